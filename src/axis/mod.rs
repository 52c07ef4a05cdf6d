//! The tunnel axis: a smooth curve with chainage along it and a frame (forward, left, up) at every point.
//!
//! Everything that Adit knows about "along the tunnel" and "around the tunnel" is said in [`AxisCoordinates`].

mod alignment;
mod enclosed_void;
mod ends;
mod sections;
mod skeleton;
mod smoothing;
mod spline;
mod trace;

pub use alignment::import_csv;
pub use trace::{Branch, Direction, Settings, Side, Source, Summary, trace};

use crate::numeric::{Vec3, any_perpendicular};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use spline::Spline;
use std::sync::Arc;

/// Steeper than this anywhere (from horizontal) and the tunnel counts as a shaft: gravity no longer tells left from
/// right, so the frame is carried along the axis without twist instead.
const SHAFT_INCLINATION_DEG: f64 = 70.0;

/// Distance between the samples that seed the projection of a point onto the axis, metres.
const SEED_SPACING_M: f64 = 0.5;

/// The moving frame of the axis at one chainage. Orthonormal: `forward x left = up`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Point on the axis, local metres.
    pub origin: Vec3,
    /// Direction of increasing chainage.
    pub forward: Vec3,
    /// To the left when facing increasing chainage; horizontal except in shafts.
    pub left: Vec3,
    /// Perpendicular to both; in the vertical plane of the axis except in shafts.
    pub up: Vec3,
}

/// A point told by the axis: where along it, and where in the section perpendicular to it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AxisCoordinates {
    /// Chainage in metres (starts at the axis' start chainage).
    pub chainage: f64,
    /// Metres to the right of the axis when facing increasing chainage.
    pub right: f64,
    /// Metres above the axis, along the frame's `up`.
    pub up: f64,
}

impl AxisCoordinates {
    /// Angle around the axis in radians, (-pi, pi]: 0 at the crown, positive over the right wall, +-pi at the invert.
    pub fn angle(&self) -> f64 {
        self.right.atan2(self.up)
    }

    /// Distance from the axis in metres.
    pub fn radius(&self) -> f64 {
        self.right.hypot(self.up)
    }

    /// The coordinates with the given angle (see [`Self::angle`]) and radius.
    pub fn from_polar(chainage: f64, angle: f64, radius: f64) -> Self {
        let (sin, cos) = angle.sin_cos();
        Self { chainage, right: radius * sin, up: radius * cos }
    }
}

/// Why points or a file do not make an axis.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// The points do not enclose an elongated space.
    #[error(
        "the scan is no tunnel: {reason} (surface that faces an enclosed space: {:.0} %, its length: {length_m:.1} m, \
         its width: {width_m:.1} m); if it is one, give its centre line as axis.alignment", enclosed_share * 100.0
    )]
    NotATunnel {
        /// What is missing.
        reason: &'static str,
        /// Share (0 to 1) of the scanned surface that borders on the largest enclosed space.
        enclosed_share: f64,
        /// Length of that space, metres.
        length_m: f64,
        /// Its width (twice the clearance), metres.
        width_m: f64,
    },
    /// The tunnel runs in a circle, or there are several ways from one end to the other.
    #[error(
        "the scan has a closed loop: two ways that stay apart for at least {arm_m:.1} m; give axis.ends to follow one \
         tunnel, or cut the scan into single tunnels"
    )]
    ClosedLoop {
        /// Length of the shorter way, metres.
        arm_m: f64,
    },
    /// The tunnel that was followed does not pass a place where it was to end.
    #[error(
        "axis.ends: the tunnel that was followed passes its {} point {away_m:.1} m away, so no tunnel long enough to be followed \
         leads there; both points must lie in the void of the scan, in its own coordinates (mesh.openings in the report of \
         the main tunnel lists such points for its side drifts)", ["first", "second"][*which]
    )]
    EndNotReached {
        /// Which of the two, 0 or 1.
        which: usize,
        /// How far it is from the axis, metres.
        away_m: f64,
    },
    /// The alignment file has a line that is no point.
    #[error("line {line} of the alignment is not understood: {problem}")]
    Alignment {
        /// Line number from 1.
        line: usize,
        /// What was expected and found.
        problem: String,
    },
    /// A setting is out of its range.
    #[error("axis.{key} is out of range: {problem}")]
    Setting {
        /// The key in the pipeline file.
        key: &'static str,
        /// What was given and what is possible.
        problem: String,
    },
    /// Fewer than two distinct points.
    #[error("an axis needs at least 2 distinct points, got {found}")]
    TooFewPoints {
        /// Distinct points given.
        found: usize,
    },
    /// A coordinate is NaN or infinite.
    #[error("axis point {index} is not finite")]
    NotFinite {
        /// Index of the point.
        index: usize,
    },
}

/// A smooth axis with arc-length chainage.
#[derive(Clone, Debug)]
pub struct Axis {
    spline: Spline,
    start_chainage: f64,
    /// Frame without gravity (shafts): twist-free `left` at each seed; empty when gravity defines the frame.
    transported_left: Vec<Vec3>,
    /// Where the crown line of a shaft was asked to face; north when not.
    crown_azimuth_deg: Option<f64>,
    /// Chainage (from 0) of each seed.
    seed_lengths: Vec<f64>,
    seed_points: Vec<[f64; 3]>,
    seed_tree: Arc<ImmutableKdTree<f64, 3>>,
}

impl Axis {
    /// The C2 curve through `points` (local metres, in the direction of increasing chainage); the first point has
    /// chainage `start_chainage`. Repeated points are merged.
    ///
    /// # Errors
    /// [`Error::TooFewPoints`] below two distinct points, [`Error::NotFinite`] for NaN or infinite input.
    pub fn through(points: &[Vec3], start_chainage: f64) -> Result<Self, Error> {
        if let Some(index) = points.iter().position(|p| !p.iter().all(|c| c.is_finite())) {
            return Err(Error::NotFinite { index });
        }
        let mut distinct: Vec<Vec3> = Vec::with_capacity(points.len());
        for p in points {
            if distinct.last().is_none_or(|last| (p - last).norm() > 1e-9) {
                distinct.push(*p);
            }
        }
        if distinct.len() < 2 {
            return Err(Error::TooFewPoints { found: distinct.len() });
        }
        let spline = Spline::through(&distinct);
        let seeds = ((spline.length() / SEED_SPACING_M).ceil() as usize).max(1);
        let seed_lengths: Vec<f64> = (0..=seeds).map(|i| spline.length() * i as f64 / seeds as f64).collect();
        let seed_points: Vec<[f64; 3]> = seed_lengths.iter().map(|&s| spline.at_length(s).position.into()).collect();
        // Distinct finite points always build; the tree only refuses NaN-sized trees.
        let seed_tree = ImmutableKdTree::new_from_slice(&seed_points).expect("finite seeds build a tree").into();
        let mut axis = Self {
            spline,
            start_chainage,
            transported_left: Vec::new(),
            crown_azimuth_deg: None,
            seed_lengths,
            seed_points,
            seed_tree,
        };
        let limit = SHAFT_INCLINATION_DEG.to_radians().sin();
        let forwards: Vec<Vec3> = axis.seed_lengths.iter().map(|&s| axis.spline.at_length(s).tangent()).collect();
        if forwards.iter().any(|f| f.z.abs() > limit) {
            axis.transported_left = transport_left(&forwards, &Vec3::y());
        }
        Ok(axis)
    }

    /// The points that the curve goes through, local metres: with [`Self::start_chainage`] and
    /// [`Self::crown_azimuth_deg`] they make the same axis again.
    pub fn knots(&self) -> &[Vec3] {
        self.spline.knots()
    }

    /// What [`Self::with_crown_azimuth`] was given, if it had an effect.
    pub fn crown_azimuth_deg(&self) -> Option<f64> {
        self.crown_azimuth_deg
    }

    /// Chainage of the first point, metres.
    pub fn start_chainage(&self) -> f64 {
        self.start_chainage
    }

    /// Chainage of the last point, metres.
    pub fn end_chainage(&self) -> f64 {
        self.start_chainage + self.spline.length()
    }

    /// Arc length in metres.
    pub fn length(&self) -> f64 {
        self.spline.length()
    }

    /// Whether the frame is carried along without twist because the axis is too steep for gravity to define it.
    pub fn is_shaft(&self) -> bool {
        !self.transported_left.is_empty()
    }

    /// The same curve with chainage running the other way, starting at `start_chainage`.
    pub fn reversed(&self, start_chainage: f64) -> Self {
        let points: Vec<Vec3> = self.spline.knots().iter().rev().copied().collect();
        Self::through(&points, start_chainage).expect("the knots of an axis make an axis")
    }

    /// The same shaft with its crown line at its start facing the azimuth (degrees clockwise from north) instead of
    /// north. An axis with a gravity frame is returned unchanged.
    pub fn with_crown_azimuth(mut self, azimuth_deg: f64) -> Self {
        if self.is_shaft() {
            let forwards: Vec<Vec3> = self.seed_lengths.iter().map(|&s| self.spline.at_length(s).tangent()).collect();
            let (sin, cos) = azimuth_deg.to_radians().sin_cos();
            self.transported_left = transport_left(&forwards, &Vec3::new(sin, cos, 0.0));
            self.crown_azimuth_deg = Some(azimuth_deg);
        }
        self
    }

    /// The frame at a chainage; beyond the ends the axis continues straight.
    pub fn frame_at(&self, chainage: f64) -> Frame {
        let length = chainage - self.start_chainage;
        let sample = self.spline.at_length(length);
        let forward = sample.tangent();
        let left = self.left_at(length, &forward);
        Frame { origin: sample.position, forward, left, up: forward.cross(&left) }
    }

    /// Unit direction in the section at `chainage` for an angle around the axis (see [`AxisCoordinates::angle`]).
    pub fn direction_at(&self, chainage: f64, angle: f64) -> Vec3 {
        let frame = self.frame_at(chainage);
        let (sin, cos) = angle.sin_cos();
        frame.up * cos - frame.left * sin
    }

    /// Local point of axis coordinates: the inverse of [`Self::project`].
    pub fn point_at(&self, c: &AxisCoordinates) -> Vec3 {
        let frame = self.frame_at(c.chainage);
        frame.origin - frame.left * c.right + frame.up * c.up
    }

    /// Axis coordinates of a local point: its closest point on the axis and the offset in that section.
    pub fn project(&self, point: &Vec3) -> AxisCoordinates {
        let nearest = self.seed_tree.query(&(*point).into()).nearest_one::<SquaredEuclidean<f64>>().execute();
        let (length, sample) = self.spline.closest(point, self.seed_lengths[nearest.item as usize]);
        let forward = sample.tangent();
        let left = self.left_at(length, &forward);
        let offset = point - sample.position;
        AxisCoordinates {
            chainage: self.start_chainage + length,
            right: -offset.dot(&left),
            up: offset.dot(&forward.cross(&left)),
        }
    }

    /// The point of the axis nearest to `point` among samples each half metre: much faster than [`Self::project`] where
    /// only the side matters.
    pub fn nearest_sample(&self, point: &Vec3) -> Vec3 {
        let nearest = self.seed_tree.query(&(*point).into()).nearest_one::<SquaredEuclidean<f64>>().execute();
        Vec3::from(self.seed_points[nearest.item as usize])
    }

    /// Azimuth of the forward direction, degrees clockwise from north (+y), 0 to 360.
    pub fn azimuth_deg(&self, chainage: f64) -> f64 {
        let f = self.frame_at(chainage).forward;
        let azimuth = f.x.atan2(f.y).to_degrees();
        if azimuth < 0.0 { azimuth + 360.0 } else { azimuth }
    }

    /// Gradient of the forward direction in percent (rise over horizontal run); infinite for a vertical axis.
    pub fn gradient_percent(&self, chainage: f64) -> f64 {
        let f = self.frame_at(chainage).forward;
        100.0 * f.z / f.x.hypot(f.y)
    }

    /// Radius of curvature in metres; infinite where straight.
    pub fn bend_radius(&self, chainage: f64) -> f64 {
        1.0 / self.spline.at_length(chainage - self.start_chainage).curvature()
    }

    fn left_at(&self, length: f64, forward: &Vec3) -> Vec3 {
        if self.transported_left.is_empty() {
            return Vec3::z().cross(forward).normalize();
        }
        let last = self.seed_lengths.len() - 1;
        let position = (length / self.spline.length() * last as f64).clamp(0.0, last as f64);
        let i = (position.floor() as usize).min(last - 1);
        let blend = position - i as f64;
        let left = self.transported_left[i] * (1.0 - blend) + self.transported_left[i + 1] * blend;
        (left - forward * left.dot(forward)).normalize()
    }
}

/// Rotation-minimizing `left` vectors along unit tangents, starting so that `up` is as close to `crown` as possible.
///
/// Reference: W. Wang, B. Juettler, D. Zheng, Y. Liu, "Computation of rotation minimizing frames", ACM TOG 27(1), 2008,
/// doi:10.1145/1330511.1330513 (here with the rotation that takes one tangent to the next, exact for our dense samples).
fn transport_left(forwards: &[Vec3], crown: &Vec3) -> Vec<Vec3> {
    let first = forwards[0];
    let crown_left = crown.cross(&first);
    let mut left = if crown_left.norm() > 0.1 { crown_left.normalize() } else { any_perpendicular(&first) };
    let mut lefts = vec![left];
    for pair in forwards.windows(2) {
        if let Some(turn) = nalgebra::UnitQuaternion::rotation_between(&pair[0], &pair[1]) {
            left = turn * left;
        }
        left = (left - pair[1] * left.dot(&pair[1])).normalize();
        lefts.push(left);
    }
    lefts
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    fn arc(radius: f64, slope: f64) -> Axis {
        // Left-hand bend around (0, radius) starting towards +x.
        let points: Vec<Vec3> = (0..=120)
            .map(|i| {
                let a = i as f64 / 120.0 * PI;
                Vec3::new(radius * a.sin(), radius - radius * a.cos(), slope * radius * a)
            })
            .collect();
        Axis::through(&points, 100.0).unwrap()
    }

    #[test]
    fn straight_axis_has_gravity_frame() {
        let axis = Axis::through(&[Vec3::zeros(), Vec3::new(10.0, 0.0, 0.0)], 5.0).unwrap();
        let frame = axis.frame_at(7.0);
        assert!((frame.origin - Vec3::new(2.0, 0.0, 0.0)).norm() < 1e-12);
        assert_eq!((frame.forward, frame.left, frame.up), (Vec3::x(), Vec3::y(), Vec3::z()));
        assert!((axis.azimuth_deg(7.0) - 90.0).abs() < 1e-12);
        let right_wall = axis.project(&Vec3::new(3.0, -4.0, 0.0));
        assert!((right_wall.chainage - 8.0).abs() < 1e-12 && (right_wall.right - 4.0).abs() < 1e-12);
        assert!((right_wall.angle() - FRAC_PI_2).abs() < 1e-12);
    }

    #[test]
    fn arc_length_matches_the_circle() {
        let axis = arc(20.0, 0.0);
        // The natural ends of the spline cost a little of the arc there.
        assert!((axis.length() - 20.0 * PI).abs() < 1e-3, "{}", axis.length());
        assert!((axis.bend_radius(100.0 + 31.4) - 20.0).abs() < 1e-2);
    }

    #[test]
    fn projection_and_point_are_inverse() {
        let axis = arc(20.0, 0.1);
        for (s, r, u) in
            [(100.0, 1.0, 2.0), (120.5, -4.0, 0.3), (150.0, 4.0, -3.0), (99.0, 1.0, 1.0), (170.0, 0.0, 2.0)]
        {
            let c = AxisCoordinates { chainage: s, right: r, up: u };
            let back = axis.project(&axis.point_at(&c));
            assert!(
                (back.chainage - s).abs() < 1e-9 && (back.right - r).abs() < 1e-9 && (back.up - u).abs() < 1e-9,
                "{back:?}"
            );
        }
    }

    #[test]
    fn shaft_frame_is_orthonormal_and_faces_north() {
        let axis =
            Axis::through(&[Vec3::zeros(), Vec3::new(0.0, 0.1, -20.0), Vec3::new(0.0, 0.0, -40.0)], 0.0).unwrap();
        assert!(axis.is_shaft());
        let f = axis.frame_at(13.0);
        assert!((f.forward.cross(&f.left) - f.up).norm() < 1e-12 && f.up.y > 0.99);
    }

    #[test]
    fn reversing_mirrors_left_and_right() {
        let axis = arc(20.0, 0.0);
        let p = axis.point_at(&AxisCoordinates { chainage: 110.0, right: 2.0, up: 1.0 });
        let c = axis.reversed(0.0).project(&p);
        assert!((c.right + 2.0).abs() < 1e-6 && (c.up - 1.0).abs() < 1e-9);
        assert!((c.chainage - (axis.length() - 10.0)).abs() < 1e-6);
    }

    #[test]
    fn bad_points_are_refused() {
        assert_eq!(Axis::through(&[Vec3::zeros(); 3], 0.0).unwrap_err(), Error::TooFewPoints { found: 1 });
        let nan = Vec3::new(f64::NAN, 0.0, 0.0);
        assert_eq!(Axis::through(&[Vec3::zeros(), nan], 0.0).unwrap_err(), Error::NotFinite { index: 1 });
    }
}
