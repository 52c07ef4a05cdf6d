//! Sound small files to start from, written by Adit itself where it writes the format.

mod las;

use super::Target;
use adit::cloud::{Attributes, Cloud, ScanFrame, SourceFile};
use adit::io;
use adit::numeric::Vec3;
use std::path::Path;

/// The seeds of a target.
pub fn of(target: Target) -> Vec<Vec<u8>> {
    match target {
        Target::Las => [(40, true), (3, false), (1, true)]
            .into_iter()
            .map(|(n, all)| written("a.las", n, all))
            .chain(las::las())
            .collect(),
        Target::Laz => {
            let own = [(400, true), (60, false), (1, true)].into_iter().map(|(n, all)| written("a.laz", n, all));
            own.chain(las::laz()).collect()
        }
        Target::Ply => {
            let mut all = vec![written("a.ply", 20, true), written("a.ply", 2, false)];
            all.extend(texts(&[
                "ply\nformat ascii 1.0\ncomment c\nobj_info i\nelement vertex 3\nproperty float x\nproperty double y\n\
                 property list uchar int seen\nproperty int8 z\nproperty uchar diffuse_red\nproperty uchar diffuse_green\n\
                 property uchar diffuse_blue\nelement face 1\nproperty list uchar uint vertex_indices\nend_header\n\
                 1 2 1 5 3 1 2 3\n4 5 0 6 1 2 3\n7 8 2 1 2 9 1 2 3\n3 0 1 2\n",
                "ply\r\nformat ascii 1.0\r\nelement vertex 2\r\nproperty float x\r\nproperty float y\r\n\
                 property float z\r\nproperty float scalar_label\r\nend_header\r\n1 2 3 4\r\n4 5 6 nan\r\n",
                "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
                 element tristrips 1\nproperty list int int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n5 0 1 2 -1 3\n",
            ]));
            all.push(big_endian_ply());
            all
        }
        Target::E57 => vec![e57(false), e57(true)],
        Target::Ptx => texts(&[
            "2\n2\n10 0 0\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n1 0 0 0.5\n0 0 0 0.5\n1 1 1 0.1\n\
             2 2 2 0.9\n1\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 5 1\n0 1 0 0.25\n",
            "1\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 5 1\n0 1 0 0.25 1 2 3\n",
        ]),
        Target::Text => texts(&[
            "0.5 1 2\n1 2 3\n4 5 6\n",
            "//X;Y;Z;R;G;B;Scalar_Label\r\n1,5;2,5;3,5;255;0;10;4\r\n\r\n2,5;2,5;3,5;0;255;20;0\r\n",
            "x,y,z,intensity,classification\n1,2,3,0.5,2\n1e3,-2.5,3,nan,1\n",
            "2\n1 2 3 -2048 255 0 0\n4 5 6 2047 0 255 0\n1\n7 8 9 0 0 0 255\n",
        ]),
        Target::Pcd => pcd(),
        Target::Mesh => {
            let mut all = texts(&[
                "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 -1/-1\n",
                "COFF\n4 1 0\n0 0 0 1 1 1 1\n1 0 0 1 1 1 1 # corner\n1 1 0 0 0 0 0\n0 1 0 0 0 0 0\n4 0 1 2 3 255 0 0\n",
                "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\nendloop\nendfacet\nendsolid\n",
            ]);
            all.extend([stl(), glb()]);
            all
        }
    }
}

fn texts(list: &[&str]) -> Vec<Vec<u8>> {
    list.iter().map(|t| t.as_bytes().to_vec()).collect()
}

/// A small cloud through Adit's writer.
fn written(name: &str, n: usize, with_attributes: bool) -> Vec<u8> {
    let positions = (0..n).map(|i| Vec3::new(i as f64 * 0.25, (i * 7 % 11) as f64, 0.125)).collect();
    let column = |k: usize| (0..n).map(|i| (i * k % 60_000) as u16).collect::<Vec<u16>>();
    let attributes = if with_attributes {
        Attributes {
            colors: Some(column(91).into_iter().map(|c| [c, c / 2, 65_535 - c]).collect()),
            intensities: Some(column(1000)),
            classifications: Some((0..n).map(|i| (i % 30) as u8).collect()),
            labels: Some((0..n).map(|i| (i % 5) as u32).collect()),
            ..Default::default()
        }
    } else {
        Attributes::default()
    };
    let source = SourceFile {
        path: name.into(),
        first_point: 0,
        point_count: n,
        record_count: n as u64,
        dropped_records: Default::default(),
    };
    let frame = ScanFrame::with_origin(Vec3::new(244_300.0, 6_010_900.0, 0.0));
    let cloud = Cloud::new(frame, positions, attributes, vec![source], vec![]).expect("equal columns");
    in_file(name, |path| drop(io::write_cloud(&cloud, None, path).expect("a written scan")))
}

/// Lets `write` fill a file and takes its bytes.
fn in_file(name: &str, write: impl FnOnce(&Path)) -> Vec<u8> {
    let path = std::env::temp_dir().join(format!("adit-seed-{}-{name}", std::process::id()));
    write(&path);
    let bytes = std::fs::read(&path).expect("what was written");
    let _ = std::fs::remove_file(&path);
    bytes
}

fn big_endian_ply() -> Vec<u8> {
    let mut bytes = b"ply\nformat binary_big_endian 1.0\nelement vertex 2\nproperty double x\nproperty float y\n\
                      property short z\nproperty list uint8 int16 l\nend_header\n"
        .to_vec();
    for i in 0..2u8 {
        bytes.extend(f64::from(i).to_be_bytes());
        bytes.extend(f32::from(i).to_be_bytes());
        bytes.extend([0, i, 2, 0, 1, 0, 2]);
    }
    bytes
}

/// Two scans, Cartesian with a pose or spherical, with colour, intensity and invalid states.
fn e57(spherical: bool) -> Vec<u8> {
    use e57::{E57Writer, Quaternion, Record, RecordDataType, RecordName, RecordValue, Transform, Translation};
    in_file("a.e57", |path| {
        let mut writer = E57Writer::from_file(path, "file").expect("a writer");
        for scan in 0..2 {
            let mut prototype = if spherical {
                vec![Record::SPHERICAL_RANGE_F64, Record::SPHERICAL_AZIMUTH_F64, Record::SPHERICAL_ELEVATION_F64]
            } else {
                vec![Record::CARTESIAN_X_F32, Record::CARTESIAN_Y_F32, Record::CARTESIAN_Z_F32]
            };
            let state = if spherical { RecordName::SphericalInvalidState } else { RecordName::CartesianInvalidState };
            prototype.push(Record { name: state, data_type: RecordDataType::Integer { min: 0, max: 2 } });
            prototype.extend([Record::COLOR_RED_U8, Record::COLOR_GREEN_U8, Record::COLOR_BLUE_U8]);
            let mut points = writer.add_pointcloud("scan", prototype).expect("a scan");
            points.set_transform(Some(Transform {
                rotation: Quaternion { w: 1.0, x: 0.0, y: 0.0, z: 0.0 },
                translation: Translation { x: 1.0, y: f64::from(scan), z: 2.0 },
            }));
            for i in 0..20 {
                let number = |v: f64| if spherical { RecordValue::Double(v) } else { RecordValue::Single(v as f32) };
                let mut values = vec![number(1.0 + f64::from(i)), number(0.1 * f64::from(i)), number(0.5)];
                values.extend([i % 3, i, 255 - i, 7].map(|v| RecordValue::Integer(i64::from(v))));
                points.add_point(values).expect("a point");
            }
            points.finalize().expect("a finished scan");
        }
        writer.finalize().expect("a finished file");
    })
}

fn pcd() -> Vec<Vec<u8>> {
    let header = |data: &str| {
        format!(
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb label normal\nSIZE 4 4 4 4 2 4\nTYPE F F F U U F\n\
             COUNT 1 1 1 1 1 2\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS 2\nDATA {data}\n"
        )
    };
    let row = |i: u8| -> Vec<u8> {
        let mut row: Vec<u8> = [1.0f32, 2.0, f32::from(i)].iter().flat_map(|c| c.to_le_bytes()).collect();
        row.extend([i, 255, 128, 0, i, 0, 0, 0, 0, 0, 0, 0, 128, 63]);
        row
    };
    let rows = [row(1), row(2)];
    let mut columns = Vec::new();
    for (at, width) in [(0, 4), (4, 4), (8, 4), (12, 4), (16, 2), (18, 8)] {
        rows.iter().for_each(|r| columns.extend_from_slice(&r[at..at + width]));
    }
    let mut packed = Vec::new();
    for run in columns.chunks(32) {
        packed.push(run.len() as u8 - 1);
        packed.extend_from_slice(run);
    }
    let sizes = [(packed.len() as u32).to_le_bytes(), (columns.len() as u32).to_le_bytes()].concat();
    let text = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\n\
                HEIGHT 1\nPOINTS 2\nDATA ascii\n1 2 3 0.5\nnan 2 3 1\n";
    vec![
        [header("binary").into_bytes(), rows.concat()].concat(),
        [header("binary_compressed").into_bytes(), sizes, packed].concat(),
        text.as_bytes().to_vec(),
    ]
}

fn stl() -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes.extend(1u32.to_le_bytes());
    bytes.extend([0; 12]);
    bytes.extend([0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].iter().flat_map(|c| c.to_le_bytes()));
    bytes.extend([0; 2]);
    bytes
}

fn glb() -> Vec<u8> {
    let mut json = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0,"translation":[0,5,0]}],"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],"accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}],"bufferViews":[{"buffer":0,"byteLength":36}],"buffers":[{"byteLength":36}]}"#.to_owned();
    while !json.len().is_multiple_of(4) {
        json.push(' ');
    }
    let mut bytes = b"glTF\x02\0\0\0\0\0\0\0".to_vec();
    bytes.extend((json.len() as u32).to_le_bytes());
    bytes.extend(b"JSON");
    bytes.extend(json.as_bytes());
    bytes.extend(36u32.to_le_bytes());
    bytes.extend(b"BIN\0");
    bytes.extend([0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].iter().flat_map(|c| c.to_le_bytes()));
    bytes
}
