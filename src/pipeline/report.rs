//! `report.json`: what went in, what every stage did, what the limits say.

use super::error::Error;
use super::judge::{Previous, checks};
use super::limits::{Check, Status, number, verdict};
use super::line::{Line, peak_memory_bytes};
use super::page;
use super::run::Outcome;
use super::run_folder::{ProductFile, Record, RunFolder, read_record, sha256_of_bytes};
use super::settings::Pipeline;
use schemars::JsonSchema;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::path::PathBuf;

/// Version of the report's layout; raised when a key changes its meaning or vanishes.
pub const SCHEMA_VERSION: u32 = 2;

/// `report.json`. Besides the keys named here it has one section for each stage, under the stage's name.
#[derive(Serialize, JsonSchema)]
struct Report {
    /// Version of this layout.
    schema_version: u32,
    /// Version of the program.
    adit_version: String,
    /// The verdict: the worst of all limits; `skipped` does not occur.
    status: Status,
    /// Every limit with what was measured.
    limits: Vec<Check>,
    /// The files that were read.
    input: Vec<InputFile>,
    /// The last accepted run of the same tunnel, if one was given.
    previous: Option<Previous>,
    /// What a person should know.
    warnings: Vec<StageWarning>,
    /// Way to the map and back, of points, pixels and lines.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<RoundTrip>")]
    roundtrip: Option<Value>,
    /// The stages, by name.
    #[serde(flatten)]
    stages: Map<String, Value>,
    /// Time that the stages took, seconds; a resumed run counts the stages of all its parts.
    seconds: f64,
    /// Greatest memory of the process, bytes; 0 where the system does not tell.
    peak_memory_bytes: u64,
    /// The files that were made.
    products: Vec<ProductFile>,
    /// All settings that were used.
    pipeline: Pipeline,
}

/// A file that was read.
#[derive(Serialize, JsonSchema)]
struct InputFile {
    /// Where it was.
    path: PathBuf,
    /// Its length.
    bytes: u64,
    /// Hash of its content.
    sha256: String,
}

/// A warning of a stage.
#[derive(Serialize, serde::Deserialize, JsonSchema)]
struct StageWarning {
    /// Stable name of the warning.
    code: String,
    /// One sentence for a person.
    message: String,
    /// The stage.
    #[serde(default)]
    stage: String,
}

/// How well points, pixels and lines come back.
#[derive(JsonSchema)]
#[allow(dead_code, reason = "only its schema is used: the numbers come as the stages tell them")]
struct RoundTrip {
    /// Points that were sent; absent when the input is a mesh.
    points: Option<u64>,
    /// Points that did not come back.
    lost: Option<u64>,
    /// Greatest distance, metres.
    max_m: Option<f64>,
    /// Distance that 99 % keep to, metres.
    p99_m: Option<f64>,
    /// The same in pixels of the map.
    max_px: Option<f64>,
    /// The same in pixels of the map.
    p99_px: Option<f64>,
}

/// What every section of a stage has besides its own numbers.
#[derive(JsonSchema)]
#[allow(dead_code, reason = "only its schema is used: sections are composed from what the stages tell")]
struct StageSection {
    /// Time that the stage took, seconds.
    seconds: f64,
    /// Greatest memory of the process up to its end, bytes.
    peak_memory_bytes: u64,
    /// Version of its algorithm.
    version: u32,
}

/// What the section of the mesh has besides.
#[derive(JsonSchema)]
#[allow(dead_code, reason = "only its schema is used: the section is what the stage tells")]
struct MeshSection {
    /// The borders of the surface by what they are.
    borders: crate::mesh::Borders,
}

/// JSON Schema of `report.json` (`docs/report.schema.json`).
pub fn schema() -> Value {
    let mut generator = schemars::SchemaGenerator::default();
    let section = generator.subschema_for::<StageSection>().to_value();
    let profile = generator.subschema_for::<super::profile::Profile>().to_value();
    let mesh = generator.subschema_for::<MeshSection>().to_value();
    let mut schema = generator.into_root_schema_for::<Report>().to_value();
    schema["title"] = json!("report.json of adit");
    let required = ["ingest", "axis", "mesh", "cut", "unwrap", "map", "profile"];
    let all = super::stages::STAGES.iter().chain(super::stages::MESH_STAGES).map(|s| s.name);
    for stage in all {
        schema["properties"][stage] = match stage {
            "profile" => json!({ "allOf": [section, profile] }),
            "mesh" => json!({ "allOf": [section, mesh] }),
            _ => section.clone(),
        };
    }
    if let Some(list) = schema["required"].as_array_mut() {
        list.extend(required.map(Value::from));
    }
    // Stages may tell more than a version of this schema knows; other keys are mistakes.
    schema["additionalProperties"] = json!(false);
    schema
}

/// Writes the report and the resolved pipeline, unless they are there already, and tells how the run ended.
pub(super) fn finish(
    pipeline: &Pipeline,
    line: &Line,
    folder: &RunFolder,
    input_hashes: &[String],
    previous: Option<Previous>,
) -> Result<Outcome, Error> {
    let toml = pipeline.to_toml();
    let keys: Vec<&str> = line.plans().iter().map(|p| p.key.as_str()).collect();
    let compared = previous.as_ref().map(|p| (&p.run, &p.report_sha256));
    let key_text = json!([SCHEMA_VERSION, env!("CARGO_PKG_VERSION"), keys, toml, compared]).to_string();
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
    let report = compose(pipeline, line, input_hashes, previous);
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

fn compose(pipeline: &Pipeline, line: &Line, input_hashes: &[String], previous: Option<Previous>) -> Value {
    let input = pipeline.input.iter().zip(input_hashes).map(|(path, sha256)| {
        let bytes = std::fs::metadata(path).map(|m| m.len()).unwrap_or(0);
        InputFile { path: path.clone(), bytes, sha256: sha256.clone() }
    });
    let mut report = Report {
        schema_version: SCHEMA_VERSION,
        adit_version: env!("CARGO_PKG_VERSION").to_owned(),
        status: Status::Fail,
        limits: Vec::new(),
        input: input.collect(),
        previous,
        warnings: Vec::new(),
        roundtrip: None,
        stages: Map::new(),
        seconds: 0.0,
        peak_memory_bytes: 0,
        products: Vec::new(),
        pipeline: pipeline.clone(),
    };
    let mut roundtrip = Map::new();
    for stage in line.plans().iter().map(|p| p.stage) {
        let Some(record) = line.record(stage.name) else { continue };
        let mut section = match record.summary {
            Value::Object(section) => section,
            other => Map::from_iter([("summary".to_owned(), other)]),
        };
        for warning in section.get("warnings").and_then(Value::as_array).into_iter().flatten() {
            if let Ok(warning) = serde_json::from_value::<StageWarning>(warning.clone()) {
                report.warnings.push(StageWarning { stage: stage.name.to_owned(), ..warning });
            }
        }
        section.insert("seconds".into(), json!(milliseconds(record.seconds)));
        section.insert("peak_memory_bytes".into(), json!(record.peak_memory_bytes));
        section.insert("version".into(), json!(record.version));
        report.seconds += record.seconds;
        report.peak_memory_bytes = report.peak_memory_bytes.max(record.peak_memory_bytes);
        report.products.extend(record.files);
        // The round trip is told by the anchors (points) and the map (pixels and lines), but it is a property of the
        // whole run.
        if let Some(Value::Object(trip)) = section.remove("roundtrip") {
            roundtrip.extend(trip);
        }
        report.stages.insert(stage.name.to_owned(), Value::Object(section));
    }
    report.seconds = milliseconds(report.seconds);
    let cell_m = report.stages.get("map").and_then(|m| m["cell_m"].as_f64());
    for (metres, pixels) in [("max_m", "max_px"), ("p99_m", "p99_px")] {
        if let Some((cell_m, value)) = cell_m.zip(roundtrip.get(metres).and_then(Value::as_f64)) {
            roundtrip.insert(pixels.into(), json!(value / cell_m));
        }
    }
    report.roundtrip = (!roundtrip.is_empty()).then_some(Value::Object(roundtrip));
    let told = |report: &Report| serde_json::to_value(report).expect("a report is plain data");
    let facts = told(&report);
    if let Some(previous) = &mut report.previous {
        previous.compare_places(&facts);
    }
    report.limits = checks(&pipeline.limits, &told(&report));
    report.status = verdict(&report.limits);
    told(&report)
}

fn milliseconds(seconds: f64) -> f64 {
    (seconds * 1000.0).round() / 1000.0
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
        let borders = |key: &str| at(&format!("/mesh/borders/{key}")).unwrap_or(0.0) as u64;
        let ends = ["portals", "open_edges", "side_openings", "holes"]
            .map(|key| (borders(key), key.replace('_', " ")))
            .into_iter()
            .filter(|(n, _)| *n > 0)
            .map(|(n, what)| format!(", {what} {n}"));
        line("surface", format!("{} triangles, {area:.1} m2{}", count(faces), ends.collect::<String>()));
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
    let mut untold_drift = None;
    for check in report.get("limits").and_then(Value::as_array).into_iter().flatten() {
        let text = |key: &str| check.get(key).and_then(Value::as_str).unwrap_or("?");
        let has_level = ["warn", "fail"].iter().any(|key| check.get(*key).is_some_and(|v| !v.is_null()));
        match text("status") {
            // What nobody set a level for, and what the first run of a tunnel cannot tell, is in the report.
            "skipped" if !has_level => {}
            "skipped" if text("name").starts_with("drift.") => untold_drift = Some(text("message")),
            status => lines.push(format!("  {status:<7} {}", text("message"))),
        }
    }
    if let Some(message) = untold_drift {
        let reason = message.split_once("not measured, ").map_or(message, |(_, rest)| rest);
        lines.push(format!(
            "  skipped changes since the last run: {}",
            reason.split(" (at most").next().unwrap_or(reason)
        ));
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
    fn the_schema_in_docs_is_current() {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/report.schema.json");
        let text = serde_json::to_string_pretty(&schema()).unwrap() + "\n";
        if std::env::var_os("ADIT_RENEW_DOCS").is_some() {
            std::fs::write(&file, &text).unwrap();
        }
        let found = std::fs::read_to_string(&file).unwrap_or_default();
        assert!(found == text, "renew it: ADIT_RENEW_DOCS=1 cargo test the_schema_in_docs");
    }

    #[test]
    fn counts_are_grouped() {
        assert_eq!([7, 1234, 1_234_567].map(thousands), ["7", "1 234", "1 234 567"]);
    }
}
