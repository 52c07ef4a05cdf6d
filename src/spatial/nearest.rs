//! The k nearest neighbours of every point of a cloud at once.

use super::{KdTree, Neighbour};
use crate::numeric::Vec3;
use rayon::prelude::*;

/// Calls `visit(i, neighbours)` for every point `i` with its `count` nearest points (itself included), nearest first,
/// and collects the answers in point order. Fast when `points` are in a spatial order.
pub fn for_each_neighbourhood<T: Send>(
    points: &[Vec3],
    count: usize,
    visit: impl Fn(usize, &[Neighbour]) -> T + Sync,
) -> Vec<T> {
    let tree = KdTree::new(points);
    points.par_iter().enumerate().with_min_len(1024).map(|(i, p)| visit(i, &tree.nearest_n(p, count))).collect()
}
