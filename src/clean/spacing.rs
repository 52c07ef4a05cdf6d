//! How far apart the points are, in the dense and in the sparse direction.
//!
//! A profile scanner leaves points every few millimetres along a profile and half a metre between profiles. Each
//! sampled point looks at its nearest neighbours: if they lie on a line, the spacing across is the distance to the
//! nearest point more than 60 degrees off that line; else both spacings are the same.

use crate::numeric::{Mat3, Vec3};
use crate::spatial::nearest::BundleTree;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Points looked at.
const SAMPLES: usize = 2000;
/// Neighbours that decide whether the surroundings are a line.
const LINE_NEIGHBOURS: usize = 8;
/// Second over first eigenvalue of the scatter below which neighbours lie on a line.
const LINE_RATIO: f64 = 0.03;
/// Most neighbours looked at for one across the line.
const MOST_NEIGHBOURS: usize = 2048;
/// A scan is anisotropic when its sparse direction is this many times sparser than its dense one.
const ANISOTROPIC_RATIO: f64 = 4.0;

/// Typical distance between neighbouring points, metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spacing {
    /// In the dense direction: along the profiles of a profile scan.
    pub along_m: f64,
    /// In the sparse direction: between profiles. The same as `along_m` for an even scan.
    pub across_m: f64,
    /// Direction (unit, local) in which the points of a profile scan are sparse, when it is the same everywhere; the
    /// sign has no meaning. `None` for an even scan.
    pub sparse_direction: Option<[f64; 3]>,
}

impl Spacing {
    /// Spacing of evenly spread points.
    pub fn even(spacing_m: f64) -> Self {
        Self { along_m: spacing_m, across_m: spacing_m, sparse_direction: None }
    }

    /// Whether the points lie on profiles.
    pub fn is_anisotropic(&self) -> bool {
        self.across_m > ANISOTROPIC_RATIO * self.along_m
    }

    /// Median spacings over a sample of finite `points`; zero for fewer than two points.
    pub fn estimate(points: &[Vec3]) -> Self {
        Self::estimate_with(points, &BundleTree::new(points))
    }

    /// [`Self::estimate`] with the tree over the points.
    pub fn estimate_with(points: &[Vec3], tree: &BundleTree) -> Self {
        if points.len() < 2 {
            return Self::even(0.0);
        }
        let step = points.len().div_ceil(SAMPLES);
        let sample: Vec<usize> = (0..points.len()).step_by(step).collect();
        let places = tree.places_of(&sample);
        let samples: Vec<(f64, f64, Option<Vec3>)> =
            sample.into_par_iter().zip(places).filter_map(|(i, place)| around(points, tree, i, place)).collect();
        let median = |values: Vec<f64>| crate::numeric::statistics::median(&mut { values }).unwrap_or(0.0);
        let along_m = median(samples.iter().map(|s| s.0).collect());
        let across_m = median(samples.iter().map(|s| s.1).collect());
        let mut spacing = Self { along_m, across_m: across_m.max(along_m), sparse_direction: None };
        if spacing.is_anisotropic() {
            // Profile directions span the planes of the profiles; the direction they all lack is the sparse one.
            let scatter: Mat3 = samples.iter().filter_map(|s| s.2).map(|t| t * t.transpose()).sum();
            let eigen = scatter.symmetric_eigen();
            let smallest = eigen.eigenvalues.imin();
            if eigen.eigenvalues[smallest] < 0.05 * eigen.eigenvalues.sum() {
                spacing.sparse_direction = Some(eigen.eigenvectors.column(smallest).into_owned().into());
            }
        }
        spacing
    }
}

/// Spacing along and across around point `i`, which has a place in the tree, and the direction of its line if there is
/// one.
fn around(points: &[Vec3], tree: &BundleTree, i: usize, place: usize) -> Option<(f64, f64, Option<Vec3>)> {
    let p = points[i];
    let nearest = tree.nearest(place, LINE_NEIGHBOURS + 1);
    // Half the distance to the second neighbour: along a line it is the step, on a plane near enough to it.
    let gaps: Vec<f64> = nearest.iter().map(|n| n.distance_squared.sqrt()).filter(|d| *d > 0.0).collect();
    let along = *gaps.first()?;
    let offsets: Vec<Vec3> = nearest.iter().map(|n| points[n.index as usize] - p).collect();
    let mean: Vec3 = offsets.iter().sum::<Vec3>() / offsets.len() as f64;
    let scatter: Mat3 = offsets.iter().map(|o| (o - mean) * (o - mean).transpose()).sum();
    let eigen = scatter.symmetric_eigen();
    let first = eigen.eigenvalues.imax();
    let mut sorted: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
    sorted.sort_unstable_by(f64::total_cmp);
    if sorted[1] > LINE_RATIO * sorted[2] || offsets.len() <= LINE_NEIGHBOURS / 2 {
        return Some((along, along, None));
    }
    let line: Vec3 = eigen.eigenvectors.column(first).into_owned();
    let mut count = 4 * LINE_NEIGHBOURS;
    while count <= MOST_NEIGHBOURS {
        let wider = tree.nearest(place, count);
        for n in &wider {
            let offset = points[n.index as usize] - p;
            // More than 60 degrees off the line, and not just noise beside the point itself.
            if offset.dot(&line).abs() < 0.5 * offset.norm() && offset.norm() > 2.0 * along {
                return Some((along, offset.norm(), Some(line)));
            }
        }
        if wider.len() < count {
            break;
        }
        count *= 4;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lattice_is_even() {
        let points: Vec<Vec3> =
            (0..2500).map(|i| Vec3::new((i % 50) as f64 * 0.1, (i / 50) as f64 * 0.1, 0.0)).collect();
        let spacing = Spacing::estimate(&points);
        assert!((spacing.along_m - 0.1).abs() < 1e-9 && !spacing.is_anisotropic(), "{spacing:?}");
    }

    #[test]
    fn profiles_are_told_from_an_even_scan() {
        // Half circles of radius 2 m, 10 mm along, every 0.3 m along x.
        let points: Vec<Vec3> = (0..20)
            .flat_map(|profile| {
                (0..628).map(move |i| {
                    let a = i as f64 * 0.005;
                    Vec3::new(0.3 * profile as f64, 2.0 * a.cos(), 2.0 * a.sin())
                })
            })
            .collect();
        let spacing = Spacing::estimate(&points);
        assert!((spacing.along_m - 0.01).abs() < 1e-4 && (spacing.across_m - 0.3).abs() < 1e-3, "{spacing:?}");
        assert!(spacing.sparse_direction.unwrap()[0].abs() > 0.999);
    }
}
