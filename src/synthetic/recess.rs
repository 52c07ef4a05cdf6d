//! What is cut into the wall of a tunnel: crosscuts and niches, as boxes of void in section coordinates.

use super::furniture::Item;

/// Tone of the rock in a recess: red, green, blue from 0 to 1.
const ROCK: [f64; 3] = [0.46, 0.44, 0.41];

/// A box of void that opens into the tunnel.
#[derive(Clone, Debug, PartialEq)]
pub struct Recess {
    /// The box, from the plane through the axis to the far end.
    pub(super) hollow: Item,
    /// Whether it is another tunnel (a crosscut) and not a part of this one's wall (a niche).
    pub leads_away: bool,
}

impl Recess {
    /// A side drift that leaves through the right wall: lowest (chainage, up) and size of its mouth, and how far from the axis
    /// it goes, metres.
    pub fn crosscut(low_m: [f64; 2], size_m: [f64; 2], reach_m: f64) -> Self {
        Self { hollow: hollow(low_m, size_m, [0.0, reach_m]), leads_away: true }
    }

    /// A recess in the left wall, told as [`Self::crosscut`].
    pub fn niche(low_m: [f64; 2], size_m: [f64; 2], reach_m: f64) -> Self {
        Self { hollow: hollow(low_m, size_m, [-reach_m, 0.0]), leads_away: false }
    }

    /// Whether a place in section coordinates lies in the box.
    pub(super) fn holds(&self, in_section: &[f64; 3]) -> bool {
        let Item::Box { low_m, high_m, .. } = &self.hollow else { return false };
        (0..3).all(|i| (low_m[i]..=high_m[i]).contains(&in_section[i]))
    }
}

fn hollow(low_m: [f64; 2], size_m: [f64; 2], right_m: [f64; 2]) -> Item {
    Item::Box {
        low_m: [low_m[0], right_m[0], low_m[1]],
        high_m: [low_m[0] + size_m[0], right_m[1], low_m[1] + size_m[1]],
        color: ROCK,
    }
}
