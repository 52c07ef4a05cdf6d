//! Handles: bridges and tunnels of the surface that no flat map can have, found as short loops and cut open.
//!
//! Use it on surfaces from [`super::poisson`] and on meshes from elsewhere, where rock that touches itself leaves arches of a
//! few faces. Every cut along a loop that does not part the surface takes one handle away.
//!
//! Method. With every border closed by a fan, the edges that are neither in a shortest-path tree of the vertices nor
//! crossed by the tree of the faces that avoids them (built from the longest loops on) number twice the handles, and
//! each closes a loop with the tree: a greedy homotopy basis (J. Erickson, K. Whittlesey, "Greedy optimal homotopy and
//! homology generators", SODA 2005). The shortest loops that do not touch each other are cut, until none is left.
//! Departure: one root, so loops are short but not the shortest. Cost: a Dijkstra and a sort of the edges a round; a
//! round takes away all handles that are apart from each other.

use super::topology::{self, NO_TWIN};
use super::{VertexId, repair};
use crate::numeric::Vec3;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Cuts short loops that do not touch each other, of a manifold with one component; returns the length of the cuts in
/// metres, `None` when there is nothing to cut. Pieces may come off where a loop runs along a border.
pub(super) fn cut_round(vertices: &mut Vec<Vec3>, faces: &mut [[VertexId; 3]]) -> Option<f64> {
    let mut twin = topology::twins(faces).ok()?;
    if genus(faces, &twin) == 0 {
        return None;
    }
    let mut touched = vec![false; vertices.len()];
    let mut length_m = 0.0;
    let mut any = false;
    for found in generators(vertices, faces, &twin) {
        let at = |c: u32| faces[(c / 3) as usize][(c % 3) as usize] as usize;
        if found.half_edges.iter().any(|&c| touched[at(c)] || touched[at(topology::next(c))]) {
            continue;
        }
        for &c in &found.half_edges {
            touched[at(c)] = true;
            touched[at(topology::next(c))] = true;
            let other = std::mem::replace(&mut twin[c as usize], NO_TWIN);
            if other != NO_TWIN {
                twin[other as usize] = NO_TWIN;
            }
        }
        length_m += found.length_m;
        any = true;
    }
    any.then(|| {
        repair::split_fans_of(vertices, faces, &twin);
        length_m
    })
}

/// Number of handles of a manifold with one component.
pub(super) fn genus(faces: &[[VertexId; 3]], twin: &[u32]) -> usize {
    let boundary = twin.iter().filter(|&&t| t == NO_TWIN).count() as i64;
    let edges = (twin.len() as i64 + boundary) / 2;
    let mut used: Vec<VertexId> = faces.iter().flatten().copied().collect();
    used.sort_unstable();
    used.dedup();
    let loops = topology::boundary_loops(faces, twin).len() as i64;
    let euler = used.len() as i64 - edges + faces.len() as i64;
    ((2 - loops - euler) / 2).max(0) as usize
}

/// A loop along edges, as one half-edge of each.
struct Generator {
    half_edges: Vec<u32>,
    length_m: f64,
}

/// Loops along real edges that generate the handles, the shortest first.
fn generators(vertices: &[Vec3], faces: &[[VertexId; 3]], twin: &[u32]) -> Vec<Generator> {
    let real = faces.len();
    let mut closed = faces.to_vec();
    for (k, border) in topology::boundary_loops(faces, twin).iter().enumerate() {
        let apex = (vertices.len() + k) as VertexId;
        for i in 0..border.len() {
            closed.push([border[(i + 1) % border.len()], border[i], apex]);
        }
    }
    let Ok(around) = topology::twins(&closed) else { return Vec::new() };
    let vertex = |c: u32| closed[(c / 3) as usize][(c % 3) as usize] as usize;
    let spoke = |c: u32| vertex(c) >= vertices.len() || vertex(topology::next(c)) >= vertices.len();
    let length = |c: u32| (vertices[vertex(c)] - vertices[vertex(topology::next(c))]).norm();

    // Half-edges leaving each vertex, in compressed rows.
    let count = closed.iter().flatten().max().map_or(0, |&v| v as usize + 1);
    let mut first = vec![0u32; count + 1];
    (0..around.len() as u32).for_each(|c| first[vertex(c) + 1] += 1);
    for v in 0..count {
        first[v + 1] += first[v];
    }
    let mut leaving = vec![0u32; around.len()];
    let mut fill = first.clone();
    for c in 0..around.len() as u32 {
        let slot = &mut fill[vertex(c)];
        leaving[*slot as usize] = c;
        *slot += 1;
    }

    // Shortest paths over real edges; fans hang on as leaves.
    const NONE: u32 = u32::MAX;
    let mut distance = vec![f64::INFINITY; count];
    let mut came = vec![NONE; count];
    let mut queue = BinaryHeap::new();
    let root = closed[0][0] as usize;
    distance[root] = 0.0;
    queue.push(Reverse((0u64, root)));
    while let Some(Reverse((bits, v))) = queue.pop() {
        if f64::from_bits(bits) > distance[v] {
            continue;
        }
        for &c in &leaving[first[v] as usize..first[v + 1] as usize] {
            if spoke(c) {
                continue;
            }
            let w = vertex(topology::next(c));
            let there = distance[v] + length(c);
            if there < distance[w] {
                distance[w] = there;
                came[w] = c;
                queue.push(Reverse((there.to_bits(), w)));
            }
        }
    }
    let mut in_tree = vec![false; around.len()];
    let mark = |c: u32, marks: &mut Vec<bool>| {
        marks[c as usize] = true;
        marks[around[c as usize] as usize] = true;
    };
    came.iter().filter(|c| **c != NONE).for_each(|&c| mark(c, &mut in_tree));
    for apex in vertices.len()..count {
        if first[apex] < first[apex + 1] {
            mark(leaving[first[apex] as usize], &mut in_tree);
        }
    }

    // Faces joined over the edges that would close the longest loops; what is left closes the shortest.
    let mut edges: Vec<(u64, u32)> = (0..around.len() as u32)
        .filter(|&c| c < around[c as usize] && !in_tree[c as usize])
        .map(|c| {
            let through =
                if spoke(c) { f64::MAX } else { distance[vertex(c)] + distance[vertex(topology::next(c))] + length(c) };
            (through.to_bits(), c)
        })
        .collect();
    edges.sort_unstable_by(|a, b| b.cmp(a));
    let mut parent: Vec<u32> = (0..closed.len() as u32).collect();
    fn find(parent: &mut [u32], mut x: u32) -> u32 {
        while parent[x as usize] != x {
            parent[x as usize] = parent[parent[x as usize] as usize];
            x = parent[x as usize];
        }
        x
    }
    let mut found: Vec<Generator> = Vec::new();
    for (_, c) in edges {
        let (a, b) = (find(&mut parent, c / 3), find(&mut parent, around[c as usize] / 3));
        if a != b {
            parent[a.max(b) as usize] = a.min(b);
        } else if !spoke(c) {
            found.push(loop_through(c, &came, vertex, length));
        }
    }
    // Half-edges of fans stand for real ones on the other side.
    for generator in &mut found {
        for c in &mut generator.half_edges {
            if (*c / 3) as usize >= real {
                *c = around[*c as usize];
            }
        }
    }
    found.sort_by(|a, b| a.length_m.total_cmp(&b.length_m).then(a.half_edges.cmp(&b.half_edges)));
    found
}

/// The loop that half-edge `c` closes with the tree, without the part that both ways share.
fn loop_through(c: u32, came: &[u32], vertex: impl Fn(u32) -> usize, length: impl Fn(u32) -> f64) -> Generator {
    let path = |mut v: usize| {
        let mut path = Vec::new();
        while came[v] != u32::MAX {
            path.push(came[v]);
            v = vertex(came[v]);
        }
        path
    };
    let (mut one, mut two) = (path(vertex(c)), path(vertex(topology::next(c))));
    while let (Some(a), Some(b)) = (one.last(), two.last())
        && a == b
    {
        one.pop();
        two.pop();
    }
    let half_edges: Vec<u32> = std::iter::once(c).chain(one).chain(two).collect();
    let length_m = half_edges.iter().map(|&c| length(c)).sum();
    Generator { half_edges, length_m }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::repair::Repaired;

    /// A torus of `n x m` quads; the faces for which `keep` is false are left out.
    fn torus(n: u32, m: u32, keep: impl Fn(u32, u32) -> bool) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let vertices = (0..n * m)
            .map(|k| {
                let (a, b) = (f64::from(k / m) / f64::from(n), f64::from(k % m) / f64::from(m));
                let ((sa, ca), (sb, cb)) =
                    ((a * std::f64::consts::TAU).sin_cos(), (b * std::f64::consts::TAU).sin_cos());
                Vec3::new((3.0 + cb) * ca, (3.0 + cb) * sa, sb)
            })
            .collect();
        let at = |i: u32, j: u32| i % n * m + j % m;
        let faces = (0..n)
            .flat_map(|i| (0..m).map(move |j| (i, j)))
            .filter(|&(i, j)| keep(i, j))
            .flat_map(|(i, j)| {
                let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
                [[a, b, c], [a, c, d]]
            })
            .collect();
        (vertices, faces)
    }

    #[test]
    fn a_torus_loses_its_handle_on_the_short_way_around() {
        for hole in [false, true] {
            let (vertices, faces) = torus(40, 14, |i, j| !hole || i != 3 || j != 4);
            let observed = vec![true; faces.len()];
            let mut repaired = Repaired::of(vertices, faces, observed);
            repaired.cut_handles();
            let (mesh, summary) = repaired.into_mesh();
            assert_eq!((summary.handles_cut, summary.handles_left), (1, 0));
            // The tube's circumference is 2 pi; the way around the ring at least 4 pi.
            assert!(summary.handle_cuts_m < 8.0, "{}", summary.handle_cuts_m);
            let twin = mesh.twins();
            assert_eq!(topology::components(twin).1, 1);
            assert_eq!(genus(mesh.faces(), twin), 0);
            assert_eq!(topology::boundary_loops(mesh.faces(), twin).len(), 2 + usize::from(hole));
        }
    }

    #[test]
    fn a_surface_without_handles_stays_as_it_is() {
        let (mut vertices, mut faces) = torus(20, 10, |i, _| i < 19);
        let before = (vertices.clone(), faces.clone());
        assert_eq!(cut_round(&mut vertices, &mut faces), None);
        assert_eq!((vertices, faces), before);
    }
}
