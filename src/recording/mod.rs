//! Recordings: scans with their times, and the poses that belong to them.
//!
//! [`Recording::open`] recognizes the [`Layout`]; [`PoseTrack`] reads poses and matches them to the scans. Poses on disk
//! are poses of a camera or of another body on which the lidar is mounted; `MapFrame` converts between
//! them and the lidar poses that everything else uses:
//!
//! ```text
//! map_from_lidar(i) = inv(Tr) · inv(P₀) · Pᵢ · Tr        Tr = cam0_from_lidar
//! ```

// Scans.
#[cfg(feature = "bags")]
pub(crate) mod bags;
pub(crate) mod frame;
pub(crate) mod layout;
mod layouts;
pub(crate) mod open;
pub(crate) mod scan_files;
pub(crate) mod scan_list;
pub(crate) mod velodyne;
// Poses and positions.
pub(crate) mod calibration;
mod fixes;
mod found_fixes;
mod oxts;
pub(crate) mod poses;
pub(crate) mod track;
// Inertial measurements.
pub(crate) mod imu;
// Text files and errors.
mod error;
mod table;

#[cfg(feature = "bags")]
pub use bags::{Bag, FramePose, Topic, TopicKind};
pub use calibration::Calibration;
pub use error::RecordingError;
pub use fixes::read as read_fixes;
pub use frame::{Frame, ScanSource};
pub use layout::{Layout, RecordingFiles};
pub use open::{Recording, TimeSource};
pub use poses::{read_times, read_tum, write_kitti, write_times, write_tum};
pub use scan_files::{PointFormat, read as read_scan};
pub use scan_list::Selection;
pub use track::PoseTrack;
pub use velodyne::{read_labels, write_labels, write_scan};

pub(crate) use open::is_topic;
pub(crate) use poses::MapFrame;
