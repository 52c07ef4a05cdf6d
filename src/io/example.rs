//! A map for tests of the files that hold it.

use super::MapFolder;
use crate::cloud::ScanFrame;
use crate::map::example::flat_chart;
use crate::map::{DrawInput, Settings, Summary, draw};
use std::path::Path;

/// Draws a wall of 13 m x 3.1 m into a folder; its offset grows by 2 cm a metre along the map and is 0 in the middle.
pub(super) fn draw_sloping_map(folder: &Path, settings: &Settings) -> Summary {
    let chart = flat_chart(13.0, 3.1, 30, 10);
    let section: Vec<f64> = chart.uv().iter().map(|p| 0.02 * (p.x - 6.5)).collect();
    let frame = ScanFrame::local();
    let input = DrawInput {
        chart: &chart,
        points: None,
        frame: &frame,
        section_offsets_m: Some(&section),
        design_offsets_m: None,
        quality: None,
    };
    draw(&input, settings, &mut MapFolder::new(folder).with_tiles(settings.tiles)).unwrap()
}
