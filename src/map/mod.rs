//! Drawing the flat map: rasters of every layer, tile by tile.
//!
//! [`draw`] walks over the grid in pieces, finds the surface point under every pixel, blends the values of the scan
//! points around it and hands each finished piece to a [`Sink`], which writes it; a map is never in memory as a whole.
//!
//! Conventions: u (chainage) to the right, v (girth from the crown) up, seen from inside. See `docs/methods/map.md`.

mod blend;
mod color_ramp;
mod distortion_plot;
mod describe;
mod design_profile;
mod draw;
mod grid;
mod layer;
mod legend;
mod overview;
pub mod qgis;
mod rasterize;
mod reference_lines;
mod relief;
mod roughness;
mod samples;
mod sampling;
pub mod sheet;
pub(crate) mod stroke_font;

#[cfg(test)]
pub(crate) mod example;

pub use blend::Support;
pub use color_ramp::{Ramp, label_color};
pub use design_profile::{DesignProfile, ProfileError};
pub use distortion_plot::distortion_histogram;
pub use draw::{DrawInput, MapPoints, Piece, PointsOnMap, Sink, SinkError, automatic_max_offset_m, draw, draw_points};
pub use grid::{Grid, PixelRect, Placement, TILE_PX, automatic_cell_m};
pub use layer::{
    COVERAGE_FILLED, COVERAGE_NONE, COVERAGE_OBSERVED, FILLED_COLOR, Layer, LayerDescription, Look, NoData,
    OBSERVED_COLOR, PaletteEntry, Resampling, UNLABELLED_COLOR, color_distance, palette,
};
pub use legend::{Legend, LegendLayer, Swatch};
pub use overview::{Picture, chainage_label, overview};
pub use rasterize::{FaceIndex, NO_FACE, SurfaceTile};
pub use reference_lines::{Feet, LineKind, ReferenceLine, reference_lines};
pub use samples::{Block, Sample, SampleType, Samples};

use crate::warning::Warning;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// How the map is drawn.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Side of a pixel in metres. Automatic: a little finer than the point spacing, on the series 1, 2, 5, 10 mm ...,
    /// and at most 60 million pixels.
    pub cell_m: Option<f64>,
    /// Colours and labels are interpolated over gaps up to this distance (metres) from the nearest scan point;
    /// pixels farther away stay empty. Automatic: four point spacings in each direction, 0.05 to 1 m.
    pub fill_m: Option<f64>,
    /// Scan points farther from the surface than this (metres: pipes, cables, people) do not colour the wall.
    /// Automatic: five times the 90 % quantile of all distances, 0.1 to 0.3 m.
    pub max_offset_m: Option<f64>,
    /// The layers to draw. `relief` is added when the scan has no colour.
    pub layers: Vec<Layer>,
    /// Whether to write web tiles (`map/tiles/<layer>/<z>/<x>/<y>.png`) and a viewer, `map/tiles/index.html`.
    pub tiles: bool,
    /// The outline that the tunnel should have, for the layer `design_offset`: a CSV file of `right_m,up_m`, corners of a
    /// closed polygon around the axis.
    pub design_profile: Option<PathBuf>,
    /// Width of the window of the layer `roughness`, metres: what is larger counts as shape.
    pub roughness_window_m: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            cell_m: None,
            fill_m: None,
            max_offset_m: None,
            layers: vec![
                Layer::Color,
                Layer::Intensity,
                Layer::Labels,
                Layer::Offset,
                Layer::Coverage,
                Layer::Distortion,
            ],
            tiles: false,
            design_profile: None,
            roughness_window_m: 0.5,
        }
    }
}

/// Why a map could not be drawn.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The pixel size is not a positive number.
    #[error("a pixel of {cell_m} m cannot be drawn; set map.cell_m to a positive number such as 0.005")]
    Cell {
        /// The size asked for.
        cell_m: f64,
    },
    /// The window of the roughness is not a positive number.
    #[error(
        "a roughness cannot be measured in windows of {window_m} m; set map.roughness_window_m to a positive number such as 0.5"
    )]
    Window {
        /// The width asked for.
        window_m: f64,
    },
    /// The design profile cannot be used.
    #[error(transparent)]
    Profile(#[from] ProfileError),
    /// The grid has too many pixels.
    #[error("a map of {extent_u_m:.1} x {extent_v_m:.1} m has too many pixels of {cell_m} m; set a larger map.cell_m")]
    GridTooLarge {
        /// Pixel size in metres.
        cell_m: f64,
        /// Length of the map in metres.
        extent_u_m: f64,
        /// Height of the map in metres.
        extent_v_m: f64,
    },
    /// A column does not have one value for each point or vertex.
    #[error("{column} has {found} values, expected {expected}")]
    Length {
        /// Which column.
        column: &'static str,
        /// Values given.
        found: usize,
        /// Values needed.
        expected: usize,
    },
    /// The writer failed.
    #[error("the map could not be written")]
    Sink(#[source] Box<dyn std::error::Error + Send + Sync>),
}

/// What was drawn.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Side of a pixel, metres.
    pub cell_m: f64,
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Left edge: chainage in metres.
    pub u_min_m: f64,
    /// Top edge: girth in metres.
    pub v_max_m: f64,
    /// Typical point spacing along the tunnel and around it, metres, if there are points.
    pub point_spacing_m: Option<[f64; 2]>,
    /// Half axes of the ellipse over which gaps are interpolated, metres.
    pub fill_m: [f64; 2],
    /// Scan points farther from the surface than this do not colour it, metres.
    pub max_offset_m: f64,
    /// Points that coloured the map.
    pub points_used: usize,
    /// Points left out because they are too far from the surface.
    pub points_off_surface: usize,
    /// Points that have no place on the surface.
    pub points_unanchored: usize,
    /// Pixels on observed surface.
    pub observed_px: usize,
    /// Pixels on filled surface.
    pub filled_px: usize,
    /// Pixels with surface but without colour, because no scan point is near.
    pub empty_px: usize,
    /// Observed share of the area inside the outline of the map, holes included, percent.
    pub coverage_percent: f64,
    /// The layers drawn.
    pub layers: Vec<Layer>,
    /// Half range of the colours of the offset picture, metres.
    pub offset_range_m: f64,
    /// Stretch at the last colour of the distortion picture.
    pub stretch_range: f64,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}
