//! `report.json`: what went in, what every stage did, what the limits say.

use super::error::Error;
use super::limits::{Check, Limits, Sense, Status, number, verdict};
use super::line::{Line, peak_memory_bytes};
use super::page;
use super::run::Outcome;
use super::run_folder::{Record, RunFolder, read_record, sha256_of_bytes};
use super::settings::Pipeline;
use serde_json::{Map, Value, json};

/// Version of the report's layout; raised when a key changes its meaning or vanishes.
pub const SCHEMA_VERSION: u32 = 1;

/// Writes the report and the resolved pipeline, unless they are there already, and tells how the run ended.
pub(super) fn finish(
    pipeline: &Pipeline,
    line: &Line,
    folder: &RunFolder,
    input_hashes: &[String],
) -> Result<Outcome, Error> {
    let toml = pipeline.to_toml();
    let keys: Vec<&str> = line.plans().iter().map(|p| p.key.as_str()).collect();
    let key_text = json!([SCHEMA_VERSION, env!("CARGO_PKG_VERSION"), keys, toml]).to_string();
    let key = sha256_of_bytes(key_text.as_bytes());
    if !line.has_worked()
        && let Some(record) = read_record(folder.path(), "report")
        && record.key == key
        && folder.has_files(&record)
        && let Ok(text) = std::fs::read(folder.path().join("report.json"))
        && let Ok(report) = serde_json::from_slice::<Value>(&text)
    {
        return Ok(Outcome { status: status_of(&report), report, worked: false });
    }
    let report = compose(pipeline, line, input_hashes);
    let staging = folder.staging("report")?;
    let text = format!("{}\n", serde_json::to_string_pretty(&report).expect("a report is plain data"));
    let axis_csv = std::fs::read_to_string(folder.path().join("axis.csv")).unwrap_or_default();
    let html = page::page(&report, folder.path(), &axis_csv);
    for (name, content) in [("report.json", &text), ("report.html", &html), ("pipeline.toml", &toml)] {
        let path = staging.join(name);
        std::fs::write(&path, content).map_err(|source| super::run_folder::Error::Io {
            action: "write",
            path,
            source,
        })?;
    }
    let files = folder.publish(&staging)?;
    let record = Record {
        key,
        version: SCHEMA_VERSION,
        settings: Value::Null,
        inputs: Default::default(),
        files,
        summary: Value::Null,
        seconds: 0.0,
        peak_memory_bytes: peak_memory_bytes(),
    };
    folder.finish("report", &record)?;
    Ok(Outcome { status: status_of(&report), report, worked: true })
}

fn status_of(report: &Value) -> Status {
    // A report without a readable status is no proof of quality.
    report.get("status").and_then(|s| serde_json::from_value(s.clone()).ok()).unwrap_or(Status::Fail)
}

fn compose(pipeline: &Pipeline, line: &Line, input_hashes: &[String]) -> Value {
    let mut report = Map::new();
    report.insert("schema_version".into(), json!(SCHEMA_VERSION));
    report.insert("adit_version".into(), json!(env!("CARGO_PKG_VERSION")));
    // Placeholders keep the verdict at the top of the file.
    report.insert("status".into(), Value::Null);
    report.insert("limits".into(), Value::Null);
    let inputs: Vec<Value> = pipeline
        .input
        .iter()
        .zip(input_hashes)
        .map(|(path, sha256)| {
            let bytes = std::fs::metadata(path).map(|m| m.len()).unwrap_or(0);
            json!({ "path": path, "bytes": bytes, "sha256": sha256 })
        })
        .collect();
    report.insert("input".into(), Value::Array(inputs));
    report.insert("warnings".into(), Value::Null);
    let (mut warnings, mut products) = (Vec::new(), Vec::new());
    let (mut seconds, mut peak) = (0.0, 0u64);
    for stage in line.plans().iter().map(|p| p.stage) {
        let Some(record) = line.record(stage.name) else { continue };
        let mut section = match record.summary {
            Value::Object(section) => section,
            other => Map::from_iter([("summary".to_owned(), other)]),
        };
        for warning in section.get("warnings").and_then(Value::as_array).into_iter().flatten() {
            let mut warning = warning.clone();
            warning["stage"] = json!(stage.name);
            warnings.push(warning);
        }
        section.insert("seconds".into(), json!((record.seconds * 1000.0).round() / 1000.0));
        section.insert("peak_memory_bytes".into(), json!(record.peak_memory_bytes));
        section.insert("version".into(), json!(record.version));
        seconds += record.seconds;
        peak = peak.max(record.peak_memory_bytes);
        products.extend(record.files);
        // The round trip is told by the anchors (points) and the map (pixels and lines), but it is a property of the
        // whole run.
        if let Some(Value::Object(trip)) = section.remove("roundtrip") {
            let whole = report.entry("roundtrip").or_insert_with(|| Value::Object(Map::new()));
            whole.as_object_mut().expect("made here").extend(trip);
        }
        report.insert(stage.name.to_owned(), Value::Object(section));
    }
    report.insert("seconds".into(), json!((seconds * 1000.0).round() / 1000.0));
    report.insert("peak_memory_bytes".into(), json!(peak));
    report.insert("products".into(), json!(products));
    report.insert("pipeline".into(), serde_json::to_value(pipeline).expect("settings are plain data"));
    let cell_m = report.get("map").and_then(|m| m["cell_m"].as_f64());
    if let (Some(cell_m), Some(Value::Object(trip))) = (cell_m, report.get_mut("roundtrip")) {
        for (metres, pixels) in [("max_m", "max_px"), ("p99_m", "p99_px")] {
            if let Some(value) = trip.get(metres).and_then(Value::as_f64) {
                trip.insert(pixels.into(), json!(value / cell_m));
            }
        }
    }
    report["warnings"] = Value::Array(warnings);
    let checks = checks(&pipeline.limits, &Value::Object(report.clone()));
    report["status"] = json!(verdict(&checks));
    report["limits"] = json!(checks);
    Value::Object(report)
}

/// Judges a report by the limits.
pub fn checks(limits: &Limits, report: &Value) -> Vec<Check> {
    let at = |path: &str| report.pointer(path).and_then(Value::as_f64);
    let cell_m = at("/map/cell_m");
    let roundtrip_px = at("/roundtrip/p99_m").zip(cell_m).map(|(m, cell)| m / cell);
    let lost = at("/ingest/points").zip(at("/points/points")).map(|(read, written)| (read - written).max(0.0));
    // Roughness is no distortion of the map, so the smoothed surface counts, unless smoothing itself shrank the tube.
    let raw_stretch = at("/unwrap/stretch/p95");
    let stretch = at("/unwrap/smoothed/stretch/p95").into_iter().chain(raw_stretch).reduce(f64::min);
    let bend = bend_stretch(report);
    let beyond_bend = stretch.map(|s| ((s / (1.0 + bend) - 1.0) * 100.0).max(0.0));
    let bend_told = match bend {
        b if b > 0.005 => format!(" beyond the {} % that the bend explains", number((b * 1000.0).round() / 10.0)),
        _ => String::new(),
    };
    vec![
        Check::of(
            "flipped_faces",
            "faces mirrored or collapsed on the map",
            "",
            Sense::AtMost,
            limits.flipped_faces,
            at("/unwrap/flipped_faces"),
        ),
        Check::of(
            "coverage_percent",
            "observed share of the map",
            "%",
            Sense::AtLeast,
            limits.coverage_percent,
            at("/map/coverage_percent"),
        ),
        Check::of(
            "distortion_p95_percent",
            &format!("stretch that 95 % of the area keep to{bend_told}"),
            "%",
            Sense::AtMost,
            limits.distortion_p95_percent,
            beyond_bend,
        ),
        Check::of(
            "roundtrip_p99_px",
            "way to the map and back, 99 % of the points",
            "px",
            Sense::AtMost,
            limits.roundtrip_p99_px,
            roundtrip_px,
        ),
        Check::of(
            "roundtrip_max_m",
            "way to the map and back, every point",
            "m",
            Sense::AtMost,
            limits.roundtrip_max_m,
            at("/roundtrip/max_m").map(|m| if at("/roundtrip/lost") > Some(0.0) { f64::INFINITY } else { m }),
        ),
        Check::of(
            "roundtrip_pixels_px",
            "pixels to the wall and back",
            "px",
            Sense::AtMost,
            limits.roundtrip_pixels_px,
            at("/roundtrip/pixels/max_px")
                .map(|px| if at("/roundtrip/pixels/lost") > Some(0.0) { f64::INFINITY } else { px }),
        ),
        Check::of(
            "roundtrip_lines_m",
            "lines to the wall and back",
            "m",
            Sense::AtMost,
            limits.roundtrip_lines_m,
            at("/roundtrip/lines/max_m")
                .map(|m| if at("/roundtrip/lines/lost") > Some(0.0) { f64::INFINITY } else { m }),
        ),
        Check::of("lost_points", "points without a record in the output", "", Sense::AtMost, limits.lost_points, lost),
        Check::of(
            "filled_percent",
            "surface that no point supports",
            "%",
            Sense::AtMost,
            limits.filled_percent,
            at("/mesh/filled_percent"),
        ),
        Check::of("duration_s", "duration", "s", Sense::AtMost, limits.duration_s, at("/seconds")),
    ]
}

/// The stretch that a chainage map of this tunnel must have at the walls of its sharpest bend.
///
/// A wall at half width `w` of a bend with radius `r` is `1 + w / r` as long as its chainage.
fn bend_stretch(report: &Value) -> f64 {
    let radius = report.pointer("/axis/least_bend_radius_m").and_then(Value::as_f64);
    let half_width =
        report.pointer("/segment/mean_perimeter_m").and_then(Value::as_f64).map(|p| p / std::f64::consts::TAU);
    match radius.zip(half_width) {
        Some((radius, half_width)) if radius > half_width => half_width / radius,
        _ => 0.0,
    }
}

/// The report on one screen.
pub fn summary_lines(report: &Value) -> Vec<String> {
    let at = |path: &str| report.pointer(path).and_then(Value::as_f64);
    let text = |path: &str| report.pointer(path).and_then(Value::as_str).unwrap_or("?").to_owned();
    let mut lines = Vec::new();
    let mut line = |label: &str, value: String| lines.push(format!("  {label:<12} {value}"));
    let count = |v: f64| thousands(v as u64);
    if let (Some(points), Some(kept)) = (at("/ingest/points"), at("/clean/geometry_points")) {
        line("scan", format!("{} points, {} carry the geometry", count(points), count(kept)));
    }
    if let (Some(length), Some(start), Some(end)) =
        (at("/axis/length_m"), at("/axis/start_chainage_m"), at("/axis/end_chainage_m"))
    {
        let perimeter = at("/segment/mean_perimeter_m").map_or(String::new(), |p| format!(", perimeter {p:.2} m"));
        line("tunnel", format!("{length:.1} m, chainage {start:.2} to {end:.2}{perimeter}"));
    }
    if let (Some(faces), Some(area)) = (at("/mesh/faces"), at("/mesh/area_m2")) {
        line("surface", format!("{} triangles, {area:.1} m2", count(faces)));
    }
    if let Some(mean) = at("/unwrap/stretch/mean") {
        let p95 = at("/unwrap/stretch/p95").unwrap_or(f64::NAN);
        line("unwrap", format!("{}, stretch {mean:.4} mean, {p95:.4} for 95 %", text("/unwrap/method")));
    }
    if let (Some(width), Some(height), Some(cell)) = (at("/map/width_px"), at("/map/height_px"), at("/map/cell_m")) {
        line("map", format!("{width} x {height} pixels of {} mm", number(cell * 1000.0)));
    }
    if let (Some(seconds), Some(peak)) = (at("/seconds"), at("/peak_memory_bytes")) {
        line("effort", format!("{seconds:.1} s, {:.0} MiB", peak / 1024.0 / 1024.0));
    }
    for check in report.get("limits").and_then(Value::as_array).into_iter().flatten() {
        let status = check.get("status").and_then(Value::as_str).unwrap_or("?");
        let message = check.get("message").and_then(Value::as_str).unwrap_or("?");
        lines.push(format!("  {status:<5} {message}"));
    }
    lines
}

/// A count with thin groups: `1 234 567`.
fn thousands(value: u64) -> String {
    let digits = value.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bend_excuses_the_stretch_of_its_walls() {
        let report = |radius: Value| {
            json!({ "unwrap": { "stretch": { "p95": 1.2 } }, "axis": { "least_bend_radius_m": radius },
                    "segment": { "mean_perimeter_m": 8.2 * std::f64::consts::PI } })
        };
        let status = |r: Value| checks(&Limits::default(), &r).into_iter().find(|c| c.name == "distortion_p95_percent");
        assert_eq!(status(report(Value::Null)).unwrap().status, Status::Fail);
        assert_eq!(status(report(json!(20.0))).unwrap().status, Status::Pass);
    }

    #[test]
    fn lost_points_fail() {
        let report = json!({ "ingest": { "points": 10 }, "points": { "points": 9 } });
        let lost = checks(&Limits::default(), &report).into_iter().find(|c| c.name == "lost_points").unwrap();
        assert_eq!((lost.status, lost.value), (Status::Fail, Some(1.0)));
    }

    #[test]
    fn counts_are_grouped() {
        assert_eq!([7, 1234, 1_234_567].map(thousands), ["7", "1 234", "1 234 567"]);
    }
}
