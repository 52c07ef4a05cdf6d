//! New colours that were painted become new classes.

use super::compare::{Seen, State};
use super::mixture::unmix;
use super::{NEW_CLASS_PX, NEW_CLASS_PX_NOISY, NEW_COLOR, Rules, SAME, distance, rgb};
use crate::cloud::Label;
use crate::map::{PaletteEntry, Picture};
use std::collections::BTreeMap;

/// A mixed pixel stands out if no neighbour is farther from the base by more than this.
const MIXED_STEP: f64 = 6.0;
/// Flat colours are counted in bins of so many grey levels.
const FLAT_BIN: u8 = 8;
/// In a mixed picture a thin stroke, and in one with few colours a fill, may differ so many times more from the colour it was painted with.
const MIXED_SHADE: f64 = 2.0;
/// In a JPEG a thin stroke may differ so many times more from the colour it was painted with.
const LOSSY_SHADE: f64 = 3.0;

/// Colours that are painted, cover enough pixels, and are no mixture of what is known already.
///
/// In a picture with exact colours a new one is flat: the same on two lines through a pixel. Where colours are mixed, the
/// inside of fills is flat still, and tells new colours from classes that are nearly like them. Where there are only thin
/// strokes, the pixels that differ most from the base among their neighbours come nearest to the full colour; the colours
/// farthest from the base are taken first, and what they explain is no class of its own.
pub(super) fn find_new_classes(
    picture: &Picture,
    seen: &[Seen],
    rules: &Rules,
    classes: &mut Vec<PaletteEntry>,
    is_label_map: bool,
) -> Vec<Label> {
    let (width, height) = (picture.width, picture.height);
    let (mut bins, mut flat): (BTreeMap<[u8; 3], Bin>, BTreeMap<[u8; 3], Bin>) = Default::default();
    let far = |n: usize| distance(rgb(picture, n), seen[n].base);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            if seen[i].state != State::Painted || (rules.mixed && (seen[i].edge || !seen[i].even)) {
                continue;
            }
            let color = rgb(picture, i);
            if classes.iter().any(|c| is_mixture(color, seen[i].base, c.color, rules)) {
                continue;
            }
            let lines = [
                [i - 1, i + 1],
                [i - width, i + width],
                [i - width - 1, i + width + 1],
                [i - width + 1, i + width - 1],
            ];
            let like = |n: usize, d: f64| seen[n].state == State::Painted && distance(rgb(picture, n), color) <= d;
            if rules.mixed && lines.iter().flatten().all(|&n| like(n, rules.tolerance)) {
                flat.entry(color.map(|c| c / FLAT_BIN)).or_default().add(color, seen[i].base);
            }
            let stands_out = if rules.mixed {
                let own = far(i);
                own >= 2.0 * rules.tolerance + NEW_COLOR && lines.iter().flatten().all(|&n| far(n) <= own + MIXED_STEP)
            } else {
                lines.iter().filter(|l| l.iter().all(|&n| like(n, SAME))).count() >= 2
            };
            if stands_out {
                bins.entry(if rules.mixed { color.map(|c| c / 32) } else { color })
                    .or_default()
                    .add(color, seen[i].base);
            }
        }
    }
    let few = if rules.noisy { NEW_CLASS_PX_NOISY } else { NEW_CLASS_PX };
    let mut new = Vec::new();
    let mut add = |classes: &mut Vec<PaletteEntry>, color: [u8; 3]| {
        let value = classes.iter().map(|e| e.value).max().unwrap_or(0) + 1;
        classes.push(PaletteEntry { value, name: format!("new {value}"), color });
        new.push(value);
    };
    let nearest = |classes: &[PaletteEntry], color| {
        classes.iter().map(|e| distance(e.color, color)).fold(f64::INFINITY, f64::min)
    };
    // White paper is no class on the label map.
    let is_paper = |color: [u8; 3]| is_label_map && color == [255; 3];

    let fill_shade = if rules.noisy && !rules.lossy { MIXED_SHADE * NEW_COLOR } else { NEW_COLOR };
    let mut fills = together(&flat, few);
    fills.sort_by_key(|&(count, color, _)| (std::cmp::Reverse(count), color));
    for (_, color, base) in fills {
        let swung = classes.iter().any(|c| {
            let (share, residual) = unmix(color, base, c.color, rules);
            share >= 0.2 && residual <= 2.0 * rules.tolerance
        });
        if !swung && nearest(classes, color) > (2.0 * rules.tolerance).max(fill_shade) && !is_paper(color) {
            add(classes, color);
        }
    }
    let mut found = if rules.mixed { together(&bins, few) } else { exact(&bins, few) };
    if rules.mixed {
        found.sort_by(|a, b| distance(b.1, b.2).total_cmp(&distance(a.1, a.2)).then(a.1.cmp(&b.1)));
    } else {
        found.sort_by_key(|&(count, color, _)| (std::cmp::Reverse(count), color));
    }
    for (_, color, base) in found {
        let shade = NEW_COLOR
            * if rules.lossy {
                LOSSY_SHADE
            } else if rules.mixed {
                MIXED_SHADE
            } else {
                1.0
            };
        let unmixed = rules.tolerance + NEW_COLOR;
        let mixture = rules.mixed
            && (classes.iter().any(|c| {
                let (share, residual) = unmix(color, base, c.color, rules);
                share >= 0.2 && residual <= unmixed
            }) || is_between_classes(color, classes, rules));
        // Not a shade of a class: losses make those.
        if nearest(classes, color) > (2.0 * rules.tolerance).max(shade) && !mixture && !is_paper(color) {
            add(classes, color);
        }
    }
    new
}

/// Whether a colour lies between those of two classes, as where two strokes touch.
fn is_between_classes(color: [u8; 3], classes: &[PaletteEntry], rules: &Rules) -> bool {
    classes.iter().enumerate().any(|(i, a)| {
        classes[..i].iter().any(|b| {
            let (share, residual) = unmix(color, a.color, b.color, rules);
            (0.15..=0.85).contains(&share) && residual <= rules.tolerance
        })
    })
}

/// Count, mean colour and mean base of the bins with enough pixels.
type Candidate = (usize, [u8; 3], [u8; 3]);

fn exact(bins: &BTreeMap<[u8; 3], Bin>, few: usize) -> Vec<Candidate> {
    bins.values().filter(|b| b.count >= few).map(|b| (b.count, b.mean(b.color), b.mean(b.base))).collect()
}

/// A colour that falls on the border of bins is spread over several: neighbours count together.
fn together(bins: &BTreeMap<[u8; 3], Bin>, few: usize) -> Vec<Candidate> {
    bins.iter()
        .filter_map(|(key, bin)| {
            let near = |other: &[u8; 3]| (0..3).all(|k| other[k].abs_diff(key[k]) <= 1);
            let count: usize = bins.iter().filter(|(other, _)| near(other)).map(|(_, b)| b.count).sum();
            (count >= few && 3 * bin.count >= few).then(|| (bin.count, bin.mean(bin.color), bin.mean(bin.base)))
        })
        .collect()
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

    fn mean(&self, sums: [f64; 3]) -> [u8; 3] {
        sums.map(|s| (s / self.count as f64).round() as u8)
    }
}

/// Whether a colour is a class over the base, and so no new colour.
fn is_mixture(color: [u8; 3], base: [u8; 3], class: [u8; 3], rules: &Rules) -> bool {
    let (share, residual) = unmix(color, base, class, rules);
    share >= 0.2 && residual <= rules.tolerance
}
