//! `adit trace`: strokes painted on the map become polylines, on the map and in 3D.

use super::run_surface::{RunSurface, io_failure, tell};
use super::{Console, Exit, Failure, Result};
use crate::io::vector::{self, Shapes, Space};
use crate::lift::{StrokeSettings, strokes};
use crate::linework;
use crate::unwrap::ChartIndex;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  adit trace runs/drift --labels edited.png --out traces.gpkg

Paint as for 'adit lift'. Thin strokes become lines along their middle, broad patches become areas; the attributes
'label' and 'name' tell their class.";

/// Arguments of `adit trace`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The run folder that the map came from.
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
    /// The edited picture (PNG, JPEG or TIFF).
    #[arg(long, value_name = "EDITED")]
    labels: PathBuf,
    /// Where the lines go (.gpkg, .geojson, .dxf, .shp).
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Strokes are at most this wide, metres; what is broader is an area.
    #[arg(long, value_name = "M", default_value_t = StrokeSettings::default().max_width_m)]
    max_width: f64,
}

/// Traces the strokes.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let (map, told, classes) = super::lift::label_map_of(arguments.run.clone(), arguments.labels)?;
    let surface = RunSurface::open(&arguments.run)?;
    let settings = StrokeSettings { max_width_m: arguments.max_width, ..StrokeSettings::default() };
    let (drawn, found) = strokes(&map, &classes, &settings);
    let draped =
        linework::drape(&ChartIndex::of(&surface.chart), &drawn).map_err(|e| Failure::new(Exit::BadInput, e))?;
    tell(console, &draped.summary.warnings);
    if draped.features.is_empty() {
        return Err(Failure::message(Exit::BadInput, "nothing was painted that is on the map"));
    }
    let on_map: Vec<_> = draped.sources.iter().map(|&i| drawn[i].clone()).collect();
    let in_scan = surface.scan_from_local(&draped.features);
    let shapes = [Shapes { space: Space::Scan, features: &in_scan }, Shapes { space: Space::Map, features: &on_map }];
    tell(console, &vector::write(&arguments.out, &shapes).map_err(io_failure)?);
    console.say(&format!(
        "{told}{} strokes ({} gaps closed) and {} areas; {} specks and {} twigs left out\nwrote {}",
        found.strokes,
        found.gaps,
        found.areas,
        found.specks,
        found.twigs,
        arguments.out.display()
    ));
    Ok(Exit::Done)
}
