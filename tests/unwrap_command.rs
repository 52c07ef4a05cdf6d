//! `adit unwrap` as a whole program, on small meshes written here.

use assert_cmd::Command;
use std::f64::consts::TAU;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

/// Vertices and one-based faces of a grid over the unit square, as OBJ; `closed` joins the last column with the first.
fn grid(rows: u32, columns: u32, closed: bool, place: impl Fn(f64, f64) -> [f64; 3]) -> String {
    let across = if closed { columns } else { columns + 1 };
    let mut obj = String::new();
    for i in 0..=rows {
        for j in 0..across {
            let [x, y, z] = place(f64::from(i) / f64::from(rows), f64::from(j) / f64::from(columns));
            writeln!(obj, "v {x:?} {y:?} {z:?}").unwrap();
        }
    }
    for i in 0..rows {
        for j in 0..columns {
            let (a, d) = (i * across + j + 1, i * across + (j + 1) % across + 1);
            let (b, c) = (a + across, d + across);
            writeln!(obj, "f {a} {b} {c}\nf {a} {c} {d}").unwrap();
        }
    }
    obj
}

/// A rough round tunnel of radius 3 m and 24 m length on a bend of 60 m, seam at the invert.
fn tunnel(along: f64, around: f64) -> [f64; 3] {
    let (bend, angle) = (60.0, TAU * (around - 0.5));
    let s = 24.0 * along;
    let radius = 3.0 + 0.06 * (1.7 * s + 3.0 * angle).sin() + 0.04 * (4.0 * s - 5.0 * angle).cos();
    let (right, up) = (radius * angle.sin(), radius * angle.cos());
    let a = s / bend;
    [(bend + right) * a.sin(), bend - (bend + right) * a.cos(), up]
}

fn saddle(x: f64, y: f64) -> [f64; 3] {
    [x, y, x * y / 2.0]
}

fn unwrap(mesh: &Path, out: &Path, more: &[&str]) -> Output {
    let mut command = Command::cargo_bin("adit").unwrap();
    command.arg("unwrap").arg(mesh).arg("--out").arg(out).args(["--json", "--quiet"]).args(more);
    command.output().unwrap()
}

fn written(folder: &Path, name: &str, text: &str) -> PathBuf {
    let path = folder.join(name);
    fs::write(&path, text).unwrap();
    path
}

fn report(output: &Output) -> serde_json::Value {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn a_cut_tunnel_finds_its_axis_and_a_tube_is_opened() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("flat.ply");
    let cut = written(folder.path(), "cut.obj", &grid(72, 56, false, tunnel));
    let tube = written(folder.path(), "tube.obj", &grid(72, 56, true, tunnel));
    for method in ["lscm", "arap", "slim", "relax"] {
        for mesh in [&cut, &tube] {
            let report = report(&unwrap(mesh, &out, &["--method", method]));
            assert_eq!(report["axis"], "traced", "{method}");
            assert_eq!(report["flipped_faces"], 0, "{method}");
            assert!(report["stretch"]["mean"].as_f64().unwrap() < 1.06, "{method}: {}", report["stretch"]);
            let chainage = &report["readability"]["chainage_rms_m"];
            assert!(chainage.as_f64().unwrap() < 1.5, "{method}: {chainage}");
        }
    }
    let alone = report(&unwrap(&cut, &out, &["--method", "arap", "--no-axis"]));
    assert_eq!(alone["axis"], "none, as asked");
    assert!(alone["readability"].is_null() && alone["solve"]["figures"]["started_from_guide"] == 0.0);
}

#[test]
fn a_mesh_that_is_no_tunnel_needs_no_axis_and_texture_coordinates_do_not_matter() {
    let folder = tempfile::tempdir().unwrap();
    let plain = grid(24, 24, false, saddle);
    let mut textured = String::new();
    for line in plain.lines() {
        match line.strip_prefix("f ") {
            Some(corners) => {
                let corners: Vec<String> = corners.split(' ').map(|c| format!("{c}/{c}")).collect();
                writeln!(textured, "f {}", corners.join(" ")).unwrap();
            }
            None => writeln!(textured, "{line}\nvt 0.{} 0.5", textured.len() % 997).unwrap(),
        }
    }
    let (plain, textured) = (written(folder.path(), "a.obj", &plain), written(folder.path(), "b.obj", &textured));
    for method in ["lscm", "arap", "slim", "abf", "abf++"] {
        let outs = ["a.ply", "b.ply"].map(|name| folder.path().join(name));
        let first = report(&unwrap(&plain, &outs[0], &["--method", method]));
        report(&unwrap(&textured, &outs[1], &["--method", method]));
        assert!(first["axis"].as_str().unwrap().starts_with("no"), "{}", first["axis"]);
        assert_eq!(first["flipped_faces"], 0);
        assert!(fs::read(&outs[0]).unwrap() == fs::read(&outs[1]).unwrap(), "{method}");
    }
    let needs = unwrap(&plain, &folder.path().join("c.ply"), &["--method", "relax"]);
    assert_eq!(needs.status.code(), Some(3), "{}", String::from_utf8_lossy(&needs.stderr));
}

#[test]
fn what_is_no_disk_is_refused_with_exit_3() {
    let folder = tempfile::tempdir().unwrap();
    let sphere = grid(20, 24, true, |along, around| {
        let (a, b) = (TAU / 2.0 * (0.02 + 0.96 * along), TAU * around);
        [a.sin() * b.cos(), a.sin() * b.sin(), a.cos()]
    });
    // Both polar borders are filled: a closed sphere.
    let mut closed = sphere;
    writeln!(closed, "v 0 0 1\nv 0 0 -1").unwrap();
    for j in 0..24u32 {
        let (a, b, last) = (j + 1, (j + 1) % 24 + 1, 20 * 24);
        writeln!(closed, "f {b} 505 {a}\nf {} 506 {}", last + a, last + b).unwrap();
    }
    let two = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf 1 2 3\nf 4 5 6\n";
    let moebius = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nf 1 2 3\nf 1 2 4\n";
    let cases = [("closed", closed.as_str(), "closed"), ("two", two, "face 1"), ("turned", moebius, "faces 0 and 1")];
    for (name, text, word) in cases {
        let mesh = written(folder.path(), &format!("{name}.obj"), text);
        for method in ["lscm", "abf++", "arap", "slim"] {
            let output = unwrap(&mesh, &folder.path().join("out.ply"), &["--method", method]);
            let message = String::from_utf8_lossy(&output.stderr).into_owned();
            assert_eq!(output.status.code(), Some(3), "{name} {method}: {message}");
            assert!(message.contains(word), "{name} {method}: {message}");
        }
    }
}
