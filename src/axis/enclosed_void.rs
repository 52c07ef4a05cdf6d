//! The space that a scan encloses, on a coarse grid: where most directions run into scanned surface.
//!
//! A cell without points is enclosed when at least a share `E` of rays in evenly spread directions meets a cell with
//! points. Inside a tunnel nearly all rays do, except those that leave through a portal; outside of it, above a flat
//! outcrop or beside a single wall at least half of them do not. So the enclosed cells are the tunnel's void, the
//! places where it opens are its portals, and a scan without enclosed cells is no tunnel.
//!
//! Guarantees: no dependence on point order or threads. Cost: (cells of the void) x (rays) x (cells across).

use crate::numeric::Vec3;
use crate::spatial::VoxelGrid;
use rayon::prelude::*;

/// Rays sent from each cell.
const RAYS: usize = 64;
/// Most cells of the grid, occupied or not (one byte each).
const MAX_CELLS: f64 = 4e8;

/// What is known of a cell.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum State {
    Empty,
    Occupied,
    Enclosed,
}

/// A dense grid over the scan, padded by one empty cell on every side.
#[derive(Clone)]
pub(super) struct Grid {
    pub cell_m: f64,
    origin: Vec3,
    dims: [usize; 3],
    states: Vec<State>,
}

/// One connected enclosed space.
pub(super) struct EnclosedVoid {
    pub grid: Grid,
    /// Its cells, ascending.
    pub cells: Vec<usize>,
    /// Share of the occupied cells that border on it.
    pub enclosed_share: f64,
    /// Largest distance from a cell of it to the nearest occupied cell, metres.
    pub clearance_m: f64,
}

impl EnclosedVoid {
    /// Number of cells between each cell of the void and the nearest occupied one, at least 1, in the order of `cells`.
    pub fn layers(&self) -> Vec<u32> {
        layers(&self.grid, &self.cells)
    }

    /// The void without what is no more than two cells thin: the inside of a wall that was scanned from both sides, and
    /// leaks where the scan of a wall has holes. `None` when nothing is left.
    pub fn without_thin_parts(&self) -> Option<Self> {
        let grid = &self.grid;
        let is_core: Vec<bool> = self
            .cells
            .par_iter()
            .with_min_len(1024)
            .map(|&cell| grid.neighbours(cell, 26).all(|(n, _)| grid.states[n] != State::Occupied))
            .collect();
        let core = |cell: usize| self.cells.binary_search(&cell).is_ok_and(|i| is_core[i]);
        let mut thicker = grid.clone();
        for (i, &cell) in self.cells.iter().enumerate() {
            if !is_core[i] && !grid.neighbours(cell, 26).any(|(n, _)| core(n)) {
                thicker.states[cell] = State::Occupied;
            }
        }
        let (cells, _) = component_with_most_surface(&thicker)?;
        let clearance_m = clearance(&thicker, &cells) * thicker.cell_m;
        Some(Self { cells, enclosed_share: self.enclosed_share, clearance_m, grid: thicker })
    }
}

impl Grid {
    pub fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.dims[1] + y) * self.dims[0] + x
    }

    pub fn coordinates(&self, index: usize) -> [usize; 3] {
        let row = index / self.dims[0];
        [index % self.dims[0], row % self.dims[1], row / self.dims[1]]
    }

    pub fn centre(&self, index: usize) -> Vec3 {
        let c = self.coordinates(index);
        self.origin + Vec3::new(c[0] as f64 + 0.5, c[1] as f64 + 0.5, c[2] as f64 + 0.5) * self.cell_m
    }

    /// The cell around a point, if the point lies in the grid.
    pub fn cell_at(&self, point: &Vec3) -> Option<usize> {
        let p = (point - self.origin) / self.cell_m;
        let inside = (0..3).all(|a| p[a] >= 0.0 && p[a] < self.dims[a] as f64);
        inside.then(|| self.index([p.x as usize, p.y as usize, p.z as usize]))
    }

    pub fn state(&self, index: usize) -> State {
        self.states[index]
    }

    /// The neighbours of a cell that share a face with it (`count` = 6) or at least a corner (`count` = 26), with
    /// their distance in cells. Cells beyond the border are left out.
    pub fn neighbours(&self, index: usize, count: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
        let [x, y, z] = self.coordinates(index).map(|c| c as i64);
        (0..27_i64).filter(|&n| n != 13).filter_map(move |n| {
            let step = [n % 3 - 1, n / 3 % 3 - 1, n / 9 - 1];
            let moved: i64 = step.iter().map(|s| s.abs()).sum();
            let to = [x + step[0], y + step[1], z + step[2]];
            let inside = (0..3).all(|a| to[a] >= 0 && to[a] < self.dims[a] as i64);
            (inside && (count == 26 || moved == 1)).then(|| (self.index(to.map(|c| c as usize)), (moved as f64).sqrt()))
        })
    }

    fn occupied(points: &[Vec3], cell_m: f64) -> Option<Self> {
        let (low, high) = crate::spatial::voxel_grid::bounds(points)?;
        let origin = low.map(|c| (c / cell_m).floor() - 1.0) * cell_m;
        let dims: [usize; 3] = ((high - origin) / cell_m).map(|c| c.floor() as usize + 2).into();
        if dims.iter().map(|&d| d as f64).product::<f64>() > MAX_CELLS {
            return None;
        }
        let mut grid = Self { cell_m, origin, dims, states: vec![State::Empty; dims.iter().product()] };
        for p in points {
            let index = grid.cell_at(p).expect("the grid covers the points");
            grid.states[index] = State::Occupied;
        }
        Some(grid)
    }

    /// Whether at least `needed` rays from the centre of `cell` meet an occupied cell.
    fn is_enclosed(&self, cell: usize, rays: &[Vec3], needed: usize) -> bool {
        let mut allowed_to_miss = rays.len() - needed;
        for ray in rays {
            if !self.meets_occupied(cell, ray) {
                if allowed_to_miss == 0 {
                    return false;
                }
                allowed_to_miss -= 1;
            }
        }
        true
    }

    /// Walks from cell to cell along a ray (J. Amanatides, A. Woo, "A fast voxel traversal algorithm", 1987).
    fn meets_occupied(&self, from: usize, ray: &Vec3) -> bool {
        let mut at = self.coordinates(from).map(|c| c as i64);
        let step = [0, 1, 2].map(|a| if ray[a] > 0.0 { 1i64 } else { -1 });
        let across = [0, 1, 2].map(|a| 1.0 / ray[a].abs().max(1e-12));
        let mut next = across.map(|t| 0.5 * t);
        let stride = [1, self.dims[0] as i64, (self.dims[0] * self.dims[1]) as i64];
        let mut index = from as i64;
        loop {
            let axis = if next[0] < next[1] {
                if next[0] < next[2] { 0 } else { 2 }
            } else if next[1] < next[2] {
                1
            } else {
                2
            };
            at[axis] += step[axis];
            if at[axis] < 0 || at[axis] >= self.dims[axis] as i64 {
                return false;
            }
            next[axis] += across[axis];
            index += step[axis] * stride[axis];
            if self.states[index as usize] == State::Occupied {
                return true;
            }
        }
    }
}

/// The connected enclosed space that borders on most of the scan; `None` when nothing is enclosed or the grid would
/// be too large. `share` is `E`.
pub(super) fn enclosed_void(points: &[Vec3], cell_m: f64, share: f64) -> Option<EnclosedVoid> {
    let mut grid = Grid::occupied(points, cell_m)?;
    let rays = even_directions(RAYS);
    let needed = (share * RAYS as f64).ceil() as usize;
    let occupied: Vec<usize> = (0..grid.states.len()).filter(|&i| grid.states[i] == State::Occupied).collect();

    // Every enclosed space touches surface: begin at the cells beside it, then grow while cells are enclosed.
    let mut seen = vec![false; grid.states.len()];
    let mut front: Vec<usize> = Vec::new();
    for &cell in &occupied {
        for (n, _) in grid.neighbours(cell, 6) {
            if grid.states[n] == State::Empty && !seen[n] {
                seen[n] = true;
                front.push(n);
            }
        }
    }
    while !front.is_empty() {
        let enclosed: Vec<bool> =
            front.par_iter().with_min_len(64).map(|&cell| grid.is_enclosed(cell, &rays, needed)).collect();
        let mut next = Vec::new();
        for (&cell, _) in front.iter().zip(&enclosed).filter(|(_, e)| **e) {
            grid.states[cell] = State::Enclosed;
            for (n, _) in grid.neighbours(cell, 6) {
                if grid.states[n] == State::Empty && !seen[n] {
                    seen[n] = true;
                    next.push(n);
                }
            }
        }
        front = next;
    }
    drop(seen);

    let (cells, borders) = component_with_most_surface(&grid)?;
    let clearance_m = clearance(&grid, &cells) * cell_m;
    Some(EnclosedVoid { cells, enclosed_share: borders as f64 / occupied.len() as f64, clearance_m, grid })
}

fn component_with_most_surface(grid: &Grid) -> Option<(Vec<usize>, usize)> {
    let mut labelled = vec![false; grid.states.len()];
    let mut best: Option<(Vec<usize>, usize)> = None;
    for start in (0..grid.states.len()).filter(|&i| grid.states[i] == State::Enclosed) {
        if labelled[start] {
            continue;
        }
        labelled[start] = true;
        let mut cells = vec![start];
        let mut walls = Vec::new();
        let mut done = 0;
        while done < cells.len() {
            let cell = cells[done];
            done += 1;
            for (n, _) in grid.neighbours(cell, 6) {
                if grid.states[n] == State::Enclosed && !labelled[n] {
                    labelled[n] = true;
                    cells.push(n);
                }
            }
            walls.extend(grid.neighbours(cell, 26).map(|(n, _)| n).filter(|&n| grid.states[n] == State::Occupied));
        }
        walls.sort_unstable();
        walls.dedup();
        if best.as_ref().is_none_or(|(_, most)| walls.len() > *most) {
            cells.sort_unstable();
            best = Some((cells, walls.len()));
        }
    }
    best
}

/// Largest number of cells between a cell of the void and the nearest occupied one.
fn clearance(grid: &Grid, cells: &[usize]) -> f64 {
    f64::from(layers(grid, cells).into_iter().max().unwrap_or(0))
}

/// Number of cells between each cell of the void and the nearest occupied one, by peeling layers (26 and 6 neighbours in
/// turn, which makes the layers nearly round); 0 where none is reached.
fn layers(grid: &Grid, cells: &[usize]) -> Vec<u32> {
    let position = |cell: usize| cells.binary_search(&cell).ok();
    let mut layer = vec![0; cells.len()];
    let mut front: Vec<usize> = (0..cells.len())
        .filter(|&i| grid.neighbours(cells[i], 26).any(|(n, _)| grid.states[n] == State::Occupied))
        .collect();
    front.iter().for_each(|&i| layer[i] = 1);
    let mut depth = 1;
    while !front.is_empty() {
        depth += 1;
        let count = if depth % 2 == 1 { 26 } else { 6 };
        let mut next = Vec::new();
        for &i in &front {
            for (n, _) in grid.neighbours(cells[i], count) {
                if let Some(j) = position(n).filter(|&j| layer[j] == 0) {
                    layer[j] = depth;
                    next.push(j);
                }
            }
        }
        front = next;
    }
    layer
}

/// Directions spread evenly over the sphere (Fibonacci lattice: R. Swinbank, R. J. Purser, Q. J. R. Meteorol. Soc. 132,
/// 2006, doi:10.1256/qj.05.227).
fn even_directions(count: usize) -> Vec<Vec3> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..count)
        .map(|i| {
            let z = 1.0 - 2.0 * (i as f64 + 0.5) / count as f64;
            let radius = (1.0 - z * z).sqrt();
            let angle = golden * i as f64;
            Vec3::new(radius * angle.cos(), radius * angle.sin(), z)
        })
        .collect()
}

/// The cell edge at which about `wanted` cells hold points, metres.
pub(super) fn edge_for(points: &[Vec3], wanted: usize) -> f64 {
    let (low, high) = crate::spatial::voxel_grid::bounds(points).expect("there are points");
    let extent = (high - low).amax().max(1e-6);
    let (mut fine, mut coarse) = ((extent * 1e-6).ln(), extent.ln());
    while coarse - fine > 0.05 {
        let middle = 0.5 * (fine + coarse);
        if VoxelGrid::new(points, middle.exp()).len() > wanted { fine = middle } else { coarse = middle }
    }
    coarse.exp()
}
