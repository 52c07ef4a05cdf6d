//! Positions of binary PLY files batch by batch, and the ranges of all columns on the way.

use super::super::error::Error;
use super::super::file_scan::{AttributeInfo, FileScan, Settings, whole_units};
use super::super::label_column::{self, LabelSource};
use super::super::point_table::{self, ColorRange, Roles};
use super::super::source_bytes::SourceBytes;
use super::super::stream::{BATCH, Pass, Scope, Start};
use super::header::{Encoding, Header, Kind, Scalar};
use super::read::{RUN, info, places};
use crate::cloud::Attributes;
use crate::numeric::Vec3;
use crate::warning::Warning;
use rayon::prelude::*;

/// Takes the positions of a binary PLY file through `pass`, batch by batch; `None` for other encodings.
///
/// Returns what is known about the file and the number of points.
pub(in super::super) fn stream(
    source: &SourceBytes,
    settings: &Settings,
    scope: Scope,
    pass: &mut dyn Pass,
) -> Result<Option<(FileScan, u64)>, Error> {
    /// Points that a pass gets beforehand, at most.
    const SEEDS: u64 = 48;
    let mut header = Header::read(source)?;
    let Some((0, vertices)) = header.element("vertex") else { return Ok(None) };
    let vertices = vertices.clone();
    let Some(stride) = vertices.stride().filter(|_| header.encoding != Encoding::Ascii) else { return Ok(None) };
    let names: Vec<String> = vertices.properties.iter().map(|p| p.name.clone()).collect();
    let color_range = |_: usize| ColorRange::SixteenBit;
    // What is wrong with the columns is told by the reader for the whole file.
    let Some(roles) = Roles::of(source.path(), &names, settings, color_range)? else { return Ok(None) };
    let mut info = info(&header);
    info.single_precision = roles.position.iter().any(|&c| vertices.properties[c].kind == Kind::Scalar(Scalar::F32));
    info.label_column = roles.label.name();
    let columns = places(&vertices);
    let big_endian = header.big_endian();
    let count = vertices.count;
    let at = |record: &[u8], column: usize| columns[column].1.get(&record[columns[column].0..], big_endian);
    let position = |record: &[u8]| Vec3::from(roles.position.map(|c| at(record, c)));
    let finite = |p: &Vec3| p.iter().all(|c| c.is_finite());
    let record = |k: u64| source.bytes(header.data_at + k * stride as u64, stride);
    let mut spread = Vec::new();
    for k in 0..SEEDS.min(count) {
        spread.push(position(&record(k * count / SEEDS.min(count))?));
    }
    spread.retain(finite);
    let origin = spread.first().map_or_else(Vec3::zeros, whole_units);
    let seeds = if count as usize <= BATCH { Vec::new() } else { spread.iter().map(|p| p - origin).collect() };
    pass.begin(Start { records: count, origin, seeds });
    let empty = || vec![[f64::INFINITY, f64::NEG_INFINITY]; columns.len()];
    let (mut ranges, mut bad_labels, mut dropped, mut given) = (empty(), 0u64, None::<(u64, u64)>, 0u64);
    let (mut low, mut high) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
    let runs: Vec<u64> = (0..count).step_by(RUN).collect();
    for batch in runs.chunks(BATCH / RUN) {
        let found = batch
            .par_iter()
            .map(|&first| {
                let n = (count - first).min(RUN as u64);
                let bytes = source.bytes(header.data_at + first * stride as u64, n as usize * stride)?;
                let (mut ranges, mut bad_labels) = (empty(), 0);
                if scope.ranges {
                    for (range, &(at, scalar)) in ranges.iter_mut().zip(&columns) {
                        let [mut low, mut high] = *range;
                        scalar.column(&bytes, stride, at, big_endian, |_, value| {
                            low = low.min(value);
                            high = high.max(value);
                        });
                        *range = [low, high];
                    }
                    if let LabelSource::Column { index, .. } = roles.label {
                        for record in bytes.chunks_exact(stride) {
                            label_column::label_of(at(record, index), &mut bad_labels);
                        }
                    }
                }
                let mut positions = vec![Vec3::zeros(); n as usize];
                for (axis, &column) in roles.position.iter().enumerate() {
                    let (at, scalar) = columns[column];
                    scalar.column(&bytes, stride, at, big_endian, |row, value| positions[row][axis] = value);
                }
                let first_bad = positions.iter().position(|p| !finite(p)).map(|i| first + i as u64);
                Ok((ranges, bad_labels, positions, first_bad))
            })
            .collect::<Result<Vec<_>, Error>>()?;
        let mut positions = Vec::with_capacity(BATCH);
        for (theirs, bad, mut run, first_bad) in found {
            for (mine, theirs) in ranges.iter_mut().zip(theirs) {
                *mine = [mine[0].min(theirs[0]), mine[1].max(theirs[1])];
            }
            bad_labels += bad;
            if let Some(first_bad) = first_bad {
                let before = run.len();
                run.retain(finite);
                let (_, sum) = dropped.get_or_insert((first_bad, 0));
                *sum += (before - run.len()) as u64;
            }
            for p in &run {
                (low, high) = (low.inf(p), high.sup(p));
            }
            positions.extend(run.iter().filter(|p| scope.window.is_none_or(|w| w.contains(p))).map(|p| p - origin));
        }
        given += positions.len() as u64;
        pass.add(&positions);
    }
    let mut warnings = std::mem::take(&mut header.warnings);
    if let Some((first, sum)) = dropped {
        warnings.push(point_table::dropped(sum, count, first, "a coordinate that is not a number"));
    }
    if bad_labels > 0 {
        warnings.push(label_column::bad_values(bad_labels, &roles.label));
    }
    if low <= high {
        info.bounds = Some([low.into(), high.into()]);
    }
    for (property, [low, high]) in vertices.properties.iter().zip(&ranges) {
        info.attributes.push(if low <= high {
            AttributeInfo::range(&property.name, *low, *high)
        } else {
            AttributeInfo::present(&property.name)
        });
    }
    let known = |columns: &[usize], code, what: &str| {
        let zero = count > 0 && scope.ranges && columns.iter().all(|&c| ranges[c] == [0.0, 0.0]);
        zero.then(|| Warning::new(code, format!("all {what} are zero and are treated as absent")))
    };
    warnings.extend(roles.color.and_then(|(c, _)| known(&c, "no-colors", "colours")));
    warnings.extend(roles.intensity.and_then(|c| known(&[c], "no-intensities", "intensities")));
    let scan = FileScan {
        origin,
        positions: Vec::new(),
        attributes: Attributes::default(),
        stations: Vec::new(),
        record_count: count,
        dropped_records: Default::default(),
        outside_part: 0,
        info,
        warnings,
    };
    Ok(Some((scan, given)))
}
