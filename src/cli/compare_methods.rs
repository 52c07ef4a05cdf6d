//! `adit compare-methods`: flattens one mesh with every method and puts the figures and the maps side by side.
//!
//! Every method runs in a process of its own (`adit unwrap`), so that time and memory are its own and a method that fails
//! leaves the others alone.

use super::{Console, Exit, Failure, Result};
use crate::io::ply;
use crate::map::{Ramp, stroke_font};
use crate::numeric::Vec2;
use crate::unwrap::{Method, distortion};
use anyhow::Context;
use serde_json::Value;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use tiny_skia::{Color, FillRule, Paint, PathBuilder, Pixmap, Transform};

const EXAMPLES: &str = "\
Examples:
  adit compare-methods tunnel.ply --out comparison
  adit compare-methods runs/today/mesh.ply --methods section,lscm,arap,relax --out comparison
  adit compare-methods tunnel.ply --axis axis.csv --keep-maps --out comparison";

/// Arguments of `adit compare-methods`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The mesh (PLY, OBJ, OFF ...), a tunnel tube or already cut open.
    #[arg(value_name = "MESH")]
    mesh: PathBuf,
    /// The folder for `comparison.csv`, `.json`, `.md` and `.png`. Made if missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The methods, separated by commas. All when not given.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    methods: Vec<String>,
    /// The tunnel axis as CSV; traced when not given.
    #[arg(long, value_name = "AXIS.csv")]
    axis: Option<PathBuf>,
    /// Keep each method's map as `METHOD.ply`.
    #[arg(long)]
    keep_maps: bool,
}

/// One column of the table: heading, place in the report of `adit unwrap --json`, decimals.
const COLUMNS: [(&str, &str, usize); 18] = [
    ("seconds", "/seconds/flatten", 1),
    ("peak_memory_mib", "/peak_memory_mib", 0),
    ("flipped_faces", "/flipped_faces", 0),
    ("overlaps", "/overlaps", 0),
    ("stretch_mean", "/stretch/mean", 4),
    ("stretch_p95", "/stretch/p95", 4),
    ("stretch_max", "/stretch/max", 2),
    ("area_p05", "/area_ratio/p05", 3),
    ("area_p95", "/area_ratio/p95", 3),
    ("anisotropy_mean", "/anisotropy/mean", 4),
    ("sander_l2", "/sander_l2", 4),
    ("symmetric_dirichlet", "/symmetric_dirichlet", 5),
    ("smoothed_stretch_mean", "/smoothed/stretch/mean", 4),
    ("chainage_rms_m", "/readability/chainage_rms_m", 3),
    ("bearing_rms_deg", "/readability/bearing_rms_deg", 2),
    ("girth_rms_m", "/readability/girth_rms_m", 3),
    ("iterations", "/solve/iterations", 0),
    ("converged", "/solve/converged", 0),
];

/// Runs all methods and writes the comparison.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let methods: Vec<&'static str> = if arguments.methods.is_empty() {
        Method::NAMES.to_vec()
    } else {
        let known = |name: &String| {
            Method::named(name).map(|m| m.name()).ok_or_else(|| {
                Failure::message(
                    Exit::Usage,
                    format!("there is no method '{name}'; there are {}", Method::NAMES.join(", ")),
                )
            })
        };
        arguments.methods.iter().map(known).collect::<std::result::Result<_, _>>()?
    };
    let resources = |e: anyhow::Error| Failure { exit: Exit::Resources, error: e };
    let out = &arguments.out;
    std::fs::create_dir_all(out).with_context(|| format!("cannot make {}", out.display())).map_err(resources)?;
    let mut rows: Vec<(&str, std::result::Result<Value, String>)> = Vec::new();
    for method in methods {
        console.say(&format!("{method} ..."));
        rows.push((method, run_one(method, &arguments).map_err(resources)?));
    }
    if rows.iter().all(|(_, row)| row.is_err()) {
        let why = rows.iter().find_map(|(_, row)| row.as_ref().err()).cloned().unwrap_or_default();
        return Err(Failure::message(
            Exit::BadInput,
            format!("no method flattened {}: {why}", arguments.mesh.display()),
        ));
    }
    let write = |name: &str, bytes: &[u8]| {
        let path = out.join(name);
        std::fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display())).map_err(resources)
    };
    write("comparison.csv", csv(&rows).as_bytes())?;
    write("comparison.md", markdown(&rows).as_bytes())?;
    let json: Value = rows
        .iter()
        .map(|(method, row)| {
            let value = row.clone().unwrap_or_else(|why| serde_json::json!({ "failed": why }));
            ((*method).to_owned(), value)
        })
        .collect::<serde_json::Map<String, Value>>()
        .into();
    write("comparison.json", format!("{json:#}\n").as_bytes())?;
    let picture = picture(&rows, out).map_err(resources)?;
    write("comparison.png", &picture)?;
    if !arguments.keep_maps {
        for (method, row) in &rows {
            if row.is_ok() {
                let map = out.join(format!("{method}.ply"));
                std::fs::remove_file(&map)
                    .with_context(|| format!("cannot remove {}", map.display()))
                    .map_err(resources)?;
            }
        }
    }
    console.print(&markdown(&rows));
    Ok(Exit::Done)
}

/// The report of one method, or why it failed.
fn run_one(method: &str, arguments: &Arguments) -> anyhow::Result<std::result::Result<Value, String>> {
    let program = std::env::current_exe().context("cannot find the running program")?;
    let mut command = Command::new(program);
    command.arg("unwrap").arg(&arguments.mesh).args(["--method", method, "--json", "--quiet", "--place-by-axis"]);
    command.arg("--out").arg(arguments.out.join(format!("{method}.ply")));
    if let Some(axis) = &arguments.axis {
        command.arg("--axis").arg(axis);
    }
    let output = command.output().context("cannot start a second adit")?;
    if !output.status.success() {
        let text = String::from_utf8_lossy(&output.stderr);
        return Ok(Err(text.lines().last().unwrap_or("no message").trim_start_matches("error: ").to_owned()));
    }
    Ok(Ok(serde_json::from_slice(&output.stdout).context("adit unwrap --json gave no JSON")?))
}

fn cell(row: &Value, (_, place, decimals): &(&str, &str, usize)) -> String {
    match row.pointer(place) {
        Some(Value::Number(n)) => format!("{:.*}", decimals, n.as_f64().unwrap_or(f64::NAN)),
        Some(Value::Bool(yes)) => if *yes { "yes" } else { "no" }.to_owned(),
        _ => String::new(),
    }
}

fn csv(rows: &[(&str, std::result::Result<Value, String>)]) -> String {
    let mut text = String::from("method");
    COLUMNS.iter().for_each(|(name, ..)| text.extend([",", name]));
    text.push_str(",failed\n");
    for (method, row) in rows {
        text.push_str(method);
        for column in &COLUMNS {
            text.push(',');
            text += &row.as_ref().map(|r| cell(r, column)).unwrap_or_default();
        }
        let why = row.as_ref().err().map(|why| format!("\"{}\"", why.replace('"', "'"))).unwrap_or_default();
        let _ = writeln!(text, ",{why}");
    }
    text
}

fn markdown(rows: &[(&str, std::result::Result<Value, String>)]) -> String {
    // The table reads best with one row a figure and one column a method.
    let mut text = String::from("| |");
    rows.iter().for_each(|(method, _)| text += &format!(" {method} |"));
    text.push_str("\n|---|");
    rows.iter().for_each(|_| text.push_str("---|"));
    text.push('\n');
    for column in &COLUMNS {
        text += &format!("| {} |", column.0.replace('_', " "));
        for (_, row) in rows {
            text += &format!(" {} |", row.as_ref().map_or_else(|_| "failed".to_owned(), |r| cell(r, column)));
        }
        text.push('\n');
    }
    for (method, row) in rows {
        if let Err(why) = row {
            text += &format!("\n`{method}` failed: {why}\n");
        }
    }
    text
}

/// Width of the picture, pixels.
const WIDTH: u32 = 1600;
/// Height of the caption above each map, pixels.
const CAPTION: f32 = 34.0;
/// The stretch that is drawn in the last colour of the ramp.
const DARKEST_STRETCH: f64 = 1.15;

/// All maps under each other at one scale, coloured by stretch, as PNG.
fn picture(rows: &[(&str, std::result::Result<Value, String>)], folder: &Path) -> anyhow::Result<Vec<u8>> {
    let mut maps = Vec::new();
    for (method, row) in rows {
        if let Ok(report) = row {
            let (mesh, _) = ply::read_chart(&folder.join(format!("{method}.ply")))?;
            let uv = mesh.uv.unwrap_or_default();
            let low = uv.iter().fold(Vec2::repeat(f64::INFINITY), |a, p| a.inf(p));
            let high = uv.iter().fold(Vec2::repeat(f64::NEG_INFINITY), |a, p| a.sup(p));
            maps.push((*method, report, mesh.vertices, mesh.faces, uv, low, high));
        }
    }
    let widest = maps.iter().map(|m| m.6.x - m.5.x).fold(1e-9, f64::max);
    let margin = 20.0;
    let scale = (f64::from(WIDTH) - 2.0 * margin) / widest;
    // A map that sprawls gets no more room than two tunnels' lengths.
    let height_of = |low: &Vec2, high: &Vec2| ((high.y - low.y) * scale).min(2.0 * f64::from(WIDTH));
    let total: f64 = maps.iter().map(|m| height_of(&m.5, &m.6) + f64::from(CAPTION) + margin).sum();
    let mut canvas = Pixmap::new(WIDTH, total.ceil().max(1.0) as u32).context("the picture is too large")?;
    canvas.fill(Color::WHITE);
    let mut top = 0.0;
    for (method, report, vertices, faces, uv, low, high) in &maps {
        let figure = |place: &str| report.pointer(place).and_then(Value::as_f64).unwrap_or(f64::NAN);
        let caption = format!(
            "{method}   stretch mean {:.4}, 95 % {:.4}   bearing {:.1} deg   flips {:.0}   {:.1} s",
            figure("/stretch/mean"),
            figure("/stretch/p95"),
            figure("/readability/bearing_rms_deg"),
            figure("/flipped_faces"),
            figure("/seconds/flatten"),
        );
        let style = stroke_font::TextStyle {
            cap_px: 14.0,
            align: stroke_font::Align::Start,
            color: [0, 0, 0, 255],
            upwards: false,
        };
        stroke_font::draw_text(&mut canvas.as_mut(), &caption, Vec2::new(margin, top + 26.0), &style);
        top += f64::from(CAPTION);
        let height = height_of(low, high);
        let on_page =
            |p: Vec2| ((margin + (p.x - low.x) * scale) as f32, (top + height - (p.y - low.y) * scale) as f32);
        for corners in faces {
            let in_chart = corners.map(|v| uv[v as usize]);
            let on_surface = corners.map(|v| vertices[v as usize]);
            let Some(j) = distortion::jacobian(on_surface, in_chart) else { continue };
            let (s1, s2) = crate::numeric::svd2x2::signed_singular_values(&j);
            let color = if s2 <= 0.0 {
                // Flipped faces are told in a colour that the ramp does not have.
                [255, 0, 255]
            } else {
                Ramp::Heat.color((s1.max(1.0 / s2) - 1.0) / (DARKEST_STRETCH - 1.0))
            };
            let mut path = PathBuilder::new();
            let [a, b, c] = in_chart.map(on_page);
            path.move_to(a.0, a.1);
            path.line_to(b.0, b.1);
            path.line_to(c.0, c.1);
            path.close();
            let mut paint = Paint::default();
            paint.set_color_rgba8(color[0], color[1], color[2], 255);
            paint.anti_alias = false;
            if let Some(path) = path.finish() {
                canvas.fill_path(&path, &paint, FillRule::Winding, Transform::identity(), None);
            }
        }
        top += height + margin;
    }
    canvas.encode_png().context("cannot encode the picture")
}
