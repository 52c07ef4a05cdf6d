//! The guide: what the axis tells about a strip before any method runs. Where each vertex is along and around the
//! tunnel, and the section chart that the methods start from, are placed on and are judged by.

use super::handles::Handle;
use super::{Error, distortion, section, unfold};
use crate::axis::{Axis, AxisCoordinates};
use crate::cut::Strip;
use crate::mesh::topology;
use crate::numeric::{Vec2, Vec3, wrap_angle};
use crate::warning::Warning;
use rayon::prelude::*;
use serde::Serialize;
use std::f64::consts::TAU;

/// Share of the faces that may stay folded in the section chart of an axis that is believed without being asked for.
const MOST_FOLDED: f64 = 0.02;
/// Mean stretch that the section chart of such an axis may have: rough rock has 1.05, sharp bends 1.2.
const MOST_STRETCH: f64 = 1.6;
/// One collapsed face counts no more than this.
const UNBELIEVABLE_STRETCH: f64 = 20.0;

/// A strip as the axis sees it.
#[derive(Clone, Debug)]
pub struct Guide {
    axis: Axis,
    coordinates: Vec<AxisCoordinates>,
    angles: Vec<f64>,
    uv: Vec<Vec2>,
    handles: Vec<Handle>,
    summary: GuideSummary,
}

/// What making the guide tells.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GuideSummary {
    /// The section chart.
    pub section: section::SectionSummary,
    /// Faces that were flipped or collapsed in the raw section chart (the surface folds over as seen from the axis).
    pub folded_faces: usize,
    /// Vertices moved to unfold them.
    pub moved_vertices: usize,
    /// Faces still flipped or collapsed afterwards.
    pub flipped_faces: usize,
    /// Edges whose angle around the axis is ambiguous because a face contains the axis (end caps).
    pub ambiguous_edges: usize,
    /// What a person should know.
    pub warnings: Vec<Warning>,
}

impl Guide {
    /// Projects the vertices on the axis, makes the angle around it continuous over the strip, and charts the section.
    ///
    /// # Errors
    /// [`Error::NotOpened`] when a border of the strip winds around the axis; [`Error::Setting`].
    pub fn of_strip(strip: &Strip, axis: &Axis, settings: &section::Settings) -> Result<Self, Error> {
        let vertices = strip.mesh().vertices();
        let coordinates: Vec<AxisCoordinates> = vertices.par_iter().map(|p| axis.project(p)).collect();
        for border in std::iter::once(strip.outer_loop()).chain(strip.hole_loops().iter().map(Vec::as_slice)) {
            let turns = winding(border, &coordinates);
            if turns.abs() > 0.5 {
                return Err(Error::NotOpened { vertex: border[0], turns });
            }
        }
        let (angles, ambiguous_edges) = continuous_angles(strip, &coordinates);
        let (mut uv, section) = section::chart(strip, &coordinates, &angles, settings)?;
        let unfolded = unfold::unfold(strip.mesh(), &mut uv);
        let mut warnings = Vec::new();
        if unfolded.flipped_after > 0 {
            warnings.push(Warning::new(
                "section-chart-folds",
                format!(
                    "{} faces stay folded over in the section chart ({} before unfolding): the surface hides behind itself as seen from the axis",
                    unfolded.flipped_after, unfolded.flipped_before
                ),
            ));
        }
        if ambiguous_edges > 0 {
            warnings.push(Warning::new(
                "axis-touches-surface",
                format!(
                    "{ambiguous_edges} mesh edges pass around the axis (a closed end, or an axis outside the void): the map is unreliable there"
                ),
            ));
        }
        let summary = GuideSummary {
            section,
            folded_faces: unfolded.flipped_before,
            moved_vertices: unfolded.moved_vertices,
            flipped_faces: unfolded.flipped_after,
            ambiguous_edges,
            warnings,
        };
        Ok(Self { axis: axis.clone(), coordinates, angles, uv, handles: Vec::new(), summary })
    }

    /// The same guide with handles given by a person.
    pub fn with_handles(self, handles: &[Handle]) -> Self {
        Self { handles: handles.to_vec(), ..self }
    }

    /// Handles given by a person, for the methods that can be steered.
    pub fn handles(&self) -> &[Handle] {
        &self.handles
    }

    /// Why the axis is not that of the strip, if it is not: a surface that does not run around it gives a section chart
    /// that is wildly stretched or folded.
    pub fn doubt(&self, strip: &Strip) -> Option<String> {
        let faces = strip.mesh().faces().len();
        let folded = self.summary.flipped_faces;
        if folded as f64 > MOST_FOLDED * faces as f64 {
            return Some(format!("{folded} of {faces} faces stay folded in its section chart"));
        }
        if self.summary.ambiguous_edges as f64 > MOST_FOLDED * faces as f64 {
            return Some(format!("{} edges pass around it", self.summary.ambiguous_edges));
        }
        let (mut sum, mut total) = (0.0, 0.0);
        for face in distortion::of_faces(strip.mesh(), &self.uv) {
            if face.is_defined() {
                sum += face.area * face.stretch().min(UNBELIEVABLE_STRETCH);
                total += face.area;
            }
        }
        let mean = if total > 0.0 { sum / total } else { 1.0 };
        (mean > MOST_STRETCH).then(|| format!("its section chart stretches {mean:.1} times in the mean"))
    }

    /// The axis.
    pub fn axis(&self) -> &Axis {
        &self.axis
    }

    /// Axis coordinates of each vertex.
    pub fn coordinates(&self) -> &[AxisCoordinates] {
        &self.coordinates
    }

    /// Angle around the axis of each vertex in radians, 0 at the crown, positive over the right wall, without the jump
    /// at the invert: neighbours on the strip have neighbouring angles.
    pub fn angles(&self) -> &[f64] {
        &self.angles
    }

    /// The section chart, free of folds unless the summary says otherwise: x = chainage, y = girth from the crown.
    pub fn uv(&self) -> &[Vec2] {
        &self.uv
    }

    /// Direction of increasing chainage at a chainage.
    pub fn forward(&self, chainage: f64) -> Vec3 {
        self.axis.frame_at(chainage).forward
    }

    /// Counts and warnings.
    pub fn summary(&self) -> &GuideSummary {
        &self.summary
    }
}

/// Turns around the axis along a closed loop of vertices.
pub(crate) fn winding(border: &[u32], coordinates: &[AxisCoordinates]) -> f64 {
    let angle = |i: usize| coordinates[border[i % border.len()] as usize].angle();
    (0..border.len()).map(|i| wrap_angle(angle(i + 1) - angle(i))).sum::<f64>() / TAU
}

/// The angle of each vertex, continuous across edges, with its mean nearest to the crown; and the number of edges on
/// which two ways around disagree.
fn continuous_angles(strip: &Strip, coordinates: &[AxisCoordinates]) -> (Vec<f64>, usize) {
    let faces = strip.mesh().faces();
    let twin = strip.mesh().twins();
    let raw: Vec<f64> = coordinates.iter().map(AxisCoordinates::angle).collect();
    let mut angles = vec![f64::NAN; raw.len()];
    let mut reached = vec![false; faces.len()];
    let mut queue = std::collections::VecDeque::from([0u32]);
    reached[0] = true;
    let first = faces[0][0] as usize;
    angles[first] = raw[first];
    while let Some(face) = queue.pop_front() {
        let corners = faces[face as usize];
        let known = corners.iter().position(|&v| !angles[v as usize].is_nan()).expect("reached over a shared edge");
        for i in 1..3 {
            let from = corners[(known + i - 1) % 3] as usize;
            let to = corners[(known + i) % 3] as usize;
            if angles[to].is_nan() {
                angles[to] = angles[from] + wrap_angle(raw[to] - raw[from]);
            }
        }
        for corner in 3 * face..3 * face + 3 {
            let other = twin[corner as usize];
            if other != topology::NO_TWIN && !reached[(other / 3) as usize] {
                reached[(other / 3) as usize] = true;
                queue.push_back(other / 3);
            }
        }
    }
    let jumps = |a: u32, b: u32| {
        let (a, b) = (a as usize, b as usize);
        (angles[a] + wrap_angle(raw[b] - raw[a]) - angles[b]).abs() > 1.0
    };
    let ambiguous = faces.iter().map(|&[a, b, c]| [jumps(a, b), jumps(b, c), jumps(c, a)]);
    let ambiguous = ambiguous.flatten().filter(|&j| j).count();
    let (sum, count) = angles.iter().filter(|a| !a.is_nan()).fold((0.0, 0usize), |(s, n), a| (s + a, n + 1));
    let turns = (sum / count as f64 / TAU).round() * TAU;
    for (angle, raw) in angles.iter_mut().zip(&raw) {
        // Vertices without a face keep their own angle.
        *angle = if angle.is_nan() { *raw } else { *angle - turns };
    }
    (angles, ambiguous)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Mesh;
    use std::f64::consts::PI;

    fn tube(open_deg: f64) -> Strip {
        let (columns, rows) = (48u32, 10u32);
        let vertices = (0..=rows)
            .flat_map(|i| {
                (0..columns).map(move |j| {
                    let angle =
                        (f64::from(j) / f64::from(columns - 1) * 2.0 - 1.0) * (PI - open_deg.to_radians() / 2.0);
                    Vec3::new(f64::from(i), -4.0 * angle.sin(), 4.0 * angle.cos())
                })
            })
            .collect();
        let faces = (0..rows)
            .flat_map(|i| {
                (0..columns - 1).flat_map(move |j| {
                    let a = i * columns + j;
                    [[a, a + columns, a + columns + 1], [a, a + columns + 1, a + 1]]
                })
            })
            .collect();
        Strip::from_disk(Mesh::all_observed(vertices, faces).unwrap()).unwrap()
    }

    #[test]
    fn angles_run_from_seam_to_seam() {
        let axis = Axis::through(&[Vec3::zeros(), Vec3::new(10.0, 0.0, 0.0)], 0.0).unwrap();
        let strip = tube(1.0);
        let guide = Guide::of_strip(&strip, &axis, &section::Settings::default()).unwrap();
        let limit = PI - 0.5_f64.to_radians();
        assert!((guide.angles()[0] + limit).abs() < 1e-9 && (guide.angles()[47] - limit).abs() < 1e-9);
        assert_eq!(guide.summary().ambiguous_edges, 0);
    }
}
