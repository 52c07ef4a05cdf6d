//! From pixels to surface points: which chart triangle, and where in it, lies under each pixel centre.
//!
//! Reference: J. Pineda, "A parallel algorithm for polygon rasterization", SIGGRAPH 1988, doi:10.1145/54852.378457
//! (edge functions). Departure: edges belong to both neighbours and the face with the lower id wins, so no pixel on a
//! shared edge is lost and the result does not depend on the order of work. Faces that are flipped in the chart are
//! drawn like the others; faces without area in the chart are not drawn.
//!
//! Cost: O(pixels + faces) for each piece of the map; the index over faces is one counting sort.

use super::grid::{Grid, PixelRect, TILE_PX};
use crate::mesh::FaceId;
use crate::unwrap::Chart;

/// No face under this pixel.
pub const NO_FACE: FaceId = FaceId::MAX;

/// Which faces may touch each [`TILE_PX`] block of the grid.
#[derive(Debug)]
pub struct FaceIndex {
    blocks_across: usize,
    blocks_down: usize,
    starts: Vec<usize>,
    faces: Vec<FaceId>,
}

/// Surface points under the pixels of a rectangle, row by row.
#[derive(Debug)]
pub struct SurfaceTile {
    /// Where.
    pub rect: PixelRect,
    /// Face under each pixel centre, or [`NO_FACE`].
    pub faces: Vec<FaceId>,
    /// Weights of the second and third corner (the first is the rest to 1).
    pub barycentric: Vec<[f64; 2]>,
}

impl SurfaceTile {
    /// All three barycentric weights at a pixel.
    pub fn weights(&self, pixel: usize) -> [f64; 3] {
        let [b, c] = self.barycentric[pixel];
        [1.0 - b - c, b, c]
    }
}

impl FaceIndex {
    /// Sorts the faces of the chart into blocks of the grid.
    pub fn new(chart: &Chart, grid: &Grid) -> Self {
        let blocks_across = grid.width().div_ceil(TILE_PX);
        let blocks_down = grid.height().div_ceil(TILE_PX);
        let count = chart.strip().mesh().faces().len();
        let mut starts = vec![0usize; blocks_across * blocks_down + 1];
        for face in 0..count as FaceId {
            for_each_block(chart, grid, face, blocks_across, blocks_down, |block| starts[block + 1] += 1);
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        let mut faces = vec![0; starts[starts.len() - 1]];
        for face in 0..count as FaceId {
            for_each_block(chart, grid, face, blocks_across, blocks_down, |block| {
                faces[next[block]] = face;
                next[block] += 1;
            });
        }
        Self { blocks_across, blocks_down, starts, faces }
    }

    /// The surface points under the pixels of `rect`.
    pub fn rasterize(&self, chart: &Chart, grid: &Grid, rect: PixelRect) -> SurfaceTile {
        let mut tile = SurfaceTile { rect, faces: vec![NO_FACE; rect.len()], barycentric: vec![[0.0; 2]; rect.len()] };
        if rect.is_empty() {
            return tile;
        }
        let (c0, c1) = (rect.column / TILE_PX, ((rect.column + rect.width - 1) / TILE_PX).min(self.blocks_across - 1));
        let (r0, r1) = (rect.row / TILE_PX, ((rect.row + rect.height - 1) / TILE_PX).min(self.blocks_down - 1));
        for block_row in r0..=r1 {
            for block_column in c0..=c1 {
                let block = block_row * self.blocks_across + block_column;
                // Drawing only inside the block keeps a face that spans several from being drawn several times.
                let column = rect.column.max(block_column * TILE_PX);
                let row = rect.row.max(block_row * TILE_PX);
                let clip = PixelRect {
                    column,
                    row,
                    width: (rect.column + rect.width).min((block_column + 1) * TILE_PX) - column,
                    height: (rect.row + rect.height).min((block_row + 1) * TILE_PX) - row,
                };
                for &face in &self.faces[self.starts[block]..self.starts[block + 1]] {
                    draw_face(chart, grid, face, clip, &mut tile);
                }
            }
        }
        tile
    }
}

fn for_each_block(chart: &Chart, grid: &Grid, face: FaceId, across: usize, down: usize, mut visit: impl FnMut(usize)) {
    let p = chart.corners_in_chart(face).map(|c| grid.pixel_from_chart(c));
    let low = p[0].inf(&p[1]).inf(&p[2]) / TILE_PX as f64;
    let high = p[0].sup(&p[1]).sup(&p[2]) / TILE_PX as f64;
    if high.x < 0.0 || high.y < 0.0 || low.x >= across as f64 || low.y >= down as f64 {
        return;
    }
    let clamp = |x: f64, n: usize| (x.max(0.0) as usize).min(n - 1);
    for row in clamp(low.y, down)..=clamp(high.y, down) {
        for column in clamp(low.x, across)..=clamp(high.x, across) {
            visit(row * across + column);
        }
    }
}

fn draw_face(chart: &Chart, grid: &Grid, face: FaceId, clip: PixelRect, tile: &mut SurfaceTile) {
    let [a, b, c] = chart.corners_in_chart(face).map(|corner| grid.pixel_from_chart(corner));
    let (ab, ac) = (b - a, c - a);
    let double_area = ab.perp(&ac);
    if double_area == 0.0 || !double_area.is_finite() {
        return;
    }
    let low = a.inf(&b).inf(&c);
    let high = a.sup(&b).sup(&c);
    // Pixel centres are at +0.5.
    let first = |x: f64, start: usize| ((x - 0.5).ceil().max(start as f64)) as usize;
    let end = |x: f64, end: usize| ((x - 0.5).floor() + 1.0).clamp(0.0, end as f64) as usize;
    let (x0, x1) = (first(low.x, clip.column), end(high.x, clip.column + clip.width));
    let (y0, y1) = (first(low.y, clip.row), end(high.y, clip.row + clip.height));
    let scale = 1.0 / double_area;
    // Rounding must not open a crack between neighbours.
    let slack = -1e-12;
    for y in y0..y1 {
        let dy = y as f64 + 0.5 - a.y;
        let line = (y - tile.rect.row) * tile.rect.width;
        for x in x0..x1 {
            let dx = x as f64 + 0.5 - a.x;
            let wb = (dx * ac.y - dy * ac.x) * scale;
            let wc = (ab.x * dy - ab.y * dx) * scale;
            if wb >= slack && wc >= slack && wb + wc <= 1.0 - slack {
                let i = line + (x - tile.rect.column);
                if face < tile.faces[i] {
                    tile.faces[i] = face;
                    tile.barycentric[i] = [wb, wc];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::example::flat_chart;
    use crate::numeric::Vec2;

    #[test]
    fn every_pixel_is_drawn_once_with_the_right_place() {
        let chart = flat_chart(4.0, 3.0, 17, 11);
        let grid = Grid::covering(Vec2::zeros(), Vec2::new(4.0, 3.0), 0.01).unwrap();
        let index = FaceIndex::new(&chart, &grid);
        let mut drawn = 0;
        for rect in grid.work_rows().flatten() {
            let tile = index.rasterize(&chart, &grid, rect);
            for i in 0..rect.len() {
                assert_ne!(tile.faces[i], NO_FACE);
                let corners = chart.corners_in_chart(tile.faces[i]);
                let w = tile.weights(i);
                let uv = corners[0] * w[0] + corners[1] * w[1] + corners[2] * w[2];
                let centre =
                    Vec2::new((rect.column + i % rect.width) as f64 + 0.5, (rect.row + i / rect.width) as f64 + 0.5);
                assert!((uv - grid.chart_from_pixel(centre)).amax() < 1e-9);
                drawn += 1;
            }
        }
        assert_eq!(drawn, 400 * 300);
    }

    #[test]
    fn outside_the_chart_there_is_no_surface() {
        let chart = flat_chart(1.0, 1.0, 2, 2);
        let grid = Grid::covering(Vec2::new(-1.0, -1.0), Vec2::new(2.0, 2.0), 0.1).unwrap();
        let tile = FaceIndex::new(&chart, &grid).rasterize(&chart, &grid, grid.rect());
        assert_eq!(tile.faces.iter().filter(|&&f| f != NO_FACE).count(), 100);
        assert_eq!(tile.faces[0], NO_FACE);
    }
}
