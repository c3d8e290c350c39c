//! The last poses of a moving frame, and where it was between them.

use std::collections::VecDeque;

use crate::geometry::Pose3;
use crate::lidar::interpolate_motion;

/// Number of poses that are kept: ten seconds of most odometries.
const MOST_POSES: usize = 1000;

/// Longest time between two poses that is interpolated [s].
const LONGEST_GAP_S: f64 = 0.5;

/// Longest time after the last pose that is extrapolated [s].
const LONGEST_AHEAD_S: f64 = 0.1;

/// Poses with ascending times.
#[derive(Clone, Debug, Default)]
pub struct PoseBuffer(VecDeque<(f64, Pose3)>);

impl PoseBuffer {
    /// Adds a pose at a time [s]. One that is not later than the last is left out; one more than half a second earlier restarts
    /// the buffer, because the clock was set.
    pub fn push(&mut self, time_s: f64, parent_from_child: Pose3) {
        if let Some(&(last_s, _)) = self.0.back() {
            if time_s < last_s - LONGEST_GAP_S {
                self.0.clear();
            } else if time_s <= last_s {
                return;
            }
        }
        self.0.push_back((time_s, parent_from_child));
        if self.0.len() > MOST_POSES {
            self.0.pop_front();
        }
    }

    /// The pose at a time [s]; `None` where it is not between poses, nor shortly after the last.
    pub fn at(&self, time_s: f64) -> Option<Pose3> {
        let after = self.0.partition_point(|(at_s, _)| *at_s < time_s);
        let last = self.0.len().checked_sub(1)?;
        if after > last {
            let (last_s, pose) = self.0[last];
            let ahead_s = time_s - last_s;
            let step = last.checked_sub(1).map(|before| self.0[before]);
            return (ahead_s <= LONGEST_AHEAD_S).then(|| match step {
                Some((before_s, before)) if last_s - before_s <= LONGEST_GAP_S => {
                    let step = before.inverse() * pose;
                    pose * interpolate_motion(&step, ahead_s / (last_s - before_s))
                }
                _ => pose,
            });
        }
        let (after_s, after_pose) = self.0[after];
        if after_s == time_s {
            return Some(after_pose);
        }
        let (before_s, before) = self.0[after.checked_sub(1)?];
        let gap_s = after_s - before_s;
        (gap_s <= LONGEST_GAP_S).then(|| {
            let step = before.inverse() * after_pose;
            before * interpolate_motion(&step, (time_s - before_s) / gap_s)
        })
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    /// A car on a circle.
    fn pose(time_s: f64) -> Pose3 {
        let turn = Pose3::rotation(nalgebra::Vector3::z() * 0.3 * time_s);
        turn * Pose3::translation(20.0, 0.0, 0.0)
    }

    fn buffer(times_s: &[f64]) -> PoseBuffer {
        let mut buffer = PoseBuffer::default();
        for &time_s in times_s {
            buffer.push(time_s, pose(time_s));
        }
        buffer
    }

    #[test]
    fn between_poses_and_shortly_after_them_the_car_is_where_it_drove() {
        let buffer = buffer(&[10.0, 10.1, 10.2, 11.0]);
        for time_s in [10.0, 10.05, 10.17, 10.2] {
            assert_relative_eq!(buffer.at(time_s).unwrap(), pose(time_s), epsilon = 1e-4);
        }
        for unknown_s in [9.99, 10.5, 11.2] {
            assert_eq!(buffer.at(unknown_s), None, "{unknown_s}");
        }
        assert_eq!(PoseBuffer::default().at(0.0), None);
    }

    #[test]
    fn the_motion_goes_on_after_the_last_pose_for_a_moment() {
        let buffer = buffer(&[10.0, 10.1]);
        assert_relative_eq!(buffer.at(10.15).unwrap(), pose(10.15), epsilon = 1e-3);
        assert_eq!(buffer.at(10.21), None);
    }

    #[test]
    fn a_clock_that_is_set_back_restarts_the_buffer_and_the_number_of_poses_is_limited() {
        let mut buffer = buffer(&[10.0, 10.1, 10.05, 3.0, 3.1]);
        assert_eq!(buffer.0.len(), 2);
        for step in 0..2 * MOST_POSES {
            buffer.push(4.0 + 0.01 * step as f64, Pose3::identity());
        }
        assert_eq!(buffer.0.len(), MOST_POSES);
    }
}
