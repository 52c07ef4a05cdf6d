//! The maps side by side: on the left what a reader sees, squares of chainage and girth; on the right their stretch, in the
//! same colours for all.

use super::Row;
use crate::cut::Strip;
use crate::io::ply;
use crate::map::{Ramp, stroke_font};
use crate::numeric::{Vec2, svd2x2};
use crate::unwrap::{Guide, distortion};
use anyhow::{Context, ensure};
use serde_json::Value;
use std::path::Path;
use tiny_skia::{Color, Paint, Pixmap, Rect, Transform};

/// Width of one map at the common scale, pixels.
const PANEL: f64 = 740.0;
/// Space around the maps, pixels.
const MARGIN: f64 = 24.0;
/// Height of the legend and of the captions above each pair of maps, pixels.
const LEGEND: f64 = 96.0;
const CAPTION: f64 = 56.0;
/// A map gets at most this many times the height of the section chart; what sprawls farther is drawn smaller.
const TALLEST: f64 = 1.5;
/// Upper ends of the classes of stretch; what is beyond the last is the last colour.
const CLASSES: [f64; 7] = [1.005, 1.01, 1.02, 1.05, 1.1, 1.2, 1.5];
/// Flipped faces, in a colour that the ramp does not have.
const FLIPPED: [u8; 3] = [255, 0, 255];
/// Faces without a stretch.
const UNKNOWN: [u8; 3] = [200, 200, 200];
const LIGHT: [u8; 3] = [240, 240, 236];
const DARK: [u8; 3] = [196, 205, 214];
const CROWN: [u8; 3] = [190, 58, 55];
const CHAINAGE: [u8; 3] = [38, 104, 172];
/// Width of the lines on the maps, pixels.
const LINE: f64 = 1.6;

/// One pair of maps.
struct Pair<'a> {
    label: &'a str,
    report: &'a Value,
    uv: Vec<Vec2>,
    low: Vec2,
    high: Vec2,
    /// Pixels for each metre.
    scale: f64,
}

/// Draws all maps that there are, as PNG.
pub(super) fn draw(rows: &[Row], strip: &Strip, guide: Option<&Guide>, folder: &Path) -> anyhow::Result<Vec<u8>> {
    let mesh = strip.mesh();
    let mut pairs = Vec::new();
    for row in rows {
        let Ok(report) = &row.report else { continue };
        let file = row.entry.map(folder);
        let (map, _) = ply::read_chart(&file)?;
        let uv = map.uv.unwrap_or_default();
        ensure!(map.faces == mesh.faces(), "{} is a map of another strip", file.display());
        let (low, high) = extent(&uv);
        pairs.push(Pair { label: &row.entry.label, report, uv, low, high, scale: 1.0 });
    }
    let reference = guide.map(Guide::uv).or(pairs.first().map(|p| p.uv.as_slice())).unwrap_or_default();
    let (low, high) = extent(reference);
    let size = (high - low).map(|d| d.max(1e-9));
    let scale = PANEL / size.x;
    for pair in &mut pairs {
        let own = (pair.high - pair.low).map(|d| d.max(1e-9));
        let fits = scale.min(PANEL / own.x).min(scale * TALLEST * size.y / own.y);
        // A little more length fits into the margin and is no reason for another scale.
        pair.scale = if fits > 0.97 * scale { scale } else { fits };
    }
    let height_of = |p: &Pair| (p.high.y - p.low.y) * p.scale;
    let width = 3.0 * MARGIN + 2.0 * PANEL;
    let height = LEGEND + pairs.iter().map(|p| CAPTION + height_of(p) + MARGIN).sum::<f64>();
    let mut canvas =
        Pixmap::new(width.ceil() as u32, height.ceil() as u32).context("the picture is too large for memory")?;
    canvas.fill(Color::WHITE);

    let square = step_near(size.y / 12.0);
    let smoothing_m = pairs.iter().find_map(|p| p.report.get("smoothing_m")?.as_f64()).unwrap_or(0.0);
    let judged = if smoothing_m > 0.0 { distortion::smoothed_surface(mesh, smoothing_m) } else { mesh.clone() };
    legend(&mut canvas, square, smoothing_m);
    let mut top = LEGEND;
    for pair in &pairs {
        caption(&mut canvas, pair, scale, top);
        top += CAPTION;
        let height = height_of(pair);
        let on_page = |left: f64, p: Vec2| {
            Vec2::new(left + (p.x - pair.low.x) * pair.scale, top + height - (p.y - pair.low.y) * pair.scale)
        };
        for (face, corners) in mesh.faces().iter().enumerate() {
            let in_chart = corners.map(|v| pair.uv[v as usize]);
            let left = in_chart.map(|p| on_page(MARGIN, p));
            match guide {
                Some(guide) => {
                    let known = corners.map(|v| guide.uv()[v as usize]);
                    fill(&mut canvas, left, |w| {
                        squares(known[0] * w[0] + known[1] * w[1] + known[2] * w[2], square, LINE / pair.scale)
                    });
                }
                None => fill(&mut canvas, left, |_| DARK),
            }
            let color = match distortion::jacobian(judged.corners(face as u32), in_chart) {
                Some(jacobian) => {
                    let (s1, s2) = svd2x2::signed_singular_values(&jacobian);
                    if s2 <= 0.0 { FLIPPED } else { class_color(class_of(s1.max(1.0 / s2))) }
                }
                None => UNKNOWN,
            };
            fill(&mut canvas, in_chart.map(|p| on_page(2.0 * MARGIN + PANEL, p)), |_| color);
        }
        top += height + MARGIN;
    }
    canvas.encode_png().context("cannot encode the picture")
}

fn extent(uv: &[Vec2]) -> (Vec2, Vec2) {
    uv.iter().fold((Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY)), |(l, h), p| (l.inf(p), h.sup(p)))
}

/// The number of the series 1, 2, 5, 10 ... next below.
fn step_near(length: f64) -> f64 {
    let decade = 10f64.powf(length.log10().floor());
    [5.0, 2.0, 1.0].into_iter().map(|k| k * decade).find(|&s| s <= length).unwrap_or(decade)
}

/// The colour of a place of the tunnel: squares, the crown line, and a line every fifth square along the chainage.
fn squares(place: Vec2, square: f64, line: f64) -> [u8; 3] {
    let long = 5.0 * square;
    if place.y.abs() < line {
        CROWN
    } else if (place.x - (place.x / long).round() * long).abs() < line {
        CHAINAGE
    } else if ((place.x / square).floor() + (place.y / square).floor()).rem_euclid(2.0) < 0.5 {
        LIGHT
    } else {
        DARK
    }
}

fn class_of(stretch: f64) -> usize {
    CLASSES.partition_point(|&end| end < stretch)
}

fn class_color(class: usize) -> [u8; 3] {
    Ramp::Heat.color(class as f64 / CLASSES.len() as f64)
}

/// Fills a triangle; `color` gets the barycentric weights of a pixel's centre.
fn fill(canvas: &mut Pixmap, [a, b, c]: [Vec2; 3], color: impl Fn([f64; 3]) -> [u8; 3]) {
    let (width, height) = (canvas.width() as usize, canvas.height() as usize);
    let double_area = (b - a).perp(&(c - a));
    if double_area == 0.0 || !double_area.is_finite() {
        return;
    }
    let first = |x: f64| (x - 0.5).ceil().max(0.0) as usize;
    let end = |x: f64, n: usize| ((x - 0.5).floor() + 1.0).clamp(0.0, n as f64) as usize;
    let (low, high) = (a.inf(&b).inf(&c), a.sup(&b).sup(&c));
    for y in first(low.y)..end(high.y, height) {
        for x in first(low.x)..end(high.x, width) {
            let p = Vec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let weights =
                [(b - p).perp(&(c - p)), (c - p).perp(&(a - p)), (a - p).perp(&(b - p))].map(|w| w / double_area);
            // Pixels on a shared edge belong to both faces: no gaps.
            if weights.iter().all(|w| *w >= -1e-9) {
                let [red, green, blue] = color(weights);
                let at = 4 * (y * width + x);
                canvas.data_mut()[at..at + 4].copy_from_slice(&[red, green, blue, 255]);
            }
        }
    }
}

fn text(canvas: &mut Pixmap, words: &str, cap_px: f64, x: f64, y: f64) {
    let style =
        stroke_font::TextStyle { cap_px, align: stroke_font::Align::Start, color: [34, 38, 44, 255], upwards: false };
    stroke_font::draw_text(&mut canvas.as_mut(), words, Vec2::new(x, y), &style);
}

fn legend(canvas: &mut Pixmap, square: f64, smoothing_m: f64) {
    let right = 2.0 * MARGIN + PANEL;
    text(canvas, &format!("map: squares of {square} m, seen from inside"), 15.0, MARGIN, 34.0);
    text(canvas, &format!("red: crown, blue: each {} m of chainage", 5.0 * square), 12.0, MARGIN, 66.0);
    let against =
        if smoothing_m > 0.0 { format!(" (surface smoothed over {smoothing_m:.2} m)") } else { String::new() };
    text(canvas, &format!("stretch{against}"), 15.0, right, 34.0);
    let step = PANEL / (CLASSES.len() + 2) as f64;
    for k in 0..=CLASSES.len() + 1 {
        let (color, label) = match k {
            k if k < CLASSES.len() => (class_color(k), format!("to {}", CLASSES[k])),
            k if k == CLASSES.len() => (class_color(k), "more".to_owned()),
            _ => (FLIPPED, "flipped".to_owned()),
        };
        let x = right + k as f64 * step;
        let mut paint = Paint::default();
        paint.set_color_rgba8(color[0], color[1], color[2], 255);
        if let Some(rect) = Rect::from_xywh(x as f32, 46.0, step as f32 - 4.0, 16.0) {
            canvas.fill_rect(rect, &paint, Transform::identity(), None);
        }
        text(canvas, &label, 11.0, x, 82.0);
    }
}

fn caption(canvas: &mut Pixmap, pair: &Pair, scale: f64, top: f64) {
    let figure = |place: &str| pair.report.pointer(place).and_then(Value::as_f64);
    let smaller = if pair.scale < 0.999 * scale {
        format!("   (drawn at {:.2} of the scale)", pair.scale / scale)
    } else {
        String::new()
    };
    text(canvas, &format!("{}{smaller}", pair.label), 18.0, MARGIN, top + 24.0);
    let mut readable = String::new();
    if let (Some(chainage), Some(bearing)) =
        (figure("/readability/chainage_rms_m"), figure("/readability/bearing_rms_deg"))
    {
        readable = format!("chainage error rms {chainage:.2} m   bearing error rms {bearing:.1} deg");
    }
    text(canvas, &readable, 11.0, MARGIN, top + 46.0);
    let told = |place: &str| figure(place).unwrap_or(f64::NAN);
    let stretch = format!(
        "stretch mean {:.4}   95 % {:.4}   max {:.2}   flipped {:.0}   overlaps {:.0}",
        told("/stretch/mean"),
        told("/stretch/p95"),
        told("/stretch/max"),
        told("/flipped_faces"),
        told("/overlaps"),
    );
    text(canvas, &stretch, 11.0, 2.0 * MARGIN + PANEL, top + 46.0);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_and_steps() {
        assert_eq!([1.0, 1.005, 1.0051, 1.5, 1.6].map(class_of), [0, 0, 1, 6, 7]);
        assert_eq!([2.08, 1.99, 0.6, 5.0].map(step_near), [2.0, 1.0, 0.5, 5.0]);
    }

    #[test]
    fn two_triangles_fill_a_square_without_gaps() {
        let mut canvas = Pixmap::new(10, 10).unwrap();
        let p = |x: f64, y: f64| Vec2::new(x, y);
        let (a, b, c, d) = (p(1.5, 1.5), p(8.5, 1.5), p(8.5, 8.5), p(1.5, 8.5));
        fill(&mut canvas, [a, b, c], |_| CROWN);
        fill(&mut canvas, [a, d, c], |w| if w[0] >= 0.0 { CHAINAGE } else { LIGHT });
        let filled = canvas.pixels().iter().filter(|p| p.alpha() == 255).count();
        assert_eq!(filled, 64);
    }
}
