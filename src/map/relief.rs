//! Shaded relief of the surface: brightness of a matt surface lit from the upper left of the map.

use crate::numeric::{Vec2, Vec3};
use crate::unwrap::Chart;

/// Direction towards the light in (u, v, into the void): from the upper left, half way up.
const LIGHT: [f64; 3] = [-0.5, 0.5, std::f64::consts::FRAC_1_SQRT_2];
/// Slopes are drawn this much steeper, so that rock a few centimetres rough can be seen.
const EXAGGERATION: f64 = 1.5;

/// Brightness 0 to 1 of each vertex, from heights above the mean section (metres, positive into the void).
///
/// The gradient of a face is exact for linear heights; that of a vertex is the area-weighted mean of its faces.
pub fn shade_vertices(chart: &Chart, heights: &[f64]) -> Vec<f32> {
    let mesh = chart.strip().mesh();
    let mut gradients = vec![Vec2::zeros(); heights.len()];
    let mut weights = vec![0.0; heights.len()];
    for (face, corners) in mesh.faces().iter().enumerate() {
        let [a, b, c] = chart.corners_in_chart(face as u32);
        let (ab, ac) = (b - a, c - a);
        let area = ab.perp(&ac);
        let [ha, hb, hc] = corners.map(|v| heights[v as usize]);
        let (db, dc) = (hb - ha, hc - ha);
        // Gradient times double area.
        let gradient = Vec2::new(db * ac.y - dc * ab.y, dc * ab.x - db * ac.x);
        if area > 0.0 && gradient.iter().all(|g| g.is_finite()) {
            for &v in corners {
                gradients[v as usize] += gradient;
                weights[v as usize] += area;
            }
        }
    }
    let light = Vec3::from(LIGHT).normalize();
    gradients
        .iter()
        .zip(&weights)
        .map(|(g, &w)| {
            let slope = if w > 0.0 { g * (EXAGGERATION / w) } else { Vec2::zeros() };
            let normal = Vec3::new(-slope.x, -slope.y, 1.0).normalize();
            // A little ambient light keeps the shadow side readable.
            (0.15 + 0.85 * normal.dot(&light).max(0.0)) as f32
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::example::flat_chart;

    #[test]
    fn slopes_towards_the_light_are_brighter() {
        let chart = flat_chart(2.0, 2.0, 5, 5);
        let shade = |f: fn(&Vec2) -> f64| {
            let heights: Vec<f64> = chart.uv().iter().map(f).collect();
            shade_vertices(&chart, &heights)[12]
        };
        let flat = shade(|_| 0.0);
        assert!(shade(|p| 0.3 * p.x) > flat && shade(|p| -0.3 * p.x) < flat);
        assert!(shade(|p| -0.3 * p.y) > flat);
    }
}
