//! Scans of what is only part of a tunnel, or none: a sensible strip of what is there, or a refusal with the right reason.

use adit::axis::{self, Axis};
use adit::cut::{self, Strip};
use adit::mesh;
use adit::numeric::Vec3;
use adit::segment;
use adit::synthetic::{Alignment, ScanPlan, Section, Tunnel, scan};
use std::f64::consts::TAU;

const LENGTH_M: f64 = 30.0;

/// A scanned drift of 5 x 4.8 m, 30 m long, straight along x with its axis at height 0.
fn drift() -> Vec<Vec3> {
    let tunnel = Tunnel::rock_drift(Section::horseshoe(5.0, 4.8), Alignment::straight(LENGTH_M), 0.06, 5);
    let plan = ScanPlan { points: 150_000, colored: false, ..ScanPlan::default() };
    scan(&tunnel, &plan).unwrap().cloud.positions().to_vec()
}

fn strip_of(points: &[Vec3]) -> (Axis, Strip) {
    let (axis, _) = axis::trace(points, &axis::Settings::default()).unwrap();
    let (segmentation, _) = segment::classify_positions(points, &axis, &segment::Settings::default()).unwrap();
    let (mesh, _) = mesh::reconstruct(&segmentation, &axis, &mesh::Settings::default()).unwrap();
    let (strip, _) = cut::open(mesh, &axis, &cut::Settings::default()).unwrap();
    (axis, strip)
}

/// Length of the strip along the tunnel, metres.
fn extent(strip: &Strip) -> f64 {
    let xs = || strip.mesh().vertices().iter().map(|v| v.y);
    let ys = || strip.mesh().vertices().iter().map(|v| v.x);
    let range = |low: f64, high: f64| high - low;
    let x = range(xs().fold(f64::MAX, f64::min), xs().fold(f64::MIN, f64::max));
    let y = range(ys().fold(f64::MAX, f64::min), ys().fold(f64::MIN, f64::max));
    x.max(y)
}

fn refusal(points: &[Vec3]) -> axis::Error {
    axis::trace(points, &axis::Settings::default()).unwrap_err()
}

/// The horizontal direction across the drift of `points`, and its middle.
fn across(points: &[Vec3]) -> impl Fn(&Vec3) -> f64 + use<> {
    let (low, high) = points.iter().fold((points[0], points[0]), |(l, h), p| (l.inf(p), h.sup(p)));
    let along_x = high.x - low.x > high.y - low.y;
    let middle = (low + high) / 2.0;
    move |p| if along_x { p.y - middle.y } else { p.x - middle.x }
}

#[test]
fn one_wall_gives_a_strip_of_that_wall() {
    let mut points = drift();
    let side = across(&points);
    points.retain(|p| side(p) > 0.6);
    let (_, strip) = strip_of(&points);
    assert!(extent(&strip) > 0.6 * LENGTH_M, "{}", extent(&strip));
    assert!(strip.mesh().vertices().iter().all(|v| side(v) > 0.5), "nothing on the side that was not scanned");
}

#[test]
fn a_trench_without_roof_gives_its_walls_and_floor() {
    let mut points = drift();
    let low = points.iter().map(|p| p.z).fold(f64::MAX, f64::min);
    points.retain(|p| p.z < low + 3.3);
    let (_, strip) = strip_of(&points);
    assert!(extent(&strip) > 0.6 * LENGTH_M, "{}", extent(&strip));
    assert!(strip.mesh().vertices().iter().all(|v| v.z < low + 3.5), "no roof");
}

#[test]
fn a_lining_seen_from_outside_is_no_tunnel() {
    let points: Vec<Vec3> = (0..80_000)
        .map(|i| {
            let s = LENGTH_M * (f64::from(i) * 0.618_033_988_749_895).fract();
            if i % 2 == 0 {
                let a = std::f64::consts::PI * ((f64::from(i) * 0.754_877_666_246_693).fract() - 0.5);
                Vec3::new(s, 3.0 * a.sin(), 3.0 * a.cos())
            } else {
                let y = 30.0 * (f64::from(i) * 0.754_877_666_246_693).fract() - 15.0;
                Vec3::new(s, y + 3.0 * y.signum(), 0.0)
            }
        })
        .collect();
    let error = refusal(&points);
    assert!(matches!(error, axis::Error::NotATunnel { .. }), "{error}");
}

#[test]
fn a_ring_is_a_loop_and_a_hummocky_outcrop_is_none() {
    let ring: Vec<Vec3> = (0..120_000)
        .map(|i| {
            let (s, c) = (TAU * (f64::from(i) * 0.618_033_988_749_895).fract()).sin_cos();
            let (b, d) = (TAU * (f64::from(i) * 0.754_877_666_246_693).fract()).sin_cos();
            Vec3::new((15.0 + 2.0 * d) * c, (15.0 + 2.0 * d) * s, 2.0 * b)
        })
        .collect();
    let error = refusal(&ring);
    assert!(matches!(error, axis::Error::ClosedLoop { .. }), "{error}");
    let outcrop: Vec<Vec3> = (0..120_000)
        .map(|i| {
            let x = 40.0 * (f64::from(i) * 0.618_033_988_749_895).fract();
            let y = 30.0 * (f64::from(i) * 0.754_877_666_246_693).fract();
            Vec3::new(x, y, 1.5 * (0.9 * x).sin() * (1.1 * y).cos() + 0.3 * (5.0 * x + 3.0 * y).sin())
        })
        .collect();
    let error = refusal(&outcrop);
    assert!(matches!(error, axis::Error::NotATunnel { .. }), "{error}");
}

#[test]
fn a_scan_of_islands_is_refused_or_followed_but_never_half_told() {
    // 60 % of the surface missing in islands of half a metre.
    let mut points = drift();
    let island = |p: &Vec3| (4.1 * p.x).sin() * (3.9 * p.y + 1.0).sin() * (4.3 * p.z + 0.4).sin();
    let mut values: Vec<f64> = points.iter().map(island).collect();
    values.sort_unstable_by(f64::total_cmp);
    let limit = values[values.len() * 6 / 10];
    points.retain(|p| island(p) > limit);
    match axis::trace(&points, &axis::Settings::default()) {
        Err(error) => assert!(matches!(error, axis::Error::NotATunnel { .. }), "{error}"),
        Ok((axis, summary)) => {
            assert!(axis.length() > 0.6 * LENGTH_M, "{}", axis.length());
            assert!(summary.coverage.unwrap() < 0.9, "the gaps are told");
        }
    }
}
