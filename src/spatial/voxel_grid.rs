//! Points sorted into the cells of a regular grid, in Morton (Z) order: neighbours in space are neighbours in memory.
//!
//! Reference for the order: G. M. Morton, "A computer oriented geodetic data base and a new technique in file
//! sequencing", IBM, 1966. Here each axis only contributes the bits that its extent needs, so that long thin tunnels
//! still fit 64-bit keys together with the point's index.
//! Keys that leave room for the index are sorted by radix, least digit first (D. E. Knuth, *The Art of Computer
//! Programming* 3, 1998, section 5.2.5): three or four passes over the points, which no comparison sort reaches.
//! Guarantees: the same cells, in the same order, on any number of threads. Cost: linear in the points.

use crate::numeric::Vec3;
use rayon::prelude::*;

/// Points handled by one task; fixed, so that nothing depends on the number of threads.
const CHUNK: usize = 1 << 16;
/// Cells per axis at most: the grid's own limit so that keys fit 128 bits with the index.
const MAX_BITS: u32 = 30;

/// Cells of a cubic grid that hold at least one point, with their points.
#[derive(Clone, Debug)]
pub struct VoxelGrid {
    cell_m: f64,
    origin: Vec3,
    /// Point indices, cell after cell, ascending within a cell.
    order: Vec<u32>,
    /// First entry in `order` of each cell, and the total at the end.
    starts: Vec<u32>,
}

impl VoxelGrid {
    /// Sorts finite `points` into cells of `cell_m` metres. The cell is enlarged when the extent would need more than
    /// 2^30 cells on a side; [`Self::cell_m`] tells. Panics when `cell_m` is not a positive number.
    pub fn new(points: &[Vec3], cell_m: f64) -> Self {
        assert!(cell_m > 0.0 && cell_m.is_finite(), "voxel cell {cell_m}");
        let Some((low, high)) = bounds(points) else {
            return Self { cell_m, origin: Vec3::zeros(), order: Vec::new(), starts: vec![0] };
        };
        let cell_m = cell_m.max((high - low).amax() / (1u64 << (MAX_BITS - 1)) as f64);
        // Cells sit on multiples of the cell size, so that the grid does not depend on a far outlier.
        let origin = low.map(|c| (c / cell_m).floor() * cell_m);
        let code = MortonCode::new(&((high - origin) / cell_m));
        let index_bits = u64::BITS - (points.len() as u64).leading_zeros();
        let order = if code.total_bits + index_bits <= 64 {
            sort_packed(points, |i, p| code.short_key(&((p - origin) / cell_m)) << index_bits | i as u64, index_bits)
        } else {
            sort_wide(points, |p| code.key(&((p - origin) / cell_m)))
        };
        Self { cell_m, origin, order: order.0, starts: order.1 }
    }

    /// Edge of a cell, metres.
    pub fn cell_m(&self) -> f64 {
        self.cell_m
    }

    /// Number of occupied cells.
    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Indices of the points of the occupied cell number `cell`, ascending.
    pub fn points_of(&self, cell: usize) -> &[u32] {
        &self.order[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }

    /// All point indices, cell after cell.
    pub fn order(&self) -> &[u32] {
        &self.order
    }

    /// All point indices, cell after cell, by value.
    pub fn into_order(self) -> Vec<u32> {
        self.order
    }

    /// Integer coordinates of the cell around a point.
    pub fn cell_around(&self, point: &Vec3) -> [i64; 3] {
        ((point - self.origin) / self.cell_m).map(|c| c.floor() as i64).into()
    }
}

/// Lower and upper corner of the box around `points`; `None` without points.
pub fn bounds(points: &[Vec3]) -> Option<(Vec3, Vec3)> {
    points
        .par_chunks(CHUNK)
        .filter_map(|chunk| {
            let first = *chunk.first()?;
            Some(chunk.iter().fold((first, first), |(low, high), p| (low.inf(p), high.sup(p))))
        })
        .reduce_with(|a, b| (a.0.inf(&b.0), a.1.sup(&b.1)))
}

/// Interleaves the bits of three cell numbers, each axis with as many bits as it needs.
struct MortonCode {
    bits: [u32; 3],
    total_bits: u32,
    /// For each axis the spread of every byte value at every byte position, so that a key costs a few lookups.
    spread: Vec<[u128; 256]>,
    /// The lower halves of `spread`: all there is when the keys fit 64 bits.
    low: Vec<[u64; 256]>,
}

impl MortonCode {
    fn new(extent_in_cells: &Vec3) -> Self {
        let bits: [u32; 3] = std::array::from_fn(|axis| u64::BITS - (extent_in_cells[axis] as u64).leading_zeros());
        // Where bit b of an axis goes: after all lower bits of all axes.
        let position = |axis: usize, b: u32| -> u32 {
            (0..3).map(|other| bits[other].min(if other < axis { b + 1 } else { b })).sum()
        };
        let mut spread = vec![[0; 256]; 12];
        for axis in 0..3 {
            for byte in 0..4 {
                for (value, entry) in spread[axis * 4 + byte].iter_mut().enumerate() {
                    for b in (0..8).filter(|b| value >> b & 1 == 1) {
                        let bit = byte as u32 * 8 + b;
                        if bit < bits[axis] {
                            *entry |= 1u128 << position(axis, bit);
                        }
                    }
                }
            }
        }
        let low = spread.iter().map(|table| table.map(|key| key as u64)).collect();
        Self { bits, total_bits: bits.iter().sum(), spread, low }
    }

    /// The key when [`Self::total_bits`] is at most 64.
    fn short_key(&self, position_in_cells: &Vec3) -> u64 {
        let mut key = 0;
        for axis in 0..3 {
            let cell = position_in_cells[axis] as u32;
            for byte in 0..self.bits[axis].div_ceil(8) as usize {
                key |= self.low[axis * 4 + byte][(cell >> (8 * byte)) as usize & 255];
            }
        }
        key
    }

    fn key(&self, position_in_cells: &Vec3) -> u128 {
        let mut key = 0;
        for axis in 0..3 {
            let cell = position_in_cells[axis] as u32;
            for byte in 0..self.bits[axis].div_ceil(8) as usize {
                key |= self.spread[axis * 4 + byte][(cell >> (8 * byte)) as usize & 255];
            }
        }
        key
    }
}

fn sort_packed(points: &[Vec3], key: impl Fn(usize, &Vec3) -> u64 + Sync, index_bits: u32) -> (Vec<u32>, Vec<u32>) {
    let keys: Vec<u64> = points.par_iter().enumerate().map(|(i, p)| key(i, p)).collect();
    let keys = radix_sorted(keys, index_bits);
    let mask = (1u64 << index_bits) - 1;
    let starts = cell_starts(keys.len(), |i| keys[i] >> index_bits == keys[i - 1] >> index_bits);
    (keys.par_iter().map(|k| (k & mask) as u32).collect(), starts)
}

/// Bits of a digit: 2048 places to write to fit the first cache.
const DIGIT_BITS: u32 = 11;
/// Below this many keys a comparison sort is as fast.
const FEW_KEYS: usize = 4096;

/// Keys in ascending order. The lowest `ordered_bits` bits hold ascending numbers already, so that a stable sort of the
/// bits above is enough.
fn radix_sorted(mut keys: Vec<u64>, ordered_bits: u32) -> Vec<u64> {
    if keys.len() < FEW_KEYS {
        keys.sort_unstable();
        return keys;
    }
    let used = keys.par_iter().copied().reduce(|| 0, |a, b| a | b);
    let bits = u64::BITS - used.leading_zeros();
    let digits = bits.saturating_sub(ordered_bits).div_ceil(DIGIT_BITS) as usize;
    let digit = |key: u64, d: usize| (key >> (ordered_bits + d as u32 * DIGIT_BITS)) as usize & ((1 << DIGIT_BITS) - 1);
    // The histograms of all digits in one reading.
    let mut counts = vec![[0u32; 1 << DIGIT_BITS]; digits];
    for &key in &keys {
        for (d, counts) in counts.iter_mut().enumerate() {
            counts[digit(key, d)] += 1;
        }
    }
    let mut sorted = vec![0u64; keys.len()];
    for (d, counts) in counts.iter_mut().enumerate() {
        let mut next = 0;
        for count in counts.iter_mut() {
            (*count, next) = (next, next + *count);
        }
        for &key in &keys {
            let place = &mut counts[digit(key, d)];
            sorted[*place as usize] = key;
            *place += 1;
        }
        std::mem::swap(&mut keys, &mut sorted);
    }
    keys
}

fn sort_wide(points: &[Vec3], key: impl Fn(&Vec3) -> u128 + Sync) -> (Vec<u32>, Vec<u32>) {
    let mut keys: Vec<(u128, u32)> = points.par_iter().enumerate().map(|(i, p)| (key(p), i as u32)).collect();
    keys.par_sort_unstable();
    let starts = cell_starts(keys.len(), |i| keys[i].0 == keys[i - 1].0);
    (keys.par_iter().map(|k| k.1).collect(), starts)
}

fn cell_starts(len: usize, same_as_before: impl Fn(usize) -> bool) -> Vec<u32> {
    let mut starts: Vec<u32> = (0..len).filter(|&i| i == 0 || !same_as_before(i)).map(|i| i as u32).collect();
    starts.push(len as u32);
    starts
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    fn assert_matches_a_map(points: &[Vec3], cell_m: f64) {
        let grid = VoxelGrid::new(points, cell_m);
        let mut cells: BTreeMap<[i64; 3], Vec<u32>> = BTreeMap::new();
        for (i, p) in points.iter().enumerate() {
            cells.entry(grid.cell_around(p)).or_default().push(i as u32);
        }
        assert_eq!(grid.len(), cells.len());
        for cell in 0..grid.len() {
            let members = grid.points_of(cell);
            assert_eq!(cells[&grid.cell_around(&points[members[0] as usize])], members);
        }
    }

    proptest! {
        #[test]
        fn cells_hold_exactly_their_points(
            points in prop::collection::vec((-5.0..5.0f64, 0.0..80.0f64, -1.0..1.0f64), 1..200),
            cell in 0.01..3.0f64,
        ) {
            let points: Vec<Vec3> = points.into_iter().map(|(x, y, z)| Vec3::new(x, y, z)).collect();
            assert_matches_a_map(&points, cell);
        }
    }

    #[test]
    fn kilometres_in_millimetres_fit() {
        let points: Vec<Vec3> =
            (0..2000).map(|i| Vec3::new(i as f64 * 2.5, (i * 7 % 1000) as f64, (i % 13) as f64) * 1.000_1).collect();
        assert_matches_a_map(&points, 1e-6);
        assert_matches_a_map(&points, 0.001);
    }

    #[test]
    fn morton_order_keeps_neighbours_together() {
        let points: Vec<Vec3> = (0..64).map(|i| Vec3::new((i % 8) as f64 + 0.5, (i / 8) as f64 + 0.5, 0.0)).collect();
        let grid = VoxelGrid::new(&points, 1.0);
        assert_eq!(&grid.order()[..4], &[0, 1, 8, 9]);
    }

    #[test]
    fn no_points_no_cells() {
        assert!(VoxelGrid::new(&[], 1.0).is_empty());
    }
}
