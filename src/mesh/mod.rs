//! Triangle meshes: plain indexed arrays plus derived topology.

pub mod reconstruct;
pub mod openings;
mod wall_line;
pub mod borders;
pub mod section;
pub mod poisson;
mod void_side;
mod surface_nets;
pub mod repair;
mod caps;
mod handles;
mod narrow;
mod fill;
pub mod decimate;
pub mod anchor;
pub mod nearest_face;
pub mod surface_point;
pub mod topology;

pub use borders::Borders;
pub use reconstruct::{Method, Settings, Summary, is_in_pieces, reconstruct, sample_faces, take_over};
pub use surface_point::SurfacePoint;

use crate::numeric::Vec3;

/// Index of a vertex in a [`Mesh`].
pub type VertexId = u32;
/// Index of a face in a [`Mesh`].
pub type FaceId = u32;

/// A triangle mesh in local metres: manifold and consistently oriented (proved by [`Mesh::new`]).
///
/// Faces of a tunnel mesh run counter-clockwise seen from inside the tunnel: normals face the void.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    vertices: Vec<Vec3>,
    faces: Vec<[VertexId; 3]>,
    observed: Vec<bool>,
    twins: Vec<u32>,
}

/// Why arrays do not form a mesh.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// A coordinate is NaN or infinite.
    #[error("vertex {vertex} is not finite")]
    NotFinite {
        /// The vertex.
        vertex: VertexId,
    },
    /// A face names a vertex that does not exist, or one vertex twice.
    #[error("face {face} has corners {corners:?}, but there are {vertex_count} vertices and corners must differ")]
    BadFace {
        /// The face.
        face: FaceId,
        /// Its corners.
        corners: [VertexId; 3],
        /// Number of vertices.
        vertex_count: usize,
    },
    /// An edge has more than two faces, or two faces that run through it in the same direction.
    #[error(
        "edge {from}-{to} is used twice in the same direction (faces {first} and {second}): not an oriented manifold"
    )]
    NotManifoldEdge {
        /// Start of the half-edge.
        from: VertexId,
        /// End of the half-edge.
        to: VertexId,
        /// One face.
        first: FaceId,
        /// The other face.
        second: FaceId,
    },
    /// The faces around a vertex form more than one fan.
    #[error("vertex {vertex} joins {fans} separate fans of faces: not a manifold")]
    NotManifoldVertex {
        /// The vertex.
        vertex: VertexId,
        /// How many fans meet there.
        fans: usize,
    },
    /// `observed` has not one value a face.
    #[error("{found} observed flags for {expected} faces")]
    Observed {
        /// Flags given.
        found: usize,
        /// Faces given.
        expected: usize,
    },
}

impl Mesh {
    /// Proves that the faces form an oriented manifold, possibly with boundary and several components.
    ///
    /// `observed` tells for each face whether scan points support it (`false`: filled in).
    ///
    /// # Errors
    /// [`Error`] names the first vertex, face or edge that breaks the proof.
    pub fn new(vertices: Vec<Vec3>, faces: Vec<[VertexId; 3]>, observed: Vec<bool>) -> Result<Self, Error> {
        if let Some(vertex) = vertices.iter().position(|v| !v.iter().all(|c| c.is_finite())) {
            return Err(Error::NotFinite { vertex: vertex as VertexId });
        }
        if observed.len() != faces.len() {
            return Err(Error::Observed { found: observed.len(), expected: faces.len() });
        }
        let twins = topology::check_manifold(vertices.len(), &faces)?;
        Ok(Self { vertices, faces, observed, twins })
    }

    /// A mesh whose faces are all observed; see [`Mesh::new`].
    ///
    /// # Errors
    /// As [`Mesh::new`].
    pub fn all_observed(vertices: Vec<Vec3>, faces: Vec<[VertexId; 3]>) -> Result<Self, Error> {
        let observed = vec![true; faces.len()];
        Self::new(vertices, faces, observed)
    }

    /// The same surface seen from its other side.
    pub fn reversed(mut self) -> Self {
        // With corners 1 and 2 swapped, half-edge i becomes half-edge 2 - i of its face.
        let turned = |c: u32| if c == topology::NO_TWIN { c } else { c - c % 3 + 2 - c % 3 };
        self.faces.iter_mut().for_each(|f| f.swap(1, 2));
        self.twins.chunks_exact_mut(3).for_each(|t| t.swap(0, 2));
        self.twins.iter_mut().for_each(|t| *t = turned(*t));
        self
    }

    /// The same faces on other vertices: what is proved of the faces holds on.
    ///
    /// Panics unless there is one finite place for each vertex.
    pub fn moved_to(&self, vertices: Vec<Vec3>) -> Self {
        assert_eq!(vertices.len(), self.vertices.len());
        assert!(vertices.iter().all(|v| v.iter().all(|c| c.is_finite())), "a place is not finite");
        Self { vertices, faces: self.faces.clone(), observed: self.observed.clone(), twins: self.twins.clone() }
    }

    /// Vertex positions, local metres.
    pub fn vertices(&self) -> &[Vec3] {
        &self.vertices
    }

    /// Corners of each face.
    pub fn faces(&self) -> &[[VertexId; 3]] {
        &self.faces
    }

    /// Whether scan points support the face, one value a face.
    pub fn observed(&self) -> &[bool] {
        &self.observed
    }

    /// For each half-edge the opposite one, [`topology::NO_TWIN`] on the boundary; half-edge `3 f + i` leaves corner `i` of face
    /// `f`.
    pub fn twins(&self) -> &[u32] {
        &self.twins
    }

    /// The three corner positions of a face.
    pub fn corners(&self, face: FaceId) -> [Vec3; 3] {
        self.faces[face as usize].map(|v| self.vertices[v as usize])
    }

    /// Twice the area vector of a face: its direction is the normal, its length twice the area.
    pub fn double_area_vector(&self, face: FaceId) -> Vec3 {
        let [a, b, c] = self.corners(face);
        (b - a).cross(&(c - a))
    }

    /// Area-weighted unit normals at the vertices; zero where all incident faces are degenerate.
    pub fn vertex_normals(&self) -> Vec<Vec3> {
        let mut normals = vec![Vec3::zeros(); self.vertices.len()];
        for (face, corners) in self.faces.iter().enumerate() {
            let area = self.double_area_vector(face as FaceId);
            for &v in corners {
                normals[v as usize] += area;
            }
        }
        for n in &mut normals {
            *n = n.try_normalize(0.0).unwrap_or_else(Vec3::zeros);
        }
        normals
    }

    /// Total area in square metres.
    pub fn area(&self) -> f64 {
        (0..self.faces.len()).map(|f| self.double_area_vector(f as FaceId).norm() / 2.0).sum()
    }

    /// For each vertex, whether at least one incident face is observed.
    pub fn observed_vertices(&self) -> Vec<bool> {
        let mut observed = vec![false; self.vertices.len()];
        for (corners, &seen) in self.faces.iter().zip(&self.observed) {
            for &v in corners {
                observed[v as usize] |= seen;
            }
        }
        observed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reversed_mesh_is_the_one_made_of_reversed_faces() {
        let v = vec![Vec3::zeros(), Vec3::x(), Vec3::y(), Vec3::z()];
        let faces = vec![[0, 2, 1], [0, 1, 3], [1, 2, 3]];
        let turned = faces.iter().map(|&[a, b, c]| [a, c, b]).collect();
        let mesh = Mesh::all_observed(v.clone(), faces).unwrap();
        assert_eq!(mesh.clone().reversed(), Mesh::all_observed(v, turned).unwrap());
        assert_eq!(mesh.clone().reversed().reversed(), mesh);
    }
}
