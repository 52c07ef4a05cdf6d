//! What stands and hangs in a tunnel and hides the rock: ducts, cables, rails, vehicles.
//!
//! All items are described in section coordinates (chainage, right, up), so they follow the bends of the tunnel.

/// One thing in the tunnel.
#[derive(Clone, Debug, PartialEq)]
pub enum Item {
    /// A tube along the tunnel: a duct, pipe, cable or (roughly) a rail.
    Tube {
        /// Chainage of its ends, metres.
        chainage_m: [f64; 2],
        /// Its centre line in (right, up), metres.
        centre_m: [f64; 2],
        /// Its radius, metres.
        radius_m: f64,
        /// Colour: red, green, blue from 0 to 1.
        color: [f64; 3],
    },
    /// A box: the body of a vehicle, a cabinet, a stack of material.
    Box {
        /// Lowest (chainage, right, up), metres.
        low_m: [f64; 3],
        /// Highest (chainage, right, up), metres.
        high_m: [f64; 3],
        /// Colour: red, green, blue from 0 to 1.
        color: [f64; 3],
    },
}

/// A rectangular piece of an item's surface with its own coordinates (a, b), metres.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Sheet {
    pub item: usize,
    /// Side of a box: axis 0-2, and 0 for the low or 1 for the high side. Unused for tubes.
    side: (usize, usize),
    /// Size in (a, b), metres.
    pub size: [f64; 2],
}

impl Sheet {
    /// The axis across a side of a box: 0 along the tunnel, 1 right, 2 up.
    pub fn axis(&self) -> usize {
        self.side.0
    }
}

impl Item {
    /// A ventilation duct along the whole tunnel.
    pub fn duct(length_m: f64, right: f64, up: f64, radius_m: f64) -> Self {
        Self::Tube { chainage_m: [0.0, length_m], centre_m: [right, up], radius_m, color: [0.93, 0.78, 0.20] }
    }

    /// A cable along the whole tunnel.
    pub fn cable(length_m: f64, right: f64, up: f64) -> Self {
        Self::Tube { chainage_m: [0.0, length_m], centre_m: [right, up], radius_m: 0.025, color: [0.08, 0.08, 0.09] }
    }

    /// Two rails on the floor.
    pub fn rails(length_m: f64, gauge_m: f64, floor_up: f64) -> [Self; 2] {
        [-0.5, 0.5].map(|side| Self::Tube {
            chainage_m: [0.0, length_m],
            centre_m: [side * gauge_m, floor_up + 0.07],
            radius_m: 0.04,
            color: [0.35, 0.26, 0.21],
        })
    }

    /// A parked pick-up: body and cab, 4.6 m long, 1.6 m wide, 1.7 m high, on the floor.
    pub fn vehicle(chainage_m: f64, right: f64, floor_up: f64) -> [Self; 2] {
        let around = |from: f64, to: f64, low: f64, high: f64, half: f64, color| Self::Box {
            low_m: [chainage_m + from, right - half, floor_up + low],
            high_m: [chainage_m + to, right + half, floor_up + high],
            color,
        };
        [around(-2.3, 2.3, 0.35, 1.0, 0.8, [0.90, 0.38, 0.08]), around(-0.9, 1.1, 1.0, 1.7, 0.72, [0.85, 0.36, 0.10])]
    }

    pub(super) fn color(&self) -> [f64; 3] {
        match self {
            Item::Tube { color, .. } | Item::Box { color, .. } => *color,
        }
    }

    /// The sheets that make up the surface.
    pub(super) fn sheets(&self, item: usize) -> Vec<Sheet> {
        match self {
            Item::Tube { chainage_m, radius_m, .. } => {
                let size = [chainage_m[1] - chainage_m[0], std::f64::consts::TAU * radius_m];
                vec![Sheet { item, side: (0, 0), size }]
            }
            Item::Box { low_m, high_m, .. } => (0..6)
                .map(|k| {
                    let axis = k / 2;
                    let size = [(axis + 1) % 3, (axis + 2) % 3].map(|i| high_m[i] - low_m[i]);
                    Sheet { item, side: (axis, k % 2), size }
                })
                .collect(),
        }
    }

    /// Place and unit normal (out of the item) in section coordinates at (a, b) of one of the sheets.
    pub(super) fn place(&self, sheet: &Sheet, a: f64, b: f64) -> ([f64; 3], [f64; 3]) {
        match self {
            Item::Tube { chainage_m, centre_m, radius_m, .. } => {
                let (sin, cos) = (b / radius_m).sin_cos();
                let place = [chainage_m[0] + a, centre_m[0] + radius_m * sin, centre_m[1] + radius_m * cos];
                (place, [0.0, sin, cos])
            }
            Item::Box { low_m, high_m, .. } => {
                let (axis, high) = sheet.side;
                let mut place = [0.0; 3];
                let mut normal = [0.0; 3];
                place[axis] = if high == 1 { high_m[axis] } else { low_m[axis] };
                normal[axis] = if high == 1 { 1.0 } else { -1.0 };
                place[(axis + 1) % 3] = low_m[(axis + 1) % 3] + a;
                place[(axis + 2) % 3] = low_m[(axis + 2) % 3] + b;
                (place, normal)
            }
        }
    }

    /// Whether the straight line between two places in section coordinates meets the item.
    pub(super) fn blocks(&self, from: &[f64; 3], to: &[f64; 3]) -> bool {
        let along = [0, 1, 2].map(|i| to[i] - from[i]);
        match self {
            Item::Tube { chainage_m, centre_m, radius_m, .. } => {
                let start = [from[1] - centre_m[0], from[2] - centre_m[1]];
                let (a, b) = (along[1] * along[1] + along[2] * along[2], start[0] * along[1] + start[1] * along[2]);
                let c = start[0] * start[0] + start[1] * start[1] - radius_m * radius_m;
                let root = b * b - a * c;
                if root <= 0.0 || a == 0.0 {
                    return c < 0.0 && a == 0.0;
                }
                let (enter, leave) = ((-b - root.sqrt()) / a, (-b + root.sqrt()) / a);
                let chainage = |t: f64| from[0] + along[0] * t;
                let (enter, leave) = (enter.max(0.0), leave.min(1.0));
                enter < leave
                    && chainage(enter).max(chainage(leave)) > chainage_m[0]
                    && chainage(enter).min(chainage(leave)) < chainage_m[1]
            }
            Item::Box { low_m, high_m, .. } => {
                let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
                for i in 0..3 {
                    if along[i] == 0.0 {
                        if from[i] <= low_m[i] || from[i] >= high_m[i] {
                            return false;
                        }
                        continue;
                    }
                    let (x, y) = ((low_m[i] - from[i]) / along[i], (high_m[i] - from[i]) / along[i]);
                    enter = enter.max(x.min(y));
                    leave = leave.min(x.max(y));
                }
                enter < leave
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tube_blocks_what_passes_through_it() {
        let duct = Item::duct(10.0, 1.0, 1.0, 0.3);
        assert!(duct.blocks(&[5.0, 0.0, 0.0], &[5.0, 2.0, 2.0]));
        assert!(duct.blocks(&[-3.0, 0.0, 0.0], &[9.0, 2.0, 2.0]), "obliquely");
        assert!(!duct.blocks(&[5.0, 0.0, 0.0], &[5.0, 2.0, 0.5]), "below it");
        assert!(!duct.blocks(&[5.0, 0.0, 0.0], &[5.0, 0.7, 0.7]), "short of it");
        assert!(!duct.blocks(&[11.0, 0.0, 0.0], &[12.0, 2.0, 2.0]), "beyond its end");
    }

    #[test]
    fn a_box_blocks_what_passes_through_it() {
        let [body, _] = Item::vehicle(5.0, 0.0, -2.0);
        assert!(body.blocks(&[0.0, 0.0, -1.3], &[10.0, 0.0, -1.3]));
        assert!(!body.blocks(&[0.0, 1.0, -1.3], &[10.0, 1.0, -1.3]));
        assert!(!body.blocks(&[0.0, 0.0, -1.3], &[2.6, 0.0, -1.3]), "short of it");
    }

    #[test]
    fn sheets_cover_the_surface_with_outward_normals() {
        let [body, _] = Item::vehicle(5.0, 0.0, -2.0);
        let sheets = body.sheets(0);
        let area: f64 = sheets.iter().map(|s| s.size[0] * s.size[1]).sum();
        assert!((area - 2.0 * (4.6 * 1.6 + 4.6 * 0.65 + 1.6 * 0.65)).abs() < 1e-9);
        for item in [body, Item::duct(10.0, 1.0, 1.0, 0.3)] {
            for sheet in item.sheets(0) {
                let (p, n) = item.place(&sheet, 0.4 * sheet.size[0], 0.3 * sheet.size[1]);
                let ahead = |d: f64| [0, 1, 2].map(|i| p[i] + d * n[i]);
                assert!(item.blocks(&ahead(0.2), &ahead(-0.2)) && !item.blocks(&ahead(0.2), &ahead(1e-6)));
            }
        }
    }
}
