//! Where iterative methods start: the guide's section chart or a conformal map, else Tutte's embedding.

use super::conformal::{ConformalForm, far_pair, used_vertices};
use super::guide::Guide;
use super::rigid_fit::chart_area;
use super::triangle_shapes::Shapes;
use super::unfold::{Unfolded, unfold};
use super::unfurl::unfurl;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::mesh::Mesh;
use crate::numeric::sparse::{self, Analysis, Cholesky, Pattern};
use crate::numeric::{Vec2, Vec3};
use crate::warning::Warning;
use rayon::prelude::*;
use std::f64::consts::TAU;

/// How far the sides of the rectangle bulge, as a share of their length.
const BULGE: f64 = 0.02;
/// Edges count as at least this long, as a share of a typical one.
const SHORTEST: f64 = 1e-3;
/// How often the springs of an embedding are softened at most, and by how much at once.
const SOFTENINGS: usize = 20;
const MOST_SOFTENING: f64 = 30.0;
/// Softening ends when the energy of what is squeezed falls by less than this.
const MUST_GAIN: f64 = 0.95;

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
    // The guide's chart was unfolded as far as it goes.
    let unfolded = match guide {
        Some(guide) => Unfolded {
            flipped_before: guide.summary().folded_faces,
            flipped_after: guide.summary().flipped_faces,
            moved_vertices: guide.summary().moved_vertices,
        },
        None => unfold(mesh, &mut uv),
    };
    summary.figures.insert("start_flipped_faces".to_owned(), unfolded.flipped_before as f64);
    if unfolded.flipped_after == 0 {
        return Ok(uv);
    }
    let failed = |e: sparse::Error| Error::Solve { method, what: format!("start from Tutte's embedding: {e}") };
    let in_rectangle = guide.map(|guide| in_rectangle(strip, guide)).transpose().map_err(failed)?.flatten();
    let figure = if in_rectangle.is_some() { "a rectangle" } else { "a disk" };
    summary.warnings.push(Warning::new(
        "started-from-tutte",
        format!(
            "{} faces of the start stay flipped after unfolding ({} before), so {method} starts from Tutte's embedding \
             in {figure} instead",
            unfolded.flipped_after, unfolded.flipped_before
        ),
    ));
    uv = in_rectangle.map_or_else(|| tutte(strip, shapes), Ok).map_err(failed)?;
    // Rounding folds faces that the embedding squeezes to nearly nothing; they are few and lie apart.
    let still = unfold(mesh, &mut uv).flipped_after;
    if still > 0 {
        let what = format!("no start without flips: {still} faces are flipped in Tutte's embedding");
        return Err(Error::Solve { method, what });
    }
    let unfurled = unfurl(mesh, shapes, &mut uv).map_err(failed)?;
    summary.figures.insert("unfurling_rounds".to_owned(), unfurled.rounds as f64);
    Ok(uv)
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

/// Tutte's embedding in a circle of the surface's area, the outer loop spread on it by arc length.
pub(super) fn tutte(strip: &Strip, shapes: &Shapes) -> Result<Vec<Vec2>, sparse::Error> {
    let rim = strip.outer_loop();
    let radius = (shapes.area() / std::f64::consts::PI).sqrt();
    let shares = shares_along(strip.mesh(), &(0..=rim.len()).map(|k| rim[k % rim.len()]).collect::<Vec<_>>());
    let places: Vec<Vec2> =
        shares.iter().take(rim.len()).map(|t| Vec2::new((TAU * t).cos(), (TAU * t).sin()) * radius).collect();
    embedded(strip, &places)
}

/// Tutte's embedding in a rectangle of the tunnel's length and girth: portals on its left and right, the seam above and
/// below. `None` where the corners of the section chart do not follow each other around the strip.
fn in_rectangle(strip: &Strip, guide: &Guide) -> Result<Option<Vec<Vec2>>, sparse::Error> {
    let (uv, rim) = (guide.uv(), strip.outer_loop());
    let girth = guide.summary().section.mean_girth_m;
    let angles = guide.angles();
    let (low, high) = rim.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &v| {
        (low.min(uv[v as usize].x), high.max(uv[v as usize].x))
    });
    if !(high > low && girth > 0.0) {
        return Ok(None);
    }
    // The corners of the rim, counter-clockwise on the map from the start of the seam's lower border.
    let sides = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
    let corner = |(along, around): (f64, f64)| -> usize {
        let score = |k: usize| {
            let v = rim[k] as usize;
            along * (2.0 * (uv[v].x - low) / (high - low) - 1.0) + around * angles[v] / std::f64::consts::PI
        };
        (0..rim.len()).max_by(|&a, &b| score(a).total_cmp(&score(b)).then(b.cmp(&a))).expect("a rim has vertices")
    };
    let corners = sides.map(corner);
    let lengths: [usize; 4] = std::array::from_fn(|i| (corners[(i + 1) % 4] + rim.len() - corners[i]) % rim.len());
    if lengths.contains(&0) || lengths.iter().sum::<usize>() != rim.len() {
        return Ok(None);
    }
    let place = |(along, around): (f64, f64)| Vec2::new(if along > 0.0 { high } else { low }, 0.5 * girth * around);
    let mut places = vec![Vec2::zeros(); rim.len()];
    for i in 0..4 {
        let side: Vec<u32> = (0..=lengths[i]).map(|k| rim[(corners[i] + k) % rim.len()]).collect();
        let (from, to) = (place(sides[i]), place(sides[(i + 1) % 4]));
        let outwards = Vec2::new((to - from).y, -(to - from).x) * (4.0 * BULGE);
        // A straight side would leave faces with all corners on it without area.
        for (k, t) in shares_along(strip.mesh(), &side).into_iter().enumerate().take(lengths[i]) {
            places[(corners[i] + k) % rim.len()] = from + (to - from) * t + outwards * (t * (1.0 - t));
        }
    }
    embedded(strip, &places).map(Some)
}

/// Where each vertex of a chain lies between its ends, 0 to 1: by length, with a share of plain counting that keeps
/// doubled vertices apart.
fn shares_along(mesh: &Mesh, chain: &[u32]) -> Vec<f64> {
    let steps: Vec<f64> =
        chain.windows(2).map(|w| (mesh.vertices()[w[0] as usize] - mesh.vertices()[w[1] as usize]).norm()).collect();
    let total = steps.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    let mut gone = 0.0;
    let mut shares = vec![0.0];
    for (k, step) in steps.iter().enumerate() {
        gone += step;
        shares.push(0.9 * gone / total + 0.1 * (k + 1) as f64 / steps.len() as f64);
    }
    shares
}

/// Tutte's embedding (W. T. Tutte, "How to draw a graph", Proc. London Math. Soc. 13, 1963, doi:10.1112/plms/s3-13.1.743)
/// inside given places of the outer loop, which have to be convex: every other vertex in the weighted mean of its
/// neighbours. Holes count as filled by one vertex each, so that the graph is that of a disk.
///
/// Springs start with weights 1 / edge length and are weakened again and again where the map squeezes the surface (S.
/// Yoshizawa, A. Belyaev, H.-P. Seidel, "A fast and simple stretch-minimizing mesh parameterization", SMI 2004,
/// doi:10.1109/SMI.2004.1314507): any positive weights give a map without flips. Departure: both ends of a spring share in its
/// weakening, so that the matrix stays symmetric, and squeezing is told by areas.
fn embedded(strip: &Strip, places: &[Vec2]) -> Result<Vec<Vec2>, sparse::Error> {
    let (mesh, rim) = (strip.mesh(), strip.outer_loop());
    let n = mesh.vertices().len();
    let total = n + strip.hole_loops().len();
    let mut fixed: Vec<Option<Vec2>> = vec![None; total];
    rim.iter().zip(places).for_each(|(&v, &p)| fixed[v as usize] = Some(p));
    for (v, used) in used_vertices(n, mesh.faces()).into_iter().enumerate() {
        if !used {
            fixed[v] = Some(Vec2::zeros());
        }
    }
    let mut points = mesh.vertices().to_vec();
    let mut spokes = Vec::new();
    for (h, hole) in strip.hole_loops().iter().enumerate() {
        points.push(hole.iter().map(|&v| mesh.vertices()[v as usize]).sum::<Vec3>() / hole.len() as f64);
        spokes.extend(hole.iter().map(|&v| (v, (n + h) as u32)));
    }
    let edges = || mesh.faces().iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).chain(spokes.iter().copied());
    let pattern = Pattern::of_pairs(total, edges)?;
    let analysis = Analysis::new(&pattern)?;
    let shortest_m = SHORTEST * (mesh.area() / mesh.faces().len() as f64).sqrt();
    let mut softness = vec![1.0; total];
    let mut best: Option<(f64, Vec<Vec2>)> = None;
    for _ in 0..SOFTENINGS {
        let mut values = vec![0.0; pattern.entries()];
        for j in 0..total {
            for (k, &i) in pattern.column(j).iter().enumerate().skip(1) {
                let i = i as usize;
                let length = (points[i] - points[j]).norm().max(shortest_m);
                let weight = 1.0 / (length * f64::sqrt(softness[i] * softness[j]));
                values[pattern.diagonal(j) + k] = -weight;
                values[pattern.diagonal(j)] += weight;
                values[pattern.diagonal(i)] += weight;
            }
        }
        let mut free = values.clone();
        let mut x = vec![0.0; total];
        let mut y = vec![0.0; total];
        pattern.fix_unknowns(&mut values, &mut x, |j| fixed[j].map(|p| p.x));
        pattern.fix_unknowns(&mut free, &mut y, |j| fixed[j].map(|p| p.y));
        let factor = Cholesky::new(&pattern, &analysis, &values)?;
        let x = factor.solve_refined(&pattern, &values, &x);
        let y = factor.solve_refined(&pattern, &values, &y);
        let uv: Vec<Vec2> = (0..n).map(|v| Vec2::new(x[v], y[v])).collect();
        let squeezed = squeezing(mesh, &uv);
        let energy = squeezed.iter().map(|&(area, squeeze)| area * squeeze * squeeze).sum::<f64>();
        if best.as_ref().is_some_and(|(least, _)| energy > MUST_GAIN * least) {
            break;
        }
        let mut sums = vec![(0.0, 0.0); n];
        for (corners, &(area, squeeze)) in mesh.faces().iter().zip(&squeezed) {
            for &v in corners {
                sums[v as usize].0 += area * squeeze;
                sums[v as usize].1 += area;
            }
        }
        for (soft, (sum, area)) in softness.iter_mut().zip(sums).filter(|(_, s)| s.1 > 0.0) {
            *soft *= (sum / area).clamp(1.0 / MOST_SOFTENING, MOST_SOFTENING);
        }
        best = Some((energy, uv));
    }
    Ok(best.expect("the first map is taken").1)
}

/// For each face its area on the surface, and the square root of how many times smaller it is on the map.
fn squeezing(mesh: &Mesh, uv: &[Vec2]) -> Vec<(f64, f64)> {
    (0..mesh.faces().len() as u32)
        .into_par_iter()
        .map(|f| {
            let area = mesh.double_area_vector(f).norm() / 2.0;
            let [a, b, c] = mesh.faces()[f as usize].map(|v| uv[v as usize]);
            let on_map = ((b - a).perp(&(c - a)) / 2.0).max(area * 1e-20).max(f64::MIN_POSITIVE);
            (area, (area / on_map).sqrt())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::closed_form;
    use super::super::distortion::flipped_faces;
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
