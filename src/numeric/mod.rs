//! The linear-algebra edge of Adit: vector types, 2x2 singular values, statistics in fixed order.
//!
//! Everything is `f64`. Sums run in index order, so a result has the same bytes on any number of threads.

pub mod conjugate_gradients;
pub mod dissection;
pub mod sparse;
pub mod statistics;
pub mod svd2x2;

/// A point or direction in 3D, metres unless stated otherwise.
pub type Vec3 = nalgebra::Vector3<f64>;
/// A point or direction in the plane, metres unless stated otherwise.
pub type Vec2 = nalgebra::Vector2<f64>;
/// A dense 2x2 matrix.
pub type Mat2 = nalgebra::Matrix2<f64>;
/// A dense 3x3 matrix.
pub type Mat3 = nalgebra::Matrix3<f64>;

/// A unit vector perpendicular to `direction` (which need not be normalised, but must not be zero).
pub fn any_perpendicular(direction: &Vec3) -> Vec3 {
    // Crossing with the axis of the smallest component is the best-conditioned choice.
    let smallest = direction.iamin();
    let mut axis = Vec3::zeros();
    axis[smallest] = 1.0;
    direction.cross(&axis).normalize()
}

/// Angle in radians between two vectors, 0 to pi. Uses `atan2`, so it is accurate near 0 and pi where `acos` is not.
pub fn angle_between(a: &Vec3, b: &Vec3) -> f64 {
    a.cross(b).norm().atan2(a.dot(b))
}

/// `angle` brought into (-pi, pi].
pub fn wrap_angle(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    let wrapped = angle - TAU * (angle / TAU).round();
    if wrapped <= -PI { wrapped + TAU } else { wrapped }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn perpendicular_is_unit_and_perpendicular() {
        for v in [Vec3::new(1.0, 0.0, 0.0), Vec3::new(-3.0, 4.0, 0.1), Vec3::new(0.0, 0.0, -2.0)] {
            let p = any_perpendicular(&v);
            assert!((p.norm() - 1.0).abs() < 1e-15 && p.dot(&v).abs() < 1e-15);
        }
    }

    #[test]
    fn wrap_angle_is_half_open() {
        assert_eq!(wrap_angle(PI), PI);
        assert!((wrap_angle(-PI) - PI).abs() < 1e-15);
        assert!((wrap_angle(3.0 * PI / 2.0) + PI / 2.0).abs() < 1e-15);
        assert!((wrap_angle(-7.0) - (2.0 * PI - 7.0)).abs() < 1e-14);
    }
}
