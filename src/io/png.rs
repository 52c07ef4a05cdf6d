//! PNG: the pictures of the map, written row by row, so that a picture is never in memory as a whole.

use png::{BitDepth, ColorType, Compression, Encoder, PixelDimensions, StreamWriter, Unit};
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Writes a picture of red, green, blue, alpha pixels from the top row to the bottom row.
pub struct PngWriter {
    path: PathBuf,
    partial: PathBuf,
    writer: Option<StreamWriter<'static, BufWriter<File>>>,
}

impl PngWriter {
    /// Starts a picture; `cell_m` is noted as the size of a pixel (to the nearest micrometre per pixel PNG can say).
    ///
    /// # Errors
    /// When the file cannot be created, or the picture has more pixels on a side than PNG allows.
    pub fn create(path: &Path, width: usize, height: usize, cell_m: Option<f64>) -> io::Result<Self> {
        let too_large = |_| io::Error::other(format!("a picture of {width} x {height} pixels is too large for PNG"));
        let (w, h) = (u32::try_from(width).map_err(too_large)?, u32::try_from(height).map_err(too_large)?);
        let mut partial = path.as_os_str().to_owned();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        let mut encoder = Encoder::new(BufWriter::with_capacity(1 << 20, File::create(&partial)?), w, h);
        encoder.set_color(ColorType::Rgba);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::Fast);
        if let Some(cell_m) = cell_m {
            let per_metre = (1.0 / cell_m).round().clamp(1.0, f64::from(u32::MAX)) as u32;
            encoder.set_pixel_dims(Some(PixelDimensions { xppu: per_metre, yppu: per_metre, unit: Unit::Meter }));
        }
        let writer = encoder.write_header()?.into_stream_writer_with_size(1 << 20)?;
        Ok(Self { path: path.to_owned(), partial, writer: Some(writer) })
    }

    /// Adds whole rows, 4 bytes a pixel.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_rows(&mut self, rgba: &[u8]) -> io::Result<()> {
        self.writer.as_mut().map_or(Ok(()), |w| w.write_all(rgba))
    }

    /// Completes the picture under its name.
    ///
    /// # Errors
    /// When rows are missing or the file cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        if let Some(writer) = self.writer.take() {
            writer.finish()?;
        }
        fs::rename(&self.partial, &self.path)
    }
}

impl Drop for PngWriter {
    fn drop(&mut self) {
        // Only there when writing was broken off.
        self.writer = None;
        fs::remove_file(&self.partial).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let mut writer = PngWriter::create(&path, 5, 4, Some(0.005)).unwrap();
        let pixels: Vec<u8> = (0..80).collect();
        writer.write_rows(&pixels[..40]).unwrap();
        writer.write_rows(&pixels[40..]).unwrap();
        writer.finish().unwrap();
        assert_eq!(image::open(&path).unwrap().into_rgba8().into_raw(), pixels);
    }

    #[test]
    fn a_picture_that_was_broken_off_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let writer = PngWriter::create(&folder.path().join("a.png"), 5, 4, None).unwrap();
        drop(writer);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
