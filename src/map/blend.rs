//! Values of scattered scan points, made continuous on the pixels of a tile.
//!
//! When to use: colour and intensity (averaged over all points of a pixel's neighbourhood) and labels (taken from the
//! nearest point, never mixed).
//!
//! References: H. Knutsson and C.-F. Westin, "Normalized and differential convolution", CVPR 1993,
//! doi:10.1109/CVPR.1993.341081 (weighted mean with certainty); S. J. Gortler et al., "The lumigraph", SIGGRAPH 1996,
//! doi:10.1145/237170.237200 (pull-push into gaps, saturating weights); P. F. Felzenszwalb and D. P. Huttenlocher,
//! "Distance transforms of sampled functions", Theory of Computing 8, 2012, doi:10.4086/toc.2012.v008a019.
//!
//! | symbol | meaning |
//! |---|---|
//! | a, b | half axes of a point's kernel along u and v: [`KERNEL_SPACINGS`] local spacings, at least [`KERNEL_MIN_PX`] pixels |
//! | w | kernel (1 - (du/a)^2 - (dv/b)^2)^3, zero outside: smooth to second order, no exponential |
//! | c | certainty of a pixel, min(1, sum of w / [`FULL_CERTAINTY`]) |
//!
//! Guarantees: values lie between those of the points used; the value of a pixel does not depend on how the map is cut
//! into tiles; sums run in a fixed order. Weights and sums are `f32`: they hold colours (16 bit), not positions.
//!
//! Departure: kernels and pyramid are stretched by the spacing of the scan, so that half a metre between profiles is
//! bridged along the tunnel without smearing the four millimetres along the profile.
//!
//! Cost: O(points x kernel area in pixels) + O(pixels).

use super::grid::{Grid, PixelRect};
use super::sampling::{ScatterIndex, Spacing};
use crate::cloud::{Cloud, Label};
use crate::numeric::Vec2;
use rayon::prelude::*;

/// Half axis of the kernel in local point spacings; the weight has a standard deviation of a third of it.
const KERNEL_SPACINGS: f64 = 1.6;
/// Half axis of the kernel in pixels where points are dense.
const KERNEL_MIN_PX: f64 = 1.5;
/// Sum of weights from which a pixel needs no help from its neighbourhood.
const FULL_CERTAINTY: f32 = 0.1;
/// A pixel counts as observed up to this many local spacings from the nearest point.
const OBSERVED_SPACINGS: f64 = 2.0;
/// ... and always up to this many pixels.
const OBSERVED_MIN_PX: f64 = 1.5;
/// The local spacing counts for squares of so many pixels.
const SPACING_PX: usize = 8;
/// Automatic filling distance in typical spacings, and its bounds in metres.
const FILL_SPACINGS: f64 = 4.0;
const FILL_BOUNDS_M: (f64, f64) = (0.05, 1.0);

/// How far colours and labels reach, resolved for one map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach {
    /// Half axes of the ellipse around a pixel in which a scan point must lie for the pixel to be filled, metres.
    pub fill_m: [f64; 2],
    /// Typical spacing along u and v, metres: the metric of "nearest".
    pub spacing_m: [f64; 2],
    /// Greatest kernel half axes, metres.
    kernel_m: [f64; 2],
}

impl Reach {
    /// From the spacing of the scan and the filling distance (`None`: four spacings in each direction, 0.05 to 1 m).
    pub fn new(spacing: &Spacing, fill_m: Option<f64>, cell_m: f64) -> Self {
        let automatic = spacing.typical.map(|s| (FILL_SPACINGS * s).clamp(FILL_BOUNDS_M.0, FILL_BOUNDS_M.1));
        let kernel_m = spacing.greatest().map(|s| (KERNEL_SPACINGS * s).max(KERNEL_MIN_PX * cell_m));
        Self { fill_m: fill_m.map_or(automatic, |f| [f; 2]), spacing_m: spacing.typical, kernel_m }
    }
}

/// How well the nearest point supports a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Support {
    /// No scan point within the filling distance.
    None,
    /// Interpolated over a gap.
    Filled,
    /// A scan point is as near as the sampling of the scan lets expect.
    Observed,
}

/// Blended values on the pixels of a rectangle; a column is empty when the cloud does not have the attribute.
#[derive(Debug)]
pub struct BlendedTile {
    /// Support of each pixel.
    pub support: Vec<Support>,
    /// Red, green, blue in the 16-bit range, NaN where nothing is near.
    pub colors: Vec<[f32; 3]>,
    /// Intensity in the 16-bit range, NaN where nothing is near.
    pub intensities: Vec<f32>,
    /// Label of the nearest point; 0 where nothing is near.
    pub labels: Vec<Label>,
}

/// The points that colour the map, with their attributes in the order of the index.
#[derive(Debug)]
pub struct Scatter {
    /// Points on the surface, sorted.
    pub index: ScatterIndex,
    /// Their spacing.
    pub spacing: Spacing,
    /// Red, green, blue, intensity; empty with neither colours nor intensities.
    values: Vec<[u16; 4]>,
    labels: Vec<Label>,
    has: Wanted,
}

/// Which attributes of the points are to be drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wanted {
    /// Colours.
    pub colors: bool,
    /// Intensities.
    pub intensities: bool,
    /// Labels.
    pub labels: bool,
}

impl Wanted {
    fn values(self) -> bool {
        self.colors || self.intensities
    }

    fn and(self, other: Self) -> Self {
        Self {
            colors: self.colors && other.colors,
            intensities: self.intensities && other.intensities,
            labels: self.labels && other.labels,
        }
    }
}

impl Scatter {
    /// Gathers the attributes of the points in the index; those that the cloud does not have are not drawn.
    pub fn new(index: ScatterIndex, spacing: Spacing, cloud: &Cloud, wanted: Wanted) -> Self {
        let attributes = cloud.attributes();
        let colors = attributes.colors.as_deref().filter(|_| wanted.colors);
        let intensities = attributes.intensities.as_deref().filter(|_| wanted.intensities);
        let value = |&point: &u32| {
            let [r, g, b] = colors.map_or([0; 3], |c| c[point as usize]);
            [r, g, b, intensities.map_or(0, |i| i[point as usize])]
        };
        let has = Wanted {
            colors: colors.is_some(),
            intensities: intensities.is_some(),
            labels: wanted.labels && attributes.labels.is_some(),
        };
        let values = if has.values() { index.points().par_iter().map(value).collect() } else { Vec::new() };
        let labels = attributes.labels.as_deref().filter(|_| wanted.labels);
        let labels = labels.map_or(Vec::new(), |l| index.points().par_iter().map(|&i| l[i as usize]).collect());
        Self { index, spacing, values, labels, has }
    }
}

/// Weighted sums of the values near each pixel of the surroundings, or their means.
struct Sums {
    /// Red, green, blue, intensity.
    values: Vec<[f32; 4]>,
    weights: Vec<f32>,
}

impl Sums {
    fn new(pixels: usize) -> Self {
        Self { values: vec![[0.0; 4]; pixels], weights: vec![0.0; pixels] }
    }

    /// Turns sums into means; `certainty` makes the weight of a mean from the sum of the weights.
    fn average(&mut self, certainty: impl Fn(f32) -> f32) {
        for (value, weight) in self.values.iter_mut().zip(&mut self.weights).filter(|(_, w)| **w > 0.0) {
            let w = *weight;
            value.iter_mut().for_each(|x| *x /= w);
            *weight = certainty(w);
        }
    }
}

/// The rectangle around a tile in which its points lie; may reach over the edge of the grid.
struct Surroundings {
    column: i64,
    row: i64,
    width: usize,
    height: usize,
    /// Where the tile starts inside.
    inner: (usize, usize),
}

/// An ellipse around a pixel.
struct Ellipse {
    inverse_half_axes: [f64; 2],
}

impl Ellipse {
    fn new(half_axes_px: [f64; 2]) -> Self {
        Self { inverse_half_axes: half_axes_px.map(|a| 1.0 / a) }
    }

    fn holds(&self, (dx, dy): (f64, f64)) -> bool {
        let [a, b] = self.inverse_half_axes;
        (dx * a).powi(2) + (dy * b).powi(2) <= 1.0
    }
}

/// Pull-push reduces by these factors in u and v from level to level.
type Factors = [usize; 2];

/// Blends the `wanted` attributes of the scan points on those pixels of `rect` that are `on_surface`.
pub fn blend(
    scatter: &Scatter,
    wanted: Wanted,
    grid: &Grid,
    reach: &Reach,
    rect: PixelRect,
    on_surface: impl Fn(usize) -> bool,
) -> BlendedTile {
    let drawn = wanted.and(scatter.has);
    let cell = grid.cell_m();
    let pyramid = pyramid_factors(reach, cell);
    let margin = [0, 1].map(|d| ((reach.kernel_m[d].max(reach.fill_m[d]) / cell).ceil() as usize) + 2);
    let has_values = drawn.values();
    let around = if has_values {
        // The pyramid needs room around, aligned so that its cells are the same for every tile.
        let total = pyramid.iter().fold([1, 1], |t: Factors, f| [t[0] * f[0], t[1] * f[1]]);
        Surroundings::aligned(rect, [0, 1].map(|d| margin[d].max(2 * total[d])), total)
    } else {
        Surroundings::new(rect, margin)
    };
    let mut sums = Sums::new(if has_values { around.width * around.height } else { 0 });
    let seeds = splat(scatter, drawn, grid, &around, &mut sums);
    let nearest = nearest_seeds(&seeds, &around, margin, rect, reach, cell);

    let mut support = vec![Support::None; rect.len()];
    let mut needs_filling = false;
    // Squares of the grid, not of the tile: a pixel must not know in which tile it lies.
    let squares = |start: usize, length: usize| (start / SPACING_PX * SPACING_PX..start + length).step_by(SPACING_PX);
    let filled = Ellipse::new(reach.fill_m.map(|f| f / cell));
    for row in squares(rect.row, rect.height) {
        for column in squares(rect.column, rect.width) {
            let centre = Vec2::new(column as f64, row as f64).add_scalar(0.5 * SPACING_PX as f64);
            let spacing = scatter.spacing.at(grid.chart_from_pixel(centre));
            let observed = Ellipse::new(spacing.map(|s| (OBSERVED_SPACINGS * s / cell).max(OBSERVED_MIN_PX)));
            for y in row.max(rect.row) - rect.row..(row + SPACING_PX - rect.row).min(rect.height) {
                for x in column.max(rect.column) - rect.column..(column + SPACING_PX - rect.column).min(rect.width) {
                    let i = y * rect.width + x;
                    let Some(offset) = nearest.offset(x, y).filter(|_| on_surface(i)) else { continue };
                    support[i] = if observed.holds(offset) {
                        Support::Observed
                    } else if filled.holds(offset) {
                        Support::Filled
                    } else {
                        continue;
                    };
                    needs_filling |= has_values && sums.weights[around.inside(x, y)] < FULL_CERTAINTY;
                }
            }
        }
    }
    if needs_filling {
        pull_push(&mut sums, around.width, around.height, &pyramid);
    } else {
        sums.average(|_| 1.0);
    }
    collect(drawn, rect, &around, &sums, support, &nearest, &seeds)
}

impl Surroundings {
    /// Where pixel (x, y) of the tile lies in the surroundings.
    fn inside(&self, x: usize, y: usize) -> usize {
        (y + self.inner.1) * self.width + x + self.inner.0
    }

    fn new(rect: PixelRect, margin: [usize; 2]) -> Self {
        Self {
            column: rect.column as i64 - margin[0] as i64,
            row: rect.row as i64 - margin[1] as i64,
            width: rect.width + 2 * margin[0],
            height: rect.height + 2 * margin[1],
            inner: (margin[0], margin[1]),
        }
    }

    fn aligned(rect: PixelRect, margin: [usize; 2], align: Factors) -> Self {
        let start = |x: usize, d: usize| (x as i64 - margin[d] as i64).div_euclid(align[d] as i64) * align[d] as i64;
        let size = |from: i64, end: usize, d: usize| {
            ((end + margin[d]) as i64 - from).div_euclid(align[d] as i64) as usize * align[d] + align[d]
        };
        let (column, row) = (start(rect.column, 0), start(rect.row, 1));
        Self {
            column,
            row,
            width: size(column, rect.column + rect.width, 0),
            height: size(row, rect.row + rect.height, 1),
            inner: ((rect.column as i64 - column) as usize, (rect.row as i64 - row) as usize),
        }
    }
}

/// One label (or 0) for each pixel that holds a point.
struct Seeds {
    holds_point: Vec<bool>,
    labels: Vec<Label>,
}

/// Adds every near point to the sums of the pixels under its kernel.
fn splat(scatter: &Scatter, drawn: Wanted, grid: &Grid, around: &Surroundings, sums: &mut Sums) -> Seeds {
    let cell = grid.cell_m();
    let reach = scatter.spacing.greatest().map(|s| KERNEL_SPACINGS * s / cell + KERNEL_MIN_PX);
    let corner = Vec2::new(around.column as f64, around.row as f64);
    let size = Vec2::new(around.width as f64, around.height as f64);
    let border = Vec2::new(reach[0], reach[1]);
    let a = grid.chart_from_pixel(corner - border);
    let b = grid.chart_from_pixel(corner + size + border);
    let mut seeds = Seeds { holds_point: vec![false; around.width * around.height], labels: Vec::new() };
    let mut votes: Vec<(u32, Label, f32)> = Vec::new();
    for bucket in scatter.index.buckets_near(a.inf(&b), a.sup(&b)) {
        // The spacing changes slowly: once for all points of a bucket.
        let half = scatter.spacing.at(bucket.centre).map(|s| (KERNEL_SPACINGS * s / cell).max(KERNEL_MIN_PX));
        for member in bucket.members {
            let p = grid.pixel_from_chart(scatter.index.places()[member]) - corner;
            if p.x >= 0.0 && p.y >= 0.0 && p.x < size.x && p.y < size.y {
                let (x, y) = (p.x as usize, p.y as usize);
                let pixel = y * around.width + x;
                seeds.holds_point[pixel] = true;
                if drawn.labels {
                    let label = scatter.labels[member];
                    let centre = Vec2::new(x as f64 + 0.5, y as f64 + 0.5);
                    votes.push((pixel as u32, label, (p - centre).norm_squared() as f32));
                }
            }
            if drawn.values() {
                add(scatter.values[member].map(f32::from), p, half, around, sums);
            }
        }
    }
    if drawn.labels {
        seeds.labels = vec![0; seeds.holds_point.len()];
        decide(&mut votes, &mut seeds.labels);
    }
    seeds
}

/// Adds a value at `p` (pixels of the surroundings) to the pixels under a kernel with these half axes.
fn add(value: [f32; 4], p: Vec2, half: [f64; 2], around: &Surroundings, sums: &mut Sums) {
    // The first pixel whose centre is not left of `low`, and the one after the last that is not right of `high`.
    let pixels = |low: f64, high: f64, size: usize| {
        let first = (low + 0.5).max(0.0) as usize;
        let end = (high + 0.5).clamp(0.0, size as f64) as usize;
        first..end
    };
    let columns = pixels(p.x - half[0], p.x + half[0], around.width);
    let (sx, sy) = ((1.0 / half[0]) as f32, (1.0 / half[1]) as f32);
    if columns.is_empty() {
        return;
    }
    let first = (columns.start as f64 + 0.5 - p.x) as f32 * sx;
    for y in pixels(p.y - half[1], p.y + half[1], around.height) {
        let dy = (y as f64 + 0.5 - p.y) as f32 * sy;
        let rest = 1.0 - dy * dy;
        let line = y * around.width + columns.start..y * around.width + columns.end;
        let mut dx = first;
        for (sum, weight) in sums.values[line.clone()].iter_mut().zip(&mut sums.weights[line]) {
            let t = (rest - dx * dx).max(0.0);
            let w = t * t * t;
            for k in 0..4 {
                sum[k] += w * value[k];
            }
            *weight += w;
            dx += sx;
        }
    }
}

/// The label of most points in each pixel; between equals the one nearest to the pixel's centre.
fn decide(votes: &mut [(u32, Label, f32)], labels: &mut [Label]) {
    votes.sort_unstable_by(|a, b| (a.0, a.1).cmp(&(b.0, b.1)).then(a.2.total_cmp(&b.2)));
    for pixel in votes.chunk_by(|a, b| a.0 == b.0) {
        let mut best: Option<(usize, f32, Label)> = None;
        for class in pixel.chunk_by(|a, b| a.1 == b.1) {
            let (count, nearest, label) = (class.len(), class[0].2, class[0].1);
            if best.is_none_or(|(n, d, _)| count > n || (count == n && nearest < d)) {
                best = Some((count, nearest, label));
            }
        }
        labels[pixel[0].0 as usize] = best.map_or(0, |b| b.2);
    }
}

/// For each pixel of the tile the nearest pixel of the surroundings that holds a point.
struct Nearest {
    /// Column and row in the surroundings, or `NO_SEED`.
    seed: Vec<(u32, u32)>,
    tile_width: usize,
    inner: (usize, usize),
}

/// No pixel near holds a point.
const NO_SEED: (u32, u32) = (u32::MAX, u32::MAX);

impl Nearest {
    /// Pixels to the right and down from pixel (x, y) of the tile to its seed.
    fn offset(&self, x: usize, y: usize) -> Option<(f64, f64)> {
        let (sx, sy) = self.seed[y * self.tile_width + x];
        let step = |seed: u32, at: usize, inner: usize| f64::from(seed) - (at + inner) as f64;
        ((sx, sy) != NO_SEED).then(|| (step(sx, x, self.inner.0), step(sy, y, self.inner.1)))
    }
}

/// Exact nearest seed within `margin` pixels, in the metric of the typical spacing: nearest in each column first, then
/// the lower envelope of parabolas along each row.
fn nearest_seeds(
    seeds: &Seeds,
    around: &Surroundings,
    margin: [usize; 2],
    rect: PixelRect,
    reach: &Reach,
    cell: f64,
) -> Nearest {
    let width = around.width;
    let (left, top) = around.inner;
    let columns = left - margin[0]..left + rect.width + margin[0];
    let rows = top - margin[1]..top + rect.height + margin[1];
    // Metric: one pixel along u is `su`, one along v is `sv`.
    let [su, sv] = reach.spacing_m.map(|s| cell / s);
    // Vertical pass: row of the nearest seed in the same column, from above and from below.
    let across = columns.len();
    let mut row_of = vec![u32::MAX; across * rect.height];
    let holds = |y: usize| &seeds.holds_point[y * width + columns.start..y * width + columns.end];
    let mut last = vec![u32::MAX; across];
    for y in rows.start..top + rect.height {
        for (last, _) in last.iter_mut().zip(holds(y)).filter(|(_, holds)| **holds) {
            *last = y as u32;
        }
        if y >= top {
            row_of[(y - top) * across..][..across].copy_from_slice(&last);
        }
    }
    last.fill(u32::MAX);
    for y in (top..rows.end).rev() {
        for (last, _) in last.iter_mut().zip(holds(y)).filter(|(_, holds)| **holds) {
            *last = y as u32;
        }
        if y < top + rect.height {
            let line = &mut row_of[(y - top) * across..][..across];
            // Between equals the one above; "none" is beyond every row.
            let from_above = |slot: u32| if slot == u32::MAX { u32::MAX } else { y as u32 - slot };
            for (slot, &last) in line.iter_mut().zip(&last) {
                if last != u32::MAX && last - (y as u32) < from_above(*slot) {
                    *slot = last;
                }
            }
        }
    }
    let mut seed = vec![NO_SEED; rect.len()];
    // Of each parabola of the envelope: its column, its height there, and from where on it is the lowest.
    let mut hull: Vec<(usize, f64, f64)> = Vec::with_capacity(across);
    // 1 / (2 su^2 distance): a division for each comparison would take most of the time.
    let inverse: Vec<f64> = (0..across).map(|distance| 0.5 / (su * su * distance as f64)).collect();
    for y in 0..rect.height {
        let line = &row_of[y * across..(y + 1) * across];
        hull.clear();
        for (x, &row) in line.iter().enumerate().filter(|(_, row)| **row != u32::MAX) {
            let d = (f64::from(row) - (y + top) as f64) * sv;
            let height = d * d;
            let mut start = f64::NEG_INFINITY;
            while let Some(&(other, other_height, other_start)) = hull.last() {
                start = (height - other_height) * inverse[x - other] + 0.5 * (x + other) as f64;
                if start > other_start {
                    break;
                }
                hull.pop();
                start = f64::NEG_INFINITY;
            }
            hull.push((x, height, start));
        }
        if hull.is_empty() {
            continue;
        }
        let mut k = 0;
        for (x, slot) in seed[y * rect.width..(y + 1) * rect.width].iter_mut().enumerate() {
            let at = (x + margin[0]) as f64;
            while k + 1 < hull.len() && hull[k + 1].2 <= at {
                k += 1;
            }
            let column = hull[k].0;
            *slot = ((column + columns.start) as u32, line[column]);
        }
    }
    Nearest { seed, tile_width: rect.width, inner: around.inner }
}

/// Reduction from level to level until a cell spans the filling distance: first only along the sparser direction,
/// until the cells are as stretched as the spacing of the scan.
fn pyramid_factors(reach: &Reach, cell: f64) -> Vec<Factors> {
    let mut size = [cell; 2];
    let mut factors = Vec::new();
    while size[0] < reach.fill_m[0] || size[1] < reach.fill_m[1] {
        let relative = [size[0] / reach.spacing_m[0], size[1] / reach.spacing_m[1]];
        let wants = [size[0] < reach.fill_m[0], size[1] < reach.fill_m[1]];
        let factor = match wants {
            [true, true] if relative[1] > 1.5 * relative[0] => [2, 1],
            [true, true] if relative[0] > 1.5 * relative[1] => [1, 2],
            [true, true] => [2, 2],
            [true, false] => [2, 1],
            _ => [1, 2],
        };
        size = [size[0] * factor[0] as f64, size[1] * factor[1] as f64];
        factors.push(factor);
    }
    factors
}

/// Turns sums into values with certainty and fills uncertain pixels from coarser and coarser means.
fn pull_push(sums: &mut Sums, width: usize, height: usize, factors: &[Factors]) {
    sums.average(|w| (w / FULL_CERTAINTY).min(1.0));
    let Some((&[fx, fy], rest)) = factors.split_first() else { return };
    let (w, h) = (width / fx, height / fy);
    let mut coarse = Sums::new(w * h);
    for y in 0..h * fy {
        for x in 0..w * fx {
            let (from, to) = (y * width + x, y / fy * w + x / fx);
            let weight = sums.weights[from];
            for k in 0..4 {
                coarse.values[to][k] += sums.values[from][k] * weight;
            }
            coarse.weights[to] += weight;
        }
    }
    // A coarse cell is certain as soon as one of its pixels is: `FULL_CERTAINTY` is undone here.
    coarse.values.as_flattened_mut().iter_mut().for_each(|x| *x *= FULL_CERTAINTY);
    coarse.weights.iter_mut().for_each(|x| *x *= FULL_CERTAINTY);
    pull_push(&mut coarse, w, h, rest);
    for y in 0..height {
        let (y0, ty) = between(y, fy, h);
        for x in 0..width {
            let i = y * width + x;
            let own = sums.weights[i];
            if own >= 1.0 {
                continue;
            }
            let (x0, tx) = between(x, fx, w);
            let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
            let (mut from_coarse, mut total) = ([0f32; 4], 0f32);
            for (cell, weight) in [
                (y0 * w + x0, (1.0 - tx) * (1.0 - ty)),
                (y0 * w + x1, tx * (1.0 - ty)),
                (y1 * w + x0, (1.0 - tx) * ty),
                (y1 * w + x1, tx * ty),
            ] {
                let weight = weight * coarse.weights[cell];
                for k in 0..4 {
                    from_coarse[k] += weight * coarse.values[cell][k];
                }
                total += weight;
            }
            if total > 0.0 {
                let help = (1.0 - own) * total;
                for k in 0..4 {
                    sums.values[i][k] = (sums.values[i][k] * own + from_coarse[k] / total * help) / (own + help);
                }
                sums.weights[i] = own + help;
            }
        }
    }
}

/// Coarse cell to the left of a fine pixel's centre and the share of the next one.
fn between(x: usize, factor: usize, count: usize) -> (usize, f32) {
    if factor == 1 {
        return (x.min(count - 1), 0.0);
    }
    let position = ((x as f32 + 0.5) / factor as f32 - 0.5).max(0.0);
    let cell = (position as usize).min(count - 1);
    (cell, position - cell as f32)
}

/// Takes the tile out of its surroundings.
fn collect(
    drawn: Wanted,
    rect: PixelRect,
    around: &Surroundings,
    sums: &Sums,
    support: Vec<Support>,
    nearest: &Nearest,
    seeds: &Seeds,
) -> BlendedTile {
    let mut colors = vec![[f32::NAN; 3]; if drawn.colors { rect.len() } else { 0 }];
    let mut intensities = vec![f32::NAN; if drawn.intensities { rect.len() } else { 0 }];
    let mut labels = vec![0; if drawn.labels { rect.len() } else { 0 }];
    for y in 0..rect.height {
        for x in 0..rect.width {
            let i = y * rect.width + x;
            if support[i] == Support::None {
                continue;
            }
            let at = around.inside(x, y);
            if sums.weights.get(at).is_some_and(|w| *w > 0.0) {
                let [r, g, b, intensity] = sums.values[at];
                if let Some(color) = colors.get_mut(i) {
                    *color = [r, g, b];
                }
                if let Some(slot) = intensities.get_mut(i) {
                    *slot = intensity;
                }
            }
            if let Some(label) = labels.get_mut(i) {
                let (column, row) = nearest.seed[i];
                *label = seeds.labels[row as usize * around.width + column as usize];
            }
        }
    }
    BlendedTile { support, colors, intensities, labels }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{Attributes, ScanFrame};
    use crate::numeric::Vec3;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn cloud(uv: &[Vec2], attributes: Attributes) -> Cloud {
        let positions = uv.iter().map(|p| Vec3::new(p.x, p.y, 0.0)).collect::<Vec<_>>();
        let source = crate::cloud::SourceFile {
            path: "x".into(),
            first_point: 0,
            point_count: uv.len(),
            record_count: uv.len() as u64,
            dropped_records: Default::default(),
        };
        Cloud::new(ScanFrame::local(), positions, attributes, vec![source], vec![]).unwrap()
    }

    const ALL: Wanted = Wanted { colors: true, intensities: true, labels: true };

    fn scatter(uv: &[Vec2], cloud: &Cloud) -> Scatter {
        let index = ScatterIndex::new(uv, |_| true);
        let spacing = Spacing::measure(&index).unwrap();
        Scatter::new(index, spacing, cloud, ALL)
    }

    fn random(n: usize, side: f64) -> Vec<Vec2> {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        (0..n).map(|_| Vec2::new(rng.random::<f64>() * side, rng.random::<f64>() * side)).collect()
    }

    #[test]
    fn a_smooth_field_comes_back_without_holes_or_speckle() {
        let uv = random(4000, 2.0);
        let field = |p: Vec2| 30_000.0 + 8_000.0 * (3.0 * p.x).sin() + 8_000.0 * (2.0 * p.y).cos();
        let attributes =
            Attributes { intensities: Some(uv.iter().map(|&p| field(p) as u16).collect()), ..Default::default() };
        let cloud = cloud(&uv, attributes);
        let scatter = scatter(&uv, &cloud);
        let grid = Grid::covering(Vec2::zeros(), Vec2::repeat(2.0), 0.005).unwrap();
        let reach = Reach::new(&scatter.spacing, None, grid.cell_m());
        let tile = blend(&scatter, ALL, &grid, &reach, grid.rect(), |_| true);
        let mut worst = 0.0f64;
        for (i, &value) in tile.intensities.iter().enumerate() {
            let p = grid.chart_from_pixel(Vec2::new((i % 400) as f64 + 0.5, (i / 400) as f64 + 0.5));
            worst = worst.max((f64::from(value) - field(p)).abs());
        }
        assert!(worst < 2000.0, "{worst}");
        assert!(tile.support.iter().all(|&s| s != Support::None));
    }

    #[test]
    fn tiles_do_not_show() {
        let uv: Vec<Vec2> = random(900, 2.0).into_iter().filter(|p| (p - Vec2::repeat(1.0)).norm() > 0.25).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let attributes = Attributes {
            intensities: Some(uv.iter().map(|_| rng.random()).collect()),
            labels: Some(uv.iter().map(|_| rng.random_range(0..4)).collect()),
            ..Default::default()
        };
        let cloud = cloud(&uv, attributes);
        let scatter = scatter(&uv, &cloud);
        let grid = Grid::covering(Vec2::zeros(), Vec2::repeat(2.0), 0.01).unwrap();
        let reach = Reach::new(&scatter.spacing, Some(0.3), grid.cell_m());
        let whole = blend(&scatter, ALL, &grid, &reach, grid.rect(), |_| true);
        let rect = PixelRect { column: 70, row: 64, width: 61, height: 50 };
        let part = blend(&scatter, ALL, &grid, &reach, rect, |_| true);
        for i in 0..rect.len() {
            let w = (rect.row + i / rect.width) * 200 + rect.column + i % rect.width;
            assert_eq!(part.support[i], whole.support[w]);
            assert_eq!(part.labels[i], whole.labels[w]);
            let (a, b) = (part.intensities[i], whole.intensities[w]);
            assert!((a - b).abs() < 2.0 || (a.is_nan() && b.is_nan()), "{a} {b}");
        }
    }

    #[test]
    fn labels_come_from_the_nearest_point_and_gaps_stay_empty() {
        let mut uv = random(800, 1.0);
        uv.iter_mut().for_each(|p| {
            if p.x > 0.5 {
                p.x += 1.0;
            }
        });
        let labels: Vec<u32> = uv.iter().map(|p| if p.y > 0.5 { 7 } else { 3 }).collect();
        let cloud = cloud(&uv, Attributes { labels: Some(labels.clone()), ..Default::default() });
        let scatter = scatter(&uv, &cloud);
        let grid = Grid::covering(Vec2::zeros(), Vec2::new(2.0, 1.0), 0.01).unwrap();
        let reach = Reach::new(&scatter.spacing, Some(0.2), grid.cell_m());
        let tile = blend(&scatter, ALL, &grid, &reach, grid.rect(), |_| true);
        for (p, &label) in uv.iter().zip(&labels) {
            let (c, r) = grid.index_of(*p).unwrap();
            assert_eq!(tile.labels[r * 200 + c], label);
            assert_eq!(tile.support[r * 200 + c], Support::Observed);
        }
        assert_eq!(tile.support[50 * 200 + 100], Support::None);
        for i in 0..grid.rect().len() {
            let p = grid.chart_from_pixel(Vec2::new((i % 200) as f64 + 0.5, (i / 200) as f64 + 0.5));
            let d = uv.iter().map(|q| (q - p).norm()).fold(f64::INFINITY, f64::min);
            match tile.support[i] {
                Support::None => assert!(d > 0.19, "{d}"),
                _ => assert!(d < 0.215, "{d}"),
            }
        }
    }

    #[test]
    fn profiles_are_bridged_along_the_tunnel_only() {
        // Profiles 0.5 m apart with a sharp edge at v = 1: it must stay sharp in between.
        let uv: Vec<Vec2> = (0..9)
            .flat_map(|i| {
                (0..500).map(move |j| Vec2::new(0.5 * f64::from(i) + 1e-4 * f64::from(j % 7), 0.004 * f64::from(j)))
            })
            .collect();
        let colors = uv.iter().map(|p| if p.y > 1.0 { [60_000; 3] } else { [1000; 3] }).collect();
        let cloud = cloud(&uv, Attributes { colors: Some(colors), ..Default::default() });
        let scatter = scatter(&uv, &cloud);
        let grid = Grid::covering(Vec2::zeros(), Vec2::new(4.0, 2.0), 0.01).unwrap();
        let reach = Reach::new(&scatter.spacing, None, grid.cell_m());
        let tile = blend(&scatter, ALL, &grid, &reach, grid.rect(), |_| true);
        for column in [25, 75, 130, 333] {
            for (row, expected) in [(20, 60_000.0), (96, 60_000.0), (104, 1000.0), (180, 1000.0)] {
                let c = tile.colors[row * 400 + column][1];
                assert!((c - expected).abs() < 100.0, "column {column}, row {row}: {c}");
            }
        }
    }
}
