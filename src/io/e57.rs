//! E57: all scans of a file in common coordinates, with the poses of their scanners.
//!
//! Reference: ASTM E2807-11, *Standard Specification for 3D Imaging Data Exchange*. Bit packing and XML are read by the
//! `e57` crate; page checksums, poses, invalid states and limits are honoured here, because leaving one of them out
//! gives a wrong scan without any error.
//! Cost: one pass for the checksums and one for the points; memory for the columns only.

use super::crs;
use super::error::{COPY_AGAIN, Error};
use super::file_scan::{AttributeInfo, FileInfo, FileScan, Settings};
use super::label_column::LabelSource;
use super::point_table::{ColorRange, PointTable, Roles};
use super::source_bytes::SourceBytes;
use crate::cloud::Station;
use crate::numeric::Vec3;
use crate::warning::Warning;
use ::e57::{CartesianCoordinate, E57Reader, PointCloud, RecordDataType};
use std::fs::File;
use std::io::BufReader;

/// Reads all scans of an E57 file; points without a valid position are dropped and counted.
pub(super) fn read(source: &SourceBytes, settings: &Settings, origin: Option<Vec3>) -> Result<FileScan, Error> {
    let path = source.path();
    let bad = |e: ::e57::Error| Error::bad(path, e.to_string(), COPY_AGAIN);
    let open = || File::open(path).map(BufReader::new).map_err(|e| Error::read(path, e));
    // A page that is not read by the points (an image, say) is damage all the same.
    E57Reader::validate_crc(open()?)
        .map_err(|e| Error::bad(path, format!("its pages do not pass their checksums ({e})"), COPY_AGAIN))?;
    let mut reader = E57Reader::new(open()?).map_err(bad)?;
    let clouds = reader.pointclouds();
    let mut info = FileInfo::new("E57");
    let mut warnings = Vec::new();
    describe(&reader, &clouds, &mut info);
    info.crs = reader.coordinate_metadata().filter(|t| !t.trim().is_empty()).map(crs::from_wkt);
    check_label_setting(path, settings)?;
    let colored = clouds.iter().any(PointCloud::has_color);
    let gray = clouds.iter().any(PointCloud::has_intensity);
    let roles = Roles {
        position: [0, 1, 2],
        color: colored.then_some(([3, 4, 5], ColorRange::Open)),
        intensity: gray.then_some(6),
        classification: None,
        source_id: None,
        label: LabelSource::None,
    };
    let mut total = 0u64;
    for (index, cloud) in clouds.iter().enumerate() {
        check_size(source, index, cloud)?;
        total += cloud.records;
    }
    let mut table = PointTable::new(total as usize, &roles);
    let mut stations = Vec::new();
    let mut station_of_record = Vec::with_capacity(total as usize);
    let mut row = 0;
    {
        // One slot: rows are filled in order.
        let mut slots = table.slots((total as usize).max(1));
        for (index, cloud) in clouds.iter().enumerate() {
            let station = cloud.transform.as_ref().map_or(u16::MAX, |pose| {
                let t = &pose.translation;
                stations.push(Station {
                    name: cloud.name.clone().unwrap_or_else(|| format!("scan {}", index + 1)),
                    position_in_local: Vec3::new(t.x, t.y, t.z),
                });
                (stations.len() - 1) as u16
            });
            check_pose(index, cloud, &mut warnings);
            let mut points = reader.pointcloud_simple(cloud).map_err(bad)?;
            points.apply_pose(true);
            points.spherical_to_cartesian(true);
            points.intensity_to_color(false);
            // Every packet has at least four bytes.
            let mut empty_packets = source.len() / 4;
            for point in points {
                // A packet may complete no point; the decoder calls that an internal error and goes on when asked again.
                if matches!(point, Err(::e57::Error::Internal { .. })) && empty_packets > 0 {
                    empty_packets -= 1;
                    continue;
                }
                let point = point.map_err(|e| {
                    let cause = format!("scan {index} breaks at one of its {} records: {e}", cloud.records);
                    Error::bad(path, cause, COPY_AGAIN)
                })?;
                let mut values = [f64::NAN; 7];
                if let CartesianCoordinate::Valid { x, y, z } = point.cartesian {
                    (values[0], values[1], values[2]) = (x, y, z);
                }
                // What has no valid colour or intensity shows as black.
                let color = point.color.map_or([0.0; 3], |c| [c.red, c.green, c.blue]);
                (values[3], values[4], values[5]) = (color[0].into(), color[1].into(), color[2].into());
                values[6] = point.intensity.unwrap_or(0.0).into();
                slots[0].set(row, &roles, &mut 0, |column| values[column]);
                station_of_record.push(station);
                row += 1;
            }
        }
    }
    if row as u64 != total {
        return Err(Error::bad(path, format!("its scans promise {total} points, but hold {row}"), COPY_AGAIN));
    }
    for (name, there) in [("color", colored), ("intensity", gray)] {
        info.attributes.extend(there.then(|| AttributeInfo::present(name)));
    }
    let mut scan = table.finish_absolute(&roles, info, warnings, "no valid position (invalid state)");
    if !stations.is_empty() {
        scan.set_stations(stations, station_of_record);
    }
    Ok(scan.relative(origin))
}

/// How many points all scans of the file hold, from its header and its XML; the file must have its stated length.
pub(super) fn announced_points(source: &SourceBytes) -> Result<u64, Error> {
    let path = source.path();
    let head = source.up_to(0, 24)?;
    let length = head.get(16..24).map_or(u64::MAX, |b| u64::from_le_bytes(b.try_into().expect("eight bytes")));
    super::announce::must_hold(source, length, "its header")?;
    let file = File::open(path).map_err(|e| Error::read(path, e))?;
    let reader = E57Reader::new(BufReader::new(file)).map_err(|e| Error::bad(path, e.to_string(), COPY_AGAIN))?;
    let clouds = reader.pointclouds();
    clouds.iter().enumerate().try_for_each(|(index, cloud)| check_size(source, index, cloud))?;
    Ok(clouds.iter().map(|c| c.records).sum())
}

fn check_label_setting(path: &std::path::Path, settings: &Settings) -> Result<(), Error> {
    super::label_column::choose(path, settings, &[], false).map(|_| ())
}

fn describe(reader: &E57Reader<BufReader<File>>, clouds: &[PointCloud], info: &mut FileInfo) {
    let header = reader.header();
    info.version = Some(format!("{}.{}", header.major, header.minor));
    let scans: Vec<serde_json::Value> = clouds
        .iter()
        .map(|c| {
            let fields: Vec<String> = c.prototype.iter().map(|r| format!("{:?}", r.name)).collect();
            let pose = c.transform.as_ref().map(|t| {
                let (q, t) = (&t.rotation, &t.translation);
                serde_json::json!({ "translation": [t.x, t.y, t.z], "rotation_wxyz": [q.w, q.x, q.y, q.z] })
            });
            serde_json::json!({
                "name": c.name,
                "records": c.records,
                "fields": fields,
                "pose": pose,
                "sensor": c.sensor_model,
                "rows_and_columns": c.has_row_column(),
                "spherical": c.has_spherical() && !c.has_cartesian(),
            })
        })
        .collect();
    info.header("scans", scans);
    info.header("images", reader.images().len());
    let extensions: Vec<String> = reader.extensions().iter().map(|e| e.namespace.clone()).collect();
    info.header("extensions", extensions);
}

/// A pose must be a rotation; quaternions that are not of unit length would scale the scan.
fn check_pose(index: usize, cloud: &PointCloud, warnings: &mut Vec<Warning>) {
    let Some(pose) = &cloud.transform else { return };
    let q = &pose.rotation;
    let norm = (q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z).sqrt();
    if (norm - 1.0).abs() > 1e-6 {
        warnings.push(Warning::new(
            "pose-not-rigid",
            format!(
                "the rotation of scan {index} has length {norm} instead of 1; it scales the scan by {}",
                norm * norm
            ),
        ));
    }
}

/// The points must fit into the file; types without bits would promise any number of points.
fn check_size(source: &SourceBytes, index: usize, cloud: &PointCloud) -> Result<(), Error> {
    let bits = |min: i64, max: i64| u64::from(64 - (max.wrapping_sub(min) as u64).leading_zeros());
    let record_bits: u64 = cloud
        .prototype
        .iter()
        .map(|r| match r.data_type {
            RecordDataType::Single { .. } => 32,
            RecordDataType::Double { .. } => 64,
            RecordDataType::ScaledInteger { min, max, .. } | RecordDataType::Integer { min, max } => bits(min, max),
        })
        .sum();
    let needed = u128::from(cloud.records) * u128::from(record_bits) / 8;
    /// Scans of constant coordinates exist in tests of other programs only.
    const MOST_POINTS_WITHOUT_BITS: u64 = 1_000_000;
    let empty = record_bits == 0 && cloud.records > MOST_POINTS_WITHOUT_BITS;
    if needed > u128::from(source.len()) || empty {
        let cause = format!(
            "scan {index} promises {} records of {record_bits} bits, more than a file of {} bytes holds",
            cloud.records,
            source.len()
        );
        return Err(Error::bad(source.path(), cause, COPY_AGAIN));
    }
    Ok(())
}
