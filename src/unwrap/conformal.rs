//! The conformal energy of a triangle mesh as a sparse quadratic form: what [`super::lscm`] minimizes and what turns the
//! angles of [`super::abf`] into coordinates.
//!
//! For (u, v) per vertex, `E_C = E_D - A`: Dirichlet energy minus signed area, zero for a similarity and positive else
//! (U. Pinkall and K. Polthier, "Computing Discrete Minimal Surfaces and Their Conjugates", Experimental Mathematics
//! 2(1), 1993, doi:10.1080/10586458.1993.10504266). As `E_C = 1/2 x^T M x` with interleaved unknowns (u0, v0, u1, ...),
//! `M = [L 0; 0 L] - A`: the cotangent Laplacian twice, and the area as a sum over boundary half-edges only, hole loops
//! included. `M` has no more entries than two Laplacians and the boundary, and it commutes with a quarter turn of all
//! (u, v), so that one factorization serves all pins and loads.

use crate::cut::Strip;
use crate::numeric::Vec2;
use crate::numeric::sparse::{Analysis, Cholesky, Error, Pattern};

/// `M` with its mesh.
pub(super) struct ConformalForm {
    /// Vertices coupled along edges; orders the elimination.
    edges: Pattern,
    pattern: Pattern,
    values: Vec<f64>,
    /// Whether a vertex is on the boundary.
    boundary: Vec<bool>,
}

/// The cotangent Laplacian on the vertex pattern: `L_ij = -(cot a + cot b) / 2`, row sums zero. Vertices without a face
/// have an empty row; the diagonal there is 1.
pub(super) fn cotangent_laplacian(
    pattern: &Pattern,
    faces: &[[u32; 3]],
    cotangents: impl Fn(usize) -> [f64; 3],
) -> Vec<f64> {
    let mut values = vec![0.0; pattern.entries()];
    for (f, &[a, b, c]) in faces.iter().enumerate() {
        let cot = cotangents(f);
        for (i, j, opposite) in [(a, b, cot[2]), (b, c, cot[0]), (c, a, cot[1])] {
            let half = opposite / 2.0;
            values[pattern.slot(i, j).expect("every edge is in the pattern")] -= half;
            values[pattern.diagonal(i as usize)] += half;
            values[pattern.diagonal(j as usize)] += half;
        }
    }
    for (v, used) in used_vertices(pattern.unknowns(), faces).into_iter().enumerate() {
        if !used {
            values[pattern.diagonal(v)] = 1.0;
        }
    }
    values
}

/// For each vertex, whether a face uses it.
pub(super) fn used_vertices(vertex_count: usize, faces: &[[u32; 3]]) -> Vec<bool> {
    let mut used = vec![false; vertex_count];
    faces.iter().flatten().for_each(|&v| used[v as usize] = true);
    used
}

/// Brings vertices without a face to the middle of the others, so that they do not enlarge the map.
pub(super) fn centre_unused(used: &[bool], uv: &mut [Vec2]) -> usize {
    let count = used.iter().filter(|&&u| u).count();
    let sum = uv.iter().zip(used).filter(|(_, u)| **u).fold(Vec2::zeros(), |s, (p, _)| s + p);
    let middle = sum / count.max(1) as f64;
    uv.iter_mut().zip(used).filter(|(_, u)| !**u).for_each(|(p, _)| *p = middle);
    used.len() - count
}

impl ConformalForm {
    /// Assembles `M` from the cotangents of each face's angles.
    pub fn new(strip: &Strip, cotangents: impl Fn(usize) -> [f64; 3]) -> Result<Self, Error> {
        let (faces, n) = (strip.mesh().faces(), strip.mesh().vertices().len());
        let edges = Pattern::of_vertices(n, faces)?;
        let laplacian = cotangent_laplacian(&edges, faces, cotangents);
        // +1 where the boundary runs from the lower to the higher vertex, -1 where it runs back, 0 inside.
        let mut boundary_run = vec![0i8; edges.entries()];
        let mut boundary = vec![false; n];
        for rim in std::iter::once(strip.outer_loop()).chain(strip.hole_loops().iter().map(Vec::as_slice)) {
            for (k, &a) in rim.iter().enumerate() {
                let b = rim[(k + 1) % rim.len()];
                boundary[a as usize] = true;
                let slot = edges.slot(a, b).expect("a boundary edge is an edge");
                boundary_run[slot] += if a < b { 1 } else { -1 };
            }
        }
        let coupled = boundary_run.iter().filter(|&&r| r != 0).count();
        let mut pattern = PatternBuilder::with_capacity(2 * n, 2 * (edges.entries() + coupled));
        for j in 0..n {
            let first = edges.diagonal(j);
            // 2 Area = sum over boundary half-edges i -> k of u_i v_k - u_k v_i.
            let column = || (first + 1..).zip(&edges.column(j)[1..]);
            pattern.push(2 * j as u32, laplacian[first]);
            for (slot, &i) in column() {
                pattern.push(2 * i, laplacian[slot]);
                if boundary_run[slot] != 0 {
                    pattern.push(2 * i + 1, -0.5 * f64::from(boundary_run[slot]));
                }
            }
            pattern.end_column();
            pattern.push(2 * j as u32 + 1, laplacian[first]);
            for (slot, &i) in column() {
                if boundary_run[slot] != 0 {
                    pattern.push(2 * i, 0.5 * f64::from(boundary_run[slot]));
                }
                pattern.push(2 * i + 1, laplacian[slot]);
            }
            pattern.end_column();
        }
        let (pattern, values) = pattern.finish();
        Ok(Self { edges, pattern, values, boundary })
    }

    /// Which vertices are on a boundary loop.
    pub fn boundary(&self) -> &[bool] {
        &self.boundary
    }

    /// Minimizes `E_C` with two vertices held where they are told. Returns the chart and the relative residual.
    pub fn solve_pinned(mut self, pins: [(u32, Vec2); 2]) -> Result<(Vec<Vec2>, f64), Error> {
        let mut right = vec![0.0; self.pattern.unknowns()];
        let at = |j: usize| pins.iter().find(|p| p.0 as usize == j / 2).map(|p| p.1[j % 2]);
        self.pattern.fix_unknowns(&mut self.values, &mut right, at);
        let x = self.factor()?.solve_refined(&self.pattern, &self.values, &right);
        let residual = self.pattern.relative_residual(&self.values, &x, &right);
        Ok((pair_up(&x), residual))
    }

    /// Factors `M + shift`, where the shift `sigma` is added to the diagonal at boundary vertices only (the matrix `B` of
    /// Mullen et al.): `M` itself leaves the position free, and on a developable surface also size and heading.
    pub fn factor_shifted(mut self, sigma: f64) -> Result<ShiftedForm, Error> {
        let boundary = &self.boundary;
        self.pattern.add_to_diagonal(&mut self.values, |j| if boundary[j / 2] { sigma } else { 0.0 });
        let factor = self.factor()?;
        Ok(ShiftedForm { form: self, factor, sigma })
    }

    fn factor(&self) -> Result<Cholesky, Error> {
        Cholesky::new(&self.pattern, &Analysis::of_paired(&self.edges, &self.pattern)?, &self.values)
    }

    /// Mean diagonal entry of `M`: the scale that a shift is measured against.
    pub fn mean_diagonal(&self) -> f64 {
        let n = self.pattern.unknowns();
        (0..n).map(|j| self.values[self.pattern.diagonal(j)]).sum::<f64>() / n.max(1) as f64
    }
}

/// A factored `M + sigma B`.
pub(super) struct ShiftedForm {
    form: ConformalForm,
    factor: Cholesky,
    sigma: f64,
}

impl ShiftedForm {
    /// The form, shifted.
    pub fn form(&self) -> &ConformalForm {
        &self.form
    }

    /// Adds to a load what the shift takes away from a solution that lies at `uv`: without it, the shift pulls the far ends
    /// of a long strip towards the origin.
    pub fn make_up_for_shift(&self, load: &mut [Vec2], uv: &[Vec2]) {
        for ((l, p), _) in load.iter_mut().zip(uv).zip(&self.form.boundary).filter(|(_, on)| **on) {
            *l += p * self.sigma;
        }
    }

    /// Solves for a load of one vector a vertex. Returns the chart and the relative residual.
    pub fn solve(&self, load: &[Vec2]) -> (Vec<Vec2>, f64) {
        let right = interleave(load);
        let form = &self.form;
        let x = self.factor.solve_refined(&form.pattern, &form.values, &right);
        let residual = form.pattern.relative_residual(&form.values, &x, &right);
        (pair_up(&x), residual)
    }
}

/// A pattern and its values, written column after column.
struct PatternBuilder {
    starts: Vec<u32>,
    rows: Vec<u32>,
    values: Vec<f64>,
}

impl PatternBuilder {
    fn with_capacity(unknowns: usize, entries: usize) -> Self {
        let mut starts = Vec::with_capacity(unknowns + 1);
        starts.push(0);
        Self { starts, rows: Vec::with_capacity(entries), values: Vec::with_capacity(entries) }
    }

    fn push(&mut self, row: u32, value: f64) {
        self.rows.push(row);
        self.values.push(value);
    }

    fn end_column(&mut self) {
        self.starts.push(self.rows.len() as u32);
    }

    fn finish(self) -> (Pattern, Vec<f64>) {
        (Pattern::from_columns(self.starts, self.rows), self.values)
    }
}

fn interleave(uv: &[Vec2]) -> Vec<f64> {
    uv.iter().flat_map(|p| [p.x, p.y]).collect()
}

fn pair_up(x: &[f64]) -> Vec<Vec2> {
    x.chunks_exact(2).map(|p| Vec2::new(p[0], p[1])).collect()
}

/// Two boundary vertices far from each other: the farthest from the first of the outer loop, and the farthest from that.
/// Ties go to the earlier vertex of the loop.
pub(super) fn far_pair(strip: &Strip) -> [u32; 2] {
    let (rim, vertices) = (strip.outer_loop(), strip.mesh().vertices());
    let farthest = |from: u32| {
        let d = |v: u32| (vertices[v as usize] - vertices[from as usize]).norm_squared();
        rim.iter().copied().fold((from, 0.0), |best, v| if d(v) > best.1 { (v, d(v)) } else { best }).0
    };
    let first = farthest(rim[0]);
    [first, farthest(first)]
}
