//! The layers of a map: their names, pixel types, NoData values and how they look as a picture.

use super::color_ramp::{Ramp, label_color};
use super::samples::{SampleType, Samples};
use crate::cloud::Label;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What a layer shows. The name is the name of its files: `map/<layer>.png` and `map/<layer>.tif`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Layer {
    /// Colour of the scan, blended from all points near a pixel (red, green, blue, alpha).
    Color,
    /// Intensity of the scan, blended likewise (16 bit, 0 = NoData).
    Intensity,
    /// Label of the nearest scan point, never mixed.
    Labels,
    /// Signed distance from the local mean section in metres, positive into the void.
    Offset,
    /// Where the map is observed (1), filled (2), or has no surface (0).
    Coverage,
    /// Stretch of the map: singular values s1 and s2 of surface -> chart, area ratio, direction of greatest stretch.
    Distortion,
    /// Shaded relief of the offset, lit from the upper left.
    Relief,
    /// What was seen at a place first: wall, floor, or furniture that hides it.
    Classes,
    /// Scatter of the points about their local plane in metres.
    Noise,
    /// Scan points a square metre.
    Density,
    /// Angle between the line of sight and the normal in degrees; only when the scanner stations are known.
    Incidence,
    /// Position of each pixel on the surface in scan coordinates (offset of each band in the metadata).
    Xyz,
    /// Face and barycentric weights (second and third corner) of each pixel in `chart.ply`.
    SurfacePoint,
    /// Signed distance from the design profile in metres, positive where rock stands inside it.
    DesignOffset,
    /// Root mean square of the height over the plane that fits best in a window, metres.
    Roughness,
}

impl Layer {
    /// File name without extension.
    pub fn name(self) -> &'static str {
        match self {
            Layer::Color => "color",
            Layer::Intensity => "intensity",
            Layer::Labels => "labels",
            Layer::Offset => "offset",
            Layer::Coverage => "coverage",
            Layer::Distortion => "distortion",
            Layer::Relief => "relief",
            Layer::Classes => "classes",
            Layer::Noise => "noise",
            Layer::Density => "density",
            Layer::Incidence => "incidence",
            Layer::Xyz => "xyz",
            Layer::SurfacePoint => "surface_point",
            Layer::DesignOffset => "design_offset",
            Layer::Roughness => "roughness",
        }
    }
}

/// A value that stands for "nothing here".
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoData {
    /// This value in every band.
    Value(f64),
    /// Not a number.
    Nan,
    /// The last band is alpha: 0 where there is nothing.
    Alpha,
}

impl NoData {
    /// The value of a sample where there is nothing.
    pub fn value(self) -> f64 {
        match self {
            NoData::Value(x) => x,
            NoData::Nan => f64::NAN,
            NoData::Alpha => 0.0,
        }
    }

    /// Whether the value of a sample (not of an alpha band) means that there is something.
    pub fn is_data(self, value: f64) -> bool {
        match self {
            NoData::Value(none) => value != none,
            NoData::Nan => !value.is_nan(),
            NoData::Alpha => true,
        }
    }
}

/// How coarser versions of a layer are made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Resampling {
    /// Take one of the pixels.
    Nearest,
    /// Take the mean of the pixels that hold something.
    Mean,
}

/// How a layer looks as a picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Look {
    /// The samples are red, green, blue, alpha.
    Rgba,
    /// Grey from black at `low` to white at `high` (NoData transparent).
    Grey {
        /// Black.
        low: f64,
        /// White.
        high: f64,
    },
    /// The first band (or the given one) through a colour ramp.
    Ramp {
        /// Colours.
        ramp: Ramp,
        /// Value of the first colour.
        low: f64,
        /// Value of the last colour.
        high: f64,
    },
    /// Greatest stretch, max(s1, 1/s2), of the first two bands through a colour ramp.
    Stretch {
        /// Colours.
        ramp: Ramp,
        /// Value of the last colour; the first is 1.
        high: f64,
    },
    /// One colour for each label.
    Labels(Vec<PaletteEntry>),
    /// Colours of the coverage classes.
    Coverage,
    /// Not made to be looked at: no picture.
    None,
}

/// A class of the label map: what `map/labels.json` tells about it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PaletteEntry {
    /// The label; 0 is unlabelled surface.
    pub value: Label,
    /// Name for people.
    pub name: String,
    /// Red, green, blue in the picture.
    pub color: [u8; 3],
}

/// Everything a writer needs to know about a layer before its pixels come.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerDescription {
    /// Which layer.
    pub layer: Layer,
    /// Type of its samples.
    pub sample: SampleType,
    /// Names of its bands, in order.
    pub bands: Vec<&'static str>,
    /// Value for "nothing here".
    pub no_data: NoData,
    /// For coarser versions.
    pub resampling: Resampling,
    /// As a picture.
    pub look: Look,
    /// Unit of the values, empty if they have none.
    pub unit: &'static str,
    /// One sentence for people.
    pub meaning: &'static str,
    /// Number to be added to the samples of each band (empty: none).
    pub band_offsets: Vec<f64>,
}

/// Coverage class: no surface.
pub const COVERAGE_NONE: u8 = 0;
/// Coverage class: surface with scan points as near as the sampling lets expect.
pub const COVERAGE_OBSERVED: u8 = 1;
/// Coverage class: interpolated surface or colour.
pub const COVERAGE_FILLED: u8 = 2;

/// Colour of unlabelled surface.
pub const UNLABELLED_COLOR: [u8; 3] = [238, 236, 230];
/// Colour of observed surface in the coverage picture.
pub const OBSERVED_COLOR: [u8; 3] = [116, 173, 145];
/// Colour of filled surface in the coverage picture.
pub const FILLED_COLOR: [u8; 3] = [244, 176, 66];

impl LayerDescription {
    /// The picture of some samples of this layer: red, green, blue, alpha of each pixel. Empty for [`Look::None`].
    pub fn picture(&self, samples: &Samples) -> Vec<[u8; 4]> {
        self.look.picture(samples, self.bands.len(), self.no_data)
    }
}

impl Look {
    /// The picture of samples with so many bands: red, green, blue, alpha of each pixel. Empty for [`Look::None`].
    pub fn picture(&self, samples: &Samples, bands: usize, no_data: NoData) -> Vec<[u8; 4]> {
        let pixels = samples.len() / bands;
        let opaque = |[r, g, b]: [u8; 3]| [r, g, b, 255];
        let transparent = [0; 4];
        let is_data = |x: f64| no_data.is_data(x);
        match self {
            Look::None => Vec::new(),
            Look::Rgba => match samples {
                Samples::U8(v) => v.as_chunks::<4>().0.to_vec(),
                _ => Vec::new(),
            },
            Look::Grey { low, high } => (0..pixels)
                .map(|i| {
                    let x = samples.get(i * bands);
                    if !is_data(x) {
                        return transparent;
                    }
                    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
                    opaque([(t * 255.0 + 0.5) as u8; 3])
                })
                .collect(),
            Look::Ramp { ramp, low, high } => (0..pixels)
                .map(|i| {
                    let x = samples.get(i * bands);
                    if is_data(x) { opaque(ramp.color((x - low) / (high - low))) } else { transparent }
                })
                .collect(),
            Look::Stretch { ramp, high } => (0..pixels)
                .map(|i| {
                    let (s1, s2) = (samples.get(i * bands), samples.get(i * bands + 1));
                    if s1.is_nan() {
                        return transparent;
                    }
                    // A flipped or collapsed face (s2 <= 0) is as bad as it gets.
                    let stretch = if s2 > 0.0 { s1.max(1.0 / s2) } else { f64::INFINITY };
                    opaque(ramp.color((stretch - 1.0) / (high - 1.0)))
                })
                .collect(),
            Look::Labels(palette) => (0..pixels)
                .map(|i| {
                    let x = samples.get(i * bands);
                    if !is_data(x) {
                        return transparent;
                    }
                    let value = x as Label;
                    let found = palette.binary_search_by_key(&value, |e| e.value);
                    opaque(found.map_or_else(|_| label_color(value), |k| palette[k].color))
                })
                .collect(),
            Look::Coverage => (0..pixels)
                .map(|i| match samples.get(i * bands) as u8 {
                    COVERAGE_OBSERVED => opaque(OBSERVED_COLOR),
                    COVERAGE_FILLED => opaque(FILLED_COLOR),
                    _ => transparent,
                })
                .collect(),
        }
    }
}

/// The classes of [`Layer::Classes`] with their colours.
pub fn surface_classes() -> Vec<PaletteEntry> {
    [("wall", [176, 166, 150]), ("floor", [120, 149, 178]), ("furniture", [222, 118, 62])]
        .into_iter()
        .enumerate()
        .map(|(value, (name, color))| PaletteEntry { value: value as Label, name: name.into(), color })
        .collect()
}

/// Squared distance of two colours.
pub fn color_distance(a: [u8; 3], b: [u8; 3]) -> i32 {
    (0..3).map(|k| (i32::from(a[k]) - i32::from(b[k])).pow(2)).sum()
}

/// The classes of a set of labels (sorted, unique): unlabelled surface first, then each label with its colour.
pub fn palette(labels: impl IntoIterator<Item = Label>) -> Vec<PaletteEntry> {
    let mut values: Vec<Label> = labels.into_iter().filter(|&l| l != 0).collect();
    values.sort_unstable();
    values.dedup();
    let unlabelled = PaletteEntry { value: 0, name: "unlabelled".into(), color: UNLABELLED_COLOR };
    let mut entries = vec![unlabelled];
    for value in values {
        // Classes are told apart by colour on the way back, even after JPEG: later candidates walk round the colour
        // circle until one is far from all colours so far. With very many classes "different" has to do.
        let mut wanted = if entries.len() < 200 { 1200 } else { 1 };
        let mut attempt = 0;
        let color = loop {
            let candidate = label_color(value.wrapping_add(131 * attempt));
            let nearest = entries.iter().map(|e| color_distance(e.color, candidate)).min().unwrap_or(i32::MAX);
            if nearest >= wanted {
                break candidate;
            }
            attempt += 1;
            if attempt % 32 == 0 {
                wanted = (wanted / 2).max(1);
            }
        };
        entries.push(PaletteEntry { value, name: format!("label {value}"), color });
    }
    entries
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn palette_colors_are_distinct() {
        let entries = palette((0..2000).rev());
        assert_eq!(entries.len(), 2000);
        let colors: std::collections::BTreeSet<_> = entries.iter().map(|e| e.color).collect();
        assert_eq!(colors.len(), 2000);
        assert!(entries.windows(2).all(|w| w[0].value < w[1].value));
        let few = palette(0..40);
        for (i, a) in few.iter().enumerate() {
            assert!(few[..i].iter().all(|b| color_distance(a.color, b.color) >= 300), "{a:?}");
        }
    }

    #[test]
    fn no_data_is_transparent() {
        let mut description = LayerDescription {
            layer: Layer::Intensity,
            sample: SampleType::U16,
            bands: vec!["intensity"],
            no_data: NoData::Value(0.0),
            resampling: Resampling::Mean,
            look: Look::Grey { low: 0.0, high: 100.0 },
            unit: "",
            meaning: "",
            band_offsets: vec![],
        };
        let picture = description.picture(&Samples::U16(vec![0, 50, 200]));
        assert_eq!(picture, [[0, 0, 0, 0], [128, 128, 128, 255], [255, 255, 255, 255]]);
        description.look = Look::Ramp { ramp: Ramp::Diverging, low: -1.0, high: 1.0 };
        description.no_data = NoData::Nan;
        let picture = description.picture(&Samples::F32(vec![f32::NAN, 0.0]));
        assert_eq!(picture[0][3], 0);
        assert!(picture[1].iter().all(|&c| c > 220));
    }
}
