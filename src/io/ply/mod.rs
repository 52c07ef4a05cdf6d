//! PLY: clouds and meshes in ASCII and binary, in all dialects that are met in practice.
//!
//! When to use: clouds with arbitrary scalar columns, and all meshes that Adit writes.
//! Reference: G. Turk, *The PLY Polygon File Format* (1994); the dialects are those of CloudCompare (`scalar_*`
//! columns), MeshLab, Blender and PDAL (`float64`, `obj_info`, `\r\n`, counts that precede unknown elements).
//! Guarantees: counts are checked against the file before memory is taken; every property of a rewritten cloud keeps
//! its bytes.
//! Cost: binary vertices without lists decode in parallel straight into columns; text and lists are walked in order.

mod header;
mod mesh;
mod placed_points;
mod read;
mod rewrite;
mod stream;

pub(super) use header::announced_vertices;
pub(super) use mesh::read_mesh;
pub use mesh::{PlyMesh, RawMesh, read_chart, write_mesh};
pub(super) use placed_points::placed_points;
pub(super) use read::{describe, read};
pub(super) use rewrite::{rewrite, write_new};
pub(super) use stream::stream;
