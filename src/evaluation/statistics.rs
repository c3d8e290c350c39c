//! Summary statistics.

use serde::{Deserialize, Serialize};

/// Statistics of the magnitudes of errors or times, all in their unit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct Summary {
    /// Root mean square.
    pub rmse: f64,
    /// Arithmetic mean.
    pub mean: f64,
    /// 50th percentile.
    pub median: f64,
    /// 95th percentile.
    pub p95: f64,
    /// Maximum.
    pub max: f64,
}

impl Summary {
    /// The statistics of the magnitudes of numbers; `None` without numbers.
    pub fn new(numbers: &[f64]) -> Option<Self> {
        let mut magnitudes: Vec<f64> = numbers.iter().map(|number| number.abs()).collect();
        magnitudes.sort_by(f64::total_cmp);
        Some(Self {
            rmse: rms(&magnitudes)?,
            mean: mean(&magnitudes)?,
            median: percentile_of_sorted(&magnitudes, 50.0)?,
            p95: percentile_of_sorted(&magnitudes, 95.0)?,
            max: *magnitudes.last()?,
        })
    }
}

/// Arithmetic mean; `None` without numbers.
pub fn mean(numbers: &[f64]) -> Option<f64> {
    (!numbers.is_empty()).then(|| numbers.iter().sum::<f64>() / numbers.len() as f64)
}

/// Root mean square; `None` without numbers.
pub fn rms(numbers: &[f64]) -> Option<f64> {
    let squares: f64 = numbers.iter().map(|number| number * number).sum();
    (!numbers.is_empty()).then(|| (squares / numbers.len() as f64).sqrt())
}

/// Percentile of ascending numbers, interpolated linearly as in NumPy; `None` without numbers.
pub fn percentile_of_sorted(ascending: &[f64], percent: f64) -> Option<f64> {
    let last = ascending.len().checked_sub(1)?;
    let place = percent / 100.0 * last as f64;
    let below = place.floor() as usize;
    let (low, high) = (ascending[below], ascending[(below + 1).min(last)]);
    Some(low + (place - place.floor()) * (high - low))
}

/// Slope of the least-squares line `y = a + b x`; `None` if all x are equal.
pub fn slope(x: &[f64], y: &[f64]) -> Option<f64> {
    let (x_mean, y_mean) = (mean(x)?, mean(y)?);
    let (mut covariance, mut variance) = (0.0, 0.0);
    for (x, y) in x.iter().zip(y) {
        covariance += (x - x_mean) * (y - y_mean);
        variance += (x - x_mean).powi(2);
    }
    (variance > 0.0).then(|| covariance / variance)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn a_summary_does_not_depend_on_signs_or_order() {
        let summary = Summary::new(&[3.0, -4.0, 0.0]).unwrap();
        assert_eq!(summary, Summary::new(&[0.0, 4.0, -3.0]).unwrap());
        assert_relative_eq!(summary.rmse, (25.0_f64 / 3.0).sqrt(), epsilon = 1e-15);
        assert_eq!((summary.median, summary.max), (3.0, 4.0));
        assert_eq!(Summary::new(&[]), None);
    }

    #[test]
    fn percentiles_are_interpolated_as_in_numpy() {
        // numpy.percentile([1, 2, 3, 4, 10], 95) = 8.8
        let ascending = [1.0, 2.0, 3.0, 4.0, 10.0];
        let p95 = percentile_of_sorted(&ascending, 95.0).unwrap();
        assert_relative_eq!(p95, 8.8, epsilon = 1e-12);
        assert_eq!(percentile_of_sorted(&ascending, 100.0), Some(10.0));
        assert_eq!(percentile_of_sorted(&[7.0], 95.0), Some(7.0));
    }

    #[test]
    fn the_slope_of_a_line_is_found_and_a_point_has_none() {
        let x = [0.0, 1.0, 5.0];
        let y = x.map(|x| 3.0 - 0.25 * x);
        assert_relative_eq!(slope(&x, &y).unwrap(), -0.25, epsilon = 1e-15);
        assert_eq!(slope(&[1.0, 1.0], &[0.0, 2.0]), None);
    }
}
