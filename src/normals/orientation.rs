//! Which of its two sides a normal faces: the void.
//!
//! The surface was seen from the void, so a normal faces the scanner station that saw the point, or, where stations are
//! unknown, the axis. Where that direction runs almost along the surface (niche cheeks, steps, ducts) it says little;
//! there the neighbours with a clear direction vote, and then the neighbours' neighbours, until nothing changes.

use crate::axis::Axis;
use crate::numeric::Vec3;
use crate::spatial::nearest::BundleTree;
use rayon::prelude::*;

/// Cosine between normal and direction to the void below which neighbours decide.
const EDGE_ON: f64 = 0.15;
/// Neighbours that vote.
const VOTERS: usize = 12;
/// Rounds of voting.
const ROUNDS: usize = 8;
/// Consecutive points that share one look-up of the axis: they are neighbours in space.
const BLOCK: usize = 32;

pub(super) struct Verdict {
    pub by_station: usize,
    pub by_neighbours: usize,
}

/// Turns `normals` towards the void; `tree` is over the points.
pub(super) fn orient(
    normals: &mut [Vec3],
    points: &[Vec3],
    tree: &BundleTree,
    axis: &Axis,
    station_of: impl Fn(usize) -> Option<Vec3> + Sync,
) -> Verdict {
    let clear: Vec<(bool, bool)> = normals
        .par_chunks_mut(BLOCK)
        .enumerate()
        .flat_map_iter(|(block, normals)| {
            let first = block * BLOCK;
            // Neighbours in memory share their place on the axis, unless the curve jumped.
            let mut at = points[first];
            let mut on_axis = axis.nearest_sample(&at);
            let station_of = &station_of;
            normals.iter_mut().enumerate().map(move |(k, normal)| {
                let i = first + k;
                let point = points[i];
                let station = station_of(i);
                let target = station.unwrap_or_else(|| {
                    if (point - at).norm_squared() > 0.04 {
                        at = point;
                        on_axis = axis.nearest_sample(&point);
                    }
                    on_axis
                });
                let towards = target - point;
                let cosine = normal.dot(&towards) / towards.norm().max(1e-12);
                if cosine < 0.0 {
                    *normal = -*normal;
                }
                (cosine.abs() >= EDGE_ON, station.is_some())
            })
        })
        .collect();
    let by_station = clear.iter().filter(|c| c.0 && c.1).count();
    let unclear: Vec<usize> = (0..points.len()).filter(|&i| !clear[i].0).collect();
    if unclear.is_empty() {
        return Verdict { by_station, by_neighbours: 0 };
    }
    let voters: Vec<Vec<u32>> = unclear
        .par_iter()
        .zip(tree.places_of(&unclear))
        .map(|(&i, place)| {
            tree.nearest(place, VOTERS + 1).iter().map(|n| n.index).filter(|&n| n as usize != i).collect()
        })
        .collect();
    let mut decided: Vec<bool> = clear.iter().map(|c| c.0).collect();
    for _ in 0..ROUNDS {
        let votes: Vec<Option<bool>> = unclear
            .par_iter()
            .zip(&voters)
            .map(|(&i, voters)| {
                // Parallel normals speak for the same side; perpendicular ones say nothing.
                let sum: f64 = voters
                    .iter()
                    .filter(|&&n| decided[n as usize])
                    .map(|&n| {
                        let cosine = normals[i].dot(&normals[n as usize]);
                        cosine * cosine.abs()
                    })
                    .sum();
                (sum != 0.0).then_some(sum < 0.0)
            })
            .collect();
        let mut changed = false;
        for (&i, vote) in unclear.iter().zip(votes) {
            if let Some(flip) = vote {
                changed |= flip || !decided[i];
                decided[i] = true;
                if flip {
                    normals[i] = -normals[i];
                }
            }
        }
        if !changed {
            break;
        }
    }
    Verdict { by_station, by_neighbours: unclear.len() }
}
