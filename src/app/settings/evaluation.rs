//! Configuration of `evaluate`: errors of a result against the ground truth.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::blocks::{OutputConfig, PoseInputConfig, optional_path, require_path};
use crate::evaluation::Alignment;
use crate::file_path::FilePath;
use crate::recording::{Layout, Selection};
use crate::validation::{InvalidValue, Validate, at_least_one, nested, positive, require};

/// Configuration of `evaluate`: the keys of range-mcl's `evaluation.yml`, then new ones.
///
/// Defaults: the values of range-mcl.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Result of `localize`, `refine` or range-mcl, or a trajectory of any origin, rows of KITTI or TUM.
    #[default("results/localization.npz".into())]
    pub result_file: FilePath,
    /// Calibration of the camera whose poses a trajectory has as rows of KITTI; `None`: they are those of the lidar.
    pub result_calib_file: Option<FilePath>,
    /// The ground truth; without any, the poses in `scan_folder`, else those in the result.
    pub given_poses: PoseInputConfig,
    /// The recording whose poses are the ground truth; `None`: for a topic, that of the localization.
    pub scan_folder: Option<FilePath>,
    /// Layout of the recording; `None`: that of the localization, or as its files show.
    pub layout: Option<Layout>,
    /// Topic of the point clouds in a bag with several, or name of a lidar or scene in a folder with several.
    pub topic: Option<String>,
    /// Alignment with the truth before errors are computed; `None`: none for a result in a map, and that of the
    /// first pose for a trajectory.
    pub alignment: Option<Alignment>,
    /// Folder of the output; `None`: that of a result, and `NAME_evaluation` next to a trajectory `NAME.txt`.
    pub output_folder: Option<FilePath>,
    /// Whether to write the metrics next to the result.
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
    /// The frames of the result that are used.
    pub frames: Selection,
    /// Output; what is written replaces earlier evaluations.
    pub output: OutputConfig,
}

impl Validate for EvaluationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        require_path("result_file", &self.result_file)?;
        nested("given_poses", &self.given_poses)?;
        for (key, value) in [
            ("result_calib_file", &self.result_calib_file),
            ("scan_folder", &self.scan_folder),
            ("output_folder", &self.output_folder),
        ] {
            optional_path(key, value.as_deref())?;
        }
        nested("frames", &self.frames)?;
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
