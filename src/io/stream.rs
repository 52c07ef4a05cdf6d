//! Positions of a file in batches, for work that needs one pass: memory stays bounded however long the scan is.
//!
//! LAS, LAZ, COPC and binary PLY are decoded batch by batch, on all threads inside a batch. The other formats are read
//! whole and come as one batch, so their memory is that of [`super::read_cloud`].

use super::assemble::{contained, read_file};
use super::detect::{self, Format};
use super::error::Error;
use super::file_scan::{FileScan, Settings};
use super::source_bytes::SourceBytes;
use super::{las, ply};
use crate::numeric::Vec3;
use std::path::Path;

/// About this many points are in memory at a time.
pub(super) const BATCH: usize = 1 << 20;

/// A box in scan coordinates, its faces included.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScanBox {
    /// Lowest corner.
    pub low: Vec3,
    /// Highest corner.
    pub high: Vec3,
}

impl ScanBox {
    /// Whether a point in scan coordinates lies inside.
    pub fn contains(&self, point: &Vec3) -> bool {
        (0..3).all(|i| self.low[i] <= point[i] && point[i] <= self.high[i])
    }

    /// Whether two boxes share a point.
    pub fn meets(&self, other: &Self) -> bool {
        (0..3).all(|i| self.low[i] <= other.high[i] && other.low[i] <= self.high[i])
    }
}

/// What is known before the first batch.
pub(super) struct Start {
    /// Records that will come, those without a position included.
    pub(super) records: u64,
    /// Positions are relative to this point, in scan units.
    pub(super) origin: Vec3,
    /// Points spread over the file, relative to `origin`; none when the whole file is the first batch.
    pub(super) seeds: Vec<Vec3>,
}

/// Work that needs one pass over the positions of a file.
pub(super) trait Pass {
    fn begin(&mut self, start: Start);
    fn add(&mut self, positions: &[Vec3]);
}

/// What is asked of a pass over a file.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Scope<'a> {
    /// Look at every attribute, not only at the positions, and put its range into [`super::file_scan::FileInfo`].
    pub(super) ranges: bool,
    /// Only points in this box. The index of COPC says which parts of the file hold them; elsewhere all are looked at.
    pub(super) window: Option<&'a ScanBox>,
}

/// Takes all positions of a file through `pass`; the result has no columns, only what is known about the file, and
/// the number of points that came by.
pub(super) fn stream_file(
    path: &Path,
    settings: &Settings,
    scope: Scope,
    pass: &mut dyn Pass,
) -> Result<(FileScan, u64), Error> {
    contained(path, || {
        let source = SourceBytes::open(path)?;
        match detect::format_of(&source)? {
            Format::Las => return las::stream(&source, settings, scope, pass),
            Format::Ply => {
                if let Some(streamed) = ply::stream(&source, settings, scope, pass)? {
                    return Ok(streamed);
                }
            }
            _ => {}
        }
        let mut scan = read_file(path, settings, None, None)?;
        let positions = std::mem::take(&mut scan.positions);
        pass.begin(Start { records: scan.record_count, origin: scan.origin, seeds: Vec::new() });
        let origin = scan.origin;
        Ok(match scope.window {
            None => {
                pass.add(&positions);
                (scan, positions.len() as u64)
            }
            Some(window) => {
                let inside: Vec<Vec3> = positions.into_iter().filter(|p| window.contains(&(p + origin))).collect();
                pass.add(&inside);
                (scan, inside.len() as u64)
            }
        })
    })
}

/// Visits all points of a scan file batch by batch, in file order: `visit` gets positions in scan coordinates relative
/// to an origin, and that origin. Points outside `window`, if there is one, are left out.
///
/// Returns the number of points visited. Poses of `settings` are not applied.
///
/// # Errors
/// As [`super::read_cloud`]; `visit` may have seen some points by then.
pub fn stream_positions(
    path: &Path,
    settings: &Settings,
    window: Option<&ScanBox>,
    visit: &mut dyn FnMut(&[Vec3], &Vec3),
) -> Result<u64, Error> {
    struct Visit<'a> {
        origin: Vec3,
        visit: &'a mut dyn FnMut(&[Vec3], &Vec3),
    }
    impl Pass for Visit<'_> {
        fn begin(&mut self, start: Start) {
            self.origin = start.origin;
        }

        fn add(&mut self, positions: &[Vec3]) {
            (self.visit)(positions, &self.origin);
        }
    }
    let mut pass = Visit { origin: Vec3::zeros(), visit };
    Ok(stream_file(path, settings, Scope { ranges: false, window }, &mut pass)?.1)
}
