//! The local half of local/global methods: the rotation of each triangle, and the load that a field of rotations puts on
//! the vertices. Shared by the methods that compare triangles with rotated copies of themselves.

use super::corner_sums::CornerSums;
use super::triangle_shapes::Shape;
use crate::numeric::svd2x2::closest_rotation;
use crate::numeric::{Mat2, Vec2};
use rayon::prelude::*;

/// A rotation in the plane as cosine and sine.
pub(super) type Rotation = [f64; 2];

/// The rotation closest to each face's Jacobian (area plays no role in it); the identity where the Jacobian is zero.
pub(super) fn closest_rotations(faces: &[[u32; 3]], shapes: &[Shape], uv: &[Vec2]) -> Vec<Rotation> {
    (faces, shapes)
        .into_par_iter()
        .map(|(corners, shape)| {
            let m = shape.jacobian(corners.map(|v| uv[v as usize]));
            let (c, s) = (m.m11 + m.m22, m.m21 - m.m12);
            let n = c.hypot(s);
            if n > 0.0 { [c / n, s / n] } else { [1.0, 0.0] }
        })
        .collect()
}

/// The gradient, with respect to the vertices, of the sum over faces of area times `tr(R^T J)`: one vector a vertex.
/// It sums to zero.
pub(super) fn rotation_load(
    vertex_count: usize,
    faces: &[[u32; 3]],
    shapes: &[Shape],
    rotations: &[Rotation],
) -> Vec<Vec2> {
    let mut load = vec![Vec2::zeros(); vertex_count];
    for ((corners, shape), &[c, s]) in faces.iter().zip(shapes).zip(rotations) {
        for (&v, g) in corners.iter().zip(shape.hat_gradients()) {
            load[v as usize] += Vec2::new(c * g.x - s * g.y, s * g.x + c * g.y);
        }
    }
    load
}

/// `|J - R|^2` with the closest rotation `R`, written as `2 (q - 1)^2 + 2 r^2` for the singular values `q + r` and `q - r`,
/// which keeps the digits near an isometry.
pub(super) fn rigid_density(j: &Mat2) -> f64 {
    // The library's hypot guards against overflow, which costs a third of the whole pass.
    let swelling = ((j.m11 + j.m22).powi(2) + (j.m21 - j.m12).powi(2)).sqrt() / 2.0 - 1.0;
    let skew = (j.m11 - j.m22).powi(2) + (j.m12 + j.m21).powi(2);
    2.0 * swelling * swelling + skew / 2.0
}

/// Derivative of [`rigid_density`] with respect to `J`.
pub(super) fn rigid_slope(j: &Mat2) -> Mat2 {
    (j - closest_rotation(j)) * 2.0
}

/// The gradient of [`rigid_energy`] with respect to the vertices.
pub(super) fn rigid_gradient(corner_sums: &CornerSums, faces: &[[u32; 3]], shapes: &[Shape], uv: &[Vec2]) -> Vec<Vec2> {
    corner_sums.gather(
        |_| Vec2::zeros(),
        |f| {
            let shape = &shapes[f];
            let j = shape.jacobian(faces[f].map(|v| uv[v as usize]));
            let slope = rigid_slope(&j);
            shape.hat_gradients().map(|g| slope * g)
        },
    )
}

/// Sum over faces of `area |J - R|^2`, with `R` the rotation closest to `J`: twice the energy of Liu et al. 2008 per
/// unit of their weights, square metres.
pub(super) fn rigid_energy(faces: &[[u32; 3]], shapes: &[Shape], uv: &[Vec2]) -> f64 {
    let each: Vec<f64> = (faces, shapes)
        .into_par_iter()
        .map(|(corners, shape)| shape.area() * rigid_density(&shape.jacobian(corners.map(|v| uv[v as usize]))))
        .collect();
    each.iter().sum()
}

/// Sum over faces of `area (s1 - s2)^2 / 2` with the signed singular values of the Jacobian, square metres: the
/// conformal energy `E_C`. Adding it up face by face loses no digits, where `x^T M x` cancels.
pub(super) fn conformal_energy(faces: &[[u32; 3]], shapes: &[Shape], uv: &[Vec2]) -> f64 {
    let each: Vec<f64> = (faces, shapes)
        .into_par_iter()
        .map(|(corners, shape)| {
            let m = shape.jacobian(corners.map(|v| uv[v as usize]));
            shape.area() * ((m.m11 - m.m22).powi(2) + (m.m12 + m.m21).powi(2)) / 2.0
        })
        .collect();
    each.iter().sum()
}

/// Signed area of a chart, square metres.
pub(super) fn chart_area(faces: &[[u32; 3]], uv: &[Vec2]) -> f64 {
    faces
        .iter()
        .map(|corners| {
            let [a, b, c] = corners.map(|v| uv[v as usize]);
            (b - a).perp(&(c - a)) / 2.0
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_load_is_the_gradient_of_the_trace_term() {
        let shape = Shape { base: 2.0, x: 0.5, y: 1.5 };
        let faces = [[0u32, 1, 2]];
        let uv = [Vec2::new(0.3, 0.1), Vec2::new(1.9, 0.8), Vec2::new(0.2, 2.0)];
        let rotation = [[0.8, 0.6]];
        let value =
            |uv: &[Vec2; 3]| shape.area() * (Mat2::new(0.8, -0.6, 0.6, 0.8).transpose() * shape.jacobian(*uv)).trace();
        let load = rotation_load(3, &faces, &[shape], &rotation);
        for i in 0..3 {
            for k in 0..2 {
                let mut moved = uv;
                moved[i][k] += 1e-6;
                assert!(((value(&moved) - value(&uv)) / 1e-6 - load[i][k]).abs() < 1e-8);
            }
        }
    }

    #[test]
    fn the_gradient_is_the_derivative_of_the_energy() {
        let shapes = [Shape { base: 2.0, x: 0.5, y: 1.5 }, Shape { base: 1.0, x: 0.2, y: 0.7 }];
        let faces = [[0u32, 1, 2], [2, 1, 3]];
        let uv = [Vec2::new(0.3, 0.1), Vec2::new(1.9, 0.8), Vec2::new(0.2, 2.0), Vec2::new(1.4, 2.2)];
        let gradient = rigid_gradient(&CornerSums::new(4, &faces), &faces, &shapes, &uv);
        for i in 0..4 {
            for k in 0..2 {
                let at = |d: f64| {
                    let mut moved = uv;
                    moved[i][k] += d;
                    rigid_energy(&faces, &shapes, &moved)
                };
                let slope = (at(1e-6) - at(-1e-6)) / 2e-6;
                assert!((slope - gradient[i][k]).abs() < 1e-7, "{slope} {}", gradient[i][k]);
            }
        }
    }

    #[test]
    fn a_rotated_copy_has_no_energy() {
        let shape = Shape { base: 2.0, x: 0.5, y: 1.5 };
        let turn = Mat2::new(0.6, -0.8, 0.8, 0.6);
        let uv = shape.corners().map(|p| turn * p);
        assert!(rigid_energy(&[[0, 1, 2]], &[shape], &uv).abs() < 1e-15);
        let [[c, s]] = closest_rotations(&[[0, 1, 2]], &[shape], &uv)[..] else { panic!() };
        assert!((c - 0.6).abs() < 1e-15 && (s - 0.8).abs() < 1e-15);
        assert!((chart_area(&[[0, 1, 2]], &uv) - shape.area()).abs() < 1e-15);
        let doubled = uv.map(|p| p * 2.0);
        assert!((rigid_energy(&[[0, 1, 2]], &[shape], &doubled) - 2.0 * shape.area()).abs() < 1e-14);
    }
}
