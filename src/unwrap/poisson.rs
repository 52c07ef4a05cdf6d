//! The global half of local/global methods: the map whose gradient fits a load best, with the cotangent Laplacian factored
//! once for all iterations.

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

    /// Solves `L x = load` for u and v. The load must sum to zero; the mean becomes that of `reference`.
    pub fn solve(&self, load: &[Vec2], reference: &[Vec2]) -> Vec<Vec2> {
        let n = load.len();
        let mut x: Vec<f64> = load.iter().map(|p| p.x).chain(load.iter().map(|p| p.y)).collect();
        (x[self.held], x[n + self.held]) = (0.0, 0.0);
        for v in (0..n).filter(|&v| !self.used[v]) {
            (x[v], x[n + v]) = (0.0, 0.0);
        }
        self.factor.solve_in_place(&mut x);
        let mut uv: Vec<Vec2> = (0..n).map(|v| Vec2::new(x[v], x[n + v])).collect();
        let shift = self.mean(reference) - self.mean(&uv);
        uv.iter_mut().for_each(|p| *p += shift);
        uv
    }

    /// Mean over the vertices that have faces.
    fn mean(&self, uv: &[Vec2]) -> Vec2 {
        let mut used = uv.iter().zip(&self.used).filter(|(_, u)| **u).map(|(p, _)| *p);
        let first = used.next().unwrap_or_else(Vec2::zeros);
        let (sum, count) = used.fold((Vec2::zeros(), 1.0), |(s, n), p| (s + (p - first), n + 1.0));
        first + sum / count
    }
}
