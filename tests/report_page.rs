//! `report.html` and `index.html` in a real browser, where there is one: nothing from outside, readable on phone and desktop.

#![allow(clippy::print_stderr, reason = "a skipped check is told")]

use assert_cmd::cargo::cargo_bin;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Widths of a phone and of a desktop window, in pixels.
const WIDTHS: [u32; 2] = [390, 1280];

fn browser() -> Option<PathBuf> {
    let folders = std::env::var_os("PATH")?;
    let names = ["chromium", "chromium-browser", "google-chrome"];
    std::env::split_paths(&folders).flat_map(|f| names.map(|n| f.join(n))).find(|p| p.is_file())
}

/// What the browser makes of a page that shows `page` in a frame of some width and writes down what it measures there.
fn measured(browser: &Path, page: &Path, width: u32) -> serde_json::Value {
    let frame = page.with_file_name(format!("frame-{width}.html"));
    let name = page.file_name().unwrap().to_str().unwrap();
    let script = "
        const inside = document.getElementById('page');
        inside.onload = () => {
            const d = inside.contentDocument, w = inside.contentWindow;
            const pictures = [...d.images];
            const asked = w.performance.getEntriesByType('resource').map(e => e.name).filter(n => !n.startsWith('data:'));
            const small = [...d.querySelectorAll('p,td,th,figcaption,li')].filter(e => parseFloat(w.getComputedStyle(e).fontSize) < 13);
            const text = [...d.querySelectorAll('svg text')].map(e => 11 * e.closest('svg').getBoundingClientRect().width / e.closest('svg').viewBox.baseVal.width);
            document.title = JSON.stringify({
                width: d.documentElement.scrollWidth, asked, small: small.length, pictures: pictures.length,
                unread: pictures.filter(p => !p.complete || p.naturalWidth == 0).length, least_svg_text_px: Math.min(...text, 99),
                plots: d.querySelectorAll('svg').length, verdict: d.querySelector('.verdict')?.getBoundingClientRect().top ?? -1,
            });
        };";
    let html = format!(
        "<!doctype html><body style='margin:0'><iframe id=page src='{name}' style='border:0;width:{width}px;height:800px'></iframe>\
         <script>{script}</script>"
    );
    fs::write(&frame, html).unwrap();
    let output = Command::new(browser)
        .args([
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--allow-file-access-from-files",
            "--virtual-time-budget=20000",
        ])
        .args(["--host-resolver-rules=MAP * ~NOTFOUND", "--dump-dom"])
        .arg(format!("--user-data-dir={}", page.with_file_name("browser").display()))
        .arg(format!("file://{}", frame.display()))
        .output()
        .unwrap();
    let dom = String::from_utf8_lossy(&output.stdout).into_owned();
    let title = dom.split("<title>").nth(1).and_then(|t| t.split("</title>").next()).unwrap_or_else(|| panic!("{dom}"));
    serde_json::from_str(&title.replace("&quot;", "\"").replace("&amp;", "&"))
        .unwrap_or_else(|e| panic!("{e}: {title}"))
}

#[test]
fn the_pages_are_readable_on_a_phone_and_ask_nobody() {
    let Some(browser) = browser() else {
        // Said by the test itself: there is nothing to look with.
        eprintln!("SKIPPED: no browser on this machine, the pages are not looked at");
        return;
    };
    let place = tempfile::tempdir().unwrap();
    let (runs, mut scans) = (place.path().join("runs"), Vec::new());
    for day in ["2026-11-23", "2026-11-24"] {
        let scan = place.path().join(format!("drift_{day}.laz"));
        let made = Command::new(cargo_bin("adit"))
            .args(["synth", "--length", "8", "--points", "20000", "--furniture", "none", "--seed", &day[8..], "--out"])
            .arg(&scan)
            .status();
        assert!(made.unwrap().success());
        scans.push(scan);
    }
    // A limit that this map breaks, so that the offending metre is shown.
    let night = Command::new(cargo_bin("adit"))
        .arg("batch")
        .args(&scans)
        .args(["--quiet", "--set", "map.cell_m=0.04", "--set", "limits.coverage_percent={ warn = 99.9 }", "--out"])
        .arg(&runs)
        .status();
    assert!(matches!(night.unwrap().code(), Some(0 | 5)));
    let last = fs::read_to_string(runs.join("latest.txt")).unwrap_or_else(|_| {
        let ledger: serde_json::Value = serde_json::from_slice(&fs::read(runs.join("runs.json")).unwrap()).unwrap();
        ledger[1]["run"].as_str().unwrap().to_owned()
    });
    let page = runs.join(last.trim()).join("report.html");
    assert!(fs::read_to_string(&page).unwrap().contains("class=\"metre\""), "the offending metre is not shown");
    for width in WIDTHS {
        let seen = measured(&browser, &page, width);
        assert_eq!(
            (&seen["asked"], &seen["unread"], &seen["small"]),
            (&serde_json::json!([]), &0.into(), &0.into()),
            "{seen}"
        );
        assert!(seen["width"].as_u64().unwrap() <= u64::from(width), "{width}: sideways scrolling, {seen}");
        assert!(seen["pictures"].as_u64().unwrap() >= 5 && seen["plots"].as_u64().unwrap() >= 13, "{width}: {seen}");
        assert!(seen["least_svg_text_px"].as_f64().unwrap() >= 9.0, "{width}: {seen}");
        assert!(
            (0.0..200.0).contains(&seen["verdict"].as_f64().unwrap()),
            "{width}: the verdict is not on top, {seen}"
        );
        let index = measured(&browser, &runs.join("index.html"), width);
        assert!(
            index["width"].as_u64().unwrap() <= u64::from(width) && index["asked"] == serde_json::json!([]),
            "{index}"
        );
        assert!(index["plots"].as_u64().unwrap() >= 4, "{index}");
    }
}
