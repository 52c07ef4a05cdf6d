//! How rough the wall is: rms of its height over the plane that fits best within a window.
//!
//! When to use: to tell smooth lining, blasted and broken rock apart, and to find spalling; the window is the size of
//! what still counts as roughness, what is larger counts as shape. Heights are those over the mean section, so the bend
//! of the vault does not count.
//!
//! The chart is divided into cells of an eighth of the window; each keeps the moments of the vertices in it, in
//! coordinates of its own centre (so nothing is lost to large chainages). The moments of the cells in the round window
//! around a cell, shifted to its centre, give the plane `h = a + b u + c v` and its residual in closed form. Vertices take
//! the value between the four cells around them.
//!
//! Cost: O(vertices) + 50 x cells.

use crate::numeric::{Vec2, Vec3};
use crate::unwrap::Chart;
use nalgebra::Matrix3;
use rayon::prelude::*;

/// Cells in the width of a window.
const CELLS: usize = 8;
/// Fewest vertices in a window that tell a roughness.
const FEWEST: f64 = 12.0;

/// Moments of vertices: number, and sums of u, v, h, uu, vv, uv, uh, vh, hh.
type Moments = [f64; 10];

/// The roughness at each vertex of the chart in metres (NaN: too few vertices), given heights and the window's width.
pub fn roughness(chart: &Chart, heights: &[f64], window_m: f64) -> Vec<f32> {
    let uv = chart.uv();
    let cell = window_m / CELLS as f64;
    let start = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
    let (low, high) = uv.iter().fold(start, |(l, h), p| (l.inf(p), h.sup(p)));
    let count = |d: f64| (d / cell) as usize + 1;
    let (across, down) = (count(high.x - low.x), count(high.y - low.y));
    let cell_of = |p: &Vec2| [((p.x - low.x) / cell) as usize, ((p.y - low.y) / cell) as usize];
    let mut cells: Vec<Moments> = vec![[0.0; 10]; across * down];
    for (p, &h) in uv.iter().zip(heights) {
        if !h.is_finite() {
            continue;
        }
        let [i, j] = cell_of(p);
        let (u, v) = (p.x - low.x - (i as f64 + 0.5) * cell, p.y - low.y - (j as f64 + 0.5) * cell);
        let terms = [1.0, u, v, h, u * u, v * v, u * v, u * h, v * h, h * h];
        cells[j * across + i].iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
    }
    let reach = (CELLS / 2) as i64;
    let value = |k: usize| {
        let (i, j) = ((k % across) as i64, (k / across) as i64);
        let mut all: Moments = [0.0; 10];
        for dj in -reach..=reach {
            for di in -reach..=reach {
                let (x, y) = (i + di, j + dj);
                let inside = x >= 0 && y >= 0 && x < across as i64 && y < down as i64;
                if inside && di * di + dj * dj <= reach * reach {
                    let shifted = shift(&cells[y as usize * across + x as usize], di as f64 * cell, dj as f64 * cell);
                    all.iter_mut().zip(shifted).for_each(|(sum, m)| *sum += m);
                }
            }
        }
        rms_over_plane(&all)
    };
    let values: Vec<f64> = (0..cells.len()).into_par_iter().map(value).collect();
    let between = |p: &Vec2| {
        let (x, y) = ((p.x - low.x) / cell - 0.5, (p.y - low.y) / cell - 0.5);
        let (i, j) = (x.floor(), y.floor());
        let (mut sum, mut weight) = (0.0, 0.0);
        for (dj, di) in [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)] {
            let (c, r) = (i + di, j + dj);
            if c < 0.0 || r < 0.0 || c >= across as f64 || r >= down as f64 {
                continue;
            }
            let w = (1.0 - (x - c).abs()) * (1.0 - (y - r).abs());
            let value = values[r as usize * across + c as usize];
            if w > 0.0 && value.is_finite() {
                sum += w * value;
                weight += w;
            }
        }
        if weight > 0.0 { (sum / weight) as f32 } else { f32::NAN }
    };
    uv.par_iter().map(between).collect()
}

/// Moments in coordinates in which the cell's centre is at (a, b).
fn shift(m: &Moments, a: f64, b: f64) -> Moments {
    let [n, u, v, h, uu, vv, uv, uh, vh, hh] = *m;
    [
        n,
        u + a * n,
        v + b * n,
        h,
        uu + 2.0 * a * u + a * a * n,
        vv + 2.0 * b * v + b * b * n,
        uv + a * v + b * u + a * b * n,
        uh + a * h,
        vh + b * h,
        hh,
    ]
}

fn rms_over_plane(m: &Moments) -> f64 {
    let [n, u, v, h, uu, vv, uv, uh, vh, hh] = *m;
    if n < FEWEST {
        return f64::NAN;
    }
    let normal = Matrix3::new(n, u, v, u, uu, uv, v, uv, vv);
    let right = Vec3::new(h, uh, vh);
    // Vertices on a line fit a plane in many ways, all with the same residual; that is no window of wall.
    let Some(plane) = normal.cholesky().map(|c| c.solve(&right)) else { return f64::NAN };
    ((hh - plane.dot(&right)).max(0.0) / n).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::example::flat_chart;

    #[test]
    fn waves_count_and_slopes_do_not() {
        let chart = flat_chart(6.0, 3.0, 301, 151);
        // A slope of 30 % far from zero, with waves of 5 mm amplitude and 0.1 m length on the right half.
        let heights: Vec<f64> = chart
            .uv()
            .iter()
            .map(|p| 7.0 + 0.3 * p.x + if p.x > 3.0 { 0.005 * (62.8 * p.y).sin() } else { 0.0 })
            .collect();
        let found = roughness(&chart, &heights, 0.5);
        let at = |x: usize, y: usize| f64::from(found[y * 301 + x]);
        assert!(at(60, 75) < 1e-6, "{}", at(60, 75));
        assert!((at(240, 75) - 0.005 / 2f64.sqrt()).abs() < 2e-4, "{}", at(240, 75));
        assert!(at(300, 150).is_finite());
        let sparse = flat_chart(6.0, 3.0, 7, 4);
        assert!(roughness(&sparse, &[0.0; 28], 0.5).iter().all(|r| r.is_nan()));
    }
}
