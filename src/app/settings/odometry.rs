//! Configuration of `odometry`: poses of a recording from its scans.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::blocks::{
    GnssInputConfig, InertialConfig, OutputConfig, PoseInputConfig, RecordingConfig, require_path,
};
use crate::file_path::FilePath;
use crate::odometry::TrajectoryConfig;
use crate::sensor::MotionCompensation;
use crate::validation::{InvalidValue, Validate, nested, positive};

/// Configuration of `odometry`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct OdometryCommandConfig {
    /// The recording.
    pub recording: RecordingConfig,
    /// Poses to polish; without any, poses are found from the scans alone.
    pub given_poses: PoseInputConfig,
    /// Its inertial sensor, where it is used.
    pub inertial: InertialConfig,
    /// Positions of a GNSS receiver, which poses from the scans follow.
    pub gnss: GnssInputConfig,
    /// Folder of the poses, the report and the picture.
    #[default("results/odometry".into())]
    pub output_folder: FilePath,
    /// Largest distance between successive given poses [m]; a larger one is an error of the poses.
    #[default(50.0)]
    pub max_step_m: f64,
    /// Times of the points for motion compensation; `None` for scans that are compensated already.
    #[default(Some(MotionCompensation::Auto))]
    pub motion_compensation: Option<MotionCompensation>,
    /// Odometry, loops and adjustment.
    pub trajectory: TrajectoryConfig,
    /// Output.
    pub output: OutputConfig,
}

impl Validate for OdometryCommandConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("recording", &self.recording)?;
        nested("given_poses", &self.given_poses)?;
        nested("inertial", &self.inertial)?;
        nested("gnss", &self.gnss)?;
        require_path("output_folder", &self.output_folder)?;
        positive("max_step_m", self.max_step_m)?;
        nested("trajectory", &self.trajectory)
    }
}
