//! `adit planes`: planes of traces and patches with sets, stereonet and statistics; or given planes drawn on the map.

use super::run_surface::{RunSurface, cannot_write, io_failure, tell};
use super::{Console, Exit, Failure, Result};
use crate::io::vector::{self, Shapes, Space};
use crate::linework::{self, Feature, Kind, Value};
use crate::numeric::{Vec2, Vec3};
use crate::planes::{
    self, FitSettings, PlaneFit, Reliability, SetSettings, StatisticsSettings, Stereonet, StereonetPole, TraceOnMap,
};
use crate::unwrap::{Chart, ChartIndex};
use std::fmt::Write;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  adit planes runs/drift --traces traces.gpkg --out planes                 from 'adit trace' or drawn in QGIS
  adit planes runs/drift --traces traces.gpkg --out planes --sets sets.csv given sets: name,dip,dip_direction
  adit planes runs/drift --draw planes.csv --out curves.gpkg               name,dip,dip_direction,x,y,z[,radius]

The folder of the first two gets planes.gpkg, planes.dxf (a layer for each set), dips.csv (dip, dip direction first),
leapfrog.csv, stereonet.svg, stereonet.png and statistics.json.";

/// Arguments of `adit planes`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The run folder.
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
    /// Traces and patches on the map (.gpkg, .geojson, .dxf, .shp).
    #[arg(long, value_name = "FILE", required_unless_present = "draw", conflicts_with = "draw")]
    traces: Option<PathBuf>,
    /// Planes to draw: CSV with the columns name,dip,dip_direction,x,y,z and, for planes that end, radius (metres).
    #[arg(long, value_name = "CSV")]
    draw: Option<PathBuf>,
    /// A folder for all products, or the file of the curves (with --draw).
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// Given sets instead of found ones: CSV with the columns name,dip,dip_direction.
    #[arg(long, value_name = "CSV", conflicts_with = "draw")]
    sets: Option<PathBuf>,
    /// Planes within this angle of a mean belong to its set, degrees.
    #[arg(long, value_name = "DEG", default_value_t = SetSettings::default().spread_deg)]
    spread: f64,
    /// Least deviation from a plane that a trace has however even it looks, metres: pixels, scanner, surface.
    #[arg(long, value_name = "M", default_value_t = FitSettings::default().noise_m)]
    noise: f64,
    /// Length of the intervals of the RQD, metres of chainage.
    #[arg(long, value_name = "M", default_value_t = StatisticsSettings::default().interval_m)]
    interval: f64,
}

/// Fits or draws.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    match &arguments.draw {
        Some(csv) => draw(&arguments, csv, console),
        None => fit(&arguments, console),
    }
}

/// A trace or patch with its plane.
struct Plane {
    on_map: Feature,
    in_local: Feature,
    fit: Option<PlaneFit>,
    set: Option<u32>,
    axis_angle_deg: Option<f64>,
}

fn fit(arguments: &Arguments, console: &Console) -> Result {
    let traces = arguments.traces.as_ref().expect("clap requires it");
    let drawn = vector::read(traces, Space::Map).map_err(io_failure)?;
    let surface = RunSurface::open(&arguments.run)?;
    let directions = RunSurface::axis_directions(&arguments.run)?;
    let index = ChartIndex::of(&surface.chart);
    let bad = |e: linework::Error| Failure::new(Exit::BadInput, e);
    let draped = linework::drape(&index, &drawn.features).map_err(bad)?;
    tell(console, &[drawn.warnings.clone(), draped.summary.warnings.clone()].concat());
    let usage = |e: planes::Error| Failure::new(Exit::Usage, e);
    if !(arguments.noise > 0.0) {
        return Err(Failure::message(
            Exit::Usage,
            format!("--noise is {}, but must be more than 0 m", arguments.noise),
        ));
    }
    let settings = FitSettings { noise_m: arguments.noise, ..FitSettings::default() };
    let statistics = StatisticsSettings { interval_m: arguments.interval, ..StatisticsSettings::default() };
    let mut found: Vec<Plane> = Vec::new();
    for (in_local, &source) in draped.features.iter().zip(&draped.sources) {
        let on_map = drawn.features[source].clone();
        let fit = match in_local.kind {
            Kind::Point => None,
            Kind::Line => planes::fit_line(&in_local.parts, &settings),
            Kind::Area => planes::fit_points(&faces_inside(&surface.chart, &on_map.parts), &settings),
        };
        let axis_angle_deg = fit.as_ref().map(|fit| {
            let u = on_map.parts[0][0].x;
            let nearest = directions.iter().min_by(|a, b| (a.0 - u).abs().total_cmp(&(b.0 - u).abs()));
            90.0 - planes::angle_between_planes_deg(&fit.normal, &nearest.expect("not empty").1)
        });
        found.push(Plane { on_map, in_local: in_local.clone(), fit, set: None, axis_angle_deg });
    }
    let accepted: Vec<usize> =
        (0..found.len()).filter(|&i| found[i].fit.as_ref().is_some_and(PlaneFit::is_accepted)).collect();
    let normals: Vec<Vec3> = accepted.iter().filter_map(|&i| Some(found[i].fit.as_ref()?.normal)).collect();
    let set_settings = SetSettings { spread_deg: arguments.spread, ..SetSettings::default() };
    let (sets, numbers) = match &arguments.sets {
        Some(csv) => planes::given_sets(&normals, &read_sets(csv)?, &set_settings).map_err(usage)?,
        None => planes::sets(&normals, &set_settings).map_err(usage)?,
    };
    for (&i, number) in accepted.iter().zip(&numbers) {
        found[i].set = *number;
    }
    let on_map: Vec<TraceOnMap> = found
        .iter()
        .filter(|p| p.on_map.kind == Kind::Line)
        .map(|p| TraceOnMap {
            parts: p.on_map.parts.iter().map(|part| part.iter().map(|v| v.xy()).collect::<Vec<Vec2>>()).collect(),
            set: p.set,
        })
        .collect();
    let summary = planes::statistics(&index, &on_map, &sets, &statistics).map_err(usage)?;
    let mean_direction = directions.iter().map(|d| d.1).sum::<Vec3>();
    let net = Stereonet {
        poles: found
            .iter()
            .filter_map(|p| p.fit.as_ref().map(|fit| (p, fit)))
            .map(|(p, fit)| StereonetPole { normal: fit.normal, set: p.set, accepted: fit.is_accepted() })
            .collect(),
        sets: sets.clone(),
        axis: mean_direction.try_normalize(0.1 * directions.len() as f64),
        blind_deg: statistics.blind_deg,
        title: format!("Poles of {} planes", found.iter().filter(|p| p.fit.is_some()).count()),
    };
    write_products(&arguments.out, &surface, &found, &net, statistics.blind_deg, console)?;
    let unreliable = found.iter().filter(|p| p.fit.is_some()).count() - accepted.len();
    let report = serde_json::json!({
        "traces": found.len(),
        "accepted": accepted.len(),
        "unreliable": unreliable,
        "without_plane": found.iter().filter(|p| p.fit.is_none()).count(),
        "limits": {
            "least_m": settings.least_m, "greatest_k": settings.greatest_k,
            "greatest_angle_95_deg": settings.greatest_angle_deg, "sure_angle_95_deg": settings.sure_angle_deg, "noise_m": settings.noise_m,
            "correlation_m": settings.correlation_m,
        },
        "drape": draped.summary,
        "sets": sets,
        "blind_zone_deg": statistics.blind_deg,
        "statistics": summary,
    });
    let path = arguments.out.join("statistics.json");
    std::fs::write(&path, format!("{report:#}\n")).map_err(|e| cannot_write(&path, e))?;
    let mut told = format!("{} planes accepted, {unreliable} unreliable, {} sets", accepted.len(), sets.len());
    for set in &sets {
        let _ = write!(
            told,
            "\n  set {}: dip {:.1}, dip direction {:.1}, {} planes",
            set.number, set.dip_deg, set.dip_direction_deg, set.planes
        );
    }
    let all = &summary.all;
    let _ = write!(
        told,
        "\n  P21 {:.3} m/m2, P20 {:.3} /m2, P10 {:.3} /m on {:.1} m2 of observed surface\nwrote {}",
        all.p21_m_per_m2,
        all.p20_per_m2,
        all.p10_per_m,
        summary.observed_area_m2,
        arguments.out.display()
    );
    console.say(&told);
    Ok(Exit::Done)
}

/// Centres and areas of the observed faces whose centre lies inside rings on the map (even-odd).
fn faces_inside(chart: &Chart, rings: &[Vec<Vec3>]) -> Vec<(Vec3, f64)> {
    let mesh = chart.strip().mesh();
    let inside = |p: Vec2| {
        let crossings = rings.iter().flat_map(|ring| ring.windows(2)).filter(|w| {
            let (a, b) = (w[0].xy(), w[1].xy());
            (a.y > p.y) != (b.y > p.y) && p.x < a.x + (b.x - a.x) * (p.y - a.y) / (b.y - a.y)
        });
        crossings.count() % 2 == 1
    };
    (0..mesh.faces().len() as u32)
        .filter(|&f| mesh.observed()[f as usize] && inside(chart.corners_in_chart(f).iter().sum::<Vec2>() / 3.0))
        .map(|f| (mesh.corners(f).iter().sum::<Vec3>() / 3.0, mesh.double_area_vector(f).norm() / 2.0))
        .collect()
}

fn write_products(
    folder: &Path,
    surface: &RunSurface,
    found: &[Plane],
    net: &Stereonet,
    blind_deg: f64,
    console: &Console,
) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| cannot_write(folder, e))?;
    let mut dips = String::from("dip,dip_direction,id,set,accepted,x,y,z,length_m,m,k,angle_95_deg,blind_zone\n");
    let mut leapfrog = String::from("x,y,z,dip,dip_azimuth,set,id\n");
    let (mut on_map, mut in_local) = (Vec::new(), Vec::new());
    for plane in found {
        let mut features = [plane.on_map.clone(), plane.in_local.clone()];
        if let Some(fit) = &plane.fit {
            let centre = surface.frame.scan_from_local(&fit.centre);
            let blind = plane.axis_angle_deg.is_some_and(|a| a < blind_deg);
            let set = plane.set.map_or(String::new(), |s| s.to_string());
            let id = plane.on_map.id.unwrap_or_default();
            let _ = writeln!(
                dips,
                "{:.2},{:.2},{} {id},{set},{},{:.4},{:.4},{:.4},{:.3},{:.2},{:.3},{:.2},{blind}",
                fit.dip_deg,
                fit.dip_direction_deg,
                plane.on_map.class,
                fit.is_accepted(),
                centre.x,
                centre.y,
                centre.z,
                fit.length_m,
                fit.m,
                fit.k,
                fit.angle_95_deg
            );
            if fit.is_accepted() {
                let _ = writeln!(
                    leapfrog,
                    "{:.4},{:.4},{:.4},{:.2},{:.2},{set},{} {id}",
                    centre.x, centre.y, centre.z, fit.dip_deg, fit.dip_direction_deg, plane.on_map.class
                );
            }
            let reason = match &fit.reliability {
                Reliability::Accepted => Value::Null,
                Reliability::Unreliable(reason) => Value::Text(reason.clone()),
            };
            let angle = plane.axis_angle_deg.unwrap_or(90.0);
            for feature in &mut features {
                for (name, value) in [
                    ("dip_deg", Value::Real(fit.dip_deg)),
                    ("dip_direction_deg", Value::Real(fit.dip_direction_deg)),
                    ("accepted", Value::Boolean(fit.is_accepted())),
                    ("unreliable_because", reason.clone()),
                    ("set", plane.set.map_or(Value::Null, |s| Value::Integer(i64::from(s)))),
                    ("length_m", Value::Real(fit.length_m)),
                    ("rms_m", Value::Real(fit.rms_m)),
                    ("m", Value::Real(fit.m)),
                    ("k", Value::Real(fit.k)),
                    ("angle_95_deg", Value::Real(fit.angle_95_deg)),
                    ("axis_angle_deg", Value::Real(angle)),
                    ("blind_zone", Value::Boolean(blind)),
                    ("terzaghi_weight", Value::Real(1.0 / angle.max(1.0).to_radians().sin())),
                ] {
                    feature.set(name, value);
                }
            }
        }
        let [map, local] = features;
        on_map.push(map);
        in_local.push(local);
    }
    let in_scan = surface.scan_from_local(&in_local);
    let shapes = [Shapes { space: Space::Scan, features: &in_scan }, Shapes { space: Space::Map, features: &on_map }];
    let write = |name: &str, shapes: &[Shapes]| -> Result<()> {
        tell(console, &vector::write(&folder.join(name), shapes).map_err(io_failure)?);
        Ok(())
    };
    write("planes.gpkg", &shapes)?;
    let mut by_set = in_scan.clone();
    for (feature, plane) in by_set.iter_mut().zip(found) {
        feature.set("class", Value::Text(feature.class.clone()));
        feature.class = match (plane.set, &plane.fit) {
            (Some(set), _) => format!("set_{set}"),
            (None, Some(fit)) if fit.is_accepted() => "no_set".into(),
            _ => "unreliable".into(),
        };
    }
    write("planes.dxf", &[Shapes { space: Space::Scan, features: &by_set }])?;
    for (name, text) in [("dips.csv", &dips), ("leapfrog.csv", &leapfrog), ("stereonet.svg", &net.svg())] {
        let path = folder.join(name);
        std::fs::write(&path, text).map_err(|e| cannot_write(&path, e))?;
    }
    let path = folder.join("stereonet.png");
    crate::io::write_picture(&path, &net.picture(2.0), None).map_err(|e| Failure::new(Exit::Resources, e))?;
    Ok(())
}

/// The rows of a CSV file with a header line; columns by name, in any order.
fn read_csv(path: &Path, needed: &[&str], optional: &[&str]) -> Result<Vec<Vec<Option<String>>>> {
    let bad = |message: String| Failure::message(Exit::BadInput, format!("{}: {message}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|e| bad(e.to_string()))?;
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty());
    let (_, header) = lines.next().ok_or_else(|| bad("it is empty".into()))?;
    let header: Vec<String> =
        header.trim_start_matches('\u{feff}').split(',').map(|h| h.trim().to_ascii_lowercase()).collect();
    let place = |name: &str| header.iter().position(|h| h == name);
    if let Some(missing) = needed.iter().find(|n| place(n).is_none()) {
        return Err(bad(format!("the column '{missing}' is missing; there are: {}", header.join(", "))));
    }
    lines
        .map(|(number, line)| {
            let cells: Vec<&str> = line.split(',').map(str::trim).collect();
            if cells.len() != header.len() {
                return Err(bad(format!(
                    "line {} has {} values, the header {}",
                    number + 1,
                    cells.len(),
                    header.len()
                )));
            }
            let value = |n: &&str| place(n).map(|i| cells[i].to_owned()).filter(|c| !c.is_empty());
            Ok(needed.iter().chain(optional).map(value).collect())
        })
        .collect()
}

fn number(path: &Path, row: usize, name: &str, cell: Option<&String>) -> Result<f64> {
    cell.and_then(|c| c.parse::<f64>().ok()).filter(|v| v.is_finite()).ok_or_else(|| {
        let given = cell.map_or("", |c| c.as_str());
        Failure::message(
            Exit::BadInput,
            format!("{}: row {}: {name} is '{given}', not a number", path.display(), row + 1),
        )
    })
}

fn read_sets(path: &Path) -> Result<Vec<(String, f64, f64)>> {
    let rows = read_csv(path, &["name", "dip", "dip_direction"], &[])?;
    rows.iter()
        .enumerate()
        .map(|(i, row)| {
            let name = row[0].clone().unwrap_or_else(|| format!("set {}", i + 1));
            Ok((name, number(path, i, "dip", row[1].as_ref())?, number(path, i, "dip_direction", row[2].as_ref())?))
        })
        .collect()
}

fn draw(arguments: &Arguments, csv: &Path, console: &Console) -> Result {
    let rows = read_csv(csv, &["name", "dip", "dip_direction", "x", "y", "z"], &["radius"])?;
    let surface = RunSurface::open(&arguments.run)?;
    let (mut on_map, mut in_local): (Vec<Feature>, Vec<Feature>) = (Vec::new(), Vec::new());
    let mut missed = Vec::new();
    for (i, row) in rows.iter().enumerate() {
        let value = |k: usize, name: &str| number(csv, i, name, row[k].as_ref());
        let (dip, direction) = (value(1, "dip")?, value(2, "dip_direction")?);
        let name = row[0].clone().unwrap_or_else(|| format!("plane {}", i + 1));
        planes::check_orientation(&name, dip, direction).map_err(|e| Failure::new(Exit::BadInput, e))?;
        let through = surface.frame.local_from_scan(&Vec3::new(value(3, "x")?, value(4, "y")?, value(5, "z")?));
        let radius = if row[6].is_some() { value(6, "radius")? } else { f64::INFINITY };
        let found = planes::curves(&surface.chart, &planes::normal_of(dip, direction), &through, radius);
        if found.is_empty() {
            missed.push(name.clone());
            continue;
        }
        let map_parts = found.iter().map(|c| c.on_map.iter().map(|p| Vec3::new(p.x, p.y, 0.0)).collect()).collect();
        let local_parts = found.into_iter().map(|c| c.in_local).collect();
        let feature = Feature {
            class: "planes".into(),
            id: Some(i as i64 + 1),
            attributes: vec![
                ("name".into(), Value::Text(name)),
                ("dip_deg".into(), Value::Real(dip)),
                ("dip_direction_deg".into(), Value::Real(direction)),
            ],
            kind: Kind::Line,
            parts: map_parts,
        };
        in_local.push(feature.with_parts(local_parts));
        on_map.push(feature);
    }
    if !missed.is_empty() {
        console.warn(&format!("planes that do not meet the surface: {}", missed.join(", ")));
    }
    if on_map.is_empty() {
        return Err(Failure::message(Exit::BadInput, format!("no plane of {} meets the surface", csv.display())));
    }
    let in_scan = surface.scan_from_local(&in_local);
    let shapes = [Shapes { space: Space::Scan, features: &in_scan }, Shapes { space: Space::Map, features: &on_map }];
    tell(console, &vector::write(&arguments.out, &shapes).map_err(io_failure)?);
    console.say(&format!("{} planes drawn\nwrote {}", on_map.len(), arguments.out.display()));
    Ok(Exit::Done)
}
