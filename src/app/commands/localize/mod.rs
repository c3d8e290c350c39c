//! `localize`: where the car is in a map, scan by scan.

mod drive;
mod pictures;
mod recorder;

use std::path::Path;

use anyhow::Result;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use self::drive::{Drive, global_start, motion, panoramas};
use self::pictures::draw_example;
use self::recorder::Recorder;
use super::interrupt::Interrupted;
use super::run_output::{self, Movie, RunFiles};
use super::stages::{Inputs, LoadedMap, Observer, mapping_file};
use super::{Context, odometry, run_page};
use crate::app::config::{self, LocalizationConfig};
use crate::app::results::{LocalizationResults, Report};
use crate::evaluation::RangeMclRules;
use crate::geometry::{Pose2, Pose3};
use crate::ground::{FuzzyConfig, FuzzyGround};
use crate::localization::State;
use crate::map::Stance;
use crate::recording::Sequence;

/// Which random stream belongs to what; the streams of frames follow.
const INITIALIZATION_STREAM: u64 = 0;
const ODOMETRY_STREAM: u64 = 1;
const FIRST_FRAME_STREAM: u64 = 2;

/// Localizes the frames that a configuration selects.
pub fn run(config: &LocalizationConfig, context: &Context) -> Result<Report> {
    let inputs = Inputs {
        map_file: &config.map_file,
        map_pose_file: mapping_file("map_pose_file", config.map_pose_file.as_deref())?,
        map_calib_file: mapping_file("map_calib_file", config.map_calib_file.as_deref())?,
        scan_folder: &config.scan_folder,
        pose_file: &config.pose_file,
        calib_file: &config.calib_file,
    };
    inputs.require()?;
    let files = RunFiles::beside(&config.result_path);
    if config.save_result || config.plot_loc_results || config.visualize {
        run_output::prepare(&files, "result_path", config.force)?;
    }
    let map = LoadedMap::load(&inputs, Some(config.range_image.batch_size()), context)?;
    let sequence = map.sequence(&inputs, &config.selection())?;
    let increments = odometry::read_increments(
        config.odometry,
        config.odometry_file.as_deref(),
        &sequence,
        &mut stream(config.seed, ODOMETRY_STREAM),
    )?;
    let sequence = odometry::compensated(sequence, config.motion_compensation, &increments);
    let run = localize(config, context, &map, &sequence, &increments, &files)?;
    let Run {
        results,
        lifted,
        refined,
        movie,
        mut failure,
    } = run;
    let about = about(config, context, &map);
    if config.save_result {
        run_output::write_results(&files, &results)?;
        run_output::write_trajectory(&files, "mcl", &sequence, &lifted)?;
        if config.refine {
            run_output::write_trajectory(&files, "refined", &sequence, &refined)?;
        } else {
            run_output::remove_refined(&files)?;
        }
        config::write(&files.file("localization.yml"), config)?;
    }
    tell_of_doubt(&results);
    let report = run_output::evaluate(&results, &RangeMclRules::default(), about)?;
    if config.save_result {
        run_output::write_report(&files, &results, &report)?;
    }
    if config.plot_loc_results {
        run_output::draw_run(&files, Some(&map.mesh), &results)?;
        draw_example(config, &files, &map, &sequence, &lifted)?;
    }
    if config.save_result {
        run_page::write(&files, &report)?;
    }
    if let Some(movie) = movie
        && let Err(error) = movie.finish()
    {
        failure.get_or_insert(error);
    }
    let is_whole = results.len() == sequence.frames.len();
    if is_whole && failure.is_none() {
        if !config.save_result {
            tracing::warn!("the result is not kept: save_result is False");
        }
        return Ok(report);
    }
    let (found, all) = (results.len(), sequence.frames.len());
    let kept = if config.save_result {
        let path = config.result_path.display();
        format!("{found} of {all} frames are localized and kept in {path}")
    } else {
        format!("{found} of {all} frames were localized, and nothing is kept: save_result is False")
    };
    Err(match failure {
        Some(failure) => failure.context(kept),
        None => Interrupted { kept }.into(),
    })
}

/// What the filter made of the frames up to where it came.
struct Run {
    results: LocalizationResults,
    /// The estimates in space.
    lifted: Vec<Pose3>,
    /// The refined poses in space; none unless frames are refined.
    refined: Vec<Pose3>,
    /// Why it did not come to the end, unless that was wished.
    failure: Option<anyhow::Error>,
    /// The pictures of the frames, if they are wanted.
    movie: Option<Movie>,
}

/// Says where the filter was not sure.
fn tell_of_doubt(results: &LocalizationResults) {
    let states = results.states.as_deref().unwrap_or_default();
    let is_sure = |state: &u8| *state == State::Tracking as u8;
    match states.iter().position(is_sure) {
        None => tracing::warn!(
            "the filter was not sure of any of {} frames: the car is perhaps not in the map, or did not drive far enough to tell",
            states.len()
        ),
        Some(first) => {
            let doubtful = states[first..]
                .iter()
                .filter(|&state| !is_sure(state))
                .count();
            if doubtful > 0 {
                tracing::warn!(
                    "the filter lost its way in {doubtful} of {} frames; frames.csv has the state of each",
                    states.len()
                );
            }
        }
    }
}

/// Runs the filter over the frames, as far as it comes; an error only where no frame was finished.
fn localize(
    config: &LocalizationConfig,
    context: &Context,
    map: &LoadedMap,
    sequence: &Sequence,
    increments: &[Option<Pose2>],
    files: &RunFiles,
) -> Result<Run> {
    let classifier = FuzzyGround::new(FuzzyConfig::default())?;
    let observer = Observer {
        model: config.range_image.model(),
        own_car_m: config.own_car_m,
        classifier: &classifier,
    };
    let panoramas = panoramas(config, map);
    let global_start = global_start(config, &panoramas)?;
    let mut recorder = Recorder::new(config, map, files);
    let mut drive = Drive {
        config,
        map,
        observer: &observer,
        panoramas: &panoramas,
        global_start,
        localizer: None,
        stance: Stance::default(),
    };
    let mut failure = None;
    let task = context.progress.task("localize", sequence.frames.len());
    for (row, frame) in sequence.frames.iter().enumerate() {
        if context.interrupt.requested() {
            break;
        }
        let moved = motion(config.motion_model, increments[row], sequence, row);
        let said = drive
            .take_in(row, frame, moved)
            .and_then(|said| recorder.record(frame, increments[row], said));
        if let Err(error) = said {
            failure = Some(error);
            break;
        }
        task.advance(1);
    }
    drop(task);
    let run = recorder.finish(failure);
    match (run.results.is_empty(), run.failure) {
        (false, failure) => Ok(Run { failure, ..run }),
        (true, Some(failure)) => Err(failure),
        (true, None) => {
            let kept = "no frame was finished".to_owned();
            Err(Interrupted { kept }.into())
        }
    }
}

/// What was run, for the report.
fn about(
    config: &LocalizationConfig,
    context: &Context,
    map: &LoadedMap,
) -> std::collections::BTreeMap<String, String> {
    let path = |path: &Path| path.display().to_string();
    [
        ("recording", path(&config.scan_folder)),
        ("map", path(&config.map_file)),
        (
            "odometry",
            odometry::description(config.odometry, config.odometry_file.as_deref()),
        ),
        ("renderer", map.renderer.name()),
        ("seed", config.seed.to_string()),
        ("threads", context.threads.to_string()),
        (
            "particles",
            format!("{} reduced to {}", config.num_particles, config.num_reduced),
        ),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}

/// The generator of a stream: the same whatever happens in the others.
fn stream(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}
