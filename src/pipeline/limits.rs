//! The quality gate: what a finished run must keep to, and the verdict.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

/// Levels of one measure. A plain number is the level at which the run fails.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Levels {
    /// Beyond this the run carries a warning.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub warn: Option<f64>,
    /// Beyond this the run fails (exit code 5); its products are kept and marked.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fail: Option<f64>,
}

impl Levels {
    const fn fail_at(fail: f64) -> Self {
        Self { warn: None, fail: Some(fail) }
    }

    const fn warn_at(warn: f64) -> Self {
        Self { warn: Some(warn), fail: None }
    }

    const fn at(warn: f64, fail: f64) -> Self {
        Self { warn: Some(warn), fail: Some(fail) }
    }
}

impl<'de> Deserialize<'de> for Levels {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl<'de> serde::de::Visitor<'de> for Visitor {
            type Value = Levels;

            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("a number (the level that fails) or a table { warn = ..., fail = ... }")
            }

            fn visit_f64<E>(self, fail: f64) -> Result<Levels, E> {
                Ok(Levels::fail_at(fail))
            }

            fn visit_i64<E>(self, fail: i64) -> Result<Levels, E> {
                Ok(Levels::fail_at(fail as f64))
            }

            fn visit_u64<E>(self, fail: u64) -> Result<Levels, E> {
                Ok(Levels::fail_at(fail as f64))
            }

            fn visit_map<A: serde::de::MapAccess<'de>>(self, mut map: A) -> Result<Levels, A::Error> {
                let mut levels = Levels::default();
                while let Some(key) = map.next_key::<String>()? {
                    match key.as_str() {
                        "warn" => levels.warn = Some(map.next_value()?),
                        "fail" => levels.fail = Some(map.next_value()?),
                        other => return Err(serde::de::Error::unknown_field(other, &["warn", "fail"])),
                    }
                }
                Ok(levels)
            }
        }
        deserializer.deserialize_any(Visitor)
    }
}

/// When a finished run counts as good. Each limit is a number (fails beyond it) or `{ warn = ..., fail = ... }`;
/// an empty table `{}` switches a limit off. What a run does not measure is reported as skipped, with the reason.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Most faces that are mirrored or collapsed on the map.
    pub flipped_faces: Levels,
    /// Least observed share of the map, percent.
    pub coverage_percent: Levels,
    /// Most stretch of the smoothed surface that 95 % of the area keep to, percent, beyond what the bend explains.
    pub distortion_p95_percent: Levels,
    /// Most distance between a point and its way to the map and back, 99th percentile, pixels.
    pub roundtrip_p99_px: Levels,
    /// Most distance between any point and its way to the map and back, metres.
    pub roundtrip_max_m: Levels,
    /// Most distance on the map between a pixel and its way to the wall and back, pixels.
    pub roundtrip_pixels_px: Levels,
    /// Most distance in space between a line and its way to the map and back, metres.
    pub roundtrip_lines_m: Levels,
    /// Most points of the input without a record in the output.
    pub lost_points: Levels,
    /// Most surface that no point supports, percent.
    pub filled_percent: Levels,
    /// Least points on a square metre of surface that 95 % of the metres along the tunnel have.
    pub density_per_m2: Levels,
    /// Most scatter of the points about the surface (1.4826 times the median deviation), metres.
    pub noise_m: Levels,
    /// Most distance between the surfaces that two stations saw, metres.
    pub station_residual_m: Levels,
    /// Least length of the axis, metres.
    pub length_m: Levels,
    /// Longest duration, seconds.
    pub duration_s: Levels,
    /// Greatest memory, bytes.
    pub peak_memory_bytes: Levels,
    /// Most change against the last accepted run of the same tunnel.
    pub drift: Drift,
}

/// Most change against the last accepted run of the same tunnel (`adit watch`, `adit batch`, `adit run --compare-with`).
/// Without such a run these are skipped.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Drift {
    /// Most loss of coverage, percentage points.
    pub coverage_loss_percent: Levels,
    /// Most growth of the distortion, percentage points.
    pub distortion_growth_percent: Levels,
    /// Most change of the axis' length, metres.
    pub length_change_m: Levels,
    /// Most change of the mean perimeter of the section, percent.
    pub perimeter_change_percent: Levels,
    /// Most change of the area of the surface, percent.
    pub area_change_percent: Levels,
    /// Most loss of points, percent.
    pub points_loss_percent: Levels,
    /// Most growth of the noise, percent.
    pub noise_growth_percent: Levels,
    /// Most growth of the duration, percent.
    pub duration_growth_percent: Levels,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            flipped_faces: Levels::fail_at(0.0),
            coverage_percent: Levels::at(95.0, 90.0),
            distortion_p95_percent: Levels::at(10.0, 15.0),
            roundtrip_p99_px: Levels::at(0.1, 1.0),
            roundtrip_max_m: Levels::fail_at(1e-6),
            roundtrip_pixels_px: Levels::fail_at(0.01),
            roundtrip_lines_m: Levels::fail_at(0.001),
            lost_points: Levels::fail_at(0.0),
            filled_percent: Levels::warn_at(10.0),
            density_per_m2: Levels::default(),
            noise_m: Levels::warn_at(0.05),
            station_residual_m: Levels::at(0.02, 0.05),
            length_m: Levels::default(),
            duration_s: Levels::default(),
            peak_memory_bytes: Levels::default(),
            drift: Drift::default(),
        }
    }
}

impl Default for Drift {
    /// Warnings only: a tunnel that is being driven grows, and that is no fault of the scan.
    fn default() -> Self {
        Self {
            coverage_loss_percent: Levels::warn_at(5.0),
            distortion_growth_percent: Levels::warn_at(5.0),
            length_change_m: Levels::default(),
            perimeter_change_percent: Levels::warn_at(5.0),
            area_change_percent: Levels::default(),
            points_loss_percent: Levels::warn_at(50.0),
            noise_growth_percent: Levels::warn_at(50.0),
            duration_growth_percent: Levels::default(),
        }
    }
}

/// How a check, or the whole run, came out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Status {
    /// Not judged: no level is set, or the value was not measured; the message says which.
    Skipped,
    /// Within all levels.
    Pass,
    /// Beyond a warning level.
    Warn,
    /// Beyond a failing level.
    Fail,
}

impl Status {
    /// The word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Skipped => "skipped",
            Self::Pass => "pass",
            Self::Warn => "warn",
            Self::Fail => "fail",
        }
    }
}

/// Which side of a level is good.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Sense {
    /// The value should not be greater.
    AtMost,
    /// The value should not be smaller.
    AtLeast,
}

/// One limit with the value that was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Check {
    /// Name of the limit, as in the pipeline file.
    pub name: String,
    /// What was measured; absent when the run does not tell it.
    pub value: Option<f64>,
    /// Unit of the value and the levels.
    pub unit: String,
    /// Whether the levels are upper or lower bounds.
    pub sense: Sense,
    /// Level of warning.
    pub warn: Option<f64>,
    /// Level of failing.
    pub fail: Option<f64>,
    /// How it came out.
    pub status: Status,
    /// Chainage of the metre where the value is worst, where metres are told apart.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worst_chainage_m: Option<f64>,
    /// One sentence for a person.
    pub message: String,
}

/// What a limit is about.
#[derive(Clone, Copy, Debug)]
pub struct Measure<'a> {
    /// Name of the limit, as in the pipeline file.
    pub name: &'a str,
    /// What is measured, for a person.
    pub what: &'a str,
    /// Unit of the value.
    pub unit: &'a str,
    /// Which side of a level is good.
    pub sense: Sense,
}

impl Check {
    /// Judges a value; one that was not measured (with the reason) is skipped.
    pub fn of(measure: Measure, levels: Levels, value: Result<f64, &str>) -> Self {
        let Measure { name, what, unit, sense } = measure;
        let measured = value.ok();
        let beyond = |level: Option<f64>| match (level, measured) {
            (Some(level), Some(value)) => match sense {
                // A value that is not a number keeps to no level.
                Sense::AtMost => !(value <= level),
                Sense::AtLeast => !(value >= level),
            },
            _ => false,
        };
        let no_level = levels.warn.is_none() && levels.fail.is_none();
        let status = match (beyond(levels.warn), beyond(levels.fail)) {
            _ if measured.is_none() || no_level => Status::Skipped,
            (_, true) => Status::Fail,
            (true, false) => Status::Warn,
            (false, false) => Status::Pass,
        };
        let spaced = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        let bound = match sense {
            Sense::AtMost => "at most",
            Sense::AtLeast => "at least",
        };
        let allowed = match if status == Status::Warn { levels.warn } else { levels.fail.or(levels.warn) } {
            Some(level) => format!(" ({bound} {}{spaced})", number(level)),
            None => " (no level is set)".to_owned(),
        };
        let message = match value {
            Ok(value) => format!("{what}: {}{spaced}{allowed}", number(value)),
            Err(reason) => format!("{what}: not measured, {reason}{allowed}"),
        };
        Self {
            name: name.to_owned(),
            value: measured,
            unit: unit.to_owned(),
            sense,
            warn: levels.warn,
            fail: levels.fail,
            status,
            worst_chainage_m: None,
            message,
        }
    }

    /// The same check with the place where it is worst.
    pub fn worst_at(mut self, chainage_m: Option<f64>) -> Self {
        self.worst_chainage_m = chainage_m;
        self
    }
}

/// The worst status of the checks; a run of which nothing was judged passes.
pub fn verdict(checks: &[Check]) -> Status {
    checks.iter().map(|c| c.status).fold(Status::Pass, Status::max)
}

/// A number for a person: four significant digits, no needless zeros.
pub fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    if value.fract() == 0.0 && value.abs() < 1e15 {
        return format!("{value:.0}");
    }
    let magnitude = value.abs().log10().floor() as i32;
    if !(-4..=9).contains(&magnitude) {
        return format!("{value:.2e}");
    }
    let text = format!("{value:.*}", (3 - magnitude).max(0) as usize);
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judged(sense: Sense, levels: Levels, value: Result<f64, &str>) -> Check {
        Check::of(Measure { name: "x", what: "the measure", unit: "m", sense }, levels, value)
    }

    #[test]
    fn a_value_on_the_level_keeps_to_it() {
        let flips = |n| judged(Sense::AtMost, Levels::fail_at(0.0), Ok(n)).status;
        assert_eq!((flips(0.0), flips(1.0)), (Status::Pass, Status::Fail));
        let coverage = |c| judged(Sense::AtLeast, Levels::at(95.0, 90.0), Ok(c)).status;
        assert_eq!((coverage(95.0), coverage(94.9), coverage(89.9)), (Status::Pass, Status::Warn, Status::Fail));
        assert_eq!(coverage(f64::NAN), Status::Fail);
    }

    #[test]
    fn what_is_not_measured_is_skipped_with_its_reason() {
        let check = judged(Sense::AtMost, Levels::at(1.0, 2.0), Err("there is one station"));
        assert_eq!(check.status, Status::Skipped);
        assert_eq!(check.message, "the measure: not measured, there is one station (at most 2 m)");
        let check = judged(Sense::AtMost, Levels::default(), Ok(3.0));
        assert_eq!((check.status, check.message.as_str()), (Status::Skipped, "the measure: 3 m (no level is set)"));
        assert_eq!(verdict(&[check]), Status::Pass);
    }

    #[test]
    fn levels_read_from_a_number_or_a_table() {
        let read = |text: &str| toml::from_str::<Limits>(text);
        assert_eq!(read("flipped_faces = 3").unwrap().flipped_faces, Levels::fail_at(3.0));
        assert_eq!(read("coverage_percent = { warn = 80 }").unwrap().coverage_percent.warn, Some(80.0));
        assert_eq!(read("coverage_percent = {}").unwrap().coverage_percent, Levels::default());
        assert!(read("coverage_percent = 'high'").unwrap_err().message().contains("a number"));
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!([1.0 / 3.0, 1234.56, 0.00012345, 5.0].map(number), ["0.3333", "1235", "0.0001234", "5"]);
    }
}
