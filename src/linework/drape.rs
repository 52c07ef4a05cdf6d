//! From the map to the surface: each drawn line becomes the surface curve under it, in 3D.
//!
//! A vertex is added at every edge of the surface that the line crosses, so the 3D line lies in the faces
//! ([`super::route()`]). The third map coordinate, the distance from the surface, is carried along the line. Vertices with
//! a way off the surface ([`super::OFF_SURFACE`]) are joined by straight 3D segments. Where no surface lies under a line
//! it is split; what is lost is told in metres, feature by feature.

use super::{Error, Feature, Kind, OFF_SURFACE, Value, check_finite, route};
use crate::mesh::SurfacePoint;
use crate::numeric::{Vec2, Vec3};
use crate::unwrap::ChartIndex;
use crate::warning::Warning;
use serde::Serialize;

/// Gaps along a line shorter than this are rounding, metres.
const GAP_M: f64 = 1e-6;

/// What draping did.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct DrapeSummary {
    /// Features given.
    pub features: usize,
    /// Features of which something lies on the surface.
    pub draped: usize,
    /// Features of which nothing lies on the surface; they are left out.
    pub dropped: usize,
    /// Features that lost a part, or were split, where no surface lies under them.
    pub split: usize,
    /// Map length that has no surface under it, metres.
    pub missing_m: f64,
    /// Vertices of the 3D linework.
    pub vertices: usize,
    /// What a person should know, one a feature that did not come whole.
    pub warnings: Vec<Warning>,
}

/// Draped linework.
#[derive(Clone, Debug, PartialEq)]
pub struct Drape {
    /// Features in local metres, in the order of the map's; features without a surface are left out.
    pub features: Vec<Feature>,
    /// For each of them, its place in the given list.
    pub sources: Vec<usize>,
    /// Counts.
    pub summary: DrapeSummary,
}

/// A vertex on its way up: straight, or along the surface.
struct Lifted {
    on_map: Vec2,
    offset: f64,
    /// 3D position if the vertex has a way off the surface.
    off_surface: Option<Vec3>,
}

/// Puts features of the map on the surface.
///
/// # Errors
/// [`Error::NotFinite`], [`Error::OffSurface`].
pub fn drape(index: &ChartIndex, features: &[Feature]) -> Result<Drape, Error> {
    drape_with(index, &index.chart().strip().mesh().vertex_normals(), features)
}

/// [`drape`] with the vertex normals of the mesh, for those who drape often.
pub(super) fn drape_with(index: &ChartIndex, normals: &[Vec3], features: &[Feature]) -> Result<Drape, Error> {
    let surface = Surface { index, normals };
    let mut summary = DrapeSummary { features: features.len(), ..DrapeSummary::default() };
    let (mut draped, mut sources) = (Vec::new(), Vec::new());
    for (source, feature) in features.iter().enumerate() {
        check_finite(feature)?;
        let ways = off_surface_ways(feature)?;
        let (mut parts, mut missing_m, mut whole) = (Vec::new(), 0.0, true);
        for (number, part) in feature.parts.iter().enumerate() {
            let vertices: Vec<Lifted> = part
                .iter()
                .enumerate()
                .map(|(vertex, p)| surface.lifted(p, ways.iter().find(|w| (w.0, w.1) == (number, vertex)).map(|w| w.2)))
                .collect();
            let pieces = match feature.kind {
                Kind::Point => vertices.iter().filter_map(|v| surface.position(v)).map(|p| vec![p]).collect(),
                Kind::Line | Kind::Area => surface.line(&vertices, &mut missing_m),
            };
            let complete = match feature.kind {
                Kind::Point => pieces.len() == part.len(),
                Kind::Line | Kind::Area => pieces.len() == 1 && missing_m == 0.0,
            };
            whole &= complete;
            parts.extend(pieces);
        }
        if feature.kind == Kind::Area && !whole {
            // A ring with a gap bounds nothing.
            parts.clear();
        }
        summary.missing_m += missing_m;
        summary.vertices += parts.iter().map(Vec::len).sum::<usize>();
        let (name, lost) = (feature.name(), format!("{missing_m:.3} m of it have no surface under them"));
        if parts.is_empty() {
            summary.dropped += 1;
            summary
                .warnings
                .push(Warning::new("not-on-map", format!("{name} was left out: {lost} (hole, or beside the map)")));
            continue;
        }
        if !whole {
            summary.split += 1;
            let message = format!("{name} is in {} parts: {lost}", parts.len());
            summary.warnings.push(Warning::new("split", message));
        }
        summary.draped += 1;
        let mut in_scan = feature.with_parts(parts);
        in_scan.attributes.retain(|(n, _)| n != OFF_SURFACE);
        draped.push(in_scan);
        sources.push(source);
    }
    Ok(Drape { features: draped, sources, summary })
}

struct Surface<'a> {
    index: &'a ChartIndex<'a>,
    normals: &'a [Vec3],
}

impl Surface<'_> {
    fn at(&self, point: SurfacePoint) -> Vec3 {
        point.position(self.index.chart().strip().mesh(), self.normals)
    }

    fn lifted(&self, p: &Vec3, way: Option<Vec3>) -> Lifted {
        let on_map = p.xy();
        let off_surface = way.and_then(|way| Some(self.at(self.index.surface_point(on_map)?) + way));
        Lifted { on_map, offset: p.z, off_surface }
    }

    fn position(&self, vertex: &Lifted) -> Option<Vec3> {
        vertex.off_surface.or_else(|| {
            let foot = self.index.surface_point(vertex.on_map)?;
            Some(self.at(SurfacePoint { offset: vertex.offset, ..foot }))
        })
    }

    /// The 3D polylines over a map polyline; `missing_m` grows by the length without surface.
    fn line(&self, vertices: &[Lifted], missing_m: &mut f64) -> Vec<Vec<Vec3>> {
        let mut lines: Vec<Vec<Vec3>> = Vec::new();
        // Whether the next vertex continues the last line.
        let mut joined = false;
        let mut push = |p: Vec3, joined: &mut bool| match lines.last_mut() {
            Some(line) if *joined => {
                if (p - line[line.len() - 1]).norm() > 1e-9 {
                    line.push(p);
                }
            }
            _ => {
                lines.push(vec![p]);
                *joined = true;
            }
        };
        for pair in vertices.windows(2) {
            let [a, b] = [&pair[0], &pair[1]];
            let length = (b.on_map - a.on_map).norm();
            if a.off_surface.is_some() || b.off_surface.is_some() || length == 0.0 {
                match (self.position(a), self.position(b)) {
                    (Some(from), Some(to)) => {
                        push(from, &mut joined);
                        push(to, &mut joined);
                    }
                    _ => {
                        *missing_m += length;
                        joined = false;
                    }
                }
                continue;
            }
            let found = route(self.index, a.on_map, b.on_map);
            let (mut t, mut end) = (0.0, None::<Vec3>);
            for piece in &found.pieces {
                let gap = (piece.t[0] - t) * length;
                if gap > GAP_M {
                    *missing_m += gap;
                    joined = false;
                }
                let position = |k: usize| {
                    let offset = a.offset + (b.offset - a.offset) * piece.t[k];
                    self.at(SurfacePoint { offset, ..piece.ends[k] })
                };
                let (from, to) = (position(0), position(1));
                // Another sheet of a map that covers itself.
                if joined && end.is_some_and(|end| (end - from).norm() > GAP_M) {
                    joined = false;
                }
                push(from, &mut joined);
                push(to, &mut joined);
                (t, end) = (piece.t[1], Some(to));
            }
            let rest = (1.0 - t) * length;
            if rest > GAP_M {
                *missing_m += rest;
                joined = false;
            }
        }
        lines.retain(|line| line.len() > 1);
        lines
    }
}

/// Part, vertex and way of each vertex off the surface.
fn off_surface_ways(feature: &Feature) -> Result<Vec<(usize, usize, Vec3)>, Error> {
    let text = match feature.attribute(OFF_SURFACE) {
        None | Some(Value::Null) => return Ok(Vec::new()),
        Some(Value::Text(text)) if text.trim().is_empty() => return Ok(Vec::new()),
        Some(Value::Text(text)) => text,
        Some(_) => return Err(Error::OffSurface { feature: feature.name() }),
    };
    let wrong = || Error::OffSurface { feature: feature.name() };
    let rows: Vec<(usize, usize, f64, f64, f64)> = serde_json::from_str(text).map_err(|_| wrong())?;
    rows.into_iter()
        .map(|(part, vertex, x, y, z)| {
            let there = feature.parts.get(part).is_some_and(|p| vertex < p.len());
            let way = Vec3::new(x, y, z);
            (there && way.iter().all(|c| c.is_finite())).then_some((part, vertex, way)).ok_or_else(wrong)
        })
        .collect()
}
