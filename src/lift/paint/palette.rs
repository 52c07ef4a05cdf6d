//! Pictures whose colours were replaced by those of a small palette.

use crate::map::{Picture, color_distance};
use std::collections::{BTreeSet, HashMap};

/// A palette has so many colours.
const PALETTE_COLORS: usize = 256;
/// A colour seen so often tells what becomes of it.
const OFTEN: usize = 3;
/// Share of the pixels of colours seen often that have become the same, if nothing was dithered.
const SAME_SHARE: f64 = 0.8;
/// A class is shown by the entry of the palette that is nearest to its colour, up to this distance.
const SNAP: f64 = 100.0;
/// So near an entry shows a class whatever else there is.
const NEAR: f64 = 12.0;
/// The mean of dithered colours is taken over a patch of this side.
const PATCH_PX: usize = 8;
/// An entry stands for a colour of the base if it is no farther than those of all but this share of the colours, by this factor,
/// or than the nearest by it.
const SELDOM: f64 = 0.01;
const FARTHER: f64 = 1.5;

/// What a palette made of the colours of the base.
#[derive(Clone, Debug)]
pub(super) struct Palette {
    entries: Vec<[u8; 3]>,
    /// The nearest of the colours that each colour of the base has become; others were painted there.
    of_color: HashMap<[u8; 3], [u8; 3]>,
    /// So far entries are from the colours they stand for.
    reach: f64,
    /// Mean colour of the base.
    mean: [u8; 3],
    /// Whether a colour becomes different ones that are right on average.
    pub(super) is_dithered: bool,
}

impl Palette {
    /// The palette of a picture, if it has few colours: `pairs` gives a colour of the base and what has become of it, pixel by
    /// pixel.
    pub(super) fn of(picture: &Picture, pairs: impl Iterator<Item = ([u8; 3], [u8; 3])>) -> Option<Self> {
        let entries = few_colors(picture)?;
        let mut outcomes: HashMap<[u8; 3], Outcomes> = HashMap::new();
        for (color, entry) in pairs {
            outcomes.entry(color).or_default().add(color, entry);
        }
        let mut outcomes: Vec<([u8; 3], Outcomes)> = outcomes.into_iter().collect();
        outcomes.sort_unstable_by_key(|(color, _)| *color);
        let (mut sums, mut count) = ([0; 3], 0);
        for (color, outcome) in &outcomes {
            (0..3).for_each(|k| sums[k] += outcome.seen * usize::from(color[k]));
            count += outcome.seen;
        }
        let mean = sums.map(|s| (s / count.max(1)) as u8);
        let often = || outcomes.iter().map(|(_, o)| o).filter(|o| o.seen >= OFTEN);
        let (seen, same) = often().fold((0, 0), |(seen, same), o| (seen + o.seen, same + o.same));
        let is_dithered = (same as f64) < SAME_SHARE * seen as f64;
        let mut distances: Vec<(i32, usize)> = often().map(|o| (o.distance, o.seen)).collect();
        distances.sort_unstable_by_key(|d| std::cmp::Reverse(d.0));
        let mut left = (SELDOM * seen as f64) as usize;
        let reach = distances.iter().find(|d| left.checked_sub(d.1).map(|l| left = l).is_none());
        let reach = FARTHER * reach.map_or(0.0, |d| f64::from(d.0).sqrt());
        let of_color = outcomes.into_iter().map(|(color, o)| (color, o.nearest)).collect();
        Some(Palette { entries, of_color, reach, mean, is_dithered })
    }

    /// What a pixel of the base shows, given its colour.
    pub(super) fn of_base(&self, color: [u8; 3]) -> [u8; 3] {
        let nearest = self.nearest(color);
        let distance = |entry| f64::from(color_distance(entry, color)).sqrt();
        let entry = self.of_color.get(&color).copied().unwrap_or(nearest);
        if distance(entry) <= self.reach.max(FARTHER * distance(nearest)) { entry } else { nearest }
    }

    /// The colours that show classes (colour and value; 0 is unlabelled surface). One that is shown by none keeps its own; where
    /// one colour may show two classes, both have it.
    pub(super) fn of_classes(&self, classes: &[([u8; 3], u32)]) -> Vec<[u8; 3]> {
        let distance = |a, b| f64::from(color_distance(a, b)).sqrt();
        let entry = |color| if self.is_dithered { self.dithered(color) } else { self.nearest(color) };
        let mut entries: Vec<[u8; 3]> = classes.iter().map(|c| entry(c.0)).collect();
        for k in 1..entries.len() {
            // Mixtures of the same entries that are hardly different.
            let is_far = |j: usize| distance(classes[j].0, entries[j]) > NEAR;
            let twin = |&j: &usize| is_far(j) && is_far(k) && distance(entries[j], entries[k]) <= 2.0 * NEAR;
            if let Some(j) = (0..k).find(twin) {
                entries[k] = entries[j];
            }
        }
        // A colour that had no entry of its own was averaged with those of the base, so it moved towards these.
        let may_show = |k: usize| {
            let ((color, value), entry) = (classes[k], entries[k]);
            let far = distance(color, entry);
            let towards = distance(entry, self.mean) <= distance(color, self.mean);
            far <= NEAR || value != 0 && far <= SNAP && towards
        };
        let shown = |k: usize| {
            let far = distance(classes[k].0, entries[k]);
            let rivals = |j: &usize| *j != k && distance(entries[*j], entries[k]) <= NEAR && may_show(*j);
            let is_taken = (0..classes.len()).filter(rivals).any(|j| {
                let other = distance(classes[j].0, entries[j]);
                other <= NEAR && far > NEAR || 2.0 * other < far
            });
            if may_show(k) && !is_taken { entries[k] } else { classes[k].0 }
        };
        (0..classes.len()).map(shown).collect()
    }

    /// Whether a colour got lost: it is not in the palette, and those of the base were replaced, too. A picture of few colours
    /// that are all kept has lost none; dithering makes others from those that there are.
    pub(super) fn lost(&self, color: [u8; 3]) -> bool {
        self.reach > 0.0 && !self.is_dithered && !self.entries.contains(&color)
    }

    fn nearest(&self, color: [u8; 3]) -> [u8; 3] {
        self.entries.iter().copied().min_by_key(|&e| color_distance(e, color)).unwrap_or(color)
    }

    /// Mean of a patch of one colour after error diffusion (Floyd and Steinberg 1976).
    fn dithered(&self, color: [u8; 3]) -> [u8; 3] {
        let mut carried = vec![[0i32; 3]; (PATCH_PX + 2) * (PATCH_PX + 1)];
        let mut sums = [0usize; 3];
        for y in 0..PATCH_PX {
            for x in 1..=PATCH_PX {
                let at = y * (PATCH_PX + 2) + x;
                let wanted = [0, 1, 2].map(|k| (i32::from(color[k]) + carried[at][k] / 16).clamp(0, 255));
                let entry = self.nearest(wanted.map(|w| w as u8));
                for k in 0..3 {
                    sums[k] += usize::from(entry[k]);
                    let error = wanted[k] - i32::from(entry[k]);
                    for (to, share) in [(1, 7), (PATCH_PX + 1, 3), (PATCH_PX + 2, 5), (PATCH_PX + 3, 1)] {
                        carried[at + to][k] += share * error;
                    }
                }
            }
        }
        sums.map(|s| (s / (PATCH_PX * PATCH_PX)) as u8)
    }
}

/// What has become of a colour.
#[derive(Default)]
struct Outcomes {
    seen: usize,
    /// Of these, how many are `usual` (a lower bound: majority vote of Boyer and Moore).
    same: usize,
    usual: [u8; 3],
    lead: usize,
    nearest: [u8; 3],
    /// Squared distance of the nearest.
    distance: i32,
}

impl Outcomes {
    fn add(&mut self, color: [u8; 3], entry: [u8; 3]) {
        let distance = color_distance(color, entry);
        if self.seen == 0 || distance < self.distance {
            (self.nearest, self.distance) = (entry, distance);
        }
        self.seen += 1;
        if self.lead == 0 {
            (self.usual, self.same) = (entry, 0);
        }
        if self.usual == entry {
            (self.lead, self.same) = (self.lead + 1, self.same + 1);
        } else {
            self.lead -= 1;
        }
    }
}

/// The colours of a picture with few.
fn few_colors(picture: &Picture) -> Option<Vec<[u8; 3]>> {
    let mut colors = BTreeSet::new();
    let mut last = None;
    for &[r, g, b, a] in picture.rgba.as_chunks::<4>().0 {
        if a >= super::window::OPAQUE && last != Some([r, g, b]) {
            last = Some([r, g, b]);
            colors.insert([r, g, b]);
            if colors.len() > PALETTE_COLORS {
                return None;
            }
        }
    }
    Some(colors.into_iter().collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(colors: &[[u8; 3]]) -> Picture {
        let rgba = colors.iter().flat_map(|c| [c[0], c[1], c[2], 255]).collect();
        Picture { width: colors.len(), height: 1, rgba }
    }

    #[test]
    fn the_usual_outcome_of_a_colour_is_that_of_the_base() {
        let (grey, dark, red) = ([120; 3], [100; 3], [200, 30, 40]);
        let pairs = [
            (grey, grey),
            (grey, grey),
            (grey, red),
            ([104; 3], dark),
            ([104; 3], dark),
            ([104; 3], dark),
            ([104; 3], dark),
            ([98; 3], red),
        ];
        let palette = Palette::of(&picture(&[grey, dark, red]), pairs.into_iter()).unwrap();
        assert!(!palette.is_dithered);
        assert_eq!(palette.of_base(grey), grey);
        assert_eq!(palette.of_base([104; 3]), dark);
        assert_eq!(palette.of_base([111; 3]), grey);
        // All pixels of this colour are painted.
        assert_eq!(palette.of_base([98; 3]), dark);
        let classes = [([238, 236, 230], 0), ([228, 26, 28], 1), ([0, 0, 255], 2)];
        assert_eq!(palette.of_classes(&classes), [[238, 236, 230], red, [0, 0, 255]]);
        let alike = [([228, 26, 28], 1), ([235, 40, 60], 2)];
        assert_eq!(palette.of_classes(&alike), [red; 2]);
        let many: Vec<[u8; 3]> = (0..=255).map(|k| [k, 0, 0]).chain([[0, 1, 0]]).collect();
        assert!(Palette::of(&picture(&many), std::iter::empty()).is_none());
    }

    #[test]
    fn dithered_colours_are_right_on_average() {
        let pairs = (0..40).map(|k| ([100; 3], [if k % 2 == 0 { 0 } else { 200 }; 3]));
        let palette = Palette::of(&picture(&[[0; 3], [200; 3]]), pairs).unwrap();
        assert!(palette.is_dithered);
        let [shown, ..] = palette.of_classes(&[([100; 3], 1)])[0];
        assert!(shown.abs_diff(100) < 12, "{shown}");
    }
}
