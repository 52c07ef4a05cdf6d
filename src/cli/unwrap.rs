//! `adit unwrap`: flattens one mesh.

use super::{Console, Exit, Failure, Result};
use crate::axis::{self, Axis};
use crate::cut::{self, Strip};
use crate::io::{self, ply};
use crate::mesh::Mesh;
use crate::numeric::Vec3;
use crate::unwrap::{self, AxisUse, Guide, Method, Settings};
use anyhow::Context;
use std::path::{Path, PathBuf};
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  adit unwrap tunnel.ply --out flat.ply                     the default method; finds the axis by itself
  adit unwrap camel.ply --method slim --out flat.ply        any mesh of disk topology; no tunnel, no axis needed
  adit unwrap tunnel.ply --method relax --set straightness=0.9 --axis axis.csv --out flat.ply
  adit unwrap tunnel.ply --method deform-arap --set 'handles=\"handles.csv\"' --out flat.ply
  adit unwrap tunnel.ply --method section --json --out flat.ply | jq .stretch.mean";

/// A border this long, compared with the longest, is a second portal rather than a hole.
const SECOND_PORTAL: f64 = 0.4;
/// Vertices that the axis is traced from: enough for a few hundred in each slice as long as the tunnel is wide; a million
/// would take longer than some methods.
const TRACED_VERTICES: usize = 40_000;
/// And where the axis only says where a method starts. Tunnels too long for them are traced again with the others.
const FEW_TRACED_VERTICES: usize = 12_000;

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
    /// The tunnel axis as CSV in scan coordinates. Without it the axis is traced when the mesh is a tube or the method
    /// needs an axis or starts better with one; texture coordinates in the file are never used.
    #[arg(long, value_name = "AXIS.csv")]
    axis: Option<PathBuf>,
    /// Insist on an axis whatever the method, to place the map and tell its readability.
    #[arg(long)]
    place_by_axis: bool,
    /// Do not look for an axis: flatten the mesh as the disk it is.
    #[arg(long, conflicts_with_all = ["axis", "place_by_axis"])]
    no_axis: bool,
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

    let Opened { strip, guide, cut, axis } = open(mesh, &arguments, &settings, &frame)?;
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
    let guide = guide.map(|guide| guide.with_handles(&handles));
    let cpu_before = cpu_seconds();
    let (chart, summary) = unwrap::flatten_guided(strip, guide, &settings).map_err(|e| {
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
        report["axis"] = axis.into();
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
        console.print(&lines(&summary, mesh.faces().len(), seconds, &axis));
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

/// A mesh ready to be flattened.
struct Opened {
    strip: Strip,
    guide: Option<Guide>,
    cut: Option<cut::Summary>,
    /// Where the axis came from, or why there is none.
    axis: String,
}

/// Traces or reads the axis where one is of use, and opens the mesh if it is a tube.
fn open(mesh: Mesh, arguments: &Arguments, settings: &Settings, frame: &crate::cloud::ScanFrame) -> Result<Opened> {
    let name = arguments.mesh.display();
    let bad = |e: anyhow::Error| Failure { exit: Exit::BadInput, error: e };
    let what = || format!("{name} cannot be opened to one strip");
    let disk = |mesh: Mesh, axis: String| -> Result<Opened> {
        let strip = Strip::from_disk(mesh).with_context(what).map_err(bad)?;
        Ok(Opened { strip, guide: None, cut: None, axis })
    };
    let along = |mesh: Mesh, axis: &Axis, source: String| -> anyhow::Result<Opened> {
        let (strip, cut) = cut::open(mesh, axis, &cut::Settings::default()).with_context(what)?;
        let guide = Guide::of_strip(&strip, axis, &settings.section())
            .with_context(|| format!("{name} does not run along its axis"))?;
        Ok(Opened { strip, guide: Some(guide), cut: Some(cut), axis: source })
    };

    if let Some(path) = &arguments.axis {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the axis {}", path.display()))
            .map_err(bad)?;
        let read = axis::import_csv(&text, frame, &axis::Settings::default());
        let axis = read.with_context(|| path.display().to_string()).map_err(bad)?.0;
        return along(mesh, &axis, format!("read from {}", path.display())).map_err(bad);
    }
    let use_of_axis = settings.method.axis_use();
    if arguments.no_axis && use_of_axis == AxisUse::Needs {
        let text = format!("--no-axis: method '{}' needs the tunnel axis", settings.method.name());
        return Err(Failure::message(Exit::Usage, text));
    }
    if arguments.no_axis {
        return disk(mesh, "none, as asked".to_owned());
    }
    let insists = arguments.place_by_axis || use_of_axis == AxisUse::Needs || is_tube(&mesh);
    if !insists && use_of_axis == AxisUse::Ignores {
        return disk(mesh, format!("not looked for: '{}' does without", settings.method.name()));
    }
    let trace = |count| axis::trace(&spread(mesh.vertices(), count), &axis::Settings::default());
    let traced = match insists {
        true => trace(TRACED_VERTICES),
        false => trace(FEW_TRACED_VERTICES).or_else(|_| trace(TRACED_VERTICES)),
    };
    if insists {
        let what = || match use_of_axis {
            AxisUse::Needs => format!("{name} shows no tunnel axis, which '{}' needs", settings.method.name()),
            _ => format!("{name} shows no tunnel axis to open it along or place it by"),
        };
        let axis = traced.with_context(what).map_err(bad)?.0;
        return along(mesh, &axis, "traced".to_owned()).map_err(bad);
    }
    // The method can do without, so an axis that does not fit is no failure of the mesh.
    let refused = |why: String| format!("none: {why}");
    match traced {
        Err(error) => disk(mesh, refused(error.to_string())),
        Ok((axis, _)) => {
            let untouched = mesh.clone();
            match along(mesh, &axis, "traced".to_owned()) {
                Ok(opened) => match opened.guide.as_ref().and_then(|guide| guide.doubt(&opened.strip)) {
                    None => Ok(opened),
                    Some(doubt) => disk(untouched, refused(format!("the one traced is not that of the mesh; {doubt}"))),
                },
                Err(error) => disk(untouched, refused(format!("the one traced does not fit; {error:#}"))),
            }
        }
    }
}

/// About `count` of the points, one from each of as many equal runs of them; where in its run changes from run to run, so
/// that the rows of a grid do not line up.
fn spread(points: &[Vec3], count: usize) -> Vec<Vec3> {
    if points.len() <= count {
        return points.to_vec();
    }
    let run = points.len() as f64 / count as f64;
    let pick = |k: usize| ((k as f64 + (k as f64 * 0.618_033_988_749_895).fract()) * run) as usize;
    (0..count).map(|k| points[pick(k).min(points.len() - 1)]).collect()
}

/// Whether the mesh hangs together and two of its borders are so long that they are portals.
fn is_tube(mesh: &Mesh) -> bool {
    if crate::mesh::topology::components(mesh.twins()).1 != 1 {
        return false;
    }
    let at = |v: u32| mesh.vertices()[v as usize];
    let mut lengths: Vec<f64> = crate::mesh::topology::boundary_loops(mesh.faces(), mesh.twins())
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
fn lines(summary: &unwrap::Summary, faces: usize, seconds: f64, axis: &str) -> String {
    let d = &summary.distortion;
    let mut text = format!(
        "{}: {faces} faces in {seconds:.1} s, {} flipped, {} overlaps\n\
         stretch mean {:.4}, 95 % {:.4}, max {:.3}; area ratio 5-95 % {:.3}-{:.3}; s1/s2 mean {:.4}; symmetric Dirichlet {:.5}; \
         conformal energy {:.6e} m2; rigid energy {:.6e} m2",
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
        d.conformal_energy_m2,
        d.rigid_energy_m2,
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
    text += &format!("\naxis: {axis}");
    if !summary.solve.converged {
        let residual = summary.solve.residual.map_or(String::new(), |r| format!(", residual {r:.1e}"));
        text += &format!("\nnot converged after {} iterations{residual}", summary.solve.iterations);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_takes_one_of_each_run_and_no_fixed_place_in_it() {
        let points: Vec<Vec3> = (0..1000).map(|i| Vec3::new(f64::from(i), 0.0, 0.0)).collect();
        assert_eq!(spread(&points, 1000), points);
        let few = spread(&points, 100);
        let runs: Vec<usize> = few.iter().map(|p| p.x as usize / 10).collect();
        assert_eq!(runs, (0..100).collect::<Vec<_>>());
        let mut places: Vec<usize> = few.iter().map(|p| p.x as usize % 10).collect();
        places.sort_unstable();
        places.dedup();
        assert_eq!(places.len(), 10);
    }
}
