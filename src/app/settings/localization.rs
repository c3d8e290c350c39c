//! Configuration of `localize`: the pose of the car in a map.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::blocks::{
    GnssInputConfig, InertialConfig, MapInputConfig, MotionSourceConfig, OutputConfig,
    PoseInputConfig, RecordingConfig, require_path,
};
use crate::file_path::FilePath;
use crate::geometry::FARTHEST_M;
use crate::localization::TrackerConfig;
use crate::localization::initialization::StartSpread;
use crate::localization::observation::Likelihood;
use crate::map::MapOptions;
use crate::refinement::{FrameRefinementConfig, RefinerConfig};
use crate::rendering::RenderingMethod;
use crate::validation::{InvalidValue, Validate, nested, require};

/// Configuration of `localize`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct LocalizationConfig {
    /// The recording.
    pub recording: RecordingConfig,
    /// Its true poses, for the report.
    pub given_poses: PoseInputConfig,
    /// The map.
    pub map_input: MapInputConfig,
    /// Output path of the result; all other output is written next to it.
    #[default("results/localization.npz".into())]
    pub result_path: FilePath,
    /// Whether to write the result.
    #[default(true)]
    pub save_result: bool,
    /// Whether the trajectories also have the poses that are not trusted; comments in those of TUM are the states.
    pub all_poses: bool,
    /// Whether to draw a picture per frame and an animation.
    pub visualize: bool,
    /// Whether the start is known: `initial_pose`, else the first true pose. `None`: known if `initial_pose` is
    /// given. `initialization` takes precedence.
    pub pose_tracking: Option<bool>,
    /// Start: x, y in the map [m], heading [deg].
    pub initial_pose: Option<[f64; 3]>,
    /// Its inertial sensor, where it is used: its rates predict rotations in the odometry of the scans, and compensate them.
    pub inertial: InertialConfig,
    /// Positions of a GNSS receiver, of which the first is a start in a map with a place on the Earth where `initial_pose` is
    /// not given: around it in every heading.
    pub gnss: GnssInputConfig,
    /// Initial distribution of the particles: around a known start (tracking), along the mapped road (corridor), or over the
    /// whole map (extent); `None`: it follows from `pose_tracking` and `initial_pose`.
    pub initialization: Option<Initialization>,
    /// Spread of the particles around a known start.
    pub start: StartSpread,
    /// Motion between frames.
    pub motion: MotionSourceConfig,
    /// Motion model for odometry that is not that of the scans.
    pub motion_model: MotionModel,
    /// Sensor, odometry of the scans and particle filter.
    pub tracker: TrackerConfig,
    /// Rendering of the range images that the reference likelihood compares.
    pub rendering: RenderingConfig,
    /// Whether to refine every frame while tracking.
    pub refine: bool,
    /// Parameters of the refinement.
    pub refinement: FrameRefinementConfig,
    /// Output.
    pub output: OutputConfig,
}

/// Rendering of whole range images.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RenderingConfig {
    /// Rendering method.
    pub method: RenderingMethod,
}

/// Initial distribution of the particles.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Initialization {
    /// Around a known pose.
    Tracking,
    /// Along the mapped road.
    Corridor,
    /// Over the whole map.
    Extent,
}

/// Motion model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum MotionModel {
    /// Turn, drive, turn.
    #[default]
    TurnDriveTurn,
    /// Speed and turn rate over a duration.
    Velocity,
}

impl LocalizationConfig {
    /// How the map is prepared, on the default backend.
    pub fn map_options(&self) -> MapOptions {
        MapOptions {
            method: self.rendering.method,
            ..MapOptions::default()
        }
    }

    /// The refinement of every frame, where `refine` is set.
    pub fn refiner(&self) -> RefinerConfig {
        RefinerConfig {
            ground: self.tracker.localizer.ground.clone(),
            observation: self.tracker.localizer.observation.clone(),
            refinement: self.refinement.clone(),
        }
    }

    /// Initial distribution of the particles: `initialization`, else around a known start, else along the
    /// road where `pose_tracking` is false, else anywhere.
    pub fn initialization(&self) -> Initialization {
        let by_start = match (self.pose_tracking, self.initial_pose) {
            (Some(true), _) | (None, Some(_)) => Initialization::Tracking,
            (Some(false), _) => Initialization::Corridor,
            (None, None) => Initialization::Extent,
        };
        self.initialization.unwrap_or(by_start)
    }
}

impl Validate for LocalizationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("recording", &self.recording)?;
        nested("given_poses", &self.given_poses)?;
        nested("map_input", &self.map_input)?;
        nested("inertial", &self.inertial)?;
        nested("gnss", &self.gnss)?;
        require_path("result_path", &self.result_path)?;
        self.motion.validate(&self.given_poses)?;
        self.validate_start()?;
        nested("start", &self.start)?;
        nested("tracker", &self.tracker)?;
        require(
            self.rendering.method != RenderingMethod::Raster
                || self.tracker.localizer.observation.likelihood == Likelihood::Reference,
            "rendering.method",
            "raster",
            "observation.likelihood: robust compares along the measured beams, which are always cast; set it to reference, or rendering.method to auto or cast",
        )?;
        nested("refinement", &self.refinement)
    }
}

impl LocalizationConfig {
    fn validate_start(&self) -> Result<(), InvalidValue> {
        let has_start = self.initial_pose.is_some() || self.given_poses.pose_file.is_some();
        let (key, value) = match self.initialization {
            Some(_) => ("initialization", "tracking"),
            None => ("pose_tracking", "True"),
        };
        require(
            has_start || self.initialization() != Initialization::Tracking,
            key,
            value,
            "a known start needs initial_pose (--start X,Y,HEADING_DEG), or pose_file with the true poses",
        )?;
        let Some([x, y, heading_deg]) = self.initial_pose else {
            return Ok(());
        };
        let is_possible = x.abs().max(y.abs()) <= FARTHEST_M && heading_deg.abs() <= 360.0;
        require(
            is_possible,
            "initial_pose",
            format!("[{x}, {y}, {heading_deg}]"),
            "give x and y in the map in metres, and the heading from -360 to 360 degrees",
        )
    }
}
