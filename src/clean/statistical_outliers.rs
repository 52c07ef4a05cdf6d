//! Isolated points: those much farther from their neighbours than their neighbours are from theirs.
//!
//! With `d(p)` the mean distance of `p` to its `k` nearest neighbours, `r(p) = d(p) / median { d(q) : q neighbour }`.
//! A point goes when `r(p)` exceeds a limit. Unlike a limit on `d` itself this does not eat the sparse parts of an
//! uneven scan: every point of a lone profile has the same `d`, so `r` is 1 there.
//!
//! Reference: the classical rule (a limit on `d`) is from R. B. Rusu et al., "Towards 3D point cloud based object maps
//! for household environments", Robotics and Autonomous Systems 56(11), 2008, doi:10.1016/j.robot.2008.08.005; the ratio
//! to the neighbours is the idea of M. M. Breunig et al., "LOF: identifying density-based local outliers", SIGMOD 2000,
//! doi:10.1145/342009.335388, with a median so that outliers do not excuse each other.
//! The limit is chosen from the scan: six standard deviations of `ln r`, within the bounds of the settings. Sprays of
//! points whose neighbours are outliers too (dust, rain, multipath) have an unremarkable `r`; they go when `d` itself
//! exceeds a large multiple of its median. Cost: k nearest neighbours of every point.

use super::Error;
use crate::numeric::statistics::median;
use crate::spatial::nearest::BundleTree;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Most neighbours that the settings allow.
const MOST_NEIGHBOURS: usize = 16;
/// Standard deviations of `ln r` beyond which a point is isolated.
const SIGMAS: f64 = 6.0;
/// Makes the median absolute deviation of a normal distribution its standard deviation.
const SIGMA_FROM_MAD: f64 = 1.4826;

/// A point this many times farther from its neighbours than the typical point carries no surface.
const SPARSE_RATIO: f64 = 20.0;

/// Settings of the outlier removal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StatisticalOutliers {
    /// Whether isolated points are dropped at all.
    pub enabled: bool,
    /// Number of nearest neighbours looked at, 2 to 16.
    pub neighbours: usize,
    /// The automatic limit on the ratio is not below this.
    pub min_ratio: f64,
    /// The automatic limit on the ratio is not above this.
    pub max_ratio: f64,
}

impl Default for StatisticalOutliers {
    fn default() -> Self {
        Self { enabled: true, neighbours: 12, min_ratio: 2.5, max_ratio: 5.0 }
    }
}

impl StatisticalOutliers {
    pub(super) fn check(&self) -> Result<(), Error> {
        let refuse = |key, value, range| Err(Error::Setting { key, value, range });
        if !(2..=MOST_NEIGHBOURS).contains(&self.neighbours) {
            return refuse("statistical_outliers.neighbours", self.neighbours as f64, "2 to 16");
        }
        if !(self.min_ratio > 1.0 && self.min_ratio.is_finite()) {
            return refuse("statistical_outliers.min_ratio", self.min_ratio, "more than 1");
        }
        if !(self.max_ratio >= self.min_ratio) {
            return refuse("statistical_outliers.max_ratio", self.max_ratio, "at least min_ratio");
        }
        Ok(())
    }
}

/// Which points are not isolated, and the limit that decided.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// One flag per point.
    pub kept: Vec<bool>,
    /// Limit on the ratio; infinite when nothing was judged.
    pub ratio: f64,
    /// Limit on the mean distance to the neighbours, metres; infinite when nothing was judged.
    pub sparse_limit_m: f64,
}

/// Judges every point of the tree.
pub fn remove_statistical_outliers(tree: &BundleTree, settings: &StatisticalOutliers) -> Verdict {
    if !settings.enabled || tree.len() <= settings.neighbours {
        return Verdict { kept: vec![true; tree.len()], ratio: f64::INFINITY, sparse_limit_m: f64::INFINITY };
    }
    let k = settings.neighbours;
    // All along the curve of the tree, where neighbours are near in memory. The point itself is its own nearest
    // neighbour.
    let found: Vec<(f32, [u32; MOST_NEIGHBOURS])> = tree.for_each_place(k + 1, |place, neighbours| {
        let mut sum = 0.0;
        let mut others = [0; MOST_NEIGHBOURS];
        let all = neighbours.iter().filter(|n| n.index as usize != place).take(k);
        for (other, n) in others.iter_mut().zip(all) {
            *other = n.index;
            sum += n.distance_squared.sqrt();
        }
        ((sum / k as f64) as f32, others)
    });
    let own: Vec<f32> = found.par_iter().map(|f| f.0).collect();
    let logs: Vec<f64> = found
        .par_iter()
        .map(|(own_distance, neighbours)| {
            // Distances sort like their bits, and those sort faster.
            let mut theirs = [0u32; MOST_NEIGHBOURS];
            for (distance, &n) in theirs.iter_mut().zip(&neighbours[..k]) {
                *distance = own[n as usize].to_bits();
            }
            theirs[..k].sort_unstable();
            let at = |rank: usize| f64::from(f32::from_bits(theirs[rank]));
            let typical = 0.5 * (at((k - 1) / 2) + at(k / 2));
            let own_distance = f64::from(*own_distance);
            if own_distance <= typical { 0.0 } else { (own_distance / typical).ln() }
        })
        .collect();
    let (ratio, sparse_limit_m) = rayon::join(
        || limit(&logs).clamp(settings.min_ratio, settings.max_ratio),
        || {
            let mut distances: Vec<f64> = own.iter().map(|&d| f64::from(d)).collect();
            SPARSE_RATIO * median(&mut distances).unwrap_or(f64::INFINITY)
        },
    );
    let log_limit = ratio.ln();
    let is_kept = |(log, own): (&f64, &f32)| *log <= log_limit && f64::from(*own) <= sparse_limit_m;
    let kept = tree.in_point_order(logs.par_iter().zip(&own).map(is_kept).collect());
    Verdict { kept, ratio, sparse_limit_m }
}

fn limit(logs: &[f64]) -> f64 {
    // Only the upper half is kept apart (see above), so the deviation is taken about zero, where the median lies.
    let mut above: Vec<f64> = logs.iter().copied().filter(|l| *l > 0.0).collect();
    (SIGMAS * SIGMA_FROM_MAD * median(&mut above).unwrap_or(0.0)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::Vec3;
    use rand::{Rng, SeedableRng};

    #[test]
    fn sparse_parts_stay() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(11);
        // Density falls by a factor of 100 along x: the far end has a spacing of 0.3 m, the near end of 0.03 m.
        let mut points = Vec::new();
        while points.len() < 20_000 {
            let (x, y) = (random.random_range(0.0..20.0f64), random.random_range(0.0..4.0));
            if random.random_range(0.0..1.0) < (-x * 0.23).exp() {
                points.push(Vec3::new(x, y, 0.0));
            }
        }
        let wall = points.len();
        for i in 0..20 {
            points.push(Vec3::new(i as f64, 2.0, 1.5));
        }
        let verdict = remove_statistical_outliers(&BundleTree::new(&points), &StatisticalOutliers::default());
        let lost = verdict.kept[..wall].iter().filter(|k| !**k).count();
        assert!(lost < wall / 500, "{lost} of {wall} lost at ratio {}", verdict.ratio);
        let near = verdict.kept[wall..wall + 10].iter().filter(|k| **k).count();
        assert_eq!(near, 0, "outliers over the dense part stayed");
    }

    #[test]
    fn switched_off_keeps_all() {
        let points: Vec<Vec3> = (0..100).map(|i| Vec3::new(if i == 99 { 1e4 } else { i as f64 }, 0.0, 0.0)).collect();
        let off = StatisticalOutliers { enabled: false, ..Default::default() };
        assert!(remove_statistical_outliers(&BundleTree::new(&points), &off).kept.iter().all(|k| *k));
        assert!(!remove_statistical_outliers(&BundleTree::new(&points), &StatisticalOutliers::default()).kept[99]);
    }
}
