//! The pipeline file: one table per stage, unknown keys refused, one way to override a key.
//!
//! The whole file is one Rust type, [`Pipeline`]; its JSON schema (derived) knows every key, so misspelt ones are told
//! with line, column and the key that was probably meant, and the reference page is generated from the same source.

use super::known_keys::KnownKeys;
use super::limits::Limits;
use super::profile;
use crate::{axis, clean, cut, io, map, mesh, normals, segment, unwrap};
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};
use std::path::{Path, PathBuf};
use toml::de::{DeTable, DeValue};

/// Everything that decides what a run computes. Thread count and output folder do not, and are not part of it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Pipeline {
    /// Scan files, read together as one scan, or one mesh file; relative to the pipeline file, as all paths in it.
    #[serde(deserialize_with = "one_or_many")]
    pub input: Vec<PathBuf>,
    /// Reading the scan.
    pub ingest: io::Settings,
    /// From all points to the points that carry the geometry.
    pub clean: clean::Settings,
    /// Finding the tunnel's axis.
    pub axis: axis::Settings,
    /// Which way the surface faces, and how noisy it is.
    pub normals: normals::Settings,
    /// Telling wall and floor from everything else.
    pub segment: segment::Settings,
    /// Making the surface.
    pub mesh: mesh::Settings,
    /// Cutting the surface open.
    pub cut: cut::Settings,
    /// Flattening the surface.
    pub unwrap: unwrap::Settings,
    /// Tying the points to the surface.
    pub anchor: mesh::anchor::Settings,
    /// Drawing the map.
    pub map: map::Settings,
    /// What is told along the tunnel.
    pub profile: profile::Settings,
    /// When a finished run counts as good: levels that make it warn or fail.
    pub limits: Limits,
}

/// Why a pipeline file or an override was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The file cannot be read.
    #[error("cannot read the pipeline file '{}': {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// The text is no TOML, or a value has the wrong type.
    #[error("{place}: {message}")]
    Invalid {
        /// File, line and column.
        place: String,
        /// What is wrong.
        message: String,
    },
    /// A key that no stage knows.
    #[error("{place}: there is no key '{key}'{}", suggestion.as_ref().map_or(String::new(), |s| format!("; did you mean '{s}'?")))]
    UnknownKey {
        /// File, line and column, or the override.
        place: String,
        /// The key with its tables.
        key: String,
        /// The nearest known key.
        suggestion: Option<String>,
    },
    /// An override is not `key=value`.
    #[error("'--set {given}' is not of the form key=value, e.g. --set map.cell_m=0.005")]
    Override {
        /// What was given.
        given: String,
    },
}

/// Stages whose method is the name of a table: naming another method replaces the one in the file.
const METHOD_STAGES: [(&str, &[&str]); 1] = [("unwrap", unwrap::Method::NAMES)];

impl Pipeline {
    /// The pipeline of a file with overrides (`key=value`) applied in order. Input paths become absolute.
    ///
    /// # Errors
    /// [`Error`] with line and column in the file, or the override that does not fit.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self, Error> {
        let text = std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        let mut pipeline = Self::parse(&text, &path.display().to_string(), overrides)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let more = [&mut pipeline.axis.alignment, &mut pipeline.ingest.poses, &mut pipeline.map.design_profile];
        let handles = pipeline.unwrap.method.handles_file_mut();
        for named in pipeline.input.iter_mut().chain(more.into_iter().flatten()).chain(handles) {
            *named = folder.join(&*named);
        }
        pipeline.make_inputs_absolute();
        Ok(pipeline)
    }

    /// The pipeline told by `text`; `name` stands for the file in error messages. Input paths stay as they are.
    ///
    /// # Errors
    /// As [`Pipeline::load`].
    pub fn parse(text: &str, name: &str, overrides: &[String]) -> Result<Self, Error> {
        let keys = KnownKeys::of(Self::schema());
        let place = |offset: usize| {
            let before = &text[..offset.min(text.len())];
            let line = before.matches('\n').count() + 1;
            let column = before.chars().rev().take_while(|&c| c != '\n').count() + 1;
            format!("{name}:{line}:{column}")
        };
        let invalid = |error: toml::de::Error| Error::Invalid {
            place: place(error.span().map_or(0, |s| s.start)),
            message: error.message().replace('\n', " "),
        };
        let document = DeTable::parse(text).map_err(invalid)?;
        refuse_unknown_keys(document.get_ref(), &mut Vec::new(), &keys, &place)?;
        // Read the file by itself first: only this way does a wrong value get its line and column.
        let from_file: Self = toml::from_str(text).map_err(invalid)?;
        if overrides.is_empty() {
            return Ok(from_file);
        }
        let mut table: toml::Table = toml::from_str(text).map_err(invalid)?;
        let mut pipeline = from_file;
        for given in overrides {
            apply_override(&mut table, given, &keys)?;
            pipeline = table.clone().try_into().map_err(|error: toml::de::Error| Error::Invalid {
                place: format!("--set {given}"),
                message: error.message().replace('\n', " "),
            })?;
        }
        Ok(pipeline)
    }

    /// The defaults with overrides applied.
    ///
    /// # Errors
    /// As [`Pipeline::load`].
    pub fn from_overrides(overrides: &[String]) -> Result<Self, Error> {
        let mut pipeline = Self::parse("", "defaults", overrides)?;
        pipeline.make_inputs_absolute();
        Ok(pipeline)
    }

    /// Replaces relative input paths by absolute ones, so that the resolved pipeline means the same everywhere.
    pub fn make_inputs_absolute(&mut self) {
        let more = [&mut self.axis.alignment, &mut self.ingest.poses, &mut self.map.design_profile];
        let handles = self.unwrap.method.handles_file_mut();
        for input in self.input.iter_mut().chain(more.into_iter().flatten()).chain(handles) {
            // Only an empty path or a vanished working folder has no absolute form; reading it will say so.
            if let Ok(absolute) = std::path::absolute(&*input) {
                *input = absolute.components().collect();
            }
        }
    }

    /// The settings of a stage; null for stages without.
    pub fn settings_of(&self, stage: &str) -> serde_json::Value {
        let all = serde_json::to_value(self).expect("settings are plain data");
        all.get(stage).cloned().unwrap_or_default()
    }

    /// The resolved pipeline as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("settings are tables of plain values")
    }

    /// JSON schema of the pipeline file.
    pub fn schema() -> schemars::Schema {
        schemars::schema_for!(Pipeline)
    }
}

fn refuse_unknown_keys(
    table: &DeTable,
    path: &mut Vec<String>,
    keys: &KnownKeys,
    place: &dyn Fn(usize) -> String,
) -> Result<(), Error> {
    for (key, value) in table {
        path.push(key.get_ref().to_string());
        let names: Vec<&str> = path.iter().map(String::as_str).collect();
        if !keys.contains(&names) {
            return Err(Error::UnknownKey {
                place: place(key.span().start),
                key: names.join("."),
                suggestion: keys.nearest(&names),
            });
        }
        match value.get_ref() {
            DeValue::Table(inner) => refuse_unknown_keys(inner, path, keys, place)?,
            DeValue::Array(items) => {
                for item in items {
                    if let DeValue::Table(inner) = item.get_ref() {
                        refuse_unknown_keys(inner, path, keys, place)?;
                    }
                }
            }
            _ => {}
        }
        path.pop();
    }
    Ok(())
}

fn apply_override(table: &mut toml::Table, given: &str, keys: &KnownKeys) -> Result<(), Error> {
    let malformed = || Error::Override { given: given.to_owned() };
    let (key, text) = given.split_once('=').ok_or_else(malformed)?;
    let path: Vec<&str> = key.trim().split('.').map(str::trim).collect();
    if path.iter().any(|p| p.is_empty()) {
        return Err(malformed());
    }
    if !keys.contains(&path) {
        return Err(Error::UnknownKey {
            place: format!("--set {given}"),
            key: path.join("."),
            suggestion: keys.nearest(&path),
        });
    }
    // What does not read as a TOML value is meant as text: `unwrap=lscm`.
    let value = format!("value = {}", text.trim())
        .parse::<toml::Table>()
        .ok()
        .and_then(|mut t| t.remove("value"))
        .unwrap_or_else(|| toml::Value::String(text.trim().to_owned()));
    let (last, parents) = path.split_last().ok_or_else(malformed)?;
    let method = METHOD_STAGES.iter().find(|(stage, _)| *stage == path[0]);
    // `unwrap = "lscm"` in the file becomes a table, so that keys can be set below it.
    if method.is_some()
        && let Some(slot) = table.get_mut(path[0])
        && let Some(name) = slot.as_str().map(str::to_owned)
    {
        *slot = toml::Value::Table([(name, toml::Value::Table(toml::Table::new()))].into_iter().collect());
    }
    if let Some((stage, methods)) = method {
        let chosen = if parents.is_empty() { value.as_str() } else { path.get(1).copied() };
        if let Some(chosen) = chosen.filter(|c| methods.contains(c))
            && let Some(stage_table) = table.get_mut(*stage).and_then(toml::Value::as_table_mut)
        {
            stage_table.retain(|k, _| k == chosen || !methods.contains(&k));
            if parents.is_empty() {
                stage_table.entry(chosen).or_insert_with(|| toml::Value::Table(toml::Table::new()));
                return Ok(());
            }
        }
    }
    let mut at = table;
    for parent in parents {
        let slot = at.entry(*parent).or_insert_with(|| toml::Value::Table(toml::Table::new()));
        if !slot.is_table() {
            *slot = toml::Value::Table(toml::Table::new());
        }
        at = slot.as_table_mut().ok_or_else(malformed)?;
    }
    at.insert((*last).to_owned(), value);
    Ok(())
}

/// A list of paths, or a single one.
fn one_or_many<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<PathBuf>, D::Error> {
    struct Paths;
    impl<'de> serde::de::Visitor<'de> for Paths {
        type Value = Vec<PathBuf>;

        fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
            f.write_str("a file name or a list of file names")
        }

        fn visit_str<E: serde::de::Error>(self, path: &str) -> Result<Self::Value, E> {
            Ok(vec![path.into()])
        }

        fn visit_seq<A: serde::de::SeqAccess<'de>>(self, mut list: A) -> Result<Self::Value, A::Error> {
            let mut paths = Vec::new();
            while let Some(path) = list.next_element()? {
                paths.push(path);
            }
            Ok(paths)
        }
    }
    deserializer.deserialize_any(Paths)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(text: &str, overrides: &[&str]) -> String {
        let overrides: Vec<String> = overrides.iter().map(ToString::to_string).collect();
        Pipeline::parse(text, "night.toml", &overrides).unwrap_err().to_string()
    }

    fn with(text: &str, overrides: &[&str]) -> Pipeline {
        let overrides: Vec<String> = overrides.iter().map(ToString::to_string).collect();
        Pipeline::parse(text, "night.toml", &overrides).unwrap()
    }

    #[test]
    fn an_unknown_key_is_told_with_its_place_and_the_nearest_one() {
        assert_eq!(
            refused("[map]\ncell_m = 0.01\n  cel_m = 1\n", &[]),
            "night.toml:3:3: there is no key 'map.cel_m'; did you mean 'map.cell_m'?"
        );
        assert_eq!(refused("[maps]\n", &[]), "night.toml:1:2: there is no key 'maps'; did you mean 'map'?");
        assert!(refused("", &["seam_angle_deg=90"]).ends_with("did you mean 'cut.seam_angle_deg'?"));
    }

    #[test]
    fn a_wrong_value_is_told_with_its_place() {
        assert!(refused("\n[map]\ncell_m = 'small'\n", &[]).starts_with("night.toml:3:10: "));
        assert!(refused("[map]\n", &["map.cell_m=small"]).starts_with("--set map.cell_m=small: "));
        assert!(refused("[map\n", &[]).starts_with("night.toml:1:"));
        assert!(refused("", &["map.cell_m"]).contains("key=value"));
    }

    #[test]
    fn overrides_win_in_order() {
        let pipeline = with("[map]\ncell_m = 0.5\n", &["map.cell_m=0.1", "map.cell_m=0.2"]);
        assert_eq!(pipeline.map.cell_m, Some(0.2));
    }

    #[test]
    fn naming_a_method_replaces_the_one_in_the_file() {
        for text in ["unwrap = 'section'\n", "[unwrap.section]\n", "[unwrap]\nsmoothing_m = 0.5\n", ""] {
            assert_eq!(with(text, &["unwrap=lscm"]).unwrap.method.name(), "lscm", "{text}");
            let iterated = with(text, &["unwrap.arap.max_iterations=7"]);
            assert_eq!(iterated.unwrap.method.name(), "arap", "{text}");
        }
        assert_eq!(with("[unwrap]\nsmoothing_m = 0.5\n", &["unwrap=lscm"]).settings_of("unwrap")["smoothing_m"], 0.5);
    }

    #[test]
    fn the_resolved_file_gives_the_same_pipeline() {
        let pipeline = with("input = 'a.laz'\n[limits]\nflipped_faces = 3\n", &["unwrap=slim", "map.cell_m=0.004"]);
        assert_eq!(Pipeline::parse(&pipeline.to_toml(), "resolved", &[]).unwrap(), pipeline);
    }

    #[test]
    fn paths_are_relative_to_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("p.toml");
        let text = "input = ['scan.laz']\n[axis]\nalignment = 'axis.csv'\n[unwrap.deform-skin]\nhandles = 'h.csv'\n";
        std::fs::write(&file, text).unwrap();
        let pipeline = Pipeline::load(&file, &[]).unwrap();
        assert_eq!(pipeline.input, [folder.path().join("scan.laz")]);
        assert_eq!(pipeline.axis.alignment, Some(folder.path().join("axis.csv")));
        assert_eq!(pipeline.unwrap.method.handles_file(), Some(&folder.path().join("h.csv")));
    }

    #[test]
    fn the_pipelines_that_come_with_adit_are_valid() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines");
        for file in std::fs::read_dir(folder).unwrap() {
            Pipeline::load(&file.unwrap().path(), &[]).unwrap();
        }
    }
}
