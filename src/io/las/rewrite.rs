//! Records back to a file: bit for bit as they were, with columns appended.

use super::super::error::Error;
use super::super::source_bytes::SourceBytes;
use super::super::write::{NO_CLASS, PointColumns, PointOfRecord, WriteSummary};
use super::extra_bytes::{ExtraField, MICROMETRE, ScalarKind};
use super::header::{Container, EVLR_HEADER, VLR_HEADER, Vlr};
use super::read::extra_fields;
use super::records::{Chunk, Layout, Records};
use crate::cloud::{Cloud, SourceFile};
use crate::numeric::Vec3;
use crate::warning::Warning;
use laz::{DecompressionSelection, LazVlr, LazVlrBuilder, ParLasZipCompressor};
use rayon::prelude::*;
use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

/// Names of the appended columns, in their order.
static NAMES: [&str; 5] = ["label", "chainage", "girth", "offset", "surface_class"];

/// Names of the columns that are appended; those of the source with these names give way.
fn appended_names(columns: &PointColumns) -> &'static [&'static str] {
    if columns.surface_classes.is_some() { &NAMES } else { &NAMES[..4] }
}

/// Bytes that the appended columns take in a record.
fn appended_len(columns: &PointColumns) -> usize {
    4 + 8 + 4 + 4 + usize::from(columns.surface_classes.is_some())
}

/// Points of a LAZ chunk; what all readers expect.
const LAZ_CHUNK: usize = 50_000;
/// Bytes of records in flight between decoding and compressing.
const BATCH_BYTES: usize = 48 << 20;

/// Micrometres of a length, or the no-data value when there is none or it does not fit.
fn micrometres(value: f64, kind: ScalarKind) -> i64 {
    let no_data = kind.no_data().unwrap_or(0);
    let scaled = (value / MICROMETRE).round();
    let limit = if kind == ScalarKind::I32Micrometres { f64::from(i32::MAX) } else { 9.0e18 };
    if scaled.abs() <= limit { scaled as i64 } else { no_data }
}

fn append_columns(columns: &PointColumns, point: Option<usize>, out: &mut Vec<u8>) {
    let at = |column: &[f64]| point.map_or(f64::NAN, |p| column[p]);
    out.extend_from_slice(&point.map_or(0, |p| columns.labels[p]).to_le_bytes());
    out.extend_from_slice(&micrometres(at(columns.chainage), ScalarKind::I64Micrometres).to_le_bytes());
    for column in [columns.girth, columns.offset] {
        out.extend_from_slice(&(micrometres(at(column), ScalarKind::I32Micrometres) as i32).to_le_bytes());
    }
    if let Some(classes) = columns.surface_classes {
        out.push(point.map_or(NO_CLASS, |p| classes[p]));
    }
}

/// Descriptors of the appended columns with their ranges.
fn appended_fields(columns: &PointColumns) -> Vec<ExtraField> {
    let range = |values: &[f64], kind: ScalarKind| {
        let mut range: Option<[i64; 2]> = None;
        for raw in values.iter().filter(|v| !v.is_nan()).map(|&v| micrometres(v, kind)) {
            let [low, high] = range.get_or_insert([raw, raw]);
            *low = (*low).min(raw);
            *high = (*high).max(raw);
        }
        range
    };
    let labels = columns.labels.iter().minmax();
    let (long, short) = (ScalarKind::I64Micrometres, ScalarKind::I32Micrometres);
    let mut fields = vec![
        ExtraField::scalar(NAMES[0], ScalarKind::U32, labels, "fracture label, 0: none"),
        ExtraField::scalar(NAMES[1], long, range(columns.chainage, long), "along the axis, m"),
        ExtraField::scalar(NAMES[2], short, range(columns.girth, short), "from crown, + right wall, m"),
        ExtraField::scalar(NAMES[3], short, range(columns.offset, short), "into the void, m"),
    ];
    if let Some(classes) = columns.surface_classes {
        let range = classes.iter().min().zip(classes.iter().max()).map(|(a, b)| [i64::from(*a), i64::from(*b)]);
        // At most 31 characters: 0 wall, 1 floor, 2 furniture, 3 outside, 4 noise.
        let meaning = "wall floor furn. outside noise";
        fields.push(ExtraField::scalar(NAMES[4], ScalarKind::U8, range, meaning));
    }
    fields
}

trait MinMax {
    fn minmax(self) -> Option<[i64; 2]>;
}

impl<'a, I: Iterator<Item = &'a u32>> MinMax for I {
    fn minmax(self) -> Option<[i64; 2]> {
        self.fold(None, |range: Option<[i64; 2]>, &v| {
            let v = i64::from(v);
            Some(range.map_or([v, v], |[low, high]| [low.min(v), high.max(v)]))
        })
    }
}

/// One opened source file.
struct Source<'a> {
    file: &'a SourceFile,
    bytes: SourceBytes,
    container: Container,
    /// Ranges of the extra bytes that are kept.
    kept: Vec<std::ops::Range<usize>>,
    /// Fields that are kept, in their order.
    fields: Vec<ExtraField>,
    replaced: Vec<String>,
}

impl<'a> Source<'a> {
    fn open(file: &'a SourceFile, names: &[&str]) -> Result<Self, Error> {
        let bytes = SourceBytes::open(&file.path)?;
        let container = Container::read(&bytes)?;
        let (described, described_len) = extra_fields(&container);
        let standard = Layout::of(container.format).standard;
        let (mut kept, mut fields, mut replaced) = (Vec::new(), Vec::new(), Vec::new());
        for field in described {
            if names.contains(&field.name().as_str()) {
                replaced.push(field.name());
            } else {
                kept.push(standard + field.at..standard + field.at + field.size());
                fields.push(field);
            }
        }
        // Bytes without a description keep their place through a descriptor of their own.
        let mut at = described_len;
        while at < container.extra_len() {
            let size = (container.extra_len() - at).min(255);
            kept.push(standard + at..standard + at + size);
            fields.push(ExtraField::undocumented(size as u8));
            at += size;
        }
        Ok(Self { file, bytes, container, kept, fields, replaced })
    }

    /// Whether the cloud has the points elsewhere than the file says: a pose was applied when they were read.
    fn is_placed(&self, cloud: &Cloud) -> Result<bool, Error> {
        let records = self.records()?;
        let (container, points) = (&self.container, PointOfRecord::new(self.file));
        let mut placed = false;
        if let Some(first) = records.chunks.first() {
            records.visit(&first.head(), DecompressionSelection::all(), &mut |record, bytes| {
                let Some(point) = points.get(record) else { return };
                let here = cloud.frame().scan_from_local(&cloud.positions()[point]);
                placed = (0..3).any(|axis| {
                    let raw = i32::from_le_bytes(bytes[4 * axis..4 * axis + 4].try_into().expect("four bytes"));
                    let there = f64::from(raw) * container.scale[axis] + container.offset[axis];
                    (here[axis] - there).abs() > 0.01 * container.scale[axis].abs()
                });
            })?;
        }
        Ok(placed)
    }

    fn records(&self) -> Result<Records<'_>, Error> {
        let records = Records::plan(&self.bytes, &self.container, true, &mut Vec::new())?;
        if records.count != self.file.record_count {
            let cause = format!(
                "it has {} records, but {} were read from it before: it changed meanwhile",
                records.count, self.file.record_count
            );
            return Err(Error::bad(&self.file.path, cause, "run again on the new file"));
        }
        Ok(records)
    }
}

/// How integer coordinates of one file become those of the output: whole steps to add, or scale and shift.
enum Requantize {
    Same,
    Shift([i64; 3]),
    Scale { factor: [f64; 3], shift: [f64; 3] },
}

impl Requantize {
    fn between(from: &Container, to: &Container) -> Self {
        if from.scale == to.scale && from.offset == to.offset {
            return Self::Same;
        }
        let shift = [0, 1, 2].map(|i| (from.offset[i] - to.offset[i]) / to.scale[i]);
        if from.scale == to.scale && shift.iter().all(|s| (s - s.round()).abs() < 1e-6) {
            return Self::Shift(shift.map(|s| s.round() as i64));
        }
        Self::Scale { factor: [0, 1, 2].map(|i| from.scale[i] / to.scale[i]), shift }
    }

    /// Changes the coordinates at the head of a record; `false` when one does not fit into 32 bits.
    fn apply(&self, record: &mut [u8]) -> bool {
        if matches!(self, Self::Same) {
            return true;
        }
        for axis in 0..3 {
            let slot = &mut record[4 * axis..4 * axis + 4];
            let raw = i32::from_le_bytes((&*slot).try_into().expect("four bytes"));
            let moved = match self {
                Self::Same => i64::from(raw),
                Self::Shift(shift) => i64::from(raw) + shift[axis],
                Self::Scale { factor, shift } => (f64::from(raw) * factor[axis] + shift[axis]).round() as i64,
            };
            let Ok(moved) = i32::try_from(moved) else { return false };
            slot.copy_from_slice(&moved.to_le_bytes());
        }
        true
    }
}

/// Writes a position into the coordinates at the head of a record; `false` when one does not fit into 32 bits.
fn put_position(container: &Container, position_in_scan: &Vec3, record: &mut [u8]) -> bool {
    for axis in 0..3 {
        let raw = ((position_in_scan[axis] - container.offset[axis]) / container.scale[axis]).round();
        if raw.abs() > f64::from(i32::MAX) {
            return false;
        }
        record[4 * axis..4 * axis + 4].copy_from_slice(&(raw as i32).to_le_bytes());
    }
    true
}

/// Counts and ranges for the header of the output.
#[derive(Clone, Debug)]
struct Tally {
    count: u64,
    by_return: [u64; 15],
    min: [i32; 3],
    max: [i32; 3],
}

impl Tally {
    fn new() -> Self {
        Self { count: 0, by_return: [0; 15], min: [i32::MAX; 3], max: [i32::MIN; 3] }
    }

    fn add(&mut self, record: &[u8], return_mask: u8) {
        self.count += 1;
        let number = usize::from(record[14] & return_mask);
        if (1..=15).contains(&number) {
            self.by_return[number - 1] += 1;
        }
        for axis in 0..3 {
            let raw = i32::from_le_bytes(record[4 * axis..4 * axis + 4].try_into().expect("four bytes"));
            self.min[axis] = self.min[axis].min(raw);
            self.max[axis] = self.max[axis].max(raw);
        }
    }

    fn merge(&mut self, other: &Self) {
        self.count += other.count;
        for (mine, theirs) in self.by_return.iter_mut().zip(other.by_return) {
            *mine += theirs;
        }
        for axis in 0..3 {
            self.min[axis] = self.min[axis].min(other.min[axis]);
            self.max[axis] = self.max[axis].max(other.max[axis]);
        }
    }
}

/// Writes all records of the cloud's LAS or LAZ sources with the columns appended.
pub(in super::super) fn rewrite(
    cloud: &Cloud,
    columns: &PointColumns,
    destination: &Path,
) -> Result<WriteSummary, Error> {
    let sources: Vec<Source> =
        cloud.sources().iter().map(|s| Source::open(s, appended_names(columns))).collect::<Result<_, _>>()?;
    let mut summary = WriteSummary::default();
    let first =
        sources.first().ok_or_else(|| Error::output(destination, "the cloud has no source file", "name one"))?;
    check_one_shape(&sources, destination, &mut summary)?;
    summary.replaced_columns.clone_from(&first.replaced);
    let mut fields = first.fields.clone();
    fields.extend(appended_fields(columns));
    let kept: usize = first.kept.iter().map(|r| r.len()).sum();
    let layout = Layout::of(first.container.format);
    let placed: Vec<bool> = sources.iter().map(|s| s.is_placed(cloud)).collect::<Result<_, _>>()?;
    let mut template = first.container.clone();
    let moved = placed.contains(&true);
    if moved {
        // Scanner coordinates have an offset near the scanner; where the poses put the points, it may be out of reach.
        template.set_offset(cloud.frame().origin_in_scan.into());
    }
    let mut output =
        Output::create(destination, &template, &fields, layout.standard + kept + appended_len(columns), &mut summary)?;
    let record_len = output.record_len;
    for (source, placed) in sources.iter().zip(placed) {
        let records = source.records()?;
        let requantize = Requantize::between(&source.container, &template);
        if placed {
            summary.warnings.push(Warning::new(
                "placed-points",
                format!(
                    "coordinates of '{}' are written where its pose puts them, in steps of {:?}",
                    source.file.path.display(),
                    template.scale
                ),
            ));
        }
        let points = PointOfRecord::new(source.file);
        let encode = |chunk: &Chunk| -> Result<(Vec<u8>, Tally), Error> {
            let mut out = Vec::with_capacity(chunk.count as usize * record_len);
            let mut tally = Tally::new();
            let mut overflow = None;
            records.visit(chunk, DecompressionSelection::all(), &mut |first_record, bytes| {
                for (i, record) in bytes.chunks_exact(source.container.record_len).enumerate() {
                    let start = out.len();
                    out.extend_from_slice(&record[..layout.standard]);
                    let point = points.get(first_record + i as u64);
                    let fits = match point.filter(|_| placed) {
                        Some(p) => put_position(
                            &template,
                            &cloud.frame().scan_from_local(&cloud.positions()[p]),
                            &mut out[start..],
                        ),
                        None => requantize.apply(&mut out[start..]),
                    };
                    if !fits {
                        overflow.get_or_insert(first_record + i as u64);
                    }
                    for range in &source.kept {
                        out.extend_from_slice(&record[range.clone()]);
                    }
                    append_columns(columns, point, &mut out);
                    tally.add(&out[start..], layout.return_mask);
                }
            })?;
            match overflow {
                Some(record) => Err(Error::output(
                    destination,
                    format!(
                        "record {record} of '{}' does not fit into the 32-bit coordinates of '{}'",
                        source.file.path.display(),
                        first.file.path.display()
                    ),
                    "write the files one by one, or give them one offset",
                )),
                None => Ok((out, tally)),
            }
        };
        let batch = (BATCH_BYTES / (LAZ_CHUNK * record_len)).max(1);
        for chunks in records.chunks.chunks(batch) {
            let encoded: Vec<(Vec<u8>, Tally)> = chunks.par_iter().map(encode).collect::<Result<_, _>>()?;
            for (bytes, tally) in &encoded {
                output.push(bytes, tally)?;
            }
        }
    }
    let mut finished = WriteSummary::default();
    output.finish(Some(&first.bytes), &mut finished)?;
    summary.points = finished.points;
    if sources.len() == 1 && !moved {
        // Otherwise counts and ranges must differ from those of the first source.
        summary.warnings.extend(finished.warnings);
    }
    Ok(summary)
}

/// All sources must have records of one shape; coordinates may be stored with other scales and offsets.
fn check_one_shape(sources: &[Source], destination: &Path, summary: &mut WriteSummary) -> Result<(), Error> {
    let first = &sources[0];
    for other in &sources[1..] {
        let names = |s: &Source| s.fields.iter().map(|f| (f.name(), f.data_type(), f.size())).collect::<Vec<_>>();
        if other.container.format != first.container.format || names(other) != names(first) {
            let describe = |s: &Source| {
                let extra: Vec<String> = s.fields.iter().map(ExtraField::name).collect();
                format!("'{}' point format {} with extra bytes {extra:?}", s.file.path.display(), s.container.format)
            };
            let cause = format!("its sources have different records: {}, {}", describe(first), describe(other));
            return Err(Error::output(destination, cause, "lift the files one by one, or convert them to one format"));
        }
        if let Requantize::Scale { .. } = Requantize::between(&other.container, &first.container) {
            summary.warnings.push(Warning::new(
                "requantized",
                format!(
                    "coordinates of '{}' (steps of {:?}) are rounded to the steps of '{}' ({:?})",
                    other.file.path.display(),
                    other.container.scale,
                    first.file.path.display(),
                    first.container.scale
                ),
            ));
        }
    }
    Ok(())
}

enum Points {
    Plain(BufWriter<File>),
    Compressed(Box<ParLasZipCompressor<BufWriter<File>>>),
}

/// A LAS or LAZ file being written.
struct Output<'a> {
    path: &'a Path,
    header: Container,
    record_len: usize,
    points: Points,
    pending: Vec<u8>,
    tally: Tally,
}

impl<'a> Output<'a> {
    fn create(
        path: &'a Path,
        template: &Container,
        fields: &[ExtraField],
        record_len: usize,
        summary: &mut WriteSummary,
    ) -> Result<Self, Error> {
        let compressed = super::super::detect::extension(path) == "laz";
        let mut header = template.clone();
        let is_copc = |v: &Vlr| v.user_id() == "copc";
        if header.vlrs.iter().any(is_copc) {
            summary.warnings.push(Warning::new(
                "copc-index-dropped",
                "the spatial index of the COPC source does not describe the new file and is left out",
            ));
        }
        header.vlrs.retain(|v| !v.is(LazVlr::USER_ID, LazVlr::RECORD_ID) && !is_copc(v));
        let payload: Vec<u8> = fields.iter().flat_map(|f| f.raw.iter().copied()).collect();
        if payload.len() > usize::from(u16::MAX) || record_len > usize::from(u16::MAX) {
            let cause = format!("{} columns of extra bytes are more than LAS can describe", fields.len());
            return Err(Error::output(path, cause, "remove columns from the source"));
        }
        match header.vlrs.iter_mut().find(|v| v.is("LASF_Spec", 4)) {
            _ if fields.is_empty() => {}
            Some(record) => {
                record.header[20..22].copy_from_slice(&(payload.len() as u16).to_le_bytes());
                record.data = payload;
            }
            None => header.vlrs.push(Vlr::new("LASF_Spec", 4, "extra bytes", payload)),
        }
        let mut laz_vlr = None;
        if compressed {
            let extra = (record_len - Layout::of(header.format).standard) as u16;
            let vlr = LazVlrBuilder::default()
                .with_point_format(header.format, extra)
                .map_err(|e| Error::output(path, e.to_string(), "write an uncompressed .las"))?
                .with_fixed_chunk_size(LAZ_CHUNK as u32)
                .build();
            let mut payload = Vec::new();
            vlr.write_to(&mut payload).map_err(|e| Error::write(path, e))?;
            header.vlrs.push(Vlr::new(LazVlr::USER_ID, LazVlr::RECORD_ID, "by Adit", payload));
            laz_vlr = Some(vlr);
        }
        let vlr_bytes: usize = header.vlrs.iter().map(|v| VLR_HEADER + v.data.len()).sum();
        header.points_at = (header.raw.len() + vlr_bytes + header.gap.len()) as u64;
        header.compressed = compressed;
        header.record_len = record_len;
        let file = File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(true)
            .open(path)
            .map_err(|e| Error::write(path, e))?;
        let mut out = BufWriter::with_capacity(1 << 20, file);
        // The header is filled in at the end, when counts and ranges are known.
        let mut head = header.raw.clone();
        for vlr in &header.vlrs {
            head.extend_from_slice(&vlr.header);
            head.extend_from_slice(&vlr.data);
        }
        head.extend_from_slice(&header.gap);
        out.write_all(&head).map_err(|e| Error::write(path, e))?;
        let points = match laz_vlr {
            None => Points::Plain(out),
            Some(vlr) => {
                let compressor = ParLasZipCompressor::new(out, vlr)
                    .map_err(|e| Error::output(path, e.to_string(), "write a .las"))?;
                Points::Compressed(Box::new(compressor))
            }
        };
        Ok(Self { path, header, record_len, points, pending: Vec::new(), tally: Tally::new() })
    }

    fn push(&mut self, records: &[u8], tally: &Tally) -> Result<(), Error> {
        self.tally.merge(tally);
        let written = match &mut self.points {
            Points::Plain(out) => out.write_all(records),
            Points::Compressed(compressor) => {
                self.pending.extend_from_slice(records);
                // Whole chunks only: then all of them compress in parallel.
                let whole = self.pending.len() / (LAZ_CHUNK * self.record_len) * LAZ_CHUNK * self.record_len;
                if self.pending.len() < BATCH_BYTES || whole == 0 {
                    return Ok(());
                }
                let written = compressor.compress_many(&self.pending[..whole]);
                self.pending.drain(..whole);
                written
            }
        };
        written.map_err(|e| Error::write(self.path, e))
    }

    /// Writes what follows the points, then the header.
    fn finish(mut self, source: Option<&SourceBytes>, summary: &mut WriteSummary) -> Result<(), Error> {
        let path = self.path;
        let fail = |e: std::io::Error| Error::write(path, e);
        let mut out = match self.points {
            Points::Plain(out) => out,
            Points::Compressed(mut compressor) => {
                compressor.compress_many(&self.pending).map_err(fail)?;
                self.pending = Vec::new();
                compressor.done().map_err(|e| fail(std::io::Error::other(e.to_string())))?;
                compressor.into_inner()
            }
        };
        let mut at = out.stream_position().map_err(fail)?;
        let old = self.header.clone();
        if let Some(source) = source {
            self.header.evlr_count = 0;
            self.header.evlrs_at = 0;
            for (record, &[from, len]) in old.evlrs.iter().zip(&old.evlr_spans) {
                if record.user_id() == "copc" || record.is("LASF_Spec", 4) {
                    continue;
                }
                if self.header.evlr_count == 0 {
                    self.header.evlrs_at = at;
                }
                self.header.evlr_count += 1;
                if (from..from + len).contains(&old.waveform_at) {
                    self.header.waveform_at = at + (old.waveform_at - from);
                }
                copy(source, from, len, &mut out, path)?;
                at += len;
            }
            let inside_records =
                old.evlr_spans.iter().any(|&[from, len]| (from..from + len).contains(&old.waveform_at));
            if old.waveform_at >= old.points_at.min(EVLR_HEADER as u64)
                && old.waveform_at > 0
                && !inside_records
                && old.waveform_at < source.len()
            {
                self.header.waveform_at = at;
                copy(source, old.waveform_at, source.len() - old.waveform_at, &mut out, path)?;
            }
        }
        patch_header(&mut self.header, &self.tally, summary);
        out.seek(SeekFrom::Start(0)).map_err(fail)?;
        out.write_all(&self.header.raw).map_err(fail)?;
        out.into_inner().map_err(|e| fail(e.into_error()))?.sync_all().map_err(fail)?;
        summary.points = self.tally.count;
        Ok(())
    }
}

fn copy(source: &SourceBytes, from: u64, len: u64, out: &mut BufWriter<File>, destination: &Path) -> Result<(), Error> {
    const BLOCK: u64 = 1 << 20;
    let mut done = 0;
    while done < len {
        let block = source.bytes(from + done, (len - done).min(BLOCK) as usize)?;
        out.write_all(&block).map_err(|e| Error::write(destination, e))?;
        done += block.len() as u64;
    }
    Ok(())
}

/// Brings the header's fields into agreement with what was written; fields that were right keep their bits.
fn patch_header(header: &mut Container, tally: &Tally, summary: &mut WriteSummary) {
    fn put(raw: &mut [u8], at: usize, bytes: &[u8]) {
        raw[at..at + bytes.len()].copy_from_slice(bytes);
    }
    let Container { minor, format, scale, offset, points_at, record_len, compressed, .. } = *header;
    let (low, high) = (header.min, header.max);
    let (evlrs_at, evlr_count, waveform_at) = (header.evlrs_at, header.evlr_count, header.waveform_at);
    let vlr_count = header.vlrs.len() as u32;
    let raw = &mut header.raw;
    put(raw, 96, &(points_at as u32).to_le_bytes());
    put(raw, 100, &vlr_count.to_le_bytes());
    raw[104] = format | if compressed { 0x80 } else { 0 };
    put(raw, 105, &(record_len as u16).to_le_bytes());
    let mut corrected = Vec::new();
    let legacy_count = u32::try_from(tally.count).unwrap_or(0);
    let legacy_returns = [0, 1, 2, 3, 4].map(|i| u32::try_from(tally.by_return[i]).unwrap_or(0));
    let stored_legacy = super::header::u32_at(raw, 107);
    // From LAS 1.4 on the legacy fields may be left zero.
    if stored_legacy != legacy_count && !(minor >= 4 && stored_legacy == 0) {
        put(raw, 107, &legacy_count.to_le_bytes());
        corrected.push("point count");
    }
    let stored: Vec<u32> = (0..5).map(|i| super::header::u32_at(raw, 111 + 4 * i)).collect();
    if stored != legacy_returns && !(minor >= 4 && stored.iter().all(|&s| s == 0)) {
        for (i, n) in legacy_returns.iter().enumerate() {
            put(raw, 111 + 4 * i, &n.to_le_bytes());
        }
        corrected.push("points by return");
    }
    if minor >= 3 {
        put(raw, 227, &waveform_at.to_le_bytes());
    }
    if minor >= 4 {
        put(raw, 235, &evlrs_at.to_le_bytes());
        put(raw, 243, &evlr_count.to_le_bytes());
        put(raw, 247, &tally.count.to_le_bytes());
        for (i, n) in tally.by_return.iter().enumerate() {
            if super::header::u64_at(raw, 255 + 8 * i) != *n {
                put(raw, 255 + 8 * i, &n.to_le_bytes());
                corrected.push("points by return");
            }
        }
    }
    for axis in 0..3 {
        if tally.count == 0 {
            break;
        }
        let ends = [tally.min[axis], tally.max[axis]].map(|v| f64::from(v) * scale[axis] + offset[axis]);
        let ends = [ends[0].min(ends[1]), ends[0].max(ends[1])];
        let near = |stored: f64, found: f64| (stored - found).abs() <= scale[axis].abs() * 0.5 + 1e-12 * found.abs();
        if !near(low[axis], ends[0]) || !near(high[axis], ends[1]) {
            put(raw, 179 + 16 * axis, &ends[1].to_le_bytes());
            put(raw, 187 + 16 * axis, &ends[0].to_le_bytes());
            corrected.push("bounding box");
        }
    }
    corrected.dedup();
    if !corrected.is_empty() {
        summary.warnings.push(Warning::new(
            "las-header-corrected",
            format!("the source's header was wrong and is corrected in the copy: {}", corrected.join(", ")),
        ));
    }
}

/// Writes a cloud as LAS 1.4, point format 7 with colours and 6 without.
pub(in super::super) fn write_new(
    cloud: &Cloud,
    columns: Option<&PointColumns>,
    destination: &Path,
    step_m: f64,
) -> Result<WriteSummary, Error> {
    let frame = cloud.frame();
    let attributes = cloud.attributes();
    let format = if attributes.colors.is_some() { 7 } else { 6 };
    let layout = Layout::of(format);
    let step = step_m / frame.metres_per_unit;
    // A power of ten: coordinates read back as the decimal numbers that people expect.
    let step = 10f64.powf(step.log10().round());
    let origin = frame.origin_in_scan;
    let mut summary = WriteSummary::default();
    let own_labels = attributes.labels.as_deref().filter(|_| columns.is_none());
    let fields = match (columns, own_labels) {
        (Some(columns), _) => appended_fields(columns),
        (None, Some(labels)) => {
            vec![ExtraField::scalar(NAMES[0], ScalarKind::U32, labels.iter().minmax(), "fracture label, 0: none")]
        }
        (None, None) => vec![],
    };
    let extra = columns.map_or(fields.len() * 4, appended_len);
    let record_len = layout.standard + extra;
    let header = new_header(format, record_len, [step; 3], origin.into(), frame.crs.as_deref());
    let mut output = Output::create(destination, &header, &fields, record_len, &mut summary)?;
    // The header was made without counts; filling them in is no correction.
    let mut silent = WriteSummary::default();
    let encode = |first: usize, last: usize| -> Result<(Vec<u8>, Tally), Error> {
        let mut out = Vec::with_capacity((last - first) * record_len);
        let mut tally = Tally::new();
        for i in first..last {
            let start = out.len();
            let p = cloud.positions()[i] / frame.metres_per_unit;
            for c in p.iter() {
                let raw = (c / step).round();
                if raw.abs() > f64::from(i32::MAX) {
                    let cause = format!("point {i} lies {c} units from the origin, too far for steps of {step}");
                    return Err(Error::output(destination, cause, "write a .ply"));
                }
                out.extend_from_slice(&(raw as i32).to_le_bytes());
            }
            let at16 = |column: &Option<Vec<u16>>| column.as_ref().map_or(0, |c| c[i]).to_le_bytes();
            out.extend_from_slice(&at16(&attributes.intensities));
            // Return 1 of 1, no flags, class, user data and scan angle.
            out.extend_from_slice(&[0x11, 0, attributes.classifications.as_ref().map_or(0, |c| c[i]), 0, 0, 0]);
            out.extend_from_slice(&at16(&attributes.source_ids));
            out.extend_from_slice(&[0; 8]);
            if let Some(colors) = &attributes.colors {
                for c in colors[i] {
                    out.extend_from_slice(&c.to_le_bytes());
                }
            }
            match (columns, own_labels) {
                (Some(columns), _) => append_columns(columns, Some(i), &mut out),
                (None, Some(labels)) => out.extend_from_slice(&labels[i].to_le_bytes()),
                (None, None) => {}
            }
            tally.add(&out[start..], layout.return_mask);
        }
        Ok((out, tally))
    };
    let starts: Vec<usize> = (0..cloud.len()).step_by(LAZ_CHUNK).collect();
    let batch = (BATCH_BYTES / (LAZ_CHUNK * record_len)).max(1);
    for starts in starts.chunks(batch) {
        let encoded: Vec<(Vec<u8>, Tally)> = starts
            .par_iter()
            .map(|&first| encode(first, (first + LAZ_CHUNK).min(cloud.len())))
            .collect::<Result<_, _>>()?;
        for (bytes, tally) in &encoded {
            output.push(bytes, tally)?;
        }
    }
    output.finish(None, &mut silent)?;
    summary.points = silent.points;
    Ok(summary)
}

/// The header of a new LAS 1.4 file without points.
fn new_header(format: u8, record_len: usize, scale: [f64; 3], offset: [f64; 3], crs: Option<&str>) -> Container {
    const SIZE: usize = 375;
    let wkt = crs.filter(|c| c.contains('[') && c.ends_with(']'));
    let mut raw = vec![0; SIZE];
    raw[..4].copy_from_slice(b"LASF");
    // Formats from 6 on must state coordinate systems as WKT.
    raw[6..8].copy_from_slice(&(1u16 << 4).to_le_bytes());
    raw[24] = 1;
    raw[25] = 4;
    raw[26..30].copy_from_slice(b"Adit");
    let software = concat!("Adit ", env!("CARGO_PKG_VERSION")).as_bytes();
    raw[58..58 + software.len()].copy_from_slice(software);
    raw[94..96].copy_from_slice(&(SIZE as u16).to_le_bytes());
    for axis in 0..3 {
        raw[131 + 8 * axis..139 + 8 * axis].copy_from_slice(&scale[axis].to_le_bytes());
        raw[155 + 8 * axis..163 + 8 * axis].copy_from_slice(&offset[axis].to_le_bytes());
    }
    let vlrs = wkt.map(|w| {
        let mut data = w.as_bytes().to_vec();
        data.push(0);
        data
    });
    let vlrs = vlrs.filter(|d| d.len() <= usize::from(u16::MAX));
    Container {
        raw,
        minor: 4,
        format,
        compressed: false,
        record_len,
        count: 0,
        scale,
        offset,
        min: [f64::NAN; 3],
        max: [f64::NAN; 3],
        vlrs: vlrs.map(|d| Vlr::new("LASF_Projection", 2112, "WKT", d)).into_iter().collect(),
        gap: Vec::new(),
        points_at: SIZE as u64,
        evlrs: Vec::new(),
        evlr_spans: Vec::new(),
        evlrs_at: 0,
        evlr_count: 0,
        waveform_at: 0,
        warnings: Vec::new(),
    }
}
