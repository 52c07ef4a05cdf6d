//! Reading pictures that come back from a paint program: PNG, JPEG or TIFF, of any pixel type.

use crate::map::Picture;
use image::{DynamicImage, ImageFormat, ImageReader};
use std::path::{Path, PathBuf};

/// A picture file as it was read.
#[derive(Clone, Debug)]
pub struct PictureFile {
    /// The pixels as red, green, blue, alpha.
    pub picture: Picture,
    /// The numbers themselves, when the file is a grey TIFF (such as `labels.tif`).
    pub values: Option<Vec<u32>>,
    /// Whether the file format loses detail (JPEG).
    pub lossy: bool,
}

/// Why a picture cannot be read.
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
    /// The file is no picture, or a damaged one.
    #[error("{path}: this is no PNG, JPEG or TIFF picture that can be read ({source}); save it as PNG")]
    Decode {
        /// The file.
        path: PathBuf,
        /// What the decoder says.
        source: image::ImageError,
    },
}

/// Reads a picture; its format is told by its content, not by its name.
///
/// # Errors
/// [`Error`].
pub fn read_picture(path: &Path) -> Result<PictureFile, Error> {
    let io = |source| Error::Io { path: path.to_owned(), source };
    let mut reader = ImageReader::open(path).map_err(io)?.with_guessed_format().map_err(io)?;
    // Maps are large; memory is bounded by the file that a person chose to give.
    reader.no_limits();
    let format = reader.format();
    let image = reader.decode().map_err(|source| Error::Decode { path: path.to_owned(), source })?;
    let values = match (&image, format) {
        (DynamicImage::ImageLuma8(grey), Some(ImageFormat::Tiff)) => Some(grey.iter().map(|&x| x.into()).collect()),
        (DynamicImage::ImageLuma16(grey), Some(ImageFormat::Tiff)) => Some(grey.iter().map(|&x| x.into()).collect()),
        _ => None,
    };
    let rgba = image.into_rgba8();
    let (width, height) = (rgba.width() as usize, rgba.height() as usize);
    let picture = Picture { width, height, rgba: rgba.into_raw() };
    Ok(PictureFile { picture, values, lossy: format == Some(ImageFormat::Jpeg) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixel_types_become_rgba() {
        let folder = tempfile::tempdir().unwrap();
        let png = folder.path().join("a.png");
        image::RgbImage::from_pixel(3, 2, image::Rgb([9, 8, 7])).save(&png).unwrap();
        let read = read_picture(&png).unwrap();
        assert_eq!((read.picture.width, read.picture.height, read.lossy), (3, 2, false));
        assert_eq!(read.picture.rgba[..4], [9, 8, 7, 255]);
        let tif = folder.path().join("a.tif");
        image::GrayImage::from_pixel(3, 2, image::Luma([5])).save(&tif).unwrap();
        assert_eq!(read_picture(&tif).unwrap().values, Some(vec![5; 6]));
        std::fs::write(&png, "no picture").unwrap();
        assert!(read_picture(&png).unwrap_err().to_string().contains("save it as PNG"));
        assert!(matches!(read_picture(&folder.path().join("none.png")), Err(Error::Io { .. })));
    }
}
