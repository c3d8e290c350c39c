//! Recordings: scans with their times, and the poses that belong to them.
//!
//! [`Recording::open`] recognizes the [`layout`]; [`PoseTrack`] reads poses and matches them to the scans. Poses on disk
//! are poses of a camera or of another body on which the lidar is mounted; [`MapFrame`] converts between
//! them and the lidar poses that everything else uses:
//!
//! ```text
//! map_from_lidar(i) = inv(Tr) · inv(P₀) · Pᵢ · Tr        Tr = cam0_from_lidar
//! ```

// Scans.
#[cfg(feature = "bags")]
pub mod bags;
pub mod frame;
pub mod layout;
pub mod open;
pub mod scan_files;
pub mod scan_list;
pub mod velodyne;
// Poses.
pub mod calibration;
mod oxts;
pub mod poses;
pub mod track;
// Text files and errors.
mod error;
mod table;

#[cfg(feature = "bags")]
pub use bags::Bag;
pub use calibration::Calibration;
pub use error::RecordingError;
pub use frame::{Frame, ScanSource};
pub use open::Recording;
pub use poses::MapFrame;
pub use scan_list::Selection;
pub use track::PoseTrack;
