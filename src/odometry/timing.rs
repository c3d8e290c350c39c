//! Choice of the times of the points by the residuals of the odometry.
//!
//! Points that were measured while the sensor moved agree with the scans before only if they are compensated with
//! their true times. The odometry runs once with each candidate; its residual has the least value for the right
//! one. Near the right times it grows with the square of the error: the residual of compensated scans,
//! candidates none (0), clockwise (1) and counter-clockwise (−1), is that of 0 by the same amount below both
//! others, that of clockwise scans by one quarter of the whole range below the next. The scan of a sensor at rest has
//! the same residual with all candidates.

use super::config::OdometryConfig;
use super::odometer::{Odometer, OdometryError};
use crate::lidar::{Rotation, Scan};
use crate::validation::{InvalidValue, Validate as _};

/// Residuals of the odometry with each candidate for the times of the points.
#[derive(Clone, Debug, PartialEq)]
pub struct TimingComparison {
    /// The candidates, `None` for points without times, with the mean residual of the odometry [m].
    pub residuals_m: Vec<(Option<Rotation>, f64)>,
    /// Index of the candidate that fits; `None` if the residuals do not decide, as without motion.
    pub best: Option<usize>,
}

/// A run of scans whose timing cannot be compared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TimingError {
    /// A setting of the odometry.
    #[error(transparent)]
    InvalidValue(#[from] InvalidValue),
    /// A scan that does not follow its predecessor.
    #[error(transparent)]
    Odometry(#[from] OdometryError),
}

/// Compares candidates for the times of the points on consecutive scans, ten or more with motion. Times that the scans
/// have are ignored.
pub fn compare_timings(
    scans: &[Scan],
    candidates: &[Option<Rotation>],
    config: &OdometryConfig,
) -> Result<TimingComparison, TimingError> {
    config.validate()?;
    let residuals_m = (candidates.iter())
        .map(|&candidate| Ok((candidate, mean_residual(scans, candidate, config)?)))
        .collect::<Result<Vec<_>, TimingError>>()?;
    let values: Vec<f64> = residuals_m
        .iter()
        .map(|(_, residual_m)| *residual_m)
        .collect();
    Ok(TimingComparison {
        best: decide(&values),
        residuals_m,
    })
}

/// Mean residual of the registered scans; infinite if there are none [m].
fn mean_residual(
    scans: &[Scan],
    candidate: Option<Rotation>,
    config: &OdometryConfig,
) -> Result<f64, TimingError> {
    let mut odometer = Odometer::new(config.clone())?;
    let (mut sum_m, mut count) = (0.0, 0);
    for scan in scans {
        let mut scan = scan.clone();
        scan.times_s =
            candidate.map_or_else(Vec::new, |rotation| rotation.point_times(&scan.points));
        if let Some(residual_m) = odometer.step(&scan)?.residual_m {
            sum_m += residual_m;
            count += 1;
        }
    }
    Ok(match count {
        0 => f64::INFINITY,
        _ => sum_m / f64::from(count),
    })
}

/// The least residual, if it is clearly below the next.
fn decide(residuals_m: &[f64]) -> Option<usize> {
    /// Smallest difference between the largest and the least residual, as a share of the least.
    const SPREAD: f64 = 0.05;
    /// Smallest difference between the next and the least residual, as a share of the spread: a quarter for exact
    /// times of uncompensated scans.
    const MARGIN: f64 = 0.2;
    let mut order: Vec<usize> = (0..residuals_m.len()).collect();
    order.sort_by(|&a, &b| residuals_m[a].total_cmp(&residuals_m[b]));
    let (&best, &next, &worst) = (order.first()?, order.get(1)?, order.last()?);
    let spread_m = residuals_m[worst] - residuals_m[best];
    let is_clear = residuals_m[worst].is_finite()
        && spread_m >= SPREAD * residuals_m[best]
        && residuals_m[next] - residuals_m[best] >= MARGIN * spread_m;
    is_clear.then_some(best)
}
