//! `odometry`: poses of a recording from its scans, with loops closed and all poses adjusted.

use anyhow::{Context as _, Result};
use clap::Args;
use serde::Serialize;

use super::stages::{RecordingInputs, infer};
use super::trajectory;
use crate::app::report::RunFiles;
use crate::app::report::georeference::GeoreferenceReport;
use crate::app::report::odometry::{self, OdometryReport};
use crate::app::report::run_output::stamped;
use crate::app::run::{
    Claims, Context, Outputs, Printed, RecordingArgs, RunArgs, input, memory, output,
};
use crate::app::settings::OdometryCommandConfig;
use crate::file_path::FilePath;
use crate::geometry::Pose3;
use crate::georeference::{AlignedPath, PathOverTime, align, write_geojson};
use crate::mapping::{LostPath, check_path, find_poses};
use crate::odometry::{GnssConstraints, Trajectory};
use crate::recording::{Frame, Recording};
use crate::sensor::{Sensor, SensorConfig};

/// Path on the Earth, where positions of a receiver are given.
const GEOJSON: &str = "poses.geojson";

/// Arguments of `odometry`.
#[derive(Clone, Debug, Args, Serialize)]
pub struct OdometryArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(flatten)]
    pub run: RunArgs,

    /// The recording.
    #[command(flatten)]
    #[serde(flatten)]
    pub recording: RecordingArgs,

    /// Folder to write; sets the key `output_folder`.
    #[arg(long = "output", value_name = "FOLDER")]
    pub output_folder: Option<FilePath>,

    /// Poses to polish, rows of KITTI or TUM, or a topic of the bag; sets the key `pose_file`.
    #[arg(long = "poses", value_name = "FILE")]
    pub pose_file: Option<FilePath>,

    /// Positions of a GNSS receiver that the poses follow: sentences of NMEA, rows of time, latitude, longitude and height, a
    /// folder oxts, or a topic of the bag; sets the key `gnss_file`.
    #[arg(long = "gnss", value_name = "SOURCE")]
    pub gnss_file: Option<FilePath>,

    /// Calibration of the camera whose poses these are; sets the key `calib_file`.
    #[arg(long = "calib", value_name = "FILE")]
    pub calib_file: Option<FilePath>,

    /// Inertial sensor whose rates predict rotations and compensate scans, and whose forces make poses level that are found from the scans: a table of times, rates and forces, a folder oxts, or a topic of the bag; sets the key `imu_file`.
    #[arg(long = "imu", value_name = "FILE")]
    pub imu_file: Option<FilePath>,
}

/// Finds the poses of the recording that a configuration names; returns what to print.
pub fn run(config: &OdometryCommandConfig, context: &Context) -> Result<Printed> {
    let folder = &config.output_folder;
    let mut claims = prepare(config, context)?;
    let mut resolved = config.clone();
    let (recording, sensor) = open(&mut resolved)?;
    let gnss = config.gnss.read(&recording)?;
    let frames = recording.dense_frames();
    let is_given = recording.track.is_some();
    let imu = recording.imu.as_ref().filter(|_| !is_given);
    let name = if is_given { "polish" } else { "odometry" };
    let found = trajectory::find(name, frames.len(), context, |on_event| {
        find_poses(
            &frames,
            is_given,
            imu,
            &config.trajectory,
            gnss.as_ref(),
            memory::budget(),
            on_event,
        )
    })?;
    let numbers: Vec<usize> = recording.frames.iter().map(|it| it.number).collect();
    let rows: Vec<usize> = (0..frames.len())
        .filter(|&row| numbers.binary_search(&frames[row].number).is_ok())
        .collect();
    let main = folder.join("report.json");
    output::create_folder(folder)?;
    claims.begin(&main)?;
    odometry::write(
        &RunFiles::in_folder(&main, folder),
        &recording,
        &rows,
        &found,
    )?;
    let aligned = gnss
        .map(|gnss| aligned(&frames, &found, &gnss))
        .transpose()?;
    if let Some(aligned) = &aligned {
        let poses: Vec<Pose3> = rows.iter().map(|&row| found.poses[row]).collect();
        let path = [stamped(&recording.frames, &poses)];
        output::write_file(&folder.join(GEOJSON), |file| {
            write_geojson(file, &aligned.georeference, &path)
        })?;
    }
    if config.output.plots {
        odometry::draw(&folder.join("path.png"), &found, is_given)?;
    }
    let mut report = OdometryReport::new(&found, &frames, recording.has_times, sensor);
    report.georeference = (aligned.as_ref())
        .map(GeoreferenceReport::new)
        .transpose()?;
    output::write_yaml(&folder.join("effective_odometry.yml"), &resolved)?;
    output::write_json(&main, &report)?;
    claims.finish(&main)?;
    odometry::warn(&report.summary, LostPath::of(&found, &frames).as_ref());
    let mut rows = odometry::rows(&report.summary);
    rows.extend(
        report
            .georeference
            .iter()
            .flat_map(GeoreferenceReport::rows),
    );
    Printed::rows(&rows, &report)
}

/// The place of the path on the Earth.
fn aligned(frames: &[Frame], found: &Trajectory, gnss: &GnssConstraints) -> Result<AlignedPath> {
    let times_s: Vec<f64> = frames.iter().map(|frame| frame.time_s).collect();
    let path = PathOverTime {
        times_s: &times_s,
        map_from_lidar: &found.poses,
    };
    Ok(align(path, &gnss.fixes, &gnss.config)?)
}

fn prepare(config: &OdometryCommandConfig, context: &Context) -> Result<Claims> {
    let mut names = vec![
        "poses_tum.txt",
        "poses_kitti.txt",
        "odometry_tum.txt",
        "trajectory.npz",
        "frames.csv",
        "effective_odometry.yml",
    ];
    names.extend(config.gnss.gnss_file.as_ref().map(|_| GEOJSON));
    names.extend(config.output.plots.then_some("path.png"));
    let mut inputs = RecordingInputs::new(&config.recording, &config.given_poses).files();
    inputs.extend(config.inertial.files(&config.recording));
    inputs.extend(config.gnss.file(&config.recording));
    input::require(&inputs)?;
    inputs.extend(context.input());
    let outputs = Outputs {
        key: "output_folder",
        main: &config.output_folder.join("report.json"),
        magic: None,
        names: names.into_iter().map(str::to_owned).collect(),
        inputs,
        force: config.output.force,
    };
    outputs.prepare()
}

/// Opens the recording, with the poses to polish if there are any.
fn open(config: &mut OdometryCommandConfig) -> Result<(Recording, Sensor)> {
    let inputs = RecordingInputs::new(&config.recording, &config.given_poses);
    let mut recording = config.inertial.open(inputs.open()?)?;
    if let Some(path) = &config.given_poses.pose_file {
        let track = inputs.track(path, &recording)?;
        recording = recording.with_poses(track)?.with_gyroscope_of_poses();
        check_path(&recording, config.max_step_m)
            .with_context(|| format!("pose_file is {}", path.display()))?;
        recording.skipped.clear();
    }
    let mut known = SensorConfig {
        motion_compensation: config.motion_compensation,
        ..SensorConfig::default()
    };
    let completed = infer(&mut known, recording)?;
    config.motion_compensation = known.motion_compensation;
    Ok(completed)
}
