//! The picture that a person opens first: the map with chainages, crown line, L / CROWN / R and a scale bar.
//!
//! Long tunnels are wrapped into rows, so that the picture keeps a shape that a screen can show. The base is the colour
//! of the scan; without colour its intensity under a light from the upper left, without intensity the shaded relief.

use super::draw::{DrawInput, Piece, Sink, SinkError, draw};
use super::grid::next_in_series;
use super::layer::{Layer, LayerDescription};
use super::stroke_font::{Align, TextStyle, draw_text, paint, stroke_path, text_width};
use super::{Error, Grid, Settings, Summary};
use crate::numeric::Vec2;
use tiny_skia::{FillRule, PathBuilder, Pixmap, PixmapMut, Rect, Transform};

/// Rows are about this many times as long as the girth is wide.
const ROW_ASPECT: f64 = 3.2;
/// Columns of map wanted in a row, and most rows of pixels of the whole picture.
const ROW_PX: f64 = 4200.0;
const MAX_HEIGHT_PX: f64 = 14_000.0;

const INK: [u8; 4] = [34, 38, 44, 255];
const FAINT: [u8; 4] = [34, 38, 44, 150];
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

/// Draws the overview of a map that was drawn with `settings` and gave `summary`.
///
/// # Errors
/// As [`draw`].
pub fn overview(input: &DrawInput, settings: &Settings, summary: &Summary) -> Result<Picture, Error> {
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
    let base_settings = Settings {
        cell_m: Some(plan.cell_m),
        fill_m: settings.fill_m,
        max_offset_m: Some(summary.max_offset_m),
        layers,
    };
    let mut base = BasePicture::default();
    draw(input, &base_settings, &mut base)?;
    base.mark_holes();
    Ok(plan.compose(&base))
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
    row_m: f64,
    rows: usize,
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
        let (rows, row_m) = if extent.x <= 1.4 * wanted {
            (1, extent.x)
        } else {
            // Whole multiples of ten metres (of one in pipes) make rows start at round chainages.
            let unit = if wanted > 20.0 { 10.0 } else { 1.0 };
            let row_m = (wanted / unit).round().max(1.0) * unit;
            let first = (low.x / row_m).floor() * row_m;
            (((high.x - first) / row_m).ceil() as usize, row_m)
        };
        let fits_width = row_m / ROW_PX;
        let fits_height = rows as f64 * extent.y * 1.3 / MAX_HEIGHT_PX;
        // Whole millimetres; finer for models of a metre or so.
        let wanted = fits_width.max(fits_height).max(1e-5);
        let unit = if wanted > 1e-3 { 1000.0 } else { 1e5 };
        let cell_m = map_cell_m.max((wanted * unit).ceil() / unit);
        let row_px = row_m / cell_m;
        let cap = (row_px / 110.0).clamp(9.0, 42.0);
        Self {
            cell_m,
            low,
            high,
            row_m,
            rows,
            cap,
            left: 11.0 * cap,
            right: 7.0 * cap,
            head: 4.5 * cap,
            above: 2.0 * cap,
            below: 5.0 * cap,
            foot: 5.0 * cap,
        }
    }

    /// First chainage of a row.
    fn row_start(&self, row: usize) -> f64 {
        if self.rows == 1 {
            return self.low.x;
        }
        let first = (self.low.x / self.row_m).floor() * self.row_m;
        first + row as f64 * self.row_m
    }

    fn compose(&self, base: &BasePicture) -> Picture {
        let map_height = (self.high.y - self.low.y) / self.cell_m;
        // A narrow map still has room for its texts.
        let row_px = (self.row_m / self.cell_m).max(text_width(VIEW, self.cap) - self.left);
        let row_height = self.above + map_height + self.below;
        let width = (self.left + row_px + self.right).ceil() as u32;
        let height = (self.head + self.rows as f64 * row_height + self.foot).ceil() as u32;
        let Some(mut pixmap) = Pixmap::new(width.max(1), height.max(1)) else {
            return Picture { width: 0, height: 0, rgba: vec![] };
        };
        pixmap.fill(tiny_skia::Color::WHITE);
        for row in 0..self.rows {
            let top = (self.head + row as f64 * row_height + self.above).round();
            self.paste(base, row, top, &mut pixmap);
            self.annotate(row, top, map_height, &mut pixmap.as_mut());
        }
        let foot = self.head + self.rows as f64 * row_height + 1.2 * self.cap;
        self.head_and_foot(foot, row_px, &mut pixmap.as_mut());
        let rgba = pixmap.data().to_vec();
        Picture { width: width as usize, height: height as usize, rgba }
    }

    /// Copies the pixels of a row of map.
    fn paste(&self, base: &BasePicture, row: usize, top: f64, pixmap: &mut Pixmap) {
        let Some(grid) = base.grid else { return };
        let from = ((self.row_start(row) - grid.u_min()) / self.cell_m).round() as i64;
        let columns = (self.row_m / self.cell_m).ceil() as i64;
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
    fn annotate(&self, row: usize, top: f64, map_height: f64, canvas: &mut PixmapMut) {
        let cap = self.cap;
        let start = self.row_start(row);
        let (u0, u1) = (start.max(self.low.x), (start + self.row_m).min(self.high.x));
        let x_of = |u: f64| self.left + (u - start) / self.cell_m;
        let y_of = |v: f64| top + (self.high.y - v) / self.cell_m;
        let (x0, x1, bottom) = (x_of(u0), x_of(u1), top + map_height);
        let thin = (cap * 0.07).max(1.0);
        let text = |align| TextStyle { cap_px: cap, align, color: INK, upwards: false };

        // Chainage: a tick each step, a line and a label each so many.
        let (tick_m, label_m) = tick_steps(self.row_m, cap * self.cell_m);
        let mut ticks = PathBuilder::new();
        let mut lines = PathBuilder::new();
        for k in (u0 / tick_m).ceil() as i64..=(u1 / tick_m).floor() as i64 {
            let u = k as f64 * tick_m;
            let x = x_of(u);
            let is_label = ((u / label_m).round() * label_m - u).abs() < 1e-6 * tick_m.max(1.0);
            let length = if is_label { 0.9 * cap } else { 0.45 * cap };
            segment(&mut ticks, x, bottom, x, bottom + length);
            segment(&mut ticks, x, top, x, top - length);
            if is_label {
                draw_text(canvas, &chainage_label(u), Vec2::new(x, bottom + 2.4 * cap), &text(Align::Middle));
                segment(&mut lines, x, top, x, bottom);
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
        draw_lines(canvas, lines, thin, GRID_SHADOW);
        draw_lines(canvas, ticks, thin, INK);

        // The crown: dashes, dark under light, to be seen on any wall.
        let crown = y_of(0.0);
        if crown > top && crown < bottom {
            let mut dashes = PathBuilder::new();
            let (dash, gap) = (1.2 * cap, 0.8 * cap);
            let mut x = x0;
            while x < x1 {
                segment(&mut dashes, x, crown, (x + dash).min(x1), crown);
                x += dash + gap;
            }
            let under = dashes.clone();
            draw_lines(canvas, under, 2.2 * thin, [0, 0, 0, 110]);
            draw_lines(canvas, dashes, 1.1 * thin, [255, 255, 255, 230]);
        }
        // Margins.
        let big = 1.5 * cap;
        let margin = |canvas: &mut PixmapMut, name: &str, y: f64, size: f64| {
            let style = TextStyle { cap_px: size, align: Align::End, color: INK, upwards: false };
            draw_text(canvas, name, Vec2::new(x0 - 1.3 * cap, y + 0.5 * size), &style);
        };
        if crown > top && crown < bottom {
            margin(canvas, "CROWN", crown, cap);
            margin(canvas, "R", (top + crown) / 2.0, big);
            margin(canvas, "L", (crown + bottom) / 2.0, big);
        } else {
            margin(canvas, if crown >= bottom { "R" } else { "L" }, (top + bottom) / 2.0, big);
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
        assert_eq!((short.rows, short.cell_m), (1, 0.01));
        let long = RowPlan::new(Vec2::new(100.0, -12.0), Vec2::new(1100.0, 12.0), 0.005);
        assert!(long.rows > 10 && long.row_m == 80.0 && long.row_start(0) == 80.0);
        assert!(long.rows as f64 * 24.0 / long.cell_m < MAX_HEIGHT_PX);
    }

    #[test]
    fn ticks_suit_pipes_and_tunnels() {
        assert_eq!(tick_steps(41.0, 0.4), (1.0, 5.0));
        assert_eq!(tick_steps(80.0, 0.8), (1.0, 10.0));
        assert_eq!(tick_steps(3.0, 0.03), (0.1, 0.5));
    }
}
