//! Read, write, and let an independent reader compare: laspy, where a Python with it is present.
//!
//! `ADIT_TEST_PYTHON` names the Python (default `python3`); `ADIT_ROUND_TRIP_FOLDER` adds all LAS and LAZ files of a
//! folder and of the folders in it to those that are made here.

#![allow(clippy::print_stderr, reason = "a skipped check is told")]

mod common;

use adit::cloud::Cloud;
use adit::io::{self, PointColumns};
use std::path::{Path, PathBuf};
use std::process::Command;

/// What the script ends with when laspy does not read the source.
const LASPY_GIVES_UP: i32 = 3;

/// All records with the columns that a run appends.
fn rewrite(cloud: &Cloud, to: &Path) {
    let n = cloud.len();
    let labels: Vec<u32> = (0..n).map(|i| (i % 9) as u32).collect();
    let column = |step: f64| (0..n).map(|i| if i % 7 == 0 { f64::NAN } else { i as f64 * step }).collect::<Vec<f64>>();
    let (chainage, girth, offset) = (column(0.01), column(-0.001), column(0.0001));
    let columns =
        PointColumns { labels: &labels, chainage: &chainage, girth: &girth, offset: &offset, surface_classes: None };
    io::write_points(cloud, &columns, to).unwrap();
}

fn las_files(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(las_files(&path));
        } else if path.extension().is_some_and(|e| e == "las" || e == "laz") {
            files.push(path);
        }
    }
    files.sort();
    files
}

#[test]
fn laspy_finds_every_record_header_and_vlr_again() {
    let Some(python) = common::python_with("laspy, lazrs") else { return };
    let folder = tempfile::tempdir().unwrap();
    let text: String =
        (0..3000).map(|i| format!("{}.5 {} {} {} {} 7 9\n", i % 91, i % 13, i % 7, i % 999, i % 256)).collect();
    let made = folder.path().join("made.xyz");
    std::fs::write(&made, text).unwrap();
    let (cloud, _) = io::read_cloud(&[made], &io::Settings::default()).unwrap();
    for name in ["made.las", "made.laz"] {
        io::write_cloud(&cloud, None, &folder.path().join(name)).unwrap();
    }
    let mut files = las_files(folder.path());
    if let Ok(more) = std::env::var("ADIT_ROUND_TRIP_FOLDER") {
        files.extend(las_files(Path::new(&more)));
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/round_trip_laspy.py");
    let settings = io::Settings { unit: Some(io::Unit::Metre), ..Default::default() };
    let (mut failures, mut compared) = (Vec::new(), 0);
    for file in files {
        // Files without points make no cloud; that they are refused is tested elsewhere.
        let Ok((cloud, summary)) = io::read_cloud(std::slice::from_ref(&file), &settings) else {
            eprintln!("not read: {}", file.display());
            continue;
        };
        // What a header promises beyond the records that are there is not written again, and that is said.
        if summary.warnings.iter().any(|w| w.code == "las-variable-length-records") {
            eprintln!("not compared, its header promises too much: {}", file.display());
            continue;
        }
        for extension in ["las", "laz"] {
            let copy = folder.path().join(format!("copy.{extension}"));
            rewrite(&cloud, &copy);
            let done = Command::new(&python).arg(&script).args([&file, &copy]).output().unwrap();
            if done.status.code() == Some(LASPY_GIVES_UP) {
                eprintln!("not compared: {}: {}", file.display(), String::from_utf8_lossy(&done.stdout).trim());
                break;
            }
            compared += 1;
            if !done.status.success() {
                let said = String::from_utf8_lossy(if done.stdout.is_empty() { &done.stderr } else { &done.stdout });
                failures.push(format!("{} as {extension}: {}", file.display(), said.trim()));
            }
        }
    }
    assert!(compared >= 4, "only {compared} compared");
    assert!(failures.is_empty(), "{} of {compared}:\n{}", failures.len(), failures.join("\n"));
    eprintln!("{compared} copies compared by laspy");
}
