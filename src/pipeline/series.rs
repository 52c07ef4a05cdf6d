//! A folder of runs: one run folder a scan, a ledger, the pointer to the last accepted run, a page and metrics over all.
//!
//! A scan gets the folder `<name>-<start of its hash>`, so another scan of the same name never overwrites a map. An accepted
//! run is never changed either: other settings for the same scan get a folder of their own.

use super::arrivals::Scan;
use super::error::Kind;
use super::explain;
use super::folder_lock::FolderLock;
use super::limits::Status;
use super::run::explain as explain_run;
use super::run_folder::{self, read_record, sha256_of, sha256_of_all, sha256_of_bytes, write_atomically};
use super::series_page;
use super::settings::Pipeline;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// How the run of a scan ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Within all limits.
    Pass,
    /// Within the failing limits.
    Warn,
    /// A limit was broken; the products are kept.
    Fail,
    /// The input is missing, damaged or no tunnel.
    BadInput,
    /// The input is of a kind that is not read.
    Unsupported,
    /// Not enough memory or disk.
    Resources,
    /// Wrong settings.
    Usage,
    /// A bug in Adit.
    Internal,
}

impl Verdict {
    /// Whether the map may be used.
    pub fn is_accepted(self) -> bool {
        matches!(self, Self::Pass | Self::Warn)
    }

    /// The word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pass => "pass",
            Self::Warn => "warn",
            Self::Fail => "fail",
            Self::BadInput => "bad-input",
            Self::Unsupported => "unsupported",
            Self::Resources => "resources",
            Self::Usage => "usage",
            Self::Internal => "internal",
        }
    }

    /// The verdict of a run that did not finish.
    pub fn of_kind(kind: Kind) -> Self {
        match kind {
            Kind::Usage => Self::Usage,
            Kind::BadInput => Self::BadInput,
            Kind::Unsupported => Self::Unsupported,
            Kind::Resources => Self::Resources,
            Kind::Internal => Self::Internal,
        }
    }

    /// The verdict of a run that finished.
    pub fn of_status(status: Status) -> Self {
        match status {
            Status::Pass | Status::Skipped => Self::Pass,
            Status::Warn => Self::Warn,
            Status::Fail => Self::Fail,
        }
    }

    /// All of them, the best first.
    pub const ALL: [Self; 8] = [
        Self::Pass,
        Self::Warn,
        Self::Fail,
        Self::BadInput,
        Self::Unsupported,
        Self::Resources,
        Self::Usage,
        Self::Internal,
    ];
}

/// One line of the ledger.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// Name of the scan.
    pub scan: String,
    /// The tunnel that it is of; runs of one tunnel are compared.
    #[serde(default)]
    pub tunnel: String,
    /// Its files.
    pub files: Vec<PathBuf>,
    /// Sizes and modification times of the files when they were taken: tells a replaced scan without reading it.
    pub stamp: String,
    /// Hash over the content of the files.
    pub sha256: String,
    /// Name of the run folder.
    pub run: String,
    /// How it ended.
    pub verdict: Verdict,
    /// One sentence: the broken limits, or the error.
    pub message: String,
    /// When it ended, seconds since 1970.
    pub finished_unix_s: u64,
    /// How long it took, seconds.
    pub seconds: f64,
    /// Run folder of the run that it was compared with.
    #[serde(default)]
    pub compared_with: Option<String>,
    /// Points read.
    pub points: Option<f64>,
    /// Observed share of the map, percent.
    pub coverage_percent: Option<f64>,
    /// Mean stretch.
    pub stretch_mean: Option<f64>,
    /// Scatter of the points about the surface, metres.
    #[serde(default)]
    pub noise_m: Option<f64>,
    /// Peak memory, bytes.
    pub peak_memory_bytes: u64,
}

/// A scan that is to be mapped, and where.
#[derive(Clone, Debug)]
pub struct Job {
    /// The scan.
    pub scan: Scan,
    /// Name of its run folder.
    pub run: String,
    /// Run folder of the last accepted run of the same tunnel.
    pub compared_with: Option<String>,
    /// Hash of the scan when it was taken.
    pub sha256: String,
    stamp: String,
    begun: Instant,
}

/// How a run ended, for the ledger.
#[derive(Clone, Debug)]
pub struct Ended {
    /// The verdict.
    pub verdict: Verdict,
    /// Why there is no map, if there is none.
    pub error: Option<String>,
    /// Greatest memory, bytes, as far as it is known.
    pub peak_memory_bytes: u64,
}

/// A folder of runs, held by this process.
pub struct Series {
    runs: PathBuf,
    entries: Vec<Entry>,
    /// Scans that were refused for lack of memory or disk by this process, and when.
    refused: BTreeMap<String, Instant>,
    _lock: FolderLock,
}

/// The pipeline of the scans that are being mapped.
const PIPELINE: &str = ".pipeline.toml";
/// Lack of memory or disk may pass: a refused scan is tried again after this time, and by the next process.
const RETRY_AFTER: Duration = Duration::from_secs(900);

impl Series {
    /// Opens the folder and takes its lock, so that no scan is taken twice.
    ///
    /// # Errors
    /// [`run_folder::Error`]: locked by another process, or not writable.
    pub fn open(runs: &Path) -> Result<Self, run_folder::Error> {
        fs::create_dir_all(runs).map_err(run_folder::Error::io("make the folder", runs))?;
        let lock_path = runs.join(".lock");
        let lock = FolderLock::take(runs, &lock_path)?;
        let ledger = runs.join("runs.json");
        let entries = match fs::read(&ledger) {
            Ok(text) => serde_json::from_slice(&text)
                .map_err(|e| run_folder::Error::Damaged { path: ledger.clone(), what: e.to_string() })?,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Vec::new(),
            Err(e) => return Err(run_folder::Error::io("read", &ledger)(e)),
        };
        Ok(Self { runs: runs.to_owned(), entries, refused: BTreeMap::new(), _lock: lock })
    }

    /// The folder of runs.
    pub fn path(&self) -> &Path {
        &self.runs
    }

    /// The ledger, oldest first.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Whether this very scan has been taken already: same files, sizes and times. Lack of memory or disk does not count for
    /// ever.
    pub fn has_taken(&self, scan: &Scan) -> bool {
        let Some(stamp) = scan.stamp() else { return false };
        let known = self.entries.iter().rfind(|e| e.scan == scan.name && e.stamp == stamp);
        known.is_some_and(|e| {
            e.verdict != Verdict::Resources || self.refused.get(&stamp).is_some_and(|at| at.elapsed() < RETRY_AFTER)
        })
    }

    /// Chooses the run folder of a scan and the run that it is compared with.
    ///
    /// A folder that holds an accepted run is used again only when the run would do nothing there.
    pub fn begin(&self, scan: &Scan, pipeline: &Pipeline) -> Job {
        let begun = Instant::now();
        let stamp = scan.stamp().unwrap_or_default();
        let hashes: Vec<String> = scan.files.iter().filter_map(|f| sha256_of(f).ok()).collect();
        let sha256 = sha256_of_all(&hashes);
        let mut run = format!("{}-{}", scan.name, &sha256[..8]);
        let mut own = pipeline.clone();
        own.input = scan.files.clone();
        own.make_inputs_absolute();
        let entry_of = |run: &str| self.entries.iter().find(|e| e.run == run);
        if entry_of(&run).is_some_and(|e| e.verdict.is_accepted()) && self.would_change(&run, &own) {
            run += &format!("-{}", &sha256_of_bytes(own.to_toml().as_bytes())[..6]);
        }
        let tunnel = scan.tunnel();
        // A run that is looked at again stays compared with what it was compared with.
        let before = entry_of(&run).map(|e| e.compared_with.clone());
        let compared_with = before.unwrap_or_else(|| {
            let same =
                self.entries.iter().rev().filter(|e| e.tunnel == tunnel && e.verdict.is_accepted() && e.run != run);
            let mut there = same.filter(|e| self.runs.join(&e.run).join("report.json").exists());
            there.next().map(|e| e.run.clone())
        });
        Job { scan: scan.clone(), run, compared_with, stamp, sha256, begun }
    }

    /// Whether a run of this pipeline would change the folder.
    fn would_change(&self, run: &str, pipeline: &Pipeline) -> bool {
        let folder = self.runs.join(run);
        if !folder.exists() {
            return false;
        }
        let same_settings = fs::read_to_string(folder.join("pipeline.toml")).is_ok_and(|t| t == pipeline.to_toml());
        let stale = |found: Vec<explain::Explanation>| found.iter().any(|e| !e.fresh);
        // What cannot be explained is said by the run itself.
        !same_settings || read_record(&folder, "report").is_none() || explain_run(pipeline, &folder).is_ok_and(stale)
    }

    /// Writes how a run ended into the ledger, the page and the pointer to the last accepted run.
    ///
    /// # Errors
    /// [`run_folder::Error`] when one of them cannot be written.
    pub fn finish(&mut self, job: Job, ended: Ended) -> Result<Entry, run_folder::Error> {
        let finished = matches!(ended.verdict, Verdict::Pass | Verdict::Warn | Verdict::Fail);
        let report = fs::read(self.runs.join(&job.run).join("report.json")).ok().filter(|_| finished);
        let report: Option<Value> = report.and_then(|text| serde_json::from_slice(&text).ok());
        let number_at = |path: &str| report.as_ref()?.pointer(path)?.as_f64();
        let told_peak = number_at("/peak_memory_bytes").unwrap_or(0.0) as u64;
        let entry = Entry {
            scan: job.scan.name.clone(),
            tunnel: job.scan.tunnel(),
            files: job.scan.files.clone(),
            stamp: job.stamp,
            sha256: job.sha256,
            run: job.run,
            verdict: ended.verdict,
            message: match (&report, ended.error) {
                (_, Some(error)) => error.replace('\n', " "),
                (Some(report), None) => broken_limits(report),
                (None, None) => String::new(),
            },
            finished_unix_s: SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs(),
            seconds: job.begun.elapsed().as_secs_f64(),
            compared_with: job.compared_with,
            points: number_at("/ingest/points"),
            coverage_percent: number_at("/map/coverage_percent"),
            stretch_mean: number_at("/unwrap/stretch/mean"),
            noise_m: number_at("/profile/noise_whole_m"),
            peak_memory_bytes: ended.peak_memory_bytes.max(told_peak),
        };
        if entry.verdict == Verdict::Resources {
            self.refused.insert(entry.stamp.clone(), Instant::now());
        }
        self.entries.retain(|e| e.run != entry.run);
        self.entries.push(entry.clone());
        let text = serde_json::to_vec_pretty(&self.entries).expect("entries are plain data");
        self.write("runs.json", &text)?;
        self.write("index.html", series_page::index(&self.entries, &self.runs).as_bytes())?;
        if entry.verdict.is_accepted() {
            self.point_to(&entry.run)?;
        }
        Ok(entry)
    }

    /// Keeps the resolved pipeline beside the runs, for the processes that map the scans.
    ///
    /// # Errors
    /// [`run_folder::Error::Io`].
    pub fn keep_pipeline(&self, pipeline: &Pipeline) -> Result<PathBuf, run_folder::Error> {
        self.write(PIPELINE, pipeline.to_toml().as_bytes())?;
        let path = self.runs.join(PIPELINE);
        std::path::absolute(&path).map_err(|source| run_folder::Error::Io { action: "find", path, source })
    }

    fn write(&self, name: &str, content: &[u8]) -> Result<(), run_folder::Error> {
        write_atomically(&self.runs.join(name), &self.runs.join(format!(".tmp-{name}")), content)
    }

    /// `latest` leads to the last accepted run: a link where links exist, and always a text file with its name.
    fn point_to(&self, run: &str) -> Result<(), run_folder::Error> {
        self.write("latest.txt", format!("{run}\n").as_bytes())?;
        #[cfg(unix)]
        {
            let (link, temporary) = (self.runs.join("latest"), self.runs.join(".tmp-latest"));
            let _ = fs::remove_file(&temporary);
            // Some network shares have no links; latest.txt tells the same there.
            if std::os::unix::fs::symlink(run, &temporary).is_ok() {
                let _ = fs::rename(&temporary, &link);
            }
        }
        Ok(())
    }

    /// Writes the metrics of all runs to a file that a Prometheus text collector reads.
    ///
    /// # Errors
    /// [`run_folder::Error::Io`].
    pub fn write_metrics(&self, path: &Path) -> Result<(), run_folder::Error> {
        let mut temporary = path.as_os_str().to_owned();
        temporary.push(".tmp");
        write_atomically(path, Path::new(&temporary), series_page::metrics(&self.entries).as_bytes())
    }

    /// The runs that a keep policy gives up, oldest first: not among the newest `keep_last`, older than `older_than`,
    /// and not accepted if accepted ones are kept. The latest accepted run always stays.
    pub fn superfluous(&self, keep_last: usize, keep_accepted: bool, older_than: Duration) -> Vec<&Entry> {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        let latest = self.entries.iter().rev().find(|e| e.verdict.is_accepted()).map(|e| &e.run);
        let newest = self.entries.len().saturating_sub(keep_last);
        self.entries[..newest]
            .iter()
            .filter(|e| Some(&e.run) != latest)
            .filter(|e| !(keep_accepted && e.verdict.is_accepted()))
            .filter(|e| now.saturating_sub(e.finished_unix_s) >= older_than.as_secs())
            .collect()
    }

    /// Removes the run folder; the ledger keeps the line, so that the scan is not taken again.
    ///
    /// # Errors
    /// [`run_folder::Error`]: in use, or not removable.
    pub fn remove_run(&self, run: &str) -> Result<(), run_folder::Error> {
        let path = self.runs.join(run);
        if !path.exists() {
            return Ok(());
        }
        run_folder::remove(&path)
    }
}

fn broken_limits(report: &serde_json::Value) -> String {
    let checks = report.get("limits").and_then(|l| l.as_array()).into_iter().flatten();
    let is_broken = |c: &&Value| matches!(c.get("status").and_then(|s| s.as_str()), Some("warn" | "fail"));
    let broken = checks.filter(is_broken);
    broken.filter_map(|c| c.get("message")?.as_str()).collect::<Vec<_>>().join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(run: &str, verdict: Verdict, finished: u64) -> Entry {
        Entry {
            scan: run.to_owned(),
            tunnel: run.to_owned(),
            files: vec![],
            stamp: String::new(),
            sha256: String::new(),
            run: run.to_owned(),
            verdict,
            message: String::new(),
            finished_unix_s: finished,
            seconds: 1.0,
            compared_with: None,
            points: None,
            coverage_percent: None,
            stretch_mean: None,
            noise_m: None,
            peak_memory_bytes: 0,
        }
    }

    #[test]
    fn the_keep_policy_never_gives_up_the_latest_accepted_run() {
        let place = tempfile::tempdir().unwrap();
        let mut series = Series::open(place.path()).unwrap();
        series.entries = vec![
            entry("a", Verdict::Pass, 10),
            entry("b", Verdict::Fail, 20),
            entry("c", Verdict::Warn, 30),
            entry("d", Verdict::BadInput, 40),
        ];
        let names = |s: Vec<&Entry>| s.into_iter().map(|e| e.run.clone()).collect::<Vec<_>>();
        assert_eq!(names(series.superfluous(0, false, Duration::ZERO)), ["a", "b", "d"]);
        assert_eq!(names(series.superfluous(1, true, Duration::ZERO)), ["b"]);
        assert!(series.superfluous(0, false, Duration::from_secs(u64::MAX / 2)).is_empty());
    }

    #[test]
    fn a_second_process_is_refused() {
        let place = tempfile::tempdir().unwrap();
        let _first = Series::open(place.path()).unwrap();
        assert!(matches!(Series::open(place.path()), Err(run_folder::Error::Locked { .. })));
    }

    /// A run folder with a report of a scan, entered into the ledger.
    fn run_of(series: &mut Series, file: &Path, content: &str, verdict: Verdict) -> Entry {
        fs::write(file, content).unwrap();
        let job = series.begin(&Scan::of_file(file), &Pipeline::default());
        let folder = series.path().join(&job.run);
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("report.json"), "{}").unwrap();
        series.finish(job, Ended { verdict, error: None, peak_memory_bytes: 7 }).unwrap()
    }

    #[test]
    fn a_scan_is_compared_with_the_last_accepted_one_of_its_tunnel() {
        let (place, incoming) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let mut series = Series::open(place.path()).unwrap();
        let file = |name: &str| incoming.path().join(name);
        let first = run_of(&mut series, &file("drift_2026-01-01.xyz"), "1", Verdict::Pass);
        let bad = run_of(&mut series, &file("drift_2026-01-02.xyz"), "2", Verdict::Fail);
        let other = run_of(&mut series, &file("shaft_2026-01-02.xyz"), "3", Verdict::Pass);
        let second = run_of(&mut series, &file("drift_2026-01-03.xyz"), "4", Verdict::Pass);
        assert_eq!((first.compared_with, other.compared_with), (None, None));
        assert_eq!((bad.compared_with, second.compared_with), (Some(first.run.clone()), Some(first.run)));
        // What was rejected is not the latest.
        let latest = || fs::read_to_string(place.path().join("latest.txt")).unwrap();
        assert_eq!(latest().trim(), second.run);
        run_of(&mut series, &file("drift_2026-01-04.xyz"), "5", Verdict::Fail);
        assert_eq!(latest().trim(), second.run);
    }

    #[test]
    fn an_accepted_map_is_not_overwritten_by_other_settings() {
        let (place, incoming) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let mut series = Series::open(place.path()).unwrap();
        let file = incoming.path().join("drift.xyz");
        let accepted = run_of(&mut series, &file, "1", Verdict::Pass);
        let other = Pipeline::from_overrides(&["map.cell_m=0.5".to_owned()]).unwrap();
        let run = series.begin(&Scan::of_file(&file), &other).run;
        assert!(run.starts_with(&accepted.run) && run != accepted.run, "{run}");
        // A rejected one may be done again in its place.
        let rejected = run_of(&mut series, &file, "2", Verdict::Fail);
        assert_eq!(series.begin(&Scan::of_file(&file), &other).run, rejected.run);
    }

    #[test]
    fn lack_of_memory_is_tried_again_by_the_next_process() {
        let (place, incoming) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let mut series = Series::open(place.path()).unwrap();
        let (big, broken) = (incoming.path().join("big.xyz"), incoming.path().join("broken.xyz"));
        run_of(&mut series, &big, "1", Verdict::Resources);
        run_of(&mut series, &broken, "2", Verdict::BadInput);
        let taken = |series: &Series| [&big, &broken].map(|f| series.has_taken(&Scan::of_file(f)));
        assert_eq!(taken(&series), [true, true]);
        drop(series);
        assert_eq!(taken(&Series::open(place.path()).unwrap()), [false, true]);
    }
}
