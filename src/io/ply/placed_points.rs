//! Positions and map columns of a binary PLY file that a run wrote.

use super::super::error::{COPY_AGAIN, Error};
use super::super::placed_points::PlacedPoint;
use super::super::source_bytes::SourceBytes;
use super::header::{Encoding, Header, Kind, Scalar};
use crate::numeric::Vec3;
use std::path::Path;

/// Vertices read in one go.
const RUN: usize = 1 << 16;

/// See [`crate::io::placed_points`].
pub(in super::super) fn placed_points(path: &Path, each: &mut dyn FnMut(&[PlacedPoint])) -> Result<(), Error> {
    let source = SourceBytes::open(path)?;
    let header = Header::read(&source)?;
    let Some((0, vertices)) = header.element("vertex") else {
        return Err(Error::bad(path, "it does not begin with an element 'vertex'", COPY_AGAIN));
    };
    let (Some(stride), true) = (vertices.stride(), header.encoding != Encoding::Ascii) else {
        return Err(Error::bad(path, "its vertices are no binary records of one length", COPY_AGAIN));
    };
    let mut places: Vec<(usize, Scalar)> = Vec::new();
    for name in ["x", "y", "z", "chainage", "girth", "offset"] {
        let mut at = 0;
        let mut found = None;
        for property in &vertices.properties {
            let Kind::Scalar(scalar) = property.kind else { continue };
            if property.name == name {
                found = Some((at, scalar));
            }
            at += scalar.size();
        }
        places.push(found.ok_or_else(|| Error::bad(path, format!("its vertices have no '{name}'"), COPY_AGAIN))?);
    }
    let count = vertices.count as usize;
    for first in (0..count).step_by(RUN) {
        let rows = RUN.min(count - first);
        let bytes = source.bytes(header.data_at + (first * stride) as u64, rows * stride)?;
        let points: Vec<PlacedPoint> = bytes
            .chunks_exact(stride)
            .map(|record| {
                let v: Vec<f64> = places.iter().map(|(at, s)| s.get(&record[*at..], header.big_endian())).collect();
                PlacedPoint { position_in_scan: Vec3::new(v[0], v[1], v[2]), on_map: Vec3::new(v[3], v[4], v[5]) }
            })
            .collect();
        each(&points);
    }
    Ok(())
}
