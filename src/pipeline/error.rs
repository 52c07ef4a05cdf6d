//! What keeps a run from finishing: which stage, what happened there, and whose problem it is.

use super::{checkpoint, preflight, run_folder, settings};
use crate::{axis, clean, cut, io, map, mesh, normals, segment, unwrap};

/// Whose problem an error is; the command line turns it into an exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The command line or the pipeline file.
    Usage,
    /// The input.
    BadInput,
    /// The input is sound, but of a kind that is not read.
    Unsupported,
    /// Memory, disk, or permission to write.
    Resources,
    /// A bug in Adit.
    Internal,
}

/// Why a run did not finish.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The pipeline file or an override.
    #[error(transparent)]
    Settings(#[from] settings::Error),
    /// No input was named.
    #[error("no input: name a scan with --input FILE, or with `input = [\"FILE\"]` in the pipeline file")]
    NoInput,
    /// A mesh among several files.
    #[error("{meshes} of the {files} input files are meshes: name one mesh, or only scans")]
    SeveralMeshes {
        /// How many are meshes.
        meshes: usize,
        /// How many files were named.
        files: usize,
    },
    /// A stage that does not exist.
    #[error("there is no stage '{name}'; there are {stages}")]
    NoStage {
        /// What was named.
        name: String,
        /// All names.
        stages: String,
    },
    /// The run would not fit into memory or on disk.
    #[error(transparent)]
    Preflight(#[from] preflight::Error),
    /// An input was written to while it was read.
    #[error("'{}' changed while it was read: run again when it has been copied completely", path.display())]
    InputChanged {
        /// The file.
        path: std::path::PathBuf,
    },
    /// The run folder cannot be used.
    #[error(transparent)]
    RunFolder(#[from] run_folder::Error),
    /// A stage refused its input.
    #[error("{stage}: {source}")]
    Stage {
        /// Name of the stage.
        stage: &'static str,
        /// Whose problem it is.
        kind: Kind,
        /// What the stage says.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A stage refused its input, and there is a picture of what it saw.
    #[error("{error}; what was seen is in {picture}")]
    Pictured {
        /// The refusal.
        error: Box<Error>,
        /// The picture in the run folder.
        picture: std::path::PathBuf,
    },
}

impl Error {
    /// Whose problem it is.
    pub fn kind(&self) -> Kind {
        match self {
            Self::Settings(_) | Self::NoInput | Self::SeveralMeshes { .. } | Self::NoStage { .. } => Kind::Usage,
            Self::Preflight(_) => Kind::Resources,
            Self::InputChanged { .. } => Kind::BadInput,
            Self::RunFolder(error) => error.kind(),
            Self::Stage { kind, .. } => *kind,
            Self::Pictured { error, .. } => error.kind(),
        }
    }

    /// The error of a stage, with the stage's name.
    pub fn in_stage<E: StageError>(stage: &'static str) -> impl Fn(E) -> Self {
        move |error| Self::Stage { stage, kind: error.kind(), source: Box::new(error) }
    }
}

/// Errors of stages, which know whose problem they are.
pub trait StageError: std::error::Error + Send + Sync + 'static {
    /// Whose problem it is.
    fn kind(&self) -> Kind;
}

impl StageError for io::Error {
    fn kind(&self) -> Kind {
        match io::Error::kind(self) {
            io::ErrorKind::BadInput => Kind::BadInput,
            io::ErrorKind::Unsupported => Kind::Unsupported,
            io::ErrorKind::Output => Kind::Resources,
            io::ErrorKind::Settings => Kind::Usage,
        }
    }
}

impl StageError for clean::Error {
    fn kind(&self) -> Kind {
        match self {
            clean::Error::Setting { .. } => Kind::Usage,
            clean::Error::TooManyPoints { .. } => Kind::Resources,
            _ => Kind::BadInput,
        }
    }
}

impl StageError for axis::Error {
    fn kind(&self) -> Kind {
        match self {
            axis::Error::Setting { .. } | axis::Error::EndNotReached { .. } => Kind::Usage,
            _ => Kind::BadInput,
        }
    }
}

impl StageError for normals::Error {
    fn kind(&self) -> Kind {
        match self {
            normals::Error::Neighbours { .. } => Kind::Usage,
            _ => Kind::BadInput,
        }
    }
}

impl StageError for segment::Error {
    fn kind(&self) -> Kind {
        match self {
            segment::Error::CodeTwice { .. } => Kind::Usage,
            _ => Kind::BadInput,
        }
    }
}

impl StageError for mesh::Error {
    fn kind(&self) -> Kind {
        Kind::BadInput
    }
}

impl StageError for mesh::reconstruct::Error {
    fn kind(&self) -> Kind {
        match self {
            mesh::reconstruct::Error::Setting { .. } | mesh::reconstruct::Error::NothingToDecimate => Kind::Usage,
            _ => Kind::BadInput,
        }
    }
}

impl StageError for cut::Error {
    fn kind(&self) -> Kind {
        match self {
            cut::Error::Setting { .. } => Kind::Usage,
            _ => Kind::BadInput,
        }
    }
}

impl StageError for unwrap::Error {
    fn kind(&self) -> Kind {
        match self {
            unwrap::Error::Setting { .. } => Kind::Usage,
            _ => Kind::BadInput,
        }
    }
}

impl StageError for map::Error {
    fn kind(&self) -> Kind {
        match self {
            map::Error::Sink(_) => Kind::Resources,
            _ => Kind::Usage,
        }
    }
}

impl StageError for run_folder::Error {
    fn kind(&self) -> Kind {
        run_folder::Error::kind(self)
    }
}

impl StageError for checkpoint::Error {
    fn kind(&self) -> Kind {
        Kind::Resources
    }
}
