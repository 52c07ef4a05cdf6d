//! Caps over the ends of a tube: faces that close it there and have to go before it can be opened to a map.
//!
//! Use it on meshes from elsewhere (a watertight Poisson surface is closed over its portals) and on tunnels whose face was
//! scanned. A cap consists of faces whose normals run along the axis. At an end without a border around the axis it grows from
//! the face nearest to the axis; at one with such a border, which then is a hole in the cap, from that border. It is cut off
//! when it covers enough of the section and when a border around the axis is left behind. A face of rock with deep steps that
//! is not left out wholly stays: the surface stays closed there.
//!
//! Cost: linear in vertices and faces.

use super::{FaceId, VertexId, borders, topology};
use crate::axis::{Axis, AxisCoordinates};
use crate::numeric::{Vec3, statistics};
use rayon::prelude::*;

/// A normal closer to the axis than this (cosine of 45 degrees) belongs to a cap, not to a wall.
const ALONG_THE_AXIS: f64 = std::f64::consts::FRAC_1_SQRT_2;
/// A cap lies within this many radii of the section from the outermost place of its end: a hemisphere needs one.
const REACH_IN_RADII: f64 = 1.2;
/// Seen along the axis, a cap covers at least this share of the section; the part of a hemisphere beyond 45 degrees covers half.
const COVERED: f64 = 0.35;
/// ... and what is left of a cap around a hole this share: less is relief.
const COVERED_AROUND_A_HOLE: f64 = 0.15;

/// A cap.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Cap {
    /// Its faces, ascending.
    pub faces: Vec<FaceId>,
    /// Chainage of its middle, metres.
    pub chainage_m: f64,
    /// Its area, square metres.
    pub area_m2: f64,
}

/// Which end of the axis.
#[derive(Clone, Copy, PartialEq, Eq)]
enum End {
    Start,
    Finish,
}

/// Finds the caps of an oriented manifold, that at the start first.
pub(super) fn find(vertices: &[Vec3], faces: &[[VertexId; 3]], twin: &[u32], axis: &Axis) -> Vec<Cap> {
    let places: Vec<AxisCoordinates> = vertices.par_iter().map(|p| axis.project(p)).collect();
    let mut radii: Vec<f64> = places.iter().map(AxisCoordinates::radius).collect();
    let Some(radius_m) = statistics::median(&mut radii) else { return Vec::new() };
    let surface = Surface { vertices, faces, twin, axis, places: &places, radius_m };
    let around = surface.borders_around(faces, twin);
    let middle_m = (axis.start_chainage() + axis.end_chainage()) / 2.0;
    let end_of = |border: &[VertexId]| {
        let sum: f64 = border.iter().map(|&v| places[v as usize].chainage).sum();
        if sum / (border.len() as f64) < middle_m { End::Start } else { End::Finish }
    };
    let cap_at = |end: End| {
        let border: Vec<VertexId> = around.iter().filter(|l| end_of(l) == end).flatten().copied().collect();
        surface.cap_at(end, &border, around.len())
    };
    [End::Start, End::Finish].into_iter().filter_map(cap_at).collect()
}

struct Surface<'a> {
    vertices: &'a [Vec3],
    faces: &'a [[VertexId; 3]],
    twin: &'a [u32],
    axis: &'a Axis,
    places: &'a [AxisCoordinates],
    /// Typical distance of the wall from the axis, metres.
    radius_m: f64,
}

impl Surface<'_> {
    /// The cap at an end with so many vertices on borders around the axis, of a surface with `around` such borders in all.
    fn cap_at(&self, end: End, border: &[VertexId], around: usize) -> Option<Cap> {
        // Metres into the tunnel from its end.
        let inwards = |chainage: f64| match end {
            End::Start => chainage - self.axis.start_chainage(),
            End::Finish => self.axis.end_chainage() - chainage,
        };
        let outermost = self.places.iter().map(|c| inwards(c.chainage)).fold(f64::INFINITY, f64::min);
        let reach_m = outermost + REACH_IN_RADII * self.radius_m;
        let is_cap = |face: FaceId| {
            let near = self.faces[face as usize].iter().all(|&v| inwards(self.places[v as usize].chainage) < reach_m);
            let area = self.double_area(face);
            near && area.dot(&self.forward(face)).abs() > ALONG_THE_AXIS * area.norm()
        };
        let off_axis = |face: FaceId| self.middle(face).radius();
        let all = || (0..self.faces.len() as FaceId).filter(|&f| is_cap(f));
        let mut cap: Vec<FaceId> = if border.is_empty() {
            all().min_by(|&a, &b| off_axis(a).total_cmp(&off_axis(b))).into_iter().collect()
        } else {
            let mut on_border = vec![false; self.vertices.len()];
            border.iter().for_each(|&v| on_border[v as usize] = true);
            all().filter(|&f| self.faces[f as usize].iter().any(|&v| on_border[v as usize])).collect()
        };
        let mut taken = vec![false; self.faces.len()];
        cap.iter().for_each(|&f| taken[f as usize] = true);
        let mut done = 0;
        while done < cap.len() {
            let face = cap[done] as usize;
            done += 1;
            for &other in self.twin[3 * face..3 * face + 3].iter().filter(|t| **t != topology::NO_TWIN) {
                let next = other / 3;
                if !taken[next as usize] && is_cap(next) {
                    taken[next as usize] = true;
                    cap.push(next);
                }
            }
        }
        cap.sort_unstable();
        // What stands beside the tunnel (the rock around a portal) covers nothing of it.
        let across = cap.iter().filter(|&&f| off_axis(f) < self.radius_m);
        let covered: f64 = across.map(|&f| self.double_area(f).dot(&self.forward(f)).abs() / 2.0).sum();
        let least = if border.is_empty() { COVERED } else { COVERED_AROUND_A_HOLE };
        let is_closed = usize::from(border.is_empty());
        let leaves_a_border = || {
            let rest: Vec<[VertexId; 3]> =
                self.faces.iter().zip(&taken).filter(|(_, taken)| !**taken).map(|(f, _)| *f).collect();
            self.borders_around(&rest, &topology::lenient_twins(&rest).0).len() == around + is_closed
        };
        let section = std::f64::consts::PI * self.radius_m * self.radius_m;
        (covered >= least * section && leaves_a_border()).then(|| Cap {
            chainage_m: cap.iter().map(|&f| self.middle(f).chainage).sum::<f64>() / cap.len() as f64,
            area_m2: cap.iter().map(|&f| self.double_area(f).norm() / 2.0).sum(),
            faces: cap,
        })
    }

    /// The borders of some faces that wind around the axis.
    fn borders_around(&self, faces: &[[VertexId; 3]], twin: &[u32]) -> Vec<Vec<VertexId>> {
        let winds = |l: &Vec<VertexId>| {
            let angles: Vec<f64> = l.iter().map(|&v| self.places[v as usize].angle()).collect();
            borders::whole_turns(&angles) != 0
        };
        topology::boundary_loops(faces, twin).into_iter().filter(winds).collect()
    }

    fn double_area(&self, face: FaceId) -> Vec3 {
        let [a, b, c] = self.faces[face as usize].map(|v| self.vertices[v as usize]);
        (b - a).cross(&(c - a))
    }

    fn middle(&self, face: FaceId) -> AxisCoordinates {
        let mean = |number: fn(&AxisCoordinates) -> f64| {
            self.faces[face as usize].iter().map(|&v| number(&self.places[v as usize])).sum::<f64>() / 3.0
        };
        AxisCoordinates { chainage: mean(|c| c.chainage), right: mean(|c| c.right), up: mean(|c| c.up) }
    }

    fn forward(&self, face: FaceId) -> Vec3 {
        self.axis.frame_at(self.middle(face).chainage).forward
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    const RADIUS: f64 = 2.0;
    const COLUMNS: u32 = 48;

    fn axis() -> Axis {
        Axis::through(&[Vec3::zeros(), Vec3::new(12.0, 0.0, 0.0)], 0.0).unwrap()
    }

    /// A surface of revolution around the x axis through (x, radius); ends of radius 0 are closed by a fan.
    fn revolved(outline: &[[f64; 2]]) -> (Vec<Vec3>, Vec<[VertexId; 3]>) {
        let mut vertices = Vec::new();
        for [x, r] in outline {
            // A quarter turn has a cosine of 6e-17.
            let r = if *r < 1e-9 { 0.0 } else { *r };
            vertices.extend((0..COLUMNS).map(|j| {
                let (sin, cos) = (TAU * f64::from(j) / f64::from(COLUMNS)).sin_cos();
                Vec3::new(*x, -r * sin, r * cos)
            }));
        }
        let mut faces = Vec::new();
        for i in 0..outline.len() as u32 - 1 {
            for j in 0..COLUMNS {
                let (a, d) = (i * COLUMNS + j, i * COLUMNS + (j + 1) % COLUMNS);
                faces.extend([[a, a + COLUMNS, d + COLUMNS], [a, d + COLUMNS, d]]);
            }
        }
        let repaired = crate::mesh::repair::Repaired::given(&vertices, &faces, &vec![true; faces.len()]);
        let (vertices, faces) = repaired.parts();
        (vertices.to_vec(), faces.to_vec())
    }

    fn wall() -> Vec<[f64; 2]> {
        (0..=60).map(|i| [0.2 * f64::from(i), RADIUS]).collect()
    }

    fn caps_of(outline: &[[f64; 2]]) -> Vec<Cap> {
        let (vertices, faces) = revolved(outline);
        find(&vertices, &faces, &topology::twins(&faces).unwrap(), &axis())
    }

    #[test]
    fn flat_caps_are_found_and_open_ends_left_alone() {
        let disc = |x: f64| (0..8).map(move |i| [x, RADIUS * f64::from(i) / 8.0]);
        assert!(caps_of(&wall()).is_empty());
        let one: Vec<[f64; 2]> = wall().into_iter().chain(disc(12.0).rev()).collect();
        let both: Vec<[f64; 2]> = disc(0.0).chain(one.clone()).collect();
        for (outline, chainages) in [(one, vec![12.0]), (both, vec![0.0, 12.0])] {
            let caps = caps_of(&outline);
            assert_eq!(caps.iter().map(|c| c.chainage_m.round()).collect::<Vec<_>>(), chainages);
            // A polygon of 48 corners.
            assert!(caps.iter().all(|c| (c.area_m2 / (TAU / 2.0 * RADIUS * RADIUS) - 1.0).abs() < 0.01), "{caps:?}");
        }
    }

    #[test]
    fn hemispheres_are_cut_off_where_they_turn_into_the_wall() {
        let dome =
            (0..=16).map(|i| TAU / 4.0 * f64::from(i) / 16.0).map(|t| [12.0 + RADIUS * t.sin(), RADIUS * t.cos()]);
        let outline: Vec<[f64; 2]> = wall().into_iter().chain(dome.skip(1)).collect();
        let caps = caps_of(&outline);
        assert_eq!(caps.len(), 1);
        // Beyond 45 degrees: a cap of height R (1 - cos 45).
        let expected = TAU * RADIUS * RADIUS * (1.0 - ALONG_THE_AXIS);
        assert!((caps[0].area_m2 / expected - 1.0).abs() < 0.1, "{} of {expected}", caps[0].area_m2);
    }

    #[test]
    fn a_cap_with_a_hole_is_one_and_relief_and_a_cone_are_none() {
        // The end is closed but for a hole of 0.6 m.
        let holed: Vec<[f64; 2]> =
            wall().into_iter().chain((3..10).rev().map(|i| [12.0, 0.2 * f64::from(i)])).collect();
        let caps = caps_of(&holed);
        assert_eq!(caps.len(), 1);
        assert!((caps[0].area_m2 / (TAU / 2.0 * (RADIUS * RADIUS - 0.36)) - 1.0).abs() < 0.01, "{caps:?}");
        // A rim of 10 cm at the end, and the rock around a portal.
        for at_the_end in [1.9, 5.0] {
            let outline: Vec<[f64; 2]> = wall().into_iter().chain([[12.0, at_the_end]]).collect();
            assert!(caps_of(&outline).is_empty(), "{at_the_end}");
        }
        // A cone is closed, but no face of it runs across the axis.
        let cone: Vec<[f64; 2]> = wall().into_iter().chain([[14.0, 1.0], [16.0, 0.0]]).collect();
        assert!(caps_of(&cone).is_empty());
    }
}
