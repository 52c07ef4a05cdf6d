//! Tunnels with side drifts, and meshes with caps over their ends: the real program tells what it found, and what it made of it.

use assert_cmd::Command;
use serde_json::Value;
use std::f64::consts::{PI, TAU};
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

const LENGTH_M: f64 = 16.0;
/// The crosscut of `adit synth`: 2.5 m wide, its middle at 62 % of the length, on the right wall.
const MOUTH_M: [f64; 2] = [0.62 * LENGTH_M - 1.25, 0.62 * LENGTH_M + 1.25];

/// Girths of the lower and the upper edge of the mouth (2.5 m high) in the section of 4.6 m x 4.2 m.
fn mouth_girths() -> [f64; 2] {
    let (half, wall, high): (f64, f64, f64) = (2.3, 1.9, 2.5);
    let springline = half * PI / 2.0;
    [springline - half * ((high - wall) / half).asin(), springline + wall]
}

fn adit(arguments: &[&str]) {
    let output = Command::cargo_bin("adit").unwrap().args(arguments).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(matches!(output.status.code(), Some(0 | 5)), "{arguments:?}: {said}");
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

fn run(input: &Path, name: &str, settings: &[&str]) -> (PathBuf, Value) {
    let folder = input.with_file_name(name);
    let mut arguments = vec!["run", "--input", path(input), "--out", path(&folder), "--quiet"];
    settings.iter().for_each(|s| arguments.extend(["--set", s]));
    adit(&arguments);
    let report = serde_json::from_slice(&fs::read(folder.join("report.json")).unwrap()).unwrap();
    (folder, report)
}

/// [portals, open edges, side openings].
fn borders(report: &Value) -> [u64; 3] {
    ["portals", "open_edges", "side_openings"].map(|key| report["mesh"]["borders"][key].as_u64().unwrap())
}

fn warning<'r>(report: &'r Value, code: &str) -> Option<&'r str> {
    let of_code = |w: &&Value| w["code"] == code;
    report["warnings"].as_array().unwrap().iter().find(of_code).and_then(|w| w["message"].as_str())
}

/// The pixels of a picture of the map inside a rectangle of (u, v), metres.
fn pixels_within(run: &Path, layer: &str, u: [f64; 2], v: [f64; 2]) -> Vec<[u8; 4]> {
    let picture = image::open(run.join(format!("map/{layer}.png"))).unwrap().into_rgba8();
    let world = fs::read_to_string(run.join(format!("map/{layer}.pgw"))).unwrap();
    let n: Vec<f64> = world.lines().map(|l| l.trim().parse().unwrap()).collect();
    let inside = |x: u32, y: u32| {
        let (at_u, at_v) = (n[4] + f64::from(x) * n[0], n[5] + f64::from(y) * n[3]);
        (u[0]..u[1]).contains(&at_u) && (v[0]..v[1]).contains(&at_v)
    };
    picture.enumerate_pixels().filter(|(x, y, _)| inside(*x, *y)).map(|(_, _, p)| p.0).collect()
}

#[test]
fn a_crosscut_is_a_hole_or_closed_with_wall_that_nobody_saw() {
    let folder = tempfile::tempdir().unwrap();
    let scan = folder.path().join("junction.laz");
    let length = LENGTH_M.to_string();
    adit(&[
        "synth",
        "--out",
        path(&scan),
        "--length",
        &length,
        "--points",
        "150000",
        "--alignment",
        "straight",
        "--furniture",
        "crosscut",
        "--outliers",
        "0",
        "--right-text",
        "",
        "--quiet",
    ]);
    let middle_m = (MOUTH_M[0] + MOUTH_M[1]) / 2.0;
    let girths = mouth_girths();
    let mouth_m2 = (MOUTH_M[1] - MOUTH_M[0]) * (girths[1] - girths[0]);
    let shrunk = |[low, high]: [f64; 2], by: f64| [low + by, high - by];

    let (hole, report) = run(&scan, "hole", &["map.cell_m=0.03"]);
    assert_eq!(borders(&report), [2, 0, 1], "{}", report["mesh"]["borders"]);
    assert_eq!(warning(&report, "portals"), None);
    let opening = &report["mesh"]["openings"][0];
    assert!(
        (opening["chainage_m"].as_f64().unwrap() - middle_m).abs() < 0.3 && opening["side"] == "right",
        "{opening}"
    );
    assert!(warning(&report, "side-openings").unwrap().contains("left as holes"));
    let [u, v] = [shrunk(MOUTH_M, 0.3), shrunk(girths, 0.3)];
    assert!(pixels_within(&hole, "coverage", u, v).iter().all(|p| p[3] == 0), "a hole");

    for method in ["section", "poisson"] {
        let set = format!("mesh.method=\"{method}\"");
        let (closed, report) = run(&scan, method, &["map.cell_m=0.03", &set, "mesh.side_openings=\"close\""]);
        assert_eq!(borders(&report), [2, 0, 0], "{method}: {}", report["mesh"]["borders"]);
        let closed_m2 = report["mesh"]["openings_closed_m2"].as_f64().unwrap();
        assert!((closed_m2 / mouth_m2 - 1.0).abs() < 0.15, "{method}: {closed_m2} of {mouth_m2} m2");
        assert!(warning(&report, "side-openings").unwrap().contains("wall that nobody saw"));
        assert!(report["anchor"]["behind_filled"].as_u64().unwrap() > 100, "{method}: {}", report["anchor"]);
        let coverage = pixels_within(&closed, "coverage", u, v);
        let [filled, observed] = [[true, false], [false, true]].map(|[orange, green]| {
            coverage.iter().filter(|p| p[3] > 0 && (p[0] > p[1]) == orange && (p[1] >= p[0]) == green).count()
        });
        assert_eq!((filled, observed), (coverage.len(), 0), "{method}");
        // Well inside, no colour of the side drift or of the rim.
        let deep = pixels_within(&closed, "color", shrunk(MOUTH_M, 0.6), shrunk(girths, 0.6));
        assert!(deep.iter().all(|p| p[3] == 0), "{method}: colour on wall that nobody saw");
    }
}

/// A watertight tube of 2 m radius and 20 m length around a bend, closed by discs or hemispheres, as an OBJ file.
fn capped_tube(domes: bool) -> String {
    const RADIUS_M: f64 = 2.0;
    const COLUMNS: usize = 60;
    // (chainage, radius) of the rings, from pole to pole.
    let cap: Vec<[f64; 2]> = (1..16)
        .map(|i| f64::from(i) / 16.0)
        .map(|t| {
            if domes {
                [-RADIUS_M * (t * PI / 2.0).cos(), RADIUS_M * (t * PI / 2.0).sin()]
            } else {
                [0.0, RADIUS_M * t]
            }
        })
        .collect();
    let mut rings: Vec<[f64; 2]> = cap.clone();
    rings.extend((0..=100).map(|i| [0.2 * f64::from(i), RADIUS_M]));
    rings.extend(cap.iter().rev().map(|[s, r]| [20.0 - s, *r]));
    let bend_m = 40.0;
    let place = |s: f64, r: f64, angle: f64| {
        let (turn, out) = (s / bend_m, bend_m + r * angle.sin());
        [500_000.0 + out * turn.sin(), 6_000_000.0 - out * turn.cos(), 100.0 + r * angle.cos()]
    };
    let mut text = String::new();
    let mut vertex = |[x, y, z]: [f64; 3]| writeln!(text, "v {x:.4} {y:.4} {z:.4}").unwrap();
    for [s, r] in &rings {
        (0..COLUMNS).for_each(|j| vertex(place(*s, *r, TAU * j as f64 / COLUMNS as f64)));
    }
    let outermost = if domes { RADIUS_M } else { 0.0 };
    vertex(place(-outermost, 0.0, 0.0));
    vertex(place(20.0 + outermost, 0.0, 0.0));
    let mut face = |a: usize, b: usize, c: usize| writeln!(text, "f {} {} {}", a + 1, b + 1, c + 1).unwrap();
    let poles = rings.len() * COLUMNS;
    for j in 0..COLUMNS {
        let k = (j + 1) % COLUMNS;
        for i in 0..rings.len() - 1 {
            let at = |i: usize, j: usize| i * COLUMNS + j;
            face(at(i, j), at(i + 1, j), at(i + 1, k));
            face(at(i, j), at(i + 1, k), at(i, k));
        }
        let last = (rings.len() - 1) * COLUMNS;
        face(poles, j, k);
        face(poles + 1, last + k, last + j);
    }
    text
}

#[test]
fn a_watertight_mesh_is_opened_at_its_portals() {
    let folder = tempfile::tempdir().unwrap();
    for (name, domes) in [("discs", false), ("domes", true)] {
        let input = folder.path().join(format!("{name}.obj"));
        fs::write(&input, capped_tube(domes)).unwrap();
        let (_, report) = run(&input, name, &["map.cell_m=0.05"]);
        assert_eq!(borders(&report), [2, 0, 0], "{name}: {}", report["mesh"]["borders"]);
        assert_eq!(report["mesh"]["repair"]["caps_cut"], 2, "{name}");
        assert!(warning(&report, "caps-cut").is_some() && warning(&report, "portals").is_none(), "{name}");
        assert_eq!(report["cut"]["closed_end"], false, "{name}");
        // Two discs; of domes what lies beyond 45 degrees.
        let caps_m2 = report["mesh"]["repair"]["caps_m2"].as_f64().unwrap();
        let expected = if domes { 2.0 * TAU * 4.0 * (1.0 - 0.5f64.sqrt()) } else { 2.0 * PI * 4.0 };
        assert!((caps_m2 / expected - 1.0).abs() < 0.12, "{name}: {caps_m2} of {expected}");
        let metres = |key: &str| report["map"][key].as_f64().unwrap() * 0.05;
        let (width, height) = (metres("width_px"), metres("height_px"));
        let expected = if domes { 20.0..24.5 } else { 19.6..20.9 };
        assert!(expected.contains(&width) && (height / (TAU * 2.0) - 1.0).abs() < 0.03, "{name}: {width} x {height}");
    }
}
