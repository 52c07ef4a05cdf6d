//! As-rigid-as-possible deformation in space: the tunnel is straightened, opened like a book by automatic handles while
//! every vertex fan stays as rigid as it can, pressed flat, relaxed in the plane, and projected on it.
//!
//! Use it to see what a deformation tool would make of the tunnel, or to steer the map by handles of your own. `arap` and
//! `relax` get as flat with less work.
//!
//! Reference: O. Sorkine, M. Alexa, "As-Rigid-As-Possible Surface Modeling", Symposium on Geometry Processing 2007,
//! doi:10.2312/SGP/SGP07/109-116; spokes-and-rims: I. Chao, U. Pinkall, P. Sanan, P. Schröder, "A Simple Geometric Model for
//! Elastic Deformation", ACM Transactions on Graphics 29(4), 2010, doi:10.1145/1778765.1778775.
//!
//! | symbol | meaning |
//! |---|---|
//! | `p`, `p'` | vertices of the surface and of the deformed surface |
//! | `R_i` | rotation of the fan of vertex `i` |
//! | `w_ij` | cotangent weights |
//! | `E` | sum over fans of `w_ij |(p'_i - p'_j) - R_i (p_i - p_j)|^2` |
//!
//! Handles are the vertices next to a regular lattice of the section chart. They move from the straightened tunnel
//! (closed form) to the map in `opening_steps` steps, each followed by a local (rotations) and a global step (solve). Then
//! all heights are pressed to zero and the map relaxes in its plane, the automatic handles being weak springs that keep it
//! from wandering. There every fan is at rest unrolled (`fans.rs`): with fans as bent as the rock the plane is never
//! at rest, and not even a cylinder would open to its flat form.
//!
//! Guarantees: finite; an isometry on developable surfaces; flips left at the end are unfolded and counted. Needs the axis.
//! Departures: handles are springs of known weight, not hard constraints, so that a handle on a bump does not dent the map;
//! fans are unrolled in the plane.
//! Cost: two Cholesky factorizations of the number of vertices; one pass over the faces and three (opening) or two (flat)
//! solves a step.

use super::conformal::{cotangent_laplacian, used_vertices};
pub use super::fans::Fan;
use super::fans::{BentFans, UnrolledFans};
use super::finish::finish;
use super::guide::Guide;
use super::handles::Steering;
use super::opening::{Handles, straightened};
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::numeric::Vec2;
use crate::numeric::sparse::{self, Analysis, Cholesky, Pattern};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Spring of a handle while opening, as a multiple of the mean diagonal of the Laplacian.
const OPENING_SPRING: f64 = 1.0;
/// Spring of an automatic handle while relaxing in the plane: enough to hold the map in place, not to shape it.
const FLAT_SPRING: f64 = 1e-3;
/// Spring of a handle that a person gave: it is met.
const GIVEN_SPRING: f64 = 1e3;
/// Handles around the tunnel when their spacing is chosen automatically.
const HANDLES_AROUND: f64 = 24.0;
/// Energy for each square metre below which the map is an isometry to the accuracy of the solver: strains of 1e-8.
const ISOMETRY: f64 = 1e-16;

/// How the tunnel is deformed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Distance of the automatic handles along and around the tunnel, metres. A 24th of the girth when not given.
    pub handle_spacing_m: Option<f64>,
    /// Steps from the closed section to the flat one. Default 6.
    pub opening_steps: usize,
    /// Iterations in the plane afterwards, at most. Default 100.
    pub flat_iterations: usize,
    /// They stop when the energy falls by less than this share. Default 0.002.
    pub tolerance: f64,
    /// Which edges a fan feels: `spokes` (the paper) or `spokes-and-rims` (default: rough rock folds less).
    pub fan: Fan,
    /// A file with handles that steer the map (docs/methods/deform_arap.md): CSV with `x, y, z` in scan coordinates and
    /// `u, v` (chainage, girth) in metres.
    pub handles: Option<PathBuf>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            handle_spacing_m: None,
            opening_steps: 6,
            flat_iterations: 100,
            tolerance: 0.002,
            fan: Fan::SpokesAndRims,
            handles: None,
        }
    }
}

/// Opens the tunnel and projects it.
///
/// # Errors
/// [`Error::NeedsAxis`] without a guide; [`Error::Setting`]; [`Error::Handles`]; [`Error::Solve`].
pub fn flatten(strip: &Strip, guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    let guide = guide.ok_or(Error::NeedsAxis { method: "deform-arap" })?;
    let spacing = settings.handle_spacing_m.unwrap_or(guide.summary().section.mean_girth_m / HANDLES_AROUND);
    if !(spacing > 0.0 && spacing.is_finite()) {
        return Err(Error::Setting { key: "deform-arap.handle_spacing_m", value: spacing, must: "more than 0 m" });
    }
    if settings.opening_steps == 0 {
        return Err(Error::Setting { key: "deform-arap.opening_steps", value: 0.0, must: "1 or more" });
    }
    if !(settings.tolerance >= 0.0) {
        return Err(Error::Setting { key: "deform-arap.tolerance", value: settings.tolerance, must: "0 or more" });
    }
    let solve_error = |e: sparse::Error| Error::Solve { method: "deform-arap", what: e.to_string() };
    let mesh = strip.mesh();
    let n = mesh.vertices().len();
    let shapes = Shapes::of(mesh);
    let used = used_vertices(n, mesh.faces());
    let steering = Steering::of(strip, guide, "deform-arap")?;
    let displacement = steering.as_ref().map(|s| s.displacement.as_slice());
    let handles = Handles::on_lattice(guide, &used, spacing);
    let mut held: Vec<u32> = handles.vertices().collect();
    let mut summary = SolveSummary::default();
    summary.figures.insert("handles".to_owned(), held.len() as f64);

    let pattern = Pattern::of_vertices(n, mesh.faces()).map_err(solve_error)?;
    let analysis = Analysis::new(&pattern).map_err(solve_error)?;
    let laplacian = cotangent_laplacian(&pattern, mesh.faces(), |f| shapes.shapes[f].cotangents());
    let mean = (0..n).map(|j| laplacian[pattern.diagonal(j)]).sum::<f64>() / n as f64;

    let straight = straightened(guide);
    let mut springs = vec![OPENING_SPRING * mean; held.len()];
    let opening = Springs::new(&pattern, &analysis, &laplacian, &held, &springs).map_err(solve_error)?;
    let bent = BentFans::new(mesh, &shapes, settings.fan);
    let mut pose = straight.clone();
    for step in 1..=settings.opening_steps {
        let t = step as f64 / settings.opening_steps as f64;
        pose = opening.solve(&bent.load(&pose), &handles.opened(guide, &straight, displacement, t));
    }
    drop((opening, bent));

    let mut uv: Vec<Vec2> = pose.iter().map(|p| p.xy()).collect();
    let opened = handles.opened(guide, &straight, displacement, 1.0);
    let mut targets: Vec<Vec2> = opened.iter().map(|p| p.xy()).collect();
    springs.fill(FLAT_SPRING * mean);
    if let Some(steering) = &steering {
        for &(vertex, place) in &steering.held {
            held.push(vertex);
            targets.push(place);
            springs.push(GIVEN_SPRING * mean);
        }
    }
    let flat = Springs::new(&pattern, &analysis, &laplacian, &held, &springs).map_err(solve_error)?;
    let fans = UnrolledFans::new(mesh, &shapes, settings.fan);
    let (mut energy, mut load) = fans.local_step(&uv);
    let isometry = ISOMETRY * shapes.area();
    let mut fall = f64::INFINITY;
    while summary.iterations < settings.flat_iterations && !summary.converged {
        uv = flat.solve(&load, &targets);
        let last = energy;
        (energy, load) = fans.local_step(&uv);
        fall = (last - energy) / last.max(f64::MIN_POSITIVE);
        summary.iterations += 1;
        summary.converged = fall <= settings.tolerance || energy <= isometry;
    }
    summary.energy = Some(energy);
    summary.residual = fall.is_finite().then_some(fall);
    if let Some(vertex) = uv.iter().position(|p| !(p.x.is_finite() && p.y.is_finite())) {
        return Err(Error::NotFinite { vertex: vertex as u32 });
    }
    finish(strip, &shapes, &mut uv, &mut summary);
    if let Some(steering) = &steering {
        summary.figures.insert("given_handles".to_owned(), steering.held.len() as f64);
        summary.figures.insert("given_handles_missed_by_m".to_owned(), steering.missed_by_m(&uv));
    }
    Ok((uv, summary))
}

/// The Laplacian with springs at the handles.
struct Springs<'a> {
    factor: Cholesky,
    held: &'a [u32],
    springs: &'a [f64],
}

impl<'a> Springs<'a> {
    fn new(
        pattern: &Pattern,
        analysis: &Analysis,
        laplacian: &[f64],
        held: &'a [u32],
        springs: &'a [f64],
    ) -> Result<Self, sparse::Error> {
        let mut values = laplacian.to_vec();
        held.iter().zip(springs).for_each(|(&v, spring)| values[pattern.diagonal(v as usize)] += spring);
        Ok(Self { factor: Cholesky::new(pattern, analysis, &values)?, held, springs })
    }

    /// The global step: the pose that fits the load best and is drawn to the targets.
    fn solve<const D: usize>(&self, load: &[Vector<D>], targets: &[Vector<D>]) -> Vec<Vector<D>> {
        let n = load.len();
        let mut x: Vec<f64> = (0..D).flat_map(|k| load.iter().map(move |p| p[k])).collect();
        for ((&v, spring), target) in self.held.iter().zip(self.springs).zip(targets) {
            (0..D).for_each(|k| x[k * n + v as usize] += spring * target[k]);
        }
        self.factor.solve_in_place(&mut x);
        (0..n).map(|v| Vector::from_fn(|k, _| x[k * n + v])).collect()
    }
}

type Vector<const D: usize> = nalgebra::SVector<f64, D>;

#[cfg(test)]
mod tests {
    use super::super::distortion::{Distortion, flipped_faces};
    use super::super::{closed_form, handles::Handle};
    use super::*;

    #[test]
    fn developable_tunnels_open_to_isometries() {
        for known in closed_form::developable() {
            let guide = Guide::of_strip(&known.strip, &known.axis, &Default::default()).unwrap();
            for fan in [Fan::Spokes, Fan::SpokesAndRims] {
                let settings = Settings { fan, ..Settings::default() };
                let (uv, summary) = flatten(&known.strip, Some(&guide), &settings).unwrap();
                assert!(summary.converged, "{} {fan:?}: {summary:?}", known.name);
                assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);
                let stretch = Distortion::of(known.strip.mesh(), &uv).stretch.max;
                assert!(stretch < 1.0 + 1e-6, "{} {fan:?}: {stretch} {summary:?}", known.name);
                let farthest = uv.iter().zip(&known.flat).map(|(p, q)| (p - q).norm()).fold(0.0, f64::max);
                assert!(farthest < 1e-5, "{} {fan:?}: {farthest} m", known.name);
            }
        }
    }

    #[test]
    fn given_handles_are_met_and_bring_the_map_along() {
        let known = closed_form::rough(60, 60);
        let guide = Guide::of_strip(&known.strip, &known.axis, &Default::default()).unwrap();
        let vertices = known.strip.mesh().vertices();
        let given = |v: usize, d: Vec2| Handle {
            given_in: format!("vertex {v}"),
            position_in_local: vertices[v],
            place_in_chart: guide.uv()[v] + d,
        };
        let shift = Vec2::new(0.3, -0.2);
        let handles = [given(10 * 61 + 30, shift), given(50 * 61 + 20, shift), given(31 * 61 + 45, shift)];
        let steered = guide.clone().with_handles(&handles);
        let (uv, summary) = flatten(&known.strip, Some(&steered), &Settings::default()).unwrap();
        assert!(summary.figures["given_handles_missed_by_m"] < 1e-3, "{summary:?}");
        assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);
        let (free, _) = flatten(&known.strip, Some(&guide), &Settings::default()).unwrap();
        let mean = uv.iter().zip(&free).map(|(p, q)| p - q).sum::<Vec2>() / uv.len() as f64;
        assert!((mean - shift).norm() < 0.1, "{mean}");
    }

    #[test]
    fn a_rough_bend_opens_without_flips() {
        let known = closed_form::rough(60, 60);
        let guide = Guide::of_strip(&known.strip, &known.axis, &Default::default()).unwrap();
        let (uv, summary) = flatten(&known.strip, Some(&guide), &Settings::default()).unwrap();
        assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);
        assert!(summary.figures["handles"] > 100.0);
    }

    #[test]
    fn it_needs_the_axis() {
        let known = closed_form::prism();
        let error = flatten(&known.strip, None, &Settings::default()).unwrap_err();
        assert_eq!(error, Error::NeedsAxis { method: "deform-arap" });
    }
}
