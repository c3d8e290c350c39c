//! Configuration of `refine`: swarm, Gauss-Newton and smoothing of a trajectory.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::{optional_path, path};
use super::localization::LocalizationConfig;
use super::odometry::OdometrySource;
use super::recording::mounting;
use crate::ground::{FuzzyConfig, GroundConfig, GroundMethod, PcaGround, RansacGround};
use crate::localization::observation::ObservationConfig;
use crate::refinement::{self, RefinerConfig};
use crate::sensor::{MotionCompensation, RangeImageConfig, SensorConfig};
use crate::validation::{InvalidValue, Validate, in_range, require};

/// Configuration of `refine`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefinementConfig {
    /// The recording: its folder, the folder of its scans, or a bag.
    pub scan_folder: PathBuf,
    /// Topic of the point clouds in a bag with several.
    pub topic: Option<String>,
    /// Map of `build-map` or range-mcl.
    pub map_file: PathBuf,
    /// Camera poses of the mapping drive; `None`: the map carries its own frame.
    pub map_pose_file: Option<PathBuf>,
    /// Calibration of the mapping drive; `None`: the map carries its own frame.
    pub map_calib_file: Option<PathBuf>,
    /// True poses of the recording for the report, rows of KITTI or TUM, a folder `oxts`, or a topic of a bag.
    pub pose_file: Option<PathBuf>,
    /// Calibration of the recording, with its line `Tr`; `None`: its poses are those of the lidar.
    pub calib_file: Option<PathBuf>,
    /// Pose x, y, z [m], roll, pitch, yaw [deg] of the lidar on the body whose poses are given; `None`: they are
    /// those of the lidar.
    pub body_from_lidar: Option<[f64; 6]>,
    /// Result of `localize`, to which the refined poses are added, or a trajectory in the frame of the map, rows of TUM
    /// or KITTI.
    pub result_file: PathBuf,
    /// Result to write of a trajectory; `None`: `refined.npz` in a folder that is named after it.
    pub output_file: Option<PathBuf>,
    /// Standard deviations of the poses of a trajectory: position [m] and heading [deg].
    pub uncertainty: [f64; 2],
    /// Whether to draw the final plots.
    pub plot_loc_results: bool,
    /// First frame of the recording.
    pub start_idx: usize,
    /// Number of scans from `start_idx` on; -1 for all.
    pub n_scans: i64,
    /// Step between frames: n uses every n-th frame.
    pub frame_step: usize,
    /// Source of the motion between frames, for smoothing.
    pub odometry: OdometrySource,
    /// Odometry poses in KITTI or TUM format, for `odometry: file`.
    pub odometry_file: Option<PathBuf>,
    /// Size and limits of the range images.
    pub range_image: RangeImageConfig,
    /// Box of the own car in the lidar frame: x_min, x_max, y_min, y_max [m]; `None`: inferred.
    pub own_car_m: Option<[f32; 4]>,
    /// Height of the sensor above the road [m]; `None`: estimated from the scans.
    pub sensor_height_m: Option<f64>,
    /// Method of ground segmentation of the scans.
    pub ground_method: GroundMethod,
    /// Inlier distance of the RANSAC plane [m].
    pub distance_threshold: f32,
    /// Sample size of a RANSAC plane.
    pub ransac_n: usize,
    /// Number of RANSAC planes.
    pub num_iterations: usize,
    /// Parameters of `ground_method: pca`.
    pub pca: PcaGround,
    /// Linguistic sets and rules of `ground_method: fuzzy`.
    pub fuzzy: FuzzyConfig,
    /// Observation model.
    pub observation: ObservationConfig,
    /// Swarm, Gauss-Newton and smoothing.
    pub refinement: refinement::FrameRefinementConfig,
    /// Times of the points for motion compensation; `None` for scans that are compensated already, such as
    /// those of KITTI odometry.
    pub motion_compensation: Option<MotionCompensation>,
    /// Angle to add to the elevations of all points [deg].
    pub elevation_bias_deg: f64,
    /// Seed of all random choices.
    pub seed: u64,
    /// Whether to replace existing refined poses.
    pub force: bool,
}

impl RefinementConfig {
    /// The refinement of the result of a localization: its files, frames, odometry, ground
    /// classifier and observation model.
    pub fn of(localization: LocalizationConfig) -> Self {
        Self {
            range_image: RangeImageConfig {
                max_instance: None,
                render_instanced: None,
                ..localization.range_image
            },
            scan_folder: localization.scan_folder,
            topic: localization.topic,
            body_from_lidar: localization.body_from_lidar,
            map_file: localization.map_file,
            map_pose_file: localization.map_pose_file,
            map_calib_file: localization.map_calib_file,
            pose_file: localization.pose_file,
            calib_file: localization.calib_file,
            result_file: localization.result_path,
            output_file: None,
            uncertainty: [1.0, 10.0],
            plot_loc_results: true,
            start_idx: localization.start_idx,
            n_scans: localization.n_scans,
            frame_step: localization.frame_step,
            odometry: localization.odometry,
            odometry_file: localization.odometry_file,
            own_car_m: localization.own_car_m,
            sensor_height_m: localization.sensor_height_m,
            ground_method: localization.ground_method,
            distance_threshold: localization.distance_threshold,
            ransac_n: localization.ransac_n,
            num_iterations: localization.num_iterations,
            pca: localization.pca,
            fuzzy: localization.fuzzy,
            observation: localization.observation,
            refinement: refinement::FrameRefinementConfig::default(),
            motion_compensation: localization.motion_compensation,
            elevation_bias_deg: localization.elevation_bias_deg,
            seed: localization.seed,
            force: localization.force,
        }
    }

    /// Whether a trajectory is refined, and not a result of `localize`.
    pub fn is_trajectory(&self) -> bool {
        self.result_file
            .extension()
            .is_none_or(|extension| extension != "npz")
    }

    /// The result that is written.
    pub fn output(&self) -> PathBuf {
        if !self.is_trajectory() {
            return self.result_file.clone();
        }
        let beside = || {
            let mut name = self.result_file.file_stem().unwrap_or_default().to_owned();
            name.push("_refined");
            self.result_file.with_file_name(name).join("refined.npz")
        };
        self.output_file.clone().unwrap_or_else(beside)
    }

    /// The ground classifier of the scans and its parameters.
    pub fn ground(&self) -> GroundConfig {
        GroundConfig {
            method: self.ground_method,
            fuzzy: self.fuzzy.clone(),
            pca: self.pca,
            ransac: RansacGround {
                distance_threshold: self.distance_threshold,
                ransac_n: self.ransac_n,
                num_iterations: self.num_iterations,
                seed: self.seed,
            },
        }
    }

    /// What is known about the sensor.
    pub fn known_sensor(&self) -> SensorConfig {
        SensorConfig {
            range_image: self.range_image.clone(),
            own_car_m: self.own_car_m,
            sensor_height_m: self.sensor_height_m,
            motion_compensation: self.motion_compensation,
        }
    }

    /// The refiner.
    pub fn refiner(&self) -> RefinerConfig {
        RefinerConfig {
            ground: self.ground(),
            observation: self.observation.clone(),
            refinement: self.refinement.clone(),
        }
    }
}

impl Default for RefinementConfig {
    /// The refinement of what `localize` finds by default.
    fn default() -> Self {
        Self::of(LocalizationConfig::default())
    }
}

impl Validate for RefinementConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        path("scan_folder", &self.scan_folder)?;
        path("map_file", &self.map_file)?;
        optional_path("map_pose_file", self.map_pose_file.as_deref())?;
        optional_path("map_calib_file", self.map_calib_file.as_deref())?;
        optional_path("pose_file", self.pose_file.as_deref())?;
        optional_path("calib_file", self.calib_file.as_deref())?;
        mounting(self.calib_file.as_deref(), self.body_from_lidar)?;
        in_range("elevation_bias_deg", self.elevation_bias_deg, -5.0..=5.0)?;
        path("result_file", &self.result_file)?;
        optional_path("output_file", self.output_file.as_deref())?;
        let [position_m, heading_deg] = self.uncertainty;
        let is_possible =
            (0.0..=100.0).contains(&position_m) && (0.0..=180.0).contains(&heading_deg);
        require(
            is_possible,
            "uncertainty",
            format!("{:?}", self.uncertainty),
            "give a position within 100 m and a heading within 180 degrees",
        )?;
        self.selection().validate()?;
        (self.odometry).validate(self.odometry_file.as_deref(), self.pose_file.as_deref())?;
        self.known_sensor().validate()?;
        self.range_image.without_batches()?;
        self.refiner().validate()
    }
}
