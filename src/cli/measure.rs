//! `adit measure`: a distance on the map, and the true distance on the surface under it.

use super::{Console, Exit, Failure, Result};
use crate::cut::Strip;
use crate::io::ply;
use crate::mesh::Mesh;
use crate::numeric::{Vec2, Vec3};
use crate::unwrap::{Chart, ChartIndex};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  adit measure runs/today 12.4,-3.1 15.0,2.2
  adit measure flat.ply 12.4,-3.1 15.0,2.2 16.1,2.4 --json";

/// Arguments of `adit measure`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// A run folder (its `chart.ply` is used) or a flat mesh from `adit unwrap`.
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Two or more places on the map in metres: chainage,girth.
    #[arg(value_name = "U,V", required = true, num_args = 2.., allow_hyphen_values = true)]
    places: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Places between which the way on the surface is straight, metres on the map.
const STEP_M: f64 = 0.005;

/// Measures along the straight lines between the places.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let usage = |text: String| Failure::message(Exit::Usage, text);
    let mut json = arguments.json;
    let mut places = Vec::new();
    for text in &arguments.places {
        // Places may begin with a minus, so options behind them arrive here.
        if text == "--json" {
            json = true;
            continue;
        }
        let parsed = text.split_once(',').and_then(|(u, v)| Some((u.trim().parse().ok()?, v.trim().parse().ok()?)));
        let (u, v): (f64, f64) = parsed
            .ok_or_else(|| usage(format!("'{text}' is no place on the map: expected U,V in metres, e.g. 12.4,-3.1")))?;
        places.push(Vec2::new(u, v));
    }
    if places.len() < 2 {
        return Err(usage("two places are needed".to_owned()));
    }
    let path = if arguments.run.is_dir() { arguments.run.join("chart.ply") } else { arguments.run.clone() };
    let bad = |e: anyhow::Error| Failure { exit: Exit::BadInput, error: e };
    let (raw, _) = ply::read_chart(&path).map_err(|e| Failure::new(Exit::BadInput, e))?;
    let uv = raw.uv.unwrap_or_default();
    let mesh = Mesh::all_observed(raw.vertices, raw.faces).map_err(|e| bad(e.into()))?;
    let strip = Strip::from_disk(mesh).map_err(|e| bad(e.into()))?;
    let chart = Chart::new(strip, uv).map_err(|e| bad(e.into()))?;
    let measured = measure(&chart, &places);
    if measured.map_m == 0.0 {
        return Err(usage("the places are one and the same: there is no length to measure".to_owned()));
    }
    if measured.without_surface_m >= measured.map_m {
        let text =
            "no part of the line lies on the map; places are chainage,girth in metres, and the crown is at girth 0";
        return Err(usage(text.to_owned()));
    }
    if json {
        let report = serde_json::json!({
            "map_m": measured.map_m,
            "surface_m": measured.surface_m,
            "ratio": measured.surface_m / measured.map_m,
            "without_surface_m": measured.without_surface_m,
        });
        console.print(&format!("{report:#}"));
    } else {
        let mut text = format!(
            "on the map {:.3} m, on the surface {:.3} m, ratio {:.4}",
            measured.map_m,
            measured.surface_m,
            measured.surface_m / measured.map_m
        );
        if measured.without_surface_m > 0.0 {
            text += &format!(
                "\n{:.3} m of the line lie beside the map or in a hole: measured straight in space from edge to edge",
                measured.without_surface_m
            );
        }
        console.print(&text);
    }
    Ok(Exit::Done)
}

struct Measured {
    map_m: f64,
    surface_m: f64,
    without_surface_m: f64,
}

fn measure(chart: &Chart, places: &[Vec2]) -> Measured {
    let index = ChartIndex::of(chart);
    let mesh = chart.strip().mesh();
    // At offset 0 normals play no role.
    let normals = vec![Vec3::zeros(); mesh.vertices().len()];
    let mut measured = Measured { map_m: 0.0, surface_m: 0.0, without_surface_m: 0.0 };
    let mut last: Option<Vec3> = None;
    for pair in places.windows(2) {
        let length = (pair[1] - pair[0]).norm();
        measured.map_m += length;
        let steps = (length / STEP_M).ceil().max(1.0) as usize;
        for i in 0..=steps {
            let place = pair[0] + (pair[1] - pair[0]) * (i as f64 / steps as f64);
            match index.surface_point(place) {
                Some(foot) => {
                    let here = foot.position(mesh, &normals);
                    measured.surface_m += last.map_or(0.0, |last| (here - last).norm());
                    last = Some(here);
                }
                None => measured.without_surface_m += if i > 0 { length / steps as f64 } else { 0.0 },
            }
        }
    }
    measured
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::unwrap::closed_form;

    #[test]
    fn a_cylinder_keeps_its_lengths_around_and_along() {
        let known = closed_form::full_cylinder();
        let chart = Chart::new(known.strip, known.flat).unwrap();
        for [a, b] in [[(0.3, -11.0), (0.3, 11.0)], [(0.5, 2.0), (8.5, 2.0)], [(1.0, -8.0), (8.0, 9.0)]] {
            let measured = measure(&chart, &[Vec2::new(a.0, a.1), Vec2::new(b.0, b.1)]);
            let ratio = measured.surface_m / measured.map_m;
            assert!((ratio - 1.0).abs() < 1e-4 && measured.without_surface_m == 0.0, "{a:?} {b:?}: {ratio}");
        }
    }

    #[test]
    fn a_chainage_map_of_a_bend_is_off_by_radius_over_bend_radius() {
        // A circular tunnel of 3 m on a left-hand bend of 20 m: the right wall is the outer one.
        let known = closed_form::bend(20.0);
        let chart = Chart::new(known.strip, known.flat).unwrap();
        let quarter = 1.5 * std::f64::consts::PI;
        for (girth, expected) in [(0.0, 1.0), (quarter, 23.0 / 20.0), (-quarter, 17.0 / 20.0)] {
            let measured = measure(&chart, &[Vec2::new(2.0, girth), Vec2::new(30.0, girth)]);
            let ratio = measured.surface_m / measured.map_m;
            assert!((ratio - expected).abs() < 2e-3, "at girth {girth}: {ratio} instead of {expected}");
        }
        let around = measure(&chart, &[Vec2::new(15.0, -6.0), Vec2::new(15.0, 6.0)]);
        assert!((around.surface_m / around.map_m - 1.0).abs() < 2e-3);
    }

    #[test]
    fn a_sheet_on_a_slope_is_longer_than_its_plan() {
        // A 2 m x 2 m sheet at 45 degrees, drawn on the map as its plan.
        let vertices: Vec<Vec3> =
            [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)].map(|(x, y)| Vec3::new(x, y, x)).to_vec();
        let uv = vertices.iter().map(|p| p.xy()).collect();
        let mesh = Mesh::all_observed(vertices, vec![[0, 1, 2], [0, 2, 3]]).unwrap();
        let chart = Chart::new(Strip::from_disk(mesh).unwrap(), uv).unwrap();
        let along = measure(&chart, &[Vec2::new(0.5, 1.0), Vec2::new(1.5, 1.0)]);
        assert!((along.map_m - 1.0).abs() < 1e-12 && (along.surface_m - 2f64.sqrt()).abs() < 1e-9);
        let across = measure(&chart, &[Vec2::new(1.0, 0.2), Vec2::new(1.0, 1.2)]);
        assert!((across.surface_m - 1.0).abs() < 1e-9 && across.without_surface_m == 0.0);
        let beside = measure(&chart, &[Vec2::new(1.0, 1.0), Vec2::new(1.0, 3.0)]);
        assert!((beside.without_surface_m - 1.0).abs() < 0.02, "{}", beside.without_surface_m);
    }
}
