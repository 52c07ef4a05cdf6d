//! Files into one cloud: one frame, one unit, equal columns.

use super::detect::{self, Format};
use super::error::Error;
use super::file_scan::{FileInfo, FileScan, Settings};
use super::guards::{self, PointGuards};
use super::part::Part;
use super::point_table::MID_GREY;
use super::poses::Poses;
use super::source_bytes::SourceBytes;
use super::stations::{self, StationOverlap};
use super::{e57, las, pcd, ply, text, unit_guess};
use crate::cloud::{Attributes, Cloud, DroppedRecords, ScanFrame, SourceFile, Station};
use crate::numeric::Vec3;
use crate::warning::Warning;
use serde::Serialize;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// What was read.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The files in the order in which they were given.
    pub files: Vec<FileSummary>,
    /// Points of the cloud.
    pub points: usize,
    /// Names of the attribute columns that the cloud has.
    pub attributes: Vec<&'static str>,
    /// Length of a scan unit in metres.
    pub metres_per_unit: f64,
    /// Origin of the local frame in scan coordinates.
    pub origin_in_scan: [f64; 3],
    /// Lowest and highest scan coordinates.
    pub bounds_in_scan: [[f64; 3]; 2],
    /// Coordinate reference system as the files state it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crs: Option<String>,
    /// Scanner positions known from the files.
    pub stations: usize,
    /// How well stations agree where they overlap.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub overlaps: Vec<StationOverlap>,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// What one file gave.
#[derive(Clone, Debug, Serialize)]
pub struct FileSummary {
    /// The file.
    pub path: PathBuf,
    /// Its format, e.g. `LAZ`.
    pub format: &'static str,
    /// Version of the format, where it has one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub version: Option<String>,
    /// Records in the file.
    pub records: u64,
    /// Points read from it.
    pub points: usize,
    /// Records that gave no point (not a number, or no echo).
    pub dropped: u64,
    /// Records outside the part of the scan that was asked for.
    #[serde(skip_serializing_if = "is_zero")]
    pub outside_part: u64,
    /// Column that labels came from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label_column: Option<String>,
    /// Suspicious points.
    pub guards: PointGuards,
}

/// Reads one or several files as one scan, in a local frame in metres.
///
/// Points come in the order of the files and of their records. The origin of the frame lies on whole units near the
/// first file.
///
/// # Errors
/// [`Error`] names the first file that cannot be used, why, and what to do: missing, empty, truncated or contradictory
/// files, coordinates in degrees, files with different coordinate reference systems, no points at all.
pub fn read_cloud(files: &[PathBuf], settings: &Settings) -> Result<(Cloud, Summary), Error> {
    read_part(files, settings, None)
}

/// As [`read_cloud`], but only the points of a part of the scan; what lies outside is counted.
///
/// # Errors
/// As [`read_cloud`]; also when the scan is in another unit than the part, or nothing of it lies in the part.
pub fn read_part(files: &[PathBuf], settings: &Settings, part: Option<&Part>) -> Result<(Cloud, Summary), Error> {
    let mut whole: Option<Whole> = None;
    let mut warnings = Vec::new();
    let poses = settings.poses.as_deref().map(Poses::read).transpose()?.unwrap_or_default();
    for path in files {
        let origin = whole.as_ref().map(|w| w.scan.origin);
        let of_file = poses.of(path);
        let mut scan = if of_file.is_empty() {
            if let Some(poses) = &settings.poses {
                let text =
                    format!("'{}' names no pose for '{}'; it is left where it is", poses.display(), path.display());
                warnings.push(Warning::new("no-pose", text));
            }
            read_file(path, settings, origin, part)?
        } else {
            // Where its points lie is known when they have been moved.
            of_file.apply(path, read_file(path, settings, None, None)?, origin)?
        };
        refuse_degrees(path, &scan, settings)?;
        if let Some(part) = part {
            check_unit(&scan, settings, part)?;
            scan.keep_part(part);
        }
        let (guards, mut found, sample) = guards::inspect(&scan);
        found.splice(0..0, std::mem::take(&mut scan.warnings));
        for mut warning in found {
            if files.len() > 1 {
                warning.message = format!("{}: {}", path.display(), warning.message);
            }
            warnings.push(warning);
        }
        match &mut whole {
            None => whole = Some(Whole::first(path, scan, guards, sample)),
            Some(whole) => whole.append(path, scan, guards, &mut warnings)?,
        }
    }
    let whole = whole.ok_or_else(|| Error::Settings {
        key: "--input",
        cause: "no scan was named".into(),
        remedy: "name one or several files".into(),
    })?;
    whole.finish(settings, part, warnings)
}

/// Reads one file of any format; a panic in a decoder ends as bad input. With a `part`, points outside it may be missing.
pub(super) fn read_file(
    path: &Path,
    settings: &Settings,
    origin: Option<Vec3>,
    part: Option<&Part>,
) -> Result<FileScan, Error> {
    contained(path, || {
        let source = SourceBytes::open(path)?;
        match detect::format_of(&source)? {
            Format::Las => las::read(&source, settings, origin, part),
            Format::Ply => ply::read(&source, settings, origin),
            Format::E57 => e57::read(&source, settings, origin),
            Format::Ptx => text::read_ptx(&source, settings, origin),
            Format::Pts => text::read_xyz(&source, settings, origin, "PTS"),
            Format::Xyz => text::read_xyz(&source, settings, origin, "XYZ"),
            Format::Pcd => pcd::read(&source, settings, origin),
            Format::Obj | Format::Off | Format::Stl | Format::Glb => Err(Error::unsupported(
                path,
                "it is a mesh, not a point cloud",
                "use `adit unwrap` for meshes, or name a point cloud",
            )),
        }
    })
}

/// Runs a reader; whatever panics in it (decoders of other crates do on damaged files) ends as bad input.
pub(super) fn contained<T>(path: &Path, read: impl FnOnce() -> Result<T, Error>) -> Result<T, Error> {
    super::quiet_panics::quietly(|| catch_unwind(AssertUnwindSafe(read))).unwrap_or_else(|panic| {
        let message = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied())
            .unwrap_or("no message");
        Err(Error::bad(path, format!("its content breaks the decoder ({message})"), super::error::COPY_AGAIN))
    })
}

pub(super) fn refuse_degrees(path: &Path, scan: &FileScan, settings: &Settings) -> Result<(), Error> {
    let Some(crs) = scan.info.crs.as_ref().filter(|c| c.degrees && settings.unit.is_none()) else { return Ok(()) };
    let name: String = crs.text.chars().take(60).collect();
    Err(Error::bad(
        path,
        format!("its coordinates are degrees ({name}), not lengths"),
        "reproject it to a metric system, e.g. `pdal translate IN OUT reprojection --filters.reprojection.out_srs=EPSG:\
         <UTM zone>`, or set ingest.unit if the statement is wrong",
    ))
}

/// The part is told in metres of the scan that the settings assume.
fn check_unit(scan: &FileScan, settings: &Settings, part: &Part) -> Result<(), Error> {
    let metres = settings.unit.map(super::Unit::metres).or(scan.info.crs.as_ref().and_then(|c| c.metres_per_unit));
    let metres = metres.unwrap_or(1.0);
    if (metres - part.metres_per_unit()).abs() < 1e-9 {
        return Ok(());
    }
    Err(Error::Settings {
        key: "ingest.chainage_m",
        cause: format!("the scan states a unit of {metres} m, which must be known before a part of it can be read"),
        remedy: "set ingest.unit".into(),
    })
}

fn is_zero(count: &u64) -> bool {
    *count == 0
}

struct Whole {
    scan: FileScan,
    sources: Vec<SourceFile>,
    files: Vec<FileSummary>,
    low: Vec3,
    high: Vec3,
    /// Some points of the first file, scan coordinates.
    sample: Vec<Vec3>,
}

/// What one file gave.
struct Row {
    first_point: usize,
    points: usize,
    records: u64,
    dropped: DroppedRecords,
    outside_part: u64,
    info: FileInfo,
    guards: PointGuards,
}

impl Whole {
    fn first(path: &Path, scan: FileScan, guards: PointGuards, sample: Vec<Vec3>) -> Self {
        let mut whole = Self {
            sources: Vec::new(),
            files: Vec::new(),
            low: Vec3::repeat(f64::INFINITY),
            high: Vec3::repeat(f64::NEG_INFINITY),
            sample,
            scan,
        };
        let scan = &mut whole.scan;
        let row = Row {
            first_point: 0,
            points: scan.positions.len(),
            records: scan.record_count,
            dropped: std::mem::take(&mut scan.dropped_records),
            outside_part: scan.outside_part,
            info: scan.info.clone(),
            guards,
        };
        whole.note(path, row);
        whole
    }

    fn note(&mut self, path: &Path, row: Row) {
        self.files.push(FileSummary {
            path: path.to_owned(),
            format: row.info.format,
            version: row.info.version,
            records: row.records,
            points: row.points,
            dropped: row.dropped.count() - row.outside_part,
            outside_part: row.outside_part,
            label_column: row.info.label_column,
            guards: row.guards,
        });
        if let Some([low, high]) = row.info.bounds {
            self.low = self.low.inf(&low.into());
            self.high = self.high.sup(&high.into());
        }
        self.sources.push(SourceFile {
            path: path.to_owned(),
            first_point: row.first_point,
            point_count: row.points,
            record_count: row.records,
            dropped_records: row.dropped,
        });
    }

    fn append(
        &mut self,
        path: &Path,
        scan: FileScan,
        guards: PointGuards,
        warnings: &mut Vec<Warning>,
    ) -> Result<(), Error> {
        check_same_crs(&self.files[0].path, &self.scan, path, &scan, warnings)?;
        let before = self.scan.positions.len();
        let added = scan.positions.len();
        let FileScan { positions, attributes, stations, record_count, dropped_records, outside_part, info, .. } = scan;
        self.scan.positions.extend(positions);
        let first_station = self.scan.stations.len() as u16;
        let mine = &mut self.scan.attributes;
        let context = Append { before, added, path };
        context.column("colours", &mut mine.colors, attributes.colors, MID_GREY, Some("mid grey"), warnings);
        context.column("intensities", &mut mine.intensities, attributes.intensities, 0, Some("0"), warnings);
        context.column("classes", &mut mine.classifications, attributes.classifications, 0, None, warnings);
        context.column("source ids", &mut mine.source_ids, attributes.source_ids, 0, None, warnings);
        context.column("labels", &mut mine.labels, attributes.labels, 0, Some("unlabelled"), warnings);
        let ids = attributes.station_ids.map(|ids| ids.into_iter().map(|i| i.saturating_add(first_station)).collect());
        context.column("stations", &mut mine.station_ids, ids, u16::MAX, Some("unknown"), warnings);
        self.scan.stations.extend(stations);
        let dropped = dropped_records;
        let row =
            Row { first_point: before, points: added, records: record_count, dropped, outside_part, info, guards };
        self.note(path, row);
        Ok(())
    }

    fn finish(
        self,
        settings: &Settings,
        part: Option<&Part>,
        mut warnings: Vec<Warning>,
    ) -> Result<(Cloud, Summary), Error> {
        let Self { mut scan, sources, files, low, high, sample } = self;
        let path = &files[0].path;
        if scan.positions.is_empty() {
            let dropped: u64 = files.iter().map(|f| f.dropped).sum();
            if let Some(part) = part.filter(|_| files.iter().any(|f| f.outside_part > 0)) {
                let cause = format!("none of its points lies {}", part.in_words());
                return Err(Error::bad(path, cause, "set ingest.chainage_m to where the scan lies, or leave it out"));
            }
            let cause = if dropped > 0 {
                format!("none of its {dropped} records is a point")
            } else {
                "it has no points".into()
            };
            return Err(Error::bad(path, cause, "export the scan again, with its points"));
        }
        let metres_per_unit = unit_of(&scan, settings, &mut warnings);
        if metres_per_unit != 1.0 {
            scan.positions.iter_mut().for_each(|p| *p *= metres_per_unit);
            scan.stations.iter_mut().filter_map(|s| s.position_in_local.as_mut()).for_each(|p| *p *= metres_per_unit);
        } else if settings.unit.is_none() {
            warnings.extend(unit_guess::of(&(high - low), &sample));
        }
        settle_attributes(&mut scan.attributes, &mut warnings);
        let crs = scan.info.crs.map(|c| c.text);
        let frame = ScanFrame { origin_in_scan: scan.origin, metres_per_unit, crs: crs.clone() };
        let known: Vec<Station> = scan.stations;
        let mut summary = Summary {
            points: scan.positions.len(),
            attributes: names(&scan.attributes),
            metres_per_unit,
            origin_in_scan: scan.origin.into(),
            bounds_in_scan: [low.into(), high.into()],
            crs,
            stations: known.iter().filter(|s| s.position_in_local.is_some()).count(),
            overlaps: Vec::new(),
            files,
            warnings,
        };
        let path = summary.files[0].path.clone();
        let cloud = Cloud::new(frame, scan.positions, scan.attributes, sources, known)
            .map_err(|e| Error::bad(&path, e.to_string(), super::error::COPY_AGAIN))?;
        summary.overlaps = stations::overlaps(&cloud, &mut summary.warnings);
        Ok((cloud, summary))
    }
}

struct Append<'a> {
    before: usize,
    added: usize,
    path: &'a Path,
}

impl Append<'_> {
    /// Appends a column; where only one side has it, the other is filled and that is said.
    fn column<T: Clone>(
        &self,
        name: &str,
        mine: &mut Option<Vec<T>>,
        theirs: Option<Vec<T>>,
        fill: T,
        filled_with: Option<&str>,
        warnings: &mut Vec<Warning>,
    ) {
        let one_sided = mine.is_some() != theirs.is_some();
        if let Some(filled_with) = filled_with.filter(|_| one_sided) {
            let who = if mine.is_some() { "has no" } else { "is the first file with" };
            warnings.push(Warning::new(
                "mixed-attributes",
                format!("{} {who} {name}; points of files without them are {filled_with}", self.path.display()),
            ));
        }
        match (mine.as_mut(), theirs) {
            (None, None) => {}
            (Some(mine), Some(theirs)) => mine.extend(theirs),
            (Some(mine), None) => mine.resize(self.before + self.added, fill),
            (None, Some(theirs)) => {
                let mut column = vec![fill; self.before];
                column.extend(theirs);
                *mine = Some(column);
            }
        }
    }
}

fn check_same_crs(
    first_path: &Path,
    first: &FileScan,
    path: &Path,
    scan: &FileScan,
    warnings: &mut Vec<Warning>,
) -> Result<(), Error> {
    match (&first.info.crs, &scan.info.crs) {
        (Some(a), Some(b)) if a.text != b.text => {
            let short = |t: &str| t.chars().take(60).collect::<String>();
            Err(Error::bad(
                path,
                format!(
                    "its coordinate reference system ({}) differs from that of '{}' ({})",
                    short(&b.text),
                    first_path.display(),
                    short(&a.text)
                ),
                "reproject the files to one system, or read them apart",
            ))
        }
        (Some(_), None) | (None, Some(_)) => {
            warnings.push(Warning::new(
                "mixed-crs",
                format!(
                    "only one of '{}' and '{}' states a coordinate reference system; they are taken to agree",
                    first_path.display(),
                    path.display()
                ),
            ));
            Ok(())
        }
        _ => Ok(()),
    }
}

fn unit_of(scan: &FileScan, settings: &Settings, warnings: &mut Vec<Warning>) -> f64 {
    if let Some(unit) = settings.unit {
        return unit.metres();
    }
    let stated = scan.info.crs.as_ref().and_then(|c| c.metres_per_unit).unwrap_or(1.0);
    if (stated - 1.0).abs() > 1e-12 {
        warnings.push(Warning::new(
            "unit",
            format!(
                "the coordinate reference system states a unit of {stated} m; lengths are converted to metres \
                 (set ingest.unit = \"metre\" if that is wrong)"
            ),
        ));
    }
    stated
}

pub(super) fn eight_bit_colors(largest: u16) -> Warning {
    Warning::new(
        "eight-bit-colors",
        format!("colours reach only {largest} of 65535: they are 8-bit values and are scaled by 257"),
    )
}

/// All-zero colours and intensities are no measurement; 8-bit colours in 16-bit fields are scaled.
fn settle_attributes(attributes: &mut Attributes, warnings: &mut Vec<Warning>) {
    if let Some(colors) = &mut attributes.colors {
        let largest = colors.iter().flatten().copied().max().unwrap_or(0);
        if largest == 0 {
            warnings.push(Warning::new("no-colors", "all colours are zero and are treated as absent"));
            attributes.colors = None;
        } else if largest <= 255 {
            warnings.push(eight_bit_colors(largest));
            colors.iter_mut().flatten().for_each(|c| *c *= 257);
        }
    }
    if attributes.intensities.as_ref().is_some_and(|i| i.iter().all(|&i| i == 0)) {
        warnings.push(Warning::new("no-intensities", "all intensities are zero and are treated as absent"));
        attributes.intensities = None;
    }
}

fn names(attributes: &Attributes) -> Vec<&'static str> {
    let all = [
        ("color", attributes.colors.is_some()),
        ("intensity", attributes.intensities.is_some()),
        ("classification", attributes.classifications.is_some()),
        ("source_id", attributes.source_ids.is_some()),
        ("label", attributes.labels.is_some()),
        ("station", attributes.station_ids.is_some()),
    ];
    all.iter().filter(|a| a.1).map(|a| a.0).collect()
}
