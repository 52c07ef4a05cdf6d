//! `adit sheet`: the map on paper, at true scale, as PDF, SVG or PNG.

use super::{Console, Exit, Failure, Result};
use crate::io::raster_file::{self, RasterFile};
use crate::io::{self, drawing};
use crate::map::sheet::{Layout, Page, SheetContent, SheetError, SheetSettings, Strip, Trace, View, nice_range, sheet};
use crate::map::{COVERAGE_NONE, COVERAGE_OBSERVED, Layer, Legend, LegendLayer, ReferenceLine};
use clap::ValueEnum;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  adit sheet runs/drift --scale 100 --out drift.pdf
  adit sheet runs/drift --scale 50 --layout chainage-y --view outside --paper a1 --out drift.pdf
  adit sheet runs/drift --layer offset --traces fractures.geojson --out drift.svg

One metre is 1000 / scale millimetres on every page; long tunnels take several pages that overlap. SVG and PNG hold one
page a file: drift-1.svg, drift-2.svg ...";

/// Arguments of `adit sheet`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The run folder.
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Where the sheet goes.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// One metre is 1000 / SCALE millimetres.
    #[arg(long, default_value_t = 100.0)]
    scale: f64,
    /// What kind of file; by default what the name of the output says.
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// The paper, landscape for chainage-x and portrait for chainage-y; by default the smallest that holds the girth.
    #[arg(long, value_enum)]
    paper: Option<Paper>,
    /// The layer that is printed; by default color, else intensity, else relief.
    #[arg(long, value_name = "LAYER")]
    layer: Option<String>,
    /// Which way the chainage runs.
    #[arg(long, value_enum, default_value_t = LayoutName::ChainageX)]
    layout: LayoutName,
    /// From where the wall is seen.
    #[arg(long, value_enum, default_value_t = ViewName::Inside)]
    view: ViewName,
    /// Resolution of the printed raster, pixels an inch.
    #[arg(long, default_value_t = 200.0)]
    dpi: f64,
    /// Name of the project in the title block; by default the names of the scans.
    #[arg(long, value_name = "TEXT")]
    project: Option<String>,
    /// Mapped lines to be printed with their ids: GeoJSON in map coordinates (chainage, girth). May be repeated.
    #[arg(long, value_name = "FILE")]
    traces: Vec<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    Pdf,
    Svg,
    Png,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Paper {
    A4,
    A3,
    A2,
    A1,
    A0,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum LayoutName {
    ChainageX,
    ChainageY,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ViewName {
    Inside,
    Outside,
}

/// Columns of a strip along the tunnel, metres.
const STRIP_STEP_M: f64 = 0.5;
/// Pixels of the raster that strips are measured on, at most.
const STRIP_PIXELS: usize = 4_000_000;

/// Draws the sheet.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let format = format_of(&arguments)?;
    if !(arguments.dpi >= 20.0 && arguments.dpi <= 1200.0) {
        return Err(Failure::message(Exit::Usage, format!("--dpi {}: give 20 to 1200", arguments.dpi)));
    }
    let run = &arguments.run;
    let legend: Legend = read_json(&run.join("map/legend.json"))?;
    let lines: Vec<ReferenceLine> = read_json(&run.join("map/lines.json"))?;
    let report: Value = read_json(&run.join("report.json"))?;
    let layer = layer_of(&arguments, &legend)?;
    let mut raster = RasterFile::open(&raster_path(run, layer.layer)).map_err(raster_failure)?;
    let traces = read_traces(&arguments.traces)?;
    let strips = strips(run, &legend)?;
    let title = title(&arguments, &report);
    let content =
        SheetContent { legend: &legend, layer, lines: &lines, traces: &traces, strips: &strips, title: &title };
    let settings = SheetSettings {
        scale: arguments.scale,
        paper_mm: arguments.paper.map(|p| match p {
            Paper::A4 => [297.0, 210.0],
            Paper::A3 => [420.0, 297.0],
            Paper::A2 => [594.0, 420.0],
            Paper::A1 => [841.0, 594.0],
            Paper::A0 => [1189.0, 841.0],
        }),
        layout: match arguments.layout {
            LayoutName::ChainageX => Layout::ChainageX,
            LayoutName::ChainageY => Layout::ChainageY,
        },
        view: match arguments.view {
            ViewName::Inside => View::Inside,
            ViewName::Outside => View::Outside,
        },
        dpi: arguments.dpi,
    };
    let pages =
        sheet(&content, &settings, &mut |low, high, columns, rows| raster.picture(layer, low, high, columns, rows))
            .map_err(|error| match error {
                SheetError::Raster(error) => raster_failure(error),
                other => Failure::message(Exit::Usage, other.to_string()),
            })?;
    let written = write(&pages, format, &arguments, &title[0].1)?;
    if !console.is_quiet() {
        let (w, h) = (pages[0].width_mm, pages[0].height_mm);
        let names: Vec<String> = written.iter().map(|p| p.display().to_string()).collect();
        console.print(&format!(
            "{} pages of {w} x {h} mm at 1:{}\nwrote {}",
            pages.len(),
            arguments.scale,
            names.join(", ")
        ));
    }
    Ok(Exit::Done)
}

fn format_of(arguments: &Arguments) -> std::result::Result<Format, Failure> {
    let extension = arguments.out.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    arguments.format.or(Format::from_str(&extension, true).ok()).ok_or_else(|| {
        let message = format!("{}: name a .pdf, .svg or .png file, or give --format", arguments.out.display());
        Failure::message(Exit::Usage, message)
    })
}

fn layer_of<'a>(arguments: &Arguments, legend: &'a Legend) -> std::result::Result<&'a LegendLayer, Failure> {
    let shown: Vec<&LegendLayer> = legend.layers.iter().filter(|l| l.look != crate::map::Look::None).collect();
    let named = |name: &str| shown.iter().copied().find(|l| l.layer.name() == name);
    let found = match &arguments.layer {
        Some(name) => named(name),
        None => ["color", "intensity", "relief", "offset"].into_iter().find_map(named).or(shown.first().copied()),
    };
    found.ok_or_else(|| {
        let names: Vec<&str> = shown.iter().map(|l| l.layer.name()).collect();
        let wanted = arguments.layer.as_deref().unwrap_or("any");
        Failure::message(Exit::Usage, format!("the map has no layer '{wanted}' to print; it has {}", names.join(", ")))
    })
}

fn raster_path(run: &Path, layer: Layer) -> PathBuf {
    run.join("map").join(format!("{}.tif", layer.name()))
}

fn raster_failure(error: raster_file::Error) -> Failure {
    Failure::new(Exit::BadInput, error)
}

fn read_json<T: DeserializeOwned>(path: &Path) -> std::result::Result<T, Failure> {
    let text = fs::read_to_string(path).map_err(|e| {
        let message = format!("{}: {e}; a sheet needs the folder of a finished run", path.display());
        Failure::message(Exit::BadInput, message)
    })?;
    serde_json::from_str(&text).map_err(|e| Failure::message(Exit::BadInput, format!("{}: {e}", path.display())))
}

/// Azimuth and gradient from the axis, coverage and distortion from the rasters.
fn strips(run: &Path, legend: &Legend) -> std::result::Result<Vec<Strip>, Failure> {
    let path = run.join("axis.csv");
    let text =
        fs::read_to_string(&path).map_err(|e| Failure::message(Exit::BadInput, format!("{}: {e}", path.display())))?;
    let rows: Vec<Vec<f64>> =
        text.lines().skip(1).map(|l| l.split(',').map(|v| v.trim().parse().unwrap_or(f64::NAN)).collect()).collect();
    let column = |k: usize| rows.iter().filter(|r| r.len() > k).map(|r| [r[0], r[k]]).collect::<Vec<_>>();
    let mut strips = Vec::new();
    let mut add = |name: &str, unit: &str, values: Vec<[f64; 2]>, range: [f64; 2], color: [u8; 3]| {
        strips.push(Strip { name: name.into(), unit: unit.into(), values, range, color });
    };
    let range = |values: &[[f64; 2]], least: f64| nice_range(values.iter().map(|v| v[1]), least);
    let azimuth = continuous(column(4));
    let spread = range(&azimuth, 4.0);
    add("azimuth", "\u{b0}", azimuth, spread, [20, 80, 160]);
    let gradient = column(5);
    let spread = range(&gradient, 2.0);
    add("gradient", "%", gradient, spread, [120, 72, 30]);
    if let Some(values) = along(run, legend, Layer::Coverage, |column| {
        let class = |v: &f64| *v as u8;
        let first = column.iter().position(|v| class(v) != COVERAGE_NONE)?;
        let last = column.iter().rposition(|v| class(v) != COVERAGE_NONE)?;
        let observed = column[first..=last].iter().filter(|v| class(v) == COVERAGE_OBSERVED).count();
        Some(100.0 * observed as f64 / (last - first + 1) as f64)
    })? {
        add("coverage", "%", values, [0.0, 100.0], [46, 125, 80]);
    }
    if let Some(values) = along(run, legend, Layer::Distortion, |column| {
        let mut stretch: Vec<f64> =
            column.chunks_exact(4).filter(|s| s[1] > 0.0).map(|s| 100.0 * (s[0].max(1.0 / s[1]) - 1.0)).collect();
        crate::numeric::statistics::quantile(&mut stretch, 0.95)
    })? {
        let [_, high] = range(&values, 2.0);
        add("stretch 95 %", "%", values, [0.0, high], [170, 40, 60]);
    }
    Ok(strips)
}

/// Azimuths without jumps at north.
fn continuous(mut values: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    for i in 1..values.len() {
        let turns = ((values[i - 1][1] - values[i][1]) / 360.0).round();
        values[i][1] += 360.0 * turns;
    }
    values
}

/// A number for each step along the tunnel from the samples of a layer there, from top to bottom. `None`: no such layer.
fn along(
    run: &Path,
    legend: &Legend,
    layer: Layer,
    value: impl Fn(&[f64]) -> Option<f64>,
) -> std::result::Result<Option<Vec<[f64; 2]>>, Failure> {
    let Some(entry) = legend.layer(layer) else { return Ok(None) };
    let mut file = RasterFile::open(&raster_path(run, layer)).map_err(raster_failure)?;
    let level = file.level_within(STRIP_PIXELS);
    let (width, height) = file.size(level);
    let samples = file.read(level, [0, width], [0, height]).map_err(raster_failure)?;
    let (cell, bands) = (file.cell_m(level), entry.bands.len());
    let step = ((STRIP_STEP_M / cell).round() as usize).max(1);
    let mut values = Vec::new();
    for first in (0..width).step_by(step) {
        let last = (first + step).min(width);
        let middle = (first + last) / 2;
        // One column stands for its step where classes are counted from edge to edge.
        let mut column = Vec::with_capacity(height * bands);
        for y in 0..height {
            column.extend((0..bands).map(|b| samples.get((y * width + middle.min(width - 1)) * bands + b)));
        }
        let u = legend.u_min_m + (middle as f64 + 0.5) * cell;
        values.push([u, value(&column).unwrap_or(f64::NAN)]);
    }
    Ok(Some(values))
}

/// Captions and values of the title block; the first is the project.
fn title(arguments: &Arguments, report: &Value) -> Vec<(String, String)> {
    let at = |pointer: &str| report.pointer(pointer);
    let number = |pointer: &str| at(pointer).and_then(Value::as_f64);
    let missing = || "not stated".to_owned();
    let inputs: Vec<&Value> = at("/input").and_then(Value::as_array).into_iter().flatten().collect();
    let text = |value: &Value, key: &str| value.get(key).and_then(Value::as_str).unwrap_or_default().to_owned();
    let names: Vec<String> = inputs
        .iter()
        .map(|i| Path::new(&text(i, "path")).file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default())
        .collect();
    let scans = match names.as_slice() {
        [] => missing(),
        [one] => one.clone(),
        [first, rest @ ..] => format!("{first} and {} more", rest.len()),
    };
    let hash = inputs.first().map_or_else(missing, |i| text(i, "sha256").chars().take(16).collect());
    let date = ["points.laz", "points.las"].iter().find_map(|n| io::las_creation_date(&arguments.run.join(n)));
    let percent = |pointer: &str| number(pointer).map(|s| format!("{:.1} %", 100.0 * (s - 1.0)));
    let stretch = ["mean", "p95", "max"].map(|k| percent(&format!("/unwrap/stretch/{k}")));
    let distortion = match stretch {
        [Some(mean), Some(p95), Some(max)] => format!("mean {mean}, 95 % {p95}, max {max}"),
        _ => missing(),
    };
    let status = at("/status").and_then(Value::as_str).unwrap_or("unknown");
    let method = at("/unwrap/method").and_then(Value::as_str).unwrap_or("unknown");
    let version = at("/adit_version").and_then(Value::as_str).unwrap_or("unknown");
    let cell = number("/map/cell_m").map_or_else(missing, |c| format!("{} mm", (c * 1e6).round() / 1e3));
    let coverage = number("/map/coverage_percent").map_or_else(missing, |c| format!("{c:.1} %"));
    [
        ("project", arguments.project.clone().unwrap_or_else(|| scans.clone())),
        ("scan", scans.clone()),
        ("date of the scan file", date.unwrap_or_else(missing)),
        ("sha256 of the scan", hash),
        ("unwrapped by", format!("Adit {version}, {method}")),
        ("stretch", distortion),
        ("pixel", cell),
        ("coverage", coverage),
        ("quality limits", status.to_owned()),
    ]
    .map(|(caption, value)| (caption.to_owned(), value))
    .to_vec()
}

/// Lines with ids from GeoJSON files in map coordinates.
fn read_traces(paths: &[PathBuf]) -> std::result::Result<Vec<Trace>, Failure> {
    let mut traces = Vec::new();
    for path in paths {
        let document: Value = read_json(path)?;
        let bad = |what: &str| Failure::message(Exit::BadInput, format!("{}: {what}", path.display()));
        let features = document
            .get("features")
            .and_then(Value::as_array)
            .ok_or_else(|| bad("this is no GeoJSON feature collection"))?;
        for (k, feature) in features.iter().enumerate() {
            let property = |name: &str| match feature.pointer(&format!("/properties/{name}")) {
                Some(Value::String(text)) => Some(text.clone()),
                Some(Value::Number(number)) => Some(number.to_string()),
                _ => None,
            };
            let id =
                ["id", "name", "fid", "label"].into_iter().find_map(property).unwrap_or_else(|| (k + 1).to_string());
            let coordinates = feature.pointer("/geometry/coordinates").cloned().unwrap_or_default();
            let parts: Vec<Value> = match feature.pointer("/geometry/type").and_then(Value::as_str) {
                Some("LineString") => vec![coordinates],
                Some("MultiLineString") => coordinates.as_array().cloned().unwrap_or_default(),
                other => {
                    let kind = other.unwrap_or("nothing");
                    return Err(bad(&format!("feature {} is a {kind}; only lines are printed", k + 1)));
                }
            };
            for part in parts {
                let place = |p: &Value| Some([p.get(0)?.as_f64()?, p.get(1)?.as_f64()?]);
                let points: Option<Vec<[f64; 2]>> =
                    part.as_array().map(|a| a.iter().map(place).collect()).unwrap_or(None);
                let points = points.ok_or_else(|| bad(&format!("the coordinates of feature {} do not read", k + 1)))?;
                traces.push(Trace { id: id.clone(), points });
            }
        }
    }
    Ok(traces)
}

/// Writes one PDF, or one file a page; gives the names.
fn write(
    pages: &[Page],
    format: Format,
    arguments: &Arguments,
    title: &str,
) -> std::result::Result<Vec<PathBuf>, Failure> {
    let out = &arguments.out;
    let encode = |e: image::ImageError| Failure::message(Exit::Internal, e.to_string());
    if format == Format::Pdf {
        publish(out, &drawing::pdf(pages, title).map_err(encode)?)?;
        return Ok(vec![out.clone()]);
    }
    let mut names = Vec::new();
    for (k, page) in pages.iter().enumerate() {
        let name = if pages.len() == 1 {
            out.clone()
        } else {
            let stem = out.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
            let extension = out.extension().map(|e| format!(".{}", e.to_string_lossy())).unwrap_or_default();
            out.with_file_name(format!("{stem}-{}{extension}", k + 1))
        };
        if format == Format::Svg {
            publish(&name, drawing::svg(page, title).map_err(encode)?.as_bytes())?;
        } else {
            let picture = drawing::png_picture(page, arguments.dpi).ok_or_else(|| {
                let message = format!(
                    "a page of {} x {} mm at {} dpi is too large a picture",
                    page.width_mm, page.height_mm, arguments.dpi
                );
                Failure::message(Exit::Usage, message)
            })?;
            let resolution = 0.0254 / arguments.dpi;
            io::write_picture(&name, &picture, Some(resolution)).map_err(|e| Failure::new(Exit::Resources, e))?;
        }
        names.push(name);
    }
    Ok(names)
}

/// Writes a file under a temporary name first.
fn publish(path: &Path, bytes: &[u8]) -> std::result::Result<(), Failure> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    let failed =
        |e: std::io::Error| Failure::message(Exit::Resources, format!("{} cannot be written: {e}", path.display()));
    fs::write(&partial, bytes).map_err(failed)?;
    fs::rename(&partial, path).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn azimuths_go_on_over_north() {
        let values = continuous(vec![[0.0, 358.0], [1.0, 1.0], [2.0, 359.5]]);
        assert_eq!(values.iter().map(|v| v[1]).collect::<Vec<_>>(), [358.0, 361.0, 359.5]);
    }

    #[test]
    fn traces_keep_their_ids() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("t.geojson");
        let text = r#"{"type":"FeatureCollection","features":[
            {"type":"Feature","properties":{"id":7},"geometry":{"type":"LineString","coordinates":[[1,2],[3,4.5]]}},
            {"type":"Feature","properties":{},"geometry":{"type":"MultiLineString","coordinates":[[[1,2],[3,4]],[[5,6],[7,8]]]}}]}"#;
        fs::write(&path, text).unwrap();
        let traces = read_traces(std::slice::from_ref(&path)).unwrap();
        assert_eq!(traces.iter().map(|t| t.id.as_str()).collect::<Vec<_>>(), ["7", "2", "2"]);
        assert_eq!(traces[0].points, [[1.0, 2.0], [3.0, 4.5]]);
        fs::write(&path, r#"{"features":[{"geometry":{"type":"Point","coordinates":[1,2]}}]}"#).unwrap();
        assert!(read_traces(&[path]).is_err());
    }
}
