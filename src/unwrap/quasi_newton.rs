//! The memory of a limited-memory quasi-Newton method (L-BFGS) over map coordinates: what [`super::relax`] and
//! [`super::arap`] turn their gradient into a step with.
//!
//! The first guess of the inverse Hessian is the caller's factored one; the last few steps correct it.
//!
//! References: J. Nocedal, "Updating quasi-Newton matrices with limited storage", Mathematics of Computation 35, 1980,
//! doi:10.1090/S0025-5718-1980-0572855-7; with a factored Laplacian as first guess: T. Liu, S. Bouaziz, L. Kavan,
//! "Quasi-Newton methods for real-time simulation of hyperelastic materials", ACM TOG 36(3), 2017, doi:10.1145/2990496.
//! Guarantees: sums add up in the same order on any number of threads. Cost: linear in the steps remembered.

use crate::numeric::Vec2;
use rayon::prelude::*;
use std::collections::VecDeque;

/// Steps that are remembered.
const REMEMBERED: usize = 6;
/// Faces or vertices handled in one go; fixed, so that sums add up in the same order on any number of threads.
pub(super) const CHUNK: usize = 8192;

/// A remembered step: displacement, change of the gradient, and their product.
struct Pair {
    step: Vec<Vec2>,
    change: Vec<Vec2>,
    curvature: f64,
}

/// The last steps.
#[derive(Default)]
pub(super) struct Memory {
    pairs: VecDeque<Pair>,
}

impl Memory {
    /// Forgets all steps. Returns whether there were any.
    pub fn forget(&mut self) -> bool {
        let any = !self.pairs.is_empty();
        self.pairs.clear();
        any
    }

    /// Remembers a step by the places and gradients at its two ends, if the energy is convex along it.
    pub fn remember(&mut self, ends: [&[Vec2]; 2], gradients: [&[Vec2]; 2]) {
        let difference = |[from, to]: [&[Vec2]; 2]| -> Vec<Vec2> {
            to.par_iter().with_min_len(CHUNK).zip(from).map(|(b, a)| b - a).collect()
        };
        let (step, change) = (difference(ends), difference(gradients));
        let curvature = dot(&step, &change);
        if curvature > 0.0 {
            if self.pairs.len() == REMEMBERED {
                self.pairs.pop_front();
            }
            self.pairs.push_back(Pair { step, change, curvature });
        }
    }

    /// The step against `gradient`: the two-loop recursion around `apply`, the first guess of the inverse Hessian.
    pub fn direction(&self, gradient: &[Vec2], apply: impl FnOnce(&[Vec2]) -> Vec<Vec2>) -> Vec<Vec2> {
        let mut q = gradient.to_vec();
        let mut shares = Vec::with_capacity(self.pairs.len());
        for pair in self.pairs.iter().rev() {
            let share = dot(&pair.step, &q) / pair.curvature;
            add(&mut q, &pair.change, -share);
            shares.push(share);
        }
        let mut r = apply(&q);
        for (pair, share) in self.pairs.iter().zip(shares.into_iter().rev()) {
            let back = dot(&pair.change, &r) / pair.curvature;
            add(&mut r, &pair.step, share - back);
        }
        r.par_iter_mut().with_min_len(CHUNK).for_each(|d| *d = -*d);
        r
    }
}

pub(super) fn dot(a: &[Vec2], b: &[Vec2]) -> f64 {
    let parts: Vec<f64> = a
        .par_chunks(CHUNK)
        .zip(b.par_chunks(CHUNK))
        .map(|(a, b)| a.iter().zip(b).map(|(p, q)| p.dot(q)).sum())
        .collect();
    parts.iter().sum()
}

fn add(to: &mut [Vec2], what: &[Vec2], times: f64) {
    to.par_iter_mut().with_min_len(CHUNK).zip(what).for_each(|(p, q)| *p += q * times);
}

/// `uv + length * direction`.
pub(super) fn advance(uv: &[Vec2], direction: &[Vec2], length: f64) -> Vec<Vec2> {
    uv.par_iter().with_min_len(CHUNK).zip(direction).map(|(p, d)| p + d * length).collect()
}

/// Sum of `value` over 0..count, in fixed chunks.
pub(super) fn chunked_sum(count: usize, value: impl Fn(usize) -> f64 + Sync) -> f64 {
    let parts: Vec<f64> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .map(|k| (k * CHUNK..((k + 1) * CHUNK).min(count)).map(&value).sum())
        .collect();
    parts.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quadratic_is_solved_in_a_few_steps() {
        // E = 1/2 sum w_i |x_i - t_i|^2 with unlike weights; the first guess is the identity.
        let target: Vec<Vec2> = (0..4).map(|i| Vec2::new(f64::from(i), 1.0)).collect();
        let weight = [1.0, 2.0, 4.0, 1.5];
        let gradient = |x: &[Vec2]| -> Vec<Vec2> { (0..4).map(|i| (x[i] - target[i]) * weight[i]).collect() };
        let mut memory = Memory::default();
        let mut x = vec![Vec2::zeros(); 4];
        let mut g = gradient(&x);
        for _ in 0..12 {
            let d = memory.direction(&g, |g| g.to_vec());
            // The exact length along a line.
            let hd: Vec<Vec2> = (0..4).map(|i| d[i] * weight[i]).collect();
            let curvature = dot(&d, &hd);
            if curvature == 0.0 {
                break;
            }
            let moved = advance(&x, &d, -dot(&g, &d) / curvature);
            let next = gradient(&moved);
            memory.remember([&x, &moved], [&g, &next]);
            (x, g) = (moved, next);
        }
        assert!(x.iter().zip(&target).all(|(p, q)| (p - q).norm() < 1e-9), "{x:?}");
        assert!(memory.forget() && !memory.forget());
    }
}
