//! A run in its folder: what is there already stays, what is missing is done, and the limits judge it.

use super::error::Error;
use super::explain::{self, Explanation};
use super::from_mesh::run_mesh;
use super::from_scan::{Until, run_scan};
use super::judge::Previous;
use super::limits::Status;
use super::line::{Line, Observer, Stage};
use super::preflight::Need;
use super::report;
use super::run_folder::{RunFolder, sha256_of_all};
use super::settings::Pipeline;
use super::stages::{Prepared, prepare};
use crate::warning::Warning;
use serde_json::json;
use std::path::{Path, PathBuf};

/// How a run ended.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The verdict of the limits.
    pub status: Status,
    /// The report, as in `report.json`.
    pub report: serde_json::Value,
    /// Whether anything had to be done.
    pub worked: bool,
}

/// What a run is allowed and asked to do besides what its pipeline says. None of it changes a product.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// What to do again although it is there.
    pub redo: Redo,
    /// Memory that the run may need, bytes; without it, what the system has free.
    pub memory_bytes: Option<u64>,
    /// Folder on a fast disk for checkpoints and products that are being written; without it, the run folder.
    pub tmp: Option<PathBuf>,
    /// Run folder of the last accepted run of the same tunnel, for the limits of drift.
    pub compare_with: Option<PathBuf>,
    /// Hash that the input must have ([`super::run_folder::sha256_of_all`]), where it was taken for what it was before.
    pub expect_sha256: Option<String>,
}

/// What to do again although it is there.
#[derive(Clone, Debug, Default)]
pub struct Redo {
    /// Everything.
    pub all: bool,
    /// These stages.
    pub stages: Vec<String>,
    /// This stage and all after it.
    pub from: Option<String>,
}

impl Redo {
    fn includes(&self, stage: &str, stages: &[Stage]) -> bool {
        let position = |name: &str| stages.iter().position(|s| s.name == name);
        let after = self.from.as_deref().and_then(position).zip(position(stage)).is_some_and(|(from, at)| at >= from);
        self.all || after || self.stages.iter().any(|s| s == stage)
    }

    fn check(&self, stages: &[Stage]) -> Result<(), Error> {
        match self.stages.iter().chain(&self.from).find(|name| stages.iter().all(|s| s.name != **name)) {
            Some(unknown) => Err(Error::NoStage {
                name: unknown.clone(),
                stages: stages.iter().map(|s| s.name).collect::<Vec<_>>().join(", "),
            }),
            None => Ok(()),
        }
    }
}

/// What a rerun in the folder would do with each stage, and why.
///
/// # Errors
/// As [`run`], for the pipeline and its input.
pub fn explain(pipeline: &Pipeline, out: &Path) -> Result<Vec<Explanation>, Error> {
    Ok(explain::explain(&prepare(pipeline)?.plans, out))
}

/// Runs the pipeline in a run folder, doing only what is not there yet.
///
/// # Errors
/// [`Error`] with the stage that refused. The folder then holds the products of the stages before it.
pub fn run(pipeline: &Pipeline, out: &Path, options: &Options, observer: &dyn Observer) -> Result<Outcome, Error> {
    let prepared = prepare(pipeline)?;
    options.redo.check(prepared.stages)?;
    if options.expect_sha256.as_ref().is_some_and(|expected| *expected != sha256_of_all(&prepared.input_hashes)) {
        return Err(Error::InputChanged { path: pipeline.input[0].clone() });
    }
    let folder = RunFolder::open_with_scratch(out, options.tmp.as_deref())?;
    folder.refuse_inputs_inside(&pipeline.input, &["points.laz", "points.ply", "mesh.ply", "chart.ply"])?;
    if let Some(stage) = folder.interrupted() {
        observer.resumed(stage);
    }
    let result = run_in(&folder, pipeline, prepared, options, observer);
    if let Err(error) = &result {
        // The error itself is what counts; a full disk may be the reason for both.
        let _ = folder.note("run-failed", json!({ "error": error.to_string() }));
    }
    result
}

fn run_in(
    folder: &RunFolder,
    pipeline: &Pipeline,
    prepared: Prepared,
    options: &Options,
    observer: &dyn Observer,
) -> Result<Outcome, Error> {
    let Prepared { from_mesh, stages, input_hashes, stamps, plans } = prepared;
    for stage in stages.iter().filter(|s| options.redo.includes(s.name, stages)) {
        folder.forget(stage.name)?;
    }
    let line = Line::new(folder, observer, plans);
    for stage in stages.iter().filter(|s| line.is_fresh(s.name)) {
        observer.finished(stage.name, 0.0, true);
    }
    if stages.iter().any(|s| !line.is_fresh(s.name)) {
        match Need::of(&pipeline.input, pipeline) {
            Ok(need) => need.check(options.memory_bytes, folder.path())?,
            Err(error) if pipeline.ingest.allow_truncated => {
                let message = format!("memory and disk are not estimated, because {error}");
                observer.warned("ingest", &Warning::new("no-estimate", message));
            }
            Err(error) => return Err(error),
        }
        folder.note("run-begun", json!({ "adit_version": env!("CARGO_PKG_VERSION"), "input": pipeline.input }))?;
    }
    if from_mesh {
        run_mesh(pipeline, &stamps, &line)?;
    } else {
        run_scan(pipeline, &stamps, &line, Until::End)?;
    }
    let previous = options.compare_with.as_deref().map(Previous::read);
    let outcome = report::finish(pipeline, &line, folder, &input_hashes, previous)?;
    if outcome.worked {
        folder.note("run-finished", json!({ "status": outcome.status }))?;
    }
    Ok(outcome)
}

/// Runs the pipeline of a scan in a run folder as far as the surface: afterwards the folder holds `mesh.ply` and
/// `axis.csv`.
///
/// # Errors
/// As [`run`].
pub fn run_to_surface(pipeline: &Pipeline, out: &Path, observer: &dyn Observer) -> Result<(), Error> {
    let Prepared { plans, stamps, .. } = prepare(pipeline)?;
    let folder = RunFolder::open(out)?;
    folder.refuse_inputs_inside(&pipeline.input, &["mesh.ply"])?;
    run_scan(pipeline, &stamps, &Line::new(&folder, observer, plans), Until::Surface)
}
