//! Finds the floor: the flat, level part of the section below the axis, from one wall foot to the other.
//!
//! In windows along the tunnel the depth picture gives a cross profile. From its lowest part the floor grows to both
//! sides as long as the profile stays level; it counts as a floor when it is wide and straight, so that the invert of a
//! round sewer or a shaft has none. The feet are smoothed along the tunnel by a running median. Cost: linear in cells.

use super::SectionField;
use super::unrolled_grid::Grid;
use crate::numeric::statistics;

/// Length of tunnel that shares one cross profile, metres.
const WINDOW_M: f64 = 1.0;
/// Steepest side slope of a floor over [`BASE_M`] (35 degrees).
const LEVEL: f64 = 0.7;
/// Distance over which the slope of the profile is taken, metres.
const BASE_M: f64 = 0.35;
/// A floor is at least this wide, as a share of the section's width.
const MIN_WIDTH_SHARE: f64 = 0.3;
/// A floor's rms distance from its straight line is at most this share of its width (a 90 degree arc has 6 %).
const MAX_BEND_SHARE: f64 = 0.035;
/// The tunnel has a floor when this share of the windows has one.
const MIN_WINDOWS: f64 = 0.5;
/// Windows on both sides whose median smooths the feet.
const MEDIAN_REACH: usize = 3;

/// The feet of the walls along the tunnel.
#[derive(Clone, Debug)]
pub struct Floor {
    start: f64,
    window: f64,
    /// Girth of the left (negative) and right foot in each window, metres.
    feet: Vec<[f64; 2]>,
}

impl Floor {
    /// Girth of the left (negative) and right wall foot at a chainage; beyond them, towards the invert, lies the floor.
    pub fn feet(&self, chainage: f64) -> [f64; 2] {
        let position = ((chainage - self.start) / self.window - 0.5).clamp(0.0, (self.feet.len() - 1) as f64);
        let k = (position as usize).min(self.feet.len() - 1);
        let (a, b) = (self.feet[k], self.feet[(k + 1).min(self.feet.len() - 1)]);
        let t = position - k as f64;
        [a[0] * (1.0 - t) + b[0] * t, a[1] * (1.0 - t) + b[1] * t]
    }

    /// What makes the same floor again with [`Self::from_columns`]: first chainage, window length, feet, metres.
    pub fn columns(&self) -> ([f64; 2], &[[f64; 2]]) {
        ([self.start, self.window], &self.feet)
    }

    /// A floor from what [`Self::columns`] gave; `None` without feet.
    pub fn from_columns([start, window]: [f64; 2], feet: Vec<[f64; 2]>) -> Option<Self> {
        (!feet.is_empty() && window > 0.0).then_some(Self { start, window, feet })
    }

    /// The same feet in the girth of another mean section around the same axis.
    pub(super) fn on(mut self, from: &SectionField, to: &SectionField) -> Self {
        for (k, feet) in self.feet.iter_mut().enumerate() {
            let chainage = self.start + (k as f64 + 0.5) * self.window;
            *feet = feet.map(|g| to.girth(chainage, from.angle_of_girth(chainage, g)));
        }
        self
    }

    /// Whether a place of the section belongs to the floor.
    pub fn contains(&self, chainage: f64, girth: f64) -> bool {
        let [left, right] = self.feet(chainage);
        girth < left || girth > right
    }
}

/// The floor of a depth picture (`depth`: metres behind the mean section for each cell, NaN where nothing is known).
pub(super) fn find(grid: &Grid, section: &SectionField, depth: &[f64]) -> Option<Floor> {
    let windows = ((grid.rows as f64 * grid.row_m / WINDOW_M).round() as usize).clamp(1, grid.rows);
    let window = grid.rows as f64 * grid.row_m / windows as f64;
    let found: Vec<Option<[f64; 2]>> = (0..windows)
        .map(|w| {
            let rows = w * grid.rows / windows..((w + 1) * grid.rows / windows).max(w * grid.rows / windows + 1);
            let chainage = grid.start + (w as f64 + 0.5) * window;
            feet_of_window(grid, section, depth, rows, chainage)
        })
        .collect();
    let seen = found.iter().flatten().count();
    if (seen as f64) < MIN_WINDOWS * windows as f64 {
        return None;
    }
    let feet = (0..windows)
        .map(|w| {
            let mut reach = MEDIAN_REACH;
            loop {
                let near = &found[w.saturating_sub(reach)..(w + reach + 1).min(windows)];
                let mut left: Vec<f64> = near.iter().flatten().map(|f| f[0]).collect();
                let mut right: Vec<f64> = near.iter().flatten().map(|f| f[1]).collect();
                if let (Some(l), Some(r)) = (statistics::median(&mut left), statistics::median(&mut right)) {
                    return [l, r];
                }
                reach *= 2; // Ends: some window has a floor.
            }
        })
        .collect();
    Some(Floor { start: grid.start, window, feet })
}

/// Girths of both feet in one window, if its lower part is a floor.
fn feet_of_window(
    grid: &Grid,
    section: &SectionField,
    depth: &[f64],
    rows: std::ops::Range<usize>,
    chainage: f64,
) -> Option<[f64; 2]> {
    let columns = grid.columns;
    let (left, right) = section.girth_range(chainage);
    // The profile as (right, up, girth), starting at the crown's opposite and once around; NaN where unknown.
    let place = |j: usize| -> Option<[f64; 3]> {
        let mut values: Vec<f64> = rows.clone().map(|i| depth[i * columns + j]).filter(|d| !d.is_nan()).collect();
        let d = statistics::median(&mut values)?;
        let girth = left + (right - left) * (j as f64 + 0.5) / columns as f64;
        let angle = section.angle_of_girth(chainage, girth);
        let radius = section.radius(chainage, angle) + d;
        Some([radius * angle.sin(), radius * angle.cos(), girth])
    };
    let profile: Vec<Option<[f64; 3]>> = (0..columns).map(place).collect();
    let known = profile.iter().flatten();
    let (low, high) = known.clone().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(p[1]), h.max(p[1])));
    let width = known.clone().map(|p| p[0].abs()).fold(0.0, f64::max) * 2.0;
    if known.count() < columns / 4 || low > -0.1 * (high - low) {
        return None;
    }
    // Walk from the invert (column 0 going up is the left side, the last column going down the right side).
    let base = ((BASE_M.min(0.15 * width) / grid.column_m).round() as usize).max(2);
    let walk = |side: usize| -> Option<usize> {
        let column = |k: usize| if side == 0 { k } else { columns - 1 - k };
        let mut reached = None;
        let mut k = 0;
        while k + base < columns / 2 {
            let (here, ahead) = (profile[column(k)], profile[column(k + base)]);
            if let (Some(a), Some(b)) = (here, ahead) {
                let (run, rise) = ((b[0] - a[0]).abs(), (b[1] - a[1]).abs());
                if a[1] > 0.0 || b[1] > a[1] && rise > LEVEL * run {
                    // The foot is where the rise begins inside the base: the lowest turn of the two chords.
                    return Some(k + sharpest(&profile, column, k, base));
                }
                reached = Some(k + base);
            }
            k += 1;
        }
        reached
    };
    let (a, b) = (walk(0)?, walk(1)?);
    if a + b < 4 || a + b >= columns {
        return None;
    }
    let floor: Vec<[f64; 2]> =
        (0..a).chain(columns - b..columns).filter_map(|j| profile[j].map(|p| [p[0], p[1]])).collect();
    let n = floor.len() as f64;
    if floor.len() < 4 {
        return None;
    }
    let (mx, my) = floor.iter().fold((0.0, 0.0), |(x, y), p| (x + p[0] / n, y + p[1] / n));
    let (sxx, sxy) =
        floor.iter().fold((0.0, 0.0), |(xx, xy), p| (xx + (p[0] - mx).powi(2), xy + (p[0] - mx) * (p[1] - my)));
    let slope = if sxx > 0.0 { sxy / sxx } else { 0.0 };
    let rms = (floor.iter().map(|p| (p[1] - my - slope * (p[0] - mx)).powi(2)).sum::<f64>() / n).sqrt();
    let (low, high) = floor.iter().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(p[0]), h.max(p[0])));
    let wide = high - low;
    if wide < MIN_WIDTH_SHARE * width || rms > MAX_BEND_SHARE * wide || slope.abs() > LEVEL {
        return None;
    }
    let step = (right - left) / columns as f64;
    let coarse = [left + a as f64 * step, right - b as f64 * step];
    // Where the line of the floor meets the line of the wall: finer than a cell, and the corner of the mean section is
    // rounded.
    let corner = |side: usize| -> Option<f64> {
        let column = |k: usize| if side == 0 { k } else { columns - 1 - k };
        let reach = if side == 0 { a } else { b };
        let middle = mx + 0.5 * if side == 0 { low - mx } else { high - mx };
        let beside: Vec<[f64; 2]> = (0..reach.saturating_sub((CORNER_M / step) as usize))
            .filter_map(|k| profile[column(k)].map(|p| [p[0], p[1]]))
            .filter(|p| (p[0] - middle).abs() <= 0.5 * (high - low))
            .collect();
        let floor_line = line(&beside)?;
        let above = |p: &[f64; 3]| p[1] - (floor_line[0] + floor_line[1] * p[0]);
        let wall: Vec<[f64; 2]> = (reach.saturating_sub(2)..columns / 2)
            .filter_map(|k| profile[column(k)])
            .take_while(|p| above(p) <= FOOT_WALL_M[1])
            .filter(|p| above(p) >= FOOT_WALL_M[0])
            .map(|p| [p[1], p[0]])
            .collect();
        let wall_line = line(&wall)?;
        // up = f0 + f1 x, x = w0 + w1 up
        let divisor = 1.0 - floor_line[1] * wall_line[1];
        let x = (wall_line[0] + wall_line[1] * floor_line[0]) / divisor;
        let up = floor_line[0] + floor_line[1] * x;
        let near = (divisor.abs() > 0.2).then(|| section.girth(chainage, x.atan2(up)))?;
        ((near - coarse[side]).abs() <= FURTHEST_CORRECTION_M).then_some(near)
    };
    Some([0, 1].map(|side| corner(side).unwrap_or(coarse[side])))
}

/// The floor's line is taken from what lies farther than this from the coarse foot, metres.
const CORNER_M: f64 = 0.2;
/// The wall's line is taken from what lies between these heights over the floor, metres.
const FOOT_WALL_M: [f64; 2] = [0.08, 0.6];
/// A corner farther than this from the coarse foot is not that of wall and floor, metres.
const FURTHEST_CORRECTION_M: f64 = 0.35;

/// The line `y = l0 + l1 x` of least squares through points (x, y); `None` for fewer than three, or all at one x.
fn line(points: &[[f64; 2]]) -> Option<[f64; 2]> {
    let n = points.len() as f64;
    if points.len() < 3 {
        return None;
    }
    let (mx, my) = points.iter().fold((0.0, 0.0), |(x, y), p| (x + p[0] / n, y + p[1] / n));
    let (sxx, sxy) =
        points.iter().fold((0.0, 0.0), |(xx, xy), p| (xx + (p[0] - mx).powi(2), xy + (p[0] - mx) * (p[1] - my)));
    (sxx > 0.0).then(|| [my - sxy / sxx * mx, sxy / sxx])
}

/// Columns after `from` at which the profile turns most, between 0 and `base`.
fn sharpest(profile: &[Option<[f64; 3]>], column: impl Fn(usize) -> usize, from: usize, base: usize) -> usize {
    let (Some(a), Some(b)) = (profile[column(from)], profile[column(from + base)]) else { return base / 2 };
    let (x, y) = (b[0] - a[0], b[1] - a[1]);
    let mut best = (0.0, 0);
    for k in 0..=base {
        let Some(p) = profile[column(from + k)] else { continue };
        // Distance below the chord.
        let off = ((p[0] - a[0]) * y - (p[1] - a[1]) * x).abs();
        if off > best.0 {
            best = (off, k);
        }
    }
    best.1
}
