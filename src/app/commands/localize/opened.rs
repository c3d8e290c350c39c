//! The inputs of a localization, opened, and its outputs, claimed.

use std::collections::VecDeque;
use std::iter;
use std::path::Path;

use anyhow::{Result, ensure};

use super::super::motion_source::MotionSource;
use super::super::stages::{RecordingInputs, input_files};
use super::gnss_start;
use crate::app::report::RunFiles;
use crate::app::report::run_output::{self, LOCALIZATION_FILES, REFINEMENT_FILES, REPORT_FILES};
use crate::app::run::{Claims, Context, Outputs, input};
use crate::app::settings::{Initialization, LocalizationConfig, NPZ, OdometrySource};
use crate::file_path::FilePath;
use crate::lidar::Scan;
use crate::map::Map;
use crate::random::stream;
use crate::recording::Recording;
use crate::sensor::Sensor;

/// Random stream of the noise on the odometry; the localizer has its own streams.
const ODOMETRY_STREAM: u64 = 1;

/// What a localization works on.
pub struct Opened {
    /// The configuration, with what the scans show about the sensor.
    pub config: LocalizationConfig,
    /// The files of the result.
    pub files: RunFiles,
    /// The map.
    pub map: Map,
    /// The recording, with its true poses where they are given; without frames where a robot sends them.
    pub recording: Recording,
    /// The sensor; `None` where it is inferred from the scans as they arrive.
    pub sensor: Option<Sensor>,
}

impl Opened {
    /// Whether the scans are those of a robot that drives: nobody knows how many there will be, or reads one again.
    pub fn is_driving(&self) -> bool {
        self.recording.frames.is_empty()
    }
}

/// Opens map, recording and source of motion, after the outputs are claimed, with further files next to the result.
pub fn open(
    config: &LocalizationConfig,
    further_files: &[&'static str],
    context: &Context,
) -> Result<(Opened, MotionSource, Claims)> {
    let inputs = RecordingInputs::new(&config.recording, &config.given_poses);
    let files = RunFiles::new(&config.result_path);
    context.interrupt.keeps("no frame was finished");
    let mut read = input_files(inputs, &config.map_input, &config.motion, context)?;
    let fixes = config.gnss.file(&config.recording);
    input::require(fixes.as_slice())?;
    let measurements = config.inertial.files(&config.recording);
    input::require(measurements.as_slice())?;
    read.extend(fixes.into_iter().chain(measurements));
    let claims = prepare(config, read, further_files, &files)?;
    let map = config.map_input.load(config.map_options(), context)?;
    let mut resolved = config.clone();
    let (recording, sensor) = inputs.open_in_map(&map, &mut resolved.tracker.sensor, None)?;
    gnss_start::resolve(&mut resolved, &map, &recording)?;
    let first = recording.frames.first();
    let is_at_truth =
        resolved.initialization() == Initialization::Tracking && resolved.initial_pose.is_none();
    ensure!(
        !is_at_truth || first.is_some_and(|frame| frame.map_from_lidar.is_some()),
        "pose_file has no pose of the first frame, at which tracking starts; give initial_pose, or start_idx of a frame with a pose"
    );
    let odometry = config.tracker.odometry.clone().unwrap_or_default();
    let recording = (config.inertial).open_calibrated(recording, &odometry, context)?;
    let mut rng = stream(config.tracker.seed, ODOMETRY_STREAM);
    let (motion, odometry_file) =
        MotionSource::open(&config.motion, &inputs, &recording, &mut rng)?;
    resolved.motion.odometry_file = odometry_file.map(FilePath::from);
    let opened = Opened {
        config: resolved,
        files,
        map,
        recording,
        sensor: Some(sensor),
    };
    Ok((opened, motion, claims))
}

/// Opens the map for scans that a robot sends, as [`open`] does for those of a recording.
pub fn open_driving(
    config: &LocalizationConfig,
    further_files: &[&'static str],
    context: &Context,
) -> Result<(Opened, MotionSource, Claims)> {
    let files = RunFiles::new(&config.result_path);
    context.interrupt.keeps("no scan was localized");
    let mut read = config.map_input.files();
    input::require(&read)?;
    read.extend(context.input());
    let claims = prepare(config, read, further_files, &files)?;
    let opened = Opened {
        config: config.clone(),
        files,
        map: config.map_input.load(config.map_options(), context)?,
        recording: Recording::from_scans(iter::empty::<Scan>()),
        sensor: None,
    };
    let motion = match config.motion.odometry {
        OdometrySource::None => MotionSource::Unknown,
        _ => MotionSource::Scans(VecDeque::new()),
    };
    Ok((opened, motion, claims))
}

/// Prepares the configured outputs of files that are read.
fn prepare(
    config: &LocalizationConfig,
    inputs: Vec<(&'static str, &Path)>,
    further_files: &[&'static str],
    files: &RunFiles,
) -> Result<Claims> {
    let mut names = Vec::new();
    if config.save_result {
        names.extend(REPORT_FILES.iter().chain(&LOCALIZATION_FILES));
        names.extend(further_files);
        let is_refined = config.refine;
        names.extend(REFINEMENT_FILES.iter().filter(|_| is_refined));
    }
    names.extend(config.output.plots.then_some("plots"));
    if config.visualize {
        names.extend(["loc_plots", "localization.gif"]);
    }
    if names.is_empty() {
        return Claims::read(files.folder());
    }
    let outputs = Outputs {
        key: "result_path",
        main: &config.result_path,
        magic: Some(NPZ),
        names: names.into_iter().map(str::to_owned).collect(),
        inputs,
        force: config.output.force,
    };
    run_output::prepare(files, &outputs)
}
