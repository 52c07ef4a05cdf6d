//! Vertex fans that stay as rigid as they can: on the bent surface, and unrolled into the plane.
//!
//! A fan is a vertex with the faces around it. Its energy compares the edges of those faces with a rotated copy of what
//! they are at rest, with half the opposite cotangent of the face as weight; *spokes* are the edges at the vertex (Sorkine
//! & Alexa 2007), *rims* those opposite to it (Chao et al. 2010, who show that with them no fan can be indefinite).
//!
//! At rest a fan is either as the surface has it ([`BentFans`]), or unrolled ([`UnrolledFans`]): its faces keep their shape
//! and are laid out around the vertex one after the other. Around an inner vertex their angles are scaled so that they
//! fill a full turn, each face being turned by its share of the gap, around a border vertex they are laid as they are.
//! Where the surface is developable nothing has to be scaled and a flat isometry is free of energy, which it is not for
//! fans that are bent at rest.

use super::triangle_shapes::{Shape, Shapes};
use crate::mesh::{Mesh, topology};
use crate::numeric::{Mat3, Vec2, Vec3};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// The edges of a vertex fan that count as rigid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Fan {
    /// The edges at the vertex.
    Spokes,
    /// Also the edges opposite to it: smoother, never indefinite.
    #[default]
    SpokesAndRims,
}

impl Fan {
    /// Of what the three edges of a face give (0-1, 1-2, 2-0), what the fan of corner `k` feels.
    fn of_corner<T: Copy + std::ops::Add<Output = T>>(self, each: &[T; 3], k: usize) -> T {
        // At corner k the spokes are edges k and k - 1, the rim is edge k + 1.
        let spokes = each[k] + each[(k + 2) % 3];
        match self {
            Fan::Spokes => spokes,
            Fan::SpokesAndRims => spokes + each[(k + 1) % 3],
        }
    }

    /// What the corners of a face make of edge `k` together, as the mean over the fans that feel it.
    fn on_edge<T>(self, corners: &[T; 3], k: usize) -> T
    where
        T: Copy + std::ops::Add<Output = T> + std::ops::Div<f64, Output = T>,
    {
        let ends = corners[k] + corners[(k + 1) % 3];
        match self {
            Fan::Spokes => ends / 2.0,
            Fan::SpokesAndRims => (ends + corners[(k + 2) % 3]) / 3.0,
        }
    }
}

/// The fans of the surface as it is in space.
pub(super) struct BentFans<'a> {
    faces: &'a [[u32; 3]],
    vertex_count: usize,
    /// Edge vectors 0-1, 1-2, 2-0 on the surface, times half the opposite cotangent.
    edges: Vec<[Vec3; 3]>,
    fan: Fan,
}

impl<'a> BentFans<'a> {
    pub fn new(mesh: &'a Mesh, shapes: &Shapes, fan: Fan) -> Self {
        let (faces, vertices) = (mesh.faces(), mesh.vertices());
        let edges = faces
            .iter()
            .zip(&shapes.shapes)
            .map(|(corners, shape)| {
                let weight = half_cotangents(shape);
                std::array::from_fn(|k| {
                    let (a, b) = (corners[k] as usize, corners[(k + 1) % 3] as usize);
                    (vertices[b] - vertices[a]) * weight[k]
                })
            })
            .collect();
        Self { faces, vertex_count: vertices.len(), edges, fan }
    }

    /// The right-hand side of the global step for a pose: every edge turned as the fans that feel it have turned.
    pub fn load(&self, pose: &[Vec3]) -> Vec<Vec3> {
        let rotations = self.rotations(pose);
        let mut load = vec![Vec3::zeros(); self.vertex_count];
        for (corners, edges) in self.faces.iter().zip(&self.edges) {
            let r = corners.map(|v| rotations[v as usize]);
            for k in 0..3 {
                let turned = self.fan.on_edge(&r, k) * edges[k];
                load[corners[(k + 1) % 3] as usize] += turned;
                load[corners[k] as usize] -= turned;
            }
        }
        load
    }

    /// The rotation of each fan that brings the surface's edges closest to those of the pose.
    fn rotations(&self, pose: &[Vec3]) -> Vec<Mat3> {
        let mut covariance = vec![Mat3::zeros(); self.vertex_count];
        for (corners, edges) in self.faces.iter().zip(&self.edges) {
            let p = corners.map(|v| pose[v as usize]);
            let each: [Mat3; 3] = std::array::from_fn(|k| (p[(k + 1) % 3] - p[k]) * edges[k].transpose());
            (0..3).for_each(|k| covariance[corners[k] as usize] += self.fan.of_corner(&each, k));
        }
        covariance.par_iter().map(closest_rotation).collect()
    }
}

/// A complex number: (real, imaginary) as (x, y).
fn times(a: Vec2, b: Vec2) -> Vec2 {
    Vec2::new(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x)
}

fn conjugate(a: Vec2) -> Vec2 {
    Vec2::new(a.x, -a.y)
}

/// The fans laid flat.
pub(super) struct UnrolledFans<'a> {
    faces: &'a [[u32; 3]],
    vertex_count: usize,
    /// Edge vectors 0-1, 1-2, 2-0 of each face in its own plane, and their weights.
    edges: Vec<([Vec2; 3], [f64; 3])>,
    /// For each corner the turn from the face's own plane into the unrolled fan of that corner.
    laid: Vec<[Vec2; 3]>,
    fan: Fan,
}

impl<'a> UnrolledFans<'a> {
    pub fn new(mesh: &'a Mesh, shapes: &Shapes, fan: Fan) -> Self {
        let faces = mesh.faces();
        let shapes = &shapes.shapes;
        let edges: Vec<([Vec2; 3], [f64; 3])> = shapes
            .iter()
            .map(|shape| {
                let p = shape.corners();
                (std::array::from_fn(|k| p[(k + 1) % 3] - p[k]), half_cotangents(shape))
            })
            .collect();
        let twin = mesh.twins();
        let mut laid = vec![[Vec2::zeros(); 3]; faces.len()];
        let mut done = vec![false; mesh.vertices().len()];
        for corner in 0..3 * faces.len() as u32 {
            let vertex = faces[corner as usize / 3][corner as usize % 3] as usize;
            if std::mem::replace(&mut done[vertex], true) {
                continue;
            }
            let around = || topology::fan(twin, corner);
            let angle = |c: u32| shapes[c as usize / 3].angles()[c as usize % 3];
            let first = around().next().expect("a corner is in its fan");
            let is_inner = twin[first as usize] != topology::NO_TWIN;
            let scale = if is_inner { TAU / around().map(angle).sum::<f64>() } else { 1.0 };
            let mut begin = 0.0;
            for c in around() {
                let (face, k) = (c as usize / 3, c as usize % 3);
                let (sin, cos) = (begin + (scale - 1.0) * angle(c) / 2.0).sin_cos();
                laid[face][k] = times(Vec2::new(cos, sin), conjugate(edges[face].0[k].normalize()));
                begin += scale * angle(c);
            }
        }
        Self { faces, vertex_count: mesh.vertices().len(), edges, laid, fan }
    }

    /// Local step in a pose in the plane: the energy with the best rotations, and the right-hand side of the global step.
    pub fn local_step(&self, pose: &[Vec2]) -> (f64, Vec<Vec2>) {
        let edge = |corners: &[u32; 3], k: usize| pose[corners[(k + 1) % 3] as usize] - pose[corners[k] as usize];
        let mut covariance = vec![Vec2::zeros(); self.vertex_count];
        for ((corners, (rest, weight)), laid) in self.faces.iter().zip(&self.edges).zip(&self.laid) {
            let each: [Vec2; 3] = std::array::from_fn(|k| times(edge(corners, k), conjugate(rest[k])) * weight[k]);
            for k in 0..3 {
                covariance[corners[k] as usize] += times(self.fan.of_corner(&each, k), conjugate(laid[k]));
            }
        }
        let rotation = |c: &Vec2| c.try_normalize(0.0).unwrap_or_else(Vec2::x);
        let rotations: Vec<Vec2> = covariance.iter().map(rotation).collect();
        let mut load = vec![Vec2::zeros(); self.vertex_count];
        let mut energy = 0.0;
        for ((corners, (rest, weight)), laid) in self.faces.iter().zip(&self.edges).zip(&self.laid) {
            let turns: [Vec2; 3] = std::array::from_fn(|k| times(rotations[corners[k] as usize], laid[k]));
            for k in 0..3 {
                let turned = times(self.fan.on_edge(&turns, k), rest[k]) * weight[k];
                load[corners[(k + 1) % 3] as usize] += turned;
                load[corners[k] as usize] -= turned;
                // Squares are taken of the difference: the energy of an isometry is zero to the last digits.
                let errors: [f64; 3] =
                    std::array::from_fn(|e| weight[e] * (edge(corners, e) - times(turns[k], rest[e])).norm_squared());
                energy += self.fan.of_corner(&errors, k);
            }
        }
        let fans_per_edge = match self.fan {
            Fan::Spokes => 2.0,
            Fan::SpokesAndRims => 3.0,
        };
        (energy / fans_per_edge, load)
    }
}

/// Half the cotangents opposite to the edges 0-1, 1-2, 2-0.
fn half_cotangents(shape: &Shape) -> [f64; 3] {
    let cot = shape.cotangents();
    [cot[2] / 2.0, cot[0] / 2.0, cot[1] / 2.0]
}

/// The rotation closest to a matrix; the identity for a zero matrix.
fn closest_rotation(m: &Mat3) -> Mat3 {
    let size = m.amax();
    if !(size > 0.0) {
        return Mat3::identity();
    }
    let svd = (m / size).svd(true, true);
    let (Some(mut u), Some(vt)) = (svd.u, svd.v_t) else { return Mat3::identity() };
    if (u * vt).determinant() < 0.0 {
        let smallest = svd.singular_values.imin();
        u.column_mut(smallest).neg_mut();
    }
    u * vt
}

#[cfg(test)]
mod tests {
    use super::super::closed_form;
    use super::*;

    #[test]
    fn closest_rotation_is_a_rotation() {
        let turn = nalgebra::Rotation3::from_euler_angles(0.4, -1.0, 2.0).into_inner();
        assert!((closest_rotation(&(turn * 5.0)) - turn).norm() < 1e-12);
        let mirrored = Mat3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -0.1);
        assert!((closest_rotation(&mirrored) - Mat3::identity()).norm() < 1e-12);
    }

    #[test]
    fn a_flat_isometry_has_no_energy_and_is_in_balance() {
        for known in closed_form::developable() {
            let mesh = known.strip.mesh();
            let shapes = Shapes::of(mesh);
            let (sin, cos) = 0.7_f64.sin_cos();
            let turned: Vec<Vec2> = known.flat.iter().map(|p| times(Vec2::new(cos, sin), *p)).collect();
            for fan in [Fan::Spokes, Fan::SpokesAndRims] {
                let (energy, load) = UnrolledFans::new(mesh, &shapes, fan).local_step(&turned);
                assert!(energy.abs() < 1e-20 * shapes.area(), "{} {fan:?}: {energy:e}", known.name);
                // The load of an isometry is its own Laplacian.
                let expected = laplacian_times(mesh, &shapes, &turned);
                let largest = load.iter().zip(&expected).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
                assert!(largest < 1e-11, "{} {fan:?}: {largest:e}", known.name);
            }
        }
    }

    #[test]
    fn bent_fans_of_the_surface_itself_are_in_balance() {
        let known = closed_form::rough(20, 20);
        let mesh = known.strip.mesh();
        let shapes = Shapes::of(mesh);
        for fan in [Fan::Spokes, Fan::SpokesAndRims] {
            let load = BentFans::new(mesh, &shapes, fan).load(mesh.vertices());
            for axis in 0..3 {
                let flat: Vec<Vec2> = mesh.vertices().iter().map(|p| Vec2::new(p[axis], 0.0)).collect();
                let expected = laplacian_times(mesh, &shapes, &flat);
                assert!(load.iter().zip(&expected).all(|(a, b)| (a[axis] - b.x).abs() < 1e-11));
            }
        }
    }

    fn laplacian_times(mesh: &Mesh, shapes: &Shapes, p: &[Vec2]) -> Vec<Vec2> {
        let mut product = vec![Vec2::zeros(); p.len()];
        for (corners, shape) in mesh.faces().iter().zip(&shapes.shapes) {
            let weight = half_cotangents(shape);
            for k in 0..3 {
                let (a, b) = (corners[k] as usize, corners[(k + 1) % 3] as usize);
                product[b] += (p[b] - p[a]) * weight[k];
                product[a] -= (p[b] - p[a]) * weight[k];
            }
        }
        product
    }
}
