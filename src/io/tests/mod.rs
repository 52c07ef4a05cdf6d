//! Round trips through real files.

mod dialects;
mod formats;
mod guards;
mod las_variants;
mod parts;

use super::*;
use crate::cloud::{Attributes, Cloud, ScanFrame, SourceFile};
use crate::numeric::Vec3;
use std::path::{Path, PathBuf};

/// A small cloud far from the origin, with every attribute; whole tenths of a millimetre.
fn cloud(n: usize) -> Cloud {
    let frame = ScanFrame::with_origin(Vec3::new(244_300.0, 6_010_900.0, 0.0));
    let step = |i: usize, k: usize| ((i * k) % 1_000_003) as f64 * 1e-4;
    let positions = (0..n).map(|i| Vec3::new(step(i, 7919), step(i, 104_729), step(i, 31))).collect();
    let attributes = Attributes {
        colors: Some((0..n).map(|i| [(i * 257 % 65_536) as u16, (i % 999) as u16, 65_535]).collect()),
        intensities: Some((0..n).map(|i| (i * 13 % 65_536) as u16).collect()),
        classifications: Some((0..n).map(|i| (i % 31) as u8).collect()),
        source_ids: Some((0..n).map(|i| (i % 7) as u16).collect()),
        labels: Some((0..n).map(|i| (i % 5) as u32).collect()),
        station_ids: None,
    };
    let source = SourceFile {
        path: "made.las".into(),
        first_point: 0,
        point_count: n,
        record_count: n as u64,
        dropped_records: Default::default(),
    };
    Cloud::new(frame, positions, attributes, vec![source], vec![]).unwrap()
}

fn read(path: &Path) -> (Cloud, Summary) {
    read_cloud(&[path.to_owned()], &Settings::default()).unwrap()
}

/// Everything but the provenance agrees; positions to within a nanometre.
fn assert_same(a: &Cloud, b: &Cloud) {
    assert_eq!(a.len(), b.len());
    assert_eq!(a.attributes(), b.attributes());
    for (p, q) in a.positions().iter().zip(b.positions()) {
        let (p, q) = (a.frame().scan_from_local(p), b.frame().scan_from_local(q));
        assert!((p - q).amax() < 2e-9, "{p} {q}");
    }
}

#[test]
fn new_files_read_back() {
    let folder = tempfile::tempdir().unwrap();
    // More than one chunk of LAZ and more than one run of PLY.
    let cloud = cloud(120_001);
    for name in ["a.las", "a.laz", "a.ply"] {
        let path = folder.path().join(name);
        let written = write_cloud(&cloud, None, &path).unwrap();
        assert_eq!(written.points, 120_001);
        let (back, summary) = read(&path);
        assert_same(&cloud, &back);
        assert_eq!(summary.files[0].label_column.as_deref(), Some("label"));
        assert_eq!(back.frame().origin_in_scan.map(f64::fract), Vec3::zeros(), "whole units");
        assert_eq!(summary.warnings, vec![], "{name}");
    }
}

fn columns(n: usize) -> (Vec<u32>, [Vec<f64>; 3]) {
    let labels = (0..n).map(|i| (i % 11) as u32).collect();
    let length = |k: usize| (0..n).map(|i| if i % 10 == 3 { f64::NAN } else { (i * k) as f64 * 1e-6 - 1.5 }).collect();
    (labels, [length(3), length(5), length(7)])
}

fn lift(from: &Path, to: &Path) -> (Cloud, WriteSummary) {
    let (cloud, _) = read(from);
    let (labels, [chainage, girth, offset]) = columns(cloud.len());
    let columns =
        PointColumns { labels: &labels, chainage: &chainage, girth: &girth, offset: &offset, surface_classes: None };
    let summary = write_points(&cloud, &columns, to).unwrap();
    (cloud, summary)
}

#[test]
fn lifted_files_keep_everything_and_take_the_new_labels() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = cloud(60_001);
    for (from, to) in
        [("a.las", "b.laz"), ("a.laz", "b.las"), ("a.laz", "b.laz"), ("a.ply", "b.ply"), ("a.ply", "b.laz")]
    {
        let (from, to, again) =
            (folder.path().join(from), folder.path().join(to), folder.path().join(format!("c_{to}")));
        write_cloud(&cloud, None, &from).unwrap();
        let (before, written) = lift(&from, &to);
        assert_eq!(written.points, 60_001);
        if from.extension() == to.extension() {
            assert_eq!(written.replaced_columns, ["label"]);
        }
        let (after, _) = read(&to);
        assert_eq!(after.attributes().labels.as_ref().unwrap(), &columns(60_001).0);
        let mut expected = before.attributes().clone();
        expected.labels.clone_from(&after.attributes().labels);
        assert_eq!(after.attributes(), &expected);
        // A lift of a lifted file replaces the columns instead of adding more.
        lift(&to, &again);
        assert_eq!(std::fs::metadata(&to).unwrap().len(), std::fs::metadata(&again).unwrap().len());
        assert_eq!(std::fs::read(&to).unwrap(), std::fs::read(&again).unwrap());
    }
}

#[test]
fn surface_classes_are_a_column_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = cloud(1000);
    let classes: Vec<u8> = (0..1000).map(|i| if i % 7 == 0 { NO_CLASS } else { (i % 5) as u8 }).collect();
    for name in ["las", "laz", "ply"] {
        let [from, with, without] = ["a", "b", "c"].map(|stem| folder.path().join(format!("{stem}.{name}")));
        write_cloud(&cloud, None, &from).unwrap();
        let (read_back, _) = read(&from);
        let (labels, [chainage, girth, offset]) = columns(1000);
        let mut columns = PointColumns {
            labels: &labels,
            chainage: &chainage,
            girth: &girth,
            offset: &offset,
            surface_classes: Some(&classes),
        };
        write_points(&read_back, &columns, &with).unwrap();
        let as_labels = |path: &Path| {
            let settings = Settings { label_column: Some("surface_class".into()), ..Settings::default() };
            read_cloud(&[path.to_owned()], &settings).map(|(cloud, _)| cloud.attributes().labels.clone().unwrap())
        };
        let expected: Vec<u32> = classes.iter().map(|&c| u32::from(c)).collect();
        assert_eq!(as_labels(&with).unwrap(), expected, "{name}");
        // The classification of the file is not touched, and a writer that knows no classes leaves the column alone.
        assert_eq!(read(&with).0.attributes().classifications, cloud.attributes().classifications);
        columns.surface_classes = None;
        write_points(&read(&with).0, &columns, &without).unwrap();
        assert_eq!(as_labels(&without).unwrap(), expected, "{name}");
        assert!(as_labels(&from).is_err());
    }
}

#[test]
fn several_files_are_one_scan() {
    let folder = tempfile::tempdir().unwrap();
    let paths: Vec<PathBuf> = ["a.las", "b.laz"].iter().map(|n| folder.path().join(n)).collect();
    let cloud = cloud(1000);
    paths.iter().for_each(|p| drop(write_cloud(&cloud, None, p).unwrap()));
    let (both, summary) = read_cloud(&paths, &Settings::default()).unwrap();
    assert_eq!((both.len(), summary.files.len()), (2000, 2));
    assert_eq!(both.sources()[1].first_point, 1000);
    assert_eq!(both.positions()[..1000], both.positions()[1000..]);
    let (labels, [a, b, c]) = columns(2000);
    let to = folder.path().join("c.laz");
    let columns = PointColumns { labels: &labels, chainage: &a, girth: &b, offset: &c, surface_classes: None };
    assert_eq!(write_points(&both, &columns, &to).unwrap().points, 2000);
    assert_eq!(read(&to).0.attributes().labels, Some(labels));
}

#[test]
fn a_truncated_file_is_refused_or_used_as_set() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    write_cloud(&cloud(1000), None, &path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let error = read_cloud(std::slice::from_ref(&path), &Settings::default()).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::BadInput);
    assert!(error.to_string().contains("promises 1000 records"), "{error}");
    let settings = Settings { allow_truncated: true, ..Default::default() };
    let (partial, summary) = read_cloud(&[path], &settings).unwrap();
    assert!(partial.len() > 400 && partial.len() < 500);
    assert_eq!(summary.warnings[0].code, "truncated");
}

#[test]
fn meshes_read_back_in_their_frame() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("chart.ply");
    let frame = ScanFrame::with_origin(Vec3::new(500_000.0, 6_000_000.0, 0.0));
    let vertices =
        [Vec3::new(0.1, 0.2, 0.3), Vec3::new(1.0, 0.0, 0.0), Vec3::new(0.0, 1.0, 0.0), Vec3::new(1.0, 1.0, 0.5)];
    let uv = vertices.map(|v| crate::numeric::Vec2::new(v.x * 2.0, v.y));
    let faces = [[0, 1, 2], [2, 1, 3]];
    let mesh = ply::PlyMesh {
        frame: &frame,
        vertices: &vertices,
        uv: Some(&uv),
        faces: &faces,
        observed_vertices: Some(&[true, true, true, false]),
        observed_faces: Some(&[true, false]),
        quality: None,
    };
    ply::write_mesh(&mesh, &path).unwrap();
    let (back, summary) = ply::read_chart(&path).unwrap();
    assert_eq!((summary.vertices, summary.faces), (4, 2));
    assert_eq!(back.frame, frame);
    assert_eq!(back.faces, faces);
    assert_eq!(back.uv.as_deref(), Some(&uv[..]));
    assert_eq!(back.observed.as_deref(), Some(&[true, false][..]));
    for (a, b) in vertices.iter().zip(&back.vertices) {
        assert!((a - b).amax() < 1e-9);
    }
}
