//! Poses of trajectories.

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
