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
pub struct Pose {
    /// A rotation matrix.
    pub rotation: Mat3,
    /// Added after the rotation, scan units.
    pub translation: Vec3,
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

    /// The pose of a file, by its path, or by the end of its path that the entry names.
    pub(super) fn of(&self, path: &Path) -> Option<Pose> {
        let exact = self.scans.iter().find(|(file, _)| file == path);
        let named = || self.scans.iter().find(|(file, _)| file.is_relative() && path.ends_with(file));
        exact.or_else(named).map(|s| s.1)
    }
}

/// Writes poses as `ingest.poses` reads them; each has a remark, which becomes a comment.
///
/// # Errors
/// [`Error::Write`] when the operating system refuses. The file appears whole or not at all.
pub fn write_poses(path: &Path, scans: &[(PathBuf, Pose, String)]) -> Result<(), Error> {
    let mut text = String::from("# Poses by `adit register`, for ingest.poses: scan = pose * (x, y, z, 1).\n");
    for (file, pose, remark) in scans {
        for line in remark.lines() {
            text += &format!("\n# {line}");
        }
        let name = toml::Value::String(file.display().to_string());
        text += &format!("\n[[scan]]\nfile = {name}\npose = [\n");
        for r in 0..3 {
            let m = |c| pose.rotation[(r, c)];
            text += &format!("  [{:?}, {:?}, {:?}, {:?}],\n", m(0), m(1), m(2), pose.translation[r]);
        }
        text += "  [0.0, 0.0, 0.0, 1.0],\n]\n";
    }
    let unfinished = path.with_extension("toml.part");
    std::fs::write(&unfinished, text)
        .and_then(|()| std::fs::rename(&unfinished, path))
        .map_err(|e| Error::write(path, e))
}

impl Pose {
    /// The pose of a file that is in scan coordinates already.
    pub(super) fn identity() -> Self {
        Self { rotation: Mat3::identity(), translation: Vec3::zeros() }
    }

    /// Scan coordinates of a point of the file.
    pub(super) fn apply_to(&self, point: &Vec3) -> Vec3 {
        self.rotation * point + self.translation
    }

    /// Moves a scan that was read without an origin; a file without stations gets one where its own origin goes.
    pub(super) fn apply(&self, path: &Path, mut scan: FileScan, origin: Option<Vec3>) -> FileScan {
        let moved = |p: Vec3| self.apply_to(&p);
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
