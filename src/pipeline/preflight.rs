//! What a run will need, estimated from the headers of its inputs before any work is done.
//!
//! | symbol | meaning |
//! |---|---|
//! | n | points announced by the headers |
//! | L | length of the tunnel: at most 1.3 times the diagonal of the bounding box, where a header has one |
//! | w | smallest side of the bounding box, 1 to 6 m |
//! | f | faces of the surface: `min(1.05 n, 2 L 608^2 / (3 w))`; with `mesh.spacing_m = s`: `2 L 4.5 w / s^2` instead |
//! | p | pixels of the map: `3 n`; with `map.cell_m = c`: `L 4.5 w / c^2` |
//!
//! `memory = 64 MiB + 150 n + 1000 f` and `disk = 20 MiB + 2 input + 24 n + 150 f + 20 p`, in bytes.
//!
//! The factors are measured upper bounds (`docs/nightly.md` has the table); where a header has no bounding box, or the
//! tunnel does not fill it, the estimate is high, never low.

use super::settings::Pipeline;
use crate::io::{self, Announcement};
use serde::Serialize;
use std::path::{Path, PathBuf};

const MIB: u64 = 1 << 20;
/// Memory and disk of a run without points: the program, its threads, small files.
const MEMORY_BASE: u64 = 64 * MIB;
const DISK_BASE: u64 = 20 * MIB;
/// Bytes for each point: its columns and the voxels it is cleaned with; its checkpoint.
const MEMORY_PER_POINT: f64 = 150.0;
const DISK_PER_POINT: f64 = 24.0;
/// Bytes for each face: the linear system that flattens the surface; mesh, chart and their checkpoints.
const MEMORY_PER_FACE: f64 = 1000.0;
const DISK_PER_FACE: f64 = 150.0;
/// Bytes for each pixel over all layers, and pixels for each point when the size of a pixel is chosen automatically.
const DISK_PER_PIXEL: f64 = 20.0;
const PIXELS_PER_POINT: f64 = 3.0;
/// A tunnel is at most this much longer than the diagonal of its bounding box.
const LENGTH_PER_DIAGONAL: f64 = 1.3;
/// The surface has at most this many faces for each point, and this many columns around the section.
const FACES_PER_POINT: f64 = 1.05;
const MOST_COLUMNS: f64 = 608.0;
/// Bounds of the width that is read from a bounding box, metres.
const WIDTH_BOUNDS_M: (f64, f64) = (1.0, 6.0);
/// Perimeter for each metre of width: at least and at most.
const PERIMETER_PER_WIDTH: (f64, f64) = (3.0, 4.5);

/// What a run will need.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Need {
    /// Points announced by all inputs.
    pub points: u64,
    /// Memory, bytes.
    pub memory_bytes: u64,
    /// Disk in the run folder, bytes.
    pub disk_bytes: u64,
}

impl Need {
    /// The need of a run of this pipeline on these files.
    ///
    /// # Errors
    /// As [`io::announce`]: a file is missing, damaged or shorter than its header says.
    pub fn of(files: &[PathBuf], pipeline: &Pipeline) -> Result<Self, super::Error> {
        // Files with poses are read whole.
        let part = super::find_axis::part_of(pipeline)?.filter(|_| pipeline.ingest.poses.is_none());
        let told = files.iter().map(|f| io::announce_part(f, part.as_ref()));
        let told: Vec<Announcement> = told.collect::<Result<_, _>>().map_err(super::Error::in_stage("ingest"))?;
        // A file that is no mesh and no scan is told when it is read.
        let faces_per_point = if super::stages::is_mesh(files).unwrap_or(false) { 2.0 } else { FACES_PER_POINT };
        Ok(Self::estimate(&told, faces_per_point, pipeline.mesh.spacing_m, pipeline.map.cell_m))
    }

    fn estimate(told: &[Announcement], faces_per_point: f64, spacing_m: Option<f64>, cell_m: Option<f64>) -> Self {
        let points = told.iter().map(|a| a.points).fold(0u64, u64::saturating_add);
        let bytes = told.iter().map(|a| a.bytes).fold(0u64, u64::saturating_add);
        let n = points as f64;
        let (mut faces, mut pixels) = (faces_per_point * n, PIXELS_PER_POINT * n);
        if let Some(sides) = united_sides(told) {
            let length = LENGTH_PER_DIAGONAL * sides.iter().map(|s| s * s).sum::<f64>().sqrt();
            let width = sides.iter().copied().fold(f64::MAX, f64::min).clamp(WIDTH_BOUNDS_M.0, WIDTH_BOUNDS_M.1);
            let most_area = length * PERIMETER_PER_WIDTH.1 * width;
            let most_faces = match spacing_m {
                Some(spacing) => 2.0 * most_area / (spacing * spacing),
                None => 2.0 * length * MOST_COLUMNS * MOST_COLUMNS / (PERIMETER_PER_WIDTH.0 * width),
            };
            faces = if spacing_m.is_some() { most_faces } else { faces.min(most_faces) };
            pixels = cell_m.map_or(pixels, |cell| most_area / (cell * cell));
        }
        let disk = DISK_PER_POINT * n + DISK_PER_FACE * faces + DISK_PER_PIXEL * pixels;
        Self {
            points,
            memory_bytes: MEMORY_BASE.saturating_add((MEMORY_PER_POINT * n + MEMORY_PER_FACE * faces) as u64),
            disk_bytes: DISK_BASE.saturating_add(bytes.saturating_mul(2)).saturating_add(disk as u64),
        }
    }

    /// Refuses a run that will not fit.
    ///
    /// # Errors
    /// [`Error::Memory`] when more than `memory_bytes` (or what the system has free) is needed, [`Error::Disk`] when `out`
    /// has too little room.
    pub fn check(&self, memory_bytes: Option<u64>, out: &Path) -> Result<(), Error> {
        let (limit, told_by) = match memory_bytes {
            Some(limit) => (Some(limit), "allowed by --memory"),
            None => (available_memory_bytes(), "free on this machine"),
        };
        if let Some(limit) = limit.filter(|&limit| limit < self.memory_bytes) {
            return Err(Error::Memory { points: self.points, needed: self.memory_bytes, limit, told_by });
        }
        // What an earlier run left there is needed no second time.
        let needed = self.disk_bytes.saturating_sub(bytes_below(out));
        if let Some(free) = free_disk_bytes(out).filter(|&free| free < needed) {
            return Err(Error::Disk { path: out.to_owned(), points: self.points, needed, free });
        }
        Ok(())
    }
}

/// Sides of the box around all files, metres; `None` unless all headers have one.
fn united_sides(told: &[Announcement]) -> Option<[f64; 3]> {
    let mut united: Option<[[f64; 3]; 2]> = None;
    for announcement in told {
        let [low, high] = announcement.bounds_m?;
        let [l, h] = united.unwrap_or([low, high]);
        united = Some([[0, 1, 2].map(|i| l[i].min(low[i])), [0, 1, 2].map(|i| h[i].max(high[i]))]);
    }
    let [low, high] = united?;
    let sides = [0, 1, 2].map(|i| high[i] - low[i]);
    sides.iter().all(|s| s.is_finite() && *s > 0.0).then_some(sides)
}

/// Why a run is not even begun.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Too little memory.
    #[error(
        "a scan of {points} points needs about {} of memory, but {} are {told_by}: give it more with --memory, run it on a \
         larger machine, or split the scan along the tunnel", size(*needed), size(*limit)
    )]
    Memory {
        /// Points of the scan.
        points: u64,
        /// Estimated need, bytes.
        needed: u64,
        /// What may be used, bytes.
        limit: u64,
        /// Who says so.
        told_by: &'static str,
    },
    /// Too little disk.
    #[error(
        "a scan of {points} points needs about {} on disk, but '{}' has {} free: remove old runs (adit clean-runs) or choose \
         another folder with --out", size(*needed), path.display(), size(*free)
    )]
    Disk {
        /// The run folder.
        path: PathBuf,
        /// Points of the scan.
        points: u64,
        /// Estimated need, bytes.
        needed: u64,
        /// Free bytes.
        free: u64,
    },
}

/// Bytes for a person.
pub fn size(bytes: u64) -> String {
    let mib = bytes as f64 / MIB as f64;
    if mib >= 1024.0 { format!("{:.1} GiB", mib / 1024.0) } else { format!("{mib:.0} MiB") }
}

/// A size as a person writes it: `4G`, `800M`, `2GiB`, `1000000`.
///
/// # Errors
/// A sentence about what is wrong.
pub fn parse_size(text: &str) -> Result<u64, String> {
    let text = text.trim();
    let digits = text.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(text.len());
    let factor = match text[digits..].trim().to_ascii_lowercase().trim_end_matches("ib").trim_end_matches('b') {
        "" => 1u64,
        "k" => 1 << 10,
        "m" => 1 << 20,
        "g" => 1 << 30,
        "t" => 1 << 40,
        unit => return Err(format!("'{unit}' is no unit of memory; write 800M or 4G")),
    };
    match text[..digits].parse::<f64>() {
        Ok(value) if value > 0.0 && value.is_finite() => Ok((value * factor as f64) as u64),
        _ => Err(format!("'{text}' is no amount of memory; write 800M or 4G")),
    }
}

/// Memory that can be used without swapping, bytes; a limit of the container or the service counts too. `None` where the
/// system does not tell.
pub fn available_memory_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    let available = line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024;
    Some(group_memory_bytes().map_or(available, |group| group.min(available)))
}

/// What the control group of this process leaves, bytes, if it has a limit.
fn group_memory_bytes() -> Option<u64> {
    let group = std::fs::read_to_string("/proc/self/cgroup").ok()?;
    let path = group.lines().find_map(|l| l.strip_prefix("0::"))?.trim_start_matches('/').to_owned();
    let number = |name: &str| {
        let text = std::fs::read_to_string(Path::new("/sys/fs/cgroup").join(&path).join(name)).ok()?;
        text.trim().parse::<u64>().ok()
    };
    Some(number("memory.max")?.saturating_sub(number("memory.current")?))
}

/// Length of all files below a folder; what cannot be looked at counts nothing.
fn bytes_below(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let bytes = |e: std::fs::DirEntry| match e.file_type() {
        Ok(kind) if kind.is_dir() => bytes_below(&e.path()),
        Ok(kind) if kind.is_file() => e.metadata().map_or(0, |m| m.len()),
        _ => 0,
    };
    entries.map(bytes).sum()
}

/// Free bytes for this user where `path` is, or will be; `None` where the system does not tell.
pub fn free_disk_bytes(path: &Path) -> Option<u64> {
    #[cfg(unix)]
    {
        let absolute = std::path::absolute(path).ok()?;
        let existing = absolute.ancestors().find(|p| p.exists())?;
        let told = rustix::fs::statvfs(existing).ok()?;
        Some(told.f_bavail.saturating_mul(told.f_frsize))
    }
    #[cfg(not(unix))]
    {
        let _ = path;
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_as_people_write_them() {
        let read = |t: &str| parse_size(t).unwrap();
        assert_eq!(
            [read("4G"), read("800M"), read("2GiB"), read("1.5g"), read("1000")],
            [4 << 30, 800 << 20, 2 << 30, 3 << 29, 1000]
        );
        assert!(parse_size("lots").is_err() && parse_size("4 parsecs").is_err() && parse_size("0").is_err());
    }

    #[test]
    fn the_estimate_bounds_what_was_measured() {
        // Points, size of the file, box; measured memory and disk in MiB (docs/nightly.md).
        let measured: [(u64, u64, [f64; 3], u64, u64); 3] = [
            (300_545, 2_100_000, [19.0, 13.0, 4.6], 281, 67),
            (1_000_000, 12_300_000, [36.0, 20.0, 7.0], 1031, 227),
            (5_000_000, 56_400_000, [36.0, 20.0, 7.0], 1350, 521),
        ];
        for (points, bytes, high, memory, disk) in measured {
            let bounds_m = Some([[0.0; 3], high]);
            let need =
                Need::estimate(&[Announcement { points, counted: true, bytes, bounds_m }], FACES_PER_POINT, None, None);
            let (m, d) = (need.memory_bytes / MIB, need.disk_bytes / MIB);
            assert!(m >= memory && m < memory * 3, "{points} points: {m} MiB of memory estimated, {memory} measured");
            assert!(d >= disk && d < disk * 3, "{points} points: {d} MiB of disk estimated, {disk} measured");
        }
    }

    #[test]
    fn what_does_not_fit_is_refused_with_the_numbers_and_a_remedy() {
        let need = Need { points: 20_000_000, memory_bytes: 22 << 30, disk_bytes: u64::MAX };
        let place = tempfile::tempdir().unwrap();
        let memory = need.check(Some(4 << 30), place.path()).unwrap_err().to_string();
        assert!(memory.contains("22.0 GiB") && memory.contains("4.0 GiB") && memory.contains("--memory"), "{memory}");
        if cfg!(unix) {
            let disk = need.check(Some(u64::MAX), place.path()).unwrap_err().to_string();
            assert!(disk.contains("clean-runs"), "{disk}");
        }
    }
}
