//! Motion of the sensor during a sweep, by which its scan is deskewed.
//!
//! The estimates give the motion far more accurately than odometry does. With m the motion from the
//! last frame to this one and m' the one before, constant acceleration gives at this frame
//!
//! ```text
//! v = m + ½ (m − m')
//! ```
//!
//! The pose of this frame is found first with the scan deskewed by m', then, from there, with v. Odometry is used
//! until there are two frames in a row in which the filter was tracking.

use super::odometry::Odometry;
use crate::geometry::{Pose3, pose3_from_pose2};
use crate::lidar::{Motion, PERIOD_S, Scan, interpolate_motion, interval_s};

/// The motion of the sensor, updated frame by frame.
#[derive(Clone, Debug, Default)]
pub struct SweepMotion {
    /// Pose of the last frame if it was tracked, `map_from_lidar`.
    last_pose: Option<Pose3>,
    /// Time of the last frame [s].
    last_time_s: Option<f64>,
    /// Motion from the frame before it, m'.
    last_motion: Option<Motion>,
}

impl SweepMotion {
    /// Time since the last frame [s].
    pub fn duration_s(&self, scan: &Scan) -> f64 {
        let times_s = self.last_time_s.zip(scan.time_s);
        let since = times_s.map(|(last_s, now_s)| interval_s(last_s, now_s));
        since.filter(|&s| s > 0.0).unwrap_or(PERIOD_S)
    }

    /// Motion around the next frame before its pose is known; `None` if it is unknown.
    pub fn predict(&self, odometry: Odometry, duration_s: f64) -> Option<Motion> {
        let measured = odometry.in_plane();
        let of_odometry = |increment| Motion {
            previous_from_current: pose3_from_pose2(&increment, 0.0),
            duration_s,
        };
        self.last_motion.or(measured.map(of_odometry))
    }

    /// Motion around the next frame, whose pose was found; `None` if the last frame was not tracked.
    pub fn around(&self, map_from_lidar: &Pose3, duration_s: f64) -> Option<Motion> {
        let mut motion = self.since_last(map_from_lidar, duration_s)?;
        if let Some(last) = &self.last_motion {
            let continued = last.after(duration_s);
            let change = continued.inverse() * motion.previous_from_current;
            motion.previous_from_current *= interpolate_motion(&change, 0.5);
        }
        Some(motion)
    }

    /// Makes a frame the last one; without a pose if it was not tracked.
    pub fn update(&mut self, map_from_lidar: Option<Pose3>, scan: &Scan, duration_s: f64) {
        self.last_motion = map_from_lidar.and_then(|pose| self.since_last(&pose, duration_s));
        self.last_pose = map_from_lidar;
        self.last_time_s = scan.time_s;
    }

    fn since_last(&self, map_from_lidar: &Pose3, duration_s: f64) -> Option<Motion> {
        Some(Motion {
            previous_from_current: self.last_pose?.inverse() * map_from_lidar,
            duration_s,
        })
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    fn at(x: f64) -> Pose3 {
        Pose3::translation(x, 0.0, 0.0)
    }

    fn scan(time_s: f64) -> Scan {
        Scan {
            time_s: Some(time_s),
            ..Scan::default()
        }
    }

    #[test]
    fn the_speed_of_constant_acceleration_is_exact() {
        // x = 3 t + 2 t², at uneven times.
        let x = |t: f64| 3.0 * t + 2.0 * t * t;
        let mut sweep = SweepMotion::default();
        for t in [0.0, 0.1] {
            let duration_s = sweep.duration_s(&scan(t));
            sweep.update(Some(at(x(t))), &scan(t), duration_s);
        }
        let duration_s = sweep.duration_s(&scan(0.2));
        assert_relative_eq!(duration_s, 0.1, epsilon = 1e-12);
        let found = sweep.around(&at(x(0.2)), duration_s).unwrap();
        let speed = found.previous_from_current.translation.x / found.duration_s;
        assert_relative_eq!(speed, 3.0 + 4.0 * 0.2, epsilon = 1e-9);
    }

    #[test]
    fn a_frame_that_was_not_tracked_gives_no_motion() {
        let mut sweep = SweepMotion::default();
        sweep.update(Some(at(0.0)), &scan(0.0), 0.1);
        sweep.update(None, &scan(0.1), 0.1);
        assert!(sweep.around(&at(1.0), 0.1).is_none());
        assert!(sweep.predict(Odometry::Unknown, 0.1).is_none());
        let increment = crate::geometry::Pose2::translation(0.7, 0.0);
        let motion = sweep.predict(Odometry::Increment(increment), 0.2).unwrap();
        assert_relative_eq!(motion.after(0.1).translation.x, 0.35);
    }
}
