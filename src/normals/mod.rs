//! Unit normals that face the void, with the local noise and curvature and a denoised position as by-products.
//!
//! Each geometry point gets the plane of its nearest neighbours (`planes`). How many are taken follows the
//! surroundings: from few to many as long as the points scatter about the plane no more than they did before (averaging
//! noise), and no further when they begin to (an edge or a bend). In a scan of profiles the neighbours are found in
//! coordinates that are compressed along the axis, and the plane is fitted as a height over the section's tangent and
//! the axis, because the relief between two profiles is larger than the piece of profile beside the point.
//!
//! Orientation: towards the scanner station where it is known, else towards the axis; where that direction is almost
//! along the surface, neighbours decide.
//!
//! References: N. J. Mitra, A. Nguyen, L. Guibas, "Estimating surface normals in noisy point cloud data", IJCGA 14,
//! 2004, doi:10.1142/S0218195904001470 (neighbourhood against noise and curvature); see also `plane_fit`.

mod orientation;
mod plane_fit;
mod planes;
mod profiles;

pub use planes::{adaptive, unoriented};

use crate::axis::Axis;
use crate::clean::{GeometryCloud, Spacing};
use crate::cloud::Cloud;
use crate::numeric::Vec3;
use crate::numeric::statistics::{median, quantile};
use crate::spatial::nearest::BundleTree;
use crate::warning::Warning;
use plane_fit::Plane;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How normals are estimated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Number of nearest neighbours (the point included) for each plane, 4 to 128. 14 or 28
    /// by noise and edges, or 18 to 72 in noisy scans, when not given.
    pub neighbours: Option<usize>,
    /// Whether known scanner stations decide which side faces the void (else only the axis does).
    pub use_stations: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self { neighbours: None, use_stations: true }
    }
}

/// How the normals came about.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Points with a normal: all of them.
    pub points: usize,
    /// Whether the points lie on profiles.
    pub profiles: bool,
    /// How many points used each number of neighbours, `[neighbours, points]`.
    pub neighbourhoods: Vec<[usize; 2]>,
    /// Median noise: root mean square distance of neighbours from the plane, metres.
    pub noise_m: f64,
    /// The noise that 95 % of the points stay below, metres.
    pub noise_p95_m: f64,
    /// Points whose neighbours lie on a line; their normal is perpendicular to it and faces the void.
    pub on_a_line: usize,
    /// Points oriented by the line of sight of their scanner station.
    pub oriented_by_station: usize,
    /// Points seen almost edge on, oriented by their neighbours.
    pub oriented_by_neighbours: usize,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

/// Why normals cannot be estimated.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// Fewer than three points.
    #[error("normals need at least 3 points, got {found}")]
    TooFewPoints {
        /// Points given.
        found: usize,
    },
    /// The number of neighbours is out of range.
    #[error("normals.neighbours = {found} is out of range: 4 to 128")]
    Neighbours {
        /// What was given.
        found: usize,
    },
}

/// Scanner stations of geometry points.
#[derive(Clone, Copy, Debug, Default)]
pub struct Viewpoints<'a> {
    /// Positions of the stations, local metres.
    stations: &'a [crate::cloud::Station],
    /// Station of each scan point; a number without a station means unknown.
    station_of_point: &'a [u16],
}

impl<'a> Viewpoints<'a> {
    /// Nothing known.
    pub fn unknown() -> Self {
        Self::default()
    }

    /// The stations of a cloud, if it has them for its points.
    pub fn of(cloud: &'a Cloud) -> Self {
        match &cloud.attributes().station_ids {
            Some(ids) => Self { stations: cloud.stations(), station_of_point: ids },
            None => Self::unknown(),
        }
    }

    /// Position of the station that saw scan point `index`.
    pub fn of_point(&self, index: usize) -> Option<Vec3> {
        let station = *self.station_of_point.get(index)?;
        self.stations.get(station as usize)?.position_in_local
    }
}

/// Geometry points with unit normals that face the void.
#[derive(Clone, Debug, PartialEq)]
pub struct OrientedCloud {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    denoised: Vec<Vec3>,
    noise_m: Vec<f32>,
    variation: Vec<f32>,
    spacing: Spacing,
}

impl OrientedCloud {
    /// Takes positions and unit normals as they are (for surfaces whose normals are known).
    ///
    /// Panics if the lengths differ.
    pub fn from_parts(positions: Vec<Vec3>, normals: Vec<Vec3>) -> Self {
        assert_eq!(positions.len(), normals.len());
        let spacing = Spacing::estimate(&positions);
        let n = positions.len();
        Self {
            denoised: positions.clone(),
            positions,
            normals,
            noise_m: vec![0.0; n],
            variation: vec![0.0; n],
            spacing,
        }
    }

    /// Number of points: that of the geometry cloud, in its order.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Geometry points, local metres.
    pub fn positions(&self) -> &[Vec3] {
        &self.positions
    }

    /// Unit normals into the void.
    pub fn normals(&self) -> &[Vec3] {
        &self.normals
    }

    /// Geometry points moved along their normals onto the plane of their neighbours, local metres.
    pub fn denoised(&self) -> &[Vec3] {
        &self.denoised
    }

    /// Local noise: root mean square distance of the neighbours from the plane, metres.
    pub fn noise_m(&self) -> &[f32] {
        &self.noise_m
    }

    /// Surface variation, 0 (flat) to 1/3: a measure of curvature and edges.
    pub fn variation(&self) -> &[f32] {
        &self.variation
    }

    /// Spacing of the points.
    pub fn spacing(&self) -> Spacing {
        self.spacing
    }
}

/// What is known of the surface at one point.
#[derive(Clone, Copy, Debug)]
struct Estimate {
    normal: Vec3,
    denoised: Vec3,
    noise_m: f32,
    variation: f32,
    neighbours: u8,
    on_a_line: bool,
}

/// Estimates a normal for every geometry point and orients it into the void.
///
/// # Errors
/// [`Error::TooFewPoints`], [`Error::Neighbours`].
pub fn estimate(
    geometry: &GeometryCloud,
    axis: &Axis,
    viewpoints: Viewpoints<'_>,
    settings: &Settings,
) -> Result<(OrientedCloud, Summary), Error> {
    let points = geometry.positions();
    if points.len() < 3 {
        return Err(Error::TooFewPoints { found: points.len() });
    }
    if let Some(found) = settings.neighbours.filter(|n| !(4..=128).contains(n)) {
        return Err(Error::Neighbours { found });
    }
    let profiles = geometry.spacing().is_anisotropic();
    let estimates = if profiles {
        profiles::estimate(points, axis, &geometry.spacing(), settings.neighbours)
    } else {
        planes_of(geometry.tree(), settings.neighbours)
    };
    let mut normals: Vec<Vec3> = estimates.par_iter().map(|e| e.normal).collect();
    let viewpoints = if settings.use_stations { viewpoints } else { Viewpoints::unknown() };
    let station_of = |i: usize| viewpoints.of_point(geometry.first_points()[i] as usize);
    let (verdict, ((used, on_a_line), (noise_m, noise_p95_m))) = rayon::join(
        || orientation::orient(&mut normals, points, geometry.tree(), axis, station_of),
        || {
            rayon::join(
                || {
                    let mut used: std::collections::BTreeMap<usize, usize> = std::collections::BTreeMap::new();
                    for e in &estimates {
                        *used.entry(e.neighbours as usize).or_default() += 1;
                    }
                    (used, estimates.iter().filter(|e| e.on_a_line).count())
                },
                || {
                    let mut noises: Vec<f64> = estimates.iter().map(|e| f64::from(e.noise_m)).collect();
                    (median(&mut noises).unwrap_or(0.0), quantile(&mut noises, 0.95).unwrap_or(0.0))
                },
            )
        },
    );
    let mut warnings = Vec::new();
    if on_a_line * 20 > points.len() {
        warnings.push(Warning::new(
            "normals-on-lines",
            format!(
                "{:.0} % of the points have neighbours on a line only, so their normals are weak; the scan is sparse \
                 in one direction",
                100.0 * on_a_line as f64 / points.len() as f64
            ),
        ));
    }
    let summary = Summary {
        points: points.len(),
        profiles,
        neighbourhoods: used.into_iter().map(|(k, n)| [k, n]).collect(),
        noise_m,
        noise_p95_m,
        on_a_line,
        oriented_by_station: verdict.by_station,
        oriented_by_neighbours: verdict.by_neighbours,
        warnings,
    };
    let cloud = OrientedCloud {
        positions: points.to_vec(),
        normals,
        denoised: estimates.par_iter().map(|e| e.denoised).collect(),
        noise_m: estimates.par_iter().map(|e| e.noise_m).collect(),
        variation: estimates.par_iter().map(|e| e.variation).collect(),
        spacing: geometry.spacing(),
    };
    Ok((cloud, summary))
}

fn planes_of(tree: &BundleTree, neighbours: Option<usize>) -> Vec<Estimate> {
    let own = neighbours.as_slice();
    let sizes = if own.is_empty() { planes::neighbourhoods(tree) } else { planes::Sizes { own, shared: &[] } };
    tree.in_point_order(planes::for_each(tree, sizes, |place, chosen| from_plane(tree.point(place), chosen)))
}

fn from_plane(point: Vec3, chosen: Option<(Plane, usize)>) -> Estimate {
    let Some((plane, neighbours)) = chosen else {
        return Estimate {
            normal: Vec3::z(),
            denoised: point,
            noise_m: 0.0,
            variation: 0.0,
            neighbours: 0,
            on_a_line: true,
        };
    };
    Estimate {
        normal: plane.normal,
        denoised: point + plane.normal * (plane.centre - point).dot(&plane.normal),
        noise_m: plane.noise_m as f32,
        variation: plane.variation as f32,
        neighbours: neighbours as u8,
        on_a_line: plane.roundness < planes::LINE,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use std::f64::consts::TAU;

    fn straight() -> Axis {
        Axis::through(&[Vec3::zeros(), Vec3::new(20.0, 0.0, 0.0)], 0.0).unwrap()
    }

    fn noise(random: &mut rand_chacha::ChaCha8Rng) -> f64 {
        (0..12).map(|_| random.random_range(-0.5..0.5)).sum::<f64>()
    }

    fn tube(count: usize, noise_m: f64) -> Vec<Vec3> {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(4);
        (0..count)
            .map(|_| {
                let (s, a) = (random.random_range(0.0..20.0), random.random_range(0.0..TAU));
                let r = 3.0 + noise_m * noise(&mut random);
                Vec3::new(s, r * a.sin(), r * a.cos())
            })
            .collect()
    }

    fn median_error_deg(cloud: &OrientedCloud) -> f64 {
        let mut errors: Vec<f64> = cloud
            .positions()
            .iter()
            .zip(cloud.normals())
            .map(|(p, n)| crate::numeric::angle_between(n, &-Vec3::new(0.0, p.y, p.z)).to_degrees())
            .collect();
        median(&mut errors).unwrap()
    }

    #[test]
    fn normals_of_a_tube_face_its_axis() {
        let geometry = GeometryCloud::from_positions(tube(60_000, 0.0));
        let (cloud, summary) = estimate(&geometry, &straight(), Viewpoints::unknown(), &Settings::default()).unwrap();
        assert!(median_error_deg(&cloud) < 0.5, "{}", median_error_deg(&cloud));
        let inwards =
            cloud.positions().iter().zip(cloud.normals()).filter(|(p, n)| n.y * p.y + n.z * p.z < 0.0).count();
        assert_eq!(inwards, cloud.len());
        assert!((summary.points, summary.profiles) == (60_000, false));
    }

    #[test]
    fn noise_is_measured_and_averaged() {
        let geometry = GeometryCloud::from_positions(tube(200_000, 0.003));
        let adaptive = estimate(&geometry, &straight(), Viewpoints::unknown(), &Settings::default()).unwrap();
        let fixed = Settings { neighbours: Some(16), ..Default::default() };
        let fixed = estimate(&geometry, &straight(), Viewpoints::unknown(), &fixed).unwrap();
        assert!(median_error_deg(&adaptive.0) < 0.8 * median_error_deg(&fixed.0));
        assert!((adaptive.1.noise_m - 0.003).abs() < 0.0005, "{}", adaptive.1.noise_m);
        let off = |points: &[Vec3]| {
            let sum: f64 = points.iter().map(|p| (p.y.hypot(p.z) - 3.0).powi(2)).sum();
            (sum / points.len() as f64).sqrt()
        };
        assert!(off(adaptive.0.denoised()) < 0.5 * off(adaptive.0.positions()));
    }

    #[test]
    fn profiles_get_surface_normals() {
        // Profiles each 0.5 m, points each 20 mm, on a tube whose radius grows by 1 in 10.
        let points: Vec<Vec3> = (0..40)
            .flat_map(|profile| {
                let s = profile as f64 * 0.5;
                let r = 3.0 + 0.1 * s;
                (0..940).map(move |i| {
                    let a = (i as f64 + 0.3 * profile as f64) / 940.0 * TAU;
                    Vec3::new(s, r * a.sin(), r * a.cos())
                })
            })
            .collect();
        let geometry = GeometryCloud::from_positions(points);
        let (cloud, summary) = estimate(&geometry, &straight(), Viewpoints::unknown(), &Settings::default()).unwrap();
        assert!(summary.profiles);
        let mut errors: Vec<f64> = cloud
            .positions()
            .iter()
            .zip(cloud.normals())
            .map(|(p, n)| {
                let radial = Vec3::new(0.0, p.y, p.z).normalize();
                crate::numeric::angle_between(n, &(Vec3::x() * 0.1 - radial)).to_degrees()
            })
            .collect();
        assert!(quantile(&mut errors, 0.95).unwrap() < 1.0, "{:?}", quantile(&mut errors, 0.95));
    }

    #[test]
    fn stations_decide_where_they_are_known() {
        use crate::cloud::Station;
        // A plate between station and axis: the axis says up, the station below says down.
        let points: Vec<Vec3> =
            (0..400).map(|i| Vec3::new((i % 20) as f64 * 0.05, (i / 20) as f64 * 0.05, -1.0)).collect();
        let geometry = GeometryCloud::from_positions(points);
        let stations = [Station { name: "a".into(), position_in_local: Some(Vec3::new(0.5, 0.5, -3.0)) }];
        let ids = vec![0u16; 400];
        let viewpoints = Viewpoints { stations: &stations, station_of_point: &ids };
        let (seen, summary) = estimate(&geometry, &straight(), viewpoints, &Settings::default()).unwrap();
        assert!(seen.normals().iter().all(|n| n.z < -0.99));
        assert_eq!(summary.oriented_by_station, 400);
        let without = Settings { use_stations: false, ..Default::default() };
        let (unseen, _) = estimate(&geometry, &straight(), viewpoints, &without).unwrap();
        assert!(unseen.normals().iter().all(|n| n.z > 0.99));
    }

    #[test]
    fn unusable_input_is_refused() {
        let two = GeometryCloud::from_positions(vec![Vec3::zeros(), Vec3::x()]);
        let error = estimate(&two, &straight(), Viewpoints::unknown(), &Settings::default()).unwrap_err();
        assert_eq!(error, Error::TooFewPoints { found: 2 });
        let three = GeometryCloud::from_positions(vec![Vec3::zeros(), Vec3::x(), Vec3::y()]);
        let settings = Settings { neighbours: Some(2), ..Default::default() };
        let error = estimate(&three, &straight(), Viewpoints::unknown(), &settings).unwrap_err();
        assert_eq!(error, Error::Neighbours { found: 2 });
    }
}
