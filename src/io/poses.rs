//! Poses of scans given in a TOML file: one 4x4 matrix for each input file.
//!
//! ```toml
//! [[scan]]
//! file = "station_1.laz"
//! pose = [[0.0, -1.0, 0.0, 12.5], [1.0, 0.0, 0.0, 3.0], [0.0, 0.0, 1.0, 1.7], [0.0, 0.0, 0.0, 1.0]]
//! ```
//! Rows of the matrix are written one after the other; it multiplies columns: `scan = pose * (x, y, z, 1)`.

use super::error::Error;
use super::file_scan::FileScan;
use crate::cloud::Station;
use crate::numeric::{Mat3, Vec3};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// The poses of all scans that have one.
#[derive(Clone, Debug, Default)]
pub(super) struct Poses {
    scans: Vec<(PathBuf, Pose)>,
}

/// A rigid motion from the coordinates of a file to those of the scan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pose {
    rotation: Mat3,
    translation: Vec3,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    scan: Vec<Scan>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Scan {
    file: PathBuf,
    pose: [[f64; 4]; 4],
}

impl Poses {
    /// Reads the poses and proves that every matrix is a rigid motion.
    pub(super) fn read(path: &Path) -> Result<Self, Error> {
        let text = std::fs::read_to_string(path).map_err(|e| Error::read(path, e))?;
        let bad = |cause: String| Error::Settings {
            key: "ingest.poses",
            cause: format!("'{}': {cause}", path.display()),
            remedy: "see docs/formats.md for its form".into(),
        };
        let file: File = toml::from_str(&text).map_err(|e| bad(e.to_string().trim().replace('\n', " ")))?;
        let mut poses = Self::default();
        for scan in file.scan {
            let m = scan.pose;
            let rotation = Mat3::from_fn(|r, c| m[r][c]);
            let translation = Vec3::from_fn(|r, _| m[r][3]);
            let error = (rotation.transpose() * rotation - Mat3::identity()).amax();
            let name = scan.file.display().to_string();
            if error.is_nan()
                || error > 1e-4
                || m[3] != [0.0, 0.0, 0.0, 1.0]
                || !translation.iter().all(|t| t.is_finite())
            {
                return Err(bad(format!(
                    "the pose of '{name}' is no rigid motion (its rotation is {error:.2e} from orthogonal, its last \
                     row {:?})",
                    m[3]
                )));
            }
            if rotation.determinant() < 0.0 {
                return Err(bad(format!("the pose of '{name}' mirrors the scan; left and right would swap")));
            }
            if poses.scans.iter().any(|(file, _)| *file == scan.file) {
                return Err(bad(format!("'{name}' has two poses")));
            }
            poses.scans.push((scan.file, Pose { rotation, translation }));
        }
        Ok(poses)
    }

    /// The pose of a file, by its path or else its name.
    pub(super) fn of(&self, path: &Path) -> Option<Pose> {
        let exact = self.scans.iter().find(|(file, _)| file == path);
        let named = || self.scans.iter().find(|(file, _)| file.components().count() == 1 && path.ends_with(file));
        exact.or_else(named).map(|s| s.1)
    }
}

impl Pose {
    /// Moves a scan that was read without an origin; a file without stations gets one where its own origin goes.
    pub(super) fn apply(&self, path: &Path, mut scan: FileScan, origin: Option<Vec3>) -> FileScan {
        let moved = |p: Vec3| self.rotation * p + self.translation;
        let from = scan.origin;
        for p in &mut scan.positions {
            *p = moved(*p + from);
        }
        if scan.stations.is_empty() {
            let name = path.file_stem().map_or_else(String::new, |s| s.to_string_lossy().into_owned());
            scan.stations = vec![Station { name, position_in_local: self.translation }];
            scan.attributes.station_ids = Some(vec![0; scan.positions.len()]);
        } else {
            for station in &mut scan.stations {
                station.position_in_local = moved(station.position_in_local + from);
            }
        }
        scan.origin = Vec3::zeros();
        scan.relative(origin)
    }
}
