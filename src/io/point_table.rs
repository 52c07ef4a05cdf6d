//! Rows of named numbers into columns: shared by all formats that describe their columns by name.

use super::error::Error;
use super::file_scan::{AttributeInfo, FileInfo, FileScan, Settings};
use super::label_column::{self, LabelSource};
use crate::cloud::{Attributes, DroppedRecords};
use crate::numeric::Vec3;
use crate::warning::Warning;
use std::path::Path;

/// How the numbers of a colour channel are meant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum ColorRange {
    /// 0 to 255.
    EightBit,
    /// 0 to 65535.
    SixteenBit,
    /// 0 to 1, or 0 to 255 if larger ones occur.
    Open,
}

/// Which column means what.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Roles {
    pub(super) position: [usize; 3],
    pub(super) color: Option<([usize; 3], ColorRange)>,
    pub(super) intensity: Option<usize>,
    pub(super) classification: Option<usize>,
    pub(super) source_id: Option<usize>,
    pub(super) label: LabelSource,
}

const INTENSITY_NAMES: [&str; 5] = ["intensity", "reflectance", "reflectivity", "amplitude", "remission"];
const CLASS_NAMES: [&str; 2] = ["classification", "class"];
const SOURCE_NAMES: [&str; 3] = ["point_source_id", "pointsourceid", "pointid_source"];
const COLOR_NAMES: [[&str; 3]; 4] = [
    ["red", "green", "blue"],
    ["diffuse_red", "diffuse_green", "diffuse_blue"],
    ["r", "g", "b"],
    ["color_red", "color_green", "color_blue"],
];

impl Roles {
    /// Finds the roles of columns by name; `None` when a coordinate is missing.
    pub(super) fn of(
        path: &Path,
        names: &[String],
        settings: &Settings,
        color_range: impl Fn(usize) -> ColorRange,
    ) -> Result<Option<Self>, Error> {
        let plain: Vec<String> = names.iter().map(|n| n.trim().to_ascii_lowercase()).collect();
        let find = |wanted: &str| plain.iter().position(|n| n.strip_prefix("scalar_").unwrap_or(n) == wanted);
        let first = |wanted: &[&str]| wanted.iter().find_map(|w| find(w));
        let (Some(x), Some(y), Some(z)) = (find("x"), find("y"), find("z")) else { return Ok(None) };
        let color = COLOR_NAMES.iter().find_map(|[r, g, b]| Some([find(r)?, find(g)?, find(b)?]));
        let label = label_column::choose(path, settings, names, first(&CLASS_NAMES).is_some())?;
        Ok(Some(Self {
            position: [x, y, z],
            color: color.map(|c| (c, color_range(c[0]))),
            intensity: first(&INTENSITY_NAMES),
            classification: first(&CLASS_NAMES),
            source_id: first(&SOURCE_NAMES),
            label,
        }))
    }

    /// Whether a column means anything.
    pub(super) fn use_column(&self, column: usize) -> bool {
        let labels = matches!(&self.label, LabelSource::Column { index, .. } if *index == column);
        let single = [self.intensity, self.classification, self.source_id];
        labels
            || self.position.contains(&column)
            || self.color.is_some_and(|(channels, _)| channels.contains(&column))
            || single.contains(&Some(column))
    }
}

/// Colour of points that have none beside points that have one.
pub(super) const MID_GREY: [u16; 3] = [0x8080; 3];

/// Says how many records gave no point.
pub(super) fn dropped(count: u64, of: u64, first: u64, reason: &str) -> Warning {
    Warning::new(
        "dropped-points",
        format!("{count} of {of} points have {reason} and are dropped (the first is record {first})"),
    )
}

/// Says which scans of a file lack what others have.
pub(super) fn mixed_scans(name: &str, filled_with: &str, has: impl Iterator<Item = bool>) -> Option<Warning> {
    let has: Vec<bool> = has.collect();
    let without: Vec<usize> = (0..has.len()).filter(|&i| !has[i]).map(|i| i + 1).collect();
    (!without.is_empty() && without.len() < has.len()).then(|| {
        let text = format!(
            "{} of its {} scans (the first is scan {}) have no {name}; their points are {filled_with}",
            without.len(),
            has.len(),
            without[0]
        );
        Warning::new("mixed-attributes", text)
    })
}

/// Columns being filled.
#[derive(Debug)]
pub(super) struct PointTable {
    positions: Vec<[f64; 3]>,
    colors: Option<Vec<[u16; 3]>>,
    open_colors: Option<Vec<[f32; 3]>>,
    intensities: Option<Vec<f32>>,
    classifications: Option<Vec<u8>>,
    source_ids: Option<Vec<u16>>,
    labels: Option<Vec<u32>>,
    bad_labels: u64,
}

/// A run of rows of a [`PointTable`], disjoint from all others.
pub(super) struct TableSlots<'a> {
    positions: &'a mut [[f64; 3]],
    colors: Option<&'a mut [[u16; 3]]>,
    open_colors: Option<&'a mut [[f32; 3]]>,
    intensities: Option<&'a mut [f32]>,
    classifications: Option<&'a mut [u8]>,
    source_ids: Option<&'a mut [u16]>,
    labels: Option<&'a mut [u32]>,
}

impl PointTable {
    /// `n` rows, to be filled through [`PointTable::slots`].
    pub(super) fn new(n: usize, roles: &Roles) -> Self {
        let open = roles.color.is_some_and(|c| c.1 == ColorRange::Open);
        Self {
            positions: vec![[0.0; 3]; n],
            colors: roles.color.filter(|_| !open).map(|_| vec![[0; 3]; n]),
            open_colors: roles.color.filter(|_| open).map(|_| vec![[0.0; 3]; n]),
            intensities: roles.intensity.map(|_| vec![0.0; n]),
            classifications: roles.classification.map(|_| vec![0; n]),
            source_ids: roles.source_id.map(|_| vec![0; n]),
            labels: roles.label.is_some().then(|| vec![0; n]),
            bad_labels: 0,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.positions.len()
    }

    /// The rows in runs of `run` (the last may be shorter).
    pub(super) fn slots(&mut self, run: usize) -> Vec<TableSlots<'_>> {
        fn runs<T>(column: Option<&mut [T]>, run: usize) -> impl Iterator<Item = Option<&mut [T]>> {
            let mut chunks = column.map(|c| c.chunks_mut(run));
            std::iter::from_fn(move || Some(chunks.as_mut().and_then(Iterator::next)))
        }
        let mut colors = runs(self.colors.as_deref_mut(), run);
        let mut open_colors = runs(self.open_colors.as_deref_mut(), run);
        let mut intensities = runs(self.intensities.as_deref_mut(), run);
        let mut classifications = runs(self.classifications.as_deref_mut(), run);
        let mut source_ids = runs(self.source_ids.as_deref_mut(), run);
        let mut labels = runs(self.labels.as_deref_mut(), run);
        self.positions
            .chunks_mut(run)
            .map(|positions| TableSlots {
                positions,
                colors: colors.next().flatten(),
                open_colors: open_colors.next().flatten(),
                intensities: intensities.next().flatten(),
                classifications: classifications.next().flatten(),
                source_ids: source_ids.next().flatten(),
                labels: labels.next().flatten(),
            })
            .collect()
    }

    pub(super) fn add_bad_labels(&mut self, count: u64) {
        self.bad_labels += count;
    }

    /// Appends the rows of another table; a column that only one of them has is mid grey or zero in the rows of the other.
    pub(super) fn append(&mut self, other: Self) {
        let rows = [self.len(), other.len()];
        fn join<T: Clone>(mine: &mut Option<Vec<T>>, theirs: Option<Vec<T>>, fill: T, rows: [usize; 2]) {
            if mine.is_none() && theirs.is_none() {
                return;
            }
            let column = mine.get_or_insert_with(|| vec![fill.clone(); rows[0]]);
            match theirs {
                Some(theirs) => column.extend(theirs),
                None => column.resize(rows[0] + rows[1], fill),
            }
        }
        self.positions.extend(other.positions);
        join(&mut self.colors, other.colors, MID_GREY, rows);
        join(&mut self.open_colors, other.open_colors, MID_GREY.map(|c| f32::from(c) / 65535.0), rows);
        join(&mut self.intensities, other.intensities, 0.0, rows);
        join(&mut self.classifications, other.classifications, 0, rows);
        join(&mut self.source_ids, other.source_ids, 0, rows);
        join(&mut self.labels, other.labels, 0, rows);
        self.bad_labels += other.bad_labels;
    }

    /// Moves all positions: scanner to scan coordinates.
    pub(super) fn transform(&mut self, from: usize, mut map: impl FnMut(Vec3) -> Vec3) {
        for p in &mut self.positions[from..] {
            *p = map(Vec3::from(*p)).into();
        }
    }

    /// Keeps the rows for which `keep` is true; all columns stay equal.
    fn retain(&mut self, keep: &[bool]) {
        fn filter<T>(column: &mut Vec<T>, keep: &[bool]) {
            let mut index = 0;
            column.retain(|_| {
                index += 1;
                keep[index - 1]
            });
        }
        filter(&mut self.positions, keep);
        self.colors.iter_mut().for_each(|c| filter(c, keep));
        self.open_colors.iter_mut().for_each(|c| filter(c, keep));
        self.intensities.iter_mut().for_each(|c| filter(c, keep));
        self.classifications.iter_mut().for_each(|c| filter(c, keep));
        self.source_ids.iter_mut().for_each(|c| filter(c, keep));
        self.labels.iter_mut().for_each(|c| filter(c, keep));
    }

    /// Drops rows that are not finite, settles colour and intensity ranges, and chooses the origin.
    pub(super) fn finish(
        self,
        roles: &Roles,
        info: FileInfo,
        warnings: Vec<Warning>,
        origin: Option<Vec3>,
    ) -> FileScan {
        self.finish_absolute(roles, info, warnings, "a coordinate that is not a number").relative(origin)
    }

    /// As [`PointTable::finish`], still without an origin; `reason` is what rows without a finite position have.
    pub(super) fn finish_absolute(
        mut self,
        roles: &Roles,
        mut info: FileInfo,
        mut warnings: Vec<Warning>,
        reason: &str,
    ) -> FileScan {
        let record_count = self.len() as u64;
        let finite = |p: &[f64; 3]| p.iter().all(|c| c.is_finite());
        let dropped: DroppedRecords =
            self.positions.iter().enumerate().filter(|(_, p)| !finite(p)).map(|(i, _)| i as u64).collect();
        if let Some(first) = dropped.first() {
            let keep: Vec<bool> = self.positions.iter().map(finite).collect();
            self.retain(&keep);
            warnings.push(self::dropped(dropped.count(), record_count, first, reason));
        }
        if self.bad_labels > 0 {
            warnings.push(label_column::bad_values(self.bad_labels, &roles.label));
        }
        let colors = self.colors.take().or_else(|| self.open_colors.take().map(|c| settle_colors(&c, &mut info)));
        let intensities = self.intensities.take().and_then(|i| settle_intensities(&i, &mut info, &mut warnings));
        info.label_column = roles.label.name();
        if info.records == 0 {
            info.records = record_count;
        }
        let mut attributes = Attributes {
            colors,
            intensities,
            classifications: self.classifications.filter(|c| c.iter().any(|&v| v > 0)),
            source_ids: self.source_ids.filter(|c| c.iter().any(|&v| v > 0)),
            labels: self.labels,
            station_ids: None,
        };
        if attributes.colors.as_ref().is_some_and(|c| !c.is_empty() && c.iter().all(|c| *c == [0; 3])) {
            warnings.push(Warning::new("no-colors", "all colours are zero and are treated as absent"));
            attributes.colors = None;
        }
        FileScan {
            origin: Vec3::zeros(),
            positions: bytemuck::cast_vec(self.positions),
            attributes,
            stations: Vec::new(),
            record_count,
            dropped_records: dropped,
            outside_part: 0,
            info,
            warnings,
        }
    }
}

/// Rows in memory that can be walked column by column.
pub(super) trait ColumnSource {
    /// Calls `put` with the number of each row and its value in a column.
    fn each(&self, column: usize, put: impl FnMut(usize, f64));
}

impl TableSlots<'_> {
    /// Fills all rows column by column; the same as [`TableSlots::set`] for each row, but each column in a loop of its own.
    pub(super) fn set_columns(&mut self, roles: &Roles, bad_labels: &mut u64, source: &impl ColumnSource) {
        let rows = self.len();
        for (axis, &column) in roles.position.iter().enumerate() {
            let slots = &mut self.positions[..rows];
            source.each(column, |row, value| slots[row][axis] = value);
        }
        if let Some((columns, range)) = roles.color {
            for (channel, column) in columns.into_iter().enumerate() {
                if let Some(slots) = &mut self.colors {
                    let scale = if range == ColorRange::EightBit { 257.0 } else { 1.0 };
                    source.each(column, |row, value| slots[row][channel] = (value * scale) as u16);
                } else if let Some(slots) = &mut self.open_colors {
                    source.each(column, |row, value| slots[row][channel] = value as f32);
                }
            }
        }
        if let (Some(column), Some(slots)) = (roles.intensity, &mut self.intensities) {
            source.each(column, |row, value| slots[row] = value as f32);
        }
        if let (Some(column), Some(slots)) = (roles.classification, &mut self.classifications) {
            source.each(column, |row, value| slots[row] = value as u8);
        }
        if let (Some(column), Some(slots)) = (roles.source_id, &mut self.source_ids) {
            source.each(column, |row, value| slots[row] = value as u16);
        }
        if let Some(slots) = &mut self.labels {
            let column = match &roles.label {
                LabelSource::Column { index, .. } => Some(*index),
                _ => roles.classification,
            };
            if let Some(column) = column {
                source.each(column, |row, value| slots[row] = label_column::label_of(value, bad_labels));
            }
        }
    }

    pub(super) fn len(&self) -> usize {
        self.positions.len()
    }

    /// Fills row `row` from numbers by column; bad labels are counted.
    #[inline(always)]
    pub(super) fn set(&mut self, row: usize, roles: &Roles, bad_labels: &mut u64, get: impl Fn(usize) -> f64) {
        self.positions[row] = roles.position.map(&get);
        if let Some((columns, range)) = roles.color {
            if let Some(colors) = &mut self.colors {
                let scale = if range == ColorRange::EightBit { 257.0 } else { 1.0 };
                colors[row] = columns.map(|c| (get(c) * scale).clamp(0.0, 65535.0) as u16);
            } else if let Some(colors) = &mut self.open_colors {
                colors[row] = columns.map(|c| get(c) as f32);
            }
        }
        if let (Some(column), Some(slots)) = (roles.intensity, &mut self.intensities) {
            slots[row] = get(column) as f32;
        }
        if let (Some(column), Some(slots)) = (roles.classification, &mut self.classifications) {
            slots[row] = get(column) as u8;
        }
        if let (Some(column), Some(slots)) = (roles.source_id, &mut self.source_ids) {
            slots[row] = get(column) as u16;
        }
        if let Some(slots) = &mut self.labels {
            let value = match &roles.label {
                LabelSource::Column { index, .. } => get(*index),
                _ => roles.classification.map_or(0.0, &get),
            };
            slots[row] = label_column::label_of(value, bad_labels);
        }
    }
}

fn range(values: impl Iterator<Item = f32>) -> Option<[f32; 2]> {
    let mut range: Option<[f32; 2]> = None;
    for v in values.filter(|v| v.is_finite()) {
        let [low, high] = range.get_or_insert([v, v]);
        *low = low.min(v);
        *high = high.max(v);
    }
    range
}

/// Floating point colours: 0 to 1, or 0 to 255, or 0 to 65535 by the largest value.
fn settle_colors(colors: &[[f32; 3]], info: &mut FileInfo) -> Vec<[u16; 3]> {
    let [low, high] = range(colors.iter().flatten().copied()).unwrap_or([0.0, 0.0]);
    info.attributes.push(AttributeInfo::range("color", f64::from(low), f64::from(high)));
    let scale = match high {
        h if h <= 1.0 => 65535.0,
        h if h <= 255.0 => 257.0,
        _ => 1.0,
    };
    colors.iter().map(|c| c.map(|v| (v * scale).round().clamp(0.0, 65535.0) as u16)).collect()
}

/// Intensities onto 16 bits: kept when they are 16-bit integers, else the range is stretched (and that is said).
fn settle_intensities(values: &[f32], info: &mut FileInfo, warnings: &mut Vec<Warning>) -> Option<Vec<u16>> {
    let [low, high] = range(values.iter().copied())?;
    info.attributes.push(AttributeInfo::range("intensity", f64::from(low), f64::from(high)));
    if low == 0.0 && high == 0.0 {
        warnings.push(Warning::new("no-intensities", "all intensities are zero and are treated as absent"));
        return None;
    }
    if low >= 0.0 && (1.0..=65535.0).contains(&high) && high > 1.0 {
        return Some(values.iter().map(|&v| v.round() as u16).collect());
    }
    let (from, to) = if low >= 0.0 && high <= 1.0 {
        (0.0, 1.0)
    } else if low >= -2048.0 && high <= 2047.0 {
        // The range of PTS files.
        (-2048.0, 2047.0)
    } else {
        warnings.push(Warning::new(
            "intensity-range",
            format!("intensities from {low} to {high} are stretched to 0..65535"),
        ));
        (low, high)
    };
    let scale = 65535.0 / (to - from).max(f32::MIN_POSITIVE);
    Some(values.iter().map(|&v| ((v - from) * scale).round().clamp(0.0, 65535.0) as u16).collect())
}
