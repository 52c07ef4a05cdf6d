//! Which stages a run has, from which files, and under which keys.

use super::error::Error;
use super::line::{self, Plan, Stage};
use super::run_folder::{self, sha256_of};
use super::settings::Pipeline;
use crate::io;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// The stages in their order. Raise a version when the stage gives other results for the same input.
pub const STAGES: &[Stage] = &[
    Stage { name: "ingest", version: 1, needs: &[] },
    Stage { name: "clean", version: 2, needs: &["ingest"] },
    Stage { name: "axis", version: 4, needs: &["clean"] },
    Stage { name: "normals", version: 3, needs: &["ingest", "clean", "axis"] },
    Stage { name: "segment", version: 6, needs: &["ingest", "clean", "axis"] },
    Stage { name: "mesh", version: 7, needs: &["segment", "normals", "axis"] },
    Stage { name: "cut", version: 2, needs: &["mesh", "axis"] },
    Stage { name: "unwrap", version: 4, needs: &["cut", "axis"] },
    Stage { name: "anchor", version: 4, needs: &["unwrap", "ingest"] },
    Stage { name: "map", version: 4, needs: &["anchor", "unwrap", "mesh", "ingest"] },
    Stage { name: "points", version: 2, needs: &["anchor", "mesh", "ingest"] },
    Stage { name: "profile", version: 1, needs: &["map", "anchor", "unwrap", "mesh", "axis"] },
];

/// The stages of a run that starts from a mesh.
pub const MESH_STAGES: &[Stage] = &[
    Stage { name: "ingest", version: 1, needs: &[] },
    Stage { name: "axis", version: 4, needs: &["ingest"] },
    Stage { name: "mesh", version: 7, needs: &["ingest", "axis"] },
    Stage { name: "cut", version: 2, needs: &["mesh", "axis"] },
    Stage { name: "unwrap", version: 4, needs: &["cut", "axis"] },
    Stage { name: "map", version: 3, needs: &["unwrap", "mesh", "ingest"] },
    Stage { name: "profile", version: 1, needs: &["map", "unwrap", "mesh", "axis"] },
];

/// A run that is known to be possible: which stages, from which files, under which keys.
pub(super) struct Prepared {
    pub from_mesh: bool,
    pub stages: &'static [Stage],
    pub input_hashes: Vec<String>,
    pub stamps: Stamps,
    pub plans: Vec<Plan>,
}

/// Length and time of the inputs from before they were hashed: tells whether somebody writes to them meanwhile.
pub(super) struct Stamps(Vec<(PathBuf, Option<(u64, SystemTime)>)>);

impl Stamps {
    fn of(files: &[PathBuf]) -> Self {
        Self(files.iter().map(|f| (f.clone(), stamp(f))).collect())
    }

    /// Refuses files that are not what they were.
    pub fn check(&self) -> Result<(), Error> {
        match self.0.iter().find(|(file, before)| stamp(file) != *before) {
            Some((path, _)) => Err(Error::InputChanged { path: path.clone() }),
            None => Ok(()),
        }
    }
}

fn stamp(file: &Path) -> Option<(u64, SystemTime)> {
    let found = std::fs::metadata(file).ok()?;
    Some((found.len(), found.modified().ok()?))
}

pub(super) fn prepare(pipeline: &Pipeline) -> Result<Prepared, Error> {
    if pipeline.input.is_empty() {
        return Err(Error::NoInput);
    }
    let stamps = Stamps::of(&pipeline.input);
    let input_hashes = hash_inputs(&pipeline.input)?;
    let alignment_hash = hash_inputs(pipeline.axis.alignment.as_slice())?;
    let poses_hash = hash_inputs(pipeline.ingest.poses.as_slice())?;
    let handles_file = pipeline.unwrap.method.handles_file();
    let handles_hash = hash_inputs(handles_file.map(std::slice::from_ref).unwrap_or_default())?;
    let profile_hash = hash_inputs(pipeline.map.design_profile.as_slice())?;
    let from_mesh = is_mesh(&pipeline.input)?;
    let stages = if from_mesh { MESH_STAGES } else { STAGES };
    let plans = line::plan(
        stages,
        |stage| pipeline.settings_of(stage),
        |stage| match stage {
            "ingest" => {
                let poses = poses_hash.iter().map(|h| ("poses".to_owned(), h.clone()));
                let files = input_hashes.iter().enumerate().map(|(i, h)| (format!("file {i}"), h.clone()));
                // A stretch of chainages means what the axis makes of it.
                let stretch = pipeline.ingest.chainage_m.into_iter().flat_map(|_| {
                    let settings = ("axis".to_owned(), pipeline.settings_of("axis").to_string());
                    alignment_hash.iter().map(|h| ("alignment".to_owned(), h.clone())).chain([settings])
                });
                files.chain(poses).chain(stretch).collect()
            }
            "axis" => alignment_hash.iter().map(|h| ("alignment".to_owned(), h.clone())).collect(),
            "unwrap" => handles_hash.iter().map(|h| ("handles".to_owned(), h.clone())).collect(),
            "map" => profile_hash.iter().map(|h| ("design profile".to_owned(), h.clone())).collect(),
            _ => BTreeMap::new(),
        },
    );
    Ok(Prepared { from_mesh, stages, input_hashes, stamps, plans })
}

/// Hashes of the input files; a file that cannot be read is bad input, told by its name.
fn hash_inputs(files: &[PathBuf]) -> Result<Vec<String>, Error> {
    let hash = |path: &PathBuf| {
        sha256_of(path).map_err(|error| match error {
            run_folder::Error::Io { path, source, .. } => Error::in_stage("ingest")(io::Error::Read { path, source }),
            other => other.into(),
        })
    };
    files.iter().map(hash).collect()
}

/// Whether the input is a mesh. Several files, one of them a mesh, make no sense together.
///
/// # Errors
/// [`Error::SeveralMeshes`].
pub fn is_mesh(inputs: &[PathBuf]) -> Result<bool, Error> {
    let extension = |p: &PathBuf| p.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let meshes = inputs.iter().filter(|path| match extension(path).as_str() {
        "obj" | "off" | "stl" | "glb" => true,
        "ply" => ply_has_faces(path),
        _ => false,
    });
    match (meshes.count(), inputs.len()) {
        (0, _) => Ok(false),
        (1, 1) => Ok(true),
        (meshes, files) => Err(Error::SeveralMeshes { meshes, files }),
    }
}

/// Whether the header of a PLY file announces faces. A file that does not read is left to the reader to complain about.
fn ply_has_faces(path: &Path) -> bool {
    let mut start = Vec::new();
    let read = std::fs::File::open(path).and_then(|f| f.take(65_536).read_to_end(&mut start));
    let text = String::from_utf8_lossy(&start);
    let count = |line: &str| line.trim().strip_prefix("element face")?.trim().parse::<u64>().ok();
    read.is_ok() && text.lines().take_while(|l| l.trim() != "end_header").filter_map(count).any(|n| n > 0)
}
