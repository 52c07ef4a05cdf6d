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
use super::point_table::{ColorRange, MID_GREY, PointTable, Roles, mixed_scans};
use super::source_bytes::SourceBytes;
use crate::cloud::Station;
use crate::numeric::Vec3;
use crate::warning::Warning;
use ::e57::{CartesianCoordinate, E57Reader, Point, PointCloud, RecordDataType, RecordName};
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
            // A scan without a pose was moved to where it belongs already: nobody knows from where it was seen.
            let place = cloud.transform.as_ref().map(|pose| &pose.translation).map(|t| Vec3::new(t.x, t.y, t.z));
            let place = place.filter(|p| p.iter().all(|c| c.is_finite()));
            let mut station = u16::MAX;
            if place.is_some() || clouds.len() > 1 {
                station = stations.len().min(usize::from(u16::MAX)) as u16;
                let name = cloud.name.clone().unwrap_or_else(|| format!("scan {}", index + 1));
                stations.push(Station { name, position_in_local: place });
            }
            check_pose(index, cloud, &mut warnings);
            let own = OwnRange::of(&mut reader, source, index, cloud)?;
            warnings.extend(own.told(index));
            let no_color = if cloud.has_color() { [0.0; 3] } else { MID_GREY.map(|c| f64::from(c) / 65535.0) };
            each_point(&mut reader, source, index, cloud, &own, |point| {
                let mut values = [f64::NAN; 7];
                if let CartesianCoordinate::Valid { x, y, z } = point.cartesian {
                    (values[0], values[1], values[2]) = (x, y, z);
                }
                // What has no valid colour or intensity shows as black, in a scan without any as grey.
                let color = point.color.map_or(no_color, |c| [c.red, c.green, c.blue].map(|c| own.color(c)));
                values[3..6].copy_from_slice(&color);
                values[6] = point.intensity.map_or(0.0, |i| own.intensity(i));
                slots[0].set(row, &roles, &mut 0, |column| values[column]);
                station_of_record.push(station);
                row += 1;
            })?;
        }
    }
    if row as u64 != total {
        return Err(Error::bad(path, format!("its scans promise {total} points, but hold {row}"), COPY_AGAIN));
    }
    warnings.extend(mixed_scans("colours", "mid grey", clouds.iter().map(PointCloud::has_color)));
    warnings.extend(mixed_scans("intensities", "0", clouds.iter().map(PointCloud::has_intensity)));
    for (name, there) in [("color", colored), ("intensity", gray)] {
        info.attributes.extend(there.then(|| AttributeInfo::present(name)));
    }
    let mut scan = table.finish_absolute(&roles, info, warnings, "no valid position (invalid state)");
    if !stations.is_empty() {
        scan.set_stations(stations, station_of_record);
    }
    Ok(scan.relative(origin))
}

/// Visits all points of a scan in common coordinates.
fn each_point(
    reader: &mut E57Reader<BufReader<File>>,
    source: &SourceBytes,
    index: usize,
    cloud: &PointCloud,
    own: &OwnRange,
    mut visit: impl FnMut(Point),
) -> Result<(), Error> {
    let path = source.path();
    let mut points = reader.pointcloud_simple(cloud).map_err(|e| Error::bad(path, e.to_string(), COPY_AGAIN))?;
    points.apply_pose(true);
    points.spherical_to_cartesian(true);
    points.intensity_to_color(false);
    points.normalize_intensity(own.intensity.is_none());
    points.normalize_color(own.color.is_none());
    // Every packet has at least four bytes.
    let mut empty_packets = source.len() / 4;
    for point in points {
        // A packet may complete no point; the decoder calls that an internal error and goes on when asked again.
        if matches!(point, Err(::e57::Error::Internal { .. })) && empty_packets > 0 {
            empty_packets -= 1;
            continue;
        }
        visit(point.map_err(|e| {
            let cause = format!("scan {index} breaks at one of its {} records: {e}", cloud.records);
            Error::bad(path, cause, COPY_AGAIN)
        })?);
    }
    Ok(())
}

/// Ranges of a scan's own values, where neither limits nor types state any: the standard lets floating point numbers
/// go without.
#[derive(Clone, Copy, Debug, Default)]
struct OwnRange {
    intensity: Option<[f32; 2]>,
    /// The largest channel.
    color: Option<f32>,
}

impl OwnRange {
    fn of(
        reader: &mut E57Reader<BufReader<File>>,
        source: &SourceBytes,
        index: usize,
        cloud: &PointCloud,
    ) -> Result<Self, Error> {
        let boundless = |name: &RecordName| {
            let data_type = cloud.prototype.iter().find(|r| r.name == *name).map(|r| &r.data_type);
            match data_type {
                Some(RecordDataType::Single { min, max }) => min.is_none() || max.is_none(),
                Some(RecordDataType::Double { min, max }) => min.is_none() || max.is_none(),
                _ => false,
            }
        };
        let gray = cloud.intensity_limits.as_ref();
        let gray_limited = gray.is_some_and(|l| l.intensity_min.is_some() && l.intensity_max.is_some());
        let color_limited = cloud.color_limits.as_ref().is_some_and(|l| {
            let all = [&l.red_min, &l.red_max, &l.green_min, &l.green_max, &l.blue_min, &l.blue_max];
            all.into_iter().all(Option::is_some)
        });
        let mut own = Self::default();
        if !gray_limited && boundless(&RecordName::Intensity) {
            own.intensity = Some([f32::INFINITY, f32::NEG_INFINITY]);
        }
        let channels = [RecordName::ColorRed, RecordName::ColorGreen, RecordName::ColorBlue];
        if !color_limited && channels.iter().any(boundless) {
            own.color = Some(0.0);
        }
        let mut seen = own;
        if own.intensity.is_some() || own.color.is_some() {
            each_point(reader, source, index, cloud, &own, |point| {
                if let (Some([low, high]), Some(i)) = (&mut seen.intensity, point.intensity.filter(|i| i.is_finite())) {
                    (*low, *high) = (low.min(i), high.max(i));
                }
                if let (Some(most), Some(c)) = (&mut seen.color, point.color) {
                    *most = [c.red, c.green, c.blue].into_iter().filter(|c| c.is_finite()).fold(*most, f32::max);
                }
            })?;
        }
        Ok(seen)
    }

    /// An intensity as a share of its range; that of 0 to 1 is kept.
    fn intensity(&self, value: f32) -> f64 {
        let value = f64::from(value);
        match self.intensity.map(|range| range.map(f64::from)) {
            Some([low, high]) if low < 0.0 || high > 1.0 => {
                if high > low {
                    (value - low) / (high - low)
                } else {
                    1.0
                }
            }
            _ => value,
        }
    }

    /// A colour channel as a share of 1, of 255 or of 65535, whichever holds the largest one.
    fn color(&self, value: f32) -> f64 {
        let most = match self.color {
            Some(most) if most > 255.0 => 65_535.0,
            Some(most) if most > 1.0 => 255.0,
            _ => 1.0,
        };
        f64::from(value) / most
    }

    fn told(&self, index: usize) -> Option<Warning> {
        let [low, high] = self.intensity.filter(|[low, high]| *low < 0.0 || *high > 1.0)?;
        let text =
            format!("scan {index} states no limits of its intensities; {low} to {high} are stretched to 0..65535");
        Some(Warning::new("intensity-range", text))
    }
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
