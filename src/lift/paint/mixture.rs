//! Painted pixels as mixtures of the base and the colour of a class: which class, and how much of the pixel.

use super::window::{Seen, State};
use super::{CERTAIN_SHARE_RESIZED, Rules, distance, rgb};
use crate::map::Picture;

/// A class is certain when the next one leaves this many times the tolerance more unexplained.
const MARGIN: f64 = 0.5;
/// In noisy pictures so many tolerances may stay unexplained, when the next class leaves this many times more.
const BLURRED: f64 = 3.0;
const BLURRED_MARGIN: f64 = 1.6;
/// Classes this near to each other are mistaken for one another at the edges of strokes.
const ALIKE: f64 = 60.0;
/// Paint whose brightness differs from the base by this much shows its share by brightness.
const CLEAR_BRIGHTNESS: f64 = 30.0;

/// The painted pixels and what they may be painted with.
pub(super) struct Painted<'a> {
    pub(super) picture: &'a Picture,
    pub(super) seen: &'a [Seen],
    /// Colours of the classes.
    pub(super) classes: &'a [[u8; 3]],
    pub(super) rules: &'a Rules,
}

/// One class or two (their places in the list) that a pixel is painted with, and how much of it.
pub(super) type Shares = [(u16, f64); 2];

impl Painted<'_> {
    /// The class of a pixel whose colour leaves no doubt.
    pub(super) fn certain(&self, i: usize) -> Option<u16> {
        let mut best: Option<(f64, usize)> = None;
        let mut second = f64::INFINITY;
        for (k, &color) in self.classes.iter().enumerate() {
            let (share, _) = self.unmix(i, color);
            let residual = self.around(i, color);
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

    /// Whether a class may explain most of a pixel.
    pub(super) fn is_plausible(&self, i: usize, class: u16) -> bool {
        let color = self.classes[usize::from(class)];
        self.unmix(i, color).0 >= CERTAIN_SHARE_RESIZED && self.around(i, color) <= BLURRED * self.rules.tolerance
    }

    /// Whether the class of a pixel that seems certain is doubtful: two other classes that prevail around or have greater shares
    /// there explain the pixel as well, or a class of nearly the same colour prevails around.
    pub(super) fn is_doubtful(&self, i: usize, certain: &[Option<u16>]) -> bool {
        let Some(own) = certain[i] else { return false };
        let color = |class: u16| self.classes[usize::from(class)];
        let (share, residual) = self.unmix(i, color(own));
        // Class, pixels of it, and whether one of them holds more of it than this one of its own.
        let mut near: Vec<(u16, usize, bool)> = Vec::new();
        for n in self.around_px(i, self.rules.near) {
            let Some(class) = certain[n] else { continue };
            let stronger = class != own && self.unmix(n, color(class)).0 > share;
            match near.iter_mut().find(|c| c.0 == class) {
                Some(known) => *known = (class, known.1 + 1, known.2 || stronger),
                None => near.push((class, 1, stronger)),
            }
        }
        let count = near.iter().find(|c| c.0 == own).map_or(0, |c| c.1);
        let prevails = |c: &&(u16, usize, bool)| c.0 != own && c.1 > count;
        if near.iter().filter(prevails).any(|c| distance(color(c.0), color(own)) < ALIKE) {
            return true;
        }
        let stronger: Vec<u16> = near.iter().filter(|c| c.2 || prevails(c)).map(|c| c.0).collect();
        stronger.iter().enumerate().any(|(k, &a)| {
            stronger[..k].iter().any(|&b| {
                let (_, pair) = unmix(rgb(self.picture, i), color(a), color(b), self.rules);
                pair <= residual + self.rules.tolerance
            })
        })
    }

    /// Pixels of the picture within a distance in columns and rows, row by row.
    pub(super) fn around_px(&self, i: usize, reach: usize) -> impl Iterator<Item = usize> + use<> {
        let (width, height) = (self.picture.width, self.picture.height);
        let (x, y) = (i % width, i / width);
        (y.saturating_sub(reach)..(y + reach + 1).min(height))
            .flat_map(move |ny| (x.saturating_sub(reach)..(x + reach + 1).min(width)).map(move |nx| ny * width + nx))
    }

    /// Painted share of a pixel: with its own class if that is certain, else with one or two that are certain near it.
    /// Gives what that leaves unexplained, too.
    pub(super) fn share(&self, i: usize, certain: &[Option<u16>]) -> Option<(f64, Shares)> {
        if let Some(class) = certain[i] {
            // In a picture of the same size a certain pixel is painted as a whole.
            let (share, residual) = self.unmix(i, self.classes[usize::from(class)]);
            return Some((residual, [(class, share.max(0.5)), (class, 0.0)]));
        }
        let mut near: Vec<u16> = self.around_px(i, self.rules.near).filter_map(|n| certain[n]).collect();
        near.sort_unstable();
        near.dedup();
        let mut best: Option<(f64, Shares)> = None;
        let mut better = |residual: f64, paint: Shares| {
            if best.is_none_or(|(r, _)| residual < r) {
                best = Some((residual, paint));
            }
        };
        let color = |class: u16| self.classes[usize::from(class)];
        for (k, &a) in near.iter().enumerate() {
            let (share, residual) = self.unmix(i, color(a));
            better(residual, [(a, share), (a, 0.0)]);
            // Where two classes touch, a pixel may hold both and nothing of the base.
            for &b in &near[..k] {
                let (share, residual) = unmix(rgb(self.picture, i), color(b), color(a), self.rules);
                better(residual + 0.5 * self.rules.tolerance, [(a, share), (b, 1.0 - share)]);
            }
        }
        best
    }

    /// Root mean square of the residuals of a class around a pixel.
    fn around(&self, i: usize, color: [u8; 3]) -> f64 {
        let reach = self.rules.reach;
        if reach == 0 {
            return self.unmix(i, color).1;
        }
        let (mut sum, mut count) = (0.0, 0.0);
        for n in self.around_px(i, reach).filter(|&n| self.seen[n].state == State::Painted) {
            sum += self.unmix(n, color).1.powi(2);
            count += 1.0;
        }
        (sum / f64::max(count, 1.0)).sqrt()
    }

    /// Share of a class in the colour of a pixel, and the distance from the mixture.
    fn unmix(&self, i: usize, color: [u8; 3]) -> (f64, f64) {
        unmix(rgb(self.picture, i), self.seen[i].base, color, self.rules)
    }
}

/// `a` in 0..1 for which `base + a (paint - base)` is nearest to `color`, and the distance. A JPEG keeps brightness
/// sharper than colour, so there each has its own share, and that of the brightness counts where paint and base differ in it.
pub(super) fn unmix(color: [u8; 3], base: [u8; 3], paint: [u8; 3], rules: &Rules) -> (f64, f64) {
    let difference = |a: [u8; 3], b: [u8; 3]| [0, 1, 2].map(|k| f64::from(a[k]) - f64::from(b[k]));
    let (d, v) = (difference(color, base), difference(paint, base));
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let part = |d: [f64; 3], v: [f64; 3]| {
        let share = if dot(v, v) > 0.0 { dot(d, v) / dot(v, v) } else { 0.0 };
        let inside = share.clamp(0.0, 1.0);
        // What sharpening filters swing beyond both colours is no other colour. Channels reach their ends one by one.
        let swing = rules.swing * (share - inside).signum() * f64::from(u8::from(share != inside));
        let rest = [0, 1, 2].map(|k| {
            let (near, far) = (inside * v[k], (inside + swing) * v[k]);
            d[k] - d[k].clamp(near.min(far), near.max(far))
        });
        (inside, dot(rest, rest))
    };
    if !rules.lossy {
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
