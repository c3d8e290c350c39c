//! Choice of the times of the points by the residuals of the odometry.
//!
//! Points that were measured while the sensor moved agree with the scans before only if they are compensated with
//! their true times. The odometry runs once with each candidate; its residual has the least value for the right
//! one. Near the right times it grows with the square of the error: the residual of compensated scans,
//! candidates none (0), clockwise (1) and counter-clockwise (−1), is that of 0 by the same amount below both
//! others, that of clockwise scans by one quarter of the whole range below the next. The scan of a sensor at rest has
//! the same residual with all candidates.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

use rayon::prelude::*;

use super::config::OdometryConfig;
use super::odometer::{Odometer, OdometryError};
use crate::geometry::wrap_angle;
use crate::lidar::{Rotation, RotationDirection, Scan};
use crate::validation::{InvalidValue, Validate as _};

/// Residuals of the odometry with each candidate for the times of the points.
#[derive(Clone, Debug, PartialEq)]
pub struct TimingComparison {
    /// The candidates, `None` for points without times, then clockwise and counter-clockwise, each with the start of
    /// the revolution that fits it best, with the mean residual of the odometry [m].
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

/// Compares the times of the points of a sensor that turns once in a period [s] with none, on consecutive scans, ten or
/// more with motion. Times that the scans have are ignored.
pub fn compare_timings(
    scans: &[Scan],
    period_s: f64,
    config: &OdometryConfig,
) -> Result<TimingComparison, TimingError> {
    config.validate()?;
    // With wrong times no pose fits as it should; the residuals are compared.
    let config = &OdometryConfig {
        min_common_share: 0.0,
        ..config.clone()
    };
    let runs = Runs { scans, config };
    let order = scans.first().and_then(order_of_firing);
    let mut residuals_m = vec![(None, runs.mean_residual(None)?)];
    for direction in [
        RotationDirection::Clockwise,
        RotationDirection::CounterClockwise,
    ] {
        let from_order = order.filter(|(fired, _)| *fired == direction);
        let rotation = |start_rad| Rotation {
            direction,
            period_s,
            start_rad,
        };
        let first = rotation(from_order.map_or(PI, |(_, start_rad)| start_rad));
        let (rotation, residual_m) = runs.best_start(first)?;
        residuals_m.push((Some(rotation), residual_m));
    }
    let values: Vec<f64> = residuals_m.iter().map(|(_, m)| *m).collect();
    Ok(TimingComparison {
        best: decide(&values),
        residuals_m,
    })
}

/// Sense of rotation, and azimuth at which a revolution starts [rad], of points in the order in which a spinning sensor
/// measured them; `None` of points in another order, such as one beam after the other.
pub fn order_of_firing(scan: &Scan) -> Option<(RotationDirection, f64)> {
    /// Turns from the first to the last point.
    const TURNS: std::ops::RangeInclusive<f64> = 0.9..=1.1;
    /// Largest step back: beams of one moment have different azimuths [rad].
    const ASIDE_RAD: f64 = 0.35;
    /// Nearer points have no direction [m].
    const NEAREST_M: f32 = 0.1;
    let is_valid = |point: &&glam::Vec3| point.is_finite() && point.length() > NEAREST_M;
    let azimuths: Vec<f64> = (scan.points.iter().filter(is_valid))
        .map(|point| f64::from(point.y.atan2(point.x)))
        .collect();
    let start_rad = *azimuths.first()?;
    let steps = azimuths
        .windows(2)
        .map(|pair| wrap_angle(pair[1] - pair[0]));
    let turned: Vec<f64> = steps
        .scan(0.0, |turned, step| {
            *turned += step;
            Some(*turned)
        })
        .collect();
    let last = *turned.last()?;
    let mut farthest = 0.0_f64;
    let is_steady = turned.iter().all(|turned| {
        let along = turned * last.signum();
        farthest = farthest.max(along);
        along >= farthest - ASIDE_RAD
    });
    let direction = if last > 0.0 {
        RotationDirection::CounterClockwise
    } else {
        RotationDirection::Clockwise
    };
    (is_steady && TURNS.contains(&(last.abs() / (2.0 * PI)))).then_some((direction, start_rad))
}

/// Runs of the odometry over the same scans.
struct Runs<'a> {
    scans: &'a [Scan],
    config: &'a OdometryConfig,
}

impl Runs<'_> {
    /// The start of the revolution with the least residual, with it [m]. Points between a wrong start and the right one
    /// are off by a whole period.
    fn best_start(&self, first: Rotation) -> Result<(Rotation, f64), TimingError> {
        /// Decrease of the residual by which another start than the first is better (unitless).
        const BETTER: f64 = 0.03;
        let mut best = (first, self.mean_residual(Some(first))?);
        let mut better = BETTER;
        for turns in [
            &[FRAC_PI_2, PI, -FRAC_PI_2][..],
            &[FRAC_PI_4, -FRAC_PI_4],
            &[0.5 * FRAC_PI_4, -0.5 * FRAC_PI_4],
        ] {
            let turned = |turn: &f64| Rotation {
                start_rad: wrap_angle(best.0.start_rad + turn),
                ..best.0
            };
            let others: Vec<Rotation> = turns.iter().map(turned).collect();
            let residual = |&other: &Rotation| Ok((other, self.mean_residual(Some(other))?));
            let found: Result<Vec<_>, TimingError> = others.par_iter().map(residual).collect();
            for (other, residual_m) in found? {
                if residual_m < (1.0 - better) * best.1 {
                    best = (other, residual_m);
                }
            }
            // The first start fits: there is nothing to refine.
            if best.0 == first {
                break;
            }
            better = 0.0;
        }
        Ok(best)
    }

    /// Mean residual of the registered scans; infinite if there are none [m].
    fn mean_residual(&self, candidate: Option<Rotation>) -> Result<f64, TimingError> {
        let mut odometer = Odometer::new(self.config.clone())?;
        let (mut sum_m, mut count) = (0.0, 0);
        for scan in self.scans {
            let mut scan = scan.clone();
            scan.times_s =
                candidate.map_or_else(Vec::new, |rotation| rotation.point_times(&scan.points));
            if let Some(residual_m) = odometer.step(&scan)?.residual_m {
                sum_m += residual_m;
                count += 1;
            }
        }
        let mean_m = match count {
            0 => f64::INFINITY,
            _ => sum_m / f64::from(count),
        };
        tracing::debug!("{candidate:?}: mean residual {:.2} mm", 1e3 * mean_m);
        Ok(mean_m)
    }
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
