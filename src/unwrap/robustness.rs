//! Meshes with defects, for every method: a correct map, or an error that names what is wrong. Tests only.

use super::closed_form::{self, Known};
use super::{AxisUse, Chart, Method, Settings, Summary, flatten};
use crate::cut::{self, Strip};
use crate::mesh::{self, Mesh};
use crate::numeric::{Vec2, Vec3};
use std::f64::consts::TAU;

const ROWS: u32 = 30;
const COLUMNS: u32 = 32;

fn vertex(row: u32, column: u32) -> usize {
    (row * (COLUMNS + 1) + column) as usize
}

/// A rough tunnel with what scanners and repair tools leave behind: vertices in one place, faces without area, slivers.
fn damaged() -> Known {
    let known = closed_form::rough(ROWS, COLUMNS);
    let mesh = known.strip.mesh();
    let mut v = mesh.vertices().to_vec();
    // Doubled vertices inside and on the border.
    v[vertex(8, 10)] = v[vertex(8, 11)];
    v[vertex(20, 0)] = v[vertex(21, 0)];
    // A vertex on the line between its neighbours, and one a micrometre beside another.
    v[vertex(15, 16)] = (v[vertex(15, 15)] + v[vertex(15, 17)]) / 2.0;
    v[vertex(24, 20)] = v[vertex(24, 21)] + Vec3::new(1e-6, 0.0, 0.0);
    // All corners of a face in one place.
    for place in [vertex(4, 24), vertex(4, 25), vertex(5, 24), vertex(5, 25)] {
        v[place] = v[vertex(4, 24)];
    }
    let strip = Strip::from_disk(Mesh::all_observed(v, mesh.faces().to_vec()).unwrap()).unwrap();
    Known { strip, ..known }
}

/// A rough tunnel with two windows.
fn windowed() -> Known {
    let known = closed_form::rough(ROWS, COLUMNS);
    let mesh = known.strip.mesh();
    let near = |f: &[u32; 3], centre: usize| {
        f.iter().any(|&v| (mesh.vertices()[v as usize] - mesh.vertices()[centre]).norm() < 1.5)
    };
    let kept = |f: &&[u32; 3]| !near(f, vertex(8, 10)) && !near(f, vertex(20, 20));
    let faces: Vec<[u32; 3]> = mesh.faces().iter().filter(kept).copied().collect();
    let strip = Strip::from_disk(Mesh::all_observed(mesh.vertices().to_vec(), faces).unwrap()).unwrap();
    assert_eq!(strip.hole_loops().len(), 2);
    Known { strip, ..known }
}

/// The map with the axis, and without it where the method can do without.
fn maps(method: &str, known: &Known) -> Vec<(Chart, Summary)> {
    let settings = Settings { smoothing_m: Some(0.0), ..Settings::of(Method::named(method).unwrap()) };
    let mut axes = vec![Some(&known.axis)];
    if settings.method.axis_use() != AxisUse::Needs {
        axes.push(None);
    }
    let map = |axis| flatten(known.strip.clone(), axis, &settings).unwrap_or_else(|e| panic!("{method}: {e}"));
    axes.into_iter().map(map).collect()
}

fn assert_sound(method: &str, chart: &Chart, summary: &Summary) {
    assert!(chart.uv().iter().all(|p| p.x.is_finite() && p.y.is_finite()), "{method}");
    let d = &summary.distortion;
    let figures = [d.stretch.mean, d.stretch.max, d.area_ratio.mean, d.symmetric_dirichlet, d.sander_l2];
    assert!(figures.iter().all(|x| x.is_finite()), "{method}: {d:?}");
    let not_positive = |f: u32| {
        let [a, b, c] = chart.corners_in_chart(f);
        (b - a).perp(&(c - a)) <= 0.0
    };
    let flips = (0..chart.strip().mesh().faces().len() as u32).filter(|&f| not_positive(f)).count();
    assert_eq!(summary.flipped_faces, flips, "{method}");
}

#[test]
fn slivers_doubled_vertices_and_faces_without_area() {
    let known = damaged();
    for method in Method::NAMES {
        for (chart, summary) in maps(method, &known) {
            assert_sound(method, &chart, &summary);
            assert!(summary.distortion.degenerate_faces >= 4, "{method}: {}", summary.distortion.degenerate_faces);
            // Where the surface is sound the map is too.
            assert!(summary.distortion.stretch.p95 < 1.3, "{method}: {:?}", summary.distortion.stretch);
        }
    }
}

#[test]
fn windows_stay_windows() {
    let known = windowed();
    for method in Method::NAMES {
        for (chart, summary) in maps(method, &known) {
            assert_sound(method, &chart, &summary);
            assert_eq!(chart.strip().hole_loops().len(), 2);
            assert!(summary.distortion.stretch.p95 < 1.3, "{method}: {:?}", summary.distortion.stretch);
        }
    }
}

#[test]
fn vertices_without_faces_are_no_obstacle() {
    let known = closed_form::half_cylinder();
    let mesh = known.strip.mesh();
    let mut vertices = mesh.vertices().to_vec();
    vertices.push(Vec3::new(4.0, 0.0, 1.0));
    let strip = Strip::from_disk(Mesh::all_observed(vertices, mesh.faces().to_vec()).unwrap()).unwrap();
    let known = Known { strip, ..known };
    for method in Method::NAMES {
        for (chart, summary) in maps(method, &known) {
            assert_sound(method, &chart, &summary);
            assert_eq!(summary.flipped_faces, 0, "{method}");
        }
    }
}

/// A half cylinder 400 times as long as wide: pinned conformal maps lose their scale there first.
#[test]
fn a_very_long_strip() {
    let (length, radius) = (1200.0, 1.0);
    let mesh = closed_form::grid(600, 8, 0.0, |along, around| {
        let angle = TAU / 4.0 * (2.0 * around - 1.0);
        Vec3::new(length * along, -radius * angle.sin(), radius * angle.cos())
    });
    let axis = crate::axis::Axis::through(&[Vec3::zeros(), Vec3::new(length, 0.0, 0.0)], 0.0).unwrap();
    let flat = vec![Vec2::zeros(); mesh.vertices().len()];
    let known = Known { name: "long", strip: Strip::from_disk(mesh).unwrap(), axis, flat };
    for method in ["lscm", "abf++", "arap", "slim", "relax", "section"] {
        for (chart, summary) in maps(method, &known) {
            assert_sound(method, &chart, &summary);
            assert_eq!(summary.flipped_faces, 0, "{method}");
            assert!(summary.distortion.stretch.max < 1.0 + 1e-4, "{method}: {:?}", summary.distortion.stretch);
        }
    }
}

#[test]
fn what_is_no_disk_is_refused_by_name() {
    // Two sheets.
    let v: Vec<Vec3> = (0..7).map(|i| Vec3::new(f64::from(i), f64::from(i * i % 5), 0.0)).collect();
    let two = Mesh::all_observed(v, vec![[0, 1, 2], [1, 3, 2], [4, 5, 6]]).unwrap();
    let message = Strip::from_disk(two).unwrap_err().to_string();
    assert!(message.contains("2 components") && message.contains("face 2"), "{message}");

    // An octahedron.
    let v = vec![Vec3::x(), -Vec3::x(), Vec3::y(), -Vec3::y(), Vec3::z(), -Vec3::z()];
    let faces = vec![[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];
    let sphere = Mesh::all_observed(v, faces).unwrap();
    assert_eq!(Strip::from_disk(sphere), Err(cut::Error::Closed));

    // A Möbius strip: however its faces are turned, two neighbours disagree, and they are named.
    let n = 12u32;
    let place = |i: u32, j: u32| {
        let (turn, across) = (TAU * f64::from(i) / f64::from(n), f64::from(j) - 0.5);
        let radius = 3.0 + across * (turn / 2.0).cos();
        Vec3::new(radius * turn.cos(), radius * turn.sin(), across * (turn / 2.0).sin())
    };
    let v: Vec<Vec3> = (0..n).flat_map(|i| [place(i, 0), place(i, 1)]).collect();
    let corner = |i: u32, j: u32| if i < n { 2 * i + j } else { 1 - j };
    let faces = (0..n).flat_map(|i| {
        let (a, b, c, d) = (corner(i, 0), corner(i + 1, 0), corner(i + 1, 1), corner(i, 1));
        [[a, b, c], [a, c, d]]
    });
    let error = Mesh::all_observed(v, faces.collect()).unwrap_err();
    assert!(matches!(error, mesh::Error::NotManifoldEdge { first, second, .. } if first != second), "{error}");
}
