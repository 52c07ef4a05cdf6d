//! ABF++: the angles of a flat triangulation that are closest to those of the surface, for meshes of millions of faces.
//!
//! Use it for the least angle distortion with little area distortion. It takes several factorizations of twice the number
//! of vertices; `lscm` takes one and comes close, `arap` treats lengths better.
//!
//! References: A. Sheffer, B. Lévy, M. Mogilnitsky, A. Bogomyakov, "ABF++: Fast and Robust Angle Based Flattening", ACM
//! Transactions on Graphics 24(2), 2005, doi:10.1145/1061347.1061354; the first step from the targets is the linear ABF of
//! R. Zayer, B. Lévy, H.-P. Seidel, "Linear Angle Based Parameterization", Symposium on Geometry Processing 2007.
//!
//! | symbol | meaning |
//! |---|---|
//! | `alpha`, `phi`, `w` | angles, their targets, weights `1 / phi^2` |
//! | `C` | `C_plan` and `C_len` of the inner vertices, see `angles`; `J` their Jacobian |
//! | `lambda` | their multipliers |
//! | `P_t` | inverse of a face's weights restricted to steps that keep its angle sum |
//!
//! Each iteration is a Newton step of the Lagrangian with the Hessian of the energy (the second derivatives of `C` are left
//! out, as in the paper). Angles and face conditions are eliminated face by face, which leaves
//! `(sum_t J_t P_t J_t^T) lambda = C + J P w (phi - alpha)`: positive definite, two unknowns an inner vertex, one 2x2 block
//! an edge. The pattern is made and analysed once. The matrix changes little between iterations, so the factor of an
//! earlier one preconditions conjugate gradients until that takes too many steps.
//!
//! Guarantees: when it converges, the fixed point is that of the full problem (the same as `abf`), and the layout has the
//! angles to the tolerance. When it does not, that is told and the best angles so far are laid out; nothing else is tried.
//! Departures: `C_len` is the difference of logarithms instead of products, the same set with a better scaled Jacobian;
//! steps are shortened where an angle would leave (0, pi) instead of raising its weight.
//! Layout: least squares conformal with the cotangents of the found angles (shared with `lscm`), then the surface's area.
//! Cost: one or two factorizations with two unknowns a vertex, a few solves an iteration, and a factorization for the layout.

use super::angles::{AngleProblem, FREE, lay_out};
use super::guide::Guide;
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary, stopping};
use crate::cut::Strip;
use crate::numeric::sparse::{self, Analysis, Cholesky, Pattern};
use crate::numeric::{Vec2, conjugate_gradients};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// The linear solve with an old factor stops at this share of its first residual.
const SOLVE_SHARE: f64 = 1e-3;
/// More steps than this with an old factor cost more than a new one.
const MOST_STEPS: usize = 8;

/// How angles are flattened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Newton iterations at most. Default 20.
    pub max_iterations: usize,
    /// The iterations stop when no condition is off by more than this many radians and no angle moves by more than 1000
    /// times as much. Default 1e-7.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { max_iterations: 20, tolerance: 1e-7 }
    }
}

/// Flattens by angles. The guide is not needed.
///
/// # Errors
/// [`Error::Solve`] when a system cannot be solved or the layout has no area, [`Error::Setting`].
pub fn flatten(strip: &Strip, _guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    stopping::positive("abf++.tolerance", settings.tolerance)?;
    let shapes = Shapes::of(strip.mesh());
    let problem = AngleProblem::new(strip.mesh(), &shapes);
    let mut summary = SolveSummary::default();
    let solve_error = |e: sparse::Error| Error::Solve { method: "abf++", what: e.to_string() };
    let angles = newton(&problem, settings, &mut summary).map_err(solve_error)?;
    let uv = lay_out("abf++", strip, &shapes, &angles, &mut summary)?;
    Ok((uv, summary))
}

/// The reduced Newton iterations. Returns the angles.
fn newton(
    problem: &AngleProblem,
    settings: &Settings,
    summary: &mut SolveSummary,
) -> Result<Vec<[f64; 3]>, sparse::Error> {
    let mut angles = problem.start();
    if problem.inner_count == 0 {
        // Every vertex is on the boundary: any angles fit.
        summary.converged = true;
        return Ok(angles);
    }
    let edges = || {
        problem.faces.iter().flat_map(|c| {
            let [a, b, c] = c.map(|v| problem.inner[v as usize]);
            [(a, b), (b, c), (c, a)].into_iter().filter(|&(a, b)| a != FREE && b != FREE)
        })
    };
    let nodes = Pattern::of_pairs(problem.inner_count, edges)?;
    let mut solver = ReducedSolver::new(&nodes)?;
    let mut residuals = problem.residuals(&angles);
    summary.figures.insert("shortened_steps".to_owned(), 0.0);
    while summary.iterations < settings.max_iterations && !summary.converged {
        let cotangents: Vec<[f64; 3]> = angles.par_iter().map(|a| a.map(|x| x.cos() / x.sin())).collect();
        let mut right = residuals;
        assemble(problem, &angles, &cotangents, &nodes, &mut solver.values, &mut right);
        let multipliers = solver.solve(right)?;
        let step = angle_step(problem, &angles, &cotangents, &multipliers);
        let share = problem.longest_step(&angles, &step);
        if share < 1.0 {
            *summary.figures.entry("shortened_steps".to_owned()).or_default() += 1.0;
        }
        let mut largest = 0.0f64;
        for (a, d) in angles.iter_mut().flatten().zip(step.iter().flatten()) {
            *a += share * d;
            largest = largest.max((share * d).abs());
        }
        residuals = problem.residuals(&angles);
        let misfit = problem.misfit(&angles, &residuals);
        summary.iterations += 1;
        summary.residual = Some(misfit.largest());
        summary.figures.insert("largest_angle_step".to_owned(), largest);
        summary.converged = misfit.largest() <= settings.tolerance && largest <= 1000.0 * settings.tolerance;
    }
    summary.energy = Some(problem.energy(&angles));
    summary.figures.insert("factorizations".to_owned(), solver.factorizations as f64);
    summary.figures.insert("linear_steps".to_owned(), solver.steps as f64);
    stopping::warn_of_misfit("abf++", settings.tolerance, summary);
    Ok(angles)
}

/// The reduced system. Its matrix changes little from step to step, so an old factor serves as preconditioner until it
/// needs too many steps.
struct ReducedSolver {
    pattern: Pattern,
    analysis: Analysis,
    values: Vec<f64>,
    factor: Option<Cholesky>,
    /// The multipliers of the step before.
    last: Vec<f64>,
    factorizations: usize,
    /// Conjugate gradient steps so far.
    steps: usize,
}

impl ReducedSolver {
    fn new(nodes: &Pattern) -> Result<Self, sparse::Error> {
        let pattern = nodes.two_per_node()?;
        let analysis = Analysis::of_paired(nodes, &pattern)?;
        let values = vec![0.0; pattern.entries()];
        Ok(Self { pattern, analysis, values, factor: None, last: Vec::new(), factorizations: 0, steps: 0 })
    }

    fn solve(&mut self, mut right: Vec<f64>) -> Result<Vec<f64>, sparse::Error> {
        if let Some(old) = &self.factor {
            let precondition = |r: &[f64]| {
                let mut x = r.to_vec();
                old.solve_in_place(&mut x);
                x
            };
            let multiply = |x: &[f64]| self.pattern.multiply(&self.values, x);
            // The multipliers settle like the angles, so only their change has to be found.
            let mut rest = multiply(&self.last);
            rest.iter_mut().zip(&right).for_each(|(r, b)| *r = b - *r);
            let outcome = conjugate_gradients::solve(multiply, precondition, &rest, SOLVE_SHARE, MOST_STEPS);
            self.steps += outcome.steps;
            if outcome.converged {
                self.last.iter_mut().zip(&outcome.x).for_each(|(x, d)| *x += d);
                return Ok(self.last.clone());
            }
        }
        self.factorizations += 1;
        let factor = match self.factor.take() {
            Some(mut factor) => {
                factor.refactor(&self.pattern, &self.values)?;
                factor
            }
            None => Cholesky::new(&self.pattern, &self.analysis, &self.values)?,
        };
        factor.solve_in_place(&mut right);
        self.factor = Some(factor);
        self.last.clone_from(&right);
        Ok(right)
    }
}

/// `P_t x` for one face: the inverse of the weights on steps that sum to zero.
fn project(inverse: &[f64; 3], x: &[f64; 3]) -> [f64; 3] {
    let mean = (0..3).map(|k| inverse[k] * x[k]).sum::<f64>() / inverse.iter().sum::<f64>();
    std::array::from_fn(|k| inverse[k] * (x[k] - mean))
}

/// What a face does without multipliers: back to its targets as far as its sum allows, which it restores.
fn free_step(angles: &[f64; 3], target: &[f64; 3], inverse: &[f64; 3]) -> [f64; 3] {
    let pull: [f64; 3] = std::array::from_fn(|k| (target[k] - angles[k]) / inverse[k]);
    let lack = (PI - angles.iter().sum::<f64>()) / inverse.iter().sum::<f64>();
    let free = project(inverse, &pull);
    std::array::from_fn(|k| free[k] + inverse[k] * lack)
}

/// Fills the matrix and completes the right-hand side, which comes with `C`.
fn assemble(
    problem: &AngleProblem,
    angles: &[[f64; 3]],
    cotangents: &[[f64; 3]],
    nodes: &Pattern,
    values: &mut [f64],
    right: &mut [f64],
) {
    values.fill(0.0);
    for (t, corners) in problem.faces.iter().enumerate() {
        let inner = corners.map(|v| problem.inner[v as usize]);
        let inverse = problem.weight[t].map(|w| 1.0 / w);
        let free = free_step(&angles[t], &problem.target[t], &inverse);
        let gradients: [[[f64; 3]; 2]; 3] = std::array::from_fn(|k| AngleProblem::gradients(&cotangents[t], k));
        let projected = gradients.map(|g| g.map(|g| project(&inverse, &g)));
        let dot = |a: &[f64; 3], b: &[f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        for a in 0..3 {
            if inner[a] == FREE {
                continue;
            }
            for row in 0..2 {
                right[2 * inner[a] as usize + row] += dot(&gradients[a][row], &free);
            }
            for b in 0..3 {
                // Lower triangle of blocks: the row is the larger node.
                if inner[b] == FREE || inner[b] > inner[a] {
                    continue;
                }
                let slot = nodes.slot(inner[a], inner[b]).expect("every inner edge is in the pattern");
                let block = nodes.block_slots(slot, inner[b] as usize);
                for (n, (row, column)) in [(0, 0), (1, 0), (0, 1), (1, 1)].into_iter().enumerate() {
                    if !(a == b && n == 2) {
                        values[block[n]] += dot(&gradients[a][row], &projected[b][column]);
                    }
                }
            }
        }
    }
}

/// The step of all angles, given the multipliers.
fn angle_step(
    problem: &AngleProblem,
    angles: &[[f64; 3]],
    cotangents: &[[f64; 3]],
    multipliers: &[f64],
) -> Vec<[f64; 3]> {
    let each = |t: usize| {
        let inverse = problem.weight[t].map(|w| 1.0 / w);
        let mut step = free_step(&angles[t], &problem.target[t], &inverse);
        let mut push = [0.0; 3];
        for k in 0..3 {
            let v = problem.inner[problem.faces[t][k] as usize];
            if v != FREE {
                let gradients = AngleProblem::gradients(&cotangents[t], k);
                for (row, gradient) in gradients.iter().enumerate() {
                    let multiplier = multipliers[2 * v as usize + row];
                    (0..3).for_each(|i| push[i] += multiplier * gradient[i]);
                }
            }
        }
        let push = project(&inverse, &push);
        (0..3).for_each(|i| step[i] -= push[i]);
        step
    };
    (0..problem.faces.len()).into_par_iter().with_min_len(1024).map(each).collect()
}

#[cfg(test)]
mod tests {
    use super::super::closed_form;
    use super::*;

    #[test]
    fn developable_surfaces_keep_their_angles() {
        for known in closed_form::developable() {
            let (uv, summary) = flatten(&known.strip, None, &Settings::default()).unwrap();
            assert!(summary.converged && summary.iterations <= 2 && summary.energy.unwrap() < 1e-12, "{summary:?}");
            let shapes = Shapes::of(known.strip.mesh());
            let energy = super::super::rigid_fit::rigid_energy(known.strip.mesh().faces(), &shapes.shapes, &uv);
            assert!(energy < 1e-10, "{} {energy}", known.name);
        }
    }

    #[test]
    fn the_layout_has_the_angles() {
        let known = closed_form::rough(40, 40);
        let shapes = Shapes::of(known.strip.mesh());
        let problem = AngleProblem::new(known.strip.mesh(), &shapes);
        let mut summary = SolveSummary::default();
        let angles = newton(&problem, &Settings::default(), &mut summary).unwrap();
        assert!(summary.converged, "{summary:?}");
        let uv = lay_out("abf++", &known.strip, &shapes, &angles, &mut summary).unwrap();
        for (corners, wanted) in known.strip.mesh().faces().iter().zip(&angles) {
            for k in 0..3 {
                let [p, q, r] = [k, (k + 1) % 3, (k + 2) % 3].map(|i| uv[corners[i] as usize]);
                let angle = (q - p).perp(&(r - p)).atan2((q - p).dot(&(r - p)));
                assert!((angle - wanted[k]).abs() < 1e-5, "{angle} {}", wanted[k]);
            }
        }
    }

    #[test]
    fn not_converging_is_told() {
        let known = closed_form::rough(20, 20);
        let settings = Settings { max_iterations: 1, tolerance: 1e-12 };
        let (_, summary) = flatten(&known.strip, None, &settings).unwrap();
        assert!(!summary.converged && summary.warnings.iter().any(|w| w.code == "not-converged"));
    }
}
