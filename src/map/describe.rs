//! The layers of a map before its pixels: which can be drawn, and what each of them holds and looks like.

use super::draw::DrawInput;
use super::layer::{Layer, LayerDescription, Look, NoData, Resampling, palette, surface_classes};
use super::samples::SampleType;
use super::{Ramp, Settings};
use crate::numeric::statistics;
use crate::segment::VertexQuality;
use crate::segment::quality::NOTHING_SEEN;
use crate::warning::Warning;

/// A 32-bit float holds every whole number up to this one.
const WHOLE_IN_F32: usize = 1 << 24;

/// The layers that can be drawn, sorted, without repetition; what cannot be drawn becomes a warning.
pub(super) fn wanted_layers(
    input: &DrawInput,
    settings: &Settings,
    has_points: bool,
    warnings: &mut Vec<Warning>,
) -> Vec<Layer> {
    let mut wanted = settings.layers.clone();
    wanted.sort_unstable();
    wanted.dedup();
    let attributes = input.points.filter(|_| has_points).map(|(cloud, _)| cloud.attributes());
    let colors = attributes.and_then(|a| a.colors.as_deref());
    let intensities = attributes.and_then(|a| a.intensities.as_deref());
    let mut leave_out = |layer: Layer, code: &str, message: &str| {
        if wanted.contains(&layer) {
            wanted.retain(|&l| l != layer);
            warnings.push(Warning::new(code, message));
        }
    };
    let no_color = match colors {
        None => Some("the scan has no colour, so map/color is not drawn"),
        Some(c) if c.iter().all(|x| *x == c[0]) => Some("all points have the same colour, so map/color is not drawn"),
        Some(_) => None,
    };
    if let Some(message) = no_color {
        leave_out(Layer::Color, "no-color", &format!("{message}; intensity and relief show the wall instead"));
    }
    let no_intensity = match intensities {
        None => Some("the scan has no intensity, so map/intensity is not drawn"),
        Some(i) if i.iter().all(|x| *x == i[0]) => {
            Some("all points have the same intensity, so map/intensity is not drawn")
        }
        Some(_) => None,
    };
    if let Some(message) = no_intensity {
        leave_out(Layer::Intensity, "no-intensity", message);
    }
    if input.design_offsets_m.is_none() {
        let message = "no map.design_profile is given, so map/design_offset is not drawn";
        leave_out(Layer::DesignOffset, "no-design-profile", message);
    }
    if input.quality.is_none() {
        for layer in [Layer::Classes, Layer::Noise, Layer::Density, Layer::Incidence] {
            let message = format!("there are no scan points, so map/{} is not drawn", layer.name());
            leave_out(layer, "no-quality", &message);
        }
    } else if input.quality.is_some_and(|q| q.incidence_deg.is_empty()) {
        let message = "no scanner station is known, so map/incidence is not drawn";
        leave_out(Layer::Incidence, "no-station", message);
    }
    if input.section_offsets_m.is_none() {
        let message = "the mean section is not known, so map/offset and map/relief are not drawn";
        leave_out(Layer::Offset, "no-mean-section", message);
        leave_out(Layer::Relief, "no-mean-section", message);
        leave_out(Layer::Roughness, "no-mean-section", "the mean section is not known, so map/roughness is not drawn");
    } else if no_color.is_some() && !wanted.contains(&Layer::Relief) {
        wanted.push(Layer::Relief);
    }
    wanted
}

/// The values of a quality layer at the vertices.
pub(super) fn quality_of(layer: Layer, quality: &VertexQuality) -> &[f32] {
    match layer {
        Layer::Noise => &quality.noise_m,
        Layer::Density => &quality.density_per_m2,
        _ => &quality.incidence_deg,
    }
}

/// The value that 95 % of the vertices stay below, on the series 1, 2, 5.
fn quality_range(layer: Layer, input: &DrawInput) -> f64 {
    let values = input.quality.map_or(&[][..], |q| quality_of(layer, q));
    let mut known: Vec<f64> = values.iter().map(|&v| f64::from(v)).filter(|v| v.is_finite()).collect();
    super::grid::next_in_series(statistics::quantile(&mut known, 0.95).unwrap_or(1.0).max(1e-4))
}

/// What writers and legends need to know about a layer.
pub(super) fn describe(
    layer: Layer,
    input: &DrawInput,
    offset_range_m: f64,
    stretch_range: f64,
    roughness_range_m: f64,
) -> LayerDescription {
    let attributes = input.points.map(|(cloud, _)| cloud.attributes());
    let labels = attributes.and_then(|a| a.labels.as_deref()).unwrap_or_default();
    let of = |sample, bands: &[&'static str], no_data, resampling, look, unit, meaning| LayerDescription {
        layer,
        sample,
        bands: bands.to_vec(),
        no_data,
        resampling,
        look,
        unit,
        meaning,
        band_offsets: vec![],
    };
    use {NoData as N, Resampling as R, SampleType as S};
    match layer {
        Layer::Color => of(
            S::U8,
            &["red", "green", "blue", "alpha"],
            N::Alpha,
            R::Mean,
            Look::Rgba,
            "",
            "colour of the scan, mean of the points near each pixel",
        ),
        Layer::Intensity => {
            let (low, high) = intensity_range(attributes.and_then(|a| a.intensities.as_deref()).unwrap_or_default());
            let look = Look::Grey { low, high };
            let meaning = "intensity of the scan, mean of the points near each pixel";
            of(S::U16, &["intensity"], N::Value(0.0), R::Mean, look, "", meaning)
        }
        Layer::Labels => {
            let mut seen: Vec<u32> = labels.to_vec();
            seen.sort_unstable();
            seen.dedup();
            let (sample, none) = match seen.last().copied().unwrap_or(0) {
                0..255 => (S::U8, f64::from(u8::MAX)),
                255..65_535 => (S::U16, f64::from(u16::MAX)),
                _ => (S::U32, f64::from(u32::MAX)),
            };
            let meaning = "label of the nearest scan point, 0 = unlabelled; see labels.json";
            of(sample, &["label"], N::Value(none), R::Nearest, Look::Labels(palette(seen)), "", meaning)
        }
        Layer::Offset => {
            let look = Look::Ramp { ramp: Ramp::Diverging, low: -offset_range_m, high: offset_range_m };
            let meaning = "distance of the surface from the local mean section, positive into the void";
            of(S::F32, &["offset"], N::Nan, R::Mean, look, "m", meaning)
        }
        Layer::DesignOffset => {
            let look = Look::Ramp { ramp: Ramp::Diverging, low: -offset_range_m, high: offset_range_m };
            let meaning = "distance of the surface from the design profile, positive where rock stands inside it";
            of(S::F32, &["design_offset"], N::Nan, R::Mean, look, "m", meaning)
        }
        Layer::Roughness => {
            let look = Look::Ramp { ramp: Ramp::Heat, low: 0.0, high: roughness_range_m };
            let meaning = "rms of the height over the plane that fits best in a window of map.roughness_window_m";
            of(S::F32, &["roughness"], N::Nan, R::Mean, look, "m", meaning)
        }
        Layer::Coverage => {
            let meaning = "0 no surface, 1 observed, 2 filled (interpolated)";
            of(S::U8, &["class"], N::Value(0.0), R::Nearest, Look::Coverage, "", meaning)
        }
        Layer::Distortion => {
            let look = Look::Stretch { ramp: Ramp::Heat, high: stretch_range };
            let meaning = "stretch of the map: s1 >= s2, area ratio, direction of s1 in degrees from the chainage axis";
            of(S::F32, &["s1", "s2", "area", "angle"], N::Nan, R::Nearest, look, "", meaning)
        }
        Layer::Relief => {
            let look = Look::Grey { low: 1.0, high: 255.0 };
            let meaning = "shaded relief of the offset from the mean section, lit from the upper left";
            of(S::U8, &["relief"], N::Value(0.0), R::Mean, look, "", meaning)
        }
        Layer::Classes => {
            let meaning = "what was seen first: 0 wall, 1 floor, 2 furniture that hides the wall, 255 nothing";
            of(
                S::U8,
                &["class"],
                N::Value(f64::from(NOTHING_SEEN)),
                R::Nearest,
                Look::Labels(surface_classes()),
                "",
                meaning,
            )
        }
        Layer::Noise | Layer::Density | Layer::Incidence => {
            let look = Look::Ramp { ramp: Ramp::Heat, low: 0.0, high: quality_range(layer, input) };
            let (unit, meaning) = match layer {
                Layer::Noise => ("m", "root mean square scatter of the points about their local plane"),
                Layer::Density => ("1/m2", "scan points on a square metre of the mean section"),
                _ => ("deg", "angle between the line of sight and the normal of the surface"),
            };
            of(S::F32, &[layer.name()], N::Nan, R::Mean, look, unit, meaning)
        }
        Layer::Xyz => {
            let meaning = "position on the surface in scan coordinates: sample + offset of the band";
            let mut d = of(S::F32, &["x", "y", "z"], N::Nan, R::Nearest, Look::None, "", meaning);
            d.band_offsets = input.frame.origin_in_scan.iter().copied().collect();
            d
        }
        Layer::SurfacePoint => {
            let bands = ["face", "barycentric_b", "barycentric_c"];
            let meaning = "face of chart.ply and weights of its second and third corner";
            let sample = surface_point_type(input.chart.strip().mesh().faces().len());
            of(sample, &bands, N::Value(-1.0), R::Nearest, Look::None, "", meaning)
        }
    }
}

/// The least type that tells all faces apart.
pub(super) fn surface_point_type(faces: usize) -> SampleType {
    if faces <= WHOLE_IN_F32 { SampleType::F32 } else { SampleType::F64 }
}

/// Black and white of the intensity picture: the 1 % and 99 % quantiles of the scan.
fn intensity_range(intensities: &[u16]) -> (f64, f64) {
    let step = (intensities.len() / 1_000_000).max(1);
    let mut some: Vec<f64> = intensities.iter().step_by(step).map(|&i| f64::from(i)).collect();
    let low = statistics::quantile(&mut some, 0.01).unwrap_or(0.0);
    let high = statistics::quantile(&mut some, 0.99).unwrap_or(65_535.0);
    if high > low { (low, high) } else { (0.0, 65_535.0) }
}
