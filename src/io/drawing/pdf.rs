//! PDF of drawn pages: vectors in millimetres, rasters embedded, the same bytes for the same pages.
//!
//! Letters are strokes, so a sheet looks the same everywhere and needs no font; the same words lie invisibly over them as
//! text, so that they can be searched and copied.
//!
//! Reference: ISO 32000-1:2008, "Portable document format", sections 8 and 9.

use crate::map::sheet::{Align, Item, Page, TEXT_PEN, text_strokes, text_width_mm};
use flate2::{Compression, write::ZlibEncoder};
use pdf_writer::types::{LineCapStyle, LineJoinStyle, TextRenderingMode};
use pdf_writer::{Content, Filter, Finish, Name, Pdf, Rect, Ref, Str, TextStr};
use std::io::Write;

/// Points in a millimetre.
const PT: f64 = 72.0 / 25.4;
/// Height of Helvetica's capitals, and mean width of its letters, as shares of the font size.
const CAP_SHARE: f64 = 0.718;
const LETTER_SHARE: f64 = 0.53;

/// The pages as one PDF file.
///
/// # Errors
/// When a raster cannot be encoded.
pub fn pdf(pages: &[Page], title: &str) -> Result<Vec<u8>, image::ImageError> {
    let mut pdf = Pdf::new();
    let mut last = 0;
    let mut next = || {
        last += 1;
        Ref::new(last)
    };
    let (catalog, tree, info, font) = (next(), next(), next(), next());
    pdf.catalog(catalog).pages(tree);
    pdf.document_info(info).title(TextStr(title)).creator(TextStr("Adit"));
    pdf.type1_font(font).base_font(Name(b"Helvetica"));
    let ids: Vec<(Ref, Ref)> = pages.iter().map(|_| (next(), next())).collect();
    pdf.pages(tree).kids(ids.iter().map(|p| p.0)).count(pages.len() as i32);
    for (page, &(page_id, content_id)) in pages.iter().zip(&ids) {
        let images: Vec<Ref> = page.items.iter().filter(|i| matches!(i, Item::Image { .. })).map(|_| next()).collect();
        let names: Vec<Vec<u8>> = (0..images.len()).map(name).collect();
        let mut written = pdf.page(page_id);
        written.media_box(Rect::new(0.0, 0.0, (page.width_mm * PT) as f32, (page.height_mm * PT) as f32));
        written.parent(tree).contents(content_id);
        let mut resources = written.resources();
        resources.fonts().pair(Name(b"F"), font);
        let mut objects = resources.x_objects();
        for (image, name) in images.iter().zip(&names) {
            objects.pair(Name(name), *image);
        }
        objects.finish();
        resources.finish();
        written.finish();
        let content = deflate(&content(page, &names));
        pdf.stream(content_id, &content).filter(Filter::FlateDecode);
        let mut image = images.iter();
        for item in &page.items {
            let Item::Image { picture, photo, .. } = item else { continue };
            let Some(id) = image.next() else { continue };
            let (bytes, filter) = if *photo {
                (super::jpeg(picture)?, Filter::DctDecode)
            } else {
                (deflate(&super::on_paper(picture)), Filter::FlateDecode)
            };
            let mut object = pdf.image_xobject(*id, &bytes);
            object.filter(filter);
            object.width(picture.width as i32).height(picture.height as i32).bits_per_component(8);
            object.color_space().device_rgb();
        }
    }
    Ok(pdf.finish())
}

fn name(k: usize) -> Vec<u8> {
    format!("Im{k}").into_bytes()
}

fn deflate(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::new(6));
    encoder.write_all(bytes).and_then(|()| encoder.finish()).expect("writing to memory does not fail")
}

/// The drawing operators of a page.
fn content(page: &Page, names: &[Vec<u8>]) -> Vec<u8> {
    let mut c = Content::new();
    // Millimetres, y down.
    c.transform([PT as f32, 0.0, 0.0, -PT as f32, 0.0, (page.height_mm * PT) as f32]);
    c.set_line_cap(LineCapStyle::ButtCap).set_line_join(LineJoinStyle::RoundJoin);
    let mut names = names.iter();
    for item in &page.items {
        match item {
            Item::Line { points, width_mm, color, dash } => {
                stroke_color(&mut c, *color);
                c.set_line_width(*width_mm as f32).set_dash_pattern(dash.iter().map(|d| *d as f32), 0.0);
                polyline(&mut c, points);
                c.stroke();
            }
            Item::Area { points, color } => {
                let [r, g, b] = color.map(|x| f32::from(x) / 255.0);
                c.set_fill_rgb(r, g, b);
                polyline(&mut c, points);
                c.close_path().fill_nonzero();
            }
            Item::Text { text, at, cap_mm, align, color, upwards } => {
                stroke_color(&mut c, *color);
                c.set_line_cap(LineCapStyle::RoundCap);
                c.set_line_width((cap_mm * TEXT_PEN) as f32).set_dash_pattern([], 0.0);
                for line in text_strokes(text, *at, *cap_mm, *align, *upwards) {
                    polyline(&mut c, &line);
                }
                c.stroke().set_line_cap(LineCapStyle::ButtCap);
                invisible(&mut c, text, *at, *cap_mm, *align, *upwards);
            }
            Item::Image { at, width_mm, height_mm, .. } => {
                let Some(name) = names.next() else { continue };
                c.save_state();
                c.transform([*width_mm as f32, 0.0, 0.0, -*height_mm as f32, at[0] as f32, (at[1] + height_mm) as f32]);
                c.x_object(Name(name)).restore_state();
            }
        }
    }
    c.finish().to_vec()
}

fn stroke_color(c: &mut Content, color: [u8; 3]) {
    let [r, g, b] = color.map(|x| f32::from(x) / 255.0);
    c.set_stroke_rgb(r, g, b);
}

fn polyline(c: &mut Content, points: &[[f64; 2]]) {
    for (i, p) in points.iter().enumerate() {
        // A dot is a line without length; readers draw its round caps only if it has some.
        let nudge = if i > 0 && points[i] == points[i - 1] { 0.08 } else { 0.0 };
        let (x, y) = ((p[0] + nudge) as f32, p[1] as f32);
        if i == 0 {
            c.move_to(x, y)
        } else {
            c.line_to(x, y)
        };
    }
}

/// The text for searching and copying; stretched to the width of its strokes.
fn invisible(c: &mut Content, text: &str, at: [f64; 2], cap_mm: f64, align: Align, upwards: bool) {
    let latin: Vec<u8> = text.chars().map(|ch| u8::try_from(ch).unwrap_or(b'?')).collect();
    let width = text_width_mm(text, cap_mm);
    let size = cap_mm / CAP_SHARE;
    let shift = width
        * match align {
            Align::Start => 0.0,
            Align::Middle => 0.5,
            Align::End => 1.0,
        };
    let natural = size * LETTER_SHARE * latin.len().max(1) as f64;
    let matrix = if upwards {
        [0.0, -1.0, -1.0, 0.0, at[0], at[1] + shift]
    } else {
        [1.0, 0.0, 0.0, -1.0, at[0] - shift, at[1]]
    };
    c.begin_text()
        .set_font(Name(b"F"), size as f32)
        .set_text_rendering_mode(TextRenderingMode::Invisible)
        .set_horizontal_scaling((100.0 * width / natural) as f32)
        .set_text_matrix(matrix.map(|x| x as f32))
        .show(Str(&latin))
        .end_text();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::Picture;

    #[test]
    fn a_page_has_its_size_and_its_words() {
        let mut page = Page::new(420.0, 297.0);
        page.text("0+010 (m)", [20.0, 20.0], 3.0, Align::Start, [0; 3]);
        let picture = Picture { width: 2, height: 1, rgba: vec![255, 0, 0, 255, 0, 0, 0, 0] };
        page.items.push(Item::Image { at: [10.0, 10.0], width_mm: 20.0, height_mm: 10.0, picture, photo: true });
        let bytes = pdf(&[page.clone(), page.clone()], "two pages").unwrap();
        assert_eq!(bytes, pdf(&[page.clone(), page], "two pages").unwrap());
        let text = String::from_utf8_lossy(&bytes);
        assert!(text.starts_with("%PDF-") && text.contains("/Count 2") && text.contains("two pages"));
        assert!(text.contains("/MediaBox [0 0 1190.5"), "420 mm are 1190.55 points");
        assert_eq!(text.matches("/Subtype /Image").count(), 2);
    }
}
