//! The borders of a surface, and what each of them is.
//!
//! A border that winds around the axis is an end of the tube: a portal, or where the scan ends. On a surface that none winds
//! around (one scanned wall, a trench, a missing floor) the longest border is its open edge. Of the others, one that goes
//! around most of a side opening is the rim of that opening, and the rest are holes: scan shadows.
//!
//! Cost: one projection onto the axis for each vertex of a border.

use super::openings::SideOpening;
use super::{Mesh, topology};
use crate::axis::{Axis, AxisCoordinates, Side};
use crate::numeric::{Vec3, wrap_angle};
use crate::warning::Warning;
use schemars::JsonSchema;
use serde::Serialize;
use std::f64::consts::TAU;

/// Every surface is trimmed at both ends of the axis, whether the tunnel goes on there, opens, or ends in a face.
const PORTALS_EXPECTED: usize = 2;
/// Borders that are listed one by one.
const MOST_LISTED: usize = 12;
/// The rim of a side opening encloses at least this share of it, along and around together.
const RIM_SHARE: f64 = 0.5;

/// What a border is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[schemars(rename = "BorderKind")]
pub enum Kind {
    /// It winds around the axis: an end of the tunnel, or of what was scanned of it.
    Portal,
    /// The outline of a surface that does not close around the axis.
    OpenEdge,
    /// The rim of a side drift, a niche or a room.
    SideOpening,
    /// A scan shadow.
    Hole,
}

/// One border.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Border {
    /// What it is.
    pub kind: Kind,
    /// Chainage of its middle, metres.
    pub chainage_m: f64,
    /// The side on which its middle lies, facing increasing chainage; absent for a border that winds around the axis.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub side: Option<Side>,
    /// Extent along the tunnel and around the axis, metres.
    pub width_m: [f64; 2],
    /// Length, metres.
    pub length_m: f64,
}

/// All borders of a surface, for the report.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Borders {
    /// Borders that wind around the axis.
    pub portals: usize,
    /// As many as a tube has that is trimmed at both ends of its axis.
    pub portals_expected: usize,
    /// Outlines of a surface that does not close around the axis: one scanned wall, a trench, a missing floor.
    pub open_edges: usize,
    /// Rims of side openings.
    pub side_openings: usize,
    /// Scan shadows and other holes.
    pub holes: usize,
    /// The longest borders, at most twelve, the longest first, holes after all others.
    pub longest: Vec<Border>,
}

/// Whole turns of a border around the axis.
pub(super) fn turns(axis: &Axis, border: &[Vec3]) -> i64 {
    let angles: Vec<f64> = border.iter().map(|p| axis.project(p).angle()).collect();
    whole_turns(&angles)
}

/// Whole turns of a closed line of angles.
pub(super) fn whole_turns(angles: &[f64]) -> i64 {
    let sum: f64 = (0..angles.len()).map(|i| wrap_angle(angles[(i + 1) % angles.len()] - angles[i])).sum();
    (sum / TAU).round() as i64
}

impl Borders {
    /// Tells the borders of a surface apart.
    pub(super) fn of(mesh: &Mesh, axis: &Axis, openings: &[SideOpening]) -> Self {
        let loops = topology::boundary_loops(mesh.faces(), mesh.twins());
        let outlines: Vec<Outline> = loops
            .iter()
            .map(|l| Outline::of(&l.iter().map(|&v| mesh.vertices()[v as usize]).collect::<Vec<_>>(), axis))
            .collect();
        // The longest first; equals stay in the order of their loops.
        let mut order: Vec<usize> = (0..outlines.len()).collect();
        order.sort_by(|&a, &b| outlines[b].length_m.total_cmp(&outlines[a].length_m));
        let winds = |&i: &usize| outlines[i].turns != 0;
        let mut kinds: Vec<Kind> =
            (0..outlines.len()).map(|i| if winds(&i) { Kind::Portal } else { Kind::Hole }).collect();
        if !order.iter().any(winds)
            && let Some(&outer) = order.first()
        {
            kinds[outer] = Kind::OpenEdge;
        }
        for opening in openings {
            let rim = order.iter().find(|&&i| kinds[i] == Kind::Hole && outlines[i].share_of(opening) >= RIM_SHARE);
            rim.into_iter().for_each(|&i| kinds[i] = Kind::SideOpening);
        }
        // The ends of the tunnel are told however many shadows are longer.
        order.sort_by_key(|&i| kinds[i] == Kind::Hole);
        let count = |kind: Kind| kinds.iter().filter(|k| **k == kind).count();
        Self {
            portals: count(Kind::Portal),
            portals_expected: PORTALS_EXPECTED,
            open_edges: count(Kind::OpenEdge),
            side_openings: count(Kind::SideOpening),
            holes: count(Kind::Hole),
            longest: order.iter().take(MOST_LISTED).map(|&i| outlines[i].told_as(kinds[i])).collect(),
        }
    }

    /// What a person should know when the surface is no tube with two ends.
    pub(super) fn warning(&self, axis: &Axis) -> Option<Warning> {
        let portals = || self.longest.iter().filter(|b| b.kind == Kind::Portal);
        let message = match self.portals {
            PORTALS_EXPECTED => return None,
            0 if self.open_edges > 0 => format!(
                "the surface does not close around the axis (one scanned wall, a trench, a missing floor or roof): it has one open \
                 edge of {:.0} m instead of {PORTALS_EXPECTED} borders around its ends; nothing is cut, and the map ends where the \
                 surface does",
                self.longest[0].length_m
            ),
            0 => "the surface is closed at both ends; it cannot be opened to a map".to_owned(),
            1 => {
                let middle = (axis.start_chainage() + axis.end_chainage()) / 2.0;
                let open_at_start = portals().all(|p| p.chainage_m < middle);
                let closed = if open_at_start { axis.end_chainage() } else { axis.start_chainage() };
                format!(
                    "the surface is closed at chainage {closed:.1} m, where a border around the axis was expected (a face, or a \
                     cap): the seam ends in the middle of it, and the map is stretched there"
                )
            }
            many => {
                let places: Vec<String> = portals().map(|p| format!("{:.1}", p.chainage_m)).collect();
                format!(
                    "{many} borders wind around the axis where {PORTALS_EXPECTED} were expected (near chainage {} m): the surface is \
                     no single tube, and no map can be made of it; look at the axis and at side drifts",
                    places.join(", ")
                )
            }
        };
        Some(Warning::new("portals", message))
    }
}

/// A border as seen from the axis.
struct Outline {
    /// Its vertices.
    places: Vec<AxisCoordinates>,
    turns: i64,
    length_m: f64,
}

impl Outline {
    fn of(border: &[Vec3], axis: &Axis) -> Self {
        let places: Vec<AxisCoordinates> = border.iter().map(|p| axis.project(p)).collect();
        let angles: Vec<f64> = places.iter().map(AxisCoordinates::angle).collect();
        let length_m = (0..border.len()).map(|i| (border[(i + 1) % border.len()] - border[i]).norm()).sum();
        Self { turns: whole_turns(&angles), places, length_m }
    }

    fn mean(&self, number: impl Fn(&AxisCoordinates) -> f64) -> f64 {
        self.places.iter().map(number).sum::<f64>() / self.places.len() as f64
    }

    /// Extent along the tunnel: lowest and highest chainage.
    fn along(&self) -> [f64; 2] {
        extent(self.places.iter().map(|c| c.chainage))
    }

    /// Extent around the axis, metres of arc from a direction.
    fn around(&self, from_angle: f64) -> [f64; 2] {
        extent(self.places.iter().map(|c| wrap_angle(c.angle() - from_angle) * c.radius()))
    }

    /// The share of a side opening that the border encloses, from their extents.
    fn share_of(&self, opening: &SideOpening) -> f64 {
        let [along, around] = opening.width_m;
        let common = |[low, high]: [f64; 2], middle: f64, width: f64| {
            (high.min(middle + width / 2.0) - low.max(middle - width / 2.0)).max(0.0) / width
        };
        common(self.along(), opening.chainage_m, along)
            * common(self.around(opening.angle_deg.to_radians()), 0.0, around)
    }

    fn told_as(&self, kind: Kind) -> Border {
        let middle = AxisCoordinates {
            chainage: self.mean(|c| c.chainage),
            right: self.mean(|c| c.right),
            up: self.mean(|c| c.up),
        };
        let width = |[low, high]: [f64; 2]| high - low;
        Border {
            kind,
            chainage_m: middle.chainage,
            side: (self.turns == 0).then(|| Side::of(&middle)),
            width_m: [width(self.along()), width(self.around(middle.angle()))],
            length_m: self.length_m,
        }
    }
}

fn extent(numbers: impl Iterator<Item = f64>) -> [f64; 2] {
    numbers.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], x| [low.min(x), high.max(x)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::VertexId;

    fn axis() -> Axis {
        Axis::through(&[Vec3::zeros(), Vec3::new(20.0, 0.0, 0.0)], 100.0).unwrap()
    }

    /// A tube of 2 m radius around the axis, of squares of 10 cm along; `keep` gets chainage and angle of a square.
    fn tube(keep: impl Fn(f64, f64) -> bool) -> Mesh {
        let (rows, columns) = (200u32, 120u32);
        let angle = |j: u32| TAU * f64::from(j % columns) / f64::from(columns);
        let vertices: Vec<Vec3> = (0..=rows)
            .flat_map(|i| (0..columns).map(move |j| (i, j)))
            .map(|(i, j)| axis().point_at(&AxisCoordinates::from_polar(100.0 + 0.1 * f64::from(i), angle(j), 2.0)))
            .collect();
        let mut faces: Vec<[VertexId; 3]> = Vec::new();
        for (i, j) in (0..rows).flat_map(|i| (0..columns).map(move |j| (i, j))) {
            if keep(100.0 + 0.1 * f64::from(i), wrap_angle(angle(j))) {
                let (a, d) = (i * columns + j, i * columns + (j + 1) % columns);
                faces.extend([[a, a + columns, d + columns], [a, d + columns, d]]);
            }
        }
        Mesh::all_observed(vertices, faces).unwrap()
    }

    /// A crosscut of 2 m x 1.5 m on the right wall at 110 m.
    fn opening() -> SideOpening {
        SideOpening {
            chainage_m: 110.0,
            angle_deg: 90.0,
            side: Side::Right,
            width_m: [2.0, 1.5],
            seen_depth_m: 3.0,
            points: 1000,
            ends_in_local: [[10.0, 0.0, 0.0], [10.0, -5.0, 0.0]],
        }
    }

    fn mouth(s: f64, angle: f64) -> bool {
        (109.0..111.0).contains(&s) && (2.0 * (angle - TAU / 4.0)).abs() < 0.75
    }

    fn kinds(b: &Borders) -> [usize; 4] {
        [b.portals, b.open_edges, b.side_openings, b.holes]
    }

    #[test]
    fn portals_an_opening_and_a_shadow_are_told_apart() {
        let shadow = |s: f64, angle: f64| (104.0..105.0).contains(&s) && (angle + 1.0).abs() < 0.2;
        let mesh = tube(|s, angle| !mouth(s, angle) && !shadow(s, angle));
        let borders = Borders::of(&mesh, &axis(), &[opening()]);
        assert_eq!((kinds(&borders), borders.warning(&axis())), ([2, 0, 1, 1], None));
        let order: Vec<Kind> = borders.longest.iter().map(|b| b.kind).collect();
        assert_eq!(order, [Kind::Portal, Kind::Portal, Kind::SideOpening, Kind::Hole]);
        let rim = &borders.longest[2];
        assert!((rim.chainage_m - 110.0).abs() < 0.1 && rim.side == Some(Side::Right), "{rim:?}");
        assert!((rim.width_m[0] - 2.0).abs() < 0.11 && (rim.width_m[1] - 1.5).abs() < 0.21, "{rim:?}");
        assert_eq!(borders.longest[3].side, Some(Side::Left));
        // Without a known opening the mouth is a hole like others.
        assert_eq!(kinds(&Borders::of(&mesh, &axis(), &[])), [2, 0, 0, 2]);
    }

    #[test]
    fn a_missing_floor_is_an_open_edge_and_told() {
        let mesh = tube(|s, angle| angle.abs() < 2.5 && !mouth(s, angle));
        let borders = Borders::of(&mesh, &axis(), &[opening()]);
        assert_eq!(kinds(&borders), [0, 1, 1, 0]);
        assert!(borders.longest[0].length_m > 40.0 && borders.longest[0].kind == Kind::OpenEdge);
        assert!(borders.warning(&axis()).unwrap().message.contains("does not close around the axis"));
    }

    #[test]
    fn a_closed_end_is_told_with_its_chainage() {
        let open = tube(|_, _| true);
        let mut vertices = open.vertices().to_vec();
        let mut faces = open.faces().to_vec();
        let (ring, pole) = (200 * 120, vertices.len() as VertexId);
        vertices.push(Vec3::new(20.0, 0.0, 0.0));
        faces.extend((0..120).map(|j| [ring + j, pole, ring + (j + 1) % 120]));
        let borders = Borders::of(&Mesh::all_observed(vertices, faces).unwrap(), &axis(), &[]);
        assert_eq!(kinds(&borders), [1, 0, 0, 0]);
        assert!(borders.warning(&axis()).unwrap().message.contains("closed at chainage 120.0 m"));
    }
}
