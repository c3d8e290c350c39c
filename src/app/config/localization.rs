//! `localize`: where the car is in a map.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::{own_car, path};
use crate::lidar::{LidarModel, RotationDirection};
use crate::localization::LocalizerConfig;
use crate::localization::convergence::ConvergenceConfig;
use crate::localization::initialization::StartSpread;
use crate::localization::motion::{OdometryNoise, VelocityNoise};
use crate::localization::observation::ObservationConfig;
use crate::localization::panorama::PanoramaConfig;
use crate::localization::proposal::ProposalConfig;
use crate::localization::resampling::{KldConfig, ResamplingConfig};
use crate::localization::settings::TemperingConfig;
use crate::localization::vigilance::VigilanceConfig;
use crate::map::scan_cloud::ScanSettings;
use crate::recording::Selection;
use crate::refinement::RefinementConfig;
use crate::validation::{
    InvalidValue, Validate, at_least_one, nested, not_negative, positive, require,
};

/// The keys of range-mcl's `localization.yml`, and below them new ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LocalizationConfig {
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
    /// Where the result is written; everything else of the run lies beside it.
    pub result_path: PathBuf,
    /// Whether the final plots are drawn.
    pub plot_loc_results: bool,
    /// Whether the start is known; `initialization` says it more precisely.
    pub pose_tracking: bool,
    /// First frame of the recording.
    pub start_idx: usize,
    /// Cells of the grid for initialization [m].
    pub grid_res: f64,
    /// Particles at the start.
    #[serde(rename = "numParticles")]
    pub num_particles: usize,
    /// Fewer occupied tiles than this are convergence.
    pub converge_thres: usize,
    /// Particles after convergence.
    pub num_reduced: usize,
    /// Weights change only after this much motion [m].
    pub move_thres: f64,
    /// Spread of headings around the best of a cell when particles are seeded [deg].
    pub yaw_sigma: f64,
    /// Whether a picture per frame and an animation are drawn.
    pub visualize: bool,
    /// Whether the result is written.
    pub save_result: bool,
    /// Size and limits of the range images, and how they are rendered.
    pub range_image: RenderedRangeImage,

    /// How many scans of the recording are looked at; -1 for all.
    pub n_scans: i64,
    /// Every how manieth frame is taken.
    pub frame_step: usize,
    /// Where particles start; follows from `pose_tracking` where it is not given.
    pub initialization: Option<Initialization>,
    /// Where the motion between frames comes from.
    pub odometry: OdometrySource,
    /// Poses of the odometry, in KITTI or TUM format; for `odometry: file`.
    pub odometry_file: Option<PathBuf>,
    /// How particles follow the odometry.
    pub motion_model: MotionModel,
    /// The own car in the lidar frame: x_min, x_max, y_min, y_max [m].
    pub own_car_m: [f32; 4],
    /// How particles are spread around a known start.
    pub start: StartSpread,
    /// Noise of turn, drive, turn, per increment.
    pub odometry_noise: OdometryNoise,
    /// Noise of velocity commands.
    pub velocity_noise: VelocityNoise,
    /// Noise of going on as before, without odometry, per frame.
    pub constant_velocity_noise: OdometryNoise,
    /// Noise of standing, without odometry and before the velocity is known, per frame.
    pub unknown_velocity_noise: OdometryNoise,
    /// Which beams are compared, and what a difference means.
    pub observation: ObservationConfig,
    /// How the likelihood is sharpened within a frame.
    pub tempering: TemperingConfig,
    /// Where particles are drawn while tracking.
    pub proposal: ProposalConfig,
    /// When few particles carry the weight.
    pub resampling: ResamplingConfig,
    /// How many particles a wide belief needs.
    pub kld: KldConfig,
    /// When the map disagrees.
    pub vigilance: VigilanceConfig,
    /// The search for a start.
    pub panorama: PanoramaConfig,
    /// The sense in which the sensor spins, where the motion of the car during a scan is to be
    /// compensated; not so for scans that are compensated already, as those of KITTI odometry.
    pub motion_compensation: Option<RotationDirection>,
    /// Whether every frame is refined as it comes, while tracking.
    pub refine: bool,
    /// How.
    pub refinement: RefinementConfig,
    /// What random choices follow from.
    pub seed: u64,
    /// Whether an existing result is replaced.
    pub force: bool,
}

/// The range images of `localize`: the sensor, and how many of them are rendered at once.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RenderedRangeImage {
    /// Rows.
    pub height: usize,
    /// Columns over 360 degrees.
    pub width: usize,
    /// Upper edge of the vertical field of view over the horizon [deg].
    pub fov_up: f32,
    /// Lower edge of the vertical field of view; below the horizon whatever its sign [deg].
    pub fov_down: f32,
    /// Returns at this range or farther are dropped [m].
    pub max_range: f32,
    /// Returns at this range or nearer are dropped [m].
    pub min_range: f32,
    /// Whether particles are rendered together or one by one.
    pub render_instanced: bool,
    /// How many particles are rendered together.
    pub max_instance: usize,
}

/// Where particles start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Initialization {
    /// Around a known pose.
    Tracking,
    /// Along the road that the map was built from.
    Corridor,
    /// Anywhere in the map.
    Extent,
}

/// Where the motion between frames comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OdometrySource {
    /// From the poses of the recording, with noise, as range-mcl does for demonstration.
    #[default]
    GroundTruth,
    /// From `odometry_file`.
    File,
    /// Nowhere: particles only spread.
    None,
}

/// How particles follow the odometry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MotionModel {
    /// Turn, drive, turn.
    #[default]
    TurnDriveTurn,
    /// Speed and turn rate over a duration.
    Velocity,
}

impl Default for LocalizationConfig {
    /// The values of range-mcl.
    fn default() -> Self {
        Self {
            scan_folder: "data/kitti/velodyne".into(),
            map_file: "results/map.ply".into(),
            map_pose_file: "data/kitti/poses.txt".into(),
            map_calib_file: "data/kitti/calib.txt".into(),
            pose_file: "data/kitti/poses.txt".into(),
            calib_file: "data/kitti/calib.txt".into(),
            result_path: "results/localization.npz".into(),
            plot_loc_results: true,
            pose_tracking: true,
            start_idx: 0,
            grid_res: 1.0,
            num_particles: 10_000,
            converge_thres: 2,
            num_reduced: 100,
            move_thres: 0.2,
            yaw_sigma: 2.0,
            visualize: false,
            save_result: true,
            range_image: RenderedRangeImage::default(),
            n_scans: -1,
            frame_step: 1,
            initialization: None,
            odometry: OdometrySource::default(),
            odometry_file: None,
            motion_model: MotionModel::default(),
            own_car_m: ScanSettings::default().own_car_m,
            start: StartSpread::default(),
            odometry_noise: OdometryNoise::default(),
            velocity_noise: VelocityNoise::default(),
            constant_velocity_noise: LocalizerConfig::default().constant_velocity,
            unknown_velocity_noise: LocalizerConfig::default().unknown_velocity,
            observation: ObservationConfig::default(),
            tempering: TemperingConfig::default(),
            proposal: ProposalConfig::default(),
            resampling: ResamplingConfig::default(),
            kld: KldConfig::default(),
            vigilance: VigilanceConfig::default(),
            panorama: PanoramaConfig::default(),
            motion_compensation: None,
            refine: false,
            refinement: RefinementConfig::default(),
            seed: 0,
            force: false,
        }
    }
}

impl Default for RenderedRangeImage {
    /// The sensor of [`LidarModel`]; batches large enough for every renderer.
    fn default() -> Self {
        let LidarModel {
            height,
            width,
            fov_up,
            fov_down,
            max_range,
            min_range,
        } = LidarModel::default();
        Self {
            height,
            width,
            fov_up,
            fov_down,
            max_range,
            min_range,
            render_instanced: true,
            max_instance: 1024,
        }
    }
}

impl LocalizationConfig {
    /// The frames that are localized.
    pub fn selection(&self) -> Selection {
        Selection {
            start_idx: self.start_idx,
            n_scans: self.n_scans,
            frame_step: self.frame_step,
        }
    }

    /// The filter.
    pub fn localizer(&self) -> LocalizerConfig {
        LocalizerConfig {
            num_particles: self.num_particles,
            num_reduced: self.num_reduced,
            move_thres_m: self.move_thres,
            motion: self.odometry_noise.clone(),
            velocity: self.velocity_noise.clone(),
            constant_velocity: self.constant_velocity_noise.clone(),
            unknown_velocity: self.unknown_velocity_noise.clone(),
            observation: self.observation.clone(),
            tempering: self.tempering.clone(),
            proposal: self.proposal.clone(),
            resampling: self.resampling.clone(),
            kld: self.kld.clone(),
            convergence: ConvergenceConfig {
                converge_thres: self.converge_thres,
                ..ConvergenceConfig::default()
            },
            vigilance: self.vigilance.clone(),
            ..LocalizerConfig::default()
        }
    }

    /// The search for a start, on cells of `grid_res`, with headings spread by `yaw_sigma`.
    pub fn panorama_config(&self) -> PanoramaConfig {
        PanoramaConfig {
            cell_m: self.grid_res,
            yaw_sigma_rad: self.yaw_sigma.to_radians(),
            ..self.panorama.clone()
        }
    }

    /// Where particles start: as told, or around the start for pose tracking, or else along
    /// the road.
    pub fn initialization(&self) -> Initialization {
        self.initialization.unwrap_or(if self.pose_tracking {
            Initialization::Tracking
        } else {
            Initialization::Corridor
        })
    }
}

impl RenderedRangeImage {
    /// The sensor alone.
    pub fn model(&self) -> LidarModel {
        LidarModel {
            height: self.height,
            width: self.width,
            fov_up: self.fov_up,
            fov_down: self.fov_down,
            max_range: self.max_range,
            min_range: self.min_range,
        }
    }

    /// How many particles are rendered together.
    pub fn batch_size(&self) -> usize {
        if self.render_instanced {
            self.max_instance
        } else {
            1
        }
    }
}

impl Validate for LocalizationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        path("scan_folder", &self.scan_folder)?;
        path("map_file", &self.map_file)?;
        path("map_pose_file", &self.map_pose_file)?;
        path("map_calib_file", &self.map_calib_file)?;
        path("pose_file", &self.pose_file)?;
        path("calib_file", &self.calib_file)?;
        path("result_path", &self.result_path)?;
        self.selection().validate()?;
        positive("grid_res", self.grid_res)?;
        at_least_one("numParticles", self.num_particles)?;
        at_least_one("converge_thres", self.converge_thres)?;
        at_least_one("num_reduced", self.num_reduced)?;
        not_negative("move_thres", self.move_thres)?;
        not_negative("yaw_sigma", self.yaw_sigma)?;
        require(
            self.odometry != OdometrySource::File || self.odometry_file.is_some(),
            "odometry",
            "file",
            "name the file in odometry_file, or choose ground_truth or none",
        )?;
        own_car("own_car_m", self.own_car_m)?;
        nested("start", &self.start)?;
        nested("odometry_noise", &self.odometry_noise)?;
        nested("velocity_noise", &self.velocity_noise)?;
        nested("constant_velocity_noise", &self.constant_velocity_noise)?;
        nested("unknown_velocity_noise", &self.unknown_velocity_noise)?;
        nested("observation", &self.observation)?;
        nested("tempering", &self.tempering)?;
        nested("proposal", &self.proposal)?;
        nested("resampling", &self.resampling)?;
        nested("kld", &self.kld)?;
        nested("vigilance", &self.vigilance)?;
        nested("panorama", &self.panorama)?;
        nested("refinement", &self.refinement)?;
        nested("range_image", &self.range_image)
    }
}

impl Validate for RenderedRangeImage {
    fn validate(&self) -> Result<(), InvalidValue> {
        at_least_one("max_instance", self.max_instance)?;
        self.model().validate()
    }
}
