//! What is suspicious about coordinates, whatever the format.

use super::file_scan::FileScan;
use crate::numeric::Vec3;
use crate::warning::Warning;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashMap;

/// Counts of suspicious points of a file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct PointGuards {
    /// Points at exactly 0, 0, 0 in scan coordinates: scanners write them where nothing came back.
    pub at_zero: u64,
    /// Points that repeat the coordinates of another one; from a sample of the points when there are many.
    pub duplicates: u64,
    /// Whether coordinates were squeezed through 32-bit floats and lost more than half a millimetre.
    pub single_precision_loss: bool,
}

/// Points in a block of the parallel pass; fixed, so that sums do not depend on the threads.
const BLOCK: usize = 1 << 16;
/// Duplicates are counted among about this many points.
const DUPLICATE_SAMPLE: usize = 1 << 18;
/// A step of 32-bit coordinates that matters, in scan units of about a metre.
const COARSE_STEP: f64 = 0.0005;

/// Looks at all points of a file. `frame_unit` is the length of a scan unit in metres.
pub(super) fn inspect(scan: &FileScan) -> (PointGuards, Vec<Warning>) {
    let mut guards = PointGuards::default();
    let mut warnings = Vec::new();
    let n = scan.positions.len();
    if n == 0 {
        return (guards, warnings);
    }
    let zero = -scan.origin;
    // One of 2^shift hashes is kept: all copies of a point are kept or left together, so the share is unbiased.
    let shift = (n / DUPLICATE_SAMPLE).checked_ilog2().map_or(0, |l| l + 1);
    let mask = (1u64 << shift) - 1;
    let found: Vec<(u64, Vec<u64>)> = scan
        .positions
        .par_chunks(BLOCK)
        .map(|block| {
            let mut at_zero = 0;
            let mut sample = Vec::new();
            for p in block {
                at_zero += u64::from(*p == zero);
                let hash = hash(p);
                if hash & mask == 0 {
                    sample.push(hash);
                }
            }
            (at_zero, sample)
        })
        .collect();
    guards.at_zero = found.iter().map(|f| f.0).sum();
    let mut seen: HashMap<u64, ()> = HashMap::with_capacity(DUPLICATE_SAMPLE * 2);
    let mut sampled = 0u64;
    for hash in found.iter().flat_map(|f| &f.1) {
        sampled += 1;
        seen.insert(*hash, ());
    }
    guards.duplicates = (sampled - seen.len() as u64) << shift;
    guards.single_precision_loss = lost_to_single_precision(scan);
    if guards.at_zero > 0 {
        warnings.push(Warning::new(
            "points-at-zero",
            format!("{} of {n} points lie at exactly 0, 0, 0 (scanners write that for lost echoes)", guards.at_zero),
        ));
    }
    if guards.duplicates > 0 {
        let about = if shift == 0 { "" } else { "about " };
        warnings.push(Warning::new(
            "duplicate-points",
            format!("{about}{} of {n} points repeat the coordinates of another point", guards.duplicates),
        ));
    }
    if guards.single_precision_loss {
        let largest = scan.info.bounds.map_or(0.0, |b| b.iter().flatten().fold(0.0f64, |m, c| m.max(c.abs())));
        warnings.push(Warning::new(
            "single-precision-coordinates",
            format!(
                "coordinates up to {largest:.0} were stored as 32-bit floats, which step by {} there: the scan lost \
                 detail before it came here; export it again with 64-bit or integer coordinates, or with a local origin",
                single_step(largest)
            ),
        ));
    }
    (guards, warnings)
}

/// A hash of the exact coordinates (splitmix64 finaliser over the three bit patterns).
fn hash(p: &Vec3) -> u64 {
    let mut h = 0u64;
    for c in p.iter() {
        h = (h ^ c.to_bits()).wrapping_add(0x9e37_79b9_7f4a_7c15);
        h = (h ^ (h >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h = (h ^ (h >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        h ^= h >> 31;
    }
    h
}

/// Distance between neighbouring 32-bit floats at `value`.
fn single_step(value: f64) -> f64 {
    let single = value.abs() as f32;
    f64::from(f32::from_bits(single.to_bits() + 1)) - f64::from(single)
}

/// Whether far coordinates all lie on 32-bit floats although the file could say more.
fn lost_to_single_precision(scan: &FileScan) -> bool {
    /// Enough points to make an accident impossible.
    const SAMPLE: usize = 2000;
    let Some(bounds) = scan.info.bounds else { return false };
    let stride = scan.positions.len().div_ceil(SAMPLE).max(1);
    (0..3).any(|axis| {
        let nearest = bounds[0][axis].abs().min(bounds[1][axis].abs());
        if bounds[0][axis].signum() != bounds[1][axis].signum() {
            return false;
        }
        let step = single_step(nearest);
        if scan.info.single_precision {
            return single_step(bounds[0][axis].abs().max(bounds[1][axis].abs())) >= COARSE_STEP;
        }
        // On an integer grid, the 32-bit steps must be much coarser than the grid to be told from it.
        if step < COARSE_STEP || step < 8.0 * scan.info.resolution {
            return false;
        }
        let tolerance = 0.51 * scan.info.resolution + nearest * 1e-15;
        let mut values = scan.positions.iter().step_by(stride).map(|p| p[axis] + scan.origin[axis]);
        let spread = bounds[1][axis] - bounds[0][axis];
        scan.positions.len() >= 100
            && spread > 8.0 * step
            && values.all(|v| (f64::from(v as f32) - v).abs() <= tolerance)
    })
}
