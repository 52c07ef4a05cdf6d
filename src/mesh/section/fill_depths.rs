//! Depths between measurements: a thin plate from rim to rim.

use super::support::Node;
use crate::segment::unrolled_grid::{Grid, GridPoint};
use rayon::prelude::*;

/// Sweeps of the thin-plate fill; gaps of ten cells are smooth by then.
const FILL_SWEEPS: usize = 60;

/// Depths of bridged and filled nodes: a front of averages moves inwards, then a thin plate relaxes it.
pub(super) fn fill_depths(grid: &Grid, state: &[Node], places: &mut [GridPoint]) {
    const UNKNOWN: u32 = u32::MAX;
    let columns = grid.columns;
    // Round in which a node got its first value.
    let has_depth = |s: Node| matches!(s, Node::Measured | Node::Closed);
    let mut known: Vec<u32> = state.iter().map(|s| if has_depth(*s) { 0 } else { UNKNOWN }).collect();
    let mut front: Vec<usize> = (0..grid.len()).filter(|&n| matches!(state[n], Node::Bridged | Node::Filled)).collect();
    let unknown = front.clone();
    let mut round = 0;
    while !front.is_empty() {
        round += 1;
        let mut later = Vec::new();
        let mut reached = Vec::new();
        for &n in &front {
            let (mut sum, mut weight) = (0.0, 0.0);
            for m in grid.neighbours(n, 1).filter(|&m| known[m] < round) {
                let w = 1.0 / grid.distance(n, m).powi(2);
                sum += w * places[m].depth;
                weight += w;
            }
            if weight > 0.0 { reached.push((n, sum / weight)) } else { later.push(n) }
        }
        if reached.is_empty() {
            break; // Not connected to any measurement: cannot happen after a closing, and would stay at depth 0.
        }
        for (n, depth) in reached {
            places[n].depth = depth;
            known[n] = round;
        }
        front = later;
    }
    // Gauss-Seidel on the 13-point biharmonic stencil where all of it exists, on the mean of the neighbours elsewhere.
    let along = (grid.column_m / grid.row_m).powi(2);
    let present = |n: usize| state[n] != Node::Absent;
    let step = |n: usize, di: isize, dj: isize| -> Option<usize> {
        let i = (n / columns) as isize + di;
        let j = (n % columns) as isize + dj;
        let inside = i >= 0 && i < grid.rows as isize;
        let m = i as usize % grid.rows * columns + j.rem_euclid(columns as isize) as usize;
        (inside && present(m)).then_some(m)
    };
    // Laplacian with weight `along` for rows: stencil of its square.
    let (a, diagonal) = (along, 6.0 * along * along + 8.0 * along + 6.0);
    let ring: [(isize, isize, f64); 12] = [
        (-1, 0, -4.0 * a * (a + 1.0)),
        (1, 0, -4.0 * a * (a + 1.0)),
        (0, -1, -4.0 * (a + 1.0)),
        (0, 1, -4.0 * (a + 1.0)),
        (-1, -1, 2.0 * a),
        (-1, 1, 2.0 * a),
        (1, -1, 2.0 * a),
        (1, 1, 2.0 * a),
        (-2, 0, a * a),
        (2, 0, a * a),
        (0, -2, 1.0),
        (0, 2, 1.0),
    ];
    // The sweeps run one node after the other: where each node's neighbours lie is told beforehand.
    const NOWHERE: u32 = u32::MAX;
    let around: Vec<[u32; 12]> =
        unknown.par_iter().map(|&n| ring.map(|(di, dj, _)| step(n, di, dj).map_or(NOWHERE, |m| m as u32))).collect();
    let mut depth: Vec<f64> = places.par_iter().map(|p| p.depth).collect();
    let mean_weights = [a, a, 1.0, 1.0];
    for sweep in 0..FILL_SWEEPS {
        for k in 0..unknown.len() {
            let k = if sweep % 2 == 0 { k } else { unknown.len() - 1 - k };
            let (n, beside) = (unknown[k], &around[k]);
            if !beside.contains(&NOWHERE) {
                let sum: f64 = ring.iter().zip(beside).map(|((_, _, w), &m)| w * depth[m as usize]).sum();
                depth[n] = -sum / diagonal;
                continue;
            }
            let (mut sum, mut weight) = (0.0, 0.0);
            for (w, &m) in mean_weights.iter().zip(beside).filter(|(_, m)| **m != NOWHERE) {
                sum += w * depth[m as usize];
                weight += w;
            }
            if weight > 0.0 {
                depth[n] = sum / weight;
            }
        }
    }
    unknown.iter().for_each(|&n| places[n].depth = depth[n]);
}
