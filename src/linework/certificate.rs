//! The certificate of a map: pixels and lines are sent to 3D and back, and what is lost on the way is measured.
//!
//! * Pixels: the centre of a pixel -> the surface under it -> a point in 3D -> the nearest place of the surface, found anew
//!   in space -> the map. Told in pixels, and in metres in space.
//! * Lines: a segment on the map -> the curve on the wall ([`super::drape()`]) -> the map ([`super::flatten()`], which finds
//!   each vertex anew in space) -> the wall again. Told in metres between the two curves, vertex by vertex, both ways.
//!
//! Pixels and segments are spread evenly over the map, the same ones each time. Points are measured by
//! [`crate::unwrap::round_trip`]. Cost: bounded by the number of samples, however large the map is.

use super::drape::drape_with;
use super::{Feature, FlattenSettings, Kind, flatten};
use crate::mesh::anchor::Anchoring;
use crate::numeric::{Vec2, Vec3, statistics};
use crate::unwrap::ChartIndex;
use rayon::prelude::*;
use serde::Serialize;

/// Pixels that are sent, about.
const PIXELS: f64 = 60_000.0;
/// Segments that are sent, and their length on the map, metres.
const LINES: usize = 48;
const LINE_M: f64 = 1.5;

/// What became of pixels.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PixelTrip {
    /// Pixels with a surface under their centre that were sent.
    pub sent: usize,
    /// Pixels that found no way back.
    pub lost: usize,
    /// Largest distance on the map, pixels.
    pub max_px: f64,
    /// 99 % came back nearer than this, pixels.
    pub p99_px: f64,
    /// Largest distance in space, metres.
    pub max_m: f64,
    /// 99 % came back nearer than this, metres.
    pub p99_m: f64,
}

/// What became of lines.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LineTrip {
    /// Segments with a surface under them that were sent.
    pub sent: usize,
    /// Segments that did not come back.
    pub lost: usize,
    /// Vertices that were compared.
    pub vertices: usize,
    /// Largest distance between the curves, metres.
    pub max_m: f64,
    /// 99 % of the vertices are nearer than this, metres.
    pub p99_m: f64,
}

/// Both.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Certificate {
    /// Pixel -> 3D -> pixel.
    pub pixels: PixelTrip,
    /// Line -> 3D -> line.
    pub lines: LineTrip,
}

/// Measures pixels and lines of a map with square pixels of `cell_m`. `anchoring` must be of the chart's mesh.
pub fn certify(index: &ChartIndex, anchoring: &Anchoring, cell_m: f64, settings: &FlattenSettings) -> Certificate {
    let chart = index.chart();
    let (mut low, mut high) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
    for &v in chart.strip().mesh().faces().iter().flatten() {
        low = low.inf(&chart.uv()[v as usize]);
        high = high.sup(&chart.uv()[v as usize]);
    }
    Certificate {
        pixels: pixels(index, anchoring, (low, high), cell_m, settings),
        lines: lines(index, anchoring, (low, high), settings),
    }
}

fn largest_and_p99(values: &[f64]) -> (f64, f64) {
    let mut finite: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    let max = finite.iter().copied().fold(0.0, f64::max);
    (max, statistics::quantile(&mut finite, 0.99).unwrap_or(0.0))
}

fn pixels(
    index: &ChartIndex,
    anchoring: &Anchoring,
    (low, high): (Vec2, Vec2),
    cell_m: f64,
    settings: &FlattenSettings,
) -> PixelTrip {
    let (mesh, normals, uv) = (anchoring.mesh(), anchoring.normals(), index.chart().uv());
    // Whole pixels of the grid, which is aligned to multiples of the cell.
    let first = (low / cell_m).map(f64::floor);
    let size = ((high - low) / cell_m).map(|c| c.ceil().max(1.0));
    let step = (size.x * size.y / PIXELS).sqrt().ceil().max(1.0);
    let (columns, rows) = ((size.x / step).ceil() as usize, (size.y / step).ceil() as usize);
    let found: Vec<Option<(f64, f64)>> = (0..columns * rows)
        .into_par_iter()
        .filter_map(|i| {
            let pixel = Vec2::new((i % columns) as f64, (i / columns) as f64) * step;
            let place = (first + pixel + Vec2::repeat(0.5)) * cell_m;
            let p = index.surface_point(place)?.position(mesh, normals);
            Some(anchoring.place(&p, &settings.anchor).map(|(anchor, _)| {
                let on_map = (anchor.in_chart(mesh, uv) - place).norm() / cell_m;
                (on_map, (anchor.position(mesh, normals) - p).norm())
            }))
        })
        .collect();
    let px: Vec<f64> = found.iter().flatten().map(|f| f.0).collect();
    let m: Vec<f64> = found.iter().flatten().map(|f| f.1).collect();
    let ((max_px, p99_px), (max_m, p99_m)) = (largest_and_p99(&px), largest_and_p99(&m));
    PixelTrip { sent: found.len(), lost: found.iter().filter(|f| f.is_none()).count(), max_px, p99_px, max_m, p99_m }
}

fn lines(index: &ChartIndex, anchoring: &Anchoring, (low, high): (Vec2, Vec2), settings: &FlattenSettings) -> LineTrip {
    let drawn: Vec<Feature> = (0..LINES)
        .map(|i| {
            let t = i as f64;
            // Low-discrepancy places, directions by the golden angle.
            let shares = Vec2::new((t * 0.754_877_666 + 0.5).fract(), (t * 0.569_840_291 + 0.5).fract());
            let a = low + (high - low).component_mul(&shares);
            let (s, c) = (t * 2.399_963_23).sin_cos();
            let b = a + Vec2::new(c, s) * LINE_M;
            let part = vec![Vec3::new(a.x, a.y, 0.0), Vec3::new(b.x, b.y, 0.0)];
            Feature {
                class: "line".into(),
                id: Some(i as i64),
                attributes: vec![],
                kind: Kind::Line,
                parts: vec![part],
            }
        })
        .collect();
    let mut trip = LineTrip::default();
    let mut errors = Vec::new();
    let normals = anchoring.normals();
    let Ok(up) = drape_with(index, normals, &drawn) else { return trip };
    for feature in &up.features {
        // Pieces one by one: where a line was split, the pieces have nothing to do with each other.
        for part in &feature.parts {
            trip.sent += 1;
            let one = feature.with_parts(vec![part.clone()]);
            let flat = flatten(index, anchoring, &[one], settings);
            let again = flat.ok().and_then(|flat| drape_with(index, normals, &flat.features).ok());
            let Some(back) = again.filter(|a| !a.features.is_empty()) else {
                trip.lost += 1;
                continue;
            };
            let returned: Vec<&Vec<Vec3>> = back.features.iter().flat_map(|f| &f.parts).collect();
            errors.extend(part.iter().map(|p| distance(p, &returned)));
            errors.extend(returned.iter().copied().flatten().map(|p| distance(p, &[part])));
        }
    }
    trip.vertices = errors.len();
    (trip.max_m, trip.p99_m) = largest_and_p99(&errors);
    trip
}

/// Distance of a point from polylines.
fn distance(p: &Vec3, lines: &[&Vec<Vec3>]) -> f64 {
    let segment = |w: &[Vec3]| {
        let d = w[1] - w[0];
        let t = if d.norm_squared() > 0.0 { ((p - w[0]).dot(&d) / d.norm_squared()).clamp(0.0, 1.0) } else { 0.0 };
        (p - w[0] - d * t).norm()
    };
    lines.iter().flat_map(|line| line.windows(2)).map(segment).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::example::bent_chart;

    #[test]
    fn a_sound_map_gets_its_certificate() {
        let chart = bent_chart(6.0, 4.0, 121, 81, |u, v| Vec3::new(u, v, 0.1 * (5.0 * u).sin() * (4.0 * v).cos()));
        let (index, anchoring) = (ChartIndex::of(&chart), Anchoring::of(chart.strip().mesh()));
        let found = certify(&index, &anchoring, 0.01, &FlattenSettings::default());
        assert!(found.pixels.sent > 50_000 && found.pixels.lost == 0, "{found:?}");
        assert!(found.pixels.max_px < 1e-6 && found.pixels.max_m < 1e-9, "{found:?}");
        assert!(found.lines.sent >= LINES / 2 && found.lines.lost == 0 && found.lines.max_m < 1e-6, "{found:?}");
    }
}
