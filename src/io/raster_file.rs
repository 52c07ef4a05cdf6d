//! Reading the map's GeoTIFFs again, a part at a time and from the overview that is fine enough.

use crate::map::{LegendLayer, Picture, Samples};
use crate::numeric::Vec2;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

/// Why a raster cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The file cannot be opened.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What happened.
        source: std::io::Error,
    },
    /// The file is no raster of a map, or a damaged one.
    #[error("{path}: this is no raster of a map that can be read ({what}); run again with --force map")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
}

/// An open raster of the map.
pub struct RasterFile {
    path: PathBuf,
    decoder: Decoder<BufReader<File>>,
    /// Size of each resolution, the full one first.
    levels: Vec<(usize, usize)>,
    corner: Vec2,
    cell_m: f64,
}

impl RasterFile {
    /// Opens a raster and reads its directories.
    ///
    /// # Errors
    /// [`Error`].
    pub fn open(path: &Path) -> Result<Self, Error> {
        let file = File::open(path).map_err(|source| Error::Io { path: path.to_owned(), source })?;
        let damaged = |e: tiff::TiffError| Error::Damaged { path: path.to_owned(), what: e.to_string() };
        let mut decoder = Decoder::new(BufReader::new(file)).map_err(damaged)?;
        let scale = decoder.get_tag_f64_vec(Tag::ModelPixelScaleTag).map_err(damaged)?;
        let tie = decoder.get_tag_f64_vec(Tag::ModelTiepointTag).map_err(damaged)?;
        let (&[cell_m, ..], &[_, _, _, u, v, ..]) = (scale.as_slice(), tie.as_slice()) else {
            return Err(Error::Damaged { path: path.to_owned(), what: "it has no place on the map".into() });
        };
        let mut levels = Vec::new();
        loop {
            let (w, h) = decoder.dimensions().map_err(damaged)?;
            levels.push((w as usize, h as usize));
            if !decoder.more_images() {
                break;
            }
            decoder.next_image().map_err(damaged)?;
        }
        Ok(Self { path: path.to_owned(), decoder, levels, corner: Vec2::new(u, v), cell_m })
    }

    /// Side of a pixel of a resolution, metres.
    pub fn cell_m(&self, level: usize) -> f64 {
        self.cell_m * self.levels[0].0 as f64 / self.levels[level].0 as f64
    }

    /// Columns and rows of a resolution.
    pub fn size(&self, level: usize) -> (usize, usize) {
        self.levels[level]
    }

    /// The coarsest resolution whose pixels are not larger than `cell_m`, or the full one.
    pub fn level_for(&self, cell_m: f64) -> usize {
        (0..self.levels.len()).rev().find(|&k| self.cell_m(k) <= cell_m * 1.001).unwrap_or(0)
    }

    /// The finest resolution with at most so many pixels, or the coarsest.
    pub fn level_within(&self, pixels: usize) -> usize {
        (0..self.levels.len()).find(|&k| self.levels[k].0 * self.levels[k].1 <= pixels).unwrap_or(self.levels.len() - 1)
    }

    /// The samples of a rectangle of pixels, row by row, bands of a pixel together.
    ///
    /// # Errors
    /// [`Error::Damaged`].
    pub fn read(&mut self, level: usize, columns: [usize; 2], rows: [usize; 2]) -> Result<Samples, Error> {
        let path = self.path.clone();
        let damaged = |what: String| Error::Damaged { path: path.clone(), what };
        let failed = |e: tiff::TiffError| damaged(e.to_string());
        self.decoder.seek_to_image(level).map_err(failed)?;
        let (tile_w, tile_h) = self.decoder.chunk_dimensions();
        let (tile_w, tile_h) = (tile_w as usize, tile_h as usize);
        let across = self.levels[level].0.div_ceil(tile_w);
        let (width, height) = (columns[1] - columns[0], rows[1] - rows[0]);
        let mut out: Option<Samples> = None;
        for ty in rows[0] / tile_h..rows[1].div_ceil(tile_h) {
            for tx in columns[0] / tile_w..columns[1].div_ceil(tile_w) {
                let chunk = (ty * across + tx) as u32;
                let (data_w, data_h) = self.decoder.chunk_data_dimensions(chunk);
                let (data_w, data_h) = (data_w as usize, data_h as usize);
                let tile = samples(self.decoder.read_chunk(chunk).map_err(failed)?)
                    .ok_or_else(|| damaged("its samples are of a strange type".into()))?;
                let bands = tile.len() / (data_w * data_h).max(1);
                let out = out.get_or_insert_with(|| tile.zeros(width * height * bands));
                let (x0, x1) = (columns[0].max(tx * tile_w), columns[1].min(tx * tile_w + data_w));
                for y in rows[0].max(ty * tile_h)..rows[1].min(ty * tile_h + data_h) {
                    let from = ((y - ty * tile_h) * data_w + x0 - tx * tile_w) * bands;
                    let to = ((y - rows[0]) * width + x0 - columns[0]) * bands;
                    out.copy(to, &tile, from, (x1 - x0) * bands);
                }
            }
        }
        out.ok_or_else(|| damaged("the part asked for is empty".into()))
    }

    /// The picture of a rectangle of the map in so many columns and rows: means of the pixels of the raster, or for
    /// classes one of them. Transparent beside the raster.
    ///
    /// # Errors
    /// [`Error::Damaged`].
    pub fn picture(
        &mut self,
        layer: &LegendLayer,
        low: Vec2,
        high: Vec2,
        columns: usize,
        rows: usize,
    ) -> Result<Picture, Error> {
        let (step_u, step_v) = ((high.x - low.x) / columns as f64, (high.y - low.y) / rows as f64);
        let level = self.level_for(step_u.min(step_v));
        let (width, height) = self.levels[level];
        let cell = self.cell_m(level);
        let pixel = |u: f64, v: f64| Vec2::new((u - self.corner.x) / cell, (self.corner.y - v) / cell);
        let (a, b) = (pixel(low.x, high.y), pixel(high.x, low.y));
        let clip = |x: f64, end: usize| (x.max(0.0) as usize).min(end);
        let c = [clip(a.x.floor(), width), clip(b.x.ceil(), width)];
        let r = [clip(a.y.floor(), height), clip(b.y.ceil(), height)];
        let mut rgba = vec![0u8; 4 * columns * rows];
        if c[1] <= c[0] || r[1] <= r[0] {
            return Ok(Picture { width: columns, height: rows, rgba });
        }
        let samples = self.read(level, c, r)?;
        let part = layer.look.picture(&samples, layer.bands.len(), layer.no_data);
        let is_class = matches!(layer.look, crate::map::Look::Labels(_) | crate::map::Look::Coverage);
        let part_width = c[1] - c[0];
        let span = |from: f64, to: f64, start: usize, end: usize| {
            let first = (from.floor().max(start as f64) as usize).min(end - 1);
            first..(to.ceil() as usize).clamp(first + 1, end)
        };
        for y in 0..rows {
            let (y0, y1) = (a.y + y as f64 * step_v / cell, a.y + (y + 1) as f64 * step_v / cell);
            for x in 0..columns {
                let (x0, x1) = (a.x + x as f64 * step_u / cell, a.x + (x + 1) as f64 * step_u / cell);
                let out = &mut rgba[4 * (y * columns + x)..4 * (y * columns + x) + 4];
                let at = |px: usize, py: usize| part[(py - r[0]) * part_width + px - c[0]];
                if is_class {
                    let (px, py) = (0.5 * (x0 + x1), 0.5 * (y0 + y1));
                    if px >= c[0] as f64 && py >= r[0] as f64 && px < c[1] as f64 && py < r[1] as f64 {
                        out.copy_from_slice(&at(px as usize, py as usize));
                    }
                    continue;
                }
                let (mut sum, mut alpha, mut weight) = ([0.0; 3], 0.0, 0.0);
                for py in span(y0, y1, r[0], r[1]) {
                    let wy = ((py as f64 + 1.0).min(y1) - (py as f64).max(y0)).max(0.0);
                    for px in span(x0, x1, c[0], c[1]) {
                        let w = wy * ((px as f64 + 1.0).min(x1) - (px as f64).max(x0)).max(0.0);
                        let p = at(px, py);
                        let wa = w * f64::from(p[3]);
                        (0..3).for_each(|k| sum[k] += wa * f64::from(p[k]));
                        alpha += wa;
                        weight += w;
                    }
                }
                if alpha > 0.0 {
                    let [r, g, b] = sum.map(|s| (s / alpha).round() as u8);
                    out.copy_from_slice(&[r, g, b, (alpha / weight).round() as u8]);
                }
            }
        }
        Ok(Picture { width: columns, height: rows, rgba })
    }
}

fn samples(result: DecodingResult) -> Option<Samples> {
    Some(match result {
        DecodingResult::U8(v) => Samples::U8(v),
        DecodingResult::U16(v) => Samples::U16(v),
        DecodingResult::U32(v) => Samples::U32(v),
        DecodingResult::F32(v) => Samples::F32(v),
        DecodingResult::F64(v) => Samples::F64(v),
        _ => return None,
    })
}

impl Samples {
    /// As many zeros of the same type.
    fn zeros(&self, count: usize) -> Samples {
        match self {
            Samples::U8(_) => Samples::U8(vec![0; count]),
            Samples::U16(_) => Samples::U16(vec![0; count]),
            Samples::U32(_) => Samples::U32(vec![0; count]),
            Samples::F32(_) => Samples::F32(vec![0.0; count]),
            Samples::F64(_) => Samples::F64(vec![0.0; count]),
        }
    }

    /// Copies `count` samples of the same type.
    fn copy(&mut self, to: usize, from: &Samples, at: usize, count: usize) {
        match (self, from) {
            (Samples::U8(a), Samples::U8(b)) => a[to..to + count].copy_from_slice(&b[at..at + count]),
            (Samples::U16(a), Samples::U16(b)) => a[to..to + count].copy_from_slice(&b[at..at + count]),
            (Samples::U32(a), Samples::U32(b)) => a[to..to + count].copy_from_slice(&b[at..at + count]),
            (Samples::F32(a), Samples::F32(b)) => a[to..to + count].copy_from_slice(&b[at..at + count]),
            (Samples::F64(a), Samples::F64(b)) => a[to..to + count].copy_from_slice(&b[at..at + count]),
            _ => unreachable!("all tiles of a raster have one type"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::example::draw_sloping_map;
    use crate::map::{Layer, Legend, Settings};

    #[test]
    fn parts_of_every_resolution_come_back() {
        let folder = tempfile::tempdir().unwrap();
        draw_sloping_map(folder.path(), &Settings { cell_m: Some(0.01), ..Default::default() });
        let mut file = RasterFile::open(&folder.path().join("offset.tif")).unwrap();
        assert_eq!((file.size(0), file.size(1)), ((1300, 310), (650, 155)));
        assert_eq!((file.level_for(0.02), file.level_for(0.019), file.level_for(0.001)), (1, 0, 0));
        for (level, x, y) in [(0, 250, 255), (1, 300, 100)] {
            let samples = file.read(level, [x, x + 20], [y, y + 30]).unwrap();
            let u = (x as f64 + 7.5) * file.cell_m(level);
            assert!((samples.get(3 * 20 + 7) - 0.02 * (u - 6.5)).abs() < 1e-3);
        }
        let text = std::fs::read_to_string(folder.path().join("legend.json")).unwrap();
        let legend: Legend = serde_json::from_str(&text).unwrap();
        let layer = legend.layer(Layer::Offset).unwrap();
        let picture = file.picture(layer, Vec2::new(-1.0, -1.0), Vec2::new(14.0, 4.0), 150, 50).unwrap();
        let pixel = |x: usize, y: usize| &picture.rgba[4 * (y * 150 + x)..4 * (y * 150 + x) + 4];
        assert_eq!(pixel(5, 25)[3], 0);
        // Blue on the left (behind the mean section), red on the right.
        assert!(pixel(12, 25)[2] > pixel(12, 25)[0] && pixel(135, 25)[0] > pixel(135, 25)[2]);
        assert!(matches!(RasterFile::open(&folder.path().join("legend.json")), Err(Error::Damaged { .. })));
    }
}
