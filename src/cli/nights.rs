//! `adit watch`, `adit batch`, `adit clean-runs`: many scans, nobody at the screen.

use super::jobs::{Budget, Jobs, exit_of, worse};
use super::run::Resources;
use super::{Console, Exit, Failure, Result, hook};
use crate::pipeline::series::{Ended, Entry, Job, Series, Verdict};
use crate::pipeline::{Patience, Pipeline, Readiness, Scan, run_folder};
use notify::Watcher;
use serde_json::json;
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

const WATCH_EXAMPLES: &str = "\
Examples:
  adit watch incoming -p pipelines/nightly.toml --out runs            until Ctrl-C
  adit watch incoming -p pipelines/nightly.toml --out runs --once     from cron: what is there now, then end
  adit watch incoming -p pipelines/nightly.toml --out runs --jobs 2 --memory 12G --tmp /var/tmp

A scan is a file, or a subfolder of stations. It is taken
  * when a manifest with hashes agrees: `<file>.sha256`, in a subfolder SHA256SUMS or manifest.sha256 (as of sha256sum), or
  * when a marker says that it is complete: `<file>.done`, in a subfolder `.done`, or
  * when its files have been left alone for --settle-s seconds and their headers agree with their lengths.
Each scan is taken once; a replaced file is a new scan. runs/index.html shows all runs, runs/latest the last accepted one.
A second watch on the same folder of runs waits until the first one has ended. See docs/nightly.md.";

const BATCH_EXAMPLES: &str = "\
Examples:
  adit batch a.laz b.laz stations/ --out runs
  adit batch scans/*.laz -p pipelines/nightly.toml --out runs --metrics /var/lib/node_exporter/adit.prom
  adit batch scans/*.laz --out runs --jobs 4 --memory 24G      four at a time, as far as they fit";

const CLEAN_EXAMPLES: &str = "\
Examples:
  adit clean-runs runs --keep-last 30 --keep-accepted           tells what would go
  adit clean-runs runs --keep-last 30 --older-than-days 90 --yes";

/// How long a process that ends a scan is looked for again, and a folder that is in use.
const LOOK_AGAIN: Duration = Duration::from_millis(50);
const LOCK_AGAIN: Duration = Duration::from_millis(500);

/// What watch and batch have in common.
#[derive(clap::Args)]
pub struct Common {
    /// The pipeline file. Without one the defaults apply.
    #[arg(long, short, value_name = "PIPELINE.toml")]
    pipeline: Option<PathBuf>,
    /// The folder of runs; one run folder a scan is made in it.
    #[arg(long, value_name = "RUNS")]
    out: PathBuf,
    /// Override one key of the pipeline. May be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Scans that are mapped at the same time, as far as they fit into --memory. They share the threads.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    jobs: u16,
    #[command(flatten)]
    resources: Resources,
    /// How long to wait for another process that holds the folder of runs; 0 refuses at once (exit code 6). Default: as
    /// long as it takes.
    #[arg(long, value_name = "SECONDS")]
    wait_s: Option<u64>,
    /// Write metrics for a Prometheus text collector here after each scan.
    #[arg(long, value_name = "FILE")]
    metrics: Option<PathBuf>,
    /// A shell command that gets one JSON object on its standard input before each scan.
    #[arg(long, value_name = "CMD")]
    hook_start: Option<String>,
    /// The same after each scan, with the verdict: for mail or chat. Its failure never breaks a run.
    #[arg(long, value_name = "CMD")]
    hook_end: Option<String>,
    /// A hook that takes longer is ended.
    #[arg(long, value_name = "SECONDS", default_value_t = 30)]
    hook_limit_s: u64,
}

/// Arguments of `adit watch`.
#[derive(clap::Args)]
#[command(after_help = WATCH_EXAMPLES)]
pub struct Watch {
    /// The folder in which scans arrive.
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
    #[command(flatten)]
    common: Common,
    /// Take what is there and has arrived, then end.
    #[arg(long)]
    once: bool,
    /// A scan without a marker or a manifest is taken when its files have not changed for this long.
    #[arg(long, value_name = "SECONDS", default_value_t = 60)]
    settle_s: u64,
    /// A scan that has not changed for this long, but is shorter than its header says or differs from its manifest, is given
    /// up: it gets the verdict bad-input.
    #[arg(long, value_name = "SECONDS", default_value_t = 3600)]
    give_up_s: u64,
    /// Time between two looks into the folder. Changes that the system tells of are seen at once; network shares tell none.
    #[arg(long, value_name = "SECONDS", default_value_t = 10)]
    poll_s: u64,
}

/// Arguments of `adit batch`.
#[derive(clap::Args)]
#[command(after_help = BATCH_EXAMPLES)]
pub struct Batch {
    /// Scans: files, or folders of stations that belong together.
    #[arg(value_name = "SCAN", required = true)]
    scans: Vec<PathBuf>,
    #[command(flatten)]
    common: Common,
}

/// Arguments of `adit clean-runs`.
#[derive(clap::Args)]
#[command(after_help = CLEAN_EXAMPLES)]
pub struct Clean {
    /// The folder of runs.
    #[arg(value_name = "RUNS")]
    runs: PathBuf,
    /// Keep the newest runs, whatever their verdict.
    #[arg(long, value_name = "N", default_value_t = 10)]
    keep_last: usize,
    /// Keep all accepted runs.
    #[arg(long)]
    keep_accepted: bool,
    /// Only give up runs that are older.
    #[arg(long, value_name = "DAYS", default_value_t = 0)]
    older_than_days: u64,
    /// Really remove; otherwise only tell.
    #[arg(long)]
    yes: bool,
}

/// Watches a folder.
pub fn watch(arguments: Watch, console: &Console) -> Result {
    let common = &arguments.common;
    let pipeline = pipeline(common)?;
    let mut series = open(common, console)?;
    let patience = Patience {
        settle: Duration::from_secs(arguments.settle_s),
        give_up: Duration::from_secs(arguments.give_up_s.max(arguments.settle_s)),
    };
    let events = Events::of(&arguments.folder, console);
    let runs = common.out.clone();
    let mut night = Night::new(common, &pipeline, &series, &runs, console)?;
    let mut seen: BTreeMap<String, Seen> = BTreeMap::new();
    console.say(&format!("watching {}, runs in {}", arguments.folder.display(), common.out.display()));
    let mut listed = None;
    loop {
        let scans = match Scan::in_folder(&arguments.folder) {
            Ok(scans) => {
                listed = Some(true);
                scans
            }
            Err(error) => {
                let message = format!("cannot list '{}': {error}", arguments.folder.display());
                // A share that was there may come back; what is at work goes on meanwhile.
                match listed {
                    Some(_) if arguments.once => return Err(Failure::message(Exit::BadInput, message)),
                    None => return Err(Failure::message(Exit::BadInput, message)),
                    Some(true) => console.warn(&message),
                    Some(false) => {}
                }
                listed = Some(false);
                Vec::new()
            }
        };
        let mut look_again = false;
        for scan in scans {
            if series.has_taken(&scan) || night.has(&scan) {
                continue;
            }
            let Some(stamp) = scan.stamp_with_papers() else { continue };
            let seen = seen.entry(format!("{:?}", scan.files)).or_insert_with(|| Seen::new(stamp.clone()));
            match seen.look(&scan, stamp, &patience) {
                Readiness::Ready => night.queue.push_back((scan, None)),
                Readiness::Broken(reason) => night.queue.push_back((scan, Some(reason))),
                Readiness::Waiting(reason) => {
                    // Only watching tells how long a file of the future has been left alone.
                    look_again |= scan.is_from_the_future() && seen.since.elapsed() < patience.settle;
                    seen.say(&scan, reason, console);
                }
            }
        }
        night.work(&mut series, arguments.once)?;
        if arguments.once && !look_again && night.is_done() {
            return Ok(night.worst);
        }
        let pause = if night.is_done() { Duration::from_secs(arguments.poll_s.max(1)) } else { LOOK_AGAIN };
        events.wait(pause);
    }
}

/// What is known of a scan that waits.
struct Seen {
    stamp: String,
    /// Since when its stamp has been this one, on a clock that never jumps.
    since: Instant,
    /// What was found the last time, and when; hashes and headers of an unchanged scan are not read at every look.
    found: Option<(Readiness, Instant)>,
    said: Option<String>,
}

impl Seen {
    fn new(stamp: String) -> Self {
        Self { stamp, since: Instant::now(), found: None, said: None }
    }

    fn look(&mut self, scan: &Scan, stamp: String, patience: &Patience) -> Readiness {
        if self.stamp != stamp {
            *self = Self::new(stamp);
        }
        /// An unchanged scan is looked into again after this time.
        const LOOK_INTO: Duration = Duration::from_secs(1);
        if let Some((found, at)) = &self.found
            && at.elapsed() < LOOK_INTO
        {
            return found.clone();
        }
        let found = scan.readiness(self.since.elapsed(), patience);
        self.found = Some((found.clone(), Instant::now()));
        found
    }

    /// Says once for each state why a scan is not taken.
    fn say(&mut self, scan: &Scan, reason: String, console: &Console) {
        // Seconds count on; what is waited for stays the same.
        let kind: String = reason.chars().filter(|c| !c.is_ascii_digit()).collect();
        if self.said.as_ref() != Some(&kind) {
            console.say(&format!("{}: waiting, {reason}", scan.name));
            self.said = Some(kind);
        }
    }
}

/// Changes in a folder, where the system tells of them.
struct Events {
    changes: Receiver<()>,
    // Watches as long as it lives.
    _watcher: Option<notify::RecommendedWatcher>,
}

impl Events {
    fn of(folder: &Path, console: &Console) -> Self {
        let (send, changes) = channel();
        let watcher = notify::recommended_watcher(move |event: notify::Result<notify::Event>| {
            // Reading a file is no change; when nobody listens any more, the watch is over.
            if event.is_ok_and(|e| !e.kind.is_access()) {
                let _ = send.send(());
            }
        });
        let watching = watcher.and_then(|mut watcher| {
            watcher.watch(folder, notify::RecursiveMode::Recursive)?;
            Ok(watcher)
        });
        match watching {
            Ok(watcher) => Self { changes, _watcher: Some(watcher) },
            Err(error) => {
                console.say(&format!("changes in the folder are found by looking only ({error})"));
                Self { changes, _watcher: None }
            }
        }
    }

    /// Waits for a change, at most so long.
    fn wait(&self, at_most: Duration) {
        if self.changes.recv_timeout(at_most).is_ok() {
            // Files are written in many pieces: one look for all of them.
            std::thread::sleep(LOOK_AGAIN);
            while self.changes.try_recv().is_ok() {}
        } else if self._watcher.is_none() {
            // Without a sender the channel does not wait.
            std::thread::sleep(at_most);
        }
    }
}

/// Maps a list of scans.
pub fn batch(arguments: Batch, console: &Console) -> Result {
    let pipeline = pipeline(&arguments.common)?;
    let mut series = open(&arguments.common, console)?;
    let runs = arguments.common.out.clone();
    let mut night = Night::new(&arguments.common, &pipeline, &series, &runs, console)?;
    for path in &arguments.scans {
        night.queue.push_back((Scan::at(path).unwrap_or_else(|| Scan::of_file(path)), None));
    }
    night.work(&mut series, true)?;
    Ok(night.worst)
}

/// Scans in the order in which they are mapped, and those that are being mapped.
struct Night<'a> {
    /// Scans with the reason why they are refused, if they are.
    queue: VecDeque<(Scan, Option<String>)>,
    jobs: Jobs<'a>,
    pipeline: &'a Pipeline,
    common: &'a Common,
    console: &'a Console,
    worst: Exit,
}

impl<'a> Night<'a> {
    fn new(
        common: &'a Common,
        pipeline: &'a Pipeline,
        series: &Series,
        runs: &'a Path,
        console: &'a Console,
    ) -> Result<Self> {
        let budget = Budget::new(common.jobs.into(), common.resources.memory, common.resources.tmp.clone());
        let file = series.keep_pipeline(pipeline).map_err(no_folder)?;
        let jobs = Jobs::new(budget, file, runs);
        Ok(Self { queue: VecDeque::new(), jobs, pipeline, common, console, worst: Exit::Done })
    }

    fn has(&self, scan: &Scan) -> bool {
        self.jobs.has(&scan.name) || self.queue.iter().any(|(s, _)| s.name == scan.name)
    }

    fn is_done(&self) -> bool {
        self.queue.is_empty() && self.jobs.is_idle()
    }

    /// Starts what fits and enters what has ended; until everything has, or as far as it goes now.
    fn work(&mut self, series: &mut Series, to_the_end: bool) -> Result<()> {
        let internal = |error: std::io::Error| Failure::new(Exit::Internal, error);
        loop {
            for (job, ended) in self.jobs.ended(self.console).map_err(internal)? {
                self.enter(series, job, ended)?;
            }
            while let Some((scan, refused)) = self.queue.pop_front() {
                let need = Jobs::need(&scan.files, self.pipeline);
                if !self.jobs.has_room(&need) || self.jobs.has(&scan.name) {
                    self.queue.push_front((scan, refused));
                    break;
                }
                let job = series.begin(&scan, self.pipeline);
                self.hook_start(&job);
                match refused {
                    Some(reason) => {
                        let ended = Ended { verdict: Verdict::BadInput, error: Some(reason), peak_memory_bytes: 0 };
                        self.enter(series, job, ended)?;
                    }
                    None => self.jobs.start(job, &need).map_err(internal)?,
                }
            }
            if self.is_done() || !to_the_end {
                return Ok(());
            }
            std::thread::sleep(LOOK_AGAIN);
        }
    }

    fn hook_start(&self, job: &Job) {
        self.console.say(&format!("{}: begun", job.scan.name));
        let files: Vec<String> = job.scan.files.iter().map(|f| f.display().to_string()).collect();
        let start = json!({
            "event": "start", "run_id": self.console.run_id(), "scan": job.scan.name, "run": job.run, "files": files,
        });
        hook::run(self.common.hook_start.as_deref(), &start, self.hook_limit(), self.console);
    }

    fn hook_limit(&self) -> Duration {
        Duration::from_secs(self.common.hook_limit_s)
    }

    fn enter(&mut self, series: &mut Series, job: Job, ended: Ended) -> Result<()> {
        let entry = series.finish(job, ended).map_err(no_folder)?;
        tell(&entry, self.console);
        if let Some(path) = &self.common.metrics {
            series.write_metrics(path).map_err(no_folder)?;
        }
        let mut end = json!({ "event": "end", "run_id": self.console.run_id() });
        end["entry"] = serde_json::to_value(&entry).map_err(|e| Failure::new(Exit::Internal, e))?;
        hook::run(self.common.hook_end.as_deref(), &end, self.hook_limit(), self.console);
        self.worst = worse(self.worst, exit_of(entry.verdict));
        Ok(())
    }
}

/// Removes runs that a keep policy gives up.
pub fn clean_runs(arguments: Clean, console: &Console) -> Result {
    if !arguments.runs.join("runs.json").exists() {
        let message = format!("'{}' is no folder of runs (it has no runs.json)", arguments.runs.display());
        return Err(Failure::message(Exit::Usage, message));
    }
    let series = Series::open(&arguments.runs).map_err(no_folder)?;
    let age = Duration::from_secs(arguments.older_than_days * 86_400);
    let mut count = 0;
    for entry in series.superfluous(arguments.keep_last, arguments.keep_accepted, age) {
        if !arguments.runs.join(&entry.run).exists() {
            continue;
        }
        count += 1;
        if arguments.yes {
            series.remove_run(&entry.run).map_err(no_folder)?;
        }
        let verb = if arguments.yes { "removed" } else { "would remove" };
        console.print(&format!("{verb} {} ({})", entry.run, entry.verdict.name()));
    }
    if count > 0 && !arguments.yes {
        console.say("nothing was removed; add --yes to do it");
    }
    Ok(Exit::Done)
}

fn pipeline(common: &Common) -> Result<Pipeline> {
    match &common.pipeline {
        Some(path) => Pipeline::load(path, &common.set),
        None => Pipeline::from_overrides(&common.set),
    }
    .map_err(|error| Failure::new(Exit::Usage, error))
}

fn no_folder(error: run_folder::Error) -> Failure {
    Failure::new(Exit::Resources, error)
}

/// Opens the folder of runs, waiting for another process that holds it.
fn open(common: &Common, console: &Console) -> Result<Series> {
    let begun = Instant::now();
    let mut said = false;
    loop {
        match Series::open(&common.out) {
            Err(error @ run_folder::Error::Locked { .. }) => {
                if common.wait_s.is_some_and(|wait| begun.elapsed() >= Duration::from_secs(wait)) {
                    return Err(no_folder(error));
                }
                if !said {
                    console.say(&format!("waiting: {error}"));
                    said = true;
                }
                std::thread::sleep(LOCK_AGAIN);
            }
            opened => return opened.map_err(no_folder),
        }
    }
}

fn tell(entry: &Entry, console: &Console) {
    let text = format!("{}: {} in {:.1} s {}", entry.scan, entry.verdict.name(), entry.seconds, entry.message);
    if entry.verdict.is_accepted() { console.say(text.trim_end()) } else { console.error(text.trim_end()) }
}
