//! The curves in which a plane cuts the surface, exact: straight on each face, in 3D and on the map at once.
//!
//! Each vertex has a signed distance from the plane; an edge whose ends lie on different sides is cut at the place where
//! the distance is zero. Zero counts as above, so a vertex in the plane needs no special case. The cuts of a face are
//! joined, and the pieces followed from face to face. Cost: linear in the faces.

use crate::mesh::topology;
use crate::numeric::{Vec2, Vec3};
use crate::unwrap::Chart;
use std::collections::BTreeMap;

/// A curve, the same vertices in both spaces.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Curve {
    /// On the map.
    pub on_map: Vec<Vec2>,
    /// On the surface, local metres.
    pub in_local: Vec<Vec3>,
    /// Whether all of it lies on observed faces.
    pub observed: bool,
}

/// The curves of the plane `normal . x = offset`, within `radius_m` of `centre` (infinite for a through-going plane).
///
/// A curve ends at the border of the surface, and where the plane ends.
pub fn curves(chart: &Chart, normal: &Vec3, through: &Vec3, radius_m: f64) -> Vec<Curve> {
    let mesh = chart.strip().mesh();
    let twin = mesh.twins();
    let distance: Vec<f64> = mesh.vertices().iter().map(|p| normal.dot(&(p - through))).collect();
    let from = |c: u32| mesh.faces()[(c / 3) as usize][(c % 3) as usize];
    // A half-edge and its twin are one edge.
    let edge_of = |c: u32| if twin[c as usize] == topology::NO_TWIN { c } else { c.min(twin[c as usize]) };
    // Each cut face joins two edges.
    let mut faces_of_edge: BTreeMap<u32, [Option<u32>; 2]> = BTreeMap::new();
    let mut cuts: BTreeMap<u32, [u32; 2]> = BTreeMap::new();
    for face in 0..mesh.faces().len() as u32 {
        let cut: Vec<u32> = (3 * face..3 * face + 3)
            .filter(|&c| (distance[from(c) as usize] >= 0.0) != (distance[from(topology::next(c)) as usize] >= 0.0))
            .map(edge_of)
            .collect();
        if let [a, b] = cut[..] {
            cuts.insert(face, [a, b]);
            for e in [a, b] {
                let faces = faces_of_edge.entry(e).or_default();
                faces[usize::from(faces[0].is_some())] = Some(face);
            }
        }
    }
    let place = |edge: u32| {
        let (a, b) = (from(edge) as usize, from(topology::next(edge)) as usize);
        // From the lower vertex, so that both faces compute the same place.
        let (a, b) = (a.min(b), a.max(b));
        let t = distance[a] / (distance[a] - distance[b]);
        let lerp3 = mesh.vertices()[a] + (mesh.vertices()[b] - mesh.vertices()[a]) * t;
        (chart.uv()[a] + (chart.uv()[b] - chart.uv()[a]) * t, lerp3)
    };
    let mut used: BTreeMap<u32, bool> = cuts.keys().map(|&f| (f, false)).collect();
    let mut found = Vec::new();
    // Open curves begin at edges with one cut face, closed ones anywhere.
    let ends: Vec<u32> = faces_of_edge.iter().filter(|(_, f)| f[1].is_none()).map(|(&e, _)| e).collect();
    let starts = ends.into_iter().chain(cuts.values().map(|c| c[0]).collect::<Vec<_>>());
    for start in starts {
        let mut edge = start;
        let mut curve: Vec<(Vec2, Vec3, bool)> = Vec::new();
        while let Some(face) = faces_of_edge[&edge].iter().flatten().copied().find(|f| !used[f]) {
            used.insert(face, true);
            let [a, b] = cuts[&face];
            let next = if a == edge { b } else { a };
            let observed = mesh.observed()[face as usize];
            if curve.is_empty() {
                let (uv, p) = place(edge);
                curve.push((uv, p, observed));
            }
            let (uv, p) = place(next);
            curve.push((uv, p, observed));
            edge = next;
        }
        found.extend(within(&curve, through, radius_m));
    }
    found
}

/// The parts of a curve within a ball.
fn within(curve: &[(Vec2, Vec3, bool)], centre: &Vec3, radius: f64) -> Vec<Curve> {
    let mut parts: Vec<Curve> = Vec::new();
    let mut open = false;
    for pair in curve.windows(2) {
        let ((uv_a, a, _), (uv_b, b, observed)) = (pair[0], pair[1]);
        let range = if radius.is_finite() { inside_ball(&(a - centre), &(b - a), radius) } else { Some((0.0, 1.0)) };
        let Some((low, high)) = range else {
            open = false;
            continue;
        };
        let at = |t: f64| (uv_a + (uv_b - uv_a) * t, a + (b - a) * t);
        if !open || low > 0.0 {
            let (uv, p) = at(low);
            parts.push(Curve { on_map: vec![uv], in_local: vec![p], observed: true });
        }
        let part = parts.last_mut().expect("a part is open");
        let (uv, p) = at(high);
        if (p - part.in_local[part.in_local.len() - 1]).norm() > 1e-12 {
            part.on_map.push(uv);
            part.in_local.push(p);
        }
        part.observed &= observed;
        open = high == 1.0;
    }
    parts.retain(|p| p.in_local.len() > 1);
    parts
}

/// Where the segment `from + t d`, t in 0 to 1, lies within a radius of the origin.
fn inside_ball(from: &Vec3, d: &Vec3, radius: f64) -> Option<(f64, f64)> {
    let (a, b, c) = (d.norm_squared(), from.dot(d), from.norm_squared() - radius * radius);
    if a == 0.0 {
        return (c <= 0.0).then_some((0.0, 1.0));
    }
    let root = (b * b - a * c).max(0.0).sqrt();
    if b * b - a * c <= 0.0 {
        return None;
    }
    let (low, high) = (((-b - root) / a).max(0.0), ((-b + root) / a).min(1.0));
    (high > low).then_some((low, high))
}

#[cfg(test)]
mod tests {
    use super::super::normal_of;
    use super::*;
    use crate::map::example::{bent_chart, flat_chart};

    #[test]
    fn a_plane_cuts_a_half_cylinder_in_its_sine() {
        // A cylinder of radius 2 m along x, opened: girth v = 2 a.
        let chart = bent_chart(10.0, 6.0, 101, 121, |u, v| Vec3::new(u, 2.0 * (v / 2.0).cos(), 2.0 * (v / 2.0).sin()));
        let normal = normal_of(65.0, 70.0);
        let through = Vec3::new(5.0, 0.5, 0.8);
        let found = curves(&chart, &normal, &through, f64::INFINITY);
        assert_eq!(found.len(), 1);
        let curve = &found[0];
        assert!(curve.observed && curve.on_map.len() > 121);
        let worst = curve.in_local.iter().map(|p| normal.dot(&(p - through)).abs()).fold(0.0, f64::max);
        assert!(worst < 1e-12, "{worst}");
        for p in &curve.on_map {
            let (y, z) = (2.0 * (p.y / 2.0).cos(), 2.0 * (p.y / 2.0).sin());
            let u = through.x - (normal.y * (y - through.y) + normal.z * (z - through.z)) / normal.x;
            assert!((u - p.x).abs() < 2e-3, "{u} {}", p.x);
        }
    }

    #[test]
    fn planes_with_an_end_have_shorter_traces() {
        let chart = flat_chart(4.0, 2.0, 41, 21);
        let through = Vec3::new(2.0, 1.0, 0.0);
        let all = curves(&chart, &Vec3::x(), &through, f64::INFINITY);
        let part = curves(&chart, &Vec3::x(), &through, 0.37);
        let length =
            |c: &[Curve]| -> f64 { c.iter().flat_map(|c| c.in_local.windows(2)).map(|w| (w[1] - w[0]).norm()).sum() };
        assert!((length(&all) - 2.0).abs() < 1e-12 && (length(&part) - 0.74).abs() < 1e-12);
        assert!(curves(&chart, &Vec3::x(), &Vec3::new(9.0, 0.0, 0.0), f64::INFINITY).is_empty());
    }
}
