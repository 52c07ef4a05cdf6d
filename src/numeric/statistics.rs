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

/// Several weighted quantiles with one sort; see [`weighted_quantile`].
pub fn weighted_quantiles(values: &[f64], weights: &[f64], qs: &[f64]) -> Option<Vec<f64>> {
    assert_eq!(values.len(), weights.len());
    let total: f64 = weights.iter().sum();
    if values.is_empty() || total <= 0.0 {
        return None;
    }
    let mut order: Vec<u32> = (0..values.len() as u32).collect();
    order.sort_unstable_by(|&a, &b| values[a as usize].total_cmp(&values[b as usize]).then(a.cmp(&b)));
    let pick = |q: f64| {
        let mut cumulated = 0.0;
        for &i in &order {
            cumulated += weights[i as usize];
            if cumulated >= q * total {
                return values[i as usize];
            }
        }
        values[order[order.len() - 1] as usize]
    };
    Some(qs.iter().map(|&q| pick(q)).collect())
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
}
