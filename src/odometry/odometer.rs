//! The streaming odometry.

use std::time::{Duration, Instant};

use nalgebra::{Matrix6, Vector6};

use super::config::OdometryConfig;
use super::state::{OdometerState, Registered};
use crate::geometry::Pose3;
use crate::lidar::{Motion, PERIOD_S, Scan, interval_s};
use crate::memory::MemoryError;
use crate::validation::{InvalidValue, Validate as _};

/// A scan that cannot be the next one.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum OdometryError {
    /// Times of scans do not ascend.
    #[error(
        "the scan of time {time_s} s follows one of time {previous_s} s: sort the scans by time"
    )]
    TimeNotAscending {
        /// Time of the previous scan [s].
        previous_s: f64,
        /// Time of the scan [s].
        time_s: f64,
    },
    /// The scans do not fit the budget of memory.
    #[error(transparent)]
    Memory(#[from] MemoryError),
}

/// How the pose of a scan was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepState {
    /// There is no scan before it: the origin.
    First,
    /// Given, not measured.
    Given,
    /// Registered to the local map.
    Registered,
    /// Registered to the local map, after a motion that was a surprise or that only a wide search found.
    Doubtful,
    /// Predicted by constant velocity, with the rotation of a gyroscope where there is one; the scan is not mapped. It has
    /// too few points, it does not fit the local map, or the motion to where it fits is impossible.
    Predicted,
    /// The same; after several in turn the local map begins again with this scan, and the motion to it is unknown.
    Lost,
}

impl StepState {
    /// Whether the scan shows the motion to it.
    pub fn is_measured(self) -> bool {
        matches!(self, Self::Registered | Self::Doubtful)
    }

    /// Whether the motion is assumed.
    pub fn is_predicted(self) -> bool {
        matches!(self, Self::Predicted | Self::Lost)
    }
}

/// The pose of a scan and the motion to it.
#[derive(Clone, Debug, PartialEq)]
pub struct OdometryEstimate {
    /// `p_odom = odom_from_lidar * p_lidar`; odom is the lidar frame of the first scan.
    pub odom_from_lidar: Pose3,
    /// Motion since the previous scan.
    pub previous_from_current: Pose3,
    /// Time since the previous scan [s].
    pub duration_s: f64,
    /// Covariance of `previous_from_current`: (x, y, z, roll, pitch, yaw) in the lidar frame of this scan [m, rad].
    pub covariance: Matrix6<f64>,
    /// How the pose was found.
    pub state: StepState,
    /// Motions (x, y, z, roll, pitch, yaw) in the lidar frame that the scan does not determine [m, rad]; along them the
    /// pose is the predicted one. They move points by about a metre each.
    pub degenerate_directions: Vec<Vector6<f64>>,
    /// Robust root mean square of the distances between points and mapped planes [m]; `None` if not registered.
    pub residual_m: Option<f64>,
    /// Share of the points that match the local map.
    pub matched_share: f64,
    /// Time of computation.
    pub elapsed: Duration,
}

/// LiDAR odometry, scan by scan.
#[derive(Clone, Debug)]
pub struct Odometer {
    config: OdometryConfig,
    state: Option<OdometerState>,
    /// Time of the last scan [s].
    time_s: Option<f64>,
}

impl Odometer {
    /// An odometry before its first scan.
    ///
    /// # Errors
    /// A field of the configuration is out of its range.
    pub fn new(config: OdometryConfig) -> Result<Self, InvalidValue> {
        config.validate()?;
        Ok(Self {
            config,
            state: None,
            time_s: None,
        })
    }

    /// Registers the next scan. Points with times are compensated by the estimated motion; points without are taken as
    /// compensated.
    ///
    /// # Errors
    /// Times of scans do not ascend, or memory does not suffice.
    pub fn step(&mut self, scan: &Scan) -> Result<OdometryEstimate, OdometryError> {
        let start = Instant::now();
        let duration_s = self.duration_until(scan)?;
        self.time_s = scan.time_s;
        let mut estimate = match &mut self.state {
            Some(state) => advance(state, scan, duration_s, &self.config),
            None => {
                self.state = OdometerState::begin(scan, &self.config);
                OdometryEstimate::first(duration_s)
            }
        };
        estimate.elapsed = start.elapsed();
        Ok(estimate)
    }

    /// Sets the motion to the next scan by which it is predicted, instead of constant velocity. What is wrong with its time
    /// is reported by [`step`](Self::step).
    pub(super) fn set_motion(&mut self, scan: &Scan, previous_from_current: Pose3) {
        let duration_s = self.duration_until(scan);
        if let (Some(state), Ok(duration_s)) = (&mut self.state, duration_s) {
            let motion = Motion {
                previous_from_current,
                duration_s,
            };
            state.set_motion(motion, &self.config);
        }
    }

    /// Time since the previous scan [s].
    fn duration_until(&self, scan: &Scan) -> Result<f64, OdometryError> {
        let (Some(previous_s), Some(time_s)) = (self.time_s, scan.time_s) else {
            return Ok(PERIOD_S);
        };
        let duration_s = interval_s(previous_s, time_s);
        if duration_s > 0.0 && duration_s.is_finite() {
            Ok(duration_s)
        } else {
            Err(OdometryError::TimeNotAscending { previous_s, time_s })
        }
    }
}

/// Registers a scan, or predicts its pose.
fn advance(
    state: &mut OdometerState,
    scan: &Scan,
    duration_s: f64,
    config: &OdometryConfig,
) -> OdometryEstimate {
    let previous = state.odom_from_lidar;
    let found = state.register(scan, duration_s, config);
    if found.is_none() {
        state.coast(scan, duration_s, config);
    }
    let estimate = OdometryEstimate {
        odom_from_lidar: state.odom_from_lidar,
        previous_from_current: previous.inverse() * state.odom_from_lidar,
        covariance: Matrix6::from_diagonal(&state.prior(0.0, false, config)),
        state: if state.is_lost() {
            StepState::Lost
        } else {
            StepState::Predicted
        },
        ..OdometryEstimate::first(duration_s)
    };
    match found {
        None => estimate,
        Some(Registered { found, is_doubtful }) => OdometryEstimate {
            covariance: found.covariance,
            state: if is_doubtful {
                StepState::Doubtful
            } else {
                StepState::Registered
            },
            degenerate_directions: found.degenerate_directions,
            residual_m: Some(found.residual_m),
            matched_share: found.matched_share,
            ..estimate
        },
    }
}

impl OdometryEstimate {
    /// Whether the scan determines the motion to it in all directions, and is not [doubtful](StepState::Doubtful).
    pub fn is_determined(&self) -> bool {
        self.state == StepState::Registered && self.degenerate_directions.is_empty()
    }

    /// An estimate without motion.
    pub(super) fn first(duration_s: f64) -> Self {
        Self {
            odom_from_lidar: Pose3::identity(),
            previous_from_current: Pose3::identity(),
            duration_s,
            covariance: Matrix6::zeros(),
            state: StepState::First,
            degenerate_directions: Vec::new(),
            residual_m: None,
            matched_share: 0.0,
            elapsed: Duration::ZERO,
        }
    }
}
