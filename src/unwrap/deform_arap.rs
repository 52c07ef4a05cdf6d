//! As-rigid-as-possible deformation in space: the tunnel is straightened, opened like a book by automatic handles while
//! every vertex fan stays as rigid as it can, pressed flat, and projected on the plane.
//!
//! Use it to see what a deformation tool would make of the tunnel, or where the opening itself is of interest. `arap` and
//! `relax` get flatter maps faster.
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
//! all heights are pressed to zero and `flat_iterations` steps relax the map in its plane with the handles as weak springs
//! that keep it from wandering.
//!
//! Guarantees: finite; flips left at the end are unfolded and counted. Needs the axis.
//! Departures: handles are springs of known weight, not hard constraints, so that a handle on a bump does not dent the map.
//! Cost: two Cholesky factorizations of the number of vertices; one pass over the faces and three (opening) or two (flat)
//! solves a step.

use super::conformal::{cotangent_laplacian, used_vertices};
use super::finish::finish;
use super::guide::Guide;
use super::opening::{Handles, straightened};
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::numeric::sparse::{self, Analysis, Cholesky, Pattern};
use crate::numeric::{Mat3, Vec2, Vec3};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Spring of a handle while opening, as a multiple of the mean diagonal of the Laplacian.
const OPENING_SPRING: f64 = 1.0;
/// Spring of a handle while relaxing in the plane: enough to hold the map in place, not to shape it.
const FLAT_SPRING: f64 = 1e-3;

/// How the tunnel is deformed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Distance of the handles along and around the tunnel, metres. Default 1.
    pub handle_spacing_m: f64,
    /// Steps from the closed section to the flat one. Default 6.
    pub opening_steps: usize,
    /// Iterations in the plane afterwards. Default 8.
    pub flat_iterations: usize,
    /// Which edges a fan feels: `spokes` (the paper) or `spokes-and-rims` (default: rough rock folds less).
    pub fan: Fan,
}

/// The edges of a vertex fan that count as rigid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Fan {
    /// The edges at the vertex.
    Spokes,
    /// Also the edges opposite to it: smoother, never indefinite.
    #[default]
    SpokesAndRims,
}

impl Default for Settings {
    fn default() -> Self {
        Self { handle_spacing_m: 1.0, opening_steps: 6, flat_iterations: 8, fan: Fan::SpokesAndRims }
    }
}

/// Opens the tunnel and projects it.
///
/// # Errors
/// [`Error::NeedsAxis`] without a guide; [`Error::Setting`]; [`Error::Solve`].
pub fn flatten(strip: &Strip, guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    let guide = guide.ok_or(Error::NeedsAxis { method: "deform-arap" })?;
    let spacing = settings.handle_spacing_m;
    if !(spacing > 0.0 && spacing.is_finite()) {
        return Err(Error::Setting { key: "deform-arap.handle_spacing_m", value: spacing, must: "more than 0 m" });
    }
    if settings.opening_steps == 0 {
        return Err(Error::Setting { key: "deform-arap.opening_steps", value: 0.0, must: "1 or more" });
    }
    let solve_error = |e: sparse::Error| Error::Solve { method: "deform-arap", what: e.to_string() };
    let mesh = strip.mesh();
    let n = mesh.vertices().len();
    let shapes = Shapes::of(mesh);
    let used = used_vertices(n, mesh.faces());
    let handles = Handles::on_lattice(guide, &used, spacing);
    let held: Vec<u32> = handles.vertices().collect();
    let mut summary = SolveSummary::direct();
    summary.figures.insert("handles".to_owned(), held.len() as f64);

    let pattern = Pattern::of_vertices(n, mesh.faces()).map_err(solve_error)?;
    let analysis = Analysis::new(&pattern).map_err(solve_error)?;
    let laplacian = cotangent_laplacian(&pattern, mesh.faces(), |f| shapes.shapes[f].cotangents());
    let mean = (0..n).map(|j| laplacian[pattern.diagonal(j)]).sum::<f64>() / n as f64;
    let fans = Fans::new(strip, &shapes, settings.fan);

    let straight = straightened(guide);
    let mut pose = straight.clone();
    let opening = Springs::new(&pattern, &analysis, &laplacian, &held, OPENING_SPRING * mean).map_err(solve_error)?;
    for step in 1..=settings.opening_steps {
        let t = step as f64 / settings.opening_steps as f64;
        let targets = handles.opened(guide, &straight, t);
        pose = opening.solve(fans.load(&fans.rotations(&pose)), &targets, 3);
    }
    drop(opening);
    pose.iter_mut().for_each(|p| p.z = 0.0);
    let flat = Springs::new(&pattern, &analysis, &laplacian, &held, FLAT_SPRING * mean).map_err(solve_error)?;
    let targets = handles.opened(guide, &straight, 1.0);
    for _ in 0..settings.flat_iterations {
        pose = flat.solve(fans.load(&fans.rotations(&pose)), &targets, 2);
    }
    summary.iterations = settings.opening_steps + settings.flat_iterations;
    let mut uv: Vec<Vec2> = pose.iter().map(|p| p.xy()).collect();
    if let Some(vertex) = uv.iter().position(|p| !(p.x.is_finite() && p.y.is_finite())) {
        return Err(Error::NotFinite { vertex: vertex as u32 });
    }
    finish(strip, &shapes, &mut uv, &mut summary);
    Ok((uv, summary))
}

/// The Laplacian with springs at the handles.
struct Springs<'a> {
    factor: Cholesky,
    held: &'a [u32],
    spring: f64,
}

impl<'a> Springs<'a> {
    fn new(
        pattern: &Pattern,
        analysis: &Analysis,
        laplacian: &[f64],
        held: &'a [u32],
        spring: f64,
    ) -> Result<Self, sparse::Error> {
        let mut values = laplacian.to_vec();
        held.iter().for_each(|&v| values[pattern.diagonal(v as usize)] += spring);
        Ok(Self { factor: Cholesky::new(pattern, analysis, &values)?, held, spring })
    }

    /// Solves for the first `dimensions` coordinates; the others are zero.
    fn solve(&self, mut load: Vec<Vec3>, targets: &[Vec3], dimensions: usize) -> Vec<Vec3> {
        for (&v, target) in self.held.iter().zip(targets) {
            load[v as usize] += target * self.spring;
        }
        let n = load.len();
        let mut x: Vec<f64> = (0..dimensions).flat_map(|k| load.iter().map(move |p| p[k])).collect();
        self.factor.solve_in_place(&mut x);
        (0..n)
            .map(|v| {
                let mut p = Vec3::zeros();
                (0..dimensions).for_each(|k| p[k] = x[k * n + v]);
                p
            })
            .collect()
    }
}

/// The edges of every face with their half cotangents, as seen by the fans.
struct Fans<'a> {
    faces: &'a [[u32; 3]],
    vertex_count: usize,
    /// Edge vectors 0-1, 1-2, 2-0 on the surface, times half the opposite cotangent.
    edges: Vec<[Vec3; 3]>,
    fan: Fan,
}

impl<'a> Fans<'a> {
    fn new(strip: &'a Strip, shapes: &Shapes, fan: Fan) -> Self {
        let (faces, vertices) = (strip.mesh().faces(), strip.mesh().vertices());
        let edges = faces
            .iter()
            .zip(&shapes.shapes)
            .map(|(corners, shape)| {
                let cot = shape.cotangents();
                std::array::from_fn(|k| {
                    let (a, b) = (corners[k] as usize, corners[(k + 1) % 3] as usize);
                    (vertices[b] - vertices[a]) * (cot[(k + 2) % 3] / 2.0)
                })
            })
            .collect();
        Self { faces, vertex_count: vertices.len(), edges, fan }
    }

    /// The rotation of each fan that brings the surface's edges closest to those of the pose.
    fn rotations(&self, pose: &[Vec3]) -> Vec<Mat3> {
        let mut covariance = vec![Mat3::zeros(); self.vertex_count];
        for (corners, edges) in self.faces.iter().zip(&self.edges) {
            let p = corners.map(|v| pose[v as usize]);
            let each: [Mat3; 3] = std::array::from_fn(|k| (p[(k + 1) % 3] - p[k]) * edges[k].transpose());
            let all = each[0] + each[1] + each[2];
            for k in 0..3 {
                // At corner k the spokes are edges k and k - 1, the rim is edge k + 1.
                covariance[corners[k] as usize] += match self.fan {
                    Fan::Spokes => all - each[(k + 1) % 3],
                    Fan::SpokesAndRims => all,
                };
            }
        }
        covariance.par_iter().map(closest_rotation).collect()
    }

    /// The right-hand side that a field of rotations makes.
    fn load(&self, rotations: &[Mat3]) -> Vec<Vec3> {
        let mut load = vec![Vec3::zeros(); self.vertex_count];
        for (corners, edges) in self.faces.iter().zip(&self.edges) {
            let r = corners.map(|v| rotations[v as usize]);
            for k in 0..3 {
                let next = (k + 1) % 3;
                let turned = match self.fan {
                    Fan::Spokes => (r[k] + r[next]) * edges[k] / 2.0,
                    Fan::SpokesAndRims => (r[0] + r[1] + r[2]) * edges[k] / 3.0,
                };
                load[corners[next] as usize] += turned;
                load[corners[k] as usize] -= turned;
            }
        }
        load
    }
}

/// The rotation closest to a matrix; the identity for a zero matrix.
fn closest_rotation(m: &Mat3) -> Mat3 {
    let size = m.amax();
    if !(size > 0.0) {
        return Mat3::identity();
    }
    let svd = (m / size).svd(true, true);
    let (Some(mut u), Some(vt)) = (svd.u, svd.v_t) else { return Mat3::identity() };
    if (u * vt).determinant() < 0.0 {
        let smallest = svd.singular_values.imin();
        u.column_mut(smallest).neg_mut();
    }
    u * vt
}

#[cfg(test)]
mod tests {
    use super::super::{closed_form, distortion::flipped_faces};
    use super::*;

    #[test]
    fn closest_rotation_is_a_rotation() {
        let turn = nalgebra::Rotation3::from_euler_angles(0.4, -1.0, 2.0).into_inner();
        assert!((closest_rotation(&(turn * 5.0)) - turn).norm() < 1e-12);
        let mirrored = Mat3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -0.1);
        assert!((closest_rotation(&mirrored) - Mat3::identity()).norm() < 1e-12);
    }

    #[test]
    fn developable_tunnels_open_to_isometries() {
        for known in closed_form::developable() {
            let guide = Guide::of_strip(&known.strip, &known.axis, &Default::default()).unwrap();
            for fan in [Fan::Spokes, Fan::SpokesAndRims] {
                let settings = Settings { fan, flat_iterations: 100, ..Settings::default() };
                let (uv, _) = flatten(&known.strip, Some(&guide), &settings).unwrap();
                assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);
                let shapes = Shapes::of(known.strip.mesh());
                let energy = super::super::rigid_fit::rigid_energy(known.strip.mesh().faces(), &shapes.shapes, &uv);
                let relative = energy / shapes.area();
                // Fans across a crease are bent on the surface: flat, they are a compromise. The prism has two of 90 degrees.
                let most = if known.name == "prism" { 1e-2 } else { 1e-3 };
                assert!(relative < most, "{} {fan:?}: {relative:e}", known.name);
            }
        }
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
