//! Small repairs that turn a list of oriented triangles into one oriented manifold: every change is counted.

use super::topology::{self, NO_TWIN};
use super::{FaceId, VertexId};
use crate::numeric::Vec3;

/// Gives each fan of faces around a vertex a vertex of its own; returns how many vertices were added.
///
/// Edges must already be manifold (at most two faces, in opposite directions).
pub fn split_fans(vertices: &mut Vec<Vec3>, faces: &mut [[VertexId; 3]]) -> usize {
    let Ok(twin) = topology::twins(faces) else { return 0 };
    let mut owner = vec![false; vertices.len()];
    let mut done = vec![false; twin.len()];
    let before = vertices.len();
    for corner in 0..twin.len() as u32 {
        if done[corner as usize] {
            continue;
        }
        let vertex = faces[(corner / 3) as usize][(corner % 3) as usize];
        let taken = std::mem::replace(&mut owner[vertex as usize], true);
        let id = if taken { vertices.len() as VertexId } else { vertex };
        if taken {
            vertices.push(vertices[vertex as usize]);
            owner.push(true);
        }
        for c in topology::fan(&twin, corner) {
            done[c as usize] = true;
            faces[(c / 3) as usize][(c % 3) as usize] = id;
        }
    }
    vertices.len() - before
}

/// Removes triangles that hang on the surface by less than one edge, until none is left.
pub fn trim_dangling(faces: Vec<[VertexId; 3]>, observed: Vec<bool>) -> (Vec<[VertexId; 3]>, Vec<bool>) {
    let Ok(twin) = topology::twins(&faces) else { return (faces, observed) };
    let mut gone = vec![false; faces.len()];
    let mut stack: Vec<FaceId> = (0..faces.len() as FaceId).collect();
    while let Some(f) = stack.pop() {
        if gone[f as usize] {
            continue;
        }
        let neighbours: Vec<FaceId> = (3 * f..3 * f + 3)
            .map(|c| twin[c as usize])
            .filter(|&t| t != NO_TWIN && !gone[(t / 3) as usize])
            .map(|t| t / 3)
            .collect();
        if neighbours.is_empty() {
            gone[f as usize] = true;
            stack.extend(neighbours);
        }
    }
    let keep = |f: usize| !gone[f];
    let observed = observed.into_iter().enumerate().filter(|(f, _)| keep(*f)).map(|(_, o)| o).collect();
    let faces = faces.into_iter().enumerate().filter(|(f, _)| keep(*f)).map(|(_, c)| c).collect();
    (faces, observed)
}

/// The largest component of a mesh, and what was left out.
#[derive(Clone, Debug)]
pub struct Largest {
    /// Vertices in use.
    pub vertices: Vec<Vec3>,
    /// Faces of the component.
    pub faces: Vec<[VertexId; 3]>,
    /// One flag a face.
    pub observed: Vec<bool>,
    /// Number of other components.
    pub components_dropped: usize,
    /// Faces in them.
    pub faces_dropped: usize,
}

/// Keeps the component with the most faces (the first of equals) and the vertices it uses, in their order.
pub fn keep_largest(vertices: Vec<Vec3>, faces: Vec<[VertexId; 3]>, observed: Vec<bool>) -> Largest {
    let (component, count) = match topology::twins(&faces) {
        Ok(twin) => topology::components(&twin),
        Err(_) => (vec![0; faces.len()], 1),
    };
    let mut size = vec![0usize; count];
    component.iter().for_each(|&c| size[c as usize] += 1);
    let best = (0..count).max_by(|&a, &b| size[a].cmp(&size[b]).then(b.cmp(&a))).unwrap_or(0) as u32;
    let faces_before = faces.len();
    let (faces, observed): (Vec<_>, Vec<_>) =
        faces.into_iter().zip(observed).zip(&component).filter(|(_, c)| **c == best).map(|(face, _)| face).unzip();
    let faces_dropped = faces_before - faces.len();
    let (vertices, faces) = compact(vertices, faces);
    Largest { vertices, faces, observed, components_dropped: count.saturating_sub(1), faces_dropped }
}

/// Leaves out vertices that no face uses; the others keep their order.
pub fn compact(vertices: Vec<Vec3>, mut faces: Vec<[VertexId; 3]>) -> (Vec<Vec3>, Vec<[VertexId; 3]>) {
    let mut id = vec![VertexId::MAX; vertices.len()];
    faces.iter().flatten().for_each(|&v| id[v as usize] = 0);
    let mut kept = Vec::with_capacity(vertices.len());
    for (v, position) in vertices.into_iter().enumerate() {
        if id[v] == 0 {
            id[v] = kept.len() as VertexId;
            kept.push(position);
        }
    }
    faces.iter_mut().flatten().for_each(|v| *v = id[*v as usize]);
    (kept, faces)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Mesh;

    fn points(n: usize) -> Vec<Vec3> {
        (0..n).map(|i| Vec3::new(i as f64, (i * i) as f64, 0.0)).collect()
    }

    #[test]
    fn touching_fans_get_vertices_of_their_own() {
        let mut vertices = points(5);
        let mut faces = vec![[0, 1, 2], [0, 3, 4]];
        assert_eq!(split_fans(&mut vertices, &mut faces), 1);
        assert_eq!(vertices[5], vertices[0]);
        Mesh::all_observed(vertices, faces).unwrap();
    }

    #[test]
    fn the_largest_component_is_kept_and_the_rest_counted() {
        let kept = keep_largest(points(8), vec![[0, 1, 2], [3, 4, 5], [4, 7, 5]], vec![true, true, false]);
        assert_eq!((kept.faces, kept.observed), (vec![[0, 1, 2], [1, 3, 2]], vec![true, false]));
        assert_eq!((kept.components_dropped, kept.faces_dropped, kept.vertices.len()), (1, 1, 4));
    }

    #[test]
    fn lonely_triangles_are_trimmed() {
        let (faces, observed) = trim_dangling(vec![[0, 1, 2], [2, 1, 3], [4, 5, 6]], vec![true, false, true]);
        assert_eq!((faces.len(), observed), (2, vec![true, false]));
    }
}
