//! The plane at every point: over the largest neighbourhood that is still flat.
//!
//! The small neighbourhoods are the point's own. The large ones of noisy scans are taken about the middle of up to four
//! points that follow each other along the curve of the tree: a step aside that is small beside them, for a third of
//! the search. A point that does not lie on their plane, as far as its own neighbourhood tells, keeps its own.

use super::plane_fit::{Plane, Scatter, Spread};
use crate::numeric::Vec3;
use crate::numeric::statistics::median;
use crate::spatial::nearest::{BundleTree, Nested};
use std::ops::Range;

/// Numbers of neighbours tried in turn, ascending, the point included.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sizes<'a> {
    /// About each point.
    pub own: &'a [usize],
    /// Larger ones, about the middle of a few points that follow each other: their planes differ little.
    pub shared: &'a [usize],
}

/// Neighbourhoods of most scans.
const NEIGHBOURHOODS: Sizes<'static> = Sizes { own: &[14, 28], shared: &[] };
/// Those of a scan whose noise is not small against its spacing.
const NOISY_NEIGHBOURHOODS: Sizes<'static> = Sizes { own: &[18], shared: &[36, 72] };
/// Points whose noise decides between the two.
const NOISE_SAMPLE: usize = 8000;
/// Noise over spacing from which a scan is noisy in that sense.
const NOISY: f64 = 0.25;
/// A larger neighbourhood may scatter more about its plane than the one before by this many standard errors of the
/// scatter: more means an edge or a bend.
const MORE_SCATTER_ERRORS: f64 = 1.2;
/// A shared plane may pass the middle of the point's own neighbourhood by this share of the noise: more means that the
/// point belongs to something else than its successors.
const OFF_PLANE: f64 = 1.0;
/// Middle over largest eigenvalue below which a neighbourhood is a line and says nothing about the surface.
pub(super) const LINE: f64 = 0.02;

/// Unoriented normals of any points, each from the plane of its `neighbours` nearest points (itself included).
pub fn unoriented(points: &[Vec3], neighbours: usize) -> Vec<Vec3> {
    normals_of_sizes(&BundleTree::new(points), Sizes { own: &[neighbours], shared: &[] })
}

/// Unoriented normals of any points, each from as many neighbours as noise and edges allow (see the module's header).
pub fn adaptive(points: &[Vec3]) -> Vec<Vec3> {
    let tree = BundleTree::new(points);
    let sizes = neighbourhoods(&tree);
    normals_of_sizes(&tree, sizes)
}

fn normals_of_sizes(tree: &BundleTree, sizes: Sizes<'_>) -> Vec<Vec3> {
    tree.in_point_order(for_each(tree, sizes, |_, chosen| chosen.map_or(Vec3::z(), |(plane, _)| plane.normal)))
}

/// Calls `visit(place, chosen)` for every place of the tree with its plane and the number of points it was taken over;
/// `None` where there are fewer than three points. Answers in the order of places.
pub(super) fn for_each<T: Send>(
    tree: &BundleTree,
    sizes: Sizes<'_>,
    visit: impl Fn(usize, Option<(Plane, usize)>) -> T + Sync,
) -> Vec<T> {
    let share = |middle: &Vec3, near: &Nested<'_>| -> Vec<(Plane, usize)> {
        let mut scatter = Scatter::about(*middle);
        let mut taken = 0;
        let plane_of_size = |&size: &usize| {
            let until = size.min(near.len());
            near.offsets(taken..until).for_each(|offset| scatter.add_offset(offset));
            taken = until;
            Some((scatter.spread()?.plane(), until))
        };
        sizes.shared.iter().map_while(plane_of_size).collect()
    };
    tree.for_each_nested(sizes.own, sizes.shared, share, |place, near, shared| {
        let add = |scatter: &mut Scatter, range| near.offsets(range).for_each(|offset| scatter.add_offset(offset));
        let mut chosen = largest_flat(tree.point(place), near.len(), sizes.own, add);
        for &(plane, size) in shared.into_iter().flatten() {
            let Some((before, count)) = &chosen else { break };
            let off = (before.centre - plane.centre).dot(&plane.normal).abs();
            let allowed = growth(*count) * before.noise_m;
            if before.roundness >= LINE && (plane.noise_m > allowed || off > OFF_PLANE * before.noise_m) {
                break;
            }
            chosen = Some((plane, size));
        }
        visit(place, chosen)
    })
}

/// The noise about the plane of a larger neighbourhood over that of one of `count` points up to which it is as flat.
fn growth(count: usize) -> f64 {
    1.0 + MORE_SCATTER_ERRORS / (2.0 * (count as f64 - 3.0).max(1.0)).sqrt()
}

/// The neighbourhoods to try, by the noise and the spacing of a sample of the points.
pub(super) fn neighbourhoods(tree: &BundleTree) -> Sizes<'static> {
    let sample = tree.for_sample(NOISE_SAMPLE, NEIGHBOURHOODS.own[NEIGHBOURHOODS.own.len() - 1], |place, found| {
        let add = |scatter: &mut Scatter, range: Range<usize>| {
            found[range].iter().for_each(|n| scatter.add(&tree.point(n.index as usize)));
        };
        let chosen = largest_flat(tree.point(place), found.len(), NEIGHBOURHOODS.own, add);
        let noise_m = chosen.map_or(0.0, |(plane, _)| plane.noise_m);
        (noise_m, found.get(1).map_or(0.0, |n| n.distance_squared.sqrt()))
    });
    let (mut noises, mut spacings): (Vec<f64>, Vec<f64>) = sample.into_iter().unzip();
    let noisy = median(&mut noises).unwrap_or(0.0) > NOISY * median(&mut spacings).unwrap_or(0.0);
    if noisy { NOISY_NEIGHBOURHOODS } else { NEIGHBOURHOODS }
}

/// The plane over the largest of the neighbourhoods of a point that is still flat, and how many points that is. `add`
/// adds some of its `available` nearest points.
fn largest_flat(
    point: Vec3,
    available: usize,
    sizes: &[usize],
    add: impl Fn(&mut Scatter, Range<usize>),
) -> Option<(Plane, usize)> {
    let mut scatter = Scatter::about(point);
    let mut chosen: Option<(Spread, usize)> = None;
    let mut taken = 0;
    for &size in sizes {
        let until = size.min(available);
        add(&mut scatter, taken..until);
        taken = until;
        let Some(spread) = scatter.spread() else { break };
        let grows = chosen.is_none_or(|(before, count)| {
            let allowed = growth(count).powi(2) * before.noise_squared();
            before.roundness() < LINE || spread.noise_squared() <= allowed
        });
        if !grows {
            break;
        }
        chosen = Some((spread, taken));
    }
    chosen.map(|(spread, count)| (spread.plane(), count))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Metres; half of the spacing of the points, which makes them noisy.
    const NOISE_M: f64 = 0.003;

    fn noise(random: &mut ChaCha8Rng) -> f64 {
        NOISE_M * (0..12).map(|_| random.random_range(-0.5..0.5)).sum::<f64>()
    }

    /// Two plates of 70 cm that meet at a right angle along x; for each point its true normal and its distance from the
    /// edge.
    fn corner() -> (Vec<Vec3>, Vec<(Vec3, f64)>) {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let point = |random: &mut ChaCha8Rng| {
            let (x, from_edge) = (random.random_range(0.0..0.7), random.random_range(-0.7..0.7));
            let height = noise(random);
            if from_edge < 0.0 {
                (Vec3::new(x, -from_edge, height), (Vec3::z(), -from_edge))
            } else {
                (Vec3::new(x, height, from_edge), (Vec3::y(), from_edge))
            }
        };
        (0..27_000).map(|_| point(&mut random)).unzip()
    }

    fn errors_deg(normals: &[Vec3], truth: &[(Vec3, f64)], from_edge: Range<f64>) -> Vec<f64> {
        let near = normals.iter().zip(truth).filter(|(_, (_, distance))| from_edge.contains(distance));
        near.map(|(normal, (wanted, _))| normal.dot(wanted).abs().min(1.0).acos().to_degrees()).collect()
    }

    #[test]
    fn large_neighbourhoods_average_noise_but_stop_at_edges() {
        let (points, truth) = corner();
        let (small, large) = (unoriented(&points, 18), unoriented(&points, 72));
        let grown = adaptive(&points);
        let median_of = |normals: &[Vec3], range| median(&mut errors_deg(normals, &truth, range)).unwrap();
        // Far from the edge nearly as good as the large ones.
        let far = 0.1..0.6;
        assert!(median_of(&grown, far.clone()) < 0.4 * median_of(&small, far.clone()));
        assert!(median_of(&grown, far.clone()) < 1.4 * median_of(&large, far));
        // Beside it, where large ones lean over to the other side, nearly as good as the small ones.
        let beside = 0.012..0.02;
        assert!(median_of(&grown, beside.clone()) < 0.7 * median_of(&large, beside.clone()));
        assert!(median_of(&grown, beside.clone()) < 1.3 * median_of(&small, beside));
    }

    #[test]
    fn a_rod_before_a_wall_stays_before_it() {
        let mut random = ChaCha8Rng::seed_from_u64(6);
        let mut points: Vec<Vec3> = (0..14_000)
            .map(|_| Vec3::new(random.random_range(0.0..0.7), random.random_range(0.0..0.7), noise(&mut random)))
            .collect();
        let wall = points.len();
        points.extend(
            (0..140).map(|i| Vec3::new(0.005 * i as f64, 0.35 + noise(&mut random), 0.04 + noise(&mut random))),
        );
        let tree = BundleTree::new(&points);
        let to_plane = tree.in_point_order(for_each(&tree, NOISY_NEIGHBOURHOODS, |place, chosen| {
            let (plane, _) = chosen.unwrap();
            ((plane.centre - tree.point(place)).dot(&plane.normal).abs(), plane.noise_m)
        }));
        let moved = to_plane[wall..].iter().filter(|(distance, _)| *distance > 4.0 * NOISE_M).count();
        assert!(moved < 3, "{moved} of 140 points of the rod left it");
        let mut noises: Vec<f64> = to_plane[..wall].iter().map(|(_, noise_m)| *noise_m).collect();
        let noise_m = median(&mut noises).unwrap();
        assert!((noise_m / NOISE_M - 1.0).abs() < 0.1, "{noise_m}");
    }

    #[test]
    fn the_same_bytes_on_one_and_on_three_threads() {
        let (points, _) = corner();
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| adaptive(&points))
        };
        let bits =
            |normals: Vec<Vec3>| -> Vec<[u64; 3]> { normals.iter().map(|n| n.map(f64::to_bits).into()).collect() };
        assert_eq!(bits(on(1)), bits(on(3)));
    }
}
