//! `adit package`: everything that is needed to use the map without Adit, in one ZIP file.

use super::run_surface::read_chart;
use super::{Console, Exit, Failure, Result};
use crate::io::{MapFolder, PackageError, PackageFile};
use crate::map::qgis::{self, ProjectLayer};
use crate::map::{self, DrawInput, Layer, Legend};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  adit package runs/drift --out drift.zip
  adit package runs/drift --points --out drift_with_points.zip

The package holds the rasters and pictures, the way back to 3D (map/xyz.tif, map/surface_point.tif; drawn now if the run
has none), the surface, the axis, all vector files of the run, a QGIS project with relative paths, styles, the report,
a README and SHA256SUMS. The same run gives the same bytes.";

/// Arguments of `adit package`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The run folder.
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// The ZIP file.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Also pack the points of the scan.
    #[arg(long)]
    points: bool,
}

/// Vector files that are packed wherever they lie in the run.
const VECTORS: [&str; 9] = ["gpkg", "geojson", "dxf", "shp", "shx", "dbf", "prj", "cpg", "csv"];
/// Those of them that QGIS opens as layers.
const LAYERS: [&str; 4] = ["gpkg", "geojson", "dxf", "shp"];
const PROJECT: &str = "map.qgs";

/// Packs the run.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let run = &arguments.run;
    for name in ["report.json", "map/legend.json", "chart.ply"] {
        if !run.join(name).is_file() {
            let message = format!("{} is not the folder of a finished run: {name} is missing", run.display());
            return Err(Failure::message(Exit::BadInput, message));
        }
    }
    let mut legend: Legend = read_json(&run.join("map/legend.json"))?;
    let report: Value = read_json(&run.join("report.json"))?;
    let mut files = Vec::new();
    collect(run, run, &mut files)?;
    files.retain(|name| is_packed(name, arguments.points));
    files.sort();

    // The way back, if the run did not draw it.
    let missing: Vec<Layer> =
        [Layer::Xyz, Layer::SurfacePoint].into_iter().filter(|&l| legend.layer(l).is_none()).collect();
    let drawn = if missing.is_empty() { None } else { Some(draw_back_map(&arguments, &mut legend, &missing)?) };

    let vectors: Vec<ProjectLayer> = files
        .iter()
        .filter(|name| LAYERS.contains(&extension(name).as_str()))
        .map(|name| ProjectLayer { name: name.clone(), path: name.clone(), is_vector: true })
        .collect();
    let title = arguments.run.file_name().map_or("map".into(), |n| n.to_string_lossy().into_owned());
    let mut package = PackageFile::create(&arguments.out).map_err(failure)?;
    package.add_bytes("README.txt", readme(&legend, &report, arguments.points).as_bytes()).map_err(failure)?;
    package.add_bytes(PROJECT, qgis::project(&title, &legend, &vectors).as_bytes()).map_err(failure)?;
    for layer in &legend.layers {
        let name = format!("map/{}.qml", layer.layer.name());
        package.add_bytes(&name, qgis::style(layer).as_bytes()).map_err(failure)?;
    }
    let text = serde_json::to_string_pretty(&legend).map_err(|e| Failure::message(Exit::Internal, e.to_string()))?;
    package.add_bytes("map/legend.json", format!("{text}\n").as_bytes()).map_err(failure)?;
    for name in &files {
        package.add_file(name, &run.join(name)).map_err(failure)?;
    }
    if let Some(folder) = &drawn {
        for layer in &missing {
            for extension in ["tif", "tfw"] {
                let file = format!("{}.{extension}", layer.name());
                package.add_file(&format!("map/{file}"), &folder.join(&file)).map_err(failure)?;
            }
        }
        fs::remove_dir_all(folder).map_err(|e| cannot(folder, &e))?;
    }
    let count = package.finish().map_err(failure)?;
    if !console.is_quiet() {
        console.print(&format!("{count} files in {}", arguments.out.display()));
    }
    Ok(Exit::Done)
}

/// All files of the run but the private ones, with `/`, relative to it.
fn collect(root: &Path, folder: &Path, files: &mut Vec<String>) -> std::result::Result<(), Failure> {
    let entries = fs::read_dir(folder).map_err(|e| cannot(folder, &e))?;
    for entry in entries {
        let path = entry.map_err(|e| cannot(folder, &e))?.path();
        let hidden = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
        if hidden {
            continue;
        }
        if path.is_dir() {
            collect(root, &path, files)?;
        } else if let Ok(relative) = path.strip_prefix(root) {
            let parts: Vec<String> =
                relative.components().map(|c| c.as_os_str().to_string_lossy().into_owned()).collect();
            files.push(parts.join("/"));
        }
    }
    Ok(())
}

fn is_packed(name: &str, with_points: bool) -> bool {
    match name {
        // Written anew, with the back-map in it.
        "map/legend.json" => false,
        "chart.ply" | "axis.csv" | "report.json" | "report.html" | "pipeline.toml" => true,
        "points.laz" | "points.las" | "points.ply" => with_points,
        // The same surface as the chart, before it was cut.
        "mesh.ply" => false,
        _ => name.starts_with("map/") || VECTORS.contains(&extension(name).as_str()),
    }
}

fn extension(name: &str) -> String {
    Path::new(name).extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

/// Draws the layers that lead back to 3D on the grid of the map, into a folder beside the package.
fn draw_back_map(
    arguments: &Arguments,
    legend: &mut Legend,
    layers: &[Layer],
) -> std::result::Result<PathBuf, Failure> {
    let (frame, chart) = read_chart(&arguments.run)?;
    let mut folder = arguments.out.as_os_str().to_owned();
    folder.push(".back-map");
    let folder = PathBuf::from(folder);
    fs::create_dir_all(&folder).map_err(|e| cannot(&folder, &e))?;
    let input = DrawInput {
        chart: &chart,
        points: None,
        frame: &frame,
        section_offsets_m: None,
        design_offsets_m: None,
        quality: None,
    };
    let settings = map::Settings { cell_m: Some(legend.cell_m), layers: layers.to_vec(), ..Default::default() };
    let mut sink = MapFolder::new(&folder);
    map::draw(&input, &settings, &mut sink).map_err(|e| Failure::new(Exit::Resources, e))?;
    let back: Legend = read_json(&folder.join("legend.json"))?;
    if (back.u_min_m, back.v_max_m, back.width_px, back.height_px)
        != (legend.u_min_m, legend.v_max_m, legend.width_px, legend.height_px)
    {
        let message = "chart.ply does not belong to the map of this run; run again with --force map";
        return Err(Failure::message(Exit::BadInput, message));
    }
    legend.layers.extend(back.layers);
    Ok(folder)
}

fn readme(legend: &Legend, report: &Value, with_points: bool) -> String {
    let text = |pointer: &str| report.pointer(pointer).and_then(Value::as_str).unwrap_or("unknown").to_owned();
    let mut layers = String::new();
    for layer in &legend.layers {
        layers += &format!("  map/{}.tif  {}\n", layer.layer.name(), layer.meaning);
    }
    let points = if with_points { "  points.laz (or .ply)  every point with chainage, girth and offset\n" } else { "" };
    format!(
        "MAP OF A TUNNEL, UNWRAPPED\n\n\
         Made by Adit {} ({}). {}.\n\
         Open map.qgs in QGIS (3.x): all layers lie on one plane, x = chainage (m), y = girth from the crown (m).\n\
         One pixel is {} m. The first pixel's upper left corner is at x = {}, y = {}.\n\n\
         RASTERS (GeoTIFF, tiled, with overviews)\n{layers}\n\
         OTHER FILES\n\
         \x20 map/*.png + *.pgw   the same layers as pictures, with world files\n\
         \x20 map/*.qml           styles for QGIS\n\
         \x20 map/legend.json     what every layer and colour means\n\
         \x20 map/lines.json      crown, springlines, feet of the walls on the map\n\
         \x20 chart.ply           the surface: vertices x y z (scan coordinates) u v (map), and its faces\n\
         \x20 axis.csv            the axis: chainage, x, y, z, azimuth, gradient\n\
         {points}\
         \x20 report.json, report.html, pipeline.toml   how the map was made and how good it is\n\
         \x20 SHA256SUMS          hashes of all files: sha256sum --check SHA256SUMS\n\n\
         FROM A PIXEL BACK TO 3D\n\
         \x20 map/xyz.tif has three float bands. Scan coordinates = sample + offset of the band; the offsets are in the\n\
         \x20 GDAL metadata (OFFSET) and in map/legend.json (band_offsets). NaN: no surface.\n\
         \x20 map/surface_point.tif has the face of chart.ply and the weights b, c of its second and third corner:\n\
         \x20 point = (1 - b - c) A + b B + c C. -1: no surface.\n\
         \x20 In Python: x = tifffile.imread('map/xyz.tif')[row, column].astype('f8') + offsets\n",
        text("/adit_version"),
        text("/unwrap/method"),
        legend.view,
        legend.cell_m,
        legend.u_min_m,
        legend.v_max_m,
    )
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> std::result::Result<T, Failure> {
    let text = fs::read_to_string(path).map_err(|e| cannot(path, &e))?;
    serde_json::from_str(&text).map_err(|e| Failure::message(Exit::BadInput, format!("{}: {e}", path.display())))
}

fn cannot(path: &Path, error: &std::io::Error) -> Failure {
    Failure::message(Exit::Resources, format!("{}: {error}", path.display()))
}

fn failure(error: PackageError) -> Failure {
    Failure::new(Exit::Resources, error)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_belongs_to_the_map_is_packed() {
        let packed = |name: &str| is_packed(name, false);
        assert!(packed("map/color.tif") && packed("traces.gpkg") && packed("planes/planes.csv") && packed("chart.ply"));
        assert!(!packed("points.laz") && is_packed("points.laz", true) && !packed("mesh.ply") && !packed("notes.txt"));
    }
}
