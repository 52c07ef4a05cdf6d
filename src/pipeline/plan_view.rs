//! A scan seen from above, for a run that was refused: so that a person sees what Adit saw.

use crate::map::Picture;
use crate::map::stroke_font::{Align, TextStyle, draw_text, paint};
use crate::numeric::{Vec2, Vec3};
use tiny_skia::{Pixmap, Rect, Transform};

/// Longer side of the drawing in pixels, and the empty border around it.
const LONGEST_PX: f64 = 1000.0;
const BORDER_PX: f64 = 60.0;

/// Draws the points from above, north up, darker where there are more, with a scale bar. `None` without points.
pub(super) fn plan_view(points: &[Vec3]) -> Option<Picture> {
    let (low, high) = crate::spatial::voxel_grid::bounds(points)?;
    let extent = (high - low).xy();
    let pixel_m = (extent.max() / LONGEST_PX).max(1e-6);
    let side = |metres: f64| (metres / pixel_m).ceil() as usize + 1;
    let (columns, rows) = (side(extent.x), side(extent.y));
    let mut count = vec![0u32; columns * rows];
    for p in points {
        let (x, y) = (((p.x - low.x) / pixel_m) as usize, ((high.y - p.y) / pixel_m) as usize);
        count[y.min(rows - 1) * columns + x.min(columns - 1)] += 1;
    }
    let mut seen: Vec<f64> = count.iter().filter(|c| **c > 0).map(|c| f64::from(*c)).collect();
    // Walls seen from above hold most points a pixel; nine tenths of them come out black.
    let much = crate::numeric::statistics::quantile(&mut seen, 0.9).unwrap_or(1.0).max(1.0);
    let border = BORDER_PX as usize;
    let (width, height) = (columns + 2 * border, rows + 2 * border);
    let mut canvas = Pixmap::new(width as u32, height as u32)?;
    canvas.fill(tiny_skia::Color::WHITE);
    for (k, &c) in count.iter().enumerate().filter(|(_, c)| **c > 0) {
        let dark = (0.25 + 0.75 * f64::from(c) / much).min(1.0);
        let grey = (255.0 * (1.0 - dark)).round() as u8;
        let at = (k / columns + border) * width + k % columns + border;
        canvas.data_mut()[4 * at..4 * at + 4].copy_from_slice(&[grey, grey, grey, 255]);
    }
    let bar_m = round_length(extent.max() / 4.0);
    let bar = Rect::from_xywh(BORDER_PX as f32, height as f32 - 30.0, (bar_m / pixel_m) as f32, 4.0)?;
    canvas.as_mut().fill_rect(bar, &paint([0, 0, 0, 255]), Transform::identity(), None);
    let style = TextStyle { cap_px: 11.0, align: Align::Start, color: [0, 0, 0, 255], upwards: false };
    let text = |canvas: &mut Pixmap, text: &str, x: f64, y: f64| {
        draw_text(&mut canvas.as_mut(), text, Vec2::new(x, y), &style);
    };
    text(&mut canvas, &format!("{bar_m} m"), BORDER_PX + bar_m / pixel_m + 8.0, height as f64 - 23.0);
    text(&mut canvas, "seen from above, north up", BORDER_PX, 30.0);
    Some(Picture { width, height, rgba: canvas.take() })
}

/// The largest of 1, 2, 5, 10, 20 ... that is not longer than `metres`.
fn round_length(metres: f64) -> f64 {
    let power = 10f64.powf(metres.max(1e-6).log10().floor());
    [5.0, 2.0].into_iter().map(|k| k * power).find(|l| *l <= metres).unwrap_or(power)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ring_is_seen_as_a_ring() {
        let points: Vec<Vec3> = (0..3600)
            .map(|i| {
                let (sin, cos) = (f64::from(i) / 3600.0 * std::f64::consts::TAU).sin_cos();
                Vec3::new(15.0 * cos, 15.0 * sin, f64::from(i % 7))
            })
            .collect();
        let picture = plan_view(&points).unwrap();
        let dark = |x: usize, y: usize| picture.rgba[4 * (y * picture.width + x)] < 250;
        let (cx, cy) = (picture.width / 2, picture.height / 2);
        assert!(!dark(cx, cy));
        assert!((0..cx).any(|x| dark(x, cy)) && (cx..picture.width).any(|x| dark(x, cy)));
        assert!((0..cy).any(|y| dark(cx, y)));
        assert!(plan_view(&[]).is_none());
        assert_eq!((round_length(7.5), round_length(49.0), round_length(0.3)), (5.0, 20.0, 0.2));
    }
}
