//! What other programs make of the formats.

use super::formats::{PTX, in_scan, mesh, read_bytes, scan, station};
use super::*;

fn utf16(text: &str, big_endian: bool) -> Vec<u8> {
    let units = "\u{feff}".encode_utf16().chain(text.encode_utf16());
    units.flat_map(|u| if big_endian { u.to_be_bytes() } else { u.to_le_bytes() }).collect()
}

#[test]
fn texts_in_utf16_and_with_lone_carriage_returns_are_the_same_scans() {
    let texts = [("a.csv", "X;Y;Z;I\r\n1,5;2;3;7\r\n4;5;6;8\r\n"), ("a.pts", "2\n1 2 3\n4 5 6\n"), ("a.ptx", PTX)];
    for (name, text) in texts {
        let (expected, _) = scan(name, text.as_bytes());
        let marked = ["\u{feff}", text].concat().into_bytes();
        let returns = text.replace("\r\n", "\n").replace('\n', "\r").into_bytes();
        for bytes in [utf16(text, false), utf16(text, true), marked, returns, utf16(&text.replace('\n', "\r"), false)] {
            let (cloud, _) = scan(name, &bytes);
            assert_eq!(in_scan(&cloud), in_scan(&expected), "{name}");
            assert_eq!(cloud.attributes(), expected.attributes(), "{name}");
        }
    }
    let mut broken = utf16("1 2 3\n", false);
    broken.push(0x20);
    let error = read_bytes("a.txt", &broken, &Settings::default()).unwrap_err().to_string();
    assert!(error.contains("UTF-16") && error.contains("does not decode"), "{error}");
}

#[test]
fn columns_of_words_stand_beside_the_coordinates() {
    let (cloud, summary) = scan("a.csv", b"code,x,y,z,surveyed\nwall,1,2,3,2024-01-01 10:00\nfloor,4,5,6,\n");
    assert_eq!(in_scan(&cloud), [Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 5.0, 6.0)]);
    assert!(summary.warnings.iter().all(|w| w.code != "skipped-lines"), "{:?}", summary.warnings);
    // A value that is missing in the first line is no missing column.
    let (cloud, _) = scan("a.csv", b"x,y,z,intensity,\n1,2,3,,\n4,5,6,7,\n");
    assert_eq!(cloud.attributes().intensities.as_deref(), Some(&[0, 7][..]));
    let error =
        read_bytes("a.csv", b"code,x,y,z\na,1,2,3\nb,4,five,6\n", &Settings::default()).unwrap_err().to_string();
    assert!(error.contains("line 3: 'five' is not a number"), "{error}");
}

#[test]
fn a_line_that_is_neither_header_nor_numbers_is_told() {
    let (cloud, summary) = scan("a.txt", b"1.234,5;2;3\n4;5;6\n7;8;9\n");
    assert_eq!(cloud.len(), 2);
    let told = summary.warnings.iter().find(|w| w.code == "skipped-lines").unwrap();
    assert!(told.message.contains("1.234,5;2;3"), "{}", told.message);
    // Exponents of Fortran are numbers.
    assert_eq!(scan("a.txt", b"1.0D+01 2.0 3.0\n4 5 6\n").0.len(), 2);
}

#[test]
fn longitude_and_latitude_are_refused_like_any_degrees() {
    let error = read_bytes("a.csv", b"lat,lon,alt\n46.1,7.1,500\n46.2,7.2,501\n", &Settings::default()).unwrap_err();
    assert!(error.to_string().contains("degrees"), "{error}");
}

/// The header of a PTX scan of two points with the points behind it.
fn ptx(points: &str) -> Vec<u8> {
    format!("\n1\n2\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n5 5 5 1\n{points}").into_bytes()
}

#[test]
fn ptx_lines_of_three_to_ten_numbers() {
    for (points, attributes) in [
        ("1 2 3\n4 5 6\n", &["station"][..]),
        ("1 2 3 0.5\n4 5 6 0.6\n", &["intensity", "station"]),
        ("1 2 3 10 20 30\n4 5 6 0 255 7", &["color", "station"]),
        ("1 2 3 0.5 10 20 30\n4 5 6 0.6 0 255 7\n", &["color", "intensity", "station"]),
    ] {
        let (cloud, summary) = scan("a.ptx", &ptx(points));
        assert_eq!(in_scan(&cloud), [Vec3::new(6.0, 7.0, 8.0), Vec3::new(9.0, 10.0, 11.0)], "{points}");
        assert_eq!(summary.attributes, attributes, "{points}");
        assert!(summary.warnings.iter().all(|w| w.code != "unknown-columns"), "{points}");
    }
    let (_, summary) = scan("a.ptx", &ptx("1 2 3 .5 10 20 30 0 0 1\n4 5 6 .6 0 255 7 0 0 1\n"));
    assert!(summary.warnings.iter().any(|w| w.code == "unknown-columns"));
    let error = read_bytes("a.ptx", &ptx("1 2 3 0.5 20 30\n4 5 6 0.5 2 3\n"), &Settings::default()).unwrap_err();
    assert!(error.kind() == ErrorKind::Unsupported && error.to_string().contains("6 numbers"), "{error}");
}

#[test]
fn ptx_scans_with_and_without_colours_become_one_cloud() {
    let text = [ptx("1 2 3 0.5\n4 5 6 0.6\n"), ptx("1 2 3 10 20 30\n4 5 6 0 255 7\n")].concat();
    let (cloud, summary) = scan("a.ptx", text.trim_ascii_start());
    let attributes = cloud.attributes();
    assert_eq!(attributes.colors.as_deref().unwrap()[..3], [[0x8080; 3], [0x8080; 3], [2570, 5140, 7710]]);
    let intensities = attributes.intensities.as_deref().unwrap();
    assert!(intensities[0] > 0 && intensities[1] > intensities[0] && intensities[2..] == [0, 0], "{intensities:?}");
    let mixed: Vec<&str> =
        summary.warnings.iter().filter(|w| w.code == "mixed-attributes").map(|w| w.message.as_str()).collect();
    assert!(mixed.len() == 2 && mixed[0].contains("scan 2") && mixed[1].contains("mid grey"), "{mixed:?}");
}

#[test]
fn pcd_headers_that_disagree_are_told() {
    let header = "VERSION .6\nCOLUMNS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 7\nHEIGHT 3\nVIEWPOINT nan 0 0\nPOINTS 2\n";
    let (cloud, summary) = scan("a.pcd", format!("{header}DATA ascii\n1 2 3\n4 5 6\n").as_bytes());
    assert_eq!((cloud.len(), cloud.stations().len()), (2, 0));
    assert_eq!(summary.warnings.iter().filter(|w| w.code == "pcd-header").count(), 2, "{:?}", summary.warnings);
}

/// A scan without a pose is a station all the same; where it was seen from is not known.
#[test]
fn e57_scans_without_poses_are_stations_without_a_place() {
    use ::e57::{E57Writer, Record, RecordValue};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.e57");
    let mut writer = E57Writer::from_file(&path, "file").unwrap();
    for scan in ["one", "two"] {
        let prototype = vec![Record::CARTESIAN_X_F64, Record::CARTESIAN_Y_F64, Record::CARTESIAN_Z_F64];
        let mut points = writer.add_pointcloud(scan, prototype).unwrap();
        points.add_point([1.0, 2.0, 3.0].map(RecordValue::Double).to_vec()).unwrap();
        points.finalize().unwrap();
    }
    writer.finalize().unwrap();
    let (cloud, summary) = read(&path);
    assert_eq!(cloud.attributes().station_ids.as_deref(), Some(&[0, 1][..]));
    assert_eq!((cloud.stations().len(), cloud.stations()[1].position_in_local, summary.stations), (2, None, 0));
    assert_eq!(read_stations(&path, &Settings::default()).unwrap().len(), 2);
}

/// Floating point intensities and colours may go without limits; the decoder makes zeros of them.
#[test]
fn e57_values_without_limits_keep_their_ratios() {
    use ::e57::{E57Writer, Record, RecordDataType, RecordName, RecordValue};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.e57");
    let free = RecordDataType::Double { min: None, max: None };
    let mut prototype = vec![Record::CARTESIAN_X_F64, Record::CARTESIAN_Y_F64, Record::CARTESIAN_Z_F64];
    prototype.extend(
        [RecordName::Intensity, RecordName::ColorRed, RecordName::ColorGreen, RecordName::ColorBlue]
            .map(|name| Record { name, data_type: free.clone() }),
    );
    let mut writer = E57Writer::from_file(&path, "file").unwrap();
    let mut points = writer.add_pointcloud("scan", prototype).unwrap();
    for (intensity, red) in [(-30.0, 255.0), (-10.0, 0.0), (10.0, 51.0)] {
        points.add_point([1.0, 2.0, 3.0, intensity, red, 0.0, 102.0].map(RecordValue::Double).to_vec()).unwrap();
    }
    points.finalize().unwrap();
    writer.finalize().unwrap();
    let (cloud, summary) = read(&path);
    assert_eq!(cloud.attributes().intensities.as_deref(), Some(&[0, 32_768, 65_535][..]));
    let colors = cloud.attributes().colors.as_deref().unwrap();
    assert_eq!(colors, [[65_535, 0, 26_214], [0, 0, 26_214], [13_107, 0, 26_214]]);
    assert!(summary.warnings.iter().any(|w| w.code == "intensity-range"), "{:?}", summary.warnings);
}

#[test]
fn an_e57_scan_without_colours_is_grey_beside_one_with_colours() {
    use ::e57::{E57Writer, Record, RecordValue};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.e57");
    let mut writer = E57Writer::from_file(&path, "file").unwrap();
    let place = vec![Record::CARTESIAN_X_F64, Record::CARTESIAN_Y_F64, Record::CARTESIAN_Z_F64];
    let colored = [place.clone(), vec![Record::COLOR_RED_U8, Record::COLOR_GREEN_U8, Record::COLOR_BLUE_U8]].concat();
    for (prototype, color) in [(colored, vec![255, 0, 51]), (place, vec![])] {
        let mut points = writer.add_pointcloud("scan", prototype).unwrap();
        let place = [1.0, 2.0, 3.0].map(RecordValue::Double).to_vec();
        points.add_point([place, color.into_iter().map(RecordValue::Integer).collect()].concat()).unwrap();
        points.finalize().unwrap();
    }
    writer.finalize().unwrap();
    let (cloud, summary) = read(&path);
    assert_eq!(cloud.attributes().colors.as_deref(), Some(&[[65_535, 0, 13_107], [0x8080; 3]][..]));
    let told = summary.warnings.iter().find(|w| w.code == "mixed-attributes");
    assert!(told.is_some_and(|w| w.message.contains("scan 2")), "{:?}", summary.warnings);
}

/// A GLB with one primitive of `mode` over the corners of a square, shown by `copies` nodes.
fn glb(mode: u64, copies: usize) -> Vec<u8> {
    let nodes: Vec<usize> = (0..copies).collect();
    let json = serde_json::json!({
        "asset": { "version": "2.0" },
        "scenes": [{ "nodes": nodes }],
        "nodes": vec![serde_json::json!({ "mesh": 0 }); copies],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "mode": mode }] }],
        "accessors": [{ "bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3" }],
        "bufferViews": [{ "buffer": 0, "byteLength": 48 }],
        "buffers": [{ "byteLength": 48 }],
    });
    let mut json = json.to_string();
    while !json.len().is_multiple_of(4) {
        json.push(' ');
    }
    let corners = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
    let data: Vec<u8> = corners.iter().flatten().flat_map(|c| c.to_le_bytes()).collect();
    let size = |n: usize| (n as u32).to_le_bytes();
    [&b"glTF\x02\0\0\0\0\0\0\0"[..], &size(json.len()), b"JSON", json.as_bytes(), &size(48), b"BIN\0", &data].concat()
}

#[test]
fn glb_strips_and_fans_are_triangles() {
    let (strip, _) = mesh("a.glb", &glb(5, 1)).unwrap();
    assert_eq!(strip.faces, [[0, 1, 2], [1, 3, 2]]);
    let (fan, _) = mesh("a.glb", &glb(6, 1)).unwrap();
    assert_eq!(fan.faces, [[1, 2, 0], [2, 3, 0]]);
}

#[test]
fn a_glb_that_shows_its_mesh_too_often_is_refused() {
    assert_eq!(mesh("a.glb", &glb(5, 64)).unwrap().0.faces.len(), 128);
    let error = mesh("a.glb", &glb(5, 65)).unwrap_err().to_string();
    assert!(error.contains("64 times"), "{error}");
}

/// Two stations of a rough tunnel in one PTX; the second lies 3 cm too high.
fn two_stations() -> Vec<u8> {
    let texts = [station(1, |p| p), station(2, |p| p + Vec3::new(0.0, 0.0, 0.03))];
    let scan = |text: &String| {
        let head =
            format!("1\n{}\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", text.lines().count());
        head + text
    };
    texts.iter().map(scan).collect::<String>().into_bytes()
}

#[test]
fn scans_in_one_file_are_stations_with_poses_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ptx");
    std::fs::write(&path, two_stations()).unwrap();
    let stations = read_stations(&path, &Settings::default()).unwrap();
    assert_eq!(stations.iter().map(|s| s.station).collect::<Vec<_>>(), [Some(1), Some(2)]);
    let (_, summary) = read(&path);
    let [pair] = &summary.overlaps[..] else { panic!("{:?}", summary.overlaps) };
    assert!(pair.overlap.median_m > 0.01, "{pair:?}");

    let poses = folder.path().join("poses.toml");
    let entry = |station, z| PoseEntry {
        file: "a.ptx".into(),
        station: Some(station),
        pose: Pose { rotation: crate::numeric::Mat3::identity(), translation: Vec3::new(0.0, 0.0, z) },
        remark: String::new(),
    };
    write_poses(&poses, &[entry(2, -0.03)]).unwrap();
    let settings = Settings { poses: Some(poses.clone()), ..Default::default() };
    let (cloud, summary) = read_cloud(std::slice::from_ref(&path), &settings).unwrap();
    assert!(summary.overlaps[0].overlap.median_m < 0.005, "{:?}", summary.overlaps);
    let z: Vec<f64> =
        cloud.stations().iter().map(|s| cloud.frame().scan_from_local(&s.position_in_local.unwrap()).z).collect();
    assert_eq!(z, [0.0, -0.03]);
    assert!((read_stations(&path, &settings).unwrap()[1].pose.translation.z + 0.03).abs() < 1e-12);

    write_poses(&poses, &[entry(3, 0.0)]).unwrap();
    let error = read_cloud(&[path], &settings).unwrap_err();
    assert!(error.kind() == ErrorKind::Settings && error.to_string().contains("station 3"), "{error}");
}
