//! What a drive exchanges with whoever sends the scans.

use crate::app::report::export::LiveFrame;
use crate::geometry::Pose3;
use crate::lidar::{Motion, Scan};
use crate::live::{LivePose, Reason};
use crate::localization::Start;
use crate::recording::Frame;

/// A frame that arrived, and its scan.
pub type ArrivedFrame = (Frame, Scan);

/// A pose by the odometry of a robot.
#[derive(Clone, Debug)]
pub struct MeasuredPose {
    /// Name of the frame in which it measures.
    pub odom_frame: String,
    /// Pose of the frame that the odometry measures: `p_odom = odom_from_child * p_child`.
    pub odom_from_child: Pose3,
    /// Pose of the lidar in that frame at that time; `None` while no transforms connect the two.
    pub child_from_lidar: Option<Pose3>,
}

impl MeasuredPose {
    /// Motion of the lidar since an earlier pose, `previous_from_current`; `None` where it is faster than a car, because the
    /// odometry was reset, and between poses in two frames.
    pub fn since(&self, earlier: &Self, duration_s: f64) -> Option<Pose3> {
        /// Fastest motion [m/s].
        const FASTEST: f64 = 100.0;
        let moved = earlier.odom_from_child.inverse() * self.odom_from_child;
        let is_possible = self.odom_frame == earlier.odom_frame
            && moved.translation.vector.norm() <= FASTEST * duration_s;
        let [before, now] = match (earlier.child_from_lidar, self.child_from_lidar) {
            // The lidar may move on the robot.
            (Some(before), Some(now)) => [before, now],
            // A mounting that becomes known is no motion.
            (_, known) => [known.unwrap_or_default(); 2],
        };
        is_possible.then(|| before.inverse() * moved * now)
    }
}

/// A pose that a measured motion carries on since the last scan.
#[derive(Clone, Copy, Debug)]
#[cfg_attr(
    not(feature = "ros2"),
    allow(dead_code, reason = "only a node publishes it")
)]
pub struct CarriedPose {
    /// The pose now.
    pub pose: LivePose,
    /// The motion since the last scan.
    pub motion: Motion,
}

/// What is known at a moment at which no scan is localized.
#[derive(Clone, Copy, Debug)]
#[cfg_attr(
    not(feature = "ros2"),
    allow(dead_code, reason = "only a node publishes it")
)]
pub struct Waiting {
    /// The moment, by the clock of the scans [s].
    pub time_s: f64,
    /// Why the localization is in its state.
    pub reason: Reason,
    /// The pose, where the motion is measured and carries it, because no scan is localized any more.
    pub carried: Option<CarriedPose>,
    /// Number of scans that were dropped so far.
    pub dropped: u64,
    /// Number of scans that could not be used so far.
    pub rejected: u64,
}

/// What a robot gives besides scans, and what it takes.
pub struct Robot<'a> {
    /// Pose by the odometry at a time [s]; `None` where it is not measured.
    pub measured: Box<dyn Fn(f64) -> Option<MeasuredPose> + 'a>,
    /// A start that was proposed since the last call.
    pub proposed: Box<dyn Fn() -> Option<Start> + 'a>,
    /// Takes a frame that was localized.
    pub localized: Box<dyn FnMut(&LiveFrame) + 'a>,
    /// Takes what is known while no scan is localized.
    pub waiting: Box<dyn FnMut(&Waiting) + 'a>,
}

impl Default for Robot<'_> {
    /// A recording: scans only.
    fn default() -> Self {
        Self {
            measured: Box::new(|_| None),
            proposed: Box::new(|| None),
            localized: Box::new(|_| ()),
            waiting: Box::new(|_| ()),
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn a_mounting_that_becomes_known_and_a_reset_of_the_odometry_are_no_motion() {
        let step = Pose3::translation(0.5, 0.0, 0.0);
        let pose = |odom_from_child: Pose3, child_from_lidar: Option<Pose3>| MeasuredPose {
            odom_frame: "odom".to_owned(),
            odom_from_child,
            child_from_lidar,
        };
        let first = pose(Pose3::translation(40.0, 7.0, 0.0), None);
        let mounted = pose(
            first.odom_from_child * step,
            Some(Pose3::translation(1.0, 0.0, 2.0)),
        );
        let moved = mounted.since(&first, 0.1).unwrap();
        assert_relative_eq!(moved, step, epsilon = 1e-12);
        let reset = pose(step, mounted.child_from_lidar);
        assert_eq!(reset.since(&mounted, 0.1), None);
        let in_other_frame = MeasuredPose {
            odom_frame: "odom_filtered".to_owned(),
            ..mounted.clone()
        };
        assert_eq!(in_other_frame.since(&first, 0.1), None);
        // A mast that rises is one.
        let risen = pose(
            mounted.odom_from_child * step,
            Some(Pose3::translation(1.0, 0.0, 2.25)),
        );
        let moved = risen.since(&mounted, 0.1).unwrap();
        assert_relative_eq!(moved, Pose3::translation(0.5, 0.0, 0.25), epsilon = 1e-12);
    }
}
