//! The list of unwrap methods: their names, their settings, how free their result is, and the dispatch to their files.
//!
//! In a pipeline a method is named by its table, `[unwrap.section]`, or by a string, `unwrap = "section"`.
//! A new method is one file in `unwrap/`, one `mod` line and one line in the list at the end of this file.

use super::guide::Guide;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::numeric::Vec2;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Error as _, MapAccess, Visitor};
use serde::ser::SerializeMap;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::path::PathBuf;

/// What a method leaves undecided about its result; registration decides it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Freedom {
    /// The method already places its result: u = chainage, v = girth.
    Placed,
    /// The result has the right size but lies anywhere in the plane.
    Rigid,
    /// The result also has an arbitrary scale.
    Similar,
}

/// What a method makes of the tunnel axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AxisUse {
    /// It places its result by the axis or opens the tunnel along it: no axis, no map.
    Needs,
    /// It starts nearer to its result with an axis; without one it starts from a conformal map.
    Profits,
    /// Only the place of the result on the page depends on it.
    Ignores,
}

macro_rules! methods {
    ($( $(#[$doc:meta])* $variant:ident($module:ident) = $name:literal, $freedom:ident, $axis:ident; )+) => {
        /// A method of flattening with its settings. Written as a table named after the method, or just its name.
        #[derive(Clone, Debug, PartialEq)]
        #[non_exhaustive]
        pub enum Method {
            $( $(#[$doc])* $variant(super::$module::Settings), )+
        }

        impl Method {
            /// The names of all methods, in the order of the documentation.
            pub const NAMES: &'static [&'static str] = &[$($name),+];

            /// The method of that name with default settings; `None` when there is no such method.
            pub fn named(name: &str) -> Option<Self> {
                match name {
                    $($name => Some(Self::$variant(super::$module::Settings::default())),)+
                    _ => None,
                }
            }

            /// The name in kebab-case.
            pub fn name(&self) -> &'static str {
                match self { $(Self::$variant(_) => $name,)+ }
            }

            /// What registration still has to decide.
            pub fn freedom(&self) -> Freedom {
                match self { $(Self::$variant(_) => Freedom::$freedom,)+ }
            }

            /// What it makes of the tunnel axis.
            pub fn axis_use(&self) -> AxisUse {
                match self { $(Self::$variant(_) => AxisUse::$axis,)+ }
            }

            /// Map coordinates of each vertex, not yet registered.
            pub(super) fn solve(&self, strip: &Strip, guide: Option<&Guide>) -> Result<(Vec<Vec2>, SolveSummary), Error> {
                match self { $(Self::$variant(settings) => super::$module::flatten(strip, guide, settings),)+ }
            }

            /// Reads the value of the key `name`; the caller has checked that the name exists.
            pub(super) fn next_value<'de, A: MapAccess<'de>>(name: &str, map: &mut A) -> Result<Self, A::Error> {
                match name {
                    $($name => Ok(Self::$variant(map.next_value()?)),)+
                    _ => Err(A::Error::unknown_variant(name, Self::NAMES)),
                }
            }

            /// Writes `name = { settings }` into a map.
            pub(super) fn serialize_entry<M: SerializeMap>(&self, map: &mut M) -> Result<(), M::Error> {
                match self { $(Self::$variant(settings) => map.serialize_entry($name, settings),)+ }
            }

            /// Name and settings schema of each method.
            pub(super) fn schemas(generator: &mut SchemaGenerator) -> Vec<(&'static str, Schema)> {
                vec![$(($name, generator.subschema_for::<super::$module::Settings>()),)+]
            }
        }
    };
}

impl Method {
    /// The file with handles that the method's settings name, if they do.
    pub fn handles_file(&self) -> Option<&PathBuf> {
        match self {
            Self::DeformArap(settings) => settings.handles.as_ref(),
            Self::DeformSkin(settings) => settings.handles.as_ref(),
            _ => None,
        }
    }

    /// The same, to be changed: paths in a pipeline file are relative to it.
    pub fn handles_file_mut(&mut self) -> Option<&mut PathBuf> {
        match self {
            Self::DeformArap(settings) => settings.handles.as_mut(),
            Self::DeformSkin(settings) => settings.handles.as_mut(),
            _ => None,
        }
    }
}

impl Serialize for Method {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(1))?;
        self.serialize_entry(&mut map)?;
        map.end()
    }
}

impl<'de> Deserialize<'de> for Method {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct MethodVisitor;
        impl<'de> Visitor<'de> for MethodVisitor {
            type Value = Method;

            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                write!(f, "the name of an unwrap method or one table named after it ({})", Method::NAMES.join(", "))
            }

            fn visit_str<E: serde::de::Error>(self, name: &str) -> Result<Method, E> {
                Method::named(name).ok_or_else(|| E::unknown_variant(name, Method::NAMES))
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Method, A::Error> {
                let name: String =
                    map.next_key()?.ok_or_else(|| A::Error::custom("an unwrap method is missing here"))?;
                let method = Method::next_value(&name, &mut map)?;
                match map.next_key::<String>()? {
                    Some(other) => Err(A::Error::custom(two_methods(&name, &other))),
                    None => Ok(method),
                }
            }
        }
        deserializer.deserialize_any(MethodVisitor)
    }
}

pub(super) fn two_methods(first: &str, second: &str) -> String {
    format!("two unwrap methods, '{first}' and '{second}': a run has exactly one, remove the other table")
}

impl JsonSchema for Method {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "UnwrapMethod".into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        let tables: Vec<Schema> = Method::schemas(generator)
            .into_iter()
            .map(|(name, schema)| {
                json_schema!({
                    "type": "object", "properties": { name: schema }, "required": [name], "additionalProperties": false
                })
            })
            .collect();
        json_schema!({ "anyOf": [{ "enum": Method::NAMES }, { "oneOf": tables }] })
    }
}

methods! {
    /// Chainage and true girth of the section; no optimisation.
    Section(section) = "section", Placed, Needs;
    /// Least squares conformal map: keeps angles.
    Lscm(lscm) = "lscm", Similar, Profits;
    /// Relaxed section chart: nearly isometric, yet a chainage ruler. The default.
    Relax(relax) = "relax", Placed, Needs;
    /// Angle based flattening by full Newton steps: the reference for small meshes.
    Abf(abf) = "abf", Similar, Ignores;
    /// Angle based flattening by reduced Newton steps: least angle distortion.
    AbfPlusPlus(abf_plus_plus) = "abf++", Similar, Ignores;
    /// As-rigid-as-possible map: lengths, areas and angles all nearly right.
    Arap(arap) = "arap", Rigid, Profits;
    /// Scalable locally injective map: never a flip, mild worst triangles.
    Slim(slim) = "slim", Rigid, Profits;
    /// As-rigid-as-possible deformation in space, then projection.
    DeformArap(deform_arap) = "deform-arap", Placed, Needs;
    /// Bones that open the tunnel like a book, then projection.
    DeformSkin(deform_skin) = "deform-skin", Placed, Needs;
}
