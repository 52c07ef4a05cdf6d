//! The nearest of a short list of points, without sorting the list.
//!
//! Squared distances on a surface are spread evenly, so that a counting sort by bins of squared distance leaves about
//! the same number in each bin: what is nearer than a bin is known without a comparison, and only the bin in which a
//! wanted number is reached has to be sorted.

/// Bins of a counting sort.
const BINS: usize = 32;
/// Sorted by insertion up to this many.
const FEW: usize = 16;

/// A list of points and, for one place at a time, what of it is near.
#[derive(Default)]
pub(super) struct List {
    /// Offsets from the middle of the bundle, 32 bits: enough to tell what is nearer.
    pub x: Vec<f32>,
    pub y: Vec<f32>,
    pub z: Vec<f32>,
    /// Places on the curve.
    pub at: Vec<u32>,
    /// Offset of the place that asks, and squared distances of the list from it.
    pub own: [f32; 3],
    pub squared: Vec<f32>,
    /// Numbers in the list of what is near, sorted by bins.
    pub near: Vec<u32>,
    near_squared: Vec<f32>,
    bin_of: Vec<u32>,
    sorted: Vec<u32>,
    /// Where each bin ends in `near`, and bins per squared distance.
    ends: [u32; BINS],
    bins_per_unit: f32,
}

impl List {
    pub fn clear(&mut self) {
        [&mut self.x, &mut self.y, &mut self.z].into_iter().for_each(Vec::clear);
        self.at.clear();
    }

    /// Measures the squared distances from an offset.
    pub fn measure(&mut self, own: [f32; 3]) {
        let Self { x, y, z, squared, .. } = self;
        squared.clear();
        squared.extend(x.iter().zip(y.iter()).zip(z.iter()).map(|((x, y), z)| {
            let (dx, dy, dz) = (x - own[0], y - own[1], z - own[2]);
            dx * dx + dy * dy + dz * dz
        }));
        self.own = own;
    }

    /// Fills `near` with what lies within a squared distance, which may be infinite, and gives back how many that are.
    pub fn within(&mut self, limit: f32) -> usize {
        let Self { squared, near, near_squared, .. } = self;
        near.resize(squared.len(), 0);
        near_squared.resize(squared.len(), 0.0);
        // Written first, kept if inside: no branch to guess.
        let mut inside = 0;
        for (number, &s) in squared.iter().enumerate() {
            near[inside] = number as u32;
            near_squared[inside] = s;
            inside += usize::from(s <= limit);
        }
        near.truncate(inside);
        near_squared.truncate(inside);
        inside
    }

    /// Sorts `near` by bins of squared distance from 0 to `limit`.
    pub fn rank(&mut self, limit: f32) {
        let Self { near, near_squared, bin_of, sorted, .. } = self;
        let scale = if limit.is_finite() { limit } else { near_squared.iter().copied().fold(0.0, f32::max) };
        self.bins_per_unit = if scale > 0.0 { BINS as f32 / scale } else { 0.0 };
        bin_of.clear();
        bin_of.extend(near_squared.iter().map(|&s| bin(s, self.bins_per_unit)));
        sorted.resize(near.len(), 0);
        self.ends = sort_by_bin(near, bin_of, sorted);
        std::mem::swap(near, sorted);
    }

    /// Makes the first `count` of `near` the nearest, in no order but that the last of them is the farthest, whose
    /// squared distance is given back. Equal distances by number.
    pub fn settle(&mut self, count: usize) -> f32 {
        let squared = &self.squared;
        let bin = bin(squared[self.near[count - 1] as usize], self.bins_per_unit) as usize % BINS;
        let start = if bin == 0 { 0 } else { self.ends[bin - 1] as usize };
        sort(&mut self.near[start..self.ends[bin] as usize], squared);
        squared[self.near[count - 1] as usize]
    }

    /// Sorts `near` by distance.
    pub fn sort(&mut self) {
        let Self { near, squared, ends, .. } = self;
        let fullest = ends.windows(2).map(|w| w[1] - w[0]).fold(ends[0], u32::max);
        if fullest <= FEW as u32 {
            return insertion_sort(near, squared);
        }
        let mut start = 0;
        for &end in ends.iter() {
            sort(&mut near[start..end as usize], squared);
            start = end as usize;
        }
    }
}

/// The bin of a squared distance.
fn bin(squared: f32, bins_per_unit: f32) -> u32 {
    let last = (BINS - 1) as f32;
    let place = squared * bins_per_unit;
    // Adding 2^23 leaves the whole number in the lowest bits.
    ((if place < last { place } else { last }) + 8_388_608.0).to_bits() & (BINS as u32 - 1)
}

/// Counting sort; gives back where each bin ends.
fn sort_by_bin(numbers: &[u32], bin_of: &[u32], sorted: &mut [u32]) -> [u32; BINS] {
    let mut ends = [0u32; BINS];
    for &bin in bin_of {
        ends[bin as usize % BINS] += 1;
    }
    let mut next = 0;
    for end in &mut ends {
        (*end, next) = (next, next + *end);
    }
    for (&number, &bin) in numbers.iter().zip(bin_of) {
        let end = &mut ends[bin as usize % BINS];
        if let Some(place) = sorted.get_mut(*end as usize) {
            *place = number;
        }
        *end += 1;
    }
    ends
}

/// Sorts numbers by the distances that they stand for, then by themselves.
fn sort(numbers: &mut [u32], squared: &[f32]) {
    if numbers.len() > FEW {
        numbers.sort_unstable_by_key(|&n| (squared[n as usize].to_bits(), n));
    } else {
        insertion_sort(numbers, squared);
    }
}

/// The same, quick when they are few or nearly sorted.
fn insertion_sort(numbers: &mut [u32], squared: &[f32]) {
    for i in 1..numbers.len() {
        let number = numbers[i];
        let key = (squared[number as usize], number);
        let mut slot = i;
        while slot > 0 && key < (squared[numbers[slot - 1] as usize], numbers[slot - 1]) {
            numbers[slot] = numbers[slot - 1];
            slot -= 1;
        }
        numbers[slot] = number;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    /// A list on a line, so that squared distances from 0 are the squares.
    fn list(offsets: &[f32]) -> List {
        let none = vec![0.0; offsets.len()];
        let mut list = List { x: offsets.to_vec(), y: none.clone(), z: none, ..List::default() };
        list.measure([0.0; 3]);
        list
    }

    #[test]
    fn settled_numbers_are_the_nearest() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let even: Vec<f32> = (0..200).map(|_| random.random_range(0.0f32..1.0).sqrt()).collect();
        let crowded: Vec<f32> = (0..200).map(|i| if i % 10 == 0 { 1.0 } else { 1e-4 * (i % 7) as f32 }).collect();
        for offsets in [even, crowded, vec![0.0; 50]] {
            let mut order: Vec<u32> = (0..offsets.len() as u32).collect();
            order.sort_by(|&a, &b| offsets[a as usize].total_cmp(&offsets[b as usize]).then(a.cmp(&b)));
            for limit in [f32::INFINITY, 1.0] {
                let mut list = list(&offsets);
                let inside = list.within(limit);
                list.rank(limit);
                for count in [45, 31, 2] {
                    let farthest = list.settle(count.min(inside));
                    let mut first = list.near[..count].to_vec();
                    first.sort_by_key(|n| order.iter().position(|o| o == n));
                    assert_eq!(first, order[..count]);
                    assert_eq!(farthest, offsets[order[count - 1] as usize].powi(2));
                }
                list.sort();
                assert_eq!(list.near, order[..inside]);
            }
        }
    }
}
