//! The axis of a run: traced or read, written as `axis.csv`, and pictured where it is refused.

use super::error::Error;
use super::line::done;
use super::plan_view::plan_view;
use super::products::cannot_write;
use super::settings::Pipeline;
use crate::axis::Error::{ClosedLoop, EndNotReached, NotATunnel};
use crate::axis::{self, Axis};
use crate::cloud::ScanFrame;
use crate::numeric::Vec3;
use crate::{io, map};
use serde_json::json;
use std::path::Path;

/// Distance between the lines of `axis.csv`, metres.
const AXIS_CSV_STEP_M: f64 = 0.5;

/// A picture of what was seen when the axis is refused, in the run folder.
const REFUSED_PICTURE: &str = "refused_plan.png";

/// Traces the axis, or reads the alignment that the settings name.
pub(super) fn find_axis(
    pipeline: &Pipeline,
    points: &[Vec3],
    frame: &ScanFrame,
    out: &Path,
) -> Result<(Axis, serde_json::Value), Error> {
    let settings = pipeline.axis.in_local(frame);
    let picture = out.join(REFUSED_PICTURE);
    // What an earlier, refused run left must not be taken for this one's.
    match std::fs::remove_file(&picture) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            return Err(cannot_write("axis", &picture)(error));
        }
        _ => {}
    }
    match &settings.alignment {
        Some(path) => done("axis", axis::import_csv(&read_alignment("axis", path)?, frame, &settings)),
        None => {
            let traced = axis::trace(points, &settings);
            let no_tunnel = matches!(traced, Err(NotATunnel { .. } | ClosedLoop { .. } | EndNotReached { .. }));
            let result = done("axis", traced);
            match (result, no_tunnel.then(|| plan_view(points)).flatten()) {
                (Err(error), Some(seen)) => {
                    io::write_picture(&picture, &seen, None)
                        .map_err(|error| Error::in_stage("axis")(map::Error::Sink(Box::new(error))))?;
                    Err(Error::Pictured { error: Box::new(error), picture })
                }
                (result, _) => result,
            }
        }
    }
}

fn read_alignment(stage: &'static str, path: &Path) -> Result<String, Error> {
    std::fs::read_to_string(path)
        .map_err(|source| Error::in_stage(stage)(io::Error::Read { path: path.to_owned(), source }))
}

/// The part of the scan that `ingest.chainage_m` asks for; the axis must be known before the scan is.
pub(super) fn part_of(pipeline: &Pipeline) -> Result<Option<io::Part>, Error> {
    let Some(chainage_m) = pipeline.ingest.chainage_m else { return Ok(None) };
    let in_ingest = Error::in_stage("ingest");
    let Some(path) = &pipeline.axis.alignment else {
        return Err(in_ingest(io::Error::Settings {
            key: "ingest.chainage_m",
            cause: "chainages are those of an axis that is known before the scan is read".into(),
            remedy: "set axis.alignment too; the axis.csv of an earlier run will do".into(),
        }));
    };
    let frame = ScanFrame {
        metres_per_unit: pipeline.ingest.unit.map_or(1.0, io::Unit::metres),
        ..ScanFrame::with_origin(Vec3::zeros())
    };
    let text = read_alignment("ingest", path)?;
    let (axis, _) =
        axis::import_csv(&text, &frame, &pipeline.axis.in_local(&frame)).map_err(Error::in_stage("ingest"))?;
    io::Part::along(axis, frame, chainage_m).map(Some).map_err(Error::in_stage("ingest"))
}

/// Adds to each side opening the `axis_ends` that make it a run of its own: its `ends_in_local` in scan coordinates.
pub(super) fn tell_ends(summary: &mut serde_json::Value, frame: &ScanFrame) {
    for opening in summary["openings"].as_array_mut().into_iter().flatten() {
        let local: Option<[[f64; 3]; 2]> = serde_json::from_value(opening["ends_in_local"].clone()).ok();
        if let Some(ends) = local {
            let millimetres = |p: [f64; 3]| p.map(|c| (c * 1000.0).round() / 1000.0);
            opening["axis_ends"] = json!(ends.map(|p| millimetres(frame.scan_from_local(&p.into()).into())));
        }
    }
}

/// The axis as `axis.csv`, scan coordinates.
pub fn axis_csv(axis: &Axis, frame: &ScanFrame) -> String {
    let mut text = String::from("chainage_m,x,y,z,azimuth_deg,gradient_percent\n");
    let steps = (axis.length() / AXIS_CSV_STEP_M).floor() as usize;
    let mut chainages: Vec<f64> = (0..=steps).map(|i| axis.start_chainage() + i as f64 * AXIS_CSV_STEP_M).collect();
    if axis.end_chainage() - chainages[steps] > 1e-6 {
        chainages.push(axis.end_chainage());
    }
    for s in chainages {
        let p = frame.scan_from_local(&axis.frame_at(s).origin);
        let (azimuth, gradient) = (axis.azimuth_deg(s), axis.gradient_percent(s));
        text += &format!("{s:.4},{:.4},{:.4},{:.4},{azimuth:.4},{gradient:.4}\n", p.x, p.y, p.z);
    }
    text
}
