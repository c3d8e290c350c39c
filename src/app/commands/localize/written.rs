//! What a localization writes: results, trajectories, report, plots and page.

use anyhow::Result;

use super::super::motion_source;
use super::opened::Opened;
use super::recorder::Run;
use crate::app::report::run_output::{self, REFINEMENT_FILES, Trajectory};
use crate::app::report::{LocalizationResults, Report, run_page};
use crate::app::run::{Context, output};
use crate::app::settings::OdometrySource;
use crate::evaluation::RangeMclRules;
use crate::localization::State;

/// Completes the result.
pub fn write_results(opened: &Opened, run: &mut Run) -> Result<()> {
    let Opened { config, files, .. } = opened;
    if !config.save_result || run.results.is_empty() {
        return Ok(());
    }
    run.claims.begin(&files.result)?;
    if !config.refine {
        run.claims.remove(&REFINEMENT_FILES)?;
    }
    run.finish_result()?;
    // The frames of an interrupted run are kept; a whole run lacks its report and pictures still.
    if run.is_complete(opened) {
        Ok(())
    } else {
        run.claims.finish(&files.result)
    }
}

/// Writes trajectories and configuration.
pub fn write_trajectories(opened: &Opened, run: &Run) -> Result<()> {
    let Opened {
        config,
        files,
        map,
        recording,
        ..
    } = opened;
    if !config.save_result || run.results.is_empty() {
        return Ok(());
    }
    run_output::write_poses(files, &run.results)?;
    let results = &run.results;
    let frames = run.frames(opened);
    let mcl = Trajectory::of_filter(results, &frames);
    mcl.write(files, "mcl", recording, config.all_poses)?;
    mcl.write_geojson(files, "mcl", map, config.all_poses)?;
    if config.refine {
        let refined = Trajectory::refined(results, &frames);
        refined.write(files, "refined", recording, config.all_poses)?;
        refined.write_geojson(files, "refined", map, config.all_poses)?;
    }
    output::write_yaml(&files.file("effective_localization.yml"), config)
}

/// Writes report, plots and page, and returns the report.
pub fn write_run(opened: &Opened, run: &mut Run, context: &Context) -> Result<Report> {
    let Opened {
        config,
        files,
        map,
        sensor,
        recording,
    } = opened;
    let results = &run.results;
    warn_of_untracked_frames(results);
    let localizer = &config.tracker.localizer;
    let [most, reduced] = [localizer.num_particles, localizer.num_reduced];
    let odometry = match (config.motion.odometry, &config.motion.odometry_file) {
        (OdometrySource::Auto, None) if opened.is_driving() => {
            "that of /tf, where it has any, else from the scans".to_owned()
        }
        _ => motion_source::description(&config.motion),
    };
    let seed = config.tracker.seed;
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
    about.extend(run_output::inertial(&config.inertial, &recording.frames));
    let report = Report {
        live: run.live.clone(),
        ..run_output::evaluate(results, &RangeMclRules::default(), about)?
    };
    if config.save_result {
        run_output::write_report(files, results, &report)?;
    }
    if config.output.plots {
        let mesh = run_output::map_around(map, results.estimates.iter().flatten())?;
        run_output::draw_run(files, Some(&mesh), results)?;
        let frames = run.frames(opened);
        let mcl = Trajectory::of_filter(results, &frames);
        if let (Some((frame, pose)), Some(sensor)) = (mcl.middle(), sensor) {
            run_output::draw_range_images(files, map, frame, pose, &sensor.range_image)?;
        }
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
            let unfilled = results
                .trusted()
                .iter()
                .take_while(|trusted| !**trusted)
                .count();
            if 2 * unfilled > states.len() {
                tracing::warn!(
                    "the first {unfilled} of {} frames were not localized: frames.csv lists the state of each",
                    states.len()
                );
            }
        }
    }
}
