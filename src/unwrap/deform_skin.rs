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
//! | `Q = L M^-1 L` | biharmonic form on the cage |
//! | `c_b(u)`, `theta_b(u)` | place of bone `b` in the section at chainage `u`, and its direction there |
//!
//! The cage is a regular grid over the section chart. It carries the mean section (from the vertices, smoothed over about
//! a metre) and the weights. Bones run along the tunnel: the crown, the two ends, and outwards from the crown a new one
//! whenever the section has turned by `bone_turn_deg`, which puts bones on springlines and wall lines. Each bone is a chain
//! of rigid transforms: at chainage `u` it turns `theta_b(u)` back to horizontal and brings `c_b(u)` to its girth. Weights
//! minimize `w^T Q w` between the bounds (active set) and are normalized to sum to one, as in the paper's fast variant.
//! The bend is taken out first in closed form (chainage, right, up).
//!
//! Guarantees: finite; flips (relief that folds over when it is projected) are unfolded and counted. Needs the axis.
//! Departures: the cage is two-dimensional, because the surface is; bones are chains so that a section that changes along
//! the tunnel opens everywhere.
//! Cost: a few small factorizations on the cage, then linear in the vertices.

use super::finish::finish;
use super::guide::Guide;
use super::opening::straightened;
use super::triangle_shapes::Shapes;
use super::{Error, SolveSummary};
use crate::cut::Strip;
use crate::numeric::sparse::{self, Analysis, Cholesky, Pattern};
use crate::numeric::{Vec2, Vec3, wrap_angle};
use crate::warning::Warning;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Width of a cage cell around the tunnel and along it, metres.
const CELL_AROUND_M: f64 = 0.25;
const CELL_ALONG_M: f64 = 1.0;
/// Cage nodes at most; cells grow beyond.
const MOST_NODES: f64 = 12_000.0;
/// Passes of the (1 2 1) / 4 filter over the mean section.
const SMOOTHING: usize = 4;
/// Rounds of the active set at most; the bounds are rarely touched, two or three rounds are usual.
const MOST_ROUNDS: usize = 30;

/// How the tunnel is skinned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// A new bone wherever the section has turned by this many degrees. Default 15.
    pub bone_turn_deg: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { bone_turn_deg: 15.0 }
    }
}

/// Opens the tunnel by bones and projects it.
///
/// # Errors
/// [`Error::NeedsAxis`] without a guide; [`Error::Setting`]; [`Error::Solve`].
pub fn flatten(strip: &Strip, guide: Option<&Guide>, settings: &Settings) -> Result<(Vec<Vec2>, SolveSummary), Error> {
    let guide = guide.ok_or(Error::NeedsAxis { method: "deform-skin" })?;
    let turn = settings.bone_turn_deg;
    if !(1.0..=90.0).contains(&turn) {
        return Err(Error::Setting { key: "deform-skin.bone_turn_deg", value: turn, must: "1 to 90 degrees" });
    }
    let solve_error = |e: sparse::Error| Error::Solve { method: "deform-skin", what: e.to_string() };
    let shapes = Shapes::of(strip.mesh());
    let straight = straightened(guide);
    let cage = Cage::new(guide.uv(), &straight);
    let bones = cage.bones(turn.to_radians());
    let mut summary = SolveSummary::direct();
    let weights = cage.weights(&bones, &mut summary).map_err(solve_error)?;
    let mut uv: Vec<Vec2> = guide
        .uv()
        .iter()
        .zip(&straight)
        .map(|(chart, q)| {
            let mut place = Vec2::zeros();
            for (&bone, weight) in bones.iter().zip(&weights) {
                let w = cage.interpolate(weight, *chart);
                if w > 0.0 {
                    place += cage.follow(bone, chart.x, q) * w;
                }
            }
            Vec2::new(chart.x, place.x)
        })
        .collect();
    summary.figures.insert("bones".to_owned(), bones.len() as f64);
    summary.figures.insert("cage_nodes".to_owned(), (cage.rows * cage.columns) as f64);
    summary.figures.insert("empty_cage_nodes".to_owned(), cage.empty as f64);
    if let Some(vertex) = uv.iter().position(|p| !(p.x.is_finite() && p.y.is_finite())) {
        return Err(Error::NotFinite { vertex: vertex as u32 });
    }
    finish(strip, &shapes, &mut uv, &mut summary);
    Ok((uv, summary))
}

/// A grid over the section chart with the mean section at its nodes.
struct Cage {
    low: Vec2,
    step: Vec2,
    /// Nodes along the tunnel.
    rows: usize,
    /// Nodes around it.
    columns: usize,
    /// Mean (right, down) at each node.
    section: Vec<Vec2>,
    /// Direction of the section at each node, 0 at the crown, growing with the girth.
    direction: Vec<f64>,
    /// Nodes that no vertex was near; filled from their row.
    empty: usize,
}

impl Cage {
    fn new(uv: &[Vec2], straight: &[Vec3]) -> Self {
        let low = uv.iter().fold(uv[0], |b, p| b.inf(p));
        let high = uv.iter().fold(uv[0], |b, p| b.sup(p));
        let extent = high - low;
        let grow = (extent.x / CELL_ALONG_M * extent.y / CELL_AROUND_M / MOST_NODES).sqrt().max(1.0);
        let cells = |length: f64, cell: f64| (length / (cell * grow)).ceil().max(2.0);
        let cells = Vec2::new(cells(extent.x, CELL_ALONG_M), cells(extent.y, CELL_AROUND_M));
        let step = extent.component_div(&cells).map(|s| s.max(f64::MIN_POSITIVE));
        let (rows, columns) = (cells.x as usize + 1, cells.y as usize + 1);
        // Spread each vertex over the four nodes around it.
        let mut sum = vec![(Vec2::zeros(), 0.0); rows * columns];
        let mut cage = Self { low, step, rows, columns, section: Vec::new(), direction: Vec::new(), empty: 0 };
        for (p, q) in uv.iter().zip(straight) {
            for (node, w) in cage.corners(*p) {
                sum[node].0 += Vec2::new(q.y, q.z) * w;
                sum[node].1 += w;
            }
        }
        cage.empty = sum.iter().filter(|s| s.1 <= 0.0).count();
        let mut section: Vec<Option<Vec2>> = sum.iter().map(|(s, w)| (*w > 0.0).then(|| s / *w)).collect();
        fill_rows(&mut section, rows, columns);
        let mut section: Vec<Vec2> = section.into_iter().map(|s| s.unwrap_or_else(Vec2::zeros)).collect();
        for _ in 0..SMOOTHING {
            smooth(&mut section, rows, columns, true);
            smooth(&mut section, rows, columns, false);
        }
        cage.direction =
            (0..rows).flat_map(|row| directions(&section[row * columns..(row + 1) * columns], low.y, step.y)).collect();
        cage.section = section;
        cage
    }

    /// The four nodes around a place in the chart and their bilinear weights.
    fn corners(&self, p: Vec2) -> [(usize, f64); 4] {
        let at = (p - self.low).component_div(&self.step);
        let clamp = |x: f64, n: usize| x.clamp(0.0, (n - 1) as f64);
        let (x, y) = (clamp(at.x, self.rows), clamp(at.y, self.columns));
        let (i, j) = ((x as usize).min(self.rows - 2), (y as usize).min(self.columns - 2));
        let (s, t) = (x - i as f64, y - j as f64);
        let node = |i: usize, j: usize| i * self.columns + j;
        [
            (node(i, j), (1.0 - s) * (1.0 - t)),
            (node(i, j + 1), (1.0 - s) * t),
            (node(i + 1, j), s * (1.0 - t)),
            (node(i + 1, j + 1), s * t),
        ]
    }

    fn interpolate(&self, values: &[f64], p: Vec2) -> f64 {
        self.corners(p).iter().map(|&(node, w)| values[node] * w).sum()
    }

    /// Columns of the grid on which bones lie: ends, crown, and wherever the mean direction has turned enough.
    fn bones(&self, turn: f64) -> Vec<usize> {
        let mean =
            |j: usize| (0..self.rows).map(|i| self.direction[i * self.columns + j]).sum::<f64>() / self.rows as f64;
        let crown = (-self.low.y / self.step.y).round().clamp(0.0, (self.columns - 1) as f64) as usize;
        let mut bones = vec![crown];
        let mut last = mean(crown);
        for j in crown + 1..self.columns {
            if (mean(j) - last).abs() >= turn || j == self.columns - 1 {
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

    /// Where the bone in column `bone` takes a straightened point at chainage `u`: (girth, height).
    fn follow(&self, bone: usize, u: f64, q: &Vec3) -> Vec2 {
        let x = ((u - self.low.x) / self.step.x).clamp(0.0, (self.rows - 1) as f64);
        let i = (x as usize).min(self.rows - 2);
        let s = x - i as f64;
        let (a, b) = (i * self.columns + bone, (i + 1) * self.columns + bone);
        let place = self.section[a] * (1.0 - s) + self.section[b] * s;
        let angle = self.direction[a] * (1.0 - s) + self.direction[b] * s;
        let (sin, cos) = angle.sin_cos();
        let d = Vec2::new(q.y, q.z) - place;
        let girth = self.low.y + self.step.y * bone as f64;
        Vec2::new(girth + cos * d.x + sin * d.y, cos * d.y - sin * d.x)
    }

    /// Bounded biharmonic weights of the bones at the nodes, summing to one.
    fn weights(&self, bones: &[usize], summary: &mut SolveSummary) -> Result<Vec<Vec<f64>>, sparse::Error> {
        let (rows, columns, n) = (self.rows, self.columns, self.rows * self.columns);
        let node = |i: usize, j: usize| (i * columns + j) as u32;
        // Five-point Laplacian with natural ends, in metres.
        let stencil = |i: usize, j: usize| {
            let (along, around) = (1.0 / (self.step.x * self.step.x), 1.0 / (self.step.y * self.step.y));
            let mut row: Vec<(u32, f64)> = Vec::with_capacity(5);
            let mut middle = 0.0;
            let mut add = |at: u32, k: f64| {
                row.push((at, -k));
                middle += k;
            };
            if i > 0 {
                add(node(i - 1, j), along);
            }
            if i + 1 < rows {
                add(node(i + 1, j), along);
            }
            if j > 0 {
                add(node(i, j - 1), around);
            }
            if j + 1 < columns {
                add(node(i, j + 1), around);
            }
            row.push((node(i, j), middle));
            row
        };
        let grid = || (0..rows).flat_map(|i| (0..columns).map(move |j| (i, j)));
        let pairs = || {
            grid().flat_map(|(i, j)| {
                let row = stencil(i, j);
                let all: Vec<(u32, u32)> =
                    row.iter().flat_map(|a| row.iter().map(move |b| (a.0, b.0))).filter(|(a, b)| a < b).collect();
                all
            })
        };
        let pattern = Pattern::of_pairs(n, pairs)?;
        let mut form = vec![0.0; pattern.entries()];
        for (i, j) in grid() {
            let row = stencil(i, j);
            for (a, p) in &row {
                for (b, q) in row.iter().filter(|(b, _)| b <= a) {
                    form[pattern.slot(*a, *b).expect("in the pattern")] += p * q;
                }
            }
        }
        let analysis = Analysis::new(&pattern)?;
        let mut rounds_needed = 0;
        let mut unsettled = 0;
        let mut weights = Vec::with_capacity(bones.len());
        for &bone in bones {
            let mut fixed: Vec<Option<f64>> = vec![None; n];
            for &other in bones {
                for i in 0..rows {
                    fixed[node(i, other) as usize] = Some(if other == bone { 1.0 } else { 0.0 });
                }
            }
            let on_bone = fixed.clone();
            let mut weight = Vec::new();
            let mut settled = false;
            for round in 1..=MOST_ROUNDS {
                let (mut values, mut right) = (form.clone(), vec![0.0; n]);
                pattern.fix_unknowns(&mut values, &mut right, |v| fixed[v]);
                Cholesky::new(&pattern, &analysis, &values)?.solve_in_place(&mut right);
                weight = right;
                let force = pattern.multiply(&form, &weight);
                let mut changed = false;
                for v in 0..n {
                    if on_bone[v].is_some() {
                        continue;
                    }
                    match fixed[v] {
                        None if weight[v] < -1e-9 => (fixed[v], changed) = (Some(0.0), true),
                        None if weight[v] > 1.0 + 1e-9 => (fixed[v], changed) = (Some(1.0), true),
                        // A bound that pulls instead of pushing is let go; early rounds only, so that it cannot cycle.
                        Some(bound) if round < MOST_ROUNDS / 2 && force[v] * (0.5 - bound) < 0.0 => {
                            (fixed[v], changed) = (None, true);
                        }
                        _ => {}
                    }
                }
                rounds_needed = rounds_needed.max(round);
                if !changed {
                    settled = true;
                    break;
                }
            }
            unsettled += usize::from(!settled);
            weight.iter_mut().for_each(|w| *w = w.clamp(0.0, 1.0));
            weights.push(weight);
        }
        for v in 0..n {
            let sum: f64 = weights.iter().map(|w| w[v]).sum();
            if sum > 0.0 {
                weights.iter_mut().for_each(|w| w[v] /= sum);
            }
        }
        summary.figures.insert("active_set_rounds".to_owned(), rounds_needed as f64);
        summary.converged = unsettled == 0;
        if unsettled > 0 {
            summary.warnings.push(Warning::new(
                "not-converged",
                format!(
                    "the bounds of {unsettled} of {} bone weights were still changing after {MOST_ROUNDS} rounds; they \
                     were cut off at 0 and 1",
                    bones.len()
                ),
            ));
        }
        Ok(weights)
    }
}

/// Empty nodes take the value interpolated between the nearest filled ones of their row, or of the row before.
fn fill_rows(section: &mut [Option<Vec2>], rows: usize, columns: usize) {
    let order = (0..rows).chain((0..rows).rev());
    for row in order {
        let filled: Vec<usize> = (0..columns).filter(|j| section[row * columns + j].is_some()).collect();
        if filled.is_empty() {
            let from = if row > 0 { row - 1 } else { row + 1 };
            for j in 0..columns {
                section[row * columns + j] = section[from * columns + j];
            }
            continue;
        }
        for j in 0..columns {
            let at = row * columns + j;
            if section[at].is_none() {
                let after = filled.partition_point(|&f| f < j);
                let pick = |k: usize| section[row * columns + filled[k]];
                section[at] = match (after.checked_sub(1), after < filled.len()) {
                    (Some(b), true) => {
                        let share = (j - filled[b]) as f64 / (filled[after] - filled[b]) as f64;
                        pick(b).zip(pick(after)).map(|(p, q)| p * (1.0 - share) + q * share)
                    }
                    (Some(b), false) => pick(b),
                    (None, _) => pick(after),
                };
            }
        }
    }
}

/// One pass of (1 2 1) / 4 along or around; ends keep their value, so that the section does not shrink there.
fn smooth(section: &mut [Vec2], rows: usize, columns: usize, along: bool) {
    let old = section.to_vec();
    let (stride, count, lines) = if along { (columns, rows, columns) } else { (1, columns, rows) };
    for line in 0..lines {
        let first = if along { line } else { line * columns };
        for k in 1..count.saturating_sub(1) {
            let at = first + k * stride;
            section[at] = (old[at - stride] + old[at] * 2.0 + old[at + stride]) / 4.0;
        }
    }
}

/// Directions of a section by central differences, unwrapped outwards from the crown.
fn directions(section: &[Vec2], first_girth: f64, step: f64) -> Vec<f64> {
    let n = section.len();
    let crown = (-first_girth / step).round().clamp(0.0, (n - 1) as f64) as usize;
    let raw: Vec<f64> = (0..n)
        .map(|j| {
            let d = section[(j + 1).min(n - 1)] - section[j.saturating_sub(1)];
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
    use super::super::{closed_form, distortion::flipped_faces};
    use super::*;

    fn guide(known: &closed_form::Known) -> Guide {
        Guide::of_strip(&known.strip, &known.axis, &Default::default()).unwrap()
    }

    #[test]
    fn a_cylinder_opens_to_its_girth() {
        let known = closed_form::full_cylinder();
        let (uv, summary) = flatten(&known.strip, Some(&guide(&known)), &Settings::default()).unwrap();
        assert!(summary.converged && summary.figures["bones"] >= 20.0, "{summary:?}");
        for (p, q) in uv.iter().zip(&known.flat) {
            // Blended bones are not exact: within 1.5 % of the half girth.
            assert!((p - q).norm() < 0.12, "{p} {q}");
        }
        assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);
    }

    #[test]
    fn weights_are_bounded_and_sum_to_one() {
        let known = closed_form::rough(40, 40);
        let guide = guide(&known);
        let cage = Cage::new(guide.uv(), &straightened(&guide));
        let bones = cage.bones(0.5);
        let weights = cage.weights(&bones, &mut SolveSummary::default()).unwrap();
        for v in 0..cage.rows * cage.columns {
            assert!((weights.iter().map(|w| w[v]).sum::<f64>() - 1.0).abs() < 1e-12);
        }
        for (bone, weight) in bones.iter().zip(&weights) {
            assert!(weight.iter().all(|w| (0.0..=1.0).contains(w)));
            assert!((weight[*bone] - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn a_rough_bend_opens_without_flips() {
        let known = closed_form::rough(60, 60);
        let (uv, _) = flatten(&known.strip, Some(&guide(&known)), &Settings::default()).unwrap();
        assert_eq!(flipped_faces(known.strip.mesh(), &uv).0, 0);
    }
}
