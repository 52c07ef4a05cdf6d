//! `report.html`: the report as one page that a surveyor understands, self-contained and readable offline.

use super::limits::number;
use super::picture::{base64, thumbnail, upright_piece};
use super::plots::{self, Plot};
use rayon::prelude::*;
use serde_json::Value;
use std::fmt::Write;
use std::path::Path;

const STYLE: &str = "\
:root{color-scheme:light dark;--line:#8884}
body{font:16px/1.5 system-ui,sans-serif;margin:0 auto;max-width:72rem;padding:1rem}
h1{font-size:1.5rem;margin:.5rem 0;overflow-wrap:anywhere}h2{font-size:1.15rem;margin:2rem 0 .5rem;border-bottom:1px solid var(--line)}
.verdict{border-radius:.5rem;padding:1rem;color:#fff}.pass{background:#1b7f3b}.warn{background:#8a5a00}.fail{background:#b3261e}.skipped{background:#5f6368}
.pill{border-radius:1rem;padding:.1rem .6rem;color:#fff;font-size:.85rem;white-space:nowrap}
table{border-collapse:collapse;width:100%}td,th{text-align:left;padding:.3rem .5rem;border-bottom:1px solid var(--line);vertical-align:top}
.scroll{overflow-x:auto}.drawing{min-width:42rem}img,svg{max-width:100%;height:auto;display:block}svg{width:100%}img.long{max-width:none;width:60rem}
figure{margin:.75rem 0}figcaption{font-size:.9rem;opacity:.85}
.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,21rem),1fr));gap:0 1.5rem}
.sections{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(46%,10rem),1fr));gap:0 1rem}
img.metre{height:22rem;width:auto;image-rendering:pixelated;background:#fff;border:1px solid var(--line)}
code,pre{overflow-wrap:anywhere;white-space:pre-wrap}";

/// Colours of the plots: what was measured, what warns, what fails.
const BLUE: &str = "#1a5fb4";
const AMBER: &str = "#c77700";
const RED: &str = "#b3261e";

/// Limits on the effort of a run: of these the page tells the level and the status, and what was measured only when a limit is
/// broken, so that the same scan gives the same bytes.
const EFFORT: [&str; 3] = ["duration_s", "peak_memory_bytes", "drift.duration_growth_percent"];

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
    for check in checks(report).filter(|c| is_broken(c)) {
        let _ = write!(html, "<br>{}", escape(text_of(check, "message")));
    }
    html.push_str("</div>\n");
    // Reading a large picture takes a second: all of them at once.
    let thumbnails: Vec<Option<Vec<u8>>> =
        FIGURES.par_iter().map(|(name, _)| thumbnail(&folder.join(name), 1600)).collect();
    let figures: Vec<String> =
        FIGURES.iter().zip(&thumbnails).map(|((_, caption), png)| figure(png.as_deref(), caption)).collect();
    let [overview, coverage, distortion, offset] = [0, 1, 2, 3].map(|k| figures[k].as_str());
    html.push_str(overview);
    limits(&mut html, report, folder);
    facts(&mut html, report);
    borders(&mut html, report);
    html.push_str("<h2>Where the map is good</h2>\n");
    html.push_str(coverage);
    html.push_str(distortion);
    drawing(&mut html, folder, "map/distortion_histogram.svg", "Length factors of the map, by share of the surface.");
    html.push_str(offset);
    along(&mut html, report);
    histograms(&mut html, report);
    sections(&mut html, report);
    alignment(&mut html, axis_csv);
    previous(&mut html, report);
    warnings(&mut html, report);
    provenance(&mut html, report);
    effort(&mut html, report);
    html.push_str("</body></html>\n");
    html
}

fn checks(report: &Value) -> impl Iterator<Item = &Value> {
    report.get("limits").and_then(Value::as_array).into_iter().flatten()
}

fn text_of<'a>(value: &'a Value, key: &str) -> &'a str {
    value.get(key).and_then(Value::as_str).unwrap_or("")
}

fn is_broken(check: &Value) -> bool {
    matches!(text_of(check, "status"), "warn" | "fail")
}

fn is_effort(check: &Value) -> bool {
    EFFORT.contains(&text_of(check, "name"))
}

/// The pictures of the page and what is written below them.
const FIGURES: [(&str, &str); 4] = [
    (
        "map/map.png",
        "Overview: chainage to the right, crown in the centre, seen from inside facing increasing chainage.",
    ),
    ("map/coverage.png", "Coverage: green is observed, orange filled, empty no surface."),
    ("map/distortion.png", "Distortion: the darker or warmer, the more the map stretches."),
    ("map/offset.png", "Distance from the local mean section: rock towards the void is red."),
];

/// A picture with its caption; nothing without a picture.
fn figure(png: Option<&[u8]>, caption: &str) -> String {
    let Some(png) = png else { return String::new() };
    let side = |at: usize| png.get(at..at + 4).map_or(1, |b| u32::from_be_bytes([b[0], b[1], b[2], b[3]]));
    // A long tunnel is scrolled sideways instead of being squeezed into a line.
    let class = if side(16) > 4 * side(20) { " class=\"long\"" } else { "" };
    let alternative = escape(caption);
    format!(
        "<figure><div class=\"scroll\"><img{class} alt=\"{alternative}\" src=\"data:image/png;base64,{}\"></div>\
         <figcaption>{alternative}</figcaption></figure>\n",
        base64(png)
    )
}

/// A drawing that is text: part of the page as it is, but for the name of its language, which is an address.
fn drawing(html: &mut String, folder: &Path, name: &str, caption: &str) {
    if let Ok(svg) = std::fs::read_to_string(folder.join(name)) {
        let svg = svg.replace(" xmlns=\"http://www.w3.org/2000/svg\"", "");
        let _ = writeln!(
            html,
            "<figure><div class=\"scroll\"><div class=\"drawing\">{}</div></div><figcaption>{}</figcaption></figure>",
            svg.trim_end(),
            escape(caption)
        );
    }
}

fn facts(html: &mut String, report: &Value) {
    html.push_str("<h2>What was measured</h2>\n<div class=\"scroll\"><table>\n");
    let rows: [(&str, &str, &str); 15] = [
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
        ("Points on a square metre, 95 % of the tunnel", "/profile/density_p05_per_m2", ""),
        ("Scatter of the points about the surface", "/profile/noise_whole_m", "m"),
    ];
    for (name, path, unit) in rows {
        if let Some(value) = report.pointer(path).and_then(Value::as_f64) {
            let _ = writeln!(html, "<tr><td>{name}</td><td>{} {unit}</td></tr>", number(value));
        }
    }
    html.push_str("</table></div>\n");
}

/// Where the surface ends, and why: portals, side openings, scan shadows.
fn borders(html: &mut String, report: &Value) {
    let Some(borders) = report.pointer("/mesh/borders") else { return };
    let count = |key: &str| borders.get(key).and_then(Value::as_u64).unwrap_or(0);
    let _ = writeln!(
        html,
        "<h2>Where the surface ends</h2>\n<p>{} of {} expected borders around the axis (portals, or ends of the scan), {} open \
         edge(s), {} side opening(s), {} hole(s). The longest borders:</p>\n<div class=\"scroll\"><table><tr><th>Border</th>\
         <th>Chainage</th><th>Side</th><th>Along</th><th>Around</th><th>Length</th></tr>",
        count("portals"),
        count("portals_expected"),
        count("open_edges"),
        count("side_openings"),
        count("holes")
    );
    for border in borders.get("longest").and_then(Value::as_array).into_iter().flatten() {
        let metres = |pointer: &str| {
            let value = border.pointer(pointer).and_then(Value::as_f64).unwrap_or(0.0);
            format!("<td>{} m</td>", number((value * 100.0).round() / 100.0))
        };
        let _ = writeln!(
            html,
            "<tr><td>{}</td>{}<td>{}</td>{}{}{}</tr>",
            escape(&text_of(border, "kind").replace('-', " ")),
            metres("/chainage_m"),
            escape(text_of(border, "side")),
            metres("/width_m/0"),
            metres("/width_m/1"),
            metres("/length_m")
        );
    }
    html.push_str("</table></div>\n");
}

fn limits(html: &mut String, report: &Value, folder: &Path) {
    html.push_str("<h2>Limits</h2>\n<div class=\"scroll\"><table><tr><th></th><th>Measured</th><th>Warns</th><th>Fails</th></tr>\n");
    let is_judged = |c: &&Value| text_of(c, "status") != "skipped";
    for check in checks(report).filter(|c| !is_effort(c)).filter(is_judged) {
        limit_row(html, check);
        if is_broken(check)
            && let Some((picture, layer)) = offending_metre(check, folder)
        {
            let chainage = check.get("worst_chainage_m").and_then(Value::as_f64).unwrap_or(0.0);
            let _ = writeln!(
                html,
                "<tr><td></td><td colspan=\"3\"><figure><img class=\"metre\" alt=\"the metre that is worst\" \
                 src=\"data:image/png;base64,{}\"><figcaption>Worst around chainage {}: the layer {layer} from {} to {} m, right \
                 wall on top.</figcaption></figure></td></tr>",
                base64(&picture),
                number(chainage),
                number(chainage - HALF_WINDOW_M),
                number(chainage + HALF_WINDOW_M)
            );
        }
    }
    html.push_str("</table></div>\n");
    let skipped: Vec<&Value> = checks(report).filter(|c| !is_effort(c) && !is_judged(c)).collect();
    if !skipped.is_empty() {
        let _ = writeln!(
            html,
            "<details><summary>{} limits were not judged: no level is set, or there was nothing to measure</summary>\
             <div class=\"scroll\"><table>",
            skipped.len()
        );
        skipped.into_iter().for_each(|check| limit_row(html, check));
        html.push_str("</table></div></details>\n");
    }
}

fn limit_row(html: &mut String, check: &Value) {
    let text = |key: &str| escape(text_of(check, key));
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

/// Half of the piece of the map that is shown around the worst metre, metres.
const HALF_WINDOW_M: f64 = 1.5;

/// The piece of the map around the worst metre of a limit, and the layer it is from.
fn offending_metre(check: &Value, folder: &Path) -> Option<(Vec<u8>, &'static str)> {
    let chainage = check.get("worst_chainage_m").and_then(Value::as_f64)?;
    let layers: &[&str] = match text_of(check, "name") {
        "coverage_percent" | "filled_percent" => &["coverage", "color"],
        "distortion_p95_percent" | "flipped_faces" => &["distortion", "coverage"],
        "noise_m" => &["offset", "color"],
        _ => &["color", "intensity", "relief", "coverage"],
    };
    layers.iter().find_map(|layer| {
        let picture = folder.join(format!("map/{layer}.png"));
        let world = std::fs::read_to_string(picture.with_extension("pgw")).ok()?;
        let numbers: Vec<f64> = world.lines().filter_map(|l| l.trim().parse().ok()).collect();
        let (cell, first) = (*numbers.first()?, *numbers.get(4)?);
        let column = |u: f64| ((u - first) / cell + 0.5).max(0.0) as usize;
        let piece = upright_piece(&picture, column(chainage - HALF_WINDOW_M), column(chainage + HALF_WINDOW_M), 600)?;
        Some((piece, *layer))
    })
}

/// What the pieces of the tunnel are like, one plot for each number, with the levels of its limit.
fn along(html: &mut String, report: &Value) {
    let Some(profile) = report.get("profile") else { return };
    let numbers = |key: &str| -> Vec<Option<f64>> {
        profile.get(key).and_then(Value::as_array).into_iter().flatten().map(Value::as_f64).collect()
    };
    let chainages: Vec<f64> = numbers("chainage_m").into_iter().flatten().collect();
    let step = profile.get("step_m").and_then(Value::as_f64).unwrap_or(1.0);
    let Some((&first, &last)) = chainages.first().zip(chainages.last()) else { return };
    html.push_str("<h2>Along the tunnel</h2>\n<div class=\"plots\">\n");
    // Name of the column, caption, name of the limit, and how the value is shown.
    type Row<'a> = (&'a str, &'a str, &'a str, &'a dyn Fn(f64) -> f64);
    let rows: [Row; 5] = [
        ("coverage_percent", "Coverage, %", "coverage_percent", &|v| v),
        ("stretch_p95", "Stretch that 95 % keep to, %", "", &|v| (v - 1.0) * 100.0),
        ("density_per_m2", "Points on a square metre", "density_per_m2", &|v| v),
        ("noise_m", "Scatter about the surface, mm", "noise_m", &|v| v * 1000.0),
        ("filled_percent", "Filled surface, %", "filled_percent", &|v| v),
    ];
    for (key, title, limit, shown) in rows {
        let values: Vec<(f64, Option<f64>)> = chainages
            .iter()
            .zip(numbers(key))
            .flat_map(|(c, v)| [(*c, v.map(shown)), (*c + step, v.map(shown))])
            .collect();
        let known = values.iter().filter_map(|v| v.1);
        let Some((low, high)) =
            known.fold(None, |r: Option<(f64, f64)>, v| Some(r.map_or((v, v), |(l, h)| (l.min(v), h.max(v)))))
        else {
            continue;
        };
        let check = checks(report).find(|c| text_of(c, "name") == limit);
        let level = |key: &str| check.and_then(|c| c.get(key)?.as_f64()).map(shown);
        let margin = ((high - low) * 0.08).max(high.abs() * 0.01).max(1e-6);
        let bottom = if low >= 0.0 { (low - margin).max(0.0) } else { low - margin };
        let mut plot = Plot::new((first, last + step), (bottom, high + margin), "chainage, m", title);
        for (key, color) in [("warn", AMBER), ("fail", RED)] {
            level(key).into_iter().for_each(|l| plot.level(l, color));
        }
        plot.line(&values, BLUE);
        let _ = writeln!(html, "<figure>{}<figcaption>{title}</figcaption></figure>", plot.svg());
    }
    html.push_str("</div>\n");
}

fn histograms(html: &mut String, report: &Value) {
    let list = report.pointer("/profile/histograms").and_then(Value::as_array);
    let Some(list) = list.filter(|l| !l.is_empty()) else { return };
    html.push_str("<h2>How the numbers are spread</h2>\n<div class=\"plots\">\n");
    for histogram in list {
        let value = |key: &str| histogram.get(key).and_then(Value::as_f64).unwrap_or(0.0);
        let heights: Vec<f64> = histogram
            .get("percent")
            .and_then(Value::as_array)
            .into_iter()
            .flatten()
            .filter_map(Value::as_f64)
            .collect();
        let (from, width) = (value("from"), value("width"));
        let most = heights.iter().copied().fold(1.0, f64::max);
        let (name, unit) = (escape(text_of(histogram, "name")), escape(text_of(histogram, "unit")));
        let to = from + width * heights.len() as f64;
        let mut plot = Plot::new((from, to), (0.0, most * 1.05), &format!("{name}, {unit}"), "");
        plot.bars(from, width, &heights, BLUE);
        let _ = writeln!(
            html,
            "<figure>{}<figcaption>Share in percent by {name}; the outermost bars hold what lies beyond.</figcaption></figure>",
            plot.svg()
        );
    }
    html.push_str("</div>\n");
}

fn sections(html: &mut String, report: &Value) {
    let Some(list) = report.pointer("/profile/sections").and_then(Value::as_array) else { return };
    let radii = |section: &Value, key: &str| -> Vec<Option<f64>> {
        section.get(key).and_then(Value::as_array).into_iter().flatten().map(Value::as_f64).collect()
    };
    let all = list.iter().flat_map(|s| [radii(s, "mean_radii_m"), radii(s, "radii_m")].concat());
    let most = all.flatten().fold(0.1, f64::max);
    html.push_str("<h2>Sections</h2>\n<div class=\"sections\">\n");
    for section in list {
        let mean: Vec<f64> = radii(section, "mean_radii_m").into_iter().flatten().collect();
        let chainage = section.get("chainage_m").and_then(Value::as_f64).unwrap_or(0.0);
        let _ = writeln!(
            html,
            "<figure>{}<figcaption>Chainage {} m</figcaption></figure>",
            plots::section(&mean, &radii(section, "radii_m"), most),
            number(chainage)
        );
    }
    let _ = writeln!(
        html,
        "</div>\n<p>Facing increasing chainage. Blue: the surface, with its holes; dashed: the mean section; red: the axis. All to \
         one scale, {} m from the axis to the edge.</p>",
        number((most / 0.9 * 100.0).round() / 100.0)
    );
}

fn alignment(html: &mut String, axis_csv: &str) {
    let rows: Vec<Vec<f64>> =
        axis_csv.lines().skip(1).filter_map(|l| l.split(',').map(|v| v.parse().ok()).collect()).collect();
    if rows.len() < 2 || rows[0].len() < 6 {
        return;
    }
    let (first, last) = (&rows[0], &rows[rows.len() - 1]);
    let map: Vec<(f64, f64)> = rows.iter().map(|r| (r[1] - first[1], r[2] - first[2])).collect();
    let told = |r: &[f64]| format!("{} m", number((r[0] * 100.0).round() / 100.0));
    html.push_str("<h2>Axis</h2>\n<div class=\"plots\">\n");
    let _ = writeln!(
        html,
        "<figure>{}<figcaption>Plan, north up; begins at {} east, {} north.</figcaption></figure>",
        plots::plan(&map, &told(first), &told(last)),
        first[1],
        first[2]
    );
    let (mut low, mut high) = rows.iter().fold((f64::MAX, f64::MIN), |(l, h), r| (l.min(r[3]), h.max(r[3])));
    // A level tunnel is not shown as a mountain of millimetres.
    let least = 0.02 * (last[0] - first[0]);
    if high - low < least {
        (low, high) = ((low + high - least) / 2.0, (low + high + least) / 2.0);
    }
    let mut plot = Plot::new((first[0], last[0]), (low, high), "chainage, m", "height");
    plot.line(&rows.iter().map(|r| (r[0], Some(r[3]))).collect::<Vec<_>>(), BLUE);
    plot.mark(first[0], first[3], RED);
    plot.mark(last[0], last[3], RED);
    let _ = writeln!(
        html,
        "<figure>{}<figcaption>Long section: height in metres (exaggerated).</figcaption></figure>",
        plot.svg()
    );
    html.push_str("</div>\n");
}

fn previous(html: &mut String, report: &Value) {
    let Some(previous) = report.get("previous").filter(|p| p.is_object()) else { return };
    let overlap = previous.get("overlap_percent").and_then(Value::as_f64);
    let told = match (previous.get("refused").and_then(Value::as_str), overlap) {
        (Some(reason), _) => format!("not used: {reason}"),
        (None, Some(overlap)) => format!("the bounding boxes share {} %", number(overlap)),
        (None, None) => String::new(),
    };
    let _ = writeln!(
        html,
        "<h2>Compared with</h2>\n<p><code>{}</code> {}</p>",
        escape(text_of(previous, "run")),
        escape(&told)
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
        let bytes = input.get("bytes").and_then(Value::as_f64).unwrap_or(0.0);
        let _ = writeln!(
            html,
            "<tr><td>Input</td><td><code>{}</code><br>{} bytes, SHA-256 <code>{}</code></td></tr>",
            escape(text_of(input, "path")),
            number(bytes),
            escape(text_of(input, "sha256"))
        );
    }
    let _ = writeln!(html, "<tr><td>Adit</td><td>{}</td></tr>", escape(text_of(report, "adit_version")));
    let versions: Vec<String> =
        stages(report).filter_map(|(name, s)| Some(format!("{name} {}", s.get("version")?.as_u64()?))).collect();
    let _ = writeln!(html, "<tr><td>Stages, by version</td><td>{}</td></tr>", escape(&versions.join(", ")));
    for product in report.get("products").and_then(Value::as_array).into_iter().flatten() {
        let _ = writeln!(
            html,
            "<tr><td>Product</td><td>{}<br><code>{}</code></td></tr>",
            escape(text_of(product, "name")),
            escape(text_of(product, "sha256"))
        );
    }
    let settings = report.get("pipeline").map(|p| serde_json::to_string_pretty(p).unwrap_or_default());
    let _ = writeln!(
        html,
        "</table></div>\n<details><summary>All settings</summary><pre>{}</pre></details>",
        escape(&settings.unwrap_or_default())
    );
}

/// The sections of the stages, in their order.
fn stages(report: &Value) -> impl Iterator<Item = (&String, &Value)> {
    let all = report.as_object().into_iter().flatten();
    all.filter(|(_, s)| s.get("seconds").is_some() && s.get("version").is_some())
}

/// Where timings and memory are told, and how their limits were kept. The numbers themselves are in `report.json`.
fn effort(html: &mut String, report: &Value) {
    html.push_str(
        "<h2>Effort</h2>\n<p>Seconds and peak memory of every stage are in <a href=\"report.json\">report.json</a>: they differ from \
         run to run, and this page does not.</p>\n<div class=\"scroll\"><table><tr><th></th><th>Limit</th><th>Warns</th><th>Fails</th></tr>\n",
    );
    for check in checks(report).filter(|c| is_effort(c)) {
        if is_broken(check) {
            limit_row(html, check);
        } else {
            let mut unmeasured = check.clone();
            unmeasured["message"] = Value::from(if text_of(check, "status") == "pass" { "kept" } else { "not judged" });
            limit_row(html, &unmeasured);
        }
    }
    html.push_str("</table></div>\n");
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
            "seconds": 12.5, "map": { "seconds": 7.25, "version": 1, "peak_memory_bytes": 1048576 },
            "profile": {
                "step_m": 1.0, "chainage_m": [0.0, 1.0], "coverage_percent": [90.0, null],
                "histograms": [{ "name": "stretch", "unit": "%", "from": 0.0, "width": 1.0, "percent": [60.0, 40.0] }],
                "sections": [{ "chainage_m": 5.0, "mean_radii_m": [1.0, 1.0, 1.0], "radii_m": [1.0, null, 1.0] }],
            },
            "mesh": { "borders": {
                "portals": 1, "portals_expected": 2, "open_edges": 0, "side_openings": 1, "holes": 3,
                "longest": [{ "kind": "side-opening", "side": "right", "chainage_m": 8.004, "width_m": [2.5, 2.6], "length_m": 9.1 }],
            } },
        });
        let csv = "chainage_m,x,y,z,azimuth_deg,gradient_percent\n0,0,0,0,90,0\n1,1,0,0.1,90,10\n";
        let html = page(&report, folder.path(), csv);
        assert!(html.contains("FAIL") && html.contains("7 faces &amp; more") && html.contains("&lt;drift&gt;.laz"));
        assert!(
            html.contains("1 of 2 expected borders")
                && html.contains("<td>side opening</td><td>8 m</td><td>right</td>")
        );
        assert!(html.contains("<polygon") && html.contains("aria-label=\"plan\""));
        assert!(!html.contains("http") && !html.contains("<script"), "the page must not need anybody else");
    }

    #[test]
    fn the_metre_that_breaks_a_limit_is_shown() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("map")).unwrap();
        let picture = folder.path().join("map/coverage.png");
        let mut encoder = png::Encoder::new(std::fs::File::create(&picture).unwrap(), 100, 10);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.write_header().unwrap().write_image_data(&[7; 1000]).unwrap();
        std::fs::write(picture.with_extension("pgw"), "0.1\n0\n0\n-0.1\n0.05\n0.95\n").unwrap();
        let mut check = json!({ "name": "coverage_percent", "status": "warn", "worst_chainage_m": 4.5 });
        let (piece, layer) = offending_metre(&check, folder.path()).unwrap();
        assert_eq!(layer, "coverage");
        assert_eq!(piece[16..24], [0, 0, 0, 30, 0, 0, 0, 10]);
        check["worst_chainage_m"] = json!(null);
        assert!(offending_metre(&check, folder.path()).is_none());
    }

    #[test]
    fn effort_changes_the_page_only_when_it_breaks_a_limit() {
        let folder = tempfile::tempdir().unwrap();
        let page_of = |seconds: f64, status: &str| {
            let report = json!({ "status": status, "seconds": seconds, "map": { "seconds": seconds, "version": 1 },
                "limits": [{ "name": "duration_s", "status": status, "message": format!("took {seconds} s") }] });
            page(&report, folder.path(), "")
        };
        assert_eq!(page_of(1.0, "pass"), page_of(2.0, "pass"));
        assert!(!page_of(1.0, "pass").contains("took"));
        assert!(page_of(7.0, "fail").contains("took 7 s"));
    }
}
