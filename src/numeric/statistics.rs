//! Order statistics, plain and weighted, deterministic for any input order of equal values.

/// The `q`-quantile (0 to 1) of `values` by linear interpolation between order statistics. `values` is reordered.
///
/// Returns `None` when `values` is empty. Non-finite values order by `f64::total_cmp`.
pub fn quantile(values: &mut [f64], q: f64) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let rank = q.clamp(0.0, 1.0) * (values.len() - 1) as f64;
    let low = rank.floor() as usize;
    let (_, &mut at_low, above) = values.select_nth_unstable_by(low, f64::total_cmp);
    let fraction = rank - low as f64;
    if fraction == 0.0 {
        return Some(at_low);
    }
    let next = above.iter().copied().min_by(f64::total_cmp).unwrap_or(at_low);
    Some(at_low + fraction * (next - at_low))
}

/// The median of `values`; see [`quantile`].
pub fn median(values: &mut [f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// The smallest value at which the cumulated weight reaches the share `q` of the total weight.
///
/// Returns `None` when `values` is empty or the weights sum to zero. Panics if the lengths differ.
pub fn weighted_quantile(values: &[f64], weights: &[f64], q: f64) -> Option<f64> {
    weighted_quantiles(values, weights, &[q]).map(|v| v[0])
}

/// Several weighted quantiles; see [`weighted_quantile`].
///
/// Values fall into bins that keep their order; only the bins that hold a quantile are sorted, so the cost is linear
/// unless nearly all values are alike.
pub fn weighted_quantiles(values: &[f64], weights: &[f64], qs: &[f64]) -> Option<Vec<f64>> {
    const BINS: u64 = 1 << 16;
    assert_eq!(values.len(), weights.len());
    let keys = || values.iter().map(|&v| order_key(v));
    let (lowest, highest) = (keys().min()?, keys().max()?);
    let shift = (0..64).find(|&s| (highest - lowest) >> s < BINS).unwrap_or(63);
    let bin_of = |value: f64| ((order_key(value) - lowest) >> shift) as usize;
    let mut in_bin = vec![0.0; BINS as usize];
    values.iter().zip(weights).for_each(|(&v, w)| in_bin[bin_of(v)] += w);
    let total: f64 = in_bin.iter().sum();
    if !(total > 0.0) {
        return None;
    }
    let pick = |q: f64| {
        let (mut below, mut bin) = (0.0, 0);
        while bin + 1 < in_bin.len() && below + in_bin[bin] < q * total {
            below += in_bin[bin];
            bin += 1;
        }
        let mut inside: Vec<(f64, f64)> =
            values.iter().copied().zip(weights.iter().copied()).filter(|(v, _)| bin_of(*v) == bin).collect();
        inside.sort_by(|a, b| a.0.total_cmp(&b.0));
        for &(value, weight) in &inside {
            below += weight;
            if below >= q * total {
                return value;
            }
        }
        // Rounding, or q = 1: the largest value that there is.
        inside.last().map_or_else(|| values.iter().copied().max_by(f64::total_cmp).unwrap_or(f64::NAN), |v| v.0)
    };
    Some(qs.iter().map(|&q| pick(q)).collect())
}

/// An integer that orders like `f64::total_cmp`.
fn order_key(value: f64) -> u64 {
    let bits = value.to_bits();
    if bits >> 63 == 1 { !bits } else { bits | 1 << 63 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_interpolate() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [4.0, 1.0, 2.0, 3.0]), Some(2.5));
        assert_eq!(quantile(&mut [10.0, 0.0], 0.25), Some(2.5));
        assert_eq!(median(&mut []), None);
    }

    #[test]
    fn weights_shift_the_quantile() {
        assert_eq!(weighted_quantile(&[1.0, 2.0, 3.0], &[1.0, 1.0, 10.0], 0.5), Some(3.0));
        assert_eq!(weighted_quantile(&[1.0, 2.0], &[0.0, 0.0], 0.5), None);
    }

    #[test]
    fn bins_give_what_sorting_gives() {
        let values: Vec<f64> = (0..5000u32).map(|i| (f64::from(i * 7919 % 5003) - 2000.0).powi(3) * 1e-3).collect();
        let weights: Vec<f64> = (0..5000u32).map(|i| f64::from(i % 13)).collect();
        let qs = [0.0, 0.001, 0.05, 0.5, 0.95, 0.999, 1.0];
        let mut order: Vec<usize> = (0..5000).collect();
        order.sort_by(|&a, &b| values[a].total_cmp(&values[b]));
        let total: f64 = weights.iter().sum();
        for (q, found) in qs.iter().zip(weighted_quantiles(&values, &weights, &qs).unwrap()) {
            let mut below = 0.0;
            let reached = |&&i: &&usize| {
                below += weights[i];
                below >= q * total
            };
            assert_eq!(values[*order.iter().find(reached).unwrap()], found, "{q}");
        }
        assert_eq!(weighted_quantiles(&[2.5; 40], &[1.0; 40], &[0.3]), Some(vec![2.5]));
    }
}
