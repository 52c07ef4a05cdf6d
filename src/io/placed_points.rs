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

/// Calls `each` with the points of the file, some at a time and in order.
///
/// # Errors
/// [`Error`] when the file does not read or has no map columns.
pub fn placed_points(path: &Path, each: &mut dyn FnMut(&[PlacedPoint])) -> Result<(), Error> {
    let is_ply = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"));
    if is_ply { super::ply::placed_points(path, each) } else { super::las::placed_points(path, each) }
}
