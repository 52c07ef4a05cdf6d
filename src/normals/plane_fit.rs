//! The plane through neighbouring points: normal, noise and curvature from their scatter.
//!
//! Reference: H. Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992,
//! doi:10.1145/133994.134011 (normal = eigenvector of the smallest eigenvalue of the scatter matrix); surface variation
//! from M. Pauly, M. Gross, L. P. Kobbelt, "Efficient simplification of point-sampled surfaces", IEEE Visualization
//! 2002, doi:10.1109/VISUAL.2002.1183771. Eigenvalues in closed form: O. K. Smith, "Eigenvalues of a symmetric 3x3
//! matrix", CACM 4(4), 1961, doi:10.1145/355578.366316.

use crate::numeric::{Mat3, Vec3};

/// A plane fitted to points.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plane {
    pub centre: Vec3,
    pub normal: Vec3,
    /// Root mean square distance of the points from the plane, freed of the three parameters that were fitted.
    pub noise_m: f64,
    /// Surface variation: smallest eigenvalue over the sum of all, 0 (flat) to 1/3.
    pub variation: f64,
    /// Middle over largest eigenvalue: near 0 when the points lie on a line.
    pub roundness: f64,
}

/// Sums from which planes are fitted; points can be added in turn.
#[derive(Clone, Copy)]
pub(super) struct Scatter {
    /// Sums are taken about this point, so that they stay small.
    reference: Vec3,
    count: f64,
    sum: Vec3,
    squares: [f64; 6],
}

impl Scatter {
    pub fn about(reference: Vec3) -> Self {
        Self { reference, count: 0.0, sum: Vec3::zeros(), squares: [0.0; 6] }
    }

    pub fn add(&mut self, point: &Vec3) {
        let d = point - self.reference;
        self.count += 1.0;
        self.sum += d;
        let products = [d.x * d.x, d.x * d.y, d.x * d.z, d.y * d.y, d.y * d.z, d.z * d.z];
        for (square, product) in self.squares.iter_mut().zip(products) {
            *square += product;
        }
    }

    /// The best plane of what was added; `None` for fewer than three points.
    pub fn plane(&self) -> Option<Plane> {
        if self.count < 3.0 {
            return None;
        }
        let mean = self.sum / self.count;
        let [xx, xy, xz, yy, yz, zz] = self.squares.map(|s| s / self.count);
        let matrix = Mat3::new(
            xx - mean.x * mean.x,
            xy - mean.x * mean.y,
            xz - mean.x * mean.z,
            xy - mean.x * mean.y,
            yy - mean.y * mean.y,
            yz - mean.y * mean.z,
            xz - mean.x * mean.z,
            yz - mean.y * mean.z,
            zz - mean.z * mean.z,
        );
        let (values, normal) = smallest_eigenvector(&matrix);
        let total = values[0] + values[1] + values[2];
        let freedom = (self.count - 3.0).max(1.0) / self.count;
        Some(Plane {
            centre: self.reference + mean,
            normal,
            noise_m: (values[0].max(0.0) / freedom).sqrt(),
            variation: if total > 0.0 { values[0].max(0.0) / total } else { 0.0 },
            roundness: if values[2] > 0.0 { values[1].max(0.0) / values[2] } else { 0.0 },
        })
    }
}

/// Ascending eigenvalues of a symmetric matrix and a unit eigenvector of the smallest.
pub(super) fn smallest_eigenvector(m: &Mat3) -> ([f64; 3], Vec3) {
    let scale = m.amax();
    if scale <= 0.0 {
        return ([0.0; 3], Vec3::z());
    }
    let a = m / scale;
    let mean = a.trace() / 3.0;
    let off = a.m12 * a.m12 + a.m13 * a.m13 + a.m23 * a.m23;
    let spread = (a.m11 - mean).powi(2) + (a.m22 - mean).powi(2) + (a.m33 - mean).powi(2) + 2.0 * off;
    if spread <= 1e-28 {
        return ([mean * scale; 3], Vec3::z());
    }
    let p = (spread / 6.0).sqrt();
    let shifted = (a - Mat3::identity() * mean) / p;
    // 3 angles: a third of the arc cosine of half the determinant, taken by atan2 because that is accurate at the ends.
    let half = (shifted.determinant() / 2.0).clamp(-1.0, 1.0);
    let angle = (1.0 - half * half).max(0.0).sqrt().atan2(half) / 3.0;
    let largest = mean + 2.0 * p * angle.cos();
    let smallest = mean + 2.0 * p * (angle + std::f64::consts::TAU / 3.0).cos();
    let middle = 3.0 * mean - largest - smallest;
    // Rows of (A - smallest I) span the plane perpendicular to the eigenvector.
    let b = a - Mat3::identity() * smallest;
    let rows = [Vec3::new(b.m11, b.m12, b.m13), Vec3::new(b.m21, b.m22, b.m23), Vec3::new(b.m31, b.m32, b.m33)];
    let crosses = [rows[0].cross(&rows[1]), rows[0].cross(&rows[2]), rows[1].cross(&rows[2])];
    let norms = crosses.map(|c| c.norm_squared());
    let best = if norms[0] >= norms[1] && norms[0] >= norms[2] {
        0
    } else if norms[1] >= norms[2] {
        1
    } else {
        2
    };
    let values = [smallest * scale, middle * scale, largest * scale];
    if norms[best] < 1e-20 {
        // Two equal smallest eigenvalues (points on a line): any direction across it.
        let eigen = a.symmetric_eigen();
        return (values, eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned());
    }
    (values, crosses[best] / norms[best].sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    #[test]
    fn eigenvectors_match_nalgebra() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(9);
        for _ in 0..2000 {
            let b = Mat3::from_fn(|_, _| random.random_range(-1.0..1.0));
            let scale = 10f64.powi(random.random_range(-8..8));
            let flatten = Mat3::from_diagonal(&Vec3::new(1.0, 0.5, random.random_range(0.0..0.1)));
            let m = b * flatten * flatten * b.transpose() * scale;
            let (values, vector) = smallest_eigenvector(&m);
            let mut wanted: Vec<f64> = m.symmetric_eigenvalues().iter().copied().collect();
            wanted.sort_unstable_by(f64::total_cmp);
            for (a, b) in values.iter().zip(&wanted) {
                assert!((a - b).abs() < 1e-12 * wanted[2].abs() + 1e-15 * scale, "{values:?} {wanted:?}");
            }
            assert!((m * vector - vector * values[0]).norm() < 1e-7 * wanted[2]);
        }
    }

    #[test]
    fn degenerate_scatters_still_give_a_unit_vector() {
        for m in [Mat3::zeros(), Mat3::identity(), Mat3::from_diagonal(&Vec3::new(1.0, 0.0, 0.0))] {
            assert!((smallest_eigenvector(&m).1.norm() - 1.0).abs() < 1e-12);
        }
        let line = smallest_eigenvector(&Mat3::from_diagonal(&Vec3::new(1.0, 0.0, 0.0))).1;
        assert!(line.x.abs() < 1e-9);
    }

    #[test]
    fn plane_of_a_noisy_plane() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let mut scatter = Scatter::about(Vec3::new(1e5, 2e5, 50.0));
        for _ in 0..2000 {
            let (x, y) = (random.random_range(-1.0..1.0), random.random_range(-1.0..1.0));
            let noise: f64 = random.random_range(-0.01..0.01);
            scatter.add(&Vec3::new(1e5 + x, 2e5 + y, 50.0 + 0.5 * x + noise));
        }
        let plane = scatter.plane().unwrap();
        let wanted = Vec3::new(-0.5, 0.0, 1.0).normalize();
        assert!(plane.normal.cross(&wanted).norm() < 1e-3);
        // Uniform noise over 0.02 m has 0.02 / sqrt(12) across z, less the slope's cosine along the normal.
        let sigma = 0.02 / 12f64.sqrt() * wanted.z;
        assert!((plane.noise_m / sigma - 1.0).abs() < 0.05);
    }
}
