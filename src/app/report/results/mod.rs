//! Result files of a run: `localization.npz`, `frames.csv`, `report.json` and `report.md`.

// The results of a run and their `.npz` file.
mod columns;
mod localization_results;
mod npz;
mod npz_writer;
mod results_file;
#[cfg(test)]
mod results_file_tests;
mod row_log;
mod trajectory_file;
mod trusted;
// Tables and reports.
mod frames;
mod live_summary;
mod refinement_summary;
mod report;
mod rows;
mod run_summary;

#[cfg(test)]
pub(crate) mod kitti_07_tests;

pub use columns::{Column, unknown_pose};
pub use frames::{FrameTable, write_frames_csv};
pub use live_summary::{LatencySummary, LiveSummary};
pub use localization_results::{LocalizationResults, ParticleLog, ScanOutline};
pub use refinement_summary::RefinementSummary;
pub use report::{Report, TrajectoryReport};
pub use results_file::{ResultWriter, write_poses_npy};
pub use row_log::RowLog;
pub use rows::{MetricRow, Value, length};
pub use run_summary::RunSummary;
pub use trajectory_file::write_trajectory_npz;
pub use trusted::{stretches, with_gaps};
