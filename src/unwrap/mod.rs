//! Flattening a strip: every method turns a [`Strip`] into a [`Chart`], (u, v) in metres for each vertex.
//!
//! The map is seen from inside: u runs with the chainage, v is the girth from the crown, positive over the right wall
//! (right when facing increasing chainage). Faces that run counter-clockwise seen from inside keep that sense in (u, v).

pub mod abf;
pub mod abf_plus_plus;
mod angles;
pub mod arap;
mod cage;
mod conformal;
mod corner_sums;
pub mod chart_index;
pub mod deform_arap;
pub mod deform_skin;
pub mod distortion;
mod fans;
mod finish;
mod flip_free_step;
pub mod guide;
pub mod handles;
pub mod lscm;
pub mod method;
mod opening;
mod patch_embedding;
mod poisson;
mod quasi_newton;
pub mod readability;
pub mod registration;
pub mod relax;
mod rigid_fit;
pub mod section;
pub mod slim;
mod start;
mod stopping;
mod triangle_shapes;
pub mod unfold;
mod unfurl;
#[cfg(test)]
pub(crate) mod closed_form;
#[cfg(test)]
mod contract;
#[cfg(test)]
mod independent;
#[cfg(test)]
mod robustness;

pub use chart_index::{ChartIndex, RoundTrip, covered_and_round_trip, covered_points, round_trip};
pub use distortion::Distortion;
pub use guide::Guide;
pub use handles::Handle;
pub use method::{AxisUse, Freedom, Method};
pub use readability::Readability;

use crate::axis::Axis;
use crate::cut::Strip;
use crate::numeric::Vec2;
use crate::warning::Warning;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Error as _, MapAccess, Visitor};
use serde::ser::SerializeMap;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::collections::BTreeMap;

/// A strip with map coordinates at its vertices. Owns its strip, because the way back needs it.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    strip: Strip,
    uv: Vec<Vec2>,
}

/// Why a strip was not flattened.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// One (u, v) for each vertex is needed.
    #[error("{found} map coordinates for {expected} vertices")]
    Length {
        /// Coordinates given.
        found: usize,
        /// Vertices of the strip.
        expected: usize,
    },
    /// A map coordinate is NaN or infinite.
    #[error("vertex {vertex} has no finite map coordinate")]
    NotFinite {
        /// The vertex.
        vertex: u32,
    },
    /// The method needs to know the tunnel axis.
    #[error("method '{method}' needs the tunnel axis, and none was given or found")]
    NeedsAxis {
        /// Name of the method.
        method: &'static str,
    },
    /// A setting has a value that makes no sense.
    #[error("unwrap setting '{key}' is {value}, but must be {must}")]
    Setting {
        /// The key, e.g. `section.window_m`.
        key: &'static str,
        /// The value given.
        value: f64,
        /// What would be accepted.
        must: &'static str,
    },
    /// The surface goes around the axis: it was not cut, or the axis is not inside it.
    #[error(
        "the strip still winds around the axis (the angle differs by {turns:.2} turns at vertex {vertex}): cut it along a seam first, or check the axis"
    )]
    NotOpened {
        /// A vertex where two ways around disagree.
        vertex: u32,
        /// By how many turns they disagree.
        turns: f64,
    },
    /// A file with handles, or one of its handles, cannot be used.
    #[error("{given_in}: {problem}")]
    Handles {
        /// File and line.
        given_in: String,
        /// What is wrong.
        problem: String,
    },
    /// The settings name a file with handles, and the caller did not read it.
    #[error("the handles of '{}' were not read", path.display())]
    HandlesNotRead {
        /// The file.
        path: std::path::PathBuf,
    },
    /// A linear system could not be solved.
    #[error("method '{method}': {what}")]
    Solve {
        /// Name of the method.
        method: &'static str,
        /// What went wrong, with numbers.
        what: String,
    },
}

impl Chart {
    /// Proves one finite (u, v) for each vertex of the strip.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn new(strip: Strip, uv: Vec<Vec2>) -> Result<Self, Error> {
        let expected = strip.mesh().vertices().len();
        if uv.len() != expected {
            return Err(Error::Length { found: uv.len(), expected });
        }
        if let Some(vertex) = uv.iter().position(|p| !p.x.is_finite() || !p.y.is_finite()) {
            return Err(Error::NotFinite { vertex: vertex as u32 });
        }
        Ok(Self { strip, uv })
    }

    /// The strip that was flattened.
    pub fn strip(&self) -> &Strip {
        &self.strip
    }

    /// Map coordinates of each vertex, metres: x = u (chainage), y = v (girth from the crown).
    pub fn uv(&self) -> &[Vec2] {
        &self.uv
    }

    /// Map coordinates of the corners of a face.
    pub fn corners_in_chart(&self, face: u32) -> [Vec2; 3] {
        self.strip.mesh().faces()[face as usize].map(|v| self.uv[v as usize])
    }
}

/// How to flatten: the method, and how its distortion is told.
///
/// Written `unwrap = "section"` or as a table: `[unwrap.section]` for the method's settings, `[unwrap]` for the rest.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// The method. Default `relax`.
    pub method: Method,
    /// Distortion is told twice: against the mesh itself, and against the surface smoothed over this distance in
    /// metres, which is what the reader of the map cares about. 0 leaves the second out. Chosen automatically when not
    /// given: 0.25, or a sixtieth of the girth in narrow tubes.
    pub smoothing_m: Option<f64>,
}

/// Distance over which the surface is smoothed for the second distortion, metres: larger than joints and drill marks.
const SMOOTHING_M: f64 = 0.25;
/// At most this share of the girth is smoothed, so that a narrow tube does not shrink.
const SMOOTHING_OF_GIRTH: f64 = 1.0 / 60.0;

impl Default for Settings {
    fn default() -> Self {
        Self::of(Method::named("relax").expect("the default method is in the list"))
    }
}

impl Settings {
    /// A method with the default way of telling its distortion.
    pub fn of(method: Method) -> Self {
        Self { method, smoothing_m: None }
    }

    /// How the section chart that guides the method is made.
    pub fn section(&self) -> section::Settings {
        match &self.method {
            Method::Section(own) => own.clone(),
            _ => section::Settings::default(),
        }
    }
}

impl Serialize for Settings {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        if let Some(smoothing_m) = self.smoothing_m {
            map.serialize_entry("smoothing_m", &smoothing_m)?;
        }
        self.method.serialize_entry(&mut map)?;
        map.end()
    }
}

impl<'de> Deserialize<'de> for Settings {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct SettingsVisitor;
        impl<'de> Visitor<'de> for SettingsVisitor {
            type Value = Settings;

            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                write!(f, "the name of an unwrap method, or a table with one of {}", Method::NAMES.join(", "))
            }

            fn visit_str<E: serde::de::Error>(self, name: &str) -> Result<Settings, E> {
                Method::named(name).map(Settings::of).ok_or_else(|| E::unknown_variant(name, Method::NAMES))
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Settings, A::Error> {
                let mut settings = Settings::default();
                let mut chosen: Option<String> = None;
                while let Some(key) = map.next_key::<String>()? {
                    if key == "smoothing_m" {
                        settings.smoothing_m = Some(map.next_value()?);
                    } else if let Some(first) = &chosen {
                        return Err(A::Error::custom(method::two_methods(first, &key)));
                    } else {
                        settings.method = Method::next_value(&key, &mut map)?;
                        chosen = Some(key);
                    }
                }
                Ok(settings)
            }
        }
        deserializer.deserialize_any(SettingsVisitor)
    }
}

impl JsonSchema for Settings {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "UnwrapSettings".into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        let mut properties = serde_json::Map::new();
        properties.insert(
            "smoothing_m".to_owned(),
            serde_json::json!({
                "type": "number", "minimum": 0.0,
                "description": "Distortion is also told against the surface smoothed over this distance in metres; 0 leaves it out. Chosen automatically when not given: 0.25, or a sixtieth of the girth in narrow tubes."
            }),
        );
        let mut one_of = Vec::new();
        for (name, schema) in Method::schemas(generator) {
            properties.insert(name.to_owned(), schema.to_value());
            one_of.push(serde_json::json!({ "required": [name] }));
        }
        one_of.push(serde_json::json!({ "maxProperties": 1, "properties": { "smoothing_m": true } }));
        json_schema!({
            "description": "How to flatten: exactly one table named after a method, or just its name.",
            "anyOf": [
                { "enum": Method::NAMES },
                { "type": "object", "properties": properties, "additionalProperties": false, "anyOf": one_of }
            ]
        })
    }
}

/// What a method tells about its solve.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SolveSummary {
    /// Iterations done; 0 for methods without.
    pub iterations: usize,
    /// Whether the method's own stopping rule was reached. Not converging is a result, not an error.
    pub converged: bool,
    /// The quantity the stopping rule looks at, at the end; `None` for direct methods.
    pub residual: Option<f64>,
    /// The energy the method minimises, at the end; `None` for methods without.
    pub energy: Option<f64>,
    /// Further counts and figures of the method by name (repaired angles, moved vertices, factorisations ...).
    pub figures: BTreeMap<String, f64>,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

impl SolveSummary {
    /// The summary of a method that has nothing to iterate.
    pub fn direct() -> Self {
        Self { converged: true, ..Self::default() }
    }
}

/// What the unwrap stage reports.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Name of the method.
    pub method: String,
    /// Faces that are not counter-clockwise on the map, decided exactly; collapsed ones included.
    pub flipped_faces: usize,
    /// Of those, faces with exactly zero area on the map.
    pub collapsed_faces: usize,
    /// Crossings of the map's border with itself, decided exactly: the map covers itself there.
    pub overlaps: usize,
    /// Distortion against the mesh.
    #[serde(flatten)]
    pub distortion: Distortion,
    /// Distortion against the surface smoothed over `smoothing_m`; absent when that is 0.
    pub smoothed: Option<Distortion>,
    /// The distance used for `smoothed`, metres.
    pub smoothing_m: f64,
    /// How far the map is from reading as a chainage ruler; absent without an axis.
    pub readability: Option<Readability>,
    /// How the result was placed.
    pub registration: registration::Placement,
    /// What the method tells.
    pub solve: SolveSummary,
    /// What the section chart that guides the methods tells; absent without an axis.
    pub guide: Option<guide::GuideSummary>,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Flattens a strip and places it on the map: u = chainage, v = girth from the crown, metres, seen from inside.
///
/// Without an axis the methods that need none are placed with their principal direction along u, centred on (0, 0).
///
/// # Errors
/// [`Error::NeedsAxis`] for methods that cannot do without, [`Error::NotOpened`] for strips that wind around the axis,
/// and what the method itself refuses.
pub fn flatten(strip: Strip, axis: Option<&Axis>, settings: &Settings) -> Result<(Chart, Summary), Error> {
    flatten_with_handles(strip, axis, &[], settings)
}

/// As [`flatten`], with the handles of the file that the settings of the method name ([`Method::handles_file`]).
///
/// # Errors
/// As [`flatten`]; [`Error::HandlesNotRead`] when a file is named and no handles are given, [`Error::Handles`] for handles
/// that do not fit the strip.
pub fn flatten_with_handles(
    strip: Strip,
    axis: Option<&Axis>,
    handles: &[Handle],
    settings: &Settings,
) -> Result<(Chart, Summary), Error> {
    let guide = axis.map(|axis| Guide::of_strip(&strip, axis, &settings.section())).transpose()?;
    flatten_guided(strip, guide.map(|guide| guide.with_handles(handles)), settings)
}

/// [`flatten_with_handles`] with a guide that is already made and has its handles.
///
/// # Errors
/// As [`flatten_with_handles`].
pub fn flatten_guided(strip: Strip, guide: Option<Guide>, settings: &Settings) -> Result<(Chart, Summary), Error> {
    if let (Some(path), true) =
        (settings.method.handles_file(), guide.as_ref().is_some_and(|guide| guide.handles().is_empty()))
    {
        return Err(Error::HandlesNotRead { path: path.clone() });
    }
    if let Some(value) = settings.smoothing_m.filter(|s| !(*s >= 0.0 && s.is_finite())) {
        return Err(Error::Setting { key: "smoothing_m", value, must: "0 or more metres" });
    }
    let smoothing_m = settings.smoothing_m.unwrap_or_else(|| {
        let girth = guide.as_ref().map_or_else(|| strip.mesh().area().sqrt(), |g| g.summary().section.mean_girth_m);
        SMOOTHING_M.min(girth * SMOOTHING_OF_GIRTH)
    });
    let (mut uv, solve) = settings.method.solve(&strip, guide.as_ref())?;
    let placement = registration::place(&strip, guide.as_ref(), settings.method.freedom(), &mut uv)?;
    let chart = Chart::new(strip, uv)?;

    let (mesh, uv) = (chart.strip().mesh(), chart.uv());
    let (flipped_faces, collapsed_faces) = distortion::flipped_faces(mesh, uv);
    let mut warnings = solve.warnings.clone();
    if let Some(guide) = &guide {
        warnings.extend(guide.summary().warnings.iter().cloned());
    }
    // The surface is smoothed only now: the memory of the solve, which needs the most, is free again.
    let ((distortion, overlaps, readability), smoothed) = rayon::join(
        || {
            let readability = guide.as_ref().map(|guide| Readability::of(mesh, uv, guide));
            (Distortion::of(mesh, uv), distortion::border_crossings(chart.strip(), uv), readability)
        },
        || (smoothing_m > 0.0).then(|| Distortion::of(&distortion::smoothed_surface(mesh, smoothing_m), uv)),
    );
    let summary = Summary {
        method: settings.method.name().to_owned(),
        flipped_faces,
        collapsed_faces,
        overlaps,
        distortion,
        smoothed,
        smoothing_m,
        readability,
        registration: placement,
        guide: guide.map(|g| g.summary().clone()),
        solve,
        warnings,
    };
    Ok((chart, summary))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Settings, toml::de::Error> {
        #[derive(serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Run {
            unwrap: Settings,
        }
        toml::from_str::<Run>(text).map(|run| run.unwrap)
    }

    #[test]
    fn a_method_is_a_table_or_a_name() {
        assert_eq!(parse("unwrap = \"section\"").unwrap(), Settings::of(Method::named("section").unwrap()));
        let settings = parse("[unwrap]\nsmoothing_m = 0.5\n[unwrap.section]\nwindow_m = 3").unwrap();
        assert_eq!(settings.smoothing_m, Some(0.5));
        assert_eq!(settings.method, Method::Section(section::Settings { window_m: Some(3.0) }));
        assert_eq!(parse("[unwrap]").unwrap(), Settings::default());
    }

    #[test]
    fn every_method_survives_writing_and_reading() {
        for name in Method::NAMES {
            let settings = Settings::of(Method::named(name).unwrap());
            let text = toml::to_string(&std::collections::BTreeMap::from([("unwrap", &settings)])).unwrap();
            assert_eq!(parse(&text).unwrap(), settings, "{text}");
        }
    }

    #[test]
    fn misspelt_and_doubled_methods_are_refused_with_the_place() {
        let message = |text: &str| parse(text).unwrap_err().to_string();
        assert!(message("[unwrap.sektion]").contains("sektion"));
        let misspelt = message("[unwrap.section]\nwindw_m = 3");
        assert!(misspelt.contains("windw_m") && misspelt.contains("line 2"), "{misspelt}");
        assert!(message("unwrap = \"flat\"").contains("section"));
    }

    #[test]
    fn the_schema_names_every_method() {
        let schema = serde_json::to_string(&schemars::schema_for!(Settings)).unwrap();
        for name in Method::NAMES {
            assert!(schema.contains(&format!("\"{name}\"")), "{schema}");
        }
    }
}
