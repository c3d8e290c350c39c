//! Trajectories.

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

/// Poses in ascending order of their frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// Stamped poses.
    pub poses: Vec<StampedPose>,
}

impl Trajectory {
    /// Path length from the first pose to each pose [m].
    pub fn distances_m(&self) -> Vec<f64> {
        let position = |index: usize| self.poses[index].map_from_lidar.translation.vector;
        let mut length_m = 0.0;
        (0..self.poses.len())
            .map(|index| {
                if index > 0 {
                    length_m += (position(index) - position(index - 1)).norm();
                }
                length_m
            })
            .collect()
    }
}

impl FromIterator<StampedPose> for Trajectory {
    fn from_iter<I: IntoIterator<Item = StampedPose>>(poses: I) -> Self {
        Self {
            poses: poses.into_iter().collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn path_length_accumulates_along_the_path() {
        let corners = [(0.0, 0.0), (3.0, 0.0), (3.0, 4.0)];
        let trajectory: Trajectory = corners
            .iter()
            .enumerate()
            .map(|(frame, &(x, y))| StampedPose {
                frame,
                time_s: 0.0,
                map_from_lidar: Pose3::translation(x, y, 0.0),
            })
            .collect();
        assert_eq!(trajectory.distances_m(), [0.0, 3.0, 7.0]);
    }
}
