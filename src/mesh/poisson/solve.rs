//! The screened Poisson equation on the octree: from oriented points to a function that rises through the surface.
//!
//! | symbol | meaning |
//! |---|---|
//! | `u` | the function, positive in the void; its mean over the points is the value on the surface |
//! | `V` | density of the normals: each point's normal times its area, spread over the cell of its depth |
//! | `B_i` | trilinear function of a node |
//! | `h` | edge of a cell of the level |
//! | `alpha` | weight of the points' own values, [`SCREENING`] |
//!
//! On each level, coarse to fine: `sum_j (int grad B_i . grad B_j + alpha / h sum_p a_p B_i(p) B_j(p)) u_j = int V . grad B_i`
//! for the free nodes, by conjugate gradients from the coarser level's values; the nodes at the rim of a level keep these.

use super::octree::{CORNERS, Grid, Level, NODES, cell_of, first_node, weights_in_cell};
use crate::numeric::{Vec3, conjugate_gradients};
use rayon::prelude::*;
use std::cell::RefCell;

/// Weight of the points' own values against the gradients, as in the reference implementation of the paper.
const SCREENING: f64 = 4.0;
/// A point goes one level deeper while the cells there would hold this many points.
const POINTS_A_CELL: f64 = 1.0;
/// Mean over the places in a cell of what a point of a plane counts at its own place (`2/3` for a plane along the axes).
const SHARE_OF_DENSITY: f64 = 2.0 / 3.0;
/// How far the residual falls on the coarsest level and on the others, and the most steps.
const ROOT_SHARE: f64 = 1e-9;
const ROOT_STEPS: usize = 400;
const SHARE: f64 = 1e-3;
const STEPS: usize = 40;

/// Oriented points along the octree's curve.
pub(super) struct Samples {
    pub points: Vec<Vec3>,
    pub normals: Vec<Vec3>,
    pub keys: Vec<u64>,
    /// Area that a point stands for, square metres.
    pub area: Vec<f64>,
    /// The level at which a point is spread.
    pub depth: Vec<u8>,
}

/// The function on all levels.
pub(super) struct Solution {
    pub grid: Grid,
    pub levels: Vec<Level>,
    /// Values at the nodes of each level, less that of the surface.
    pub values: Vec<Vec<f64>>,
    pub samples: Samples,
    /// Steps of conjugate gradients on each level, and whether the residual fell as far as wanted.
    pub steps: Vec<(usize, bool)>,
}

/// Solves for points and unit normals into the void; there is at least one point.
pub(super) fn solve(grid: Grid, points: &[Vec3], normals: &[Vec3]) -> Solution {
    let mut order: Vec<(u64, u32)> = points.par_iter().enumerate().map(|(i, p)| (grid.key(p), i as u32)).collect();
    order.par_sort_unstable();
    let mut samples = Samples {
        points: order.par_iter().map(|&(_, i)| points[i as usize]).collect(),
        normals: order.par_iter().map(|&(_, i)| normals[i as usize]).collect(),
        keys: order.par_iter().map(|o| o.0).collect(),
        area: vec![0.0; order.len()],
        depth: vec![0; order.len()],
    };
    drop(order);
    let levels = refine(&grid, &mut samples);
    let mut slots = Vec::new();

    // The vector field of each level, its own and with that of the coarser ones, and the right sides.
    let mut loads = Vec::with_capacity(levels.len());
    let mut own = Vec::with_capacity(levels.len());
    let mut all: [Vec<f64>; 3] = Default::default();
    for (l, level) in levels.iter().enumerate() {
        let spread = [0, 1, 2].map(|a| spread_normals(&grid, level, l, &samples, a, &mut slots));
        own.push(divergence(level, &spread, &mut slots));
        if l > 0 {
            for (a, field) in all.iter_mut().enumerate() {
                let mut sum = level.prolong(&levels[l - 1], field);
                sum.par_iter_mut().zip(&spread[a]).for_each(|(s, v)| *s += v);
                *field = sum;
            }
        } else {
            all = spread;
        }
        loads.push(divergence(level, &all, &mut slots));
    }
    drop(all);
    // What finer levels say of the coarser ones.
    let mut finer = own.pop().expect("a level");
    for l in (0..levels.len() - 1).rev() {
        let from_finer = levels[l + 1].restrict(&levels[l], &finer, &mut slots);
        loads[l].par_iter_mut().zip(&from_finer).for_each(|(b, f)| *b += f);
        finer = own.pop().expect("one for each level");
        finer.par_iter_mut().zip(&from_finer).for_each(|(b, f)| *b += f);
    }
    drop(finer);

    let slots = RefCell::new(slots);
    let mut values: Vec<Vec<f64>> = Vec::with_capacity(levels.len());
    let mut steps = Vec::with_capacity(levels.len());
    for (l, level) in levels.iter().enumerate() {
        let mut u = if l == 0 { vec![0.0; level.len()] } else { level.prolong(&levels[l - 1], &values[l - 1]) };
        let operator = Operator::new(&grid, level, &samples);
        let multiply = |x: &[f64]| operator.apply(x, &mut slots.borrow_mut());
        let au = multiply(&u);
        let right: Vec<f64> =
            (0..level.len()).into_par_iter().map(|i| if level.free[i] { loads[l][i] - au[i] } else { 0.0 }).collect();
        let diagonal = operator.diagonal(&mut slots.borrow_mut());
        let precondition = |r: &[f64]| r.par_iter().zip(&diagonal).map(|(r, d)| r / d).collect();
        let (share, most) = if l == 0 { (ROOT_SHARE, ROOT_STEPS) } else { (SHARE, STEPS) };
        let outcome = conjugate_gradients::solve(multiply, precondition, &right, share, most);
        u.par_iter_mut().zip(&outcome.x).for_each(|(u, d)| *u += d);
        loads[l] = Vec::new();
        values.push(u);
        steps.push((outcome.steps, outcome.converged));
    }
    let mut solution = Solution { grid, levels, values, samples, steps };
    let surface = solution.mean_at_points();
    solution.values.iter_mut().for_each(|v| v.par_iter_mut().for_each(|u| *u -= surface));
    solution
}

/// Makes the levels from coarse to fine: a point goes on to the next one while enough others are near it.
fn refine(grid: &Grid, samples: &mut Samples) -> Vec<Level> {
    let mut levels = vec![Level::root(grid, &samples.keys)];
    let mut slots = Vec::new();
    for l in 0..grid.depth as usize {
        let level = &mut levels[l];
        let counts = level.assemble(&mut slots, |b, out| {
            let [from, to] = level.points[b];
            for p in &samples.points[from as usize..to as usize] {
                let (cell, t) = cell_of(level.local(grid, b, p));
                let at = weights_in_cell(t);
                (0..8).for_each(|c| out[first_node(cell) + CORNERS[c]] += at[c]);
            }
        });
        // Points whose brick is not on this level keep what the coarser one said.
        let told: Vec<(u32, f64)> = (0..level.bricks.len())
            .into_par_iter()
            .flat_map_iter(|b| {
                let values = level.load(b, &counts);
                let [from, to] = level.points[b];
                let (level, samples) = (&*level, &*samples);
                (from..to).map(move |i| {
                    let (cell, t) = cell_of(level.local(grid, b, &samples.points[i as usize]));
                    let at = weights_in_cell(t);
                    (i, (0..8).map(|c| at[c] * values[first_node(cell) + CORNERS[c]]).sum::<f64>())
                })
            })
            .collect();
        let mut wanted = vec![false; samples.points.len()];
        for (i, count) in told {
            let i = i as usize;
            if samples.depth[i] as usize == l {
                samples.area[i] = SHARE_OF_DENSITY * level.cell_m * level.cell_m / count;
                wanted[i] = count >= 4.0 * POINTS_A_CELL * SHARE_OF_DENSITY || l == 0;
                samples.depth[i] += u8::from(wanted[i]);
            }
        }
        match level.finer(grid, l + 1, &samples.keys, &wanted) {
            Some(next) => levels.push(next),
            None => break,
        }
    }
    levels
}

/// One component of the density of normals of the points that are spread at level `l`.
fn spread_normals(
    grid: &Grid,
    level: &Level,
    l: usize,
    samples: &Samples,
    axis: usize,
    slots: &mut Vec<[f64; NODES]>,
) -> Vec<f64> {
    let volume = level.cell_m.powi(3);
    level.assemble(slots, |b, out| {
        let [from, to] = level.points[b];
        for i in (from as usize..to as usize).filter(|&i| samples.depth[i] as usize == l) {
            let (cell, t) = cell_of(level.local(grid, b, &samples.points[i]));
            let at = weights_in_cell(t);
            let v = samples.normals[i][axis] * samples.area[i] / volume;
            (0..8).for_each(|c| out[first_node(cell) + CORNERS[c]] += at[c] * v);
        }
    })
}

/// `int V . grad B_i` at the nodes.
fn divergence(level: &Level, field: &[Vec<f64>; 3], slots: &mut Vec<[f64; NODES]>) -> Vec<f64> {
    let scale = level.cell_m * level.cell_m;
    level.assemble(slots, |b, out| {
        for (a, component) in field.iter().enumerate() {
            let v = level.load(b, component);
            let part = match a {
                0 => along_z(along_y(along_x(v, slope), mass), mass),
                1 => along_z(along_y(along_x(v, mass), slope), mass),
                _ => along_z(along_y(along_x(v, mass), mass), slope),
            };
            (0..NODES).for_each(|k| out[k] += scale * part[k]);
        }
    })
}

/// A cell with points: the weight and place of their mean.
struct Screen {
    octant: u8,
    weight: f64,
    place: [f64; 3],
}

/// The matrix of a level.
struct Operator<'a> {
    level: &'a Level,
    screens: Vec<Screen>,
    first_screen: Vec<u32>,
}

impl<'a> Operator<'a> {
    fn new(grid: &Grid, level: &'a Level, samples: &Samples) -> Self {
        let of_bricks: Vec<Vec<Screen>> = (0..level.bricks.len())
            .into_par_iter()
            .with_min_len(64)
            .map(|b| {
                let mut sums = [(0.0, [0.0; 3]); 8];
                let [from, to] = level.points[b];
                for i in from as usize..to as usize {
                    let (cell, t) = cell_of(level.local(grid, b, &samples.points[i]));
                    let (weight, place) = &mut sums[cell];
                    *weight += samples.area[i];
                    (0..3).for_each(|a| place[a] += samples.area[i] * t[a]);
                }
                let with_points = sums.iter().enumerate().filter(|(_, s)| s.0 > 0.0);
                with_points
                    .map(|(octant, &(sum, place))| Screen {
                        octant: octant as u8,
                        weight: SCREENING * sum / level.cell_m,
                        place: place.map(|p| p / sum),
                    })
                    .collect()
            })
            .collect();
        let mut first_screen = vec![0];
        for s in &of_bricks {
            first_screen.push(first_screen[first_screen.len() - 1] + s.len() as u32);
        }
        Self { level, screens: of_bricks.into_iter().flatten().collect(), first_screen }
    }

    fn screens_of(&self, brick: usize) -> &[Screen] {
        &self.screens[self.first_screen[brick] as usize..self.first_screen[brick + 1] as usize]
    }

    /// The product for vectors that are zero at nodes that are not free, or the whole of it; zero at those nodes.
    fn apply(&self, x: &[f64], slots: &mut Vec<[f64; NODES]>) -> Vec<f64> {
        let h = self.level.cell_m;
        let mut out = self.level.assemble(slots, |b, out| {
            let u = self.level.load(b, x);
            let (mx, kx) = (along_x(u, mass), along_x(u, stiffness));
            let (my, ky) = (along_y(mx, mass), along_y(mx, stiffness));
            let other = along_y(kx, mass);
            let both: [f64; NODES] = std::array::from_fn(|k| ky[k] + other[k]);
            let (first, second) = (along_z(both, mass), along_z(my, stiffness));
            (0..NODES).for_each(|k| out[k] = h * (first[k] + second[k]));
            for s in self.screens_of(b) {
                let (base, at) = (first_node(s.octant as usize), weights_in_cell(s.place));
                let value: f64 = (0..8).map(|c| at[c] * u[base + CORNERS[c]]).sum();
                (0..8).for_each(|c| out[base + CORNERS[c]] += s.weight * value * at[c]);
            }
        });
        out.par_iter_mut().zip(&self.level.free).filter(|(_, f)| !**f).for_each(|(o, _)| *o = 0.0);
        out
    }

    fn diagonal(&self, slots: &mut Vec<[f64; NODES]>) -> Vec<f64> {
        let of_corner = self.level.cell_m / 3.0;
        self.level.assemble(slots, |b, out| {
            for (octant, c) in (0..64).map(|i| (i / 8, i % 8)) {
                out[first_node(octant) + CORNERS[c]] += of_corner;
            }
            for s in self.screens_of(b) {
                let at = weights_in_cell(s.place);
                (0..8).for_each(|c| out[first_node(s.octant as usize) + CORNERS[c]] += s.weight * at[c] * at[c]);
            }
        })
    }
}

impl Solution {
    /// The mean of the function over the points, by their areas.
    fn mean_at_points(&self) -> f64 {
        let mut sums = (0.0, 0.0);
        for (l, (level, values)) in self.levels.iter().zip(&self.values).enumerate() {
            let parts: Vec<(f64, f64)> = (0..level.bricks.len())
                .into_par_iter()
                .with_min_len(64)
                .map(|b| {
                    let u = level.load(b, values);
                    let mut sum = (0.0, 0.0);
                    let [from, to] = level.points[b];
                    for i in (from as usize..to as usize).filter(|&i| self.samples.depth[i] as usize == l) {
                        let (cell, t) = cell_of(level.local(&self.grid, b, &self.samples.points[i]));
                        let at = weights_in_cell(t);
                        let value: f64 = (0..8).map(|c| at[c] * u[first_node(cell) + CORNERS[c]]).sum();
                        sum.0 += self.samples.area[i] * value;
                        sum.1 += self.samples.area[i];
                    }
                    sum
                })
                .collect();
            for part in parts {
                sums.0 += part.0;
                sums.1 += part.1;
            }
        }
        if sums.1 > 0.0 { sums.0 / sums.1 } else { 0.0 }
    }
}

// Integrals over the two cells between three nodes in a row, for cells of edge 1.

/// `int B_i B_j`.
#[inline(always)]
fn mass(a: f64, b: f64, c: f64) -> [f64; 3] {
    [(2.0 * a + b) / 6.0, (a + 4.0 * b + c) / 6.0, (b + 2.0 * c) / 6.0]
}

/// `int B_i' B_j'`.
#[inline(always)]
fn stiffness(a: f64, b: f64, c: f64) -> [f64; 3] {
    [a - b, 2.0 * b - a - c, c - b]
}

/// `int B_i' B_j`.
#[inline(always)]
fn slope(a: f64, b: f64, c: f64) -> [f64; 3] {
    [-(a + b) / 2.0, (a - c) / 2.0, (b + c) / 2.0]
}

#[inline(always)]
fn along_x(u: [f64; NODES], f: impl Fn(f64, f64, f64) -> [f64; 3]) -> [f64; NODES] {
    let mut out = [0.0; NODES];
    for k in 0..9 {
        let [a, b, c] = f(u[3 * k], u[3 * k + 1], u[3 * k + 2]);
        (out[3 * k], out[3 * k + 1], out[3 * k + 2]) = (a, b, c);
    }
    out
}

#[inline(always)]
fn along_y(u: [f64; NODES], f: impl Fn(f64, f64, f64) -> [f64; 3]) -> [f64; NODES] {
    let mut out = [0.0; NODES];
    for z in 0..3 {
        for k in 9 * z..9 * z + 3 {
            let [a, b, c] = f(u[k], u[k + 3], u[k + 6]);
            (out[k], out[k + 3], out[k + 6]) = (a, b, c);
        }
    }
    out
}

#[inline(always)]
fn along_z(u: [f64; NODES], f: impl Fn(f64, f64, f64) -> [f64; 3]) -> [f64; NODES] {
    let mut out = [0.0; NODES];
    for k in 0..9 {
        let [a, b, c] = f(u[k], u[k + 9], u[k + 18]);
        (out[k], out[k + 9], out[k + 18]) = (a, b, c);
    }
    out
}
