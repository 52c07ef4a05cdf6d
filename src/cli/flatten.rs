//! `adit flatten`: 3D linework (bolts, sections, design faults, traces of other programs) comes onto the map.

use super::run_surface::{RunSurface, io_failure, tell};
use super::{Console, Exit, Failure, Result};
use crate::io::vector::{self, Shapes, Space};
use crate::linework::{self, FlattenSettings};
use crate::mesh::anchor::Anchoring;
use crate::unwrap::ChartIndex;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  adit flatten runs/drift --in bolts.dxf --out bolts.gpkg
  adit flatten runs/drift --in faults.shp --out faults.geojson

Coordinates of the input: those of the scan. On the map the third coordinate is the distance from the surface; what lies
deep in the rock or beyond a border keeps its way from the surface in the attribute 'off_surf', so that
'adit drape' brings it back exactly.";

/// Arguments of `adit flatten`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The run folder.
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
    /// Linework in scan coordinates (.gpkg, .geojson, .dxf, .shp).
    #[arg(long = "in", value_name = "FILE")]
    input: PathBuf,
    /// Where it goes: .gpkg gets both spaces, .geojson, .dxf and .shp map coordinates.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Vertices farther than this from the surface, metres, have no place on the map.
    #[arg(long, value_name = "M", default_value_t = FlattenSettings::default().reach_m)]
    reach: f64,
}

/// Flattens the linework.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let given = vector::read(&arguments.input, Space::Scan).map_err(io_failure)?;
    let surface = RunSurface::open(&arguments.run)?;
    let anchoring = Anchoring::of(surface.chart.strip().mesh());
    let settings =
        FlattenSettings { anchor: surface.pipeline.anchor.clone(), reach_m: arguments.reach, ..Default::default() };
    let local = surface.local_from_scan(&given.features);
    let flat = linework::flatten(&ChartIndex::of(&surface.chart), &anchoring, &local, &settings)
        .map_err(|e| Failure::new(Exit::BadInput, e))?;
    tell(console, &[given.warnings, flat.summary.warnings.clone()].concat());
    if flat.features.is_empty() {
        let message = format!(
            "nothing of {} is within {} m of the surface: are its coordinates those of the scan?",
            arguments.input.display(),
            arguments.reach
        );
        return Err(Failure::message(Exit::BadInput, message));
    }
    let in_scan: Vec<_> = flat.sources.iter().map(|&i| given.features[i].clone()).collect();
    let shapes =
        [Shapes { space: Space::Map, features: &flat.features }, Shapes { space: Space::Scan, features: &in_scan }];
    tell(console, &vector::write(&arguments.out, &shapes).map_err(io_failure)?);
    let s = &flat.summary;
    console.say(&format!(
        "{} of {} features flattened, {} vertices and {} added, {} off the surface, {} splits\nwrote {}",
        s.flattened,
        s.features,
        s.vertices,
        s.added,
        s.off_surface,
        s.splits,
        arguments.out.display()
    ));
    Ok(Exit::Done)
}
