//! Small repairs that turn a list of oriented triangles into one oriented manifold: every change is counted.

use super::topology::{self, NO_TWIN};
use super::{FaceId, Mesh, VertexId, caps, fill, handles, narrow};
use crate::axis::Axis;
use crate::numeric::Vec3;
use serde::Serialize;
use std::collections::HashSet;

/// Rounds of cutting handles after which the rest is given up and told.
const MOST_ROUNDS: usize = 60;

/// Rounds of taking away what is narrow: closing what one stood on may leave another.
const NARROW_ROUNDS: usize = 3;
/// Most edges of a hole that is left by what was narrow.
const NARROW_RIM: usize = 24;

/// Gives each fan of faces around a vertex a vertex of its own; returns how many vertices were added.
///
/// Edges must already be manifold (at most two faces, in opposite directions).
pub fn split_fans(vertices: &mut Vec<Vec3>, faces: &mut [[VertexId; 3]]) -> usize {
    let Ok(twin) = topology::twins(faces) else { return 0 };
    split_fans_of(vertices, faces, &twin)
}

/// [`split_fans`] where `twin` tells which faces hang together: cuts the surface open where it says so.
pub(super) fn split_fans_of(vertices: &mut Vec<Vec3>, faces: &mut [[VertexId; 3]], twin: &[u32]) -> usize {
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
        for c in topology::fan(twin, corner) {
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

/// What was repaired, for the report.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// Vertices merged because they lie at the same place.
    pub vertices_merged: usize,
    /// Faces dropped because they have no area or repeat another face.
    pub degenerate_faces_dropped: usize,
    /// Faces turned, so that all faces of a piece look to the same side.
    pub faces_turned: usize,
    /// Half-edges on edges with more than two faces, cut apart.
    pub edges_cut: usize,
    /// Faces dropped because the surface stayed no manifold around them.
    pub branching_faces_dropped: usize,
    /// Vertices doubled because separate fans of faces met there.
    pub vertices_split: usize,
    /// Components smaller than the largest that were dropped.
    pub components_dropped: usize,
    /// Faces of those components.
    pub faces_dropped: usize,
    /// Faces dropped because the surface closes around itself there within a few edges: fingers and throats.
    pub narrow_faces_dropped: usize,
    /// Caps that closed the tube at its ends and were cut off.
    pub caps_cut: usize,
    /// Faces of these caps.
    pub cap_faces_dropped: usize,
    /// Area of these caps, square metres.
    pub caps_m2: f64,
    /// Handles of the surface that were cut open.
    pub handles_cut: usize,
    /// Length of these cuts, metres.
    pub handle_cuts_m: f64,
    /// Handles that could not be cut.
    pub handles_left: usize,
    /// Holes closed by a patch and marked as filled.
    pub holes_filled: usize,
    /// Faces of these patches.
    pub faces_filled: usize,
    /// Narrow holes that stayed open because no patch fits.
    pub holes_given_up: usize,
}

/// A surface under repair: an oriented manifold at every moment.
pub(super) struct Repaired {
    vertices: Vec<Vec3>,
    faces: Vec<[VertexId; 3]>,
    observed: Vec<bool>,
    pub summary: Summary,
}

impl Repaired {
    /// Makes oriented faces a manifold: edges with too many faces are cut apart, fans get vertices of their own, and
    /// what still branches is dropped.
    pub fn of(mut vertices: Vec<Vec3>, mut faces: Vec<[VertexId; 3]>, mut observed: Vec<bool>) -> Self {
        let mut summary = Summary::default();
        loop {
            let (twin, defects) = topology::lenient_twins(&faces);
            summary.edges_cut += defects.len();
            summary.vertices_split += split_fans_of(&mut vertices, &mut faces, &twin);
            if defects.is_empty() {
                break;
            }
            let (_, left) = topology::lenient_twins(&faces);
            if left.is_empty() {
                // Cut edges found new partners, so fans may have changed.
                continue;
            }
            let mut drop = vec![false; faces.len()];
            left.iter().for_each(|c| drop[(c / 3) as usize] = true);
            summary.branching_faces_dropped += drop.iter().filter(|d| **d).count();
            let kept = faces.into_iter().zip(observed).zip(&drop).filter(|(_, d)| !**d).map(|(both, _)| both);
            (faces, observed) = kept.unzip();
        }
        Self { vertices, faces, observed, summary }
    }

    /// Takes a mesh as a file gives it: merges equal positions, drops faces without area, turns faces of a piece to one
    /// side, and goes on as [`Self::of`].
    pub fn given(vertices: &[Vec3], faces: &[[VertexId; 3]], observed: &[bool]) -> Self {
        let mut order: Vec<u32> = (0..vertices.len() as u32).collect();
        let key = |v: u32| vertices[v as usize].map(|c| (c + 0.0).to_bits());
        order.sort_unstable_by_key(|&v| (key(v).x, key(v).y, key(v).z, v));
        let mut same: Vec<u32> = (0..vertices.len() as u32).collect();
        let mut merged = 0;
        for group in order.chunk_by(|&a, &b| key(a) == key(b)) {
            merged += group.len() - 1;
            group.iter().for_each(|&v| same[v as usize] = group[0]);
        }
        let mut seen: Vec<([VertexId; 3], usize)> = Vec::with_capacity(faces.len());
        for (f, face) in faces.iter().enumerate() {
            let corners = face.map(|v| same[v as usize]);
            let [a, b, c] = corners.map(|v| vertices[v as usize]);
            let mut sorted = corners;
            sorted.sort_unstable();
            if sorted[0] != sorted[1] && sorted[1] != sorted[2] && (b - a).cross(&(c - a)).norm() > 0.0 {
                seen.push((sorted, f));
            }
        }
        seen.sort_unstable();
        seen.dedup_by(|later, first| later.0 == first.0);
        seen.sort_unstable_by_key(|s| s.1);
        let mut kept: Vec<[VertexId; 3]> = seen.iter().map(|s| faces[s.1].map(|v| same[v as usize])).collect();
        let observed = seen.iter().map(|s| observed[s.1]).collect();
        let dropped = faces.len() - kept.len();
        let turned = turn_to_one_side(&mut kept);
        let (vertices, kept) = compact(vertices.to_vec(), kept);
        let mut repaired = Self::of(vertices, kept, observed);
        repaired.summary.vertices_merged = merged;
        repaired.summary.degenerate_faces_dropped = dropped;
        repaired.summary.faces_turned = turned;
        repaired
    }

    /// Keeps the largest component.
    pub fn keep_largest(&mut self) {
        let all =
            (std::mem::take(&mut self.vertices), std::mem::take(&mut self.faces), std::mem::take(&mut self.observed));
        let kept = keep_largest(all.0, all.1, all.2);
        (self.vertices, self.faces, self.observed) = (kept.vertices, kept.faces, kept.observed);
        self.summary.components_dropped += kept.components_dropped;
        self.summary.faces_dropped += kept.faces_dropped;
    }

    /// Takes away fingers and throats that are a few edges around, keeps the largest component and closes what they stood on.
    pub fn cut_narrow(&mut self) {
        for _ in 0..NARROW_ROUNDS {
            let Ok(twin) = topology::twins(&self.faces) else { return };
            let narrow = narrow::narrow_vertices(&self.vertices, &self.faces, &twin);
            let stays: Vec<bool> = self.faces.iter().map(|f| f.iter().all(|&v| !narrow[v as usize])).collect();
            if stays.iter().all(|s| *s) {
                return;
            }
            let mut rim = vec![false; self.vertices.len()];
            for (face, _) in self.faces.iter().zip(&stays).filter(|(_, s)| !**s) {
                face.iter().for_each(|&v| rim[v as usize] = true);
            }
            self.summary.narrow_faces_dropped += stays.iter().filter(|s| !**s).count();
            let all = std::mem::take(&mut self.faces).into_iter().zip(std::mem::take(&mut self.observed));
            (self.faces, self.observed) = all.zip(&stays).filter(|(_, s)| **s).map(|(both, _)| both).unzip();
            // New vertices of split fans lie where their old ones do.
            let rim: HashSet<[u64; 3]> =
                rim.iter().zip(&self.vertices).filter(|(r, _)| **r).map(|(_, p)| bits(p)).collect();
            self.summary.vertices_split += split_fans(&mut self.vertices, &mut self.faces);
            self.keep_largest();
            self.fill_holes(f64::INFINITY, |border| {
                border.len() <= NARROW_RIM && border.iter().all(|p| rim.contains(&bits(p)))
            });
        }
    }

    /// Cuts off what closes the tube at the ends of the axis; returns the chainages of these caps, metres.
    pub fn cut_caps(&mut self, axis: &Axis) -> Vec<f64> {
        let Ok(twin) = topology::twins(&self.faces) else { return Vec::new() };
        let caps = caps::find(&self.vertices, &self.faces, &twin, axis);
        let mut stays = vec![true; self.faces.len()];
        for cap in &caps {
            cap.faces.iter().for_each(|&f| stays[f as usize] = false);
            self.summary.cap_faces_dropped += cap.faces.len();
            self.summary.caps_m2 += cap.area_m2;
        }
        self.summary.caps_cut += caps.len();
        if !caps.is_empty() {
            self.retain_marked(&stays);
            // What stood on a cap hangs on nothing now.
            self.keep_largest();
        }
        caps.into_iter().map(|c| c.chainage_m).collect()
    }

    /// Cuts all handles open, keeping the largest component where a cut parts the surface.
    pub fn cut_handles(&mut self) {
        let left = |faces: &[[VertexId; 3]]| topology::twins(faces).map_or(0, |twin| handles::genus(faces, &twin));
        let before = left(&self.faces);
        for _ in 0..MOST_ROUNDS {
            let Some(length_m) = handles::cut_round(&mut self.vertices, &mut self.faces) else { break };
            self.summary.handle_cuts_m += length_m;
            self.keep_largest();
        }
        self.summary.handles_left = left(&self.faces);
        self.summary.handles_cut += before.saturating_sub(self.summary.handles_left);
    }

    /// Closes holes narrower than `width_m`; `is_hole` gets the places of a border and tells holes from portals.
    pub fn fill_holes(&mut self, width_m: f64, is_hole: impl Fn(&[Vec3]) -> bool) {
        let places = |l: &[VertexId]| -> Vec<Vec3> { l.iter().map(|&v| self.vertices[v as usize]).collect() };
        let mut faces = std::mem::take(&mut self.faces);
        let filled = fill::fill_holes(&self.vertices, &mut faces, width_m, |l| is_hole(&places(l)));
        self.faces = faces;
        self.observed.resize(self.faces.len(), false);
        self.summary.holes_filled += filled.holes;
        self.summary.faces_filled += filled.faces;
        self.summary.holes_given_up += filled.given_up;
    }

    /// Faces and places, to look at.
    pub fn parts(&self) -> (&[Vec3], &[[VertexId; 3]]) {
        (&self.vertices, &self.faces)
    }

    /// Leaves out the faces for which `keep` is false.
    pub fn retain(&mut self, keep: impl Fn(&[Vec3; 3]) -> bool) {
        let stays: Vec<bool> = self.faces.iter().map(|f| keep(&f.map(|v| self.vertices[v as usize]))).collect();
        self.retain_marked(&stays);
    }

    fn retain_marked(&mut self, stays: &[bool]) {
        let all = std::mem::take(&mut self.faces).into_iter().zip(std::mem::take(&mut self.observed));
        (self.faces, self.observed) = all.zip(stays).filter(|(_, s)| **s).map(|(both, _)| both).unzip();
        self.summary.vertices_split += split_fans(&mut self.vertices, &mut self.faces);
    }

    /// Marks the faces for which `is_filled` holds as not observed.
    pub fn mark_filled(&mut self, is_filled: impl Fn(&[Vec3; 3]) -> bool) {
        for (face, seen) in self.faces.iter().zip(&mut self.observed) {
            *seen &= !is_filled(&face.map(|v| self.vertices[v as usize]));
        }
    }

    /// The mesh.
    pub fn into_mesh(self) -> (Mesh, Summary) {
        let (vertices, faces) = compact(self.vertices, self.faces);
        (Mesh::new(vertices, faces, self.observed).expect("repair keeps an oriented manifold"), self.summary)
    }
}

/// A place as something to compare exactly.
fn bits(p: &Vec3) -> [u64; 3] {
    [p.x, p.y, p.z].map(f64::to_bits)
}

/// Turns faces so that neighbours across an edge of two faces run through it in opposite directions; the first face of
/// each piece decides. Returns how many were turned.
fn turn_to_one_side(faces: &mut [[VertexId; 3]]) -> usize {
    let mut edges: Vec<(VertexId, VertexId, u32)> = (0..3 * faces.len() as u32)
        .map(|c| {
            let (f, i) = ((c / 3) as usize, (c % 3) as usize);
            let (a, b) = (faces[f][i], faces[f][(i + 1) % 3]);
            (a.min(b), a.max(b), c)
        })
        .collect();
    edges.sort_unstable();
    // (face beside half-edge, whether both run the same way)
    let mut beside: Vec<Option<(u32, bool)>> = vec![None; 3 * faces.len()];
    for group in edges.chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
        if let [(_, _, a), (_, _, b)] = *group {
            let start = |c: u32| faces[(c / 3) as usize][(c % 3) as usize];
            let same = start(a) == start(b);
            beside[a as usize] = Some((b / 3, same));
            beside[b as usize] = Some((a / 3, same));
        }
    }
    let mut turned = vec![false; faces.len()];
    let mut done = vec![false; faces.len()];
    for seed in 0..faces.len() {
        if std::mem::replace(&mut done[seed], true) {
            continue;
        }
        let mut stack = vec![seed];
        while let Some(f) = stack.pop() {
            for (other, same) in beside[3 * f..3 * f + 3].iter().flatten() {
                let other = *other as usize;
                if !std::mem::replace(&mut done[other], true) {
                    turned[other] = turned[f] ^ same;
                    stack.push(other);
                }
            }
        }
    }
    for (face, _) in faces.iter_mut().zip(&turned).filter(|(_, t)| **t) {
        face.swap(1, 2);
    }
    turned.iter().filter(|t| **t).count()
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn an_edge_of_four_faces_is_cut_into_two_sheets() {
        // Two roofs that share their ridge 0-1.
        let vertices = points(6);
        let faces = vec![[0, 1, 2], [1, 0, 3], [0, 1, 4], [1, 0, 5]];
        let repaired = Repaired::of(vertices, faces, vec![true; 4]);
        assert!(repaired.summary.edges_cut > 0);
        let (mesh, _) = repaired.into_mesh();
        assert!(mesh.faces().len() + 2 >= 4);
    }

    #[test]
    fn a_mesh_from_elsewhere_is_sewn_and_turned() {
        // A square whose triangles share no vertices and look to both sides, a face twice, and one without area.
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(|[x, y]| Vec3::new(x, y, 0.0));
        let vertices = vec![square[0], square[1], square[2], square[0], square[2], square[3], square[1], square[1]];
        let faces = [[0, 1, 2], [3, 5, 4], [0, 1, 2], [1, 6, 7]];
        let repaired = Repaired::given(&vertices, &faces, &[true; 4]);
        let summary = repaired.summary.clone();
        assert_eq!((summary.vertices_merged, summary.degenerate_faces_dropped, summary.faces_turned), (4, 2, 1));
        let (mesh, _) = repaired.into_mesh();
        assert_eq!((mesh.vertices().len(), mesh.faces().len()), (4, 2));
        assert_eq!(topology::boundary_loops(mesh.faces(), mesh.twins()).len(), 1);
    }
}
