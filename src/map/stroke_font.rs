//! A small stroke font of our own for the annotations: drafting letters made of lines with round ends.
//!
//! No font of the system and no font file is needed, so a picture has the same bytes everywhere, without a display.
//!
//! Glyphs live on a grid: x in units 0 to 8, y in units from -3 (`a`) over the baseline (`d`) and the height of small
//! letters (`j`) to the height of capitals (`m`, 9 units). Each pair of characters is a point, blanks separate strokes.

use crate::numeric::Vec2;
use tiny_skia::{Color, LineCap, LineJoin, Paint, Path, PathBuilder, PixmapMut, Stroke, Transform};

/// Height of a capital letter in glyph units.
const CAP_UNITS: f64 = 9.0;
/// Space between glyphs, and width of a blank, in glyph units.
const GAP_UNITS: f64 = 2.2;
const BLANK_UNITS: f64 = 3.0;
/// Width of the pen as a share of the height of a capital.
const PEN: f64 = 0.12;

/// Where a text sits relative to its position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Align {
    /// Starts at the position.
    Start,
    /// Is centred on it.
    Middle,
    /// Ends at it.
    End,
}

/// How a text is drawn.
#[derive(Clone, Copy, Debug)]
pub struct TextStyle {
    /// Height of capitals in pixels.
    pub cap_px: f64,
    /// Horizontal place.
    pub align: Align,
    /// Red, green, blue, alpha.
    pub color: [u8; 4],
    /// Whether the text reads upwards instead of to the right.
    pub upwards: bool,
}

/// Strokes of a character; unknown characters are an empty box.
fn strokes(character: char) -> &'static str {
    match character {
        '0' => "1d4d5e5l4m1m0l0e1d",
        '1' => "1k3m3d",
        '2' => "0l1m4m5l5j0d5d",
        '3' => "0l1m4m5l5i4h2h 4h5g5e4d1d0e",
        '4' => "4d4m0g5g",
        '5' => "5m0m0i1j4j5i5e4d1d0e",
        '6' => "4m2m0j0e1d4d5e5h4i1i0h",
        '7' => "0m5m2d",
        '8' => "1h0i0l1m4m5l5i4h1h0g0e1d4d5e5g4h",
        '9' => "1d3d5g5l4m1m0l0i1h4h5i",
        '+' => "3e3k 0h6h",
        '-' | '\u{2212}' => "0h4h",
        '.' => "0d0d",
        ',' => "1d0b",
        ':' => "0e0e 0i0i",
        ';' => "1e1e0b 1i1i",
        '/' => "0c4m",
        '(' => "2n0k0d2b",
        ')' => "0n2k2d0b",
        '%' => "0d5m 0l1m2l1k0l 3e4f5e4d3e",
        '=' => "0f5f 0i5i",
        '<' => "4e0h4k",
        '>' => "0e4h0k",
        '|' => "0c0m",
        '_' => "0c5c",
        '\'' => "0m0k",
        '\u{b0}' => "0l1m2l1k0l",
        'A' => "0d3m6d 1g5g",
        'B' => "0d0m4m5l5i4h0h 4h5g5e4d0d",
        'C' => "5l4m1m0l0e1d4d5e",
        'D' => "0d0m3m5k5f3d0d",
        'E' => "5d0d0m5m 0h4h",
        'F' => "0d0m5m 0h4h",
        'G' => "5l4m1m0l0e1d4d5e5h3h",
        'H' => "0d0m 5d5m 0h5h",
        'I' => "0d0m",
        'J' => "4m4e3d1d0e",
        'K' => "0d0m 5m0g 2i5d",
        'L' => "0m0d5d",
        'M' => "0d0m3g6m6d",
        'N' => "0d0m5d5m",
        'O' => "1d5d6e6l5m1m0l0e1d",
        'P' => "0d0m4m5l5i4h0h",
        'Q' => "1d5d6e6l5m1m0l0e1d 4f6c",
        'R' => "0d0m4m5l5i4h0h 3h5d",
        'S' => "5l4m1m0l0i1h4h5g5e4d1d0e",
        'T' => "0m6m 3m3d",
        'U' => "0m0e1d4d5e5m",
        'V' => "0m3d6m",
        'W' => "0m2d4k6d8m",
        'X' => "0d5m 0m5d",
        'Y' => "0m3h6m 3h3d",
        'Z' => "0m5m0d5d",
        'a' => "5j5d 5i4j1j0i0e1d4d5e",
        'b' => "0m0d 0i1j4j5i5e4d1d0e",
        'c' => "4i3j1j0i0e1d3d4e",
        'd' => "5m5d 5i4j1j0i0e1d4d5e",
        'e' => "0g5g5i4j1j0i0e1d4d5e",
        'f' => "4m3m2l2d 0j4j",
        'g' => "5j5b4a1a0b 5i4j1j0i0e1d4d5e",
        'h' => "0m0d 0i1j3j4i4d",
        'i' => "0j0d 0l0l",
        'j' => "2j2b1a0a 2l2l",
        'k' => "0m0d 4j0f 1g4d",
        'l' => "0m0e1d",
        'm' => "0j0d 0i1j2j3i3d 3i4j5j6i6d",
        'n' => "0j0d 0i1j3j4i4d",
        'o' => "1d4d5e5i4j1j0i0e1d",
        'p' => "0j0a 0i1j4j5i5e4d1d0e",
        'q' => "5j5a 5i4j1j0i0e1d4d5e",
        'r' => "0j0d 0h2j3j",
        's' => "4i3j1j0i0h1g3g4f4e3d1d0e",
        't' => "2m2e3d4d 0j4j",
        'u' => "0j0e1d3d4e 4j4d",
        'v' => "0j2d4j",
        'w' => "0j1d3i5d6j",
        'x' => "0d4j 0j4d",
        'y' => "0j2d 4j1a0a",
        'z' => "0j4j0d4d",
        _ => "0d0m4m4d0d",
    }
}

/// Points of a stroke in glyph units, y up from the baseline.
fn points(stroke: &str) -> Vec<Vec2> {
    stroke
        .as_bytes()
        .chunks_exact(2)
        .map(|pair| Vec2::new(f64::from(pair[0] - b'0'), f64::from(pair[1]) - f64::from(b'd')))
        .collect()
}

fn width_units(character: char) -> f64 {
    if character == ' ' {
        return BLANK_UNITS;
    }
    strokes(character).split(' ').flat_map(points).fold(0.0, |w, p| p.x.max(w))
}

/// Width of a text in pixels.
pub fn text_width(text: &str, cap_px: f64) -> f64 {
    let units: f64 = text.chars().map(|c| width_units(c) + GAP_UNITS).sum();
    (units - GAP_UNITS).max(0.0) * cap_px / CAP_UNITS
}

/// The polylines of a text that starts at the origin, y up, capitals one unit high.
pub fn polylines(text: &str) -> Vec<Vec<Vec2>> {
    let mut pen = 0.0;
    let mut lines = Vec::new();
    for character in text.chars() {
        if character != ' ' {
            for stroke in strokes(character).split(' ') {
                lines.push(points(stroke).into_iter().map(|p| (p + Vec2::new(pen, 0.0)) / CAP_UNITS).collect());
            }
        }
        pen += width_units(character) + GAP_UNITS;
    }
    lines
}

/// Draws a text; `position` is a point of the baseline in pixels (y down).
pub fn draw_text(canvas: &mut PixmapMut, text: &str, position: Vec2, style: &TextStyle) {
    let shift = match style.align {
        Align::Start => 0.0,
        Align::Middle => 0.5,
        Align::End => 1.0,
    } * text_width(text, style.cap_px);
    let mut builder = PathBuilder::new();
    for line in polylines(text) {
        for (i, p) in line.iter().enumerate() {
            let along = p.x * style.cap_px - shift;
            let above = p.y * style.cap_px;
            let (x, y) = if style.upwards {
                (position.x - above, position.y - along)
            } else {
                (position.x + along, position.y - above)
            };
            match i {
                0 => builder.move_to(x as f32, y as f32),
                // A dot is a line without length; it needs some for its round ends to be drawn.
                _ if line[i] == line[i - 1] => builder.line_to(x as f32 + 0.01, y as f32),
                _ => builder.line_to(x as f32, y as f32),
            }
        }
    }
    if let Some(path) = builder.finish() {
        stroke_path(canvas, &path, style.cap_px * PEN, style.color);
    }
}

/// Strokes a path with round ends.
pub fn stroke_path(canvas: &mut PixmapMut, path: &Path, width_px: f64, color: [u8; 4]) {
    let stroke = Stroke {
        width: width_px.max(0.7) as f32,
        line_cap: LineCap::Round,
        line_join: LineJoin::Round,
        ..Stroke::default()
    };
    canvas.stroke_path(path, &paint(color), &stroke, Transform::identity(), None);
}

/// A plain colour.
pub fn paint([r, g, b, a]: [u8; 4]) -> Paint<'static> {
    let mut paint = Paint::default();
    paint.set_color(Color::from_rgba8(r, g, b, a));
    paint.anti_alias = true;
    paint
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiny_skia::Pixmap;

    #[test]
    fn all_glyphs_lie_on_their_grid() {
        for c in (' '..='~').chain(['\u{b0}', '\u{2212}']) {
            for p in strokes(c).split(' ').flat_map(points) {
                assert!((0.0..=8.0).contains(&p.x) && (-3.0..=10.0).contains(&p.y), "{c}: {p}");
            }
        }
    }

    #[test]
    fn an_l_has_its_foot_to_the_right() {
        let mut pixmap = Pixmap::new(40, 40).unwrap();
        let style = TextStyle { cap_px: 27.0, align: Align::Start, color: [0, 0, 0, 255], upwards: false };
        draw_text(&mut pixmap.as_mut(), "L", Vec2::new(10.0, 35.0), &style);
        let dark = |x: u32, y: u32| pixmap.pixel(x, y).unwrap().alpha() > 100;
        assert!(dark(10, 10) && dark(10, 34) && dark(23, 35) && !dark(23, 10));
    }

    #[test]
    fn widths_add_up() {
        assert!(text_width("00", 9.0) > 2.0 * text_width("0", 9.0));
        assert_eq!(text_width("", 9.0), 0.0);
    }
}
