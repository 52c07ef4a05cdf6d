//! Whether points lie near a face, in space: the grid tells it only for surfaces that run along the mean section.

use super::clusters::Cluster;
use super::support::Node;
use crate::numeric::Vec3;
use crate::segment::unrolled_grid::{CellPoints, Grid};
use rayon::prelude::*;

/// The points of the surface in local metres, by the cell they lie in.
pub(super) struct PointsNear<'a> {
    grid: &'a Grid,
    /// First point of each cell, one more than there are cells.
    first: Vec<u32>,
    points: Vec<Vec3>,
    reach_m: f64,
}

impl<'a> PointsNear<'a> {
    /// Takes the points of each cell's cluster; `reach_m` is how far a point speaks for the surface, `point` tells where the
    /// points of `cells` are.
    pub fn new(
        grid: &'a Grid,
        cells: &CellPoints,
        clusters: &[Cluster],
        reach_m: f64,
        point: impl Fn(usize) -> Vec3 + Sync,
    ) -> Self {
        let of_surface = |cell: usize| {
            let cluster = clusters[cell];
            let inside = move |depth: f64| cluster.count > 0 && depth >= cluster.low && depth <= cluster.high;
            let points = cells.in_cell(cell).iter().zip(cells.indices_in_cell(cell));
            points.filter(move |(p, _)| inside(p.depth)).map(|(_, &index)| index)
        };
        let mut first = Vec::with_capacity(grid.len() + 1);
        let mut indices: Vec<u32> = Vec::with_capacity(cells.len());
        for cell in 0..grid.len() {
            first.push(indices.len() as u32);
            indices.extend(of_surface(cell));
        }
        first.push(indices.len() as u32);
        let points = indices.par_iter().map(|&i| point(i as usize)).collect();
        Self { grid, first, points, reach_m }
    }

    /// How far each node of the surface is from a point, in metres: at most this where its cell has points, and infinite
    /// where no point is within reach.
    pub fn distances(&self, state: &[Node], space: &[Vec3]) -> Vec<f32> {
        let distance = |n: usize| match state[n] {
            Node::Measured => self.nearest_in(n, &space[n]).sqrt() as f32,
            Node::Bridged if self.is_near(&space[n], n) => self.reach_m as f32,
            _ => f32::INFINITY,
        };
        (0..self.grid.len()).into_par_iter().map(distance).collect()
    }

    /// Whether the middle and the corners of a face are within reach of points; of its nodes are given their places and their
    /// [`Self::distances`].
    pub fn support(&self, nodes: [usize; 3], space: &[Vec3], to_points: &[f32]) -> bool {
        let corners = nodes.map(|n| (space[n], f64::from(to_points[n])));
        let middle = corners.iter().map(|(p, _)| p).sum::<Vec3>() / 3.0;
        let at_most = corners.iter().map(|(p, d)| (p - middle).norm() + d).fold(f64::INFINITY, f64::min);
        corners.iter().all(|(_, d)| *d <= self.reach_m * (1.0 + 1e-6))
            && (at_most <= self.reach_m || self.is_near(&middle, nodes[0]))
    }

    /// Squared distance to the nearest point in a cell.
    fn nearest_in(&self, cell: usize, place: &Vec3) -> f64 {
        let points = &self.points[self.first[cell] as usize..self.first[cell + 1] as usize];
        points.iter().map(|p| (p - place).norm_squared()).fold(f64::INFINITY, f64::min)
    }

    /// Whether a point of the surface lies within reach of a place at `cell` or beside it.
    fn is_near(&self, place: &Vec3, cell: usize) -> bool {
        let within = |n: usize| self.nearest_in(n, place) <= self.reach_m * self.reach_m;
        // One more cell than the reach, because the place may lie beside its cell.
        let far = (self.reach_m / self.grid.column_m.min(self.grid.row_m)).ceil() as usize + 1;
        within(cell)
            || self.grid.neighbours(cell, 1).any(within)
            || (far > 1 && self.grid.neighbours(cell, far).any(within))
    }
}
