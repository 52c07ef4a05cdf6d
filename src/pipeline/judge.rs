//! The verdict: every limit against the report, and the report against the last accepted run of the same tunnel.

use super::limits::{Check, Drift, Levels, Limits, Measure, Sense, number};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The run that a run is compared with, and what of it is compared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Previous {
    /// Its run folder.
    pub run: PathBuf,
    /// Hash of its report.
    pub report_sha256: String,
    /// Why its numbers are not compared, if they are not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
    /// Share of the smaller of both scans' bounding boxes that the other covers along the axis that fits worst, percent.
    pub overlap_percent: Option<f64>,
    /// Its numbers, by name.
    pub values: std::collections::BTreeMap<String, f64>,
}

/// Bounding boxes of scans of one tunnel overlap at least this much.
const LEAST_OVERLAP_PERCENT: f64 = 30.0;

/// What is compared between runs: name and place in the report.
const COMPARED: [(&str, &str); 8] = [
    ("coverage_percent", "/map/coverage_percent"),
    ("length_m", "/axis/length_m"),
    ("perimeter_m", "/segment/mean_perimeter_m"),
    ("area_m2", "/mesh/area_m2"),
    ("points", "/ingest/points"),
    ("noise_m", "/profile/noise_whole_m"),
    ("duration_s", "/seconds"),
    ("stretch_p95", "/unwrap/stretch/p95"),
];

impl Previous {
    /// What the report in a run folder says; that it does not say anything is told in `refused`.
    pub fn read(run: &Path) -> Self {
        let mut previous = Self {
            run: run.to_owned(),
            report_sha256: String::new(),
            refused: None,
            overlap_percent: None,
            values: Default::default(),
        };
        let read = std::fs::read(run.join("report.json"));
        let Some((text, report)) =
            read.ok().and_then(|t| serde_json::from_slice::<Value>(&t).ok().map(|report| (t, report)))
        else {
            previous.refused = Some(format!("'{}' has no report.json that reads", run.display()));
            return previous;
        };
        previous.report_sha256 = super::run_folder::sha256_of_bytes(&text);
        if report.get("status").and_then(Value::as_str).is_none_or(|s| s == "fail") {
            previous.refused = Some(format!("'{}' was not accepted itself", run.display()));
        }
        for (name, path) in COMPARED {
            previous.values.extend(report.pointer(path).and_then(Value::as_f64).map(|v| (name.to_owned(), v)));
        }
        for (i, name) in BOUNDS.iter().enumerate() {
            let at = format!("/ingest/bounds_in_scan/{}/{}", i / 3, i % 3);
            previous.values.extend(report.pointer(&at).and_then(Value::as_f64).map(|v| ((*name).to_owned(), v)));
        }
        previous
    }

    /// Refuses the comparison when both scans lie at different places.
    pub(super) fn compare_places(&mut self, report: &Value) {
        let mut worst: Option<f64> = None;
        for axis in 0..3 {
            let own = |side: usize| report.pointer(&format!("/ingest/bounds_in_scan/{side}/{axis}"))?.as_f64();
            let (Some(low), Some(high)) = (own(0), own(1)) else { return };
            let (Some(&l), Some(&h)) = (self.values.get(BOUNDS[axis]), self.values.get(BOUNDS[3 + axis])) else {
                return;
            };
            let smaller = (high - low).min(h - l).max(1e-9);
            let share = 100.0 * ((high.min(h) - low.max(l)) / smaller).clamp(0.0, 1.0);
            worst = Some(worst.map_or(share, |w| w.min(share)));
        }
        self.overlap_percent = worst.map(|w| (w * 10.0).round() / 10.0);
        if let Some(overlap) = worst.filter(|&w| w < LEAST_OVERLAP_PERCENT && self.refused.is_none()) {
            self.refused = Some(format!(
                "'{}' lies elsewhere (the bounding boxes share {overlap:.0} %, at least {LEAST_OVERLAP_PERCENT} % are \
                 needed): it is another tunnel",
                self.run.display()
            ));
        }
    }
}

const BOUNDS: [&str; 6] = ["low_x", "low_y", "low_z", "high_x", "high_y", "high_z"];

/// Judges a report by the limits.
pub fn checks(limits: &Limits, report: &Value) -> Vec<Check> {
    let at = |path: &str| report.pointer(path).and_then(Value::as_f64);
    let from_mesh = at("/points/points").is_none() && report.get("anchor").is_none();
    let needs_points = if from_mesh { "the input is a mesh, not a scan" } else { "the run does not tell it" };
    let or = |value: Option<f64>, reason: &'static str| value.ok_or(reason);
    let cell_m = at("/map/cell_m");
    let roundtrip_px = at("/roundtrip/p99_m").zip(cell_m).map(|(m, cell)| m / cell);
    let lost = at("/ingest/points").zip(at("/points/points")).map(|(read, written)| (read - written).max(0.0));
    let (stations_told, station_residual) = worst_overlap(report);
    // Roughness is no distortion of the map, so the smoothed surface counts, unless smoothing itself shrank the tube.
    let raw_stretch = at("/unwrap/stretch/p95");
    let stretch = at("/unwrap/smoothed/stretch/p95").into_iter().chain(raw_stretch).reduce(f64::min);
    let bend = bend_stretch(report);
    let beyond_bend = stretch.map(|s| ((s / (1.0 + bend) - 1.0) * 100.0).max(0.0));
    let bend_told = match bend {
        b if b > 0.005 => format!(" beyond the {} % that the bend explains", number((b * 1000.0).round() / 10.0)),
        _ => String::new(),
    };
    let distortion_told = format!("stretch that 95 % of the area keep to{bend_told}");
    let untold = "the run does not tell it";
    let most = |name, what, unit, levels, value| judge(name, what, unit, Sense::AtMost, levels, value);
    let least = |name, what, unit, levels, value| judge(name, what, unit, Sense::AtLeast, levels, value);
    // What does not come back at all has come back from infinitely far.
    let whole_way = |of: &str, key: &str| {
        let value = at(&format!("/roundtrip{of}/{key}"))?;
        Some(if at(&format!("/roundtrip{of}/lost")) > Some(0.0) { f64::INFINITY } else { value })
    };
    let worst = |name: &str| at(&format!("/profile/worst/{name}/chainage_m"));
    let mut checks = vec![
        most(
            "flipped_faces",
            "faces mirrored or collapsed on the map",
            "",
            limits.flipped_faces,
            or(at("/unwrap/flipped_faces"), untold),
        )
        .worst_at(worst("flipped_faces")),
        least(
            "coverage_percent",
            "observed share of the map",
            "%",
            limits.coverage_percent,
            or(at("/map/coverage_percent"), untold),
        )
        .worst_at(worst("coverage_percent")),
        most("distortion_p95_percent", &distortion_told, "%", limits.distortion_p95_percent, or(beyond_bend, untold))
            .worst_at(worst("stretch_p95")),
        most(
            "roundtrip_p99_px",
            "way to the map and back, 99 % of the points",
            "px",
            limits.roundtrip_p99_px,
            or(roundtrip_px, needs_points),
        ),
        most(
            "roundtrip_max_m",
            "way to the map and back, every point",
            "m",
            limits.roundtrip_max_m,
            or(whole_way("", "max_m"), needs_points),
        ),
        most(
            "roundtrip_pixels_px",
            "pixels to the wall and back",
            "px",
            limits.roundtrip_pixels_px,
            or(whole_way("/pixels", "max_px"), untold),
        ),
        most(
            "roundtrip_lines_m",
            "lines to the wall and back",
            "m",
            limits.roundtrip_lines_m,
            or(whole_way("/lines", "max_m"), untold),
        ),
        most("lost_points", "points without a record in the output", "", limits.lost_points, or(lost, needs_points)),
        most(
            "filled_percent",
            "surface that no point supports",
            "%",
            limits.filled_percent,
            or(at("/mesh/filled_percent"), untold),
        )
        .worst_at(worst("filled_percent")),
        least(
            "density_per_m2",
            "points on a square metre, 95 % of the tunnel",
            "",
            limits.density_per_m2,
            or(at("/profile/density_p05_per_m2"), needs_points),
        )
        .worst_at(worst("density_per_m2")),
        most(
            "noise_m",
            "scatter of the points about the surface",
            "m",
            limits.noise_m,
            or(at("/profile/noise_whole_m"), needs_points),
        )
        .worst_at(worst("noise_m")),
        most(
            "station_residual_m",
            &stations_told,
            "m",
            limits.station_residual_m,
            or(station_residual, if from_mesh { needs_points } else { "no two stations saw the same wall" }),
        ),
        least("length_m", "length of the axis", "m", limits.length_m, or(at("/axis/length_m"), untold)),
        most("duration_s", "duration", "s", limits.duration_s, or(at("/seconds"), untold)),
        most(
            "peak_memory_bytes",
            "greatest memory",
            "bytes",
            limits.peak_memory_bytes,
            or(at("/peak_memory_bytes").filter(|&b| b > 0.0), "this system does not tell it"),
        ),
    ];
    checks.extend(drift(&limits.drift, report));
    checks
}

fn judge(name: &str, what: &str, unit: &str, sense: Sense, levels: Levels, value: Result<f64, &str>) -> Check {
    Check::of(Measure { name, what, unit, sense }, levels, value)
}

/// The changes against the previous run that the report names.
fn drift(drift: &Drift, report: &Value) -> Vec<Check> {
    let previous = report.get("previous").and_then(|p| serde_json::from_value::<Previous>(p.clone()).ok());
    let reason = match &previous {
        None => Some("there is no accepted run of this tunnel to compare with".to_owned()),
        Some(previous) => previous.refused.clone(),
    };
    let run = previous.as_ref().and_then(|p| p.run.file_name()).map(|n| n.to_string_lossy().into_owned());
    let pair = |name: &str| {
        let place = COMPARED.iter().find(|(n, _)| *n == name).map(|(_, place)| *place)?;
        Some((*previous.as_ref()?.values.get(name)?, report.pointer(place)?.as_f64()?))
    };
    let loss = |(old, new): (f64, f64)| old - new;
    let change = |(old, new): (f64, f64)| (new - old).abs();
    let percent = |(old, new): (f64, f64)| 100.0 * (new - old) / old.abs().max(1e-9);
    let rows: [(&str, &str, &str, Levels, Option<f64>); 8] = [
        (
            "drift.coverage_loss_percent",
            "coverage lost",
            "points",
            drift.coverage_loss_percent,
            pair("coverage_percent").map(loss),
        ),
        (
            "drift.distortion_growth_percent",
            "distortion gained",
            "points",
            drift.distortion_growth_percent,
            pair("stretch_p95").map(|p| -100.0 * loss(p)),
        ),
        ("drift.length_change_m", "axis length changed", "m", drift.length_change_m, pair("length_m").map(change)),
        (
            "drift.perimeter_change_percent",
            "mean perimeter changed",
            "%",
            drift.perimeter_change_percent,
            pair("perimeter_m").map(|p| percent(p).abs()),
        ),
        (
            "drift.area_change_percent",
            "area of the surface changed",
            "%",
            drift.area_change_percent,
            pair("area_m2").map(|p| percent(p).abs()),
        ),
        (
            "drift.points_loss_percent",
            "points lost",
            "%",
            drift.points_loss_percent,
            pair("points").map(|p| -percent(p)),
        ),
        ("drift.noise_growth_percent", "noise gained", "%", drift.noise_growth_percent, pair("noise_m").map(percent)),
        (
            "drift.duration_growth_percent",
            "duration gained",
            "%",
            drift.duration_growth_percent,
            pair("duration_s").map(percent),
        ),
    ];
    rows.into_iter()
        .map(|(name, what, unit, levels, value)| {
            let what = run.as_ref().map_or(what.to_owned(), |run| format!("{what} since {run}"));
            let value = match (&reason, value) {
                (Some(reason), _) => Err(reason.as_str()),
                (None, Some(value)) => Ok(value),
                (None, None) => Err("one of both runs does not tell it"),
            };
            judge(name, &what, unit, Sense::AtMost, levels, value)
        })
        .collect()
}

/// What the residual between stations is called, and the largest one, metres: the median distance of one station's points from
/// the planes of the other.
fn worst_overlap(report: &Value) -> (String, Option<f64>) {
    let overlaps = report.pointer("/ingest/overlaps").and_then(Value::as_array).into_iter().flatten();
    let medians = overlaps.filter_map(|o| Some((o.get("stations")?, o.get("median_m")?.as_f64()?)));
    match medians.max_by(|a, b| a.1.total_cmp(&b.1)) {
        None => ("distance between what two stations saw".to_owned(), None),
        Some((pair, median)) => {
            let name = |i: usize| pair.get(i).and_then(Value::as_str).unwrap_or("?");
            (format!("distance between what stations '{}' and '{}' saw", name(0), name(1)), Some(median))
        }
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::limits::Status;
    use serde_json::json;

    fn check(report: &Value, name: &str) -> Check {
        checks(&Limits::default(), report).into_iter().find(|c| c.name == name).unwrap()
    }

    #[test]
    fn a_bend_excuses_the_stretch_of_its_walls() {
        let report = |radius: Value| {
            json!({ "unwrap": { "stretch": { "p95": 1.2 } }, "axis": { "least_bend_radius_m": radius },
                    "segment": { "mean_perimeter_m": 8.2 * std::f64::consts::PI } })
        };
        let status = |r: Value| check(&r, "distortion_p95_percent").status;
        assert_eq!(status(report(Value::Null)), Status::Fail);
        assert_eq!(status(report(json!(20.0))), Status::Pass);
    }

    #[test]
    fn lost_points_fail() {
        let report = json!({ "ingest": { "points": 10 }, "points": { "points": 9 } });
        let lost = check(&report, "lost_points");
        assert_eq!((lost.status, lost.value), (Status::Fail, Some(1.0)));
    }

    #[test]
    fn the_stations_that_disagree_most_are_judged_and_named() {
        let pair = |a: &str, b: &str, median: f64| json!({ "stations": [a, b], "median_m": median, "points": 900 });
        let report =
            json!({ "ingest": { "overlaps": [pair("north", "middle", 0.003), pair("middle", "south", 0.031)] } });
        let residual = check(&report, "station_residual_m");
        assert_eq!((residual.status, residual.value), (Status::Warn, Some(0.031)));
        assert!(residual.message.contains("'middle' and 'south'"), "{}", residual.message);
    }

    #[test]
    fn nothing_unmeasured_passes() {
        for check in checks(&Limits::default(), &json!({})) {
            assert_eq!(check.status, Status::Skipped, "{}", check.name);
            assert!(check.message.contains("not measured, "), "{}", check.message);
        }
    }

    fn earlier(folder: &Path, coverage: f64, low_x: f64) -> Previous {
        let report = json!({ "status": "pass", "map": { "coverage_percent": coverage },
            "ingest": { "bounds_in_scan": [[low_x, 0, 0], [low_x + 10.0, 5, 5]] } });
        std::fs::write(folder.join("report.json"), report.to_string()).unwrap();
        Previous::read(folder)
    }

    #[test]
    fn a_change_against_the_previous_run_is_judged() {
        let folder = tempfile::tempdir().unwrap();
        let mut report = json!({ "map": { "coverage_percent": 90.0 },
            "ingest": { "bounds_in_scan": [[1.0, 0, 0], [11.0, 5, 5]] } });
        let mut previous = earlier(folder.path(), 98.5, 0.0);
        previous.compare_places(&report);
        assert_eq!((previous.refused.clone(), previous.overlap_percent), (None, Some(90.0)));
        report["previous"] = json!(previous);
        let loss = check(&report, "drift.coverage_loss_percent");
        assert_eq!((loss.status, loss.value), (Status::Warn, Some(8.5)));
        // What only one of both tells is skipped.
        assert_eq!(check(&report, "drift.points_loss_percent").status, Status::Skipped);
    }

    #[test]
    fn another_place_is_another_tunnel() {
        let folder = tempfile::tempdir().unwrap();
        let mut report = json!({ "map": { "coverage_percent": 10.0 },
            "ingest": { "bounds_in_scan": [[500.0, 0, 0], [510.0, 5, 5]] } });
        let mut previous = earlier(folder.path(), 98.5, 0.0);
        previous.compare_places(&report);
        report["previous"] = json!(previous);
        let loss = check(&report, "drift.coverage_loss_percent");
        assert!(loss.status == Status::Skipped && loss.message.contains("another tunnel"), "{}", loss.message);
    }
}
