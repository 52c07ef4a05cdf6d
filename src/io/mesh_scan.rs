//! A mesh as a file gives it: triangles of valid vertices, not yet proved to be a manifold.

use super::detect::{self, Format};
use super::error::{COPY_AGAIN, Error};
use super::file_scan::whole_units;
use super::source_bytes::SourceBytes;
use super::{assemble, mesh_formats, ply};
use crate::cloud::ScanFrame;
use crate::numeric::{Vec2, Vec3};
use crate::warning::Warning;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// A mesh as a file gives it, in local metres of its frame.
#[derive(Clone, Debug, PartialEq)]
pub struct RawMesh {
    /// Takes local metres to the coordinates in the file.
    pub frame: ScanFrame,
    /// Vertex positions, local metres; all finite.
    pub vertices: Vec<Vec3>,
    /// Corners of each triangle: valid and different vertices. Not proved to be a manifold.
    pub faces: Vec<[u32; 3]>,
    /// Chart or texture coordinates, one a vertex, where the file has them.
    pub uv: Option<Vec<Vec2>>,
    /// Whether a face is observed, where the file says so.
    pub observed: Option<Vec<bool>>,
}

/// What was read from a mesh file.
#[derive(Clone, Debug, Serialize)]
pub struct MeshSummary {
    /// The file.
    pub path: PathBuf,
    /// Its format, e.g. `OBJ`.
    pub format: &'static str,
    /// Vertices.
    pub vertices: usize,
    /// Triangles.
    pub faces: usize,
    /// Polygons with more than three corners that were split into triangles.
    pub split_polygons: usize,
    /// Faces dropped because they name a vertex twice or have fewer than three corners.
    pub degenerate_faces: usize,
    /// Vertices merged because they repeat a position (formats without shared vertices only).
    pub merged_vertices: usize,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Collects a mesh while a reader walks its file.
#[derive(Debug)]
pub(super) struct MeshBuilder {
    pub(super) format: &'static str,
    pub(super) vertices: Vec<Vec3>,
    pub(super) uv: Vec<Vec2>,
    pub(super) observed_vertices: Vec<bool>,
    faces: Vec<[u32; 3]>,
    observed: Vec<bool>,
    pub(super) frame: Option<ScanFrame>,
    pub(super) single_precision: bool,
    split_polygons: usize,
    degenerate_faces: usize,
    pub(super) merged_vertices: usize,
    pub(super) warnings: Vec<Warning>,
}

impl MeshBuilder {
    pub(super) fn new(format: &'static str) -> Self {
        Self {
            format,
            vertices: Vec::new(),
            uv: Vec::new(),
            observed_vertices: Vec::new(),
            faces: Vec::new(),
            observed: Vec::new(),
            frame: None,
            single_precision: false,
            split_polygons: 0,
            degenerate_faces: 0,
            merged_vertices: 0,
            warnings: Vec::new(),
        }
    }

    /// Adds a polygon as a fan of triangles.
    pub(super) fn polygon(&mut self, corners: &[f64], observed: Option<bool>) -> Result<(), String> {
        let index = |c: f64| -> Result<u32, String> {
            if (0.0..f64::from(u32::MAX)).contains(&c) && c.fract() == 0.0 {
                Ok(c as u32)
            } else {
                Err(format!("'{c}' is no vertex index"))
            }
        };
        if corners.len() < 3 {
            self.degenerate_faces += 1;
            return Ok(());
        }
        self.split_polygons += usize::from(corners.len() > 3);
        let first = index(corners[0])?;
        for pair in corners[1..].windows(2) {
            self.triangle([first, index(pair[0])?, index(pair[1])?], observed);
        }
        Ok(())
    }

    /// Adds a triangle strip; a negative index restarts it.
    pub(super) fn strip(&mut self, strip: &[f64]) -> Result<(), String> {
        let mut flip = false;
        let mut run: Vec<f64> = Vec::new();
        for &index in strip {
            if index < 0.0 {
                run.clear();
                flip = false;
                continue;
            }
            run.push(index);
            if let [.., a, b, c] = run[..] {
                self.polygon(&if flip { [b, a, c] } else { [a, b, c] }, None)?;
                flip = !flip;
            }
        }
        Ok(())
    }

    pub(super) fn triangle(&mut self, corners: [u32; 3], observed: Option<bool>) {
        let [a, b, c] = corners;
        if a == b || b == c || c == a {
            self.degenerate_faces += 1;
            return;
        }
        self.faces.push(corners);
        self.observed.extend(observed);
    }

    pub(super) fn face_count(&self) -> usize {
        self.faces.len()
    }

    /// Checks indices and coordinates and moves the mesh into a local frame.
    pub(super) fn finish(mut self, path: &Path) -> Result<(RawMesh, MeshSummary), Error> {
        let n = self.vertices.len();
        for (face, corners) in self.faces.iter().enumerate() {
            if let Some(corner) = corners.iter().find(|&&c| c as usize >= n) {
                let cause = format!("face {face} names vertex {corner}, but there are {n} vertices");
                return Err(Error::bad(path, cause, COPY_AGAIN));
            }
        }
        if let Some(bad) = self.vertices.iter().position(|v| !v.iter().all(|c| c.is_finite())) {
            let v = self.vertices[bad];
            let cause = format!("vertex {bad} is not finite ({}, {}, {})", v.x, v.y, v.z);
            return Err(Error::bad(path, cause, "repair or export the mesh again"));
        }
        if self.degenerate_faces > 0 {
            self.warnings.push(Warning::new(
                "degenerate-faces",
                format!(
                    "{} faces name a vertex twice or have fewer than three corners; dropped",
                    self.degenerate_faces
                ),
            ));
        }
        let frame = self.frame.take().unwrap_or_else(|| {
            let (mut low, mut high) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
            for v in &self.vertices {
                low = low.inf(v);
                high = high.sup(v);
            }
            if n == 0 { ScanFrame::local() } else { ScanFrame::with_origin(whole_units(&((low + high) / 2.0))) }
        });
        for v in &mut self.vertices {
            *v = frame.local_from_scan(v);
        }
        let summary = MeshSummary {
            path: path.to_owned(),
            format: self.format,
            vertices: n,
            faces: self.faces.len(),
            split_polygons: self.split_polygons,
            degenerate_faces: self.degenerate_faces,
            merged_vertices: self.merged_vertices,
            warnings: self.warnings,
        };
        let observed_vertices = (self.observed_vertices.len() == n && n > 0).then_some(self.observed_vertices);
        let observed = if self.observed.len() == self.faces.len() && !self.faces.is_empty() {
            Some(self.observed)
        } else {
            // A face is observed when all its vertices are.
            observed_vertices.map(|o| self.faces.iter().map(|f| f.iter().all(|&c| o[c as usize])).collect())
        };
        let uv = (self.uv.len() == n && n > 0).then_some(self.uv);
        Ok((RawMesh { frame, vertices: self.vertices, faces: self.faces, uv, observed }, summary))
    }
}

/// Reads a triangle mesh; polygons are split into triangles.
///
/// Nothing is proved about its topology: that is the work of [`crate::mesh::Mesh::new`].
///
/// # Errors
/// [`Error`] for files that cannot be read, without faces, with indices out of range or coordinates that are not finite.
pub fn read_mesh(path: &Path) -> Result<(RawMesh, MeshSummary), Error> {
    assemble::contained(path, || {
        let source = SourceBytes::open(path)?;
        let builder = read_mesh_source(&source)?;
        if builder.face_count() == 0 {
            return Err(Error::bad(path, "it has no faces", "name a mesh, or use `adit run` for a point cloud"));
        }
        builder.finish(path)
    })
}

/// Reads a mesh from an opened file; it may have no faces.
pub(super) fn read_mesh_source(source: &SourceBytes) -> Result<MeshBuilder, Error> {
    match detect::format_of(source)? {
        Format::Ply => ply::read_mesh(source),
        Format::Obj => mesh_formats::obj(source),
        Format::Off => mesh_formats::off(source),
        Format::Stl => mesh_formats::stl(source),
        Format::Glb => mesh_formats::glb(source),
        _ => {
            let remedy = "name a PLY, OBJ, OFF, STL or GLB, or use `adit run` for point clouds";
            Err(Error::unsupported(source.path(), "it is a point cloud, not a mesh", remedy))
        }
    }
}
