//! Choice of the times of the points by the residuals of the odometry.
//!
//! Points that were measured while the sensor moved agree with the scans before only if they are compensated with
//! their true times. The odometry runs once without times and once with each candidate; its residual has the least value
//! for the right one. Near the right times it grows with the square of the error: the residual of compensated scans,
//! candidates none (0), clockwise (1) and counter-clockwise (−1), is that of 0 by the same amount below both
//! others, that of clockwise scans by one quarter of the whole range below the next. The scan of a sensor at rest has
//! the same residual with all candidates. Where the first start of a direction fits clearly better than no times, no other
//! start is tried. Scans in the order in which their points were measured, which start at different azimuths, have that order as the
//! only other candidate.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};

use rayon::prelude::*;

use super::config::OdometryConfig;
use super::odometer::{Odometer, OdometryError};
use crate::geometry::Pose3;
use crate::lidar::{FiringOrder, PointTiming, Rotation, RotationDirection, Scan};
use crate::statistics::median;
use crate::validation::{InvalidValue, Validate as _};

/// Residuals of the odometry with each candidate for the times of the points.
#[derive(Clone, Debug, PartialEq)]
pub struct TimingComparison {
    /// The candidates, `None` for points without times, then the order of the points, or clockwise and
    /// counter-clockwise with the start of the revolution that fits each best, with the mean residual of the odometry [m]. Where a
    /// timing was expected and fits, it is the first, and those with which it was compared follow.
    pub residuals_m: Vec<(Option<PointTiming>, f64)>,
    /// Index of the candidate that fits; `None` if the residuals do not decide, as without motion.
    pub best: Option<usize>,
}

/// Smallest difference between the largest and the least residual that decides, as a share of the least. Errors of wrong times
/// add to those of the scans in squares: this share is theirs if they are a third of these, √(1.05² − 1). `docs/method.md`,
/// Thresholds, has the shares of real and simulated sensors.
const SPREAD: f64 = 0.05;

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

/// Compares the times of the points of a sensor that turns once, or from the start of a scan to that of the next, in a
/// period [s] with none, on consecutive scans, ten or more with motion. Times that the scans have are ignored.
pub fn compare_timings(
    scans: &[Scan],
    period_s: f64,
    config: &OdometryConfig,
) -> Result<TimingComparison, TimingError> {
    let runs = Runs::new(scans, config)?;
    let none = (None, runs.none_m);
    if let Some(period_s) = period_of_order(scans, period_s) {
        let order = PointTiming::Order { period_s };
        return Ok(TimingComparison::decided(vec![none, runs.with(order)?]));
    }
    let order = scans.first().and_then(FiringOrder::of);
    let first = |direction| Rotation {
        direction,
        period_s,
        start_rad: (order.as_ref().filter(|it| it.direction == direction))
            .map_or(PI, |it| it.start_rad),
    };
    let directions = [
        RotationDirection::Clockwise,
        RotationDirection::CounterClockwise,
    ];
    let starts = directions.map(first);
    let residuals_m = runs.residuals_of(&starts)?;
    let firsts: Vec<Fitted> = starts.into_iter().zip(residuals_m).collect();
    if (firsts.iter()).any(|&(_, residual_m)| runs.is_clearly_better_than_none(residual_m)) {
        let rotations = (firsts.iter()).map(|&(it, m)| (Some(PointTiming::Rotation(it)), m));
        let compared = TimingComparison::decided([none].into_iter().chain(rotations).collect());
        if compared.best.is_some() {
            return Ok(compared);
        }
    }
    let coarse: Result<Vec<(Rotation, Fitted)>, TimingError> = (firsts.par_iter())
        .map(|&first| Ok((first.0, runs.best_quarter(first)?)))
        .collect();
    let coarse = coarse?;
    let fitted = |&(first, found): &(Rotation, Fitted)| {
        // The first start fits: there is nothing to refine. Nor where the best of four is clearly worse than no times: a start that is
        // off by an eighth of a turn has wrong times for an eighth of the points.
        let is_done = found.0 == first || is_clearly_worse(found.1, runs.none_m);
        let (rotation, residual_m) = if is_done {
            found
        } else {
            runs.best_start(found)?
        };
        Ok((Some(PointTiming::Rotation(rotation)), residual_m))
    };
    let rotations: Result<Vec<_>, TimingError> = coarse.par_iter().map(fitted).collect();
    let residuals_m = [none].into_iter().chain(rotations?);
    Ok(TimingComparison::decided(residuals_m.collect()))
}

/// The comparison of a timing that is expected with no times and, where these are not clearly worse, of a rotation with the opposite
/// direction and the other starts by quarters of a turn; `None` if it does not fit clearly best, so that the full comparison is needed.
pub fn fits_best(
    timing: PointTiming,
    scans: &[Scan],
    config: &OdometryConfig,
) -> Result<Option<TimingComparison>, TimingError> {
    let runs = Runs::new(scans, config)?;
    let (expected, none) = (runs.with(timing)?, (None, runs.none_m));
    let mut residuals_m = vec![expected];
    if let PointTiming::Rotation(rotation) = timing
        && !runs.is_clearly_better_than_none(expected.1)
    {
        let [_, turned @ ..] = quarters(rotation);
        let others = turned.into_iter().chain([rotation.reversed()]);
        let others: Vec<Rotation> = others.collect();
        let timings = others.iter().map(|&it| Some(PointTiming::Rotation(it)));
        residuals_m.extend(timings.zip(runs.residuals_of(&others)?));
    }
    residuals_m.push(none);
    let compared = TimingComparison::decided(residuals_m);
    Ok(Some(compared).filter(|compared| compared.best == Some(0)))
}

/// A rotation, and the others that start quarters of a turn from it.
fn quarters(first: Rotation) -> [Rotation; 4] {
    [0.0, FRAC_PI_2, PI, -FRAC_PI_2].map(|turn| first.turned(turn))
}

impl TimingComparison {
    fn decided(residuals_m: Vec<(Option<PointTiming>, f64)>) -> Self {
        let values: Vec<f64> = residuals_m.iter().map(|(_, m)| *m).collect();
        Self {
            best: decide(&values),
            residuals_m,
        }
    }
}

/// Duration of a turn of a sensor with an interval between its scans [s], if their points are in the order in which they
/// were measured and show it by the azimuths at which they start; `None` of others. Scans may be missing between them.
fn period_of_order(scans: &[Scan], interval_s: f64) -> Option<f64> {
    /// Median deviation of the angles between the starts of scans that show the speed of rotation: 0.1 degrees for an
    /// HDL-32 and a VLP-16, 90 degrees for starts at random, whose scans are taken as a turn each [rad].
    const EVEN_RAD: f64 = TAU / 36.0;
    let scans: Vec<&Scan> = scans.iter().filter(|scan| !scan.is_empty()).collect();
    let orders: Option<Vec<FiringOrder>> = scans.iter().map(|scan| FiringOrder::of(scan)).collect();
    let orders = orders?;
    let first = orders.first()?;
    let is_one_sense = orders.iter().all(|it| it.direction == first.direction);
    if !is_one_sense || !FiringOrder::pass_all_azimuths(&orders) {
        return None;
    }
    let steps = |pair: &[&Scan]| match (pair[0].time_s, pair[1].time_s) {
        (Some(before_s), Some(time_s)) => ((time_s - before_s) / interval_s).round().max(1.0),
        _ => 1.0,
    };
    // A sector without returns matters less over fewer scans.
    let least = scans.windows(2).map(steps).reduce(f64::min)?;
    let sweeps_rad: Vec<f64> = (orders.windows(2).zip(scans.windows(2)))
        .filter(|(_, scans)| steps(scans) == least)
        .map(|(orders, _)| orders[0].angle_to(&orders[1], least) / least)
        .collect();
    let usual_rad = median(sweeps_rad.iter().copied())?;
    let is_even = median(sweeps_rad.iter().map(|rad| (rad - usual_rad).abs()))? < EVEN_RAD;
    Some(interval_s * TAU / if is_even { usual_rad } else { TAU })
}

/// Whether a residual is larger than another one by as much as decides.
fn is_clearly_worse(residual_m: f64, other_m: f64) -> bool {
    residual_m > (1.0 + SPREAD) * other_m
}

/// Runs of the odometry over the same scans; the first one is without times.
struct Runs<'a> {
    scans: &'a [Scan],
    config: OdometryConfig,
    /// Large scans are thinned, by odd steps, which pass through all beams; without times.
    thinned: Vec<(usize, Scan)>,
    /// Mean residual without times; infinite if no scan was registered [m].
    none_m: f64,
    /// Motion to each scan without times, where it was found.
    motions: Vec<Option<Pose3>>,
}

/// A rotation and its mean residual [m].
type Fitted = (Rotation, f64);

impl<'a> Runs<'a> {
    fn new(scans: &'a [Scan], config: &OdometryConfig) -> Result<Self, TimingError> {
        /// Least number of points of a thinned scan.
        const POINTS: usize = 30_000;
        config.validate()?;
        // With wrong times no pose fits as it should; the residuals are compared.
        let config = OdometryConfig {
            min_common_share: 0.0,
            ..config.clone()
        };
        let thinned = |scan: &Scan| {
            let step = (scan.len() / POINTS).saturating_sub(1) / 2 * 2 + 1;
            let mut thinned = scan.every(step);
            thinned.times_s.clear();
            (step, thinned)
        };
        let mut runs = Self {
            scans,
            config,
            thinned: scans.iter().map(thinned).collect(),
            none_m: f64::INFINITY,
            motions: vec![None; scans.len()],
        };
        (runs.none_m, runs.motions) = runs.run(None)?;
        Ok(runs)
    }

    /// A candidate with its mean residual [m].
    fn with(&self, timing: PointTiming) -> Result<(Option<PointTiming>, f64), TimingError> {
        Ok((Some(timing), self.run(Some(timing))?.0))
    }

    /// Whether a rotation fits clearly better than no times: then it is the right one, within a twelfth of a turn. Errors of no times are
    /// uniform within half a sweep, with a mean square of 1/12 of the squared motion; those of the opposite direction are twice as large, and
    /// with a start that is off by a share s of a turn they are a whole motion for s of the points.
    fn is_clearly_better_than_none(&self, residual_m: f64) -> bool {
        is_clearly_worse(self.none_m, residual_m)
    }

    /// The start of the revolution with the least residual among a first one, whose residual is known, and those by quarters of a turn from
    /// it. Points between a wrong start and the right one are off by a whole period.
    fn best_quarter(&self, (first, first_m): Fitted) -> Result<Fitted, TimingError> {
        /// Decrease of the residual by which another start than the first is better (unitless): it takes away errors that are
        /// a quarter of all, √(1 − 0.97²), since they add in squares.
        const BETTER: f64 = 0.03;
        let [_, turned @ ..] = quarters(first);
        let residuals_m = self.residuals_of(&turned)?;
        let others = turned.into_iter().zip(residuals_m);
        Ok(others.fold((first, first_m), |best, other| {
            let is_better = other.1 < (1.0 - BETTER) * best.1;
            if is_better { other } else { best }
        }))
    }

    /// The start with the least residual near one of [`Runs::best_quarter`].
    fn best_start(&self, mut best: Fitted) -> Result<Fitted, TimingError> {
        for turn in [FRAC_PI_4, 0.5 * FRAC_PI_4] {
            let others = [turn, -turn].map(|turn| best.0.turned(turn));
            for other in others.into_iter().zip(self.residuals_of(&others)?) {
                if other.1 < best.1 {
                    best = other;
                }
            }
        }
        Ok(best)
    }

    fn residuals_of(&self, rotations: &[Rotation]) -> Result<Vec<f64>, TimingError> {
        let residual = |&it: &Rotation| Ok(self.with(PointTiming::Rotation(it))?.1);
        rotations.par_iter().map(residual).collect()
    }

    /// Mean residual of the registered scans, infinite if there are none [m], and the motions to these.
    fn run(
        &self,
        candidate: Option<PointTiming>,
    ) -> Result<(f64, Vec<Option<Pose3>>), TimingError> {
        // Scans that all start at one azimuth have the motions that were found without times; half of the iterations are
        // enough from them on. By the order of the points each scan has its own start, which moves it.
        let has_motions = matches!(candidate, Some(PointTiming::Rotation(_)));
        let mut config = self.config.clone();
        if has_motions {
            config.iterations = config.iterations.div_ceil(2);
        }
        let mut odometer = Odometer::new(config)?;
        let (mut sum_m, mut count) = (0.0, 0);
        let mut motions = Vec::with_capacity(self.scans.len());
        for ((scan, (step, thinned)), motion) in
            self.scans.iter().zip(&self.thinned).zip(&self.motions)
        {
            let mut thinned = thinned.clone();
            thinned.times_s = match candidate {
                None => vec![],
                // It needs the azimuths of the points only, not their order.
                Some(PointTiming::Rotation(rotation)) => rotation.point_times(&thinned.points),
                Some(order) => (order.point_times(scan).into_iter())
                    .step_by(*step)
                    .collect(),
            };
            if let Some(motion) = motion.filter(|_| has_motions) {
                odometer.set_motion(&thinned, motion);
            }
            let found = odometer.step(&thinned)?;
            motions.push(
                found
                    .state
                    .is_measured()
                    .then_some(found.previous_from_current),
            );
            if let Some(residual_m) = found.residual_m {
                sum_m += residual_m;
                count += 1;
            }
        }
        let mean_m = match count {
            0 => f64::INFINITY,
            _ => sum_m / f64::from(count),
        };
        tracing::debug!("{candidate:?}: mean residual {:.2} mm", 1e3 * mean_m);
        Ok((mean_m, motions))
    }
}

/// The least residual, if it is clearly below the next.
fn decide(residuals_m: &[f64]) -> Option<usize> {
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
