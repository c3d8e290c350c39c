//! `evaluate`: how far a result is from the truth.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::path;
use crate::recording::Selection;
use crate::validation::{InvalidValue, Validate, at_least_one, positive, require};

/// The keys of range-mcl's `evaluation.yml`, and below them new ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationConfig {
    /// The result of `localize`, of `refine` or of range-mcl.
    pub result_file: PathBuf,
    /// Camera poses of the recording, for results that hold no ground truth, as those of range-mcl.
    pub pose_file: PathBuf,
    /// Calibration of the recording, with its line `Tr`, for the same results.
    pub calib_file: PathBuf,
    /// Whether the trajectory is drawn.
    pub plot_loc_traj: bool,
    /// Whether the measures are written beside the result.
    pub save_evaluation_results: bool,
    /// Metres per unit of the result's positions.
    pub grid_resolution: f64,
    /// A checked frame farther from the truth than this is a failure [m].
    pub converge_thres: f64,
    /// The share of particles, the heaviest, that an estimate is made of.
    pub particle_select_ratio: f64,
    /// Frames until convergence is asked for, and between checks from there on.
    pub convergence_interval: usize,

    /// First frame of the result that counts.
    pub start_idx: usize,
    /// How many frames of the result are looked at; -1 for all.
    pub n_scans: i64,
    /// Every how manieth frame is taken.
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
    /// The frames that are measured.
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
