//! `odometry`: poses of a recording from its scans, with loops closed and all poses adjusted.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use serde::Serialize;

use super::stages::SensorKeys;
use super::trajectory;
use crate::app::report::plotting::PathPlot;
use crate::app::report::plotting::color::{ODOMETRY, REFINED};
use crate::app::report::results::write_trajectory_npz;
use crate::app::report::run_output::{self, RunFiles};
use crate::app::run::arguments::RunArgs;
use crate::app::run::artefact::{Claims, Outputs};
use crate::app::run::output::Printed;
use crate::app::run::{Context, output};
use crate::app::settings::OdometryCommandConfig;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::mapping::{TrajectorySummary, find_poses};
use crate::odometry::{Loop, OdometryEstimate, StepState, Trajectory};
use crate::recording::poses::write_tum;
use crate::recording::{Frame, Recording};
use crate::sensor::{RangeImageConfig, Sensor};

/// Arguments of `odometry`.
#[derive(Clone, Debug, Args, Serialize)]
pub struct OdometryArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(flatten)]
    pub run: RunArgs,

    /// Folder to write; sets the key `output_folder`.
    #[arg(long, value_name = "FOLDER")]
    #[serde(rename = "output_folder")]
    pub output: Option<PathBuf>,

    /// Poses to polish, rows of KITTI or TUM, or a topic of the bag; sets the key `pose_file`.
    #[arg(long, value_name = "FILE")]
    #[serde(rename = "pose_file")]
    pub poses: Option<PathBuf>,

    /// Calibration of the camera whose poses these are; sets the key `calib_file`.
    #[arg(long, value_name = "FILE")]
    #[serde(rename = "calib_file")]
    pub calib: Option<PathBuf>,
}

/// Report of a run.
#[derive(Debug, Serialize)]
struct OdometryReport {
    #[serde(flatten)]
    summary: TrajectorySummary,
    /// The sensor.
    sensor: Sensor,
    /// Loops that were found.
    found_loops: Vec<LoopReport>,
}

/// A loop in the report.
#[derive(Debug, Serialize)]
struct LoopReport {
    /// Frame of the earlier visit.
    first: usize,
    /// Frame of the later visit.
    second: usize,
    /// Distance between the visits [m].
    distance_m: f64,
    /// Share of the surfaces in common, without the ground.
    common_share: f64,
    /// What became of it.
    verdict: String,
}

/// Finds the poses of the recording that a configuration names; returns what to print.
pub fn run(config: &OdometryCommandConfig, context: &Context) -> Result<Printed> {
    config.recording_inputs().require()?;
    let folder = &config.output_folder;
    let mut claims = prepare(config, context)?;
    let mut resolved = config.clone();
    let (recording, sensor) = open(&mut resolved)?;
    let frames = recording.dense_frames();
    let is_given = recording.track.is_some();
    let name = if is_given { "polish" } else { "odometry" };
    let found = trajectory::find(name, frames.len(), context, |on_event| {
        find_poses(&frames, is_given, &config.trajectory, on_event)
    })?;
    let numbers: Vec<usize> = recording.frames.iter().map(|it| it.number).collect();
    let rows: Vec<usize> = (0..frames.len())
        .filter(|&row| numbers.binary_search(&frames[row].number).is_ok())
        .collect();
    let main = folder.join("report.json");
    output::create_folder(folder)?;
    claims.begin(&main)?;
    write(
        &RunFiles::in_folder(&main, folder),
        &recording,
        &rows,
        &found,
    )?;
    if config.visualize {
        draw(&folder.join("path.png"), &found, is_given)?;
    }
    let summary = TrajectorySummary::new(&found, recording.has_times);
    let report = OdometryReport {
        found_loops: found
            .loops
            .iter()
            .map(|it| LoopReport::of(it, &frames))
            .collect(),
        summary,
        sensor,
    };
    output::write_yaml(&folder.join("effective_odometry.yml"), &resolved)?;
    output::write_json(&main, &report)?;
    claims.finish(&main)?;
    trajectory::warn(&report.summary);
    Printed::rows(&trajectory::rows(&report.summary)).with_json(&report)
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
    names.extend(config.visualize.then_some("path.png"));
    let mut inputs = config.recording_inputs().files();
    inputs.extend(context.input());
    let outputs = Outputs {
        key: "output_folder",
        main: &config.output_folder.join("report.json"),
        magic: None,
        names: names.into_iter().map(str::to_owned).collect(),
        inputs,
        force: config.force,
    };
    outputs.prepare()
}

/// Opens the recording, with the poses to polish if there are any.
fn open(config: &mut OdometryCommandConfig) -> Result<(Recording, Sensor)> {
    let inputs = config.recording_inputs();
    let mut recording = inputs.open(&config.selection())?;
    if let Some(path) = &config.pose_file {
        let track = inputs.track(path, &recording)?;
        recording = recording.with_poses(track)?;
        let origin = format!("pose_file is {}", path.display());
        trajectory::check(&recording, config.max_step_m, &origin)?;
        recording.skipped.clear();
    }
    let keys = SensorKeys {
        range_image: &mut RangeImageConfig::default(),
        own_car_m: &mut None,
        motion_compensation: &mut config.motion_compensation,
    };
    keys.resolve(recording)
}

/// Writes the poses of the selected frames.
fn write(
    files: &RunFiles,
    recording: &Recording,
    rows: &[usize],
    found: &Trajectory,
) -> Result<()> {
    let frames = &recording.frames;
    let poses: Vec<Pose3> = rows.iter().map(|&row| found.poses[row]).collect();
    let steps: Vec<&OdometryEstimate> = rows.iter().map(|&row| &found.odometry[row]).collect();
    let odometry: Vec<Pose3> = steps.iter().map(|step| step.odom_from_lidar).collect();
    run_output::write_trajectory(files, "poses", recording, &poses)?;
    output::write_file(&files.file("odometry_tum.txt"), |file| {
        write_tum(file, &trajectory::stamped(frames, &odometry))
    })?;
    write_trajectory_npz(&files.file("trajectory.npz"), frames, &poses, &steps)?;
    output::write_text(&files.file("frames.csv"), &csv(frames, &poses, &steps))
}

/// One row per frame.
fn csv(frames: &[Frame], poses: &[Pose3], steps: &[&OdometryEstimate]) -> String {
    let mut text = "frame,time_s,x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad,state,matched_share,residual_m,degenerate_directions,time_ms\n".to_owned();
    for ((frame, pose), step) in frames.iter().zip(poses).zip(steps) {
        let (t, angles) = (pose.translation.vector, pose.rotation.euler_angles());
        let residual = step.residual_m.map_or(String::new(), |m| format!("{m:.5}"));
        text += &format!(
            "{},{:.6},{:.6},{:.6},{:.6},{:.8},{:.8},{:.8},{},{:.4},{residual},{},{:.3}\n",
            frame.number,
            frame.time_s,
            t.x,
            t.y,
            t.z,
            angles.0,
            angles.1,
            angles.2,
            in_words(step.state),
            step.matched_share,
            step.degenerate_directions.len(),
            1e3 * step.elapsed.as_secs_f64()
        );
    }
    text
}

fn in_words(state: StepState) -> &'static str {
    match state {
        StepState::First => "first",
        StepState::Registered => "registered",
        StepState::Predicted => "predicted",
        StepState::Given => "given",
    }
}

/// Draws the path before and after loops and adjustment.
fn draw(path: &Path, found: &Trajectory, is_given: bool) -> Result<()> {
    let planar = |poses: &mut dyn Iterator<Item = Pose3>| -> Vec<Pose2> {
        poses.map(|pose| pose2_from_pose3(&pose)).collect()
    };
    let before = planar(&mut found.odometry.iter().map(|step| step.odom_from_lidar));
    let after = planar(&mut found.poses.iter().copied());
    let name = if is_given { "given" } else { "odometry" };
    PathPlot {
        title: "Path",
        ground_truth: None,
        paths: &[(name, ODOMETRY, &before), ("adjusted", REFINED, &after)],
        numbers: None,
        map: None,
    }
    .save(path)
}

impl LoopReport {
    fn of(found: &Loop, frames: &[Frame]) -> Self {
        Self {
            first: frames[found.first].number,
            second: frames[found.second].number,
            distance_m: found.first_from_second.translation.vector.norm(),
            common_share: found.common_share,
            verdict: format!("{:?}", found.verdict).to_lowercase(),
        }
    }
}
