//! The painted shares of the edited picture, in the pixels of the map.

use super::compare::{Sampler, Seen, State};
use super::rgb;
use crate::cloud::Label;
use crate::lift::label_map::{LabelMap, NO_SURFACE};
use crate::map::{PaletteEntry, Picture, Placement, color_distance};
use crate::numeric::Vec2;
use rayon::prelude::*;

/// The classes in the pixels of the map, over the part of it that the edited picture shows.
pub(super) fn on_the_map(
    sample: &Sampler,
    labels: &Picture,
    palette: &[PaletteEntry],
    classes: &[PaletteEntry],
    seen: &[Seen],
    paint: &[(u16, f32)],
) -> LabelMap {
    let (width, height) = (sample.edited.width, sample.edited.height);
    let low = sample.map_from_edited(0.0, 0.0);
    let high = sample.map_from_edited(width as f64, height as f64);
    let clip = |x: f64, end: usize| (x.round().max(0.0) as usize).min(end);
    let (c0, c1) = (clip(low.x, labels.width), clip(high.x, labels.width));
    let (r0, r1) = (clip(low.y, labels.height), clip(high.y, labels.height));
    let (out_width, out_height) = (c1.saturating_sub(c0), r1.saturating_sub(r0));
    let mut out = vec![NO_SURFACE; out_width * out_height];
    let placement = Placement {
        first_centre: sample.placement.chart_from_pixel(Vec2::new(c0 as f64 + 0.5, r0 as f64 + 0.5)),
        ..sample.placement
    };
    let label_at = |i: usize| {
        let at = (i / out_width + r0) * labels.width + i % out_width + c0;
        if labels.rgba[4 * at + 3] < 128 {
            return NO_SURFACE;
        }
        let before = nearest_class(palette, rgb(labels, at));
        let uv = placement.chart_from_pixel(Vec2::new((i % out_width) as f64 + 0.5, (i / out_width) as f64 + 0.5));
        let p = sample.own.pixel_from_chart(uv) - Vec2::repeat(0.5);
        let (x, y) = (p.x.floor(), p.y.floor());
        let (tx, ty) = (p.x - x, p.y - y);
        let pixel = |dx: f64, dy: f64| {
            let c = (x + dx).clamp(0.0, width as f64 - 1.0) as usize;
            let r = (y + dy).clamp(0.0, height as f64 - 1.0) as usize;
            r * width + c
        };
        let around = [
            (pixel(0.0, 0.0), (1.0 - tx) * (1.0 - ty)),
            (pixel(1.0, 0.0), tx * (1.0 - ty)),
            (pixel(0.0, 1.0), (1.0 - tx) * ty),
            (pixel(1.0, 1.0), tx * ty),
        ];
        let mut shares: [(u16, f64); 4] = [(0, 0.0); 4];
        let (mut total, mut erased) = (0.0, 0.0);
        for (k, (n, weight)) in around.into_iter().enumerate() {
            let (class, share) = paint[n];
            let share = f64::from(share) * weight;
            // The same class in several of the four pixels counts together.
            let slot = (0..k).find(|&j| shares[j].0 == class && shares[j].1 > 0.0).unwrap_or(k);
            shares[slot] = (class, shares[slot].1 + share);
            total += share;
            erased += if seen[n].state == State::Erased { weight } else { 0.0 };
        }
        if erased >= 0.5 {
            return 0;
        }
        if total < 0.5 - 1e-6 {
            return before;
        }
        let most = shares.iter().fold((0u16, 0.0), |m, s| if s.1 > m.1 { *s } else { m });
        classes[usize::from(most.0)].value
    };
    out.par_iter_mut().enumerate().for_each(|(i, label)| *label = label_at(i));
    LabelMap { width: out_width, height: out_height, placement, labels: out }
}

fn nearest_class(classes: &[PaletteEntry], color: [u8; 3]) -> Label {
    classes.iter().map(|e| (color_distance(e.color, color), e.value)).min().map_or(0, |(_, label)| label)
}
