//! Nearest neighbours of any set of points, answers in a fixed order.
//!
//! Use it for scattered queries and for points of any distribution. Many equal points end up in one leaf, which makes
//! each query near them linear in their number: remove exact duplicates first (`clean` does).

use crate::numeric::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use std::num::NonZero;

/// One answer of a query.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Neighbour {
    /// Index of the point in the slice that the tree was built from.
    pub index: u32,
    /// Squared distance to the query, square metres.
    pub distance_squared: f64,
}

/// A k-d tree over points in memory.
#[derive(Debug)]
pub struct KdTree {
    /// `None` for no points: the tree underneath wants at least one.
    tree: Option<ImmutableKdTree<f64, 3>>,
    len: usize,
}

impl KdTree {
    /// Builds the tree in O(n log n). Points that are not finite are never found.
    pub fn new(points: &[Vec3]) -> Self {
        let len = points.len();
        let far = [f64::INFINITY; 3];
        let coordinates: Vec<[f64; 3]> =
            points.iter().map(|p| if p.iter().all(|c| c.is_finite()) { (*p).into() } else { far }).collect();
        let tree = (len > 0).then(|| ImmutableKdTree::new_from_slice(&coordinates).expect("non-empty points build"));
        Self { tree, len }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether the tree has no points.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The nearest point, or `None` for an empty tree.
    pub fn nearest(&self, query: &Vec3) -> Option<Neighbour> {
        let found = self.tree.as_ref()?.query(&(*query).into()).nearest_one::<SquaredEuclidean<f64>>().execute();
        found.distance.is_finite().then_some(Neighbour { index: found.item, distance_squared: found.distance })
    }

    /// The `count` nearest points (fewer when there are fewer), nearest first, equal distances by index.
    pub fn nearest_n(&self, query: &Vec3, count: usize) -> Vec<Neighbour> {
        let (Some(tree), Some(count)) = (&self.tree, NonZero::new(count)) else { return Vec::new() };
        let found = tree.query(&(*query).into()).nearest_n::<SquaredEuclidean<f64>>(count).execute();
        in_order(found.into_iter().map(|f| Neighbour { index: f.item, distance_squared: f.distance }))
    }

    /// All points within `radius` metres, nearest first, equal distances by index.
    pub fn within(&self, query: &Vec3, radius: f64) -> Vec<Neighbour> {
        let Some(tree) = &self.tree else { return Vec::new() };
        let found = tree.query(&(*query).into()).within::<SquaredEuclidean<f64>>(radius * radius).unsorted().execute();
        in_order(found.into_iter().map(|f| Neighbour { index: f.item, distance_squared: f.distance }))
    }
}

fn in_order(found: impl Iterator<Item = Neighbour>) -> Vec<Neighbour> {
    let mut sorted: Vec<Neighbour> = found.filter(|n| n.distance_squared.is_finite()).collect();
    sorted.sort_unstable_by(|a, b| a.distance_squared.total_cmp(&b.distance_squared).then(a.index.cmp(&b.index)));
    sorted
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    fn brute(points: &[Vec3], query: &Vec3) -> Vec<Neighbour> {
        let all = points
            .iter()
            .enumerate()
            .map(|(i, p)| Neighbour { index: i as u32, distance_squared: (p - query).norm_squared() });
        in_order(all)
    }

    #[test]
    fn agrees_with_brute_force_on_hard_inputs() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let mut uniform = || Vec3::new(random.random(), random.random(), random.random());
        let cloud: Vec<Vec3> = (0..500).map(|_| uniform()).collect();
        let plane: Vec<Vec3> = cloud.iter().map(|p| Vec3::new(p.x, p.y, 0.0)).collect();
        let line: Vec<Vec3> = cloud.iter().map(|p| Vec3::new(p.x, 0.0, 0.0)).collect();
        let lattice: Vec<Vec3> =
            (0..512).map(|i| Vec3::new((i % 8) as f64, (i / 8 % 8) as f64, (i / 64) as f64)).collect();
        let same = vec![Vec3::new(1.0, 2.0, 3.0); 300];
        for points in [cloud, plane, line, lattice, same] {
            let tree = KdTree::new(&points);
            for query in [points[7], Vec3::new(0.4, 0.3, 0.2), Vec3::new(9.0, -3.0, 1.0)] {
                let all = brute(&points, &query);
                let nearest = tree.nearest_n(&query, 20);
                assert_eq!(nearest.len(), 20);
                for (found, wanted) in nearest.iter().zip(&all) {
                    assert!((found.distance_squared - wanted.distance_squared).abs() < 1e-12);
                }
                let radius = all[30].distance_squared.sqrt() + 1e-9;
                let inside = all.iter().filter(|n| n.distance_squared <= radius * radius).count();
                assert_eq!(tree.within(&query, radius).len(), inside);
            }
        }
    }

    #[test]
    fn empty_and_not_finite_points_are_harmless() {
        assert!(
            KdTree::new(&[]).nearest(&Vec3::zeros()).is_none()
                && KdTree::new(&[]).within(&Vec3::zeros(), 1.0).is_empty()
        );
        let tree = KdTree::new(&[Vec3::new(f64::NAN, 0.0, 0.0), Vec3::x()]);
        assert_eq!(tree.nearest_n(&Vec3::zeros(), 2).len(), 1);
    }
}
