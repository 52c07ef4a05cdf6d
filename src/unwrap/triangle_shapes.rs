//! The shape of each triangle laid into its own plane: what every optimizing method knows about the surface.
//!
//! Corner 0 lies at (0, 0), corner 1 at (`base`, 0), corner 2 at (`x`, `y`) with `y > 0`. Triangles that have no shape
//! (zero area, needles, doubled vertices) get one: their edge lengths grow by the same small amount until the triangle
//! inequality holds with a margin, the intrinsic mollification of N. Sharp and K. Crane, "A Laplacian for Nonmanifold
//! Triangle Meshes", Computer Graphics Forum 39(5), 2020, doi:10.1111/cgf.14069, applied to the broken triangles only.
//! Each such triangle is counted, the first ones by name.

use crate::mesh::{FaceId, Mesh};
use crate::numeric::Vec2;
use crate::warning::Warning;
use rayon::prelude::*;

/// Margin of the triangle inequality as a share of the mean edge length of the mesh. Cotangents stay below about its
/// inverse root, which costs half the digits of a solve and no more.
const MARGIN: f64 = 1e-6;

/// How many repaired faces a warning names.
const NAMED_FACES: usize = 8;

/// One triangle in its own plane, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shape {
    /// Length of the edge from corner 0 to corner 1.
    pub base: f64,
    /// First coordinate of corner 2.
    pub x: f64,
    /// Height of corner 2 over the base, positive.
    pub y: f64,
}

impl Shape {
    /// From the lengths of the edges 0-1, 1-2, 2-0, which satisfy the strict triangle inequality.
    fn from_lengths([a, b, c]: [f64; 3]) -> Self {
        // Kahan's order of operations for the area: stable for needles.
        let mut s = [a, b, c];
        s.sort_unstable_by(|p, q| q.total_cmp(p));
        let [p, q, r] = s;
        let area16 = (p + (q + r)) * (r - (p - q)) * (r + (p - q)) * (p + (q - r));
        let double_area = area16.max(0.0).sqrt() / 2.0;
        Self { base: a, x: ((c - b) * (c + b) + a * a) / (2.0 * a), y: double_area / a }
    }

    /// Area, square metres.
    pub fn area(&self) -> f64 {
        self.base * self.y / 2.0
    }

    /// Cotangents of the angles at the three corners.
    pub fn cotangents(&self) -> [f64; 3] {
        let Self { base, x, y } = *self;
        [x / y, (base - x) / y, (x * (x - base) + y * y) / (base * y)]
    }

    /// Angles at the three corners, radians.
    pub fn angles(&self) -> [f64; 3] {
        let Self { base, x, y } = *self;
        [y.atan2(x), y.atan2(base - x), (base * y).atan2(x * (x - base) + y * y)]
    }

    /// Corners in the plane.
    #[allow(dead_code, reason = "tests and deformation read it")]
    pub fn corners(&self) -> [Vec2; 3] {
        [Vec2::zeros(), Vec2::new(self.base, 0.0), Vec2::new(self.x, self.y)]
    }

    /// For each corner the gradient of its hat function (1 there, 0 at the others) times the area: half the opposite edge,
    /// turned by a quarter.
    pub fn hat_gradients(&self) -> [Vec2; 3] {
        let Self { base, x, y } = *self;
        [Vec2::new(-y, x - base) / 2.0, Vec2::new(y, -x) / 2.0, Vec2::new(0.0, base) / 2.0]
    }

    /// The Jacobian of the linear map that takes the shape's corners to `p`.
    pub fn jacobian(&self, p: [Vec2; 3]) -> crate::numeric::Mat2 {
        let first = (p[1] - p[0]) / self.base;
        let second = ((p[2] - p[0]) - first * self.x) / self.y;
        crate::numeric::Mat2::from_columns(&[first, second])
    }
}

/// The shapes of all faces of a mesh, and which of them had to be repaired.
#[derive(Clone, Debug)]
pub(super) struct Shapes {
    /// One a face.
    pub shapes: Vec<Shape>,
    /// Faces that had no shape of their own.
    pub repaired: Vec<FaceId>,
}

impl Shapes {
    pub fn of(mesh: &Mesh) -> Self {
        let (vertices, faces) = (mesh.vertices(), mesh.faces());
        let lengths = |f: usize| {
            let [a, b, c] = faces[f].map(|v| vertices[v as usize]);
            [(b - a).norm(), (c - b).norm(), (a - c).norm()]
        };
        let lengths: Vec<[f64; 3]> = (0..faces.len()).into_par_iter().map(lengths).collect();
        let total: f64 = lengths.iter().map(|l| l.iter().sum::<f64>()).sum();
        let mean = total / (3 * faces.len()).max(1) as f64;
        // All vertices in one point: any unit will do.
        let margin = MARGIN * if mean > 0.0 { mean } else { 1.0 };
        let slack = |[a, b, c]: [f64; 3]| (a + b - c).min(b + c - a).min(c + a - b);
        let shapes = (0..faces.len())
            .into_par_iter()
            .map(|f| {
                let slack = slack(lengths[f]);
                if slack >= margin {
                    // The coordinates come from the vectors, not from lengths: no digits are lost for slivers.
                    let [p, q, r] = faces[f].map(|v| vertices[v as usize]);
                    let (a, e, g) = (lengths[f][0], q - p, r - p);
                    return Shape { base: a, x: e.dot(&g) / a, y: e.cross(&g).norm() / a };
                }
                Shape::from_lengths(lengths[f].map(|l| l + (margin - slack)))
            })
            .collect();
        let repaired = (0..faces.len()).filter(|&f| !(slack(lengths[f]) >= margin)).map(|f| f as FaceId).collect();
        Self { shapes, repaired }
    }

    /// Total area, square metres.
    pub fn area(&self) -> f64 {
        self.shapes.iter().map(Shape::area).sum()
    }

    /// A warning that names the repaired faces, if there are any.
    pub fn warning(&self) -> Option<Warning> {
        let count = self.repaired.len();
        (count > 0).then(|| {
            let named: Vec<String> = self.repaired.iter().take(NAMED_FACES).map(u32::to_string).collect();
            let more = if count > NAMED_FACES { ", ..." } else { "" };
            Warning::new(
                "degenerate-faces",
                format!(
                    "{count} faces have no area or are needles ({}{more}); for the solve their edges were lengthened by \
                     at most {MARGIN:e} of the mean edge, the surface itself is unchanged",
                    named.join(", ")
                ),
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::{Mat2, Vec3};

    #[test]
    fn shape_of_a_known_triangle() {
        let v = vec![Vec3::new(1.0, 1.0, 0.0), Vec3::new(1.0, 5.0, 0.0), Vec3::new(1.0, 1.0, 3.0)];
        let shapes = Shapes::of(&Mesh::all_observed(v, vec![[0, 1, 2]]).unwrap());
        let s = shapes.shapes[0];
        assert_eq!((s.base, s.x, s.y, s.area()), (4.0, 0.0, 3.0, 6.0));
        assert!((s.angles().iter().sum::<f64>() - std::f64::consts::PI).abs() < 1e-15);
        for (angle, cot) in s.angles().iter().zip(s.cotangents()) {
            assert!((angle.cos() / angle.sin() - cot).abs() < 1e-15);
        }
        let m = Mat2::new(2.0, -1.0, 0.5, 3.0);
        assert!((s.jacobian(s.corners().map(|p| m * p + Vec2::new(7.0, 8.0))) - m).norm() < 1e-14);
        let again = Shape::from_lengths([4.0, 5.0, 3.0]);
        assert!((again.x - s.x).abs() < 1e-15 && (again.y - s.y).abs() < 1e-15);
        assert!(shapes.warning().is_none());
    }

    #[test]
    fn broken_triangles_get_a_shape_and_are_named() {
        let v = vec![Vec3::zeros(), Vec3::x(), Vec3::x() * 2.0, Vec3::x(), Vec3::new(0.5, 1.0, 0.0)];
        let faces = vec![[0, 1, 4], [0, 2, 1], [1, 3, 4]];
        let shapes = Shapes::of(&Mesh::all_observed(v, faces).unwrap());
        assert_eq!(shapes.repaired, vec![1, 2]);
        for s in &shapes.shapes {
            assert!(s.y > 0.0 && s.cotangents().iter().all(|c| c.abs() < 1e7), "{s:?}");
        }
        assert!(shapes.warning().unwrap().message.contains("2 faces have no area or are needles (1, 2)"));
    }
}
