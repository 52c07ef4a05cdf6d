//! Exit codes, and errors that know theirs.

use std::fmt::Display;
use std::process::ExitCode;

/// How the process ends. The numbers are a promise to scripts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    /// Done.
    Done = 0,
    /// A bug in Adit.
    Internal = 1,
    /// Wrong command line or pipeline file.
    Usage = 2,
    /// The input is missing, damaged, or shows no tunnel.
    BadInput = 3,
    /// The input is sound, but of a kind that Adit does not read.
    Unsupported = 4,
    /// Finished, but a quality limit was broken; the products are kept and marked.
    LimitBroken = 5,
    /// Not enough memory or disk, or the output cannot be written.
    Resources = 6,
    /// Cancelled by the user.
    Cancelled = 7,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        ExitCode::from(exit as u8)
    }
}

/// Why a subcommand did not finish: the exit code, and the chain of causes from the outermost to the root.
#[derive(Debug)]
pub struct Failure {
    /// The exit code.
    pub exit: Exit,
    /// What happened, to whom, and what to do about it.
    pub error: anyhow::Error,
}

/// What a subcommand ends with.
pub type Result<T = Exit> = std::result::Result<T, Failure>;

impl Failure {
    /// A failure with its exit code and an error whose sources tell the causes.
    pub fn new(exit: Exit, error: impl Into<anyhow::Error>) -> Self {
        Self { exit, error: error.into() }
    }

    /// A failure told in one sentence.
    pub fn message(exit: Exit, message: impl Display) -> Self {
        Self { exit, error: anyhow::anyhow!("{message}") }
    }

    /// One line: the error and its causes, without saying anything twice.
    pub fn line(&self) -> String {
        let mut line = String::new();
        for cause in self.error.chain() {
            let text = cause.to_string().replace('\n', " ");
            // Some errors repeat their source in their own text.
            if !line.contains(&text) {
                if !line.is_empty() {
                    line.push_str(": ");
                }
                line.push_str(&text);
            }
        }
        line
    }
}

/// Turns the text of a panic into a request to report it. The exit code is set where the panic is caught.
pub(super) fn report_panics_as_internal_errors() {
    std::panic::set_hook(Box::new(|panic| {
        let payload = panic.payload();
        let text = payload
            .downcast_ref::<&str>()
            .map(ToString::to_string)
            .or_else(|| payload.downcast_ref::<String>().cloned())
            .unwrap_or_default();
        let place = panic.location().map(ToString::to_string).unwrap_or_default();
        super::console::to_stderr(&format!(
            "internal error, please report: {text} (adit {}, {place})",
            env!("CARGO_PKG_VERSION")
        ));
    }));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_is_one_line_without_repetition() {
        let root = std::io::Error::other("disk on\nfire");
        let failure =
            Failure { exit: Exit::Resources, error: anyhow::Error::new(root).context("cannot write x: disk on fire") };
        assert_eq!(failure.line(), "cannot write x: disk on fire");
    }
}
