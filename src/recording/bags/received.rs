//! Messages of topics of ROS 2 as they are received, in CDR with its header.

use super::fields::Fields;
use super::index::{Content, Serialization};
use super::message::{FramePose, Header, read_poses, read_proposal};
use super::point_cloud::read_scan;
use crate::lidar::Scan;

/// A cloud of `sensor_msgs/PointCloud2`.
#[derive(Clone, Debug, PartialEq)]
pub struct ReceivedCloud {
    /// The moment of the scan, the middle of its sweep if its points have times [ns].
    pub moment_ns: u64,
    /// Name of its frame.
    pub frame: String,
    /// The scan.
    pub scan: Scan,
    /// Whether times of the points were left out, because they make no sense.
    pub has_unknown_times: bool,
}

impl ReceivedCloud {
    /// Reads a message; one without a stamp has that of its arrival [ns].
    ///
    /// # Errors
    /// The message is damaged.
    pub fn read(message: &[u8], arrived_ns: u64) -> Result<Self, String> {
        let fields = || Fields::new(message, Serialization::Cdr);
        let frame = Header::read(&mut fields()?)?.frame;
        let mut stamp = fields()?;
        let (seconds, nanoseconds) = (u64::from(stamp.u32()?), u64::from(stamp.u32()?));
        let stamp_ns = match 1_000_000_000 * seconds + nanoseconds {
            0 => arrived_ns,
            stamp_ns => stamp_ns,
        };
        let stamp_s = seconds_of(stamp_ns);
        let read = read_scan(&mut fields()?, Content::PointCloud, stamp_s)?;
        let mut scan = read.scan;
        scan.center_times();
        // Seconds since 1970 have no digits for nanoseconds.
        let after_ns = 1e9 * (scan.time_s.unwrap_or(stamp_s) - stamp_s);
        Ok(Self {
            moment_ns: stamp_ns.saturating_add_signed(after_ns.round() as i64),
            frame,
            scan,
            has_unknown_times: read.has_unknown_times,
        })
    }
}

/// Reads `nav_msgs/Odometry`.
///
/// # Errors
/// The message is damaged, or has no pose.
pub fn read_odometry(message: &[u8]) -> Result<Vec<FramePose>, String> {
    read_poses(message, Serialization::Cdr, Content::Odometry, 0.0)
}

/// Reads `tf2_msgs/TFMessage`.
///
/// # Errors
/// The message is damaged, or has a transform that is none.
pub fn read_transforms(message: &[u8]) -> Result<Vec<FramePose>, String> {
    read_poses(message, Serialization::Cdr, Content::TransformTree, 0.0)
}

/// Reads `geometry_msgs/PoseWithCovarianceStamped`: the pose, and the standard deviations of its position [m] and heading
/// [rad].
///
/// # Errors
/// The message is damaged, or has no pose.
pub fn read_pose_with_deviations(message: &[u8]) -> Result<(FramePose, [f64; 2]), String> {
    read_proposal(&mut Fields::new(message, Serialization::Cdr)?)
}

fn seconds_of(nanoseconds: u64) -> f64 {
    (nanoseconds / 1_000_000_000) as f64 + 1e-9 * (nanoseconds % 1_000_000_000) as f64
}
