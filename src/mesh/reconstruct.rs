//! The verb of the mesh stage: from classified points to one oriented manifold.

use super::{Mesh, section};
use crate::axis::Axis;
use crate::segment::Segmentation;
use crate::warning::Warning;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the surface is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Distance between neighbouring vertices in metres; by default about one vertex for 1.5 points, but not finer than
    /// 1/600 of the tunnel's perimeter.
    pub spacing_m: Option<f64>,
    /// Surface farther than this from the nearest point is not observed, metres (profile scans: this is the limit
    /// around the section; along the axis the distance between profiles is bridged).
    pub max_gap_m: f64,
    /// Holes narrower than this are filled and marked as filled, metres; 0 fills none.
    pub fill_hole_m: f64,
    /// The wall behind ducts, cables and other furniture is filled and marked where its shadow is narrower than this,
    /// metres; 0 leaves holes.
    pub fill_behind_furniture_m: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { spacing_m: None, max_gap_m: 0.05, fill_hole_m: 0.3, fill_behind_furniture_m: 1.5 }
    }
}

/// What was built, for the report.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The method that was used.
    pub method: &'static str,
    /// Why it was chosen.
    pub reason: String,
    /// Vertices of the mesh.
    pub vertices: usize,
    /// Faces of the mesh.
    pub faces: usize,
    /// Area in square metres.
    pub area_m2: f64,
    /// Share of the area that no point supports (filled holes), percent.
    pub filled_percent: f64,
    /// Boundary loops: two portals and the holes that stayed.
    pub boundary_loops: usize,
    /// Numbers of the section method.
    pub section: section::Summary,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Why there is no mesh.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// A setting is out of range.
    #[error("mesh.{key} = {value}: {must}")]
    Setting {
        /// Name of the key.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        must: &'static str,
    },
    /// No part of the surface has enough points.
    #[error("{points} points on the tunnel's surface make no connected surface; try a larger mesh.spacing_m")]
    NoSurface {
        /// Points of the surface.
        points: usize,
    },
}

/// Builds the surface of the tunnel from its wall and floor points.
///
/// # Errors
/// [`Error::Setting`] for impossible settings, [`Error::NoSurface`] when nothing hangs together.
pub fn reconstruct(segmentation: &Segmentation, axis: &Axis, settings: &Settings) -> Result<(Mesh, Summary), Error> {
    check(settings)?;
    let options = section::Options {
        spacing_m: settings.spacing_m,
        max_gap_m: settings.max_gap_m,
        fill_hole_m: settings.fill_hole_m,
        fill_behind_furniture_m: settings.fill_behind_furniture_m,
    };
    let points = segmentation.class.iter().filter(|c| c.is_surface()).count();
    let (mesh, section) = section::reconstruct(segmentation, axis, &options).ok_or(Error::NoSurface { points })?;
    let mut warnings = Vec::new();
    if section.multiple_depth_percent > 5.0 {
        warnings.push(Warning::new(
            "multiple-depths",
            format!(
                "{:.1} % of the cells hold points at several distances from the axis; the section method keeps one",
                section.multiple_depth_percent
            ),
        ));
    }
    let area_m2 = mesh.area();
    let filled: f64 = (0..mesh.faces().len())
        .filter(|&f| !mesh.observed()[f])
        .map(|f| mesh.double_area_vector(f as u32).norm() / 2.0)
        .sum();
    let twin = super::topology::twins(mesh.faces()).expect("a Mesh is manifold");
    let summary = Summary {
        method: "section",
        reason: format!(
            "{:.2} % of the rays from the axis meet the surface more than once",
            section.multiple_depth_percent
        ),
        vertices: mesh.vertices().len(),
        faces: mesh.faces().len(),
        area_m2,
        filled_percent: 100.0 * filled / area_m2,
        boundary_loops: super::topology::boundary_loops(mesh.faces(), &twin).len(),
        section,
        warnings,
    };
    Ok((mesh, summary))
}

fn check(settings: &Settings) -> Result<(), Error> {
    let positive = |v: f64| v.is_finite() && v > 0.0;
    match settings.spacing_m {
        Some(value) if !positive(value) => {
            return Err(Error::Setting { key: "spacing_m", value, must: "must be a positive number of metres" });
        }
        _ => {}
    }
    if !positive(settings.max_gap_m) {
        let value = settings.max_gap_m;
        return Err(Error::Setting { key: "max_gap_m", value, must: "must be a positive number of metres" });
    }
    for (key, value) in
        [("fill_hole_m", settings.fill_hole_m), ("fill_behind_furniture_m", settings.fill_behind_furniture_m)]
    {
        if !(value.is_finite() && value >= 0.0) {
            return Err(Error::Setting { key, value, must: "must be 0 or a positive number of metres" });
        }
    }
    Ok(())
}
