//! The picture that a person opens first: the map with chainages, crown line, L / CROWN / R and a scale bar.
//!
//! Long tunnels are wrapped into rows of equal length, so that the picture keeps a shape that a screen can show. The base is the colour
//! of the scan; without colour its intensity under a light from the upper left, without intensity the shaded relief.

use super::draw::{DrawInput, MapPoints, Piece, Sink, SinkError, draw_points};
use super::grid::next_in_series;
use super::layer::{Layer, LayerDescription};
use super::reference_lines::{LineKind, ReferenceLine};
use super::stroke_font::{Align, TextStyle, draw_text, paint, stroke_path, text_width};
use super::{Error, Grid, Settings, Summary};
use crate::numeric::Vec2;
use tiny_skia::{FillRule, PathBuilder, Pixmap, PixmapMut, Rect, Transform};

/// Rows are about this many times as long as the girth is wide.
const ROW_ASPECT: f64 = 3.2;
/// Columns of map wanted in a row, and most rows of pixels of the whole picture.
const ROW_PX: f64 = 4200.0;
const MAX_HEIGHT_PX: f64 = 14_000.0;
/// A small map is drawn with finer pixels than it has, at least half as large, so that a row has this many columns.
const SMALL_ROW_PX: f64 = 2000.0;
const FINER: f64 = 2.0;

const INK: [u8; 4] = [34, 38, 44, 255];
const FAINT: [u8; 4] = [34, 38, 44, 150];
const LIGHT: [u8; 4] = [255, 255, 255, 225];
const SHADE: [u8; 4] = [0, 0, 0, 120];
const GRID_SHADOW: [u8; 4] = [0, 0, 0, 50];
const HATCH: [u8; 3] = [196, 200, 206];
const HATCH_GROUND: [u8; 3] = [240, 241, 243];

/// A picture in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Red, green, blue, alpha of each pixel, from the upper left.
    pub rgba: Vec<u8>,
}

/// Draws the overview of a map that was drawn of `points` with `settings` and gave `summary`, with its reference lines.
///
/// # Errors
/// As [`draw_points`].
pub fn overview(
    input: &DrawInput,
    points: &MapPoints,
    settings: &Settings,
    summary: &Summary,
    lines: &[ReferenceLine],
) -> Result<Picture, Error> {
    let (low, high) = (
        Vec2::new(summary.u_min_m, summary.v_max_m - summary.height_px as f64 * summary.cell_m),
        Vec2::new(summary.u_min_m + summary.width_px as f64 * summary.cell_m, summary.v_max_m),
    );
    let plan = RowPlan::new(low, high, summary.cell_m);
    let has = |layer| summary.layers.contains(&layer);
    let mut layers = vec![Layer::Coverage];
    if has(Layer::Color) {
        layers.push(Layer::Color);
    } else {
        layers.extend([Layer::Intensity, Layer::Relief].into_iter().filter(|&l| has(l)));
    }
    let base_settings = Settings { cell_m: Some(plan.cell_m), layers, ..settings.clone() };
    let mut base = BasePicture::default();
    draw_points(input, points, &base_settings, &mut base)?;
    base.mark_holes();
    Ok(plan.compose(&base, lines))
}

/// The base of the overview: one colour a pixel.
#[derive(Default)]
struct BasePicture {
    grid: Option<Grid>,
    layers: Vec<LayerDescription>,
    pixels: Vec<[u8; 3]>,
    state: Vec<State>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
enum State {
    /// Beside the map.
    #[default]
    Outside,
    /// Surface without colour, or a hole in the surface.
    Hole,
    /// Coloured.
    Drawn,
}

impl Sink for BasePicture {
    fn begin(&mut self, grid: &Grid, layers: &[LayerDescription]) -> Result<(), SinkError> {
        self.grid = Some(*grid);
        self.layers = layers.to_vec();
        self.pixels = vec![[255; 3]; grid.rect().len()];
        self.state = vec![State::Outside; grid.rect().len()];
        Ok(())
    }

    fn take(&mut self, pieces: Vec<Piece>) -> Result<(), SinkError> {
        let width = self.grid.map_or(0, |g| g.width());
        for piece in pieces {
            let find = |layer| self.layers.iter().position(|d| d.layer == layer);
            let picture = |layer| find(layer).map(|k| self.layers[k].picture(&piece.layers[k]));
            let (color, intensity, relief) = (picture(Layer::Color), picture(Layer::Intensity), picture(Layer::Relief));
            let coverage = find(Layer::Coverage).map(|k| &piece.layers[k]);
            for i in 0..piece.rect.len() {
                let at = (piece.rect.row + i / piece.rect.width) * width + piece.rect.column + i % piece.rect.width;
                if coverage.is_some_and(|c| c.get(i) != 0.0) {
                    self.state[at] = State::Hole;
                }
                let pixel = match (&color, &intensity, &relief) {
                    (Some(c), _, _) => c[i],
                    (None, Some(grey), Some(light)) => lit(grey[i], light[i]),
                    (None, Some(grey), None) => grey[i],
                    (None, None, Some(light)) => warm(light[i]),
                    (None, None, None) => match coverage.map(|c| c.get(i)) {
                        Some(class) if class != 0.0 => [205, 203, 198, 255],
                        _ => [0; 4],
                    },
                };
                if pixel[3] > 0 {
                    self.state[at] = State::Drawn;
                    self.pixels[at] = [pixel[0], pixel[1], pixel[2]];
                }
            }
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), SinkError> {
        Ok(())
    }
}

/// Intensity under a light: the relief darkens and brightens, half as strongly as alone.
fn lit(grey: [u8; 4], light: [u8; 4]) -> [u8; 4] {
    if grey[3] == 0 {
        return grey;
    }
    let shade = if light[3] == 0 { 0.75 } else { f64::from(light[0]) / 255.0 };
    // A flat wall has a shade of 0.75 and keeps its grey.
    let value = (30.0 + 0.85 * f64::from(grey[0])) * (0.4 + 0.6 * shade / 0.75);
    warm([value.min(255.0) as u8, 0, 0, 255])
}

/// A grey with a trace of stone.
fn warm(grey: [u8; 4]) -> [u8; 4] {
    let g = f64::from(grey[0]);
    [g as u8, (0.985 * g) as u8, (0.95 * g) as u8, grey[3]]
}

impl BasePicture {
    /// Pixels without surface that are not connected with the border of the picture are holes.
    fn mark_holes(&mut self) {
        let Some(grid) = self.grid else { return };
        let (w, h) = (grid.width(), grid.height());
        let mut reached = vec![false; w * h];
        let border = (0..w).flat_map(|x| [x, (h - 1) * w + x]).chain((0..h).flat_map(|y| [y * w, y * w + w - 1]));
        let mut open: Vec<usize> = border.filter(|&i| self.state[i] == State::Outside).collect();
        open.iter().for_each(|&i| reached[i] = true);
        while let Some(i) = open.pop() {
            let (x, y) = (i % w, i / w);
            let neighbours = [
                (x > 0).then(|| i - 1),
                (x + 1 < w).then(|| i + 1),
                (y > 0).then(|| i - w),
                (y + 1 < h).then(|| i + w),
            ];
            for n in neighbours.into_iter().flatten() {
                if self.state[n] == State::Outside && !reached[n] {
                    reached[n] = true;
                    open.push(n);
                }
            }
        }
        for (state, reached) in self.state.iter_mut().zip(reached) {
            if *state == State::Outside && !reached {
                *state = State::Hole;
            }
        }
    }
}

/// How the map is cut into rows, and the measures of the margins, all in pixels.
struct RowPlan {
    cell_m: f64,
    low: Vec2,
    high: Vec2,
    /// Chainages where rows start and end: one more than rows.
    cuts: Vec<f64>,
    /// The longest row, metres.
    row_m: f64,
    cap: f64,
    left: f64,
    right: f64,
    head: f64,
    above: f64,
    below: f64,
    foot: f64,
}

impl RowPlan {
    fn new(low: Vec2, high: Vec2, map_cell_m: f64) -> Self {
        let extent = high - low;
        let wanted = (ROW_ASPECT * extent.y).max(1.0);
        let rows = if extent.x <= 1.4 * wanted { 1 } else { (extent.x / wanted).ceil() as usize };
        // Rows of equal length, cut at whole multiples of ten metres (of one in pipes).
        let unit = if wanted > 20.0 { 10.0 } else { 1.0 };
        let cut = |k: usize| ((low.x + extent.x * k as f64 / rows as f64) / unit).round() * unit;
        let mut cuts = vec![low.x];
        cuts.extend((1..rows).map(cut));
        cuts.push(high.x);
        let row_m = cuts.windows(2).map(|c| c[1] - c[0]).fold(0.0, f64::max);
        let fits_height = rows as f64 * extent.y * 1.3 / MAX_HEIGHT_PX;
        let needed = (row_m / ROW_PX).max(fits_height);
        let finer = map_cell_m.min(row_m / SMALL_ROW_PX).max(map_cell_m / FINER);
        // Whole millimetres; finer for models of a metre or so.
        let wanted = needed.max(finer).max(1e-5);
        let unit = if wanted > 1e-3 { 1000.0 } else { 1e5 };
        let cell_m = (wanted * unit - 1e-6).ceil() / unit;
        let row_px = row_m / cell_m;
        let cap = (row_px / 110.0).clamp(11.0, 42.0);
        Self {
            cell_m,
            low,
            high,
            cuts,
            row_m,
            cap,
            left: 13.0 * cap,
            right: 7.0 * cap,
            head: 4.5 * cap,
            above: 2.0 * cap,
            below: 5.0 * cap,
            foot: 5.0 * cap,
        }
    }

    fn rows(&self) -> usize {
        self.cuts.len() - 1
    }

    fn compose(&self, base: &BasePicture, lines: &[ReferenceLine]) -> Picture {
        let map_height = (self.high.y - self.low.y) / self.cell_m;
        // A narrow map still has room for its texts.
        let row_px = (self.row_m / self.cell_m).max(text_width(VIEW, self.cap) + self.cap - self.right);
        let row_height = self.above + map_height + self.below;
        let width = (self.left + row_px + self.right).ceil() as u32;
        let height = (self.head + self.rows() as f64 * row_height + self.foot).ceil() as u32;
        let Some(mut pixmap) = Pixmap::new(width.max(1), height.max(1)) else {
            return Picture { width: 0, height: 0, rgba: vec![] };
        };
        pixmap.fill(tiny_skia::Color::WHITE);
        for row in 0..self.rows() {
            let top = (self.head + row as f64 * row_height + self.above).round();
            self.paste(base, row, top, &mut pixmap);
            self.annotate(row, top, map_height, lines, &mut pixmap.as_mut());
        }
        let foot = self.head + self.rows() as f64 * row_height + 1.2 * self.cap;
        self.head_and_foot(foot, row_px, &mut pixmap.as_mut());
        let rgba = pixmap.data().to_vec();
        Picture { width: width as usize, height: height as usize, rgba }
    }

    /// Copies the pixels of a row of map.
    fn paste(&self, base: &BasePicture, row: usize, top: f64, pixmap: &mut Pixmap) {
        let Some(grid) = base.grid else { return };
        let from = ((self.cuts[row] - grid.u_min()) / self.cell_m).round() as i64;
        let columns = ((self.cuts[row + 1] - self.cuts[row]) / self.cell_m).ceil() as i64;
        let (left, stride) = (self.left.round() as usize, pixmap.width() as usize);
        let hatch_period = (self.cap * 0.6).round().max(6.0) as usize;
        let data = pixmap.data_mut();
        for y in 0..grid.height() {
            for x in from.max(0)..(from + columns).min(grid.width() as i64) {
                let at = y * grid.width() + x as usize;
                let (px, py) = (left + (x - from) as usize, top as usize + y);
                let color = match base.state[at] {
                    State::Outside => continue,
                    State::Drawn => base.pixels[at],
                    State::Hole if (px + py) % hatch_period < hatch_period.div_ceil(6) => HATCH,
                    State::Hole => HATCH_GROUND,
                };
                let to = (py * stride + px) * 4;
                if let Some(out) = data.get_mut(to..to + 4) {
                    out.copy_from_slice(&[color[0], color[1], color[2], 255]);
                }
            }
        }
    }

    /// Frame, ticks, chainages, crown line and margins of a row.
    fn annotate(&self, row: usize, top: f64, map_height: f64, lines: &[ReferenceLine], canvas: &mut PixmapMut) {
        let cap = self.cap;
        let (u0, u1) = (self.cuts[row], self.cuts[row + 1]);
        let x_of = |u: f64| self.left + (u - u0) / self.cell_m;
        let y_of = |v: f64| top + (self.high.y - v) / self.cell_m;
        let (x0, x1, bottom) = (x_of(u0), x_of(u1), top + map_height);
        let thin = (cap * 0.07).max(1.0);
        let text = |align| TextStyle { cap_px: cap, align, color: INK, upwards: false };

        // Chainage: a tick each step, a line and a label each so many.
        let (tick_m, label_m) = tick_steps(self.row_m, cap * self.cell_m);
        let mut ticks = PathBuilder::new();
        let mut verticals = PathBuilder::new();
        for k in (u0 / tick_m).ceil() as i64..=(u1 / tick_m).floor() as i64 {
            let u = k as f64 * tick_m;
            let x = x_of(u);
            let is_label = ((u / label_m).round() * label_m - u).abs() < 1e-6 * tick_m.max(1.0);
            let length = if is_label { 0.9 * cap } else { 0.45 * cap };
            segment(&mut ticks, x, bottom, x, bottom + length);
            segment(&mut ticks, x, top, x, top - length);
            if is_label {
                draw_text(canvas, &chainage_label(u), Vec2::new(x, bottom + 2.4 * cap), &text(Align::Middle));
                segment(&mut verticals, x, top, x, bottom);
            }
        }
        // Girth: every metre or so at the right edge, labelled.
        let girth_step = girth_step(self.high.y - self.low.y);
        for k in (self.low.y / girth_step).ceil() as i64..=(self.high.y / girth_step).floor() as i64 {
            let v = k as f64 * girth_step;
            let y = y_of(v);
            segment(&mut ticks, x1, y, x1 + 0.6 * cap, y);
            segment(&mut ticks, x0, y, x0 - 0.6 * cap, y);
            let label = if k == 0 { "0 m".to_owned() } else { format!("{v:+}") };
            draw_text(canvas, &label, Vec2::new(x1 + 1.2 * cap, y + 0.5 * cap), &text(Align::Start));
        }
        draw_lines(canvas, verticals, thin, GRID_SHADOW);
        draw_lines(canvas, ticks, thin, INK);

        // Reference lines: light over dark, to be seen on any wall. Their names stand where they meet the left edge.
        let mut named = Vec::new();
        for line in lines {
            let pattern: &[f64] = match line.kind {
                LineKind::Crown => &[1.2, 0.8],
                LineKind::SpringlineLeft | LineKind::SpringlineRight => &[0.9, 0.5, 0.15, 0.5],
                LineKind::FootLeft | LineKind::FootRight => &[],
            };
            let pattern: Vec<f64> = pattern.iter().map(|p| p * cap).collect();
            let pixels = |p: &[f64; 2]| Vec2::new(x_of(p[0]), y_of(p[1]));
            let mut path = PathBuilder::new();
            for piece in &line.pieces {
                let inside: Vec<Vec2> = piece.iter().filter(|p| p[0] >= u0 && p[0] <= u1).map(pixels).collect();
                dashed(&mut path, &inside, &pattern);
                if let Some(first) = inside.first().filter(|p| p.x < x0 + 4.0 * cap) {
                    named.push((line.kind, first.y));
                }
            }
            draw_lines(canvas, path.clone(), 2.2 * thin, SHADE);
            draw_lines(canvas, path, 1.1 * thin, LIGHT);
        }
        // Margins: names of lines that keep a distance from each other, the crown's first.
        let crown = y_of(0.0);
        let shows_crown = crown > top && crown < bottom;
        if shows_crown && !named.iter().any(|n| n.0 == LineKind::Crown) {
            named.push((LineKind::Crown, crown));
        }
        named.sort_by_key(|n| n.0);
        let margin = |canvas: &mut PixmapMut, name: &str, x: f64, y: f64, size: f64| {
            let style = TextStyle { cap_px: size, align: Align::End, color: INK, upwards: false };
            draw_text(canvas, name, Vec2::new(x, y + 0.5 * size), &style);
        };
        let mut taken: Vec<f64> = Vec::new();
        for (kind, y) in named {
            if taken.iter().all(|t| (t - y).abs() > 1.5 * cap) {
                margin(canvas, kind.label(), x0 - 1.3 * cap, y, cap);
                taken.push(y);
            }
        }
        let (big, wall) = (1.5 * cap, x0 - 9.0 * cap);
        if shows_crown {
            margin(canvas, "R", wall, (top + crown) / 2.0, big);
            margin(canvas, "L", wall, (crown + bottom) / 2.0, big);
        } else {
            margin(canvas, if crown >= bottom { "R" } else { "L" }, wall, (top + bottom) / 2.0, big);
        }
        let mut frame = PathBuilder::new();
        for (a, b, c, d) in [(x0, top, x1, top), (x1, top, x1, bottom), (x1, bottom, x0, bottom), (x0, bottom, x0, top)]
        {
            segment(&mut frame, a, b, c, d);
        }
        draw_lines(canvas, frame, thin, INK);
    }

    /// View and units above, scale bar and key below.
    fn head_and_foot(&self, foot: f64, row_px: f64, canvas: &mut PixmapMut) {
        let cap = self.cap;
        let style = |align| TextStyle { cap_px: cap, align, color: INK, upwards: false };
        draw_text(canvas, VIEW, Vec2::new(self.left, self.head - 1.6 * cap), &style(Align::Start));

        // A scale bar of about a fifth of the row, in five boxes.
        let wanted = 0.2 * row_px * self.cell_m;
        let length_m = super::grid::previous_in_series(wanted.max(1e-3));
        let length = length_m / self.cell_m;
        let x1 = self.left + row_px;
        let x0 = x1 - length;
        let boxes = if format!("{length_m:e}").starts_with('2') { 4 } else { 5 };
        let height = 0.5 * cap;
        for k in 0..boxes {
            let x = x0 + length * f64::from(k) / f64::from(boxes);
            let color = if k % 2 == 0 { INK } else { [255; 4] };
            fill_rect(canvas, x, foot, length / f64::from(boxes), height, color);
        }
        let mut frame = PathBuilder::new();
        for (a, b, c, d) in [
            (x0, foot, x1, foot),
            (x1, foot, x1, foot + height),
            (x1, foot + height, x0, foot + height),
            (x0, foot + height, x0, foot),
        ] {
            segment(&mut frame, a, b, c, d);
        }
        draw_lines(canvas, frame, (cap * 0.07).max(1.0), INK);
        let below = foot + height + 1.6 * cap;
        draw_text(canvas, "0", Vec2::new(x0, below), &style(Align::Middle));
        draw_text(canvas, &metres(length_m), Vec2::new(x1, below), &style(Align::End));

        // What the hatching means.
        let (x, side) = (self.left, 1.6 * cap);
        fill_rect(canvas, x, foot, 2.0 * side, side, [HATCH_GROUND[0], HATCH_GROUND[1], HATCH_GROUND[2], 255]);
        let mut hatch = PathBuilder::new();
        let step = side / 3.0;
        for k in 1..9 {
            // Diagonals clipped to the box.
            let c = f64::from(k) * step;
            let (ax, ay) = if c <= side { (0.0, c) } else { (c - side, side) };
            let (bx, by) = if c <= 2.0 * side { (c, 0.0) } else { (2.0 * side, c - 2.0 * side) };
            segment(&mut hatch, x + ax, foot + ay, x + bx, foot + by);
        }
        draw_lines(canvas, hatch, (cap * 0.08).max(1.0), [HATCH[0], HATCH[1], HATCH[2], 255]);
        let faint = TextStyle { color: FAINT, ..style(Align::Start) };
        draw_text(canvas, "not scanned", Vec2::new(x + 2.6 * side, foot + 0.5 * side + 0.5 * cap), &faint);
    }
}

/// What the picture shows, so that nobody takes it for its mirror image.
const VIEW: &str =
    "seen from inside, facing increasing chainage    chainage (m) to the right, girth from the crown (m) up";

/// Steps of the ticks and of the labels along the tunnel, metres: labels must not touch each other.
fn tick_steps(row_m: f64, cap_m: f64) -> (f64, f64) {
    let label_width_m = 6.5 * cap_m;
    let label_m =
        [1.0, 5.0, 10.0, 50.0, 100.0].into_iter().find(|&l| l > label_width_m && row_m / l <= 16.0).unwrap_or(500.0);
    let label_m = if row_m < 4.0 { 0.5 } else { label_m };
    let tick_m: f64 = if label_m <= 1.0 { 0.1 } else { 1.0 };
    (tick_m.max(label_m / 20.0), label_m)
}

fn girth_step(girth: f64) -> f64 {
    next_in_series(girth / 9.0).max(0.1)
}

/// `0+045`: kilometres + metres, with decimals where needed.
pub fn chainage_label(chainage: f64) -> String {
    let sign = if chainage < -5e-4 { "-" } else { "" };
    let millimetres = (chainage.abs() * 1000.0).round() as u64;
    let (km, m, mm) = (millimetres / 1_000_000, millimetres / 1000 % 1000, millimetres % 1000);
    if mm == 0 {
        return format!("{sign}{km}+{m:03}");
    }
    let decimals = format!("{mm:03}");
    format!("{sign}{km}+{m:03}.{}", decimals.trim_end_matches('0'))
}

fn metres(length_m: f64) -> String {
    format!("{length_m} m")
}

/// Adds a polyline in dashes and gaps of the given lengths (none: solid).
fn dashed(path: &mut PathBuilder, points: &[Vec2], pattern: &[f64]) {
    let (mut part, mut left) = (0, pattern.first().copied().unwrap_or(f64::INFINITY));
    for pair in points.windows(2) {
        let length = (pair[1] - pair[0]).norm();
        let at = |s: f64| pair[0] + (pair[1] - pair[0]) * (s / length.max(1e-12));
        let mut done = 0.0;
        while done < length {
            let step = left.min(length - done);
            if part % 2 == 0 {
                let (a, b) = (at(done), at(done + step));
                segment(path, a.x, a.y, b.x, b.y);
            }
            done += step;
            left -= step;
            if left <= 1e-9 {
                part = (part + 1) % pattern.len().max(1);
                left = pattern[part];
            }
        }
    }
}

fn segment(path: &mut PathBuilder, x0: f64, y0: f64, x1: f64, y1: f64) {
    path.move_to(x0 as f32, y0 as f32);
    path.line_to(x1 as f32, y1 as f32);
}

fn draw_lines(canvas: &mut PixmapMut, path: PathBuilder, width_px: f64, color: [u8; 4]) {
    if let Some(path) = path.finish() {
        stroke_path(canvas, &path, width_px, color);
    }
}

fn fill_rect(canvas: &mut PixmapMut, x: f64, y: f64, width: f64, height: f64, color: [u8; 4]) {
    if let Some(rect) = Rect::from_xywh(x as f32, y as f32, width as f32, height as f32) {
        let path = PathBuilder::from_rect(rect);
        canvas.fill_path(&path, &paint(color), FillRule::Winding, Transform::identity(), None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chainages_read_as_surveyors_write_them() {
        assert_eq!(chainage_label(45.0), "0+045");
        assert_eq!(chainage_label(1234.5), "1+234.5");
        assert_eq!(chainage_label(-7.25), "-0+007.25");
        assert_eq!(chainage_label(-1e-12), "0+000");
    }

    #[test]
    fn long_tunnels_are_wrapped_into_rows() {
        let short = RowPlan::new(Vec2::new(0.0, -12.0), Vec2::new(41.0, 12.0), 0.005);
        assert_eq!((short.rows(), short.cell_m), (1, 0.01));
        let long = RowPlan::new(Vec2::new(100.0, -12.0), Vec2::new(1100.0, 12.0), 0.005);
        assert!(long.rows() > 10 && long.row_m <= 80.0 && long.cuts[1] % 10.0 == 0.0);
        assert!(long.rows() as f64 * 24.0 / long.cell_m < MAX_HEIGHT_PX);
    }

    #[test]
    fn a_pipe_that_starts_before_zero_has_no_sliver_of_a_row() {
        let pipe = RowPlan::new(Vec2::new(-0.06, -1.5), Vec2::new(20.6, 1.45), 0.02);
        assert_eq!(pipe.cuts, [-0.06, 7.0, 14.0, 20.6]);
        // Drawn finer than the map, so that its texts can be read.
        assert_eq!(pipe.cell_m, 0.01);
    }

    #[test]
    fn dashes_go_on_around_corners() {
        let mut path = PathBuilder::new();
        dashed(&mut path, &[Vec2::zeros(), Vec2::new(3.0, 0.0), Vec2::new(3.0, 4.0)], &[2.0, 2.0]);
        let bounds = path.finish().unwrap().bounds();
        assert_eq!((bounds.right(), bounds.bottom()), (3.0, 3.0));
    }

    #[test]
    fn ticks_suit_pipes_and_tunnels() {
        assert_eq!(tick_steps(41.0, 0.4), (1.0, 5.0));
        assert_eq!(tick_steps(80.0, 0.8), (1.0, 10.0));
        assert_eq!(tick_steps(3.0, 0.03), (0.1, 0.5));
    }
}
