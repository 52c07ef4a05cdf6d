//! A simulated terrestrial laser scanner: what stations in a tunnel would have measured, with the truth of each point.
//!
//! Points are drawn on the surface, not by casting a ray for each direction: a cell of the surface gets as many points
//! as the scanner's regular angular grid would put there (cos(incidence) / range^2), spread evenly, and a point is kept
//! when nothing stands between it and the station. The points of a station come in scan-line order.

use super::furniture::{Item, Sheet};
use super::tunnel::Tunnel;
use super::view::View;
use crate::cloud::{self, Attributes, Cloud, Label, ScanFrame, SourceFile, Station};
use crate::numeric::Vec3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Side of the cells in which points are spread evenly, metres.
const CELL_M: f64 = 0.25;

/// Visibility is probed at this many places squared in each cell before points are dealt out.
const PROBES: usize = 3;

/// Longest step of a line of sight between two tests against the bent section, metres.
const SIGHT_STEP_M: f64 = 0.75;

/// A line of sight counts as blocked when it runs this deep in the rock, metres.
const SIGHT_TOLERANCE_M: f64 = 0.01;

/// In section coordinates a line of sight through a bend is a curve; it is followed in pieces that leave the curve by
/// at most this, metres.
const SIGHT_SAGITTA_M: f64 = 0.01;

/// Distances before the wall at which a grazing line of sight is tested against the relief, metres.
const GRAZING_TESTS_M: [f64; 4] = [0.06, 0.15, 0.3, 0.6];

/// Steeper lines of sight (cosine of incidence above this) are not hidden by the relief they end on.
const GRAZING_COSINE: f64 = 0.7;

/// The mouth of a recess is met within this share of a line of sight.
const MOUTH_STEP: f64 = 1e-4;

/// Half the width of the beam, metres: a line of sight that grazes a bump by less still gives an echo.
const BEAM_M: f64 = 0.004;

/// Azimuth between two scan lines of the order in which points are written, degrees.
const SCAN_LINE_DEG: f64 = 0.25;

/// What a point was measured on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Surface {
    /// Rock or lining, roof included.
    Wall,
    /// The flat floor.
    Floor,
    /// Ducts, cables, rails, vehicles.
    Furniture,
    /// A side drift.
    Outside,
    /// Nothing: an outlier.
    Outlier,
}

/// How a tunnel is scanned.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanPlan {
    /// Number of points wanted; the scan has this many within a few percent.
    pub points: usize,
    /// Chainages of the scanner stations; empty: one every 10 m or so, evenly.
    pub station_chainages_m: Vec<f64>,
    /// Stations stand alternately this far right and left of the axis, metres.
    pub station_offset_m: f64,
    /// Height of the instrument above the floor (or below the crown of a section without floor: half way), metres.
    pub instrument_height_m: f64,
    /// Standard deviation of the measured range, metres.
    pub range_noise_m: f64,
    /// Share of the points that are outliers.
    pub outlier_share: f64,
    /// Nothing is measured beyond this range, metres.
    pub max_range_m: f64,
    /// Density does not grow further when the wall is closer than this, metres (as in scans thinned on delivery).
    pub saturation_range_m: f64,
    /// Half the opening of the blind cone below the instrument, degrees.
    pub nadir_cone_deg: f64,
    /// Whether points have colours.
    pub colored: bool,
    /// Where the local origin lies in the coordinates of the scan.
    pub origin_in_scan: Vec3,
    /// What is seen of the tunnel.
    pub view: View,
    /// Same seed, same scan.
    pub seed: u64,
}

impl Default for ScanPlan {
    fn default() -> Self {
        Self {
            points: 200_000,
            station_chainages_m: Vec::new(),
            station_offset_m: 0.4,
            instrument_height_m: 1.6,
            range_noise_m: 0.002,
            outlier_share: 0.0,
            max_range_m: 40.0,
            saturation_range_m: 3.0,
            nadir_cone_deg: 30.0,
            colored: true,
            origin_in_scan: Vec3::zeros(),
            view: View::default(),
            seed: 1,
        }
    }
}

/// What is known about each point of a [`SyntheticScan`]; columns as long as the cloud.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Truth {
    /// What the point was measured on.
    pub surface: Vec<Surface>,
    /// True chainage, metres; NaN for outliers.
    pub chainage_m: Vec<f64>,
    /// True girth from the crown, metres; NaN for what is not the swept section: furniture, recesses, outliers.
    pub girth_m: Vec<f64>,
    /// The fracture, 0 for none.
    pub label: Vec<Label>,
}

/// A simulated scan and its truth.
#[derive(Clone, Debug)]
pub struct SyntheticScan {
    /// As a file would give it: positions, colours, intensities, labels, stations.
    pub cloud: Cloud,
    /// What the file would not tell.
    pub truth: Truth,
}

/// Why a tunnel cannot be scanned as planned.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// A number of the plan is out of range.
    #[error("{setting} is {value}, but must be {must_be}")]
    Plan {
        /// Name of the setting.
        setting: &'static str,
        /// Its value.
        value: f64,
        /// The allowed range, in words.
        must_be: &'static str,
    },
    /// There is no room for something.
    #[error("there is no room for {what}: it needs {needs}; leave it out or choose another section")]
    NoRoom {
        /// The thing.
        what: &'static str,
        /// What it needs.
        needs: &'static str,
    },
    /// The columns do not form a cloud; a defect of the generator.
    #[error(transparent)]
    Cloud(#[from] cloud::Error),
}

/// One measured point.
#[derive(Clone, Copy, Debug)]
struct Shot {
    position: Vec3,
    surface: Surface,
    chainage: f64,
    girth: f64,
    label: Label,
    color: [u16; 3],
    intensity: u16,
}

/// What a line of sight ends on.
struct Hit {
    position: Vec3,
    normal: Vec3,
    in_section: [f64; 3],
}

/// What a target is a piece of.
enum Piece {
    /// The tunnel itself, in (chainage, girth).
    Tunnel,
    Furniture(Sheet),
    Recess(Sheet),
}

/// A rectangular piece of surface, divided into cells.
struct Target {
    piece: Piece,
    corner: [f64; 2],
    cell_size: [f64; 2],
    cells: [usize; 2],
    first_cell: usize,
}

impl Target {
    fn new(piece: Piece, corner: [f64; 2], size: [f64; 2], first_cell: usize) -> Self {
        let cells = size.map(|m| (m / CELL_M).ceil().max(1.0) as usize);
        let cell_size = [size[0] / cells[0] as f64, size[1] / cells[1] as f64];
        Self { piece, corner, cell_size, cells, first_cell }
    }

    fn count(&self) -> usize {
        self.cells[0] * self.cells[1]
    }

    /// The place at shares (x, y) of a cell.
    fn place(&self, cell: usize, x: f64, y: f64) -> [f64; 2] {
        let index = [cell / self.cells[1], cell % self.cells[1]];
        [0, 1].map(|i| self.corner[i] + (index[i] as f64 + [x, y][i]) * self.cell_size[i])
    }
}

impl Piece {
    fn sheet(&self) -> Option<&Sheet> {
        match self {
            Self::Tunnel => None,
            Self::Furniture(sheet) | Self::Recess(sheet) => Some(sheet),
        }
    }
}

/// A cell as one station sees it.
struct Deal {
    station: usize,
    target: usize,
    cell: usize,
    /// Points to draw before visibility.
    draws: usize,
    /// Some probe was hidden by rock: each point has to be tested.
    rock_hides: bool,
}

struct Scanner<'a> {
    tunnel: &'a Tunnel,
    plan: &'a ScanPlan,
    stations: Vec<Vec3>,
    stations_in_section: Vec<[f64; 3]>,
    targets: Vec<Target>,
}

/// Scans a tunnel.
///
/// # Errors
/// [`Error::Plan`] names a setting that is out of range.
pub fn scan(tunnel: &Tunnel, plan: &ScanPlan) -> Result<SyntheticScan, Error> {
    check(plan)?;
    let stations_in_section = stations(tunnel, plan);
    let stations = stations_in_section.iter().map(|s| local_point(tunnel, s)).collect();
    let size = [tunnel.length(), tunnel.section.perimeter()];
    let mut targets = vec![Target::new(Piece::Tunnel, [0.0, -tunnel.section.half_perimeter()], size, 0)];
    let furniture = tunnel.furniture.iter().enumerate().flat_map(|(k, item)| item.sheets(k)).map(Piece::Furniture);
    let recesses = tunnel.recesses.iter().enumerate().flat_map(|(k, r)| r.hollow.sheets(k)).map(Piece::Recess);
    for piece in furniture.chain(recesses) {
        let first = targets.last().map_or(0, |t| t.first_cell + t.count());
        let size = piece.sheet().map_or([0.0; 2], |s| s.size);
        targets.push(Target::new(piece, [0.0, 0.0], size, first));
    }
    let scanner = Scanner { tunnel, plan, stations, stations_in_section, targets };
    let deals = scanner.deal();
    let mut shots = Vec::with_capacity(scanner.stations.len());
    for of_station in deals.chunk_by(|a, b| a.station == b.station) {
        let measured: Vec<Vec<Shot>> = of_station.par_iter().map(|d| scanner.measure(d)).collect();
        let mut measured: Vec<Shot> = measured.into_iter().flatten().collect();
        scanner.sort_by_scan_line(of_station[0].station, &mut measured);
        shots.push((of_station[0].station, measured));
    }
    assemble(plan, &scanner.stations, shots)
}

fn check(plan: &ScanPlan) -> Result<(), Error> {
    let profile_m = plan.view.profile_m.unwrap_or(1.0);
    let rules = [
        ("points", plan.points as f64, plan.points > 0, "at least 1"),
        ("range_noise_m", plan.range_noise_m, (0.0..1.0).contains(&plan.range_noise_m), "from 0 to below 1"),
        ("outlier_share", plan.outlier_share, (0.0..1.0).contains(&plan.outlier_share), "from 0 to below 1"),
        ("max_range_m", plan.max_range_m, plan.max_range_m > 0.0, "positive"),
        ("saturation_range_m", plan.saturation_range_m, plan.saturation_range_m > 0.0, "positive"),
        ("gap share", plan.view.gap_share, (0.0..1.0).contains(&plan.view.gap_share), "from 0 to below 1"),
        ("profile_m", profile_m, profile_m > 0.0 && profile_m.is_finite(), "positive"),
        ("nadir_cone_deg", plan.nadir_cone_deg, (0.0..90.0).contains(&plan.nadir_cone_deg), "from 0 to below 90"),
    ];
    match rules.into_iter().find(|r| !r.2) {
        Some((setting, value, _, must_be)) => Err(Error::Plan { setting, value, must_be }),
        None => Ok(()),
    }
}

/// The stations in section coordinates.
fn stations(tunnel: &Tunnel, plan: &ScanPlan) -> Vec<[f64; 3]> {
    let up = tunnel.section.invert_up() + plan.instrument_height_m;
    // A section too low for the instrument, or without a floor to stand on, is scanned from its middle.
    let up = if tunnel.alignment.is_shaft() || tunnel.section.foot(0.0, up).outward > -0.3 { 0.0 } else { up };
    let mut chainages = plan.station_chainages_m.clone();
    if chainages.is_empty() {
        let count = (tunnel.length() / 10.0).round().max(1.0) as usize;
        chainages = (0..count).map(|k| tunnel.length() * (k as f64 + 0.5) / count as f64).collect();
    }
    let side = |k: usize| if k.is_multiple_of(2) { plan.station_offset_m } else { -plan.station_offset_m };
    chainages.iter().enumerate().map(|(k, &s)| [s, side(k), up]).collect()
}

fn local_point(tunnel: &Tunnel, in_section: &[f64; 3]) -> Vec3 {
    let frame = tunnel.frame_at(in_section[0]);
    frame.origin - frame.left * in_section[1] + frame.up * in_section[2]
}

impl Scanner<'_> {
    /// How many points each cell gets from each station, station by station.
    fn deal(&self) -> Vec<Deal> {
        let places: Vec<(usize, usize)> =
            self.targets.iter().enumerate().flat_map(|(t, target)| (0..target.count()).map(move |c| (t, c))).collect();
        let seen: Vec<(f64, f64, bool)> = (0..self.stations.len() * places.len())
            .into_par_iter()
            .map(|id| {
                let (target, cell) = places[id % places.len()];
                self.probe(id / places.len(), &self.targets[target], cell)
            })
            .collect();
        let total: f64 = seen.iter().map(|&(weight, share, _)| weight * share).sum();
        let mut deals = Vec::new();
        let (mut owed, mut given) = (0.0, 0.0);
        for (id, &(weight, share, rock_hides)) in seen.iter().enumerate() {
            if weight * share == 0.0 {
                continue;
            }
            owed += self.plan.points as f64 * weight * share / total;
            let draws = ((owed - given) / share).round().max(0.0);
            given += draws * share;
            if draws > 0.0 {
                let (target, cell) = places[id % places.len()];
                let station = id / places.len();
                deals.push(Deal { station, target, cell, draws: draws as usize, rock_hides });
            }
        }
        deals
    }

    /// Weight of a cell seen from a station if nothing were in the way, the share of its probes that are visible, and
    /// whether the bend of the tunnel hides a part.
    fn probe(&self, station: usize, target: &Target, cell: usize) -> (f64, f64, bool) {
        let middle = target.place(cell, 0.5, 0.5);
        let hit = self.hit(target, middle);
        let reach = target.cell_size[0] + target.cell_size[1];
        if (hit.position - self.stations[station]).norm() > self.plan.max_range_m + reach {
            return (0.0, 0.0, false);
        }
        let (mut weight, mut visible, mut rock_hides) = (0.0, 0, false);
        for i in 0..PROBES {
            for j in 0..PROBES {
                let share = |k: usize| (k as f64 + 0.5) / PROBES as f64;
                let at = target.place(cell, share(i), share(j));
                let hit = self.hit(target, at);
                let density = self.density(station, &hit);
                if density == 0.0 || !self.is_seen(target, at, &hit) {
                    rock_hides = true;
                    continue;
                }
                weight += density;
                if !self.rock_clear(station, target, &hit) {
                    rock_hides = true;
                } else if self.furniture_clear(station, &hit) && self.relief_clear(station, target, &hit) {
                    visible += 1;
                }
            }
        }
        let probes = (PROBES * PROBES) as f64;
        (weight / probes * target.cell_size[0] * target.cell_size[1], f64::from(visible) / probes, rock_hides)
    }

    /// The place of a target that a line of sight may end on.
    fn hit(&self, target: &Target, at: [f64; 2]) -> Hit {
        let (in_section, normal) = match self.item(target) {
            None => {
                let outward = self.tunnel.relief_at(at[0], at[1]);
                let o = self.tunnel.section.point(at[1]);
                let in_section = [at[0], o.right + o.outward[0] * outward, o.up + o.outward[1] * outward];
                (in_section, [0.0, -o.outward[0], -o.outward[1]])
            }
            Some((item, sheet)) => {
                let (place, out_of_box) = item.place(sheet, at[0], at[1]);
                // The walls of a recess are seen from the inside of its box.
                let inwards = matches!(target.piece, Piece::Recess(_));
                (place, if inwards { out_of_box.map(|n| -n) } else { out_of_box })
            }
        };
        let frame = self.tunnel.frame_at(in_section[0]);
        Hit {
            position: frame.origin - frame.left * in_section[1] + frame.up * in_section[2],
            normal: frame.forward * normal[0] - frame.left * normal[1] + frame.up * normal[2],
            in_section,
        }
    }

    /// The thing that a target is a sheet of, if it is no piece of the tunnel itself.
    fn item<'t>(&'t self, target: &'t Target) -> Option<(&'t Item, &'t Sheet)> {
        match &target.piece {
            Piece::Tunnel => None,
            Piece::Furniture(sheet) => Some((&self.tunnel.furniture[sheet.item], sheet)),
            Piece::Recess(sheet) => Some((&self.tunnel.recesses[sheet.item].hollow, sheet)),
        }
    }

    /// Whether the place belongs to what the scan sees.
    fn is_seen(&self, target: &Target, at: [f64; 2], hit: &Hit) -> bool {
        let [s, right, up] = hit.in_section;
        let foot = || self.tunnel.section.foot(right, up);
        let in_the_void = || {
            let foot = foot();
            foot.outward < self.tunnel.relief_at(s, foot.girth) + SIGHT_TOLERANCE_M
        };
        // Where a recess opens there is neither wall nor, in the void of the tunnel, a side of its box.
        let nothing_there = match target.piece {
            Piece::Tunnel => {
                !self.tunnel.is_floor(at[1]) && self.tunnel.recesses.iter().any(|r| r.holds(&hit.in_section))
            }
            Piece::Recess(_) => in_the_void(),
            Piece::Furniture(_) => false,
        };
        if nothing_there {
            return false;
        }
        // Gaps are patches of the wall; a thing in front of one is missing where the wall behind it would be.
        let girth = if let Piece::Tunnel = target.piece { at[1] } else { foot().girth };
        let crown_up = self.tunnel.section.point(0.0).up;
        self.plan.view.sees(&hit.in_section, girth, crown_up, self.plan.seed)
    }

    /// Points per square metre, up to a factor.
    fn density(&self, station: usize, hit: &Hit) -> f64 {
        let ray = hit.position - self.stations[station];
        let range = ray.norm();
        let cos_incidence = -ray.dot(&hit.normal) / range;
        let below = -ray.z / range;
        if range > self.plan.max_range_m || cos_incidence <= 0.0 || below > self.plan.nadir_cone_deg.to_radians().cos()
        {
            return 0.0;
        }
        cos_incidence / range.max(self.plan.saturation_range_m).powi(2)
    }

    /// Whether no rock is in the way before the last stretch: into a recess the line of sight leads through its mouth.
    fn rock_clear(&self, station: usize, target: &Target, hit: &Hit) -> bool {
        let Piece::Recess(sheet) = &target.piece else { return self.bend_clear(station, hit) };
        // The line leaves a convex section once; there it must be in the box, which is convex too.
        let (mut inside, mut outside) = (0.0, 1.0);
        while outside - inside > MOUTH_STEP {
            let middle = (inside + outside) / 2.0;
            let [_, right, up] = self.on_sight(station, hit, middle);
            if self.tunnel.section.foot(right, up).outward < 0.0 { inside = middle } else { outside = middle }
        }
        self.tunnel.recesses[sheet.item].holds(&self.on_sight(station, hit, outside))
    }

    /// Whether the line of sight stays in the void; only a bend can hide the wall of a convex section. The last stretch
    /// before the wall is left to [`Self::relief_clear`].
    fn bend_clear(&self, station: usize, hit: &Hit) -> bool {
        if self.tunnel.alignment.is_straight() {
            return true;
        }
        let length = (hit.position - self.stations[station]).norm();
        let steps = (length / SIGHT_STEP_M).ceil();
        (1..steps as usize).map(|k| k as f64 / steps).filter(|share| (1.0 - share) * length > 0.5).all(|share| {
            let [s, right, up] = self.on_sight(station, hit, share);
            let foot = self.tunnel.section.foot(right, up);
            foot.outward < SIGHT_TOLERANCE_M || foot.outward < self.tunnel.relief_at(s, foot.girth) + SIGHT_TOLERANCE_M
        })
    }

    /// Section coordinates of the point at a share of the line of sight.
    fn on_sight(&self, station: usize, hit: &Hit, share: f64) -> [f64; 3] {
        let from = &self.stations_in_section[station];
        let straight = [0, 1, 2].map(|i| from[i] + (hit.in_section[i] - from[i]) * share);
        if self.tunnel.alignment.is_straight() {
            return straight;
        }
        let point = self.stations[station] + (hit.position - self.stations[station]) * share;
        self.tunnel.alignment.project_near(&point, straight[0])
    }

    /// Whether no duct, cable or vehicle is in the way.
    fn furniture_clear(&self, station: usize, hit: &Hit) -> bool {
        if self.tunnel.furniture.is_empty() {
            return true;
        }
        let run = (hit.in_section[0] - self.stations_in_section[station][0]).abs();
        let bend = self.tunnel.alignment.sharpest_curvature();
        // Sagitta of a chord: run^2 / 8 radius.
        let pieces = (run * (bend / (8.0 * SIGHT_SAGITTA_M)).sqrt()).ceil().max(1.0);
        let length = (hit.position - self.stations[station]).norm();
        let mut from = self.stations_in_section[station];
        for k in 1..=pieces as usize {
            // The line ends a little short of what it is to hit.
            let share = if k == pieces as usize { 1.0 - 1e-3 / length } else { k as f64 / pieces };
            let to = self.on_sight(station, hit, share);
            if self.tunnel.furniture.iter().any(|item| item.blocks(&from, &to)) {
                return false;
            }
            from = to;
        }
        true
    }

    /// Whether a grazing line of sight passes the bumps just before the wall.
    fn relief_clear(&self, station: usize, target: &Target, hit: &Hit) -> bool {
        if self.tunnel.relief.is_none() || !matches!(target.piece, Piece::Tunnel) {
            return true;
        }
        let ray = hit.position - self.stations[station];
        let length = ray.norm();
        if -ray.dot(&hit.normal) / length > GRAZING_COSINE {
            return true;
        }
        GRAZING_TESTS_M.iter().filter(|&&d| d < length).all(|d| {
            let [s, right, up] = self.on_sight(station, hit, 1.0 - d / length);
            let foot = self.tunnel.section.foot(right, up);
            foot.outward < self.tunnel.relief_at(s, foot.girth) + BEAM_M
        })
    }

    /// The points of one cell.
    fn measure(&self, deal: &Deal) -> Vec<Shot> {
        let target = &self.targets[deal.target];
        let cell_count = self.targets.last().map_or(0, |t| t.first_cell + t.count());
        let mut random = ChaCha8Rng::seed_from_u64(self.plan.seed);
        random.set_stream((deal.station * cell_count + target.first_cell + deal.cell) as u64);
        let mut place = [random.random::<f64>(), random.random::<f64>()];
        let mut shots = Vec::with_capacity(deal.draws);
        for _ in 0..deal.draws {
            // The R2 sequence: evenly spread for any number of points.
            place = [(place[0] + 0.754_877_666_246_692_8).fract(), (place[1] + 0.569_840_290_998_053_3).fract()];
            let at = target.place(deal.cell, place[0], place[1]);
            let item = self.item(target).map(|(item, sheet)| (item, sheet.axis()));
            let Some(at) = self.plan.view.on_profile(at, item) else { continue };
            let hit = self.hit(target, at);
            if self.density(deal.station, &hit) == 0.0
                || !self.is_seen(target, at, &hit)
                || (deal.rock_hides && !self.rock_clear(deal.station, target, &hit))
                || !self.furniture_clear(deal.station, &hit)
                || !self.relief_clear(deal.station, target, &hit)
            {
                continue;
            }
            shots.push(self.shoot(deal.station, target, at, &hit, &mut random));
        }
        shots
    }

    fn shoot(&self, station: usize, target: &Target, at: [f64; 2], hit: &Hit, random: &mut ChaCha8Rng) -> Shot {
        let from = self.stations[station];
        let noise = self.plan.range_noise_m * gauss(random);
        let speckle = gauss(random);
        if random.random::<f64>() < self.plan.outlier_share {
            // A false echo somewhere on the ray, short of the wall or a little behind it.
            let position = from + (hit.position - from) * random.random_range(0.3..1.15);
            let (chainage, girth) = (f64::NAN, f64::NAN);
            let color = [0.4, 0.4, 0.42].map(sixteen_bits);
            return Shot { position, surface: Surface::Outlier, chainage, girth, label: 0, color, intensity: 2_000 };
        }
        let (position, normal, surface, girth, label, color, reflectance) = match self.item(target) {
            None => {
                let w = self.tunnel.wall_at(at[0], at[1]);
                let surface = if w.is_floor { Surface::Floor } else { Surface::Wall };
                (w.position, w.normal, surface, at[1], w.label, w.color, w.reflectance)
            }
            Some((item, sheet)) => {
                let surface = match &target.piece {
                    Piece::Recess(_) if self.tunnel.recesses[sheet.item].leads_away => Surface::Outside,
                    Piece::Recess(_) => Surface::Wall,
                    _ => Surface::Furniture,
                };
                (hit.position, hit.normal, surface, f64::NAN, 0, item.color(), 0.6)
            }
        };
        let ray = position - from;
        let range = ray.norm();
        let cos_incidence = (-ray.dot(&normal) / range).clamp(0.0, 1.0);
        let intensity = reflectance * (0.35 + 0.65 * cos_incidence) / (1.0 + range / 60.0) * (1.0 + 0.03 * speckle);
        let color = color.map(|c| sixteen_bits(c * (1.0 + 0.012 * speckle)));
        Shot {
            position: position + ray * (noise / range),
            surface,
            chainage: hit.in_section[0],
            girth,
            label,
            color,
            // 12 bits, as most instruments deliver.
            intensity: (intensity * 4095.0).round().clamp(0.0, 4095.0) as u16 * 16,
        }
    }

    /// The order of a spinning scanner: azimuth line by azimuth line, up one and down the next.
    fn sort_by_scan_line(&self, station: usize, shots: &mut [Shot]) {
        let from = self.stations[station];
        let key = |shot: &Shot| {
            let ray = shot.position - from;
            let line = (ray.y.atan2(ray.x).to_degrees() / SCAN_LINE_DEG).floor();
            let elevation = ray.z.atan2(ray.x.hypot(ray.y));
            (line, if line as i64 % 2 == 0 { elevation } else { -elevation })
        };
        shots.par_sort_by(|a, b| {
            let (a, b) = (key(a), key(b));
            a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
        });
    }
}

/// A share from 0 to 1 as 8 bits in a 16-bit field, as cameras deliver.
fn sixteen_bits(share: f64) -> u16 {
    (share * 255.0).round().clamp(0.0, 255.0) as u16 * 257
}

/// A standard normal number (Box and Muller).
fn gauss(random: &mut ChaCha8Rng) -> f64 {
    let u: f64 = 1.0 - random.random::<f64>();
    let v: f64 = random.random();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

fn assemble(plan: &ScanPlan, stations: &[Vec3], shots: Vec<(usize, Vec<Shot>)>) -> Result<SyntheticScan, Error> {
    let station_ids: Vec<u16> = shots.iter().flat_map(|(k, s)| std::iter::repeat_n(*k as u16, s.len())).collect();
    let shots: Vec<Shot> = shots.into_iter().flat_map(|(_, s)| s).collect();
    let attributes = Attributes {
        colors: plan.colored.then(|| shots.iter().map(|s| s.color).collect()),
        intensities: Some(shots.iter().map(|s| s.intensity).collect()),
        labels: Some(shots.iter().map(|s| s.label).collect()),
        source_ids: Some(station_ids.iter().map(|k| k + 1).collect()),
        station_ids: Some(station_ids),
        classifications: None,
    };
    let source = SourceFile {
        path: "synthetic".into(),
        first_point: 0,
        point_count: shots.len(),
        record_count: shots.len() as u64,
        dropped_records: Default::default(),
    };
    let named = stations
        .iter()
        .enumerate()
        .map(|(k, &p)| Station { name: format!("station {}", k + 1), position_in_local: Some(p) })
        .collect();
    let frame = ScanFrame::with_origin(plan.origin_in_scan);
    let positions = shots.iter().map(|s| s.position).collect();
    let truth = Truth {
        surface: shots.iter().map(|s| s.surface).collect(),
        chainage_m: shots.iter().map(|s| s.chainage).collect(),
        girth_m: shots.iter().map(|s| s.girth).collect(),
        label: shots.iter().map(|s| s.label).collect(),
    };
    Ok(SyntheticScan { cloud: Cloud::new(frame, positions, attributes, vec![source], named)?, truth })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Alignment, Item, Recess, Section, SectionPoint};

    fn quiet(points: usize) -> ScanPlan {
        ScanPlan { points, range_noise_m: 0.0, ..ScanPlan::default() }
    }

    #[test]
    fn points_lie_where_the_truth_says() {
        for a in [Alignment::straight(20.0), Alignment::bend(20.0, 12.0), Alignment::shaft(15.0)] {
            let tunnel = Tunnel::smooth(Section::horseshoe(4.6, 4.2), a);
            let scan = scan(&tunnel, &quiet(5_000)).unwrap();
            assert!((scan.cloud.len() as f64 / 5_000.0 - 1.0).abs() < 0.03, "{}", scan.cloud.len());
            for (i, p) in scan.cloud.positions().iter().enumerate() {
                let (s, g) = (scan.truth.chainage_m[i], scan.truth.girth_m[i]);
                let q = SectionPoint { chainage: s, girth: g, outward: 0.0 };
                assert!((p - tunnel.point_at(&q)).norm() < 1e-9);
            }
        }
    }

    #[test]
    fn a_crosscut_is_seen_through_its_mouth_only() {
        let tunnel =
            |recesses| Tunnel { recesses, ..Tunnel::smooth(Section::horseshoe(4.6, 4.2), Alignment::straight(20.0)) };
        let plan = ScanPlan { station_chainages_m: vec![4.0], station_offset_m: 0.0, ..quiet(40_000) };
        let crosscut = Recess::crosscut([9.0, -2.1], [2.5, 2.5], 8.3);
        let SyntheticScan { cloud, truth } = scan(&tunnel(vec![crosscut.clone()]), &plan).unwrap();
        let in_section: Vec<[f64; 3]> = cloud.positions().iter().map(|p| [p.x, -p.y, p.z]).collect();
        let behind = |k: usize| in_section[k][1] > 2.3 + 1e-9;
        let seen: Vec<usize> = (0..cloud.len()).filter(|&k| behind(k)).collect();
        assert!(seen.len() > 150, "{}", seen.len());
        for &k in &seen {
            assert!(truth.surface[k] == Surface::Outside && truth.girth_m[k].is_nan());
            // The ray meets the wall at right = 2.3 inside the mouth; the near cheek faces away from the station.
            let [s, right, up] = in_section[k];
            let share = 2.3 / right;
            let (at_s, at_up) = (4.0 + (s - 4.0) * share, -0.5 + (up + 0.5) * share);
            assert!((9.0..11.5).contains(&at_s) && (-2.1..0.41).contains(&at_up), "{s} {right} {up}");
            assert!(s > 9.01, "the near cheek");
        }
        // Below the springline, where the wall stands at right = 2.3.
        let in_mouth = |p: &[f64; 3]| (9.01..11.49).contains(&p[0]) && (-2.05..-0.2).contains(&p[2]);
        let on_the_wall = |p: &[f64; 3]| (p[1] - 2.3).abs() < 1e-6;
        assert!(!in_section.iter().any(|p| in_mouth(p) && on_the_wall(p)), "wall in the mouth");
        assert!(
            in_section.iter().any(|p| (9.0..11.5).contains(&p[0]) && p[1] > 1.0 && p[2] < -2.09),
            "the floor stays"
        );
        let niche = Recess { leads_away: false, ..crosscut };
        let scan = scan(&tunnel(vec![niche]), &plan).unwrap();
        assert!(seen.iter().all(|&k| scan.truth.surface[k] == Surface::Wall));
    }

    #[test]
    fn a_bend_hides_the_far_end() {
        // From chainage 1 of a tight bend the outer wall 25 m further is behind the inner wall.
        let tunnel = Tunnel::smooth(Section::circle(2.0), Alignment::bend(30.0, 12.0));
        let plan = ScanPlan { station_chainages_m: vec![1.0], station_offset_m: 0.0, ..quiet(5_000) };
        let scan = scan(&tunnel, &plan).unwrap();
        let farthest = scan.truth.chainage_m.iter().copied().fold(0.0, f64::max);
        // The tangent from the axis to the inner wall (radius 10) and on to the outer wall (radius 14).
        let turn = (10.0_f64 / 12.0).acos() + (10.0_f64 / 14.0).acos();
        assert!(farthest < 1.0 + 12.0 * turn + 0.1, "{farthest}");
        assert!(farthest > 1.0 + 12.0 * turn - 2.0, "{farthest}");
    }

    #[test]
    fn the_cone_below_the_instrument_stays_empty() {
        let tunnel = Tunnel::smooth(Section::horseshoe(4.6, 4.2), Alignment::straight(10.0));
        let plan = ScanPlan { station_chainages_m: vec![5.0], station_offset_m: 0.0, ..quiet(20_000) };
        let scan = scan(&tunnel, &plan).unwrap();
        let radius = 1.6 * 30.0_f64.to_radians().tan();
        let foot = tunnel.frame_at(5.0).origin + Vec3::z() * tunnel.section.invert_up();
        let closest = scan.cloud.positions().iter().map(|p| (p - foot).norm()).fold(f64::MAX, f64::min);
        assert!(closest > radius - 1e-9 && closest < radius + 0.1, "{closest} {radius}");
    }

    #[test]
    fn noise_has_the_stated_size() {
        let tunnel = Tunnel::smooth(Section::circle(2.0), Alignment::straight(10.0));
        let plan = ScanPlan { points: 20_000, range_noise_m: 0.003, ..ScanPlan::default() };
        let scan = scan(&tunnel, &plan).unwrap();
        let stations = scan.cloud.stations();
        let mut sum = 0.0;
        for (i, p) in scan.cloud.positions().iter().enumerate() {
            let hit = tunnel.surface_point(scan.truth.chainage_m[i], scan.truth.girth_m[i]);
            let from =
                stations[scan.cloud.attributes().station_ids.as_ref().unwrap()[i] as usize].position_in_local.unwrap();
            sum += ((p - from).norm() - (hit - from).norm()).powi(2);
        }
        let sigma = (sum / scan.cloud.len() as f64).sqrt();
        assert!((sigma / 0.003 - 1.0).abs() < 0.03, "{sigma}");
    }

    #[test]
    fn density_falls_with_range_and_incidence() {
        let tunnel = Tunnel::smooth(Section::circle(2.0), Alignment::straight(20.0));
        let plan = ScanPlan {
            station_chainages_m: vec![0.5],
            station_offset_m: 0.0,
            instrument_height_m: 2.0,
            nadir_cone_deg: 0.0,
            saturation_range_m: 0.5,
            ..quiet(50_000)
        };
        let scan = scan(&tunnel, &plan).unwrap();
        let within = |from: f64, to: f64| {
            let inside = |s: &&f64| (from..to).contains(*s);
            scan.truth.chainage_m.iter().filter(inside).count() as f64
        };
        // On the wall of a cylinder cos / range^2 = r / (r^2 + d^2)^(3/2), whose integral is d / (r sqrt(r^2 + d^2)).
        let integral = |d: f64| d / (4.0 + d * d).sqrt();
        let expected = (integral(9.5) - integral(4.5)) / (integral(4.5) - integral(1.5));
        let found = within(5.0, 10.0) / within(2.0, 5.0);
        assert!((found / expected - 1.0).abs() < 0.1, "{found} {expected}");
    }

    #[test]
    fn furniture_is_seen_and_casts_shadows() {
        let mut tunnel = Tunnel::smooth(Section::horseshoe(4.6, 4.2), Alignment::bend(12.0, 30.0));
        tunnel.furniture.push(Item::duct(12.0, 1.0, 1.25, 0.25));
        tunnel.furniture.extend(Item::vehicle(8.0, -1.0, tunnel.section.invert_up()));
        let plan = ScanPlan { station_chainages_m: vec![3.0], station_offset_m: 0.0, ..quiet(20_000) };
        let scan = scan(&tunnel, &plan).unwrap();
        let station = scan.cloud.stations()[0].position_in_local.unwrap();
        let count = |surface| scan.truth.surface.iter().filter(|&&s| s == surface).count();
        assert!(count(Surface::Furniture) > 1_000 && count(Surface::Floor) > 500);
        let from = {
            let (s, r, u) = tunnel.alignment.project(&station);
            [s, r, u]
        };
        let mut behind_duct = 0;
        for (i, p) in scan.cloud.positions().iter().enumerate() {
            let (s, right, up) = tunnel.alignment.project(p);
            if scan.truth.surface[i] == Surface::Furniture {
                let on_duct = ((right - 1.0).hypot(up - 1.25) - 0.25).abs() < 1e-9;
                assert!(on_duct || (s > 5.6 && s < 10.4), "{s} {right} {up}");
            } else if (s - 3.0).abs() < 0.3 {
                // Near the station the line of sight is straight in section coordinates too.
                behind_duct += usize::from(tunnel.furniture[0].blocks(&from, &[s, right, up]));
            }
        }
        assert_eq!(behind_duct, 0);
    }

    #[test]
    fn outliers_are_marked() {
        let tunnel = Tunnel::smooth(Section::circle(2.0), Alignment::straight(10.0));
        let scan = scan(&tunnel, &ScanPlan { outlier_share: 0.05, ..quiet(10_000) }).unwrap();
        let share =
            scan.truth.surface.iter().filter(|&&s| s == Surface::Outlier).count() as f64 / scan.cloud.len() as f64;
        assert!((share - 0.05).abs() < 0.01, "{share}");
        assert!(
            scan.truth.surface.iter().zip(&scan.truth.girth_m).all(|(s, g)| (*s == Surface::Outlier) == g.is_nan())
        );
    }

    #[test]
    fn same_seed_same_scan_on_any_number_of_threads() {
        let tunnel = Tunnel::smooth(Section::horseshoe(4.6, 4.2), Alignment::bend(12.0, 20.0));
        let plan = ScanPlan { outlier_share: 0.01, ..quiet(3_000) };
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| scan(&tunnel, &plan).unwrap().cloud)
        };
        assert_eq!(on(1), on(2));
        let other = ScanPlan { seed: 2, ..plan.clone() };
        assert_ne!(on(1), scan(&tunnel, &other).unwrap().cloud);
    }

    #[test]
    fn impossible_plans_are_refused() {
        let tunnel = Tunnel::smooth(Section::circle(2.0), Alignment::straight(10.0));
        let e = scan(&tunnel, &quiet(0)).unwrap_err();
        assert_eq!(e.to_string(), "points is 0, but must be at least 1");
    }
}
