//! Opening the tube: a seam along a line of constant angle around the axis, from portal to portal.
//!
//! Use it on every tunnel mesh before flattening. Triangles that the line crosses are split, so the seam is straight on
//! the map; vertices very near the line are taken for points of it, so no slivers arise. The seam is the cheapest edge
//! path between the portals, where edges on the line are cheapest and crossing a hole costs its straight width
//! (nothing needs cutting there). A portal may be ragged or have a slit far into the tunnel; leaving through it costs as
//! much as going on along the line to its outermost point, so a slit beside the line is no short cut. Where the surface hides behind itself as seen from the axis, or has steps, the path leaves the
//! line as shortly as it can; how far is reported.
//!
//! Guarantees: the result is a [`Strip`] none of whose borders winds around the axis. Cost: linear, apart from sorting
//! the edges and the path search (E. Dijkstra, Numerische Mathematik 1, 1959, doi:10.1007/BF01386390).

use super::{Error, Strip};
use crate::axis::{Axis, AxisCoordinates};
use crate::mesh::{Mesh, topology};
use crate::numeric::{Vec3, wrap_angle};
use crate::warning::Warning;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::f64::consts::{PI, TAU};

/// Where to cut.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Angle of the seam around the axis in degrees: 0 at the crown, 90 on the right wall, 180 (the default) at the
    /// invert, -90 on the left wall.
    pub seam_angle_deg: f64,
    /// Whether the floor stays on the map: `keep`, or `remove` for crown and walls only (fracture maps).
    pub floor: FloorChoice,
}

/// What happens to the floor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FloorChoice {
    /// It stays.
    #[default]
    Keep,
    /// It is cut away along the feet of the walls.
    Remove,
}

impl Default for Settings {
    fn default() -> Self {
        Self { seam_angle_deg: 180.0, floor: FloorChoice::Keep }
    }
}

/// What cutting did.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Angle of the seam around the axis, degrees.
    pub seam_angle_deg: f64,
    /// Whether the mesh was open from portal to portal already, so that nothing was cut.
    pub already_open: bool,
    /// Length of the cut on the surface, metres.
    pub seam_length_m: f64,
    /// Of that, the length that does not run on the seam line.
    pub off_line_m: f64,
    /// Holes that the seam runs through.
    pub holes_crossed: usize,
    /// Holes left in the strip.
    pub holes_left: usize,
    /// Faces split along the seam line.
    pub split_faces: usize,
    /// Vertices added by splitting and by doubling the seam.
    pub added_vertices: usize,
    /// Vertices without a face, left out.
    pub loose_vertices_dropped: usize,
    /// Whether all faces were reversed, because they did not face the void.
    pub reversed_faces: bool,
    /// Whether one end of the tunnel is closed by a face wall, so that the seam ends inside it.
    pub closed_end: bool,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Crossings closer to a vertex than this share of the edge go through the vertex.
const SNAP: f64 = 0.1;
/// An edge off the line costs at least this many times its length ...
const OFF_LINE_COST: f64 = 2.0;
/// ... and this much more for each metre it is away from the line.
const OFF_LINE_COST_PER_M: f64 = 4.0;

/// Opens a tube along a seam; see the module.
///
/// # Errors
/// [`Error::Portals`] when the mesh is no tube around the axis, [`Error::Setting`], and what [`Strip::from_disk`] finds.
pub fn open(mesh: Mesh, axis: &Axis, settings: &Settings) -> Result<(Strip, Summary), Error> {
    if !settings.seam_angle_deg.is_finite() {
        return Err(Error::Setting { value: settings.seam_angle_deg });
    }
    if mesh.faces().is_empty() {
        return Err(Error::Empty);
    }
    let mut summary = Summary {
        seam_angle_deg: settings.seam_angle_deg,
        already_open: false,
        seam_length_m: 0.0,
        off_line_m: 0.0,
        holes_crossed: 0,
        holes_left: 0,
        split_faces: 0,
        added_vertices: 0,
        loose_vertices_dropped: 0,
        reversed_faces: false,
        closed_end: false,
        warnings: Vec::new(),
    };
    let coordinates: Vec<AxisCoordinates> = mesh.vertices().par_iter().map(|p| axis.project(p)).collect();
    let mesh = face_the_void(mesh, &coordinates, &mut summary)?;
    let loops = topology::boundary_loops(mesh.faces(), mesh.twins());
    let turns: Vec<i64> = loops.iter().map(|l| winding(l, &coordinates)).collect();
    let portals = turns.iter().filter(|&&t| t != 0).count();
    match portals {
        0 if loops.is_empty() => return Err(Error::Closed),
        0 => {
            summary.already_open = true;
            let strip = Strip::from_disk(mesh)?;
            summary.holes_left = strip.hole_loops().len();
            return Ok((strip, summary));
        }
        1 | 2 if turns.iter().all(|t| t.abs() <= 1) => {}
        _ => return Err(Error::Portals { turns: turns.into_iter().filter(|&t| t != 0).collect() }),
    }
    let seam = settings.seam_angle_deg.to_radians();
    let line = Line::of(&mesh, &coordinates, seam);
    let split = split_along(mesh, &line, &mut summary);
    let path = cheapest_seam(&split, &coordinates, &mut summary);
    let before = split.mesh.vertices().len();
    let (mesh, dropped) = cut_along(split.mesh, &path);
    summary.added_vertices += mesh.vertices().len() + dropped - before;
    summary.loose_vertices_dropped = dropped;
    let strip = Strip::from_disk(mesh)?;
    let coordinates: Vec<AxisCoordinates> = strip.mesh().vertices().par_iter().map(|p| axis.project(p)).collect();
    for border in std::iter::once(strip.outer_loop()).chain(strip.hole_loops().iter().map(Vec::as_slice)) {
        let turns = winding(border, &coordinates);
        if turns != 0 && !summary.closed_end {
            return Err(Error::NotOpened { vertex: border[0], turns });
        }
    }
    summary.holes_left = strip.hole_loops().len();
    if summary.off_line_m > 0.05 * summary.seam_length_m && summary.off_line_m > 0.5 {
        summary.warnings.push(Warning::new(
            "seam-leaves-line",
            format!(
                "{:.2} m of the {:.2} m long seam run beside the line at {:.0} degrees, because the surface there is not seen from the axis; choose another seam_angle_deg for a straight border",
                summary.off_line_m, summary.seam_length_m, settings.seam_angle_deg
            ),
        ));
    }
    Ok((strip, summary))
}

/// Whole turns around the axis along a closed loop of vertices.
fn winding(border: &[u32], coordinates: &[AxisCoordinates]) -> i64 {
    let angle = |i: usize| coordinates[border[i % border.len()] as usize].angle();
    let sum: f64 = (0..border.len()).map(|i| wrap_angle(angle(i + 1) - angle(i))).sum();
    (sum / TAU).round() as i64
}

/// Reverses all faces when most of the surface shows its back to the axis.
fn face_the_void(mesh: Mesh, coordinates: &[AxisCoordinates], summary: &mut Summary) -> Result<Mesh, Error> {
    // Counter-clockwise in (chainage, angle) is counter-clockwise seen from inside.
    let facing: f64 = mesh
        .faces()
        .iter()
        .map(|corners| {
            let [a, b, c] = corners.map(|v| &coordinates[v as usize]);
            let angle = a.angle();
            let (u1, u2) = (b.chainage - a.chainage, c.chainage - a.chainage);
            let (v1, v2) = (wrap_angle(b.angle() - angle), wrap_angle(c.angle() - angle));
            u1 * v2 - v1 * u2
        })
        .sum();
    if facing >= 0.0 {
        return Ok(mesh);
    }
    summary.reversed_faces = true;
    summary.warnings.push(Warning::new(
        "faces-reversed",
        "the faces of the mesh showed their back to the tunnel axis; all were reversed, so that the map is seen from inside",
    ));
    Ok(mesh.reversed())
}

/// The seam line on the mesh: the side of each vertex, and where edges are crossed.
struct Line {
    /// -1, 0 (on the line) or 1 for each vertex.
    side: Vec<i8>,
    /// For each half-edge that is to be split, the share of the way from its start.
    crossing: Vec<f64>,
    /// Distance of each vertex from the line around the section, metres.
    away: Vec<f64>,
    /// Chainage of each vertex, metres.
    chainage: Vec<f64>,
}

impl Line {
    fn of(mesh: &Mesh, coordinates: &[AxisCoordinates], seam: f64) -> Self {
        let twin = mesh.twins();
        let from_seam: Vec<f64> = coordinates.iter().map(|c| wrap_angle(c.angle() - seam)).collect();
        let distance = |v: usize| coordinates[v].radius() * from_seam[v].sin();
        let mut side: Vec<i8> = from_seam.iter().map(|&a| if a < 0.0 { -1 } else { 1 }).collect();
        let mut crossing = vec![f64::NAN; twin.len()];
        let mut snapped = Vec::new();
        for (f, corners) in mesh.faces().iter().enumerate() {
            for i in 0..3 {
                let half_edge = 3 * f + i;
                let (a, b) = (corners[i] as usize, corners[(i + 1) % 3] as usize);
                let other = twin[half_edge];
                // Each edge once; crossed on the seam's side of the axis only.
                if (other != topology::NO_TWIN && (other as usize) < half_edge)
                    || side[a] == side[b]
                    || (from_seam[a] - from_seam[b]).abs() >= PI
                {
                    continue;
                }
                let t = distance(a) / (distance(a) - distance(b));
                if t <= SNAP || t.is_nan() {
                    snapped.push(a);
                } else if t > 1.0 - SNAP {
                    snapped.push(b);
                } else {
                    crossing[half_edge] = t;
                    if other != topology::NO_TWIN {
                        crossing[other as usize] = 1.0 - t;
                    }
                }
            }
        }
        for v in snapped {
            side[v] = 0;
        }
        for (f, corners) in mesh.faces().iter().enumerate() {
            for i in 0..3 {
                if side[corners[i] as usize] == 0 || side[corners[(i + 1) % 3] as usize] == 0 {
                    crossing[3 * f + i] = f64::NAN;
                }
            }
        }
        let away = coordinates.iter().zip(&from_seam).map(|(c, a)| c.radius() * a.abs()).collect();
        let chainage = coordinates.iter().map(|c| c.chainage).collect();
        Self { side, crossing, away, chainage }
    }
}

/// A mesh with the seam line among its edges.
struct Split {
    mesh: Mesh,
    /// Whether a vertex lies on the line.
    on_line: Vec<bool>,
    /// Distance of a vertex from the line around the section, metres.
    away: Vec<f64>,
    /// Chainage of a vertex, metres.
    chainage: Vec<f64>,
}

fn split_along(mesh: Mesh, line: &Line, summary: &mut Summary) -> Split {
    let twin = mesh.twins();
    let mut vertices = mesh.vertices().to_vec();
    let mut away = line.away.clone();
    let mut chainage = line.chainage.clone();
    let mut on_line: Vec<bool> = line.side.iter().map(|&s| s == 0).collect();
    let mut middle = vec![u32::MAX; twin.len()];
    for (f, corners) in mesh.faces().iter().enumerate() {
        for i in 0..3 {
            let half_edge = 3 * f + i;
            let t = line.crossing[half_edge];
            if t.is_nan() || middle[half_edge] != u32::MAX {
                continue;
            }
            let (v, w) = (corners[i] as usize, corners[(i + 1) % 3] as usize);
            let id = vertices.len() as u32;
            vertices.push(vertices[v] + (vertices[w] - vertices[v]) * t);
            chainage.push(chainage[v] + (chainage[w] - chainage[v]) * t);
            on_line.push(true);
            away.push(0.0);
            middle[half_edge] = id;
            if twin[half_edge] != topology::NO_TWIN {
                middle[twin[half_edge] as usize] = id;
            }
        }
    }
    let mut faces = Vec::with_capacity(mesh.faces().len() + 2 * (vertices.len() - mesh.vertices().len()));
    let mut observed = Vec::with_capacity(faces.capacity());
    for (f, &corners) in mesh.faces().iter().enumerate() {
        let mid = [middle[3 * f], middle[3 * f + 1], middle[3 * f + 2]];
        let pieces = split_face(corners, mid, &vertices);
        summary.split_faces += usize::from(mid.iter().any(|&m| m != u32::MAX));
        observed.extend(std::iter::repeat_n(mesh.observed()[f], pieces.len()));
        faces.extend(pieces);
    }
    summary.added_vertices += vertices.len() - mesh.vertices().len();
    let mesh = Mesh::new(vertices, faces, observed).expect("splitting edges keeps a manifold");
    Split { mesh, on_line, away, chainage }
}

/// The parts of a face whose edges are split where `mid` (for the edge leaving each corner) names a vertex.
fn split_face(corners: [u32; 3], mid: [u32; 3], vertices: &[Vec3]) -> Vec<[u32; 3]> {
    let split: Vec<usize> = (0..3).filter(|&i| mid[i] != u32::MAX).collect();
    match split[..] {
        [] => vec![corners],
        [i] => {
            let (a, b, c, m) = (corners[i], corners[(i + 1) % 3], corners[(i + 2) % 3], mid[i]);
            vec![[a, m, c], [m, b, c]]
        }
        [i, j] => {
            // The corner between the two split edges is cut off; the rest is a quad with two diagonals.
            let apex = if j == i + 1 { j } else { i };
            let (a, b, c) = (corners[apex], corners[(apex + 1) % 3], corners[(apex + 2) % 3]);
            let (after, before) = (mid[apex], mid[(apex + 2) % 3]);
            let length = |p: u32, q: u32| (vertices[p as usize] - vertices[q as usize]).norm_squared();
            let mut parts = vec![[a, after, before]];
            if length(after, c) <= length(b, before) {
                parts.extend([[after, b, c], [after, c, before]]);
            } else {
                parts.extend([[after, b, before], [b, c, before]]);
            }
            parts
        }
        // A line through the axis crosses a triangle's border at most twice.
        _ => unreachable!("three corners cannot lie on three sides of a line"),
    }
}

/// How the path search came to a vertex.
#[derive(Clone, Copy)]
enum Came {
    Start,
    /// Over this half-edge.
    Edge(u32),
    /// Along the border of a hole from this vertex.
    Hole(u32),
}

/// The half-edges to cut, from the far end back to the first portal.
fn cheapest_seam(split: &Split, coordinates: &[AxisCoordinates], summary: &mut Summary) -> Vec<u32> {
    let faces = split.mesh.faces();
    let count = split.mesh.vertices().len();
    let vertex = |c: u32| faces[(c / 3) as usize][(c % 3) as usize];
    let loops = topology::boundary_loops(faces, split.mesh.twins());
    // Splitting adds vertices without coordinates of their own; the original ones decide the winding.
    let winds = |l: &[u32]| {
        let original: Vec<u32> = l.iter().copied().filter(|&v| (v as usize) < coordinates.len()).collect();
        winding(&original, coordinates) != 0
    };
    let portals: Vec<usize> = (0..loops.len()).filter(|&i| winds(&loops[i])).collect();
    const NO_LOOP: u32 = u32::MAX;
    let mut loop_of = vec![NO_LOOP; count];
    for (i, l) in loops.iter().enumerate() {
        l.iter().for_each(|&v| loop_of[v as usize] = i as u32);
    }
    let start_loop = portals[0];
    let pole = if portals.len() == 1 {
        summary.closed_end = true;
        Some(middle_of_closed_end(&loops[start_loop], coordinates))
    } else {
        None
    };
    // Leaving or entering away from a portal's outermost point costs the way to it, as if the seam went on outside.
    let middle = |l: &[u32]| l.iter().map(|&v| split.chainage[v as usize]).sum::<f64>() / l.len() as f64;
    let start_middle = middle(&loops[start_loop]);
    let end_middle = pole.map_or_else(|| middle(&loops[portals[1]]), |pole| split.chainage[pole as usize]);
    let outermost = |l: &[u32], low: bool| {
        let ends = l.iter().map(|&v| split.chainage[v as usize]);
        if low { ends.fold(f64::INFINITY, f64::min) } else { ends.fold(f64::NEG_INFINITY, f64::max) }
    };
    let start_chainage = outermost(&loops[start_loop], start_middle <= end_middle);
    let end_chainage = portals.get(1).map(|&end| outermost(&loops[end], end_middle < start_middle));
    let detour = |v: u32, portal: f64| (split.chainage[v as usize] - portal).abs() + split.away[v as usize];
    // What is still to be paid at a vertex where the seam may end.
    let leaves = |v: u32| match end_chainage {
        Some(end) => (loop_of[v as usize] == portals[1] as u32).then(|| detour(v, end)),
        None => (Some(v) == pole).then_some(0.0),
    };

    // Inner half-edges leaving each vertex, in compressed rows.
    let mut first = vec![0u32; count + 1];
    let inner = |c: u32| split.mesh.twins()[c as usize] != topology::NO_TWIN;
    let half_edges = || (0..split.mesh.twins().len() as u32).filter(|&c| inner(c));
    half_edges().for_each(|c| first[vertex(c) as usize + 1] += 1);
    for v in 0..count {
        first[v + 1] += first[v];
    }
    let mut leaving = vec![0u32; first[count] as usize];
    let mut fill = first.clone();
    for c in half_edges() {
        let slot = &mut fill[vertex(c) as usize];
        leaving[*slot as usize] = c;
        *slot += 1;
    }

    let length = |c: u32| {
        let ends = [vertex(c), vertex(topology::next(c))].map(|v| split.mesh.vertices()[v as usize]);
        (ends[1] - ends[0]).norm()
    };
    let on_line = |c: u32| split.on_line[vertex(c) as usize] && split.on_line[vertex(topology::next(c)) as usize];
    let cost = |c: u32| {
        if on_line(c) {
            return length(c);
        }
        let away = (split.away[vertex(c) as usize] + split.away[vertex(topology::next(c)) as usize]) / 2.0;
        length(c) * (OFF_LINE_COST + OFF_LINE_COST_PER_M * away)
    };

    let mut distance = vec![f64::INFINITY; count];
    let mut came = vec![Came::Start; count];
    let mut done = vec![false; count];
    let mut entered = vec![false; loops.len()];
    entered[start_loop] = true;
    // Distances are not negative, so their bit patterns order like the numbers.
    let mut heap: BinaryHeap<Reverse<(u64, u32)>> = BinaryHeap::new();
    for &v in &loops[start_loop] {
        distance[v as usize] = detour(v, start_chainage);
        heap.push(Reverse((distance[v as usize].to_bits(), v)));
    }
    let mut end: Option<(f64, u32)> = None;
    while let Some(Reverse((_, v))) = heap.pop() {
        if std::mem::replace(&mut done[v as usize], true) {
            continue;
        }
        let here = distance[v as usize];
        if end.is_some_and(|(least, _)| least <= here) {
            break;
        }
        if let Some(rest) = leaves(v) {
            // A seam that touched the portal and went on would cut off what lies between.
            if end.is_none_or(|(least, _)| here + rest < least) {
                end = Some((here + rest, v));
            }
            continue;
        }
        let hole = loop_of[v as usize];
        if hole != NO_LOOP && !std::mem::replace(&mut entered[hole as usize], true) {
            for &w in &loops[hole as usize] {
                // As dear as a straight seam across: a hole on the line is the shortest way, one beside it no lure.
                let straight = (split.mesh.vertices()[w as usize] - split.mesh.vertices()[v as usize]).norm();
                let there = here + straight;
                if there < distance[w as usize] {
                    distance[w as usize] = there;
                    came[w as usize] = Came::Hole(v);
                    heap.push(Reverse((there.to_bits(), w)));
                }
            }
        }
        for &c in &leaving[first[v as usize] as usize..first[v as usize + 1] as usize] {
            let w = vertex(topology::next(c)) as usize;
            let there = here + cost(c);
            if loop_of[w] != start_loop as u32 && there < distance[w] {
                distance[w] = there;
                came[w] = Came::Edge(c);
                heap.push(Reverse((there.to_bits(), w as u32)));
            }
        }
    }
    let mut path = Vec::new();
    let mut at = end.map(|(_, v)| v);
    while let Some(v) = at {
        at = match came[v as usize] {
            Came::Start => None,
            Came::Edge(c) => {
                path.push(c);
                summary.seam_length_m += length(c);
                summary.off_line_m += if on_line(c) { 0.0 } else { length(c) };
                Some(vertex(c))
            }
            Came::Hole(from) => {
                summary.holes_crossed += 1;
                Some(from)
            }
        };
    }
    path
}

/// The vertex nearest to the axis on the half of the tunnel that lies away from its only portal.
fn middle_of_closed_end(portal: &[u32], coordinates: &[AxisCoordinates]) -> u32 {
    let (low, high) = coordinates
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), c| (low.min(c.chainage), high.max(c.chainage)));
    let original = portal.iter().filter(|&&v| (v as usize) < coordinates.len());
    let (sum, count) = original.fold((0.0, 0.0), |(s, n), &v| (s + coordinates[v as usize].chainage, n + 1.0));
    let far = |c: &AxisCoordinates| (c.chainage - sum / count).abs() > (high - low) / 2.0;
    let candidates = (0..coordinates.len()).filter(|&v| far(&coordinates[v]));
    candidates.min_by(|&a, &b| coordinates[a].radius().total_cmp(&coordinates[b].radius())).unwrap_or(0) as u32
}

/// Opens the mesh along half-edges: each side gets its own copies of the vertices. Vertices without a face are
/// dropped and counted.
fn cut_along(mesh: Mesh, path: &[u32]) -> (Mesh, usize) {
    let mut twin = mesh.twins().to_vec();
    for &c in path {
        let other = twin[c as usize];
        twin[c as usize] = topology::NO_TWIN;
        if other != topology::NO_TWIN {
            twin[other as usize] = topology::NO_TWIN;
        }
    }
    let mut vertices = Vec::with_capacity(mesh.vertices().len() + path.len() + 1);
    let mut faces = vec![[u32::MAX; 3]; mesh.faces().len()];
    // First copies keep the order of the old vertices; further copies of the seam's follow at the end.
    let mut first = vec![u32::MAX; mesh.vertices().len()];
    for &v in mesh.faces().iter().flatten() {
        first[v as usize] = 0;
    }
    for (v, slot) in first.iter_mut().enumerate().filter(|(_, slot)| **slot == 0) {
        *slot = vertices.len() as u32;
        vertices.push(mesh.vertices()[v]);
    }
    let dropped = mesh.vertices().len() - vertices.len();
    let mut taken = vec![false; mesh.vertices().len()];
    for corner in 0..twin.len() as u32 {
        if faces[(corner / 3) as usize][(corner % 3) as usize] != u32::MAX {
            continue;
        }
        let old = mesh.faces()[(corner / 3) as usize][(corner % 3) as usize] as usize;
        let id = if std::mem::replace(&mut taken[old], true) {
            vertices.push(mesh.vertices()[old]);
            vertices.len() as u32 - 1
        } else {
            first[old]
        };
        for c in topology::fan(&twin, corner) {
            faces[(c / 3) as usize][(c % 3) as usize] = id;
        }
    }
    let observed = mesh.observed().to_vec();
    (Mesh::new(vertices, faces, observed).expect("cutting keeps a manifold"), dropped)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A closed tube of `rows` x `columns` quads around a straight axis of 10 m along x; `radius(s, angle)`.
    fn tube(
        rows: u32,
        columns: u32,
        keep: impl Fn(f64, f64) -> bool,
        radius: impl Fn(f64, f64) -> f64,
    ) -> (Mesh, Axis) {
        let axis = Axis::through(&[Vec3::zeros(), Vec3::new(10.0, 0.0, 0.0)], 0.0).unwrap();
        let place = |i: u32, j: u32| {
            let s = 10.0 * f64::from(i) / f64::from(rows);
            (s, wrap_angle(TAU * (f64::from(j) + 0.37 * f64::from(i % 2)) / f64::from(columns)))
        };
        let vertices = (0..=rows)
            .flat_map(|i| (0..columns).map(move |j| (i, j)))
            .map(|(i, j)| {
                let (s, angle) = place(i, j);
                axis.point_at(&AxisCoordinates::from_polar(s, angle, radius(s, angle)))
            })
            .collect();
        let mut faces = Vec::new();
        for i in 0..rows {
            for j in 0..columns {
                let (s, angle) = place(i, j);
                if keep(s, angle) {
                    let (a, d) = (i * columns + j, i * columns + (j + 1) % columns);
                    faces.extend([[a, a + columns, d + columns], [a, d + columns, d]]);
                }
            }
        }
        (Mesh::all_observed(vertices, faces).unwrap(), axis)
    }

    fn smooth(_: f64, _: f64) -> f64 {
        3.0
    }

    fn everywhere(_: f64, _: f64) -> bool {
        true
    }

    #[test]
    fn a_tube_opens_on_a_straight_line_and_keeps_its_area() {
        let (mesh, axis) = tube(40, 61, everywhere, smooth);
        let area = mesh.area();
        for seam_angle_deg in [180.0, 90.0, -35.0, 0.0] {
            let (strip, summary) =
                open(mesh.clone(), &axis, &Settings { seam_angle_deg, ..Settings::default() }).unwrap();
            assert!((strip.mesh().area() - area).abs() < 1e-9);
            assert!(strip.hole_loops().is_empty() && !summary.already_open);
            assert_eq!(summary.off_line_m, 0.0);
            assert!((10.0..10.4).contains(&summary.seam_length_m), "{}", summary.seam_length_m);
            assert!(summary.warnings.is_empty());
        }
    }

    #[test]
    fn the_seam_runs_through_holes_on_the_floor() {
        let hole = |s: f64, angle: f64| !((3.0..7.0).contains(&s) && angle.abs() > 2.2);
        let (mesh, axis) = tube(40, 60, hole, smooth);
        let (strip, summary) = open(mesh, &axis, &Settings::default()).unwrap();
        assert_eq!((summary.holes_crossed, summary.holes_left), (1, 0));
        assert!(summary.seam_length_m < 6.5 && strip.hole_loops().is_empty());
    }

    #[test]
    fn a_slit_that_reaches_far_into_the_tunnel_beside_the_line_is_no_short_cut() {
        // Open along the right foot of the wall over 60 % of the length, out of either portal.
        for from_the_end in [true, false] {
            let slit = |s: f64, angle: f64| {
                let inside = if from_the_end { s > 4.0 } else { s < 6.0 };
                !(inside && (2.3..2.45).contains(&angle))
            };
            let (mesh, axis) = tube(80, 120, slit, smooth);
            let area = mesh.area();
            let (strip, summary) = open(mesh, &axis, &Settings::default()).unwrap();
            assert!((strip.mesh().area() - area).abs() < 1e-9);
            assert_eq!((summary.off_line_m, summary.holes_left), (0.0, 0), "{summary:?}");
            assert!((10.0..10.4).contains(&summary.seam_length_m), "{}", summary.seam_length_m);
        }
    }

    #[test]
    fn a_hole_elsewhere_stays() {
        let hole = |s: f64, angle: f64| !((3.0..7.0).contains(&s) && angle.abs() < 0.3);
        let (mesh, axis) = tube(40, 60, hole, smooth);
        let (strip, summary) = open(mesh, &axis, &Settings::default()).unwrap();
        assert_eq!((summary.holes_crossed, summary.holes_left, strip.hole_loops().len()), (0, 1, 1));
    }

    #[test]
    fn a_missing_floor_needs_no_cut() {
        let (mesh, axis) = tube(40, 60, |_, angle| angle.abs() < 2.5, smooth);
        let (strip, summary) = open(mesh.clone(), &axis, &Settings::default()).unwrap();
        assert!(summary.already_open);
        assert_eq!(strip.mesh().faces(), mesh.faces());
    }

    #[test]
    fn faces_that_look_outwards_are_turned() {
        let (mesh, axis) = tube(20, 30, everywhere, smooth);
        let faces = mesh.faces().iter().map(|&[a, b, c]| [a, c, b]).collect();
        let outwards = Mesh::all_observed(mesh.vertices().to_vec(), faces).unwrap();
        let (_, summary) = open(outwards, &axis, &Settings::default()).unwrap();
        assert!(summary.reversed_faces && summary.warnings.iter().any(|w| w.code == "faces-reversed"));
    }

    #[test]
    fn a_rough_tube_opens_and_says_how_far_it_leaves_the_line() {
        let rough =
            |s: f64, angle: f64| 3.0 + 0.4 * (5.0 * s).sin() * (9.0 * angle).cos() + 0.2 * (31.0 * angle + s).sin();
        let (mesh, axis) = tube(80, 120, everywhere, rough);
        let (strip, summary) = open(mesh, &axis, &Settings::default()).unwrap();
        assert!(strip.hole_loops().is_empty());
        assert!(summary.off_line_m < 0.1 * summary.seam_length_m, "{summary:?}");
    }

    #[test]
    fn a_tunnel_with_a_face_wall_is_cut_into_its_middle() {
        let (tube, axis) = tube(20, 30, everywhere, smooth);
        let mut vertices = tube.vertices().to_vec();
        let mut faces = tube.faces().to_vec();
        let pole = vertices.len() as u32;
        vertices.push(Vec3::new(10.0, 0.01, 0.0));
        let ring = 20 * 30;
        faces.extend((0..30u32).map(|j| [ring + j, pole, ring + (j + 1) % 30]));
        let mesh = Mesh::all_observed(vertices, faces).unwrap();
        let (strip, summary) = open(mesh, &axis, &Settings::default()).unwrap();
        assert!(summary.closed_end && strip.hole_loops().is_empty());
        assert!(summary.seam_length_m > 12.0);
    }

    #[test]
    fn a_mesh_beside_the_axis_counts_as_open_and_a_sphere_is_refused() {
        let v = vec![Vec3::zeros(), Vec3::x(), Vec3::y(), Vec3::z()];
        let sphere = Mesh::all_observed(v, vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]).unwrap();
        let axis = Axis::through(&[Vec3::new(0.1, 0.1, -5.0), Vec3::new(0.1, 0.1, 5.0)], 0.0).unwrap();
        assert_eq!(open(sphere, &axis, &Settings::default()).unwrap_err(), Error::Closed);
    }
}
