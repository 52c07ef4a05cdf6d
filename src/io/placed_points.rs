//! The points of a run with their places on the map, as `points.laz` and `points.ply` hold them: what a check from the
//! files alone needs.

use super::Error;
use crate::numeric::Vec3;
use std::path::Path;

/// A point of the file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlacedPoint {
    /// Its position, scan coordinates.
    pub position_in_scan: Vec3,
    /// Chainage, girth and offset, metres; NaN without a place.
    pub on_map: Vec3,
}

/// Bytes of the four columns that a run appends to a LAS record: label, chainage, girth, offset.
const APPENDED: usize = 20;
/// Lengths are stored in micrometres.
const MICROMETRE: f64 = 1e-6;
/// Records read in one go.
const RUN: u64 = 1 << 18;

/// Calls `each` with the points of the file, some at a time and in order.
///
/// # Errors
/// [`Error`] when the file does not read or has no map columns.
pub fn placed_points(path: &Path, each: &mut dyn FnMut(&[PlacedPoint])) -> Result<(), Error> {
    let is_ply = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"));
    if is_ply { super::ply::placed_points(path, each) } else { from_las(path, each) }
}

fn from_las(path: &Path, each: &mut dyn FnMut(&[PlacedPoint])) -> Result<(), Error> {
    let bad = |cause: String| Error::BadInput {
        path: path.to_owned(),
        cause,
        remedy: "run again with --force points".into(),
    };
    let mut reader = las::Reader::from_path(path).map_err(|e| bad(e.to_string()))?;
    if usize::from(reader.header().point_format().extra_bytes) < APPENDED {
        return Err(bad("its records have no columns chainage, girth and offset".into()));
    }
    loop {
        let records = reader.read_points(RUN).map_err(|e| bad(e.to_string()))?;
        let mut points = Vec::with_capacity(records.len());
        for point in records.points() {
            let p = point.map_err(|e| bad(e.to_string()))?;
            let own = &p.extra_bytes[p.extra_bytes.len() - APPENDED..];
            let chainage = i64::from_le_bytes(own[4..12].try_into().expect("eight bytes"));
            let short = |at: usize| i32::from_le_bytes(own[at..at + 4].try_into().expect("four bytes"));
            let metres = |raw: i64, none: i64| if raw == none { f64::NAN } else { raw as f64 * MICROMETRE };
            let length = |at: usize| metres(i64::from(short(at)), i64::from(i32::MIN));
            points.push(PlacedPoint {
                position_in_scan: Vec3::new(p.x, p.y, p.z),
                on_map: Vec3::new(metres(chainage, i64::MIN), length(12), length(16)),
            });
        }
        if points.is_empty() {
            return Ok(());
        }
        each(&points);
    }
}
