//! From a place on the map back to the surface: (u, v) to face and barycentric coordinates, and the round-trip figure.
//!
//! A grid over the chart lists the faces of each cell; the orientation of a place to the three sides of a candidate is
//! computed in a form that has the same sign from both faces of an edge, so no place between two faces is lost.
//! Where the chart covers itself (its border crosses itself beside a notch or a hole), the face with the lowest number
//! answers; what is anchored to the sheet below has no place on the map that leads back to it ([`covered_points`]).
//! Cost: linear to build, constant a query.

use super::Chart;
use crate::mesh::anchor::Anchors;
use crate::mesh::{FaceId, SurfacePoint};
use crate::numeric::{Vec2, Vec3, statistics};
use rayon::prelude::*;
use serde::Serialize;

/// Faces a cell lists on average.
const FACES_PER_CELL: f64 = 2.0;
/// A place this little outside a face (barycentric) is inside: rounding.
const INSIDE: f64 = -1e-9;

/// Finds the face under a place on the map.
pub struct ChartIndex<'a> {
    chart: &'a Chart,
    lowest: Vec2,
    cell: f64,
    columns: usize,
    rows: usize,
    /// First entry of each cell in `faces`.
    start: Vec<u32>,
    faces: Vec<u32>,
}

impl<'a> ChartIndex<'a> {
    /// Builds the grid.
    pub fn of(chart: &'a Chart) -> Self {
        let mesh = chart.strip().mesh();
        let (mut lowest, mut highest) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
        for &v in mesh.faces().iter().flatten() {
            lowest = lowest.inf(&chart.uv()[v as usize]);
            highest = highest.sup(&chart.uv()[v as usize]);
        }
        let extent = highest - lowest;
        let count = mesh.faces().len() as f64;
        // The limit keeps a chart that is much longer than wide, or nearly empty, from needing a huge grid.
        let cell = (extent.x * extent.y * FACES_PER_CELL / count).sqrt().max(extent.max() / 100_000.0).max(1e-12);
        let columns = (extent.x / cell) as usize + 1;
        let rows = (extent.y / cell) as usize + 1;
        let mut index = Self { chart, lowest, cell, columns, rows, start: Vec::new(), faces: Vec::new() };
        let mut start = vec![0u32; columns * rows + 1];
        for f in 0..mesh.faces().len() as u32 {
            index.for_cells(f, |cell| start[cell + 1] += 1);
        }
        for i in 1..start.len() {
            start[i] += start[i - 1];
        }
        let mut fill = start.clone();
        let mut faces = vec![0u32; start[start.len() - 1] as usize];
        for f in 0..mesh.faces().len() as u32 {
            index.for_cells(f, |cell| {
                faces[fill[cell] as usize] = f;
                fill[cell] += 1;
            });
        }
        index.start = start;
        index.faces = faces;
        index
    }

    fn for_cells(&self, face: u32, mut visit: impl FnMut(usize)) {
        let [a, b, c] = self.chart.corners_in_chart(face);
        let (low, high) = (a.inf(&b).inf(&c) - self.lowest, a.sup(&b).sup(&c) - self.lowest);
        let last = |i: usize, count: usize| i.min(count - 1);
        for i in (low.x / self.cell) as usize..=last((high.x / self.cell) as usize, self.columns) {
            for j in (low.y / self.cell) as usize..=last((high.y / self.cell) as usize, self.rows) {
                visit(j * self.columns + i);
            }
        }
    }

    /// The chart that is searched.
    pub fn chart(&self) -> &'a Chart {
        self.chart
    }

    /// All faces in the cells that the segment from `a` to `b` may touch, each once, by number.
    pub fn faces_along(&self, a: Vec2, b: Vec2) -> Vec<FaceId> {
        let mut faces = Vec::new();
        let (from, to) = ((a - self.lowest) / self.cell, (b - self.lowest) / self.cell);
        let (from, to) = if from.x <= to.x { (from, to) } else { (to, from) };
        let last = self.columns as f64 - 1.0;
        let (first_column, last_column) = ((from.x - 1e-6).floor().max(0.0), (to.x + 1e-6).floor().min(last));
        let mut column = first_column;
        while column <= last_column {
            // Rows that the segment passes while it is in the column, one cell of rounding wider.
            let at = |x: f64| match to.x - from.x {
                width if width > 0.0 => from.y + (to.y - from.y) * ((x - from.x) / width).clamp(0.0, 1.0),
                _ => from.y,
            };
            let (mut low, mut high) = (at(column - 1e-6), at(column + 1.0 + 1e-6));
            if to.x - from.x <= 1.0 {
                (low, high) = (from.y, to.y);
            }
            let rows =
                ((low.min(high) - 1e-6).floor().max(0.0), (low.max(high) + 1e-6).floor().min(self.rows as f64 - 1.0));
            let mut row = rows.0;
            while row <= rows.1 {
                let cell = row as usize * self.columns + column as usize;
                faces.extend_from_slice(&self.faces[self.start[cell] as usize..self.start[cell + 1] as usize]);
                row += 1.0;
            }
            column += 1.0;
        }
        faces.sort_unstable();
        faces.dedup();
        faces
    }

    /// The surface under a place on the map, at offset 0; `None` beside the map and in its holes.
    pub fn surface_point(&self, place: Vec2) -> Option<SurfacePoint> {
        let at = (place - self.lowest) / self.cell;
        // Places on the border may come out a rounding error beside it.
        let slack = 1e-9;
        if !(at.x >= -slack && at.y >= -slack) {
            return None;
        }
        let (i, j) = (at.x.max(0.0) as usize, at.y.max(0.0) as usize);
        let (i, j) = (i.min(self.columns - 1), j.min(self.rows - 1));
        if at.x > self.columns as f64 + slack || at.y > self.rows as f64 + slack {
            return None;
        }
        let cell = j * self.columns + i;
        let mut nearest: Option<(f64, SurfacePoint)> = None;
        for &face in &self.faces[self.start[cell] as usize..self.start[cell + 1] as usize] {
            let Some(barycentric) = barycentric(self.chart.corners_in_chart(face), place) else { continue };
            let lowest = barycentric.iter().copied().fold(f64::INFINITY, f64::min);
            let point = SurfacePoint { face, barycentric, offset: 0.0 };
            if lowest >= 0.0 {
                return Some(point);
            }
            if lowest >= INSIDE && nearest.is_none_or(|(best, _)| lowest > best) {
                nearest = Some((lowest, point));
            }
        }
        nearest.map(|(_, point)| point)
    }
}

/// Barycentric coordinates of a place in a counter-clockwise triangle; `None` when it has no area or is flipped.
fn barycentric([a, b, c]: [Vec2; 3], p: Vec2) -> Option<[f64; 3]> {
    let area = (b - a).perp(&(c - a));
    if area <= 0.0 || area.is_nan() {
        return None;
    }
    let (wa, wb) = ((b - p).perp(&(c - p)) / area, (c - p).perp(&(a - p)) / area);
    Some([wa, wb, 1.0 - wa - wb])
}

/// A point whose place on the map leads to a surface point farther than this from its own, metres, lies on a covered
/// sheet. Rounding between neighbouring faces stays far below.
const COVERED_M: f64 = 1e-7;
/// Points sent by one task.
const RUN: usize = 4096;

fn is_elsewhere(back: &Vec3, sent: &Vec3) -> bool {
    !((back - sent).norm() <= COVERED_M)
}

/// The points that the map cannot tell apart from others: their place is covered by another sheet of the chart, which
/// happens where the border of the chart crosses itself. The map shows one sheet; the points of the other have no place.
pub fn covered_points(index: &ChartIndex, anchors: &Anchors) -> Vec<usize> {
    let mesh = index.chart.strip().mesh();
    let normals = mesh.vertex_normals();
    (0..anchors.len())
        .into_par_iter()
        .filter(|&i| {
            let Some(anchor) = anchors.get(i) else { return false };
            match index.surface_point(anchor.in_chart(mesh, index.chart.uv())) {
                Some(foot) if foot.face == anchor.face => false,
                Some(foot) => {
                    let back = SurfacePoint { offset: anchor.offset, ..foot }.position(mesh, &normals);
                    is_elsewhere(&back, &anchor.position(mesh, &normals))
                }
                // A flipped or collapsed face: nothing of it is on the map.
                None => true,
            }
        })
        .collect()
}

/// [`covered_points`], and the [`round_trip`] of all others, with one search of the map for both. `normals` are the
/// vertex normals of the chart's mesh.
pub fn covered_and_round_trip(
    index: &ChartIndex,
    anchors: &Anchors,
    points: &[Vec3],
    normals: &[Vec3],
) -> (Vec<usize>, RoundTrip) {
    let mesh = index.chart.strip().mesh();
    let of_run = |first: usize| {
        let (mut covered, mut distances) = (Vec::new(), Vec::with_capacity(RUN));
        for i in first..(first + RUN).min(points.len()) {
            let Some(anchor) = anchors.get(i) else { continue };
            let back = index.surface_point(anchor.in_chart(mesh, index.chart.uv())).map(|foot| {
                let position = SurfacePoint { offset: anchor.offset, ..foot }.position(mesh, normals);
                (foot.face, position)
            });
            match back {
                Some((face, back)) if face == anchor.face || !is_elsewhere(&back, &anchor.position(mesh, normals)) => {
                    if anchors.is_exact(i) {
                        distances.push((back - points[i]).norm());
                    }
                }
                // A flipped or collapsed face has nothing on the map.
                _ => covered.push(i),
            }
        }
        (covered, distances)
    };
    let runs: Vec<(Vec<usize>, Vec<f64>)> = (0..points.len()).into_par_iter().step_by(RUN).map(of_run).collect();
    let (mut covered, mut distances) = (Vec::new(), Vec::with_capacity(points.len()));
    for (some, theirs) in runs {
        covered.extend(some);
        distances.extend(theirs);
    }
    (covered, RoundTrip::of(distances))
}

/// What came of sending every anchored point to the map and back.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RoundTrip {
    /// Points with an exact anchor that were sent.
    pub points: usize,
    /// Points under whose place the map has no surface.
    pub lost: usize,
    /// Largest distance between a point and what came back, metres.
    pub max_m: f64,
    /// 99 % came back nearer than this, metres.
    pub p99_m: f64,
}

impl RoundTrip {
    /// From the distance of each point, infinite for those that were lost.
    fn of(distances: Vec<f64>) -> Self {
        let points = distances.len();
        let mut found = distances;
        found.retain(|d| d.is_finite());
        let max_m = found.iter().copied().fold(0.0, f64::max);
        let p99_m = statistics::quantile(&mut found, 0.99).unwrap_or(0.0);
        Self { points, lost: points - found.len(), max_m, p99_m }
    }
}

/// Sends every exactly anchored point to (u, v, offset), finds the surface under (u, v) anew, and measures how far the
/// point that comes back is from the one that was sent. Nothing of the anchor but (u, v, offset) is used on the way back.
pub fn round_trip(index: &ChartIndex, anchors: &Anchors, points: &[Vec3]) -> RoundTrip {
    let mesh = index.chart.strip().mesh();
    let normals = mesh.vertex_normals();
    let distances = (0..points.len())
        .into_par_iter()
        .filter(|&i| anchors.is_exact(i))
        .filter_map(|i| anchors.get(i).map(|anchor| (i, anchor)))
        .map(|(i, anchor)| match index.surface_point(anchor.in_chart(mesh, index.chart.uv())) {
            Some(foot) => {
                let back = SurfacePoint { offset: anchor.offset, ..foot }.position(mesh, &normals);
                (back - points[i]).norm()
            }
            None => f64::INFINITY,
        });
    RoundTrip::of(distances.collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::anchor::{Settings, anchor_points};
    use crate::unwrap::{self, closed_form};

    #[test]
    fn points_come_back_through_the_map() {
        let known = closed_form::rough(80, 90);
        let (chart, _) = unwrap::flatten(known.strip, Some(&known.axis), &unwrap::Settings::default()).unwrap();
        let mesh = chart.strip().mesh();
        // Two points above and below the middle of every face.
        let points: Vec<Vec3> = (0..mesh.faces().len() as u32)
            .flat_map(|f| {
                let [a, b, c] = mesh.corners(f);
                let (middle, normal) = ((a * 3.0 + b * 2.0 + c) / 6.0, mesh.double_area_vector(f).normalize());
                [middle + normal * 0.01, middle - normal * 0.02]
            })
            .collect();
        let (anchors, summary) = anchor_points(mesh, &points, &Settings::default());
        assert!(summary.clamped * 50 < summary.points && summary.unanchored == 0, "{summary:?}");
        let trip = round_trip(&ChartIndex::of(&chart), &anchors, &points);
        assert_eq!((trip.points, trip.lost), (summary.anchored, 0));
        assert!(trip.max_m < 1e-9 && trip.p99_m <= trip.max_m, "{trip:?}");
    }

    #[test]
    fn a_chart_that_does_not_belong_is_noticed() {
        let known = closed_form::prism();
        let mesh = known.strip.mesh().clone();
        let points: Vec<Vec3> =
            (0..mesh.faces().len() as u32).map(|f| mesh.corners(f).iter().sum::<Vec3>() / 3.0).collect();
        let (anchors, _) = anchor_points(&mesh, &points, &Settings::default());
        // All of the map folded onto one line of faces: the way back cannot tell them apart.
        let folded: Vec<Vec2> = known.flat.iter().map(|p| Vec2::new((p.x - 6.0).abs(), p.y)).collect();
        let chart = Chart::new(known.strip, folded).unwrap();
        let trip = round_trip(&ChartIndex::of(&chart), &anchors, &points);
        assert!(trip.max_m > 1.0 || trip.lost > 0, "{trip:?}");
    }

    #[test]
    fn points_of_a_covered_sheet_are_found_and_all_others_come_back() {
        let known = closed_form::prism();
        let mesh = known.strip.mesh().clone();
        let points: Vec<Vec3> =
            (0..mesh.faces().len() as u32).map(|f| mesh.corners(f).iter().sum::<Vec3>() / 3.0).collect();
        let (mut anchors, _) = anchor_points(&mesh, &points, &Settings::default());
        // The last part of the map slides back over the part before it: flipped faces and two sheets in that range.
        let slid: Vec<Vec2> = known.flat.iter().map(|p| Vec2::new(p.x - 0.6 * f64::from(p.x > 6.1), p.y)).collect();
        let chart = Chart::new(known.strip, slid).unwrap();
        let index = ChartIndex::of(&chart);
        let before = round_trip(&index, &anchors, &points);
        let covered = covered_points(&index, &anchors);
        assert!(before.max_m > 0.1 || before.lost > 0, "{before:?}");
        assert!(!covered.is_empty() && covered.len() * 2 < points.len(), "{}", covered.len());
        let both = covered_and_round_trip(&index, &anchors, &points, &mesh.vertex_normals());
        anchors.release(&covered);
        let after = round_trip(&index, &anchors, &points);
        assert_eq!(both, (covered.clone(), after.clone()));
        assert_eq!((after.points, after.lost), (points.len() - covered.len(), 0));
        assert!(after.max_m < 1e-9, "{after:?}");
    }

    #[test]
    fn beside_the_map_there_is_nothing() {
        let known = closed_form::half_cylinder();
        let chart = Chart::new(known.strip, known.flat).unwrap();
        let index = ChartIndex::of(&chart);
        assert_eq!(index.surface_point(Vec2::new(-0.01, 0.0)), None);
        assert_eq!(index.surface_point(Vec2::new(3.0, 20.0)), None);
        let middle = index.surface_point(Vec2::new(3.0, 0.1)).unwrap();
        assert!((middle.in_chart(chart.strip().mesh(), chart.uv()) - Vec2::new(3.0, 0.1)).norm() < 1e-12);
    }
}
