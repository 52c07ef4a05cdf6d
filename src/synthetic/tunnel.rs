//! A section swept along an alignment: the surface in closed form, its exact meshes and its inverse.

use super::fracture::Fracture;
use super::furniture::Item;
use super::lettering::{Lettering, Wall};
use super::recess::Recess;
use super::relief::Relief;
use super::rock::{Place, Rock, step};
use super::{Alignment, Section};
use crate::axis::{Axis, Frame};
use crate::cloud::Label;
use crate::mesh::{Mesh, VertexId};
use crate::numeric::{Vec2, Vec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The relief fades out towards the corners of the section over this girth, so that floor and wall meet, metres.
const CORNER_FADE_M: f64 = 0.25;

/// Floors are graded by hand: share of the wall's relief that they keep.
const FLOOR_RELIEF: f64 = 0.3;

/// Step of the differences that give the slope of the relief, metres.
const SLOPE_STEP_M: f64 = 0.02;

/// A place told by the smooth tunnel surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SectionPoint {
    /// Metres along the axis.
    pub chainage: f64,
    /// Metres around the section from the crown, positive over the right wall.
    pub girth: f64,
    /// Distance from the smooth surface: positive in the rock, negative in the void.
    pub outward: f64,
}

/// A mesh with the exact map coordinates of its vertices.
#[derive(Clone, Debug)]
pub struct KnownMesh {
    /// Faces run counter-clockwise seen from inside.
    pub mesh: Mesh,
    /// True (chainage, girth) of each vertex.
    pub uv: Vec<Vec2>,
}

/// The wall at one place, with everything that a scanner would see there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WallPoint {
    /// Position, local metres.
    pub position: Vec3,
    /// Unit normal of the rough surface, into the void.
    pub normal: Vec3,
    /// The fracture whose trace runs here, 0 for none.
    pub label: Label,
    /// Red, green, blue from 0 to 1.
    pub color: [f64; 3],
    /// Reflectance for the scanner's infrared light, from 0 to 1.
    pub reflectance: f64,
    /// Whether the place belongs to the flat floor.
    pub is_floor: bool,
}

/// A tunnel known in closed form.
#[derive(Clone, Debug)]
pub struct Tunnel {
    /// The section, the same all along.
    pub section: Section,
    /// The axis.
    pub alignment: Alignment,
    /// Roughness of the walls; `None`: smooth.
    pub relief: Option<Relief>,
    /// Fracture planes; they leave traces on walls and roof, not on a flat floor.
    pub fractures: Vec<Fracture>,
    /// Paint on the walls.
    pub lettering: Vec<Lettering>,
    /// How the rock looks.
    pub rock: Rock,
    /// What stands and hangs in it.
    pub furniture: Vec<Item>,
    /// What is cut into its walls. The closed form of the surface leaves them out.
    pub recesses: Vec<Recess>,
}

impl Tunnel {
    /// An empty tunnel with smooth walls; fill in the other fields as needed.
    pub fn smooth(section: Section, alignment: Alignment) -> Self {
        Self {
            section,
            alignment,
            relief: None,
            fractures: Vec::new(),
            lettering: Vec::new(),
            rock: Rock::new(1),
            furniture: Vec::new(),
            recesses: Vec::new(),
        }
    }

    /// A drilled and blasted horseshoe drift as the bundled sample shows it: rough rock, nine fractures in three sets,
    /// "ADIT 12 R" on the right wall and "L" on the left.
    pub fn rock_drift(section: Section, alignment: Alignment, roughness_m: f64, seed: u64) -> Self {
        let mut tunnel = Self::smooth(section, alignment);
        if roughness_m > 0.0 {
            tunnel.relief = Some(Relief::rock(roughness_m, seed));
        }
        tunnel.rock = Rock::new(seed);
        tunnel.fractures = three_sets(&tunnel, seed);
        let (length, half) = (tunnel.length(), tunnel.section.half_perimeter());
        let girth_m = tunnel.section.floor_girth().map_or(0.5 * half, |floor| 0.72 * floor);
        let height_m = (0.16 * half).min(length / 12.0);
        for (text, wall, place) in [("ADIT 12 R", Wall::Right, 0.36), ("L", Wall::Left, 0.22)] {
            let chainage_m = place * length;
            let paint = [0.95, 0.94, 0.90];
            tunnel.lettering.push(Lettering { text: text.into(), wall, chainage_m, girth_m, height_m, paint });
        }
        tunnel
    }

    /// Length along the axis, metres; chainage runs from 0 to this.
    pub fn length(&self) -> f64 {
        self.alignment.length()
    }

    /// The frame of the axis, in closed form.
    pub fn frame_at(&self, chainage: f64) -> Frame {
        self.alignment.frame_at(chainage)
    }

    /// The axis as the later stages know it (a dense spline, within a millimetre of the closed form).
    pub fn axis(&self) -> Axis {
        self.alignment.axis()
    }

    /// The point `outward` metres behind the smooth surface at (chainage, girth), local metres.
    pub fn point_at(&self, p: &SectionPoint) -> Vec3 {
        let frame = self.frame_at(p.chainage);
        let o = self.section.point(p.girth);
        let (right, up) = (o.right + o.outward[0] * p.outward, o.up + o.outward[1] * p.outward);
        frame.origin - frame.left * right + frame.up * up
    }

    /// The wall at (chainage, girth), local metres: the smooth surface plus relief and fracture grooves.
    pub fn surface_point(&self, chainage: f64, girth: f64) -> Vec3 {
        self.point_at(&SectionPoint { chainage, girth, outward: self.outward_at(chainage, girth) })
    }

    /// How far the wall lies behind the smooth surface at (chainage, girth), metres.
    pub fn outward_at(&self, chainage: f64, girth: f64) -> f64 {
        let relief = self.relief_at(chainage, girth);
        if self.fractures.is_empty() || self.is_floor(girth) {
            return relief;
        }
        let position = self.point_at(&SectionPoint { chainage, girth, outward: relief });
        relief + self.nearest_trace(&position, &self.inward_normal(chainage, girth)).groove
    }

    /// The fracture whose trace covers (chainage, girth), 0 for none.
    pub fn label_at(&self, chainage: f64, girth: f64) -> Label {
        if self.is_floor(girth) {
            return 0;
        }
        let outward = self.relief_at(chainage, girth);
        let position = self.point_at(&SectionPoint { chainage, girth, outward });
        self.nearest_trace(&position, &self.inward_normal(chainage, girth)).label()
    }

    /// The paint at (chainage, girth), if any.
    pub fn paint_at(&self, chainage: f64, girth: f64) -> Option<[f64; 3]> {
        self.lettering.iter().find(|l| l.covers(chainage, girth)).map(|l| l.paint)
    }

    /// Whether a girth lies on the flat floor.
    pub fn is_floor(&self, girth: f64) -> bool {
        self.section.floor_girth().is_some_and(|floor| girth.abs() > floor)
    }

    /// The wall at (chainage, girth) with its looks.
    pub fn wall_at(&self, chainage: f64, girth: f64) -> WallPoint {
        let frame = self.frame_at(chainage);
        let o = self.section.point(girth);
        let is_floor = self.is_floor(girth);
        let smooth_normal = frame.left * o.outward[0] - frame.up * o.outward[1];
        let around = frame.up * o.along[1] - frame.left * o.along[0];
        let on = |outward: f64| {
            let (right, up) = (o.right + o.outward[0] * outward, o.up + o.outward[1] * outward);
            frame.origin - frame.left * right + frame.up * up
        };
        let height = self.relief_at(chainage, girth);
        let trace = if is_floor { Trace::none() } else { self.nearest_trace(&on(height), &smooth_normal) };
        let slope = match &self.relief {
            None => [0.0; 2],
            Some(_) => [
                (self.relief_at(chainage + SLOPE_STEP_M, girth) - height) / SLOPE_STEP_M,
                (self.relief_at(chainage, girth + SLOPE_STEP_M) - height) / SLOPE_STEP_M,
            ],
        };
        let towards_crown = if girth > 0.0 { -slope[1] } else { slope[1] };
        let position = on(height + trace.groove);
        let (color, reflectance) = self.rock.appearance(&Place {
            in_section: [chainage, o.right, o.up],
            position,
            depth: self.relief.as_ref().map_or(0.0, |r| height / r.amplitude_m.max(1e-6)),
            slope: [slope[0], towards_crown],
            trace: (trace.distance, trace.half_width),
            is_floor,
            paint: self.paint_at(chainage, girth),
        });
        WallPoint {
            position,
            normal: (smooth_normal + frame.forward * slope[0] + around * slope[1]).normalize(),
            label: trace.label(),
            color,
            reflectance,
            is_floor,
        }
    }

    /// Relief without fracture grooves.
    pub(super) fn relief_at(&self, chainage: f64, girth: f64) -> f64 {
        let Some(relief) = &self.relief else { return 0.0 };
        let o = self.section.point(girth);
        let mut fade = if self.is_floor(girth) { FLOOR_RELIEF } else { 1.0 };
        for corner in self.section.corners() {
            fade *= step(0.0, CORNER_FADE_M, (girth.abs() - corner).abs());
        }
        if fade == 0.0 { 0.0 } else { fade * relief.height(chainage, o.right, o.up) }
    }

    fn nearest_trace(&self, position: &Vec3, wall_normal: &Vec3) -> Trace {
        let mut nearest = Trace::none();
        for f in &self.fractures {
            let distance = f.trace_distance(position, wall_normal);
            if distance < nearest.distance {
                let groove = f.groove_m * (-(distance / f.half_width_m).powi(2)).exp();
                nearest = Trace { id: f.id, distance, half_width: f.half_width_m, groove };
            }
        }
        nearest
    }

    /// Unit normal of the smooth surface, into the void.
    pub fn inward_normal(&self, chainage: f64, girth: f64) -> Vec3 {
        let frame = self.frame_at(chainage);
        let [right, up] = self.section.point(girth).outward;
        frame.left * right - frame.up * up
    }

    /// The inverse of [`Self::point_at`].
    pub fn project(&self, point: &Vec3) -> SectionPoint {
        let (chainage, right, up) = self.alignment.project(point);
        let foot = self.section.foot(right, up);
        SectionPoint { chainage, girth: foot.girth, outward: foot.outward }
    }

    /// The closed tube from portal to portal: `along` by `around` quads of two triangles each, seam nowhere.
    ///
    /// `uv` has girths in (-half perimeter, half perimeter].
    pub fn tube(&self, along: usize, around: usize) -> KnownMesh {
        self.structured(along, around, self.section.half_perimeter(), true)
    }

    /// The tube cut open along the invert: a disk whose map is the rectangle length x perimeter.
    pub fn strip(&self, along: usize, around: usize) -> KnownMesh {
        self.strip_within(along, around, self.section.half_perimeter())
    }

    /// The part of the surface with girth between -`reach_m` and `reach_m`, e.g. walls and roof without the floor, or
    /// exactly half a cylinder.
    pub fn strip_within(&self, along: usize, around: usize, reach_m: f64) -> KnownMesh {
        self.structured(along, around, reach_m, false)
    }

    fn structured(&self, along: usize, around: usize, reach: f64, closed: bool) -> KnownMesh {
        let columns = if closed { around } else { around + 1 };
        let mut vertices = Vec::with_capacity((along + 1) * columns);
        let mut uv = Vec::with_capacity((along + 1) * columns);
        for i in 0..=along {
            let chainage = self.length() * i as f64 / along as f64;
            for j in 0..columns {
                // A tube starts one step above -reach, so that the invert has girth +half perimeter.
                let step = if closed { j + 1 } else { j };
                let girth = reach * (2.0 * step as f64 / around as f64 - 1.0);
                vertices.push(self.surface_point(chainage, girth));
                uv.push(Vec2::new(chainage, girth));
            }
        }
        let vertex = |i: usize, j: usize| (i * columns + j % columns) as VertexId;
        let mut faces = Vec::with_capacity(2 * along * around);
        for i in 0..along {
            for j in 0..around {
                let (a, b, c, d) = (vertex(i, j), vertex(i + 1, j), vertex(i + 1, j + 1), vertex(i, j + 1));
                // Alternating diagonals leave no preferred shear.
                if (i + j) % 2 == 0 {
                    faces.extend([[a, b, c], [a, c, d]]);
                } else {
                    faces.extend([[a, b, d], [b, c, d]]);
                }
            }
        }
        let mesh = Mesh::all_observed(vertices, faces).expect("a structured grid is an oriented manifold");
        KnownMesh { mesh, uv }
    }
}

/// The fracture trace nearest to a place on the wall.
#[derive(Clone, Copy, Debug)]
struct Trace {
    id: Label,
    distance: f64,
    half_width: f64,
    groove: f64,
}

impl Trace {
    fn none() -> Self {
        Self { id: 0, distance: f64::INFINITY, half_width: 1.0, groove: 0.0 }
    }

    fn label(&self) -> Label {
        if self.distance < self.half_width { self.id } else { 0 }
    }
}

/// Nine fractures in three sets, spread along the tunnel: two steep sets that cross it and a gently dipping one.
fn three_sets(tunnel: &Tunnel, seed: u64) -> Vec<Fracture> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let azimuth = {
        let f = tunnel.frame_at(tunnel.length() / 2.0).forward;
        f.x.atan2(f.y).to_degrees()
    };
    let reach = -tunnel.section.invert_up();
    // Dip and dip direction of each set relative to the azimuth of the tunnel.
    let sets = [(74.0, 38.0), (62.0, 318.0), (28.0, 195.0)];
    (0..9)
        .map(|k| {
            let (dip, direction) = sets[k % 3];
            let mut scatter = |width: f64| width * (random.random::<f64>() - 0.5);
            let chainage = tunnel.length() * (k as f64 + 0.5) / 9.0 + scatter(0.6);
            let frame = tunnel.frame_at(chainage);
            let through = frame.origin + frame.left * scatter(reach) + frame.up * scatter(reach);
            let f =
                Fracture::from_dip(k as Label + 1, dip + scatter(12.0), azimuth + direction + scatter(16.0), through);
            // Every other one ends within the tunnel.
            if k % 2 == 1 { f.with_radius(1.6 * reach) } else { f }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::topology::{boundary_loops, components};
    use std::f64::consts::PI;

    fn tunnels() -> Vec<Tunnel> {
        let sections = [Section::circle(2.0), Section::horseshoe(4.6, 4.2), Section::ellipse(5.0, 4.0)];
        let alignments = [
            Alignment::straight(20.0),
            Alignment::bend(20.0, 15.0),
            Alignment::helix(30.0, 12.0, 12.0),
            Alignment::shaft(20.0),
        ];
        sections.iter().flat_map(|s| alignments.iter().map(|a| Tunnel::smooth(s.clone(), a.clone()))).collect()
    }

    #[test]
    fn faces_look_into_the_void_and_match_the_map() {
        for t in tunnels() {
            for known in [t.strip(20, 24), t.tube(20, 24)] {
                let m = &known.mesh;
                for f in 0..m.faces().len() as u32 {
                    let corners = m.faces()[f as usize].map(|v| known.uv[v as usize]);
                    if corners.iter().any(|a| corners.iter().any(|b| (a.y - b.y).abs() > t.section.half_perimeter())) {
                        continue; // the face that closes the tube
                    }
                    let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
                    assert!(m.double_area_vector(f).dot(&t.inward_normal(middle.x, middle.y)) > 0.0);
                    assert!((corners[1] - corners[0]).perp(&(corners[2] - corners[0])) > 0.0);
                }
            }
        }
    }

    #[test]
    fn strips_are_disks_and_tubes_have_two_portals() {
        let t = &tunnels()[1];
        for (known, loops) in [(t.strip(10, 12), 1), (t.tube(10, 12), 2)] {
            let twin = known.mesh.twins();
            assert_eq!(boundary_loops(known.mesh.faces(), twin).len(), loops);
            assert_eq!(components(twin).1, 1);
        }
    }

    #[test]
    fn areas_converge_to_the_closed_form() {
        // Pappus: the area of a swept surface is perimeter times the path of the outline's centroid, which is the
        // axis itself for a circle, bent or not.
        let (radius, length) = (2.0, 20.0);
        for a in [Alignment::straight(length), Alignment::bend(length, 15.0), Alignment::shaft(length)] {
            let area = Tunnel::smooth(Section::circle(radius), a).strip(200, 200).mesh.area();
            assert!((area / (2.0 * PI * radius * length) - 1.0).abs() < 1e-3, "{area}");
        }
    }

    #[test]
    fn projection_inverts_the_surface() {
        for t in tunnels() {
            for i in 0..400 {
                let p = SectionPoint {
                    chainage: t.length() * ((i as f64 + 0.3) * 0.618_033_988).fract(),
                    girth: t.section.half_perimeter() * (2.0 * ((i as f64 + 0.3) * 0.414_213_562).fract() - 1.0),
                    outward: 0.0,
                };
                let q = t.project(&t.point_at(&p));
                assert!((q.chainage - p.chainage).abs() < 1e-9 && (q.girth - p.girth).abs() < 1e-9, "{p:?} {q:?}");
                assert!(q.outward.abs() < 1e-9);
            }
        }
    }

    #[test]
    fn the_right_wall_lies_right() {
        let t = Tunnel::smooth(Section::horseshoe(4.6, 4.2), Alignment::straight(10.0));
        let wall = t.surface_point(5.0, 2.3 * PI / 2.0 + 0.5);
        // Facing +x, right is -y.
        assert!((wall.y + 2.3).abs() < 1e-12 && (wall.x - 5.0).abs() < 1e-12);
    }

    #[test]
    fn labels_lie_on_their_planes() {
        let t = Tunnel::rock_drift(Section::horseshoe(4.6, 4.2), Alignment::bend(22.0, 45.0), 0.05, 3);
        let mut labelled = 0;
        for i in 0..40_000 {
            let s = t.length() * (i as f64 * 0.618_033_988).fract();
            let g = t.section.half_perimeter() * (2.0 * (i as f64 * 0.414_213_562).fract() - 1.0);
            let wall = t.wall_at(s, g);
            assert_eq!(wall.label, t.label_at(s, g));
            assert!((wall.position - t.surface_point(s, g)).norm() < 1e-12);
            if wall.label > 0 {
                labelled += 1;
                let f = &t.fractures[wall.label as usize - 1];
                // The groove moves the point by at most its depth.
                assert!((f.normal.dot(&wall.position) - f.offset).abs() < f.half_width_m + f.groove_m);
                assert!(!wall.is_floor);
            }
        }
        assert!((200..4000).contains(&labelled), "{labelled}");
    }

    #[test]
    fn rough_normals_are_those_of_the_surface() {
        let mut t = Tunnel::rock_drift(Section::circle(2.0), Alignment::bend(22.0, 45.0), 0.04, 3);
        t.fractures.clear();
        let mut worst = 0.0_f64;
        for i in 0..500 {
            let s = 1.0 + 20.0 * (i as f64 * 0.618_033_988).fract();
            let g = 6.0 * (2.0 * (i as f64 * 0.414_213_562).fract() - 1.0);
            let d = SLOPE_STEP_M;
            let along = t.surface_point(s + d, g) - t.surface_point(s, g);
            let around = t.surface_point(s, g + d) - t.surface_point(s, g);
            worst = worst.max(crate::numeric::angle_between(&along.cross(&around), &t.wall_at(s, g).normal));
        }
        // The section is curved by d / radius over the step of the differences.
        assert!(worst < 0.05, "{worst}");
    }

    #[test]
    fn the_wall_meets_the_floor() {
        let t = Tunnel::rock_drift(Section::horseshoe(4.6, 4.2), Alignment::straight(10.0), 0.08, 3);
        let corner = t.section.corners()[0];
        for s in [1.0, 4.3, 8.8] {
            let step = t.surface_point(s, corner + 1e-6) - t.surface_point(s, corner - 1e-6);
            assert!(step.norm() < 1e-4, "{}", step.norm());
        }
    }
}
