//! An axis from a CSV file: the surveyor's centre line.
//!
//! Columns `x, y, z` or `chainage, x, y, z`, separated by comma, semicolon, tab or blanks; with a header line the
//! columns may have any order (`x`/`easting`, `y`/`northing`, `z`/`elevation`/`height`, `chainage`/`chainage_m`/`station`;
//! others are ignored). Lines that start with `#` and empty lines are skipped. The file `axis.csv` of a run can be read.

use super::trace::{describe, finish, imported_direction};
use super::{Axis, Error, Settings, Source, Summary};
use crate::cloud::ScanFrame;
use crate::numeric::Vec3;
use crate::warning::Warning;

/// Chainages that differ from the lengths of the curve by more than this share deserve a warning.
const CHAINAGE_TOLERANCE: f64 = 1e-3;

/// Which column holds what.
struct Columns {
    position: [usize; 3],
    chainage: Option<usize>,
}

/// Reads an axis from the text of a CSV file in scan coordinates; `frame` is the frame of the scan.
///
/// # Errors
/// [`Error::Alignment`] names the line, [`Error::TooFewPoints`], [`Error::Setting`].
pub fn import_csv(text: &str, frame: &ScanFrame, settings: &Settings) -> Result<(Axis, Summary), Error> {
    settings.check()?;
    let mut columns: Option<Columns> = None;
    let mut points: Vec<Vec3> = Vec::new();
    let mut chainages: Vec<f64> = Vec::new();
    for (number, raw) in text.lines().enumerate() {
        let line = number + 1;
        let content = raw.trim().trim_start_matches('\u{feff}');
        if content.is_empty() || content.starts_with('#') {
            continue;
        }
        let fields = fields(content);
        if columns.is_none() {
            let is_header = fields.iter().any(|f| f.parse::<f64>().is_err());
            columns = Some(if is_header { header(&fields, line)? } else { headerless(&fields, line)? });
            if is_header {
                continue;
            }
        }
        let columns = columns.as_ref().expect("set above");
        let number = |column: usize| -> Result<f64, Error> {
            let field = fields.get(column).copied().unwrap_or("");
            field.parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(|| Error::Alignment {
                line,
                problem: format!("column {} should be a number, found '{field}'", column + 1),
            })
        };
        let [x, y, z] = columns.position;
        points.push(frame.local_from_scan(&Vec3::new(number(x)?, number(y)?, number(z)?)));
        if let Some(column) = columns.chainage {
            chainages.push(number(column)? * frame.metres_per_unit);
        }
    }
    // Chainage decides the direction, not the order of the lines.
    if let (Some(first), Some(last)) = (chainages.first(), chainages.last())
        && first > last
    {
        points.reverse();
        chainages.reverse();
    }
    let start = settings.start_chainage_m.or(chainages.first().copied()).unwrap_or(0.0);
    let axis = imported_direction(Axis::through(&points, start)?, settings);
    let mut warnings = Vec::new();
    if settings.ends.is_some() {
        let message = "axis.ends was ignored: axis.alignment says where the tunnel begins and ends";
        warnings.push(Warning::new("ends-unused", message));
    }
    if let (Some(first), Some(last)) = (chainages.first(), chainages.last()) {
        let stated = last - first;
        if (stated - axis.length()).abs() > CHAINAGE_TOLERANCE * axis.length() {
            warnings.push(Warning::new(
                "alignment-chainage",
                format!(
                    "the alignment states {stated:.3} m of chainage for a curve of {:.3} m; chainage is measured along \
                     the curve in space, starting at {start:.3} m",
                    axis.length()
                ),
            ));
        }
    }
    let axis = finish(axis, settings, &mut warnings);
    let summary = describe(&axis, Source::Alignment, warnings);
    Ok((axis, summary))
}

fn fields(line: &str) -> Vec<&str> {
    let separator = [';', '\t', ','].into_iter().find(|s| line.contains(*s));
    match separator {
        Some(s) => line.split(s).map(|f| f.trim().trim_matches('"')).collect(),
        None => line.split_whitespace().collect(),
    }
}

fn header(fields: &[&str], line: usize) -> Result<Columns, Error> {
    let names: Vec<String> = fields.iter().map(|f| f.to_lowercase()).collect();
    let find = |accepted: &[&str]| names.iter().position(|n| accepted.contains(&n.as_str()));
    let need = |accepted: &[&str]| {
        find(accepted).ok_or_else(|| Error::Alignment {
            line,
            problem: format!("the header has no column '{}'; it has: {}", accepted[0], fields.join(", ")),
        })
    };
    Ok(Columns {
        position: [
            need(&["x", "easting", "east", "e", "x_m"])?,
            need(&["y", "northing", "north", "n", "y_m"])?,
            need(&["z", "elevation", "height", "h", "z_m"])?,
        ],
        chainage: find(&["chainage_m", "chainage", "station", "s", "ch"]),
    })
}

fn headerless(fields: &[&str], line: usize) -> Result<Columns, Error> {
    match fields.len() {
        3 => Ok(Columns { position: [0, 1, 2], chainage: None }),
        4 => Ok(Columns { position: [1, 2, 3], chainage: Some(0) }),
        found => Err(Error::Alignment {
            line,
            problem: format!("expected x, y, z or chainage, x, y, z (or a header line), found {found} columns"),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn import(text: &str) -> Result<(Axis, Summary), Error> {
        import_csv(text, &ScanFrame::with_origin(Vec3::new(1000.0, 2000.0, 0.0)), &Settings::default())
    }

    #[test]
    fn headers_separators_and_plain_columns() {
        for text in [
            "x,y,z\n1000,2000,5\n1010,2000,5\n",
            "# centre line\n1000 2000 5\n1010 2000 5",
            "chainage_m;northing;easting;elevation;note\n0;2000;1000;5;a\n10;2000;1010;5;b\n",
            "100\t1000\t2000\t5\n110\t1010\t2000\t5\n",
        ] {
            let (axis, summary) = import(text).unwrap();
            let start = axis.frame_at(axis.start_chainage());
            assert!(
                (start.origin - Vec3::new(0.0, 0.0, 5.0)).norm() < 1e-9 && (start.forward - Vec3::x()).norm() < 1e-9
            );
            assert!((axis.length() - 10.0).abs() < 1e-9 && summary.warnings.is_empty(), "{text}");
        }
        assert_eq!(import("100 1000 2000 5\n110 1010 2000 5\n").unwrap().0.start_chainage(), 100.0);
    }

    #[test]
    fn falling_chainage_turns_the_axis_and_wrong_chainage_warns() {
        let (axis, summary) = import("120 1000 2000 5\n100 1010 2000 5\n").unwrap();
        assert!((axis.frame_at(100.0).forward + Vec3::x()).norm() < 1e-9);
        assert_eq!(summary.warnings[0].code, "alignment-chainage");
    }

    #[test]
    fn ends_beside_an_alignment_are_told_to_be_unused() {
        let settings = Settings { ends: Some([[1000.0, 2000.0, 5.0], [1010.0, 2000.0, 5.0]]), ..Settings::default() };
        let frame = ScanFrame::with_origin(Vec3::zeros());
        let (_, summary) = import_csv("x,y,z\n1000,2000,5\n1010,2000,5\n", &frame, &settings).unwrap();
        assert_eq!(summary.warnings[0].code, "ends-unused");
    }

    #[test]
    fn bad_lines_are_named() {
        let error = import("x,y,z\n1,2,3\n1,two,3\n").unwrap_err();
        assert_eq!(error, Error::Alignment { line: 3, problem: "column 2 should be a number, found 'two'".to_owned() });
        assert!(import("east,north\n1,2\n").unwrap_err().to_string().contains("no column 'z'"));
        assert!(matches!(import("x,y,z\n1,2,3\n"), Err(Error::TooFewPoints { found: 1 })));
    }
}
