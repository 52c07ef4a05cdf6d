//! The module list in `src/lib.rs` is the architecture: a module uses only modules above it.

use std::fs;
use std::path::{Path, PathBuf};

fn modules() -> Vec<String> {
    let lib = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("src/lib.rs")).unwrap();
    lib.lines().filter_map(|l| l.strip_prefix("pub mod ")?.strip_suffix(';')).map(str::to_owned).collect()
}

fn rust_files(folder: &Path, found: &mut Vec<PathBuf>) {
    let mut entries: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        if path.is_dir() {
            rust_files(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

/// Names directly after `crate::` in a source text, tests excluded (they may look anywhere).
fn used_modules(source: &str) -> Vec<String> {
    let code = source.split("#[cfg(test)]").next().unwrap();
    let mut used = Vec::new();
    for line in code.lines().filter(|l| !l.trim_start().starts_with("//")) {
        for (at, _) in line.match_indices("crate::") {
            let rest = &line[at + "crate::".len()..];
            let names: Vec<&str> = match rest.strip_prefix('{') {
                Some(list) => list
                    .split(['}', ';'])
                    .next()
                    .unwrap()
                    .split(',')
                    .map(|p| p.trim().split("::").next().unwrap())
                    .collect(),
                None => vec![rest.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap()],
            };
            used.extend(names.into_iter().filter(|n| !n.is_empty()).map(str::to_owned));
        }
    }
    used
}

#[test]
fn modules_only_use_modules_above_them() {
    let modules = modules();
    assert!(modules.len() > 10, "the module list of lib.rs was not found: {modules:?}");
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut broken = Vec::new();
    for (rank, module) in modules.iter().enumerate() {
        let mut files = Vec::new();
        let folder = src.join(module);
        if folder.is_dir() {
            rust_files(&folder, &mut files);
        } else {
            files.push(src.join(format!("{module}.rs")));
        }
        for file in files {
            for used in used_modules(&fs::read_to_string(&file).unwrap()) {
                if let Some(other) = modules.iter().position(|m| *m == used).filter(|&other| other > rank) {
                    broken.push(format!(
                        "{}: '{module}' uses '{}', which lies below it",
                        file.display(),
                        modules[other]
                    ));
                }
            }
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn only_the_edges_touch_files_and_only_cli_prints() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    rust_files(&src, &mut files);
    let mut broken = Vec::new();
    for file in files {
        let name = file.strip_prefix(&src).unwrap().to_string_lossy().replace('\\', "/");
        let source = fs::read_to_string(&file).unwrap();
        let code = source.split("#[cfg(test)]").next().unwrap();
        let may_touch_files = ["io/", "pipeline/", "viewer/", "cli/", "main.rs"].iter().any(|p| name.starts_with(p));
        if !may_touch_files && code.contains("std::fs") {
            broken.push(format!("{name} touches files"));
        }
        let may_print = name.starts_with("cli/") || name == "main.rs";
        if !may_print && ["println!", "eprintln!", "print!("].iter().any(|p| code.contains(p)) {
            broken.push(format!("{name} prints"));
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}
