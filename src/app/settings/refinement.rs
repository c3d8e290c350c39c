//! Configuration of `refine`: swarm, Gauss-Newton and smoothing of a trajectory.

use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::blocks::{
    InertialConfig, MapInputConfig, MotionSourceConfig, OutputConfig, PoseInputConfig,
    RecordingConfig, is_result, optional_path, require_path,
};
use super::localization::LocalizationConfig;
use crate::file_path::FilePath;
use crate::refinement::RefinerConfig;
use crate::sensor::SensorConfig;
use crate::validation::{InvalidValue, Validate, nested, require};

/// Configuration of `refine`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct RefinementConfig {
    /// The recording.
    pub recording: RecordingConfig,
    /// Its true poses, for the report.
    pub given_poses: PoseInputConfig,
    /// The map.
    pub map_input: MapInputConfig,
    /// Result of `localize`, to which the refined poses are added, or a trajectory in the frame of the map, rows of TUM
    /// or KITTI.
    #[default("results/localization.npz".into())]
    pub result_file: FilePath,
    /// Result to write of a trajectory; `None`: `refined.npz` in a folder that is named after it.
    pub output_file: Option<FilePath>,
    /// Whether the trajectories also have the poses that are not trusted; comments in those of TUM are the states.
    pub all_poses: bool,
    /// Standard deviations of the poses of a trajectory: position [m] and heading [deg].
    #[default([1.0, 10.0])]
    pub uncertainty: [f64; 2],
    /// Its inertial sensor, where it is used: its rates compensate the scans.
    pub inertial: InertialConfig,
    /// Motion between frames, for smoothing.
    pub motion: MotionSourceConfig,
    /// What is known about the sensor; the rest is inferred from the scans.
    pub sensor: SensorConfig,
    /// Observation model, swarm, Gauss-Newton and smoothing.
    pub refiner: RefinerConfig,
    /// Seed of all random choices.
    pub seed: u64,
    /// Output.
    pub output: OutputConfig,
}

impl RefinementConfig {
    /// The refinement of the result of a localization: its files, frames, odometry, ground
    /// classifier and observation model.
    pub fn of(localization: LocalizationConfig) -> Self {
        let tracker = localization.tracker;
        Self {
            recording: localization.recording,
            given_poses: localization.given_poses,
            map_input: localization.map_input,
            result_file: localization.result_path,
            all_poses: localization.all_poses,
            inertial: localization.inertial,
            motion: localization.motion,
            sensor: tracker.sensor,
            refiner: RefinerConfig {
                ground: tracker.localizer.ground,
                observation: tracker.localizer.observation,
                ..RefinerConfig::default()
            },
            seed: tracker.seed,
            output: OutputConfig {
                plots: true,
                ..localization.output
            },
            ..Self::default()
        }
    }

    /// Whether a trajectory is refined, and not a result of `localize`.
    pub fn is_trajectory(&self) -> bool {
        !is_result(&self.result_file)
    }

    /// The result that is written.
    pub fn output(&self) -> PathBuf {
        if !self.is_trajectory() {
            return self.result_file.to_path_buf();
        }
        let next_to_it = || {
            let mut name = self.result_file.file_stem().unwrap_or_default().to_owned();
            name.push("_refined");
            self.result_file.with_file_name(name).join("refined.npz")
        };
        let named = self.output_file.as_deref().map(Path::to_owned);
        named.unwrap_or_else(next_to_it)
    }
}

impl Validate for RefinementConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("recording", &self.recording)?;
        nested("given_poses", &self.given_poses)?;
        nested("map_input", &self.map_input)?;
        nested("inertial", &self.inertial)?;
        require_path("result_file", &self.result_file)?;
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
        self.motion.validate(&self.given_poses)?;
        nested("sensor", &self.sensor)?;
        nested("refiner", &self.refiner)
    }
}
