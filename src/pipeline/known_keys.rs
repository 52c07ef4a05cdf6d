//! Which keys a pipeline file may have, read from the JSON schema of its settings, and the nearest one to a misspelt one.

use serde_json::Value;

/// The keys of a schema node, by path.
pub(super) struct KnownKeys {
    schema: Value,
}

impl KnownKeys {
    pub(super) fn of(schema: schemars::Schema) -> Self {
        Self { schema: schema.into() }
    }

    /// Whether `path` names a key; below a node whose children the schema leaves open, everything is known.
    pub(super) fn contains(&self, path: &[&str]) -> bool {
        let mut nodes = vec![&self.schema];
        for key in path {
            let mut children = Vec::new();
            let mut open = true;
            for node in nodes.iter().flat_map(|n| self.variants(n)) {
                if let Some(properties) = node.get("properties").and_then(Value::as_object) {
                    open = false;
                    children.extend(properties.get(*key));
                }
            }
            if open {
                return true;
            }
            if children.is_empty() {
                return false;
            }
            nodes = children;
        }
        true
    }

    /// The keys directly below `path`, in the schema's order.
    pub(super) fn children(&self, path: &[&str]) -> Vec<String> {
        let mut nodes = vec![&self.schema];
        for key in path {
            let variants: Vec<&Value> = nodes.iter().flat_map(|n| self.variants(n)).collect();
            nodes = variants.into_iter().filter_map(|n| n.get("properties")?.get(*key)).collect();
        }
        let mut names = Vec::new();
        for node in nodes.iter().flat_map(|n| self.variants(n)) {
            if let Some(properties) = node.get("properties").and_then(Value::as_object) {
                names.extend(properties.keys().filter(|k| !names.contains(*k)).cloned().collect::<Vec<_>>());
            }
        }
        names
    }

    /// The known key most likely meant by the unknown `path`: a sibling that is spelt alike, or the same name elsewhere.
    pub(super) fn nearest(&self, path: &[&str]) -> Option<String> {
        let (wrong, parents) = path.split_last()?;
        let siblings = self.children(parents);
        let limit = (wrong.chars().count() / 3).max(1) + 1;
        let best = siblings.iter().map(|s| (edit_distance(wrong, s), s)).min();
        if let Some((distance, name)) = best.filter(|(d, _)| *d <= limit) {
            let _ = distance;
            return Some(parents.iter().copied().chain([name.as_str()]).collect::<Vec<_>>().join("."));
        }
        let mut everything = Vec::new();
        self.collect(&mut Vec::new(), &mut everything);
        everything
            .into_iter()
            .filter_map(|p| {
                let distance = edit_distance(wrong, p.last()?);
                (distance < limit).then(|| (distance, p.join(".")))
            })
            .min()
            .map(|(_, name)| name)
    }

    fn collect(&self, path: &mut Vec<String>, found: &mut Vec<Vec<String>>) {
        // Settings are at most a stage, a method and a key deep.
        if path.len() >= 3 {
            return;
        }
        let at: Vec<&str> = path.iter().map(String::as_str).collect();
        for child in self.children(&at) {
            path.push(child);
            found.push(path.clone());
            self.collect(path, found);
            path.pop();
        }
    }

    /// A node with its references followed and its alternatives spread out.
    fn variants<'a>(&'a self, node: &'a Value) -> Vec<&'a Value> {
        let mut found = Vec::new();
        let mut todo = vec![node];
        // Schemas of settings do not recurse; the bound keeps a mistake there from hanging.
        for _ in 0..1000 {
            let Some(node) = todo.pop() else { break };
            if let Some(name) = node.get("$ref").and_then(Value::as_str).and_then(|r| r.strip_prefix("#/$defs/")) {
                todo.extend(self.schema.get("$defs").and_then(|d| d.get(name)));
            }
            for alternatives in ["anyOf", "oneOf", "allOf"] {
                if let Some(list) = node.get(alternatives).and_then(Value::as_array) {
                    todo.extend(list);
                }
            }
            found.push(node);
        }
        found
    }
}

/// Insertions, deletions, replacements and swaps of neighbours that turn one word into the other.
fn edit_distance(a: &str, b: &str) -> usize {
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    let mut rows = vec![vec![0usize; b.len() + 1]; a.len() + 1];
    for i in 0..=a.len() {
        for j in 0..=b.len() {
            rows[i][j] = if i == 0 || j == 0 {
                i + j
            } else {
                let replaced = rows[i - 1][j - 1] + usize::from(a[i - 1] != b[j - 1]);
                let mut least = replaced.min(rows[i - 1][j] + 1).min(rows[i][j - 1] + 1);
                if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                    least = least.min(rows[i - 2][j - 2] + 1);
                }
                least
            };
        }
    }
    rows[a.len()][b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_count_single_slips() {
        assert_eq!(edit_distance("cel_m", "cell_m"), 1);
        assert_eq!(edit_distance("lsmc", "lscm"), 1);
        assert_eq!(edit_distance("map", "cut"), 3);
    }
}
