//! `refine`: refines the trajectory of `localize`, or one from anywhere, frame by frame and smooths it.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Result, ensure};
use clap::Args;
use serde::Serialize;

use super::motion_source;
use super::motion_source::MotionSource;
use super::stages::{RecordingInputs, input_files};
use crate::app::report::results::unknown_pose;
use crate::app::report::run_output::{self, REFINEMENT_FILES, REPORT_FILES, Trajectory};
use crate::app::report::{LocalizationResults, Report, RunFiles, run_page};
use crate::app::run::arguments::numbers;
use crate::app::run::{Claims, Context, Outputs, RecordingArgs, RunArgs, input, output};
use crate::app::settings::{
    self, LocalizationConfig, NPZ, OdometrySource, OutputConfig, RefinementConfig,
};
use crate::evaluation::RangeMclRules;
use crate::file_path::FilePath;
use crate::files::remove_abandoned;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::localization::State;
use crate::localization::odometry::demonstration_noise;
use crate::map::{Map, MapOptions};
use crate::odometry::{Odometer, OdometryConfig};
use crate::random::stream;
use crate::recording::layout::Layout;
use crate::recording::{Calibration, Frame, Recording};
use crate::refinement::{InitialEstimate, RefinedTrajectory, RefinerConfig, TrajectoryRefiner};
use crate::sensor::Sensor;
use crate::statistics::median;

/// Arguments of `refine`.
#[derive(Clone, Debug, Args, Serialize)]
pub struct RefineArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(flatten)]
    pub run: RunArgs,

    /// The recording.
    #[command(flatten)]
    #[serde(flatten)]
    pub recording: RecordingArgs,

    /// Recording; by default that of the localization. Sets the key `scan_folder`.
    #[arg(long = "recording", value_name = "RECORDING")]
    pub scan_folder: Option<FilePath>,

    /// Map; by default that of the localization. Sets the key `map_file`.
    #[arg(long = "map", value_name = "MAP")]
    pub map_file: Option<FilePath>,

    /// Standard deviations of the poses of a trajectory [m, deg]; sets the key `uncertainty`.
    #[arg(long, value_name = "POSITION,HEADING", value_parser = uncertainty)]
    pub uncertainty: Option<[f64; 2]>,

    /// True poses of the recording for the report; sets the key `pose_file`.
    #[arg(long = "truth", value_name = "FILE")]
    pub pose_file: Option<FilePath>,

    /// Calibration of the camera whose poses these, and those of a trajectory, are; sets the key `calib_file`.
    #[arg(long = "calib", value_name = "FILE")]
    pub calib_file: Option<FilePath>,

    /// Inertial sensor whose rates compensate scans: a table of times, rates and forces, a folder oxts, or a topic of the bag; by default that of the localization. Sets the key `imu_file`.
    #[arg(long = "imu", value_name = "FILE")]
    pub imu_file: Option<FilePath>,

    /// Result to write of a trajectory (.npz); sets the key `output_file`.
    #[arg(long = "output", value_name = "RESULT")]
    pub output_file: Option<FilePath>,
}

/// Parses the standard deviations of a position [m] and a heading [deg].
fn uncertainty(text: &str) -> Result<[f64; 2], &'static str> {
    numbers(
        text,
        "give those of the position in metres and of the heading in degrees, such as 2,15",
    )
}

/// Random stream of the noise on the odometry; the refiner has its own streams.
const ODOMETRY_STREAM: u64 = u64::MAX;

/// Refines the result that a configuration names, and adds the refined trajectory to it.
pub fn run(config: &RefinementConfig, context: &Context) -> Result<Report> {
    input::require_file("result_file", &config.result_file)?;
    let inputs = RecordingInputs::new(&config.recording, &config.given_poses);
    let files = RunFiles::new(&config.output());
    let (mut claims, main) = prepare(config, inputs, context, &files)?;
    let is_trajectory = config.is_trajectory();
    let mut results = if is_trajectory {
        LocalizationResults::default()
    } else {
        without_rounding_errors(LocalizationResults::read(&config.result_file)?)
    };
    let is_unfinished = claims.state(&main) == Some("unfinished");
    ensure!(
        results.refined.is_none() || config.output.force || is_unfinished,
        "{} already has refined poses; add --force to replace them",
        config.result_file.display()
    );
    run_output::warn_of_shortfall(&results, &config.result_file);
    let map = config.map_input.load(MapOptions::default(), context)?;
    let mut resolved = config.clone();
    let localization = (!is_trajectory).then(|| base_config(Some(&config.result_file)));
    let found = localization.filter(|localization| localization.recording == config.recording);
    let found = found.map(|localization| localization.sensor);
    let (sequence, sensor) = inputs.open_in_map(&map, &mut resolved.sensor, found.as_ref())?;
    let odometry = OdometryConfig::default();
    let sequence = (config.inertial).open_calibrated(sequence, &odometry, context)?;
    let config = &resolved;
    if is_trajectory {
        results = follow(config, &map, &sequence)?;
    }
    let sequence = frames_of(sequence, &results, config)?;
    let rules = RangeMclRules::default();
    let estimates = results.estimates_or_particle_means(&rules)?.into_owned();
    let increments = increments(config, &sequence, &results)?;
    let starts = if is_trajectory {
        let [position_m, heading_deg] = config.uncertainty;
        let deviations = [position_m, heading_deg.to_radians()];
        let times_s = results.times_s.as_deref();
        InitialEstimate::from_rough(&estimates, deviations, &increments, times_s)
    } else {
        initial_estimates(&results, &estimates, &increments)
    };
    let frames = &sequence.frames;
    let place = (&map, &sensor);
    let (refined, runtimes_s) = refine(config, context, place, frames, &starts, &increments)?;
    let truth = sequence.frames.iter().map(|frame| frame.map_from_lidar);
    let truth = truth.map(|pose| pose.unwrap_or_else(unknown_pose));
    let truth = sequence
        .track
        .is_some()
        .then(|| truth.collect::<Vec<Pose3>>());
    let planar = |truth: &[Pose3]| truth.iter().map(pose2_from_pose3).collect();
    results.ground_truth = (results.ground_truth.take()).or(truth.as_deref().map(planar));
    results.ground_truth_in_space = results
        .ground_truth_in_space
        .take()
        .or(truth.map(Into::into));
    let changes = refined.changes.iter();
    let changes = changes.map(|&it| run_output::before_and_after(it));
    let (costs_m, agreements): (Vec<_>, Vec<_>) = changes.unzip();
    results.refinement_costs_m = Some(costs_m.into());
    results.refinement_agreements = Some(agreements.into());
    let states = refined.states.iter().map(|state| *state as u8);
    results.refined_states = Some(states.collect());
    if is_trajectory {
        warn_of_distance(config, &estimates, &refined);
        results.states.clone_from(&results.refined_states);
    }
    results.estimates = Some(estimates.into());
    results.refined = Some(refined.poses.clone().into());
    results.refined_in_space = Some(refined.map_from_lidar.clone().into());
    results.refined_covariances = Some(refined.covariances.clone().into());
    results.refine_runtimes_s = Some(runtimes_s.into());
    claims.begin(&main)?;
    let report = write_run(config, context, &files, &map, &sequence, &results)?;
    claims.finish(&main)?;
    Ok(report)
}

/// The configuration for a result: that of its localization, which is next to it.
pub fn base_config(result: Option<&Path>) -> RefinementConfig {
    let Some(result) = result else {
        return RefinementConfig::default();
    };
    let path = RunFiles::new(result).file("effective_localization.yml");
    let found = settings::load::<LocalizationConfig>(Some(&path), &[]);
    found.map_or_else(
        |_missing| RefinementConfig::default(),
        |found| RefinementConfig {
            output: OutputConfig::default(),
            ..RefinementConfig::of(found)
        },
    )
}

/// Prepares the outputs, of which the second value is the main one: the result of a trajectory, or the effective
/// configuration of a result, which exists already.
fn prepare(
    config: &RefinementConfig,
    inputs: RecordingInputs,
    context: &Context,
    files: &RunFiles,
) -> Result<(Claims, PathBuf)> {
    let mut names: Vec<&str> = [&REPORT_FILES[..], &REFINEMENT_FILES].concat();
    names.push("ground_truth_poses.npy");
    names.extend(config.output.plots.then_some("plots"));
    let is_trajectory = config.is_trajectory();
    let (key, main) = if is_trajectory {
        ("output_file", files.result.clone())
    } else {
        ("result_file", files.file("effective_refinement.yml"))
    };
    ensure!(
        is_trajectory || fs::symlink_metadata(&config.result_file)?.is_file(),
        "result_file is {}, which is not a regular file; refine replaces it: give the path of the file itself",
        config.result_file.display()
    );
    let mut inputs = input_files(inputs, &config.map_input, &config.motion, context)?;
    let measurements = config.inertial.files(&config.recording);
    input::require(measurements.as_slice())?;
    inputs.extend(measurements);
    inputs.extend(is_trajectory.then_some(("result_file", config.result_file.as_path())));
    let outputs = Outputs {
        key,
        main: &main,
        magic: is_trajectory.then_some(NPZ),
        names: names.into_iter().map(str::to_owned).collect(),
        inputs,
        force: config.output.force || !is_trajectory,
    };
    let claims = outputs.prepare()?;
    remove_abandoned(&files.result)?;
    Ok((claims, main))
}

/// The frames of a recording that a trajectory has poses of, and these poses as a result.
fn follow(
    config: &RefinementConfig,
    map: &Map,
    sequence: &Recording,
) -> Result<LocalizationResults> {
    let track = RecordingInputs::new(&config.recording, &config.given_poses)
        .track(&config.result_file, sequence)?;
    // Poses of a lidar are in the frame of the map, those of a camera in the world of its drive.
    let world_from_map = if track.calibration == Calibration::identity() {
        Pose3::identity()
    } else {
        map.path.world_from_map
    };
    let track = track.in_map(&world_from_map);
    let poses = track.matched(&sequence.frames, sequence.has_times)?;
    let known: Vec<(&Frame, Pose3)> = (sequence.frames.iter().zip(poses))
        .filter_map(|(frame, pose)| Some((frame, pose?)))
        .collect();
    Ok(LocalizationResults {
        frames: known.iter().map(|(frame, _)| frame.number).collect(),
        estimates_in_space: Some(known.iter().map(|(_, pose)| *pose).collect()),
        times_s: Some(known.iter().map(|(frame, _)| frame.time_s).collect()),
        times_are_assumed: !sequence.has_times,
        ..LocalizationResults::default()
    })
}

/// The frames of the sequence that the result contains, in its order.
fn frames_of(
    mut sequence: Recording,
    results: &LocalizationResults,
    config: &RefinementConfig,
) -> Result<Recording> {
    sequence
        .frames
        .retain(|frame| results.frames.binary_search(&frame.number).is_ok());
    ensure!(
        sequence.frames.len() == results.len(),
        "{} has {} frames, of which start_idx, n_scans and frame_step select {}; select the frames that were localized",
        config.result_file.display(),
        results.len(),
        sequence.frames.len()
    );
    Ok(sequence)
}

/// A result whose estimates and odometry are on a lattice of a nanometre and a nanoradian: the same after they have
/// been written and read again, which changes their last bits, so that refining again gives the same poses.
fn without_rounding_errors(mut results: LocalizationResults) -> LocalizationResults {
    const PER_STEP: f64 = (1_u64 << 30) as f64;
    let rounded = |value: f64| (value * PER_STEP).round() / PER_STEP;
    let on_lattice = |pose: &mut Pose2| {
        let place = pose.translation.vector.map(rounded);
        *pose = Pose2::new(place, rounded(pose.rotation.angle()));
    };
    (results.estimates.iter_mut().flatten()).for_each(on_lattice);
    (results.odometry.iter_mut().flatten()).for_each(on_lattice);
    for pose in results.estimates_in_space.iter_mut().flatten() {
        let rotation = pose.rotation.scaled_axis().map(rounded);
        *pose = Pose3::new(pose.translation.vector.map(rounded), rotation);
    }
    results
}

/// The estimates with the states of the filter; a result without states was tracking throughout.
fn initial_estimates(
    results: &LocalizationResults,
    estimates: &[Pose2],
    increments: &[Option<Pose2>],
) -> Vec<InitialEstimate> {
    let numbers = results.states.as_deref();
    let state = |row: usize| State::from_number(numbers?[row]);
    let states: Vec<State> = (0..estimates.len())
        .map(|row| state(row).unwrap_or(State::Tracking))
        .collect();
    // Those of a trajectory may have any height.
    let is_of_filter = results.covariances.is_some();
    let in_space = results
        .estimates_in_space
        .as_deref()
        .filter(|_| is_of_filter);
    let (covariances, times_s) = (results.covariances.as_deref(), results.times_s.as_deref());
    InitialEstimate::from_filter(
        estimates,
        in_space,
        covariances,
        &states,
        increments,
        times_s,
    )
}

/// Refines all frames and smooths them; also returns the runtime of each frame [s].
fn refine(
    config: &RefinementConfig,
    context: &Context,
    (map, sensor): (&Map, &Sensor),
    frames: &[Frame],
    starts: &[InitialEstimate],
    increments: &[Option<Pose2>],
) -> Result<(RefinedTrajectory, Vec<f64>)> {
    context.interrupt.keeps(format!(
        "{} is unchanged: a trajectory is refined as a whole",
        config.result_file.display()
    ));
    let refiner = refiner_config(config, increments);
    let mut refiner = TrajectoryRefiner::new(map, sensor, refiner, config.seed)?;
    let mut runtimes_s = Vec::with_capacity(starts.len());
    let task = context.progress.task("refine", starts.len());
    for (frame, start) in frames.iter().zip(starts) {
        context.interrupt.check()?;
        let scan = frame.read()?;
        let started = Instant::now();
        refiner.add(&scan, start)?;
        runtimes_s.push(started.elapsed().as_secs_f64());
        task.advance(1);
    }
    drop(task);
    refiner.place_backwards(starts, increments, |row| {
        context.interrupt.check()?;
        anyhow::Ok(frames[row].read()?)
    })?;
    let known: Option<Vec<Pose2>> = increments.iter().copied().collect();
    let is_used = config.motion.odometry != OdometrySource::None;
    ensure!(known.is_some() || !is_used, "the odometry has gaps");
    let refined = refiner.finish(known.as_deref().filter(|_| is_used))?;
    report_unrefined(&refined, config.is_trajectory());
    Ok((refined, runtimes_s))
}

fn report_unrefined(refined: &RefinedTrajectory, is_trajectory: bool) {
    let smoothed = if refined.is_smoothed {
        ", only smoothed"
    } else {
        ""
    };
    if is_trajectory && refined.untracked > 0 {
        let moved = if refined.is_smoothed {
            "follow from the others by the odometry"
        } else {
            "are unchanged"
        };
        tracing::warn!(
            "{} of {} poses could not be placed in the map: they {moved}; their state is searching, and the trajectory is without them. If the trajectory may be farther off, give a larger --uncertainty",
            refined.untracked,
            refined.poses.len()
        );
    } else if refined.untracked > 0 {
        tracing::info!(
            "{} frames in which the filter was not tracking cannot be placed from their neighbours{smoothed}",
            refined.untracked
        );
    }
    if refined.unmapped > 0 {
        tracing::warn!(
            "{} frames are not refined{smoothed}: there is no mapped ground under the car, and without it their scans do not determine the pose, or the scans have no beams",
            refined.unmapped
        );
    }
}

/// Warns of placed poses that are farther from a trajectory than its uncertainty allows: it may be in another frame.
fn warn_of_distance(config: &RefinementConfig, estimates: &[Pose2], refined: &RefinedTrajectory) {
    /// Standard deviations within which the median of the distances is.
    const DEVIATIONS: f64 = 3.0;
    let [position_m, _] = config.uncertainty;
    let rows = estimates.iter().zip(&refined.poses).zip(&refined.states);
    let placed = rows.filter(|(_, state)| **state == State::Tracking);
    let distances_m =
        placed.map(|((a, b), _)| (b.translation.vector - a.translation.vector).norm());
    if let Some(median_m) = median(distances_m)
        && median_m > DEVIATIONS * position_m
    {
        tracing::warn!(
            "half of the placed poses are {median_m:.1} m or more from the trajectory, whose uncertainty is {position_m} m: is it in the frame of the map, or is a calibration missing?"
        );
    }
}

/// The odometry into each frame: that of the localization, where the result contains it.
fn increments(
    config: &RefinementConfig,
    sequence: &Recording,
    results: &LocalizationResults,
) -> Result<Vec<Option<Pose2>>> {
    let is_new =
        config.motion.odometry == OdometrySource::None || config.motion.odometry_file.is_some();
    if let (Some(recorded), false) = (&results.odometry, is_new) {
        return Ok(recorded.iter().copied().map(Some).collect());
    }
    let (mut motion, _file) = MotionSource::open(
        &config.motion,
        &RecordingInputs::new(&config.recording, &config.given_poses),
        sequence,
        &mut stream(config.seed, ODOMETRY_STREAM),
    )?;
    let mut between = motion.take_frames_between();
    let mut odometer = Odometer::new(OdometryConfig::default())?;
    let into_frame = |(row, frame): (usize, &Frame)| {
        if !matches!(motion, MotionSource::Scans(_)) {
            return Ok(motion
                .given_over(row..row + 1)
                .map(|motion| motion.increment));
        }
        let mut increment = Pose3::identity();
        let passed = MotionSource::frames_before(&mut between, frame);
        for frame in passed.chain([frame.clone()]) {
            increment *= odometer.step(&frame.read()?)?.previous_from_current;
        }
        Ok(Some(pose2_from_pose3(&increment)))
    };
    sequence.frames.iter().enumerate().map(into_frame).collect()
}

/// The configuration of the refiner; the noise that the demonstration adds to the true odometry is
/// never assumed smaller than it is.
fn refiner_config(config: &RefinementConfig, increments: &[Option<Pose2>]) -> RefinerConfig {
    let mut refiner = config.refiner.clone();
    if config.motion.odometry == OdometrySource::GroundTruth {
        let smoothing = &mut refiner.refinement.smoothing;
        // The first has no motion into it.
        let steps_m = increments.iter().skip(1).flatten();
        let step_m = median(steps_m.map(|step| step.translation.vector.norm()));
        *smoothing = smoothing.with_noise(&demonstration_noise(), step_m.unwrap_or(0.0));
    }
    refiner
}

/// Writes results, report, plots and page, and returns the report.
fn write_run(
    config: &RefinementConfig,
    context: &Context,
    files: &RunFiles,
    map: &Map,
    sequence: &Recording,
    results: &LocalizationResults,
) -> Result<Report> {
    let saving = context.interrupt.saving();
    run_output::write_results(files, results)?;
    let refined = Trajectory::refined(results, &sequence.frames);
    refined.write(files, "refined", sequence, config.all_poses)?;
    refined.write_geojson(files, "refined", map, config.all_poses)?;
    output::write_yaml(&files.file("effective_refinement.yml"), config)?;
    let odometry = match (config.motion.odometry, &config.motion.odometry_file) {
        // It may be that of a topic.
        (OdometrySource::Auto, None) if sequence.files.layout == Layout::Bag => {
            "that of the localization".to_owned()
        }
        _ => motion_source::description(&config.motion),
    };
    let inputs = (&config.recording, &config.map_input);
    let mut about = run_output::about(results, inputs, map, odometry, config.seed);
    about.extend(run_output::inertial(&config.inertial, &sequence.frames));
    let report = run_output::evaluate(results, &RangeMclRules::default(), about)?;
    run_output::write_report(files, results, &report)?;
    let path = config.result_file.display();
    context.interrupt.keeps(format!(
        "the refined trajectory is kept in {path}; plots are missing"
    ));
    drop(saving);
    if config.output.plots {
        let mesh = run_output::map_around(map, results.estimates.iter().flatten())?;
        run_output::draw_run(files, Some(&mesh), results)?;
    }
    run_page::write(files, &report)?;
    Ok(report)
}
