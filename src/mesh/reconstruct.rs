//! The verb of the mesh stage: from classified points, or from faces made elsewhere, to one oriented manifold.

use super::borders::{self, Borders};
use super::decimate::{self, Decimate};
use super::openings::{self, SideOpening, SideOpenings};
use super::wall_line::WallLine;
use super::{FaceId, Mesh, VertexId, poisson, repair, section, topology};
use crate::axis::{Axis, AxisCoordinates};
use crate::numeric::Vec3;
use crate::segment::{Class, Segmentation};
use crate::warning::Warning;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Above this share of cells with several depths the section method loses too much of the surface, percent.
const MANY_DEPTHS_PERCENT: f64 = 5.0;
/// Above this share of points in front of the surface, these are rough rock and no furniture.
const MUCH_FURNITURE: f64 = 0.1;
/// Above this share the mean section says nothing.
const MOSTLY_IN_FRONT: f64 = 0.4;
/// A mesh from elsewhere is taken as it is when its largest piece has this share of the area.
const ONE_PIECE: f64 = 0.9;
/// Points that stand for the pieces of a mesh.
const SAMPLE: usize = 800_000;

/// Which method makes the surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    #[default]
    /// `section`, or `poisson` where much of the surface hides behind itself and that method's surface can be opened.
    Auto,
    /// Depth over the unrolled mean section: tunnels, drifts, sewers, shafts.
    Section,
    /// Screened Poisson surface, trimmed by its points: caves, junctions, deep overhangs.
    Poisson,
}

/// How the surface is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// `"section"` for tunnels, drifts, sewers and shafts, `"poisson"` to keep what hides behind itself. `"auto"` takes
    /// `section` and, where more than 5 % of the rays from the axis meet the surface more than once, `poisson` if its
    /// surface can be opened with few cuts; the report tells why.
    pub method: Method,
    /// Distance between neighbouring vertices in metres; by default about one vertex for 1.5 points, but not finer than
    /// 1/600 of the tunnel's perimeter.
    pub spacing_m: Option<f64>,
    /// Surface farther than this from the nearest point is not observed, metres (profile scans: this is the limit
    /// around the section; along the axis the distance between profiles is bridged). Where points lie farther apart, the
    /// report tells the reach that was used.
    pub max_gap_m: f64,
    /// Holes narrower than this are filled and marked as filled, metres; 0 fills none.
    pub fill_hole_m: f64,
    /// The wall behind ducts, cables and other furniture is filled and marked where its shadow is narrower than this,
    /// metres; 0 leaves holes. Only the section method knows where the wall goes on.
    pub fill_behind_furniture_m: f64,
    /// Side drifts, niches and rooms that open into the wall: `"hole"` leaves a hole with the wall line as its rim, `"close"`
    /// continues the wall over it, however wide, and marks that as filled, `"keep"` keeps what was seen of it.
    pub side_openings: SideOpenings,
    /// Thins the mesh: `{ faces = N }` down to a number of faces, `{ deviation_m = X }` as far as the surface moves no
    /// more than that. Not thinned when not given.
    pub decimate: Option<Decimate>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            method: Method::Auto,
            spacing_m: None,
            max_gap_m: 0.05,
            fill_hole_m: 0.3,
            fill_behind_furniture_m: 1.5,
            side_openings: SideOpenings::Hole,
            decimate: None,
        }
    }
}

/// What was built, for the report.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The method that was used: `section`, `poisson`, or `given` for a mesh from elsewhere.
    pub method: &'static str,
    /// Why it was chosen.
    pub reason: String,
    /// Vertices of the mesh.
    pub vertices: usize,
    /// Faces of the mesh.
    pub faces: usize,
    /// Area in square metres.
    pub area_m2: f64,
    /// Share of the area that no point supports (filled holes), percent.
    pub filled_percent: f64,
    /// All boundary loops: those that `borders` tells apart.
    pub boundary_loops: usize,
    /// The borders by what they are.
    pub borders: Borders,
    /// Side drifts, niches and rooms that open into the wall.
    pub openings: Vec<SideOpening>,
    /// Surface that nobody saw, over side openings that were closed, square metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub openings_closed_m2: Option<f64>,
    /// Numbers of the section method.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub section: Option<section::Summary>,
    /// Numbers of the poisson method.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poisson: Option<poisson::Summary>,
    /// What was thinned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub decimate: Option<decimate::Summary>,
    /// What was repaired.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repair: Option<repair::Summary>,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Why there is no mesh.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// A setting is out of range.
    #[error("mesh.{key} = {value}: {must}")]
    Setting {
        /// Name of the key.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        must: &'static str,
    },
    /// `decimate` without a limit.
    #[error("mesh.decimate needs `faces` or `deviation_m`: how far to thin")]
    NothingToDecimate,
    /// No part of the surface has enough points.
    #[error("{points} points on the tunnel's surface make no connected surface; try a larger mesh.spacing_m")]
    NoSurface {
        /// Points of the surface.
        points: usize,
    },
}

/// Builds the surface of the tunnel from its wall and floor points.
///
/// # Errors
/// [`Error::Setting`] for impossible settings, [`Error::NoSurface`] when nothing hangs together.
pub fn reconstruct(segmentation: &Segmentation, axis: &Axis, settings: &Settings) -> Result<(Mesh, Summary), Error> {
    check(settings)?;
    let options = section::Options {
        spacing_m: settings.spacing_m,
        max_gap_m: settings.max_gap_m,
        fill_hole_m: settings.fill_hole_m,
        fill_behind_furniture_m: settings.fill_behind_furniture_m,
        side_openings: settings.side_openings,
    };
    if settings.method == Method::Poisson {
        let reason = "mesh.method = \"poisson\" was set".to_owned();
        return by_poisson(segmentation, axis, settings, &options, reason);
    }
    let count = |class: Class| segmentation.class.iter().filter(|k| **k == class).count();
    let points = segmentation.class.iter().filter(|c| c.is_surface()).count();
    let (mesh, section, line) =
        section::reconstruct(segmentation, axis, &options).ok_or(Error::NoSurface { points })?;
    let share = section.multiple_depth_percent;
    let mut reason = format!("{share:.2} % of the rays from the axis meet the surface more than once");
    let front = count(Class::Furniture);
    let share_in_front = front as f64 / (points + front) as f64;
    let hides = share > MANY_DEPTHS_PERCENT || share_in_front > MOSTLY_IN_FRONT;
    if hides && settings.method == Method::Auto && !segmentation.sampling.is_profiles() {
        if share_in_front > MOSTLY_IN_FRONT {
            reason += &format!(", {:.0} % of the points stand in front of the rest", 100.0 * share_in_front);
        }
        match by_poisson(segmentation, axis, settings, &options, reason.clone()) {
            Ok((mesh, summary)) => match cannot_be_opened(&mesh, &summary, axis, segmentation) {
                None => return Ok((mesh, summary)),
                Some(why) => reason += &format!("; the surface of the poisson method {why}, so section was kept"),
            },
            Err(why) => reason += &format!("; the poisson method found none ({why})"),
        }
    }
    let mut warnings = Vec::new();
    if share > MANY_DEPTHS_PERCENT {
        warnings.push(Warning::new(
            "multiple-depths",
            format!(
                "the section method keeps one depth for each ray from the axis ({reason}); mesh.method = \"poisson\" keeps all"
            ),
        ));
    }
    if share_in_front > MOSTLY_IN_FRONT {
        warnings.push(Warning::new(
            "mostly-in-front",
            format!(
                "{:.0} % of the points stand in front of the rest and were left out: the tunnel is not understood as a \
                 section that runs along an axis; mesh.method = \"poisson\" keeps them",
                100.0 * share_in_front
            ),
        ));
    }
    let closed_m2 = closed_m2(&mesh, &line, axis, segmentation, settings);
    if !line.openings.is_empty() && settings.side_openings != SideOpenings::Keep {
        warnings.push(openings::warning(&line.openings, closed_m2));
    }
    let (mesh, thinned) = thin(mesh, settings);
    let mut summary = describe("section", reason, &mesh, axis, line.openings, warnings);
    summary.openings_closed_m2 = closed_m2;
    summary.decimate = thinned;
    summary.section = Some(section);
    Ok((mesh, summary))
}

/// Why a surface of the poisson method makes no map, if it does not: cuts through it that are longer in all than its
/// section, or borders that do not run around the axis like portals.
fn cannot_be_opened(mesh: &Mesh, summary: &Summary, axis: &Axis, segmentation: &Segmentation) -> Option<String> {
    let repair = summary.repair.as_ref()?;
    let most_m = segmentation.section.mean_perimeter();
    if repair.handles_left > 0 || repair.handle_cuts_m > most_m {
        return Some(format!(
            "has {} handles to be cut open over {:.0} m (at most {most_m:.0} m)",
            repair.handles_cut + repair.handles_left,
            repair.handle_cuts_m
        ));
    }
    let borders = topology::boundary_loops(mesh.faces(), mesh.twins());
    let around: Vec<i64> = borders
        .iter()
        .map(|border| borders::turns(axis, &border.iter().map(|&v| mesh.vertices()[v as usize]).collect::<Vec<_>>()))
        .filter(|t| *t != 0)
        .collect();
    (around.len() > 2 || around.iter().any(|t| t.abs() > 1))
        .then(|| format!("has {} borders around the axis that wind {around:?} times", around.len()))
}

/// The poisson method, cut off at the wall line and repaired.
fn by_poisson(
    segmentation: &Segmentation,
    axis: &Axis,
    settings: &Settings,
    options: &section::Options,
    reason: String,
) -> Result<(Mesh, Summary), Error> {
    let mut warnings = Vec::new();
    let count = |class: Class| segmentation.class.iter().filter(|k| **k == class).count();
    let front = count(Class::Furniture);
    let surface = segmentation.class.iter().filter(|c| c.is_surface()).count();
    let rock_in_front = front as f64 > MUCH_FURNITURE * (surface + front) as f64;
    if rock_in_front {
        warnings.push(Warning::new(
            "furniture-kept",
            format!(
                "{:.0} % of the surface points stand in front of the rest, more than furniture does: they are taken for \
                 rock and stay",
                100.0 * front as f64 / (surface + front) as f64
            ),
        ));
    }
    let poisson_options = poisson::Options {
        spacing_m: settings.spacing_m,
        max_gap_m: settings.max_gap_m,
        fill_hole_m: settings.fill_hole_m,
        perimeter_m: segmentation.section.mean_perimeter(),
    };
    let compressed = poisson::Compressed::for_profiles(&segmentation.sampling, axis, &poisson_options);
    let place = |c: &AxisCoordinates| compressed.as_ref().map_or_else(|| axis.point_at(c), |k| k.place(c));
    let classified = || segmentation.coordinates.par_iter().zip(&segmentation.class);
    let line = (settings.side_openings != SideOpenings::Keep).then(|| section::wall_line(segmentation, axis, options));
    let is_open = |c: &AxisCoordinates| line.as_ref().is_some_and(|l| l.is_open(c, &segmentation.section));
    let closes = settings.side_openings == SideOpenings::Close;
    let mut points: Vec<Vec3> = classified()
        .filter(|(_, k)| k.is_surface() || (rock_in_front && **k == Class::Furniture))
        .filter(|(c, _)| !(closes && is_open(c)))
        .map(|(c, _)| place(c))
        .collect();
    let mut walls: Vec<Vec3> = classified().filter(|(_, k)| **k != Class::Noise).map(|(c, _)| place(c)).collect();
    if let Some(line) = line.as_ref().filter(|_| closes) {
        // The wall line stands in for what was seen behind it, so that the surface runs on over the mouth.
        let drawn: Vec<Vec3> = line.places_over_openings(&segmentation.section).iter().map(place).collect();
        walls.extend(&drawn);
        points.extend(drawn);
    }
    let (mut raw, mut poisson) = match &compressed {
        Some(k) => {
            let options = poisson::Options { spacing_m: Some(k.cell_m), ..poisson_options };
            poisson::reconstruct(points, &walls, &k.straight, &options)
        }
        None => poisson::reconstruct(points, &walls, axis, &poisson_options),
    };
    drop(walls);
    if let Some(k) = &compressed {
        raw.vertices.par_iter_mut().for_each(|v| *v = k.point(v));
        poisson.spacing_along_m = Some(k.cell_along_m());
        warnings.push(Warning::new(
            "poisson-of-profiles",
            format!(
                "the scan is made of profiles: along the axis cells are {:.2} m long and gaps up to that length are bridged; \
                 mesh.method = \"section\" suits such scans better",
                k.cell_along_m()
            ),
        ));
    }
    warnings.extend(poisson.warning(settings.spacing_m));
    let mut surface_under_repair = repair::Repaired::of(raw.vertices, raw.faces, raw.observed);
    let over_mouth = |[a, b, c]: &[Vec3; 3]| is_open(&axis.project(&((a + b + c) / 3.0)));
    if closes {
        surface_under_repair.mark_filled(over_mouth);
    } else {
        surface_under_repair.retain(|face| !over_mouth(face));
    }
    surface_under_repair.keep_largest();
    surface_under_repair.cut_narrow();
    let (mesh, repaired) = finish(surface_under_repair, axis, settings, &mut warnings);
    if repaired.narrow_faces_dropped > 0 {
        warnings.push(Warning::new(
            "narrow-parts-dropped",
            format!(
                "{} faces of fingers and throats about a cell thick were left out, and closed where they stood",
                repaired.narrow_faces_dropped
            ),
        ));
    }
    if mesh.faces().is_empty() {
        return Err(Error::NoSurface { points: surface });
    }
    let closed_m2 = line.as_ref().and_then(|line| closed_m2(&mesh, line, axis, segmentation, settings));
    let openings = line.map_or(Vec::new(), |line| line.openings);
    if !openings.is_empty() {
        warnings.push(openings::warning(&openings, closed_m2));
    }
    let (mesh, thinned) = thin(mesh, settings);
    let mut summary = describe("poisson", reason, &mesh, axis, openings, warnings);
    summary.openings_closed_m2 = closed_m2;
    summary.decimate = thinned;
    summary.poisson = Some(poisson);
    summary.repair = Some(repaired);
    Ok((mesh, summary))
}

/// Area of the surface that closes side openings, square metres; `None` when none was to be closed.
fn closed_m2(
    mesh: &Mesh,
    line: &WallLine,
    axis: &Axis,
    segmentation: &Segmentation,
    settings: &Settings,
) -> Option<f64> {
    let closes = settings.side_openings == SideOpenings::Close && !line.openings.is_empty();
    let over_mouth = |face: FaceId| {
        let [a, b, c] = mesh.corners(face);
        line.is_open(&axis.project(&((a + b + c) / 3.0)), &segmentation.section)
    };
    let filled = || (0..mesh.faces().len() as FaceId).filter(|&f| !mesh.observed()[f as usize]);
    closes.then(|| filled().filter(|&f| over_mouth(f)).map(|f| mesh.double_area_vector(f).norm() / 2.0).sum())
}

/// One component without caps and handles, with its small holes closed.
fn finish(
    mut surface: repair::Repaired,
    axis: &Axis,
    settings: &Settings,
    warnings: &mut Vec<Warning>,
) -> (Mesh, repair::Summary) {
    surface.keep_largest();
    let caps = surface.cut_caps(axis);
    surface.cut_handles();
    if settings.fill_hole_m > 0.0 {
        surface.fill_holes(settings.fill_hole_m, |border| borders::turns(axis, border) == 0);
    }
    // A cut may have parted what only hung together over the rim of a hole.
    surface.keep_largest();
    let (mesh, summary) = surface.into_mesh();
    if !caps.is_empty() {
        let places: Vec<String> = caps.iter().map(|c| format!("{c:.1}")).collect();
        warnings.push(Warning::new(
            "caps-cut",
            format!(
                "the surface ran across the tunnel at chainage {} m (a cap of the program that made it, or a face of rock): \
                 {:.1} m2 were cut off there, because a map needs both ends open; they are not on the map",
                places.join(" and "),
                summary.caps_m2
            ),
        ));
    }
    if summary.handles_cut > 0 {
        warnings.push(Warning::new(
            "handles-cut",
            format!(
                "{} handle(s) of the surface were cut open over {:.1} m, because a flat map cannot have them: places \
                 where rock touches rock, or a way around a pillar",
                summary.handles_cut, summary.handle_cuts_m
            ),
        ));
    }
    (mesh, summary)
}

/// Thins the mesh as the settings say.
fn thin(mesh: Mesh, settings: &Settings) -> (Mesh, Option<decimate::Summary>) {
    match &settings.decimate {
        Some(target) => {
            let (mesh, summary) = decimate::decimate(mesh, target);
            (mesh, Some(summary))
        }
        None => (mesh, None),
    }
}

/// Whether a mesh from elsewhere falls into pieces that have to be made into one surface: then [`sample_faces`] and
/// [`reconstruct`] do that, else [`take_over`] repairs it as it is.
pub fn is_in_pieces(vertices: &[Vec3], faces: &[[VertexId; 3]]) -> bool {
    let mut all = repair::Repaired::given(vertices, faces, &vec![true; faces.len()]);
    let area =
        |(v, f): (&[Vec3], &[[VertexId; 3]])| -> f64 { f.iter().map(|c| area_of(c.map(|i| v[i as usize]))).sum() };
    let before = area(all.parts());
    all.keep_largest();
    area(all.parts()) < ONE_PIECE * before
}

fn area_of([a, b, c]: [Vec3; 3]) -> f64 {
    (b - a).cross(&(c - a)).norm() / 2.0
}

/// About 800,000 points spread evenly over the faces of a mesh, in the order of the faces.
pub fn sample_faces(vertices: &[Vec3], faces: &[[VertexId; 3]]) -> Vec<Vec3> {
    let corners = |f: &[VertexId; 3]| f.map(|v| vertices[v as usize]);
    let total: f64 = faces.iter().map(|f| area_of(corners(f))).sum();
    let each = total / SAMPLE as f64;
    let mut points = Vec::with_capacity(SAMPLE + 1);
    let mut owed = 0.5;
    for face in faces {
        let [a, b, c] = corners(face);
        owed += if each > 0.0 { area_of([a, b, c]) / each } else { 0.0 };
        while owed >= 1.0 {
            owed -= 1.0;
            // An additive recurrence in two dimensions covers a face evenly however many points it gets.
            let k = points.len() as f64;
            let (u, v) = ((k * 0.754_877_666_246_693).fract(), (k * 0.569_840_290_998_053).fract());
            let root = u.sqrt();
            points.push(a * (1.0 - root) + b * (root * (1.0 - v)) + c * (root * v));
        }
    }
    points
}

/// Repairs a mesh from elsewhere: equal positions merged, faces turned to one side, edges of more than two faces and
/// handles cut, the largest component kept, small holes filled and marked.
///
/// # Errors
/// [`Error::Setting`], [`Error::NoSurface`].
pub fn take_over(
    vertices: &[Vec3],
    faces: &[[VertexId; 3]],
    observed: &[bool],
    axis: &Axis,
    settings: &Settings,
) -> Result<(Mesh, Summary), Error> {
    check(settings)?;
    let surface = repair::Repaired::given(vertices, faces, observed);
    let mut warnings = Vec::new();
    let (mesh, repaired) = finish(surface, axis, settings, &mut warnings);
    if mesh.faces().is_empty() {
        return Err(Error::NoSurface { points: vertices.len() });
    }
    if repaired.faces_dropped > 0 {
        warnings.push(Warning::new(
            "components-dropped",
            format!(
                "{} smaller piece(s) of the mesh with {} faces were left out",
                repaired.components_dropped, repaired.faces_dropped
            ),
        ));
    }
    let (mesh, thinned) = thin(mesh, settings);
    let mut summary = describe("given", "the input is a mesh".to_owned(), &mesh, axis, Vec::new(), warnings);
    summary.decimate = thinned;
    summary.repair = Some(repaired);
    Ok((mesh, summary))
}

fn describe(
    method: &'static str,
    reason: String,
    mesh: &Mesh,
    axis: &Axis,
    openings: Vec<SideOpening>,
    mut warnings: Vec<Warning>,
) -> Summary {
    let area_m2 = mesh.area();
    let filled: f64 = (0..mesh.faces().len())
        .filter(|&f| !mesh.observed()[f])
        .map(|f| mesh.double_area_vector(f as u32).norm() / 2.0)
        .sum();
    let borders = Borders::of(mesh, axis, &openings);
    warnings.extend(borders.warning(axis));
    Summary {
        method,
        reason,
        vertices: mesh.vertices().len(),
        faces: mesh.faces().len(),
        area_m2,
        filled_percent: 100.0 * filled / area_m2,
        boundary_loops: borders.portals + borders.open_edges + borders.side_openings + borders.holes,
        borders,
        openings,
        openings_closed_m2: None,
        section: None,
        poisson: None,
        decimate: None,
        repair: None,
        warnings,
    }
}

fn check(settings: &Settings) -> Result<(), Error> {
    let positive = |v: f64| v.is_finite() && v > 0.0;
    match settings.spacing_m {
        Some(value) if !positive(value) => {
            return Err(Error::Setting { key: "spacing_m", value, must: "must be a positive number of metres" });
        }
        _ => {}
    }
    if !positive(settings.max_gap_m) {
        let value = settings.max_gap_m;
        return Err(Error::Setting { key: "max_gap_m", value, must: "must be a positive number of metres" });
    }
    for (key, value) in
        [("fill_hole_m", settings.fill_hole_m), ("fill_behind_furniture_m", settings.fill_behind_furniture_m)]
    {
        if !(value.is_finite() && value >= 0.0) {
            return Err(Error::Setting { key, value, must: "must be 0 or a positive number of metres" });
        }
    }
    match &settings.decimate {
        Some(Decimate { faces: None, deviation_m: None }) => Err(Error::NothingToDecimate),
        Some(Decimate { deviation_m: Some(value), .. }) if !positive(*value) => Err(Error::Setting {
            key: "decimate.deviation_m",
            value: *value,
            must: "must be a positive number of metres",
        }),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::segment::{self, classify_positions};
    use std::f64::consts::TAU;

    fn axis() -> Axis {
        Axis::through(&[Vec3::zeros(), Vec3::new(20.0, 0.0, 0.0)], 0.0).unwrap()
    }

    /// Even points on a tube of 2 m radius and 20 m length around the x axis with a side drift of 1.6 m width and 5 m
    /// depth on the left at 10 m.
    fn drift() -> Vec<Vec3> {
        let mut points: Vec<Vec3> = (0..240_000)
            .map(|i| {
                let s = 20.0 * (f64::from(i) * 0.618_033_988_749_895).fract();
                let a = TAU * (f64::from(i) * 0.754_877_666_246_693).fract() - std::f64::consts::PI;
                Vec3::new(s, -2.0 * a.sin(), 2.0 * a.cos())
            })
            .filter(|p| !(p.y > 0.0 && (p.x - 10.0).hypot(p.z) < 0.8))
            .collect();
        points.extend((0..25_000).map(|i| {
            let y = 1.8 + 5.0 * (f64::from(i) * 0.618_033_988_749_895).fract();
            let (sin, cos) = (TAU * (f64::from(i) * 0.754_877_666_246_693).fract()).sin_cos();
            Vec3::new(10.0 + 0.8 * cos, y, 0.8 * sin)
        }));
        points
    }

    #[test]
    fn a_side_drift_is_cut_off_at_the_wall_line_and_told() {
        let (segmentation, _) = classify_positions(&drift(), &axis(), &segment::Settings::default()).unwrap();
        for method in [Method::Section, Method::Poisson] {
            let (mesh, summary) =
                reconstruct(&segmentation, &axis(), &Settings { method, ..Settings::default() }).unwrap();
            assert_eq!(summary.openings.len(), 1, "{method:?} {:?}", summary.openings);
            let opening = &summary.openings[0];
            assert!((opening.chainage_m - 10.0).abs() < 0.2 && opening.side == crate::axis::Side::Left);
            assert!((opening.width_m[0] - 1.6).abs() < 0.4 && (opening.seen_depth_m - 4.7).abs() < 0.6, "{opening:?}");
            assert!((Vec3::from(opening.ends_in_local[1]) - Vec3::new(10.0, 6.6, 0.0)).norm() < 0.5);
            assert!(mesh.vertices().iter().all(|v| v.y.hypot(v.z) < 2.35), "{method:?}: nothing behind the wall line");
            // The poisson method may leave a sliver of the rim open besides.
            let most = if method == Method::Section { 3 } else { 5 };
            assert!((3..=most).contains(&summary.boundary_loops), "{method:?}: {}", summary.boundary_loops);
            assert!(summary.warnings.iter().any(|w| w.code == "side-openings"));
        }
    }

    #[test]
    fn a_closed_side_drift_is_wall_that_nobody_saw() {
        let (segmentation, _) = classify_positions(&drift(), &axis(), &segment::Settings::default()).unwrap();
        for method in [Method::Section, Method::Poisson] {
            let settings = Settings { method, side_openings: SideOpenings::Close, ..Settings::default() };
            let (mesh, summary) = reconstruct(&segmentation, &axis(), &settings).unwrap();
            let borders = &summary.borders;
            assert_eq!((borders.portals, borders.side_openings, borders.holes), (2, 0, 0), "{method:?} {borders:?}");
            assert_eq!(summary.openings.len(), 1);
            let mut filled_m2 = 0.0;
            for f in 0..mesh.faces().len() {
                let [a, b, c] = mesh.corners(f as u32);
                let m = (a + b + c) / 3.0;
                let from_middle = (m.x - 10.0).hypot(m.z);
                if m.y > 0.0 && from_middle < 0.55 {
                    assert!(!mesh.observed()[f], "{method:?}: {m} was not seen");
                    assert!((m.y.hypot(m.z) - 2.0).abs() < 0.08, "{method:?}: {m} is off the wall line");
                    filled_m2 += mesh.double_area_vector(f as u32).norm() / 2.0;
                }
            }
            let told = summary.openings_closed_m2.unwrap();
            // The mouth is 1.6 m wide, and its rim counts as wall where a cheek is not far behind it.
            assert!(
                filled_m2 > 0.85 && (filled_m2..2.8).contains(&told),
                "{method:?}: {told}, {filled_m2} well inside"
            );
            let warning = summary.warnings.iter().find(|w| w.code == "side-openings").unwrap();
            assert!(warning.message.contains(&format!("{told:.1} m2 of wall that nobody saw")), "{}", warning.message);
        }
    }

    #[test]
    fn the_method_follows_what_hides_and_whether_it_can_be_opened() {
        // A boulder of 1.1 m on the floor that holds three times the points of the walls.
        let mut points = drift();
        points.retain(|p| p.y < 2.1);
        let count = 3 * points.len();
        points.extend((0..count).map(|i| {
            let z = 1.0 - 2.0 * (i as f64 + 0.5) / count as f64;
            let (sin, cos) = (2.399_963_229_728_653 * i as f64).sin_cos();
            let r = (1.0 - z * z).sqrt();
            Vec3::new(10.0, 0.0, -1.0) + Vec3::new(r * cos, r * sin, z) * 1.1
        }));
        let (segmentation, _) = classify_positions(&points, &axis(), &segment::Settings::default()).unwrap();
        let with = |method| reconstruct(&segmentation, &axis(), &Settings { method, ..Settings::default() }).unwrap();
        let (_, set) = with(Method::Section);
        assert_eq!(set.method, "section");
        let (mesh, mut summary) = with(Method::Auto);
        assert_eq!(summary.method, "poisson", "{}", summary.reason);
        assert!(summary.reason.contains("stand in front"), "{}", summary.reason);
        assert_eq!(cannot_be_opened(&mesh, &summary, &axis(), &segmentation), None);
        summary.repair.as_mut().unwrap().handle_cuts_m = 100.0;
        assert!(cannot_be_opened(&mesh, &summary, &axis(), &segmentation).unwrap().contains("100 m"));
        let (plain, _) = classify_positions(&drift(), &axis(), &segment::Settings::default()).unwrap();
        assert_eq!(reconstruct(&plain, &axis(), &Settings::default()).unwrap().1.method, "section");
    }

    #[test]
    fn profiles_half_a_metre_apart_make_one_poisson_surface() {
        // 41 profiles of 1200 points each: 1 cm around, 50 cm along.
        let points: Vec<Vec3> = (0..41 * 1200)
            .map(|i| {
                let a = TAU * (f64::from(i % 1200) + 0.31 * f64::from(i / 1200)) / 1200.0;
                Vec3::new(0.5 * f64::from(i / 1200), -2.0 * a.sin(), 2.0 * a.cos())
            })
            .collect();
        let (segmentation, _) = classify_positions(&points, &axis(), &segment::Settings::default()).unwrap();
        let settings = Settings { method: Method::Poisson, ..Settings::default() };
        let (mesh, summary) = reconstruct(&segmentation, &axis(), &settings).unwrap();
        assert_eq!(summary.boundary_loops, 2);
        assert!(summary.filled_percent < 0.1, "{}", summary.filled_percent);
        assert!(mesh.vertices().iter().all(|v| (v.y.hypot(v.z) - 2.0).abs() < 0.006));
        let covered = summary.area_m2 / (TAU * 2.0 * 20.0);
        assert!((0.96..1.04).contains(&covered), "{covered}");
        assert!(summary.warnings.iter().any(|w| w.code == "poisson-of-profiles"), "{:?}", summary.warnings);
        assert!(summary.poisson.unwrap().spacing_along_m.unwrap() > 0.3);
    }

    #[test]
    fn a_mesh_in_pieces_is_told_from_one_in_one_piece() {
        let tube = |shift: f64| -> (Vec<Vec3>, Vec<[u32; 3]>) {
            let vertices = (0..21 * 24)
                .map(|k: u32| {
                    let (sin, cos) = (TAU * f64::from(k % 24) / 24.0).sin_cos();
                    Vec3::new(f64::from(k / 24) + shift, 2.0 * cos, 2.0 * sin)
                })
                .collect();
            let faces = (0..20 * 24u32)
                .flat_map(|k| {
                    let (i, j) = (k / 24, k % 24);
                    let (a, b) = (i * 24 + j, i * 24 + (j + 1) % 24);
                    [[a, a + 24, b + 24], [a, b + 24, b]]
                })
                .collect();
            (vertices, faces)
        };
        let (mut vertices, mut faces) = tube(0.0);
        assert!(!is_in_pieces(&vertices, &faces));
        let points = sample_faces(&vertices, &faces);
        assert!((points.len() as i64 - SAMPLE as i64).abs() <= 1);
        assert!(points.iter().all(|p| (1.98..=2.0).contains(&p.y.hypot(p.z))));
        let axis = axis();
        let (mesh, summary) =
            take_over(&vertices, &faces, &vec![true; faces.len()], &axis, &Settings::default()).unwrap();
        assert_eq!((mesh.faces().len(), summary.boundary_loops), (faces.len(), 2));
        let (more, corners) = tube(30.0);
        let shift = vertices.len() as u32;
        vertices.extend(more);
        faces.extend(corners.iter().map(|f| f.map(|v| v + shift)));
        assert!(is_in_pieces(&vertices, &faces));
    }

    #[test]
    fn impossible_settings_are_refused() {
        let (segmentation, _) = classify_positions(&drift(), &axis(), &segment::Settings::default()).unwrap();
        let wrong = Settings { max_gap_m: 0.0, ..Settings::default() };
        assert!(matches!(reconstruct(&segmentation, &axis(), &wrong), Err(Error::Setting { key: "max_gap_m", .. })));
    }
}
