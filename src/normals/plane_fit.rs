//! The plane through neighbouring points: normal, noise and curvature from their scatter.
//!
//! Reference: H. Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992,
//! doi:10.1145/133994.134011 (normal = eigenvector of the smallest eigenvalue of the scatter matrix); surface variation
//! from M. Pauly, M. Gross, L. P. Kobbelt, "Efficient simplification of point-sampled surfaces", IEEE Visualization
//! 2002, doi:10.1109/VISUAL.2002.1183771. Smallest eigenvalue by Laguerre's method (W. H. Press et al., *Numerical
//! Recipes*, 3rd edition, 2007, section 9.5.3); where two nearly meet, in closed form: O. K. Smith, "Eigenvalues of a
//! symmetric 3x3 matrix", CACM 4(4), 1961, doi:10.1145/355578.366316.

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
        self.add_offset((point - self.reference).into());
    }

    /// Adds a point by its offset from the reference.
    pub fn add_offset(&mut self, offset: [f64; 3]) {
        let d = Vec3::from(offset);
        self.count += 1.0;
        self.sum += d;
        let products = [d.x * d.x, d.x * d.y, d.x * d.z, d.y * d.y, d.y * d.z, d.z * d.z];
        for (square, product) in self.squares.iter_mut().zip(products) {
            *square += product;
        }
    }

    /// How what was added spreads; `None` for fewer than three points.
    pub fn spread(&self) -> Option<Spread> {
        if self.count < 3.0 {
            return None;
        }
        let share = self.count.recip();
        let mean = self.sum * share;
        let [xx, xy, xz, yy, yz, zz] = self.squares.map(|s| s * share);
        let (xx, yy, zz) = (xx - mean.x * mean.x, yy - mean.y * mean.y, zz - mean.z * mean.z);
        let (xy, xz, yz) = (xy - mean.x * mean.y, xz - mean.x * mean.z, yz - mean.y * mean.z);
        let matrix = [xx, xy, xz, yy, yz, zz];
        Some(Spread { centre: self.reference + mean, values: eigenvalues(&matrix), matrix, count: self.count })
    }
}

/// Covariance of points with its eigenvalues.
#[derive(Clone, Copy, Debug)]
pub(super) struct Spread {
    centre: Vec3,
    /// Entries xx, xy, xz, yy, yz, zz.
    matrix: [f64; 6],
    /// Ascending, square metres.
    values: [f64; 3],
    count: f64,
}

impl Spread {
    /// Mean square distance from the best plane, freed of its three parameters.
    pub fn noise_squared(&self) -> f64 {
        self.values[0].max(0.0) * self.count / (self.count - 3.0).max(1.0)
    }

    /// Middle over largest eigenvalue: near 0 when the points lie on a line.
    pub fn roundness(&self) -> f64 {
        if self.values[2] > 0.0 { self.values[1].max(0.0) / self.values[2] } else { 0.0 }
    }

    /// The best plane.
    pub fn plane(&self) -> Plane {
        let total: f64 = self.values.iter().sum();
        Plane {
            centre: self.centre,
            normal: smallest_eigenvector(&self.matrix, self.values[0]),
            noise_m: self.noise_squared().sqrt(),
            variation: if total > 0.0 { self.values[0].max(0.0) / total } else { 0.0 },
            roundness: self.roundness(),
        }
    }
}

/// Steps towards the smallest eigenvalue at most; two or three are enough for what is flat.
const STEPS: usize = 6;
/// Steps below this share of the middle eigenvalue are the last: the error left is about the third power.
const LAST_STEP: f64 = 1e-5;
/// Slope of the characteristic polynomial at its smallest root, over the squared trace, below which it is not exact.
const FLAT_POLYNOMIAL: f64 = 0.01;

/// Ascending eigenvalues of a covariance: a symmetric matrix that has no negative ones.
fn eigenvalues(matrix: &[f64; 6]) -> [f64; 3] {
    let [xx, xy, xz, yy, yz, zz] = *matrix;
    let trace = xx + yy + zz;
    let (minor_x, minor_y, minor_z) = (yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy);
    let minors = minor_x + minor_y + minor_z;
    let determinant = xx * minor_x - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
    // Laguerre's method from below the smallest root of the characteristic polynomial: a step triples the digits.
    let mut smallest = 0.0;
    let mut slope = minors;
    for _ in 0..STEPS {
        let height = ((smallest - trace) * smallest + minors) * smallest - determinant;
        let half_bend = 3.0 * smallest - trace;
        slope = (3.0 * smallest - 2.0 * trace) * smallest + minors;
        let root = (slope * slope - 3.0 * height * half_bend).max(0.0).sqrt();
        let step = 3.0 * height / (slope + 2.0 * root);
        smallest -= step;
        if !(step.abs() * trace > LAST_STEP * minors) {
            break;
        }
    }
    // Where two roots almost meet, the polynomial is flat and says little. Points in one place have no slope at all.
    if !(slope > FLAT_POLYNOMIAL * trace * trace) {
        return eigenvalues_by_angle(matrix);
    }
    let sum = trace - smallest;
    let product = minors - smallest * sum;
    let largest = (sum + (sum * sum - 4.0 * product).max(0.0).sqrt()) / 2.0;
    [smallest, sum - largest, largest]
}

/// Ascending eigenvalues of any symmetric matrix.
fn eigenvalues_by_angle(matrix: &[f64; 6]) -> [f64; 3] {
    let m = symmetric(matrix);
    let scale = m.amax();
    if scale <= 0.0 {
        return [0.0; 3];
    }
    let a = m / scale;
    let mean = a.trace() / 3.0;
    let off = a.m12 * a.m12 + a.m13 * a.m13 + a.m23 * a.m23;
    let spread = (a.m11 - mean).powi(2) + (a.m22 - mean).powi(2) + (a.m33 - mean).powi(2) + 2.0 * off;
    if spread <= 1e-28 {
        return [mean * scale; 3];
    }
    let p = (spread / 6.0).sqrt();
    let shifted = (a - Mat3::identity() * mean) / p;
    // 3 angles: a third of the arc cosine of half the determinant, taken by atan2 because that is accurate at the ends.
    let half = (shifted.determinant() / 2.0).clamp(-1.0, 1.0);
    let angle = (1.0 - half * half).max(0.0).sqrt().atan2(half) / 3.0;
    let largest = mean + 2.0 * p * angle.cos();
    let smallest = mean + 2.0 * p * (angle + std::f64::consts::TAU / 3.0).cos();
    [smallest, 3.0 * mean - largest - smallest, largest].map(|v| v * scale)
}

fn symmetric(matrix: &[f64; 6]) -> Mat3 {
    let [xx, xy, xz, yy, yz, zz] = *matrix;
    Mat3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz)
}

/// A unit eigenvector of the smallest eigenvalue of a covariance.
fn smallest_eigenvector(matrix: &[f64; 6], smallest: f64) -> Vec3 {
    let m = symmetric(matrix);
    let scale = m.trace();
    if !(scale > 0.0) {
        return Vec3::z();
    }
    // Rows of (A - smallest I) span the plane perpendicular to the eigenvector.
    let (a, by) = (m * scale.recip(), smallest / scale);
    let rows =
        [Vec3::new(a.m11 - by, a.m12, a.m13), Vec3::new(a.m12, a.m22 - by, a.m23), Vec3::new(a.m13, a.m23, a.m33 - by)];
    let crosses = [rows[0].cross(&rows[1]), rows[0].cross(&rows[2]), rows[1].cross(&rows[2])];
    let norms = crosses.map(|c| c.norm_squared());
    let best = if norms[0] >= norms[1] && norms[0] >= norms[2] {
        0
    } else if norms[1] >= norms[2] {
        1
    } else {
        2
    };
    if norms[best] < 1e-20 {
        // Two equal smallest eigenvalues (points on a line): any direction across it.
        let eigen = a.symmetric_eigen();
        return eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    }
    crosses[best] / norms[best].sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    fn entries(m: &Mat3) -> [f64; 6] {
        [m.m11, m.m12, m.m13, m.m22, m.m23, m.m33]
    }

    #[test]
    fn eigenvectors_match_nalgebra() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(9);
        for round in 0..4000 {
            let b = Mat3::from_fn(|_, _| random.random_range(-1.0..1.0));
            let scale = 10f64.powi(random.random_range(-8..8));
            // Flat and long spreads, some with eigenvalues that are nearly equal.
            let middle = [0.5, 0.2, 1.0][round % 3];
            let flatten = Mat3::from_diagonal(&Vec3::new(1.0, middle, middle * random.random_range(0.0..1.0)));
            let m = b * flatten * flatten * b.transpose() * scale;
            let values = eigenvalues(&entries(&m));
            let vector = smallest_eigenvector(&entries(&m), values[0]);
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
        let line = Mat3::from_diagonal(&Vec3::new(1.0, 0.0, 0.0));
        for m in [Mat3::zeros(), Mat3::identity(), line] {
            let m = entries(&m);
            assert!((smallest_eigenvector(&m, eigenvalues(&m)[0]).norm() - 1.0).abs() < 1e-12);
        }
        let across = smallest_eigenvector(&entries(&line), eigenvalues(&entries(&line))[0]);
        assert!(across.x.abs() < 1e-9);
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
        let plane = scatter.spread().unwrap().plane();
        let wanted = Vec3::new(-0.5, 0.0, 1.0).normalize();
        assert!(plane.normal.cross(&wanted).norm() < 1e-3);
        // Uniform noise over 0.02 m has 0.02 / sqrt(12) across z, less the slope's cosine along the normal.
        let sigma = 0.02 / 12f64.sqrt() * wanted.z;
        assert!((plane.noise_m / sigma - 1.0).abs() < 0.05);
    }
}
