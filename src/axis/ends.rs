//! The two points between which the axis of a network was asked for: whether it runs there, and from where to where.

use super::{Axis, Error};
use crate::numeric::Vec3;

/// An end nearer than this to where the tunnel ends means that place, in radii of the section.
const MEANS_THE_PORTAL_RADII: f64 = 2.0;
/// An end farther than this from the axis is not on it, in radii of the section.
const ON_THE_AXIS_RADII: f64 = 1.5;

/// The part of the chainages `covered` that lies between two given places, local metres.
///
/// # Errors
/// [`Error::EndNotReached`] when the axis does not pass one of them, or both are one place on it.
pub(super) fn between(ends: &[Vec3; 2], axis: &Axis, covered: (f64, f64), radius_m: f64) -> Result<(f64, f64), Error> {
    let grace_m = MEANS_THE_PORTAL_RADII * radius_m;
    let chainage = |which: usize| {
        let c = axis.project(&ends[which]);
        let beyond_m = (covered.0 - c.chainage).max(c.chainage - covered.1).max(0.0);
        let on_it = c.radius() <= ON_THE_AXIS_RADII * radius_m && beyond_m <= grace_m;
        if on_it { Ok(c.chainage) } else { Err(Error::EndNotReached { which, away_m: c.radius().hypot(beyond_m) }) }
    };
    let (a, b) = (chainage(0)?, chainage(1)?);
    let (low, high) = (a.min(b), a.max(b));
    if high - low < radius_m {
        // Two places beside each other: the way between them crosses the tunnel that was found.
        let which = usize::from(axis.project(&ends[1]).radius() > axis.project(&ends[0]).radius());
        return Err(Error::EndNotReached { which, away_m: axis.project(&ends[which]).radius() });
    }
    let start = if low - covered.0 > grace_m { low } else { covered.0 };
    let end = if covered.1 - high > grace_m { high } else { covered.1 };
    Ok((start, end))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn between_on_a_line(a: [f64; 3], b: [f64; 3]) -> Result<(f64, f64), Error> {
        let axis = Axis::through(&[Vec3::zeros(), Vec3::new(40.0, 0.0, 0.0)], 0.0).unwrap();
        between(&[Vec3::from(a), Vec3::from(b)], &axis, (1.0, 39.0), 2.0)
    }

    #[test]
    fn ends_inside_the_tunnel_cut_it_and_ends_near_the_portals_mean_them() {
        assert_eq!(between_on_a_line([0.0, 0.5, 0.0], [41.0, 0.0, 1.0]), Ok((1.0, 39.0)));
        assert_eq!(between_on_a_line([4.5, 0.0, 0.0], [36.0, 0.0, 0.0]), Ok((1.0, 39.0)));
        assert_eq!(between_on_a_line([30.0, 0.0, 0.0], [10.0, 1.0, 0.0]), Ok((10.0, 30.0)));
    }

    #[test]
    fn an_end_that_the_axis_does_not_pass_is_told() {
        let far = between_on_a_line([10.0, 0.0, 0.0], [30.0, 4.0, 3.0]);
        assert_eq!(far, Err(Error::EndNotReached { which: 1, away_m: 5.0 }));
        let beyond = between_on_a_line([50.0, 0.0, 0.0], [30.0, 0.0, 0.0]);
        assert_eq!(beyond, Err(Error::EndNotReached { which: 0, away_m: 11.0 }));
        let across = between_on_a_line([20.0, -1.0, 0.0], [20.5, 2.5, 0.0]);
        assert_eq!(across, Err(Error::EndNotReached { which: 1, away_m: 2.5 }));
    }

    /// Two galleries of 2.4 x 2.4 m: 24 m along x, and 15 m along y that leaves it at x = 8. Points every 8 cm.
    fn junction() -> Vec<Vec3> {
        let within = |p: &Vec3, low: [f64; 2], high: [f64; 2]| {
            (0..2).all(|a| p[a] > low[a] && p[a] < high[a]) && p.z > 0.0 && p.z < 2.4
        };
        let inside = |p: &Vec3| within(p, [-1.0, -1.2], [25.0, 1.2]) || within(p, [6.8, 1.0], [9.2, 16.2]);
        let step = 0.08;
        let mut points = Vec::new();
        for i in 0..300 {
            for j in -18..206 {
                for k in -1..31 {
                    let p = [i, j, k].map(|n| (f64::from(n) + 0.5) * step).into();
                    let beside = [Vec3::x(), Vec3::y(), Vec3::z()].map(|a| [p + a * step, p - a * step]);
                    if !inside(&p) && beside.iter().flatten().any(&inside) {
                        points.push(p);
                    }
                }
            }
        }
        points
    }

    #[test]
    fn a_side_drift_is_followed_between_its_ends() {
        use crate::axis::{Settings, trace};
        let points = junction();
        let followed = |a: [f64; 3], b: [f64; 3]| {
            trace(&points, &Settings { ends: Some([a, b]), ..Settings::default() }).map(|(axis, _)| axis)
        };
        let (main, summary) = trace(&points, &Settings::default()).unwrap();
        assert!((main.length() - 24.0).abs() < 1.0, "{}", main.length());
        assert_eq!(summary.branches.len(), 1);

        let side = followed([8.0, 0.0, 1.2], [8.0, 15.0, 1.2]).unwrap();
        assert!((13.0..18.0).contains(&side.length()), "{}", side.length());
        let direction = side.frame_at(side.end_chainage() - 5.0).forward;
        assert!(direction.y.abs() > 0.99, "{direction}");

        let part = followed([5.0, 0.0, 1.2], [19.0, 0.0, 1.2]).unwrap();
        assert!((part.length() - 14.0).abs() < 0.3, "{}", part.length());

        let nowhere = followed([2.0, 0.0, 1.2], [8.0, 40.0, 1.2]).unwrap_err();
        assert!(matches!(nowhere, Error::EndNotReached { which: 1, away_m } if away_m > 20.0), "{nowhere}");
    }
}
