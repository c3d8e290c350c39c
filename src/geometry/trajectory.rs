//! Poses of trajectories.

use nalgebra::{Isometry, SVector};

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

/// Distance driven up to each pose, starting at 0 [m]. Gaps, poses that are not finite, are bridged by a straight line.
pub fn distances_m<R, const D: usize>(poses: &[Isometry<f64, R, D>]) -> Vec<f64> {
    let mut last: Option<SVector<f64, D>> = None;
    let mut driven_m = 0.0;
    (poses.iter().map(|pose| pose.translation.vector))
        .map(|place| {
            if place.iter().all(|number| number.is_finite()) {
                driven_m += last.map_or(0.0, |last| (place - last).norm());
                last = Some(place);
            }
            driven_m
        })
        .collect()
}
