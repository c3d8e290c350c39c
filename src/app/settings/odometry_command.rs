//! Configuration of `odometry`: poses of a recording from its scans.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::check::{optional_path, path};
use super::recording::mounting;
use crate::odometry::TrajectoryConfig;
use crate::sensor::MotionCompensation;
use crate::validation::{InvalidValue, Validate, in_range, positive};

/// Configuration of `odometry`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct OdometryCommandConfig {
    /// The recording: its folder, the folder of its scans, or a bag.
    #[default("data/kitti/velodyne".into())]
    pub scan_folder: PathBuf,
    /// Topic of the point clouds in a bag with several.
    pub topic: Option<String>,
    /// Poses to polish, rows of KITTI or TUM, a folder `oxts`, or a topic of a bag; `None`: poses from the scans alone.
    pub pose_file: Option<PathBuf>,
    /// Calibration of the recording, with its line `Tr`; `None`: the poses in `pose_file` are those of the lidar.
    pub calib_file: Option<PathBuf>,
    /// Pose x, y, z [m], roll, pitch, yaw [deg] of the lidar on the body whose poses are given; `None`: they are
    /// those of the lidar.
    pub body_from_lidar: Option<[f64; 6]>,
    /// Folder of the poses, the report and the picture.
    #[default("results/odometry".into())]
    pub output_folder: PathBuf,
    /// First frame of the recording.
    pub start_idx: usize,
    /// Number of scans from `start_idx` on; -1 for all.
    #[default(-1)]
    pub n_scans: i64,
    /// Step between frames: n uses every n-th frame.
    #[default(1)]
    pub frame_step: usize,
    /// Largest distance between successive given poses [m]; a larger one is an error of the poses.
    #[default(50.0)]
    pub max_step_m: f64,
    /// Times of the points for motion compensation; `None` for scans that are compensated already.
    #[default(Some(MotionCompensation::Auto))]
    pub motion_compensation: Option<MotionCompensation>,
    /// Angle to add to the elevations of all points [deg].
    pub elevation_bias_deg: f64,
    /// Whether to draw the path.
    #[default(true)]
    pub visualize: bool,
    /// Odometry, loops and adjustment.
    pub trajectory: TrajectoryConfig,
    /// Whether to replace existing output.
    pub force: bool,
}

impl Validate for OdometryCommandConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        path("scan_folder", &self.scan_folder)?;
        optional_path("pose_file", self.pose_file.as_deref())?;
        optional_path("calib_file", self.calib_file.as_deref())?;
        mounting(self.calib_file.as_deref(), self.body_from_lidar)?;
        in_range("elevation_bias_deg", self.elevation_bias_deg, -5.0..=5.0)?;
        path("output_folder", &self.output_folder)?;
        self.selection().validate()?;
        positive("max_step_m", self.max_step_m)?;
        crate::validation::nested("trajectory", &self.trajectory)
    }
}
