//! Unfolding: moves the vertices of flipped faces, and as few others as needed, until every face is counter-clockwise.
//!
//! Use it to make an almost flip-free chart a valid start for methods that keep faces from flipping. It does not make a
//! good map out of a bad one: where it moves vertices, distortion is whatever the neighbours allow.
//!
//! Flipped faces are gathered with a margin of one ring of faces. Inside this patch each vertex moves to the weighted
//! mean of its neighbours, everything outside stays; for a convex patch that gives a valid embedding (Tutte, "How to
//! draw a graph", Proc. London Math. Soc. 13, 1963, doi:10.1112/plms/s3-13.1.743). Patches are not convex in general,
//! so the margin grows ring by ring until nothing is flipped or the limit is reached. What is tangled over more than that
//! is laid anew by `patch_embedding` inside ever wider margins; each patch is taken over only if it has fewer flips then.
//! A chart with more than a fifth of its faces flipped is left as it is. Deterministic: vertices move in index order, in
//! place. Cost: linear in the size of the patches, and a sparse factorisation of those of the second kind.

use super::distortion::orientation;
use super::patch_embedding::embed;
use crate::mesh::{Mesh, topology};
use crate::numeric::Vec2;
use rayon::prelude::*;

/// Widest margin around a flipped face, in rings of faces.
const WIDEST_MARGIN: usize = 12;
/// Margins around what is still flipped then, in rings of faces.
const EMBEDDING_MARGINS: [usize; 4] = [16, 32, 64, 128];
/// How often both are done.
const ROUNDS: usize = 2;
/// Above this share of flipped faces there is no chart to mend: it is left as it is.
const MOST_FOLDED: f64 = 0.2;
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
    if bad.is_empty() || bad.len() as f64 > MOST_FOLDED * faces.len() as f64 {
        return result;
    }
    let around = faces_around(mesh);
    let twin = mesh.twins();
    let original = uv.to_vec();
    let mut best = (bad.len(), original.clone());
    // Laid anew, a patch is even inside; what then still folds at its rim is a matter for the sweeps again.
    for _ in 0..ROUNDS {
        for margin in 1..=WIDEST_MARGIN {
            let (patch, in_patch) = rings_around(mesh, &around, &bad, margin);
            // A vertex moves when all its faces are in the patch; vertices on the border of the strip slide along it.
            let vertices = inner_vertices(mesh, &around, &patch, &in_patch);
            for _ in 0..SWEEPS {
                for &v in &vertices {
                    uv[v as usize] = neighbour_mean(mesh, uv, &around, twin, v);
                }
            }
            bad = flipped(uv);
            if bad.is_empty() {
                break;
            }
        }
        if bad.len() < best.0 {
            best = (bad.len(), uv.to_vec());
        }
        for margin in EMBEDDING_MARGINS {
            if bad.is_empty() {
                break;
            }
            let (patch, in_patch) = rings_around(mesh, &around, &bad, margin);
            let mut is_free = vec![false; uv.len()];
            inner_vertices(mesh, &around, &patch, &in_patch).into_iter().for_each(|v| is_free[v as usize] = true);
            // What the solver refuses stays flipped, and is counted.
            let Ok(Some(moved)) = embed(mesh, &is_free, uv) else { break };
            for piece in connected(&patch, &in_patch, twin) {
                let flips = |uv: &[Vec2]| {
                    piece.iter().filter(|&&f| orientation(faces[f as usize].map(|v| uv[v as usize])) <= 0.0).count()
                };
                if flips(&moved) < flips(uv) {
                    for v in piece.iter().flat_map(|&f| faces[f as usize]).filter(|&v| is_free[v as usize]) {
                        uv[v as usize] = moved[v as usize];
                    }
                }
            }
            bad = flipped(uv);
        }
        if bad.len() < best.0 {
            best = (bad.len(), uv.to_vec());
        }
        if bad.is_empty() {
            break;
        }
    }
    result.flipped_after = best.0;
    uv.copy_from_slice(&best.1);
    result.moved_vertices = uv.iter().zip(&original).filter(|(a, b)| a != b).count();
    result
}

/// All faces within `margin` rings of the given ones, ascending, and a flag for each face.
fn rings_around(mesh: &Mesh, around: &FacesAround, given: &[u32], margin: usize) -> (Vec<u32>, Vec<bool>) {
    let faces = mesh.faces();
    let mut in_patch = vec![false; faces.len()];
    let mut patch = given.to_vec();
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
    (patch, in_patch)
}

/// Vertices of the patch whose faces all belong to it, ascending.
fn inner_vertices(mesh: &Mesh, around: &FacesAround, patch: &[u32], in_patch: &[bool]) -> Vec<u32> {
    let mut vertices: Vec<u32> = patch.iter().flat_map(|&f| mesh.faces()[f as usize]).collect();
    vertices.sort_unstable();
    vertices.dedup();
    vertices.retain(|&v| around.of(v).iter().all(|&f| in_patch[f as usize]));
    vertices
}

/// The pieces of the patch that hang together over edges.
fn connected(patch: &[u32], in_patch: &[bool], twin: &[u32]) -> Vec<Vec<u32>> {
    let mut left = in_patch.to_vec();
    let mut pieces = Vec::new();
    for &start in patch {
        if !std::mem::replace(&mut left[start as usize], false) {
            continue;
        }
        let mut piece = vec![start];
        let mut done = 0;
        while done < piece.len() {
            let f = piece[done];
            done += 1;
            for across in (3 * f..3 * f + 3).map(|edge| twin[edge as usize]).filter(|&t| t != topology::NO_TWIN) {
                if std::mem::replace(&mut left[across as usize / 3], false) {
                    piece.push(across / 3);
                }
            }
        }
        pieces.push(piece);
    }
    pieces
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

    /// A sheet of `n` x `n` squares with a hole of 6 x 6 in its middle.
    fn sheet_with_hole(n: u32) -> Mesh {
        let vertices: Vec<Vec3> =
            (0..=n).flat_map(|i| (0..=n).map(move |j| Vec3::new(f64::from(i), f64::from(j), 0.0))).collect();
        let hole = |i: u32, j: u32| (n / 2 - 3..n / 2 + 3).contains(&i) && (n / 2 - 3..n / 2 + 3).contains(&j);
        let squares = (0..n).flat_map(|i| (0..n).map(move |j| (i, j))).filter(|&(i, j)| !hole(i, j));
        let faces = squares
            .flat_map(|(i, j)| {
                let a = i * (n + 1) + j;
                [[a, a + n + 1, a + n + 2], [a, a + n + 2, a + 1]]
            })
            .collect();
        Mesh::all_observed(vertices, faces).unwrap()
    }

    #[test]
    fn a_tangle_around_a_hole_is_laid_anew_and_the_hole_keeps_its_room() {
        let n = 100;
        let mesh = sheet_with_hole(n);
        let mut uv: Vec<Vec2> = mesh.vertices().iter().map(|p| p.xy()).collect();
        // Everything within 15 of the middle is mirrored.
        let middle = Vec2::new(f64::from(n) / 2.0, f64::from(n) / 2.0);
        uv.iter_mut().filter(|p| (**p - middle).norm() < 15.0).for_each(|p| p.x = 2.0 * middle.x - p.x);
        assert!(flipped_faces(&mesh, &uv).0 > 100);
        let result = unfold(&mesh, &mut uv);
        assert_eq!((result.flipped_after, flipped_faces(&mesh, &uv)), (0, (0, 0)), "{result:?}");
        let corner = |i: u32, j: u32| uv[(i * (n + 1) + j) as usize];
        assert!((corner(47, 47) - corner(53, 53)).norm() > 1.0, "{:?} {:?}", corner(47, 47), corner(53, 53));
        assert!((uv[0] - Vec2::zeros()).norm() == 0.0, "far from the tangle nothing moves");
    }

    #[test]
    fn a_tangle_at_the_border_is_laid_anew() {
        let n = 100;
        let mesh = sheet_with_hole(n);
        let mut uv: Vec<Vec2> = mesh.vertices().iter().map(|p| p.xy()).collect();
        let middle = Vec2::new(0.0, 30.0);
        uv.iter_mut().filter(|p| (**p - middle).norm() < 14.0).for_each(|p| p.y = 2.0 * middle.y - p.y);
        assert!(flipped_faces(&mesh, &uv).0 > 50);
        let result = unfold(&mesh, &mut uv);
        assert_eq!((result.flipped_after, flipped_faces(&mesh, &uv)), (0, (0, 0)), "{result:?}");
    }

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
