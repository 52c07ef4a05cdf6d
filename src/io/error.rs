//! Why a file could not be read or written: always the file, the cause with its numbers, and a remedy.

use std::path::{Path, PathBuf};

/// What kind of failure an [`Error`] is; the command line maps it to an exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorKind {
    /// The input is missing, broken or unusable.
    BadInput,
    /// The input is sound but Adit does not read it.
    Unsupported,
    /// A product could not be written.
    Output,
    /// A setting makes no sense for the input.
    Settings,
}

/// Why a file could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused to open or read an input.
    #[error("cannot read '{path}': {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// The content of a file contradicts itself or its format.
    #[error("'{path}' cannot be used: {cause}; {remedy}", path = path.display())]
    BadInput {
        /// The file.
        path: PathBuf,
        /// What is wrong, with record numbers and values.
        cause: String,
        /// What to do about it.
        remedy: String,
    },
    /// The file is sound but of a kind that is not read.
    #[error("'{path}' is not supported: {cause}; {remedy}", path = path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What is not supported.
        cause: String,
        /// What to do about it.
        remedy: String,
    },
    /// A product could not be written.
    #[error("cannot write '{path}': {source}", path = path.display())]
    Write {
        /// The destination.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// What should be written does not fit the destination.
    #[error("cannot write '{path}': {cause}; {remedy}", path = path.display())]
    Output {
        /// The destination.
        path: PathBuf,
        /// What does not fit.
        cause: String,
        /// What to do about it.
        remedy: String,
    },
    /// A setting does not fit the input.
    #[error("{key}: {cause}; {remedy}")]
    Settings {
        /// The setting.
        key: &'static str,
        /// Why it does not fit.
        cause: String,
        /// What to do about it.
        remedy: String,
    },
}

impl Error {
    /// What kind of failure this is.
    pub fn kind(&self) -> ErrorKind {
        match self {
            Self::Read { .. } | Self::BadInput { .. } => ErrorKind::BadInput,
            Self::Unsupported { .. } => ErrorKind::Unsupported,
            Self::Write { .. } | Self::Output { .. } => ErrorKind::Output,
            Self::Settings { .. } => ErrorKind::Settings,
        }
    }

    pub(super) fn read(path: &Path, source: std::io::Error) -> Self {
        Self::Read { path: path.to_owned(), source }
    }

    pub(super) fn bad(path: &Path, cause: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::BadInput { path: path.to_owned(), cause: cause.into(), remedy: remedy.into() }
    }

    pub(super) fn unsupported(path: &Path, cause: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Unsupported { path: path.to_owned(), cause: cause.into(), remedy: remedy.into() }
    }

    pub(super) fn write(path: &Path, source: std::io::Error) -> Self {
        Self::Write { path: path.to_owned(), source }
    }

    pub(super) fn output(path: &Path, cause: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Output { path: path.to_owned(), cause: cause.into(), remedy: remedy.into() }
    }
}

/// The remedy for a file that was cut off or damaged on its way here.
pub(super) const COPY_AGAIN: &str = "copy or export the file again";
