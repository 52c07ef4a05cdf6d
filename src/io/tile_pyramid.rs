//! Web tiles: every picture of the map as a pyramid of 256-pixel PNGs, with a viewer that needs no server.
//!
//! `tiles/<layer>/<z>/<x>/<y>.png`: x to the right, y down from the upper left corner of the map; the greatest z is the
//! full resolution, each level less halves it. Tiles with nothing on them are not written. `tiles/index.html` shows them
//! from disk; nothing is loaded from elsewhere.

use crate::map::{Grid, LayerDescription, Piece, Resampling, TILE_PX};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

const VIEWER: &str = include_str!("tile_viewer.html");
/// Where the viewer's page takes what it shows.
const PLACEHOLDER: &str = "/*MAP*/";

/// A tile: red, green, blue, alpha of `TILE_PX` squared pixels.
type Tile = Vec<[u8; 4]>;

/// Writes the pyramid of one layer.
pub struct TilePyramid {
    folder: PathBuf,
    resampling: Resampling,
    /// Tiles across and down on each level, full resolution first.
    levels: Vec<(usize, usize)>,
    /// Tiles of the coarser levels that still wait for some of their parts.
    pending: Vec<BTreeMap<(usize, usize), (Tile, usize)>>,
}

impl TilePyramid {
    /// A pyramid in `folder/<layer>`.
    pub fn new(folder: &Path, grid: &Grid, layer: &LayerDescription) -> Self {
        let levels = levels(grid);
        Self {
            folder: folder.join(layer.layer.name()),
            resampling: layer.resampling,
            pending: levels.iter().map(|_| BTreeMap::new()).collect(),
            levels,
        }
    }

    /// Takes the picture of a piece.
    ///
    /// # Errors
    /// When a tile cannot be written.
    pub fn take(&mut self, piece: &Piece, pixels: &[[u8; 4]]) -> io::Result<()> {
        let rect = piece.rect;
        let tiles = (0..rect.width.div_ceil(TILE_PX)).map(|t| {
            let width = TILE_PX.min(rect.width - t * TILE_PX);
            let mut tile = vec![[0u8; 4]; TILE_PX * TILE_PX];
            for y in 0..rect.height {
                let from = y * rect.width + t * TILE_PX;
                tile[y * TILE_PX..y * TILE_PX + width].copy_from_slice(&pixels[from..from + width]);
            }
            (rect.column / TILE_PX + t, rect.row / TILE_PX, tile)
        });
        self.write(0, tiles.collect())
    }

    /// Writes finished tiles of a level and passes them, halved, to the next.
    fn write(&mut self, level: usize, tiles: Vec<(usize, usize, Tile)>) -> io::Result<()> {
        let z = self.levels.len() - 1 - level;
        let folder = &self.folder;
        tiles.par_iter().try_for_each(|(x, y, tile)| {
            if tile.iter().all(|p| p[3] == 0) {
                return Ok(());
            }
            let column = folder.join(z.to_string()).join(x.to_string());
            fs::create_dir_all(&column)?;
            fs::write(column.join(format!("{y}.png")), encode(tile)?)
        })?;
        if level + 1 == self.levels.len() {
            return Ok(());
        }
        let (across, down) = self.levels[level];
        let mut complete = Vec::new();
        for (x, y, tile) in tiles {
            let key = (y / 2, x / 2);
            let parts = (across - 2 * key.1).min(2) * (down - 2 * key.0).min(2);
            let half = TILE_PX / 2;
            let (target, count) =
                self.pending[level + 1].entry(key).or_insert_with(|| (vec![[0; 4]; TILE_PX * TILE_PX], 0));
            let (dx, dy) = (x % 2 * half, y % 2 * half);
            for ty in 0..half {
                for tx in 0..half {
                    let at = |a: usize, b: usize| tile[(2 * ty + b) * TILE_PX + 2 * tx + a];
                    target[(dy + ty) * TILE_PX + dx + tx] = match self.resampling {
                        Resampling::Nearest => at(0, 0),
                        Resampling::Mean => mean([at(0, 0), at(1, 0), at(0, 1), at(1, 1)]),
                    };
                }
            }
            *count += 1;
            if *count == parts {
                complete.push(key);
            }
        }
        let ready = complete
            .into_iter()
            .filter_map(|key| self.pending[level + 1].remove(&key).map(|(tile, _)| (key.1, key.0, tile)))
            .collect::<Vec<_>>();
        if ready.is_empty() { Ok(()) } else { self.write(level + 1, ready) }
    }
}

/// Writes the viewer for some layers.
///
/// # Errors
/// When the page cannot be written.
pub fn write_viewer(folder: &Path, grid: &Grid, layers: &[&LayerDescription]) -> io::Result<()> {
    let names: Vec<serde_json::Value> =
        layers.iter().map(|l| serde_json::json!({ "name": l.layer.name(), "meaning": l.meaning })).collect();
    let map = serde_json::json!({
        "width": grid.width(), "height": grid.height(), "cell": grid.cell_m(), "u": grid.u_min(), "v": grid.v_max(),
        "levels": levels(grid).len(), "tile": TILE_PX, "layers": names,
    });
    fs::create_dir_all(folder)?;
    fs::write(folder.join("index.html"), VIEWER.replace(PLACEHOLDER, &map.to_string()))
}

/// Tiles across and down, from the full resolution to a single tile.
fn levels(grid: &Grid) -> Vec<(usize, usize)> {
    let mut levels = vec![(grid.width().div_ceil(TILE_PX), grid.height().div_ceil(TILE_PX))];
    while let Some(&(across, down)) = levels.last().filter(|l| l.0.max(l.1) > 1) {
        levels.push((across.div_ceil(2), down.div_ceil(2)));
    }
    levels
}

/// Mean of the pixels that are there.
fn mean(parts: [[u8; 4]; 4]) -> [u8; 4] {
    let alpha: u32 = parts.iter().map(|p| u32::from(p[3])).sum();
    if alpha == 0 {
        return [0; 4];
    }
    let channel = |k: usize| {
        let sum: u32 = parts.iter().map(|p| u32::from(p[k]) * u32::from(p[3])).sum();
        ((sum + alpha / 2) / alpha) as u8
    };
    [channel(0), channel(1), channel(2), 255]
}

fn encode(tile: &Tile) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, TILE_PX as u32, TILE_PX as u32);
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    encoder.write_header().and_then(|mut w| w.write_image_data(tile.as_flattened())).map_err(io::Error::from)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::example::draw_sloping_map;
    use crate::map::{Layer, Settings};

    #[test]
    fn tiles_hold_the_picture_at_every_zoom() {
        let folder = tempfile::tempdir().unwrap();
        let settings = Settings { cell_m: Some(0.01), layers: vec![Layer::Offset], tiles: true, ..Default::default() };
        draw_sloping_map(folder.path(), &settings);
        // 1300 x 310 pixels: 6 x 2 tiles, 3 x 1, 2 x 1, 1 x 1.
        let whole = image::open(folder.path().join("offset.png")).unwrap().into_rgba8();
        let tile = |z: u32, x: u32, y: u32| {
            image::open(folder.path().join(format!("tiles/offset/{z}/{x}/{y}.png"))).unwrap().into_rgba8()
        };
        assert_eq!(tile(3, 4, 1).get_pixel(100, 20), whole.get_pixel(4 * 256 + 100, 256 + 20));
        assert_eq!(tile(3, 5, 1).get_pixel(200, 20)[3], 0);
        let (coarse, fine) = (*tile(2, 2, 0).get_pixel(10, 10), *whole.get_pixel(2 * (512 + 10), 20));
        assert!((0..4).all(|k| coarse[k].abs_diff(fine[k]) <= 3), "{coarse:?} {fine:?}");
        assert_eq!(tile(0, 0, 0).get_pixel(163, 5)[3], 0);
        let page = fs::read_to_string(folder.path().join("tiles/index.html")).unwrap();
        assert!(page.contains("\"levels\":4") && page.contains("\"name\":\"offset\"") && !page.contains(PLACEHOLDER));
        assert!(!page.contains("http"), "the viewer loads nothing from elsewhere");
    }
}
