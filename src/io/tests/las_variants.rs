//! Files that Adit does not write itself: every version with every point format, extra bytes of every type, waveform
//! and extended records, several chunk forms of LAZ. Made here byte by byte, so that nothing comes from elsewhere.

use super::*;
use crate::io::{ScanBox, stream_positions};

/// Bytes of a record of each point format.
const LENGTHS: [usize; 11] = [20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67];

/// What a made file has.
#[derive(Clone, Copy)]
pub(super) struct Made {
    minor: u8,
    format: u8,
    points: usize,
    /// Types of the extra bytes, by their codes.
    extra: &'static [u8],
    scale: [f64; 3],
    extended_records: bool,
}

impl Made {
    /// The same with coordinates in other steps.
    pub(super) fn in_steps(self, step: f64) -> Self {
        Self { scale: [step; 3], ..self }
    }

    pub(super) fn new(minor: u8, format: u8, points: usize) -> Self {
        Self { minor, format, points, extra: &[], scale: [0.001, 0.002, 0.0005], extended_records: false }
    }

    fn extra_size(code: u8) -> usize {
        let scalar = |c| [1, 1, 2, 2, 4, 4, 8, 8, 4, 8][usize::from(c - 1)];
        match code {
            0 => 3,
            c => scalar((c - 1) % 10 + 1) * (usize::from(c - 1) / 10 + 1),
        }
    }

    fn record_len(&self) -> usize {
        LENGTHS[usize::from(self.format)] + self.extra.iter().map(|&c| Self::extra_size(c)).sum::<usize>()
    }

    /// Bytes of record `i`: coordinates that mean something, the rest a pattern.
    fn record(&self, i: usize) -> Vec<u8> {
        let mut record: Vec<u8> = (0..self.record_len()).map(|b| (b * 31 + i * 7) as u8).collect();
        for (axis, raw) in self.raw(i).into_iter().enumerate() {
            record[4 * axis..4 * axis + 4].copy_from_slice(&raw.to_le_bytes());
        }
        // A return number that exists: 1 of 2.
        record[14] = if self.format < 6 { 0x11 } else { 0x21 };
        record
    }

    fn raw(&self, i: usize) -> [i32; 3] {
        [i as i32 * 100 - 50, (i % 17) as i32 * 250, -((i % 23) as i32)]
    }

    pub(super) fn position(&self, i: usize) -> Vec3 {
        Vec3::from_fn(|axis, _| f64::from(self.raw(i)[axis]) * self.scale[axis] + [1000.0, 2000.0, -5.0][axis])
    }

    fn bytes(&self) -> Vec<u8> {
        let header_len: usize = match self.minor {
            4 => 375,
            3 => 235,
            _ => 227,
        };
        let mut vlrs = Vec::new();
        let vlr = |user: &str, id: u16, data: &[u8]| {
            let mut v = vec![0u8; 54];
            v[2..2 + user.len()].copy_from_slice(user.as_bytes());
            v[18..20].copy_from_slice(&id.to_le_bytes());
            v[20..22].copy_from_slice(&(data.len() as u16).to_le_bytes());
            v[22..31].copy_from_slice(b"test data");
            v.extend_from_slice(data);
            v
        };
        let mut count = 1u32;
        vlrs.extend(vlr("someone", 77, b"kept as it is"));
        if !self.extra.is_empty() {
            let mut descriptors = Vec::new();
            for (k, &code) in self.extra.iter().enumerate() {
                let mut d = vec![0u8; 192];
                d[2] = code;
                d[3] = if code == 0 { 3 } else { 0 };
                d[4..10].copy_from_slice(format!("extra{}", k % 10).as_bytes());
                d[10] = b'a' + (k / 10) as u8;
                descriptors.extend(d);
            }
            vlrs.extend(vlr("LASF_Spec", 4, &descriptors));
            count += 1;
        }
        let points_at = header_len + vlrs.len();
        let mut h = vec![0u8; header_len];
        h[..4].copy_from_slice(b"LASF");
        h[4..6].copy_from_slice(&7u16.to_le_bytes());
        h[8..24].copy_from_slice(b"a-guid-of-16-byt");
        (h[24], h[25]) = (1, self.minor);
        h[26..31].copy_from_slice(b"maker");
        h[58..66].copy_from_slice(b"software");
        h[90..92].copy_from_slice(&200u16.to_le_bytes());
        h[92..94].copy_from_slice(&2021u16.to_le_bytes());
        h[94..96].copy_from_slice(&(header_len as u16).to_le_bytes());
        h[96..100].copy_from_slice(&(points_at as u32).to_le_bytes());
        h[100..104].copy_from_slice(&count.to_le_bytes());
        h[104] = self.format;
        h[105..107].copy_from_slice(&(self.record_len() as u16).to_le_bytes());
        if self.format < 6 {
            h[107..111].copy_from_slice(&(self.points as u32).to_le_bytes());
            h[111..115].copy_from_slice(&(self.points as u32).to_le_bytes());
        }
        let mut box_of = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
        for i in 0..self.points {
            for axis in 0..3 {
                let c = self.position(i)[axis];
                box_of[axis] = [box_of[axis][0].min(c), box_of[axis][1].max(c)];
            }
        }
        for axis in 0..3 {
            h[131 + 8 * axis..139 + 8 * axis].copy_from_slice(&self.scale[axis].to_le_bytes());
            h[155 + 8 * axis..163 + 8 * axis].copy_from_slice(&[1000.0f64, 2000.0, -5.0][axis].to_le_bytes());
            let [low, high] = if self.points > 0 { box_of[axis] } else { [0.0; 2] };
            h[179 + 16 * axis..187 + 16 * axis].copy_from_slice(&high.to_le_bytes());
            h[187 + 16 * axis..195 + 16 * axis].copy_from_slice(&low.to_le_bytes());
        }
        if self.minor == 4 {
            h[247..255].copy_from_slice(&(self.points as u64).to_le_bytes());
            h[255..263].copy_from_slice(&(self.points as u64).to_le_bytes());
        }
        let mut bytes = [h, vlrs].concat();
        (0..self.points).for_each(|i| bytes.extend(self.record(i)));
        if self.extended_records {
            let at = bytes.len() as u64;
            bytes[235..243].copy_from_slice(&at.to_le_bytes());
            bytes[243..247].copy_from_slice(&2u32.to_le_bytes());
            // Waveform data packets, which the header points to, and one of somebody else.
            for (user, id, data) in [("LASF_Spec", 65_535u16, &[1u8, 2, 3, 4, 5][..]), ("other", 9, b"tail")] {
                let mut v = vec![0u8; 60];
                v[2..2 + user.len()].copy_from_slice(user.as_bytes());
                v[18..20].copy_from_slice(&id.to_le_bytes());
                v[20..28].copy_from_slice(&(data.len() as u64).to_le_bytes());
                bytes.extend(v);
                bytes.extend(data);
            }
            bytes[227..235].copy_from_slice(&at.to_le_bytes());
            // Internal waveform packets.
            bytes[6] |= 2;
        }
        bytes
    }
}

/// Every version with the point formats that it may hold.
fn all_versions() -> Vec<Made> {
    let formats = [0..=1, 0..=1, 0..=3, 0..=5, 0..=10];
    (0..=4u8).flat_map(|minor| formats[usize::from(minor)].clone().map(move |f| Made::new(minor, f, 41))).collect()
}

fn write_and_read(made: &Made, folder: &Path) -> (PathBuf, Cloud, Summary) {
    let path = folder.join(format!("made_1{}_{}.las", made.minor, made.format));
    std::fs::write(&path, made.bytes()).unwrap();
    let (cloud, summary) = read(&path);
    (path, cloud, summary)
}

fn lift_to(cloud: &Cloud, to: &Path) -> WriteSummary {
    let (labels, [a, b, c]) = columns(cloud.len());
    write_points(
        cloud,
        &PointColumns { labels: &labels, chainage: &a, girth: &b, offset: &c, surface_classes: None },
        to,
    )
    .unwrap()
}

#[test]
fn every_version_and_format_is_read_and_kept_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    for made in all_versions() {
        let name = format!("1.{} format {}", made.minor, made.format);
        let (path, cloud, summary) = write_and_read(&made, folder.path());
        assert_eq!(cloud.len(), made.points, "{name}");
        let odd: Vec<_> = summary.warnings.iter().filter(|w| w.code.starts_with("las-")).collect();
        assert!(odd.is_empty(), "{name}: {odd:?}");
        for i in 0..made.points {
            let p = cloud.frame().scan_from_local(&cloud.positions()[i]);
            assert!((p - made.position(i)).amax() < 1e-9, "{name} point {i}: {p}");
        }
        assert_eq!(cloud.attributes().colors.is_some(), ![0, 1, 4, 6, 9].contains(&made.format), "{name}");
        let source = std::fs::read(&path).unwrap();
        for to in ["b.las", "b.laz"] {
            let to = folder.path().join(to);
            lift_to(&cloud, &to);
            // Through LAZ and back to plain records.
            let plain = folder.path().join("c.las");
            lift_to(&read(&to).0, &plain);
            let copy = std::fs::read(&plain).unwrap();
            let at = |b: &[u8]| u32::from_le_bytes(b[96..100].try_into().unwrap()) as usize;
            let len = |b: &[u8]| usize::from(u16::from_le_bytes([b[105], b[106]]));
            for i in 0..made.points {
                let (from, back) = (at(&source) + i * len(&source), at(&copy) + i * len(&copy));
                let kept = len(&source);
                assert_eq!(source[from..from + kept], copy[back..back + kept], "{name} record {i}");
            }
            // Version, identifiers, dates, scale, offset and box are those of the source.
            for range in [4..26, 26..96, 131..227] {
                assert_eq!(source[range.clone()], copy[range], "{name} header");
            }
        }
    }
}

#[test]
fn extra_bytes_of_every_type_survive() {
    static SCALARS: [u8; 11] = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 0];
    // The pairs and triples that LAS 1.4 R14 gave up.
    static TUPLES: [u8; 20] = [11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30];
    let folder = tempfile::tempdir().unwrap();
    for (format, extra) in [(1, &SCALARS[..]), (7, &SCALARS[..]), (3, &TUPLES[..]), (6, &TUPLES[..])] {
        let made = Made { extra, ..Made::new(4, format, 57) };
        let (path, cloud, _) = write_and_read(&made, folder.path());
        let info = inspect(&path, &Settings::default()).unwrap();
        let named = info.attributes.iter().filter(|a| a.name.starts_with("extra")).count();
        assert_eq!(named, extra.len());
        let ranged = info.attributes.iter().filter(|a| a.name.starts_with("extra") && a.min.is_some()).count();
        assert_eq!(ranged, if extra.len() == 11 { 10 } else { 0 }, "format {format}");
        let to = folder.path().join("lifted.laz");
        lift_to(&cloud, &to);
        let plain = folder.path().join("plain.las");
        lift_to(&read(&to).0, &plain);
        let (source, copy) = (std::fs::read(&path).unwrap(), std::fs::read(&plain).unwrap());
        let at = |b: &[u8]| u32::from_le_bytes(b[96..100].try_into().unwrap()) as usize;
        let len = made.record_len();
        for i in 0..made.points {
            let (from, back) = (at(&source) + i * len, at(&copy) + i * (len + 20));
            assert_eq!(source[from..from + len], copy[back..back + len], "format {format} record {i}");
        }
    }
}

#[test]
fn extended_records_and_waveforms_move_along() {
    let folder = tempfile::tempdir().unwrap();
    let made = Made { extended_records: true, ..Made::new(4, 9, 12) };
    let (path, cloud, _) = write_and_read(&made, folder.path());
    let to = folder.path().join("b.las");
    lift_to(&cloud, &to);
    let (source, copy) = (std::fs::read(&path).unwrap(), std::fs::read(&to).unwrap());
    let at = |b: &[u8]| u64::from_le_bytes(b[235..243].try_into().unwrap()) as usize;
    assert_eq!(source[at(&source)..], copy[at(&copy)..], "extended records");
    assert_eq!(source[243..247], copy[243..247]);
    let waveform = u64::from_le_bytes(copy[227..235].try_into().unwrap());
    assert_eq!(waveform as usize, at(&copy));
}

#[test]
fn files_without_points_are_described_and_not_used() {
    let folder = tempfile::tempdir().unwrap();
    for (minor, format) in [(0, 0), (2, 3), (3, 5), (4, 6), (4, 10)] {
        let path = folder.path().join("none.las");
        std::fs::write(&path, Made::new(minor, format, 0).bytes()).unwrap();
        let info = inspect(&path, &Settings::default()).unwrap();
        assert_eq!((info.points, info.usable), (0, false));
        assert!(read_cloud(&[path], &Settings::default()).unwrap_err().to_string().contains("no points"));
    }
}

#[test]
fn a_negative_scale_turns_the_axis_and_not_the_bounds() {
    let folder = tempfile::tempdir().unwrap();
    let made = Made { scale: [-0.001, 0.002, 0.0005], ..Made::new(2, 1, 30) };
    let (path, cloud, summary) = write_and_read(&made, folder.path());
    assert!(!summary.warnings.iter().any(|w| w.code == "las-bounding-box"), "{:?}", summary.warnings);
    assert!((cloud.frame().scan_from_local(&cloud.positions()[3]) - made.position(3)).amax() < 1e-9);
    let [low, high] = inspect(&path, &Settings::default()).unwrap().bounds.unwrap();
    assert!(low[0] < high[0]);
}

/// A LAZ file with the given LASzip record around the points of `made`.
pub(super) fn laz_of(made: &Made, vlr: laz::LazVlr, chunks: &[usize]) -> Vec<u8> {
    let plain = made.bytes();
    let points_at = u32::from_le_bytes(plain[96..100].try_into().unwrap()) as usize;
    let mut payload = Vec::new();
    vlr.write_to(&mut payload).unwrap();
    let mut bytes = plain[..points_at].to_vec();
    let mut record = vec![0u8; 54];
    record[2..17].copy_from_slice(b"laszip encoded\0");
    record[18..20].copy_from_slice(&22204u16.to_le_bytes());
    record[20..22].copy_from_slice(&(payload.len() as u16).to_le_bytes());
    bytes.extend(record);
    bytes.extend(payload);
    let at = bytes.len() as u32;
    bytes[96..100].copy_from_slice(&at.to_le_bytes());
    let vlrs = u32::from_le_bytes(bytes[100..104].try_into().unwrap()) + 1;
    bytes[100..104].copy_from_slice(&vlrs.to_le_bytes());
    bytes[104] |= 0x80;
    let mut out = std::io::Cursor::new(bytes);
    std::io::Seek::seek(&mut out, std::io::SeekFrom::End(0)).unwrap();
    let variable = vlr.uses_variable_size_chunks();
    let mut compressor = laz::LasZipCompressor::new(&mut out, vlr).unwrap();
    let mut next = 0;
    for (index, &count) in chunks.iter().enumerate() {
        for i in next..next + count {
            compressor.compress_one(&made.record(i)).unwrap();
        }
        next += count;
        if variable && index + 1 < chunks.len() {
            compressor.finish_current_chunk().unwrap();
        }
    }
    assert_eq!(next, made.points);
    compressor.done().unwrap();
    drop(compressor);
    out.into_inner()
}

#[test]
fn chunks_of_any_form_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.laz");
    let builder = |format: u8| laz::LazVlrBuilder::default().with_point_format(format, 0).unwrap();
    for format in [0, 1, 3, 6, 7, 8] {
        let made = Made::new(4, format, 301);
        let fixed = laz_of(&made, builder(format).with_fixed_chunk_size(100).build(), &[301]);
        let variable = laz_of(&made, builder(format).with_variable_chunk_size().build(), &[120, 1, 80, 100]);
        for (form, bytes) in [("fixed", fixed), ("variable", variable)] {
            std::fs::write(&path, bytes).unwrap();
            let (cloud, _) = read(&path);
            assert_eq!(cloud.len(), 301, "format {format} {form}");
            for i in 0..301 {
                let p = cloud.frame().scan_from_local(&cloud.positions()[i]);
                assert!((p - made.position(i)).amax() < 1e-9, "format {format} {form} point {i}");
            }
        }
    }
}

/// All positions of a file through the stream, scan coordinates.
pub(super) fn streamed(path: &Path, window: Option<&ScanBox>) -> Vec<Vec3> {
    let mut all = Vec::new();
    let count = stream_positions(path, &Settings::default(), window, &mut |batch, origin| {
        all.extend(batch.iter().map(|p| p + origin));
    });
    assert_eq!(count.unwrap(), all.len() as u64);
    all
}

#[test]
fn the_stream_gives_what_reading_gives() {
    let folder = tempfile::tempdir().unwrap();
    // More than one batch of each format.
    let cloud = cloud(1_200_001);
    for name in ["a.las", "a.laz", "a.ply"] {
        let path = folder.path().join(name);
        write_cloud(&cloud, None, &path).unwrap();
        let (whole, _) = read(&path);
        let expected: Vec<Vec3> = whole.positions().iter().map(|p| whole.frame().scan_from_local(p)).collect();
        let all = streamed(&path, None);
        assert_eq!(all.len(), expected.len(), "{name}");
        assert!(all.iter().zip(&expected).all(|(a, b)| (a - b).amax() < 1e-9), "{name}");
        // Off the grid of the coordinates, so that no point lies on a face.
        let low = expected[5].map(|c| c - 20.000_03);
        let window = ScanBox { low, high: low.add_scalar(40.0) };
        let inside: Vec<Vec3> = expected.iter().filter(|p| window.contains(p)).copied().collect();
        let part = streamed(&path, Some(&window));
        assert!(!part.is_empty() && part.len() < all.len(), "{name}");
        assert_eq!(part.len(), inside.len(), "{name}");
        let info = inspect(&path, &Settings::default()).unwrap();
        assert_eq!(info.points, 1_200_001, "{name}");
        let [low, high] = info.bounds.unwrap();
        let (lowest, highest) = crate::spatial::voxel_grid::bounds(&expected).unwrap();
        assert!((Vec3::from(low) - lowest).amax() < 1e-9 && (Vec3::from(high) - highest).amax() < 1e-9, "{name}");
    }
}
