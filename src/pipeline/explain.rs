//! Why a stage would be done again, or not.

use super::line::Plan;
use super::run_folder::{Record, read_record};
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

/// What a rerun would do with one stage, and why.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Explanation {
    /// Name of the stage.
    pub stage: &'static str,
    /// Whether its products are up to date.
    pub fresh: bool,
    /// Why it is stale; empty when fresh.
    pub reasons: Vec<String>,
}

/// Compares what is planned with what a run folder holds.
pub(super) fn explain(plans: &[Plan], folder: &Path) -> Vec<Explanation> {
    let mut found: Vec<Explanation> = Vec::new();
    for plan in plans {
        let reasons = match read_record(folder, plan.stage.name) {
            None => vec!["it has not been finished in this folder".to_owned()],
            Some(record) => reasons(plan, &record, folder, &found),
        };
        found.push(Explanation { stage: plan.stage.name, fresh: reasons.is_empty(), reasons });
    }
    found
}

fn reasons(plan: &Plan, record: &Record, folder: &Path, before: &[Explanation]) -> Vec<String> {
    let mut reasons = Vec::new();
    if record.version != plan.stage.version {
        reasons.push(format!("version {} -> {} of the stage", record.version, plan.stage.version));
    }
    differences("", &record.settings, &plan.settings, &mut |key, old, new| {
        reasons.push(format!("{}{key}: {old} -> {new}", plan.stage.name));
    });
    for (name, hash) in &plan.inputs {
        match record.inputs.get(name) {
            Some(old) if old == hash => {}
            _ if before.iter().any(|e| e.stage == name) => reasons.push(format!("{name} changed")),
            Some(old) => reasons.push(format!("{name} of the input changed ({} -> {})", &short(old), &short(hash))),
            None => reasons.push(format!("{name} of the input is new ({})", short(hash))),
        }
    }
    for name in record.inputs.keys().filter(|n| !plan.inputs.contains_key(*n)) {
        reasons.push(format!("{name} of the input is gone"));
    }
    for file in &record.files {
        match std::fs::metadata(folder.join(&file.name)) {
            Err(_) => reasons.push(format!("{} is missing", file.name)),
            Ok(m) if m.len() != file.bytes => {
                reasons.push(format!("{} has {} bytes instead of {}", file.name, m.len(), file.bytes));
            }
            Ok(_) => {}
        }
    }
    if reasons.is_empty() && record.key != plan.key {
        reasons.push("its record is from another version of Adit".to_owned());
    }
    reasons
}

fn short(hash: &str) -> String {
    hash.chars().take(8).collect()
}

fn differences(path: &str, old: &Value, new: &Value, tell: &mut impl FnMut(&str, &Value, &Value)) {
    match (old, new) {
        (Value::Object(a), Value::Object(b)) => {
            for key in a.keys().chain(b.keys().filter(|k| !a.contains_key(*k))) {
                let of = |m: &serde_json::Map<String, Value>| m.get(key).cloned().unwrap_or(Value::Null);
                differences(&format!("{path}.{key}"), &of(a), &of(b), tell);
            }
        }
        _ if old != new => tell(path, old, new),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn differences_name_the_key_with_both_values() {
        let mut told = Vec::new();
        let (old, new) = (json!({ "a": 1, "b": { "c": 2, "d": 0 } }), json!({ "a": 1, "b": { "c": 3 }, "e": true }));
        differences("", &old, &new, &mut |k, o, n| told.push(format!("{k} {o} {n}")));
        assert_eq!(told, [".b.c 2 3", ".b.d 0 null", ".e null true"]);
    }
}
