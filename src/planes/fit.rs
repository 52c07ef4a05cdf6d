//! The plane through a trace by total least squares, and whether it may be believed.
//!
//! The trace's length is spread evenly along its 3D polyline; the second moments are integrals over the segments, so
//! vertices that were added or taken away change nothing. Eigenvalues l1 >= l2 >= l3 (square metres): l3 is the mean
//! squared distance from the plane, its eigenvector the normal. Quality as in O. Fernandez, "Obtaining a best fitting plane
//! through 3D georeferenced data", 2005 (doi:10.1016/j.jsg.2004.12.004), after N. H. Woodcock, "Specification of fabric
//! shapes using an eigenvalue method", 1977 (doi:10.1130/0016-7606(1977)88<1231:SOFSUA>2.0.CO;2): M = ln(l1 / l3),
//! K = ln(l1 / l2) / ln(l2 / l3).
//!
//! M and K look only at the shape of the trace; a trace of a few pixels can have fine ones. So the angle within which the
//! orientation is known with 95 % confidence is told as well: to first order the normal turns about the first axis with
//! variance s^2 / (n l2) and about the second with s^2 / (n l1), where s^2 = max(l3, noise^2) n / (n - 3) and n is the
//! number of independent places of the trace, its length over the length along which errors of the hand, of the pixels and
//! of the surface hang together. The factor is Student's t for n - 3 degrees of freedom. An orientation is accepted when M,
//! K and this angle all keep to their limits; K may be greater when the angle is small, because a long trace that is nearly
//! straight can still be known well (K only compares proportions).
//!
//! Departures: the noise floor and n are stated assumptions, not estimates. Cost: linear.

use crate::numeric::{Mat3, Vec3};
use serde::Serialize;

/// When an orientation is believed.
#[derive(Clone, Debug, PartialEq)]
pub struct FitSettings {
    /// Least M.
    pub least_m: f64,
    /// Greatest K.
    pub greatest_k: f64,
    /// Greatest angle of 95 % confidence, degrees.
    pub greatest_angle_deg: f64,
    /// K may be greater when the angle of confidence is at most this, degrees: the length of the trace makes up for it.
    pub sure_angle_deg: f64,
    /// Distance from the plane that a trace has at least, however even it looks, metres: pixels, scanner, surface.
    pub noise_m: f64,
    /// Length along the trace over which errors hang together, metres.
    pub correlation_m: f64,
}

impl Default for FitSettings {
    fn default() -> Self {
        Self {
            least_m: 4.0,
            greatest_k: 0.8,
            greatest_angle_deg: 5.0,
            sure_angle_deg: 3.0,
            noise_m: 0.01,
            correlation_m: 0.3,
        }
    }
}

/// Whether an orientation may be used.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reliability {
    /// All limits are kept.
    Accepted,
    /// The reason why not.
    Unreliable(String),
}

/// A plane with its quality.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PlaneFit {
    /// Centre of the trace, local metres.
    #[serde(skip)]
    pub centre: Vec3,
    /// Upward unit normal.
    #[serde(skip)]
    pub normal: Vec3,
    /// Dip, degrees, 0 to 90.
    pub dip_deg: f64,
    /// Dip direction, degrees clockwise from north, 0 to 360.
    pub dip_direction_deg: f64,
    /// ln(l1 / l3).
    pub m: f64,
    /// ln(l1 / l2) / ln(l2 / l3).
    pub k: f64,
    /// Root of the mean squared distance of the trace from the plane, metres.
    pub rms_m: f64,
    /// Length of the trace in 3D, metres; for patches the square root of their area.
    pub length_m: f64,
    /// The true normal lies within this angle with 95 % confidence, degrees; at most 90.
    pub angle_95_deg: f64,
    /// Whether the orientation may be used.
    pub reliability: Reliability,
}

impl PlaneFit {
    /// Whether the orientation may be used.
    pub fn is_accepted(&self) -> bool {
        self.reliability == Reliability::Accepted
    }
}

/// The plane of a trace, local metres; `None` without length.
pub fn fit_line(parts: &[Vec<Vec3>], settings: &FitSettings) -> Option<PlaneFit> {
    let segments = || parts.iter().flat_map(|part| part.windows(2)).map(|w| (w[0], w[1], (w[1] - w[0]).norm()));
    let length: f64 = segments().map(|s| s.2).sum();
    if !(length > 0.0) {
        return None;
    }
    let centre = segments().map(|(a, b, l)| (a + b) * (l / 2.0)).sum::<Vec3>() / length;
    let mut moments = Mat3::zeros();
    for (a, b, l) in segments() {
        let (middle, half) = ((a + b) / 2.0 - centre, (b - a) / 2.0);
        moments += (middle * middle.transpose() + half * half.transpose() / 3.0) * l;
    }
    Some(judged(centre, moments / length, length, length / settings.correlation_m, settings))
}

/// The plane of a patch told by points with weights (areas), local metres; `None` without weight.
pub fn fit_points(points: &[(Vec3, f64)], settings: &FitSettings) -> Option<PlaneFit> {
    let area: f64 = points.iter().map(|p| p.1).sum();
    if !(area > 0.0) {
        return None;
    }
    let centre = points.iter().map(|(p, w)| p * *w).sum::<Vec3>() / area;
    let moments = points.iter().map(|(p, w)| (p - centre) * (p - centre).transpose() * *w).sum::<Mat3>() / area;
    let independent = area / (settings.correlation_m * settings.correlation_m);
    Some(judged(centre, moments, area.sqrt(), independent, settings))
}

fn judged(centre: Vec3, moments: Mat3, length: f64, independent: f64, settings: &FitSettings) -> PlaneFit {
    let eigen = moments.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let l1 = eigen.eigenvalues[order[0]].max(f64::MIN_POSITIVE);
    // Rounding leaves eigenvalues of exact planes a little above or below zero.
    let floor = l1 * 1e-15;
    let (l2, l3) = (eigen.eigenvalues[order[1]].max(floor), eigen.eigenvalues[order[2]].max(floor));
    let normal = super::upward(&eigen.eigenvectors.column(order[2]).into_owned());
    let (dip_deg, dip_direction_deg) = super::dip_of(&normal);
    let (m, k) = ((l1 / l3).ln(), (l1 / l2).ln() / (l2 / l3).ln().max(1e-9));
    let angle_95_deg = confidence_angle(l1, l2, l3, independent, settings.noise_m);
    let mut reasons = Vec::new();
    if !(m >= settings.least_m) {
        reasons.push(format!("M is {m:.2}, less than {}", settings.least_m));
    }
    if !(k <= settings.greatest_k || angle_95_deg <= settings.sure_angle_deg) {
        reasons.push(format!("K is {k:.2}, more than {}: nearly a straight line", settings.greatest_k));
    }
    if !(angle_95_deg <= settings.greatest_angle_deg) {
        reasons.push(format!("known within {angle_95_deg:.1} degrees only, not {}", settings.greatest_angle_deg));
    }
    let reliability =
        if reasons.is_empty() { Reliability::Accepted } else { Reliability::Unreliable(reasons.join("; ")) };
    PlaneFit {
        centre,
        normal,
        dip_deg,
        dip_direction_deg,
        m,
        k,
        rms_m: l3.sqrt(),
        length_m: length,
        angle_95_deg,
        reliability,
    }
}

/// See the module; 90 degrees where there are too few independent places.
fn confidence_angle(l1: f64, l2: f64, l3: f64, independent: f64, noise_m: f64) -> f64 {
    let freedom = independent - 3.0;
    if !(freedom > 0.5) {
        return 90.0;
    }
    let s2 = l3.max(noise_m * noise_m) * independent / freedom;
    // Cornish and Fisher's expansion of Student's t at 97.5 %.
    let t = 1.96 + 2.372 / freedom + 2.822 / (freedom * freedom);
    (t * (s2 / independent * (1.0 / l1 + 1.0 / l2)).sqrt()).atan().to_degrees()
}

#[cfg(test)]
mod tests {
    use super::super::{angle_between_planes_deg, normal_of};
    use super::*;
    use rand::{Rng, SeedableRng};

    /// Where a plane cuts a round tunnel of radius 2 m along x, over an arc, with noise that hangs together over 0.3 m.
    fn trace(dip: f64, direction: f64, arc_deg: f64, noise: f64, seed: u64) -> Vec<Vec<Vec3>> {
        let n = normal_of(dip, direction);
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let steps = 120;
        let knots: Vec<Vec3> = (0..60).map(|_| Vec3::from_fn(|_, _| random.random_range(-1.0..1.0))).collect();
        let mut length = 0.0;
        let mut before: Option<Vec3> = None;
        let line = (0..=steps)
            .map(|i| {
                let a = (f64::from(i) / f64::from(steps) - 0.5) * arc_deg.to_radians();
                let (y, z) = (2.0 * a.sin(), 2.0 * a.cos());
                let p = Vec3::new(-(n.y * y + n.z * z) / n.x, y, z);
                length += before.map_or(0.0, |b| (p - b).norm());
                before = Some(p);
                let at = length / 0.3;
                let (k, f) = ((at as usize).min(58), at.fract());
                p + (knots[k] * (1.0 - f) + knots[k + 1] * f) * noise * 1.73
            })
            .collect();
        vec![line]
    }

    #[test]
    fn exact_traces_give_their_plane_wherever_they_lie() {
        for (dip, direction) in [(45.0, 100.0), (85.0, 250.0), (60.0, 75.0), (30.0, 260.0)] {
            let line = trace(dip, direction, 200.0, 0.0, 1);
            let fit = fit_line(&line, &FitSettings::default()).unwrap();
            assert!((fit.dip_deg - dip).abs() < 1e-6 && (fit.dip_direction_deg - direction).abs() < 1e-6, "{fit:?}");
            assert!(fit.is_accepted() && fit.rms_m < 1e-6, "{fit:?}");
            // Fewer vertices on straight pieces change nothing: halve every segment.
            let finer: Vec<Vec3> =
                line[0].windows(2).flat_map(|w| [w[0], (w[0] + w[1]) / 2.0]).chain(line[0].last().copied()).collect();
            let again = fit_line(&[finer], &FitSettings::default()).unwrap();
            assert!(
                (again.m - fit.m).abs() < 0.5
                    && (again.k - fit.k).abs() < 1e-2
                    && (again.length_m - fit.length_m).abs() < 1e-9
            );
        }
    }

    #[test]
    fn straight_and_short_traces_are_unreliable() {
        let straight = vec![vec![Vec3::zeros(), Vec3::new(8.0, 1.0, 0.5), Vec3::new(16.0, 2.0, 1.004)]];
        let fit = fit_line(&straight, &FitSettings::default()).unwrap();
        assert!(!fit.is_accepted(), "{fit:?}");
        let short = fit_line(&trace(70.0, 90.0, 20.0, 0.0, 1), &FitSettings::default()).unwrap();
        assert!(!short.is_accepted() && short.angle_95_deg > 5.0, "{short:?}");
        assert!(fit_line(&[vec![Vec3::zeros()]], &FitSettings::default()).is_none());
    }

    #[test]
    fn the_angle_of_confidence_keeps_its_promise() {
        // Traces of many lengths with 1 cm noise: the true normal lies within the angle in 95 % of the cases or more.
        let (mut inside, mut all, mut worst) = (0, 0, 0.0f64);
        for seed in 0..400 {
            let arc = 60.0 + 200.0 * f64::from(seed % 20) / 20.0;
            let (dip, direction) = (50.0 + f64::from(seed % 7) * 5.0, 60.0 + f64::from(seed % 13) * 5.0);
            let fit =
                fit_line(&trace(dip, direction, arc, 0.01, u64::from(seed as u32)), &FitSettings::default()).unwrap();
            let error = angle_between_planes_deg(&fit.normal, &normal_of(dip, direction));
            all += 1;
            inside += i32::from(error <= fit.angle_95_deg);
            if fit.is_accepted() {
                worst = worst.max(error);
            }
        }
        assert!(f64::from(inside) >= 0.93 * f64::from(all), "{inside} of {all}");
        assert!(worst < 5.0, "an accepted orientation is wrong by {worst} degrees");
    }

    #[test]
    fn turning_the_trace_turns_the_plane() {
        let line = trace(40.0, 120.0, 150.0, 0.005, 3);
        let fit = fit_line(&line, &FitSettings::default()).unwrap();
        for azimuth in [90.0f64, 217.0] {
            let (s, c) = (-azimuth.to_radians()).sin_cos();
            let turned = vec![line[0].iter().map(|p| Vec3::new(c * p.x - s * p.y, s * p.x + c * p.y, p.z)).collect()];
            let other = fit_line(&turned, &FitSettings::default()).unwrap();
            let direction = (fit.dip_direction_deg + azimuth).rem_euclid(360.0);
            assert!((other.dip_deg - fit.dip_deg).abs() < 1e-9 && (other.dip_direction_deg - direction).abs() < 1e-8);
            assert!((other.angle_95_deg - fit.angle_95_deg).abs() < 1e-9);
        }
    }

    #[test]
    fn patches_have_planes_too() {
        let n = normal_of(35.0, 210.0);
        let (e, f) = (n.cross(&Vec3::x()).normalize(), n.cross(&n.cross(&Vec3::x())).normalize());
        let points: Vec<(Vec3, f64)> =
            (0..400).map(|i| (e * (f64::from(i % 20) * 0.1) + f * (f64::from(i / 20) * 0.1), 0.01)).collect();
        let fit = fit_points(&points, &FitSettings::default()).unwrap();
        assert!(fit.is_accepted() && angle_between_planes_deg(&fit.normal, &n) < 1e-6, "{fit:?}");
    }
}
