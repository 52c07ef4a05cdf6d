//! The *section* method: the surface as one depth for each cell of a grid unrolled around the mean section.
//!
//! Use it for everything that is star-shaped around its axis up to small overhangs: drifts, rail and road tunnels, sewers,
//! shafts. It needs no solve, runs in linear time and cannot fold over. Caves and junctions, where a ray from the axis
//! meets the surface more than once, lose what lies behind the first surface; [`Summary::multiple_depth_percent`] tells.
//!
//! Method. The points are sorted into cells of (chainage, girth). In each cell the dominant cluster of depths is chosen,
//! with a preference for the one that continues its neighbours; cells that nothing around them agrees with are dropped.
//! A plane is fitted to the cluster and its neighbours by weighted least squares with a robust second round (moving least
//! squares, D. Levin, "The approximation power of moving least-squares", Math. Comp. 67, 1998,
//! doi:10.1090/S0025-5718-98-00974-0), and evaluated at the cluster's centroid. Cells without points but within
//! `max_gap_m` of one belong to the observed surface; narrower gaps than `fill_hole_m` (a morphological closing) are
//! filled and marked as such; both get their depth from a thin plate through the neighbours. Over a side opening that is to be
//! closed, lines along the tunnel run straight from the wall before it to the wall after it. Four neighbouring cells make two
//! triangles.
//!
//! | symbol | meaning |
//! |---|---|
//! | `h` | column width of the grid, the target spacing |
//! | `d` | depth: distance from the axis minus mean radius, positive into the rock |
//!
//! Guarantees: oriented manifold, faces counter-clockwise in (chainage, girth), no face wider than the cells it spans,
//! same bytes on any number of threads. Cost: linear in points and cells; 24 bytes a point and 60 a cell.

use super::openings::SideOpenings;
use super::repair;
use super::wall_line::WallLine;
use super::{Mesh, VertexId};
use crate::axis::Axis;
use crate::numeric::{Mat3, Vec3, statistics};
use crate::segment::unrolled_grid::{CellPoints, Grid, GridPoint, squared_distance};
use crate::segment::{Class, SectionField, Segmentation};
use rayon::prelude::*;
use serde::Serialize;

/// Default spacing in units of the distance between points: about 1.5 points a cell.
const SPACING_IN_POINT_DISTANCES: f64 = 1.2;
/// Default spacing is not finer than this share of the perimeter (4.4 cm in a rail tunnel).
const FINEST_SHARE_OF_PERIMETER: f64 = 1.0 / 600.0;
/// Longest side ratio of the cells of a profile scan.
const MAX_CELL_ASPECT: f64 = 4.0;
/// A profile scan tells less along the axis, so its cells are wider: this share of the perimeter.
const FINEST_SHARE_OF_PROFILE: f64 = 1.0 / 400.0;
/// Steepest slope of the depth, metres a metre, that still counts as the same surface.
const MAX_SLOPE: f64 = 2.5;
/// Scatter of points around the surface that is always allowed, metres.
const NOISE_ALLOWANCE_M: f64 = 0.012;
/// How far a vertex may move from the middle of its cell, in cells.
const MAX_SHIFT: f64 = 0.3;
/// Width of the fitting weights, in cells.
const FIT_SIGMA: f64 = 0.7;
/// A cell with more points than this is never taken for an outlier.
const BUMP_POINTS: u32 = 2;
/// How far a lonely point may stick out, in robust standard deviations of its neighbours.
const BUMP_IN_SCALES: f64 = 5.0;
/// A face between cells without points is observed when they are within this share of `max_gap_m` of one.
const NEAR_SHARE: f64 = 0.6;
/// Sweeps of the thin-plate fill; gaps of ten cells are smooth by then.
const FILL_SWEEPS: usize = 60;

/// What the method was asked for; a copy of the keys in [`super::reconstruct::Settings`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Options {
    pub spacing_m: Option<f64>,
    pub max_gap_m: f64,
    pub fill_hole_m: f64,
    pub fill_behind_furniture_m: f64,
    pub side_openings: SideOpenings,
}

/// What was done, for the report.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Summary {
    /// Width of the cells around the section, metres.
    pub spacing_m: f64,
    /// Length of the cells along the axis, metres (longer for profile scans).
    pub spacing_along_m: f64,
    /// Points of the tunnel's surface that were used.
    pub points_used: usize,
    /// Cells with points.
    pub cells_with_points: usize,
    /// Cells dropped because nothing around them agrees with their depth.
    pub isolated_cells_dropped: usize,
    /// Cells of few points dropped because they stick out of the surface around them.
    pub bumps_dropped: usize,
    /// Share of cells with points at two or more clearly different depths, percent.
    pub multiple_depth_percent: f64,
    /// Cells without points that lie within `max_gap_m` of one: part of the observed surface.
    pub cells_bridged: usize,
    /// Cells in holes narrower than `fill_hole_m` that were filled.
    pub cells_filled: usize,
    /// Cells of side openings that were closed.
    pub cells_closed: usize,
    /// Vertices split because two parts of the surface touched in a point.
    pub vertices_split: usize,
    /// Components smaller than the largest that were dropped.
    pub components_dropped: usize,
    /// Faces of those components.
    pub faces_dropped: usize,
}

/// State of one node of the grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Node {
    Absent,
    /// Has points.
    Measured,
    /// Close to points: observed whatever its neighbours are.
    Near,
    /// Close enough to points to be observed together with a measured neighbour.
    Bridged,
    /// In a small hole.
    Filled,
    /// In a side opening that is closed.
    Closed,
}

/// Builds the surface; see the module's header. `None` when no cell is left.
pub(super) fn reconstruct(
    segmentation: &Segmentation,
    axis: &Axis,
    options: &Options,
) -> Option<(Mesh, Summary, WallLine)> {
    let section = &segmentation.section;
    let (grid, along_gap) = choose_grid(segmentation, options);
    let used = segmentation.coordinates.par_iter().zip(&segmentation.class);
    let (cells, _) =
        CellPoints::sort(&grid, used.map(|(c, class)| class.is_surface().then(|| grid.unroll(section, c))));
    let mut summary = Summary {
        spacing_m: grid.column_m,
        spacing_along_m: grid.row_m,
        points_used: cells.len(),
        ..Summary::default()
    };
    let clusters = choose_clusters(&grid, &cells, &mut summary);
    let clusters = drop_isolated(&grid, clusters, &mut summary);
    let mut places = fit_places(&grid, &cells, &clusters);
    drop(cells);
    let clusters = drop_bumps(&grid, clusters, &places, &mut summary);
    let depth: Vec<f64> =
        clusters.iter().zip(&places).map(|(c, p)| if c.count > 0 { p.depth } else { f64::NAN }).collect();
    let line = WallLine::of(grid, depth, segmentation, axis);
    let (grid, open) = (line.grid(), line.open());
    let clusters = cut_openings(&line, section, clusters, &mut places, options.side_openings);
    let mut furniture = vec![false; grid.len()];
    for (c, _) in segmentation.coordinates.iter().zip(&segmentation.class).filter(|(_, k)| **k == Class::Furniture) {
        if let Some(cell) = grid.cell_at(&grid.unroll(section, c)) {
            furniture[cell] = true;
        }
    }
    let state = support(grid, &clusters, &places, [&furniture, open], along_gap, options, &mut summary);
    fill_depths(grid, &state, &mut places);
    // Between profiles whole rows have no points of their own; elsewhere a face needs a measured corner.
    let profiles = segmentation.sampling.is_profiles();
    let (mut vertices, faces, observed) = triangulate(grid, &state, &places, profiles, |p| grid.lift(section, axis, p));
    let (mut faces, observed) = repair::trim_dangling(faces, observed);
    summary.vertices_split = repair::split_fans(&mut vertices, &mut faces);
    let kept = repair::keep_largest(vertices, faces, observed);
    summary.components_dropped = kept.components_dropped;
    summary.faces_dropped = kept.faces_dropped;
    let mesh = Mesh::new(kept.vertices, kept.faces, kept.observed)
        .expect("a triangulated grid with split fans is an oriented manifold");
    (!mesh.faces().is_empty()).then_some((mesh, summary, line))
}

/// The grid and the reach of a point along the axis.
fn choose_grid(segmentation: &Segmentation, options: &Options) -> (Grid, f64) {
    let (section, sampling) = (&segmentation.section, &segmentation.sampling);
    let area = section.mean_perimeter() * (section.end() - section.start());
    let count = segmentation.class.iter().filter(|c| c.is_surface()).count().max(1);
    let even = (area / count as f64).sqrt();
    let column_m = options.spacing_m.unwrap_or_else(|| {
        let wanted = if sampling.is_profiles() { sampling.around_m } else { even } * SPACING_IN_POINT_DISTANCES;
        let finest = if sampling.is_profiles() { FINEST_SHARE_OF_PROFILE } else { FINEST_SHARE_OF_PERIMETER };
        wanted.max(section.mean_perimeter() * finest)
    });
    if !sampling.is_profiles() {
        return (Grid::new(section, column_m, column_m), options.max_gap_m.max(1.5 * column_m));
    }
    // Whole rows between the profiles, as many as keep the cells from getting too long.
    let between = (sampling.along_m / (MAX_CELL_ASPECT * column_m)).ceil().max(1.0);
    let row_m = (sampling.along_m / between).max(column_m);
    (Grid::new(section, row_m, column_m), options.max_gap_m.max(0.8 * sampling.along_m))
}

/// The chosen depth range of a cell; empty when `count` is 0.
#[derive(Clone, Copy, Debug, Default)]
struct Cluster {
    low: f64,
    high: f64,
    middle: f64,
    count: u32,
}

/// Splits the depths of each cell at gaps and chooses one cluster, first the largest, then the one that continues the
/// neighbours best among those with a fair share of the points.
fn choose_clusters(grid: &Grid, cells: &CellPoints, summary: &mut Summary) -> Vec<Cluster> {
    let gap = 2.0 * grid.column_m + NOISE_ALLOWANCE_M;
    let split = |cell: usize| -> Vec<Cluster> {
        let mut depths: Vec<f64> = cells.in_cell(cell).iter().map(|p| p.depth).collect();
        depths.sort_unstable_by(f64::total_cmp);
        depths
            .chunk_by(|a, b| b - a <= gap)
            .map(|c| Cluster { low: c[0], high: c[c.len() - 1], middle: c[c.len() / 2], count: c.len() as u32 })
            .collect()
    };
    let largest: Vec<(Cluster, bool)> = (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            let clusters = split(cell);
            let best = clusters.iter().copied().reduce(|a, b| if b.count >= a.count { b } else { a });
            let several = clusters.iter().filter(|c| c.count >= 2).count() > 1;
            (best.unwrap_or_default(), several)
        })
        .collect();
    summary.cells_with_points = largest.iter().filter(|(c, _)| c.count > 0).count();
    let several = largest.iter().filter(|(_, several)| *several).count();
    summary.multiple_depth_percent = 100.0 * several as f64 / summary.cells_with_points.max(1) as f64;
    (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            let chosen = largest[cell].0;
            if chosen.count == 0 || cells.in_cell(cell).len() == chosen.count as usize {
                return chosen;
            }
            let mut around: Vec<f64> =
                grid.neighbours(cell, 2).map(|n| largest[n].0).filter(|c| c.count > 0).map(|c| c.middle).collect();
            let Some(expected) = statistics::median(&mut around) else { return chosen };
            let fair = chosen.count.div_ceil(4);
            split(cell)
                .into_iter()
                .filter(|c| c.count >= fair)
                .min_by(|a, b| (a.middle - expected).abs().total_cmp(&(b.middle - expected).abs()))
                .unwrap_or(chosen)
        })
        .collect()
}

/// Empties cells that too few of their nearest occupied neighbours agree with.
fn drop_isolated(grid: &Grid, clusters: Vec<Cluster>, summary: &mut Summary) -> Vec<Cluster> {
    let kept: Vec<Cluster> = clusters
        .par_iter()
        .enumerate()
        .map(|(cell, cluster)| {
            if cluster.count == 0 {
                return *cluster;
            }
            for reach in [1, 2, 4, 6] {
                let (mut seen, mut agree) = (0, 0);
                for n in grid.neighbours(cell, reach).filter(|&n| clusters[n].count > 0) {
                    seen += 1;
                    let allowed = MAX_SLOPE * grid.distance(cell, n) + NOISE_ALLOWANCE_M;
                    let jump = (cluster.low - clusters[n].high).max(clusters[n].low - cluster.high);
                    agree += usize::from(jump <= allowed);
                }
                if seen >= 6 || reach == 6 {
                    let enough = if seen >= 6 { agree >= 2 && 5 * agree >= seen } else { agree >= 1 };
                    return if enough { *cluster } else { Cluster::default() };
                }
            }
            *cluster
        })
        .collect();
    summary.isolated_cells_dropped =
        clusters.iter().zip(&kept).filter(|(before, after)| before.count > 0 && after.count == 0).count();
    kept
}

/// One place on the surface for each cell with a cluster; for the others the middle of the cell at depth 0.
fn fit_places(grid: &Grid, cells: &CellPoints, clusters: &[Cluster]) -> Vec<GridPoint> {
    (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            let (i, j) = ((cell / grid.columns) as f64 + 0.5, (cell % grid.columns) as f64 + 0.5);
            let cluster = clusters[cell];
            if cluster.count == 0 {
                return grid.middle(cell, 0.0);
            }
            let (mut row, mut column) = (0.0, 0.0);
            for p in cells.in_cell(cell).iter().filter(|p| p.depth >= cluster.low && p.depth <= cluster.high) {
                row += p.row;
                column += p.column;
            }
            let count = f64::from(cluster.count);
            let at = [
                i + (row / count - i).clamp(-MAX_SHIFT, MAX_SHIFT),
                j + (column / count - j).clamp(-MAX_SHIFT, MAX_SHIFT),
            ];
            GridPoint { row: at[0], column: at[1], depth: fit_depth(grid, cells, clusters, cell, at) }
        })
        .collect()
}

/// Depth of the surface at `at`, inside `cell`, by a robust weighted plane through the points around.
fn fit_depth(grid: &Grid, cells: &CellPoints, clusters: &[Cluster], cell: usize, at: [f64; 2]) -> f64 {
    let own = clusters[cell];
    // (row offset in cells, column offset in cells, depth, weight)
    let mut samples: Vec<[f64; 4]> = Vec::with_capacity(32);
    for n in std::iter::once(cell).chain(grid.neighbours(cell, 1)) {
        let cluster = clusters[n];
        if cluster.count == 0 {
            continue;
        }
        let allowed = MAX_SLOPE * grid.distance(cell, n) + NOISE_ALLOWANCE_M;
        if (own.low - cluster.high).max(cluster.low - own.high) > allowed {
            continue;
        }
        for p in cells.in_cell(n).iter().filter(|p| p.depth >= cluster.low && p.depth <= cluster.high) {
            let dr = p.row - at[0];
            let mut dc = p.column - at[1];
            // Across the seam.
            dc -= grid.columns as f64 * (dc / grid.columns as f64).round();
            let weight = (-0.5 * (dr * dr + dc * dc) / (FIT_SIGMA * FIT_SIGMA)).exp();
            samples.push([dr, dc, p.depth - own.middle, weight]);
        }
    }
    let mut depth = plane_at_origin(&samples);
    if samples.len() >= 6 {
        let mut residuals: Vec<f64> =
            samples.iter().map(|s| (s[2] - depth[0] - depth[1] * s[0] - depth[2] * s[1]).abs()).collect();
        let scale = 1.4826 * statistics::median(&mut residuals.clone()).unwrap_or(0.0);
        let reach = (3.0 * scale).max(1e-4);
        for (s, r) in samples.iter_mut().zip(residuals.drain(..)) {
            let t = r / reach;
            s[3] *= if t < 1.0 { (1.0 - t * t).powi(2) } else { 0.0 };
        }
        depth = plane_at_origin(&samples);
    }
    (own.middle + depth[0]).clamp(own.low, own.high)
}

/// Empties cells of few points that stick out of the plane through their neighbours: single outliers close to the surface.
fn drop_bumps(grid: &Grid, clusters: Vec<Cluster>, places: &[GridPoint], summary: &mut Summary) -> Vec<Cluster> {
    let kept: Vec<Cluster> = clusters
        .par_iter()
        .enumerate()
        .map(|(cell, &cluster)| {
            if cluster.count == 0 || cluster.count > BUMP_POINTS {
                return cluster;
            }
            let here = places[cell];
            let mut samples: Vec<[f64; 4]> = Vec::with_capacity(24);
            for n in grid.neighbours(cell, 2).filter(|&n| clusters[n].count > 0) {
                let dr = places[n].row - here.row;
                let mut dc = places[n].column - here.column;
                dc -= grid.columns as f64 * (dc / grid.columns as f64).round();
                // A cell of several points is a surer witness than a single one.
                let weight = f64::from(clusters[n].count.min(4)) / (1.0 + dr * dr + dc * dc);
                samples.push([dr, dc, places[n].depth, weight]);
            }
            if samples.len() < 5 {
                return cluster;
            }
            // Depths relative to the median keep the ridge of the slopes from pulling towards the mean section.
            let mut depths: Vec<f64> = samples.iter().map(|s| s[2]).collect();
            let middle = statistics::median(&mut depths).unwrap_or(0.0);
            samples.iter_mut().for_each(|s| s[2] -= middle);
            let mut plane = plane_at_origin(&samples);
            let residual = |plane: &[f64; 3], s: &[f64; 4]| (s[2] - plane[0] - plane[1] * s[0] - plane[2] * s[1]).abs();
            let mut scale = 0.0;
            for _ in 0..2 {
                let mut residuals: Vec<f64> = samples.iter().map(|s| residual(&plane, s)).collect();
                scale = 1.4826 * statistics::median(&mut residuals).unwrap_or(0.0);
                let reach = (3.0 * scale).max(1e-3);
                let weighted: Vec<[f64; 4]> = samples
                    .iter()
                    .map(|s| {
                        let t = residual(&plane, s) / reach;
                        [s[0], s[1], s[2], if t < 1.0 { s[3] * (1.0 - t * t).powi(2) } else { 0.0 }]
                    })
                    .collect();
                plane = plane_at_origin(&weighted);
            }
            let out = (here.depth - middle - plane[0]).abs();
            if out > BUMP_IN_SCALES * scale + NOISE_ALLOWANCE_M { Cluster::default() } else { cluster }
        })
        .collect();
    summary.bumps_dropped =
        clusters.iter().zip(&kept).filter(|(before, after)| before.count > 0 && after.count == 0).count();
    kept
}

/// Finds the side openings without building the surface.
pub(super) fn wall_line(segmentation: &Segmentation, axis: &Axis, options: &Options) -> WallLine {
    let (grid, _) = choose_grid(segmentation, options);
    let used = segmentation.coordinates.par_iter().zip(&segmentation.class);
    let section = &segmentation.section;
    let (cells, _) =
        CellPoints::sort(&grid, used.map(|(c, class)| class.is_surface().then(|| grid.unroll(section, c))));
    let clusters = choose_clusters(&grid, &cells, &mut Summary::default());
    let depth: Vec<f64> = clusters.iter().map(|c| if c.count > 0 { c.middle } else { f64::NAN }).collect();
    WallLine::of(grid, depth, segmentation, axis)
}

/// Empties the cells of side openings, unless these are to be kept; their places are those of the wall line where it is to be continued.
fn cut_openings(
    line: &WallLine,
    section: &SectionField,
    mut clusters: Vec<Cluster>,
    places: &mut [GridPoint],
    what: SideOpenings,
) -> Vec<Cluster> {
    let (grid, open) = (line.grid(), line.open());
    let depth = match what {
        SideOpenings::Keep => return clusters,
        SideOpenings::Hole => vec![0.0; grid.len()],
        SideOpenings::Close => line.continued(section),
    };
    for cell in (0..grid.len()).filter(|&c| open[c]) {
        clusters[cell] = Cluster::default();
        places[cell] = grid.middle(cell, depth[cell]);
    }
    clusters
}

/// Value and slopes at the origin of the weighted least-squares plane; slopes fade out where the samples do not tell.
fn plane_at_origin(samples: &[[f64; 4]]) -> [f64; 3] {
    let mut normal = Mat3::zeros();
    let mut right = Vec3::zeros();
    for &[r, c, d, w] in samples {
        let row = Vec3::new(1.0, r, c);
        normal += w * row * row.transpose();
        right += w * d * row;
    }
    let total = normal[(0, 0)];
    if total <= 0.0 {
        return [0.0; 3];
    }
    // A slope needs a spread of a tenth of a cell to be believed.
    normal[(1, 1)] += 0.01 * total;
    normal[(2, 2)] += 0.01 * total;
    match normal.cholesky() {
        Some(factor) => factor.solve(&right).into(),
        None => [right[0] / total, 0.0, 0.0],
    }
}

/// Which nodes belong to the surface, and why. The flags tell which cells hold furniture, and which a side opening.
fn support(
    grid: &Grid,
    clusters: &[Cluster],
    places: &[GridPoint],
    [furniture, open]: [&[bool]; 2],
    along_gap: f64,
    options: &Options,
    summary: &mut Summary,
) -> Vec<Node> {
    let around_gap = options.max_gap_m.max(if along_gap > options.max_gap_m { grid.column_m } else { 0.0 });
    let reach_rows = (along_gap / grid.row_m).ceil() as usize + 1;
    let reach_columns = ((around_gap / grid.column_m).ceil() as usize + 1).min((grid.columns - 1) / 2);
    let mut state: Vec<Node> = (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            if clusters[cell].count > 0 {
                return Node::Measured;
            }
            let (i, j) = (cell / grid.columns, cell % grid.columns);
            let mut nearest = f64::INFINITY;
            for other in i.saturating_sub(reach_rows)..(i + reach_rows + 1).min(grid.rows) {
                for d in 0..2 * reach_columns + 1 {
                    let n = other * grid.columns + (j + grid.columns + d - reach_columns) % grid.columns;
                    if clusters[n].count == 0 {
                        continue;
                    }
                    let dr = (places[n].row - i as f64 - 0.5) * grid.row_m / along_gap;
                    // The place's shift inside its cell, on top of whole columns.
                    let shift = places[n].column - (n % grid.columns) as f64 - 0.5;
                    let dc = (d as f64 - reach_columns as f64 + shift) * grid.column_m / around_gap;
                    nearest = nearest.min(dr * dr + dc * dc);
                }
            }
            match nearest {
                d if d <= NEAR_SHARE * NEAR_SHARE => Node::Near,
                d if d <= 1.0 => Node::Bridged,
                _ => Node::Absent,
            }
        })
        .collect();
    // Stretch the metric of profile scans, so that a hole counts by its width around the section.
    let scale = [grid.row_m * around_gap / along_gap, grid.column_m];
    if options.fill_hole_m > 0.0 {
        close(grid, &mut state, options.fill_hole_m / 2.0, scale, |_| true);
    }
    if options.fill_behind_furniture_m > options.fill_hole_m && furniture.iter().any(|f| *f) {
        // The shadow lies beside the thing as well, so the fill reaches out from it.
        let reach = options.fill_behind_furniture_m / 3.0;
        let from_furniture = squared_distance(furniture, grid.rows, grid.columns, scale);
        let near = |n: usize| from_furniture[n] <= reach * reach;
        close(grid, &mut state, options.fill_behind_furniture_m / 2.0, scale, near);
    }
    // The rim of an opening is the wall line: no bridge leads into it, and nothing in it counts as seen.
    let inside = match options.side_openings {
        SideOpenings::Hole => Some(Node::Absent),
        SideOpenings::Close => Some(Node::Closed),
        SideOpenings::Keep => None,
    };
    if let Some(inside) = inside {
        state.iter_mut().zip(open).filter(|(_, o)| **o).for_each(|(s, _)| *s = inside);
    }
    summary.cells_bridged = state.iter().filter(|s| matches!(s, Node::Near | Node::Bridged)).count();
    summary.cells_filled = state.iter().filter(|s| **s == Node::Filled).count();
    summary.cells_closed = state.iter().filter(|s| **s == Node::Closed).count();
    state
}

/// Morphological closing: grows the surface by `radius`, shrinks it back, and fills what stays beyond where `allowed`.
fn close(grid: &Grid, state: &mut [Node], radius: f64, scale: [f64; 2], allowed: impl Fn(usize) -> bool) {
    let margin = (radius / scale[0]).ceil() as usize + 2;
    let rows = grid.rows + 2 * margin;
    let mut present = vec![false; rows * grid.columns];
    for (p, s) in present[margin * grid.columns..].iter_mut().zip(state.iter()) {
        *p = *s != Node::Absent;
    }
    let grown = squared_distance(&present, rows, grid.columns, scale);
    let beyond: Vec<bool> = grown.iter().map(|d| *d > radius * radius).collect();
    let back = squared_distance(&beyond, rows, grid.columns, scale);
    for (n, (s, d)) in state.iter_mut().zip(&back[margin * grid.columns..]).enumerate() {
        if *s == Node::Absent && *d > radius * radius && allowed(n) {
            *s = Node::Filled;
        }
    }
}

/// Depths of bridged and filled nodes: a front of averages moves inwards, then a thin plate relaxes it.
fn fill_depths(grid: &Grid, state: &[Node], places: &mut [GridPoint]) {
    const UNKNOWN: u32 = u32::MAX;
    let columns = grid.columns;
    // Round in which a node got its first value.
    let has_depth = |s: Node| matches!(s, Node::Measured | Node::Closed);
    let mut known: Vec<u32> = state.iter().map(|s| if has_depth(*s) { 0 } else { UNKNOWN }).collect();
    let mut front: Vec<usize> =
        (0..grid.len()).filter(|&n| matches!(state[n], Node::Near | Node::Bridged | Node::Filled)).collect();
    let unknown = front.clone();
    let mut round = 0;
    while !front.is_empty() {
        round += 1;
        let mut later = Vec::new();
        let mut reached = Vec::new();
        for &n in &front {
            let (mut sum, mut weight) = (0.0, 0.0);
            for m in grid.neighbours(n, 1).filter(|&m| known[m] < round) {
                let w = 1.0 / grid.distance(n, m).powi(2);
                sum += w * places[m].depth;
                weight += w;
            }
            if weight > 0.0 { reached.push((n, sum / weight)) } else { later.push(n) }
        }
        if reached.is_empty() {
            break; // Not connected to any measurement: cannot happen after a closing, and would stay at depth 0.
        }
        for (n, depth) in reached {
            places[n].depth = depth;
            known[n] = round;
        }
        front = later;
    }
    // Gauss-Seidel on the 13-point biharmonic stencil where all of it exists, on the mean of the neighbours elsewhere.
    let along = (grid.column_m / grid.row_m).powi(2);
    let present = |n: usize| state[n] != Node::Absent;
    let step = |n: usize, di: isize, dj: isize| -> Option<usize> {
        let i = (n / columns) as isize + di;
        let j = (n % columns) as isize + dj;
        let inside = i >= 0 && i < grid.rows as isize;
        let m = i as usize % grid.rows * columns + j.rem_euclid(columns as isize) as usize;
        (inside && present(m)).then_some(m)
    };
    // Laplacian with weight `along` for rows: stencil of its square.
    let (a, diagonal) = (along, 6.0 * along * along + 8.0 * along + 6.0);
    let ring: [(isize, isize, f64); 12] = [
        (-1, 0, -4.0 * a * (a + 1.0)),
        (1, 0, -4.0 * a * (a + 1.0)),
        (0, -1, -4.0 * (a + 1.0)),
        (0, 1, -4.0 * (a + 1.0)),
        (-1, -1, 2.0 * a),
        (-1, 1, 2.0 * a),
        (1, -1, 2.0 * a),
        (1, 1, 2.0 * a),
        (-2, 0, a * a),
        (2, 0, a * a),
        (0, -2, 1.0),
        (0, 2, 1.0),
    ];
    // The sweeps run one node after the other: where each node's neighbours lie is told beforehand.
    const NOWHERE: u32 = u32::MAX;
    let around: Vec<[u32; 12]> =
        unknown.par_iter().map(|&n| ring.map(|(di, dj, _)| step(n, di, dj).map_or(NOWHERE, |m| m as u32))).collect();
    let mut depth: Vec<f64> = places.par_iter().map(|p| p.depth).collect();
    let mean_weights = [a, a, 1.0, 1.0];
    for sweep in 0..FILL_SWEEPS {
        for k in 0..unknown.len() {
            let k = if sweep % 2 == 0 { k } else { unknown.len() - 1 - k };
            let (n, beside) = (unknown[k], &around[k]);
            if !beside.contains(&NOWHERE) {
                let sum: f64 = ring.iter().zip(beside).map(|((_, _, w), &m)| w * depth[m as usize]).sum();
                depth[n] = -sum / diagonal;
                continue;
            }
            let (mut sum, mut weight) = (0.0, 0.0);
            for (w, &m) in mean_weights.iter().zip(beside).filter(|(_, m)| **m != NOWHERE) {
                sum += w * depth[m as usize];
                weight += w;
            }
            if weight > 0.0 {
                depth[n] = sum / weight;
            }
        }
    }
    unknown.iter().for_each(|&n| places[n].depth = depth[n]);
}

/// Vertices of the present nodes and two triangles for each complete square of them, one for three corners.
fn triangulate(
    grid: &Grid,
    state: &[Node],
    places: &[GridPoint],
    profiles: bool,
    lift: impl Fn(&GridPoint) -> Vec3 + Sync,
) -> (Vec<Vec3>, Vec<[VertexId; 3]>, Vec<bool>) {
    let mut id = vec![VertexId::MAX; grid.len()];
    let mut present = Vec::new();
    for (n, s) in state.iter().enumerate() {
        if *s != Node::Absent {
            id[n] = present.len() as VertexId;
            present.push(n);
        }
    }
    let vertices: Vec<Vec3> = present.par_iter().map(|&n| lift(&places[n])).collect();
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
                        let measured = corners.iter().any(|&n| state[n] == Node::Measured);
                        let near = corners.iter().all(|&n| state[n] == Node::Near);
                        out.push((corners.map(|n| id[n]), !filled && (measured || near || profiles)));
                    }
                };
                let missing = square.iter().filter(|&&n| id[n] == VertexId::MAX).count();
                let [a, b, c, d] = square;
                match missing {
                    0 if splits_along_ac(grid, places, &vertices, &id, square) => {
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
fn splits_along_ac(grid: &Grid, places: &[GridPoint], vertices: &[Vec3], id: &[VertexId], square: [usize; 4]) -> bool {
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
    let [a, b, c, d] = square.map(|n| vertices[id[n] as usize]);
    (c - a).norm_squared() <= (d - b).norm_squared()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::topology;
    use crate::segment::{self, classify_positions};
    use std::f64::consts::{PI, TAU};

    const RADIUS: f64 = 2.0;
    const LENGTH: f64 = 8.0;

    fn straight() -> Axis {
        Axis::through(&[Vec3::zeros(), Vec3::new(LENGTH, 0.0, 0.0)], 0.0).unwrap()
    }

    /// Even deterministic points on a tube of radius `r(chainage, angle)` around the x axis.
    fn tube(count: u32, r: impl Fn(f64, f64) -> f64) -> Vec<Vec3> {
        (0..count)
            .map(|i| {
                let s = LENGTH * (f64::from(i) * 0.618_033_988_749_895).fract();
                let a = TAU * (f64::from(i) * 0.754_877_666_246_693).fract() - PI;
                Vec3::new(s, -r(s, a) * a.sin(), r(s, a) * a.cos())
            })
            .collect()
    }

    fn mesh_of(points: &[Vec3], options: &Options) -> (Mesh, Summary) {
        let axis = straight();
        let (segmentation, _) = classify_positions(points, &axis, &segment::Settings::default()).unwrap();
        let (mesh, summary, _) = reconstruct(&segmentation, &axis, options).unwrap();
        (mesh, summary)
    }

    fn loops(mesh: &Mesh) -> usize {
        topology::boundary_loops(mesh.faces(), mesh.twins()).len()
    }

    const OPTIONS: Options = Options {
        spacing_m: Some(0.05),
        max_gap_m: 0.05,
        fill_hole_m: 0.2,
        fill_behind_furniture_m: 0.0,
        side_openings: SideOpenings::Hole,
    };

    #[test]
    fn a_tube_becomes_a_tube_that_faces_inwards() {
        let (mesh, summary) = mesh_of(&tube(120_000, |_, _| RADIUS), &OPTIONS);
        assert_eq!((loops(&mesh), summary.isolated_cells_dropped), (2, 0));
        assert!((mesh.area() - TAU * RADIUS * LENGTH).abs() < 0.02 * TAU * RADIUS * LENGTH);
        for v in mesh.vertices() {
            assert!((v.y.hypot(v.z) - RADIUS).abs() < 1e-3);
        }
        for f in 0..mesh.faces().len() as u32 {
            let [a, b, c] = mesh.corners(f);
            let inwards = -Vec3::new(0.0, (a + b + c).y, (a + b + c).z);
            assert!(mesh.double_area_vector(f).dot(&inwards) > 0.0);
        }
    }

    #[test]
    fn the_grid_is_nearly_the_delaunay_triangulation_of_its_vertices() {
        use spade::{DelaunayTriangulation, Point2, Triangulation};
        let (mesh, _) = mesh_of(&tube(120_000, |_, _| RADIUS), &OPTIONS);
        let plane: Vec<Point2<f64>> =
            mesh.vertices().iter().map(|v| Point2::new(v.x, RADIUS * (-v.y).atan2(v.z))).collect();
        // Away from the portals and from the invert, where the plane has a border and the tube has none.
        let inner = |v: u32| {
            let p = plane[v as usize];
            p.y.abs() < 0.9 * PI * RADIUS && (0.3..LENGTH - 0.3).contains(&p.x)
        };
        let delaunay = DelaunayTriangulation::<Point2<f64>>::bulk_load_stable(plane.clone()).unwrap();
        let mut expected: Vec<[u32; 2]> = delaunay
            .undirected_edges()
            .map(|e| {
                let [a, b] = e.vertices().map(|v| v.fix().index() as u32);
                [a.min(b), a.max(b)]
            })
            .collect();
        expected.sort_unstable();
        let edges: Vec<[u32; 2]> = mesh
            .faces()
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .filter(|&[a, b]| a < b && inner(a) && inner(b))
            .collect();
        let same = edges.iter().filter(|e| expected.binary_search(e).is_ok()).count();
        let share = same as f64 / edges.len() as f64;
        assert!(edges.len() > 20_000 && share > 0.95, "{share} of {}", edges.len());
    }

    #[test]
    fn noise_is_averaged_and_outliers_leave_no_spike() {
        let mut points = tube(240_000, |s, a| RADIUS + 0.03 * (3.0 * a).cos() * s.sin());
        let truth = |v: &Vec3| RADIUS + 0.03 * (3.0 * (-v.y).atan2(v.z)).cos() * v.x.sin();
        // Triangular noise of 3 mm standard deviation along the ray; one point in 300 up to 1 m too close.
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        for p in points.iter_mut() {
            let shift = if random() < 1.0 / 300.0 { -random() } else { 0.003 * 6f64.sqrt() * (random() - random()) };
            let r = p.y.hypot(p.z);
            p.y *= (r + shift) / r;
            p.z *= (r + shift) / r;
        }
        let (mesh, _) = mesh_of(&points, &OPTIONS);
        let errors: Vec<f64> = mesh.vertices().iter().map(|v| v.y.hypot(v.z) - truth(v)).collect();
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        let worst = errors.iter().fold(0.0, |w: f64, e| w.max(e.abs()));
        assert!(rms < 0.0015 && worst < 0.02, "rms {rms}, worst {worst}");
        assert_eq!(loops(&mesh), 2);
    }

    #[test]
    fn a_small_hole_is_filled_and_marked_a_large_one_stays() {
        let mut points = tube(120_000, |_, _| RADIUS);
        // A hole 0.15 m wide on the right wall and one 0.8 m wide on the left.
        points.retain(|p| {
            let girth = RADIUS * (-p.y).atan2(p.z);
            (p.x - 3.0).hypot(girth - 3.0) > 0.075 && (p.x - 5.0).hypot(girth + 3.0) > 0.4
        });
        let (mesh, summary) = mesh_of(&points, &OPTIONS);
        assert_eq!(loops(&mesh), 3);
        assert!(summary.cells_filled > 0);
        for f in 0..mesh.faces().len() {
            let [a, b, c] = mesh.corners(f as u32);
            let m = (a + b + c) / 3.0;
            let girth = RADIUS * (-m.y).atan2(m.z);
            if (m.x - 3.0).hypot(girth - 3.0) < 0.03 {
                assert!(!mesh.observed()[f] && (m.y.hypot(m.z) - RADIUS).abs() < 0.01);
            }
            assert!((m.x - 5.0).hypot(girth + 3.0) > 0.3, "the large hole was filled");
        }
    }

    #[test]
    fn profiles_half_a_metre_apart_make_one_observed_surface() {
        let points: Vec<Vec3> = (0..17)
            .flat_map(|i| {
                (0..1500).map(move |k| {
                    let a = TAU * (f64::from(k) + 0.1 * f64::from(i % 3)) / 1500.0 - PI;
                    Vec3::new(f64::from(i) * 0.5, -RADIUS * a.sin(), RADIUS * a.cos())
                })
            })
            .collect();
        let (mesh, summary) = mesh_of(&points, &Options { spacing_m: None, ..OPTIONS });
        assert_eq!((loops(&mesh), summary.cells_filled), (2, 0));
        assert!(mesh.observed().iter().all(|&o| o) && summary.spacing_along_m > 2.0 * summary.spacing_m);
        assert!(mesh.vertices().iter().all(|v| (v.y.hypot(v.z) - RADIUS).abs() < 2e-3));
    }

    #[test]
    fn the_mesh_is_the_same_on_one_thread_and_on_many() {
        let points = tube(40_000, |s, a| RADIUS + 0.1 * (s + 2.0 * a).sin());
        let many = mesh_of(&points, &OPTIONS).0;
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(pool.install(|| mesh_of(&points, &OPTIONS).0), many);
    }
}
