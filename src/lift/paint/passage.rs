//! What happened to a picture of the map before it came back: told by where it was not painted on.

use super::palette::Palette;
use super::resampling::{Filter, Kernel};
use super::window::{OPAQUE, Place, Window, far};
use super::{Base, Error, MAX_TOLERANCE, NOISE_FACTOR, SAME};
use crate::map::{PaletteEntry, Picture, PixelRect};
use crate::numeric::statistics;
use rayon::prelude::*;

/// Share of pixels that must agree with a picture of the map for it to be the base.
const BASE_SHARE: f64 = 0.4;
/// Median difference from the base, at most.
const MAX_MEDIAN: f64 = 30.0;
/// The map is looked at in so many pieces of this side, in pixels of the map.
const PIECES: f64 = 80.0;
const PIECE_PX: usize = 64;
/// Kernels are told apart where they differ by more than this.
const TELLING: f64 = 2.0;
/// Painted pixels tell nothing about the kernel; a difference counts up to this.
const MOST: f64 = 20.0;
/// A kernel that leaves more than this on average, where kernels differ, is not the one.
const KNOWN: f64 = 5.0;
/// A picture is exact when so many of its pixels are.
const EXACT_SHARE: f64 = 0.9;
/// Dithering is smoothed by a triangle of this half width.
const FOCUS_PX: f64 = 2.0;

/// How transparent pixels were mixed with others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Alpha {
    /// Colours count as much as they are opaque.
    Weighted,
    /// Colours count alike.
    Plain,
}

/// How a picture of the map became the picture that came back.
#[derive(Clone, Debug)]
pub(super) struct Passage {
    pub(super) filter: Filter,
    alpha: Alpha,
    /// Opaque colour behind the map.
    background: Option<[u8; 3]>,
    palette: Option<Palette>,
    pub(super) lossy: bool,
    /// Whether one of the kernels predicts the picture.
    pub(super) is_known: bool,
}

impl Passage {
    /// Whether colours are right only on average.
    pub(super) fn is_dithered(&self) -> bool {
        self.palette.as_ref().is_some_and(|p| p.is_dithered)
    }

    /// The palette, if each colour became one of its own.
    pub(super) fn palette(&self) -> Option<&Palette> {
        self.palette.as_ref().filter(|p| !p.is_dithered)
    }

    /// The colour of a pixel of a picture of the map, as it was before it was resized.
    pub(super) fn color_of_base(&self, [r, g, b, a]: [u8; 4]) -> [f32; 4] {
        if a < OPAQUE { self.background.map_or([0.0; 4], opaque) } else { opaque([r, g, b]) }
    }

    /// The colour of a pixel that came back.
    pub(super) fn color_seen(&self, [r, g, b, a]: [u8; 4]) -> [f32; 4] {
        let share = if self.alpha == Alpha::Weighted { f32::from(a) / 255.0 } else { 1.0 };
        [share * f32::from(r), share * f32::from(g), share * f32::from(b), f32::from(a)]
    }

    /// The colours that classes have in the picture that came back.
    pub(super) fn colors_of_classes(&self, classes: &[PaletteEntry]) -> Vec<[u8; 3]> {
        match &self.palette {
            None => classes.iter().map(|c| c.color).collect(),
            Some(palette) => palette.of_classes(&classes.iter().map(|c| (c.color, c.value)).collect::<Vec<_>>()),
        }
    }

    /// Names of the classes without a colour of their own in the palette of the picture, and of the class that shows instead
    /// of each, if one does.
    pub(super) fn lost_classes(&self, classes: &[PaletteEntry], shown: &[[u8; 3]]) -> Vec<[String; 2]> {
        let Some(palette) = &self.palette else { return Vec::new() };
        let lost = |k: &usize| classes[*k].value != 0 && palette.lost(shown[*k]);
        let instead = |k: usize| {
            let entry = palette.of_base(classes[k].color);
            let other = (0..classes.len()).find(|&j| j != k && classes[j].value != 0 && shown[j] == entry)?;
            Some([classes[k].name.clone(), classes[other].name.clone()])
        };
        (0..classes.len()).filter(lost).filter_map(instead).collect()
    }
}

fn opaque([r, g, b]: [u8; 3]) -> [f32; 4] {
    [f32::from(r), f32::from(g), f32::from(b), 255.0]
}

/// The picture of the map that agrees most with the edited one, what happened to it, and the median of the differences.
pub(super) fn identify<'a>(
    edited: &Picture,
    lossy: bool,
    bases: &'a [Base],
    place: &Place,
) -> Result<(&'a Base, Passage, f64), Error> {
    let pieces = pieces(place);
    let kernel = if place.is_resized() { Kernel::Box } else { Kernel::Nearest };
    let mut passage = Passage {
        filter: Filter::of(kernel),
        alpha: Alpha::Weighted,
        background: background(edited, &bases[0].picture, place),
        palette: None,
        lossy,
        is_known: true,
    };
    let differences = |base: &Base, passage: &Passage| -> Vec<f64> {
        let of_piece = |&piece: &PixelRect| {
            let window = Window::new(piece, place, passage, edited, &base.picture);
            let all = (0..window.seen.len()).filter(|&i| window.is_surface(i)).map(|i| window.difference(i));
            all.collect::<Vec<f64>>()
        };
        pieces.par_iter().map(of_piece).collect::<Vec<_>>().concat()
    };
    let mut best: Option<(f64, &Base)> = None;
    for base in bases {
        let Some(median) = statistics::median(&mut differences(base, &passage)) else { continue };
        if best.is_none_or(|(m, _)| median < m) {
            best = Some((median, base));
        }
    }
    let Some((_, base)) = best else {
        return Err(Error::NoBase { closest: "none".into(), percent: 0.0 });
    };
    let mut rest = 0.0;
    if place.is_resized() {
        (passage, rest) = find_kernel(edited, base, place, &passage, &pieces);
    } else if !lossy {
        let before = differences(base, &passage);
        find_palette(edited, base, place, &mut passage, &before);
    }
    let mut found = differences(base, &passage);
    let mut median = statistics::median(&mut found).unwrap_or(f64::INFINITY);
    if !lossy && rest > KNOWN {
        passage.is_known = false;
        median = median.max(rest / 2.0);
    }
    let tolerance = (SAME + NOISE_FACTOR * median.min(MAX_MEDIAN)).min(MAX_TOLERANCE);
    let share = found.iter().filter(|d| **d <= tolerance).count() as f64 / found.len().max(1) as f64;
    if share >= BASE_SHARE && median <= MAX_MEDIAN {
        Ok((base, passage, median))
    } else if share >= BASE_SHARE && median <= 2.0 * MAX_MEDIAN {
        Err(Error::Noisy { closest: base.name.clone(), difference: median })
    } else {
        Err(Error::NoBase { closest: base.name.clone(), percent: 100.0 * share })
    }
}

/// Pieces of the map, spread over what the picture shows of it.
fn pieces(place: &Place) -> Vec<PixelRect> {
    let [columns, rows] = &place.covered;
    let (width, height) = (columns.len(), rows.len());
    let across = (PIECES * width as f64 / height.max(1) as f64).sqrt().ceil().max(1.0) as usize;
    let across = across.min(width.div_ceil(PIECE_PX)).max(1);
    let down = ((PIECES / across as f64).ceil() as usize).clamp(1, height.div_ceil(PIECE_PX).max(1));
    let piece = |i: usize| {
        let middle = |k: usize, of: usize, length: usize| {
            let side = PIECE_PX.min(length);
            (((2 * k + 1) * length / (2 * of)).saturating_sub(side / 2).min(length - side), side)
        };
        let ((x, width), (y, height)) = (middle(i % across, across, width), middle(i / across, down, height));
        PixelRect { column: columns.start + x, row: rows.start + y, width, height }
    };
    (0..across * down).map(piece).collect()
}

/// The colour behind the map, if the picture came back without transparency.
fn background(edited: &Picture, labels: &Picture, place: &Place) -> Option<[u8; 3]> {
    let map_pixel = |x: usize, y: usize| {
        let at = |k: usize, axis: super::resampling::Axis, end: usize| {
            let p = axis.origin + (k as f64 + 0.5) * axis.scale;
            (p >= 0.0 && p < end as f64).then_some(p as usize)
        };
        Some(at(y, place.rows, labels.height)? * labels.width + at(x, place.columns, labels.width)?)
    };
    let mut channels = [const { Vec::new() }; 4];
    let (width, height) = (edited.width, edited.height);
    let step = (width * height / 400_000).max(1) | 1;
    for i in (0..width * height).step_by(step) {
        if map_pixel(i % width, i / width).is_some_and(|p| labels.rgba[4 * p + 3] < OPAQUE) {
            (0..4).for_each(|k| channels[k].push(f64::from(edited.rgba[4 * i + k])));
        }
    }
    let [r, g, b, alpha] = channels.map(|mut c| statistics::median(&mut c).map_or(0, |m| m.round() as u8));
    (alpha >= OPAQUE).then_some([r, g, b])
}

/// The kernel that the picture was resized with, and how transparent pixels were mixed: what predicts it best where kernels
/// differ. Gives the mean difference that is left there, too.
fn find_kernel(
    edited: &Picture,
    base: &Base,
    place: &Place,
    passage: &Passage,
    pieces: &[PixelRect],
) -> (Passage, f64) {
    let kinds: &[Alpha] =
        if passage.background.is_some() { &[Alpha::Weighted] } else { &[Alpha::Weighted, Alpha::Plain] };
    let candidates: Vec<Passage> = Kernel::ALL
        .iter()
        .flat_map(|&kernel| kinds.iter().map(move |&alpha| (Filter::of(kernel), alpha)))
        .map(|(filter, alpha)| Passage { filter, alpha, ..passage.clone() })
        .collect();
    let of_piece = |&piece: &PixelRect| -> (Vec<f64>, usize) {
        let windows: Vec<Window> =
            candidates.iter().map(|passage| Window::new(piece, place, passage, edited, &base.picture)).collect();
        let (mut sums, mut count) = (vec![0.0; candidates.len()], 0);
        // The widest kernel has the fewest complete pixels.
        let inner = windows.iter().map(|w| w.edited).reduce(common).unwrap_or(piece);
        for y in inner.row..inner.row + inner.height {
            for x in inner.column..inner.column + inner.width {
                let at = |w: &Window| (y - w.edited.row) * w.edited.width + x - w.edited.column;
                let first = windows[0].expected[at(&windows[0])];
                if windows.iter().any(|w| far(w.expected[at(w)], first) > TELLING) {
                    windows.iter().zip(&mut sums).for_each(|(w, s)| *s += w.difference(at(w)).min(MOST));
                    count += 1;
                }
            }
        }
        (sums, count)
    };
    let parts: Vec<(Vec<f64>, usize)> = pieces.par_iter().map(of_piece).collect();
    let count: usize = parts.iter().map(|p| p.1).sum();
    let total = |k: usize| parts.iter().map(|p| p.0[k]).sum::<f64>();
    let best = (0..candidates.len()).min_by(|&a, &b| total(a).total_cmp(&total(b))).unwrap_or(0);
    (candidates[best].clone(), total(best) / count.max(1) as f64)
}

fn common(a: PixelRect, b: PixelRect) -> PixelRect {
    let (column, row) = (a.column.max(b.column), a.row.max(b.row));
    let end = |a: usize, b: usize, start: usize| a.min(b).saturating_sub(start);
    PixelRect {
        column,
        row,
        width: end(a.column + a.width, b.column + b.width, column),
        height: end(a.row + a.height, b.row + b.height, row),
    }
}

/// Finds the palette that replaced the colours, if one did.
fn find_palette(edited: &Picture, base: &Base, place: &Place, passage: &mut Passage, differences: &[f64]) {
    let equal = differences.iter().filter(|d| **d < 1.0).count();
    if equal as f64 >= EXACT_SHARE * differences.len() as f64 {
        return;
    }
    let [columns, rows] = &place.covered;
    let base = &base.picture;
    let (dx, dy) = (place.columns.origin, place.rows.origin);
    let pixel = |picture: &Picture, x: usize, y: usize| {
        let at = 4 * (y * picture.width + x);
        [picture.rgba[at], picture.rgba[at + 1], picture.rgba[at + 2], picture.rgba[at + 3]]
    };
    let pairs = rows.clone().flat_map(|y| columns.clone().map(move |x| (x, y))).filter_map(|(x, y)| {
        let [r, g, b, a] = pixel(base, x, y);
        let seen = pixel(edited, (x as f64 - dx) as usize, (y as f64 - dy) as usize);
        (a >= OPAQUE && seen[3] >= OPAQUE).then_some(([r, g, b], [seen[0], seen[1], seen[2]]))
    });
    passage.palette = Palette::of(edited, pairs);
    if passage.is_dithered() {
        passage.filter = Filter { kernel: Kernel::Triangle, spread: FOCUS_PX };
    }
}
