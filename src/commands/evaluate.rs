//! `evaluate`: how far a result is from the truth.

use anyhow::{Result, ensure};

use super::input;
use super::run_output::{self, RunFiles};
use crate::config::{self, EvaluationConfig};
use crate::evaluation::{LocalizationResults, RangeMclRules, Report};
use crate::geometry::{Pose2, planar};
use crate::kitti::Calibration;
use crate::kitti::poses::CameraPoses;

/// Judges a result of `localize`, of `refine` or of range-mcl.
pub fn run(config: &EvaluationConfig) -> Result<Report> {
    input::require_file("result_file", &config.result_file)?;
    let mut results = LocalizationResults::read(&config.result_file)?;
    scale(&mut results, config.grid_resolution);
    if results.ground_truth.is_none() {
        results.ground_truth = Some(truth(config, &results)?);
    } else {
        tracing::info!(
            "the ground truth in {} is used",
            config.result_file.display()
        );
    }
    let mut results = selected(results, config);
    ensure!(
        !results.is_empty(),
        "no frame of {} is selected; check start_idx, n_scans and frame_step",
        config.result_file.display()
    );
    let rules = RangeMclRules {
        convergence_interval: config.convergence_interval,
        converge_thres: config.converge_thres,
        particle_select_ratio: config.particle_select_ratio,
    };
    if results.estimates.is_none() {
        results.estimates = Some(rules.estimates(&results)?);
    }
    let about = [("result", config.result_file.display().to_string())]
        .map(|(key, value)| (key.to_owned(), value));
    let report = run_output::judge(&results, &rules, about.into())?;
    let files = RunFiles::beside(&config.result_file);
    if config.save_evaluation_results {
        run_output::write_report(&files, &results, &report)?;
        config::write(&files.file("evaluation.yml"), config)?;
    }
    if config.plot_loc_traj {
        run_output::draw_run(&files, None, &results)?;
    }
    Ok(report)
}

/// Positions in metres, for results that are in cells.
fn scale(results: &mut LocalizationResults, grid_resolution_m: f64) {
    if grid_resolution_m == 1.0 {
        return;
    }
    let columns = [&mut results.estimates, &mut results.refined];
    for pose in columns.into_iter().flatten().flatten() {
        pose.translation.vector *= grid_resolution_m;
    }
    results.particles.scale_positions(grid_resolution_m as f32);
}

/// The true poses of the frames of a result, in the frame of the recording's first pose.
fn truth(config: &EvaluationConfig, results: &LocalizationResults) -> Result<Vec<Pose2>> {
    input::require_file("pose_file", &config.pose_file)?;
    input::require_file("calib_file", &config.calib_file)?;
    let calibration = Calibration::read(&config.calib_file)?;
    let poses = CameraPoses::read(&config.pose_file)?.map_from_lidar(&calibration);
    let last = results.frames.last().copied().unwrap_or_default();
    ensure!(
        last < poses.len(),
        "{} has {} poses, but the result reaches frame {last}; pose_file and result_file belong to different recordings",
        config.pose_file.display(),
        poses.len()
    );
    Ok(results
        .frames
        .iter()
        .map(|&frame| planar(&poses[frame]))
        .collect())
}

/// The frames that the configuration selects.
fn selected(results: LocalizationResults, config: &EvaluationConfig) -> LocalizationResults {
    let window = usize::try_from(config.n_scans).unwrap_or(usize::MAX);
    let end = config.start_idx.saturating_add(window);
    let rows: Vec<usize> = (0..results.len())
        .filter(|&row| {
            let frame = results.frames[row];
            (config.start_idx..end).contains(&frame)
        })
        .step_by(config.frame_step)
        .collect();
    if rows.len() == results.len() {
        results
    } else {
        results.rows(&rows)
    }
}
