//! How the rock looks: tones, foliation, veins, weathering, damp, paint and muck.

use super::relief::Noise;
use crate::numeric::Vec3;

/// Width over which a fracture stains the rock beside it, metres.
const STAIN_M: f64 = 0.10;

/// What the colour of a place depends on, beside the rock itself.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    /// Section coordinates: chainage, right, up.
    pub in_section: [f64; 3],
    /// Position in local metres.
    pub position: Vec3,
    /// Height of the relief relative to its amplitude, -1 to 1 or so; positive is deeper in the rock.
    pub depth: f64,
    /// Slope of the relief along the tunnel and towards the crown.
    pub slope: [f64; 2],
    /// Distance along the wall to the nearest fracture trace, metres, and half the width of that trace.
    pub trace: (f64, f64),
    /// Whether the place is floor.
    pub is_floor: bool,
    /// Paint, if any.
    pub paint: Option<[f64; 3]>,
}

/// A rock with its own pattern of tones.
#[derive(Clone, Debug, PartialEq)]
pub struct Rock {
    tones: Noise,
    grain: Noise,
    stains: Noise,
    /// Direction across the foliation, local.
    foliation: Vec3,
}

impl Rock {
    /// The rock of a seed.
    pub fn new(seed: u64) -> Self {
        Self {
            tones: Noise::new(seed, 2),
            grain: Noise::new(seed, 3),
            stains: Noise::new(seed, 4),
            foliation: Vec3::new(0.55, 0.35, 0.76).normalize(),
        }
    }

    /// Red, green, blue from 0 to 1, and reflectance in infrared from 0 to 1.
    pub(super) fn appearance(&self, place: &Place) -> ([f64; 3], f64) {
        let p: [f64; 3] = place.position.into();
        let scaled = |metres: f64| p.map(|c| c / metres);
        let grain = self.grain.at(scaled(0.035)) + 0.6 * self.grain.at(scaled(0.012));
        let mut color;
        let mut reflectance;
        if place.is_floor {
            let gravel = self.grain.fractal(scaled(0.12), 3);
            let wet = step(0.05, 0.35, self.stains.fractal(scaled(2.5), 2));
            color = mix([0.47, 0.43, 0.37], [0.30, 0.28, 0.25], wet).map(|c| c * (1.0 + 0.25 * gravel + 0.06 * grain));
            reflectance = 0.45 - 0.2 * wet + 0.1 * gravel;
        } else {
            // Two tones in bands that follow a warped foliation, and thin bright veins along it.
            let warp = self.tones.fractal(scaled(2.2), 3);
            let layer = place.position.dot(&self.foliation) / 0.55 + 1.6 * warp;
            let band = step(
                -0.5,
                0.6,
                self.tones.at([layer, 0.37 * layer, 2.5]) + 0.5 * self.tones.at([3.1 * layer, 7.7, 1.3]),
            );
            let cloud = step(-0.6, 0.6, self.tones.fractal(scaled(4.0), 3));
            let cold = mix([0.43, 0.45, 0.47], [0.64, 0.64, 0.62], band);
            let warm = mix([0.50, 0.43, 0.37], [0.71, 0.65, 0.57], band);
            color = mix(cold, warm, cloud);
            let vein = step(0.035, 0.012, (self.tones.at([0.45 * layer, 11.0, 4.0]) - 0.28).abs());
            color = mix(color, [0.86, 0.84, 0.80], 0.75 * vein);
            reflectance = 0.45 + 0.2 * band + 0.25 * vein;
            // Damp runs down the wall from the roof.
            let [s, right, up] = place.in_section;
            let damp = step(0.18, 0.45, self.stains.at([s / 0.9, right / 6.0, up / 5.0]))
                * step(-0.1, 0.35, self.stains.at([s / 3.5 + 9.0, right / 4.0, up / 4.0]));
            color = mix(color, [0.24, 0.23, 0.21], 0.5 * damp);
            reflectance *= 1.0 - 0.45 * damp;
            color = color.map(|c| c * (1.0 + 0.07 * grain));
        }
        // Fresh breaks catch the light of the lamp, hollows lie in shade.
        let light = (1.0 + 0.55 * place.slope[0] + 0.35 * place.slope[1] - 0.10 * place.depth).clamp(0.55, 1.35);
        color = color.map(|c| c * light);
        let (distance, half_width) = place.trace;
        if distance < 3.0 * STAIN_M && !place.is_floor {
            let patchy = 0.65 + 0.5 * self.stains.fractal(scaled(0.25), 2);
            let rust = patchy * (-(distance / STAIN_M).powi(2)).exp();
            color = mix(color, [0.56, 0.32, 0.14], (0.75 * rust).clamp(0.0, 0.8));
            let open = step(1.0, 0.75, distance / half_width);
            color = mix(color, [0.10, 0.08, 0.07], 0.9 * open);
            reflectance = reflectance * (1.0 - 0.3 * rust) * (1.0 - 0.75 * open);
        }
        if let Some(paint) = place.paint {
            let worn = step(0.25, 0.6, self.grain.fractal(scaled(0.09), 2));
            color = mix(color, paint.map(|c| c * (0.92 + 0.08 * light)), 0.95 - 0.5 * worn);
            reflectance = reflectance + (0.95 - reflectance) * (0.95 - 0.5 * worn);
        }
        (color.map(|c| c.clamp(0.02, 1.0)), reflectance.clamp(0.03, 1.0))
    }
}

/// Smooth step from 0 at `low` to 1 at `high` (which may lie below `low`).
pub(super) fn step(low: f64, high: f64, x: f64) -> f64 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

fn mix(a: [f64; 3], b: [f64; 3], share: f64) -> [f64; 3] {
    [0, 1, 2].map(|i| a[i] + (b[i] - a[i]) * share)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place() -> Place {
        Place {
            in_section: [3.0, 1.0, 1.0],
            position: Vec3::new(3.0, -1.0, 1.0),
            depth: 0.0,
            slope: [0.0; 2],
            trace: (f64::INFINITY, 0.03),
            is_floor: false,
            paint: None,
        }
    }

    #[test]
    fn fractures_are_dark_and_paint_is_bright() {
        let rock = Rock::new(5);
        let brightness = |p: &Place| rock.appearance(p).0.iter().sum::<f64>() / 3.0;
        let plain = brightness(&place());
        let open = brightness(&Place { trace: (0.0, 0.02), ..place() });
        let painted = brightness(&Place { paint: Some([0.95; 3]), ..place() });
        assert!(open < 0.5 * plain && painted > plain, "{open} {plain} {painted}");
        assert!((0.2..0.85).contains(&plain));
    }

    #[test]
    fn the_pattern_belongs_to_the_seed() {
        assert_eq!(Rock::new(5).appearance(&place()), Rock::new(5).appearance(&place()));
        assert_ne!(Rock::new(5).appearance(&place()).0, Rock::new(6).appearance(&place()).0);
    }
}
