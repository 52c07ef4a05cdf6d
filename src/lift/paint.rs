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

use super::Error;
use super::label_map::{LabelMap, NO_SURFACE};
use crate::cloud::Label;
use crate::map::{PaletteEntry, Picture, Placement, color_distance};
use crate::numeric::{Vec2, statistics};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;

/// Distance of colours up to which a pixel of a losslessly saved picture is the same: 3 grey levels in each channel.
const SAME: f64 = 5.2;
/// Tolerance added for each unit of the median difference from the base.
const NOISE_FACTOR: f64 = 4.0;
/// Greatest tolerance; a picture that is noisier than this is not a picture of the map.
const MAX_TOLERANCE: f64 = 64.0;
/// Share of pixels that must agree with a picture of the map for it to be the base.
const BASE_SHARE: f64 = 0.4;
/// Median difference from the base, at most.
const MAX_MEDIAN: f64 = 30.0;
/// A smoothed pixel belongs to a certain one at most this many pixels of the map away.
const NEAR_PX: usize = 3;
/// Painted share of a certain pixel, in a picture of the same size and in a resized one.
const CERTAIN_SHARE: f64 = 0.7;
const CERTAIN_SHARE_RESIZED: f64 = 0.45;
/// A class is certain when the next one leaves this many times the tolerance more unexplained.
const MARGIN: f64 = 0.5;
/// In noisy pictures so many tolerances may stay unexplained, when the next class leaves this many times more.
const BLURRED: f64 = 3.0;
const BLURRED_MARGIN: f64 = 1.6;
/// Share of painted pixels that may stay without a class, in a lossless and in a noisy picture.
const AMBIGUOUS_SHARE: f64 = 0.02;
const AMBIGUOUS_SHARE_NOISY: f64 = 0.25;
/// A new colour must cover this many pixels to be a class; more in noisy pictures.
const NEW_CLASS_PX: usize = 9;
const NEW_CLASS_PX_NOISY: usize = 40;
/// A new colour is at least this far from all classes.
const NEW_COLOR: f64 = 24.0;
/// Filters that sharpen when they resize swing beyond the colours around, by this share of the contrast within this many
/// half pixels of the edited picture.
const RINGING: f64 = 0.12;
const RINGING_REACH: f64 = 5.0;
/// The colours of pixels so near to the edge of the surface may be mixed with what is behind it.
const EDGE_PX: f64 = 3.0;
/// JPEG mixes colours over so many pixels.
const JPEG_SPREAD_PX: f64 = 2.0;
/// Paint whose brightness differs from the base by this much shows its share by brightness.
const CLEAR_BRIGHTNESS: f64 = 30.0;
/// A mixed pixel stands out if no neighbour is farther from the base by more than this.
const MIXED_STEP: f64 = 6.0;
/// Pixels looked at to find the base.
const BASE_SAMPLES: usize = 200_000;
/// Shapes may differ by this many pixels (rounding when a picture was resized).
const SHAPE_SLACK_PX: f64 = 1.5;

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
    // Share of each pixel that is painted, and with which class.
    let mut paint: Vec<(u16, f32)> = vec![(0, 0.0); seen.len()];
    let (mut smoothed_px, mut ambiguous, mut example) = (0, 0, 0);
    let found: Vec<Found> = index.par_iter().map(|&i| painted.share(i, &certain)).collect();
    for (&i, found) in index.iter().zip(found) {
        match found {
            Found::Paint(class, share) => {
                paint[i] = (class, share as f32);
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
    let limit = if noisy { AMBIGUOUS_SHARE_NOISY } else { AMBIGUOUS_SHARE };
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
    let map = on_the_map(&sample, labels, palette, &classes, &seen, &paint);
    Ok(Recognised {
        map,
        base: base.name.clone(),
        new_classes,
        classes,
        tolerance: rules.tolerance,
        painted_px,
        smoothed_px,
        ambiguous_px: ambiguous,
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
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
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
struct Seen {
    state: State,
    /// Mean colour of the base under the pixel.
    base: [u8; 3],
    /// Whether the surface ends near: programs mix its colours with what lies behind transparency.
    edge: bool,
}

/// Compares the edited picture with pictures of the map, pixel by pixel of the edited one.
struct Sampler<'a> {
    edited: &'a Picture,
    own: Placement,
    placement: Placement,
    lossy: bool,
}

impl Sampler<'_> {
    /// Pixel coordinates on a picture of the map of a place on the edited picture.
    fn map_from_edited(&self, x: f64, y: f64) -> Vec2 {
        self.placement.pixel_from_chart(self.own.chart_from_pixel(Vec2::new(x, y)))
    }

    /// Column and row of the pixel of a picture of the map under the centre of a pixel of the edited picture.
    fn map_pixel(&self, x: usize, y: usize, picture: &Picture) -> Option<(usize, usize)> {
        let p = self.map_from_edited(x as f64 + 0.5, y as f64 + 0.5);
        let inside = p.x >= 0.0 && p.y >= 0.0 && p.x < picture.width as f64 && p.y < picture.height as f64;
        inside.then_some((p.x as usize, p.y as usize))
    }

    fn scale(&self) -> f64 {
        self.own.step_u / self.placement.step_u
    }

    fn is_resized(&self) -> bool {
        (self.scale() - 1.0).abs() > 1e-6
    }

    /// Mean colour of the base under a pixel, and how far the edited colour is from the colours around it. `None` beside
    /// the surface.
    fn difference(&self, x: usize, y: usize, base: &Picture) -> Option<([u8; 3], f64)> {
        let (bx, by) = self.map_pixel(x, y, base)?;
        if base.rgba[4 * (by * base.width + bx) + 3] < 128 {
            return None;
        }
        let color = rgb(self.edited, y * self.edited.width + x);
        let own = rgb(base, by * base.width + bx);
        if !self.is_resized() && !self.lossy {
            return Some((own, f64::from(color_distance(own, color)).sqrt()));
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
            let swing = RINGING * f64::from(most[k] - least[k]);
            let over = low[k].saturating_sub(color[k]).max(color[k].saturating_sub(high[k]));
            (f64::from(over) - swing).max(0.0)
        };
        Some((mean, (0..3).map(|k| beyond(k).powi(2)).sum::<f64>().sqrt()))
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
    fn compare(&self, base: &Picture, labels: &Picture, tolerance: f64) -> Vec<Seen> {
        let width = self.edited.width;
        let state = |i: usize| {
            let (x, y) = (i % width, i / width);
            let nothing = Seen { state: State::NoSurface, base: [0; 3], edge: false };
            let on_labels =
                self.map_pixel(x, y, labels).is_some_and(|(c, r)| labels.rgba[4 * (r * labels.width + c) + 3] >= 128);
            if !on_labels {
                return nothing;
            }
            let edge = self.is_near_edge(x, y, base);
            let Some((mean, difference)) = self.difference(x, y, base) else {
                // Surface without a value in this picture (such as colour): what is opaque there was painted.
                let opaque =
                    self.edited.rgba[4 * i + 3] >= 128 && difference_from_grey(rgb(self.edited, i)) > NEW_COLOR;
                let state = if opaque { State::Painted } else { State::Same };
                return Seen { state, base: [255; 3], edge };
            };
            let state = if self.edited.rgba[4 * i + 3] < 128 {
                State::Erased
            } else if difference > tolerance {
                State::Painted
            } else {
                State::Same
            };
            Seen { state, base: mean, edge }
        };
        (0..width * self.edited.height).into_par_iter().map(state).collect()
    }
}

/// How colourful a colour is: greatest less smallest channel.
fn difference_from_grey(c: [u8; 3]) -> f64 {
    f64::from(c[0].max(c[1]).max(c[2])) - f64::from(c[0].min(c[1]).min(c[2]))
}

/// The place of a picture that shows the whole map at another resolution.
fn whole_map(picture: &Picture, map: &Picture, placement: Placement) -> Result<Placement, Error> {
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
fn find_base<'a>(sample: &Sampler, bases: &'a [Base]) -> Result<(&'a Base, f64), Error> {
    let width = sample.edited.width;
    let pixels = width * sample.edited.height;
    let step = (pixels / BASE_SAMPLES).max(1) | 1;
    let mut best: Option<(f64, f64, &Base)> = None;
    for base in bases {
        let mut differences: Vec<f64> = (0..pixels)
            .step_by(step)
            .filter(|&i| sample.edited.rgba[4 * i + 3] >= 128)
            .filter_map(|i| sample.difference(i % width, i / width, &base.picture).map(|d| d.1))
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

/// The painted pixels and what they may be painted with.
struct Painted<'a> {
    picture: &'a Picture,
    seen: &'a [Seen],
    classes: &'a [PaletteEntry],
    rules: &'a Rules,
}

/// What a painted pixel turns out to be.
enum Found {
    /// Painted with a class (its place in the list) to this share.
    Paint(u16, f64),
    /// A difference that the file's own noise explains.
    Noise,
    /// Painted with something that is no class.
    Nothing,
}

impl Painted<'_> {
    /// The class of a pixel whose colour leaves no doubt.
    fn certain(&self, i: usize) -> Option<u16> {
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
    fn share(&self, i: usize, certain: &[Option<u16>]) -> Found {
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
fn unmix(color: [u8; 3], base: [u8; 3], paint: [u8; 3], lossy: bool) -> (f64, f64) {
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

fn distance(a: [u8; 3], b: [u8; 3]) -> f64 {
    f64::from(color_distance(a, b)).sqrt()
}

/// Colours that are painted, cover enough pixels, and are no mixture of what is known already.
///
/// In a picture with exact colours a new one is flat: the same on two lines through a pixel. Where colours are mixed, the
/// pixels that differ most from the base among their neighbours come nearest to the full colour; the colours farthest
/// from the base are taken first, and what they explain is no class of its own.
fn find_new_classes(
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

/// In a noisy picture a certain pixel without neighbours of its class is noise.
fn drop_isolated(certain: &mut [Option<u16>], index: &[usize], width: usize, height: usize) {
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

/// The classes in the pixels of the map, over the part of it that the edited picture shows.
fn on_the_map(
    sample: &Sampler,
    labels: &Picture,
    palette: &[PaletteEntry],
    classes: &[PaletteEntry],
    seen: &[Seen],
    paint: &[(u16, f32)],
) -> LabelMap {
    let (width, height) = (sample.edited.width, sample.edited.height);
    let low = sample.map_from_edited(0.0, 0.0);
    let high = sample.map_from_edited(width as f64, height as f64);
    let clip = |x: f64, end: usize| (x.round().max(0.0) as usize).min(end);
    let (c0, c1) = (clip(low.x, labels.width), clip(high.x, labels.width));
    let (r0, r1) = (clip(low.y, labels.height), clip(high.y, labels.height));
    let (out_width, out_height) = (c1.saturating_sub(c0), r1.saturating_sub(r0));
    let mut out = vec![NO_SURFACE; out_width * out_height];
    let placement = Placement {
        first_centre: sample.placement.chart_from_pixel(Vec2::new(c0 as f64 + 0.5, r0 as f64 + 0.5)),
        ..sample.placement
    };
    let label_at = |i: usize| {
        let at = (i / out_width + r0) * labels.width + i % out_width + c0;
        if labels.rgba[4 * at + 3] < 128 {
            return NO_SURFACE;
        }
        let before = nearest_class(palette, rgb(labels, at));
        let uv = placement.chart_from_pixel(Vec2::new((i % out_width) as f64 + 0.5, (i / out_width) as f64 + 0.5));
        let p = sample.own.pixel_from_chart(uv) - Vec2::repeat(0.5);
        let (x, y) = (p.x.floor(), p.y.floor());
        let (tx, ty) = (p.x - x, p.y - y);
        let pixel = |dx: f64, dy: f64| {
            let c = (x + dx).clamp(0.0, width as f64 - 1.0) as usize;
            let r = (y + dy).clamp(0.0, height as f64 - 1.0) as usize;
            r * width + c
        };
        let around = [
            (pixel(0.0, 0.0), (1.0 - tx) * (1.0 - ty)),
            (pixel(1.0, 0.0), tx * (1.0 - ty)),
            (pixel(0.0, 1.0), (1.0 - tx) * ty),
            (pixel(1.0, 1.0), tx * ty),
        ];
        let mut shares: [(u16, f64); 4] = [(0, 0.0); 4];
        let (mut total, mut erased) = (0.0, 0.0);
        for (k, (n, weight)) in around.into_iter().enumerate() {
            let (class, share) = paint[n];
            let share = f64::from(share) * weight;
            // The same class in several of the four pixels counts together.
            let slot = (0..k).find(|&j| shares[j].0 == class && shares[j].1 > 0.0).unwrap_or(k);
            shares[slot] = (class, shares[slot].1 + share);
            total += share;
            erased += if seen[n].state == State::Erased { weight } else { 0.0 };
        }
        if erased >= 0.5 {
            return 0;
        }
        if total < 0.5 - 1e-6 {
            return before;
        }
        let most = shares.iter().fold((0u16, 0.0), |m, s| if s.1 > m.1 { *s } else { m });
        classes[usize::from(most.0)].value
    };
    out.par_iter_mut().enumerate().for_each(|(i, label)| *label = label_at(i));
    LabelMap { width: out_width, height: out_height, placement, labels: out }
}

fn nearest_class(classes: &[PaletteEntry], color: [u8; 3]) -> Label {
    classes.iter().map(|e| (color_distance(e.color, color), e.value)).min().map_or(0, |(_, label)| label)
}

fn rgb(picture: &Picture, i: usize) -> [u8; 3] {
    [picture.rgba[4 * i], picture.rgba[4 * i + 1], picture.rgba[4 * i + 2]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{Grid, palette};

    const W: usize = 240;
    const H: usize = 120;

    fn pixel(picture: &Picture, i: usize) -> [u8; 4] {
        [picture.rgba[4 * i], picture.rgba[4 * i + 1], picture.rgba[4 * i + 2], picture.rgba[4 * i + 3]]
    }

    fn picture(width: usize, height: usize, color: impl Fn(usize, usize) -> [u8; 4]) -> Picture {
        let rgba = (0..width * height).flat_map(|i| color(i % width, i / width)).collect();
        Picture { width, height, rgba }
    }

    fn opaque(c: [u8; 3]) -> [u8; 4] {
        [c[0], c[1], c[2], 255]
    }

    /// Labels 1 and 2 in two bars, a photo with texture, both with a transparent border of 5 pixels.
    fn bases() -> (Vec<Base>, Vec<PaletteEntry>, Placement) {
        let classes = palette([1, 2]);
        let border = |x: usize, y: usize| x < 5 || y < 5 || x >= W - 5 || y >= H - 5;
        let labels = picture(W, H, |x, y| match (border(x, y), x) {
            (true, _) => [0; 4],
            (_, 40..50) => opaque(classes[1].color),
            (_, 80..90) => opaque(classes[2].color),
            _ => opaque(classes[0].color),
        });
        let photo = picture(W, H, |x, y| {
            let grey = 90 + ((x * 7 + y * 13) % 31) as u8;
            if border(x, y) { [0; 4] } else { [grey, grey, grey - 9, 255] }
        });
        let grid = Grid::covering(Vec2::zeros(), Vec2::new(2.4, 1.2), 0.01).unwrap();
        let bases =
            vec![Base { name: "labels".into(), picture: labels }, Base { name: "color".into(), picture: photo }];
        (bases, classes, Placement::of_grid(&grid))
    }

    fn stroke(picture: &mut Picture, y: std::ops::Range<usize>, color: [u8; 3]) {
        for y in y {
            for x in 100..200 {
                let i = 4 * (y * picture.width + x);
                picture.rgba[i..i + 4].copy_from_slice(&opaque(color));
            }
        }
    }

    fn edited(picture: Picture) -> Edited {
        Edited { picture, placement: None, lossy: false }
    }

    #[test]
    fn an_untouched_label_map_comes_back() {
        let (bases, classes, placement) = bases();
        let found = recognise(&edited(bases[0].picture.clone()), &bases, placement, &classes).unwrap();
        assert_eq!((found.painted_px, found.new_classes.len()), (0, 0));
        let count = |l: Label| found.map.labels.iter().filter(|&&x| x == l).count();
        assert_eq!((count(1), count(2)), (10 * (H - 10), 10 * (H - 10)));
        assert_eq!(count(NO_SURFACE), W * H - (W - 10) * (H - 10));
    }

    #[test]
    fn strokes_on_the_photo_are_found_with_old_and_new_classes() {
        let (bases, classes, placement) = bases();
        let mut picture = bases[1].picture.clone();
        stroke(&mut picture, 30..33, classes[2].color);
        stroke(&mut picture, 60..63, [10, 250, 240]);
        let found = recognise(&edited(picture), &bases, placement, &classes).unwrap();
        assert_eq!((found.base.as_str(), found.painted_px), ("color", 600));
        assert_eq!(found.new_classes, [3]);
        assert_eq!(found.map.labels[31 * W + 150], 2);
        assert_eq!(found.map.labels[61 * W + 150], 3);
        // What the label map said before stays where nothing was painted.
        assert_eq!(found.map.labels[31 * W + 45], 1);
        assert_eq!(found.map.labels[31 * W + 70], 0);
    }

    #[test]
    fn half_and_double_size_work() {
        let (bases, classes, placement) = bases();
        let mut painted = bases[0].picture.clone();
        stroke(&mut painted, 30..34, classes[1].color);
        let double = picture(2 * W, 2 * H, |x, y| pixel(&painted, y / 2 * W + x / 2));
        let half = picture(W / 2, H / 2, |x, y| {
            let of = |dx: usize, dy: usize| pixel(&painted, (2 * y + dy) * W + 2 * x + dx).map(u16::from);
            let (a, b, c, d) = (of(0, 0), of(1, 0), of(0, 1), of(1, 1));
            [0, 1, 2, 3].map(|k| ((a[k] + b[k] + c[k] + d[k]) / 4) as u8)
        });
        for version in [double, half] {
            let width = version.width as f64;
            let found = recognise(&edited(version), &bases, placement, &classes).unwrap();
            let at = |x: f64, y: f64| found.map.at(Vec2::new(x, y)).unwrap();
            assert_eq!(at(1.5, 1.2 - 0.32), 1, "{width}");
            assert_eq!(at(1.5, 1.2 - 0.40), 0, "{width}");
            assert_eq!(at(0.85, 0.6), 2, "{width}");
        }
    }

    #[test]
    fn strange_pictures_are_refused() {
        let (bases, classes, placement) = bases();
        let other = picture(W, H, |x, y| [(x * 97 % 255) as u8, (y * 31 % 255) as u8, 200, 255]);
        let error = recognise(&edited(other), &bases, placement, &classes).unwrap_err();
        assert!(matches!(error, Error::NoBase { .. }), "{error}");
        let cropped = picture(100, 100, |x, y| pixel(&bases[0].picture, y * W + x));
        let error = recognise(&edited(cropped.clone()), &bases, placement, &classes).unwrap_err();
        assert!(matches!(error, Error::Shape { width: 100, .. }), "{error}");
        // With a world file the crop is fine.
        let with_place = Edited { placement: Some(placement), ..edited(cropped) };
        let found = recognise(&with_place, &bases, placement, &classes).unwrap();
        assert_eq!(found.map.labels[50 * 100 + 45], 1);
        // A gradient has no classes.
        let mut gradient = bases[0].picture.clone();
        for y in 20..60 {
            for x in 100..200 {
                let i = 4 * (y * W + x);
                gradient.rgba[i..i + 3].copy_from_slice(&[(x + 20) as u8, (2 * y) as u8, 90]);
            }
        }
        let error = recognise(&edited(gradient), &bases, placement, &classes).unwrap_err();
        assert!(matches!(error, Error::Ambiguous { .. }), "{error}");
    }

    /// Strokes of three pixels in every direction and fills, in classes of the palette.
    fn drawing(base: &Picture, classes: &[PaletteEntry]) -> (Picture, Vec<Option<Label>>) {
        let (w, h) = (base.width, base.height);
        let (mut painted, mut truth) = (base.clone(), vec![None; w * h]);
        let mut put = |x: usize, y: usize, class: &PaletteEntry| {
            let i = y * w + x;
            if base.rgba[4 * i + 3] > 0 {
                painted.rgba[4 * i..4 * i + 3].copy_from_slice(&class.color);
                truth[i] = Some(class.value);
            }
        };
        for t in 0..100 {
            for d in 0..3 {
                put(100 + t, 11 + d, &classes[1]);
                put(111 + d, 18 + t * 95 / 100, &classes[2]);
                put(120 + t, 25 + d + t * 7 / 10, &classes[1]);
            }
        }
        for y in 80..108 {
            for x in 130..160 {
                put(x, y, &classes[2]);
            }
        }
        (painted, truth)
    }

    /// Intersection over union of the painted classes, and pixels with a class that was not painted there nor near.
    fn judge(found: &Recognised, truth: &[Option<Label>], before: &[Label]) -> (f64, usize) {
        let (mut both, mut any, mut wrong) = (0usize, 0usize, 0usize);
        for (i, (&got, &before)) in found.map.labels.iter().zip(before).enumerate() {
            let changed = (got != before).then_some(got);
            let expected = truth[i].filter(|&t| t != before);
            both += usize::from(changed.is_some() && changed == expected);
            any += usize::from(changed.is_some() || expected.is_some());
            wrong += usize::from(changed.is_some_and(|c| {
                let (x, y) = (i % W, i / W);
                !(y.saturating_sub(2)..(y + 3).min(H))
                    .any(|ny| (x.saturating_sub(2)..(x + 3).min(W)).any(|nx| truth[ny * W + nx] == Some(c)))
            }));
        }
        (both as f64 / any as f64, wrong)
    }

    fn resized(picture: &Picture, scale: f64, filter: image::imageops::FilterType) -> Picture {
        let image =
            image::RgbaImage::from_raw(picture.width as u32, picture.height as u32, picture.rgba.clone()).unwrap();
        let size = |n: usize| (n as f64 * scale).round() as u32;
        let small = image::imageops::resize(&image, size(picture.width), size(picture.height), filter);
        Picture { width: small.width() as usize, height: small.height() as usize, rgba: small.into_raw() }
    }

    fn as_jpeg(picture: &Picture, quality: u8) -> Picture {
        let rgb: Vec<u8> = picture.rgba.as_chunks::<4>().0.iter().flat_map(|p| [p[0], p[1], p[2]]).collect();
        let mut bytes = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality)
            .encode(&rgb, picture.width as u32, picture.height as u32, image::ExtendedColorType::Rgb8)
            .unwrap();
        let image = image::load_from_memory(&bytes).unwrap().into_rgba8();
        Picture { rgba: image.into_raw(), ..picture.clone() }
    }

    /// Six levels a channel with the error carried to the right, as web palettes do.
    fn with_palette(picture: &Picture) -> Picture {
        let mut out = picture.clone();
        let mut carried = [0i32; 3];
        for pixel in out.rgba.as_chunks_mut::<4>().0 {
            for k in 0..3 {
                let wanted = i32::from(pixel[k]) + carried[k];
                let level = ((wanted + 8).clamp(0, 255) / 17 * 17).clamp(0, 255);
                carried[k] = wanted - level;
                pixel[k] = level as u8;
            }
        }
        out
    }

    #[test]
    fn what_paint_programs_do_to_files_does_not_change_the_classes() {
        use image::imageops::FilterType;
        let (bases, classes, placement) = bases();
        let before: Vec<Label> =
            recognise(&edited(bases[0].picture.clone()), &bases, placement, &classes).unwrap().map.labels;
        for base in &bases {
            let (painted, truth) = drawing(&base.picture, &classes);
            let mut versions = vec![("same", painted.clone(), false, 1.0)];
            for (scale, name) in [(0.5, "half"), (2.0, "double")] {
                for filter in [FilterType::Triangle, FilterType::CatmullRom, FilterType::Lanczos3] {
                    versions.push((name, resized(&painted, scale, filter), false, 0.95));
                }
            }
            versions.push(("nearest", resized(&painted, 2.0, FilterType::Nearest), false, 0.999));
            versions.push(("jpeg", as_jpeg(&painted, 85), true, 0.85));
            versions.push(("palette", with_palette(&painted), false, 0.95));
            for (name, picture, lossy, least) in versions {
                let version = Edited { picture, placement: None, lossy };
                let found = recognise(&version, &bases, placement, &classes)
                    .unwrap_or_else(|e| panic!("{name} {}: {e}", base.name));
                assert_eq!(found.base, base.name);
                let (iou, wrong) = judge(&found, &truth, &before);
                assert!(
                    iou >= least && wrong == 0 && found.new_classes.is_empty(),
                    "{name} {}: IoU {iou}, {wrong} wrong, {:?}",
                    base.name,
                    found.new_classes
                );
            }
        }
    }

    #[test]
    fn what_was_erased_is_unlabelled() {
        let (bases, classes, placement) = bases();
        let mut picture = bases[0].picture.clone();
        for y in 50..60 {
            for x in 35..55 {
                picture.rgba[4 * (y * W + x) + 3] = 0;
            }
        }
        let found = recognise(&edited(picture), &bases, placement, &classes).unwrap();
        assert_eq!((found.erased_px, found.map.labels[55 * W + 45], found.map.labels[65 * W + 45]), (200, 0, 1));
    }
}
