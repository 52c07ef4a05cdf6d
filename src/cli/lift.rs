//! `adit lift`: an edited picture of the map becomes labels on the points and faces of the scan.

use super::run_surface::{RunSurface, cannot_write, io_failure, need};
use super::{Console, Exit, Failure, Result};
use crate::io::picture::{PictureFile, read_picture};
use crate::io::{self, LabelsFile, PointColumns, world_file};
use crate::lift::{self, Base, Edited, LabelMap, NO_SURFACE};
use crate::map::{self, PaletteEntry, Placement};
use crate::mesh::anchor;
use crate::numeric::Vec2;
use crate::unwrap;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  adit lift runs/drift --labels edited.png --out lifted.laz
  adit lift runs/drift --labels edited.jpg --out lifted.laz --faces face_labels.csv

Paint on map/labels.png, color.png, intensity.png or relief.png of the run with full, opaque colours: those of
map/labels.json, or new ones, which become new classes. Resized pictures, palettes and JPEG are fine; a cropped picture
needs its world file. What is transparent on the wall was erased.";

/// Arguments of `adit lift`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The run folder that the map came from.
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
    /// The edited picture (PNG, JPEG or TIFF).
    #[arg(long, value_name = "EDITED")]
    labels: PathBuf,
    /// Where the points go (.laz, .las or .ply): all records as they were, plus label, chainage, girth and offset.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Also write what was recognised as a picture like map/labels.png, with a world file, to be checked by eye.
    #[arg(long, value_name = "FILE.png")]
    recognised: Option<PathBuf>,
    /// Also write the label of each face of chart.ply as CSV.
    #[arg(long, value_name = "FILE")]
    faces: Option<PathBuf>,
}

/// Lifts the labels.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let (label_map, mut told, classes) = read_label_map(&arguments)?;
    if let Some(path) = &arguments.recognised {
        let picture = picture_of(&label_map, &classes);
        io::write_picture(path, &picture, Some(label_map.placement.step_u))
            .map_err(|e| Failure::new(Exit::Resources, e))?;
        world_file::write(path, &label_map.placement).map_err(|e| Failure::new(Exit::Resources, e))?;
    }

    let surface = RunSurface::open(&arguments.run)?;
    let points = ["points.laz", "points.ply"].map(|name| arguments.run.join(name)).into_iter().find(|p| p.is_file());
    let Some(points) = points else {
        let message = format!("{} has no points.laz: lift needs a finished run of a scan", arguments.run.display());
        return Err(Failure::message(Exit::BadInput, message));
    };
    // The labels in the file are replaced, so which column holds them does not matter; its unit does.
    let ingest =
        io::Settings { unit: surface.pipeline.ingest.unit, label_column: Some("none".into()), ..Default::default() };
    let (cloud, _) = io::read_cloud(&[points], &ingest).map_err(io_failure)?;

    // Both files keep scan coordinates, each in a local frame of its own.
    let RunSurface { pipeline, chart, .. } = surface.in_frame(cloud.frame())?;
    let (mut anchors, _) = anchor::anchor_points(chart.strip().mesh(), cloud.positions(), &pipeline.anchor);
    anchors.release(&unwrap::covered_points(&unwrap::ChartIndex::of(&chart), &anchors));
    let uv = anchors.in_chart(chart.strip().mesh(), chart.uv());
    let limit = pipeline.map.max_offset_m.unwrap_or_else(|| map::automatic_max_offset_m(anchors.offsets()));
    let lifted = lift::labels_of_points(&label_map, &uv, anchors.offsets(), limit).map_err(lift_failure)?;
    let faces = lift::labels_of_faces(&label_map, &chart);

    let columns = PointColumns {
        labels: &lifted.labels,
        chainage: &uv.iter().map(|p| p.x).collect::<Vec<_>>(),
        girth: &uv.iter().map(|p| p.y).collect::<Vec<_>>(),
        offset: anchors.offsets(),
        surface_classes: None,
    };
    let partial = partial_name(&arguments.out);
    let written = io::write_points(&cloud, &columns, &partial).map_err(io_failure);
    if written.is_err() {
        fs::remove_file(&partial).ok();
    }
    written?;
    fs::rename(&partial, &arguments.out).map_err(|e| cannot_write(&arguments.out, e))?;
    if let Some(path) = &arguments.faces {
        let mut text = String::from("face,label\n");
        for (face, label) in faces.labels.iter().enumerate() {
            let _ = writeln!(text, "{face},{label}");
        }
        fs::write(path, text).map_err(|e| cannot_write(path, e))?;
    }

    for entry in &classes {
        let count = |counts: &std::collections::BTreeMap<u32, usize>| counts.get(&entry.value).copied().unwrap_or(0);
        let (points, faces) = (count(&lifted.counts), count(&faces.counts));
        if points + faces > 0 {
            let _ = writeln!(told, "{:>6}  {:<20} {points:>10} points {faces:>9} faces", entry.value, entry.name);
        }
    }
    let _ = write!(
        told,
        "{} points off the surface (more than {limit:.2} m) and {} beside the map have no label\nwrote {}",
        lifted.off_surface,
        lifted.outside,
        arguments.out.display()
    );
    if !console.is_quiet() {
        console.print(&told);
    }
    Ok(Exit::Done)
}

/// The classes on the map, what was seen, and the classes' names.
fn read_label_map(arguments: &Arguments) -> Result<(LabelMap, String, Vec<PaletteEntry>)> {
    let folder = arguments.run.join("map");
    let json = need(&arguments.run, "map/labels.json")?;
    let text = fs::read_to_string(&json).map_err(|e| Failure::new(Exit::BadInput, e))?;
    let file: LabelsFile = serde_json::from_str(&text)
        .map_err(|e| Failure::message(Exit::BadInput, format!("{}: {e}", json.display())))?;
    let placement = file.picture_placement();
    let bad = |e: crate::io::picture::Error| Failure::new(Exit::BadInput, e);
    let read = read_picture(&arguments.labels).map_err(bad)?;
    let world = world_file::read(&arguments.labels).map_err(|e| Failure::new(Exit::BadInput, e))?;
    if let Some(values) = read.values {
        return values_map(&read.picture, values, world, &file, &arguments.labels);
    }
    let PictureFile { picture, lossy, .. } = read;
    let edited = Edited { picture, placement: world, lossy };
    let base = |name: &str| -> Result<Option<Base>> {
        let path = folder.join(format!("{name}.png"));
        if !path.is_file() {
            return Ok(None);
        }
        Ok(Some(Base { name: name.into(), picture: read_picture(&path).map_err(bad)?.picture }))
    };
    let Some(labels) = base("labels")? else {
        let message = format!("{} has no map/labels.png", arguments.run.display());
        return Err(Failure::message(Exit::BadInput, message));
    };
    let mut bases = vec![labels];
    let mut found = lift::recognise(&edited, &bases, placement, &file.classes);
    if matches!(found, Err(lift::Error::NoBase { .. })) {
        // Not the label map: one of the other pictures.
        for name in ["color", "intensity", "relief", "offset", "coverage", "distortion"] {
            bases.extend(base(name)?);
        }
        found = lift::recognise(&edited, &bases, placement, &file.classes);
    }
    let found = found.map_err(|e| {
        let message = anyhow::Error::from(e).context(arguments.labels.display().to_string());
        Failure::new(Exit::BadInput, message)
    })?;
    let mut told = format!(
        "{} is map/{}.png with {} painted pixels, {} of them smoothed",
        arguments.labels.display(),
        found.base,
        found.painted_px,
        found.smoothed_px
    );
    if found.erased_px > 0 {
        let _ = write!(told, "; {} erased ones are unlabelled now", found.erased_px);
    }
    if found.ambiguous_px > 0 {
        let _ = write!(told, "; {} between the classes were left as they were", found.ambiguous_px);
    }
    if found.undecided_px > 0 {
        let _ = write!(
            told,
            "; {} painted pixels of the map could be either of two classes and are unlabelled",
            found.undecided_px
        );
    }
    for [lost, instead] in &found.lost_classes {
        let _ = write!(
            told,
            "\nthe palette of the picture has no colour for {lost}: what was painted with it looks like {instead} and is taken for it; \
             save with full colours"
        );
    }
    for entry in found.classes.iter().filter(|e| found.new_classes.contains(&e.value)) {
        let [r, g, b] = entry.color;
        let _ = write!(told, "\nnew class {} for the colour #{r:02x}{g:02x}{b:02x}", entry.value);
    }
    told.push('\n');
    Ok((found.map, told, found.classes))
}

/// The classes on a picture of the map of a run, for other subcommands.
pub(super) fn label_map_of(run: PathBuf, labels: PathBuf) -> Result<(LabelMap, String, Vec<PaletteEntry>)> {
    read_label_map(&Arguments { run, labels, out: PathBuf::new(), faces: None, recognised: None })
}

/// A grey TIFF holds the labels themselves; its greatest number stands for "no surface".
fn values_map(
    picture: &map::Picture,
    values: Vec<u32>,
    world: Option<Placement>,
    file: &LabelsFile,
    path: &Path,
) -> Result<(LabelMap, String, Vec<PaletteEntry>)> {
    let (width, height) = (picture.width, picture.height);
    let corner = Vec2::new(file.u_min_m, file.v_max_m);
    let half = file.cell_m / 2.0;
    let placement = world.unwrap_or(Placement {
        first_centre: corner + Vec2::new(half, -half),
        step_u: file.cell_m,
        step_v: -file.cell_m,
    });
    let greatest = values.iter().copied().max().unwrap_or(0);
    let none = if greatest > 255 { u32::from(u16::MAX) } else { u32::from(u8::MAX) };
    let labels: Vec<u32> = values.into_iter().map(|v| if v == none { NO_SURFACE } else { v }).collect();
    let classes = map::palette(labels.iter().copied().filter(|&l| l != NO_SURFACE));
    let told = format!("{} holds labels as numbers\n", path.display());
    Ok((LabelMap { width, height, placement, labels }, told, classes))
}

/// The classes in their colours, transparent where there is no surface.
fn picture_of(label_map: &LabelMap, classes: &[PaletteEntry]) -> map::Picture {
    let color = |label: &u32| match classes.iter().find(|c| c.value == *label) {
        _ if *label == NO_SURFACE => [0; 4],
        Some(PaletteEntry { color: [r, g, b], .. }) => [*r, *g, *b, 255],
        None => {
            let [r, g, b] = map::label_color(*label);
            [r, g, b, 255]
        }
    };
    let rgba = label_map.labels.iter().flat_map(color).collect();
    map::Picture { width: label_map.width, height: label_map.height, rgba }
}

/// The extension tells the format, so it stays at the end.
fn partial_name(path: &Path) -> PathBuf {
    let mut name = std::ffi::OsString::from(".partial-");
    name.push(path.file_name().unwrap_or_default());
    path.with_file_name(name)
}

fn lift_failure(error: lift::Error) -> Failure {
    Failure::new(Exit::Internal, error)
}
