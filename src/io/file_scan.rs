//! What one file gives: columns, provenance, and what is known about the file.

use super::part::Part;
use crate::cloud::{Attributes, DroppedRecords, Station};
use crate::numeric::Vec3;
use crate::warning::Warning;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// How scans are read. One table, `[ingest]`, of the pipeline file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Column with fracture labels: an extra-bytes or PLY scalar name, `classification` or `none`.
    /// Not set: a column named like `fracture`, `label` or `scalar_label` is found by its name.
    pub label_column: Option<String>,
    /// Unit of the coordinates. Not set: the unit that the file's coordinate reference system states, else metres.
    pub unit: Option<Unit>,
    /// Columns of text scans (XYZ, CSV, TXT, PTS) in order, e.g. `["x", "y", "z", "intensity", "red", "green", "blue"]`;
    /// `skip` leaves one out. Not set: taken from the header line or guessed from the values, and shown by `adit info`.
    pub text_columns: Option<Vec<String>>,
    /// TOML file with a 4x4 matrix `pose` for each input file, see `docs/formats.md`. Not set: only poses in the files.
    pub poses: Option<PathBuf>,
    /// Only the part of the scan between two chainages of `axis.alignment`, metres, as far as 30 m from it. Of COPC files only
    /// what may lie there is read, of others everything is looked at. Not set: the whole scan.
    pub chainage_m: Option<[f64; 2]>,
    /// Use the complete records of a file that was cut off, with a warning, instead of refusing it.
    pub allow_truncated: bool,
}

/// A unit of length that scans come in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Unit {
    /// 1 m.
    Metre,
    /// 0.01 m.
    Centimetre,
    /// 0.001 m.
    Millimetre,
    /// 0.3048 m.
    Foot,
    /// 1200/3937 m.
    UsSurveyFoot,
}

impl Unit {
    /// Length of the unit in metres.
    pub fn metres(self) -> f64 {
        match self {
            Self::Metre => 1.0,
            Self::Centimetre => 0.01,
            Self::Millimetre => 0.001,
            Self::Foot => 0.3048,
            Self::UsSurveyFoot => 1200.0 / 3937.0,
        }
    }
}

/// Range of one attribute of a file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AttributeInfo {
    /// Name of the attribute.
    pub name: String,
    /// Smallest value, when it was looked at.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min: Option<f64>,
    /// Largest value, when it was looked at.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max: Option<f64>,
}

impl AttributeInfo {
    pub(super) fn present(name: &str) -> Self {
        Self { name: name.to_owned(), min: None, max: None }
    }

    pub(super) fn range(name: &str, min: f64, max: f64) -> Self {
        Self { name: name.to_owned(), min: Some(min), max: Some(max) }
    }
}

/// What is known about a file besides its columns.
#[derive(Clone, Debug)]
pub(super) struct FileInfo {
    pub(super) format: &'static str,
    pub(super) version: Option<String>,
    pub(super) records: u64,
    pub(super) faces: u64,
    /// Format-specific facts for `adit info`.
    pub(super) header: serde_json::Map<String, serde_json::Value>,
    pub(super) attributes: Vec<AttributeInfo>,
    pub(super) label_column: Option<String>,
    pub(super) crs: Option<super::crs::Crs>,
    /// Lowest and highest coordinates in scan units.
    pub(super) bounds: Option<[[f64; 3]; 2]>,
    /// Step of the coordinates as stored: the LAS scale, 0 for floating point.
    pub(super) resolution: f64,
    /// Whether coordinates are stored as 32-bit floats.
    pub(super) single_precision: bool,
}

impl FileInfo {
    pub(super) fn new(format: &'static str) -> Self {
        Self {
            format,
            version: None,
            records: 0,
            faces: 0,
            header: serde_json::Map::new(),
            attributes: Vec::new(),
            label_column: None,
            crs: None,
            bounds: None,
            resolution: 0.0,
            single_precision: false,
        }
    }

    pub(super) fn header(&mut self, key: &str, value: impl Serialize) {
        let value = serde_json::to_value(value).unwrap_or(serde_json::Value::Null);
        self.header.insert(key.to_owned(), value);
    }
}

/// One file as columns; positions and stations are in scan units relative to `origin`.
#[derive(Debug)]
pub(super) struct FileScan {
    pub(super) origin: Vec3,
    pub(super) positions: Vec<Vec3>,
    pub(super) attributes: Attributes,
    pub(super) stations: Vec<Station>,
    pub(super) record_count: u64,
    /// Records that gave no point.
    pub(super) dropped_records: DroppedRecords,
    /// How many of them lie outside the part that was asked for.
    pub(super) outside_part: u64,
    pub(super) info: FileInfo,
    pub(super) warnings: Vec<Warning>,
}

impl FileScan {
    /// Adds stations and, for each record, the one that saw it.
    pub(super) fn set_stations(&mut self, stations: Vec<Station>, mut station_of_record: Vec<u16>) {
        let mut records = 0..;
        station_of_record.retain(|_| records.next().is_some_and(|r| self.dropped_records.point_of(r).is_some()));
        self.attributes.station_ids = Some(station_of_record);
        self.stations = stations;
    }

    /// Lets go of the points outside a part of the scan.
    pub(super) fn keep_part(&mut self, part: &Part) {
        let origin = self.origin;
        let keep: Vec<bool> = self.positions.par_iter().map(|p| part.contains(&(p + origin))).collect();
        self.outside_part += keep.iter().filter(|k| !**k).count() as u64;
        self.dropped_records = self.dropped_records.and_points(&keep);
        self.attributes.retain(&keep);
        let mut kept = keep.iter();
        self.positions.retain(|_| *kept.next().expect("one entry for each point"));
        self.info.bounds = bounds(&self.positions).map(|b| b.map(|corner| (corner + origin).into()));
    }

    /// A scan whose positions are still absolute: moves them next to a whole-unit origin.
    pub(super) fn relative(mut self, origin: Option<Vec3>) -> Self {
        let Some([low, high]) = bounds(&self.positions) else {
            self.origin = origin.unwrap_or_else(Vec3::zeros);
            return self;
        };
        self.info.bounds = Some([low.into(), high.into()]);
        self.origin = origin.unwrap_or_else(|| whole_units(&((low + high) / 2.0)));
        if self.origin != Vec3::zeros() {
            self.positions.iter_mut().for_each(|p| *p -= self.origin);
        }
        for position in self.stations.iter_mut().filter_map(|s| s.position_in_local.as_mut()) {
            *position -= self.origin;
        }
        self
    }
}

/// Lowest and highest coordinates.
fn bounds(positions: &[Vec3]) -> Option<[Vec3; 2]> {
    let mut positions = positions.iter();
    let first = positions.next()?;
    Some(positions.fold([*first; 2], |[low, high], p| [low.inf(p), high.sup(p)]))
}

/// An origin on whole hundreds of units near `point`; zero for coordinates that are small already.
///
/// Below ten thousand units an `f64` resolves 2e-12, so nothing is gained by moving.
pub(super) fn whole_units(point: &Vec3) -> Vec3 {
    const SMALL: f64 = 10_000.0;
    if point.amax() < SMALL { Vec3::zeros() } else { point.map(|c| (c / 100.0).floor() * 100.0) }
}
