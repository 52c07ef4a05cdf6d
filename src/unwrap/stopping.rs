//! When iterations stop: what the settings of iterative methods must be, and what is said when they end too early.

use super::{Error, SolveSummary};
use crate::warning::Warning;

/// Refuses a negative tolerance.
///
/// # Errors
/// [`Error::Setting`].
pub(super) fn not_negative(key: &'static str, tolerance: f64) -> Result<(), Error> {
    if tolerance >= 0.0 { Ok(()) } else { Err(Error::Setting { key, value: tolerance, must: "0 or more" }) }
}

/// Refuses a tolerance that is not positive.
///
/// # Errors
/// [`Error::Setting`].
pub(super) fn positive(key: &'static str, tolerance: f64) -> Result<(), Error> {
    if tolerance > 0.0 { Ok(()) } else { Err(Error::Setting { key, value: tolerance, must: "more than 0" }) }
}

/// Warns when the conditions on angles are still off by more than `tolerance` radians.
pub(super) fn warn_of_misfit(method: &str, tolerance: f64, summary: &mut SolveSummary) {
    if !summary.converged {
        summary.warnings.push(Warning::new(
            "not-converged",
            format!(
                "{method} did not converge in {} iterations: conditions off by {:.1e} (wanted {tolerance:e}); the map is \
                 laid out from the angles reached",
                summary.iterations,
                summary.residual.unwrap_or(f64::NAN),
            ),
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tolerances_must_make_sense() {
        assert!(not_negative("k", 0.0).is_ok() && positive("k", 1e-9).is_ok());
        for bad in [-1.0, f64::NAN] {
            assert!(matches!(not_negative("k", bad), Err(Error::Setting { key: "k", .. })));
            assert!(positive("k", bad).is_err());
        }
        assert!(positive("k", 0.0).is_err());
    }
}
