//! Where the surface lies in a cell: a robust plane through the points of its cluster and of the cells around.

use super::clusters::Cluster;
use super::{MAX_SLOPE, NOISE_ALLOWANCE_M};
use crate::numeric::{Mat3, Vec3, statistics};
use crate::segment::unrolled_grid::{CellPoints, Grid, GridPoint};
use rayon::prelude::*;

/// How far a vertex may move from the middle of its cell, in cells.
pub(super) const MAX_SHIFT: f64 = 0.3;
/// Width of the fitting weights, in cells.
const FIT_SIGMA: f64 = 0.7;

/// One place on the surface for each cell with a cluster; for the others the middle of the cell at depth 0.
pub(super) fn fit_places(grid: &Grid, cells: &CellPoints, clusters: &[Cluster]) -> Vec<GridPoint> {
    (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            let (i, j) = ((cell / grid.columns) as f64 + 0.5, (cell % grid.columns) as f64 + 0.5);
            let cluster = clusters[cell];
            if cluster.count == 0 {
                return grid.middle(cell, 0.0);
            }
            let (mut row, mut column) = (0.0, 0.0);
            for p in cells.in_cell(cell).iter().filter(|p| p.depth >= cluster.low && p.depth <= cluster.high) {
                row += p.row;
                column += p.column;
            }
            let count = f64::from(cluster.count);
            let at = [
                i + (row / count - i).clamp(-MAX_SHIFT, MAX_SHIFT),
                j + (column / count - j).clamp(-MAX_SHIFT, MAX_SHIFT),
            ];
            GridPoint { row: at[0], column: at[1], depth: fit_depth(grid, cells, clusters, cell, at) }
        })
        .collect()
}

/// Depth of the surface at `at`, inside `cell`, by a robust weighted plane through the points around.
fn fit_depth(grid: &Grid, cells: &CellPoints, clusters: &[Cluster], cell: usize, at: [f64; 2]) -> f64 {
    let own = clusters[cell];
    // (row offset in cells, column offset in cells, depth, weight)
    let mut samples: Vec<[f64; 4]> = Vec::with_capacity(32);
    for n in std::iter::once(cell).chain(grid.neighbours(cell, 1)) {
        let cluster = clusters[n];
        if cluster.count == 0 {
            continue;
        }
        let allowed = MAX_SLOPE * grid.distance(cell, n) + NOISE_ALLOWANCE_M;
        if (own.low - cluster.high).max(cluster.low - own.high) > allowed {
            continue;
        }
        for p in cells.in_cell(n).iter().filter(|p| p.depth >= cluster.low && p.depth <= cluster.high) {
            let dr = p.row - at[0];
            let mut dc = p.column - at[1];
            // Across the seam.
            dc -= grid.columns as f64 * (dc / grid.columns as f64).round();
            let weight = (-0.5 * (dr * dr + dc * dc) / (FIT_SIGMA * FIT_SIGMA)).exp();
            samples.push([dr, dc, p.depth - own.middle, weight]);
        }
    }
    let mut depth = plane_at_origin(&samples);
    if samples.len() >= 6 {
        let mut residuals: Vec<f64> =
            samples.iter().map(|s| (s[2] - depth[0] - depth[1] * s[0] - depth[2] * s[1]).abs()).collect();
        let scale = 1.4826 * statistics::median(&mut residuals.clone()).unwrap_or(0.0);
        let reach = (3.0 * scale).max(1e-4);
        for (s, r) in samples.iter_mut().zip(residuals.drain(..)) {
            let t = r / reach;
            s[3] *= if t < 1.0 { (1.0 - t * t).powi(2) } else { 0.0 };
        }
        depth = plane_at_origin(&samples);
    }
    (own.middle + depth[0]).clamp(own.low, own.high)
}

/// Value and slopes at the origin of the weighted least-squares plane; slopes fade out where the samples do not tell.
pub(super) fn plane_at_origin(samples: &[[f64; 4]]) -> [f64; 3] {
    let mut normal = Mat3::zeros();
    let mut right = Vec3::zeros();
    for &[r, c, d, w] in samples {
        let row = Vec3::new(1.0, r, c);
        normal += w * row * row.transpose();
        right += w * d * row;
    }
    let total = normal[(0, 0)];
    if total <= 0.0 {
        return [0.0; 3];
    }
    // A slope needs a spread of a tenth of a cell to be believed.
    normal[(1, 1)] += 0.01 * total;
    normal[(2, 2)] += 0.01 * total;
    match normal.cholesky() {
        Some(factor) => factor.solve(&right).into(),
        None => [right[0] / total, 0.0, 0.0],
    }
}
