//! Meshes in PLY: any dialect in, `mesh.ply` and `chart.ply` out.

use super::super::error::{COPY_AGAIN, Error};
use super::super::mesh_scan::{MeshBuilder, MeshSummary};
use super::super::source_bytes::SourceBytes;
use super::header::{Header, Kind};
use super::read::Walker;
use crate::cloud::ScanFrame;
use crate::numeric::{Vec2, Vec3};
use crate::segment::VertexQuality;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

pub use super::super::mesh_scan::RawMesh;

/// A mesh to be written; positions in local metres of `frame`.
#[derive(Clone, Copy, Debug)]
pub struct PlyMesh<'a> {
    /// Takes local metres to the scan coordinates that are written.
    pub frame: &'a ScanFrame,
    /// Vertex positions, local metres.
    pub vertices: &'a [Vec3],
    /// Chart coordinates (chainage, girth) in metres, one a vertex.
    pub uv: Option<&'a [Vec2]>,
    /// Corners of each face.
    pub faces: &'a [[u32; 3]],
    /// Whether scan points support the vertex, one value a vertex; all are observed when absent.
    pub observed_vertices: Option<&'a [bool]>,
    /// Whether scan points support the face, one value a face.
    pub observed_faces: Option<&'a [bool]>,
    /// How well the surface was measured at each vertex.
    pub quality: Option<&'a VertexQuality>,
}

/// Marks the comment that keeps the local frame, so that reading gives back the same local numbers.
const FRAME_COMMENT: &str = "comment adit_frame";

/// Writes a mesh as binary little endian PLY: vertex `double x y z [u v]`, `uchar observed`, `[float noise density
/// [incidence], uchar surface_class]`; face `list uchar int vertex_indices`, `[uchar observed]`. Positions are in scan
/// coordinates, `u v` and `noise` in metres, `density` in points a square metre, `incidence` in degrees.
///
/// # Errors
/// [`Error::Write`] when the operating system refuses.
pub fn write_mesh(mesh: &PlyMesh, path: &Path) -> Result<(), Error> {
    let write = || -> std::io::Result<()> {
        let mut out = BufWriter::with_capacity(1 << 20, File::create(path)?);
        let frame = mesh.frame;
        let o = frame.origin_in_scan;
        writeln!(out, "ply\nformat binary_little_endian 1.0")?;
        writeln!(out, "{FRAME_COMMENT} {:?} {:?} {:?} {:?}", o.x, o.y, o.z, frame.metres_per_unit)?;
        writeln!(out, "element vertex {}", mesh.vertices.len())?;
        let names: &[&str] = if mesh.uv.is_some() { &["x", "y", "z", "u", "v"] } else { &["x", "y", "z"] };
        for name in names {
            writeln!(out, "property double {name}")?;
        }
        writeln!(out, "property uchar observed")?;
        let incidence = mesh.quality.is_some_and(|q| !q.incidence_deg.is_empty());
        if mesh.quality.is_some() {
            writeln!(out, "property float noise\nproperty float density")?;
            if incidence {
                writeln!(out, "property float incidence")?;
            }
            writeln!(out, "property uchar surface_class")?;
        }
        writeln!(out, "element face {}\nproperty list uchar int vertex_indices", mesh.faces.len())?;
        if mesh.observed_faces.is_some() {
            writeln!(out, "property uchar observed")?;
        }
        writeln!(out, "end_header")?;
        for (i, vertex) in mesh.vertices.iter().enumerate() {
            for c in frame.scan_from_local(vertex).iter() {
                out.write_all(&c.to_le_bytes())?;
            }
            if let Some(uv) = mesh.uv {
                out.write_all(&uv[i].x.to_le_bytes())?;
                out.write_all(&uv[i].y.to_le_bytes())?;
            }
            out.write_all(&[mesh.observed_vertices.is_none_or(|o| o[i]).into()])?;
            if let Some(quality) = mesh.quality {
                out.write_all(&quality.noise_m[i].to_le_bytes())?;
                out.write_all(&quality.density_per_m2[i].to_le_bytes())?;
                if incidence {
                    out.write_all(&quality.incidence_deg[i].to_le_bytes())?;
                }
                out.write_all(&[quality.class[i]])?;
            }
        }
        for (i, face) in mesh.faces.iter().enumerate() {
            out.write_all(&[3])?;
            for corner in face {
                out.write_all(&corner.to_le_bytes())?;
            }
            if let Some(observed) = mesh.observed_faces {
                out.write_all(&[observed[i].into()])?;
            }
        }
        out.into_inner()?.sync_all()
    };
    write().map_err(|e| Error::write(path, e))
}

/// Reads `chart.ply` (or any PLY mesh with `u v`, `s t` or `texture_u texture_v` per vertex).
///
/// # Errors
/// As [`super::super::read_mesh`]; also when there are no chart coordinates.
pub fn read_chart(path: &Path) -> Result<(RawMesh, MeshSummary), Error> {
    let (mesh, summary) = super::super::read_mesh(path)?;
    if mesh.uv.is_none() {
        return Err(Error::bad(path, "its vertices have no chart coordinates u, v", "name a chart.ply"));
    }
    Ok((mesh, summary))
}

/// Reads a mesh from an opened PLY file.
pub(in super::super) fn read_mesh(source: &SourceBytes) -> Result<MeshBuilder, Error> {
    let header = &Header::read(source)?;
    let bytes = &source.up_to(header.data_at, usize::MAX)?;
    let path = source.path();
    let mut builder = MeshBuilder::new("PLY");
    builder.warnings.clone_from(&header.warnings);
    builder.frame = header.remarks.iter().find_map(|r| frame_of(r));
    let mut walker = Walker::new(source, header, bytes);
    let mut seen_vertices = false;
    for element in &header.elements {
        let find = |names: &[&str]| {
            names.iter().find_map(|n| element.properties.iter().position(|p| p.name.eq_ignore_ascii_case(n)))
        };
        match element.name.as_str() {
            "vertex" => {
                seen_vertices = true;
                let (Some(x), Some(y), Some(z)) = (find(&["x"]), find(&["y"]), find(&["z"])) else {
                    return Err(Error::bad(path, "its vertices have no coordinates x, y, z", COPY_AGAIN));
                };
                let u = find(&["u", "s", "texture_u"]);
                let v = find(&["v", "t", "texture_v"]);
                let observed = find(&["observed"]);
                builder.single_precision = element.properties[x].kind == Kind::Scalar(super::header::Scalar::F32);
                walker.rows(element, &mut |row| {
                    let s = &row.scalars;
                    builder.vertices.push(Vec3::new(s[x], s[y], s[z]));
                    if let (Some(u), Some(v)) = (u, v) {
                        builder.uv.push(Vec2::new(s[u], s[v]));
                    }
                    if let Some(observed) = observed {
                        builder.observed_vertices.push(s[observed] != 0.0);
                    }
                    Ok(())
                })?;
            }
            "face" => {
                let Some(indices) = find(&["vertex_indices", "vertex_index"]) else {
                    walker.skip(element)?;
                    continue;
                };
                let observed = find(&["observed"]);
                walker.rows(element, &mut |row| {
                    let Some((_, corners)) = row.lists.iter().find(|(place, _)| *place == indices) else {
                        return Err("the vertex indices are no list".into());
                    };
                    builder.polygon(corners, observed.map(|o| row.scalars[o] != 0.0))
                })?;
            }
            "tristrips" => {
                walker.rows(element, &mut |row| row.lists.iter().try_for_each(|(_, strip)| builder.strip(strip)))?;
            }
            _ => walker.skip(element)?,
        }
    }
    builder.warnings.extend(walker.warnings());
    if !seen_vertices {
        return Err(Error::bad(path, "it has no element 'vertex'", COPY_AGAIN));
    }
    Ok(builder)
}

fn frame_of(remark: &str) -> Option<ScanFrame> {
    let numbers: Vec<f64> =
        remark.strip_prefix(FRAME_COMMENT)?.split_whitespace().map(str::parse).collect::<Result<_, _>>().ok()?;
    let [x, y, z, metres_per_unit] = numbers[..] else { return None };
    let sane = numbers.iter().all(|n| n.is_finite()) && metres_per_unit > 0.0;
    sane.then(|| ScanFrame { metres_per_unit, ..ScanFrame::with_origin(Vec3::new(x, y, z)) })
}
