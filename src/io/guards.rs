//! What is suspicious about coordinates, whatever the format.

use super::file_scan::{FileInfo, FileScan};
use crate::numeric::Vec3;
use crate::warning::Warning;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashSet;

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
const DUPLICATE_SAMPLE: u64 = 1 << 18;
/// A step of 32-bit coordinates that matters, in scan units of about a metre.
const COARSE_STEP: f64 = 0.0005;

/// Points kept for a closer look when all have come by.
const SAMPLE: usize = 20_000;

/// Looks at all points of a file that is in memory; also returns an even sample in scan coordinates.
pub(super) fn inspect(scan: &FileScan) -> (PointGuards, Vec<Warning>, Vec<Vec3>) {
    let mut pass = GuardsPass::new(scan.positions.len() as u64, scan.origin);
    pass.add(&scan.positions);
    pass.finish(&scan.info)
}

/// Looks at the points of a file while they come by; memory does not grow with their number.
pub(super) struct GuardsPass {
    origin: Vec3,
    at_zero: u64,
    /// One of 2^shift hashes is kept: all copies of a point are kept or left together, so the share is unbiased.
    shift: u32,
    hashes: HashSet<u64>,
    hashed: u64,
    stride: usize,
    points: usize,
    sample: Vec<Vec3>,
}

impl GuardsPass {
    /// For about `n` points relative to `origin`.
    pub(super) fn new(n: u64, origin: Vec3) -> Self {
        let shift = (n / DUPLICATE_SAMPLE).checked_ilog2().map_or(0, |l| l + 1);
        let stride = n.div_ceil(SAMPLE as u64).max(1) as usize;
        Self { origin, at_zero: 0, shift, hashes: HashSet::new(), hashed: 0, stride, points: 0, sample: Vec::new() }
    }

    pub(super) fn add(&mut self, positions: &[Vec3]) {
        let zero = -self.origin;
        let mask = (1u64 << self.shift) - 1;
        let found: Vec<(u64, Vec<u64>)> = positions
            .par_chunks(BLOCK)
            .map(|block| {
                let mut at_zero = 0;
                let mut kept = Vec::new();
                for p in block {
                    at_zero += u64::from(*p == zero);
                    let hash = hash(p);
                    if hash & mask == 0 {
                        kept.push(hash);
                    }
                }
                (at_zero, kept)
            })
            .collect();
        for (at_zero, kept) in found {
            self.at_zero += at_zero;
            self.hashed += kept.len() as u64;
            self.hashes.extend(kept);
        }
        let first = (self.stride - self.points % self.stride) % self.stride;
        self.sample.extend(positions.iter().skip(first).step_by(self.stride).map(|p| p + self.origin));
        self.points += positions.len();
    }

    /// What was found, and the sample in scan coordinates.
    pub(super) fn finish(self, info: &FileInfo) -> (PointGuards, Vec<Warning>, Vec<Vec3>) {
        let n = self.points;
        let guards = PointGuards {
            at_zero: self.at_zero,
            duplicates: (self.hashed - self.hashes.len() as u64) << self.shift,
            single_precision_loss: lost_to_single_precision(info, &self.sample),
        };
        let mut warnings = Vec::new();
        if guards.at_zero > 0 {
            warnings.push(Warning::new(
                "points-at-zero",
                format!(
                    "{} of {n} points lie at exactly 0, 0, 0 (scanners write that for lost echoes)",
                    guards.at_zero
                ),
            ));
        }
        if guards.duplicates > 0 {
            let about = if self.shift == 0 { "" } else { "about " };
            warnings.push(Warning::new(
                "duplicate-points",
                format!("{about}{} of {n} points repeat the coordinates of another point", guards.duplicates),
            ));
        }
        if guards.single_precision_loss {
            let largest = info.bounds.map_or(0.0, |b| b.iter().flatten().fold(0.0f64, |m, c| m.max(c.abs())));
            warnings.push(Warning::new(
                "single-precision-coordinates",
                format!(
                    "coordinates up to {largest:.0} were stored as 32-bit floats, which step by {} there: the scan \
                     lost detail before it came here; export it again with 64-bit or integer coordinates, or with a \
                     local origin",
                    single_step(largest)
                ),
            ));
        }
        (guards, warnings, self.sample)
    }
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

/// Whether far coordinates all lie on 32-bit floats although the file could say more; `sample` in scan coordinates.
fn lost_to_single_precision(info: &FileInfo, sample: &[Vec3]) -> bool {
    let Some(bounds) = info.bounds else { return false };
    (0..3).any(|axis| {
        let nearest = bounds[0][axis].abs().min(bounds[1][axis].abs());
        if bounds[0][axis].signum() != bounds[1][axis].signum() {
            return false;
        }
        let step = single_step(nearest);
        if info.single_precision {
            return single_step(bounds[0][axis].abs().max(bounds[1][axis].abs())) >= COARSE_STEP;
        }
        // On an integer grid, the 32-bit steps must be much coarser than the grid to be told from it.
        if step < COARSE_STEP || step < 8.0 * info.resolution {
            return false;
        }
        let tolerance = 0.51 * info.resolution + nearest * 1e-15;
        let spread = bounds[1][axis] - bounds[0][axis];
        // Enough points to make an accident impossible.
        sample.len() >= 100
            && spread > 8.0 * step
            && sample.iter().all(|p| (f64::from(p[axis] as f32) - p[axis]).abs() <= tolerance)
    })
}
