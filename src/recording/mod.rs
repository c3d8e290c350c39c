//! Recordings in the layout of the KITTI odometry benchmark.
//!
//! Poses on disk are camera poses; [`MapFrame`] converts between them and the lidar poses that
//! everything else uses:
//!
//! ```text
//! map_from_lidar(i) = inv(Tr) · inv(P₀) · Pᵢ · Tr        Tr = cam0_from_lidar
//! ```

#[cfg(feature = "bags")]
pub mod bags;
pub mod calibration;
mod error;
pub mod poses;
pub mod scan_files;
pub mod sequence;
mod table;
pub mod velodyne;

#[cfg(feature = "bags")]
pub use bags::Bag;
pub use calibration::Calibration;
pub use error::RecordingError;
pub use poses::MapFrame;
pub use sequence::{Frame, Selection, Sequence};
