//! The surface out of the octree: cells that it passes through, divided down to the finest cell, handed to surface nets.
//!
//! The function is continuous across levels (what a finer level keeps at its rim is what the coarser one says there), and a
//! trilinear function has no zero in a cell whose corners have one sign. So the cells found are all there are, and cells
//! of different levels fit without cracks once they are divided.

use super::octree::{self, NONE};
use super::solve::Solution;
use crate::mesh::surface_nets::{Field, Net, SIDE};
use crate::numeric::Vec3;
use rayon::prelude::*;

/// A cell of the finest grid in one of the blocks that hold its corners.
struct Found {
    block: [i32; 3],
    cell: [u32; 3],
    values: [f32; 8],
}

/// Divides cells that the surface passes through.
struct Divider<'a> {
    solution: &'a Solution,
    /// Points of the leaf, when only what is near them is asked for.
    near: Option<&'a [Vec3]>,
    reach_m: f64,
}

/// The surface within about `reach_m` of the points, and the number of blocks of the grid it was taken from.
pub(super) fn surface(solution: &Solution, reach_m: f64) -> (Net, usize) {
    let mut found: Vec<Found> = Vec::new();
    for (l, level) in solution.levels.iter().enumerate() {
        let size = 1u32 << (solution.grid.depth as usize - l);
        // A leaf farther from points than half its edge; it may hold points that are too few for finer cells.
        let far = level.cell_m / 2.0 > reach_m;
        let of_level: Vec<Vec<Found>> = (0..level.bricks.len())
            .into_par_iter()
            .with_min_len(64)
            .map(|b| {
                let mut out = Vec::new();
                let points = level.points[b].map(|i| i as usize);
                let points = &solution.samples.points[points[0]..points[1]];
                if far && points.is_empty() {
                    return out;
                }
                let at = octree::coordinates_of(level.bricks[b]);
                for octant in (0..8).filter(|&o| level.children[b][o] == NONE) {
                    let values = level.corners(b, octant).map(|n| solution.values[l][n as usize]);
                    let cell = [0, 1, 2].map(|a| (2 * at[a] + (octant as u32 >> a & 1)) * size);
                    let divider = Divider { solution, near: far.then_some(points), reach_m };
                    divider.divide(cell, size, &values, &mut out);
                }
                out
            })
            .collect();
        found.extend(of_level.into_iter().flatten());
    }
    found.par_sort_unstable_by_key(|f| (f.block[2], f.block[1], f.block[0], f.cell));
    let groups: Vec<&[Found]> = found.chunk_by(|a, b| a.block == b.block).collect();
    let blocks = groups.iter().map(|g| g[0].block).collect();
    let mut field = Field::new(solution.grid.origin, solution.grid.cell_m, blocks);
    field.values.par_iter_mut().zip(&groups).for_each(|(values, group)| {
        for f in *group {
            for (c, value) in f.values.iter().enumerate() {
                let at = [0, 1, 2].map(|a| f.cell[a] as i32 + (c as i32 >> a & 1) - SIDE as i32 * f.block[a]);
                if at.iter().all(|&k| (0..SIDE as i32).contains(&k)) {
                    values[((at[2] * SIDE as i32 + at[1]) * SIDE as i32 + at[0]) as usize] = *value;
                }
            }
        }
    });
    let count = field.blocks.len();
    drop(found);
    (field.net(), count)
}

impl Divider<'_> {
    fn divide(&self, cell: [u32; 3], size: u32, values: &[f64; 8], out: &mut Vec<Found>) {
        let positive = values.iter().filter(|v| **v >= 0.0).count();
        if positive == 0 || positive == 8 || !self.is_near(cell, size) {
            return;
        }
        if size == 1 {
            let lower = cell.map(|c| (c / SIDE as u32) as i32);
            let upper = cell.map(|c| ((c + 1) / SIDE as u32) as i32);
            for z in lower[2]..=upper[2] {
                for y in lower[1]..=upper[1] {
                    for x in lower[0]..=upper[0] {
                        out.push(Found { block: [x, y, z], cell, values: values.map(|v| v as f32) });
                    }
                }
            }
            return;
        }
        for octant in 0..8u32 {
            let corner = |c: u32| {
                let t = [0, 1, 2].map(|a| 0.5 * f64::from((octant >> a & 1) + (c >> a & 1)));
                let at = octree::weights_in_cell(t);
                (0..8).map(|k| at[k] * values[k]).sum::<f64>()
            };
            let inner = [0, 1, 2, 3, 4, 5, 6, 7].map(corner);
            self.divide([0, 1, 2].map(|a| cell[a] + (octant >> a & 1) * (size / 2)), size / 2, &inner, out);
        }
    }

    fn is_near(&self, cell: [u32; 3], size: u32) -> bool {
        let Some(points) = self.near else { return true };
        let grid = &self.solution.grid;
        let low = grid.origin + Vec3::from(cell.map(f64::from)) * grid.cell_m;
        let high = low.add_scalar(f64::from(size) * grid.cell_m);
        points.iter().any(|p| (p - p.sup(&low).inf(&high)).norm_squared() <= self.reach_m * self.reach_m)
    }
}
