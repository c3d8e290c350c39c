//! The streaming odometry.

use std::time::{Duration, Instant};

use glam::DVec3;
use nalgebra::{Matrix6, Point3, Vector6};

use super::alignment::{Alignment, Problem};
use super::config::OdometryConfig;
use super::sampling::{TimedPoint, first_per_voxel, sample, sensor_range};
use super::search::search;
use super::voxel_map::VoxelMap;
use crate::geometry::Pose3;
use crate::lidar::{Motion, Scan};
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
}

/// How the pose of a scan was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepState {
    /// The first scan: the origin.
    First,
    /// Registered to the local map.
    Registered,
    /// Predicted by constant velocity; the scan is not mapped. It has too few points, it does not match the local
    /// map, or the motion to its match is impossible.
    Predicted,
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
    /// Unit vectors (x, y, z, roll, pitch, yaw) in the lidar frame that the scan does not determine, rotations times
    /// the lever `lever_m`; along them the pose is the predicted one.
    pub degenerate_directions: Vec<Vector6<f64>>,
    /// Robust root mean square of the distances between points and mapped planes [m]; `None` if not registered.
    pub residual_m: Option<f64>,
    /// Share of the points that match the local map.
    pub matched_share: f64,
    pub cost: f64,
    /// Time of computation.
    pub elapsed: Duration,
}

/// LiDAR odometry, scan by scan.
#[derive(Clone, Debug)]
pub struct Odometer {
    config: OdometryConfig,
    last: Option<Last>,
}

/// State after a scan.
#[derive(Clone, Debug)]
struct Last {
    map: VoxelMap,
    /// Range of the sensor [m].
    range_m: f64,
    odom_from_lidar: Pose3,
    /// Motion that led there; `None` after the first scan.
    motion: Option<Motion>,
    time_s: Option<f64>,
    /// Points of the first scan, which is compensated once its motion is known.
    first_points: Option<Vec<TimedPoint>>,
    /// Mean squared deviation from the predictions (m², rad²).
    deviation: [f64; 2],
    /// Mean cost of the registered scans.
    cost: f64,
}

impl Odometer {
    /// An odometry before its first scan.
    pub fn new(config: OdometryConfig) -> Result<Self, InvalidValue> {
        config.validate()?;
        Ok(Self { config, last: None })
    }

    /// Registers the next scan. Points with times are compensated by the estimated motion; points without are taken as
    /// compensated.
    pub fn step(&mut self, scan: &Scan) -> Result<OdometryEstimate, OdometryError> {
        let start = Instant::now();
        let duration_s = self.duration_since_last(scan)?;
        let mut estimate = match self.last.take() {
            None => self.begin(scan),
            Some(mut last) => {
                let estimate = self.advance(&mut last, scan, duration_s);
                last.time_s = scan.time_s;
                self.last = Some(last);
                estimate
            }
        };
        estimate.elapsed = start.elapsed();
        Ok(estimate)
    }

    /// Time since the previous scan [s].
    fn duration_since_last(&self, scan: &Scan) -> Result<f64, OdometryError> {
        let previous_s = self.last.as_ref().and_then(|last| last.time_s);
        let (Some(previous_s), Some(time_s)) = (previous_s, scan.time_s) else {
            return Ok(self.config.period_s);
        };
        match time_s > previous_s && (time_s - previous_s).is_finite() {
            true => Ok(time_s - previous_s),
            false => Err(OdometryError::TimeNotAscending { previous_s, time_s }),
        }
    }

    /// The first scan with enough points is the local map.
    fn begin(&mut self, scan: &Scan) -> OdometryEstimate {
        let odom_from_lidar = Pose3::identity();
        if let Some(range_m) = sensor_range(scan) {
            let points = self.sample(scan, range_m);
            let mut last = Last {
                map: self.empty_map(range_m),
                range_m,
                odom_from_lidar,
                motion: None,
                time_s: scan.time_s,
                first_points: None,
                deviation: [0.0; 2],
                cost: 1.0,
            };
            last.map.insert(&mapped(&points, &odom_from_lidar, None));
            last.first_points = Some(points);
            self.last = Some(last);
        }
        OdometryEstimate {
            odom_from_lidar,
            previous_from_current: odom_from_lidar,
            duration_s: self.config.period_s,
            covariance: Matrix6::zeros(),
            state: StepState::First,
            degenerate_directions: Vec::new(),
            residual_m: None,
            matched_share: 0.0,
            cost: 1.0,
            elapsed: Duration::ZERO,
        }
    }

    /// Registers a scan to the local map, and adds it.
    fn advance(&self, last: &mut Last, scan: &Scan, duration_s: f64) -> OdometryEstimate {
        let previous = last.odom_from_lidar;
        let predicted_motion = last
            .motion
            .map_or(Pose3::identity(), |m| m.after(duration_s));
        let predicted = previous * predicted_motion;
        let points = self.sample(scan, last.range_m);
        let spacing_m = self.voxel_m(last.range_m) * self.config.registration_spacing;
        let sparse = first_per_voxel(points.iter().copied(), spacing_m as f32);
        let prior = self.prior(last, duration_s);
        let problem = Problem {
            map: &last.map,
            points: &sparse,
            odom_from_previous: previous,
            duration_s,
            predicted,
            prior_information: prior.map_diagonal_inverse(),
            min_kernel_m: 0.1 * self.voxel_m(last.range_m),
            iterations: self.config.iterations,
        };
        let lever_m = problem.lever();
        let found = match last.motion {
            Some(_) => self.track(last, &problem),
            None => self.first_motion(last, &problem),
        };
        let found = found.filter(|found| self.is_possible(last, found, &predicted, duration_s));
        let Some(found) = found else {
            last.odom_from_lidar = predicted;
            return OdometryEstimate {
                odom_from_lidar: predicted,
                previous_from_current: predicted_motion,
                duration_s,
                covariance: prior,
                state: StepState::Predicted,
                degenerate_directions: (0..6).map(|axis| unit(axis)).collect(),
                residual_m: None,
                matched_share: 0.0,
                cost: 1.0,
                elapsed: Duration::ZERO,
            };
        };
        let previous_from_current = previous.inverse() * found.odom_from_lidar;
        let motion = Motion {
            previous_from_current,
            duration_s,
        };
        if last.motion.is_some() {
            last.remember_deviation(&(predicted.inverse() * found.odom_from_lidar));
        }
        last.cost = match last.motion {
            Some(_) => 0.8 * last.cost + 0.2 * found.cost,
            None => found.cost,
        };
        if let Some(first) = last.first_points.take() {
            last.map = self.empty_map(last.range_m);
            last.map.insert(&mapped(&first, &previous, Some(&motion)));
        }
        last.map
            .insert(&mapped(&points, &found.odom_from_lidar, Some(&motion)));
        let center = found.odom_from_lidar.translation.vector;
        let center = DVec3::new(center.x, center.y, center.z);
        last.map
            .remove_beyond(center, self.config.map_radius_share * last.range_m);
        last.odom_from_lidar = found.odom_from_lidar;
        last.motion = Some(motion);
        OdometryEstimate {
            odom_from_lidar: found.odom_from_lidar,
            previous_from_current,
            duration_s,
            covariance: found.covariance,
            state: StepState::Registered,
            degenerate_directions: degenerate(&found, lever_m),
            residual_m: Some(found.residual_m),
            matched_share: found.matched_share,
            cost: found.cost,
            elapsed: Duration::ZERO,
        }
    }

    /// Registers a scan from the prediction; if the result is worse than usual, from several starts.
    fn track(&self, last: &Last, problem: &Problem) -> Option<Alignment> {
        /// Increase of the cost that starts a search.
        const WORSE: f64 = 0.1;
        let found = problem.align(&problem.predicted, self.kernel(last));
        if found
            .as_ref()
            .is_some_and(|found| found.cost < last.cost + WORSE)
        {
            return found;
        }
        let voxel_m = self.voxel_m(last.range_m);
        let searched = search(problem, 4.0 * voxel_m, 8.0 * voxel_m);
        (found.into_iter().chain(searched)).min_by(|a, b| a.cost.total_cmp(&b.cost))
    }

    /// The motion from the first scan to the second, without a prediction. The first scan is compensated by it, and the
    /// second is registered again.
    fn first_motion(&self, last: &Last, problem: &Problem) -> Option<Alignment> {
        const PASSES: usize = 3;
        let voxel_m = self.voxel_m(last.range_m);
        let mut found = search(problem, 4.0 * voxel_m, 0.2 * last.range_m)?;
        let first = last.first_points.as_ref()?;
        for _ in 0..PASSES {
            let motion = Motion {
                previous_from_current: problem.odom_from_previous.inverse() * found.odom_from_lidar,
                duration_s: problem.duration_s,
            };
            let mut map = self.empty_map(last.range_m);
            map.insert(&mapped(first, &problem.odom_from_previous, Some(&motion)));
            let problem = Problem {
                map: &map,
                ..*problem
            };
            found = problem.align(&found.odom_from_lidar, voxel_m)?;
        }
        Some(found)
    }

    fn voxel_m(&self, range_m: f64) -> f64 {
        self.config.voxel_share * range_m
    }

    fn empty_map(&self, range_m: f64) -> VoxelMap {
        VoxelMap::new(self.voxel_m(range_m), self.config.voxel_points)
    }

    fn sample(&self, scan: &Scan, range_m: f64) -> Vec<TimedPoint> {
        let min_range_m = self.config.min_range_share * range_m;
        let spacing_m = self.config.map_spacing * self.voxel_m(range_m);
        sample(
            scan,
            min_range_m as f32,
            (2.0 * range_m) as f32,
            spacing_m as f32,
        )
    }

    /// Covariance of the prediction.
    fn prior(&self, last: &Last, duration_s: f64) -> Matrix6<f64> {
        let periods = (duration_s / self.config.period_s).max(1.0);
        let [floor_m, floor_rad] = [0.3 * self.voxel_m(last.range_m) * periods, 0.02 * periods];
        let [shift, turn] = last.deviation;
        let (shift, turn) = match last.motion {
            Some(_) => (
                9.0 * shift + floor_m * floor_m,
                9.0 * turn + floor_rad * floor_rad,
            ),
            None => ((0.2 * last.range_m).powi(2), 0.3_f64.powi(2)),
        };
        Matrix6::from_diagonal(&Vector6::new(shift, shift, shift, turn, turn, turn))
    }

    /// Initial scale of the robust kernel [m].
    fn kernel(&self, last: &Last) -> f64 {
        let [shift, turn] = last.deviation;
        let deviation_m = shift.sqrt() + last.range_m * 0.5 * turn.sqrt();
        let voxel_m = self.voxel_m(last.range_m);
        (3.0 * deviation_m).clamp(voxel_m, 4.0 * voxel_m)
    }

    /// Whether a motion deviates from the prediction by no more than a vehicle can accelerate.
    fn is_possible(
        &self,
        last: &Last,
        found: &Alignment,
        predicted: &Pose3,
        duration_s: f64,
    ) -> bool {
        let config = &self.config;
        const LOST: f64 = 0.85;
        if found.cost > LOST || found.matched_share < config.min_matched_share {
            return false;
        }
        let periods = (duration_s / 0.1).max(1.0);
        let deviation = predicted.inverse() * found.odom_from_lidar;
        let shift_m = deviation.translation.vector.norm();
        let turn_rad = deviation.rotation.angle();
        last.motion.is_none()
            || shift_m <= config.max_deviation_share * last.range_m * periods
                && turn_rad <= config.max_deviation_deg.to_radians() * periods
    }
}

impl Last {
    fn remember_deviation(&mut self, deviation: &Pose3) {
        const NEW: f64 = 0.1;
        let shift = deviation.translation.vector.norm_squared();
        let turn = deviation.rotation.angle().powi(2);
        for (mean, new) in self.deviation.iter_mut().zip([shift, turn]) {
            *mean += NEW * (new - *mean);
        }
    }
}

trait DiagonalInverse {
    fn map_diagonal_inverse(&self) -> Self;
}
impl DiagonalInverse for Matrix6<f64> {
    fn map_diagonal_inverse(&self) -> Self {
        Matrix6::from_diagonal(&self.diagonal().map(|value| 1.0 / value))
    }
}

fn unit(axis: usize) -> Vector6<f64> {
    let mut unit = Vector6::zeros();
    unit[axis] = 1.0;
    unit
}

/// Points in the odom frame, compensated by the motion.
fn mapped(points: &[TimedPoint], odom_from_lidar: &Pose3, motion: Option<&Motion>) -> Vec<DVec3> {
    let place = |point: &TimedPoint| {
        let p = Point3::new(
            f64::from(point.position.x),
            f64::from(point.position.y),
            f64::from(point.position.z),
        );
        let p = match motion {
            Some(motion) if point.time_s != 0.0 => motion.after(point.time_s.into()) * p,
            _ => p,
        };
        let p = odom_from_lidar * p;
        DVec3::new(p.x, p.y, p.z)
    };
    points.iter().map(place).collect()
}

/// Directions whose share of the information is negligible; rotations are scaled by the lever.
fn degenerate(found: &Alignment, lever_m: f64) -> Vec<Vector6<f64>> {
    const NEGLIGIBLE: f64 = 0.01;
    let mut scale = Matrix6::identity();
    for axis in 3..6 {
        scale[(axis, axis)] = 1.0 / lever_m;
    }
    let eigen = (scale * found.information * scale).symmetric_eigen();
    (eigen
        .eigenvalues
        .iter()
        .zip(eigen.eigenvectors.column_iter()))
    .filter(|(value, _)| **value < NEGLIGIBLE)
    .map(|(_, direction)| direction.into_owned())
    .collect()
}
