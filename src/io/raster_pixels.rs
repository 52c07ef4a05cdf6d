//! The pixels of a raster of the map with their places, a tile at a time: what a check from the files alone needs.

use crate::map::Placement;
use crate::numeric::Vec2;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

/// Why a raster does not read.
#[derive(Debug, thiserror::Error)]
#[error("'{}' is no raster of a map that reads: {what}", path.display())]
pub struct Error {
    /// The file.
    pub path: PathBuf,
    /// What is wrong.
    pub what: String,
}

/// A raster that was opened.
pub struct RasterPixels {
    path: PathBuf,
    decoder: Decoder<BufReader<File>>,
    /// Columns and rows.
    pub size: (usize, usize),
    /// Place of the pixels.
    pub placement: Placement,
    /// What has to be added to the samples of each band: large coordinates do not fit into them.
    pub band_offsets: Vec<f64>,
}

impl RasterPixels {
    /// Opens a raster and reads where it lies.
    ///
    /// # Errors
    /// [`Error`] when it is no TIFF or tells no place.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let failed = |what: String| Error { path: path.to_owned(), what };
        let file = File::open(path).map_err(|e| failed(e.to_string()))?;
        let bad = |e: tiff::TiffError| failed(e.to_string());
        let mut decoder = Decoder::new(BufReader::new(file)).map_err(bad)?.with_limits(Limits::unlimited());
        let (width, height) = decoder.dimensions().map_err(bad)?;
        let scale = decoder.get_tag_f64_vec(Tag::ModelPixelScaleTag).map_err(bad)?;
        let tie = decoder.get_tag_f64_vec(Tag::ModelTiepointTag).map_err(bad)?;
        let (&[step_u, step_v, ..], &[i, j, _, u, v, ..]) = (&scale[..], &tie[..]) else {
            return Err(failed("its place on the map is incomplete".into()));
        };
        let first_centre = Vec2::new(u + (0.5 - i) * step_u, v - (0.5 - j) * step_v);
        let placement = Placement { first_centre, step_u, step_v: -step_v };
        let metadata = decoder.get_tag_ascii_string(Tag::Unknown(42112)).unwrap_or_default();
        Ok(Self {
            path: path.to_owned(),
            decoder,
            size: (width as usize, height as usize),
            placement,
            band_offsets: offsets(&metadata),
        })
    }

    /// Calls `each` with the column, the row and the samples of every `step`th pixel of every `step`th row.
    ///
    /// # Errors
    /// [`Error`] when a tile does not read, or the samples are no numbers of 32-bit floating point.
    pub fn for_each(&mut self, step: usize, each: &mut dyn FnMut(usize, usize, &[f32])) -> Result<(), Error> {
        let failed = |what: String| Error { path: self.path.clone(), what };
        let (tile_width, tile_height) = self.decoder.chunk_dimensions();
        let (tile_width, tile_height) = (tile_width as usize, tile_height as usize);
        let across = self.size.0.div_ceil(tile_width);
        let down = self.size.1.div_ceil(tile_height);
        for tile in 0..across * down {
            let chunk = self.decoder.read_chunk(tile as u32).map_err(|e| failed(e.to_string()))?;
            let DecodingResult::F32(samples) = chunk else {
                return Err(failed("its samples are not 32-bit floating point".into()));
            };
            let (left, top) = (tile % across * tile_width, tile / across * tile_height);
            // Tiles at the right and lower border come without their padding.
            let (width, height) = (tile_width.min(self.size.0 - left), tile_height.min(self.size.1 - top));
            let bands = samples.len() / (width * height);
            for y in (0..height).filter(|y| (top + y).is_multiple_of(step)) {
                for x in (0..width).filter(|x| (left + x).is_multiple_of(step)) {
                    let at = (y * width + x) * bands;
                    each(left + x, top + y, &samples[at..at + bands]);
                }
            }
        }
        Ok(())
    }
}

/// The items `OFFSET` of GDAL's metadata, by band.
fn offsets(metadata: &str) -> Vec<f64> {
    let mut found: Vec<(usize, f64)> = Vec::new();
    for item in metadata.split("<Item ").skip(1).filter(|i| i.contains("role=\"offset\"")) {
        let sample = item.split("sample=\"").nth(1).and_then(|s| s.split('"').next()).and_then(|s| s.parse().ok());
        let value = item.split('>').nth(1).and_then(|s| s.split('<').next()).and_then(|s| s.trim().parse().ok());
        found.extend(sample.zip(value));
    }
    found.sort_by_key(|f| f.0);
    found.into_iter().map(|f| f.1).collect()
}
