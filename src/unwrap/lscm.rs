//! Least squares conformal maps: angles are kept as well as one sparse solve can.
//!
//! Use it for a quick map that keeps angles, or as the start of another method. Do not measure lengths on it: conformal
//! maps trade length for angle.
//!
//! References: B. Lévy, S. Petitjean, N. Ray, J. Maillot, "Least Squares Conformal Maps for Automatic Texture Atlas
//! Generation", ACM Transactions on Graphics 21(3), 2002, doi:10.1145/566654.566590 (pinned form);
//! P. Mullen, Y. Tong, P. Alliez, M. Desbrun, "Spectral Conformal Parameterization", Computer Graphics Forum 27(5), 2008,
//! doi:10.1111/j.1467-8659.2008.01289.x (spectral form).
//!
//! | symbol | meaning |
//! |---|---|
//! | `E_C`, `M` | conformal energy, `E_C = 1/2 z^* M z` with `z = u + i v` (`L_C` in Mullen et al.); see `conformal` |
//! | `B` | identity on boundary vertices, zero inside |
//! | `sigma` | shift: `M + sigma B` is what is factored by the spectral and the even form |
//! | `R_t` | rotation of face `t`, closest to its Jacobian |
//!
//! All three forms minimize the same energy; they differ in what stops the map from shrinking to a point, and that
//! decides how the scale drifts along a long tunnel. A surface with relief cannot be mapped conformally triangle by
//! triangle, so `E_C` is about `eps * integral |f'|^2` with the local scale `|f'|` and a small `eps`:
//! * `pinned`: two boundary vertices are held. The cheapest way to keep two *points* apart is to stretch the
//!   surroundings of the points, so the scale has two peaks, and any amount of scale may be traded for a little angle.
//! * `spectral`: `z^* B z = 1`, no pins. The scale of a strip is largest in the middle and falls off to the portals.
//! * `even` (default, ours): no pins; instead each triangle is tied to a rotated copy of itself,
//!   `E_C + tie * sum_t area_t |J_t - R_t|^2 / 2`, so weakly (`tie` = 0.01) that angles hardly notice, but more than
//!   `eps`, so that the scale has no reason to drift. `R_t` comes from the guide, or from the pinned solution, and from
//!   the previous round afterwards; all rounds share one factorization. On a rough tunnel of 8 m x 41 m (100 000
//!   triangles) the map's area ratio lies between 0.92 and 1.08 for 90 % of the surface where two pins give 0.32 to 2.23,
//!   and angles are better too, because in the pinned map the shrunken parts carry no weight.
//!
//! Guarantees: an isometry on developable surfaces; motion, scale and numbering of the input do not matter beyond
//! rounding. Very obtuse triangles can flip in the solve; they are unfolded afterwards (`unfold`) and counted. The result
//! is scaled to the area of the surface.
//! Departures: `M` is assembled as Laplacian minus area, which is the same energy as Lévy's rows without forming
//! `A^T A`; the shift (1e-10 of the mean diagonal of `M`, boundary vertices only) makes it definite, and the load of the
//! even form makes up for it.
//! Cost: one complex Cholesky factorization, one unknown a vertex, then one solve a round.

use super::conformal::{ConformalForm, ShiftedForm, far_pair, used_vertices};
use super::finish::finish;
use super::guide::Guide;
use super::rigid_fit::{chart_area, closest_rotations, conformal_energy, rotation_load};
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::numeric::{Vec2, sparse};
use crate::warning::Warning;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Shift of the spectral and even forms as a share of the mean diagonal entry. Far below any conformal energy of a
/// measured surface, far above the rounding of a factorization.
const SHIFT: f64 = 1e-10;

/// The spectral rounds stop when no vertex moves by more than this share of the map's extent.
const STILL: f64 = 1e-6;

/// How a least squares conformal map is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// What fixes the scale: `even` (default), `pinned` or `spectral`.
    pub form: Form,
    /// Weight of the even form's tie of each triangle to its own size, against the conformal energy. Default 0.01.
    pub tie: f64,
    /// Rounds of the even form (default 2 with an axis, 10 without) and at most of the spectral form (default 50).
    /// The pinned form has none.
    pub rounds: Option<usize>,
    /// The two vertices that the pinned form holds, as numbered in the mesh. Two boundary vertices far from each other
    /// when not given.
    pub pins: Option<[u32; 2]>,
}

/// What keeps the map from shrinking to a point.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Form {
    /// Each triangle is weakly tied to its own size.
    #[default]
    Even,
    /// Two far boundary vertices are held (Lévy et al. 2002).
    Pinned,
    /// The smallest eigenvector of the energy against the boundary (Mullen et al. 2008).
    Spectral,
}

impl Default for Settings {
    fn default() -> Self {
        Self { form: Form::Even, tie: 0.01, rounds: None, pins: None }
    }
}

/// Flattens a strip conformally. The guide, if there is one, gives the even form its first rotations.
///
/// # Errors
/// [`Error::Solve`] when the system cannot be solved, [`Error::Setting`] for zero rounds or a tie that is not positive.
pub fn flatten(strip: &Strip, guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    if settings.rounds == Some(0) {
        return Err(Error::Setting { key: "lscm.rounds", value: 0.0, must: "1 or more" });
    }
    if !(settings.tie > 0.0 && settings.tie.is_finite()) {
        return Err(Error::Setting { key: "lscm.tie", value: settings.tie, must: "more than 0" });
    }
    let faces = strip.mesh().faces();
    let shapes = Shapes::of(strip.mesh());
    let mut summary = SolveSummary::direct();
    // Scaling the Dirichlet part is all that a tie adds to the matrix.
    let tied_form = |tie: f64| {
        ConformalForm::new(strip, |f| shapes.shapes[f].cotangents().map(|c| c * (1.0 + tie))).map_err(solve_error)
    };
    let pins = pins(strip, settings)?;
    let pinned = || tied_form(0.0)?.solve_pinned(pins).map_err(solve_error);
    let mut uv = match settings.form {
        Form::Pinned => {
            let (uv, residual) = pinned()?;
            summary.figures.insert("first_pin".to_owned(), pins[0].0.into());
            summary.figures.insert("second_pin".to_owned(), pins[1].0.into());
            summary.residual = Some(residual);
            uv
        }
        Form::Even => {
            let start = guide.map_or_else(|| pinned().map(|(uv, _)| uv), |g| Ok(g.uv().to_vec()))?;
            let shifted = shift(tied_form(settings.tie)?, &mut summary)?;
            let rounds = settings.rounds.unwrap_or(if guide.is_some() { 2 } else { 10 });
            even_rounds(strip, &shapes, (&shifted, settings.tie), start, rounds, &mut summary)
        }
        Form::Spectral => spectral_rounds(strip, &shift(tied_form(0.0)?, &mut summary)?, settings, &mut summary),
    };
    let area = chart_area(faces, &uv);
    if !(area.is_finite() && area > 0.0) {
        return Err(Error::Solve {
            method: "lscm",
            what: format!("the map has no area ({area} m2 where the surface has {} m2)", shapes.area()),
        });
    }
    let scale = (shapes.area() / area).sqrt();
    uv.iter_mut().for_each(|p| *p *= scale);
    summary.energy = Some(conformal_energy(faces, &shapes.shapes, &uv));
    finish(strip, &shapes, &mut uv, &mut summary);
    Ok((uv, summary))
}

/// The two pins: given, or far apart on the boundary; on the u axis, as far apart as in space.
///
/// # Errors
/// [`Error::Setting`] for pins that are no two places of the mesh.
fn pins(strip: &Strip, settings: &Settings) -> Result<[(u32, Vec2); 2], Error> {
    let vertices = strip.mesh().vertices();
    let [a, b] = match settings.pins {
        None => far_pair(strip),
        Some(pins) if settings.form != Form::Pinned => {
            let must = "left out unless form = \"pinned\": the other forms hold no vertex";
            return Err(Error::Setting { key: "lscm.pins", value: pins[0].into(), must });
        }
        Some(pins) => {
            let used = used_vertices(vertices.len(), strip.mesh().faces());
            let bad = |v: &u32| !used.get(*v as usize).copied().unwrap_or(false);
            if let Some(&pin) = pins.iter().find(|v| bad(v)) {
                return Err(Error::Setting { key: "lscm.pins", value: pin.into(), must: "a vertex that has faces" });
            }
            pins
        }
    };
    let d = (vertices[a as usize] - vertices[b as usize]).norm();
    if !(d > 0.0) {
        return Err(Error::Setting { key: "lscm.pins", value: b.into(), must: "at another place than the first pin" });
    }
    Ok([(a, Vec2::zeros()), (b, Vec2::new(d, 0.0))])
}

/// Adds the shift, records it, and factors.
fn shift(form: ConformalForm, summary: &mut SolveSummary) -> Result<ShiftedForm, Error> {
    let sigma = SHIFT * form.mean_diagonal();
    summary.figures.insert("shift".to_owned(), sigma);
    form.factor_shifted(sigma).map_err(solve_error)
}

/// The pinned solution up to size and heading: a pull at two points, because `M` commutes with quarter turns.
fn pulled_apart(strip: &Strip, shifted: &ShiftedForm) -> Vec<Vec2> {
    let [a, b] = far_pair(strip);
    let mut load = vec![Vec2::zeros(); strip.mesh().vertices().len()];
    load[a as usize].x = -1.0;
    load[b as usize].x = 1.0;
    shifted.solve(&load).0
}

/// Rotations from the map so far, a solve with their load, and again.
fn even_rounds(
    strip: &Strip,
    shapes: &Shapes,
    (shifted, tie): (&ShiftedForm, f64),
    start: Vec<Vec2>,
    rounds: usize,
    summary: &mut SolveSummary,
) -> Vec<Vec2> {
    let (n, faces) = (strip.mesh().vertices().len(), strip.mesh().faces());
    let mut uv = start;
    for round in 1..=rounds {
        let mut load = rotation_load(n, faces, &shapes.shapes, &closest_rotations(faces, &shapes.shapes, &uv));
        // The rotations come with the weight of the tie, so that the map has its own size in every round.
        load.iter_mut().for_each(|l| *l *= tie);
        shifted.make_up_for_shift(&mut load, &uv);
        uv = shifted.solve_from(&uv, &load);
        if round == rounds {
            summary.residual = Some(shifted.residual(&uv, &load));
        }
    }
    summary.iterations = rounds;
    uv
}

/// Inverse iteration for the smallest eigenvalue of `M` against `B`, constants left out.
fn spectral_rounds(strip: &Strip, shifted: &ShiftedForm, settings: &Settings, summary: &mut SolveSummary) -> Vec<Vec2> {
    let boundary = shifted.form().boundary();
    let rounds = settings.rounds.unwrap_or(50);
    let mut uv = pulled_apart(strip, shifted);
    standardize(&mut uv, boundary, strip);
    summary.converged = false;
    let mut moved = f64::INFINITY;
    while summary.iterations < rounds && !summary.converged {
        let load: Vec<Vec2> = uv.iter().zip(boundary).map(|(p, &on)| if on { *p } else { Vec2::zeros() }).collect();
        let (mut next, residual) = shifted.solve(&load);
        standardize(&mut next, boundary, strip);
        moved = uv.iter().zip(&next).map(|(p, q)| (p - q).amax()).fold(0.0, f64::max);
        moved /= next.iter().map(|p| p.amax()).fold(0.0, f64::max);
        uv = next;
        summary.iterations += 1;
        summary.residual = Some(residual);
        summary.converged = moved <= STILL;
    }
    summary.figures.insert("last_move_share".to_owned(), moved);
    if !summary.converged {
        summary.warnings.push(Warning::new(
            "not-converged",
            format!(
                "the spectral form still moves by {moved:.1e} of the map after {rounds} rounds (wanted {STILL:e}); \
                 raise unwrap.lscm.rounds"
            ),
        ));
    }
    uv
}

/// Mean of the boundary at (0, 0), root mean square 1, the first far vertex on the negative u axis: what the load leaves
/// free is decided the same way in each round.
fn standardize(uv: &mut [Vec2], boundary: &[bool], strip: &Strip) {
    let rim = || boundary.iter().enumerate().filter(|(_, on)| **on).map(|(v, _)| v);
    let count = rim().count() as f64;
    let mean = rim().fold(Vec2::zeros(), |s, v| s + uv[v]) / count;
    let size = (rim().map(|v| (uv[v] - mean).norm_squared()).sum::<f64>() / count).sqrt();
    let heading = mean - uv[far_pair(strip)[0] as usize];
    let (c, s) = (heading.x / heading.norm(), heading.y / heading.norm());
    for p in uv {
        let q = (*p - mean) / size;
        *p = Vec2::new(c * q.x + s * q.y, c * q.y - s * q.x);
    }
}

fn solve_error(error: sparse::Error) -> Error {
    Error::Solve { method: "lscm", what: error.to_string() }
}

#[cfg(test)]
mod tests {
    use super::super::closed_form;
    use super::*;
    use crate::mesh::Mesh;
    use crate::numeric::Vec3;

    const FORMS: [Form; 3] = [Form::Even, Form::Pinned, Form::Spectral];

    fn settings(form: Form) -> Settings {
        Settings { form, ..Settings::default() }
    }

    /// Largest difference of edge lengths between map and surface, metres.
    fn worst_edge(strip: &Strip, uv: &[Vec2]) -> f64 {
        let v = strip.mesh().vertices();
        let edges = strip.mesh().faces().iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
        let worst = |(a, b): (u32, u32)| {
            let (a, b) = (a as usize, b as usize);
            ((v[a] - v[b]).norm() - (uv[a] - uv[b]).norm()).abs()
        };
        edges.map(worst).fold(0.0, f64::max)
    }

    /// `z = x y / 2` over a square, the way libigl's tests like it: 11 x 11 vertices, spacing 0.1.
    fn saddle() -> Strip {
        let at = |i: u32, j: u32| i * 11 + j;
        let vertices = (0..121)
            .map(|k| {
                let (x, y) = (f64::from(k / 11) / 10.0, f64::from(k % 11) / 10.0);
                Vec3::new(x, y, x * y / 2.0)
            })
            .collect();
        let faces = (0..10u32)
            .flat_map(|i| (0..10u32).map(move |j| (i, j)))
            .flat_map(|(i, j)| [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]])
            .collect();
        Strip::from_disk(Mesh::all_observed(vertices, faces).unwrap()).unwrap()
    }

    #[test]
    fn developable_surfaces_keep_every_length() {
        for known in closed_form::developable() {
            for form in FORMS {
                let (uv, summary) = flatten(&known.strip, None, &settings(form)).unwrap();
                let worst = worst_edge(&known.strip, &uv);
                assert!(worst < 1e-6, "{} {form:?}: {worst}", known.name);
                assert!(summary.converged && summary.warnings.is_empty(), "{:?}", summary.warnings);
            }
        }
    }

    #[test]
    fn a_hole_leaves_the_map_of_a_cylinder_alone() {
        let known = closed_form::half_cylinder();
        let mesh = known.strip.mesh();
        let kept = |f: &[u32; 3]| {
            let middle = f.iter().map(|&v| known.flat[v as usize]).sum::<Vec2>() / 3.0;
            (middle - Vec2::new(4.0, 1.0)).norm() > 1.2
        };
        let faces: Vec<[u32; 3]> = mesh.faces().iter().copied().filter(kept).collect();
        let strip = Strip::from_disk(Mesh::all_observed(mesh.vertices().to_vec(), faces).unwrap()).unwrap();
        assert_eq!(strip.hole_loops().len(), 1);
        for form in FORMS {
            let (uv, summary) = flatten(&strip, None, &settings(form)).unwrap();
            assert!(worst_edge(&strip, &uv) < 1e-6, "{form:?}");
            assert!(summary.figures["unused_vertices"] > 0.0);
        }
    }

    #[test]
    fn a_strip_four_hundred_times_as_long_as_wide_keeps_every_length() {
        let mesh = closed_form::grid(600, 8, 0.0, |along, around| {
            let angle = std::f64::consts::PI * (around - 0.5);
            Vec3::new(1200.0 * along, -angle.sin(), angle.cos())
        });
        let strip = Strip::from_disk(mesh).unwrap();
        for form in FORMS {
            let (uv, summary) = flatten(&strip, None, &settings(form)).unwrap();
            assert!(worst_edge(&strip, &uv) < 1e-4, "{form:?}: {}", worst_edge(&strip, &uv));
            assert_eq!(summary.figures["unfolded_faces"], 0.0);
        }
    }

    #[test]
    fn pinned_energy_agrees_with_an_independent_solver() {
        let strip = saddle();
        let (uv, summary) = flatten(&strip, None, &settings(Form::Pinned)).unwrap();
        // libigl 2.6.3 `lscm` with the same pins, scaled to the area of the surface.
        let reference = 4.014_400_320_355e-6;
        assert!((summary.energy.unwrap() / reference - 1.0).abs() < 1e-6, "{:e}", summary.energy.unwrap());
        assert!((chart_area(strip.mesh().faces(), &uv) - strip.mesh().area()).abs() < 1e-12);
    }

    #[test]
    fn the_even_form_does_not_drift() {
        let known = closed_form::rough(60, 60);
        let guide = Guide::of_strip(&known.strip, &known.axis, &Default::default()).unwrap();
        let spread = |uv: &[Vec2]| {
            let mesh = known.strip.mesh();
            let shapes = Shapes::of(mesh);
            let mut ratios: Vec<f64> = mesh
                .faces()
                .iter()
                .zip(&shapes.shapes)
                .map(|(c, s)| s.jacobian(c.map(|v| uv[v as usize])).determinant())
                .collect();
            let quantile = |r: &mut Vec<f64>, q| crate::numeric::statistics::quantile(r, q).unwrap();
            quantile(&mut ratios, 0.95) - quantile(&mut ratios, 0.05)
        };
        let pinned = spread(&flatten(&known.strip, None, &settings(Form::Pinned)).unwrap().0);
        let even = spread(&flatten(&known.strip, None, &settings(Form::Even)).unwrap().0);
        let guided = spread(&flatten(&known.strip, Some(&guide), &settings(Form::Even)).unwrap().0);
        assert!(even < 0.5 * pinned && guided < 0.5 * pinned, "{pinned} {even} {guided}");
    }

    #[test]
    fn slivers_and_doubled_vertices_are_repaired_and_counted() {
        let known = closed_form::half_cylinder();
        let mut vertices = known.strip.mesh().vertices().to_vec();
        let inner = 10 * 49 + 20;
        vertices[inner] = vertices[inner + 1];
        let mesh = Mesh::all_observed(vertices, known.strip.mesh().faces().to_vec()).unwrap();
        let strip = Strip::from_disk(mesh).unwrap();
        for form in FORMS {
            let (uv, summary) = flatten(&strip, None, &settings(form)).unwrap();
            assert!(uv.iter().all(|p| p.x.is_finite() && p.y.is_finite()));
            assert_eq!(summary.figures["repaired_faces"], 2.0);
            assert!(summary.warnings.iter().any(|w| w.code == "degenerate-faces"));
        }
    }
}
