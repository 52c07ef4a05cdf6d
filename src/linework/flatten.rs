//! From 3D to the map: each vertex gets its place under it and its distance from the surface.
//!
//! A vertex near the surface is anchored like a scan point ([`crate::mesh::anchor`]) and comes back exactly from
//! (u, v, distance). One that lies deep in the rock, far in the void or beyond a border keeps its way from the surface
//! below it ([`super::OFF_SURFACE`]) and comes back exactly as well.
//!
//! A straight 3D segment near the surface is a curve on the map: it is halved until the map follows it within
//! `tolerance_m`. Where the segment crosses the seam of the map the line is split. Segments from or to vertices off the
//! surface stay straight in 3D and get no vertices in between.

use super::{Error, Feature, Kind, OFF_SURFACE, Value, check_finite};
use crate::mesh::SurfacePoint;
use crate::mesh::anchor::{self, Anchoring};
use crate::numeric::{Vec2, Vec3};
use crate::unwrap::ChartIndex;
use crate::warning::Warning;
use serde::Serialize;

/// A place and a distance that bring a vertex back nearer than this are exact, metres.
const EXACT_M: f64 = 1e-6;
/// A segment is not halved below this length, metres.
const SHORTEST_M: f64 = 1e-3;
/// Where the map jumps it is, down to this length: as much of a line is lost at the seam.
const LOST_AT_SEAM_M: f64 = 1e-6;
/// Map length that a 3D length may have: more is a jump from one side of the seam to the other. The second term, metres,
/// lets short segments pass steps of the relief.
const JUMP: (f64, f64) = (4.0, 0.02);

/// How to flatten linework.
#[derive(Clone, Debug, PartialEq)]
pub struct FlattenSettings {
    /// Anchoring of vertices near the surface.
    pub anchor: anchor::Settings,
    /// Vertices farther than this from the surface, metres, have no place on the map. Default 50.
    pub reach_m: f64,
    /// How closely the map follows a straight 3D segment, metres. Default 0.0002.
    pub tolerance_m: f64,
}

impl Default for FlattenSettings {
    fn default() -> Self {
        Self { anchor: anchor::Settings::default(), reach_m: 50.0, tolerance_m: 2e-4 }
    }
}

/// What flattening did.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct FlattenSummary {
    /// Features given.
    pub features: usize,
    /// Features on the map.
    pub flattened: usize,
    /// Features without any place on the map; they are left out.
    pub dropped: usize,
    /// Vertices given.
    pub vertices: usize,
    /// Vertices that keep a way off the surface (deep, far, or beyond a border).
    pub off_surface: usize,
    /// Vertices farther from the surface than the reach; left out.
    pub far: usize,
    /// Vertices added so that the map follows the line.
    pub added: usize,
    /// Places where a line was split (at the seam, or beside left-out vertices).
    pub splits: usize,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Linework on the map.
#[derive(Clone, Debug, PartialEq)]
pub struct Flatten {
    /// Features on the map, in the order of those given; features without a place are left out.
    pub features: Vec<Feature>,
    /// For each of them, its place in the given list.
    pub sources: Vec<usize>,
    /// Counts.
    pub summary: FlattenSummary,
}

#[derive(Clone, Copy)]
struct Placed {
    uv: Vec2,
    distance: f64,
    way: Option<Vec3>,
}

struct Flattener<'a> {
    index: &'a ChartIndex<'a>,
    anchoring: &'a Anchoring<'a>,
    settings: &'a FlattenSettings,
}

/// Brings features in local metres onto the map. `anchoring` must be of the mesh of the chart.
///
/// # Errors
/// [`Error::NotFinite`], or [`Error::Setting`] for a reach or tolerance that is not positive.
pub fn flatten(
    index: &ChartIndex,
    anchoring: &Anchoring,
    features: &[Feature],
    settings: &FlattenSettings,
) -> Result<Flatten, Error> {
    for (key, value) in [("reach_m", settings.reach_m), ("tolerance_m", settings.tolerance_m)] {
        if !(value > 0.0 && value.is_finite()) {
            return Err(Error::Setting { key, value, must: "a positive number of metres" });
        }
    }
    let way = Flattener { index, anchoring, settings };
    let mut summary = FlattenSummary { features: features.len(), ..FlattenSummary::default() };
    let (mut flat, mut sources) = (Vec::new(), Vec::new());
    for (source, feature) in features.iter().enumerate() {
        check_finite(feature)?;
        let mut parts: Vec<Vec<Placed>> = Vec::new();
        let (mut far, mut splits) = (0, 0);
        for part in &feature.parts {
            summary.vertices += part.len();
            let placed: Vec<Option<Placed>> = part.iter().map(|p| way.place(p)).collect();
            far += placed.iter().filter(|p| p.is_none()).count();
            if feature.kind == Kind::Point {
                parts.extend(placed.into_iter().flatten().map(|p| vec![p]));
                continue;
            }
            let first = parts.len();
            let mut open = false;
            for (i, place) in placed.iter().enumerate() {
                let Some(place) = *place else {
                    open = false;
                    continue;
                };
                if !open {
                    parts.push(vec![place]);
                    open = true;
                    continue;
                }
                let (from, to) = (part[i - 1], part[i]);
                let before = parts[parts.len() - 1].len();
                let start = placed[i - 1].expect("the line is open");
                let pieces = parts.len();
                way.segment((from, start), (to, place), &mut parts);
                if parts.len() == pieces {
                    summary.added += parts[pieces - 1].len() - before - 1;
                }
            }
            splits += (parts.len() - first).saturating_sub(1);
        }
        parts.retain(|p| feature.kind == Kind::Point || p.len() > 1);
        if feature.kind == Kind::Area && (splits > 0 || far > 0) {
            // A ring that the seam cuts bounds nothing on the map.
            parts.clear();
        }
        summary.far += far;
        summary.splits += splits;
        let name = feature.name();
        if parts.is_empty() {
            summary.dropped += 1;
            let message = format!(
                "{name} was left out: {far} of its vertices are farther than {} m from the surface, and it is cut {splits} times",
                settings.reach_m
            );
            summary.warnings.push(Warning::new("not-on-map", message));
            continue;
        }
        if far > 0 || splits > 0 {
            let message = format!(
                "{name} is split in {} parts: {splits} cuts at the seam or beside vertices without a place, {far} vertices \
                 farther than {} m from the surface",
                parts.len(),
                settings.reach_m
            );
            summary.warnings.push(Warning::new("split", message));
        }
        let mut ways: Vec<(usize, usize, f64, f64, f64)> = Vec::new();
        for (p, part) in parts.iter().enumerate() {
            for (v, vertex) in part.iter().enumerate() {
                ways.extend(vertex.way.map(|w| (p, v, w.x, w.y, w.z)));
            }
        }
        let shape =
            parts.iter().map(|part| part.iter().map(|v| Vec3::new(v.uv.x, v.uv.y, v.distance)).collect()).collect();
        let mut on_map = feature.with_parts(shape);
        on_map.attributes.retain(|(n, _)| n != OFF_SURFACE);
        if !ways.is_empty() {
            summary.off_surface += ways.len();
            let text = serde_json::to_string(&ways).expect("plain numbers");
            on_map.attributes.push((OFF_SURFACE.to_owned(), Value::Text(text)));
        }
        summary.flattened += 1;
        flat.push(on_map);
        sources.push(source);
    }
    Ok(Flatten { features: flat, sources, summary })
}

impl Flattener<'_> {
    fn place(&self, p: &Vec3) -> Option<Placed> {
        let (mesh, normals) = (self.anchoring.mesh(), self.anchoring.normals());
        let uv = self.index.chart().uv();
        if let Some((anchor, true)) = self.anchoring.place(p, &self.settings.anchor)
            && anchor.offset.abs() <= self.settings.anchor.max_offset_m
        {
            let place = anchor.in_chart(mesh, uv);
            let back = self.index.surface_point(place).map(|s| SurfacePoint { offset: anchor.offset, ..s });
            if back.is_some_and(|s| (s.position(mesh, normals) - p).norm() <= EXACT_M) {
                return Some(Placed { uv: place, distance: anchor.offset, way: None });
            }
        }
        let (foot, distance) = self.anchoring.foot(p, self.settings.reach_m)?;
        let place = foot.in_chart(mesh, uv);
        let shown = self.index.surface_point(place)?.position(mesh, normals);
        let side = (p - foot.position(mesh, normals)).dot(&mesh.double_area_vector(foot.face));
        Some(Placed { uv: place, distance: distance.copysign(side), way: Some(p - shown) })
    }

    /// Appends what comes after `from` on the way to `to`; a jump of the map begins a new part.
    fn segment(&self, (a, from): (Vec3, Placed), (b, to): (Vec3, Placed), parts: &mut Vec<Vec<Placed>>) {
        let length = (b - a).norm();
        let on_map = (to.uv - from.uv).norm();
        let jumps = on_map > JUMP.0 * length + JUMP.1;
        let straight = from.way.is_some() || to.way.is_some();
        let fits = |t: f64| {
            self.place(&(a + (b - a) * t)).is_some_and(|p| {
                let on_line = from.uv + (to.uv - from.uv) * t;
                let distance = from.distance + (to.distance - from.distance) * t;
                p.way.is_none()
                    && (p.uv - on_line).norm() <= self.settings.tolerance_m
                    && (p.distance - distance).abs() <= self.settings.tolerance_m
            })
        };
        if !jumps && (straight || length <= SHORTEST_M || [0.5, 0.25, 0.75].into_iter().all(fits)) {
            parts.last_mut().expect("a part is open").push(to);
            return;
        }
        let middle = (a + b) / 2.0;
        match self.place(&middle) {
            Some(place) if length > LOST_AT_SEAM_M => {
                self.segment((a, from), (middle, place), parts);
                self.segment((middle, place), (b, to), parts);
            }
            _ => parts.push(vec![to]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::drape;
    use super::*;
    use crate::map::example::bent_chart;

    fn line(id: i64, parts: Vec<Vec<Vec3>>) -> Feature {
        Feature {
            class: "trace".into(),
            id: Some(id),
            attributes: vec![("name".into(), Value::Text("x".into()))],
            kind: Kind::Line,
            parts,
        }
    }

    /// A wavy sheet over the chart.
    fn wavy() -> crate::unwrap::Chart {
        bent_chart(4.0, 3.0, 61, 46, |u, v| Vec3::new(u, v, 0.1 * (3.0 * u).sin() * (2.0 * v).cos()))
    }

    #[test]
    fn lines_drawn_on_the_map_hug_the_wall_and_come_back() {
        let chart = wavy();
        let (index, anchoring) = (ChartIndex::of(&chart), Anchoring::of(chart.strip().mesh()));
        let drawn = line(7, vec![vec![Vec3::new(0.31, 0.2, 0.0), Vec3::new(3.7, 2.8, 0.0), Vec3::new(3.6, 0.4, 0.0)]]);
        let draped = drape(&index, std::slice::from_ref(&drawn)).unwrap();
        assert_eq!((draped.summary.draped, draped.summary.split, draped.summary.missing_m), (1, 0, 0.0));
        let in_scan = &draped.features[0];
        assert_eq!((in_scan.id, &in_scan.attributes), (Some(7), &drawn.attributes));
        // Every place between two vertices lies on the surface as well.
        for pair in in_scan.parts[0].windows(2) {
            for t in [0.25, 0.5, 0.75] {
                let (_, distance) = anchoring.foot(&(pair[0] + (pair[1] - pair[0]) * t), 1.0).unwrap();
                assert!(distance < 1e-9, "{distance}");
            }
        }
        let back = flatten(&index, &anchoring, &draped.features, &FlattenSettings::default()).unwrap();
        assert_eq!((back.summary.off_surface, back.summary.splits), (0, 0));
        // The line on the map is the one that was drawn: all its vertices lie on it.
        let on_drawn = |p: Vec2| {
            drawn.parts[0]
                .windows(2)
                .map(|w| {
                    let (a, d) = (w[0].xy(), w[1].xy() - w[0].xy());
                    let t = ((p - a).dot(&d) / d.norm_squared()).clamp(0.0, 1.0);
                    (p - a - d * t).norm()
                })
                .fold(f64::INFINITY, f64::min)
        };
        let worst = back.features[0].parts[0].iter().map(|p| on_drawn(p.xy()).max(p.z.abs())).fold(0.0, f64::max);
        assert!(worst < 1e-9, "{worst}");
        assert!((back.features[0].length() - drawn.length()).abs() < 1e-9);
    }

    #[test]
    fn lines_and_bolts_in_3d_come_back_exactly() {
        let chart = wavy();
        let (index, anchoring) = (ChartIndex::of(&chart), Anchoring::of(chart.strip().mesh()));
        let given = [
            // A straight line beside the surface, a bolt that ends deep in the rock, a line over the border.
            line(1, vec![vec![Vec3::new(0.5, 0.5, 0.05), Vec3::new(3.3, 2.1, 0.12)]]),
            line(2, vec![vec![Vec3::new(1.0, 1.0, 0.0), Vec3::new(1.3, 0.8, -4.0)]]),
            line(3, vec![vec![Vec3::new(3.5, 1.0, 0.0), Vec3::new(4.6, 1.1, 0.2)]]),
        ];
        let flat = flatten(&index, &anchoring, &given, &FlattenSettings::default()).unwrap();
        assert_eq!(flat.summary.flattened, 3);
        assert!(flat.summary.off_surface >= 2, "{:?}", flat.summary);
        let back = drape(&index, &flat.features).unwrap();
        for (before, after) in given.iter().zip(&back.features) {
            assert_eq!(before.id, after.id);
            assert_eq!(after.parts.len(), 1);
            let (a, b) = (before.parts[0][0], before.parts[0][1]);
            let ends = [after.parts[0][0], after.parts[0][after.parts[0].len() - 1]];
            assert!((ends[0] - a).norm() < 1e-6 && (ends[1] - b).norm() < 1e-6, "{ends:?}");
            let beside = |p: &Vec3| (p - a).cross(&(b - a)).norm() / (b - a).norm();
            let worst = after.parts[0].iter().map(beside).fold(0.0, f64::max);
            assert!(worst < 1e-3, "{:?}: {worst}", before.id);
        }
    }

    #[test]
    fn a_line_across_the_seam_loses_next_to_nothing_there() {
        let width = std::f64::consts::TAU;
        let chart = bent_chart(4.0, width, 61, 91, |u, v| Vec3::new(u, -v.sin(), v.cos()));
        let (index, anchoring) = (ChartIndex::of(&chart), Anchoring::of(chart.strip().mesh()));
        let at = |s: f64, angle: f64| Vec3::new(s, -angle.sin(), angle.cos());
        let across = line(1, vec![vec![at(1.0, -0.13), at(1.3, 0.2)]]);
        let flat = flatten(&index, &anchoring, &[across], &FlattenSettings::default()).unwrap();
        assert_eq!((flat.summary.splits, flat.features[0].parts.len()), (1, 2), "{:?}", flat.summary);
        let back = drape(&index, &flat.features).unwrap();
        let parts = &back.features[0].parts;
        let gap = (parts[0][parts[0].len() - 1] - parts[1][0]).norm();
        assert!(gap < 1e-5, "{gap}");
    }

    #[test]
    fn what_has_no_place_is_told() {
        let chart = wavy();
        let (index, anchoring) = (ChartIndex::of(&chart), Anchoring::of(chart.strip().mesh()));
        let far = line(1, vec![vec![Vec3::new(0.0, 0.0, 90.0), Vec3::new(1.0, 0.0, 95.0)]]);
        let flat = flatten(&index, &anchoring, &[far], &FlattenSettings::default()).unwrap();
        assert_eq!((flat.summary.dropped, flat.summary.far, flat.summary.warnings.len()), (1, 2, 1));
        let beside = line(2, vec![vec![Vec3::new(-2.0, 1.0, 0.0), Vec3::new(1.0, 1.0, 0.0)]]);
        let outside = line(3, vec![vec![Vec3::new(-2.0, 1.0, 0.0), Vec3::new(-1.0, 1.0, 0.0)]]);
        let up = drape(&index, &[beside, outside]).unwrap();
        assert_eq!((up.summary.draped, up.summary.dropped, up.summary.split), (1, 1, 1));
        assert!((up.summary.missing_m - 3.0).abs() < 1e-9 && up.summary.warnings.len() == 2);
    }
}
