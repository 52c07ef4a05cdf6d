//! SVG of a drawn page, in millimetres: what drawing programs open and edit.
//!
//! Letters are strokes, grouped under the words they spell; the raster is embedded.

use crate::map::sheet::{Item, Page, TEXT_PEN, text_strokes};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use std::fmt::Write;

/// A page as the text of an SVG file.
///
/// # Errors
/// When a raster cannot be encoded.
pub fn svg(page: &Page, title: &str) -> Result<String, image::ImageError> {
    let (w, h) = (page.width_mm, page.height_mm);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w}mm\" height=\"{h}mm\" viewBox=\"0 0 {w} {h}\">\n\
         <title>{}</title>\n<rect width=\"{w}\" height=\"{h}\" fill=\"#ffffff\"/>\n",
        escape(title)
    );
    for item in &page.items {
        match item {
            Item::Line { points, width_mm, color, dash } => {
                let _ = write!(
                    out,
                    "<path d=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{width_mm}\" stroke-linejoin=\"round\"",
                    path(points),
                    hex(*color)
                );
                if !dash.is_empty() {
                    let lengths: Vec<String> = dash.iter().map(f64::to_string).collect();
                    let _ = write!(out, " stroke-dasharray=\"{}\"", lengths.join(" "));
                }
                out += "/>\n";
            }
            Item::Area { points, color } => {
                let _ = writeln!(out, "<path d=\"{}Z\" fill=\"{}\"/>", path(points), hex(*color));
            }
            Item::Text { text, at, cap_mm, align, color, upwards } => {
                let strokes: String =
                    text_strokes(text, *at, *cap_mm, *align, *upwards).iter().map(|line| path(line)).collect();
                let _ = writeln!(
                    out,
                    "<g aria-label=\"{0}\"><title>{0}</title><path d=\"{strokes}\" fill=\"none\" stroke=\"{1}\" \
                     stroke-width=\"{2:.3}\" stroke-linecap=\"round\" stroke-linejoin=\"round\"/></g>",
                    escape(text),
                    hex(*color),
                    cap_mm * TEXT_PEN
                );
            }
            Item::Image { at, width_mm, height_mm, picture, photo } => {
                let (kind, bytes) =
                    if *photo { ("jpeg", super::jpeg(picture)?) } else { ("png", super::png(picture)?) };
                let _ = writeln!(
                    out,
                    "<image x=\"{}\" y=\"{}\" width=\"{width_mm}\" height=\"{height_mm}\" preserveAspectRatio=\"none\" \
                     href=\"data:image/{kind};base64,{}\"/>",
                    at[0],
                    at[1],
                    STANDARD.encode(bytes)
                );
            }
        }
    }
    Ok(out + "</svg>\n")
}

fn path(points: &[[f64; 2]]) -> String {
    let mut text = String::new();
    for (i, p) in points.iter().enumerate() {
        // A dot is a line without length; some programs draw its round caps only if it has some.
        let nudge = if i > 0 && points[i] == points[i - 1] { 0.08 } else { 0.0 };
        let _ = write!(text, "{}{:.3} {:.3}", if i == 0 { 'M' } else { 'L' }, p[0] + nudge, p[1]);
    }
    text
}

fn hex([r, g, b]: [u8; 3]) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::Picture;
    use crate::map::sheet::Align;

    #[test]
    fn millimetres_are_user_units() {
        let mut page = Page::new(297.0, 210.0);
        page.line(&[[10.0, 20.0], [110.0, 20.0]], 0.2, [1, 2, 3]);
        page.text("a < b", [10.0, 30.0], 3.0, Align::End, [0; 3]);
        let picture = Picture { width: 1, height: 1, rgba: vec![9, 9, 9, 255] };
        page.items.push(Item::Image { at: [1.0, 2.0], width_mm: 3.0, height_mm: 4.0, picture, photo: false });
        let text = svg(&page, "sheet").unwrap();
        assert!(text.contains("width=\"297mm\" height=\"210mm\" viewBox=\"0 0 297 210\""));
        assert!(text.contains("M10.000 20.000L110.000 20.000") && text.contains("#010203"));
        assert!(text.contains("a &lt; b") && text.contains("data:image/png;base64,"));
    }
}
