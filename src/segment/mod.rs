//! Which points are wall: the mean section along the axis, and what does not belong to it.

pub mod sampling;
pub mod section_field;

pub use sampling::Sampling;
pub use section_field::SectionField;

use crate::axis::{Axis, AxisCoordinates};
use crate::numeric::Vec3;
use crate::warning::Warning;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What a point belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum Class {
    /// Rock or lining, crown included.
    Wall = 0,
    /// The ground one walks or drives on.
    Floor = 1,
    /// Ducts, pipes, cables, rails, lights, vehicles, people.
    Furniture = 2,
    /// Beyond the portals or far behind the surface.
    Outside = 3,
    /// Outliers and mixed pixels.
    Noise = 4,
}

impl Class {
    /// All classes, in the order of their codes.
    pub const ALL: [Class; 5] = [Class::Wall, Class::Floor, Class::Furniture, Class::Outside, Class::Noise];

    /// Whether the tunnel's surface is made from points of this class.
    pub fn is_surface(self) -> bool {
        matches!(self, Class::Wall | Class::Floor)
    }
}

/// How points are told apart.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Points farther than this from the mean section are outside, metres; by default 0.4 of the local mean radius,
    /// at least 0.15 m.
    pub max_offset_m: Option<f64>,
}

/// The class of each geometry point, the mean section and the points' coordinates around the axis.
#[derive(Clone, Debug)]
pub struct Segmentation {
    /// One class for each point.
    pub class: Vec<Class>,
    /// Axis coordinates of each point.
    pub coordinates: Vec<AxisCoordinates>,
    /// The mean section along the axis.
    pub section: SectionField,
    /// How densely the surface was sampled.
    pub sampling: Sampling,
}

/// What was found, for the report.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Points of each class, in the order wall, floor, furniture, outside, noise.
    pub points_by_class: Vec<(Class, usize)>,
    /// First chainage with a tunnel around the axis, metres.
    pub start_chainage_m: f64,
    /// Last chainage with a tunnel around the axis, metres.
    pub end_chainage_m: f64,
    /// Mean perimeter of the section, metres.
    pub mean_perimeter_m: f64,
    /// Share of the mean section bridged over gaps, percent.
    pub bridged_percent: f64,
    /// How densely the surface was sampled.
    pub sampling: Sampling,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Why the points could not be told apart.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// No mean section around the axis.
    #[error(transparent)]
    Section(#[from] section_field::Error),
    /// Too few points to tell anything.
    #[error("{found} points are too few to find the tunnel's surface (100 are needed)")]
    TooFewPoints {
        /// Points given.
        found: usize,
    },
}

/// Finds the mean section and the class of each point.
///
/// # Errors
/// [`Error`] when the points do not surround the axis anywhere.
pub fn classify_positions(
    positions: &[Vec3],
    axis: &Axis,
    settings: &Settings,
) -> Result<(Segmentation, Summary), Error> {
    let coordinates: Vec<AxisCoordinates> = positions.par_iter().map(|p| axis.project(p)).collect();
    // The spacing along the tunnel decides the row length of the field, and needs the girth from a field to measure.
    let first = SectionField::estimate(&coordinates, 0.0)?;
    let unrolled: Vec<[f64; 2]> =
        coordinates.par_iter().map(|c| [c.chainage, first.girth(c.chainage, c.angle())]).collect();
    let sampling = Sampling::measure(&unrolled).ok_or(Error::TooFewPoints { found: positions.len() })?;
    drop(unrolled);
    let section = if sampling.is_profiles() && sampling.along_m > first.step() {
        SectionField::estimate(&coordinates, sampling.along_m)?
    } else {
        first
    };
    let class: Vec<Class> = coordinates
        .par_iter()
        .map(|c| {
            let radius = section.radius(c.chainage, c.angle());
            let limit = settings.max_offset_m.unwrap_or((0.4 * radius).max(0.15));
            let beyond = c.chainage < section.start() || c.chainage > section.end();
            if beyond || (c.radius() - radius).abs() > limit { Class::Outside } else { Class::Wall }
        })
        .collect();
    let summary = Summary {
        points_by_class: Class::ALL.map(|k| (k, class.iter().filter(|&&c| c == k).count())).to_vec(),
        start_chainage_m: section.start(),
        end_chainage_m: section.end(),
        mean_perimeter_m: section.mean_perimeter(),
        bridged_percent: 100.0 * section.bridged_share(),
        sampling,
        warnings: Vec::new(),
    };
    Ok((Segmentation { class, coordinates, section, sampling }, summary))
}
