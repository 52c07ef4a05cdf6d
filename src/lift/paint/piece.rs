//! One piece of the map: from the painted pixels of the edited picture to a class for each pixel of the map.

use super::mixture::{Painted, Shares, drop_isolated};
use super::new_classes::Candidates;
use super::passage::Passage;
use super::resampling::{Axis, Band, Filter, Kernel, resample};
use super::synthesis::{Allowed, Scene, Search, State as Class, View};
use super::window::{OPAQUE, Place, State, Window, far};
use super::{NEW_COLOR, Rules, distance, rgb};
use crate::cloud::Label;
use crate::lift::label_map::NO_SURFACE;
use crate::map::{PaletteEntry, Picture, PixelRect, color_distance};

/// Standard deviation of the noise of an exact picture: rounding.
const ROUNDING: f64 = 1.0;
/// Shares are added up this exactly.
const HALF_SLACK: f32 = 1e-4;
/// JPEG is at least this noisy where something was painted, in brightness and in colour.
const LOSSY_NOISE: [f64; 2] = [6.0, 6.0];
/// The median of distances in three channels is this many standard deviations of one.
const MEDIAN_DISTANCE: f64 = 1.54;

/// Everything that the pieces have in common.
pub(super) struct Frame<'a> {
    pub(super) edited: &'a Picture,
    pub(super) base: &'a Picture,
    /// The label map as it went out, and its palette.
    pub(super) labels: &'a Picture,
    pub(super) palette: &'a [PaletteEntry],
    pub(super) place: &'a Place,
    pub(super) passage: &'a Passage,
    pub(super) rules: &'a Rules,
}

/// What a pixel of the map turned out to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Outcome {
    /// Not painted: the label before.
    Before(Label),
    /// Erased, or painted with one of several classes.
    Unlabelled,
    /// Painted with a class (its place in the list).
    Class(u16),
}

/// What a piece of the map turned out to be.
#[derive(Default)]
pub(super) struct Part {
    /// What the pixels of the core are.
    pub(super) labels: Vec<Outcome>,
    /// Counts, see [`super::Recognised`].
    pub(super) painted: usize,
    pub(super) smoothed: usize,
    pub(super) ambiguous: usize,
    pub(super) undecided: usize,
    pub(super) erased: usize,
    /// Colours that no class explains.
    pub(super) candidates: Candidates,
    /// For each class: pixels of the map that have it.
    pub(super) used: Vec<usize>,
    /// For each class: what its colour should be changed by, see [`Scene::fit`].
    pub(super) fits: Vec<Vec<([f64; 4], f64)>>,
    /// An ambiguous pixel of the edited picture: its colour, column and row.
    pub(super) example: Option<([u8; 3], usize, usize)>,
}

impl Frame<'_> {
    fn window(&self, core: PixelRect) -> Window {
        Window::new(core, self.place, self.passage, self.edited, self.base)
    }

    /// The label of a pixel of the map before.
    fn before(&self, column: usize, row: usize) -> Outcome {
        let at = row * self.labels.width + column;
        if self.labels.rgba[4 * at + 3] < OPAQUE {
            return Outcome::Before(NO_SURFACE);
        }
        let color = rgb(self.labels, at);
        let nearest = self.palette.iter().map(|e| (color_distance(e.color, color), e.value)).min();
        Outcome::Before(nearest.map_or(0, |(_, label)| label))
    }

    /// Finds what is painted on a piece with classes that have the given colours in the edited picture.
    pub(super) fn solve(&self, core: PixelRect, colors: &[[u8; 3]]) -> Part {
        let window = self.window(core);
        let seen = window.compare(self.rules.tolerance, self.rules.mixed);
        let mut part = Part::default();
        let all = || (0..core.len()).map(|i| (core.column + i % core.width, core.row + i / core.width));
        part.labels = all().map(|(column, row)| self.before(column, row)).collect();
        if seen.iter().all(|s| s.state == State::Same) {
            return part;
        }
        let picture = window.picture();
        let painted = Painted { picture: &picture, seen: &seen, classes: colors, rules: self.rules };
        let certain = certain(&painted);
        let erased = colors.len() as u16;
        part.used = vec![0; colors.len()];
        if certain.iter().all(Option::is_none) && seen.iter().all(|s| s.state != State::Erased) {
            let shares = vec![None; seen.len()];
            self.count(&window, &painted, &certain, &shares, &window.expected, &mut part);
            return part;
        }
        let allowed = self.allowed(&window, &painted, &certain, erased);
        let shares: Vec<Option<(f64, Shares)>> = (0..seen.len())
            .map(|i| match seen[i].state {
                State::Same => None,
                State::Painted => painted.share(i, &certain),
                State::Erased => Some((0.0, [(erased, 1.0), (erased, 0.0)])),
            })
            .collect();
        let mut paints: Vec<[f32; 4]> = colors.iter().map(|c| [c[0], c[1], c[2], 255].map(f32::from)).collect();
        paints.push([0.0; 4]);
        let views = self.views(&window);
        let mut scene = Scene::new(window.map.width, &window.base, &paints, &allowed, views);
        let is_sampled = self.passage.filter.kernel.is_exact() && self.place.scale() > 1.0;
        let search = match (is_sampled, self.rules.mixed) {
            (true, _) => Search::None,
            (false, false) => Search::Plain,
            (false, true) => Search::Full,
        };
        scene.find(&first_states(&window, &shares, is_sampled), search);
        let states = scene.states.clone();
        let mut doubtful = vec![false; states.len()];
        scene.doubtful(self.rules.mixed, self.rules.noisy).into_iter().for_each(|p| doubtful[p] = true);

        let (x0, y0) = (core.column - window.map.column, core.row - window.map.row);
        for (i, (column, row)) in all().enumerate() {
            let p = (y0 + i / core.width) * window.map.width + x0 + i % core.width;
            if states[p] == 0 || part.labels[i] == Outcome::Before(NO_SURFACE) {
                continue;
            }
            debug_assert_eq!(
                (window.map.column + p % window.map.width, window.map.row + p / window.map.width),
                (column, row)
            );
            part.undecided += usize::from(doubtful[p]);
            let class = states[p] - 1;
            if class != erased {
                part.used[usize::from(class)] += 1;
            }
            part.labels[i] = if doubtful[p] || class == erased { Outcome::Unlabelled } else { Outcome::Class(class) };
        }
        if self.rules.mixed {
            part.fits = (0..colors.len()).map(|k| scene.fit(k as Class + 1)).collect();
        }
        let colors: Vec<[f32; 4]> = (0..states.len()).map(|p| scene.color(p, states[p])).collect();
        let made = resample(&colors, window.map.width, &window.columns, &window.rows);
        self.count(&window, &painted, &certain, &shares, &made, &mut part);
        part
    }

    /// The classes that pixels of the map may have: those that are certain near them, and in noisy pictures those that are
    /// certain somewhere in the window and explain a pixel near them.
    fn allowed(&self, window: &Window, painted: &Painted, certain: &[Option<u16>], erased: u16) -> Allowed {
        let class_at = |i: usize| if painted.seen[i].state == State::Erased { Some(erased) } else { certain[i] };
        let classes = (0..painted.seen.len()).filter_map(class_at).collect();
        let mut allowed = Allowed::new(classes, window.base.len());
        let (width, height) = (window.map.width, window.map.height);
        let near = |band: &Band, k: usize, end: usize| {
            let (centre, reach) = (band.centre(k), self.rules.near_on_map);
            ((centre - reach).max(0.0) as usize)..((centre + reach).ceil() as usize).min(end)
        };
        let occurring: Vec<u16> = allowed.occurring().to_vec();
        let mut plausible = Vec::new();
        for i in 0..painted.seen.len() {
            plausible.clear();
            plausible.extend(class_at(i));
            if self.rules.mixed && painted.seen[i].state == State::Painted {
                plausible.extend(occurring.iter().filter(|&&k| k != erased && painted.is_plausible(i, k)));
            }
            let columns = near(&window.columns, i % window.edited.width, width);
            for y in near(&window.rows, i / window.edited.width, height) {
                for x in columns.clone() {
                    plausible.iter().for_each(|&class| allowed.allow(y * width + x, class));
                }
            }
        }
        allowed
    }

    /// What came back, as the noise in it asks.
    fn views(&self, window: &Window) -> Vec<View> {
        let noise = self.rules.median / MEDIAN_DISTANCE;
        let map = [window.map.width, window.map.height];
        if !self.passage.lossy {
            let weight = (1.0 / noise.max(ROUNDING).powi(2)) as f32;
            let pictures = [window.seen.clone(), window.expected.clone()];
            return vec![View::new([&window.columns, &window.rows], map, pictures, |c| c, [0.0, 255.0], weight)];
        }
        let weight = |least: f64| (1.0 / noise.max(least).powi(2)) as f32;
        let [sharp, coarse] = LOSSY_NOISE;
        let brightness = |pixels: &[[f32; 4]]| pixels.iter().map(|&c| luma(c)).collect::<Vec<_>>();
        let halved = |pixels: &[[f32; 4]], columns: &Band, rows: &Band| {
            let chroma: Vec<[f32; 4]> = pixels.iter().map(|&c| chroma(c)).collect();
            resample(&chroma, window.edited.width, columns, rows)
        };
        let (columns, rows) = (in_pairs(window.edited.width), in_pairs(window.edited.height));
        let colors = window.base.clone();
        let (wide, high) = (twice(&window.columns), twice(&window.rows));
        let expected = resample(&colors.iter().map(|&c| chroma(c)).collect::<Vec<_>>(), map[0], &wide, &high);
        vec![
            View::new(
                [&window.columns, &window.rows],
                map,
                [brightness(&window.seen), brightness(&window.expected)],
                luma,
                [0.0, 255.0],
                weight(sharp),
            ),
            View::new(
                [&wide, &high],
                map,
                [halved(&window.seen, &columns, &rows), expected],
                chroma,
                [-255.0, 255.0],
                weight(coarse),
            ),
        ]
    }

    /// Counts the painted pixels of the edited picture in the core, and those that the classes do not explain.
    fn count(
        &self,
        window: &Window,
        painted: &Painted,
        certain: &[Option<u16>],
        shares: &[Option<(f64, Shares)>],
        made: &[[f32; 4]],
        part: &mut Part,
    ) {
        // A mixture is judged less strictly than full colours.
        let slack = 2.0 * self.rules.tolerance + NEW_COLOR;
        let rest = self.rest(window, made);
        for i in (0..made.len()).filter(|&i| window.is_own(i, self.place)) {
            match painted.seen[i].state {
                State::Same => continue,
                State::Erased => {
                    part.erased += 1;
                    continue;
                }
                State::Painted if window.expected[i][3] < f32::from(OPAQUE) => continue,
                State::Painted => part.painted += 1,
            }
            let difference = distance(rgb(painted.picture, i), painted.seen[i].base);
            let is_noise = self.rules.mixed && difference <= slack + NEW_COLOR;
            if rest[i] > self.rules.unexplained {
                part.candidates.add(painted, i);
            }
            let residual = shares[i].map_or(f64::INFINITY, |s| s.0).min(far(window.seen[i], made[i]));
            if residual <= slack.max(0.5 * difference) {
                part.smoothed += usize::from(certain[i].is_none());
            } else if !is_noise {
                part.ambiguous += 1;
                let (x, y) = (i % window.edited.width, i / window.edited.width);
                let place = (window.edited.column + x, window.edited.row + y);
                part.example.get_or_insert((rgb(painted.picture, i), place.0, place.1));
            }
        }
    }

    /// How far each pixel of the edited picture is from what the states make; in noisy pictures, the mean around it.
    fn rest(&self, window: &Window, made: &[[f32; 4]]) -> Vec<f64> {
        let rest: Vec<[f32; 4]> =
            window.seen.iter().zip(made).map(|(s, m)| [0, 1, 2, 3].map(|k| s[k] - m[k].clamp(0.0, 255.0))).collect();
        let (width, height) = (window.edited.width, window.edited.height);
        if self.rules.noisy && !rest.is_empty() {
            let axis = |count: usize| {
                let filter = Filter { kernel: Kernel::Box, spread: 3.0 };
                Band::new(Axis { origin: 0.0, scale: 1.0 }, filter, 0..count, &(0..count), &(0..count))
            };
            return resample(&rest, width, &axis(width), &axis(height)).into_iter().map(|d| far(d, [0.0; 4])).collect();
        }
        rest.into_iter().map(|d| far(d, [0.0; 4])).collect()
    }
}

/// The class of each pixel of the edited picture where there is no doubt.
fn certain(painted: &Painted) -> Vec<Option<u16>> {
    let (width, height) = (painted.picture.width, painted.picture.height);
    let index: Vec<usize> = (0..painted.seen.len()).filter(|&i| painted.seen[i].state == State::Painted).collect();
    let mut certain = vec![None; painted.seen.len()];
    for &i in &index {
        certain[i] = painted.certain(i);
    }
    if painted.rules.noisy {
        drop_isolated(&mut certain, &index, width, height);
    }
    let doubtful: Vec<usize> = index.iter().copied().filter(|&i| painted.is_doubtful(i, &certain)).collect();
    doubtful.into_iter().for_each(|i| certain[i] = None);
    certain
}

/// The states that the painted shares suggest, interpolated: painted where they are a half or more. If the picture shows only
/// some pixels of the map (`is_sampled`), pixels half way between painted and other ones are painted only where a line would
/// be thinner than elsewhere without them.
fn first_states(window: &Window, shares: &[Option<(f64, Shares)>], is_sampled: bool) -> Vec<Class> {
    let (width, height) = (window.map.width, window.map.height);
    let (across, down) = (Window::between(&window.columns, width), Window::between(&window.rows, height));
    let mut states = vec![0; width * height];
    let mut is_sure = vec![false; width * height];
    let mut totals: Vec<(u16, f32)> = Vec::new();
    for (p, state) in states.iter_mut().enumerate() {
        let ((k, tx), (l, ty)) = (across[p % width], down[p / width]);
        totals.clear();
        for (dy, wy) in [(0, 1.0 - ty), (1, ty)] {
            for (dx, wx) in [(0, 1.0 - tx), (1, tx)] {
                let weight = wx * wy;
                if weight == 0.0 {
                    continue;
                }
                for (class, share) in shares[(l + dy) * window.edited.width + k + dx].iter().flat_map(|s| &s.1) {
                    match totals.iter_mut().find(|t| t.0 == *class) {
                        Some(total) => total.1 += weight * *share as f32,
                        None => totals.push((*class, weight * *share as f32)),
                    }
                }
            }
        }
        let most = totals.iter().copied().reduce(|a, b| if b.1 > a.1 { b } else { a });
        let sum: f32 = totals.iter().map(|t| t.1).sum();
        is_sure[p] = sum > 0.5 + HALF_SLACK;
        if let Some((class, _)) = most.filter(|_| sum >= 0.5 - HALF_SLACK) {
            *state = class + 1;
        }
    }
    if is_sampled {
        let is_wide = opened(&is_sure, width);
        let around = |p: usize| {
            let (x, y) = (p % width, p / width);
            (y.saturating_sub(1)..(y + 2).min(height))
                .flat_map(move |ny| (x.saturating_sub(1)..(x + 2).min(width)).map(move |nx| ny * width + nx))
        };
        for p in 0..states.len() {
            if !is_sure[p] && !around(p).any(|n| is_sure[n] && !is_wide[n]) {
                states[p] = 0;
            }
        }
    }
    states
}

/// The pixels (`width` in a row) that lie in a square of 3 x 3 marked ones.
fn opened(marked: &[bool], width: usize) -> Vec<bool> {
    let mut out = vec![false; marked.len()];
    let height = marked.len() / width.max(1);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let square = || (y - 1..y + 2).flat_map(|ny| (x - 1..x + 2).map(move |nx| ny * width + nx));
            if square().all(|n| marked[n]) {
                square().for_each(|n| out[n] = true);
            }
        }
    }
    out
}

/// Brightness (Rec. 601, as in JPEG).
fn luma([r, g, b, _]: [f32; 4]) -> [f32; 4] {
    [0.299 * r + 0.587 * g + 0.114 * b, 0.0, 0.0, 0.0]
}

/// Colour without brightness.
fn chroma([r, g, b, _]: [f32; 4]) -> [f32; 4] {
    [-0.1687 * r - 0.3313 * g + 0.5 * b, 0.5 * r - 0.4187 * g - 0.0813 * b, 0.0, 0.0]
}

/// The change of a colour out of that of its brightness and of what [`chroma`] gives.
pub(super) fn color_change(luma: f64, [blue, red, ..]: [f64; 4]) -> [f64; 4] {
    [luma + 1.402 * red, luma - 0.344 * blue - 0.714 * red, luma + 1.772 * blue, 0.0]
}

/// Means of pairs of pixels, for which JPEG stores one colour.
fn in_pairs(count: usize) -> Band {
    let axis = Axis { origin: 0.0, scale: 2.0 };
    let filter = Filter::of(Kernel::Box);
    Band::new(axis, filter, 0..count / 2, &(0..count), &(0..count))
}

/// The means of pairs of pixels after a JPEG was read, which interpolates its colours between pairs.
fn twice(band: &Band) -> Band {
    let pairs = band.len() / 2;
    band.combined(pairs, |k| {
        if k == 0 || k + 1 == pairs {
            return (2 * k, vec![0.5; 2]);
        }
        (2 * k - 2, vec![0.0625, 0.0625, 0.375, 0.375, 0.0625, 0.0625])
    })
}
