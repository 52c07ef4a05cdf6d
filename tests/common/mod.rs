//! What several integration tests need.

use std::process::Command;

/// The Python that lets other programs check products: `ADIT_TEST_PYTHON`, or `python3`. `None`, said aloud, if it cannot
/// import `modules`.
pub fn python_with(modules: &str) -> Option<String> {
    let python = std::env::var("ADIT_TEST_PYTHON").unwrap_or_else(|_| "python3".into());
    let found = Command::new(&python).args(["-c", &format!("import {modules}")]).output();
    if found.is_ok_and(|o| o.status.success()) {
        return Some(python);
    }
    eprintln!("SKIPPED: {python} has not all of {modules}; ADIT_TEST_PYTHON names another interpreter");
    None
}
