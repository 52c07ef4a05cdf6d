//! Scans that arrive in a folder: what is one, and whether it has arrived completely.
//!
//! A scan is complete when a marker or a manifest with hashes says so, or when nobody has written to it for a while *and* its
//! header agrees with its length. Time stamps alone are not believed: the caller also watches on a clock that never jumps.

use super::run_folder::sha256_of;
use crate::io;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Files that count as scans or meshes when a folder is looked through.
const EXTENSIONS: [&str; 14] =
    ["las", "laz", "e57", "ply", "ptx", "pts", "xyz", "csv", "txt", "pcd", "obj", "off", "stl", "glb"];

/// Manifests of a folder of stations, in the form of `sha256sum`: a hash, two spaces, a file name.
const FOLDER_MANIFESTS: [&str; 2] = ["SHA256SUMS", "manifest.sha256"];

/// A scan that waits to be mapped: a file, or a folder of stations.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Scan {
    /// Name without extension.
    pub name: String,
    /// The files, sorted.
    pub files: Vec<PathBuf>,
    /// The folder, if it is one.
    pub folder: Option<PathBuf>,
}

/// Whether a scan can be mapped.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Readiness {
    /// It has arrived.
    Ready,
    /// Not yet, and why.
    Waiting(String),
    /// It has been left alone for so long that it will not get better by waiting: it is to be refused, and why.
    Broken(String),
}

/// How long a scan is left alone before it is taken or given up.
#[derive(Clone, Copy, Debug)]
pub struct Patience {
    /// Without a marker, its files must not have changed for this long.
    pub settle: Duration,
    /// A scan that still contradicts itself after this long is refused.
    pub give_up: Duration,
}

impl Scan {
    /// The scan of a path: the file itself, or all scan files of a folder. `None` when there is none.
    pub fn at(path: &Path) -> Option<Self> {
        if path.is_dir() {
            let mut files: Vec<PathBuf> =
                fs::read_dir(path).ok()?.flatten().map(|e| e.path()).filter(|p| p.is_file() && is_scan(p)).collect();
            files.sort();
            let name = path.file_name()?.to_string_lossy().into_owned();
            return (!files.is_empty()).then(|| Self { name, files, folder: Some(path.to_owned()) });
        }
        is_scan(path).then(|| Self::of_file(path))
    }

    /// The scan of a file of any name.
    pub fn of_file(path: &Path) -> Self {
        let name = path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        Self { name, files: vec![path.to_owned()], folder: None }
    }

    /// All scans directly in a folder, by name.
    ///
    /// # Errors
    /// What the operating system says when the folder cannot be listed.
    pub fn in_folder(folder: &Path) -> std::io::Result<Vec<Self>> {
        let mut scans: Vec<Self> = fs::read_dir(folder)?.flatten().filter_map(|e| Self::at(&e.path())).collect();
        scans.sort();
        Ok(scans)
    }

    /// The tunnel that the scan is of: its name without dates, times and counters. Scans of one tunnel are compared.
    pub fn tunnel(&self) -> String {
        let is_date = |word: &str| {
            word.chars().any(|c| c.is_ascii_digit()) && word.chars().all(|c| c.is_ascii_digit() || "TZ".contains(c))
        };
        let words: Vec<&str> = self.name.split(['_', '-', '.', ' ']).filter(|w| !w.is_empty() && !is_date(w)).collect();
        if words.is_empty() { self.name.clone() } else { words.join("_") }
    }

    /// Sizes and modification times of the files; `None` while one cannot be looked at.
    pub fn stamp(&self) -> Option<String> {
        stamp_of(&self.files)
    }

    /// Like [`Self::stamp`], with the markers and manifests that speak for the scan.
    pub fn stamp_with_papers(&self) -> Option<String> {
        let papers = self.manifests().into_iter().chain(self.markers()).filter(|p| p.exists()).collect::<Vec<_>>();
        Some(self.stamp()? + &stamp_of(&papers)?)
    }

    /// Whether the scan has arrived. `unchanged` is how long the caller has seen it unchanged.
    pub fn readiness(&self, unchanged: Duration, patience: &Patience) -> Readiness {
        let left_alone = self.files.iter().filter_map(|f| age(f)).min().unwrap_or_default().max(unchanged);
        let doubtful = |reason: String| match left_alone >= patience.give_up {
            true => Readiness::Broken(reason),
            false => Readiness::Waiting(reason),
        };
        let manifests: Vec<PathBuf> = self.manifests().into_iter().filter(|m| m.exists()).collect();
        if !manifests.is_empty() {
            return match manifests.iter().map(|m| self.disagreement(m)).find_map(|d| d) {
                None => Readiness::Ready,
                Some(reason) => doubtful(reason),
            };
        }
        if self.is_marked() {
            return Readiness::Ready;
        }
        if left_alone < patience.settle {
            let (since, settle) = (left_alone.as_secs(), patience.settle.as_secs());
            return Readiness::Waiting(format!("it changed {since} s ago and must be left alone for {settle} s"));
        }
        let refused = self.files.iter().find_map(|f| match io::announce(f) {
            Err(error) if error.kind() == io::ErrorKind::BadInput => Some(error.to_string()),
            // Whatever else there is to say is said by the run.
            _ => None,
        });
        refused.map_or(Readiness::Ready, doubtful)
    }

    /// Whether a file's time lies in the future: clocks differ, or one jumped.
    pub fn is_from_the_future(&self) -> bool {
        let modified = |f: &PathBuf| fs::metadata(f).ok()?.modified().ok();
        self.files.iter().filter_map(modified).any(|m| m > SystemTime::now())
    }

    fn markers(&self) -> Vec<PathBuf> {
        let beside = |f: &PathBuf| f.with_file_name(format!("{}.done", f.file_name().unwrap_or_default().display()));
        self.files.iter().map(beside).chain(self.folder.iter().map(|f| f.join(".done"))).collect()
    }

    /// Whether a marker says that the scan is complete: `<file>.done` beside each file, or `.done` in the folder.
    fn is_marked(&self) -> bool {
        let (beside, in_folder) = self.markers().into_iter().partition::<Vec<_>, _>(|m| !m.ends_with(".done"));
        beside.iter().all(|m| m.exists()) || in_folder.iter().any(|m| m.exists())
    }

    fn manifests(&self) -> Vec<PathBuf> {
        let beside = |f: &PathBuf| f.with_file_name(format!("{}.sha256", f.file_name().unwrap_or_default().display()));
        let in_folder = self.folder.iter().flat_map(|f| FOLDER_MANIFESTS.map(|name| f.join(name)));
        self.files.iter().map(beside).chain(in_folder).collect()
    }

    /// How the files differ from a manifest; `None` when they do not.
    fn disagreement(&self, manifest: &Path) -> Option<String> {
        let name = manifest.display();
        let Ok(text) = fs::read_to_string(manifest) else { return Some(format!("'{name}' does not read")) };
        let mut lines = 0;
        for line in text.lines().filter(|l| !l.trim().is_empty() && !l.starts_with('#')) {
            let Some((hash, file)) = line.split_once(char::is_whitespace).filter(|(h, _)| h.len() == 64) else {
                return Some(format!("'{name}' has the line '{line}', which is no SHA-256 and a file name"));
            };
            let file = manifest.with_file_name(file.trim().trim_start_matches('*'));
            match sha256_of(&file) {
                Err(_) => return Some(format!("'{}' of '{name}' is not there", file.display())),
                Ok(found) if !found.eq_ignore_ascii_case(hash) => {
                    return Some(format!("'{}' does not have the hash that '{name}' states", file.display()));
                }
                Ok(_) => lines += 1,
            }
        }
        (lines == 0).then(|| format!("'{name}' names no file"))
    }
}

fn stamp_of(files: &[PathBuf]) -> Option<String> {
    let mut stamp = String::new();
    for file in files {
        let found = fs::metadata(file).ok()?;
        let modified = found.modified().ok()?.duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
        let _ = write!(stamp, "{}:{}:{modified};", file.display(), found.len());
    }
    Some(stamp)
}

fn is_scan(path: &Path) -> bool {
    let hidden = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
    let known = path.extension().is_some_and(|e| EXTENSIONS.iter().any(|k| e.eq_ignore_ascii_case(k)));
    known && !hidden
}

/// How long ago a file was changed; a time in the future counts as just now.
fn age(path: &Path) -> Option<Duration> {
    let modified = fs::metadata(path).ok()?.modified().ok()?;
    Some(SystemTime::now().duration_since(modified).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::run_folder::sha256_of_bytes;

    const HOUR: Duration = Duration::from_secs(3600);
    const PATIENT: Patience = Patience { settle: Duration::from_secs(600), give_up: HOUR };

    /// The smallest text scan.
    fn scan_file(folder: &Path, name: &str) -> PathBuf {
        let file = folder.join(name);
        fs::write(&file, "1 2 3\n").unwrap();
        file
    }

    #[test]
    fn scans_settle_by_age_or_by_marker() {
        let place = tempfile::tempdir().unwrap();
        scan_file(place.path(), "a.xyz");
        fs::write(place.path().join("notes.md"), b"x").unwrap();
        scan_file(place.path(), ".b.xyz");
        let scans = Scan::in_folder(place.path()).unwrap();
        assert_eq!(scans.len(), 1);
        assert!(matches!(scans[0].readiness(Duration::ZERO, &PATIENT), Readiness::Waiting(_)));
        assert_eq!(scans[0].readiness(Duration::from_secs(601), &PATIENT), Readiness::Ready);
        let before = scans[0].stamp_with_papers();
        fs::write(place.path().join("a.xyz.done"), b"").unwrap();
        assert_eq!(scans[0].readiness(Duration::ZERO, &PATIENT), Readiness::Ready);
        assert_ne!(scans[0].stamp_with_papers(), before);
    }

    #[test]
    fn a_marker_of_the_folder_speaks_for_its_stations_only() {
        let place = tempfile::tempdir().unwrap();
        let drift = place.path().join("drift");
        fs::create_dir(&drift).unwrap();
        scan_file(&drift, "1.xyz");
        scan_file(place.path(), "other.xyz");
        fs::write(place.path().join(".done"), b"").unwrap();
        let ready = || -> Vec<bool> {
            let scans = Scan::in_folder(place.path()).unwrap();
            scans.iter().map(|s| s.readiness(Duration::ZERO, &PATIENT) == Readiness::Ready).collect()
        };
        assert_eq!(ready(), [false, false]);
        fs::write(drift.join(".done"), b"").unwrap();
        assert_eq!(ready(), [true, false]);
    }

    #[test]
    fn a_settled_file_that_is_too_short_waits_and_is_given_up() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("a.las");
        fs::write(&file, b"LASF half of a header").unwrap();
        let scan = Scan::at(&file).unwrap();
        assert!(matches!(scan.readiness(Duration::from_secs(700), &PATIENT), Readiness::Waiting(_)));
        assert!(matches!(scan.readiness(HOUR, &PATIENT), Readiness::Broken(reason) if reason.contains("a.las")));
    }

    #[test]
    fn a_manifest_is_believed_when_all_hashes_agree() {
        let place = tempfile::tempdir().unwrap();
        let drift = place.path().join("drift");
        fs::create_dir(&drift).unwrap();
        scan_file(&drift, "1.xyz");
        let hash = sha256_of_bytes(b"1 2 3\n");
        fs::write(drift.join("SHA256SUMS"), format!("{hash}  1.xyz\n{hash} *2.xyz\n")).unwrap();
        let ready = |unchanged| Scan::at(&drift).unwrap().readiness(unchanged, &PATIENT);
        assert!(matches!(ready(Duration::ZERO), Readiness::Waiting(reason) if reason.contains("2.xyz")));
        fs::write(drift.join("2.xyz"), b"1 2").unwrap();
        assert!(matches!(ready(HOUR), Readiness::Broken(reason) if reason.contains("hash")));
        fs::write(drift.join("2.xyz"), b"1 2 3\n").unwrap();
        assert_eq!(ready(Duration::ZERO), Readiness::Ready);
    }

    #[test]
    fn the_tunnel_is_the_name_without_dates() {
        let tunnel = |name: &str| Scan::of_file(Path::new(name)).tunnel();
        assert_eq!(
            ["drift_2026-11-24.laz", "drift-20261125T0300.laz", "drift3 (2).laz", "2026.laz"].map(tunnel),
            ["drift", "drift", "drift3_(2)", "2026"]
        );
    }
}
