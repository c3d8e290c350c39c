//! Everything about a simulation in one place.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::drive::MotionConfig;
use super::odometry::OdometryConfig;
use super::path::PathSegment;
use super::scanner::ScannerConfig;
use super::street::StreetConfig;
use super::traffic::TrafficConfig;
use crate::validation::{InvalidValue, Validate};

/// A drive along a street: what `simulate` reads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimulationConfig {
    /// Where drives go: drive n becomes `drive_n` below this folder.
    pub output_folder: PathBuf,
    /// Seed of the street and of all noise.
    pub seed: u64,
    /// Number of the drive, from 1. Drives of one seed and path share the street and nothing else.
    pub drive: u32,
    /// Number of scans from the start of the drive; -1 for all.
    pub n_scans: i64,
    /// KITTI poses to drive along, instead of `path`.
    pub path_pose_file: Option<PathBuf>,
    /// Calibration of those poses; null: `calib.txt` beside them.
    pub path_calib_file: Option<PathBuf>,
    /// The path, piece by piece.
    pub path: Vec<PathSegment>,
    /// What stands along it.
    pub street: StreetConfig,
    /// How the car drives.
    pub motion: MotionConfig,
    /// What else moves.
    pub traffic: TrafficConfig,
    /// The sensor.
    pub scanner: ScannerConfig,
    /// The odometry written beside the true poses.
    pub odometry: OdometryConfig,
}

impl Default for SimulationConfig {
    /// 260 m through a small town, up a slope and over a crest, past a square.
    fn default() -> Self {
        let segment = |length_m, turn_deg, grade_percent| PathSegment {
            length_m,
            turn_deg,
            grade_percent,
        };
        Self {
            output_folder: PathBuf::from("data/street"),
            seed: 1,
            drive: 1,
            n_scans: -1,
            path_pose_file: None,
            path_calib_file: None,
            path: vec![
                segment(45.0, 0.0, 0.0),
                segment(25.0, 55.0, 0.0),
                segment(35.0, -8.0, 7.0),
                segment(20.0, 0.0, -6.0),
                segment(25.0, -75.0, 0.0),
                segment(60.0, 12.0, 0.0),
                segment(20.0, -60.0, 1.0),
                segment(30.0, 0.0, 1.0),
            ],
            street: StreetConfig::default(),
            motion: MotionConfig::default(),
            traffic: TrafficConfig::default(),
            scanner: ScannerConfig::default(),
            odometry: OdometryConfig::default(),
        }
    }
}

impl SimulationConfig {
    /// The folder of this drive.
    pub fn drive_folder(&self) -> PathBuf {
        self.output_folder.join(format!("drive_{}", self.drive))
    }

    /// The first contradiction, if there is one.
    pub fn check(&self) -> Result<(), SimulationError> {
        let scanner = &self.scanner;
        let ground = &self.street.ground;
        let positive = [
            ("street.lane_width_m", self.street.lane_width_m),
            (
                "street.side_street_spacing_m",
                self.street.side_street_spacing_m,
            ),
            ("street.lamp_spacing_m", self.street.lamp_spacing_m),
            ("street.plants_per_100_m", self.street.plants_per_100_m),
            ("street.ground.cell_m", ground.cell_m),
            ("street.ground.reach_m", ground.reach_m),
            ("street.ground.sidewalk_width_m", ground.sidewalk_width_m),
            ("motion.speed_m_s", self.motion.speed_m_s),
            ("motion.sensor_height_m", self.motion.sensor_height_m),
            ("scanner.max_range_m", scanner.max_range_m),
            ("scanner.reach_m", scanner.reach_m),
            ("scanner.azimuth_steps", scanner.azimuth_steps as f64),
            ("scanner.beams", scanner.beams as f64),
            ("drive", f64::from(self.drive)),
            ("motion.kidnapped_by_m", self.motion.kidnapped_by_m),
        ];
        let shares = [
            ("street.built_share", self.street.built_share),
            ("street.parked_share", self.street.parked_share),
            ("scanner.dropout_share", scanner.dropout_share),
        ];
        let not_negative = [
            (
                "traffic.lorry_from_s",
                self.traffic.lorry_from_s.unwrap_or_default(),
            ),
            ("traffic.lorry_for_s", self.traffic.lorry_for_s),
            ("scanner.range_noise_m", scanner.range_noise_m),
            ("scanner.min_range_m", scanner.min_range_m),
            (
                "traffic.oncoming_spacing_m",
                self.traffic.oncoming_spacing_m,
            ),
            (
                "traffic.oncoming_speed_m_s",
                self.traffic.oncoming_speed_m_s,
            ),
            (
                "traffic.cyclists_per_100_m",
                self.traffic.cyclists_per_100_m,
            ),
            (
                "traffic.pedestrians_per_100_m",
                self.traffic.pedestrians_per_100_m,
            ),
        ];
        let refuse = |&(key, value): &(&'static str, f64), wanted| {
            Err(SimulationError::BadValue { key, value, wanted })
        };
        let lengths: Vec<(&'static str, f64)> = self
            .path
            .iter()
            .map(|segment| ("path: length_m", segment.length_m))
            .collect();
        let positive = [&positive[..], &lengths].concat();
        if let Some(bad) = positive.iter().find(|(_, v)| !(*v > 0.0 && v.is_finite())) {
            return refuse(bad, "greater than 0");
        }
        if let Some(bad) = shares.iter().find(|(_, v)| !(0.0..=1.0).contains(v)) {
            return refuse(bad, "a share from 0 to 1");
        }
        if let Some(bad) = not_negative
            .iter()
            .find(|(_, v)| !(*v >= 0.0 && v.is_finite()))
        {
            return refuse(bad, "0 or greater");
        }
        if scanner.min_range_m >= scanner.max_range_m {
            return refuse(
                &("scanner.min_range_m", scanner.min_range_m),
                "less than scanner.max_range_m",
            );
        }
        Ok(())
    }
}

impl Validate for SimulationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        self.check().map_err(|error| match error {
            SimulationError::BadValue { key, value, wanted } => {
                InvalidValue::new(key, value, format!("it must be {wanted}"))
            }
            // The others are known only when the drive is planned.
            _ => InvalidValue::new("path", "not usable", error.to_string()),
        })
    }
}

/// Why there is no drive.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum SimulationError {
    #[error("{key}: {value} must be {wanted}")]
    BadValue {
        key: &'static str,
        value: f64,
        wanted: &'static str,
    },
    #[error(
        "the path is {length_m:.1} m long, at least {least_m} m are needed; add segments to `path`, or choose another `path_pose_file`"
    )]
    PathTooShort { length_m: f64, least_m: f64 },
    #[error(
        "motion.kidnapped_at_frame: {frame} and motion.kidnapped_by_m: {by_m} lead beyond the drive, whose path is {path_m:.1} m long; the frame must be 2 or greater, and the car must be set where the drive still comes to"
    )]
    NowhereToBeSet {
        frame: usize,
        by_m: f64,
        path_m: f64,
    },
}
