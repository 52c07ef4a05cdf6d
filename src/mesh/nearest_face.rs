//! The face of a mesh nearest to a point: a bounding-volume tree over the faces, and the closest point of a triangle.
//!
//! The tree is built by halving the faces at the median of their centres along the longest side, so it needs no tuning
//! and is the same on every run. Reference for the closest point: C. Ericson, "Real-Time Collision Detection", 2005,
//! section 5.1.5. Cost: n log n to build, about log n a query; a good first bound makes queries several times cheaper.

use super::{FaceId, Mesh};
use crate::numeric::Vec3;

/// Faces in a leaf.
const LEAF: usize = 4;

/// A bounding-volume tree over the faces of a mesh.
pub struct FaceTree {
    /// Heap order: the children of node i are 2 i + 1 and 2 i + 2. Low and high corner of each node.
    boxes: Vec<[Vec3; 2]>,
    /// Faces in leaf order.
    faces: Vec<FaceId>,
    /// Index of the first leaf in `boxes`.
    first_leaf: usize,
    /// First face of each leaf in `faces`.
    leaf_start: Vec<u32>,
    /// The leaf of each face.
    leaf_of: Vec<u32>,
}

/// The closest point of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Nearest {
    /// The face; the lowest number where several are equally near.
    pub face: FaceId,
    /// Barycentric coordinates of the closest point.
    pub barycentric: [f64; 3],
    /// Squared distance, square metres.
    pub squared_distance: f64,
}

/// Nodes still to be looked at, with their distances: a perfect tree is at most 32 deep.
struct Stack([(usize, f64); 64]);

impl Default for Stack {
    fn default() -> Self {
        Self([(0, 0.0); 64])
    }
}

impl FaceTree {
    /// Builds the tree. The mesh must have faces.
    pub fn of(mesh: &Mesh) -> Self {
        let count = mesh.faces().len();
        let mut faces: Vec<FaceId> = (0..count as FaceId).collect();
        let centres: Vec<Vec3> = faces.iter().map(|&f| mesh.corners(f).iter().sum::<Vec3>()).collect();
        let leaves = count.div_ceil(LEAF).next_power_of_two();
        let first_leaf = leaves - 1;
        let mut leaf_start = vec![0u32; leaves + 1];
        let bounds = |l: usize| count * l / leaves;
        (0..=leaves).for_each(|l| leaf_start[l] = bounds(l) as u32);
        // Each level sorts every node's faces around the median along the node's longest side.
        fn split(faces: &mut [FaceId], leaves: usize, offset: usize, total: usize, all: usize, centres: &[Vec3]) {
            if leaves == 1 || faces.len() < 2 {
                return;
            }
            let mut low = Vec3::repeat(f64::INFINITY);
            let mut high = Vec3::repeat(f64::NEG_INFINITY);
            for &f in faces.iter() {
                low = low.inf(&centres[f as usize]);
                high = high.sup(&centres[f as usize]);
            }
            let side = (high - low).imax();
            let half = leaves / 2;
            let middle = total * (offset + half) / all - total * offset / all;
            let key = |f: &FaceId| centres[*f as usize][side];
            if middle > 0 && middle < faces.len() {
                faces.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
            }
            let (left, right) = faces.split_at_mut(middle);
            rayon::join(
                || split(left, half, offset, total, all, centres),
                || split(right, half, offset + half, total, all, centres),
            );
        }
        split(&mut faces, leaves, 0, count, leaves, &centres);
        let empty = [Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY)];
        let mut boxes = vec![empty; first_leaf + leaves];
        let mut leaf_of = vec![0u32; count];
        for l in 0..leaves {
            for &f in &faces[leaf_start[l] as usize..leaf_start[l + 1] as usize] {
                leaf_of[f as usize] = l as u32;
                for p in mesh.corners(f) {
                    let b = &mut boxes[first_leaf + l];
                    *b = [b[0].inf(&p), b[1].sup(&p)];
                }
            }
        }
        for i in (0..first_leaf).rev() {
            let (a, b) = (boxes[2 * i + 1], boxes[2 * i + 2]);
            boxes[i] = [a[0].inf(&b[0]), a[1].sup(&b[1])];
        }
        Self { boxes, faces, first_leaf, leaf_start, leaf_of }
    }

    /// The nearest face within `reach` metres; `guess` is looked at first and makes the search faster when it is near.
    pub fn nearest(&self, mesh: &Mesh, point: &Vec3, reach: f64, guess: Option<FaceId>) -> Option<Nearest> {
        let mut best = Nearest { face: FaceId::MAX, barycentric: [0.0; 3], squared_distance: reach * reach };
        let mut stack = Stack::default();
        match guess {
            None => self.look_below(0, mesh, point, &mut best, &mut stack),
            Some(face) => {
                consider(mesh, point, face, &mut best);
                // From the leaf of the guess to the root: mostly no neighbour on the way is near enough to be entered.
                let mut node = self.first_leaf + self.leaf_of[face as usize] as usize;
                self.look_below(node, mesh, point, &mut best, &mut stack);
                while node > 0 {
                    let sibling = if node % 2 == 1 { node + 1 } else { node - 1 };
                    self.look_below(sibling, mesh, point, &mut best, &mut stack);
                    node = (node - 1) / 2;
                }
            }
        }
        (best.face != FaceId::MAX).then_some(best)
    }

    /// Improves the best by the faces below a node: depth first, the nearer child first.
    fn look_below(&self, node: usize, mesh: &Mesh, point: &Vec3, best: &mut Nearest, Stack(stack): &mut Stack) {
        let distance = self.squared_distance(node, point);
        if distance > best.squared_distance {
            return;
        }
        let mut top = 1;
        stack[0] = (node, distance);
        while top > 0 {
            top -= 1;
            let (node, distance) = stack[top];
            if distance > best.squared_distance {
                continue;
            }
            if node >= self.first_leaf {
                let l = node - self.first_leaf;
                for &f in &self.faces[self.leaf_start[l] as usize..self.leaf_start[l + 1] as usize] {
                    consider(mesh, point, f, best);
                }
                continue;
            }
            let (a, b) = (2 * node + 1, 2 * node + 2);
            let (da, db) = (self.squared_distance(a, point), self.squared_distance(b, point));
            let (near, far) = if da <= db { ((a, da), (b, db)) } else { ((b, db), (a, da)) };
            for child in [far, near] {
                if child.1 <= best.squared_distance {
                    stack[top] = child;
                    top += 1;
                }
            }
        }
    }

    fn squared_distance(&self, node: usize, p: &Vec3) -> f64 {
        let [low, high] = &self.boxes[node];
        let mut sum = 0.0;
        for i in 0..3 {
            let d = (low[i] - p[i]).max(p[i] - high[i]).max(0.0);
            sum += d * d;
        }
        sum
    }
}

/// Makes a face the best if it is nearer, or as near and of a lower number.
fn consider(mesh: &Mesh, point: &Vec3, face: FaceId, best: &mut Nearest) {
    let (barycentric, squared_distance) = closest_on_triangle(&mesh.corners(face), point);
    if squared_distance < best.squared_distance || (squared_distance == best.squared_distance && face < best.face) {
        *best = Nearest { face, barycentric, squared_distance };
    }
}

/// Barycentric coordinates of the point of a triangle closest to `p`, and its squared distance.
pub fn closest_on_triangle([a, b, c]: &[Vec3; 3], p: &Vec3) -> ([f64; 3], f64) {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
    let at = |w: [f64; 3]| (w, (a * w[0] + b * w[1] + c * w[2] - p).norm_squared());
    if d1 <= 0.0 && d2 <= 0.0 {
        return at([1.0, 0.0, 0.0]);
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
    if d3 >= 0.0 && d4 <= d3 {
        return at([0.0, 1.0, 0.0]);
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        let t = d1 / (d1 - d3);
        return at([1.0 - t, t, 0.0]);
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
    if d6 >= 0.0 && d5 <= d6 {
        return at([0.0, 0.0, 1.0]);
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        let t = d2 / (d2 - d6);
        return at([1.0 - t, 0.0, t]);
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        let t = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return at([0.0, 1.0 - t, t]);
    }
    let sum = va + vb + vc;
    let (v, w) = (vb / sum, vc / sum);
    at([1.0 - v - w, v, w])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_closest_point_is_found_in_all_seven_regions() {
        let t = [Vec3::zeros(), Vec3::new(1.0, 0.0, 0.0), Vec3::new(0.0, 1.0, 0.0)];
        let check = |p: [f64; 3], closest: [f64; 2]| {
            let (w, d) = closest_on_triangle(&t, &Vec3::from(p));
            assert!((w[1] - closest[0]).abs() < 1e-15 && (w[2] - closest[1]).abs() < 1e-15, "{p:?} {w:?}");
            let expected = Vec3::new(closest[0], closest[1], 0.0) - Vec3::from(p);
            assert!((d - expected.norm_squared()).abs() < 1e-15);
        };
        check([0.2, 0.3, 1.0], [0.2, 0.3]);
        check([-1.0, -1.0, 0.5], [0.0, 0.0]);
        check([2.0, -1.0, 0.5], [1.0, 0.0]);
        check([-1.0, 2.0, 0.5], [0.0, 1.0]);
        check([0.4, -1.0, 0.5], [0.4, 0.0]);
        check([-1.0, 0.4, 0.5], [0.0, 0.4]);
        check([1.0, 1.0, 0.5], [0.5, 0.5]);
    }

    #[test]
    fn the_tree_agrees_with_looking_at_every_face() {
        let n = 23u32;
        let vertices: Vec<Vec3> = (0..=n)
            .flat_map(|i| {
                (0..=n).map(move |j| {
                    let (x, y) = (f64::from(i) * 0.1, f64::from(j) * 0.1);
                    Vec3::new(x, y, (3.0 * x).sin() * (2.0 * y).cos())
                })
            })
            .collect();
        let faces: Vec<[u32; 3]> = (0..n)
            .flat_map(|i| {
                (0..n).flat_map(move |j| {
                    let a = i * (n + 1) + j;
                    [[a, a + n + 1, a + n + 2], [a, a + n + 2, a + 1]]
                })
            })
            .collect();
        let mesh = Mesh::all_observed(vertices, faces).unwrap();
        let tree = FaceTree::of(&mesh);
        for k in 0..300 {
            let t = f64::from(k) * 0.618;
            let p = Vec3::new(2.5 * t.fract(), 2.4 * (7.0 * t).fract(), 3.0 * (13.0 * t).fract() - 1.5);
            let brute = (0..mesh.faces().len() as u32)
                .map(|f| (closest_on_triangle(&mesh.corners(f), &p).1, f))
                .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
                .unwrap();
            let found = tree.nearest(&mesh, &p, 10.0, Some(k % 100)).unwrap();
            assert_eq!((found.squared_distance, found.face), brute);
            assert_eq!(tree.nearest(&mesh, &p, 10.0, None), Some(found));
            assert_eq!(tree.nearest(&mesh, &p, brute.0.sqrt() * 0.99, None), None);
        }
    }
}
