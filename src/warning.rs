//! Warnings are values: every fallback, repair and dropped point ends up in the report through this type.

use serde::{Deserialize, Serialize};

/// Something a person should know about a result that was still produced.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Warning {
    /// Stable machine-readable name, `kebab-case`, e.g. `f32-coordinates`.
    pub code: String,
    /// One sentence for a person: what was seen (with numbers), what was done about it, what the remedy is.
    pub message: String,
}

impl Warning {
    /// A warning with a stable `code` and a sentence for a person.
    pub fn new(code: &str, message: impl Into<String>) -> Self {
        Self { code: code.to_owned(), message: message.into() }
    }
}
