//! Flattening a strip: every method turns a [`Strip`] into a [`Chart`], (u, v) in metres for each vertex.
//!
//! The map is seen from inside: u runs with the chainage, v is the girth from the crown, positive over the right wall
//! (right when facing increasing chainage). Faces that run counter-clockwise seen from inside keep that sense in (u, v).

use crate::cut::Strip;
use crate::numeric::Vec2;

/// A strip with map coordinates at its vertices. Owns its strip, because the way back needs it.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    strip: Strip,
    uv: Vec<Vec2>,
}

/// Why a strip was not flattened.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// One (u, v) for each vertex is needed.
    #[error("{found} map coordinates for {expected} vertices")]
    Length {
        /// Coordinates given.
        found: usize,
        /// Vertices of the strip.
        expected: usize,
    },
    /// A map coordinate is NaN or infinite.
    #[error("vertex {vertex} has no finite map coordinate")]
    NotFinite {
        /// The vertex.
        vertex: u32,
    },
    /// The method needs to know the tunnel axis.
    #[error("method '{method}' needs the tunnel axis, and none was given or found")]
    NeedsAxis {
        /// Name of the method.
        method: &'static str,
    },
}

impl Chart {
    /// Proves one finite (u, v) for each vertex of the strip.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn new(strip: Strip, uv: Vec<Vec2>) -> Result<Self, Error> {
        let expected = strip.mesh().vertices().len();
        if uv.len() != expected {
            return Err(Error::Length { found: uv.len(), expected });
        }
        if let Some(vertex) = uv.iter().position(|p| !p.x.is_finite() || !p.y.is_finite()) {
            return Err(Error::NotFinite { vertex: vertex as u32 });
        }
        Ok(Self { strip, uv })
    }

    /// The strip that was flattened.
    pub fn strip(&self) -> &Strip {
        &self.strip
    }

    /// Map coordinates of each vertex, metres: x = u (chainage), y = v (girth from the crown).
    pub fn uv(&self) -> &[Vec2] {
        &self.uv
    }

    /// Map coordinates of the corners of a face.
    pub fn corners_in_chart(&self, face: u32) -> [Vec2; 3] {
        self.strip.mesh().faces()[face as usize].map(|v| self.uv[v as usize])
    }
}
