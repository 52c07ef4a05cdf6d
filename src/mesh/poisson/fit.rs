//! Moves the vertices of the level set onto the planes of the points around them, as far as there are points.
//!
//! The level set of a trilinear function is off by a part of a cell where the surface bends, and it curls where the points end,
//! because a Poisson surface closes. Both go away when each vertex moves along the mean normal by the weighted mean distance
//! from the planes of the points in the cells around it (moving least squares, see R. Kolluri, "Provably good moving least
//! squares", ACM TALG 4(2), 2008, doi:10.1145/1361192.1361195). Points are taken cell by cell, by their means, so that noise
//! is averaged however many there are. Points that face another way than the vertex belong to another sheet.

use super::octree;
use super::solve::Solution;
use crate::mesh::surface_nets::Net;
use crate::numeric::Vec3;
use rayon::prelude::*;
use std::collections::HashMap;

/// Width of the Gaussian weights, in cells.
const SIGMA: f64 = 0.6;
/// Weights that make a full step: one cell of points a sigma away. With less, the step is shorter in proportion.
const FULL_WEIGHT: f64 = 0.6;
/// Longest step, in cells.
const LONGEST: f64 = 0.7;
/// Least cosine between the normals of a vertex and of points of its sheet.
const SAME_SHEET: f64 = 0.3;

/// The points of a cell.
struct Patch {
    place: Vec3,
    normal: Vec3,
    area: f64,
}

/// Moves the vertices.
pub(super) fn onto_points(net: &mut Net, solution: &Solution) {
    let samples = &solution.samples;
    let grid = &solution.grid;
    let mut starts = vec![0];
    starts.extend((1..samples.keys.len()).filter(|&i| samples.keys[i] != samples.keys[i - 1]));
    starts.push(samples.keys.len());
    let patches: Vec<Patch> = starts
        .par_windows(2)
        .map(|w| {
            let (mut place, mut normal, mut area) = (Vec3::zeros(), Vec3::zeros(), 0.0);
            for i in w[0]..w[1] {
                place += samples.points[i] * samples.area[i];
                normal += samples.normals[i] * samples.area[i];
                area += samples.area[i];
            }
            Patch { place: place / area, normal: normal.try_normalize(0.0).unwrap_or_else(Vec3::zeros), area }
        })
        .collect();
    // Looked up only, never walked through.
    let of_cell: HashMap<u64, u32> =
        starts[..starts.len() - 1].iter().enumerate().map(|(k, &i)| (samples.keys[i], k as u32)).collect();
    let mut normals = vec![Vec3::zeros(); net.vertices.len()];
    for face in &net.faces {
        let [a, b, c] = face.map(|v| net.vertices[v as usize]);
        let area = (b - a).cross(&(c - a));
        face.iter().for_each(|&v| normals[v as usize] += area);
    }
    net.vertices.par_iter_mut().zip(&normals).for_each(|(v, normal)| {
        let Some(normal) = normal.try_normalize(0.0) else { return };
        let cell: [u32; 3] = ((*v - grid.origin) / grid.cell_m).map(|c| c as u32).into();
        let (mut sum, mut weights, mut mean, mut gauss) = (0.0, 0.0, Vec3::zeros(), 0.0);
        for o in 0..27u32 {
            let around = [o % 3, o / 3 % 3, o / 9];
            // A cell before the first is outside of the grid; its number wraps around and has no points.
            let key = octree::key_of([0, 1, 2].map(|a| (cell[a] + around[a]).wrapping_sub(1)));
            let Some(patch) = of_cell.get(&key).map(|&k| &patches[k as usize]) else { continue };
            if patch.normal.dot(&normal) < SAME_SHEET {
                continue;
            }
            let off = patch.place - *v;
            let g = (-off.norm_squared() / (2.0 * (SIGMA * grid.cell_m).powi(2))).exp();
            gauss += g;
            weights += g * patch.area;
            sum += g * patch.area * patch.normal.dot(&off);
            mean += g * patch.area * patch.normal;
        }
        if let Some(mean) = mean.try_normalize(0.0) {
            let step = (sum / weights).clamp(-LONGEST * grid.cell_m, LONGEST * grid.cell_m);
            *v += mean * (step * (gauss / FULL_WEIGHT).min(1.0));
        }
    });
}
