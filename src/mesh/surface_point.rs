//! A point anchored to the surface: the hinge between scan and map.

use super::{FaceId, Mesh};
use crate::numeric::{Vec2, Vec3};

/// A point told by the surface: a place on a face and a signed distance from it.
///
/// 3D to 2D goes point -> surface point -> (u, v); 2D to 3D goes pixel -> surface point -> 3D. Both use the same anchor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// The face.
    pub face: FaceId,
    /// Weights of the face's corners, summing to 1.
    pub barycentric: [f64; 3],
    /// Metres along the interpolated vertex normal: positive into the void, negative behind the surface.
    pub offset: f64,
}

impl SurfacePoint {
    /// The anchored position in local metres. `normals` are the mesh's vertex normals ([`Mesh::vertex_normals`]).
    pub fn position(&self, mesh: &Mesh, normals: &[Vec3]) -> Vec3 {
        let corners = mesh.faces()[self.face as usize];
        let mut point = Vec3::zeros();
        let mut normal = Vec3::zeros();
        for (&v, w) in corners.iter().zip(self.barycentric) {
            point += mesh.vertices()[v as usize] * w;
            normal += normals[v as usize] * w;
        }
        if self.offset == 0.0 { point } else { point + normal.normalize() * self.offset }
    }

    /// The map coordinates of the anchor, given (u, v) of the vertices.
    pub fn in_chart(&self, mesh: &Mesh, uv: &[Vec2]) -> Vec2 {
        let corners = mesh.faces()[self.face as usize];
        corners.iter().zip(self.barycentric).fold(Vec2::zeros(), |sum, (&v, w)| sum + uv[v as usize] * w)
    }
}
