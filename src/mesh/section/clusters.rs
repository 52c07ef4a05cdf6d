//! Which points of a cell are the surface: one cluster of depths, chosen with its neighbours, or none.

use super::fit::plane_at_origin;
use super::{MAX_SLOPE, NOISE_ALLOWANCE_M, Summary};
use crate::numeric::statistics;
use crate::segment::unrolled_grid::{CellPoints, Grid, GridPoint};
use rayon::prelude::*;

/// A cell with more points than this is never taken for an outlier.
const BUMP_POINTS: u32 = 2;
/// How far a lonely point may stick out, in robust standard deviations of its neighbours.
const BUMP_IN_SCALES: f64 = 5.0;

/// The chosen depth range of a cell; empty when `count` is 0.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Cluster {
    pub low: f64,
    pub high: f64,
    pub middle: f64,
    pub count: u32,
}

/// Splits the depths of each cell at gaps and chooses one cluster, first the largest, then the one that continues the
/// neighbours best among those with a fair share of the points.
pub(super) fn choose_clusters(grid: &Grid, cells: &CellPoints, summary: &mut Summary) -> Vec<Cluster> {
    let gap = 2.0 * grid.column_m + NOISE_ALLOWANCE_M;
    let split = |cell: usize| -> Vec<Cluster> {
        let mut depths: Vec<f64> = cells.in_cell(cell).iter().map(|p| p.depth).collect();
        depths.sort_unstable_by(f64::total_cmp);
        depths
            .chunk_by(|a, b| b - a <= gap)
            .map(|c| Cluster { low: c[0], high: c[c.len() - 1], middle: c[c.len() / 2], count: c.len() as u32 })
            .collect()
    };
    let largest: Vec<(Cluster, bool)> = (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            let clusters = split(cell);
            let best = clusters.iter().copied().reduce(|a, b| if b.count >= a.count { b } else { a });
            let several = clusters.iter().filter(|c| c.count >= 2).count() > 1;
            (best.unwrap_or_default(), several)
        })
        .collect();
    summary.cells_with_points = largest.iter().filter(|(c, _)| c.count > 0).count();
    let several = largest.iter().filter(|(_, several)| *several).count();
    summary.multiple_depth_percent = 100.0 * several as f64 / summary.cells_with_points.max(1) as f64;
    (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            let chosen = largest[cell].0;
            if chosen.count == 0 || cells.in_cell(cell).len() == chosen.count as usize {
                return chosen;
            }
            let mut around: Vec<f64> =
                grid.neighbours(cell, 2).map(|n| largest[n].0).filter(|c| c.count > 0).map(|c| c.middle).collect();
            let Some(expected) = statistics::median(&mut around) else { return chosen };
            let fair = chosen.count.div_ceil(4);
            split(cell)
                .into_iter()
                .filter(|c| c.count >= fair)
                .min_by(|a, b| (a.middle - expected).abs().total_cmp(&(b.middle - expected).abs()))
                .unwrap_or(chosen)
        })
        .collect()
}

/// Empties cells that too few of their nearest occupied neighbours agree with.
pub(super) fn drop_isolated(grid: &Grid, clusters: Vec<Cluster>, summary: &mut Summary) -> Vec<Cluster> {
    let kept: Vec<Cluster> = clusters
        .par_iter()
        .enumerate()
        .map(|(cell, cluster)| {
            if cluster.count == 0 {
                return *cluster;
            }
            for reach in [1, 2, 4, 6] {
                let (mut seen, mut agree) = (0, 0);
                for n in grid.neighbours(cell, reach).filter(|&n| clusters[n].count > 0) {
                    seen += 1;
                    let allowed = MAX_SLOPE * grid.distance(cell, n) + NOISE_ALLOWANCE_M;
                    let jump = (cluster.low - clusters[n].high).max(clusters[n].low - cluster.high);
                    agree += usize::from(jump <= allowed);
                }
                if seen >= 6 || reach == 6 {
                    let enough = if seen >= 6 { agree >= 2 && 5 * agree >= seen } else { agree >= 1 };
                    return if enough { *cluster } else { Cluster::default() };
                }
            }
            *cluster
        })
        .collect();
    summary.isolated_cells_dropped =
        clusters.iter().zip(&kept).filter(|(before, after)| before.count > 0 && after.count == 0).count();
    kept
}

/// Empties cells of few points that stick out of the plane through their neighbours: single outliers close to the surface.
pub(super) fn drop_bumps(
    grid: &Grid,
    clusters: Vec<Cluster>,
    places: &[GridPoint],
    summary: &mut Summary,
) -> Vec<Cluster> {
    let kept: Vec<Cluster> = clusters
        .par_iter()
        .enumerate()
        .map(|(cell, &cluster)| {
            if cluster.count == 0 || cluster.count > BUMP_POINTS {
                return cluster;
            }
            let here = places[cell];
            let mut samples: Vec<[f64; 4]> = Vec::with_capacity(24);
            for n in grid.neighbours(cell, 2).filter(|&n| clusters[n].count > 0) {
                let dr = places[n].row - here.row;
                let mut dc = places[n].column - here.column;
                dc -= grid.columns as f64 * (dc / grid.columns as f64).round();
                // A cell of several points is a surer witness than a single one.
                let weight = f64::from(clusters[n].count.min(4)) / (1.0 + dr * dr + dc * dc);
                samples.push([dr, dc, places[n].depth, weight]);
            }
            if samples.len() < 5 {
                return cluster;
            }
            // Depths relative to the median keep the ridge of the slopes from pulling towards the mean section.
            let mut depths: Vec<f64> = samples.iter().map(|s| s[2]).collect();
            let middle = statistics::median(&mut depths).unwrap_or(0.0);
            samples.iter_mut().for_each(|s| s[2] -= middle);
            let mut plane = plane_at_origin(&samples);
            let residual = |plane: &[f64; 3], s: &[f64; 4]| (s[2] - plane[0] - plane[1] * s[0] - plane[2] * s[1]).abs();
            let mut scale = 0.0;
            for _ in 0..2 {
                let mut residuals: Vec<f64> = samples.iter().map(|s| residual(&plane, s)).collect();
                scale = 1.4826 * statistics::median(&mut residuals).unwrap_or(0.0);
                let reach = (3.0 * scale).max(1e-3);
                let weighted: Vec<[f64; 4]> = samples
                    .iter()
                    .map(|s| {
                        let t = residual(&plane, s) / reach;
                        [s[0], s[1], s[2], if t < 1.0 { s[3] * (1.0 - t * t).powi(2) } else { 0.0 }]
                    })
                    .collect();
                plane = plane_at_origin(&weighted);
            }
            let out = (here.depth - middle - plane[0]).abs();
            if out > BUMP_IN_SCALES * scale + NOISE_ALLOWANCE_M { Cluster::default() } else { cluster }
        })
        .collect();
    summary.bumps_dropped =
        clusters.iter().zip(&kept).filter(|(before, after)| before.count > 0 && after.count == 0).count();
    kept
}
