//! The edited picture beside the pictures of the map: which of them was painted on, and where it differs.

use super::{Base, Error, MAX_TOLERANCE, NEW_COLOR, NOISE_FACTOR, SAME, SWING, rgb};
use crate::map::{Picture, Placement, color_distance};
use crate::numeric::{Vec2, statistics};
use rayon::prelude::*;

/// Share of pixels that must agree with a picture of the map for it to be the base.
const BASE_SHARE: f64 = 0.4;
/// Median difference from the base, at most.
const MAX_MEDIAN: f64 = 30.0;
/// Filters that sharpen swing by a share of the contrast within this many half pixels of the edited picture.
const RINGING_REACH: f64 = 5.0;
/// The colours of pixels so near to the edge of the surface may be mixed with what is behind it.
const EDGE_PX: f64 = 3.0;
/// JPEG mixes colours over so many pixels.
const JPEG_SPREAD_PX: f64 = 2.0;
/// Channels of an even base differ by so many grey levels.
const EVEN: u8 = 64;
/// Pixels looked at to find the base.
const BASE_SAMPLES: usize = 200_000;
/// Shapes may differ by this many pixels (rounding when a picture was resized).
const SHAPE_SLACK_PX: f64 = 1.5;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// Beside the map.
    NoSurface,
    /// As the base.
    Same,
    /// Something else than the base.
    Painted,
    /// Transparent on the surface.
    Erased,
}

/// What the base says about a pixel of the edited picture.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    pub(super) state: State,
    /// Mean colour of the base under the pixel.
    pub(super) base: [u8; 3],
    /// Whether the surface ends near: programs mix its colours with what lies behind transparency.
    pub(super) edge: bool,
    /// Whether the base is nearly even around the pixel: no edge of its own is resized or compressed there.
    pub(super) even: bool,
}

/// Where a pixel of the edited picture lies between the colours of the base.
struct Difference {
    /// Mean colour of the base under the pixel.
    mean: [u8; 3],
    /// Distance of the edited colour from the colours around.
    from_base: f64,
    /// Greatest difference of a channel among the colours around.
    contrast: u8,
}

/// Compares the edited picture with pictures of the map, pixel by pixel of the edited one.
pub(super) struct Sampler<'a> {
    pub(super) edited: &'a Picture,
    pub(super) own: Placement,
    pub(super) placement: Placement,
    pub(super) lossy: bool,
}

impl Sampler<'_> {
    /// Pixel coordinates on a picture of the map of a place on the edited picture.
    pub(super) fn map_from_edited(&self, x: f64, y: f64) -> Vec2 {
        self.placement.pixel_from_chart(self.own.chart_from_pixel(Vec2::new(x, y)))
    }

    /// Column and row of the pixel of a picture of the map under the centre of a pixel of the edited picture.
    pub(super) fn map_pixel(&self, x: usize, y: usize, picture: &Picture) -> Option<(usize, usize)> {
        let p = self.map_from_edited(x as f64 + 0.5, y as f64 + 0.5);
        let inside = p.x >= 0.0 && p.y >= 0.0 && p.x < picture.width as f64 && p.y < picture.height as f64;
        inside.then_some((p.x as usize, p.y as usize))
    }

    pub(super) fn scale(&self) -> f64 {
        self.own.step_u / self.placement.step_u
    }

    pub(super) fn is_resized(&self) -> bool {
        (self.scale() - 1.0).abs() > 1e-6
    }

    /// Mean colour of the base under a pixel, and how far the edited colour is from the colours around it. `None` beside
    /// the surface.
    fn difference(&self, x: usize, y: usize, base: &Picture) -> Option<Difference> {
        let (bx, by) = self.map_pixel(x, y, base)?;
        if base.rgba[4 * (by * base.width + bx) + 3] < 128 {
            return None;
        }
        let color = rgb(self.edited, y * self.edited.width + x);
        let own = rgb(base, by * base.width + bx);
        if !self.is_resized() && !self.lossy {
            let from_base = f64::from(color_distance(own, color)).sqrt();
            return Some(Difference { mean: own, from_base, contrast: 0 });
        }
        // In a resized picture, and in a JPEG, the colour may be any mixture of the pixels around, and sharpening filters swing beyond it
        // by a share of the contrast farther around.
        let half = 0.5 * self.scale().max(1.0);
        let p = self.map_from_edited(x as f64 + 0.5, y as f64 + 0.5);
        let range = |c: f64, reach: f64, end: usize| {
            let from = (c - reach).floor().max(0.0) as usize;
            from..((c + reach).ceil().max(1.0) as usize).min(end).max(from + 1)
        };
        let (mut low, mut high) = ([255u8; 3], [0u8; 3]);
        let (mut least, mut most) = ([255u8; 3], [0u8; 3]);
        let (mut sum, mut weight) = ([0.0; 3], 0.0);
        let near = if self.is_resized() { half + 1.0 } else { JPEG_SPREAD_PX };
        for ny in range(p.y, RINGING_REACH * half, base.height) {
            for nx in range(p.x, RINGING_REACH * half, base.width) {
                let n = ny * base.width + nx;
                let c = rgb(base, n);
                (0..3).for_each(|k| (least[k], most[k]) = (least[k].min(c[k]), most[k].max(c[k])));
                let centre = (nx as f64 + 0.5 - p.x).abs().max((ny as f64 + 0.5 - p.y).abs());
                if base.rgba[4 * n + 3] < 128 || centre > near {
                    continue;
                }
                let overlap = |i: usize, c: f64| ((i as f64 + 1.0).min(c + half) - (i as f64).max(c - half)).max(0.0);
                let w = overlap(nx, p.x) * overlap(ny, p.y);
                for k in 0..3 {
                    low[k] = low[k].min(c[k]);
                    high[k] = high[k].max(c[k]);
                    sum[k] += w * f64::from(c[k]);
                }
                weight += w;
            }
        }
        let mean = if weight > 0.0 { sum.map(|s| (s / weight).round() as u8) } else { own };
        let beyond = |k: usize| {
            let swing = SWING * f64::from(most[k] - least[k]);
            let over = low[k].saturating_sub(color[k]).max(color[k].saturating_sub(high[k]));
            (f64::from(over) - swing).max(0.0)
        };
        let from_base = (0..3).map(|k| beyond(k).powi(2)).sum::<f64>().sqrt();
        let contrast = (0..3).map(|k| high[k].saturating_sub(low[k])).max().unwrap_or(0);
        Some(Difference { mean, from_base, contrast })
    }

    /// Whether the base has no surface within a few pixels.
    fn is_near_edge(&self, x: usize, y: usize, base: &Picture) -> bool {
        let p = self.map_from_edited(x as f64 + 0.5, y as f64 + 0.5);
        let reach = EDGE_PX.max(1.5 * self.scale() + 1.0);
        [-1.0, 0.0, 1.0].iter().any(|dy| {
            [-1.0, 0.0, 1.0].iter().any(|dx| {
                let (nx, ny) = (p.x + dx * reach, p.y + dy * reach);
                let outside = !(nx >= 0.0 && ny >= 0.0 && nx < base.width as f64 && ny < base.height as f64);
                outside || base.rgba[4 * (ny as usize * base.width + nx as usize) + 3] < 128
            })
        })
    }

    /// The state of each pixel.
    pub(super) fn compare(&self, base: &Picture, labels: &Picture, tolerance: f64) -> Vec<Seen> {
        let width = self.edited.width;
        let state = |i: usize| {
            let (x, y) = (i % width, i / width);
            let nothing = Seen { state: State::NoSurface, base: [0; 3], edge: false, even: false };
            let on_labels =
                self.map_pixel(x, y, labels).is_some_and(|(c, r)| labels.rgba[4 * (r * labels.width + c) + 3] >= 128);
            if !on_labels {
                return nothing;
            }
            let edge = self.is_near_edge(x, y, base);
            let Some(difference) = self.difference(x, y, base) else {
                // Surface without a value in this picture (such as colour): what is opaque there was painted.
                let opaque =
                    self.edited.rgba[4 * i + 3] >= 128 && difference_from_grey(rgb(self.edited, i)) > NEW_COLOR;
                let state = if opaque { State::Painted } else { State::Same };
                return Seen { state, base: [255; 3], edge, even: true };
            };
            let state = if self.edited.rgba[4 * i + 3] < 128 {
                State::Erased
            } else if difference.from_base > tolerance {
                State::Painted
            } else {
                State::Same
            };
            Seen { state, base: difference.mean, edge, even: difference.contrast <= EVEN }
        };
        (0..width * self.edited.height).into_par_iter().map(state).collect()
    }
}

/// How colourful a colour is: greatest less smallest channel.
fn difference_from_grey(c: [u8; 3]) -> f64 {
    f64::from(c[0].max(c[1]).max(c[2])) - f64::from(c[0].min(c[1]).min(c[2]))
}

/// The place of a picture that shows the whole map at another resolution.
pub(super) fn whole_map(picture: &Picture, map: &Picture, placement: Placement) -> Result<Placement, Error> {
    let (fx, fy) = (map.width as f64 / picture.width as f64, map.height as f64 / picture.height as f64);
    // The height that the width asks for.
    if (map.height as f64 / fx - picture.height as f64).abs() > SHAPE_SLACK_PX {
        return Err(Error::Shape {
            width: picture.width,
            height: picture.height,
            map_width: map.width,
            map_height: map.height,
        });
    }
    let (step_u, step_v) = (placement.step_u * fx, placement.step_v * fy);
    let corner = placement.chart_from_pixel(Vec2::zeros());
    Ok(Placement { first_centre: corner + Vec2::new(step_u, step_v) / 2.0, step_u, step_v })
}

/// The picture of the map that agrees most with the edited one, and the median of the differences from it.
pub(super) fn find_base<'a>(sample: &Sampler, bases: &'a [Base]) -> Result<(&'a Base, f64), Error> {
    let width = sample.edited.width;
    let pixels = width * sample.edited.height;
    let step = (pixels / BASE_SAMPLES).max(1) | 1;
    let mut best: Option<(f64, f64, &Base)> = None;
    for base in bases {
        let mut differences: Vec<f64> = (0..pixels)
            .step_by(step)
            .filter(|&i| sample.edited.rgba[4 * i + 3] >= 128)
            .filter_map(|i| sample.difference(i % width, i / width, &base.picture).map(|d| d.from_base))
            .collect();
        let Some(median) = statistics::median(&mut differences) else { continue };
        let tolerance = (SAME + NOISE_FACTOR * median.min(MAX_MEDIAN)).min(MAX_TOLERANCE);
        let share = differences.iter().filter(|d| **d <= tolerance).count() as f64 / differences.len() as f64;
        if best.is_none_or(|(_, m, _)| median < m) {
            best = Some((share, median, base));
        }
    }
    match best {
        Some((share, median, base)) if share >= BASE_SHARE && median <= MAX_MEDIAN => Ok((base, median)),
        Some((share, median, base)) if share >= BASE_SHARE && median <= 2.0 * MAX_MEDIAN => {
            Err(Error::Noisy { closest: base.name.clone(), difference: median })
        }
        Some((share, _, base)) => Err(Error::NoBase { closest: base.name.clone(), percent: 100.0 * share }),
        None => Err(Error::NoBase { closest: "none".into(), percent: 0.0 }),
    }
}
