use super::*;
use crate::spatial::KdTree;
use rand::{Rng, SeedableRng};

fn assert_same_as_the_tree(points: &[Vec3], count: usize) {
    let tree = KdTree::new(points);
    let all = for_each_neighbourhood(points, count, |_, found| found.to_vec());
    for (i, found) in all.iter().enumerate() {
        let wanted = tree.nearest_n(&points[i], count);
        assert_eq!(found.len(), wanted.len());
        for (a, b) in found.iter().zip(&wanted) {
            assert!((a.distance_squared - b.distance_squared).abs() <= 1e-12 * (1.0 + b.distance_squared));
        }
        assert!(found.windows(2).all(|w| by_distance(&w[0], &w[1]).is_lt()));
    }
}

/// Searches one by one find what the search of all finds, whether the points come in order or not.
fn assert_single_searches_agree(points: &[Vec3]) {
    let some: Vec<usize> = (0..points.len()).step_by(37).collect();
    let all = for_each_neighbourhood(points, 9, |_, found| found.to_vec());
    for tree in [BundleTree::new(points), BundleTree::of_ordered(points)] {
        let places = tree.places_of(&some);
        assert!(some.iter().zip(places).all(|(&i, place)| tree.nearest(place, 9) == all[i]));
    }
}

/// A surface, profiles, a surface with far points, equal points.
fn distributions() -> [Vec<Vec3>; 4] {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(8);
    let cylinder: Vec<Vec3> = (0..3000)
        .map(|_| {
            let a: f64 = random.random_range(0.0..std::f64::consts::TAU);
            Vec3::new(random.random_range(0.0..20.0), 3.0 * a.cos(), 3.0 * a.sin())
        })
        .collect();
    let profiles: Vec<Vec3> = (0..3000).map(|i| Vec3::new((i / 300) as f64, (i % 300) as f64 * 0.01, 0.0)).collect();
    let mut with_outliers = cylinder.clone();
    with_outliers.extend((0..20).map(|i| Vec3::new(1000.0 * i as f64, -500.0, 40.0)));
    let same = vec![Vec3::new(1.0, 1.0, 1.0); 200];
    [cylinder, profiles, with_outliers, same]
}

#[test]
fn agrees_with_the_tree() {
    for points in distributions() {
        assert_single_searches_agree(&points);
        assert_same_as_the_tree(&points, 16);
        assert_same_as_the_tree(&points[..points.len().min(40)], 64);
    }
}

/// The distance of the farthest of the first `count` of what is near, metres.
fn reach(near: &Nested<'_>, count: usize) -> f64 {
    near.offsets(0..count.min(near.len())).map(|d| Vec3::from(d).norm()).fold(0.0, f64::max)
}

#[test]
fn nested_sets_are_the_nearest_points() {
    let (own, wide) = ([5, 16], [9, 40]);
    for points in distributions() {
        let kd_tree = KdTree::new(&points);
        let assert_reach = |position: &Vec3, sizes: [usize; 2], found: [f64; 2]| {
            for (size, found) in sizes.into_iter().zip(found) {
                let wanted = kd_tree.nearest_n(position, size).last().unwrap().distance_squared.sqrt();
                assert!((found - wanted).abs() <= 1e-5 * (1.0 + wanted), "{size}: {found} {wanted}");
            }
        };
        let tree = BundleTree::new(&points);
        let share = |middle: &Vec3, near: &Nested<'_>| (*middle, wide.map(|size| reach(near, size)));
        let visit = |place: usize, near: &Nested<'_>, shared: Option<&(Vec3, [f64; 2])>| {
            (place, own.map(|size| reach(near, size)), *shared.unwrap())
        };
        let all = tree.for_each_nested(&own, &wide, share, visit);
        assert!(all.iter().map(|a| a.0).eq(0..points.len()));
        for (place, found, (middle, found_wide)) in all {
            assert_reach(&tree.point(place), own, found);
            assert_reach(&middle, wide, found_wide);
            // The middle is that of at most four places in a row, this one among them.
            let mut runs = (1..=4).flat_map(|len| (place.saturating_sub(len - 1)..=place).map(move |at| at..at + len));
            assert!(runs.any(|run| {
                let len = run.len() as f64;
                run.end <= points.len() && (run.map(|at| tree.point(at)).sum::<Vec3>() / len - middle).norm() < 1e-9
            }));
        }
        let alone = tree.for_each_nested(&own, &[], |_, _| (), |_, _, shared| shared.is_none());
        assert!(alone.into_iter().all(|none| none));
    }
}

#[test]
fn few_or_no_points() {
    let count = |points: &[Vec3]| {
        let visit = |_, near: &Nested<'_>, wide: Option<&usize>| (near.len(), wide.copied());
        BundleTree::new(points).for_each_nested(&[5], &[9], |_, near| near.len(), visit)
    };
    assert_eq!(count(&[]), []);
    assert_eq!(count(&[Vec3::zeros(), Vec3::x()]), [(2, Some(2)); 2]);
    assert!(for_each_neighbourhood(&[], 5, |_, n| n.len()).is_empty());
    assert!(BundleTree::new(&[Vec3::zeros(), Vec3::x()]).nearest(1, 0).is_empty());
    assert_eq!(for_each_neighbourhood(&[Vec3::zeros(), Vec3::x()], 5, |_, n| n.len()), [2, 2]);
}
