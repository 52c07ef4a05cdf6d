use super::resampling::{Axis, Band, Filter, Kernel, resample};
use super::*;
use crate::lift::label_map::NO_SURFACE;
use crate::map::{Grid, palette};
use crate::numeric::Vec2;

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
    let bases = vec![Base { name: "labels".into(), picture: labels }, Base { name: "color".into(), picture: photo }];
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

/// The drawing with smooth edges: the share of each pixel that is painted is that of 16 points in it.
fn smooth_drawing(base: &Picture, classes: &[PaletteEntry]) -> (Picture, Vec<Option<Label>>) {
    let (mut painted, mut truth) = (base.clone(), vec![None; base.width * base.height]);
    // Distance from a line of half width 1.5, or from a disc.
    let is_line = |x: f64, y: f64| (y - 20.3 - 0.31 * (x - 100.0)).abs() <= 1.5 * 1.05 && (100.0..=200.0).contains(&x);
    let is_disc = |x: f64, y: f64| (x - 90.0).hypot(y - 80.0) <= 21.0;
    for i in 0..truth.len() {
        let (x, y) = ((i % base.width) as f64, (i / base.width) as f64);
        for (shape, class) in
            [(&is_disc as &dyn Fn(f64, f64) -> bool, &classes[2]), (&is_line as &dyn Fn(f64, f64) -> bool, &classes[1])]
        {
            let inside = (0..16).filter(|k| shape(x + (k % 4) as f64 / 4.0 + 0.125, y + (k / 4) as f64 / 4.0 + 0.125));
            let share = inside.count() as f64 / 16.0;
            if base.rgba[4 * i + 3] == 0 || share == 0.0 {
                continue;
            }
            for k in 0..3 {
                let old = f64::from(painted.rgba[4 * i + k]);
                painted.rgba[4 * i + k] = (old + share * (f64::from(class.color[k]) - old)).round() as u8;
            }
            if share >= 0.5 {
                truth[i] = Some(class.value);
            }
        }
    }
    (painted, truth)
}

/// Intersection over union of the painted classes; pixels with another class than the one that was painted there, or a class
/// that was not painted near.
fn judge(found: &Recognised, truth: &[Option<Label>], before: &[Label]) -> (f64, usize) {
    let (mut both, mut any, mut wrong) = (0usize, 0usize, 0usize);
    for (i, (&got, &before)) in found.map.labels.iter().zip(before).enumerate() {
        let changed = (got != before).then_some(got);
        let expected = truth[i].filter(|&t| t != before);
        both += usize::from(changed.is_some() && changed == expected);
        any += usize::from(changed.is_some() || expected.is_some());
        wrong += usize::from(changed.is_some_and(|c| {
            let (x, y) = (i % W, i / W);
            let is_other = c != 0 && truth[i].is_some_and(|t| t != c);
            let is_far = !(y.saturating_sub(2)..(y + 3).min(H))
                .any(|ny| (x.saturating_sub(2)..(x + 3).min(W)).any(|nx| truth[ny * W + nx] == Some(c)));
            is_other || c != 0 && is_far
        }));
    }
    (both as f64 / any as f64, wrong)
}

fn resized(picture: &Picture, scale: f64, filter: image::imageops::FilterType) -> Picture {
    let image = image::RgbaImage::from_raw(picture.width as u32, picture.height as u32, picture.rgba.clone()).unwrap();
    let size = |n: usize| (n as f64 * scale).round() as u32;
    let small = image::imageops::resize(&image, size(picture.width), size(picture.height), filter);
    Picture { width: small.width() as usize, height: small.height() as usize, rgba: small.into_raw() }
}

/// As Pillow resizes: colours count as much as they are opaque.
fn weighted(picture: &Picture, scale: f64, kernel: Kernel) -> Picture {
    let (w, h) = ((picture.width as f64 * scale) as usize, (picture.height as f64 * scale) as usize);
    let axis = Axis { origin: 0.0, scale: 1.0 / scale };
    let band = |to: usize, from: usize| Band::new(axis, Filter::of(kernel), 0..to, &(0..from), &(0..from));
    let pixels: Vec<[f32; 4]> = picture
        .rgba
        .as_chunks::<4>()
        .0
        .iter()
        .map(|p| {
            let share = f32::from(p[3]) / 255.0;
            [share * f32::from(p[0]), share * f32::from(p[1]), share * f32::from(p[2]), f32::from(p[3])]
        })
        .collect();
    let small = resample(&pixels, picture.width, &band(w, picture.width), &band(h, picture.height));
    let plain = |c: &[f32; 4]| {
        let c = c.map(|x| x.clamp(0.0, 255.0).round());
        let share = (c[3] / 255.0).max(1e-3);
        [c[0] / share, c[1] / share, c[2] / share, c[3]].map(|x| x.round() as u8)
    };
    Picture { width: w, height: h, rgba: small.iter().flat_map(plain).collect() }
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
fn dithered(picture: &Picture) -> Picture {
    let mut out = picture.clone();
    let mut carried = [0i32; 3];
    for pixel in out.rgba.as_chunks_mut::<4>().0 {
        for k in 0..3 {
            let wanted = i32::from(pixel[k]) + carried[k];
            let level = ((wanted + 25) / 51 * 51).clamp(0, 255);
            carried[k] = wanted - level;
            pixel[k] = level as u8;
        }
    }
    out
}

/// A palette made for the picture: colours are cut to 16 levels a channel, and each cell is shown by the mean of its colours.
fn with_palette(picture: &Picture) -> Picture {
    let mut cells: std::collections::BTreeMap<[u8; 3], ([usize; 3], usize)> = Default::default();
    let cell = |p: &[u8; 4]| [p[0] / 16, p[1] / 16, p[2] / 16];
    for p in picture.rgba.as_chunks::<4>().0 {
        let (sums, count) = cells.entry(cell(p)).or_default();
        (0..3).for_each(|k| sums[k] += usize::from(p[k]));
        *count += 1;
    }
    let mut out = picture.clone();
    for p in out.rgba.as_chunks_mut::<4>().0 {
        let (sums, count) = cells[&cell(p)];
        (0..3).for_each(|k| p[k] = (sums[k] / count) as u8);
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
        let (smooth, smooth_truth) = smooth_drawing(&base.picture, &classes);
        let mut versions = vec![("same", painted.clone(), false, 1.0)];
        versions.push(("smaller", weighted(&painted, 0.7, Kernel::Lanczos), false, 0.98));
        for (scale, name, least) in [(0.5, "half", 0.97), (2.0, "double", 0.99)] {
            for filter in [FilterType::Triangle, FilterType::CatmullRom, FilterType::Lanczos3] {
                versions.push((name, resized(&painted, scale, filter), false, least));
            }
            for kernel in [Kernel::Box, Kernel::Hamming, Kernel::Cubic, Kernel::Lanczos] {
                versions.push((name, weighted(&painted, scale, kernel), false, least));
            }
        }
        versions.push(("nearest", resized(&painted, 2.0, FilterType::Nearest), false, 0.999));
        versions.push(("half, nearest", resized(&painted, 0.5, FilterType::Nearest), false, 0.88));
        versions.push(("jpeg", as_jpeg(&painted, 85), true, 0.97));
        // Under the noise of JPEG the weak texture of this photo does not tell how it was resized.
        if base.name == "labels" {
            versions.push(("half jpeg", as_jpeg(&resized(&painted, 0.5, FilterType::CatmullRom), 85), true, 0.95));
        }
        versions.push(("palette", with_palette(&painted), false, 0.98));
        versions.push(("dithered", dithered(&painted), false, 0.95));
        let smooth_versions =
            [("smooth", smooth.clone(), false, 0.98), ("smooth jpeg", as_jpeg(&smooth, 85), true, 0.9)];
        let with_truth = |truth| move |(name, picture, lossy, least)| (name, picture, lossy, least, truth);
        let all = versions.into_iter().map(with_truth(&truth));
        for (name, picture, lossy, least, truth) in
            all.chain(smooth_versions.into_iter().map(with_truth(&smooth_truth)))
        {
            let version = Edited { picture, placement: None, lossy };
            let found = recognise(&version, &bases, placement, &classes)
                .unwrap_or_else(|e| panic!("{name} {}: {e}", base.name));
            assert_eq!(found.base, base.name);
            let (iou, wrong) = judge(&found, truth, &before);
            assert!(
                iou >= least && wrong == 0 && found.new_classes.is_empty(),
                "{name} {}: IoU {iou}, {wrong} wrong, {:?}",
                base.name,
                found.new_classes
            );
        }
    }
}

/// Red and pink share an entry of the palette, and both are classes.
#[test]
fn one_colour_for_two_classes_is_refused() {
    let (bases, _, placement) = bases();
    let classes = palette([1, 2, 7]);
    let mut picture = bases[1].picture.clone();
    stroke(&mut picture, 30..50, [236, 40, 90]);
    for pixel in picture.rgba.as_chunks_mut::<4>().0 {
        if pixel[0].abs_diff(pixel[1]) < 3 {
            (0..3).for_each(|k| pixel[k] = pixel[k] / 8 * 8 + 4);
        }
    }
    let error = recognise(&edited(picture), &bases, placement, &classes).unwrap_err();
    assert!(matches!(error, Error::OneColor { .. }), "{error}");
    assert!(error.to_string().contains("'label 1' and 'label 7'"), "{error}");
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

/// Pure red and a strong yellow are nearly the colours of two classes; fills of them, and where they touch, are neither
/// those classes nor a third one.
#[test]
fn new_colours_like_those_of_classes_stay_apart_in_every_file() {
    use image::imageops::FilterType;
    let (bases, _, placement) = bases();
    let classes = palette(1..=9);
    let new = [[255, 0, 0], [250, 230, 0]];
    let mut painted = bases[1].picture.clone();
    let mut truth = vec![None; W * H];
    for y in 20..90 {
        for x in 100..200 {
            let which = usize::from(x >= 150);
            painted.rgba[4 * (y * W + x)..4 * (y * W + x) + 3].copy_from_slice(&new[which]);
            truth[y * W + x] = Some(which);
        }
    }
    for (name, picture, lossy) in [
        ("half", resized(&painted, 0.5, FilterType::CatmullRom), false),
        ("double", resized(&painted, 2.0, FilterType::CatmullRom), false),
        ("jpeg", as_jpeg(&painted, 85), true),
    ] {
        let found = recognise(&Edited { picture, placement: None, lossy }, &bases, placement, &classes)
            .unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(found.new_classes.len(), 2, "{name}: {:?}", found.classes);
        let color = |label: Label| found.classes.iter().find(|c| c.value == label).unwrap().color;
        let (mut right, mut wrong) = (0, 0);
        for (&label, truth) in found.map.labels.iter().zip(&truth) {
            let Some(truth) = *truth else { continue };
            if found.new_classes.contains(&label) && distance(color(label), new[truth]) < NEW_COLOR {
                right += 1;
            } else if label != 0 {
                wrong += 1;
            }
        }
        assert!(right >= 6_700 && wrong == 0, "{name}: {right} of 7000 right, {wrong} wrong");
    }
}

#[test]
fn a_palette_that_lost_the_colour_of_a_class_is_told() {
    let (bases, _, placement) = bases();
    let classes = palette(1..=9);
    let mut painted = bases[1].picture.clone();
    let red = classes.iter().find(|c| c.value == 1).unwrap();
    for p in (20..40).flat_map(|y| (100..160).map(move |x| 4 * (y * W + x))) {
        painted.rgba[p..p + 3].copy_from_slice(&red.color);
    }
    let found = recognise(&edited(with_palette(&painted)), &bases, placement, &classes).unwrap();
    let orange = classes.iter().find(|c| c.color == [255, 127, 0]).unwrap();
    assert!(found.lost_classes.contains(&[orange.name.clone(), red.name.clone()]), "{:?}", found.lost_classes);
    assert!(found.lost_classes.iter().all(|[lost, _]| *lost != red.name));
    let found = recognise(&edited(painted), &bases, placement, &classes).unwrap();
    assert_eq!(found.lost_classes, Vec::<[String; 2]>::new());
}
