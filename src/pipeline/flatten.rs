//! The surface cut open and made flat.

use super::error::Error;
use super::line::done;
use super::products::{Surface, write_ply};
use super::settings::Pipeline;
use crate::axis::Axis;
use crate::cloud::ScanFrame;
use crate::unwrap::{self, Chart};
use crate::warning::Warning;
use crate::{cut, io};
use serde_json::json;
use std::path::Path;

/// The surface cut open, without its floor if that is wished.
pub(super) fn open_surface(
    pipeline: &Pipeline,
    surface: &Surface,
    axis: &Axis,
) -> Result<(cut::Strip, serde_json::Value), Error> {
    let mesh = surface.mesh.clone();
    if pipeline.cut.floor == cut::FloorChoice::Keep {
        return done("cut", cut::open(mesh, axis, &pipeline.cut));
    }
    let Some(floor) = &surface.floor else {
        let message = "cut.floor = \"remove\", but no level floor was found: nothing is removed";
        let (strip, mut summary) = done("cut", cut::open(mesh, axis, &pipeline.cut))?;
        if let Some(warnings) = summary["warnings"].as_array_mut() {
            warnings.push(json!(Warning::new("no-floor", message)));
        }
        return Ok((strip, summary));
    };
    let (mesh, removed) = cut::without_floor(mesh, axis, &surface.section, floor).map_err(Error::in_stage("cut"))?;
    let (strip, mut summary) = done("cut", cut::open(mesh, axis, &pipeline.cut))?;
    summary["floor"] = json!(removed);
    Ok((strip, summary))
}

/// The surface made flat, with `chart.ply`.
pub(super) fn flatten(
    pipeline: &Pipeline,
    strip: cut::Strip,
    axis: &Axis,
    frame: &ScanFrame,
    staging: &Path,
) -> Result<(Chart, serde_json::Value), Error> {
    let handles = read_handles(pipeline, frame)?;
    let (chart, summary) = done("unwrap", unwrap::flatten_with_handles(strip, Some(axis), &handles, &pipeline.unwrap))?;
    write_ply("unwrap", &staging.join("chart.ply"), frame, chart.strip().mesh(), Some(chart.uv()), None)?;
    Ok((chart, summary))
}

/// The handles of the file that the settings of the unwrap method name; none when they name none.
fn read_handles(pipeline: &Pipeline, frame: &ScanFrame) -> Result<Vec<unwrap::Handle>, Error> {
    let Some(path) = pipeline.unwrap.method.handles_file() else { return Ok(Vec::new()) };
    let text = std::fs::read_to_string(path)
        .map_err(|source| Error::in_stage("unwrap")(io::Error::Read { path: path.clone(), source }))?;
    unwrap::handles::import_csv(&text, &path.display().to_string(), frame).map_err(Error::in_stage("unwrap"))
}
