//! A smooth curve through noisy, evenly spaced centres, as stiff as the centres allow.
//!
//! Minimises `sum w_i |y_i - z_i|^2 + lambda sum |third difference of z|^2` (P. H. C. Eilers, "A perfect smoother",
//! Analytical Chemistry 75(14), 2003, doi:10.1021/ac034173t; third differences, so that straight lines and evenly
//! curved bends are not pulled in at all). `lambda` is written as a wavelength: `lambda = (wavelength / (2 pi h))^6`,
//! waves of the centres that are shorter are damped, longer ones are kept.
//!
//! The relief of rock moves neighbouring centres alike, so ordinary cross-validation would follow it. Here whole blocks
//! longer than the relief are left out and predicted; the stiffest curve within one standard error of the best
//! prediction is taken (block cross-validation: P. Burman, E. Chow, D. Nolan, Biometrika 81(2), 1994,
//! doi:10.1093/biomet/81.2.351). Weights are then lowered where a centre is far off (Tukey's biweight).

use crate::numeric::Vec3;
use crate::numeric::statistics::median;
use rayon::prelude::*;

/// Wavelengths tried, as multiples of the block; the last one is a straight line. The one before it bends like a
/// parabola, which a piece of tunnel hardly longer than wide would follow into any niche.
const WAVELENGTHS: [f64; 10] = [1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 14.0, 24.0, 60.0, f64::INFINITY];
/// With fewer blocks than this, only the parabola and the line are tried; with fewer than two, the line is taken.
const FEW_BLOCKS: usize = 4;
/// Rounds of lowering the weights of far-off centres.
const ROUNDS: usize = 4;
/// Tukey's constant: centres beyond this many standard deviations count nothing.
const TUKEY: f64 = 4.685;

/// What came out.
pub(super) struct Smoothed {
    pub curve: Vec<Vec3>,
    /// Wavelength below which the centres' waves were taken for noise, metres.
    pub wavelength_m: f64,
    /// Median distance between centres and curve, metres.
    pub residual_m: f64,
}

/// Smooths `centres` at even steps of `step_m` with `weights` (zero: nothing known there). `block_m` is the length
/// over which errors of the centres hang together; differences of prediction below `tolerance_m` do not matter.
pub(super) fn smooth(centres: &[Vec3], weights: &[f64], step_m: f64, block_m: f64, tolerance_m: f64) -> Smoothed {
    let n = centres.len();
    let block = ((block_m / step_m).ceil() as usize).max(1);
    let stiffness = |multiple: f64| (multiple * block_m / (std::f64::consts::TAU * step_m)).powi(6);
    let mut robust = weights.to_vec();
    let mut chosen = WAVELENGTHS[WAVELENGTHS.len() - 1];
    let mut curve = solve(centres, &robust, stiffness(chosen));
    let mut residual_m = 0.0;
    for _ in 0..ROUNDS {
        chosen = choose(centres, &robust, block, &stiffness, tolerance_m);
        curve = solve(centres, &robust, stiffness(chosen));
        let gaps: Vec<f64> = centres.iter().zip(&curve).map(|(y, z)| (y - z).norm()).collect();
        let mut known: Vec<f64> = (0..n).filter(|&i| weights[i] > 0.0).map(|i| gaps[i]).collect();
        residual_m = median(&mut known).unwrap_or(0.0);
        let limit = TUKEY * 1.4826 * residual_m.max(1e-9);
        for i in 0..n {
            let x = (gaps[i] / limit).min(1.0);
            robust[i] = weights[i] * (1.0 - x * x).powi(2).max(1e-6);
        }
    }
    Smoothed { curve, wavelength_m: chosen * block_m, residual_m }
}

/// The stiffest of the wavelengths whose prediction of left-out blocks is within one standard error (or the tolerance)
/// of the best.
fn choose(
    centres: &[Vec3],
    weights: &[f64],
    block: usize,
    stiffness: &(impl Fn(f64) -> f64 + Sync),
    tolerance_m: f64,
) -> f64 {
    let n = centres.len();
    let blocks = n.div_ceil(block);
    let known = |b: usize| weights[b * block..((b + 1) * block).min(n)].iter().any(|w| *w > 0.0);
    let blocks_known = (0..blocks).filter(|&b| known(b)).count();
    if blocks_known < 2 {
        return f64::INFINITY;
    }
    let tried = if blocks_known < FEW_BLOCKS { &WAVELENGTHS[WAVELENGTHS.len() - 2..] } else { &WAVELENGTHS[..] };
    let scores: Vec<(f64, f64)> = tried
        .par_iter()
        .map(|&multiple| {
            let errors: Vec<f64> = (0..blocks)
                .filter_map(|b| {
                    let left_out = b * block..((b + 1) * block).min(n);
                    let mut without = weights.to_vec();
                    without[left_out.clone()].fill(0.0);
                    let total: f64 = left_out.clone().map(|i| weights[i]).sum();
                    if total <= 0.0 || without.iter().filter(|w| **w > 0.0).count() < 4 {
                        return None;
                    }
                    let predicted = solve(centres, &without, stiffness(multiple));
                    Some(left_out.map(|i| weights[i] * (centres[i] - predicted[i]).norm()).sum::<f64>() / total)
                })
                .collect();
            // What cannot be predicted at all is no choice.
            if errors.is_empty() || errors.iter().any(|e| !e.is_finite()) {
                return (f64::INFINITY, 0.0);
            }
            let count = errors.len() as f64;
            let mean = errors.iter().sum::<f64>() / count;
            let variance = errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / count;
            (mean, (variance / count).sqrt())
        })
        .collect();
    let best = (0..scores.len()).min_by(|&a, &b| scores[a].0.total_cmp(&scores[b].0)).expect("wavelengths");
    let limit = scores[best].0 + scores[best].1.max(tolerance_m);
    let stiffest = (0..scores.len()).rev().find(|&i| scores[i].0 <= limit).unwrap_or(best);
    tried[stiffest]
}

/// Solves `(W + lambda D'D) z = W y` by a banded Cholesky factorisation (three bands beside the diagonal).
fn solve(centres: &[Vec3], weights: &[f64], lambda: f64) -> Vec<Vec3> {
    let n = centres.len();
    if n < 4 {
        return centres.to_vec();
    }
    if lambda.is_infinite() {
        return straight(centres, weights);
    }
    // Rows: diagonal, first, second, third band below it.
    let mut band = vec![[0.0; 4]; n];
    let total: f64 = weights.iter().sum();
    for i in 0..n {
        // A trace of weight everywhere keeps the matrix definite when few centres are known.
        band[i][0] = weights[i] + 1e-12 * total.max(1e-300);
    }
    let difference = [-1.0, 3.0, -3.0, 1.0];
    for start in 0..n - 3 {
        for a in 0..4 {
            for b in 0..=a {
                band[start + a][a - b] += lambda * difference[a] * difference[b];
            }
        }
    }
    let mut z: Vec<Vec3> = centres.iter().zip(weights).map(|(y, w)| y * *w).collect();
    for i in 0..n {
        // A stiff curve held by few centres is nearly singular; a pivot lost to rounding must not become an infinity.
        let least_pivot = 1e-14 * band[i][0];
        for k in (0..=3.min(i)).rev() {
            let j = i - k;
            let mut sum = band[i][k];
            for m in (k + 1)..=3.min(i) {
                // Entries L[i][i-m] L[j][i-m] where the second exists.
                if m - k <= 3 && i >= m {
                    sum -= band[i][m] * band[j][m - k];
                }
            }
            band[i][k] = if k == 0 { sum.max(least_pivot).sqrt() } else { sum / band[j][0] };
        }
        for m in 1..=3.min(i) {
            let before = z[i - m];
            z[i] -= before * band[i][m];
        }
        z[i] /= band[i][0];
    }
    for i in (0..n).rev() {
        for m in 1..=3.min(n - 1 - i) {
            let after = z[i + m];
            z[i] -= after * band[i + m][m];
        }
        z[i] /= band[i][0];
    }
    z
}

/// The line of least squares, at even steps.
fn straight(centres: &[Vec3], weights: &[f64]) -> Vec<Vec3> {
    let total: f64 = weights.iter().sum();
    if !(total > 0.0) {
        return centres.to_vec();
    }
    let mean_at = weights.iter().enumerate().map(|(i, w)| w * i as f64).sum::<f64>() / total;
    let mean = centres.iter().zip(weights).map(|(y, w)| y * *w).sum::<Vec3>() / total;
    let (mut slope, mut spread) = (Vec3::zeros(), 0.0);
    for (i, (y, w)) in centres.iter().zip(weights).enumerate() {
        let t = i as f64 - mean_at;
        slope += (y - mean) * (w * t);
        spread += w * t * t;
    }
    // One known place alone has no slope; the centres' own steps do.
    let last = centres.len() - 1;
    let slope = if spread > 0.0 { slope / spread } else { (centres[last] - centres[0]) / last as f64 };
    (0..centres.len()).map(|i| mean + slope * (i as f64 - mean_at)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    #[test]
    fn parabolas_pass_unchanged() {
        let centres: Vec<Vec3> =
            (0..50).map(|i| i as f64).map(|t| Vec3::new(t, 0.01 * t * t, 1.0 - 0.002 * t * t)).collect();
        let out = smooth(&centres, &vec![1.0; 50], 1.0, 5.0, 0.0);
        for (a, b) in out.curve.iter().zip(&centres) {
            assert!((a - b).norm() < 1e-6, "{a:?} {b:?}");
        }
    }

    #[test]
    fn a_short_piece_with_bulging_ends_stays_straight() {
        // Ends that pull the centres down by a tenth of the length, as slices half outside a portal do.
        let centres: Vec<Vec3> =
            (0..16).map(|i| Vec3::new(i as f64 * 0.5, 0.0, if (2..14).contains(&i) { 0.0 } else { -0.8 })).collect();
        let out = smooth(&centres, &[1.0; 16], 0.5, 5.0, 0.03);
        let slope = (out.curve[15] - out.curve[0]).z.abs() / 7.5;
        let sag = (out.curve[0] + out.curve[15] - out.curve[8] * 2.0).z.abs();
        assert!(slope < 1e-9 && sag < 0.1, "{sag} m at {} m", out.wavelength_m);
    }

    #[test]
    fn few_known_centres_give_a_finite_curve() {
        let centres: Vec<Vec3> = (0..60).map(|i| Vec3::new(i as f64 * 0.5, 0.0, 0.0)).collect();
        let weights: Vec<f64> = (0..60).map(|i| if (20..26).contains(&i) { 1e-6 } else { 0.0 }).collect();
        let out = smooth(&centres, &weights, 0.5, 9.0, 0.02);
        assert!(out.curve.iter().all(|p| p.iter().all(|c| c.is_finite())));
    }

    #[test]
    fn relief_goes_and_a_bend_stays() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(2);
        // Straight, then a bend of 40 m radius, then straight again; relief of 0.1 m correlated over 4 m.
        let n = 240;
        let heading = |s: f64| ((s - 40.0).clamp(0.0, 40.0)) / 40.0;
        let mut truth = vec![Vec3::zeros()];
        for i in 1..n {
            let h = heading(i as f64 * 0.5);
            let last = truth[i - 1];
            truth.push(last + Vec3::new(h.cos(), h.sin(), 0.0) * 0.5);
        }
        let knots: Vec<f64> = (0..n / 8 + 2).map(|_| random.random_range(-0.1..0.1)).collect();
        let noisy: Vec<Vec3> = (0..n)
            .map(|i| {
                let (k, f) = (i / 8, (i % 8) as f64 / 8.0);
                truth[i] + Vec3::new(0.0, knots[k] * (1.0 - f) + knots[k + 1] * f, 0.0)
            })
            .collect();
        let mut weights = vec![1.0; n];
        weights[100..110].fill(0.0);
        let out = smooth(&noisy, &weights, 0.5, 12.0, 0.02);
        let worst = out.curve.iter().zip(&truth).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
        assert!(worst < 0.2, "{worst} m off at wavelength {} m", out.wavelength_m);
        let rms = (out.curve.iter().zip(&truth).map(|(a, b)| (a - b).norm_squared()).sum::<f64>() / n as f64).sqrt();
        assert!(rms < 0.06, "{rms}");
    }

    #[test]
    fn a_wild_centre_is_ignored() {
        let mut centres: Vec<Vec3> = (0..60).map(|i| Vec3::new(i as f64, 0.0, 0.0)).collect();
        centres[30].y = 5.0;
        let out = smooth(&centres, &vec![1.0; 60], 1.0, 6.0, 0.0);
        assert!(out.curve[30].y.abs() < 1e-3, "{}", out.curve[30].y);
    }
}
