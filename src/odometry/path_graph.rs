//! The pose graph of a drive: its submaps, the motions between them, and the scans that move with them.

use super::block_system::BlockSystem;
use super::drive::{Drive, Submap};
use super::loops::{Loop, LoopVerdict};
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

/// The loops that the poses follow, between the centers of their submaps.
pub fn loop_edges(drive: &Drive, maps: &[Submap], loops: &[Loop]) -> Vec<Edge> {
    /// Standard deviations [m], [rad].
    const SHIFT_M: f64 = 0.05;
    const TURN_RAD: f64 = 0.005;
    let motion = |a: usize, b: usize| drive.poses[a].inverse() * drive.poses[b];
    let map_of = |row: usize| maps.partition_point(|map| map.rows.end <= row);
    (loops.iter())
        .filter(|found| found.verdict == LoopVerdict::Accepted)
        .map(|found| {
            let [first, second] = [found.first, found.second].map(map_of);
            Edge {
                first,
                second,
                first_from_second: motion(maps[first].center, found.first)
                    * found.first_from_second
                    * motion(found.second, maps[second].center),
                information: information(SHIFT_M, TURN_RAD),
                is_loop: true,
            }
        })
        .collect()
}

/// Adds the directions up of the scans of submaps, where they are known, to the equations of their poses, those from
/// `first` on.
pub fn keep_level(
    drive: &Drive,
    maps: &[Submap],
    first: usize,
    system: &mut BlockSystem,
    poses: &[Pose3],
) {
    let Some(levels) = &drive.levels else {
        return;
    };
    for (place, (map, pose)) in maps.iter().zip(&poses[first..]).enumerate() {
        levels.add_to(
            system,
            (first + place, map.center),
            pose,
            map.rows.len() as f64,
        );
    }
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
