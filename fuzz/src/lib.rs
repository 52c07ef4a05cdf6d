//! One input through every entrance that Adit has for its format.
//!
//! Errors are fine, whatever they say. What is looked for: panics in Adit's own code, aborts, hangs, and memory that
//! the size of the file does not explain. Panics of other crates are contained by the readers and end as errors.

pub mod mutation;
pub mod seeds;

use adit::io;
use adit::numeric::Vec3;
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

fn is_finite(position: Vec3) -> bool {
    position.iter().all(|c| c.is_finite())
}

/// What a reader makes of an input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All of it is read.
    Accepted,
    /// A part of it is read, with a warning that the rest is missing.
    Partial,
    /// An error says why not.
    Refused,
}

/// Reads the input as a scan, looks into it as `adit info` does, through a window where there is an index, and as a mesh
/// where it could be one.
pub fn read(target: Target, bytes: &[u8]) -> Outcome {
    // The readers use positioned reads of files; a file in memory costs little.
    let folder = if cfg!(target_os = "linux") { PathBuf::from("/dev/shm") } else { std::env::temp_dir() };
    let path = folder.join(format!("adit-fuzz-{}.{}", std::process::id(), target.extension(bytes)));
    std::fs::write(&path, bytes).expect("a file in memory");
    let lenient = io::Settings { allow_truncated: true, ..Default::default() };
    // Of these only the fact that they end matters.
    let _ = io::inspect(&path, &io::Settings::default());
    let _ = io::announce(&path);
    if matches!(target, Target::Las | Target::Laz) {
        let window = io::ScanBox { low: Vec3::zeros(), high: Vec3::repeat(0.2) };
        let _ = io::stream_positions(&path, &lenient, Some(&window), &mut |_, _| {});
    }
    let as_mesh = || if io::read_mesh(&path).is_ok() { Outcome::Accepted } else { Outcome::Refused };
    let outcome = if target == Target::Mesh {
        as_mesh()
    } else {
        if target == Target::Ply {
            as_mesh();
        }
        match io::read_cloud(std::slice::from_ref(&path), &lenient) {
            Ok((cloud, _)) if !cloud.stations().iter().filter_map(|s| s.position_in_local).all(is_finite) => {
                panic!("a station without a place has one")
            }
            Ok((_, summary)) if summary.warnings.iter().any(|w| w.code == "truncated") => Outcome::Partial,
            Ok(_) => Outcome::Accepted,
            Err(_) => Outcome::Refused,
        }
    };
    let _ = std::fs::remove_file(&path);
    outcome
}
