//! How densely the surface was sampled along and around the tunnel: profile scans are dense in one direction only.
//!
//! For a sample of points, the nearest neighbour is found in the double cone along the axis (more along than around) and
//! in the one around it; the medians are the two spacings. A rotating profiler that was moved by 0.5 m gives 0.5 m along
//! and millimetres around, a static scanner gives about the same both ways. Cost: one 2D kd-tree of the points.

use crate::numeric::statistics;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;
use std::num::NonZero;

/// Points whose neighbourhood is looked at.
const SAMPLE: usize = 2000;
/// Neighbours looked at around each; enough to reach the next profile at 250 points a profile spacing.
const NEIGHBOURS: usize = 1500;
/// Ratio of the two spacings from which a scan counts as made of profiles.
const PROFILE_RATIO: f64 = 4.0;

/// Typical distances between neighbouring points on the surface.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Sampling {
    /// Median distance to the nearest neighbour along the tunnel, metres.
    pub along_m: f64,
    /// Median distance to the nearest neighbour around the section, metres.
    pub around_m: f64,
}

impl Sampling {
    /// Measures points given as (chainage, girth) in metres. `None` below 100 points.
    pub fn measure(points: &[[f64; 2]]) -> Option<Self> {
        if points.len() < 100 {
            return None;
        }
        let tree: ImmutableKdTree<f64, 2> = ImmutableKdTree::new_from_slice(points).ok()?;
        let stride = points.len().div_ceil(SAMPLE);
        let nearest: Vec<[f64; 2]> = (0..points.len())
            .into_par_iter()
            .step_by(stride)
            .map(|i| {
                let here = points[i];
                let mut best = [f64::INFINITY; 2];
                // Most queries are answered by a few neighbours; only profile scans need to look far.
                for count in [32, NEIGHBOURS] {
                    let count = NonZero::new(count).unwrap_or(NonZero::<usize>::MIN);
                    for near in tree.query(&here).nearest_n::<SquaredEuclidean<f64>>(count).execute() {
                        let other = points[near.item as usize];
                        let (ds, dg) = ((other[0] - here[0]).abs(), (other[1] - here[1]).abs());
                        let cone = usize::from(dg > ds);
                        let distance = ds.hypot(dg);
                        if distance > 0.0 {
                            best[cone] = best[cone].min(distance);
                        }
                    }
                    if best[0].is_finite() && best[1].is_finite() {
                        break;
                    }
                }
                best
            })
            .collect();
        let median = |cone: usize| {
            let mut finite: Vec<f64> = nearest.iter().map(|b| b[cone]).filter(|d| d.is_finite()).collect();
            // Directions in which half of the points see no neighbour at all are not measured.
            if finite.len() * 2 < nearest.len() { None } else { statistics::median(&mut finite) }
        };
        match (median(0), median(1)) {
            (Some(along_m), Some(around_m)) => Some(Self { along_m, around_m }),
            (Some(one), None) | (None, Some(one)) => Some(Self { along_m: one, around_m: one }),
            (None, None) => None,
        }
    }

    /// Whether the points lie on profiles across the tunnel with wide gaps between them.
    pub fn is_profiles(&self) -> bool {
        self.along_m > PROFILE_RATIO * self.around_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn profiles_are_told_from_an_even_scan() {
        let profiles: Vec<[f64; 2]> =
            (0..20).flat_map(|i| (0..2000).map(move |k| [f64::from(i) * 0.5, f64::from(k) * 0.01])).collect();
        let found = Sampling::measure(&profiles).unwrap();
        assert!((found.along_m - 0.5).abs() < 1e-9 && (found.around_m - 0.01).abs() < 1e-9, "{found:?}");
        assert!(found.is_profiles());
        let even: Vec<[f64; 2]> = (0..10_000u32)
            .map(|i| {
                [10.0 * (f64::from(i) * 0.618_033_988_75).fract(), 10.0 * (f64::from(i) * 0.754_877_666_25).fract()]
            })
            .collect();
        let found = Sampling::measure(&even).unwrap();
        assert!(!found.is_profiles() && found.along_m < 0.2 && found.around_m < 0.2, "{found:?}");
        assert_eq!(Sampling::measure(&even[..50]), None);
    }
}
