//! Which side of the surface is the void, for rock that hides behind itself: the side that one gets to from the axis.
//!
//! Use it where "towards the axis" is no answer: overhangs, pillars, boulders on the floor. Cells with points are walls;
//! a flood from the axis through cells that are not near a wall (so that it does not seep through cells that have no
//! points by chance, nor into clefts that are narrow beside the tunnel) and then a few steps closer gives every free cell the
//! number of steps that lead to it. Of the two
//! cells a little way along and against a normal, the one that is reached, or reached much sooner, lies in the void;
//! through a hole in the surface the way to the back is long, and the flood neither leaves the portals nor goes on for ever. A point none of whose sides is reached was never seen from
//! the tunnel (the buried part of a boulder in a model made of pieces) and is told as hidden.
//!
//! Guarantees: no dependence on point order or threads. Cost: linear in points and in the cells of the bounding box
//! (at most [`MOST_CELLS`]).

use crate::axis::Axis;
use crate::numeric::Vec3;
use crate::spatial::voxel_grid::bounds;
use rayon::prelude::*;

/// Edge of a cell in distances between points: a random sample leaves five neighbouring cells of a surface empty in one
/// of two million places.
const CELL_IN_SPACINGS: f64 = 1.75;
/// The flood keeps this share of its longest way off the walls, and a cell at least.
const OFF_THE_WALL: f64 = 1.0 / 130.0;
/// Most cells; a larger box gets larger cells.
const MOST_CELLS: f64 = 3e7;
/// How far along the normal one looks, in cells, nearest first.
const LOOK_AT: [f64; 6] = [1.0, 1.5, 2.0, 2.5, 3.0, 3.5];
/// Steps by which the back has to be farther than the front when both are reached.
const MUCH_FARTHER: u32 = 6;
/// How far beyond the ends of the axis the flood goes, as a share of its longest way.
const MARGIN: f64 = 0.125;
/// A cell that the flood has not reached, one beside a wall, and one with points.
const UNREACHED: u32 = u32::MAX;
const BESIDE: u32 = u32::MAX - 1;
const WALL: u32 = u32::MAX - 2;

/// What the flood told.
pub(super) struct Sides {
    /// Points that cannot be seen from the tunnel on either side.
    pub hidden: Vec<bool>,
    /// Points with the void on both sides or an unclear answer: they face the axis.
    pub unclear: usize,
}

/// Turns unit `normals` towards the void; see the module. `walls` are all points that one cannot pass, `way_m` is how far
/// the flood goes.
pub(super) fn face_the_void(
    points: &[Vec3],
    normals: &mut [Vec3],
    walls: &[Vec3],
    axis: &Axis,
    spacing_m: f64,
    way_m: f64,
) -> Sides {
    let nobody = Sides { hidden: vec![false; points.len()], unclear: 0 };
    let Some((low, high)) = bounds(points) else { return nobody };
    let extent = high - low;
    let mut cell_m = CELL_IN_SPACINGS * spacing_m;
    let dims_at = |cell_m: f64| -> [usize; 3] { extent.map(|e| (e / cell_m).floor() as usize + 3).into() };
    while dims_at(cell_m).iter().map(|&d| d as f64).product::<f64>() > MOST_CELLS {
        cell_m *= 1.1;
    }
    let dims = dims_at(cell_m);
    // One free cell around everything.
    let origin = low.map(|c| c - cell_m);
    let cell_of = |p: &Vec3| -> Option<usize> {
        let q = (p - origin) / cell_m;
        let inside = (0..3).all(|a| q[a] >= 0.0 && q[a] < dims[a] as f64);
        inside.then(|| ((q.z as usize) * dims[1] + q.y as usize) * dims[0] + q.x as usize)
    };
    let mut steps = vec![UNREACHED; dims.iter().product()];
    for cell in walls.iter().filter_map(cell_of) {
        steps[cell] = WALL;
    }
    let mut rim: Vec<usize> = (0..steps.len()).filter(|&c| steps[c] == WALL).collect();
    let off = ((OFF_THE_WALL * way_m / cell_m).round() as usize).max(1);
    for _ in 0..off {
        let mut next = Vec::new();
        for cell in rim {
            for_each_neighbour(cell, dims, |n| {
                if steps[n] == UNREACHED {
                    steps[n] = BESIDE;
                    next.push(n);
                }
            });
        }
        rim = next;
    }
    let centre = |cell: usize| {
        let at = [cell % dims[0], cell / dims[0] % dims[1], cell / (dims[0] * dims[1])];
        origin + Vec3::from(at.map(|c| c as f64 + 0.5)) * cell_m
    };
    // Out of a portal one gets behind the rock: the flood ends where the axis does.
    let ends = [axis.start_chainage(), axis.end_chainage()].map(|s| axis.frame_at(s));
    let margin_m = cell_m.max(MARGIN * way_m);
    let inside = |cell: usize| {
        let p = centre(cell);
        let nearest = axis.nearest_sample(&p);
        let beyond = |k: usize, sign: f64| {
            (nearest - ends[k].origin).norm() < 1e-6 && sign * (p - ends[k].origin).dot(&ends[k].forward) > margin_m
        };
        !beyond(0, -1.0) && !beyond(1, 1.0)
    };
    let most_steps = (way_m / cell_m).ceil() as u32;
    flood(&mut steps, dims, axis, cell_m, [most_steps, off as u32 + 1], cell_of, inside);

    // (turn, hidden, unclear)
    let verdicts: Vec<(bool, bool, bool)> = points
        .par_iter()
        .zip(normals.par_iter())
        .map(|(p, n)| {
            let mut seen = false;
            let mut sides = [Look::default(), Look::default()];
            for along in LOOK_AT.map(|k| k * cell_m) {
                let front = sides[0].at(cell_of(&(p + n * along)).map(|c| steps[c]));
                let back = sides[1].at(cell_of(&(p - n * along)).map(|c| steps[c]));
                seen |= front.is_some() || back.is_some();
                match (front, back) {
                    (Some(_), None) => return (false, false, false),
                    (None, Some(_)) => return (true, false, false),
                    (Some(f), Some(b)) if f + MUCH_FARTHER < b => return (false, false, false),
                    (Some(f), Some(b)) if b + MUCH_FARTHER < f => return (true, false, false),
                    _ => {}
                }
            }
            let towards = axis.nearest_sample(p) - p;
            (n.dot(&towards) < 0.0, !seen, seen)
        })
        .collect();
    normals.par_iter_mut().zip(&verdicts).filter(|(_, v)| v.0).for_each(|(n, _)| *n = -*n);
    Sides { unclear: verdicts.iter().filter(|v| v.2).count(), hidden: verdicts.into_iter().map(|v| v.1).collect() }
}

/// A look from a point along or against its normal, which another wall ends.
#[derive(Default)]
struct Look {
    left_own_wall: bool,
    blocked: bool,
}

impl Look {
    /// The steps of the next cell looked at, if the flood came there and no wall is before it.
    fn at(&mut self, steps: Option<u32>) -> Option<u32> {
        match steps {
            Some(WALL) => self.blocked |= self.left_own_wall,
            _ => self.left_own_wall = true,
        }
        steps.filter(|&s| s < WALL && !self.blocked)
    }
}

/// Numbers the free cells by their steps from the axis: at most `most_steps` off the walls, then some `closer` to them.
fn flood(
    steps: &mut [u32],
    dims: [usize; 3],
    axis: &Axis,
    cell_m: f64,
    [most_steps, closer]: [u32; 2],
    cell_of: impl Fn(&Vec3) -> Option<usize>,
    inside: impl Fn(usize) -> bool,
) {
    let samples = (axis.length() / (0.5 * cell_m)).ceil().max(1.0) as usize;
    let mut front: Vec<u32> = Vec::new();
    for i in 0..=samples {
        let at = axis.start_chainage() + axis.length() * i as f64 / samples as f64;
        if let Some(cell) = cell_of(&axis.frame_at(at).origin)
            && steps[cell] == UNREACHED
        {
            steps[cell] = 0;
            front.push(cell as u32);
        }
    }
    let mut step = 0;
    let mut reached: Vec<u32> = Vec::new();
    while !front.is_empty() && step < most_steps {
        step += 1;
        let mut next = Vec::new();
        for &cell in &front {
            for_each_neighbour(cell as usize, dims, |n| match steps[n] {
                UNREACHED if inside(n) => {
                    steps[n] = step;
                    next.push(n as u32);
                }
                BESIDE => reached.push(cell),
                _ => {}
            });
        }
        front = next;
    }
    for _ in 0..closer {
        let mut next = Vec::new();
        for &cell in &reached {
            let here = steps[cell as usize];
            for_each_neighbour(cell as usize, dims, |n| {
                if steps[n] == BESIDE {
                    steps[n] = here + 1;
                    next.push(n as u32);
                }
            });
        }
        reached = next;
    }
}

/// The cells that share a face with a cell.
fn for_each_neighbour(cell: usize, dims: [usize; 3], mut visit: impl FnMut(usize)) {
    let strides = [1, dims[0], dims[0] * dims[1]];
    let at = [cell % dims[0], cell / dims[0] % dims[1], cell / strides[2]];
    for a in 0..3 {
        if at[a] > 0 {
            visit(cell - strides[a]);
        }
        if at[a] + 1 < dims[a] {
            visit(cell + strides[a]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Even points on a sphere, with its outward normals.
    fn sphere(centre: Vec3, radius: f64, count: u32) -> Vec<(Vec3, Vec3)> {
        (0..count)
            .map(|i| {
                let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / f64::from(count);
                let (sin, cos) = (2.399_963_229_728_653 * f64::from(i)).sin_cos();
                let n = Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
                (centre + n * radius, n)
            })
            .collect()
    }

    #[test]
    fn both_sides_of_a_boulder_face_the_void_and_its_core_is_hidden() {
        // A hollow of 4 m, in it a boulder of 1 m with a buried core; the axis passes below the boulder.
        let mut all = sphere(Vec3::zeros(), 4.0, 20_000);
        all.extend(sphere(Vec3::new(0.0, 0.0, 2.0), 1.0, 1_250));
        all.extend(sphere(Vec3::new(0.0, 0.0, 2.0), 0.2, 50));
        let (points, mut normals): (Vec<Vec3>, Vec<Vec3>) = all.into_iter().unzip();
        let axis = Axis::through(&[Vec3::new(-3.0, 0.0, -1.0), Vec3::new(3.0, 0.0, -1.0)], 0.0).unwrap();
        let sides = face_the_void(&points, &mut normals, &points, &axis, 0.1, 30.0);
        for (i, (p, n)) in points.iter().zip(&normals).enumerate() {
            match i {
                0..20_000 => assert!(n.dot(p) < 0.0, "hollow {i}"),
                20_000..21_250 => assert!(n.dot(&(p - Vec3::new(0.0, 0.0, 2.0))) > 0.0, "boulder {i}"),
                _ => assert!(sides.hidden[i], "core {i}"),
            }
        }
        assert!(sides.hidden[..21_250].iter().all(|h| !h));
    }
}
