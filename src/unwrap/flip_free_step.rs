//! How far a map can move along a step before the first face loses its area: shared by the methods that never flip.
//!
//! Reference: J. Smith, S. Schaefer, "Bijective Parameterization with Free Boundaries", ACM Transactions on Graphics 34(4),
//! 2015, doi:10.1145/2766947: the doubled area of a face is a quadratic of the step length.

use super::quasi_newton::CHUNK;
use crate::numeric::Vec2;
use rayon::prelude::*;

/// The largest multiple of `step` before one of the faces that are `guarded` loses its area; infinite when none does.
pub(super) fn largest_flip_free_step(
    faces: &[[u32; 3]],
    uv: &[Vec2],
    step: &[Vec2],
    guarded: impl Fn(usize) -> bool + Sync,
) -> f64 {
    (0..faces.len())
        .into_par_iter()
        .with_min_len(CHUNK)
        .filter(|&f| guarded(f))
        .map(|f| {
            let p = faces[f].map(|v| uv[v as usize]);
            let d = faces[f].map(|v| step[v as usize]);
            let (e, f, de, df) = (p[1] - p[0], p[2] - p[0], d[1] - d[0], d[2] - d[0]);
            smallest_positive_root(de.perp(&df), e.perp(&df) + de.perp(&f), e.perp(&f))
        })
        .reduce(|| f64::INFINITY, f64::min)
}

/// The smallest positive root of `a t^2 + b t + c` with `c > 0`, or infinity. Stable for tiny `a`.
fn smallest_positive_root(a: f64, b: f64, c: f64) -> f64 {
    let discriminant = b * b - 4.0 * a * c;
    if discriminant < 0.0 {
        return f64::INFINITY;
    }
    let q = -0.5 * (b + discriminant.sqrt().copysign(b));
    let roots = [if a == 0.0 { f64::INFINITY } else { q / a }, if q == 0.0 { f64::INFINITY } else { c / q }];
    roots.into_iter().filter(|t| *t > 0.0).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_stops_where_a_face_loses_its_area() {
        let uv = [Vec2::zeros(), Vec2::x(), Vec2::y()];
        let step = [Vec2::zeros(), Vec2::zeros(), Vec2::new(0.0, -2.0)];
        assert_eq!(largest_flip_free_step(&[[0, 1, 2]], &uv, &step, |_| true), 0.5);
        assert_eq!(largest_flip_free_step(&[[0, 1, 2]], &uv, &step, |_| false), f64::INFINITY);
        assert_eq!(largest_flip_free_step(&[[0, 1, 2]], &uv, &[Vec2::x(); 3], |_| true), f64::INFINITY);
    }

    #[test]
    fn the_first_flip_is_found() {
        assert_eq!(smallest_positive_root(0.0, -2.0, 1.0), 0.5);
        assert_eq!(smallest_positive_root(0.0, 2.0, 1.0), f64::INFINITY);
        assert!((smallest_positive_root(1.0, -3.0, 2.0) - 1.0).abs() < 1e-15);
        assert_eq!(smallest_positive_root(1.0, 0.0, 1.0), f64::INFINITY);
        assert!((smallest_positive_root(1e-300, -1.0, 1.0) - 1.0).abs() < 1e-15);
    }
}
