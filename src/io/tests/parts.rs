//! Parts of a scan: boxes and stretches of chainage, and what the index of a COPC is good for.

use super::las_variants::{Made, laz_of, streamed};
use super::*;
use crate::axis::{self, Axis};

/// Two nodes of an octree as COPC, records in the order of x; also the first byte of the second node.
fn copc(path: &Path, made: &Made) -> u64 {
    let vlr = laz::LazVlrBuilder::default().with_point_format(6, 0).unwrap().with_variable_chunk_size().build();
    let mut bytes = laz_of(made, vlr, &[100, 100]);
    let first_chunk = u64::from(u32::from_le_bytes(bytes[96..100].try_into().unwrap())) + 8;
    std::fs::write(path, &bytes).unwrap();
    let middle = made.position(100);
    // The chunk lengths, from the plan of the reader itself.
    let second_chunk = las::chunk_starts(path)[1];
    // Records come in the order of x: the first hundred lie below the middle.
    let low = Vec3::new(middle.x - 512.0, 1900.0, -400.0);
    let mut info = vec![0u8; 160];
    for (at, v) in [(0, low.x + 512.0), (8, low.y + 512.0), (16, low.z + 512.0), (24, 512.0)] {
        info[at..at + 8].copy_from_slice(&v.to_le_bytes());
    }
    let hierarchy_at = bytes.len() as u64 + 60;
    info[40..48].copy_from_slice(&hierarchy_at.to_le_bytes());
    info[48..56].copy_from_slice(&64u64.to_le_bytes());
    // The info record goes behind the points as an extended one; the page right after its header.
    let mut page = Vec::new();
    for (x, at) in [(0u32, first_chunk), (1, second_chunk)] {
        for v in [1u32, x, 0, 0] {
            page.extend(v.to_le_bytes());
        }
        page.extend(at.to_le_bytes());
        page.extend(1u32.to_le_bytes());
        page.extend(100i32.to_le_bytes());
    }
    let evlrs_at = bytes.len() as u64;
    for (id, data) in [(1000u16, &page), (1, &info)] {
        let mut v = vec![0u8; 60];
        v[2..6].copy_from_slice(b"copc");
        v[18..20].copy_from_slice(&id.to_le_bytes());
        v[20..28].copy_from_slice(&(data.len() as u64).to_le_bytes());
        bytes.extend(v);
        bytes.extend(data);
    }
    bytes[235..243].copy_from_slice(&evlrs_at.to_le_bytes());
    bytes[243..247].copy_from_slice(&2u32.to_le_bytes());
    std::fs::write(path, &bytes).unwrap();
    second_chunk
}

/// Damage in the second node is met by whoever reads it.
fn damage(path: &Path, second_chunk: u64) {
    let mut bytes = std::fs::read(path).unwrap();
    let from = second_chunk as usize + 31;
    bytes[from..from + 40].fill(0xff);
    std::fs::write(path, &bytes).unwrap();
}

#[test]
fn the_index_of_copc_leaves_out_what_lies_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.copc.laz");
    let made = Made::new(4, 6, 200).in_steps(0.01);
    let second_chunk = copc(&path, &made);
    let (cloud, _) = read(&path);
    let middle = made.position(100);
    let window =
        ScanBox { low: middle - Vec3::new(20.25, 500.0, 500.0), high: middle + Vec3::new(-1.25, 500.0, 500.0) };
    let expected = cloud.positions().iter().filter(|p| window.contains(&cloud.frame().scan_from_local(p))).count();
    assert_eq!(streamed(&path, Some(&window)).len(), expected);
    assert!(expected > 0 && expected < 100);
    damage(&path, second_chunk);
    assert_eq!(streamed(&path, Some(&window)).len(), expected);
    assert!(read_cloud(&[path], &Settings::default()).is_err());
}

/// A straight axis along x through the points of [`Made`].
fn part(made: &Made, chainage_m: [f64; 2]) -> Result<Part, Error> {
    let frame = ScanFrame::local();
    let [first, last] = [0, 199].map(|i| made.position(i));
    let text = format!("chainage,x,y,z\n0,{},{},{}\n1,{},{1},{2}\n", first.x, first.y, first.z, last.x);
    let (axis, _): (Axis, _) = axis::import_csv(&text, &frame, &axis::Settings::default()).unwrap();
    Part::along(axis, frame, chainage_m)
}

#[test]
fn a_stretch_of_chainage_is_the_same_part_of_every_format() {
    let folder = tempfile::tempdir().unwrap();
    let made = Made::new(4, 6, 200).in_steps(0.01);
    let path = folder.path().join("a.copc.laz");
    let second_chunk = copc(&path, &made);
    let (whole, _) = read(&path);
    let in_scan = |c: &Cloud| c.positions().iter().map(|p| c.frame().scan_from_local(p)).collect::<Vec<Vec3>>();
    let (first, half) = (made.position(0), made.position(99));
    let stretch = [2.0, half.x - first.x - 1.0];
    let part = part(&made, stretch).unwrap();
    let expected: Vec<Vec3> = in_scan(&whole).into_iter().filter(|p| part.contains(p)).collect();
    assert!(expected.len() > 10 && expected.len() < 100, "{}", expected.len());
    assert!(expected.iter().all(|p| p.x >= first.x + 2.0 - 1e-6));

    let others = ["b.laz", "b.ply"].map(|name| folder.path().join(name));
    others.iter().for_each(|to| drop(write_cloud(&whole, None, to).unwrap()));
    // The second node lies elsewhere and is not even read.
    damage(&path, second_chunk);
    for file in others.iter().chain([&path]) {
        let (cloud, summary) = read_part(std::slice::from_ref(file), &Settings::default(), Some(&part)).unwrap();
        let found = in_scan(&cloud);
        assert_eq!(found.len(), expected.len(), "{}", file.display());
        assert!(found.iter().zip(&expected).all(|(a, b)| (a - b).amax() < 2e-4));
        let told = &summary.files[0];
        assert_eq!((told.records, told.dropped, told.outside_part), (200, 0, 200 - expected.len() as u64));
        let records: Vec<u64> = (0..cloud.len()).map(|i| cloud.sources()[0].record_of(i)).collect();
        assert!(records.iter().zip(&expected).all(|(&r, p)| (made.position(r as usize) - p).amax() < 0.011));
    }
    assert_eq!(announce_part(&path, Some(&part)).unwrap().points, 100);
    assert_eq!(announce(&path).unwrap().points, 200);
}

#[test]
fn a_part_that_is_not_there_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let made = Made::new(4, 6, 200).in_steps(0.01);
    for (stretch, told) in [([5.0, 5.0], "no stretch"), ([f64::NAN, 5.0], "no stretch"), ([9e5, 9.1e5], "outside the")]
    {
        let error = part(&made, stretch).unwrap_err();
        assert!(error.kind() == ErrorKind::Settings && error.to_string().contains(told), "{error}");
    }
    let path = folder.path().join("a.xyz");
    std::fs::write(&path, "1 2 3\n4 5 6\n").unwrap();
    let part = part(&made, [1.0, 2.0]).unwrap();
    let error = read_part(std::slice::from_ref(&path), &Settings::default(), Some(&part)).unwrap_err();
    assert!(error.to_string().contains("between the chainages 1 and 2"), "{error}");
    let feet = Settings { unit: Some(Unit::Foot), ..Default::default() };
    let error = read_part(&[path], &feet, Some(&part)).unwrap_err();
    assert!(error.to_string().contains("0.3048"), "{error}");
}
