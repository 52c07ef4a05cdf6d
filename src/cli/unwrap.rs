//! `adit unwrap`: flattens one mesh.

use super::{Console, Exit, Failure, Result};
use crate::axis::{self, Axis};
use crate::cut::{self, Strip};
use crate::io::{self, ply};
use crate::mesh::Mesh;
use crate::unwrap::{self, Method, Settings};
use anyhow::Context;
use std::path::{Path, PathBuf};
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  adit unwrap tunnel.ply --out flat.ply                     the default method; finds the axis by itself
  adit unwrap tunnel.ply --method slim --out flat.ply       any mesh of disk topology, no axis needed
  adit unwrap tunnel.ply --method relax --set straightness=0.9 --axis axis.csv --out flat.ply
  adit unwrap tunnel.ply --method deform-arap --set 'handles=\"handles.csv\"' --out flat.ply
  adit unwrap tunnel.ply --method section --json --out flat.ply | jq .stretch.mean";

/// A border this long, compared with the longest, is a second portal rather than a hole.
const SECOND_PORTAL: f64 = 0.4;

/// Arguments of `adit unwrap`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The mesh (PLY, OBJ, OFF ...): one component without handles. A tube is cut open along its invert first.
    #[arg(value_name = "MESH")]
    mesh: PathBuf,
    /// How to flatten.
    #[arg(long, value_name = "NAME")]
    method: Option<String>,
    /// A setting of the method, e.g. `straightness=0.9`. May be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// The flat mesh, written as PLY: positions `x y z` of the input and map coordinates `u v` in metres.
    #[arg(long, value_name = "FLAT.ply")]
    out: PathBuf,
    /// The tunnel axis as CSV in scan coordinates. Without it the axis is traced when the method needs one.
    #[arg(long, value_name = "AXIS.csv")]
    axis: Option<PathBuf>,
    /// Trace the axis even if the method can do without, to place the map and tell its readability.
    #[arg(long)]
    place_by_axis: bool,
    /// Print distortion, readability and timings as JSON.
    #[arg(long)]
    json: bool,
}

/// Flattens the mesh.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let started = Instant::now();
    let settings = settings(arguments.method.as_deref(), &arguments.set)?;
    let (raw, read) = io::read_mesh(&arguments.mesh).map_err(|e| Failure::new(Exit::BadInput, e))?;
    read.warnings.iter().for_each(|w| console.warn(&w.message));
    let frame = raw.frame.clone();
    let bad_mesh = |e: anyhow::Error| Failure { exit: Exit::BadInput, error: e };
    let name = arguments.mesh.display();
    let observed = raw.observed.unwrap_or_else(|| vec![true; raw.faces.len()]);
    let mesh = Mesh::new(raw.vertices, raw.faces, observed)
        .with_context(|| format!("{name} cannot be flattened; repair the mesh"))
        .map_err(bad_mesh)?;
    let read_seconds = started.elapsed().as_secs_f64();

    let (strip, axis, cut) = open(mesh, &arguments, &settings, &frame)?;
    if let Some(cut) = &cut {
        cut.warnings.iter().for_each(|w| console.warn(&w.message));
    }
    let open_seconds = started.elapsed().as_secs_f64() - read_seconds;
    let handles = match settings.method.handles_file() {
        Some(path) => {
            let text =
                std::fs::read_to_string(path).with_context(|| format!("cannot read the handles {}", path.display()));
            let text = text.map_err(bad_mesh)?;
            unwrap::handles::import_csv(&text, &path.display().to_string(), &frame)
                .map_err(|e| Failure::new(Exit::BadInput, e))?
        }
        None => Vec::new(),
    };
    let cpu_before = cpu_seconds();
    let (chart, summary) = unwrap::flatten_with_handles(strip, axis.as_ref(), &handles, &settings).map_err(|e| {
        let exit = if matches!(e, unwrap::Error::Setting { .. }) { Exit::Usage } else { Exit::BadInput };
        Failure { exit, error: anyhow::Error::new(e).context(format!("{name} was not flattened")) }
    })?;
    summary.warnings.iter().for_each(|w| console.warn(&w.message));
    let flatten_seconds = started.elapsed().as_secs_f64() - read_seconds - open_seconds;
    let flatten_cpu_seconds = cpu_seconds().zip(cpu_before).map(|(after, before)| after - before);

    let mesh = chart.strip().mesh();
    let observed = mesh.observed_vertices();
    let flat = ply::PlyMesh {
        frame: &frame,
        vertices: mesh.vertices(),
        uv: Some(chart.uv()),
        faces: mesh.faces(),
        observed_vertices: Some(&observed),
        observed_faces: None,
        quality: None,
    };
    write_whole(&flat, &arguments.out)?;
    let seconds = started.elapsed().as_secs_f64();
    if arguments.json {
        let mut report = serde_json::to_value(&summary).map_err(|e| Failure::new(Exit::Internal, e))?;
        report["faces"] = mesh.faces().len().into();
        report["cut"] = serde_json::to_value(&cut).map_err(|e| Failure::new(Exit::Internal, e))?;
        report["seconds"] = serde_json::json!({
            "read": read_seconds, "open": open_seconds, "flatten": flatten_seconds, "all": seconds,
            "flatten_cpu": flatten_cpu_seconds,
        });
        if let Some(peak) = peak_memory_mib() {
            report["peak_memory_mib"] = peak.into();
        }
        console.print(&format!("{report:#}"));
    } else {
        console.print(&lines(&summary, mesh.faces().len(), seconds));
    }
    Ok(Exit::Done)
}

/// The settings from the method's name and `key=value` pairs.
fn settings(method: Option<&str>, set: &[String]) -> Result<Settings> {
    let usage = |text: String| Failure::message(Exit::Usage, text);
    let name = match method {
        Some(name) => Method::named(name)
            .ok_or_else(|| usage(format!("there is no method '{name}'; there are {}", Method::NAMES.join(", "))))?
            .name(),
        None => Settings::default().method.name(),
    };
    let mut table = format!("[\"{name}\"]\n");
    for pair in set {
        let (key, value) = pair
            .split_once('=')
            .ok_or_else(|| usage(format!("--set {pair}: expected KEY=VALUE, e.g. straightness=0.9")))?;
        let key = key.trim().trim_start_matches("unwrap.").trim_start_matches(&format!("{name}."));
        table.push_str(&format!("{key} = {}\n", value.trim()));
    }
    toml::from_str(&table).map_err(|e| usage(format!("--set: {}", e.message())))
}

/// Traces or reads the axis where one is needed, and opens the mesh if it is a tube.
fn open(
    mesh: Mesh,
    arguments: &Arguments,
    settings: &Settings,
    frame: &crate::cloud::ScanFrame,
) -> Result<(Strip, Option<Axis>, Option<cut::Summary>)> {
    let name = arguments.mesh.display();
    let bad = |e: anyhow::Error| Failure { exit: Exit::BadInput, error: e };
    let axis = match &arguments.axis {
        Some(path) => {
            let text = std::fs::read_to_string(path)
                .with_context(|| format!("cannot read the axis {}", path.display()))
                .map_err(bad)?;
            let read = axis::import_csv(&text, frame, &axis::Settings::default());
            Some(read.with_context(|| path.display().to_string()).map_err(bad)?.0)
        }
        None if arguments.place_by_axis || settings.method.needs_axis() || is_tube(&mesh) => {
            let traced = axis::trace(mesh.vertices(), &axis::Settings::default());
            let what = || format!("{name} shows no tunnel axis, which '{}' needs", settings.method.name());
            Some(traced.with_context(what).map_err(bad)?.0)
        }
        None => None,
    };
    let what = || format!("{name} cannot be opened to one strip");
    match axis {
        Some(axis) => {
            let (strip, cut) = cut::open(mesh, &axis, &cut::Settings::default()).with_context(what).map_err(bad)?;
            Ok((strip, Some(axis), Some(cut)))
        }
        None => Ok((Strip::from_disk(mesh).with_context(what).map_err(bad)?, None, None)),
    }
}

/// Whether two borders are so long that they are portals.
fn is_tube(mesh: &Mesh) -> bool {
    let Ok(twin) = crate::mesh::topology::twins(mesh.faces()) else { return false };
    let at = |v: u32| mesh.vertices()[v as usize];
    let mut lengths: Vec<f64> = crate::mesh::topology::boundary_loops(mesh.faces(), &twin)
        .iter()
        .map(|l| (0..l.len()).map(|i| (at(l[(i + 1) % l.len()]) - at(l[i])).norm()).sum())
        .collect();
    lengths.sort_by(|a, b| b.total_cmp(a));
    matches!(lengths[..], [first, second, ..] if second > SECOND_PORTAL * first)
}

/// Largest memory of this process so far, where the system tells (Linux).
fn peak_memory_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    Some((line.trim().trim_end_matches("kB").trim().parse::<f64>().ok()? / 1024.0).round())
}

/// Processor time of this process so far, all threads together, where the system tells (Linux).
fn cpu_seconds() -> Option<f64> {
    /// The kernel counts in hundredths of a second whatever its own clock does.
    const TICKS_PER_SECOND: f64 = 100.0;
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The second field, the name, may hold blanks; it ends with the last parenthesis.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |field: usize| fields.get(field)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) / TICKS_PER_SECOND)
}

/// Writes under a temporary name first, so that a killed process leaves no half a file under the final one.
fn write_whole(flat: &ply::PlyMesh, out: &Path) -> Result<()> {
    let mut temporary = out.as_os_str().to_owned();
    temporary.push(".partial");
    let temporary = PathBuf::from(temporary);
    ply::write_mesh(flat, &temporary).map_err(|e| Failure::new(Exit::Resources, e))?;
    std::fs::rename(&temporary, out)
        .with_context(|| format!("cannot write {}", out.display()))
        .map_err(|e| Failure { exit: Exit::Resources, error: e })
}

/// The result in a few lines.
fn lines(summary: &unwrap::Summary, faces: usize, seconds: f64) -> String {
    let d = &summary.distortion;
    let mut text = format!(
        "{}: {faces} faces in {seconds:.1} s, {} flipped, {} overlaps\n\
         stretch mean {:.4}, 95 % {:.4}, max {:.3}; area ratio 5-95 % {:.3}-{:.3}; s1/s2 mean {:.4}; symmetric Dirichlet {:.5}",
        summary.method,
        summary.flipped_faces,
        summary.overlaps,
        d.stretch.mean,
        d.stretch.p95,
        d.stretch.max,
        d.area_ratio.p05,
        d.area_ratio.p95,
        d.anisotropy.mean,
        d.symmetric_dirichlet,
    );
    if let Some(smoothed) = &summary.smoothed {
        text += &format!(
            "\nagainst the surface smoothed over {} m: stretch mean {:.4}, 95 % {:.4}",
            summary.smoothing_m, smoothed.stretch.mean, smoothed.stretch.p95
        );
    }
    if let Some(r) = &summary.readability {
        text += &format!(
            "\nchainage error rms {:.3} m, max {:.3} m; bearing error rms {:.2} deg; girth error rms {:.3} m",
            r.chainage_rms_m, r.chainage_max_m, r.bearing_rms_deg, r.girth_rms_m
        );
    }
    if !summary.solve.converged {
        let residual = summary.solve.residual.map_or(String::new(), |r| format!(", residual {r:.1e}"));
        text += &format!("\nnot converged after {} iterations{residual}", summary.solve.iterations);
    }
    text
}
