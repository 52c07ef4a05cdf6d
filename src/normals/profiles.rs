//! Normals of a profile scan: dense along each profile, sparse from one profile to the next.
//!
//! Nearest neighbours would all lie on the point's own profile, and a plane by total least squares would follow the
//! relief between profiles instead of the profile. So neighbours are sought in axis coordinates with the chainage
//! compressed until both spacings are alike, and the plane is a linear regression of the height along `f x t` over the
//! axis direction `f` and the profile's tangent `t`.

use super::Estimate;
use crate::axis::Axis;
use crate::clean::Spacing;
use crate::numeric::{Mat3, Vec3};
use crate::spatial::nearest::for_each_neighbourhood;
use rayon::prelude::*;

/// Neighbours, the point included: about five on each of five profiles.
const NEIGHBOURS: usize = 24;
/// The compressed spacing between profiles, in spacings along a profile: neighbours reach over about two profiles.
const COMPRESSED: f64 = 2.0;

pub(super) fn estimate(points: &[Vec3], axis: &Axis, spacing: &Spacing, neighbours: Option<usize>) -> Vec<Estimate> {
    let ratio = COMPRESSED * spacing.along_m / spacing.across_m;
    let compressed: Vec<Vec3> = points
        .par_iter()
        .with_min_len(1024)
        .map(|p| {
            let c = axis.project(p);
            Vec3::new(c.chainage * ratio, c.right, c.up)
        })
        .collect();
    for_each_neighbourhood(&compressed, neighbours.unwrap_or(NEIGHBOURS), |i, found| {
        let chainage = compressed[i].x / ratio;
        let frame = axis.frame_at(chainage);
        let point = points[i];
        // The tangent of the profile from what lies within half the distance to the next one.
        let mut tangent_scatter = Mat3::zeros();
        for n in found {
            let offset = points[n.index as usize] - point;
            let along = offset.dot(&frame.forward);
            if along.abs() < 0.5 * spacing.across_m {
                let across = offset - frame.forward * along;
                tangent_scatter += across * across.transpose();
            }
        }
        let eigen = tangent_scatter.symmetric_eigen();
        let largest = eigen.eigenvalues.imax();
        let tangent: Vec3 = eigen.eigenvectors.column(largest).into_owned();
        let alone = eigen.eigenvalues[largest] <= 0.0;
        let up = frame.forward.cross(&tangent).normalize();
        // height = c0 + c1 forward + c2 tangent
        let mut matrix = Mat3::zeros();
        let mut right_side = Vec3::zeros();
        let row = |n: &crate::spatial::Neighbour| {
            let offset = points[n.index as usize] - point;
            (Vec3::new(1.0, offset.dot(&frame.forward), offset.dot(&tangent)), offset.dot(&up))
        };
        for n in found {
            let (basis, height) = row(n);
            matrix += basis * basis.transpose();
            right_side += basis * height;
        }
        let solved = (!alone).then(|| matrix.lu().solve(&right_side)).flatten();
        let coefficients = solved.filter(|c| c.iter().all(|v| v.is_finite()));
        let c = coefficients.unwrap_or_else(Vec3::zeros);
        let squares: f64 = found
            .iter()
            .map(|n| {
                let (basis, height) = row(n);
                (height - c.dot(&basis)).powi(2)
            })
            .sum();
        let slope = Vec3::new(1.0, c.y, c.z).norm();
        let freedom = (found.len() as f64 - 3.0).max(1.0);
        let noise = (squares / freedom).sqrt() / slope;
        let reach: f64 = found.iter().map(|n| row(n).0.z.powi(2)).sum::<f64>() / found.len() as f64;
        Estimate {
            normal: (up - frame.forward * c.y - tangent * c.z).normalize(),
            // The relief between profiles is not noise: the point stays where it was measured.
            denoised: point,
            noise_m: noise as f32,
            variation: (noise * noise / (noise * noise + reach).max(1e-30)) as f32,
            neighbours: found.len() as u8,
            on_a_line: coefficients.is_none(),
        }
    })
}
