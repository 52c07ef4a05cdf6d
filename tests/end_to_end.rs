//! The real program on synthetic scans in a temporary folder: what it makes is compared with the closed form.

use adit::synthetic::{Recipe, Tunnel, Wall};
use assert_cmd::Command;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

/// Small enough to be quick, dense enough for a map.
const POINTS: &str = "60000";

fn adit(arguments: &[&str]) -> Output {
    Command::cargo_bin("adit").unwrap().args(arguments).output().unwrap()
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout)
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

/// `adit synth` into `folder`.
fn synth(folder: &Path, name: &str, options: &[&str]) -> PathBuf {
    let scan = folder.join(name);
    let mut arguments = vec!["synth", "--out", path(&scan)];
    if !options.contains(&"--points") {
        arguments.extend(["--points", POINTS]);
    }
    arguments.extend(options);
    let output = adit(&arguments);
    assert!(output.status.success(), "{}", text(&output));
    scan
}

/// `adit run`; the run must finish, a broken limit is told by the tests that care.
fn run(scan: &Path, name: &str, options: &[&str]) -> PathBuf {
    let folder = scan.with_file_name(name);
    let mut arguments = vec!["run", "--input", path(scan), "--out", path(&folder), "--quiet"];
    arguments.extend(options);
    let output = adit(&arguments);
    let code = output.status.code();
    assert!(matches!(code, Some(0 | 5)), "exit {code:?}: {}", text(&output));
    folder
}

fn report(folder: &Path) -> serde_json::Value {
    serde_json::from_str(&fs::read_to_string(folder.join("report.json")).unwrap()).unwrap()
}

/// The columns label, chainage, girth (metres; NaN for none) of a LAS file, by their names.
fn map_columns(file: &Path) -> Vec<(u32, f64, f64)> {
    let mut reader = las::Reader::from_path(file).unwrap();
    let described =
        reader.header().vlrs().iter().find(|v| v.user_id == "LASF_Spec" && v.record_id == 4).unwrap().clone();
    let mut at = 0;
    let mut place = std::collections::BTreeMap::new();
    for descriptor in described.data.chunks_exact(192) {
        let name = String::from_utf8_lossy(&descriptor[4..36]).trim_end_matches('\0').to_owned();
        place.insert(name, at);
        at += [0, 1, 1, 2, 2, 4, 4, 8, 8, 4, 8][usize::from(descriptor[2])];
    }
    let records = reader.read_all().unwrap();
    let metres = |raw: i64, none: i64| if raw == none { f64::NAN } else { raw as f64 * 1e-6 };
    records
        .points()
        .map(|p| {
            let bytes = p.unwrap().extra_bytes;
            let of = |name: &str| &bytes[place[name]..];
            let label = u32::from_le_bytes(of("label")[..4].try_into().unwrap());
            let chainage = i64::from_le_bytes(of("chainage")[..8].try_into().unwrap());
            let girth = i32::from_le_bytes(of("girth")[..4].try_into().unwrap());
            (label, metres(chainage, i64::MIN), metres(i64::from(girth), i64::from(i32::MIN)))
        })
        .collect()
}

fn median(mut values: Vec<f64>) -> f64 {
    assert!(!values.is_empty());
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// A grey picture with the place of its pixels.
struct Picture {
    pixels: image::RgbaImage,
    cell_m: f64,
    u_of_first: f64,
    v_of_first: f64,
}

impl Picture {
    fn open(folder: &Path, layer: &str) -> Self {
        let pixels = image::open(folder.join(format!("map/{layer}.png"))).unwrap().into_rgba8();
        let world = fs::read_to_string(folder.join(format!("map/{layer}.pgw"))).unwrap();
        let n: Vec<f64> = world.lines().map(|l| l.trim().parse().unwrap()).collect();
        assert!(n[0] > 0.0 && n[3] < 0.0 && n[1] == 0.0 && n[2] == 0.0, "u to the right, v upwards");
        Self { pixels, cell_m: n[0], u_of_first: n[4], v_of_first: n[5] }
    }

    /// (u, v, brightness) of the pixels that are not empty.
    fn places(&self) -> impl Iterator<Item = (f64, f64, f64)> + '_ {
        self.pixels.enumerate_pixels().filter(|(_, _, p)| p.0[3] > 0).map(|(x, y, p)| {
            let brightness = f64::from(u32::from(p.0[0]) + u32::from(p.0[1]) + u32::from(p.0[2])) / 765.0;
            (self.u_of_first + f64::from(x) * self.cell_m, self.v_of_first - f64::from(y) * self.cell_m, brightness)
        })
    }
}

const PRODUCTS: [&str; 21] = [
    "pipeline.toml",
    "report.json",
    "axis.csv",
    "mesh.ply",
    "chart.ply",
    "map/map.png",
    "map/labels.json",
    "map/color.png",
    "map/color.tif",
    "map/intensity.png",
    "map/intensity.tif",
    "map/labels.png",
    "map/labels.tif",
    "map/offset.png",
    "map/offset.tif",
    "map/coverage.png",
    "map/coverage.tif",
    "map/distortion.png",
    "map/distortion.tif",
    "map/labels.pgw",
    "points.laz",
];

/// Runs a scan with truth and compares the coordinates of all points that have both.
fn compare_with_closed_form(name: &str, method: &str, options: &[&str], girth_tolerance_m: f64) {
    let temporary = tempfile::tempdir().unwrap();
    let mut all = vec!["--truth", "--length", "14", "--roughness", "0.03"];
    all.extend(options);
    let scan = synth(temporary.path(), &format!("{name}.laz"), &all);
    let folder = run(&scan, "run", &["--set", "map.cell_m=0.04", "--set", &format!("unwrap={method}")]);
    for product in PRODUCTS {
        assert!(folder.join(product).is_file(), "{name}: no {product}");
    }
    let report = report(&folder);
    assert_eq!(report["unwrap"]["flipped_faces"], 0, "{name}");
    assert!(report["roundtrip"]["max_m"].as_f64().unwrap() < 1e-6, "{name}: {}", report["roundtrip"]);
    assert_eq!(report["roundtrip"]["lost"], 0, "{name}: {}", report["roundtrip"]);
    let covered = report["anchor"]["covered"].as_u64().unwrap();
    assert!(covered * 1000 < report["anchor"]["points"].as_u64().unwrap(), "{name}: {covered} points are covered");
    assert!(report["map"]["coverage_percent"].as_f64().unwrap() > 80.0, "{name}: {}", report["map"]);
    let (truth, found) = (map_columns(&scan), map_columns(&folder.join("points.laz")));
    assert_eq!(truth.len(), found.len(), "{name}: every point is written");
    let both: Vec<_> = truth.iter().zip(&found).filter(|(t, f)| t.2.is_finite() && f.2.is_finite()).collect();
    assert!(both.len() > truth.len() * 7 / 10, "{name}: only {} of {} points on the map", both.len(), truth.len());
    // The map may start elsewhere along the axis, but must keep the scale and the direction.
    let shift = median(both.iter().map(|(t, f)| f.1 - t.1).collect());
    assert!(shift.abs() < 0.5, "{name}: chainage is shifted by {shift}");
    let chainage = median(both.iter().map(|(t, f)| (f.1 - t.1 - shift).abs()).collect());
    let girth = median(both.iter().map(|(t, f)| (f.2 - t.2).abs()).collect());
    assert!(chainage < 0.05, "{name}: chainage is off by {chainage} m (median)");
    assert!(girth < girth_tolerance_m, "{name}: girth is off by {girth} m (median)");
}

#[test]
fn straight_tunnels_get_their_true_coordinates() {
    compare_with_closed_form("straight", "relax", &["--alignment", "straight"], 0.06);
}

#[test]
fn bends_get_their_true_coordinates() {
    // On a bend `relax` gives up some of the ruler for less stretch; `section` is the exact ruler.
    compare_with_closed_form("bend", "section", &["--radius", "-25", "--azimuth", "80"], 0.08);
}

#[test]
fn ramps_get_their_true_coordinates() {
    compare_with_closed_form("ramp", "relax", &["--alignment", "ramp", "--gradient", "-15", "--azimuth", "30"], 0.06);
}

#[test]
fn shafts_get_their_true_coordinates() {
    let shaft = ["--alignment", "shaft", "--section", "circle:2", "--furniture", "cables"];
    compare_with_closed_form("shaft", "relax", &shaft, 0.08);
}

/// The bundled kind of tunnel, as the lettering tests need it.
fn lettered(folder: &Path) -> (PathBuf, Tunnel) {
    let scan = synth(folder, "drift.laz", &["--length", "16", "--points", "150000", "--furniture", "none"]);
    let recipe = Recipe { length_m: 16.0, furniture: vec![], ..Recipe::default() };
    (scan, recipe.tunnel().unwrap())
}

#[test]
fn lettering_reads_correctly_from_inside() {
    let temporary = tempfile::tempdir().unwrap();
    let (scan, tunnel) = lettered(temporary.path());
    let folder = run(&scan, "run", &["--set", "map.cell_m=0.02"]);
    let picture = Picture::open(&folder, "color");
    // The crown is in the middle.
    let (top, bottom) = (picture.v_of_first, picture.v_of_first - f64::from(picture.pixels.height()) * picture.cell_m);
    assert!((top + bottom).abs() < 0.3, "v runs from {bottom} to {top}");
    // Single letters are as small as the shift of the map's start against the truth, so only words are compared.
    for letters in tunnel.lettering.iter().filter(|l| l.text.chars().count() > 1) {
        let sign = if letters.wall == Wall::Left { -1.0 } else { 1.0 };
        let (s0, g0) = (letters.chainage_m, sign * letters.girth_m);
        let (half_width, half_height) = (letters.width_m() / 2.0 + 0.1, letters.height_m / 2.0 + 0.1);
        let window: Vec<_> =
            picture.places().filter(|(u, v, _)| (u - s0).abs() < half_width && (v - g0).abs() < half_height).collect();
        assert!(window.len() > 500, "the lettering {} is on the map", letters.text);
        // How much brighter the paint is than the rock around it, were the map as `seen` says.
        let contrast = |seen: &dyn Fn(f64, f64) -> (f64, f64)| {
            let (mut paint, mut rock) = ((0.0, 0.0), (0.0, 0.0));
            for &(u, v, brightness) in &window {
                let (s, g) = seen(u, v);
                let sum = if letters.covers(s, g) { &mut paint } else { &mut rock };
                *sum = (sum.0 + brightness, sum.1 + 1.0);
            }
            paint.0 / paint.1 - rock.0 / rock.1
        };
        let right = contrast(&|u, v| (u, v));
        let mirrored = contrast(&|u, v| (2.0 * s0 - u, v));
        let upside_down = contrast(&|u, v| (u, 2.0 * g0 - v));
        let turned = contrast(&|u, v| (2.0 * s0 - u, 2.0 * g0 - v));
        assert!(right > 0.15, "{}: contrast {right}", letters.text);
        for (how, wrong) in [("mirrored", mirrored), ("upside down", upside_down), ("turned", turned)] {
            assert!(wrong < 0.9 * right, "{} {how}: {wrong}, upright: {right}", letters.text);
        }
    }
}

#[test]
fn labels_survive_the_way_to_the_map_and_back() {
    let temporary = tempfile::tempdir().unwrap();
    let (scan, _) = lettered(temporary.path());
    let folder = run(&scan, "run", &["--set", "map.cell_m=0.005"]);
    let lifted = temporary.path().join("lifted.laz");
    let output =
        adit(&["lift", path(&folder), "--labels", path(&folder.join("map/labels.png")), "--out", path(&lifted)]);
    assert!(output.status.success(), "{}", text(&output));
    let before: Vec<u32> = las::Reader::from_path(&scan)
        .unwrap()
        .read_all()
        .unwrap()
        .points()
        .map(|p| u32::from_le_bytes(p.unwrap().extra_bytes[0..4].try_into().unwrap()))
        .collect();
    let after = map_columns(&lifted);
    assert_eq!(before.len(), after.len());
    // Points on the surface; outliers have no place on the map.
    let labelled: Vec<_> = before.iter().zip(&after).filter(|(b, a)| **b > 0 && a.2.is_finite()).collect();
    assert!(labelled.len() > 500, "{}", labelled.len());
    let kept = labelled.iter().filter(|(b, a)| **b == a.0).count() as f64 / labelled.len() as f64;
    assert!(kept >= 0.99, "{kept} of {} labelled points", labelled.len());
    let gained = before.iter().zip(&after).filter(|(b, a)| **b == 0 && a.0 > 0).count() as f64 / before.len() as f64;
    assert!(gained < 0.02, "{gained} of the points gained a label");
}

/// Every file below a folder with its bytes, without what may differ (times).
fn products(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(current) = folders.pop() {
        for entry in fs::read_dir(current).unwrap() {
            let entry = entry.unwrap().path();
            let name = entry.file_name().unwrap().to_string_lossy().into_owned();
            if entry.is_dir() {
                if !name.starts_with('.') {
                    folders.push(entry);
                }
            } else if name != "report.json" && !name.ends_with(".log") && !name.starts_with('.') {
                found.push((entry.strip_prefix(folder).unwrap().to_owned(), fs::read(&entry).unwrap()));
            }
        }
    }
    found.sort();
    found
}

#[test]
fn the_same_bytes_on_one_and_two_threads() {
    let temporary = tempfile::tempdir().unwrap();
    let scan = synth(temporary.path(), "scan.laz", &["--length", "10", "--points", "30000"]);
    let coarse = ["--set", "map.cell_m=0.05", "--threads"];
    let once = products(&run(&scan, "one", &[&coarse[..], &["1"]].concat()));
    for (name, threads) in [("two", "2"), ("again", "2")] {
        let other = products(&run(&scan, name, &[&coarse[..], &[threads]].concat()));
        assert_eq!(once.len(), other.len());
        for ((file, bytes), (other_file, other_bytes)) in once.iter().zip(&other) {
            assert_eq!(file, other_file);
            assert!(bytes == other_bytes, "{} differs on the run '{name}'", file.display());
        }
    }
}

#[test]
fn ply_without_colors_works_too() {
    let temporary = tempfile::tempdir().unwrap();
    let options = ["--no-color", "--origin", "0,0,0", "--length", "10", "--points", "40000"];
    let scan = synth(temporary.path(), "scan.ply", &options);
    let folder = run(&scan, "run", &["--set", "map.cell_m=0.05"]);
    assert!(folder.join("points.ply").is_file() && !folder.join("points.laz").exists());
    // Not a black picture: the overview shows something of the rock.
    let overview = image::open(folder.join("map/map.png")).unwrap().into_luma8();
    let grey = overview.pixels().filter(|p| (30..220).contains(&p.0[0])).count();
    assert!(grey * 5 > overview.pixels().len(), "{grey} grey pixels of {}", overview.pixels().len());
}

#[test]
fn bad_input_is_told_in_one_line() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    let scan = synth(folder, "scan.laz", &["--length", "6", "--points", "8000", "--furniture", "none"]);
    let bytes = fs::read(&scan).unwrap();
    fs::write(folder.join("empty.laz"), b"").unwrap();
    fs::write(folder.join("text.las"), b"hello").unwrap();
    fs::write(folder.join("cut.laz"), &bytes[..bytes.len() / 2]).unwrap();
    let ply = |vertices: &str, count: usize| {
        let properties = "property double x\nproperty double y\nproperty double z\n";
        format!("ply\nformat ascii 1.0\nelement vertex {count}\n{properties}end_header\n{vertices}")
    };
    fs::write(folder.join("none.ply"), ply("", 0)).unwrap();
    fs::write(folder.join("nan.ply"), ply("nan nan nan\nnan 0 0\n", 2)).unwrap();
    let plane: String =
        (0..4000).map(|i| format!("{} {} 0\n", f64::from(i % 63) * 0.1, f64::from(i / 63) * 0.1)).collect();
    fs::write(folder.join("plane.ply"), ply(&plane, 4000)).unwrap();
    fs::write(folder.join("file"), b"").unwrap();
    let file = |name: &str| path(&folder.join(name)).to_owned();
    let out = file("out");
    let input = |name: &str| vec!["run".to_owned(), "--input".into(), file(name), "--out".into(), out.clone()];
    let with = |mut arguments: Vec<String>, more: &[&str]| {
        arguments.extend(more.iter().map(|m| (*m).to_owned()));
        arguments
    };
    // Arguments, exit code, what the line must name.
    let table: Vec<(&str, Vec<String>, i32, &str)> = vec![
        ("missing", input("no.laz"), 3, "no.laz"),
        ("empty", input("empty.laz"), 3, "empty.laz"),
        ("text", input("text.las"), 3, "text.las"),
        ("truncated", input("cut.laz"), 3, "cut.laz"),
        ("zero points", input("none.ply"), 3, "none.ply"),
        ("nothing finite", input("nan.ply"), 3, "nan.ply"),
        ("not a tunnel", input("plane.ply"), 3, ""),
        ("misspelt key", with(input("scan.laz"), &["--set", "map.cel_m=1"]), 2, "map.cell_m"),
        ("bad value", with(input("scan.laz"), &["--set", "map.cell_m=wide"]), 2, "map.cell_m=wide"),
        (
            "unwritable",
            ["run", "--input", &file("scan.laz"), "--out", &file("file/run")].map(str::to_owned).to_vec(),
            6,
            "file",
        ),
        ("no such pipeline", vec!["run".into(), file("no.toml")], 2, "no.toml"),
        ("no input", vec!["run".into()], 2, "input"),
        ("unknown format", vec!["synth".into(), "--out".into(), file("x.xyz")], 2, "xyz"),
        ("impossible tunnel", vec!["synth".into(), "--out".into(), file("x.laz"), "--radius=1".into()], 2, "radius"),
    ];
    for (name, arguments, code, names) in table {
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let output = adit(&arguments);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{name}: {told}");
        let error = told.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or_default();
        assert!(error.contains(names), "{name}: '{error}' does not name '{names}'");
        assert!(!told.contains("panicked") && !told.contains("internal error"), "{name}: {told}");
        for product in ["report.json", "map", "mesh.ply", "chart.ply", "points.laz", "points.ply"] {
            assert!(!folder.join("out").join(product).exists(), "{name} left {product}");
        }
    }
}

#[test]
fn gps_times_that_call_the_decoder_again_and_again_do_not_end_the_program() {
    // Found by fuzzing: a layer that changes between the sequences of GPS times some 30,000 times for one point, and a chunk
    // without layers that does so more often still. A decoder that calls itself for each needs that much stack.
    for file in ["gps_time_sequences.laz", "gps_time_sequences_deep.laz"] {
        for options in [&["info"][..], &["info", "--json"], &["info", "--threads", "1"]] {
            let output = adit(&[options, &[&format!("tests/damaged/{file}")]].concat());
            let told = text(&output);
            assert_eq!(output.status.code(), Some(3), "{file}: {told}");
            assert!(
                told.contains("do not decode: GPS times change between sequences again and again"),
                "{file}: {told}"
            );
        }
    }
}
