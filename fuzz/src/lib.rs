//! One input through every entrance that Adit has for its format.
//!
//! Errors are fine, whatever they say. What is looked for: panics in Adit's own code, aborts, hangs, and memory that
//! the size of the file does not explain. Panics of other crates are contained by the readers and end as errors.

pub mod seeds;

use adit::io;
use std::path::PathBuf;

/// A reader that is fuzzed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    Las,
    Laz,
    Ply,
    E57,
    Ptx,
    Text,
    Pcd,
    Mesh,
}

impl Target {
    pub const ALL: [Self; 8] =
        [Self::Las, Self::Laz, Self::Ply, Self::E57, Self::Ptx, Self::Text, Self::Pcd, Self::Mesh];

    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|t| t.name() == name)
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Las => "las",
            Self::Laz => "laz",
            Self::Ply => "ply",
            Self::E57 => "e57",
            Self::Ptx => "ptx",
            Self::Text => "text",
            Self::Pcd => "pcd",
            Self::Mesh => "mesh",
        }
    }

    /// Extension of the file that carries the input; meshes are told apart by their first bytes.
    fn extension(self, bytes: &[u8]) -> &'static str {
        match self {
            Self::Text => "xyz",
            Self::Mesh if bytes.starts_with(b"glTF") => "glb",
            Self::Mesh if bytes.starts_with(b"solid") || bytes.starts_with(b" ") => "stl",
            Self::Mesh if bytes[..bytes.len().min(8)].windows(3).any(|w| w == b"OFF") => "off",
            Self::Mesh => "obj",
            other => other.name(),
        }
    }
}

/// Reads the input as a scan, looks into it as `adit info` does, and as a mesh where it could be one.
pub fn read(target: Target, bytes: &[u8]) {
    // The readers use positioned reads of files; a file in memory costs little.
    let folder = if cfg!(target_os = "linux") { PathBuf::from("/dev/shm") } else { std::env::temp_dir() };
    let path = folder.join(format!("adit-fuzz-{}.{}", std::process::id(), target.extension(bytes)));
    std::fs::write(&path, bytes).expect("a file in memory");
    let lenient = io::Settings { allow_truncated: true, ..Default::default() };
    // The results do not matter, only that there are some.
    let _ = io::inspect(&path, &io::Settings::default());
    match target {
        Target::Mesh => drop(io::read_mesh(&path)),
        Target::Ply => {
            let _ = io::read_cloud(std::slice::from_ref(&path), &lenient);
            let _ = io::read_mesh(&path);
        }
        _ => drop(io::read_cloud(std::slice::from_ref(&path), &lenient)),
    }
    let _ = std::fs::remove_file(&path);
}
