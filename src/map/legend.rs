//! The legend of a map: what each layer shows, with which colours, so that pictures can be read and made again.

use super::Grid;
use super::color_ramp::Ramp;
use super::layer::{FILLED_COLOR, Layer, LayerDescription, Look, NoData, OBSERVED_COLOR};
use serde::{Deserialize, Serialize};

/// Values of a ramp that are shown with their colour.
const RAMP_STEPS: usize = 9;

/// What `map/legend.json` holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Legend {
    /// How the map is to be read.
    pub view: String,
    /// Side of a pixel of the rasters, metres.
    pub cell_m: f64,
    /// Chainage of the left edge, metres.
    pub u_min_m: f64,
    /// Girth of the top edge, metres.
    pub v_max_m: f64,
    /// Columns of the rasters.
    pub width_px: usize,
    /// Rows of the rasters.
    pub height_px: usize,
    /// The layers, in the order of their names in the settings.
    pub layers: Vec<LegendLayer>,
}

/// One layer in the legend.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LegendLayer {
    /// Which.
    pub layer: Layer,
    /// What it shows.
    pub meaning: String,
    /// Unit of the values; empty if they have none.
    pub unit: String,
    /// Names of the bands.
    pub bands: Vec<String>,
    /// Added to the samples of each band (empty: nothing).
    pub band_offsets: Vec<f64>,
    /// The value for "nothing here".
    pub no_data: NoData,
    /// How values become colours.
    pub look: Look,
    /// Colours with the values they stand for.
    pub swatches: Vec<Swatch>,
}

/// A colour and what it stands for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Swatch {
    /// In words or numbers.
    pub label: String,
    /// Red, green, blue.
    pub color: [u8; 3],
}

impl Legend {
    /// The legend of layers that are drawn on a grid.
    pub fn of(grid: &Grid, layers: &[LayerDescription]) -> Self {
        Self {
            view: "seen from inside, facing increasing chainage; chainage to the right, girth from the crown up".into(),
            cell_m: grid.cell_m(),
            u_min_m: grid.u_min(),
            v_max_m: grid.v_max(),
            width_px: grid.width(),
            height_px: grid.height(),
            layers: layers.iter().map(entry).collect(),
        }
    }

    /// The entry of a layer, if it was drawn.
    pub fn layer(&self, layer: Layer) -> Option<&LegendLayer> {
        self.layers.iter().find(|l| l.layer == layer)
    }
}

fn entry(description: &LayerDescription) -> LegendLayer {
    LegendLayer {
        layer: description.layer,
        meaning: description.meaning.to_owned(),
        unit: description.unit.to_owned(),
        bands: description.bands.iter().map(|b| (*b).to_owned()).collect(),
        band_offsets: description.band_offsets.clone(),
        no_data: description.no_data,
        look: description.look.clone(),
        swatches: swatches(&description.look, description.unit),
    }
}

fn swatches(look: &Look, unit: &str) -> Vec<Swatch> {
    let number = |x: f64| {
        let rounded = (x * 1e4).round() / 1e4;
        if unit.is_empty() { format!("{rounded}") } else { format!("{rounded} {unit}") }
    };
    let ramp = |low: f64, high: f64, color: &dyn Fn(f64) -> [u8; 3]| {
        let step = |i: usize| i as f64 / (RAMP_STEPS - 1) as f64;
        (0..RAMP_STEPS)
            .map(|i| Swatch { label: number(low + (high - low) * step(i)), color: color(step(i)) })
            .collect::<Vec<_>>()
    };
    let of_ramp = |colors: Ramp| move |t: f64| colors.color(t);
    match look {
        Look::Rgba | Look::None => vec![],
        Look::Grey { low, high } => ramp(*low, *high, &|t| [(t * 255.0).round() as u8; 3]),
        Look::Ramp { ramp: colors, low, high } => ramp(*low, *high, &of_ramp(*colors)),
        Look::Stretch { ramp: colors, high } => ramp(1.0, *high, &of_ramp(*colors)),
        Look::Labels(classes) => {
            classes.iter().map(|c| Swatch { label: format!("{} {}", c.value, c.name), color: c.color }).collect()
        }
        Look::Coverage => vec![
            Swatch { label: "observed".into(), color: OBSERVED_COLOR },
            Swatch { label: "filled".into(), color: FILLED_COLOR },
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ramps_show_their_ends_and_their_unit() {
        let shown = swatches(&Look::Ramp { ramp: Ramp::Diverging, low: -0.2, high: 0.2 }, "m");
        assert_eq!((shown.len(), shown[0].label.as_str(), shown[8].label.as_str()), (9, "-0.2 m", "0.2 m"));
        assert_eq!((shown[4].label.as_str(), shown[4].color), ("0 m", Ramp::Diverging.color(0.5)));
        assert!(swatches(&Look::None, "").is_empty());
    }
}
