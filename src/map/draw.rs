//! The walk over the map: piece by piece, all layers of a piece together.

use super::blend::{self, BlendedTile, Reach, Scatter, Support, Wanted};
use super::describe::{describe, quality_of, surface_point_type, wanted_layers};
use super::layer::{COVERAGE_FILLED, COVERAGE_NONE, COVERAGE_OBSERVED, Layer, LayerDescription};
use super::rasterize::{FaceIndex, NO_FACE, SurfaceTile};
use super::samples::{SampleType, Samples};
use super::sampling::{ScatterIndex, Spacing};
use super::{Error, Grid, PixelRect, Settings, Summary, automatic_cell_m, relief, roughness};
use crate::cloud::{Cloud, ScanFrame};
use crate::numeric::{Vec2, statistics};
use crate::segment::VertexQuality;
use crate::segment::quality::NOTHING_SEEN;
use crate::unwrap::{Chart, distortion};
use crate::warning::Warning;
use rayon::prelude::*;

/// Pieces computed at the same time; bounds the memory, whatever the number of threads.
const PIECES_AT_ONCE: usize = 4;
/// Automatic limit of the distance from the surface: this many times the 90 % quantile, within bounds in metres.
const OFFSET_LIMIT: f64 = 5.0;
const OFFSET_LIMIT_BOUNDS_M: (f64, f64) = (0.1, 0.3);
/// Steps of the offset layer, metres: far below any scanner's noise, and it lets the file be compressed.
const OFFSET_STEP_M: f64 = 1.0 / 8192.0;
/// Steps of the roughness layer, metres.
const ROUGHNESS_STEP_M: f64 = 1.0 / 131_072.0;
/// Steps of the weights in the layer of surface points: under a tenth of a micrometre on any face, and less to store.
const WEIGHT_STEP: f64 = 1.0 / 4_194_304.0;
/// Steps of the positions, scan units: what lies near the origin needs no more digits than the rest.
const POSITION_STEP: f64 = 1.0 / 262_144.0;
/// Pixel size of charts without scan points, as a share of the mean edge length.
const CELL_PER_EDGE: f64 = 0.25;

/// Where the points of a cloud lie on the map.
#[derive(Clone, Copy, Debug)]
pub struct PointsOnMap<'a> {
    /// Chart coordinates of each point; NaN for a point that has no place on the surface.
    pub uv: &'a [Vec2],
    /// Signed distance of each point from the surface in metres.
    pub offsets_m: &'a [f64],
}

/// What a map is drawn from.
#[derive(Clone, Copy, Debug)]
pub struct DrawInput<'a> {
    /// The flattened surface.
    pub chart: &'a Chart,
    /// The scan and the place of its points on the chart, unless the map is made from a mesh alone.
    pub points: Option<(&'a Cloud, PointsOnMap<'a>)>,
    /// Frame of the scan coordinates (for [`Layer::Xyz`]).
    pub frame: &'a ScanFrame,
    /// Signed distance of each vertex of the chart from the local mean section in metres, positive into the void.
    /// Needed by the layers offset and relief.
    pub section_offsets_m: Option<&'a [f64]>,
    /// Signed distance of each vertex of the chart from the design profile in metres, positive inside it.
    pub design_offsets_m: Option<&'a [f64]>,
    /// How well the surface was measured at each vertex of the chart. Needed by classes, noise, density, incidence.
    pub quality: Option<&'a VertexQuality>,
}

/// A finished piece of the map: one column of samples for each layer, in the order of the descriptions.
#[derive(Debug)]
pub struct Piece {
    /// Where. Aligned to tiles of [`super::TILE_PX`] pixels.
    pub rect: PixelRect,
    /// Samples of each layer.
    pub layers: Vec<Samples>,
}

/// Takes the pieces of a map: rows of pieces from the top, each row from left to right.
pub trait Sink {
    /// Called once before the first piece.
    ///
    /// # Errors
    /// Whatever keeps the sink from taking pieces.
    fn begin(&mut self, grid: &Grid, layers: &[LayerDescription]) -> Result<(), SinkError>;

    /// Takes the next pieces, in order, all of one row of pieces.
    ///
    /// # Errors
    /// Whatever keeps the sink from taking them.
    fn take(&mut self, pieces: Vec<Piece>) -> Result<(), SinkError>;

    /// Called once after the last piece.
    ///
    /// # Errors
    /// Whatever keeps the sink from finishing.
    fn finish(&mut self) -> Result<(), SinkError>;
}

/// What a [`Sink`] failed with.
pub type SinkError = Box<dyn std::error::Error + Send + Sync>;

/// The scan points that colour maps: sorted once for all maps that are drawn of a chart.
pub struct MapPoints {
    /// `None` without points on the surface.
    scatter: Option<Scatter>,
    max_offset_m: f64,
    off_surface: usize,
    unanchored: usize,
}

impl MapPoints {
    /// Sorts the points of the input with the attributes that the layers of the settings show.
    ///
    /// # Errors
    /// [`Error::Length`] for columns that do not fit.
    pub fn of(input: &DrawInput, settings: &Settings) -> Result<Self, Error> {
        let Some((cloud, points)) = input.points else {
            let max_offset_m = settings.max_offset_m.unwrap_or(OFFSET_LIMIT_BOUNDS_M.1);
            return Ok(Self { scatter: None, max_offset_m, off_surface: 0, unanchored: 0 });
        };
        for (column, found) in [("the place on the map", points.uv.len()), ("the offset", points.offsets_m.len())] {
            if found != cloud.len() {
                return Err(Error::Length { column, found, expected: cloud.len() });
            }
        }
        let max_offset_m = settings.max_offset_m.unwrap_or_else(|| automatic_max_offset_m(points.offsets_m));
        let (mut off_surface, mut unanchored) = (0, 0);
        for (uv, offset) in points.uv.iter().zip(points.offsets_m) {
            if !(uv.x.is_finite() && uv.y.is_finite()) {
                unanchored += 1;
            } else if !is_on_surface(*offset, max_offset_m) {
                off_surface += 1;
            }
        }
        let index = ScatterIndex::new(points.uv, |i| is_on_surface(points.offsets_m[i], max_offset_m));
        let scatter = Spacing::measure(&index)
            .map(|spacing| Scatter::new(index, spacing, cloud, attributes_of(&settings.layers)));
        Ok(Self { scatter, max_offset_m, off_surface, unanchored })
    }
}

/// The attributes of points that layers show.
fn attributes_of(layers: &[Layer]) -> Wanted {
    let has = |layer| layers.contains(&layer);
    Wanted { colors: has(Layer::Color), intensities: has(Layer::Intensity), labels: has(Layer::Labels) }
}

/// Draws the layers of the settings over the whole chart and hands them to `sink` piece by piece.
///
/// Layers that the input cannot give (colour of a scan without colour) are left out with a warning.
///
/// # Errors
/// [`Error::Cell`], [`Error::GridTooLarge`] and [`Error::Length`] for input that does not fit, [`Error::Sink`] when
/// the writer fails.
pub fn draw(input: &DrawInput, settings: &Settings, sink: &mut dyn Sink) -> Result<Summary, Error> {
    draw_points(input, &MapPoints::of(input, settings)?, settings, sink)
}

/// As [`draw`], with points that are sorted already: those of the same input, with the attributes of all layers. Which of them
/// lie on the surface was decided then, so `max_offset_m` of these settings does not count.
///
/// # Errors
/// As [`draw`].
pub fn draw_points(
    input: &DrawInput,
    points: &MapPoints,
    settings: &Settings,
    sink: &mut dyn Sink,
) -> Result<Summary, Error> {
    let plan = Plan::new(input, points, settings)?;
    sink.begin(&plan.grid, &plan.layers).map_err(Error::Sink)?;
    let mut counts = Counts::default();
    for row in plan.grid.work_rows() {
        for rects in row.chunks(PIECES_AT_ONCE) {
            let drawn: Vec<(Piece, Counts)> = rects.par_iter().map(|&rect| plan.draw_piece(rect)).collect();
            let mut pieces = Vec::with_capacity(drawn.len());
            for (piece, part) in drawn {
                counts.observed += part.observed;
                counts.filled += part.filled;
                counts.empty += part.empty;
                pieces.push(piece);
            }
            sink.take(pieces).map_err(Error::Sink)?;
        }
    }
    sink.finish().map_err(Error::Sink)?;
    Ok(plan.summary(&counts))
}

#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    observed: usize,
    filled: usize,
    empty: usize,
}

/// Everything that is the same for all pieces.
struct Plan<'a> {
    input: &'a DrawInput<'a>,
    grid: Grid,
    faces: FaceIndex,
    points: &'a MapPoints,
    scatter: Option<(&'a Scatter, Reach)>,
    wanted: Wanted,
    shade: Vec<f32>,
    roughness: Vec<f32>,
    stretch: Vec<[f32; 4]>,
    layers: Vec<LayerDescription>,
    offset_range_m: f64,
    stretch_range: f64,
    warnings: Vec<Warning>,
}

impl<'a> Plan<'a> {
    fn new(input: &'a DrawInput<'a>, points: &'a MapPoints, settings: &Settings) -> Result<Self, Error> {
        let mesh = input.chart.strip().mesh();
        let vertices = mesh.vertices().len();
        if let Some(found) = input.section_offsets_m.map(<[f64]>::len).filter(|&n| n != vertices) {
            return Err(Error::Length { column: "the distance from the mean section", found, expected: vertices });
        }
        if let Some(found) = input.design_offsets_m.map(<[f64]>::len).filter(|&n| n != vertices) {
            return Err(Error::Length { column: "the distance from the design profile", found, expected: vertices });
        }
        if let Some(quality) = input.quality {
            let incidence = if quality.incidence_deg.is_empty() { vertices } else { quality.incidence_deg.len() };
            let lengths = [quality.noise_m.len(), quality.density_per_m2.len(), incidence, quality.class.len()];
            if let Some(found) = lengths.into_iter().find(|&n| n != vertices) {
                return Err(Error::Length { column: "the quality of the surface", found, expected: vertices });
            }
        }
        let mut warnings = Vec::new();
        let (low, high) = extent(input.chart);
        let scatter = points.scatter.as_ref();
        if let (None, Some((cloud, _))) = (scatter, input.points) {
            let message = format!("none of {} scan points lies on the map, so nothing colours it", cloud.len());
            warnings.push(Warning::new("map-without-points", message));
        }
        let cell_m = settings.cell_m.unwrap_or_else(|| match scatter.map(|s| s.spacing.typical) {
            Some([along, around]) => automatic_cell_m(along, around, high - low),
            None => {
                let edge = (4.0 / 3f64.sqrt() * mesh.area() / mesh.faces().len().max(1) as f64).sqrt() * CELL_PER_EDGE;
                automatic_cell_m(edge, edge, high - low)
            }
        });
        let grid = Grid::covering(low, high, cell_m)?;
        let faces = FaceIndex::new(input.chart, &grid);

        let wanted = wanted_layers(input, settings, scatter.is_some(), &mut warnings);
        let offset_range_m = input.section_offsets_m.map_or(0.1, |offsets| {
            let mut sizes: Vec<f64> = offsets.iter().map(|o| o.abs()).filter(|o| o.is_finite()).collect();
            super::grid::next_in_series(statistics::quantile(&mut sizes, 0.98).unwrap_or(0.1).max(0.01))
        });
        let shade = match input.section_offsets_m {
            Some(offsets) if wanted.contains(&Layer::Relief) => relief::shade_vertices(input.chart, offsets),
            _ => Vec::new(),
        };
        let roughness = match input.section_offsets_m {
            Some(offsets) if wanted.contains(&Layer::Roughness) => {
                let window_m = settings.roughness_window_m;
                if !(window_m.is_finite() && window_m > 0.0) {
                    return Err(Error::Window { window_m });
                }
                roughness::roughness(input.chart, offsets, window_m)
            }
            _ => Vec::new(),
        };
        let roughness_range_m = {
            let mut values: Vec<f64> = roughness.iter().filter(|r| r.is_finite()).map(|&r| f64::from(r)).collect();
            super::grid::next_in_series(statistics::quantile(&mut values, 0.98).unwrap_or(0.01).max(0.001))
        };
        let stretch: Vec<[f32; 4]> = if wanted.contains(&Layer::Distortion) {
            (0..mesh.faces().len() as u32).into_par_iter().map(|f| stretch_of(input.chart, f)).collect()
        } else {
            Vec::new()
        };
        let stretch_range = stretch_range(&stretch);
        let layers: Vec<LayerDescription> = wanted
            .iter()
            .map(|&layer| describe(layer, input, offset_range_m, stretch_range, roughness_range_m))
            .collect();
        let scatter = scatter.map(|s| (s, Reach::new(&s.spacing, settings.fill_m, cell_m)));
        Ok(Self {
            input,
            grid,
            faces,
            points,
            scatter,
            wanted: attributes_of(&wanted),
            shade,
            roughness,
            stretch,
            layers,
            offset_range_m,
            stretch_range,
            warnings,
        })
    }

    fn draw_piece(&self, rect: PixelRect) -> (Piece, Counts) {
        let surface = self.faces.rasterize(self.input.chart, &self.grid, rect);
        let blended = self.scatter.as_ref().map(|(scatter, reach)| {
            blend::blend(scatter, self.wanted, &self.grid, reach, rect, |i| surface.faces[i] != NO_FACE)
        });
        let coverage = self.coverage(&surface, blended.as_ref());
        let mut counts = Counts::default();
        for (i, &class) in coverage.iter().enumerate() {
            counts.observed += usize::from(class == COVERAGE_OBSERVED);
            counts.filled += usize::from(class == COVERAGE_FILLED);
            let supported = blended.as_ref().is_none_or(|b| b.support[i] != Support::None);
            counts.empty += usize::from(class != COVERAGE_NONE && !supported);
        }
        let layers = self.layers.iter().map(|d| self.samples(d.layer, &surface, blended.as_ref(), &coverage)).collect();
        (Piece { rect, layers }, counts)
    }

    fn coverage(&self, surface: &SurfaceTile, blended: Option<&BlendedTile>) -> Vec<u8> {
        let observed = self.input.chart.strip().mesh().observed();
        let class = |(i, &face): (usize, &u32)| {
            if face == NO_FACE {
                COVERAGE_NONE
            } else if observed[face as usize] && blended.is_none_or(|b| b.support[i] == Support::Observed) {
                COVERAGE_OBSERVED
            } else {
                COVERAGE_FILLED
            }
        };
        surface.faces.iter().enumerate().map(class).collect()
    }

    fn samples(&self, layer: Layer, surface: &SurfaceTile, blended: Option<&BlendedTile>, coverage: &[u8]) -> Samples {
        let pixels = surface.rect.len();
        let on_surface = |i: usize| surface.faces[i] != NO_FACE;
        let corners = |i: usize| self.input.chart.strip().mesh().faces()[surface.faces[i] as usize];
        match layer {
            Layer::Color => {
                let mut rgba = vec![0u8; pixels * 4];
                for (i, out) in rgba.as_chunks_mut::<4>().0.iter_mut().enumerate() {
                    let color = blended.map_or([f32::NAN; 3], |b| b.colors[i]);
                    if on_surface(i) && !color[0].is_nan() {
                        let [r, g, b] = color.map(|c| (c / 257.0 + 0.5) as u8);
                        *out = [r, g, b, 255];
                    }
                }
                Samples::U8(rgba)
            }
            Layer::Intensity => Samples::U16(
                (0..pixels)
                    .map(|i| match blended.map_or(f32::NAN, |b| b.intensities[i]) {
                        // 0 is NoData, so the darkest value is 1.
                        value if on_surface(i) && !value.is_nan() => ((value + 0.5) as u16).max(1),
                        _ => 0,
                    })
                    .collect(),
            ),
            Layer::Labels => {
                let label = |i: usize| match blended {
                    Some(b) if !b.labels.is_empty() => b.labels[i],
                    _ => 0,
                };
                match self.label_type() {
                    SampleType::U8 => {
                        Samples::U8((0..pixels).map(|i| if on_surface(i) { label(i) as u8 } else { u8::MAX }).collect())
                    }
                    SampleType::U16 => Samples::U16(
                        (0..pixels).map(|i| if on_surface(i) { label(i) as u16 } else { u16::MAX }).collect(),
                    ),
                    _ => Samples::U32((0..pixels).map(|i| if on_surface(i) { label(i) } else { u32::MAX }).collect()),
                }
            }
            Layer::Offset | Layer::DesignOffset => {
                let offsets =
                    if layer == Layer::Offset { self.input.section_offsets_m } else { self.input.design_offsets_m };
                Samples::F32(
                    (0..pixels)
                        .map(|i| match offsets {
                            Some(offsets) if on_surface(i) => {
                                let w = surface.weights(i);
                                let value: f64 = corners(i).iter().zip(w).map(|(&v, w)| offsets[v as usize] * w).sum();
                                to_step(value, OFFSET_STEP_M) as f32
                            }
                            _ => f32::NAN,
                        })
                        .collect(),
                )
            }
            Layer::Roughness => Samples::F32(
                (0..pixels)
                    .map(|i| {
                        if !on_surface(i) || self.roughness.is_empty() {
                            return f32::NAN;
                        }
                        let w = surface.weights(i);
                        let rough = |v: u32| f64::from(self.roughness[v as usize]);
                        let value: f64 = corners(i).iter().zip(w).map(|(&v, w)| rough(v) * w).sum();
                        to_step(value, ROUGHNESS_STEP_M) as f32
                    })
                    .collect(),
            ),
            Layer::Coverage => Samples::U8(coverage.to_vec()),
            Layer::Distortion => {
                let mut bands = vec![f32::NAN; pixels * 4];
                for (i, out) in bands.as_chunks_mut::<4>().0.iter_mut().enumerate() {
                    if on_surface(i) {
                        *out = self.stretch[surface.faces[i] as usize];
                    }
                }
                Samples::F32(bands)
            }
            Layer::Relief => Samples::U8(
                (0..pixels)
                    .map(|i| {
                        if !on_surface(i) || self.shade.is_empty() {
                            return 0;
                        }
                        let w = surface.weights(i);
                        let shade: f64 =
                            corners(i).iter().zip(w).map(|(&v, w)| f64::from(self.shade[v as usize]) * w).sum();
                        ((shade * 254.0 + 0.5) as u8).saturating_add(1)
                    })
                    .collect(),
            ),
            Layer::Classes => Samples::U8(
                (0..pixels)
                    .map(|i| match self.input.quality {
                        // Classes do not mix: the one of the nearest corner.
                        Some(quality) if on_surface(i) => {
                            let w = surface.weights(i);
                            let nearest = if w[0] >= w[1] && w[0] >= w[2] {
                                0
                            } else if w[1] >= w[2] {
                                1
                            } else {
                                2
                            };
                            quality.class[corners(i)[nearest] as usize]
                        }
                        _ => NOTHING_SEEN,
                    })
                    .collect(),
            ),
            Layer::Noise | Layer::Density | Layer::Incidence => {
                let values = self.input.quality.map_or(&[][..], |q| quality_of(layer, q));
                let value = |i: usize| {
                    let w = surface.weights(i);
                    let blended: f64 = corners(i).iter().zip(w).map(|(&v, w)| f64::from(values[v as usize]) * w).sum();
                    blended as f32
                };
                let known = |i: usize| on_surface(i) && !values.is_empty();
                Samples::F32((0..pixels).map(|i| if known(i) { value(i) } else { f32::NAN }).collect())
            }
            Layer::Xyz => {
                let vertices = self.input.chart.strip().mesh().vertices();
                let scale = 1.0 / self.input.frame.metres_per_unit;
                let mut bands = vec![f32::NAN; pixels * 3];
                for (i, out) in bands.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                    if on_surface(i) {
                        let w = surface.weights(i);
                        let [a, b, c] = corners(i).map(|v| vertices[v as usize]);
                        let position = (a * w[0] + b * w[1] + c * w[2]) * scale;
                        *out = [0, 1, 2].map(|k| to_step(position[k], POSITION_STEP) as f32);
                    }
                }
                Samples::F32(bands)
            }
            Layer::SurfacePoint => {
                let mut bands = vec![-1.0; pixels * 3];
                for (i, out) in bands.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                    if on_surface(i) {
                        let [_, b, c] = surface.weights(i);
                        *out = [f64::from(surface.faces[i]), to_step(b, WEIGHT_STEP), to_step(c, WEIGHT_STEP)];
                    }
                }
                match surface_point_type(self.input.chart.strip().mesh().faces().len()) {
                    SampleType::F32 => Samples::F32(bands.into_iter().map(|x| x as f32).collect()),
                    _ => Samples::F64(bands),
                }
            }
        }
    }

    fn label_type(&self) -> SampleType {
        self.layers.iter().find(|d| d.layer == Layer::Labels).map_or(SampleType::U8, |d| d.sample)
    }

    fn summary(self, counts: &Counts) -> Summary {
        let pixel_area = self.grid.cell_m() * self.grid.cell_m();
        let holes: f64 = self.input.chart.strip().hole_loops().iter().map(|l| loop_area(self.input.chart, l)).sum();
        let inside = (counts.observed + counts.filled) as f64 * pixel_area + holes;
        let coverage_percent = if inside > 0.0 { 100.0 * counts.observed as f64 * pixel_area / inside } else { 0.0 };
        Summary {
            cell_m: self.grid.cell_m(),
            width_px: self.grid.width(),
            height_px: self.grid.height(),
            u_min_m: self.grid.u_min(),
            v_max_m: self.grid.v_max(),
            point_spacing_m: self.scatter.as_ref().map(|(s, _)| s.spacing.typical),
            fill_m: self.scatter.as_ref().map_or([0.0; 2], |(_, reach)| reach.fill_m),
            max_offset_m: self.points.max_offset_m,
            points_used: self.scatter.as_ref().map_or(0, |(s, _)| s.index.len()),
            points_off_surface: self.points.off_surface,
            points_unanchored: self.points.unanchored,
            observed_px: counts.observed,
            filled_px: counts.filled,
            empty_px: counts.empty,
            coverage_percent,
            layers: self.layers.iter().map(|d| d.layer).collect(),
            offset_range_m: self.offset_range_m,
            stretch_range: self.stretch_range,
            warnings: self.warnings,
        }
    }
}

/// The least rectangle around the chart.
fn extent(chart: &Chart) -> (Vec2, Vec2) {
    let start = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
    let mut used = vec![false; chart.uv().len()];
    chart.strip().mesh().faces().iter().flatten().for_each(|&v| used[v as usize] = true);
    chart.uv().iter().zip(used).filter(|(_, u)| *u).fold(start, |(low, high), (p, _)| (low.inf(p), high.sup(p)))
}

/// Area inside a closed line of vertices in the chart, whatever its sense.
fn loop_area(chart: &Chart, vertices: &[u32]) -> f64 {
    let uv = chart.uv();
    let double: f64 = (0..vertices.len())
        .map(|i| uv[vertices[i] as usize].perp(&uv[vertices[(i + 1) % vertices.len()] as usize]))
        .sum();
    double.abs() / 2.0
}

/// The multiple of `step` (a power of two) nearest to a value far smaller than 2^51 steps. Adding and taking away 1.5 x 2^52
/// rounds to a whole number; `round` is a call for every pixel on processors that it must not count on.
fn to_step(value: f64, step: f64) -> f64 {
    const WHOLE: f64 = 6_755_399_441_055_744.0;
    (value / step + WHOLE - WHOLE) * step
}

fn is_on_surface(offset_m: f64, max_offset_m: f64) -> bool {
    offset_m.abs() <= max_offset_m
}

/// The distance from the surface (metres) up to which points belong to it: five times the 90 % quantile of all
/// distances (NaN: no distance), 0.1 to 0.3 m. The same for drawing the map and for the way back.
pub fn automatic_max_offset_m(offsets_m: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = offsets_m.iter().map(|o| o.abs()).filter(|o| o.is_finite()).collect();
    let typical = statistics::quantile(&mut sizes, 0.9).unwrap_or(0.0);
    (OFFSET_LIMIT * typical).clamp(OFFSET_LIMIT_BOUNDS_M.0, OFFSET_LIMIT_BOUNDS_M.1)
}

/// s1, s2, area ratio and direction (degrees) of a face.
fn stretch_of(chart: &Chart, face: u32) -> [f32; 4] {
    let d = distortion::of_face(chart.strip().mesh(), chart.uv(), face);
    [d.s1 as f32, d.s2 as f32, (d.s1 * d.s2) as f32, d.direction.to_degrees() as f32]
}

/// The stretch at the end of the colours: covers 99 % of the faces, from 1.05 up to 2.
fn stretch_range(stretch: &[[f32; 4]]) -> f64 {
    let mut values: Vec<f64> =
        stretch.iter().filter(|s| s[1] > 0.0).map(|s| f64::from(s[0]).max(1.0 / f64::from(s[1]))).collect();
    let q = statistics::quantile(&mut values, 0.99).unwrap_or(1.0);
    1.0 + super::grid::next_in_series((q - 1.0).clamp(0.05, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{Attributes, SourceFile};
    use crate::map::example::bent_chart;
    use crate::numeric::Vec3;

    /// Keeps whole layers in memory.
    #[derive(Default)]
    pub struct InMemory {
        pub grid: Option<Grid>,
        pub descriptions: Vec<LayerDescription>,
        pub values: Vec<Vec<f64>>,
    }

    impl Sink for InMemory {
        fn begin(&mut self, grid: &Grid, layers: &[LayerDescription]) -> Result<(), SinkError> {
            self.grid = Some(*grid);
            self.descriptions = layers.to_vec();
            self.values = layers.iter().map(|l| vec![f64::NAN; grid.rect().len() * l.bands.len()]).collect();
            Ok(())
        }

        fn take(&mut self, pieces: Vec<Piece>) -> Result<(), SinkError> {
            let width = self.grid.unwrap().width();
            for piece in pieces {
                for (layer, samples) in piece.layers.iter().enumerate() {
                    let bands = self.descriptions[layer].bands.len();
                    for i in 0..piece.rect.len() {
                        let (x, y) = (piece.rect.column + i % piece.rect.width, piece.rect.row + i / piece.rect.width);
                        for b in 0..bands {
                            self.values[layer][(y * width + x) * bands + b] = samples.get(i * bands + b);
                        }
                    }
                }
            }
            Ok(())
        }

        fn finish(&mut self) -> Result<(), SinkError> {
            Ok(())
        }
    }

    fn half_cylinder() -> Chart {
        let radius = 2.0;
        bent_chart(12.0, radius * std::f64::consts::PI, 61, 41, |u, v| {
            let angle = v / radius - std::f64::consts::FRAC_PI_2;
            Vec3::new(u, -radius * angle.sin(), radius * angle.cos())
        })
    }

    fn dense_cloud(chart: &Chart) -> (Cloud, Vec<Vec2>, Vec<f64>) {
        let (_, high) = extent(chart);
        let mut uv = Vec::new();
        for i in 0..600 {
            for j in 0..300 {
                uv.push(Vec2::new((f64::from(i) + 0.5) / 600.0 * high.x, (f64::from(j) + 0.5) / 300.0 * high.y));
            }
        }
        let colors = uv.iter().map(|p| [(p.x / high.x * 65_535.0) as u16, (p.y / high.y * 65_535.0) as u16, 0]);
        let labels = uv.iter().map(|p| u32::from(p.x > 6.0) * 300).collect();
        let attributes = Attributes { colors: Some(colors.collect()), labels: Some(labels), ..Default::default() };
        let n = uv.len();
        let source = SourceFile {
            path: "x".into(),
            first_point: 0,
            point_count: n,
            record_count: n as u64,
            dropped_records: Default::default(),
        };
        let cloud = Cloud::new(ScanFrame::local(), vec![Vec3::zeros(); n], attributes, vec![source], vec![]).unwrap();
        (cloud, uv, vec![0.0; n])
    }

    #[test]
    fn all_layers_of_a_half_cylinder() {
        let chart = half_cylinder();
        let (cloud, uv, mut offsets_m) = dense_cloud(&chart);
        offsets_m[0] = 2.0;
        let section: Vec<f64> = chart.uv().iter().map(|p| 0.01 * p.x).collect();
        let frame = ScanFrame::with_origin(Vec3::new(500_000.0, 6_000_000.0, 0.0));
        let quality = VertexQuality {
            noise_m: chart.uv().iter().map(|p| 0.001 * p.x as f32).collect(),
            density_per_m2: chart.uv().iter().map(|p| 100.0 * p.y as f32).collect(),
            incidence_deg: chart.uv().iter().map(|p| p.x as f32).collect(),
            class: chart.uv().iter().map(|p| u8::from(p.x > 6.1) * 2).collect(),
        };
        let input = DrawInput {
            chart: &chart,
            points: Some((&cloud, PointsOnMap { uv: &uv, offsets_m: &offsets_m })),
            frame: &frame,
            section_offsets_m: Some(&section),
            design_offsets_m: Some(&section),
            quality: Some(&quality),
        };
        let mut layers = Settings::default().layers;
        layers.extend([Layer::Relief, Layer::Xyz, Layer::SurfacePoint, Layer::DesignOffset, Layer::Roughness]);
        layers.extend([Layer::Classes, Layer::Noise, Layer::Density, Layer::Incidence]);
        let settings = Settings { cell_m: Some(0.02), layers, roughness_window_m: 1.6, ..Default::default() };
        let mut sink = InMemory::default();
        let summary = draw(&input, &settings, &mut sink).unwrap();
        assert_eq!((summary.width_px, summary.height_px), (600, 315));
        assert_eq!((summary.points_off_surface, summary.points_unanchored), (1, 0));
        assert!(summary.coverage_percent > 99.9, "{summary:?}");
        assert_eq!(summary.warnings.len(), 1, "{:?}", summary.warnings);
        let layer = |wanted: Layer| {
            let k = sink.descriptions.iter().position(|d| d.layer == wanted).unwrap();
            (&sink.descriptions[k], &sink.values[k])
        };
        let grid = sink.grid.unwrap();
        for (column, row) in [(0, 10), (300, 150), (599, 300), (77, 310)] {
            let i = row * 600 + column;
            let uv = grid.chart_from_pixel(Vec2::new(column as f64 + 0.5, row as f64 + 0.5));
            // Red grows with chainage, green upwards.
            let (_, color) = layer(Layer::Color);
            assert!((color[4 * i] - uv.x / 12.0 * 255.0).abs() < 2.0 && color[4 * i + 3] == 255.0);
            assert!((color[4 * i + 1] - uv.y / (2.0 * std::f64::consts::PI) * 255.0).abs() < 2.0);
            let (description, labels) = layer(Layer::Labels);
            assert_eq!((description.sample, labels[i]), (SampleType::U16, if uv.x > 6.0 { 300.0 } else { 0.0 }));
            assert!((layer(Layer::Offset).1[i] - 0.01 * uv.x).abs() < OFFSET_STEP_M);
            assert!((layer(Layer::DesignOffset).1[i] - 0.01 * uv.x).abs() < OFFSET_STEP_M);
            assert!(layer(Layer::Roughness).1[i] < 1e-5);
            assert_eq!(layer(Layer::Coverage).1[i], 1.0);
            assert!((layer(Layer::Noise).1[i] - 0.001 * uv.x).abs() < 1e-6);
            assert!((layer(Layer::Density).1[i] - 100.0 * uv.y).abs() < 1e-3);
            assert!((layer(Layer::Incidence).1[i] - uv.x).abs() < 1e-4);
            assert_eq!(layer(Layer::Classes).1[i], if uv.x > 6.1 { 2.0 } else { 0.0 });
            let stretch = &layer(Layer::Distortion).1[4 * i..4 * i + 4];
            assert!((stretch[0] - 1.0).abs() < 0.01 && (stretch[1] - 1.0).abs() < 0.01);
            let (description, xyz) = layer(Layer::Xyz);
            assert_eq!(description.band_offsets, [500_000.0, 6_000_000.0, 0.0]);
            assert!((xyz[3 * i] - uv.x).abs() < 0.5 * POSITION_STEP + 1e-6);
            let (_, place) = layer(Layer::SurfacePoint);
            let corners = chart.corners_in_chart(place[3 * i] as u32);
            let (b, c) = (place[3 * i + 1], place[3 * i + 2]);
            assert!((corners[0] * (1.0 - b - c) + corners[1] * b + corners[2] * c - uv).norm() < 1e-7);
        }
    }

    #[test]
    fn a_mesh_alone_gives_the_geometric_layers() {
        let chart = half_cylinder();
        let input = DrawInput {
            chart: &chart,
            points: None,
            frame: &ScanFrame::local(),
            section_offsets_m: None,
            design_offsets_m: None,
            quality: None,
        };
        let mut sink = InMemory::default();
        let summary = draw(&input, &Settings::default(), &mut sink).unwrap();
        assert_eq!(summary.layers, [Layer::Labels, Layer::Coverage, Layer::Distortion]);
        assert_eq!(summary.warnings.len(), 3);
    }

    #[test]
    fn columns_must_fit() {
        let chart = half_cylinder();
        let input = DrawInput {
            chart: &chart,
            points: None,
            frame: &ScanFrame::local(),
            section_offsets_m: Some(&[0.0]),
            design_offsets_m: None,
            quality: None,
        };
        let error = draw(&input, &Settings::default(), &mut InMemory::default()).unwrap_err();
        assert!(matches!(error, Error::Length { found: 1, .. }));
    }
}
