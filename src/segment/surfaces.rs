//! Tells the tunnel's own surface from what hangs and stands in front of it, and from what lies behind.
//!
//! The unrolled depth picture is cut into *patches*: in each cell the points are split at gaps of depth, and a cluster is
//! joined with the nearest one of each neighbouring cell when the step between them is no larger than rock makes it.
//! Ducts, cables, vehicles and people are patches that stand in front of their neighbours along their outline; the
//! largest patch is the wall, and a patch that continues it across a scan shadow is wall as well.
//!
//! Reference for the idea (in range pictures): R. Hoffman, A. K. Jain, "Segmentation and classification of range images",
//! IEEE TPAMI 9(5), 1987, doi:10.1109/TPAMI.1987.4767955. Departure: several depths a cell, because several stations see
//! behind each other's obstacles; and the judgement of a patch by its outline. Cost: linear in points and cells.

use super::unrolled_grid::{CellPoints, Grid};
use super::{Class, SectionField};
use crate::numeric::statistics;
use rayon::prelude::*;

/// Steepest depth of rock, metres a metre of surface.
const MAX_SLOPE: f64 = 1.2;
/// Steps below this are never an edge, metres.
const NOISE_ALLOWANCE_M: f64 = 0.02;
/// Steps above this are always an edge, metres (matters between the profiles of a profile scan).
const MAX_STEP_M: f64 = 0.25;
/// A patch needs this many points to be a thing; fewer are noise.
const THING_POINTS: usize = 8;
/// A patch stands in front when at least this share of its outline does.
const FRONT_SHARE: f64 = 0.25;
/// A patch without neighbours is furniture when it lies this far in front of the wall around it, in mean radii.
const FRONT_IN_RADII: f64 = 0.06;
/// A patch this far behind the wall around it belongs to a side room, in mean radii.
const BEHIND_IN_RADII: f64 = 0.25;

/// Width of the window that finds things standing out of the wall, and how far they do at least, in mean radii.
const STAND_OUT_WINDOW_IN_RADII: f64 = 0.7;
const STAND_OUT_IN_RADII: f64 = 0.13;
/// How far to both sides the usual depth is looked for along the tunnel, metres: vehicles are shorter than this.
const COURSE_REACH_M: f64 = 7.5;
/// Length of tunnel that shares one depth on that way, metres.
const COURSE_STEP_M: f64 = 0.5;
/// So many robust standard deviations from the usual depth are no relief.
const UNUSUAL: f64 = 4.0;
/// What takes more than this share of a section is a narrower tunnel and no thing in it.
const MOST_OF_A_SECTION: f64 = 0.6;
/// A bench is at least this long and this wide, metres, and not higher than this share of the tunnel's height.
const BENCH_LENGTH_M: f64 = 5.0;
const BENCH_WIDTH_M: f64 = 0.25;
const BENCH_HEIGHT_SHARE: f64 = 0.22;

/// Points of one cell at about the same depth.
#[derive(Clone, Copy, Debug)]
struct Cluster {
    cell: u32,
    low: f64,
    high: f64,
    middle: f64,
    count: u32,
}

/// What was seen, for the report.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct PatchCounts {
    /// Patches in all.
    pub patches: usize,
    /// Patches that are the tunnel's surface.
    pub surface_patches: usize,
    /// Patches in front of it.
    pub furniture_patches: usize,
    /// Patches behind it.
    pub outside_patches: usize,
}

/// Sets the class of every point in `cells`: wall, furniture, outside or noise. Returns the counts and, for each cell,
/// the depth of the surface (NaN without one).
pub(super) fn classify(
    grid: &Grid,
    cells: &CellPoints,
    section: &SectionField,
    mean_radius: f64,
    class: &mut [Class],
) -> (PatchCounts, Vec<f64>) {
    let (first, clusters) = split_cells(grid, cells);
    let patch_of = join(grid, &first, &clusters);
    // Things that touch the wall somewhere are in its patch: what stands out in front is taken away, then joined anew.
    let standing_out = standing_out(grid, section, &first, &clusters, &patch_of, mean_radius);
    for (c, _) in clusters.iter().zip(&standing_out).filter(|(_, out)| **out) {
        let cell = c.cell as usize;
        for (point, &index) in cells.in_cell(cell).iter().zip(cells.indices_in_cell(cell)) {
            if point.depth >= c.low && point.depth <= c.high {
                class[index as usize] = Class::Furniture;
            }
        }
    }
    let clusters: Vec<Cluster> =
        clusters.into_iter().zip(&standing_out).filter(|(_, out)| !**out).map(|(c, _)| c).collect();
    let first = first_of_cells(grid, &clusters);
    let patch_of = join(grid, &first, &clusters);
    let patches = patch_of.iter().copied().max().map_or(0, |m| m as usize + 1);
    let mut points = vec![0usize; patches];
    for (c, &p) in clusters.iter().zip(&patch_of) {
        points[p as usize] += c.count as usize;
    }
    let main = (0..patches).max_by(|&a, &b| points[a].cmp(&points[b]).then(b.cmp(&a))).unwrap_or(0);
    let outlines = outlines(grid, &first, &clusters, &patch_of, patches);
    let offsets = offsets_from_main(grid, &clusters, &patch_of, main, patches);
    let benches = benches(grid, section, &clusters, &patch_of, main, patches);
    let sections = sections(grid, &clusters, &patch_of, patches);
    let mut counts = PatchCounts { patches, ..PatchCounts::default() };
    let class_of_patch: Vec<Class> = (0..patches)
        .map(|p| {
            let (front, total) = outlines[p];
            let offset = offsets[p];
            if p == main || benches[p] || sections[p] {
                counts.surface_patches += 1;
                Class::Wall
            } else if points[p] < THING_POINTS {
                Class::Noise
            } else if front as f64 > FRONT_SHARE * total as f64 || offset < -FRONT_IN_RADII * mean_radius {
                counts.furniture_patches += 1;
                Class::Furniture
            } else if offset > BEHIND_IN_RADII * mean_radius {
                counts.outside_patches += 1;
                Class::Outside
            } else {
                counts.surface_patches += 1;
                Class::Wall
            }
        })
        .collect();
    let mut depth = vec![f64::NAN; grid.len()];
    for (cell, d) in depth.iter_mut().enumerate() {
        let range = first[cell] as usize..first[cell + 1] as usize;
        let mut support = 0;
        for (c, &p) in clusters[range.clone()].iter().zip(&patch_of[range]) {
            let kind = class_of_patch[p as usize];
            for (point, &index) in cells.in_cell(cell).iter().zip(cells.indices_in_cell(cell)) {
                if point.depth >= c.low && point.depth <= c.high {
                    class[index as usize] = kind;
                }
            }
            if kind == Class::Wall && c.count >= support {
                support = c.count;
                *d = c.middle;
            }
        }
    }
    (counts, depth)
}

/// Clusters of each cell from near to far, and the first cluster of each cell.
fn split_cells(grid: &Grid, cells: &CellPoints) -> (Vec<u32>, Vec<Cluster>) {
    let gap = MAX_SLOPE * grid.column_m + NOISE_ALLOWANCE_M;
    let lists: Vec<Vec<Cluster>> = (0..grid.rows)
        .into_par_iter()
        .map(|row| {
            let mut out = Vec::new();
            for cell in row * grid.columns..(row + 1) * grid.columns {
                let mut depths: Vec<f64> = cells.in_cell(cell).iter().map(|p| p.depth).collect();
                depths.sort_unstable_by(f64::total_cmp);
                out.extend(depths.chunk_by(|a, b| b - a <= gap).map(|c| Cluster {
                    cell: cell as u32,
                    low: c[0],
                    high: c[c.len() - 1],
                    middle: c[c.len() / 2],
                    count: c.len() as u32,
                }));
            }
            out
        })
        .collect();
    let clusters: Vec<Cluster> = lists.into_iter().flatten().collect();
    (first_of_cells(grid, &clusters), clusters)
}

/// First cluster of each cell, one more than there are cells.
fn first_of_cells(grid: &Grid, clusters: &[Cluster]) -> Vec<u32> {
    let mut first = vec![0u32; grid.len() + 1];
    clusters.iter().for_each(|c| first[c.cell as usize + 1] += 1);
    for cell in 0..grid.len() {
        first[cell + 1] += first[cell];
    }
    first
}

/// Clusters of the largest patch that stand out in front of it, by one of two measures. A morphological closing fills every
/// dent of the depth picture narrower than its window: ducts, people, whatever is small beside the section. And along the
/// tunnel the depth at the same girth is usually another: a vehicle may take half of the floor, but not half of the tunnel.
/// What is in front by more than [`STAND_OUT_IN_RADII`] is a core; the thing is all that hangs together with a core and is in
/// front by half of that. No core lies in the lowest part of the section, and only the second measure counts there: kerbs
/// and ballast are ground, and go on.
fn standing_out(
    grid: &Grid,
    section: &SectionField,
    first: &[u32],
    clusters: &[Cluster],
    patch_of: &[u32],
    mean_radius: f64,
) -> Vec<bool> {
    let mut size = vec![0usize; patch_of.iter().max().map_or(0, |m| *m as usize + 1)];
    clusters.iter().zip(patch_of).for_each(|(c, &p)| size[p as usize] += c.count as usize);
    let Some(main) = (0..size.len()).max_by(|&a, &b| size[a].cmp(&size[b]).then(b.cmp(&a))) else {
        return Vec::new();
    };
    let in_main = |k: usize| patch_of[k] as usize == main;
    let range = |cell: usize| first[cell] as usize..first[cell + 1] as usize;
    let far: Vec<f64> = (0..grid.len())
        .map(|cell| range(cell).filter(|&k| in_main(k)).map(|k| clusters[k].middle).fold(f64::NEG_INFINITY, f64::max))
        .collect();
    let radius = STAND_OUT_WINDOW_IN_RADII * mean_radius / 2.0;
    let rows = (radius / grid.row_m).floor() as usize;
    let columns = ((radius / grid.column_m).floor() as usize).min(grid.columns / 4);
    // A window of a rectangle is a window of rows after one of columns, and hardly differs from a disk here.
    let extreme = |field: &[f64], pick: fn(f64, f64) -> f64, skip: f64| -> Vec<f64> {
        let around: Vec<f64> = (0..grid.len())
            .into_par_iter()
            .map(|n| {
                let (i, j) = (n / grid.columns, n % grid.columns);
                (0..2 * columns + 1)
                    .map(|d| field[i * grid.columns + (j + grid.columns + d - columns) % grid.columns])
                    .filter(|v| v.is_finite())
                    .fold(skip, pick)
            })
            .collect();
        (0..grid.len())
            .into_par_iter()
            .map(|n| {
                let (i, j) = (n / grid.columns, n % grid.columns);
                (i.saturating_sub(rows)..(i + rows + 1).min(grid.rows))
                    .map(|i| around[i * grid.columns + j])
                    .filter(|v| v.is_finite())
                    .fold(skip, pick)
            })
            .collect()
    };
    let closed = extreme(&extreme(&far, f64::max, f64::NEG_INFINITY), f64::min, f64::INFINITY);
    let place = |cell: usize, depth: f64| {
        let (row, column) = (cell / grid.columns, cell % grid.columns);
        let chainage = grid.start + (row as f64 + 0.5) * grid.row_m;
        let (left, right) = section.girth_range(chainage);
        let girth = left + (right - left) * (column as f64 + 0.5) / grid.columns as f64;
        let angle = section.angle_of_girth(chainage, girth);
        (section.radius(chainage, angle) + depth) * angle.cos()
    };
    let (low, high) = (0..grid.len())
        .filter(|&cell| far[cell].is_finite())
        .map(|cell| place(cell, far[cell]))
        .fold((f64::MAX, f64::MIN), |(l, h), up| (l.min(up), h.max(up)));
    let ground = low + BENCH_HEIGHT_SHARE * (high - low);
    let core = STAND_OUT_IN_RADII * mean_radius;
    let usual = usual_along(grid, &far);
    let mut relief: Vec<f64> = far.iter().zip(&usual).map(|(d, u)| (d - u).abs()).filter(|d| d.is_finite()).collect();
    let unusual = core.max(UNUSUAL * 1.4826 * statistics::median(&mut relief).unwrap_or(f64::INFINITY));
    // In front by how many cores.
    let above_ground: Vec<bool> = clusters.par_iter().map(|c| place(c.cell as usize, c.middle) >= ground).collect();
    let measure = |of: &(dyn Fn(usize) -> f64 + Sync)| -> Vec<f64> {
        let value = |k: usize| if in_main(k) { of(k) } else { f64::NAN };
        (0..clusters.len()).into_par_iter().map(value).collect()
    };
    let by_window = measure(&|k| {
        let fill = closed[clusters[k].cell as usize] - clusters[k].middle;
        if above_ground[k] && fill.is_finite() { fill / core } else { 0.0 }
    });
    let by_course = measure(&|k| (usual[clusters[k].cell as usize] - clusters[k].middle) / unusual);
    let mut out = vec![false; clusters.len()];
    for (in_front, largest_share) in [(by_window, f64::INFINITY), (by_course, MOST_OF_A_SECTION)] {
        let mut seen = vec![false; clusters.len()];
        for seed in 0..clusters.len() {
            let is_core = in_front[seed] > 1.0 && above_ground[seed];
            if !is_core || std::mem::replace(&mut seen[seed], true) {
                continue;
            }
            let mut thing = vec![seed];
            let mut done = 0;
            while done < thing.len() {
                let k = thing[done];
                done += 1;
                let cell = clusters[k].cell as usize;
                for m in std::iter::once(cell).chain(grid.neighbours(cell, 1)).flat_map(range) {
                    let hangs_on = step(&clusters[k], &clusters[m]).abs() <= MAX_STEP_M;
                    if in_front[m] > 0.5 && hangs_on && !std::mem::replace(&mut seen[m], true) {
                        thing.push(m);
                    }
                }
            }
            let mut rows_of_it: Vec<usize> = thing.iter().map(|&k| clusters[k].cell as usize / grid.columns).collect();
            rows_of_it.sort_unstable();
            rows_of_it.dedup();
            if thing.len() as f64 <= largest_share * (rows_of_it.len() * grid.columns) as f64 {
                thing.into_iter().for_each(|k| out[k] = true);
            }
        }
    }
    out
}

/// The usual depth of each cell: the median along the tunnel of what lies at the same girth, NaN where nothing is known.
fn usual_along(grid: &Grid, far: &[f64]) -> Vec<f64> {
    let rows_a_step = ((COURSE_STEP_M / grid.row_m).round() as usize).max(1);
    let steps = grid.rows.div_ceil(rows_a_step);
    let reach = (COURSE_REACH_M / (rows_a_step as f64 * grid.row_m)).ceil() as usize;
    let median_of = |values: &mut dyn Iterator<Item = f64>| {
        let mut known: Vec<f64> = values.filter(|d| d.is_finite()).collect();
        statistics::median(&mut known).unwrap_or(f64::NAN)
    };
    let columns: Vec<Vec<f64>> = (0..grid.columns)
        .into_par_iter()
        .map(|j| {
            let rows_of = |k: usize| k * rows_a_step..((k + 1) * rows_a_step).min(grid.rows);
            let stepped: Vec<f64> =
                (0..steps).map(|k| median_of(&mut rows_of(k).map(|i| far[i * grid.columns + j]))).collect();
            let near = |k: usize| k.saturating_sub(reach)..(k + reach + 1).min(steps);
            (0..steps).map(|k| median_of(&mut stepped[near(k)].iter().copied())).collect()
        })
        .collect();
    (0..grid.len()).map(|cell| columns[cell % grid.columns][cell / grid.columns / rows_a_step]).collect()
}

/// Step between two clusters: 0 when their depth ranges overlap; negative when `a` lies in front of `b`.
fn step(a: &Cluster, b: &Cluster) -> f64 {
    if a.high < b.low {
        a.high - b.low
    } else if b.high < a.low {
        a.low - b.high
    } else {
        0.0
    }
}

fn allowed(grid: &Grid, a: &Cluster, b: &Cluster) -> f64 {
    (MAX_SLOPE * grid.distance(a.cell as usize, b.cell as usize) + NOISE_ALLOWANCE_M).min(MAX_STEP_M)
}

/// The cluster of `cell` that is nearest in depth to `a`.
fn nearest<'a>(first: &[u32], clusters: &'a [Cluster], cell: usize, a: &Cluster) -> Option<(usize, &'a Cluster)> {
    (first[cell] as usize..first[cell + 1] as usize)
        .map(|k| (k, &clusters[k]))
        .min_by(|(_, x), (_, y)| step(a, x).abs().total_cmp(&step(a, y).abs()))
}

/// Number of the patch of each cluster: connected across neighbouring cells without a step, over one empty cell too.
fn join(grid: &Grid, first: &[u32], clusters: &[Cluster]) -> Vec<u32> {
    let links: Vec<Vec<u32>> = clusters
        .par_iter()
        .map(|a| {
            grid.neighbours(a.cell as usize, 2)
                .filter(|&n| n > a.cell as usize)
                .filter_map(|n| {
                    let (k, b) = nearest(first, clusters, n, a)?;
                    // The step must be the smallest seen from the other side too.
                    let (_, back) = nearest(first, clusters, a.cell as usize, b)?;
                    let mutual = back.low == a.low && back.high == a.high;
                    (mutual && step(a, b).abs() <= allowed(grid, a, b)).then_some(k as u32)
                })
                .collect()
        })
        .collect();
    let mut parent: Vec<u32> = (0..clusters.len() as u32).collect();
    fn root(parent: &mut [u32], mut x: u32) -> u32 {
        while parent[x as usize] != x {
            parent[x as usize] = parent[parent[x as usize] as usize];
            x = parent[x as usize];
        }
        x
    }
    for (a, list) in links.iter().enumerate() {
        for &b in list {
            let (x, y) = (root(&mut parent, a as u32), root(&mut parent, b));
            // The smaller index stays, so numbering does not depend on the order of joins.
            parent[x.max(y) as usize] = x.min(y);
        }
    }
    let mut number = vec![u32::MAX; clusters.len()];
    let mut count = 0;
    (0..clusters.len() as u32)
        .map(|k| {
            let r = root(&mut parent, k) as usize;
            if number[r] == u32::MAX {
                number[r] = count;
                count += 1;
            }
            number[r]
        })
        .collect()
}

/// For each patch: how many steps of its outline lead to something behind it, and how many steps there are.
fn outlines(grid: &Grid, first: &[u32], clusters: &[Cluster], patch_of: &[u32], patches: usize) -> Vec<(usize, usize)> {
    let mut outline = vec![(0, 0); patches];
    for (k, a) in clusters.iter().enumerate() {
        let own = patch_of[k];
        let cells = std::iter::once(a.cell as usize).chain(grid.neighbours(a.cell as usize, 1));
        for cell in cells {
            let range = first[cell] as usize..first[cell + 1] as usize;
            if cell != a.cell as usize && range.clone().any(|m| patch_of[m] == own) {
                continue; // The patch goes on there.
            }
            for m in range.filter(|&m| patch_of[m] != own) {
                let s = step(a, &clusters[m]);
                let entry = &mut outline[own as usize];
                // A single far point must not count as a wall behind.
                if clusters[m].count >= 2 {
                    entry.0 += usize::from(s < 0.0);
                    entry.1 += usize::from(s != 0.0);
                }
            }
        }
    }
    outline
}

/// Which patches go around most of the section where they are: the tunnel itself, narrower or wider there.
fn sections(grid: &Grid, clusters: &[Cluster], patch_of: &[u32], patches: usize) -> Vec<bool> {
    // Clusters come row by row, cell by cell.
    let (mut cells, mut rows) = (vec![0usize; patches], vec![0usize; patches]);
    let (mut last_cell, mut last_row) = (vec![usize::MAX; patches], vec![usize::MAX; patches]);
    for (c, &p) in clusters.iter().zip(patch_of) {
        let (p, cell) = (p as usize, c.cell as usize);
        cells[p] += usize::from(std::mem::replace(&mut last_cell[p], cell) != cell);
        rows[p] += usize::from(std::mem::replace(&mut last_row[p], cell / grid.columns) != cell / grid.columns);
    }
    cells.iter().zip(&rows).map(|(&c, &r)| c as f64 > MOST_OF_A_SECTION * (r * grid.columns) as f64).collect()
}

/// Which patches are benches: level strips low over the ground that run along the tunnel (walkways, kerbs, ballast
/// shoulders). They belong to the surface although they stand in front of it.
fn benches(
    grid: &Grid,
    section: &SectionField,
    clusters: &[Cluster],
    patch_of: &[u32],
    main: usize,
    patches: usize,
) -> Vec<bool> {
    // Height above the axis and distance right of it.
    let place = |c: &Cluster| {
        let (row, column) = (c.cell as usize / grid.columns, c.cell as usize % grid.columns);
        let chainage = grid.start + (row as f64 + 0.5) * grid.row_m;
        let (left, right) = section.girth_range(chainage);
        let girth = left + (right - left) * (column as f64 + 0.5) / grid.columns as f64;
        let angle = section.angle_of_girth(chainage, girth);
        let radius = section.radius(chainage, angle) + c.middle;
        (row, [radius * angle.sin(), radius * angle.cos()])
    };
    let (mut low, mut high) = (f64::MAX, f64::MIN);
    // Extent of each patch in each of its rows: (row, right from, right to, up from, up to).
    let mut extents: Vec<Vec<(usize, [f64; 4])>> = vec![Vec::new(); patches];
    for (c, &p) in clusters.iter().zip(patch_of) {
        let (row, [right, up]) = place(c);
        if p as usize == main {
            (low, high) = (low.min(up), high.max(up));
            continue;
        }
        let rows = &mut extents[p as usize];
        match rows.last_mut() {
            Some((r, e)) if *r == row => {
                *e = [e[0].min(right), e[1].max(right), e[2].min(up), e[3].max(up)];
            }
            _ => rows.push((row, [right, right, up, up])),
        }
    }
    let enough = (0.15 * grid.rows as f64).max(BENCH_LENGTH_M / grid.row_m);
    extents
        .iter()
        .map(|rows| {
            let level = rows.iter().filter(|(_, e)| {
                let (width, rise) = (e[1] - e[0] + grid.column_m, e[3] - e[2]);
                width > BENCH_WIDTH_M && rise < 0.5 * width && e[2] < low + BENCH_HEIGHT_SHARE * (high - low)
            });
            let level = level.count();
            rows.len() as f64 >= enough && 2 * level > rows.len()
        })
        .collect()
}

/// Median depth of each patch behind the main patch nearby (negative: in front); 0 where no main patch is near.
fn offsets_from_main(grid: &Grid, clusters: &[Cluster], patch_of: &[u32], main: usize, patches: usize) -> Vec<f64> {
    // Blocks of about half a metre hold the median of the main patch; empty ones take the mean of their neighbours.
    let block = ((0.5 / grid.column_m).round() as usize).max(1);
    let block_rows = ((0.5 / grid.row_m).round() as usize).max(1);
    let (rows, columns) = (grid.rows.div_ceil(block_rows), grid.columns.div_ceil(block));
    let block_of =
        |cell: u32| (cell as usize / grid.columns / block_rows) * columns + (cell as usize % grid.columns) / block;
    let mut values: Vec<Vec<f64>> = vec![Vec::new(); rows * columns];
    for (c, &p) in clusters.iter().zip(patch_of) {
        if p as usize == main {
            values[block_of(c.cell)].push(c.middle);
        }
    }
    let mut depth: Vec<f64> = values.iter_mut().map(|v| statistics::median(v).unwrap_or(f64::NAN)).collect();
    while depth.iter().any(|d| d.is_nan()) {
        let before = depth.clone();
        let mut changed = false;
        for (b, d) in depth.iter_mut().enumerate().filter(|(_, d)| d.is_nan()) {
            let (i, j) = (b / columns, b % columns);
            let around = [
                i.checked_sub(1).map(|i| i * columns + j),
                (i + 1 < rows).then_some((i + 1) * columns + j),
                Some(i * columns + (j + 1) % columns),
                Some(i * columns + (j + columns - 1) % columns),
            ];
            let known: Vec<f64> = around.into_iter().flatten().map(|n| before[n]).filter(|v| !v.is_nan()).collect();
            if !known.is_empty() {
                *d = known.iter().sum::<f64>() / known.len() as f64;
                changed = true;
            }
        }
        if !changed {
            break;
        }
    }
    let mut offsets: Vec<Vec<f64>> = vec![Vec::new(); patches];
    for (c, &p) in clusters.iter().zip(patch_of).filter(|(_, p)| **p as usize != main) {
        offsets[p as usize].push(c.middle - depth[block_of(c.cell)]);
    }
    offsets.iter_mut().map(|v| statistics::median(v).filter(|d| !d.is_nan()).unwrap_or(0.0)).collect()
}
