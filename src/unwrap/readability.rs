//! How far a chart is from reading like a ruler: chainage along u, girth along v, axis lines horizontal.
//!
//! A map can be almost free of distortion and still hard to work with, because the tunnel curls over the page. These
//! figures compare a registered chart with what the axis tells:
//! * chainage error: u minus the chainage of each vertex;
//! * bearing error: the angle between horizontal and the image of the axis direction on each face;
//! * girth error: v minus the girth of the section chart at each vertex.
//!
//! All are weighted by surface area. Cost: linear.

use super::distortion::jacobian;
use super::guide::Guide;
use super::registration::vertex_areas;
use crate::mesh::Mesh;
use crate::numeric::Vec2;
use rayon::prelude::*;
use serde::Serialize;

/// Faces that see the axis direction this much foreshortened (cosine) have no meaningful bearing: steps across the
/// tunnel. About 11 degrees from perpendicular.
const LEAST_ALONG: f64 = 0.2;

/// Readability of a registered chart.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Readability {
    /// Root mean square of u - chainage, metres.
    pub chainage_rms_m: f64,
    /// Largest |u - chainage|, metres.
    pub chainage_max_m: f64,
    /// Root mean square angle between the image of the axis direction and horizontal, degrees.
    pub bearing_rms_deg: f64,
    /// Share of the surface that is too steep to the axis to have a bearing, percent.
    pub without_bearing_percent: f64,
    /// Root mean square of v - girth, metres.
    pub girth_rms_m: f64,
    /// Largest |v - girth|, metres.
    pub girth_max_m: f64,
}

impl Readability {
    /// Measures a chart that is already registered.
    pub fn of(mesh: &Mesh, uv: &[Vec2], guide: &Guide) -> Self {
        let areas = vertex_areas(mesh);
        let total: f64 = areas.iter().sum();
        let (mut chainage_sum, mut girth_sum) = (0.0, 0.0);
        let (mut chainage_max_m, mut girth_max_m) = (0.0_f64, 0.0_f64);
        for ((p, q), w) in uv.iter().zip(guide.uv()).zip(&areas) {
            let d = p - q;
            chainage_sum += w * d.x * d.x;
            girth_sum += w * d.y * d.y;
            // Vertices without a face are not on the map.
            if *w > 0.0 {
                chainage_max_m = chainage_max_m.max(d.x.abs());
                girth_max_m = girth_max_m.max(d.y.abs());
            }
        }
        let bearings: Vec<(f64, f64)> = (0..mesh.faces().len() as u32)
            .into_par_iter()
            .map(|face| {
                let area = mesh.double_area_vector(face).norm() / 2.0;
                (area, bearing(mesh, uv, guide, face).unwrap_or(f64::NAN))
            })
            .collect();
        let (mut bearing_sum, mut with, mut all) = (0.0, 0.0, 0.0);
        for (area, angle) in bearings {
            all += area;
            if angle.is_finite() {
                bearing_sum += area * angle * angle;
                with += area;
            }
        }
        let share = |x: f64, whole: f64| if whole > 0.0 { x / whole } else { 0.0 };
        Self {
            chainage_rms_m: share(chainage_sum, total).sqrt(),
            chainage_max_m,
            bearing_rms_deg: share(bearing_sum, with).sqrt().to_degrees(),
            without_bearing_percent: 100.0 * share(all - with, all),
            girth_rms_m: share(girth_sum, total).sqrt(),
            girth_max_m,
        }
    }
}

/// Angle in radians between u and the image of the axis direction on a face.
fn bearing(mesh: &Mesh, uv: &[Vec2], guide: &Guide, face: u32) -> Option<f64> {
    let corners = mesh.corners(face);
    let ids = mesh.faces()[face as usize];
    let j = jacobian(corners, ids.map(|v| uv[v as usize]))?;
    let chainage = ids.iter().map(|&v| guide.coordinates()[v as usize].chainage).sum::<f64>() / 3.0;
    let forward = guide.forward(chainage);
    let x = (corners[1] - corners[0]).normalize();
    let e2 = corners[2] - corners[0];
    let y = (e2 - x * e2.dot(&x)).normalize();
    let along = Vec2::new(forward.dot(&x), forward.dot(&y));
    if along.norm() < LEAST_ALONG {
        return None;
    }
    let image = j * along;
    Some(image.y.atan2(image.x))
}
