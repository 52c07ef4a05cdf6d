//! LAS 1.0 to 1.4 and LAZ: all point formats, extra bytes, coordinate systems; records are rewritten bit for bit.
//!
//! When to use: the default format of scans and of the lifted points.
//! Reference: ASPRS, *LAS Specification 1.4 - R15* (2019); M. Isenburg, *LASzip: lossless compression of lidar data*,
//! Photogrammetric Engineering & Remote Sensing 79 (2013), 209-217. The arithmetic decoding is done by the `laz` crate;
//! everything around it (header, records, chunks, columns) is done here, so that nothing is lost on the way back, and so is the
//! decoding of GPS times and of the points of formats 6 to 10, so that damage cannot end the process.
//! Guarantees: no header count is trusted before the file is known to hold it; chunks decode in parallel into disjoint
//! slots, so columns are the same on any number of threads.
//! Cost: one pass over the file; working memory of one piece (a few hundred kB) a thread besides the columns, plus the
//! compressed chunk for LAZ.

mod crs;
mod extra_bytes;
mod copc;
mod gps_times;
mod header;
mod placed_points;
mod point14;
mod ranges;
mod read;
mod records;
mod rewrite;
mod stream;
#[cfg(test)]
mod tests;

pub(super) use placed_points::placed_points;
pub(super) use read::{announced_points, read};
pub(super) use rewrite::{rewrite, write_new};
pub(super) use stream::stream;

/// First byte of each chunk of a file.
#[cfg(test)]
pub(super) fn chunk_starts(path: &std::path::Path) -> Vec<u64> {
    let source = super::source_bytes::SourceBytes::open(path).expect("a file");
    let opened = read::Opened::new(&source, &super::Settings::default(), None).expect("a sound file");
    opened.records.chunks.iter().map(records::Chunk::begins_at).collect()
}
