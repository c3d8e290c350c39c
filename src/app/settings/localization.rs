//! Configuration of `localize`: the pose of the car in a map.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::check::{optional_path, path};
use super::odometry::OdometrySource;
use super::recording::mounting;
use crate::geometry::FARTHEST_M;
use crate::ground::{FuzzyConfig, GroundConfig, GroundMethod, PcaGround, RansacGround};
use crate::localization::LocalizerConfig;
use crate::localization::convergence::ConvergenceConfig;
use crate::localization::initialization::StartSpread;
use crate::localization::motion::{OdometryNoise, VelocityNoise};
use crate::localization::observation::{Likelihood, ObservationConfig};
use crate::localization::places::PlacesConfig;
use crate::localization::proposal::ProposalConfig;
use crate::localization::resampling::{KldConfig, ResamplingConfig};
use crate::localization::tempering::TemperingConfig;
use crate::localization::tracking_loss::TrackingLossConfig;
use crate::map::{MapOptions, PanoramaConfig};
use crate::refinement::{FrameRefinementConfig, RefinerConfig};
use crate::rendering::RenderingMethod;
use crate::sensor::{MotionCompensation, RangeImageConfig, SensorConfig};
use crate::validation::{InvalidValue, Validate, in_range, nested, not_negative, require};

/// Configuration of `localize`: the keys of range-mcl's `localization.yml`, then new ones.
///
/// Defaults: the values of range-mcl where it has the key.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct LocalizationConfig {
    /// The recording: its folder, the folder of its scans, or a bag.
    #[default("data/kitti/velodyne".into())]
    pub scan_folder: PathBuf,
    /// Topic of the point clouds in a bag with several.
    pub topic: Option<String>,
    /// Map of `build-map` or range-mcl.
    #[default("results/map.ply".into())]
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
    /// Output path of the result; all other output is written beside it.
    #[default("results/localization.npz".into())]
    pub result_path: PathBuf,
    /// Whether to draw the final plots.
    #[default(true)]
    pub plot_loc_results: bool,
    /// Whether the start is known: `initial_pose`, else the first true pose. `None`: it is if there is an
    /// `initial_pose`. `initialization` takes precedence.
    pub pose_tracking: Option<bool>,
    /// First frame of the recording.
    pub start_idx: usize,
    /// Cell edge of the grid for initialization [m].
    #[default(1.0)]
    pub grid_res: f64,
    /// Number of particles at the start.
    #[serde(rename = "numParticles")]
    #[default(LocalizerConfig::default().num_particles)]
    pub num_particles: usize,
    /// Number of occupied tiles below which the filter has converged.
    #[default(LocalizerConfig::default().convergence.converge_thres)]
    pub converge_thres: usize,
    /// Number of particles after convergence.
    #[default(LocalizerConfig::default().num_reduced)]
    pub num_reduced: usize,
    /// Motion after which the weights are updated [m].
    #[default(LocalizerConfig::default().move_thres_m)]
    pub move_thres: f64,
    /// Standard deviation of the initial headings around the best heading of a cell [deg].
    #[default(2.0)]
    pub yaw_sigma: f64,
    /// Whether to draw a picture per frame and an animation.
    pub visualize: bool,
    /// Whether to write the result.
    #[default(true)]
    pub save_result: bool,
    /// Size and limits of the range images, and their rendering.
    pub range_image: RangeImageConfig,
    /// Rendering of the range images that the reference likelihood compares.
    pub rendering: RenderingConfig,

    /// Number of scans from `start_idx` on; -1 for all.
    #[default(-1)]
    pub n_scans: i64,
    /// Step between frames: n uses every n-th frame.
    #[default(1)]
    pub frame_step: usize,
    /// Start: x, y in the map [m], heading [deg].
    pub initial_pose: Option<[f64; 3]>,
    /// Initial distribution of the particles; `None`: it follows from `pose_tracking` and `initial_pose`.
    pub initialization: Option<Initialization>,
    /// Source of the motion between frames.
    pub odometry: OdometrySource,
    /// Odometry poses in KITTI or TUM format, for `odometry: file`.
    pub odometry_file: Option<PathBuf>,
    /// Motion model.
    pub motion_model: MotionModel,
    /// Box of the own car in the lidar frame: x_min, x_max, y_min, y_max [m]; `None`: inferred.
    pub own_car_m: Option<[f32; 4]>,
    /// Height of the sensor above the road [m]; `None`: estimated from the scans.
    pub sensor_height_m: Option<f64>,
    /// Method of ground segmentation of the scans.
    pub ground_method: GroundMethod,
    /// Inlier distance of the RANSAC plane [m].
    #[default(RansacGround::default().distance_threshold)]
    pub distance_threshold: f32,
    /// Sample size of a RANSAC plane.
    #[default(RansacGround::default().ransac_n)]
    pub ransac_n: usize,
    /// Number of RANSAC planes.
    #[default(RansacGround::default().num_iterations)]
    pub num_iterations: usize,
    /// Parameters of `ground_method: pca`.
    pub pca: PcaGround,
    /// Linguistic sets and rules of `ground_method: fuzzy`.
    pub fuzzy: FuzzyConfig,
    /// Turn after which the weights are updated [rad].
    #[default(LocalizerConfig::default().turn_thres_rad)]
    pub turn_thres_rad: f64,
    /// Spread below which the filter has converged.
    pub convergence: ConvergenceConfig,
    /// Spread of the particles around a known start.
    pub start: StartSpread,
    /// Noise of the turn-drive-turn model, per increment.
    pub odometry_noise: OdometryNoise,
    /// Noise of the velocity model.
    pub velocity_noise: VelocityNoise,
    /// Noise of constant velocity, without odometry, per 0.1 s.
    #[default(LocalizerConfig::default().constant_velocity)]
    pub constant_velocity_noise: OdometryNoise,
    /// The same before the velocity is known, per 0.1 s.
    #[default(LocalizerConfig::default().unknown_velocity)]
    pub unknown_velocity_noise: OdometryNoise,
    /// Observation model.
    pub observation: ObservationConfig,
    /// Tempering of the likelihood within a frame.
    pub tempering: TemperingConfig,
    /// Search among several places.
    pub places: PlacesConfig,
    /// Proposal distribution while tracking.
    pub proposal: ProposalConfig,
    /// Resampling.
    pub resampling: ResamplingConfig,
    /// Adaptive number of particles.
    pub kld: KldConfig,
    /// Detection of tracking loss.
    pub vigilance: TrackingLossConfig,
    /// Search for the start with panoramas.
    pub panorama: PanoramaConfig,
    /// Times of the points for motion compensation; `None` for scans that are compensated already, such as
    /// those of KITTI odometry.
    #[default(Some(MotionCompensation::Auto))]
    pub motion_compensation: Option<MotionCompensation>,
    /// Angle to add to the elevations of all points [deg].
    pub elevation_bias_deg: f64,
    /// Whether to refine every frame while tracking.
    pub refine: bool,
    /// Parameters of the refinement.
    pub refinement: FrameRefinementConfig,
    /// Seed of all random choices.
    pub seed: u64,
    /// Whether to replace an existing result.
    pub force: bool,
}

/// Rendering of whole range images.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RenderingConfig {
    /// Method.
    pub method: RenderingMethod,
}

/// Initial distribution of the particles.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MotionModel {
    /// Turn, drive, turn.
    #[default]
    TurnDriveTurn,
    /// Speed and turn rate over a duration.
    Velocity,
}

impl LocalizationConfig {
    /// Configuration of the filter.
    pub fn localizer(&self) -> LocalizerConfig {
        LocalizerConfig {
            num_particles: self.num_particles,
            num_reduced: self.num_reduced,
            move_thres_m: self.move_thres,
            turn_thres_rad: self.turn_thres_rad,
            motion: self.odometry_noise.clone(),
            velocity: self.velocity_noise.clone(),
            constant_velocity: self.constant_velocity_noise.clone(),
            unknown_velocity: self.unknown_velocity_noise.clone(),
            observation: self.observation.clone(),
            tempering: self.tempering.clone(),
            places: self.places.clone(),
            proposal: self.proposal.clone(),
            resampling: self.resampling.clone(),
            kld: self.kld.clone(),
            convergence: ConvergenceConfig {
                converge_thres: self.converge_thres,
                ..self.convergence.clone()
            },
            tracking_loss: self.vigilance.clone(),
            ground: self.ground(),
            panorama: self.panorama_config(),
        }
    }

    /// How the map is prepared, on the default backend.
    pub fn map_options(&self) -> MapOptions {
        MapOptions {
            method: self.rendering.method,
            max_poses: Some(self.range_image.batch_size()),
            ..MapOptions::default()
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

    /// The refinement of every frame, where `refine` is set.
    pub fn refiner(&self) -> RefinerConfig {
        RefinerConfig {
            ground: self.ground(),
            observation: self.observation.clone(),
            refinement: self.refinement.clone(),
        }
    }

    /// Configuration of the search for the start, with `grid_res` and `yaw_sigma`.
    fn panorama_config(&self) -> PanoramaConfig {
        PanoramaConfig {
            cell_m: self.grid_res,
            yaw_sigma_rad: self.yaw_sigma.to_radians(),
            ..self.panorama.clone()
        }
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
        path("scan_folder", &self.scan_folder)?;
        path("map_file", &self.map_file)?;
        optional_path("map_pose_file", self.map_pose_file.as_deref())?;
        optional_path("map_calib_file", self.map_calib_file.as_deref())?;
        optional_path("pose_file", self.pose_file.as_deref())?;
        optional_path("calib_file", self.calib_file.as_deref())?;
        mounting(self.calib_file.as_deref(), self.body_from_lidar)?;
        in_range("elevation_bias_deg", self.elevation_bias_deg, -5.0..=5.0)?;
        path("result_path", &self.result_path)?;
        self.selection().validate()?;
        (self.odometry).validate(self.odometry_file.as_deref(), self.pose_file.as_deref())?;
        self.validate_start()?;
        in_range("grid_res", self.grid_res, PanoramaConfig::CELLS_M)?;
        not_negative("yaw_sigma", self.yaw_sigma)?;
        nested("start", &self.start)?;
        self.known_sensor().validate()?;
        self.localizer().validate()?;
        require(
            self.rendering.method != RenderingMethod::Raster
                || self.observation.likelihood == Likelihood::Reference,
            "rendering.method",
            "raster",
            "observation.likelihood: robust compares along the measured beams, which are always cast; set it to reference, or rendering.method to auto or cast",
        )?;
        nested("refinement", &self.refinement)
    }
}

impl LocalizationConfig {
    fn validate_start(&self) -> Result<(), InvalidValue> {
        let has_start = self.initial_pose.is_some() || self.pose_file.is_some();
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
