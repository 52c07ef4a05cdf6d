//! Linework through the real program: map to wall and back at the coordinates of a national grid, in all formats, and the
//! certificate of a run from its files.

#![allow(clippy::print_stderr, reason = "a skipped check is told")]

mod common;

use adit::io::vector::{self, Shapes, Space};
use adit::linework::{Feature, Kind, Value};
use adit::numeric::Vec3;
use assert_cmd::Command;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

fn adit(arguments: &[&str]) -> Output {
    Command::cargo_bin("adit").unwrap().args(arguments).output().unwrap()
}

fn told(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout)
}

fn done(arguments: &[&str]) -> String {
    let output = adit(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", told(&output));
    told(&output)
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

/// A small run at northing 6 010 935.
fn run(folder: &Path) -> PathBuf {
    let (scan, run) = (folder.join("scan.laz"), folder.join("run"));
    let options = ["--length", "10", "--points", "40000", "--furniture", "none", "--origin", "244398,6010935,18"];
    done(&[&["synth", "--out", path(&scan)], &options[..]].concat());
    let output = adit(&["run", "--input", path(&scan), "--out", path(&run), "--quiet", "--set", "map.cell_m=0.04"]);
    assert!(matches!(output.status.code(), Some(0 | 5)), "{}", told(&output));
    run
}

fn line(id: i64, part: Vec<Vec3>) -> Feature {
    let attributes =
        vec![("kind".to_owned(), Value::Text("joint".into())), ("aperture_m".to_owned(), Value::Real(0.25))];
    Feature { class: "traces".into(), id: Some(id), attributes, kind: Kind::Line, parts: vec![part] }
}

fn distance(p: &Vec3, lines: &[Vec<Vec3>]) -> f64 {
    let segment = |w: &[Vec3]| {
        let d = w[1] - w[0];
        let t = if d.norm_squared() > 0.0 { ((p - w[0]).dot(&d) / d.norm_squared()).clamp(0.0, 1.0) } else { 0.0 };
        (p - w[0] - d * t).norm()
    };
    lines.iter().flat_map(|l| l.windows(2)).map(segment).fold(f64::INFINITY, f64::min)
}

#[test]
fn linework_returns_within_a_millimetre_in_every_format() {
    let place = tempfile::tempdir().unwrap();
    let run = run(place.path());
    let file = |name: &str| place.path().join(name);
    // On the map: a line along, a line across the crown, a short one.
    let drawn = [
        line(11, vec![Vec3::new(1.0, 0.5, 0.0), Vec3::new(8.5, 1.4, 0.0)]),
        line(12, vec![Vec3::new(3.0, -3.0, 0.0), Vec3::new(4.1, 0.2, 0.0), Vec3::new(3.5, 3.2, 0.0)]),
        line(40, vec![Vec3::new(6.0, -2.0, 0.0), Vec3::new(6.2, -2.1, 0.0)]),
    ];
    vector::write(&file("drawn.gpkg"), &[Shapes { space: Space::Map, features: &drawn }]).unwrap();
    for name in ["gpkg", "geojson", "dxf", "shp"] {
        let (up, back) = (file(&format!("up.{name}")), file(&format!("back.{name}")));
        done(&["drape", path(&run), "--in", path(&file("drawn.gpkg")), "--out", path(&up)]);
        done(&["flatten", path(&run), "--in", path(&up), "--out", path(&back)]);
        let wall = vector::read(&up, Space::Scan).unwrap().features;
        let again = vector::read(&back, Space::Map).unwrap().features;
        assert_eq!((wall.len(), again.len()), (3, 3), "{name}");
        for (before, (on_wall, after)) in drawn.iter().zip(wall.iter().zip(&again)) {
            assert_eq!((before.id, before.id), (on_wall.id, after.id), "{name}");
            assert_eq!(after.attribute("kind"), Some(&Value::Text("joint".into())), "{name}");
            // The wall is bent: many vertices, all of them near northing 6 010 935.
            let vertices: usize = on_wall.parts.iter().map(Vec::len).sum();
            assert!(vertices > 5, "{name}: {vertices}");
            assert!(on_wall.parts.iter().flatten().all(|p| (p.y - 6_010_935.0).abs() < 50.0), "{name}");
            let worst = after.parts.iter().flatten().map(|p| distance(p, &before.parts)).fold(0.0, f64::max);
            let missed = before.parts[0].iter().map(|p| distance(p, &after.parts)).fold(0.0, f64::max);
            assert!(worst < 1e-3 && missed < 1e-3, "{name}: {worst} {missed}");
        }
    }
}

#[test]
fn bolts_keep_their_offset_and_what_is_lost_is_told() {
    let place = tempfile::tempdir().unwrap();
    let run = run(place.path());
    let file = |name: &str| place.path().join(name);
    let wall = [
        line(1, vec![Vec3::new(4.0, 1.0, 0.0), Vec3::new(4.1, 1.0, 0.0)]),
        line(2, vec![Vec3::new(-50.0, 1.0, 0.0), Vec3::new(-40.0, 1.0, 0.0)]),
    ];
    vector::write(&file("collars.gpkg"), &[Shapes { space: Space::Map, features: &wall }]).unwrap();
    let warning = done(&["drape", path(&run), "--in", path(&file("collars.gpkg")), "--out", path(&file("up.gpkg"))]);
    assert!(warning.contains("traces 2 was left out"), "{warning}");
    let collar = vector::read(&file("up.gpkg"), Space::Scan).unwrap().features[0].parts[0][0];
    // A bolt of 3 m into the rock, upwards and aside.
    let bolt = line(7, vec![collar, collar + Vec3::new(0.6, 0.4, 2.9)]);
    vector::write(&file("bolt.geojson"), &[Shapes { space: Space::Scan, features: std::slice::from_ref(&bolt) }])
        .unwrap();
    done(&["flatten", path(&run), "--in", path(&file("bolt.geojson")), "--out", path(&file("bolt.gpkg"))]);
    done(&["drape", path(&run), "--in", path(&file("bolt.gpkg")), "--out", path(&file("again.gpkg"))]);
    let again = &vector::read(&file("again.gpkg"), Space::Scan).unwrap().features[0];
    assert_eq!((again.id, again.parts.len(), again.parts[0].len()), (Some(7), 1, 2));
    for (a, b) in bolt.parts[0].iter().zip(&again.parts[0]) {
        assert!((a - b).norm() < 1e-3, "{a} {b}");
    }
    let output = adit(&["drape", path(&run), "--in", path(&file("none.gpkg")), "--out", path(&file("x.gpkg"))]);
    assert_eq!(output.status.code(), Some(3), "{}", told(&output));
}

#[test]
fn the_certificate_finds_a_shifted_raster_and_changed_bytes() {
    let place = tempfile::tempdir().unwrap();
    let run = run(place.path());
    let report: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(run.join("report.json")).unwrap()).unwrap();
    let trip = &report["roundtrip"];
    assert!(trip["max_m"].as_f64().unwrap() < 1e-6 && trip["max_px"].as_f64().unwrap() < 1e-4, "{trip}");
    assert!(
        trip["pixels"]["max_px"].as_f64().unwrap() < 0.01 && trip["pixels"]["sent"].as_u64().unwrap() > 1000,
        "{trip}"
    );
    assert!(trip["lines"]["max_m"].as_f64().unwrap() < 1e-3 && trip["lines"]["sent"].as_u64().unwrap() > 20, "{trip}");
    let verify = || {
        let output = adit(&["verify", path(&run)]);
        (output.status.code(), told(&output))
    };
    let (code, text) = verify();
    assert_eq!(code, Some(0), "{text}");

    // The raster says that it lies two pixels beside its place; nobody would see it, the hash in the report is right.
    let raster = run.join("map/distortion.tif");
    let bytes = fs::read(&raster).unwrap();
    let u = report["map"]["u_min_m"].as_f64().unwrap();
    let v = report["map"]["v_max_m"].as_f64().unwrap();
    let tie = [u.to_le_bytes(), v.to_le_bytes()].concat();
    let at = bytes.windows(16).position(|w| w == tie).expect("the tie point is in the file");
    let mut shifted = bytes.clone();
    shifted[at..at + 8].copy_from_slice(&(u + 0.08).to_le_bytes());
    fs::write(&raster, &shifted).unwrap();
    let (code, text) = verify();
    assert_eq!(code, Some(5), "{text}");
    assert!(text.contains("distortion.tif lies 2 px to the right"), "{text}");

    // The same shift in the content, with the bytes of the report made to agree: another layer of the grid one pixel on.
    let hash = |name: &str| adit::pipeline::run_folder::sha256_of(&run.join(name)).unwrap();
    let mut forged = report.clone();
    let corner = u - 0.08;
    shifted[at..at + 8].copy_from_slice(&corner.to_le_bytes());
    fs::write(&raster, &shifted).unwrap();
    forged["map"]["u_min_m"] = serde_json::json!(corner);
    for product in forged["products"].as_array_mut().unwrap() {
        let name = product["name"].as_str().unwrap().to_owned();
        product["sha256"] = serde_json::json!(hash(&name));
    }
    fs::write(run.join("report.json"), forged.to_string()).unwrap();
    let (code, text) = verify();
    assert_eq!(code, Some(5), "{text}");
    let content = |l: &str| l.contains("FAIL") && l.contains("distortion.tif") && l.contains("pixels differ");
    assert!(text.lines().any(content), "{text}");
    fs::write(&raster, &bytes).unwrap();
    fs::write(run.join("report.json"), report.to_string()).unwrap();

    // One byte of a picture.
    let picture = run.join("map/color.png");
    let mut changed = fs::read(&picture).unwrap();
    let last = changed.len() - 1;
    changed[last] ^= 1;
    fs::write(&picture, &changed).unwrap();
    let (code, text) = verify();
    assert_eq!(code, Some(5), "{text}");
    assert!(text.contains("map/color.png has changed since the run"), "{text}");
}

/// Two lines at seven-digit coordinates, as map and as scan.
fn write_both_spaces(file: &Path) {
    let far = |x: f64, z: f64| Vec3::new(244_398.0 + x, 6_010_935.0 + x, z);
    let features =
        [line(3, vec![far(0.0, 1.0), far(2.0, 1.5)]), line(8, vec![far(1.0, 1.0), far(3.0, 2.5), far(4.0, 2.0)])];
    let shapes =
        [Shapes { space: Space::Scan, features: &features }, Shapes { space: Space::Map, features: &features }];
    vector::write(file, &shapes).unwrap();
}

/// Other programs read what is written: fiona or geopandas, and ezdxf, when Python has them.
#[test]
fn files_open_in_other_programs() {
    let Some(python) = common::python_with("pyogrio, ezdxf") else { return };
    let place = tempfile::tempdir().unwrap();
    let file = |name: &str| place.path().join(name);
    for name in ["a.gpkg", "a.dxf", "a.shp", "a.geojson"] {
        write_both_spaces(&file(name));
    }
    let script = r#"
import sys, ezdxf, pyogrio
folder = sys.argv[1]
layers = dict(pyogrio.list_layers(folder + "/a.gpkg"))
assert set(layers) == {"traces_map", "traces_scan"}, layers
for layer in layers:
    info = pyogrio.read_info(folder + "/a.gpkg", layer=layer, force_total_bounds=True)
    assert info["features"] == 2 and list(info["fields"]) == ["kind", "aperture_m"], info
    assert info["geometry_type"] in ("LineString Z", "2.5D LineString"), info
    assert max(abs(a - b) for a, b in zip(info["total_bounds"], (244398, 6010935, 244402, 6010939))) < 1e-6, info
for name in ("a.shp", "a.geojson"):
    assert pyogrio.read_info(folder + "/" + name)["features"] == 2, name
document = ezdxf.readfile(folder + "/a.dxf")
audit = document.audit()
assert not audit.errors and not audit.fixes, (audit.errors, audit.fixes)
lines = list(document.modelspace().query("POLYLINE"))
assert len(lines) == 2 and all(l.is_3d_polyline for l in lines)
assert [tuple(v) for v in lines[0].points()][1] == (244400.0, 6010937.0, 1.5)
print("fine")
"#;
    let output = std::process::Command::new(&python).args(["-c", script, path(place.path())]).output().unwrap();
    assert!(output.status.success(), "{}", told(&output));
}

/// The checks of GDAL's own validator, when Python has it.
#[test]
fn gdal_finds_geopackages_valid() {
    let Some(python) = common::python_with("osgeo_utils.samples.validate_gpkg") else { return };
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("a.gpkg");
    write_both_spaces(&file);
    let script = "import sys, osgeo_utils.samples.validate_gpkg as v\n\
                  found = v.check(sys.argv[1], abort_at_first_error=False, extra_checks=True)\n\
                  assert not found, found";
    let output = std::process::Command::new(&python).args(["-c", script, path(&file)]).output().unwrap();
    assert!(output.status.success(), "{}", told(&output));
}

/// Requirements of OGC 12-128r17 that SQL can tell: marks of the file, tables that refer to each other, extents, and the
/// head of each geometry.
#[test]
fn geopackages_meet_the_standard() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("a.gpkg");
    write_both_spaces(&file);
    let database = rusqlite::Connection::open(&file).unwrap();
    let one = |sql: &str| database.query_row(sql, [], |row| row.get::<_, i64>(0)).unwrap();
    assert_eq!(one("PRAGMA application_id"), i64::from(u32::from_be_bytes(*b"GPKG")));
    assert_eq!(one("PRAGMA user_version"), 10_300);
    let check: String = database.query_row("PRAGMA integrity_check", [], |row| row.get(0)).unwrap();
    assert_eq!(check, "ok");
    assert_eq!(one("SELECT count(*) FROM pragma_foreign_key_check"), 0);
    assert_eq!(one("SELECT count(*) FROM gpkg_spatial_ref_sys WHERE srs_id IN (-1, 0, 4326)"), 3);
    let described =
        "SELECT c.table_name, g.column_name, g.geometry_type_name, g.srs_id, g.z, c.min_x, c.min_y, c.max_x, c.max_y
                     FROM gpkg_contents c JOIN gpkg_geometry_columns g USING (table_name, srs_id)
                     WHERE c.data_type = 'features' AND g.m = 0";
    let mut tables = database.prepare(described).unwrap();
    let mut rows = tables.query([]).unwrap();
    let mut seen = Vec::new();
    while let Some(row) = rows.next().unwrap() {
        let text = |k: usize| row.get::<_, String>(k).unwrap();
        let (table, column, kind) = (text(0), text(1), text(2));
        let (srs, z): (i32, u32) = (row.get(3).unwrap(), row.get(4).unwrap());
        let extent = [5, 6, 7, 8].map(|k| row.get::<_, f64>(k).unwrap());
        let mut reached = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        let mut shapes = database.prepare(&format!("SELECT {column} FROM {table}")).unwrap();
        let shapes: Vec<Vec<u8>> = shapes.query_map([], |r| r.get(0)).unwrap().map(Result::unwrap).collect();
        assert!(!shapes.is_empty(), "{table}");
        for shape in &shapes {
            let int = |at: usize| i32::from_le_bytes(shape[at..at + 4].try_into().unwrap());
            let float = |at: usize| f64::from_le_bytes(shape[at..at + 8].try_into().unwrap());
            assert_eq!((&shape[..2], shape[2], shape[3] & 1, int(4)), (&b"GP"[..], 0, 1, srs), "{table}");
            let body = 8 + [0, 32, 48, 48, 64][usize::from(shape[3] >> 1 & 7)];
            // ISO well-known binary: 2 is a line, 1000 more for three coordinates.
            assert_eq!((shape[body], int(body + 1)), (1, 2 + 1000 * z as i32), "{table}");
            assert_eq!(kind, "LINESTRING");
            let step = if z == 1 { 24 } else { 16 };
            for at in (0..int(body + 5) as usize).map(|i| body + 9 + i * step) {
                let (x, y) = (float(at), float(at + 8));
                reached = [reached[0].min(x), reached[1].min(y), reached[2].max(x), reached[3].max(y)];
            }
        }
        assert_eq!(extent, reached, "{table}");
        seen.push(table);
    }
    seen.sort();
    assert_eq!(seen, ["traces_map", "traces_scan"]);
}
