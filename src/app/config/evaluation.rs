//! Configuration of `evaluate`: errors of a result against the ground truth.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::check::{optional_path, path};
use crate::validation::{InvalidValue, Validate, at_least_one, positive, require};

/// Configuration of `evaluate`: the keys of range-mcl's `evaluation.yml`, then new ones.
///
/// Defaults: the values of range-mcl.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Result of `localize`, `refine` or range-mcl.
    #[default("results/localization.npz".into())]
    pub result_file: PathBuf,
    /// Poses of the recording, rows of KITTI or TUM, the ground truth; `None`: that in the result.
    pub pose_file: Option<PathBuf>,
    /// Calibration of the recording, with its line `Tr`, for `pose_file`.
    /// `None`: the poses are those of the lidar.
    pub calib_file: Option<PathBuf>,
    /// Whether to draw the trajectory.
    #[default(true)]
    pub plot_loc_traj: bool,
    /// Whether to write the metrics beside the result.
    #[default(true)]
    pub save_evaluation_results: bool,
    /// Metres per unit of the result's positions.
    #[default(1.0)]
    pub grid_resolution: f64,
    /// Position error above which a checked frame is a failure [m].
    #[default(5.0)]
    pub converge_thres: f64,
    /// Fraction of the particles, by descending weight, that an estimate is computed from, unitless.
    #[default(0.8)]
    pub particle_select_ratio: f64,
    /// Number of frames before the first check of convergence, and between checks.
    #[default(100)]
    pub convergence_interval: usize,

    /// First frame of the result.
    pub start_idx: usize,
    /// Number of frames from `start_idx` on; -1 for all.
    #[default(-1)]
    pub n_scans: i64,
    /// Step between frames: n uses every n-th frame.
    #[default(1)]
    pub frame_step: usize,
}

impl Validate for EvaluationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        path("result_file", &self.result_file)?;
        optional_path("pose_file", self.pose_file.as_deref())?;
        optional_path("calib_file", self.calib_file.as_deref())?;
        self.selection().validate()?;
        positive("grid_resolution", self.grid_resolution)?;
        positive("converge_thres", self.converge_thres)?;
        require(
            self.particle_select_ratio > 0.0 && self.particle_select_ratio <= 1.0,
            "particle_select_ratio",
            self.particle_select_ratio,
            "it must be greater than 0 and at most 1",
        )?;
        at_least_one("convergence_interval", self.convergence_interval)
    }
}
