//! What stages hand to each other and keep in the run folder.

use super::checkpoint::{self, Checkpoint};
use super::error::Error;
use super::run_folder;
use crate::cloud::ScanFrame;
use crate::io::ply::{PlyMesh, write_mesh};
use crate::mesh::Mesh;
use crate::numeric::Vec2;
use crate::segment::{Floor, Quality, SectionField, VertexQuality};
use crate::unwrap::Chart;
use crate::{cut, map};
use std::path::Path;

/// The surface, the mean section that it deviates from, and what the points told about both.
pub(super) struct Surface {
    pub mesh: Mesh,
    pub section: SectionField,
    /// Where the walls meet the floor; empty without a floor.
    pub feet: Vec<map::Feet>,
    pub floor: Option<Floor>,
    /// `None` when the run started from a mesh.
    pub points: Option<SurfacePoints>,
}

/// What the points of a scan told about the surface.
pub(super) struct SurfacePoints {
    pub quality: Quality,
    /// The class of each scan point.
    pub class_of_point: Vec<u8>,
}

/// Where the points of the scan lie on the map.
pub(super) struct PlacedPoints {
    /// Chainage and girth; NaN without a place.
    pub uv: Vec<Vec2>,
    /// Distance from the surface, metres.
    pub offsets_m: Vec<f64>,
}

impl Checkpoint for PlacedPoints {
    fn save(&self, columns: &mut checkpoint::Writer) {
        self.uv.save(columns);
        columns.put("offsets", &self.offsets_m);
    }

    fn load(columns: &checkpoint::Reader) -> Result<Self, checkpoint::Error> {
        Ok(Self { uv: Checkpoint::load(columns)?, offsets_m: columns.get("offsets")? })
    }
}

impl Checkpoint for Surface {
    fn save(&self, columns: &mut checkpoint::Writer) {
        self.mesh.save(columns);
        self.section.save(columns);
        columns.put("feet", &self.feet);
        columns.put("has floor and points", &[[u8::from(self.floor.is_some()), u8::from(self.points.is_some())]]);
        if let Some(floor) = &self.floor {
            floor.save(columns);
        }
        if let Some(points) = &self.points {
            points.quality.save(columns);
            columns.put("class of point", &points.class_of_point);
        }
    }

    fn load(columns: &checkpoint::Reader) -> Result<Self, checkpoint::Error> {
        let [has_floor, has_points] = columns.one::<[u8; 2]>("has floor and points")?;
        let points = || -> Result<SurfacePoints, checkpoint::Error> {
            Ok(SurfacePoints { quality: Quality::load(columns)?, class_of_point: columns.get("class of point")? })
        };
        Ok(Self {
            mesh: Mesh::load(columns)?,
            section: SectionField::load(columns)?,
            feet: columns.get("feet")?,
            floor: (has_floor != 0).then(|| Floor::load(columns)).transpose()?,
            points: (has_points != 0).then(points).transpose()?,
        })
    }
}

impl Checkpoint for Chart {
    fn save(&self, columns: &mut checkpoint::Writer) {
        self.strip().mesh().save(columns);
        self.uv().to_vec().save(columns);
    }

    fn load(columns: &checkpoint::Reader) -> Result<Self, checkpoint::Error> {
        let strip = cut::Strip::load(columns)?;
        Chart::new(strip, Checkpoint::load(columns)?).map_err(|e| columns.damaged(e))
    }
}

pub(super) fn write_text(stage: &'static str, path: &Path, text: &str) -> Result<(), Error> {
    std::fs::write(path, text).map_err(cannot_write(stage, path))
}

pub(super) fn write_ply(
    stage: &'static str,
    path: &Path,
    frame: &ScanFrame,
    mesh: &Mesh,
    uv: Option<&[Vec2]>,
    quality: Option<&VertexQuality>,
) -> Result<(), Error> {
    let observed = mesh.observed_vertices();
    let ply = PlyMesh {
        frame,
        vertices: mesh.vertices(),
        uv,
        faces: mesh.faces(),
        observed_vertices: Some(&observed),
        observed_faces: Some(mesh.observed()),
        quality,
    };
    write_mesh(&ply, path).map_err(Error::in_stage(stage))
}

pub(super) fn cannot_write(stage: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    move |source| Error::in_stage(stage)(run_folder::Error::Io { action: "write", path: path.to_owned(), source })
}
