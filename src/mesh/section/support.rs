//! Which nodes of the grid belong to the surface, and whether anybody saw them.

use super::clusters::Cluster;
use super::fit::MAX_SHIFT;
use super::{Options, Reach, Summary};
use crate::mesh::openings::SideOpenings;
use crate::segment::unrolled_grid::{Grid, GridPoint, squared_distance};
use rayon::prelude::*;

/// State of one node of the grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Node {
    Absent,
    /// Has points.
    Measured,
    /// Close to points.
    Bridged,
    /// In a small hole.
    Filled,
    /// In a side opening that is closed.
    Closed,
}

/// A bridged node that leans towards the points comes this far into their reach, so that the way there in space may be longer.
const WITHIN_REACH: f64 = 0.95;

/// Which nodes belong to the surface, and why. The flags tell which cells hold furniture, and which a side opening. The places
/// of bridged nodes that lie just beyond the reach of the points lean towards them.
pub(super) fn support(
    grid: &Grid,
    clusters: &[Cluster],
    places: &mut [GridPoint],
    [furniture, open]: [&[bool]; 2],
    reach: Reach,
    options: &Options,
    summary: &mut Summary,
) -> Vec<Node> {
    let along_gap = reach.along_m;
    let around_gap = options.max_gap_m.max(if along_gap > options.max_gap_m { grid.column_m } else { 0.0 });
    let reach_rows = (along_gap / grid.row_m).ceil() as usize + 1;
    let reach_columns = ((around_gap / grid.column_m).ceil() as usize + 1).min((grid.columns - 1) / 2);
    let found: Vec<(Node, [f64; 2])> = (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            if clusters[cell].count > 0 {
                return (Node::Measured, [0.0; 2]);
            }
            let (i, j) = (cell / grid.columns, cell % grid.columns);
            let (mut nearest, mut towards) = (f64::INFINITY, [0.0; 2]);
            for other in i.saturating_sub(reach_rows)..(i + reach_rows + 1).min(grid.rows) {
                for d in 0..2 * reach_columns + 1 {
                    let n = other * grid.columns + (j + grid.columns + d - reach_columns) % grid.columns;
                    if clusters[n].count == 0 {
                        continue;
                    }
                    let rows = places[n].row - i as f64 - 0.5;
                    // The place's shift inside its cell, on top of whole columns.
                    let shift = places[n].column - (n % grid.columns) as f64 - 0.5;
                    let columns = d as f64 - reach_columns as f64 + shift;
                    let (dr, dc) = (rows * grid.row_m / along_gap, columns * grid.column_m / around_gap);
                    if dr * dr + dc * dc < nearest {
                        (nearest, towards) = (dr * dr + dc * dc, [rows, columns]);
                    }
                }
            }
            if nearest <= 1.0 { (Node::Bridged, towards) } else { (Node::Absent, [0.0; 2]) }
        })
        .collect();
    for (place, (_, [rows, columns])) in places.iter_mut().zip(&found).filter(|(_, (node, _))| *node == Node::Bridged) {
        let distance_m = (rows * grid.row_m).hypot(columns * grid.column_m);
        if distance_m > WITHIN_REACH * reach.in_space_m {
            let share = 1.0 - WITHIN_REACH * reach.in_space_m / distance_m;
            place.row += (share * rows).clamp(-MAX_SHIFT, MAX_SHIFT);
            place.column += (share * columns).clamp(-MAX_SHIFT, MAX_SHIFT);
        }
    }
    let mut state: Vec<Node> = found.into_iter().map(|(node, _)| node).collect();
    // Stretch the metric of profile scans, so that a hole counts by its width around the section.
    let scale = [grid.row_m * around_gap / along_gap, grid.column_m];
    if options.fill_hole_m > 0.0 {
        close(grid, &mut state, options.fill_hole_m / 2.0, scale, |_| true);
    }
    if options.fill_behind_furniture_m > options.fill_hole_m && furniture.iter().any(|f| *f) {
        // The shadow lies beside the thing as well, so the fill reaches out from it.
        let reach = options.fill_behind_furniture_m / 3.0;
        let from_furniture = squared_distance(furniture, grid.rows, grid.columns, scale);
        let near = |n: usize| from_furniture[n] <= reach * reach;
        close(grid, &mut state, options.fill_behind_furniture_m / 2.0, scale, near);
    }
    // The rim of an opening is the wall line: no bridge leads into it, and nothing in it counts as seen.
    let inside = match options.side_openings {
        SideOpenings::Hole => Some(Node::Absent),
        SideOpenings::Close => Some(Node::Closed),
        SideOpenings::Keep => None,
    };
    if let Some(inside) = inside {
        state.iter_mut().zip(open).filter(|(_, o)| **o).for_each(|(s, _)| *s = inside);
    }
    summary.cells_bridged = state.iter().filter(|s| **s == Node::Bridged).count();
    summary.cells_filled = state.iter().filter(|s| **s == Node::Filled).count();
    summary.cells_closed = state.iter().filter(|s| **s == Node::Closed).count();
    state
}

/// Morphological closing: grows the surface by `radius`, shrinks it back, and fills what stays beyond where `allowed`.
fn close(grid: &Grid, state: &mut [Node], radius: f64, scale: [f64; 2], allowed: impl Fn(usize) -> bool) {
    let margin = (radius / scale[0]).ceil() as usize + 2;
    let rows = grid.rows + 2 * margin;
    let mut present = vec![false; rows * grid.columns];
    for (p, s) in present[margin * grid.columns..].iter_mut().zip(state.iter()) {
        *p = *s != Node::Absent;
    }
    let grown = squared_distance(&present, rows, grid.columns, scale);
    let beyond: Vec<bool> = grown.iter().map(|d| *d > radius * radius).collect();
    let back = squared_distance(&beyond, rows, grid.columns, scale);
    for (n, (s, d)) in state.iter_mut().zip(&back[margin * grid.columns..]).enumerate() {
        if *s == Node::Absent && *d > radius * radius && allowed(n) {
            *s = Node::Filled;
        }
    }
}
