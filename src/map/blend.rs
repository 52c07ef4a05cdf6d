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

/// The points that colour the map.
#[derive(Debug)]
pub struct Scatter<'a> {
    /// Points on the surface, sorted.
    pub index: ScatterIndex<'a>,
    /// Their spacing.
    pub spacing: Spacing,
    /// Their attributes.
    pub cloud: &'a Cloud,
    /// Whether colours are to be blended.
    pub colors: bool,
    /// Whether intensities are to be blended.
    pub intensities: bool,
    /// Whether labels are to be drawn.
    pub labels: bool,
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

/// Pull-push reduces by these factors in u and v from level to level.
type Factors = [usize; 2];

/// Blends the values of the scan points on those pixels of `rect` that are `wanted` (because there is surface).
pub fn blend(
    scatter: &Scatter,
    grid: &Grid,
    reach: &Reach,
    rect: PixelRect,
    wanted: impl Fn(usize) -> bool,
) -> BlendedTile {
    let cell = grid.cell_m();
    let pyramid = pyramid_factors(reach, cell);
    let margin = [0, 1].map(|d| ((reach.kernel_m[d].max(reach.fill_m[d]) / cell).ceil() as usize) + 2);
    let around = Surroundings::new(rect, margin);
    let mut sums = vec![[0f32; 5]; around.width * around.height];
    let seeds = splat(scatter, grid, &around, &mut sums);
    let nearest = nearest_seeds(&seeds, &around, rect, reach, cell);

    let mut support = vec![Support::None; rect.len()];
    let mut needs_filling = false;
    for y in 0..rect.height {
        for x in 0..rect.width {
            let i = y * rect.width + x;
            let Some((dx, dy)) = nearest.offset(i).filter(|_| wanted(i)) else { continue };
            let (du, dv) = (dx * cell, dy * cell);
            let centre = Vec2::new((rect.column + x) as f64 + 0.5, (rect.row + y) as f64 + 0.5);
            let local = scatter.spacing.at(grid.chart_from_pixel(centre));
            let within = |limit: [f64; 2]| (du / limit[0]).powi(2) + (dv / limit[1]).powi(2) <= 1.0;
            support[i] = if within(local.map(|s| (OBSERVED_SPACINGS * s).max(OBSERVED_MIN_PX * cell))) {
                Support::Observed
            } else if within(reach.fill_m) {
                Support::Filled
            } else {
                continue;
            };
            let at = (y + around.inner.1) * around.width + x + around.inner.0;
            needs_filling |= sums[at][4] < FULL_CERTAINTY;
        }
    }
    let wants_values = scatter.colors || scatter.intensities;
    if wants_values && needs_filling {
        // The pyramid needs more room, aligned so that its cells are the same for every tile.
        let total = pyramid.iter().fold([1, 1], |t: Factors, f| [t[0] * f[0], t[1] * f[1]]);
        let wide = Surroundings::aligned(rect, [2 * total[0], 2 * total[1]], total);
        let mut wide_sums = vec![[0f32; 5]; wide.width * wide.height];
        splat(scatter, grid, &wide, &mut wide_sums);
        pull_push(&mut wide_sums, wide.width, wide.height, &pyramid);
        return collect(scatter, rect, &wide, &wide_sums, support, &nearest, &seeds);
    }
    sums.iter_mut().filter(|s| s[4] > 0.0).for_each(|s| {
        let w = s[4];
        s[..4].iter_mut().for_each(|x| *x /= w);
        s[4] = 1.0;
    });
    collect(scatter, rect, &around, &sums, support, &nearest, &seeds)
}

impl Surroundings {
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

/// Adds every near point to the sums (red, green, blue, intensity, weight) of the pixels under its kernel.
fn splat(scatter: &Scatter, grid: &Grid, around: &Surroundings, sums: &mut [[f32; 5]]) -> Seeds {
    let cell = grid.cell_m();
    let attributes = scatter.cloud.attributes();
    let colors = attributes.colors.as_deref().filter(|_| scatter.colors);
    let intensities = attributes.intensities.as_deref().filter(|_| scatter.intensities);
    let labels = attributes.labels.as_deref().filter(|_| scatter.labels);
    let reach = scatter.spacing.greatest().map(|s| KERNEL_SPACINGS * s / cell + KERNEL_MIN_PX);
    let corner = Vec2::new(around.column as f64, around.row as f64);
    let size = Vec2::new(around.width as f64, around.height as f64);
    let border = Vec2::new(reach[0], reach[1]);
    let a = grid.chart_from_pixel(corner - border);
    let b = grid.chart_from_pixel(corner + size + border);
    let mut seeds = Seeds { holds_point: vec![false; sums.len()], labels: Vec::new() };
    let mut votes: Vec<(u32, Label, f32)> = Vec::new();
    let wants_values = colors.is_some() || intensities.is_some();
    scatter.index.for_each_near(a.inf(&b), a.sup(&b), |point, uv| {
        let p = grid.pixel_from_chart(uv) - corner;
        if p.x >= 0.0 && p.y >= 0.0 && p.x < size.x && p.y < size.y {
            let pixel = p.y as usize * around.width + p.x as usize;
            seeds.holds_point[pixel] = true;
            if let Some(labels) = labels {
                let centre = Vec2::new(p.x.floor() + 0.5, p.y.floor() + 0.5);
                votes.push((pixel as u32, labels[point as usize], (p - centre).norm_squared() as f32));
            }
        }
        if !wants_values {
            return;
        }
        let spacing = scatter.spacing.at(uv);
        let half = spacing.map(|s| (KERNEL_SPACINGS * s / cell).max(KERNEL_MIN_PX));
        let x0 = (p.x - half[0] - 0.5).ceil().max(0.0);
        let x1 = (p.x + half[0] - 0.5).floor().min(size.x - 1.0);
        let y0 = (p.y - half[1] - 0.5).ceil().max(0.0);
        let y1 = (p.y + half[1] - 0.5).floor().min(size.y - 1.0);
        if x0 > x1 || y0 > y1 {
            return;
        }
        let c = colors.map_or([0.0; 3], |c| c[point as usize].map(f32::from));
        let intensity = intensities.map_or(0.0, |i| f32::from(i[point as usize]));
        let (sx, sy) = ((1.0 / half[0]) as f32, (1.0 / half[1]) as f32);
        for y in y0 as usize..=y1 as usize {
            let dy = (y as f64 + 0.5 - p.y) as f32 * sy;
            let rest = 1.0 - dy * dy;
            let line = &mut sums[y * around.width..(y + 1) * around.width];
            let mut dx = (x0 + 0.5 - p.x) as f32 * sx;
            for sum in &mut line[x0 as usize..=x1 as usize] {
                let t = rest - dx * dx;
                if t > 0.0 {
                    let w = t * t * t;
                    sum[0] += w * c[0];
                    sum[1] += w * c[1];
                    sum[2] += w * c[2];
                    sum[3] += w * intensity;
                    sum[4] += w;
                }
                dx += sx;
            }
        }
    });
    if labels.is_some() {
        seeds.labels = vec![0; sums.len()];
        decide(&mut votes, &mut seeds.labels);
    }
    seeds
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
    /// Index in the surroundings, or `u32::MAX`.
    seed: Vec<u32>,
    rect: PixelRect,
    inner: (usize, usize),
    width: usize,
}

impl Nearest {
    /// Pixels to the right and down from pixel `i` of the tile to its seed.
    fn offset(&self, i: usize) -> Option<(f64, f64)> {
        let seed = self.seed[i];
        (seed != u32::MAX).then(|| {
            let (sx, sy) = (seed as usize % self.width, seed as usize / self.width);
            let (x, y) = (i % self.rect.width + self.inner.0, i / self.rect.width + self.inner.1);
            (sx as f64 - x as f64, sy as f64 - y as f64)
        })
    }
}

/// Exact nearest seed in the metric of the typical spacing: nearest in each column first, then the lower envelope of
/// parabolas along each row.
fn nearest_seeds(seeds: &Seeds, around: &Surroundings, rect: PixelRect, reach: &Reach, cell: f64) -> Nearest {
    let (width, height) = (around.width, around.height);
    // Metric: one pixel along u is `su`, one along v is `sv`.
    let [su, sv] = reach.spacing_m.map(|s| cell / s);
    let first = around.inner.1;
    // Vertical pass: row of the nearest seed in the same column, from above and from below.
    let mut row_of = vec![u32::MAX; width * rect.height];
    let mut last = vec![u32::MAX; width];
    for y in 0..first + rect.height {
        for x in 0..width {
            if seeds.holds_point[y * width + x] {
                last[x] = y as u32;
            }
            if y >= first {
                row_of[(y - first) * width + x] = last[x];
            }
        }
    }
    last.fill(u32::MAX);
    for y in (first..height).rev() {
        for x in 0..width {
            if seeds.holds_point[y * width + x] {
                last[x] = y as u32;
            }
            if y < first + rect.height && last[x] != u32::MAX {
                let slot = &mut row_of[(y - first) * width + x];
                if *slot == u32::MAX || (last[x] as usize - y) < (y - *slot as usize) {
                    *slot = last[x];
                }
            }
        }
    }
    let mut seed = vec![u32::MAX; rect.len()];
    let mut hull: Vec<usize> = Vec::with_capacity(width);
    let mut from: Vec<f64> = Vec::with_capacity(width);
    for y in 0..rect.height {
        let line = &row_of[y * width..(y + 1) * width];
        let height_of = |x: usize| {
            let d = (line[x] as f64 - (y + first) as f64) * sv;
            d * d
        };
        hull.clear();
        from.clear();
        for x in (0..width).filter(|&x| line[x] != u32::MAX) {
            let f = height_of(x);
            let mut start = f64::NEG_INFINITY;
            while let Some(&h) = hull.last() {
                // Where the parabola at x gets below the one at h.
                start = (f - height_of(h) + su * su * ((x * x) as f64 - (h * h) as f64))
                    / (2.0 * su * su * (x as f64 - h as f64));
                if start > from[hull.len() - 1] {
                    break;
                }
                hull.pop();
                from.pop();
                start = f64::NEG_INFINITY;
            }
            hull.push(x);
            from.push(start);
        }
        if hull.is_empty() {
            continue;
        }
        let mut k = 0;
        for x in 0..rect.width {
            let at = (x + around.inner.0) as f64;
            while k + 1 < hull.len() && from[k + 1] <= at {
                k += 1;
            }
            seed[y * rect.width + x] = line[hull[k]] * width as u32 + hull[k] as u32;
        }
    }
    Nearest { seed, rect, inner: around.inner, width }
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
fn pull_push(sums: &mut [[f32; 5]], width: usize, height: usize, factors: &[Factors]) {
    for s in sums.iter_mut() {
        let w = s[4];
        if w > 0.0 {
            s[..4].iter_mut().for_each(|x| *x /= w);
            s[4] = (w / FULL_CERTAINTY).min(1.0);
        }
    }
    let Some((&[fx, fy], rest)) = factors.split_first() else { return };
    let (w, h) = (width / fx, height / fy);
    let mut coarse = vec![[0f32; 5]; w * h];
    for y in 0..h * fy {
        for x in 0..w * fx {
            let s = sums[y * width + x];
            if s[4] > 0.0 {
                let c = &mut coarse[y / fy * w + x / fx];
                for k in 0..4 {
                    c[k] += s[k] * s[4];
                }
                c[4] += s[4];
            }
        }
    }
    // A coarse cell is certain as soon as one of its pixels is: `FULL_CERTAINTY` is undone here.
    coarse.iter_mut().for_each(|c| c.iter_mut().for_each(|x| *x *= FULL_CERTAINTY));
    pull_push(&mut coarse, w, h, rest);
    for y in 0..height {
        let (y0, ty) = between(y, fy, h);
        for x in 0..width {
            let s = &mut sums[y * width + x];
            if s[4] >= 1.0 {
                continue;
            }
            let (x0, tx) = between(x, fx, w);
            let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
            let mut from_coarse = [0f32; 5];
            for (cell, weight) in [
                (y0 * w + x0, (1.0 - tx) * (1.0 - ty)),
                (y0 * w + x1, tx * (1.0 - ty)),
                (y1 * w + x0, (1.0 - tx) * ty),
                (y1 * w + x1, tx * ty),
            ] {
                let c = coarse[cell];
                let weight = weight * c[4];
                for k in 0..4 {
                    from_coarse[k] += weight * c[k];
                }
                from_coarse[4] += weight;
            }
            if from_coarse[4] > 0.0 {
                let own = s[4];
                let help = (1.0 - own) * from_coarse[4];
                for k in 0..4 {
                    s[k] = (s[k] * own + from_coarse[k] / from_coarse[4] * help) / (own + help);
                }
                s[4] = own + help;
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
    scatter: &Scatter,
    rect: PixelRect,
    around: &Surroundings,
    values: &[[f32; 5]],
    support: Vec<Support>,
    nearest: &Nearest,
    seeds: &Seeds,
) -> BlendedTile {
    let value = |i: usize| {
        let at = (i / rect.width + around.inner.1) * around.width + i % rect.width + around.inner.0;
        (support[i] != Support::None && values[at][4] > 0.0).then(|| values[at])
    };
    let colors = if scatter.colors {
        (0..rect.len()).map(|i| value(i).map_or([f32::NAN; 3], |v| [v[0], v[1], v[2]])).collect()
    } else {
        Vec::new()
    };
    let intensities = if scatter.intensities {
        (0..rect.len()).map(|i| value(i).map_or(f32::NAN, |v| v[3])).collect()
    } else {
        Vec::new()
    };
    let labels = if scatter.labels {
        (0..rect.len())
            .map(|i| match (support[i], nearest.seed[i]) {
                (Support::None, _) | (_, u32::MAX) => 0,
                (_, seed) => seeds.labels[seed as usize],
            })
            .collect()
    } else {
        Vec::new()
    };
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

    fn scatter<'a>(uv: &'a [Vec2], cloud: &'a Cloud) -> Scatter<'a> {
        let index = ScatterIndex::new(uv, |_| true);
        let spacing = Spacing::measure(&index).unwrap();
        let a = cloud.attributes();
        let (colors, intensities, labels) = (a.colors.is_some(), a.intensities.is_some(), a.labels.is_some());
        Scatter { index, spacing, cloud, colors, intensities, labels }
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
        let tile = blend(&scatter, &grid, &reach, grid.rect(), |_| true);
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
        let whole = blend(&scatter, &grid, &reach, grid.rect(), |_| true);
        let rect = PixelRect { column: 70, row: 64, width: 61, height: 50 };
        let part = blend(&scatter, &grid, &reach, rect, |_| true);
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
        let tile = blend(&scatter, &grid, &reach, grid.rect(), |_| true);
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
        let tile = blend(&scatter, &grid, &reach, grid.rect(), |_| true);
        for column in [25, 75, 130, 333] {
            for (row, expected) in [(20, 60_000.0), (96, 60_000.0), (104, 1000.0), (180, 1000.0)] {
                let c = tile.colors[row * 400 + column][1];
                assert!((c - expected).abs() < 100.0, "column {column}, row {row}: {c}");
            }
        }
    }
}
