//! Which column of a file holds fracture labels.

use super::error::Error;
use super::file_scan::Settings;
use crate::warning::Warning;
use std::path::Path;

/// Where labels come from.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum LabelSource {
    None,
    /// The LAS classification.
    Classification,
    /// A named scalar column.
    Column {
        /// Its name as the file writes it.
        name: String,
        /// Its place among the names given to [`choose`].
        index: usize,
    },
}

impl LabelSource {
    pub(super) fn is_some(&self) -> bool {
        *self != Self::None
    }

    /// The name for people.
    pub(super) fn name(&self) -> Option<String> {
        match self {
            Self::None => None,
            Self::Classification => Some("classification".into()),
            Self::Column { name, .. } => Some(name.clone()),
        }
    }
}

/// Names that are taken for labels when no column is set, best first; compared without case and `scalar_` prefix.
const LABEL_NAMES: [&str; 9] = [
    "fracture",
    "fracture_label",
    "fracture_id",
    "label",
    "labels",
    "joint_set",
    "annotation",
    "class_label",
    "segment_label",
];

/// Chooses the label column among scalar column `names` (empty names are skipped).
pub(super) fn choose(
    path: &Path,
    settings: &Settings,
    names: &[String],
    has_classification: bool,
) -> Result<LabelSource, Error> {
    let column = |index: usize| LabelSource::Column { name: names[index].clone(), index };
    if let Some(wanted) = &settings.label_column {
        let exact = names.iter().position(|n| !n.is_empty() && n == wanted);
        if let Some(index) = exact.or_else(|| names.iter().position(|n| !n.is_empty() && plain(n) == plain(wanted))) {
            return Ok(column(index));
        }
        return match plain(wanted).as_str() {
            "none" => Ok(LabelSource::None),
            "classification" if has_classification => Ok(LabelSource::Classification),
            _ => {
                let mut there: Vec<&str> = names.iter().map(String::as_str).filter(|n| !n.is_empty()).collect();
                there.extend(has_classification.then_some("classification"));
                let there = if there.is_empty() { "none".into() } else { there.join(", ") };
                Err(Error::Settings {
                    key: "ingest.label_column",
                    cause: format!("'{}' has no column '{wanted}'", path.display()),
                    remedy: format!("its columns are: {there}"),
                })
            }
        };
    }
    Ok(LABEL_NAMES.iter().find_map(|l| names.iter().position(|n| plain(n) == *l)).map_or(LabelSource::None, column))
}

fn plain(name: &str) -> String {
    let name = name.trim().to_ascii_lowercase().replace([' ', '-', '.'], "_");
    name.strip_prefix("scalar_").unwrap_or(&name).to_owned()
}

/// The label of a column value; what is no whole number from 0 to 2^32 - 1 counts as bad and is unlabelled.
pub(super) fn label_of(value: f64, bad: &mut u64) -> u32 {
    let rounded = value.round();
    // CloudCompare writes integers as f32; a millionth covers its rounding.
    if rounded >= 0.0 && rounded <= f64::from(u32::MAX) && (value - rounded).abs() <= 1e-6 * rounded.max(1.0) {
        rounded as u32
    } else {
        *bad += 1;
        0
    }
}

pub(super) fn bad_values(count: u64, label: &LabelSource) -> Warning {
    Warning::new(
        "label-values",
        format!(
            "{count} values of the label column '{}' are negative, fractional or not a number; \
             these points are unlabelled",
            label.name().unwrap_or_default()
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(list: &[&str]) -> Vec<String> {
        list.iter().map(|s| (*s).to_owned()).collect()
    }

    #[test]
    fn known_names_are_found() {
        let found = choose(Path::new("a"), &Settings::default(), &names(&["omnivariance", "scalar_Label"]), true);
        assert_eq!(found.unwrap(), LabelSource::Column { name: "scalar_Label".into(), index: 1 });
        let none = choose(Path::new("a"), &Settings::default(), &names(&["roughness"]), true);
        assert_eq!(none.unwrap(), LabelSource::None);
    }

    #[test]
    fn a_missing_column_names_what_is_there() {
        let settings = Settings { label_column: Some("cracks".into()), ..Default::default() };
        let error = choose(Path::new("a.las"), &settings, &names(&["amplitude"]), true).unwrap_err().to_string();
        assert!(error.contains("cracks") && error.contains("amplitude, classification"), "{error}");
    }

    #[test]
    fn labels_are_whole_numbers() {
        let mut bad = 0;
        assert_eq!([3.0, 0.0, 4294967295.0, 7.0000001].map(|v| label_of(v, &mut bad)), [3, 0, u32::MAX, 7]);
        assert_eq!(bad, 0);
        assert_eq!([-1.0, 0.5, f64::NAN, 5e9].map(|v| label_of(v, &mut bad)), [0; 4]);
        assert_eq!(bad, 4);
    }
}
