//! A printed page as a list of lines, areas, texts and pictures in millimetres, whatever file it becomes.

use crate::map::Picture;
use crate::map::stroke_font;

pub use crate::map::stroke_font::Align;

/// Height of the letters of the stroke font over its line width.
pub const TEXT_PEN: f64 = 0.11;

/// One page; millimetres from its upper left corner, y down.
#[derive(Clone, Debug)]
pub struct Page {
    /// Width, millimetres.
    pub width_mm: f64,
    /// Height, millimetres.
    pub height_mm: f64,
    /// What is drawn, in this order.
    pub items: Vec<Item>,
}

/// Something on a page.
#[derive(Clone, Debug)]
pub enum Item {
    /// A polyline.
    Line {
        /// Its vertices.
        points: Vec<[f64; 2]>,
        /// Width, millimetres.
        width_mm: f64,
        /// Red, green, blue.
        color: [u8; 3],
        /// Lengths of dashes and gaps, millimetres; empty: solid.
        dash: Vec<f64>,
    },
    /// A filled polygon.
    Area {
        /// Its corners.
        points: Vec<[f64; 2]>,
        /// Red, green, blue.
        color: [u8; 3],
    },
    /// A line of text.
    Text {
        /// The text.
        text: String,
        /// A point of the baseline.
        at: [f64; 2],
        /// Height of capitals, millimetres.
        cap_mm: f64,
        /// Where the text sits relative to `at`.
        align: Align,
        /// Red, green, blue.
        color: [u8; 3],
        /// Whether it reads upwards.
        upwards: bool,
    },
    /// A picture.
    Image {
        /// Upper left corner.
        at: [f64; 2],
        /// Width, millimetres.
        width_mm: f64,
        /// Height, millimetres.
        height_mm: f64,
        /// The pixels; transparent ones show the paper.
        picture: Picture,
        /// Whether losses of a photograph's compression may be accepted.
        photo: bool,
    },
}

impl Page {
    /// An empty page.
    pub fn new(width_mm: f64, height_mm: f64) -> Self {
        Self { width_mm, height_mm, items: Vec::new() }
    }

    /// Adds a solid line.
    pub fn line(&mut self, points: &[[f64; 2]], width_mm: f64, color: [u8; 3]) {
        self.items.push(Item::Line { points: points.to_vec(), width_mm, color, dash: vec![] });
    }

    /// Adds the outline of a rectangle.
    pub fn frame(&mut self, x: f64, y: f64, width: f64, height: f64, pen_mm: f64, color: [u8; 3]) {
        self.line(&[[x, y], [x + width, y], [x + width, y + height], [x, y + height], [x, y]], pen_mm, color);
    }

    /// Adds a filled rectangle.
    pub fn area(&mut self, x: f64, y: f64, width: f64, height: f64, color: [u8; 3]) {
        let points = vec![[x, y], [x + width, y], [x + width, y + height], [x, y + height]];
        self.items.push(Item::Area { points, color });
    }

    /// Adds a text that reads to the right.
    pub fn text(&mut self, text: &str, at: [f64; 2], cap_mm: f64, align: Align, color: [u8; 3]) {
        self.items.push(Item::Text { text: text.to_owned(), at, cap_mm, align, color, upwards: false });
    }
}

/// Width of a text in millimetres.
pub fn text_width_mm(text: &str, cap_mm: f64) -> f64 {
    stroke_font::text_width(text, cap_mm)
}

/// The strokes of a text in page millimetres.
pub fn text_strokes(text: &str, at: [f64; 2], cap_mm: f64, align: Align, upwards: bool) -> Vec<Vec<[f64; 2]>> {
    let shift = text_width_mm(text, cap_mm)
        * match align {
            Align::Start => 0.0,
            Align::Middle => 0.5,
            Align::End => 1.0,
        };
    let place = |x: f64, y: f64| {
        let (along, above) = (x * cap_mm - shift, y * cap_mm);
        if upwards { [at[0] - above, at[1] - along] } else { [at[0] + along, at[1] - above] }
    };
    stroke_font::polylines(text).into_iter().map(|line| line.iter().map(|p| place(p.x, p.y)).collect()).collect()
}
