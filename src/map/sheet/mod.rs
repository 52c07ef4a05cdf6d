//! The map sheet: the map at true scale on paper, with everything a reader needs to use it, on as many pages as it takes.
//!
//! Each page shows a stretch of tunnel that overlaps its neighbours, a grid in metres, chainages, the reference lines,
//! strips along the chainage (azimuth, gradient, coverage, distortion), a legend and a title block. Nothing is scaled to
//! fit: one metre is `1000 / scale` millimetres in both directions; a map that is too wide for the paper is an error.

mod page;
mod strips;

pub use page::{Align, Item, Page, TEXT_PEN, text_strokes, text_width_mm};
pub use strips::{Strip, nice_range};

use super::overview::{Picture, chainage_label};
use super::{Legend, LegendLayer, LineKind, ReferenceLine, Swatch};
use crate::numeric::Vec2;

/// Which way the chainage runs on the paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// To the right.
    ChainageX,
    /// Upwards.
    ChainageY,
}

/// From where the wall is seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum View {
    /// From the void: what somebody in the tunnel sees.
    Inside,
    /// From the rock: the mirror image.
    Outside,
}

/// How the sheet is laid out.
#[derive(Clone, Debug, PartialEq)]
pub struct SheetSettings {
    /// One metre is `1000 / scale` millimetres.
    pub scale: f64,
    /// Width and height of the paper in millimetres, landscape; `None`: the smallest of A4 to A0 that holds the girth.
    pub paper_mm: Option<[f64; 2]>,
    /// Which way the chainage runs.
    pub layout: Layout,
    /// From where the wall is seen.
    pub view: View,
    /// Resolution of the embedded raster, pixels per 25.4 mm.
    pub dpi: f64,
}

/// A line that was mapped, such as a fracture.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    /// What is printed beside it.
    pub id: String,
    /// Chainage and girth, metres.
    pub points: Vec<[f64; 2]>,
}

/// What the sheet shows.
#[derive(Clone, Copy, Debug)]
pub struct SheetContent<'a> {
    /// Grid and layers of the map.
    pub legend: &'a Legend,
    /// The layer that is printed.
    pub layer: &'a LegendLayer,
    /// Crown, springlines, feet of the walls.
    pub lines: &'a [ReferenceLine],
    /// Mapped lines.
    pub traces: &'a [Trace],
    /// Curves along the chainage.
    pub strips: &'a [Strip],
    /// Title block: a caption and a value each.
    pub title: &'a [(String, String)],
}

/// Gives the map's picture over a rectangle of the chart (least and greatest corner) in so many columns and rows.
pub type Raster<'a, E> = dyn FnMut(Vec2, Vec2, usize, usize) -> Result<Picture, E> + 'a;

/// Why there is no sheet.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SheetError<E: std::error::Error + 'static> {
    /// The scale is not a positive number.
    #[error("a scale of 1:{scale} cannot be drawn; give a number such as 100")]
    Scale {
        /// The scale asked for.
        scale: f64,
    },
    /// The map is wider than the paper.
    #[error(
        "at 1:{scale} the girth of {girth_m:.1} m needs paper of {needed_mm:.0} mm, this one has {paper_mm:.0} mm: \
         choose larger paper, or a scale of 1:{fitting} or smaller"
    )]
    Paper {
        /// The scale asked for.
        scale: f64,
        /// Height of the map, metres.
        girth_m: f64,
        /// Height of paper needed, millimetres.
        needed_mm: f64,
        /// Height of the paper, millimetres.
        paper_mm: f64,
        /// The first usual scale that fits.
        fitting: f64,
    },
    /// The raster could not be read.
    #[error(transparent)]
    Raster(E),
}

/// A4 to A0, landscape, millimetres.
const PAPERS_MM: [[f64; 2]; 5] = [[297.0, 210.0], [420.0, 297.0], [594.0, 420.0], [841.0, 594.0], [1189.0, 841.0]];
/// Usual scales, for advice.
const SCALES: [f64; 10] = [10.0, 20.0, 25.0, 50.0, 100.0, 200.0, 250.0, 500.0, 1000.0, 2000.0];
/// Paper's edge to the outer frame, millimetres.
const EDGE: f64 = 8.0;
/// Between the frame and the map: before its first chainage, behind its last, above it, millimetres.
const BEFORE: f64 = 24.0;
const BEHIND: f64 = 16.0;
const ABOVE: f64 = 13.0;
/// Room for the chainages, horizontal and upright layout, millimetres.
const CHAINAGES: [f64; 2] = [8.0, 18.0];
/// Height of a strip with its gap, millimetres.
const STRIP: f64 = 10.0;
const STRIP_GAP: f64 = 2.0;
/// Legend and title block, millimetres.
const LEGEND: f64 = 13.0;
const TITLE: f64 = 26.0;
/// Overlap of pages, millimetres of paper.
const OVERLAP: f64 = 10.0;

const INK: [u8; 3] = [28, 32, 38];
const FAINT: [u8; 3] = [120, 126, 134];
const GRID: [u8; 3] = [60, 66, 74];
const FRACTURE: [u8; 3] = [200, 16, 46];
const CAP: f64 = 2.2;

/// Draws the sheet's pages.
///
/// # Errors
/// [`SheetError`] when the map does not fit the paper, or its raster cannot be read.
pub fn sheet<E: std::error::Error + 'static>(
    content: &SheetContent,
    settings: &SheetSettings,
    raster: &mut Raster<E>,
) -> Result<Vec<Page>, SheetError<E>> {
    let plan = PagePlan::new(content, settings)?;
    (0..plan.pages).map(|k| plan.page(k, content, settings, raster)).collect()
}

/// Measures that all pages share.
struct PagePlan {
    scale: f64,
    layout: Layout,
    view: View,
    /// Width and height of the paper as it lies before the reader.
    paper: [f64; 2],
    low: Vec2,
    high: Vec2,
    /// First chainage, length shown on a page and step from page to page, metres.
    start: f64,
    length: f64,
    pitch: f64,
    pages: usize,
}

impl PagePlan {
    fn new<E: std::error::Error + 'static>(
        content: &SheetContent,
        settings: &SheetSettings,
    ) -> Result<Self, SheetError<E>> {
        let scale = settings.scale;
        if !(scale.is_finite() && scale > 0.0) {
            return Err(SheetError::Scale { scale });
        }
        let l = content.legend;
        let low = Vec2::new(l.u_min_m, l.v_max_m - l.height_px as f64 * l.cell_m);
        let high = Vec2::new(l.u_min_m + l.width_px as f64 * l.cell_m, l.v_max_m);
        let strips = content.strips.len() as f64 * STRIP;
        let upright = settings.layout == Layout::ChainageY;
        // Room beside the map, across and along the chainage.
        let (across, along) = if upright {
            (2.0 * EDGE + 16.0 + CHAINAGES[1] + strips, 2.0 * EDGE + ABOVE + BEFORE + LEGEND + TITLE)
        } else {
            (2.0 * EDGE + ABOVE + CHAINAGES[0] + strips + LEGEND + TITLE, 2.0 * EDGE + BEFORE + BEHIND)
        };
        let girth_m = high.y - low.y;
        let needed = |scale: f64| across + girth_m * 1000.0 / scale;
        let turned = |p: [f64; 2]| if upright { [p[1], p[0]] } else { p };
        let side = |p: [f64; 2]| if upright { p[0] } else { p[1] };
        let papers: Vec<[f64; 2]> = settings.paper_mm.map_or(PAPERS_MM.to_vec(), |p| vec![p]);
        let Some(&paper) = papers.iter().find(|p| side(turned(**p)) >= needed(scale)) else {
            let paper_mm = side(turned(papers[papers.len() - 1]));
            let fitting = SCALES.into_iter().find(|&s| s > scale && needed(s) <= paper_mm);
            return Err(SheetError::Paper {
                scale,
                girth_m,
                needed_mm: needed(scale),
                paper_mm,
                fitting: fitting.unwrap_or(f64::INFINITY),
            });
        };
        let paper = turned(paper);
        let long = if upright { paper[1] } else { paper[0] };
        let metres = |mm: f64| mm * scale / 1000.0;
        // Whole metres on a page, where a metre is small enough for that.
        let unit = if metres(long) > 8.0 { 1.0 } else { 0.1 };
        let whole = |x: f64| ((x / unit + 1e-9).floor() * unit).max(unit);
        let start = (low.x / unit + 1e-9).floor() * unit;
        let length = whole(metres(long - along));
        let pitch = whole(length - metres(OVERLAP));
        let rest = (high.x - start - length).max(0.0);
        let pages = 1 + (rest / pitch - 1e-9).ceil().max(0.0) as usize;
        Ok(Self { scale, layout: settings.layout, view: settings.view, paper, low, high, start, length, pitch, pages })
    }

    fn mm(&self, metres: f64) -> f64 {
        metres * 1000.0 / self.scale
    }

    fn is_upright(&self) -> bool {
        self.layout == Layout::ChainageY
    }

    /// Height of the map across the chainage, millimetres.
    fn girth_mm(&self) -> f64 {
        self.mm(self.high.y - self.low.y)
    }

    /// A place on the page: `a` millimetres along the chainage, `b` across it, from where right walls are seen to left.
    fn place(&self, a: f64, b: f64) -> [f64; 2] {
        if self.is_upright() {
            [EDGE + 16.0 + b, self.paper[1] - EDGE - TITLE - LEGEND - BEFORE - a]
        } else {
            [EDGE + BEFORE + a, EDGE + ABOVE + b]
        }
    }

    /// Millimetres across the chainage of a girth.
    fn across(&self, v: f64) -> f64 {
        match self.view {
            View::Inside => self.mm(self.high.y - v),
            View::Outside => self.mm(v - self.low.y),
        }
    }

    fn page<E: std::error::Error + 'static>(
        &self,
        k: usize,
        content: &SheetContent,
        settings: &SheetSettings,
        raster: &mut Raster<E>,
    ) -> Result<Page, SheetError<E>> {
        let u0 = self.start + k as f64 * self.pitch;
        let u1 = (u0 + self.length).min(self.high.x.max(u0 + self.pitch.min(1.0)));
        let mut page = Page::new(self.paper[0], self.paper[1]);
        self.picture(u0, u1, content, settings, raster, &mut page).map_err(SheetError::Raster)?;
        self.grid(u0, u1, &mut page);
        self.reference_lines(u0, u1, content.lines, &mut page);
        self.traces(u0, u1, content.traces, &mut page);
        self.margins(u0, content.lines, &mut page);
        for (i, strip) in content.strips.iter().enumerate() {
            let top = self.girth_mm() + CHAINAGES[usize::from(self.is_upright())] + i as f64 * STRIP;
            let height = STRIP - STRIP_GAP;
            let turn = |points: Vec<[f64; 2]>| points.into_iter().map(|[a, b]| self.place(a, b)).collect::<Vec<_>>();
            strip.draw(&mut page, [u0, u1], self.mm(u1 - u0), top, height, self.is_upright(), &turn);
        }
        self.head(k, u0, u1, &mut page);
        self.legend(content, &mut page);
        self.title(k, content.title, &mut page);
        Ok(page)
    }

    fn picture<E>(
        &self,
        u0: f64,
        u1: f64,
        content: &SheetContent,
        settings: &SheetSettings,
        raster: &mut Raster<E>,
        page: &mut Page,
    ) -> Result<(), E> {
        let (from, to) = (u0.max(self.low.x), u1.min(self.high.x));
        if to <= from {
            return Ok(());
        }
        let pixels = |m: f64| ((self.mm(m) / 25.4 * settings.dpi).round() as usize).max(1);
        let (columns, rows) = (pixels(to - from), pixels(self.high.y - self.low.y));
        let mut picture = raster(Vec2::new(from, self.low.y), Vec2::new(to, self.high.y), columns, rows)?;
        if self.view == View::Outside {
            picture = remap(&picture, columns, rows, |x, y| (x, rows - 1 - y));
        }
        let (mut width_mm, mut height_mm) = (self.mm(to - from), self.girth_mm());
        let mut at = self.place(self.mm(from - u0), 0.0);
        if self.is_upright() {
            // A quarter turn to the left: what was right is up.
            picture = remap(&picture, rows, columns, |x, y| (columns - 1 - y, x));
            (width_mm, height_mm) = (height_mm, width_mm);
            at[1] -= height_mm;
        }
        let photo = matches!(content.layer.look, super::Look::Rgba | super::Look::Grey { .. });
        page.items.push(Item::Image { at, width_mm, height_mm, picture, photo });
        Ok(())
    }

    fn grid(&self, u0: f64, u1: f64, page: &mut Page) {
        let (wide, high) = (self.mm(u1 - u0), self.girth_mm());
        let a_of = |u: f64| self.mm(u - u0);
        // Bold lines each 10 m at 1:100, others in between; fewer metres on larger scales.
        let bold = super::grid::next_in_series(self.scale * 0.099);
        let fine = if format!("{bold:e}").starts_with('5') { bold / 5.0 } else { bold / 2.0 };
        let tick = [25.0, 250.0, 2500.0].iter().filter(|s| self.scale > **s).fold(0.1, |tick, _| 10.0 * tick);
        let each = |step: f64, from: f64, to: f64| {
            ((from / step - 1e-9).ceil() as i64..=(to / step + 1e-9).floor() as i64).map(move |k| k as f64 * step)
        };
        let is_bold = |x: f64| ((x / bold).round() * bold - x).abs() < 1e-6;
        for u in each(fine, u0, u1) {
            let pen = if is_bold(u) { 0.18 } else { 0.06 };
            page.line(&[self.place(a_of(u), 0.0), self.place(a_of(u), high)], pen, GRID);
        }
        for v in each(fine, self.low.y, self.high.y) {
            let b = self.across(v);
            page.line(&[self.place(0.0, b), self.place(wide, b)], if is_bold(v) { 0.18 } else { 0.06 }, GRID);
            let sign = if v.abs() < 1e-9 { "0 m".to_owned() } else { format!("{:+}", (v * 1e3).round() / 1e3) };
            page.line(&[self.place(wide, b), self.place(wide + 1.2, b)], 0.15, INK);
            let (shift, align) =
                if self.is_upright() { ([0.0, -2.0], Align::Middle) } else { ([2.0, 0.4 * CAP], Align::Start) };
            let p = self.place(wide + if self.is_upright() { 1.2 } else { 0.0 }, b);
            page.text(&sign, [p[0] + shift[0], p[1] + shift[1]], 0.85 * CAP, align, INK);
        }
        for u in each(tick, u0, u1) {
            let long = ((u / fine).round() * fine - u).abs() < 1e-6;
            let length = if long { 2.0 } else { 1.0 };
            page.line(&[self.place(a_of(u), high), self.place(a_of(u), high + length)], 0.15, INK);
            page.line(&[self.place(a_of(u), 0.0), self.place(a_of(u), -length)], 0.15, INK);
            if long {
                let p = self.place(a_of(u), high);
                let (at, align) = if self.is_upright() {
                    ([p[0] + 2.8, p[1] + 0.45 * CAP], Align::Start)
                } else {
                    ([p[0], p[1] + 3.0 + CAP], Align::Middle)
                };
                page.text(&chainage_label(u), at, CAP, align, INK);
            }
        }
        let corners = [[0.0, 0.0], [wide, 0.0], [wide, high], [0.0, high], [0.0, 0.0]];
        page.line(&corners.map(|[a, b]| self.place(a, b)), 0.3, INK);
    }

    /// The part of a line between two chainages, on the page.
    fn on_page(&self, points: &[[f64; 2]], u0: f64, u1: f64) -> Vec<Vec<[f64; 2]>> {
        let mut parts: Vec<Vec<[f64; 2]>> = Vec::new();
        let mut open = false;
        for pair in points.windows(2) {
            let (a, b) = (pair[0], pair[1]);
            let (mut t0, mut t1) = (0.0, 1.0);
            let du = b[0] - a[0];
            if du.abs() < 1e-12 {
                if a[0] < u0 || a[0] > u1 {
                    open = false;
                    continue;
                }
            } else {
                let (s, e) = ((u0 - a[0]) / du, (u1 - a[0]) / du);
                t0 = f64::max(t0, s.min(e));
                t1 = f64::min(t1, s.max(e));
            }
            if t0 > t1 {
                open = false;
                continue;
            }
            let at = |t: f64| self.place(self.mm(a[0] + du * t - u0), self.across(a[1] + (b[1] - a[1]) * t));
            if !open || t0 > 0.0 {
                parts.push(vec![at(t0)]);
            }
            if let Some(part) = parts.last_mut() {
                part.push(at(t1));
            }
            open = t1 >= 1.0;
        }
        parts
    }

    fn reference_lines(&self, u0: f64, u1: f64, lines: &[ReferenceLine], page: &mut Page) {
        for line in lines {
            let dash = dash_of(line.kind);
            for piece in line.pieces.iter().flat_map(|piece| self.on_page(piece, u0, u1)) {
                // Light under dark: to be seen on any wall.
                page.line(&piece, 0.7, [255, 255, 255]);
                page.items.push(Item::Line { points: piece, width_mm: 0.3, color: INK, dash: dash.clone() });
            }
        }
    }

    fn traces(&self, u0: f64, u1: f64, traces: &[Trace], page: &mut Page) {
        for trace in traces {
            for part in self.on_page(&trace.points, u0, u1) {
                page.line(&part, 0.45, FRACTURE);
                let p = part[part.len() / 2];
                let cap = 0.8 * CAP;
                let width = text_width_mm(&trace.id, cap);
                page.area(p[0] + 0.6, p[1] - cap - 1.0, width + 0.8, cap + 0.8, [255, 255, 255]);
                page.text(&trace.id, [p[0] + 1.0, p[1] - 0.6], cap, Align::Start, FRACTURE);
            }
        }
    }

    /// Names of the reference lines and L / R at the first chainage.
    fn margins(&self, u0: f64, lines: &[ReferenceLine], page: &mut Page) {
        let mut named: Vec<(LineKind, f64)> = vec![(LineKind::Crown, 0.0)];
        for line in lines.iter().filter(|l| l.kind != LineKind::Crown) {
            let vertices = line.pieces.iter().flatten();
            let nearest = vertices.min_by(|a, b| (a[0] - u0).abs().total_cmp(&(b[0] - u0).abs()));
            named.extend(nearest.filter(|p| (p[0] - u0).abs() < self.length).map(|p| (line.kind, p[1])));
        }
        named.sort_by_key(|n| n.0);
        let mut taken: Vec<f64> = Vec::new();
        let write = |page: &mut Page, text: &str, v: f64, a: f64, cap: f64| {
            let p = self.place(a, self.across(v));
            if self.is_upright() {
                page.text(text, [p[0], p[1] + cap], cap, Align::Middle, INK);
            } else {
                page.text(text, [p[0], p[1] + 0.45 * cap], cap, Align::End, INK);
            }
        };
        for (kind, v) in named {
            let b = self.across(v);
            let apart = if self.is_upright() { 11.0 } else { 1.5 * CAP };
            if v > self.low.y && v < self.high.y && taken.iter().all(|t| (t - b).abs() > apart) {
                write(page, kind.label(), v, -2.0, CAP);
                taken.push(b);
            }
        }
        let big = 1.8 * CAP;
        let far = if self.is_upright() { -8.0 } else { -17.0 };
        if self.high.y > 0.0 {
            write(page, "R", 0.5 * self.high.y, far, big);
        }
        if self.low.y < 0.0 {
            write(page, "L", 0.5 * self.low.y, far, big);
        }
    }

    /// View, scale and scale bar.
    fn head(&self, k: usize, u0: f64, u1: f64, page: &mut Page) {
        page.frame(EDGE, EDGE, self.paper[0] - 2.0 * EDGE, self.paper[1] - 2.0 * EDGE, 0.5, INK);
        let view = match self.view {
            View::Inside => "seen from inside, facing increasing chainage",
            View::Outside => "seen from outside (mirror image of the view from inside)",
        };
        let layout = match self.layout {
            Layout::ChainageX => "chainage to the right",
            Layout::ChainageY => "chainage upwards",
        };
        let text = format!("{view}; {layout}, girth from the crown (m)");
        let x = EDGE + if self.is_upright() { 4.0 } else { BEFORE };
        page.text(&text, [x, EDGE + 4.0 + 0.5 * CAP], CAP, Align::Start, INK);
        let range = format!(
            "{} to {}   page {} of {}",
            chainage_label((u0.max(self.low.x) * 100.0).round() / 100.0),
            chainage_label((u1.min(self.high.x) * 100.0).round() / 100.0),
            k + 1,
            self.pages
        );
        if self.is_upright() {
            page.text(&range, [x, EDGE + 8.5 + 0.5 * CAP], CAP, Align::Start, INK);
        } else {
            page.text(&range, [self.paper[0] - EDGE - 3.0, EDGE + 4.0 + 0.5 * CAP], CAP, Align::End, INK);
        }
    }

    fn legend(&self, content: &SheetContent, page: &mut Page) {
        let top = self.paper[1] - EDGE - TITLE - LEGEND;
        let right = self.paper[0] - EDGE;
        page.line(&[[EDGE, top], [right, top]], 0.25, INK);
        let cap = 0.85 * CAP;
        // Scale bar at the right end.
        let length_m = super::grid::previous_in_series(self.scale * 0.0501);
        let length = self.mm(length_m);
        let boxes = if format!("{length_m:e}").starts_with('2') { 4 } else { 5 };
        let x0 = right - 5.0 - length;
        for i in 0..boxes {
            let step = length / f64::from(boxes);
            let color = if i % 2 == 0 { INK } else { [255; 3] };
            page.area(x0 + f64::from(i) * step, top + 5.0, step, 1.5, color);
        }
        page.frame(x0, top + 5.0, length, 1.5, 0.15, INK);
        page.text("0", [x0, top + 10.0], cap, Align::Middle, INK);
        page.text(&format!("{length_m} m"), [x0 + length, top + 10.0], cap, Align::Middle, INK);
        page.text(&format!("1:{}", self.scale), [x0 + 0.5 * length, top + 3.6], cap, Align::Middle, INK);
        // Lines.
        let mut x = EDGE + 4.0;
        let end = x0 - 6.0;
        let mut shown: Vec<&str> = Vec::new();
        for line in content.lines {
            let name = match line.kind {
                LineKind::Crown => "crown",
                LineKind::SpringlineLeft | LineKind::SpringlineRight => "springline",
                LineKind::FootLeft | LineKind::FootRight => "wall / floor",
            };
            if shown.contains(&name) {
                continue;
            }
            shown.push(name);
            let points = vec![[x, top + 4.0], [x + 9.0, top + 4.0]];
            page.items.push(Item::Line { points, width_mm: 0.3, color: INK, dash: dash_of(line.kind) });
            page.text(name, [x + 10.0, top + 4.8], cap, Align::Start, INK);
            x += 14.0 + text_width_mm(name, cap);
        }
        if !content.traces.is_empty() {
            page.line(&[[x, top + 4.0], [x + 9.0, top + 4.0]], 0.45, FRACTURE);
            page.text("trace with its id", [x + 10.0, top + 4.8], cap, Align::Start, INK);
            x += 14.0 + text_width_mm("trace with its id", cap);
        }
        page.text("white: not scanned", [x, top + 4.8], cap, Align::Start, FAINT);
        // The printed layer.
        let mut x = EDGE + 4.0;
        let y = top + 8.0;
        let name = format!("{}:", content.layer.layer.name());
        page.text(&name, [x, y + 2.4], cap, Align::Start, INK);
        x += text_width_mm(&name, cap) + 2.0;
        let swatches = &content.layer.swatches;
        if swatches.is_empty() {
            page.text(&content.layer.meaning, [x, y + 2.4], cap, Align::Start, FAINT);
        } else if matches!(content.layer.look, super::Look::Labels(_) | super::Look::Coverage) {
            classes(page, swatches, x, y, end, cap);
        } else {
            let (first, last) = (&swatches[0], &swatches[swatches.len() - 1]);
            page.text(&first.label, [x, y + 2.4], cap, Align::Start, INK);
            x += text_width_mm(&first.label, cap) + 1.5;
            for swatch in swatches {
                page.area(x, y, 4.0, 2.8, swatch.color);
                x += 4.0;
            }
            page.frame(x - 4.0 * swatches.len() as f64, y, 4.0 * swatches.len() as f64, 2.8, 0.1, INK);
            page.text(&last.label, [x + 1.5, y + 2.4], cap, Align::Start, INK);
            x += 4.0 + text_width_mm(&last.label, cap);
            if x + text_width_mm(&content.layer.meaning, cap) < end {
                page.text(&content.layer.meaning, [x, y + 2.4], cap, Align::Start, FAINT);
            }
        }
    }

    /// Captions and values in boxes, in two rows.
    fn title(&self, k: usize, title: &[(String, String)], page: &mut Page) {
        let top = self.paper[1] - EDGE - TITLE;
        let (left, right) = (EDGE, self.paper[0] - EDGE);
        page.line(&[[left, top], [right, top]], 0.4, INK);
        let mut entries = title.to_vec();
        entries.push(("scale".into(), format!("1:{}", self.scale)));
        entries.push(("page".into(), format!("{} of {}", k + 1, self.pages)));
        let rows = if right - left < 260.0 { 3 } else { 2 };
        let columns = entries.len().div_ceil(rows);
        let height = TITLE / rows as f64;
        for row in 1..rows {
            page.line(&[[left, top + row as f64 * height], [right, top + row as f64 * height]], 0.15, INK);
        }
        for (row, entries) in entries.chunks(columns).enumerate() {
            // Boxes as wide as their texts ask for.
            let caps = [0.65 * CAP, CAP];
            let wish = |(caption, value): &(String, String)| {
                text_width_mm(caption, caps[0]).max(text_width_mm(value, caps[1])) + 4.0
            };
            let wanted: f64 = entries.iter().map(wish).sum();
            let spare = (right - left) / wanted;
            let y = top + row as f64 * height;
            let mut x = left;
            for entry in entries {
                let width = wish(entry) * spare;
                if x > left {
                    page.line(&[[x, y], [x, y + height]], 0.15, INK);
                }
                page.text(&entry.0, [x + 2.0, y + 2.6], caps[0], Align::Start, FAINT);
                // A long value is written smaller rather than over the next box.
                let cap = caps[1] * ((width - 3.0) / text_width_mm(&entry.1, caps[1]).max(1e-9)).min(1.0);
                page.text(&entry.1, [x + 2.0, y + height - 2.2], cap, Align::Start, INK);
                x += width;
            }
        }
    }
}

fn dash_of(kind: LineKind) -> Vec<f64> {
    match kind {
        LineKind::Crown => vec![4.0, 2.0],
        LineKind::SpringlineLeft | LineKind::SpringlineRight => vec![3.0, 1.2, 0.4, 1.2],
        LineKind::FootLeft | LineKind::FootRight => vec![],
    }
}

/// Boxes of classes with their names, as many as there is room for; the rest is counted.
fn classes(page: &mut Page, swatches: &[Swatch], mut x: f64, y: f64, end: f64, cap: f64) {
    for (i, swatch) in swatches.iter().enumerate() {
        let width = 6.5 + text_width_mm(&swatch.label, cap);
        if x + width > end - 22.0 && i + 1 < swatches.len() {
            let more = format!("and {} more, see legend.json", swatches.len() - i);
            page.text(&more, [x, y + 2.4], cap, Align::Start, FAINT);
            return;
        }
        page.area(x, y, 4.0, 2.8, swatch.color);
        page.frame(x, y, 4.0, 2.8, 0.1, INK);
        page.text(&swatch.label, [x + 5.0, y + 2.4], cap, Align::Start, INK);
        x += width + 1.5;
    }
}

/// A picture whose pixel (x, y) is pixel `from(x, y)` of another.
fn remap(picture: &Picture, width: usize, height: usize, from: impl Fn(usize, usize) -> (usize, usize)) -> Picture {
    let mut rgba = Vec::with_capacity(4 * width * height);
    for y in 0..height {
        for x in 0..width {
            let (fx, fy) = from(x, y);
            let at = 4 * (fy * picture.width + fx);
            rgba.extend_from_slice(&picture.rgba[at..at + 4]);
        }
    }
    Picture { width, height, rgba }
}

#[cfg(test)]
mod tests;
