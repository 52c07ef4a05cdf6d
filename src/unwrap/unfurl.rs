//! Unfurling: from a chart without flips that squeezes parts of the surface to nearly nothing to one that any optimiser can
//! go on from.
//!
//! Use it after an embedding in a given outline, or where a patch was laid anew: there faces are squeezed by factors of
//! thousands and more, and the energy of a method without flips is all in the worst of them, so that it moves nothing else.
//!
//! Method. Each face that is stretched or squeezed more than [`BOUND`] gets a stop on the way to its true shape that is just
//! that far from where it is, `V S^(1-t) V^T` of the shape for the Jacobian `J = U S V^T`; two steps of `slim` bring the
//! chart towards these shapes, and the stops are set anew (L. Liu, C. Ye, R. Ni, X.-M. Fu, "Progressive parameterizations",
//! ACM TOG 37(4), 2018, doi:10.1145/3197517.3201331). Departure: it ends as soon as few faces are far off, or no fewer
//! become; the method that called does the rest.
//!
//! Guarantees: no face flips; same bytes on any number of threads. Cost: a factorisation of twice the vertices a round.

use super::SolveSummary;
use super::slim::{self, WeightedSolver};
use super::triangle_shapes::{Shape, Shapes};
use crate::mesh::Mesh;
use crate::numeric::sparse;
use crate::numeric::{Mat2, Vec2};
use rayon::prelude::*;

/// Stretch between a face and its stop.
const BOUND: f64 = 3.0;
/// A face stretched or squeezed more than this is far from its shape.
const FAR: f64 = 30.0;
/// Rounds at most.
const MOST_ROUNDS: usize = 40;
/// Rounds without fewer far faces after which it ends.
const PATIENCE: usize = 4;

/// What unfurling did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Unfurled {
    pub rounds: usize,
    /// Faces stretched or squeezed more than thirtyfold, before and after.
    pub far: [usize; 2],
}

/// Unfurls a chart without flips in place; see the module.
///
/// # Errors
/// What the sparse solver refuses.
pub(super) fn unfurl(mesh: &Mesh, shapes: &Shapes, uv: &mut Vec<Vec2>) -> Result<Unfurled, sparse::Error> {
    let (mut stops, far) = stops_on_the_way(mesh.faces(), shapes, uv);
    let mut result = Unfurled { rounds: 0, far: [far, far] };
    if far == 0 {
        return Ok(result);
    }
    let settings = slim::Settings { max_iterations: 2, ..slim::Settings::default() };
    let mut solver = WeightedSolver::new(mesh, &stops)?;
    let (mut patience, mut exact) = (PATIENCE, false);
    while result.far[1] > 0 && result.rounds < MOST_ROUNDS {
        if patience == 0 {
            if exact {
                break;
            }
            // An iterative solve says nothing of faces that are squeezed a million times more than others.
            solver = solver.directly()?;
            (patience, exact) = (PATIENCE, true);
        }
        slim::iterate(&mut solver, mesh, &stops, uv, &settings, &mut SolveSummary::default())?;
        let far;
        (stops, far) = stops_on_the_way(mesh.faces(), shapes, uv);
        patience = if far < result.far[1] { PATIENCE } else { patience - 1 };
        result.far[1] = far;
        result.rounds += 1;
        solver.take_shapes(mesh, &stops)?;
    }
    Ok(result)
}

/// For each face a shape no farther from its place on the map than [`BOUND`], and the number of faces that are far off.
fn stops_on_the_way(faces: &[[u32; 3]], shapes: &Shapes, uv: &[Vec2]) -> (Shapes, usize) {
    let stops: Vec<(Shape, bool)> = faces
        .par_iter()
        .zip(&shapes.shapes)
        .map(|(corners, shape)| stop(shape, &shape.jacobian(corners.map(|v| uv[v as usize]))))
        .collect();
    let far = stops.iter().filter(|s| s.1).count();
    (Shapes { shapes: stops.into_iter().map(|s| s.0).collect(), repaired: Vec::new() }, far)
}

fn stop(shape: &Shape, j: &Mat2) -> (Shape, bool) {
    let m = j.transpose() * j;
    let half = (m.m11 - m.m22) / 2.0;
    let s1 = ((m.m11 + m.m22) / 2.0 + half.hypot(m.m12)).sqrt();
    // From the determinant: the small singular value would be lost in the square.
    let s2 = j.determinant() / s1;
    let stretch = s1.max(1.0 / s2);
    if !(stretch > BOUND && stretch.is_finite()) {
        return (*shape, false);
    }
    let t = BOUND.ln() / stretch.ln();
    let (sin, cos) = (m.m12.atan2(half) / 2.0).sin_cos();
    let [k1, k2] = [s1, s2].map(|s| s.powf(1.0 - t));
    let way = Mat2::new(
        k1 * cos * cos + k2 * sin * sin,
        (k1 - k2) * sin * cos,
        (k1 - k2) * sin * cos,
        k1 * sin * sin + k2 * cos * cos,
    );
    let (e, g) = (way * Vec2::new(shape.base, 0.0), way * Vec2::new(shape.x, shape.y));
    let base = e.norm();
    (Shape { base, x: e.dot(&g) / base, y: e.perp(&g) / base }, stretch > FAR)
}

#[cfg(test)]
mod tests {
    use super::super::closed_form;
    use super::super::distortion::{Distortion, flipped_faces};
    use super::super::start::tutte;
    use super::*;

    #[test]
    fn a_stop_is_as_far_as_wanted_and_no_farther() {
        let shape = Shape { base: 1.5, x: 0.4, y: 1.1 };
        let j = Mat2::new(0.02, 0.001, -0.004, 5e-4);
        let (stop, far) = stop(&shape, &j);
        assert!(far && stop.y > 0.0);
        let corners = shape.corners().map(|p| j * p);
        let left = stop.jacobian(corners).singular_values();
        let all = shape.jacobian(corners).singular_values();
        // The same turn as a share of the logarithms.
        let share = left.map(f64::ln).component_div(&all.map(f64::ln));
        assert!((share.x - share.y).abs() < 1e-9, "{share}");
        assert!((1.0 / left.y - BOUND).abs() < 1e-9, "{left}");
        let near = Mat2::new(1.2, 0.0, 0.1, 0.9);
        assert_eq!(super::stop(&shape, &near), (shape, false));
    }

    #[test]
    fn a_sheet_squeezed_into_a_corner_spreads_without_flips() {
        let known = closed_form::rough(40, 40);
        let mesh = known.strip.mesh();
        let shapes = Shapes::of(mesh);
        let mut uv = tutte(&known.strip, &shapes).unwrap();
        // Nothing but the border and what lies near it keeps its room.
        let rim = 1.2 * (shapes.area() / std::f64::consts::PI).sqrt();
        uv.iter_mut().for_each(|p| *p *= (p.norm() / rim).powi(6).max(1e-5));
        assert_eq!(flipped_faces(mesh, &uv).0, 0);
        let before = Distortion::of(mesh, &uv).stretch.p95;
        let unfurled = unfurl(mesh, &shapes, &mut uv).unwrap();
        let after = Distortion::of(mesh, &uv).stretch.p95;
        assert_eq!(flipped_faces(mesh, &uv).0, 0);
        assert!(unfurled.far[0] > 300 && unfurled.far[1] == 0, "{unfurled:?}");
        assert!(before > 100.0 && after < 4.0, "{before} {after}");
    }
}
