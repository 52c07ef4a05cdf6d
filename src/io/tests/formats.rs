//! Every format reads what it says.

use super::*;

/// Writes `bytes` under `name` and reads them with `settings`.
pub(super) fn read_bytes(name: &str, bytes: &[u8], settings: &Settings) -> Result<(Cloud, Summary), Error> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    read_cloud(&[path], settings)
}

pub(super) fn scan(name: &str, bytes: &[u8]) -> (Cloud, Summary) {
    read_bytes(name, bytes, &Settings::default()).unwrap()
}

pub(super) fn mesh(name: &str, bytes: &[u8]) -> Result<(RawMesh, MeshSummary), Error> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    read_mesh(&path)
}

pub(super) fn in_scan(cloud: &Cloud) -> Vec<Vec3> {
    cloud.positions().iter().map(|p| cloud.frame().scan_from_local(p)).collect()
}

#[test]
fn text_with_header_and_labels() {
    let text = "//X;Y;Z;R;G;B;Scalar_Label\r\n1,5;2,5;3,5;255;0;10;4\r\n\r\n2,5;2,5;3,5;0;255;20;0\r\n";
    let (cloud, summary) = scan("a.csv", text.as_bytes());
    assert_eq!(in_scan(&cloud), [Vec3::new(1.5, 2.5, 3.5), Vec3::new(2.5, 2.5, 3.5)]);
    assert_eq!(cloud.attributes().labels.as_deref(), Some(&[4, 0][..]));
    assert_eq!(cloud.attributes().colors.as_deref(), Some(&[[65535, 0, 2570], [0, 65535, 5140]][..]));
    assert_eq!(summary.files[0].label_column.as_deref(), Some("Scalar_Label"));
}

#[test]
fn text_columns_can_be_set() {
    let settings =
        Settings { text_columns: Some(["skip", "z", "y", "x"].map(str::to_owned).to_vec()), ..Default::default() };
    let (cloud, _) = read_bytes("a.txt", b"9 3 2 1 7\n9 6 5 4 7\n", &settings).unwrap();
    assert_eq!(in_scan(&cloud), [Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 5.0, 6.0)]);
}

#[test]
fn a_bad_line_is_named() {
    let mut text = "0.5 1 2\n".repeat(200_000);
    text.push_str("1 2 drei\n");
    let error = read_bytes("a.xyz", text.as_bytes(), &Settings::default()).unwrap_err().to_string();
    assert!(error.contains("line 200001: 'drei' is not a number"), "{error}");
}

#[test]
fn pts_counts_are_checked() {
    let (cloud, _) = scan("a.pts", b"2\n1 2 3 -2048 255 0 0\n4 5 6 2047 0 255 0\n1\n7 8 9 0 0 0 255\n");
    assert_eq!(cloud.len(), 3);
    assert_eq!(cloud.attributes().intensities.as_ref().unwrap()[..2], [0, 65535]);
    let error = read_bytes("a.pts", b"3\n1 2 3 -2048 255 0 0\n", &Settings::default()).unwrap_err().to_string();
    assert!(error.contains("promises 3 points, but 1 follow"), "{error}");
}

pub(super) const PTX: &str = "2\n1\n10 0 0\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n1 0 0 0.5\n0 0 0 0.5\n\
                   1\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 5 1\n0 1 0 0.25\n";

#[test]
fn ptx_poses_and_lost_echoes() {
    let (cloud, summary) = scan("a.ptx", PTX.as_bytes());
    // The first matrix turns x into y (rows are images of the axes) and moves to (10, 20, 30).
    assert_eq!(in_scan(&cloud), [Vec3::new(10.0, 21.0, 30.0), Vec3::new(0.0, 1.0, 5.0)]);
    assert_eq!(cloud.sources()[0].dropped_records, [1].into_iter().collect());
    assert_eq!(cloud.attributes().station_ids.as_deref(), Some(&[0, 1][..]));
    assert_eq!(cloud.stations()[0].position_in_local, Some(Vec3::new(10.0, 20.0, 30.0)));
    assert_eq!(summary.files[0].dropped, 1);
}

#[test]
fn a_mirroring_ptx_matrix_is_reported() {
    let mirrored = PTX.replacen("0 1 0 0\n-1 0 0 0", "0 1 0 0\n1 0 0 0", 1);
    let (_, summary) = scan("a.ptx", mirrored.as_bytes());
    assert!(summary.warnings.iter().any(|w| w.code == "mirrored-axes"), "{:?}", summary.warnings);
}

pub(super) fn pcd(data: &str, body: &[u8]) -> Vec<u8> {
    let header = format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb label\nSIZE 4 4 4 4 2\nTYPE F F F U U\nCOUNT 1 1 1 1 1\nWIDTH 2\n\
         HEIGHT 1\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS 2\nDATA {data}\n"
    );
    [header.as_bytes(), body].concat()
}

#[test]
fn pcd_binary_and_compressed_agree() {
    let rows: [([f32; 3], u32, u16); 2] = [([1.0, 2.0, 3.0], 0x00ff_8000, 7), ([4.0, 5.0, 6.0], 0x0000_00ff, 9)];
    let mut binary = Vec::new();
    for (p, rgb, label) in rows {
        p.iter().for_each(|c| binary.extend_from_slice(&c.to_le_bytes()));
        binary.extend_from_slice(&rgb.to_le_bytes());
        binary.extend_from_slice(&label.to_le_bytes());
    }
    let mut columns = Vec::new();
    for axis in 0..3 {
        rows.iter().for_each(|r| columns.extend_from_slice(&r.0[axis].to_le_bytes()));
    }
    rows.iter().for_each(|r| columns.extend_from_slice(&r.1.to_le_bytes()));
    rows.iter().for_each(|r| columns.extend_from_slice(&r.2.to_le_bytes()));
    // Literal runs only, at most 32 bytes each.
    let mut packed = Vec::new();
    for run in columns.chunks(32) {
        packed.push(run.len() as u8 - 1);
        packed.extend_from_slice(run);
    }
    let sizes = [(packed.len() as u32).to_le_bytes(), (columns.len() as u32).to_le_bytes()].concat();
    let (a, _) = scan("a.pcd", &pcd("binary", &binary));
    let (b, _) = scan("a.pcd", &pcd("binary_compressed", &[sizes, packed].concat()));
    assert_eq!(in_scan(&a), [Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 5.0, 6.0)]);
    assert_eq!(a.attributes().colors.as_deref(), Some(&[[65535, 128 * 257, 0], [0, 0, 65535]][..]));
    assert_eq!(a.attributes().labels.as_deref(), Some(&[7, 9][..]));
    assert_eq!((a.positions(), a.attributes()), (b.positions(), b.attributes()));
    assert_eq!(a.stations()[0].position_in_local, Some(Vec3::new(1.0, 2.0, 3.0)));
}

#[test]
fn e57_poses_and_invalid_points() {
    use ::e57::{E57Writer, Quaternion, Record, RecordDataType, RecordName, RecordValue, Transform, Translation};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.e57");
    let mut writer = E57Writer::from_file(&path, "file").unwrap();
    let prototype = vec![
        Record::CARTESIAN_X_F64,
        Record::CARTESIAN_Y_F64,
        Record::CARTESIAN_Z_F64,
        Record { name: RecordName::CartesianInvalidState, data_type: RecordDataType::Integer { min: 0, max: 2 } },
    ];
    let mut points = writer.add_pointcloud("scan", prototype).unwrap();
    let half = std::f64::consts::FRAC_1_SQRT_2;
    points.set_transform(Some(Transform {
        rotation: Quaternion { w: half, x: 0.0, y: 0.0, z: half },
        translation: Translation { x: 100.0, y: 200.0, z: 300.0 },
    }));
    for (x, state) in [(1.0, 0), (0.0, 2), (2.0, 0)] {
        let coordinate = [x, 0.0, 0.0].map(RecordValue::Double);
        points.add_point([&coordinate[..], &[RecordValue::Integer(state)]].concat()).unwrap();
    }
    points.finalize().unwrap();
    writer.finalize().unwrap();
    let (cloud, summary) = read(&path);
    // A quarter turn about z takes x to y.
    for (p, expected) in in_scan(&cloud).iter().zip([Vec3::new(100.0, 201.0, 300.0), Vec3::new(100.0, 202.0, 300.0)]) {
        assert!((p - expected).amax() < 1e-12, "{p}");
    }
    assert_eq!((cloud.len(), summary.files[0].dropped), (2, 1));
    assert_eq!(cloud.stations()[0].position_in_local, Some(Vec3::new(100.0, 200.0, 300.0)));
}

#[test]
fn ply_dialects() {
    let header = "ply\r\nformat binary_big_endian 1.0\r\ncomment caf\u{e9}\r\nobj_info x\r\nelement vertex 1\r\n\
                  property float64 x\r\nproperty\tfloat64 y\r\nproperty float64  z\r\nproperty uint8 diffuse_red\r\n\
                  property uint8 diffuse_green\r\nproperty uint8 diffuse_blue\r\nproperty float scalar_fracture\r\n\
                  end_header\r\n";
    let mut bytes = header.as_bytes().to_vec();
    for c in [1.5f64, -2.5, 3e7] {
        bytes.extend_from_slice(&c.to_be_bytes());
    }
    bytes.extend_from_slice(&[255, 1, 0]);
    bytes.extend_from_slice(&3.0f32.to_be_bytes());
    let (cloud, _) = scan("a.ply", &bytes);
    assert_eq!(in_scan(&cloud), [Vec3::new(1.5, -2.5, 3e7)]);
    assert_eq!(cloud.attributes().colors.as_deref(), Some(&[[65535, 257, 0]][..]));
    assert_eq!(cloud.attributes().labels.as_deref(), Some(&[3][..]));
}

#[test]
fn ply_text_with_lists_keeps_them_when_lifted() {
    let folder = tempfile::tempdir().unwrap();
    let (from, to) = (folder.path().join("a.ply"), folder.path().join("b.ply"));
    let text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty list uchar int seen_by\n\
                property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n\
                1 2 8 9 2 3\n4 0 5 6\n3 0 1 0\n";
    std::fs::write(&from, text).unwrap();
    let (cloud, _) = read(&from);
    assert_eq!(in_scan(&cloud), [Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 5.0, 6.0)]);
    let columns = PointColumns {
        labels: &[7, 0],
        chainage: &[1.5, f64::NAN],
        girth: &[2.0, f64::NAN],
        offset: &[0.25, f64::NAN],
        surface_classes: None,
    };
    write_points(&cloud, &columns, &to).unwrap();
    let expected = text
        .replace(
            "z\nelement",
            "z\nproperty uint label\nproperty double chainage\nproperty double girth\nproperty double offset\nelement",
        )
        .replace("1 2 8 9 2 3\n4 0 5 6\n", "1 2 8 9 2 3 7 1.5 2 0.25\n4 0 5 6 0 nan nan nan\n");
    assert_eq!(std::fs::read_to_string(&to).unwrap(), expected);
    assert_eq!(read(&to).0.attributes().labels.as_deref(), Some(&[7, 0][..]));
}

#[test]
fn mesh_formats_agree() {
    let obj = "# cube side\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/1 2/2 3/3 -1/4\nvt 0 0\n";
    assert!(mesh("a.obj", obj.as_bytes()).unwrap_err().to_string().contains("texture coordinate"));
    let obj = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 -1/-1\n";
    let off = "OFF 4 1 0\n0 0 0\n1 0 0 # corner\n1 1 0\n0 1 0\n4 0 1 2 3\n";
    let stl = "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\nendloop\nendfacet\n\
               facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 1 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n";
    let (a, summary) = mesh("a.obj", obj.as_bytes()).unwrap();
    assert_eq!((a.vertices.len(), a.faces.as_slice()), (4, &[[0, 1, 2], [0, 2, 3]][..]));
    assert_eq!(summary.split_polygons, 1);
    assert_eq!(a.uv.as_ref().unwrap()[2], crate::numeric::Vec2::new(1.0, 1.0));
    for (name, text) in [("a.off", off), ("a.stl", stl)] {
        let (b, _) = mesh(name, text.as_bytes()).unwrap();
        assert_eq!((&b.vertices, &b.faces), (&a.vertices, &a.faces), "{name}");
    }
    let number = |n: f32| n.to_be_bytes();
    let count = |n: u32| n.to_be_bytes();
    let mut off = b"COFF BINARY\n".to_vec();
    off.extend([4, 1, 0].map(count).concat());
    for v in &a.vertices {
        off.extend([v.x as f32, v.y as f32, v.z as f32, 0.5, 0.5, 0.5, 1.0].map(number).concat());
    }
    off.extend([4, 0, 1, 2, 3, 1, 9].map(count).concat());
    let (b, _) = mesh("a.off", &off).unwrap();
    assert_eq!((&b.vertices, &b.faces), (&a.vertices, &a.faces), "binary");
    for cut in [off.len() - 1, 30] {
        assert!(mesh("a.off", &off[..cut]).unwrap_err().to_string().contains("ends too early"), "{cut}");
    }
    let (_, summary) = mesh("a.off", &[&off[..], b"12345"].concat()).unwrap();
    assert!(summary.warnings.iter().any(|w| w.code == "trailing-bytes" && w.message.starts_with("5 bytes")));
    let last = off.len() - 12;
    off[last..last + 4].copy_from_slice(&count(4));
    assert!(mesh("a.off", &off).is_err());
}

#[test]
fn binary_stl_and_glb() {
    let corners = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let mut stl = vec![b' '; 80];
    stl.extend_from_slice(&1u32.to_le_bytes());
    stl.extend_from_slice(&[0; 12]);
    corners.iter().flatten().for_each(|c| stl.extend_from_slice(&c.to_le_bytes()));
    stl.extend_from_slice(&[0; 2]);
    let (a, _) = mesh("a.stl", &stl).unwrap();
    assert_eq!(a.vertices[2], Vec3::new(0.0, 1.0, 0.0));

    let mut json = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0,"translation":[0,5,0]}],
        "meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],"accessors":[{"bufferView":0,"componentType":5126,
        "count":3,"type":"VEC3"}],"bufferViews":[{"buffer":0,"byteLength":36}],"buffers":[{"byteLength":36}]}"#
        .to_owned();
    while !json.len().is_multiple_of(4) {
        json.push(' ');
    }
    let mut glb = b"glTF\x02\0\0\0\0\0\0\0".to_vec();
    glb.extend_from_slice(&(json.len() as u32).to_le_bytes());
    glb.extend_from_slice(b"JSON");
    glb.extend_from_slice(json.as_bytes());
    glb.extend_from_slice(&36u32.to_le_bytes());
    glb.extend_from_slice(b"BIN\0");
    corners.iter().flatten().for_each(|c| glb.extend_from_slice(&c.to_le_bytes()));
    let (b, summary) = mesh("a.glb", &glb).unwrap();
    // y up becomes z up: the node lifts by 5, and glTF's y is our z.
    assert_eq!(b.vertices, [Vec3::new(0.0, 0.0, 5.0), Vec3::new(1.0, 0.0, 5.0), Vec3::new(0.0, 0.0, 6.0)]);
    assert_eq!(summary.warnings[0].code, "y-up");
}

#[test]
fn poses_from_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let (scan, poses) = (folder.path().join("s1.xyz"), folder.path().join("poses.toml"));
    std::fs::write(&scan, "1 0 0\n2 0 0\n").unwrap();
    let pose = "[[scan]]\nfile = \"s1.xyz\"\npose = [[0.0, -1.0, 0.0, 500000.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]]\n";
    std::fs::write(&poses, pose).unwrap();
    let settings = Settings { poses: Some(poses.clone()), ..Default::default() };
    let (cloud, _) = read_cloud(std::slice::from_ref(&scan), &settings).unwrap();
    assert_eq!(in_scan(&cloud), [Vec3::new(500_000.0, 1.0, 2.0), Vec3::new(500_000.0, 2.0, 2.0)]);
    let station = cloud.frame().scan_from_local(&cloud.stations()[0].position_in_local.unwrap());
    assert_eq!(station, Vec3::new(500_000.0, 0.0, 2.0));
    std::fs::write(&poses, pose.replacen("-1.0", "1.0", 1)).unwrap();
    let error = read_cloud(&[scan], &settings).unwrap_err();
    assert!(error.to_string().contains("mirrors"), "{error}");
    assert_eq!(error.kind(), ErrorKind::Settings);
}

/// A rough tunnel along x as seen by one station, about itself.
pub(super) fn station(seed: u32, place: impl Fn(Vec3) -> Vec3) -> String {
    let random = |i: u32| {
        let mut h = u64::from(i).wrapping_add(u64::from(seed) << 33).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        h = (h ^ (h >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (h >> 12) as f64 / (1u64 << 52) as f64
    };
    (0..30_000u32)
        .map(|i| {
            let (x, a) = (random(3 * i) * 10.0, random(3 * i + 1) * std::f64::consts::TAU);
            let waves = (x * 1.7 + (2.0 * a).sin()).sin() + (x * 3.1).cos() * (3.0 * a).sin();
            let r = 2.5 + 0.08 * waves;
            let p = place(Vec3::new(x, r * a.cos(), r * a.sin()));
            format!("{:.5} {:.5} {:.5}\n", p.x, p.y, p.z)
        })
        .collect()
}

#[test]
fn residuals_between_stations_and_points_that_a_pose_moves() {
    let folder = tempfile::tempdir().unwrap();
    let far = Vec3::new(600_000.0, 6_000_000.0, 100.0);
    let texts = [station(1, |p| p), station(2, |p| p + Vec3::new(0.0, 0.0, 0.03))];
    let mut paths = Vec::new();
    for (name, text) in ["s1", "s2"].iter().zip(texts) {
        let (from, to) = (folder.path().join(format!("{name}.xyz")), folder.path().join(format!("{name}.laz")));
        std::fs::write(&from, text).unwrap();
        write_cloud(&read(&from).0, None, &to).unwrap();
        paths.push(to);
    }
    let (_, summary) = read_cloud(&paths, &Settings::default()).unwrap();
    let [pair] = &summary.overlaps[..] else { panic!("{:?}", summary.overlaps) };
    assert!(pair.overlap.median_m > 0.01, "{pair:?}");
    assert!(summary.warnings.iter().any(|w| w.code == "station-overlap"));

    // The pose takes the lift of 3 cm back, and both far away.
    let poses = folder.path().join("poses.toml");
    let pose = |z| Pose { rotation: crate::numeric::Mat3::identity(), translation: far + Vec3::new(0.0, 0.0, z) };
    let scans = [("s1.laz", 0.0), ("s2.laz", -0.03)].map(|(file, z)| PoseEntry {
        file: file.into(),
        station: None,
        pose: pose(z),
        remark: "a remark".to_owned(),
    });
    write_poses(&poses, &scans).unwrap();
    let settings = Settings { poses: Some(poses), ..Default::default() };
    let (cloud, summary) = read_cloud(&paths, &settings).unwrap();
    assert!(summary.overlaps[0].overlap.median_m < 0.005, "{:?}", summary.overlaps);
    let (labels, [a, b, c]) = columns(cloud.len());
    let to = folder.path().join("both.laz");
    let columns = PointColumns { labels: &labels, chainage: &a, girth: &b, offset: &c, surface_classes: None };
    let written = write_points(&cloud, &columns, &to).unwrap();
    assert_eq!(written.warnings.iter().filter(|w| w.code == "placed-points").count(), 2, "{:?}", written.warnings);
    let (back, _) = read(&to);
    for (p, q) in cloud.positions().iter().zip(back.positions()) {
        let (p, q) = (cloud.frame().scan_from_local(p), back.frame().scan_from_local(q));
        assert!((p - q).amax() < 1e-4, "{p} {q}");
    }
}

#[test]
fn pcd_text_with_packed_colours_and_vectors() {
    let text = "VERSION .7\nFIELDS x y z rgb normal\nSIZE 4 4 4 4 4\nTYPE F F F F F\nCOUNT 1 1 1 1 3\nWIDTH 2\nHEIGHT 1\n\
                POINTS 2\nDATA ascii\n1 2 3 2.3418052e-38 0 0 1\nnan 5 6 0 0 0 1\n";
    let (cloud, summary) = scan("a.pcd", text.as_bytes());
    // The bits of that number are 0x00ff0000.
    assert_eq!(cloud.attributes().colors.as_deref(), Some(&[[65535, 0, 0]][..]));
    assert_eq!(summary.files[0].dropped, 1);
    let unsigned = text.replacen("TYPE F F F F F", "TYPE F F F U F", 1).replace("2.3418052e-38", "16711680");
    assert_eq!(scan("a.pcd", unsigned.as_bytes()).0.attributes().colors, cloud.attributes().colors);
    let error = read_bytes("a.pcd", text.replace("6 0 0 0 1\n", "6\n").as_bytes(), &Settings::default());
    assert!(error.unwrap_err().to_string().contains("line 11: fewer numbers"));
}

#[test]
fn mesh_dialects() {
    let continued = mesh("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 \\\n3\n").unwrap().0;
    assert_eq!(continued.faces, [[0, 1, 2]]);
    let bare = mesh("a.off", b"3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n").unwrap().0;
    assert_eq!((bare.vertices, bare.faces), (continued.vertices, continued.faces));
    let upper =
        b"SOLID A\nFACET NORMAL 0 0 1\nOUTER LOOP\nVERTEX 0 0 0\nVERTEX 1 0 0\nVERTEX 0 1 0\nENDLOOP\nENDFACET\n";
    assert_eq!(mesh("a.stl", upper).unwrap().0.faces.len(), 1);
    let mut binary = vec![b' '; 80];
    binary.extend_from_slice(&1u32.to_le_bytes());
    binary.extend_from_slice(&[0; 12]);
    [0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].iter().for_each(|c| binary.extend_from_slice(&c.to_le_bytes()));
    binary.extend_from_slice(&[0; 5]);
    let (read, summary) = mesh("a.stl", &binary).unwrap();
    assert_eq!((read.faces.len(), summary.warnings[0].code.as_str()), (1, "trailing-bytes"));
}
