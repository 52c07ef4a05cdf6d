//! Small holes closed by a smooth patch.
//!
//! Method. The border is triangulated with the least area among all triangulations of its polygon (G. Barequet, M. Sharir,
//! "Filling gaps in the boundary of a polyhedron", CAGD 12(2), 1995, doi:10.1016/0167-8396(94)00011-G), which for holes of
//! some dozen edges follows the rim without a bump. Departure: no new vertices, so a patch is as smooth as its rim; holes
//! of more than [`MOST_EDGES`] edges stay. Cost: cubic in the edges of a hole.

use super::VertexId;
use super::topology;
use crate::numeric::{Mat3, Vec3};

/// Holes with more edges stay open.
const MOST_EDGES: usize = 160;

/// What filling did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Filled {
    pub holes: usize,
    pub faces: usize,
    /// Narrow enough, but of too many edges or without a patch that leaves the surface a manifold.
    pub given_up: usize,
}

/// Closes the holes of a manifold that are narrower than `width_m`; `is_hole` tells holes from portals. New faces are
/// appended.
pub(super) fn fill_holes(
    vertices: &[Vec3],
    faces: &mut Vec<[VertexId; 3]>,
    width_m: f64,
    is_hole: impl Fn(&[VertexId]) -> bool,
) -> Filled {
    let mut filled = Filled::default();
    let Ok(twin) = topology::twins(faces) else { return filled };
    let loops: Vec<Vec<VertexId>> = topology::boundary_loops(faces, &twin)
        .into_iter()
        .filter(|l| width(l.iter().map(|&v| vertices[v as usize])) <= width_m && is_hole(l))
        .collect();
    if loops.is_empty() {
        return filled;
    }
    // Edges between border vertices that exist already must not come a second time.
    let mut on_loop = vec![false; vertices.len()];
    loops.iter().flatten().for_each(|&v| on_loop[v as usize] = true);
    let mut existing: Vec<(VertexId, VertexId)> = faces
        .iter()
        .flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)])
        .filter(|&(a, b)| on_loop[a as usize] && on_loop[b as usize])
        .map(|(a, b)| (a.min(b), a.max(b)))
        .collect();
    existing.sort_unstable();
    existing.dedup();
    for border in &loops {
        let mut repeated = border.clone();
        repeated.sort_unstable();
        repeated.dedup();
        let patch = (border.len() <= MOST_EDGES && repeated.len() == border.len())
            .then(|| least_area(vertices, border, &existing))
            .flatten();
        match patch {
            Some(patch) => {
                filled.holes += 1;
                filled.faces += patch.len();
                let edges = patch.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
                existing.extend(edges.map(|(a, b)| (a.min(b), a.max(b))));
                existing.sort_unstable();
                faces.extend(patch);
            }
            None => filled.given_up += 1,
        }
    }
    filled
}

/// The narrower extent of a border in its own plane, metres.
fn width(points: impl Iterator<Item = Vec3> + Clone) -> f64 {
    let count = points.clone().count() as f64;
    let middle = points.clone().sum::<Vec3>() / count;
    let scatter = points.clone().map(|p| (p - middle) * (p - middle).transpose()).sum::<Mat3>();
    let eigen = scatter.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let across = eigen.eigenvectors.column(order[1]).into_owned();
    let along = points.map(|p| (p - middle).dot(&across));
    let (low, high) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
    high - low
}

/// The triangulation of least area; `None` when every one needs an edge that exists already.
fn least_area(vertices: &[Vec3], border: &[VertexId], existing: &[(VertexId, VertexId)]) -> Option<Vec<[VertexId; 3]>> {
    let n = border.len();
    if n < 3 {
        return None;
    }
    let taken = |i: usize, k: usize| {
        let (a, b) = (border[i].min(border[k]), border[i].max(border[k]));
        existing.binary_search(&(a, b)).is_ok()
    };
    let at = |i: usize| vertices[border[i] as usize];
    let mut area = vec![0.0f64; n * n];
    let mut split = vec![usize::MAX; n * n];
    for span in 2..n {
        for i in 0..n - span {
            let k = i + span;
            // The last span is the border's own closing edge.
            if span < n - 1 && taken(i, k) {
                area[i * n + k] = f64::INFINITY;
                continue;
            }
            let mut best = f64::INFINITY;
            for m in i + 1..k {
                let total = area[i * n + m] + area[m * n + k] + (at(m) - at(i)).cross(&(at(k) - at(i))).norm() / 2.0;
                if total < best {
                    best = total;
                    split[i * n + k] = m;
                }
            }
            area[i * n + k] = best;
        }
    }
    if !area[n - 1].is_finite() {
        return None;
    }
    let mut patch = Vec::with_capacity(n - 2);
    let mut stack = vec![(0, n - 1)];
    while let Some((i, k)) = stack.pop() {
        if k - i < 2 {
            continue;
        }
        let m = split[i * n + k];
        // The border runs with the surface on its left, so the patch runs against it.
        patch.push([border[k], border[m], border[i]]);
        stack.extend([(i, m), (m, k)]);
    }
    Some(patch)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Mesh;

    fn sheet(n: u32, keep: impl Fn(u32, u32) -> bool) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let vertices = (0..(n + 1) * (n + 1))
            .map(|k| Vec3::new(f64::from(k / (n + 1)), f64::from(k % (n + 1)), 0.1 * f64::from(k / (n + 1)).sin()))
            .collect();
        let faces = (0..n)
            .flat_map(|i| (0..n).map(move |j| (i, j)))
            .filter(|&(i, j)| keep(i, j))
            .flat_map(|(i, j)| {
                let a = i * (n + 1) + j;
                [[a, a + n + 1, a + n + 2], [a, a + n + 2, a + 1]]
            })
            .collect();
        (vertices, faces)
    }

    #[test]
    fn a_small_hole_is_closed_and_a_wide_one_and_the_rim_stay() {
        let (vertices, mut faces) = sheet(20, |i, j| {
            !((3..5).contains(&i) && (3..6).contains(&j)) && !((9..16).contains(&i) && (9..16).contains(&j))
        });
        let filled = fill_holes(&vertices, &mut faces, 3.0, |_| true);
        assert_eq!(filled, Filled { holes: 1, faces: 8, given_up: 0 });
        let mesh = Mesh::all_observed(vertices, faces).unwrap();
        let twin = mesh.twins();
        assert_eq!(topology::boundary_loops(mesh.faces(), twin).len(), 2);
        assert!((0..mesh.faces().len() as u32).all(|f| mesh.double_area_vector(f).z > 0.0));
    }

    #[test]
    fn what_is_no_hole_stays_open() {
        let (vertices, mut faces) = sheet(6, |i, j| (i, j) != (2, 2));
        assert_eq!(fill_holes(&vertices, &mut faces, 2.0, |_| false), Filled::default());
    }
}
