//! The *section* method: the surface as one depth for each cell of a grid unrolled around the mean section.
//!
//! Use it for everything that is star-shaped around its axis up to small overhangs: drifts, rail and road tunnels, sewers,
//! shafts. It needs no solve, runs in linear time and cannot fold over. Caves and junctions, where a ray from the axis
//! meets the surface more than once, lose what lies behind the first surface; [`Summary::multiple_depth_percent`] tells.
//!
//! Method. The points are sorted into cells of (chainage, girth). In each cell the dominant cluster of depths is chosen,
//! with a preference for the one that continues its neighbours; cells that nothing around them agrees with are dropped.
//! A plane is fitted to the cluster and its neighbours by weighted least squares with a robust second round (moving least
//! squares, D. Levin, "The approximation power of moving least-squares", Math. Comp. 67, 1998,
//! doi:10.1090/S0025-5718-98-00974-0), and evaluated at the cluster's centroid. Cells without points but within
//! `max_gap_m` of one are bridged, gaps narrower than `fill_hole_m` (a morphological closing) are filled; both get their
//! depth from a thin plate through the neighbours. Observed is what has a point within reach in space as well, all else is
//! marked as filled. Over a side opening that is to be
//! closed, lines along the tunnel run straight from the wall before it to the wall after it. Four neighbouring cells make two
//! triangles.
//!
//! | symbol | meaning |
//! |---|---|
//! | `h` | column width of the grid, the target spacing |
//! | `d` | depth: distance from the axis minus mean radius, positive into the rock |
//!
//! Guarantees: oriented manifold, faces counter-clockwise in (chainage, girth), no face wider than the cells it spans,
//! same bytes on any number of threads. Cost: linear in points and cells; 60 bytes a point and 90 a cell.

mod clusters;
mod fit;
mod support;
mod fill_depths;
mod points_near;
mod triangulate;

use super::Mesh;
use super::openings::SideOpenings;
use super::repair;
use super::wall_line::WallLine;
use crate::axis::Axis;
use crate::numeric::Vec3;
use crate::segment::unrolled_grid::{CellPoints, Grid, GridPoint};
use crate::segment::{Class, SectionField, Segmentation};
use clusters::{Cluster, choose_clusters, drop_bumps, drop_isolated};
use fill_depths::fill_depths;
use fit::fit_places;
use points_near::PointsNear;
use rayon::prelude::*;
use serde::Serialize;
use std::sync::atomic::{AtomicUsize, Ordering};
use support::{Node, support};
use triangulate::triangulate;

/// Default spacing in units of the distance between points: about 1.5 points a cell.
const SPACING_IN_POINT_DISTANCES: f64 = 1.2;
/// Points farther apart than `max_gap_m` speak for the surface this far around, in cells of the default spacing.
const SPARSE_REACH: f64 = 1.5;
/// Default spacing is not finer than this share of the perimeter (4.4 cm in a rail tunnel).
const FINEST_SHARE_OF_PERIMETER: f64 = 1.0 / 600.0;
/// Longest side ratio of the cells of a profile scan.
const MAX_CELL_ASPECT: f64 = 4.0;
/// A profile scan tells less along the axis, so its cells are wider: this share of the perimeter.
const FINEST_SHARE_OF_PROFILE: f64 = 1.0 / 400.0;
/// Steepest slope of the depth, metres a metre, that still counts as the same surface.
const MAX_SLOPE: f64 = 2.5;
/// Scatter of points around the surface that is always allowed, metres.
const NOISE_ALLOWANCE_M: f64 = 0.012;

/// What the method was asked for; a copy of the keys in [`super::reconstruct::Settings`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Options {
    pub spacing_m: Option<f64>,
    pub max_gap_m: f64,
    pub fill_hole_m: f64,
    pub fill_behind_furniture_m: f64,
    pub side_openings: SideOpenings,
}

/// What was done, for the report.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Summary {
    /// Width of the cells around the section, metres.
    pub spacing_m: f64,
    /// Length of the cells along the axis, metres (longer for profile scans).
    pub spacing_along_m: f64,
    /// Points of the tunnel's surface that were used.
    pub points_used: usize,
    /// Cells with points.
    pub cells_with_points: usize,
    /// Cells dropped because nothing around them agrees with their depth.
    pub isolated_cells_dropped: usize,
    /// Cells of few points dropped because they stick out of the surface around them.
    pub bumps_dropped: usize,
    /// Share of cells with points at two or more clearly different depths, percent.
    pub multiple_depth_percent: f64,
    /// How far from a point surface counts as observed, metres: `max_gap_m`, or more where the points themselves lie farther
    /// apart. `None` for profile scans, whose profiles are bridged.
    pub reach_m: Option<f64>,
    /// Cells without points that lie within reach of one on the grid.
    pub cells_bridged: usize,
    /// Faces between cells with points and such cells that are beyond reach all the same, in space: marked as filled.
    pub faces_beyond_points: usize,
    /// Cells in holes narrower than `fill_hole_m` that were filled.
    pub cells_filled: usize,
    /// Cells of side openings that were closed.
    pub cells_closed: usize,
    /// Vertices split because two parts of the surface touched in a point.
    pub vertices_split: usize,
    /// Components smaller than the largest that were dropped.
    pub components_dropped: usize,
    /// Faces of those components.
    pub faces_dropped: usize,
}

/// Builds the surface; see the module's header. `None` when no cell is left.
pub(super) fn reconstruct(
    segmentation: &Segmentation,
    axis: &Axis,
    options: &Options,
) -> Option<(Mesh, Summary, WallLine)> {
    let (section, coordinates) = (&segmentation.section, &segmentation.coordinates);
    let (grid, reach) = choose_grid(segmentation, options);
    let used = coordinates.par_iter().zip(&segmentation.class);
    let (cells, _) =
        CellPoints::sort(&grid, used.map(|(c, class)| class.is_surface().then(|| grid.unroll(section, c))));
    let mut summary = Summary {
        spacing_m: grid.column_m,
        spacing_along_m: grid.row_m,
        reach_m: Some(reach.in_space_m).filter(|m| m.is_finite()),
        points_used: cells.len(),
        ..Summary::default()
    };
    let clusters = choose_clusters(&grid, &cells, &mut summary);
    let clusters = drop_isolated(&grid, clusters, &mut summary);
    let mut places = fit_places(&grid, &cells, &clusters);
    let clusters = drop_bumps(&grid, clusters, &places, &mut summary);
    let depth: Vec<f64> =
        clusters.iter().zip(&places).map(|(c, p)| if c.count > 0 { p.depth } else { f64::NAN }).collect();
    let line = WallLine::of(grid, depth, segmentation, axis);
    let (grid, open) = (line.grid(), line.open());
    let clusters = cut_openings(&line, section, clusters, &mut places, options.side_openings);
    let mut furniture = vec![false; grid.len()];
    for (c, _) in coordinates.iter().zip(&segmentation.class).filter(|(_, k)| **k == Class::Furniture) {
        if let Some(cell) = grid.cell_at(&grid.unroll(section, c)) {
            furniture[cell] = true;
        }
    }
    let state = support(grid, &clusters, &mut places, [&furniture, open], reach, options, &mut summary);
    fill_depths(grid, &state, &mut places);
    let space = in_space(grid, &state, &places, |p| grid.lift(section, axis, p));
    let (mut vertices, faces, observed) = if segmentation.sampling.is_profiles() {
        // Between profiles whole rows have no points of their own.
        triangulate(grid, &state, &places, &space, |_| true)
    } else {
        let points = PointsNear::new(grid, &cells, &clusters, reach.in_space_m, |i| axis.point_at(&coordinates[i]));
        let to_points = points.distances(&state, &space);
        let beyond = AtomicUsize::new(0);
        let surface = triangulate(grid, &state, &places, &space, |nodes| {
            let near = points.support(nodes, &space, &to_points);
            beyond.fetch_add(usize::from(!near), Ordering::Relaxed);
            near
        });
        summary.faces_beyond_points = beyond.into_inner();
        surface
    };
    drop((cells, space));
    let (mut faces, observed) = repair::trim_dangling(faces, observed);
    summary.vertices_split = repair::split_fans(&mut vertices, &mut faces);
    let kept = repair::keep_largest(vertices, faces, observed);
    summary.components_dropped = kept.components_dropped;
    summary.faces_dropped = kept.faces_dropped;
    let mesh = Mesh::new(kept.vertices, kept.faces, kept.observed)
        .expect("a triangulated grid with split fans is an oriented manifold");
    (!mesh.faces().is_empty()).then_some((mesh, summary, line))
}

/// The present nodes in local metres; the others are at the origin.
fn in_space(grid: &Grid, state: &[Node], places: &[GridPoint], lift: impl Fn(&GridPoint) -> Vec3 + Sync) -> Vec<Vec3> {
    let node = |n: usize| if state[n] == Node::Absent { Vec3::zeros() } else { lift(&places[n]) };
    (0..grid.len()).into_par_iter().map(node).collect()
}

/// How far points speak for the surface, metres.
#[derive(Clone, Copy, Debug)]
struct Reach {
    /// On the grid, along the axis.
    along_m: f64,
    /// In space; without limit in scans of profiles, between which whole rows of cells have no points.
    in_space_m: f64,
}

/// The grid and the reach of a point.
fn choose_grid(segmentation: &Segmentation, options: &Options) -> (Grid, Reach) {
    let (section, sampling) = (&segmentation.section, &segmentation.sampling);
    let area = section.mean_perimeter() * (section.end() - section.start());
    let count = segmentation.class.iter().filter(|c| c.is_surface()).count().max(1);
    let even = (area / count as f64).sqrt();
    let gap_m = options.max_gap_m;
    let column_m = options.spacing_m.unwrap_or_else(|| {
        let wanted = if sampling.is_profiles() { sampling.around_m } else { even } * SPACING_IN_POINT_DISTANCES;
        let finest = if sampling.is_profiles() { FINEST_SHARE_OF_PROFILE } else { FINEST_SHARE_OF_PERIMETER };
        wanted.max(section.mean_perimeter() * finest)
    });
    if !sampling.is_profiles() {
        let apart_m = even * SPACING_IN_POINT_DISTANCES;
        let in_space_m = if apart_m > gap_m { SPARSE_REACH * apart_m } else { gap_m };
        let reach = Reach { along_m: gap_m.max(SPARSE_REACH * column_m), in_space_m };
        return (Grid::new(section, column_m, column_m), reach);
    }
    // Whole rows between the profiles, as many as keep the cells from getting too long.
    let between = (sampling.along_m / (MAX_CELL_ASPECT * column_m)).ceil().max(1.0);
    let row_m = (sampling.along_m / between).max(column_m);
    let along_m = gap_m.max(0.8 * sampling.along_m);
    (Grid::new(section, row_m, column_m), Reach { along_m, in_space_m: f64::INFINITY })
}

/// Finds the side openings without building the surface.
pub(super) fn wall_line(segmentation: &Segmentation, axis: &Axis, options: &Options) -> WallLine {
    let (grid, _) = choose_grid(segmentation, options);
    let used = segmentation.coordinates.par_iter().zip(&segmentation.class);
    let section = &segmentation.section;
    let (cells, _) =
        CellPoints::sort(&grid, used.map(|(c, class)| class.is_surface().then(|| grid.unroll(section, c))));
    let clusters = choose_clusters(&grid, &cells, &mut Summary::default());
    let depth: Vec<f64> = clusters.iter().map(|c| if c.count > 0 { c.middle } else { f64::NAN }).collect();
    WallLine::of(grid, depth, segmentation, axis)
}

/// Empties the cells of side openings, unless these are to be kept; their places are those of the wall line where it is to be continued.
fn cut_openings(
    line: &WallLine,
    section: &SectionField,
    mut clusters: Vec<Cluster>,
    places: &mut [GridPoint],
    what: SideOpenings,
) -> Vec<Cluster> {
    let (grid, open) = (line.grid(), line.open());
    let depth = match what {
        SideOpenings::Keep => return clusters,
        SideOpenings::Hole => vec![0.0; grid.len()],
        SideOpenings::Close => line.continued(section),
    };
    for cell in (0..grid.len()).filter(|&c| open[c]) {
        clusters[cell] = Cluster::default();
        places[cell] = grid.middle(cell, depth[cell]);
    }
    clusters
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::topology;
    use crate::segment::{self, classify_positions};
    use rand::{Rng, SeedableRng};
    use std::f64::consts::{PI, TAU};

    const RADIUS: f64 = 2.0;
    const LENGTH: f64 = 8.0;

    fn straight() -> Axis {
        Axis::through(&[Vec3::zeros(), Vec3::new(LENGTH, 0.0, 0.0)], 0.0).unwrap()
    }

    /// Even deterministic points on a tube of radius `r(chainage, angle)` around the x axis.
    fn tube(count: u32, r: impl Fn(f64, f64) -> f64) -> Vec<Vec3> {
        (0..count)
            .map(|i| {
                let s = LENGTH * (f64::from(i) * 0.618_033_988_749_895).fract();
                let a = TAU * (f64::from(i) * 0.754_877_666_246_693).fract() - PI;
                Vec3::new(s, -r(s, a) * a.sin(), r(s, a) * a.cos())
            })
            .collect()
    }

    fn mesh_of(points: &[Vec3], options: &Options) -> (Mesh, Summary) {
        let axis = straight();
        let (segmentation, _) = classify_positions(points, &axis, &segment::Settings::default()).unwrap();
        let (mesh, summary, _) = reconstruct(&segmentation, &axis, options).unwrap();
        (mesh, summary)
    }

    fn loops(mesh: &Mesh) -> usize {
        topology::boundary_loops(mesh.faces(), mesh.twins()).len()
    }

    const OPTIONS: Options = Options {
        spacing_m: Some(0.05),
        max_gap_m: 0.05,
        fill_hole_m: 0.2,
        fill_behind_furniture_m: 0.0,
        side_openings: SideOpenings::Hole,
    };

    #[test]
    fn a_tube_becomes_a_tube_that_faces_inwards() {
        let (mesh, summary) = mesh_of(&tube(120_000, |_, _| RADIUS), &OPTIONS);
        assert_eq!((loops(&mesh), summary.isolated_cells_dropped), (2, 0));
        assert!((mesh.area() - TAU * RADIUS * LENGTH).abs() < 0.02 * TAU * RADIUS * LENGTH);
        for v in mesh.vertices() {
            assert!((v.y.hypot(v.z) - RADIUS).abs() < 1e-3);
        }
        for f in 0..mesh.faces().len() as u32 {
            let [a, b, c] = mesh.corners(f);
            let inwards = -Vec3::new(0.0, (a + b + c).y, (a + b + c).z);
            assert!(mesh.double_area_vector(f).dot(&inwards) > 0.0);
        }
    }

    #[test]
    fn the_grid_is_nearly_the_delaunay_triangulation_of_its_vertices() {
        use spade::{DelaunayTriangulation, Point2, Triangulation};
        let (mesh, _) = mesh_of(&tube(120_000, |_, _| RADIUS), &OPTIONS);
        let plane: Vec<Point2<f64>> =
            mesh.vertices().iter().map(|v| Point2::new(v.x, RADIUS * (-v.y).atan2(v.z))).collect();
        // Away from the portals and from the invert, where the plane has a border and the tube has none.
        let inner = |v: u32| {
            let p = plane[v as usize];
            p.y.abs() < 0.9 * PI * RADIUS && (0.3..LENGTH - 0.3).contains(&p.x)
        };
        let delaunay = DelaunayTriangulation::<Point2<f64>>::bulk_load_stable(plane.clone()).unwrap();
        let mut expected: Vec<[u32; 2]> = delaunay
            .undirected_edges()
            .map(|e| {
                let [a, b] = e.vertices().map(|v| v.fix().index() as u32);
                [a.min(b), a.max(b)]
            })
            .collect();
        expected.sort_unstable();
        let edges: Vec<[u32; 2]> = mesh
            .faces()
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .filter(|&[a, b]| a < b && inner(a) && inner(b))
            .collect();
        let same = edges.iter().filter(|e| expected.binary_search(e).is_ok()).count();
        let share = same as f64 / edges.len() as f64;
        assert!(edges.len() > 20_000 && share > 0.95, "{share} of {}", edges.len());
    }

    #[test]
    fn noise_is_averaged_and_outliers_leave_no_spike() {
        let mut points = tube(240_000, |s, a| RADIUS + 0.03 * (3.0 * a).cos() * s.sin());
        let truth = |v: &Vec3| RADIUS + 0.03 * (3.0 * (-v.y).atan2(v.z)).cos() * v.x.sin();
        // Triangular noise of 3 mm standard deviation along the ray; one point in 300 up to 1 m too close.
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        for p in points.iter_mut() {
            let shift = if random() < 1.0 / 300.0 { -random() } else { 0.003 * 6f64.sqrt() * (random() - random()) };
            let r = p.y.hypot(p.z);
            p.y *= (r + shift) / r;
            p.z *= (r + shift) / r;
        }
        let (mesh, _) = mesh_of(&points, &OPTIONS);
        let errors: Vec<f64> = mesh.vertices().iter().map(|v| v.y.hypot(v.z) - truth(v)).collect();
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        let worst = errors.iter().fold(0.0, |w: f64, e| w.max(e.abs()));
        assert!(rms < 0.0015 && worst < 0.02, "rms {rms}, worst {worst}");
        assert_eq!(loops(&mesh), 2);
    }

    #[test]
    fn a_small_hole_is_filled_and_marked_a_large_one_stays() {
        let mut points = tube(120_000, |_, _| RADIUS);
        // A hole 0.15 m wide on the right wall and one 0.8 m wide on the left.
        points.retain(|p| {
            let girth = RADIUS * (-p.y).atan2(p.z);
            (p.x - 3.0).hypot(girth - 3.0) > 0.075 && (p.x - 5.0).hypot(girth + 3.0) > 0.4
        });
        let (mesh, summary) = mesh_of(&points, &OPTIONS);
        assert_eq!(loops(&mesh), 3);
        assert!(summary.cells_filled > 0);
        for f in 0..mesh.faces().len() {
            let [a, b, c] = mesh.corners(f as u32);
            let m = (a + b + c) / 3.0;
            let girth = RADIUS * (-m.y).atan2(m.z);
            if (m.x - 3.0).hypot(girth - 3.0) < 0.03 {
                assert!(!mesh.observed()[f] && (m.y.hypot(m.z) - RADIUS).abs() < 0.01);
            }
            assert!((m.x - 5.0).hypot(girth + 3.0) > 0.3, "the large hole was filled");
        }
    }

    #[test]
    fn observed_surface_has_a_point_within_reach_in_space() {
        // On the grid a step of 11 cm is one cell wide, in space its middle is more than 5 cm from everything seen.
        let points = tube(120_000, |s, _| RADIUS + if s > 4.01 { 0.11 } else { 0.0 });
        let (mesh, summary) = mesh_of(&points, &Options { fill_hole_m: 0.0, ..OPTIONS });
        let tree = crate::spatial::KdTree::new(&points);
        let far = |p: &Vec3| tree.nearest(p).unwrap().distance_squared.sqrt();
        let mut on_the_step = 0;
        for f in 0..mesh.faces().len() {
            let [a, b, c] = mesh.corners(f as u32);
            let middle = (a + b + c) / 3.0;
            on_the_step += usize::from((3.9..4.1).contains(&middle.x) && !mesh.observed()[f]);
            if mesh.observed()[f] {
                let farthest = [a, b, c, middle].iter().map(far).fold(0.0, f64::max);
                assert!(farthest < 0.05 + 1e-6, "face {f} at {middle}: {farthest}");
            }
        }
        assert!(on_the_step > 100 && summary.faces_beyond_points >= on_the_step, "{on_the_step}");
        assert_eq!(loops(&mesh), 2);
    }

    #[test]
    fn sparse_points_keep_their_reach_and_say_so() {
        // 4 cm apart by chance: two cells of 5 cm in ten have no point.
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(11);
        let points: Vec<Vec3> = (0..62_000)
            .map(|_| {
                let (s, a) = (random.random_range(0.0..LENGTH), random.random_range(0.0..TAU));
                Vec3::new(s, RADIUS * a.sin(), RADIUS * a.cos())
            })
            .collect();
        let (mesh, summary) = mesh_of(&points, &Options { fill_hole_m: 0.0, ..OPTIONS });
        let filled = mesh.observed().iter().filter(|o| !**o).count();
        // 1851 if bridged nodes beyond the reach did not lean towards the points.
        assert!((100..1000).contains(&filled), "{filled} of {}", mesh.faces().len());
        assert_eq!(summary.reach_m, Some(0.05));
        let points = tube(10_000, |_, _| RADIUS);
        let (_, summary) = mesh_of(&points, &Options { spacing_m: None, ..OPTIONS });
        assert!((summary.reach_m.unwrap() - 0.18).abs() < 0.01, "{:?}", summary.reach_m);
    }

    #[test]
    fn profiles_half_a_metre_apart_make_one_observed_surface() {
        let points: Vec<Vec3> = (0..17)
            .flat_map(|i| {
                (0..1500).map(move |k| {
                    let a = TAU * (f64::from(k) + 0.1 * f64::from(i % 3)) / 1500.0 - PI;
                    Vec3::new(f64::from(i) * 0.5, -RADIUS * a.sin(), RADIUS * a.cos())
                })
            })
            .collect();
        let (mesh, summary) = mesh_of(&points, &Options { spacing_m: None, ..OPTIONS });
        assert_eq!((loops(&mesh), summary.cells_filled), (2, 0));
        assert!(mesh.observed().iter().all(|&o| o) && summary.spacing_along_m > 2.0 * summary.spacing_m);
        assert!(mesh.vertices().iter().all(|v| (v.y.hypot(v.z) - RADIUS).abs() < 2e-3));
    }

    #[test]
    fn the_mesh_is_the_same_on_one_thread_and_on_many() {
        let points = tube(40_000, |s, a| RADIUS + 0.1 * (s + 2.0 * a).sin());
        let many = mesh_of(&points, &OPTIONS).0;
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(pool.install(|| mesh_of(&points, &OPTIONS).0), many);
    }
}
