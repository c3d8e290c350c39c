//! What a drive exchanges with whoever sends the scans.

use crate::app::report::export::LiveFrame;
use crate::geometry::Pose3;
use crate::lidar::Scan;
use crate::live::Reason;
use crate::localization::Start;
use crate::recording::Frame;

/// A frame that arrived, and its scan.
pub type ArrivedFrame = (Frame, Scan);

/// What a robot gives besides scans, and what it takes.
pub struct Robot<'a> {
    /// Where the odometry has the sensor at a time [s]; `None` where it is not measured.
    pub odom_from_lidar: Box<dyn Fn(f64) -> Option<Pose3> + 'a>,
    /// A start that was proposed since the last call.
    pub proposed: Box<dyn Fn() -> Option<Start> + 'a>,
    /// Takes a frame that was localized.
    pub localized: Box<dyn FnMut(&LiveFrame) + 'a>,
    /// Takes the reason of the state at a time [s] without a scan.
    pub waiting: Box<dyn FnMut(f64, Reason) + 'a>,
}

impl Default for Robot<'_> {
    /// That of a recording: nothing but scans.
    fn default() -> Self {
        Self {
            odom_from_lidar: Box::new(|_| None),
            proposed: Box::new(|| None),
            localized: Box::new(|_| ()),
            waiting: Box::new(|_, _| ()),
        }
    }
}
