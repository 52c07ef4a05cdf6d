//! The cage of the deformation methods: a regular grid over the section chart that carries smooth fields and bounded
//! biharmonic weights.
//!
//! A tunnel's surface is two-dimensional, so its cage is too. Values live at the nodes and are bilinear in between.
//!
//! | symbol | meaning |
//! |---|---|
//! | `L` | five-point Laplacian, natural at the ends (no flow across) |
//! | `Q = L^T L` | biharmonic form: free only for constants |
//! | `N` | squared second differences along and around, free for everything bilinear: it does not bend ends over |
//!
//! References: A. Jacobson, I. Baran, J. Popović, O. Sorkine, "Bounded Biharmonic Weights for Real-Time Deformation", ACM
//! Transactions on Graphics 30(4), 2011, doi:10.1145/2010324.1964973; P. Eilers, B. Marx, "Flexible smoothing with
//! B-splines and penalties", Statistical Science 11(2), 1996, doi:10.1214/ss/1038425655 (smoothing by a penalty on
//! differences). Departure: weights are found by an active set on the grid instead of a quadratic program on tetrahedra.
//! Cost: one small sparse factorization a field, one a round and weight.

use crate::numeric::Vec2;
use crate::numeric::sparse::{Analysis, Cholesky, Error, Pattern};

/// Cells around the tunnel and, at that many girths, along it: 0.25 m by 1 m in a road tunnel of 25 m girth.
const CELLS_OF_GIRTH: [f64; 2] = [25.0, 100.0];
/// Nodes at most; cells grow beyond.
const MOST_NODES: f64 = 12_000.0;
/// Rounds of the active set at most; few are usual.
const MOST_ROUNDS: usize = 30;

/// A regular grid over the section chart: rows along the tunnel, columns around it.
pub(super) struct Cage {
    pub low: Vec2,
    pub step: Vec2,
    pub rows: usize,
    pub columns: usize,
    pattern: Pattern,
    analysis: Analysis,
}

/// A value to be met at a place of the chart, with its weight (square metres, or any other unit alike for all).
pub(super) struct Sample {
    pub place: Vec2,
    pub weight: f64,
    pub value: Vec2,
}

/// Bounded biharmonic weights.
pub(super) struct Weights {
    /// For each handle its weight at each node; they sum to one at each node.
    pub of: Vec<Vec<f64>>,
    /// Rounds of the active set that the slowest weight needed.
    pub rounds: usize,
    /// Weights whose bounds were still changing at the end and were cut off.
    pub unsettled: usize,
}

impl Cage {
    /// A cage over the places.
    pub fn over(places: impl Iterator<Item = Vec2> + Clone) -> Result<Self, Error> {
        let low = places.clone().fold(Vec2::repeat(f64::INFINITY), |b, p| b.inf(&p));
        let high = places.fold(Vec2::repeat(f64::NEG_INFINITY), |b, p| b.sup(&p));
        let extent = (high - low).map(|d| if d > 0.0 { d } else { 1.0 });
        let wanted = Vec2::from(CELLS_OF_GIRTH).component_mul(&(extent / extent.y));
        let grow = (wanted.x * wanted.y / MOST_NODES).sqrt().max(1.0);
        let cells = wanted.map(|c| (c / grow).ceil().max(3.0));
        let (rows, columns) = (cells.x as usize + 1, cells.y as usize + 1);
        let pattern = Pattern::of_pairs(rows * columns, || neighbours(rows, columns))?;
        let analysis = Analysis::new(&pattern)?;
        Ok(Self { low, step: extent.component_div(&cells), rows, columns, pattern, analysis })
    }

    /// Number of nodes.
    pub fn nodes(&self) -> usize {
        self.rows * self.columns
    }

    /// The four nodes around a place in the chart and their bilinear weights; places outside count as on the border.
    pub fn corners(&self, place: Vec2) -> [(usize, f64); 4] {
        let at = (place - self.low).component_div(&self.step);
        let clamp = |x: f64, n: usize| x.clamp(0.0, (n - 1) as f64);
        let (x, y) = (clamp(at.x, self.rows), clamp(at.y, self.columns));
        let (i, j) = ((x as usize).min(self.rows - 2), (y as usize).min(self.columns - 2));
        let (s, t) = (x - i as f64, y - j as f64);
        let node = |i: usize, j: usize| i * self.columns + j;
        [
            (node(i, j), (1.0 - s) * (1.0 - t)),
            (node(i, j + 1), (1.0 - s) * t),
            (node(i + 1, j), s * (1.0 - t)),
            (node(i + 1, j + 1), s * t),
        ]
    }

    /// The field at a place.
    pub fn at<T>(&self, field: &[T], place: Vec2) -> T
    where
        T: Copy + std::ops::Mul<f64, Output = T> + std::ops::Add<Output = T>,
    {
        let [a, b, c, d] = self.corners(place).map(|(node, w)| field[node] * w);
        a + b + c + d
    }

    /// The biharmonic form `Q` per square metre of chart.
    fn biharmonic(&self) -> Vec<f64> {
        let per_m2 = self.step.map(|s| 1.0 / (s * s));
        self.form((0..self.rows).flat_map(|i| (0..self.columns).map(move |j| (i, j))).map(|(i, j)| {
            let mut row: Vec<(usize, f64)> = Vec::with_capacity(5);
            let mut middle = 0.0;
            let mut add = |exists: bool, node: usize, k: f64| {
                if exists {
                    row.push((node, -k));
                    middle += k;
                }
            };
            let here = i * self.columns + j;
            add(i > 0, here.wrapping_sub(self.columns), per_m2.x);
            add(i + 1 < self.rows, here + self.columns, per_m2.x);
            add(j > 0, here.wrapping_sub(1), per_m2.y);
            add(j + 1 < self.columns, here + 1, per_m2.y);
            row.push((here, middle));
            row
        }))
    }

    /// The form `N` with a weight for each direction, per square metre of chart.
    fn second_differences(&self, weight: Vec2) -> Vec<f64> {
        let scale = weight.zip_map(&self.step, |w, s| w.sqrt() / (s * s));
        let row = |here: usize, stride: usize, k: f64| vec![(here - stride, k), (here, -2.0 * k), (here + stride, k)];
        let grid = || (0..self.rows).flat_map(|i| (0..self.columns).map(move |j| (i, j)));
        let along = grid()
            .filter(|(i, _)| (1..self.rows - 1).contains(i))
            .map(|(i, j)| row(i * self.columns + j, self.columns, scale.x));
        let around = grid()
            .filter(|(_, j)| (1..self.columns - 1).contains(j))
            .map(|(i, j)| row(i * self.columns + j, 1, scale.y));
        self.form(along.chain(around))
    }

    /// The sum of the squares of linear rows.
    fn form(&self, rows: impl Iterator<Item = Vec<(usize, f64)>>) -> Vec<f64> {
        let mut values = vec![0.0; self.pattern.entries()];
        for row in rows {
            for &(a, p) in &row {
                for &(b, q) in row.iter().filter(|(b, _)| *b <= a) {
                    values[self.slot(a, b)] += p * q;
                }
            }
        }
        values
    }

    fn slot(&self, a: usize, b: usize) -> usize {
        self.pattern.slot(a as u32, b as u32).expect("the pattern reaches two cells far")
    }

    /// The field that follows the samples smoothly: waves shorter than `wavelength` (along, around; metres) are damped to
    /// less than half. Sample weights are square metres of chart. Where there are no samples it goes on straight.
    pub fn smooth_field(&self, samples: impl Iterator<Item = Sample>, wavelength: Vec2) -> Result<Vec<Vec2>, Error> {
        let stiffness = wavelength.map(|w| (w / std::f64::consts::TAU).powi(4));
        self.fit(self.second_differences(stiffness * (self.step.x * self.step.y)), samples)
    }

    /// The field that meets the samples (to one part in a million or so) and bends as little as it can in between and
    /// beyond; one sample makes it constant.
    pub fn interpolating_field(&self, samples: impl Iterator<Item = Sample>) -> Result<Vec<Vec2>, Error> {
        let mut form = self.biharmonic();
        let size = (0..self.nodes()).map(|v| form[self.pattern.diagonal(v)]).fold(0.0, f64::max);
        form.iter_mut().for_each(|x| *x /= 1e6 * size);
        self.fit(form, samples)
    }

    fn fit(&self, mut form: Vec<f64>, samples: impl Iterator<Item = Sample>) -> Result<Vec<Vec2>, Error> {
        let n = self.nodes();
        let mut right = vec![0.0; 2 * n];
        // Products of the four corners of a cell, gathered by the cell's first node.
        let mut cells = vec![[0.0; 10]; n];
        for Sample { place, weight, value } in samples {
            let corners = self.corners(place);
            let products = &mut cells[corners[0].0];
            let mut k = 0;
            for (a, (node, p)) in corners.iter().enumerate() {
                for (_, q) in &corners[a..] {
                    products[k] += weight * p * q;
                    k += 1;
                }
                right[*node] += weight * p * value.x;
                right[n + node] += weight * p * value.y;
            }
        }
        for (first, products) in cells.iter().enumerate().filter(|(_, p)| p[0] + p[4] + p[7] + p[9] > 0.0) {
            let corners = [first, first + 1, first + self.columns, first + self.columns + 1];
            let mut k = 0;
            for (a, &node) in corners.iter().enumerate() {
                for &other in &corners[a..] {
                    form[self.slot(node, other)] += products[k];
                    k += 1;
                }
            }
        }
        Cholesky::new(&self.pattern, &self.analysis, &form)?.solve_in_place(&mut right);
        Ok((0..n).map(|v| Vec2::new(right[v], right[n + v])).collect())
    }

    /// Bounded biharmonic weights of handles that are sets of nodes (disjoint), each minimizing `w^T Q w` with
    /// `0 <= w <= 1`, one on its own nodes and zero on those of the others; then normalized to sum to one, as in the
    /// paper's fast variant.
    pub fn weights(&self, handles: &[Vec<usize>]) -> Result<Weights, Error> {
        let n = self.nodes();
        let form = self.biharmonic();
        let mut result = Weights { of: Vec::with_capacity(handles.len()), rounds: 0, unsettled: 0 };
        for own in 0..handles.len() {
            let mut fixed: Vec<Option<f64>> = vec![None; n];
            for (other, nodes) in handles.iter().enumerate() {
                nodes.iter().for_each(|&v| fixed[v] = Some(if other == own { 1.0 } else { 0.0 }));
            }
            let on_handle = fixed.clone();
            let mut weight = Vec::new();
            let mut settled = false;
            for round in 1..=MOST_ROUNDS {
                let (mut values, mut right) = (form.clone(), vec![0.0; n]);
                self.pattern.fix_unknowns(&mut values, &mut right, |v| fixed[v]);
                Cholesky::new(&self.pattern, &self.analysis, &values)?.solve_in_place(&mut right);
                weight = right;
                let force = self.pattern.multiply(&form, &weight);
                let mut changed = false;
                for v in (0..n).filter(|&v| on_handle[v].is_none()) {
                    match fixed[v] {
                        None if weight[v] < -1e-9 => (fixed[v], changed) = (Some(0.0), true),
                        None if weight[v] > 1.0 + 1e-9 => (fixed[v], changed) = (Some(1.0), true),
                        // A bound that pulls instead of pushing is let go; early rounds only, so that it cannot cycle.
                        Some(bound) if round < MOST_ROUNDS / 2 && force[v] * (0.5 - bound) < 0.0 => {
                            (fixed[v], changed) = (None, true);
                        }
                        _ => {}
                    }
                }
                result.rounds = result.rounds.max(round);
                if !changed {
                    settled = true;
                    break;
                }
            }
            result.unsettled += usize::from(!settled);
            weight.iter_mut().for_each(|w| *w = w.clamp(0.0, 1.0));
            result.of.push(weight);
        }
        for v in 0..n {
            let sum: f64 = result.of.iter().map(|w| w[v]).sum();
            if sum > 0.0 {
                result.of.iter_mut().for_each(|w| w[v] /= sum);
            }
        }
        Ok(result)
    }
}

/// Pairs of nodes that the biharmonic form couples.
fn neighbours(rows: usize, columns: usize) -> impl Iterator<Item = (u32, u32)> {
    let offsets = [(0, 1), (0, 2), (1, -1), (1, 0), (1, 1), (2, 0)];
    (0..rows).flat_map(move |i| (0..columns).map(move |j| (i, j))).flat_map(move |(i, j)| {
        offsets.into_iter().filter_map(move |(di, dj): (usize, isize)| {
            let other = (i + di, j.checked_add_signed(dj)?);
            (other.0 < rows && other.1 < columns)
                .then_some(((i * columns + j) as u32, (other.0 * columns + other.1) as u32))
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rectangle() -> impl Iterator<Item = Vec2> + Clone {
        (0..=20).flat_map(|i| (0..=50).map(move |j| Vec2::new(f64::from(i), f64::from(j) * 0.5 - 12.5)))
    }

    #[test]
    fn weights_are_bounded_and_sum_to_one() {
        let cage = Cage::over(rectangle()).unwrap();
        let line = |j: usize| (0..cage.rows).map(|i| i * cage.columns + j).collect::<Vec<_>>();
        let handles = [line(0), line(20), line(31), line(cage.columns - 1)];
        let weights = cage.weights(&handles).unwrap();
        assert_eq!(weights.unsettled, 0);
        for v in 0..cage.nodes() {
            assert!((weights.of.iter().map(|w| w[v]).sum::<f64>() - 1.0).abs() < 1e-12);
        }
        for (nodes, weight) in handles.iter().zip(&weights.of) {
            assert!(weight.iter().all(|w| (0.0..=1.0).contains(w)));
            assert!(nodes.iter().all(|&v| (weight[v] - 1.0).abs() < 1e-9));
        }
    }

    #[test]
    fn a_smooth_field_keeps_what_is_linear_and_drops_ripples() {
        let cage = Cage::over(rectangle()).unwrap();
        // A plane in x, a sawtooth of 1 m in y.
        let tooth = |p: Vec2| if (p.y * 2.0).round().rem_euclid(2.0) == 0.0 { 0.1 } else { -0.1 };
        let samples =
            rectangle().map(|p| Sample { place: p, weight: 0.5, value: Vec2::new(3.0 + 0.2 * p.x - p.y, tooth(p)) });
        let smooth = cage.smooth_field(samples, Vec2::new(4.0, 2.0)).unwrap();
        for p in rectangle() {
            let q = cage.at(&smooth, p);
            assert!((q.x - (3.0 + 0.2 * p.x - p.y)).abs() < 1e-6, "{p} {q}");
            // At its ends a field may follow a little farther.
            assert!(q.y.abs() < if p.y.abs() < 10.0 { 0.02 } else { 0.1 }, "{p} {q}");
        }
    }

    #[test]
    fn an_interpolating_field_meets_its_samples_and_one_sample_moves_everything() {
        let cage = Cage::over(rectangle()).unwrap();
        let sample =
            |u: f64, v: f64, x: f64, y: f64| Sample { place: Vec2::new(u, v), weight: 1.0, value: Vec2::new(x, y) };
        let one = cage.interpolating_field([sample(3.3, 1.2, 0.5, -0.2)].into_iter()).unwrap();
        assert!(one.iter().all(|d| (d - Vec2::new(0.5, -0.2)).norm() < 1e-4), "{:?}", one[0]);
        let two =
            cage.interpolating_field([sample(2.0, -4.0, 0.5, 0.0), sample(17.0, 6.1, -0.5, 1.0)].into_iter()).unwrap();
        assert!((cage.at(&two, Vec2::new(2.0, -4.0)) - Vec2::new(0.5, 0.0)).norm() < 1e-3);
        assert!((cage.at(&two, Vec2::new(17.0, 6.1)) - Vec2::new(-0.5, 1.0)).norm() < 1e-3);
    }
}
