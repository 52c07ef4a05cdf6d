//! The surface against shapes known in closed form.

use super::*;
use crate::mesh::{Mesh, repair, topology};
use std::f64::consts::{PI, TAU};

const OPTIONS: Options = Options { spacing_m: Some(0.1), max_gap_m: 0.15, fill_hole_m: 0.6, perimeter_m: TAU * 2.0 };

fn straight() -> Axis {
    Axis::through(&[Vec3::new(0.5, 0.0, 0.0), Vec3::new(7.5, 0.0, 0.0)], 0.0).unwrap()
}

/// Even points on a tube of 2 m radius and 8 m length around the x axis.
fn tube(count: u32) -> Vec<Vec3> {
    (0..count)
        .map(|i| {
            let s = 8.0 * (f64::from(i) * 0.618_033_988_749_895).fract();
            let a = TAU * (f64::from(i) * 0.754_877_666_246_693).fract() - PI;
            Vec3::new(s, -2.0 * a.sin(), 2.0 * a.cos())
        })
        .collect()
}

/// Even directions.
fn directions(count: u32) -> impl Iterator<Item = Vec3> {
    (0..count).map(move |i| {
        let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / f64::from(count);
        let (sin, cos) = (2.399_963_229_728_653 * f64::from(i)).sin_cos();
        Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
    })
}

/// A number between -1 and 1 that looks like chance.
fn chance(i: usize) -> f64 {
    2.0 * (43_758.547 * (12.989_8 * i as f64).sin()).fract().abs() - 1.0
}

fn repaired(raw: Raw) -> Mesh {
    let mut repaired = repair::Repaired::of(raw.vertices, raw.faces, raw.observed);
    repaired.keep_largest();
    repaired.into_mesh().0
}

fn mesh_of(points: Vec<Vec3>) -> (Mesh, Summary) {
    let (raw, summary) = reconstruct(points.clone(), &points, &straight(), &OPTIONS);
    (repaired(raw), summary)
}

/// The surface of points on a closed shape, by their true inward normals.
fn closed(samples: impl Iterator<Item = (Vec3, Vec3)>, cell_m: f64) -> (Mesh, Summary) {
    let (points, normals): (Vec<Vec3>, Vec<Vec3>) = samples.unzip();
    let (raw, summary) = surface_of(&points, &normals, cell_m, 0.05, 0.3);
    (repaired(raw), summary)
}

fn loops(mesh: &Mesh) -> usize {
    topology::boundary_loops(mesh.faces(), mesh.twins()).len()
}

/// Vertices less edges plus faces of a closed mesh.
fn euler(mesh: &Mesh) -> i64 {
    assert_eq!(loops(mesh), 0);
    mesh.vertices().len() as i64 - mesh.faces().len() as i64 / 2
}

fn rms(errors: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = errors.fold((0.0, 0.0), |(s, n), e| (s + e * e, n + 1.0));
    (sum / count).sqrt()
}

#[test]
fn a_sphere_becomes_one_and_finer_cells_lie_closer() {
    let at = |cell_m: f64| {
        let (mesh, summary) = closed(directions(60_000).map(|n| (2.0 * n, -n)), cell_m);
        assert_eq!((euler(&mesh), summary.levels_not_converged), (2, 0));
        assert!(mesh.observed().iter().all(|o| *o));
        for f in 0..mesh.faces().len() as u32 {
            assert!(mesh.double_area_vector(f).dot(&mesh.corners(f)[0]) < 0.0, "faces look inwards");
        }
        rms(mesh.vertices().iter().map(|v| v.norm() - 2.0))
    };
    let (coarse, fine) = (at(0.2), at(0.1));
    assert!(coarse < 0.01 && fine < 0.5 * coarse, "{coarse} {fine}");
}

#[test]
fn a_torus_keeps_its_handle() {
    let samples = (0..80_000).map(|i| {
        let (a, b) = (
            TAU * (f64::from(i) * 0.618_033_988_749_895).fract(),
            TAU * (f64::from(i) * 0.754_877_666_246_693).fract(),
        );
        let out = Vec3::new(a.cos() * b.cos(), a.sin() * b.cos(), b.sin());
        (2.0 * Vec3::new(a.cos(), a.sin(), 0.0) + 0.7 * out, -out)
    });
    let (mesh, _) = closed(samples, 0.1);
    assert_eq!(euler(&mesh), 0);
    assert!(rms(mesh.vertices().iter().map(|v| (v.x.hypot(v.y) - 2.0).hypot(v.z) - 0.7)) < 0.005);
}

#[test]
fn noise_is_averaged() {
    // Even noise of 30 mm has 17 mm rms; nine points a cell.
    let noisy = directions(50_000).enumerate().map(|(i, n)| ((2.0 + 0.03 * chance(i)) * n, -n));
    let (mesh, _) = closed(noisy, 0.1);
    assert_eq!(euler(&mesh), 2);
    let error = rms(mesh.vertices().iter().map(|v| v.norm() - 2.0));
    assert!(error < 0.008, "{error}");
}

#[test]
fn sparse_places_are_solved_on_coarser_cells_and_stay_whole() {
    // A sixteenth of the points below: four times the distance, 0.09 m, in cells of 0.05 m.
    let above = directions(100_000).filter(|n| n.z > 0.0);
    let uneven = above.chain(directions(6_250).filter(|n| n.z <= 0.0)).map(|n| (2.0 * n, -n));
    let (points, normals): (Vec<Vec3>, Vec<Vec3>) = uneven.unzip();
    let (raw, summary) = surface_of(&points, &normals, 0.05, 0.12, 0.3);
    let mesh = repaired(raw);
    assert_eq!(euler(&mesh), 2);
    let at = &summary.points_of_level;
    assert!(at[at.len() - 1] > 40_000 && at[at.len() - 2] + at[at.len() - 3] > 2_000, "{at:?}");
    let below = rms(mesh.vertices().iter().filter(|v| v.z < -0.1).map(|v| v.norm() - 2.0));
    assert!(below < 0.006, "{below}");
}

#[test]
fn a_tube_becomes_a_tube_that_faces_inwards() {
    let (mesh, summary) = mesh_of(tube(40_000));
    assert_eq!((loops(&mesh), summary.points_hidden), (2, 0));
    for v in mesh.vertices() {
        assert!((v.y.hypot(v.z) - 2.0).abs() < 0.006, "{}", v.y.hypot(v.z));
        // Both portals stay open: nothing is drawn across them.
        assert!(v.x > -0.06 && v.x < 8.06, "{}", v.x);
    }
    for f in 0..mesh.faces().len() as u32 {
        let [a, b, c] = mesh.corners(f);
        assert!(mesh.double_area_vector(f).dot(&Vec3::new(0.0, (a + b + c).y, (a + b + c).z)) < 0.0);
    }
}

#[test]
fn what_hides_behind_itself_keeps_both_sides() {
    // A ledge: a plate 0.6 m thick that stands out 1 m from the wall on the right, seen from above and from below.
    let mut points = tube(60_000);
    points.retain(|p| !(p.y < 0.0 && p.z.abs() < 0.3));
    for i in 0..40 {
        for k in 0..320 {
            let (along, out) = (f64::from(k) * 0.025, f64::from(i) * 0.025);
            for z in [-0.3, 0.3] {
                points.push(Vec3::new(along, -(4.0f64 - 0.09).sqrt() + out, z));
            }
        }
    }
    for i in 0..24 {
        let z = -0.3 + f64::from(i) * 0.025;
        points.extend((0..320).map(|k| Vec3::new(f64::from(k) * 0.025, -(4.0f64 - 0.09).sqrt() + 1.0, z)));
    }
    let (mesh, _) = mesh_of(points);
    let near = |p: Vec3| mesh.vertices().iter().map(|v| (v - p).norm()).fold(f64::INFINITY, f64::min);
    assert!(near(Vec3::new(4.0, -1.5, 0.3)) < 0.08 && near(Vec3::new(4.0, -1.5, -0.3)) < 0.08);
    assert_eq!(loops(&mesh), 2);
}

#[test]
fn a_small_hole_is_filled_and_marked_a_scan_shadow_stays() {
    let mut points = tube(60_000);
    points.retain(|p| {
        let girth = 2.0 * (-p.y).atan2(p.z);
        (p.x - 3.0).hypot(girth - 3.0) > 0.26 && (p.x - 5.0).hypot(girth + 3.0) > 0.6
    });
    let (mesh, summary) = mesh_of(points.clone());
    assert!(summary.faces_filled > 0 && summary.unsupported_faces_dropped > 0);
    assert_eq!(loops(&mesh), 3);
    let tree = KdTree::new(&points);
    for (f, seen) in mesh.observed().iter().enumerate() {
        let far = mesh.corners(f as u32).iter().any(|v| tree.nearest(v).unwrap().distance_squared.sqrt() > 0.15);
        assert_eq!(far, !seen);
    }
}

#[test]
fn few_points_and_outliers_far_away_do_no_harm() {
    assert!(surface_of(&[], &[], 0.1, 0.05, 0.3).0.faces.is_empty());
    let one = surface_of(&[Vec3::new(1e6, 2e6, 3.0)], &[Vec3::z()], 0.1, 0.05, 0.3).0;
    assert!(one.vertices.iter().all(|v| (v - Vec3::new(1e6, 2e6, 3.0)).norm() < 0.5));
    let far = [(Vec3::new(60.0, -3.0, 8.0), Vec3::x()), (Vec3::new(-40.0, 9.0, 0.0), Vec3::y())];
    let (mesh, _) = closed(directions(40_000).map(|n| (2.0 * n, -n)).chain(far), 0.1);
    assert_eq!(euler(&mesh), 2);
    assert!(rms(mesh.vertices().iter().map(|v| v.norm() - 2.0)) < 0.005);
}

#[test]
fn what_was_not_reached_is_told() {
    let fine = Summary { levels: 3, spacing_m: 0.1, ..Summary::default() };
    assert!(fine.warning(Some(0.1)).is_none() && fine.warning(None).is_none());
    assert_eq!(fine.warning(Some(0.05)).unwrap().code, "poisson-cells-enlarged");
    let short = Summary { levels_not_converged: 1, ..fine };
    assert_eq!(short.warning(None).unwrap().code, "poisson-not-converged");
}

#[test]
fn the_mesh_is_the_same_on_one_thread_and_on_many() {
    let many = mesh_of(tube(20_000)).0;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(pool.install(|| mesh_of(tube(20_000)).0), many);
}
