//! What a file announces in its header: how many points, and whether the file can hold them. Nothing else is read, so
//! this tells a half-copied file from a whole one, and what a run will need, before any work is done.

use super::assemble::contained;
use super::detect::{self, Format};
use super::error::{COPY_AGAIN, Error};
use super::part::Part;
use super::source_bytes::SourceBytes;
use super::{e57, las, pcd, ply};
use serde::Serialize;
use std::path::Path;

/// What the header of a file says.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Announcement {
    /// Points (vertices of a mesh) in the file.
    pub points: u64,
    /// Whether the header counts the points; otherwise they were estimated from the length of the first lines.
    pub counted: bool,
    /// Length of the file, bytes.
    pub bytes: u64,
    /// The box around the points as the header states it, metres, if it does (LAS and LAZ).
    pub bounds_m: Option<[[f64; 3]; 2]>,
}

/// Lines of text are sampled from this many bytes.
const SAMPLE: usize = 1 << 16;
/// A vertex with its two triangles takes about this many bytes: text (OBJ, OFF) and binary (GLB).
const TEXT_BYTES_PER_VERTEX: u64 = 80;
const GLB_BYTES_PER_VERTEX: u64 = 36;
/// A triangle of a binary STL, and its header; two triangles share a vertex.
const STL_TRIANGLE: u64 = 50;
const STL_HEADER: u64 = 84;

/// Reads the header of a file and checks that it agrees with the file's length.
///
/// LAS: count times record length; LAZ: the chunk table behind the points; E57: the physical length; PLY and PCD: count
/// times record length; GLB and STL: the stated length. Texts (XYZ, CSV, PTS, PTX, OBJ, OFF) state none.
///
/// # Errors
/// [`Error`] when the file cannot be opened, its header does not read, or the file is shorter than its header says.
pub fn announce(path: &Path) -> Result<Announcement, Error> {
    announce_part(path, None)
}

/// As [`announce`]; of a COPC only the points that may lie in `part` are counted. Other formats tell nothing about parts.
///
/// # Errors
/// As [`announce`].
pub fn announce_part(path: &Path, part: Option<&Part>) -> Result<Announcement, Error> {
    contained(path, || {
        let source = SourceBytes::open(path)?;
        let bytes = source.len();
        let counted = |points| Announcement { points, counted: true, bytes, bounds_m: None };
        let estimated = |points| Announcement { points, counted: false, bytes, bounds_m: None };
        Ok(match detect::format_of(&source)? {
            Format::Las => {
                let (points, bounds_m) = las::announced_points(&source, part)?;
                Announcement { bounds_m, ..counted(points) }
            }
            Format::E57 => counted(e57::announced_points(&source)?),
            Format::Ply => counted(ply::announced_vertices(&source)?),
            Format::Pcd => counted(pcd::announced_points(&source)?),
            Format::Glb => {
                let head = source.up_to(0, 12)?;
                let stated = head.get(8..12).map_or(0, |b| u64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])));
                must_hold(&source, stated.max(12), "its header")?;
                estimated(bytes / GLB_BYTES_PER_VERTEX)
            }
            Format::Stl => {
                let head = source.up_to(0, STL_HEADER as usize)?;
                if head.starts_with(b"solid") && !head.contains(&0) {
                    estimated(bytes / (2 * TEXT_BYTES_PER_VERTEX))
                } else {
                    let count = head.get(80..84).map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
                    must_hold(&source, STL_HEADER + STL_TRIANGLE * u64::from(count), "its triangle count")?;
                    counted(u64::from(count) / 2)
                }
            }
            Format::Obj | Format::Off => estimated(bytes / TEXT_BYTES_PER_VERTEX),
            Format::Ptx | Format::Pts | Format::Xyz => {
                let sample = source.up_to(0, SAMPLE)?;
                let ends = |end: u8| sample.iter().filter(|&&b| b == end).count();
                // Old exports end their lines with a carriage return alone.
                let lines = ends(b'\n').max(ends(b'\r')).max(1) as u64;
                estimated((bytes as f64 * lines as f64 / sample.len() as f64).round() as u64)
            }
        })
    })
}

/// Refuses a file that is shorter than what `what` says.
pub(super) fn must_hold(source: &SourceBytes, needed: u64, what: &str) -> Result<(), Error> {
    if source.len() >= needed {
        return Ok(());
    }
    let cause = format!("{what} needs {needed} bytes, but the file has {}", source.len());
    Err(Error::bad(source.path(), cause, COPY_AGAIN))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{Attributes, Cloud, ScanFrame, SourceFile};
    use crate::numeric::Vec3;
    use std::fs;

    fn cloud(points: usize) -> Cloud {
        let positions = (0..points).map(|i| Vec3::new(i as f64 * 0.01, (i % 97) as f64 * 0.02, 1.5)).collect();
        let sources = vec![SourceFile {
            path: "a".into(),
            first_point: 0,
            point_count: points,
            record_count: points as u64,
            dropped_records: Default::default(),
        }];
        Cloud::new(ScanFrame::local(), positions, Attributes::default(), sources, Vec::new()).unwrap()
    }

    #[test]
    fn half_of_a_file_is_told_from_the_whole() {
        let place = tempfile::tempdir().unwrap();
        for name in ["a.las", "a.laz", "a.ply"] {
            let path = place.path().join(name);
            crate::io::write_cloud(&cloud(3000), None, &path).unwrap();
            let whole = announce(&path).unwrap();
            assert_eq!((whole.points, whole.counted), (3000, true), "{name}");
            let bytes = fs::read(&path).unwrap();
            for share in [0.2, 0.5, 0.99] {
                let cut = place.path().join(format!("cut-{name}"));
                fs::write(&cut, &bytes[..(bytes.len() as f64 * share) as usize]).unwrap();
                let error = announce(&cut).unwrap_err().to_string();
                assert!(error.contains(name) && error.contains("copy"), "{share}: {error}");
            }
        }
    }

    #[test]
    fn an_e57_states_its_length() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("a.e57");
        let mut head = b"ASTM-E57".to_vec();
        head.extend([1u32, 0].iter().flat_map(|v| v.to_le_bytes()));
        head.extend([4096u64, 48, 100, 1024].iter().flat_map(|v| v.to_le_bytes()));
        head.resize(2048, 0);
        fs::write(&path, head).unwrap();
        assert!(announce(&path).unwrap_err().to_string().contains("4096 bytes"));
    }

    #[test]
    fn lines_of_text_are_estimated() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("a.xyz");
        for end in ["\n", "\r\n", "\r"] {
            fs::write(&path, format!("1.000 2.000 3.000{end}").repeat(10_000)).unwrap();
            let told = announce(&path).unwrap();
            assert!(!told.counted && told.points.abs_diff(10_000) < 100, "{told:?}");
        }
    }
}
