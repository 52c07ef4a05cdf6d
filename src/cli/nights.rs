//! `adit watch`, `adit batch`, `adit clean-runs`: many scans, nobody at the screen.

use super::run::Progress;
use super::{Console, Exit, Failure, Result};
use crate::pipeline::series::{Entry, Scan, Series, Verdict};
use crate::pipeline::{Pipeline, run_folder};
use serde_json::json;
use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const WATCH_EXAMPLES: &str = "\
Examples:
  adit watch incoming -p pipelines/nightly.toml --out runs            until Ctrl-C
  adit watch incoming -p pipelines/nightly.toml --out runs --once     from cron: what is there now, then end

A scan is a file, or a subfolder of stations. It is taken when it has been left alone for --settle-s seconds, or when
a file `<name>.done` (in a subfolder: `.done`) says that it is complete. Each scan is taken once; a replaced file is a
new scan. runs/index.html shows all runs, runs/latest the last accepted one. See docs/nightly.md.";

const BATCH_EXAMPLES: &str = "\
Examples:
  adit batch a.laz b.laz stations/ --out runs
  adit batch scans/*.laz -p pipelines/nightly.toml --out runs --metrics /var/lib/node_exporter/adit.prom";

const CLEAN_EXAMPLES: &str = "\
Examples:
  adit clean-runs runs --keep-last 30 --keep-accepted           tells what would go
  adit clean-runs runs --keep-last 30 --older-than-days 90 --yes";

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
    /// Take what is there and settled, then end.
    #[arg(long)]
    once: bool,
    /// A scan is taken when its files have not changed for this long.
    #[arg(long, value_name = "SECONDS", default_value_t = 60)]
    settle_s: u64,
    /// Time between two looks into the folder.
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
    let pipeline = pipeline(&arguments.common)?;
    let mut series = open(&arguments.common.out)?;
    let settle = Duration::from_secs(arguments.settle_s);
    // When a scan was first seen with its present sizes and times, on a clock that never jumps.
    let mut seen: BTreeMap<String, (String, Instant)> = BTreeMap::new();
    let mut worst = Exit::Done;
    console.say(&format!("watching {}, runs in {}", arguments.folder.display(), arguments.common.out.display()));
    loop {
        let scans = Scan::in_folder(&arguments.folder).map_err(|error| {
            Failure::message(Exit::BadInput, format!("cannot list '{}': {error}", arguments.folder.display()))
        })?;
        for scan in scans {
            let Some(stamp) = scan.stamp() else { continue };
            if series.has_taken(&scan) {
                continue;
            }
            let key = format!("{:?}", scan.files);
            let (known, since) = seen.entry(key).or_insert_with(|| (stamp.clone(), Instant::now()));
            if *known != stamp {
                (*known, *since) = (stamp.clone(), Instant::now());
            }
            let settled = scan.is_marked() || scan.is_settled(settle) || since.elapsed() >= settle;
            if !settled {
                continue;
            }
            worst = worse(worst, take(&mut series, &scan, &pipeline, &arguments.common, console)?);
        }
        if arguments.once {
            return Ok(worst);
        }
        std::thread::sleep(Duration::from_secs(arguments.poll_s.max(1)));
    }
}

/// Maps a list of scans.
pub fn batch(arguments: Batch, console: &Console) -> Result {
    let pipeline = pipeline(&arguments.common)?;
    let mut series = open(&arguments.common.out)?;
    let mut worst = Exit::Done;
    for path in &arguments.scans {
        let name = path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let scan = Scan::at(path).unwrap_or_else(|| Scan { name, files: vec![path.clone()] });
        worst = worse(worst, take(&mut series, &scan, &pipeline, &arguments.common, console)?);
    }
    Ok(worst)
}

/// Removes runs that a keep policy gives up.
pub fn clean_runs(arguments: Clean, console: &Console) -> Result {
    if !arguments.runs.join("runs.json").exists() {
        let message = format!("'{}' is no folder of runs (it has no runs.json)", arguments.runs.display());
        return Err(Failure::message(Exit::Usage, message));
    }
    let series = open(&arguments.runs)?;
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

fn open(runs: &std::path::Path) -> Result<Series> {
    Series::open(runs).map_err(no_folder)
}

fn take(series: &mut Series, scan: &Scan, pipeline: &Pipeline, common: &Common, console: &Console) -> Result {
    console.say(&format!("{}: begun", scan.name));
    let files: Vec<String> = scan.files.iter().map(|f| f.display().to_string()).collect();
    let limit = Duration::from_secs(common.hook_limit_s);
    let start = json!({ "event": "start", "run_id": console.run_id(), "scan": scan.name, "files": files });
    hook(common.hook_start.as_deref(), &start, limit, console);
    let progress = Progress { console };
    let (entry, _report) = series.process(scan, pipeline, &progress).map_err(no_folder)?;
    console.finish_bar();
    tell(&entry, console);
    if let Some(path) = &common.metrics {
        series.write_metrics(path).map_err(no_folder)?;
    }
    let mut end = json!({ "event": "end", "run_id": console.run_id() });
    end["entry"] = serde_json::to_value(&entry).map_err(|e| Failure::new(Exit::Internal, e))?;
    hook(common.hook_end.as_deref(), &end, limit, console);
    Ok(exit_of(entry.verdict))
}

fn tell(entry: &Entry, console: &Console) {
    let text = format!("{}: {} in {:.1} s {}", entry.scan, entry.verdict.name(), entry.seconds, entry.message);
    if entry.verdict.is_accepted() { console.say(text.trim_end()) } else { console.error(text.trim_end()) }
}

fn exit_of(verdict: Verdict) -> Exit {
    match verdict {
        Verdict::Pass | Verdict::Warn => Exit::Done,
        Verdict::Fail => Exit::LimitBroken,
        Verdict::BadInput => Exit::BadInput,
        Verdict::Unsupported => Exit::Unsupported,
        Verdict::Resources => Exit::Resources,
        Verdict::Usage => Exit::Usage,
        Verdict::Internal => Exit::Internal,
    }
}

/// Of two ends the one that needs a person more.
fn worse(a: Exit, b: Exit) -> Exit {
    let urgency = |e: Exit| match e {
        Exit::Done => 0,
        Exit::LimitBroken => 1,
        Exit::Unsupported => 2,
        Exit::BadInput => 3,
        Exit::Usage => 4,
        Exit::Cancelled => 5,
        Exit::Resources => 6,
        Exit::Internal => 7,
    };
    if urgency(b) > urgency(a) { b } else { a }
}

/// Runs a hook; whatever goes wrong with it is a warning.
fn hook(command: Option<&str>, message: &serde_json::Value, limit: Duration, console: &Console) {
    let Some(command) = command else { return };
    let attempt = || -> std::io::Result<String> {
        let mut child =
            Command::new("sh").arg("-c").arg(command).stdin(Stdio::piped()).stdout(Stdio::null()).spawn()?;
        if let Some(mut input) = child.stdin.take() {
            // A hook need not read its input.
            let _ = writeln!(input, "{message}");
        }
        let begun = Instant::now();
        loop {
            if let Some(status) = child.try_wait()? {
                return Ok(if status.success() { String::new() } else { format!("ended with {status}") });
            }
            if begun.elapsed() > limit {
                child.kill()?;
                child.wait()?;
                return Ok(format!("took longer than {} s and was ended", limit.as_secs()));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    match attempt() {
        Ok(problem) if problem.is_empty() => {}
        Ok(problem) => console.warn(&format!("hook `{command}` {problem}")),
        Err(error) => console.warn(&format!("hook `{command}` cannot be run: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_urgent_end_wins() {
        assert_eq!(worse(worse(Exit::Done, Exit::BadInput), Exit::LimitBroken), Exit::BadInput);
    }
}
