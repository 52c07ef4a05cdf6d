//! How pixels of the map become pixels of a picture of another size: weighted means along rows, then along columns.

use std::ops::Range;

/// A position on the border of two pixels belongs to the later one, whatever the last bit of a world file says.
const BORDER: f64 = 1e-6;

/// Shape of the weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kernel {
    /// The pixel under the centre.
    Nearest,
    /// The pixel under the upper left corner.
    Corner,
    Box,
    Triangle,
    Hamming,
    /// Keys' cubic with a = -1/2 (Catmull-Rom).
    Cubic,
    /// Lanczos with three lobes.
    Lanczos,
}

impl Kernel {
    pub(super) const ALL: [Kernel; 7] = [
        Kernel::Box,
        Kernel::Triangle,
        Kernel::Hamming,
        Kernel::Cubic,
        Kernel::Lanczos,
        Kernel::Nearest,
        Kernel::Corner,
    ];

    /// Whether it swings beyond the colours around an edge.
    pub(super) fn sharpens(self) -> bool {
        matches!(self, Kernel::Cubic | Kernel::Lanczos)
    }

    /// Whether colours stay what they are.
    pub(super) fn is_exact(self) -> bool {
        matches!(self, Kernel::Nearest | Kernel::Corner)
    }

    /// Half width.
    fn support(self) -> f64 {
        match self {
            Kernel::Nearest | Kernel::Corner => 0.0,
            Kernel::Box => 0.5,
            Kernel::Triangle | Kernel::Hamming => 1.0,
            Kernel::Cubic => 2.0,
            Kernel::Lanczos => 3.0,
        }
    }

    fn at(self, x: f64) -> f64 {
        use std::f64::consts::PI;
        let sinc = |x: f64| if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) };
        let d = x.abs();
        match self {
            Kernel::Nearest | Kernel::Corner => 1.0,
            Kernel::Box => f64::from(u8::from(x > -0.5 && x <= 0.5)),
            Kernel::Triangle => (1.0 - d).max(0.0),
            Kernel::Hamming if d >= 1.0 => 0.0,
            Kernel::Hamming => sinc(d) * (0.54 + 0.46 * (PI * d).cos()),
            Kernel::Cubic if d < 1.0 => (1.5 * d - 2.5) * d * d + 1.0,
            Kernel::Cubic if d < 2.0 => ((-0.5 * d + 2.5) * d - 4.0) * d + 2.0,
            Kernel::Lanczos if d < 3.0 => sinc(d) * sinc(d / 3.0),
            Kernel::Cubic | Kernel::Lanczos => 0.0,
        }
    }
}

/// A kernel and how far it is spread.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Filter {
    pub(super) kernel: Kernel,
    /// The kernel is as wide as for pictures that are smaller by this factor, at least.
    pub(super) spread: f64,
}

impl Filter {
    pub(super) fn of(kernel: Kernel) -> Self {
        Filter { kernel, spread: 1.0 }
    }
}

/// Where the pixels of a picture lie in pixels of the map, along one axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Axis {
    /// Of the picture's edge.
    pub(super) origin: f64,
    /// Pixels of the map in one of the picture.
    pub(super) scale: f64,
}

impl Axis {
    fn centre(&self, k: usize) -> f64 {
        self.origin + (k as f64 + 0.5) * self.scale
    }

    /// Pixels of the map that a pixel of the picture is made of, of those that the picture covers.
    fn reach(&self, filter: Filter, k: usize, covered: &Range<usize>) -> Range<usize> {
        let inside = |x: f64| (x.max(0.0) as usize).clamp(covered.start, covered.end);
        let from_place = |x: f64| {
            let j = inside(x + BORDER).min(covered.end - 1);
            j..j + 1
        };
        match filter.kernel {
            Kernel::Nearest => from_place(self.centre(k)),
            Kernel::Corner => from_place(self.origin + k as f64 * self.scale),
            kernel => {
                let half = kernel.support() * self.scale.max(filter.spread);
                let centre = self.centre(k);
                let first = inside(centre - half + 0.5).min(covered.end - 1);
                first..inside(centre + half + 0.5).max(first + 1)
            }
        }
    }

    /// Pixels of the picture (of `count`) that are made of pixels in `window` alone.
    pub(super) fn complete(
        &self,
        filter: Filter,
        count: usize,
        window: &Range<usize>,
        covered: &Range<usize>,
    ) -> Range<usize> {
        let clip = |x: f64| (x.max(0.0) as usize).min(count);
        let first = clip((window.start as f64 - self.origin) / self.scale - 1.0);
        let last = clip((window.end as f64 - self.origin) / self.scale + 2.0);
        let is_complete = |&k: &usize| {
            let (reach, centre) = (self.reach(filter, k, covered), self.centre(k));
            let beside = centre < covered.start as f64 || centre > covered.end as f64;
            !beside && reach.start >= window.start && reach.end <= window.end
        };
        let from = (first..last).find(is_complete).unwrap_or(last);
        from..(from..last).rev().find(is_complete).map_or(from, |k| k + 1)
    }
}

/// Weights along one axis: each element of the outcome is made of a run of elements.
#[derive(Clone, Debug, Default)]
pub(super) struct Band {
    /// First element of each run, and where its weights end.
    runs: Vec<(u32, u32)>,
    weights: Vec<f32>,
}

impl Band {
    /// The weights of `window` pixels of the map (counted from its start) in `picture` pixels.
    pub(super) fn new(
        axis: Axis,
        filter: Filter,
        picture: Range<usize>,
        window: &Range<usize>,
        covered: &Range<usize>,
    ) -> Self {
        let mut band = Band::default();
        let mut weights = Vec::new();
        for k in picture {
            let (reach, centre) = (axis.reach(filter, k, covered), axis.centre(k));
            let spread = axis.scale.max(filter.spread);
            let single = reach.len() == 1;
            weights.clear();
            weights.extend(
                reach.clone().map(|j| if single { 1.0 } else { filter.kernel.at((j as f64 + 0.5 - centre) / spread) }),
            );
            let sum: f64 = weights.iter().sum();
            band.push(reach.start - window.start, weights.iter().map(|w| (w / sum) as f32));
        }
        band
    }

    fn push(&mut self, start: usize, weights: impl Iterator<Item = f32>) {
        self.weights.extend(weights);
        self.runs.push((start as u32, self.weights.len() as u32));
    }

    pub(super) fn len(&self) -> usize {
        self.runs.len()
    }

    /// First element and weights of a run.
    pub(super) fn run(&self, k: usize) -> (usize, &[f32]) {
        let from = if k == 0 { 0 } else { self.runs[k - 1].1 as usize };
        (self.runs[k].0 as usize, &self.weights[from..self.runs[k].1 as usize])
    }

    /// Centre of gravity of a run, in elements; (0, 0) is the edge of the first.
    pub(super) fn centre(&self, k: usize) -> f64 {
        let (start, weights) = self.run(k);
        weights.iter().enumerate().map(|(j, w)| f64::from(*w) * ((start + j) as f64 + 0.5)).sum()
    }

    /// Each element as a weighted sum of elements of this band: `combination(k)` gives the first and the weights.
    pub(super) fn combined(&self, count: usize, combination: impl Fn(usize) -> (usize, Vec<f32>)) -> Self {
        let mut band = Band::default();
        for k in 0..count {
            let (first, outer) = combination(k);
            let start = self.run(first).0;
            let end = (first..first + outer.len()).map(|e| self.run(e).0 + self.run(e).1.len()).max().unwrap_or(start);
            let mut sums = vec![0.0; end - start];
            for (e, factor) in outer.iter().enumerate() {
                let (from, weights) = self.run(first + e);
                weights.iter().enumerate().for_each(|(j, w)| sums[from - start + j] += factor * w);
            }
            band.push(start, sums.into_iter());
        }
        band
    }

    /// For each of `count` elements that runs are made of: the runs it is in, and its weights there.
    pub(super) fn transposed(&self, count: usize) -> Self {
        let mut ranges = vec![(usize::MAX, 0); count];
        for k in 0..self.len() {
            let (start, weights) = self.run(k);
            for range in &mut ranges[start..start + weights.len()] {
                *range = (range.0.min(k), k + 1);
            }
        }
        let mut band = Band::default();
        for (j, &(first, end)) in ranges.iter().enumerate() {
            let weight = |k: usize| {
                let (start, weights) = self.run(k);
                j.checked_sub(start).and_then(|at| weights.get(at)).copied().unwrap_or(0.0)
            };
            let first = first.min(end);
            band.push(first, (first..end).map(weight));
        }
        band
    }
}

/// Colours of pixels of the map (`width` in a row) taken through both axes.
pub(super) fn resample(pixels: &[[f32; 4]], width: usize, columns: &Band, rows: &Band) -> Vec<[f32; 4]> {
    let height = pixels.len() / width.max(1);
    let sum = |weights: &[f32], pixel: &dyn Fn(usize) -> [f32; 4]| {
        let mut sum = [0.0f32; 4];
        for (j, w) in weights.iter().enumerate() {
            let c = pixel(j);
            (0..4).for_each(|k| sum[k] += w * c[k]);
        }
        sum
    };
    let mut wide = Vec::with_capacity(height * columns.len());
    for row in pixels.chunks_exact(width.max(1)) {
        for x in 0..columns.len() {
            let (start, weights) = columns.run(x);
            wide.push(sum(weights, &|j| row[start + j]));
        }
    }
    let mut out = Vec::with_capacity(rows.len() * columns.len());
    for y in 0..rows.len() {
        let (start, weights) = rows.run(y);
        for x in 0..columns.len() {
            out.push(sum(weights, &|j| wide[(start + j) * columns.len() + x]));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(kernel: Kernel, scale: f64, k: usize) -> (usize, Vec<f32>) {
        let axis = Axis { origin: 0.0, scale };
        let band = Band::new(axis, Filter::of(kernel), 0..4, &(0..20), &(0..20));
        let (start, weights) = band.run(k);
        (start, weights.to_vec())
    }

    #[test]
    fn weights_are_those_of_the_usual_programs() {
        assert_eq!(row(Kernel::Box, 2.0, 1), (2, vec![0.5, 0.5]));
        assert_eq!(row(Kernel::Triangle, 2.0, 1), (1, vec![0.125, 0.375, 0.375, 0.125]));
        assert_eq!(row(Kernel::Nearest, 2.0, 1), (3, vec![1.0]));
        assert_eq!(row(Kernel::Corner, 2.0, 1), (2, vec![1.0]));
        assert_eq!(row(Kernel::Triangle, 0.5, 3), (1, vec![0.75, 0.25]));
        for kernel in Kernel::ALL {
            for scale in [0.5, 1.0, 1.49, 2.0] {
                assert!((row(kernel, scale, 2).1.iter().sum::<f32>() - 1.0).abs() < 1e-6, "{kernel:?} {scale}");
            }
        }
    }

    #[test]
    fn a_transposed_band_has_the_same_weights() {
        let axis = Axis { origin: 0.3, scale: 1.7 };
        let band = Band::new(axis, Filter::of(Kernel::Cubic), 0..9, &(0..20), &(0..20));
        let other = band.transposed(20);
        let weight = |band: &Band, k: usize, j: usize| {
            let (start, weights) = band.run(k);
            j.checked_sub(start).and_then(|at| weights.get(at)).copied().unwrap_or(0.0)
        };
        for k in 0..9 {
            for j in 0..20 {
                assert_eq!(weight(&band, k, j), weight(&other, j, k));
            }
        }
    }
}
