//! Tunnel axes in closed form: straights and circular bends in plan with one gradient, and shafts.

use crate::axis::{Axis, Frame};
use crate::numeric::Vec3;

/// Steeper than this the alignment counts as a shaft, as in [`crate::axis`].
const SHAFT_PITCH_DEG: f64 = 70.0;

/// Newton steps that find the closest point of a bend; converges to the last bit in four or five.
const PROJECTION_STEPS: usize = 8;

/// Distance between the knots of [`Alignment::axis`], metres.
const AXIS_KNOT_SPACING_M: f64 = 0.5;

/// A stretch of constant curvature.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stretch {
    /// Length along the axis, metres.
    pub length_m: f64,
    /// Bend in plan: 1 / radius, positive to the left, 0 for a straight.
    pub curvature_per_m: f64,
}

/// Why stretches do not form an alignment.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// No stretch, or one that is not of positive finite length.
    #[error("stretch {index} of the alignment has length {length_m} m; lengths must be positive")]
    Length {
        /// Index of the stretch.
        index: usize,
        /// Its length.
        length_m: f64,
    },
    /// A bend steeper than 70 degrees has no closed-form frame.
    #[error("a bend of pitch {pitch_deg} degrees: shafts (steeper than 70 degrees) must be straight")]
    SteepBend {
        /// The pitch.
        pitch_deg: f64,
    },
}

/// A smooth axis made of stretches, all with the same pitch; chainage starts at 0.
#[derive(Clone, Debug, PartialEq)]
pub struct Alignment {
    stretches: Vec<Stretch>,
    /// Chainage, heading and position where each stretch starts, and one more at the end.
    knots: Vec<Knot>,
    sin_pitch: f64,
    cos_pitch: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Knot {
    chainage: f64,
    /// Counter-clockwise from +x, radians.
    heading: f64,
    position: Vec3,
}

impl Alignment {
    /// Stretches one after another from the origin towards +x, rising with `pitch_deg` (negative: falling).
    ///
    /// # Errors
    /// [`Error::Length`] for empty or non-positive stretches, [`Error::SteepBend`] for a shaft that bends.
    pub fn new(stretches: Vec<Stretch>, pitch_deg: f64) -> Result<Self, Error> {
        if stretches.is_empty() {
            return Err(Error::Length { index: 0, length_m: 0.0 });
        }
        for (index, s) in stretches.iter().enumerate() {
            if !(s.length_m > 0.0 && s.length_m.is_finite()) {
                return Err(Error::Length { index, length_m: s.length_m });
            }
            if s.curvature_per_m != 0.0 && pitch_deg.abs() > SHAFT_PITCH_DEG {
                return Err(Error::SteepBend { pitch_deg });
            }
        }
        let (sin_pitch, cos_pitch) =
            if pitch_deg.abs() == 90.0 { (pitch_deg.signum(), 0.0) } else { pitch_deg.to_radians().sin_cos() };
        let mut alignment = Self { stretches, knots: Vec::new(), sin_pitch, cos_pitch };
        alignment.lay(Vec3::zeros(), 0.0);
        Ok(alignment)
    }

    /// Level and straight.
    ///
    /// # Panics
    /// As all the constructors below: when a length or radius is not positive.
    pub fn straight(length_m: f64) -> Self {
        Self::one(length_m, 0.0, 0.0)
    }

    /// Level, bending to the left with a constant radius (to the right when it is negative).
    pub fn bend(length_m: f64, radius_m: f64) -> Self {
        Self::one(length_m, 1.0 / radius_m, 0.0)
    }

    /// Straight, rising by `gradient_percent` metres in 100 m of horizontal distance.
    pub fn ramp(length_m: f64, gradient_percent: f64) -> Self {
        Self::one(length_m, 0.0, (gradient_percent / 100.0).atan().to_degrees())
    }

    /// A spiral ramp: constant radius in plan, constant gradient.
    pub fn helix(length_m: f64, radius_m: f64, gradient_percent: f64) -> Self {
        Self::one(length_m, 1.0 / radius_m, (gradient_percent / 100.0).atan().to_degrees())
    }

    /// Straight down.
    pub fn shaft(length_m: f64) -> Self {
        Self::one(length_m, 0.0, -90.0)
    }

    fn one(length_m: f64, curvature_per_m: f64, pitch_deg: f64) -> Self {
        Self::new(vec![Stretch { length_m, curvature_per_m }], pitch_deg).expect("positive length")
    }

    /// The same alignment, starting at `start` (local metres) with an azimuth clockwise from north (+y).
    pub fn placed(mut self, start: Vec3, azimuth_deg: f64) -> Self {
        self.lay(start, (90.0 - azimuth_deg).to_radians());
        self
    }

    fn lay(&mut self, start: Vec3, heading: f64) {
        self.knots = vec![Knot { chainage: 0.0, heading, position: start }];
        for k in 0..self.stretches.len() {
            let knot = self.knots[k];
            let Stretch { length_m, curvature_per_m } = self.stretches[k];
            self.knots.push(Knot {
                chainage: knot.chainage + length_m,
                heading: knot.heading + length_m * self.cos_pitch * curvature_per_m,
                position: self.position(k, length_m),
            });
        }
    }

    /// Length along the axis, metres; chainage runs from 0 to this.
    pub fn length(&self) -> f64 {
        self.knots[self.knots.len() - 1].chainage
    }

    /// Whether the axis is too steep for gravity to tell left from right.
    pub fn is_shaft(&self) -> bool {
        self.sin_pitch.abs() > SHAFT_PITCH_DEG.to_radians().sin()
    }

    /// Curvature in plan at a chainage: positive to the left.
    pub fn curvature_at(&self, chainage: f64) -> f64 {
        self.stretches[self.stretch_at(chainage)].curvature_per_m
    }

    /// Whether no stretch bends.
    pub fn is_straight(&self) -> bool {
        self.stretches.iter().all(|s| s.curvature_per_m == 0.0)
    }

    /// Largest curvature in plan, 1 / metres.
    pub fn sharpest_curvature(&self) -> f64 {
        self.stretches.iter().map(|s| s.curvature_per_m.abs()).fold(0.0, f64::max)
    }

    /// (chainage, right, up) of a point whose chainage is known within a metre or so: three Newton steps on whatever
    /// stretch they lead to.
    pub(super) fn project_near(&self, point: &Vec3, guess: f64) -> [f64; 3] {
        let mut chainage = guess;
        for _ in 0..3 {
            let k = self.stretch_at(chainage);
            let f = self.frame_at_in(k, chainage);
            let offset = point - f.origin;
            let bend = self.cos_pitch * self.cos_pitch * self.stretches[k].curvature_per_m;
            chainage += offset.dot(&f.forward) / (1.0 - bend * offset.dot(&f.left)).max(0.05);
        }
        let f = self.frame_at(chainage);
        let offset = point - f.origin;
        [chainage, -offset.dot(&f.left), offset.dot(&f.up)]
    }

    fn stretch_at(&self, chainage: f64) -> usize {
        self.knots[1..self.stretches.len()].iter().take_while(|k| k.chainage <= chainage).count()
    }

    /// Position `along` metres into stretch `k`.
    fn position(&self, k: usize, along: f64) -> Vec3 {
        let knot = &self.knots[k];
        let horizontal = along * self.cos_pitch;
        let half_turn = horizontal * self.stretches[k].curvature_per_m / 2.0;
        // The chord of the arc: its direction is half way between the headings at its ends.
        let chord = if half_turn == 0.0 { horizontal } else { horizontal * half_turn.sin() / half_turn };
        let (sin, cos) = (knot.heading + half_turn).sin_cos();
        knot.position + Vec3::new(chord * cos, chord * sin, along * self.sin_pitch)
    }

    /// The frame at a chainage; beyond the ends the first and last stretch continue.
    pub fn frame_at(&self, chainage: f64) -> Frame {
        self.frame_at_in(self.stretch_at(chainage), chainage)
    }

    /// The frame of a stretch, also beyond its ends.
    fn frame_at_in(&self, k: usize, chainage: f64) -> Frame {
        let along = chainage - self.knots[k].chainage;
        let heading = self.knots[k].heading + along * self.cos_pitch * self.stretches[k].curvature_per_m;
        let (sin, cos) = heading.sin_cos();
        let forward = Vec3::new(self.cos_pitch * cos, self.cos_pitch * sin, self.sin_pitch);
        let left = if self.is_shaft() {
            // The crown of a shaft faces north, as in `axis`; steep enough shafts are never horizontal towards north.
            Vec3::y().cross(&forward).normalize()
        } else {
            Vec3::new(-sin, cos, 0.0)
        };
        Frame { origin: self.position(k, along), forward, left, up: forward.cross(&left) }
    }

    /// Chainage of the axis point closest to `point`, and the offsets (right, up) in its section.
    pub fn project(&self, point: &Vec3) -> (f64, f64, f64) {
        let mut best = (0.0, f64::INFINITY);
        for k in 0..self.stretches.len() {
            let (from, to) = (self.knots[k].chainage, self.knots[k + 1].chainage);
            for guess in self.guesses(k, point) {
                let mut chainage = self.knots[k].chainage + guess;
                for _ in 0..PROJECTION_STEPS {
                    let f = self.frame_at_in(k, chainage);
                    let offset = point - f.origin;
                    let bend = self.cos_pitch * self.cos_pitch * self.stretches[k].curvature_per_m;
                    let slope = 1.0 - bend * offset.dot(&f.left);
                    // Beyond the centre of the bend there is no closest point; stay put.
                    if slope < 0.05 {
                        break;
                    }
                    chainage += offset.dot(&f.forward) / slope;
                }
                // Inner stretches end at their knots; the first and last may continue beyond the portals.
                let low = if k == 0 { f64::NEG_INFINITY } else { from };
                let high = if k + 1 == self.stretches.len() { f64::INFINITY } else { to };
                let chainage = chainage.clamp(low, high);
                let distance = (point - self.frame_at_in(k, chainage).origin).norm();
                if distance < best.1 {
                    best = (chainage, distance);
                }
            }
        }
        let f = self.frame_at(best.0);
        let offset = point - f.origin;
        (best.0, -offset.dot(&f.left), offset.dot(&f.up))
    }

    /// Starting distances into stretch `k` for the projection: one for a straight, one for each turn of a helix.
    fn guesses(&self, k: usize, point: &Vec3) -> Vec<f64> {
        let Stretch { length_m, curvature_per_m } = self.stretches[k];
        let start = self.frame_at_in(k, self.knots[k].chainage);
        if curvature_per_m == 0.0 {
            return vec![(point - start.origin).dot(&start.forward)];
        }
        let centre = start.origin + start.left / curvature_per_m;
        let (from, to) = (start.origin - centre, point - centre);
        let turn = (from.x * to.y - from.y * to.x).atan2(from.x * to.x + from.y * to.y);
        let full = 2.0 * std::f64::consts::PI / (curvature_per_m.abs() * self.cos_pitch);
        let first = turn / (curvature_per_m * self.cos_pitch);
        // Half a turn of slack at both ends.
        let mut guesses = Vec::new();
        let mut guess = first - full * ((first + full / 2.0) / full).floor();
        while guess < length_m + full / 2.0 {
            guesses.push(guess);
            guess += full;
        }
        guesses
    }

    /// The axis as the rest of the program knows it: a spline through points of this alignment every half metre.
    pub fn axis(&self) -> Axis {
        let n = (self.length() / AXIS_KNOT_SPACING_M).ceil().max(1.0) as usize;
        let points: Vec<Vec3> = (0..=n).map(|i| self.frame_at(self.length() * i as f64 / n as f64).origin).collect();
        Axis::through(&points, 0.0).expect("an alignment has at least two distinct finite points")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    fn alignments() -> Vec<Alignment> {
        vec![
            Alignment::straight(30.0),
            Alignment::bend(30.0, 20.0).placed(Vec3::new(3.0, -2.0, 1.0), 217.0),
            Alignment::bend(30.0, -40.0),
            Alignment::ramp(30.0, 12.0).placed(Vec3::zeros(), 10.0),
            Alignment::helix(200.0, 15.0, 14.0),
            Alignment::shaft(30.0),
            Alignment::new(
                vec![
                    Stretch { length_m: 10.0, curvature_per_m: 0.0 },
                    Stretch { length_m: 12.0, curvature_per_m: 0.05 },
                    Stretch { length_m: 9.0, curvature_per_m: -0.02 },
                ],
                3.0,
            )
            .unwrap(),
        ]
    }

    #[test]
    fn chainage_is_arc_length_and_frames_are_orthonormal() {
        for a in alignments() {
            for i in 0..100 {
                let s = a.length() * (i as f64 + 0.3) / 100.0;
                let f = a.frame_at(s);
                let step = 1e-5;
                let velocity = (a.frame_at(s + step).origin - a.frame_at(s - step).origin) / (2.0 * step);
                assert!((velocity - f.forward).norm() < 1e-6, "{a:?} at {s}");
                assert!((f.forward.cross(&f.left) - f.up).norm() < 1e-12 && (f.left.norm() - 1.0).abs() < 1e-12);
                assert!(a.is_shaft() || (f.left.z == 0.0 && f.up.z > 0.0));
            }
        }
    }

    #[test]
    fn a_bend_is_a_circle_to_the_left() {
        let f = Alignment::bend(30.0, 20.0).frame_at(10.0 * PI);
        assert!((f.origin - Vec3::new(20.0, 20.0, 0.0)).norm() < 1e-12 && (f.forward - Vec3::y()).norm() < 1e-12);
        let f = Alignment::bend(30.0, -20.0).frame_at(10.0 * PI);
        assert!((f.origin - Vec3::new(20.0, -20.0, 0.0)).norm() < 1e-12);
    }

    #[test]
    fn projection_inverts_the_frame() {
        for a in alignments() {
            for i in 0..60 {
                let s = a.length() * (i as f64 + 0.3) / 60.0;
                let f = a.frame_at(s);
                for (right, up) in [(0.0, 2.0), (3.5, -1.0), (-3.5, 1.0)] {
                    let p = f.origin - f.left * right + f.up * up;
                    let (cs, cr, cu) = a.project(&p);
                    let error = (cs - s).abs() + (cr - right).abs() + (cu - up).abs();
                    assert!(error < 1e-9, "{a:?} at {s}: {error}");
                }
            }
        }
    }

    #[test]
    fn the_spline_axis_agrees() {
        for a in alignments() {
            let axis = a.axis();
            assert_eq!(axis.is_shaft(), a.is_shaft());
            for i in 1..10 {
                let s = a.length() * i as f64 / 10.0;
                let (known, spline) = (a.frame_at(s), axis.frame_at(s));
                assert!((known.origin - spline.origin).norm() < 2e-3, "{a:?} {s}");
                assert!((known.left - spline.left).norm() < 2e-2 && (known.up - spline.up).norm() < 2e-2);
            }
        }
    }

    #[test]
    fn bad_alignments_are_refused() {
        let bend = vec![Stretch { length_m: 5.0, curvature_per_m: 0.1 }];
        assert_eq!(Alignment::new(bend, -80.0), Err(Error::SteepBend { pitch_deg: -80.0 }));
        let none = vec![Stretch { length_m: 0.0, curvature_per_m: 0.0 }];
        assert_eq!(Alignment::new(none, 0.0), Err(Error::Length { index: 0, length_m: 0.0 }));
    }
}
