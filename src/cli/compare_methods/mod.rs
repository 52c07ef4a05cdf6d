//! `adit compare-methods`: flattens one strip with every method and puts the figures and the maps side by side.
//!
//! The strip is made once. Every method then runs in a process of its own (`adit unwrap`), so that time and memory are its
//! own and a method that fails, or takes too long, leaves the others alone.

mod picture;
mod table;

use super::{Console, Exit, Failure, Result};
use crate::axis::{self, Axis};
use crate::cloud::ScanFrame;
use crate::cut::{self, Strip};
use crate::io::{self, ply};
use crate::mesh::Mesh;
use crate::pipeline::{self, Pipeline};
use crate::unwrap::{Guide, Method};
use anyhow::Context;
use serde_json::Value;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const EXAMPLES: &str = "\
Examples:
  adit compare-methods drift.laz --out comparison                 from a scan: its surface is made first
  adit compare-methods pipelines/compare_methods.toml --out comparison
  adit compare-methods tunnel.ply --methods section,lscm,arap,relax --out comparison
  adit compare-methods tunnel.ply --methods relax:straightness=0,relax:straightness=1 --keep-maps --out curve

A method may carry settings behind a colon, several separated by semicolons. The folder then holds comparison.csv, .json,
.md and .png, and the strip that was flattened: strip.ply, axis.csv.";

/// Arguments of `adit compare-methods`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// A scan, a mesh (a tunnel tube or already cut open), or a pipeline file that names one.
    #[arg(value_name = "SCAN|MESH|PIPELINE.toml", required = true)]
    input: Vec<PathBuf>,
    /// The folder for the comparison. Made if missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The methods, separated by commas. All when not given.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    methods: Vec<String>,
    /// The tunnel axis as CSV; traced when not given.
    #[arg(long, value_name = "AXIS.csv")]
    axis: Option<PathBuf>,
    /// Override one key of the pipeline that makes the strip, e.g. `mesh.spacing_m=0.1`. May be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// A method that takes longer than this many seconds is stopped.
    #[arg(long, value_name = "S", default_value_t = 1800.0)]
    limit_s: f64,
    /// Keep each method's map as `METHOD.ply`.
    #[arg(long)]
    keep_maps: bool,
}

/// A method with settings, as asked for.
struct Entry {
    /// As typed: names the row.
    label: String,
    method: &'static str,
    set: Vec<String>,
}

impl Entry {
    fn parse(text: &str) -> Result<Self> {
        let (name, settings) = text.split_once(':').unwrap_or((text, ""));
        let method = Method::named(name.trim()).ok_or_else(|| {
            let known = Method::NAMES.join(", ");
            Failure::message(Exit::Usage, format!("there is no method '{name}'; there are {known}"))
        })?;
        let set = settings.split(';').map(str::trim).filter(|s| !s.is_empty()).map(str::to_owned).collect();
        Ok(Self { label: text.trim().to_owned(), method: method.name(), set })
    }

    /// The method's map in the folder.
    fn map(&self, folder: &Path) -> PathBuf {
        let safe = |c: char| if c.is_ascii_alphanumeric() || "+-.=".contains(c) { c } else { '_' };
        folder.join(format!("{}.ply", self.label.chars().map(safe).collect::<String>()))
    }
}

/// A row of the comparison: the report of `adit unwrap --json`, or why there is none.
struct Row {
    entry: Entry,
    report: std::result::Result<Value, String>,
}

/// The strip that all methods flatten.
struct Common {
    strip: Strip,
    axis: Option<Axis>,
    strip_file: PathBuf,
    axis_file: Option<PathBuf>,
}

/// Runs all methods and writes the comparison.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let mut entries: Vec<Entry> = arguments.methods.iter().map(|m| Entry::parse(m)).collect::<Result<_>>()?;
    if entries.is_empty() {
        entries = Method::NAMES.iter().map(|m| Entry::parse(m)).collect::<Result<_>>()?;
    }
    if let Some(twice) = (1..entries.len()).find(|&k| entries[..k].iter().any(|e| e.label == entries[k].label)) {
        return Err(Failure::message(Exit::Usage, format!("'{}' is named twice", entries[twice].label)));
    }
    if !(arguments.limit_s > 0.0) {
        return Err(Failure::message(Exit::Usage, "--limit-s must be more than 0".to_owned()));
    }
    let resources = |e: anyhow::Error| Failure { exit: Exit::Resources, error: e };
    let out = &arguments.out;
    std::fs::create_dir_all(out).with_context(|| format!("cannot make {}", out.display())).map_err(resources)?;
    let common = common_strip(&arguments, console)?;
    let limit = Duration::try_from_secs_f64(arguments.limit_s).unwrap_or(Duration::MAX);
    let count = entries.len();
    let mut rows: Vec<Row> = Vec::new();
    for (k, entry) in entries.into_iter().enumerate() {
        console.start_bar(k as u64, count as u64, &entry.label);
        let started = Instant::now();
        let report = run_one(&entry, &common, out, limit).map_err(resources)?;
        let told = match &report {
            Ok(_) => format!("{:.1} s", started.elapsed().as_secs_f64()),
            Err(why) => format!("failed: {why}"),
        };
        console.say(&format!("{}/{count} {}: {told}", k + 1, entry.label));
        rows.push(Row { entry, report });
    }
    console.finish_bar();
    if let Some(Err(why)) = rows.iter().all(|row| row.report.is_err()).then(|| rows[0].report.as_ref()) {
        let text = format!("no method flattened {}: {why}", arguments.input[0].display());
        return Err(Failure::message(Exit::BadInput, text));
    }
    let write = |name: &str, bytes: &[u8]| {
        let path = out.join(name);
        std::fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display())).map_err(resources)
    };
    write("comparison.csv", table::csv(&rows).as_bytes())?;
    write("comparison.md", table::markdown(&rows).as_bytes())?;
    write("comparison.json", table::json(&rows).as_bytes())?;
    let guide = match &common.axis {
        Some(axis) => Some(Guide::of_strip(&common.strip, axis, &Default::default()).map_err(|e| resources(e.into()))?),
        None => None,
    };
    let picture = picture::draw(&rows, &common.strip, guide.as_ref(), out).map_err(resources)?;
    write("comparison.png", &picture)?;
    if !arguments.keep_maps {
        for row in rows.iter().filter(|row| row.report.is_ok()) {
            let map = row.entry.map(out);
            std::fs::remove_file(&map)
                .with_context(|| format!("cannot remove {}", map.display()))
                .map_err(resources)?;
        }
    }
    console.print(&table::markdown(&rows));
    Ok(Exit::Done)
}

/// The strip from a scan, a mesh or a pipeline file, written into the folder with its axis.
fn common_strip(arguments: &Arguments, console: &Console) -> Result<Common> {
    let bad = |e: anyhow::Error| Failure { exit: Exit::BadInput, error: e };
    let out = &arguments.out;
    let is_pipeline = |p: &PathBuf| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("toml"));
    let mut pipeline = match &arguments.input[..] {
        [file] if is_pipeline(file) => Pipeline::load(file, &arguments.set),
        files => Pipeline::from_overrides(&arguments.set).map(|mut pipeline| {
            pipeline.input = files.to_vec();
            pipeline.make_inputs_absolute();
            pipeline
        }),
    }
    .map_err(|e| Failure::new(Exit::Usage, e))?;
    if let Some(axis) = &arguments.axis {
        pipeline.axis.alignment = Some(axis.clone());
    }
    if pipeline.input.is_empty() {
        return Err(pipeline::Error::NoInput.into());
    }
    let (mesh_file, alignment) = if pipeline::is_mesh(&pipeline.input)? {
        (pipeline.input[0].clone(), pipeline.axis.alignment.clone())
    } else {
        let folder = out.join("surface");
        pipeline::run_to_surface(&pipeline, &folder, &super::run::Progress { console })?;
        console.finish_bar();
        (folder.join("mesh.ply"), Some(folder.join("axis.csv")))
    };
    let (raw, read) = io::read_mesh(&mesh_file).map_err(|e| Failure::new(Exit::BadInput, e))?;
    read.warnings.iter().for_each(|w| console.warn(&w.message));
    let (frame, name) = (raw.frame.clone(), mesh_file.display());
    let observed = raw.observed.unwrap_or_else(|| vec![true; raw.faces.len()]);
    let mesh = Mesh::new(raw.vertices, raw.faces, observed).with_context(|| format!("{name}")).map_err(bad)?;
    let settings = axis::Settings { alignment: None, ..pipeline.axis.in_local(&frame) };
    let axis = match &alignment {
        Some(path) => {
            let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()));
            let read = axis::import_csv(&text.map_err(bad)?, &frame, &axis::Settings::default());
            Some(read.with_context(|| path.display().to_string()).map_err(bad)?.0)
        }
        None => match axis::trace(mesh.vertices(), &settings) {
            Ok((axis, _)) => Some(axis),
            Err(error) => {
                console.warn(&format!("{name} shows no tunnel axis ({error}): maps are compared without readability"));
                None
            }
        },
    };
    let strip = match &axis {
        Some(axis) => {
            let (strip, cut) = cut::open(mesh, axis, &pipeline.cut).with_context(|| format!("{name}")).map_err(bad)?;
            cut.warnings.iter().for_each(|w| console.warn(&w.message));
            strip
        }
        None => Strip::from_disk(mesh).with_context(|| format!("{name}")).map_err(bad)?,
    };
    let strip_file = out.join("strip.ply");
    write_strip(&strip, &frame, &strip_file)?;
    let axis_file = axis.as_ref().map(|axis| (out.join("axis.csv"), pipeline::axis_csv(axis, &frame)));
    if let Some((path, text)) = &axis_file {
        std::fs::write(path, text)
            .with_context(|| format!("cannot write {}", path.display()))
            .map_err(|e| Failure { exit: Exit::Resources, error: e })?;
    }
    Ok(Common { strip, axis, strip_file, axis_file: axis_file.map(|(path, _)| path) })
}

fn write_strip(strip: &Strip, frame: &ScanFrame, path: &Path) -> Result<()> {
    let mesh = strip.mesh();
    let observed = mesh.observed_vertices();
    let file = ply::PlyMesh {
        frame,
        vertices: mesh.vertices(),
        uv: None,
        faces: mesh.faces(),
        observed_vertices: Some(&observed),
        observed_faces: Some(mesh.observed()),
        quality: None,
    };
    ply::write_mesh(&file, path).map_err(|e| Failure::new(Exit::Resources, e))
}

/// The report of one method, or why it failed.
fn run_one(
    entry: &Entry,
    common: &Common,
    out: &Path,
    limit: Duration,
) -> anyhow::Result<std::result::Result<Value, String>> {
    let program = std::env::current_exe().context("cannot find the running program")?;
    let mut command = Command::new(program);
    command.arg("unwrap").arg(&common.strip_file).args(["--method", entry.method, "--json", "--quiet"]);
    command.arg("--out").arg(entry.map(out));
    entry.set.iter().for_each(|pair| {
        command.args(["--set", pair]);
    });
    if let Some(axis) = &common.axis_file {
        command.arg("--axis").arg(axis);
    }
    let mut child =
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().context("cannot start a second adit")?;
    let (stdout, stderr) = (read_all(child.stdout.take()), read_all(child.stderr.take()));
    let started = Instant::now();
    let status = loop {
        match child.try_wait().context("cannot wait for the second adit")? {
            Some(status) => break Some(status),
            None if started.elapsed() >= limit => {
                child.kill().context("cannot stop the second adit")?;
                child.wait().context("cannot wait for the second adit")?;
                break None;
            }
            None => std::thread::sleep(Duration::from_millis(20)),
        }
    };
    let text = |reader: std::thread::JoinHandle<Vec<u8>>| reader.join().unwrap_or_default();
    let (stdout, stderr) = (text(stdout), text(stderr));
    Ok(match status {
        None => Err(format!("stopped after {:.0} s (--limit-s)", limit.as_secs_f64())),
        Some(status) if status.success() => {
            Ok(serde_json::from_slice(&stdout).context("adit unwrap --json gave no JSON")?)
        }
        Some(status) => {
            let text = String::from_utf8_lossy(&stderr);
            let last = text.lines().rev().find(|l| !l.trim().is_empty());
            // Without a last word it was ended from outside: out of memory, as a rule.
            Err(last.map_or_else(|| format!("ended: {status}"), |l| l.trim_start_matches("error: ").to_owned()))
        }
    })
}

/// Reads a pipe to its end beside the main thread, so that the writer never waits.
fn read_all(pipe: Option<impl Read + Send + 'static>) -> std::thread::JoinHandle<Vec<u8>> {
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(mut pipe) = pipe {
            // A broken pipe ends the text; the exit status tells the rest.
            let _ = pipe.read_to_end(&mut bytes);
        }
        bytes
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_method_may_carry_settings() {
        let entry = Entry::parse("relax:straightness=0.25;max_iterations=9").unwrap_or_else(|_| panic!());
        assert_eq!((entry.method, entry.set.len(), entry.set[1].as_str()), ("relax", 2, "max_iterations=9"));
        assert_eq!(entry.map(Path::new("x")), Path::new("x/relax_straightness=0.25_max_iterations=9.ply"));
        assert!(Entry::parse("relaxx").is_err());
    }
}
