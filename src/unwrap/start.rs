//! Where iterative methods start: the guide's section chart, else a conformal map, else Tutte's embedding.

use super::conformal::{ConformalForm, far_pair, used_vertices};
use super::distortion::flipped_faces;
use super::guide::Guide;
use super::rigid_fit::chart_area;
use super::triangle_shapes::Shapes;
use super::unfold::unfold;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::numeric::Vec2;
use crate::numeric::sparse::{self, Cholesky, Pattern};
use crate::warning::Warning;
use std::f64::consts::TAU;

/// The start of a method that bears flips: the section chart, or the pinned conformal map scaled to the surface's area.
pub(super) fn start(
    method: &'static str,
    strip: &Strip,
    guide: Option<&Guide>,
    shapes: &Shapes,
    summary: &mut SolveSummary,
) -> Result<Vec<Vec2>, Error> {
    if let Some(guide) = guide {
        summary.figures.insert("started_from_guide".to_owned(), 1.0);
        return Ok(guide.uv().to_vec());
    }
    summary.figures.insert("started_from_guide".to_owned(), 0.0);
    pinned_conformal(strip, shapes).map_err(|e| Error::Solve { method, what: e.to_string() })
}

/// The start of a method that keeps faces from flipping: as [`start`], unfolded; Tutte's embedding when flips remain.
///
/// # Errors
/// [`Error::Solve`] when even that has flips, which takes a defect of rounding.
pub(super) fn start_without_flips(
    method: &'static str,
    strip: &Strip,
    guide: Option<&Guide>,
    shapes: &Shapes,
    summary: &mut SolveSummary,
) -> Result<Vec<Vec2>, Error> {
    let mesh = strip.mesh();
    let mut uv = start(method, strip, guide, shapes, summary)?;
    let unfolded = unfold(mesh, &mut uv);
    summary.figures.insert("start_flipped_faces".to_owned(), unfolded.flipped_before as f64);
    if unfolded.flipped_after == 0 {
        return Ok(uv);
    }
    summary.warnings.push(Warning::new(
        "started-from-tutte",
        format!(
            "{} faces of the start stay flipped after unfolding ({} before), so {method} starts from Tutte's embedding \
             in a disk instead and may need more iterations",
            unfolded.flipped_after, unfolded.flipped_before
        ),
    ));
    let uv = tutte(strip, shapes).map_err(|e: sparse::Error| Error::Solve { method, what: e.to_string() })?;
    match flipped_faces(mesh, &uv) {
        (0, _) => Ok(uv),
        (flipped, collapsed) => Err(Error::Solve {
            method,
            what: format!(
                "no start without flips: {flipped} faces are flipped in Tutte's embedding, {collapsed} of them have no area"
            ),
        }),
    }
}

/// The conformal map with two far boundary vertices held, scaled to the area of the surface.
pub(super) fn pinned_conformal(strip: &Strip, shapes: &Shapes) -> Result<Vec<Vec2>, sparse::Error> {
    let form = ConformalForm::new(strip, |f| shapes.shapes[f].cotangents())?;
    let [a, b] = far_pair(strip);
    let (mut uv, _) = form.solve_pinned([(a, Vec2::zeros()), (b, Vec2::new(1.0, 0.0))])?;
    let area = chart_area(strip.mesh().faces(), &uv);
    if area > 0.0 {
        let scale = (shapes.area() / area).sqrt();
        uv.iter_mut().for_each(|p| *p *= scale);
    }
    Ok(uv)
}

/// Tutte's embedding (W. T. Tutte, "How to draw a graph", Proc. London Math. Soc. 13, 1963, doi:10.1112/plms/s3-13.1.743):
/// the outer loop on a circle of the surface's area by arc length, every other vertex in the mean of its neighbours. Holes
/// count as filled by one vertex each, so that the graph is that of a disk.
pub(super) fn tutte(strip: &Strip, shapes: &Shapes) -> Result<Vec<Vec2>, sparse::Error> {
    let (mesh, rim) = (strip.mesh(), strip.outer_loop());
    let n = mesh.vertices().len();
    let total = n + strip.hole_loops().len();
    let radius = (shapes.area() / std::f64::consts::PI).sqrt();
    let mut fixed: Vec<Option<Vec2>> = vec![None; total];
    let length = |k: usize| {
        let (a, b) = (rim[k] as usize, rim[(k + 1) % rim.len()] as usize);
        (mesh.vertices()[a] - mesh.vertices()[b]).norm()
    };
    // A share of plain counting keeps doubled vertices apart on the circle.
    let perimeter: f64 = (0..rim.len()).map(length).sum();
    let mut gone = 0.0;
    for (k, &v) in rim.iter().enumerate() {
        let turn = 0.9 * gone / perimeter.max(f64::MIN_POSITIVE) + 0.1 * k as f64 / rim.len() as f64;
        fixed[v as usize] = Some(Vec2::new((TAU * turn).cos(), (TAU * turn).sin()) * radius);
        gone += length(k);
    }
    for (v, used) in used_vertices(n, mesh.faces()).into_iter().enumerate() {
        if !used {
            fixed[v] = Some(Vec2::zeros());
        }
    }
    let spokes = strip.hole_loops().iter().enumerate();
    let spokes: Vec<(u32, u32)> = spokes.flat_map(|(h, l)| l.iter().map(move |&v| (v, (n + h) as u32))).collect();
    let edges = || mesh.faces().iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).chain(spokes.iter().copied());
    let pattern = Pattern::of_pairs(total, edges)?;
    let mut values = vec![0.0; pattern.entries()];
    for j in 0..total {
        for (k, &i) in pattern.column(j).iter().enumerate().skip(1) {
            values[pattern.diagonal(j) + k] = -1.0;
            values[pattern.diagonal(j)] += 1.0;
            values[pattern.diagonal(i as usize)] += 1.0;
        }
    }
    let mut free = values.clone();
    let mut x = vec![0.0; total];
    let mut y = vec![0.0; total];
    pattern.fix_unknowns(&mut values, &mut x, |j| fixed[j].map(|p| p.x));
    pattern.fix_unknowns(&mut free, &mut y, |j| fixed[j].map(|p| p.y));
    let factor = Cholesky::of(&pattern, &values)?;
    let x = factor.solve_refined(&pattern, &values, &x);
    let y = factor.solve_refined(&pattern, &values, &y);
    Ok((0..n).map(|v| Vec2::new(x[v], y[v])).collect())
}

#[cfg(test)]
mod tests {
    use super::super::closed_form;
    use super::*;

    #[test]
    fn tutte_has_no_flips_with_and_without_holes() {
        let known = closed_form::rough(30, 30);
        let shapes = Shapes::of(known.strip.mesh());
        let uv = tutte(&known.strip, &shapes).unwrap();
        assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);

        let mesh = known.strip.mesh();
        let far = |f: &[u32; 3]| f.iter().all(|&v| (known.flat[v as usize] - known.flat[480]).norm() > 2.0);
        let faces: Vec<[u32; 3]> = mesh.faces().iter().copied().filter(far).collect();
        let mesh = crate::mesh::Mesh::all_observed(mesh.vertices().to_vec(), faces).unwrap();
        let strip = Strip::from_disk(mesh).unwrap();
        assert!(!strip.hole_loops().is_empty());
        let uv = tutte(&strip, &Shapes::of(strip.mesh())).unwrap();
        assert_eq!(flipped_faces(strip.mesh(), &uv).0, 0);
    }
}
