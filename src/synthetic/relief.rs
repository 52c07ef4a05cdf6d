//! Rough walls: a fractal height over the smooth section, deterministic for a seed.
//!
//! The height is a sum of gradient noise (K. Perlin, "Improving noise", ACM TOG 21(3), 2002,
//! doi:10.1145/566654.566636), folded noise for the creases of blocky rock, and the saw tooth of blast rounds that
//! every drilled and blasted tunnel shows. Noise is taken at section coordinates (chainage, right, up), so the wall
//! closes around the section without a step.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Share of each blast round in which the wall falls back to the drill line.
const ROUND_STEP: f64 = 0.06;

/// Gradient noise over 3D space, about -1 to 1, with features of size 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Noise {
    permutation: Vec<u8>,
}

impl Noise {
    /// The noise field of a seed; fields of different `stream` are independent.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(u64::MAX - stream);
        let mut permutation: Vec<u8> = (0..=255).collect();
        for i in (1..256).rev() {
            permutation.swap(i, random.random_range(0..=i));
        }
        permutation.extend_from_within(..);
        Self { permutation }
    }

    /// Value at a point.
    pub fn at(&self, p: [f64; 3]) -> f64 {
        let cell = p.map(f64::floor);
        let [x, y, z] = [p[0] - cell[0], p[1] - cell[1], p[2] - cell[2]];
        // Wraps every 256 cells, longer than any section; only very long tunnels repeat.
        let [i, j, k] = cell.map(|c| (c as i64 & 255) as usize);
        let fade = |t: f64| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
        let [u, v, w] = [fade(x), fade(y), fade(z)];
        let t = &self.permutation;
        let hash =
            |a: usize, b: usize, c: usize| t[t[t[(i + a) & 255] as usize + ((j + b) & 255)] as usize + ((k + c) & 255)];
        let lerp = |a: f64, b: f64, t: f64| a + t * (b - a);
        let edge = |b: usize, c: usize| {
            let (yb, zc) = (y - b as f64, z - c as f64);
            lerp(slope(hash(0, b, c), x, yb, zc), slope(hash(1, b, c), x - 1.0, yb, zc), u)
        };
        lerp(lerp(edge(0, 0), edge(1, 0), v), lerp(edge(0, 1), edge(1, 1), v), w)
    }

    /// Octaves of noise, each half the size and half the height of the one before; about -1 to 1.
    pub fn fractal(&self, p: [f64; 3], octaves: usize) -> f64 {
        let (mut sum, mut amplitude, mut q) = (0.0, 0.5, p);
        for _ in 0..octaves {
            sum += amplitude * self.at(q);
            amplitude *= 0.5;
            // An offset keeps the lattice points of the octaves apart.
            q = q.map(|c| 2.0 * c + 17.3);
        }
        2.0 * sum
    }
}

/// Dot product with one of the twelve edge directions of a cube.
fn slope(hash: u8, x: f64, y: f64, z: f64) -> f64 {
    let h = hash & 15;
    let u = if h < 8 { x } else { y };
    let v = if h < 4 {
        y
    } else if h == 12 || h == 14 {
        x
    } else {
        z
    };
    (if h & 1 == 0 { u } else { -u }) + (if h & 2 == 0 { v } else { -v })
}

/// How rough the walls are.
#[derive(Clone, Debug, PartialEq)]
pub struct Relief {
    /// Typical height of the roughness, metres.
    pub amplitude_m: f64,
    /// Size of the largest bumps, metres.
    pub wavelength_m: f64,
    /// Length of a blast round, metres; 0 for none.
    pub round_m: f64,
    /// How far the drill holes look out at the end of a round, metres.
    pub lookout_m: f64,
    noise: Noise,
}

impl Relief {
    /// Rock of a given roughness; drilled and blasted when it is rough enough for that (above 2 cm).
    pub fn rock(amplitude_m: f64, seed: u64) -> Self {
        let blasted = amplitude_m > 0.02;
        Self {
            amplitude_m,
            wavelength_m: 2.4,
            round_m: if blasted { 3.2 } else { 0.0 },
            lookout_m: if blasted { 1.2 * amplitude_m } else { 0.0 },
            noise: Noise::new(seed, 1),
        }
    }

    /// Height into the rock at section coordinates (chainage, right, up), metres.
    pub fn height(&self, chainage: f64, right: f64, up: f64) -> f64 {
        let p = [chainage, right, up].map(|c| c / self.wavelength_m);
        let bumps = self.noise.fractal(p, 6);
        let folded = p.map(|c| 1.7 * c + 91.7);
        let creases = 0.6 - 2.0 * self.noise.at(folded).abs() - self.noise.at(folded.map(|c| 2.1 * c)).abs();
        let mut height = self.amplitude_m * (0.8 * bumps + 0.7 * creases);
        if self.round_m > 0.0 {
            // The face of a round is not quite a plane.
            let warp = 0.12 * self.noise.at(p.map(|c| 0.9 * c + 5.1));
            let phase = ((chainage + warp) / self.round_m).rem_euclid(1.0);
            let tooth = if phase < 1.0 - ROUND_STEP { phase / (1.0 - ROUND_STEP) } else { (1.0 - phase) / ROUND_STEP };
            height += self.lookout_m * (tooth - 0.5);
        }
        height
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_bounded_and_depends_on_the_seed() {
        let (a, b) = (Noise::new(1, 0), Noise::new(2, 0));
        let mut differs = false;
        for i in 0..2000 {
            let p = [i as f64 * 0.137, i as f64 * 0.071 - 40.0, 3.3];
            assert!(a.at(p).abs() <= 1.2);
            assert!((a.at(p) - a.at([p[0] + 1e-7, p[1], p[2]])).abs() < 1e-6);
            differs |= (a.at(p) - b.at(p)).abs() > 0.1;
        }
        assert!(differs);
        assert_eq!(a.at([5.0, -3.0, 8.0]), 0.0, "gradient noise vanishes on the lattice");
    }

    #[test]
    fn roughness_has_the_stated_size() {
        let relief = Relief::rock(0.05, 7);
        let heights: Vec<f64> =
            (0..4000).map(|i| relief.height(i as f64 * 0.0713, (i as f64 * 0.39).sin() * 2.0, 1.0)).collect();
        let mean = heights.iter().sum::<f64>() / 4000.0;
        let rms = (heights.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / 4000.0).sqrt();
        assert!((0.015..0.06).contains(&rms), "{rms}");
        assert!(mean.abs() < 0.02, "{mean}");
    }
}
