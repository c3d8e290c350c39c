//! `refine`: a trajectory polished by a particle swarm, then smoothed.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::{own_car, path};
use super::localization::OdometrySource;
use crate::lidar::{LidarModel, RotationDirection};
use crate::localization::observation::ObservationConfig;
use crate::recording::Selection;
use crate::refinement;
use crate::validation::{InvalidValue, Validate, nested, require};

/// What `refine` reads, and how it refines.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefinementConfig {
    /// Folder of the scans, `NNNNNN.bin`.
    pub scan_folder: PathBuf,
    /// The map, as `build-map` or range-mcl wrote it.
    pub map_file: PathBuf,
    /// Camera poses that the map was built with.
    pub map_pose_file: PathBuf,
    /// Calibration that the map was built with.
    pub map_calib_file: PathBuf,
    /// Camera poses of the recording.
    pub pose_file: PathBuf,
    /// Calibration of the recording, with its line `Tr`.
    pub calib_file: PathBuf,
    /// The result of `localize`, to which the refined poses are added.
    pub result_file: PathBuf,
    /// Whether the final plots are drawn.
    pub plot_loc_results: bool,
    /// First frame of the recording.
    pub start_idx: usize,
    /// How many scans of the recording are looked at; -1 for all.
    pub n_scans: i64,
    /// Every how manieth frame is taken.
    pub frame_step: usize,
    /// Where the motion between frames comes from, for smoothing.
    pub odometry: OdometrySource,
    /// Poses of the odometry, in KITTI or TUM format; for `odometry: file`.
    pub odometry_file: Option<PathBuf>,
    /// Size and limits of the range images.
    pub range_image: LidarModel,
    /// The own car in the lidar frame: x_min, x_max, y_min, y_max [m].
    pub own_car_m: [f32; 4],
    /// Which beams are compared, and what a difference means.
    pub observation: ObservationConfig,
    /// Swarm, finishing step and smoothing.
    pub refinement: refinement::RefinementConfig,
    /// The sense in which the sensor spins, where the motion of the car during a scan is to be
    /// compensated; not so for scans that are compensated already, as those of KITTI odometry.
    pub motion_compensation: Option<RotationDirection>,
    /// What random choices follow from.
    pub seed: u64,
    /// Whether existing refined poses are replaced.
    pub force: bool,
}

impl Default for RefinementConfig {
    /// The files that `localize` reads and writes by default.
    fn default() -> Self {
        let localization = super::LocalizationConfig::default();
        Self {
            scan_folder: localization.scan_folder,
            map_file: localization.map_file,
            map_pose_file: localization.map_pose_file,
            map_calib_file: localization.map_calib_file,
            pose_file: localization.pose_file,
            calib_file: localization.calib_file,
            result_file: localization.result_path,
            plot_loc_results: true,
            start_idx: 0,
            n_scans: -1,
            frame_step: 1,
            odometry: OdometrySource::default(),
            odometry_file: None,
            range_image: LidarModel::default(),
            own_car_m: localization.own_car_m,
            observation: localization.observation,
            refinement: refinement::RefinementConfig::default(),
            motion_compensation: None,
            seed: 0,
            force: false,
        }
    }
}

impl RefinementConfig {
    /// The frames that are refined.
    pub fn selection(&self) -> Selection {
        Selection {
            start_idx: self.start_idx,
            n_scans: self.n_scans,
            frame_step: self.frame_step,
        }
    }
}

impl Validate for RefinementConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        path("scan_folder", &self.scan_folder)?;
        path("map_file", &self.map_file)?;
        path("map_pose_file", &self.map_pose_file)?;
        path("map_calib_file", &self.map_calib_file)?;
        path("pose_file", &self.pose_file)?;
        path("calib_file", &self.calib_file)?;
        path("result_file", &self.result_file)?;
        self.selection().validate()?;
        require(
            self.odometry != OdometrySource::File || self.odometry_file.is_some(),
            "odometry",
            "file",
            "name the file in odometry_file, or choose ground_truth or none",
        )?;
        own_car("own_car_m", self.own_car_m)?;
        nested("observation", &self.observation)?;
        nested("refinement", &self.refinement)?;
        nested("range_image", &self.range_image)
    }
}
