//! From all points of a scan to the points that carry its geometry: voxel means without isolated outliers.
//!
//! The scan's own points stay in the [`Cloud`]; every one of them knows the geometry point it went into, or that it
//! was dropped.

mod spacing;
mod statistical_outliers;
mod voxel_downsample;

pub use spacing::Spacing;
pub use statistical_outliers::{StatisticalOutliers, Verdict, remove_statistical_outliers};
pub use voxel_downsample::{VoxelDownsample, Voxels, voxel_downsample};

use crate::cloud::Cloud;
use crate::numeric::Vec3;
use crate::spatial::nearest::BundleTree;
use crate::warning::Warning;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Mark of a scan point that has no geometry point because it was dropped.
pub const DROPPED: u32 = u32::MAX;

/// A scan whose outliers exceed this share has a problem that a person should know about.
const MANY_OUTLIERS_PERCENT: f64 = 5.0;

/// How a scan is cleaned.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Thinning to one point per voxel.
    pub voxel_downsample: VoxelDownsample,
    /// Removal of isolated points.
    pub statistical_outliers: StatisticalOutliers,
}

/// What happened to the points.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Points of the scan.
    pub points: usize,
    /// Points at exactly the place of an earlier point.
    pub exact_duplicates: usize,
    /// Edge of the voxels, metres.
    pub cell_m: f64,
    /// Whether the edge was chosen automatically.
    pub cell_chosen_automatically: bool,
    /// Voxels that hold at least one point.
    pub occupied_voxels: usize,
    /// Voxels dropped as isolated outliers.
    pub outlier_voxels: usize,
    /// Scan points in them.
    pub outlier_points: usize,
    /// A voxel was an outlier when its mean distance to its neighbours exceeded this multiple of theirs.
    pub outlier_ratio: f64,
    /// A voxel was also an outlier when its mean distance to its neighbours exceeded this, metres.
    pub sparse_limit_m: f64,
    /// Geometry points that remain.
    pub geometry_points: usize,
    /// Their spacing.
    pub spacing: Spacing,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Why a scan cannot be cleaned.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// The scan has no points.
    #[error("the scan has no points")]
    NoPoints,
    /// The scan has more points than indices.
    #[error("the scan has {found} points, at most {limit} can be handled at once: split it along the tunnel")]
    TooManyPoints {
        /// Points of the scan.
        found: usize,
        /// Most points that are possible.
        limit: usize,
    },
    /// A setting is out of its range.
    #[error("clean.{key} = {value} is out of range: {range}")]
    Setting {
        /// The key in the pipeline file.
        key: &'static str,
        /// What was given.
        value: f64,
        /// What is possible.
        range: &'static str,
    },
    /// Outlier removal left too little.
    #[error("only {kept} of {found} points are left after outlier removal; raise clean.statistical_outliers.max_ratio")]
    NothingLeft {
        /// Voxels before.
        found: usize,
        /// Voxels after.
        kept: usize,
    },
}

/// The points that carry the geometry of a scan, in Morton order: neighbours in space are near in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct GeometryCloud {
    positions: Vec<Vec3>,
    tree: BundleTree,
    counts: Vec<u32>,
    first_points: Vec<u32>,
    geometry_of_point: Vec<u32>,
    cell_m: f64,
    spacing: Spacing,
}

impl GeometryCloud {
    /// A geometry cloud that takes every position as it is: one geometry point per position.
    pub fn from_positions(positions: Vec<Vec3>) -> Self {
        let indices: Vec<u32> = (0..positions.len() as u32).collect();
        let tree = BundleTree::new(&positions);
        let spacing = Spacing::estimate_with(&positions, &tree);
        Self {
            counts: vec![1; positions.len()],
            first_points: indices.clone(),
            geometry_of_point: indices,
            cell_m: spacing.along_m,
            spacing,
            positions,
            tree,
        }
    }

    /// Number of geometry points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Means of the scan points per voxel, local metres.
    pub fn positions(&self) -> &[Vec3] {
        &self.positions
    }

    /// The tree over the positions, for all who look for neighbours.
    pub fn tree(&self) -> &BundleTree {
        &self.tree
    }

    /// How many scan points went into each geometry point.
    pub fn counts(&self) -> &[u32] {
        &self.counts
    }

    /// Index in the cloud of the first scan point of each geometry point: the place to look up a station or a source.
    pub fn first_points(&self) -> &[u32] {
        &self.first_points
    }

    /// For each scan point its geometry point, or [`DROPPED`].
    pub fn geometry_of_point(&self) -> &[u32] {
        &self.geometry_of_point
    }

    /// Edge of the voxels, metres.
    pub fn cell_m(&self) -> f64 {
        self.cell_m
    }

    /// Typical distance between neighbouring geometry points, in the dense and in the sparse direction.
    pub fn spacing(&self) -> Spacing {
        self.spacing
    }
}

/// Thins the scan to one point per voxel and drops isolated outliers.
///
/// # Errors
/// [`Error`]: no points, too many, or a setting out of range.
pub fn clean(cloud: &Cloud, settings: &Settings) -> Result<(GeometryCloud, Summary), Error> {
    let points = cloud.positions();
    if points.is_empty() {
        return Err(Error::NoPoints);
    }
    if points.len() >= DROPPED as usize {
        return Err(Error::TooManyPoints { found: points.len(), limit: DROPPED as usize - 1 });
    }
    settings.voxel_downsample.check()?;
    settings.statistical_outliers.check()?;

    let mut voxels = voxel_downsample(points, &settings.voxel_downsample);
    let occupied_voxels = voxels.positions.len();
    let verdict = remove_statistical_outliers(&voxels.tree, &settings.statistical_outliers);
    let outlier_points = voxels.counts.iter().zip(&verdict.kept).filter(|(_, k)| !**k).map(|(c, _)| *c as usize).sum();
    voxels.keep(&verdict.kept);
    if voxels.positions.is_empty() {
        return Err(Error::NothingLeft { found: occupied_voxels, kept: 0 });
    }
    let outlier_voxels = occupied_voxels - voxels.positions.len();
    let mut warnings = Vec::new();
    let outlier_percent = 100.0 * outlier_points as f64 / points.len() as f64;
    if outlier_percent > MANY_OUTLIERS_PERCENT {
        warnings.push(Warning::new(
            "many-outliers",
            format!(
                "{outlier_percent:.1} % of the points ({outlier_points}) were dropped as isolated; if they are rock, \
                 raise clean.statistical_outliers.max_ratio or switch the step off with enabled = false"
            ),
        ));
    }
    let spacing = Spacing::estimate_with(&voxels.positions, &voxels.tree);
    let summary = Summary {
        points: points.len(),
        exact_duplicates: voxels.exact_duplicates,
        cell_m: voxels.cell_m,
        cell_chosen_automatically: settings.voxel_downsample.cell_m.is_none(),
        occupied_voxels,
        outlier_voxels,
        outlier_points,
        outlier_ratio: verdict.ratio,
        sparse_limit_m: verdict.sparse_limit_m,
        geometry_points: voxels.positions.len(),
        spacing,
        warnings,
    };
    let Voxels { positions, counts, first_points, geometry_of_point, cell_m, tree, .. } = voxels;
    Ok((GeometryCloud { positions, tree, counts, first_points, geometry_of_point, cell_m, spacing }, summary))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{Attributes, ScanFrame, SourceFile};
    use rand::{Rng, SeedableRng};

    fn cloud(positions: Vec<Vec3>) -> Cloud {
        let n = positions.len();
        let source = SourceFile {
            path: "a.las".into(),
            first_point: 0,
            point_count: n,
            record_count: n as u64,
            dropped_records: Default::default(),
        };
        Cloud::new(ScanFrame::local(), positions, Attributes::default(), vec![source], vec![]).unwrap()
    }

    /// Profiles of 4 m radius every 0.5 m along x, a point each 4 mm, and outliers 1 to 11 m off the wall.
    fn profile_scan() -> (Vec<Vec3>, usize) {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let mut points = Vec::new();
        for profile in 0..40 {
            for i in 0..6283 {
                let angle = i as f64 * 0.001;
                let radius = 4.0 + random.random_range(-0.004..0.004) + 0.2 * (5.0 * angle).sin();
                points.push(Vec3::new(0.5 * profile as f64, radius * angle.cos(), radius * angle.sin()));
            }
        }
        let wall = points.len();
        for _ in 0..60 {
            let (angle, radius): (f64, f64) =
                (random.random_range(0.0..std::f64::consts::TAU), random.random_range(5.5..15.0));
            points.push(Vec3::new(random.random_range(15.0..19.5), radius * angle.cos(), radius * angle.sin()));
        }
        (points, wall)
    }

    #[test]
    fn profiles_stay_and_outliers_go() {
        let (points, wall) = profile_scan();
        let (geometry, summary) = clean(&cloud(points.clone()), &Settings::default()).unwrap();
        let kept_wall = (0..wall).filter(|&i| geometry.geometry_of_point()[i] != DROPPED).count();
        let kept_outliers = (wall..points.len()).filter(|&i| geometry.geometry_of_point()[i] != DROPPED).count();
        assert!(kept_wall as f64 > 0.9999 * wall as f64, "{kept_wall} of {wall}, {summary:?}");
        assert!(kept_outliers <= 3, "{kept_outliers} outliers stayed");
        assert!((summary.spacing.across_m - 0.5).abs() < 0.02, "{summary:?}");
        assert!(summary.spacing.along_m < 0.05 && geometry.cell_m() < 0.05, "{summary:?}");
    }

    #[test]
    fn every_point_is_accounted_for() {
        let (points, _) = profile_scan();
        let (geometry, summary) = clean(&cloud(points.clone()), &Settings::default()).unwrap();
        let in_geometry: usize = geometry.counts().iter().map(|&c| c as usize).sum();
        assert_eq!(in_geometry + summary.outlier_points, points.len());
        assert_eq!(geometry.len() + summary.outlier_voxels, summary.occupied_voxels);
        for (i, p) in points.iter().enumerate() {
            let of = geometry.geometry_of_point()[i];
            if of != DROPPED {
                let gap = (geometry.positions()[of as usize] - p).norm();
                assert!(gap <= geometry.cell_m() * 3f64.sqrt());
            }
        }
        for (g, &first) in geometry.first_points().iter().enumerate() {
            assert_eq!(geometry.geometry_of_point()[first as usize] as usize, g);
        }
    }

    #[test]
    fn same_bytes_on_any_number_of_threads() {
        let (points, _) = profile_scan();
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| clean(&cloud(points.clone()), &Settings::default()).unwrap().0)
        };
        assert_eq!(run(1), run(3));
    }

    #[test]
    fn thousands_of_missing_returns_at_one_place_go() {
        let (mut points, wall) = profile_scan();
        points.truncate(wall);
        points.extend(std::iter::repeat_n(Vec3::new(3.2, 0.1, 0.2), 3000));
        let (_, summary) = clean(&cloud(points), &Settings::default()).unwrap();
        assert_eq!((summary.exact_duplicates, summary.outlier_points), (2999, 3000));
    }

    #[test]
    fn unusable_input_is_refused() {
        assert_eq!(clean(&cloud(vec![]), &Settings::default()).unwrap_err(), Error::NoPoints);
        let mut settings = Settings::default();
        settings.voxel_downsample.cell_m = Some(-1.0);
        let error = clean(&cloud(vec![Vec3::zeros()]), &settings).unwrap_err();
        assert!(error.to_string().contains("clean.voxel_downsample.cell_m = -1"), "{error}");
    }

    #[test]
    fn a_handful_of_points_survives() {
        for n in 1..6 {
            let points = (0..n).map(|i| Vec3::new(i as f64, 0.0, 0.0)).collect();
            let (geometry, _) = clean(&cloud(points), &Settings::default()).unwrap();
            assert_eq!(geometry.len(), n);
        }
    }
}
