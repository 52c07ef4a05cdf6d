//! A guess at the unit of coordinates that state none, from how high a tunnel can be.
//!
//! The height is taken in cells of the plan, so that neither length, bends nor gradient count: drifts and tunnels are
//! between 2 m and 15 m high. A tunnel in feet is only noticed when it is higher than 18 ft (5.5 m); lower ones pass for
//! metres. Nothing is converted: the guess is a warning, and `ingest.unit` settles it.

use crate::numeric::{Vec3, statistics};
use crate::warning::Warning;

/// Heights above these many units point to another unit than the metre.
const FEET_FROM: f64 = 18.0;
const CENTIMETRES_FROM: f64 = 150.0;
const MILLIMETRES_FROM: f64 = 1500.0;

/// A warning when a scan of this extent, with these points, does not look like metres.
pub(super) fn of(extent: &Vec3, sample: &[Vec3]) -> Option<Warning> {
    let size = format!("{:.0} x {:.0} x {:.0} units", extent.x, extent.y, extent.z);
    let guess = |height: &str, unit: &str, name: &str| {
        Some(Warning::new(
            "unit-guess",
            format!("the scan measures {size}{height}: if these are {unit}, set ingest.unit = \"{name}\""),
        ))
    };
    match local_height(sample) {
        Some(height) => {
            let text = format!(" and is about {height:.0} units high");
            match height {
                h if h >= MILLIMETRES_FROM => guess(&text, "millimetres", "millimetre"),
                h if h >= CENTIMETRES_FROM => guess(&text, "centimetres", "centimetre"),
                h if h >= FEET_FROM => guess(&text, "feet and not metres of a cavern", "foot"),
                _ => None,
            }
        }
        // Too few points for a height: only the extents speak.
        None if extent.amax() > 2000.0 && extent.amin() > 500.0 => guess("", "millimetres", "millimetre"),
        None => None,
    }
}

/// Median height of the occupied cells of the plan; `None` when few cells hold enough points.
fn local_height(sample: &[Vec3]) -> Option<f64> {
    /// Cells along the longer side of the plan.
    const CELLS: f64 = 64.0;
    const POINTS_IN_CELL: usize = 8;
    const CELLS_NEEDED: usize = 8;
    let (low, high) = crate::spatial::voxel_grid::bounds(sample)?;
    let cell = (high.x - low.x).max(high.y - low.y) / CELLS;
    if !(cell > 0.0) || !cell.is_finite() {
        return None;
    }
    let mut heights: Vec<([u32; 2], f64)> =
        sample.iter().map(|p| ([((p.x - low.x) / cell) as u32, ((p.y - low.y) / cell) as u32], p.z)).collect();
    heights.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut found: Vec<f64> = heights
        .chunk_by(|a, b| a.0 == b.0)
        .filter(|column| column.len() >= POINTS_IN_CELL)
        .map(|column| column[column.len() - 1].1 - column[0].1)
        .collect();
    if found.len() < CELLS_NEEDED { None } else { statistics::median(&mut found) }
}
