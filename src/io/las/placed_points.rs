//! Positions and map columns of a LAS or LAZ file that a run wrote.

use super::super::error::Error;
use super::super::placed_points::PlacedPoint;
use super::super::source_bytes::SourceBytes;
use super::extra_bytes::ExtraField;
use super::header::{Container, u32_at};
use super::read::extra_fields;
use super::records::Records;
use crate::numeric::Vec3;
use laz::DecompressionSelection;
use rayon::prelude::*;
use std::path::Path;

/// See [`crate::io::placed_points`].
pub(in super::super) fn placed_points(path: &Path, each: &mut dyn FnMut(&[PlacedPoint])) -> Result<(), Error> {
    let source = SourceBytes::open(path)?;
    let container = Container::read(&source)?;
    // Whether the file is still that of the run is told by its hash, not by warnings.
    let records = Records::plan(&source, &container, false, &mut Vec::new())?;
    let (fields, _) = extra_fields(&container);
    // A scan may bring a column of the same name; the run appends its own behind it.
    let column = |name: &str| -> Result<&ExtraField, Error> {
        let found = fields.iter().rev().find(|f| f.name() == name);
        found.ok_or_else(|| {
            Error::bad(path, format!("its records have no column '{name}'"), "run again with --force points")
        })
    };
    let columns = [column("chainage")?, column("girth")?, column("offset")?];
    let selection = DecompressionSelection::base().decompress_z().decompress_extra_bytes();
    let extra_at = container.record_len - container.extra_len();
    let point = |record: &[u8]| {
        let position_in_scan =
            Vec3::from_fn(|k, _| f64::from(u32_at(record, 4 * k) as i32) * container.scale[k] + container.offset[k]);
        let on_map = Vec3::from_fn(|k, _| columns[k].value(&record[extra_at..]).unwrap_or(f64::NAN));
        PlacedPoint { position_in_scan, on_map }
    };
    for group in records.chunks.chunks(rayon::current_num_threads()) {
        let decoded: Vec<Vec<PlacedPoint>> = group
            .par_iter()
            .map(|chunk| {
                let mut points = Vec::with_capacity(chunk.count as usize);
                records.visit(chunk, selection, &mut |_, bytes| {
                    points.extend(bytes.chunks_exact(container.record_len).map(point));
                })?;
                Ok(points)
            })
            .collect::<Result<_, Error>>()?;
        decoded.iter().for_each(|points| each(points));
    }
    Ok(())
}
