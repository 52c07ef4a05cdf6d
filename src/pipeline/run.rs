//! The straight line from scan to map.

use super::checkpoint::{self, Checkpoint};
use super::error::Error;
use super::explain::{self, Explanation};
use super::judge::Previous;
use super::limits::Status;
use super::line::{self, Line, Observer, Plan, Stage, done, section};
use super::picture;
use super::plan_view::plan_view;
use super::preflight::Need;
use super::profile::{self, Columns};
use super::report;
use super::run_folder::{RunFolder, sha256_of, sha256_of_all};
use super::settings::Pipeline;
use crate::axis::{self, Axis, AxisCoordinates};
use crate::clean::{DROPPED, GeometryCloud};
use crate::cloud::{Cloud, ScanFrame};
use crate::io::ply::{PlyMesh, write_mesh};
use crate::linework::{self, FlattenSettings};
use crate::mesh::anchor;
use crate::mesh::{self, Mesh};
use crate::normals::{self, OrientedCloud, Viewpoints};
use crate::numeric::{Vec2, Vec3};
use crate::segment::{self, Class, Floor, Quality, SectionField, Segmentation, VertexQuality};
use crate::unwrap::{self, Chart};
use crate::warning::Warning;
use crate::{clean, cut, io, map};
use rayon::prelude::*;
use serde_json::json;
use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// The stages in their order. Raise a version when the stage gives other results for the same input.
pub const STAGES: &[Stage] = &[
    Stage { name: "ingest", version: 1, needs: &[] },
    Stage { name: "clean", version: 2, needs: &["ingest"] },
    Stage { name: "axis", version: 4, needs: &["clean"] },
    Stage { name: "normals", version: 3, needs: &["ingest", "clean", "axis"] },
    Stage { name: "segment", version: 6, needs: &["ingest", "clean", "axis"] },
    Stage { name: "mesh", version: 6, needs: &["segment", "normals", "axis"] },
    Stage { name: "cut", version: 2, needs: &["mesh", "axis"] },
    Stage { name: "unwrap", version: 4, needs: &["cut", "axis"] },
    Stage { name: "anchor", version: 4, needs: &["unwrap", "ingest"] },
    Stage { name: "map", version: 4, needs: &["anchor", "unwrap", "mesh", "ingest"] },
    Stage { name: "points", version: 2, needs: &["anchor", "mesh", "ingest"] },
    Stage { name: "profile", version: 1, needs: &["map", "anchor", "unwrap", "mesh", "axis"] },
];

/// The stages of a run that starts from a mesh.
pub const MESH_STAGES: &[Stage] = &[
    Stage { name: "ingest", version: 1, needs: &[] },
    Stage { name: "axis", version: 4, needs: &["ingest"] },
    Stage { name: "mesh", version: 7, needs: &["ingest", "axis"] },
    Stage { name: "cut", version: 2, needs: &["mesh", "axis"] },
    Stage { name: "unwrap", version: 4, needs: &["cut", "axis"] },
    Stage { name: "map", version: 3, needs: &["unwrap", "mesh", "ingest"] },
    Stage { name: "profile", version: 1, needs: &["map", "unwrap", "mesh", "axis"] },
];

/// Distance between the lines of `axis.csv`, metres.
const AXIS_CSV_STEP_M: f64 = 0.5;

/// How a run ended.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The verdict of the limits.
    pub status: Status,
    /// The report, as in `report.json`.
    pub report: serde_json::Value,
    /// Whether anything had to be done.
    pub worked: bool,
}

/// The surface, the mean section that it deviates from, and what the points told about both.
struct Surface {
    mesh: Mesh,
    section: SectionField,
    /// Where the walls meet the floor; empty without a floor.
    feet: Vec<map::Feet>,
    floor: Option<Floor>,
    /// `None` when the run started from a mesh.
    points: Option<SurfacePoints>,
}

/// What the points of a scan told about the surface.
struct SurfacePoints {
    quality: Quality,
    /// The class of each scan point.
    class_of_point: Vec<u8>,
}

/// What a run is allowed and asked to do besides what its pipeline says. None of it changes a product.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// What to do again although it is there.
    pub redo: Redo,
    /// Memory that the run may need, bytes; without it, what the system has free.
    pub memory_bytes: Option<u64>,
    /// Folder on a fast disk for checkpoints and products that are being written; without it, the run folder.
    pub tmp: Option<PathBuf>,
    /// Run folder of the last accepted run of the same tunnel, for the limits of drift.
    pub compare_with: Option<PathBuf>,
    /// Hash that the input must have ([`super::run_folder::sha256_of_all`]), where it was taken for what it was before.
    pub expect_sha256: Option<String>,
}

/// What to do again although it is there.
#[derive(Clone, Debug, Default)]
pub struct Redo {
    /// Everything.
    pub all: bool,
    /// These stages.
    pub stages: Vec<String>,
    /// This stage and all after it.
    pub from: Option<String>,
}

impl Redo {
    fn includes(&self, stage: &str, stages: &[Stage]) -> bool {
        let position = |name: &str| stages.iter().position(|s| s.name == name);
        let after = self.from.as_deref().and_then(position).zip(position(stage)).is_some_and(|(from, at)| at >= from);
        self.all || after || self.stages.iter().any(|s| s == stage)
    }

    fn check(&self, stages: &[Stage]) -> Result<(), Error> {
        match self.stages.iter().chain(&self.from).find(|name| stages.iter().all(|s| s.name != **name)) {
            Some(unknown) => Err(Error::NoStage {
                name: unknown.clone(),
                stages: stages.iter().map(|s| s.name).collect::<Vec<_>>().join(", "),
            }),
            None => Ok(()),
        }
    }
}

/// What a rerun in the folder would do with each stage, and why.
///
/// # Errors
/// As [`run`], for the pipeline and its input.
pub fn explain(pipeline: &Pipeline, out: &Path) -> Result<Vec<Explanation>, Error> {
    Ok(explain::explain(&prepare(pipeline)?.plans, out))
}

/// A run that is known to be possible: which stages, from which files, under which keys.
struct Prepared {
    from_mesh: bool,
    stages: &'static [Stage],
    input_hashes: Vec<String>,
    stamps: Stamps,
    plans: Vec<Plan>,
}

/// Length and time of the inputs from before they were hashed: tells whether somebody writes to them meanwhile.
struct Stamps(Vec<(PathBuf, Option<(u64, SystemTime)>)>);

impl Stamps {
    fn of(files: &[PathBuf]) -> Self {
        Self(files.iter().map(|f| (f.clone(), stamp(f))).collect())
    }

    /// Refuses files that are not what they were.
    fn check(&self) -> Result<(), Error> {
        match self.0.iter().find(|(file, before)| stamp(file) != *before) {
            Some((path, _)) => Err(Error::InputChanged { path: path.clone() }),
            None => Ok(()),
        }
    }
}

fn stamp(file: &Path) -> Option<(u64, SystemTime)> {
    let found = std::fs::metadata(file).ok()?;
    Some((found.len(), found.modified().ok()?))
}

fn prepare(pipeline: &Pipeline) -> Result<Prepared, Error> {
    if pipeline.input.is_empty() {
        return Err(Error::NoInput);
    }
    let stamps = Stamps::of(&pipeline.input);
    let input_hashes = hash_inputs(&pipeline.input)?;
    let alignment_hash = hash_inputs(pipeline.axis.alignment.as_slice())?;
    let poses_hash = hash_inputs(pipeline.ingest.poses.as_slice())?;
    let handles_file = pipeline.unwrap.method.handles_file();
    let handles_hash = hash_inputs(handles_file.map(std::slice::from_ref).unwrap_or_default())?;
    let profile_hash = hash_inputs(pipeline.map.design_profile.as_slice())?;
    let from_mesh = is_mesh(&pipeline.input)?;
    let stages = if from_mesh { MESH_STAGES } else { STAGES };
    let plans = line::plan(
        stages,
        |stage| pipeline.settings_of(stage),
        |stage| match stage {
            "ingest" => {
                let poses = poses_hash.iter().map(|h| ("poses".to_owned(), h.clone()));
                let files = input_hashes.iter().enumerate().map(|(i, h)| (format!("file {i}"), h.clone()));
                // A stretch of chainages means what the axis makes of it.
                let stretch = pipeline.ingest.chainage_m.into_iter().flat_map(|_| {
                    let settings = ("axis".to_owned(), pipeline.settings_of("axis").to_string());
                    alignment_hash.iter().map(|h| ("alignment".to_owned(), h.clone())).chain([settings])
                });
                files.chain(poses).chain(stretch).collect()
            }
            "axis" => alignment_hash.iter().map(|h| ("alignment".to_owned(), h.clone())).collect(),
            "unwrap" => handles_hash.iter().map(|h| ("handles".to_owned(), h.clone())).collect(),
            "map" => profile_hash.iter().map(|h| ("design profile".to_owned(), h.clone())).collect(),
            _ => BTreeMap::new(),
        },
    );
    Ok(Prepared { from_mesh, stages, input_hashes, stamps, plans })
}

/// Runs the pipeline in a run folder, doing only what is not there yet.
///
/// # Errors
/// [`Error`] with the stage that refused. The folder then holds the products of the stages before it.
pub fn run(pipeline: &Pipeline, out: &Path, options: &Options, observer: &dyn Observer) -> Result<Outcome, Error> {
    let prepared = prepare(pipeline)?;
    options.redo.check(prepared.stages)?;
    if options.expect_sha256.as_ref().is_some_and(|expected| *expected != sha256_of_all(&prepared.input_hashes)) {
        return Err(Error::InputChanged { path: pipeline.input[0].clone() });
    }
    let folder = RunFolder::open_with_scratch(out, options.tmp.as_deref())?;
    folder.refuse_inputs_inside(&pipeline.input, &["points.laz", "points.ply", "mesh.ply", "chart.ply"])?;
    if let Some(stage) = folder.interrupted() {
        observer.resumed(stage);
    }
    let result = run_in(&folder, pipeline, prepared, options, observer);
    if let Err(error) = &result {
        // The error itself is what counts; a full disk may be the reason for both.
        let _ = folder.note("run-failed", json!({ "error": error.to_string() }));
    }
    result
}

fn run_in(
    folder: &RunFolder,
    pipeline: &Pipeline,
    prepared: Prepared,
    options: &Options,
    observer: &dyn Observer,
) -> Result<Outcome, Error> {
    let Prepared { from_mesh, stages, input_hashes, stamps, plans } = prepared;
    for stage in stages.iter().filter(|s| options.redo.includes(s.name, stages)) {
        folder.forget(stage.name)?;
    }
    let line = Line::new(folder, observer, plans);
    for stage in stages.iter().filter(|s| line.is_fresh(s.name)) {
        observer.finished(stage.name, 0.0, true);
    }
    if stages.iter().any(|s| !line.is_fresh(s.name)) {
        match Need::of(&pipeline.input, pipeline) {
            Ok(need) => need.check(options.memory_bytes, folder.path())?,
            Err(error) if pipeline.ingest.allow_truncated => {
                let message = format!("memory and disk are not estimated, because {error}");
                observer.warned("ingest", &Warning::new("no-estimate", message));
            }
            Err(error) => return Err(error),
        }
        folder.note("run-begun", json!({ "adit_version": env!("CARGO_PKG_VERSION"), "input": pipeline.input }))?;
    }
    if from_mesh {
        run_mesh(pipeline, &stamps, &line)?;
    } else {
        run_scan(pipeline, &stamps, &line, Until::End)?;
    }
    let previous = options.compare_with.as_deref().map(Previous::read);
    let outcome = report::finish(pipeline, &line, folder, &input_hashes, previous)?;
    if outcome.worked {
        folder.note("run-finished", json!({ "status": outcome.status }))?;
    }
    Ok(outcome)
}

/// Runs the pipeline of a scan in a run folder as far as the surface: afterwards the folder holds `mesh.ply` and
/// `axis.csv`.
///
/// # Errors
/// As [`run`].
pub fn run_to_surface(pipeline: &Pipeline, out: &Path, observer: &dyn Observer) -> Result<(), Error> {
    let Prepared { plans, stamps, .. } = prepare(pipeline)?;
    let folder = RunFolder::open(out)?;
    folder.refuse_inputs_inside(&pipeline.input, &["mesh.ply"])?;
    run_scan(pipeline, &stamps, &Line::new(&folder, observer, plans), Until::Surface)
}

/// How far a run goes.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Until {
    Surface,
    End,
}

/// From a scan to everything.
fn run_scan<'a>(pipeline: &'a Pipeline, stamps: &'a Stamps, line: &'a Line<'a>, until: Until) -> Result<(), Error> {
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
    let chart = line.product("unwrap", |staging| {
        let axis = axis.get()?;
        let handles = read_handles(pipeline, cloud.get()?.frame())?;
        let (chart, summary) =
            done("unwrap", unwrap::flatten_with_handles(strip.take()?, Some(&axis), &handles, &pipeline.unwrap))?;
        write_ply(
            "unwrap",
            &staging.join("chart.ply"),
            cloud.get()?.frame(),
            chart.strip().mesh(),
            Some(chart.uv()),
            None,
        )?;
        Ok((chart, summary))
    });
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

/// From a mesh to a map of its surface; it enters at `cut`, its vertices stand for the points where some are needed.
fn run_mesh<'a>(pipeline: &'a Pipeline, stamps: &'a Stamps, line: &'a Line<'a>) -> Result<(), Error> {
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
    let chart = line.product("unwrap", |staging| {
        let axis = axis.get()?;
        let handles = read_handles(pipeline, &raw.get()?.frame)?;
        let (chart, summary) =
            done("unwrap", unwrap::flatten_with_handles(strip.take()?, Some(&axis), &handles, &pipeline.unwrap))?;
        write_ply(
            "unwrap",
            &staging.join("chart.ply"),
            &raw.get()?.frame,
            chart.strip().mesh(),
            Some(chart.uv()),
            None,
        )?;
        Ok((chart, summary))
    });
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

/// The surface cut open, without its floor if that is wished.
fn open_surface(pipeline: &Pipeline, surface: &Surface, axis: &Axis) -> Result<(cut::Strip, serde_json::Value), Error> {
    let mesh = surface.mesh.clone();
    if pipeline.cut.floor == cut::FloorChoice::Keep {
        return done("cut", cut::open(mesh, axis, &pipeline.cut));
    }
    let Some(floor) = &surface.floor else {
        let message = "cut.floor = \"remove\", but no level floor was found: nothing is removed";
        let (strip, mut summary) = done("cut", cut::open(mesh, axis, &pipeline.cut))?;
        if let Some(warnings) = summary["warnings"].as_array_mut() {
            warnings.push(json!(Warning::new("no-floor", message)));
        }
        return Ok((strip, summary));
    };
    let (mesh, removed) = cut::without_floor(mesh, axis, &surface.section, floor).map_err(Error::in_stage("cut"))?;
    let (strip, mut summary) = done("cut", cut::open(mesh, axis, &pipeline.cut))?;
    summary["floor"] = json!(removed);
    Ok((strip, summary))
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

/// Traces the axis, or reads the alignment that the settings name.
fn find_axis(
    pipeline: &Pipeline,
    points: &[Vec3],
    frame: &ScanFrame,
    out: &Path,
) -> Result<(Axis, serde_json::Value), Error> {
    let settings = pipeline.axis.in_local(frame);
    let picture = out.join(REFUSED_PICTURE);
    // What an earlier, refused run left must not be taken for this one's.
    match std::fs::remove_file(&picture) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            return Err(cannot_write("axis", &picture)(error));
        }
        _ => {}
    }
    match &settings.alignment {
        Some(path) => done("axis", axis::import_csv(&read_alignment("axis", path)?, frame, &settings)),
        None => {
            let traced = axis::trace(points, &settings);
            let no_tunnel = matches!(traced, Err(axis::Error::NotATunnel { .. } | axis::Error::ClosedLoop { .. }));
            let result = done("axis", traced);
            match (result, no_tunnel.then(|| plan_view(points)).flatten()) {
                (Err(error), Some(seen)) => {
                    io::write_picture(&picture, &seen, None)
                        .map_err(|error| Error::in_stage("axis")(map::Error::Sink(Box::new(error))))?;
                    Err(Error::Pictured { error: Box::new(error), picture })
                }
                (result, _) => result,
            }
        }
    }
}

fn read_alignment(stage: &'static str, path: &Path) -> Result<String, Error> {
    std::fs::read_to_string(path)
        .map_err(|source| Error::in_stage(stage)(io::Error::Read { path: path.to_owned(), source }))
}

/// The part of the scan that `ingest.chainage_m` asks for; the axis must be known before the scan is.
pub(super) fn part_of(pipeline: &Pipeline) -> Result<Option<io::Part>, Error> {
    let Some(chainage_m) = pipeline.ingest.chainage_m else { return Ok(None) };
    let in_ingest = Error::in_stage("ingest");
    let Some(path) = &pipeline.axis.alignment else {
        return Err(in_ingest(io::Error::Settings {
            key: "ingest.chainage_m",
            cause: "chainages are those of an axis that is known before the scan is read".into(),
            remedy: "set axis.alignment too; the axis.csv of an earlier run will do".into(),
        }));
    };
    let frame = ScanFrame {
        metres_per_unit: pipeline.ingest.unit.map_or(1.0, io::Unit::metres),
        ..ScanFrame::with_origin(Vec3::zeros())
    };
    let text = read_alignment("ingest", path)?;
    let (axis, _) =
        axis::import_csv(&text, &frame, &pipeline.axis.in_local(&frame)).map_err(Error::in_stage("ingest"))?;
    io::Part::along(axis, frame, chainage_m).map(Some).map_err(Error::in_stage("ingest"))
}

/// A picture of what was seen when the axis is refused, in the run folder.
const REFUSED_PICTURE: &str = "refused_plan.png";

/// Adds to each side opening the `axis_ends` that make it a run of its own: its `ends_in_local` in scan coordinates.
fn tell_ends(summary: &mut serde_json::Value, frame: &ScanFrame) {
    for opening in summary["openings"].as_array_mut().into_iter().flatten() {
        let local: Option<[[f64; 3]; 2]> = serde_json::from_value(opening["ends_in_local"].clone()).ok();
        if let Some(ends) = local {
            let millimetres = |p: [f64; 3]| p.map(|c| (c * 1000.0).round() / 1000.0);
            opening["axis_ends"] = json!(ends.map(|p| millimetres(frame.scan_from_local(&p.into()).into())));
        }
    }
}

/// The handles of the file that the settings of the unwrap method name; none when they name none.
fn read_handles(pipeline: &Pipeline, frame: &ScanFrame) -> Result<Vec<unwrap::Handle>, Error> {
    let Some(path) = pipeline.unwrap.method.handles_file() else { return Ok(Vec::new()) };
    let text = std::fs::read_to_string(path)
        .map_err(|source| Error::in_stage("unwrap")(io::Error::Read { path: path.clone(), source }))?;
    unwrap::handles::import_csv(&text, &path.display().to_string(), frame).map_err(Error::in_stage("unwrap"))
}

/// Draws all layers and the overview into the folder `map` of the staging folder.
fn draw_map(
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

/// Whether the input is a mesh. Several files, one of them a mesh, make no sense together.
///
/// # Errors
/// [`Error::SeveralMeshes`].
pub fn is_mesh(inputs: &[PathBuf]) -> Result<bool, Error> {
    let extension = |p: &PathBuf| p.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let meshes = inputs.iter().filter(|path| match extension(path).as_str() {
        "obj" | "off" | "stl" | "glb" => true,
        "ply" => ply_has_faces(path),
        _ => false,
    });
    match (meshes.count(), inputs.len()) {
        (0, _) => Ok(false),
        (1, 1) => Ok(true),
        (meshes, files) => Err(Error::SeveralMeshes { meshes, files }),
    }
}

/// Whether the header of a PLY file announces faces. A file that does not read is left to the reader to complain about.
fn ply_has_faces(path: &Path) -> bool {
    let mut start = Vec::new();
    let read = std::fs::File::open(path).and_then(|f| f.take(65_536).read_to_end(&mut start));
    let text = String::from_utf8_lossy(&start);
    let count = |line: &str| line.trim().strip_prefix("element face")?.trim().parse::<u64>().ok();
    read.is_ok() && text.lines().take_while(|l| l.trim() != "end_header").filter_map(count).any(|n| n > 0)
}

/// Where the points of the scan lie on the map.
struct PlacedPoints {
    /// Chainage and girth; NaN without a place.
    uv: Vec<Vec2>,
    /// Distance from the surface, metres.
    offsets_m: Vec<f64>,
}

impl Checkpoint for PlacedPoints {
    fn save(&self, columns: &mut checkpoint::Writer) {
        self.uv.save(columns);
        columns.put("offsets", &self.offsets_m);
    }

    fn load(columns: &checkpoint::Reader) -> Result<Self, checkpoint::Error> {
        Ok(Self { uv: Checkpoint::load(columns)?, offsets_m: columns.get("offsets")? })
    }
}

impl Checkpoint for Surface {
    fn save(&self, columns: &mut checkpoint::Writer) {
        self.mesh.save(columns);
        self.section.save(columns);
        columns.put("feet", &self.feet);
        columns.put("has floor and points", &[[u8::from(self.floor.is_some()), u8::from(self.points.is_some())]]);
        if let Some(floor) = &self.floor {
            floor.save(columns);
        }
        if let Some(points) = &self.points {
            points.quality.save(columns);
            columns.put("class of point", &points.class_of_point);
        }
    }

    fn load(columns: &checkpoint::Reader) -> Result<Self, checkpoint::Error> {
        let [has_floor, has_points] = columns.one::<[u8; 2]>("has floor and points")?;
        let points = || -> Result<SurfacePoints, checkpoint::Error> {
            Ok(SurfacePoints { quality: Quality::load(columns)?, class_of_point: columns.get("class of point")? })
        };
        Ok(Self {
            mesh: Mesh::load(columns)?,
            section: SectionField::load(columns)?,
            feet: columns.get("feet")?,
            floor: (has_floor != 0).then(|| Floor::load(columns)).transpose()?,
            points: (has_points != 0).then(points).transpose()?,
        })
    }
}

impl Checkpoint for Chart {
    fn save(&self, columns: &mut checkpoint::Writer) {
        self.strip().mesh().save(columns);
        self.uv().to_vec().save(columns);
    }

    fn load(columns: &checkpoint::Reader) -> Result<Self, checkpoint::Error> {
        let strip = cut::Strip::load(columns)?;
        Chart::new(strip, Checkpoint::load(columns)?).map_err(|e| columns.damaged(e))
    }
}

/// What a person should know about points below another sheet of the map.
fn covered_warning(covered: usize) -> Vec<Warning> {
    let message = format!(
        "{covered} points lie where the border of the map folds over another part of it: they have no place on the map"
    );
    if covered == 0 { Vec::new() } else { vec![Warning::new("covered_points", message)] }
}

/// Hashes of the input files; a file that cannot be read is bad input, told by its name.
fn hash_inputs(files: &[PathBuf]) -> Result<Vec<String>, Error> {
    let hash = |path: &PathBuf| {
        sha256_of(path).map_err(|error| match error {
            super::run_folder::Error::Io { path, source, .. } => {
                Error::in_stage("ingest")(io::Error::Read { path, source })
            }
            other => other.into(),
        })
    };
    files.iter().map(hash).collect()
}

/// Name of the file with all points: PLY stays PLY, everything else becomes LAZ.
fn points_file(inputs: &[PathBuf]) -> &'static str {
    let is_ply = |p: &PathBuf| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"));
    if inputs.iter().all(is_ply) { "points.ply" } else { "points.laz" }
}

/// What the map is like along the tunnel, from the finished products.
fn told_along(
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

/// Axis coordinates of the vertices, computed once for all who need them.
fn vertex_coordinates<'c>(once: &'c OnceCell<Vec<AxisCoordinates>>, mesh: &Mesh, axis: &Axis) -> &'c [AxisCoordinates] {
    once.get_or_init(|| mesh.vertices().par_iter().map(|p| axis.project(p)).collect())
}

/// What the map shows of the place of the surface around the axis.
struct AroundTheAxis {
    /// Distance of each vertex from the local mean section, metres, positive into the void.
    section_offsets_m: Vec<f64>,
    /// Distance of each vertex from the design profile, if one is given, metres, positive inside it.
    design_offsets_m: Option<Vec<f64>>,
    /// The lines of the section on the chart; a shaft has neither crown nor springlines.
    lines: Vec<map::ReferenceLine>,
}

fn around_the_axis(
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

/// The axis as `axis.csv`, scan coordinates.
pub fn axis_csv(axis: &Axis, frame: &ScanFrame) -> String {
    let mut text = String::from("chainage_m,x,y,z,azimuth_deg,gradient_percent\n");
    let steps = (axis.length() / AXIS_CSV_STEP_M).floor() as usize;
    let mut chainages: Vec<f64> = (0..=steps).map(|i| axis.start_chainage() + i as f64 * AXIS_CSV_STEP_M).collect();
    if axis.end_chainage() - chainages[steps] > 1e-6 {
        chainages.push(axis.end_chainage());
    }
    for s in chainages {
        let p = frame.scan_from_local(&axis.frame_at(s).origin);
        let (azimuth, gradient) = (axis.azimuth_deg(s), axis.gradient_percent(s));
        text += &format!("{s:.4},{:.4},{:.4},{:.4},{azimuth:.4},{gradient:.4}\n", p.x, p.y, p.z);
    }
    text
}

fn write_text(stage: &'static str, path: &Path, text: &str) -> Result<(), Error> {
    std::fs::write(path, text).map_err(cannot_write(stage, path))
}

fn write_ply(
    stage: &'static str,
    path: &Path,
    frame: &ScanFrame,
    mesh: &Mesh,
    uv: Option<&[Vec2]>,
    quality: Option<&VertexQuality>,
) -> Result<(), Error> {
    let observed = mesh.observed_vertices();
    let ply = PlyMesh {
        frame,
        vertices: mesh.vertices(),
        uv,
        faces: mesh.faces(),
        observed_vertices: Some(&observed),
        observed_faces: Some(mesh.observed()),
        quality,
    };
    write_mesh(&ply, path).map_err(Error::in_stage(stage))
}

fn cannot_write(stage: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    move |source| {
        Error::in_stage(stage)(super::run_folder::Error::Io { action: "write", path: path.to_owned(), source })
    }
}
