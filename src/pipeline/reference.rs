//! The reference page of the pipeline file, written from its schema and its defaults.

use super::settings::Pipeline;
use serde_json::Value;
use std::fmt::Write;

/// The page `docs/pipeline_reference.md`.
pub fn reference() -> String {
    let schema: Value = Pipeline::schema().into();
    let defaults = serde_json::to_value(Pipeline::default()).expect("settings are plain data");
    let mut page = String::from(
        "# Pipeline file\n\n\
         Generated from the settings in the source (`cargo test` says when it is out of date and how to renew it).\n\n\
         One table per stage; every key has a default, most are chosen from the scan. `adit run FILE.toml --check` prints a\n\
         file resolved, `--set map.cell_m=0.005` overrides one key. Unknown keys are refused.\n",
    );
    let tables = schema.get("properties").and_then(Value::as_object);
    for (name, table) in tables.into_iter().flatten() {
        let node = follow(&schema, table);
        let told = table.get("description").or(node.get("description")).and_then(Value::as_str).unwrap_or("");
        let _ = write!(page, "\n## `{name}`\n\n{told}\n");
        rows(&mut page, &schema, node, defaults.get(name).unwrap_or(&Value::Null), name);
    }
    page
}

/// The keys of a table as a Markdown table; tables below it follow.
fn rows(page: &mut String, schema: &Value, node: &Value, defaults: &Value, path: &str) {
    let Some(properties) = properties(node) else { return };
    let mut below = Vec::new();
    let mut first = true;
    for (key, property) in properties {
        let target = follow(schema, property);
        if self::properties(target).is_some_and(|p| !p.contains_key("fail")) {
            below.push((key, property, target));
            continue;
        }
        if first {
            page.push_str("\n| key | default | meaning |\n|---|---|---|\n");
            first = false;
        }
        let told = property.get("description").or(target.get("description")).and_then(Value::as_str).unwrap_or("");
        let default = match defaults.get(key) {
            None | Some(Value::Null) => "automatic".to_owned(),
            Some(value) => format!("`{value}`"),
        };
        let _ = writeln!(page, "| `{key}` | {default} | {} |", told.replace('\n', " ").replace('|', "\\|"));
    }
    for (key, property, target) in below {
        let told = property.get("description").or(target.get("description")).and_then(Value::as_str).unwrap_or("");
        let _ = write!(page, "\n### `{path}.{key}`\n\n{told}\n");
        // Methods that are not the default have no values in the defaults; their schema does.
        let own = defaults.get(key).cloned().unwrap_or_else(|| defaults_of(target));
        rows(page, schema, target, &own, &format!("{path}.{key}"));
    }
}

fn properties(node: &Value) -> Option<&serde_json::Map<String, Value>> {
    node.get("properties").and_then(Value::as_object).or_else(|| {
        let alternatives = node.get("anyOf").or(node.get("oneOf"))?.as_array()?;
        alternatives.iter().find_map(|a| a.get("properties")?.as_object())
    })
}

fn follow<'a>(schema: &'a Value, node: &'a Value) -> &'a Value {
    let reference = node.get("$ref").and_then(Value::as_str).and_then(|r| r.strip_prefix("#/$defs/"));
    reference.and_then(|name| schema.get("$defs")?.get(name)).unwrap_or(node)
}

fn defaults_of(node: &Value) -> Value {
    let of = |(key, property): (&String, &Value)| Some((key.clone(), property.get("default")?.clone()));
    properties(node).map(|p| p.iter().filter_map(of).collect()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_in_docs_is_current() {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/pipeline_reference.md");
        if std::env::var_os("ADIT_RENEW_DOCS").is_some() {
            std::fs::write(&file, reference()).unwrap();
        }
        let page = std::fs::read_to_string(&file).unwrap_or_default();
        assert!(page == reference(), "renew it: ADIT_RENEW_DOCS=1 cargo test reference");
    }
}
