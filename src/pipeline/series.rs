//! A folder of runs: one run folder a scan, a ledger, the pointer to the last accepted run, a page and metrics over all.
//!
//! A scan gets the folder `<name>-<start of its hash>`, so another scan of the same name never overwrites a map.

use super::error::{Error, Kind};
use super::limits::{Status, number};
use super::line::{Observer, peak_memory_bytes, reset_peak_memory};
use super::page::escape;
use super::run::{Outcome, Redo, run};
use super::run_folder::{self, sha256_of, sha256_of_bytes, write_atomically};
use super::settings::Pipeline;
use serde::{Deserialize, Serialize};
use std::fmt::Write;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Files that count as scans or meshes when a folder is looked through.
const EXTENSIONS: [&str; 14] =
    ["las", "laz", "e57", "ply", "ptx", "pts", "xyz", "csv", "txt", "pcd", "obj", "off", "stl", "glb"];

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

    fn of(result: &Result<Outcome, Error>) -> Self {
        match result {
            Ok(outcome) => match outcome.status {
                Status::Pass => Self::Pass,
                Status::Warn => Self::Warn,
                Status::Fail => Self::Fail,
            },
            Err(error) => match error.kind() {
                Kind::Usage => Self::Usage,
                Kind::BadInput => Self::BadInput,
                Kind::Unsupported => Self::Unsupported,
                Kind::Resources => Self::Resources,
                Kind::Internal => Self::Internal,
            },
        }
    }
}

/// One line of the ledger.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// Name of the scan.
    pub scan: String,
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
    /// Points read.
    pub points: Option<f64>,
    /// Observed share of the map, percent.
    pub coverage_percent: Option<f64>,
    /// Mean stretch.
    pub stretch_mean: Option<f64>,
    /// Peak memory, bytes.
    pub peak_memory_bytes: u64,
}

/// A scan that waits to be mapped: a file, or a folder of stations.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Scan {
    /// Name without extension.
    pub name: String,
    /// The files, sorted.
    pub files: Vec<PathBuf>,
}

impl Scan {
    /// The scan of a path: the file itself, or all scan files of a folder. `None` when there is none.
    pub fn at(path: &Path) -> Option<Self> {
        let name = path.file_stem()?.to_string_lossy().into_owned();
        if path.is_dir() {
            let mut files: Vec<PathBuf> =
                fs::read_dir(path).ok()?.flatten().map(|e| e.path()).filter(|p| p.is_file() && is_scan(p)).collect();
            files.sort();
            let name = path.file_name()?.to_string_lossy().into_owned();
            return (!files.is_empty()).then_some(Self { name, files });
        }
        is_scan(path).then(|| Self { name, files: vec![path.to_owned()] })
    }

    /// All scans directly in a folder, by name.
    pub fn in_folder(folder: &Path) -> std::io::Result<Vec<Self>> {
        let mut scans: Vec<Self> = fs::read_dir(folder)?.flatten().filter_map(|e| Self::at(&e.path())).collect();
        scans.sort();
        Ok(scans)
    }

    /// Sizes and modification times of the files; `None` while one cannot be looked at.
    pub fn stamp(&self) -> Option<String> {
        let mut stamp = String::new();
        for file in &self.files {
            let found = fs::metadata(file).ok()?;
            let modified = found.modified().ok()?.duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
            let _ = write!(stamp, "{}:{}:{modified};", file.display(), found.len());
        }
        Some(stamp)
    }

    /// Whether all files have been left alone for `quiet`, or a marker `<file>.done` (or `.done` in the folder) says
    /// that the scan is complete.
    pub fn is_settled(&self, quiet: Duration) -> bool {
        self.is_marked() || self.files.iter().all(|f| age(f).is_some_and(|a| a >= quiet))
    }

    /// Whether a marker says that the scan is complete.
    pub fn is_marked(&self) -> bool {
        let beside = |f: &PathBuf| f.with_file_name(format!("{}.done", f.file_name().unwrap_or_default().display()));
        let folder = self.files.first().and_then(|f| f.parent()).map(|p| p.join(".done"));
        self.files.iter().all(|f| beside(f).exists()) || (self.files.len() > 1 && folder.is_some_and(|f| f.exists()))
    }
}

fn is_scan(path: &Path) -> bool {
    let hidden = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
    let known = path.extension().is_some_and(|e| EXTENSIONS.iter().any(|k| e.eq_ignore_ascii_case(k)));
    known && !hidden
}

/// How long ago a file was changed; a time in the future (clocks differ or jumped) counts as just now.
fn age(path: &Path) -> Option<Duration> {
    let modified = fs::metadata(path).ok()?.modified().ok()?;
    Some(SystemTime::now().duration_since(modified).unwrap_or_default())
}

/// A folder of runs, held by this process.
pub struct Series {
    runs: PathBuf,
    entries: Vec<Entry>,
    _lock: File,
}

impl Series {
    /// Opens the folder and takes its lock, so that no scan is taken twice.
    ///
    /// # Errors
    /// [`run_folder::Error`]: locked by another process, or not writable.
    pub fn open(runs: &Path) -> Result<Self, run_folder::Error> {
        let io = |action: &'static str, path: &Path| {
            let path = path.to_owned();
            move |source| run_folder::Error::Io { action, path, source }
        };
        fs::create_dir_all(runs).map_err(io("make the folder", runs))?;
        let lock_path = runs.join(".lock");
        let lock = File::options()
            .create(true)
            .truncate(false)
            .read(true)
            .write(true)
            .open(&lock_path)
            .map_err(io("open the lock", &lock_path))?;
        if lock.try_lock().is_err() {
            let holder = fs::read_to_string(&lock_path).unwrap_or_default();
            let holder = if holder.is_empty() { "another process".to_owned() } else { holder };
            return Err(run_folder::Error::Locked { path: runs.to_owned(), holder });
        }
        fs::write(&lock_path, format!("process {}", std::process::id())).map_err(io("write the lock", &lock_path))?;
        let ledger = runs.join("runs.json");
        let entries = match fs::read(&ledger) {
            Ok(text) => serde_json::from_slice(&text)
                .map_err(|e| run_folder::Error::Damaged { path: ledger.clone(), what: e.to_string() })?,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Vec::new(),
            Err(e) => return Err(io("read", &ledger)(e)),
        };
        Ok(Self { runs: runs.to_owned(), entries, _lock: lock })
    }

    /// The ledger, oldest first.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Whether this very scan has been taken already: same files, sizes and times.
    pub fn has_taken(&self, scan: &Scan) -> bool {
        let stamp = scan.stamp();
        self.entries.iter().any(|e| e.scan == scan.name && Some(&e.stamp) == stamp.as_ref())
    }

    /// Maps one scan and writes it into the ledger; what goes wrong with it is a verdict, not an error.
    ///
    /// # Errors
    /// [`run_folder::Error`] when the ledger, the page or the pointer cannot be written.
    pub fn process(
        &mut self,
        scan: &Scan,
        pipeline: &Pipeline,
        observer: &dyn Observer,
    ) -> Result<(Entry, Option<serde_json::Value>), run_folder::Error> {
        let begun = Instant::now();
        reset_peak_memory();
        let stamp = scan.stamp().unwrap_or_default();
        let hashes: Vec<String> = scan.files.iter().filter_map(|f| sha256_of(f).ok()).collect();
        let sha256 = if hashes.len() == 1 { hashes[0].clone() } else { sha256_of_bytes(hashes.concat().as_bytes()) };
        let folder = format!("{}-{}", scan.name, &sha256[..8]);
        let mut own = pipeline.clone();
        own.input = scan.files.clone();
        own.make_inputs_absolute();
        let result = run(&own, &self.runs.join(&folder), &Redo::default(), observer);
        let report = result.as_ref().ok().map(|o| o.report.clone());
        let number_at = |path: &str| report.as_ref()?.pointer(path)?.as_f64();
        let entry = Entry {
            scan: scan.name.clone(),
            files: own.input,
            stamp,
            sha256,
            run: folder,
            verdict: Verdict::of(&result),
            message: match &result {
                Ok(outcome) => broken_limits(&outcome.report),
                Err(error) => one_line(error),
            },
            finished_unix_s: SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs(),
            seconds: begun.elapsed().as_secs_f64(),
            points: number_at("/ingest/points"),
            coverage_percent: number_at("/map/coverage_percent"),
            stretch_mean: number_at("/unwrap/stretch/mean"),
            peak_memory_bytes: peak_memory_bytes(),
        };
        self.entries.retain(|e| e.run != entry.run);
        self.entries.push(entry.clone());
        self.save()?;
        if entry.verdict.is_accepted() {
            self.point_to(&entry.run)?;
        }
        Ok((entry, report))
    }

    fn save(&self) -> Result<(), run_folder::Error> {
        let text = serde_json::to_vec_pretty(&self.entries).expect("entries are plain data");
        self.write("runs.json", &text)?;
        self.write("index.html", self.index().as_bytes())
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

    /// The page over all runs, newest first.
    fn index(&self) -> String {
        let mut html = String::from(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><title>Adit runs</title><style>\
             :root{color-scheme:light dark}body{font:16px/1.5 system-ui,sans-serif;margin:0 auto;max-width:70rem;padding:1rem}\
             table{border-collapse:collapse;width:100%}td,th{text-align:left;padding:.25rem .5rem;border-bottom:1px solid #8884}\
             .pill{border-radius:1rem;padding:.1rem .6rem;color:#fff;background:#b3261e}.pass{background:#1b7f3b}.warn{background:#9a6700}\
             .scroll{overflow-x:auto}svg{max-width:100%;background:#fff}</style></head><body><h1>Runs</h1>\n",
        );
        for (title, value) in [
            ("Coverage, %", (|e: &Entry| e.coverage_percent) as fn(&Entry) -> Option<f64>),
            ("Mean stretch", |e| e.stretch_mean),
            ("Duration, s", |e| Some(e.seconds)),
        ] {
            trend(&mut html, title, &self.entries.iter().filter_map(value).collect::<Vec<_>>());
        }
        html.push_str("<div class=\"scroll\"><table><tr><th></th><th>Scan</th><th>Points</th><th>Coverage</th><th>Seconds</th><th></th></tr>\n");
        for e in self.entries.iter().rev() {
            let optional = |v: Option<f64>| v.map_or("\u{2013}".to_owned(), number);
            let page = self.runs.join(&e.run).join("report.html");
            let name = if page.exists() {
                format!("<a href=\"{0}/report.html\">{1}</a>", escape(&e.run), escape(&e.scan))
            } else {
                escape(&e.scan)
            };
            let _ = writeln!(
                html,
                "<tr><td><span class=\"pill {0}\">{0}</span></td><td>{name}</td><td>{1}</td><td>{2}</td><td>{3}</td><td>{4}</td></tr>",
                e.verdict.name(),
                optional(e.points),
                optional(e.coverage_percent),
                number(e.seconds.round()),
                escape(&e.message)
            );
        }
        html.push_str("</table></div></body></html>\n");
        html
    }

    /// The metrics of the last run and the counts over all, in the text format of Prometheus.
    pub fn metrics(&self) -> String {
        let mut text = String::new();
        let mut metric = |name: &str, help: &str, values: &[(String, f64)]| {
            let _ = writeln!(text, "# HELP adit_{name} {help}\n# TYPE adit_{name} gauge");
            for (labels, value) in values {
                let _ = writeln!(text, "adit_{name}{labels} {value}");
            }
        };
        let success = self.entries.iter().filter(|e| e.verdict.is_accepted()).map(|e| e.finished_unix_s).max();
        let one = |value: f64| vec![(String::new(), value)];
        metric("last_success_time_seconds", "End of the last accepted run.", &one(success.unwrap_or(0) as f64));
        let verdicts = [
            Verdict::Pass,
            Verdict::Warn,
            Verdict::Fail,
            Verdict::BadInput,
            Verdict::Unsupported,
            Verdict::Resources,
            Verdict::Usage,
            Verdict::Internal,
        ];
        let counts = verdicts.map(|v| {
            let count = self.entries.iter().filter(|e| e.verdict == v).count();
            (format!("{{verdict=\"{}\"}}", v.name()), count as f64)
        });
        metric("runs", "Runs in the folder by verdict.", &counts);
        if let Some(last) = self.entries.last() {
            metric("last_duration_seconds", "Duration of the last run.", &one(last.seconds));
            metric("last_points", "Points of the last run.", &one(last.points.unwrap_or(0.0)));
            metric(
                "last_coverage_percent",
                "Observed share of the last map.",
                &one(last.coverage_percent.unwrap_or(0.0)),
            );
            metric(
                "last_accepted",
                "Whether the last run was accepted.",
                &one(f64::from(u8::from(last.verdict.is_accepted()))),
            );
            metric("last_peak_memory_bytes", "Peak memory of the last run.", &one(last.peak_memory_bytes as f64));
        }
        text
    }

    /// Writes [`Self::metrics`] to a file that a collector reads.
    ///
    /// # Errors
    /// [`run_folder::Error::Io`].
    pub fn write_metrics(&self, path: &Path) -> Result<(), run_folder::Error> {
        let mut temporary = path.as_os_str().to_owned();
        temporary.push(".tmp");
        write_atomically(path, Path::new(&temporary), self.metrics().as_bytes())
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
        drop(run_folder::RunFolder::open(&path)?);
        fs::remove_dir_all(&path).map_err(|source| run_folder::Error::Io { action: "remove", path, source })
    }
}

fn trend(html: &mut String, title: &str, values: &[f64]) {
    if values.len() < 2 {
        return;
    }
    let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    let mut line = String::new();
    for (i, value) in values.iter().enumerate() {
        let x = 10.0 + 580.0 * i as f64 / (values.len() - 1) as f64;
        let _ = write!(line, "{x:.1},{:.1} ", 70.0 - 60.0 * (value - low) / (high - low).max(1e-9));
    }
    let _ = writeln!(
        html,
        "<figure><svg viewBox=\"0 0 600 80\" width=\"600\"><polyline points=\"{line}\" fill=\"none\" stroke=\"#1a5fb4\" stroke-width=\"2\"/></svg>\
         <figcaption>{title}: {} to {}</figcaption></figure>",
        number(low),
        number(high)
    );
}

fn broken_limits(report: &serde_json::Value) -> String {
    let checks = report.get("limits").and_then(|l| l.as_array()).into_iter().flatten();
    let broken = checks.filter(|c| c.get("status").and_then(|s| s.as_str()) != Some("pass"));
    broken.filter_map(|c| c.get("message")?.as_str()).collect::<Vec<_>>().join("; ")
}

fn one_line(error: &Error) -> String {
    error.to_string().replace('\n', " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(run: &str, verdict: Verdict, finished: u64) -> Entry {
        Entry {
            scan: run.to_owned(),
            files: vec![],
            stamp: String::new(),
            sha256: String::new(),
            run: run.to_owned(),
            verdict,
            message: String::new(),
            finished_unix_s: finished,
            seconds: 1.0,
            points: None,
            coverage_percent: None,
            stretch_mean: None,
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

    #[test]
    fn scans_settle_by_age_or_by_marker() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("a.laz");
        fs::write(&file, b"x").unwrap();
        fs::write(place.path().join("notes.md"), b"x").unwrap();
        fs::write(place.path().join(".b.laz"), b"x").unwrap();
        let scans = Scan::in_folder(place.path()).unwrap();
        assert_eq!(scans.len(), 1);
        assert!(!scans[0].is_settled(Duration::from_secs(3600)) && scans[0].is_settled(Duration::ZERO));
        fs::write(place.path().join("a.laz.done"), b"").unwrap();
        assert!(scans[0].is_settled(Duration::from_secs(3600)));
    }

    #[test]
    fn metrics_count_by_verdict() {
        let place = tempfile::tempdir().unwrap();
        let mut series = Series::open(place.path()).unwrap();
        series.entries = vec![entry("a", Verdict::Pass, 10), entry("b", Verdict::BadInput, 20)];
        let text = series.metrics();
        assert!(text.contains("adit_last_success_time_seconds 10\n"), "{text}");
        assert!(text.contains("adit_runs{verdict=\"bad-input\"} 1\n") && text.contains("adit_last_accepted 0\n"));
    }
}
