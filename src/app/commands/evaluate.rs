//! `evaluate`: the errors of a result.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Result, ensure};

use super::claims::{Claims, Outputs};
use super::run_output::{self, REPORT_FILES, RunFiles};
use super::{Context, input, output, run_page};
use crate::app::config::{self, EvaluationConfig, LocalizationConfig};
use crate::app::results::{LocalizationResults, Report};
use crate::evaluation::RangeMclRules;
use crate::files::folder_of;
use crate::geometry::{Pose3, TriangleMesh, pose2_from_pose3};
use crate::map::{MappingPath, mesh_file};
use crate::recording::PoseTrack;

/// Compares a result of `localize`, `refine` or range-mcl with the ground truth.
pub fn run(config: &EvaluationConfig, context: &Context) -> Result<Report> {
    input::require_file("result_file", &config.result_file)?;
    let files = RunFiles::beside(&config.result_file);
    let main = files.file("effective_evaluation.yml");
    let mut claims = prepare(config, context, &main)?;
    let mut results = LocalizationResults::read(&config.result_file)?;
    run_output::warn_of_shortfall(&results, &config.result_file);
    let mut about = about(config, &files)?;
    about.extend(run_output::shortfall(&results));
    scale(&mut results, config.grid_resolution);
    let map = match config.pose_file.is_some() || config.plot_loc_traj {
        true => map_of(&files)?,
        false => None,
    };
    if let Some(pose_file) = &config.pose_file {
        let path = map.as_ref().and_then(|(_, path)| path.as_ref());
        let truth = truth(pose_file, config, &results, path)?;
        results.ground_truth = Some(truth.iter().map(pose2_from_pose3).collect());
        results.ground_truth_in_space = Some(truth);
    }
    ensure!(
        results.ground_truth.is_some(),
        "{} has no ground truth; set pose_file and calib_file to the poses of its recording",
        config.result_file.display()
    );
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
    results.estimates = Some(results.estimates_or_particle_means(&rules)?);
    let report = run_output::evaluate(&results, &rules, about)?;
    if config.save_evaluation_results {
        claims.begin(&main)?;
        run_output::write_report(&files, &results, &report)?;
        output::write_yaml(&main, config)?;
    }
    if config.plot_loc_traj {
        let mesh = map.as_ref().map(|(mesh, _)| mesh);
        run_output::draw_run(&files, mesh, &results)?;
    }
    if config.save_evaluation_results {
        run_page::write(&files, &report)?;
        claims.finish(&main)?;
    }
    Ok(report)
}

/// Prepares the configured outputs; the effective configuration is the main one.
fn prepare(config: &EvaluationConfig, context: &Context, main: &Path) -> Result<Claims> {
    let reports = REPORT_FILES.iter();
    let mut names: Vec<&str> = reports
        .copied()
        .filter(|_| config.save_evaluation_results)
        .collect();
    names.extend(config.plot_loc_traj.then_some("plots"));
    if names.is_empty() {
        return Claims::read(folder_of(main));
    }
    let optional = [
        ("pose_file", &config.pose_file),
        ("calib_file", &config.calib_file),
    ];
    let inputs = (optional.iter()).filter_map(|(key, path)| Some((*key, path.as_deref()?)));
    let outputs = Outputs {
        key: "result_file",
        main,
        magic: None,
        names: names.into_iter().map(str::to_owned).collect(),
        inputs: inputs
            .chain([("result_file", config.result_file.as_path())])
            .chain(context.input())
            .collect(),
        force: true,
    };
    outputs.prepare()
}

/// The inputs and settings of the run from its report, and the evaluated file.
fn about(config: &EvaluationConfig, files: &RunFiles) -> Result<BTreeMap<String, String>> {
    let report = files.file("report.json");
    let mut about = if report.exists() {
        Report::read_json(&report)?.about
    } else {
        BTreeMap::new()
    };
    let result = config.result_file.display().to_string();
    about.insert("result".to_owned(), result);
    Ok(about)
}

/// The map of the run and its path; `None` if its configuration or its map file does not exist.
fn map_of(files: &RunFiles) -> Result<Option<(TriangleMesh, Option<MappingPath>)>> {
    let effective = files.file("effective_localization.yml");
    if !effective.exists() {
        return Ok(None);
    }
    let localized: LocalizationConfig = config::load(Some(&effective), &[])?;
    if !localized.map_file.exists() {
        tracing::info!("{} does not exist any more", localized.map_file.display());
        return Ok(None);
    }
    Ok(Some(mesh_file::read(&localized.map_file)?))
}

/// Converts positions in grid cells to metres.
fn scale(results: &mut LocalizationResults, grid_resolution_m: f64) {
    if grid_resolution_m == 1.0 {
        return;
    }
    let columns = [&mut results.estimates, &mut results.refined];
    for pose in columns.into_iter().flatten().flatten() {
        pose.translation.vector *= grid_resolution_m;
    }
    results.particles.scale_positions(grid_resolution_m as f32);
    // Results of range-mcl, which are planar.
    (results.estimates_in_space, results.refined_in_space) = (None, None);
}

/// The true poses of the frames of a result: in the frame of its map, or, if its path is not known, of
/// the first pose of the recording.
fn truth(
    pose_file: &Path,
    config: &EvaluationConfig,
    results: &LocalizationResults,
    mapping_path: Option<&MappingPath>,
) -> Result<Vec<Pose3>> {
    input::require_file("pose_file", pose_file)?;
    input::require_optional_file("calib_file", config.calib_file.as_deref())?;
    let mut track = PoseTrack::read(pose_file, config.calib_file.as_deref())?;
    if let Some(path) = mapping_path {
        track = track.in_map(&path.world_from_map);
    }
    let poses = &track.map_from_lidar;
    let last = results.frames.last().copied().unwrap_or_default();
    ensure!(
        last < poses.len(),
        "{} has {} poses, but the result reaches frame {last}; pose_file and result_file belong to different recordings",
        pose_file.display(),
        poses.len()
    );
    Ok((results.frames.iter()).map(|&frame| poses[frame]).collect())
}

/// The results of the frames that the configuration selects.
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
        results.select(&rows)
    }
}
