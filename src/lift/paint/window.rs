//! A piece of the map and the pixels of the edited picture that are made of it.

use super::Error;
use super::passage::Passage;
use super::resampling::{Axis, Band, resample};
use crate::map::{Picture, PixelRect, Placement};
use crate::numeric::Vec2;
use std::collections::HashMap;
use std::ops::Range;

/// Shapes may differ by this many pixels (rounding when a picture was resized).
const SHAPE_SLACK_PX: f64 = 1.5;
/// Side of the pieces that the map is worked on in, pixels of the map.
const CORE_PX: usize = 256;
/// A piece is worked on with so many pixels (of the coarser picture) around it.
const MARGIN_PX: f64 = 12.0;
/// Channels of an even base differ by so many grey levels.
const EVEN: f32 = 64.0;
/// Opaque enough to be seen.
pub(super) const OPAQUE: u8 = 128;

/// Where the edited picture lies on the pictures of the map.
pub(super) struct Place {
    pub(super) columns: Axis,
    pub(super) rows: Axis,
    /// Columns and rows of the map that the edited picture shows.
    pub(super) covered: [Range<usize>; 2],
    pub(super) width: usize,
    pub(super) height: usize,
}

impl Place {
    /// The place of `edited`, which lies at `own` or shows the whole map.
    pub(super) fn new(
        edited: &Picture,
        own: Option<Placement>,
        map: &Picture,
        placement: Placement,
    ) -> Result<Self, Error> {
        let (columns, rows) = match own {
            Some(own) => {
                let corner = placement.pixel_from_chart(own.chart_from_pixel(Vec2::zeros()));
                let axis = |origin: f64, scale: f64| {
                    // World files are written with a few digits.
                    let whole = (scale - 1.0).abs() < 1e-6 && (origin - origin.round()).abs() < 0.02;
                    if whole { Axis { origin: origin.round(), scale: 1.0 } } else { Axis { origin, scale } }
                };
                (axis(corner.x, own.step_u / placement.step_u), axis(corner.y, own.step_v / placement.step_v))
            }
            None => {
                let scale = map.width as f64 / edited.width as f64;
                if (map.height as f64 / scale - edited.height as f64).abs() > SHAPE_SLACK_PX {
                    return Err(Error::Shape {
                        width: edited.width,
                        height: edited.height,
                        map_width: map.width,
                        map_height: map.height,
                    });
                }
                let rows = map.height as f64 / edited.height as f64;
                (Axis { origin: 0.0, scale }, Axis { origin: 0.0, scale: rows })
            }
        };
        let range = |axis: Axis, count: usize, end: usize| {
            let clip = |x: f64| (x.round().max(0.0) as usize).min(end);
            clip(axis.origin)..clip(axis.origin + count as f64 * axis.scale)
        };
        Ok(Place {
            covered: [range(columns, edited.width, map.width), range(rows, edited.height, map.height)],
            columns,
            rows,
            width: edited.width,
            height: edited.height,
        })
    }

    /// Pixels of the map in one of the edited picture.
    pub(super) fn scale(&self) -> f64 {
        self.columns.scale
    }

    /// Whether pixels of the edited picture are no pixels of the map.
    pub(super) fn is_resized(&self) -> bool {
        [self.columns, self.rows].iter().any(|a| a.scale != 1.0 || a.origin.fract() != 0.0)
    }

    /// The pieces of the part of the map that the picture shows, row by row.
    pub(super) fn cores(&self) -> Vec<PixelRect> {
        let [columns, rows] = &self.covered;
        let mut cores = Vec::new();
        for row in rows.clone().step_by(CORE_PX) {
            for column in columns.clone().step_by(CORE_PX) {
                cores.push(PixelRect {
                    column,
                    row,
                    width: CORE_PX.min(columns.end - column),
                    height: CORE_PX.min(rows.end - row),
                });
            }
        }
        cores
    }
}

/// What the base says about a pixel of the edited picture.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    pub(super) state: State,
    /// Colour that the base gives it.
    pub(super) base: [u8; 3],
    /// Whether the base is nearly even around the pixel: no edge of its own is resized or compressed there.
    pub(super) even: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// As the base.
    Same,
    /// Something else than the base.
    Painted,
    /// Transparent where the base is not.
    Erased,
}

/// A piece of the map with its surroundings, and the pixels of the edited picture that are made of nothing else. Colours
/// are red, green, blue and alpha; with transparency the first three are multiplied by it.
pub(super) struct Window {
    pub(super) core: PixelRect,
    /// The pixels of the map.
    pub(super) map: PixelRect,
    /// The pixels of the edited picture.
    pub(super) edited: PixelRect,
    pub(super) columns: Band,
    pub(super) rows: Band,
    /// Colours of the base, for each pixel of the map.
    pub(super) base: Vec<[f32; 4]>,
    /// Colours that came back, and those that the base would give, for each pixel of the edited picture.
    pub(super) seen: Vec<[f32; 4]>,
    pub(super) expected: Vec<[f32; 4]>,
}

impl Window {
    pub(super) fn new(core: PixelRect, place: &Place, passage: &Passage, edited: &Picture, base: &Picture) -> Self {
        let margin = |axis: Axis| (MARGIN_PX * axis.scale.max(1.0)).ceil() as usize;
        let grown = |start: usize, length: usize, margin: usize, covered: &Range<usize>| {
            start.saturating_sub(margin).max(covered.start)..(start + length + margin).min(covered.end)
        };
        let [covered_columns, covered_rows] = &place.covered;
        let across = grown(core.column, core.width, margin(place.columns), covered_columns);
        let down = grown(core.row, core.height, margin(place.rows), covered_rows);
        let complete = |axis: Axis, count: usize, window: &Range<usize>, covered: &Range<usize>| {
            let range = axis.complete(passage.filter, count, window, covered);
            // Colours of a JPEG belong to pairs of pixels.
            if passage.lossy { range.start.next_multiple_of(2).min(range.end)..range.end } else { range }
        };
        let columns = complete(place.columns, place.width, &across, covered_columns);
        let rows = complete(place.rows, place.height, &down, covered_rows);
        let column_band = Band::new(place.columns, passage.filter, columns.clone(), &across, covered_columns);
        let row_band = Band::new(place.rows, passage.filter, rows.clone(), &down, covered_rows);
        let pixels = |picture: &Picture, columns: Range<usize>, rows: Range<usize>| -> Vec<[u8; 4]> {
            let all = picture.rgba.as_chunks::<4>().0;
            rows.flat_map(|y| all[y * picture.width..][columns.clone()].iter().copied()).collect()
        };
        let on_map = pixels(base, across.clone(), down.clone());
        let mut colors: Vec<[f32; 4]> = on_map.iter().map(|&c| passage.color_of_base(c)).collect();
        if let Some(palette) = passage.palette() {
            let mut known = HashMap::new();
            for (color, &[r, g, b, a]) in colors.iter_mut().zip(&on_map).filter(|(_, c)| c[3] >= OPAQUE) {
                let [r, g, b] = *known.entry([r, g, b]).or_insert_with(|| palette.of_base([r, g, b]));
                *color = passage.color_of_base([r, g, b, a]);
            }
        }
        let seen = if passage.is_dithered() {
            // Both pictures, which have the same size, are looked at out of focus.
            let moved = |r: &Range<usize>, axis: Axis| {
                let from = |k: usize| (k as f64 - axis.origin) as usize;
                from(r.start)..from(r.end)
            };
            let sharp = pixels(edited, moved(&across, place.columns), moved(&down, place.rows));
            let sharp: Vec<[f32; 4]> = sharp.into_iter().map(|c| passage.color_seen(c)).collect();
            resample(&sharp, across.len(), &column_band, &row_band)
        } else {
            pixels(edited, columns.clone(), rows.clone()).into_iter().map(|c| passage.color_seen(c)).collect()
        };
        Window {
            core,
            expected: resample(&colors, across.len(), &column_band, &row_band),
            base: colors,
            seen,
            map: rect(&across, &down),
            edited: rect(&columns, &rows),
            columns: column_band,
            rows: row_band,
        }
    }

    /// How far a pixel of the edited picture is from what the base would give.
    pub(super) fn difference(&self, i: usize) -> f64 {
        far(self.seen[i], self.expected[i].map(|c| c.clamp(0.0, 255.0)))
    }

    /// Whether a pixel of the edited picture shows surface, and is not transparent.
    pub(super) fn is_surface(&self, i: usize) -> bool {
        self.expected[i][3] >= f32::from(OPAQUE) && self.seen[i][3] >= f32::from(OPAQUE)
    }

    /// Whether the centre of a pixel of the edited picture lies in the core (each lies in that of one window).
    pub(super) fn is_own(&self, i: usize, place: &Place) -> bool {
        let inside = |axis: Axis, k: usize, start: usize, length: usize, covered: &Range<usize>| {
            let centre = (axis.origin + (k as f64 + 0.5) * axis.scale).max(0.0) as usize;
            (start..start + length).contains(&centre.clamp(covered.start, covered.end - 1))
        };
        let (x, y) = (i % self.edited.width, i / self.edited.width);
        let (core, [columns, rows]) = (self.core, &place.covered);
        inside(place.columns, self.edited.column + x, core.column, core.width, columns)
            && inside(place.rows, self.edited.row + y, core.row, core.height, rows)
    }

    /// The pixels of the edited picture as a picture.
    pub(super) fn picture(&self) -> Picture {
        let rgba = self.seen.iter().flatten().map(|c| c.round() as u8).collect();
        Picture { width: self.edited.width, height: self.edited.height, rgba }
    }

    /// What the base says about each pixel of the edited picture, when differences up to `tolerance` are noise.
    pub(super) fn compare(&self, tolerance: f64, is_mixed: bool) -> Vec<Seen> {
        let (width, height) = (self.edited.width, self.edited.height);
        let even = |i: usize| {
            let (x, y) = (i % width, i / width);
            let (mut low, mut high) = ([255.0f32; 3], [0.0f32; 3]);
            for ny in y.saturating_sub(1)..(y + 2).min(height) {
                for nx in x.saturating_sub(1)..(x + 2).min(width) {
                    let c = self.expected[ny * width + nx];
                    (0..3).for_each(|k| (low[k], high[k]) = (low[k].min(c[k]), high[k].max(c[k])));
                }
            }
            (0..3).all(|k| high[k] - low[k] <= EVEN)
        };
        let seen = |i: usize| {
            let (seen, expected) = (self.seen[i], self.expected[i].map(|c| c.clamp(0.0, 255.0)));
            let state = if expected[3] >= f32::from(OPAQUE) && seen[3] < f32::from(OPAQUE) {
                State::Erased
            } else if far(seen, expected) > tolerance {
                State::Painted
            } else {
                State::Same
            };
            let base = [0, 1, 2].map(|k| expected[k].round() as u8);
            Seen { state, base, even: state != State::Painted || !is_mixed || even(i) }
        };
        (0..self.seen.len()).map(seen).collect()
    }

    /// For each column (row) of the map: the pixel of the edited picture at or before its centre, and how far it is on the
    /// way to the next one.
    pub(super) fn between(band: &Band, count: usize) -> Vec<(usize, f32)> {
        let last = band.len().saturating_sub(1);
        let mut k = 0;
        (0..count)
            .map(|j| {
                let centre = j as f64 + 0.5;
                while k < last && band.centre(k + 1) <= centre {
                    k += 1;
                }
                if k == last || centre <= band.centre(k) {
                    return (k, 0.0);
                }
                let (a, b) = (band.centre(k), band.centre(k + 1));
                (k, ((centre - a) / (b - a)) as f32)
            })
            .collect()
    }
}

fn rect(columns: &Range<usize>, rows: &Range<usize>) -> PixelRect {
    PixelRect { column: columns.start, row: rows.start, width: columns.len(), height: rows.len() }
}

/// Distance of two colours with their alpha.
pub(super) fn far(a: [f32; 4], b: [f32; 4]) -> f64 {
    (0..4).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
}
