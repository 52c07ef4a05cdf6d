//! What was painted on a picture of the map, whatever the paint program did to the file.
//!
//! The edited picture is compared with the pictures of the map; the one it agrees with most is its *base*. Where it
//! agrees within the noise of the file, nothing was painted: the class is that of the label map before. Elsewhere the
//! colour `p` is taken for paint `c` over the base `b`: `p = b + a (c - b)`, where `c` is a colour of the palette, or a new
//! flat colour (which becomes a new class), and `a` is the share of the pixel that is painted. Pixels with colours in
//! between (smoothed edges, resized pictures, JPEG) thus tell how much of them is painted; the map, in its own pixels,
//! is painted where the interpolated share is a half or more.
//!
//! Works for pictures that were resized (whole map, same shape), saved with another pixel type or a palette,
//! JPEG-compressed, or cropped with a world file.
//!
//! | symbol | meaning |
//! |---|---|
//! | d | distance of `p` from the colours of the base around the pixel |
//! | t | tolerance: 3 grey levels a channel and [`NOISE_FACTOR`] times the median of `d`, which is noise of the file because most pixels are not painted |
//! | r | what the mixture leaves unexplained: the distance of `p` from the line from `b` to `c` |
//!
//! Guarantee: a pixel only gets a class of which a *certain* pixel (`r <= t`, no other class nearly as good, mostly
//! painted) lies within [`NEAR_PX`], so noise does not make classes; a picture with many pixels that belong nowhere is
//! refused. In noisy files residuals are summed over a window of 5 x 5 pixels, because JPEG stores colour coarsely.
//! Cost: O(pixels + painted pixels x classes).

mod compare;
mod mixture;
mod new_classes;
mod on_the_map;
#[cfg(test)]
mod tests;

use self::compare::{Sampler, State, find_base, whole_map};
use self::mixture::{Found, Painted, drop_isolated};
use self::new_classes::find_new_classes;
use self::on_the_map::{LabelsBefore, Shares, on_the_map};
use super::Error;
use super::label_map::LabelMap;
use crate::cloud::Label;
use crate::map::{PaletteEntry, Picture, Placement, color_distance};
use rayon::prelude::*;
use serde::Serialize;

/// Distance of colours up to which a pixel of a losslessly saved picture is the same: 3 grey levels in each channel.
const SAME: f64 = 5.2;
/// Tolerance added for each unit of the median difference from the base.
const NOISE_FACTOR: f64 = 4.0;
/// Greatest tolerance; a picture that is noisier than this is not a picture of the map.
const MAX_TOLERANCE: f64 = 64.0;
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
/// A new colour must cover this many pixels to be a class; more in noisy pictures.
const NEW_CLASS_PX: usize = 9;
const NEW_CLASS_PX_NOISY: usize = 40;
/// A new colour is at least this far from all classes.
const NEW_COLOR: f64 = 24.0;

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
    /// Pixels of the map on the border of two painted classes, which could be either; they stay what they were.
    pub undecided_px: usize,
    /// Pixels of the map that are transparent in the edited picture: erased, so they are unlabelled now.
    pub erased_px: usize,
}

/// Finds the classes painted on `edited`.
///
/// `bases[0]` must be the label map itself (`labels`), drawn with `palette`; all bases lie at `placement`.
///
/// # Errors
/// [`Error::Shape`] when the place of the picture is unknown, [`Error::NoBase`] when it is no picture of this map,
/// [`Error::Ambiguous`] when too many painted pixels have no clear class.
pub fn recognise(
    edited: &Edited,
    bases: &[Base],
    placement: Placement,
    palette: &[PaletteEntry],
) -> Result<Recognised, Error> {
    let labels = &bases[0].picture;
    let own = match edited.placement {
        Some(own) => own,
        None => whole_map(&edited.picture, labels, placement)?,
    };
    let sample = Sampler { edited: &edited.picture, own, placement, lossy: edited.lossy };
    let (base, median) = find_base(&sample, bases)?;
    let tolerance = (SAME + NOISE_FACTOR * median).min(MAX_TOLERANCE);
    let noisy = edited.lossy || median > 1.0;
    let rules = Rules {
        tolerance: if edited.lossy { tolerance.max(2.0 * SAME) } else { tolerance },
        reach: if noisy { 2 } else { 0 },
        share: if sample.is_resized() { CERTAIN_SHARE_RESIZED } else { CERTAIN_SHARE },
        noisy,
        near: (NEAR_PX as f64 / sample.scale().min(1.0)).ceil() as usize,
        mixed: noisy || sample.is_resized(),
        lossy: edited.lossy,
        swing: if sample.is_resized() { SWING } else { 0.0 },
    };
    let seen = sample.compare(&base.picture, labels, rules.tolerance);
    let painted_px = seen.iter().filter(|s| s.state == State::Painted).count();
    let (width, height) = (edited.picture.width, edited.picture.height);

    // Full colours: palette first, then new flat ones.
    let mut classes = palette.to_vec();
    let is_label_map = base.name == bases[0].name;
    let new_classes = find_new_classes(&edited.picture, &seen, &rules, &mut classes, is_label_map);
    let painted = Painted { picture: &edited.picture, seen: &seen, classes: &classes, rules: &rules };
    let index: Vec<usize> = (0..seen.len()).filter(|&i| seen[i].state == State::Painted).collect();
    let mut certain: Vec<Option<u16>> = vec![None; seen.len()];
    for (i, class) in index.par_iter().map(|&i| (i, painted.certain(i))).collect::<Vec<_>>() {
        certain[i] = class;
    }
    if noisy {
        drop_isolated(&mut certain, &index, width, height);
    }
    if rules.mixed {
        let doubtful: Vec<usize> = index.par_iter().copied().filter(|&i| painted.is_doubtful(i, &certain)).collect();
        doubtful.into_iter().for_each(|i| certain[i] = None);
    }
    // Share of each pixel that is painted, and with which classes.
    let mut paint: Vec<Shares> = vec![[(0, 0.0); 2]; seen.len()];
    let (mut smoothed_px, mut ambiguous, mut example) = (0, 0, 0);
    let found: Vec<Found> = index.par_iter().map(|&i| painted.share(i, &certain)).collect();
    for (&i, found) in index.iter().zip(found) {
        match found {
            Found::Paint(shares) => {
                paint[i] = shares.map(|(class, share)| (class, share as f32));
                smoothed_px += usize::from(certain[i].is_none());
            }
            Found::Noise => {}
            Found::Nothing => {
                if ambiguous == 0 {
                    example = i;
                }
                ambiguous += 1;
            }
        }
    }
    let limit = match (noisy, sample.is_resized()) {
        (true, _) => AMBIGUOUS_SHARE_NOISY,
        (false, true) => AMBIGUOUS_SHARE_RESIZED,
        (false, false) => AMBIGUOUS_SHARE,
    };
    let few = if noisy { NEW_CLASS_PX_NOISY } else { NEW_CLASS_PX };
    if ambiguous as f64 > limit * painted_px as f64 && ambiguous > few {
        let [r, g, b] = rgb(&edited.picture, example);
        return Err(Error::Ambiguous {
            ambiguous,
            painted: painted_px,
            color: format!("#{r:02x}{g:02x}{b:02x}"),
            column: example % width,
            row: example / width,
        });
    }
    let before = LabelsBefore { picture: labels, palette };
    let (map, undecided_px) = on_the_map(&sample, &before, &classes, &seen, &paint, rules.mixed);
    Ok(Recognised {
        map,
        base: base.name.clone(),
        new_classes,
        classes,
        tolerance: rules.tolerance,
        painted_px,
        smoothed_px,
        ambiguous_px: ambiguous,
        undecided_px,
        erased_px: (0..width * height).filter(|&i| seen[i].state == State::Erased).count(),
    })
}

/// How strictly colours are told apart in one picture.
struct Rules {
    tolerance: f64,
    /// Pixels around a pixel whose residuals count with its own.
    reach: usize,
    /// Least painted share of a certain pixel.
    share: f64,
    noisy: bool,
    /// Pixels between a pixel and the certain one whose class it may have.
    near: usize,
    /// Whether small differences are to be expected anywhere.
    mixed: bool,
    /// Whether brightness and colour were spread differently (JPEG).
    lossy: bool,
    /// How far beyond both colours of a mixture a colour may be, as a share of their difference.
    swing: f64,
}

fn rgb(picture: &Picture, i: usize) -> [u8; 3] {
    [picture.rgba[4 * i], picture.rgba[4 * i + 1], picture.rgba[4 * i + 2]]
}

fn distance(a: [u8; 3], b: [u8; 3]) -> f64 {
    f64::from(color_distance(a, b)).sqrt()
}
