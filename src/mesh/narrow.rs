//! Fingers and throats: places where the surface closes around itself within a few edges.
//!
//! Use it on surfaces from [`super::poisson`], where sheets of points that cross leave thorns and tunnels one cell thick. A flat
//! map has no room for what hangs on a loop of five edges: a Tutte embedding squeezes a finger of ten rings a billionfold.
//!
//! Method. A vertex is narrow when the surface within [`RINGS`] edges of it is not a disk but a ring (Euler characteristic
//! vertices - edges + faces of what is seen, 1 for a disk), and turns its back on the vertex somewhere, which no rough wall
//! does so near. Vertices whose surroundings reach a border are never narrow. Cost: linear; some forty vertices are looked at
//! around each one that has a back near it.

use super::VertexId;
use super::topology::{self, NO_TWIN};
use crate::numeric::Vec3;
use rayon::prelude::*;

/// Edges that one looks away from a vertex: what is narrow has less than about twice as many around it.
const RINGS: usize = 3;
/// A normal shows its back to another one when their cosine is below this.
const BACK: f64 = -0.2;

/// Whether the surface is narrow around each vertex. The faces are an oriented manifold.
pub(super) fn narrow_vertices(vertices: &[Vec3], faces: &[[VertexId; 3]], twin: &[u32]) -> Vec<bool> {
    let mut normals = vec![Vec3::zeros(); vertices.len()];
    let mut first = vec![0u32; vertices.len() + 1];
    let mut at_border = vec![false; vertices.len()];
    for (f, corners) in faces.iter().enumerate() {
        let [a, b, c] = corners.map(|v| vertices[v as usize]);
        let area = (b - a).cross(&(c - a));
        for (i, &v) in corners.iter().enumerate() {
            normals[v as usize] += area;
            first[v as usize + 1] += 1;
            if twin[3 * f + i] == NO_TWIN {
                at_border[v as usize] = true;
                at_border[corners[(i + 1) % 3] as usize] = true;
            }
        }
    }
    normals.iter_mut().for_each(|n| *n = n.try_normalize(0.0).unwrap_or_else(Vec3::zeros));
    for v in 0..vertices.len() {
        first[v + 1] += first[v];
    }
    // Half-edges leaving each vertex, in compressed rows.
    let mut leaving = vec![0u32; twin.len()];
    let mut fill = first.clone();
    for c in 0..twin.len() as u32 {
        let slot = &mut fill[faces[(c / 3) as usize][(c % 3) as usize] as usize];
        leaving[*slot as usize] = c;
        *slot += 1;
    }
    let end = |c: u32| {
        let c = topology::next(c);
        faces[(c / 3) as usize][(c % 3) as usize]
    };
    let around = |v: VertexId| &leaving[first[v as usize] as usize..first[v as usize + 1] as usize];
    let is_narrow = |v: usize| {
        // Away from borders each neighbour is the end of one half-edge that leaves the vertex.
        let mut seen = vec![v as VertexId];
        let mut done = 0;
        let mut has_back = false;
        for _ in 0..RINGS {
            let ring = seen.len();
            while done < ring {
                let at = seen[done];
                done += 1;
                if at_border[at as usize] {
                    return false;
                }
                for w in around(at).iter().map(|&c| end(c)) {
                    if !seen.contains(&w) {
                        has_back |= normals[w as usize].dot(&normals[v]) < BACK;
                        seen.push(w);
                    }
                }
            }
        }
        if !has_back || seen.iter().any(|&w| at_border[w as usize]) {
            return false;
        }
        let (mut edges, mut whole) = (0i64, 0i64);
        for &w in &seen {
            for &c in around(w) {
                let (x, y) = (end(c), end(topology::next(c)));
                if seen.contains(&x) {
                    // Each edge leaves both its ends, each face all its corners.
                    edges += i64::from(w < x);
                    whole += i64::from(w < x && w < y && seen.contains(&y));
                }
            }
        }
        seen.len() as i64 - edges + whole < 1
    };
    (0..vertices.len()).into_par_iter().with_min_len(1024).map(is_narrow).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::repair::Repaired;

    /// A sheet of `n` x `n` squares; on its middle stands a closed finger of `rings` rings of `sides` squares.
    fn sheet_with_finger(n: u32, sides: u32, rings: u32) -> (Vec<Vec3>, Vec<[VertexId; 3]>) {
        let mut vertices: Vec<Vec3> =
            (0..=n).flat_map(|i| (0..=n).map(move |j| Vec3::new(f64::from(i), f64::from(j), 0.0))).collect();
        let mut faces: Vec<[VertexId; 3]> = (0..n)
            .flat_map(|i| (0..n).map(move |j| (i, j)))
            .filter(|&(i, j)| (i, j) != (n / 2, n / 2))
            .flat_map(|(i, j)| {
                let a = i * (n + 1) + j;
                [[a, a + n + 1, a + n + 2], [a, a + n + 2, a + 1]]
            })
            .collect();
        let corner = (n / 2) * (n + 1) + n / 2;
        // Counter-clockwise seen from above, as the sheet.
        let mut below = vec![corner, corner + n + 1, corner + n + 2, corner + 1];
        assert_eq!(sides, 4, "the hole has four sides");
        for ring in 1..=rings {
            let place = |v: VertexId| {
                let p = vertices[v as usize];
                Vec3::new(p.x, p.y, f64::from(ring))
            };
            let above: Vec<Vec3> = below.iter().map(|&v| place(v)).collect();
            let start = vertices.len() as u32;
            vertices.extend(above);
            let above: Vec<VertexId> = (0..4).map(|k| start + k).collect();
            for k in 0..4 {
                let (a, b, c, d) = (below[k], below[(k + 1) % 4], above[(k + 1) % 4], above[k]);
                faces.extend([[a, b, c], [a, c, d]]);
            }
            below = above;
        }
        faces.extend([[below[0], below[1], below[2]], [below[0], below[2], below[3]]]);
        (vertices, faces)
    }

    #[test]
    fn a_finger_goes_and_the_sheet_is_closed_where_it_stood() {
        let (vertices, faces) = sheet_with_finger(20, 4, 12);
        let observed = vec![true; faces.len()];
        let mut surface = Repaired::of(vertices, faces, observed);
        surface.cut_narrow();
        let (mesh, summary) = surface.into_mesh();
        assert!(summary.narrow_faces_dropped > 60, "{summary:?}");
        assert!(mesh.vertices().iter().all(|v| v.z <= 1.0));
        let borders = topology::boundary_loops(mesh.faces(), mesh.twins());
        assert_eq!((borders.len(), topology::components(mesh.twins()).1), (1, 1));
        assert!(mesh.observed().iter().filter(|o| !**o).count() >= 2, "what closes the hole is marked");
    }

    #[test]
    fn a_rough_sheet_and_a_thick_tube_are_not_narrow() {
        let (mut vertices, faces) = sheet_with_finger(20, 4, 1);
        vertices.iter_mut().for_each(|v| v.z += 0.6 * ((7.0 * v.x).sin() + (5.0 * v.y).cos()));
        let twin = topology::twins(&faces).unwrap();
        let narrow = narrow_vertices(&vertices, &faces, &twin);
        assert!(narrow.iter().all(|n| !n));
        let (columns, rows) = (9u32, 20u32);
        let tube: Vec<Vec3> = (0..rows * columns)
            .map(|k| {
                let (sin, cos) = (std::f64::consts::TAU * f64::from(k % columns) / f64::from(columns)).sin_cos();
                Vec3::new(cos, sin, 0.7 * f64::from(k / columns))
            })
            .collect();
        let faces: Vec<[VertexId; 3]> = (0..(rows - 1) * columns)
            .flat_map(|k| {
                let (i, j) = (k / columns, k % columns);
                let (a, b) = (i * columns + j, i * columns + (j + 1) % columns);
                [[a, b, b + columns], [a, b + columns, a + columns]]
            })
            .collect();
        let twin = topology::twins(&faces).unwrap();
        assert!(narrow_vertices(&tube, &faces, &twin).iter().all(|n| !n));
    }
}
