//! The pixel grid of a map: square cells in chart metres, whole-cell origin, rows from the top (greatest v) down.
//!
//! Column `c` and row `r` of pixel centres are `u = u_min + (c + 0.5) cell`, `v = v_max - (r + 0.5) cell`: u runs to the
//! right and v runs up, so the right wall is the upper half of the picture and the map is never mirrored.

use super::Error;
use crate::numeric::Vec2;

/// Side of a stored tile in pixels; COG readers like 256 or 512.
pub const TILE_PX: usize = 256;

/// Width of the piece that is computed at once; wide, because sparse scans are sparse along the tunnel.
pub const WORK_WIDTH_PX: usize = 4 * TILE_PX;

/// Finest and coarsest pixel that is chosen automatically, metres.
const AUTOMATIC_CELL_M: (f64, f64) = (0.001, 0.1);

/// An automatic grid stays below this many pixels; a person who wants more sets `cell_m`.
const AUTOMATIC_PIXELS: f64 = 60e6;

/// More pixels than this in one direction do not fit the formats that people open.
const MAX_SIDE_PX: f64 = 2_000_000_000.0;

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PixelRect {
    /// First column.
    pub column: usize,
    /// First row (from the top).
    pub row: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl PixelRect {
    /// Pixels in the rectangle.
    pub fn len(&self) -> usize {
        self.width * self.height
    }

    /// Whether the rectangle holds no pixel.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Square pixels over a part of the chart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    cell_m: f64,
    /// Column 0 starts at `first_column * cell_m`.
    first_column: i64,
    /// Row 0 ends (at its top edge) at `top_row * cell_m`.
    top_row: i64,
    width: usize,
    height: usize,
}

impl Grid {
    /// The smallest grid of `cell_m` pixels, aligned to whole cells, that covers the chart rectangle.
    ///
    /// # Errors
    /// [`Error::Cell`] if `cell_m` is not positive, [`Error::GridTooLarge`] if a side has more than 2 10^9 pixels.
    pub fn covering(min_in_chart: Vec2, max_in_chart: Vec2, cell_m: f64) -> Result<Self, Error> {
        if !(cell_m.is_finite() && cell_m > 0.0) {
            return Err(Error::Cell { cell_m });
        }
        let extent = max_in_chart - min_in_chart;
        if !(extent.x.is_finite() && extent.y.is_finite()) || extent.amax() / cell_m > MAX_SIDE_PX {
            return Err(Error::GridTooLarge { cell_m, extent_u_m: extent.x, extent_v_m: extent.y });
        }
        // A chart that ends on a cell border (up to rounding) does not get another, empty, cell.
        let snap = |cells: f64| if (cells - cells.round()).abs() < 1e-6 { cells.round() } else { cells };
        let first_column = snap(min_in_chart.x / cell_m).floor() as i64;
        let last_column = snap(max_in_chart.x / cell_m).ceil() as i64;
        let bottom_row = snap(min_in_chart.y / cell_m).floor() as i64;
        let top_row = snap(max_in_chart.y / cell_m).ceil() as i64;
        Ok(Self {
            cell_m,
            first_column,
            top_row,
            width: (last_column - first_column).max(1) as usize,
            height: (top_row - bottom_row).max(1) as usize,
        })
    }

    /// Side of a pixel in metres.
    pub fn cell_m(&self) -> f64 {
        self.cell_m
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Chart u of the left edge, metres.
    pub fn u_min(&self) -> f64 {
        self.metres(self.first_column)
    }

    /// Chart v of the top edge, metres.
    pub fn v_max(&self) -> f64 {
        self.metres(self.top_row)
    }

    /// Whole cells in metres, rounded once: 301 cells of 0.01 m are 3.01 m and not 3.0100000000000002 m.
    fn metres(&self, cells: i64) -> f64 {
        let per_metre = (1.0 / self.cell_m).round();
        if 1.0 / per_metre == self.cell_m { cells as f64 / per_metre } else { cells as f64 * self.cell_m }
    }

    /// The rectangle of the whole grid.
    pub fn rect(&self) -> PixelRect {
        PixelRect { column: 0, row: 0, width: self.width, height: self.height }
    }

    /// Chart position of continuous pixel coordinates: (0, 0) is the upper left corner of the grid,
    /// (0.5, 0.5) the centre of its first pixel.
    pub fn chart_from_pixel(&self, pixel: Vec2) -> Vec2 {
        Vec2::new((self.first_column as f64 + pixel.x) * self.cell_m, (self.top_row as f64 - pixel.y) * self.cell_m)
    }

    /// Continuous pixel coordinates of a chart position; the inverse of [`Self::chart_from_pixel`].
    pub fn pixel_from_chart(&self, uv: Vec2) -> Vec2 {
        Vec2::new(uv.x / self.cell_m - self.first_column as f64, self.top_row as f64 - uv.y / self.cell_m)
    }

    /// Column and row of the pixel that holds a chart position, if it lies in the grid.
    pub fn index_of(&self, uv: Vec2) -> Option<(usize, usize)> {
        let p = self.pixel_from_chart(uv);
        let inside = p.x >= 0.0 && p.y >= 0.0 && p.x < self.width as f64 && p.y < self.height as f64;
        inside.then(|| (p.x as usize, p.y as usize))
    }

    /// The pieces in which the map is computed, row by row from the top, `WORK_WIDTH_PX` x `TILE_PX` or less.
    pub fn work_rows(&self) -> impl Iterator<Item = Vec<PixelRect>> + use<> {
        let (width, height) = (self.width, self.height);
        (0..height.div_ceil(TILE_PX)).map(move |r| {
            let row = r * TILE_PX;
            (0..width.div_ceil(WORK_WIDTH_PX))
                .map(|c| {
                    let column = c * WORK_WIDTH_PX;
                    PixelRect {
                        column,
                        row,
                        width: WORK_WIDTH_PX.min(width - column),
                        height: TILE_PX.min(height - row),
                    }
                })
                .collect()
        })
    }
}

/// Where the pixels of a picture lie in chart metres: a grid that need not be square or aligned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Chart position of the centre of the upper left pixel.
    pub first_centre: Vec2,
    /// Metres to the right from one column to the next.
    pub step_u: f64,
    /// Metres up from one row to the next (negative: rows run down).
    pub step_v: f64,
}

impl Placement {
    /// The placement of a map's own grid.
    pub fn of_grid(grid: &Grid) -> Self {
        let first_centre = grid.chart_from_pixel(Vec2::new(0.5, 0.5));
        Self { first_centre, step_u: grid.cell_m(), step_v: -grid.cell_m() }
    }

    /// Chart position of continuous pixel coordinates; (0, 0) is the upper left corner of the picture.
    pub fn chart_from_pixel(&self, pixel: Vec2) -> Vec2 {
        self.first_centre + Vec2::new((pixel.x - 0.5) * self.step_u, (pixel.y - 0.5) * self.step_v)
    }

    /// Continuous pixel coordinates of a chart position.
    pub fn pixel_from_chart(&self, uv: Vec2) -> Vec2 {
        let d = uv - self.first_centre;
        Vec2::new(d.x / self.step_u + 0.5, d.y / self.step_v + 0.5)
    }
}

/// The pixel size that suits points `spacing_u_m` x `spacing_v_m` apart on a chart of the given extent: on the series
/// 1, 2, 5, 10, ... millimetres, below the finer of the two spacings but not so fine that most pixels are interpolated.
pub fn automatic_cell_m(spacing_u_m: f64, spacing_v_m: f64, extent: Vec2) -> f64 {
    let finer = spacing_u_m.min(spacing_v_m);
    let mean = (spacing_u_m * spacing_v_m).sqrt();
    let wanted = (0.8 * finer).max(mean / 5.0).clamp(AUTOMATIC_CELL_M.0, AUTOMATIC_CELL_M.1);
    let affordable = (extent.x * extent.y / AUTOMATIC_PIXELS).sqrt();
    if affordable > wanted { next_in_series(affordable) } else { previous_in_series(wanted) }
}

/// The greatest 1-2-5 number that is not above `x`.
pub fn previous_in_series(x: f64) -> f64 {
    let exponent = x.log10().floor() as i32;
    let candidates = [1.0, 2.0, 5.0, 10.0].map(|m| decimal(m, exponent));
    // The tolerance keeps 0.005 at 0.005 although it is not a binary fraction.
    candidates.into_iter().rev().find(|c| *c <= x * (1.0 + 1e-9)).unwrap_or(candidates[0])
}

/// The least 1-2-5 number that is not below `x`.
pub fn next_in_series(x: f64) -> f64 {
    let exponent = x.log10().floor() as i32;
    let candidates = [1.0, 2.0, 5.0, 10.0].map(|m| decimal(m, exponent));
    candidates.into_iter().find(|c| *c >= x * (1.0 - 1e-9)).unwrap_or(candidates[3])
}

/// `mantissa * 10^exponent`, rounded once.
fn decimal(mantissa: f64, exponent: i32) -> f64 {
    if exponent < 0 { mantissa / 10f64.powi(-exponent) } else { mantissa * 10f64.powi(exponent) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn series_is_1_2_5() {
        assert_eq!(previous_in_series(0.012), 0.01);
        assert_eq!(previous_in_series(0.005), 0.005);
        assert_eq!(previous_in_series(0.0499), 0.02);
        assert_eq!(next_in_series(0.0051), 0.01);
        assert_eq!(next_in_series(0.02), 0.02);
        assert_eq!(next_in_series(3.0), 5.0);
    }

    #[test]
    fn grid_is_aligned_and_v_points_up() {
        let grid = Grid::covering(Vec2::new(0.013, -2.0), Vec2::new(10.0, 3.001), 0.01).unwrap();
        assert_eq!((grid.u_min(), grid.v_max()), (0.01, 3.01));
        assert_eq!((grid.width(), grid.height()), (999, 501));
        assert_eq!(grid.index_of(Vec2::new(0.015, 3.005)), Some((0, 0)));
        assert_eq!(grid.index_of(Vec2::new(0.015, -1.995)), Some((0, 500)));
        assert_eq!(grid.index_of(Vec2::new(0.0, 0.0)), None);
    }

    #[test]
    fn work_pieces_tile_the_grid() {
        let grid = Grid::covering(Vec2::zeros(), Vec2::new(25.0, 6.0), 0.01).unwrap();
        let pieces: Vec<PixelRect> = grid.work_rows().flatten().collect();
        assert_eq!(pieces.iter().map(PixelRect::len).sum::<usize>(), grid.width() * grid.height());
        assert!(pieces.iter().all(|p| p.column % TILE_PX == 0 && p.row % TILE_PX == 0));
    }

    #[test]
    fn bad_cells_are_refused() {
        assert!(matches!(Grid::covering(Vec2::zeros(), Vec2::new(1.0, 1.0), 0.0), Err(Error::Cell { .. })));
        let far = Vec2::new(1e6, 1.0);
        assert!(matches!(Grid::covering(Vec2::zeros(), far, 1e-9), Err(Error::GridTooLarge { .. })));
    }

    #[test]
    fn automatic_cells_follow_the_density() {
        let extent = Vec2::new(41.0, 20.0);
        assert_eq!(automatic_cell_m(0.014, 0.014, extent), 0.01);
        assert_eq!(automatic_cell_m(0.5, 0.004, extent), 0.005);
        assert_eq!(automatic_cell_m(0.001, 0.001, extent), 0.005);
    }

    proptest! {
        #[test]
        fn pixel_and_chart_are_inverse(u in -1e4..1e4f64, v in -50.0..50.0f64) {
            let grid = Grid::covering(Vec2::new(-1e4, -50.0), Vec2::new(1e4, 50.0), 0.005).unwrap();
            let back = grid.chart_from_pixel(grid.pixel_from_chart(Vec2::new(u, v)));
            prop_assert!((back - Vec2::new(u, v)).amax() < 1e-9);
        }
    }
}
