//! World files: six lines that put a picture in place (`.pgw` next to `.png`, `.tfw` next to `.tif`).
//!
//! The last two lines are the *centre* of the upper left pixel, unlike the tie point of a GeoTIFF, which is its corner.

use crate::map::Placement;
use crate::numeric::Vec2;
use std::io;
use std::path::{Path, PathBuf};

/// Why a world file cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The file cannot be read.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What happened.
        source: io::Error,
    },
    /// The file does not hold six numbers.
    #[error("{path}: a world file holds six numbers, one a line, this one {found}")]
    Numbers {
        /// The file.
        path: PathBuf,
        /// Numbers found.
        found: usize,
    },
    /// The picture is turned or mirrored.
    #[error("{path}: the picture is turned or mirrored; a tunnel map has chainage to the right and girth up")]
    Turned {
        /// The file.
        path: PathBuf,
    },
}

/// The six lines of a world file.
fn to_text(placement: &Placement) -> String {
    let (c, u, v) = (placement.first_centre, placement.step_u, placement.step_v);
    format!("{u:.12}\n0.0\n0.0\n{v:.12}\n{:.9}\n{:.9}\n", c.x, c.y)
}

/// The name of the world file of a picture: `.png` -> `.pgw`, `.tif` -> `.tfw`, `.jpg` -> `.jgw`.
pub fn path_of(picture: &Path) -> PathBuf {
    let extension = picture.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    picture.with_extension(match extension.as_str() {
        "png" => "pgw",
        "tif" | "tiff" => "tfw",
        "jpg" | "jpeg" => "jgw",
        _ => "wld",
    })
}

/// Writes the world file of a picture.
///
/// # Errors
/// [`Error::Io`].
pub fn write(picture: &Path, placement: &Placement) -> Result<(), Error> {
    let path = path_of(picture);
    std::fs::write(&path, to_text(placement)).map_err(|source| Error::Io { path, source })
}

/// Reads the world file of a picture; `None` when there is none.
///
/// # Errors
/// [`Error`] when there is one that cannot be used.
pub fn read(picture: &Path) -> Result<Option<Placement>, Error> {
    let path = path_of(picture);
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(source) => return Err(Error::Io { path, source }),
    };
    let numbers: Vec<f64> = text.split_whitespace().map_while(|w| w.parse().ok()).collect();
    let &[step_u, turn_a, turn_b, step_v, u, v] = numbers.as_slice() else {
        return Err(Error::Numbers { path, found: numbers.len() });
    };
    if turn_a != 0.0 || turn_b != 0.0 || !(step_u > 0.0 && step_v < 0.0) {
        return Err(Error::Turned { path });
    }
    Ok(Some(Placement { first_centre: Vec2::new(u, v), step_u, step_v }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::Grid;

    #[test]
    fn centre_of_the_first_pixel() {
        let grid = Grid::covering(Vec2::new(10.0, -3.0), Vec2::new(20.0, 4.0), 0.005).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let picture = folder.path().join("a.png");
        assert_eq!(read(&picture).unwrap(), None);
        write(&picture, &Placement::of_grid(&grid)).unwrap();
        let placement = read(&picture).unwrap().unwrap();
        assert!((placement.first_centre - Vec2::new(10.0025, 3.9975)).amax() < 1e-9);
        assert_eq!((placement.step_u, placement.step_v), (0.005, -0.005));
        std::fs::write(path_of(&picture), "1\n0.1\n0\n-1\n0\n0\n").unwrap();
        assert!(matches!(read(&picture), Err(Error::Turned { .. })));
        std::fs::write(path_of(&picture), "1\n0\n").unwrap();
        assert!(matches!(read(&picture), Err(Error::Numbers { found: 2, .. })));
    }
}
