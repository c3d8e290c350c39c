//! Blocks of keys that several commands share.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use nalgebra::UnitQuaternion;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::file_path::FilePath;
use crate::files::has_extension;
use crate::geometry::{Pose3, pose_from_degrees};
use crate::georeference::GnssConfig;
use crate::recording::{Layout, Selection};
use crate::validation::{InvalidValue, Validate, in_range, nested, require};

/// The recording that a command reads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct RecordingConfig {
    /// The recording: its folder, the folder of its scans, or a bag.
    #[default("data/kitti/velodyne".into())]
    pub scan_folder: FilePath,
    /// Layout of the recording: `kitti`, `kitti_raw`, `kitti360`, `mulran`, `nclt`, `boreas`, `helipr`, `ncd`, `nuscenes`, `apollo`,
    /// `paris_luco`, `generic` (a folder of scans) or `bag`; `None`: as its files show.
    pub layout: Option<Layout>,
    /// Topic of the point clouds in a bag with several, or name of a lidar or scene in a folder with several.
    pub topic: Option<String>,
    /// The frames that are used.
    pub frames: Selection,
    /// Angle to add to the elevations of all points [deg].
    pub elevation_bias_deg: f64,
}

impl Validate for RecordingConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        require_path("scan_folder", &self.scan_folder)?;
        nested("frames", &self.frames)?;
        in_range("elevation_bias_deg", self.elevation_bias_deg, -5.0..=5.0)
    }
}

/// Poses that are given: those of a map, or the true ones of a recording.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PoseInputConfig {
    /// Rows of KITTI or TUM, a folder `oxts`, or a topic of a bag; `None`: those that the recording contains, if any.
    pub pose_file: Option<FilePath>,
    /// Calibration of the recording, with its line `Tr`; `None`: the poses in `pose_file` are those of the lidar.
    pub calib_file: Option<FilePath>,
    /// Pose x, y, z [m], roll, pitch, yaw [deg] of the lidar on the body whose poses are given; `None`: they are
    /// those of the lidar.
    pub body_from_lidar: Option<[f64; 6]>,
}

impl PoseInputConfig {
    /// `body_from_lidar` as a pose.
    pub fn body_from_lidar(&self) -> Option<Pose3> {
        self.body_from_lidar.map(pose_from_degrees)
    }
}

impl Validate for PoseInputConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        optional_path("pose_file", self.pose_file.as_deref())?;
        optional_path("calib_file", self.calib_file.as_deref())?;
        let Some(numbers) = self.body_from_lidar else {
            return Ok(());
        };
        let key = "body_from_lidar";
        require(
            self.calib_file.is_none(),
            key,
            format!("{numbers:?}"),
            "give calib_file or body_from_lidar, not both",
        )?;
        let is_possible = numbers[..3].iter().all(|m| m.abs() <= 1000.0)
            && numbers[3..].iter().all(|deg| deg.abs() <= 360.0);
        require(
            is_possible,
            key,
            format!("{numbers:?}"),
            "x, y, z must be within 1000 m, and roll, pitch, yaw within 360 degrees",
        )
    }
}

/// The inertial sensor of a recording.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct InertialConfig {
    /// Its measurements: a table of times, angular rates and forces, a folder `oxts`, or a topic of the bag; `None`: no
    /// sensor.
    pub imu_file: Option<FilePath>,
    /// Roll, pitch, yaw [deg] of its axes in the lidar frame; `None`: from the transforms of the bag or the calibration of
    /// `oxts`, else estimated.
    pub lidar_from_imu: Option<[f64; 3]>,
}

impl InertialConfig {
    /// `lidar_from_imu` as a rotation.
    pub fn lidar_from_imu(&self) -> Option<UnitQuaternion<f64>> {
        let [roll, pitch, yaw] = self.lidar_from_imu?;
        Some(pose_from_degrees([0.0, 0.0, 0.0, roll, pitch, yaw]).rotation)
    }
}

impl Validate for InertialConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        optional_path("imu_file", self.imu_file.as_deref())?;
        for deg in self.lidar_from_imu.iter().flatten() {
            in_range("lidar_from_imu", *deg, -360.0..=360.0)?;
        }
        Ok(())
    }
}

/// Positions of a GNSS receiver.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GnssInputConfig {
    /// Sentences of NMEA, rows of time, latitude, longitude and height, a folder `oxts`, or a topic of a bag; `None`: none
    /// are used.
    pub gnss_file: Option<FilePath>,
    /// Their errors, and the place of the antenna.
    pub errors: GnssConfig,
}

impl Validate for GnssInputConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        optional_path("gnss_file", self.gnss_file.as_deref())?;
        nested("errors", &self.errors)
    }
}

/// The map in which a recording is localized.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct MapInputConfig {
    /// Map of `build-map` or range-mcl.
    #[default("results/map.ply".into())]
    pub map_file: FilePath,
    /// Camera poses of the mapping drive; `None`: the map carries its own frame.
    pub map_pose_file: Option<FilePath>,
    /// Calibration of the mapping drive; `None`: the map carries its own frame.
    pub map_calib_file: Option<FilePath>,
}

impl Validate for MapInputConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        require_path("map_file", &self.map_file)?;
        optional_path("map_pose_file", self.map_pose_file.as_deref())?;
        optional_path("map_calib_file", self.map_calib_file.as_deref())
    }
}

/// Where the motion between frames comes from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MotionSourceConfig {
    /// Source of the motion.
    pub odometry: OdometrySource,
    /// Odometry poses in KITTI or TUM format, for `odometry: auto` and `file`.
    pub odometry_file: Option<FilePath>,
}

impl MotionSourceConfig {
    /// Requires a file for [`OdometrySource::File`], and true poses for [`OdometrySource::GroundTruth`].
    pub(super) fn validate(&self, truth: &PoseInputConfig) -> Result<(), InvalidValue> {
        require(
            self.odometry != OdometrySource::GroundTruth || truth.pose_file.is_some(),
            "motion.odometry",
            "ground_truth",
            "name the true poses in pose_file, or choose auto",
        )?;
        require(
            self.odometry != OdometrySource::File || self.odometry_file.is_some(),
            "motion.odometry",
            "file",
            "name the file in odometry_file, or choose auto, scans or none",
        )
    }
}

/// Source of the motion between frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OdometrySource {
    /// `odometry_file` or, in a bag, the topic of odometry, if there is one; else the scans.
    #[default]
    Auto,
    /// The scans alone.
    Scans,
    /// `odometry_file`.
    File,
    /// The true poses of the recording with noise, as range-mcl does for demonstration.
    GroundTruth,
    /// None: constant velocity.
    None,
}

/// How a command writes its output.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct OutputConfig {
    /// Whether to draw the pictures of the result.
    #[default(true)]
    pub plots: bool,
    /// Whether to replace existing output.
    pub force: bool,
}

/// First bytes of a result.
pub const NPZ: &[u8] = b"PK";

/// Whether a file is a result of `localize` or `refine`, an archive of arrays, and not a trajectory as text: by its name, or
/// by how it begins.
pub fn is_result(path: &Path) -> bool {
    let begins_as_archive = || {
        let mut start = [0; NPZ.len()];
        let read = File::open(path).and_then(|mut file| file.read_exact(&mut start));
        read.is_ok() && start == NPZ
    };
    has_extension(path, "npz") || begins_as_archive()
}

/// Requires a path that is not empty.
pub fn require_path(key: &str, value: &Path) -> Result<(), InvalidValue> {
    let is_given = !value.as_os_str().is_empty();
    require(is_given, key, "empty", "give a path")
}

/// Requires a path that is not empty, where one is given.
pub(super) fn optional_path(key: &str, value: Option<&Path>) -> Result<(), InvalidValue> {
    value.map_or(Ok(()), |value| require_path(key, value))
}
