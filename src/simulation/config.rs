//! Configuration of a simulated drive.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::centreline::PathSegment;
use super::ego_motion::MotionConfig;
use super::given_poses::GivenPosesConfig;
use super::gnss::SimulatedGnssConfig;
use super::inertial::SimulatedImuConfig;
use super::odometry::SimulatedOdometryConfig;
use super::scanner::ScannerConfig;
use super::street_config::StreetConfig;
use super::traffic::TrafficConfig;
use crate::file_path::FilePath;
use crate::memory::MemoryError;
use crate::validation::{InvalidValue, Validate, in_range, nested, require};

/// A drive along a street: the configuration of `simulate`.
///
/// Defaults: 260 m through a small town, up a slope and over a crest, past a square.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SimulationConfig {
    /// Folder of the drives: drive n is written to `drive_n` below it.
    #[default("data/street".into())]
    pub output_folder: FilePath,
    /// Seed of the street and of all noise.
    #[default(1)]
    pub seed: u64,
    /// Number of the drive, from 1. Drives of one seed and path share the street and nothing else.
    #[default(1)]
    pub drive: u32,
    /// Number of scans from the start of the drive; -1 for all.
    #[default(-1)]
    pub n_scans: i64,
    /// KITTI poses to drive along, instead of `path`.
    pub path_pose_file: Option<FilePath>,
    /// Calibration of those poses; null: `calib.txt` next to them.
    pub path_calib_file: Option<FilePath>,
    /// Segments of the path.
    #[default(vec![ PathSegment::new(45.0, 0.0, 0.0), PathSegment::new(25.0, 55.0, 0.0), PathSegment::new(35.0, -8.0, 7.0), PathSegment::new(20.0, 0.0, -6.0), PathSegment::new(25.0, -75.0, 0.0), PathSegment::new(60.0, 12.0, 0.0), PathSegment::new(20.0, -60.0, 1.0), PathSegment::new(30.0, 0.0, 1.0), ])]
    pub path: Vec<PathSegment>,
    /// The street and what stands along it.
    pub street: StreetConfig,
    /// Motion of the vehicle.
    pub motion: MotionConfig,
    /// Other road users.
    pub traffic: TrafficConfig,
    /// The sensor.
    pub scanner: ScannerConfig,
    /// The odometry written next to the true poses.
    pub odometry: SimulatedOdometryConfig,
    /// Errors of the poses that the drive comes with, to build a map with; without errors they are the true ones.
    pub given_poses: GivenPosesConfig,
    /// The inertial sensor.
    pub imu: SimulatedImuConfig,
    /// The GNSS receiver whose positions are written next to the true poses.
    pub gnss: SimulatedGnssConfig,
}

impl SimulationConfig {
    /// The folder of this drive.
    pub fn drive_folder(&self) -> PathBuf {
        self.output_folder.join(format!("drive_{}", self.drive))
    }
}

/// Longest path [m].
const LONGEST_M: f64 = 100_000.0;

impl Validate for SimulationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("drive", self.drive, 1..=1_000_000)?;
        let length_m: f64 = self.path.iter().map(|segment| segment.length_m).sum();
        let remedy = format!("its segments must be at most {LONGEST_M} m long together");
        require(length_m <= LONGEST_M, "path", length_m, remedy)?;
        for (index, segment) in self.path.iter().enumerate() {
            nested(&format!("path.{}", index + 1), segment)?;
        }
        nested("street", &self.street)?;
        nested("motion", &self.motion)?;
        nested("traffic", &self.traffic)?;
        nested("scanner", &self.scanner)?;
        nested("odometry", &self.odometry)?;
        nested("given_poses", &self.given_poses)?;
        nested("imu", &self.imu)?;
        nested("gnss", &self.gnss)
    }
}

/// Reasons why a drive cannot be simulated.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages document the variants")]
pub enum SimulationError {
    #[error(transparent)]
    InvalidValue(#[from] InvalidValue),
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[error(
        "the path is {length_m:.1} m long, at least {least_m} m are needed; add segments to `path`, or choose another `path_pose_file`"
    )]
    PathTooShort { length_m: f64, least_m: f64 },
    #[error(
        "motion.kidnapped_at_frame: {frame} and motion.kidnapped_by_m: {by_m} lead beyond the end of the drive, whose path is {length_m:.1} m long; choose a frame of 2 or greater and a distance that ends before the end of the path"
    )]
    KidnappedBeyondPath {
        frame: usize,
        by_m: f64,
        length_m: f64,
    },
}
