//! The global half of local/global methods: a Poisson equation with the cotangent Laplacian, factored once for all
//! iterations.

use super::conformal::{cotangent_laplacian, used_vertices};
use super::triangle_shapes::Shapes;
use crate::numeric::Vec2;
use crate::numeric::sparse::{Cholesky, Error, Pattern};

/// The factored cotangent Laplacian of a mesh, one vertex held.
pub(super) struct Poisson {
    factor: Cholesky,
    used: Vec<bool>,
    held: usize,
}

impl Poisson {
    /// Assembles and factors.
    pub fn new(faces: &[[u32; 3]], vertex_count: usize, shapes: &Shapes) -> Result<Self, Error> {
        let pattern = Pattern::of_vertices(vertex_count, faces)?;
        let mut values = cotangent_laplacian(&pattern, faces, |f| shapes.shapes[f].cotangents());
        let used = used_vertices(vertex_count, faces);
        // The Laplacian leaves the position free; the load says nothing about it either.
        let held = used.iter().position(|&u| u).unwrap_or(0);
        let mut none = vec![0.0; vertex_count];
        pattern.fix_unknowns(&mut values, &mut none, |j| (j == held).then_some(0.0));
        Ok(Self { factor: Cholesky::of(&pattern, &values)?, used, held })
    }

    /// The inverse of the rigid energy's Hessian with held rotations, `2 L`, applied to a gradient, which must sum to zero.
    /// The mean of the result is zero.
    pub fn correction(&self, gradient: &[Vec2]) -> Vec<Vec2> {
        let n = gradient.len();
        let mut x: Vec<f64> = gradient.iter().map(|g| g.x / 2.0).chain(gradient.iter().map(|g| g.y / 2.0)).collect();
        (x[self.held], x[n + self.held]) = (0.0, 0.0);
        self.factor.solve_in_place(&mut x);
        let mut step: Vec<Vec2> = (0..n).map(|v| Vec2::new(x[v], x[n + v])).collect();
        let used = || self.used.iter().enumerate().filter(|(_, used)| **used).map(|(v, _)| v);
        let mean = used().fold(Vec2::zeros(), |sum, v| sum + step[v]) / used().count().max(1) as f64;
        used().for_each(|v| step[v] -= mean);
        step
    }
}
