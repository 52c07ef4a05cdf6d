//! Singular values of 2x2 matrices in closed form.
//!
//! Reference: J. Blinn, "Consider the lowly 2x2 matrix", IEEE Computer Graphics and Applications 16(2), 1996,
//! doi:10.1109/38.486688.

use super::Mat2;

/// Singular values `(s1, s2)` with `s1 >= |s2|`; `s2` carries the sign of the determinant, so it is negative
/// for a matrix that mirrors.
pub fn signed_singular_values(m: &Mat2) -> (f64, f64) {
    let (e, f) = ((m.m11 + m.m22) / 2.0, (m.m11 - m.m22) / 2.0);
    let (g, h) = ((m.m21 + m.m12) / 2.0, (m.m21 - m.m12) / 2.0);
    let (q, r) = (e.hypot(h), f.hypot(g));
    (q + r, q - r)
}

/// The rotation closest to `m` (Frobenius norm): the orthogonal polar factor restricted to determinant +1.
/// Returns the identity for a zero matrix.
pub fn closest_rotation(m: &Mat2) -> Mat2 {
    let (c, s) = (m.m11 + m.m22, m.m21 - m.m12);
    let n = c.hypot(s);
    if n == 0.0 { Mat2::identity() } else { Mat2::new(c / n, -s / n, s / n, c / n) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn singular_values_match_nalgebra() {
        for m in [Mat2::new(1.0, 2.0, 3.0, 4.0), Mat2::new(-0.5, 0.1, 7.0, 2.0), Mat2::new(1.0, 1.0, 1.0, 1.0)] {
            let (s1, s2) = signed_singular_values(&m);
            let reference = m.svd(false, false).singular_values;
            assert!((s1 - reference[0]).abs() < 1e-12 && (s2.abs() - reference[1]).abs() < 1e-12);
            assert!((s1 * s2 - m.determinant()).abs() < 1e-12);
        }
    }

    #[test]
    fn closest_rotation_recovers_a_rotation() {
        let (s, c) = 0.7_f64.sin_cos();
        let rotation = Mat2::new(c, -s, s, c);
        assert!((closest_rotation(&(rotation * 3.0)) - rotation).norm() < 1e-15);
    }
}
