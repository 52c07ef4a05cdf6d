//! Plots of the report's page as SVG: drawn for the width of a phone, so that their text stays readable there.

use super::limits::number;
use std::fmt::Write;

/// Units of a plot; one unit is about a pixel on a phone.
const WIDTH: f64 = 360.0;
const HEIGHT: f64 = 190.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 40.0;

/// A frame with numbered axes into which data is drawn.
pub(super) struct Plot {
    svg: String,
    x: (f64, f64),
    y: (f64, f64),
}

impl Plot {
    /// A plot of these ranges; equal ends are spread a little.
    pub(super) fn new(x: (f64, f64), y: (f64, f64), x_label: &str, y_label: &str) -> Self {
        let spread = |(a, b): (f64, f64)| if b - a > 1e-12 { (a, b) } else { (a - 0.5, b + 0.5) };
        let mut plot = Self { svg: String::new(), x: spread(x), y: spread(y) };
        let _ = write!(
            plot.svg,
            "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{0}\" font-family=\"sans-serif\" font-size=\"11\">\
             <rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"#fff\"/>",
            super::page::escape(if y_label.is_empty() { x_label } else { y_label })
        );
        for tick in ticks(plot.x, 6) {
            let x = plot.px(tick);
            let _ = write!(
                plot.svg,
                "<path d=\"M{x:.1} {TOP}V{1:.1}\" stroke=\"#0001\"/><text x=\"{x:.1}\" y=\"{2:.1}\" text-anchor=\"middle\">{0}</text>",
                label(tick),
                HEIGHT - BOTTOM,
                HEIGHT - BOTTOM + 13.0
            );
        }
        for tick in ticks(plot.y, 5) {
            let y = plot.py(tick);
            let _ = write!(
                plot.svg,
                "<path d=\"M{LEFT} {y:.1}H{1:.1}\" stroke=\"#0002\"/><text x=\"{2:.1}\" y=\"{3:.1}\" text-anchor=\"end\">{0}</text>",
                label(tick),
                WIDTH - RIGHT,
                LEFT - 4.0,
                y + 4.0
            );
        }
        let _ = write!(
            plot.svg,
            "<text x=\"{0:.1}\" y=\"{1:.1}\" text-anchor=\"middle\">{x_label}</text>",
            (LEFT + WIDTH - RIGHT) / 2.0,
            HEIGHT - 8.0
        );
        plot
    }

    fn px(&self, x: f64) -> f64 {
        LEFT + (x - self.x.0) / (self.x.1 - self.x.0) * (WIDTH - LEFT - RIGHT)
    }

    fn py(&self, y: f64) -> f64 {
        HEIGHT - BOTTOM - (y - self.y.0) / (self.y.1 - self.y.0) * (HEIGHT - TOP - BOTTOM)
    }

    /// A line through points; a point without a value interrupts it.
    pub(super) fn line(&mut self, points: &[(f64, Option<f64>)], color: &str) {
        let mut path = String::new();
        let mut pen_down = false;
        for (x, y) in points {
            if let Some(y) = y.filter(|y| y.is_finite()) {
                let _ = write!(path, "{}{:.1} {:.1}", if pen_down { 'L' } else { 'M' }, self.px(*x), self.py(y));
                pen_down = true;
            } else {
                pen_down = false;
            }
        }
        let _ = write!(self.svg, "<path d=\"{path}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.8\"/>");
    }

    /// A dashed level, if it lies in the range.
    pub(super) fn level(&mut self, y: f64, color: &str) {
        if y >= self.y.0 && y <= self.y.1 {
            let _ = write!(
                self.svg,
                "<path d=\"M{LEFT} {0:.1}H{1:.1}\" stroke=\"{color}\" stroke-dasharray=\"5 3\"/>",
                self.py(y),
                WIDTH - RIGHT
            );
        }
    }

    /// Bars that touch each other.
    pub(super) fn bars(&mut self, from: f64, width: f64, heights: &[f64], color: &str) {
        for (i, height) in heights.iter().enumerate() {
            let (x0, x1) = (self.px(from + i as f64 * width), self.px(from + (i + 1) as f64 * width));
            let _ = write!(
                self.svg,
                "<rect x=\"{x0:.1}\" y=\"{0:.1}\" width=\"{1:.1}\" height=\"{2:.1}\" fill=\"{color}\"/>",
                self.py(*height),
                (x1 - x0 - 0.4).max(0.4),
                self.py(0.0) - self.py(*height)
            );
        }
    }

    /// A mark with a text.
    pub(super) fn mark(&mut self, x: f64, y: f64, color: &str) {
        let _ =
            write!(self.svg, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3\" fill=\"{color}\"/>", self.px(x), self.py(y));
    }

    /// The finished picture.
    pub(super) fn svg(mut self) -> String {
        self.svg.push_str("</svg>");
        self.svg
    }
}

/// The line through `points` at the same scale in both directions, with a scale bar: a plan.
pub(super) fn plan(points: &[(f64, f64)], start: &str, end: &str) -> String {
    let fold = |f: &dyn Fn(&(f64, f64)) -> f64| {
        points.iter().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(f(p)), h.max(f(p))))
    };
    let ((x0, x1), (y0, y1)) = (fold(&|p| p.0), fold(&|p| p.1));
    let scale = ((WIDTH - 60.0) / (x1 - x0).max(1e-3)).min((HEIGHT - 50.0) / (y1 - y0).max(1e-3));
    let x = |v: f64| (WIDTH - (x1 - x0) * scale) / 2.0 + (v - x0) * scale;
    let y = |v: f64| 20.0 + (HEIGHT - 50.0 + (y1 - y0) * scale) / 2.0 - (v - y0) * scale;
    let mut path = String::new();
    for (i, p) in points.iter().enumerate() {
        let _ = write!(path, "{}{:.1} {:.1}", if i == 0 { 'M' } else { 'L' }, x(p.0), y(p.1));
    }
    let bar = ticks((0.0, (x1 - x0).max(y1 - y0) / 2.0), 2).last().copied().unwrap_or(1.0).max(1e-3);
    let (first, last) = (points[0], points[points.len() - 1]);
    let text = |p: (f64, f64), t: &str| {
        let (px, py) = (x(p.0), y(p.1));
        let anchor = if px > WIDTH / 2.0 { "end" } else { "start" };
        format!(
            "<circle cx=\"{px:.1}\" cy=\"{py:.1}\" r=\"3\" fill=\"#b3261e\"/><text x=\"{px:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\">{t}</text>",
            py - 7.0
        )
    };
    format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"plan\" font-family=\"sans-serif\" font-size=\"11\">\
         <rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"#fff\"/><path d=\"{path}\" fill=\"none\" stroke=\"#1a5fb4\" stroke-width=\"2\"/>{}{}\
         <path d=\"M14 {3:.1}v4h{2:.1}v-4\" fill=\"none\" stroke=\"#000\"/><text x=\"14\" y=\"{4:.1}\">{5} m</text>\
         <path d=\"M345 32V10m-4 7l4 -8l4 8\" fill=\"none\" stroke=\"#000\"/><text x=\"345\" y=\"44\" text-anchor=\"middle\">N</text></svg>",
        text(first, start),
        text(last, end),
        bar * scale,
        HEIGHT - 12.0,
        HEIGHT - 16.0,
        number(bar)
    )
}

/// A section: closed mean outline, and the surface itself where it has no hole. Radii from the invert over the left wall.
pub(super) fn section(mean: &[f64], surface: &[Option<f64>], most: f64) -> String {
    let place = |i: usize, n: usize, r: f64| {
        let angle = std::f64::consts::TAU * i as f64 / n as f64 - std::f64::consts::PI;
        (100.0 + 90.0 * r / most * angle.sin(), 100.0 - 90.0 * r / most * angle.cos())
    };
    let mut svg = String::from(
        "<svg viewBox=\"0 0 200 200\" role=\"img\" aria-label=\"section\"><rect width=\"200\" height=\"200\" fill=\"#fff\"/><polygon points=\"",
    );
    for (i, r) in mean.iter().enumerate() {
        let (x, y) = place(i, mean.len(), *r);
        let _ = write!(svg, "{x:.1},{y:.1} ");
    }
    svg.push_str("\" fill=\"none\" stroke=\"#0007\" stroke-width=\"1\" stroke-dasharray=\"4 2\"/><path d=\"");
    let mut pen_down = false;
    // Around once more to the first point, so that the outline closes at the invert.
    for i in 0..=surface.len() {
        match surface.get(i % surface.len().max(1)).copied().flatten() {
            Some(r) => {
                let (x, y) = place(i, surface.len(), r);
                let _ = write!(svg, "{}{x:.1} {y:.1}", if pen_down { 'L' } else { 'M' });
                pen_down = true;
            }
            None => pen_down = false,
        }
    }
    svg.push_str(
        "\" fill=\"none\" stroke=\"#1a5fb4\" stroke-width=\"1.6\"/><circle cx=\"100\" cy=\"100\" r=\"2\" fill=\"#b3261e\"/></svg>",
    );
    svg
}

/// Round numbers inside a range, about `count` of them.
fn ticks((low, high): (f64, f64), count: usize) -> Vec<f64> {
    let raw = (high - low) / count as f64;
    if !(raw > 0.0 && raw.is_finite()) {
        return Vec::new();
    }
    let power = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|d| d * power).find(|s| *s >= raw * 0.999).unwrap_or(10.0 * power);
    let first = (low / step - 1e-9).ceil() as i64;
    let last = (high / step + 1e-9).floor() as i64;
    (first..=last).map(|i| i as f64 * step).collect()
}

/// A tick without the noise of its multiplication.
fn label(value: f64) -> String {
    let rounded = (value * 1e9).round() / 1e9;
    if rounded == 0.0 { "0".to_owned() } else { number(rounded) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks((0.0, 21.7), 6), [0.0, 5.0, 10.0, 15.0, 20.0]);
        let fine: Vec<String> = ticks((0.93, 1.01), 4).into_iter().map(label).collect();
        assert_eq!(fine, ["0.94", "0.96", "0.98", "1"]);
        assert!(ticks((3.0, 3.0), 4).is_empty());
    }

    #[test]
    fn a_missing_value_interrupts_the_line() {
        let mut plot = Plot::new((0.0, 3.0), (0.0, 1.0), "x", "y");
        plot.line(&[(0.0, Some(0.5)), (1.0, Some(1.0)), (2.0, None), (3.0, Some(0.0))], "#000");
        let svg = plot.svg();
        let path = svg.rsplit("<path d=\"").next().unwrap();
        assert_eq!((path.matches('M').count(), path.matches('L').count()), (2, 1), "{path}");
        assert!(svg.ends_with("</svg>") && svg.contains("stroke=\"#000\""));
    }
}
