//! Poses of trajectories.

use nalgebra::Isometry;

use super::Pose3;

/// A pose with its frame number and time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose {
    /// Frame number in the recording.
    pub frame: usize,
    /// Time since the first frame of the recording [s].
    pub time_s: f64,
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Pose3,
}

/// Distance driven up to each pose, starting at 0 [m].
pub fn distances_m<R, const D: usize>(poses: &[Isometry<f64, R, D>]) -> Vec<f64> {
    let steps_m = poses
        .windows(2)
        .map(|pair| (pair[1].translation.vector - pair[0].translation.vector).norm());
    let mut driven_m = 0.0;
    (poses.iter().take(1).map(|_| 0.0).chain(steps_m))
        .map(|step_m| {
            driven_m += step_m;
            driven_m
        })
        .collect()
}
