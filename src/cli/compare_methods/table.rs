//! The figures of the comparison as CSV, Markdown and JSON.

use super::Row;
use serde_json::Value;
use std::fmt::Write;

/// One column of the table: heading, place in the report of `adit unwrap --json`, decimals.
const COLUMNS: [(&str, &str, usize); 25] = [
    ("seconds", "/seconds/flatten", 2),
    ("cpu_seconds", "/seconds/flatten_cpu", 2),
    ("peak_memory_mib", "/peak_memory_mib", 0),
    ("flipped_faces", "/flipped_faces", 0),
    ("overlaps", "/overlaps", 0),
    ("stretch_mean", "/stretch/mean", 4),
    ("stretch_p95", "/stretch/p95", 4),
    ("stretch_max", "/stretch/max", 2),
    ("s1_p95", "/s1/p95", 4),
    ("s2_p05", "/s2/p05", 4),
    ("area_p05", "/area_ratio/p05", 3),
    ("area_p95", "/area_ratio/p95", 3),
    ("anisotropy_mean", "/anisotropy/mean", 4),
    ("sander_l2", "/sander_l2", 4),
    ("symmetric_dirichlet", "/symmetric_dirichlet", 5),
    ("smoothed_stretch_mean", "/smoothed/stretch/mean", 4),
    ("smoothed_stretch_p95", "/smoothed/stretch/p95", 4),
    ("chainage_rms_m", "/readability/chainage_rms_m", 3),
    ("chainage_max_m", "/readability/chainage_max_m", 3),
    ("bearing_rms_deg", "/readability/bearing_rms_deg", 2),
    ("girth_rms_m", "/readability/girth_rms_m", 3),
    ("girth_max_m", "/readability/girth_max_m", 3),
    ("unfolded_faces", "/solve/figures/unfolded_faces", 0),
    ("iterations", "/solve/iterations", 0),
    ("converged", "/solve/converged", 0),
];

fn cell(report: &Value, (_, place, decimals): &(&str, &str, usize)) -> String {
    match report.pointer(place) {
        Some(Value::Number(n)) => format!("{:.*}", decimals, n.as_f64().unwrap_or(f64::NAN)),
        Some(Value::Bool(yes)) => if *yes { "yes" } else { "no" }.to_owned(),
        _ => String::new(),
    }
}

/// One line a method; the last column says why a method failed.
pub(super) fn csv(rows: &[Row]) -> String {
    let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
    let mut text = String::from("method");
    COLUMNS.iter().for_each(|(name, ..)| text.extend([",", name]));
    text.push_str(",failed\n");
    for row in rows {
        let label = &row.entry.label;
        text += &if label.contains([',', '"']) { quoted(label) } else { label.clone() };
        for column in &COLUMNS {
            text.push(',');
            text += &row.report.as_ref().map(|r| cell(r, column)).unwrap_or_default();
        }
        let _ = writeln!(text, ",{}", row.report.as_ref().err().map(|why| quoted(why)).unwrap_or_default());
    }
    text
}

/// One row a figure and one column a method, which reads best on a page.
pub(super) fn markdown(rows: &[Row]) -> String {
    let mut text = String::from("| |");
    rows.iter().for_each(|row| text += &format!(" {} |", row.entry.label));
    text.push_str("\n|---|");
    rows.iter().for_each(|_| text.push_str("---|"));
    text.push('\n');
    for column in &COLUMNS {
        text += &format!("| {} |", column.0.replace('_', " "));
        for row in rows {
            text += &format!(" {} |", row.report.as_ref().map_or_else(|_| "failed".to_owned(), |r| cell(r, column)));
        }
        text.push('\n');
    }
    for row in rows {
        if let Err(why) = &row.report {
            text += &format!("\n`{}` failed: {why}\n", row.entry.label);
        }
    }
    text
}

/// The whole reports by method.
pub(super) fn json(rows: &[Row]) -> String {
    let entry = |row: &Row| {
        let value = row.report.clone().unwrap_or_else(|why| serde_json::json!({ "failed": why }));
        (row.entry.label.clone(), value)
    };
    let all: Value = rows.iter().map(entry).collect::<serde_json::Map<String, Value>>().into();
    format!("{all:#}\n")
}

#[cfg(test)]
mod tests {
    use super::super::Entry;
    use super::*;

    #[test]
    fn a_failure_is_a_row_with_its_reason() {
        let entry = |name: &str| Entry::parse(name).unwrap_or_else(|_| panic!());
        let report = serde_json::json!({ "stretch": { "mean": 1.25 }, "solve": { "converged": true } });
        let rows = [
            Row { entry: entry("arap"), report: Ok(report) },
            Row { entry: entry("abf"), report: Err("no \"memory\"".to_owned()) },
        ];
        let text = csv(&rows);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 3);
        assert!(lines[1].starts_with("arap,,") && lines[1].contains(",1.2500,") && lines[1].ends_with(",yes,"));
        assert!(lines[2].ends_with(",\"no \"\"memory\"\"\""), "{}", lines[2]);
        assert!(markdown(&rows).contains("| stretch mean | 1.2500 | failed |"));
        assert!(json(&rows).contains("\"failed\""));
    }
}
