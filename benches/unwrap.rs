//! Flattening and anchoring, 20 000 to 1 000 000 triangles of a rough tunnel on a bend (8 m wide, 40 m long).
//!
//! `cargo bench --bench unwrap` runs all sizes; `-- relax/20k` one of them. `ADIT_BENCH_FULL=1` adds 500k and 1M.

use adit::axis::{Axis, AxisCoordinates};
use adit::cut::{self, Strip};
use adit::mesh::{Mesh, anchor};
use adit::numeric::Vec3;
use adit::unwrap::{self, Method, Settings};
use criterion::{BatchSize, BenchmarkId, Criterion, criterion_group, criterion_main};
use std::f64::consts::PI;
use std::time::Duration;

/// An axis of 40 m with a bend radius of 120 m.
fn axis() -> Axis {
    let knots: Vec<Vec3> = (0..=80)
        .map(|i| {
            let a = f64::from(i) / 80.0 * 40.0 / 120.0;
            Vec3::new(120.0 * a.sin(), 120.0 - 120.0 * a.cos(), 0.02 * 120.0 * a)
        })
        .collect();
    Axis::through(&knots, 0.0).expect("distinct knots")
}

/// A closed tube of about `faces` triangles with waves of several lengths on its wall.
fn tube(axis: &Axis, faces: usize) -> Mesh {
    let length = axis.length();
    let columns = ((faces as f64 / 2.0 * 2.0 * PI * 4.0 / length).sqrt() as u32).max(8);
    let rows = (faces as f64 / 2.0 / f64::from(columns)).round() as u32;
    let vertices = (0..=rows)
        .flat_map(|i| (0..columns).map(move |j| (i, j)))
        .map(|(i, j)| {
            let (s, angle) = (length * f64::from(i) / f64::from(rows), 2.0 * PI * f64::from(j) / f64::from(columns));
            let waves = 0.1 * (1.7 * s + (3.0 * angle).sin()).sin() + 0.05 * (5.0 * s - 7.0 * angle).sin();
            axis.point_at(&AxisCoordinates::from_polar(s, angle, 4.0 + waves + 0.01 * (41.0 * s + 97.0 * angle).sin()))
        })
        .collect();
    let faces = (0..rows)
        .flat_map(|i| {
            (0..columns).flat_map(move |j| {
                let (a, d) = (i * columns + j, i * columns + (j + 1) % columns);
                [[a, a + columns, d + columns], [a, d + columns, d]]
            })
        })
        .collect();
    Mesh::all_observed(vertices, faces).expect("a grid is a manifold")
}

fn sizes() -> Vec<(&'static str, usize)> {
    let mut sizes = vec![("20k", 20_000), ("100k", 100_000)];
    if std::env::var_os("ADIT_BENCH_FULL").is_some() {
        sizes.extend([("500k", 500_000), ("1M", 1_000_000)]);
    }
    sizes
}

fn opened(axis: &Axis, faces: usize) -> Strip {
    cut::open(tube(axis, faces), axis, &cut::Settings::default()).expect("a tube opens").0
}

fn flatten(criterion: &mut Criterion) {
    let axis = axis();
    for method in ["section", "relax", "lscm", "abf++", "arap", "slim"] {
        let mut group = criterion.benchmark_group(method);
        for (name, faces) in sizes() {
            let strip = opened(&axis, faces);
            let settings =
                Settings { smoothing_m: Some(0.0), ..Settings::of(Method::named(method).expect("in the list")) };
            group.bench_function(BenchmarkId::from_parameter(name), |b| {
                let run = |strip| unwrap::flatten(strip, Some(&axis), &settings).expect("a strip flattens");
                b.iter_batched(|| strip.clone(), run, BatchSize::LargeInput);
            });
        }
        group.finish();
    }
}

fn anchoring(criterion: &mut Criterion) {
    let axis = axis();
    let mut group = criterion.benchmark_group("anchor 1M points");
    for (name, faces) in sizes() {
        let mesh = tube(&axis, faces);
        // Points within 2 cm of the surface in scan order: along the faces.
        let points: Vec<Vec3> = (0..1_000_000usize)
            .map(|i| {
                let face = (i * mesh.faces().len() / 1_000_000) as u32;
                let [a, b, c] = mesh.corners(face);
                let t = (i as f64 * 0.618_033_988_75).fract();
                let off = mesh.double_area_vector(face).normalize() * (0.04 * t - 0.02);
                a * (0.5 * t) + b * (0.7 - 0.4 * t) + c * (0.3 - 0.1 * t) + off
            })
            .collect();
        group.bench_function(BenchmarkId::from_parameter(name), |b| {
            b.iter(|| anchor::anchor_points(&mesh, &points, &anchor::Settings::default()));
        });
    }
    group.finish();
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10).measurement_time(Duration::from_secs(5));
    targets = flatten, anchoring
}
criterion_main!(benches);
