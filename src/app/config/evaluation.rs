//! Configuration of `evaluate`: errors of a result against the ground truth.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::path;
use crate::recording::Selection;
use crate::validation::{InvalidValue, Validate, at_least_one, positive, require};

/// Configuration of `evaluate`: the keys of range-mcl's `evaluation.yml`, then new ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Result of `localize`, `refine` or range-mcl.
    pub result_file: PathBuf,
    /// Camera poses of the recording, for results without ground truth, such as those of range-mcl.
    pub pose_file: PathBuf,
    /// Calibration of the recording, with its line `Tr`, for the same results.
    pub calib_file: PathBuf,
    /// Whether to draw the trajectory.
    pub plot_loc_traj: bool,
    /// Whether to write the metrics beside the result.
    pub save_evaluation_results: bool,
    /// Metres per unit of the result's positions.
    pub grid_resolution: f64,
    /// Position error above which a checked frame is a failure [m].
    pub converge_thres: f64,
    /// Fraction of the particles, by descending weight, that an estimate is computed from, unitless.
    pub particle_select_ratio: f64,
    /// Number of frames before the first check of convergence, and between checks.
    pub convergence_interval: usize,

    /// First frame of the result.
    pub start_idx: usize,
    /// Number of frames from `start_idx` on; -1 for all.
    pub n_scans: i64,
    /// Step between frames: n uses every n-th frame.
    pub frame_step: usize,
}

impl Default for EvaluationConfig {
    /// The values of range-mcl.
    fn default() -> Self {
        Self {
            result_file: "results/localization.npz".into(),
            pose_file: "data/kitti/poses.txt".into(),
            calib_file: "data/kitti/calib.txt".into(),
            plot_loc_traj: true,
            save_evaluation_results: true,
            grid_resolution: 1.0,
            converge_thres: 5.0,
            particle_select_ratio: 0.8,
            convergence_interval: 100,
            start_idx: 0,
            n_scans: -1,
            frame_step: 1,
        }
    }
}

impl EvaluationConfig {
    /// Selection of the frames.
    pub fn selection(&self) -> Selection {
        Selection {
            start_idx: self.start_idx,
            n_scans: self.n_scans,
            frame_step: self.frame_step,
        }
    }
}

impl Validate for EvaluationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        path("result_file", &self.result_file)?;
        path("pose_file", &self.pose_file)?;
        path("calib_file", &self.calib_file)?;
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
