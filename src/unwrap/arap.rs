//! As-rigid-as-possible parameterization: every triangle wants to be a rotated copy of itself.
//!
//! Use it for maps on which lengths, areas and angles all have to be nearly right. It does not forbid flips, so use
//! `slim` where the surface is so rough that flips appear.
//!
//! Reference: L. Liu, L. Zhang, Y. Xu, C. Gotsman, S. J. Gortler, "A Local/Global Approach to Mesh Parameterization",
//! Computer Graphics Forum 27(5), 2008, doi:10.1111/j.1467-8659.2008.01290.x.
//!
//! | symbol | meaning |
//! |---|---|
//! | `J_t` | Jacobian of face `t`, surface to map |
//! | `L_t` | the auxiliary rotation of face `t` (`R` in the code) |
//! | `A_t` | area of face `t` |
//! | `E` | `sum_t A_t |J_t - L_t|^2`, square metres |
//!
//! Local step: `L_t` is the rotation closest to `J_t`. Global step: the map that fits the rotations best, a Poisson
//! equation with the cotangent Laplacian, which is factored once. A local and a global step together are a step of length
//! one against the gradient of `E`, measured by the Laplacian; the steps before bend it (L-BFGS, see `quasi_newton`), which
//! takes a third of the iterations to the same energy, because plain steps are slow to turn long stretches of tunnel.
//!
//! Guarantees: the energy never rises; an isometry on developable surfaces with a start that is free of flips; the mean
//! of the map stays where the start had it. Flips left by the iteration are unfolded and counted.
//! Departures: the acceleration (a step that would not lower the energy enough is shortened, then retried plainly); the
//! energy is summed over areas (`A_t |.|^2` is the paper's cotangent sum), the start is the section chart
//! where there is an axis and the pinned conformal map where there is none.
//! Cost: one Cholesky factorization of the number of vertices, then a pass over the faces and two solves an iteration.

use super::corner_sums::CornerSums;
use super::finish::finish;
use super::guide::Guide;
use super::poisson::Poisson;
use super::quasi_newton::{Memory, advance, dot};
use super::rigid_fit::{rigid_energy, rigid_gradient};
use super::start::start;
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary, stopping};
use crate::cut::Strip;
use crate::numeric::Vec2;
use crate::numeric::sparse;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How an as-rigid-as-possible map is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Local/global iterations at most. Default 20.
    pub max_iterations: usize,
    /// The iterations stop when the energy falls by less than this share twice in a row. Default 1e-3.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { max_iterations: 20, tolerance: 1e-3 }
    }
}

/// Armijo's constant: share of the promised descent that an accelerated step must keep.
const ARMIJO: f64 = 1e-4;
/// Halvings of an accelerated step before it is given up.
const HALVINGS: usize = 8;

/// Flattens a strip as rigidly as possible, starting from the guide's section chart or a conformal map.
///
/// # Errors
/// [`Error::Solve`] when the system cannot be solved, [`Error::Setting`] for a negative tolerance.
pub fn flatten(strip: &Strip, guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    stopping::not_negative("arap.tolerance", settings.tolerance)?;
    let solve_error = |e: sparse::Error| Error::Solve { method: "arap", what: e.to_string() };
    let (faces, n) = (strip.mesh().faces(), strip.mesh().vertices().len());
    let shapes = Shapes::of(strip.mesh());
    let mut summary = SolveSummary::default();
    let mut uv = start("arap", strip, guide, &shapes, &mut summary)?;

    let poisson = Poisson::new(faces, n, &shapes).map_err(solve_error)?;
    let corner_sums = CornerSums::new(n, faces);
    let mut energy = rigid_energy(faces, &shapes.shapes, &uv);
    summary.figures.insert("start_energy".to_owned(), energy);
    // Below this the energy is rounding: a developable surface is done.
    let rounding = 1e-20 * shapes.area();
    let mut memory = Memory::default();
    let mut gradient = rigid_gradient(&corner_sums, faces, &shapes.shapes, &uv);
    let mut calm = 0;
    while summary.iterations < settings.max_iterations && !summary.converged {
        // Without memory this is the plain global step.
        let direction = memory.direction(&gradient, |g| poisson.correction(g));
        let slope = dot(&gradient, &direction);
        let moved = descend(faces, &shapes, &uv, energy, &direction, slope);
        summary.iterations += 1;
        let Some((next, after)) = moved else {
            // The memory misled; without it, only rounding keeps a global step from lowering the energy.
            summary.converged = !memory.forget();
            continue;
        };
        let next_gradient = rigid_gradient(&corner_sums, faces, &shapes.shapes, &next);
        memory.remember([&uv, &next], [&gradient, &next_gradient]);
        let fall = (energy - after) / energy.max(f64::MIN_POSITIVE);
        (uv, energy, gradient) = (next, after, next_gradient);
        summary.residual = Some(fall);
        calm = if fall <= settings.tolerance || energy <= rounding { calm + 1 } else { 0 };
        summary.converged = calm == 2 || energy <= rounding;
    }
    summary.energy = Some(energy);
    finish(strip, &shapes, &mut uv, &mut summary);
    Ok((uv, summary))
}

/// The whole step where it lowers the energy enough, else a shortened one.
fn descend(
    faces: &[[u32; 3]],
    shapes: &Shapes,
    uv: &[Vec2],
    energy: f64,
    direction: &[Vec2],
    slope: f64,
) -> Option<(Vec<Vec2>, f64)> {
    if slope >= 0.0 {
        return None;
    }
    let lengths = std::iter::successors(Some(1.0), |length| Some(length / 2.0));
    lengths.take(HALVINGS).find_map(|length| {
        let moved = advance(uv, direction, length);
        let after = rigid_energy(faces, &shapes.shapes, &moved);
        (after <= energy + ARMIJO * length * slope).then_some((moved, after))
    })
}

#[cfg(test)]
mod tests {
    use super::super::closed_form;
    use super::*;
    use crate::mesh::Mesh;
    use crate::numeric::Vec3;

    #[test]
    fn developable_surfaces_become_isometries() {
        for known in closed_form::developable() {
            let (_, summary) = flatten(&known.strip, None, &Settings::default()).unwrap();
            assert!(summary.converged && summary.energy.unwrap() < 1e-12, "{} {summary:?}", known.name);
        }
    }

    #[test]
    fn energy_agrees_with_an_independent_solver() {
        // z = x y / 2 over the unit square, 11 x 11 vertices; libigl 2.6.3 `ARAPData` to convergence.
        let at = |i: u32, j: u32| i * 11 + j;
        let vertices: Vec<Vec3> = (0..121)
            .map(|k| {
                let (x, y) = (f64::from(k / 11) / 10.0, f64::from(k % 11) / 10.0);
                Vec3::new(x, y, x * y / 2.0)
            })
            .collect();
        let faces = (0..10u32)
            .flat_map(|i| (0..10u32).map(move |j| (i, j)))
            .flat_map(|(i, j)| [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]])
            .collect();
        let strip = Strip::from_disk(Mesh::all_observed(vertices, faces).unwrap()).unwrap();
        let settings = Settings { max_iterations: 2000, tolerance: 1e-13 };
        let (_, summary) = flatten(&strip, None, &settings).unwrap();
        assert!((summary.energy.unwrap() / 2.205_667_431_466e-5 - 1.0).abs() < 1e-6, "{summary:?}");
    }

    #[test]
    fn the_energy_never_rises() {
        let known = closed_form::rough(40, 40);
        let mut last = f64::INFINITY;
        for max_iterations in 0..6 {
            let settings = Settings { max_iterations, tolerance: 0.0 };
            let energy = flatten(&known.strip, None, &settings).unwrap().1.energy.unwrap();
            assert!(energy <= last, "{max_iterations}: {energy} after {last}");
            last = energy;
        }
    }
}
