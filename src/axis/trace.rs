//! Finds the axis of a scanned tunnel without any parameter.
//!
//! Steps: the space that the scan encloses on a coarse grid (`enclosed_void`); the way through it between its two
//! farthest ends (`skeleton`); slices perpendicular to that way, shifted onto their mean section and smoothed, again
//! and again (`sections`, `smoothing`); the ends where the section stops being covered; the direction of chainage.
//! Works for straight, curved, inclined, helical and vertical tunnels; a scan that encloses no elongated space is
//! refused with numbers. Guarantees: the same axis for any number of threads.

use super::enclosed_void::{EnclosedVoid, State, edge_for, enclosed_void};
use super::sections::{self, DIRECTIONS, NEAR, Refined, direction_of, refine, slice};
use super::skeleton::{self, Skeleton};
use super::{Axis, AxisCoordinates, Error};
use crate::clean::Spacing;
use crate::cloud::ScanFrame;
use crate::numeric::Vec3;
use crate::numeric::statistics::median;
use crate::warning::Warning;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Points used; more would only cost time.
const MOST_POINTS: usize = 200_000;
/// Cells with points on the coarse grid.
const SURFACE_CELLS: usize = 16_000;
/// The grid is refined until the void is this many cells wide (half width), if the points allow.
const CLEARANCE_CELLS: f64 = 4.5;
/// Share of directions that meet surface: inside a tunnel, and inside one that lacks its floor or roof.
const ENCLOSED: f64 = 0.76;
const HALF_OPEN: f64 = 0.62;
/// Share of the surface that must border on the enclosed space: for a tunnel, and for a half-open one.
const LEAST_SHARE: f64 = 0.25;
const LEAST_SHARE_HALF_OPEN: f64 = 0.6;
/// Share of the surface that must border on the strictly enclosed space for its loops to be loops of tunnels.
const LEAST_SHARE_OF_LOOP: f64 = 0.5;
/// Code of the warning that the space is enclosed only when one side may be open.
const HALF_OPEN_SECTION: &str = "half-open-section";
/// Length over width that is at least needed: for a tunnel, and for a half-open one.
const LEAST_ASPECT: f64 = 0.5;
const LEAST_ASPECT_HALF_OPEN: f64 = 2.0;
/// How far beyond the ends of the void more tunnel is looked for, in radii of the section.
const REACH_RADII: f64 = 8.0;
/// More tunnel is looked for again, this often at most, when a better axis found this much more surface.
const MOST_EXTENSIONS: usize = 3;
const EXTENDED: f64 = 1.005;
/// The tunnel ends where less than this share of the usual directions is covered.
const PORTAL_COVERAGE: f64 = 0.72;
/// Usual share of directions with surface below which there is no section: one wall of a tunnel has half.
const LEAST_COVERAGE: f64 = 0.3;
/// An axis that passes a portal's middle at more than this many radii has missed it.
const MISSED_RADII: f64 = 0.6;
/// So has one that the rough path strays from by more than this many.
const STRAYED_RADII: f64 = 0.4;
/// An axis that runs through rock for more than this share of its length is none.
const MOST_BURIED: f64 = 0.02;
/// Where the centres of the slices lie this close to the axis, in radii, the sections agree, whatever hides the middle of the
/// void: vehicles and ducts take the widest way from side to side.
const AGREEING_RADII: f64 = 0.05;
/// A tunnel that turns by more than this in all, and with a smaller radius than this many of its section's, bends sharply.
const SHARP_TURN_DEG: f64 = 40.0;
const SHARPEST_RADII: f64 = 4.0;
/// How often the middle of the void is smoothed.
const SMOOTHING_PASSES: usize = 6;
/// In the outermost slice the tunnel begins where this share of the directions has begun.
const BEGUN: f64 = 0.15;
/// Steeper than this from end to end, chainage runs downwards.
const DOWNWARDS_DEG: f64 = 60.0;
/// More points outside the axis' range than this is worth a warning, percent.
const MANY_OUTSIDE_PERCENT: f64 = 10.0;

/// How the axis is found.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// A CSV file with the centre line (`x,y,z` or `chainage,x,y,z` in scan coordinates). The axis is traced when not
    /// given.
    pub alignment: Option<PathBuf>,
    /// Chainage of the axis' first point in metres. 0, or the alignment's own chainage, when not given.
    pub start_chainage_m: Option<f64>,
    /// Which way chainage increases.
    pub direction: Direction,
    /// Chainage increases towards this azimuth, degrees clockwise from north. Overrides `direction`.
    pub direction_azimuth_deg: Option<f64>,
    /// In a shaft, the azimuth that its crown line faces, degrees clockwise from north. North when not given.
    pub crown_azimuth_deg: Option<f64>,
    /// Two points `[[x, y, z], [x, y, z]]` in scan coordinates between which to follow a network; a point within a width of
    /// the tunnel's end means that end. The two farthest ends when not given.
    pub ends: Option<[[f64; 3]; 2]>,
}

/// Which way chainage increases.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Direction {
    /// Towards the positive side of x or y, whichever the axis spans more; downwards in shafts; as in the alignment
    /// file if there is one.
    #[default]
    Auto,
    /// The opposite of `auto`.
    Reverse,
}

impl Settings {
    /// The settings with `ends` in local metres, as [`trace`] wants them.
    pub fn in_local(&self, frame: &ScanFrame) -> Self {
        let ends = self.ends.map(|e| e.map(|p| frame.local_from_scan(&p.into()).into()));
        Self { ends, ..self.clone() }
    }

    pub(super) fn check(&self) -> Result<(), Error> {
        let finite = |key, value: Option<f64>| match value {
            Some(v) if !v.is_finite() => Err(Error::Setting { key, problem: format!("{v} is not a finite number") }),
            _ => Ok(()),
        };
        finite("start_chainage_m", self.start_chainage_m)?;
        finite("direction_azimuth_deg", self.direction_azimuth_deg)?;
        finite("crown_azimuth_deg", self.crown_azimuth_deg)?;
        if let Some(ends) = self.ends {
            ends.iter().flatten().try_for_each(|v| finite("ends", Some(*v)))?;
            if ends[0] == ends[1] {
                return Err(Error::Setting { key: "ends", problem: "the two points are the same".to_owned() });
            }
        }
        Ok(())
    }
}

/// Where an axis came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// Traced through the scan.
    Traced,
    /// Read from an alignment file.
    Alignment,
}

/// On which side of the main tunnel something lies, facing increasing chainage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Side {
    /// Left wall.
    Left,
    /// Right wall.
    Right,
    /// Crown.
    Above,
    /// Invert.
    Below,
}

impl Side {
    /// The side on which a place lies: the nearest of the four directions.
    pub fn of(c: &AxisCoordinates) -> Self {
        if c.up.abs() > c.right.abs() {
            if c.up > 0.0 { Self::Above } else { Self::Below }
        } else if c.right > 0.0 {
            Self::Right
        } else {
            Self::Left
        }
    }
}

/// A side drift.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Branch {
    /// Chainage of its mouth, metres.
    pub chainage_m: f64,
    /// The side on which it leaves.
    pub side: Side,
    /// Its scanned length, metres.
    pub length_m: f64,
    /// A point in its middle, local metres: an end for `axis.ends` of its own run.
    pub middle_in_local: [f64; 3],
}

/// How the axis was found and what it is like.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Traced or imported.
    pub source: Source,
    /// Length of the axis, metres.
    pub length_m: f64,
    /// First chainage, metres.
    pub start_chainage_m: f64,
    /// Last chainage, metres.
    pub end_chainage_m: f64,
    /// Azimuth at the start and at the end, degrees.
    pub azimuth_deg: [f64; 2],
    /// Least and greatest gradient, percent; null where vertical.
    pub gradient_percent: [Option<f64>; 2],
    /// Least radius of curvature, metres; null when straight (above 100 km).
    pub least_bend_radius_m: Option<f64>,
    /// Whether the frame is carried along because gravity cannot define it.
    pub shaft: bool,
    /// Radius of the circle with the area of the mean section, metres.
    pub section_radius_m: Option<f64>,
    /// Share of the surface that borders on the enclosed space, 0 to 1.
    pub enclosed_share: Option<f64>,
    /// Cell of the coarse grid, metres.
    pub coarse_cell_m: Option<f64>,
    /// Median share of directions around the axis with surface near the mean section, 0 to 1.
    pub coverage: Option<f64>,
    /// Movements of the section's centre along less than this are relief, not axis; metres.
    pub smoothing_wavelength_m: Option<f64>,
    /// Median distance between the axis and the centres of single slices, metres.
    pub centre_residual_m: Option<f64>,
    /// Whether the start and the end are portals (else the scan just ends, or the tunnel has a face).
    pub ends_at_portal: Option<[bool; 2]>,
    /// Share of the points before the start and after the end, percent.
    pub outside_percent: [f64; 2],
    /// Side drifts, by chainage.
    pub branches: Vec<Branch>,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Traces the axis of the tunnel that `points` (local metres, one per voxel or otherwise evened out) were scanned in.
///
/// # Errors
/// [`Error::NotATunnel`] with what was seen, [`Error::ClosedLoop`], [`Error::Setting`].
pub fn trace(points: &[Vec3], settings: &Settings) -> Result<(Axis, Summary), Error> {
    settings.check()?;
    if let Some(index) = points.iter().position(|p| !p.iter().all(|c| c.is_finite())) {
        return Err(Error::NotFinite { index });
    }
    let sample: Vec<Vec3> = points.iter().step_by(points.len().div_ceil(MOST_POINTS).max(1)).copied().collect();
    if sample.len() < 200 {
        return Err(not_a_tunnel("there are too few points", None, 0.0));
    }
    let spacing = Spacing::estimate(&sample);
    let mut warnings = Vec::new();
    let ends = settings.ends.map(|e| e.map(Vec3::from));
    let mut void = find_void(&sample, &spacing, false, &mut warnings)?;
    let strictly = !warnings.iter().any(|w| w.code == HALF_OPEN_SECTION);
    let strict_share = if strictly { void.enclosed_share } else { 0.0 };
    let mut skeleton = skeleton::skeleton(&void, ends);
    if skeleton.loop_arm_m.is_some() && ends.is_none() {
        // A way through a wall that is thin, or leaks, is none.
        if let Some(thicker) = void.without_thin_parts() {
            let way = skeleton::skeleton(&thicker, ends);
            if way.loop_arm_m.is_none() {
                (void, skeleton) = (thicker, way);
                warnings.push(Warning::new(
                    "thin-walls",
                    "ways around that lead through walls thinner than a few points' distance, or through holes of their scan, \
                     were taken for closed; axis.ends follows another way",
                ));
            }
        }
    }
    if skeleton.loop_arm_m.is_some() && ends.is_none() {
        // In a very short tunnel only a ring along the wall is well enclosed; with more patience its middle is too.
        void = find_void(&sample, &spacing, true, &mut warnings)?;
        skeleton = skeleton::skeleton(&void, ends);
        if let Some(arm_m) = skeleton.loop_arm_m {
            // Hollows of an outcrop hang together in circles too; the walls of a loop of tunnels nearly all face it.
            if strict_share < LEAST_SHARE_OF_LOOP {
                return Err(not_a_tunnel(
                    "what is enclosed runs in circles and too little of the surface faces it",
                    Some(&void),
                    length_of(&void),
                ));
            }
            return Err(Error::ClosedLoop { arm_m });
        }
    }
    let rough = rough_axis(&skeleton, &void)?;
    let volume = skeleton.main_cells.len() as f64 * void.grid.cell_m.powi(3);
    let radius_m = (volume / rough.length().max(void.clearance_m) / std::f64::consts::PI).sqrt().max(void.clearance_m);
    let ends_of = |axis: &Axis| (axis.start_chainage(), axis.end_chainage());
    let mut surface = surface_of(&sample, &void, &skeleton.main_cells, &rough, ends_of(&rough), radius_m);
    let least_step_m = (1.3 * spacing.across_m).max(3.0 * spacing.along_m);
    let mut refined = refine(&surface, &rough, radius_m, least_step_m, 1.5 * radius_m)?;
    for _ in 0..MOST_EXTENSIONS {
        // The rough path winds around what stands in the tunnel; its straight continuation may miss the rest of it.
        let void_end = |s: f64| refined.axis.project(&rough.frame_at(s).origin).chainage;
        let ends = (void_end(rough.start_chainage()), void_end(rough.end_chainage()));
        let more = surface_of(&sample, &void, &skeleton.main_cells, &refined.axis, ends, refined.radius_m);
        if more.len() as f64 <= EXTENDED * surface.len() as f64 {
            break;
        }
        surface = more;
        refined = refine(&surface, &refined.axis, refined.radius_m, least_step_m, 1.5 * refined.radius_m)?;
    }
    let mut knot_spacing_m = refined.radius_m;
    if let Some(bend) = sharp_bend(&skeleton, &void, &refined, radius_m)? {
        knot_spacing_m = 0.5 * radius_m;
        warnings.push(Warning::new(
            "sharp-bend",
            format!(
                "the tunnel turns by {:.0} degrees within {:.1} m, and its section is {:.1} m wide: the axis follows the middle of \
                 the void, because sections overlap",
                bend.turns_deg,
                bend.length_m,
                2.0 * radius_m
            ),
        ));
        refined = bend.refined;
        surface = surface_of(&sample, &void, &void.cells, &refined.axis, ends_of(&refined.axis), radius_m);
    }
    let (range, coverage) = covered_range(&surface, &refined, least_step_m)
        .ok_or_else(|| not_a_tunnel("no section is covered well enough", Some(&void), rough.length()))?;
    if coverage < LEAST_COVERAGE {
        return Err(not_a_tunnel("too little of any section around the axis has surface", Some(&void), rough.length()));
    }
    let range = match &ends {
        Some(ends) => super::ends::between(ends, &refined.axis, range, refined.radius_m)?,
        None => range,
    };
    let knots = knots_between(&refined.axis, range, knot_spacing_m);
    let start_chainage = settings.start_chainage_m.unwrap_or(0.0);
    let forwards = Axis::through(&knots, start_chainage)?;
    let flipped = is_against_direction(&forwards, settings);
    let axis = finish(if flipped { forwards.reversed(start_chainage) } else { forwards }, settings, &mut warnings);

    let mut ends_at_portal = skeleton.ends_at_portal;
    if flipped {
        ends_at_portal.reverse();
    }
    let outside_percent = outside_percent(&sample, &axis);
    if outside_percent[0] + outside_percent[1] > MANY_OUTSIDE_PERCENT {
        warnings.push(Warning::new(
            "points-beyond-portals",
            format!(
                "{:.1} % of the points lie before the start and {:.1} % after the end of the enclosed tunnel; they are \
                 not mapped",
                outside_percent[0], outside_percent[1]
            ),
        ));
    }
    let branches = branches(&skeleton, &axis, refined.radius_m);
    if !branches.is_empty() {
        let list: Vec<String> = branches
            .iter()
            .map(|b| format!("{:?} at {:.1} m, {:.0} m long", b.side, b.chainage_m, b.length_m).to_lowercase())
            .collect();
        warnings.push(Warning::new(
            "branches",
            format!(
                "the tunnel has {} side drift(s) that are not followed: {}; give axis.ends to follow one",
                branches.len(),
                list.join("; ")
            ),
        ));
    }
    if skeleton.pillars > 0 {
        warnings.push(Warning::new(
            "obstacles",
            format!("the void splits around {} pillar(s) or other obstacles; the axis passes them", skeleton.pillars),
        ));
    }
    let mut summary = describe(&axis, Source::Traced, warnings);
    summary.section_radius_m = Some(refined.radius_m);
    summary.enclosed_share = Some(void.enclosed_share);
    summary.coarse_cell_m = Some(void.grid.cell_m);
    summary.coverage = Some(coverage);
    summary.smoothing_wavelength_m = Some(refined.wavelength_m);
    summary.centre_residual_m = Some(refined.residual_m);
    summary.ends_at_portal = Some(ends_at_portal);
    summary.outside_percent = outside_percent;
    summary.branches = branches;
    Ok((axis, summary))
}

fn not_a_tunnel(reason: &'static str, void: Option<&EnclosedVoid>, length_m: f64) -> Error {
    Error::NotATunnel {
        reason,
        enclosed_share: void.map_or(0.0, |v| v.enclosed_share),
        length_m,
        width_m: void.map_or(0.0, |v| 2.0 * v.clearance_m),
    }
}

/// The enclosed void on a grid fine enough to see it and coarse enough that walls have no gaps.
fn find_void(
    points: &[Vec3],
    spacing: &Spacing,
    only_patiently: bool,
    warnings: &mut Vec<Warning>,
) -> Result<EnclosedVoid, Error> {
    let finest = (2.5 * spacing.along_m).max(1.15 * spacing.across_m);
    let coarsest = edge_for(points, SURFACE_CELLS).max(finest);
    let search = |share: f64, least_share: f64| {
        let mut cell_m = coarsest;
        let mut best: Option<EnclosedVoid> = None;
        loop {
            let found = enclosed_void(points, cell_m, share);
            let wide_enough = found.as_ref().is_some_and(|v| v.clearance_m >= CLEARANCE_CELLS * cell_m);
            if let Some(void) = found
                && best.as_ref().is_none_or(|b| void.enclosed_share > 0.8 * b.enclosed_share)
            {
                best = Some(void);
            }
            let good = best.as_ref().is_some_and(|b| b.enclosed_share >= least_share);
            if (wide_enough && good) || cell_m <= finest || cell_m < 0.1 * coarsest {
                return best;
            }
            cell_m = (0.6 * cell_m).max(finest);
        }
    };
    let closed = if only_patiently { None } else { search(ENCLOSED, LEAST_SHARE) };
    if let Some(void) = closed.as_ref().filter(|v| v.enclosed_share >= LEAST_SHARE) {
        let length_m = length_of(void);
        if length_m >= LEAST_ASPECT * 2.0 * void.clearance_m && void.clearance_m >= 2.0 * void.grid.cell_m {
            return Ok(closed.expect("just looked at"));
        }
    }
    let open = search(HALF_OPEN, LEAST_SHARE_HALF_OPEN);
    if let Some(void) = open.as_ref().filter(|v| v.enclosed_share >= LEAST_SHARE_HALF_OPEN) {
        let length_m = length_of(void);
        let least_aspect = if only_patiently { LEAST_ASPECT } else { LEAST_ASPECT_HALF_OPEN };
        if length_m >= least_aspect * 2.0 * void.clearance_m && void.clearance_m >= 2.0 * void.grid.cell_m {
            let message = if only_patiently {
                "the tunnel is shorter than wide; its axis is uncertain"
            } else {
                "the section is open on one side (a trench, or a floor or roof that was not scanned); the axis follows \
                 what is there"
            };
            warnings.push(Warning::new(HALF_OPEN_SECTION, message));
            return Ok(open.expect("just looked at"));
        }
        return Err(not_a_tunnel("the enclosed space is not elongated", Some(void), length_m));
    }
    match closed.or(open) {
        Some(void) => {
            let length_m = length_of(&void);
            let reason = if void.enclosed_share < LEAST_SHARE {
                "too little of the surface faces an enclosed space"
            } else {
                "the enclosed space is not elongated"
            };
            Err(not_a_tunnel(reason, Some(&void), length_m))
        }
        None => Err(not_a_tunnel("the surface encloses no space", None, 0.0)),
    }
}

/// Largest extent of a void's cells, metres: enough for judging whether it is elongated.
fn length_of(void: &EnclosedVoid) -> f64 {
    let centres: Vec<Vec3> = void.cells.iter().map(|&c| void.grid.centre(c)).collect();
    crate::spatial::voxel_grid::bounds(&centres).map_or(0.0, |(low, high)| (high - low).norm())
}

/// A curve through the skeleton's path, freed of the steps of the grid.
fn rough_axis(skeleton: &Skeleton, void: &EnclosedVoid) -> Result<Axis, Error> {
    let mut path = skeleton.path.clone();
    for _ in 0..4 {
        let before = path.clone();
        for i in 1..path.len().saturating_sub(1) {
            path[i] = (before[i - 1] + before[i] * 2.0 + before[i + 1]) / 4.0;
        }
    }
    let mut knots: Vec<Vec3> = Vec::new();
    for p in &path {
        if knots.last().is_none_or(|last| (p - last).norm() >= 0.7 * void.clearance_m) {
            knots.push(*p);
        }
    }
    if knots.len() < 2 {
        knots = vec![path[0], path[path.len() - 1]];
    }
    if (knots[knots.len() - 1] - knots[0]).norm() < 0.5 * void.grid.cell_m {
        return Err(not_a_tunnel("the enclosed space is not elongated", Some(void), length_of(void)));
    }
    Axis::through(&knots, 0.0)
}

/// Points on the surface of these cells of the void, and those that continue it along `axis` beyond the chainages where the
/// void ends.
fn surface_of(
    points: &[Vec3],
    void: &EnclosedVoid,
    main_cells: &[usize],
    axis: &Axis,
    (start, end): (f64, f64),
    radius_m: f64,
) -> Vec<Vec3> {
    let grid = &void.grid;
    let occupied_around = |cells: &[usize]| {
        let mut around: Vec<usize> = cells
            .iter()
            .flat_map(|&c| grid.neighbours(c, 26).map(|(n, _)| n))
            .filter(|&n| grid.state(n) == State::Occupied)
            .collect();
        around.sort_unstable();
        around.dedup();
        around
    };
    let touching = occupied_around(main_cells);
    let mut walls = occupied_around(&touching);
    walls.extend(&touching);
    walls.sort_unstable();
    walls.dedup();
    let keep: Vec<bool> = points
        .par_iter()
        .with_min_len(1024)
        .map(|p| {
            if grid.cell_at(p).is_some_and(|c| walls.binary_search(&c).is_ok()) {
                return true;
            }
            let c = axis.project(p);
            let beyond = (start - c.chainage).max(c.chainage - end);
            beyond > -radius_m && beyond < REACH_RADII * radius_m && c.radius() < 1.6 * radius_m
        })
        .collect();
    points.iter().zip(keep).filter(|(_, k)| *k).map(|(p, _)| *p).collect()
}

/// First and last chainage at which enough of the section is covered, and the usual coverage.
fn covered_range(surface: &[Vec3], refined: &Refined, least_step_m: f64) -> Option<((f64, f64), f64)> {
    let axis = &refined.axis;
    let span = (axis.start_chainage(), axis.end_chainage());
    let step_m = (0.1 * refined.radius_m).max(least_step_m).max((span.1 - span.0) / 8000.0);
    let slices = slice(surface, axis, step_m, refined.radius_m, span);
    let coverage: Vec<f64> = (0..slices.radii.len()).map(|i| slices.coverage(i)).collect();
    let mut seen: Vec<f64> = coverage.iter().copied().filter(|c| *c > 0.1).collect();
    let usual = median(&mut seen)?;
    let limit = PORTAL_COVERAGE * usual;
    let first = coverage.iter().position(|c| *c >= limit)?;
    let last = coverage.iter().rposition(|c| *c >= limit)?;
    // Within the outermost slices: where the wall begins in each direction.
    let needed = ((BEGUN * DIRECTIONS as f64).ceil() as usize).max(1);
    let slice_start = |i: usize| slices.start + i as f64 * slices.step_m;
    let extreme = |from: f64, to: f64, sign: f64| -> f64 {
        let mut nearest = [f64::INFINITY; DIRECTIONS];
        for p in surface {
            let c: AxisCoordinates = axis.project(p);
            if c.chainage >= from && c.chainage <= to {
                let mean = slices.mean_radius(&c);
                if (c.radius() - mean).abs() < NEAR * mean {
                    let a = direction_of(&c);
                    nearest[a] = nearest[a].min(sign * c.chainage);
                }
            }
        }
        let mut begun: Vec<f64> = nearest.iter().copied().filter(|n| n.is_finite()).collect();
        begun.sort_unstable_by(f64::total_cmp);
        // Nothing near the mean section itself although the medians are: the slice's own border.
        begun
            .get((needed - 1).min(begun.len().saturating_sub(1)))
            .map_or(if sign > 0.0 { from } else { to }, |s| sign * s)
    };
    let start = extreme(slice_start(first), slice_start(first + 1), 1.0);
    let end = extreme(slice_start(last), slice_start(last + 1), -1.0);
    (end > start).then_some(((start, end), usual))
}

/// The middle of a void that turns within few widths, so that its sections overlap.
struct SharpBend {
    refined: Refined,
    /// Sum of its turns, degrees.
    turns_deg: f64,
    /// Length from portal to portal, metres.
    length_m: f64,
}

/// The middle of the void as the axis, if the refined one misses a portal, strays from the rough path or runs through rock,
/// because the tunnel bends too sharply for sections.
fn sharp_bend(
    skeleton: &Skeleton,
    void: &EnclosedVoid,
    refined: &Refined,
    radius_m: f64,
) -> Result<Option<SharpBend>, Error> {
    if refined.residual_m < AGREEING_RADII * refined.radius_m {
        return Ok(None);
    }
    let missed = |p: &Vec3| refined.axis.project(p).radius() > MISSED_RADII * radius_m;
    let samples = (refined.axis.length() / void.grid.cell_m).ceil() as usize;
    let at = |i: usize| refined.axis.start_chainage() + refined.axis.length() * i as f64 / samples as f64;
    let in_rock = |i: &usize| {
        let cell = void.grid.cell_at(&refined.axis.frame_at(at(*i)).origin);
        cell.is_some_and(|c| void.grid.state(c) == State::Occupied)
    };
    let buried = (0..=samples).filter(in_rock).count() as f64;
    let strays = |p: &Vec3| refined.axis.project(p).radius() > STRAYED_RADII * radius_m;
    if buried <= MOST_BURIED * samples as f64
        && !skeleton.portals(void).iter().any(missed)
        && !skeleton.path.iter().any(strays)
    {
        return Ok(None);
    }
    let way = skeleton.widest_way(void);
    let mut line = vec![way[0]];
    for p in &way[1..] {
        if (p - line[line.len() - 1]).norm() >= 0.5 * void.clearance_m {
            line.push(*p);
        }
    }
    if line.len() < 3 {
        return Ok(None);
    }
    for _ in 0..SMOOTHING_PASSES {
        let before = line.clone();
        for i in 1..line.len() - 1 {
            line[i] = (before[i - 1] + before[i] * 2.0 + before[i + 1]) / 4.0;
        }
    }
    let length_m: f64 = line.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
    let turns: f64 = line.windows(3).map(|w| (w[1] - w[0]).angle(&(w[2] - w[1]))).sum();
    if turns < SHARP_TURN_DEG.to_radians() || length_m > SHARPEST_RADII * radius_m * turns {
        return Ok(None);
    }
    let axis = sections::extended(&line, 1.5 * radius_m)?;
    let mut gaps: Vec<f64> = way.iter().map(|p| axis.project(p).radius()).collect();
    let residual_m = median(&mut gaps).unwrap_or(0.0);
    Ok(Some(SharpBend {
        refined: Refined { axis, radius_m, wavelength_m: void.clearance_m, residual_m },
        turns_deg: turns.to_degrees(),
        length_m,
    }))
}

fn knots_between(axis: &Axis, (start, end): (f64, f64), spacing_m: f64) -> Vec<Vec3> {
    let count = (((end - start) / spacing_m).round() as usize).max(1);
    (0..=count).map(|i| axis.frame_at(start + (end - start) * i as f64 / count as f64).origin).collect()
}

/// Whether chainage has to run the other way to follow the settings or the rule.
fn is_against_direction(axis: &Axis, settings: &Settings) -> bool {
    let (start, end) = (axis.frame_at(axis.start_chainage()).origin, axis.frame_at(axis.end_chainage()).origin);
    let chord = end - start;
    if let Some(azimuth) = settings.direction_azimuth_deg {
        let (sin, cos) = azimuth.to_radians().sin_cos();
        return chord.x * sin + chord.y * cos < 0.0;
    }
    let against = if chord.z.abs() > chord.norm() * DOWNWARDS_DEG.to_radians().sin() {
        chord.z > 0.0
    } else {
        let steps = (axis.length().ceil() as usize).clamp(2, 10_000);
        let points: Vec<Vec3> = (0..=steps)
            .map(|i| axis.frame_at(axis.start_chainage() + axis.length() * i as f64 / steps as f64).origin)
            .collect();
        let (low, high) = crate::spatial::voxel_grid::bounds(&points).expect("an axis has points");
        if high.x - low.x > high.y - low.y { chord.x < 0.0 } else { chord.y < 0.0 }
    };
    against != (settings.direction == Direction::Reverse)
}

/// Applies what the settings say about the frame.
pub(super) fn finish(axis: Axis, settings: &Settings, warnings: &mut Vec<Warning>) -> Axis {
    match settings.crown_azimuth_deg {
        Some(azimuth) if axis.is_shaft() => axis.with_crown_azimuth(azimuth),
        Some(azimuth) => {
            warnings.push(Warning::new(
                "crown-azimuth-unused",
                format!(
                    "axis.crown_azimuth_deg = {azimuth} was ignored: the axis is no shaft, gravity defines its crown"
                ),
            ));
            axis
        }
        None => axis,
    }
}

/// The direction of an imported axis.
pub(super) fn imported_direction(axis: Axis, settings: &Settings) -> Axis {
    let turn = match settings.direction_azimuth_deg {
        Some(_) => is_against_direction(&axis, settings),
        None => settings.direction == Direction::Reverse,
    };
    let start = axis.start_chainage();
    if turn { axis.reversed(start) } else { axis }
}

fn outside_percent(points: &[Vec3], axis: &Axis) -> [f64; 2] {
    let chainages: Vec<f64> = points.par_iter().with_min_len(1024).map(|p| axis.project(p).chainage).collect();
    let share = |count: usize| 100.0 * count as f64 / points.len() as f64;
    // A millimetre of grace: the outermost points define the ends.
    [
        share(chainages.iter().filter(|c| **c < axis.start_chainage() - 1e-3).count()),
        share(chainages.iter().filter(|c| **c > axis.end_chainage() + 1e-3).count()),
    ]
}

fn branches(skeleton: &Skeleton, axis: &Axis, radius_m: f64) -> Vec<Branch> {
    let mut found: Vec<Branch> = skeleton
        .branches
        .iter()
        .filter_map(|rough| {
            let mouth = axis.project(&rough.mouth);
            // What leaves beyond the ends is the outside of a portal.
            if mouth.chainage <= axis.start_chainage() || mouth.chainage >= axis.end_chainage() {
                return None;
            }
            // The axis may run through what the rough path left beside it.
            if axis.project(&rough.middle).radius() < 0.5 * radius_m {
                return None;
            }
            let frame = axis.frame_at(mouth.chainage);
            let towards = rough.middle - frame.origin;
            let middle = AxisCoordinates {
                chainage: mouth.chainage,
                right: -towards.dot(&frame.left),
                up: towards.dot(&frame.up),
            };
            Some(Branch {
                chainage_m: mouth.chainage,
                side: Side::of(&middle),
                length_m: rough.length_m,
                middle_in_local: rough.middle.into(),
            })
        })
        .collect();
    found.sort_by(|a, b| a.chainage_m.total_cmp(&b.chainage_m));
    found
}

/// What can be said of any axis.
pub(super) fn describe(axis: &Axis, source: Source, warnings: Vec<Warning>) -> Summary {
    let steps = (axis.length().ceil() as usize).clamp(2, 10_000);
    let chainages: Vec<f64> =
        (0..=steps).map(|i| axis.start_chainage() + axis.length() * i as f64 / steps as f64).collect();
    let gradients: Vec<f64> = chainages.iter().map(|&s| axis.gradient_percent(s)).collect();
    let bend = chainages.iter().map(|&s| axis.bend_radius(s)).fold(f64::INFINITY, f64::min);
    let finite = |v: f64| v.is_finite().then_some(v);
    Summary {
        source,
        length_m: axis.length(),
        start_chainage_m: axis.start_chainage(),
        end_chainage_m: axis.end_chainage(),
        azimuth_deg: [axis.azimuth_deg(axis.start_chainage()), axis.azimuth_deg(axis.end_chainage())],
        gradient_percent: [
            finite(gradients.iter().copied().fold(f64::INFINITY, f64::min)),
            finite(gradients.iter().copied().fold(f64::NEG_INFINITY, f64::max)),
        ],
        least_bend_radius_m: (bend < 1e5).then_some(bend),
        shaft: axis.is_shaft(),
        section_radius_m: None,
        enclosed_share: None,
        coarse_cell_m: None,
        coverage: None,
        smoothing_wavelength_m: None,
        centre_residual_m: None,
        ends_at_portal: None,
        outside_percent: [0.0, 0.0],
        branches: Vec::new(),
        warnings,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clean;
    use crate::synthetic::{Course, Recipe, Shape, scan};

    /// Length of the traced axis, and its greatest angle to the true one in degrees.
    fn length_and_angle(recipe: &Recipe) -> (f64, f64) {
        let tunnel = recipe.tunnel().unwrap();
        let scan = scan(&tunnel, &recipe.plan().unwrap()).unwrap();
        let (geometry, _) = clean::clean(&scan.cloud, &clean::Settings::default()).unwrap();
        let (axis, _) = trace(geometry.positions(), &Settings::default()).unwrap();
        let truth = tunnel.axis();
        let steps = 40;
        let angle = |i: i32| {
            let frame = axis.frame_at(axis.start_chainage() + axis.length() * f64::from(i) / f64::from(steps));
            let there = truth.frame_at(truth.project(&frame.origin).chainage).forward;
            frame.forward.cross(&there).norm().atan2(frame.forward.dot(&there).abs()).to_degrees()
        };
        (axis.length(), (0..=steps).map(angle).fold(0.0, f64::max))
    }

    /// A corridor of 2.4 x 2.4 x 24 m along x with rooms of 7 x 4 x 2.4 m behind walls of 0.4 m on its left, each with a door
    /// of 1 m at its start. Points every 6 cm; the scan of the walls between has a hole of 36 cm at the far end of each room.
    fn corridor_with_rooms() -> Vec<Vec3> {
        const ROOMS: [f64; 3] = [1.5, 9.2, 16.9];
        let within = |p: &Vec3, low: [f64; 3], high: [f64; 3]| (0..3).all(|a| p[a] > low[a] && p[a] < high[a]);
        let inside = |p: &Vec3| {
            within(p, [-1.0, -1.2, 0.0], [25.0, 1.2, 2.4])
                || ROOMS.iter().any(|x| {
                    within(p, [x - 0.7, 1.6, 0.0], [x + 6.3, 5.6, 2.4])
                        || within(p, [x - 0.5, 1.1, 0.0], [x + 0.5, 1.7, 2.0])
                })
        };
        let hole = |p: &Vec3| ROOMS.iter().any(|x| within(p, [x + 5.3, 0.9, 1.0], [x + 5.66, 1.8, 1.36]));
        let step = 0.06;
        let mut points = Vec::new();
        for i in 0..400 {
            for j in -22..96 {
                for k in -1..42 {
                    let p = [i, j, k].map(|n| (f64::from(n) + 0.5) * step).into();
                    let beside = [Vec3::x(), Vec3::y(), Vec3::z()].map(|a| [p + a * step, p - a * step]);
                    if !inside(&p) && beside.iter().flatten().any(&inside) && !hole(&p) {
                        points.push(p);
                    }
                }
            }
        }
        points
    }

    #[test]
    fn a_wall_that_leaks_makes_no_loop_of_a_corridor_and_its_rooms() {
        let points = corridor_with_rooms();
        let void = find_void(&points, &Spacing::estimate(&points), false, &mut Vec::new()).unwrap();
        assert!(skeleton::skeleton(&void, None).loop_arm_m.is_some(), "the holes are wide enough to be a way");
        let (axis, summary) = trace(&points, &Settings::default()).unwrap();
        assert!((axis.length() - 24.0).abs() < 1.0, "{}", axis.length());
        assert!((0..=24).all(|s| axis.frame_at(axis.start_chainage() + f64::from(s)).origin.y.abs() < 0.15));
        assert_eq!(summary.branches.len(), 3, "{:?}", summary.branches);
        assert!(summary.warnings.iter().any(|w| w.code == "thin-walls"), "{:?}", summary.warnings);
        assert!(summary.branches.iter().all(|b| b.side == Side::Left));
    }

    #[test]
    fn what_stands_in_a_drift_does_not_bend_its_axis() {
        use crate::synthetic::Kind;
        for (course, length_m) in
            [(Course::Straight, 10.0), (Course::Bend, 14.0), (Course::Ramp, 18.0), (Course::Bend, 30.0)]
        {
            let recipe = Recipe {
                course,
                length_m,
                points: (6000.0 * length_m) as usize,
                furniture: vec![Kind::Duct, Kind::Cables, Kind::Rails, Kind::Vehicle],
                ..Recipe::default()
            };
            let (length, angle) = length_and_angle(&recipe);
            assert!(
                length > 0.95 * length_m && angle < 7.0,
                "{length_m} m {course:?}: length {length:.2} m, {angle:.1} degrees off"
            );
        }
    }

    #[test]
    fn a_tunnel_that_turns_within_two_widths_keeps_its_turn() {
        // 158 degrees around a bend of one width: no section is seen whole from its middle.
        let recipe = Recipe {
            shape: Shape::Circle { radius_m: 2.0 },
            course: Course::Bend,
            radius_m: 4.0,
            length_m: 11.0,
            points: 40_000,
            furniture: vec![],
            ..Recipe::default()
        };
        let tunnel = recipe.tunnel().unwrap();
        let scan = scan(&tunnel, &recipe.plan().unwrap()).unwrap();
        let (geometry, _) = clean::clean(&scan.cloud, &clean::Settings::default()).unwrap();
        let (axis, summary) = trace(geometry.positions(), &Settings::default()).unwrap();
        assert!(summary.warnings.iter().any(|w| w.code == "sharp-bend"), "{:?}", summary.warnings);
        let frames: Vec<_> =
            (0..=20).map(|i| axis.frame_at(axis.start_chainage() + axis.length() * f64::from(i) / 20.0)).collect();
        let turn = frames[0].forward.angle(&frames[20].forward).to_degrees();
        let off = frames.iter().map(|f| tunnel.axis().project(&f.origin).radius()).fold(0.0, f64::max);
        assert!(turn > 60.0 && off < 1.0, "turns {turn:.0} degrees, {off:.2} m off");
    }

    #[test]
    fn tunnels_hardly_longer_than_wide_get_a_sober_axis() {
        let horseshoe = Shape::Horseshoe { width_m: 4.6, height_m: 4.2 };
        let circle = Shape::Circle { radius_m: 2.0 };
        for (shape, length_m, course) in [
            (horseshoe, 7.0, Course::Straight),
            (horseshoe, 8.0, Course::Bend),
            (horseshoe, 12.0, Course::Ramp),
            (circle, 8.0, Course::Straight),
        ] {
            let recipe = Recipe { shape, length_m, course, points: 40_000, furniture: vec![], ..Recipe::default() };
            let (length, angle) = length_and_angle(&recipe);
            // A straight axis through a short bend is off by half the turn at its ends.
            let half_turn = if course == Course::Bend { (length_m / recipe.radius_m / 2.0).to_degrees() } else { 0.0 };
            assert!(
                (length - length_m).abs() < 0.05 * length_m && angle < half_turn + 1.5,
                "{shape:?} {length_m} m {course:?}: length {length:.2} m, {angle:.1} degrees off"
            );
        }
    }
}
