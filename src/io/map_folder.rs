//! The `map` folder of a run: a picture and a GeoTIFF of every layer, world files, and the palette of the labels.

use super::geotiff::{GeoTiffWriter, Tile, no_data_tile};
use super::png::PngWriter;
use super::tile_pyramid::{self, TilePyramid};
use super::world_file;
use crate::map::{
    Block, Grid, Layer, LayerDescription, Legend, Look, PaletteEntry, Picture, Piece, Placement, Sink, TILE_PX,
};
use crate::numeric::Vec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Pictures are reduced to at most this many columns and pixels: few programs open more. GeoTIFFs and web tiles have no
/// such limit.
const PICTURE_MAX_WIDTH: usize = 65_000;
const PICTURE_MAX_PIXELS: usize = 1_000_000_000;

/// Folder of the web tiles.
const TILES: &str = "tiles";

/// Writes the layers of a map into a folder; see [`crate::map::draw`].
pub struct MapFolder {
    folder: PathBuf,
    grid: Option<Grid>,
    layers: Vec<LayerFiles>,
    /// Every how many pixels make one of the pictures.
    reduction: usize,
    tiles: bool,
}

/// The files of one layer while they are written.
struct LayerFiles {
    description: LayerDescription,
    raster: Option<GeoTiffWriter>,
    picture: Option<PictureRows>,
    tiles: Option<TilePyramid>,
}

/// Rows of the picture that are not complete yet.
struct PictureRows {
    writer: PngWriter,
    width: usize,
    rows: Vec<[u8; 4]>,
}

/// Why a map could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file cannot be written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What happened.
        source: io::Error,
    },
    /// A world file cannot be written.
    #[error(transparent)]
    WorldFile(#[from] world_file::Error),
    /// A piece does not belong to the map that was begun.
    #[error("a piece of the map does not fit: {message}")]
    Piece {
        /// What does not fit.
        message: String,
    },
}

/// What `map/labels.json` holds: the grid of the pictures and the classes of the label map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LabelsFile {
    /// Side of a pixel of `labels.tif`, metres.
    pub cell_m: f64,
    /// Side of a pixel of `labels.png`, metres: the same unless the picture had to be reduced.
    pub picture_cell_m: f64,
    /// Chainage of the left edge, metres.
    pub u_min_m: f64,
    /// Girth of the top edge, metres.
    pub v_max_m: f64,
    /// Columns of `labels.png`.
    pub width_px: usize,
    /// Rows of `labels.png`.
    pub height_px: usize,
    /// The classes, ordered by value. Transparent pixels have no surface.
    pub classes: Vec<PaletteEntry>,
}

impl LabelsFile {
    /// Where the pixels of the pictures lie.
    pub fn picture_placement(&self) -> Placement {
        let step = self.picture_cell_m;
        let first_centre = Vec2::new(self.u_min_m + step / 2.0, self.v_max_m - step / 2.0);
        Placement { first_centre, step_u: step, step_v: -step }
    }
}

impl MapFolder {
    /// A sink that writes into `folder`, which must exist.
    pub fn new(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), grid: None, layers: Vec::new(), reduction: 1, tiles: false }
    }

    /// Whether a web tile pyramid with its viewer goes into the folder `tiles`, too.
    pub fn with_tiles(mut self, tiles: bool) -> Self {
        self.tiles = tiles;
        self
    }

    /// Every how many pixels of the map make one pixel of the pictures; 1 except for enormous maps.
    pub fn picture_reduction(&self) -> usize {
        self.reduction
    }

    fn begin_map(&mut self, grid: &Grid, layers: &[LayerDescription]) -> Result<(), Error> {
        self.grid = Some(*grid);
        self.reduction = picture_reduction(grid.width(), grid.height());
        let (width, height) = (grid.width().div_ceil(self.reduction), grid.height().div_ceil(self.reduction));
        let legend = Legend::of(grid, layers);
        let path = self.folder.join("legend.json");
        let mut text = serde_json::to_string_pretty(&legend)
            .map_err(|e| Error::Io { path: path.clone(), source: io::Error::other(e) })?;
        text.push('\n');
        fs::write(&path, text).map_err(|source| Error::Io { path: path.clone(), source })?;
        let placement = Placement::of_grid(grid);
        let picture_placement = picture_placement(grid, self.reduction);
        for description in layers {
            let name = description.layer.name();
            let path = self.folder.join(format!("{name}.tif"));
            let failed = |source| Error::Io { path: path.clone(), source };
            let raster = GeoTiffWriter::create(&path, grid, description, TILE_PX).map_err(failed)?;
            world_file::write(&path, &placement)?;
            let mut picture = None;
            let shown = description.look != Look::None;
            let pyramid = (self.tiles && shown).then(|| TilePyramid::new(&self.folder.join(TILES), grid, description));
            if shown {
                let path = self.folder.join(format!("{name}.png"));
                let failed = |source| Error::Io { path: path.clone(), source };
                let cell_m = picture_placement.step_u;
                let writer = PngWriter::create(&path, width, height, Some(cell_m)).map_err(failed)?;
                world_file::write(&path, &picture_placement)?;
                picture = Some(PictureRows { writer, width, rows: Vec::new() });
            }
            if let (Layer::Labels, Look::Labels(classes)) = (description.layer, &description.look) {
                let path = self.folder.join("labels.json");
                let file = LabelsFile {
                    cell_m: grid.cell_m(),
                    picture_cell_m: picture_placement.step_u,
                    u_min_m: grid.u_min(),
                    v_max_m: grid.v_max(),
                    width_px: width,
                    height_px: height,
                    classes: classes.clone(),
                };
                let mut text = serde_json::to_string_pretty(&file)
                    .map_err(|e| Error::Io { path: path.clone(), source: io::Error::other(e) })?;
                text.push('\n');
                fs::write(&path, text).map_err(|source| Error::Io { path: path.clone(), source })?;
            }
            let raster = Some(raster);
            self.layers.push(LayerFiles { description: description.clone(), raster, picture, tiles: pyramid });
        }
        if self.tiles {
            let shown: Vec<&LayerDescription> = layers.iter().filter(|l| l.look != Look::None).collect();
            let folder = self.folder.join(TILES);
            tile_pyramid::write_viewer(&folder, grid, &shown)
                .map_err(|source| Error::Io { path: folder.join("index.html"), source })?;
        }
        Ok(())
    }

    fn take_pieces(&mut self, pieces: &[Piece]) -> Result<(), Error> {
        let Some(grid) = self.grid else {
            return Err(Error::Piece { message: "the map was not begun".into() });
        };
        if let Some(piece) = pieces.iter().find(|p| p.layers.len() != self.layers.len()) {
            let message = format!("{} layers instead of {}", piece.layers.len(), self.layers.len());
            return Err(Error::Piece { message });
        }
        let (folder, reduction) = (&self.folder, self.reduction);
        // Layers are independent files: they are compressed side by side.
        self.layers.par_iter_mut().enumerate().try_for_each(|(k, files)| {
            let name = files.description.layer.name();
            if let Some(raster) = &mut files.raster {
                let tiles = pieces.iter().flat_map(|p| tiles_of(&files.description, p, k)).collect();
                let path = folder.join(format!("{name}.tif"));
                raster.write_tiles(tiles).map_err(|source| Error::Io { path, source })?;
            }
            if let Some(picture) = &mut files.picture {
                for piece in pieces {
                    let path = folder.join(format!("{name}.png"));
                    let pixels = files.description.picture(&piece.layers[k]);
                    picture.take(&grid, piece, &pixels, reduction).map_err(|source| Error::Io { path, source })?;
                    if let Some(tiles) = &mut files.tiles {
                        let path = folder.join(TILES).join(name);
                        tiles.take(piece, &pixels).map_err(|source| Error::Io { path, source })?;
                    }
                }
            }
            Ok(())
        })
    }

    fn finish_map(&mut self) -> Result<(), Error> {
        let folder = &self.folder;
        self.layers.par_iter_mut().try_for_each(|files| {
            let name = files.description.layer.name();
            if let Some(raster) = files.raster.take() {
                let path = folder.join(format!("{name}.tif"));
                raster.finish().map_err(|source| Error::Io { path, source })?;
            }
            if let Some(picture) = files.picture.take() {
                let path = folder.join(format!("{name}.png"));
                picture.writer.finish().map_err(|source| Error::Io { path, source })?;
            }
            Ok(())
        })
    }
}

/// Writes a picture such as the overview; `pixel_m` is noted as the size of a pixel on paper.
///
/// # Errors
/// `Error::Io`.
pub fn write_picture(path: &Path, picture: &Picture, pixel_m: Option<f64>) -> Result<(), Error> {
    let failed = |source| Error::Io { path: path.to_owned(), source };
    let mut writer = PngWriter::create(path, picture.width, picture.height, pixel_m).map_err(failed)?;
    writer.write_rows(&picture.rgba).map_err(failed)?;
    writer.finish().map_err(failed)
}

impl Sink for MapFolder {
    fn begin(&mut self, grid: &Grid, layers: &[LayerDescription]) -> Result<(), crate::map::SinkError> {
        Ok(self.begin_map(grid, layers)?)
    }

    fn take(&mut self, pieces: Vec<Piece>) -> Result<(), crate::map::SinkError> {
        Ok(self.take_pieces(&pieces)?)
    }

    fn finish(&mut self) -> Result<(), crate::map::SinkError> {
        Ok(self.finish_map()?)
    }
}

impl PictureRows {
    fn take(&mut self, grid: &Grid, piece: &Piece, pixels: &[[u8; 4]], reduction: usize) -> io::Result<()> {
        let rect = piece.rect;
        // The middle pixel of each reduced pixel that lies in this piece.
        let middle = |i: usize, end: usize| (i * reduction + reduction / 2).min(end - 1);
        let first =
            |from: usize, end: usize| (0..).map(move |k| from / reduction + k).find(move |&i| middle(i, end) >= from);
        let (Some(x0), Some(y0)) = (first(rect.column, grid.width()), first(rect.row, grid.height())) else {
            return Ok(());
        };
        let picture_rows = grid.height().div_ceil(reduction);
        let rows: Vec<usize> =
            (y0..picture_rows).take_while(|&i| middle(i, grid.height()) < rect.row + rect.height).collect();
        if self.rows.is_empty() {
            self.rows.resize(rows.len() * self.width, [0; 4]);
        }
        for (line, &row) in rows.iter().enumerate() {
            let from = (middle(row, grid.height()) - rect.row) * rect.width;
            if reduction == 1 {
                self.rows[line * self.width + rect.column..][..rect.width]
                    .copy_from_slice(&pixels[from..][..rect.width]);
                continue;
            }
            for x in (x0..self.width).take_while(|&x| middle(x, grid.width()) < rect.column + rect.width) {
                self.rows[line * self.width + x] = pixels[from + middle(x, grid.width()) - rect.column];
            }
        }
        if rect.column + rect.width == grid.width() {
            self.writer.write_rows(self.rows.as_flattened())?;
            self.rows.clear();
        }
        Ok(())
    }
}

/// Every how many pixels of a map make one of its pictures.
fn picture_reduction(width: usize, height: usize) -> usize {
    (1..)
        .find(|n| {
            width.div_ceil(*n) <= PICTURE_MAX_WIDTH && width.div_ceil(*n) * height.div_ceil(*n) <= PICTURE_MAX_PIXELS
        })
        .unwrap_or(1)
}

fn picture_placement(grid: &Grid, reduction: usize) -> Placement {
    let half = 0.5 * reduction as f64;
    let step = grid.cell_m() * reduction as f64;
    Placement { first_centre: grid.chart_from_pixel(Vec2::new(half, half)), step_u: step, step_v: -step }
}

/// Cuts a piece of a layer into tiles, padded with NoData.
fn tiles_of(description: &LayerDescription, piece: &Piece, layer: usize) -> Vec<Tile> {
    let rect = piece.rect;
    (0..rect.width.div_ceil(TILE_PX))
        .map(|t| {
            let size = [TILE_PX.min(rect.width - t * TILE_PX), rect.height];
            let from = Block { x: t * TILE_PX, y: 0, picture_width: rect.width };
            let to = Block { x: 0, y: 0, picture_width: TILE_PX };
            let mut samples = no_data_tile(description, TILE_PX);
            samples.copy_block(to, &piece.layers[layer], from, size, description.bands.len());
            Tile { column: rect.column / TILE_PX + t, row: rect.row / TILE_PX, samples }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::example::draw_sloping_map;
    use crate::map::{Layer, Settings};

    #[test]
    fn pictures_rasters_and_palette_of_a_map() {
        let folder = tempfile::tempdir().unwrap();
        let summary = draw_sloping_map(folder.path(), &Settings { cell_m: Some(0.01), ..Default::default() });
        assert_eq!(summary.layers, [Layer::Labels, Layer::Offset, Layer::Coverage, Layer::Distortion, Layer::Relief]);
        let picture = image::open(folder.path().join("offset.png")).unwrap().into_rgba8();
        assert_eq!(picture.dimensions(), (1300, 310));
        // Blue on the left (behind the mean section), red on the right.
        let (left, right) = (picture.get_pixel(20, 100), picture.get_pixel(1280, 100));
        assert!(left[2] > left[0] && right[0] > right[2]);
        let labels: LabelsFile =
            serde_json::from_str(&fs::read_to_string(folder.path().join("labels.json")).unwrap()).unwrap();
        assert_eq!((labels.width_px, labels.classes[0].value), (1300, 0));
        let mut names: Vec<String> =
            fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        assert_eq!(names.len(), 5 * 4 + 2, "{names:?}");
        let legend: Legend =
            serde_json::from_str(&fs::read_to_string(folder.path().join("legend.json")).unwrap()).unwrap();
        assert_eq!(legend.layers.iter().map(|l| l.layer).collect::<Vec<_>>(), summary.layers);
        assert_eq!((legend.cell_m, legend.width_px, legend.height_px), (0.01, 1300, 310));
        assert!(world_file::read(&folder.path().join("offset.tif")).unwrap().is_some());
    }

    #[test]
    fn enormous_pictures_are_reduced() {
        assert_eq!(picture_reduction(41_000, 18_000), 1);
        assert_eq!(picture_reduction(500_000, 9_000), 8);
        let grid = Grid::covering(Vec2::zeros(), Vec2::new(1000.0, 18.0), 0.002).unwrap();
        let placement = picture_placement(&grid, 8);
        assert!((placement.first_centre - Vec2::new(0.008, 17.992)).amax() < 1e-9);
        assert!((placement.step_u - 0.016).abs() < 1e-12);
    }
}
