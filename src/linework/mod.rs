//! Points, lines and areas with attributes, and their way between the map and the scan: [`drape`] and [`flatten`].
//!
//! Coordinates of a shape are three numbers in one of two spaces:
//! * *map*: chainage u, girth v and the distance from the surface, metres (positive into the void, 0 for what is drawn);
//! * *scan*: local metres of a [`crate::cloud::ScanFrame`].

mod certificate;
mod drape;
mod flatten;
mod route;

pub use certificate::{Certificate, LineTrip, PixelTrip, certify};
pub use drape::{Drape, DrapeSummary, drape};
pub use flatten::{Flatten, FlattenSettings, FlattenSummary, flatten};
pub use route::{Piece, Route, route};

use crate::numeric::Vec3;
use serde::{Deserialize, Serialize};

/// Name of the attribute (Shapefiles cut names at ten characters) that holds what a map cannot: for vertices that lie in no prism over the surface (deep bolts and
/// boreholes, beyond a border) a list of `[part, vertex, dx, dy, dz]`, the way in scan axes, metres, from the surface
/// under the vertex to the vertex itself.
pub const OFF_SURFACE: &str = "off_surf";

/// The value of an attribute.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Value {
    /// No value.
    Null,
    /// Yes or no.
    Boolean(bool),
    /// A whole number.
    Integer(i64),
    /// A number.
    Real(f64),
    /// Text.
    Text(String),
}

/// What a shape is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// Single points; each part has one vertex.
    Point,
    /// Polylines.
    Line,
    /// Rings, closed (the last vertex repeats the first); the first ring of the list is an outer one.
    Area,
}

/// A thing that was drawn: its shape in one space, its id, its attributes.
#[derive(Clone, Debug, PartialEq)]
pub struct Feature {
    /// Feature class: the layer it belongs to.
    pub class: String,
    /// Identity, the same in both spaces; `None` until a file gives it one.
    pub id: Option<i64>,
    /// Names and values, in the order of the file.
    pub attributes: Vec<(String, Value)>,
    /// What the parts are.
    pub kind: Kind,
    /// Vertices of each part.
    pub parts: Vec<Vec<Vec3>>,
}

impl Feature {
    /// The same feature with other vertices.
    pub fn with_parts(&self, parts: Vec<Vec<Vec3>>) -> Self {
        Self { parts, ..self.clone() }
    }

    /// The value of an attribute.
    pub fn attribute(&self, name: &str) -> Option<&Value> {
        self.attributes.iter().find(|(n, _)| n == name).map(|(_, v)| v)
    }

    /// Sets an attribute, in its place if it is there already.
    pub fn set(&mut self, name: &str, value: Value) {
        match self.attributes.iter_mut().find(|(n, _)| n == name) {
            Some((_, old)) => *old = value,
            None => self.attributes.push((name.to_owned(), value)),
        }
    }

    /// Length of all parts, metres.
    pub fn length(&self) -> f64 {
        self.parts.iter().map(|part| part.windows(2).map(|w| (w[1] - w[0]).norm()).sum::<f64>()).sum()
    }

    /// Name for messages: the class and the id.
    pub fn name(&self) -> String {
        match self.id {
            Some(id) => format!("{} {id}", self.class),
            None => self.class.clone(),
        }
    }
}

/// Why linework does not find its way.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// A vertex is NaN or infinite.
    #[error("feature {feature} has a vertex that is not finite")]
    NotFinite {
        /// The feature.
        feature: String,
    },
    /// The attribute with the ways off the surface does not read.
    #[error(
        "feature {feature}: its attribute '{OFF_SURFACE}' is not a list of [part, vertex, dx, dy, dz] of its vertices"
    )]
    OffSurface {
        /// The feature.
        feature: String,
    },
    /// A setting has a value that makes no sense.
    #[error("the setting '{key}' is {value}, but must be {must}")]
    Setting {
        /// The key.
        key: &'static str,
        /// The value given.
        value: f64,
        /// What would be accepted.
        must: &'static str,
    },
}

fn check_finite(feature: &Feature) -> Result<(), Error> {
    let finite = feature.parts.iter().flatten().all(|p| p.iter().all(|c| c.is_finite()));
    if finite { Ok(()) } else { Err(Error::NotFinite { feature: feature.name() }) }
}
