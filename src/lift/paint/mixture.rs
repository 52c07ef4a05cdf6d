//! Painted pixels as mixtures of the base and the colour of a class: which class, and how much of the pixel.

use super::compare::{Seen, State};
use super::{NEW_COLOR, Rules, distance, rgb};
use crate::map::{PaletteEntry, Picture};

/// A class is certain when the next one leaves this many times the tolerance more unexplained.
const MARGIN: f64 = 0.5;
/// In noisy pictures so many tolerances may stay unexplained, when the next class leaves this many times more.
const BLURRED: f64 = 3.0;
const BLURRED_MARGIN: f64 = 1.6;
/// Paint whose brightness differs from the base by this much shows its share by brightness.
const CLEAR_BRIGHTNESS: f64 = 30.0;

/// The painted pixels and what they may be painted with.
pub(super) struct Painted<'a> {
    pub(super) picture: &'a Picture,
    pub(super) seen: &'a [Seen],
    pub(super) classes: &'a [PaletteEntry],
    pub(super) rules: &'a Rules,
}

/// What a painted pixel turns out to be.
pub(super) enum Found {
    /// Painted with a class (its place in the list) to this share.
    Paint(u16, f64),
    /// A difference that the file's own noise explains.
    Noise,
    /// Painted with something that is no class.
    Nothing,
}

impl Painted<'_> {
    /// The class of a pixel whose colour leaves no doubt.
    pub(super) fn certain(&self, i: usize) -> Option<u16> {
        let mut best: Option<(f64, usize)> = None;
        let mut second = f64::INFINITY;
        for (k, class) in self.classes.iter().enumerate() {
            let (share, _) = self.unmix(i, class.color);
            let residual = self.around(i, class.color);
            // A pixel that is mostly base says nothing about the class; it may still stand against another class.
            match best {
                Some((b, _)) if residual >= b => second = second.min(residual),
                _ if share < self.rules.share => second = second.min(residual.max(self.rules.tolerance)),
                _ => {
                    second = second.min(best.map_or(f64::INFINITY, |b| b.0));
                    best = Some((residual, k));
                }
            }
        }
        let (residual, k) = best?;
        let clear = second - residual >= MARGIN * self.rules.tolerance;
        // In a noisy picture the strokes themselves are blurred; then a class has to be far better than all others.
        let distinct = self.rules.noisy
            && residual <= BLURRED * self.rules.tolerance
            && second >= (BLURRED_MARGIN * residual).max(residual + self.rules.tolerance);
        (residual <= self.rules.tolerance && clear || distinct).then_some(k as u16)
    }

    /// Painted share of a pixel: with its own class if that is certain, else with one that is certain near it.
    pub(super) fn share(&self, i: usize, certain: &[Option<u16>]) -> Found {
        if let Some(class) = certain[i] {
            // In a picture of the same size a certain pixel is painted as a whole.
            return Found::Paint(class, self.unmix(i, self.classes[usize::from(class)].color).0.max(0.5));
        }
        let (width, height) = (self.picture.width, self.picture.height);
        let (x, y) = (i % width, i / width);
        let mut near: Vec<u16> = Vec::new();
        let reach = self.rules.near;
        for ny in y.saturating_sub(reach)..(y + reach + 1).min(height) {
            for nx in x.saturating_sub(reach)..(x + reach + 1).min(width) {
                near.extend(certain[ny * width + nx]);
            }
        }
        near.sort_unstable();
        near.dedup();
        let mut best: Option<(f64, f64, u16)> = None;
        for class in near {
            let (share, residual) = self.unmix(i, self.classes[usize::from(class)].color);
            if best.is_none_or(|(_, r, _)| residual < r) {
                best = Some((share, residual, class));
            }
        }
        let difference = distance(rgb(self.picture, i), self.seen[i].base);
        // A mixture may also hold what the map showed beside the pixel, so it is judged less strictly than full colours.
        let slack = 2.0 * self.rules.tolerance + NEW_COLOR;
        match best {
            Some((share, residual, class)) if residual <= slack.max(0.5 * difference) => Found::Paint(class, share),
            _ if self.seen[i].edge || self.rules.mixed && difference <= slack => Found::Noise,
            _ => Found::Nothing,
        }
    }

    /// Root mean square of the residuals of a class around a pixel.
    fn around(&self, i: usize, color: [u8; 3]) -> f64 {
        let reach = self.rules.reach;
        if reach == 0 {
            return self.unmix(i, color).1;
        }
        let (width, height) = (self.picture.width, self.picture.height);
        let (x, y) = (i % width, i / width);
        let (mut sum, mut count) = (0.0, 0.0);
        for ny in y.saturating_sub(reach)..(y + reach + 1).min(height) {
            for nx in x.saturating_sub(reach)..(x + reach + 1).min(width) {
                let n = ny * width + nx;
                if self.seen[n].state == State::Painted {
                    sum += self.unmix(n, color).1.powi(2);
                    count += 1.0;
                }
            }
        }
        (sum / f64::max(count, 1.0)).sqrt()
    }

    /// Share of a class in the colour of a pixel, and the distance from the mixture.
    fn unmix(&self, i: usize, color: [u8; 3]) -> (f64, f64) {
        unmix(rgb(self.picture, i), self.seen[i].base, color, self.rules.lossy)
    }
}

/// `a` in 0..1 for which `base + a (paint - base)` is nearest to `color`, and the distance. A JPEG keeps brightness
/// sharper than colour, so there each has its own share, and that of the brightness counts where paint and base differ in it.
pub(super) fn unmix(color: [u8; 3], base: [u8; 3], paint: [u8; 3], lossy: bool) -> (f64, f64) {
    let difference = |a: [u8; 3], b: [u8; 3]| [0, 1, 2].map(|k| f64::from(a[k]) - f64::from(b[k]));
    let (d, v) = (difference(color, base), difference(paint, base));
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let part = |d: [f64; 3], v: [f64; 3]| {
        let share = if dot(v, v) > 0.0 { (dot(d, v) / dot(v, v)).clamp(0.0, 1.0) } else { 0.0 };
        let rest = [0, 1, 2].map(|k| d[k] - share * v[k]);
        (share, dot(rest, rest))
    };
    if !lossy {
        let (share, rest) = part(d, v);
        return (share, rest.sqrt());
    }
    // The grey part of a difference and what is left of it (Rec. 601).
    let split = |x: [f64; 3]| {
        let grey = dot(x, [0.299, 0.587, 0.114]);
        ([grey; 3], x.map(|c| c - grey))
    };
    let ((d_grey, d_color), (v_grey, v_color)) = (split(d), split(v));
    let (grey, color) = (part(d_grey, v_grey), part(d_color, v_color));
    let share = if v_grey[0].abs() >= CLEAR_BRIGHTNESS { grey.0 } else { color.0 };
    (share, (grey.1 + color.1).sqrt())
}

/// In a noisy picture a certain pixel without neighbours of its class is noise.
pub(super) fn drop_isolated(certain: &mut [Option<u16>], index: &[usize], width: usize, height: usize) {
    let before = certain.to_vec();
    for &i in index {
        let (x, y) = (i % width, i / width);
        let mut same = 0;
        for ny in y.saturating_sub(1)..(y + 2).min(height) {
            for nx in x.saturating_sub(1)..(x + 2).min(width) {
                same += usize::from(before[ny * width + nx] == before[i] && before[i].is_some());
            }
        }
        if same < 3 {
            certain[i] = None;
        }
    }
}
