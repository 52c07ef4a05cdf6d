//! The *poisson* method: screened Poisson reconstruction on an octree, trimmed by its points.
//!
//! Use it for what is not star-shaped around the axis: caves, junctions, pillars, deep overhangs. It needs no axis to tell
//! depth, only to tell which side is the void (`void_side`). On a regular tunnel `section` is faster and as exact.
//!
//! Method. A function is sought whose gradient is the density of the points' normals and which has one value at the
//! points: M. Kazhdan, M. Bolitho, H. Hoppe, "Poisson surface reconstruction", SGP 2006, doi:10.2312/SGP/SGP06/061-070;
//! M. Kazhdan, H. Hoppe, "Screened Poisson surface reconstruction", ACM TOG 32(3), 2013, doi:10.1145/2487228.2487237. It is
//! solved on an octree that is as deep as the points are dense, from coarse to fine (`octree`, `solve`), its level set comes
//! out of `surface_nets` (`extract`) and is moved onto the points (`fit`), and everything that no point supports goes or is marked (`support`).
//!
//! Scans of profiles are compressed along the axis meanwhile (`compressed`); there, distances along it count less.
//!
//! Departures from the papers: trilinear functions, nested so that each level takes the coarser one's values at its rim;
//! a point is spread at one depth, not between two; the points' own areas come from their density one level up; the
//! level set is taken on the finest cells only, near points only, and trimmed by distance instead of density.
//!
//! Guarantees: no face farther from a point than `max_gap_m` (or a cell) unless it is marked filled; same bytes on any
//! number of threads. Cost: linear in points and surface but for sorts.

mod compressed;
mod extract;
mod fit;
mod octree;
mod solve;
mod support;
#[cfg(test)]
mod tests;

use super::void_side::{self, Sides};
use crate::axis::Axis;
use crate::normals;
use crate::numeric::Vec3;
use crate::spatial::KdTree;
use crate::spatial::voxel_grid::bounds;
use crate::warning::Warning;
pub(super) use compressed::Compressed;
use rayon::prelude::*;
use serde::Serialize;
pub(super) use support::Raw;

/// Neighbours that make the plane of a point.
const NEIGHBOURS: usize = 16;
/// Default cell in distances between points, and not finer than this share of the perimeter (5 cm in a rail tunnel).
const CELL_IN_POINT_DISTANCES: f64 = 1.3;
const FINEST_SHARE_OF_PERIMETER: f64 = 1.0 / 550.0;
/// How far from the axis one looks for ways around the rock, in mean radii, along the edges of cells.
const WAY_IN_RADII: f64 = 4.0;
/// Support reaches at least this many cells from a point.
const LEAST_GAP_IN_CELLS: f64 = 1.0;

/// What the method was asked for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Options {
    /// Edge of a cell; chosen from the points when not given.
    pub spacing_m: Option<f64>,
    pub max_gap_m: f64,
    pub fill_hole_m: f64,
    /// Mean perimeter of the section, metres.
    pub perimeter_m: f64,
}

impl Options {
    /// Edge of a cell for points at this distance from each other.
    fn cell(&self, point_distance_m: f64) -> f64 {
        let chosen = CELL_IN_POINT_DISTANCES * point_distance_m;
        self.spacing_m.unwrap_or_else(|| chosen.max(self.perimeter_m * FINEST_SHARE_OF_PERIMETER))
    }
}

/// What was done, for the report.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Summary {
    /// Edge of a cell of the finest level, metres.
    pub spacing_m: f64,
    /// Length of a cell along the axis where a scan of profiles was compressed, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spacing_along_m: Option<f64>,
    /// Points given.
    pub points_used: usize,
    /// Points dropped because no side of them can be reached from the axis: buried inside the rock.
    pub points_hidden: usize,
    /// Points whose side was not clear; they face the axis.
    pub points_unclear: usize,
    /// Levels of the octree.
    pub levels: usize,
    /// Points spread at each level, the coarsest first: fewer at the finest where the scan is sparse.
    pub points_of_level: Vec<usize>,
    /// Nodes of the finest level.
    pub nodes: usize,
    /// Steps of the solver on each level, the coarsest first.
    pub solver_steps: Vec<usize>,
    /// Levels on which the residual did not fall as far as wanted.
    pub levels_not_converged: usize,
    /// Blocks of the grid that the surface was taken from.
    pub blocks: usize,
    /// Support: faces with a corner farther than this from every point are filled or dropped, metres.
    pub gap_m: f64,
    /// Faces dropped because they lay farther than `gap_m` from every point.
    pub unsupported_faces_dropped: usize,
    /// Faces dropped at borders because they reached more than half a cell beyond the points.
    pub overhanging_faces_dropped: usize,
    /// Faces that close holes narrower than `fill_hole_m`.
    pub faces_filled: usize,
}

impl Summary {
    /// What a person should know of the solve; `spacing_m` is the cell that was asked for.
    pub(super) fn warning(&self, spacing_m: Option<f64>) -> Option<Warning> {
        if self.levels_not_converged > 0 {
            return Some(Warning::new(
                "poisson-not-converged",
                format!(
                    "the Poisson equation was not solved as far as wanted on {} of {} levels; the surface may lie off by a \
                     part of a cell ({:.3} m)",
                    self.levels_not_converged, self.levels, self.spacing_m
                ),
            ));
        }
        let asked = spacing_m.filter(|&s| s < self.spacing_m)?;
        Some(Warning::new(
            "poisson-cells-enlarged",
            format!(
                "mesh.spacing_m = {asked} is too fine for a scan of this extent; {:.3} m was used: crop the scan",
                self.spacing_m
            ),
        ))
    }
}

/// Builds the surface; see the module's header.
/// `walls` are all points that block the way, those of the surface included.
pub(super) fn reconstruct(points: Vec<Vec3>, walls: &[Vec3], axis: &Axis, options: &Options) -> (Raw, Summary) {
    let spacing_m = spacing(&points);
    let cell_m = options.cell(spacing_m);
    let mut normals = normals::unoriented(&points, NEIGHBOURS);
    let Sides { hidden, unclear } = void_side::face_the_void(
        &points,
        &mut normals,
        walls,
        axis,
        spacing_m,
        WAY_IN_RADII * options.perimeter_m / std::f64::consts::TAU,
    );
    let given = points.len();
    let (points, normals): (Vec<Vec3>, Vec<Vec3>) =
        points.into_iter().zip(normals).zip(&hidden).filter(|(_, h)| !**h).map(|(both, _)| both).unzip();
    let (raw, mut summary) = surface_of(&points, &normals, cell_m, options.max_gap_m, options.fill_hole_m);
    summary.points_used = given;
    summary.points_hidden = given - points.len();
    summary.points_unclear = unclear;
    (raw, summary)
}

/// The trimmed surface of points whose unit normals face the void.
fn surface_of(points: &[Vec3], normals: &[Vec3], cell_m: f64, max_gap_m: f64, fill_hole_m: f64) -> (Raw, Summary) {
    let mut summary = Summary { spacing_m: cell_m, points_used: points.len(), ..Summary::default() };
    let Some((low, high)) = bounds(points) else {
        return (Raw { vertices: Vec::new(), faces: Vec::new(), observed: Vec::new() }, summary);
    };
    let grid = octree::Grid::around(low, high, cell_m);
    summary.spacing_m = grid.cell_m;
    summary.gap_m = max_gap_m.max(LEAST_GAP_IN_CELLS * grid.cell_m);
    let solution = solve::solve(grid, points, normals);
    summary.levels = solution.levels.len();
    summary.points_of_level = vec![0; summary.levels];
    solution.samples.depth.iter().for_each(|&d| summary.points_of_level[d as usize] += 1);
    summary.nodes = solution.levels[summary.levels - 1].len();
    summary.solver_steps = solution.steps.iter().map(|s| s.0).collect();
    summary.levels_not_converged = solution.steps.iter().filter(|s| !s.1).count();
    let (mut net, blocks) = extract::surface(&solution, summary.gap_m.max(fill_hole_m / 2.0));
    summary.blocks = blocks;
    fit::onto_points(&mut net, &solution);
    drop(solution);
    (support::trim(net, points, fill_hole_m, &mut summary), summary)
}

/// Typical distance between neighbouring points, metres: of the square that each has on the surface.
fn spacing(points: &[Vec3]) -> f64 {
    const SAMPLE: usize = 4000;
    const AROUND: usize = 8;
    if points.len() <= AROUND {
        return 1.0;
    }
    let tree = KdTree::new(points);
    let mut areas: Vec<f64> = points
        .par_iter()
        .step_by(points.len().div_ceil(SAMPLE))
        .map(|p| tree.nearest_n(p, AROUND + 1).last().map_or(0.0, |n| n.distance_squared) * std::f64::consts::PI)
        .collect();
    (crate::numeric::statistics::median(&mut areas).unwrap_or(1.0) / AROUND as f64).sqrt().max(1e-6)
}

/// The trimmed surface of points whose unit normals face the void, as vertices, faces and whether a face is observed: the
/// method without a tunnel around it. Farther than `max_gap_m` from points nothing is kept but what closes holes
/// narrower than `fill_hole_m`. The faces are oriented but may still branch at single edges.
pub fn of_oriented_points(
    points: &[Vec3],
    normals: &[Vec3],
    cell_m: f64,
    max_gap_m: f64,
    fill_hole_m: f64,
) -> (Vec<Vec3>, Vec<[super::VertexId; 3]>, Vec<bool>, Summary) {
    let (raw, summary) = surface_of(points, normals, cell_m, max_gap_m, fill_hole_m);
    (raw.vertices, raw.faces, raw.observed, summary)
}
