//! What the map is like metre by metre along the tunnel: where a limit is broken, not only whether.
//!
//! Everything is counted on the finished map: faces and points belong to the metre that their chainage on the map falls
//! into; coverage is counted on the columns of `map/coverage.png`. Metres with less than a quarter of the usual surface
//! (the portals) are told, but are neither worst nor part of a quantile.

use crate::axis::AxisCoordinates;
use crate::mesh::{FaceId, Mesh};
use crate::numeric::{Vec2, statistics};
use crate::segment::SectionField;
use crate::unwrap::{Chart, distortion};
use crate::warning::Warning;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What is told along the tunnel, in the report and on its page.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Length of the pieces along the tunnel that are told apart, metres; long tunnels get longer ones (at most 2000).
    pub step_m: f64,
    /// Chainages (metres) of the sections that the report shows. Without any, `section_count` are spread evenly.
    pub sections_m: Vec<f64>,
    /// How many sections are shown when `sections_m` names none.
    pub section_count: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { step_m: 1.0, sections_m: Vec::new(), section_count: 6 }
    }
}

/// No report tells more pieces.
const MOST_PIECES: f64 = 2000.0;
/// A piece with less than this share of the usual surface is a portal.
const PORTAL_SHARE: f64 = 0.25;
/// Directions of a section.
const SECTION_POINTS: usize = 180;
/// Points farther from the surface than this (metres) are furniture, not noise.
const MOST_NOISE_M: f64 = 0.3;
/// Turns a median deviation into the standard deviation of a normal distribution.
const SIGMA_PER_MEDIAN_DEVIATION: f64 = 1.4826;
/// Bars of a histogram.
const BARS: usize = 40;

/// The section `profile` of the report.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Profile {
    /// Length of a piece, metres.
    pub step_m: f64,
    /// Chainage at the start of each piece, metres.
    pub chainage_m: Vec<f64>,
    /// Surface of each piece, square metres.
    pub area_m2: Vec<f64>,
    /// Observed share of each piece of the map, percent; null where the map has no coverage layer.
    pub coverage_percent: Vec<Option<f64>>,
    /// Stretch that 95 % of the piece keep to.
    pub stretch_p95: Vec<Option<f64>>,
    /// Faces mirrored or collapsed on the map.
    pub flipped_faces: Vec<Option<f64>>,
    /// Surface that no point supports, percent.
    pub filled_percent: Vec<Option<f64>>,
    /// Points for each square metre of surface.
    pub density_per_m2: Vec<Option<f64>>,
    /// Scatter of the points about the surface, metres.
    pub noise_m: Vec<Option<f64>>,
    /// The piece where each of them is worst.
    pub worst: BTreeMap<&'static str, Worst>,
    /// Density that 95 % of the pieces have at least, points for each square metre.
    pub density_p05_per_m2: Option<f64>,
    /// Scatter of all points about the surface, metres.
    pub noise_whole_m: Option<f64>,
    /// How the numbers are spread.
    pub histograms: Vec<Histogram>,
    /// Sections across the tunnel.
    pub sections: Vec<Section>,
    /// What a person should know.
    #[schemars(with = "Vec<BTreeMap<String, String>>")]
    pub warnings: Vec<Warning>,
}

/// Where something is worst.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Worst {
    /// Chainage in the middle of the piece, metres.
    pub chainage_m: f64,
    /// The value there.
    pub value: f64,
}

/// How often values fall into classes of equal width.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Histogram {
    /// What is counted.
    pub name: &'static str,
    /// Unit of `from` and `width`.
    pub unit: &'static str,
    /// Lower end of the first class.
    pub from: f64,
    /// Width of a class.
    pub width: f64,
    /// Share of each class, percent; the first and the last hold what lies beyond them too.
    pub percent: Vec<f64>,
}

/// A section across the tunnel: radii around the axis from the invert over the left wall, the crown and the right wall.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Section {
    /// Where, metres.
    pub chainage_m: f64,
    /// The mean section around this place, metres.
    pub mean_radii_m: Vec<f64>,
    /// The surface exactly here, metres; null where it has a hole.
    pub radii_m: Vec<Option<f64>>,
}

/// What a profile is made from.
pub struct Input<'a> {
    /// The flattened surface.
    pub chart: &'a Chart,
    /// Axis coordinates of its vertices.
    pub coordinates: &'a [AxisCoordinates],
    /// The mean section.
    pub section: &'a SectionField,
    /// Place on the map and distance from the surface of each scan point.
    pub points: Option<(&'a [Vec2], &'a [f64])>,
    /// Observed and all pixels of each column of the map, with the chainage of the first column and its width.
    pub coverage: Option<Columns>,
}

/// Counts of the columns of the coverage picture.
pub struct Columns {
    /// Chainage at the left edge, metres.
    pub start_m: f64,
    /// Width of a column, metres.
    pub width_m: f64,
    /// Observed pixels, and pixels between the outermost with surface.
    pub counts: Vec<[u32; 2]>,
}

/// Tells what the map is like along the tunnel.
pub fn profile(input: &Input, settings: &Settings) -> Profile {
    let mesh = input.chart.strip().mesh();
    let uv = input.chart.uv();
    let (low, high) = uv.iter().fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(p.x), h.max(p.x)));
    let step = settings.step_m.max(0.01).max((high - low) / MOST_PIECES);
    let start = (low / step).floor() * step;
    let count = (((high - start) / step).ceil() as usize).max(1);
    let piece = |u: f64| (((u - start) / step).floor().max(0.0) as usize).min(count - 1);

    let weighted = |values: &[[f64; 2]], q: f64| {
        let (v, w): (Vec<f64>, Vec<f64>) = values.iter().map(|[v, w]| (*v, *w)).unzip();
        statistics::weighted_quantile(&v, &w, q)
    };
    let of_faces = || {
        let measured = distortion::of_faces(mesh, uv);
        let mut stretch: Vec<Vec<[f64; 2]>> = vec![Vec::new(); count];
        let (mut area, mut filled, mut flipped) = (vec![0.0; count], vec![0.0; count], vec![0.0; count]);
        for (f, corners) in mesh.faces().iter().enumerate() {
            let in_chart = corners.map(|v| uv[v as usize]);
            let at = piece((in_chart[0].x + in_chart[1].x + in_chart[2].x) / 3.0);
            area[at] += measured[f].area;
            filled[at] += if mesh.observed()[f] { 0.0 } else { measured[f].area };
            flipped[at] += f64::from(u8::from(distortion::orientation(in_chart) <= 0.0));
            if measured[f].is_defined() {
                stretch[at].push([measured[f].stretch(), measured[f].area]);
            }
        }
        let stretch_p95: Vec<Option<f64>> = stretch.iter().map(|s| weighted(s, 0.95)).collect();
        let beyond_one: Vec<[f64; 2]> =
            measured.iter().filter(|m| m.is_defined()).map(|m| [(m.stretch() - 1.0) * 100.0, m.area]).collect();
        (area, filled, flipped, stretch_p95, histogram("stretch beyond 1", "%", &beyond_one, false))
    };
    let of_points = || {
        let mut offsets: Vec<Vec<f64>> = vec![Vec::new(); count];
        for (p, offset) in input.points.iter().flat_map(|(uv, offsets)| uv.iter().zip(*offsets)) {
            if p.x.is_finite() && offset.abs() <= MOST_NOISE_M {
                offsets[piece(p.x)].push(*offset);
            }
        }
        let points: Vec<f64> = offsets.iter().map(|o| o.len() as f64).collect();
        let noise: Vec<Option<f64>> = offsets.iter().map(|o| scatter(o)).collect();
        let all_offsets: Vec<f64> = offsets.into_iter().flatten().collect();
        let values: Vec<[f64; 2]> = all_offsets.iter().map(|o| [o * 1000.0, 1.0]).collect();
        let distances = histogram("distance of the points from the surface", "mm", &values, true);
        (points, noise, scatter(&all_offsets), distances)
    };
    let ((area, filled, flipped, stretch_p95, stretches), (points, noise, noise_whole_m, distances)) =
        rayon::join(of_faces, of_points);
    let has_points = input.points.is_some();
    let each = |of: &dyn Fn(usize) -> Option<f64>| -> Vec<Option<f64>> { (0..count).map(of).collect() };
    let density = each(&|i| (has_points && area[i] > 0.0).then(|| points[i] / area[i]));
    let coverage = match &input.coverage {
        None => vec![None; count],
        Some(columns) => {
            let mut sums = vec![[0u64; 2]; count];
            for (i, [observed, all]) in columns.counts.iter().enumerate() {
                let sum = &mut sums[piece(columns.start_m + (i as f64 + 0.5) * columns.width_m)];
                *sum = [sum[0] + u64::from(*observed), sum[1] + u64::from(*all)];
            }
            sums.iter().map(|[o, a]| (*a > 0).then(|| 100.0 * *o as f64 / *a as f64)).collect()
        }
    };

    let mut usual: Vec<f64> = area.iter().copied().filter(|a| *a > 0.0).collect();
    let least_area = PORTAL_SHARE * statistics::median(&mut usual).unwrap_or(0.0);
    let counts = |i: usize| area[i] >= least_area && area[i] > 0.0;
    let filled_percent = each(&|i| (area[i] > 0.0).then(|| 100.0 * filled[i] / area[i]));
    let flipped_faces = each(&|i| Some(flipped[i]));
    let mut worst = BTreeMap::new();
    for (name, values, most) in [
        ("coverage_percent", &coverage, false),
        ("stretch_p95", &stretch_p95, true),
        ("flipped_faces", &flipped_faces, true),
        ("filled_percent", &filled_percent, true),
        ("density_per_m2", &density, false),
        ("noise_m", &noise, true),
    ] {
        let told = values.iter().enumerate().filter(|(i, _)| counts(*i)).filter_map(|(i, v)| Some((i, (*v)?)));
        let sign = if most { 1.0 } else { -1.0 };
        let found = told.reduce(|a, b| if sign * b.1 > sign * a.1 { b } else { a });
        // Nothing is worst where nothing is wrong.
        if let Some((i, value)) = found.filter(|(_, v)| !most || *v > 0.0) {
            worst.insert(name, Worst { chainage_m: start + (i as f64 + 0.5) * step, value });
        }
    }
    let mut densities: Vec<f64> = (0..count).filter(|&i| counts(i)).filter_map(|i| density[i]).collect();
    let mut histograms = vec![stretches];
    if has_points {
        histograms.push(distances);
    }
    let relief: Vec<[f64; 2]> = input
        .coordinates
        .iter()
        .map(|c| [(input.section.radius(c.chainage, c.angle()) - c.radius()) * 1000.0, 1.0])
        .collect();
    histograms.push(histogram("distance of the surface from the mean section", "mm", &relief, true));
    let mut warnings = Vec::new();
    let sections = sections(input, mesh, settings, &mut warnings);
    Profile {
        step_m: step,
        chainage_m: (0..count).map(|i| start + i as f64 * step).collect(),
        area_m2: area,
        coverage_percent: coverage,
        stretch_p95,
        flipped_faces,
        filled_percent,
        density_per_m2: density,
        noise_m: noise,
        worst,
        density_p05_per_m2: statistics::quantile(&mut densities, 0.05),
        noise_whole_m,
        histograms: histograms.into_iter().flatten().collect(),
        sections,
        warnings,
    }
}

/// Robust standard deviation; `None` for fewer than ten values.
fn scatter(values: &[f64]) -> Option<f64> {
    let middle = statistics::median(&mut values.to_vec()).filter(|_| values.len() >= 10)?;
    let mut deviations: Vec<f64> = values.iter().map(|v| (v - middle).abs()).collect();
    statistics::median(&mut deviations).map(|d| SIGMA_PER_MEDIAN_DEVIATION * d)
}

/// The histogram of weighted values: from 0, or around 0 on both sides, wide enough for 97 % of the weight.
fn histogram(name: &'static str, unit: &'static str, values: &[[f64; 2]], both_sides: bool) -> Option<Histogram> {
    let (sizes, weights): (Vec<f64>, Vec<f64>) = values.iter().map(|[v, w]| (v.abs(), *w)).unzip();
    let reach = statistics::weighted_quantile(&sizes, &weights, 0.97)?;
    let bars_on_a_side = if both_sides { BARS / 2 } else { BARS };
    let width = round_up(reach.max(1e-3) / bars_on_a_side as f64);
    let from = if both_sides { -width * bars_on_a_side as f64 } else { 0.0 };
    let mut sums = vec![0.0; BARS];
    for [value, weight] in values {
        let bar = ((value - from) / width).floor().clamp(0.0, (BARS - 1) as f64) as usize;
        sums[bar] += weight;
    }
    let total: f64 = sums.iter().sum();
    let percent = sums.iter().map(|s| (s / total * 1e5).round() / 1e3).collect();
    Some(Histogram { name, unit, from, width, percent })
}

/// The next greater number of the series 1, 2, 5, 10 ...
fn round_up(value: f64) -> f64 {
    let power = 10f64.powf(value.log10().floor());
    let digit = [1.0, 2.0, 5.0, 10.0].into_iter().find(|d| d * power >= value * (1.0 - 1e-9)).unwrap_or(10.0);
    digit * power
}

fn sections(input: &Input, mesh: &Mesh, settings: &Settings, warnings: &mut Vec<Warning>) -> Vec<Section> {
    let (start, end) = (input.section.start(), input.section.end());
    let spread = |i: usize| start + (i as f64 + 0.5) / settings.section_count as f64 * (end - start);
    let chainages: Vec<f64> = match settings.sections_m.as_slice() {
        [] => (0..settings.section_count).map(spread).collect(),
        named => named.to_vec(),
    };
    let mut found = Vec::new();
    for chainage in chainages {
        if !(chainage >= start && chainage <= end) {
            let message = format!(
                "there is no section at chainage {chainage} m: the tunnel goes from {start:.2} to {end:.2} m; see profile.sections_m"
            );
            warnings.push(Warning::new("section-outside", message));
            continue;
        }
        let angle = |k: usize| std::f64::consts::TAU * k as f64 / SECTION_POINTS as f64 - std::f64::consts::PI;
        let mean = (0..SECTION_POINTS).map(|k| millimetres(input.section.radius(chainage, angle(k)))).collect();
        let radii = surface_radii(input.coordinates, mesh, chainage);
        found.push(Section { chainage_m: millimetres(chainage), mean_radii_m: mean, radii_m: radii });
    }
    found
}

fn millimetres(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

/// Radii of the surface where it is cut by the section at a chainage, by direction.
fn surface_radii(coordinates: &[AxisCoordinates], mesh: &Mesh, chainage: f64) -> Vec<Option<f64>> {
    let mut sums = vec![(0.0, 0.0); SECTION_POINTS];
    let per_turn = SECTION_POINTS as f64 / std::f64::consts::TAU;
    let mut put = |right: f64, up: f64| {
        let slot = ((right.atan2(up) + std::f64::consts::PI) * per_turn).round() as usize % SECTION_POINTS;
        sums[slot] = (sums[slot].0 + right.hypot(up), sums[slot].1 + 1.0);
    };
    for face in 0..mesh.faces().len() as FaceId {
        let c = mesh.faces()[face as usize].map(|v| coordinates[v as usize]);
        let crossing = |a: &AxisCoordinates, b: &AxisCoordinates| {
            if (a.chainage < chainage) == (b.chainage < chainage) {
                return None;
            }
            let t = (chainage - a.chainage) / (b.chainage - a.chainage);
            Some((a.right + t * (b.right - a.right), a.up + t * (b.up - a.up)))
        };
        let ends: Vec<(f64, f64)> =
            [(0, 1), (1, 2), (2, 0)].iter().filter_map(|&(i, j)| crossing(&c[i], &c[j])).collect();
        if let [a, b] = ends.as_slice() {
            // Points along the segment, closer than the directions are.
            let length = (a.0 - b.0).hypot(a.1 - b.1);
            let nearest = a.0.hypot(a.1).min(b.0.hypot(b.1)).max(1e-3);
            let pieces = (length / nearest * per_turn * 2.0).ceil().clamp(1.0, 100.0) as usize;
            for i in 0..=pieces {
                let t = i as f64 / pieces as f64;
                put(a.0 + t * (b.0 - a.0), a.1 + t * (b.1 - a.1));
            }
        }
    }
    sums.into_iter().map(|(sum, n)| (n > 0.0).then(|| millimetres(sum / n))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::Axis;
    use crate::cut::Strip;
    use crate::numeric::Vec3;

    /// A half cylinder of radius 2 along y, 10 m long, with its exact chart; the faces of one metre are filled.
    fn half_cylinder(filled_metre: usize) -> (Chart, Axis) {
        let (rows, columns) = (21, 17);
        let angle = |j: usize| (j as f64 / (columns - 1) as f64 - 0.5) * std::f64::consts::PI;
        let mut vertices = Vec::new();
        let mut uv = Vec::new();
        for i in 0..rows {
            for j in 0..columns {
                let (sin, cos) = angle(j).sin_cos();
                vertices.push(Vec3::new(2.0 * sin, i as f64 * 0.5, 2.0 * cos));
                uv.push(Vec2::new(i as f64 * 0.5, 2.0 * angle(j)));
            }
        }
        let (mut faces, mut observed) = (Vec::new(), Vec::new());
        for i in 0..rows - 1 {
            for j in 0..columns - 1 {
                let a = (i * columns + j) as u32;
                let (b, c, d) = (a + columns as u32, a + columns as u32 + 1, a + 1);
                faces.extend([[a, b, c], [a, c, d]]);
                observed.extend([i / 2 != filled_metre; 2]);
            }
        }
        let strip = Strip::from_disk(Mesh::new(vertices, faces, observed).unwrap()).unwrap();
        let line: Vec<Vec3> = (0..=20).map(|i| Vec3::new(0.0, f64::from(i) * 0.5, 0.0)).collect();
        (Chart::new(strip, uv).unwrap(), Axis::through(&line, 0.0).unwrap())
    }

    #[test]
    fn the_metre_that_is_wrong_is_found() {
        let (chart, axis) = half_cylinder(6);
        let coordinates: Vec<AxisCoordinates> =
            chart.strip().mesh().vertices().iter().map(|p| axis.project(p)).collect();
        let section = SectionField::uniform(0.0, 10.0, |_| 2.0);
        // Every centimetre a point; metre 3 is noisy, metre 8 has a tenth of the points.
        let on_map: Vec<Vec2> = (0..1000)
            .filter(|i| i / 100 != 8 || i % 10 == 0)
            .map(|i| Vec2::new(f64::from(i) * 0.01 + 0.005, f64::from(i % 7) * 0.1))
            .collect();
        let offsets: Vec<f64> = on_map
            .iter()
            .enumerate()
            .map(|(i, p)| [-1.0, 0.0, 1.0][i % 3] * if p.x.floor() == 3.0 { 0.02 } else { 0.002 })
            .collect();
        let counts = (0..100).map(|i| [if i / 10 == 4 { 3 } else { 9 }, 10]).collect();
        let input = Input {
            chart: &chart,
            coordinates: &coordinates,
            section: &section,
            points: Some((&on_map, &offsets)),
            coverage: Some(Columns { start_m: 0.0, width_m: 0.1, counts }),
        };
        let told = profile(&input, &Settings { sections_m: vec![5.2, 99.0], ..Settings::default() });
        let at = |name: &str| told.worst[name].chainage_m;
        assert_eq!(told.chainage_m.len(), 10);
        assert_eq!(
            [at("coverage_percent"), at("filled_percent"), at("noise_m"), at("density_per_m2")],
            [4.5, 6.5, 3.5, 8.5]
        );
        assert!((told.worst["noise_m"].value - 0.02 * 1.4826).abs() < 1e-9, "{:?}", told.worst);
        assert_eq!(told.coverage_percent[4], Some(30.0));
        assert!(!told.worst.contains_key("flipped_faces"));
        assert!((told.histograms[0].percent.iter().sum::<f64>() - 100.0).abs() < 0.1);
        // The section sees the upper half only; the other chainage is refused aloud.
        assert_eq!((told.sections.len(), told.warnings.len()), (1, 1));
        let radii = &told.sections[0].radii_m;
        assert!(radii[SECTION_POINTS / 2].is_some_and(|r| (r - 2.0).abs() < 0.02) && radii[0].is_none());
    }
}
