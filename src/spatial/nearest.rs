//! The k nearest neighbours of every point of a cloud at once.
//!
//! Points are sorted along a Morton curve and cut into small bundles, which a binary tree of boxes holds together. All
//! points of a bundle search together: the radius that sufficed for the bundle before is tried first, the points of
//! the tree within it are gathered once, as 32-bit offsets from the bundle, and each point of the bundle takes its
//! nearest from the list by a counting sort (`choice`); where the radius held too few it grows and the point looks
//! again. The last choice is made with 64-bit distances, so the answers are exact for any distribution; it is fast for
//! points on surfaces. Who needs no order among the neighbours asks for nested sets of them (`nested`): faster.
//!
//! Guarantees: neighbours sorted by distance and index, the same on any number of threads.
//! Reference for the tree over the curve: C. Lauterbach et al., "Fast BVH construction on GPUs", Computer Graphics
//! Forum 28(2), 2009, doi:10.1111/j.1467-8659.2009.01377.x (here cut at jumps of the curve instead of at key bits).
//! Cost: one sort of integers, and about 0.4 microseconds a point for 16 neighbours.

mod choice;
mod nested;

pub use nested::Nested;

use super::{Neighbour, VoxelGrid};
use crate::numeric::Vec3;
use choice::List;
use rayon::prelude::*;

/// Most points in a bundle.
const BUNDLE: usize = 16;
/// Bundles handled by one task.
const TASK: usize = 64;
/// The square of the radius tried first, in squares of the radius that the bundle before needed.
const FIRST_TRY: f64 = 1.25;
/// A bundle wider than this many radii is searched point by point: its common list would be long.
const WIDE: f64 = 4.0;
/// A position looks first about as far as the one before had to: in squared distance farther by so many statistical
/// errors of the number of points.
const FARTHER: f32 = 1.5;
/// Relative error of squared distances in 32 bits, with a margin.
const ROUNDING: f32 = 4e-6;

/// Calls `visit(i, neighbours)` for every point `i` with its `count` nearest points (itself included; all of them when
/// there are fewer), nearest first, and collects the answers in point order. Points must be finite.
pub fn for_each_neighbourhood<T: Clone + Send + Sync>(
    points: &[Vec3],
    count: usize,
    visit: impl Fn(usize, &[Neighbour]) -> T + Sync,
) -> Vec<T> {
    BundleTree::new(points).for_each(count, visit)
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Box3 {
    low: Vec3,
    high: Vec3,
}

impl Box3 {
    fn distance_squared(&self, other: &Self) -> f64 {
        // Unlike `f64::max` one instruction: no coordinate is NaN.
        let larger = |a: f64, b: f64| if a > b { a } else { b };
        let gap =
            |axis: usize| larger(larger(self.low[axis] - other.high[axis], other.low[axis] - self.high[axis]), 0.0);
        let [x, y, z] = [gap(0), gap(1), gap(2)];
        x * x + y * y + z * z
    }
}

#[derive(Clone, Debug, PartialEq)]
struct Node {
    bounds: Box3,
    /// Points for a bundle; unused for an inner node.
    start: u32,
    end: u32,
    /// The second child of an inner node (the first follows it); 0 for a bundle.
    second: u32,
}

/// Points ready to be asked for the neighbours of each of them.
#[derive(Clone, Debug, PartialEq)]
pub struct BundleTree {
    /// Coordinates along the curve.
    x: Vec<f64>,
    y: Vec<f64>,
    z: Vec<f64>,
    /// Index of each of them in the input.
    order: Vec<u32>,
    /// Whether the input was in the order of the curve already.
    ordered: bool,
    nodes: Vec<Node>,
    bundles: Vec<(u32, u32)>,
}

/// Reusable memory of a search.
#[derive(Default)]
struct Search {
    /// Squared radius that the last bundle needed; 0 before the first.
    radius_squared: f64,
    stack: Vec<u32>,
    list: List,
    /// Squared distance within which the last place had what it asked for; 0 before the first.
    reach_squared: f32,
    found: Vec<Neighbour>,
}

impl BundleTree {
    /// Sorts finite points and builds the tree.
    pub fn new(points: &[Vec3]) -> Self {
        let Some((low, high)) = super::voxel_grid::bounds(points) else { return Self::of_ordered(points) };
        // A cell of about one point on a surface; the order inside a cell does not matter.
        let extent = (high - low).amax();
        let cell_m = (extent / (points.len() as f64).sqrt()).max(1e-9 * extent).max(1e-12);
        Self::along(points, VoxelGrid::new(points, cell_m).into_order(), false)
    }

    /// Builds the tree over finite points that come in a spatial order already (that of a [`VoxelGrid`]): no sort, and
    /// places on the curve are the points' own indices.
    pub fn of_ordered(points: &[Vec3]) -> Self {
        Self::along(points, (0..points.len() as u32).collect(), true)
    }

    fn along(points: &[Vec3], order: Vec<u32>, ordered: bool) -> Self {
        let along = |axis: usize| order.par_iter().map(|&i| points[i as usize][axis]).collect();
        let (x, y, z) = (along(0), along(1), along(2));
        let mut tree = Self { x, y, z, order, ordered, nodes: Vec::new(), bundles: Vec::new() };
        if points.is_empty() {
            return tree;
        }
        let whole = 0..tree.order.len();
        // Parts are built side by side and appended in order.
        let mut parts = vec![whole];
        for _ in 0..6 {
            parts = parts.into_iter().flat_map(|r| tree.split(r)).collect();
        }
        let built: Vec<Vec<Node>> = parts
            .into_par_iter()
            .map(|range| {
                let mut nodes = Vec::new();
                tree.build(range, &mut nodes);
                nodes
            })
            .collect();
        tree.join(built);
        tree.bundles = tree.nodes.iter().filter(|n| n.second == 0).map(|n| (n.start, n.end)).collect();
        tree
    }

    /// As [`for_each_neighbourhood`].
    pub fn for_each<T: Clone + Send + Sync>(
        &self,
        count: usize,
        visit: impl Fn(usize, &[Neighbour]) -> T + Sync,
    ) -> Vec<T> {
        let id = |place: usize| self.order[place];
        self.in_point_order(self.answers(count, &id, |place, found| visit(self.order[place] as usize, found)))
    }

    /// Calls `visit(place, neighbours)` for every place on the curve; neighbours are places too. Places that are near in
    /// space are near in memory, which is what makes it faster than [`Self::for_each`]. Answers in the order of the curve.
    pub fn for_each_place<T: Send>(&self, count: usize, visit: impl Fn(usize, &[Neighbour]) -> T + Sync) -> Vec<T> {
        self.answers(count, &|place| place as u32, visit)
    }

    /// The answers for about `wanted` of the places, evenly spread in runs along the curve; in the order of the curve.
    pub fn for_sample<T: Send>(
        &self,
        wanted: usize,
        count: usize,
        visit: impl Fn(usize, &[Neighbour]) -> T + Sync,
    ) -> Vec<T> {
        if count == 0 {
            return Vec::new();
        }
        let stride = (self.order.len() / wanted.max(1)).max(1);
        let some: Vec<(u32, u32)> = self.bundles.iter().copied().step_by(stride).collect();
        let parts: Vec<Vec<T>> = some
            .par_chunks(TASK)
            .map(|bundles| {
                let alone = bundles.iter().flat_map(|b| self.answer(&[*b], count, &|place| place as u32, &visit));
                alone.collect()
            })
            .collect();
        parts.into_iter().flatten().collect()
    }

    /// The `count` points nearest to the one at a place (itself included; all when there are fewer), by their index in
    /// the input, nearest first, equal distances by index.
    pub fn nearest(&self, place: usize, count: usize) -> Vec<Neighbour> {
        if count == 0 {
            return Vec::new();
        }
        let alone = [(place as u32, place as u32 + 1)];
        self.answer(&alone, count, &|at| self.order[at], &|_, found| found.to_vec()).pop().unwrap_or_default()
    }

    /// Places on the curve of some of the points, given by their index.
    pub fn places_of(&self, points: &[usize]) -> Vec<usize> {
        if self.ordered {
            return points.to_vec();
        }
        let places = self.places();
        points.iter().map(|&point| places[point] as usize).collect()
    }

    /// Values along the curve, put into the order of the points.
    pub fn in_point_order<T: Clone + Send + Sync>(&self, along_curve: Vec<T>) -> Vec<T> {
        if self.ordered {
            return along_curve;
        }
        self.places().into_par_iter().map(|at| along_curve[at as usize].clone()).collect()
    }

    /// Place on the curve of each point.
    fn places(&self) -> Vec<u32> {
        let mut places = vec![0u32; self.order.len()];
        for (at, &i) in self.order.iter().enumerate() {
            places[i as usize] = at as u32;
        }
        places
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.order.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// The point at a place of the curve.
    pub fn point(&self, place: usize) -> Vec3 {
        Vec3::new(self.x[place], self.y[place], self.z[place])
    }

    fn answers<T: Send>(
        &self,
        count: usize,
        id: &(impl Fn(usize) -> u32 + Sync),
        visit: impl Fn(usize, &[Neighbour]) -> T + Sync,
    ) -> Vec<T> {
        if count == 0 {
            return (0..self.order.len()).map(|place| visit(place, &[])).collect();
        }
        self.tasks(|bundles| self.answer(bundles, count, id, &visit))
    }

    /// Answers of all tasks, in the order of the curve.
    fn tasks<T: Send>(&self, task: impl Fn(&[(u32, u32)]) -> Vec<T> + Sync) -> Vec<T> {
        let answers: Vec<Vec<T>> = self.bundles.par_chunks(TASK).map(&task).collect();
        let mut all = Vec::with_capacity(self.order.len());
        answers.into_iter().for_each(|part| all.extend(part));
        all
    }

    fn answer<T>(
        &self,
        bundles: &[(u32, u32)],
        count: usize,
        id: &impl Fn(usize) -> u32,
        visit: &impl Fn(usize, &[Neighbour]) -> T,
    ) -> Vec<T> {
        let mut search = Search::default();
        let mut answers = Vec::with_capacity(bundles.len() * BUNDLE);
        for &(start, end) in bundles {
            let count = count.min(self.order.len());
            let places = (start as usize..end as usize).map(|at| (at, self.point(at)));
            self.search(start as usize..end as usize, places, count, &mut search, |at, _, search| {
                self.sort(at, count, id, search);
                answers.push(visit(at, &search.found));
                search.found.last().map_or(0.0, |n| n.distance_squared)
            });
        }
        answers
    }

    /// Two halves, cut where the curve jumps farthest within the middle third; one part if it is small.
    fn split(&self, range: std::ops::Range<usize>) -> Vec<std::ops::Range<usize>> {
        let len = range.len();
        if len <= BUNDLE {
            return vec![range];
        }
        let third = (len / 6).max(1);
        let middle = range.start + len / 2;
        let jump = |at: usize| (self.point(at) - self.point(at - 1)).norm_squared();
        let mut cut = middle;
        let mut longest = jump(middle);
        for at in (middle - third + 1)..(middle + third) {
            let length = jump(at);
            if length > longest {
                (cut, longest) = (at, length);
            }
        }
        vec![range.start..cut, cut..range.end]
    }

    /// Appends the subtree of a range and returns its box.
    fn build(&self, range: std::ops::Range<usize>, nodes: &mut Vec<Node>) -> Box3 {
        let here = nodes.len();
        let (start, end) = (range.start as u32, range.end as u32);
        let halves = self.split(range.clone());
        let empty = Box3 { low: Vec3::repeat(f64::INFINITY), high: Vec3::repeat(f64::NEG_INFINITY) };
        nodes.push(Node { bounds: empty, start, end, second: 0 });
        let bounds = if halves.len() == 1 {
            range.fold(empty, |b, at| Box3 { low: b.low.inf(&self.point(at)), high: b.high.sup(&self.point(at)) })
        } else {
            let first = self.build(halves[0].clone(), nodes);
            nodes[here].second = nodes.len() as u32;
            let second = self.build(halves[1].clone(), nodes);
            Box3 { low: first.low.inf(&second.low), high: first.high.sup(&second.high) }
        };
        nodes[here].bounds = bounds;
        bounds
    }

    /// Puts subtrees, in the order of their ranges, under one root.
    fn join(&mut self, mut parts: Vec<Vec<Node>>) {
        while parts.len() > 1 {
            let mut joined = Vec::with_capacity(parts.len().div_ceil(2));
            let mut rest = parts.into_iter();
            while let Some(first) = rest.next() {
                let Some(second) = rest.next() else {
                    joined.push(first);
                    break;
                };
                let (a, b) = (first[0].bounds, second[0].bounds);
                let bounds = Box3 { low: a.low.inf(&b.low), high: a.high.sup(&b.high) };
                let offset = first.len() as u32 + 1;
                let mut nodes = Vec::with_capacity(first.len() + second.len() + 1);
                nodes.push(Node { bounds, start: 0, end: 0, second: offset });
                let moved = |by: u32| {
                    move |mut n: Node| {
                        n.second += if n.second == 0 { 0 } else { by };
                        n
                    }
                };
                nodes.extend(first.into_iter().map(moved(1)));
                nodes.extend(second.into_iter().map(moved(offset)));
                joined.push(nodes);
            }
            parts = joined;
        }
        self.nodes = parts.pop().expect("at least one part");
    }

    /// Calls `visit` for each of some positions in a run of places, with the place that belongs to it, when `choose`
    /// has left its nearest points in the list; `visit` tells the squared distance of the farthest.
    fn search(
        &self,
        bundle: std::ops::Range<usize>,
        positions: impl Iterator<Item = (usize, Vec3)>,
        count: usize,
        search: &mut Search,
        mut visit: impl FnMut(usize, &Vec3, &mut Search) -> f64,
    ) {
        if search.radius_squared <= 0.0 {
            search.radius_squared = self.first_radius_squared(bundle.start, count);
        }
        let own = bundle.clone().map(|at| self.point(at)).fold(
            Box3 { low: self.point(bundle.start), high: self.point(bundle.start) },
            |b, p| Box3 { low: b.low.inf(&p), high: b.high.sup(&p) },
        );
        let mut radius_squared = search.radius_squared * FIRST_TRY;
        let wide = (own.high - own.low).norm_squared() > WIDE * WIDE * radius_squared;
        if !wide {
            self.gather(&own, radius_squared, search);
        }
        let mut needed = 0.0f64;
        for (at, p) in positions {
            // Points of a wide bundle have a list of their own and start anew.
            let from = if wide { Box3 { low: p, high: p } } else { own };
            let mut tried = if wide { search.radius_squared * FIRST_TRY } else { radius_squared };
            if wide {
                self.gather(&from, tried, search);
            }
            while !self.choose(&p, &from, tried, count, search) {
                // The emptier the surroundings turn out to be, the more the radius grows.
                let share = count as f64 / search.list.near.len().max(1) as f64;
                tried *= (1.3 * share).clamp(1.5, 16.0);
                self.gather(&from, tried, search);
            }
            radius_squared = tried;
            needed = needed.max(visit(at, &p, search));
        }
        // A lone point must not make its successors gather half the cloud.
        let before = search.radius_squared;
        search.radius_squared = if needed > 0.0 { needed.clamp(before / 4.0, before * 4.0) } else { before };
    }

    /// A squared radius that is not far from what a place needs: that of its neighbours on the curve.
    fn first_radius_squared(&self, at: usize, count: usize) -> f64 {
        let near = at.saturating_sub(count)..(at + count + 1).min(self.order.len());
        let p = self.point(at);
        let mut squared: Vec<f64> = near.map(|other| (self.point(other) - p).norm_squared()).collect();
        let last = (count - 1).min(squared.len() - 1);
        let (_, radius_squared, _) = squared.select_nth_unstable_by(last, f64::total_cmp);
        // Equal points have no distance; any positive radius finds them.
        radius_squared.max(f64::MIN_POSITIVE * 1e30)
    }

    /// Collects the points of all bundles that come within the radius of a box.
    fn gather(&self, own: &Box3, radius_squared: f64, search: &mut Search) {
        let Search { stack, list, .. } = search;
        list.clear();
        let middle = (own.low + own.high) / 2.0;
        let reach = radius_squared.sqrt() * (1.0 + 1e-6);
        let (low, high) = (own.low.add_scalar(-reach), own.high.add_scalar(reach));
        stack.clear();
        stack.push(0);
        while let Some(node) = stack.pop() {
            let n = &self.nodes[node as usize];
            if n.bounds.distance_squared(own) > radius_squared {
                continue;
            }
            if n.second != 0 {
                stack.push(n.second);
                stack.push(node + 1);
                continue;
            }
            let (start, end) = (n.start as usize, n.end as usize);
            debug_assert!(end - start <= BUNDLE, "more would not fit into `kept`");
            let points = self.x[start..end].iter().zip(&self.y[start..end]).zip(&self.z[start..end]);
            let mut kept = ([0.0f32; BUNDLE], [0.0f32; BUNDLE], [0.0f32; BUNDLE], [0u32; BUNDLE]);
            let mut count = 0;
            // Written first, kept if inside: no branch to guess.
            for (k, ((&px, &py), &pz)) in points.enumerate() {
                let slot = count % BUNDLE;
                kept.0[slot] = (px - middle.x) as f32;
                kept.1[slot] = (py - middle.y) as f32;
                kept.2[slot] = (pz - middle.z) as f32;
                kept.3[slot] = (start + k) as u32;
                let inside = (px >= low.x) & (px <= high.x) & (py >= low.y);
                count += usize::from(inside & (py <= high.y) & (pz >= low.z) & (pz <= high.z));
            }
            let count = count.min(BUNDLE);
            list.x.extend_from_slice(&kept.0[..count]);
            list.y.extend_from_slice(&kept.1[..count]);
            list.z.extend_from_slice(&kept.2[..count]);
            list.at.extend_from_slice(&kept.3[..count]);
        }
    }

    /// Brings the `count` nearest of the gathered points to the front of `list.near`; false when there are fewer within
    /// the radius, or when 32 bits do not tell. See [`List::settle`].
    fn choose(&self, p: &Vec3, own: &Box3, radius_squared: f64, count: usize, search: &mut Search) -> bool {
        let Search { list, reach_squared, .. } = search;
        let middle = (own.low + own.high) / 2.0;
        list.measure([(p.x - middle.x) as f32, (p.y - middle.y) as f32, (p.z - middle.z) as f32]);
        // Offsets are rounded relative to the size of the list, distances relative to themselves.
        let size = (own.high - own.low).norm() + radius_squared.sqrt();
        let slack = (ROUNDING as f64 * size) as f32;
        let everything = list.at.len() == self.order.len();
        let most = if everything { f32::INFINITY } else { radius_squared as f32 };
        let first = *reach_squared * (1.0 + FARTHER / (count as f32).sqrt());
        for limit in [first, most] {
            if limit <= most && list.within(limit) >= count {
                list.rank(limit);
                // Everything that 32 bits cannot tell from the last one is within reach too.
                let reach = (list.settle(count).sqrt() + slack).powi(2) * (1.0 + ROUNDING);
                if reach <= limit {
                    *reach_squared = reach;
                    return true;
                }
            }
        }
        false
    }

    /// The exact choice among what [`Self::choose`] left, into `search.found`.
    fn sort(&self, at: usize, count: usize, id: &impl Fn(usize) -> u32, search: &mut Search) {
        let p = self.point(at);
        let Search { list, reach_squared, found, .. } = search;
        list.sort();
        found.clear();
        for &number in list.near.iter().take_while(|&&number| list.squared[number as usize] <= *reach_squared) {
            let k = list.at[number as usize] as usize;
            let (dx, dy, dz) = (self.x[k] - p.x, self.y[k] - p.y, self.z[k] - p.z);
            let new = Neighbour { index: id(k), distance_squared: dx * dx + dy * dy + dz * dz };
            // In order but for the last bits: insertion costs one comparison for nearly all.
            let mut slot = found.len();
            found.push(new);
            while slot > 0 && by_distance(&new, &found[slot - 1]).is_lt() {
                found[slot] = found[slot - 1];
                slot -= 1;
            }
            found[slot] = new;
        }
        found.truncate(count);
    }
}

fn by_distance(a: &Neighbour, b: &Neighbour) -> std::cmp::Ordering {
    a.distance_squared.total_cmp(&b.distance_squared).then(a.index.cmp(&b.index))
}

#[cfg(test)]
mod tests;
