//! Stretch of each face, for the distortion layer.

use crate::mesh::FaceId;
use crate::numeric::{Mat2, Vec2, svd2x2};
use crate::unwrap::Chart;

/// Singular values s1 >= s2 of the map from the surface to the chart (s2 < 0: flipped), area ratio s1 s2, and the
/// direction of greatest stretch in the chart: degrees from the u axis, -90 to 90. NaN for a face without area.
pub fn of_face(chart: &Chart, face: FaceId) -> [f32; 4] {
    let [p, q, r] = chart.strip().mesh().corners(face);
    let [a, b, c] = chart.corners_in_chart(face);
    let (e1, e2) = (q - p, r - p);
    let length = e1.norm();
    let height = e1.cross(&e2).norm() / length;
    if !(length > 0.0 && height > 0.0) {
        return [f32::NAN; 4];
    }
    // Edges in an orthonormal basis of the face: (length, 0) and (along, height).
    let along = e1.dot(&e2) / length;
    let first: Vec2 = (b - a) / length;
    let second: Vec2 = ((c - a) - first * along) / height;
    let jacobian = Mat2::new(first.x, second.x, first.y, second.y);
    let (s1, s2) = svd2x2::signed_singular_values(&jacobian);
    // J J^T has its greatest eigenvector in the direction of greatest stretch.
    let m = jacobian * jacobian.transpose();
    let angle = 0.5 * (2.0 * m.m12).atan2(m.m11 - m.m22);
    [s1 as f32, s2 as f32, (s1 * s2) as f32, angle.to_degrees() as f32]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::example::flat_chart;

    #[test]
    fn a_stretched_chart_says_so() {
        let flat = flat_chart(2.0, 1.0, 3, 3);
        let uv = flat.uv().iter().map(|p| Vec2::new(p.x, 1.25 * p.y)).collect();
        let chart = Chart::new(flat.strip().clone(), uv).unwrap();
        for face in 0..chart.strip().mesh().faces().len() as FaceId {
            let [s1, s2, area, angle] = of_face(&chart, face);
            assert!((s1 - 1.25).abs() < 1e-6 && (s2 - 1.0).abs() < 1e-6 && (area - 1.25).abs() < 1e-6);
            assert!((angle.abs() - 90.0).abs() < 1e-3);
        }
    }
}
