//! Every guard fires on what it guards against, and not on a sound file.

use super::*;

/// A sound LAS file of `n` points as bytes.
fn las(n: usize) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    write_cloud(&cloud(n), None, &path).unwrap();
    std::fs::read(path).unwrap()
}

fn laz(n: usize) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.laz");
    write_cloud(&cloud(n), None, &path).unwrap();
    std::fs::read(path).unwrap()
}

fn with(mut bytes: Vec<u8>, at: usize, patch: &[u8]) -> Vec<u8> {
    bytes[at..at + patch.len()].copy_from_slice(patch);
    bytes
}

fn read_named(name: &str, bytes: &[u8]) -> Result<Summary, Error> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    read_cloud(&[path], &Settings::default()).map(|(_, summary)| summary)
}

fn refused(name: &str, bytes: &[u8], part: &str) {
    let error = read_named(name, bytes).expect_err(part);
    assert_eq!(error.kind(), ErrorKind::BadInput, "{error}");
    assert!(error.to_string().contains(part), "'{part}' is not in: {error}");
}

fn warned(name: &str, bytes: &[u8], code: &str) {
    let summary = read_named(name, bytes).unwrap();
    assert!(summary.warnings.iter().any(|w| w.code == code), "no {code}: {:?}", summary.warnings);
}

#[test]
fn a_sound_file_has_no_warnings() {
    assert_eq!(read_named("a.las", &las(500)).unwrap().warnings, vec![]);
}

#[test]
fn missing_and_empty_files() {
    let error = read_cloud(&[PathBuf::from("no/such.laz")], &Settings::default()).unwrap_err();
    assert!(error.to_string().contains("no/such.laz"), "{error}");
    assert_eq!(error.kind(), ErrorKind::BadInput);
    refused("a.laz", b"", "0 bytes");
    let unknown = read_named("a.dwg", b"AC1032").unwrap_err();
    assert_eq!(unknown.kind(), ErrorKind::Unsupported);
}

#[test]
fn scale_zero_or_not_a_number() {
    refused("a.las", &with(las(10), 131, &0f64.to_le_bytes()), "scale of x is 0");
    refused("a.las", &with(las(10), 139, &f64::NAN.to_le_bytes()), "scale of y is NaN");
    refused("a.las", &with(las(10), 155, &f64::INFINITY.to_le_bytes()), "offset of x is inf");
    refused("a.las", &with(las(10), 131, &1e300f64.to_le_bytes()), "overflows");
}

#[test]
fn counts_beyond_the_file() {
    let bytes = with(las(10), 247, &u64::MAX.to_le_bytes());
    refused("a.las", &bytes, "promises 18446744073709551615 records");
    let bytes = with(laz(10), 247, &u64::MAX.to_le_bytes());
    refused("a.laz", &bytes, "points cannot come from");
    // As many as could be true: the chunk table does not list them.
    let bytes = with(laz(10), 247, &100_000_000u64.to_le_bytes());
    assert!(read_named("a.laz", &bytes).is_err());
}

#[test]
fn a_smaller_count_than_there_are_records() {
    let bytes = with(with(las(10), 247, &7u64.to_le_bytes()), 107, &0u32.to_le_bytes());
    warned("a.las", &bytes, "las-point-count");
}

#[test]
fn record_length_and_points_outside() {
    refused("a.las", &with(las(10), 105, &20u16.to_le_bytes()), "records of 20 bytes cannot hold");
    refused("a.las", &with(las(10), 96, &u32::MAX.to_le_bytes()), "outside the file");
}

#[test]
fn absurd_variable_length_records() {
    warned("a.las", &with(las(10), 100, &u32::MAX.to_le_bytes()), "las-variable-length-records");
}

#[test]
fn a_wrong_bounding_box() {
    warned("a.las", &with(las(10), 179, &1e9f64.to_le_bytes()), "las-bounding-box");
    warned("a.las", &with(las(10), 187, &f64::NAN.to_le_bytes()), "las-bounding-box");
}

#[test]
fn truncated_laz() {
    let bytes = laz(1000);
    refused("a.laz", &bytes[..bytes.len() / 2], "chunk table");
    refused("a.laz", &bytes[..300], "bytes");
}

#[test]
fn points_at_zero_and_duplicates() {
    warned("a.xyz", b"0 0 0\n0.5 1 2\n1 2 3\n", "points-at-zero");
    let summary = read_named("a.xyz", b"0.5 1 2\n1 2 3\n0.5 1 2\n0.5 1 2\n").unwrap();
    assert_eq!(summary.files[0].guards.duplicates, 2);
    warned("a.xyz", b"0.5 1 2\n1 2 3\n0.5 1 2\n", "duplicate-points");
}

#[test]
fn points_that_are_no_numbers() {
    let summary = read_named("a.xyz", b"1 2 3\nnan 1 2\n4 5 inf\n5 6 7\n").unwrap();
    assert_eq!((summary.points, summary.files[0].dropped), (2, 2));
    assert_eq!(summary.warnings[0].code, "dropped-points");
    refused("a.xyz", b"1 2 nan\nnan 1 2\n", "none of its 2 records is a point");
}

#[test]
fn coordinates_that_went_through_f32() {
    // Northings of six million step by half a metre in single precision.
    let text = |quantise: bool| -> String {
        (0..500)
            .map(|i| {
                let y = 6_000_000.0 + f64::from(i) * 0.037;
                format!("{} {} 10.123\n", 100.0 + f64::from(i), if quantise { f64::from(y as f32) } else { y })
            })
            .collect()
    };
    warned("a.xyz", text(true).as_bytes(), "single-precision-coordinates");
    let sound = read_named("a.xyz", text(false).as_bytes()).unwrap();
    assert!(!sound.files[0].guards.single_precision_loss);
}

#[test]
fn f32_columns_far_from_the_origin() {
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
                  property float z\nend_header\n";
    let ply = |x: f32| {
        let mut bytes = header.as_bytes().to_vec();
        for c in [x, 1.0, 2.0, x + 1.0, 1.5, 2.5] {
            bytes.extend_from_slice(&c.to_le_bytes());
        }
        bytes
    };
    warned("a.ply", &ply(500_000.0), "single-precision-coordinates");
    assert_eq!(read_named("a.ply", &ply(5.0)).unwrap().warnings, vec![]);
}

#[test]
fn millimetres_are_guessed_and_can_be_set() {
    let text: String = (0..100).map(|i| format!("{} {} {}\n", i * 400, i % 7 * 700, i % 5 * 900)).collect();
    warned("a.xyz", text.as_bytes(), "unit-guess");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.xyz");
    std::fs::write(&path, text).unwrap();
    let settings = Settings { unit: Some(Unit::Millimetre), ..Default::default() };
    let (cloud, summary) = read_cloud(&[path], &settings).unwrap();
    assert!(((cloud.positions()[1] - cloud.positions()[0]).x - 0.4).abs() < 1e-12);
    assert!(!summary.warnings.iter().any(|w| w.code == "unit-guess"));
}

/// A tunnel along a rising bend, 5 units wide and high for `scale` 1, as text.
fn drift(scale: f64) -> String {
    (0..4000)
        .map(|i| {
            let (s, a) = (f64::from(i) * 0.01, f64::from(i) * 2.399_963);
            let across = (3.0 + 2.5 * a.cos(), 2.5 * a.sin() + s * 0.5);
            let (x, y) = (s * 2.0, across.0 + s * s * 0.01);
            format!("{:.4} {:.4} {:.4}\n", x * scale, y * scale, across.1 * scale)
        })
        .collect()
}

#[test]
fn units_are_guessed_from_the_height_of_the_drift() {
    assert_eq!(read_named("a.xyz", drift(1.0).as_bytes()).unwrap().warnings, vec![]);
    for (scale, name) in [(1000.0, "millimetre"), (100.0, "centimetre"), (4.5 / 0.3048, "foot")] {
        let summary = read_named("a.xyz", drift(scale).as_bytes()).unwrap();
        let guess = summary.warnings.iter().find(|w| w.code == "unit-guess").unwrap_or_else(|| panic!("{name}"));
        assert!(guess.message.contains(&format!("ingest.unit = \"{name}\"")), "{guess:?}");
    }
}

/// A LAS file that states a coordinate reference system.
fn las_with_crs(wkt: &str) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    let plain = cloud(10);
    let frame = ScanFrame { crs: Some(wkt.into()), ..plain.frame().clone() };
    let cloud =
        Cloud::new(frame, plain.positions().to_vec(), plain.attributes().clone(), plain.sources().to_vec(), vec![]);
    write_cloud(&cloud.unwrap(), None, &path).unwrap();
    std::fs::read(path).unwrap()
}

const DEGREES: &str = "GEOGCS[\"WGS 84\",DATUM[\"D\",SPHEROID[\"S\",6378137,298.2]],UNIT[\"degree\",0.0174]]";
const UTM: &str = "PROJCS[\"UTM\",GEOGCS[\"WGS 84\",UNIT[\"degree\",0.0174]],UNIT[\"metre\",1]]";
const FEET: &str = "PROJCS[\"state plane\",GEOGCS[\"NAD83\",UNIT[\"degree\",0.0174]],UNIT[\"foot\",0.3048]]";

#[test]
fn degrees_are_refused_with_the_remedy() {
    refused("a.las", &las_with_crs(DEGREES), "reproject");
    assert_eq!(read_named("a.las", &las_with_crs(UTM)).unwrap().crs.as_deref(), Some(UTM));
}

#[test]
fn feet_are_converted_and_that_is_said() {
    let summary = read_named("a.las", &las_with_crs(FEET)).unwrap();
    assert_eq!(summary.metres_per_unit, 0.3048);
    assert!(summary.warnings.iter().any(|w| w.code == "unit"));
}

#[test]
fn files_with_different_crs_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let paths = [("a.las", UTM), ("b.las", FEET)].map(|(name, crs)| {
        let path = folder.path().join(name);
        std::fs::write(&path, las_with_crs(crs)).unwrap();
        path
    });
    let error = read_cloud(&paths, &Settings::default()).unwrap_err().to_string();
    assert!(error.contains("differs from that of") && error.contains("b.las"), "{error}");
}

#[test]
fn zero_colours_and_intensities_are_absent() {
    let text = b"x y z r g b intensity\n1 2 3 0 0 0 0\n2 3 4 0 0 0 0\n";
    let summary = read_named("a.csv", text).unwrap();
    assert_eq!(summary.attributes, Vec::<&str>::new());
    let codes: Vec<&str> = summary.warnings.iter().map(|w| w.code.as_str()).collect();
    assert!(codes.contains(&"no-colors") && codes.contains(&"no-intensities"), "{codes:?}");
}

#[test]
fn eight_bit_colours_in_sixteen_bit_fields_are_scaled() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    let plain = cloud(10);
    let mut attributes = plain.attributes().clone();
    attributes.colors = Some(vec![[255, 128, 0]; 10]);
    let dark =
        Cloud::new(plain.frame().clone(), plain.positions().to_vec(), attributes, plain.sources().to_vec(), vec![]);
    write_cloud(&dark.unwrap(), None, &path).unwrap();
    let (back, summary) = read(&path);
    assert_eq!(back.attributes().colors.as_ref().unwrap()[0], [65535, 128 * 257, 0]);
    assert_eq!(summary.warnings[0].code, "eight-bit-colors");
}

#[test]
fn ply_counts_and_indices() {
    let huge = "ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\n\
                property float z\nend_header\n1 2 3\n";
    refused("a.ply", huge.as_bytes(), "need at least");
    let bare = "ply\nformat ascii 1.0\nelement vertex 999999999\nend_header\n";
    refused("a.ply", bare.as_bytes(), "0 properties");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let mesh = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n";
    std::fs::write(&path, mesh).unwrap();
    assert!(read_mesh(&path).unwrap_err().to_string().contains("face 0 names vertex 9"));
}

#[test]
fn damaged_laz_ends_in_an_error_or_points_never_in_a_panic() {
    let good = laz(3000);
    let points_at = u32::from_le_bytes(good[96..100].try_into().unwrap()) as usize;
    for i in 0..60 {
        let mut bytes = good.clone();
        let at = points_at + i * (good.len() - points_at) / 60;
        bytes[at] ^= 1 << (i % 8);
        // Either outcome is right; a panic or an endless loop is not.
        let _ = read_named("a.laz", &bytes);
    }
}

/// Found by fuzzing: a point that is called a colour made the decoder ask for 4 GB.
#[test]
fn laz_items_that_are_not_those_of_the_point_format_are_refused() {
    let good = laz(3000);
    let id = b"laszip encoded";
    let record = good.windows(id.len()).position(|w| w == id).unwrap() - 2;
    // Behind the 54 bytes of the record's head and the 34 before its items, of 6 bytes: type, size, version.
    let item = |k: usize| record + 54 + 34 + 6 * k;
    let point = [good[item(0)], good[item(0) + 1]];
    let color = 11u16.to_le_bytes();
    for (at, value, told) in [
        (item(0), color, "LASzip item 1 is RGB14 of 30 bytes"),
        (item(1), point, "LASzip item 2 is Point14 of 6 bytes"),
        (item(2), color, "LASzip item 3 is RGB14 of 4 bytes"),
    ] {
        let refusal = read_named("a.laz", &with(good.clone(), at, &value)).unwrap_err().to_string();
        assert!(refusal.contains(told), "{told}: {refusal}");
    }
}

#[test]
fn a_changed_source_is_not_rewritten() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    std::fs::write(&path, las(20)).unwrap();
    let (cloud, _) = read(&path);
    std::fs::write(&path, las(21)).unwrap();
    let (labels, [a, b, c]) = columns(20);
    let columns = PointColumns { labels: &labels, chainage: &a, girth: &b, offset: &c, surface_classes: None };
    let error = write_points(&cloud, &columns, &folder.path().join("b.las")).unwrap_err().to_string();
    assert!(error.contains("changed meanwhile"), "{error}");
}

#[test]
fn unwritable_destinations_are_named() {
    let error = write_cloud(&cloud(3), None, Path::new("no/such/folder/a.laz")).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Output);
    assert!(error.to_string().contains("no/such/folder/a.laz"), "{error}");
}

#[test]
fn info_shows_what_reading_refuses() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    std::fs::write(&path, las_with_crs(DEGREES)).unwrap();
    let info = inspect(&path, &Settings::default()).unwrap();
    assert!(!info.usable && info.points == 10);
    assert!(info.warnings.iter().any(|w| w.code == "degrees"));
    let bytes = las(100);
    std::fs::write(&path, &bytes[..bytes.len() - 30]).unwrap();
    let info = inspect(&path, &Settings::default()).unwrap();
    assert_eq!((info.usable, info.points), (false, 99));
}

/// Found by fuzzing: the bytes of a colour that occurs no time were looked for behind the last record.
#[test]
fn a_pcd_color_field_without_values_is_no_color() {
    let header = "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 0\nWIDTH 2\nHEIGHT 1\n\
                  POINTS 2\nDATA binary\n";
    let mut bytes = header.as_bytes().to_vec();
    bytes.extend([1.0f32, 2.0, 3.0, 4.0, 5.0, 7.0].iter().flat_map(|v| v.to_le_bytes()));
    let summary = read_named("a.pcd", &bytes).unwrap();
    assert_eq!(summary.points, 2);
    assert!(!summary.attributes.contains(&"color"));
}
