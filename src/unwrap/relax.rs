//! Relaxed section chart: as isometric as possible while chainage stays a ruler. The default method.
//!
//! Use it for the map people work on: it has nearly the distortion of the best unconstrained maps, but the tunnel does
//! not curl over the page. When the map must be an exact chainage ruler use `section` (or `straightness` 1); when only
//! distortion counts use `straightness` 0, `arap` or `slim`.
//!
//! Minimises over (u, v) of the vertices, starting from the section chart,
//!
//! ```text
//! E = sum_f A_f [ (|J|^2 + |J^-1|^2) / 4 - 1 ]              isometry (symmetric Dirichlet)
//!   + k g_c / l^2  sum_v a_v (u_v - s_v)^2                  chainage tie
//!   + k g_b        sum_f A_f (J t)_v^2                      axis lines stay horizontal
//! k = straightness / (1 - straightness)
//! ```
//!
//! | symbol | meaning |
//! |---|---|
//! | J, A_f | Jacobian surface -> chart of face f, its area |
//! | s_v, a_v | chainage of vertex v, area around it |
//! | t | axis direction projected on the face |
//! | l | half the mean girth: errors are told as a share of the map's half height |
//! | g_c, g_b | fixed weights, chosen so that `straightness` 0.5 costs little distortion on a gentle bend |
//!
//! The isometry term is the energy of J. Smith and S. Schaefer, "Bijective parameterization with free boundaries", ACM
//! TOG 34(4), 2015, doi:10.1145/2766947. It is minimised by quasi-Newton steps (L-BFGS) that start from the exact Hessian
//! of the rigid (ARAP) energy plus ties: two sparse Cholesky factorizations, one for u and one for v, made once and used
//! in every step (T. Liu, S. Bouaziz, L. Kavan, "Quasi-Newton methods for real-time simulation of hyperelastic
//! materials", ACM TOG 36(3), 2017, doi:10.1145/2990496). Every step stops short of the first face to flip. Because
//! the preconditioner is the surface's own Laplacian, the number of steps does not grow with the mesh, so no coarse
//! solve is needed: a million faces relax in one go.
//!
//! Faces that are flipped at the start (the section chart could not be unfolded: caves, sharp bends) are pulled towards
//! rigidity without the barrier, and the few that are flipped at the end are unfolded, `unfurl`ed, and all is relaxed
//! again. Where unfolding fails it starts anew from an embedding in a rectangle, which has no flips.
//!
//! Guarantees: no flips below `straightness` 1, unless a warning tells that no start without flips was found; there, u is
//! exactly the chainage. Isometric on prisms; same bytes on any
//! number of threads.
//! Cost: two factorizations (about 1 s a million faces together) and 0.2 s a step and million faces.

use super::corner_sums::CornerSums;
use super::finish::finish;
use super::flip_free_step::largest_flip_free_step;
use super::guide::Guide;
use super::quasi_newton::{Memory, advance, chunked_sum, dot};
use super::rigid_fit::{rigid_density, rigid_slope};
use super::start::start_without_flips;
use super::triangle_shapes::{Shape, Shapes};
use super::unfurl::unfurl;
use super::{Error, SolveSummary, distortion};
use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::numeric::dissection::nested_dissection;
use crate::numeric::sparse::{Analysis, Cholesky, Pattern};
use crate::numeric::{Mat2, Vec2};
use crate::warning::Warning;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `relax`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// From 0 (as isometric as possible, the tunnel may curl) to 1 (u is exactly the chainage). Default 0.5.
    pub straightness: f64,
    /// Most quasi-Newton steps; caves need more than tunnels. Default 200.
    pub max_iterations: usize,
    /// Done when a step lowers the energy by less than this share of it. Default 0.0005.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { straightness: 0.5, max_iterations: 200, tolerance: 5e-4 }
    }
}

/// Weight of the chainage tie at `straightness` 0.5.
const CHAINAGE_TIE: f64 = 0.1;
/// Weight of the horizontal tie at `straightness` 0.5.
const BEARING_TIE: f64 = 0.25;
/// At `straightness` 0 this tie alone says where on the page the map lies.
const PLACE_TIE: f64 = 1e-7;
/// The horizontal tie grows no further beyond this `straightness`: rough rock has no straight axis lines.
const STRAIGHTEST: f64 = 0.95;
/// Steps that minimise the rigid energy first: it has no barrier, so needles in the start do not slow it down.
const RIGID_STEPS: usize = 3;
/// Share of the way to the first flip that a step may go.
const SAFETY: f64 = 0.8;
/// Armijo's constant: share of the promised descent that a step must keep.
const ARMIJO: f64 = 1e-4;
/// Relaxes the section chart; see the module.
///
/// # Errors
/// [`Error::NeedsAxis`], [`Error::Setting`], and [`Error::Solve`] when the surface has no solvable Laplacian.
pub fn flatten(strip: &Strip, guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    let guide = guide.ok_or(Error::NeedsAxis { method: "relax" })?;
    if !(0.0..=1.0).contains(&settings.straightness) {
        return Err(Error::Setting { key: "relax.straightness", value: settings.straightness, must: "from 0 to 1" });
    }
    if !(settings.tolerance > 0.0 && settings.tolerance < 1.0) {
        return Err(Error::Setting { key: "relax.tolerance", value: settings.tolerance, must: "between 0 and 1" });
    }
    let mut summary = SolveSummary::default();
    let shapes = Shapes::of(strip.mesh());
    let mut uv = descend(strip, guide, &shapes, settings, guide.uv().to_vec(), &mut summary)?;
    if settings.straightness >= 1.0 {
        summary.figures.insert("repaired_faces".to_owned(), shapes.repaired.len() as f64);
        summary.warnings.extend(shapes.warning());
        return Ok((uv, summary));
    }
    let mesh = strip.mesh();
    finish(strip, &shapes, &mut uv, &mut summary);
    if summary.figures["faces_without_barrier"] == 0.0 {
        return Ok((uv, summary));
    }
    let mut again = SolveSummary::default();
    let start = if distortion::flipped_faces(mesh, &uv).0 > 0 {
        start_without_flips("relax", strip, Some(guide), &shapes, &mut again)
    } else {
        // Patches that were laid anew are squeezed.
        let mut start = uv.clone();
        unfurl(mesh, &shapes, &mut start)
            .map(|unfurled| {
                again.figures.insert("unfurling_rounds".to_owned(), unfurled.rounds as f64);
                start
            })
            .map_err(|e| Error::Solve { method: "relax", what: e.to_string() })
    };
    let start = match start {
        Ok(start) => start,
        Err(why) => {
            summary
                .warnings
                .push(Warning::new("not-relaxed-again", format!("{why}; the map is that of the first solve")));
            return Ok((uv, summary));
        }
    };
    let mut relaxed = descend(strip, guide, &shapes, settings, start.clone(), &mut again)?;
    finish(strip, &shapes, &mut relaxed, &mut again);
    let flipped = distortion::flipped_faces(mesh, &relaxed).0;
    if flipped > 0 {
        // Needles have no barrier; better squeezed than flipped.
        again.converged = false;
        again.warnings.push(Warning::new(
            "start-kept",
            format!(
                "the solve flipped {flipped} faces for good, so the map is its start: free of flips, but not relaxed"
            ),
        ));
        relaxed = start;
    }
    Ok((relaxed, again))
}

/// The quasi-Newton steps from a start.
fn descend(
    strip: &Strip,
    guide: &Guide,
    shapes: &Shapes,
    settings: &Settings,
    mut uv: Vec<Vec2>,
    summary: &mut SolveSummary,
) -> Result<Vec<Vec2>, Error> {
    let failed = |e: crate::numeric::sparse::Error| Error::Solve { method: "relax", what: e.to_string() };
    let mesh = strip.mesh();
    let (problem, pattern) = rayon::join(
        || Problem::new(mesh, guide, shapes, settings, &uv),
        || Pattern::of_vertices(mesh.vertices().len(), mesh.faces()),
    );
    let step = pattern.and_then(|pattern| Preconditioner::new(&problem, &pattern, &uv)).map_err(failed)?;

    for _ in 0..RIGID_STEPS.min(settings.max_iterations) {
        let (gradient, before) = problem.rigid_gradient_and_energy(&uv);
        let direction = step.apply(&gradient, -1.0);
        let length = problem.longest_step(&uv, &direction).min(1.0);
        let moved = advance(&uv, &direction, length);
        let after = problem.rigid_gradient_and_energy(&moved).1;
        if after >= before {
            break;
        }
        uv = moved;
        summary.iterations += 1;
        if before - after <= settings.tolerance * after {
            break;
        }
    }

    let mut memory = Memory::default();
    let mut energy = problem.energy(&uv);
    let mut gradient = problem.gradient(&uv);
    let mut calm = 0;
    while summary.iterations < settings.max_iterations.max(1) {
        let mut direction = memory.direction(&gradient, |g| step.apply(g, 1.0));
        let mut slope = dot(&gradient, &direction);
        if slope >= 0.0 {
            // The memory is misleading; the preconditioned gradient always descends.
            memory.forget();
            direction = step.apply(&gradient, -1.0);
            slope = dot(&gradient, &direction);
        }
        let mut length = problem.longest_step(&uv, &direction).min(1.0);
        let (mut moved, mut after) = (Vec::new(), f64::INFINITY);
        for _ in 0..20 {
            moved = advance(&uv, &direction, length);
            after = problem.energy(&moved);
            if after <= energy + ARMIJO * length * slope {
                break;
            }
            length *= 0.5;
            after = f64::INFINITY;
        }
        if !after.is_finite() {
            // No descent at working precision: this is the minimum.
            summary.converged = true;
            break;
        }
        let next_gradient = problem.gradient(&moved);
        memory.remember([&uv, &moved], [&gradient, &next_gradient]);
        let gain = (energy - after) / after.abs().max(f64::MIN_POSITIVE);
        (uv, energy, gradient) = (moved, after, next_gradient);
        summary.iterations += 1;
        summary.residual = Some(gain);
        calm = if gain < settings.tolerance || energy <= problem.negligible { calm + 1 } else { 0 };
        if calm == 2 {
            summary.converged = true;
            break;
        }
    }
    summary.energy = Some(energy);
    summary.figures.insert("straightness".to_owned(), settings.straightness);
    summary.figures.insert("faces_without_barrier".to_owned(), problem.loose_count as f64);
    Ok(uv)
}

/// What is minimised.
struct Problem<'a> {
    faces: &'a [[u32; 3]],
    shapes: &'a [Shape],
    /// Axis direction in the plane of each face.
    along: Vec<[f64; 2]>,
    chainage: Vec<f64>,
    /// Chainage tie of each vertex: k g_c a_v / l^2.
    tie: Vec<f64>,
    bearing: f64,
    /// u does not move (straightness 1).
    ruler: bool,
    /// Faces that start flipped: rigid energy instead of the barrier.
    loose: Vec<bool>,
    loose_count: usize,
    corner_sums: CornerSums,
    /// Energy below which everything is rounding.
    negligible: f64,
}

impl<'a> Problem<'a> {
    fn new(mesh: &'a Mesh, guide: &Guide, shapes: &'a Shapes, settings: &Settings, uv: &[Vec2]) -> Self {
        let faces = mesh.faces();
        let ruler = settings.straightness >= 1.0;
        let ratio = |straightness: f64| straightness / (1.0 - straightness);
        let half_girth = guide.summary().section.mean_girth_m / 2.0;
        let tie = ratio(settings.straightness.min(1.0 - 1e-6)) * CHAINAGE_TIE + PLACE_TIE;
        let areas = super::registration::vertex_areas(mesh);
        let along = (0..faces.len() as u32)
            .into_par_iter()
            .map(|f| {
                let [a, b, c] = mesh.corners(f);
                let chainage = faces[f as usize].iter().map(|&v| guide.coordinates()[v as usize].chainage);
                let forward = guide.forward(chainage.sum::<f64>() / 3.0);
                let x = (b - a).try_normalize(0.0).unwrap_or_else(crate::numeric::Vec3::zeros);
                let across = (c - a) - x * x.dot(&(c - a));
                let y = across.try_normalize(0.0).unwrap_or_else(crate::numeric::Vec3::zeros);
                [forward.dot(&x), forward.dot(&y)]
            })
            .collect();
        let loose: Vec<bool> = faces
            .par_iter()
            .zip(&shapes.shapes)
            .map(|(corners, shape)| {
                let p = corners.map(|v| uv[v as usize]);
                // A needle on the map would put the barrier at the edge of what numbers can hold.
                distortion::orientation(p) <= 0.0 || shape.jacobian(p).determinant() < 1e-6
            })
            .collect();
        Self {
            faces,
            shapes: &shapes.shapes,
            along,
            chainage: guide.coordinates().iter().map(|c| c.chainage).collect(),
            tie: areas.iter().map(|a| a * tie / (half_girth * half_girth)).collect(),
            bearing: BEARING_TIE * ratio(settings.straightness.min(STRAIGHTEST)),
            ruler,
            loose_count: loose.iter().filter(|&&l| l).count(),
            loose,
            corner_sums: CornerSums::new(mesh.vertices().len(), faces),
            negligible: 1e-14 * mesh.area(),
        }
    }

    fn jacobian(&self, face: usize, uv: &[Vec2]) -> Mat2 {
        self.shapes[face].jacobian(self.faces[face].map(|v| uv[v as usize]))
    }

    /// Energy of the ties.
    fn tie_energy(&self, uv: &[Vec2]) -> f64 {
        chunked_sum(uv.len(), |v| self.tie[v] * (uv[v].x - self.chainage[v]).powi(2))
    }

    /// Energy; infinite when a face that must not flip has.
    fn energy(&self, uv: &[Vec2]) -> f64 {
        let isometry = chunked_sum(self.faces.len(), |f| {
            let j = self.jacobian(f, uv);
            let area = self.shapes[f].area();
            let [tx, ty] = self.along[f];
            let rise = j.m21 * tx + j.m22 * ty;
            let density = if self.loose[f] {
                rigid_density(&j)
            } else {
                let d = j.determinant();
                // s^2 + s^-2 - 2 = (s - 1/s)^2 for both singular values, without cancelling.
                if d <= 0.0 { f64::INFINITY } else { isometric_density(&j, d) }
            };
            area * (density + self.bearing * rise * rise)
        });
        isometry + self.tie_energy(uv)
    }

    fn gradient(&self, uv: &[Vec2]) -> Vec<Vec2> {
        self.gather(uv, |f, j| {
            if self.loose[f] {
                return rigid_slope(j);
            }
            let d = j.determinant();
            let square = j.norm_squared();
            let cofactor = Mat2::new(j.m22, -j.m21, -j.m12, j.m11);
            (j * (1.0 + 1.0 / (d * d)) - cofactor * (square / (d * d * d))) / 2.0
        })
    }

    fn rigid_gradient_and_energy(&self, uv: &[Vec2]) -> (Vec<Vec2>, f64) {
        let gradient = self.gather(uv, |_, j| rigid_slope(j));
        let energy = chunked_sum(self.faces.len(), |f| {
            let j = self.jacobian(f, uv);
            let [tx, ty] = self.along[f];
            let rise = j.m21 * tx + j.m22 * ty;
            self.shapes[f].area() * (rigid_density(&j) + self.bearing * rise * rise)
        });
        (gradient, energy + self.tie_energy(uv))
    }

    /// Gradient with respect to the vertices from the derivative of the density with respect to J.
    fn gather(&self, uv: &[Vec2], slope: impl Fn(usize, &Mat2) -> Mat2 + Sync) -> Vec<Vec2> {
        let tie = |v: usize| Vec2::new(2.0 * self.tie[v] * (uv[v].x - self.chainage[v]), 0.0);
        let mut gradient = self.corner_sums.gather(tie, |f| {
            let j = self.jacobian(f, uv);
            let shape = &self.shapes[f];
            let [tx, ty] = self.along[f];
            let rise = j.m21 * tx + j.m22 * ty;
            let mut s = slope(f, &j);
            s.m21 += 2.0 * self.bearing * rise * tx;
            s.m22 += 2.0 * self.bearing * rise * ty;
            let s = s * shape.area();
            let third = s.column(1) / shape.y;
            let second = s.column(0) / shape.base - third * (shape.x / shape.base);
            [-(second + third), second, third]
        });
        if self.ruler {
            gradient.iter_mut().for_each(|g| g.x = 0.0);
        }
        gradient
    }

    /// How far one can go along `direction` before the first face flips, times [`SAFETY`].
    fn longest_step(&self, uv: &[Vec2], direction: &[Vec2]) -> f64 {
        SAFETY * largest_flip_free_step(self.faces, uv, direction, |f| !self.loose[f])
    }
}

/// ((s1 - 1/s1)^2 + (s2 - 1/s2)^2) / 4, which is the symmetric Dirichlet density less its minimum.
fn isometric_density(j: &Mat2, determinant: f64) -> f64 {
    // |J|^2 - 2 d = (s1 - s2)^2 and d - 1/d vanish without cancelling near an isometry.
    let skew = (j.m11 - j.m22).powi(2) + (j.m12 + j.m21).powi(2);
    let swelling = determinant - 1.0;
    (skew * (1.0 + 1.0 / (determinant * determinant)) + 2.0 * swelling * swelling / determinant) / 4.0
}

/// The Hessian of the rigid energy and the ties, factored: one system for u, one for v.
struct Preconditioner {
    u: Option<Cholesky>,
    v: Cholesky,
}

impl Preconditioner {
    /// `uv` is any chart of the mesh: it tells which vertices are neighbours.
    fn new(problem: &Problem, pattern: &Pattern, uv: &[Vec2]) -> Result<Self, crate::numeric::sparse::Error> {
        let (analysis, (u, v)) = rayon::join(
            || Analysis::in_order(pattern, &nested_dissection(pattern, uv)),
            || Self::values(problem, pattern),
        );
        let analysis = analysis?;
        let (u, v) = rayon::join(
            || if problem.ruler { Ok(None) } else { Cholesky::new(pattern, &analysis, &u).map(Some) },
            || Cholesky::new(pattern, &analysis, &v),
        );
        Ok(Self { u: u?, v: v? })
    }

    /// The entries of both systems.
    fn values(problem: &Problem, pattern: &Pattern) -> (Vec<f64>, Vec<f64>) {
        let slots = pattern.face_slots(problem.faces);
        let mut u = vec![0.0; pattern.entries()];
        let mut v = vec![0.0; pattern.entries()];
        for (f, slots) in slots.iter().enumerate() {
            let shape = &problem.shapes[f];
            let [tx, ty] = problem.along[f];
            let rows = |w1: f64, w2: f64| {
                // Derivative along the direction (w1, w2) of the face as weights of its corners.
                let (second, third) = (w1 / shape.base - w2 * shape.x / (shape.base * shape.y), w2 / shape.y);
                [-(second + third), second, third]
            };
            let (gx, gy, gt) = (rows(1.0, 0.0), rows(0.0, 1.0), rows(tx, ty));
            let pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)];
            for (&slot, (i, j)) in slots.iter().zip(pairs) {
                let rigid = gx[i] * gx[j] + gy[i] * gy[j];
                u[slot as usize] += 2.0 * shape.area() * rigid;
                v[slot as usize] += 2.0 * shape.area() * (rigid + problem.bearing * gt[i] * gt[j]);
            }
        }
        // v is tied by nothing to a place; a tie far below the isometry's weight holds its mean.
        for j in 0..problem.tie.len() {
            let unused = !problem.corner_sums.is_used(j);
            u[pattern.diagonal(j)] += if unused { 1.0 } else { 2.0 * problem.tie[j] };
            v[pattern.diagonal(j)] += if unused { 1.0 } else { 2.0 * problem.tie[j].max(f64::MIN_POSITIVE) };
        }
        (u, v)
    }

    /// Solves for both coordinates and multiplies by `factor`.
    fn apply(&self, gradient: &[Vec2], factor: f64) -> Vec<Vec2> {
        let mut u: Vec<f64> = gradient.iter().map(|g| g.x * factor).collect();
        let mut v: Vec<f64> = gradient.iter().map(|g| g.y * factor).collect();
        rayon::join(
            || match &self.u {
                Some(system) => system.solve_in_place(&mut u),
                None => u.fill(0.0),
            },
            || self.v.solve_in_place(&mut v),
        );
        u.into_iter().zip(v).map(|(x, y)| Vec2::new(x, y)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::unwrap::{self, Method, Summary, closed_form};

    fn relaxed(known: &closed_form::Known, straightness: f64) -> (Vec<Vec2>, Summary) {
        let settings = Settings { straightness, ..Settings::default() };
        let settings = unwrap::Settings::of(Method::Relax(settings));
        let (chart, summary) = unwrap::flatten(known.strip.clone(), Some(&known.axis), &settings).unwrap();
        (chart.uv().to_vec(), summary)
    }

    #[test]
    fn densities_and_their_slopes_agree() {
        let j = Mat2::new(1.1, 0.2, -0.3, 0.8);
        let reference = (j.norm_squared() + j.try_inverse().unwrap().norm_squared()) / 4.0 - 1.0;
        assert!((isometric_density(&j, j.determinant()) - reference).abs() < 1e-14);
        for i in 0..4 {
            let mut moved = j;
            moved[i] += 1e-6;
            let slope = (rigid_density(&moved) - rigid_density(&j)) / 1e-6;
            assert!((slope - rigid_slope(&j)[i]).abs() < 1e-5);
        }
        let turn = Mat2::new(0.6, -0.8, 0.8, 0.6);
        assert!(isometric_density(&turn, 1.0).abs() < 1e-15 && rigid_density(&turn).abs() < 1e-15);
    }

    #[test]
    fn the_gradient_is_the_derivative_of_the_energy() {
        let known = closed_form::rough(12, 16);
        let mesh = known.strip.mesh();
        let guide = Guide::of_strip(&known.strip, &known.axis, &Default::default()).unwrap();
        let shapes = Shapes::of(mesh);
        let problem = Problem::new(mesh, &guide, &shapes, &Settings::default(), guide.uv());
        let gradient = problem.gradient(guide.uv());
        for v in [0, 57, 100, 180] {
            for axis in 0..2 {
                let at = |d: f64| {
                    let mut uv = guide.uv().to_vec();
                    uv[v][axis] += d;
                    problem.energy(&uv)
                };
                let slope = (at(1e-6) - at(-1e-6)) / 2e-6;
                assert!((slope - gradient[v][axis]).abs() < 1e-5 * (1.0 + slope.abs()), "{v} {axis}: {slope}");
            }
        }
    }

    #[test]
    fn relaxing_lowers_stretch_and_never_flips() {
        let known = closed_form::rough(120, 110);
        let section = unwrap::flatten(
            known.strip.clone(),
            Some(&known.axis),
            &unwrap::Settings::of(Method::named("section").unwrap()),
        );
        let before = section.unwrap().1;
        let (_, after) = relaxed(&known, 0.5);
        assert_eq!((after.flipped_faces, after.overlaps), (0, 0));
        assert!(after.solve.converged, "{:?}", after.solve);
        let (before, after) = (before.distortion.stretch.mean - 1.0, after.distortion.stretch.mean - 1.0);
        assert!(after < 0.75 * before, "{before} {after}");
    }

    #[test]
    fn straightness_trades_chainage_against_stretch() {
        let known = closed_form::bend(20.0);
        let runs: Vec<Summary> = [0.0, 0.5, 1.0].map(|s| relaxed(&known, s).1).into();
        let error = |s: &Summary| s.readability.as_ref().unwrap().chainage_rms_m;
        let stretch = |s: &Summary| s.distortion.symmetric_dirichlet;
        assert!(error(&runs[0]) > error(&runs[1]) && error(&runs[1]) > error(&runs[2]));
        assert_eq!(error(&runs[2]), 0.0);
        assert!(stretch(&runs[0]) < stretch(&runs[1]) && stretch(&runs[1]) < stretch(&runs[2]));
        assert!(runs.iter().all(|s| s.flipped_faces == 0));
    }

    #[test]
    fn settings_outside_their_range_are_refused() {
        let known = closed_form::half_cylinder();
        let settings = unwrap::Settings::of(Method::Relax(Settings { straightness: 1.5, ..Settings::default() }));
        let error = unwrap::flatten(known.strip, Some(&known.axis), &settings).unwrap_err();
        assert!(matches!(error, Error::Setting { key: "relax.straightness", .. }));
    }
}
