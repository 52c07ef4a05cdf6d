//! The lines by which people find their way on a map: crown, springlines, feet of the walls.
//!
//! The mean section tells at which angle around the axis each line lies; on the chart a line is where that angle is
//! reached: the crossings with the edges of the faces, one median for every [`BIN_M`] of chainage.
//!
//! The springline is where the wall turns into the roof: the section stops growing wider there. Near that place the
//! missing width grows with the square of the girth (circle and arch over vertical walls alike), so the place follows
//! from two girths: `g0 = 2 g(1 %) - g(4 %)`, where `g(p)` is the girth at which the half-width is `p` below its maximum.
//!
//! When to use: every map of a tunnel; shafts have neither crown nor springlines. Cost: O(faces).

use crate::axis::AxisCoordinates;
use crate::numeric::{Vec2, statistics};
use crate::segment::SectionField;
use crate::unwrap::Chart;
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Length of chainage that gives one vertex of a line, metres.
const BIN_M: f64 = 0.25;
/// A line is interrupted where it is missing over more than this many bins.
const BRIDGED_BINS: usize = 8;
/// Distance between the sections whose lines are looked for, metres.
const STEP_M: f64 = 1.0;
/// Sections on both sides whose median radii make the section that a springline is looked for in: rough rock has its
/// widest place anywhere, the drive it was blasted for does not.
const MEDIAN_REACH: usize = 12;
/// Missing half-widths from which the springline follows, as shares of the greatest.
const MISSING: [f64; 2] = [0.01, 0.04];
/// Angles at which the half-width is looked at.
const ANGLES: usize = 720;

/// Which line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LineKind {
    /// The highest line of the roof.
    Crown,
    /// Where the left wall turns into the roof.
    SpringlineLeft,
    /// Where the right wall turns into the roof.
    SpringlineRight,
    /// Where the left wall meets the floor.
    FootLeft,
    /// Where the right wall meets the floor.
    FootRight,
}

impl LineKind {
    /// The word in the margin.
    pub fn label(self) -> &'static str {
        match self {
            LineKind::Crown => "CROWN",
            LineKind::SpringlineLeft | LineKind::SpringlineRight => "spring",
            LineKind::FootLeft | LineKind::FootRight => "floor",
        }
    }
}

/// A line on the map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReferenceLine {
    /// Which.
    pub kind: LineKind,
    /// Its pieces: chainage and girth of each vertex, metres.
    pub pieces: Vec<Vec<[f64; 2]>>,
}

/// Angles of the feet of the walls along the tunnel: chainage, left angle, right angle.
pub type Feet = [f64; 3];

/// Finds the lines on a chart, given the axis coordinates of its vertices. `feet` may be empty: no floor.
pub fn reference_lines(
    chart: &Chart,
    coordinates: &[AxisCoordinates],
    section: &SectionField,
    feet: &[Feet],
) -> Vec<ReferenceLine> {
    let springs = springlines(section);
    let mut wanted: Vec<(LineKind, Vec<(f64, f64)>)> = vec![(LineKind::Crown, vec![(section.start(), 0.0)])];
    let side = |table: &[Feet], k: usize| table.iter().map(|f| (f[0], f[k])).collect::<Vec<_>>();
    wanted.push((LineKind::SpringlineLeft, side(&springs, 1)));
    wanted.push((LineKind::SpringlineRight, side(&springs, 2)));
    if !feet.is_empty() {
        wanted.push((LineKind::FootLeft, side(feet, 1)));
        wanted.push((LineKind::FootRight, side(feet, 2)));
    }
    wanted
        .into_iter()
        .map(|(kind, table)| ReferenceLine { kind, pieces: line_at(chart, coordinates, |s| interpolate(&table, s)) })
        .filter(|line| !line.pieces.is_empty())
        .collect()
}

/// Left and right angle of the springlines at every step of chainage.
fn springlines(section: &SectionField) -> Vec<Feet> {
    let steps = ((section.end() - section.start()) / STEP_M).ceil().max(1.0) as usize;
    let chainage = |i: usize| section.start() + (i as f64 + 0.5) / steps as f64 * (section.end() - section.start());
    // Angles from the left side of the invert over the crown to its right side.
    let radii: Vec<Vec<f64>> =
        (0..steps).map(|i| (0..=2 * ANGLES).map(|k| section.radius(chainage(i), angle_of(k))).collect()).collect();
    (0..steps)
        .map(|i| {
            let near = &radii[i.saturating_sub(MEDIAN_REACH)..(i + MEDIAN_REACH + 1).min(steps)];
            let usual: Vec<f64> = (0..=2 * ANGLES)
                .map(|k| {
                    let mut values: Vec<f64> = near.iter().map(|r| r[k]).collect();
                    statistics::median(&mut values).unwrap_or(radii[i][k])
                })
                .collect();
            let angle = |side| spring_angle(section, chainage(i), &usual, side);
            [chainage(i), angle(-1.0), angle(1.0)]
        })
        .collect()
}

/// The angle of an entry in a table of radii around the section.
fn angle_of(k: usize) -> f64 {
    PI * (k as f64 / ANGLES as f64 - 1.0)
}

/// Angle of the springline on one side (`side`: -1 left, 1 right) of a section with these radii.
fn spring_angle(section: &SectionField, chainage: f64, radii: &[f64], side: f64) -> f64 {
    // From the crown downwards.
    let entry = |k: usize| if side < 0.0 { ANGLES - k } else { ANGLES + k };
    let width = |k: usize| radii[entry(k)] * angle_of(entry(k)).sin().abs();
    let widest = (0..=ANGLES).map(width).fold(0.0, f64::max);
    let girth_at = |missing: f64| {
        let k = (0..=ANGLES).find(|&k| width(k) >= (1.0 - missing) * widest).unwrap_or(ANGLES / 2);
        section.girth(chainage, angle_of(entry(k)))
    };
    let [near, far] = MISSING.map(girth_at);
    section.angle_of_girth(chainage, 2.0 * near - far)
}

/// A value of a table at a chainage; constant beyond its ends.
fn interpolate(table: &[(f64, f64)], chainage: f64) -> f64 {
    let next = table.partition_point(|t| t.0 <= chainage);
    match (next.checked_sub(1).map(|k| table[k]), table.get(next)) {
        (Some(a), Some(b)) => a.1 + (b.1 - a.1) * (chainage - a.0) / (b.0 - a.0),
        (Some(a), None) => a.1,
        (None, Some(b)) => b.1,
        (None, None) => 0.0,
    }
}

/// Where the angle around the axis is `angle_at(chainage)`, on the chart.
fn line_at(chart: &Chart, coordinates: &[AxisCoordinates], angle_at: impl Fn(f64) -> f64) -> Vec<Vec<[f64; 2]>> {
    let beyond: Vec<f64> = coordinates
        .iter()
        .map(|c| {
            let d = c.angle() - angle_at(c.chainage);
            d - TAU * (d / TAU).round()
        })
        .collect();
    let mut bins: Vec<(i64, f64)> = Vec::new();
    for (face, corners) in chart.strip().mesh().faces().iter().enumerate() {
        let d = corners.map(|v| beyond[v as usize]);
        // On the far side of the tunnel the angle jumps by a full turn; that is no crossing.
        if d.iter().any(|x| !(x.abs() < FRAC_PI_2)) {
            continue;
        }
        let uv = chart.corners_in_chart(face as u32);
        for (a, b) in [(0, 1), (1, 2), (2, 0)] {
            if (d[a] < 0.0) != (d[b] < 0.0) {
                let crossing: Vec2 = uv[a] + (uv[b] - uv[a]) * (d[a] / (d[a] - d[b]));
                bins.push(((crossing.x / BIN_M).floor() as i64, crossing.y));
            }
        }
    }
    bins.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut pieces: Vec<Vec<[f64; 2]>> = Vec::new();
    let mut last: Option<i64> = None;
    for bin in bins.chunk_by(|a, b| a.0 == b.0) {
        let (k, girth) = bin[bin.len() / 2];
        if last.is_none_or(|l| k - l > BRIDGED_BINS as i64) {
            pieces.push(Vec::new());
        }
        last = Some(k);
        let millimetres = |x: f64| (x * 1000.0).round() / 1000.0;
        if let Some(piece) = pieces.last_mut() {
            piece.push([millimetres((k as f64 + 0.5) * BIN_M), millimetres(girth)]);
        }
    }
    pieces.retain(|p| p.len() > 1);
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::example::bent_chart;
    use crate::numeric::Vec3;

    /// Half-width 2 m: vertical walls from -2 m to the axis' height, a round roof above, a flat floor below.
    fn horseshoe(angle: f64) -> f64 {
        if angle.abs() <= FRAC_PI_2 {
            2.0
        } else {
            let (s, c) = (angle.sin().abs(), angle.cos().abs());
            (2.0 / s.max(1e-9)).min(2.0 / c)
        }
    }

    #[test]
    fn springlines_of_a_horseshoe_and_a_pipe() {
        for radius in [horseshoe as fn(f64) -> f64, |_| 1.3] {
            let section = SectionField::uniform(0.0, 20.0, radius);
            for [_, left, right] in springlines(&section) {
                assert!((left.to_degrees() + 90.0).abs() < 3.0, "{left}");
                assert!((right.to_degrees() - 90.0).abs() < 3.0, "{right}");
            }
        }
    }

    #[test]
    fn lines_lie_where_the_angle_says() {
        // A half pipe, girth 0 at the lower edge of the chart.
        let radius = 2.0;
        let chart = bent_chart(12.0, radius * PI, 61, 41, |u, v| {
            let angle = v / radius - FRAC_PI_2;
            Vec3::new(u, -radius * angle.sin(), radius * angle.cos())
        });
        let section = SectionField::uniform(0.0, 12.0, |_| 2.0);
        let coordinates: Vec<AxisCoordinates> =
            chart.uv().iter().map(|p| AxisCoordinates::from_polar(p.x, p.y / radius - FRAC_PI_2, radius)).collect();
        let feet = [[0.0, -0.5, 0.5], [12.0, -0.5, 0.7]];
        let lines = reference_lines(&chart, &coordinates, &section, &feet);
        let crown = &lines[0];
        assert_eq!((crown.kind, crown.pieces.len()), (LineKind::Crown, 1));
        assert!(crown.pieces[0].iter().all(|p| (p[1] - radius * FRAC_PI_2).abs() < 0.002));
        let right = lines.iter().find(|l| l.kind == LineKind::FootRight).unwrap();
        for p in &right.pieces[0] {
            let expected = radius * (0.5 + 0.2 * p[0] / 12.0 + FRAC_PI_2);
            assert!((p[1] - expected).abs() < 0.01, "{p:?} {expected}");
        }
    }
}
