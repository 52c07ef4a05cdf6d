//! A C2 interpolating cubic spline over chord length, with arc length both ways.
//!
//! Reference: C. de Boor, "A Practical Guide to Splines", 1978, chapter IV. Ends are "not-a-knot"-free: the second
//! derivative vanishes there (natural spline), because a tunnel continues straight beyond its portals in Adit.

use crate::numeric::Vec3;

/// Position and derivatives at one place of the curve.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample {
    pub position: Vec3,
    first: Vec3,
    second: Vec3,
}

impl Sample {
    pub fn tangent(&self) -> Vec3 {
        self.first.normalize()
    }

    pub fn curvature(&self) -> f64 {
        self.first.cross(&self.second).norm() / self.first.norm().powi(3)
    }
}

#[derive(Clone, Debug)]
pub(super) struct Spline {
    knots: Vec<Vec3>,
    /// Chord-length parameter of each knot.
    parameters: Vec<f64>,
    /// Second derivative at each knot.
    seconds: Vec<Vec3>,
    /// Arc length from the first knot to each knot.
    lengths: Vec<f64>,
}

/// Abscissae and weights of 5-point Gauss-Legendre quadrature on [-1, 1].
const GAUSS: [(f64, f64); 5] = [
    (-0.906_179_845_938_664, 0.236_926_885_056_189_1),
    (-0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
    (0.0, 0.568_888_888_888_888_9),
    (0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
    (0.906_179_845_938_664, 0.236_926_885_056_189_1),
];

impl Spline {
    /// Needs at least two points, consecutive ones distinct.
    pub fn through(knots: &[Vec3]) -> Self {
        let mut parameters = vec![0.0];
        for pair in knots.windows(2) {
            parameters.push(parameters[parameters.len() - 1] + (pair[1] - pair[0]).norm());
        }
        let seconds = natural_second_derivatives(knots, &parameters);
        let mut spline = Self { knots: knots.to_vec(), parameters, seconds, lengths: vec![0.0] };
        for i in 0..knots.len() - 1 {
            let arc = spline.arc_length(i, spline.parameters[i], spline.parameters[i + 1]);
            spline.lengths.push(spline.lengths[i] + arc);
        }
        spline
    }

    pub fn knots(&self) -> &[Vec3] {
        &self.knots
    }

    pub fn length(&self) -> f64 {
        self.lengths[self.lengths.len() - 1]
    }

    /// The curve at an arc length; straight beyond the ends.
    pub fn at_length(&self, length: f64) -> Sample {
        let total = self.length();
        if length <= 0.0 || length >= total {
            let (end, beyond) = if length <= 0.0 { (0, length) } else { (self.knots.len() - 1, length - total) };
            let mut sample = self.at_parameter(end.min(self.knots.len() - 2), self.parameters[end]);
            sample.position += sample.tangent() * beyond;
            return sample;
        }
        let i = self.lengths.partition_point(|&l| l <= length) - 1;
        let (start, end) = (self.parameters[i], self.parameters[i + 1]);
        let wanted = length - self.lengths[i];
        let mut t = start + (end - start) * wanted / (self.lengths[i + 1] - self.lengths[i]);
        // Speed is close to 1 in chord length, so Newton gains several digits a step.
        for _ in 0..8 {
            let error = self.arc_length(i, start, t) - wanted;
            t = (t - error / self.at_parameter(i, t).first.norm()).clamp(start, end);
            if error.abs() < 1e-13 * total {
                break;
            }
        }
        self.at_parameter(i, t)
    }

    /// Arc length and place of the point of the curve closest to `point`, searched around `seed_length`.
    ///
    /// Newton's method in the parameter, so that arc length is integrated only once.
    pub fn closest(&self, point: &Vec3, seed_length: f64) -> (f64, Sample) {
        let last = self.knots.len() - 1;
        let (first_t, last_t) = (self.parameters[0], self.parameters[last]);
        let mut i = self.lengths.partition_point(|&l| l <= seed_length).clamp(1, last) - 1;
        let share = (seed_length - self.lengths[i]) / (self.lengths[i + 1] - self.lengths[i]);
        let mut t = self.parameters[i] + share * (self.parameters[i + 1] - self.parameters[i]);
        t = t.clamp(first_t, last_t);
        for _ in 0..40 {
            let sample = self.at_parameter(i, t);
            let offset = sample.position - point;
            let slope = offset.dot(&sample.first);
            let speed2 = sample.first.norm_squared();
            if (t == first_t && slope > 0.0) || (t == last_t && slope < 0.0) {
                // Straight on beyond the ends.
                let tangent = sample.tangent();
                let beyond = -offset.dot(&tangent);
                let end = if t == first_t { 0.0 } else { self.length() };
                return (end + beyond, Sample { position: sample.position + tangent * beyond, ..sample });
            }
            // Damped where the point lies beyond the centre of the bend.
            let curvature = (speed2 + offset.dot(&sample.second)).max(0.1 * speed2);
            let next = (t - slope / curvature).clamp(first_t, last_t);
            let step = (next - t).abs();
            t = next;
            while i > 0 && t < self.parameters[i] {
                i -= 1;
            }
            while i + 1 < last && t >= self.parameters[i + 1] {
                i += 1;
            }
            if step * speed2.sqrt() < 1e-13 * (1.0 + last_t) {
                break;
            }
        }
        (self.lengths[i] + self.arc_length(i, self.parameters[i], t), self.at_parameter(i, t))
    }

    fn at_parameter(&self, i: usize, t: f64) -> Sample {
        let h = self.parameters[i + 1] - self.parameters[i];
        let b = (t - self.parameters[i]) / h;
        let a = 1.0 - b;
        let (p, q, m, n) = (self.knots[i], self.knots[i + 1], self.seconds[i], self.seconds[i + 1]);
        Sample {
            position: p * a + q * b + (m * (a * a * a - a) + n * (b * b * b - b)) * (h * h / 6.0),
            first: (q - p) / h + (n * (3.0 * b * b - 1.0) - m * (3.0 * a * a - 1.0)) * (h / 6.0),
            second: m * a + n * b,
        }
    }

    fn arc_length(&self, i: usize, from: f64, to: f64) -> f64 {
        let (middle, half) = ((from + to) / 2.0, (to - from) / 2.0);
        half * GAUSS.iter().map(|&(x, w)| w * self.at_parameter(i, middle + half * x).first.norm()).sum::<f64>()
    }
}

/// Solves the tridiagonal system of the natural cubic spline (Thomas algorithm).
fn natural_second_derivatives(knots: &[Vec3], t: &[f64]) -> Vec<Vec3> {
    let n = knots.len();
    let mut seconds = vec![Vec3::zeros(); n];
    if n < 3 {
        return seconds;
    }
    let mut upper = vec![0.0; n];
    let mut right = vec![Vec3::zeros(); n];
    for i in 1..n - 1 {
        let (before, after) = (t[i] - t[i - 1], t[i + 1] - t[i]);
        let load = ((knots[i + 1] - knots[i]) / after - (knots[i] - knots[i - 1]) / before) * 6.0;
        let pivot = 2.0 * (before + after) - before * upper[i - 1];
        upper[i] = after / pivot;
        right[i] = (load - right[i - 1] * before) / pivot;
    }
    for i in (1..n - 1).rev() {
        seconds[i] = right[i] - seconds[i + 1] * upper[i];
    }
    seconds
}
