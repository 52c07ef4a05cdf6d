//! The contract that every unwrap method owes, checked for every method in the list by itself. Tests only.

use super::closed_form::{self, Known};
use super::{Chart, ChartIndex, Method, Settings, Summary, flatten};
use crate::axis::Axis;
use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::numeric::{Vec2, Vec3};
use nalgebra::{Rotation3, Unit};

/// Vertex coordinates of charts that should be equal may differ by this much, metres: methods iterate.
const SAME_M: f64 = 2e-5;

/// Blended bones are approximate by nature: no exact isometry, and places within this much of the girth. Everything else
/// in the contract they owe like the others; their own tests bound how far off they are.
const APPROXIMATE: [(&str, f64); 1] = [("deform-skin", 0.01)];

fn exact_methods() -> impl Iterator<Item = &'static str> {
    Method::NAMES.iter().copied().filter(|m| APPROXIMATE.iter().all(|(name, _)| name != m))
}

fn chart(method: &str, strip: Strip, axis: &Axis) -> (Chart, Summary) {
    let settings = Settings { smoothing_m: Some(0.0), ..Settings::of(Method::named(method).unwrap()) };
    flatten(strip, Some(axis), &settings).unwrap_or_else(|e| panic!("{method}: {e}"))
}

/// Largest distance after the best turn and shift; methods that place freely on an asymmetric guide may still move a bit.
fn largest_difference(a: &[Vec2], b: &[Vec2]) -> f64 {
    let mean = |p: &[Vec2]| p.iter().sum::<Vec2>() / p.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let (dot, cross) = a.iter().zip(b).fold((0.0, 0.0), |(d, c), (p, q)| {
        let (p, q) = (p - ma, q - mb);
        (d + p.dot(&q), c + p.perp(&q))
    });
    let (sin, cos) = cross.atan2(dot).sin_cos();
    let turned = |p: &Vec2| Vec2::new(cos * (p - ma).x - sin * (p - ma).y, sin * (p - ma).x + cos * (p - ma).y) + mb;
    a.iter().zip(b).map(|(p, q)| (turned(p) - q).norm()).fold(0.0, f64::max)
}

#[test]
fn every_method_is_an_isometry_on_developable_surfaces() {
    for known in closed_form::developable() {
        for method in exact_methods() {
            let (_, summary) = chart(method, known.strip.clone(), &known.axis);
            let stretch = summary.distortion.stretch.max;
            assert!(stretch < 1.0 + 1e-5, "{method} on the {}: {stretch}", known.name);
            assert_eq!((summary.flipped_faces, summary.overlaps), (0, 0), "{method} on the {}", known.name);
        }
    }
}

#[test]
fn every_method_places_its_chart_like_the_axis_says() {
    let known = closed_form::prism();
    let girth = known.flat[known.flat.len() - 1].y - known.flat[0].y;
    for method in Method::NAMES {
        let (chart, _) = chart(method, known.strip.clone(), &known.axis);
        let off = APPROXIMATE.iter().find(|(name, _)| name == method).map_or(1e-3, |(_, share)| share * girth);
        for (p, q) in chart.uv().iter().zip(&known.flat) {
            assert!((p - q).norm() < off, "{method}: {p} instead of {q}");
        }
    }
}

fn rough() -> Known {
    closed_form::rough(36, 40)
}

#[test]
fn motion_of_the_input_leaves_the_chart_the_same_and_scale_scales_it() {
    let known = rough();
    let turn = Rotation3::from_axis_angle(&Unit::new_normalize(Vec3::z()), 0.7);
    for method in Method::NAMES {
        let (reference, _) = chart(method, known.strip.clone(), &known.axis);
        for scale in [1.0, 3.0] {
            let moved = |p: &Vec3| (turn * p) * scale + Vec3::new(20.0, -35.0, 4.0);
            let mesh = known.strip.mesh();
            let vertices = mesh.vertices().iter().map(moved).collect();
            let strip = Strip::from_disk(Mesh::all_observed(vertices, mesh.faces().to_vec()).unwrap()).unwrap();
            let knots: Vec<Vec3> = (0..=40)
                .map(|i| known.axis.start_chainage() + known.axis.length() * f64::from(i) / 40.0)
                .map(|s| moved(&known.axis.frame_at(s).origin))
                .collect();
            let axis = Axis::through(&knots, known.axis.start_chainage() * scale).unwrap();
            let (other, _) = chart(method, strip, &axis);
            let scaled: Vec<Vec2> = reference.uv().iter().map(|p| p * scale).collect();
            let difference = largest_difference(&scaled, other.uv()) / scale;
            // The section chart averages over a window in metres, which does not scale with the tunnel.
            let allowed = if scale == 1.0 { 1e-3 } else { 0.05 };
            assert!(difference < allowed, "{method} at scale {scale}: {difference}");
        }
    }
}

#[test]
fn renumbered_vertices_give_the_same_chart() {
    let known = rough();
    let mesh = known.strip.mesh();
    let count = mesh.vertices().len();
    // A fixed permutation without structure: multiplication by a number prime to the count.
    let factor = (count / 2..).find(|f| gcd(*f, count) == 1).unwrap();
    let new_of = |old: usize| (old * factor + 5) % count;
    let mut vertices = vec![Vec3::zeros(); count];
    (0..count).for_each(|old| vertices[new_of(old)] = mesh.vertices()[old]);
    let faces = mesh.faces().iter().map(|c| c.map(|v| new_of(v as usize) as u32)).collect();
    let renumbered = Strip::from_disk(Mesh::all_observed(vertices, faces).unwrap()).unwrap();
    for method in Method::NAMES {
        let (reference, _) = chart(method, known.strip.clone(), &known.axis);
        let (other, _) = chart(method, renumbered.clone(), &known.axis);
        let back: Vec<Vec2> = (0..count).map(|old| other.uv()[new_of(old)]).collect();
        let difference = largest_difference(reference.uv(), &back);
        assert!(difference < SAME_M, "{method}: {difference}");
    }
}

fn gcd(a: usize, b: usize) -> usize {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[test]
fn one_thread_and_two_give_the_same_bytes() {
    let known = rough();
    for method in Method::NAMES {
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| chart(method, known.strip.clone(), &known.axis).0)
        };
        let bits =
            |chart: Chart| -> Vec<[u64; 2]> { chart.uv().iter().map(|p| [p.x.to_bits(), p.y.to_bits()]).collect() };
        assert!(bits(on(1)) == bits(on(2)), "{method}");
    }
}

#[test]
fn every_place_on_the_map_goes_back_to_its_point() {
    let known = rough();
    for method in Method::NAMES {
        let (chart, summary) = chart(method, known.strip.clone(), &known.axis);
        if summary.flipped_faces + summary.overlaps > 0 {
            // Where the map covers itself a place has two points.
            assert!(
                method.starts_with("deform-"),
                "{method}: {} flips, {} overlaps",
                summary.flipped_faces,
                summary.overlaps
            );
            continue;
        }
        let index = ChartIndex::of(&chart);
        let mesh = chart.strip().mesh();
        for face in 0..mesh.faces().len() as u32 {
            let at = [0.2, 0.5, 0.3];
            let place: Vec2 = chart.corners_in_chart(face).iter().zip(at).map(|(p, w)| p * w).sum();
            let point: Vec3 = mesh.corners(face).iter().zip(at).map(|(p, w)| p * w).sum();
            let back = index.surface_point(place).unwrap_or_else(|| panic!("{method}: face {face} is off the map"));
            let back: Vec3 = mesh.corners(back.face).iter().zip(back.barycentric).map(|(p, w)| p * w).sum();
            assert!((back - point).norm() < 1e-9, "{method}: {:e} m", (back - point).norm());
        }
    }
}

#[test]
fn the_flips_that_are_told_are_the_flips_that_are_there() {
    let known = rough();
    for method in Method::NAMES {
        let (chart, summary) = chart(method, known.strip.clone(), &known.axis);
        let negative = (0..chart.strip().mesh().faces().len() as u32)
            .filter(|&f| {
                let [a, b, c] = chart.corners_in_chart(f);
                (b - a).perp(&(c - a)) <= 0.0
            })
            .count();
        assert_eq!(summary.flipped_faces, negative, "{method}");
    }
}
