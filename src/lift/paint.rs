//! What was painted on a picture of the map, whatever the paint program did to the file.
//!
//! The edited picture is compared with the pictures of the map; the one it agrees with most is its *base*. Where it
//! agrees, nothing was painted: the class is that of the label map before. Where it differs, the colour tells the class:
//! one of the palette, or a new flat colour, which becomes a new class. Pixels with colours in between (smoothed edges,
//! JPEG) belong to the class next to them that is most like them, if it is near; a picture with many pixels that belong
//! nowhere is refused.
//!
//! Works for pictures that were resized (whole map, same shape), saved with another pixel type, JPEG-compressed, or
//! cropped with a world file. Guarantee: a pixel only gets a class whose full colour was painted within
//! [`NEAR_PX`] pixels of it, so noise does not make classes. Cost: O(pixels x classes).

use super::Error;
use super::label_map::{LabelMap, NO_SURFACE};
use crate::cloud::Label;
use crate::map::{PaletteEntry, Picture, Placement, color_distance};
use crate::numeric::Vec2;
use serde::Serialize;
use std::collections::BTreeMap;

/// Squared colour distance up to which a pixel of a losslessly saved picture is the same.
const SAME: i32 = 3 * 3 * 3;
/// Squared colour distance up to which a pixel of a JPEG is the same.
const SAME_JPEG: i32 = 40 * 40;
/// Share of pixels that must agree with a picture of the map for it to be the base.
const BASE_SHARE: f64 = 0.4;
/// A smoothed pixel belongs to a full colour at most this many pixels away.
const NEAR_PX: usize = 3;
/// Share of painted pixels that may stay without a class.
const AMBIGUOUS_SHARE: f64 = 0.02;
/// A new colour must cover this many pixels to be a class.
const NEW_CLASS_PX: usize = 9;
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
    /// The classes on the map.
    #[serde(skip)]
    pub map: LabelMap,
    /// The picture of the map that was painted on.
    pub base: String,
    /// All classes: those of the palette and new ones.
    pub classes: Vec<PaletteEntry>,
    /// Values of the new classes.
    pub new_classes: Vec<Label>,
    /// Pixels that differ from the base.
    pub painted_px: usize,
    /// Painted pixels whose class was taken from their neighbourhood.
    pub smoothed_px: usize,
    /// Painted pixels without a class; they stay what they were.
    pub ambiguous_px: usize,
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
    let sample = Sampler { edited: &edited.picture, own, placement, same: if edited.lossy { SAME_JPEG } else { SAME } };
    let base = find_base(&sample, bases)?;
    let (width, height) = (edited.picture.width, edited.picture.height);
    let is_label_map = base.name == bases[0].name;

    // Class before, and whether the pixel was painted.
    let mut before = vec![NO_SURFACE; width * height];
    let mut painted = vec![false; width * height];
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let Some(at) = sample.map_pixel(x, y, labels) else { continue };
            if pixel(labels, at)[3] < 128 {
                continue;
            }
            before[i] = nearest_class(palette, rgb(labels, at)).map_or(0, |(_, label)| label);
            painted[i] = sample.differs(x, y, &base.picture);
        }
    }
    let painted_px = painted.iter().filter(|&&p| p).count();

    // Full colours: palette first, then new flat ones.
    let mut classes = palette.to_vec();
    let full = |color: [u8; 3], classes: &[PaletteEntry]| {
        nearest_class(classes, color).filter(|&(d, _)| d <= sample.same).map(|(_, label)| label)
    };
    let new_classes = find_new_classes(&edited.picture, &painted, &sample, &mut classes, is_label_map);
    let mut class: Vec<Option<Label>> = vec![None; width * height];
    for i in (0..class.len()).filter(|&i| painted[i]) {
        class[i] = full(rgb(&edited.picture, i), &classes);
    }
    if edited.lossy {
        drop_isolated(&mut class, &painted, width, height);
    }
    // Smoothed pixels: the most similar class that is near. Unpainted neighbours count with what they were.
    let certain = class.clone();
    let (mut smoothed_px, mut ambiguous, mut example) = (0, 0, 0);
    for i in (0..class.len()).filter(|&i| painted[i] && certain[i].is_none()) {
        let (x, y) = (i % width, i / width);
        let color = rgb(&edited.picture, i);
        let mut best: Option<(i32, Label)> = None;
        let mut near_painted = false;
        for ny in y.saturating_sub(NEAR_PX)..(y + NEAR_PX + 1).min(height) {
            for nx in x.saturating_sub(NEAR_PX)..(x + NEAR_PX + 1).min(width) {
                let n = ny * width + nx;
                let label = match certain[n] {
                    Some(label) => label,
                    None if !painted[n] && before[n] != NO_SURFACE => before[n],
                    None => continue,
                };
                near_painted |= certain[n].is_some();
                let d = color_distance(rgb(&edited.picture, n), color);
                if best.is_none_or(|(b, l)| d < b || (d == b && label < l)) {
                    best = Some((d, label));
                }
            }
        }
        match best {
            Some((_, label)) if near_painted => {
                class[i] = Some(label);
                smoothed_px += 1;
            }
            _ => {
                if ambiguous == 0 {
                    example = i;
                }
                ambiguous += 1;
            }
        }
    }
    // Losses touch edges of what was there before; those pixels stay what they were.
    if !edited.lossy && ambiguous as f64 > AMBIGUOUS_SHARE * painted_px as f64 && ambiguous > NEW_CLASS_PX {
        let [r, g, b] = rgb(&edited.picture, example);
        return Err(Error::Ambiguous {
            ambiguous,
            painted: painted_px,
            color: format!("#{r:02x}{g:02x}{b:02x}"),
            column: example % width,
            row: example / width,
        });
    }
    let after = class.iter().zip(&before).map(|(c, &b)| if b == NO_SURFACE { b } else { c.unwrap_or(b) }).collect();
    let map = LabelMap { width, height, placement: own, labels: after };
    let base = base.name.clone();
    Ok(Recognised { map, base, classes, new_classes, painted_px, smoothed_px, ambiguous_px: ambiguous })
}

/// Compares the edited picture with pictures of the map, pixel by pixel of the edited one.
struct Sampler<'a> {
    edited: &'a Picture,
    own: Placement,
    placement: Placement,
    same: i32,
}

impl Sampler<'_> {
    /// Index of the pixel of a picture of the map under the centre of a pixel of the edited picture.
    fn map_pixel(&self, x: usize, y: usize, picture: &Picture) -> Option<usize> {
        let uv = self.own.chart_from_pixel(Vec2::new(x as f64 + 0.5, y as f64 + 0.5));
        let p = self.placement.pixel_from_chart(uv);
        let inside = p.x >= 0.0 && p.y >= 0.0 && p.x < picture.width as f64 && p.y < picture.height as f64;
        inside.then(|| p.y as usize * picture.width + p.x as usize)
    }

    fn resized(&self) -> bool {
        (self.own.step_u / self.placement.step_u - 1.0).abs() > 1e-6
    }

    /// Whether the colour differs from the base. In a resized picture it may be a mixture of the pixels around.
    fn differs(&self, x: usize, y: usize, base: &Picture) -> bool {
        let Some(at) = self.map_pixel(x, y, base) else { return false };
        let color = rgb(self.edited, y * self.edited.width + x);
        if color_distance(rgb(base, at), color) <= self.same {
            return false;
        }
        if !self.resized() {
            return true;
        }
        // Between the darkest and the brightest value of each channel around: may be a mixture.
        let reach = (self.own.step_u / self.placement.step_u).ceil() as usize + 1;
        let (bx, by) = (at % base.width, at / base.width);
        let (mut low, mut high) = ([255u8; 3], [0u8; 3]);
        for ny in by.saturating_sub(reach)..(by + reach + 1).min(base.height) {
            for nx in bx.saturating_sub(reach)..(bx + reach + 1).min(base.width) {
                let c = rgb(base, ny * base.width + nx);
                for k in 0..3 {
                    low[k] = low[k].min(c[k]);
                    high[k] = high[k].max(c[k]);
                }
            }
        }
        let slack = f64::from(self.same).sqrt() as i32;
        (0..3).any(|k| {
            i32::from(color[k]) < i32::from(low[k]) - slack || i32::from(color[k]) > i32::from(high[k]) + slack
        })
    }
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

/// The picture of the map that agrees most with the edited one.
fn find_base<'a>(sample: &Sampler, bases: &'a [Base]) -> Result<&'a Base, Error> {
    let pixels = sample.edited.width * sample.edited.height;
    let step = (pixels / BASE_SAMPLES).max(1) | 1;
    let mut best: Option<(f64, &Base)> = None;
    for base in bases {
        let (mut seen, mut same) = (0usize, 0usize);
        for i in (0..pixels).step_by(step) {
            let (x, y) = (i % sample.edited.width, i / sample.edited.width);
            let Some(at) = sample.map_pixel(x, y, &base.picture) else { continue };
            if pixel(&base.picture, at)[3] < 128 {
                continue;
            }
            seen += 1;
            same += usize::from(!sample.differs(x, y, &base.picture));
        }
        let share = if seen == 0 { 0.0 } else { same as f64 / seen as f64 };
        if best.is_none_or(|(b, _)| share > b) {
            best = Some((share, base));
        }
    }
    match best {
        Some((share, base)) if share >= BASE_SHARE => Ok(base),
        Some((share, base)) => Err(Error::NoBase { closest: base.name.clone(), percent: 100.0 * share }),
        None => Err(Error::NoBase { closest: "none".into(), percent: 0.0 }),
    }
}

/// Flat colours that are painted, cover enough pixels and belong to no class yet.
fn find_new_classes(
    picture: &Picture,
    painted: &[bool],
    sample: &Sampler,
    classes: &mut Vec<PaletteEntry>,
    is_label_map: bool,
) -> Vec<Label> {
    let (width, height) = (picture.width, picture.height);
    let mut counts: BTreeMap<[u8; 3], usize> = BTreeMap::new();
    // JPEG does not keep a colour exactly: neighbours of the same colour count within its tolerance.
    let tolerance = if sample.same == SAME { SAME } else { 12 * 12 };
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            let color = rgb(picture, i);
            let known = nearest_class(classes, color).is_some_and(|(d, _)| d <= sample.same);
            if !painted[i] || known {
                continue;
            }
            // Flat: the same colour on a line through the pixel is enough for a thin stroke.
            let same = |n: usize| painted[n] && color_distance(rgb(picture, n), color) <= tolerance;
            let lines = [
                [i - 1, i + 1],
                [i - width, i + width],
                [i - width - 1, i + width + 1],
                [i - width + 1, i + width - 1],
            ];
            if lines.iter().filter(|l| l.iter().all(|&n| same(n))).count() >= 2 {
                let key = if sample.same == SAME { color } else { color.map(|c| c & 0xf0 | 8) };
                *counts.entry(key).or_insert(0) += 1;
            }
        }
    }
    let mut found: Vec<([u8; 3], usize)> = counts.into_iter().filter(|c| c.1 >= NEW_CLASS_PX).collect();
    found.sort_by_key(|&(color, count)| (std::cmp::Reverse(count), color));
    let mut new = Vec::new();
    for (color, _) in found {
        // Not a shade of a class: JPEG makes those. And white or transparent paper is no class on the label map.
        let distance = nearest_class(classes, color).map_or(i32::MAX, |(d, _)| d);
        if distance <= sample.same.max(24 * 24) || (is_label_map && color == [255; 3]) {
            continue;
        }
        let value = classes.iter().map(|e| e.value).max().unwrap_or(0) + 1;
        classes.push(PaletteEntry { value, name: format!("new {value}"), color });
        new.push(value);
    }
    new
}

/// In a lossy picture a full colour without neighbours of its class is noise.
fn drop_isolated(class: &mut [Option<Label>], painted: &[bool], width: usize, height: usize) {
    let before = class.to_vec();
    for i in (0..class.len()).filter(|&i| painted[i]) {
        let (x, y) = (i % width, i / width);
        let mut same = 0;
        for ny in y.saturating_sub(1)..(y + 2).min(height) {
            for nx in x.saturating_sub(1)..(x + 2).min(width) {
                same += usize::from(before[ny * width + nx] == before[i] && before[i].is_some());
            }
        }
        if same < 4 {
            class[i] = None;
        }
    }
}

fn nearest_class(classes: &[PaletteEntry], color: [u8; 3]) -> Option<(i32, Label)> {
    classes.iter().map(|e| (color_distance(e.color, color), e.value)).min()
}

fn pixel(picture: &Picture, i: usize) -> [u8; 4] {
    [picture.rgba[4 * i], picture.rgba[4 * i + 1], picture.rgba[4 * i + 2], picture.rgba[4 * i + 3]]
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
}
