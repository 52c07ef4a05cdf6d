//! Scalable locally injective mappings: the symmetric Dirichlet energy, which forbids flips, minimized by reweighted
//! local/global steps with a line search that never lets a face turn over.
//!
//! Use it where the map must not flip whatever the surface looks like, or where the worst triangle matters more than the
//! mean. `arap` is faster on tame surfaces.
//!
//! Reference: M. Rabinovich, R. Poranne, D. Panozzo, O. Sorkine-Hornung, "Scalable Locally Injective Mappings", ACM
//! Transactions on Graphics 36(2), 2017, doi:10.1145/2983621. Largest step without flips: J. Smith, S. Schaefer,
//! "Bijective Parameterization with Free Boundaries", ACM Transactions on Graphics 34(4), 2015, doi:10.1145/2766947.
//!
//! | symbol | meaning |
//! |---|---|
//! | `J = U S V^T` | Jacobian of a face with its signed singular values `s1, s2` |
//! | `D(s1, s2)` | `s1^2 + s2^2 + s1^-2 + s2^-2`, four for an isometry |
//! | `R = U V^T` | rotation closest to `J` |
//! | `W = U S_W U^T` | weight with `S_W,i^2 = (dD/ds_i) / (2 (s_i - 1))`; `Q = W^2` |
//! | `A` | area of the face; energies are `sum A D / sum A`, so 4 is the best |
//!
//! Each iteration minimizes `sum A |W (J - R)|^2` plus a proximal term, whose gradient at the current map is that of the
//! energy, and walks towards the minimum as far as the line search allows.
//!
//! Guarantees: no face flips that the start did not have flipped (and the start has none); the energy never rises.
//! Departures: near an isometry `Q` is four times the identity, so the quadratic form is close to two cotangent
//! Laplacians. The system is therefore solved by conjugate gradients preconditioned with one factored Laplacian, made once
//! for all iterations; it never has to be assembled. Where the weights are far from that (after a start by Tutte) and the
//! iterations do not converge, the form is assembled into its 2x2 block pattern (made once, slots known) and factored;
//! both are counted in the summary. The proximal weight is 1e-4 of the mean diagonal instead of an absolute 1e-4. Weights
//! end where a face is squeezed a few hundredfold; the gradient is exact all the same.
//! Cost: one Cholesky factorization of the number of vertices, then about ten solves with it an iteration.

use super::corner_sums::CornerSums;
use super::distortion::orientation;
use super::finish::finish;
use super::flip_free_step::largest_flip_free_step;
use super::guide::Guide;
use super::quasi_newton::{advance, dot};
use super::start::start_without_flips;
use super::triangle_shapes::{Shape, Shapes};
use super::{Error, SolveSummary, stopping};
use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::numeric::sparse::{self, Analysis, Cholesky, Pattern};
use crate::numeric::{Mat2, Vec2, conjugate_gradients};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Proximal term as a share of the mean diagonal entry of the Laplacian.
const PROXIMAL: f64 = 1e-4;
/// The linear solve stops at this share of the first residual: the step is searched along a line anyway.
const SOLVE_SHARE: f64 = 1e-3;
/// Greatest weight in the form that is solved, that of a face squeezed to 3 thousandths: beyond, its matrix would be singular
/// within rounding.
const MOST_WEIGHT: f64 = 4e7;
/// Conjugate gradient steps before the form is factored instead.
const MOST_STEPS: usize = 60;
/// Share of the largest flip-free step that the line search starts from.
const BACK_FROM_FLIP: f64 = 0.8;
/// Armijo constant of the line search.
const ARMIJO: f64 = 1e-4;

/// How a locally injective map is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Iterations at most. Default 10.
    pub max_iterations: usize,
    /// The iterations stop when the energy above that of an isometry falls by less than this share. Default 1e-4.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { max_iterations: 10, tolerance: 1e-4 }
    }
}

/// Flattens a strip without flips, starting from the guide's section chart, a conformal map or Tutte's embedding.
///
/// # Errors
/// [`Error::Solve`] when there is no start without flips or a system cannot be solved, [`Error::Setting`].
pub fn flatten(strip: &Strip, guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    stopping::not_negative("slim.tolerance", settings.tolerance)?;
    let mesh = strip.mesh();
    let shapes = Shapes::of(mesh);
    let mut summary = SolveSummary::default();
    let mut uv = start_without_flips("slim", strip, guide, &shapes, &mut summary)?;
    minimize(mesh, &shapes, &mut uv, settings, &mut summary)
        .map_err(|e| Error::Solve { method: "slim", what: e.to_string() })?;
    finish(strip, &shapes, &mut uv, &mut summary);
    Ok((uv, summary))
}

/// The iterations, from a map without flips.
fn minimize(
    mesh: &Mesh,
    shapes: &Shapes,
    uv: &mut Vec<Vec2>,
    settings: &Settings,
    summary: &mut SolveSummary,
) -> Result<(), sparse::Error> {
    iterate(&mut WeightedSolver::new(mesh, shapes)?, mesh, shapes, uv, settings, summary)
}

/// [`minimize`] with a solver that was made for these shapes.
pub(super) fn iterate(
    solver: &mut WeightedSolver,
    mesh: &Mesh,
    shapes: &Shapes,
    uv: &mut Vec<Vec2>,
    settings: &Settings,
    summary: &mut SolveSummary,
) -> Result<(), sparse::Error> {
    let area = shapes.area();
    let mut energy = dirichlet_energy(mesh.faces(), &shapes.shapes, uv) / area;
    summary.figures.insert("start_energy".to_owned(), energy);
    while summary.iterations < settings.max_iterations && !summary.converged {
        let faces: Vec<FaceWeight> = (mesh.faces(), &shapes.shapes)
            .into_par_iter()
            .map(|(corners, shape)| FaceWeight::at(shape, corners.map(|v| uv[v as usize])))
            .collect();
        let gradient = gradient(&solver.corner_sums, &shapes.shapes, &faces);
        let step = solver.solve(mesh, shapes, &faces, &gradient)?;
        let slope = -dot(&gradient, &step) / area;
        let largest = largest_flip_free_step(mesh.faces(), uv, &step, |_| true);
        let mut length = 1.0f64.min(BACK_FROM_FLIP * largest);
        let before = energy;
        // The energy is a barrier: halving ends, but at rounding level there is nothing left to gain.
        let moved = (slope > 0.0).then_some(60).and_then(|halvings| {
            (0..halvings).find_map(|_| {
                let candidate = advance(uv, &step, length);
                let value = dirichlet_energy(mesh.faces(), &shapes.shapes, &candidate) / area;
                let accepted = value <= before - ARMIJO * length * slope;
                length *= 0.5;
                accepted.then_some((candidate, value))
            })
        });
        summary.iterations += 1;
        let Some((candidate, value)) = moved else {
            summary.converged = true;
            break;
        };
        (*uv, energy) = (candidate, value);
        let fall = (before - energy) / (before - 4.0).max(f64::MIN_POSITIVE);
        summary.residual = Some(fall);
        summary.converged = fall <= settings.tolerance || energy - 4.0 < 1e-13;
    }
    summary.energy = Some(energy);
    summary.figures.insert("linear_steps".to_owned(), solver.steps as f64);
    summary.figures.insert("factorizations".to_owned(), solver.factorizations as f64);
    Ok(())
}

/// What a face contributes at the current map.
#[derive(Clone, Copy)]
struct FaceWeight {
    /// `Q = W^2`, symmetric: entries 00, 01, 11; its eigenvalues end at [`MOST_WEIGHT`].
    q: [f64; 3],
    /// `Q (J - R)` without that end, half the derivative of `D` with respect to `J`.
    stress: Mat2,
}

impl FaceWeight {
    fn at(shape: &Shape, corners: [Vec2; 3]) -> Self {
        let j = shape.jacobian(corners);
        // Signed singular values and vectors in closed form: J = rotation part + mirrored part.
        let (e, f) = ((j.m11 + j.m22) / 2.0, (j.m11 - j.m22) / 2.0);
        let (g, h) = ((j.m21 + j.m12) / 2.0, (j.m21 - j.m12) / 2.0);
        let (turn, mirror) = (e.hypot(h), f.hypot(g));
        let (s1, s2) = (turn + mirror, turn - mirror);
        // (s - s^-3) / (s - 1) without the cancellation near s = 1.
        let weight = |s: f64| (s * s + 1.0) * (s + 1.0) / (s * s * s);
        let (w1, w2) = (weight(s1), weight(s2));
        // U has angle (turn angle + mirror angle) / 2.
        let double = h.atan2(e) + g.atan2(f);
        let (sin, cos) = double.sin_cos();
        let form = |w1: f64, w2: f64| {
            let (mean, half) = ((w1 + w2) / 2.0, (w1 - w2) / 2.0);
            [mean + half * cos, half * sin, mean - half * cos]
        };
        let q = form(w1, w2);
        let rotation = if turn > 0.0 { Mat2::new(e, -h, h, e) / turn } else { Mat2::identity() };
        let d = j - rotation;
        let stress = Mat2::new(q[0], q[1], q[1], q[2]) * d;
        Self { q: form(w1.min(MOST_WEIGHT), w2.min(MOST_WEIGHT)), stress }
    }
}

/// Sum of `A D`; infinite as soon as a face is not counter-clockwise, which is decided exactly.
fn dirichlet_energy(faces: &[[u32; 3]], shapes: &[Shape], uv: &[Vec2]) -> f64 {
    let each: Vec<f64> = (faces, shapes)
        .into_par_iter()
        .map(|(corners, shape)| {
            let p = corners.map(|v| uv[v as usize]);
            let j = shape.jacobian(p);
            let det = j.determinant();
            if det <= 0.0 || orientation(p) <= 0.0 {
                return f64::INFINITY;
            }
            let norm = j.norm_squared();
            shape.area() * norm * (1.0 + 1.0 / (det * det))
        })
        .collect();
    each.iter().sum()
}

/// Gradient of the energy sum with respect to the vertices.
fn gradient(corner_sums: &CornerSums, shapes: &[Shape], weights: &[FaceWeight]) -> Vec<Vec2> {
    corner_sums.gather(|_| Vec2::zeros(), |f| shapes[f].hat_gradients().map(|g| (weights[f].stress * g) * 2.0))
}

/// Solves for the step of the weighted form.
pub(super) struct WeightedSolver {
    edges: Pattern,
    analysis: Analysis,
    corner_sums: CornerSums,
    proximal: f64,
    laplacian: Cholesky,
    /// The 2x2 block form, made when the iterations fail for the first time; from then on it alone is used.
    block: Option<(Pattern, Analysis)>,
    /// Conjugate gradient steps so far.
    steps: usize,
    /// Factorizations of the block form so far.
    factorizations: usize,
}

impl WeightedSolver {
    pub fn new(mesh: &Mesh, shapes: &Shapes) -> Result<Self, sparse::Error> {
        let n = mesh.vertices().len();
        let edges = Pattern::of_vertices(n, mesh.faces())?;
        let analysis = Analysis::new(&edges)?;
        let (laplacian, proximal) = isometric_form(&edges, &analysis, mesh, shapes)?;
        let corner_sums = CornerSums::new(n, mesh.faces());
        Ok(Self { edges, analysis, corner_sums, proximal, laplacian, block: None, steps: 0, factorizations: 0 })
    }

    /// Factors the block form from now on.
    pub fn directly(mut self) -> Result<Self, sparse::Error> {
        self.make_block()?;
        Ok(self)
    }

    fn make_block(&mut self) -> Result<(), sparse::Error> {
        if self.block.is_none() {
            let pattern = self.edges.two_per_node()?;
            let analysis = Analysis::of_paired(&self.edges, &pattern)?;
            self.block = Some((pattern, analysis));
        }
        Ok(())
    }

    /// The same solver for other shapes of the same faces.
    pub fn take_shapes(&mut self, mesh: &Mesh, shapes: &Shapes) -> Result<(), sparse::Error> {
        (self.laplacian, self.proximal) = isometric_form(&self.edges, &self.analysis, mesh, shapes)?;
        Ok(())
    }

    /// The step `-H^-1 gradient / 2` with `H` the weighted form plus the proximal term.
    fn solve(
        &mut self,
        mesh: &Mesh,
        shapes: &Shapes,
        weights: &[FaceWeight],
        gradient: &[Vec2],
    ) -> Result<Vec<Vec2>, sparse::Error> {
        let right: Vec<Vec2> = gradient.iter().map(|g| g * -0.5).collect();
        if self.block.is_none() {
            let n = right.len();
            let split = |p: &[Vec2]| -> Vec<f64> { p.iter().map(|p| p.x).chain(p.iter().map(|p| p.y)).collect() };
            let join = |x: &[f64]| -> Vec<Vec2> { (0..n).map(|v| Vec2::new(x[v], x[n + v])).collect() };
            // Two solves with the Laplacian of an isometry.
            let precondition = |r: &[f64]| {
                let mut x = r.to_vec();
                self.laplacian.solve_in_place(&mut x);
                x
            };
            let multiply = |x: &[f64]| split(&self.multiply(mesh, shapes, weights, &join(x)));
            let outcome = conjugate_gradients::solve(multiply, precondition, &split(&right), SOLVE_SHARE, MOST_STEPS);
            self.steps += outcome.steps;
            if outcome.converged {
                return Ok(join(&outcome.x));
            }
        }
        self.direct(mesh, shapes, weights, &right)
    }

    /// `H x`, face by face.
    fn multiply(&self, mesh: &Mesh, shapes: &Shapes, weights: &[FaceWeight], x: &[Vec2]) -> Vec<Vec2> {
        self.corner_sums.gather(
            |v| x[v] * self.proximal,
            |f| {
                let (shape, weight) = (&shapes.shapes[f], &weights[f]);
                let j = shape.jacobian(mesh.faces()[f].map(|v| x[v as usize]));
                let stress = Mat2::new(weight.q[0], weight.q[1], weight.q[1], weight.q[2]) * j;
                shape.hat_gradients().map(|g| stress * g)
            },
        )
    }

    /// Assembles and factors the block form.
    fn direct(
        &mut self,
        mesh: &Mesh,
        shapes: &Shapes,
        weights: &[FaceWeight],
        right: &[Vec2],
    ) -> Result<Vec<Vec2>, sparse::Error> {
        self.make_block()?;
        let (pattern, analysis) = self.block.as_ref().expect("just made");
        let mut values = vec![0.0; pattern.entries()];
        let mut add = |i: u32, j: u32, k: f64, q: [f64; 3]| {
            let slot = self.edges.slot(i, j).expect("every edge is in the pattern");
            let block = self.edges.block_slots(slot, i.min(j) as usize);
            let entries = [k * q[0], k * q[1], k * q[1], k * q[2]];
            for (n, (slot, entry)) in block.into_iter().zip(entries).enumerate() {
                // On the diagonal the upper entry is the lower one.
                if !(n == 2 && i == j) {
                    values[slot] += entry;
                }
            }
        };
        for ((corners, shape), weight) in mesh.faces().iter().zip(&shapes.shapes).zip(weights) {
            let hats = shape.hat_gradients();
            for a in 0..3 {
                for b in a..3 {
                    let k = hats[a].dot(&hats[b]) / shape.area();
                    add(corners[a], corners[b], k, weight.q);
                }
            }
        }
        pattern.add_to_diagonal(&mut values, |j| if self.corner_sums.is_used(j / 2) { self.proximal } else { 1.0 });
        let factor = Cholesky::new(pattern, analysis, &values)?;
        self.factorizations += 1;
        let mut x: Vec<f64> = right.iter().flat_map(|p| [p.x, p.y]).collect();
        factor.solve_in_place(&mut x);
        Ok(x.chunks_exact(2).map(|p| Vec2::new(p[0], p[1])).collect())
    }
}

/// The form at an isometry with the proximal term, factored, and the weight of that term.
fn isometric_form(
    edges: &Pattern,
    analysis: &Analysis,
    mesh: &Mesh,
    shapes: &Shapes,
) -> Result<(Cholesky, f64), sparse::Error> {
    let n = mesh.vertices().len();
    let mut values = super::conformal::cotangent_laplacian(edges, mesh.faces(), |f| shapes.shapes[f].cotangents());
    let mean = (0..n).map(|j| values[edges.diagonal(j)]).sum::<f64>() / n.max(1) as f64;
    let proximal = PROXIMAL * mean;
    // An isometry has Q = 4.
    values.iter_mut().for_each(|v| *v *= 4.0);
    edges.add_to_diagonal(&mut values, |_| proximal);
    Ok((Cholesky::new(edges, analysis, &values)?, proximal))
}

#[cfg(test)]
mod tests {
    use super::super::closed_form;
    use super::*;

    #[test]
    fn weights_and_stress_match_the_energy() {
        let shape = Shape { base: 1.5, x: 0.4, y: 1.1 };
        let p = [Vec2::new(0.1, 0.0), Vec2::new(2.0, 0.5), Vec2::new(0.2, 0.9)];
        let faces = [[0u32, 1, 2]];
        let weights = [FaceWeight::at(&shape, p)];
        let g = gradient(&CornerSums::new(3, &faces), &[shape], &weights);
        for i in 0..3 {
            for k in 0..2 {
                let at = |d: f64| {
                    let mut q = p;
                    q[i][k] += d;
                    dirichlet_energy(&faces, &[shape], &q)
                };
                let numeric = (at(1e-6) - at(-1e-6)) / 2e-6;
                assert!((numeric - g[i][k]).abs() < 1e-6, "{numeric} {}", g[i][k]);
            }
        }
        let isometry = FaceWeight::at(&shape, shape.corners());
        assert!((isometry.q[0] - 4.0).abs() < 1e-12 && isometry.q[1].abs() < 1e-12 && isometry.stress.norm() < 1e-12);
    }

    #[test]
    fn developable_surfaces_become_isometries() {
        for known in closed_form::developable() {
            let (_, summary) = flatten(&known.strip, None, &Settings::default()).unwrap();
            assert!(summary.converged && summary.energy.unwrap() - 4.0 < 1e-9, "{} {summary:?}", known.name);
        }
    }

    #[test]
    fn from_a_far_start_it_gets_to_the_same_map_without_flips() {
        let known = closed_form::rough(30, 30);
        let mesh = known.strip.mesh();
        let settings = Settings { max_iterations: 200, tolerance: 1e-9 };
        let (_, near) = flatten(&known.strip, None, &settings).unwrap();
        let shapes = Shapes::of(mesh);
        let mut far = super::super::start::tutte(&known.strip, &shapes).unwrap();
        let mut summary = SolveSummary::default();
        minimize(mesh, &shapes, &mut far, &settings, &mut summary).unwrap();
        assert_eq!(super::super::distortion::flipped_faces(mesh, &far).0, 0);
        let (a, b) = (near.energy.unwrap(), summary.energy.unwrap());
        assert!((a / b - 1.0).abs() < 1e-5, "{a} {b}");
    }

    #[test]
    fn conjugate_gradients_and_the_factored_form_give_the_same_step() {
        let known = closed_form::rough(20, 20);
        let (mesh, shapes) = (known.strip.mesh(), Shapes::of(known.strip.mesh()));
        let uv = super::super::start::start("slim", &known.strip, None, &shapes, &mut SolveSummary::default()).unwrap();
        let pairs = mesh.faces().iter().zip(&shapes.shapes);
        let weights: Vec<FaceWeight> = pairs.map(|(c, s)| FaceWeight::at(s, c.map(|v| uv[v as usize]))).collect();
        let mut solver = WeightedSolver::new(mesh, &shapes).unwrap();
        let right = gradient(&solver.corner_sums, &shapes.shapes, &weights);
        let direct = solver.direct(mesh, &shapes, &weights, &right).unwrap();
        let back = solver.multiply(mesh, &shapes, &weights, &direct);
        let largest = right.iter().map(|r| r.amax()).fold(0.0, f64::max);
        for (b, r) in back.iter().zip(&right) {
            assert!((b - r).amax() < 1e-9 * largest);
        }
    }
}
