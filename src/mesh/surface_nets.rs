//! Surface nets on a sparse grid: the zero surface of a function, one vertex for each sheet in a cell.
//!
//! Reference: S. F. F. Gibson, "Constrained elastic surface nets", MICCAI 1998, doi:10.1007/BFb0056277 (vertex in the mean
//! of the edge crossings); G. M. Nielson, "Dual marching cubes", IEEE Visualization 2004, doi:10.1109/VISUAL.2004.28 (a
//! vertex for each sheet, so that sheets which pass through one cell stay apart). A face of a cell with two opposite
//! positive corners keeps these apart from each other, by the same rule on both sides, so sheets never branch; what is
//! left to repair are edges where two sheets meet twice.
//!
//! Guarantees: faces counter-clockwise seen from the positive side; the same faces in the same order on any number of
//! threads. Cost: linear in the cells of the blocks.

use crate::mesh::VertexId;
use crate::numeric::Vec3;
use rayon::prelude::*;
use std::collections::HashMap;

/// Grid vertices along the edge of a block.
pub(super) const SIDE: usize = 8;
/// Grid vertices of a block.
pub(super) const VOLUME: usize = SIDE * SIDE * SIDE;
const NO_VERTEX: u32 = u32::MAX;

/// A function at the vertices of some blocks of a grid; NaN where it is not known.
pub(super) struct Field {
    pub origin: Vec3,
    pub cell_m: f64,
    /// Block coordinates, ascending in (z, y, x).
    pub blocks: Vec<[i32; 3]>,
    /// Values, positive in the void; `x` fastest. Single precision: only where they change sign inside a cell counts.
    pub values: Vec<[f32; VOLUME]>,
    number: HashMap<[i32; 3], u32>,
}

/// The zero surface.
pub(super) struct Net {
    pub vertices: Vec<Vec3>,
    pub faces: Vec<[VertexId; 3]>,
}

impl Field {
    /// A field without values. `blocks` in any order, without repetitions.
    pub fn new(origin: Vec3, cell_m: f64, mut blocks: Vec<[i32; 3]>) -> Self {
        blocks.sort_unstable_by_key(|&[x, y, z]| [z, y, x]);
        let number = blocks.iter().enumerate().map(|(i, &b)| (b, i as u32)).collect();
        Self { origin, cell_m, values: vec![[f32::NAN; VOLUME]; blocks.len()], blocks, number }
    }

    pub fn block(&self, at: [i32; 3]) -> Option<usize> {
        self.number.get(&at).map(|&n| n as usize)
    }

    /// Place of a grid vertex, metres.
    pub fn place(&self, block: usize, local: [usize; 3]) -> Vec3 {
        let b = self.blocks[block];
        let at = [0, 1, 2].map(|a| f64::from(b[a]) * SIDE as f64 + local[a] as f64);
        self.origin + Vec3::from(at) * self.cell_m
    }

    /// The values of a block with one layer of its neighbours on each side (`shell` 1: from -1 to `SIDE`).
    pub fn padded(&self, block: usize) -> Vec<f32> {
        const WIDE: usize = SIDE + 2;
        let around: Vec<Option<usize>> = (0..27)
            .map(|n| {
                let b = self.blocks[block];
                self.block([b[0] + n % 3 - 1, b[1] + n / 3 % 3 - 1, b[2] + n / 9 - 1])
            })
            .collect();
        let mut out = vec![f32::NAN; WIDE * WIDE * WIDE];
        // Which neighbour along an axis, and the place in it.
        let split = |w: usize| match w {
            0 => (0, SIDE - 1),
            w if w > SIDE => (2, 0),
            w => (1, w - 1),
        };
        for z in 0..WIDE {
            for y in 0..WIDE {
                for x in 0..WIDE {
                    let ((bx, lx), (by, ly), (bz, lz)) = (split(x), split(y), split(z));
                    if let Some(n) = around[bx + 3 * by + 9 * bz] {
                        out[(z * WIDE + y) * WIDE + x] = self.values[n][(lz * SIDE + ly) * SIDE + lx];
                    }
                }
            }
        }
        out
    }

    /// Extracts the zero surface.
    pub fn net(&self) -> Net {
        let sheets = sheets_of_cases();
        // Cells of each block: case and place of each sheet's vertex.
        let cells: Vec<Cells> = (0..self.blocks.len()).into_par_iter().map(|b| self.cells(b, &sheets)).collect();
        let mut first_of_block = Vec::with_capacity(cells.len());
        let mut count = 0u32;
        for c in &cells {
            first_of_block.push(count);
            count += c.vertices.len() as u32;
        }
        let vertex = |block: usize, local: [i32; 3], edge: usize| -> u32 {
            let b = self.blocks[block];
            let side = SIDE as i32;
            let outside = [0, 1, 2].map(|a| local[a].div_euclid(side));
            let owner = if outside == [0; 3] { Some(block) } else { self.block([0, 1, 2].map(|a| b[a] + outside[a])) };
            let Some(owner) = owner else { return NO_VERTEX };
            let [x, y, z] = local.map(|c| c.rem_euclid(side) as usize);
            let cell = (z * SIDE + y) * SIDE + x;
            match cells[owner].first[cell] {
                u16::MAX => NO_VERTEX,
                first => {
                    let sheet = sheets[cells[owner].case[cell] as usize].of_edge[edge];
                    first_of_block[owner] + u32::from(first) + u32::from(sheet)
                }
            }
        };
        let vertices: Vec<Vec3> = cells.iter().flat_map(|c| c.vertices.iter().copied()).collect();
        let faces: Vec<Vec<[VertexId; 3]>> = (0..self.blocks.len())
            .into_par_iter()
            .map(|block| {
                let padded = self.padded(block);
                let value = |x: usize, y: usize, z: usize| padded[((z + 1) * (SIDE + 2) + y + 1) * (SIDE + 2) + x + 1];
                let mut out = Vec::new();
                for z in 0..SIDE {
                    for y in 0..SIDE {
                        for x in 0..SIDE {
                            let here = value(x, y, z);
                            if here.is_nan() {
                                continue;
                            }
                            for a in 0..3 {
                                let mut end = [x, y, z];
                                end[a] += 1;
                                let there = value(end[0], end[1], end[2]);
                                if there.is_nan() || (here >= 0.0) == (there >= 0.0) {
                                    continue;
                                }
                                // The four cells around the edge, counter-clockwise seen against its direction.
                                let corner = |o1: i32, o2: i32| {
                                    let mut local = [x as i32, y as i32, z as i32];
                                    local[(a + 1) % 3] -= o1;
                                    local[(a + 2) % 3] -= o2;
                                    vertex(block, local, a * 4 + (o1 + 2 * o2) as usize)
                                };
                                let mut quad = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                                if quad.contains(&NO_VERTEX) {
                                    continue;
                                }
                                if here >= 0.0 {
                                    quad.reverse();
                                }
                                let [p, q, r, s] = quad.map(|v| vertices[v as usize]);
                                if (r - p).norm_squared() <= (s - q).norm_squared() {
                                    out.extend([[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]]);
                                } else {
                                    out.extend([[quad[0], quad[1], quad[3]], [quad[1], quad[2], quad[3]]]);
                                }
                            }
                        }
                    }
                }
                out
            })
            .collect();
        Net { vertices, faces: faces.into_iter().flatten().collect() }
    }

    fn cells(&self, block: usize, sheets: &[Sheets]) -> Cells {
        let padded = self.padded(block);
        let mut cells = Cells { first: vec![u16::MAX; VOLUME], case: vec![0; VOLUME], vertices: Vec::new() };
        for z in 0..SIDE {
            for y in 0..SIDE {
                for x in 0..SIDE {
                    let mut corners = [0.0f32; 8];
                    let mut case = 0;
                    for (c, value) in corners.iter_mut().enumerate() {
                        let (cx, cy, cz) = (x + (c & 1), y + (c >> 1 & 1), z + (c >> 2));
                        *value = padded[((cz + 1) * (SIDE + 2) + cy + 1) * (SIDE + 2) + cx + 1];
                        case |= usize::from(*value >= 0.0) << c;
                    }
                    if case == 0 || case == 255 || corners.iter().any(|v| v.is_nan()) {
                        continue;
                    }
                    let cell = (z * SIDE + y) * SIDE + x;
                    cells.first[cell] = cells.vertices.len() as u16;
                    cells.case[cell] = case as u8;
                    let base = self.place(block, [x, y, z]);
                    let sheet = &sheets[case];
                    let mut sums = [(Vec3::zeros(), 0.0); 4];
                    for (e, &s) in sheet.of_edge.iter().enumerate().filter(|(_, s)| **s != NO_SHEET) {
                        let (from, to) = ends_of_edge(e);
                        let (f, g) = (f64::from(corners[from]), f64::from(corners[to]));
                        let at = |c: usize| Vec3::new((c & 1) as f64, (c >> 1 & 1) as f64, (c >> 2) as f64);
                        let (sum, count) = &mut sums[s as usize];
                        *sum += at(from) + (at(to) - at(from)) * (f / (f - g));
                        *count += 1.0;
                    }
                    for (sum, count) in &sums[..sheet.count] {
                        cells.vertices.push(base + sum * (self.cell_m / count));
                    }
                }
            }
        }
        cells
    }
}

/// The cells of one block that the surface passes through.
struct Cells {
    /// First vertex of each cell among those of the block, `u16::MAX` for none.
    first: Vec<u16>,
    /// Which corners are positive.
    case: Vec<u8>,
    vertices: Vec<Vec3>,
}

const NO_SHEET: u8 = u8::MAX;

/// Which sheet of the surface crosses each of the twelve edges of a cell.
struct Sheets {
    of_edge: [u8; 12],
    count: usize,
}

/// The two corners of edge `4 a + o1 + 2 o2`: along axis `a`, at offsets `o1`, `o2` along the next two axes.
fn ends_of_edge(edge: usize) -> (usize, usize) {
    let (a, o1, o2) = (edge / 4, edge & 1, edge >> 1 & 1);
    let from = (o1 << ((a + 1) % 3)) | (o2 << ((a + 2) % 3));
    (from, from | (1 << a))
}

fn sheets_of_cases() -> Vec<Sheets> {
    (0..256usize)
        .map(|case| {
            let positive = |corner: usize| case >> corner & 1 == 1;
            let crossed = |edge: usize| {
                let (from, to) = ends_of_edge(edge);
                positive(from) != positive(to)
            };
            // The smallest edge of a sheet names it.
            let mut root: [usize; 12] = std::array::from_fn(|e| e);
            let mut join = |a: usize, b: usize| {
                let (a, b) = (root[a], root[b]);
                let (low, high) = (a.min(b), a.max(b));
                root.iter_mut().filter(|r| **r == high).for_each(|r| *r = low);
            };
            for face in 0..6 {
                let (a, side) = (face / 2, face % 2);
                let on_face = |e: usize| {
                    let (from, to) = ends_of_edge(e);
                    from >> a & 1 == side && to >> a & 1 == side
                };
                let edges: Vec<usize> = (0..12).filter(|&e| on_face(e) && crossed(e)).collect();
                match edges[..] {
                    [one, other] => join(one, other),
                    [_, _, _, _] => {
                        // Two opposite corners are positive: each is cut off by the two edges that end at it.
                        for corner in (0..8).filter(|&c| positive(c) && c >> a & 1 == side) {
                            let at: Vec<usize> = edges
                                .iter()
                                .copied()
                                .filter(|&e| ends_of_edge(e).0 == corner || ends_of_edge(e).1 == corner)
                                .collect();
                            join(at[0], at[1]);
                        }
                    }
                    _ => {}
                }
            }
            let mut of_edge = [NO_SHEET; 12];
            let mut count = 0;
            for e in (0..12).filter(|&e| crossed(e)) {
                if root[e] == e {
                    of_edge[e] = count;
                    count += 1;
                } else {
                    of_edge[e] = of_edge[root[e]];
                }
            }
            Sheets { of_edge, count: count as usize }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Mesh;
    use crate::mesh::topology;

    /// The zero surface of `f` in a box of `blocks` blocks around the origin.
    fn net_of(blocks: i32, cell_m: f64, f: impl Fn(&Vec3) -> f64) -> Net {
        let all = (-blocks..blocks)
            .flat_map(|z| (-blocks..blocks).flat_map(move |y| (-blocks..blocks).map(move |x| [x, y, z])))
            .collect();
        let mut field = Field::new(Vec3::new(0.013, 0.007, 0.003), cell_m, all);
        for b in 0..field.blocks.len() {
            for i in 0..VOLUME {
                let p = field.place(b, [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE]);
                field.values[b][i] = f(&p) as f32;
            }
        }
        field.net()
    }

    #[test]
    fn a_ball_becomes_a_sphere_that_faces_the_positive_side() {
        let net = net_of(2, 0.1, |p| 1.0 - p.norm());
        let mesh = Mesh::all_observed(net.vertices, net.faces).unwrap();
        let twin = mesh.twins();
        assert!(topology::boundary_loops(mesh.faces(), twin).is_empty());
        assert_eq!(mesh.vertices().len() as i64 - mesh.faces().len() as i64 / 2, 2, "genus 0");
        assert!(mesh.vertices().iter().all(|v| (v.norm() - 1.0).abs() < 0.005));
        for f in 0..mesh.faces().len() as u32 {
            // Positive inside: faces look at the centre.
            assert!(mesh.double_area_vector(f).dot(&mesh.corners(f)[0]) < 0.0);
        }
    }

    #[test]
    fn sheets_of_every_case_close_and_count_right() {
        let sheets = sheets_of_cases();
        assert_eq!((sheets[1].count, sheets[129].count, sheets[0b0110_1001].count), (1, 2, 4));
        for (case, s) in sheets.iter().enumerate() {
            let crossed = (0..12).filter(|&e| (case >> ends_of_edge(e).0 ^ case >> ends_of_edge(e).1) & 1 == 1).count();
            assert_eq!(s.of_edge.iter().filter(|e| **e != NO_SHEET).count(), crossed);
            for k in 0..s.count as u8 {
                assert!(s.of_edge.iter().filter(|e| **e == k).count() >= 3, "case {case}");
            }
        }
    }

    #[test]
    fn two_balls_that_nearly_touch_stay_two_surfaces() {
        let gap = 0.03;
        let net = net_of(3, 0.1, |p| {
            let ball = |x: f64| 0.7 - (p - Vec3::new(x, 0.0, 0.0)).norm();
            ball(-0.7 - gap / 2.0).max(ball(0.7 + gap / 2.0))
        });
        let twin = topology::twins(&net.faces).unwrap();
        assert_eq!(topology::components(&twin).1, 2);
    }
}
