//! Measurements by time.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};

/// Standard gravity [m/s²].
pub const GRAVITY_M_S2: f64 = 9.806_65;

/// A measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuSample {
    /// When it was measured [s].
    pub time_s: f64,
    /// Angular rate about the axes of the sensor [rad/s].
    pub rate_rad_s: Vector3<f64>,
    /// Specific force along the axes of the sensor, upward at rest [m/s²].
    pub force_m_s2: Vector3<f64>,
}

/// Measurements that cannot be those of an inertial sensor.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum ImuError {
    #[error("has {found} inertial measurements, at least {least} are needed")]
    TooFew { found: usize, least: usize },
    #[error(
        "the inertial measurement {row} at {time_s} s is not later than the one before it at {previous_s} s; sort them by time"
    )]
    NotAscending {
        row: usize,
        time_s: f64,
        previous_s: f64,
    },
    #[error(
        "the {quantity} of the inertial measurement {row} is {value}, which no vehicle reaches: {limit} is the limit; correct its unit"
    )]
    OutOfRange {
        row: usize,
        quantity: &'static str,
        value: f64,
        limit: &'static str,
    },
    #[error(
        "the inertial measurements are {period_s:.2} s apart, at most {most_s} s are useful; record more of them"
    )]
    TooSlow { period_s: f64, most_s: f64 },
}

/// Measurements in the order of their times, which ascend.
#[derive(Clone, Debug, PartialEq)]
pub struct ImuSamples(Vec<ImuSample>);

impl ImuSamples {
    /// Least number of measurements.
    const LEAST: usize = 20;
    /// Longest mean time between measurements: that of KITTI's oxts with a scan each [s].
    const MAX_PERIOD_S: f64 = 0.15;
    /// Longest time across which measurements are interpolated [s].
    const MAX_GAP_S: f64 = 0.3;
    /// Largest rate [rad/s] and force [m/s²], beyond the ranges of sensors of vehicles and hands.
    const MAX_RATE_RAD_S: f64 = 100.0;
    const MAX_FORCE_M_S2: f64 = 1000.0;

    /// Checks measurements. One that has the time of the one before it is dropped, as recorders repeat the last one.
    ///
    /// # Errors
    /// There are too few, their times do not ascend, or they are larger than a vehicle can reach.
    pub fn new(mut samples: Vec<ImuSample>) -> Result<Self, ImuError> {
        samples.dedup_by_key(|sample| sample.time_s);
        for (row, pair) in samples.windows(2).enumerate() {
            let [previous_s, time_s] = [pair[0].time_s, pair[1].time_s];
            if time_s.is_nan() || time_s <= previous_s {
                return Err(ImuError::NotAscending {
                    row: row + 2,
                    time_s,
                    previous_s,
                });
            }
        }
        for (row, sample) in samples.iter().enumerate() {
            let quantities = [
                ("time", sample.time_s.abs(), 1e11, "1e11 s"),
                (
                    "angular rate",
                    sample.rate_rad_s.norm(),
                    Self::MAX_RATE_RAD_S,
                    "100 rad/s",
                ),
                (
                    "specific force",
                    sample.force_m_s2.norm(),
                    Self::MAX_FORCE_M_S2,
                    "1000 m/s²",
                ),
            ];
            let beyond =
                (quantities.into_iter()).find(|(_, value, most, _)| value.is_nan() || value > most);
            if let Some((quantity, value, _, limit)) = beyond {
                return Err(ImuError::OutOfRange {
                    row: row + 1,
                    quantity,
                    value,
                    limit,
                });
            }
        }
        let found = samples.len();
        if found < Self::LEAST {
            let least = Self::LEAST;
            return Err(ImuError::TooFew { found, least });
        }
        let samples = Self(samples);
        let [first_s, last_s] = samples.span_s();
        let period_s = (last_s - first_s) / (found - 1) as f64;
        if period_s > Self::MAX_PERIOD_S {
            let most_s = Self::MAX_PERIOD_S;
            return Err(ImuError::TooSlow { period_s, most_s });
        }
        Ok(samples)
    }

    /// The measurements.
    pub fn rows(&self) -> &[ImuSample] {
        &self.0
    }

    /// Times of the first and the last measurement [s].
    pub fn span_s(&self) -> [f64; 2] {
        [self.0[0].time_s, self.0[self.0.len() - 1].time_s]
    }

    /// Pairs of neighbouring measurements across which is interpolated.
    pub(crate) fn steps(&self) -> impl Iterator<Item = [&ImuSample; 2]> {
        (self.0.windows(2))
            .map(|pair| [&pair[0], &pair[1]])
            .filter(|[a, b]| b.time_s - a.time_s <= Self::MAX_GAP_S)
    }

    /// Rotation `first_from_last` between two times, from the rates without a bias [rad/s]; `None` where measurements are
    /// missing.
    pub fn turn(
        &self,
        from_s: f64,
        to_s: f64,
        bias_rad_s: &Vector3<f64>,
    ) -> Option<UnitQuaternion<f64>> {
        let [first_s, last_s] = self.span_s();
        if !(first_s <= from_s && from_s <= to_s && to_s <= last_s) {
            return None;
        }
        let mut turn = UnitQuaternion::identity();
        let mut row = self.row_before(from_s);
        let mut time_s = from_s;
        while time_s < to_s {
            let end_s = self.0[row + 1].time_s.min(to_s);
            let rate = self.rate_at(row, 0.5 * (time_s + end_s))? - bias_rad_s;
            turn *= UnitQuaternion::from_scaled_axis(rate * (end_s - time_s));
            time_s = end_s;
            row = (row + 1).min(self.0.len() - 2);
        }
        Some(turn)
    }

    /// Row of the last measurement that is not after a time and is followed by another one.
    fn row_before(&self, time_s: f64) -> usize {
        let after = self.0.partition_point(|sample| sample.time_s <= time_s);
        after.saturating_sub(1).min(self.0.len() - 2)
    }

    /// Rate between a row and the next one; `None` in a gap.
    fn rate_at(&self, row: usize, time_s: f64) -> Option<Vector3<f64>> {
        let [a, b] = [&self.0[row], &self.0[row + 1]];
        let period_s = b.time_s - a.time_s;
        let share = (time_s - a.time_s) / period_s;
        (period_s <= Self::MAX_GAP_S).then(|| a.rate_rad_s.lerp(&b.rate_rad_s, share))
    }

    /// Whether an axis stays at one extreme value, once for long or again and again, as that of a sensor beyond its range does.
    pub(crate) fn is_saturated(&self) -> bool {
        /// Measurements in succession that count, and how many count in all.
        const LENGTH: usize = 4;
        const ALL: usize = 12;
        let is_clipped = |value: &dyn Fn(&ImuSample) -> f64| {
            let extreme = self.0.iter().map(value).fold(0.0, |most: f64, value| {
                if value.abs() > most.abs() {
                    value
                } else {
                    most
                }
            });
            // The first run may be that of an axis that never changes.
            let runs = self.0.chunk_by(|a, b| value(a) == value(b)).skip(1);
            let is_long = |run: &&[ImuSample]| run.len() >= LENGTH && value(&run[0]) == extreme;
            extreme != 0.0 && runs.filter(is_long).map(<[_]>::len).sum::<usize>() >= ALL
        };
        (0..3).any(|axis| {
            is_clipped(&|sample| sample.rate_rad_s[axis])
                || is_clipped(&|sample| sample.force_m_s2[axis])
        })
    }
}

/// An inertial sensor of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Imu {
    /// Its measurements.
    pub samples: Arc<ImuSamples>,
    /// Rotation of its axes in the lidar frame; `None`: estimated.
    pub lidar_from_imu: Option<UnitQuaternion<f64>>,
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    fn samples(count: usize, at: impl Fn(f64) -> ImuSample) -> Vec<ImuSample> {
        (0..count).map(|row| at(0.01 * row as f64)).collect()
    }

    fn turning(time_s: f64) -> ImuSample {
        ImuSample {
            time_s,
            rate_rad_s: Vector3::new(0.1, -0.2, time_s),
            force_m_s2: Vector3::z() * GRAVITY_M_S2,
        }
    }

    #[test]
    fn rates_about_one_axis_add_up_to_its_angle() {
        let about_z = |time_s| ImuSample {
            rate_rad_s: Vector3::z() * time_s,
            ..turning(time_s)
        };
        let imu = ImuSamples::new(samples(201, about_z)).unwrap();
        // ∫ t dt, also between measurements.
        for (from_s, to_s) in [(0.0, 2.0), (0.503, 0.506), (0.123, 1.987)] {
            let turn = imu.turn(from_s, to_s, &Vector3::zeros()).unwrap();
            let angle = 0.5 * (to_s.powi(2) - from_s.powi(2));
            assert_relative_eq!(turn.scaled_axis().z, angle, epsilon = 1e-9);
        }
        let bias = Vector3::new(0.0, 0.0, 1.0);
        let turn = imu.turn(0.0, 2.0, &bias).unwrap();
        assert_relative_eq!(turn.angle(), 0.0, epsilon = 1e-9);
    }

    #[test]
    fn turns_in_succession_compose() {
        let imu = ImuSamples::new(samples(201, turning)).unwrap();
        let turn = |from_s, to_s| imu.turn(from_s, to_s, &Vector3::zeros()).unwrap();
        let whole = turn(0.2, 1.8);
        let parts = turn(0.2, 0.9) * turn(0.9, 1.8);
        assert_relative_eq!(whole.angle_to(&parts), 0.0, epsilon = 1e-9);
        assert_eq!(imu.turn(-0.1, 1.0, &Vector3::zeros()), None);
        assert_eq!(imu.turn(1.0, 2.1, &Vector3::zeros()), None);
    }

    #[test]
    fn nothing_is_interpolated_across_a_gap() {
        let mut rows = samples(201, turning);
        rows.drain(100..140);
        let imu = ImuSamples::new(rows).unwrap();
        assert_eq!(imu.turn(0.9, 1.5, &Vector3::zeros()), None);
        assert!(imu.turn(0.0, 0.9, &Vector3::zeros()).is_some());
        assert_eq!(imu.steps().count(), 159);
    }

    #[test]
    fn what_is_not_measured_by_an_imu_is_refused_with_its_row() {
        let refused = |change: &dyn Fn(&mut Vec<ImuSample>)| {
            let mut rows = samples(100, turning);
            change(&mut rows);
            ImuSamples::new(rows).unwrap_err()
        };
        let error = refused(&|rows| rows[7].time_s = 0.0);
        assert!(matches!(error, ImuError::NotAscending { row: 8, .. }));
        let error = refused(&|rows| rows[3].rate_rad_s.y = f64::NAN);
        assert!(matches!(error, ImuError::OutOfRange { row: 4, .. }));
        let error = refused(&|rows| rows[3].force_m_s2.x = -1001.0);
        assert!(matches!(error, ImuError::OutOfRange { row: 4, .. }));
        let error = refused(&|rows| rows.truncate(19));
        assert!(matches!(error, ImuError::TooFew { found: 19, .. }));
        let error = refused(&|rows| rows.iter_mut().for_each(|row| row.time_s *= 20.0));
        assert!(matches!(error, ImuError::TooSlow { .. }));
        // Two of the same time are one.
        let mut rows = samples(100, turning);
        rows[50].time_s = rows[49].time_s;
        assert_eq!(ImuSamples::new(rows).unwrap().rows().len(), 99);
    }

    #[test]
    fn an_axis_that_rests_at_its_limit_is_saturated() {
        let swinging = |limit: f64| {
            move |time_s: f64| ImuSample {
                rate_rad_s: Vector3::new(0.0, 0.0, (5.0 * time_s).sin().clamp(-limit, limit)),
                ..turning(time_s)
            }
        };
        let is_saturated =
            |limit| (ImuSamples::new(samples(1000, swinging(limit))).unwrap()).is_saturated();
        assert!(is_saturated(0.7));
        assert!(!is_saturated(2.0));
        // One bend that is too sharp for it.
        let bend = |time_s: f64| ImuSample {
            rate_rad_s: Vector3::new(0.0, 0.0, (1.0 - (time_s - 5.0).powi(2)).clamp(0.1, 0.7)),
            ..turning(time_s)
        };
        let bend = ImuSamples::new(samples(1000, bend)).unwrap();
        assert!(bend.is_saturated());
    }
}
