//! Refines a rough path to the centre line: every slice perpendicular to it is shifted onto the mean section around it.
//!
//! In slice `i` and direction `a` around the axis, `r(i, a)` is the median radius of the points. The mean section `T_i`
//! is the median of `r` over a window of slices; its centre of area is the centre line there. A single slice may lack
//! its floor or have a niche or a vehicle, so its own centre of area is worthless; but what it has in common with the
//! mean section tells its shift: least squares of `(r - T) (n . e) = n . shift` over directions, with `n` the normal of
//! `T` and `e` the ray, weighted by arc length and robustly (Tukey's biweight), which ignores missing and odd parts.

use super::smoothing::{Smoothed, smooth};
use super::{Axis, AxisCoordinates, Error};
use crate::numeric::statistics::median;
use crate::numeric::{Vec2, Vec3};
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Directions around the axis.
pub(super) const DIRECTIONS: usize = 72;
/// Half the window of the mean section, in radii.
const WINDOW_RADII: f64 = 5.0;
/// Length over which errors of a slice's centre hang together, in radii.
const BLOCK_RADII: f64 = 2.5;
/// Differences of the centre line below this many radii are not worth a wave.
const TOLERANCE_RADII: f64 = 0.015;
/// Slices supported by less than this share of the usual support are not tunnel when they lie beyond the ends.
const END_SUPPORT: f64 = 0.5;
/// Surface within this share of the mean section's radius belongs to the section.
pub(super) const NEAR: f64 = 0.2;
/// Rounds of slicing and smoothing.
const ROUNDS: usize = 6;
/// A round that moves the axis less than this share of the radius ends the refinement.
const SETTLED: f64 = 5e-4;
/// Spacing of the knots of the final axis, in radii.
const KNOT_RADII: f64 = 1.0;

/// A refined axis and what was learnt on the way.
pub(super) struct Refined {
    pub axis: Axis,
    /// Area-equivalent radius of the mean section, metres (median along the axis).
    pub radius_m: f64,
    /// Wavelength below which movements of the centres were taken for relief, metres.
    pub wavelength_m: f64,
    /// Median distance between the centres of slices and the axis, metres.
    pub residual_m: f64,
}

/// Radii around an axis; NaN where nothing was seen.
pub(super) struct Slices {
    pub start: f64,
    pub step_m: f64,
    pub radii: Vec<[f64; DIRECTIONS]>,
    pub mean: Vec<[f64; DIRECTIONS]>,
}

impl Slices {
    fn chainage(&self, i: usize) -> f64 {
        self.start + (i as f64 + 0.5) * self.step_m
    }

    /// The mean section's radius around a place, NaN if unknown.
    pub fn mean_radius(&self, c: &AxisCoordinates) -> f64 {
        let i = ((c.chainage - self.start) / self.step_m).floor().clamp(0.0, self.mean.len() as f64 - 1.0);
        self.mean[i as usize][direction_of(c)]
    }

    /// Share of the directions in which slice `i` has surface near the mean section.
    pub fn coverage(&self, i: usize) -> f64 {
        let near = |a: usize| (self.radii[i][a] - self.mean[i][a]).abs() < NEAR * self.mean[i][a];
        (0..DIRECTIONS).filter(|&a| near(a)).count() as f64 / DIRECTIONS as f64
    }
}

/// Which of the directions a place lies in.
pub(super) fn direction_of(c: &AxisCoordinates) -> usize {
    ((c.angle() / TAU + 0.5) * DIRECTIONS as f64).floor().clamp(0.0, DIRECTIONS as f64 - 1.0) as usize
}

/// Unit ray (right, up) of a direction's middle.
fn ray(direction: usize) -> Vec2 {
    let angle = ((direction as f64 + 0.5) / DIRECTIONS as f64 - 0.5) * TAU;
    Vec2::new(angle.sin(), angle.cos())
}

/// Slices `points` perpendicular to `axis` over a span of chainage, in steps of about `step_m`.
pub(super) fn slice(points: &[Vec3], axis: &Axis, step_m: f64, radius_m: f64, span: (f64, f64)) -> Slices {
    let count = (((span.1 - span.0) / step_m).floor() as usize).max(1);
    let step_m = (span.1 - span.0) / count as f64;
    let coordinates: Vec<AxisCoordinates> = points.par_iter().with_min_len(1024).map(|p| axis.project(p)).collect();
    let mut members: Vec<Vec<f64>> = vec![Vec::new(); count * DIRECTIONS];
    for c in &coordinates {
        let i = ((c.chainage - span.0) / step_m).floor();
        if i >= 0.0 && (i as usize) < count {
            members[i as usize * DIRECTIONS + direction_of(c)].push(c.radius());
        }
    }
    let medians: Vec<f64> = members.par_iter_mut().map(|m| median(m).unwrap_or(f64::NAN)).collect();
    let radii: Vec<[f64; DIRECTIONS]> =
        medians.chunks_exact(DIRECTIONS).map(|c| c.try_into().expect("a chunk per slice")).collect();
    let window = (WINDOW_RADII * radius_m / step_m).ceil() as usize;
    let mean = (0..count).into_par_iter().map(|i| mean_section(&radii, i, window)).collect();
    Slices { start: span.0, step_m, radii, mean }
}

/// Median over the window of slices per direction, gaps filled along the circle; NaN if nothing is known at all.
fn mean_section(radii: &[[f64; DIRECTIONS]], i: usize, window: usize) -> [f64; DIRECTIONS] {
    let range = i.saturating_sub(window)..(i + window + 1).min(radii.len());
    let mut section = [f64::NAN; DIRECTIONS];
    for (a, radius) in section.iter_mut().enumerate() {
        let mut seen: Vec<f64> = range.clone().map(|j| radii[j][a]).filter(|r| r.is_finite()).collect();
        // A direction seen in very few slices is more likely something odd than the wall.
        if seen.len() * 20 >= range.len() {
            *radius = median(&mut seen).unwrap_or(f64::NAN);
        }
    }
    let known: Vec<usize> = (0..DIRECTIONS).filter(|&a| section[a].is_finite()).collect();
    if known.is_empty() {
        return section;
    }
    let filled = section;
    for (place, &from) in known.iter().enumerate() {
        let to = known[(place + 1) % known.len()];
        let gap = (to + DIRECTIONS - from - 1) % DIRECTIONS;
        for k in 1..=gap {
            // Straight chord across the gap, in polar form: a missing floor is flat, not round.
            let (p, q) = (ray(from) * filled[from], ray(to) * filled[to]);
            let direction = ray((from + k) % DIRECTIONS);
            let chord = q - p;
            let cross = direction.x * chord.y - direction.y * chord.x;
            let radius = (p.x * chord.y - p.y * chord.x) / cross;
            let linear = filled[from] + (filled[to] - filled[from]) * k as f64 / (gap + 1) as f64;
            section[(from + k) % DIRECTIONS] =
                if radius.is_finite() && radius > 0.25 * linear && radius <= linear { radius } else { linear };
        }
    }
    section
}

/// Area and centre of area (right, up) of a section.
fn area_and_centre(section: &[f64; DIRECTIONS]) -> (f64, Vec2) {
    let (mut area, mut moment) = (0.0, Vec2::zeros());
    for a in 0..DIRECTIONS {
        let (p, q) = (ray(a) * section[a], ray((a + 1) % DIRECTIONS) * section[(a + 1) % DIRECTIONS]);
        let cross = (p.x * q.y - p.y * q.x) / 2.0;
        area += cross;
        moment += (p + q) / 3.0 * cross;
    }
    (area.abs(), if area == 0.0 { Vec2::zeros() } else { moment / area })
}

/// Shift (right, up) of a slice against the mean section, and how much of the circle supports it (0 to 1).
fn shift(radii: &[f64; DIRECTIONS], mean: &[f64; DIRECTIONS], radius_m: f64) -> (Vec2, f64) {
    // Per direction: normal n of the section, (r - T)(n . e), arc length.
    let mut rows: Vec<(Vec2, f64, f64)> = Vec::with_capacity(DIRECTIONS);
    for a in 0..DIRECTIONS {
        if !radii[a].is_finite() {
            continue;
        }
        let (before, after) = ((a + DIRECTIONS - 1) % DIRECTIONS, (a + 1) % DIRECTIONS);
        let along = ray(after) * mean[after] - ray(before) * mean[before];
        let length = along.norm() / 2.0;
        let mut normal = Vec2::new(along.y, -along.x) / along.norm().max(1e-12);
        if normal.dot(&ray(a)) < 0.0 {
            normal = -normal;
        }
        rows.push((normal, (radii[a] - mean[a]) * normal.dot(&ray(a)), length));
    }
    let perimeter: f64 = (0..DIRECTIONS).map(|a| mean[a] * TAU / DIRECTIONS as f64).sum();
    let mut found = Vec2::zeros();
    let mut support = 0.0;
    // Starts from the robust scale of the residuals, and a tenth of the radius at most: beyond that it is not wall.
    for _ in 0..12 {
        let mut gaps: Vec<f64> = rows.iter().map(|(n, d, _)| (d - n.dot(&found)).abs()).collect();
        let scale = (1.4826 * median(&mut gaps).unwrap_or(0.0)).clamp(0.004 * radius_m, 0.1 * radius_m);
        let mut matrix = crate::numeric::Mat2::identity() * (0.02 * perimeter);
        let mut right_side = Vec2::zeros();
        support = 0.0;
        for (n, d, length) in &rows {
            let x = ((d - n.dot(&found)).abs() / (4.685 * scale)).min(1.0);
            let weight = length * (1.0 - x * x).powi(2);
            matrix += n * n.transpose() * weight;
            right_side += n * (d * weight);
            support += weight;
        }
        let next = matrix.try_inverse().map_or(found, |m| m * right_side);
        let moved = (next - found).norm();
        found = next;
        if moved < 1e-5 * radius_m {
            break;
        }
    }
    (found, (support / perimeter.max(1e-12)).min(1.0))
}

/// Iterates slicing, shifting and smoothing from a rough axis. `reach_m` is how far the axis is continued beyond its
/// ends to look for more tunnel; `least_step_m` the thinnest slice that still has points all around.
pub(super) fn refine(
    points: &[Vec3],
    rough: &Axis,
    radius_m: f64,
    least_step_m: f64,
    reach_m: f64,
) -> Result<Refined, Error> {
    let mut axis = rough.clone();
    let mut radius_m = radius_m;
    let mut rounds = 0;
    loop {
        rounds += 1;
        // The void ends before the tunnel does; look beyond until the section stops.
        let span = (axis.start_chainage() - reach_m, axis.end_chainage() + reach_m);
        let step_m = (0.25 * radius_m).max(least_step_m).max((span.1 - span.0) / 4000.0);
        let slices = slice(points, &axis, step_m, radius_m, span);
        let count = slices.radii.len();
        let found: Vec<(Vec3, f64, f64, Vec3)> = (0..count)
            .into_par_iter()
            .map(|i| {
                let frame = axis.frame_at(slices.chainage(i));
                let mean = &slices.mean[i];
                if !mean[0].is_finite() {
                    return (frame.origin, 0.0, f64::NAN, frame.origin);
                }
                let (area, centre) = area_and_centre(mean);
                let (shift, support) = shift(&slices.radii[i], mean, radius_m);
                let offset = centre + shift;
                // Squared: a slice with half its circle says much less than half of what a full one says.
                let moved = frame.origin - frame.left * offset.x + frame.up * offset.y;
                (moved, support * support, (area / std::f64::consts::PI).sqrt(), frame.origin)
            })
            .collect();
        let centres: Vec<Vec3> = found.iter().map(|f| f.0).collect();
        let weights: Vec<f64> = found.iter().map(|f| if f.1 > 0.04 { f.1 } else { 0.0 }).collect();
        let mut known: Vec<f64> = found.iter().map(|f| f.2).filter(|r| r.is_finite()).collect();
        if let Some(seen) = median(&mut known) {
            radius_m = seen;
        }
        let Smoothed { curve, wavelength_m, residual_m } =
            smooth(&centres, &weights, slices.step_m, BLOCK_RADII * radius_m, TOLERANCE_RADII * radius_m);
        let mut supports: Vec<f64> = weights.iter().copied().filter(|w| *w > 0.0).collect();
        let enough = END_SUPPORT * END_SUPPORT * median(&mut supports).unwrap_or(0.0);
        let first = weights.iter().position(|w| *w > enough).unwrap_or(0);
        let last = weights.iter().rposition(|w| *w > enough).unwrap_or(count - 1);
        let moved = (first..=last).map(|i| (curve[i] - found[i].3).norm()).fold(0.0, f64::max);
        let every = ((KNOT_RADII * radius_m / slices.step_m).round() as usize).max(1);
        let mut knots: Vec<Vec3> = (first..=last).step_by(every).map(|i| curve[i]).collect();
        if (last - first) % every != 0 {
            // The last stretch is between half a step and one and a half.
            if (last - first) % every < every.div_ceil(2) && knots.len() > 2 {
                knots.pop();
            }
            knots.push(curve[last]);
        }
        let next = extended(&knots, slices.step_m)?;
        let settled = moved < SETTLED * radius_m;
        if settled || rounds == ROUNDS {
            return Ok(Refined { axis: next, radius_m, wavelength_m, residual_m });
        }
        axis = next;
    }
}

/// An axis through `knots`, continued straight by `by_m` at both ends.
pub(super) fn extended(knots: &[Vec3], by_m: f64) -> Result<Axis, Error> {
    let axis = Axis::through(knots, 0.0)?;
    let (start, end) = (axis.frame_at(0.0), axis.frame_at(axis.end_chainage()));
    let mut all = vec![start.origin - start.forward * by_m];
    all.extend_from_slice(knots);
    all.push(end.origin + end.forward * by_m);
    Axis::through(&all, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn horseshoe() -> [f64; DIRECTIONS] {
        // 8 m wide, walls of 3 m under a half circle of 4 m, seen from 3 m above the floor's middle.
        std::array::from_fn(|a| {
            let e = ray(a);
            let mut t: f64 = if e.y < 0.0 { -3.0 / e.y } else { f64::INFINITY };
            if e.x != 0.0 && (e.y * 4.0 / e.x.abs()) <= 0.0 {
                t = t.min(4.0 / e.x.abs());
            }
            if e.y > 0.0 {
                t = 4.0
            }
            t
        })
    }

    #[test]
    fn shift_finds_what_was_shifted() {
        let mean = horseshoe();
        let wanted = Vec2::new(0.12, -0.07);
        // The shifted section, ray by ray: the wall that the ray meets, moved by the shift.
        let mut moved = [f64::NAN; DIRECTIONS];
        for a in 0..DIRECTIONS {
            let e = ray(a);
            let mut best = f64::INFINITY;
            for k in 0..3600 {
                let angle = k as f64 / 3600.0 * TAU;
                let d = Vec2::new(angle.sin(), angle.cos());
                let mut t: f64 = if d.y < 0.0 { -3.0 / d.y } else { 4.0 };
                if d.y <= 0.0 && d.x != 0.0 {
                    t = t.min(4.0 / d.x.abs());
                }
                let p = d * t + wanted;
                let off = (p.x * e.y - p.y * e.x).abs();
                if p.dot(&e) > 0.0 && off < best {
                    best = off;
                    moved[a] = p.norm();
                }
            }
        }
        // A third of the floor missing and a niche of 1 m must not matter.
        moved[0..8].fill(f64::NAN);
        moved[50..55].iter_mut().for_each(|r| *r += 1.0);
        let (found, support) = shift(&moved, &mean, 4.0);
        assert!((found - wanted).norm() < 0.01, "{found:?}");
        assert!(support > 0.6);
    }

    #[test]
    fn area_and_centre_of_a_shifted_circle() {
        // A circle of radius 2 seen from 0.3 m left of and 0.2 m below its centre.
        let section = std::array::from_fn(|a| {
            let (e, c) = (ray(a), Vec2::new(0.3, 0.2));
            let along = e.dot(&c);
            along + (along * along + 4.0 - c.norm_squared()).sqrt()
        });
        let (area, centre) = area_and_centre(&section);
        assert!((area / (4.0 * std::f64::consts::PI) - 1.0).abs() < 0.005);
        assert!((centre - Vec2::new(0.3, 0.2)).norm() < 0.002);
    }
}
