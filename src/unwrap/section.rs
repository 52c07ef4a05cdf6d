//! The section chart: u = chainage, v = true girth from the crown along the local section of the mesh. No solve.
//!
//! Use it when the map must be an exact chainage ruler, and as the start of every optimiser: it is always readable and
//! takes well under a second for a million faces. Distortion is what the rock's roughness and the bend make it; `relax`
//! halves it. The section must be seen whole from the axis; where the surface hides behind itself the chart folds, and
//! `unfold` puts that right (counted).
//!
//! | symbol | meaning |
//! |---|---|
//! | s_k | chainage of slice k; slices are one mesh edge apart |
//! | G_k(a) | arc length from the crown to angle a along the cut of the mesh with the plane of slice k |
//! | a_j | angle grid, 0.5 degrees |
//! | D_kj | G_k(a_j+1) - G_k(a_j), averaged over a chainage window with weights (1 - x^2)^2 |
//! | A_kj | sum of D_k from the crown to a_j |
//!
//! A vertex at (s, a) gets v = A_kj + D_kj (G_k(a) - G_k(a_j)) / (G_k(a_j+1) - G_k(a_j)), interpolated between the two
//! slices around s. Averaging the *increments* lets v change smoothly along the tunnel and fills what a slice does not
//! have from its neighbours; the quotient keeps the exact shape within a grid step, so a prism and a polygonal cylinder
//! come out isometric to rounding. Gaps in a slice are bridged by chords where no neighbour within a few metres knows
//! better. v grows with the angle everywhere, so the chart cannot fold where the surface does not.
//!
//! Guarantees: u is the chainage of every vertex that unfolding did not move; isometric on prisms. Cost: linear;
//! memory one angle grid a slice.

use super::guide::Guide;
use super::{Error, SolveSummary};
use crate::axis::AxisCoordinates;
use crate::cut::Strip;
use crate::numeric::{Vec2, wrap_angle};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// Settings of the section chart.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Girth is averaged over this length of tunnel in metres, so that v is smooth along the tunnel. A sixth of the girth
    /// when not given.
    pub window_m: Option<f64>,
}

/// What making the section chart tells.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SectionSummary {
    /// Slices measured.
    pub slices: usize,
    /// Distance between them, metres.
    pub slice_spacing_m: f64,
    /// Share of the measured girth that was bridged by a chord over a gap, percent.
    pub bridged_percent: f64,
    /// Pieces of section hidden behind others as seen from the axis.
    pub hidden_pieces: usize,
    /// Mean girth of the section from border to border, metres.
    pub mean_girth_m: f64,
    /// Length of tunnel over which girth was averaged, metres.
    pub window_m: f64,
}

/// Window as a share of the girth. Measured on rough tunnels: a shorter one lets the axis lines wander (bearing error 6.6
/// degrees at 1 m, 3.8 at 4 m for a girth of 26 m), a longer one gains little and follows changes of the section late.
const WINDOW_OF_GIRTH: f64 = 1.0 / 6.0;
/// Angle grid: steps in a full turn.
const STEPS: usize = 720;
/// Most slices; a longer tunnel gets wider spacing (the mesh itself is never thinned).
const MOST_SLICES: f64 = 20_000.0;
/// Distance over which a gap stops borrowing its girth from the slices beside it and trusts the chord, metres.
const BORROW_M: f64 = 2.0;
/// Angles closer than this are the same crossing.
const SAME_ANGLE: f64 = 1e-10;

/// The section chart: the guide already is it.
///
/// # Errors
/// [`Error::NeedsAxis`] without a guide.
pub fn flatten(_strip: &Strip, guide: Option<&Guide>, _: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    let guide = guide.ok_or(Error::NeedsAxis { method: "section" })?;
    Ok((guide.uv().to_vec(), SolveSummary::direct()))
}

/// (chainage, girth) of each vertex; see the module.
///
/// # Errors
/// [`Error::Setting`] for a window that is not positive.
pub(super) fn chart(
    strip: &Strip,
    coordinates: &[AxisCoordinates],
    angles: &[f64],
    settings: &Settings,
) -> Result<(Vec<Vec2>, SectionSummary), Error> {
    if let Some(value) = settings.window_m.filter(|w| !(*w > 0.0 && w.is_finite())) {
        return Err(Error::Setting { key: "section.window_m", value, must: "more than 0 metres" });
    }
    let layout = Layout::of(strip, coordinates, angles);
    let slices = cut_slices(strip, coordinates, angles, &layout);
    let length: f64 = slices.iter().map(Slice::length).sum();
    let mean_girth_m = length / layout.slices as f64;
    let window_m = settings.window_m.unwrap_or(mean_girth_m * WINDOW_OF_GIRTH);
    let increments = average_increments(&slices, &layout, window_m);
    let sums = sum_from_crown(&increments, &layout);
    let uv = coordinates
        .par_iter()
        .zip(angles)
        .map(|(c, &angle)| {
            // The last half step before each portal continues the line through the last two slices.
            let position = (c.chainage - layout.start) / layout.spacing - 0.5;
            let k = (position.floor().max(0.0) as usize).min(layout.slices.saturating_sub(2));
            let blend = (position - k as f64).clamp(-0.5, 1.5);
            let girth = |k: usize| layout.girth(&slices[k], &increments[k], &sums[k], angle);
            let v = if blend == 0.0 {
                girth(k)
            } else {
                (1.0 - blend) * girth(k) + blend * girth((k + 1).min(layout.slices - 1))
            };
            Vec2::new(c.chainage, v)
        })
        .collect();
    let bridged: f64 = slices.iter().map(|s| s.bridged).sum();
    let summary = SectionSummary {
        slices: layout.slices,
        slice_spacing_m: layout.spacing,
        bridged_percent: if length > 0.0 { 100.0 * bridged / length } else { 0.0 },
        hidden_pieces: slices.iter().map(|s| s.hidden).sum(),
        mean_girth_m,
        window_m,
    };
    Ok((uv, summary))
}

/// Where the slices and the angle grid lie.
struct Layout {
    start: f64,
    spacing: f64,
    slices: usize,
    /// Grid index of angle 0.
    crown: usize,
    /// Grid steps.
    steps: usize,
}

impl Layout {
    fn of(strip: &Strip, coordinates: &[AxisCoordinates], angles: &[f64]) -> Self {
        let mesh = strip.mesh();
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        let (mut left, mut right) = (0.0_f64, 0.0_f64);
        for &v in mesh.faces().iter().flatten() {
            let s = coordinates[v as usize].chainage;
            (low, high) = (low.min(s), high.max(s));
            (left, right) = (left.min(angles[v as usize]), right.max(angles[v as usize]));
        }
        let edge = (2.0 * mesh.area() / mesh.faces().len() as f64).sqrt();
        let length = high - low;
        let slices = (length / edge).ceil().clamp(1.0, MOST_SLICES) as usize;
        let step = TAU / STEPS as f64;
        let crown = (-left / step).floor() as usize + 1;
        let steps = crown + (right / step).floor() as usize + 1;
        Self { start: low, spacing: length / slices as f64, slices, crown, steps }
    }

    fn chainage(&self, slice: usize) -> f64 {
        self.start + (slice as f64 + 0.5) * self.spacing
    }

    fn grid_angle(&self, j: usize) -> f64 {
        (j as f64 - self.crown as f64) * (TAU / STEPS as f64)
    }

    /// Girth from the crown at an angle in one slice.
    fn girth(&self, slice: &Slice, increments: &[f64], sums: &[f64], angle: f64) -> f64 {
        let position = angle / (TAU / STEPS as f64) + self.crown as f64;
        let j = (position.floor().max(0.0) as usize).min(self.steps - 1);
        let (from, to) = (slice.at_grid[j], slice.at_grid[j + 1]);
        let here = slice.girth_at(angle);
        match (here.is_nan(), from.is_nan(), to.is_nan()) {
            (false, false, false) => sums[j] + increments[j] * ((here - from) / (to - from)).clamp(0.0, 1.0),
            // The slice ends within this step: its own length counts from the grid angle that it reaches.
            (false, false, true) => sums[j] + (here - from).max(0.0),
            (false, true, false) => sums[j + 1] - (to - here).max(0.0),
            _ => sums[j] + increments[j] * (position - j as f64).clamp(0.0, 1.0),
        }
    }
}

/// A corner of the cut through the mesh.
#[derive(Clone, Copy)]
struct Knot {
    angle: f64,
    right: f64,
    up: f64,
    girth: f64,
    /// Whether the piece that ends here bridges a gap.
    bridge: bool,
}

/// The cut of the mesh with the plane of one chainage, as girth over angle.
struct Slice {
    knots: Vec<Knot>,
    /// Girth at the grid angles (from an arbitrary zero); NaN where the slice does not reach.
    at_grid: Vec<f64>,
    /// Whether the grid step touches a bridged gap.
    bridged_step: Vec<bool>,
    bridged: f64,
    hidden: usize,
}

impl Slice {
    fn length(&self) -> f64 {
        match (self.knots.first(), self.knots.last()) {
            (Some(a), Some(b)) => b.girth - a.girth,
            _ => 0.0,
        }
    }

    /// Girth at an angle; NaN outside.
    fn girth_at(&self, angle: f64) -> f64 {
        let (Some(first), Some(last)) = (self.knots.first(), self.knots.last()) else { return f64::NAN };
        if angle < first.angle - SAME_ANGLE || angle > last.angle + SAME_ANGLE {
            return f64::NAN;
        }
        let above = self.knots.partition_point(|k| k.angle < angle).clamp(1, self.knots.len() - 1);
        let (a, b) = (&self.knots[above - 1], &self.knots[above]);
        // Where the ray of this angle meets the straight piece.
        let (sin, cos) = angle.sin_cos();
        let (side_a, side_b) = (a.right * cos - a.up * sin, b.right * cos - b.up * sin);
        let t = if (b.angle - a.angle) < std::f64::consts::FRAC_PI_2 && side_a < side_b {
            side_a / (side_a - side_b)
        } else {
            // Too wide or seen edge-on: share by angle.
            (angle - a.angle) / (b.angle - a.angle).max(SAME_ANGLE)
        };
        a.girth + (b.girth - a.girth) * t.clamp(0.0, 1.0)
    }
}

/// Cuts the mesh with all slice planes.
fn cut_slices(strip: &Strip, coordinates: &[AxisCoordinates], angles: &[f64], layout: &Layout) -> Vec<Slice> {
    let faces = strip.mesh().faces();
    // Slices with chainage in (low, high] of a face, so that a vertex on a plane belongs to one side only.
    let range = |corners: &[u32; 3]| {
        let s = corners.map(|v| coordinates[v as usize].chainage);
        let low = s[0].min(s[1]).min(s[2]);
        let high = s[0].max(s[1]).max(s[2]);
        let index = |s: f64| ((s - layout.start) / layout.spacing - 0.5).floor() + 1.0;
        let first = index(low).max(0.0) as usize;
        (first, (index(high).max(0.0) as usize).min(layout.slices))
    };
    let mut start = vec![0usize; layout.slices + 1];
    for corners in faces {
        let (first, end) = range(corners);
        (first..end).for_each(|k| start[k + 1] += 1);
    }
    for k in 0..layout.slices {
        start[k + 1] += start[k];
    }
    let mut crossed = vec![0u32; start[layout.slices]];
    let mut fill = start.clone();
    for (f, corners) in faces.iter().enumerate() {
        let (first, end) = range(corners);
        for slot in &mut fill[first..end] {
            crossed[*slot] = f as u32;
            *slot += 1;
        }
    }
    (0..layout.slices)
        .into_par_iter()
        .map(|k| {
            let plane = layout.chainage(k);
            let crossing = |a: u32, b: u32| -> Option<Knot> {
                // Both faces of an edge compute the same crossing: always from the lower index.
                let (a, b) = (a.min(b) as usize, a.max(b) as usize);
                let (p, q) = (&coordinates[a], &coordinates[b]);
                if (p.chainage < plane) == (q.chainage < plane) {
                    return None;
                }
                let t = (plane - p.chainage) / (q.chainage - p.chainage);
                let (right, up) = (p.right + t * (q.right - p.right), p.up + t * (q.up - p.up));
                let near = angles[a] + t * (angles[b] - angles[a]);
                let angle = near + wrap_angle(right.atan2(up) - near);
                Some(Knot { angle, right, up, girth: 0.0, bridge: false })
            };
            let mut pieces: Vec<[Knot; 2]> = crossed[start[k]..start[k + 1]]
                .iter()
                .filter_map(|&f| {
                    let [a, b, c] = faces[f as usize];
                    let mut ends = [crossing(a, b), crossing(b, c), crossing(c, a)].into_iter().flatten();
                    let (p, q) = (ends.next()?, ends.next()?);
                    Some(if p.angle <= q.angle { [p, q] } else { [q, p] })
                })
                .collect();
            pieces.sort_unstable_by(|x, y| {
                x[0].angle.total_cmp(&y[0].angle).then_with(|| x[1].angle.total_cmp(&y[1].angle))
            });
            string_together(&pieces, layout)
        })
        .collect()
}

/// Joins the pieces of a slice, sorted by angle, to girth over angle.
fn string_together(pieces: &[[Knot; 2]], layout: &Layout) -> Slice {
    let mut knots: Vec<Knot> = Vec::with_capacity(pieces.len() + 1);
    let (mut bridged, mut hidden) = (0.0, 0);
    let distance = |a: &Knot, b: &Knot| (a.right - b.right).hypot(a.up - b.up);
    for [from, to] in pieces {
        let length = distance(from, to);
        let Some(last) = knots.last().copied() else {
            knots.push(*from);
            knots.push(Knot { girth: length, ..*to });
            continue;
        };
        if from.angle > last.angle + SAME_ANGLE {
            let gap = distance(&last, from);
            bridged += gap;
            let girth = last.girth + gap;
            knots.push(Knot { girth, bridge: true, ..*from });
            knots.push(Knot { girth: girth + length, ..*to });
        } else if from.angle >= last.angle - SAME_ANGLE {
            knots.push(Knot { girth: last.girth + length, ..*to });
        } else {
            // Part of the piece lies behind what is already there: its length counts, at one angle.
            hidden += 1;
            let end = knots.len() - 1;
            knots[end].girth += length;
            if to.angle > last.angle {
                let share = (to.angle - last.angle) / (to.angle - from.angle);
                knots[end].girth -= length * share;
                let girth = knots[end].girth + length * share;
                knots.push(Knot { girth, ..*to });
            }
        }
    }
    let mut slice = Slice { knots, at_grid: Vec::new(), bridged_step: vec![false; layout.steps], bridged, hidden };
    slice.at_grid = (0..=layout.steps).map(|j| slice.girth_at(layout.grid_angle(j))).collect();
    let step =
        |angle: f64| ((angle / (TAU / STEPS as f64) + layout.crown as f64).max(0.0) as usize).min(layout.steps - 1);
    for pair in slice.knots.windows(2).filter(|pair| pair[1].bridge) {
        slice.bridged_step[step(pair[0].angle)..=step(pair[1].angle)].fill(true);
    }
    slice
}

/// Girth of each grid step in each slice, averaged along the tunnel; gaps take over from the slices beside them.
fn average_increments(slices: &[Slice], layout: &Layout, window_m: f64) -> Vec<Vec<f64>> {
    let reach = (window_m / 2.0 / layout.spacing).floor() as usize;
    let weight = |d: usize| {
        let x = d as f64 / (reach + 1) as f64;
        (1.0 - x * x).powi(2)
    };
    let weights: Vec<f64> = (0..=reach).map(weight).collect();
    let columns: Vec<Vec<f64>> = (0..layout.steps)
        .into_par_iter()
        .map(|j| {
            let raw = |slice: &Slice| slice.at_grid[j + 1] - slice.at_grid[j];
            let observed: Vec<f64> = slices.iter().map(|s| if s.bridged_step[j] { f64::NAN } else { raw(s) }).collect();
            let (observed, distance) = windowed(&observed, &weights, layout.spacing);
            let all: Vec<f64> = slices.iter().map(raw).collect();
            let (all, _) = windowed(&all, &weights, layout.spacing);
            observed
                .iter()
                .zip(&all)
                .zip(&distance)
                .map(|((&seen, &bridged), &distance)| {
                    if distance == 0.0 || bridged.is_nan() {
                        seen
                    } else if seen.is_nan() {
                        bridged
                    } else {
                        let trust = (-distance / BORROW_M).exp();
                        trust * seen + (1.0 - trust) * bridged
                    }
                })
                .collect()
        })
        .collect();
    let mut rows: Vec<Vec<f64>> =
        (0..slices.len()).map(|k| (0..layout.steps).map(|j| columns[j][k]).collect()).collect();
    // Grid steps that no slice has in full (the seam's own step, a missing floor) continue their neighbour's girth.
    for row in &mut rows {
        for j in layout.crown..layout.steps {
            if row[j].is_nan() {
                row[j] = if j > 0 { row[j - 1] } else { f64::NAN };
            }
        }
        for j in (0..layout.steps).rev() {
            if row[j].is_nan() {
                row[j] = if j + 1 < layout.steps { row[j + 1] } else { f64::NAN };
            }
        }
        for j in 1..layout.steps {
            if row[j].is_nan() {
                row[j] = row[j - 1];
            }
        }
    }
    rows
}

/// Local line fit with a kernel of the finite values around each index; where there are none, the line between the nearest averages
/// on both sides, and the distance to the nearer one (0 where there are). All NaN when nothing is finite.
fn windowed(values: &[f64], weights: &[f64], spacing: f64) -> (Vec<f64>, Vec<f64>) {
    let reach = weights.len() - 1;
    let mut averages: Vec<f64> = (0..values.len())
        .map(|k| {
            // A line is fitted, so that one-sided windows at the portals do not pull the girth inwards.
            let (mut w0, mut w1, mut w2, mut y0, mut y1) = (0.0, 0.0, 0.0, 0.0, 0.0);
            for i in k.saturating_sub(reach)..(k + reach + 1).min(values.len()) {
                if values[i].is_finite() {
                    let (w, d) = (weights[i.abs_diff(k)], i as f64 - k as f64);
                    w0 += w;
                    w1 += w * d;
                    w2 += w * d * d;
                    y0 += w * values[i];
                    y1 += w * d * values[i];
                }
            }
            if w0 == 0.0 {
                return f64::NAN;
            }
            let (mean, determinant) = (y0 / w0, w0 * w2 - w1 * w1);
            let fitted = (w2 * y0 - w1 * y1) / determinant;
            // Too few values for a line, or a line that runs away from them.
            if determinant > 1e-9 * w0 * w0 && (0.5 * mean..2.0 * mean).contains(&fitted) { fitted } else { mean }
        })
        .collect();
    let mut distance = vec![0.0; values.len()];
    let known: Vec<usize> = (0..values.len()).filter(|&k| averages[k].is_finite()).collect();
    for pair in known.windows(2) {
        let (a, b) = (pair[0], pair[1]);
        for k in a + 1..b {
            let t = (k - a) as f64 / (b - a) as f64;
            averages[k] = (1.0 - t) * averages[a] + t * averages[b];
            distance[k] = (k - a).min(b - k) as f64 * spacing;
        }
    }
    if let (Some(&first), Some(&last)) = (known.first(), known.last()) {
        for k in (0..first).chain(last + 1..values.len()) {
            let nearest = if k < first { first } else { last };
            averages[k] = averages[nearest];
            distance[k] = k.abs_diff(nearest) as f64 * spacing;
        }
    }
    (averages, distance)
}

/// Girth from the crown at each grid angle.
fn sum_from_crown(increments: &[Vec<f64>], layout: &Layout) -> Vec<Vec<f64>> {
    increments
        .iter()
        .map(|row| {
            let mut sums = vec![0.0; layout.steps + 1];
            for j in layout.crown..layout.steps {
                sums[j + 1] = sums[j] + row[j];
            }
            for j in (0..layout.crown).rev() {
                sums[j] = sums[j + 1] - row[j];
            }
            sums
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::unwrap::{Method, Settings as UnwrapSettings, closed_form, distortion, flatten as unwrap_flatten};

    fn largest_error(known: &closed_form::Known) -> (f64, f64) {
        let guide = Guide::of_strip(&known.strip, &known.axis, &Settings::default()).unwrap();
        guide
            .uv()
            .iter()
            .zip(&known.flat)
            .fold((0.0, 0.0), |(u, v), (p, q)| (f64::max(u, (p.x - q.x).abs()), f64::max(v, (p.y - q.y).abs())))
    }

    #[test]
    fn prisms_are_isometric() {
        for known in closed_form::developable() {
            let (u, v) = largest_error(&known);
            assert!(u < 1e-9 && v < 1e-9, "{}: {u} {v}", known.name);
        }
    }

    #[test]
    fn a_cone_keeps_chainage_and_girth() {
        let (u, v) = largest_error(&closed_form::cone());
        // The mesh is a polygon of 60 corners: its girth is short of the circle's by 1 - sinc(3 degrees).
        assert!(u < 1e-9 && v < 4.0 * std::f64::consts::PI * 6e-4, "{u} {v}");
    }

    #[test]
    fn a_bend_keeps_chainage_and_girth() {
        let (u, v) = largest_error(&closed_form::bend(20.0));
        assert!(u < 1e-6 && v < 2e-3, "{u} {v}");
    }

    #[test]
    fn a_rough_tunnel_has_no_flips() {
        let known = closed_form::rough(200, 180);
        let (chart, summary) =
            unwrap_flatten(known.strip, Some(&known.axis), &UnwrapSettings::of(Method::Section(Settings::default())))
                .unwrap();
        assert_eq!(distortion::flipped_faces(chart.strip().mesh(), chart.uv()), (0, 0));
        assert_eq!((summary.flipped_faces, summary.overlaps), (0, 0));
        assert!(summary.distortion.stretch.mean < 1.1, "{}", summary.distortion.stretch.mean);
        assert!(summary.readability.unwrap().chainage_rms_m < 1e-3);
    }

    #[test]
    fn a_hole_takes_its_girth_from_the_slices_beside_it() {
        let known = closed_form::prism();
        let mesh = known.strip.into_mesh();
        // Cut a window of two facets out of the left wall.
        let keep: Vec<usize> = (0..mesh.faces().len())
            .filter(|&f| {
                let centre = mesh.corners(f as u32).iter().sum::<crate::numeric::Vec3>() / 3.0;
                !((4.0..5.0).contains(&centre.x) && centre.y > 0.0 && centre.z.abs() < 1.0)
            })
            .collect();
        assert!(keep.len() < mesh.faces().len());
        let faces = keep.iter().map(|&f| mesh.faces()[f]).collect();
        let mesh = crate::mesh::Mesh::all_observed(mesh.vertices().to_vec(), faces).unwrap();
        let strip = Strip::from_disk(mesh).unwrap();
        assert_eq!(strip.hole_loops().len(), 1);
        let guide = Guide::of_strip(&strip, &known.axis, &Settings::default()).unwrap();
        assert!(guide.summary().section.bridged_percent > 0.0);
        for &v in strip.mesh().faces().iter().flatten() {
            let error = (guide.uv()[v as usize] - known.flat[v as usize]).norm();
            assert!(error < 0.01, "{v}: {error}");
        }
    }

    #[test]
    fn a_window_of_nothing_is_refused() {
        let known = closed_form::prism();
        let error = Guide::of_strip(&known.strip, &known.axis, &Settings { window_m: Some(0.0) }).unwrap_err();
        assert!(matches!(error, Error::Setting { key: "section.window_m", .. }));
    }
}
