//! The pose graph of a drive: its submaps, the motions between them, and the scans that move with them.

use super::drive::{Drive, Submap};
use super::odometer::OdometryEstimate;
use super::pose_graph::{Edge, information};
use crate::geometry::Pose3;
use crate::lidar::interpolate_motion;

/// Path of a submap, in ranges.
pub const SUBMAP_LENGTH: f64 = 0.12;

/// Edges of the pose graph between submaps in succession.
pub fn odometry_edges(drive: &Drive, maps: &[Submap], odometry: &[OdometryEstimate]) -> Vec<Edge> {
    /// Standard deviation of the motion: share of the path, and at least in voxels.
    const SHARE: f64 = 0.003;
    const FLOOR: f64 = 0.01;
    /// Standard deviation of the rotation [rad/m], and at least [rad].
    const TURN_RAD_PER_M: f64 = 2e-4;
    const TURN_FLOOR_RAD: f64 = 2e-4;
    /// Factor where scans could not be registered.
    const PREDICTED: f64 = 30.0;
    (maps.windows(2).enumerate())
        .map(|(first, pair)| {
            let [a, b] = [pair[0].center, pair[1].center];
            let first_from_second = drive.poses[a].inverse() * drive.poses[b];
            let path_m = pair[1].travelled_m - pair[0].travelled_m;
            let is_predicted = (odometry[a + 1..=b].iter()).any(|step| step.state.is_predicted());
            let factor = if is_predicted { PREDICTED } else { 1.0 };
            let shift_m = factor * (SHARE * path_m + FLOOR * drive.voxel_m);
            let turn_rad = factor * (TURN_RAD_PER_M * path_m + TURN_FLOOR_RAD);
            Edge {
                first,
                second: first + 1,
                first_from_second,
                information: information(shift_m, turn_rad),
                is_loop: false,
            }
        })
        .collect()
}

/// Moves all poses with the centers of their submaps; the correction changes evenly from one to the next.
pub fn move_along(poses: &mut [Pose3], maps: &[Submap], before: &[Pose3], after: &[Pose3]) {
    let correction = |map: usize| after[map] * before[map].inverse();
    for (row, pose) in poses.iter_mut().enumerate() {
        let next = maps.partition_point(|map| map.center <= row);
        let last = next.saturating_sub(1);
        let next = next.min(maps.len() - 1);
        let span = maps[next].center - maps[last].center;
        let share = match span {
            0 => 0.0,
            span => (row - maps[last].center) as f64 / span as f64,
        };
        // As motions of the pose itself, whose turns do not move it.
        let moved = correction(last) * *pose;
        let further = moved.inverse() * correction(next) * *pose;
        *pose = moved * interpolate_motion(&further, share);
    }
}
