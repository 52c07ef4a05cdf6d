//! The octree as a stack of sparse grids: each level is a sorted list of bricks of 2 x 2 x 2 cells with their 27 nodes.
//!
//! A brick of one level is a cell of the level above it, so the levels are nested. Functions of a level are trilinear on
//! its cells; a node whose eight cells all belong to the level is *free*, the others carry what the coarser level says.
//! Everything is computed brick by brick into 27 slots of its own, and a node adds up its slots in fixed order, so results
//! do not depend on the number of threads.
//!
//! Cost: about 700 bytes a brick at work; a sort of the nodes of each level.

use crate::numeric::Vec3;
use rayon::prelude::*;

/// No brick.
pub(super) const NONE: u32 = u32::MAX;
/// Nodes of a brick; `x` fastest.
pub(super) const NODES: usize = 27;
/// Offsets of a cell's corners from its first node in a brick.
pub(super) const CORNERS: [usize; 8] = [0, 1, 3, 4, 9, 10, 12, 13];
/// Most cells along the longest side of the coarsest level, without its margin.
const ROOT_CELLS: f64 = 8.0;
/// Most cells along one axis of the finest level: what a key of 64 bits can number.
const MOST_CELLS: f64 = 1_048_576.0;

/// Where the cells of each level lie.
pub(super) struct Grid {
    pub origin: Vec3,
    /// Edge of a cell of the finest level, metres.
    pub cell_m: f64,
    /// Number of the finest level; the coarsest is 0.
    pub depth: u32,
    /// Bricks of the coarsest level along each axis.
    root: [u32; 3],
}

impl Grid {
    /// A grid around a box, with a margin of at least one of its coarsest cells. A box too large for its cells gets larger
    /// cells.
    pub fn around(low: Vec3, high: Vec3, cell_m: f64) -> Self {
        let extent = high - low;
        let cell_m = cell_m.max(extent.max() / (0.5 * MOST_CELLS));
        // A point needs a level above its own to tell its density.
        let mut depth = 1u32;
        while extent.max() / (cell_m * f64::from(1u32 << depth)) > ROOT_CELLS {
            depth += 1;
        }
        let root_m = cell_m * f64::from(1u32 << depth);
        let root: [u32; 3] = extent.map(|e| ((e / root_m).floor() as u32 + 4).div_ceil(2)).into();
        let middle = (low + high) / 2.0;
        let origin = middle - Vec3::from(root.map(|r| f64::from(r) * root_m));
        Self { origin, cell_m, depth, root }
    }

    /// Edge of a cell of a level, metres.
    pub fn cell_of_level(&self, level: usize) -> f64 {
        self.cell_m * f64::from(1u32 << (self.depth as usize - level))
    }

    /// Key of the finest cell around a point inside the grid.
    pub fn key(&self, p: &Vec3) -> u64 {
        key_of(((p - self.origin) / self.cell_m).map(|c| c.max(0.0) as u32).into())
    }

    /// How far a key of the finest cells has to be shifted to be that of the brick of a level.
    pub fn shift(&self, level: usize) -> u32 {
        3 * (self.depth + 1 - level as u32)
    }
}

/// Interleaves the bits of three coordinates, `x` lowest.
pub(super) fn key_of([x, y, z]: [u32; 3]) -> u64 {
    spread(x) | spread(y) << 1 | spread(z) << 2
}

/// Inverse of [`key_of`].
pub(super) fn coordinates_of(key: u64) -> [u32; 3] {
    [gather_bits(key), gather_bits(key >> 1), gather_bits(key >> 2)]
}

fn spread(v: u32) -> u64 {
    let mut x = u64::from(v) & 0x1f_ffff;
    x = (x | x << 32) & 0x001f_0000_0000_ffff;
    x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

fn gather_bits(key: u64) -> u32 {
    let mut x = key & 0x1249_2492_4924_9249;
    x = (x | x >> 2) & 0x10c3_0c30_c30c_30c3;
    x = (x | x >> 4) & 0x100f_00f0_0f00_f00f;
    x = (x | x >> 8) & 0x001f_0000_ff00_00ff;
    x = (x | x >> 16) & 0x001f_0000_0000_ffff;
    ((x | x >> 32) & 0x1f_ffff) as u32
}

/// One level of the octree.
pub(super) struct Level {
    /// Edge of a cell, metres.
    pub cell_m: f64,
    /// Keys of the bricks, ascending.
    pub bricks: Vec<u64>,
    /// For each brick, the brick of the coarser level of which it is cell `key & 7`.
    pub parent: Vec<u32>,
    /// For each brick, the bricks of the finer level that are its cells.
    pub children: Vec<[u32; 8]>,
    /// For each brick, its nodes.
    pub nodes: Vec<[u32; NODES]>,
    /// For each node, where its slots begin in `slots`.
    first: Vec<u32>,
    slots: Vec<u32>,
    /// Whether the functions of this level decide the value of a node.
    pub free: Vec<bool>,
    /// For each brick, the first of its points and the one after its last.
    pub points: Vec<[u32; 2]>,
}

impl Level {
    /// The coarsest level: all of the box.
    pub fn root(grid: &Grid, point_keys: &[u64]) -> Self {
        let [nx, ny, nz] = grid.root;
        let mut bricks: Vec<u64> =
            (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| key_of([x, y, z])))).collect();
        bricks.sort_unstable();
        let mut level = Self::of_bricks(grid, 0, bricks, Vec::new(), point_keys);
        level.free.iter_mut().for_each(|f| *f = true);
        level
    }

    /// The next level: finer cells around those points that `wanted` names, with at least one cell beyond theirs.
    pub fn finer(&mut self, grid: &Grid, level: usize, point_keys: &[u64], wanted: &[bool]) -> Option<Self> {
        let shift = grid.shift(level) - 3;
        let mut cells: Vec<u64> =
            point_keys.par_iter().zip(wanted).filter(|(_, w)| **w).map(|(k, _)| k >> shift).collect();
        cells.dedup();
        let mut bricks: Vec<u64> = cells
            .par_iter()
            .flat_map_iter(|&cell| {
                let c = coordinates_of(cell);
                (0..8u32).map(move |o| key_of([0, 1, 2].map(|a| (c[a] + 2 * (o >> a & 1) - 1) >> 1)))
            })
            .collect();
        bricks.par_sort_unstable();
        bricks.dedup();
        if bricks.is_empty() {
            return None;
        }
        let parent: Vec<u32> = bricks
            .par_iter()
            .map(|k| self.bricks.binary_search(&(k >> 3)).expect("the coarser level reaches farther") as u32)
            .collect();
        for (i, (key, &p)) in bricks.iter().zip(&parent).enumerate() {
            self.children[p as usize][(key & 7) as usize] = i as u32;
        }
        Some(Self::of_bricks(grid, level, bricks, parent, point_keys))
    }

    fn of_bricks(grid: &Grid, level: usize, bricks: Vec<u64>, parent: Vec<u32>, point_keys: &[u64]) -> Self {
        let mut keyed: Vec<(u64, u32)> = vec![(0, 0); NODES * bricks.len()];
        keyed.par_chunks_mut(NODES).zip(&bricks).enumerate().for_each(|(b, (out, &key))| {
            let [x, y, z] = coordinates_of(key).map(|c| [0, 1, 2].map(|i| spread(2 * c + i)));
            for (k, slot) in out.iter_mut().enumerate() {
                *slot = (x[k % 3] | y[k / 3 % 3] << 1 | z[k / 9] << 2, (NODES * b + k) as u32);
            }
        });
        keyed.par_sort_unstable();
        let mut nodes = vec![[0u32; NODES]; bricks.len()];
        let mut first = Vec::with_capacity(keyed.len() / 2);
        let mut free = Vec::with_capacity(keyed.len() / 2);
        let mut cells_around = 0;
        for (i, &(key, slot)) in keyed.iter().enumerate() {
            if i == 0 || keyed[i - 1].0 != key {
                first.push(i as u32);
                free.push(false);
                cells_around = 0;
            }
            let k = slot as usize % NODES;
            cells_around += [k % 3, k / 3 % 3, k / 9].iter().map(|&c| if c == 1 { 2 } else { 1 }).product::<usize>();
            let last = free.len() - 1;
            free[last] = cells_around == 8;
            nodes[slot as usize / NODES][k] = last as u32;
        }
        first.push(keyed.len() as u32);
        let slots = keyed.into_par_iter().map(|(_, slot)| slot).collect();
        let shift = grid.shift(level);
        let points = bricks
            .par_iter()
            .map(|&key| [key, key + 1].map(|k| point_keys.partition_point(|p| *p < k << shift) as u32))
            .collect();
        let children = vec![[NONE; 8]; bricks.len()];
        let cell_m = grid.cell_of_level(level);
        Self { cell_m, bricks, parent, children, nodes, first, slots, free, points }
    }

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.free.len()
    }

    /// The values at the nodes of a brick.
    pub fn load(&self, brick: usize, values: &[f64]) -> [f64; NODES] {
        self.nodes[brick].map(|n| values[n as usize])
    }

    /// Adds up at the nodes what `fill` writes into the slots of each brick, which are zero before. `slots` is kept for
    /// the next call.
    pub fn assemble(&self, slots: &mut Vec<[f64; NODES]>, fill: impl Fn(usize, &mut [f64; NODES]) + Sync) -> Vec<f64> {
        slots.resize(self.bricks.len(), [0.0; NODES]);
        slots.par_iter_mut().enumerate().with_min_len(64).for_each(|(b, out)| {
            *out = [0.0; NODES];
            fill(b, out);
        });
        let flat: &[f64] = slots.as_flattened();
        (0..self.len())
            .into_par_iter()
            .with_min_len(1024)
            .map(|n| {
                self.slots[self.first[n] as usize..self.first[n + 1] as usize].iter().map(|&s| flat[s as usize]).sum()
            })
            .collect()
    }

    /// The place of a point in a brick, in cells from its first node: 0 to 2.
    pub fn local(&self, grid: &Grid, brick: usize, p: &Vec3) -> [f64; 3] {
        let b = coordinates_of(self.bricks[brick]);
        let q = (p - grid.origin) / self.cell_m;
        [0, 1, 2].map(|a| (q[a] - 2.0 * f64::from(b[a])).clamp(0.0, 2.0))
    }

    /// Values of the coarser level at the nodes of this one.
    pub fn prolong(&self, coarser: &Level, values: &[f64]) -> Vec<f64> {
        (0..self.len())
            .into_par_iter()
            .with_min_len(1024)
            .map(|n| {
                let slot = self.slots[self.first[n] as usize] as usize;
                let (brick, k) = (slot / NODES, slot % NODES);
                let corners = coarser.corners(self.parent[brick] as usize, (self.bricks[brick] & 7) as usize);
                let at = weights_in_cell([k % 3, k / 3 % 3, k / 9].map(|c| 0.5 * c as f64));
                (0..8).map(|c| at[c] * values[corners[c] as usize]).sum()
            })
            .collect()
    }

    /// Transpose of [`Self::prolong`]: what functionals of this level's nodes say of the coarser level's.
    pub fn restrict(&self, coarser: &Level, values: &[f64], slots: &mut Vec<[f64; NODES]>) -> Vec<f64> {
        coarser.assemble(slots, |b, out| {
            for (octant, &child) in coarser.children[b].iter().enumerate().filter(|(_, c)| **c != NONE) {
                let base = first_node(octant);
                for (k, &n) in self.nodes[child as usize].iter().enumerate() {
                    // Each node once, by the brick of its first slot.
                    if self.slots[self.first[n as usize] as usize] as usize == NODES * child as usize + k {
                        let at = weights_in_cell([k % 3, k / 3 % 3, k / 9].map(|c| 0.5 * c as f64));
                        (0..8).for_each(|c| out[base + CORNERS[c]] += at[c] * values[n as usize]);
                    }
                }
            }
        })
    }

    /// The nodes of a cell.
    pub fn corners(&self, brick: usize, octant: usize) -> [u32; 8] {
        let base = first_node(octant);
        CORNERS.map(|c| self.nodes[brick][base + c])
    }
}

/// The first node of a cell among those of its brick.
pub(super) fn first_node(octant: usize) -> usize {
    (octant & 1) + 3 * (octant >> 1 & 1) + 9 * (octant >> 2)
}

/// Trilinear weights of the corners of a cell at a place in it, 0 to 1 along each axis.
pub(super) fn weights_in_cell(t: [f64; 3]) -> [f64; 8] {
    let [x, y, z] = t.map(|t| [1.0 - t, t]);
    std::array::from_fn(|c| x[c & 1] * y[c >> 1 & 1] * z[c >> 2])
}

/// The cell of a place in a brick and the place in that cell.
pub(super) fn cell_of(local: [f64; 3]) -> (usize, [f64; 3]) {
    let upper = local.map(|c| usize::from(c >= 1.0));
    (upper[0] | upper[1] << 1 | upper[2] << 2, [0, 1, 2].map(|a| local[a] - upper[a] as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_hold_their_coordinates() {
        for c in [[0, 0, 0], [1, 2, 3], [1_048_575, 77, 524_288]] {
            assert_eq!(coordinates_of(key_of(c)), c);
        }
        assert_eq!(key_of([1, 0, 0]), 1);
    }

    #[test]
    fn levels_carry_linear_functions_and_the_transpose_is_one() {
        let points: Vec<Vec3> = (0..4000)
            .map(|i| {
                let (sin, cos) = (2.399_963 * f64::from(i)).sin_cos();
                Vec3::new(10.0 * f64::from(i) / 4000.0, cos, sin)
            })
            .collect();
        let (low, high) = crate::spatial::voxel_grid::bounds(&points).unwrap();
        let grid = Grid::around(low, high, 0.2);
        let mut keys: Vec<u64> = points.iter().map(|p| grid.key(p)).collect();
        keys.sort_unstable();
        let mut levels = vec![Level::root(&grid, &keys)];
        for l in 1..=grid.depth as usize {
            let next = levels[l - 1].finer(&grid, l, &keys, &vec![true; keys.len()]).unwrap();
            levels.push(next);
        }
        let place = |level: &Level, brick: usize, k: usize| {
            let b = coordinates_of(level.bricks[brick]);
            grid.origin
                + Vec3::from([0, 1, 2].map(|a| f64::from(2 * b[a]) + [k % 3, k / 3 % 3, k / 9][a] as f64))
                    * level.cell_m
        };
        let linear = |p: &Vec3| 1.0 + p.x - 2.0 * p.y + 0.5 * p.z;
        let sample = |level: &Level| {
            let mut values = vec![0.0; level.len()];
            for b in 0..level.bricks.len() {
                (0..NODES).for_each(|k| values[level.nodes[b][k] as usize] = linear(&place(level, b, k)));
            }
            values
        };
        for pair in levels.windows(2) {
            let (coarse, fine) = (&pair[0], &pair[1]);
            let prolonged = fine.prolong(coarse, &sample(coarse));
            for (a, b) in prolonged.iter().zip(&sample(fine)) {
                assert!((a - b).abs() < 1e-9);
            }
            let dual: Vec<f64> = (0..fine.len()).map(|i| (i as f64 * 0.37).sin()).collect();
            let start: Vec<f64> = (0..coarse.len()).map(|i| (i as f64 * 0.71).cos()).collect();
            let restricted = fine.restrict(coarse, &dual, &mut Vec::new());
            let left: f64 = restricted.iter().zip(&start).map(|(a, b)| a * b).sum();
            let right: f64 = dual.iter().zip(&fine.prolong(coarse, &start)).map(|(a, b)| a * b).sum();
            assert!((left - right).abs() < 1e-9 * (1.0 + right.abs()), "{left} {right}");
            assert!(fine.free.iter().any(|f| *f) && fine.free.iter().any(|f| !*f));
        }
    }
}
