//! `adit verify`: the certificate of a run, measured again from its files alone.

use super::run_surface::{RunSurface, io_failure, need};
use super::{Console, Exit, Failure, Result};
use crate::io::placed_points;
use crate::io::raster_pixels::RasterPixels;
use crate::linework::{self, FlattenSettings};
use crate::mesh::SurfacePoint;
use crate::mesh::anchor::Anchoring;
use crate::numeric::{Vec2, Vec3, statistics};
use crate::pipeline::limits::number;
use crate::pipeline::run_folder::sha256_of;
use crate::unwrap::{ChartIndex, distortion};
use serde::Serialize;
use serde_json::Value;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  adit verify runs/drift
  adit verify runs/drift --json

Reads report.json, chart.ply, points.laz and the rasters, nothing else. Checks that no product has changed since the run,
that every point comes back from its chainage, girth and offset, that pixels and lines come back, and that the rasters lie
where the map lies. Exit code 5 when a check fails.";

/// Arguments of `adit verify`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The run folder.
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Chainage, girth and offset are stored in micrometres; on a stretched face that is a few micrometres in space.
const POINT_M: f64 = 1e-5;
/// A place, and its neighbours a micrometre away.
const ROUNDING: [(f64, f64); 9] = [
    (0.0, 0.0),
    (1e-6, 0.0),
    (-1e-6, 0.0),
    (0.0, 1e-6),
    (0.0, -1e-6),
    (1e-6, 1e-6),
    (1e-6, -1e-6),
    (-1e-6, 1e-6),
    (-1e-6, -1e-6),
];
const PIXEL_PX: f64 = 0.01;
const LINE_M: f64 = 0.001;
/// Pixels whose content may differ from what the chart says, share: those whose centre lies on an edge.
const CONTENT_SHARE: f64 = 0.001;
/// Stored stretches are single precision.
const STRETCH: f64 = 1e-4;
/// Pixels looked at in each direction: every ...th.
const PIXEL_STEP: usize = 3;

/// One check.
#[derive(Serialize)]
struct Check {
    name: String,
    passed: bool,
    message: String,
}

/// Verifies.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let folder = &arguments.run;
    let path = need(folder, "report.json")?;
    let text = std::fs::read_to_string(&path).map_err(|e| Failure::new(Exit::BadInput, e))?;
    let report: Value = serde_json::from_str(&text)
        .map_err(|e| Failure::message(Exit::BadInput, format!("{}: {e}", path.display())))?;
    let mut checks = vec![unchanged(folder, &report)?];
    let surface = RunSurface::open(folder)?;
    let index = ChartIndex::of(&surface.chart);
    let anchoring = Anchoring::of(surface.chart.strip().mesh());
    for name in ["points.laz", "points.ply"] {
        let file = folder.join(name);
        if file.is_file() {
            checks.push(points(&file, &surface, &index, &anchoring)?);
        }
    }
    if let Some(cell_m) = report.pointer("/map/cell_m").and_then(Value::as_f64) {
        let settings = FlattenSettings { anchor: surface.pipeline.anchor.clone(), ..FlattenSettings::default() };
        let found = linework::certify(&index, &anchoring, cell_m, &settings);
        let (p, l) = (&found.pixels, &found.lines);
        checks.push(Check {
            name: "pixels".into(),
            passed: p.lost == 0 && p.sent > 0 && p.max_px <= PIXEL_PX,
            message: format!(
                "{} pixels to 3D and back: max {} px, 99 % {} px, {} lost (at most {PIXEL_PX} px)",
                p.sent,
                number(p.max_px),
                number(p.p99_px),
                p.lost
            ),
        });
        checks.push(Check {
            name: "lines".into(),
            passed: l.lost == 0 && l.sent > 0 && l.max_m <= LINE_M,
            message: format!(
                "{} lines to 3D and back: max {} m, 99 % {} m, {} lost (at most {LINE_M} m)",
                l.sent,
                number(l.max_m),
                number(l.p99_m),
                l.lost
            ),
        });
        for file in rasters(folder)? {
            checks.push(raster(&file, &report, &surface, &index));
        }
    }
    let passed = checks.iter().all(|c| c.passed);
    if arguments.json {
        let report = serde_json::json!({ "passed": passed, "checks": checks });
        console.print(&format!("{report:#}"));
    } else {
        for check in &checks {
            console.print(&format!("  {:<5} {}", if check.passed { "pass" } else { "FAIL" }, check.message));
        }
    }
    Ok(if passed { Exit::Done } else { Exit::LimitBroken })
}

/// Every product still has the bytes that the report tells.
fn unchanged(folder: &Path, report: &Value) -> Result<Check> {
    let products = report.get("products").and_then(Value::as_array).cloned().unwrap_or_default();
    let mut wrong = Vec::new();
    for product in &products {
        let (Some(name), Some(hash)) = (product["name"].as_str(), product["sha256"].as_str()) else { continue };
        let file = folder.join(name);
        if !file.is_file() {
            wrong.push(format!("{name} is missing"));
        } else if sha256_of(&file).map_err(|e| Failure::new(Exit::BadInput, e))? != hash {
            wrong.push(format!("{name} has changed since the run"));
        }
    }
    let message = match (products.len(), wrong.is_empty()) {
        (0, _) => "report.json names no products".to_owned(),
        (count, true) => format!("{count} products have the bytes of the run"),
        (_, false) => wrong.join("; "),
    };
    Ok(Check { name: "products".into(), passed: wrong.is_empty() && !products.is_empty(), message })
}

/// Every point with a place comes back from (chainage, girth, offset) to its own coordinates.
fn points(file: &Path, surface: &RunSurface, index: &ChartIndex, anchoring: &Anchoring) -> Result<Check> {
    let (mut errors, mut lost, mut without, mut beyond, mut wrong) = (Vec::new(), 0usize, 0usize, 0usize, 0usize);
    let (mesh, uv) = (anchoring.mesh(), surface.chart.uv());
    placed_points(file, &mut |points| {
        for point in points {
            if point.on_map.x.is_nan() {
                without += 1;
                continue;
            }
            let p = surface.frame.local_from_scan(&point.position_in_scan);
            // Points beyond a border were clamped to it and marked so in the run: they do not come back.
            match anchoring.place(&p, &surface.pipeline.anchor) {
                Some((_, true)) => {}
                _ => {
                    beyond += 1;
                    continue;
                }
            }
            // Rounding to micrometres takes places at the border of the map over it.
            let near = ROUNDING.iter().find_map(|(u, v)| index.surface_point(point.on_map.xy() + Vec2::new(*u, *v)));
            match near {
                Some(foot) => {
                    let back = SurfacePoint { offset: point.on_map.z, ..foot };
                    let error = (back.position(mesh, anchoring.normals()) - p).norm();
                    // A rounded micrometre of the map is more on the wall where the map shrinks it.
                    let shrunk = 1.0 / distortion::of_face(mesh, uv, foot.face).s2.abs().max(f64::MIN_POSITIVE);
                    wrong += usize::from(!(error <= POINT_M * shrunk.max(1.0)));
                    errors.push(error);
                }
                None => lost += 1,
            }
        }
    })
    .map_err(io_failure)?;
    let count = errors.len();
    let max = errors.iter().copied().fold(0.0, f64::max);
    let p99 = statistics::quantile(&mut errors, 0.99).unwrap_or(0.0);
    Ok(Check {
        name: "points".into(),
        passed: wrong == 0 && lost == 0 && count > 0,
        message: format!(
            "{count} points from their chainage, girth and offset: max {} m, 99 % {} m, {wrong} farther off than {POINT_M} m times \
             what the map shrinks there, {lost} lost; {without} have no place, {beyond} lie beyond a border",
            number(max),
            number(p99)
        ),
    })
}

fn rasters(folder: &Path) -> Result<Vec<PathBuf>> {
    let map = folder.join("map");
    let entries =
        std::fs::read_dir(&map).map_err(|e| Failure::message(Exit::BadInput, format!("{}: {e}", map.display())))?;
    let mut files: Vec<PathBuf> =
        entries.filter_map(|e| Some(e.ok()?.path())).filter(|p| p.extension().is_some_and(|e| e == "tif")).collect();
    files.sort();
    Ok(files)
}

/// A raster lies on the grid of the map; where its content follows from the surface alone, it is compared with it.
fn raster(file: &Path, report: &Value, surface: &RunSurface, index: &ChartIndex) -> Check {
    let stem = file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let name = format!("raster {stem}");
    let fail = |message: String| Check { name: name.clone(), passed: false, message };
    let mut pixels = match RasterPixels::open(file) {
        Ok(pixels) => pixels,
        Err(error) => return fail(error.to_string()),
    };
    let at = |path: &str| report.pointer(path).and_then(Value::as_f64).unwrap_or(f64::NAN);
    let cell = at("/map/cell_m");
    let corner = pixels.placement.chart_from_pixel(Vec2::zeros());
    let off = Vec2::new((corner.x - at("/map/u_min_m")) / cell, (corner.y - at("/map/v_max_m")) / cell);
    let size = (at("/map/width_px") as usize, at("/map/height_px") as usize);
    let same_cell =
        (pixels.placement.step_u / cell - 1.0).abs() < 1e-9 && (pixels.placement.step_v / cell + 1.0).abs() < 1e-9;
    if !(off.amax() <= PIXEL_PX) || !same_cell || pixels.size != size {
        return fail(format!(
            "map/{stem}.tif lies {} px to the right and {} px above where the map lies, with {} x {} pixels of {} m",
            number(off.x),
            number(off.y),
            pixels.size.0,
            pixels.size.1,
            number(pixels.placement.step_u)
        ));
    }
    let mesh = surface.chart.strip().mesh();
    let normals = vec![Vec3::zeros(); mesh.vertices().len()];
    let placement = pixels.placement;
    let offsets = pixels.band_offsets.clone();
    let (mut compared, mut wrong, mut worst) = (0usize, 0usize, 0.0f64);
    // Stored with seven digits of the distance from the band's offset.
    let single = 2e-6 * (mesh.vertices().iter().map(|p| p.amax()).fold(1.0, f64::max));
    let mut compare = |column: usize, row: usize, stored: &[f32]| {
        if stored[0].is_nan() {
            return;
        }
        compared += 1;
        let centre = placement.chart_from_pixel(Vec2::new(column as f64 + 0.5, row as f64 + 0.5));
        let Some(foot) = index.surface_point(centre) else {
            wrong += 1;
            return;
        };
        let off = if stem == "xyz" {
            let scan = Vec3::from_fn(|k, _| f64::from(stored[k]) + offsets.get(k).copied().unwrap_or(0.0));
            let error = (surface.frame.local_from_scan(&scan) - foot.position(mesh, &normals)).norm();
            worst = worst.max(error);
            error > single
        } else {
            let d = distortion::of_face(mesh, surface.chart.uv(), foot.face);
            let differs = |a: f64, b: f32| !((a - f64::from(b)).abs() <= STRETCH * a.abs().max(1.0));
            differs(d.s1, stored[0]) || differs(d.s2, stored[1])
        };
        wrong += usize::from(off);
    };
    if !matches!(stem.as_str(), "xyz" | "distortion") {
        return Check { name, passed: true, message: format!("map/{stem}.tif lies on the grid of the map") };
    }
    if let Err(error) = pixels.for_each(PIXEL_STEP, &mut compare) {
        return fail(error.to_string());
    }
    let share = wrong as f64 / compared.max(1) as f64;
    let told = if stem == "xyz" { format!(", at most {} m off", number(worst)) } else { String::new() };
    Check {
        name,
        passed: compared > 0 && share <= CONTENT_SHARE,
        message: format!(
            "map/{stem}.tif lies on the grid of the map; {wrong} of {compared} pixels differ from the surface under them{told}"
        ),
    }
}
