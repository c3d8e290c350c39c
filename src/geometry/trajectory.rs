//! A trajectory: poses of one body over time.

use super::Pose3;

/// A pose with its place in the recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose {
    /// Number of the frame in its recording.
    pub frame: usize,
    /// Time since the first frame of the recording [s].
    pub time_s: f64,
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Pose3,
}

/// Poses in the order of their frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// Ascending in frame.
    pub poses: Vec<StampedPose>,
}

impl Trajectory {
    /// Distance driven up to each pose, starting at 0 [m].
    pub fn distances_m(&self) -> Vec<f64> {
        let mut driven_m = 0.0;
        let mut previous: Option<&StampedPose> = None;
        self.poses
            .iter()
            .map(|pose| {
                if let Some(previous) = previous {
                    driven_m += (pose.map_from_lidar.translation.vector
                        - previous.map_from_lidar.translation.vector)
                        .norm();
                }
                previous = Some(pose);
                driven_m
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
    fn distance_adds_up_along_the_path_and_not_along_the_chord() {
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
