//! What is in a file, for `adit info`: everything that reading would tell, without building a cloud.

use super::assemble::contained;
use super::detect::{self, Format};
use super::error::{Error, ErrorKind};
use super::file_scan::{AttributeInfo, FileScan, Settings};
use super::guards::{GuardsPass, PointGuards};
use super::neighbourhood::NeighbourhoodPass;
use super::source_bytes::SourceBytes;
use super::stream::{Pass, Scope, Start, stream_file};
use super::{mesh_scan, ply, unit_guess};
use crate::numeric::Vec3;
use crate::warning::Warning;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What is in a scan or mesh file.
#[derive(Clone, Debug, Serialize)]
pub struct ScanInfo {
    /// The file.
    pub file: PathBuf,
    /// Its size in bytes.
    pub bytes: u64,
    /// Its format, e.g. `LAZ`.
    pub format: &'static str,
    /// Version of the format.
    pub version: Option<String>,
    /// Points (vertices of a mesh) with a valid position.
    pub points: u64,
    /// Records, those without a valid position included.
    pub records: u64,
    /// Faces of a mesh.
    pub faces: u64,
    /// Lowest and highest coordinates, in the file's unit.
    pub bounds: Option<[[f64; 3]; 2]>,
    /// Length of the file's unit in metres, as stated, set, or assumed to be 1.
    pub metres_per_unit: f64,
    /// Median distance of a point to its nearest neighbour, metres.
    pub spacing_m: Option<f64>,
    /// Points in a square metre of surface, from the neighbours of sampled points.
    pub density_per_m2: Option<f64>,
    /// Attributes with their ranges.
    pub attributes: Vec<AttributeInfo>,
    /// Column that labels come from.
    pub label_column: Option<String>,
    /// Coordinate reference system as stated.
    pub crs: Option<String>,
    /// Scanner positions, in the file's coordinates.
    pub stations: Vec<StationInfo>,
    /// Facts of the format.
    pub header: serde_json::Map<String, serde_json::Value>,
    /// Suspicious points.
    pub guards: PointGuards,
    /// Whether `adit run` (or `adit unwrap`, for a mesh) would take the file.
    pub usable: bool,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// A scanner position.
#[derive(Clone, Debug, Serialize)]
pub struct StationInfo {
    /// Its name.
    pub name: String,
    /// Its position in the file's coordinates, if the file tells it.
    pub position: Option<[f64; 3]>,
}

/// Reads a whole file and tells what is in it.
///
/// # Errors
/// [`Error`] when the file is missing, broken or of an unknown format. A sound file that cannot be mapped (no points,
/// coordinates in degrees) is no error: it is not [`ScanInfo::usable`] and its warnings say why.
pub fn inspect(path: &Path, settings: &Settings) -> Result<ScanInfo, Error> {
    // Whatever can be read is shown; that a part is missing makes the file unusable unless it is allowed.
    let lenient = Settings { allow_truncated: true, ..settings.clone() };
    let (format, bytes) = contained(path, || {
        let source = SourceBytes::open(path)?;
        Ok((detect::format_of(&source)?, source.len()))
    })?;
    let mut info = if format.is_mesh() {
        mesh_info(path, bytes)?
    } else {
        let mut look = Look::default();
        match stream_file(path, &lenient, Scope { ranges: true, window: None }, &mut look) {
            Ok((scan, points)) => scan_info(path, bytes, scan, points, look, settings),
            Err(error) if format == Format::Ply => without_coordinates(path, bytes, error)?,
            Err(error) => return Err(error),
        }
    };
    if format == Format::Ply && info.faces > 0 && info.points > 0 {
        // A mesh must also be sound as a mesh.
        let mesh = mesh_info(path, bytes)?;
        let new: Vec<Warning> = mesh.warnings.into_iter().filter(|w| !info.warnings.contains(w)).collect();
        info.warnings.extend(new);
        info.faces = mesh.faces;
    }
    Ok(info)
}

/// What is looked at while the points come by.
#[derive(Default)]
struct Look {
    begun: Option<(GuardsPass, NeighbourhoodPass)>,
}

impl Pass for Look {
    fn begin(&mut self, start: Start) {
        self.begun = Some((GuardsPass::new(start.records, start.origin), NeighbourhoodPass::new(start.seeds)));
    }

    fn add(&mut self, positions: &[Vec3]) {
        if let Some((guards, neighbourhood)) = &mut self.begun {
            guards.add(positions);
            neighbourhood.add(positions);
        }
    }
}

fn scan_info(path: &Path, bytes: u64, mut scan: FileScan, points: u64, look: Look, settings: &Settings) -> ScanInfo {
    let mut warnings = std::mem::take(&mut scan.warnings);
    let (mut guards, mut sample) = (PointGuards::default(), Vec::new());
    let (mut spacing, mut density) = (None, None);
    if let Some((guards_pass, neighbourhood)) = look.begun {
        let (found, new, points) = guards_pass.finish(&scan.info);
        (guards, sample) = (found, points);
        warnings.extend(new);
        (spacing, density) = neighbourhood.spacing_and_density();
    }
    let largest_color = |a: &AttributeInfo| ["red", "green", "blue"].contains(&&a.name[..]).then_some(a.max).flatten();
    let sixteen_bit_fields = ["LAS", "LAZ", "COPC"].contains(&scan.info.format);
    if let Some(largest) = scan.info.attributes.iter().filter_map(largest_color).reduce(f64::max)
        && sixteen_bit_fields
        && (1.0..=255.0).contains(&largest)
    {
        warnings.push(super::assemble::eight_bit_colors(largest as u16));
    }
    let stated = scan.info.crs.as_ref().and_then(|c| c.metres_per_unit);
    let metres_per_unit = settings.unit.map(super::Unit::metres).or(stated).unwrap_or(1.0);
    let degrees = settings.unit.is_none() && scan.info.crs.as_ref().is_some_and(|c| c.degrees);
    if degrees {
        warnings.push(Warning::new(
            "degrees",
            "the coordinates are degrees, not lengths: reproject the scan to a metric system before `adit run`",
        ));
    }
    if points == 0 {
        warnings.push(Warning::new("no-points", "there are no points to map"));
    }
    if let (Some([low, high]), None, None) = (scan.info.bounds, settings.unit, stated)
        && !degrees
    {
        warnings.extend(unit_guess::of(&(Vec3::from(high) - Vec3::from(low)), &sample));
    }
    let truncated = !settings.allow_truncated && warnings.iter().any(|w| w.code == "truncated");
    let usable = points > 0 && !degrees && !truncated;
    ScanInfo {
        file: path.to_owned(),
        bytes,
        format: scan.info.format,
        version: scan.info.version,
        points,
        records: scan.record_count,
        faces: scan.info.faces,
        bounds: scan.info.bounds,
        metres_per_unit,
        spacing_m: spacing.map(|s| s * metres_per_unit),
        density_per_m2: density.map(|d| d / (metres_per_unit * metres_per_unit)),
        attributes: scan.info.attributes,
        label_column: scan.info.label_column,
        crs: scan.info.crs.map(|c| c.text),
        stations: scan
            .stations
            .iter()
            .map(|s| StationInfo {
                name: s.name.clone(),
                position: s.position_in_local.map(|p| (p + scan.origin).into()),
            })
            .collect(),
        header: scan.info.header,
        guards,
        usable,
        warnings,
    }
}

fn mesh_info(path: &Path, bytes: u64) -> Result<ScanInfo, Error> {
    let (mesh, summary) = contained(path, || mesh_scan::read_mesh_source(&SourceBytes::open(path)?)?.finish(path))?;
    let mut bounds: Option<[Vec3; 2]> = None;
    for v in &mesh.vertices {
        let v = mesh.frame.scan_from_local(v);
        let [low, high] = bounds.unwrap_or([v, v]);
        bounds = Some([low.inf(&v), high.sup(&v)]);
    }
    let mut warnings = summary.warnings;
    if summary.faces == 0 {
        warnings.push(Warning::new("no-faces", "there are no faces to unwrap"));
    }
    let mut header = serde_json::Map::new();
    header.insert("split_polygons".into(), summary.split_polygons.into());
    header.insert("merged_vertices".into(), summary.merged_vertices.into());
    header.insert("chart_coordinates".into(), mesh.uv.is_some().into());
    Ok(ScanInfo {
        file: path.to_owned(),
        bytes,
        format: summary.format,
        version: None,
        points: mesh.vertices.len() as u64,
        records: mesh.vertices.len() as u64,
        faces: summary.faces as u64,
        bounds: bounds.map(|b| b.map(Into::into)),
        metres_per_unit: mesh.frame.metres_per_unit,
        spacing_m: None,
        density_per_m2: None,
        attributes: Vec::new(),
        label_column: None,
        crs: None,
        stations: Vec::new(),
        header,
        guards: PointGuards::default(),
        usable: summary.faces > 0,
        warnings,
    })
}

/// A PLY whose vertices have no x, y, z is sound, but no scan.
fn without_coordinates(path: &Path, bytes: u64, error: Error) -> Result<ScanInfo, Error> {
    let described = contained(path, || ply::describe(&SourceBytes::open(path)?));
    let Ok((info, false)) = described else { return Err(error) };
    debug_assert_eq!(error.kind(), ErrorKind::BadInput);
    Ok(ScanInfo {
        file: path.to_owned(),
        bytes,
        format: info.format,
        version: info.version,
        points: 0,
        records: info.records,
        faces: info.faces,
        bounds: None,
        metres_per_unit: 1.0,
        spacing_m: None,
        density_per_m2: None,
        attributes: info.attributes,
        label_column: None,
        crs: None,
        stations: Vec::new(),
        header: info.header,
        guards: PointGuards::default(),
        usable: false,
        warnings: vec![Warning::new("no-coordinates", error.to_string())],
    })
}
