//! What leaves the house with a map: rasters that other programs put in the right place, the way back to 3D, sheets at
//! true scale, the package, and pictures that come back from a paint program.
//!
//! One run of the bundled scan serves all tests. The checks that need Python packages or a PDF renderer run when these
//! are there (`ADIT_TEST_PYTHON` names another interpreter) and say so when they are not.

#![allow(clippy::print_stderr, reason = "a skipped check is told")]

mod common;

use assert_cmd::Command;
use std::fs::{self, File};
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::Command as Process;
use std::sync::OnceLock;
use tiff::decoder::{Decoder, DecodingResult};

fn adit() -> Command {
    Command::cargo_bin("adit").unwrap()
}

/// A finished run with all layers, at 2 cm.
fn run() -> &'static Path {
    static RUN: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    &RUN.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("drift");
        let profile = folder.path().join("profile.csv");
        fs::write(&profile, "right_m,up_m\n-2.5,-2\n2.5,-2\n2.5,1\n0,3\n-2.5,1\n").unwrap();
        let layers = "map.layers=[\"color\",\"intensity\",\"labels\",\"offset\",\"coverage\",\"distortion\",\"relief\",\
                      \"roughness\",\"design_offset\",\"xyz\",\"surface_point\"]";
        let scan = Path::new(env!("CARGO_MANIFEST_DIR")).join("sample_scans/bent_drift.laz");
        adit()
            .args(["run", "--quiet", "--set", "map.cell_m=0.02", "--set", layers, "--set", "map.tiles=true", "--set"])
            .arg(format!("map.design_profile=\"{}\"", profile.display()))
            .arg("--input")
            .arg(scan)
            .arg("--out")
            .arg(&run)
            .assert()
            .success();
        (folder, run)
    })
    .1
}

/// First image of a GeoTIFF, its width, and its GDAL metadata.
fn read_tiff(path: &Path) -> (DecodingResult, usize, String) {
    let mut decoder = Decoder::new(BufReader::new(File::open(path).unwrap())).unwrap();
    let width = decoder.dimensions().unwrap().0 as usize;
    let metadata = decoder.get_tag_ascii_string(tiff::tags::Tag::Unknown(42112)).unwrap();
    (decoder.read_image().unwrap(), width, metadata)
}

/// Vertices (x, y, z, u, v) and faces of a binary `chart.ply`.
fn read_chart(path: &Path) -> (Vec<[f64; 5]>, Vec<[u32; 3]>) {
    let mut file = BufReader::new(File::open(path).unwrap());
    let (mut vertices, mut faces, mut has_observed_faces, mut in_faces) = (0, 0, false, false);
    loop {
        let mut line = String::new();
        file.read_line(&mut line).unwrap();
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["element", "vertex", n] => vertices = n.parse().unwrap(),
            ["element", "face", n] => (faces, in_faces) = (n.parse().unwrap(), true),
            ["property", "uchar", "observed"] => has_observed_faces |= in_faces,
            ["end_header"] => break,
            _ => {}
        }
    }
    let mut read_vertex = || {
        let mut bytes = [0u8; 41];
        file.read_exact(&mut bytes).unwrap();
        [0, 1, 2, 3, 4].map(|k| f64::from_le_bytes(bytes[8 * k..8 * k + 8].try_into().unwrap()))
    };
    let vertices: Vec<[f64; 5]> = (0..vertices).map(|_| read_vertex()).collect();
    let mut read_face = || {
        let mut bytes = vec![0u8; 13 + usize::from(has_observed_faces)];
        file.read_exact(&mut bytes).unwrap();
        [0, 1, 2].map(|k| u32::from_le_bytes(bytes[1 + 4 * k..5 + 4 * k].try_into().unwrap()))
    };
    (vertices, (0..faces).map(|_: usize| read_face()).collect())
}

/// The way back needs `xyz.tif` alone, or `surface_point.tif` and `chart.ply`; both lead to the same place, which lies
/// under the pixel's centre on the map.
#[test]
fn pixels_lead_back_to_the_scan() {
    let map = run().join("map");
    let (DecodingResult::F32(xyz), width, metadata) = read_tiff(&map.join("xyz.tif")) else { panic!("floats") };
    let (DecodingResult::F32(place), ..) = read_tiff(&map.join("surface_point.tif")) else { panic!("floats") };
    let place: Vec<f64> = place.into_iter().map(f64::from).collect();
    let offset = |band: usize| -> f64 {
        let key = format!("<Item name=\"OFFSET\" sample=\"{band}\" role=\"offset\">");
        metadata.split(&key).nth(1).unwrap().split('<').next().unwrap().parse().unwrap()
    };
    let offsets = [offset(0), offset(1), offset(2)];
    assert!(offsets[1] > 6e6, "the scan has a seven-digit northing: {offsets:?}");
    let (vertices, faces) = read_chart(&run().join("chart.ply"));
    let legend: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(map.join("legend.json")).unwrap()).unwrap();
    let number = |key: &str| legend[key].as_f64().unwrap();
    let (cell, u_min, v_max) = (number("cell_m"), number("u_min_m"), number("v_max_m"));
    let mut seen = 0;
    for i in (0..xyz.len() / 3).step_by(97) {
        let on_surface = place[3 * i] >= 0.0;
        assert_eq!(on_surface, !xyz[3 * i].is_nan());
        if !on_surface {
            continue;
        }
        let (b, c) = (place[3 * i + 1], place[3 * i + 2]);
        let corners = faces[place[3 * i] as usize].map(|v| vertices[v as usize]);
        let at = |k: usize| (1.0 - b - c) * corners[0][k] + b * corners[1][k] + c * corners[2][k];
        for k in 0..3 {
            let from_xyz = f64::from(xyz[3 * i + k]) + offsets[k];
            assert!((from_xyz - at(k)).abs() < 1e-4, "pixel {i}: {from_xyz} {}", at(k));
        }
        let (u, v) = (u_min + ((i % width) as f64 + 0.5) * cell, v_max - ((i / width) as f64 + 0.5) * cell);
        assert!((at(3) - u).abs() < 0.01 * cell && (at(4) - v).abs() < 0.01 * cell);
        seen += 1;
    }
    assert!(seen > 5000, "{seen}");
}

#[test]
fn every_layer_has_a_legend_tiles_and_lines() {
    let map = run().join("map");
    let legend: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(map.join("legend.json")).unwrap()).unwrap();
    let layers = legend["layers"].as_array().unwrap();
    assert_eq!(layers.len(), 11);
    for layer in layers {
        let name = layer["layer"].as_str().unwrap();
        assert!(map.join(format!("{name}.tif")).is_file() && !layer["meaning"].as_str().unwrap().is_empty());
        let shown = layer["look"] != "none";
        assert_eq!(map.join(format!("{name}.png")).is_file(), shown, "{name}");
        assert_eq!(map.join(format!("tiles/{name}/0/0/0.png")).is_file(), shown, "{name}");
    }
    let lines: serde_json::Value = serde_json::from_str(&fs::read_to_string(map.join("lines.json")).unwrap()).unwrap();
    // The bent drift is 5 m wide with walls of 2.2 m: crown in the middle, springlines at half the arch, floor below.
    let girth = |kind: &str| {
        let line = lines.as_array().unwrap().iter().find(|l| l["kind"] == kind).unwrap_or_else(|| panic!("{kind}"));
        let mut values: Vec<f64> = line["pieces"]
            .as_array()
            .unwrap()
            .iter()
            .flat_map(|p| p.as_array().unwrap())
            .map(|p| p[1].as_f64().unwrap())
            .collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let (left, right) = (girth("springline_left"), girth("springline_right"));
    assert!(girth("crown").abs() < 0.1 && (left + right).abs() < 0.4 && right > 1.5, "{left} {right}");
    assert!(girth("foot_left") < left - 0.5 && girth("foot_right") > right + 0.5);
}

#[test]
fn sheets_are_the_same_bytes_again_and_refuse_what_does_not_fit() {
    let folder = tempfile::tempdir().unwrap();
    let sheet = |name: &str, more: &[&str]| {
        let path = folder.path().join(name);
        adit().arg("sheet").arg(run()).arg("--out").arg(&path).args(more).assert().success();
        path
    };
    let (a, b) = (sheet("a.pdf", &[]), sheet("b.pdf", &[]));
    assert!(fs::read(a).unwrap() == fs::read(b).unwrap());
    let svg = fs::read_to_string(sheet("a.svg", &["--layout", "chainage-y", "--view", "outside"])).unwrap();
    assert!(svg.contains("mirror image") && svg.contains("chainage upwards") && svg.contains("springline"));
    assert!(svg.contains("aria-label=\"f36d38fedb787da7\""), "the hash of the bundled scan is in the title block");
    let picture = image::open(sheet("a.png", &["--layer", "offset", "--dpi", "60"])).unwrap();
    assert!(picture.width() > 900);
    let small = adit().arg("sheet").arg(run()).args(["--paper", "a4", "--scale", "50", "--out", "x.pdf"]).assert();
    let text = String::from_utf8_lossy(&small.code(2).get_output().stderr.clone()).into_owned();
    assert!(text.contains("1:100") || text.contains("1:200"), "{text}");
}

/// 10 m of grid are 100 mm at 1:100, measured on the rendered page.
#[test]
fn a_rendered_sheet_has_its_scale() {
    let folder = tempfile::tempdir().unwrap();
    let pdf = folder.path().join("a.pdf");
    adit()
        .arg("sheet")
        .arg(run())
        .args(["--scale", "100", "--layer", "coverage", "--out"])
        .arg(&pdf)
        .assert()
        .success();
    let rendered = Process::new("pdftoppm")
        .args(["-r", "254", "-png", "-singlefile"])
        .arg(&pdf)
        .arg(folder.path().join("page"))
        .status();
    if !rendered.is_ok_and(|s| s.success()) {
        eprintln!("SKIPPED: no pdftoppm (poppler-utils) to render the sheet with");
        return;
    }
    let page = image::open(folder.path().join("page.png")).unwrap().into_luma8();
    // A row above the map holds nothing but the ticks, the longer ones each 5 m: 50 mm, 500 pixels.
    let dark = |y: u32| (0..page.width()).filter(|&x| page.get_pixel(x, y)[0] < 140).collect::<Vec<u32>>();
    let starts = |y: u32| {
        let dark = dark(y);
        dark.iter().copied().filter(|x| !dark.contains(&(x.wrapping_sub(1)))).collect::<Vec<u32>>()
    };
    let found = (120..page.height() / 2).map(starts).find(|ticks| {
        // Frame at both sides, ticks between.
        let inner = &ticks[1.min(ticks.len())..ticks.len().saturating_sub(1)];
        inner.len() >= 4 && inner.windows(2).all(|p| p[1].abs_diff(p[0]).abs_diff(500) <= 1)
    });
    assert!(found.is_some(), "ticks 500 pixels apart were not found above the map");
}

#[test]
fn a_package_has_everything_and_the_same_bytes_again() {
    let folder = tempfile::tempdir().unwrap();
    let pack = |name: &str| {
        let path = folder.path().join(name);
        adit().arg("package").arg(run()).arg("--out").arg(&path).assert().success();
        path
    };
    let (one, two) = (pack("one.zip"), pack("two.zip"));
    assert!(fs::read(&one).unwrap() == fs::read(two).unwrap());
    let mut zip = zip::ZipArchive::new(File::open(one).unwrap()).unwrap();
    let names: Vec<String> = zip.file_names().map(str::to_owned).collect();
    let mut text = |name: &str| {
        let mut text = String::new();
        zip.by_name(name).unwrap().read_to_string(&mut text).unwrap();
        text
    };
    let project = text("map.qgs");
    let sources: Vec<&str> = project.split("<datasource>./").skip(1).map(|s| s.split('<').next().unwrap()).collect();
    assert_eq!(sources.len(), 11);
    for source in sources {
        assert!(names.iter().any(|n| n == source), "{source} is not in the package");
    }
    let hashes = text("SHA256SUMS");
    assert_eq!(hashes.lines().count(), names.len() - 1);
    for name in ["README.txt", "map/xyz.tif", "map/surface_point.tif", "map/color.qml", "chart.ply", "axis.csv"] {
        assert!(hashes.contains(&format!("  {name}\n")), "{name}");
    }
    assert!(!names.iter().any(|n| n.contains(".adit") || n == "points.laz"));
}

/// The values of the first picture of a TIFF file of floats.
fn places(file: &[u8]) -> Vec<f32> {
    let mut decoder = tiff::decoder::Decoder::new(std::io::Cursor::new(file)).unwrap();
    match decoder.read_image().unwrap() {
        tiff::decoder::DecodingResult::F32(values) => values,
        _ => panic!("no floats"),
    }
}

/// A package of a run without a back-map has one all the same.
#[test]
fn the_way_back_is_drawn_for_the_package() {
    let folder = tempfile::tempdir().unwrap();
    let thin = folder.path().join("thin");
    fs::create_dir_all(thin.join("map")).unwrap();
    for name in ["report.json", "chart.ply"] {
        fs::copy(run().join(name), thin.join(name)).unwrap();
    }
    let mut legend: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(run().join("map/legend.json")).unwrap()).unwrap();
    legend["layers"].as_array_mut().unwrap().retain(|l| l["layer"] != "xyz" && l["layer"] != "surface_point");
    fs::write(thin.join("map/legend.json"), legend.to_string()).unwrap();
    let path = folder.path().join("p.zip");
    adit().arg("package").arg(&thin).arg("--out").arg(&path).assert().success();
    let mut zip = zip::ZipArchive::new(File::open(path).unwrap()).unwrap();
    let mut drawn = Vec::new();
    zip.by_name("map/xyz.tif").unwrap().read_to_end(&mut drawn).unwrap();
    // From chart.ply the surface comes back to the last bit of its scan coordinates, which is not that of local ones.
    let (drawn, of_the_run) = (places(&drawn), places(&fs::read(run().join("map/xyz.tif")).unwrap()));
    assert_eq!(drawn.len(), of_the_run.len());
    for (a, b) in drawn.iter().zip(&of_the_run) {
        assert!((a - b).abs() < 1e-5 || (a.is_nan() && b.is_nan()), "{a} {b}");
    }
    let left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 2, "{left:?}");
}

fn check_with_python(modules: &str, check: &str) {
    let Some(interpreter) = common::python_with(modules) else { return };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/map_products.py");
    let output =
        Process::new(interpreter).arg(script).arg(check).arg(run()).arg(env!("CARGO_BIN_EXE_adit")).output().unwrap();
    let told = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{told}");
    eprintln!("{told}");
}

#[test]
fn tifffile_alone_leads_from_pixels_to_points() {
    check_with_python("numpy, tifffile", "way_back");
}

#[test]
fn gdal_puts_pixels_where_they_are() {
    check_with_python("numpy, rasterio", "gdal");
}

#[test]
fn geotiffs_are_cloud_optimized() {
    check_with_python("rio_cogeo", "cog");
}

#[test]
fn pictures_come_back_from_pillow() {
    check_with_python("numpy, PIL", "paint");
}
