//! From a scan to everything.

use super::draw::{around_the_axis, draw_map, told_along, vertex_coordinates};
use super::error::Error;
use super::find_axis::{axis_csv, find_axis, part_of, tell_ends};
use super::flatten::{flatten, open_surface};
use super::line::{Line, done, section};
use super::products::{PlacedPoints, Surface, SurfacePoints, write_ply, write_text};
use super::settings::Pipeline;
use super::stages::Stamps;
use crate::axis::{Axis, AxisCoordinates};
use crate::clean::{DROPPED, GeometryCloud};
use crate::cloud::Cloud;
use crate::mesh::{self, anchor};
use crate::normals::{self, OrientedCloud, Viewpoints};
use crate::segment::{self, Class, Quality, Segmentation};
use crate::unwrap::{self, Chart};
use crate::warning::Warning;
use crate::{clean, io, map};
use rayon::prelude::*;
use serde_json::json;
use std::cell::OnceCell;
use std::path::{Path, PathBuf};

/// How far a run goes.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Until {
    Surface,
    End,
}

/// From a scan to everything.
pub(super) fn run_scan<'a>(
    pipeline: &'a Pipeline,
    stamps: &'a Stamps,
    line: &'a Line<'a>,
    until: Until,
) -> Result<(), Error> {
    let coordinates = OnceCell::new();
    let cloud = line.passing("ingest", |_| {
        let part = part_of(pipeline)?;
        let read = done("ingest", io::read_part(&pipeline.input, &pipeline.ingest, part.as_ref()))?;
        stamps.check()?;
        Ok(read)
    });
    let cleaned = line.passing("clean", |_| done("clean", clean::clean(&*cloud.get()?, &pipeline.clean)));
    let axis = line.product("axis", |staging| {
        let frame = cloud.get()?.frame().clone();
        let result = find_axis(pipeline, cleaned.get()?.positions(), &frame, line.folder().path())?;
        write_text("axis", &staging.join("axis.csv"), &axis_csv(&result.0, &frame))?;
        Ok(result)
    });
    let oriented = line.passing("normals", |_| {
        let (cloud, cleaned) = (cloud.get()?, cleaned.get()?);
        let viewpoints = Viewpoints::of(&cloud);
        done("normals", normals::estimate(&cleaned, &*axis.get()?, viewpoints, &pipeline.normals))
    });
    let segmentation = line.passing("segment", |_| {
        let (cloud, cleaned, axis) = (cloud.get()?, cleaned.get()?, axis.get()?);
        let cleaned: &GeometryCloud = &cleaned;
        let table = pipeline.segment.from_classification.table().map_err(Error::in_stage("segment"))?;
        let codes = cloud.attributes().classifications.as_deref();
        let given = |i: usize| codes.and_then(|codes| table[codes[cleaned.first_points()[i] as usize] as usize]);
        done("segment", segment::classify(cleaned.positions(), given, &axis, &pipeline.segment))
    });
    let surface = line.product("mesh", |staging| {
        let (segmentation, axis) = (segmentation.get()?, axis.get()?);
        let points = surface_points(&*cloud.get()?, &*cleaned.get()?, &*oriented.get()?, &segmentation);
        oriented.release();
        cleaned.release();
        let (mesh, mut summary) = done("mesh", mesh::reconstruct(&segmentation, &axis, &pipeline.mesh))?;
        tell_ends(&mut summary, cloud.get()?.frame());
        let axis: &Axis = &axis;
        let places: Vec<AxisCoordinates> = mesh.vertices().par_iter().map(|p| axis.project(p)).collect();
        let quality = points.quality.at(&segmentation.section, &places);
        write_ply("mesh", &staging.join("mesh.ply"), cloud.get()?.frame(), &mesh, None, Some(&quality))?;
        let feet = feet(&segmentation);
        let (section, floor) = (segmentation.section.clone(), segmentation.floor.clone());
        Ok((Surface { mesh, section, feet, floor, points: Some(points) }, summary))
    });
    if until == Until::Surface {
        axis.ensure()?;
        return surface.ensure();
    }
    let strip = line.passing("cut", |_| {
        segmentation.release();
        open_surface(pipeline, &*surface.get()?, &*axis.get()?)
    });
    let chart = line
        .product("unwrap", |staging| flatten(pipeline, strip.take()?, &*axis.get()?, cloud.get()?.frame(), staging));
    let placed = line.product("anchor", |_| {
        let (cloud, chart) = (cloud.get()?, chart.get()?);
        let chart: &Chart = &chart;
        let mesh = chart.strip().mesh();
        let (index, anchoring) = rayon::join(|| unwrap::ChartIndex::of(chart), || anchor::Anchoring::of(mesh));
        let (mut anchors, summary) = anchoring.anchor(cloud.positions(), &pipeline.anchor);
        let (covered, round_trip) =
            unwrap::covered_and_round_trip(&index, &anchors, cloud.positions(), anchoring.normals());
        anchors.release(&covered);
        let mut summary = section(&summary);
        summary["covered"] = json!(covered.len());
        summary["warnings"] = json!(covered_warning(covered.len()));
        summary["roundtrip"] = json!(round_trip);
        Ok((PlacedPoints { uv: anchors.in_chart(mesh, chart.uv()), offsets_m: anchors.offsets().to_vec() }, summary))
    });
    let map = line.passing("map", |staging| {
        let (cloud, chart, axis) = (cloud.get()?, chart.get()?, axis.get()?);
        let places = vertex_coordinates(&coordinates, chart.strip().mesh(), &axis);
        let (surface, placed) = (surface.get()?, placed.get()?);
        let scan = MappedScan { cloud: &cloud, surface: &surface, placed: &placed };
        draw_scan_map(pipeline, &scan, &chart, &axis, places, staging)
    });
    let points = line.passing("points", |staging| {
        let (cloud, placed, surface) = (cloud.get()?, placed.get()?, surface.get()?);
        write_scan_points(pipeline, &MappedScan { cloud: &cloud, surface: &surface, placed: &placed }, staging)
    });
    let profile = line.passing("profile", |_| {
        map.ensure()?;
        let (chart, axis, surface, placed) = (chart.get()?, axis.get()?, surface.get()?, placed.get()?);
        Ok(told_along(
            pipeline,
            line,
            &chart,
            vertex_coordinates(&coordinates, chart.strip().mesh(), &axis),
            &surface,
            Some(&placed),
        ))
    });
    axis.ensure()?;
    surface.ensure()?;
    chart.ensure()?;
    placed.ensure()?;
    if !line.is_fresh("points") && !line.is_fresh("map") {
        let (cloud, chart, axis) = (cloud.get()?, chart.get()?, axis.get()?);
        let places = vertex_coordinates(&coordinates, chart.strip().mesh(), &axis);
        let (surface, placed) = (surface.get()?, placed.get()?);
        let scan = MappedScan { cloud: &cloud, surface: &surface, placed: &placed };
        let (chart, axis): (&Chart, &Axis) = (&chart, &axis);
        line.side_by_side([
            ("points", &|staging| write_scan_points(pipeline, &scan, staging)),
            ("map", &|staging| draw_scan_map(pipeline, &scan, chart, axis, places, staging)),
        ])?;
    }
    points.ensure()?;
    map.ensure()?;
    profile.ensure()
}

/// A scan whose points have their places on the map.
struct MappedScan<'a> {
    cloud: &'a Cloud,
    surface: &'a Surface,
    placed: &'a PlacedPoints,
}

/// The map of a scan; `places` are the axis coordinates of the chart's vertices.
fn draw_scan_map(
    pipeline: &Pipeline,
    scan: &MappedScan,
    chart: &Chart,
    axis: &Axis,
    places: &[AxisCoordinates],
    staging: &Path,
) -> Result<((), serde_json::Value), Error> {
    let MappedScan { cloud, surface, placed } = scan;
    let around = around_the_axis(pipeline, chart, places, axis, surface)?;
    let quality = surface.points.as_ref().map(|p| p.quality.at(&surface.section, places));
    let input = map::DrawInput {
        chart,
        points: Some((cloud, map::PointsOnMap { uv: &placed.uv, offsets_m: &placed.offsets_m })),
        frame: cloud.frame(),
        section_offsets_m: Some(&around.section_offsets_m),
        design_offsets_m: around.design_offsets_m.as_deref(),
        quality: quality.as_ref(),
    };
    draw_map(pipeline, &input, &around.lines, staging)
}

/// The file with all points of a scan.
fn write_scan_points(pipeline: &Pipeline, scan: &MappedScan, staging: &Path) -> Result<((), serde_json::Value), Error> {
    let MappedScan { cloud, surface, placed } = scan;
    let labels = cloud.attributes().labels.clone().unwrap_or_else(|| vec![0; cloud.len()]);
    let (chainage, girth): (Vec<f64>, Vec<f64>) = placed.uv.iter().map(|p| (p.x, p.y)).unzip();
    let columns = io::PointColumns {
        labels: &labels,
        chainage: &chainage,
        girth: &girth,
        offset: &placed.offsets_m,
        surface_classes: surface.points.as_ref().map(|p| &p.class_of_point[..]),
    };
    let written = io::write_points(cloud, &columns, &staging.join(points_file(&pipeline.input)));
    done("points", written.map(|summary| ((), summary)))
}

/// Quality of the surface and class of each scan point.
fn surface_points(
    cloud: &Cloud,
    cleaned: &GeometryCloud,
    oriented: &OrientedCloud,
    segmentation: &Segmentation,
) -> SurfacePoints {
    let viewpoints = Viewpoints::of(cloud);
    let station = |i: usize| viewpoints.of_point(cleaned.first_points()[i] as usize);
    let class_of_point = cleaned
        .geometry_of_point()
        .par_iter()
        .map(|&g| if g == DROPPED { Class::Noise } else { segmentation.class[g as usize] } as u8)
        .collect();
    SurfacePoints { quality: Quality::of(oriented, segmentation, cleaned.counts(), station), class_of_point }
}

/// Angles of the feet of the walls, every metre.
fn feet(segmentation: &segment::Segmentation) -> Vec<map::Feet> {
    let (section, Some(floor)) = (&segmentation.section, &segmentation.floor) else { return vec![] };
    let steps = (section.end() - section.start()).ceil().max(1.0) as usize;
    let at = |i: usize| {
        let chainage = section.start() + (section.end() - section.start()) * i as f64 / steps as f64;
        let [left, right] = floor.feet(chainage).map(|girth| section.angle_of_girth(chainage, girth));
        [chainage, left, right]
    };
    (0..=steps).map(at).collect()
}

/// What a person should know about points below another sheet of the map.
fn covered_warning(covered: usize) -> Vec<Warning> {
    let message = format!(
        "{covered} points lie where the border of the map folds over another part of it: they have no place on the map"
    );
    if covered == 0 { Vec::new() } else { vec![Warning::new("covered_points", message)] }
}

/// Name of the file with all points: PLY stays PLY, everything else becomes LAZ.
fn points_file(inputs: &[PathBuf]) -> &'static str {
    let is_ply = |p: &PathBuf| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"));
    if inputs.iter().all(is_ply) { "points.ply" } else { "points.laz" }
}
