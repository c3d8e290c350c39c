//! Result files of a run: `results.npz`, `frames.csv`, `report.json` and `report.md`.

// The `.npz` file.
mod localization_results;
mod npy;
#[cfg(test)]
mod npz_tests;
mod read;
mod write;
// Tables and reports.
mod frames;
mod report;
mod rows;

#[cfg(test)]
pub(crate) mod kitti_07;

pub use frames::write_frames_csv;
pub use localization_results::{LocalizationResults, ParticleLog, ResultsError};
pub use report::{Report, TrajectoryReport};
pub use rows::{MetricRow, Value};
pub use write::write_poses_npy;
