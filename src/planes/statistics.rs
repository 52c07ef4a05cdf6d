//! How much is fractured: P10, P20, P21, spacing of the sets, RQD along the tunnel.
//!
//! * P21: trace length on observed surface over observed area, both in 3D (m/m2). P20: traces over the same area (1/m2).
//! * P10: crossings of scanlines over their observed 3D length (1/m). Scanlines are the lines of equal girth on the map,
//!   evenly spread.
//! * Spacing of a set: the distance between neighbouring crossings on one scanline, measured along the mean normal of the
//!   set (so it is the normal spacing and needs no correction for the direction of the scanline).
//! * RQD = 100 exp(-0.1 L) (0.1 L + 1) with L crossings a metre, for each interval of chainage (S. D. Priest and
//!   J. A. Hudson, "Discontinuity spacings in rock", 1976, doi:10.1016/0148-9062(76)90818-4). It assumes that crossings
//!   come independently of each other.
//!
//! Surface that was filled counts neither as area nor as length. Planes that run along the tunnel are seldom crossed by a
//! scanline along it (R. D. Terzaghi, "Sources of error in joint surveys", 1965, doi:10.1680/geot.1965.15.3.287): below
//! `blind_deg` between plane and axis they are marked, their weight 1 / sin(angle) is told, and P10 and RQD do not see them
//! well. Cost: linear in the faces crossed.

use super::Set;
use crate::linework::route;
use crate::numeric::{Vec2, Vec3, statistics};
use crate::unwrap::ChartIndex;
use serde::Serialize;

/// How statistics are taken.
#[derive(Clone, Debug, PartialEq)]
pub struct StatisticsSettings {
    /// Distance between scanlines on the map, metres of girth.
    pub scanline_spacing_m: f64,
    /// Length of the intervals of chainage for the RQD, metres.
    pub interval_m: f64,
    /// Planes at a smaller angle to the axis, degrees, are in the blind zone of scanlines along the tunnel.
    pub blind_deg: f64,
}

impl Default for StatisticsSettings {
    fn default() -> Self {
        Self { scanline_spacing_m: 0.5, interval_m: 5.0, blind_deg: 20.0 }
    }
}

/// A trace for the statistics.
#[derive(Clone, Debug, PartialEq)]
pub struct TraceOnMap {
    /// Its polylines on the map.
    pub parts: Vec<Vec<Vec2>>,
    /// Its set.
    pub set: Option<u32>,
}

/// Where a scanline meets a trace.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crossing {
    /// Chainage on the map.
    pub u: f64,
    /// Place in local metres.
    pub position: Vec3,
    /// Set of the trace.
    pub set: Option<u32>,
}

/// A line of equal girth with what it meets, by chainage.
#[derive(Clone, Debug, PartialEq)]
pub struct Scanline {
    /// Its girth.
    pub v: f64,
    /// Observed pieces: chainage of both ends and 3D length.
    pub pieces: Vec<(f64, f64, f64)>,
    /// Crossings in order.
    pub crossings: Vec<Crossing>,
}

/// Normal spacing of a set.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Spacing {
    /// Set; 0 for planes of no set.
    pub set: u32,
    /// Traces.
    pub traces: usize,
    /// Trace length on observed surface, metres.
    pub trace_length_m: f64,
    /// Crossings a metre of scanline.
    pub p10_per_m: f64,
    /// Traces a square metre.
    pub p20_per_m2: f64,
    /// Trace length a square metre.
    pub p21_m_per_m2: f64,
    /// Spacings measured.
    pub spacings: usize,
    /// Mean normal spacing, metres.
    pub mean_spacing_m: Option<f64>,
    /// Median normal spacing, metres.
    pub median_spacing_m: Option<f64>,
}

/// An interval of chainage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// Where it begins, chainage in metres.
    pub from_m: f64,
    /// Where it ends.
    pub to_m: f64,
    /// Observed length of the scanlines in it, metres.
    pub scanline_m: f64,
    /// Crossings in it.
    pub crossings: usize,
    /// RQD in percent; absent where nothing was observed.
    pub rqd_percent: Option<f64>,
}

/// All statistics of a window: the whole map.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Observed area in 3D, square metres.
    pub observed_area_m2: f64,
    /// Observed length of the scanlines, metres.
    pub scanline_m: f64,
    /// All traces together.
    pub all: Spacing,
    /// Set by set, those of no set (0) last.
    pub sets: Vec<Spacing>,
    /// Along the tunnel.
    pub intervals: Vec<Interval>,
}

/// The scanlines of a map with the traces that they meet.
pub fn scanlines(index: &ChartIndex, traces: &[TraceOnMap], spacing_m: f64) -> Vec<Scanline> {
    let chart = index.chart();
    let mesh = chart.strip().mesh();
    let normals = mesh.vertex_normals();
    let (mut low, mut high) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
    for &v in mesh.faces().iter().flatten() {
        low = low.inf(&chart.uv()[v as usize]);
        high = high.sup(&chart.uv()[v as usize]);
    }
    let count = ((high.y - low.y) / spacing_m).round().max(1.0) as usize;
    let line = |k: usize| {
        let v = low.y + (high.y - low.y) * (k as f64 + 0.5) / count as f64;
        let (a, b) = (Vec2::new(low.x, v), Vec2::new(high.x, v));
        let pieces = route(index, a, b)
            .pieces
            .iter()
            .filter(|p| mesh.observed()[p.ends[0].face as usize])
            .map(|p| {
                let length = (p.ends[1].position(mesh, &normals) - p.ends[0].position(mesh, &normals)).norm();
                (a.x + (b.x - a.x) * p.t[0], a.x + (b.x - a.x) * p.t[1], length)
            })
            .collect();
        let mut crossings: Vec<Crossing> = Vec::new();
        for trace in traces {
            for pair in trace.parts.iter().flat_map(|part| part.windows(2)) {
                let (p, q) = (pair[0], pair[1]);
                if (p.y >= v) == (q.y >= v) {
                    continue;
                }
                let u = p.x + (q.x - p.x) * (v - p.y) / (q.y - p.y);
                if let Some(foot) = index.surface_point(Vec2::new(u, v))
                    && mesh.observed()[foot.face as usize]
                {
                    crossings.push(Crossing { u, position: foot.position(mesh, &normals), set: trace.set });
                }
            }
        }
        crossings.sort_by(|a, b| a.u.total_cmp(&b.u).then(a.set.cmp(&b.set)));
        Scanline { v, pieces, crossings }
    };
    (0..count).map(line).collect()
}

/// Length of a trace on observed faces, metres.
fn observed_length(index: &ChartIndex, trace: &TraceOnMap, normals: &[Vec3]) -> f64 {
    let mesh = index.chart().strip().mesh();
    let length = |a: Vec2, b: Vec2| -> f64 {
        let found = route(index, a, b);
        let pieces = found.pieces.iter().filter(|p| mesh.observed()[p.ends[0].face as usize]);
        pieces.map(|p| (p.ends[1].position(mesh, normals) - p.ends[0].position(mesh, normals)).norm()).sum()
    };
    trace.parts.iter().flat_map(|part| part.windows(2)).map(|w| length(w[0], w[1])).sum()
}

/// All statistics of the traces on a map.
///
/// # Errors
/// [`super::Error::Setting`] for lengths that are not positive.
pub fn statistics(
    index: &ChartIndex,
    traces: &[TraceOnMap],
    sets: &[Set],
    settings: &StatisticsSettings,
) -> Result<Summary, super::Error> {
    for (key, value) in [("scanline_spacing_m", settings.scanline_spacing_m), ("interval_m", settings.interval_m)] {
        if !(value > 0.0 && value.is_finite()) {
            return Err(super::Error::Setting { key, value, must: "a positive number of metres" });
        }
    }
    let mesh = index.chart().strip().mesh();
    let normals = mesh.vertex_normals();
    let faces = 0..mesh.faces().len() as u32;
    let area: f64 =
        faces.filter(|&f| mesh.observed()[f as usize]).map(|f| mesh.double_area_vector(f).norm() / 2.0).sum();
    let lengths: Vec<f64> = traces.iter().map(|t| observed_length(index, t, &normals)).collect();
    let lines = scanlines(index, traces, settings.scanline_spacing_m);
    let scanline_m: f64 = lines.iter().flat_map(|l| &l.pieces).map(|p| p.2).sum();
    let of = |set: u32, belongs: &dyn Fn(Option<u32>) -> bool, normal: Option<&Vec3>| {
        let members: Vec<f64> =
            traces.iter().zip(&lengths).filter(|(t, l)| belongs(t.set) && **l > 0.0).map(|(_, l)| *l).collect();
        let mut spacings = Vec::new();
        let mut crossings = 0;
        for line in &lines {
            let own: Vec<&Crossing> = line.crossings.iter().filter(|c| belongs(c.set)).collect();
            crossings += own.len();
            if let Some(normal) = normal {
                spacings.extend(own.windows(2).map(|w| normal.dot(&(w[1].position - w[0].position)).abs()));
            }
        }
        let length: f64 = members.iter().sum();
        let mean = (!spacings.is_empty()).then(|| spacings.iter().sum::<f64>() / spacings.len() as f64);
        let per = |x: f64, whole: f64| if whole > 0.0 { x / whole } else { 0.0 };
        Spacing {
            set,
            traces: members.len(),
            trace_length_m: length,
            p10_per_m: per(crossings as f64, scanline_m),
            p20_per_m2: per(members.len() as f64, area),
            p21_m_per_m2: per(length, area),
            spacings: spacings.len(),
            mean_spacing_m: mean,
            median_spacing_m: statistics::median(&mut spacings),
        }
    };
    let mut told: Vec<Spacing> =
        sets.iter().map(|s| of(s.number, &|set| set == Some(s.number), Some(&s.normal))).collect();
    told.push(of(0, &|set| set.is_none(), None));
    Ok(Summary {
        observed_area_m2: area,
        scanline_m,
        all: of(0, &|_| true, None),
        sets: told,
        intervals: intervals(&lines, settings.interval_m),
    })
}

fn intervals(lines: &[Scanline], interval_m: f64) -> Vec<Interval> {
    let ends = lines.iter().flat_map(|l| &l.pieces).fold(None::<(f64, f64)>, |range, p| match range {
        None => Some((p.0, p.1)),
        Some((low, high)) => Some((low.min(p.0), high.max(p.1))),
    });
    let Some((low, high)) = ends else { return Vec::new() };
    let first = (low / interval_m).floor() as i64;
    let last = ((high / interval_m).ceil() as i64).max(first + 1);
    (first..last)
        .map(|k| {
            let (from, to) = (k as f64 * interval_m, (k + 1) as f64 * interval_m);
            // A piece that reaches over the end of the interval counts by the share inside.
            let inside = |p: &(f64, f64, f64)| ((p.1.min(to) - p.0.max(from)).max(0.0) / (p.1 - p.0)) * p.2;
            let scanline_m: f64 = lines.iter().flat_map(|l| &l.pieces).map(inside).sum();
            let crossings = lines.iter().flat_map(|l| &l.crossings).filter(|c| c.u >= from && c.u < to).count();
            let rqd_percent = (scanline_m > 0.0).then(|| {
                let l = crossings as f64 / scanline_m;
                100.0 * (-0.1 * l).exp() * (0.1 * l + 1.0)
            });
            Interval { from_m: from, to_m: to, scanline_m, crossings, rqd_percent }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::example::flat_chart;

    #[test]
    fn parallel_lines_give_their_numbers() {
        // 10 m x 4 m flat map; traces straight across every 0.5 m from 0.25, tilted by 45 degrees against the scanlines.
        let chart = flat_chart(10.0, 4.0, 101, 41);
        let index = ChartIndex::of(&chart);
        let traces: Vec<TraceOnMap> = (0..10)
            .map(|k| TraceOnMap {
                parts: vec![vec![Vec2::new(0.25 + 0.5 * f64::from(k), 0.1), Vec2::new(3.85 + 0.5 * f64::from(k), 3.7)]],
                set: Some(1),
            })
            .collect();
        let normal = Vec3::new(1.0, -1.0, 0.0).normalize();
        let set = Set { number: 1, normal, dip_deg: 90.0, dip_direction_deg: 135.0, planes: 10, fisher_k: None };
        let found = statistics(&index, &traces, &[set], &StatisticsSettings::default()).unwrap();
        let length = 10.0 * 3.6 * std::f64::consts::SQRT_2;
        assert!((found.observed_area_m2 - 40.0).abs() < 1e-9 && (found.scanline_m - 80.0).abs() < 1e-6);
        assert!((found.all.p21_m_per_m2 - length / 40.0).abs() < 1e-9);
        assert!((found.all.p20_per_m2 - 0.25).abs() < 1e-12);
        // Seven scanlines lie within the traces' girths (0.25 ... 3.25), each meets all ten.
        assert!((found.sets[0].p10_per_m - 70.0 / 80.0).abs() < 1e-9, "{:?}", found.sets[0]);
        let spacing = found.sets[0].mean_spacing_m.unwrap();
        assert!((spacing - 0.5 * 0.5f64.sqrt()).abs() < 1e-9, "{spacing}");
        let crossings: usize = found.intervals.iter().map(|i| i.crossings).sum();
        assert_eq!((found.intervals.len(), crossings), (2, 70));
        let l = found.intervals[0].crossings as f64 / found.intervals[0].scanline_m;
        assert!((found.intervals[0].rqd_percent.unwrap() - 100.0 * (-0.1 * l).exp() * (0.1 * l + 1.0)).abs() < 1e-9);
    }
}
