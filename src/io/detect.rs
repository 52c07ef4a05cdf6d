//! Which format a file has: by its first bytes where they tell, by its name where they do not.

use super::error::Error;
use super::source_bytes::SourceBytes;
use std::path::Path;

/// The formats that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    Las,
    Ply,
    E57,
    Ptx,
    Pts,
    Xyz,
    Pcd,
    Obj,
    Off,
    Stl,
    Glb,
}

impl Format {
    /// Whether files of this format hold meshes and nothing else.
    pub(super) fn is_mesh(self) -> bool {
        matches!(self, Self::Obj | Self::Off | Self::Stl | Self::Glb)
    }

    /// Whether one file may hold the scans of several stations.
    pub(super) fn may_hold_stations(self) -> bool {
        matches!(self, Self::E57 | Self::Ptx)
    }
}

/// Lower-case extension of a path.
pub(super) fn extension(path: &Path) -> String {
    path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

/// The format of an opened file.
pub(super) fn format_of(source: &SourceBytes) -> Result<Format, Error> {
    let head = source.up_to(0, 16)?;
    if head.starts_with(b"LASF") {
        return Ok(Format::Las);
    }
    if head.starts_with(b"ply\n") || head.starts_with(b"ply\r") {
        return Ok(Format::Ply);
    }
    if head.starts_with(b"ASTM-E57") {
        return Ok(Format::E57);
    }
    if head.starts_with(b"glTF") {
        return Ok(Format::Glb);
    }
    match extension(source.path()).as_str() {
        "las" | "laz" => Ok(Format::Las),
        "ply" => Ok(Format::Ply),
        "e57" => Ok(Format::E57),
        "ptx" => Ok(Format::Ptx),
        "pts" => Ok(Format::Pts),
        "xyz" | "csv" | "txt" | "asc" | "xyzrgb" | "neu" => Ok(Format::Xyz),
        "pcd" => Ok(Format::Pcd),
        "obj" => Ok(Format::Obj),
        "off" => Ok(Format::Off),
        "stl" => Ok(Format::Stl),
        "glb" => Ok(Format::Glb),
        other => {
            let cause =
                if other.is_empty() { "its format is unknown".into() } else { format!("'.{other}' is unknown") };
            Err(Error::unsupported(source.path(), cause, "export the scan as LAS, LAZ, E57, PLY, PTX, PTS, XYZ or PCD"))
        }
    }
}
