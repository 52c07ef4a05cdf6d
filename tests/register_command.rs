//! `adit register` as a whole program: stations that lie a little apart, and those that nothing holds.

use adit::io;
use assert_cmd::Command;
use std::f64::consts::TAU;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::process::Output;

/// Points of a tunnel of 10 m along x as lines of text, 3 cm higher than another for `lift` of 0.03; `relief_m` is the
/// height of waves on its wall.
fn tunnel(seed: u64, relief_m: f64, lift: f64) -> String {
    let random = |i: u64| {
        let mut h = (i + (seed << 33)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        h = (h ^ (h >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (h >> 12) as f64 / (1u64 << 52) as f64
    };
    let mut text = String::new();
    for i in 0..30_000 {
        let (x, a) = (random(3 * i) * 10.0, random(3 * i + 1) * TAU);
        let waves = (x * 1.7 + (2.0 * a).sin()).sin() + (x * 3.1).cos() * (3.0 * a).sin();
        // A square with round corners, so that no turn is free.
        let r = 2.5 + 0.3 * (4.0 * a).cos() + relief_m * waves + 0.001 * random(3 * i + 2);
        writeln!(text, "{x:.5} {:.5} {:.5}", r * a.cos(), r * a.sin() + lift).unwrap();
    }
    text
}

fn adit(folder: &Path, arguments: &[&str]) -> Output {
    Command::cargo_bin("adit").unwrap().current_dir(folder).arg("register").args(arguments).output().unwrap()
}

fn told(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout)
}

/// Median distance of the stations with the poses that were written, metres.
fn residual(folder: &Path, files: &[&str], poses: Option<&str>) -> f64 {
    let files: Vec<_> = files.iter().map(|f| folder.join(f)).collect();
    let settings = io::Settings { poses: poses.map(|p| folder.join(p)), ..Default::default() };
    let (_, summary) = io::read_cloud(&files, &settings).unwrap();
    assert_eq!(summary.overlaps.len(), 1);
    summary.overlaps[0].overlap.median_m
}

#[test]
fn two_files_are_brought_together() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    fs::write(folder.join("a.xyz"), tunnel(1, 0.08, 0.0)).unwrap();
    fs::write(folder.join("b.xyz"), tunnel(2, 0.08, 0.03)).unwrap();
    let output = adit(folder, &["a.xyz", "b.xyz", "--out", "poses.toml"]);
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
    assert!(told(&output).contains("before: median") && told(&output).contains("after: median"), "{}", told(&output));
    assert!(residual(folder, &["a.xyz", "b.xyz"], None) > 0.01);
    assert!(residual(folder, &["a.xyz", "b.xyz"], Some("poses.toml")) < 0.005);
}

#[test]
fn scans_in_one_file_are_brought_together() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let scan = |text: String| {
        let count = text.lines().count();
        format!("1\n{count}\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n{text}")
    };
    fs::write(folder.join("both.ptx"), scan(tunnel(1, 0.08, 0.0)) + &scan(tunnel(2, 0.08, 0.03))).unwrap();
    let output = adit(folder, &["both.ptx", "--out", "poses.toml"]);
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
    let poses = fs::read_to_string(folder.join("poses.toml")).unwrap();
    assert!(poses.contains("station = 1") && poses.contains("station = 2"), "{poses}");
    assert!(residual(folder, &["both.ptx"], None) > 0.01);
    assert!(residual(folder, &["both.ptx"], Some("poses.toml")) < 0.005);
}

#[test]
fn a_smooth_straight_tunnel_is_refused_and_nothing_is_written() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    fs::write(folder.join("a.xyz"), tunnel(1, 0.0, 0.0)).unwrap();
    fs::write(folder.join("b.xyz"), tunnel(2, 0.0, 0.03)).unwrap();
    let output = adit(folder, &["a.xyz", "b.xyz", "--out", "poses.toml"]);
    assert_eq!(output.status.code(), Some(3), "{}", told(&output));
    assert!(told(&output).contains("a shift along (1.00"), "{}", told(&output));
    assert!(!folder.join("poses.toml").exists());
}

#[test]
fn a_single_station_cannot_be_registered() {
    let place = tempfile::tempdir().unwrap();
    fs::write(place.path().join("a.xyz"), "1 2 3\n4 5 6\n").unwrap();
    let output = adit(place.path(), &["a.xyz", "--out", "poses.toml"]);
    assert_eq!(output.status.code(), Some(2), "{}", told(&output));
    assert!(told(&output).contains("only station"), "{}", told(&output));
}
