//! The *implicit* method: the zero surface of a local signed distance, for what is not star-shaped around the axis.
//!
//! Use it for caves, junctions, pillars and deep overhangs. It needs no axis to tell depth, only to tell which side is
//! the void (`void_side`); it knows of nothing farther away than its kernel, so it invents no surface. On a regular
//! tunnel `section` is faster and as exact.
//!
//! Method. On a sparse grid, each vertex near points gets the weighted mean of its distances from the planes of the
//! points (moving least squares: R. Kolluri, "Provably good moving least squares", ACM TALG 4(2), 2008,
//! doi:10.1145/1361192.1361195), twice: the second time, planes that disagree with the first mean lose weight (Tukey).
//! The distance grows into vertices without points near them by averages of their neighbours, as far as half of
//! `fill_hole_m` (J. Davis, S. Marschner, M. Garr, M. Levoy, "Filling holes in complex surfaces using volumetric
//! diffusion", 3DPVT 2002, doi:10.1109/TDPVT.2002.1024098). The zero surface comes out of `surface_nets`. What lies
//! farther than `max_gap_m` from every point is *filled* when it closes a hole, and removed when it hangs over an edge.
//!
//! | symbol | meaning |
//! |---|---|
//! | `h` | cell of the grid |
//! | `sigma` | width of the Gaussian weights, `SIGMA` `h` |
//!
//! Departures: weights end at `REACH` `h`, normals are those of plain neighbourhoods; no thin walls: two surfaces closer
//! than about `3 h` blend. Guarantees: no face farther from a point than `max_gap_m` unless it is marked filled; same
//! bytes on any number of threads. Cost: linear in points and surface; about 100 bytes a point and 2.5 KB a block of 8^3
//! grid vertices.

use super::surface_nets::{Field, Net, SIDE, VOLUME};
use super::void_side::{self, Sides};
use super::{VertexId, repair, topology};
use crate::axis::Axis;
use crate::normals;
use crate::numeric::Vec3;
use crate::spatial::KdTree;
use rayon::prelude::*;
use serde::Serialize;

/// Width of the Gaussian weights, in cells.
const SIGMA: f64 = 0.75;
/// Points farther than this from a grid vertex do not count, in cells.
const REACH: f64 = 2.0;
/// A grid vertex needs this much weight: one point at 1.4 sigma.
const LEAST_WEIGHT: f32 = 0.37;
/// Neighbours that make the plane of a point.
const NEIGHBOURS: usize = 16;
/// Default cell in distances between points, and not finer than this share of the perimeter (5 cm in a rail tunnel).
const CELL_IN_POINT_DISTANCES: f64 = 1.3;
const FINEST_SHARE_OF_PERIMETER: f64 = 1.0 / 550.0;
/// How far from the axis one looks for ways around the rock, in mean radii, along the edges of cells.
const WAY_IN_RADII: f64 = 4.0;
/// Most rounds of growth into holes.
const MOST_ROUNDS: usize = 12;

/// What the method was asked for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Options {
    /// Edge of a cell; chosen from the points when not given.
    pub spacing_m: Option<f64>,
    pub max_gap_m: f64,
    pub fill_hole_m: f64,
    /// Mean perimeter of the section, metres.
    pub perimeter_m: f64,
}

/// What was done, for the report.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Summary {
    /// Edge of a grid cell, metres.
    pub spacing_m: f64,
    /// Points given.
    pub points_used: usize,
    /// Points dropped because no side of them can be reached from the axis: buried inside the rock.
    pub points_hidden: usize,
    /// Points whose side was not clear; they face the axis.
    pub points_unclear: usize,
    /// Blocks of the grid.
    pub blocks: usize,
    /// Faces dropped because they hung over an edge, farther than `max_gap_m` from every point.
    pub unsupported_faces_dropped: usize,
    /// Faces that close holes narrower than `fill_hole_m`.
    pub faces_filled: usize,
}

/// Arrays of a surface that is not repaired yet.
pub(super) struct Raw {
    pub vertices: Vec<Vec3>,
    pub faces: Vec<[VertexId; 3]>,
    pub observed: Vec<bool>,
}

/// Builds the surface; see the module's header.
/// `walls` are all points that block the way, those of the surface included.
pub(super) fn reconstruct(points: Vec<Vec3>, walls: &[Vec3], axis: &Axis, options: &Options) -> (Raw, Summary) {
    let spacing_m = spacing(&points);
    let cell_m = options
        .spacing_m
        .unwrap_or_else(|| (CELL_IN_POINT_DISTANCES * spacing_m).max(options.perimeter_m * FINEST_SHARE_OF_PERIMETER));
    let mut summary = Summary { spacing_m: cell_m, points_used: points.len(), ..Summary::default() };
    let mut normals = normals::unoriented(&points, NEIGHBOURS);
    let Sides { hidden, unclear } = void_side::face_the_void(
        &points,
        &mut normals,
        walls,
        axis,
        spacing_m,
        WAY_IN_RADII * options.perimeter_m / std::f64::consts::TAU,
    );
    summary.points_hidden = hidden.iter().filter(|h| **h).count();
    summary.points_unclear = unclear;
    let (points, normals): (Vec<Vec3>, Vec<Vec3>) =
        points.into_iter().zip(normals).zip(&hidden).filter(|(_, h)| !**h).map(|(both, _)| both).unzip();
    if points.is_empty() {
        return (Raw { vertices: Vec::new(), faces: Vec::new(), observed: Vec::new() }, summary);
    }
    let gap_m = options.max_gap_m.max(1.5 * cell_m);
    let rounds = ((options.fill_hole_m / 2.0 / cell_m).ceil() as usize).min(MOST_ROUNDS);
    let mut field = distances(&points, &normals, cell_m, rounds);
    summary.blocks = field.blocks.len();
    (0..rounds).for_each(|_| grow(&mut field));
    let Net { vertices, faces } = field.net();
    drop(field);
    let tree = KdTree::new(&points);
    let far: Vec<f64> =
        vertices.par_iter().map(|v| tree.nearest(v).map_or(f64::INFINITY, |n| n.distance_squared.sqrt())).collect();
    let observed: Vec<bool> = faces.iter().map(|f| f.iter().all(|&v| far[v as usize] <= gap_m)).collect();
    (support(vertices, faces, observed, &far, options, &mut summary), summary)
}

/// Typical distance between neighbouring points, metres: of the square that each has on the surface.
fn spacing(points: &[Vec3]) -> f64 {
    const SAMPLE: usize = 4000;
    const AROUND: usize = 8;
    if points.len() <= AROUND {
        return 1.0;
    }
    let tree = KdTree::new(points);
    let mut areas: Vec<f64> = points
        .par_iter()
        .step_by(points.len().div_ceil(SAMPLE))
        .map(|p| tree.nearest_n(p, AROUND + 1).last().map_or(0.0, |n| n.distance_squared) * std::f64::consts::PI)
        .collect();
    (crate::numeric::statistics::median(&mut areas).unwrap_or(1.0) / AROUND as f64).sqrt().max(1e-6)
}

/// The weighted mean distance from the points' planes at the grid vertices near them.
fn distances(points: &[Vec3], normals: &[Vec3], cell_m: f64, rounds: usize) -> Field {
    // Points by block, in the grid's own order: neighbours in space are neighbours in memory.
    let block_m = SIDE as f64 * cell_m;
    let origin = points.iter().fold(points[0], |low, p| low.inf(p)).map(|c| (c / block_m).floor() * block_m);
    let block_of = |p: &Vec3| -> [i32; 3] { ((p - origin) / block_m).map(|c| c.floor() as i32).into() };
    let mut members: Vec<([i32; 3], u32)> =
        (0..points.len() as u32).map(|i| (block_of(&points[i as usize]), i)).collect();
    members.par_sort_unstable_by_key(|&([x, y, z], i)| (z, y, x, i));
    let mut groups: Vec<([i32; 3], std::ops::Range<usize>)> = Vec::new();
    let mut start = 0;
    for group in members.chunk_by(|a, b| a.0 == b.0) {
        groups.push((group[0].0, start..start + group.len()));
        start += group.len();
    }
    // Blocks that a point reaches, and those that growth may reach.
    let reach_m = (REACH + rounds as f64 + 1.0) * cell_m;
    let mut blocks: Vec<[i32; 3]> = groups
        .par_iter()
        .flat_map_iter(|(_, range)| {
            let inside = members[range.clone()].iter().map(|&(_, i)| &points[i as usize]);
            let (low, high) = inside
                .fold((Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY)), |(l, h), p| (l.inf(p), h.sup(p)));
            let (low, high) = (block_of(&low.add_scalar(-reach_m)), block_of(&high.add_scalar(reach_m)));
            (low[2]..=high[2])
                .flat_map(move |z| (low[1]..=high[1]).flat_map(move |y| (low[0]..=high[0]).map(move |x| [x, y, z])))
        })
        .collect();
    blocks.par_sort_unstable();
    blocks.dedup();
    let mut field = Field::new(origin, cell_m, blocks);
    let group_at = |b: [i32; 3]| {
        groups.binary_search_by_key(&(b[2], b[1], b[0]), |(g, _)| (g[2], g[1], g[0])).ok().map(|g| groups[g].1.clone())
    };
    let values: Vec<[f32; VOLUME]> = (0..field.blocks.len())
        .into_par_iter()
        .map(|block| {
            let b = field.blocks[block];
            let around: Vec<u32> = (0..27)
                .filter_map(|n| group_at([b[0] + n % 3 - 1, b[1] + n / 3 % 3 - 1, b[2] + n / 9 - 1]))
                .flat_map(|range| members[range].iter().map(|m| m.1))
                .collect();
            let base = field.place(block, [0, 0, 0]);
            let first = means(points, normals, &around, base, cell_m, None);
            means(points, normals, &around, base, cell_m, Some(&first))
        })
        .collect();
    field.values = values;
    field
}

/// Mean signed distances of a block's vertices from the planes of the points `around`; NaN without enough weight. With
/// the means of a first round, planes that are far from them lose weight.
fn means(
    points: &[Vec3],
    normals: &[Vec3],
    around: &[u32],
    base: Vec3,
    cell_m: f64,
    before: Option<&[f32; VOLUME]>,
) -> [f32; VOLUME] {
    let mut sum = [0.0f32; VOLUME];
    let mut weight = [0.0f32; VOLUME];
    let mut value = [f32::NAN; VOLUME];
    let range = |c: f64| {
        let low = (c - REACH).ceil().max(0.0);
        let high = (c + REACH).floor().min(SIDE as f64 - 1.0);
        if low <= high { low as usize..high as usize + 1 } else { 0..0 }
    };
    for &i in around {
        // Everything in cells from here on.
        let p = (points[i as usize] - base) / cell_m;
        let n = normals[i as usize];
        let (xs, ys, zs) = (range(p.x), range(p.y), range(p.z));
        for z in zs {
            let dz = z as f64 - p.z;
            for y in ys.clone() {
                let dy = y as f64 - p.y;
                let yz = dy * dy + dz * dz;
                if yz > REACH * REACH {
                    continue;
                }
                for x in xs.clone() {
                    let dx = x as f64 - p.x;
                    let d2 = dx * dx + yz;
                    if d2 > REACH * REACH {
                        continue;
                    }
                    let k = (z * SIDE + y) * SIDE + x;
                    let distance = dx * n.x + dy * n.y + dz * n.z;
                    let mut w = (-0.5 / (SIGMA * SIGMA) * d2).exp() as f32;
                    if let Some(before) = before {
                        // Half a cell off the mean is no noise but another sheet or an outlier.
                        let t = (distance as f32 - before[k] / cell_m as f32) / 0.75;
                        w *= if t.abs() < 1.0 { (1.0 - t * t) * (1.0 - t * t) } else { 0.0 };
                    }
                    sum[k] += w * distance as f32;
                    weight[k] += w;
                }
            }
        }
    }
    for k in 0..VOLUME {
        let least = if before.is_some() { 0.5 * LEAST_WEIGHT } else { 0.0 };
        let enough = weight[k] > least;
        value[k] = match before {
            // Sheets of equal weight on both sides of the mean: the plain mean is as good as any.
            Some(before) if !enough => before[k],
            _ if weight[k] > 0.0 => sum[k] / weight[k] * cell_m as f32,
            _ => f32::NAN,
        };
        if before.is_none() && weight[k] < LEAST_WEIGHT * 0.25 {
            value[k] = f32::NAN;
        }
    }
    value
}

/// One round of growth: vertices without a value take the mean of those neighbours along the axes that have one.
fn grow(field: &mut Field) {
    const WIDE: usize = SIDE + 2;
    let grown: Vec<[f32; VOLUME]> = (0..field.blocks.len())
        .into_par_iter()
        .map(|block| {
            let padded = field.padded(block);
            let mut out = field.values[block];
            for (k, value) in out.iter_mut().enumerate().filter(|(_, v)| v.is_nan()) {
                let at = ((k / SIDE / SIDE + 1) * WIDE + k / SIDE % SIDE + 1) * WIDE + k % SIDE + 1;
                let around = [at - 1, at + 1, at - WIDE, at + WIDE, at - WIDE * WIDE, at + WIDE * WIDE];
                let (mut sum, mut count) = (0.0, 0.0);
                for v in around.map(|n| padded[n]).into_iter().filter(|v| !v.is_nan()) {
                    sum += v;
                    count += 1.0;
                }
                if count > 0.0 {
                    *value = sum / count;
                }
            }
            out
        })
        .collect();
    field.values = grown;
}

/// Keeps observed faces, and unobserved ones that close a hole: connected, not on a border, and nowhere farther from a
/// point than half of `fill_hole_m`.
fn support(
    mut vertices: Vec<Vec3>,
    faces: Vec<[VertexId; 3]>,
    observed: Vec<bool>,
    far: &[f64],
    options: &Options,
    summary: &mut Summary,
) -> Raw {
    // Sheets that touch must not count as borders here, so edges are looked at as they come.
    let (twin, _) = topology::lenient_twins(&faces);
    let mut keep = observed.clone();
    let mut done = observed.clone();
    for seed in 0..faces.len() {
        if done[seed] {
            continue;
        }
        done[seed] = true;
        let mut region = vec![seed];
        let mut next = 0;
        let mut closes = options.fill_hole_m > 0.0;
        while next < region.len() {
            let f = region[next];
            next += 1;
            closes &= faces[f].iter().all(|&v| far[v as usize] <= options.fill_hole_m / 2.0);
            for &t in &twin[3 * f..3 * f + 3] {
                if t == topology::NO_TWIN {
                    closes = false;
                } else if !done[(t / 3) as usize] {
                    done[(t / 3) as usize] = true;
                    region.push((t / 3) as usize);
                }
            }
        }
        if closes {
            summary.faces_filled += region.len();
            region.iter().for_each(|&f| keep[f] = true);
        }
    }
    summary.unsupported_faces_dropped = keep.iter().filter(|k| !**k).count();
    let (faces, observed): (Vec<_>, Vec<_>) =
        faces.into_iter().zip(observed).zip(&keep).filter(|(_, k)| **k).map(|(both, _)| both).unzip();
    let (kept, faces) = repair::compact(std::mem::take(&mut vertices), faces);
    Raw { vertices: kept, faces, observed }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Mesh;
    use std::f64::consts::{PI, TAU};

    const OPTIONS: Options =
        Options { spacing_m: Some(0.1), max_gap_m: 0.15, fill_hole_m: 0.6, perimeter_m: TAU * 2.0 };

    fn straight() -> Axis {
        Axis::through(&[Vec3::new(0.5, 0.0, 0.0), Vec3::new(7.5, 0.0, 0.0)], 0.0).unwrap()
    }

    /// Even points on a tube of 2 m radius and 8 m length around the x axis.
    fn tube(count: u32) -> Vec<Vec3> {
        (0..count)
            .map(|i| {
                let s = 8.0 * (f64::from(i) * 0.618_033_988_749_895).fract();
                let a = TAU * (f64::from(i) * 0.754_877_666_246_693).fract() - PI;
                Vec3::new(s, -2.0 * a.sin(), 2.0 * a.cos())
            })
            .collect()
    }

    fn mesh_of(points: Vec<Vec3>) -> (Mesh, Summary) {
        let (raw, summary) = reconstruct(points.clone(), &points, &straight(), &OPTIONS);
        let mut repaired = repair::Repaired::of(raw.vertices, raw.faces, raw.observed);
        repaired.keep_largest();
        (repaired.into_mesh().0, summary)
    }

    fn loops(mesh: &Mesh) -> usize {
        topology::boundary_loops(mesh.faces(), mesh.twins()).len()
    }

    #[test]
    fn a_tube_becomes_a_tube_that_faces_inwards() {
        let (mesh, summary) = mesh_of(tube(40_000));
        assert_eq!((loops(&mesh), summary.points_hidden), (2, 0));
        for v in mesh.vertices() {
            assert!((v.y.hypot(v.z) - 2.0).abs() < 0.006, "{}", v.y.hypot(v.z));
        }
        for f in 0..mesh.faces().len() as u32 {
            let [a, b, c] = mesh.corners(f);
            assert!(mesh.double_area_vector(f).dot(&Vec3::new(0.0, (a + b + c).y, (a + b + c).z)) < 0.0);
        }
    }

    #[test]
    fn what_hides_behind_itself_keeps_both_sides() {
        // A ledge: a plate 0.6 m thick that stands out 1 m from the wall on the right, seen from above and from below.
        let mut points = tube(60_000);
        points.retain(|p| !(p.y < 0.0 && p.z.abs() < 0.3));
        for i in 0..40 {
            for k in 0..320 {
                let (along, out) = (f64::from(k) * 0.025, f64::from(i) * 0.025);
                for z in [-0.3, 0.3] {
                    points.push(Vec3::new(along, -(4.0f64 - 0.09).sqrt() + out, z));
                }
            }
        }
        for i in 0..24 {
            let z = -0.3 + f64::from(i) * 0.025;
            points.extend((0..320).map(|k| Vec3::new(f64::from(k) * 0.025, -(4.0f64 - 0.09).sqrt() + 1.0, z)));
        }
        let (mesh, _) = mesh_of(points);
        let near = |p: Vec3| mesh.vertices().iter().map(|v| (v - p).norm()).fold(f64::INFINITY, f64::min);
        assert!(near(Vec3::new(4.0, -1.5, 0.3)) < 0.08 && near(Vec3::new(4.0, -1.5, -0.3)) < 0.08);
        assert_eq!(loops(&mesh), 2);
    }

    #[test]
    fn a_small_hole_is_filled_and_marked_a_large_one_stays() {
        let mut points = tube(60_000);
        points.retain(|p| {
            let girth = 2.0 * (-p.y).atan2(p.z);
            (p.x - 3.0).hypot(girth - 3.0) > 0.26 && (p.x - 5.0).hypot(girth + 3.0) > 0.6
        });
        let (mesh, summary) = mesh_of(points.clone());
        assert!(summary.faces_filled > 0);
        assert_eq!(loops(&mesh), 3);
        let tree = KdTree::new(&points);
        for (f, seen) in mesh.observed().iter().enumerate() {
            let far = mesh.corners(f as u32).iter().any(|v| tree.nearest(v).unwrap().distance_squared.sqrt() > 0.15);
            assert_eq!(far, !seen);
        }
    }

    #[test]
    fn the_mesh_is_the_same_on_one_thread_and_on_many() {
        let many = mesh_of(tube(20_000)).0;
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(pool.install(|| mesh_of(tube(20_000)).0), many);
    }
}
