//! Skinning: bones along the crown, the springlines and the wall lines turn the straightened tunnel open like a book, and
//! every vertex follows the bones near it; then it is projected on the plane.
//!
//! Use it for a smooth, predictable opening without any solve on the mesh itself, at any mesh size. It does not correct
//! distortion: where the section differs from the mean section that the bones know, lengths are off by as much.
//!
//! Reference: A. Jacobson, I. Baran, J. Popović, O. Sorkine, "Bounded Biharmonic Weights for Real-Time Deformation", ACM
//! Transactions on Graphics 30(4), 2011, doi:10.1145/2010324.1964973.
//!
//! | symbol | meaning |
//! |---|---|
//! | `w_b` | weight of bone `b`, between 0 and 1, 1 on the bone, 0 on the others |
//! | `c_b(u)`, `theta_b(u)` | place of bone `b` in the section at chainage `u`, and its direction there |
//!
//! The bend is taken out first in closed form (chainage, right, down). The cage (`cage.rs`) is a regular grid over the
//! section chart; it carries the mean section, a smooth field fitted to the vertices, and the weights. Bones run along the
//! tunnel: the crown, the two ends, and outwards from the crown a new one whenever the section has turned by
//! `bone_turn_deg`, which puts bones on springlines and wall lines. Each bone is a chain of rigid transforms: at chainage
//! `u` it turns `theta_b(u)` back to horizontal and brings `c_b(u)` to its girth. Given handles add their displacement.
//!
//! Guarantees: finite; flips (relief that folds over when it is projected) are unfolded and counted. Needs the axis.
//! Departures: the cage is two-dimensional, because the surface is; bones are chains so that a section that changes along
//! the tunnel opens everywhere.
//! Cost: a few small factorizations on the cage, then linear in the vertices.

use super::cage::{Cage, Sample};
use super::conformal::used_vertices;
use super::finish::finish;
use super::guide::Guide;
use super::handles::Steering;
use super::opening::straightened;
use super::registration::vertex_areas;
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::numeric::{Vec2, Vec3, sparse, wrap_angle};
use crate::warning::Warning;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Waves of the section along and around the tunnel that bones do not follow, as shares of the girth: 4 m and 1 m in a
/// tunnel of 25 m girth. Relief that is shorter is projected.
const SECTION_WAVES: [f64; 2] = [0.16, 0.04];

/// How the tunnel is skinned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// A new bone wherever the section has turned by this many degrees. Default 10.
    pub bone_turn_deg: f64,
    /// A file with handles that steer the map (docs/methods/deform_arap.md): CSV with `x, y, z` in scan coordinates and
    /// `u, v` (chainage, girth) in metres.
    pub handles: Option<PathBuf>,
}

impl Default for Settings {
    fn default() -> Self {
        Self { bone_turn_deg: 10.0, handles: None }
    }
}

/// Opens the tunnel by bones and projects it.
///
/// # Errors
/// [`Error::NeedsAxis`] without a guide; [`Error::Setting`]; [`Error::Handles`]; [`Error::Solve`].
pub fn flatten(strip: &Strip, guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    let guide = guide.ok_or(Error::NeedsAxis { method: "deform-skin" })?;
    let turn = settings.bone_turn_deg;
    if !(1.0..=90.0).contains(&turn) {
        return Err(Error::Setting { key: "deform-skin.bone_turn_deg", value: turn, must: "1 to 90 degrees" });
    }
    let solve_error = |e: sparse::Error| Error::Solve { method: "deform-skin", what: e.to_string() };
    let shapes = Shapes::of(strip.mesh());
    let straight = straightened(guide);
    let steering = Steering::of(strip, guide, "deform-skin")?;
    let section = MeanSection::of(strip, guide, &straight).map_err(solve_error)?;
    let bones = section.bones(turn.to_radians());
    let weights = section.weights(&bones).map_err(solve_error)?;
    let mut summary = SolveSummary { converged: weights.unsettled == 0, ..SolveSummary::default() };
    if weights.unsettled > 0 {
        summary.warnings.push(Warning::new(
            "not-converged",
            format!(
                "the bounds of {} of {} bone weights were still changing after {} rounds; they were cut off at 0 and 1",
                weights.unsettled,
                bones.len(),
                weights.rounds
            ),
        ));
    }
    let mut uv: Vec<Vec2> = guide
        .uv()
        .iter()
        .zip(&straight)
        .map(|(chart, q)| {
            let girths = bones.iter().zip(&weights.of).map(|(&bone, weight)| {
                let w = section.cage.at(weight, *chart);
                if w > 0.0 { section.follow(bone, *chart, q) * w } else { 0.0 }
            });
            Vec2::new(chart.x, girths.sum())
        })
        .collect();
    if let Some(steering) = &steering {
        uv.iter_mut().zip(&steering.displacement).for_each(|(p, d)| *p += d);
    }
    summary.figures.insert("bones".to_owned(), bones.len() as f64);
    summary.figures.insert("cage_nodes".to_owned(), section.cage.nodes() as f64);
    summary.figures.insert("active_set_rounds".to_owned(), weights.rounds as f64);
    if let Some(vertex) = uv.iter().position(|p| !(p.x.is_finite() && p.y.is_finite())) {
        return Err(Error::NotFinite { vertex: vertex as u32 });
    }
    finish(strip, &shapes, &mut uv, &mut summary);
    if let Some(steering) = &steering {
        summary.figures.insert("given_handles".to_owned(), steering.held.len() as f64);
        summary.figures.insert("given_handles_missed_by_m".to_owned(), steering.missed_by_m(&uv));
    }
    Ok((uv, summary))
}

/// The mean section on the cage.
struct MeanSection {
    cage: Cage,
    /// Mean (right, down) at each node.
    place: Vec<Vec2>,
    /// Direction of the section at each node, 0 at the crown, growing with the girth.
    direction: Vec<f64>,
}

impl MeanSection {
    fn of(strip: &Strip, guide: &Guide, straight: &[Vec3]) -> Result<Self, sparse::Error> {
        let used = used_vertices(straight.len(), strip.mesh().faces());
        let on_surface = || guide.uv().iter().enumerate().filter(|(v, _)| used[*v]);
        let cage = Cage::over(on_surface().map(|(_, p)| *p))?;
        let areas = vertex_areas(strip.mesh());
        let samples = on_surface().map(|(v, place)| Sample {
            place: *place,
            weight: areas[v],
            value: Vec2::new(straight[v].y, straight[v].z),
        });
        let girth = cage.step.y * (cage.columns - 1) as f64;
        let place = cage.smooth_field(samples, Vec2::from(SECTION_WAVES) * girth)?;
        let rows = place.chunks(cage.columns);
        let direction = rows.flat_map(|row| directions(row, cage.low.y, cage.step.y)).collect();
        Ok(Self { cage, place, direction })
    }

    /// Columns of the grid on which bones lie: ends, crown, and wherever the mean direction has turned enough.
    fn bones(&self, turn: f64) -> Vec<usize> {
        let Cage { rows, columns, low, step, .. } = &self.cage;
        let mean = |j: usize| (0..*rows).map(|i| self.direction[i * columns + j]).sum::<f64>() / *rows as f64;
        let crown = (-low.y / step.y).round().clamp(0.0, (columns - 1) as f64) as usize;
        let mut bones = vec![crown];
        let mut last = mean(crown);
        for j in crown + 1..*columns {
            if (mean(j) - last).abs() >= turn || j == columns - 1 {
                bones.push(j);
                last = mean(j);
            }
        }
        last = mean(crown);
        for j in (0..crown).rev() {
            if (mean(j) - last).abs() >= turn || j == 0 {
                bones.push(j);
                last = mean(j);
            }
        }
        bones.sort_unstable();
        bones.dedup();
        bones
    }

    /// Bounded biharmonic weights of the bones.
    fn weights(&self, bones: &[usize]) -> Result<super::cage::Weights, sparse::Error> {
        let nodes = |&bone: &usize| (0..self.cage.rows).map(|i| i * self.cage.columns + bone).collect();
        self.cage.weights(&bones.iter().map(nodes).collect::<Vec<Vec<usize>>>())
    }

    /// The girth to which the bone in column `bone` takes a straightened point.
    fn follow(&self, bone: usize, chart: Vec2, q: &Vec3) -> f64 {
        let girth = self.cage.low.y + self.cage.step.y * bone as f64;
        let on_bone = Vec2::new(chart.x, girth);
        let (sin, cos) = self.cage.at(&self.direction, on_bone).sin_cos();
        let d = Vec2::new(q.y, q.z) - self.cage.at(&self.place, on_bone);
        girth + cos * d.x + sin * d.y
    }
}

/// Directions of a section by central differences (of second order at the ends too), unwrapped outwards from the crown.
fn directions(section: &[Vec2], first_girth: f64, step: f64) -> Vec<f64> {
    let n = section.len();
    let crown = (-first_girth / step).round().clamp(0.0, (n - 1) as f64) as usize;
    let raw: Vec<f64> = (0..n)
        .map(|j| {
            let d = match j {
                0 => section[1] * 4.0 - section[0] * 3.0 - section[2],
                _ if j == n - 1 => section[n - 1] * 3.0 - section[n - 2] * 4.0 + section[n - 3],
                _ => section[j + 1] - section[j - 1],
            };
            d.y.atan2(d.x)
        })
        .collect();
    let mut unwrapped = raw.clone();
    for j in crown + 1..n {
        unwrapped[j] = unwrapped[j - 1] + wrap_angle(raw[j] - unwrapped[j - 1]);
    }
    for j in (0..crown).rev() {
        unwrapped[j] = unwrapped[j + 1] + wrap_angle(raw[j] - unwrapped[j + 1]);
    }
    unwrapped
}

#[cfg(test)]
mod tests {
    use super::super::distortion::{Distortion, flipped_faces};
    use super::super::{closed_form, handles::Handle};
    use super::*;

    fn guide(known: &closed_form::Known) -> Guide {
        Guide::of_strip(&known.strip, &known.axis, &Default::default()).unwrap()
    }

    #[test]
    fn a_cylinder_opens_to_its_girth() {
        let known = closed_form::full_cylinder();
        let (uv, summary) = flatten(&known.strip, Some(&guide(&known)), &Settings::default()).unwrap();
        assert!(summary.converged && summary.figures["bones"] >= 20.0, "{summary:?}");
        let farthest = uv.iter().zip(&known.flat).map(|(p, q)| (p - q).norm()).fold(0.0, f64::max);
        // Blended bones are not exact: within 0.2 % of the half girth of 12.6 m.
        assert!(farthest < 0.025, "{farthest}");
        assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);
        let stretch = Distortion::of(known.strip.mesh(), &uv).stretch;
        assert!(stretch.mean < 1.01 && stretch.max < 1.05, "{stretch:?}");
    }

    #[test]
    fn a_rough_bend_opens_without_flips() {
        let known = closed_form::rough(60, 60);
        let (uv, _) = flatten(&known.strip, Some(&guide(&known)), &Settings::default()).unwrap();
        assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);
    }

    #[test]
    fn given_handles_are_met() {
        let known = closed_form::rough(60, 60);
        let free = guide(&known);
        let (plain, _) = flatten(&known.strip, Some(&free), &Settings::default()).unwrap();
        let given = |v: usize, d: Vec2| Handle {
            given_in: format!("vertex {v}"),
            position_in_local: known.strip.mesh().vertices()[v],
            place_in_chart: free.uv()[v] + d,
        };
        let handles = [given(10 * 61 + 30, Vec2::new(0.3, 0.0)), given(50 * 61 + 30, Vec2::new(-0.3, 0.0))];
        let (uv, _) = flatten(&known.strip, Some(&free.clone().with_handles(&handles)), &Settings::default()).unwrap();
        assert!(((uv[10 * 61 + 30] - plain[10 * 61 + 30]).x - 0.3).abs() < 1e-3);
        assert!(((uv[50 * 61 + 30] - plain[50 * 61 + 30]).x + 0.3).abs() < 1e-3);
        assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);
    }

    #[test]
    fn a_handle_far_from_the_surface_is_refused_with_its_line() {
        let known = closed_form::prism();
        let handle =
            Handle { given_in: "h.csv:7".to_owned(), position_in_local: Vec3::zeros(), place_in_chart: Vec2::zeros() };
        let error = flatten(&known.strip, Some(&guide(&known).with_handles(&[handle])), &Settings::default());
        assert!(error.unwrap_err().to_string().starts_with("h.csv:7: "));
    }
}
