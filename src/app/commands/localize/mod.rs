//! `localize`: localizes a recording in a map, scan by scan.

mod recorder;

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Args;
use nalgebra::Vector2;
use serde::Serialize;

use self::recorder::Run;
use super::motion_source;
use super::motion_source::{FrameMotion, MotionSource};
use super::stages::{RecordingInputs, input_files};
use crate::app::report::run_output::{self, LOCALIZATION_FILES, REFINEMENT_FILES, REPORT_FILES};
use crate::app::report::{LocalizationResults, Report, RunFiles, run_page};
use crate::app::run::arguments::numbers;
use crate::app::run::{Claims, Context, Interrupted, NPZ, Outputs, RunArgs, input, output};
use crate::app::settings::{Initialization, LocalizationConfig, MotionModel};
use crate::evaluation::RangeMclRules;
use crate::geometry::Pose2;
use crate::localization::motion::VelocityCommand;
use crate::localization::{Odometry, Start, State, Tracker, TrackerConfig};
use crate::map::Map;
use crate::random::stream;
use crate::recording::Recording;
use crate::refinement::{InitialEstimate, TrajectoryRefiner};
use crate::sensor::Sensor;

/// Arguments of `localize`.
#[derive(Clone, Debug, Args, Serialize)]
pub struct LocalizeArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(flatten)]
    pub run: RunArgs,

    /// Map of `build-map` or range-mcl, or a mesh (.ply, .obj, .stl); sets the key `map_file`.
    #[arg(long = "map", value_name = "MAP")]
    pub map_file: Option<PathBuf>,

    /// Start in the map [m, deg], if it is known; sets the key `initial_pose`.
    #[arg(long, value_name = "X,Y,HEADING", value_parser = start_pose, allow_hyphen_values = true)]
    #[serde(rename = "initial_pose")]
    pub start: Option<[f64; 3]>,

    /// Odometry, rows of KITTI or TUM, or a topic of the bag; by default the topic of odometry that a bag has, else the scans. Sets the key `odometry_file`.
    #[arg(long = "odometry", value_name = "FILE")]
    pub odometry_file: Option<PathBuf>,

    /// True poses of the recording for the report; sets the key `pose_file`.
    #[arg(long = "truth", value_name = "FILE")]
    pub pose_file: Option<PathBuf>,

    /// Calibration of the camera whose poses these are; sets the key `calib_file`.
    #[arg(long = "calib", value_name = "FILE")]
    pub calib_file: Option<PathBuf>,

    /// Result to write (.npz); sets the key `result_path`.
    #[arg(long = "output", value_name = "RESULT")]
    pub result_path: Option<PathBuf>,

    /// Log to write afterwards, for Foxglove and rerun (.mcap), as `export` does.
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub mcap: Option<PathBuf>,
}

/// Parses a start: x, y [m], heading [deg].
fn start_pose(text: &str) -> Result<[f64; 3], &'static str> {
    let help = "give x and y in the map in metres and the heading in degrees, such as 12.5,-3,90";
    numbers(text, help)
}

/// Random stream of the noise on the odometry; the localizer has its own streams.
const ODOMETRY_STREAM: u64 = 1;

/// Localizes the selected frames of a recording.
pub fn run(config: &LocalizationConfig, context: &Context) -> Result<Report> {
    input::require_file("map_file", &config.map_input.map_file)?;
    let inputs = RecordingInputs::new(&config.recording, &config.given_poses);
    inputs.require()?;
    let files = RunFiles::new(&config.result_path);
    context.interrupt.keeps("no frame was finished");
    let claims = prepare(config, context, &files)?;
    let map = config.map_input.load(config.map_options(), context)?;
    let mut resolved = config.clone();
    let (sequence, sensor) = inputs.open_in_map(&map, &mut resolved.tracker.sensor)?;
    let (motion, odometry_file) = MotionSource::open(
        &config.motion,
        &inputs,
        &sequence,
        &mut stream(config.tracker.seed, ODOMETRY_STREAM),
    )?;
    resolved.motion.odometry_file = odometry_file;
    let config = &resolved;
    let motion = Mutex::new(motion);
    let frames = sequence.frames.len();
    let run = Mutex::new(Run::new(config, &map, &files, frames, claims)?);
    let recorded = || run.lock().unwrap_or_else(PoisonError::into_inner);
    let kept = |run: &Run| run.kept(config, frames);
    context.interrupt.supervise(
        || {
            localize(
                config, context, &map, &sensor, &sequence, &motion, &recorded,
            )?;
            let mut run = recorded();
            run.complete()?;
            write_results(config, &files, &sequence, &mut run)?;
            context.interrupt.keeps(kept(&run));
            anyhow::Ok(())
        },
        || {
            let mut run = recorded();
            write_results(config, &files, &sequence, &mut run)?;
            Ok(kept(&run))
        },
    )?;
    let mut run = run.into_inner().unwrap_or_else(PoisonError::into_inner);
    let report = write_run(config, context, &files, &map, &sequence, &mut run)?;
    run.finish(config, frames)?;
    Ok(report)
}

/// Prepares the configured outputs.
fn prepare(config: &LocalizationConfig, context: &Context, files: &RunFiles) -> Result<Claims> {
    let mut names = Vec::new();
    if config.save_result {
        names.extend(REPORT_FILES.iter().chain(&LOCALIZATION_FILES));
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
        inputs: input_files(
            RecordingInputs::new(&config.recording, &config.given_poses),
            &config.map_input,
            &config.motion,
            context,
        ),
        force: config.output.force,
    };
    run_output::prepare(files, &outputs)
}

/// Localizes frames until the end, an interruption or an error, which is recorded.
fn localize<'a>(
    config: &LocalizationConfig,
    context: &Context,
    map: &Map,
    sensor: &Sensor,
    sequence: &Recording,
    motion: &Mutex<MotionSource>,
    recorded: &dyn Fn() -> MutexGuard<'a, Run>,
) -> Result<()> {
    let start = start(config, map, sequence);
    let mut motion = motion.lock().unwrap_or_else(PoisonError::into_inner);
    let tracker = TrackerConfig {
        odometry: (config.tracker.odometry.clone())
            .filter(|_| matches!(*motion, MotionSource::Scans(_))),
        ..config.tracker.clone()
    };
    let tracker = Tracker::new(map, tracker)?.with_sensor(sensor.clone());
    let mut tracker = tracker.with_start(start);
    let refiner = || TrajectoryRefiner::new(map, sensor, config.refiner(), config.tracker.seed);
    let mut refiner = config.refine.then(refiner).transpose()?;
    let task = context.progress.task("localize", sequence.frames.len());
    for (row, frame) in sequence.frames.iter().enumerate() {
        if context.interrupt.requested() {
            break;
        }
        let mut process = || {
            let scan = frame.read()?;
            let started = Instant::now();
            for between in motion.frames_before(frame) {
                tracker.pass(&between.read()?)?;
            }
            let known = match tracker.measure(&scan)? {
                Odometry::Motion(motion) => Some(FrameMotion::from_motion(motion)),
                _ => motion.given_to(row),
            };
            let increment = known.map(|motion| motion.increment);
            let odometry = odometry_into(config.motion_model, known, sequence, row);
            let estimate = tracker.step_with_motion(&scan, odometry)?;
            let runtime = started.elapsed();
            let refined = match &mut refiner {
                Some(refiner) => Some(refiner.add(&scan, &InitialEstimate::from(&estimate))?),
                None => None,
            };
            let runtimes = [runtime, started.elapsed() - runtime];
            recorded().record(frame, increment, &scan, &estimate, refined, runtimes)
        };
        if let Err(error) = process() {
            recorded().failure = Some(error);
            break;
        }
        task.advance(1);
    }
    Ok(())
}

/// Where the particles start.
fn start(config: &LocalizationConfig, map: &Map, recording: &Recording) -> Start {
    let spread = config.start.clone();
    match (config.initialization(), config.initial_pose) {
        (Initialization::Tracking, Some([x, y, heading_deg])) => Start::Pose {
            map_from_lidar: Pose2::new(Vector2::new(x, y), heading_deg.to_radians()),
            height_m: None,
            spread,
        },
        (Initialization::Tracking, None) => {
            let truth = recording.frames[0].map_from_lidar.unwrap_or_default();
            Start::near(&truth, spread)
        }
        (Initialization::Corridor, _) => Start::Road,
        (Initialization::Extent, _) if config.initialization.is_some() => Start::Anywhere,
        (Initialization::Extent, _) => {
            let start = Start::unknown(map);
            if start == Start::Road {
                tracing::info!(
                    "the map is large: an unknown start is searched along its road; set initialization to extent to search all ground"
                );
            }
            start
        }
    }
}

/// The odometry into a frame, in the form that the motion model needs.
fn odometry_into(
    model: MotionModel,
    motion: Option<FrameMotion>,
    sequence: &Recording,
    row: usize,
) -> Odometry {
    let Some(FrameMotion {
        increment,
        in_space,
    }) = motion
    else {
        return Odometry::Unknown;
    };
    match model {
        MotionModel::TurnDriveTurn => {
            in_space.map_or(Odometry::Increment(increment), Odometry::Motion)
        }
        MotionModel::Velocity => {
            let times_s = [row.saturating_sub(1), row].map(|row| sequence.frames[row].time_s);
            let duration = Duration::from_secs_f64((times_s[1] - times_s[0]).max(0.0));
            Odometry::Velocity(VelocityCommand::driving(&increment, duration))
        }
    }
}

/// Writes results and trajectories.
fn write_results(
    config: &LocalizationConfig,
    files: &RunFiles,
    sequence: &Recording,
    run: &mut Run,
) -> Result<()> {
    if !config.save_result || run.results.is_empty() {
        return Ok(());
    }
    run.claims.begin(&files.result)?;
    run_output::write_results(files, &run.results)?;
    run_output::write_trajectory(files, "mcl", sequence, run.estimates())?;
    if config.refine {
        let refined = run.results.refined_in_space.as_deref();
        run_output::write_trajectory(files, "refined", sequence, refined.unwrap_or_default())?;
    } else {
        run.claims.remove(&REFINEMENT_FILES)?;
    }
    output::write_yaml(&files.file("effective_localization.yml"), config)?;
    // The frames of an interrupted run are kept; a whole run lacks its report and pictures still.
    match run.results.len() < sequence.frames.len() {
        true => run.claims.finish(&files.result),
        false => Ok(()),
    }
}

/// Writes report, plots and page, and returns the report.
fn write_run(
    config: &LocalizationConfig,
    context: &Context,
    files: &RunFiles,
    map: &Map,
    sequence: &Recording,
    run: &mut Run,
) -> Result<Report> {
    let results = &run.results;
    warn_of_untracked_frames(results);
    let localizer = &config.tracker.localizer;
    let [most, reduced] = [localizer.num_particles, localizer.num_reduced];
    let (odometry, seed) = (
        motion_source::description(&config.motion),
        config.tracker.seed,
    );
    let inputs = (&config.recording, &config.map_input);
    let mut about = run_output::about(results, inputs, map, odometry, seed);
    about.extend([
        ("threads".to_owned(), context.threads.to_string()),
        (
            "particles".to_owned(),
            format!("{most} reduced to {reduced}"),
        ),
        ("states".to_owned(), states_in_words(results)),
    ]);
    let report = run_output::evaluate(results, &RangeMclRules::default(), about)?;
    if config.save_result {
        run_output::write_report(files, results, &report)?;
    }
    if config.output.plots {
        let mesh = run_output::map_around(map, results.estimates.iter().flatten())?;
        run_output::draw_run(files, Some(&mesh), results)?;
        let row = results.len() / 2;
        let (frame, pose) = (&sequence.frames[row], &run.estimates()[row]);
        let model = config.tracker.sensor.range_image.model();
        run_output::draw_range_images(files, map, frame, pose, &model)?;
    }
    if config.save_result {
        run_page::write(files, &report)?;
        run.claims.finish(&files.result)?;
    }
    Ok(report)
}

/// Numbers of frames in each state, in words.
fn states_in_words(results: &LocalizationResults) -> String {
    let states = results.states.as_deref().unwrap_or_default();
    let words = [State::Tracking, State::Searching, State::Lost].map(|state| {
        let count = states.iter().filter(|&&found| found == state as u8).count();
        format!("{} in {count}", state.word())
    });
    format!("{} of {} frames", words.join(", "), states.len())
}

/// Warns of frames in which the filter was not tracking.
fn warn_of_untracked_frames(results: &LocalizationResults) {
    let states = results.states.as_deref().unwrap_or_default();
    let is_tracking = |state: &u8| *state == State::Tracking as u8;
    match states.iter().position(is_tracking) {
        None => tracing::warn!(
            "the filter converged in none of {} frames: the car may not be in the map, or did not drive far enough; the poses must not be used",
            states.len()
        ),
        Some(first) => {
            if !states[first..].iter().all(is_tracking) {
                tracing::warn!(
                    "tracking was lost on the way ({}); frames.csv lists the state of each",
                    states_in_words(results)
                );
            }
            if 2 * first > states.len() {
                tracing::warn!(
                    "the first {first} of {} frames were not localized: frames.csv lists the state of each",
                    states.len()
                );
            }
        }
    }
}

impl Run {
    /// What is kept of the run after an interruption.
    fn kept(&self, config: &LocalizationConfig, frames: usize) -> String {
        let found = self.results.len();
        if found == 0 {
            "no frame was finished".to_owned()
        } else if config.save_result {
            let path = config.result_path.display();
            format!("{found} of {frames} frames are localized and kept in {path}")
        } else {
            format!(
                "{found} of {frames} frames were localized; nothing is kept: save_result is False"
            )
        }
    }

    /// Finishes the animation; an error where not all frames were localized, which names what is kept.
    fn finish(self, config: &LocalizationConfig, frames: usize) -> Result<()> {
        let kept = self.kept(config, frames);
        let animation = self.movie.map_or(Ok(()), |movie| movie.finish());
        let failure = self.failure.or(animation.err());
        let found = self.results.len();
        if found == frames && failure.is_none() {
            if !config.save_result {
                tracing::warn!("the result is not kept: save_result is False");
            }
            return Ok(());
        }
        Err(match failure {
            Some(failure) => failure.context(kept),
            None => Interrupted { kept }.into(),
        })
    }
}
