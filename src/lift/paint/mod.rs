//! What was painted on a picture of the map, whatever the paint program did to the file.
//!
//! 1. [`passage`]: the edited picture is compared with the pictures of the map. The one it agrees with most is its *base*, and
//!    where nothing was painted it tells what happened to the file: kernel, transparency, palette, noise.
//! 2. [`window`]: the map is worked on piece by piece. Each has the base as it would have come back, and the pixels that differ.
//! 3. [`mixture`]: a pixel that differs is taken for paint `c` over the base `b`, `p = b + a (c - b)`; where that leaves no doubt, its
//!    class is certain.
//! 4. [`synthesis`]: the pixels of the map get the classes, of those certain near them, that make the picture that came back.
//! 5. [`new_classes`]: colours that no class explains become new classes, and the pieces are searched again.
//!
//! Works for pictures that were resized (whole map, same shape), saved with another pixel type or a palette,
//! JPEG-compressed, or cropped with a world file.
//!
//! | symbol | meaning |
//! |---|---|
//! | d | distance of `p` from what the base would give |
//! | t | tolerance: 3 grey levels a channel and [`NOISE_FACTOR`] times the median of `d`, which is noise of the file because most pixels are not painted |
//! | r | what the mixture leaves unexplained: the distance of `p` from the line from `b` to `c` |
//!
//! Guarantee: a pixel only gets a class of which a *certain* pixel (`r <= t`, no other class nearly as good, mostly painted) lies
//! in its piece, so noise does not make classes; a picture with many pixels that belong nowhere is refused. In noisy files
//! residuals are summed over a window of 5 x 5 pixels, because JPEG stores colour coarsely.
//! Cost: O(pixels + painted pixels x classes x width of the kernel squared); memory for a piece beside the pictures.

mod mixture;
mod new_classes;
mod palette;
mod passage;
mod piece;
mod resampling;
mod synthesis;
#[cfg(test)]
mod tests;
mod window;

use self::new_classes::Candidates;
use self::passage::{Passage, identify};
use self::piece::{Frame, Outcome, Part};
use self::window::Place;
use super::Error;
use super::label_map::LabelMap;
use crate::cloud::Label;
use crate::map::{PaletteEntry, Picture, Placement, color_distance};
use crate::numeric::Vec2;
use rayon::prelude::*;
use serde::Serialize;

/// Distance of colours up to which a pixel of a losslessly saved picture is the same: 3 grey levels in each channel.
const SAME: f64 = 5.2;
/// Tolerance added for each unit of the median difference from the base.
const NOISE_FACTOR: f64 = 4.0;
/// Greatest tolerance; a picture that is noisier than this is not a picture of the map.
const MAX_TOLERANCE: f64 = 64.0;
/// Least tolerance in a JPEG, which is exact where nothing was painted and the base is even.
const LOSSY_TOLERANCE: f64 = 16.0;
/// A smoothed pixel belongs to a certain one at most this many pixels of the map away.
const NEAR_PX: usize = 3;
/// Painted share of a certain pixel, in a picture of the same size and in a resized one.
const CERTAIN_SHARE: f64 = 0.7;
const CERTAIN_SHARE_RESIZED: f64 = 0.45;
/// Filters that sharpen when they resize swing beyond the colours around by this share of the contrast.
const SWING: f64 = 0.12;
/// Share of painted pixels that may stay without a class, in a lossless, a resized and a noisy picture.
const AMBIGUOUS_SHARE: f64 = 0.02;
const AMBIGUOUS_SHARE_RESIZED: f64 = 0.05;
const AMBIGUOUS_SHARE_NOISY: f64 = 0.25;
/// A new colour must cover this many pixels to be a class; more in noisy pictures, and of the map where colours are mixed.
const NEW_CLASS_PX: usize = 9;
const NEW_CLASS_PX_MIXED: usize = 24;
const NEW_CLASS_PX_NOISY: usize = 40;
/// Rounds in which new classes are looked for.
const MAX_ROUNDS: usize = 12;
/// A class whose colour moves by less than this is left alone.
const LEAST_MOVE: f64 = 2.5;
const LEAST_MOVE_NOISY: f64 = 6.0;
/// A new colour is at least this far from all classes, and in a JPEG from those of the palette.
const NEW_COLOR: f64 = 24.0;
const NEW_COLOR_LOSSY: f64 = 28.0;

/// A picture of the map that may have been painted on.
#[derive(Clone, Debug)]
pub struct Base {
    /// Its name, e.g. `labels`.
    pub name: String,
    /// Its pixels.
    pub picture: Picture,
}

/// A picture that came back.
#[derive(Clone, Debug)]
pub struct Edited {
    /// Its pixels.
    pub picture: Picture,
    /// Its place according to a world file, if there is one.
    pub placement: Option<Placement>,
    /// Whether it was compressed with losses.
    pub lossy: bool,
}

/// What was found in a picture.
#[derive(Clone, Debug, Serialize)]
pub struct Recognised {
    /// The classes on the map, in the pixels of the map's pictures, over the part that the edited picture shows.
    #[serde(skip)]
    pub map: LabelMap,
    /// The picture of the map that was painted on.
    pub base: String,
    /// All classes: those of the palette and new ones.
    pub classes: Vec<PaletteEntry>,
    /// Values of the new classes.
    pub new_classes: Vec<Label>,
    /// Difference of colours that counts as noise of the file.
    pub tolerance: f64,
    /// Pixels that differ from the base.
    pub painted_px: usize,
    /// Painted pixels whose class was taken from their neighbourhood.
    pub smoothed_px: usize,
    /// Painted pixels without a class; they stay what they were.
    pub ambiguous_px: usize,
    /// Painted pixels of the map that could as well have another class; they are unlabelled now.
    pub undecided_px: usize,
    /// Classes whose colour the palette of the picture lost, each with the class that shows instead: what was painted with the
    /// first looks like the second.
    pub lost_classes: Vec<[String; 2]>,
    /// Pixels of the map that are transparent in the edited picture: erased, so they are unlabelled now.
    pub erased_px: usize,
}

/// Finds the classes painted on `edited`.
///
/// `bases[0]` must be the label map itself (`labels`), drawn with `palette`; all bases lie at `placement`.
///
/// # Errors
/// [`Error::Shape`] when the place of the picture is unknown, [`Error::NoBase`] when it is no picture of this map,
/// [`Error::Ambiguous`] when too many painted pixels have no clear class, [`Error::OneColor`] when they have the one colour that a
/// palette gave to two classes.
pub fn recognise(
    edited: &Edited,
    bases: &[Base],
    placement: Placement,
    palette: &[PaletteEntry],
) -> Result<Recognised, Error> {
    let labels = &bases[0].picture;
    let place = Place::new(&edited.picture, edited.placement, labels, placement)?;
    let (base, passage, median) = identify(&edited.picture, edited.lossy, bases, &place)?;
    let rules = Rules::new(&place, &passage, median);
    let frame = Frame {
        edited: &edited.picture,
        base: &base.picture,
        labels,
        palette,
        place: &place,
        passage: &passage,
        rules: &rules,
    };
    let cores = place.cores();
    // Full colours: palette first, then new ones.
    let mut classes = palette.to_vec();
    let mut shown = passage.colors_of_classes(&classes);
    let lost_classes = passage.lost_classes(&classes, &shown);
    let mut parts: Vec<Part> = cores.par_iter().map(|&core| frame.solve(core, &shown)).collect();
    let solve_again = |parts: &mut [Part], shown: &[[u8; 3]], which: &dyn Fn(&Part) -> bool| {
        let again: Vec<usize> = (0..parts.len()).filter(|&i| which(&parts[i])).collect();
        let solved: Vec<Part> = again.par_iter().map(|&i| frame.solve(cores[i], shown)).collect();
        again.into_iter().zip(solved).for_each(|(i, part)| parts[i] = part);
    };
    for _ in 0..MAX_ROUNDS {
        let mut candidates = Candidates::default();
        parts.iter().for_each(|p| candidates.merge(&p.candidates));
        let moved = if rules.mixed { refine(&parts, palette.len(), &mut shown, &rules) } else { Vec::new() };
        let new = candidates.colors(&rules, &shown);
        if new.is_empty() && moved.is_empty() {
            break;
        }
        shown.extend(&new);
        // Two colours that moved to one place are one, also where one of them is a class of the palette.
        let apart = |j: usize| if rules.lossy && j < palette.len() { NEW_COLOR_LOSSY } else { NEW_COLOR };
        let twin = |k: usize| (0..k).any(|j| distance(shown[j], shown[k]) <= apart(j));
        let twins: Vec<usize> = (palette.len()..shown.len()).filter(|&k| twin(k)).collect();
        let first_twin = twins.first().copied().unwrap_or(usize::MAX);
        for k in twins.into_iter().rev() {
            shown.remove(k);
        }
        solve_again(&mut parts, &shown, &|part| {
            let is_used = |k: usize| part.used.get(k).is_some_and(|n| *n > 0);
            !part.candidates.is_empty()
                || moved.iter().any(|&k| is_used(k))
                || part.used.iter().skip(first_twin).any(|n| *n > 0)
        });
    }
    // Mixtures that were taken for colours of their own have hardly a pixel left.
    let least = match (rules.noisy, rules.mixed) {
        (true, _) => NEW_CLASS_PX_NOISY,
        (false, true) => NEW_CLASS_PX_MIXED,
        (false, false) => NEW_CLASS_PX,
    };
    let used = |k: usize| parts.iter().filter_map(|p| p.used.get(k)).sum::<usize>();
    let kept: Vec<[u8; 3]> = (palette.len()..shown.len()).filter(|&k| used(k) >= least).map(|k| shown[k]).collect();
    if kept.len() < shown.len() - palette.len() {
        shown.truncate(palette.len());
        shown.extend(kept);
        solve_again(&mut parts, &shown, &|part| part.painted > 0 || part.used.iter().any(|n| *n > 0));
    }
    let first_value = classes.iter().map(|c| c.value).max().unwrap_or(0) + 1;
    for (&color, value) in shown[palette.len()..].iter().zip(first_value..) {
        classes.push(PaletteEntry { value, name: format!("new {value}"), color });
    }
    let new_classes: Vec<Label> = classes[palette.len()..].iter().map(|c| c.value).collect();

    let total = |count: fn(&Part) -> usize| parts.iter().map(count).sum::<usize>();
    let (painted_px, ambiguous_px) = (total(|p| p.painted), total(|p| p.ambiguous));
    let few = if rules.noisy { NEW_CLASS_PX_NOISY } else { NEW_CLASS_PX };
    let example = parts.iter().find_map(|p| p.example);
    if let Some(([r, g, b], column, row)) =
        example.filter(|_| ambiguous_px as f64 > rules.ambiguous_share * painted_px as f64 && ambiguous_px > few)
    {
        let same: Vec<&PaletteEntry> =
            classes.iter().zip(&shown).filter(|(_, c)| **c == [r, g, b]).map(|(class, _)| class).collect();
        if let [one, other, ..] = same[..] {
            return Err(Error::OneColor {
                color: format!("#{r:02x}{g:02x}{b:02x}"),
                one: one.name.clone(),
                other: other.name.clone(),
                ambiguous: ambiguous_px,
            });
        }
        return Err(Error::Ambiguous {
            ambiguous: ambiguous_px,
            painted: painted_px,
            color: format!("#{r:02x}{g:02x}{b:02x}"),
            column,
            row,
        });
    }
    let [columns, rows] = &place.covered;
    let corner = Vec2::new(columns.start as f64 + 0.5, rows.start as f64 + 0.5);
    let mut map = LabelMap {
        width: columns.len(),
        height: rows.len(),
        placement: Placement { first_centre: placement.chart_from_pixel(corner), ..placement },
        labels: vec![0; columns.len() * rows.len()],
    };
    for (core, part) in cores.iter().zip(&parts) {
        for (y, row) in part.labels.chunks_exact(core.width).enumerate() {
            let at = (core.row - rows.start + y) * map.width + core.column - columns.start;
            for (label, &found) in map.labels[at..at + core.width].iter_mut().zip(row) {
                *label = match found {
                    Outcome::Before(label) => label,
                    Outcome::Unlabelled => 0,
                    Outcome::Class(k) => classes[usize::from(k)].value,
                };
            }
        }
    }
    Ok(Recognised {
        map,
        base: base.name.clone(),
        new_classes,
        classes,
        tolerance: rules.tolerance,
        painted_px,
        smoothed_px: total(|p| p.smoothed),
        ambiguous_px,
        undecided_px: total(|p| p.undecided),
        lost_classes,
        erased_px: total(|p| p.erased),
    })
}

/// Moves the colours of new classes (from `first` on) to where the pictures made with them come nearest to what came back.
/// Where a class of the palette asks for quite another colour, that was painted instead, and is a new class. Gives the
/// classes whose pixels are to be looked at again.
fn refine(parts: &[Part], first: usize, shown: &mut Vec<[u8; 3]>, rules: &Rules) -> Vec<usize> {
    let few = if rules.noisy { NEW_CLASS_PX_NOISY } else { NEW_CLASS_PX_MIXED };
    let mut moved = Vec::new();
    for k in 0..shown.len() {
        let mut sums = [([0.0; 4], 0.0); 2];
        for fits in parts.iter().filter_map(|p| p.fits.get(k)) {
            for (sum, fit) in sums.iter_mut().zip(fits) {
                (0..4).for_each(|c| sum.0[c] += fit.0[c]);
                sum.1 += fit.1;
            }
        }
        let change = sums.map(|(sum, squares)| sum.map(|s| if squares > 0.0 { s / squares } else { 0.0 }));
        let change = if rules.lossy { piece::color_change(change[0][0], change[1]) } else { change[0] };
        let better = [0, 1, 2].map(|c| (f64::from(shown[k][c]) + change[c]).clamp(0.0, 255.0).round() as u8);
        let distance_from = |c: &[u8; 3]| distance(*c, better);
        if k >= first && distance_from(&shown[k]) > if rules.noisy { LEAST_MOVE_NOISY } else { LEAST_MOVE } {
            shown[k] = better;
            moved.push(k);
        } else if k < first
            && rules.is_known
            && distance_from(&shown[k]) > NEW_COLOR
            && shown.iter().enumerate().all(|(j, c)| j == k || distance_from(c) > 2.0 * NEW_COLOR)
            && parts.iter().filter_map(|p| p.used.get(k)).sum::<usize>() >= few
        {
            shown.push(better);
            moved.push(k);
        }
    }
    moved
}

/// How strictly colours are told apart in one picture.
struct Rules {
    tolerance: f64,
    /// Pixels around a pixel whose residuals count with its own.
    reach: usize,
    /// Least painted share of a certain pixel.
    share: f64,
    noisy: bool,
    /// Pixels of the edited picture, and of the map, between a pixel and the certain one whose class it may have.
    near: usize,
    near_on_map: f64,
    /// Whether small differences are to be expected anywhere.
    mixed: bool,
    /// Whether it is known what happened to the picture, so that what is left tells of colours.
    is_known: bool,
    /// Whether brightness and colour were spread differently (JPEG).
    lossy: bool,
    /// How far beyond both colours of a mixture a colour may be, as a share of their difference.
    swing: f64,
    /// What differs more than this from the picture that the classes make is explained by none of them.
    unexplained: f64,
    /// Median difference from the base.
    median: f64,
    /// Share of painted pixels that may stay without a class.
    ambiguous_share: f64,
}

impl Rules {
    fn new(place: &Place, passage: &Passage, median: f64) -> Self {
        let lossy = passage.lossy;
        let resized = place.is_resized() && !passage.filter.kernel.is_exact();
        let noisy = lossy || passage.is_dithered() || median > 1.5;
        let least = if lossy { LOSSY_TOLERANCE } else { 0.0 };
        let tolerance = (SAME + NOISE_FACTOR * median).clamp(least, MAX_TOLERANCE);
        Rules {
            tolerance,
            reach: if noisy { 2 } else { 0 },
            share: if resized { CERTAIN_SHARE_RESIZED } else { CERTAIN_SHARE },
            noisy,
            near: (NEAR_PX as f64 / place.scale().min(1.0)).ceil() as usize,
            near_on_map: NEAR_PX as f64 * place.scale().max(1.0),
            mixed: noisy || resized,
            lossy,
            is_known: passage.is_known,
            swing: if resized && passage.filter.kernel.sharpens() { SWING } else { 0.0 },
            unexplained: if noisy {
                0.6 * tolerance + 8.0
            } else if resized {
                (2.0 * tolerance).max(16.0)
            } else {
                tolerance
            },
            median,
            ambiguous_share: match (noisy, resized) {
                (true, _) => AMBIGUOUS_SHARE_NOISY,
                (false, true) => AMBIGUOUS_SHARE_RESIZED,
                (false, false) => AMBIGUOUS_SHARE,
            },
        }
    }
}

fn rgb(picture: &Picture, i: usize) -> [u8; 3] {
    [picture.rgba[4 * i], picture.rgba[4 * i + 1], picture.rgba[4 * i + 2]]
}

fn distance(a: [u8; 3], b: [u8; 3]) -> f64 {
    f64::from(color_distance(a, b)).sqrt()
}
