//! `report.html`: the report as one page that a surveyor understands, self-contained and readable offline.

use super::limits::number;
use super::picture::{base64, thumbnail};
use serde_json::Value;
use std::fmt::Write;
use std::path::Path;

const STYLE: &str = "\
:root{color-scheme:light dark;--line:#8884}
body{font:16px/1.5 system-ui,sans-serif;margin:0 auto;max-width:70rem;padding:1rem}
h1{font-size:1.5rem;margin:.5rem 0}h2{font-size:1.15rem;margin:2rem 0 .5rem;border-bottom:1px solid var(--line)}
.verdict{border-radius:.5rem;padding:1rem;color:#fff}.pass{background:#1b7f3b}.warn{background:#9a6700}.fail{background:#b3261e}
.pill{border-radius:1rem;padding:.1rem .6rem;color:#fff;font-size:.85rem}
table{border-collapse:collapse;width:100%}td,th{text-align:left;padding:.25rem .5rem;border-bottom:1px solid var(--line);vertical-align:top}
.scroll{overflow-x:auto}img,svg{max-width:100%;height:auto;background:#fff}
figure{margin:1rem 0}figcaption{font-size:.9rem;opacity:.8}.profiles{display:flex;flex-wrap:wrap;gap:1rem}.profiles svg{width:11rem}
code{overflow-wrap:anywhere}";

/// The page of a report; `folder` holds the pictures, `axis_csv` is the text of `axis.csv`.
pub(super) fn page(report: &Value, folder: &Path, axis_csv: &str) -> String {
    let text = |path: &str| escape(report.pointer(path).and_then(Value::as_str).unwrap_or("?"));
    let status = text("/status");
    let title = report
        .pointer("/input/0/path")
        .and_then(Value::as_str)
        .and_then(|p| Path::new(p).file_name())
        .map_or("scan".to_owned(), |n| escape(&n.to_string_lossy()));
    let mut html = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><title>{title}: {status}</title>\
         <style>{STYLE}</style></head><body>\n<h1>{title}</h1>\n"
    );
    let told = match status.as_str() {
        "pass" => "The map keeps to all limits.",
        "warn" => "The map can be used; something is worth a look.",
        _ => "A limit was broken: do not use this map before somebody has looked at it.",
    };
    let _ = write!(html, "<div class=\"verdict {status}\"><strong>{}</strong> {told}", status.to_uppercase());
    let broken = checks(report).filter(|c| c.get("status").and_then(Value::as_str) != Some("pass"));
    for check in broken {
        let _ = write!(html, "<br>{}", escape(check.get("message").and_then(Value::as_str).unwrap_or("")));
    }
    html.push_str("</div>\n");
    figure(&mut html, folder, "map/map.png", "Overview: chainage to the right, crown in the centre, seen from inside.");
    facts(&mut html, report);
    limits(&mut html, report);
    html.push_str("<h2>Where the map is good</h2>\n");
    figure(&mut html, folder, "map/coverage.png", "Coverage: observed, filled, and no surface.");
    figure(&mut html, folder, "map/distortion.png", "Distortion: greatest stretch between surface and map.");
    drawing(&mut html, folder, "map/distortion_histogram.svg", "Length factors of the map, by share of the surface.");
    quantiles(&mut html, report);
    figure(&mut html, folder, "map/offset.png", "Distance from the local mean section: rock towards the void is red.");
    profiles(&mut html, report);
    alignment(&mut html, axis_csv);
    warnings(&mut html, report);
    provenance(&mut html, report);
    html.push_str("</body></html>\n");
    html
}

/// The limits, without the one that differs from run to run.
fn checks(report: &Value) -> impl Iterator<Item = &Value> {
    let all = report.get("limits").and_then(Value::as_array).into_iter().flatten();
    all.filter(|c| c.get("name").and_then(Value::as_str) != Some("duration_s"))
}

fn figure(html: &mut String, folder: &Path, name: &str, caption: &str) {
    if let Some(png) = thumbnail(&folder.join(name), 1600) {
        let alternative = escape(caption);
        let _ = writeln!(
            html,
            "<figure><img alt=\"{alternative}\" src=\"data:image/png;base64,{}\"><figcaption>{alternative}</figcaption></figure>",
            base64(&png)
        );
    }
}

/// A drawing that is text: part of the page as it is, but for the name of its language, which is an address.
fn drawing(html: &mut String, folder: &Path, name: &str, caption: &str) {
    if let Ok(svg) = std::fs::read_to_string(folder.join(name)) {
        let svg = svg.replace(" xmlns=\"http://www.w3.org/2000/svg\"", "");
        let _ = writeln!(html, "<figure>{}<figcaption>{}</figcaption></figure>", svg.trim_end(), escape(caption));
    }
}

fn facts(html: &mut String, report: &Value) {
    html.push_str("<h2>What was measured</h2>\n<div class=\"scroll\"><table>\n");
    let rows: [(&str, &str, &str); 13] = [
        ("Points read", "/ingest/points", ""),
        ("Length of the axis", "/axis/length_m", "m"),
        ("Chainage at the start", "/axis/start_chainage_m", "m"),
        ("Chainage at the end", "/axis/end_chainage_m", "m"),
        ("Mean perimeter", "/segment/mean_perimeter_m", "m"),
        ("Least radius of the bend", "/axis/least_bend_radius_m", "m"),
        ("Surface", "/mesh/area_m2", "m\u{b2}"),
        ("Triangles", "/mesh/faces", ""),
        ("Pixel", "/map/cell_m", "m"),
        ("Observed share of the map", "/map/coverage_percent", "%"),
        ("Mean stretch", "/unwrap/stretch/mean", ""),
        ("Way to the map and back, 99 %", "/roundtrip/p99_m", "m"),
        ("Points farther from the surface than allowed", "/anchor/unanchored", ""),
    ];
    for (name, path, unit) in rows {
        if let Some(value) = report.pointer(path).and_then(Value::as_f64) {
            let _ = writeln!(html, "<tr><td>{name}</td><td>{} {unit}</td></tr>", number(value));
        }
    }
    html.push_str("</table></div>\n");
}

fn limits(html: &mut String, report: &Value) {
    html.push_str("<h2>Limits</h2>\n<div class=\"scroll\"><table><tr><th></th><th>Measured</th><th>Warns</th><th>Fails</th></tr>\n");
    for check in checks(report) {
        let text = |key: &str| escape(check.get(key).and_then(Value::as_str).unwrap_or(""));
        let level = |key: &str| check.get(key).and_then(Value::as_f64).map_or("\u{2013}".to_owned(), number);
        let _ = writeln!(
            html,
            "<tr><td><span class=\"pill {0}\">{0}</span></td><td>{1}<br><code>{2}</code></td><td>{3}</td><td>{4}</td></tr>",
            text("status"),
            text("message"),
            text("name"),
            level("warn"),
            level("fail")
        );
    }
    html.push_str("</table></div>\n");
}

/// Quantiles of the stretch as bars: what share of the area is stretched how much.
fn quantiles(html: &mut String, report: &Value) {
    let value = |name: &str| report.pointer(&format!("/unwrap/stretch/{name}")).and_then(Value::as_f64);
    let bars: Vec<(&str, f64)> = [("5 %", "p05"), ("half", "p50"), ("95 %", "p95"), ("99 %", "p99")]
        .into_iter()
        .filter_map(|(label, name)| Some((label, value(name)?)))
        .collect();
    let Some(most) = bars.iter().map(|b| (b.1 - 1.0).max(1e-6)).reduce(f64::max) else { return };
    html.push_str("<figure><svg viewBox=\"0 0 600 130\" role=\"img\" font-family=\"sans-serif\" font-size=\"13\">");
    for (i, (label, value)) in bars.iter().enumerate() {
        let (y, length) = (10 + 30 * i, ((value - 1.0).max(0.0) / most).min(1.0) * 380.0);
        let _ = write!(
            html,
            "<text x=\"0\" y=\"{}\">{label} of the area</text><rect x=\"120\" y=\"{y}\" width=\"{length:.1}\" height=\"20\" fill=\"#c2571a\"/>\
             <text x=\"{:.1}\" y=\"{}\">{} %</text>",
            y + 15,
            126.0 + length,
            y + 15,
            number(((value - 1.0) * 1e4).round() / 100.0)
        );
    }
    html.push_str("</svg><figcaption>Stretch or squeeze that a share of the area keeps to.</figcaption></figure>\n");
}

/// Mean sections at some chainages, as `mesh.profiles` of the report gives them: radii in metres around the axis,
/// from the invert over the left wall, the crown and the right wall.
fn profiles(html: &mut String, report: &Value) {
    let Some(list) = report.pointer("/mesh/profiles").and_then(Value::as_array) else { return };
    html.push_str("<h2>Mean sections</h2>\n<div class=\"profiles\">");
    let radii = |p: &Value| -> Vec<f64> {
        p.get("radii_m").and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_f64).collect()
    };
    let most = list.iter().flat_map(radii).fold(0.1, f64::max);
    for profile in list {
        let radii = radii(profile);
        let mut points = String::new();
        for (i, r) in radii.iter().enumerate() {
            let angle = std::f64::consts::TAU * i as f64 / radii.len() as f64 - std::f64::consts::PI;
            let _ = write!(
                points,
                "{:.2},{:.2} ",
                100.0 + 90.0 * r / most * angle.sin(),
                100.0 - 90.0 * r / most * angle.cos()
            );
        }
        let chainage = profile.get("chainage_m").and_then(Value::as_f64).unwrap_or(0.0);
        let _ = write!(
            html,
            "<figure><svg viewBox=\"0 0 200 200\"><polygon points=\"{points}\" fill=\"none\" stroke=\"#333\" stroke-width=\"1.5\"/>\
             <circle cx=\"100\" cy=\"100\" r=\"2\" fill=\"#b3261e\"/></svg><figcaption>Chainage {}</figcaption></figure>",
            number(chainage)
        );
    }
    html.push_str("</div>\n");
}

fn alignment(html: &mut String, axis_csv: &str) {
    let rows: Vec<Vec<f64>> =
        axis_csv.lines().skip(1).filter_map(|l| l.split(',').map(|v| v.parse().ok()).collect()).collect();
    if rows.len() < 2 || rows[0].len() < 4 {
        return;
    }
    html.push_str("<h2>Axis</h2>\n");
    let plan: Vec<(f64, f64)> = rows.iter().map(|r| (r[1], r[2])).collect();
    let section: Vec<(f64, f64)> = rows.iter().map(|r| (r[0], r[3])).collect();
    curve(html, &plan, true, "Plan, north up.");
    curve(html, &section, false, "Long section: height over chainage (heights exaggerated).");
}

fn curve(html: &mut String, points: &[(f64, f64)], same_scale: bool, caption: &str) {
    let range = |f: &dyn Fn(&(f64, f64)) -> f64| {
        points.iter().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(f(p)), h.max(f(p))))
    };
    let ((x0, x1), (y0, y1)) = (range(&|p| p.0), range(&|p| p.1));
    let (width, height) = (760.0, 200.0);
    let (mut sx, mut sy) = (width / (x1 - x0).max(1e-3), height / (y1 - y0).max(0.1));
    if same_scale {
        sx = sx.min(sy);
        sy = sx;
    }
    let mut line = String::new();
    for (x, y) in points {
        let _ = write!(line, "{:.1},{:.1} ", 20.0 + (x - x0) * sx, 10.0 + height - (y - y0) * sy);
    }
    let _ = writeln!(
        html,
        "<figure><svg viewBox=\"0 0 800 240\" font-family=\"sans-serif\" font-size=\"13\"><polyline points=\"{line}\" fill=\"none\" \
         stroke=\"#1a5fb4\" stroke-width=\"2\"/><text x=\"20\" y=\"235\">{} to {} m / {} to {} m</text></svg><figcaption>{caption}</figcaption></figure>",
        number(x0),
        number(x1),
        number(y0),
        number(y1)
    );
}

fn warnings(html: &mut String, report: &Value) {
    let list: Vec<&Value> = report.get("warnings").and_then(Value::as_array).into_iter().flatten().collect();
    if list.is_empty() {
        return;
    }
    html.push_str("<h2>What the stages say</h2>\n<ul>\n");
    for warning in list {
        let text = |key: &str| escape(warning.get(key).and_then(Value::as_str).unwrap_or(""));
        let _ = writeln!(html, "<li><strong>{}</strong>: {}</li>", text("stage"), text("message"));
    }
    html.push_str("</ul>\n");
}

fn provenance(html: &mut String, report: &Value) {
    html.push_str("<h2>Where it comes from</h2>\n<div class=\"scroll\"><table>\n");
    for input in report.get("input").and_then(Value::as_array).into_iter().flatten() {
        let text = |key: &str| escape(input.get(key).and_then(Value::as_str).unwrap_or(""));
        let bytes = input.get("bytes").and_then(Value::as_f64).unwrap_or(0.0);
        let _ = writeln!(
            html,
            "<tr><td>Input</td><td><code>{}</code><br>{} bytes, SHA-256 <code>{}</code></td></tr>",
            text("path"),
            number(bytes),
            text("sha256")
        );
    }
    let version = escape(report.get("adit_version").and_then(Value::as_str).unwrap_or(""));
    let _ = writeln!(html, "<tr><td>Adit</td><td>{version}</td></tr>");
    // Timings are left to report.json: this page is a product, and products have the same bytes on every run.
    html.push_str("<tr><td>Timings, peak memory</td><td>in <code>report.json</code></td></tr>\n");
    let settings = report.get("pipeline").map(|p| serde_json::to_string_pretty(p).unwrap_or_default());
    let _ = writeln!(
        html,
        "</table></div>\n<details><summary>All settings</summary><pre>{}</pre></details>",
        escape(&settings.unwrap_or_default())
    );
}

/// Text for HTML.
pub(super) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_page_tells_the_verdict_and_asks_nobody() {
        let folder = tempfile::tempdir().unwrap();
        let report = json!({
            "status": "fail", "input": [{ "path": "/x/<drift>.laz", "sha256": "ab", "bytes": 3 }],
            "limits": [{ "name": "flipped_faces", "status": "fail", "message": "7 faces & more", "fail": 0.0 }],
            "mesh": { "profiles": [{ "chainage_m": 5.0, "radii_m": [1.0, 1.0, 1.0, 1.0] }] },
        });
        let csv = "chainage_m,x,y,z,azimuth_deg,gradient_percent\n0,0,0,0,90,0\n1,1,0,0.1,90,10\n";
        let html = page(&report, folder.path(), csv);
        assert!(html.contains("FAIL") && html.contains("7 faces &amp; more") && html.contains("&lt;drift&gt;.laz"));
        assert!(html.contains("<polygon") && html.contains("<polyline"));
        assert!(!html.contains("http") && !html.contains("<script"), "the page must not need anybody else");
    }
}
