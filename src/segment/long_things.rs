//! Long thin things close to the surface: cables, pipes, handrails, rails.
//!
//! They stand out by less than rock does, but they are narrow across the tunnel and go on along it. A closing of the
//! depth picture with a window of a few decimetres fills what is narrower than the window; the cells that it fills
//! are joined along the tunnel, and a chain of them that is long, narrow and hardly interrupted is furniture. A bolt or
//! a ledge of rock is not long, a kerb or a bench not narrow.
//!
//! Reference for the closing: J. Serra, *Image Analysis and Mathematical Morphology*, Academic Press, 1982. Cost:
//! linear in points, cells times the window.

use super::Class;
use super::unrolled_grid::{CellPoints, Grid};
use rayon::prelude::*;

/// Half the window of the closing, metres, and at least in cells.
const HALF_WINDOW_M: f64 = 0.15;
const HALF_WINDOW_CELLS: usize = 2;
/// A chain is made of points that stand out at least this far, metres ...
const CORE_M: f64 = 0.06;
/// ... and takes along those beside them that stand out at least this far.
const BESIDE_M: f64 = 0.03;
/// Share of a cell's width that points on a slope differ by without standing out.
const SLOPE_SHARE: f64 = 0.25;
/// A chain is at least this long, metres, or this share of the tunnel.
const LENGTH_M: f64 = 2.5;
const LENGTH_SHARE: f64 = 0.5;
/// Rows of a chain that may be empty in a row: thin things are hit seldom.
const GAP_M: f64 = 0.35;
/// Rows of a chain that hold something, as a share.
const FILLED_SHARE: f64 = 0.35;
/// The depth of a cell: this quantile of its points, so that a thing in front does not count.
const FAR_QUANTILE: f64 = 0.8;

/// Turns wall points on long thin things into furniture; returns how many things and points.
pub(super) fn find(grid: &Grid, cells: &CellPoints, class: &mut [Class]) -> (usize, usize) {
    let far: Vec<f64> = (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            let points = cells.in_cell(cell).iter().zip(cells.indices_in_cell(cell));
            let mut depths: Vec<f64> =
                points.filter(|(_, i)| class[**i as usize] == Class::Wall).map(|(p, _)| p.depth).collect();
            depths.sort_unstable_by(f64::total_cmp);
            let last = depths.len().saturating_sub(1) as f64;
            depths.get((FAR_QUANTILE * last).round() as usize).copied().unwrap_or(f64::NAN)
        })
        .collect();
    let half = |step: f64| ((HALF_WINDOW_M / step).round() as usize).max(HALF_WINDOW_CELLS);
    // Across only: along the tunnel the thing goes on.
    let columns = half(grid.column_m).min(grid.columns / 8);
    let closed = closing_across(grid, &far, columns);
    let slack = SLOPE_SHARE * grid.column_m;
    let stands_out = |cell: usize, depth: f64| closed[cell] - depth - slack;
    let is_core: Vec<bool> = (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            let mut points = cells.in_cell(cell).iter().zip(cells.indices_in_cell(cell));
            points.any(|(p, i)| class[*i as usize] == Class::Wall && stands_out(cell, p.depth) > CORE_M)
        })
        .collect();
    let chains = chains(grid, &is_core);
    let length = LENGTH_M.min(LENGTH_SHARE * grid.rows as f64 * grid.row_m);
    let widest = (2 * columns + 1).max(3);
    let mut taken = vec![false; grid.len()];
    let mut things = 0;
    for chain in &chains {
        let (mut rows, mut first, mut last) = (0, usize::MAX, 0);
        for of_row in chain.chunk_by(|a, b| a / grid.columns == b / grid.columns) {
            let row = of_row[0] / grid.columns;
            (first, last, rows) = (first.min(row), last.max(row), rows + 1);
        }
        let span = last + 1 - first;
        let long = span as f64 * grid.row_m >= length;
        let narrow = chain.len() <= widest * rows;
        if long && narrow && rows as f64 >= FILLED_SHARE * span as f64 {
            things += 1;
            chain.iter().for_each(|&cell| taken[cell] = true);
        }
    }
    let near: Vec<bool> = (0..grid.len()).map(|c| taken[c] || grid.neighbours(c, 1).any(|n| taken[n])).collect();
    let mut points = 0;
    for cell in (0..grid.len()).filter(|&c| near[c]) {
        for (p, &i) in cells.in_cell(cell).iter().zip(cells.indices_in_cell(cell)) {
            if class[i as usize] == Class::Wall && stands_out(cell, p.depth) > BESIDE_M {
                class[i as usize] = Class::Furniture;
                points += 1;
            }
        }
    }
    (things, points)
}

/// Largest depth within `half` columns, then the smallest of those; unknown cells take no part.
fn closing_across(grid: &Grid, far: &[f64], half: usize) -> Vec<f64> {
    let window = |field: &[f64], pick: fn(f64, f64) -> f64| -> Vec<f64> {
        (0..grid.len())
            .into_par_iter()
            .map(|cell| {
                let (i, j) = (cell / grid.columns, cell % grid.columns);
                (0..2 * half + 1)
                    .map(|d| field[i * grid.columns + (j + grid.columns + d - half) % grid.columns])
                    .filter(|v| !v.is_nan())
                    .fold(f64::NAN, |a, b| if a.is_nan() { b } else { pick(a, b) })
            })
            .collect()
    };
    window(&window(far, f64::max), f64::min)
}

/// Cells that hang together: beside each other, or along the tunnel over a gap. Each list ascends.
fn chains(grid: &Grid, is_core: &[bool]) -> Vec<Vec<usize>> {
    let gap = ((GAP_M / grid.row_m).ceil() as usize).max(1);
    let mut seen = vec![false; grid.len()];
    let mut chains = Vec::new();
    for start in (0..grid.len()).filter(|&c| is_core[c]) {
        if std::mem::replace(&mut seen[start], true) {
            continue;
        }
        let mut chain = vec![start];
        let mut next = 0;
        while next < chain.len() {
            let (i, j) = (chain[next] / grid.columns, chain[next] % grid.columns);
            next += 1;
            for row in i.saturating_sub(gap)..(i + gap + 1).min(grid.rows) {
                for d in 0..3 {
                    let cell = row * grid.columns + (j + grid.columns + d - 1) % grid.columns;
                    if is_core[cell] && !std::mem::replace(&mut seen[cell], true) {
                        chain.push(cell);
                    }
                }
            }
        }
        chain.sort_unstable();
        chains.push(chain);
    }
    chains
}
