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
//! equation with the cotangent Laplacian, which is factored once.
//!
//! Guarantees: the energy never rises; an isometry on developable surfaces with a start that is free of flips; the mean
//! of the map stays where the start had it. Flips left by the iteration are unfolded and counted.
//! Departures: the energy is summed over areas (`A_t |.|^2` is the paper's cotangent sum), the start is the section chart
//! where there is an axis and the pinned conformal map where there is none.
//! Cost: one Cholesky factorization of the number of vertices, then a pass over the faces and two solves an iteration.

use super::finish::finish;
use super::guide::Guide;
use super::poisson::Poisson;
use super::rigid_fit::{closest_rotations, rigid_energy, rotation_load};
use super::start::start;
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::numeric::Vec2;
use crate::numeric::sparse;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How an as-rigid-as-possible map is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Local/global iterations at most. Default 10.
    pub max_iterations: usize,
    /// The iterations stop when the energy falls by less than this share. Default 1e-5.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { max_iterations: 10, tolerance: 1e-5 }
    }
}

/// Flattens a strip as rigidly as possible, starting from the guide's section chart or a conformal map.
///
/// # Errors
/// [`Error::Solve`] when the system cannot be solved, [`Error::Setting`] for a negative tolerance.
pub fn flatten(strip: &Strip, guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    if !(settings.tolerance >= 0.0) {
        return Err(Error::Setting { key: "arap.tolerance", value: settings.tolerance, must: "0 or more" });
    }
    let solve_error = |e: sparse::Error| Error::Solve { method: "arap", what: e.to_string() };
    let (faces, n) = (strip.mesh().faces(), strip.mesh().vertices().len());
    let shapes = Shapes::of(strip.mesh());
    let mut summary = SolveSummary::default();
    let mut uv = start("arap", strip, guide, &shapes, &mut summary)?;

    let poisson = Poisson::new(faces, n, &shapes).map_err(solve_error)?;
    let mut energy = rigid_energy(faces, &shapes.shapes, &uv);
    summary.figures.insert("start_energy".to_owned(), energy);
    // Below this the energy is rounding: a developable surface is done.
    let rounding = 1e-20 * shapes.area();
    let mut fall = f64::INFINITY;
    while summary.iterations < settings.max_iterations && !summary.converged {
        let load = rotation_load(n, faces, &shapes.shapes, &closest_rotations(faces, &shapes.shapes, &uv));
        uv = poisson.solve(&load, &uv);
        let next = rigid_energy(faces, &shapes.shapes, &uv);
        fall = (energy - next) / energy.max(f64::MIN_POSITIVE);
        energy = next;
        summary.iterations += 1;
        summary.converged = fall <= settings.tolerance || energy <= rounding;
    }
    summary.energy = Some(energy);
    summary.residual = fall.is_finite().then_some(fall);
    finish(strip, &shapes, &mut uv, &mut summary);
    Ok((uv, summary))
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
