//! Angle based flattening by full Newton steps: the reference that `abf++` is checked against, for small meshes.
//!
//! Reference: A. Sheffer, E. de Sturler, "Parameterization of Faceted Surfaces for Meshing using Angle-Based Flattening",
//! Engineering with Computers 17, 2001, doi:10.1007/PL00013391.
//!
//! | symbol | meaning |
//! |---|---|
//! | `alpha`, `phi`, `w` | angles, their targets, weights `1 / phi^2` |
//! | `C_tri`, `C_plan`, `C_len` | conditions of faces and inner vertices, see `angles`; `C_len` as difference of products |
//! | `lambda` | one multiplier a condition |
//!
//! Newton's method on the Lagrangian `1/2 sum w (alpha - phi)^2 + lambda . C` in all unknowns at once, second derivatives
//! of `C_len` included, by sparse LU of the indefinite system.
//!
//! Guarantees: when it converges, the angles satisfy the conditions to the tolerance and are stationary. When it does not,
//! that is told; the angles reached are laid out.
//! Departure: steps are shortened where an angle would leave (0, pi).
//! Layout: as in `abf++`. Cost: an LU factorization with about five unknowns a face an iteration, whose fill makes it
//! useless for large meshes; it refuses them.

use super::angles::{AngleProblem, FREE, lay_out};
use super::guide::Guide;
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary, stopping};
use crate::cut::Strip;
use crate::numeric::Vec2;
use faer::linalg::solvers::Solve;
use faer::sparse::{SparseColMat, Triplet};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// How angles are flattened by full Newton steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Newton iterations at most. Default 30.
    pub max_iterations: usize,
    /// The iterations stop when no condition is off by more than this many radians and no angle moves by more than 1000
    /// times as much. Default 1e-7.
    pub tolerance: f64,
    /// Meshes with more faces are refused: `abf++` gives the same map. Default 50000.
    pub max_faces: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { max_iterations: 30, tolerance: 1e-7, max_faces: 50_000 }
    }
}

/// Flattens by angles. The guide is not needed.
///
/// # Errors
/// [`Error::Solve`] when the mesh is too large, a system cannot be solved or the layout has no area; [`Error::Setting`].
pub fn flatten(strip: &Strip, _guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    stopping::positive("abf.tolerance", settings.tolerance)?;
    let count = strip.mesh().faces().len();
    if count > settings.max_faces {
        let what = format!(
            "{count} faces are more than unwrap.abf.max_faces = {}: full Newton is the reference for small meshes, use abf++",
            settings.max_faces
        );
        return Err(Error::Solve { method: "abf", what });
    }
    let shapes = Shapes::of(strip.mesh());
    let problem = AngleProblem::new(strip.mesh(), &shapes);
    let mut summary = SolveSummary::default();
    let angles = newton(&problem, settings, &mut summary)?;
    let uv = lay_out("abf", strip, &shapes, &angles, &mut summary)?;
    Ok((uv, summary))
}

/// The corners around each inner vertex: (angle after, angle before, angle at) as indices `3 t + k`.
fn wheels(problem: &AngleProblem) -> Vec<Vec<[usize; 3]>> {
    let mut wheels = vec![Vec::new(); problem.inner_count];
    for (t, corners) in problem.faces.iter().enumerate() {
        for k in 0..3 {
            let v = problem.inner[corners[k] as usize];
            if v != FREE {
                wheels[v as usize].push([3 * t + (k + 1) % 3, 3 * t + (k + 2) % 3, 3 * t + k]);
            }
        }
    }
    wheels
}

fn newton(problem: &AngleProblem, settings: &Settings, summary: &mut SolveSummary) -> Result<Vec<[f64; 3]>, Error> {
    let (faces, inner) = (problem.faces.len(), problem.inner_count);
    let (tri, plan, len) = (3 * faces, 4 * faces, 4 * faces + inner);
    let unknowns = len + inner;
    let wheels = wheels(problem);
    let mut angles = problem.start();
    let mut multipliers = vec![0.0; unknowns - tri];
    summary.figures.insert("shortened_steps".to_owned(), 0.0);
    while summary.iterations < settings.max_iterations && !summary.converged {
        let flat = angles.as_flattened();
        let mut entries: Vec<Triplet<usize, usize, f64>> = Vec::new();
        let mut right = vec![0.0; unknowns];
        let mut couple = |row: usize, column: usize, value: f64| {
            entries.push(Triplet::new(row, column, value));
            entries.push(Triplet::new(column, row, value));
        };
        let mut hessian: Vec<(usize, usize, f64)> = Vec::new();
        let (target, weight) = (problem.target.as_flattened(), problem.weight.as_flattened());
        for i in 0..3 * faces {
            hessian.push((i, i, weight[i]));
            right[i] -= weight[i] * (flat[i] - target[i]) + multipliers[i / 3];
            couple(tri + i / 3, i, 1.0);
            right[tri + i / 3] -= flat[i];
        }
        right[tri..plan].iter_mut().for_each(|r| *r += PI);
        for (v, wheel) in wheels.iter().enumerate() {
            let (lambda_plan, lambda_len) = (multipliers[plan - tri + v], multipliers[len - tri + v]);
            right[plan + v] += 2.0 * PI;
            for &[_, _, at] in wheel {
                couple(plan + v, at, 1.0);
                right[at] -= lambda_plan;
                right[plan + v] -= flat[at];
            }
            for (side, sign) in [(0, 1.0), (1, -1.0)] {
                let product: f64 = sign * wheel.iter().map(|w| flat[w[side]].sin()).product::<f64>();
                let cot = |w: &[usize; 3]| 1.0 / flat[w[side]].tan();
                right[len + v] -= product;
                for (a, w) in wheel.iter().enumerate() {
                    couple(len + v, w[side], product * cot(w));
                    right[w[side]] -= lambda_len * product * cot(w);
                    hessian.push((w[side], w[side], -lambda_len * product));
                    for x in &wheel[..a] {
                        let mixed = lambda_len * product * cot(w) * cot(x);
                        hessian.push((w[side], x[side], mixed));
                        hessian.push((x[side], w[side], mixed));
                    }
                }
            }
        }
        entries.extend(hessian.into_iter().map(|(i, j, h)| Triplet::new(i, j, h)));
        let solve_error = |what: String| Error::Solve { method: "abf", what };
        let matrix = SparseColMat::<usize, f64>::try_new_from_triplets(unknowns, unknowns, &entries)
            .map_err(|e| solve_error(format!("the system of {unknowns} unknowns cannot be built: {e:?}")))?;
        // The bytes of a parallel factorization depend on the number of threads.
        faer::set_global_parallelism(faer::Par::Seq);
        let factor =
            matrix.sp_lu().map_err(|e| solve_error(format!("the system of {unknowns} unknowns is singular: {e:?}")))?;
        let solution = factor.solve(faer::Mat::from_fn(unknowns, 1, |i, _| right[i]));
        let step: Vec<[f64; 3]> = (0..faces).map(|t| std::array::from_fn(|k| solution[(3 * t + k, 0)])).collect();
        if step.iter().flatten().any(|d| !d.is_finite()) {
            return Err(solve_error(format!("the system of {unknowns} unknowns is singular to rounding")));
        }
        let share = problem.longest_step(&angles, &step);
        if share < 1.0 {
            *summary.figures.entry("shortened_steps".to_owned()).or_default() += 1.0;
        }
        let mut largest = 0.0f64;
        for (a, d) in angles.iter_mut().flatten().zip(step.iter().flatten()) {
            *a += share * d;
            largest = largest.max((share * d).abs());
        }
        multipliers.iter_mut().enumerate().for_each(|(i, m)| *m += share * solution[(tri + i, 0)]);
        let misfit = problem.misfit(&angles, &problem.residuals(&angles));
        summary.iterations += 1;
        summary.residual = Some(misfit.largest());
        summary.figures.insert("largest_angle_step".to_owned(), largest);
        summary.converged = misfit.largest() <= settings.tolerance && largest <= 1000.0 * settings.tolerance;
    }
    summary.energy = Some(problem.energy(&angles));
    stopping::warn_of_misfit("abf", settings.tolerance, summary);
    Ok(angles)
}

#[cfg(test)]
mod tests {
    use super::super::{abf_plus_plus, closed_form};
    use super::*;

    #[test]
    fn developable_surfaces_keep_their_angles() {
        let known = closed_form::half_cylinder();
        let (_, summary) = flatten(&known.strip, None, &Settings::default()).unwrap();
        assert!(summary.converged && summary.energy.unwrap() < 1e-12, "{summary:?}");
    }

    #[test]
    fn full_and_reduced_newton_reach_the_same_angles() {
        let known = closed_form::rough(16, 16);
        let (_, full) = flatten(&known.strip, None, &Settings { tolerance: 1e-10, ..Settings::default() }).unwrap();
        let settings = abf_plus_plus::Settings { tolerance: 1e-10, max_iterations: 100 };
        let (_, reduced) = abf_plus_plus::flatten(&known.strip, None, &settings).unwrap();
        assert!(full.converged && reduced.converged, "{full:?} {reduced:?}");
        let (a, b) = (full.energy.unwrap(), reduced.energy.unwrap());
        assert!(a > 1e-3 && (a / b - 1.0).abs() < 1e-6, "{a} {b}");
    }

    #[test]
    fn large_meshes_are_refused() {
        let known = closed_form::prism();
        let settings = Settings { max_faces: 10, ..Settings::default() };
        assert!(flatten(&known.strip, None, &settings).unwrap_err().to_string().contains("abf++"));
    }
}
