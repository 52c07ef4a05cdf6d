//! Poses of scans given in a TOML file: one 4x4 matrix for each input file, or for each station in it.
//!
//! ```toml
//! [[scan]]
//! file = "station_1.laz"
//! pose = [[0.0, -1.0, 0.0, 12.5], [1.0, 0.0, 0.0, 3.0], [0.0, 0.0, 1.0, 1.7], [0.0, 0.0, 0.0, 1.0]]
//! ```
//! Rows of the matrix are written one after the other; it multiplies columns: `scan = pose * (x, y, z, 1)`. With `station = 2`
//! the entry is for the second station in the file only, on top of the pose that the file itself has for it.

use super::error::Error;
use super::file_scan::FileScan;
use crate::cloud::Station;
use crate::numeric::{Mat3, Vec3};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// The poses of all scans that have one.
#[derive(Clone, Debug, Default)]
pub(super) struct Poses {
    scans: Vec<(PathBuf, Option<u16>, Pose)>,
}

/// The poses of one file.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct FilePoses {
    whole: Option<Pose>,
    /// Number of the station, from 1, and its pose.
    stations: Vec<(u16, Pose)>,
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
    station: Option<u16>,
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
            let station = scan.station.map_or_else(String::new, |s| format!("station {s} of "));
            let name = format!("{station}'{}'", scan.file.display());
            if scan.station == Some(0) {
                return Err(bad(format!("{name}: stations are numbered from 1")));
            }
            if error.is_nan()
                || error > 1e-4
                || m[3] != [0.0, 0.0, 0.0, 1.0]
                || !translation.iter().all(|t| t.is_finite())
            {
                return Err(bad(format!(
                    "the pose of {name} is no rigid motion (its rotation is {error:.2e} from orthogonal, its last \
                     row {:?})",
                    m[3]
                )));
            }
            if rotation.determinant() < 0.0 {
                return Err(bad(format!("the pose of {name} mirrors the scan; left and right would swap")));
            }
            if poses.scans.iter().any(|(file, station, _)| (file, station) == (&scan.file, &scan.station)) {
                return Err(bad(format!("{name} has two poses")));
            }
            poses.scans.push((scan.file, scan.station, Pose { rotation, translation }));
        }
        Ok(poses)
    }

    /// The poses of a file, by its path, or by the end of its path that the entries name.
    pub(super) fn of(&self, path: &Path) -> FilePoses {
        let exact = self.scans.iter().any(|(file, ..)| file == path);
        let named = |file: &PathBuf| if exact { file == path } else { file.is_relative() && path.ends_with(file) };
        let mut poses = FilePoses::default();
        for (_, station, pose) in self.scans.iter().filter(|(file, ..)| named(file)) {
            match station {
                Some(station) => poses.stations.push((*station, *pose)),
                None => poses.whole = poses.whole.or(Some(*pose)),
            }
        }
        poses
    }
}

/// A pose to be written.
#[derive(Clone, Debug)]
pub struct PoseEntry {
    /// The file.
    pub file: PathBuf,
    /// Number of the station in the file, from 1; none for the whole file.
    pub station: Option<u16>,
    /// From the coordinates of the file to those of the scan.
    pub pose: Pose,
    /// Becomes a comment.
    pub remark: String,
}

/// Writes poses as `ingest.poses` reads them.
///
/// # Errors
/// [`Error::Write`] when the operating system refuses. The file appears whole or not at all.
pub fn write_poses(path: &Path, entries: &[PoseEntry]) -> Result<(), Error> {
    let mut text = String::from("# Poses by `adit register`, for ingest.poses: scan = pose * (x, y, z, 1).\n");
    for PoseEntry { file, station, pose, remark } in entries {
        for line in remark.lines() {
            text += &format!("\n# {line}");
        }
        let name = toml::Value::String(file.display().to_string());
        let station = station.map_or_else(String::new, |s| format!("station = {s}\n"));
        text += &format!("\n[[scan]]\nfile = {name}\n{station}pose = [\n");
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
}

impl FilePoses {
    /// Whether the file has no pose at all.
    pub(super) fn is_empty(&self) -> bool {
        self.whole.is_none() && self.stations.is_empty()
    }

    /// The pose of a station of the file (counted from 0), or of points that belong to none.
    pub(super) fn of_station(&self, station: Option<u16>) -> Pose {
        let own = self.stations.iter().find(|(number, _)| Some(number - 1) == station).map(|s| s.1);
        own.or(self.whole).unwrap_or_else(Pose::identity)
    }

    /// Moves a scan that was read without an origin; a file without stations gets one where its own origin goes.
    pub(super) fn apply(&self, path: &Path, mut scan: FileScan, origin: Option<Vec3>) -> Result<FileScan, Error> {
        let from = scan.origin;
        let there = scan.stations.len();
        if let Some((number, _)) = self.stations.iter().find(|(number, _)| usize::from(*number) > there) {
            return Err(Error::Settings {
                key: "ingest.poses",
                cause: format!("there is a pose for station {number} of '{}', which has {there}", path.display()),
                remedy: "number the stations as `adit info` lists them, from 1".into(),
            });
        }
        match &scan.attributes.station_ids {
            Some(ids) if !self.stations.is_empty() => {
                let poses: Vec<Pose> = (0..there).map(|i| self.of_station(Some(i as u16))).collect();
                let rest = self.of_station(None);
                for (p, &id) in scan.positions.iter_mut().zip(ids) {
                    *p = poses.get(usize::from(id)).unwrap_or(&rest).apply_to(&(*p + from));
                }
            }
            _ => {
                let pose = self.of_station(None);
                scan.positions.iter_mut().for_each(|p| *p = pose.apply_to(&(*p + from)));
            }
        }
        if scan.stations.is_empty() {
            let name = path.file_stem().map_or_else(String::new, |s| s.to_string_lossy().into_owned());
            scan.stations = vec![Station { name, position_in_local: Some(self.of_station(None).translation) }];
            scan.attributes.station_ids = Some(vec![0; scan.positions.len()]);
        } else {
            for (i, station) in scan.stations.iter_mut().enumerate() {
                let pose = self.of_station(u16::try_from(i).ok());
                station.position_in_local = station.position_in_local.map(|p| pose.apply_to(&(p + from)));
            }
        }
        scan.origin = Vec3::zeros();
        Ok(scan.relative(origin))
    }
}
