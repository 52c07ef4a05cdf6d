//! Side openings: where the wall lets one look into a side drift, a niche or a room, and what becomes of the surface there.
//!
//! On the unrolled grid an opening begins at cells that hold points far behind the wall (class *outside*) and no wall in
//! front of them; it takes in all cells around that lie behind the wall line by more than `BEHIND_IN_RADII`, so that
//! the cheeks and the floor of a side drift go with it. Relief that leads nowhere (a niche, an overbreak) is no opening.
//! The surface is then cut off at the wall line: the opening stays a hole.
//!
//! Cost: linear in points and cells.

use crate::axis::{Axis, AxisCoordinates, Side};
use crate::numeric::Vec3;
use crate::segment::unrolled_grid::Grid;
use crate::segment::{Class, SectionField, Segmentation};
use crate::warning::Warning;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// Farther behind the mean section than this many mean radii is no wall when it leads into an opening.
const BEHIND_IN_RADII: f64 = 0.1;
/// Openings are wider than this many mean radii, along or around.
const LEAST_WIDTH_IN_RADII: f64 = 0.25;
/// An opening leads at least this many mean radii behind the wall line.
const LEAST_DEPTH_IN_RADII: f64 = 0.4;
/// Share of the points of an opening that lie at its far end, for the end of its axis.
const FAR_SHARE: f64 = 0.05;

/// What becomes of side openings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum SideOpenings {
    /// They stay holes whose rim is the wall line.
    #[default]
    Hole,
    /// Nothing is cut off: what was seen of the side drift stays part of the surface.
    Keep,
}

/// One side opening, for the report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SideOpening {
    /// Chainage of its middle, metres.
    pub chainage_m: f64,
    /// Angle of its middle around the axis, degrees: 0 at the crown, 90 on the right wall.
    pub angle_deg: f64,
    /// The side on which it leaves, facing increasing chainage.
    pub side: Side,
    /// Extent along the tunnel and around the section, metres.
    pub width_m: [f64; 2],
    /// How far behind the wall line something was seen, metres.
    pub seen_depth_m: f64,
    /// Points behind the wall line.
    pub points: usize,
    /// Two points, local metres: on the tunnel's axis and at the far end of what was seen. As `axis.ends` (in scan
    /// coordinates) they make the side drift a run of its own.
    pub ends_in_local: [[f64; 3]; 2],
}

/// How far behind the mean section the surface is no wall any more when it leads into an opening, metres.
pub(super) fn behind_m(section: &SectionField) -> f64 {
    BEHIND_IN_RADII * section.mean_perimeter() / TAU
}

/// What a person should know of the openings.
pub(super) fn warning(openings: &[SideOpening]) -> Warning {
    let list: Vec<String> = openings
        .iter()
        .map(|o| {
            let side = format!("{:?}", o.side).to_lowercase();
            format!("{side} at {:.1} m ({:.1} m wide, seen {:.1} m deep)", o.chainage_m, o.width_m[0], o.seen_depth_m)
        })
        .collect();
    Warning::new(
        "side-openings",
        format!(
            "{} side opening(s) were cut off at the wall line and left as holes: {}; mesh.side_openings changes that, and \
             axis.ends follows a side drift in a run of its own",
            openings.len(),
            list.join("; ")
        ),
    )
}

/// Finds the openings: a flag for each cell, and the list by chainage. `depth` is that of the surface in each cell,
/// metres behind the mean section, NaN without one.
pub(super) fn find(
    grid: &Grid,
    segmentation: &Segmentation,
    axis: &Axis,
    depth: &[f64],
) -> (Vec<bool>, Vec<SideOpening>) {
    let section = &segmentation.section;
    let mean_radius = section.mean_perimeter() / TAU;
    let behind = behind_m(section);
    let mut points_in: Vec<Vec<(u32, f64)>> = vec![Vec::new(); grid.len()];
    for (i, (c, _)) in
        segmentation.coordinates.iter().zip(&segmentation.class).enumerate().filter(|(_, (_, k))| **k == Class::Outside)
    {
        if c.chainage < section.start() || c.chainage > section.end() {
            continue;
        }
        let p = grid.unroll(section, c);
        if p.depth > behind && p.row >= 0.0 && p.row < grid.rows as f64 {
            let cell = p.row as usize * grid.columns + (p.column as usize).min(grid.columns - 1);
            points_in[cell].push((i as u32, p.depth));
        }
    }
    // A wall in front of far points (a mirror image, a point behind by error) is no opening.
    let seed = |cell: usize| !points_in[cell].is_empty() && (depth[cell].is_nan() || depth[cell] > behind);
    let mut number = vec![u32::MAX; grid.len()];
    let mut regions: Vec<Vec<usize>> = Vec::new();
    for start in 0..grid.len() {
        if number[start] != u32::MAX || !seed(start) {
            continue;
        }
        let id = regions.len() as u32;
        number[start] = id;
        let mut region = vec![start];
        let mut done = 0;
        while done < region.len() {
            let cell = region[done];
            done += 1;
            // Far points thin out, so single empty cells do not part a region.
            for n in grid.neighbours(cell, 2) {
                if number[n] == u32::MAX && (seed(n) || depth[n] > behind) {
                    number[n] = id;
                    region.push(n);
                }
            }
        }
        regions.push(region);
    }
    let mut open = vec![false; grid.len()];
    let mut found = Vec::new();
    for mut region in regions {
        region.sort_unstable();
        let opening = describe(grid, segmentation, axis, &region, &points_in);
        let wide = opening.width_m.iter().all(|w| *w >= LEAST_WIDTH_IN_RADII * mean_radius);
        // What fills half the section is no opening in a wall; the section itself is not understood there.
        let half_the_section = opening.width_m[1] > 0.6 * section.mean_perimeter();
        if wide && !half_the_section && opening.seen_depth_m >= LEAST_DEPTH_IN_RADII * mean_radius {
            region.iter().for_each(|&c| open[c] = true);
            found.push(opening);
        }
    }
    enclose(grid, depth, &mut open);
    found.sort_by(|a, b| a.chainage_m.total_cmp(&b.chainage_m));
    (open, found)
}

/// Empty cells between the cells of openings belong to them: two steps of growth into cells without surface.
fn enclose(grid: &Grid, depth: &[f64], open: &mut [bool]) {
    for _ in 0..2 {
        let grown: Vec<usize> = (0..grid.len())
            .filter(|&c| !open[c] && depth[c].is_nan() && grid.neighbours(c, 1).filter(|&n| open[n]).count() >= 3)
            .collect();
        grown.into_iter().for_each(|c| open[c] = true);
    }
}

fn describe(
    grid: &Grid,
    segmentation: &Segmentation,
    axis: &Axis,
    region: &[usize],
    points_in: &[Vec<(u32, f64)>],
) -> SideOpening {
    let section = &segmentation.section;
    let rows: Vec<usize> = region.iter().map(|c| c / grid.columns).collect();
    let (first, last) = (rows[0], rows[rows.len() - 1]);
    // Columns are counted from the one opposite to the region's first, so that the invert does not part them.
    let reference = region[0] % grid.columns;
    let half = grid.columns / 2;
    let shifted = |c: usize| (c % grid.columns + grid.columns + half - reference) % grid.columns;
    let low = region.iter().map(|&c| shifted(c)).min().unwrap_or(half);
    let high = region.iter().map(|&c| shifted(c)).max().unwrap_or(half);
    let chainage_m = grid.start + (first + last + 1) as f64 / 2.0 * grid.row_m;
    let column = ((low + high + 1) as f64 / 2.0 + reference as f64 - half as f64).rem_euclid(grid.columns as f64);
    let (left, right) = section.girth_range(chainage_m);
    let angle = section.angle_of_girth(chainage_m, left + (right - left) * column / grid.columns as f64);
    let mut behind: Vec<(u32, f64)> = region.iter().flat_map(|&c| points_in[c].iter().copied()).collect();
    behind.sort_unstable_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let far =
        &behind[..((FAR_SHARE * behind.len() as f64).ceil() as usize).clamp(1, behind.len().max(1)).min(behind.len())];
    let end = far.iter().map(|(i, _)| axis.point_at(&segmentation.coordinates[*i as usize])).sum::<Vec3>()
        / far.len().max(1) as f64;
    // One stray point must not tell the depth.
    let seen_depth_m = far.last().map_or(0.0, |f| f.1);
    SideOpening {
        chainage_m,
        angle_deg: angle.to_degrees(),
        side: Side::of(&AxisCoordinates::from_polar(chainage_m, angle, 1.0)),
        width_m: [(last - first + 1) as f64 * grid.row_m, (high - low + 1) as f64 * grid.column_m],
        seen_depth_m,
        points: behind.len(),
        ends_in_local: [axis.frame_at(chainage_m).origin.into(), end.into()],
    }
}
