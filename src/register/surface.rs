//! A thinned scan with a plane at each point, and the distances of another scan from it.

use crate::numeric::{Mat3, Vec3, statistics};
use crate::spatial::kd_tree::KdTree;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashSet;

/// One point in each cell of a grid, the first that came; cells grow so that the number stays bounded.
#[derive(Clone, Debug)]
pub struct Thinned {
    points: Vec<Vec3>,
    cells: HashSet<[i64; 3]>,
    cell_m: f64,
    most: usize,
}

impl Thinned {
    /// Cells of `cell_m` to begin with, never more than `most` points.
    pub fn new(cell_m: f64, most: usize) -> Self {
        Self { points: Vec::new(), cells: HashSet::new(), cell_m, most }
    }

    /// Takes a finite point, unless its cell has one.
    pub fn add(&mut self, point: &Vec3) {
        if self.cells.insert(self.cell(point)) {
            self.points.push(*point);
            while self.points.len() > self.most {
                self.coarsen();
            }
        }
    }

    /// The points, in the order in which they came.
    pub fn into_points(self) -> Vec<Vec3> {
        self.points
    }

    fn cell(&self, point: &Vec3) -> [i64; 3] {
        (point / self.cell_m).map(|c| c.floor() as i64).into()
    }

    fn coarsen(&mut self) {
        self.cell_m *= 1.5;
        self.cells.clear();
        let points = std::mem::take(&mut self.points);
        for point in points {
            if self.cells.insert(self.cell(&point)) {
                self.points.push(point);
            }
        }
    }
}

/// A plane through neighbouring points.
#[derive(Clone, Copy, Debug)]
pub(super) struct LocalPlane {
    pub(super) centre: Vec3,
    pub(super) normal: Vec3,
}

/// A thinned scan that others are compared with.
#[derive(Debug)]
pub struct Surface {
    tree: KdTree,
    /// The plane at each point; `None` where the neighbours lie in no plane.
    planes: Vec<Option<LocalPlane>>,
}

impl Surface {
    /// Fits planes to the neighbours of each of the finite `points` (metres).
    pub fn new(points: &[Vec3]) -> Self {
        /// The point and its neighbours: enough for a plane, few enough to stay local.
        const NEIGHBOURS: usize = 9;
        let tree = KdTree::new(points);
        let planes = points
            .par_iter()
            .map(|p| {
                let near: Vec<Vec3> = tree.nearest_n(p, NEIGHBOURS).iter().map(|n| points[n.index as usize]).collect();
                plane(&near)
            })
            .collect();
        Self { tree, planes }
    }

    /// The plane next to a point, if one is within `distance_m`.
    pub(super) fn plane_near(&self, point: &Vec3, distance_m: f64) -> Option<LocalPlane> {
        let near = self.tree.nearest(point).filter(|n| n.distance_squared <= distance_m * distance_m)?;
        self.planes[near.index as usize]
    }

    /// How far the points of another scan lie from this surface, over those within `distance_m`; `None` when there are
    /// fewer than [`Overlap::FEWEST`].
    pub fn overlap(&self, points: &[Vec3], distance_m: f64) -> Option<Overlap> {
        let mut residuals: Vec<f64> = points
            .par_iter()
            .filter_map(|p| self.plane_near(p, distance_m).map(|plane| (p - plane.centre).dot(&plane.normal).abs()))
            .collect();
        let matched = residuals.len();
        if matched < Overlap::FEWEST {
            return None;
        }
        Some(Overlap {
            points: matched,
            share_percent: 100.0 * matched as f64 / points.len() as f64,
            median_m: statistics::median(&mut residuals)?,
            p95_m: statistics::quantile(&mut residuals, 0.95)?,
        })
    }
}

/// How well a scan agrees with another one where they overlap: distances of points from local planes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Overlap {
    /// Thinned points that were compared.
    pub points: usize,
    /// Their share of all thinned points.
    pub share_percent: f64,
    /// Median distance from the plane, metres; half of the points may be anything without changing it.
    pub median_m: f64,
    /// Distance that 95 % of the points keep, metres.
    pub p95_m: f64,
}

impl Overlap {
    /// Fewer points say nothing.
    pub const FEWEST: usize = 200;
}

fn plane(points: &[Vec3]) -> Option<LocalPlane> {
    /// Thickness over width of neighbours that still are a plane.
    const FLAT: f64 = 0.25;
    /// Width over length below which they are a line.
    const LINE: f64 = 0.05;
    if points.len() < 5 {
        return None;
    }
    let centre = points.iter().sum::<Vec3>() / points.len() as f64;
    let scatter: Mat3 = points.iter().map(|p| (p - centre) * (p - centre).transpose()).sum();
    let eigen = scatter.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let [thin, wide, long] = order.map(|i| eigen.eigenvalues[i].max(0.0));
    let flat = thin <= FLAT * wide && wide > LINE * LINE * long;
    flat.then(|| LocalPlane { centre, normal: eigen.eigenvectors.column(order[0]).into_owned() })
}
