//! A drawn page as a picture.

use crate::map::Picture;
use crate::map::sheet::{Item, Page, TEXT_PEN, text_strokes};
use tiny_skia::{
    Color, FillRule, FilterQuality, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, PixmapPaint, PixmapRef,
    Stroke, StrokeDash, Transform,
};

/// Pixels of the greatest page that is drawn.
const MAX_PIXELS: f64 = 400e6;

/// The page at a resolution (pixels per 25.4 mm) on white; `None` when that is too large a picture.
pub fn png_picture(page: &Page, dpi: f64) -> Option<Picture> {
    let k = (dpi / 25.4) as f32;
    let pixels = |mm: f64| (mm * dpi / 25.4).round().max(1.0);
    let (width, height) = (pixels(page.width_mm), pixels(page.height_mm));
    if !(width * height <= MAX_PIXELS) {
        return None;
    }
    let mut canvas = Pixmap::new(width as u32, height as u32)?;
    canvas.fill(Color::WHITE);
    let scale = Transform::from_scale(k, k);
    for item in &page.items {
        match item {
            Item::Line { points, width_mm, color, dash } => {
                let dash = StrokeDash::new(even(dash), 0.0);
                let stroke = Stroke { width: *width_mm as f32, line_join: LineJoin::Round, dash, ..Stroke::default() };
                if let Some(path) = path(std::slice::from_ref(points)) {
                    canvas.stroke_path(&path, &paint(*color), &stroke, scale, None);
                }
            }
            Item::Area { points, color } => {
                if let Some(path) = path(std::slice::from_ref(points)) {
                    canvas.fill_path(&path, &paint(*color), FillRule::Winding, scale, None);
                }
            }
            Item::Text { text, at, cap_mm, align, color, upwards } => {
                let stroke = Stroke {
                    width: (cap_mm * TEXT_PEN) as f32,
                    line_cap: LineCap::Round,
                    line_join: LineJoin::Round,
                    ..Stroke::default()
                };
                if let Some(path) = path(&text_strokes(text, *at, *cap_mm, *align, *upwards)) {
                    canvas.stroke_path(&path, &paint(*color), &stroke, scale, None);
                }
            }
            Item::Image { at, width_mm, height_mm, picture, .. } => {
                let opaque: Vec<u8> =
                    super::on_paper(picture).as_chunks::<3>().0.iter().flat_map(|p| [p[0], p[1], p[2], 255]).collect();
                let Some(pixels) = PixmapRef::from_bytes(&opaque, picture.width as u32, picture.height as u32) else {
                    continue;
                };
                let (sx, sy) = (*width_mm as f32 / picture.width as f32, *height_mm as f32 / picture.height as f32);
                let place = Transform::from_row(sx * k, 0.0, 0.0, sy * k, at[0] as f32 * k, at[1] as f32 * k);
                let paint = PixmapPaint { quality: FilterQuality::Bilinear, ..PixmapPaint::default() };
                canvas.draw_pixmap(0, 0, pixels, &paint, place, None);
            }
        }
    }
    Some(Picture { width: width as usize, height: height as usize, rgba: canvas.data().to_vec() })
}

fn even(dash: &[f64]) -> Vec<f32> {
    dash.iter().map(|d| *d as f32).collect()
}

fn paint([r, g, b]: [u8; 3]) -> Paint<'static> {
    let mut paint = Paint::default();
    paint.set_color(Color::from_rgba8(r, g, b, 255));
    paint.anti_alias = true;
    paint
}

fn path(lines: &[Vec<[f64; 2]>]) -> Option<Path> {
    let mut builder = PathBuilder::new();
    for line in lines {
        for (i, p) in line.iter().enumerate() {
            let nudge = if i > 0 && line[i] == line[i - 1] { 0.08 } else { 0.0 };
            let (x, y) = ((p[0] + nudge) as f32, p[1] as f32);
            if i == 0 { builder.move_to(x, y) } else { builder.line_to(x, y) }
        }
    }
    builder.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hundred_millimetres_are_as_many_pixels_as_the_resolution_says() {
        let mut page = Page::new(200.0, 50.0);
        page.line(&[[50.0, 0.0], [50.0, 50.0]], 0.5, [0; 3]);
        page.line(&[[150.0, 0.0], [150.0, 50.0]], 0.5, [0; 3]);
        let picture = png_picture(&page, 254.0).unwrap();
        assert_eq!((picture.width, picture.height), (2000, 500));
        let dark: Vec<usize> = (0..2000).filter(|x| picture.rgba[4 * (250 * 2000 + x)] < 128).collect();
        let middle = |from: usize, to: usize| {
            let near: Vec<usize> = dark.iter().copied().filter(|x| (from..to).contains(x)).collect();
            near.iter().sum::<usize>() as f64 / near.len() as f64 + 0.5
        };
        assert!((middle(1000, 2000) - middle(0, 1000) - 1000.0).abs() < 0.6);
        assert!(png_picture(&page, 1e5).is_none());
    }
}
