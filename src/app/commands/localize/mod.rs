//! `localize`: localizes a recording in a map, scan by scan.

mod filled;
pub mod frame_tracker;
mod gnss_start;
pub mod opened;
pub mod recorder;
pub mod tracking;
mod written;

use std::sync::{Mutex, MutexGuard, PoisonError};

use anyhow::Result;
use clap::Args;
use serde::Serialize;

use self::filled::fill_back;
use self::opened::Opened;
use self::recorder::Run;
use self::tracking::localize;
use self::written::{write_results, write_run, write_trajectories};
use super::motion_source::MotionSource;
use crate::app::report::Report;
use crate::app::run::arguments::numbers;
use crate::app::run::{Claims, Context, RecordingArgs, RunArgs};
use crate::app::settings::LocalizationConfig;
use crate::file_path::FilePath;

/// Files besides the scans and the map, of `localize` and `live`.
#[derive(Clone, Debug, Args, Serialize)]
pub struct DriveArgs {
    /// Odometry, rows of KITTI or TUM, or a topic of the bag; by default the topic of odometry that a bag has, else the scans. Sets the key `odometry_file`.
    #[arg(long = "odometry", alias = "odom", value_name = "FILE")]
    pub odometry_file: Option<FilePath>,

    /// Inertial sensor whose rates predict rotations and compensate scans: a table of times, rates and forces, a folder oxts, or a topic of the bag; sets the key `imu_file`.
    #[arg(long = "imu", value_name = "FILE")]
    pub imu_file: Option<FilePath>,

    /// Positions of a GNSS receiver, a start in a map with a place on the Earth: sentences of NMEA, rows of time, latitude,
    /// longitude and height, a folder oxts, or a topic of the bag; sets the key `gnss_file`.
    #[arg(long = "gnss", value_name = "SOURCE")]
    pub gnss_file: Option<FilePath>,

    /// True poses of the recording for the report; sets the key `pose_file`.
    #[arg(long = "truth", value_name = "FILE")]
    pub pose_file: Option<FilePath>,

    /// Calibration of the camera, if the true poses are those of a camera; sets the key `calib_file`.
    #[arg(long = "calib", value_name = "FILE")]
    pub calib_file: Option<FilePath>,

    /// Result to write (.npz); sets the key `result_path`.
    #[arg(long = "output", value_name = "RESULT")]
    pub result_path: Option<FilePath>,
}

/// Arguments of `localize`.
#[derive(Clone, Debug, Args, Serialize)]
pub struct LocalizeArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(flatten)]
    pub run: RunArgs,

    /// The recording.
    #[command(flatten)]
    #[serde(flatten)]
    pub recording: RecordingArgs,

    /// Map of `build-map` or range-mcl, or a mesh (.ply, .obj, .stl); sets the key `map_file`.
    #[arg(long = "map", value_name = "MAP")]
    pub map_file: Option<FilePath>,

    /// Start in the map [m, deg], if it is known; sets the key `initial_pose`.
    #[arg(long, value_name = "X,Y,HEADING", value_parser = start_pose, allow_hyphen_values = true)]
    #[serde(rename = "initial_pose")]
    pub start: Option<[f64; 3]>,

    /// Odometry, true poses and result.
    #[command(flatten)]
    #[serde(flatten)]
    pub files: DriveArgs,

    /// Log to write afterwards, for Foxglove and rerun (.mcap), as `export` does.
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub mcap: Option<FilePath>,
}

/// Largest number of frames whose trajectories are written, too, after a signal: the end of the process must not take
/// long.
const MOST_FRAMES_AT_EXIT: usize = 50_000;

/// Parses a start: x, y [m], heading [deg].
pub fn start_pose(text: &str) -> Result<[f64; 3], &'static str> {
    let help = "give x and y in the map in metres and the heading in degrees, such as 12.5,-3,90";
    numbers(text, help)
}

/// Localizes the selected frames of a recording.
pub fn run(config: &LocalizationConfig, context: &Context) -> Result<Report> {
    let opened = opened::open(config, &[], context)?;
    run_with(opened, context, |opened, motion, recorded| {
        localize(opened, motion, recorded, context)
    })
}

/// Access to the localized frames.
pub type Recorded<'a, 'b> = &'a (dyn Fn() -> MutexGuard<'b, Run> + Sync);

/// Has frames localized and recorded, and writes the result.
pub fn run_with(
    (opened, motion, claims): (Opened, MotionSource, Claims),
    context: &Context,
    localize: impl FnOnce(&Opened, MotionSource, Recorded<'_, '_>) -> Result<()>,
) -> Result<Report> {
    let run = Mutex::new(Run::new(&opened, claims)?);
    let recorded = || run.lock().unwrap_or_else(PoisonError::into_inner);
    let is_unfilled = context.interrupt.supervise(
        || {
            localize(&opened, motion, &recorded)?;
            recorded().refuse_distorted();
            let searched = recorded().searched();
            let is_unfilled = searched.is_some() && context.interrupt.requested();
            let filled = searched
                .filter(|_| !is_unfilled)
                .map(|searched| {
                    let frames = recorded().frames(&opened);
                    fill_back(&opened, &frames, &searched)
                })
                .transpose()?;
            let mut run = recorded();
            if let Some(filled) = filled.flatten() {
                run.fill(&filled);
            }
            run.complete()?;
            write_results(&opened, &mut run)?;
            context.interrupt.keeps(run.kept(&opened));
            anyhow::Ok(is_unfilled && run.is_complete(&opened))
        },
        || {
            let mut run = recorded();
            write_results(&opened, &mut run)?;
            if run.results.len() <= MOST_FRAMES_AT_EXIT {
                write_trajectories(&opened, &run)?;
            }
            Ok(run.kept(&opened))
        },
    )?;
    let mut run = run.into_inner().unwrap_or_else(PoisonError::into_inner);
    // A result without the poses of its first frames is not finished.
    if is_unfilled || run.results.len() > MOST_FRAMES_AT_EXIT {
        context.interrupt.check()?;
    }
    write_trajectories(&opened, &run)?;
    let report = write_run(&opened, &mut run, context)?;
    run.finish(&opened)?;
    Ok(report)
}
