//! How well the car's pose is known: what a run left on disk, and how far it is from the truth.
//!
//! [`results`] is the file that `localize` and `refine` write and everything else reads;
//! [`range_mcl`] judges it by the rules of the parent; [`metrics`] by those of the literature;
//! [`report`] writes the judgement down.

// What a run left on disk.
mod atomic;
#[cfg(test)]
pub(crate) mod kitti_07;
mod npy;
mod npz;
pub mod results;
// How far it is from the truth.
pub mod convergence;
pub mod metrics;
pub mod planar;
pub mod pose_error;
pub mod range_mcl;
pub mod smoothness;
pub mod statistics;
// What is told of it, and of many beside each other.
pub mod frames;
pub mod report;
pub mod rows;

pub use atomic::write_atomically;
pub use convergence::{Convergence, StrictSuccess};
pub use frames::write_frames_csv;
pub use metrics::{Judged, MetricsConfig, MetricsError, TrajectoryMetrics};
pub use npy::NpyError;
pub use npz::write_poses_npy;
pub use planar::{PlanarError, distances_m, planar_errors};
pub use pose_error::{Pairs, absolute_pose_error, kitti_segment_errors, relative_pose_error};
pub use range_mcl::{NoWeight, RangeMclRules, RangeMclVerdict};
pub use report::{Report, TrajectoryReport};
pub use results::{LocalizationResults, ParticleLog, ParticleRow, ResultsError};
pub use rows::{MetricRow, Value};
pub use statistics::Summary;
