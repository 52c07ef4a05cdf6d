//! Point to plane, iterated, with robust weights and a look at what the overlap can tell.

use super::Error;
use super::surface::{LocalPlane, Overlap, Surface};
use crate::numeric::{Mat3, Vec3, statistics};
use nalgebra::{DMatrix, Matrix6, Rotation3, Vector6};
use rayon::prelude::*;

/// A rigid motion: `rotation * (p - centre) + centre + shift`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// A rotation matrix.
    pub rotation: Mat3,
    /// What is turned about.
    pub centre: Vec3,
    /// Movement of the centre, metres.
    pub shift: Vec3,
}

impl Motion {
    fn rest(centre: Vec3) -> Self {
        Self { rotation: Mat3::identity(), centre, shift: Vec3::zeros() }
    }

    /// Where a point goes.
    pub fn apply(&self, point: &Vec3) -> Vec3 {
        self.rotation * (point - self.centre) + self.centre + self.shift
    }

    /// This motion and then a small one about where its centre is now: a rotation vector and a shift.
    fn then(&self, turn: &Vec3, shift: &Vec3) -> Self {
        let more = Rotation3::new(*turn);
        Self { rotation: more.matrix() * self.rotation, centre: self.centre, shift: self.shift + shift }
    }
}

/// The motion that makes a scan agree with others.
#[derive(Clone, Copy, Debug)]
pub struct Alignment {
    /// To be applied to the scan.
    pub motion: Motion,
    /// Agreement before.
    pub before: Overlap,
    /// Agreement after.
    pub after: Overlap,
    /// Iterations until rest.
    pub iterations: usize,
}

/// Iterations at most.
const MOST_ITERATIONS: usize = 60;
/// Movement below which the scan is at rest, metres.
const REST_M: f64 = 2e-5;
/// Tukey's constant: 95 % efficiency for normal errors.
const BIWEIGHT: f64 = 4.685;
/// Median absolute deviation of normal errors, inverted.
const MAD_TO_SIGMA: f64 = 1.4826;
/// No scanner is better; keeps the weights finite on exact data.
const SMALLEST_SIGMA_M: f64 = 1e-4;
/// How far the result is moved to see whether the misfit rises, metres.
const PROBE_M: f64 = 0.05;
/// Parts of the scan that vote on whether the misfit rises.
const PARTS: usize = 16;
/// A direction is held when the misfit rises by this share, and by three standard errors of the parts.
const RISE: f64 = 0.1;

/// A point of the moving scan where it is now, and its plane.
struct Pair {
    index: usize,
    at: Vec3,
    plane: LocalPlane,
    residual: f64,
}

/// Finds the motion of `moving` (thinned, metres) onto `fixed`, over points within `distance_m` of it.
///
/// # Errors
/// [`Error`] when there is too little overlap, nothing holds a direction, or the iteration does not come to rest.
pub fn align(fixed: &Surface, moving: &[Vec3], distance_m: f64) -> Result<Alignment, Error> {
    let no_overlap = |matched| Error::NoOverlap { matched, points: moving.len(), needed: Overlap::FEWEST, distance_m };
    let before = fixed.overlap(moving, distance_m).ok_or_else(|| no_overlap(0))?;
    let centre = moving.iter().sum::<Vec3>() / moving.len() as f64;
    let mut motion = Motion::rest(centre);
    let mut reach = distance_m;
    let mut last_m = f64::INFINITY;
    for iteration in 1..=MOST_ITERATIONS {
        let pairs = pairs(fixed, moving, &motion, reach);
        if pairs.len() < Overlap::FEWEST {
            return Err(no_overlap(pairs.len()));
        }
        let sigma = scale(&pairs);
        let system = System::of(&pairs, &motion, sigma);
        let (turn, shift) = system.step();
        motion = motion.then(&turn, &shift);
        last_m = shift.norm() + turn.norm() * system.radius;
        // Far partners are wrong ones once the scan lies well; but the wall must stay within reach.
        reach = (reach * 0.8).max(10.0 * sigma).max(distance_m.min(0.1)).min(distance_m);
        let at_rest = last_m < REST_M;
        if at_rest || iteration == MOST_ITERATIONS {
            // What nothing holds may wander for ever: it is named even when the scan is not at rest.
            let pairs = self::pairs(fixed, moving, &motion, reach);
            let free = System::of(&pairs, &motion, scale(&pairs)).unobservable(fixed, moving, &motion, &pairs, reach);
            if !free.is_empty() {
                return Err(Error::Unobservable { directions: free, probe_m: PROBE_M });
            }
        }
        if at_rest {
            let moved: Vec<Vec3> = moving.iter().map(|p| motion.apply(p)).collect();
            let after = fixed.overlap(&moved, distance_m).ok_or_else(|| no_overlap(0))?;
            return Ok(Alignment { motion, before, after, iterations: iteration });
        }
    }
    Err(Error::NoRest { iterations: MOST_ITERATIONS, last_m })
}

fn pairs(fixed: &Surface, moving: &[Vec3], motion: &Motion, reach: f64) -> Vec<Pair> {
    moving
        .par_iter()
        .enumerate()
        .filter_map(|(index, p)| {
            let at = motion.apply(p);
            let plane = fixed.plane_near(&at, reach)?;
            Some(Pair { index, at, plane, residual: (at - plane.centre).dot(&plane.normal) })
        })
        .collect()
}

/// Robust standard deviation of the residuals.
fn scale(pairs: &[Pair]) -> f64 {
    let mut absolute: Vec<f64> = pairs.iter().map(|p| p.residual.abs()).collect();
    (MAD_TO_SIGMA * statistics::median(&mut absolute).unwrap_or(0.0)).max(SMALLEST_SIGMA_M)
}

/// The normal equations about the centre; turns are scaled by the radius, so that all unknowns are metres.
struct System {
    matrix: Matrix6<f64>,
    right: Vector6<f64>,
    radius: f64,
    sigma: f64,
}

impl System {
    fn of(pairs: &[Pair], motion: &Motion, sigma: f64) -> Self {
        let centre = motion.centre + motion.shift;
        let squares: f64 = pairs.iter().map(|p| (p.at - centre).norm_squared()).sum();
        let radius = (squares / pairs.len().max(1) as f64).sqrt().max(1e-3);
        let (mut matrix, mut right) = (Matrix6::zeros(), Vector6::zeros());
        for pair in pairs {
            let u = pair.residual / (BIWEIGHT * sigma);
            if u.abs() >= 1.0 {
                continue;
            }
            let weight = (1.0 - u * u) * (1.0 - u * u);
            let turn = (pair.at - centre).cross(&pair.plane.normal) / radius;
            let n = pair.plane.normal;
            let row = Vector6::new(turn.x, turn.y, turn.z, n.x, n.y, n.z);
            matrix += row * row.transpose() * weight;
            right -= row * (pair.residual * weight);
        }
        Self { matrix, right, radius, sigma }
    }

    /// The small turn and shift that the equations ask for; directions that nothing holds at all stay at rest.
    fn step(&self) -> (Vec3, Vec3) {
        let eigen = self.matrix.symmetric_eigen();
        let largest = eigen.eigenvalues.amax();
        let mut step = Vector6::zeros();
        for k in 0..6 {
            let (value, vector) = (eigen.eigenvalues[k], eigen.eigenvectors.column(k));
            if value > 1e-9 * largest {
                step += vector * (vector.dot(&self.right) / value);
            }
        }
        (step.fixed_rows::<3>(0) / self.radius, step.fixed_rows::<3>(3).into_owned())
    }

    /// Directions in which the scan can be moved without the misfit rising.
    fn unobservable(
        &self,
        fixed: &Surface,
        moving: &[Vec3],
        motion: &Motion,
        pairs: &[Pair],
        reach: f64,
    ) -> Vec<String> {
        let eigen = self.matrix.symmetric_eigen();
        let mut order: Vec<usize> = (0..6).collect();
        order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
        let indices: Vec<usize> = pairs.iter().map(|p| p.index).collect();
        let rest = self.misfits(fixed, moving, motion, &indices, reach);
        let mut free: Vec<Vector6<f64>> = Vec::new();
        for k in order {
            let vector = eigen.eigenvectors.column(k);
            let (turn, shift) = (vector.fixed_rows::<3>(0).into_owned(), vector.fixed_rows::<3>(3).into_owned());
            let held = [1.0, -1.0].iter().all(|sign| {
                let moved = motion.then(&(turn * (sign * PROBE_M / self.radius)), &(shift * (sign * PROBE_M)));
                rises(&rest, &self.misfits(fixed, moving, &moved, &indices, reach))
            });
            if !held {
                free.push(vector.into_owned());
            }
        }
        in_plain_directions(&free)
    }

    /// Mean misfit of each part of the scan: squares, cut off at three standard deviations.
    fn misfits(&self, fixed: &Surface, moving: &[Vec3], motion: &Motion, indices: &[usize], reach: f64) -> Vec<f64> {
        let cut = 9.0 * self.sigma * self.sigma;
        let all: Vec<f64> = indices
            .par_iter()
            .map(|&i| {
                let at = motion.apply(&moving[i]);
                let plane = fixed.plane_near(&at, reach + PROBE_M);
                plane.map_or(cut, |p| (at - p.centre).dot(&p.normal).powi(2).min(cut))
            })
            .collect();
        let run = all.len().div_ceil(PARTS).max(1);
        all.chunks(run).map(|part| part.iter().sum::<f64>() / part.len() as f64).collect()
    }
}

/// Whether the misfit rises from `rest` to `moved`, beyond what the parts differ among themselves.
fn rises(rest: &[f64], moved: &[f64]) -> bool {
    let n = rest.len() as f64;
    let rise: Vec<f64> = rest.iter().zip(moved).map(|(a, b)| b - a).collect();
    let mean = rise.iter().sum::<f64>() / n;
    let variance = rise.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    let base = rest.iter().sum::<f64>() / n;
    mean > RISE * base && mean > 3.0 * (variance / n).sqrt()
}

/// Names free directions: where several are free, any mixture of them is, so they are told apart into shifts and turns.
fn in_plain_directions(free: &[Vector6<f64>]) -> Vec<String> {
    if free.is_empty() {
        return Vec::new();
    }
    let shifts = DMatrix::from_fn(3, free.len(), |row, k| free[k][3 + row]);
    let eigen = (shifts.transpose() * &shifts).symmetric_eigen();
    let mut order: Vec<usize> = (0..free.len()).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let mixture =
        |k: usize| free.iter().zip(eigen.eigenvectors.column(k).iter()).map(|(f, w)| f * *w).sum::<Vector6<f64>>();
    let named = |v: Vector6<f64>| in_words(&v.fixed_rows::<3>(0).into_owned(), &v.fixed_rows::<3>(3).into_owned());
    order.into_iter().map(|k| named(mixture(k))).collect()
}

fn in_words(turn: &Vec3, shift: &Vec3) -> String {
    let (what, v) = if shift.norm() >= turn.norm() {
        ("a shift along", shift.normalize())
    } else {
        ("a turn about", turn.normalize())
    };
    // The sign of a direction means nothing; the largest part is shown positive.
    let v = v * v[v.iamax()].signum();
    format!("{what} ({:.2}, {:.2}, {:.2})", v.x + 0.0, v.y + 0.0, v.z + 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A number from -0.5 to 0.5 that looks random, the same for the same `i`.
    fn noise(i: u64) -> f64 {
        let mut h = i.wrapping_add(0x9e37_79b9_7f4a_7c15);
        h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (h >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    }

    /// A horseshoe tunnel along x of 12 m; `relief_m` is the height of waves on its wall; `seed` chooses the sampling.
    fn tunnel(relief_m: f64, round: bool, seed: u64) -> Vec<Vec3> {
        let n = 40_000;
        (0..n)
            .map(|i| {
                let key = seed.wrapping_mul(1_000_003) + i * 3;
                let (x, a) = ((noise(key) + 0.5) * 12.0, noise(key + 1) * std::f64::consts::TAU);
                let square = if round { 0.0 } else { 0.35 * (4.0 * a).cos() };
                let waves = (x * 1.7 + (2.0 * a).sin()).sin() + (x * 3.1).cos() * (3.0 * a).sin();
                let r = 3.0 + square + relief_m * waves + 0.002 * noise(key + 2);
                Vec3::new(x, r * a.cos(), r * a.sin())
            })
            .collect()
    }

    #[test]
    fn a_known_motion_is_found_back() {
        let fixed = Surface::new(&tunnel(0.08, false, 1));
        let shown = Motion {
            rotation: *Rotation3::new(Vec3::new(0.004, -0.006, 0.01)).matrix(),
            centre: Vec3::zeros(),
            shift: Vec3::new(0.07, -0.05, 0.06),
        };
        let truth = tunnel(0.08, false, 2);
        let moving: Vec<Vec3> = truth.iter().map(|p| shown.apply(p)).collect();
        let found = align(&fixed, &moving, 0.4).unwrap();
        assert!(found.before.median_m > 0.02 && found.after.median_m < 0.004, "{found:?}");
        let squares: f64 = truth.iter().zip(&moving).map(|(t, m)| (found.motion.apply(m) - t).norm_squared()).sum();
        let rms = (squares / truth.len() as f64).sqrt();
        assert!(rms < 0.003, "{rms}");
    }

    #[test]
    fn a_smooth_straight_tunnel_is_refused_and_the_direction_named() {
        let fixed = Surface::new(&tunnel(0.0, false, 1));
        let moving: Vec<Vec3> = tunnel(0.0, false, 2).iter().map(|p| p + Vec3::new(0.05, 0.02, -0.03)).collect();
        let Err(Error::Unobservable { directions, .. }) = align(&fixed, &moving, 0.4) else { panic!("accepted") };
        assert_eq!(directions.len(), 1, "{directions:?}");
        assert!(directions[0].starts_with("a shift along (1.00"), "{directions:?}");
    }

    #[test]
    fn a_round_pipe_also_turns() {
        let fixed = Surface::new(&tunnel(0.0, true, 1));
        let Err(Error::Unobservable { directions, .. }) = align(&fixed, &tunnel(0.0, true, 2), 0.4) else {
            panic!("accepted")
        };
        assert_eq!(directions.len(), 2, "{directions:?}");
        assert!(directions.iter().any(|d| d.starts_with("a turn about (1.00")), "{directions:?}");
    }

    #[test]
    fn scans_apart_do_not_overlap() {
        let fixed = Surface::new(&tunnel(0.08, false, 1));
        let far: Vec<Vec3> = tunnel(0.08, false, 2).iter().map(|p| p + Vec3::new(100.0, 0.0, 0.0)).collect();
        assert!(matches!(align(&fixed, &far, 0.4), Err(Error::NoOverlap { .. })));
    }
}
