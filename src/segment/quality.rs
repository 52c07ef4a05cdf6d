//! How well each place of the surface was measured: noise, point density, incidence, and what was seen there.
//!
//! Use it for the quality layers of the map and the columns of `mesh.ply`. The points are counted on a grid of
//! (chainage, girth) cells a little wider than their spacing; a place of the surface takes the values of the four cells
//! around it. Where no point fell, the density is 0 and noise and incidence are unknown.
//!
//! Guarantees: sums run in point order, so the same bytes on any number of threads. Cost: linear in points and cells.

use super::unrolled_grid::{Grid, GridPoint};
use super::{Class, SectionField, Segmentation};
use crate::axis::AxisCoordinates;
use crate::normals::OrientedCloud;
use crate::numeric::{Vec3, angle_between};
use rayon::prelude::*;

/// Side of a cell in point spacings: about nine points a cell.
const CELL_IN_SPACINGS: f64 = 3.0;
/// Cells are not smaller than this, metres: the density of a few points is no density.
const SMALLEST_CELL_M: f64 = 0.05;
/// A cell counts as furniture when this share of its points is: what stood there hid the wall.
const FURNITURE_SHARE: f64 = 0.2;

/// Class of a place where nothing was seen.
pub const NOTHING_SEEN: u8 = u8::MAX;

/// The quality of the surface on a grid around the mean section.
#[derive(Clone, Debug)]
pub struct Quality {
    grid: Grid,
    /// Root mean square scatter about the local plane; NaN where unknown.
    noise_m: Vec<f32>,
    density_per_m2: Vec<f32>,
    /// Mean angle between the line of sight and the normal; NaN where unknown.
    incidence_deg: Vec<f32>,
    class: Vec<u8>,
}

/// The quality at places of the surface, one value each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VertexQuality {
    /// Root mean square scatter of the points about their local plane, metres; NaN where none were seen.
    pub noise_m: Vec<f32>,
    /// Scan points on a square metre of the mean section.
    pub density_per_m2: Vec<f32>,
    /// Angle between the line of sight and the normal, degrees; empty when no station is known, NaN where none saw.
    pub incidence_deg: Vec<f32>,
    /// What was seen there first: the code of a [`Class`], or [`NOTHING_SEEN`].
    pub class: Vec<u8>,
}

/// Sums of a cell.
#[derive(Clone, Copy, Default)]
struct Cell {
    /// Scan points on the surface.
    points: f64,
    /// Geometry points on the surface and their squared noise.
    measured: f64,
    noise_squared: f64,
    seen: f64,
    incidence_deg: f64,
    floor: f64,
    furniture: f64,
}

/// [`Quality`] as columns: start, row and column length in metres; rows and columns; noise, density, incidence; classes.
pub type QualityColumns<'a> = ([f64; 3], [u64; 2], [&'a [f32]; 3], &'a [u8]);

impl Quality {
    /// From points with normals and classes. `counts` are the scan points in each geometry point, `station` tells where
    /// a geometry point was seen from.
    pub fn of(
        oriented: &OrientedCloud,
        segmentation: &Segmentation,
        counts: &[u32],
        station: impl Fn(usize) -> Option<Vec3> + Sync,
    ) -> Self {
        let section = &segmentation.section;
        let sampling = segmentation.sampling;
        let side = |spacing: f64| (CELL_IN_SPACINGS * spacing).max(SMALLEST_CELL_M);
        let grid = Grid::new(section, side(sampling.along_m), side(sampling.around_m));
        let cell_m2 = grid.row_m * grid.column_m;
        let place: Vec<Option<(u32, f32)>> = segmentation
            .coordinates
            .par_iter()
            .enumerate()
            .map(|(i, c)| {
                let p = grid.unroll(section, c);
                let inside = p.row >= 0.0 && p.row < grid.rows as f64;
                let class = segmentation.class[i];
                if !inside || matches!(class, Class::Noise | Class::Outside) {
                    return None;
                }
                let point = oriented.positions()[i];
                let incidence = station(i)
                    .map_or(f32::NAN, |s| angle_between(&(s - point), &oriented.normals()[i]).to_degrees() as f32);
                let cell = p.row as usize * grid.columns + (p.column as usize).min(grid.columns - 1);
                Some((cell as u32, incidence))
            })
            .collect();
        let mut cells = vec![Cell::default(); grid.len()];
        for (i, (cell, incidence)) in place.iter().enumerate().filter_map(|(i, p)| p.map(|p| (i, p))) {
            let cell = &mut cells[cell as usize];
            let class = segmentation.class[i];
            if class == Class::Furniture {
                cell.furniture += 1.0;
                continue;
            }
            cell.points += f64::from(counts[i]);
            cell.measured += 1.0;
            cell.noise_squared += f64::from(oriented.noise_m()[i]).powi(2);
            cell.floor += f64::from(u8::from(class == Class::Floor));
            if !incidence.is_nan() {
                cell.seen += 1.0;
                cell.incidence_deg += f64::from(incidence);
            }
        }
        let class_of = |c: &Cell| {
            if c.measured + c.furniture == 0.0 {
                NOTHING_SEEN
            } else if c.furniture > FURNITURE_SHARE * (c.measured + c.furniture) {
                Class::Furniture as u8
            } else if 2.0 * c.floor > c.measured {
                Class::Floor as u8
            } else {
                Class::Wall as u8
            }
        };
        Self {
            // 0 / 0 is the NaN that stands for unknown.
            noise_m: cells.iter().map(|c| (c.noise_squared / c.measured).sqrt() as f32).collect(),
            density_per_m2: cells.iter().map(|c| (c.points / cell_m2) as f32).collect(),
            incidence_deg: cells.iter().map(|c| (c.incidence_deg / c.seen) as f32).collect(),
            class: cells.iter().map(class_of).collect(),
            grid,
        }
    }

    /// The values at places of the surface, given in axis coordinates.
    pub fn at(&self, section: &SectionField, places: &[AxisCoordinates]) -> VertexQuality {
        let on_grid: Vec<GridPoint> = places.par_iter().map(|p| self.grid.unroll(section, p)).collect();
        let blend = |values: &[f32]| on_grid.par_iter().map(|p| self.blend(values, p)).collect();
        let no_station = self.incidence_deg.iter().all(|v| v.is_nan());
        VertexQuality {
            noise_m: blend(&self.noise_m),
            density_per_m2: blend(&self.density_per_m2),
            incidence_deg: if no_station { Vec::new() } else { blend(&self.incidence_deg) },
            class: on_grid.par_iter().map(|p| self.class[self.cell(p.row as i64, p.column as i64)]).collect(),
        }
    }

    /// Columns for a checkpoint.
    pub fn columns(&self) -> QualityColumns<'_> {
        let Grid { start, row_m, column_m, rows, columns } = self.grid;
        let values = [&self.noise_m[..], &self.density_per_m2, &self.incidence_deg];
        ([start, row_m, column_m], [rows as u64, columns as u64], values, &self.class)
    }

    /// The same again from what [`Self::columns`] gave; `None` when the columns do not fit each other.
    pub fn from_columns(
        [start, row_m, column_m]: [f64; 3],
        [rows, columns]: [u64; 2],
        [noise_m, density_per_m2, incidence_deg]: [Vec<f32>; 3],
        class: Vec<u8>,
    ) -> Option<Self> {
        let grid = Grid { start, row_m, column_m, rows: rows as usize, columns: columns as usize };
        let lengths = [noise_m.len(), density_per_m2.len(), incidence_deg.len(), class.len()];
        let sound = grid.rows > 0 && grid.columns > 0 && lengths.iter().all(|&l| l == grid.len());
        sound.then_some(Self { grid, noise_m, density_per_m2, incidence_deg, class })
    }

    /// The cell of a row and column; rows end at the portals, columns go round.
    fn cell(&self, row: i64, column: i64) -> usize {
        let row = row.clamp(0, self.grid.rows as i64 - 1) as usize;
        row * self.grid.columns + column.rem_euclid(self.grid.columns as i64) as usize
    }

    /// Bilinear mean of the four cells around a place; unknown ones take no part.
    fn blend(&self, values: &[f32], p: &GridPoint) -> f32 {
        let (row, column) = (p.row - 0.5, p.column - 0.5);
        let (i, j) = (row.floor(), column.floor());
        let (s, t) = (row - i, column - j);
        let (mut sum, mut total) = (0.0, 0.0);
        for (di, wi) in [(0, 1.0 - s), (1, s)] {
            for (dj, wj) in [(0, 1.0 - t), (1, t)] {
                let value = f64::from(values[self.cell(i as i64 + di, j as i64 + dj)]);
                if !value.is_nan() {
                    sum += wi * wj * value;
                    total += wi * wj;
                }
            }
        }
        (sum / total) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Settings, classify_positions};
    use super::*;
    use crate::clean::GeometryCloud;
    use crate::normals::{self, Viewpoints};
    use crate::synthetic::{Alignment, Item, ScanPlan, Section, Tunnel, scan};

    #[test]
    fn noise_density_incidence_and_what_hid_the_wall() {
        let mut tunnel = Tunnel::smooth(Section::circle(2.0), Alignment::straight(12.0));
        tunnel.furniture.push(Item::duct(12.0, 1.0, 0.9, 0.25));
        let plan = ScanPlan {
            points: 150_000,
            range_noise_m: 0.003,
            station_chainages_m: vec![6.0],
            station_offset_m: 0.0,
            ..ScanPlan::default()
        };
        let scan = scan(&tunnel, &plan).unwrap();
        let axis = tunnel.axis();
        let geometry = GeometryCloud::from_positions(scan.cloud.positions().to_vec());
        let (oriented, _) =
            normals::estimate(&geometry, &axis, Viewpoints::of(&scan.cloud), &normals::Settings::default()).unwrap();
        let (segmentation, _) = classify_positions(geometry.positions(), &axis, &Settings::default()).unwrap();
        let station = scan.cloud.stations()[0].position_in_local.unwrap();
        let quality = Quality::of(&oriented, &segmentation, geometry.counts(), |_| Some(station));
        let place = |s: f64, angle: f64| axis.point_at(&crate::axis::AxisCoordinates::from_polar(s, angle, 2.0));
        // Beside the station, 4 m along, and behind the duct (at 48 degrees right of the crown).
        let found = quality.at(
            &segmentation.section,
            &[place(6.0, -1.5), place(10.0, -1.5), place(6.0, 0.84)].map(|p| axis.project(&p)),
        );
        // The noise is along the beam: across the wall it is less where the beam grazes it.
        assert!((found.noise_m[0] - 0.003).abs() < 0.0006, "{found:?}");
        assert!(found.noise_m[1] < 0.75 * found.noise_m[0], "{found:?}");
        let expected = (4.0f32 / 2.0).atan().to_degrees();
        assert!((found.incidence_deg[1] - expected).abs() < 4.0 && found.incidence_deg[0] < 12.0, "{found:?}");
        assert!(found.density_per_m2[0] > 3.0 * found.density_per_m2[1], "{found:?}");
        assert_eq!(found.class, [Class::Wall as u8, Class::Wall as u8, Class::Furniture as u8]);
        let (a, b, [x, y, z], class) = quality.columns();
        let again = Quality::from_columns(a, b, [x.to_vec(), y.to_vec(), z.to_vec()], class.to_vec()).unwrap();
        assert_eq!(again.at(&segmentation.section, &[axis.project(&place(6.0, -1.5))]).noise_m[0], found.noise_m[0]);
        let blind = Quality::of(&oriented, &segmentation, geometry.counts(), |_| None);
        assert!(blind.at(&segmentation.section, &[axis.project(&place(6.0, 0.0))]).incidence_deg.is_empty());
    }
}
