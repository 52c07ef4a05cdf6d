//! Preconditioned conjugate gradients for symmetric positive definite systems that are close to one already factored.
//!
//! Use it when the matrix changes a little from one solve to the next: a few products and solves with the old factor
//! cost less than a new factorization. It gives up after a set number of steps, and tells so.
//!
//! Reference: M. R. Hestenes, E. Stiefel, "Methods of conjugate gradients for solving linear systems", Journal of
//! Research of the National Bureau of Standards 49(6), 1952, doi:10.6028/jres.049.044.
//! Guarantees: sums add up in the same order on any number of threads. Cost: a product and a preconditioning a step.

use rayon::prelude::*;

/// Entries summed in one go; fixed, so that sums have the same bytes on any number of threads.
const CHUNK: usize = 16_384;

/// What the iterations ended with.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// The solution reached.
    pub x: Vec<f64>,
    /// Steps done.
    pub steps: usize,
    /// Whether the residual fell to the wanted share; false also when the matrix is not positive definite.
    pub converged: bool,
}

/// Solves `A x = right` from zero until the residual, measured by the preconditioner, is at most `share` of the first one.
pub fn solve(
    multiply: impl Fn(&[f64]) -> Vec<f64>,
    precondition: impl Fn(&[f64]) -> Vec<f64>,
    right: &[f64],
    share: f64,
    most_steps: usize,
) -> Outcome {
    let mut x = vec![0.0; right.len()];
    let mut r = right.to_vec();
    let mut z = precondition(&r);
    let mut p = z.clone();
    let mut rz = dot(&r, &z);
    let goal = rz * share * share;
    if rz == 0.0 {
        return Outcome { x, steps: 0, converged: true };
    }
    for steps in 1..=most_steps {
        let ap = multiply(&p);
        let curvature = dot(&p, &ap);
        if !(curvature > 0.0) {
            return Outcome { x, steps, converged: false };
        }
        let length = rz / curvature;
        add(&mut x, &p, length);
        add(&mut r, &ap, -length);
        z = precondition(&r);
        let next = dot(&r, &z);
        if next <= goal {
            return Outcome { x, steps, converged: true };
        }
        let turn = next / rz;
        rz = next;
        p.par_iter_mut().with_min_len(CHUNK).zip(&z).for_each(|(p, z)| *p = z + *p * turn);
    }
    Outcome { x, steps: most_steps, converged: false }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    let parts: Vec<f64> =
        a.par_chunks(CHUNK).zip(b.par_chunks(CHUNK)).map(|(a, b)| a.iter().zip(b).map(|(p, q)| p * q).sum()).collect();
    parts.iter().sum()
}

fn add(to: &mut [f64], what: &[f64], times: f64) {
    to.par_iter_mut().with_min_len(CHUNK).zip(what).for_each(|(p, q)| *p += q * times);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matrix(x: &[f64]) -> Vec<f64> {
        vec![4.0 * x[0] + x[1], x[0] + 3.0 * x[1] - x[2], -x[1] + 5.0 * x[2]]
    }

    #[test]
    fn three_unknowns_take_three_steps() {
        let right = matrix(&[1.0, -2.0, 0.5]);
        let outcome = solve(matrix, |r| r.to_vec(), &right, 1e-12, 4);
        assert!(outcome.converged && outcome.steps <= 4, "{outcome:?}");
        for (x, wanted) in outcome.x.iter().zip([1.0, -2.0, 0.5]) {
            assert!((x - wanted).abs() < 1e-12);
        }
    }

    #[test]
    fn too_few_steps_and_a_bad_matrix_are_told() {
        let right = matrix(&[1.0, -2.0, 0.5]);
        assert!(!solve(matrix, |r| r.to_vec(), &right, 1e-12, 1).converged);
        assert!(!solve(|x| x.iter().map(|v| -v).collect(), |r| r.to_vec(), &right, 1e-12, 5).converged);
        assert!(solve(matrix, |r| r.to_vec(), &[0.0; 3], 1e-12, 5).converged);
    }
}
