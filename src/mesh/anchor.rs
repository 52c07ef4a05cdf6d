//! Anchoring points to a surface, exactly invertible.
//!
//! Every scan point p gets a face, a place on it and an offset with
//! `p = sum b_i x_i + offset * n / |n|`, `n = sum b_i n_i` (x_i corners, n_i vertex normals): what
//! [`SurfacePoint::position`] evaluates. The segments x_i + h n_i of a face bound a prism with ruled sides; neighbouring
//! faces share those sides, so the prisms fill the space near the surface without gaps or overlaps, and a point that
//! crosses from one prism to the next keeps its place: the anchor is continuous, unlike the closest point.
//!
//! For a given face, h solves det[x_1 - x_0 + h (n_1 - n_0), x_2 - x_0 + h (n_2 - n_0), x_0 + h n_0 - p] = 0, a cubic
//! that Newton's method solves from the distance to the plane; then b follows from the triangle at height h. The search
//! starts at the nearest face and walks across the side that p lies behind.
//!
//! Points beyond the border of the surface (or of a hole) lie in no prism. They are clamped to the nearest place and
//! marked, because they do not come back exactly. Points farther than `max_offset_m` are not anchored, nor are those behind
//! surface that no scan point supports: they were cut off when the wall was continued over an opening, and must not look like
//! rock of the wall in front of them.
//!
//! Cost: about a microsecond a point; 29 bytes a point. Same anchors on any number of threads.
//! Reference for the shell: S. Porumbescu, B. Budge, L. Feng, K. Joy, "Shell maps", SIGGRAPH 2005,
//! doi:10.1145/1073204.1073239 (there with tetrahedra, here exact on the ruled prism).

use super::nearest_face::FaceTree;
use super::{FaceId, Mesh, SurfacePoint, topology};
use crate::numeric::{Vec2, Vec3};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How points are anchored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Points farther than this from the surface, metres, are not anchored. Default 0.5.
    pub max_offset_m: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { max_offset_m: 0.5 }
    }
}

/// What anchoring did.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// Points given.
    pub points: usize,
    /// Points with an exact anchor.
    pub anchored: usize,
    /// Points beyond a border, clamped to it: they have a place, but do not come back exactly.
    pub clamped: usize,
    /// Points farther from the surface than allowed (or not finite), or behind filled surface: no anchor.
    pub unanchored: usize,
    /// Of these, the points behind filled surface.
    pub behind_filled: usize,
}

/// A point farther than this behind surface that was not observed is no part of it, metres: the rim of a filled patch holds
/// points of the wall as well, and a filled cleft those that were seen in it.
const BEHIND_FILLED_M: f64 = 0.1;
/// Marks points without an anchor.
const NO_FACE: FaceId = FaceId::MAX;
/// Points handled in one go; fixed, so that the first guess of the search does not depend on the thread count.
const CHUNK: usize = 4096;
/// Most faces walked from the nearest face to the prism.
const MOST_STEPS: usize = 24;
/// Newton steps for the height.
const MOST_NEWTON: usize = 12;
/// A step of the height this small, metres, is the last: what the next one would change is lost in rounding.
const LAST_STEP: f64 = 1e-10;
/// A point this little outside a prism (barycentric) is inside: rounding on shared sides.
const INSIDE: f64 = -1e-9;

/// Anchors of a list of points, in the order of the points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Anchors {
    faces: Vec<FaceId>,
    /// Weights of the face's second and third corner.
    weights: Vec<[f64; 2]>,
    offsets: Vec<f64>,
    exact: Vec<bool>,
}

impl Anchors {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.faces.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.faces.is_empty()
    }

    /// The anchor of a point; `None` when it is not anchored.
    pub fn get(&self, point: usize) -> Option<SurfacePoint> {
        let face = self.faces[point];
        if face == NO_FACE {
            return None;
        }
        let [b1, b2] = self.weights[point];
        Some(SurfacePoint { face, barycentric: [1.0 - b1 - b2, b1, b2], offset: self.offsets[point] })
    }

    /// Takes the anchors of these points away: they have no place any more.
    pub fn release(&mut self, points: &[usize]) {
        for &point in points {
            self.faces[point] = NO_FACE;
            self.weights[point] = [f64::NAN; 2];
            self.offsets[point] = f64::NAN;
            self.exact[point] = false;
        }
    }

    /// Whether the anchor comes back to the point exactly (not clamped at a border).
    pub fn is_exact(&self, point: usize) -> bool {
        self.exact[point]
    }

    /// Distances from the surface in metres, positive into the void; NaN for points without an anchor.
    pub fn offsets(&self) -> &[f64] {
        &self.offsets
    }

    /// Map coordinates of all points, given (u, v) of the mesh's vertices; NaN for points without an anchor.
    pub fn in_chart(&self, mesh: &Mesh, uv: &[Vec2]) -> Vec<Vec2> {
        (0..self.len())
            .into_par_iter()
            .map(|i| self.get(i).map_or(Vec2::repeat(f64::NAN), |anchor| anchor.in_chart(mesh, uv)))
            .collect()
    }
}

/// A surface prepared for anchoring.
pub struct Anchoring<'a> {
    mesh: &'a Mesh,
    normals: Vec<Vec3>,
    tree: FaceTree,
}

/// Anchors all points to a mesh; see the module.
pub fn anchor_points(mesh: &Mesh, points: &[Vec3], settings: &Settings) -> (Anchors, Summary) {
    Anchoring::of(mesh).anchor(points, settings)
}

impl<'a> Anchoring<'a> {
    /// Prepares the search.
    pub fn of(mesh: &'a Mesh) -> Self {
        let (tree, normals) = rayon::join(|| FaceTree::of(mesh), || mesh.vertex_normals());
        Self { mesh, normals, tree }
    }

    /// The vertex normals that [`SurfacePoint::position`] needs.
    pub fn normals(&self) -> &[Vec3] {
        &self.normals
    }

    /// Anchors points, in order; may be called piece by piece.
    pub fn anchor(&self, points: &[Vec3], settings: &Settings) -> (Anchors, Summary) {
        let count = points.len();
        let mut anchors = Anchors {
            faces: vec![NO_FACE; count],
            weights: vec![[f64::NAN; 2]; count],
            offsets: vec![f64::NAN; count],
            exact: vec![false; count],
        };
        let reach = settings.max_offset_m.max(0.0);
        let behind_filled = points
            .par_chunks(CHUNK)
            .zip(anchors.faces.par_chunks_mut(CHUNK))
            .zip(anchors.weights.par_chunks_mut(CHUNK))
            .zip(anchors.offsets.par_chunks_mut(CHUNK))
            .zip(anchors.exact.par_chunks_mut(CHUNK))
            .map(|((((points, faces), weights), offsets), exact)| {
                let (mut guess, mut behind_filled) = (None, 0);
                for (i, p) in points.iter().enumerate() {
                    if let Some((anchor, is_exact)) = self.anchor_one(p, reach, guess) {
                        guess = Some(anchor.face);
                        if anchor.offset < -BEHIND_FILLED_M && !self.mesh.observed()[anchor.face as usize] {
                            behind_filled += 1;
                            continue;
                        }
                        faces[i] = anchor.face;
                        weights[i] = [anchor.barycentric[1], anchor.barycentric[2]];
                        offsets[i] = anchor.offset;
                        exact[i] = is_exact;
                    }
                }
                behind_filled
            })
            .sum();
        let anchored = anchors.exact.iter().filter(|&&e| e).count();
        let placed = anchors.faces.iter().filter(|&&f| f != NO_FACE).count();
        let summary =
            Summary { points: count, anchored, clamped: placed - anchored, unanchored: count - placed, behind_filled };
        (anchors, summary)
    }

    /// The anchor of one point and whether it is exact; `None` farther than `max_offset_m` from the surface.
    pub fn place(&self, point: &Vec3, settings: &Settings) -> Option<(SurfacePoint, bool)> {
        self.anchor_one(point, settings.max_offset_m.max(0.0), None)
    }

    /// The nearest place of the surface at offset 0, and its distance; `None` beyond `reach_m`.
    pub fn foot(&self, point: &Vec3, reach_m: f64) -> Option<(SurfacePoint, f64)> {
        let nearest = self.tree.nearest(self.mesh, point, reach_m, None)?;
        let foot = SurfacePoint { face: nearest.face, barycentric: nearest.barycentric, offset: 0.0 };
        Some((foot, nearest.squared_distance.sqrt()))
    }

    /// The surface.
    pub fn mesh(&self) -> &'a Mesh {
        self.mesh
    }

    /// The anchor of one point and whether it is exact; `None` beyond `reach`.
    fn anchor_one(&self, p: &Vec3, reach: f64, guess: Option<FaceId>) -> Option<(SurfacePoint, bool)> {
        if !p.iter().all(|c| c.is_finite()) {
            return None;
        }
        // From the guess to the face below the point: the nearer the first face, the sooner the search ends. Mostly it is
        // the nearest, from which the walk below would come to the same anchor.
        let hint = guess.and_then(|face| self.walk(face, p, reach));
        let nearest = self.tree.nearest(self.mesh, p, reach, hint.map(|h| h.face).or(guess))?;
        if let Some(anchor) = hint.filter(|h| h.face == nearest.face) {
            return Some((anchor, true));
        }
        let limit = reach.max(2.0 * nearest.squared_distance.sqrt());
        if let Some(anchor) = self.walk(nearest.face, p, limit).or_else(|| self.look_around(nearest.face, p, limit)) {
            return Some((anchor, true));
        }
        let foot = SurfacePoint { face: nearest.face, barycentric: nearest.barycentric, offset: 0.0 };
        let towards = p - foot.position(self.mesh, &self.normals);
        let side = towards.dot(&self.mesh.double_area_vector(nearest.face));
        let offset = nearest.squared_distance.sqrt().copysign(side);
        Some((SurfacePoint { offset, ..foot }, false))
    }

    /// From prism to prism across the side the point lies behind.
    fn walk(&self, start: FaceId, p: &Vec3, limit: f64) -> Option<SurfacePoint> {
        let mut face = start;
        for _ in 0..MOST_STEPS {
            let anchor = self.in_prism(face, p)?;
            let b = anchor.barycentric;
            let lowest = (0..3).min_by(|&i, &j| b[i].total_cmp(&b[j])).unwrap_or(0);
            if b[lowest] >= INSIDE {
                return (anchor.offset.abs() <= limit).then_some(anchor);
            }
            // The side opposite to the corner with the most negative weight.
            let across = self.mesh.twins()[3 * face as usize + (lowest + 1) % 3];
            if across == topology::NO_TWIN {
                return None;
            }
            face = across / 3;
        }
        None
    }

    /// The prisms of all faces that touch a face: of those that hold the point, the one nearest in height.
    fn look_around(&self, face: FaceId, p: &Vec3, limit: f64) -> Option<SurfacePoint> {
        let mut best: Option<SurfacePoint> = None;
        for corner in 3 * face..3 * face + 3 {
            for c in topology::fan(self.mesh.twins(), corner) {
                let Some(anchor) = self.in_prism(c / 3, p) else { continue };
                let inside = anchor.barycentric.iter().all(|&b| b >= INSIDE) && anchor.offset.abs() <= limit;
                if inside && best.is_none_or(|b| anchor.offset.abs() < b.offset.abs()) {
                    best = Some(anchor);
                }
            }
        }
        best
    }

    /// Solves p = sum b_i (x_i + h n_i) on one face, wherever b lies; `None` where the prism folds over.
    fn in_prism(&self, face: FaceId, p: &Vec3) -> Option<SurfacePoint> {
        let corners = self.mesh.faces()[face as usize];
        let x = corners.map(|v| self.mesh.vertices()[v as usize]);
        let n = corners.map(|v| self.normals[v as usize]);
        let (e1, e2, m1, m2) = (x[1] - x[0], x[2] - x[0], n[1] - n[0], n[2] - n[0]);
        let base = e1.cross(&e2);
        let size = base.norm();
        let from = x[0] - p;
        let mut h = -from.dot(&base) / (size * base.dot(&(n[0] + n[1] + n[2])) / (3.0 * size));
        if !h.is_finite() {
            return None;
        }
        for _ in 0..MOST_NEWTON {
            let (a, b, d) = (e1 + m1 * h, e2 + m2 * h, from + n[0] * h);
            let area = a.cross(&b);
            let value = area.dot(&d);
            let slope = (m1.cross(&b) + a.cross(&m2)).dot(&d) + area.dot(&n[0]);
            let step = value / slope;
            if !step.is_finite() {
                return None;
            }
            h -= step;
            // Newton's method squares what is left.
            if step.abs() <= LAST_STEP * (1.0 + h.abs()) {
                break;
            }
        }
        let (a, b, d) = (e1 + m1 * h, e2 + m2 * h, -(from + n[0] * h));
        let area = a.cross(&b);
        // Beyond the centre of curvature the triangle at height h is turned over.
        if area.dot(&base) <= 0.0 {
            return None;
        }
        let scale = area.norm_squared();
        let (b1, b2) = (d.cross(&b).dot(&area) / scale, a.cross(&d).dot(&area) / scale);
        let residual = (a * b1 + b * b2 - d).norm();
        if !(residual <= 1e-10 * (1.0 + d.norm())) {
            return None;
        }
        let normal = n[0] + m1 * b1 + m2 * b2;
        Some(SurfacePoint { face, barycentric: [1.0 - b1 - b2, b1, b2], offset: h * normal.norm() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wavy sheet, 4 m x 4 m, 10 cm edges.
    fn sheet() -> Mesh {
        let n = 40u32;
        let vertices = (0..=n)
            .flat_map(|i| {
                (0..=n).map(move |j| {
                    let (x, y) = (f64::from(i) * 0.1, f64::from(j) * 0.1);
                    Vec3::new(x, y, 0.15 * (4.0 * x).sin() * (3.0 * y).cos())
                })
            })
            .collect();
        let faces = (0..n)
            .flat_map(|i| {
                (0..n).flat_map(move |j| {
                    let a = i * (n + 1) + j;
                    [[a, a + n + 1, a + n + 2], [a, a + n + 2, a + 1]]
                })
            })
            .collect();
        Mesh::all_observed(vertices, faces).unwrap()
    }

    /// Low-discrepancy points over the sheet, some beyond its border, up to 25 cm from it.
    fn points(count: usize) -> Vec<Vec3> {
        (0..count)
            .map(|i| {
                let t = i as f64;
                let (x, y) = (4.4 * (t * 0.7548776662).fract() - 0.2, 4.4 * (t * 0.5698402910).fract() - 0.2);
                let off = 0.5 * (t * 0.3819660113).fract() - 0.25;
                Vec3::new(x, y, 0.15 * (4.0 * x).sin() * (3.0 * y).cos() + off)
            })
            .collect()
    }

    #[test]
    fn anchors_come_back_exactly() {
        let mesh = sheet();
        let anchoring = Anchoring::of(&mesh);
        let points = points(20_000);
        let (anchors, summary) = anchoring.anchor(&points, &Settings::default());
        assert_eq!(summary.points, summary.anchored + summary.clamped + summary.unanchored);
        assert!(summary.anchored > 15_000 && summary.clamped > 100 && summary.unanchored == 0, "{summary:?}");
        for (i, p) in points.iter().enumerate() {
            let anchor = anchors.get(i).unwrap();
            let back = anchor.position(&mesh, anchoring.normals());
            if anchors.is_exact(i) {
                assert!((back - p).norm() < 1e-12, "{i}: {}", (back - p).norm());
            } else {
                // Only points near the border may lie in no prism.
                let inner = (0.3..3.7).contains(&p.x) && (0.3..3.7).contains(&p.y);
                assert!(!inner, "{p}");
            }
        }
    }

    #[test]
    fn the_anchor_is_continuous_across_faces() {
        let mesh = sheet();
        let uv: Vec<Vec2> = mesh.vertices().iter().map(|p| p.xy()).collect();
        let line: Vec<Vec3> = (0..4000)
            .map(|i| {
                let x = 0.5 + 3.0 * f64::from(i) / 4000.0;
                Vec3::new(x, 1.9, 0.15 * (4.0 * x).sin() * 5.7_f64.cos() + 0.08)
            })
            .collect();
        let (anchors, summary) = anchor_points(&mesh, &line, &Settings::default());
        assert_eq!(summary.anchored, 4000);
        let places = anchors.in_chart(&mesh, &uv);
        for pair in places.windows(2) {
            assert!((pair[1] - pair[0]).norm() < 0.005, "{pair:?}");
        }
    }

    #[test]
    fn the_sign_tells_void_from_rock() {
        let mesh = sheet();
        let at = |dz: f64| {
            let p = Vec3::new(2.0, 2.0, 0.15 * 8.0_f64.sin() * 6.0_f64.cos() + dz);
            anchor_points(&mesh, &[p], &Settings::default()).0.get(0).unwrap().offset
        };
        let (above, below) = (at(0.05), at(-0.05));
        assert!((0.03..0.06).contains(&above) && (-0.06..-0.03).contains(&below), "{above} {below}");
    }

    #[test]
    fn what_was_cut_off_behind_a_filled_patch_has_no_place() {
        let whole = sheet();
        let in_patch = |f: u32| {
            let [a, b, c] = whole.corners(f);
            let m = (a + b + c) / 3.0;
            (1.0..3.0).contains(&m.x) && (1.0..3.0).contains(&m.y)
        };
        let observed = (0..whole.faces().len() as u32).map(|f| !in_patch(f)).collect();
        let mesh = Mesh::new(whole.vertices().to_vec(), whole.faces().to_vec(), observed).unwrap();
        let at = |x: f64, dz: f64| Vec3::new(x, 2.0, 0.15 * (4.0 * x).sin() * 6.0_f64.cos() + dz);
        // Behind and before the patch, and behind what was seen.
        let points = [at(2.0, -0.15), at(2.0, 0.15), at(0.5, -0.15)];
        let (anchors, summary) = anchor_points(&mesh, &points, &Settings::default());
        assert_eq!(summary, Summary { points: 3, anchored: 2, unanchored: 1, behind_filled: 1, ..Summary::default() });
        assert!(anchors.get(0).is_none() && anchors.get(1).is_some() && anchors.get(2).is_some());
    }

    #[test]
    fn far_and_broken_points_are_counted() {
        let mesh = sheet();
        let points = [Vec3::new(2.0, 2.0, 3.0), Vec3::new(f64::NAN, 0.0, 0.0), Vec3::new(2.0, 2.0, 0.0)];
        let (anchors, summary) = anchor_points(&mesh, &points, &Settings::default());
        assert_eq!(summary, Summary { points: 3, anchored: 1, unanchored: 2, ..Summary::default() });
        assert_eq!((anchors.get(0), anchors.get(1)), (None, None));
        assert!(anchors.offsets()[0].is_nan());
    }

    #[test]
    fn one_thread_and_two_give_the_same_anchors() {
        let mesh = sheet();
        let points = points(10_000);
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| anchor_points(&mesh, &points, &Settings::default()).0)
        };
        let (one, two) = (on(1), on(2));
        for i in 0..points.len() {
            assert_eq!(one.get(i), two.get(i));
        }
    }
}
