//! Lays patches of a chart anew, so that nothing in them folds: a weighted Tutte embedding inside the fixed rest.
//!
//! Use it where a chart is tangled over more than a few rings of faces; a sweep of local means gets nowhere there. It is
//! exact for a patch with a convex rim, and nearly always enough for a patch that is much larger than the tangle.
//!
//! Each free vertex goes to the weighted mean of its neighbours (W. T. Tutte, "How to draw a graph", Proc. London Math.
//! Soc. 13, 1963, doi:10.1112/plms/s3-13.1.743; weights 1 / edge length on the surface). Departures: a hole of the
//! surface counts as filled by one vertex that is joined to all of its rim, so that it keeps its room; the free part of
//! the outer border lies on a slightly bulging arc between its ends, by arc length, so that no face on it is left
//! without area. Cost: one sparse Cholesky factorisation of the free vertices.

use crate::mesh::{Mesh, topology};
use crate::numeric::sparse::{self, Cholesky, Pattern};
use crate::numeric::{Vec2, Vec3};

/// Height of the arc that the outer border lies on, as a share of its chord.
const BULGE: f64 = 0.02;
/// Edges count as at least this long, metres.
const SHORTEST_M: f64 = 1e-9;

/// Places for the free vertices; the others keep theirs. `None` when a border has no fixed vertex to hang on.
///
/// # Errors
/// What the sparse solver refuses.
pub(super) fn embed(mesh: &Mesh, is_free: &[bool], uv: &[Vec2]) -> Result<Option<Vec<Vec2>>, sparse::Error> {
    let twin = mesh.twins();
    let mut places = uv.to_vec();
    let mut is_unknown = is_free.to_vec();
    let mut holes: Vec<Vec<u32>> = Vec::new();
    let borders = topology::boundary_loops(mesh.faces(), twin);
    let extent = |border: &[u32]| {
        let at = |k: usize| uv[border[k % border.len()] as usize];
        (0..border.len()).map(|k| at(k).perp(&at(k + 1))).sum::<f64>().abs()
    };
    // All others lie inside the outer one.
    let outer = (0..borders.len()).max_by(|&a, &b| extent(&borders[a]).total_cmp(&extent(&borders[b])));
    for (k, border) in borders.into_iter().enumerate() {
        if !border.iter().any(|&v| is_free[v as usize]) {
            continue;
        }
        if Some(k) != outer {
            holes.push(border);
        } else if !lay_border(mesh, &border, is_free, &mut places) {
            return Ok(None);
        } else {
            border.iter().for_each(|&v| is_unknown[v as usize] = false);
        }
    }
    const FIXED: u32 = u32::MAX;
    let mut unknowns = 0;
    let mut number = vec![FIXED; uv.len()];
    for (n, _) in number.iter_mut().zip(&is_unknown).filter(|(_, u)| **u) {
        *n = unknowns;
        unknowns += 1;
    }
    // (one end, other end, weight); ends beyond the vertices are the middles of holes.
    let mut springs: Vec<(u32, u32, f64)> = Vec::new();
    let length = |a: &Vec3, b: &Vec3| (a - b).norm().max(SHORTEST_M);
    for (f, corners) in mesh.faces().iter().enumerate() {
        for k in 0..3 {
            let (edge, a, b) = (3 * f + k, corners[k], corners[(k + 1) % 3]);
            let once = twin[edge] == topology::NO_TWIN || twin[edge] as usize > edge;
            if once && (is_unknown[a as usize] || is_unknown[b as usize]) {
                springs.push((a, b, 1.0 / length(&mesh.vertices()[a as usize], &mesh.vertices()[b as usize])));
            }
        }
    }
    for rim in &holes {
        let middle = rim.iter().map(|&v| mesh.vertices()[v as usize]).sum::<Vec3>() / rim.len() as f64;
        let hub = number.len() as u32;
        number.push(unknowns);
        unknowns += 1;
        springs.extend(rim.iter().map(|&v| (hub, v, 1.0 / length(&middle, &mesh.vertices()[v as usize]))));
    }
    let inner = || {
        let ends = springs.iter().map(|&(a, b, _)| (number[a as usize], number[b as usize]));
        ends.filter(|&(a, b)| a != FIXED && b != FIXED)
    };
    let pattern = Pattern::of_pairs(unknowns as usize, inner)?;
    let mut values = vec![0.0; pattern.entries()];
    let mut right = [vec![0.0; unknowns as usize], vec![0.0; unknowns as usize]];
    for &(a, b, weight) in &springs {
        for (from, to) in [(a, b), (b, a)] {
            let (i, j) = (number[from as usize], number[to as usize]);
            if i == FIXED {
                continue;
            }
            values[pattern.diagonal(i as usize)] += weight;
            if j == FIXED {
                let place = places[to as usize];
                right[0][i as usize] += weight * place.x;
                right[1][i as usize] += weight * place.y;
            }
        }
        let (i, j) = (number[a as usize], number[b as usize]);
        if i != FIXED && j != FIXED {
            values[pattern.slot(i, j).expect("the pattern was made of these pairs")] -= weight;
        }
    }
    let factor = Cholesky::of(&pattern, &values)?;
    let [x, y] = right.map(|r| factor.solve_refined(&pattern, &values, &r));
    for (place, &n) in places.iter_mut().zip(&number).filter(|(_, n)| **n != FIXED) {
        *place = Vec2::new(x[n as usize], y[n as usize]);
    }
    Ok(Some(places))
}

/// Lays each free stretch of a border on an arc between the fixed vertices at its ends; false when all of it is free.
fn lay_border(mesh: &Mesh, border: &[u32], is_free: &[bool], places: &mut [Vec2]) -> bool {
    let n = border.len();
    let Some(first) = border.iter().position(|&v| !is_free[v as usize]) else { return false };
    let vertex = |k: usize| border[(first + k) % n] as usize;
    let mut start = 0;
    while start < n {
        let end = (start + 1..=n).find(|&k| !is_free[vertex(k)]).unwrap_or(n);
        let mut gone = vec![0.0];
        for k in start..end {
            let step = (mesh.vertices()[vertex(k + 1)] - mesh.vertices()[vertex(k)]).norm().max(SHORTEST_M);
            gone.push(gone[k - start] + step);
        }
        let (from, to) = (places[vertex(start)], places[vertex(end)]);
        let chord = to - from;
        let outwards = Vec2::new(chord.y, -chord.x);
        for k in start + 1..end {
            let t = gone[k - start] / gone[end - start];
            places[vertex(k)] = from + chord * t + outwards * (4.0 * BULGE * t * (1.0 - t));
        }
        start = end;
    }
    true
}
