//! Which pixels of the map are painted: those that make the picture that came back.
//!
//! Each pixel of the map is in one of a few states, as the base or painted with a class. The picture that a choice of states
//! makes is known ([`View::predicted`]), so states are changed one by one, and exchanged between neighbours, as long as that
//! brings it nearer to the picture that came back. Where the picture leaves the choice open, short outlines win.
//! This is iterated conditional modes (Besag 1986, doi:10.1111/j.2517-6161.1986.tb01412.x) with exchanges.

use super::resampling::Band;

/// What one unit of outline costs, in squared standard deviations of the noise: much at first, so that the search does not end
/// among scattered pixels.
const OUTLINE: [f32; 3] = [64.0, 16.0, 4.0];
/// Sweeps over the pixels; far fewer are needed.
const MAX_SWEEPS: usize = 12;
/// A change has to gain this much, so that rounding does not turn it back.
const LEAST_GAIN: f32 = 1e-2;
/// Pixels with less of a class than this say little about its colour.
const LEAST_SHARE: f32 = 0.3;
/// Regions up to this size are reconsidered as a whole.
const REGION_PX: usize = 200;
/// Sweeps over the surroundings of such a region.
const REGION_SWEEPS: usize = 3;
/// A class is doubtful when another one would cost less than this more; in noisy pictures all costs are lower.
const DOUBT: f32 = 24.0;
const NOISY_DOUBT: f32 = 8.0;
/// Pixels of the map, at most, of a region that may be nothing but the mixed colours of two classes that meet there.
const MIXED_REGION_PX: usize = 8;

/// What a pixel of the map shows: 0 the base, `k + 1` the class `k`.
pub(super) type State = u16;

/// A picture, or a part of its colours, as it came back and as it is predicted.
pub(super) struct View {
    /// For each column (row) of the map: the columns (rows) of the picture it is in.
    columns: Band,
    rows: Band,
    width: usize,
    seen: Vec<[f32; 4]>,
    predicted: Vec<[f32; 4]>,
    /// Colour of the view out of red, green, blue and alpha.
    project: fn([f32; 4]) -> [f32; 4],
    /// Channels end here.
    ends: [f32; 2],
    /// One over the variance of the noise.
    weight: f32,
}

impl View {
    /// `columns` and `rows` make the picture out of `map_width` x `map_height` pixels; `predicted` is that of the base.
    pub(super) fn new(
        [columns, rows]: [&Band; 2],
        [map_width, map_height]: [usize; 2],
        [seen, predicted]: [Vec<[f32; 4]>; 2],
        project: fn([f32; 4]) -> [f32; 4],
        ends: [f32; 2],
        weight: f32,
    ) -> Self {
        View {
            width: columns.len(),
            columns: columns.transposed(map_width),
            rows: rows.transposed(map_height),
            seen,
            predicted,
            project,
            ends,
            weight,
        }
    }

    /// Calls `visit` for each pixel of the picture that a pixel of the map is in, with its weight there.
    fn visit(&self, x: usize, y: usize, mut visit: impl FnMut(usize, f32)) {
        let (first_column, columns) = self.columns.run(x);
        let (first_row, rows) = self.rows.run(y);
        for (k, wy) in rows.iter().enumerate() {
            let at = (first_row + k) * self.width + first_column;
            for (l, wx) in columns.iter().enumerate() {
                visit(at + l, wx * wy);
            }
        }
    }

    /// How much worse the prediction gets when the colour of a pixel of the map changes.
    fn cost(&self, x: usize, y: usize, change: [f32; 4]) -> f32 {
        let d = (self.project)(change);
        let [low, high] = self.ends;
        let mut cost = 0.0;
        self.visit(x, y, |i, w| {
            let (seen, predicted) = (self.seen[i], self.predicted[i]);
            for k in 0..4 {
                let before = seen[k] - predicted[k].clamp(low, high);
                let after = seen[k] - (predicted[k] + w * d[k]).clamp(low, high);
                cost += after * after - before * before;
            }
        });
        cost * self.weight
    }

    fn apply(&mut self, x: usize, y: usize, change: [f32; 4]) {
        let d = (self.project)(change);
        let mut predicted = std::mem::take(&mut self.predicted);
        self.visit(x, y, |i, w| (0..4).for_each(|k| predicted[i][k] += w * d[k]));
        self.predicted = predicted;
    }

    /// What came back less what is predicted, at a pixel of the picture.
    fn rest(&self, i: usize) -> [f32; 4] {
        let [low, high] = self.ends;
        [0, 1, 2, 3].map(|k| self.seen[i][k] - self.predicted[i][k].clamp(low, high))
    }
}

/// How far to look for better states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Search {
    /// Not at all.
    None,
    /// Pixel by pixel.
    Plain,
    /// With short outlines first, and with small regions as a whole in the end.
    Full,
}

/// Pixels of the map whose states are sought.
pub(super) struct Scene<'a> {
    width: usize,
    /// Colour of each pixel of the base.
    base: &'a [[f32; 4]],
    /// Colour of each class.
    colors: &'a [[f32; 4]],
    /// Classes that each pixel may have.
    allowed: &'a Allowed,
    views: Vec<View>,
    /// State of each pixel.
    pub(super) states: Vec<State>,
    outline: f32,
}

impl<'a> Scene<'a> {
    pub(super) fn color(&self, p: usize, state: State) -> [f32; 4] {
        if state == 0 { self.base[p] } else { self.colors[usize::from(state) - 1] }
    }

    /// Pixels `width` in a row, all as the base.
    pub(super) fn new(
        width: usize,
        base: &'a [[f32; 4]],
        colors: &'a [[f32; 4]],
        allowed: &'a Allowed,
        views: Vec<View>,
    ) -> Self {
        Scene { width, base, colors, allowed, views, states: vec![0; base.len()], outline: OUTLINE[2] }
    }

    /// Finds the states, beginning with `first`.
    pub(super) fn find(&mut self, first: &[State], search: Search) {
        for (p, &state) in first.iter().enumerate().filter(|(_, state)| **state != 0) {
            self.set(p, state);
        }
        let outlines = match search {
            Search::None => &[],
            Search::Plain => &OUTLINE[2..],
            Search::Full => &OUTLINE[..],
        };
        for outline in outlines {
            self.outline = *outline;
            self.settle();
        }
        if search == Search::Full {
            self.reconsider();
            self.settle();
        }
    }

    fn set(&mut self, p: usize, state: State) {
        let change = difference(self.color(p, state), self.color(p, self.states[p]));
        let (x, y) = (p % self.width, p / self.width);
        self.views.iter_mut().for_each(|v| v.apply(x, y, change));
        self.states[p] = state;
    }

    /// Neighbours of a pixel and the length of outline between them.
    fn around(&self, p: usize) -> impl Iterator<Item = (usize, f32)> + use<> {
        let (width, height) = (self.width as isize, (self.base.len() / self.width) as isize);
        let (x, y) = (p as isize % width, p as isize / width);
        const STEPS: [(isize, isize, f32); 8] = [
            (1, 0, 1.0),
            (0, 1, 1.0),
            (1, 1, 0.7),
            (-1, 1, 0.7),
            (-1, 0, 1.0),
            (0, -1, 1.0),
            (-1, -1, 0.7),
            (1, -1, 0.7),
        ];
        STEPS.into_iter().filter_map(move |(dx, dy, length)| {
            let (nx, ny) = (x + dx, y + dy);
            let inside = nx >= 0 && ny >= 0 && nx < width && ny < height;
            inside.then(|| ((ny * width + nx) as usize, length))
        })
    }

    /// What it costs to change the state of a pixel.
    fn cost(&self, p: usize, state: State) -> f32 {
        let change = difference(self.color(p, state), self.color(p, self.states[p]));
        let (x, y) = (p % self.width, p / self.width);
        let data: f32 = self.views.iter().map(|v| v.cost(x, y, change)).sum();
        let outline: f32 = self
            .around(p)
            .map(|(n, length)| {
                let differs = |s: State| f32::from(u8::from(self.states[n] != s)) * length;
                differs(state) - differs(self.states[p])
            })
            .sum();
        data + self.outline * outline
    }

    /// What it costs to exchange the states of two pixels; they keep theirs.
    fn exchange_cost(&mut self, p: usize, q: usize) -> f32 {
        let (a, b) = (self.states[p], self.states[q]);
        let first = self.cost(p, b);
        self.set(p, b);
        let second = self.cost(q, a);
        self.set(p, a);
        first + second
    }

    /// Changes states until none gets better.
    fn settle(&mut self) {
        let active: Vec<usize> = (0..self.base.len()).filter(|&p| self.allowed.any(p)).collect();
        for _ in 0..MAX_SWEEPS {
            let mut changes = 0;
            for &p in &active {
                let own = self.states[p];
                let mut best = (-LEAST_GAIN, own);
                let states = std::iter::once(0).chain(self.allowed.classes(p).map(|k| k + 1));
                for state in states.filter(|&s| s != own) {
                    let cost = self.cost(p, state);
                    if cost < best.0 {
                        best = (cost, state);
                    }
                }
                if best.1 != own {
                    self.set(p, best.1);
                    changes += 1;
                    continue;
                }
                let others: Vec<usize> = self.around(p).take(4).map(|(q, _)| q).collect();
                for q in others {
                    let (a, b) = (self.states[p], self.states[q]);
                    if a != b
                        && self.allowed.has(p, b)
                        && self.allowed.has(q, a)
                        && self.exchange_cost(p, q) < -LEAST_GAIN
                    {
                        self.set(p, b);
                        self.set(q, a);
                        changes += 1;
                    }
                }
            }
            if changes == 0 {
                break;
            }
        }
    }

    /// How much of the colour of a class the rest asks for, view by view: sums of the rest times the share of the class, and
    /// of the share squared.
    pub(super) fn fit(&self, state: State) -> Vec<([f64; 4], f64)> {
        let mut fits = Vec::new();
        if !self.states.contains(&state) {
            return fits;
        }
        for view in &self.views {
            let mut shares = vec![0.0f32; view.seen.len()];
            for p in (0..self.states.len()).filter(|&p| self.states[p] == state) {
                view.visit(p % self.width, p / self.width, |i, w| shares[i] += w);
            }
            let (mut sums, mut squares) = ([0.0; 4], 0.0);
            for (i, &share) in shares.iter().enumerate().filter(|(_, share)| **share > LEAST_SHARE) {
                let rest = view.rest(i);
                (0..4).for_each(|k| sums[k] += f64::from(share * rest[k]));
                squares += f64::from(share * share);
            }
            fits.push((sums, squares));
        }
        fits
    }

    /// The painted regions: pixels of one class that hang together.
    fn regions(&self) -> Vec<Vec<usize>> {
        let mut done = vec![false; self.states.len()];
        let mut regions = Vec::new();
        for start in 0..self.states.len() {
            if done[start] || self.states[start] == 0 {
                continue;
            }
            let mut region = vec![start];
            done[start] = true;
            let mut next = 0;
            while next < region.len() {
                for (n, _) in self.around(region[next]) {
                    if !done[n] && self.states[n] == self.states[start] {
                        done[n] = true;
                        region.push(n);
                    }
                }
                next += 1;
            }
            regions.push(region);
        }
        regions
    }

    /// Gives small regions of a class another one, or takes them back, where that makes a better picture, together with the
    /// pixels around them.
    fn reconsider(&mut self) {
        for region in self.regions() {
            let own = self.states[region[0]];
            // A region that was given another class may have taken pixels of this one.
            if region.len() > REGION_PX || region.iter().any(|&p| self.states[p] != own) {
                continue;
            }
            let mut others: Vec<State> = region.iter().flat_map(|&p| self.allowed.classes(p)).map(|k| k + 1).collect();
            others.push(0);
            others.sort_unstable();
            others.dedup();
            for other in others.into_iter().filter(|&s| s != own) {
                let may = region.iter().filter(|&&p| self.allowed.has(p, other)).count();
                if 2 * may >= region.len() && self.try_region(&region, other) {
                    break;
                }
            }
        }
    }

    /// Gives a region another state if that gains something.
    fn try_region(&mut self, region: &[usize], state: State) -> bool {
        let mut changed: Vec<(usize, State)> = Vec::new();
        let mut total = 0.0;
        let mut set = |scene: &mut Self, p: usize, state: State, cost: f32| {
            changed.push((p, scene.states[p]));
            scene.set(p, state);
            total += cost;
        };
        for &p in region {
            let state = if self.allowed.has(p, state) { state } else { 0 };
            let cost = self.cost(p, state);
            set(self, p, state, cost);
        }
        let mut near: Vec<usize> = region.to_vec();
        for _ in 0..2 {
            let grown: Vec<usize> = near.iter().flat_map(|&p| self.around(p).map(|(n, _)| n)).collect();
            near.extend(grown);
            near.sort_unstable();
            near.dedup();
        }
        for _ in 0..REGION_SWEEPS {
            let mut is_settled = true;
            for &p in &near {
                for s in [0, state] {
                    if s != self.states[p] && self.allowed.has(p, s) {
                        let cost = self.cost(p, s);
                        if cost < -LEAST_GAIN {
                            set(self, p, s, cost);
                            is_settled = false;
                        }
                    }
                }
            }
            if is_settled {
                break;
            }
        }
        let gains = total < -LEAST_GAIN;
        if !gains {
            changed.into_iter().rev().for_each(|(p, before)| self.set(p, before));
        }
        gains
    }

    /// Painted pixels that could as well be painted with another class; in a picture of `mixed` colours also the small regions
    /// beside another class, which mixed colours may have made up.
    pub(super) fn doubtful(&mut self, mixed: bool, noisy: bool) -> Vec<usize> {
        let most = if noisy { NOISY_DOUBT } else { DOUBT };
        let mut doubtful = Vec::new();
        for region in self.regions() {
            let own = self.states[region[0]];
            let is_other = |s: State| s != 0 && s != own;
            let is_small = mixed && region.len() <= MIXED_REGION_PX;
            if is_small && region.iter().any(|&p| self.around(p).any(|(q, _)| is_other(self.states[q]))) {
                doubtful.extend(region);
                continue;
            }
            for p in region {
                let others: Vec<State> = self.allowed.classes(p).map(|k| k + 1).filter(|&s| s != own).collect();
                let near: Vec<usize> = self.around(p).map(|(q, _)| q).collect();
                let doubt = others.iter().any(|&s| self.cost(p, s) < most)
                    || !others.is_empty()
                        && near.into_iter().any(|q| is_other(self.states[q]) && self.exchange_cost(p, q) < most);
                if doubt {
                    doubtful.push(p);
                }
            }
        }
        doubtful
    }
}

fn difference(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
    [0, 1, 2, 3].map(|k| a[k] - b[k])
}

/// The classes that each pixel may have, as bits.
pub(super) struct Allowed {
    /// The classes that occur at all.
    classes: Vec<u16>,
    words: usize,
    bits: Vec<u64>,
}

impl Allowed {
    pub(super) fn new(mut classes: Vec<u16>, pixels: usize) -> Self {
        classes.sort_unstable();
        classes.dedup();
        let words = classes.len().div_ceil(64);
        Allowed { bits: vec![0; words * pixels], words, classes }
    }

    /// The classes that occur.
    pub(super) fn occurring(&self) -> &[u16] {
        &self.classes
    }

    pub(super) fn allow(&mut self, p: usize, class: u16) {
        if let Ok(k) = self.classes.binary_search(&class) {
            self.bits[p * self.words + k / 64] |= 1 << (k % 64);
        }
    }

    fn any(&self, p: usize) -> bool {
        self.bits[p * self.words..(p + 1) * self.words].iter().any(|&w| w != 0)
    }

    fn has(&self, p: usize, state: State) -> bool {
        state == 0 || self.classes(p).any(|k| k + 1 == state)
    }

    fn classes(&self, p: usize) -> impl Iterator<Item = u16> + '_ {
        let bits = &self.bits[p * self.words..(p + 1) * self.words];
        self.classes.iter().enumerate().filter(|(k, _)| bits[k / 64] >> (k % 64) & 1 == 1).map(|(_, &class)| class)
    }
}
