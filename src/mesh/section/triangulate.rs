//! Triangles between the nodes of the grid.

use super::support::Node;
use crate::mesh::VertexId;
use crate::numeric::Vec3;
use crate::segment::unrolled_grid::{Grid, GridPoint};
use rayon::prelude::*;

/// The present nodes as vertices, and two triangles for each complete square of them, one for three corners. `space` holds
/// the nodes in local metres; a face that is not filled counts as observed where `is_near_points` says so of its nodes.
pub(super) fn triangulate(
    grid: &Grid,
    state: &[Node],
    places: &[GridPoint],
    space: &[Vec3],
    is_near_points: impl Fn([usize; 3]) -> bool + Sync,
) -> (Vec<Vec3>, Vec<[VertexId; 3]>, Vec<bool>) {
    let mut id = vec![VertexId::MAX; grid.len()];
    let mut vertices = Vec::new();
    for n in (0..grid.len()).filter(|&n| state[n] != Node::Absent) {
        id[n] = vertices.len() as VertexId;
        vertices.push(space[n]);
    }
    let strips: Vec<Vec<([VertexId; 3], bool)>> = (0..grid.rows - 1)
        .into_par_iter()
        .map(|i| {
            let mut out = Vec::with_capacity(2 * grid.columns);
            for j in 0..grid.columns {
                let k = (j + 1) % grid.columns;
                // Counter-clockwise in (chainage, girth): along, around, back.
                let square = [
                    i * grid.columns + j,
                    (i + 1) * grid.columns + j,
                    (i + 1) * grid.columns + k,
                    i * grid.columns + k,
                ];
                let mut add = |corners: [usize; 3]| {
                    if corners.iter().all(|&n| id[n] != VertexId::MAX) {
                        let filled = corners.iter().any(|&n| matches!(state[n], Node::Filled | Node::Closed));
                        let seen = !filled && is_near_points(corners);
                        out.push((corners.map(|n| id[n]), seen));
                    }
                };
                let missing = square.iter().filter(|&&n| id[n] == VertexId::MAX).count();
                let [a, b, c, d] = square;
                match missing {
                    0 if splits_along_ac(grid, places, space, square) => {
                        add([a, b, c]);
                        add([a, c, d]);
                    }
                    0 => {
                        add([a, b, d]);
                        add([b, c, d]);
                    }
                    1 => [[a, b, c], [b, c, d], [c, d, a], [d, a, b]].into_iter().for_each(&mut add),
                    _ => {}
                }
            }
            out
        })
        .collect();
    let (mut faces, mut observed) = (Vec::new(), Vec::new());
    for (face, seen) in strips.into_iter().flatten() {
        faces.push(face);
        observed.push(seen);
    }
    (vertices, faces, observed)
}

/// Which diagonal of a square to take: one that keeps both triangles counter-clockwise on the grid, the shorter if both do.
fn splits_along_ac(grid: &Grid, places: &[GridPoint], space: &[Vec3], square: [usize; 4]) -> bool {
    let width = grid.columns as f64;
    let origin = places[square[0]];
    let plane = square.map(|n| {
        let dc = places[n].column - origin.column;
        [places[n].row - origin.row, dc - width * (dc / width).round()]
    });
    let area = |p: usize, q: usize, r: usize| {
        (plane[q][0] - plane[p][0]) * (plane[r][1] - plane[p][1])
            - (plane[q][1] - plane[p][1]) * (plane[r][0] - plane[p][0])
    };
    let ac = area(0, 1, 2).min(area(0, 2, 3));
    let bd = area(0, 1, 3).min(area(1, 2, 3));
    if ac <= 0.0 || bd <= 0.0 {
        return ac > bd;
    }
    let [a, b, c, d] = square.map(|n| space[n]);
    (c - a).norm_squared() <= (d - b).norm_squared()
}
