//! Tunnel sections in closed form: the outline as a function of girth, and back.
//!
//! Section coordinates are metres (right, up) from the axis, looking along increasing chainage. Every section is
//! symmetric, so only the right half is described, from the crown (girth 0) to the invert (half the perimeter).

use std::f64::consts::PI;

/// Panels of the arc-length table of half an ellipse; with eight Gauss points each the lengths are exact to 1e-14.
const ELLIPSE_PANELS: usize = 64;

/// Abscissae and weights of the 8-point Gauss-Legendre rule (positive half).
const GAUSS_8: [(f64, f64); 4] = [
    (0.183_434_642_495_649_8, 0.362_683_783_378_362),
    (0.525_532_409_916_329, 0.313_706_645_877_887_3),
    (0.796_666_477_413_626_7, 0.222_381_034_453_374_48),
    (0.960_289_856_497_536_3, 0.101_228_536_290_376_26),
];

/// A point of the outline with its local directions, all in (right, up).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OutlinePoint {
    /// Metres to the right of the axis.
    pub right: f64,
    /// Metres above the axis.
    pub up: f64,
    /// Unit direction of increasing girth.
    pub along: [f64; 2],
    /// Unit normal that points out of the void, into the rock.
    pub outward: [f64; 2],
}

/// Where a point of the section lies relative to the outline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Foot {
    /// Signed girth of the closest outline point.
    pub girth: f64,
    /// Distance from the outline: positive in the rock, negative in the void.
    pub outward: f64,
}

/// One smooth stretch of the right half of the outline.
#[derive(Clone, Debug, PartialEq)]
enum Piece {
    Line { from: [f64; 2], along: [f64; 2], length: f64 },
    Arc { centre: [f64; 2], radius: f64, start: f64, sweep: f64 },
    HalfEllipse { half_width: f64, half_height: f64, lengths: Vec<f64> },
}

/// A closed, left-right symmetric section.
#[derive(Clone, Debug, PartialEq)]
pub struct Section {
    pieces: Vec<Piece>,
    /// Girth at the start of each piece, and the half perimeter at the end.
    starts: Vec<f64>,
    /// Absolute girths at which the outline has a corner (the invert of a flat floor is none).
    corners: Vec<f64>,
}

impl Section {
    /// A circle around the axis.
    pub fn circle(radius_m: f64) -> Self {
        Self::from_pieces(vec![Piece::Arc { centre: [0.0, 0.0], radius: radius_m, start: 0.0, sweep: PI }])
    }

    /// An ellipse around the axis.
    pub fn ellipse(width_m: f64, height_m: f64) -> Self {
        Self::from_pieces(vec![half_ellipse(width_m / 2.0, height_m / 2.0)])
    }

    /// Flat floor, vertical walls and a semicircular roof; the axis runs at half height. When `height_m` is less
    /// than half of `width_m` there are no walls and the roof is a circular segment.
    pub fn horseshoe(width_m: f64, height_m: f64) -> Self {
        let (half, top) = (width_m / 2.0, height_m / 2.0);
        let wall = height_m - half;
        if wall <= 0.0 {
            let roof = Piece::Line { from: [half, -top], along: [-1.0, 0.0], length: half };
            return Self::from_pieces(vec![segment_roof(half, height_m, -top), roof]);
        }
        let spring = top - half;
        Self::from_pieces(vec![
            Piece::Arc { centre: [0.0, spring], radius: half, start: 0.0, sweep: PI / 2.0 },
            Piece::Line { from: [half, spring], along: [0.0, -1.0], length: wall },
            Piece::Line { from: [half, -top], along: [-1.0, 0.0], length: half },
        ])
    }

    /// A regular polygon with an even number of sides and a flat roof and floor, at distance `inradius_m` around the
    /// axis: a tunnel with this section is a prism, which unfolds without any distortion.
    ///
    /// # Panics
    /// When `sides` is odd or below 4.
    pub fn prism(sides: usize, inradius_m: f64) -> Self {
        assert!(sides >= 4 && sides.is_multiple_of(2), "a prism needs an even number of sides, at least 4");
        let step = 2.0 * PI / sides as f64;
        let side = 2.0 * inradius_m * (step / 2.0).tan();
        let reach = inradius_m / (step / 2.0).cos();
        let corner = |k: usize| {
            let angle = (k as f64 + 0.5) * step;
            [reach * angle.sin(), reach * angle.cos()]
        };
        let mut pieces = vec![Piece::Line { from: [0.0, inradius_m], along: [1.0, 0.0], length: side / 2.0 }];
        for k in 0..sides / 2 - 1 {
            let direction = (k + 1) as f64 * step;
            pieces.push(Piece::Line { from: corner(k), along: [direction.cos(), -direction.sin()], length: side });
        }
        pieces.push(Piece::Line { from: corner(sides / 2 - 1), along: [-1.0, 0.0], length: side / 2.0 });
        Self::from_pieces(pieces)
    }

    fn from_pieces(pieces: Vec<Piece>) -> Self {
        let mut starts = vec![0.0];
        for piece in &pieces {
            starts.push(starts[starts.len() - 1] + piece.length());
        }
        let mut corners = Vec::new();
        for (k, pair) in pieces.windows(2).enumerate() {
            let (before, after) = (pair[0].point(pair[0].length()).along, pair[1].point(0.0).along);
            if before[0] * after[0] + before[1] * after[1] < 1.0 - 1e-9 {
                corners.push(starts[k + 1]);
            }
        }
        Self { pieces, starts, corners }
    }

    /// Length of the whole outline, metres.
    pub fn perimeter(&self) -> f64 {
        2.0 * self.half_perimeter()
    }

    /// Girth from the crown to the invert, metres.
    pub fn half_perimeter(&self) -> f64 {
        self.starts[self.starts.len() - 1]
    }

    /// Absolute girths of the corners of the outline, e.g. where the walls meet the floor.
    pub fn corners(&self) -> &[f64] {
        &self.corners
    }

    /// Absolute girth beyond which the outline is floor: where the last flat piece begins. `None` for sections
    /// without a flat floor.
    pub fn floor_girth(&self) -> Option<f64> {
        match self.pieces[self.pieces.len() - 1] {
            Piece::Line { .. } => Some(self.starts[self.pieces.len() - 1]),
            _ => None,
        }
    }

    /// Height of the invert relative to the axis (negative).
    pub fn invert_up(&self) -> f64 {
        self.point(self.half_perimeter()).up
    }

    /// The outline at a signed girth; girths beyond the invert wrap around.
    pub fn point(&self, girth: f64) -> OutlinePoint {
        let half = self.half_perimeter();
        let mut girth = girth;
        if girth.abs() > half {
            girth -= 2.0 * half * (girth / (2.0 * half)).round();
        }
        let distance = girth.abs();
        let k = self.starts[1..self.pieces.len()].iter().take_while(|&&s| s <= distance).count();
        let mut p = self.pieces[k].point(distance - self.starts[k]);
        if girth < 0.0 {
            p.right = -p.right;
            // Girth runs towards the crown on the left half.
            p.along = [p.along[0], -p.along[1]];
            p.outward[0] = -p.outward[0];
        }
        p
    }

    /// The outline point closest to (right, up).
    pub fn foot(&self, right: f64, up: f64) -> Foot {
        let mut best = Foot { girth: 0.0, outward: f64::INFINITY };
        for (piece, start) in self.pieces.iter().zip(&self.starts) {
            let distance = piece.closest(right.abs(), up);
            let p = piece.point(distance);
            let (dr, du) = (right.abs() - p.right, up - p.up);
            let reach = dr.hypot(du);
            if reach < best.outward.abs() {
                let side = dr * p.outward[0] + du * p.outward[1];
                best = Foot { girth: start + distance, outward: if side < 0.0 { -reach } else { reach } };
            }
        }
        if right < 0.0 {
            best.girth = -best.girth;
        }
        best
    }
}

/// The right half of a full ellipse around the axis, crown to invert.
fn half_ellipse(half_width: f64, half_height: f64) -> Piece {
    let mut lengths = vec![0.0];
    for k in 0..ELLIPSE_PANELS {
        let panel = PI / ELLIPSE_PANELS as f64;
        let length = ellipse_length(half_width, half_height, k as f64 * panel, (k + 1) as f64 * panel);
        lengths.push(lengths[k] + length);
    }
    Piece::HalfEllipse { half_width, half_height, lengths }
}

/// A low roof: the circular segment of the given height over the floor.
fn segment_roof(half_width: f64, height: f64, floor: f64) -> Piece {
    // A circular segment: radius from chord and rise.
    let radius = (half_width * half_width + height * height) / (2.0 * height);
    let sweep = half_width.atan2(radius - height);
    Piece::Arc { centre: [0.0, floor + height - radius], radius, start: 0.0, sweep }
}

/// Arc length of the ellipse (half_width sin t, half_height cos t) between two parameters.
fn ellipse_length(half_width: f64, half_height: f64, from: f64, to: f64) -> f64 {
    let (middle, reach) = ((from + to) / 2.0, (to - from) / 2.0);
    let speed = |t: f64| (half_width * t.cos()).hypot(half_height * t.sin());
    reach * GAUSS_8.iter().map(|&(x, w)| w * (speed(middle - reach * x) + speed(middle + reach * x))).sum::<f64>()
}

impl Piece {
    fn length(&self) -> f64 {
        match self {
            Piece::Line { length, .. } => *length,
            Piece::Arc { radius, sweep, .. } => radius * sweep,
            Piece::HalfEllipse { lengths, .. } => lengths[ELLIPSE_PANELS],
        }
    }

    fn point(&self, distance: f64) -> OutlinePoint {
        match self {
            Piece::Line { from, along, .. } => OutlinePoint {
                right: from[0] + along[0] * distance,
                up: from[1] + along[1] * distance,
                along: *along,
                outward: [-along[1], along[0]],
            },
            Piece::Arc { centre, radius, start, .. } => {
                let (sin, cos) = (start + distance / radius).sin_cos();
                OutlinePoint {
                    right: centre[0] + radius * sin,
                    up: centre[1] + radius * cos,
                    along: [cos, -sin],
                    outward: [sin, cos],
                }
            }
            Piece::HalfEllipse { half_width, half_height, lengths } => ellipse_point(
                *half_width,
                *half_height,
                ellipse_parameter(*half_width, *half_height, lengths, distance),
            ),
        }
    }

    /// Distance along the piece of its point closest to (right, up), with right >= 0.
    fn closest(&self, right: f64, up: f64) -> f64 {
        match self {
            Piece::Line { from, along, length } => {
                ((right - from[0]) * along[0] + (up - from[1]) * along[1]).clamp(0.0, *length)
            }
            Piece::Arc { centre, radius, start, sweep } => {
                let angle = (right - centre[0]).atan2(up - centre[1]) - start;
                radius * angle.clamp(0.0, *sweep)
            }
            Piece::HalfEllipse { half_width, half_height, lengths } => {
                let t = ellipse_closest(*half_width, *half_height, right, up);
                let panel = PI / ELLIPSE_PANELS as f64;
                let k = ((t / panel) as usize).min(ELLIPSE_PANELS - 1);
                lengths[k] + ellipse_length(*half_width, *half_height, k as f64 * panel, t)
            }
        }
    }
}

fn ellipse_point(half_width: f64, half_height: f64, t: f64) -> OutlinePoint {
    let (sin, cos) = t.sin_cos();
    let speed = (half_width * cos).hypot(half_height * sin);
    let along = [half_width * cos / speed, -half_height * sin / speed];
    OutlinePoint { right: half_width * sin, up: half_height * cos, along, outward: [-along[1], along[0]] }
}

/// Parameter of the ellipse at an arc length from the crown, by Newton steps from the table.
fn ellipse_parameter(half_width: f64, half_height: f64, lengths: &[f64], distance: f64) -> f64 {
    let panel = PI / ELLIPSE_PANELS as f64;
    let k = lengths[1..ELLIPSE_PANELS].iter().take_while(|&&l| l <= distance).count();
    let start = k as f64 * panel;
    let mut t = start + panel * (distance - lengths[k]) / (lengths[k + 1] - lengths[k]);
    for _ in 0..4 {
        let excess = lengths[k] + ellipse_length(half_width, half_height, start, t) - distance;
        t -= excess / (half_width * t.cos()).hypot(half_height * t.sin());
    }
    t
}

/// Parameter in [0, pi] of the ellipse point closest to (right, up), right >= 0.
fn ellipse_closest(half_width: f64, half_height: f64, right: f64, up: f64) -> f64 {
    // Distance along the tangent direction is monotone between the axes; bisection is safe where Newton is not.
    let slope = |t: f64| {
        let (sin, cos) = t.sin_cos();
        (half_width * sin - right) * half_width * cos - (half_height * cos - up) * half_height * sin
    };
    let (mut low, mut high) = if up >= 0.0 { (0.0, PI / 2.0) } else { (PI / 2.0, PI) };
    for _ in 0..60 {
        let middle = (low + high) / 2.0;
        if slope(middle) < 0.0 {
            low = middle;
        } else {
            high = middle;
        }
    }
    (low + high) / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sections() -> Vec<Section> {
        vec![
            Section::circle(2.0),
            Section::ellipse(5.0, 4.0),
            Section::horseshoe(8.2, 6.7),
            Section::horseshoe(6.0, 2.0),
            Section::prism(8, 2.0),
        ]
    }

    #[test]
    fn perimeters_are_exact() {
        assert!((Section::circle(2.0).perimeter() - 4.0 * PI).abs() < 1e-14);
        // 8.2 m floor, two walls of 2.6 m, half a circle of 4.1 m.
        assert!((Section::horseshoe(8.2, 6.7).perimeter() - (8.2 + 5.2 + 4.1 * PI)).abs() < 1e-13);
        assert!((Section::prism(6, 1.0).perimeter() - 12.0 / 3.0_f64.sqrt()).abs() < 1e-13);
        // Complete elliptic integral E(m = 0.36) = 1.4180833944487241: perimeter 4 a E for a = 2.5, b = 2.
        assert!((Section::ellipse(5.0, 4.0).perimeter() - 10.0 * 1.418_083_394_448_724).abs() < 1e-12);
    }

    #[test]
    fn girth_is_arc_length_and_directions_follow_it() {
        for section in sections() {
            let half = section.half_perimeter();
            let step = 1e-6;
            for k in 0..200 {
                let g = -half + (k as f64 + 0.37) * half / 100.0;
                let (a, b) = (section.point(g - step), section.point(g + step));
                let p = section.point(g);
                let (dr, du) = (b.right - a.right, b.up - a.up);
                assert!((dr.hypot(du) / (2.0 * step) - 1.0).abs() < 1e-6, "{section:?} at {g}");
                assert!((dr / (2.0 * step) - p.along[0]).abs() < 1e-5 && (du / (2.0 * step) - p.along[1]).abs() < 1e-5);
                // The outward normal is left of the direction of girth.
                assert!((p.outward[0] + p.along[1]).abs() < 1e-12 && (p.outward[1] - p.along[0]).abs() < 1e-12);
                assert!(p.right * p.outward[0] + p.up * p.outward[1] > 0.0);
                assert!(g * p.right >= 0.0, "positive girth lies right");
            }
            assert!(section.point(0.0).right.abs() < 1e-12 && section.point(0.0).up > 0.0);
            assert!(section.point(half).right.abs() < 1e-12 && section.point(half).up < 0.0);
        }
    }

    #[test]
    fn foot_inverts_point() {
        for section in sections() {
            let half = section.half_perimeter();
            for k in 0..100 {
                let g = -half + (k as f64 + 0.37) * half / 50.0;
                if section.corners().iter().any(|c| (c - g.abs()).abs() < 0.12) {
                    continue;
                }
                let p = section.point(g);
                for offset in [-0.1, 0.0, 0.1] {
                    let f = section.foot(p.right + offset * p.outward[0], p.up + offset * p.outward[1]);
                    assert!((f.girth - g).abs() < 1e-9, "{section:?} {g} {offset} {f:?}");
                    assert!((f.outward - offset).abs() < 1e-9);
                }
            }
        }
    }

    #[test]
    fn flat_floors_are_known() {
        let s = Section::horseshoe(8.2, 6.7);
        assert!((s.floor_girth().unwrap() - (4.1 * PI / 2.0 + 2.6)).abs() < 1e-12);
        assert_eq!(s.corners().len(), 1);
        assert_eq!(Section::circle(1.0).floor_girth(), None);
        assert!((s.invert_up() + 3.35).abs() < 1e-12);
    }
}
