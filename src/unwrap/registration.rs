//! Placing a chart on the map: u = chainage, v = girth from the crown, never mirrored.
//!
//! Methods without an axis return their result anywhere in the plane, some at any scale. It is scaled so that its area
//! is the surface's, then turned and shifted to lie as close as possible (least squares, weighted by the area around
//! each vertex) to the guide; without a guide its principal direction is laid along u, centred on the origin.
//!
//! Reference: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE
//! TPAMI 13(4), 1991, doi:10.1109/34.88573 (in the plane the optimal rotation is one `atan2`).

use super::guide::Guide;
use super::{Error, Freedom};
use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::numeric::Vec2;
use serde::Serialize;

/// The motion that was applied.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Placement {
    /// What the result was fitted to: `method` (nothing to do), `section chart` or `principal direction`.
    pub reference: &'static str,
    /// Factor applied to all lengths (1 for methods that keep the scale).
    pub scale: f64,
    /// Counter-clockwise turn, degrees.
    pub rotation_deg: f64,
    /// Whether the whole chart was mirrored by the method and was mirrored back.
    pub mirrored_back: bool,
    /// Root mean square distance from the section chart after placement, metres; absent without an axis.
    pub rms_m: Option<f64>,
}

/// Area around each vertex on the surface: a third of its faces'.
pub(crate) fn vertex_areas(mesh: &Mesh) -> Vec<f64> {
    let mut areas = vec![0.0; mesh.vertices().len()];
    for (face, corners) in mesh.faces().iter().enumerate() {
        let third = mesh.double_area_vector(face as u32).norm() / 6.0;
        corners.iter().for_each(|&v| areas[v as usize] += third);
    }
    areas
}

/// Places `uv`; see the module.
///
/// # Errors
/// [`Error::Solve`] when the chart has no area that a scale could be taken from.
pub(super) fn place(
    strip: &Strip,
    guide: Option<&Guide>,
    freedom: Freedom,
    uv: &mut [Vec2],
) -> Result<Placement, Error> {
    let mesh = strip.mesh();
    let weights = vertex_areas(mesh);
    let mut placement =
        Placement { reference: "method", scale: 1.0, rotation_deg: 0.0, mirrored_back: false, rms_m: None };
    if freedom != Freedom::Placed {
        let signed_area: f64 = mesh.faces().iter().map(|&corners| double_area(corners.map(|v| uv[v as usize]))).sum();
        if signed_area < 0.0 {
            uv.iter_mut().for_each(|p| p.y = -p.y);
            placement.mirrored_back = true;
        }
        if freedom == Freedom::Similar {
            let ratio = 2.0 * mesh.area() / signed_area.abs();
            if !(ratio.is_finite() && ratio > 0.0) {
                return Err(Error::Solve {
                    method: "registration",
                    what: format!("the chart has no area ({:e} m2)", signed_area.abs() / 2.0),
                });
            }
            placement.scale = ratio.sqrt();
        }
        let (centre, turn, target) = match guide {
            Some(guide) => {
                placement.reference = "section chart";
                let (centre, target) = (centroid(uv, &weights), centroid(guide.uv(), &weights));
                (centre, turn_onto(uv, &centre, guide.uv(), &target, &weights), target)
            }
            None => {
                placement.reference = "principal direction";
                let (centre, angle) = principal_direction(mesh, uv);
                (centre, -angle, Vec2::zeros())
            }
        };
        placement.rotation_deg = turn.to_degrees();
        let (sin, cos) = (turn.sin() * placement.scale, turn.cos() * placement.scale);
        for p in uv.iter_mut() {
            let d = *p - centre;
            *p = target + Vec2::new(cos * d.x - sin * d.y, sin * d.x + cos * d.y);
        }
    }
    placement.rms_m = guide.map(|guide| {
        let (mut sum, mut total) = (0.0, 0.0);
        for ((p, q), w) in uv.iter().zip(guide.uv()).zip(&weights) {
            sum += w * (p - q).norm_squared();
            total += w;
        }
        (sum / total).sqrt()
    });
    Ok(placement)
}

fn double_area([a, b, c]: [Vec2; 3]) -> f64 {
    (b - a).perp(&(c - a))
}

fn centroid(uv: &[Vec2], weights: &[f64]) -> Vec2 {
    let (sum, total) = uv.iter().zip(weights).fold((Vec2::zeros(), 0.0), |(s, t), (p, w)| (s + p * *w, t + w));
    sum / total
}

/// The turn that brings `uv` (about `centre`) closest to `target` (about `target_centre`).
fn turn_onto(uv: &[Vec2], centre: &Vec2, target: &[Vec2], target_centre: &Vec2, weights: &[f64]) -> f64 {
    let (mut dot, mut cross) = (0.0, 0.0);
    for ((p, q), w) in uv.iter().zip(target).zip(weights) {
        let (a, b) = (p - centre, q - target_centre);
        dot += w * a.dot(&b);
        cross += w * a.perp(&b);
    }
    cross.atan2(dot)
}

/// Centroid of the chart and direction of its largest spread in (-pi/2, pi/2], integrated exactly over the faces (with
/// their area on the surface), so that the triangulation does not show.
fn principal_direction(mesh: &Mesh, uv: &[Vec2]) -> (Vec2, f64) {
    let faces = || {
        mesh.faces().iter().enumerate().map(|(face, corners)| {
            let p = corners.map(|v| uv[v as usize]);
            (mesh.double_area_vector(face as u32).norm(), p, (p[0] + p[1] + p[2]) / 3.0)
        })
    };
    let (sum, total) = faces().fold((Vec2::zeros(), 0.0), |(s, t), (area, _, middle)| (s + middle * area, t + area));
    let centre = sum / total;
    let (mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0);
    for (area, corners, middle) in faces() {
        // The second moment of a triangle is a twelfth of its corners' plus nine twelfths of its centroid's.
        for (point, share) in corners.iter().map(|p| (p, 1.0 / 12.0)).chain([(&middle, 0.75)]) {
            let d = point - centre;
            xx += area * share * d.x * d.x;
            yy += area * share * d.y * d.y;
            xy += area * share * d.x * d.y;
        }
    }
    (centre, 0.5 * (2.0 * xy).atan2(xx - yy))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::Vec3;

    fn sheet() -> Strip {
        // 6 m x 2 m in the xy-plane, seen from above.
        let vertices = (0..=6).flat_map(|i| (0..=2).map(move |j| Vec3::new(f64::from(i), f64::from(j), 0.0))).collect();
        let faces = (0..6u32)
            .flat_map(|i| {
                (0..2u32).flat_map(move |j| {
                    let a = 3 * i + j;
                    [[a, a + 3, a + 4], [a, a + 4, a + 1]]
                })
            })
            .collect();
        Strip::from_disk(Mesh::all_observed(vertices, faces).unwrap()).unwrap()
    }

    #[test]
    fn a_turned_scaled_mirrored_sheet_comes_back() {
        let strip = sheet();
        let flat: Vec<Vec2> = strip.mesh().vertices().iter().map(|p| Vec2::new(p.x - 3.0, p.y - 1.0)).collect();
        let (sin, cos) = 0.4_f64.sin_cos();
        for mirror in [1.0, -1.0] {
            let mut uv: Vec<Vec2> = flat
                .iter()
                .map(|p| Vec2::new(7.0 + 3.0 * (cos * p.x - sin * p.y), mirror * (3.0 * (sin * p.x + cos * p.y) - 5.0)))
                .collect();
            let placement = place(&strip, None, Freedom::Similar, &mut uv).unwrap();
            assert!((placement.scale - 1.0 / 3.0).abs() < 1e-12);
            assert_eq!(placement.mirrored_back, mirror < 0.0);
            for (p, q) in uv.iter().zip(&flat) {
                assert!((p - q).norm() < 1e-12, "{p} {q}");
            }
        }
    }

    #[test]
    fn a_collapsed_chart_is_refused() {
        let mut uv = vec![Vec2::zeros(); 21];
        assert!(matches!(place(&sheet(), None, Freedom::Similar, &mut uv), Err(Error::Solve { .. })));
    }
}
