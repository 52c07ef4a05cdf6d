//! `adit synth`: a synthetic scan of a tunnel that is known in closed form.

use super::{Console, Exit, Failure, Result};
use crate::cloud::Cloud;
use crate::io::{self, PointColumns};
use crate::numeric::Vec3;
use crate::segment::Class;
use crate::synthetic::{self, Course, Kind, Part, Recipe, Shape, Surface, SyntheticScan, Truth, View};
use std::path::PathBuf;

/// Classes that `--truth` writes: LAS codes where there is one, user codes otherwise.
const TRUTH_CLASSES: [(Surface, u8); 5] =
    [(Surface::Wall, 64), (Surface::Floor, 2), (Surface::Furniture, 65), (Surface::Outside, 66), (Surface::Outlier, 7)];

const EXAMPLES: &str = "\
Examples:
  adit synth --out drift.laz                                     the bundled sample: a bent, rough drift
  adit synth --out shaft.laz --section circle:2.5 --alignment shaft --furniture cables
  adit synth --out long.las --length 200 --stations 16 --points 20000000 --section horseshoe:8.2x6.7
  adit synth --out truth.ply --truth --noise-mm 3                with true class, chainage and girth of every point
  adit synth --out junction.laz --furniture crosscut,niche,duct  a side drift on the right, a recess on the left

--truth writes the columns chainage and girth (as measured around the smooth section), offset (relief), the LAS
classification of each point (64 wall, 2 floor, 65 furniture, 66 side drift, 7 outlier) and surface_class, as `adit run`
writes what it found (0 wall, 1 floor, 2 furniture, 3 outside, 4 noise). Furniture, recesses and outliers have no girth.";

/// Arguments of `adit synth`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// The scan to write: .laz, .las or .ply.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Section in metres: horseshoe:WIDTHxHEIGHT, circle:RADIUS or ellipse:WIDTHxHEIGHT.
    #[arg(long, value_name = "SHAPE", default_value = "horseshoe:4.6x4.2", value_parser = parse_shape)]
    section: Shape,
    /// Course of the axis.
    #[arg(long, value_enum, default_value_t = AlignmentName::Bend)]
    alignment: AlignmentName,
    /// Length along the axis, metres.
    #[arg(long, value_name = "M", default_value_t = Recipe::default().length_m)]
    length: f64,
    /// Bend radius, metres, positive to the left (bend and helix).
    #[arg(long, value_name = "M", default_value_t = Recipe::default().radius_m, allow_negative_numbers = true)]
    radius: f64,
    /// Gradient in percent (ramp and helix).
    #[arg(long, value_name = "PERCENT", default_value_t = 10.0, allow_negative_numbers = true)]
    gradient: f64,
    /// Azimuth at the start, degrees clockwise from north.
    #[arg(long, value_name = "DEG", default_value_t = Recipe::default().azimuth_deg, allow_negative_numbers = true)]
    azimuth: f64,
    /// Height of the wall's roughness, metres; 0 for smooth walls.
    #[arg(long, value_name = "M", default_value_t = Recipe::default().roughness_m)]
    roughness: f64,
    /// Leave out the nine fractures.
    #[arg(long)]
    no_fractures: bool,
    /// Text on the right wall; empty for none.
    #[arg(long, value_name = "TEXT", default_value = "ADIT 12 R")]
    right_text: String,
    /// Text on the left wall; empty for none.
    #[arg(long, value_name = "TEXT", default_value = "L")]
    left_text: String,
    /// What stands in the way and is cut into the walls, separated by commas; `none` for an empty tunnel.
    #[arg(long, value_name = "LIST", value_enum, value_delimiter = ',', default_value = "cables,vehicle")]
    furniture: Vec<FurnitureName>,
    /// Scanner stations, spread evenly.
    #[arg(long, value_name = "N", default_value_t = Recipe::default().stations)]
    stations: usize,
    /// Points, about.
    #[arg(long, value_name = "N", default_value_t = Recipe::default().points)]
    points: usize,
    /// Standard deviation of the range, millimetres.
    #[arg(long, value_name = "MM", default_value_t = 1000.0 * Recipe::default().noise_m)]
    noise_mm: f64,
    /// Share of outliers, 0 to 1.
    #[arg(long, value_name = "SHARE", default_value_t = Recipe::default().outlier_share)]
    outliers: f64,
    /// Write intensity only, no colours.
    #[arg(long)]
    no_color: bool,
    /// Coordinates of the start of the tunnel: x,y,z.
    #[arg(long, value_name = "X,Y,Z", default_value = "568200,6642300,148", value_parser = parse_point,
          allow_negative_numbers = true)]
    origin: Vec3,
    /// Steps of the coordinates in LAS and LAZ, millimetres.
    #[arg(long, value_name = "MM", default_value_t = 1.0)]
    step_mm: f64,
    /// Part of the section that is there: a half tunnel, or a trench without its roof.
    #[arg(long, value_enum, default_value_t = PartName::Whole)]
    part: PartName,
    /// Share of the surface that is missing, in patches of 1.5 m, 0 to below 1.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    gaps: f64,
    /// A profile scan: all points lie on profiles this far apart, metres.
    #[arg(long, value_name = "M")]
    profiles: Option<f64>,
    /// Same seed, same scan.
    #[arg(long, value_name = "N", default_value_t = Recipe::default().seed)]
    seed: u64,
    /// Also write what is known about each point.
    #[arg(long)]
    truth: bool,
}

/// Course of the axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum AlignmentName {
    /// Level and straight.
    Straight,
    /// A level bend.
    Bend,
    /// Straight with a gradient.
    Ramp,
    /// A bend with a gradient.
    Helix,
    /// Straight down.
    Shaft,
}

/// Part of the section.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum PartName {
    /// All of it.
    Whole,
    /// What lies right of the axis.
    RightHalf,
    /// Floor and walls without the roof.
    Trench,
}

/// What may stand and hang in the tunnel, and be cut into its walls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum FurnitureName {
    /// An empty tunnel.
    None,
    /// A ventilation duct.
    Duct,
    /// Three cables.
    Cables,
    /// Two rails.
    Rails,
    /// A parked pick-up.
    Vehicle,
    /// A side drift through the right wall, 2.5 m wide and high and 6 m deep.
    Crosscut,
    /// A recess in the left wall, 2 m wide and high and 1 m deep.
    Niche,
}

impl Arguments {
    fn recipe(&self) -> Recipe {
        Recipe {
            shape: self.section,
            course: match self.alignment {
                AlignmentName::Straight => Course::Straight,
                AlignmentName::Bend => Course::Bend,
                AlignmentName::Ramp => Course::Ramp,
                AlignmentName::Helix => Course::Helix,
                AlignmentName::Shaft => Course::Shaft,
            },
            length_m: self.length,
            radius_m: self.radius,
            gradient_percent: self.gradient,
            azimuth_deg: self.azimuth,
            roughness_m: self.roughness,
            fractures: !self.no_fractures,
            lettering: [self.right_text.clone(), self.left_text.clone()],
            furniture: self.furniture.iter().filter_map(|f| kind(*f)).collect(),
            stations: self.stations,
            points: self.points,
            noise_m: self.noise_mm / 1000.0,
            outlier_share: self.outliers,
            colored: !self.no_color,
            origin_in_scan: self.origin,
            view: View {
                part: match self.part {
                    PartName::Whole => Part::Whole,
                    PartName::RightHalf => Part::RightHalf,
                    PartName::Trench => Part::Trench,
                },
                gap_share: self.gaps,
                profile_m: self.profiles,
            },
            seed: self.seed,
        }
    }
}

fn kind(name: FurnitureName) -> Option<Kind> {
    match name {
        FurnitureName::None => None,
        FurnitureName::Duct => Some(Kind::Duct),
        FurnitureName::Cables => Some(Kind::Cables),
        FurnitureName::Rails => Some(Kind::Rails),
        FurnitureName::Vehicle => Some(Kind::Vehicle),
        FurnitureName::Crosscut => Some(Kind::Crosscut),
        FurnitureName::Niche => Some(Kind::Niche),
    }
}

/// Makes the scan and writes it under a temporary name until it is complete.
pub fn run(arguments: Arguments, console: &Console) -> Result {
    let usage = |e: synthetic::Error| Failure::new(Exit::Usage, e);
    if !(0.01..=1000.0).contains(&arguments.step_mm) {
        return Err(Failure::message(Exit::Usage, format!("--step-mm {} is not from 0.01 to 1000", arguments.step_mm)));
    }
    let extension = arguments.out.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    if !matches!(extension.as_str(), "las" | "laz" | "ply") {
        let out = arguments.out.display();
        return Err(Failure::message(Exit::Usage, format!("cannot write '{out}': name it .laz, .las or .ply")));
    }
    let recipe = arguments.recipe();
    let tunnel = recipe.tunnel().map_err(usage)?;
    let scan = synthetic::scan(&tunnel, &recipe.plan().map_err(usage)?).map_err(usage)?;
    let scan = if arguments.truth { with_classes(scan) } else { scan };
    let relief = arguments.truth.then(|| {
        let place = scan.truth.chainage_m.iter().zip(&scan.truth.girth_m);
        // Into the void is positive in files, into the rock in the generator.
        place.map(|(&s, &g)| if g.is_nan() { f64::NAN } else { -tunnel.outward_at(s, g) }).collect::<Vec<f64>>()
    });
    let surface_classes: Vec<u8> = scan.truth.surface.iter().map(|&s| class_of(s) as u8).collect();
    let columns = relief.as_ref().map(|offset| PointColumns {
        labels: &scan.truth.label,
        chainage: &scan.truth.chainage_m,
        girth: &scan.truth.girth_m,
        offset,
        surface_classes: Some(&surface_classes),
    });
    let out = &arguments.out;
    let unwritable = |e: std::io::Error| {
        Failure::new(Exit::Resources, anyhow::Error::new(e).context(format!("cannot write {}", out.display())))
    };
    let name = out.file_name().ok_or_else(|| unwritable(std::io::Error::other("the path names no file")))?;
    // The extension stays last: it chooses the format.
    let partial = out.with_file_name(format!(".partial-{}", name.to_string_lossy()));
    let written = io::write_cloud_in_steps(&scan.cloud, columns.as_ref(), &partial, arguments.step_mm / 1000.0);
    let summary = match written {
        Ok(summary) => summary,
        Err(e) => {
            let _ = std::fs::remove_file(&partial);
            return Err(Failure::new(Exit::Resources, e));
        }
    };
    std::fs::rename(&partial, out).map_err(unwritable)?;
    for warning in &summary.warnings {
        console.warn(&warning.message);
    }
    console.say(&format!("{} points of a synthetic tunnel in {}", summary.points, out.display()));
    Ok(Exit::Done)
}

/// The class that segmentation should find.
fn class_of(surface: Surface) -> Class {
    match surface {
        Surface::Wall => Class::Wall,
        Surface::Floor => Class::Floor,
        Surface::Furniture => Class::Furniture,
        Surface::Outside => Class::Outside,
        Surface::Outlier => Class::Noise,
    }
}

/// The scan with the true class of each point as its classification.
fn with_classes(scan: SyntheticScan) -> SyntheticScan {
    let class = |s: &Surface| TRUTH_CLASSES.iter().find(|(surface, _)| surface == s).map_or(0, |(_, code)| *code);
    let classes = scan.truth.surface.iter().map(class).collect();
    let SyntheticScan { cloud, truth } = scan;
    SyntheticScan { cloud: classified(&cloud, classes), truth: Truth { ..truth } }
}

fn classified(cloud: &Cloud, classes: Vec<u8>) -> Cloud {
    let mut attributes = cloud.attributes().clone();
    attributes.classifications = Some(classes);
    Cloud::new(
        cloud.frame().clone(),
        cloud.positions().to_vec(),
        attributes,
        cloud.sources().to_vec(),
        cloud.stations().to_vec(),
    )
    .expect("one class a point")
}

fn parse_shape(text: &str) -> std::result::Result<Shape, String> {
    let hint = "expected horseshoe:WIDTHxHEIGHT, circle:RADIUS or ellipse:WIDTHxHEIGHT";
    let (name, size) = text.split_once(':').ok_or(hint)?;
    let number = |t: &str| t.parse::<f64>().map_err(|_| format!("'{t}' is no number; {hint}"));
    let pair = || -> std::result::Result<(f64, f64), String> {
        let (w, h) = size.split_once('x').ok_or(hint)?;
        Ok((number(w)?, number(h)?))
    };
    match name {
        "horseshoe" => pair().map(|(width_m, height_m)| Shape::Horseshoe { width_m, height_m }),
        "ellipse" => pair().map(|(width_m, height_m)| Shape::Ellipse { width_m, height_m }),
        "circle" => Ok(Shape::Circle { radius_m: number(size)? }),
        _ => Err(hint.into()),
    }
}

fn parse_point(text: &str) -> std::result::Result<Vec3, String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|t| t.trim().parse::<f64>().ok().filter(|v| v.is_finite()))
        .collect::<Option<_>>()
        .ok_or("expected three numbers: x,y,z")?;
    match numbers[..] {
        [x, y, z] => Ok(Vec3::new(x, y, z)),
        _ => Err("expected three numbers: x,y,z".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        arguments: Arguments,
    }

    #[test]
    fn the_defaults_are_the_bundled_sample() {
        let line = Line::parse_from(["synth", "--out", "x.laz"]);
        // The gradient matters only for ramps and helices.
        assert_eq!(Recipe { gradient_percent: 0.0, ..line.arguments.recipe() }, Recipe::default());
    }

    #[test]
    fn shapes_are_read() {
        assert_eq!(parse_shape("circle:2.5"), Ok(Shape::Circle { radius_m: 2.5 }));
        assert_eq!(parse_shape("ellipse:3x4"), Ok(Shape::Ellipse { width_m: 3.0, height_m: 4.0 }));
        assert!(
            parse_shape("circle").is_err() && parse_shape("horseshoe:3").is_err() && parse_shape("square:2").is_err()
        );
    }

    #[test]
    fn points_are_read() {
        assert_eq!(parse_point("1, -2,3.5"), Ok(Vec3::new(1.0, -2.0, 3.5)));
        assert!(parse_point("1,2").is_err() && parse_point("1,2,x").is_err() && parse_point("1,2,nan").is_err());
    }
}
