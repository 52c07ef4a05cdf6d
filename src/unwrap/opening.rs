//! Opening a tunnel like a book, for the deformation methods: axial straightening in closed form, handles on a lattice of
//! the section chart, and where each handle is when the tunnel is opened by a share `t`.
//!
//! Straightened space is (chainage, right, down): right-handed, and its plane `down = 0` seen along the third axis is the
//! map seen from inside. At `t = 0` the handles of a section lie on the straightened surface, at `t = 1` on the map; in
//! between every chord of the section keeps its place in the chain and its length (blended from chord to girth) while its
//! direction turns from its own angle to that of the crown.

use super::guide::Guide;
use crate::numeric::{Vec2, Vec3, wrap_angle};

/// Vertices positions in straightened space: the bend is taken out, the section stays as it is.
pub(super) fn straightened(guide: &Guide) -> Vec<Vec3> {
    guide.coordinates().iter().map(|c| Vec3::new(c.chainage, c.right, -c.up)).collect()
}

/// Vertices near the nodes of a regular lattice of the section chart, row by row along the tunnel, from left to right.
pub(super) struct Handles {
    rows: Vec<Vec<u32>>,
}

impl Handles {
    /// One vertex a lattice node, the nearest within half a spacing each way; nodes without one (holes) are left out.
    pub fn on_lattice(guide: &Guide, used: &[bool], spacing_m: f64) -> Self {
        let uv = guide.uv();
        let low = bound(uv, used, f64::min);
        let high = bound(uv, used, f64::max);
        let cells = (high - low).map(|d| (d / spacing_m).round().max(1.0));
        let step = (high - low).component_div(&cells);
        let (rows, columns) = (cells.x as usize + 1, cells.y as usize + 1);
        let mut nearest: Vec<Option<(f64, u32)>> = vec![None; rows * columns];
        for (v, p) in uv.iter().enumerate().filter(|(v, _)| used[*v]) {
            let at = (p - low).component_div(&step.map(|s| s.max(f64::MIN_POSITIVE)));
            let node = at.map(f64::round);
            let cell = (node.x as usize).min(rows - 1) * columns + (node.y as usize).min(columns - 1);
            let distance = (at - node).component_mul(&step).norm_squared();
            if nearest[cell].is_none_or(|(d, _)| distance < d) {
                nearest[cell] = Some((distance, v as u32));
            }
        }
        let rows = nearest.chunks(columns).map(|row| row.iter().flatten().map(|&(_, v)| v).collect()).collect();
        Self { rows }
    }

    /// All handles.
    pub fn vertices(&self) -> impl Iterator<Item = u32> + '_ {
        self.rows.iter().flatten().copied()
    }

    /// Where the handles are when the tunnel is opened by `t` (0 closed, 1 flat), in the order of [`Handles::vertices`];
    /// flat they lie at their place in the section chart plus the displacement, if one is given.
    pub fn opened(&self, guide: &Guide, straight: &[Vec3], displacement: Option<&[Vec2]>, t: f64) -> Vec<Vec3> {
        let mut places = Vec::new();
        for row in &self.rows {
            let section: Vec<Vec2> =
                row.iter().map(|&v| Vec2::new(straight[v as usize].y, straight[v as usize].z)).collect();
            let girth: Vec<f64> = row.iter().map(|&v| guide.uv()[v as usize].y).collect();
            let opened = open_section(&section, &girth, t);
            for (&v, p) in row.iter().zip(opened) {
                let chainage = (1.0 - t) * straight[v as usize].x + t * guide.uv()[v as usize].x;
                let d = displacement.map_or_else(Vec2::zeros, |d| d[v as usize]) * t;
                places.push(Vec3::new(chainage + d.x, p.x + d.y, p.y));
            }
        }
        places
    }
}

/// Opens one section, a chain of (right, down) points with growing girth, by a share `t`.
pub(super) fn open_section(section: &[Vec2], girth: &[f64], t: f64) -> Vec<Vec2> {
    let Some(crown) = (0..girth.len()).min_by(|&a, &b| girth[a].abs().total_cmp(&girth[b].abs())) else {
        return Vec::new();
    };
    let mut opened = vec![Vec2::zeros(); section.len()];
    opened[crown] = section[crown] * (1.0 - t) + Vec2::new(girth[crown], 0.0) * t;
    // Outwards from the crown to either side, where the direction is near zero and its branch is known.
    for side in [1isize, -1] {
        let (mut here, mut angle) = (crown, 0.0);
        while let Some(next) = here.checked_add_signed(side).filter(|&n| n < section.len()) {
            let chord = (section[next] - section[here]) * side as f64;
            angle += wrap_angle(chord.y.atan2(chord.x) - angle);
            let length = (1.0 - t) * chord.norm() + t * (girth[next] - girth[here]).abs();
            let (sin, cos) = ((1.0 - t) * angle).sin_cos();
            opened[next] = opened[here] + Vec2::new(cos, sin) * (length * side as f64);
            here = next;
        }
    }
    opened
}

fn bound(uv: &[Vec2], used: &[bool], pick: fn(f64, f64) -> f64) -> Vec2 {
    let mut used = uv.iter().zip(used).filter(|(_, u)| **u).map(|(p, _)| *p);
    let first = used.next().unwrap_or_else(Vec2::zeros);
    used.fold(first, |b, p| Vec2::new(pick(b.x, p.x), pick(b.y, p.y)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn an_arch_opens_to_a_line_of_its_girth() {
        let n = 21;
        let angle = |i: usize| PI * (i as f64 / 20.0 * 2.0 - 1.0) * 0.98;
        let section: Vec<Vec2> = (0..n).map(|i| Vec2::new(4.0 * angle(i).sin(), -4.0 * angle(i).cos())).collect();
        let girth: Vec<f64> = (0..n).map(|i| 4.0 * angle(i)).collect();
        for (p, q) in open_section(&section, &girth, 0.0).iter().zip(&section) {
            assert!((p - q).norm() < 1e-12);
        }
        for (p, v) in open_section(&section, &girth, 1.0).iter().zip(&girth) {
            assert!((p - Vec2::new(*v, 0.0)).norm() < 1e-12);
        }
        // Half open: no fold, chords keep their length to the blend.
        let half = open_section(&section, &girth, 0.5);
        assert!(half.windows(2).all(|w| w[1].x > w[0].x));
    }
}
