//! The robust mean section around the axis: radius as a function of chainage and angle, and the girth along it.
//!
//! Use it wherever "the tunnel without its roughness" is meant: girth coordinates, signed offsets, a first guess of the
//! surface. It describes sections that are star-shaped around the axis; what lies behind an overhang is averaged.
//!
//! Method: the median radius of each (chainage, angle) cell, isolated cells rejected against their neighbourhood, then
//! normalised Gaussian convolution (H. Knutsson, C.-F. Westin, "Normalized and differential convolution", CVPR 1993,
//! doi:10.1109/CVPR.1993.341081) from coarse to fine, so that gaps are bridged by ever wider averages without a step.
//!
//! | symbol | meaning |
//! |---|---|
//! | `s` | chainage, metres |
//! | `a` | angle around the axis, 0 at the crown, positive over the right wall |
//! | `r(s, a)` | mean radius, metres |
//! | `g(s, a)` | girth: arc length of the section polygon from the crown, metres, negative over the left wall |
//!
//! Guarantees: `r > 0`; `g` strictly increases with `a`; [`SectionField::angle_of_girth`] inverts
//! [`SectionField::girth`] exactly (both are linear on the same segments). Cost: linear in points and cells.

use crate::axis::{Axis, AxisCoordinates};
use crate::numeric::{Vec3, statistics};
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};

/// Angular nodes of the section. Even, so that one node is exactly the crown; 1 degree is 7 cm at 4 m radius.
const COLUMNS: usize = 360;
/// Angular width over which raw medians are taken, in columns.
const MEDIAN_COLUMNS: usize = 2;
/// Length of a row in mean radii: short enough for a change of profile, long enough to average the roughness.
const STEP_IN_RADII: f64 = 0.125;
/// Smoothing along the chainage in mean radii.
const SIGMA_S_IN_RADII: f64 = 0.35;
/// Smoothing around the section, radians (3 degrees: the corner between wall and floor is rounded by about 0.2 m).
const SIGMA_ANGLE: f64 = 3.0 * PI / 180.0;
/// A cell farther from the median of its neighbourhood than this share of the radius is not part of the mean section.
const REJECT_SHARE: f64 = 0.2;
/// Rows looked at on both sides for that median: 8 m of a rail tunnel, so that 7 m beyond a portal are outvoted.
const REJECT_ROWS: usize = 16;
/// Rows looked at on both sides for the walls beside a side room: four mean radii, so that rooms up to twice as wide as the
/// tunnel are outvoted.
const ROOM_ROWS: usize = 32;
/// A side room takes no more than this share of the directions around the axis; what does is a chamber of the tunnel.
const ROOM_DIRECTIONS: f64 = 0.45;
/// The cheeks of a side room: within two rows the wall steps back by this share of the mean radius (50 degrees).
const CHEEK_IN_RADII: f64 = 0.3;
/// Share of its ends along the tunnel at which a side room has cheeks.
const CHEEK_SHARE: f64 = 0.5;
/// A row belongs to the tunnel when at least this share of its 10-degree sectors holds points.
const MIN_SECTOR_SHARE: f64 = 0.25;

/// Mean radius on a (chainage, angle) grid; see the module's header.
#[derive(Clone, Debug)]
pub struct SectionField {
    start: f64,
    step: f64,
    rows: usize,
    /// `rows x COLUMNS`, column `k` at angle `-pi + k 2 pi / COLUMNS`.
    radius: Vec<f64>,
    /// Whether points were seen in the cell.
    observed: Vec<bool>,
    /// `rows x (COLUMNS + 1)`: girth at the same angles, closing at `+pi`.
    girth: Vec<f64>,
}

/// The tunnel ends where fewer directions than this share of the usual number agree with the section further inside.
const PORTAL_SHARE: f64 = 0.7;

/// Why no mean section was found.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// No points at all.
    #[error("no points to take a section from")]
    Empty,
    /// No slice across the axis is surrounded by points.
    #[error(
        "no section along the axis has points in more than {percent:.0} % of its directions: the scan does not surround \
         its axis, so it is no tunnel or the axis is wrong"
    )]
    NotSurrounded {
        /// Largest share of directions with points, percent.
        percent: f64,
    },
}

impl SectionField {
    /// The mean section of `points` (axis coordinates).
    ///
    /// Points far outside are harmless as long as most points of each direction lie on the tunnel's surface.
    /// `min_step_m` is the smallest useful row length (the distance between profiles of a profile scan, else 0).
    ///
    /// # Errors
    /// [`Error::Empty`], or [`Error::NotSurrounded`] when no slice looks like a tunnel.
    pub fn estimate(points: &[AxisCoordinates], min_step_m: f64) -> Result<Self, Error> {
        if points.is_empty() {
            return Err(Error::Empty);
        }
        let mut radii: Vec<f64> = points.par_iter().map(AxisCoordinates::radius).collect();
        let mean_radius = statistics::median(&mut radii).unwrap_or(1.0).max(1e-6);
        drop(radii);
        let (low, high) = points.iter().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(p.chainage), h.max(p.chainage)));
        let step = (mean_radius * STEP_IN_RADII).max(min_step_m).max((high - low) / 1e6);
        let rows = ((high - low) / step).ceil().max(1.0) as usize;
        let raw = raw_medians(points, low, step, rows);
        let columns = COLUMNS / MEDIAN_COLUMNS;
        let (first, last) = tunnel_rows(&raw, rows, 0.0)?;
        let mut raw = raw[first * columns..(last + 1) * columns].to_vec();
        reject_side_rooms(&mut raw, last - first + 1, mean_radius);
        reject_isolated(&mut raw, last - first + 1);
        // What was rejected at the ends lies outside the portals.
        let (inner_first, inner_last) = tunnel_rows(&raw, last - first + 1, PORTAL_SHARE)?;
        let (start, rows) = (low + (first + inner_first) as f64 * step, inner_last - inner_first + 1);
        let raw = raw[inner_first * columns..(inner_last + 1) * columns].to_vec();
        let (radius, observed) = smooth(&raw, rows, (mean_radius * SIGMA_S_IN_RADII / step).max(0.7), mean_radius);
        Ok(Self::from_radii(start, step, rows, radius, observed))
    }

    /// A field with the same closed-form section everywhere, for tests and for axes without points: `radius(angle)`.
    pub fn uniform(start: f64, end: f64, radius: impl Fn(f64) -> f64) -> Self {
        let one: Vec<f64> = (0..COLUMNS).map(|k| radius(angle_of_column(k as f64))).collect();
        let values = [one.clone(), one].concat();
        let observed = vec![true; values.len()];
        // Rows are centred in their step, so two rows of half the length span the range.
        Self::from_radii(start, (end - start) / 2.0, 2, values, observed)
    }

    /// What makes the same field again with [`Self::from_columns`]: start and step in metres, radii, observed cells.
    pub fn columns(&self) -> (f64, f64, &[f64], &[bool]) {
        (self.start, self.step, &self.radius, &self.observed)
    }

    /// A field from what [`Self::columns`] gave; `None` when the columns do not fit each other.
    pub fn from_columns(start: f64, step: f64, radius: Vec<f64>, observed: Vec<bool>) -> Option<Self> {
        let rows = radius.len() / COLUMNS;
        let sound = rows > 0 && radius.len() == rows * COLUMNS && observed.len() == radius.len() && step > 0.0;
        (sound && radius.iter().all(|r| *r > 0.0)).then(|| Self::from_radii(start, step, rows, radius, observed))
    }

    fn from_radii(start: f64, step: f64, rows: usize, radius: Vec<f64>, observed: Vec<bool>) -> Self {
        let mut girth = vec![0.0; rows * (COLUMNS + 1)];
        let d_angle = TAU / COLUMNS as f64;
        for row in 0..rows {
            let r = &radius[row * COLUMNS..(row + 1) * COLUMNS];
            let g = &mut girth[row * (COLUMNS + 1)..(row + 1) * (COLUMNS + 1)];
            // Chord between neighbouring nodes of the polar polygon.
            let chord = |k: usize| {
                let (a, b) = (r[k % COLUMNS], r[(k + 1) % COLUMNS]);
                ((a - b).powi(2) + 4.0 * a * b * (d_angle / 2.0).sin().powi(2)).sqrt()
            };
            let crown = COLUMNS / 2;
            for k in crown..COLUMNS {
                g[k + 1] = g[k] + chord(k);
            }
            for k in (0..crown).rev() {
                g[k] = g[k + 1] - chord(k);
            }
        }
        Self { start, step, rows, radius, observed, girth }
    }

    /// First chainage of the tunnel (the portal), metres.
    pub fn start(&self) -> f64 {
        self.start
    }

    /// Last chainage of the tunnel (the other portal), metres.
    pub fn end(&self) -> f64 {
        self.start + self.rows as f64 * self.step
    }

    /// Distance between neighbouring sections, metres.
    pub fn step(&self) -> f64 {
        self.step
    }

    /// Mean radius in metres at a chainage and angle (any real angle; chainage is clamped to the portals).
    pub fn radius(&self, chainage: f64, angle: f64) -> f64 {
        let (row, next, blend) = self.row(chainage);
        let (k, t) = column(angle);
        let at = |row: usize| {
            let r = &self.radius[row * COLUMNS..(row + 1) * COLUMNS];
            r[k % COLUMNS] * (1.0 - t) + r[(k + 1) % COLUMNS] * t
        };
        at(row) * (1.0 - blend) + at(next) * blend
    }

    /// Girth in metres from the crown, positive over the right wall, at an angle in `[-pi, pi]`.
    pub fn girth(&self, chainage: f64, angle: f64) -> f64 {
        let (row, next, blend) = self.row(chainage);
        let (k, t) = column(angle.clamp(-PI, PI));
        let at = |row: usize| {
            let g = &self.girth[row * (COLUMNS + 1)..(row + 1) * (COLUMNS + 1)];
            if k == COLUMNS { g[COLUMNS] } else { g[k] * (1.0 - t) + g[k + 1] * t }
        };
        at(row) * (1.0 - blend) + at(next) * blend
    }

    /// The angle in `[-pi, pi]` with a given girth: the inverse of [`Self::girth`]; clamped beyond the invert.
    pub fn angle_of_girth(&self, chainage: f64, girth: f64) -> f64 {
        let (row, next, blend) = self.row(chainage);
        let at = |k: usize| {
            self.girth[row * (COLUMNS + 1) + k] * (1.0 - blend) + self.girth[next * (COLUMNS + 1) + k] * blend
        };
        let (mut low, mut high) = (0, COLUMNS);
        while high - low > 1 {
            let middle = (low + high) / 2;
            if at(middle) <= girth { low = middle } else { high = middle }
        }
        let (a, b) = (at(low), at(high));
        angle_of_column(low as f64 + ((girth - a) / (b - a)).clamp(0.0, 1.0))
    }

    /// Girth range `(left, right)` of the section: the girth of the invert reached over the left (negative) and the
    /// right wall, metres.
    pub fn girth_range(&self, chainage: f64) -> (f64, f64) {
        (self.girth(chainage, -PI), self.girth(chainage, PI))
    }

    /// Perimeter of the section in metres.
    pub fn perimeter(&self, chainage: f64) -> f64 {
        let (left, right) = self.girth_range(chainage);
        right - left
    }

    /// Mean perimeter over the tunnel in metres.
    pub fn mean_perimeter(&self) -> f64 {
        let sum: f64 =
            (0..self.rows).map(|row| self.girth[row * (COLUMNS + 1) + COLUMNS] - self.girth[row * (COLUMNS + 1)]).sum();
        sum / self.rows as f64
    }

    /// Enclosed area of the section in square metres.
    pub fn area(&self, chainage: f64) -> f64 {
        let wedge = (TAU / COLUMNS as f64).sin() / 2.0;
        (0..COLUMNS)
            .map(|k| {
                self.radius(chainage, angle_of_column(k as f64))
                    * self.radius(chainage, angle_of_column(k as f64 + 1.0))
                    * wedge
            })
            .sum()
    }

    /// Whether points were seen near this place of the section; elsewhere the radius is bridged.
    pub fn is_observed(&self, chainage: f64, angle: f64) -> bool {
        let (row, next, blend) = self.row(chainage);
        let (k, t) = column(angle);
        let row = if blend < 0.5 { row } else { next };
        self.observed[row * COLUMNS + (k + usize::from(t >= 0.5)) % COLUMNS]
    }

    /// Share of the grid that was bridged over gaps, 0 to 1.
    pub fn bridged_share(&self) -> f64 {
        self.observed.iter().filter(|o| !**o).count() as f64 / self.observed.len() as f64
    }

    /// Local position of the mean section at a chainage and girth.
    pub fn point_at(&self, axis: &Axis, chainage: f64, girth: f64) -> Vec3 {
        let angle = self.angle_of_girth(chainage, girth);
        axis.point_at(&AxisCoordinates::from_polar(chainage, angle, self.radius(chainage, angle)))
    }

    /// Rows around a chainage and the weight of the second.
    fn row(&self, chainage: f64) -> (usize, usize, f64) {
        let position = ((chainage - self.start) / self.step - 0.5).clamp(0.0, (self.rows - 1) as f64);
        let row = (position as usize).min(self.rows - 1);
        (row, (row + 1).min(self.rows - 1), position - row as f64)
    }
}

fn angle_of_column(k: f64) -> f64 {
    -PI + k * TAU / COLUMNS as f64
}

/// Column at or below an angle and the rest, 0 to 1; the column is `COLUMNS` only for exactly `+pi`.
fn column(angle: f64) -> (usize, f64) {
    let position = (angle + PI) / TAU * COLUMNS as f64;
    if position == COLUMNS as f64 {
        return (COLUMNS, 0.0);
    }
    let position = position.rem_euclid(COLUMNS as f64);
    let k = (position as usize).min(COLUMNS - 1);
    (k, position - k as f64)
}

/// Median radius of each raw cell (`rows x COLUMNS / MEDIAN_COLUMNS`); NaN where no point lies.
fn raw_medians(points: &[AxisCoordinates], low: f64, step: f64, rows: usize) -> Vec<f64> {
    let columns = COLUMNS / MEDIAN_COLUMNS;
    let cell: Vec<u32> = points
        .par_iter()
        .map(|p| {
            let row = (((p.chainage - low) / step) as usize).min(rows - 1);
            // Raw columns are centred on every second node.
            let k = ((p.angle() + PI) / TAU * columns as f64).round() as usize % columns;
            (row * columns + k) as u32
        })
        .collect();
    let mut start = vec![0u32; rows * columns + 1];
    cell.iter().for_each(|&c| start[c as usize + 1] += 1);
    for c in 0..rows * columns {
        start[c + 1] += start[c];
    }
    let mut cursor = start.clone();
    let mut values = vec![0.0; points.len()];
    for (p, &c) in points.iter().zip(&cell) {
        values[cursor[c as usize] as usize] = p.radius();
        cursor[c as usize] += 1;
    }
    (0..rows * columns)
        .into_par_iter()
        .map(|c| {
            let mut cell = values[start[c] as usize..start[c + 1] as usize].to_vec();
            statistics::median(&mut cell).unwrap_or(f64::NAN)
        })
        .collect()
}

/// First and last row that look like a tunnel: enough directions hold points, and at least `typical` of what the median
/// row has.
fn tunnel_rows(raw: &[f64], rows: usize, typical: f64) -> Result<(usize, usize), Error> {
    const SECTORS: usize = 36;
    let columns = COLUMNS / MEDIAN_COLUMNS;
    let share = |row: usize| {
        let mut seen = [false; SECTORS];
        for k in 0..columns {
            seen[k * SECTORS / columns] |= !raw[row * columns + k].is_nan();
        }
        seen.iter().filter(|s| **s).count() as f64 / SECTORS as f64
    };
    let shares: Vec<f64> = (0..rows).map(share).collect();
    let wanted = MIN_SECTOR_SHARE.max(typical * statistics::median(&mut shares.clone()).unwrap_or(0.0));
    let first = shares.iter().position(|&s| s >= wanted);
    let last = shares.iter().rposition(|&s| s >= wanted);
    match (first, last) {
        (Some(first), Some(last)) => Ok((first, last)),
        _ => Err(Error::NotSurrounded { percent: 100.0 * shares.iter().copied().fold(0.0, f64::max) }),
    }
}

/// Median of each cell's surroundings along the tunnel, `reach` rows on both sides; NaN where nothing is known.
fn medians_around(raw: &[f64], rows: usize, reach: usize) -> Vec<f64> {
    let columns = COLUMNS / MEDIAN_COLUMNS;
    (0..rows * columns)
        .into_par_iter()
        .map(|cell| {
            let (row, k) = (cell / columns, cell % columns);
            if raw[cell].is_nan() {
                return f64::NAN;
            }
            let mut around: Vec<f64> = (row.saturating_sub(reach)..(row + reach + 1).min(rows))
                .flat_map(|i| (0..3).map(move |d| i * columns + (k + columns + d - 1) % columns))
                .map(|c| raw[c])
                .filter(|v| !v.is_nan())
                .collect();
            statistics::median(&mut around).unwrap_or(f64::NAN)
        })
        .collect()
}

/// Sets cells to NaN that lie far from the median of their surroundings along the tunnel: outliers, side openings, and
/// what the scanner saw beyond the portals.
fn reject_isolated(raw: &mut [f64], rows: usize) {
    let medians = medians_around(raw, rows, REJECT_ROWS);
    for (value, middle) in raw.iter_mut().zip(medians) {
        if (*value - middle).abs() > REJECT_SHARE * middle {
            *value = f64::NAN;
        }
    }
}

/// Sets the cells of side rooms and crosscuts to NaN, which are too long for [`reject_isolated`]: connected cells far
/// behind the walls before and after them, on one side of the tunnel only, whose wall steps back at once. Where a cave
/// widens into an alcove the wall does so by and by, and a chamber widens all around.
fn reject_side_rooms(raw: &mut [f64], rows: usize, mean_radius: f64) {
    let columns = COLUMNS / MEDIAN_COLUMNS;
    let medians = medians_around(raw, rows, ROOM_ROWS);
    let mut far: Vec<bool> = raw.iter().zip(&medians).map(|(r, m)| *r > (1.0 + REJECT_SHARE) * m).collect();
    for start in 0..far.len() {
        if !std::mem::replace(&mut far[start], false) {
            continue;
        }
        let mut room = vec![start];
        let mut done = 0;
        while done < room.len() {
            let (i, k) = (room[done] / columns, room[done] % columns);
            done += 1;
            // Shadows are narrow; over a gap of one cell a room goes on.
            for row in i.saturating_sub(2)..(i + 3).min(rows) {
                for d in 0..5 {
                    let cell = row * columns + (k + columns + d - 2) % columns;
                    if std::mem::replace(&mut far[cell], false) {
                        room.push(cell);
                    }
                }
            }
        }
        let mut directions = vec![false; columns];
        room.iter().for_each(|cell| directions[cell % columns] = true);
        let directions = directions.iter().filter(|d| **d).count();
        if directions as f64 <= ROOM_DIRECTIONS * columns as f64
            && has_cheeks(raw, rows, &mut room, CHEEK_IN_RADII * mean_radius)
        {
            room.iter().for_each(|&cell| raw[cell] = f64::NAN);
        }
    }
}

/// Whether the radius jumps by `step_m` within two rows at enough of the ends of a room along the tunnel.
fn has_cheeks(raw: &[f64], rows: usize, room: &mut [usize], step_m: f64) -> bool {
    let columns = COLUMNS / MEDIAN_COLUMNS;
    room.sort_unstable_by_key(|cell| (cell % columns, cell / columns));
    let (mut ends, mut cheeks) = (0_u32, 0_u32);
    let mut judge = |row: usize, column: usize, outwards: isize| {
        let at = |steps: isize| {
            let i = row as isize + steps * outwards;
            (0..rows as isize).contains(&i).then(|| raw[i as usize * columns + column]).filter(|r| !r.is_nan())
        };
        let Some(outside) = at(1).or(at(2)) else { return };
        let inside = at(0).unwrap_or(outside).max(at(-1).unwrap_or(outside));
        ends += 1;
        cheeks += u32::from(inside - outside > step_m);
    };
    for of_column in room.chunk_by(|a, b| a % columns == b % columns) {
        let column = of_column[0] % columns;
        judge(of_column[0] / columns, column, -1);
        judge(of_column[of_column.len() - 1] / columns, column, 1);
    }
    ends > 0 && f64::from(cheeks) >= CHEEK_SHARE * f64::from(ends)
}

/// Normalised convolution from coarse to fine; returns the radius and whether the cell had points, `rows x COLUMNS`.
fn smooth(raw: &[f64], rows: usize, sigma_rows: f64, mean_radius: f64) -> (Vec<f64>, Vec<bool>) {
    let raw_columns = COLUMNS / MEDIAN_COLUMNS;
    let mut value = vec![0.0; rows * COLUMNS];
    let mut weight = vec![0.0; rows * COLUMNS];
    let mut observed = vec![false; rows * COLUMNS];
    for row in 0..rows {
        for k in 0..raw_columns {
            let r = raw[row * raw_columns + k];
            if r.is_nan() {
                continue;
            }
            let cell = row * COLUMNS + k * MEDIAN_COLUMNS;
            value[cell] = r;
            weight[cell] = 1.0;
            for d in 0..3 {
                observed[row * COLUMNS + (k * MEDIAN_COLUMNS + COLUMNS + d - 1) % COLUMNS] = true;
            }
        }
    }
    let sigma_columns = SIGMA_ANGLE / TAU * COLUMNS as f64;
    let mut radius = vec![mean_radius; rows * COLUMNS];
    // From sigma x 16 down to sigma; the wider average is worth a hundredth of a point.
    for level in (0..5).rev() {
        let factor = f64::from(1 << level);
        let mut sum: Vec<f64> = value.iter().zip(&weight).map(|(v, w)| v * w).collect();
        let mut total = weight.clone();
        for field in [&mut sum, &mut total] {
            blur_rows(field, rows, sigma_rows * factor);
            blur_columns(field, sigma_columns * factor);
        }
        // One isolated cell of weight 1 blurs to this much at its centre.
        let peak = 1.0 / (TAU * (sigma_rows * factor).max(0.4) * sigma_columns * factor);
        for ((r, s), t) in radius.iter_mut().zip(&sum).zip(&total) {
            let prior = 0.01 * peak;
            *r = (s + prior * *r) / (t + prior);
        }
    }
    (radius, observed)
}

fn kernel(sigma: f64) -> Vec<f64> {
    let half = (3.0 * sigma).ceil() as usize;
    let weights: Vec<f64> = (0..=2 * half).map(|i| (-0.5 * ((i as f64 - half as f64) / sigma).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    weights.into_iter().map(|w| w / sum).collect()
}

/// Gaussian blur along the chainage; nothing lies beyond the ends.
fn blur_rows(field: &mut [f64], rows: usize, sigma: f64) {
    let kernel = kernel(sigma);
    let half = kernel.len() / 2;
    let before = field.to_vec();
    field.par_chunks_mut(COLUMNS).enumerate().for_each(|(row, out)| {
        out.fill(0.0);
        for other in row.saturating_sub(half)..(row + half + 1).min(rows) {
            let w = kernel[other + half - row];
            for (o, b) in out.iter_mut().zip(&before[other * COLUMNS..(other + 1) * COLUMNS]) {
                *o += w * b;
            }
        }
    });
}

/// Gaussian blur around the section (periodic).
fn blur_columns(field: &mut [f64], sigma: f64) {
    let kernel = kernel(sigma.min(COLUMNS as f64 / 8.0));
    let half = kernel.len() / 2;
    field.par_chunks_mut(COLUMNS).for_each(|row| {
        let before = row.to_vec();
        for (k, out) in row.iter_mut().enumerate() {
            *out = kernel.iter().enumerate().map(|(i, w)| w * before[(k + COLUMNS * 2 + i - half) % COLUMNS]).sum();
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of a section `r(angle)` between chainage 0 and `length`, with deterministic scatter.
    fn points(length: f64, r: impl Fn(f64) -> f64) -> Vec<AxisCoordinates> {
        (0..60_000u32)
            .map(|i| {
                // Two irrational strides cover the (chainage, angle) plane evenly.
                let s = length * (f64::from(i) * 0.618_033_988_749_895).fract();
                let a = TAU * (f64::from(i) * 0.754_877_666_246_693).fract() - PI;
                AxisCoordinates::from_polar(s, a, r(a))
            })
            .collect()
    }

    #[test]
    fn a_circle_has_its_girth() {
        let field = SectionField::estimate(&points(20.0, |_| 3.0), 0.0).unwrap();
        for a in [-PI, -1.0, 0.0, 0.3, 2.0, PI] {
            assert!((field.radius(10.0, a) - 3.0).abs() < 1e-9);
            // The polygon of 360 chords is shorter than the circle by 1.3e-5.
            assert!((field.girth(10.0, a) - 3.0 * a).abs() < 2e-4, "{a}");
            assert!((field.angle_of_girth(10.0, field.girth(10.0, a)) - a).abs() < 1e-12);
        }
        assert!((field.perimeter(3.0) - 6.0 * PI).abs() < 1e-3);
        assert!((field.area(3.0) - 9.0 * PI).abs() < 2e-3);
        assert!(field.bridged_share() < 0.05 && field.is_observed(10.0, 1.0));
    }

    #[test]
    fn outliers_and_a_gap_do_not_dent_the_section() {
        // An ellipse with a blind sector at the invert and every tenth point far away.
        let ellipse = |a: f64| 1.0 / ((a.sin() / 4.0).powi(2) + (a.cos() / 3.0).powi(2)).sqrt();
        let mut cloud = points(30.0, ellipse);
        cloud.retain(|p| p.angle().abs() < PI - 0.15);
        for (i, p) in cloud.iter_mut().enumerate() {
            if i % 10 == 0 {
                *p = AxisCoordinates::from_polar(p.chainage, p.angle(), p.radius() * 2.5);
            }
        }
        let field = SectionField::estimate(&cloud, 0.0).unwrap();
        for k in 0..36 {
            let a = f64::from(k) * TAU / 36.0 - PI;
            assert!((field.radius(15.0, a) - ellipse(a)).abs() < 0.06, "{a}: {}", field.radius(15.0, a));
        }
        assert!(!field.is_observed(15.0, PI) && field.is_observed(15.0, 0.0));
        assert!(field.bridged_share() > 0.03);
    }

    #[test]
    fn the_tunnel_ends_where_nothing_surrounds_the_axis() {
        let mut cloud = points(20.0, |_| 3.0);
        // A wall in front of the portal.
        cloud.extend((0..2000).map(|i| AxisCoordinates { chainage: 20.0 + f64::from(i) * 0.005, right: 2.0, up: 1.0 }));
        let field = SectionField::estimate(&cloud, 0.0).unwrap();
        assert!((field.end() - 20.0).abs() < 2.0 * field.step() && field.start().abs() < 1e-2, "{}", field.end());
        let flat: Vec<_> = (0..999).map(|i| AxisCoordinates { chainage: f64::from(i), right: 3.0, up: 0.1 }).collect();
        assert!(matches!(SectionField::estimate(&flat, 0.0), Err(Error::NotSurrounded { .. })));
        assert_eq!(SectionField::estimate(&[], 0.0).unwrap_err(), Error::Empty);
    }

    /// Points of a tunnel of 1.6 m radius whose radius is `r(chainage, angle)` where that is more.
    fn widened(r: impl Fn(f64, f64) -> f64) -> SectionField {
        let points: Vec<AxisCoordinates> = points(40.0, |_| 1.6)
            .iter()
            .map(|c| AxisCoordinates::from_polar(c.chainage, c.angle(), r(c.chainage, c.angle()).max(1.6)))
            .collect();
        SectionField::estimate(&points, 0.0).unwrap()
    }

    #[test]
    fn a_room_wider_than_the_tunnel_does_not_dent_the_section() {
        // A room of 4.4 m on the left, two thirds of the wall high, 6 m deep.
        let left = |s: f64, a: f64| (s - 20.0).abs() < 2.2 && (-2.4..-0.7).contains(&a);
        let field = widened(|s, a| if left(s, a) { (6.0 / a.sin().abs()).min(7.0) } else { 0.0 });
        for s in [17.0, 18.5, 20.0, 21.9, 23.0] {
            for a in [-2.0, -1.57, -1.0, 0.0, 1.57] {
                assert!((field.radius(s, a) - 1.6).abs() < 0.15, "{s} {a}: {}", field.radius(s, a));
            }
        }
    }

    #[test]
    fn a_cave_that_widens_keeps_its_shape() {
        let swell = |s: f64| 1.6 + 1.4 * (-((s - 20.0) / 2.5).powi(2)).exp();
        // All around, and on one side.
        let chamber = widened(|s, _| swell(s));
        let alcove = widened(|s, a| if (-2.4..-0.7).contains(&a) { swell(s) } else { 0.0 });
        for field in [chamber, alcove] {
            assert!(field.radius(20.0, -1.57) > 2.7, "{}", field.radius(20.0, -1.57));
        }
    }

    #[test]
    fn a_uniform_field_is_its_formula() {
        let field = SectionField::uniform(5.0, 25.0, |a| 2.0 + 0.1 * a.cos());
        assert!((field.start() - 5.0).abs() < 1e-12 && (field.end() - 25.0).abs() < 1e-12);
        assert!((field.radius(7.0, 0.0) - 2.1).abs() < 1e-12 && (field.radius(7.0, PI) - 1.9).abs() < 1e-12);
    }
}
