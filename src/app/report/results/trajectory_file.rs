//! The `.npz` file of a trajectory.

use std::path::Path;

use anyhow::Result;

use super::npz_writer::NpzWriter;
use crate::app::run::output;
use crate::geometry::Pose3;
use crate::odometry::{OdometryEstimate, StepState};
use crate::recording::Frame;

/// Writes one row per frame: `frames`, `times_s`, `map_from_lidar` and `odom_from_lidar` (rows, 4, 4),
/// `motion_covariances` (rows, 6, 6) of the motion since the scan before: x, y, z, roll, pitch, yaw in the lidar
/// frame [m, rad], and `states`: 0 first, 1 registered, 2 predicted, 3 given, 4 doubtful,
/// 5 lost.
pub fn write_trajectory_npz(
    path: &Path,
    frames: &[Frame],
    poses: &[Pose3],
    steps: &[&OdometryEstimate],
) -> Result<()> {
    let count = frames.len();
    // Columns of the transpose are rows of the matrix.
    let matrix = |pose: &Pose3| pose.to_homogeneous().transpose().data.0.concat();
    let odometry = steps.iter().flat_map(|step| matrix(&step.odom_from_lidar));
    let covariances = (steps.iter()).flat_map(|step| step.covariance.data.0.concat());
    let state = |step: &&OdometryEstimate| match step.state {
        StepState::First => 0_u8,
        StepState::Registered => 1,
        StepState::Predicted => 2,
        StepState::Given => 3,
        StepState::Doubtful => 4,
        StepState::Lost => 5,
    };
    output::write_file(path, |file| {
        let mut npz = NpzWriter::new(file);
        let numbers = frames.iter().map(|frame| frame.number as u64);
        npz.add("frames", &[count], numbers)?;
        npz.add("times_s", &[count], frames.iter().map(|frame| frame.time_s))?;
        let poses = poses.iter().flat_map(matrix);
        npz.add("map_from_lidar", &[count, 4, 4], poses)?;
        npz.add("odom_from_lidar", &[count, 4, 4], odometry)?;
        npz.add("motion_covariances", &[count, 6, 6], covariances)?;
        npz.add("states", &[count], steps.iter().map(state))?;
        npz.finish()
    })
}
