//! A scan in memory: equal columns of attributes over points in metres, in a [`ScanFrame`].

mod dropped_records;
mod scan_frame;

pub use dropped_records::DroppedRecords;
pub use scan_frame::ScanFrame;

use crate::numeric::Vec3;
use std::path::PathBuf;

/// The fracture label of a point or face: 0 means unlabelled, any other value is a class or fracture id.
pub type Label = u32;

/// Where a run of consecutive points came from.
#[derive(Clone, Debug, PartialEq)]
pub struct SourceFile {
    /// The file as it was named by the user.
    pub path: PathBuf,
    /// Index in the cloud of the first point of this file; its points follow without a gap.
    pub first_point: usize,
    /// How many points of the cloud came from this file.
    pub point_count: usize,
    /// How many records the file holds, dropped ones included.
    pub record_count: u64,
    /// Records that gave no point, e.g. because a coordinate was NaN or they lie outside the part that was read.
    pub dropped_records: DroppedRecords,
}

impl SourceFile {
    /// Zero-based record number in the file of the cloud's point `index`, which must lie in this file's range.
    pub fn record_of(&self, index: usize) -> u64 {
        self.dropped_records.record_of((index - self.first_point) as u64)
    }
}

/// A scan of one scanner setup that a file tells apart from others (E57, PTX, PCD).
#[derive(Clone, Debug, PartialEq)]
pub struct Station {
    /// Name from the file, or a generated one.
    pub name: String,
    /// Position of the scanner in local metres, if the file tells it.
    pub position_in_local: Option<Vec3>,
}

/// The optional attribute columns; each is as long as the cloud when present.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Attributes {
    /// Red, green, blue, full 16-bit range (8-bit sources are scaled by 257).
    pub colors: Option<Vec<[u16; 3]>>,
    /// Intensity or reflectance, full 16-bit range.
    pub intensities: Option<Vec<u16>>,
    /// LAS classification.
    pub classifications: Option<Vec<u8>>,
    /// LAS point source id (often the scan line or station number).
    pub source_ids: Option<Vec<u16>>,
    /// Fracture labels, from the classification or a named scalar column.
    pub labels: Option<Vec<Label>>,
    /// Index into [`Cloud::stations`] of the scanner that saw the point.
    pub station_ids: Option<Vec<u16>>,
}

impl Attributes {
    /// Keeps the rows for which `keep` is true; it has one entry for each.
    pub fn retain(&mut self, keep: &[bool]) {
        fn filter<T>(column: &mut Option<Vec<T>>, keep: &[bool]) {
            let mut kept = keep.iter();
            column.iter_mut().for_each(|c| c.retain(|_| *kept.next().expect("one entry for each row")));
        }
        filter(&mut self.colors, keep);
        filter(&mut self.intensities, keep);
        filter(&mut self.classifications, keep);
        filter(&mut self.source_ids, keep);
        filter(&mut self.labels, keep);
        filter(&mut self.station_ids, keep);
    }
}

/// Points in metres relative to a [`ScanFrame`], with attributes and provenance.
#[derive(Clone, Debug, PartialEq)]
pub struct Cloud {
    frame: ScanFrame,
    positions: Vec<Vec3>,
    attributes: Attributes,
    sources: Vec<SourceFile>,
    stations: Vec<Station>,
}

/// Why columns do not form a cloud.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// A column is longer or shorter than the positions.
    #[error("column '{column}' has {found} values for {expected} points")]
    ColumnLength {
        /// Name of the column.
        column: &'static str,
        /// Its length.
        found: usize,
        /// The number of points.
        expected: usize,
    },
    /// A coordinate is NaN or infinite.
    #[error("point {index} has a coordinate that is not finite: {position:?}")]
    NotFinite {
        /// Index of the point.
        index: usize,
        /// Its coordinates in local metres.
        position: [f64; 3],
    },
    /// The source files do not cover the points in order.
    #[error("source files account for {found} points of {expected}")]
    Sources {
        /// Points accounted for by the sources.
        found: usize,
        /// The number of points.
        expected: usize,
    },
}

impl Cloud {
    /// Proves that all columns have the same length, all positions are finite and the sources cover the points.
    ///
    /// # Errors
    /// [`Error`] names the first column, point or source that does not fit.
    pub fn new(
        frame: ScanFrame,
        positions: Vec<Vec3>,
        attributes: Attributes,
        sources: Vec<SourceFile>,
        stations: Vec<Station>,
    ) -> Result<Self, Error> {
        let n = positions.len();
        let lengths = [
            ("colors", attributes.colors.as_ref().map(Vec::len)),
            ("intensities", attributes.intensities.as_ref().map(Vec::len)),
            ("classifications", attributes.classifications.as_ref().map(Vec::len)),
            ("source_ids", attributes.source_ids.as_ref().map(Vec::len)),
            ("labels", attributes.labels.as_ref().map(Vec::len)),
            ("station_ids", attributes.station_ids.as_ref().map(Vec::len)),
        ];
        for (column, length) in lengths {
            if let Some(found) = length.filter(|&l| l != n) {
                return Err(Error::ColumnLength { column, found, expected: n });
            }
        }
        if let Some(index) = positions.iter().position(|p| !p.iter().all(|c| c.is_finite())) {
            return Err(Error::NotFinite { index, position: positions[index].into() });
        }
        let mut next = 0;
        for source in &sources {
            if source.first_point != next {
                return Err(Error::Sources { found: next, expected: n });
            }
            next += source.point_count;
        }
        if next != n {
            return Err(Error::Sources { found: next, expected: n });
        }
        Ok(Self { frame, positions, attributes, sources, stations })
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether the cloud has no points.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// The frame that takes local metres to the coordinates of the scan.
    pub fn frame(&self) -> &ScanFrame {
        &self.frame
    }

    /// Positions in local metres, in file and record order.
    pub fn positions(&self) -> &[Vec3] {
        &self.positions
    }

    /// The attribute columns.
    pub fn attributes(&self) -> &Attributes {
        &self.attributes
    }

    /// The files that the points came from, in order.
    pub fn sources(&self) -> &[SourceFile] {
        &self.sources
    }

    /// Known scanner positions.
    pub fn stations(&self) -> &[Station] {
        &self.stations
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(n: usize) -> SourceFile {
        SourceFile {
            path: "a.las".into(),
            first_point: 0,
            point_count: n,
            record_count: n as u64,
            dropped_records: DroppedRecords::default(),
        }
    }

    #[test]
    fn columns_must_agree() {
        let attributes = Attributes { labels: Some(vec![1]), ..Default::default() };
        let result = Cloud::new(ScanFrame::local(), vec![Vec3::zeros(); 2], attributes, vec![source(2)], vec![]);
        assert_eq!(result, Err(Error::ColumnLength { column: "labels", found: 1, expected: 2 }));
    }

    #[test]
    fn positions_must_be_finite() {
        let positions = vec![Vec3::zeros(), Vec3::new(0.0, f64::NAN, 0.0)];
        let result = Cloud::new(ScanFrame::local(), positions, Attributes::default(), vec![source(2)], vec![]);
        assert!(matches!(result, Err(Error::NotFinite { index: 1, .. })));
    }

    #[test]
    fn record_numbers_skip_dropped_records() {
        let mut s = source(4);
        s.first_point = 10;
        s.dropped_records = [0, 2, 3].into_iter().collect();
        // Records 0..7 without 0, 2, 3 are 1, 4, 5, 6.
        assert_eq!((10..14).map(|i| s.record_of(i)).collect::<Vec<_>>(), [1, 4, 5, 6]);
    }
}
