//! The stereonet: poles of planes in equal-area projection of the lower hemisphere, with contours of their density.
//!
//! A pole with trend t and plunge p lies at the distance sqrt(2) sin((90 - p) / 2) from the centre (the rim is 1), north up.
//! Density: exponential smoothing of the counts with k = 2 (1 + n / 9) (F. W. Vollmer, "C program for automatic contouring
//! of spherical orientation data using a modified Kamb method", 1995, doi:10.1016/0098-3004(94)00058-3), told in standard
//! deviations above what an even spread would give; contours at 2, 4, 6 ... of them by marching squares on a fine grid.
//! Great circles show the means of the sets. The net is drawn once as a list of lines, dots and words, which is written as
//! SVG or painted as a picture; both show the same.

use super::Set;
use crate::map::{Picture, stroke_font};
use crate::numeric::{Vec2, Vec3, any_perpendicular};
use std::fmt::Write;
use tiny_skia::{PathBuilder, Pixmap};

/// A plane on the net.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereonetPole {
    /// Normal, either side.
    pub normal: Vec3,
    /// Its set.
    pub set: Option<u32>,
    /// Whether its orientation was accepted: full dots, others are rings.
    pub accepted: bool,
}

/// What the net shows.
#[derive(Clone, Debug, Default)]
pub struct Stereonet {
    /// Poles; contours count the accepted ones.
    pub poles: Vec<StereonetPole>,
    /// Sets; their means are great circles.
    pub sets: Vec<Set>,
    /// Direction of the tunnel: poles near the great circle across it are of planes along the tunnel, the blind zone.
    pub axis: Option<Vec3>,
    /// Half the width of the blind zone, degrees.
    pub blind_deg: f64,
    /// Title.
    pub title: String,
}

/// Radius of the net and size of the drawing, in drawing units.
const RADIUS: f64 = 260.0;
const SIZE: (f64, f64) = (820.0, 660.0);
const CENTRE: (f64, f64) = (310.0, 340.0);
/// Cells of the contour grid along the diameter.
const GRID: usize = 120;
/// Contours, standard deviations.
const LEVELS: [f64; 6] = [2.0, 4.0, 6.0, 8.0, 12.0, 16.0];
/// Colours of the sets, in turn: told apart by people who do not see red and green apart.
const COLORS: [[u8; 3]; 8] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [204, 121, 167],
    [86, 180, 233],
    [230, 159, 0],
    [120, 94, 240],
    [110, 110, 0],
];
const NO_SET: [u8; 3] = [110, 110, 110];
const INK: [u8; 3] = [40, 40, 40];

enum Mark {
    Line { points: Vec<Vec2>, color: [u8; 3], width: f64 },
    Dot { at: Vec2, radius: f64, color: [u8; 3], full: bool },
    Word { at: Vec2, text: String, size: f64, middle: bool },
}

/// Place of a direction on the net (the rim is 1), its lower end.
pub(super) fn project(direction: &Vec3) -> Vec2 {
    let d = if direction.z > 0.0 { -direction } else { *direction }.normalize();
    // sin((90 - plunge) / 2) over the horizontal length, without dividing by zero at the centre.
    let scale = (1.0 / (1.0 - d.z)).sqrt();
    Vec2::new(d.x * scale, d.y * scale)
}

/// The downward direction at a place on the net.
fn direction_at(p: Vec2) -> Vec3 {
    let r2 = p.norm_squared().min(1.0);
    let scale = (2.0 - r2).sqrt();
    Vec3::new(p.x * scale, p.y * scale, r2 - 1.0)
}

fn set_color(set: Option<u32>) -> [u8; 3] {
    set.map_or(NO_SET, |s| COLORS[(s as usize + COLORS.len() - 1) % COLORS.len()])
}

impl Stereonet {
    /// The net as SVG.
    pub fn svg(&self) -> String {
        let (w, h) = SIZE;
        let mut text = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w}\" height=\"{h}\" viewBox=\"0 0 {w} {h}\" \
             font-family=\"sans-serif\">\n<rect width=\"{w}\" height=\"{h}\" fill=\"white\"/>\n"
        );
        let hex = |[r, g, b]: [u8; 3]| format!("#{r:02x}{g:02x}{b:02x}");
        for mark in self.marks() {
            let _ = match mark {
                Mark::Line { points, color, width } => {
                    let places: Vec<String> = points.iter().map(|p| format!("{:.2},{:.2}", p.x, p.y)).collect();
                    writeln!(
                        text,
                        "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{width}\"/>",
                        places.join(" "),
                        hex(color)
                    )
                }
                Mark::Dot { at, radius, color, full } => {
                    let fill = if full { hex(color) } else { "white".to_owned() };
                    writeln!(
                        text,
                        "<circle cx=\"{:.2}\" cy=\"{:.2}\" r=\"{radius}\" fill=\"{fill}\" stroke=\"{}\" stroke-width=\"1.4\"/>",
                        at.x,
                        at.y,
                        hex(color)
                    )
                }
                Mark::Word { at, text: word, size, middle } => {
                    let escaped = word.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
                    let anchor = if middle { "middle" } else { "start" };
                    writeln!(
                        text,
                        "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{size}\" text-anchor=\"{anchor}\" fill=\"{}\">{escaped}</text>",
                        at.x,
                        at.y,
                        hex(INK)
                    )
                }
            };
        }
        text + "</svg>\n"
    }

    /// The net as a picture, `scale` pixels to a unit of the SVG.
    pub fn picture(&self, scale: f64) -> Picture {
        let (width, height) = ((SIZE.0 * scale).round() as u32, (SIZE.1 * scale).round() as u32);
        let mut canvas = Pixmap::new(width.max(1), height.max(1)).expect("not empty");
        canvas.fill(tiny_skia::Color::WHITE);
        let opaque = |[r, g, b]: [u8; 3]| [r, g, b, 255];
        for mark in self.marks() {
            match mark {
                Mark::Line { points, color, width } => {
                    let mut path = PathBuilder::new();
                    for (i, p) in points.iter().enumerate() {
                        let (x, y) = ((p.x * scale) as f32, (p.y * scale) as f32);
                        if i == 0 { path.move_to(x, y) } else { path.line_to(x, y) }
                    }
                    if let Some(path) = path.finish() {
                        stroke_font::stroke_path(&mut canvas.as_mut(), &path, width * scale, opaque(color));
                    }
                }
                Mark::Dot { at, radius, color, full } => {
                    let circle =
                        PathBuilder::from_circle((at.x * scale) as f32, (at.y * scale) as f32, (radius * scale) as f32);
                    let Some(path) = circle else { continue };
                    let fill = if full { opaque(color) } else { [255; 4] };
                    let (paint, rule) = (stroke_font::paint(fill), tiny_skia::FillRule::Winding);
                    canvas.fill_path(&path, &paint, rule, tiny_skia::Transform::identity(), None);
                    stroke_font::stroke_path(&mut canvas.as_mut(), &path, 1.4 * scale, opaque(color));
                }
                Mark::Word { at, text, size, middle } => {
                    let style = stroke_font::TextStyle {
                        cap_px: size * 0.7 * scale,
                        align: if middle { stroke_font::Align::Middle } else { stroke_font::Align::Start },
                        color: opaque(INK),
                        upwards: false,
                    };
                    stroke_font::draw_text(&mut canvas.as_mut(), &text, at * scale, &style);
                }
            }
        }
        Picture { width: width as usize, height: height as usize, rgba: canvas.take_demultiplied() }
    }

    fn marks(&self) -> Vec<Mark> {
        let mut marks = Vec::new();
        let on = |p: Vec2| Vec2::new(CENTRE.0 + RADIUS * p.x, CENTRE.1 - RADIUS * p.y);
        let word = |x: f64, y: f64, text: String, size: f64, middle: bool| Mark::Word {
            at: Vec2::new(x, y),
            text,
            size,
            middle,
        };
        for (level, line) in self.contours() {
            let shade = 1.0 - 0.75 * (level as f64 + 1.0) / LEVELS.len() as f64;
            let grey = (90.0 + 140.0 * shade) as u8;
            marks.push(Mark::Line { points: line.into_iter().map(on).collect(), color: [grey, grey, 255], width: 1.6 });
        }
        if let Some(axis) = self.axis.filter(|_| self.blind_deg > 0.0) {
            // Poles of planes at `blind_deg` to the axis lie on a small circle around the axis.
            for line in small_circle(&axis, 90.0 - self.blind_deg) {
                marks.push(Mark::Line {
                    points: line.into_iter().map(on).collect(),
                    color: [200, 160, 160],
                    width: 1.0,
                });
            }
        }
        let rim = (0..=180).map(|i| (f64::from(i) * 2.0).to_radians().sin_cos()).map(|(s, c)| on(Vec2::new(s, c)));
        marks.push(Mark::Line { points: rim.collect(), color: INK, width: 1.5 });
        for i in 0..36 {
            let (s, c) = (f64::from(i) * 10.0).to_radians().sin_cos();
            let length = if i % 9 == 0 { 0.04 } else { 0.02 };
            let (a, b) = (Vec2::new(s, c), Vec2::new(s, c) * (1.0 + length));
            marks.push(Mark::Line { points: vec![on(a), on(b)], color: INK, width: 1.2 });
        }
        let cross = 0.02;
        for d in [Vec2::x(), Vec2::y()] {
            marks.push(Mark::Line { points: vec![on(d * -cross), on(d * cross)], color: INK, width: 1.0 });
        }
        for set in &self.sets {
            for line in small_circle(&set.normal, 90.0) {
                let color = set_color(Some(set.number));
                marks.push(Mark::Line { points: line.into_iter().map(on).collect(), color, width: 1.6 });
            }
        }
        for pole in &self.poles {
            let at = on(project(&pole.normal));
            marks.push(Mark::Dot { at, radius: 4.0, color: set_color(pole.set), full: pole.accepted });
        }
        marks.push(word(CENTRE.0, CENTRE.1 - RADIUS - 20.0, "N".into(), 18.0, true));
        marks.push(word(CENTRE.0, 30.0, self.title.clone(), 18.0, true));
        let accepted = self.poles.iter().filter(|p| p.accepted).count();
        let left = CENTRE.0 + RADIUS + 40.0;
        let mut lines: Vec<(String, Option<u32>)> = vec![
            ("Equal area, lower hemisphere".into(), None),
            (format!("{accepted} poles accepted"), None),
            (format!("{} unreliable (rings)", self.poles.len() - accepted), None),
            ("Contours 2 4 6 8 12 16 sigma".into(), None),
        ];
        if self.axis.is_some() && self.blind_deg > 0.0 {
            lines.push((format!("Red: {:.0} deg to the axis", self.blind_deg), None));
        }
        lines.extend(self.sets.iter().map(|set| {
            let (dip, direction) = (set.dip_deg, set.dip_direction_deg);
            (format!("Set {}: {dip:02.0}/{direction:03.0}, {} planes", set.number, set.planes), Some(set.number))
        }));
        for (row, (text, set)) in lines.into_iter().enumerate() {
            let y = 90.0 + 22.0 * row as f64;
            marks.push(word(left, y, text, 14.0, false));
            if set.is_some() {
                let at = Vec2::new(left - 12.0, y - 5.0);
                marks.push(Mark::Dot { at, radius: 4.0, color: set_color(set), full: true });
            }
        }
        marks
    }

    /// Contour lines of the density of accepted poles, with the number of their level.
    fn contours(&self) -> Vec<(usize, Vec<Vec2>)> {
        let poles: Vec<Vec3> = self.poles.iter().filter(|p| p.accepted).map(|p| p.normal.normalize()).collect();
        if poles.len() < 4 {
            return Vec::new();
        }
        let n = poles.len() as f64;
        let k = 2.0 * (1.0 + n / 9.0);
        // Counts with the weight exp(k (|cos| - 1)): mean and deviation of an even spread.
        let mean = n * (1.0 - (-k).exp()) / k;
        let deviation = (n * ((1.0 - (-2.0 * k).exp()) / (2.0 * k) - (mean / n).powi(2))).max(1e-12).sqrt();
        let value = |p: Vec2| {
            let d = direction_at(p);
            (poles.iter().map(|q| (k * (q.dot(&d).abs() - 1.0)).exp()).sum::<f64>() - mean) / deviation
        };
        let place = |i: usize| 2.0 * i as f64 / GRID as f64 - 1.0;
        // Beyond the rim the net goes on at the opposite side; the contours are cut there.
        let field: Vec<f64> = (0..(GRID + 1) * (GRID + 1))
            .map(|i| {
                let p = Vec2::new(place(i % (GRID + 1)), place(i / (GRID + 1)));
                if p.norm() > 1.03 { f64::NAN } else { value(p / p.norm().max(1.0)) }
            })
            .collect();
        let mut lines = Vec::new();
        for (number, &level) in LEVELS.iter().enumerate() {
            for j in 0..GRID {
                for i in 0..GRID {
                    let corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)];
                    let values = corners.map(|(a, b)| field[b * (GRID + 1) + a]);
                    if values.iter().any(|v| v.is_nan()) {
                        continue;
                    }
                    let cut: Vec<Vec2> = (0..4)
                        .filter_map(|e| {
                            let (a, b) = (values[e], values[(e + 1) % 4]);
                            if (a >= level) == (b >= level) {
                                return None;
                            }
                            let t = (level - a) / (b - a);
                            let at = |c: (usize, usize)| Vec2::new(place(c.0), place(c.1));
                            let (p, q) = (at(corners[e]), at(corners[(e + 1) % 4]));
                            Some(p + (q - p) * t)
                        })
                        .collect();
                    for pair in cut.chunks_exact(2).filter(|c| c.iter().all(|p| p.norm() <= 1.0)) {
                        lines.push((number, pair.to_vec()));
                    }
                }
            }
        }
        lines
    }
}

/// The circle of directions at an angle around an axis on the lower hemisphere, cut at the rim; 90 degrees: a great circle.
fn small_circle(axis: &Vec3, angle_deg: f64) -> Vec<Vec<Vec2>> {
    let axis = axis.normalize();
    let e = any_perpendicular(&axis);
    let f = axis.cross(&e);
    let (s, c) = angle_deg.to_radians().sin_cos();
    let mut lines: Vec<Vec<Vec2>> = vec![Vec::new()];
    for i in 0..=720 {
        let (sa, ca) = (f64::from(i) * 0.5).to_radians().sin_cos();
        let d = axis * c + (e * ca + f * sa) * s;
        // Both ends of the axis have their circle; the upper half of one is the lower half of the other.
        let p = project(&d);
        let jump = lines.last().and_then(|l| l.last()).is_some_and(|before: &Vec2| (before - p).norm() > 0.3);
        if jump {
            lines.push(Vec::new());
        }
        lines.last_mut().expect("never empty").push(p);
    }
    lines.retain(|l| l.len() > 1);
    lines
}

#[cfg(test)]
mod tests {
    use super::super::normal_of;
    use super::*;

    #[test]
    fn poles_lie_where_the_convention_puts_them() {
        // Horizontal plane: centre. Vertical plane dipping east: pole on the rim. Dip 40 to the east: pole to the west.
        assert!(project(&normal_of(0.0, 0.0)).norm() < 1e-12);
        assert!((project(&normal_of(90.0, 90.0)).norm() - 1.0).abs() < 1e-12);
        let p = project(&normal_of(40.0, 90.0));
        assert!((p - Vec2::new(-std::f64::consts::SQRT_2 * 20f64.to_radians().sin(), 0.0)).norm() < 1e-12, "{p}");
        assert!((direction_at(p) + normal_of(40.0, 90.0)).norm() < 1e-12);
        assert_eq!(project(&-normal_of(40.0, 90.0)), p);
    }

    #[test]
    fn both_forms_show_poles_and_contours() {
        let poles: Vec<StereonetPole> = (0..20)
            .map(|i| StereonetPole {
                normal: normal_of(60.0 + f64::from(i % 5), 100.0 + f64::from(i / 5) * 2.0),
                set: Some(1),
                accepted: i != 3,
            })
            .collect();
        let net =
            Stereonet { poles, axis: Some(Vec3::x()), blind_deg: 20.0, title: "a < b".into(), ..Stereonet::default() };
        let svg = net.svg();
        assert_eq!(svg.matches("<circle").count(), 20);
        assert!(svg.contains("a &lt; b") && svg.matches("<polyline").count() > 60, "{}", svg.len());
        let picture = net.picture(1.0);
        assert_eq!((picture.width, picture.height), (820, 660));
        // The cluster lies in the west-north-west and is coloured there.
        let at = project(&normal_of(62.0, 103.0));
        let (x, y) = (CENTRE.0 + RADIUS * at.x, CENTRE.1 - RADIUS * at.y);
        let blue = (0..400)
            .map(|i| ((x as usize + i % 20 - 10), (y as usize + i / 20 - 10)))
            .filter(|(x, y)| picture.rgba[4 * (y * picture.width + x)] < 60)
            .count();
        assert!(blue > 20, "{blue}");
    }
}
