//! Trims the surface by its points: what lies farther from every point than the stated distance is *filled* when it closes a
//! hole, and removed when it hangs over an edge.

use super::Summary;
use crate::mesh::surface_nets::Net;
use crate::mesh::{VertexId, repair, topology};
use crate::numeric::Vec3;
use crate::spatial::KdTree;
use rayon::prelude::*;

/// Arrays of a surface that is not repaired yet.
pub(in crate::mesh) struct Raw {
    pub vertices: Vec<Vec3>,
    pub faces: Vec<[VertexId; 3]>,
    pub observed: Vec<bool>,
}

/// At a border, where nothing but the surface's own inertia leads on, faces reach at most this many cells beyond the points.
const OVERHANG_IN_CELLS: f64 = 0.5;

/// Keeps observed faces, whose corners and middle lie within `gap_m` of a point, and unobserved ones that close a hole: connected,
/// not on a border, and nowhere farther from a point than half of `fill_hole_m`. Then borders recede to where the points end.
pub(super) fn trim(net: Net, points: &[Vec3], fill_hole_m: f64, summary: &mut Summary) -> Raw {
    let gap_m = summary.gap_m;
    let Net { vertices, faces } = net;
    let tree = KdTree::new(points);
    let far: Vec<f64> =
        vertices.par_iter().map(|v| tree.nearest(v).map_or(f64::INFINITY, |n| n.distance_squared.sqrt())).collect();
    let is_observed = |f: &[VertexId; 3]| {
        let middle = f.iter().map(|&v| vertices[v as usize]).sum::<Vec3>() / 3.0;
        let at_most = f.iter().map(|&v| (vertices[v as usize] - middle).norm() + far[v as usize]);
        f.iter().all(|&v| far[v as usize] <= gap_m)
            && (at_most.fold(f64::INFINITY, f64::min) <= gap_m
                || tree.nearest(&middle).is_some_and(|n| n.distance_squared <= gap_m * gap_m))
    };
    let observed: Vec<bool> = faces.par_iter().map(is_observed).collect();
    // Sheets that touch must not count as borders here, so edges are looked at as they come.
    let (twin, _) = topology::lenient_twins(&faces);
    let mut keep = observed.clone();
    let mut done = observed.clone();
    for seed in 0..faces.len() {
        if done[seed] {
            continue;
        }
        done[seed] = true;
        let mut region = vec![seed];
        let mut next = 0;
        let mut closes = fill_hole_m > 0.0;
        while next < region.len() {
            let f = region[next];
            next += 1;
            closes &= faces[f].iter().all(|&v| far[v as usize] <= fill_hole_m / 2.0);
            for &t in &twin[3 * f..3 * f + 3] {
                if t == topology::NO_TWIN {
                    closes = false;
                } else if !done[(t / 3) as usize] {
                    done[(t / 3) as usize] = true;
                    region.push((t / 3) as usize);
                }
            }
        }
        if closes {
            summary.faces_filled += region.len();
            region.iter().for_each(|&f| keep[f] = true);
        }
    }
    recede(&mut keep, &observed, &faces, &twin, &far, summary);
    summary.unsupported_faces_dropped = keep.iter().filter(|k| !**k).count() - summary.overhanging_faces_dropped;
    let (faces, observed): (Vec<_>, Vec<_>) =
        faces.into_iter().zip(observed).zip(&keep).filter(|(_, k)| **k).map(|(both, _)| both).unzip();
    let (vertices, faces) = repair::compact(vertices, faces);
    Raw { vertices, faces, observed }
}

/// Takes faces off the borders, layer by layer, that reach too far beyond the points; as many layers as the support is wide.
fn recede(
    keep: &mut [bool],
    observed: &[bool],
    faces: &[[VertexId; 3]],
    twin: &[u32],
    far: &[f64],
    summary: &mut Summary,
) {
    let overhang_m = OVERHANG_IN_CELLS * summary.spacing_m;
    // A layer of cells is two of triangles.
    let layers = 2 * (summary.gap_m / summary.spacing_m).ceil() as usize;
    for _ in 0..layers {
        let hangs = |f: usize| {
            keep[f]
                && observed[f]
                && faces[f].iter().any(|&v| far[v as usize] > overhang_m)
                && twin[3 * f..3 * f + 3].iter().any(|&t| t == topology::NO_TWIN || !keep[(t / 3) as usize])
        };
        let gone: Vec<usize> = (0..faces.len()).filter(|&f| hangs(f)).collect();
        if gone.is_empty() {
            return;
        }
        summary.overhanging_faces_dropped += gone.len();
        gone.into_iter().for_each(|f| keep[f] = false);
    }
}
