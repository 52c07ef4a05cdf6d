//! The map and what it tells along the tunnel.

use super::error::Error;
use super::line::{Line, section};
use super::picture;
use super::products::{PlacedPoints, Surface, cannot_write, write_text};
use super::profile::{self, Columns};
use super::settings::Pipeline;
use crate::axis::{Axis, AxisCoordinates};
use crate::linework::{self, FlattenSettings};
use crate::mesh::{Mesh, anchor};
use crate::unwrap::{self, Chart};
use crate::{io, map};
use rayon::prelude::*;
use serde_json::json;
use std::cell::OnceCell;
use std::path::Path;

/// Draws all layers and the overview into the folder `map` of the staging folder.
pub(super) fn draw_map(
    pipeline: &Pipeline,
    input: &map::DrawInput,
    lines: &[map::ReferenceLine],
    staging: &Path,
) -> Result<((), serde_json::Value), Error> {
    let folder = staging.join("map");
    std::fs::create_dir(&folder).map_err(cannot_write("map", &folder))?;
    let mut sink = io::MapFolder::new(&folder).with_tiles(pipeline.map.tiles);
    let points = map::MapPoints::of(input, &pipeline.map).map_err(Error::in_stage("map"))?;
    let summary = map::draw_points(input, &points, &pipeline.map, &mut sink).map_err(Error::in_stage("map"))?;
    let text = serde_json::to_string(lines).expect("lines are plain data");
    write_text("map", &folder.join("lines.json"), &format!("{text}\n"))?;
    let mesh = input.chart.strip().mesh();
    // Neither keeps two threads busy all the time.
    let (picture, certificate) = rayon::join(
        || -> Result<(), Error> {
            let picture =
                map::overview(input, &points, &pipeline.map, &summary, lines).map_err(Error::in_stage("map"))?;
            io::write_picture(&folder.join("map.png"), &picture, None)
                .map_err(|error| Error::in_stage("map")(map::Error::Sink(Box::new(error))))
        },
        || {
            let (index, anchoring) =
                rayon::join(|| unwrap::ChartIndex::of(input.chart), || anchor::Anchoring::of(mesh));
            let settings = FlattenSettings { anchor: pipeline.anchor.clone(), ..FlattenSettings::default() };
            linework::certify(&index, &anchoring, summary.cell_m, &settings)
        },
    );
    picture?;
    let faces = unwrap::distortion::of_faces(mesh, input.chart.uv());
    write_text("map", &folder.join("distortion_histogram.svg"), &map::distortion_histogram(&faces))?;
    let mut told = section(&summary);
    told["roundtrip"] = json!(certificate);
    Ok(((), told))
}

/// What the map shows of the place of the surface around the axis.
pub(super) struct AroundTheAxis {
    /// Distance of each vertex from the local mean section, metres, positive into the void.
    pub section_offsets_m: Vec<f64>,
    /// Distance of each vertex from the design profile, if one is given, metres, positive inside it.
    pub design_offsets_m: Option<Vec<f64>>,
    /// The lines of the section on the chart; a shaft has neither crown nor springlines.
    pub lines: Vec<map::ReferenceLine>,
}

pub(super) fn around_the_axis(
    pipeline: &Pipeline,
    chart: &Chart,
    coordinates: &[AxisCoordinates],
    axis: &Axis,
    surface: &Surface,
) -> Result<AroundTheAxis, Error> {
    let offset = |c: &AxisCoordinates| surface.section.radius(c.chainage, c.angle()) - c.radius();
    let design_offsets_m = match &pipeline.map.design_profile {
        None => None,
        Some(path) => {
            let text = std::fs::read_to_string(path)
                .map_err(|source| Error::in_stage("map")(io::Error::Read { path: path.clone(), source }))?;
            let profile = map::DesignProfile::parse(&text).map_err(|e| Error::in_stage("map")(map::Error::from(e)))?;
            Some(coordinates.par_iter().map(|c| profile.offset(c)).collect())
        }
    };
    let lines = if axis.is_shaft() {
        vec![]
    } else {
        map::reference_lines(chart, coordinates, &surface.section, &surface.feet)
    };
    Ok(AroundTheAxis { section_offsets_m: coordinates.par_iter().map(offset).collect(), design_offsets_m, lines })
}

/// Axis coordinates of the vertices, computed once for all who need them.
pub(super) fn vertex_coordinates<'c>(
    once: &'c OnceCell<Vec<AxisCoordinates>>,
    mesh: &Mesh,
    axis: &Axis,
) -> &'c [AxisCoordinates] {
    once.get_or_init(|| mesh.vertices().par_iter().map(|p| axis.project(p)).collect())
}

/// What the map is like along the tunnel, from the finished products.
pub(super) fn told_along(
    pipeline: &Pipeline,
    line: &Line,
    chart: &Chart,
    coordinates: &[AxisCoordinates],
    surface: &Surface,
    placed: Option<&PlacedPoints>,
) -> ((), serde_json::Value) {
    let input = profile::Input {
        chart,
        coordinates,
        section: &surface.section,
        points: placed.map(|p| (p.uv.as_slice(), p.offsets_m.as_slice())),
        coverage: coverage_columns(&line.folder().path().join("map/coverage.png")),
    };
    ((), section(&profile::profile(&input, &pipeline.profile)))
}

/// Counts of the columns of the coverage picture; `None` when the map has none.
fn coverage_columns(path: &Path) -> Option<Columns> {
    let world = std::fs::read_to_string(path.with_extension("pgw")).ok()?;
    let numbers: Vec<f64> = world.lines().map(|l| l.trim().parse().ok()).collect::<Option<_>>()?;
    let (width_m, first_m) = (*numbers.first()?, *numbers.get(4)?);
    let counts = picture::column_counts(path, map::OBSERVED_COLOR)?;
    Some(Columns { start_m: first_m - width_m / 2.0, width_m, counts })
}
