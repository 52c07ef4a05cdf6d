//! How densely the scan covers the chart, and which points are near a place.
//!
//! Scans are rarely even: profile scanners leave millimetres between the points of a profile and half a metre between
//! profiles, and a scanner on a tripod spreads its points along the far walls. The spacing is therefore measured in
//! both chart directions and in blocks: for some points of each block the nearest neighbour inside a narrow double cone
//! around u, and around v. For even random points the median of that distance is the mean point spacing.

use crate::numeric::{Vec2, statistics};
use rayon::prelude::*;
use std::ops::Range;

/// Tangent of the half opening of the cones (20 degrees): wide enough to meet a neighbour soon, narrow enough not to
/// take points of the same, slightly crooked, profile for neighbours along the tunnel.
const CONE_TANGENT: f64 = 0.364;

/// Neighbours farther than this do not count as sampling, metres.
const SEARCH_RADIUS_M: f64 = 3.0;

/// Points wanted in a bucket of the index.
const BUCKET_POINTS: f64 = 24.0;

/// Points wanted in a block whose spacing is measured.
const BLOCK_POINTS: f64 = 96.0;

/// Samples over the whole chart.
const SAMPLES: usize = 150_000;

/// Points on the chart, sorted into square buckets. Their places are kept in that order, too: the map visits every
/// point several times, and a scan gives its points in any order.
#[derive(Debug)]
pub struct ScatterIndex {
    origin: Vec2,
    side: f64,
    across: usize,
    down: usize,
    starts: Vec<usize>,
    points: Vec<u32>,
    places: Vec<Vec2>,
}

/// One bucket of a [`ScatterIndex`].
#[derive(Clone, Debug)]
pub struct Bucket {
    /// Its middle on the chart.
    pub centre: Vec2,
    /// Its points: positions in [`ScatterIndex::points`] and [`ScatterIndex::places`].
    pub members: Range<usize>,
}

impl ScatterIndex {
    /// Sorts the points that `keep` accepts; points without finite coordinates are left out.
    pub fn new(uv: &[Vec2], keep: impl Fn(usize) -> bool) -> Self {
        let kept = |i: usize| uv[i].x.is_finite() && uv[i].y.is_finite() && keep(i);
        let (mut low, mut high, mut count) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY), 0usize);
        for i in (0..uv.len()).filter(|&i| kept(i)) {
            low = low.inf(&uv[i]);
            high = high.sup(&uv[i]);
            count += 1;
        }
        if count == 0 {
            return Self {
                origin: Vec2::zeros(),
                side: 1.0,
                across: 1,
                down: 1,
                starts: vec![0; 2],
                points: vec![],
                places: vec![],
            };
        }
        let extent = high - low;
        let area = extent.x.max(1e-3) * extent.y.max(1e-3);
        let side = (BUCKET_POINTS * area / count as f64).sqrt().max(1e-4);
        let across = (extent.x / side) as usize + 1;
        let down = (extent.y / side) as usize + 1;
        let starts = vec![0; across * down + 1];
        let mut index = Self { origin: low, side, across, down, starts, points: vec![], places: vec![] };
        for i in (0..uv.len()).filter(|&i| kept(i)) {
            let bucket = index.bucket_of(uv[i]);
            index.starts[bucket + 1] += 1;
        }
        for b in 1..index.starts.len() {
            index.starts[b] += index.starts[b - 1];
        }
        let mut next = index.starts.clone();
        index.points = vec![0; count];
        for i in (0..uv.len()).filter(|&i| kept(i)) {
            let bucket = index.bucket_of(uv[i]);
            index.points[next[bucket]] = i as u32;
            next[bucket] += 1;
        }
        index.places = index.points.iter().map(|&i| uv[i as usize]).collect();
        index
    }

    /// The points in the order of the buckets: their numbers in the scan.
    pub fn points(&self) -> &[u32] {
        &self.points
    }

    /// The places of [`Self::points`] on the chart.
    pub fn places(&self) -> &[Vec2] {
        &self.places
    }

    /// Points in the index.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether no point is in the index.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The buckets that touch a chart rectangle, row by row.
    pub fn buckets_near(&self, low: Vec2, high: Vec2) -> impl Iterator<Item = Bucket> + '_ {
        let columns = self.range(low.x - self.origin.x, high.x - self.origin.x, self.across);
        let rows = self.range(low.y - self.origin.y, high.y - self.origin.y, self.down);
        let found = columns.zip(rows).into_iter();
        found.flat_map(move |((c0, c1), (r0, r1))| {
            (r0..=r1).flat_map(move |r| {
                (c0..=c1).map(move |c| {
                    let bucket = r * self.across + c;
                    let centre = self.origin + Vec2::new(c as f64 + 0.5, r as f64 + 0.5) * self.side;
                    Bucket { centre, members: self.starts[bucket]..self.starts[bucket + 1] }
                })
            })
        })
    }

    fn range(&self, low: f64, high: f64, count: usize) -> Option<(usize, usize)> {
        let (low, high) = (low / self.side, high / self.side);
        (!self.is_empty() && high >= 0.0 && low < count as f64)
            .then(|| ((low.max(0.0) as usize).min(count - 1), (high as usize).min(count - 1)))
    }

    fn bucket_of(&self, p: Vec2) -> usize {
        let c = (((p.x - self.origin.x) / self.side) as usize).min(self.across - 1);
        let r = (((p.y - self.origin.y) / self.side) as usize).min(self.down - 1);
        r * self.across + c
    }

    /// Distance along u and along v to the nearest neighbour in the double cone around each direction.
    fn cone_distances(&self, member: usize) -> [Option<f64>; 2] {
        let p = self.places[member];
        let mut best = [SEARCH_RADIUS_M; 2];
        let (column, row) = {
            let bucket = self.bucket_of(p);
            ((bucket % self.across) as i64, (bucket / self.across) as i64)
        };
        let rings = (SEARCH_RADIUS_M / self.side).ceil() as i64 + 1;
        for ring in 0..=rings {
            if (ring - 1) as f64 * self.side > best[0].max(best[1]) {
                break;
            }
            for r in row - ring..=row + ring {
                if r < 0 || r >= self.down as i64 {
                    continue;
                }
                let step = if (r - row).abs() == ring { 1 } else { (2 * ring).max(1) };
                let mut c = column - ring;
                while c <= column + ring {
                    if c >= 0 && c < self.across as i64 {
                        let bucket = r as usize * self.across + c as usize;
                        for i in self.starts[bucket]..self.starts[bucket + 1] {
                            let d = (self.places[i] - p).abs();
                            if i != member && d.y <= CONE_TANGENT * d.x && d.x > 0.0 {
                                best[0] = best[0].min(d.x);
                            }
                            if i != member && d.x <= CONE_TANGENT * d.y && d.y > 0.0 {
                                best[1] = best[1].min(d.y);
                            }
                        }
                    }
                    c += step;
                }
            }
        }
        best.map(|d| (d < SEARCH_RADIUS_M).then_some(d))
    }
}

/// Point spacing along u and along v, metres, over the chart.
#[derive(Clone, Debug)]
pub struct Spacing {
    origin: Vec2,
    side: f64,
    across: usize,
    down: usize,
    blocks: Vec<[f32; 2]>,
    /// Median over the chart: along u, along v.
    pub typical: [f64; 2],
}

impl Spacing {
    /// Measures the spacing of the points in the index; `None` without two points that see each other.
    pub fn measure(index: &ScatterIndex) -> Option<Self> {
        if index.len() < 2 {
            return None;
        }
        let extent = Vec2::new(index.across as f64, index.down as f64) * index.side;
        let block_area = (BLOCK_POINTS / index.len() as f64 * extent.x * extent.y).max(extent.x * extent.y / 40_000.0);
        // Whole buckets make a block.
        let buckets = (block_area.sqrt() / index.side).round().max(1.0) as usize;
        let side = buckets as f64 * index.side;
        let (across, down) = (index.across.div_ceil(buckets), index.down.div_ceil(buckets));
        let wanted = (SAMPLES / (across * down)).clamp(3, 16);
        let measured: Vec<[Option<f64>; 2]> = (0..across * down)
            .into_par_iter()
            .map(|block| {
                let (c0, r0) = (block % across * buckets, block / across * buckets);
                let (c1, r1) = ((c0 + buckets).min(index.across), (r0 + buckets).min(index.down));
                let members: Vec<usize> = (r0..r1)
                    .flat_map(|r| {
                        let line = r * index.across;
                        index.starts[line + c0]..index.starts[line + c1]
                    })
                    .collect();
                let step = members.len().div_ceil(wanted).max(1);
                let mut found = [Vec::new(), Vec::new()];
                for &member in members.iter().step_by(step) {
                    for (direction, distance) in index.cone_distances(member).into_iter().enumerate() {
                        found[direction].extend(distance);
                    }
                }
                found.map(|mut f| statistics::median(&mut f))
            })
            .collect();
        let typical = [0, 1].map(|d| {
            let mut values: Vec<f64> = measured.iter().filter_map(|m| m[d]).collect();
            statistics::median(&mut values)
        });
        let typical = match typical {
            [Some(u), Some(v)] => [u, v],
            [Some(only), None] | [None, Some(only)] => [only; 2],
            [None, None] => return None,
        };
        // Geometric mean over the neighbourhood: densities differ by factors, and the blend must not jump.
        let blocks = (0..across * down)
            .map(|block| {
                let (c, r) = ((block % across) as i64, (block / across) as i64);
                [0, 1].map(|d| {
                    let (mut sum, mut count) = (0.0, 0);
                    for (dr, dc) in (-1..=1).flat_map(|dr| (-1..=1).map(move |dc| (dr, dc))) {
                        let (r, c) = (r + dr, c + dc);
                        if r >= 0
                            && c >= 0
                            && r < down as i64
                            && c < across as i64
                            && let Some(x) = measured[r as usize * across + c as usize][d]
                        {
                            sum += x.ln();
                            count += 1;
                        }
                    }
                    if count == 0 { typical[d] as f32 } else { (sum / f64::from(count)).exp() as f32 }
                })
            })
            .collect();
        Some(Self { origin: index.origin, side, across, down, blocks, typical })
    }

    /// Spacing along u and v around a chart position, blended between blocks.
    pub fn at(&self, uv: Vec2) -> [f64; 2] {
        let p = (uv - self.origin) / self.side - Vec2::repeat(0.5);
        let x = p.x.clamp(0.0, (self.across - 1) as f64);
        let y = p.y.clamp(0.0, (self.down - 1) as f64);
        let (c, r) = (x as usize, y as usize);
        let (fx, fy) = (x - c as f64, y - r as f64);
        let (c1, r1) = ((c + 1).min(self.across - 1), (r + 1).min(self.down - 1));
        let block = |c: usize, r: usize, d: usize| f64::from(self.blocks[r * self.across + c][d]);
        [0, 1].map(|d| {
            let top = block(c, r, d) * (1.0 - fx) + block(c1, r, d) * fx;
            let bottom = block(c, r1, d) * (1.0 - fx) + block(c1, r1, d) * fx;
            top * (1.0 - fy) + bottom * fy
        })
    }

    /// The greatest spacing along u and v in any block.
    pub fn greatest(&self) -> [f64; 2] {
        [0, 1].map(|d| self.blocks.iter().fold(0.0f64, |m, b| m.max(f64::from(b[d]))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random(n: usize, width: f64, height: f64) -> Vec<Vec2> {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        (0..n).map(|_| Vec2::new(rng.random::<f64>() * width, rng.random::<f64>() * height)).collect()
    }

    #[test]
    fn even_points_have_their_mean_spacing_in_both_directions() {
        let uv = random(20_000, 10.0, 5.0);
        let spacing = Spacing::measure(&ScatterIndex::new(&uv, |_| true)).unwrap();
        let expected = (50.0f64 / 20_000.0).sqrt();
        for s in spacing.typical {
            assert!((s / expected - 1.0).abs() < 0.15, "{s} for {expected}");
        }
    }

    #[test]
    fn profiles_are_recognised() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let uv: Vec<Vec2> = (0..40)
            .flat_map(|i| (0..2500).map(move |j| (i, j)))
            .map(|(i, j)| Vec2::new(0.5 * f64::from(i) + 0.001 * rng.random::<f64>(), 0.004 * f64::from(j)))
            .collect();
        let spacing = Spacing::measure(&ScatterIndex::new(&uv, |_| true)).unwrap();
        assert!((spacing.typical[0] - 0.5).abs() < 0.02, "{:?}", spacing.typical);
        assert!((spacing.typical[1] - 0.004).abs() < 0.001, "{:?}", spacing.typical);
    }

    #[test]
    fn near_points_are_all_found() {
        let uv = random(3000, 4.0, 3.0);
        let index = ScatterIndex::new(&uv, |i| i % 2 == 0);
        let (low, high) = (Vec2::new(1.0, 0.5), Vec2::new(1.7, 2.0));
        let inside = |p: Vec2| p.x >= low.x && p.y >= low.y && p.x <= high.x && p.y <= high.y;
        let mut found = Vec::new();
        for i in index.buckets_near(low, high).flat_map(|bucket| bucket.members) {
            if inside(index.places()[i]) {
                found.push(index.points()[i]);
            }
        }
        found.sort_unstable();
        let expected: Vec<u32> = (0..3000u32).filter(|&i| i % 2 == 0 && inside(uv[i as usize])).collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn no_points_no_spacing() {
        assert!(Spacing::measure(&ScatterIndex::new(&[], |_| true)).is_none());
        let uv = [Vec2::new(f64::NAN, 0.0), Vec2::zeros()];
        assert_eq!(ScatterIndex::new(&uv, |_| true).len(), 1);
    }
}
