//! The conformal energy of a triangle mesh as a sparse quadratic form: what [`super::lscm`] minimizes and what turns the
//! angles of [`super::abf`] into coordinates.
//!
//! For (u, v) per vertex, `E_C = E_D - A`: Dirichlet energy minus signed area, zero for a similarity and positive else
//! (U. Pinkall and K. Polthier, "Computing Discrete Minimal Surfaces and Their Conjugates", Experimental Mathematics
//! 2(1), 1993, doi:10.1080/10586458.1993.10504266). With one complex unknown a vertex, `z = u + i v`, it is
//! `E_C = 1/2 z^* M z` with the Hermitian `M = L + i K`: the cotangent Laplacian, and the area as a sum over boundary
//! half-edges only, hole loops included (`K` is +1/2 where the boundary runs from row to column, -1/2 where it runs back).
//! `M` has the entries of one real Laplacian, a factorization needs a quarter of the arithmetic of one with u and v as unknowns
//! of their own, and a quarter turn of all (u, v) is a product with `i`: one factorization serves all pins and loads.

use crate::cut::Strip;
use crate::numeric::Vec2;
use crate::numeric::sparse::{Analysis, Cholesky, Complex, Error, Pattern};

/// `M` with its mesh.
pub(super) struct ConformalForm {
    /// Vertices coupled along edges.
    pattern: Pattern,
    analysis: Analysis,
    values: Vec<Complex>,
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
    pub fn new(strip: &Strip, cotangents: impl Fn(usize) -> [f64; 3] + Send) -> Result<Self, Error> {
        let (faces, n) = (strip.mesh().faces(), strip.mesh().vertices().len());
        let pattern = Pattern::of_vertices(n, faces)?;
        let (analysis, (values, boundary)) = rayon::join(
            || Analysis::new(&pattern),
            || {
                let laplacian = cotangent_laplacian(&pattern, faces, cotangents);
                with_area(strip, &pattern, laplacian.into_iter().map(Complex::from).collect())
            },
        );
        Ok(Self { analysis: analysis?, pattern, values, boundary })
    }

    /// Which vertices are on a boundary loop.
    pub fn boundary(&self) -> &[bool] {
        &self.boundary
    }

    /// Minimizes `E_C` with two vertices held where they are told. Returns the chart and the relative residual.
    pub fn solve_pinned(mut self, pins: [(u32, Vec2); 2]) -> Result<(Vec<Vec2>, f64), Error> {
        let mut right = vec![Complex::default(); self.pattern.unknowns()];
        let at = |v: usize| pins.iter().find(|p| p.0 as usize == v).map(|p| Complex::new(p.1.x, p.1.y));
        self.pattern.fix_unknowns(&mut self.values, &mut right, at);
        let z = Cholesky::new(&self.pattern, &self.analysis, &self.values)?.solve_refined(
            &self.pattern,
            &self.values,
            &right,
        );
        let residual = self.pattern.relative_residual(&self.values, &z, &right);
        Ok((to_chart(&z), residual))
    }

    /// Factors `M + shift`, where the shift `sigma` is added to the diagonal at boundary vertices only (the matrix `B` of
    /// Mullen et al.): `M` itself leaves the position free, and on a developable surface also size and heading.
    pub fn factor_shifted(mut self, sigma: f64) -> Result<ShiftedForm, Error> {
        let boundary = &self.boundary;
        self.pattern.add_to_diagonal(&mut self.values, |v| if boundary[v] { sigma } else { 0.0 });
        let factor = Cholesky::new(&self.pattern, &self.analysis, &self.values)?;
        Ok(ShiftedForm { form: self, factor, sigma })
    }

    /// Mean diagonal entry of `M`: the scale that a shift is measured against.
    pub fn mean_diagonal(&self) -> f64 {
        let n = self.pattern.unknowns();
        (0..n).map(|v| self.values[self.pattern.diagonal(v)].re).sum::<f64>() / n.max(1) as f64
    }
}

/// Takes the area of the map from the values of `L`; also tells which vertices are on a boundary loop.
fn with_area(strip: &Strip, pattern: &Pattern, mut values: Vec<Complex>) -> (Vec<Complex>, Vec<bool>) {
    let mut boundary = vec![false; pattern.unknowns()];
    for rim in std::iter::once(strip.outer_loop()).chain(strip.hole_loops().iter().map(Vec::as_slice)) {
        for (k, &a) in rim.iter().enumerate() {
            let b = rim[(k + 1) % rim.len()];
            boundary[a as usize] = true;
            // 2 Area = sum over boundary half-edges a -> b of u_a v_b - u_b v_a; the row stored is the higher vertex.
            let slot = pattern.slot(a, b).expect("a boundary edge is an edge");
            values[slot].im -= if a < b { 0.5 } else { -0.5 };
        }
    }
    (values, boundary)
}

/// A factored `M + sigma B`.
pub(super) struct ShiftedForm {
    form: ConformalForm,
    factor: Cholesky<Complex>,
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
        let (right, form) = (to_complex(load), &self.form);
        let z = self.factor.solve_refined(&form.pattern, &form.values, &right);
        let residual = form.pattern.relative_residual(&form.values, &z, &right);
        (to_chart(&z), residual)
    }

    /// [`Self::solve`] from a chart that is nearly the solution: solving for what is missing refines it on the way.
    pub fn solve_from(&self, start: &[Vec2], load: &[Vec2]) -> Vec<Vec2> {
        let form = &self.form;
        let mut z = to_complex(start);
        let mut missing = form.pattern.multiply(&form.values, &z);
        missing.iter_mut().zip(load).for_each(|(m, l)| *m = Complex::new(l.x, l.y) - *m);
        self.factor.solve_in_place(&mut missing);
        z.iter_mut().zip(&missing).for_each(|(z, m)| *z += m);
        to_chart(&z)
    }

    /// The relative residual of a chart under a load.
    pub fn residual(&self, uv: &[Vec2], load: &[Vec2]) -> f64 {
        self.form.pattern.relative_residual(&self.form.values, &to_complex(uv), &to_complex(load))
    }
}

fn to_complex(load: &[Vec2]) -> Vec<Complex> {
    load.iter().map(|l| Complex::new(l.x, l.y)).collect()
}

fn to_chart(z: &[Complex]) -> Vec<Vec2> {
    z.iter().map(|z| Vec2::new(z.re, z.im)).collect()
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
