//! Records into columns.

use super::super::error::{COPY_AGAIN, Error};
use super::super::file_scan::{FileInfo, FileScan, Settings};
use super::super::label_column::{self, LabelSource};
use super::super::part::Part;
use super::super::source_bytes::SourceBytes;
use super::copc::Nodes;
use super::extra_bytes::{self, ExtraField};
use super::header::Container;
use super::records::{Chunk, Layout, Records};
use crate::cloud::{Attributes, DroppedRecords};
use crate::numeric::Vec3;
use crate::warning::Warning;
use laz::DecompressionSelection;
use rayon::prelude::*;

/// Least and greatest coordinates.
type Bounds = [[f64; 3]; 2];

/// How many points the header counts, and its bounding box in metres; the file holds the points, or (LAZ) the chunks that
/// its table lists.
///
/// With a `part`, the points of the chunks that may hold points of it, as far as the index of a COPC tells.
pub(in super::super) fn announced_points(
    source: &SourceBytes,
    part: Option<&Part>,
) -> Result<(u64, Option<Bounds>), Error> {
    let container = Container::read(source)?;
    let mut records = Records::plan(source, &container, false, &mut Vec::new())?;
    if let Some((part, nodes)) = part.and_then(|part| Some((part, Nodes::of(source, &container)?))) {
        records.keep(|chunk| nodes.may_hold(chunk.begins_at(), |node| part.may_meet(node)));
        return Ok((records.count, None));
    }
    let unit = super::crs::of(&container).and_then(|c| c.metres_per_unit).unwrap_or(1.0);
    let sound =
        (0..3).all(|i| container.max[i] > container.min[i] && (container.max[i] - container.min[i]).is_finite());
    let bounds = sound.then(|| [container.min.map(|v| v * unit), container.max.map(|v| v * unit)]);
    Ok((container.count, bounds))
}

/// Reads one LAS or LAZ file; positions are relative to `origin`, or to one chosen from the header. Chunks of a COPC that
/// lie outside the `part` are not read.
pub(in super::super) fn read(
    source: &SourceBytes,
    settings: &Settings,
    origin: Option<Vec3>,
    part: Option<&Part>,
) -> Result<FileScan, Error> {
    let mut opened = Opened::new(source, settings, origin)?;
    let record_count = opened.records.count;
    let mut left_out = DroppedRecords::default();
    if let Some((part, nodes)) = part.and_then(|part| Some((part, Nodes::of(source, &opened.container)?))) {
        left_out = opened.records.keep(|chunk| nodes.may_hold(chunk.begins_at(), |node| part.may_meet(node)));
    }
    let mut columns = Columns::allocate(source, &opened.records, &opened.layout, &opened.label)?;
    let facts = opened.decoder().decode(&opened.records, &mut columns)?;
    let mut scan = opened.scan(&facts);
    scan.attributes = columns.attributes(&facts);
    scan.positions = bytemuck::cast_vec(columns.positions);
    if !left_out.is_empty() {
        // The box is that of all points.
        scan.warnings.retain(|w| w.code != "las-bounding-box");
    }
    scan.record_count = record_count;
    scan.outside_part = left_out.count();
    scan.dropped_records = left_out;
    Ok(scan)
}

/// A file whose header is understood and whose records are found.
pub(super) struct Opened<'a> {
    pub(super) container: Container,
    pub(super) records: Records<'a>,
    pub(super) fields: Vec<ExtraField>,
    pub(super) layout: Layout,
    pub(super) origin: Vec3,
    label: LabelSource,
    warnings: Vec<Warning>,
}

impl<'a> Opened<'a> {
    pub(super) fn new(source: &'a SourceBytes, settings: &Settings, origin: Option<Vec3>) -> Result<Self, Error> {
        let container = Container::read(source)?;
        let mut warnings = container.warnings.clone();
        let records = Records::plan(source, &container, settings.allow_truncated, &mut warnings)?;
        let (fields, _) = extra_fields(&container);
        let label = label_source(source, settings, &fields)?;
        let layout = Layout::of(container.format);
        let origin = match origin {
            Some(origin) => origin,
            None => choose_origin(&container, &records)?,
        };
        Ok(Self { container, records, fields, layout, origin, label, warnings })
    }

    pub(super) fn decoder(&self) -> Decoder<'_> {
        let label_field = match &self.label {
            LabelSource::Column { index, .. } => Some(&self.fields[*index]),
            _ => None,
        };
        Decoder {
            container: &self.container,
            layout: self.layout,
            label: &self.label,
            label_field,
            origin: self.origin,
        }
    }

    /// What is known about the file after its records were seen, without columns.
    pub(super) fn scan(&self, facts: &Facts) -> FileScan {
        let (container, records) = (&self.container, &self.records);
        let mut warnings = self.warnings.clone();
        check_bounding_box(container, facts, &mut warnings);
        let mut info = info(container, records, &self.fields);
        info.crs = super::crs::of(container);
        if facts.records > 0 {
            let corner = |x: [i32; 3]| [0, 1, 2].map(|i| f64::from(x[i]) * container.scale[i] + container.offset[i]);
            let (a, b) = (corner(facts.min), corner(facts.max));
            // A negative scale swaps the ends.
            info.bounds = Some([[0, 1, 2].map(|i| a[i].min(b[i])), [0, 1, 2].map(|i| a[i].max(b[i]))]);
        }
        info.resolution = container.scale.iter().map(|s| s.abs()).fold(0.0, f64::max);
        if facts.bad_labels > 0 {
            warnings.push(label_column::bad_values(facts.bad_labels, &self.label));
        }
        info.label_column = self.label.name();
        if facts.records > 0 && self.layout.rgb.is_some() && facts.color_max == 0 {
            warnings.push(Warning::new("no-colors", "all colours are zero and are treated as absent"));
        }
        if facts.records > 0 && facts.intensity_max == 0 {
            warnings.push(Warning::new("no-intensities", "all intensities are zero and are treated as absent"));
        }
        FileScan {
            origin: self.origin,
            positions: Vec::new(),
            attributes: Attributes::default(),
            stations: Vec::new(),
            record_count: records.count,
            dropped_records: Default::default(),
            outside_part: 0,
            info,
            warnings,
        }
    }
}

fn info(container: &Container, records: &Records, fields: &[ExtraField]) -> FileInfo {
    let kind = if container.vlr("copc", 1).is_some() {
        "COPC"
    } else if container.compressed {
        "LAZ"
    } else {
        "LAS"
    };
    let mut info = FileInfo::new(kind);
    info.version = Some(format!("1.{}", container.minor));
    info.records = records.count;
    info.header("point_format", container.format);
    info.header("record_bytes", container.record_len);
    info.header("scale", container.scale);
    info.header("offset", container.offset);
    info.header("min", container.min);
    info.header("max", container.max);
    info.header("generating_software", super::header::text(&container.raw[58..90]).trim());
    let all: Vec<String> =
        container.vlrs.iter().chain(&container.evlrs).map(|v| format!("{}:{}", v.user_id(), v.record_id())).collect();
    info.header("variable_length_records", all);
    info.header("extra_bytes", fields.iter().map(ExtraField::name).collect::<Vec<_>>());
    info
}

/// The described extra bytes and how many bytes of a record they describe.
pub(super) fn extra_fields(container: &Container) -> (Vec<ExtraField>, usize) {
    container.vlr("LASF_Spec", 4).map_or((vec![], 0), |v| extra_bytes::parse(&v.data, container.extra_len()))
}

fn label_source(source: &SourceBytes, settings: &Settings, fields: &[ExtraField]) -> Result<LabelSource, Error> {
    let names: Vec<String> =
        fields.iter().map(|f| if (1..=10).contains(&f.data_type()) { f.name() } else { String::new() }).collect();
    label_column::choose(source.path(), settings, &names, true)
}

/// Whole units near the scan: the middle of the header's bounding box if the first record agrees, else that record.
fn choose_origin(container: &Container, records: &Records) -> Result<Vec3, Error> {
    let Some(first) = records.chunks.first() else { return Ok(Vec3::zeros()) };
    let mut position = Vec3::zeros();
    records.visit(&first.head(), DecompressionSelection::all(), &mut |_, bytes| {
        for axis in 0..3 {
            let raw = i32::from_le_bytes(bytes[4 * axis..4 * axis + 4].try_into().expect("four bytes"));
            position[axis] = f64::from(raw) * container.scale[axis] + container.offset[axis];
        }
    })?;
    let inside = (0..3).all(|i| container.min[i] <= position[i] && position[i] <= container.max[i]);
    let middle = Vec3::from_fn(|i, _| (container.min[i] + container.max[i]) / 2.0);
    let near = if inside && middle.iter().all(|c| c.is_finite()) { middle } else { position };
    Ok(super::super::file_scan::whole_units(&near))
}

/// Output columns of all records.
struct Columns {
    positions: Vec<[f64; 3]>,
    colors: Option<Vec<[u16; 3]>>,
    intensities: Vec<u16>,
    classifications: Vec<u8>,
    source_ids: Vec<u16>,
    labels: Option<Vec<u32>>,
}

impl Columns {
    fn allocate(source: &SourceBytes, records: &Records, layout: &Layout, label: &LabelSource) -> Result<Self, Error> {
        let n = records.count as usize;
        // A damaged file fails in its first chunk, before memory is taken for what it promises.
        if let Some(first) = records.chunks.first() {
            records.visit(first, DecompressionSelection::base(), &mut |_, _| {})?;
        }
        let bytes = n.checked_mul(48).ok_or(());
        let room = bytes.and_then(|b| Vec::<u8>::new().try_reserve_exact(b).map_err(|_| ()));
        if room.is_err() {
            let cause =
                format!("{n} points need {} GB of memory, more than there is", records.count * 48 / 1_000_000_000);
            return Err(Error::bad(source.path(), cause, COPY_AGAIN));
        }
        // Zeroed pages come from the system untouched, so the threads that fill them also map them.
        Ok(Self {
            positions: vec![[0.0; 3]; n],
            colors: layout.rgb.map(|_| vec![[0; 3]; n]),
            intensities: vec![0; n],
            classifications: vec![0; n],
            source_ids: vec![0; n],
            labels: label.is_some().then(|| vec![0; n]),
        })
    }

    /// Disjoint slots, one for each chunk.
    fn split(&mut self, chunks: &[Chunk]) -> Vec<Slots<'_>> {
        fn take<'a, T>(rest: &mut &'a mut [T], n: usize) -> &'a mut [T] {
            let (head, tail) = std::mem::take(rest).split_at_mut(n);
            *rest = tail;
            head
        }
        let mut positions = &mut self.positions[..];
        let mut colors = self.colors.as_deref_mut();
        let mut intensities = &mut self.intensities[..];
        let mut classifications = &mut self.classifications[..];
        let mut source_ids = &mut self.source_ids[..];
        let mut labels = self.labels.as_deref_mut();
        let mut slots = Vec::with_capacity(chunks.len());
        for chunk in chunks {
            let n = chunk.count as usize;
            slots.push(Slots {
                positions: take(&mut positions, n),
                colors: colors.as_mut().map(|c| take(c, n)),
                intensities: take(&mut intensities, n),
                classifications: take(&mut classifications, n),
                source_ids: take(&mut source_ids, n),
                labels: labels.as_mut().map(|c| take(c, n)),
            });
        }
        slots
    }

    /// The columns that carry something; all-zero ones are absent.
    fn attributes(&mut self, facts: &Facts) -> Attributes {
        Attributes {
            colors: self.colors.take().filter(|_| facts.color_max > 0),
            intensities: Some(std::mem::take(&mut self.intensities)).filter(|_| facts.intensity_max > 0),
            classifications: Some(std::mem::take(&mut self.classifications)).filter(|_| facts.class_max > 0),
            source_ids: Some(std::mem::take(&mut self.source_ids)).filter(|_| facts.source_max > 0),
            labels: self.labels.take(),
            station_ids: None,
        }
    }
}

/// The slots of one chunk.
struct Slots<'a> {
    positions: &'a mut [[f64; 3]],
    colors: Option<&'a mut [[u16; 3]]>,
    intensities: &'a mut [u16],
    classifications: &'a mut [u8],
    source_ids: &'a mut [u16],
    labels: Option<&'a mut [u32]>,
}

/// What was seen in the records besides their values.
#[derive(Clone, Copy, Debug)]
pub(super) struct Facts {
    pub(super) records: u64,
    pub(super) min: [i32; 3],
    pub(super) max: [i32; 3],
    pub(super) color_max: u16,
    pub(super) intensity_max: u16,
    class_max: u8,
    source_max: u16,
    pub(super) bad_labels: u64,
}

impl Facts {
    pub(super) const NONE: Self = Self {
        records: 0,
        min: [i32::MAX; 3],
        max: [i32::MIN; 3],
        color_max: 0,
        intensity_max: 0,
        class_max: 0,
        source_max: 0,
        bad_labels: 0,
    };

    pub(super) fn merge(mut self, other: Self) -> Self {
        self.records += other.records;
        for axis in 0..3 {
            self.min[axis] = self.min[axis].min(other.min[axis]);
            self.max[axis] = self.max[axis].max(other.max[axis]);
        }
        self.color_max = self.color_max.max(other.color_max);
        self.intensity_max = self.intensity_max.max(other.intensity_max);
        self.class_max = self.class_max.max(other.class_max);
        self.source_max = self.source_max.max(other.source_max);
        self.bad_labels += other.bad_labels;
        self
    }
}

pub(super) struct Decoder<'a> {
    container: &'a Container,
    layout: Layout,
    label: &'a LabelSource,
    label_field: Option<&'a ExtraField>,
    origin: Vec3,
}

impl Decoder<'_> {
    fn decode(&self, records: &Records, columns: &mut Columns) -> Result<Facts, Error> {
        let slots = columns.split(&records.chunks);
        let facts: Vec<Facts> = records
            .chunks
            .par_iter()
            .zip(slots)
            .map(|(chunk, mut slots)| {
                let mut facts = Facts::NONE;
                records.visit(chunk, self.selection(), &mut |first, bytes| {
                    self.decode_piece(bytes, (first - chunk.first) as usize, &mut slots, &mut facts);
                })?;
                Ok(facts)
            })
            .collect::<Result<_, Error>>()?;
        Ok(facts.into_iter().fold(Facts::NONE, Facts::merge))
    }

    /// The fields of layered LAZ that become columns.
    fn selection(&self) -> DecompressionSelection {
        let selection = DecompressionSelection::base()
            .decompress_z()
            .decompress_classification()
            .decompress_intensity()
            .decompress_point_source_id()
            .decompress_rgb();
        if matches!(self.label, LabelSource::Column { .. }) { selection.decompress_extra_bytes() } else { selection }
    }

    /// Positions of whole records, relative to the origin.
    pub(super) fn decode_positions(&self, bytes: &[u8], positions: &mut [[f64; 3]], facts: &mut Facts) {
        let container = self.container;
        let scale = container.scale;
        let shift = [0, 1, 2].map(|i| container.offset[i] - self.origin[i]);
        facts.records += positions.len() as u64;
        let (mut low, mut high) = (facts.min, facts.max);
        for (record, position) in bytes.chunks_exact(container.record_len).zip(positions) {
            let head: &[u8; 12] = record[..12].try_into().expect("records have at least 20 bytes");
            for axis in 0..3 {
                let b = axis * 4;
                let raw = i32::from_le_bytes([head[b], head[b + 1], head[b + 2], head[b + 3]]);
                low[axis] = low[axis].min(raw);
                high[axis] = high[axis].max(raw);
                position[axis] = f64::from(raw) * scale[axis] + shift[axis];
            }
        }
        (facts.min, facts.max) = (low, high);
    }

    /// Counts the values of the label column that are no labels.
    pub(super) fn count_bad_labels(&self, bytes: &[u8], facts: &mut Facts) {
        let Some(field) = self.label_field else { return };
        for record in bytes.chunks_exact(self.container.record_len) {
            if let Some(value) = field.value(&record[self.layout.standard..]) {
                label_column::label_of(value, &mut facts.bad_labels);
            }
        }
    }

    fn decode_piece(&self, bytes: &[u8], at: usize, slots: &mut Slots, facts: &mut Facts) {
        let (layout, container) = (&self.layout, self.container);
        let n = bytes.len() / container.record_len;
        let records = || bytes.chunks_exact(container.record_len);
        self.decode_positions(bytes, &mut slots.positions[at..at + n], facts);
        for (record, intensity) in records().zip(&mut slots.intensities[at..at + n]) {
            *intensity = u16::from_le_bytes([record[12], record[13]]);
            facts.intensity_max = facts.intensity_max.max(*intensity);
        }
        for (record, class) in records().zip(&mut slots.classifications[at..at + n]) {
            *class = record[layout.classification] & layout.classification_mask;
            facts.class_max = facts.class_max.max(*class);
        }
        for (record, id) in records().zip(&mut slots.source_ids[at..at + n]) {
            *id = u16::from_le_bytes([record[layout.source_id], record[layout.source_id + 1]]);
            facts.source_max = facts.source_max.max(*id);
        }
        if let (Some(rgb), Some(colors)) = (layout.rgb, &mut slots.colors) {
            for (record, color) in records().zip(&mut colors[at..at + n]) {
                let c: &[u8; 6] = record[rgb..rgb + 6].try_into().expect("the format has colours");
                *color = [0, 2, 4].map(|b| u16::from_le_bytes([c[b], c[b + 1]]));
                facts.color_max = facts.color_max.max(color[0]).max(color[1]).max(color[2]);
            }
        }
        if let Some(labels) = &mut slots.labels {
            let labels = &mut labels[at..at + n];
            match (self.label, self.label_field) {
                (LabelSource::Column { .. }, Some(field)) => {
                    for (record, label) in records().zip(labels) {
                        if let Some(value) = field.value(&record[layout.standard..]) {
                            *label = label_column::label_of(value, &mut facts.bad_labels);
                        }
                    }
                }
                (LabelSource::Classification, _) => {
                    for (record, label) in records().zip(labels) {
                        *label = u32::from(record[layout.classification] & layout.classification_mask);
                    }
                }
                _ => {}
            }
        }
    }
}

/// The header's box must hold all points, to within a step of the coordinates.
fn check_bounding_box(container: &Container, facts: &Facts, warnings: &mut Vec<Warning>) {
    if facts.records == 0 {
        return;
    }
    let mut worst = 0.0f64;
    for axis in 0..3 {
        let (scale, offset) = (container.scale[axis], container.offset[axis]);
        let ends = [facts.min[axis], facts.max[axis]].map(|v| f64::from(v) * scale + offset);
        let (low, high) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
        let step = scale.abs() * 1.5 + 1e-9 * low.abs().max(high.abs());
        for error in [(container.min[axis] - low).abs(), (container.max[axis] - high).abs()] {
            if error > step || error.is_nan() {
                worst = if error.is_nan() { f64::INFINITY } else { worst.max(error) };
            }
        }
    }
    if worst > 0.0 {
        warnings.push(Warning::new(
            "las-bounding-box",
            format!(
                "the header's bounding box disagrees with the points by up to {worst:.6} units; the points are used"
            ),
        ));
    }
}
