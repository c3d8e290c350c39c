//! Direction up along a drive, from an accelerometer and the accelerations of the odometry.
//!
//! Averages over windows w of four seconds, in the frame of the odometry, do not contain vibrations, and the acceleration of
//! the drive follows from the odometry without differentiating it twice:
//!
//! ```text
//! ∫ w R f dt − Σ w(tₖ) (vₖ₊₁ − vₖ) = g · up + (∫ w R dt) · b       w: Hann, ∫ w dt = 1;   v: velocities between scans
//! ```
//!
//! R is the rotation `odom_from_imu`. The direction up in that frame changes as slowly as the odometry drifts, and the bias b of
//! the accelerometer changes less: both are a random walk from window to window, found by robust least squares. A bias and a
//! tilt look the same until the drive turns. The standard deviation of the drift is the candidate with the largest marginal
//! likelihood, so that the noise of an accelerometer does not bend the path of an accurate odometry.
//!
//! The odometry is then integrated again with rotations whose tilt is that of gravity, so that its height follows, and
//! each scan keeps its direction up as a weak constraint of the loops and of the adjustment.

use std::f64::consts::PI;

use nalgebra::{Matrix3, Matrix6, Unit, UnitQuaternion, Vector3, Vector6};

use super::block_system::BlockSystem;
use crate::geometry::Pose3;
use crate::inertial::{GRAVITY_M_S2, ImuCalibration, ImuRejection, ImuSamples};
use crate::statistics::median;

/// Time between the middles of windows, half of their length [s].
const WINDOW_S: f64 = 2.0;

/// Directions up that the poses of a drive are to keep.
#[derive(Clone, Debug, PartialEq)]
pub struct Levels {
    /// In the lidar frame of each scan, of length one.
    up_in_lidar: Vec<Vector3<f64>>,
    /// Information of one scan [1/rad²].
    information: f64,
}

impl Levels {
    /// Directions up in the lidar frame of each scan, and the information of one of them [1/rad²].
    #[cfg(test)]
    pub fn new(up_in_lidar: Vec<Vector3<f64>>, information: f64) -> Self {
        Self {
            up_in_lidar,
            information,
        }
    }

    /// Adds the deviation of a pose, that of a row of the drive, from its direction up, as often as that of one scan counts.
    pub fn add_to(
        &self,
        system: &mut BlockSystem,
        (place, row): (usize, usize),
        pose: &Pose3,
        scans: f64,
    ) {
        let up = self.up_in_lidar[row];
        let residual = pose.rotation * up - Vector3::z();
        let by_turn = -(pose.rotation.to_rotation_matrix().matrix() * up.cross_matrix());
        let weight = self.information * scans;
        let mut block = Matrix6::zeros();
        (block.fixed_view_mut::<3, 3>(3, 3)).copy_from(&(by_turn.transpose() * by_turn * weight));
        let mut right_side = Vector6::zeros();
        (right_side.fixed_rows_mut::<3>(3)).copy_from(&-(by_turn.transpose() * residual * weight));
        system.add(place, &block, &right_side);
    }
}

/// A drive in a frame whose z axis points up.
#[derive(Clone, Debug, PartialEq)]
pub struct Levelled {
    /// `p_level = level_from_lidar * p_lidar` of each scan; the first is at the origin and is turned as little as possible.
    pub poses: Vec<Pose3>,
    /// What loops and adjustment keep.
    pub levels: Levels,
    /// Mean bias of the forces, along the axes of the sensor [m/s²].
    pub force_bias_m_s2: Vector3<f64>,
    /// Standard deviation of the tilt of the drive as a whole [rad].
    pub sigma_rad: f64,
}

/// Finds the direction up along a drive, and turns its poses by it. Times are those of the scans [s].
///
/// # Errors
/// The drive is too short, or the forces contradict its motion.
pub fn level(
    odom_from_lidar: &[Pose3],
    times_s: &[f64],
    samples: &ImuSamples,
    calibration: &ImuCalibration,
) -> Result<Levelled, ImuRejection> {
    /// Largest residual of a window [m/s²].
    const MAX_RESIDUAL_M_S2: f64 = 0.5;
    /// Largest bias [m/s²].
    const MAX_BIAS_M_S2: f64 = 1.5;
    let drive = DrivenPath {
        poses: odom_from_lidar,
        times_s,
    };
    let windows = windows(&drive, samples, calibration);
    let ups = Ups::fit(&windows).ok_or_else(|| ImuRejection::TooShort {
        duration_s: drive.duration_s(),
    })?;
    let force_bias_m_s2 = ups.mean_bias();
    let bias_m_s2 = force_bias_m_s2.norm();
    if ups.residual_m_s2 > MAX_RESIDUAL_M_S2 || bias_m_s2 > MAX_BIAS_M_S2 {
        return Err(ImuRejection::Forces {
            residual_m_s2: ups.residual_m_s2,
            bias_m_s2,
        });
    }
    let poses = ups.levelled(&drive);
    let up_in_lidar = (poses.iter())
        .map(|pose| pose.rotation.inverse() * Vector3::z())
        .collect();
    let scans_per_window = WINDOW_S * times_s.len() as f64 / drive.duration_s();
    Ok(Levelled {
        poses,
        levels: Levels {
            up_in_lidar,
            information: ups.information() / scans_per_window,
        },
        force_bias_m_s2,
        sigma_rad: ups.sigma_rad,
    })
}

/// Poses of a drive by time.
struct DrivenPath<'a> {
    poses: &'a [Pose3],
    times_s: &'a [f64],
}

impl DrivenPath<'_> {
    fn duration_s(&self) -> f64 {
        match self.times_s {
            [first_s, .., last_s] => last_s - first_s,
            _ => 0.0,
        }
    }

    /// Rotation at a time, between the scans before and after it; `None` outside of the drive.
    fn rotation(&self, time_s: f64) -> Option<UnitQuaternion<f64>> {
        let after = self.times_s.partition_point(|&scan_s| scan_s <= time_s);
        let before = after.checked_sub(1)?;
        let [from_s, to_s] = [before, after].map(|row| self.times_s.get(row));
        let share = (time_s - from_s?) / (to_s? - from_s?);
        let [a, b] = [before, after].map(|row| self.poses[row].rotation);
        Some(a * UnitQuaternion::from_scaled_axis((a.inverse() * b).scaled_axis() * share))
    }

    /// Velocity between a scan and the next one [m/s].
    fn velocity(&self, row: usize) -> Vector3<f64> {
        let shift = self.poses[row + 1].translation.vector - self.poses[row].translation.vector;
        shift / (self.times_s[row + 1] - self.times_s[row])
    }
}

/// Averages over a window.
#[derive(Clone, Debug)]
struct Window {
    /// Its middle [s].
    time_s: f64,
    /// Path until there [m].
    path_m: f64,
    /// Sum of the weights of its measurements, one if it is covered.
    covered: f64,
    /// Mean force without the acceleration of the drive, in the frame of the odometry [m/s²].
    force: Vector3<f64>,
    /// Mean rotation `odom_from_imu`.
    odom_from_imu: Matrix3<f64>,
}

/// Weight of a moment of a window [1/s].
fn weight(from_middle_s: f64) -> f64 {
    let share = (from_middle_s / WINDOW_S).abs();
    if share < 1.0 {
        (1.0 + (PI * share).cos()) / (2.0 * WINDOW_S)
    } else {
        0.0
    }
}

/// The windows that are covered by measurements.
fn windows(drive: &DrivenPath, samples: &ImuSamples, calibration: &ImuCalibration) -> Vec<Window> {
    /// Least share of a window that is measured.
    const COVERED: f64 = 0.95;
    let count = (drive.duration_s() / WINDOW_S) as usize;
    let Some(&first_s) = drive.times_s.first() else {
        return vec![];
    };
    let middle_s = |window: usize| first_s + WINDOW_S * (window as f64 + 1.0);
    let mut windows: Vec<Window> = (0..count.saturating_sub(1))
        .map(|window| Window {
            time_s: middle_s(window),
            path_m: 0.0,
            covered: 0.0,
            force: Vector3::zeros(),
            odom_from_imu: Matrix3::zeros(),
        })
        .collect();
    // A moment is in the windows before and after it.
    let around = |time_s: f64| {
        let after = ((time_s - first_s) / WINDOW_S) as usize;
        after.saturating_sub(1)..(after + 1).min(count.saturating_sub(1))
    };
    for [a, b] in samples.steps() {
        let time_s = 0.5 * (a.time_s + b.time_s) - calibration.offset_s;
        let Some(rotation) = drive.rotation(time_s) else {
            continue;
        };
        let odom_from_imu = *(rotation * calibration.lidar_from_imu)
            .to_rotation_matrix()
            .matrix();
        let force = odom_from_imu * (0.5 * (a.force_m_s2 + b.force_m_s2));
        for window in &mut windows[around(time_s)] {
            let share = weight(time_s - window.time_s) * (b.time_s - a.time_s);
            window.covered += share;
            window.force += force * share;
            window.odom_from_imu += odom_from_imu * share;
        }
    }
    for window in &mut windows {
        window.force /= window.covered;
        window.odom_from_imu /= window.covered;
    }
    let mut path_m = 0.0;
    for row in 1..drive.times_s.len().saturating_sub(1) {
        let [before, after] = [row - 1, row].map(|row| drive.velocity(row));
        let time_s = drive.times_s[row];
        path_m += before.norm() * (time_s - drive.times_s[row - 1]);
        for window in &mut windows[around(time_s)] {
            window.force -= (after - before) * weight(time_s - window.time_s);
            if time_s <= window.time_s {
                window.path_m = path_m;
            }
        }
    }
    windows.retain(|window| window.covered > COVERED);
    windows
}

/// Directions up in the frame of the odometry, and the bias.
struct Ups {
    times_s: Vec<f64>,
    /// Standard deviation of the drift, in units of the fastest one.
    drift: f64,
    /// The direction up of the whole drive, before its changes.
    up: Vector3<f64>,
    turns: Vec<UnitQuaternion<f64>>,
    biases: Vec<Vector3<f64>>,
    residual_m_s2: f64,
    sigma_rad: f64,
}

impl Ups {
    /// The directions and biases that fit windows best, with the drift for which they are most likely; `None` with fewer than
    /// two windows.
    fn fit(windows: &[Window]) -> Option<Self> {
        /// Candidates for the standard deviation of the drift, each half of the one before: of a drift in one direction from 5
        /// degrees in 100 m to 0.02 degrees in a kilometre.
        const CANDIDATES: i32 = 12;
        let fits = (0..CANDIDATES).map(|halvings| Self::fit_with(windows, 0.5_f64.powi(halvings)));
        let fits: Option<Vec<(f64, Self)>> = fits.collect();
        let likeliest = fits?.into_iter().min_by(|a, b| a.0.total_cmp(&b.0))?;
        Some(likeliest.1)
    }

    /// The directions and biases that fit windows best with a drift, and -2 log of the likelihood of the measurements.
    fn fit_with(windows: &[Window], drift: f64) -> Option<(f64, Self)> {
        const ITERATIONS: usize = 8;
        let sum: Vector3<f64> = windows.iter().map(|window| window.force).sum();
        let up = Unit::try_new(sum, 1e-6)?.into_inner();
        let mut ups = Self {
            times_s: windows.iter().map(|window| window.time_s).collect(),
            drift,
            up,
            turns: vec![UnitQuaternion::identity(); windows.len()],
            biases: vec![Vector3::zeros(); windows.len()],
            residual_m_s2: 0.0,
            sigma_rad: 0.0,
        };
        if windows.len() < 2 {
            return None;
        }
        let mut minus_two_log_likelihood = f64::INFINITY;
        for iteration in 0..ITERATIONS {
            ups.residual_m_s2 = ups.residual(windows);
            let (cost, system) = ups.system(windows);
            for (row, step) in system.solve()?.iter().enumerate() {
                let turn: Vector3<f64> = step.fixed_rows::<3>(0).into();
                let turn = UnitQuaternion::from_scaled_axis(turn);
                ups.turns[row] = turn * ups.turns[row];
                ups.biases[row] += step.fixed_rows::<3>(3);
            }
            if iteration + 1 == ITERATIONS {
                ups.sigma_rad = ups.sigma(&system)?;
                // Normalization of three axes of the drift and three of the measurement per window.
                minus_two_log_likelihood = cost
                    + system.log_determinant()?
                    + 6.0 * (windows.len() as f64) * (drift.ln() + ups.sigma_m_s2().ln());
            }
        }
        ups.residual_m_s2 = ups.residual(windows);
        Some((minus_two_log_likelihood, ups))
    }

    fn difference(&self, row: usize, window: &Window) -> Vector3<f64> {
        let up = self.turns[row] * self.up;
        window.force - up * GRAVITY_M_S2 - window.odom_from_imu * self.biases[row]
    }

    /// Robust standard deviation of an axis of the differences [m/s²].
    fn residual(&self, windows: &[Window]) -> f64 {
        /// Median of the length of a vector of three normal numbers.
        const MEDIAN: f64 = 1.538;
        let lengths = windows.iter().enumerate();
        let lengths = lengths.map(|(row, window)| self.difference(row, window).norm());
        median(lengths).unwrap_or_default() / MEDIAN
    }

    /// The standard deviation that the differences are weighted by [m/s²].
    fn sigma_m_s2(&self) -> f64 {
        /// Least one, a tilt of 0.02 degrees: corners of the odometry and vibrations are not known better.
        const LEAST_M_S2: f64 = 0.004;
        self.residual_m_s2.max(LEAST_M_S2)
    }

    /// Cost, and linearized equations of the changes: turns in the frame of the odometry, and biases.
    fn system(&self, windows: &[Window]) -> (f64, BlockSystem) {
        /// Standard deviation of the bias [m/s²], and of its change [m/s² per √s].
        const BIAS_M_S2: f64 = 0.3;
        const BIAS_WALK: f64 = 5e-4;
        /// Standard deviation of the fastest drift of the tilt [rad/m], and per window [rad].
        const TILT_RAD_PER_M: f64 = 8e-4;
        const TILT_RAD: f64 = 1.6e-3;
        /// Turns about the direction up are not measured [rad].
        const FREE_RAD: f64 = 1.0;
        /// Scale of the robust kernel, in standard deviations.
        const KERNEL: f64 = 3.0;
        let sigma = self.sigma_m_s2();
        let mut cost = 0.0;
        let mut system = BlockSystem::new(windows.len());
        for (row, window) in windows.iter().enumerate() {
            let difference = self.difference(row, window);
            let square = (difference.norm() / (KERNEL * sigma)).powi(2);
            let information = (sigma * (1.0 + square)).powi(-2);
            cost += KERNEL * KERNEL * square / (1.0 + square);
            // difference(δ) = difference + by_turn δ − R δ_b.
            let by_turn = (self.turns[row] * self.up * GRAVITY_M_S2).cross_matrix();
            let mut jacobian = nalgebra::Matrix3x6::zeros();
            jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&by_turn);
            (jacobian.fixed_view_mut::<3, 3>(0, 3)).copy_from(&-window.odom_from_imu);
            let transposed = jacobian.transpose() * information;
            system.add(row, &(transposed * jacobian), &-(transposed * difference));
            let free = Vector6::new(1.0, 1.0, 1.0, 0.0, 0.0, 0.0) * FREE_RAD.powi(-2);
            system.add(row, &Matrix6::from_diagonal(&free), &Vector6::zeros());
        }
        let held = Vector6::new(0.0, 0.0, 0.0, 1.0, 1.0, 1.0) * BIAS_M_S2.powi(-2);
        let mut bias = Vector6::zeros();
        bias.fixed_rows_mut::<3>(3).copy_from(&self.biases[0]);
        let held = Matrix6::from_diagonal(&held);
        system.add(0, &held, &-(held * bias));
        for (row, pair) in windows.windows(2).enumerate() {
            let path_m = pair[1].path_m - pair[0].path_m;
            let tilt = self.drift * (TILT_RAD_PER_M * path_m + TILT_RAD);
            let walk = BIAS_WALK * (pair[1].time_s - pair[0].time_s).sqrt();
            let [tilt, walk] = [tilt.powi(-2), walk.powi(-2)];
            let information =
                Matrix6::from_diagonal(&Vector6::new(tilt, tilt, tilt, walk, walk, walk));
            let turn = (self.turns[row + 1] * self.turns[row].inverse()).scaled_axis();
            let bias = self.biases[row + 1] - self.biases[row];
            let change = Vector6::new(turn.x, turn.y, turn.z, bias.x, bias.y, bias.z);
            cost += change.dot(&(information * change));
            system.add(row, &information, &(information * change));
            system.add(row + 1, &information, &-(information * change));
            system.add_off_diagonal(row, row + 1, &-information);
        }
        (cost, system)
    }

    /// Standard deviation of the direction up in the middle of the drive [rad].
    fn sigma(&self, system: &BlockSystem) -> Option<f64> {
        let middle = self.turns.len() / 2;
        let mut covariance = Matrix3::zeros();
        for axis in 0..3 {
            let mut unit = vec![Vector6::zeros(); self.turns.len()];
            unit[middle][axis] = 1.0;
            let solved = system.solve_for(&unit)?;
            covariance.set_column(axis, &solved[middle].fixed_rows::<3>(0));
        }
        let up = self.turns[middle] * self.up;
        let about_up = up.dot(&(covariance * up));
        Some((0.5 * (covariance.trace() - about_up)).max(0.0).sqrt())
    }

    /// Information of the tilt of one window beyond what all have in common [1/rad²].
    fn information(&self) -> f64 {
        /// Least standard deviation [rad]: 0.02 degrees.
        const LEAST_RAD: f64 = 3.5e-4;
        let sigma_rad = self.sigma_m_s2() / GRAVITY_M_S2;
        1.0 / (sigma_rad.powi(2) + LEAST_RAD.powi(2))
    }

    fn mean_bias(&self) -> Vector3<f64> {
        self.biases.iter().sum::<Vector3<f64>>() / self.biases.len().max(1) as f64
    }

    /// Rotation `level_from_odom` at a time.
    fn level_from_odom(&self, time_s: f64) -> UnitQuaternion<f64> {
        let last = self.times_s.len() - 1;
        let after = (self.times_s.partition_point(|&middle_s| middle_s <= time_s)).clamp(1, last);
        let [a, b] = [after - 1, after].map(|row| self.turns[row]);
        let share =
            (time_s - self.times_s[after - 1]) / (self.times_s[after] - self.times_s[after - 1]);
        let between = (a.inverse() * b).scaled_axis() * share.clamp(0.0, 1.0);
        let turn = a * UnitQuaternion::from_scaled_axis(between);
        // A lidar that hangs upside down is turned over.
        let flat = UnitQuaternion::rotation_between(&self.up, &Vector3::z())
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI));
        flat * turn.inverse()
    }

    /// The poses, integrated with rotations that are level.
    fn levelled(&self, drive: &DrivenPath) -> Vec<Pose3> {
        let mut position = Vector3::zeros();
        let mut poses: Vec<Pose3> = Vec::with_capacity(drive.poses.len());
        for (row, pose) in drive.poses.iter().enumerate() {
            let time_s = drive.times_s[row];
            if let Some(before) = row.checked_sub(1) {
                let middle_s = 0.5 * (drive.times_s[before] + time_s);
                let shift = pose.translation.vector - drive.poses[before].translation.vector;
                position += self.level_from_odom(middle_s) * shift;
            }
            let rotation = self.level_from_odom(time_s) * pose.rotation;
            poses.push(Pose3::from_parts(position.into(), rotation));
        }
        poses
    }
}

#[cfg(test)]
#[path = "level_tests.rs"]
mod tests;
