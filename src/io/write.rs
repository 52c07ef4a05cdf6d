//! Points back to files: every record as it was, plus what the map knows about it.

use super::detect::{self, Format};
use super::error::Error;
use super::source_bytes::SourceBytes;
use super::{las, ply};
use crate::cloud::{Cloud, Label};
use crate::warning::Warning;
use serde::Serialize;
use std::path::Path;

/// What is written beside each point of a cloud; every column is as long as the cloud.
#[derive(Clone, Copy, Debug)]
pub struct PointColumns<'a> {
    /// Label, 0 for none.
    pub labels: &'a [Label],
    /// Chainage in metres; NaN for points without an anchor.
    pub chainage: &'a [f64],
    /// Girth from the crown in metres; NaN for points without an anchor.
    pub girth: &'a [f64],
    /// Distance from the surface along its normal in metres; NaN for points without an anchor.
    pub offset: &'a [f64],
    /// What the point was taken for (codes of `segment::Class`, [`NO_CLASS`] for none), when that is known.
    pub surface_classes: Option<&'a [u8]>,
}

/// The surface class of a point that was not classified.
pub const NO_CLASS: u8 = u8::MAX;

impl PointColumns<'_> {
    fn check(&self, cloud: &Cloud, destination: &Path) -> Result<(), Error> {
        let classes = self.surface_classes.map_or(cloud.len(), <[u8]>::len);
        let lengths = [self.labels.len(), self.chainage.len(), self.girth.len(), self.offset.len(), classes];
        if lengths.iter().all(|&l| l == cloud.len()) {
            return Ok(());
        }
        let cause = format!("columns of {lengths:?} values do not belong to {} points", cloud.len());
        Err(Error::output(destination, cause, "this is an error in the program"))
    }
}

/// What was written.
#[derive(Clone, Debug, Default, Serialize)]
pub struct WriteSummary {
    /// Points written.
    pub points: u64,
    /// Columns of the source that were replaced because they have the name of a new one.
    pub replaced_columns: Vec<String>,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Writes every input point, in the order of the files and records, with the given columns.
///
/// LAS and LAZ sources keep version, scale, offset, variable length records, extra bytes and every record bit for bit;
/// `label` (`u32`), `chainage` (64-bit micrometres), `girth` and `offset` (32-bit micrometres) are appended as named
/// extra bytes, and `surface_class` (`u8`) when the classes are known. PLY sources keep all properties and elements, the columns are appended as `uint label` and
/// `double chainage girth offset` (NaN for none), `uchar surface_class`. Columns of these names that a source already has are replaced.
/// Points of other formats are written as LAS 1.4. The destination's extension chooses LAZ, LAS or PLY.
///
/// The file is written in one pass with bounded memory. It is not renamed: give a temporary name and rename it.
///
/// # Errors
/// [`Error`] when a source has changed since it was read, sources do not fit into one file, or the destination cannot
/// be written.
pub fn write_points(cloud: &Cloud, columns: &PointColumns, destination: &Path) -> Result<WriteSummary, Error> {
    columns.check(cloud, destination)?;
    let mut formats = Vec::new();
    for source in cloud.sources() {
        formats.push(detect::format_of(&SourceBytes::open(&source.path)?)?);
    }
    let all = |format: Format| formats.iter().all(|f| *f == format);
    match detect::extension(destination).as_str() {
        "las" | "laz" if all(Format::Las) => las::rewrite(cloud, columns, destination),
        "ply" if all(Format::Ply) => ply::rewrite(cloud, columns, destination),
        _ => write_cloud(cloud, Some(columns), destination),
    }
}

/// Steps of the coordinates in new LAS files, metres: a tenth of a millimetre.
const NEW_STEP_M: f64 = 1e-4;

/// Writes a cloud as a new file: LAS 1.4 (LAS, LAZ) or binary little endian PLY, by the destination's extension.
///
/// Coordinates are written in scan units: exactly in PLY, in steps of a tenth of a millimetre in LAS. Without
/// `columns`, the cloud's own labels are written as `label` if it has any.
///
/// # Errors
/// [`Error`] when the destination cannot be written or its extension is none of `las`, `laz`, `ply`.
pub fn write_cloud(cloud: &Cloud, columns: Option<&PointColumns>, destination: &Path) -> Result<WriteSummary, Error> {
    write_cloud_in_steps(cloud, columns, destination, NEW_STEP_M)
}

/// [`write_cloud`] with LAS coordinates in steps of about `step_m` (the nearest power of ten in scan units): coarser
/// steps make smaller LAZ files.
///
/// # Errors
/// As [`write_cloud`].
pub fn write_cloud_in_steps(
    cloud: &Cloud,
    columns: Option<&PointColumns>,
    destination: &Path,
    step_m: f64,
) -> Result<WriteSummary, Error> {
    if let Some(columns) = columns {
        columns.check(cloud, destination)?;
    }
    match detect::extension(destination).as_str() {
        "las" | "laz" => las::write_new(cloud, columns, destination, step_m),
        "ply" => ply::write_new(cloud, columns, destination),
        other => {
            Err(Error::output(destination, format!("'.{other}' is no point format"), "name it .laz, .las or .ply"))
        }
    }
}

/// The cloud's point of a record, for records in order: dropped records have none.
pub(super) struct PointOfRecord<'a> {
    first_point: usize,
    dropped: &'a crate::cloud::DroppedRecords,
}

impl<'a> PointOfRecord<'a> {
    pub(super) fn new(source: &'a crate::cloud::SourceFile) -> Self {
        Self { first_point: source.first_point, dropped: &source.dropped_records }
    }

    /// Index of the point, `None` when the record was dropped.
    pub(super) fn get(&self, record: u64) -> Option<usize> {
        self.dropped.point_of(record).map(|point| self.first_point + point as usize)
    }
}
