//! `adit run`: the whole pipeline.

use super::{Console, Exit, Failure, Result};
use crate::pipeline::{self, Kind, Observer, Options, Pipeline, Redo, STAGES, limits::Status, preflight, report};
use crate::warning::Warning;
use serde_json::json;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  adit run --input drift.laz --out runs/drift
  adit run --input station1.e57 --input station2.e57 --out runs/drift --set map.cell_m=0.005
  adit run pipelines/nightly.toml --input drift.laz --out runs/drift --set unwrap=lscm
  adit run pipelines/quick.toml --check
  adit run --input drift.laz --out /mnt/share/drift --memory 8G --tmp /var/tmp
  adit run --input drift_tuesday.laz --out runs/tuesday --compare-with runs/monday

The same command again does nothing; a changed key redoes what depends on it. An interrupted run goes on where it was.
The run folder then holds report.json (numbers and verdict), map/ (rasters and pictures), points.laz (every point with
chainage, girth and offset), mesh.ply, chart.ply, axis.csv and pipeline.toml (all settings that were used).

Before it begins, a run estimates its memory and disk from the headers of the scan; what will not fit ends at once with exit
code 6. docs/nightly.md has the formula.";

/// What a process may use; the same for run, watch and batch.
#[derive(clap::Args)]
pub(super) struct Resources {
    /// Memory that may be used, e.g. 8G or 800M. What needs more is refused before it begins (exit code 6). Default: what
    /// the machine (or the container) has free.
    #[arg(long, value_name = "SIZE", value_parser = preflight::parse_size)]
    pub(super) memory: Option<u64>,
    /// A folder on a fast disk for checkpoints and unfinished products, e.g. when --out is a network share. Default: the run
    /// folder.
    #[arg(long, value_name = "DIR")]
    pub(super) tmp: Option<PathBuf>,
}

/// Arguments of `adit run`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The pipeline file (TOML). Without one the defaults apply.
    #[arg(value_name = "PIPELINE.toml")]
    pipeline: Option<PathBuf>,
    /// A scan or mesh file; several files are one scan. Replaces the input named in the pipeline file.
    #[arg(long, value_name = "FILE", num_args = 1..)]
    input: Vec<PathBuf>,
    /// The run folder. Made if missing; by default `runs/` and the name of the pipeline file or the scan.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Override one key of the pipeline, e.g. `map.cell_m=0.005` or `unwrap=lscm`. May be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Do everything again, or only the named stages, although nothing changed.
    #[arg(long, value_name = "STAGE", num_args = 0..)]
    force: Option<Vec<String>>,
    /// Do this stage and all after it again.
    #[arg(long, value_name = "STAGE")]
    from: Option<String>,
    #[command(flatten)]
    resources: Resources,
    /// Run folder of an earlier, accepted run of the same tunnel: [limits.drift] judges the changes.
    #[arg(long, value_name = "RUN_DIR")]
    compare_with: Option<PathBuf>,
    /// Hash that the scan had when it was taken: another one means that somebody writes to it.
    #[arg(long, hide = true)]
    expect_sha256: Option<String>,
    /// End when standard input is closed: the process that started this one is gone.
    #[arg(long, hide = true)]
    end_with_stdin: bool,
    /// Only tell what would be done, and why.
    #[arg(long)]
    explain: bool,
    /// Only check the pipeline file and print it resolved.
    #[arg(long)]
    check: bool,
}

/// Runs the pipeline.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let mut pipeline = match &arguments.pipeline {
        Some(path) => Pipeline::load(path, &arguments.set),
        None => Pipeline::from_overrides(&arguments.set),
    }
    .map_err(|error| Failure::new(Exit::Usage, error))?;
    if !arguments.input.is_empty() {
        pipeline.input = arguments.input;
        pipeline.make_inputs_absolute();
    }
    if arguments.check {
        console.print(pipeline.to_toml().trim_end());
        return Ok(Exit::Done);
    }
    let named_after = arguments.pipeline.as_ref().or(pipeline.input.first());
    let out = arguments
        .out
        .or_else(|| Some(PathBuf::from("runs").join(named_after?.file_stem()?)))
        .ok_or_else(|| Failure::from(pipeline::Error::NoInput))?;
    if arguments.explain {
        return super::explain::print(&pipeline::explain(&pipeline, &out)?, console);
    }
    if arguments.end_with_stdin {
        std::thread::spawn(|| {
            // Whatever ends the reading, nobody is there any more.
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            std::process::exit(i32::from(Exit::Cancelled as u8));
        });
    }
    let options = Options {
        redo: Redo {
            all: arguments.force.as_ref().is_some_and(Vec::is_empty),
            stages: arguments.force.unwrap_or_default(),
            from: arguments.from,
        },
        memory_bytes: arguments.resources.memory,
        tmp: arguments.resources.tmp,
        compare_with: arguments.compare_with,
        expect_sha256: arguments.expect_sha256,
    };
    let outcome = pipeline::run(&pipeline, &out, &options, &Progress { console })?;
    console.finish_bar();
    let mut lines = vec![format!("{} {}", headline(outcome.status), out.display())];
    lines.extend(report::summary_lines(&outcome.report));
    if !outcome.worked {
        lines.insert(0, "nothing to do: same input, settings and version as before".to_owned());
    }
    if !console.is_quiet() {
        console.print(&lines.join("\n"));
    }
    Ok(if outcome.status == Status::Fail { Exit::LimitBroken } else { Exit::Done })
}

fn headline(status: Status) -> &'static str {
    match status {
        Status::Pass | Status::Skipped => "PASS",
        Status::Warn => "PASS with warnings:",
        Status::Fail => "FAIL (a limit was broken; the products are kept):",
    }
}

impl From<pipeline::Error> for Failure {
    fn from(error: pipeline::Error) -> Self {
        let exit = match error.kind() {
            Kind::Usage => Exit::Usage,
            Kind::BadInput => Exit::BadInput,
            Kind::Unsupported => Exit::Unsupported,
            Kind::Resources => Exit::Resources,
            Kind::Internal => Exit::Internal,
        };
        Failure::new(exit, error)
    }
}

/// Shows the stages on the console.
pub(super) struct Progress<'a> {
    pub(super) console: &'a Console,
}

impl Observer for Progress<'_> {
    fn started(&self, stage: &'static str) {
        let position = STAGES.iter().position(|s| s.name == stage).unwrap_or(0);
        self.console.start_bar(position as u64, STAGES.len() as u64, stage);
    }

    fn finished(&self, stage: &'static str, seconds: f64, reused: bool) {
        let text = if reused { format!("{stage:<8} as before") } else { format!("{stage:<8} {seconds:7.2} s") };
        let fields = [("stage", json!(stage)), ("seconds", json!(seconds)), ("reused", json!(reused))];
        if !self.console.is_quiet() {
            self.console.log("info", &text, &fields);
        }
    }

    fn resumed(&self, stage: &str) {
        if !self.console.is_quiet() {
            let text = format!("the last run here ended during {stage}; going on from the last finished stage");
            self.console.log("info", &text, &[("interrupted_stage", json!(stage))]);
        }
    }

    fn warned(&self, stage: &'static str, warning: &Warning) {
        if !self.console.is_quiet() {
            let text = format!("{stage}: {}", warning.message);
            self.console.log("warning", &text, &[("stage", json!(stage)), ("code", json!(warning.code))]);
        }
    }
}
