//! Sets of planes: groups of poles that are near each other, as axes (a pole and its opposite are one plane).
//!
//! Average-linkage clustering of the angles between the poles, cut at `spread_deg`, finds groups without a start and so
//! without a seed; then each group's mean axis (the eigenvector of the greatest eigenvalue of the orientation tensor, which
//! does not depend on signs; N. I. Fisher, T. Lewis and B. J. J. Embleton, "Statistical Analysis of Spherical Data", 1987,
//! doi:10.1017/CBO9780511623059) attracts the poles within `spread_deg` of it until nothing changes. Groups with fewer than
//! `least` poles are no sets; their planes have none. Sets are numbered by size. With given sets the last step is done
//! once. Cost: n^3 in the number of poles at worst; thousands are fine.

use super::{Error, angle_between_planes_deg, check_orientation, dip_of, normal_of, upward};
use crate::numeric::{Mat3, Vec3};
use serde::Serialize;

/// How sets are found.
#[derive(Clone, Debug, PartialEq)]
pub struct SetSettings {
    /// A pole belongs to a set within this angle of its mean, degrees.
    pub spread_deg: f64,
    /// Fewest poles of a set.
    pub least: usize,
}

impl Default for SetSettings {
    fn default() -> Self {
        Self { spread_deg: 25.0, least: 2 }
    }
}

/// A set of planes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Set {
    /// Number, from 1; the greatest set first.
    pub number: u32,
    /// Upward mean normal.
    #[serde(skip)]
    pub normal: Vec3,
    /// Dip of the mean, degrees.
    pub dip_deg: f64,
    /// Dip direction of the mean, degrees.
    pub dip_direction_deg: f64,
    /// Planes in it.
    pub planes: usize,
    /// Concentration after Fisher, (N - 1) / (N - R): greater is tighter; absent for fewer than two planes.
    pub fisher_k: Option<f64>,
}

/// The mean axis of poles and the length of their sum, all turned to its side.
fn mean_axis(poles: &[Vec3]) -> (Vec3, f64) {
    let tensor: Mat3 = poles.iter().map(|p| p * p.transpose()).sum();
    let eigen = tensor.symmetric_eigen();
    let axis = upward(&eigen.eigenvectors.column(eigen.eigenvalues.imax()).into_owned());
    let sum: Vec3 = poles.iter().map(|p| if p.dot(&axis) < 0.0 { -p } else { *p }).sum();
    (axis, sum.norm())
}

fn set_of(number: u32, members: &[Vec3]) -> Set {
    let (axis, resultant) = mean_axis(members);
    let (dip_deg, dip_direction_deg) = dip_of(&axis);
    let n = members.len() as f64;
    let fisher_k = (members.len() > 1).then(|| (n - 1.0) / (n - resultant).max(1e-12));
    Set { number, normal: axis, dip_deg, dip_direction_deg, planes: members.len(), fisher_k }
}

/// The nearest axis within the spread.
fn nearest(pole: &Vec3, axes: &[Vec3], spread_deg: f64) -> Option<usize> {
    axes.iter()
        .map(|a| angle_between_planes_deg(pole, a))
        .enumerate()
        .filter(|(_, angle)| *angle <= spread_deg)
        .min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)))
        .map(|(i, _)| i)
}

/// Finds sets; for each normal the number of its set or `None`.
///
/// # Errors
/// [`Error::Setting`] for a spread that is not between 0 and 90 degrees.
pub fn sets(normals: &[Vec3], settings: &SetSettings) -> Result<(Vec<Set>, Vec<Option<u32>>), Error> {
    if !(settings.spread_deg > 0.0 && settings.spread_deg < 90.0) {
        return Err(Error::Setting { key: "spread_deg", value: settings.spread_deg, must: "between 0 and 90" });
    }
    let mut groups = linked(normals, settings.spread_deg);
    groups.retain(|g| g.len() >= settings.least);
    let members = |group: &Vec<usize>| group.iter().map(|&i| normals[i]).collect::<Vec<_>>();
    let mut owner: Vec<Option<usize>> = vec![None; normals.len()];
    for _ in 0..50 {
        let axes: Vec<Vec3> = groups.iter().map(|g| mean_axis(&members(g)).0).collect();
        let next: Vec<Option<usize>> = normals.iter().map(|n| nearest(n, &axes, settings.spread_deg)).collect();
        if next == owner {
            break;
        }
        owner = next;
        groups = (0..axes.len()).map(|k| (0..normals.len()).filter(|&i| owner[i] == Some(k)).collect()).collect();
        // A group that lost its planes to its neighbours is none any more.
        groups.retain(|g| g.len() >= settings.least.max(1));
    }
    groups.sort_by(|a, b| b.len().cmp(&a.len()).then(a.cmp(b)));
    let mut numbers = vec![None; normals.len()];
    let found = groups
        .iter()
        .enumerate()
        .map(|(k, group)| {
            group.iter().for_each(|&i| numbers[i] = Some(k as u32 + 1));
            set_of(k as u32 + 1, &members(group))
        })
        .collect();
    Ok((found, numbers))
}

/// Puts each plane into the nearest of the given sets (name, dip, dip direction) within the spread. The sets keep the
/// given order; their means are those of the planes, or as given where there are none.
///
/// # Errors
/// [`Error::Orientation`] for a set out of range, [`Error::Setting`] as [`sets`].
pub fn given_sets(
    normals: &[Vec3],
    given: &[(String, f64, f64)],
    settings: &SetSettings,
) -> Result<(Vec<Set>, Vec<Option<u32>>), Error> {
    if !(settings.spread_deg > 0.0 && settings.spread_deg < 90.0) {
        return Err(Error::Setting { key: "spread_deg", value: settings.spread_deg, must: "between 0 and 90" });
    }
    let mut axes = Vec::new();
    for (name, dip, direction) in given {
        check_orientation(name, *dip, *direction)?;
        axes.push(normal_of(*dip, *direction));
    }
    let owner: Vec<Option<usize>> = normals.iter().map(|n| nearest(n, &axes, settings.spread_deg)).collect();
    let found = axes
        .iter()
        .enumerate()
        .map(|(k, axis)| {
            let members: Vec<Vec3> =
                normals.iter().zip(&owner).filter(|(_, o)| **o == Some(k)).map(|(n, _)| *n).collect();
            if members.is_empty() {
                let (dip_deg, dip_direction_deg) = dip_of(axis);
                let normal = *axis;
                Set { number: k as u32 + 1, normal, dip_deg, dip_direction_deg, planes: 0, fisher_k: None }
            } else {
                set_of(k as u32 + 1, &members)
            }
        })
        .collect();
    Ok((found, owner.into_iter().map(|o| o.map(|k| k as u32 + 1)).collect()))
}

/// Average-linkage groups with a mean angle of at most `limit_deg` between them, each sorted, in order of their first pole.
fn linked(normals: &[Vec3], limit_deg: f64) -> Vec<Vec<usize>> {
    let n = normals.len();
    let mut distance: Vec<f64> =
        (0..n * n).map(|i| angle_between_planes_deg(&normals[i / n], &normals[i % n])).collect();
    let mut groups: Vec<Option<Vec<usize>>> = (0..n).map(|i| Some(vec![i])).collect();
    loop {
        let mut best: Option<(f64, usize, usize)> = None;
        for i in 0..n {
            if groups[i].is_none() {
                continue;
            }
            for j in i + 1..n {
                if groups[j].is_some() && best.is_none_or(|b| distance[i * n + j] < b.0) {
                    best = Some((distance[i * n + j], i, j));
                }
            }
        }
        let Some((_, i, j)) = best.filter(|b| b.0 <= limit_deg) else { break };
        let second = groups[j].take().expect("it was there");
        let first = groups[i].as_mut().expect("it was there");
        let (a, b) = (first.len() as f64, second.len() as f64);
        first.extend(second);
        for k in 0..n {
            let mean = (a * distance[i * n + k] + b * distance[j * n + k]) / (a + b);
            distance[i * n + k] = mean;
            distance[k * n + i] = mean;
        }
    }
    let mut groups: Vec<Vec<usize>> = groups.into_iter().flatten().collect();
    groups.iter_mut().for_each(|g| g.sort_unstable());
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three sets of four, one of them steep, so that its poles lie on both sides of the horizon.
    fn poles() -> Vec<Vec3> {
        let mut poles = Vec::new();
        for (dip, direction) in [(20.0, 40.0), (88.0, 130.0), (60.0, 265.0)] {
            for (a, b) in [(-4.0, 3.0), (1.5, 4.0), (4.0, -5.0), (-1.0, -2.0)] {
                poles.push(normal_of(dip + a, direction + b) * if a > 0.0 { -1.0 } else { 1.0 });
            }
        }
        poles
    }

    #[test]
    fn sets_are_found_whatever_the_signs_and_the_order() {
        let given = poles();
        let (found, numbers) = sets(&given, &SetSettings::default()).unwrap();
        assert_eq!(found.len(), 3);
        for k in 0..3 {
            assert!(numbers[4 * k].is_some() && numbers[4 * k..4 * k + 4].iter().all(|n| *n == numbers[4 * k]));
            let (mean, _) = mean_axis(&given[4 * k..4 * k + 4]);
            let set = &found[numbers[4 * k].unwrap() as usize - 1];
            assert!(angle_between_planes_deg(&mean, &set.normal) < 1e-9 && set.fisher_k.unwrap() > 100.0);
        }
        let reversed: Vec<Vec3> = given.iter().rev().map(|p| -p).collect();
        let (other, _) = sets(&reversed, &SetSettings::default()).unwrap();
        for set in &found {
            assert!(other.iter().any(|o| angle_between_planes_deg(&o.normal, &set.normal) < 1e-9));
        }
    }

    #[test]
    fn a_lonely_pole_is_in_no_set_and_given_sets_are_kept() {
        let mut all = poles();
        all.push(normal_of(45.0, 320.0));
        let (found, numbers) = sets(&all, &SetSettings::default()).unwrap();
        assert_eq!((found.len(), numbers[12]), (3, None));
        let given = [("J1".to_owned(), 60.0, 265.0), ("J2".to_owned(), 5.0, 0.0)];
        let (found, numbers) = given_sets(&all, &given, &SetSettings::default()).unwrap();
        assert_eq!((numbers[8], numbers[0], numbers[4]), (Some(1), Some(2), None));
        assert_eq!((found[0].planes, found[1].planes), (4, 4));
        assert!(given_sets(&all, &[("x".into(), 95.0, 0.0)], &SetSettings::default()).is_err());
    }
}
