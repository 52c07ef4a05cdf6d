//! The painted shares of the edited picture, in the pixels of the map.

use super::compare::{Sampler, Seen, State};
use super::rgb;
use crate::cloud::Label;
use crate::lift::label_map::{LabelMap, NO_SURFACE};
use crate::map::{PaletteEntry, Picture, Placement, color_distance};
use crate::numeric::Vec2;
use rayon::prelude::*;

/// Classes (their places in the list) that a pixel is painted with, and how much of it.
pub(super) type Shares = [(u16, f32); 2];

/// The label map as it went out, drawn with its palette.
pub(super) struct LabelsBefore<'a> {
    pub(super) picture: &'a Picture,
    pub(super) palette: &'a [PaletteEntry],
}

/// Where pixels hold mixtures, the class of a pixel of the map leads the next one by this share of what is painted, or the
/// pixel could be either.
const LEAD: f64 = 0.3;

/// The classes in the pixels of the map, over the part of it that the edited picture shows, and how many of its pixels
/// could have either of two classes.
pub(super) fn on_the_map(
    sample: &Sampler,
    before: &LabelsBefore,
    classes: &[PaletteEntry],
    seen: &[Seen],
    paint: &[Shares],
    mixed: bool,
) -> (LabelMap, usize) {
    let labels = before.picture;
    let (width, height) = (sample.edited.width, sample.edited.height);
    let low = sample.map_from_edited(0.0, 0.0);
    let high = sample.map_from_edited(width as f64, height as f64);
    let clip = |x: f64, end: usize| (x.round().max(0.0) as usize).min(end);
    let (c0, c1) = (clip(low.x, labels.width), clip(high.x, labels.width));
    let (r0, r1) = (clip(low.y, labels.height), clip(high.y, labels.height));
    let (out_width, out_height) = (c1.saturating_sub(c0), r1.saturating_sub(r0));
    let placement = Placement {
        first_centre: sample.placement.chart_from_pixel(Vec2::new(c0 as f64 + 0.5, r0 as f64 + 0.5)),
        ..sample.placement
    };
    let label_at = |i: usize| -> (Label, bool) {
        let at = (i / out_width + r0) * labels.width + i % out_width + c0;
        if labels.rgba[4 * at + 3] < 128 {
            return (NO_SURFACE, false);
        }
        let uv = placement.chart_from_pixel(Vec2::new((i % out_width) as f64 + 0.5, (i / out_width) as f64 + 0.5));
        let p = sample.own.pixel_from_chart(uv) - Vec2::repeat(0.5);
        let (x, y) = (p.x.floor(), p.y.floor());
        let (tx, ty) = (p.x - x, p.y - y);
        let mut shares = Totals::default();
        let mut erased = 0.0;
        for (k, wy) in [1.0 - ty, ty].into_iter().enumerate() {
            for (j, wx) in [1.0 - tx, tx].into_iter().enumerate() {
                let weight = wx * wy;
                if weight == 0.0 {
                    continue;
                }
                let c = (x + j as f64).clamp(0.0, width as f64 - 1.0) as usize;
                let r = (y + k as f64).clamp(0.0, height as f64 - 1.0) as usize;
                let n = r * width + c;
                for (class, share) in paint[n] {
                    shares.add(class, f64::from(share) * weight);
                }
                erased += if seen[n].state == State::Erased { weight } else { 0.0 };
            }
        }
        if erased >= 0.5 {
            return (0, false);
        }
        let own = || nearest_class(before.palette, rgb(labels, at));
        let (class, first, second) = shares.leaders();
        if shares.total < 0.5 - 1e-6 {
            (own(), false)
        } else if mixed && first - second < LEAD * shares.total {
            (own(), true)
        } else {
            (classes[usize::from(class)].value, false)
        }
    };
    let found: Vec<(Label, bool)> = (0..out_width * out_height).into_par_iter().map(label_at).collect();
    let undecided = found.iter().filter(|f| f.1).count();
    let labels = found.into_iter().map(|f| f.0).collect();
    (LabelMap { width: out_width, height: out_height, placement, labels }, undecided)
}

/// Shares of the classes around a place; those of one class count together.
#[derive(Default)]
struct Totals {
    classes: [(u16, f64); 8],
    used: usize,
    total: f64,
}

impl Totals {
    fn add(&mut self, class: u16, share: f64) {
        if share == 0.0 {
            return;
        }
        self.total += share;
        let known = (0..self.used).find(|&k| self.classes[k].0 == class);
        // Should more classes than these meet within four pixels, then none of them leads.
        if let Some(k) = known.or_else(|| (self.used < self.classes.len()).then_some(self.used)) {
            self.used = self.used.max(k + 1);
            self.classes[k] = (class, self.classes[k].1 + share);
        }
    }

    /// The class with the greatest share, that share, and the next one.
    fn leaders(&self) -> (u16, f64, f64) {
        let (mut class, mut first, mut second) = (0, 0.0, 0.0);
        for &(c, share) in &self.classes[..self.used] {
            if share > first {
                (class, first, second) = (c, share, first);
            } else if share > second {
                second = share;
            }
        }
        (class, first, second)
    }
}

fn nearest_class(classes: &[PaletteEntry], color: [u8; 3]) -> Label {
    classes.iter().map(|e| (color_distance(e.color, color), e.value)).min().map_or(0, |(_, label)| label)
}
