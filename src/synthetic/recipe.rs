//! A synthetic scan from a few numbers: what `adit synth` makes, and by default the bundled sample.

use super::alignment::{Alignment, Stretch};
use super::furniture::Item;
use super::lettering::Wall;
use super::recess::Recess;
use super::scanner::{Error, ScanPlan};
use super::section::Section;
use super::tunnel::Tunnel;
use super::view::View;
use crate::numeric::Vec3;

/// Clearance between what hangs in the tunnel and the smooth wall, metres.
const CLEARANCE_M: f64 = 0.16;

/// Radius of the ventilation duct, metres.
const DUCT_RADIUS_M: f64 = 0.24;

/// Mouth of a crosscut, along the tunnel and up, and its depth behind the wall, metres.
const CROSSCUT_M: [f64; 3] = [2.5, 2.5, 6.0];

/// The same of a niche.
const NICHE_M: [f64; 3] = [2.0, 2.0, 1.0];

/// Half the width that a parked vehicle needs, metres.
const VEHICLE_HALF_WIDTH_M: f64 = 0.8;

/// The shape of the section.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Flat floor, vertical walls, semicircular roof.
    Horseshoe {
        /// Width, metres.
        width_m: f64,
        /// Height, metres.
        height_m: f64,
    },
    /// A circle.
    Circle {
        /// Radius, metres.
        radius_m: f64,
    },
    /// An ellipse.
    Ellipse {
        /// Width, metres.
        width_m: f64,
        /// Height, metres.
        height_m: f64,
    },
}

/// The course of the axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Course {
    /// Level and straight.
    Straight,
    /// Level, a constant bend (radius positive to the left).
    Bend,
    /// Straight with a gradient.
    Ramp,
    /// A constant bend with a gradient.
    Helix,
    /// Straight down.
    Shaft,
}

/// What may stand and hang in the tunnel, and be cut into its walls.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A ventilation duct below the roof on the right.
    Duct,
    /// Three cables on the left wall.
    Cables,
    /// Two rails on the floor.
    Rails,
    /// A parked pick-up on the left.
    Vehicle,
    /// A side drift through the right wall, 2.5 m wide and high and 6 m deep.
    Crosscut,
    /// A recess in the left wall, 2 m wide and high and 1 m deep.
    Niche,
}

/// Everything that decides a synthetic scan. The default is the bundled sample.
#[derive(Clone, Debug, PartialEq)]
pub struct Recipe {
    /// Shape and size of the section.
    pub shape: Shape,
    /// Course of the axis.
    pub course: Course,
    /// Length along the axis, metres.
    pub length_m: f64,
    /// Bend radius in plan, metres, positive to the left; for bends and helices.
    pub radius_m: f64,
    /// Rise in percent; for ramps and helices.
    pub gradient_percent: f64,
    /// Azimuth at the start, degrees clockwise from north.
    pub azimuth_deg: f64,
    /// Typical height of the wall's roughness, metres; 0 for smooth walls.
    pub roughness_m: f64,
    /// Whether there are fractures.
    pub fractures: bool,
    /// Text on the right and on the left wall; empty for none.
    pub lettering: [String; 2],
    /// What stands in the way.
    pub furniture: Vec<Kind>,
    /// Number of scanner stations, spread evenly.
    pub stations: usize,
    /// Number of points, about.
    pub points: usize,
    /// Standard deviation of the range, metres.
    pub noise_m: f64,
    /// Share of outliers.
    pub outlier_share: f64,
    /// Whether points have colours; the intensity remains.
    pub colored: bool,
    /// Origin of the tunnel in the coordinates of the scan.
    pub origin_in_scan: Vec3,
    /// What the scan sees of the tunnel.
    pub view: View,
    /// Same seed, same scan.
    pub seed: u64,
}

impl Default for Recipe {
    fn default() -> Self {
        Self {
            shape: Shape::Horseshoe { width_m: 4.6, height_m: 4.2 },
            course: Course::Bend,
            length_m: 22.0,
            radius_m: 45.0,
            gradient_percent: 0.0,
            azimuth_deg: 68.0,
            roughness_m: 0.05,
            fractures: true,
            lettering: ["ADIT 12 R".into(), "L".into()],
            furniture: vec![Kind::Cables, Kind::Vehicle],
            stations: 3,
            points: 300_000,
            noise_m: 0.002,
            outlier_share: 0.002,
            colored: true,
            // Coordinates as large as those of a national grid: they must survive every step.
            origin_in_scan: Vec3::new(568_200.0, 6_642_300.0, 148.0),
            view: View::default(),
            seed: 12,
        }
    }
}

impl Recipe {
    /// The tunnel of the recipe.
    ///
    /// # Errors
    /// [`Error::Plan`] names a number that is out of range, or furniture that does not fit.
    pub fn tunnel(&self) -> Result<Tunnel, Error> {
        let (width, height) = self.size();
        require("section", width.min(height), width.min(height) > 0.5, "more than 0.5 m wide and high")?;
        require("length_m", self.length_m, self.length_m > 0.0 && self.length_m.is_finite(), "positive")?;
        let half = width / 2.0;
        let bends = matches!(self.course, Course::Bend | Course::Helix);
        require("radius_m", self.radius_m, !bends || self.radius_m.abs() > half, "larger than half the width")?;
        let gradient = if matches!(self.course, Course::Ramp | Course::Helix) { self.gradient_percent } else { 0.0 };
        require("gradient_percent", gradient, gradient.abs() < 250.0, "between -250 and 250")?;
        let roughness = self.roughness_m;
        require(
            "roughness_m",
            roughness,
            (0.0..0.1 * half).contains(&roughness),
            "from 0 to a twentieth of the width",
        )?;
        let section = match self.shape {
            Shape::Horseshoe { width_m, height_m } => Section::horseshoe(width_m, height_m),
            Shape::Circle { radius_m } => Section::circle(radius_m),
            Shape::Ellipse { width_m, height_m } => Section::ellipse(width_m, height_m),
        };
        let curvature_per_m = if bends { 1.0 / self.radius_m } else { 0.0 };
        let pitch = if self.course == Course::Shaft { -90.0 } else { (gradient / 100.0).atan().to_degrees() };
        let stretch = Stretch { length_m: self.length_m, curvature_per_m };
        let alignment =
            Alignment::new(vec![stretch], pitch).expect("checked above").placed(Vec3::zeros(), self.azimuth_deg);
        let mut tunnel = Tunnel::rock_drift(section, alignment, roughness, self.seed);
        if !self.fractures {
            tunnel.fractures.clear();
        }
        for letters in &mut tunnel.lettering {
            let text = &self.lettering[usize::from(letters.wall == Wall::Left)];
            letters.text.clone_from(text);
        }
        tunnel.lettering.retain(|l| !l.text.is_empty());
        for &kind in &self.furniture {
            self.furnish(&mut tunnel, kind)?;
        }
        Ok(tunnel)
    }

    /// How the tunnel is scanned.
    ///
    /// # Errors
    /// [`Error::Plan`] when there is no station.
    pub fn plan(&self) -> Result<ScanPlan, Error> {
        require("stations", self.stations as f64, self.stations > 0, "at least 1")?;
        let chainage = |k: usize| self.length_m * (k as f64 + 0.5) / self.stations as f64;
        Ok(ScanPlan {
            points: self.points,
            station_chainages_m: (0..self.stations).map(chainage).collect(),
            range_noise_m: self.noise_m,
            outlier_share: self.outlier_share,
            origin_in_scan: self.origin_in_scan,
            seed: self.seed,
            view: self.view,
            colored: self.colored,
            ..ScanPlan::default()
        })
    }

    fn size(&self) -> (f64, f64) {
        match self.shape {
            Shape::Horseshoe { width_m, height_m } | Shape::Ellipse { width_m, height_m } => (width_m, height_m),
            Shape::Circle { radius_m } => (2.0 * radius_m, 2.0 * radius_m),
        }
    }

    fn furnish(&self, tunnel: &mut Tunnel, kind: Kind) -> Result<(), Error> {
        let half = tunnel.section.half_perimeter();
        let (length, floor_up) = (tunnel.length(), tunnel.section.invert_up());
        let inside = |girth: f64, distance: f64| {
            let o = tunnel.section.point(girth);
            (o.right - distance * o.outward[0], o.up - distance * o.outward[1])
        };
        let (width, height) = self.size();
        match kind {
            Kind::Duct => {
                room("a duct", width.min(height) > 2.0, "a section of at least 2 m")?;
                let (right, up) = inside(0.2 * half, CLEARANCE_M + DUCT_RADIUS_M);
                tunnel.furniture.push(Item::duct(length, right, up, DUCT_RADIUS_M));
            }
            Kind::Cables => {
                for k in 0..3 {
                    let (right, up) = inside(-(0.36 + 0.012 * f64::from(k)) * half, CLEARANCE_M);
                    tunnel.furniture.push(Item::cable(length, right, up));
                }
            }
            Kind::Rails => {
                let flat = tunnel.section.floor_girth().is_some();
                room("rails", flat && width > 2.0, "a flat floor of at least 2 m")?;
                tunnel.furniture.extend(Item::rails(length, 0.9, floor_up));
            }
            Kind::Vehicle => {
                let flat = tunnel.section.floor_girth().is_some();
                let fits = flat && width > 3.0 && height > 2.4 && length > 8.0;
                room("a vehicle", fits, "a flat floor of at least 3 m x 8 m and a roof above 2.4 m")?;
                let right = -(width / 2.0 - VEHICLE_HALF_WIDTH_M - 0.45);
                tunnel.furniture.extend(Item::vehicle(0.70 * length, right, floor_up));
            }
            Kind::Crosscut => tunnel.recesses.push(Recess::crosscut(
                self.mouth(tunnel, "a crosscut", 0.62, CROSSCUT_M)?,
                [CROSSCUT_M[0], CROSSCUT_M[1]],
                width / 2.0 + CROSSCUT_M[2],
            )),
            Kind::Niche => tunnel.recesses.push(Recess::niche(
                self.mouth(tunnel, "a niche", 0.40, NICHE_M)?,
                [NICHE_M[0], NICHE_M[1]],
                width / 2.0 + NICHE_M[2],
            )),
        }
        Ok(())
    }

    /// Lowest (chainage, up) of a mouth of this size whose middle lies at a share of the length, on the floor if it is flat.
    fn mouth(
        &self,
        tunnel: &Tunnel,
        what: &'static str,
        share: f64,
        [along, high, _]: [f64; 3],
    ) -> Result<[f64; 2], Error> {
        let (_, height) = self.size();
        room(
            what,
            height > 1.2 * high && tunnel.length() > 4.0 * along,
            "a section of at least 3 m and 10 m of length",
        )?;
        let floor = tunnel.section.floor_girth().map(|_| tunnel.section.invert_up());
        Ok([share * tunnel.length() - along / 2.0, floor.unwrap_or(-high / 2.0)])
    }
}

fn require(setting: &'static str, value: f64, holds: bool, must_be: &'static str) -> Result<(), Error> {
    if holds { Ok(()) } else { Err(Error::Plan { setting, value, must_be }) }
}

fn room(what: &'static str, fits: bool, needs: &'static str) -> Result<(), Error> {
    if fits { Ok(()) } else { Err(Error::NoRoom { what, needs }) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::scan;

    #[test]
    fn every_shape_and_course_can_be_scanned() {
        let shapes = [
            Shape::Horseshoe { width_m: 4.6, height_m: 4.2 },
            Shape::Circle { radius_m: 1.5 },
            Shape::Ellipse { width_m: 3.0, height_m: 4.0 },
        ];
        for shape in shapes {
            for course in [Course::Straight, Course::Bend, Course::Ramp, Course::Helix, Course::Shaft] {
                let furniture = vec![Kind::Cables];
                let recipe = Recipe {
                    shape,
                    course,
                    gradient_percent: 10.0,
                    points: 2_000,
                    furniture,
                    length_m: 10.0,
                    ..Default::default()
                };
                let scan = scan(&recipe.tunnel().unwrap(), &recipe.plan().unwrap()).unwrap();
                assert!((scan.cloud.len() as f64 / 2_000.0 - 1.0).abs() < 0.1, "{recipe:?} {}", scan.cloud.len());
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let recipe =
            Recipe { shape: Shape::Circle { radius_m: 1.0 }, furniture: vec![Kind::Vehicle], ..Default::default() };
        assert!(matches!(recipe.tunnel().unwrap_err(), Error::NoRoom { what: "a vehicle", .. }));
        assert!(Recipe { radius_m: 2.0, ..Default::default() }.tunnel().is_err());
        assert!(Recipe { stations: 0, ..Default::default() }.plan().is_err());
    }
}
