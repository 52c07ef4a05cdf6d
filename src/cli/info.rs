//! `adit info`: what is in a scan or mesh file, and what is suspicious about it.

use super::read_rate::{self, ReadRate};
use super::run_surface::io_failure;
use super::{Console, Exit, Failure, Result};
use crate::io::{self, ScanInfo};
use std::fmt::Write;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  adit info drift.laz
  adit info --json station.e57 | jq .stations
  adit info --rate drift.laz            how fast it is read";

/// Arguments of `adit info`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The scan or mesh files.
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Print one JSON object for each file instead of text.
    #[arg(long)]
    json: bool,
    /// Also read the file as `adit run` does, all columns and guards, and tell how fast that was.
    #[arg(long)]
    rate: bool,
}

/// Reads every file and prints what is in it; ends with the code of the first file that cannot be read.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let settings = io::Settings::default();
    let mut first_failure = None;
    for file in &arguments.files {
        match look(file, &settings, arguments.rate) {
            Ok((info, rate)) if arguments.json => {
                let mut value = serde_json::to_value(&info).map_err(|e| Failure::new(Exit::Internal, e))?;
                if let Some(rate) = rate {
                    value["reading"] = serde_json::to_value(rate).map_err(|e| Failure::new(Exit::Internal, e))?;
                }
                console.print(&serde_json::to_string_pretty(&value).map_err(|e| Failure::new(Exit::Internal, e))?);
            }
            Ok((info, rate)) => {
                console.print(&describe(&info));
                if let Some(rate) = rate {
                    console.print(&format!("{:<24}{}", "reading", rate.describe()));
                }
            }
            Err(error) => {
                let failure = io_failure(error);
                if first_failure.is_none() {
                    first_failure = Some(failure);
                } else {
                    console.failure(&failure);
                }
            }
        }
    }
    first_failure.map_or(Ok(Exit::Done), Err)
}

/// What is in the file, and how fast it is read. The rate comes first, so that its memory is its own.
fn look(
    file: &Path,
    settings: &io::Settings,
    with_rate: bool,
) -> std::result::Result<(ScanInfo, Option<ReadRate>), io::Error> {
    let rate = with_rate.then(|| read_rate::measure(file, settings)).transpose()?;
    Ok((io::inspect(file, settings)?, rate))
}

/// The facts for a person, one a line.
fn describe(info: &ScanInfo) -> String {
    let mut out = String::new();
    let mut line = |name: &str, text: String| {
        if !text.is_empty() {
            let _ = writeln!(out, "{name:<24}{text}");
        }
    };
    line("file", format!("{} ({:.1} MB)", info.file.display(), info.bytes as f64 / 1e6));
    line("format", format!("{} {}", info.format, info.version.as_deref().unwrap_or("")));
    let dropped = info.records - info.points.min(info.records);
    let dropped = if dropped > 0 { format!(" ({dropped} records are no points)") } else { String::new() };
    line("points", format!("{}{dropped}", info.points));
    if info.faces > 0 {
        line("faces", info.faces.to_string());
    }
    if let Some([low, high]) = info.bounds {
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            let extent = (high[axis] - low[axis]) * info.metres_per_unit;
            line(name, format!("{:.4} to {:.4} ({extent:.3} m)", low[axis], high[axis]));
        }
    }
    if info.metres_per_unit != 1.0 {
        line("unit", format!("{} m", info.metres_per_unit));
    }
    if let Some(spacing) = info.spacing_m {
        let density = info.density_per_m2.map_or_else(String::new, |d| format!(", {d:.0} points per square metre"));
        line("spacing", format!("{:.1} mm{density}", spacing * 1000.0));
    }
    let attributes: Vec<String> = info
        .attributes
        .iter()
        .map(|a| match (a.min, a.max) {
            (Some(min), Some(max)) => format!("{} ({min} to {max})", a.name),
            (None, Some(max)) => format!("{} (up to {max})", a.name),
            _ => a.name.clone(),
        })
        .collect();
    line("attributes", attributes.join(", "));
    line("labels", info.label_column.clone().unwrap_or_default());
    line("crs", info.crs.clone().unwrap_or_default());
    for station in &info.stations {
        let place = station.position.map(|[x, y, z]| format!(" at {x:.3}, {y:.3}, {z:.3}"));
        line("station", format!("{}{}", station.name, place.unwrap_or_default()));
    }
    for (key, value) in &info.header {
        line(key, value.to_string());
    }
    for warning in &info.warnings {
        line("warning", format!("{} [{}]", warning.message, warning.code));
    }
    line("usable", if info.usable { "yes" } else { "no, see the warnings" }.to_owned());
    out.trim_end().to_owned()
}
