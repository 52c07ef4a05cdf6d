//! Sheets as files: PDF with all pages, SVG and PNG with one page each.

mod pdf;
mod pixels;
mod svg;

pub use pdf::pdf;
pub use pixels::png_picture;
pub use svg::svg;

use crate::map::Picture;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};

/// Quality of embedded photographs.
const JPEG_QUALITY: u8 = 90;

/// Red, green, blue of a picture on white paper.
fn on_paper(picture: &Picture) -> Vec<u8> {
    let blend = |p: &[u8; 4]| {
        let a = u32::from(p[3]);
        [0, 1, 2].map(|k| ((u32::from(p[k]) * a + 255 * (255 - a)) / 255) as u8)
    };
    picture.rgba.as_chunks::<4>().0.iter().flat_map(blend).collect()
}

/// A picture on white paper as JPEG.
fn jpeg(picture: &Picture) -> Result<Vec<u8>, image::ImageError> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY).write_image(
        &on_paper(picture),
        picture.width as u32,
        picture.height as u32,
        ExtendedColorType::Rgb8,
    )?;
    Ok(bytes)
}

/// A picture as PNG.
fn png(picture: &Picture) -> Result<Vec<u8>, image::ImageError> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes).write_image(
        &picture.rgba,
        picture.width as u32,
        picture.height as u32,
        ExtendedColorType::Rgba8,
    )?;
    Ok(bytes)
}
