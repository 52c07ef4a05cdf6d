//! Unfolding: moves the vertices of flipped faces, and as few others as needed, until every face is counter-clockwise.
//!
//! Use it to make an almost flip-free chart a valid start for methods that keep faces from flipping. It does not make a
//! good map out of a bad one: where it moves vertices, distortion is whatever the neighbours allow.
//!
//! Flipped faces are gathered with a margin of one ring of faces. Inside this patch each vertex moves to the weighted
//! mean of its neighbours, everything outside stays; for a convex patch that gives a valid embedding (Tutte, "How to
//! draw a graph", Proc. London Math. Soc. 13, 1963, doi:10.1112/plms/s3-13.1.743). Patches are not convex in general,
//! so the margin grows ring by ring until nothing is flipped or the limit is reached.
//! Deterministic: vertices move in index order, in place. Cost: linear in the size of the patches.

use super::distortion::orientation;
use crate::mesh::{Mesh, topology};
use crate::numeric::Vec2;
use rayon::prelude::*;

/// Widest margin around a flipped face, in rings of faces.
const WIDEST_MARGIN: usize = 12;
/// Relaxation sweeps for each margin.
const SWEEPS: usize = 60;

/// What unfolding did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unfolded {
    /// Faces not counter-clockwise before.
    pub flipped_before: usize,
    /// Faces not counter-clockwise after.
    pub flipped_after: usize,
    /// Vertices that moved.
    pub moved_vertices: usize,
}

/// Unfolds `uv` in place; see the module.
pub fn unfold(mesh: &Mesh, uv: &mut [Vec2]) -> Unfolded {
    let faces = mesh.faces();
    let flipped = |uv: &[Vec2]| -> Vec<u32> {
        (0..faces.len() as u32)
            .into_par_iter()
            .filter(|&f| orientation(faces[f as usize].map(|v| uv[v as usize])) <= 0.0)
            .collect()
    };
    let mut bad = flipped(uv);
    let mut result = Unfolded { flipped_before: bad.len(), flipped_after: bad.len(), moved_vertices: 0 };
    if bad.is_empty() {
        return result;
    }
    let around = faces_around(mesh);
    let twin = topology::twins(faces).expect("a Mesh is manifold");
    let original = uv.to_vec();
    for margin in 1..=WIDEST_MARGIN {
        // All faces within `margin` rings of a flipped one.
        let mut in_patch = vec![false; faces.len()];
        let mut patch = bad.clone();
        patch.iter().for_each(|&f| in_patch[f as usize] = true);
        let mut front = patch.clone();
        for _ in 0..margin {
            let mut next = Vec::new();
            for &f in &front {
                for &v in &faces[f as usize] {
                    for &g in around.of(v) {
                        if !std::mem::replace(&mut in_patch[g as usize], true) {
                            next.push(g);
                        }
                    }
                }
            }
            patch.extend_from_slice(&next);
            front = next;
        }
        patch.sort_unstable();
        // A vertex moves when all its faces are in the patch; vertices on the border of the strip slide along it.
        let mut vertices: Vec<u32> = patch.iter().flat_map(|&f| faces[f as usize]).collect();
        vertices.sort_unstable();
        vertices.dedup();
        vertices.retain(|&v| around.of(v).iter().all(|&f| in_patch[f as usize]));
        for _ in 0..SWEEPS {
            for &v in &vertices {
                uv[v as usize] = neighbour_mean(mesh, uv, &around, &twin, v);
            }
        }
        bad = flipped(uv);
        if bad.is_empty() {
            break;
        }
    }
    result.flipped_after = bad.len();
    if result.flipped_after >= result.flipped_before {
        // Worse than nothing: give the input back.
        uv.copy_from_slice(&original);
        result.flipped_after = result.flipped_before;
    }
    result.moved_vertices = uv.iter().zip(&original).filter(|(a, b)| a != b).count();
    result
}

/// Mean of the neighbours with weights 1 / edge length on the surface; on the border only of the border neighbours.
fn neighbour_mean(mesh: &Mesh, uv: &[Vec2], around: &FacesAround, twin: &[u32], v: u32) -> Vec2 {
    let (mut inner, mut inner_weight) = (Vec2::zeros(), 0.0);
    let (mut border, mut border_weight) = (Vec2::zeros(), 0.0);
    for &f in around.of(v) {
        let corners = mesh.faces()[f as usize];
        let i = corners.iter().position(|&c| c == v).expect("the face is around the vertex") as u32;
        let (leaving, arriving) = (3 * f + i, topology::previous(3 * f + i));
        for (edge, other) in [(leaving, corners[(i as usize + 1) % 3]), (arriving, corners[(i as usize + 2) % 3])] {
            let length = (mesh.vertices()[v as usize] - mesh.vertices()[other as usize]).norm();
            let weight = 1.0 / length.max(1e-9);
            if twin[edge as usize] == topology::NO_TWIN {
                border += uv[other as usize] * weight;
                border_weight += weight;
            } else {
                // Inner edges are met from both their faces.
                inner += uv[other as usize] * (weight / 2.0);
                inner_weight += weight / 2.0;
            }
        }
    }
    if border_weight > 0.0 { border / border_weight } else { inner / inner_weight }
}

/// For each vertex its faces, in compressed rows.
struct FacesAround {
    start: Vec<u32>,
    faces: Vec<u32>,
}

impl FacesAround {
    fn of(&self, v: u32) -> &[u32] {
        &self.faces[self.start[v as usize] as usize..self.start[v as usize + 1] as usize]
    }
}

fn faces_around(mesh: &Mesh) -> FacesAround {
    let mut start = vec![0u32; mesh.vertices().len() + 1];
    mesh.faces().iter().flatten().for_each(|&v| start[v as usize + 1] += 1);
    for i in 1..start.len() {
        start[i] += start[i - 1];
    }
    let mut fill = start.clone();
    let mut faces = vec![0u32; mesh.faces().len() * 3];
    for (f, corners) in mesh.faces().iter().enumerate() {
        for &v in corners {
            faces[fill[v as usize] as usize] = f as u32;
            fill[v as usize] += 1;
        }
    }
    FacesAround { start, faces }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::Vec3;
    use crate::unwrap::distortion::flipped_faces;

    #[test]
    fn a_folded_vertex_is_put_back_and_the_rest_stays() {
        let n = 20u32;
        let vertices: Vec<Vec3> =
            (0..=n).flat_map(|i| (0..=n).map(move |j| Vec3::new(f64::from(i), f64::from(j), 0.0))).collect();
        let faces = (0..n)
            .flat_map(|i| {
                (0..n).flat_map(move |j| {
                    let a = i * (n + 1) + j;
                    [[a, a + n + 1, a + n + 2], [a, a + n + 2, a + 1]]
                })
            })
            .collect();
        let mesh = Mesh::all_observed(vertices, faces).unwrap();
        let mut uv: Vec<Vec2> = mesh.vertices().iter().map(|p| p.xy()).collect();
        let moved = (10 * (n + 1) + 10) as usize;
        uv[moved].x += 2.5;
        assert!(flipped_faces(&mesh, &uv).0 > 0);
        let result = unfold(&mesh, &mut uv);
        assert_eq!(result.flipped_after, 0);
        assert_eq!(flipped_faces(&mesh, &uv), (0, 0));
        assert!(result.moved_vertices < 100, "{result:?}");
        assert!((uv[0] - Vec2::zeros()).norm() == 0.0);
    }
}
