//! Golden pictures: what the real program draws of a small synthetic drift looks as it did when a person last looked.
//!
//! Assertions in `end_to_end.rs` prove what can be told in numbers; these pictures guard what cannot: colours, hatching,
//! ticks, lettering. They are stored small (at most 20 KiB each) and compared with a tolerance, because the last bit of
//! a sine may differ between machines.
//!
//! After a wanted change: `ADIT_UPDATE_GOLDEN=1 cargo test --test golden`, look at the pictures, commit them. A failure
//! writes `target/golden/index.html` with golden, new and difference side by side.

use assert_cmd::Command;
use image::{Rgb, RgbImage, RgbaImage, imageops};
use std::fs;
use std::path::{Path, PathBuf};

/// The pictures of a run, and how many times smaller they are kept.
const PICTURES: [(&str, u32); 5] = [("map", 5), ("color", 3), ("labels", 1), ("coverage", 1), ("offset", 3)];
/// A pixel whose brightest difference exceeds this has changed ...
const CHANGED: u8 = 40;
/// ... and so many may: rims and the edges of thin lines move by a pixel when a coordinate rounds the other way.
const CHANGED_SHARE: f64 = 0.01;
/// Mean difference of all pixels, of 255.
const MEAN_DIFFERENCE: f64 = 1.5;
/// A stored picture must not be larger.
const LARGEST_BYTES: u64 = 20 * 1024;

fn adit(arguments: &[&str]) {
    let output = Command::cargo_bin("adit").unwrap().args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

/// The picture over white, `times` smaller.
fn small(picture: &RgbaImage, times: u32) -> RgbImage {
    let mut over_white = RgbImage::new(picture.width(), picture.height());
    for (to, from) in over_white.pixels_mut().zip(picture.pixels()) {
        let [r, g, b, a] = from.0.map(u32::from);
        *to = Rgb([r, g, b].map(|c| ((c * a + 255 * (255 - a)) / 255) as u8));
    }
    let (width, height) = (picture.width().div_ceil(times), picture.height().div_ceil(times));
    let mut small = imageops::resize(&over_white, width, height, imageops::FilterType::Triangle);
    // Sixteen levels a channel keep the files small and hide what no eye would see.
    small.pixels_mut().for_each(|p| p.0 = p.0.map(|c| (c / 17).saturating_mul(17)));
    small
}

/// Largest difference of a channel.
fn difference(a: &Rgb<u8>, b: &Rgb<u8>) -> u8 {
    (0..3).map(|i| a.0[i].abs_diff(b.0[i])).max().unwrap()
}

/// What is wrong with `new`, in words, and the picture of the differences.
fn compare(golden: &RgbImage, new: &RgbImage) -> Option<(String, RgbImage)> {
    let mut picture = RgbImage::from_pixel(new.width(), new.height(), Rgb([255, 255, 255]));
    if golden.dimensions() != new.dimensions() {
        return Some((format!("is {:?} pixels, was {:?}", new.dimensions(), golden.dimensions()), picture));
    }
    let (mut changed, mut sum) = (0usize, 0.0);
    for (to, (a, b)) in picture.pixels_mut().zip(golden.pixels().zip(new.pixels())) {
        let d = difference(a, b);
        changed += usize::from(d > CHANGED);
        sum += f64::from(d);
        *to = Rgb([255, 255 - d, 255 - d]);
    }
    let pixels = f64::from(new.width() * new.height());
    let (share, mean) = (changed as f64 / pixels, sum / pixels);
    (share > CHANGED_SHARE || mean > MEAN_DIFFERENCE)
        .then(|| (format!("{:.2} % of the pixels changed, mean difference {mean:.2} of 255", 100.0 * share), picture))
}

#[test]
fn the_pictures_look_as_when_a_person_last_looked() {
    let temporary = tempfile::tempdir().unwrap();
    let (scan, run) = (temporary.path().join("drift.laz"), temporary.path().join("run"));
    let text = |p: &Path| p.to_str().unwrap().to_owned();
    adit(&[
        "synth",
        "--out",
        &text(&scan),
        "--length",
        "8",
        "--points",
        "60000",
        "--roughness",
        "0.02",
        "--furniture",
        "none",
        "--quiet",
    ]);
    adit(&["run", "--input", &text(&scan), "--out", &text(&run), "--set", "map.cell_m=0.05", "--quiet"]);

    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    let update = std::env::var_os("ADIT_UPDATE_GOLDEN").is_some();
    let mut complaints = Vec::new();
    let mut page = String::from("<title>Golden pictures</title><table><tr><th>golden<th>new<th>difference</tr>\n");
    let shown = Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("golden");
    for (name, times) in PICTURES {
        let new = small(&image::open(run.join(format!("map/{name}.png"))).unwrap().into_rgba8(), times);
        let stored = folder.join(format!("{name}.png"));
        if update {
            fs::create_dir_all(&folder).unwrap();
            new.save(&stored).unwrap();
        }
        let bytes = fs::metadata(&stored).unwrap_or_else(|e| panic!("{}: {e}", stored.display())).len();
        assert!(bytes <= LARGEST_BYTES, "{} has {bytes} bytes", stored.display());
        let golden = image::open(&stored).unwrap().into_rgb8();
        if let Some((what, differences)) = compare(&golden, &new) {
            complaints.push(format!("{name}.png: {what}"));
            fs::create_dir_all(&shown).unwrap();
            page += "<tr>";
            for (kind, picture) in [("golden", &golden), ("new", &new), ("difference", &differences)] {
                let file = format!("{name}_{kind}.png");
                picture.save(shown.join(&file)).unwrap();
                page += &format!("<td><img src=\"{file}\" alt=\"{name} {kind}\">");
            }
            page += &format!("<tr><td colspan=3>{name}: {what}\n");
        }
    }
    if !complaints.is_empty() {
        fs::write(shown.join("index.html"), page + "</table>\n").unwrap();
        panic!("{}; look at {}", complaints.join("; "), shown.join("index.html").display());
    }
}

#[test]
fn a_moved_picture_is_noticed() {
    let golden = RgbImage::from_fn(60, 40, |x, y| if (x / 10 + y / 10) % 2 == 0 { Rgb([0; 3]) } else { Rgb([255; 3]) });
    let moved = RgbImage::from_fn(60, 40, |x, y| *golden.get_pixel((x + 1) % 60, y));
    assert!(compare(&golden, &golden).is_none());
    assert!(compare(&golden, &moved).is_some());
    assert!(compare(&golden, &RgbImage::new(60, 41)).is_some());
}
