//! From a mesh to a map of its surface; it enters at `cut`, its vertices stand for the points where some are needed.

use super::draw::{around_the_axis, draw_map, told_along, vertex_coordinates};
use super::error::Error;
use super::find_axis::{axis_csv, find_axis, tell_ends};
use super::flatten::{flatten, open_surface};
use super::line::{Line, done};
use super::products::{Surface, write_ply, write_text};
use super::settings::Pipeline;
use super::stages::Stamps;
use crate::axis::{Axis, AxisCoordinates};
use crate::segment::{self, SectionField};
use crate::{io, map, mesh};
use rayon::prelude::*;
use serde_json::json;
use std::cell::OnceCell;

/// From a mesh to everything.
pub(super) fn run_mesh<'a>(pipeline: &'a Pipeline, stamps: &'a Stamps, line: &'a Line<'a>) -> Result<(), Error> {
    let coordinates = OnceCell::new();
    let raw = line.passing("ingest", |_| {
        if pipeline.ingest.chainage_m.is_some() {
            return Err(Error::in_stage("ingest")(io::Error::Settings {
                key: "ingest.chainage_m",
                cause: "a mesh is taken as a whole".into(),
                remedy: "leave it out, or name the scan instead of the mesh".into(),
            }));
        }
        let read = done("ingest", io::read_mesh(&pipeline.input[0]))?;
        stamps.check()?;
        Ok(read)
    });
    let axis = line.product("axis", |staging| {
        let raw = raw.get()?;
        // Vertices are where a modeller needed them; an axis wants the surface evenly covered.
        let points = mesh::sample_faces(&raw.vertices, &raw.faces);
        let result = find_axis(pipeline, &points, &raw.frame, line.folder().path())?;
        write_text("axis", &staging.join("axis.csv"), &axis_csv(&result.0, &raw.frame))?;
        Ok(result)
    });
    let surface = line.product("mesh", |staging| {
        let (raw, axis) = (raw.get()?, axis.get()?);
        let axis: &Axis = &axis;
        let (mesh, mut summary, section) = if mesh::is_in_pieces(&raw.vertices, &raw.faces) {
            // No piece is the tunnel: the surface is made anew from points on all of them.
            let points = mesh::sample_faces(&raw.vertices, &raw.faces);
            let (segmentation, _) =
                segment::classify_positions(&points, axis, &pipeline.segment).map_err(Error::in_stage("mesh"))?;
            let (mesh, mut summary) = done("mesh", mesh::reconstruct(&segmentation, axis, &pipeline.mesh))?;
            summary["made_from"] = json!(format!("{} points on the pieces of the mesh", points.len()));
            (mesh, summary, segmentation.section)
        } else {
            let observed = raw.observed.clone().unwrap_or_else(|| vec![true; raw.faces.len()]);
            let taken = mesh::take_over(&raw.vertices, &raw.faces, &observed, axis, &pipeline.mesh);
            let (mesh, summary) = done("mesh", taken)?;
            let coordinates: Vec<AxisCoordinates> = mesh.vertices().par_iter().map(|p| axis.project(p)).collect();
            let section = SectionField::estimate(&coordinates, 0.0)
                .map_err(|error| Error::in_stage("mesh")(segment::Error::from(error)))?;
            (mesh, summary, section)
        };
        write_ply("mesh", &staging.join("mesh.ply"), &raw.frame, &mesh, None, None)?;
        tell_ends(&mut summary, &raw.frame);
        Ok((Surface { mesh, section, feet: vec![], floor: None, points: None }, summary))
    });
    let strip = line.passing("cut", |_| open_surface(pipeline, &*surface.get()?, &*axis.get()?));
    let chart =
        line.product("unwrap", |staging| flatten(pipeline, strip.take()?, &*axis.get()?, &raw.get()?.frame, staging));
    let map = line.passing("map", |staging| {
        let (chart, surface, axis) = (chart.get()?, surface.get()?, axis.get()?);
        let places = vertex_coordinates(&coordinates, chart.strip().mesh(), &axis);
        let around = around_the_axis(pipeline, &chart, places, &axis, &surface)?;
        let frame = raw.get()?.frame.clone();
        let input = map::DrawInput {
            chart: &chart,
            points: None,
            frame: &frame,
            section_offsets_m: Some(&around.section_offsets_m),
            design_offsets_m: around.design_offsets_m.as_deref(),
            quality: None,
        };
        draw_map(pipeline, &input, &around.lines, staging)
    });
    let profile = line.passing("profile", |_| {
        map.ensure()?;
        let (chart, axis, surface) = (chart.get()?, axis.get()?, surface.get()?);
        Ok(told_along(
            pipeline,
            line,
            &chart,
            vertex_coordinates(&coordinates, chart.strip().mesh(), &axis),
            &surface,
            None,
        ))
    });
    axis.ensure()?;
    surface.ensure()?;
    chart.ensure()?;
    map.ensure()?;
    profile.ensure()
}
