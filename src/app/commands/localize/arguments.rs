//! Arguments of `localize`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use crate::app::run::arguments::{RunArgs, numbers};

/// Arguments of `localize`.
#[derive(Clone, Debug, Args, Serialize)]
pub struct LocalizeArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(flatten)]
    pub run: RunArgs,

    /// Map of `build-map` or range-mcl, or a mesh (.ply, .obj, .stl); sets the key `map_file`.
    #[arg(long, value_name = "MAP")]
    #[serde(rename = "map_file")]
    pub map: Option<PathBuf>,

    /// Start in the map [m, deg], if it is known; sets the key `initial_pose`.
    #[arg(long, value_name = "X,Y,HEADING", value_parser = start, allow_hyphen_values = true)]
    #[serde(rename = "initial_pose")]
    pub start: Option<[f64; 3]>,

    /// Odometry, rows of KITTI or TUM, or a topic of the bag; by default the topic of odometry that a bag has, else the scans. Sets the key `odometry_file`.
    #[arg(long, value_name = "FILE")]
    #[serde(rename = "odometry_file")]
    pub odometry: Option<PathBuf>,

    /// True poses of the recording for the report; sets the key `pose_file`.
    #[arg(long, value_name = "FILE")]
    #[serde(rename = "pose_file")]
    pub truth: Option<PathBuf>,

    /// Calibration of the camera whose poses these are; sets the key `calib_file`.
    #[arg(long, value_name = "FILE")]
    #[serde(rename = "calib_file")]
    pub calib: Option<PathBuf>,

    /// Result to write (.npz); sets the key `result_path`.
    #[arg(long, value_name = "RESULT")]
    #[serde(rename = "result_path")]
    pub output: Option<PathBuf>,

    /// Log to write afterwards, for Foxglove and rerun (.mcap), as `export` does.
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub mcap: Option<PathBuf>,
}

/// Parses a start: x, y [m], heading [deg].
fn start(text: &str) -> Result<[f64; 3], &'static str> {
    let help = "give x and y in the map in metres and the heading in degrees, such as 12.5,-3,90";
    numbers(text, help)
}
