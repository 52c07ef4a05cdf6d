//! Which points are wall: the mean section along the axis, and what does not belong to it.

pub mod floor;
mod long_things;
pub mod quality;
pub mod sampling;
pub mod section_field;
pub mod surfaces;
pub(crate) mod unrolled_grid;

pub use floor::Floor;
pub use quality::{Quality, QualityColumns, VertexQuality};
pub use sampling::Sampling;
pub use section_field::SectionField;

use crate::axis::{Axis, AxisCoordinates};
use crate::numeric::Vec3;
use crate::warning::Warning;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use unrolled_grid::{CellPoints, Grid};

/// Edge of a cell of the depth picture in distances between points.
const POINT_DISTANCES_A_CELL: f64 = 2.5;
/// Cells of the depth picture are not finer than this share of the perimeter (5 cm in a rail tunnel).
const FINEST_SHARE_OF_PERIMETER: f64 = 1.0 / 500.0;

/// More points outside than this share are worth a warning.
const MUCH_OUTSIDE: f64 = 0.25;

/// What a point belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum Class {
    /// Rock or lining, crown included.
    Wall = 0,
    /// The ground one walks or drives on.
    Floor = 1,
    /// Ducts, pipes, cables, rails, lights, vehicles, people.
    Furniture = 2,
    /// Beyond the portals or far behind the surface.
    Outside = 3,
    /// Outliers and mixed pixels.
    Noise = 4,
}

impl Class {
    /// All classes, in the order of their codes.
    pub const ALL: [Class; 5] = [Class::Wall, Class::Floor, Class::Furniture, Class::Outside, Class::Noise];

    /// Whether the tunnel's surface is made from points of this class.
    pub fn is_surface(self) -> bool {
        matches!(self, Class::Wall | Class::Floor)
    }
}

/// How points are told apart.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Points farther than this behind the mean section are outside, metres; by default 0.4 of the local mean radius,
    /// at least 0.15 m.
    pub max_offset_m: Option<f64>,
    /// LAS classification codes that are believed instead of judging the points anew.
    pub from_classification: FromClassification,
}

/// LAS classification codes that decide the class of a point; a code may be named once.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FromClassification {
    /// Codes of rock or lining.
    pub wall: Vec<u8>,
    /// Codes of the ground, e.g. 2.
    pub floor: Vec<u8>,
    /// Codes of ducts, cables, vehicles, people.
    pub furniture: Vec<u8>,
    /// Codes of what does not belong to the tunnel.
    pub outside: Vec<u8>,
    /// Codes of outliers, e.g. 7 and 18.
    pub noise: Vec<u8>,
}

impl FromClassification {
    fn lists(&self) -> [(Class, &[u8]); 5] {
        [
            (Class::Wall, &self.wall),
            (Class::Floor, &self.floor),
            (Class::Furniture, &self.furniture),
            (Class::Outside, &self.outside),
            (Class::Noise, &self.noise),
        ]
    }

    /// Whether any code decides anything.
    pub fn is_empty(&self) -> bool {
        self.lists().iter().all(|(_, codes)| codes.is_empty())
    }

    /// The class that a code decides.
    ///
    /// # Errors
    /// [`Error::CodeTwice`] when a code is named for two classes.
    pub fn table(&self) -> Result<[Option<Class>; 256], Error> {
        let mut table = [None; 256];
        for (class, codes) in self.lists() {
            for &code in codes {
                if table[code as usize].replace(class).is_some_and(|before| before != class) {
                    return Err(Error::CodeTwice { code });
                }
            }
        }
        Ok(table)
    }
}

/// The class of each geometry point, the mean section and the points' coordinates around the axis.
#[derive(Clone, Debug)]
pub struct Segmentation {
    /// One class for each point.
    pub class: Vec<Class>,
    /// Axis coordinates of each point.
    pub coordinates: Vec<AxisCoordinates>,
    /// The mean section along the axis.
    pub section: SectionField,
    /// How densely the surface was sampled.
    pub sampling: Sampling,
    /// The feet of the walls, when the tunnel has a floor.
    pub floor: Option<Floor>,
}

/// What was found, for the report.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Points of each class, in the order wall, floor, furniture, outside, noise.
    pub points_by_class: Vec<(Class, usize)>,
    /// First chainage with a tunnel around the axis, metres.
    pub start_chainage_m: f64,
    /// Last chainage with a tunnel around the axis, metres.
    pub end_chainage_m: f64,
    /// Mean perimeter of the section, metres.
    pub mean_perimeter_m: f64,
    /// Share of the mean section bridged over gaps, percent.
    pub bridged_percent: f64,
    /// How densely the surface was sampled.
    pub sampling: Sampling,
    /// Pieces of connected surface in the depth picture.
    pub patches: surfaces::PatchCounts,
    /// Cables, pipes, rails found close to the surface. Not looked for in profile scans.
    pub long_things: usize,
    /// Points on them.
    pub long_thing_points: usize,
    /// Whether a level floor was found.
    pub has_floor: bool,
    /// Points whose class was taken from the classification of the scan.
    pub given_points: usize,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Why the points could not be told apart.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// No mean section around the axis.
    #[error(transparent)]
    Section(#[from] section_field::Error),
    /// Too few points to tell anything.
    #[error("{found} points are too few to find the tunnel's surface (100 are needed)")]
    TooFewPoints {
        /// Points given.
        found: usize,
    },
    /// A classification code stands for two classes.
    #[error("segment.from_classification names code {code} for two classes")]
    CodeTwice {
        /// The code.
        code: u8,
    },
}

/// Finds the mean section and the class of each point.
///
/// # Errors
/// [`Error`] when the points do not surround the axis anywhere.
pub fn classify_positions(
    positions: &[Vec3],
    axis: &Axis,
    settings: &Settings,
) -> Result<(Segmentation, Summary), Error> {
    classify(positions, |_| None, axis, settings)
}

/// As [`classify_positions`], with the class of some points `given` beforehand.
///
/// # Errors
/// As [`classify_positions`].
pub fn classify(
    positions: &[Vec3],
    given: impl Fn(usize) -> Option<Class> + Sync,
    axis: &Axis,
    settings: &Settings,
) -> Result<(Segmentation, Summary), Error> {
    let coordinates: Vec<AxisCoordinates> = positions.par_iter().map(|p| axis.project(p)).collect();
    // The spacing along the tunnel decides the row length of the field, and needs the girth from a field to measure.
    let first = SectionField::estimate(&coordinates, 0.0)?;
    let unrolled: Vec<[f64; 2]> =
        coordinates.par_iter().map(|c| [c.chainage, first.girth(c.chainage, c.angle())]).collect();
    let sampling = Sampling::measure(&unrolled).ok_or(Error::TooFewPoints { found: positions.len() })?;
    drop(unrolled);
    let section = if sampling.is_profiles() && sampling.along_m > first.step() {
        SectionField::estimate(&coordinates, sampling.along_m)?
    } else {
        first
    };
    let mut class: Vec<Class> = coordinates
        .par_iter()
        .map(|c| {
            // A duct all along the tunnel dents the mean section; what lies behind it is still wall.
            let radius = [-0.35, -0.17, 0.0, 0.17, 0.35]
                .iter()
                .map(|turn| section.radius(c.chainage, c.angle() + turn))
                .fold(0.0, f64::max);
            let limit = settings.max_offset_m.unwrap_or((0.4 * radius).max(0.15));
            let beyond = c.chainage < section.start() || c.chainage > section.end();
            // Points near the axis may be furniture; only those far behind the wall are surely outside.
            if beyond || c.radius() - radius > limit { Class::Outside } else { Class::Noise }
        })
        .collect();
    let spacing = if sampling.is_profiles() { sampling.around_m } else { sampling.around_m.max(sampling.along_m) };
    let column_m = (POINT_DISTANCES_A_CELL * spacing).max(section.mean_perimeter() * FINEST_SHARE_OF_PERIMETER);
    let row_m = if sampling.is_profiles() { sampling.along_m.max(column_m) } else { column_m };
    let grid = Grid::new(&section, row_m, column_m);
    let (cells, _) = CellPoints::sort(
        &grid,
        coordinates.par_iter().zip(&class).enumerate().map(|(i, (c, k))| {
            // What is known to be no surface takes no part in the picture.
            let takes_part = *k != Class::Outside && given(i).is_none_or(Class::is_surface);
            takes_part.then(|| grid.unroll(&section, c))
        }),
    );
    let mean_radius = section.mean_perimeter() / std::f64::consts::TAU;
    let (patches, depth) = surfaces::classify(&grid, &cells, &section, mean_radius, &mut class);
    let (long_things, long_thing_points) =
        if sampling.is_profiles() { (0, 0) } else { long_things::find(&grid, &cells, &mut class) };
    drop(cells);
    let floor = if axis.is_shaft() { None } else { floor::find(&grid, &section, &depth) };
    if let Some(floor) = &floor {
        class.par_iter_mut().zip(&coordinates).for_each(|(k, c)| {
            if *k == Class::Wall && floor.contains(c.chainage, section.girth(c.chainage, c.angle())) {
                *k = Class::Floor;
            }
        });
    }
    class.par_iter_mut().enumerate().for_each(|(i, k)| *k = given(i).unwrap_or(*k));
    // Once more without the furniture: a duct must not lengthen the girth of the wall behind it.
    let surface: Vec<AxisCoordinates> =
        coordinates.iter().zip(&class).filter(|(_, k)| k.is_surface()).map(|(c, _)| *c).collect();
    let cleared = SectionField::estimate(&surface, if sampling.is_profiles() { sampling.along_m } else { 0.0 })?;
    drop(surface);
    let floor = floor.map(|f| f.on(&section, &cleared));
    let section = cleared;
    class.par_iter_mut().zip(&coordinates).for_each(|(k, c)| {
        // Even a given class does not make a surface beyond the portals.
        if k.is_surface() && (c.chainage < section.start() || c.chainage > section.end()) {
            *k = Class::Outside;
        }
    });
    let mut warnings = Vec::new();
    let outside = class.iter().filter(|k| **k == Class::Outside).count();
    let outside_share = outside as f64 / class.len().max(1) as f64;
    if outside_share > MUCH_OUTSIDE {
        warnings.push(Warning::new(
            "much-outside",
            format!(
                "{:.0} % of the points lie beyond the ends or far behind the walls of the tunnel between chainage {:.1} and \
                 {:.1} m: side drifts, rooms, other tunnels; they are not mapped (axis.ends follows another way)",
                100.0 * outside_share,
                section.start(),
                section.end()
            ),
        ));
    }
    let given_points = (0..positions.len()).into_par_iter().filter(|&i| given(i).is_some()).count();
    let summary = Summary {
        points_by_class: Class::ALL.map(|k| (k, class.iter().filter(|&&c| c == k).count())).to_vec(),
        start_chainage_m: section.start(),
        end_chainage_m: section.end(),
        mean_perimeter_m: section.mean_perimeter(),
        bridged_percent: 100.0 * section.bridged_share(),
        sampling,
        patches,
        long_things,
        long_thing_points,
        has_floor: floor.is_some(),
        given_points,
        warnings,
    };
    Ok((Segmentation { class, coordinates, section, sampling, floor }, summary))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clean::{self, DROPPED};
    use crate::synthetic::{Alignment, Item, ScanPlan, Section, Surface, Tunnel, scan};

    /// Precision and recall of `found` for the points that truly are `surface`.
    fn score(truth: &[Surface], class: &[Class], surface: Surface, found: Class) -> (f64, f64) {
        let both = truth.iter().zip(class).filter(|(t, c)| **t == surface && **c == found).count() as f64;
        let claimed = class.iter().filter(|c| **c == found).count() as f64;
        let real = truth.iter().filter(|t| **t == surface).count() as f64;
        (both / claimed, both / real)
    }

    #[test]
    fn a_drift_full_of_things_is_told_apart() {
        let length = 20.0;
        let mut tunnel = Tunnel::rock_drift(Section::horseshoe(5.0, 4.8), Alignment::bend(length, 60.0), 0.1, 3);
        // The axis of a horseshoe runs at half height.
        let floor = -2.4;
        tunnel.furniture = vec![Item::duct(length, 1.2, 1.3, 0.35), Item::cable(length, -2.2, 0.9)];
        tunnel.furniture.extend(Item::rails(length, 1.435, floor));
        tunnel.furniture.extend(Item::vehicle(11.0, -0.8, floor));
        let plan = ScanPlan { points: 400_000, range_noise_m: 0.003, outlier_share: 0.005, ..ScanPlan::default() };
        let scan = scan(&tunnel, &plan).unwrap();
        let (geometry, _) = clean::clean(&scan.cloud, &clean::Settings::default()).unwrap();
        let (segmentation, summary) =
            classify_positions(geometry.positions(), &tunnel.axis(), &Settings::default()).unwrap();
        let class: Vec<Class> = geometry
            .geometry_of_point()
            .iter()
            .map(|&g| if g == DROPPED { Class::Noise } else { segmentation.class[g as usize] })
            .collect();
        let wall = score(&scan.truth.surface, &class, Surface::Wall, Class::Wall);
        let floor = score(&scan.truth.surface, &class, Surface::Floor, Class::Floor);
        assert!(wall.0 > 0.98 && wall.1 > 0.97, "wall {wall:?} {summary:?}");
        assert!(floor.0 > 0.95 && floor.1 > 0.95, "floor {floor:?} {summary:?}");
        assert!(summary.has_floor && summary.patches.furniture_patches > 0);
    }

    /// Four stations, 3 mm noise, 0.5 % outliers, everything that stands in the way: the whole way from the scan.
    #[test]
    fn the_classes_of_a_furnished_tunnel_agree_with_the_truth() {
        use crate::synthetic::{Course, Kind, Recipe, Shape};
        let horseshoe = Shape::Horseshoe { width_m: 4.6, height_m: 4.2 };
        let all = [Kind::Duct, Kind::Cables, Kind::Rails, Kind::Vehicle];
        let cases = [
            (horseshoe, Course::Bend, 1, 0.05, &all[..]),
            (horseshoe, Course::Ramp, 12, 0.1, &all[..]),
            // The vehicle takes half of the floor.
            (Shape::Horseshoe { width_m: 5.0, height_m: 4.8 }, Course::Straight, 1, 0.05, &all[..]),
            (Shape::Circle { radius_m: 2.5 }, Course::Straight, 1, 0.05, &all[..2]),
        ];
        for (shape, course, seed, roughness_m, furniture) in cases {
            let recipe = Recipe {
                shape,
                course,
                seed,
                roughness_m,
                furniture: furniture.to_vec(),
                length_m: 30.0,
                gradient_percent: 12.0,
                stations: 4,
                noise_m: 0.003,
                outlier_share: 0.005,
                ..Recipe::default()
            };
            let scan = scan(&recipe.tunnel().unwrap(), &recipe.plan().unwrap()).unwrap();
            let (geometry, _) = clean::clean(&scan.cloud, &clean::Settings::default()).unwrap();
            let (axis, _) = crate::axis::trace(geometry.positions(), &crate::axis::Settings::default()).unwrap();
            let (found, summary) = classify_positions(geometry.positions(), &axis, &Settings::default()).unwrap();
            let class: Vec<Class> = geometry
                .geometry_of_point()
                .iter()
                .map(|&g| if g == DROPPED { Class::Noise } else { found.class[g as usize] })
                .collect();
            let wall = score(&scan.truth.surface, &class, Surface::Wall, Class::Wall);
            assert!(wall.0 >= 0.99 && wall.1 >= 0.98, "{shape:?} {course:?} {seed}: wall {wall:?} {summary:?}");
            let furniture = score(&scan.truth.surface, &class, Surface::Furniture, Class::Furniture);
            assert!(furniture.0 >= 0.97 && furniture.1 >= 0.94, "{shape:?} {course:?} {seed}: furniture {furniture:?}");
            if matches!(shape, Shape::Horseshoe { .. }) {
                let floor = score(&scan.truth.surface, &class, Surface::Floor, Class::Floor);
                assert!(floor.0 >= 0.97 && floor.1 >= 0.97, "{shape:?} {course:?} {seed}: floor {floor:?} {summary:?}");
            }
        }
    }

    #[test]
    fn a_narrow_stretch_of_the_tunnel_is_wall() {
        // Between 12 and 16 m the tube is half a metre narrower all around.
        let points: Vec<Vec3> = (0..300_000)
            .map(|i| {
                let s = 30.0 * (f64::from(i) * 0.618_033_988_749_895).fract();
                let a = std::f64::consts::TAU * (f64::from(i) * 0.754_877_666_246_693).fract();
                let radius = if (12.0..16.0).contains(&s) { 2.0 } else { 2.5 };
                Vec3::new(s, radius * a.cos(), radius * a.sin())
            })
            .collect();
        let axis = Axis::through(&[Vec3::zeros(), Vec3::new(30.0, 0.0, 0.0)], 0.0).unwrap();
        let (found, summary) = classify_positions(&points, &axis, &Settings::default()).unwrap();
        let wall = found.class.iter().filter(|c| **c == Class::Wall).count();
        assert!(wall as f64 > 0.995 * points.len() as f64, "{summary:?}");
    }

    #[test]
    fn a_class_that_the_file_knows_is_believed() {
        let tunnel = Tunnel::smooth(Section::circle(2.0), Alignment::straight(10.0));
        let scan = scan(&tunnel, &ScanPlan { points: 40_000, ..ScanPlan::default() }).unwrap();
        let codes = FromClassification { furniture: vec![65], noise: vec![7, 18], ..FromClassification::default() };
        let table = codes.table().unwrap();
        let given = |i: usize| table[if i.is_multiple_of(10) { 65 } else { 1 }];
        let (found, summary) = classify(scan.cloud.positions(), given, &tunnel.axis(), &Settings::default()).unwrap();
        assert_eq!(summary.given_points, scan.cloud.len().div_ceil(10));
        assert!(found.class.iter().step_by(10).all(|c| *c == Class::Furniture));
        assert!(found.class[1..10].iter().all(|c| *c == Class::Wall));
        let twice = FromClassification { wall: vec![65], ..codes };
        assert_eq!(twice.table().unwrap_err(), Error::CodeTwice { code: 65 });
    }

    #[test]
    fn a_round_pipe_has_no_floor() {
        let tunnel = Tunnel::smooth(Section::circle(0.45), Alignment::straight(8.0));
        let scan = scan(&tunnel, &ScanPlan { points: 40_000, ..ScanPlan::default() }).unwrap();
        let (segmentation, summary) =
            classify_positions(scan.cloud.positions(), &tunnel.axis(), &Settings::default()).unwrap();
        assert!(!summary.has_floor && segmentation.floor.is_none());
        let wall = segmentation.class.iter().filter(|c| **c == Class::Wall).count();
        assert!(wall as f64 > 0.99 * segmentation.class.len() as f64, "{summary:?}");
    }
}
