//! New colours that were painted become new classes.

use super::mixture::{Painted, unmix};
use super::window::State;
use super::{NEW_CLASS_PX, NEW_CLASS_PX_NOISY, NEW_COLOR, Rules, SAME, distance, rgb};
use std::collections::BTreeMap;

/// A pixel stands out if no neighbour is farther from the base by more than this.
const STEP: f64 = 6.0;
/// Mixed colours are counted in bins of so many grey levels, and those of a JPEG.
const BIN: u8 = 8;
const BIN_LOSSY: u8 = 24;
/// More than this share of a class is no mixture.
const FULL: f64 = 0.9;
/// In noisy pictures colours of strokes that are nearer than this to a class are left to those who fit its colour.
const NOISY_COLOR: f64 = 40.0;
/// Colours found in one round are so far apart; nearer ones wait until the first is known.
const APART: f64 = 60.0;

/// Painted colours that no class explains, and that may be new classes.
///
/// Inside of fills colours are flat. In thin strokes the pixels that differ most from the base among their neighbours come
/// nearest to the full colour.
#[derive(Default)]
pub(super) struct Candidates {
    strokes: BTreeMap<[u8; 3], Bin>,
    fills: BTreeMap<[u8; 3], Bin>,
}

impl Candidates {
    /// Adds a pixel of the edited picture that no class explains.
    pub(super) fn add(&mut self, painted: &Painted, i: usize) {
        let (picture, seen, rules) = (painted.picture, painted.seen, painted.rules);
        let (x, y) = (i % picture.width, i / picture.width);
        if x == 0 || y == 0 || x + 1 == picture.width || y + 1 == picture.height || !seen[i].even {
            return;
        }
        let color = rgb(picture, i);
        let far = |n: usize| distance(rgb(picture, n), seen[n].base);
        let own = far(i);
        let like = if rules.mixed { rules.tolerance } else { SAME };
        let around = || painted.around_px(i, 1);
        let bin = color.map(|c| {
            if rules.lossy {
                c / BIN_LOSSY
            } else if rules.mixed {
                c / BIN
            } else {
                c
            }
        });
        if around().all(|n| seen[n].state == State::Painted && distance(rgb(picture, n), color) <= like) {
            self.fills.entry(bin).or_default().add(color, seen[i].base);
        }
        if own >= 2.0 * rules.tolerance && around().all(|n| far(n) <= own + STEP) {
            self.strokes.entry(bin).or_default().add(color, seen[i].base);
        }
    }

    /// Whether there is none.
    pub(super) fn is_empty(&self) -> bool {
        self.strokes.is_empty() && self.fills.is_empty()
    }

    /// Adds those of another piece.
    pub(super) fn merge(&mut self, other: &Candidates) {
        for (mine, theirs) in [(&mut self.strokes, &other.strokes), (&mut self.fills, &other.fills)] {
            theirs.iter().for_each(|(key, bin)| mine.entry(*key).or_default().merge(bin));
        }
    }

    /// Colours of new classes, when those of the classes so far are `known`. What they do not explain is left for a later
    /// round.
    pub(super) fn colors(&self, rules: &Rules, known: &[[u8; 3]]) -> Vec<[u8; 3]> {
        let few = if rules.noisy { NEW_CLASS_PX_NOISY } else { NEW_CLASS_PX };
        let mut new: Vec<[u8; 3]> = Vec::new();
        let nearest =
            |colors: &[[u8; 3]], color| colors.iter().map(|&c| distance(c, color)).fold(f64::INFINITY, f64::min);
        for (count, color, _) in together(&self.fills, few, rules) {
            if count >= few && nearest(known, color) > NEW_COLOR && nearest(&new, color) > APART {
                new.push(color);
            }
        }
        if !new.is_empty() {
            return new;
        }
        for (count, color, base) in together(&self.strokes, few, rules) {
            let is_mixture = rules.mixed
                && (known.iter().any(|&c| is_shade(color, base, c, rules)) || is_between_classes(color, known, rules));
            let least = if rules.noisy { NOISY_COLOR } else { NEW_COLOR };
            if count >= few && nearest(known, color) > least && nearest(&new, color) > APART && !is_mixture {
                new.push(color);
            }
        }
        new
    }
}

/// Whether a colour is a class over the base.
fn is_shade(color: [u8; 3], base: [u8; 3], class: [u8; 3], rules: &Rules) -> bool {
    let (share, residual) = unmix(color, base, class, rules);
    let slack = if share < FULL { rules.tolerance + NEW_COLOR } else { rules.tolerance };
    share >= 0.2 && residual <= slack
}

/// Whether a colour lies between those of two classes, as where two strokes touch.
fn is_between_classes(color: [u8; 3], classes: &[[u8; 3]], rules: &Rules) -> bool {
    classes.iter().enumerate().any(|(i, a)| {
        classes[..i].iter().any(|b| {
            let (share, residual) = unmix(color, *a, *b, rules);
            (0.15..=0.85).contains(&share) && residual <= rules.tolerance
        })
    })
}

/// Count, mean colour and mean base of the bins, those with most pixels first. A colour that falls on the border of bins is
/// spread over several: neighbours count together.
fn together(bins: &BTreeMap<[u8; 3], Bin>, few: usize, rules: &Rules) -> Vec<(usize, [u8; 3], [u8; 3])> {
    let reach = u8::from(rules.mixed);
    let mut found: Vec<_> = bins
        .iter()
        .filter(|(_, bin)| 4 * bin.count >= few)
        .map(|(key, bin)| {
            let near = |other: &[u8; 3]| (0..3).all(|k| other[k].abs_diff(key[k]) <= reach);
            let count: usize = bins.iter().filter(|(other, _)| near(other)).map(|(_, b)| b.count).sum();
            (count, bin.mean(bin.color), bin.mean(bin.base))
        })
        .collect();
    found.sort_by_key(|&(count, color, _)| (std::cmp::Reverse(count), color));
    found
}

/// Painted pixels of nearly the same colour.
#[derive(Default)]
struct Bin {
    count: usize,
    /// Sums of the channels, of the paint and of the base under it.
    color: [f64; 3],
    base: [f64; 3],
}

impl Bin {
    fn add(&mut self, color: [u8; 3], base: [u8; 3]) {
        self.count += 1;
        for k in 0..3 {
            self.color[k] += f64::from(color[k]);
            self.base[k] += f64::from(base[k]);
        }
    }

    fn merge(&mut self, other: &Bin) {
        self.count += other.count;
        for k in 0..3 {
            self.color[k] += other.color[k];
            self.base[k] += other.base[k];
        }
    }

    fn mean(&self, sums: [f64; 3]) -> [u8; 3] {
        sums.map(|s| (s / self.count as f64).round() as u8)
    }
}
