//! Configuration of `build-map`: from scans with poses to a triangle mesh.

use std::path::PathBuf;

use glam::Vec3;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::check::{optional_path, path};
use super::recording::mounting;
use crate::ground::{FuzzyConfig, GroundConfig, GroundMethod, PcaGround, RansacGround};
use crate::lidar::NormalConfig;
use crate::map::build::confidence::ConfidenceConfig;
use crate::map::build::scan_cloud::ScanConfig;
use crate::map::build::visibility::VisibilityConfig;
use crate::map::{LocalMapConfig, MapConfig, PoseSource};
use crate::meshing::PoissonConfig;
use crate::sensor::{MotionCompensation, RangeImageConfig, SensorConfig};
use crate::validation::{InvalidValue, Validate, in_range, require};

/// Configuration of `build-map`: the keys of range-mcl's `build_map.yml`, then new ones.
///
/// Defaults: the values of range-mcl.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct BuildMapConfig {
    /// The recording: its folder, the folder of its scans, or a bag.
    #[default("data/kitti/velodyne".into())]
    pub scan_folder: PathBuf,
    /// Topic of the point clouds in a bag with several.
    pub topic: Option<String>,
    /// Poses of the recording, rows of KITTI or TUM, a folder `oxts`, or a topic of a bag; `None`: those that the
    /// recording contains.
    pub pose_file: Option<PathBuf>,
    /// Calibration of the recording, with its line `Tr`; `None`: the poses in `pose_file` are those of the lidar.
    pub calib_file: Option<PathBuf>,
    /// Pose x, y, z [m], roll, pitch, yaw [deg] of the lidar on the body whose poses are given; `None`: they are
    /// those of the lidar.
    pub body_from_lidar: Option<[f64; 6]>,
    /// Whether the poses are those of `pose_file` or the recording, or found from the scans.
    pub poses: PoseSource,
    /// Map to which the recording is added: it is localized in that map, and what has changed since is replaced.
    pub onto: Option<PathBuf>,
    /// Output path of the map.
    #[default("results/map.ply".into())]
    pub mesh_file: PathBuf,
    /// Number of scans from `start_idx` on; -1 for all.
    #[default(-1)]
    pub n_scans: i64,
    /// Number of counted scans in a local map.
    #[default(100)]
    pub local_map_size: usize,
    /// Whether to draw the map from above.
    #[default(true)]
    pub visualize: bool,
    /// Octree depth of the Poisson reconstruction.
    #[default(9)]
    pub depth: u32,
    /// Quantile of the vertex density below which vertices are removed, unitless.
    #[default(0.1)]
    pub min_density: f64,
    /// Voxel edge of the downsampling [m].
    #[default(0.1)]
    pub voxel_size: f64,
    /// Half length of the crop box [m].
    #[default(30.0)]
    pub crop_x: f64,
    /// Half width of the crop box [m].
    #[default(30.0)]
    pub crop_y: f64,
    /// Half height of the crop box [m].
    #[default(5.0)]
    pub crop_z: f64,
    /// Inlier distance of the RANSAC plane [m].
    #[default(0.3)]
    pub distance_threshold: f64,
    /// Sample size of a RANSAC plane.
    #[default(3)]
    pub ransac_n: usize,
    /// Number of RANSAC planes.
    #[default(100)]
    pub num_iterations: usize,
    /// Cell edge of the ground simplification [m].
    #[default(1.0)]
    pub simplify_resolution: f64,
    /// Smoothing iterations of the ground.
    #[default(1)]
    pub number_of_iterations: usize,
    /// Red, green and blue of the ground, 0 to 1.
    #[default([1.0, 0.0, 0.0])]
    pub ground_color: [f64; 3],
    /// Red, green and blue of everything else, 0 to 1.
    #[default([0.0, 0.0, 1.0])]
    pub rest_color: [f64; 3],
    /// Size and limits of the range images for the normals.
    pub range_image: RangeImageConfig,

    /// Point cloud in the map frame that is meshed instead of scans with poses, `.pcd`, `.ply` or `.npy`.
    pub cloud_file: Option<PathBuf>,
    /// First frame of the recording.
    pub start_idx: usize,
    /// Step between frames: n uses every n-th frame.
    #[default(1)]
    pub frame_step: usize,
    /// Motion since the last counted scan above which a scan counts [m].
    #[default(0.2)]
    pub displacement_threshold_m: f64,
    /// Largest distance between successive frames [m]; a larger one is an error of the poses.
    #[default(50.0)]
    pub max_step_m: f64,
    /// Whether to compare the poses with the motion of some scans before anything is built.
    #[default(true)]
    pub check_poses: bool,
    /// Method of ground segmentation.
    pub ground_method: GroundMethod,
    /// Length of path that neighbouring local maps share [m].
    #[default(5.0)]
    pub overlap_m: f64,
    /// Step between counted scans that are excluded from the map and used to evaluate it; 0 for none.
    pub holdout_step: usize,
    /// Mesh of the true surface in the map frame, for accuracy and completeness; `street.ply` of a
    /// simulated drive is one.
    pub truth_mesh: Option<PathBuf>,
    /// Distance to the nearest point above which reconstructed surface is removed [m].
    #[default(f64::from(LocalMapConfig::default().max_distance_m))]
    pub max_distance_m: f64,
    /// Confidence above which a vertex is ground, unitless.
    #[default(LocalMapConfig::default().ground_threshold)]
    pub ground_threshold: f32,
    /// Box of the own car in the lidar frame: x_min, x_max, y_min, y_max [m].
    pub own_car_m: Option<[f32; 4]>,
    /// Weight of each point. Off by default: it improved no map.
    pub confidence: ConfidenceConfig,
    /// Surface reconstruction, beside `depth`.
    pub poisson: PoissonConfig,
    /// Normals from range images.
    pub normals: NormalConfig,
    /// Free-space votes, which remove moving objects.
    pub visibility: VisibilityConfig,
    /// Linguistic sets and rules of `ground_method: fuzzy`.
    pub fuzzy: FuzzyConfig,
    /// Parameters of `ground_method: pca`.
    pub pca: PcaGround,
    /// Times of the points for motion compensation; `None` for scans that are compensated already, such as
    /// those of KITTI odometry.
    #[default(Some(MotionCompensation::Auto))]
    pub motion_compensation: Option<MotionCompensation>,
    /// Angle to add to the elevations of all points [deg].
    pub elevation_bias_deg: f64,
    /// Seed of all random choices.
    pub seed: u64,
    /// Whether to replace an existing map.
    pub force: bool,
}

impl BuildMapConfig {
    /// The build of the map.
    pub fn map(&self) -> MapConfig {
        MapConfig {
            sensor: SensorConfig {
                range_image: self.range_image.clone(),
                own_car_m: self.own_car_m,
                sensor_height_m: None,
                motion_compensation: self.motion_compensation,
            },
            poses: self.poses,
            check_poses: self.check_poses,
            seed: self.seed,
            displacement_threshold_m: self.displacement_threshold_m,
            local_map_size: self.local_map_size,
            overlap_m: self.overlap_m,
            max_step_m: self.max_step_m,
            ground: self.ground(),
            local_map: self.local_map(),
        }
    }

    /// How scans become local maps.
    fn local_map(&self) -> LocalMapConfig {
        LocalMapConfig {
            scan: ScanConfig {
                range_image: self.range_image.model(),
                normals: self.normals,
                voxel_size_m: self.voxel_size as f32,
                crop_m: Vec3::new(self.crop_x as f32, self.crop_y as f32, self.crop_z as f32),
                own_car_m: self.own_car_m.unwrap_or(ScanConfig::default().own_car_m),
                has_rows: self.range_image.has_rows.unwrap_or(true),
            },
            confidence: self.confidence.clone(),
            poisson: PoissonConfig {
                depth: self.depth,
                ..self.poisson.clone()
            },
            min_density: self.min_density,
            max_distance_m: self.max_distance_m as f32,
            visibility: self.visibility.clone(),
            ground_threshold: self.ground_threshold,
            simplify_resolution_m: self.simplify_resolution as f32,
            smoothing_iterations: self.number_of_iterations,
            ground_color: bytes(self.ground_color),
            rest_color: bytes(self.rest_color),
        }
    }

    /// The ground classifier and its parameters.
    pub fn ground(&self) -> GroundConfig {
        GroundConfig {
            method: self.ground_method,
            fuzzy: self.fuzzy.clone(),
            pca: self.pca,
            ransac: RansacGround {
                distance_threshold: self.distance_threshold as f32,
                ransac_n: self.ransac_n,
                num_iterations: self.num_iterations,
                seed: self.seed,
            },
        }
    }
}

fn bytes(rgb: [f64; 3]) -> [u8; 3] {
    rgb.map(|share| (255.0 * share).round() as u8)
}

impl Validate for BuildMapConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        path("scan_folder", &self.scan_folder)?;
        optional_path("pose_file", self.pose_file.as_deref())?;
        optional_path("calib_file", self.calib_file.as_deref())?;
        mounting(self.calib_file.as_deref(), self.body_from_lidar)?;
        in_range("elevation_bias_deg", self.elevation_bias_deg, -5.0..=5.0)?;
        optional_path("cloud_file", self.cloud_file.as_deref())?;
        optional_path("onto", self.onto.as_deref())?;
        if let Some(map) = &self.onto {
            require(
                self.cloud_file.is_none() && self.poses != PoseSource::Polished,
                "onto",
                map.display(),
                "only scans are added to a map; their poses are adjusted to it: set cloud_file to null and poses to auto, or to given for those in the world of the map",
            )?;
        }
        path("mesh_file", &self.mesh_file)?;
        self.selection().validate()?;
        self.range_image.without_batches()?;
        in_range("depth", self.depth, PoissonConfig::DEPTHS)?;
        color("ground_color", self.ground_color)?;
        color("rest_color", self.rest_color)?;
        require(
            self.holdout_step != 1,
            "holdout_step",
            self.holdout_step,
            "1 would exclude every scan; 0 excludes none, 10 every tenth",
        )?;
        self.ground().validate_with_flat_ransac()?;
        self.map().validate()
    }
}

fn color(key: &str, rgb: [f64; 3]) -> Result<(), InvalidValue> {
    require(
        rgb.iter().all(|share| (0.0..=1.0).contains(share)),
        key,
        format_args!("{rgb:?}"),
        "red, green and blue must lie between 0 and 1",
    )
}
