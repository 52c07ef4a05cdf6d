//! Spacing and density of a scan around a few of its points, while all of them come by.

use crate::numeric::{Vec3, statistics};
use rayon::prelude::*;

/// Points whose neighbourhood is looked at.
const SEEDS: usize = 48;
/// Neighbours that a density is taken from.
const NEIGHBOURS: usize = 32;
/// Points of a block that is passed over when it lies too far from a seed.
const BLOCK: usize = 512;

/// Collects the nearest neighbours of a few seeds.
pub(super) struct NeighbourhoodPass {
    seeds: Vec<Seed>,
}

struct Seed {
    at: Vec3,
    /// Squared distances of the nearest points, ascending; points at the seed itself do not count.
    nearest: Vec<f64>,
}

impl NeighbourhoodPass {
    /// Starts with the given seeds; without any they are taken from the first points that come by.
    pub(super) fn new(seeds: Vec<Vec3>) -> Self {
        Self { seeds: seeds.into_iter().map(Seed::new).collect() }
    }

    pub(super) fn add(&mut self, positions: &[Vec3]) {
        if self.seeds.is_empty() {
            let count = SEEDS.min(positions.len());
            self.seeds = (0..count).map(|k| Seed::new(positions[k * positions.len() / count])).collect();
        }
        let boxes: Vec<(Vec3, Vec3)> = positions
            .par_chunks(BLOCK)
            .map(|block| block.iter().fold((block[0], block[0]), |(low, high), p| (low.inf(p), high.sup(p))))
            .collect();
        self.seeds.par_iter_mut().for_each(|seed| {
            for (block, (low, high)) in positions.chunks(BLOCK).zip(&boxes) {
                let outside = (low - seed.at).sup(&(seed.at - high)).sup(&Vec3::zeros());
                if outside.norm_squared() < seed.limit() {
                    block.iter().for_each(|p| seed.add(p));
                }
            }
        });
    }

    /// Median distance to the nearest neighbour and median number of points in a unit of area.
    ///
    /// The density counts points in the disc that holds the 32 nearest neighbours: count / (pi r^2).
    pub(super) fn spacing_and_density(&self) -> (Option<f64>, Option<f64>) {
        let full = |s: &&Seed| s.nearest.len() == NEIGHBOURS;
        let density = |s: &Seed| NEIGHBOURS as f64 / (std::f64::consts::PI * s.nearest[NEIGHBOURS - 1]);
        let mut distances: Vec<f64> = self.seeds.iter().filter_map(|s| Some(s.nearest.first()?.sqrt())).collect();
        let mut densities: Vec<f64> = self.seeds.iter().filter(full).map(density).collect();
        (statistics::median(&mut distances), statistics::median(&mut densities))
    }
}

impl Seed {
    fn new(at: Vec3) -> Self {
        Self { at, nearest: Vec::with_capacity(NEIGHBOURS + 1) }
    }

    /// Points at this squared distance or farther change nothing.
    fn limit(&self) -> f64 {
        if self.nearest.len() == NEIGHBOURS { self.nearest[NEIGHBOURS - 1] } else { f64::INFINITY }
    }

    fn add(&mut self, p: &Vec3) {
        let d = (p - self.at).norm_squared();
        if d > 0.0 && d < self.limit() {
            let at = self.nearest.partition_point(|&n| n < d);
            self.nearest.insert(at, d);
            self.nearest.truncate(NEIGHBOURS);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_lattice_in_batches() {
        // 5 mm apart: 40 000 points in a square metre.
        let points: Vec<Vec3> =
            (0..40_000).map(|i| Vec3::new(f64::from(i % 200) * 0.005, f64::from(i / 200) * 0.005, 0.0)).collect();
        let inner = [10_050, 20_100, 30_150].map(|i| points[i]);
        let mut whole = NeighbourhoodPass::new(inner.to_vec());
        whole.add(&points);
        let mut parts = NeighbourhoodPass::new(inner.to_vec());
        points.chunks(777).for_each(|part| parts.add(part));
        let (spacing, density) = whole.spacing_and_density();
        assert!((spacing.unwrap() - 0.005).abs() < 1e-12);
        assert!((density.unwrap() / 40_000.0 - 1.0).abs() < 0.15, "{density:?}");
        assert_eq!(parts.spacing_and_density(), (spacing, density));
    }
}
