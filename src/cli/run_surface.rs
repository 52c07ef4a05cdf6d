//! The surface of a finished run, from the files that everybody can read: `chart.ply`, `axis.csv`, `pipeline.toml`.

use super::{Exit, Failure, Result};
use crate::cloud::ScanFrame;
use crate::cut::Strip;
use crate::io::{self, ErrorKind};
use crate::linework::Feature;
use crate::mesh::Mesh;
use crate::numeric::{Vec2, Vec3};
use crate::pipeline::Pipeline;
use crate::unwrap::Chart;
use crate::warning::Warning;
use std::path::{Path, PathBuf};

/// What linework needs of a run.
pub(super) struct RunSurface {
    pub(super) pipeline: Pipeline,
    pub(super) frame: ScanFrame,
    pub(super) chart: Chart,
}

impl RunSurface {
    pub(super) fn open(run: &Path) -> Result<Self> {
        let pipeline = Pipeline::load(&need(run, "pipeline.toml")?, &[]).map_err(|e| Failure::new(Exit::Usage, e))?;
        let (frame, chart) = read_chart(run)?;
        Ok(Self { pipeline, frame, chart })
    }

    /// The same surface in the local metres of another frame.
    pub(super) fn in_frame(self, frame: &ScanFrame) -> Result<Self> {
        if self.frame.origin_in_scan == frame.origin_in_scan && self.frame.metres_per_unit == frame.metres_per_unit {
            return Ok(self);
        }
        let mesh = self.chart.strip().mesh();
        let moved = |v: &Vec3| frame.local_from_scan(&self.frame.scan_from_local(v));
        let vertices = mesh.vertices().iter().map(moved).collect();
        let chart = chart_of(vertices, mesh.faces().to_vec(), mesh.observed().to_vec(), self.chart.uv().to_vec())?;
        Ok(Self { pipeline: self.pipeline, frame: frame.clone(), chart })
    }

    /// Features in scan coordinates, in local metres.
    pub(super) fn local_from_scan(&self, features: &[Feature]) -> Vec<Feature> {
        moved(features, |p| self.frame.local_from_scan(p))
    }

    /// Features in local metres, in scan coordinates.
    pub(super) fn scan_from_local(&self, features: &[Feature]) -> Vec<Feature> {
        moved(features, |p| self.frame.scan_from_local(p))
    }

    /// Directions of the axis along the tunnel, by chainage; from `axis.csv`.
    pub(super) fn axis_directions(run: &Path) -> Result<Vec<(f64, Vec3)>> {
        let path = need(run, "axis.csv")?;
        let text = std::fs::read_to_string(&path).map_err(|e| Failure::new(Exit::BadInput, e))?;
        let mut rows: Vec<(f64, Vec3)> = Vec::new();
        for (number, line) in text.lines().enumerate().skip(1) {
            let values: Vec<f64> = line.split(',').filter_map(|v| v.trim().parse().ok()).collect();
            let [chainage, x, y, z, ..] = values[..] else {
                let message = format!("{}, line {}: expected chainage and a place", path.display(), number + 1);
                return Err(Failure::message(Exit::BadInput, message));
            };
            rows.push((chainage, Vec3::new(x, y, z)));
        }
        let directions: Vec<(f64, Vec3)> = rows
            .windows(2)
            .filter_map(|w| Some(((w[0].0 + w[1].0) / 2.0, (w[1].1 - w[0].1).try_normalize(0.0)?)))
            .collect();
        if directions.is_empty() {
            return Err(Failure::message(Exit::BadInput, format!("{} holds no axis", path.display())));
        }
        Ok(directions)
    }
}

/// The chart of a run and the frame of its local metres, when nothing else of the run is needed.
pub(super) fn read_chart(run: &Path) -> Result<(ScanFrame, Chart)> {
    let (raw, _) = io::ply::read_chart(&need(run, "chart.ply")?).map_err(io_failure)?;
    let observed = raw.observed.unwrap_or_else(|| vec![true; raw.faces.len()]);
    let chart = chart_of(raw.vertices, raw.faces, observed, raw.uv.unwrap_or_default())?;
    Ok((raw.frame, chart))
}

fn chart_of(vertices: Vec<Vec3>, faces: Vec<[u32; 3]>, observed: Vec<bool>, uv: Vec<Vec2>) -> Result<Chart> {
    Mesh::new(vertices, faces, observed)
        .map_err(anyhow::Error::from)
        .and_then(|mesh| Ok(Strip::from_disk(mesh)?))
        .and_then(|strip| Ok(Chart::new(strip, uv)?))
        .map_err(|error| Failure::new(Exit::BadInput, error.context("chart.ply is not the chart of a run")))
}

fn moved(features: &[Feature], place: impl Fn(&Vec3) -> Vec3) -> Vec<Feature> {
    features
        .iter()
        .map(|f| f.with_parts(f.parts.iter().map(|part| part.iter().map(&place).collect()).collect()))
        .collect()
}

pub(super) fn need(run: &Path, name: &str) -> Result<PathBuf> {
    let path = run.join(name);
    if path.is_file() {
        return Ok(path);
    }
    let message = format!("{} is not the folder of a finished run: {name} is missing", run.display());
    Err(Failure::message(Exit::BadInput, message))
}

pub(super) fn io_failure(error: io::Error) -> Failure {
    let exit = match error.kind() {
        ErrorKind::BadInput => Exit::BadInput,
        ErrorKind::Unsupported => Exit::Unsupported,
        ErrorKind::Output => Exit::Resources,
        ErrorKind::Settings => Exit::Usage,
    };
    Failure::new(exit, error)
}

pub(super) fn cannot_write(path: &Path, error: std::io::Error) -> Failure {
    Failure::message(Exit::Resources, format!("{} cannot be written: {error}", path.display()))
}

/// Warnings go where people look; the first ones of a kind tell enough, the rest is counted.
pub(super) fn tell(console: &super::Console, warnings: &[Warning]) {
    const SHOWN: usize = 8;
    warnings.iter().take(SHOWN).for_each(|w| console.warn(&w.message));
    if warnings.len() > SHOWN {
        console.warn(&format!("and {} warnings more", warnings.len() - SHOWN));
    }
}
