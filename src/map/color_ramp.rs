//! Colours for values: a diverging ramp for signed distances, a sequential one for stretch, distinct ones for labels.

use serde::{Deserialize, Serialize};

/// Colour ramps; every colour between two stops is interpolated linearly in sRGB.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ramp {
    /// Blue - nearly white - red; the middle is zero.
    Diverging,
    /// Nearly white - yellow - red - dark violet; the first colour is "nothing to worry about".
    Heat,
}

/// Stops chosen by us: even steps of lightness, readable by people with red-green blindness.
const DIVERGING: [[u8; 3]; 9] = [
    [16, 52, 110],
    [38, 104, 172],
    [104, 166, 206],
    [184, 213, 231],
    [245, 244, 240],
    [250, 205, 176],
    [232, 134, 97],
    [190, 58, 55],
    [104, 12, 32],
];

const HEAT: [[u8; 3]; 6] =
    [[250, 249, 244], [254, 226, 142], [250, 163, 72], [220, 82, 56], [146, 26, 84], [58, 9, 82]];

impl Ramp {
    /// The colour at `t`, 0 to 1 (clamped; NaN counts as 0).
    pub fn color(self, t: f64) -> [u8; 3] {
        let stops: &[[u8; 3]] = match self {
            Ramp::Diverging => &DIVERGING,
            Ramp::Heat => &HEAT,
        };
        let t = if t.is_nan() { 0.0 } else { t.clamp(0.0, 1.0) };
        let position = t * (stops.len() - 1) as f64;
        let i = (position as usize).min(stops.len() - 2);
        let f = position - i as f64;
        let mix = |k: usize| f64::from(stops[i][k]) * (1.0 - f) + f64::from(stops[i + 1][k]) * f;
        [0, 1, 2].map(|k| (mix(k) + 0.5) as u8)
    }
}

/// Colours of the first labels: strong, and far from each other and from the grey of rock.
const LABEL_COLORS: [[u8; 3]; 12] = [
    [228, 26, 28],
    [31, 98, 205],
    [51, 160, 44],
    [255, 127, 0],
    [152, 50, 163],
    [0, 184, 202],
    [247, 55, 164],
    [166, 86, 40],
    [238, 201, 0],
    [96, 72, 220],
    [126, 186, 0],
    [0, 118, 108],
];

/// The colour of a label (not 0). Later labels walk round the colour circle by the golden angle.
pub fn label_color(label: u32) -> [u8; 3] {
    let index = label.wrapping_sub(1) as usize;
    if let Some(&color) = LABEL_COLORS.get(index) {
        return color;
    }
    const GOLDEN: f64 = 0.618_033_988_749_895;
    let hue = (index as f64 * GOLDEN).fract();
    let (saturation, value) = ([0.9, 0.6, 0.75][index % 3], [0.85, 0.95, 0.6][index / 3 % 3]);
    let channel = |offset: f64| {
        let k = (offset + hue * 6.0) % 6.0;
        let c = value - value * saturation * k.min(4.0 - k).clamp(0.0, 1.0);
        (c * 255.0f64).round() as u8
    };
    [channel(5.0), channel(3.0), channel(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ramps_start_and_end_at_their_stops() {
        assert_eq!(Ramp::Diverging.color(-3.0), DIVERGING[0]);
        assert_eq!(Ramp::Diverging.color(0.5), DIVERGING[4]);
        assert_eq!(Ramp::Heat.color(2.0), HEAT[5]);
        assert_eq!(Ramp::Heat.color(f64::NAN), HEAT[0]);
    }

    #[test]
    fn first_labels_are_far_apart() {
        for a in 1..=12u32 {
            for b in 1..a {
                let (x, y) = (label_color(a), label_color(b));
                let d: i32 = (0..3).map(|k| (i32::from(x[k]) - i32::from(y[k])).pow(2)).sum();
                assert!(d > 2000, "labels {a} and {b}: {x:?} {y:?}");
            }
        }
    }
}
