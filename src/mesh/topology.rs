//! Half-edges, boundary loops and components, derived from the face list.
//!
//! Corner `c = 3 f + i` stands for corner `i` of face `f` and for the half-edge from that corner to the next one.

use super::{Error, FaceId, VertexId};

/// Marks a half-edge on the boundary in [`twins`].
pub const NO_TWIN: u32 = u32::MAX;

/// The corner after `c` in its face.
pub fn next(c: u32) -> u32 {
    if c % 3 == 2 { c - 2 } else { c + 1 }
}

/// The corner before `c` in its face.
pub fn previous(c: u32) -> u32 {
    if c.is_multiple_of(3) { c + 2 } else { c - 1 }
}

/// For each half-edge the opposite half-edge, or [`NO_TWIN`].
///
/// # Errors
/// [`Error::NotManifoldEdge`] when two half-edges run the same way between the same vertices.
pub fn twins(faces: &[[VertexId; 3]]) -> Result<Vec<u32>, Error> {
    let vertex = |c: u32| faces[(c / 3) as usize][(c % 3) as usize];
    let mut twin = vec![NO_TWIN; faces.len() * 3];
    for group in EdgeGroups::of(faces).iter() {
        for (k, &(_, c)) in group.iter().enumerate() {
            if let Some(&(_, same)) = group[..k].iter().find(|&&(_, other)| vertex(other) == vertex(c)) {
                return Err(Error::NotManifoldEdge {
                    from: vertex(c),
                    to: vertex(next(c)),
                    first: same / 3,
                    second: c / 3,
                });
            }
        }
        if let [(_, a), (_, b)] = *group {
            twin[a as usize] = b;
            twin[b as usize] = a;
        }
    }
    Ok(twin)
}

/// [`twins`] for faces that need not be a manifold: half-edges of edges with more than two faces, or with two that run
/// the same way, count as boundary; the second value lists them.
pub fn lenient_twins(faces: &[[VertexId; 3]]) -> (Vec<u32>, Vec<u32>) {
    let vertex = |c: u32| faces[(c / 3) as usize][(c % 3) as usize];
    let mut twin = vec![NO_TWIN; faces.len() * 3];
    let mut defects = Vec::new();
    for group in EdgeGroups::of(faces).iter() {
        match *group {
            [_] => {}
            [(_, a), (_, b)] if vertex(a) != vertex(b) => {
                twin[a as usize] = b;
                twin[b as usize] = a;
            }
            _ => defects.extend(group.iter().map(|g| g.1)),
        }
    }
    (twin, defects)
}

/// Half-edges in buckets by their lower vertex (a counting sort), each bucket sorted by (higher vertex, corner): much
/// faster than one big sort or hashing, and deterministic.
struct EdgeGroups {
    start: Vec<u32>,
    edges: Vec<(u32, u32)>,
}

impl EdgeGroups {
    fn of(faces: &[[VertexId; 3]]) -> Self {
        let ends = |c: usize| {
            let corners = &faces[c / 3];
            (corners[c % 3], corners[(c + 1) % 3])
        };
        let buckets = faces.iter().flatten().max().map_or(0, |&v| v as usize + 1);
        let mut start = vec![0u32; buckets + 1];
        for c in 0..faces.len() * 3 {
            let (a, b) = ends(c);
            start[a.min(b) as usize + 1] += 1;
        }
        for v in 0..buckets {
            start[v + 1] += start[v];
        }
        let mut fill = start.clone();
        let mut edges = vec![(0u32, 0u32); faces.len() * 3];
        for c in 0..faces.len() * 3 {
            let (a, b) = ends(c);
            let slot = &mut fill[a.min(b) as usize];
            edges[*slot as usize] = (a.max(b), c as u32);
            *slot += 1;
        }
        for bucket in 0..buckets {
            edges[start[bucket] as usize..start[bucket + 1] as usize].sort_unstable();
        }
        Self { start, edges }
    }

    /// The half-edges of each edge as (higher vertex, half-edge), ascending.
    fn iter(&self) -> impl Iterator<Item = &[(u32, u32)]> {
        self.start.windows(2).flat_map(|w| self.edges[w[0] as usize..w[1] as usize].chunk_by(|x, y| x.0 == y.0))
    }
}

/// Proves that faces index existing vertices, edges have at most two opposite faces and vertices have one fan; returns the
/// [`twins`].
///
/// # Errors
/// The first defect found, see [`Error`].
pub(super) fn check_manifold(vertex_count: usize, faces: &[[VertexId; 3]]) -> Result<Vec<u32>, Error> {
    for (f, &corners) in faces.iter().enumerate() {
        let [a, b, c] = corners;
        if corners.iter().any(|&v| v as usize >= vertex_count) || a == b || b == c || c == a {
            return Err(Error::BadFace { face: f as FaceId, corners, vertex_count });
        }
    }
    let twin = twins(faces)?;
    // A vertex has one fan when turning around it from any corner reaches all its corners.
    let mut corner_count = vec![0u32; vertex_count];
    let mut first_corner = vec![u32::MAX; vertex_count];
    for (f, corners) in faces.iter().enumerate() {
        for (i, &v) in corners.iter().enumerate() {
            corner_count[v as usize] += 1;
            first_corner[v as usize] = first_corner[v as usize].min((3 * f + i) as u32);
        }
    }
    for v in 0..vertex_count {
        if corner_count[v] == 0 {
            continue;
        }
        let reached = fan(&twin, first_corner[v]).count() as u32;
        if reached != corner_count[v] {
            // Each fan misses the others; counting them exactly is only needed for the message.
            let fans = count_fans(faces, &twin, v as VertexId);
            return Err(Error::NotManifoldVertex { vertex: v as VertexId, fans });
        }
    }
    Ok(twin)
}

/// The corners around one vertex that are reached from `corner` by crossing edges, in turning order; starts at the
/// boundary if there is one.
pub fn fan(twin: &[u32], corner: u32) -> impl Iterator<Item = u32> + '_ {
    // Turn clockwise until the boundary or all the way round, then walk counter-clockwise.
    let mut start = corner;
    loop {
        let back = twin[start as usize];
        if back == NO_TWIN {
            break;
        }
        start = next(back);
        if start == corner {
            break;
        }
    }
    let mut current = Some(start);
    std::iter::from_fn(move || {
        let here = current?;
        let across = twin[previous(here) as usize];
        current = (across != NO_TWIN && across != start).then_some(across);
        Some(here)
    })
}

fn count_fans(faces: &[[VertexId; 3]], twin: &[u32], vertex: VertexId) -> usize {
    let mut seen = Vec::new();
    let mut fans = 0;
    for (f, corners) in faces.iter().enumerate() {
        for (i, &v) in corners.iter().enumerate() {
            let corner = (3 * f + i) as u32;
            if v == vertex && !seen.contains(&corner) {
                fans += 1;
                seen.extend(fan(twin, corner));
            }
        }
    }
    fans
}

/// The boundary loops as closed vertex lists (first vertex not repeated), each with the surface on its left.
/// Loops are ordered by their smallest half-edge.
pub fn boundary_loops(faces: &[[VertexId; 3]], twin: &[u32]) -> Vec<Vec<VertexId>> {
    let vertex = |c: u32| faces[(c / 3) as usize][(c % 3) as usize];
    let mut done = vec![false; twin.len()];
    let mut loops = Vec::new();
    for start in 0..twin.len() as u32 {
        if twin[start as usize] != NO_TWIN || done[start as usize] {
            continue;
        }
        let mut vertices = Vec::new();
        let mut c = start;
        while !done[c as usize] {
            done[c as usize] = true;
            vertices.push(vertex(c));
            // The next boundary half-edge leaves from the end of this one: turn around that vertex.
            let mut turn = next(c);
            while twin[turn as usize] != NO_TWIN {
                turn = next(twin[turn as usize]);
            }
            c = turn;
        }
        loops.push(vertices);
    }
    loops
}

/// Component number of each face (connected across edges), numbered in order of first face, and their count.
pub fn components(twin: &[u32]) -> (Vec<u32>, usize) {
    let face_count = twin.len() / 3;
    let mut component = vec![u32::MAX; face_count];
    let mut count = 0;
    let mut stack = Vec::new();
    for seed in 0..face_count {
        if component[seed] != u32::MAX {
            continue;
        }
        component[seed] = count;
        stack.push(seed);
        while let Some(f) = stack.pop() {
            for &other in &twin[3 * f..3 * f + 3] {
                if other != NO_TWIN && component[(other / 3) as usize] == u32::MAX {
                    component[(other / 3) as usize] = count;
                    stack.push((other / 3) as usize);
                }
            }
        }
        count += 1;
    }
    (component, count as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TETRAHEDRON: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];

    #[test]
    fn closed_surface_has_no_boundary() {
        let twin = twins(&TETRAHEDRON).unwrap();
        assert!(twin.iter().all(|&t| t != NO_TWIN));
        assert!(boundary_loops(&TETRAHEDRON, &twin).is_empty());
        check_manifold(4, &TETRAHEDRON).unwrap();
        assert_eq!(fan(&twin, 0).count(), 3);
    }

    #[test]
    fn a_square_has_one_loop_with_the_surface_on_its_left() {
        let faces = [[0, 1, 2], [0, 2, 3]];
        let twin = twins(&faces).unwrap();
        assert_eq!(boundary_loops(&faces, &twin), vec![vec![0, 1, 2, 3]]);
        assert_eq!(components(&twin), (vec![0, 0], 1));
    }

    #[test]
    fn defects_are_named() {
        assert!(matches!(check_manifold(3, &[[0, 1, 3]]), Err(Error::BadFace { face: 0, .. })));
        assert!(matches!(
            check_manifold(4, &[[0, 1, 2], [0, 1, 3]]),
            Err(Error::NotManifoldEdge { from: 0, to: 1, .. })
        ));
        // Two triangles that touch in one vertex.
        assert_eq!(check_manifold(5, &[[0, 1, 2], [0, 3, 4]]), Err(Error::NotManifoldVertex { vertex: 0, fans: 2 }));
        // Three faces on one edge.
        assert!(check_manifold(5, &[[0, 1, 2], [1, 0, 3], [0, 1, 4]]).is_err());
    }
}
