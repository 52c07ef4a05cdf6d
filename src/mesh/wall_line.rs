//! The wall line: where the wall opens into side spaces, and where it would go on if it did not.
//!
//! Cost: linear in points and cells.

use super::openings::{self, SideOpening};
use crate::axis::{Axis, AxisCoordinates};
use crate::numeric::statistics;
use crate::segment::unrolled_grid::Grid;
use crate::segment::{SectionField, Segmentation};
use std::f64::consts::TAU;
use std::ops::Range;

/// The wall beside an opening is looked for over this many mean radii, and so many cells away from the rim, which may be a cheek.
const WALL_IN_RADII: f64 = 0.25;
const RIM_CELLS: usize = 2;
/// Sweeps that take the steps from a continued wall.
const SMOOTHING_SWEEPS: usize = 6;

/// Where the wall opens into side spaces, and where it would go on.
pub struct WallLine {
    grid: Grid,
    /// Depth of the surface in each cell, metres behind the mean section, NaN without one.
    depth: Vec<f64>,
    open: Vec<bool>,
    behind_m: f64,
    pub openings: Vec<SideOpening>,
}

impl WallLine {
    /// Finds the side openings of a surface whose depth in each cell of the grid is given, NaN without one.
    pub fn of(grid: Grid, depth: Vec<f64>, segmentation: &Segmentation, axis: &Axis) -> Self {
        let (open, openings) = openings::find(&grid, segmentation, axis, &depth);
        Self { behind_m: openings::behind_m(&segmentation.section), grid, depth, open, openings }
    }

    /// Whether a place lies in a side opening or behind it.
    pub fn is_open(&self, c: &AxisCoordinates, section: &SectionField) -> bool {
        let p = self.grid.unroll(section, c);
        // The cheeks of a side drift lie over the cells of its rim.
        self.grid.cell_at(&p).is_some_and(|cell| {
            self.open[cell] || (p.depth > self.behind_m && self.grid.neighbours(cell, 2).any(|n| self.open[n]))
        })
    }

    /// The unrolled grid.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Whether each cell lies in a side opening.
    pub fn open(&self) -> &[bool] {
        &self.open
    }

    /// The wall as if there were no openings: a place in each of their cells.
    pub fn places_over_openings(&self, section: &SectionField) -> Vec<AxisCoordinates> {
        let depth = self.continued(section);
        let open = (0..self.grid.len()).filter(|&c| self.open[c]);
        open.map(|c| self.grid.place(section, &self.grid.middle(c, depth[c]))).collect()
    }

    /// Depth in each cell as if there were no openings.
    pub fn continued(&self, section: &SectionField) -> Vec<f64> {
        continue_wall(&self.grid, section, &self.depth, &self.open)
    }
}

/// Depth in each cell with the wall continued over the `open` ones: a line along the tunnel runs straight from the wall before an
/// opening to the wall after it, so that the foot of the wall and the shoulder of the roof go on; where there is only one of
/// both it goes on straight, and without any the wall lies on the mean section.
fn continue_wall(grid: &Grid, section: &SectionField, depth: &[f64], open: &[bool]) -> Vec<f64> {
    // Radii and not depths: what was seen of a side drift may dent the mean section at its mouth.
    let mean_radius = |cell: usize| grid.place(section, &grid.middle(cell, 0.0)).radius();
    let window = (WALL_IN_RADII * section.mean_perimeter() / TAU / grid.row_m).ceil() as usize;
    let wall = |rows: Range<usize>, column: usize| {
        let cells = rows.map(|i| i * grid.columns + column).filter(|&c| !open[c] && !depth[c].is_nan());
        statistics::median(&mut cells.map(|c| mean_radius(c) + depth[c]).collect::<Vec<_>>())
    };
    let mut continued = depth.to_vec();
    for column in 0..grid.columns {
        let is_open = |row: usize| open[row * grid.columns + column];
        let mut row = 0;
        while row < grid.rows {
            let first = row;
            while row < grid.rows && is_open(row) {
                row += 1;
            }
            if row == first {
                row += 1;
                continue;
            }
            let before = wall(first.saturating_sub(RIM_CELLS + window)..first.saturating_sub(RIM_CELLS), column);
            let after = wall(row + RIM_CELLS..(row + RIM_CELLS + window).min(grid.rows), column);
            for i in first..row {
                let (cell, share) = (i * grid.columns + column, (i + 1 - first) as f64 / (row + 1 - first) as f64);
                continued[cell] = match (before, after) {
                    (Some(before), Some(after)) => before + (after - before) * share - mean_radius(cell),
                    (Some(radius), None) | (None, Some(radius)) => radius - mean_radius(cell),
                    (None, None) => 0.0,
                };
            }
        }
    }
    let opened: Vec<usize> = (0..grid.len()).filter(|&c| open[c]).collect();
    for _ in 0..SMOOTHING_SWEEPS {
        for &cell in &opened {
            let around = grid.neighbours(cell, 1).filter(|&n| !continued[n].is_nan());
            let (sum, count) = around.fold((0.0, 0.0), |(s, n), c| (s + continued[c], n + 1.0));
            if count > 0.0 {
                continued[cell] = sum / count;
            }
        }
    }
    continued
}
