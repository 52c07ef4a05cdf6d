//! The angles of a triangulation as unknowns: targets, the conditions under which they fit into the plane, and the layout
//! of fitting angles. Shared by [`super::abf`] and [`super::abf_plus_plus`].
//!
//! Angle `3 t + k` is the one at corner `k` of face `t`. A planar layout exists when, with the angles in (0, pi),
//! * each face's angles sum to pi (`C_tri`),
//! * the angles around each inner vertex sum to 2 pi (`C_plan`),
//! * around each inner vertex the product of the sines of the angles after it equals that of the angles before it
//!   (`C_len`, here as difference of logarithms): walking round the vertex, the spokes come back to their length.

use super::conformal::{ConformalForm, far_pair};
use super::finish::finish;
use super::rigid_fit::chart_area;
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::mesh::topology::NO_TWIN;
use crate::numeric::{Vec2, sparse};
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};

/// Marks a vertex without conditions: on the boundary, or without faces.
pub(super) const FREE: u32 = u32::MAX;

/// Angles below this many radians, or as close to pi, are not approached in one step.
const THINNEST: f64 = 1e-4;

/// The angle problem of one mesh.
pub(super) struct AngleProblem<'a> {
    pub faces: &'a [[u32; 3]],
    /// For each vertex its number among the inner ones, or [`FREE`].
    pub inner: Vec<u32>,
    /// Number of inner vertices.
    pub inner_count: usize,
    /// Target of each angle, radians.
    pub target: Vec<[f64; 3]>,
    /// Weight of each angle, `1 / target^2`.
    pub weight: Vec<[f64; 3]>,
}

/// How far angles are from fitting: the largest residual of each kind of condition.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Misfit {
    pub triangle: f64,
    pub plane: f64,
    pub length: f64,
}

impl Misfit {
    pub fn largest(&self) -> f64 {
        self.triangle.max(self.plane).max(self.length)
    }
}

impl<'a> AngleProblem<'a> {
    /// Targets are the surface's own angles, at inner vertices scaled so that they sum to 2 pi (Sheffer & de Sturler 2001).
    pub fn new(mesh: &'a Mesh, shapes: &Shapes) -> Self {
        let (faces, n) = (mesh.faces(), mesh.vertices().len());
        let mut free = vec![true; n];
        faces.iter().flatten().for_each(|&v| free[v as usize] = false);
        let twin = mesh.twins();
        for (c, _) in twin.iter().enumerate().filter(|(_, t)| **t == NO_TWIN) {
            free[faces[c / 3][c % 3] as usize] = true;
            free[faces[c / 3][(c + 1) % 3] as usize] = true;
        }
        let mut inner_count = 0;
        let inner = free
            .iter()
            .map(|&free| {
                if free {
                    return FREE;
                }
                inner_count += 1;
                inner_count - 1
            })
            .collect();
        let own: Vec<[f64; 3]> = shapes.shapes.iter().map(|s| s.angles()).collect();
        let mut around = vec![0.0; n];
        for (corners, angles) in faces.iter().zip(&own) {
            corners.iter().zip(angles).for_each(|(&v, a)| around[v as usize] += a);
        }
        let limit = |a: f64| a.clamp(THINNEST, PI - THINNEST);
        let target: Vec<[f64; 3]> = faces
            .iter()
            .zip(&own)
            .map(|(corners, angles)| {
                std::array::from_fn(|k| {
                    let v = corners[k] as usize;
                    limit(if free[v] { angles[k] } else { angles[k] * TAU / around[v] })
                })
            })
            .collect();
        let weight = target.iter().map(|a| a.map(|a| 1.0 / (a * a))).collect();
        Self { faces, inner, inner_count: inner_count as usize, target, weight }
    }

    /// Where the iterations start: the targets, moved so that each face sums to pi.
    pub fn start(&self) -> Vec<[f64; 3]> {
        self.target.iter().map(|a| a.map(|x| x * PI / a.iter().sum::<f64>())).collect()
    }

    /// Residuals `C_plan` and `C_len` of the inner vertices, interleaved.
    pub fn residuals(&self, angles: &[[f64; 3]]) -> Vec<f64> {
        let mut residual = vec![0.0; 2 * self.inner_count];
        residual.iter_mut().step_by(2).for_each(|r| *r = -TAU);
        let logs: Vec<[f64; 3]> = angles.par_iter().map(|a| a.map(|x| x.sin().ln())).collect();
        for ((corners, a), log) in self.faces.iter().zip(angles).zip(&logs) {
            for k in 0..3 {
                let v = self.inner[corners[k] as usize];
                if v != FREE {
                    residual[2 * v as usize] += a[k];
                    residual[2 * v as usize + 1] += log[(k + 1) % 3] - log[(k + 2) % 3];
                }
            }
        }
        residual
    }

    /// The largest residuals.
    pub fn misfit(&self, angles: &[[f64; 3]], residuals: &[f64]) -> Misfit {
        let largest = |v: &mut dyn Iterator<Item = f64>| v.fold(0.0f64, |m, x| m.max(x.abs()));
        Misfit {
            triangle: largest(&mut angles.iter().map(|a| a.iter().sum::<f64>() - PI)),
            plane: largest(&mut residuals.iter().step_by(2).copied()),
            length: largest(&mut residuals.iter().skip(1).step_by(2).copied()),
        }
    }

    /// `sum ((angle - target) / target)^2`.
    pub fn energy(&self, angles: &[[f64; 3]]) -> f64 {
        let each = |((a, t), w): ((&[f64; 3], &[f64; 3]), &[f64; 3])| {
            (0..3).map(|k| w[k] * (a[k] - t[k]).powi(2)).sum::<f64>()
        };
        angles.iter().zip(&self.target).zip(&self.weight).map(each).sum()
    }

    /// The longest share of a step that leaves every angle inside (0, pi) with room: no angle loses more than 90 % of its
    /// distance to either end.
    pub fn longest_step(&self, angles: &[[f64; 3]], step: &[[f64; 3]]) -> f64 {
        let mut longest = 1.0f64;
        for (a, d) in angles.iter().flatten().zip(step.iter().flatten()) {
            let room = if *d < 0.0 { *a } else { PI - a };
            if 0.9 * room < d.abs() * longest {
                longest = 0.9 * room / d.abs();
            }
        }
        longest
    }

    /// The derivative of the two conditions of the inner vertex at corner `k` with respect to the face's three angles,
    /// given their cotangents.
    pub fn gradients(cotangents: &[f64; 3], k: usize) -> [[f64; 3]; 2] {
        let (after, before) = ((k + 1) % 3, (k + 2) % 3);
        let mut plane = [0.0; 3];
        let mut length = [0.0; 3];
        plane[k] = 1.0;
        length[after] = cotangents[after];
        length[before] = -cotangents[before];
        [plane, length]
    }
}

/// Lays angles out in the plane: least squares conformal with their cotangents, then the area of the surface.
///
/// # Errors
/// [`Error::Solve`] when the system cannot be solved or the layout has no area.
pub(super) fn lay_out(
    method: &'static str,
    strip: &Strip,
    shapes: &Shapes,
    angles: &[[f64; 3]],
    summary: &mut SolveSummary,
) -> Result<Vec<Vec2>, Error> {
    let faces = strip.mesh().faces();
    let solve_error = |e: sparse::Error| Error::Solve { method, what: e.to_string() };
    let form = ConformalForm::new(strip, |t| angles[t].map(|a| a.cos() / a.sin())).map_err(solve_error)?;
    let [a, b] = far_pair(strip);
    let (mut uv, residual) = form.solve_pinned([(a, Vec2::zeros()), (b, Vec2::new(1.0, 0.0))]).map_err(solve_error)?;
    summary.figures.insert("layout_residual".to_owned(), residual);
    let area = chart_area(faces, &uv);
    if !(area.is_finite() && area > 0.0) {
        return Err(Error::Solve { method, what: format!("the layout of the angles has no area ({area} m2)") });
    }
    let scale = (shapes.area() / area).sqrt();
    uv.iter_mut().for_each(|p| *p *= scale);
    finish(strip, shapes, &mut uv, summary);
    Ok(uv)
}
