//! Curves along the chainage, below the map: azimuth, gradient, coverage, distortion.

use super::page::{Align, Item, Page, text_width_mm};
use super::{CAP, FAINT, INK};

/// Values along the tunnel.
#[derive(Clone, Debug, PartialEq)]
pub struct Strip {
    /// What they are.
    pub name: String,
    /// Their unit.
    pub unit: String,
    /// Chainage (metres) and value; a value that is not finite interrupts the curve.
    pub values: Vec<[f64; 2]>,
    /// Value at the bottom and at the top of the strip.
    pub range: [f64; 2],
    /// Red, green, blue of the curve.
    pub color: [u8; 3],
}

/// A range that holds the values, from a little below to a little above, at least `least` wide.
pub fn nice_range(values: impl Iterator<Item = f64>, least: f64) -> [f64; 2] {
    let (low, high) =
        values.filter(|v| v.is_finite()).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if low > high {
        return [0.0, least];
    }
    let step = crate::map::grid::next_in_series(((high - low).max(least)) / 4.0);
    let bottom = (low / step).floor() * step;
    let top = ((high / step).ceil() * step).max(bottom + least);
    [bottom, top]
}

impl Strip {
    /// Draws the strip between two chainages; `turn` takes millimetres along and across to the page.
    #[allow(clippy::too_many_arguments, reason = "the frame of the strip, told once")]
    pub(super) fn draw(
        &self,
        page: &mut Page,
        [u0, u1]: [f64; 2],
        wide: f64,
        top: f64,
        height: f64,
        upright: bool,
        turn: &dyn Fn(Vec<[f64; 2]>) -> Vec<[f64; 2]>,
    ) {
        let corners = vec![[0.0, top], [wide, top], [wide, top + height], [0.0, top + height], [0.0, top]];
        page.line(&turn(corners), 0.12, FAINT);
        let middle = vec![[0.0, top + height / 2.0], [wide, top + height / 2.0]];
        page.line(&turn(middle), 0.05, FAINT);
        let [low, high] = self.range;
        let place = |[u, value]: [f64; 2]| {
            let share = ((value - low) / (high - low)).clamp(0.0, 1.0);
            [(u - u0) / (u1 - u0) * wide, top + height * (1.0 - share)]
        };
        let mut part: Vec<[f64; 2]> = Vec::new();
        let mut finish = |part: &mut Vec<[f64; 2]>| {
            let points = turn(std::mem::take(part));
            if points.len() > 1 {
                page.items.push(Item::Line { points, width_mm: 0.3, color: self.color, dash: vec![] });
            }
        };
        for &value in &self.values {
            if value[0] >= u0 && value[0] <= u1 && value[1].is_finite() {
                part.push(place(value));
            } else {
                finish(&mut part);
            }
        }
        finish(&mut part);
        let cap = 0.75 * CAP;
        let label = |page: &mut Page, text: &str, a: f64, b: f64, align: Align| {
            let at = turn(vec![[a, b]])[0];
            page.items.push(Item::Text { text: text.into(), at, cap_mm: cap, align, color: INK, upwards: upright });
        };
        let name = if self.unit.is_empty() { self.name.clone() } else { format!("{} ({})", self.name, self.unit) };
        let fits = (20.5 / text_width_mm(&name, cap)).min(1.0);
        let at = turn(vec![[-1.5, top + height / 2.0 + 0.4 * cap]])[0];
        let (text, color) = (name, INK);
        page.items.push(Item::Text { text, at, cap_mm: cap * fits, align: Align::End, color, upwards: upright });
        let number = |x: f64| format!("{}", (x * 1e4).round() / 1e4);
        label(page, &number(high), wide + 1.5, top + cap, Align::Start);
        label(page, &number(low), wide + 1.5, top + height, Align::Start);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_round_and_hold_the_values() {
        assert_eq!(nice_range([61.2, 88.7].into_iter(), 1.0), [60.0, 90.0]);
        assert_eq!(nice_range([2.0, 2.0].into_iter(), 4.0), [2.0, 6.0]);
        assert_eq!(nice_range([f64::NAN].into_iter(), 1.0), [0.0, 1.0]);
    }
}
