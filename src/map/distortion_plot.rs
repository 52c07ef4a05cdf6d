//! A histogram of the length factors of a map as SVG: how much of the surface is stretched, and squeezed, how much.
//!
//! The outline of `s1` (greatest length factor of each face) and that of `s2` (least) are drawn over one scale that is
//! symmetrical around 1 and holds 99 % of both; what lies beyond is gathered in the last bar of its side. Areas are those
//! on the surface. Cost: linear.

use super::grid::next_in_series;
use crate::unwrap::distortion::{Distribution, FaceDistortion};
use std::fmt::Write;

/// Bars on each side of 1.
const BARS: usize = 40;
/// Least half width of the scale: the map of a smooth straight tunnel is not blown up to rounding.
const LEAST_RANGE: f64 = 0.01;
/// Where the plot lies on its page, pixels.
const LEFT: f64 = 60.0;
const RIGHT: f64 = 740.0;
const TOP: f64 = 44.0;
const BOTTOM: f64 = 250.0;

/// The histogram of the faces of a map.
pub fn distortion_histogram(faces: &[FaceDistortion]) -> String {
    let defined: Vec<&FaceDistortion> = faces.iter().filter(|f| f.is_defined()).collect();
    let areas: Vec<f64> = defined.iter().map(|f| f.area).collect();
    let series = [
        ("s1, greatest length factor", "#b8402a", defined.iter().map(|f| f.s1).collect::<Vec<f64>>()),
        ("s2, least length factor", "#2668ac", defined.iter().map(|f| f.s2).collect::<Vec<f64>>()),
    ];
    let spread = series.each_ref().map(|(.., values)| Distribution::of(values, &areas));
    let range = next_in_series((spread[0].p99 - 1.0).max(1.0 - percentile_01(&series[1].2, &areas)).max(LEAST_RANGE));
    let total: f64 = areas.iter().sum();
    let shares = series.each_ref().map(|(.., values)| shares(values, &areas, range, total));
    let most = shares.iter().flatten().fold(1e-9, |m: f64, s| m.max(*s));
    let x = |factor: f64| LEFT + (factor - 1.0 + range) / (2.0 * range) * (RIGHT - LEFT);
    let y = |share: f64| BOTTOM - share / most * (BOTTOM - TOP);

    let mut svg = String::from(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 800 300\" font-family=\"sans-serif\" font-size=\"13\">\
         <rect width=\"800\" height=\"300\" fill=\"#fff\"/>\n",
    );
    for k in -4i32..=4 {
        let factor = 1.0 + range * f64::from(k) / 4.0;
        let decimals = if range < 0.04 { 4 } else { 3 };
        let _ = writeln!(
            svg,
            "<line x1=\"{0:.1}\" x2=\"{0:.1}\" y1=\"{TOP}\" y2=\"{BOTTOM}\" stroke=\"{1}\"/>\
             <text x=\"{0:.1}\" y=\"268\" text-anchor=\"middle\">{factor:.decimals$}</text>",
            x(factor),
            if k == 0 { "#666" } else { "#ddd" }
        );
    }
    for ((name, color, _), (shares, spread)) in series.iter().zip(shares.iter().zip(&spread)) {
        let mut outline = format!("M{LEFT:.1} {BOTTOM:.1}");
        for (bar, share) in shares.iter().enumerate() {
            let edge = |bar: usize| LEFT + (RIGHT - LEFT) * bar as f64 / shares.len() as f64;
            let _ = write!(outline, "L{:.1} {2:.1}L{:.1} {2:.1}", edge(bar), edge(bar + 1), y(*share));
        }
        let place = if name.starts_with("s1") { 400.0 } else { LEFT };
        let _ = writeln!(
            svg,
            "<path d=\"{outline}L{RIGHT:.1} {BOTTOM:.1}Z\" fill=\"{color}\" fill-opacity=\"0.25\" stroke=\"{color}\"/>\
             <text x=\"{place}\" y=\"18\" fill=\"{color}\">{name}</text>\
             <text x=\"{place}\" y=\"34\" fill=\"{color}\">5 % {:.4}, half {:.4}, 95 % {:.4}</text>",
            spread.p05, spread.p50, spread.p95
        );
    }
    let _ = writeln!(
        svg,
        "<text x=\"{:.1}\" y=\"290\" text-anchor=\"middle\">length on the map / length on the surface</text>\
         <text x=\"52\" y=\"{:.1}\" text-anchor=\"end\">{:.1} %</text><text x=\"52\" y=\"{BOTTOM}\" text-anchor=\"end\">0</text>\
         </svg>",
        (LEFT + RIGHT) / 2.0,
        TOP + 10.0,
        100.0 * most
    );
    svg
}

/// Share of the area in each bar; the first and the last hold everything beyond.
fn shares(values: &[f64], areas: &[f64], range: f64, total: f64) -> Vec<f64> {
    let mut shares = vec![0.0; 2 * BARS];
    for (value, area) in values.iter().zip(areas) {
        let at = (value - 1.0 + range) / range * BARS as f64;
        shares[(at.max(0.0) as usize).min(2 * BARS - 1)] += area / total.max(f64::MIN_POSITIVE);
    }
    shares
}

/// One per cent of the area lies below.
fn percentile_01(values: &[f64], areas: &[f64]) -> f64 {
    let mirrored: Vec<f64> = values.iter().map(|v| -v).collect();
    -Distribution::of(&mirrored, areas).p99
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_hold_the_area_and_the_ends_everything_beyond() {
        let face = |s1: f64, s2: f64, area: f64| FaceDistortion { s1, s2, direction: 0.0, area };
        let shares = shares(&[0.5, 1.0001, 1.04999, 2.0], &[1.0, 5.0, 2.0, 2.0], 0.05, 10.0);
        assert_eq!(shares.len(), 2 * BARS);
        assert!((shares[0] - 0.1).abs() < 1e-15 && (shares[BARS] - 0.5).abs() < 1e-15);
        assert!((shares[2 * BARS - 1] - 0.4).abs() < 1e-15);
        let svg = distortion_histogram(&[face(1.02, 0.97, 1.0), face(1.01, 0.99, 3.0), face(f64::NAN, f64::NAN, 0.0)]);
        assert!(svg.contains("half 1.0100") && svg.contains("half 0.9900") && !svg.contains("NaN"), "{svg}");
        assert!(!distortion_histogram(&[]).contains("NaN"));
    }
}
