//! A class for each pixel of a map, and the way from there to points and faces.

use super::Error;
use crate::cloud::Label;
use crate::map::Placement;
use crate::numeric::Vec2;
use crate::unwrap::Chart;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;

/// Marks pixels without surface.
pub const NO_SURFACE: Label = Label::MAX;

/// Points farther from the edge of the picture than this many pixels are outside of it.
const EDGE_PX: f64 = 2.0;

/// A class for each pixel of a picture that lies on the chart.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelMap {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Where the pixels lie.
    pub placement: Placement,
    /// Class of each pixel, row by row from the top; 0 unlabelled, [`NO_SURFACE`] where there is no map.
    pub labels: Vec<Label>,
}

impl LabelMap {
    /// The class at a place on the chart: that of the pixel there, or of the nearest of its neighbours when that pixel
    /// has no surface (the border of the map runs through pixels). `None` outside the picture.
    pub fn at(&self, uv: Vec2) -> Option<Label> {
        let p = self.placement.pixel_from_chart(uv);
        let (w, h) = (self.width as f64, self.height as f64);
        let outside = !(p.x >= -EDGE_PX && p.y >= -EDGE_PX && p.x < w + EDGE_PX && p.y < h + EDGE_PX);
        if outside || self.labels.is_empty() {
            return None;
        }
        let x = (p.x.max(0.0) as usize).min(self.width - 1);
        let y = (p.y.max(0.0) as usize).min(self.height - 1);
        let own = self.labels[y * self.width + x];
        if own != NO_SURFACE {
            return Some(own);
        }
        let mut nearest: Option<(f64, Label)> = None;
        for ny in y.saturating_sub(1)..(y + 2).min(self.height) {
            for nx in x.saturating_sub(1)..(x + 2).min(self.width) {
                let label = self.labels[ny * self.width + nx];
                let d = (Vec2::new(nx as f64 + 0.5, ny as f64 + 0.5) - p).norm_squared();
                if label != NO_SURFACE && nearest.is_none_or(|(best, _)| d < best) {
                    nearest = Some((d, label));
                }
            }
        }
        nearest.map(|(_, label)| label)
    }
}

/// Labels of the points of a scan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PointLabels {
    /// A label for each point; 0 for none.
    #[serde(skip)]
    pub labels: Vec<Label>,
    /// How many points got each label (0 included).
    pub counts: BTreeMap<Label, usize>,
    /// Points that are too far from the surface to be part of the wall; they get no label.
    pub off_surface: usize,
    /// Points without a place on the map, or outside the picture; they get no label.
    pub outside: usize,
}

/// Labels of the faces of the chart.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FaceLabels {
    /// A label for each face; 0 for none.
    #[serde(skip)]
    pub labels: Vec<Label>,
    /// How many faces got each label (0 included).
    pub counts: BTreeMap<Label, usize>,
}

/// The label under each point, given its chart coordinates (NaN: none) and its distance from the surface. Points
/// farther from the surface than `max_offset_m` did not colour the map and do not take its labels.
///
/// # Errors
/// [`Error::Length`] when the columns differ in length.
pub fn labels_of_points(
    map: &LabelMap,
    uv: &[Vec2],
    offsets_m: &[f64],
    max_offset_m: f64,
) -> Result<PointLabels, Error> {
    if uv.len() != offsets_m.len() {
        return Err(Error::Length { found: offsets_m.len(), expected: uv.len() });
    }
    let found: Vec<Result<Label, bool>> = uv
        .par_iter()
        .zip(offsets_m)
        .map(|(&p, offset)| {
            let label = map.at(p).ok_or(false)?;
            if offset.abs() <= max_offset_m { Ok(label) } else { Err(true) }
        })
        .collect();
    let off_surface = found.iter().filter(|f| **f == Err(true)).count();
    let outside = found.iter().filter(|f| **f == Err(false)).count();
    let labels: Vec<Label> = found.into_iter().map(|f| f.unwrap_or(0)).collect();
    Ok(PointLabels { counts: count(&labels), labels, off_surface, outside })
}

/// The label of each face of the chart: that of most of four places in it, its centre among equals.
pub fn labels_of_faces(map: &LabelMap, chart: &Chart) -> FaceLabels {
    let label_of = |face: u32| {
        let [a, b, c] = chart.corners_in_chart(face);
        let centre = (a + b + c) / 3.0;
        let places = [centre, (centre + a) / 2.0, (centre + b) / 2.0, (centre + c) / 2.0];
        let labels = places.map(|p| map.at(p).unwrap_or(0));
        let votes = |l: Label| labels.iter().filter(|&&x| x == l).count();
        labels.into_iter().rev().max_by_key(|&l| (votes(l), l == labels[0])).unwrap_or(0)
    };
    let labels: Vec<Label> = (0..chart.strip().mesh().faces().len() as u32).into_par_iter().map(label_of).collect();
    FaceLabels { counts: count(&labels), labels }
}

fn count(labels: &[Label]) -> BTreeMap<Label, usize> {
    let mut counts = BTreeMap::new();
    labels.iter().for_each(|&l| *counts.entry(l).or_insert(0) += 1);
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::Grid;
    use crate::map::example::flat_chart;

    fn map() -> LabelMap {
        // 2 x 1 m at 0.1 m: left half 5, right half 0, the top row without surface.
        let grid = Grid::covering(Vec2::zeros(), Vec2::new(2.0, 1.0), 0.1).unwrap();
        let labels = (0..200).map(|i| if i < 20 { NO_SURFACE } else { 5 * Label::from(i % 20 < 10) }).collect();
        LabelMap { width: 20, height: 10, placement: Placement::of_grid(&grid), labels }
    }

    #[test]
    fn points_take_the_label_of_their_pixel() {
        let uv = [
            Vec2::new(0.5, 0.5),
            Vec2::new(1.5, 0.5),
            Vec2::new(0.5, 0.95),
            Vec2::new(0.5, 0.5),
            Vec2::new(f64::NAN, 0.0),
            Vec2::new(9.0, 0.5),
        ];
        let offsets = [0.0, 0.0, 0.0, 0.4, f64::NAN, 0.0];
        let found = labels_of_points(&map(), &uv, &offsets, 0.1).unwrap();
        assert_eq!(found.labels, [5, 0, 5, 0, 0, 0]);
        assert_eq!((found.off_surface, found.outside), (1, 2));
        assert!(labels_of_points(&map(), &uv, &[], 0.1).is_err());
    }

    #[test]
    fn faces_take_the_label_of_most_of_their_area() {
        let chart = flat_chart(2.0, 1.0, 9, 5);
        let found = labels_of_faces(&map(), &chart);
        for face in 0..found.labels.len() as u32 {
            let [a, b, c] = chart.corners_in_chart(face);
            assert_eq!(found.labels[face as usize], if ((a + b + c) / 3.0).x < 1.0 { 5 } else { 0 });
        }
    }
}
