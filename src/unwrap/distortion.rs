//! How much a chart stretches the surface, told per face and for the whole map.
//!
//! Use it on any chart: it asks only for a mesh and one (u, v) for each vertex.
//!
//! On each face the map from the surface to the plane is linear. Its Jacobian J (2x2, from an orthonormal basis of the
//! face's plane to the chart) has the singular values `s1 >= s2`: a small circle on the rock becomes an ellipse with
//! these half axes.
//!
//! | symbol | here | meaning | undistorted |
//! |---|---|---|---|
//! | s1, s2 | [`FaceDistortion`] | largest and smallest length factor | 1, 1 |
//! | max(s1, 1/s2) | `stretch` | worst length error in any direction | 1 |
//! | s1 s2 | `area_ratio` | area factor | 1 |
//! | s1 / s2 | `anisotropy` | angle error | 1 |
//! | sqrt((s1^-2 + s2^-2) / 2) | `sander_l2` | root mean square length factor from map to surface | 1 |
//! | (s1^2 + s2^2 + s1^-2 + s2^-2) / 4 | `symmetric_dirichlet` | isometric energy | 1 |
//! | sum A (s1 - s2)^2 / 2 | `conformal_energy_m2` | energy of LSCM (Lévy et al. 2002) | 0 |
//! | sum A ((s1 - 1)^2 + (s2 - 1)^2) | `rigid_energy_m2` | energy of ARAP (Liu et al. 2008) | 0 |
//!
//! Averages and percentiles are weighted by surface area. Faces without area on the surface have no Jacobian; they are
//! counted and left out. Flips and overlaps are decided with exact predicates, never with a tolerance.
//!
//! References: P. Sander, J. Snyder, S. Gortler, H. Hoppe, "Texture mapping progressive meshes", SIGGRAPH 2001,
//! doi:10.1145/383259.383307 (stretch, L2); J. Shewchuk, "Adaptive precision floating-point arithmetic and fast robust
//! geometric predicates", Discrete & Computational Geometry 18, 1997, doi:10.1007/PL00009321 (orientation).
//! Cost: linear.

use crate::cut::Strip;
use crate::mesh::{FaceId, Mesh, topology};
use crate::numeric::statistics::weighted_quantiles;
use crate::numeric::{Mat2, Vec2, Vec3, svd2x2};
use rayon::prelude::*;
use robust::{Coord, orient2d};
use serde::Serialize;

/// Length factors of one face.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FaceDistortion {
    /// Largest length factor.
    pub s1: f64,
    /// Smallest length factor; negative where the face is flipped.
    pub s2: f64,
    /// Direction on the map of the greatest stretch, radians from u, (-pi/2, pi/2].
    pub direction: f64,
    /// Area on the surface, square metres.
    pub area: f64,
}

impl FaceDistortion {
    /// max(s1, 1/s2), at most `1 / SMALLEST_FACTOR` for collapsed faces.
    pub fn stretch(&self) -> f64 {
        self.s1.max(1.0 / self.small())
    }

    fn small(&self) -> f64 {
        self.s2.abs().max(SMALLEST_FACTOR)
    }

    /// Whether the face has an area on the surface, so that its length factors are defined.
    pub fn is_defined(&self) -> bool {
        self.s1.is_finite()
    }
}

/// Smaller length factors count as this much, so that one collapsed face does not hide the rest of the map.
pub const SMALLEST_FACTOR: f64 = 1e-6;

/// Faces whose doubled area is below this share of their longest edge squared have no usable plane.
const DEGENERATE_SHAPE: f64 = 1e-13;

/// The Jacobian of a face from its plane (x along the first edge) to the chart; `None` without area.
pub fn jacobian(corners: [Vec3; 3], in_chart: [Vec2; 3]) -> Option<Mat2> {
    let (e1, e2) = (corners[1] - corners[0], corners[2] - corners[0]);
    let length = e1.norm();
    let x = e1 / length;
    let along = e2.dot(&x);
    let across = (e2 - x * along).norm();
    let longest = length.max(e2.norm());
    // Written so that NaN (zero-length edges) is refused too.
    if !(length * across > DEGENERATE_SHAPE * longest * longest) {
        return None;
    }
    let (u1, u2) = (in_chart[1] - in_chart[0], in_chart[2] - in_chart[0]);
    let first = u1 / length;
    let second = (u2 - first * along) / across;
    Some(Mat2::from_columns(&[first, second]))
}

/// Length factors of one face; NaN where the face has no area on the surface.
pub fn of_face(mesh: &Mesh, uv: &[Vec2], face: FaceId) -> FaceDistortion {
    let corners = mesh.corners(face);
    let in_chart = mesh.faces()[face as usize].map(|v| uv[v as usize]);
    let area = (corners[1] - corners[0]).cross(&(corners[2] - corners[0])).norm() / 2.0;
    match jacobian(corners, in_chart) {
        Some(j) => {
            let (s1, s2) = svd2x2::signed_singular_values(&j);
            let stretch = j * j.transpose();
            let direction = 0.5 * (2.0 * stretch.m12).atan2(stretch.m11 - stretch.m22);
            FaceDistortion { s1, s2, direction, area }
        }
        None => FaceDistortion { s1: f64::NAN, s2: f64::NAN, direction: f64::NAN, area },
    }
}

/// Length factors of all faces.
pub fn of_faces(mesh: &Mesh, uv: &[Vec2]) -> Vec<FaceDistortion> {
    (0..mesh.faces().len() as FaceId).into_par_iter().map(|face| of_face(mesh, uv, face)).collect()
}

/// An area-weighted distribution over the faces.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Distribution {
    /// Smallest value.
    pub min: f64,
    /// 5 % of the area lies below.
    pub p05: f64,
    /// Area-weighted mean.
    pub mean: f64,
    /// Area-weighted median.
    pub p50: f64,
    /// 95 % of the area lies below.
    pub p95: f64,
    /// 99 % of the area lies below.
    pub p99: f64,
    /// Largest value.
    pub max: f64,
}

impl Distribution {
    /// The distribution of `values` weighted by `areas`; all zero when there are none.
    pub fn of(values: &[f64], areas: &[f64]) -> Self {
        let Some(at) = weighted_quantiles(values, areas, &[0.05, 0.5, 0.95, 0.99]) else { return Self::default() };
        let (first, last) =
            values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
        let total: f64 = areas.iter().sum();
        let mean = values.iter().zip(areas).map(|(v, w)| v * w).sum::<f64>() / total;
        Self { min: first, p05: at[0], mean, p50: at[1], p95: at[2], p99: at[3], max: last }
    }
}

/// The distortion of a whole chart.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Distortion {
    /// max(s1, 1/s2): the worst length error of each face in any direction.
    pub stretch: Distribution,
    /// s1 s2: map area over surface area.
    pub area_ratio: Distribution,
    /// s1 / s2: 1 where angles are kept.
    pub anisotropy: Distribution,
    /// Largest length factor.
    pub s1: Distribution,
    /// Smallest length factor.
    pub s2: Distribution,
    /// Area-weighted mean of (s1^2 + s2^2 + s1^-2 + s2^-2) / 4.
    pub symmetric_dirichlet: f64,
    /// Sander's L2 stretch: root of the area-weighted mean of (s1^-2 + s2^-2) / 2.
    pub sander_l2: f64,
    /// Conformal energy of the map as it lies: sum of area (s1 - s2)^2 / 2, square metres; what `lscm` makes small.
    pub conformal_energy_m2: f64,
    /// Rigid energy of the map as it lies: sum of area ((s1 - 1)^2 + (s2 - 1)^2), which is area |J - R|^2 with the
    /// closest rotation R, square metres; what `arap` makes small.
    pub rigid_energy_m2: f64,
    /// Area of the surface, square metres.
    pub surface_area_m2: f64,
    /// Area of the map, square metres; flipped faces count negative.
    pub map_area_m2: f64,
    /// Faces without area on the surface, left out of all figures above.
    pub degenerate_faces: usize,
}

impl Distortion {
    /// Measures a chart against a mesh.
    pub fn of(mesh: &Mesh, uv: &[Vec2]) -> Self {
        Self::of_measured(&of_faces(mesh, uv))
    }

    /// Sums up faces that are already measured.
    pub fn of_measured(faces: &[FaceDistortion]) -> Self {
        let defined: Vec<&FaceDistortion> = faces.iter().filter(|f| f.is_defined()).collect();
        let areas: Vec<f64> = defined.iter().map(|f| f.area).collect();
        let spread = |value: fn(&FaceDistortion) -> f64| {
            Distribution::of(&defined.iter().map(|f| value(f)).collect::<Vec<f64>>(), &areas)
        };
        let total: f64 = areas.iter().sum();
        let mean = |value: fn(&FaceDistortion) -> f64| {
            if total > 0.0 { defined.iter().map(|f| value(f) * f.area).sum::<f64>() / total } else { 0.0 }
        };
        let figures: [fn(&FaceDistortion) -> f64; 5] = [
            FaceDistortion::stretch,
            |f| f.s1 * f.s2,
            |f| f.s1.max(SMALLEST_FACTOR) / f.small(),
            |f| f.s1,
            |f| f.s2.abs(),
        ];
        let mut spreads = [Distribution::default(); 5];
        spreads.par_iter_mut().zip(figures).for_each(|(slot, figure)| *slot = spread(figure));
        let [stretch, area_ratio, anisotropy, s1, s2] = spreads;
        Self {
            stretch,
            area_ratio,
            anisotropy,
            s1,
            s2,
            symmetric_dirichlet: mean(|f| {
                let (a, b) = (f.s1.max(SMALLEST_FACTOR).powi(2), f.small().powi(2));
                (a + b + 1.0 / a + 1.0 / b) / 4.0
            }),
            sander_l2: mean(|f| (f.s1.max(SMALLEST_FACTOR).powi(-2) + f.small().powi(-2)) / 2.0).sqrt(),
            conformal_energy_m2: defined.iter().map(|f| f.area * (f.s1 - f.s2).powi(2) / 2.0).sum(),
            rigid_energy_m2: defined.iter().map(|f| f.area * ((f.s1 - 1.0).powi(2) + (f.s2 - 1.0).powi(2))).sum(),
            surface_area_m2: total,
            map_area_m2: defined.iter().map(|f| f.s1 * f.s2 * f.area).sum(),
            degenerate_faces: faces.len() - defined.len(),
        }
    }
}

fn coord(p: Vec2) -> Coord<f64> {
    Coord { x: p.x, y: p.y }
}

/// Sign of the orientation of a face on the map, exact: positive when counter-clockwise.
pub fn orientation([a, b, c]: [Vec2; 3]) -> f64 {
    orient2d(coord(a), coord(b), coord(c))
}

/// Faces that are not counter-clockwise on the map, and how many of them have exactly no area there.
pub fn flipped_faces(mesh: &Mesh, uv: &[Vec2]) -> (usize, usize) {
    mesh.faces()
        .par_iter()
        .map(|corners| {
            let o = orientation(corners.map(|v| uv[v as usize]));
            (usize::from(o <= 0.0), usize::from(o == 0.0))
        })
        .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1))
}

/// Proper crossings between border edges of the chart (outer border and holes): each is a place where the map begins to
/// cover itself. Edges that share a vertex do not count.
pub fn border_crossings(strip: &Strip, uv: &[Vec2]) -> usize {
    let borders = std::iter::once(strip.outer_loop()).chain(strip.hole_loops().iter().map(Vec::as_slice));
    let edges: Vec<[u32; 2]> = borders.flat_map(|l| (0..l.len()).map(move |i| [l[i], l[(i + 1) % l.len()]])).collect();
    let ends = |e: &[u32; 2]| e.map(|v| uv[v as usize]);
    let mut lowest = Vec2::repeat(f64::INFINITY);
    let mut highest = Vec2::repeat(f64::NEG_INFINITY);
    let mut length = 0.0;
    for edge in &edges {
        let [a, b] = ends(edge);
        lowest = lowest.inf(&a).inf(&b);
        highest = highest.sup(&a).sup(&b);
        length += (b - a).norm();
    }
    // Cells of the mean border edge keep a cell's list short; the limit bounds memory on degenerate charts.
    let extent = highest - lowest;
    let cell = (length / edges.len() as f64).max(extent.max() / 4000.0).max(f64::MIN_POSITIVE);
    let column = |x: f64| ((x - lowest.x) / cell) as u32;
    let row = |y: f64| ((y - lowest.y) / cell) as u32;
    let mut entries: Vec<(u32, u32, u32)> = Vec::new();
    for (index, edge) in edges.iter().enumerate() {
        let [a, b] = ends(edge);
        for i in column(a.x.min(b.x))..=column(a.x.max(b.x)) {
            for j in row(a.y.min(b.y))..=row(a.y.max(b.y)) {
                entries.push((i, j, index as u32));
            }
        }
    }
    entries.sort_unstable();
    let mut pairs: Vec<(u32, u32)> = Vec::new();
    for same in entries.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        for (k, &(.., first)) in same.iter().enumerate() {
            for &(.., second) in &same[k + 1..] {
                let (e, f) = (edges[first as usize], edges[second as usize]);
                let shared = e.iter().any(|v| f.contains(v));
                if !shared && segments_cross(ends(&e), ends(&f)) {
                    pairs.push((first, second));
                }
            }
        }
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs.len()
}

fn segments_cross([a, b]: [Vec2; 2], [c, d]: [Vec2; 2]) -> bool {
    let side = |p: Vec2, q: Vec2, r: Vec2| orient2d(coord(p), coord(q), coord(r));
    let (c_side, d_side) = (side(a, b, c), side(a, b, d));
    let (a_side, b_side) = (side(c, d, a), side(c, d, b));
    // Opposite strict signs; products could underflow.
    let opposite = |x: f64, y: f64| (x > 0.0 && y < 0.0) || (x < 0.0 && y > 0.0);
    opposite(c_side, d_side) && opposite(a_side, b_side)
}

/// The surface with detail below about `scale` metres smoothed away: same faces, vertices moved to averages.
///
/// Damped averaging over the neighbours (weights of a Gaussian of standard deviation scale / 2 reached by repeated
/// one-ring steps); border vertices average along the border only. Vertices move along the normal of the smoothed surface
/// only: sliding along the surface would count as distortion of a map that has none.
pub fn smoothed_surface(mesh: &Mesh, scale: f64) -> Mesh {
    let faces = mesh.faces();
    let count = mesh.vertices().len();
    let twin = mesh.twins();
    let mut border = vec![false; count];
    let mut unique: Vec<(u32, u32, bool)> = Vec::with_capacity(twin.len() / 2 + 1);
    let mut squared = 0.0;
    for (half_edge, &other) in twin.iter().enumerate() {
        let on_border = other == topology::NO_TWIN;
        if !on_border && (other as usize) < half_edge {
            continue;
        }
        let corners = faces[half_edge / 3];
        let (a, b) = (corners[half_edge % 3], corners[(half_edge + 1) % 3]);
        unique.push((a, b, on_border));
        squared += (mesh.vertices()[a as usize] - mesh.vertices()[b as usize]).norm_squared();
        if on_border {
            border[a as usize] = true;
            border[b as usize] = true;
        }
    }
    if unique.is_empty() {
        return mesh.clone();
    }
    // Neighbours in compressed rows; a border vertex only sees its border neighbours.
    let sees = |from: u32, on_border: bool| on_border || !border[from as usize];
    let mut start = vec![0u32; count + 1];
    for &(a, b, on_border) in &unique {
        start[a as usize + 1] += u32::from(sees(a, on_border));
        start[b as usize + 1] += u32::from(sees(b, on_border));
    }
    for i in 0..count {
        start[i + 1] += start[i];
    }
    let mut neighbours = vec![0u32; start[count] as usize];
    let mut fill = start.clone();
    for &(a, b, on_border) in &unique {
        for (from, to) in [(a, b), (b, a)] {
            if sees(from, on_border) {
                neighbours[fill[from as usize] as usize] = to;
                fill[from as usize] += 1;
            }
        }
    }
    let edges = unique.len() as f64;
    drop((unique, fill));
    // A half-way step has variance mean(edge^2) / 4 in each direction of the surface (random walk of half the mass).
    let step_variance = squared / edges / 4.0;
    let steps = ((scale / 2.0).powi(2) / step_variance).round().clamp(1.0, 400.0) as usize;
    let mut positions = mesh.vertices().to_vec();
    for _ in 0..steps {
        positions = (0..count)
            .into_par_iter()
            .map(|v| {
                let around = &neighbours[start[v] as usize..start[v + 1] as usize];
                if around.is_empty() {
                    return positions[v];
                }
                let mean = around.iter().fold(Vec3::zeros(), |s, &n| s + positions[n as usize]) / around.len() as f64;
                (positions[v] + mean) / 2.0
            })
            .collect();
    }
    let smooth = mesh.moved_to(positions);
    let normals = smooth.vertex_normals();
    let along_normals = mesh
        .vertices()
        .iter()
        .zip(smooth.vertices())
        .zip(&normals)
        .map(|((from, to), normal)| from + normal * normal.dot(&(to - from)))
        .collect();
    mesh.moved_to(along_normals)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle() -> Mesh {
        let v = vec![Vec3::zeros(), Vec3::new(1.0, 0.0, 0.0), Vec3::new(0.0, 1.0, 0.0)];
        Mesh::all_observed(v, vec![[0, 1, 2]]).unwrap()
    }

    #[test]
    fn a_known_linear_map_gives_its_singular_values() {
        let mesh = triangle();
        // Stretch 3 along 30 degrees, 0.5 across it.
        let (sin, cos) = 30_f64.to_radians().sin_cos();
        let turn = Mat2::new(cos, -sin, sin, cos);
        let j = turn * Mat2::new(3.0, 0.0, 0.0, 0.5) * turn.transpose();
        let uv: Vec<Vec2> = mesh.vertices().iter().map(|p| j * p.xy()).collect();
        let f = of_face(&mesh, &uv, 0);
        assert!((f.s1 - 3.0).abs() < 1e-14 && (f.s2 - 0.5).abs() < 1e-14);
        assert!((f.direction.to_degrees() - 30.0).abs() < 1e-12);
        let d = Distortion::of(&mesh, &uv);
        assert!((d.stretch.mean - 3.0).abs() < 1e-14 && (d.area_ratio.mean - 1.5).abs() < 1e-14);
        assert!((d.anisotropy.max - 6.0).abs() < 1e-13);
        assert!((d.symmetric_dirichlet - (9.0 + 0.25 + 1.0 / 9.0 + 4.0) / 4.0).abs() < 1e-14);
        assert!((d.conformal_energy_m2 - 0.5 * 2.5 * 2.5 / 2.0).abs() < 1e-14);
        assert!((d.rigid_energy_m2 - 0.5 * (4.0 + 0.25)).abs() < 1e-14);
        assert!((d.sander_l2 - ((1.0 / 9.0 + 4.0) / 2.0_f64).sqrt()).abs() < 1e-14);
    }

    #[test]
    fn flips_and_collapses_are_told_apart() {
        let mesh = triangle();
        let p = Vec2::new;
        assert_eq!(flipped_faces(&mesh, &[p(0.0, 0.0), p(1.0, 0.0), p(0.0, 1.0)]), (0, 0));
        assert_eq!(flipped_faces(&mesh, &[p(0.0, 0.0), p(0.0, 1.0), p(1.0, 0.0)]), (1, 0));
        assert_eq!(flipped_faces(&mesh, &[p(0.0, 0.0), p(0.1, 0.1), p(0.3, 0.3)]), (1, 1));
        assert!(of_face(&mesh, &[p(0.0, 0.0), p(0.0, 1.0), p(1.0, 0.0)], 0).s2 < 0.0);
    }

    #[test]
    fn a_degenerate_face_is_left_out_and_counted() {
        let v = vec![Vec3::zeros(), Vec3::x(), Vec3::x() * 2.0, Vec3::y()];
        let mesh = Mesh::all_observed(v, vec![[0, 1, 2], [0, 2, 3]]).unwrap();
        let uv: Vec<Vec2> = mesh.vertices().iter().map(|p| p.xy()).collect();
        let d = Distortion::of(&mesh, &uv);
        assert_eq!(d.degenerate_faces, 1);
        assert!((d.stretch.max - 1.0).abs() < 1e-15);
    }

    #[test]
    fn percentiles_are_weighted_by_area() {
        let d = Distribution::of(&[1.0, 2.0, 3.0], &[90.0, 9.0, 1.0]);
        assert_eq!((d.p50, d.p95, d.p99, d.max), (1.0, 2.0, 2.0, 3.0));
        assert!((d.mean - 1.11).abs() < 1e-14);
    }

    #[test]
    fn a_border_that_crosses_itself_is_found() {
        // A band of four quads bent onto itself on the map.
        let vertices = (0..5).flat_map(|i| [Vec3::new(f64::from(i), 0.0, 0.0), Vec3::new(f64::from(i), 1.0, 0.0)]);
        let faces = (0..4u32).flat_map(|i| [[2 * i, 2 * i + 2, 2 * i + 3], [2 * i, 2 * i + 3, 2 * i + 1]]).collect();
        let strip = Strip::from_disk(Mesh::all_observed(vertices.collect(), faces).unwrap()).unwrap();
        let mut uv: Vec<Vec2> = strip.mesh().vertices().iter().map(|p| p.xy()).collect();
        assert_eq!(border_crossings(&strip, &uv), 0);
        // The last column is pulled across the first quads.
        uv[8] = Vec2::new(0.5, -0.5);
        uv[9] = Vec2::new(0.5, 1.5);
        assert_eq!(border_crossings(&strip, &uv), 2);
    }

    #[test]
    fn smoothing_flattens_ripples_and_keeps_a_plane() {
        let grid = |amplitude: f64| {
            let n = 40u32;
            let vertices = (0..=n)
                .flat_map(|i| {
                    (0..=n).map(move |j| {
                        let (x, y) = (f64::from(i) * 0.05, f64::from(j) * 0.05);
                        let ripple = if (i + j) % 2 == 0 { amplitude } else { -amplitude };
                        Vec3::new(x, y, ripple)
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
        };
        let smooth = smoothed_surface(&grid(0.01), 0.25);
        let centre = 20 * 41 + 20;
        assert!(smooth.vertices()[centre].z.abs() < 1e-4);
        assert!(smoothed_surface(&grid(0.0), 0.25).vertices().iter().all(|p| p.z == 0.0));
        // A flat sheet with vertices strewn unevenly stays what it is.
        let uneven = grid(0.0);
        let vertices: Vec<Vec3> = uneven
            .vertices()
            .iter()
            .enumerate()
            .map(|(i, p)| p + Vec3::new(0.015 * (i as f64 * 2.4).sin(), 0.015 * (i as f64 * 3.7).cos(), 0.0))
            .collect();
        let uneven = Mesh::all_observed(vertices, uneven.faces().to_vec()).unwrap();
        let smooth = smoothed_surface(&uneven, 0.25);
        assert!(smooth.vertices().iter().zip(uneven.vertices()).all(|(p, q)| (p - q).norm() < 1e-15));
    }
}
