//! Side openings: where the wall lets one look into a side drift, a niche or a room, and what becomes of the surface there.
//!
//! On the unrolled grid an opening begins at cells that hold points far behind the wall (class *outside*) and no wall in
//! front of them; it takes in all cells around that lie behind the wall line by more than `BEHIND_IN_RADII`, so that
//! the cheeks and the floor of a side drift go with it. Relief that leads nowhere (a niche, an overbreak) is no opening.
//! The surface is then cut off at the wall line. The opening stays a hole, or the wall line is continued over it.
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
/// Beside an opening cells that lie behind the wall line by this share of that are still its cheeks, so many cells away.
const CHEEK_SHARE: f64 = 0.3;
const CHEEK_CELLS: usize = 3;
/// Share of the points of an opening that lie at its far end, for the end of its axis.
const FAR_SHARE: f64 = 0.05;

/// What becomes of side openings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum SideOpenings {
    /// They stay holes whose rim is the wall line.
    #[default]
    Hole,
    /// They are cut off and the wall line is continued over them, however wide: surface that nobody saw, marked as filled.
    Close,
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

/// What a person should know of openings that were cut off: left as holes, or closed by so many square metres.
pub(super) fn warning(openings: &[SideOpening], closed_m2: Option<f64>) -> Warning {
    let list: Vec<String> = openings
        .iter()
        .map(|o| {
            let side = format!("{:?}", o.side).to_lowercase();
            format!("{side} at {:.1} m ({:.1} m wide, seen {:.1} m deep)", o.chainage_m, o.width_m[0], o.seen_depth_m)
        })
        .collect();
    let became = match closed_m2 {
        None => "left as holes".to_owned(),
        Some(m2) => format!("closed by {m2:.1} m2 of wall that nobody saw (filled, not observed)"),
    };
    Warning::new(
        "side-openings",
        format!(
            "{} side opening(s) were cut off at the wall line and {became}: {}; mesh.side_openings changes that, and \
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
        if let Some(cell) = grid.cell_at(&p).filter(|_| p.depth > behind) {
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
        let extent = Extent::of(grid, &region);
        let opening = describe(grid, segmentation, axis, &region, &extent, &points_in);
        let wide = opening.width_m.iter().all(|w| *w >= LEAST_WIDTH_IN_RADII * mean_radius);
        // What fills half the section is no opening in a wall; the section itself is not understood there.
        let half_the_section = opening.width_m[1] > 0.6 * section.mean_perimeter();
        if wide && !half_the_section && opening.seen_depth_m >= LEAST_DEPTH_IN_RADII * mean_radius {
            take(grid, depth, region, &extent, behind, &mut open);
            found.push(opening);
        }
    }
    enclose(grid, depth, &mut open);
    found.sort_by(|a, b| a.chainage_m.total_cmp(&b.chainage_m));
    (open, found)
}

/// The rows and columns that a region of cells spans, first and last.
struct Extent {
    rows: [usize; 2],
    columns: [usize; 2],
    /// Columns are counted from the one opposite to this one, the region's first, so that the invert does not part them.
    reference: usize,
}

impl Extent {
    /// Of a region whose cells ascend.
    fn of(grid: &Grid, region: &[usize]) -> Self {
        let rows = [region[0] / grid.columns, region[region.len() - 1] / grid.columns];
        let mut extent = Self { rows, columns: [usize::MAX, 0], reference: region[0] % grid.columns };
        let columns = region.iter().map(|&c| extent.column(grid, c));
        extent.columns = columns.fold([usize::MAX, 0], |[low, high], c| [low.min(c), high.max(c)]);
        extent
    }

    fn column(&self, grid: &Grid, cell: usize) -> usize {
        (cell % grid.columns + grid.columns + grid.columns / 2 - self.reference) % grid.columns
    }

    fn holds(&self, grid: &Grid, cell: usize) -> bool {
        let between = |[first, last]: [usize; 2], at: usize| first <= at && at <= last;
        between(self.rows, cell / grid.columns) && between(self.columns, self.column(grid, cell))
    }
}

/// Opens the cells of a region, and the empty ones that hang together with them within its extent: a side drift is seen
/// aslant, and where one looks far into it nothing lies over the middle of its mouth. What is left of its cheeks around them
/// goes as well: the rim lies on the wall.
fn take(grid: &Grid, depth: &[f64], region: Vec<usize>, extent: &Extent, behind_m: f64, open: &mut [bool]) {
    region.iter().for_each(|&c| open[c] = true);
    let mut front = region;
    while let Some(cell) = front.pop() {
        for n in grid.neighbours(cell, 1) {
            if !open[n] && depth[n].is_nan() && extent.holds(grid, n) {
                open[n] = true;
                front.push(n);
            }
        }
    }
    for _ in 0..CHEEK_CELLS {
        let beside = |c: usize| grid.neighbours(c, 1).any(|n| open[n]);
        let cheeks: Vec<usize> =
            (0..grid.len()).filter(|&c| !open[c] && depth[c] > CHEEK_SHARE * behind_m && beside(c)).collect();
        cheeks.into_iter().for_each(|c| open[c] = true);
    }
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
    extent: &Extent,
    points_in: &[Vec<(u32, f64)>],
) -> SideOpening {
    let section = &segmentation.section;
    let ([first, last], [low, high]) = (extent.rows, extent.columns);
    let chainage_m = grid.start + (first + last + 1) as f64 / 2.0 * grid.row_m;
    let turn = extent.reference as f64 - (grid.columns / 2) as f64;
    let column = ((low + high + 1) as f64 / 2.0 + turn).rem_euclid(grid.columns as f64);
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
