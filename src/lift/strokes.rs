//! Thin strokes on a label map become polylines along their middle; broad patches become areas.
//!
//! For each class: pieces that touch (eight neighbours) are taken apart; a piece whose greatest inscribed width is at most
//! `max_width_m` and that is longer than three widths is a stroke, any other is an area. A stroke is thinned to a line one
//! pixel wide that keeps its topology (Z. Guo and R. W. Hall, "Parallel thinning with two-subiteration algorithms", 1989,
//! doi:10.1145/62065.62074, algorithm A1), the line is cut at its junctions, twigs shorter than the stroke is wide are
//! dropped, and at each junction the two branches that continue each other most straightly are joined: two crossing
//! strokes stay two lines. The steps of the pixels are smoothed and the line simplified to `tolerance_px`.
//!
//! Departures: ends are lengthened to the end of the stroke, which thinning shortens by half a width. Areas are told by
//! the pixels' outline. Cost: linear in the pixels of the bounding boxes of the pieces, times the width.

use super::label_map::{LabelMap, NO_SURFACE};
use crate::cloud::Label;
use crate::linework::{Feature, Kind, Value};
use crate::map::PaletteEntry;
use crate::numeric::{Vec2, Vec3};
use serde::Serialize;
use std::collections::BTreeMap;

/// How strokes are told from areas, and how lines are simplified.
#[derive(Clone, Debug, PartialEq)]
pub struct StrokeSettings {
    /// Strokes are at most this wide, metres; what is broader is an area.
    pub max_width_m: f64,
    /// Strokes and areas with fewer pixels are specks; they are counted and left out.
    pub least_px: usize,
    /// How far the line may be from the middle of the pixels, pixels.
    pub tolerance_px: f64,
    /// Strokes of one class that continue each other over a gap of at most this, metres, are one: another stroke was
    /// painted over them there.
    pub gap_m: f64,
}

impl Default for StrokeSettings {
    fn default() -> Self {
        Self { max_width_m: 0.12, least_px: 12, tolerance_px: 0.6, gap_m: 0.15 }
    }
}

/// What was found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StrokeSummary {
    /// Polylines.
    pub strokes: usize,
    /// Areas.
    pub areas: usize,
    /// Pieces too small to mean anything.
    pub specks: usize,
    /// Twigs of the middle lines that were dropped.
    pub twigs: usize,
    /// Gaps that were closed.
    pub gaps: usize,
}

/// A branch joins another across a junction when it bends less than this there: cosine of 50 degrees.
const STRAIGHT_ON: f64 = 0.64;
/// Pixels over which the direction of a branch at its end is taken.
const DIRECTION_PX: usize = 12;
/// Strokes continue each other over a gap when both bend less than this there: cosine of 25 degrees.
const FACING: f64 = 0.9;
/// Gaps may be so many times longer than others where they are painted over.
const COVERED: f64 = 6.0;
/// Half the window, in pixels, over which pixel steps are smoothed.
const SMOOTHING_PX: usize = 4;

/// A middle line in pixels of the map.
struct Stroke {
    label: Label,
    width_px: f64,
    line: Vec<Vec2>,
}

/// The outlines of a broad piece in pixels of the map.
struct Patch {
    label: Label,
    width_px: f64,
    rings: Vec<Vec<Vec2>>,
}

/// A line of a list and which of its ends: 0 its first vertex, 1 its last.
type End = (usize, usize);

/// Lines and areas of all classes but 0, on the map; `classes` gives their names.
pub fn strokes(map: &LabelMap, classes: &[PaletteEntry], settings: &StrokeSettings) -> (Vec<Feature>, StrokeSummary) {
    let mut summary = StrokeSummary::default();
    let cell = map.placement.step_u.abs();
    let (mut lines, mut areas): (Vec<Stroke>, Vec<Patch>) = (Vec::new(), Vec::new());
    for piece in pieces(map) {
        if piece.pixels < settings.least_px {
            summary.specks += 1;
            continue;
        }
        let mask = Mask::of(map, &piece);
        let depth = mask.depth();
        let half_width = f64::from(depth.iter().copied().max().unwrap_or(0));
        let width_px = mask.greatest_width(&depth);
        let length_px = piece.pixels as f64 / width_px.max(1.0);
        let in_map = |p: &Vec2| p + Vec2::new(piece.left as f64 - 1.0, piece.top as f64 - 1.0);
        if width_px * cell <= settings.max_width_m && length_px > 3.0 * width_px {
            let (found, twigs) = middle_lines(&mask, half_width);
            summary.twigs += twigs;
            for line in found {
                let long = lengthened(&smoothed(&line), &mask, half_width);
                let line = simplified(&long, settings.tolerance_px).iter().map(in_map).collect();
                lines.push(Stroke { label: piece.label, width_px, line });
            }
        } else {
            let rings = mask.outlines().iter().map(|ring| ring.iter().map(in_map).collect()).collect();
            areas.push(Patch { label: piece.label, width_px, rings });
        }
    }
    let is_painted = |p: Vec2| {
        let (x, y) = (p.x.floor(), p.y.floor());
        let inside = x >= 0.0 && y >= 0.0 && x < map.width as f64 && y < map.height as f64;
        inside && !matches!(map.labels[y as usize * map.width + x as usize], 0 | NO_SURFACE)
    };
    summary.gaps = close_gaps(&mut lines, settings.gap_m / cell, &is_painted);
    (summary.strokes, summary.areas) = (lines.len(), areas.len());
    let feature = |class: &str, id: usize, kind: Kind, label: Label, width_px: f64, parts: Vec<Vec<Vec2>>| {
        let on_map = |p: &Vec2| {
            let uv = map.placement.chart_from_pixel(*p);
            Vec3::new(uv.x, uv.y, 0.0)
        };
        let name = classes.iter().find(|c| c.value == label).map_or_else(String::new, |c| c.name.clone());
        Feature {
            class: class.to_owned(),
            id: Some(id as i64 + 1),
            attributes: vec![
                ("label".into(), Value::Integer(i64::from(label))),
                ("name".into(), Value::Text(name)),
                ("stroke_width_m".into(), Value::Real(width_px * cell)),
            ],
            kind,
            parts: parts.iter().map(|part| part.iter().map(on_map).collect()).collect(),
        }
    };
    let lines = lines.into_iter().enumerate();
    let mut features: Vec<Feature> =
        lines.map(|(i, s)| feature("traces", i, Kind::Line, s.label, s.width_px, vec![s.line])).collect();
    let areas = areas.into_iter().enumerate();
    features.extend(areas.map(|(i, p)| feature("patches", i, Kind::Area, p.label, p.width_px, p.rings)));
    (features, summary)
}

/// Joins strokes of one class whose ends face each other over a gap, the narrowest gap first; how many were closed.
///
/// Where strokes cross at a small angle, the one below ends in two wedges along the other, one on each of its sides: their
/// tips lie beside each other, up to a width apart, and may overlap. Longer gaps are closed where other strokes cover them.
fn close_gaps(strokes: &mut Vec<Stroke>, longest_px: f64, is_painted: &dyn Fn(Vec2) -> bool) -> usize {
    let mut closed = 0;
    loop {
        let ends: Vec<[(Vec2, Vec2); 2]> = strokes.iter().map(|s| [end_of(&s.line, 0), end_of(&s.line, 1)]).collect();
        let mut best: Option<(f64, End, End)> = None;
        for i in 0..strokes.len() {
            for j in i + 1..strokes.len() {
                if strokes[i].label != strokes[j].label {
                    continue;
                }
                let width = strokes[i].width_px.max(strokes[j].width_px).max(1.0);
                for (e, f) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    let ((p, out), (q, other)) = (ends[i][e], ends[j][f]);
                    let gap = (q - p).norm();
                    if -out.dot(&other) < FACING || gap > COVERED * longest_px || best.is_some_and(|b| gap >= b.0) {
                        continue;
                    }
                    let along = out.dot(&(q - p));
                    let beside = (q - p - out * along).norm();
                    let faces = along >= FACING * gap || (along >= -2.0 * width && beside <= 1.5 * width + 2.0);
                    let covered = || {
                        let steps = gap.ceil().max(1.0);
                        // The tips themselves may lie on the very edge of what is painted.
                        let (tip, end) = (width.ceil() as usize, steps as usize);
                        (tip..end.saturating_sub(tip)).all(|k| is_painted(p + (q - p) * (k as f64 / steps)))
                    };
                    if faces && (gap <= longest_px || covered()) {
                        best = Some((gap, (i, e), (j, f)));
                    }
                }
            }
        }
        let Some((_, (i, e), (j, f))) = best else { return closed };
        let ((p, out), (q, _)) = (ends[i][e], ends[j][f]);
        let along = out.dot(&(q - p));
        // Tips beside each other: both lines are taken back until they meet without a bend.
        let back = (q - p - out * along).norm() + (-along).max(0.0);
        let mut other = strokes.remove(j).line;
        let line = &mut strokes[i].line;
        if e == 0 {
            line.reverse();
        }
        if f == 1 {
            other.reverse();
        }
        shorten(line, back);
        other.reverse();
        shorten(&mut other, back);
        other.reverse();
        line.append(&mut other);
        closed += 1;
    }
}

/// An end of a line and the direction in which the line leaves there, over some pixels.
fn end_of(line: &[Vec2], end: usize) -> (Vec2, Vec2) {
    let at = |k: usize| if end == 0 { line[k] } else { line[line.len() - 1 - k] };
    let last = at(0);
    let from = (1..line.len()).map(at).find(|p| (last - p).norm() >= DIRECTION_PX as f64);
    let direction = last - from.unwrap_or_else(|| at(line.len() - 1));
    (last, direction.try_normalize(0.0).unwrap_or_else(Vec2::zeros))
}

/// Takes a length off the end of a line, at most to the middle of its last but one vertex and its first.
fn shorten(line: &mut Vec<Vec2>, length: f64) {
    let mut left = length;
    while line.len() > 2 {
        let (last, before) = (line[line.len() - 1], line[line.len() - 2]);
        let piece = (last - before).norm();
        if piece > left {
            let end = line.len() - 1;
            line[end] = last + (before - last) * (left / piece);
            return;
        }
        left -= piece;
        line.pop();
    }
    if let [first, last] = &mut line[..] {
        let piece = (*last - *first).norm();
        *last += (*first - *last) * (left / piece.max(1e-12)).min(0.5);
    }
}

/// A connected piece of one class and the box around it.
struct Piece {
    label: Label,
    pixels: usize,
    first: usize,
    left: usize,
    top: usize,
    right: usize,
    bottom: usize,
}

fn pieces(map: &LabelMap) -> Vec<Piece> {
    let (w, h) = (map.width, map.height);
    let mut seen = vec![false; w * h];
    let mut found = Vec::new();
    let mut stack = Vec::new();
    for start in 0..w * h {
        let label = map.labels[start];
        if label == 0 || label == NO_SURFACE || seen[start] {
            continue;
        }
        let mut piece = Piece { label, pixels: 0, first: start, left: w, top: h, right: 0, bottom: 0 };
        seen[start] = true;
        stack.push(start);
        while let Some(i) = stack.pop() {
            let (x, y) = (i % w, i / w);
            piece.pixels += 1;
            (piece.left, piece.right) = (piece.left.min(x), piece.right.max(x));
            (piece.top, piece.bottom) = (piece.top.min(y), piece.bottom.max(y));
            for ny in y.saturating_sub(1)..(y + 2).min(h) {
                for nx in x.saturating_sub(1)..(x + 2).min(w) {
                    let n = ny * w + nx;
                    if !seen[n] && map.labels[n] == label {
                        seen[n] = true;
                        stack.push(n);
                    }
                }
            }
        }
        found.push(piece);
    }
    found
}

/// The pixels of a piece with a margin of one empty pixel.
struct Mask {
    width: usize,
    height: usize,
    set: Vec<bool>,
}

/// The eight neighbours of a pixel, clockwise from above.
const AROUND: [(isize, isize); 8] = [(0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1)];

impl Mask {
    fn of(map: &LabelMap, piece: &Piece) -> Self {
        let (width, height) = (piece.right - piece.left + 3, piece.bottom - piece.top + 3);
        let mut mask = Self { width, height, set: vec![false; width * height] };
        let at = |i: usize| (i / map.width - piece.top + 1) * width + (i % map.width - piece.left + 1);
        let mut stack = vec![piece.first];
        mask.set[at(piece.first)] = true;
        // Only this piece: another of the class may lie in the same box.
        while let Some(i) = stack.pop() {
            let (x, y) = (i % map.width, i / map.width);
            for ny in y.saturating_sub(1)..(y + 2).min(map.height) {
                for nx in x.saturating_sub(1)..(x + 2).min(map.width) {
                    let n = ny * map.width + nx;
                    if map.labels[n] == piece.label && !mask.set[at(n)] {
                        mask.set[at(n)] = true;
                        stack.push(n);
                    }
                }
            }
        }
        mask
    }

    fn neighbour(&self, i: usize, k: usize) -> usize {
        let (dx, dy) = AROUND[k];
        (i as isize + dy * self.width as isize + dx) as usize
    }

    fn neighbours(&self, i: usize) -> impl Iterator<Item = usize> + '_ {
        (0..8).map(move |k| self.neighbour(i, k)).filter(|&n| self.set[n])
    }

    fn centre(&self, i: usize) -> Vec2 {
        Vec2::new((i % self.width) as f64 + 0.5, (i / self.width) as f64 + 0.5)
    }

    /// Steps to the nearest empty pixel, diagonal steps counting one: half the width of the piece at its middle.
    fn depth(&self) -> Vec<u32> {
        let mut depth: Vec<u32> = self.set.iter().map(|&s| if s { u32::MAX / 2 } else { 0 }).collect();
        let w = self.width;
        for i in (w + 1)..self.set.len().saturating_sub(w + 1) {
            if self.set[i] {
                let near = depth[i - 1].min(depth[i - w]).min(depth[i - w - 1]).min(depth[i - w + 1]);
                depth[i] = depth[i].min(near + 1);
            }
        }
        for i in ((w + 1)..self.set.len().saturating_sub(w + 1)).rev() {
            if self.set[i] {
                let near = depth[i + 1].min(depth[i + w]).min(depth[i + w + 1]).min(depth[i + w - 1]);
                depth[i] = depth[i].min(near + 1);
            }
        }
        depth
    }

    /// The width of the piece in pixels: twice the depth that all but the deepest hundredth keep to (where strokes cross
    /// they are broader).
    fn greatest_width(&self, depth: &[u32]) -> f64 {
        let mut ridge: Vec<u32> = (0..self.set.len())
            .filter(|&i| self.set[i] && (0..8).all(|k| depth[self.neighbour(i, k)] <= depth[i]))
            .map(|i| depth[i])
            .collect();
        ridge.sort_unstable();
        let at = (ridge.len() as f64 * 0.95).floor() as usize;
        ridge.get(at.min(ridge.len().saturating_sub(1))).map_or(0.0, |&d| 2.0 * f64::from(d) - 1.0)
    }

    /// Guo and Hall's thinning: the middle of the piece, one pixel wide.
    fn thinned(&self) -> Mask {
        let mut thin = Mask { width: self.width, height: self.height, set: self.set.clone() };
        let mut active: Vec<usize> = (0..thin.set.len()).filter(|&i| thin.set[i]).collect();
        loop {
            let mut removed = 0;
            for pass in 0..2 {
                let gone: Vec<usize> = active.iter().copied().filter(|&i| thin.may_go(i, pass)).collect();
                gone.iter().for_each(|&i| thin.set[i] = false);
                removed += gone.len();
                active.retain(|&i| thin.set[i]);
            }
            if removed == 0 {
                return thin;
            }
        }
    }

    fn may_go(&self, i: usize, pass: usize) -> bool {
        let p: [bool; 8] = std::array::from_fn(|k| self.set[self.neighbour(i, k)]);
        // p[0] is north, then clockwise; the paper's p2 ... p9.
        let (n, ne, e, se, s, sw, w, nw) = (p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7]);
        let count = |terms: [bool; 4]| terms.into_iter().filter(|t| *t).count();
        let components = count([!n && (ne || e), !e && (se || s), !s && (sw || w), !w && (nw || n)]);
        let first = count([nw || n, ne || e, se || s, sw || w]);
        let second = count([n || ne, e || se, s || sw, w || nw]);
        let border = if pass == 0 { (n || ne || !se) && e } else { (s || sw || !nw) && w };
        components == 1 && (2..=3).contains(&first.min(second)) && !border
    }

    /// The outer outline and those of holes along the edges of pixels, closed, simplified where they run straight.
    fn outlines(&self) -> Vec<Vec<Vec2>> {
        // Directed edges with the piece on their right (rows run down): from grid corner to grid corner.
        let columns = self.width + 1;
        let mut next: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for i in (0..self.set.len()).filter(|&i| self.set[i]) {
            let (x, y) = (i % self.width, i / self.width);
            let corner = |dx: usize, dy: usize| (y + dy) * columns + x + dx;
            for (k, from, to) in [
                (0, corner(0, 0), corner(1, 0)),
                (2, corner(1, 0), corner(1, 1)),
                (4, corner(1, 1), corner(0, 1)),
                (6, corner(0, 1), corner(0, 0)),
            ] {
                if !self.set[self.neighbour(i, k)] {
                    next.entry(from).or_default().push(to);
                }
            }
        }
        let mut rings = Vec::new();
        while let Some((&start, _)) = next.iter().find(|(_, to)| !to.is_empty()) {
            let mut ring = vec![start];
            let mut at = start;
            while let Some(to) = next.get_mut(&at).and_then(Vec::pop) {
                ring.push(to);
                at = to;
                if at == start {
                    break;
                }
            }
            let places: Vec<Vec2> =
                ring.iter().map(|c| Vec2::new((c % columns) as f64, (c / columns) as f64)).collect();
            let half = places.len() / 2;
            let mut simple = simplified(&places[..=half], 0.75);
            simple.extend(simplified(&places[half..], 0.75).into_iter().skip(1));
            rings.push(simple);
            next.retain(|_, to| !to.is_empty());
        }
        // The outer ring is the one with the greatest area.
        let area = |ring: &Vec<Vec2>| ring.windows(2).map(|w| w[0].perp(&w[1])).sum::<f64>().abs();
        rings.sort_by(|a, b| area(b).total_cmp(&area(a)));
        rings.retain(|ring| ring.len() > 3);
        rings
    }
}

/// The lines along the middle of a stroke, and the number of twigs that were dropped.
fn middle_lines(mask: &Mask, half_width: f64) -> (Vec<Vec<Vec2>>, usize) {
    let thin = mask.thinned();
    let degree = |i: usize| thin.neighbours(i).count();
    let pixels: Vec<usize> = (0..thin.set.len()).filter(|&i| thin.set[i]).collect();
    // Junctions: clusters of touching pixels with more than two neighbours.
    let mut junction: BTreeMap<usize, usize> = BTreeMap::new();
    let mut centres: Vec<Vec2> = Vec::new();
    for &i in &pixels {
        if degree(i) < 3 || junction.contains_key(&i) {
            continue;
        }
        let (mut stack, mut members) = (vec![i], Vec::new());
        junction.insert(i, centres.len());
        while let Some(j) = stack.pop() {
            members.push(j);
            for n in thin.neighbours(j).filter(|&n| degree(n) >= 3) {
                if junction.insert(n, centres.len()).is_none() {
                    stack.push(n);
                }
            }
        }
        centres.push(members.iter().map(|&m| thin.centre(m)).sum::<Vec2>() / members.len() as f64);
    }
    // Branches between junctions and ends.
    let mut used = vec![false; thin.set.len()];
    let mut branches: Vec<Branch> = Vec::new();
    let mut starts: Vec<(usize, Option<usize>)> = pixels
        .iter()
        .filter(|i| !junction.contains_key(i))
        .flat_map(|&i| {
            let touching: Vec<usize> = thin.neighbours(i).filter_map(|n| junction.get(&n).copied()).collect();
            if touching.is_empty() && degree(i) <= 1 {
                vec![(i, None)]
            } else {
                touching.into_iter().map(|j| (i, Some(j))).collect()
            }
        })
        .collect();
    // Closed lines have neither; they start anywhere.
    starts.extend(pixels.iter().filter(|i| !junction.contains_key(i)).map(|&i| (i, None)));
    for (start, from) in starts {
        if used[start] {
            continue;
        }
        let (mut line, mut at, mut to) = (vec![thin.centre(start)], start, None);
        used[start] = true;
        loop {
            let onward = thin.neighbours(at).find(|n| !used[*n] && !junction.contains_key(n));
            // The junction that the line comes from does not end it at once.
            let met = thin
                .neighbours(at)
                .filter_map(|n| junction.get(&n).copied())
                .find(|&j| line.len() > 3 || Some(j) != from);
            match (met, onward) {
                (Some(j), _) if line.len() > 1 || onward.is_none() => {
                    to = Some(j);
                    break;
                }
                (_, Some(n)) => {
                    used[n] = true;
                    line.push(thin.centre(n));
                    at = n;
                }
                _ => break,
            }
        }
        // A line that came back to its beginning is closed.
        if from.is_none() && to.is_none() && line.len() > 4 && (line[0] - line[line.len() - 1]).norm() < 1.5 {
            line.push(line[0]);
        }
        if let Some(j) = from {
            line.insert(0, centres[j]);
        }
        if let Some(j) = to {
            line.push(centres[j]);
        }
        branches.push(Branch { line, ends: [from, to] });
    }
    let before = branches.len();
    let twig = (1.5 * half_width + 1.0).max(3.0);
    branches.retain(|b| {
        b.ends.iter().all(Option::is_some) || b.ends.iter().all(Option::is_none) || b.line.len() as f64 > twig + 1.0
    });
    let twigs = before - branches.len();
    let branches = without_bridges(branches, centres.len(), 4.0 * half_width + 2.0);
    (joined(branches, centres.len(), half_width.ceil() as usize), twigs)
}

/// Where two broad strokes cross, their middle lines share a short bridge between two junctions: it is taken away and the
/// junctions become one.
fn without_bridges(mut branches: Vec<Branch>, junctions: usize, longest: f64) -> Vec<Branch> {
    let mut one: Vec<usize> = (0..junctions).collect();
    let root = |one: &[usize], mut j: usize| {
        while one[j] != j {
            j = one[j];
        }
        j
    };
    branches.retain(|b| match b.ends {
        [Some(a), Some(c)] if (b.line.len() as f64) <= longest => {
            let (a, c) = (root(&one, a), root(&one, c));
            let bridge = a != c;
            one[a.max(c)] = a.min(c);
            !bridge
        }
        _ => true,
    });
    for end in branches.iter_mut().flat_map(|b| &mut b.ends) {
        *end = end.map(|j| root(&one, j));
    }
    branches
}

struct Branch {
    line: Vec<Vec2>,
    ends: [Option<usize>; 2],
}

impl Branch {
    /// Direction away from an end; the first pixels bend towards the junction and are skipped where there are others.
    fn direction(&self, end: usize, skip: usize) -> Vec2 {
        let last = self.line.len() - 1;
        let near = skip.min(last / 3);
        let far = (near + DIRECTION_PX).min(last);
        let (from, to) = if end == 0 { (near, far) } else { (last - near, last - far) };
        (self.line[to] - self.line[from]).try_normalize(0.0).unwrap_or_else(Vec2::zeros)
    }
}

/// Joins at each junction the pairs of branches that go straight on, the straightest first.
fn joined(mut branches: Vec<Branch>, junctions: usize, skip: usize) -> Vec<Vec<Vec2>> {
    for j in 0..junctions {
        loop {
            let ends: Vec<(usize, usize)> = branches
                .iter()
                .enumerate()
                .flat_map(|(b, branch)| (0..2).filter(move |&e| branch.ends[e] == Some(j)).map(move |e| (b, e)))
                .collect();
            let mut best: Option<(f64, End, End)> = None;
            for (i, &a) in ends.iter().enumerate() {
                for &b in ends[i + 1..].iter().filter(|b| b.0 != a.0) {
                    let straight = -branches[a.0].direction(a.1, skip).dot(&branches[b.0].direction(b.1, skip));
                    if straight > STRAIGHT_ON && best.is_none_or(|(s, ..)| straight > s) {
                        best = Some((straight, a, b));
                    }
                }
            }
            let Some((_, a, b)) = best else { break };
            let (first, second) = if a.0 < b.0 { (a, b) } else { (b, a) };
            let other = branches.remove(second.0);
            let one = &mut branches[first.0];
            // The first ends at the junction, the second begins there.
            if first.1 == 0 {
                one.line.reverse();
                one.ends.reverse();
            }
            let (mut tail, mut end) = (other.line, other.ends);
            if second.1 == 1 {
                tail.reverse();
                end.reverse();
            }
            // From arm to arm, without the places of the junction, which lie beside both lines.
            one.line.truncate((one.line.len().saturating_sub(1 + skip)).max(1));
            let behind = (1 + skip).min(tail.len() - 1);
            one.line.extend(tail.into_iter().skip(behind));
            one.ends = [one.ends[0], end[1]];
        }
    }
    branches.into_iter().map(|b| b.line).filter(|line| line.len() > 1).collect()
}

/// Averages over a window that shrinks towards the ends, so that they stay.
fn smoothed(line: &[Vec2]) -> Vec<Vec2> {
    let last = line.len() - 1;
    (0..=last)
        .map(|i| {
            let reach = SMOOTHING_PX.min(i).min(last - i);
            line[i - reach..=i + reach].iter().sum::<Vec2>() / (2 * reach + 1) as f64
        })
        .collect()
}

/// Lengthens both ends straight on to the end of the stroke. The last pixels of a middle line, half a width, bend towards a
/// corner of the stroke's end; they are replaced.
fn lengthened(line: &[Vec2], mask: &Mask, half_width: f64) -> Vec<Vec2> {
    let mut line = line.to_vec();
    let hook = half_width.ceil() as usize;
    if line.len() < 3 || line[0] == line[line.len() - 1] {
        return line;
    }
    for _ in 0..2 {
        line.reverse();
        if line.len() > 2 * hook + DIRECTION_PX {
            line.truncate(line.len() - hook);
        }
        let last = line.len() - 1;
        let Some(direction) = (line[last] - line[last - DIRECTION_PX.min(last)]).try_normalize(0.0) else { continue };
        let inside = |p: Vec2| {
            p.x >= 0.0
                && p.y >= 0.0
                && (p.x as usize) < mask.width
                && (p.y as usize) < mask.height
                && mask.set[p.y as usize * mask.width + p.x as usize]
        };
        let mut reach = 0.0;
        while reach < 4.0 * half_width && inside(line[last] + direction * (reach + 0.25)) {
            reach += 0.25;
        }
        if reach > 0.0 {
            line.push(line[last] + direction * reach);
        }
    }
    line
}

/// Ramer, Douglas and Peucker: the fewest of the vertices that stay within a distance of the line.
fn simplified(line: &[Vec2], tolerance: f64) -> Vec<Vec2> {
    let mut keep = vec![false; line.len()];
    let (Some(first), Some(last)) = (keep.first().map(|_| 0), line.len().checked_sub(1)) else { return Vec::new() };
    (keep[first], keep[last]) = (true, true);
    let mut stack = vec![(first, last)];
    while let Some((a, b)) = stack.pop() {
        let along = line[b] - line[a];
        let distance = |p: Vec2| match along.norm_squared() {
            0.0 => (p - line[a]).norm(),
            squared => (p - line[a] - along * ((p - line[a]).dot(&along) / squared).clamp(0.0, 1.0)).norm(),
        };
        let farthest =
            (a + 1..b).map(|i| (distance(line[i]), i)).max_by(|x, y| x.0.total_cmp(&y.0).then(y.1.cmp(&x.1)));
        if let Some((d, i)) = farthest.filter(|f| f.0 > tolerance) {
            debug_assert!(d > tolerance);
            keep[i] = true;
            stack.extend([(a, i), (i, b)]);
        }
    }
    line.iter().zip(keep).filter(|(_, k)| *k).map(|(p, _)| *p).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{Grid, Placement};

    const CELL: f64 = 0.01;

    /// A 6 m x 4 m map with strokes painted along segments.
    fn painted(segments: &[(Label, [f64; 4], f64)]) -> LabelMap {
        let grid = Grid::covering(Vec2::zeros(), Vec2::new(6.0, 4.0), CELL).unwrap();
        let placement = Placement::of_grid(&grid);
        let (width, height) = (grid.width(), grid.height());
        let labels = (0..width * height)
            .map(|i| {
                let p = placement.chart_from_pixel(Vec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5));
                segments
                    .iter()
                    .find(|(_, [ax, ay, bx, by], w)| {
                        let (a, d) = (Vec2::new(*ax, *ay), Vec2::new(bx - ax, by - ay));
                        let t = ((p - a).dot(&d) / d.norm_squared()).clamp(0.0, 1.0);
                        (p - a - d * t).norm() <= w / 2.0
                    })
                    .map_or(0, |s| s.0)
            })
            .collect();
        LabelMap { width, height, placement, labels }
    }

    fn distance(p: &Vec3, [ax, ay, bx, by]: [f64; 4]) -> f64 {
        let (a, d) = (Vec2::new(ax, ay), Vec2::new(bx - ax, by - ay));
        let t = ((p.xy() - a).dot(&d) / d.norm_squared()).clamp(0.0, 1.0);
        (p.xy() - a - d * t).norm()
    }

    #[test]
    fn strokes_become_their_middle() {
        for width in [0.011, 0.03, 0.05, 0.1] {
            let segment = [0.5, 0.7, 5.2, 3.1];
            let (found, summary) = strokes(&painted(&[(3, segment, width)]), &[], &StrokeSettings::default());
            assert_eq!((summary.strokes, summary.areas, found.len()), (1, 0, 1), "{width}: {summary:?}");
            let line = &found[0];
            // The brush is round: the stroke reaches half a width beyond the segment.
            let painted = [0.5 - 0.45 * width, 0.7 - 0.23 * width, 5.2 + 0.45 * width, 3.1 + 0.23 * width];
            let worst = line.parts[0].iter().map(|p| distance(p, painted)).fold(0.0, f64::max);
            assert!(worst < 1.1 * CELL, "{width}: {worst}");
            let truth = (4.7f64).hypot(2.4);
            assert!((line.length() / truth - 1.0).abs() < 0.03, "{width}: {} of {truth}", line.length());
            assert!(line.parts[0].len() < 12, "{width}: {} vertices", line.parts[0].len());
            assert_eq!(line.attribute("label"), Some(&Value::Integer(3)));
        }
    }

    #[test]
    fn crossing_strokes_of_one_class_stay_two_lines() {
        let segments = [[0.5, 0.5, 5.5, 3.5], [0.6, 3.4, 5.4, 0.9]];
        let map = painted(&segments.map(|s| (2, s, 0.04)));
        let (found, summary) = strokes(&map, &[], &StrokeSettings::default());
        assert_eq!((summary.strokes, found.len()), (2, 2), "{summary:?}");
        for line in &found {
            let near = segments.iter().filter(|s| line.parts[0].iter().all(|p| distance(p, **s) < 3.0 * CELL)).count();
            assert_eq!(near, 1, "a line follows one of the strokes");
        }
    }

    #[test]
    fn a_stroke_that_was_painted_over_is_one_line() {
        let (under, over) = ([0.5, 0.5, 5.5, 3.5], [3.0, 0.4, 2.8, 3.6]);
        let (found, summary) = strokes(&painted(&[(7, over, 0.06), (2, under, 0.04)]), &[], &StrokeSettings::default());
        assert_eq!((summary.strokes, summary.gaps), (2, 1), "{summary:?}");
        let whole = found.iter().find(|f| f.attribute("label") == Some(&Value::Integer(2))).unwrap();
        assert!((whole.length() / 5f64.hypot(3.0) - 1.0).abs() < 0.03, "{}", whole.length());
    }

    #[test]
    fn a_stroke_under_another_at_a_small_angle_is_one_line() {
        for (rise, width) in [(0.15, 0.04), (0.2, 0.04), (0.3, 0.06)] {
            let (under, over) = ([0.5, 2.0 - rise, 5.5, 2.0 + rise], [0.5, 2.0 + rise, 5.5, 2.0 - rise]);
            let map = painted(&[(7, over, width), (2, under, width)]);
            let (found, summary) = strokes(&map, &[], &StrokeSettings::default());
            assert_eq!((summary.strokes, summary.gaps), (2, 1), "{rise}: {summary:?}");
            let whole = found.iter().find(|f| f.attribute("label") == Some(&Value::Integer(2))).unwrap();
            assert!((whole.length() / 5f64.hypot(2.0 * rise) - 1.0).abs() < 0.02, "{rise}: {}", whole.length());
            let worst = whole.parts[0].iter().map(|p| distance(p, under)).fold(0.0, f64::max);
            assert!(worst < width, "{rise}: {worst}");
        }
    }

    #[test]
    fn strokes_that_end_before_each_other_stay_two() {
        // A gap that nothing covers, and one that another stroke covers but that lies beside.
        let apart = painted(&[(2, [0.5, 1.0, 2.5, 1.0], 0.04), (2, [3.0, 1.0, 5.5, 1.0], 0.04)]);
        assert_eq!(strokes(&apart, &[], &StrokeSettings::default()).1.gaps, 0);
        let beside = painted(&[
            (7, [2.5, 0.5, 2.5, 3.5], 0.1),
            (2, [0.5, 1.0, 2.4, 1.0], 0.04),
            (2, [2.6, 1.25, 5.5, 1.25], 0.04),
        ]);
        assert_eq!(strokes(&beside, &[], &StrokeSettings::default()).1.gaps, 0);
    }

    #[test]
    fn broad_patches_are_areas_and_specks_are_counted() {
        let map = painted(&[(1, [1.0, 1.0, 2.0, 1.0], 0.8), (2, [4.0, 3.0, 4.005, 3.0], 0.02)]);
        let (found, summary) = strokes(&map, &[], &StrokeSettings::default());
        assert_eq!((summary.strokes, summary.areas, summary.specks), (0, 1, 1), "{summary:?}");
        let ring = &found[0].parts[0];
        assert_eq!((found[0].kind, ring.first()), (Kind::Area, ring.last()));
        let area = ring.windows(2).map(|w| w[0].xy().perp(&w[1].xy())).sum::<f64>().abs() / 2.0;
        let truth = 0.8 + std::f64::consts::PI * 0.16;
        assert!((area / truth - 1.0).abs() < 0.03, "{area} of {truth}");
    }
}
