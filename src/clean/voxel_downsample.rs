//! One point per voxel: the mean of the scan points in it.
//!
//! Use it to even out the density of a scan (near the scanner it is a hundred times that of far walls) and to average
//! noise where there are many points. The edge is chosen automatically so that the geometry keeps its detail: as small
//! as [`VoxelDownsample::max_points`] allows, and no smaller than what merges a quarter of the points. A scan of
//! profiles has its detail limited by the distance between profiles, so there the edge is at least 1/20 of it.
//!
//! Guarantees: voxels in Morton order, means summed in point order, the same bytes on any number of threads.
//! Cost: one sort of the points, and a few of a sixteenth of them to choose the edge.

use super::{DROPPED, Error, Spacing};
use crate::numeric::Vec3;
use crate::spatial::nearest::BundleTree;
use crate::spatial::voxel_grid::{VoxelGrid, bounds};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Share of the points that remain when the density does not force more merging.
const KEPT_SHARE: f64 = 0.75;
/// Profiles this far apart in units of the edge mean that detail along the profile is useless to the surface.
const EDGES_BETWEEN_PROFILES: f64 = 20.0;
/// No scanner resolves less, metres.
const SMALLEST_EDGE_M: f64 = 0.0005;
/// In clouds above this size only a sixteenth of the voxels is counted.
const COUNT_ALL_BELOW: usize = 1_000_000;

/// Settings of the voxel downsampling.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VoxelDownsample {
    /// Edge of a voxel in metres. Chosen from the density when not given.
    pub cell_m: Option<f64>,
    /// The automatic edge gives at most about this many geometry points.
    pub max_points: usize,
}

impl Default for VoxelDownsample {
    fn default() -> Self {
        Self { cell_m: None, max_points: 2_500_000 }
    }
}

impl VoxelDownsample {
    pub(super) fn check(&self) -> Result<(), Error> {
        if let Some(value) = self.cell_m.filter(|c| !(c.is_finite() && *c >= 1e-6)) {
            return Err(Error::Setting { key: "voxel_downsample.cell_m", value, range: "at least 1e-6 m" });
        }
        if self.max_points < 1000 {
            let value = self.max_points as f64;
            return Err(Error::Setting { key: "voxel_downsample.max_points", value, range: "at least 1000" });
        }
        Ok(())
    }
}

/// Occupied voxels in Morton order.
#[derive(Clone, Debug)]
pub struct Voxels {
    /// Mean of the points of each voxel.
    pub positions: Vec<Vec3>,
    /// Points of each voxel.
    pub counts: Vec<u32>,
    /// First point of each voxel.
    pub first_points: Vec<u32>,
    /// For each point its voxel, or [`DROPPED`].
    pub geometry_of_point: Vec<u32>,
    /// Points at exactly the place of an earlier one.
    pub exact_duplicates: usize,
    /// Edge of a voxel, metres.
    pub cell_m: f64,
    /// The tree over `positions`; its places are the voxels.
    pub tree: BundleTree,
}

impl Voxels {
    /// Drops the voxels that are not `kept`; their points become [`DROPPED`].
    pub fn keep(&mut self, kept: &[bool]) {
        let mut next = 0;
        let renumbered: Vec<u32> = kept
            .iter()
            .map(|&k| {
                next += u32::from(k);
                if k { next - 1 } else { DROPPED }
            })
            .collect();
        if next as usize == kept.len() {
            return;
        }
        self.geometry_of_point.par_iter_mut().for_each(|v| *v = renumbered[*v as usize]);
        retain(&mut self.positions, kept);
        self.tree = BundleTree::of_ordered(&self.positions);
        retain(&mut self.counts, kept);
        retain(&mut self.first_points, kept);
    }
}

fn retain<T>(values: &mut Vec<T>, kept: &[bool]) {
    let mut flags = kept.iter();
    values.retain(|_| *flags.next().expect("one flag per value"));
}

/// Means of `points` (finite, local metres) per voxel.
pub fn voxel_downsample(points: &[Vec3], settings: &VoxelDownsample) -> Voxels {
    if let Some(cell_m) = settings.cell_m {
        return average(points, cell_m);
    }
    let voxels = average(points, choose_edge(points, settings.max_points));
    let profile_edge = Spacing::estimate_with(&voxels.positions, &voxels.tree).across_m / EDGES_BETWEEN_PROFILES;
    if profile_edge > voxels.cell_m { average(points, profile_edge) } else { voxels }
}

/// Averages per voxel of the given edge.
fn average(points: &[Vec3], cell_m: f64) -> Voxels {
    let grid = VoxelGrid::new(points, cell_m);
    let cells: Vec<(Vec3, u32, u32, u32)> = (0..grid.len())
        .into_par_iter()
        .with_min_len(4096)
        .map(|cell| {
            let members = grid.points_of(cell);
            let first = points[members[0] as usize];
            let sum: Vec3 = members.iter().map(|&i| points[i as usize] - first).sum();
            (first + sum / members.len() as f64, members.len() as u32, members[0], duplicates(points, members))
        })
        .collect();
    let voxel_of_points = || {
        let mut voxel_of_points = vec![0; points.len()];
        for cell in 0..grid.len() {
            for &i in grid.points_of(cell) {
                voxel_of_points[i as usize] = cell as u32;
            }
        }
        voxel_of_points
    };
    // The scattered writes keep one thread busy.
    let (geometry_of_point, (positions, tree)) = rayon::join(voxel_of_points, || {
        let positions: Vec<Vec3> = cells.par_iter().map(|c| c.0).collect();
        let tree = BundleTree::of_ordered(&positions);
        (positions, tree)
    });
    Voxels {
        positions,
        counts: cells.par_iter().map(|c| c.1).collect(),
        first_points: cells.par_iter().map(|c| c.2).collect(),
        exact_duplicates: cells.iter().map(|c| c.3 as usize).sum(),
        geometry_of_point,
        cell_m: grid.cell_m(),
        tree,
    }
}

/// How many members lie exactly where an earlier member lies.
fn duplicates(points: &[Vec3], members: &[u32]) -> u32 {
    if members.len() < 2 {
        return 0;
    }
    let mut bits: Vec<[u64; 3]> = members.iter().map(|&i| points[i as usize].map(f64::to_bits).into()).collect();
    bits.sort_unstable();
    bits.windows(2).filter(|pair| pair[0] == pair[1]).count() as u32
}

/// The edge at which the wanted number of voxels is occupied.
fn choose_edge(points: &[Vec3], max_points: usize) -> f64 {
    let (low, high) = bounds(points).expect("there are points");
    let extent = (high - low).amax();
    if extent <= 0.0 {
        return SMALLEST_EDGE_M;
    }
    let wanted_share = KEPT_SHARE.min(max_points as f64 / points.len() as f64);
    // The number of occupied voxels falls as the edge grows: bisection in the logarithm, to about 1 %.
    let (mut fine, mut coarse) = (SMALLEST_EDGE_M.ln(), (extent / 4.0).max(2.0 * SMALLEST_EDGE_M).ln());
    while coarse - fine > 0.01 {
        let middle = 0.5 * (fine + coarse);
        if occupied_share(points, middle.exp()) > wanted_share { fine = middle } else { coarse = middle }
    }
    coarse.exp()
}

/// The largest whole number that is not above `value`, as `floor` finds it but without a call.
fn whole_below(value: f64) -> i64 {
    let towards_zero = value as i64;
    towards_zero.wrapping_sub(i64::from(towards_zero as f64 > value))
}

/// Occupied voxels per point. In large clouds only the voxels of one in sixteen hash values are counted, with their
/// points.
fn occupied_share(points: &[Vec3], cell_m: f64) -> f64 {
    let skip_bits = if points.len() < COUNT_ALL_BELOW { 0 } else { 4 };
    let mut picked: Vec<u64> = points
        .par_iter()
        .filter_map(|p| {
            let [x, y, z]: [i64; 3] = p.map(|c| whole_below(c / cell_m)).into();
            let mixed = x.wrapping_mul(0x9E37_79B9_7F4A_7C15_u64 as i64)
                ^ y.wrapping_mul(0xC2B2_AE3D_27D4_EB4F_u64 as i64)
                ^ z.wrapping_mul(0x1656_67B1_9E37_79F9);
            let hash = (mixed as u64 ^ mixed as u64 >> 29).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            (skip_bits == 0 || hash >> (64 - skip_bits) == 0).then_some(hash)
        })
        .collect();
    let members = picked.len();
    picked.par_sort_unstable();
    picked.dedup();
    // A scan of very few voxels may have none of the counted ones: then the edge is far too coarse.
    if members == 0 { 0.0 } else { picked.len() as f64 / members as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    #[test]
    fn cells_are_counted_as_floor_counts_them() {
        for value in [0.0, -0.0, 0.5, -0.5, 3.0, -3.0, -3.000_000_1, 2.999_999_9, 1e15 + 0.5, -1e15 - 0.5, 1e300, -1e17]
        {
            assert_eq!(whole_below(value), f64::floor(value) as i64, "{value}");
        }
    }

    #[test]
    fn means_are_means() {
        let points = [Vec3::new(0.1, 0.1, 0.1), Vec3::new(5.0, 0.0, 0.0), Vec3::new(0.3, 0.5, 0.7)];
        let voxels = voxel_downsample(&points, &VoxelDownsample { cell_m: Some(1.0), ..Default::default() });
        assert_eq!(voxels.counts, [2, 1]);
        assert!((voxels.positions[0] - Vec3::new(0.2, 0.3, 0.4)).norm() < 1e-15);
        assert_eq!(voxels.geometry_of_point, [0, 1, 0]);
        assert_eq!(voxels.first_points, [0, 1]);
    }

    #[test]
    fn automatic_edge_keeps_the_wanted_number() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        // A plane of 10 x 10 m with 1.2 M points: above the size at which voxels are sampled.
        let points: Vec<Vec3> = (0..1_200_000)
            .map(|_| Vec3::new(random.random_range(0.0..10.0), random.random_range(0.0..10.0), 0.0))
            .collect();
        let voxels = voxel_downsample(&points, &VoxelDownsample { max_points: 100_000, ..Default::default() });
        let n = voxels.positions.len() as f64;
        assert!((n - 100_000.0).abs() < 5_000.0, "{n} voxels of {} m", voxels.cell_m);
    }
}
