//! `adit run`: the whole pipeline.

use super::{Console, Exit, Failure, Result};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  adit run --input drift.laz --out runs/drift
  adit run --input station1.e57 --input station2.e57 --out runs/drift --set map.cell_m=0.005
  adit run pipelines/nightly.toml --input drift.laz --out runs/drift --set unwrap=lscm
  adit run pipelines/quick.toml --check";

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
    /// The run folder. Made if missing.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Override one key of the pipeline, e.g. `map.cell_m=0.005` or `unwrap=lscm`. May be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Only check the pipeline file and print it resolved.
    #[arg(long)]
    check: bool,
}

/// Runs the pipeline.
pub fn run(arguments: Arguments, _console: &Console) -> Result {
    let _ = (arguments.pipeline, arguments.input, arguments.out, arguments.set, arguments.check);
    Err(Failure::message(Exit::Unsupported, "the stages are not connected yet"))
}
