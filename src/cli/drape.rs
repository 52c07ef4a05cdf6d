//! `adit drape`: linework drawn on the map becomes 3D linework on the wall.

use super::run_surface::{RunSurface, io_failure, tell};
use super::{Console, Exit, Failure, Result};
use crate::io::vector::{self, Shapes, Space};
use crate::linework;
use crate::unwrap::ChartIndex;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  adit drape runs/drift --in traces.gpkg --out traces_3d.gpkg     both spaces in one file, with the same ids
  adit drape runs/drift --in traces.geojson --out traces.dxf      3D polylines for CAD

Coordinates of the input: chainage, girth and, if there is a third one, the distance from the surface, metres. Of a
GeoPackage the layers that end on _map are taken, or all if none does. A vertex is added at each edge of the surface.";

/// Arguments of `adit drape`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The run folder that the map came from.
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
    /// Linework on the map (.gpkg, .geojson, .dxf, .shp).
    #[arg(long = "in", value_name = "FILE")]
    input: PathBuf,
    /// Where it goes: .gpkg gets both spaces, .geojson, .dxf and .shp scan coordinates.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// Drapes the linework.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let drawn = vector::read(&arguments.input, Space::Map).map_err(io_failure)?;
    let surface = RunSurface::open(&arguments.run)?;
    let draped = linework::drape(&ChartIndex::of(&surface.chart), &drawn.features)
        .map_err(|e| Failure::new(Exit::BadInput, e))?;
    tell(console, &[drawn.warnings, draped.summary.warnings.clone()].concat());
    if draped.features.is_empty() {
        let message = format!(
            "nothing of {} lies on the map: are its coordinates chainage and girth?",
            arguments.input.display()
        );
        return Err(Failure::message(Exit::BadInput, message));
    }
    let on_map: Vec<_> = draped.sources.iter().map(|&i| drawn.features[i].clone()).collect();
    let in_scan = surface.scan_from_local(&draped.features);
    let shapes = [Shapes { space: Space::Scan, features: &in_scan }, Shapes { space: Space::Map, features: &on_map }];
    tell(console, &vector::write(&arguments.out, &shapes).map_err(io_failure)?);
    let s = &draped.summary;
    console.say(&format!(
        "{} of {} features draped with {} vertices, {} split, {:.3} m without surface\nwrote {}",
        s.draped,
        s.features,
        s.vertices,
        s.split,
        s.missing_m,
        arguments.out.display()
    ));
    Ok(Exit::Done)
}
