//! Fewer faces with as little change of shape as possible: edges collapse in the order of their quadric error.
//!
//! Use it when a map needs no more detail than its pixels, or when a slow unwrap method is tried. Flat rock loses most faces,
//! edges and ledges keep theirs.
//!
//! Reference: M. Garland, P. Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997,
//! doi:10.1145/258734.258849. Departures: planes are not weighted by area, so the root of the error bounds the distance
//! of a new vertex from the plane of every face that went into it; vertices on a border or between observed and filled
//! faces are neither moved nor removed, so portals, holes and the marks stay exactly what they were; a collapse that turns
//! a face by more than 60 degrees or breaks the manifold (link condition) is not done.
//! Cost: `n log n` in the faces, on one thread; 200 bytes a face.

use super::{Mesh, VertexId, repair, topology};
use crate::numeric::{Mat3, Vec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// A face may turn by this cosine at most in one collapse.
const LEAST_COSINE: f64 = 0.5;

/// How far a mesh is thinned: both limits hold when both are given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Decimate {
    /// Number of faces at which to stop.
    pub faces: Option<usize>,
    /// No vertex moves farther than this from the planes of the faces that it stands for, metres.
    pub deviation_m: Option<f64>,
}

/// What was thinned, for the report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Faces before.
    pub faces_before: usize,
    /// Faces after.
    pub faces_after: usize,
    /// Bound on the distance of a vertex from the planes of the faces that it stands for, metres.
    pub deviation_m: f64,
    /// Vertices that had to stay: on a border, or between observed and filled faces.
    pub locked_vertices: usize,
}

/// Error of a place: `p A p + 2 b p + c`, the sum of its squared distances from planes.
#[derive(Clone, Copy)]
struct Quadric {
    a: Mat3,
    b: Vec3,
    c: f64,
}

impl Quadric {
    fn of_plane(normal: &Vec3, point: &Vec3) -> Self {
        let d = -normal.dot(point);
        Self { a: normal * normal.transpose(), b: normal * d, c: d * d }
    }

    fn plus(&self, other: &Self) -> Self {
        Self { a: self.a + other.a, b: self.b + other.b, c: self.c + other.c }
    }

    fn error(&self, p: &Vec3) -> f64 {
        (p.dot(&(self.a * p)) + 2.0 * self.b.dot(p) + self.c).max(0.0)
    }

    /// The place of least error near `start`, along the directions in which the planes tell one.
    fn best(&self, start: &Vec3) -> Vec3 {
        let eigen = self.a.symmetric_eigen();
        let most = eigen.eigenvalues.amax();
        let residual = self.a * start + self.b;
        let mut place = *start;
        for k in 0..3 {
            if eigen.eigenvalues[k] > 1e-3 * most {
                let v = eigen.eigenvectors.column(k);
                place -= v * (v.dot(&residual) / eigen.eigenvalues[k]);
            }
        }
        place
    }
}

/// Thins a mesh; see the module.
pub fn decimate(mesh: Mesh, target: &Decimate) -> (Mesh, Summary) {
    let faces_before = mesh.faces().len();
    let mut work = Work::new(&mesh);
    let limit = target.deviation_m.map_or(f64::INFINITY, |d| d * d);
    let stop = target.faces.unwrap_or(0);
    let locked_vertices = work.locked.iter().filter(|l| **l).count();
    let mut queue = Queue::new();
    for f in 0..work.faces.len() {
        let corners = work.faces[f];
        for i in 0..3 {
            let (a, b) = (corners[i], corners[(i + 1) % 3]);
            if a < b {
                work.offer(&mut queue, a, b);
            }
        }
    }
    let mut alive = faces_before;
    let mut worst: f64 = 0.0;
    while alive > stop
        && let Some(Reverse((bits, a, b, stamp_a, stamp_b))) = queue.pop()
    {
        if stamp_a != work.stamp[a as usize] || stamp_b != work.stamp[b as usize] {
            continue;
        }
        let error = f64::from_bits(bits);
        if error > limit {
            break;
        }
        let place = work.place(a, b);
        if !work.may_collapse(a, b, &place) {
            continue;
        }
        worst = worst.max(error);
        alive -= work.collapse(a, b, place);
        let around = work.neighbours(a);
        for n in around {
            work.offer(&mut queue, a.min(n), a.max(n));
        }
    }
    let (faces, observed): (Vec<[VertexId; 3]>, Vec<bool>) =
        work.faces.iter().zip(mesh.observed()).filter(|(f, _)| f[0] != VertexId::MAX).map(|(f, &o)| (*f, o)).unzip();
    let (vertices, faces) = repair::compact(work.vertices, faces);
    let summary = Summary { faces_before, faces_after: faces.len(), deviation_m: worst.sqrt(), locked_vertices };
    (Mesh::new(vertices, faces, observed).expect("the link condition keeps a manifold"), summary)
}

/// Edges by their cost (its bits): the two ends, and their states when the cost was told.
type Queue = BinaryHeap<Reverse<(u64, VertexId, VertexId, u32, u32)>>;

/// The mesh while it shrinks. Removed faces have corners `VertexId::MAX`.
struct Work {
    vertices: Vec<Vec3>,
    faces: Vec<[VertexId; 3]>,
    faces_of: Vec<Vec<u32>>,
    quadric: Vec<Quadric>,
    locked: Vec<bool>,
    /// Raised whenever a vertex changes, so that old offers are known.
    stamp: Vec<u32>,
}

impl Work {
    fn new(mesh: &Mesh) -> Self {
        let count = mesh.vertices().len();
        let mut faces_of = vec![Vec::new(); count];
        let nothing = Quadric { a: Mat3::zeros(), b: Vec3::zeros(), c: 0.0 };
        let mut quadric = vec![nothing; count];
        for (f, corners) in mesh.faces().iter().enumerate() {
            let normal = mesh.double_area_vector(f as u32).try_normalize(0.0).unwrap_or_else(Vec3::zeros);
            let plane = Quadric::of_plane(&normal, &mesh.vertices()[corners[0] as usize]);
            for &v in corners {
                faces_of[v as usize].push(f as u32);
                quadric[v as usize] = quadric[v as usize].plus(&plane);
            }
        }
        let twin = mesh.twins();
        let mut locked = vec![false; count];
        for (c, &t) in twin.iter().enumerate() {
            if t == topology::NO_TWIN || mesh.observed()[c / 3] != mesh.observed()[(t / 3) as usize] {
                let corners = mesh.faces()[c / 3];
                locked[corners[c % 3] as usize] = true;
                locked[corners[(c + 1) % 3] as usize] = true;
            }
        }
        Self {
            vertices: mesh.vertices().to_vec(),
            faces: mesh.faces().to_vec(),
            faces_of,
            quadric,
            locked,
            stamp: vec![0; count],
        }
    }

    fn offer(&self, queue: &mut Queue, a: VertexId, b: VertexId) {
        if self.locked[a as usize] && self.locked[b as usize] {
            return;
        }
        let both = self.quadric[a as usize].plus(&self.quadric[b as usize]);
        let error = both.error(&self.place(a, b));
        queue.push(Reverse((error.to_bits(), a, b, self.stamp[a as usize], self.stamp[b as usize])));
    }

    /// Where the vertex goes that stands for both.
    fn place(&self, a: VertexId, b: VertexId) -> Vec3 {
        let (p, q) = (self.vertices[a as usize], self.vertices[b as usize]);
        if self.locked[a as usize] {
            return p;
        }
        if self.locked[b as usize] {
            return q;
        }
        let both = self.quadric[a as usize].plus(&self.quadric[b as usize]);
        let middle = (p + q) / 2.0;
        let best = both.best(&middle);
        // Nearly flat surroundings leave the place open; it must not wander.
        if (best - middle).norm() <= (q - p).norm() { best } else { middle }
    }

    /// The vertices that share a face with `v`, ascending.
    fn neighbours(&self, v: VertexId) -> Vec<VertexId> {
        let mut around: Vec<VertexId> =
            self.faces_of[v as usize].iter().flat_map(|&f| self.faces[f as usize]).filter(|&n| n != v).collect();
        around.sort_unstable();
        around.dedup();
        around
    }

    fn may_collapse(&self, a: VertexId, b: VertexId, place: &Vec3) -> bool {
        let shared = self.faces_of[a as usize].iter().filter(|f| self.faces[**f as usize].contains(&b)).count();
        let (around_a, around_b) = (self.neighbours(a), self.neighbours(b));
        let common = around_a.iter().filter(|n| around_b.binary_search(n).is_ok()).count();
        // Link condition; an inner edge has two faces because borders are locked on both ends or one.
        if common != shared || shared == 0 || around_a.len() + around_b.len() < common + 7 {
            return false;
        }
        let keeps = |v: VertexId, other: VertexId| {
            self.faces_of[v as usize].iter().filter(|f| !self.faces[**f as usize].contains(&other)).all(|&f| {
                let corners = self.faces[f as usize];
                let before = corners.map(|c| self.vertices[c as usize]);
                let after = corners.map(|c| if c == v { *place } else { self.vertices[c as usize] });
                let normal = |[a, b, c]: [Vec3; 3]| (b - a).cross(&(c - a));
                let (n, m) = (normal(before), normal(after));
                n.dot(&m) > LEAST_COSINE * n.norm() * m.norm()
            })
        };
        keeps(a, b) && keeps(b, a)
    }

    /// Puts `a` in the place of both; returns the number of faces that vanish.
    fn collapse(&mut self, a: VertexId, b: VertexId, place: Vec3) -> usize {
        let quadric = self.quadric[a as usize].plus(&self.quadric[b as usize]);
        let mut gone = 0;
        for f in std::mem::take(&mut self.faces_of[b as usize]) {
            let corners = &mut self.faces[f as usize];
            if corners.contains(&a) {
                let corners = std::mem::replace(corners, [VertexId::MAX; 3]);
                for v in corners.into_iter().filter(|&v| v != b) {
                    self.faces_of[v as usize].retain(|&g| g != f);
                }
                gone += 1;
            } else {
                corners.iter_mut().filter(|c| **c == b).for_each(|c| *c = a);
                self.faces_of[a as usize].push(f);
            }
        }
        self.vertices[a as usize] = place;
        self.quadric[a as usize] = quadric;
        self.locked[a as usize] |= self.locked[b as usize];
        self.stamp[a as usize] += 1;
        self.stamp[b as usize] += 1;
        gone
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An open tube of 30 x 40 quads with a patch of filled faces.
    fn tube() -> Mesh {
        let vertices = (0..31 * 40u32)
            .map(|k| {
                let (sin, cos) = (f64::from(k % 40) / 40.0 * std::f64::consts::TAU).sin_cos();
                Vec3::new(f64::from(k / 40) * 0.3, 2.0 * cos, 2.0 * sin)
            })
            .collect();
        let mut faces = Vec::new();
        let mut observed = Vec::new();
        for i in 0..30u32 {
            for j in 0..40 {
                let (a, b) = (i * 40 + j, i * 40 + (j + 1) % 40);
                faces.extend([[a, a + 40, b + 40], [a, b + 40, b]]);
                let seen = !((10..15).contains(&i) && (10..15).contains(&j));
                observed.extend([seen, seen]);
            }
        }
        Mesh::new(vertices, faces, observed).unwrap()
    }

    fn borders(mesh: &Mesh) -> Vec<Vec<[u64; 3]>> {
        let twin = mesh.twins();
        let place = |v: u32| <[f64; 3]>::from(mesh.vertices()[v as usize]).map(f64::to_bits);
        let mut loops: Vec<Vec<[u64; 3]>> = topology::boundary_loops(mesh.faces(), twin)
            .into_iter()
            .map(|l| {
                let mut places: Vec<[u64; 3]> = l.into_iter().map(place).collect();
                places.sort_unstable();
                places
            })
            .collect();
        loops.sort();
        loops
    }

    fn filled_area(mesh: &Mesh) -> f64 {
        (0..mesh.faces().len())
            .filter(|&f| !mesh.observed()[f])
            .map(|f| mesh.double_area_vector(f as u32).norm() / 2.0)
            .sum()
    }

    #[test]
    fn a_target_is_reached_and_borders_and_marks_stay() {
        let before = tube();
        let (after, summary) = decimate(before.clone(), &Decimate { faces: Some(900), deviation_m: None });
        assert!((895..=900).contains(&after.faces().len()), "{summary:?}");
        assert_eq!(summary.faces_after, after.faces().len());
        assert_eq!(borders(&before), borders(&after));
        assert!((filled_area(&before) - filled_area(&after)).abs() < 0.02 * filled_area(&before));
        assert!((before.area() - after.area()).abs() < 0.02 * before.area());
        for v in after.vertices() {
            assert!((v.y.hypot(v.z) - 2.0).abs() < 0.06, "{v:?}");
        }
    }

    #[test]
    fn a_deviation_bounds_the_distance_from_the_surface() {
        let before = tube();
        let (after, summary) = decimate(before.clone(), &Decimate { faces: None, deviation_m: Some(0.01) });
        assert!(after.faces().len() < before.faces().len() && summary.deviation_m <= 0.01, "{summary:?}");
        // A regular polygon of 40 sides lies between 1.9938 and 2 m.
        assert!(after.vertices().iter().all(|v| (1.983..2.011).contains(&v.y.hypot(v.z))));
        let (same, none) = decimate(before.clone(), &Decimate { faces: Some(10_000), deviation_m: None });
        assert_eq!((same.faces().len(), none.deviation_m), (before.faces().len(), 0.0));
    }
}
