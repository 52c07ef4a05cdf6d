//! `adit explain`: what a rerun would do, and why.

use super::{Console, Exit, Failure, Result};
use crate::pipeline::{self, Explanation, Pipeline};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  adit explain runs/drift                               would the same run again do anything?
  adit explain runs/drift --set map.cell_m=0.01         what would this key make stale?";

/// Arguments of `adit explain`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The run folder.
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
    /// A pipeline file instead of the one in the run folder.
    #[arg(long, short, value_name = "PIPELINE.toml")]
    pipeline: Option<PathBuf>,
    /// Override one key, as in `adit run`.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Tells what is fresh and what is stale.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let file = arguments.pipeline.clone().unwrap_or_else(|| arguments.run.join("pipeline.toml"));
    let pipeline = Pipeline::load(&file, &arguments.set).map_err(|error| Failure::new(Exit::Usage, error))?;
    let found = pipeline::explain(&pipeline, &arguments.run)?;
    if arguments.json {
        let text = serde_json::to_string_pretty(&found).map_err(|e| Failure::new(Exit::Internal, e))?;
        console.print(&text);
        return Ok(Exit::Done);
    }
    print(&found, console)
}

/// The explanation as text.
pub(super) fn print(found: &[Explanation], console: &Console) -> Result {
    for explanation in found {
        let state = if explanation.fresh { "fresh".to_owned() } else { explanation.reasons.join("; ") };
        console.print(&format!("{:<8} {state}", explanation.stage));
    }
    Ok(Exit::Done)
}
