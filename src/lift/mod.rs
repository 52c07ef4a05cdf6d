//! The way back: what was drawn on the map becomes labels on points and faces.
//!
//! [`recognise`] turns an edited picture into a [`LabelMap`] (which class is painted where), [`labels_of_points`] and
//! [`labels_of_faces`] carry it to the scan. Both use the chart coordinates of the same anchors that drew the map.
//! [`strokes()`] turns thin strokes into polylines on the map.

mod label_map;
mod paint;
mod strokes;

pub use label_map::{FaceLabels, LabelMap, NO_SURFACE, PointLabels, labels_of_faces, labels_of_points};
pub use paint::{Base, Edited, Recognised, recognise};
pub use strokes::{StrokeSettings, StrokeSummary, strokes};

/// Why a picture does not become labels.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// The picture has another shape than the map and nothing tells where it belongs.
    #[error(
        "the picture has {width} x {height} pixels, the map {map_width} x {map_height}: another shape. If it was cropped, \
         put a world file next to it; if it was stretched, bring it back to the shape of the map"
    )]
    Shape {
        /// Columns of the picture.
        width: usize,
        /// Rows of the picture.
        height: usize,
        /// Columns of the map.
        map_width: usize,
        /// Rows of the map.
        map_height: usize,
    },
    /// The picture is not an edited version of any picture of the map.
    #[error(
        "the picture does not look like any picture of this map ({percent:.0} % of its pixels agree with '{closest}'): \
         edit one of the pictures in the map folder of this run"
    )]
    NoBase {
        /// The picture of the map that is most like it.
        closest: String,
        /// Share of equal pixels, percent.
        percent: f64,
    },
    /// The picture is one of the map, but its colours were changed too much.
    #[error(
        "the picture is like '{closest}' of this map, but its colours differ by {difference:.0} of 255 throughout, as when a \
         program reduces them to a few: save it with full colours, or with a palette made for it"
    )]
    Noisy {
        /// The picture of the map that is most like it.
        closest: String,
        /// Median difference of the colours.
        difference: f64,
    },
    /// The palette of the picture shows two classes with one colour.
    #[error(
        "the palette of the picture shows '{one}' and '{other}' with the one colour {color}, so {ambiguous} painted pixels \
         could be either: save the picture with full colours"
    )]
    OneColor {
        /// The colour, as #rrggbb.
        color: String,
        /// A class.
        one: String,
        /// Another class.
        other: String,
        /// Painted pixels without a clear class.
        ambiguous: usize,
    },
    /// Too many painted pixels cannot be told.
    #[error(
        "{ambiguous} of {painted} painted pixels have colours between the classes, for example {color} at column \
         {column}, row {row}: paint with full, opaque colours (those of labels.json, or new ones) and save as PNG"
    )]
    Ambiguous {
        /// Painted pixels without a clear class.
        ambiguous: usize,
        /// Painted pixels.
        painted: usize,
        /// Colour of one of them, as #rrggbb.
        color: String,
        /// Its column.
        column: usize,
        /// Its row.
        row: usize,
    },
    /// A column does not have one value for each point.
    #[error("{found} offsets for {expected} points")]
    Length {
        /// Values given.
        found: usize,
        /// Values needed.
        expected: usize,
    },
}
