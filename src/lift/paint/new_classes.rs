//! New colours that were painted become new classes.

use super::compare::{Seen, State};
use super::mixture::unmix;
use super::{NEW_CLASS_PX, NEW_CLASS_PX_NOISY, NEW_COLOR, Rules, SAME, distance, rgb};
use crate::cloud::Label;
use crate::map::{PaletteEntry, Picture};
use std::collections::BTreeMap;

/// A mixed pixel stands out if no neighbour is farther from the base by more than this.
const MIXED_STEP: f64 = 6.0;

/// Colours that are painted, cover enough pixels, and are no mixture of what is known already.
///
/// In a picture with exact colours a new one is flat: the same on two lines through a pixel. Where colours are mixed, the
/// pixels that differ most from the base among their neighbours come nearest to the full colour; the colours farthest
/// from the base are taken first, and what they explain is no class of its own.
pub(super) fn find_new_classes(
    picture: &Picture,
    seen: &[Seen],
    rules: &Rules,
    classes: &mut Vec<PaletteEntry>,
    is_label_map: bool,
) -> Vec<Label> {
    let (width, height) = (picture.width, picture.height);
    let mut bins: BTreeMap<[u8; 3], Bin> = BTreeMap::new();
    let far = |n: usize| distance(rgb(picture, n), seen[n].base);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            if seen[i].state != State::Painted || (rules.mixed && seen[i].edge) {
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
            let stands_out = if rules.mixed {
                let own = far(i);
                own >= 2.0 * rules.tolerance + NEW_COLOR && lines.iter().flatten().all(|&n| far(n) <= own + MIXED_STEP)
            } else {
                let same = |n: usize| seen[n].state == State::Painted && distance(rgb(picture, n), color) <= SAME;
                lines.iter().filter(|l| l.iter().all(|&n| same(n))).count() >= 2
            };
            if stands_out {
                let bin = bins.entry(if rules.mixed { color.map(|c| c / 32) } else { color }).or_default();
                bin.count += 1;
                for k in 0..3 {
                    bin.color[k] += f64::from(color[k]);
                    bin.base[k] += f64::from(seen[i].base[k]);
                }
            }
        }
    }
    let few = if rules.noisy { NEW_CLASS_PX_NOISY } else { NEW_CLASS_PX };
    // A colour that falls on the border of bins is spread over several: neighbours count together.
    let mut found: Vec<(usize, [u8; 3], [u8; 3])> = bins
        .iter()
        .filter_map(|(key, bin)| {
            let together: usize = if rules.mixed {
                let near = |other: &[u8; 3]| (0..3).all(|k| other[k].abs_diff(key[k]) <= 1);
                bins.iter().filter(|(other, _)| near(other)).map(|(_, b)| b.count).sum()
            } else {
                bin.count
            };
            let mean = |sums: [f64; 3]| sums.map(|s| (s / bin.count as f64).round() as u8);
            (together >= few && 3 * bin.count >= few).then(|| (bin.count, mean(bin.color), mean(bin.base)))
        })
        .collect();
    if rules.mixed {
        found.sort_by(|a, b| distance(b.1, b.2).total_cmp(&distance(a.1, a.2)).then(a.1.cmp(&b.1)));
    } else {
        found.sort_by_key(|&(count, color, _)| (std::cmp::Reverse(count), color));
    }
    let mut new = Vec::new();
    for (_, color, base) in found {
        let nearest = classes.iter().map(|e| distance(e.color, color)).fold(f64::INFINITY, f64::min);
        let shade = NEW_COLOR
            * if rules.lossy {
                3.0
            } else if rules.mixed {
                2.0
            } else {
                1.0
            };
        let mixture = rules.mixed
            && classes.iter().any(|c| {
                let (share, residual) = unmix(color, base, c.color, rules.lossy);
                share >= 0.2 && residual <= rules.tolerance + NEW_COLOR
            });
        // Not a shade of a class: losses make those. And white paper is no class on the label map.
        if nearest <= (2.0 * rules.tolerance).max(shade) || mixture || (is_label_map && color == [255; 3]) {
            continue;
        }
        let value = classes.iter().map(|e| e.value).max().unwrap_or(0) + 1;
        classes.push(PaletteEntry { value, name: format!("new {value}"), color });
        new.push(value);
    }
    new
}

/// Painted pixels of nearly the same colour.
#[derive(Default)]
struct Bin {
    count: usize,
    /// Sums of the channels, of the paint and of the base under it.
    color: [f64; 3],
    base: [f64; 3],
}

/// Whether a colour is a class over the base, and so no new colour.
fn is_mixture(color: [u8; 3], base: [u8; 3], class: [u8; 3], rules: &Rules) -> bool {
    let (share, residual) = unmix(color, base, class, rules.lossy);
    share >= 0.2 && residual <= rules.tolerance
}
