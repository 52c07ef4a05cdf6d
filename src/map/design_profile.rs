//! The design profile: the outline that the tunnel should have, around its axis.
//!
//! A CSV file of `right_m,up_m`: corners of a closed polygon in the section, metres to the right of the axis and above it
//! when facing increasing chainage. Lines that start with `#` and a heading are skipped.

use crate::axis::AxisCoordinates;

/// A closed outline in the section.
#[derive(Clone, Debug, PartialEq)]
pub struct DesignProfile {
    corners: Vec<[f64; 2]>,
}

/// Why a profile cannot be used.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum ProfileError {
    /// A line does not hold two numbers.
    #[error("line {line} of the design profile is '{text}'; expected right_m,up_m such as -2.5,1.2")]
    Line {
        /// Its number, from 1.
        line: usize,
        /// What it says.
        text: String,
    },
    /// Too few corners.
    #[error("the design profile has {found} corners; an outline needs at least 3")]
    TooFew {
        /// Corners found.
        found: usize,
    },
    /// The axis is not inside.
    #[error("the axis (0, 0) is not inside the design profile; give its corners relative to the axis, in metres")]
    AxisOutside,
}

impl DesignProfile {
    /// Reads the corners.
    ///
    /// # Errors
    /// [`ProfileError`].
    pub fn parse(text: &str) -> Result<Self, ProfileError> {
        let mut corners: Vec<[f64; 2]> = Vec::new();
        let mut headings = 1;
        for (i, line) in text.lines().enumerate() {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let numbers: Vec<Option<f64>> =
                line.split([',', ';', '\t']).map(|w| w.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect();
            match numbers.as_slice() {
                &[Some(right), Some(up)] => corners.push([right, up]),
                _ if corners.is_empty() && headings > 0 => headings -= 1,
                _ => return Err(ProfileError::Line { line: i + 1, text: line.to_owned() }),
            }
        }
        if corners.len() > 1 && corners.first() == corners.last() {
            corners.pop();
        }
        if corners.len() < 3 {
            return Err(ProfileError::TooFew { found: corners.len() });
        }
        let profile = Self { corners };
        if profile.contains([0.0, 0.0]) { Ok(profile) } else { Err(ProfileError::AxisOutside) }
    }

    /// Signed distance of a place from the outline, metres: positive inside it (rock where void should be).
    pub fn offset(&self, place: &AxisCoordinates) -> f64 {
        let p = [place.right, place.up];
        let distance = self.edges().map(|(a, b)| distance(p, a, b)).fold(f64::INFINITY, f64::min);
        if self.contains(p) { distance } else { -distance }
    }

    fn edges(&self) -> impl Iterator<Item = ([f64; 2], [f64; 2])> + '_ {
        (0..self.corners.len()).map(|i| (self.corners[i], self.corners[(i + 1) % self.corners.len()]))
    }

    /// Even-odd rule.
    fn contains(&self, [x, y]: [f64; 2]) -> bool {
        let crosses = |(a, b): &([f64; 2], [f64; 2])| {
            (a[1] > y) != (b[1] > y) && x < a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
        };
        self.edges().filter(crosses).count() % 2 == 1
    }
}

fn distance(p: [f64; 2], a: [f64; 2], b: [f64; 2]) -> f64 {
    let (d, q) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
    let length = d[0] * d[0] + d[1] * d[1];
    let t = if length > 0.0 { ((q[0] * d[0] + q[1] * d[1]) / length).clamp(0.0, 1.0) } else { 0.0 };
    (q[0] - t * d[0]).hypot(q[1] - t * d[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rock_inside_the_outline_is_positive() {
        let profile = DesignProfile::parse("right_m,up_m\n-2,-1\n2,-1\n2,3\n-2,3\n-2,-1\n").unwrap();
        let at = |right: f64, up: f64| profile.offset(&AxisCoordinates { chainage: 0.0, right, up });
        assert_eq!([at(1.8, 0.0), at(2.3, 0.0), at(0.0, -1.0)].map(|x| (x * 1e9).round() / 1e9), [0.2, -0.3, 0.0]);
        assert!((at(3.0, 4.0) + 2f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_outline_is_refused() {
        assert_eq!(DesignProfile::parse("0,0\n1,1\n"), Err(ProfileError::TooFew { found: 2 }));
        assert_eq!(DesignProfile::parse("5,5\n6,5\n6,6\n"), Err(ProfileError::AxisOutside));
        let error = DesignProfile::parse("x,y\n1,2\nthree,4\n").unwrap_err();
        assert_eq!(error, ProfileError::Line { line: 3, text: "three,4".into() });
    }
}
