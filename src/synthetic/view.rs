//! Scans that do not see everything: half a tunnel, a trench without its roof, gaps, profiles with nothing between.

use super::furniture::Item;

/// Side of the patches that gaps consist of, metres of chainage and girth.
const GAP_PATCH_M: f64 = 1.5;
/// A trench keeps what lies below this share of the height of the crown over the axis.
const TRENCH_SHARE: f64 = 0.4;

/// Which part of the section is there to be seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Part {
    /// All of it.
    #[default]
    Whole,
    /// What lies right of the axis.
    RightHalf,
    /// Floor and walls without the roof.
    Trench,
}

/// What a scan sees of the tunnel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct View {
    /// Part of the section.
    pub part: Part,
    /// Share of the surface that is missing, in patches of 1.5 m, 0 to below 1.
    pub gap_share: f64,
    /// Distance between the profiles of a profile scanner, metres; `None`: an even scan.
    pub profile_m: Option<f64>,
}

impl View {
    /// Whether a place is seen; `crown_up` is the height of the crown over the axis.
    pub(super) fn sees(&self, in_section: &[f64; 3], girth: f64, crown_up: f64, seed: u64) -> bool {
        let there = match self.part {
            Part::Whole => true,
            Part::RightHalf => in_section[1] > 0.0,
            Part::Trench => in_section[2] < TRENCH_SHARE * crown_up,
        };
        there && (self.gap_share == 0.0 || share_of_patch(in_section[0], girth, seed) >= self.gap_share)
    }

    /// The place on the nearest profile, on the tunnel (`item` is `None`) or on a sheet of an item whose first or second
    /// coordinate runs along the tunnel; `None` for sheets across it, which lie between the profiles.
    pub(super) fn on_profile(&self, at: [f64; 2], item: Option<(&Item, usize)>) -> Option<[f64; 2]> {
        let Some(step) = self.profile_m else { return Some(at) };
        let snap = |chainage: f64| (chainage / step).round() * step;
        match item {
            None => Some([snap(at[0]), at[1]]),
            Some((Item::Tube { chainage_m, .. }, _)) => Some([snap(chainage_m[0] + at[0]) - chainage_m[0], at[1]]),
            Some((Item::Box { .. }, 0)) => None,
            Some((Item::Box { low_m, .. }, 1)) => Some([at[0], snap(low_m[0] + at[1]) - low_m[0]]),
            Some((Item::Box { low_m, .. }, _)) => Some([snap(low_m[0] + at[0]) - low_m[0], at[1]]),
        }
    }
}

/// A number from 0 to below 1 for the patch around a place.
fn share_of_patch(chainage: f64, girth: f64, seed: u64) -> f64 {
    let index = |metres: f64| (metres / GAP_PATCH_M).floor() as i64 as u64;
    // SplitMix64 of the two numbers and the seed.
    let mut z = seed ^ index(chainage).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ index(girth).rotate_left(32);
    for _ in 0..2 {
        z = z.wrapping_add(0x9E37_79B9_7F4A_7C15);
        z = (z ^ z >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^= z >> 31;
    }
    (z >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Alignment, ScanPlan, Section, Tunnel, scan};

    fn seen(view: View) -> (Tunnel, crate::synthetic::SyntheticScan) {
        let mut tunnel = Tunnel::smooth(Section::horseshoe(4.6, 4.2), Alignment::straight(24.0));
        tunnel.furniture.push(Item::duct(24.0, 1.0, 1.0, 0.25));
        tunnel.furniture.extend(Item::vehicle(9.0, -1.0, tunnel.section.invert_up()));
        let plan = ScanPlan { points: 30_000, range_noise_m: 0.0, view, ..ScanPlan::default() };
        let scan = scan(&tunnel, &plan).unwrap();
        (tunnel, scan)
    }

    #[test]
    fn half_a_tunnel_and_a_trench() {
        for (part, limit) in [(Part::RightHalf, [0.0, f64::MAX]), (Part::Trench, [f64::MIN, 0.85])] {
            let (tunnel, scan) = seen(View { part, ..View::default() });
            assert!((scan.cloud.len() as f64 / 30_000.0 - 1.0).abs() < 0.05, "{}", scan.cloud.len());
            for p in scan.cloud.positions() {
                let (_, right, up) = tunnel.alignment.project(p);
                assert!(right >= limit[0] && up <= limit[1], "{right} {up}");
            }
        }
    }

    #[test]
    fn the_wanted_share_is_missing() {
        let share = 0.6;
        let missing =
            (0..200).flat_map(|i| (0..50).map(move |j| share_of_patch(1.5 * f64::from(i), 1.5 * f64::from(j), 3)));
        let missing = missing.filter(|s| *s < share).count() as f64 / 10_000.0;
        assert!((missing - share).abs() < 0.02, "{missing}");
        let (_, scan) = seen(View { gap_share: share, ..View::default() });
        let truth = scan.truth.chainage_m.iter().zip(&scan.truth.girth_m).filter(|(_, g)| !g.is_nan());
        assert!(truth.into_iter().all(|(&s, &g)| share_of_patch(s, g, 1) >= share));
    }

    #[test]
    fn profiles_have_nothing_between_them() {
        let (tunnel, scan) = seen(View { profile_m: Some(0.5), ..View::default() });
        for p in scan.cloud.positions() {
            let s = tunnel.alignment.project(p).0 / 0.5;
            assert!((s - s.round()).abs() < 1e-6, "{s}");
        }
    }
}
