//! Nested sets of nearest points: for sums over neighbourhoods, which need no order.

use super::choice::List;
use super::{BUNDLE, BundleTree, Search};
use crate::numeric::Vec3;
use std::ops::Range;

/// Most places that share a wide neighbourhood.
const SHARING: usize = 4;
/// Bundles whose wide neighbourhoods are found in one list.
const BUNDLES_OF_WIDE: usize = 2;

/// The surroundings of a position: for each of the sizes asked for, the first so many are its nearest points; else they
/// have no order.
pub struct Nested<'a> {
    list: &'a List,
    near: &'a [u32],
}

impl Nested<'_> {
    /// Number of points; a place counts among its own.
    #[allow(clippy::len_without_is_empty, reason = "there is always a point")]
    pub fn len(&self) -> usize {
        self.near.len()
    }

    /// Offsets, metres, from the position to some of its surroundings.
    #[inline]
    pub fn offsets(&self, range: Range<usize>) -> impl Iterator<Item = [f64; 3]> {
        let List { x, y, z, own, .. } = self.list;
        let own = own.map(f64::from);
        self.near[range].iter().map(move |&number| {
            let k = number as usize;
            [f64::from(x[k]) - own[0], f64::from(y[k]) - own[1], f64::from(z[k]) - own[2]]
        })
    }
}

/// A position that asks for its surroundings, with its place or the first of its places.
type Asking = (usize, Vec3);

impl BundleTree {
    /// Calls `visit(place, surroundings, shared)` for every place on the curve, with its nearest points for each of the
    /// ascending `sizes`, by 32-bit distances.
    ///
    /// For the sizes of `wide` the surroundings are those of the middle of up to four places that follow each other:
    /// `share(middle, surroundings)` is called once for them, and its answer is what `visit` gets as `shared`; `None`
    /// when `wide` is empty. Answers in the order of the curve.
    pub fn for_each_nested<S, T: Send>(
        &self,
        sizes: &[usize],
        wide: &[usize],
        share: impl Fn(&Vec3, &Nested<'_>) -> S + Sync,
        visit: impl Fn(usize, &Nested<'_>, Option<&S>) -> T + Sync,
    ) -> Vec<T> {
        self.tasks(|bundles| {
            let mut shared = Vec::new();
            if !wide.is_empty() {
                shared.reserve(bundles.len() * BUNDLE / SHARING);
                let middles = |bundles: &[(u32, u32)], asking: &mut Vec<Asking>| {
                    asking.extend(bundles.iter().flat_map(parts).map(|part| {
                        let len = part.len() as f64;
                        (part.start, part.map(|at| self.point(at)).sum::<Vec3>() / len)
                    }));
                };
                let keep = |_, middle: &Vec3, near: &Nested<'_>| shared.push(share(middle, near));
                self.nested(bundles.chunks(BUNDLES_OF_WIDE), wide, middles, keep);
            }
            let mut answers = Vec::with_capacity(bundles.len() * BUNDLE);
            let mut part_of_next =
                bundles.iter().flat_map(parts).enumerate().flat_map(|(number, part)| part.map(move |_| number));
            let places = |bundles: &[(u32, u32)], asking: &mut Vec<Asking>| {
                asking.extend((bundles[0].0 as usize..bundles[0].1 as usize).map(|at| (at, self.point(at))));
            };
            self.nested(bundles.chunks(1), sizes, places, |at, _, near| {
                answers.push(visit(at, near, part_of_next.next().and_then(|part| shared.get(part))));
            });
            answers
        })
    }

    /// Calls `visit(place, position, surroundings)` for all that ask in each run of bundles.
    fn nested<'a>(
        &self,
        runs: impl Iterator<Item = &'a [(u32, u32)]>,
        sizes: &[usize],
        who_asks: impl Fn(&[(u32, u32)], &mut Vec<Asking>),
        mut visit: impl FnMut(usize, &Vec3, &Nested<'_>),
    ) {
        let (&count, smaller) = sizes.split_last().expect("at least one size");
        let count = count.clamp(1, self.len());
        let (mut search, mut asking) = (Search::default(), Vec::new());
        for run in runs {
            who_asks(run, &mut asking);
            let places = run[0].0 as usize..run[run.len() - 1].1 as usize;
            self.search(places, asking.drain(..), count, &mut search, |at, position, search| {
                for &size in smaller.iter().filter(|&&size| 0 < size && size < count) {
                    search.list.settle(size);
                }
                visit(at, position, &Nested { list: &search.list, near: &search.list.near[..count] });
                f64::from(search.reach_squared)
            });
        }
    }
}

/// The places of a bundle in even parts that share.
fn parts(&(start, end): &(u32, u32)) -> impl Iterator<Item = Range<usize>> + use<> {
    let (start, len) = (start as usize, (end - start) as usize);
    let parts = len.div_ceil(SHARING);
    (0..parts).map(move |part| start + part * len / parts..start + (part + 1) * len / parts)
}
