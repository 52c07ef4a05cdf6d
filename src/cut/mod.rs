//! Cutting the tube open: from a [`Mesh`] to a [`Strip`] of disk topology.

mod floor;
mod seam;

pub use floor::{FloorSummary, without_floor};
pub use seam::{FloorChoice, Settings, Summary, open};

use crate::mesh::{Mesh, topology};

/// A mesh of genus 0 with one component and one outer boundary loop, possibly with hole loops inside.
#[derive(Clone, Debug, PartialEq)]
pub struct Strip {
    mesh: Mesh,
    /// `loops[0]` is the outer loop.
    loops: Vec<Vec<u32>>,
}

/// Why a mesh is no strip.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// No faces at all.
    #[error("the mesh has no faces")]
    Empty,
    /// More than one connected component.
    #[error(
        "the mesh falls into {components} components; keep one (the largest has {largest} faces; face {stray} is not of it)"
    )]
    Components {
        /// How many components.
        components: usize,
        /// Faces of the largest.
        largest: usize,
        /// The first face of another one.
        stray: u32,
    },
    /// No boundary: a closed surface cannot be flattened without a cut.
    #[error("the mesh is closed: it needs a cut before it can be flattened")]
    Closed,
    /// Handles or cross-caps remain.
    #[error(
        "the mesh has genus {genus}: {loops} boundary loops and Euler characteristic {euler}; it must be cut further"
    )]
    Genus {
        /// Number of handles.
        genus: i64,
        /// Boundary loops.
        loops: usize,
        /// Vertices - edges + faces.
        euler: i64,
    },
    /// The mesh is no tube around the axis: a tube has two borders (or one and a closed end) that run around it once.
    #[error(
        "the mesh is no tube around the axis: its borders wind {turns:?} times around it, where one or two should once; check the axis and side branches"
    )]
    Portals {
        /// Turns of each border that winds around the axis at all.
        turns: Vec<i64>,
    },
    /// A border still winds around the axis after the cut.
    #[error("the border at vertex {vertex} still winds {turns} times around the axis after the cut")]
    NotOpened {
        /// A vertex of the border.
        vertex: u32,
        /// Its turns.
        turns: i64,
    },
    /// The seam angle is not a number.
    #[error("cut setting 'seam_angle_deg' is {value}, but must be an angle in degrees")]
    Setting {
        /// The value given.
        value: f64,
    },
}

impl Strip {
    /// Proves disk topology (with holes). The outer loop is the one with the longest 3D length.
    ///
    /// # Errors
    /// [`Error`] tells what else the mesh is.
    pub fn from_disk(mesh: Mesh) -> Result<Self, Error> {
        if mesh.faces().is_empty() {
            return Err(Error::Empty);
        }
        let twin = mesh.twins();
        let (component, count) = topology::components(twin);
        if count > 1 {
            let mut sizes = vec![0usize; count];
            component.iter().for_each(|&c| sizes[c as usize] += 1);
            let largest = (0..count).rev().max_by_key(|&c| sizes[c]).unwrap_or(0);
            let stray = component.iter().position(|&c| c as usize != largest).unwrap_or(0) as u32;
            return Err(Error::Components { components: count, largest: sizes[largest], stray });
        }
        let mut loops = topology::boundary_loops(mesh.faces(), twin);
        if loops.is_empty() {
            return Err(Error::Closed);
        }
        let boundary = twin.iter().filter(|&&t| t == topology::NO_TWIN).count() as i64;
        let edges = (twin.len() as i64 + boundary) / 2;
        let used = {
            let mut used = vec![false; mesh.vertices().len()];
            mesh.faces().iter().flatten().for_each(|&v| used[v as usize] = true);
            used.into_iter().filter(|&u| u).count() as i64
        };
        let euler = used - edges + mesh.faces().len() as i64;
        // chi = 2 - 2 genus - loops
        let genus = (2 - loops.len() as i64 - euler) / 2;
        if genus != 0 {
            return Err(Error::Genus { genus, loops: loops.len(), euler });
        }
        let length = |l: &Vec<u32>| -> f64 {
            (0..l.len())
                .map(|i| (mesh.vertices()[l[i] as usize] - mesh.vertices()[l[(i + 1) % l.len()] as usize]).norm())
                .sum()
        };
        let outer = (0..loops.len()).max_by(|&a, &b| length(&loops[a]).total_cmp(&length(&loops[b])).then(b.cmp(&a)));
        loops.swap(0, outer.unwrap_or(0));
        Ok(Self { mesh, loops })
    }

    /// The cut mesh.
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// The outer boundary loop, surface on its left.
    pub fn outer_loop(&self) -> &[u32] {
        &self.loops[0]
    }

    /// The loops around holes, surface on their left.
    pub fn hole_loops(&self) -> &[Vec<u32>] {
        &self.loops[1..]
    }

    /// The mesh, given back.
    pub fn into_mesh(self) -> Mesh {
        self.mesh
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::Vec3;

    /// A band of `n` quads around a circle: an annulus, or a strip when left open.
    fn band(n: u32, closed: bool) -> Mesh {
        let columns = if closed { n } else { n + 1 };
        let vertices = (0..columns)
            .flat_map(|i| {
                let a = f64::from(i) * 6.0 / f64::from(n);
                [Vec3::new(a.cos(), a.sin(), 0.0), Vec3::new(a.cos(), a.sin(), 1.0)]
            })
            .collect();
        let faces = (0..n)
            .flat_map(|i| {
                let (a, b) = (2 * i, 2 * ((i + 1) % columns));
                [[a, b, b + 1], [a, b + 1, a + 1]]
            })
            .collect();
        Mesh::all_observed(vertices, faces).unwrap()
    }

    #[test]
    fn an_open_band_is_a_strip() {
        let strip = Strip::from_disk(band(8, false)).unwrap();
        assert_eq!(strip.outer_loop().len(), 18);
        assert!(strip.hole_loops().is_empty());
    }

    #[test]
    fn a_closed_band_counts_as_a_disk_with_a_hole() {
        // An uncut tube is planar topologically; whether it is *opened* is the seam's business.
        assert_eq!(Strip::from_disk(band(8, true)).unwrap().hole_loops().len(), 1);
    }

    #[test]
    fn a_closed_surface_is_refused() {
        let v = vec![Vec3::zeros(), Vec3::x(), Vec3::y(), Vec3::z()];
        let mesh = Mesh::all_observed(v, vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]).unwrap();
        assert_eq!(Strip::from_disk(mesh), Err(Error::Closed));
    }
}
