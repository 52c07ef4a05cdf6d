//! The exact way of a straight map segment over the surface: which faces it crosses, and where.
//!
//! A segment on the map is straight; on the surface it bends at every edge that it crosses, and nowhere else, because the
//! map is linear on each face. So the surface curve is exact when each crossing is a vertex. The segment is clipped
//! against the faces of the grid cells along it; where no face lies under it, the route has a gap.
//! Where the map covers itself the face with the lowest number is meant, as everywhere
//! ([`crate::unwrap::ChartIndex`]). Cost: proportional to the number of faces near the segment.

use crate::mesh::{FaceId, SurfacePoint};
use crate::numeric::Vec2;
use crate::unwrap::ChartIndex;

/// Parts of a segment shorter than this share of it are no pieces of their own: rounding.
const SHORTEST: f64 = 1e-12;
/// A face that the segment only touches within rounding is not crossed (barycentric).
const SLACK: f64 = 1e-12;

/// A straight piece of a segment on one face.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece {
    /// Where it begins and ends along the segment, 0 to 1.
    pub t: [f64; 2],
    /// The surface at both ends, offset 0.
    pub ends: [SurfacePoint; 2],
}

/// What lies under a segment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Route {
    /// Pieces in order; between two of them may be a gap.
    pub pieces: Vec<Piece>,
}

impl Route {
    /// Share of the segment that has a surface under it.
    pub fn covered(&self) -> f64 {
        self.pieces.iter().map(|p| p.t[1] - p.t[0]).sum()
    }
}

/// The part of the segment from `a` to `b` inside a counter-clockwise triangle, as values of the segment's parameter.
fn clip([p, q, r]: [Vec2; 3], a: Vec2, b: Vec2) -> Option<[f64; 2]> {
    let area = (q - p).perp(&(r - p));
    if !(area > 0.0) {
        return None;
    }
    let (mut low, mut high) = (0.0f64, 1.0f64);
    for (from, to) in [(p, q), (q, r), (r, p)] {
        let side = to - from;
        let (at_a, at_b) = (side.perp(&(a - from)) / area, side.perp(&(b - from)) / area);
        if at_a < -SLACK && at_b < -SLACK {
            return None;
        }
        let slope = at_b - at_a;
        if at_a < 0.0 && slope > 0.0 {
            low = low.max(-at_a / slope);
        } else if at_b < 0.0 && slope < 0.0 {
            high = high.min(-at_a / slope);
        }
    }
    (high - low > SHORTEST).then_some([low, high])
}

/// The way of the segment from `a` to `b` over the surface.
pub fn route(index: &ChartIndex, a: Vec2, b: Vec2) -> Route {
    let chart = index.chart();
    let crossed: Vec<(FaceId, [f64; 2])> = index
        .faces_along(a, b)
        .into_iter()
        .filter_map(|face| Some((face, clip(chart.corners_in_chart(face), a, b)?)))
        .collect();
    let mut cuts: Vec<f64> = crossed.iter().flat_map(|(_, t)| *t).collect();
    cuts.sort_by(f64::total_cmp);
    // Neighbouring faces compute the same crossing with different rounding.
    cuts.dedup_by(|x, y| *x - *y <= SHORTEST);
    let mut by_start = crossed;
    by_start.sort_by(|x, y| x.1[0].total_cmp(&y.1[0]).then(x.0.cmp(&y.0)));
    let mut route = Route::default();
    let (mut next, mut open): (usize, Vec<(FaceId, [f64; 2])>) = (0, Vec::new());
    for pair in cuts.windows(2) {
        let middle = (pair[0] + pair[1]) / 2.0;
        while next < by_start.len() && by_start[next].1[0] <= middle {
            open.push(by_start[next]);
            next += 1;
        }
        open.retain(|(_, t)| t[1] >= middle);
        let Some(&(face, _)) = open.iter().min_by_key(|(face, _)| *face) else { continue };
        let corners = chart.corners_in_chart(face);
        let at = |t: f64| SurfacePoint { face, barycentric: weights(corners, a + (b - a) * t), offset: 0.0 };
        match route.pieces.last_mut() {
            // Another face began or ended meanwhile, but this one goes on.
            Some(last) if last.ends[0].face == face && last.t[1] == pair[0] => {
                *last = Piece { t: [last.t[0], pair[1]], ends: [last.ends[0], at(pair[1])] };
            }
            _ => route.pieces.push(Piece { t: [pair[0], pair[1]], ends: [at(pair[0]), at(pair[1])] }),
        }
    }
    route
}

fn weights([a, b, c]: [Vec2; 3], p: Vec2) -> [f64; 3] {
    let area = (b - a).perp(&(c - a));
    let (wa, wb) = ((b - p).perp(&(c - p)) / area, (c - p).perp(&(a - p)) / area);
    [wa, wb, 1.0 - wa - wb]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::example::flat_chart;

    #[test]
    fn pieces_follow_each_other_without_gap_and_end_on_the_segment() {
        let chart = flat_chart(2.0, 1.0, 21, 11);
        let index = ChartIndex::of(&chart);
        let mesh = chart.strip().mesh();
        for (a, b) in [
            (Vec2::new(0.033, 0.071), Vec2::new(1.91, 0.93)),
            // Along edges and through vertices.
            (Vec2::new(0.1, 0.5), Vec2::new(1.9, 0.5)),
            (Vec2::new(0.2, 0.2), Vec2::new(0.8, 0.8)),
            (Vec2::new(1.3, 0.9), Vec2::new(1.3, 0.1)),
        ] {
            let found = route(&index, a, b);
            assert!((found.covered() - 1.0).abs() < 1e-9, "{a:?} {b:?}: {}", found.covered());
            for pair in found.pieces.windows(2) {
                assert!((pair[0].t[1] - pair[1].t[0]).abs() < 1e-9);
            }
            for piece in &found.pieces {
                for (t, end) in piece.t.iter().zip(&piece.ends) {
                    assert!((end.in_chart(mesh, chart.uv()) - (a + (b - a) * *t)).norm() < 1e-12);
                    assert!(end.barycentric.iter().all(|w| *w > -1e-9), "{end:?}");
                }
            }
        }
    }

    #[test]
    fn beside_the_map_there_is_a_gap() {
        let chart = flat_chart(2.0, 1.0, 21, 11);
        let index = ChartIndex::of(&chart);
        let found = route(&index, Vec2::new(-1.0, 0.5), Vec2::new(1.0, 0.5));
        assert!((found.covered() - 0.5).abs() < 1e-9);
        assert!((found.pieces[0].t[0] - 0.5).abs() < 1e-9);
        assert!(route(&index, Vec2::new(-2.0, 0.5), Vec2::new(-1.0, 0.5)).pieces.is_empty());
    }
}
