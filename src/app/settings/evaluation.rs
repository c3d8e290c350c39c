//! Configuration of `evaluate`: errors of a result against the ground truth.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::check::{optional_path, path};
use super::recording::mounting;
use crate::evaluation::Alignment;
use crate::validation::{InvalidValue, Validate, at_least_one, positive, require};

/// Configuration of `evaluate`: the keys of range-mcl's `evaluation.yml`, then new ones.
///
/// Defaults: the values of range-mcl.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Result of `localize`, `refine` or range-mcl, or a trajectory of any origin, rows of KITTI or TUM.
    #[default("results/localization.npz".into())]
    pub result_file: PathBuf,
    /// Calibration of the camera whose poses a trajectory has as rows of KITTI; `None`: they are those of the lidar.
    pub result_calib_file: Option<PathBuf>,
    /// The ground truth, rows of KITTI or TUM, a folder `oxts`, or a topic of a bag; `None`: the poses in
    /// `scan_folder`, else those in the result.
    pub pose_file: Option<PathBuf>,
    /// Calibration of the recording, with its line `Tr`, for `pose_file`.
    /// `None`: the poses are those of the lidar.
    pub calib_file: Option<PathBuf>,
    /// Pose x, y, z [m], roll, pitch, yaw [deg] of the lidar on the body whose true poses are given; `None`: they
    /// are those of the lidar.
    pub body_from_lidar: Option<[f64; 6]>,
    /// The recording whose poses are the ground truth; `None`: for a topic, that of the localization.
    pub scan_folder: Option<PathBuf>,
    /// Topic of the point clouds in a bag with several.
    pub topic: Option<String>,
    /// Alignment with the truth before errors are computed; `None`: none for a result in a map, and that of the
    /// first pose for a trajectory.
    pub alignment: Option<Alignment>,
    /// Folder of the output; `None`: that of a result, and `NAME_evaluation` beside a trajectory `NAME.txt`.
    pub output_folder: Option<PathBuf>,
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
        for (key, value) in [
            ("result_calib_file", &self.result_calib_file),
            ("calib_file", &self.calib_file),
            ("scan_folder", &self.scan_folder),
            ("output_folder", &self.output_folder),
        ] {
            optional_path(key, value.as_deref())?;
        }
        mounting(self.calib_file.as_deref(), self.body_from_lidar)?;
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
