//! Planes of what was traced: orientation with its quality, sets, spacing, intensity, the stereonet, and the way back: the
//! curves in which given planes cut the surface.
//!
//! Axes: x east, y north, z up. Dip 0 to 90 degrees down from horizontal, dip direction 0 to 360 degrees clockwise from
//! north; neither depends on the sign of a normal.

mod fit;
mod intersection;
mod sets;
mod statistics;
mod stereonet;

pub use fit::{FitSettings, PlaneFit, Reliability, fit_line, fit_points};
pub use intersection::{Curve, curves};
pub use sets::{Set, SetSettings, given_sets, sets};
pub use statistics::{
    Crossing, Interval, Scanline, Spacing, StatisticsSettings, Summary, TraceOnMap, scanlines, statistics,
};
pub use stereonet::{Stereonet, StereonetPole};

use crate::numeric::Vec3;

/// Why planes cannot be told.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// A setting has a value that makes no sense.
    #[error("planes setting '{key}' is {value}, but must be {must}")]
    Setting {
        /// The key.
        key: &'static str,
        /// The value given.
        value: f64,
        /// What would be accepted.
        must: &'static str,
    },
    /// An orientation out of range.
    #[error(
        "'{name}' has dip {dip_deg} and dip direction {dip_direction_deg}: dips go from 0 to 90 degrees, directions from 0 to 360"
    )]
    Orientation {
        /// Name of the plane or set.
        name: String,
        /// Dip.
        dip_deg: f64,
        /// Dip direction.
        dip_direction_deg: f64,
    },
}

/// The upward unit normal of a plane; of a vertical one that which points to its dip direction below 180 degrees.
pub fn upward(normal: &Vec3) -> Vec3 {
    let unit = normal.normalize();
    let up = unit.z > 0.0 || (unit.z == 0.0 && (unit.x > 0.0 || (unit.x == 0.0 && unit.y > 0.0)));
    if up { unit } else { -unit }
}

/// Dip and dip direction of the plane with a normal, degrees.
pub fn dip_of(normal: &Vec3) -> (f64, f64) {
    let n = upward(normal);
    let dip = n.x.hypot(n.y).atan2(n.z).to_degrees();
    let direction = n.x.atan2(n.y).to_degrees().rem_euclid(360.0);
    // -0.0000001 comes out as 360.
    (dip, if direction >= 360.0 { 0.0 } else { direction })
}

/// The upward unit normal of a plane with dip and dip direction, degrees.
pub fn normal_of(dip_deg: f64, dip_direction_deg: f64) -> Vec3 {
    let (dip, direction) = (dip_deg.to_radians(), dip_direction_deg.to_radians());
    Vec3::new(dip.sin() * direction.sin(), dip.sin() * direction.cos(), dip.cos())
}

/// Angle between two planes, degrees, 0 to 90.
pub fn angle_between_planes_deg(a: &Vec3, b: &Vec3) -> f64 {
    a.cross(b).norm().atan2(a.dot(b).abs()).to_degrees()
}

/// Refuses orientations out of range.
///
/// # Errors
/// [`Error::Orientation`].
pub fn check_orientation(name: &str, dip_deg: f64, dip_direction_deg: f64) -> Result<(), Error> {
    if (0.0..=90.0).contains(&dip_deg) && (0.0..=360.0).contains(&dip_direction_deg) {
        return Ok(());
    }
    Err(Error::Orientation { name: name.to_owned(), dip_deg, dip_direction_deg })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orientation_does_not_depend_on_the_sign_of_the_normal() {
        for (dip, direction) in [(0.5, 10.0), (10.0, 0.0), (45.0, 90.0), (85.0, 217.0), (89.9, 359.5)] {
            let n = normal_of(dip, direction);
            for normal in [n, -n, n * 3.0] {
                let (d, a) = dip_of(&normal);
                assert!((d - dip).abs() < 1e-9 && (a - direction).abs() < 1e-7, "{d} {a}");
            }
        }
        // Vertical: the two directions are one plane, and one of them is told.
        let n = normal_of(90.0, 300.0);
        assert_eq!(dip_of(&n), dip_of(&-n));
    }
}
