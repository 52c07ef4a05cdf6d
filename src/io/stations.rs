//! Scans of single stations, thinned: for residuals between them and for fine registration.

use super::assemble::{contained, read_file, refuse_degrees};
use super::detect;
use super::error::Error;
use super::file_scan::Settings;
use super::poses::{Pose, Poses};
use super::source_bytes::SourceBytes;
use super::stream::{Pass, ScanBox, Scope, Start, stream_file};
use crate::cloud::Cloud;
use crate::numeric::Vec3;
use crate::register::{Overlap, Surface, Thinned};
use crate::warning::Warning;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Cell that scans are thinned to, metres; larger for scans that need more than [`MOST_POINTS`] of them.
const CELL_M: f64 = 0.02;
/// Points of a thinned scan, at most.
const MOST_POINTS: usize = 150_000;
/// Points farther from the other scan are no part of the overlap, metres.
const OVERLAP_M: f64 = 0.1;
/// A median distance that spoils a map at millimetres, metres.
const LARGE_RESIDUAL_M: f64 = 0.01;

/// How well two stations of a cloud agree.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StationOverlap {
    /// Their names: stations of the files, or the files themselves.
    pub stations: [String; 2],
    /// Distances of the second one's points from the first one's local planes.
    #[serde(flatten)]
    pub overlap: Overlap,
}

/// Residuals between all pairs of stations of a cloud that overlap; files stand for stations where none are known.
pub(super) fn overlaps(cloud: &Cloud, warnings: &mut Vec<Warning>) -> Vec<StationOverlap> {
    let names = names(cloud);
    if names.len() < 2 {
        return Vec::new();
    }
    let mut thinned: Vec<Thinned> = names.iter().map(|_| Thinned::new(CELL_M, MOST_POINTS)).collect();
    match &cloud.attributes().station_ids {
        Some(ids) => {
            for (p, &id) in cloud.positions().iter().zip(ids) {
                // Points of no known station belong to no pair.
                if let Some(thinned) = thinned.get_mut(usize::from(id)) {
                    thinned.add(p);
                }
            }
        }
        None => {
            for (source, thinned) in cloud.sources().iter().zip(&mut thinned) {
                let range = source.first_point..source.first_point + source.point_count;
                cloud.positions()[range].iter().for_each(|p| thinned.add(p));
            }
        }
    }
    let scans: Vec<(Vec<Vec3>, Option<ScanBox>)> = thinned
        .into_iter()
        .map(|t| {
            let points = t.into_points();
            let around = box_around(&points, OVERLAP_M);
            (points, around)
        })
        .collect();
    let mut found = Vec::new();
    for (i, (first, first_box)) in scans.iter().enumerate() {
        let near = |other: &Option<ScanBox>| first_box.as_ref().zip(other.as_ref()).is_some_and(|(a, b)| a.meets(b));
        if !scans[i + 1..].iter().any(|(_, other)| near(other)) {
            continue;
        }
        let surface = Surface::new(first);
        for (j, (second, _)) in scans.iter().enumerate().skip(i + 1).filter(|(_, (_, b))| near(b)) {
            let inside: Vec<Vec3> =
                second.iter().filter(|p| first_box.is_some_and(|b| b.contains(p))).copied().collect();
            if let Some(overlap) = surface.overlap(&inside, OVERLAP_M) {
                found.push(StationOverlap { stations: [names[i].clone(), names[j].clone()], overlap });
            }
        }
    }
    if let Some(worst) = found.iter().max_by(|a, b| a.overlap.median_m.total_cmp(&b.overlap.median_m))
        && worst.overlap.median_m > LARGE_RESIDUAL_M
    {
        warnings.push(Warning::new(
            "station-overlap",
            format!(
                "'{}' lies {:.1} mm (median, point to plane) off '{}' where they overlap; `adit register` may bring \
                 them together",
                worst.stations[1],
                worst.overlap.median_m * 1000.0,
                worst.stations[0]
            ),
        ));
    }
    found
}

fn names(cloud: &Cloud) -> Vec<String> {
    if cloud.attributes().station_ids.is_some() {
        return cloud.stations().iter().map(|s| s.name.clone()).collect();
    }
    cloud.sources().iter().map(|s| s.path.display().to_string()).collect()
}

fn box_around(points: &[Vec3], margin: f64) -> Option<ScanBox> {
    let (low, high) = crate::spatial::voxel_grid::bounds(points)?;
    Some(ScanBox { low: low.add_scalar(-margin), high: high.add_scalar(margin) })
}

/// A station, thinned, in the coordinates of the scan: a file, or one of the scans in it.
#[derive(Clone, Debug)]
pub struct StationScan {
    /// The file.
    pub path: PathBuf,
    /// Number of the station in the file, from 1, when the file has several.
    pub station: Option<u16>,
    /// Its pose so far: that of [`Settings::poses`], or none.
    pub pose: Pose,
    /// Thinned points, scan coordinates with the pose applied, in the unit of the file.
    pub points_in_scan: Vec<Vec3>,
    /// Length of the unit, metres.
    pub metres_per_unit: f64,
}

impl std::fmt::Display for StationScan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.station {
            Some(number) => write!(f, "station {number} of '{}'", self.path.display()),
            None => write!(f, "'{}'", self.path.display()),
        }
    }
}

/// Reads the stations of a file: in one pass with bounded memory (see [`super::stream_positions`]) where a file is one
/// station, whole where it may hold several (E57, PTX). Points of such a file that belong to no station are left out.
///
/// # Errors
/// As [`super::read_cloud`].
pub fn read_stations(path: &Path, settings: &Settings) -> Result<Vec<StationScan>, Error> {
    let poses = settings.poses.as_deref().map(Poses::read).transpose()?.unwrap_or_default().of(path);
    let scan = |station: Option<u16>, thinned: Thinned, origin: &Vec3, metres_per_unit: f64| {
        let pose = poses.of_station(station);
        let points_in_scan = thinned.into_points().iter().map(|p| pose.apply_to(&(p + origin))).collect();
        StationScan { path: path.to_owned(), station: station.map(|s| s + 1), pose, points_in_scan, metres_per_unit }
    };
    let unit = settings.unit.map(super::Unit::metres);
    let several = contained(path, || Ok(detect::format_of(&SourceBytes::open(path)?)?.may_hold_stations()))?;
    if several {
        let file = read_file(path, settings, None, None)?;
        refuse_degrees(path, &file, settings)?;
        let metres_per_unit = unit.or(file.info.crs.as_ref().and_then(|c| c.metres_per_unit)).unwrap_or(1.0);
        let empty = || Thinned::new(CELL_M / metres_per_unit, MOST_POINTS);
        let mut thinned: Vec<Thinned> = file.stations.iter().map(|_| empty()).collect();
        if let Some(ids) = file.attributes.station_ids.as_ref().filter(|_| thinned.len() > 1) {
            for (p, &id) in file.positions.iter().zip(ids) {
                if let Some(thinned) = thinned.get_mut(usize::from(id)) {
                    thinned.add(p);
                }
            }
            let numbered = thinned.into_iter().enumerate();
            return Ok(numbered.map(|(i, t)| scan(Some(i as u16), t, &file.origin, metres_per_unit)).collect());
        }
        let mut whole = empty();
        file.positions.iter().for_each(|p| whole.add(p));
        return Ok(vec![scan(None, whole, &file.origin, metres_per_unit)]);
    }
    let (thinned, origin, metres_per_unit) = thin(path, settings, unit)?;
    Ok(vec![scan(None, thinned, &origin, metres_per_unit)])
}

/// Thins a file in one pass: the points relative to an origin, that origin, and the length of the file's unit, metres.
fn thin(path: &Path, settings: &Settings, unit: Option<f64>) -> Result<(Thinned, Vec3, f64), Error> {
    struct Thin {
        origin: Vec3,
        thinned: Thinned,
    }
    impl Pass for Thin {
        fn begin(&mut self, start: Start) {
            self.origin = start.origin;
        }

        fn add(&mut self, positions: &[Vec3]) {
            positions.iter().for_each(|p| self.thinned.add(p));
        }
    }
    // Cells are in the file's unit until that is known; a second pass is only needed for other units than metres.
    let mut metres_per_unit = unit.unwrap_or(1.0);
    loop {
        let mut thin = Thin { origin: Vec3::zeros(), thinned: Thinned::new(CELL_M / metres_per_unit, MOST_POINTS) };
        let (scan, _) = stream_file(path, settings, Scope::default(), &mut thin)?;
        refuse_degrees(path, &scan, settings)?;
        let stated = unit.or(scan.info.crs.as_ref().and_then(|c| c.metres_per_unit)).unwrap_or(1.0);
        if stated == metres_per_unit {
            return Ok((thin.thinned, thin.origin, metres_per_unit));
        }
        metres_per_unit = stated;
    }
}
