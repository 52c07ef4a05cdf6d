//! The unrolled grid that segmentation and the section method work on: rows along the chainage, columns around the mean section.
//!
//! Column positions are shares of the local perimeter, so the grid closes at the invert at every chainage and the cells
//! grow and shrink with the section. Depth is the signed distance from the mean section along the ray from the axis,
//! positive away from the axis.

use super::SectionField;
use crate::axis::{Axis, AxisCoordinates};
use crate::numeric::Vec3;
use rayon::prelude::*;

/// Where a point lies on the grid: rows and columns are real numbers, cell `(i, j)` covers `i..i+1`, `j..j+1`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct GridPoint {
    pub row: f64,
    pub column: f64,
    /// Metres behind the mean section (negative: in front of it).
    pub depth: f64,
}

/// Size and place of the grid.
#[derive(Clone, Debug)]
pub(crate) struct Grid {
    pub start: f64,
    /// Row length in metres of chainage.
    pub row_m: f64,
    /// Mean column width in metres of girth.
    pub column_m: f64,
    pub rows: usize,
    pub columns: usize,
}

impl Grid {
    pub fn new(section: &SectionField, row_m: f64, column_m: f64) -> Self {
        let columns = ((section.mean_perimeter() / column_m).round() as usize).max(12);
        let length = section.end() - section.start();
        let rows = ((length / row_m).round() as usize).max(2);
        Self {
            start: section.start(),
            row_m: length / rows as f64,
            column_m: section.mean_perimeter() / columns as f64,
            rows,
            columns,
        }
    }

    pub fn len(&self) -> usize {
        self.rows * self.columns
    }

    /// The cells at most `reach` rows and columns away, the cell itself left out, in row order.
    pub fn neighbours(&self, cell: usize, reach: usize) -> impl Iterator<Item = usize> + '_ {
        let (i, j) = (cell / self.columns, cell % self.columns);
        let rows = i.saturating_sub(reach)..(i + reach + 1).min(self.rows);
        let around = reach.min((self.columns - 1) / 2);
        rows.flat_map(move |i| {
            (0..2 * around + 1).map(move |d| i * self.columns + (j + self.columns + d - around) % self.columns)
        })
        .filter(move |&n| n != cell)
    }

    /// Metres between the middles of two cells.
    pub fn distance(&self, a: usize, b: usize) -> f64 {
        let rows = (a / self.columns).abs_diff(b / self.columns) as f64;
        let columns = (a % self.columns).abs_diff(b % self.columns);
        let columns = columns.min(self.columns - columns) as f64;
        (rows * self.row_m).hypot(columns * self.column_m)
    }

    /// The grid coordinates of a point; the row may lie outside the grid.
    pub fn unroll(&self, section: &SectionField, c: &AxisCoordinates) -> GridPoint {
        let angle = c.angle();
        let (left, right) = section.girth_range(c.chainage);
        let share = (section.girth(c.chainage, angle) - left) / (right - left);
        GridPoint {
            row: (c.chainage - self.start) / self.row_m,
            column: (share * self.columns as f64).rem_euclid(self.columns as f64),
            depth: c.radius() - section.radius(c.chainage, angle),
        }
    }

    /// The middle of a cell, at a depth.
    pub fn middle(&self, cell: usize, depth: f64) -> GridPoint {
        GridPoint { row: (cell / self.columns) as f64 + 0.5, column: (cell % self.columns) as f64 + 0.5, depth }
    }

    /// The cell that a place lies in; `None` before the first row and after the last.
    pub fn cell_at(&self, p: &GridPoint) -> Option<usize> {
        let inside = p.row >= 0.0 && p.row < self.rows as f64;
        inside.then(|| p.row as usize * self.columns + (p.column as usize).min(self.columns - 1))
    }

    /// The axis coordinates of a place on the grid: the inverse of [`Self::unroll`].
    pub fn place(&self, section: &SectionField, p: &GridPoint) -> AxisCoordinates {
        let chainage = self.start + p.row * self.row_m;
        let (left, right) = section.girth_range(chainage);
        let angle = section.angle_of_girth(chainage, left + (right - left) * p.column / self.columns as f64);
        // A depth beyond the axis itself would come out on the other side.
        let radius = section.radius(chainage, angle);
        AxisCoordinates::from_polar(chainage, angle, (radius + p.depth).max(1e-3 * radius))
    }

    /// The local position of a place on the grid.
    pub fn lift(&self, section: &SectionField, axis: &Axis, p: &GridPoint) -> Vec3 {
        axis.point_at(&self.place(section, p))
    }
}

/// Points sorted by the grid cell they lie in.
pub(crate) struct CellPoints {
    /// First point of each cell, one more than there are cells.
    first: Vec<u32>,
    points: Vec<GridPoint>,
    /// Index of each point in the input.
    index: Vec<u32>,
}

impl CellPoints {
    /// Points outside the rows of the grid are left out; returns their number too.
    pub fn sort(grid: &Grid, points: impl IndexedParallelIterator<Item = Option<GridPoint>>) -> (Self, usize) {
        let unrolled: Vec<Option<GridPoint>> = points.collect();
        let cell = |p: &GridPoint| p.row as usize * grid.columns + (p.column as usize).min(grid.columns - 1);
        let inside = |p: &GridPoint| p.row >= 0.0 && p.row < grid.rows as f64;
        let mut first = vec![0u32; grid.len() + 1];
        let mut left_out = 0;
        for p in unrolled.iter().flatten() {
            if inside(p) {
                first[cell(p) + 1] += 1;
            } else {
                left_out += 1;
            }
        }
        for c in 0..grid.len() {
            first[c + 1] += first[c];
        }
        let mut cursor = first.clone();
        let mut points = vec![GridPoint { row: 0.0, column: 0.0, depth: 0.0 }; first[grid.len()] as usize];
        let mut index = vec![0u32; points.len()];
        for (i, p) in unrolled.iter().enumerate().filter_map(|(i, p)| p.as_ref().filter(|p| inside(p)).map(|p| (i, p)))
        {
            let slot = &mut cursor[cell(p)];
            points[*slot as usize] = *p;
            index[*slot as usize] = i as u32;
            *slot += 1;
        }
        (Self { first, points, index }, left_out)
    }

    pub fn in_cell(&self, cell: usize) -> &[GridPoint] {
        &self.points[self.first[cell] as usize..self.first[cell + 1] as usize]
    }

    /// Input indices of the points of [`Self::in_cell`].
    pub fn indices_in_cell(&self, cell: usize) -> &[u32] {
        &self.index[self.first[cell] as usize..self.first[cell + 1] as usize]
    }

    pub fn len(&self) -> usize {
        self.points.len()
    }
}

/// Squared distance of each cell to the nearest marked cell, in units of `scale` (row length, column width), and
/// infinite when none is marked; periodic in columns.
///
/// Reference: P. F. Felzenszwalb, D. P. Huttenlocher, "Distance transforms of sampled functions", Theory of Computing 8,
/// 2012, doi:10.4086/toc.2012.v008a019.
pub(crate) fn squared_distance(marked: &[bool], rows: usize, columns: usize, scale: [f64; 2]) -> Vec<f64> {
    // Around: each row is repeated half a turn on both sides.
    let half = columns / 2 + 1;
    let mut field: Vec<f64> = vec![0.0; rows * columns];
    field.par_chunks_mut(columns).enumerate().for_each(|(i, out)| {
        let line: Vec<f64> = (0..columns + 2 * half)
            .map(|k| if marked[i * columns + (k + columns * 2 - half) % columns] { 0.0 } else { f64::INFINITY })
            .collect();
        let distance = parabola_envelope(&line, scale[1]);
        out.copy_from_slice(&distance[half..half + columns]);
    });
    // Along: column by column, in transposed order so that writes stay disjoint.
    let along: Vec<Vec<f64>> = (0..columns)
        .into_par_iter()
        .map(|j| {
            let line: Vec<f64> = (0..rows).map(|i| field[i * columns + j]).collect();
            parabola_envelope(&line, scale[0])
        })
        .collect();
    field.par_chunks_mut(columns).enumerate().for_each(|(i, out)| {
        for (j, o) in out.iter_mut().enumerate() {
            *o = along[j][i];
        }
    });
    field
}

/// `min_q (scale (p - q))^2 + f(q)` for each `p`.
fn parabola_envelope(f: &[f64], scale: f64) -> Vec<f64> {
    let mut hull: Vec<(usize, f64)> = Vec::new(); // vertex of the parabola, where it starts to be lowest
    for (q, &value) in f.iter().enumerate() {
        if value.is_infinite() {
            continue;
        }
        let mut from = f64::NEG_INFINITY;
        while let Some(&(v, start)) = hull.last() {
            let (qs, vs) = (q as f64 * scale, v as f64 * scale);
            from = ((value + qs * qs) - (f[v] + vs * vs)) / (2.0 * (qs - vs));
            if from > start {
                break;
            }
            hull.pop();
            from = f64::NEG_INFINITY;
        }
        hull.push((q, from));
    }
    if hull.is_empty() {
        return vec![f64::INFINITY; f.len()];
    }
    let mut k = 0;
    (0..f.len())
        .map(|p| {
            let at = p as f64 * scale;
            while k + 1 < hull.len() && hull[k + 1].1 <= at {
                k += 1;
            }
            let d = at - hull[k].0 as f64 * scale;
            d * d + f[hull[k].0]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unroll_and_lift_are_inverse() {
        let axis = Axis::through(&[Vec3::zeros(), Vec3::new(10.0, 1.0, 0.0), Vec3::new(20.0, 4.0, 1.0)], 0.0).unwrap();
        let section = SectionField::uniform(0.0, 20.0, |a| 3.0 + 0.5 * (2.0 * a).cos());
        let grid = Grid::new(&section, 0.1, 0.1);
        for (s, a, r) in [(0.3, 0.1, 3.0), (10.0, -3.0, 2.5), (15.0, 3.1, 4.0), (19.9, 1.5, 3.3)] {
            let p = axis.point_at(&AxisCoordinates::from_polar(s, a, r));
            let g = grid.unroll(&section, &axis.project(&p));
            assert!((grid.lift(&section, &axis, &g) - p).norm() < 1e-9);
        }
    }

    #[test]
    fn distances_agree_with_brute_force() {
        let (rows, columns, scale) = (9, 14, [0.5, 0.2]);
        let marked: Vec<bool> = (0..rows * columns).map(|k| k % 37 == 5 || k == 100).collect();
        let found = squared_distance(&marked, rows, columns, scale);
        for k in 0..rows * columns {
            let best = (0..rows * columns)
                .filter(|&m| marked[m])
                .map(|m| {
                    let di = (k / columns).abs_diff(m / columns) as f64 * scale[0];
                    let dj = (k % columns).abs_diff(m % columns);
                    let dj = dj.min(columns - dj) as f64 * scale[1];
                    di * di + dj * dj
                })
                .fold(f64::INFINITY, f64::min);
            assert!((found[k] - best).abs() < 1e-12, "{k}: {} {best}", found[k]);
        }
        assert!(squared_distance(&[false; 12], 3, 4, scale).iter().all(|d| d.is_infinite()));
    }
}
