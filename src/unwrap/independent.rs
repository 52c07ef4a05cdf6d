//! LSCM and ARAP energies against an independent implementation, on small analytic surfaces. Tests only.
//!
//! Each surface is a formula over the unit square, sampled at 21 x 21 points `(i / 20, j / 20)`, vertex `21 i + j`, each cell
//! split from `(i, j)` to `(i + 1, j + 1)`. The references were computed with libigl 2.6.3 (Python):
//! * conformal: `igl.lscm` with vertices 0 and 440 held at (0, 0) and (d, 0), d their distance; then the sum over faces of
//!   `area (s1 - s2)^2 / 2` of the map scaled to the area of the surface;
//! * rigid: that map, scaled, as the start of `igl.ARAPData` with one vertex held and `max_iter` 20000, twice in a row (the
//!   second changed nothing to 14 digits); then the sum over faces of `area |J - R|^2` with the closest rotation R.

use super::{arap, lscm};
use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::numeric::Vec3;

const CELLS: u32 = 20;

/// Name, surface, conformal and rigid energy.
type Reference = (&'static str, fn(f64, f64) -> [f64; 3], f64, f64);

fn roll(x: f64, y: f64) -> [f64; 3] {
    let radius = 0.3 + 0.4 * x + 0.02 * (9.0 * y).sin();
    [radius * (4.0 * x).cos(), 1.5 * y, radius * (4.0 * x).sin()]
}

fn camel(x: f64, y: f64) -> [f64; 3] {
    let hump = |a: f64, b: f64, steep: f64| (-steep * ((x - a).powi(2) + (y - b).powi(2))).exp();
    [x, y, 0.25 * hump(0.3, 0.5, 20.0) + 0.2 * hump(0.7, 0.45, 25.0)]
}

fn cap(x: f64, y: f64) -> [f64; 3] {
    let (a, b) = (1.2 * x - 0.6, 1.6 * y - 0.8);
    [a.cos() * b.sin(), a.sin(), a.cos() * b.cos()]
}

fn helicoid(x: f64, y: f64) -> [f64; 3] {
    let radius = 0.2 + 0.8 * x;
    [radius * (3.0 * y).cos(), radius * (3.0 * y).sin(), 1.2 * y]
}

fn dented_cone(x: f64, y: f64) -> [f64; 3] {
    let radius = 0.3 + 0.7 * x;
    [radius * (2.5 * y).cos(), radius * (2.5 * y).sin(), 1.1 * x + 0.08 * (6.0 * x).sin() * (5.0 * y).cos()]
}

const REFERENCES: [Reference; 6] = [
    ("saddle", |x, y| [x, y, x * y / 2.0], 1.028_206_358_544e-6, 1.859_344_855_061e-5),
    ("spherical cap", cap, 1.443_231_294_601e-4, 2.617_209_789_454e-3),
    ("helicoid", helicoid, 6.156_274_972_828e-5, 4.710_246_570_221e-4),
    ("camel", camel, 4.429_963_867_096e-4, 6.448_526_156_300e-3),
    ("rippled roll", roll, 1.374_399_442_816e-4, 1.362_819_988_726e-3),
    ("dented cone", dented_cone, 2.689_120_634_052e-5, 2.869_177_275_287e-4),
];

fn strip(surface: fn(f64, f64) -> [f64; 3]) -> Strip {
    let side = CELLS + 1;
    let vertices = (0..side * side)
        .map(|k| Vec3::from(surface(f64::from(k / side) / f64::from(CELLS), f64::from(k % side) / f64::from(CELLS))))
        .collect();
    let faces = (0..CELLS)
        .flat_map(|i| (0..CELLS).map(move |j| i * side + j))
        .flat_map(|a| [[a, a + side, a + side + 1], [a, a + side + 1, a + 1]])
        .collect();
    Strip::from_disk(Mesh::all_observed(vertices, faces).unwrap()).unwrap()
}

#[test]
fn pinned_conformal_energy() {
    for (name, surface, reference, _) in REFERENCES {
        let last = (CELLS + 1) * (CELLS + 1) - 1;
        let settings = lscm::Settings { form: lscm::Form::Pinned, pins: Some([0, last]), ..lscm::Settings::default() };
        let energy = lscm::flatten(&strip(surface), None, &settings).unwrap().1.energy.unwrap();
        assert!((energy / reference - 1.0).abs() < 1e-6, "{name}: {energy:e} instead of {reference:e}");
    }
}

#[test]
fn rigid_energy() {
    for (name, surface, _, reference) in REFERENCES {
        let settings = arap::Settings { max_iterations: 1000, tolerance: 1e-12 };
        let (_, summary) = arap::flatten(&strip(surface), None, &settings).unwrap();
        let energy = summary.energy.unwrap();
        assert!((energy / reference - 1.0).abs() < 1e-6, "{name}: {energy:e} instead of {reference:e}");
        assert!(summary.converged && summary.iterations < 300, "{name}: {summary:?}");
    }
}

/// The energies in the report of a whole map are those that the methods made small, whatever turn it was placed with.
#[test]
fn reported_energies() {
    use super::{Method, Settings, flatten};
    for (name, surface, _, reference) in REFERENCES {
        let method = Method::Arap(arap::Settings { max_iterations: 1000, tolerance: 1e-12 });
        let (_, summary) = flatten(strip(surface), None, &Settings::of(method)).unwrap();
        let energy = summary.distortion.rigid_energy_m2;
        assert!((energy / reference - 1.0).abs() < 1e-6, "{name}: {energy:e}");

        let own = lscm::Settings { form: lscm::Form::Pinned, ..lscm::Settings::default() };
        let (_, summary) = flatten(strip(surface), None, &Settings::of(Method::Lscm(own))).unwrap();
        let (reported, own) = (summary.distortion.conformal_energy_m2, summary.solve.energy.unwrap());
        assert!((reported / own - 1.0).abs() < 1e-6, "{name}: {reported:e} {own:e}");
    }
}
