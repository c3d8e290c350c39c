//! How often something succeeds, and how sure that is.
//!
//! ```text
//! centre ± reach = (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n)     z = 1.96
//! ```
//!
//! Wilson, *Probable inference, the law of succession, and statistical inference*, JASA 1927:
//! an interval that stays within 0 and 1, also of five successes in five.

use crate::app::reporting::SuccessRate;

/// Of so many successes in so many runs; `None` of no runs.
pub fn success_rate(successes: usize, runs: usize) -> Option<SuccessRate> {
    const Z: f64 = 1.959_964;
    if runs == 0 {
        return None;
    }
    let n = runs as f64;
    let rate = successes as f64 / n;
    let squared = Z * Z / n;
    let centre = rate + 0.5 * squared;
    let reach = Z * (rate * (1.0 - rate) / n + 0.25 * squared / n).sqrt();
    Some(SuccessRate {
        successes,
        runs,
        rate,
        low: ((centre - reach) / (1.0 + squared)).max(0.0),
        high: ((centre + reach) / (1.0 + squared)).min(1.0),
    })
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn the_interval_is_that_of_the_formula() {
        // The formula in NumPy for 8 of 10:
        // (0.4901624691, 0.9433178490)
        let rate = success_rate(8, 10).unwrap();
        assert_relative_eq!(rate.low, 0.490_162_5, epsilon = 1e-6);
        assert_relative_eq!(rate.high, 0.943_317_8, epsilon = 1e-6);
    }

    #[test]
    fn five_of_five_are_not_certain_and_failures_mirror_successes() {
        let all = success_rate(5, 5).unwrap();
        assert_eq!((all.rate, all.high), (1.0, 1.0));
        assert!(all.low > 0.5 && all.low < 0.6);
        let none = success_rate(0, 5).unwrap();
        assert_relative_eq!(none.high, 1.0 - all.low, epsilon = 1e-12);
        assert_eq!(success_rate(0, 0), None);
    }
}
