//! `evaluate`: the errors of a result or of a trajectory.

mod trajectory;
mod truth;

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Result, ensure};
use clap::Args;
use serde::Serialize;

pub use self::truth::NoRigidAlignment;
use crate::app::report::run_output::{self, REPORT_FILES};
use crate::app::report::{LocalizationResults, Report, RunFiles, run_page};
use crate::app::run::{Claims, Context, Outputs, RecordingArgs, RunArgs, input, output};
use crate::app::settings::{self, EvaluationConfig, LocalizationConfig};
use crate::evaluation::alignment::level_camera_axes;
use crate::evaluation::{Alignment, RangeMclRules};
use crate::file_path::FilePath;
use crate::files::folder_of;
use crate::geometry::TriangleMesh;
use crate::map::MappingPath;
use crate::map::files::mapped_ply::MappedPly;
use crate::map::files::mesh_file;
use crate::map::mesh_view::reduced;

/// Arguments of `evaluate`.
#[derive(Clone, Debug, Args, Serialize)]
pub struct EvaluateArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(flatten)]
    pub run: RunArgs,

    /// The recording.
    #[command(flatten)]
    #[serde(flatten)]
    pub recording: RecordingArgs,

    /// True poses: rows of KITTI or TUM, a folder oxts, or a topic of the recording; by default those in the result. Sets the key `pose_file`.
    #[arg(long = "truth", value_name = "FILE")]
    pub pose_file: Option<FilePath>,

    /// Calibration of the camera whose poses the truth has; sets the key `calib_file`.
    #[arg(long = "calib", value_name = "FILE")]
    pub calib_file: Option<FilePath>,

    /// Recording whose poses are the truth; sets the key `scan_folder`.
    #[arg(long = "recording", value_name = "RECORDING")]
    pub scan_folder: Option<FilePath>,

    /// Alignment with the truth; by default none for a result in a map, and first for a trajectory. Sets the key `alignment`.
    #[arg(long = "align", value_name = "ALIGNMENT", value_parser = ["none", "first", "rigid"])]
    pub alignment: Option<String>,

    /// Folder of the report; sets the key `output_folder`.
    #[arg(long = "output", value_name = "FOLDER")]
    pub output_folder: Option<FilePath>,
}

/// Compares a result of `localize`, `refine` or range-mcl, or any trajectory, with the ground truth.
pub fn run(config: &EvaluationConfig, context: &Context) -> Result<Report> {
    input::require_file("result_file", &config.result_file)?;
    let files = output_files(config)?;
    let main = files.file("effective_evaluation.yml");
    let mut claims = prepare(config, context, &main)?;
    let results = read(config)?;
    run_output::warn_of_shortfall(&results, &config.result_file);
    let mut about = about(config)?;
    about.extend(run_output::shortfall(&results));
    let results = selected(results, config)?;
    let is_trajectory = results.particles.is_empty();
    let (report, results, mesh) = if is_trajectory {
        of_trajectory(config, results, about)?
    } else {
        in_map(config, results, about)?
    };
    if config.save_evaluation_results {
        claims.begin(&main)?;
        run_output::write_report(&files, &results, &report)?;
        output::write_yaml(&main, config)?;
    }
    if config.output.plots {
        run_output::draw_run(&files, mesh.as_ref(), &results)?;
    }
    if config.save_evaluation_results {
        run_page::write(&files, &report)?;
        claims.finish(&main)?;
    }
    Ok(report)
}

/// A report with the results that it is of, and the map.
type Evaluated = (Report, LocalizationResults, Option<TriangleMesh>);

/// Evaluates a result in a map.
fn in_map(
    config: &EvaluationConfig,
    mut results: LocalizationResults,
    mut about: BTreeMap<String, String>,
) -> Result<Evaluated> {
    let localized = localization_of(&config.result_file)?;
    let track = truth::read_track(config, localized.as_ref())?;
    let map = if track.is_some() || config.output.plots {
        localized.as_ref().map_or(Ok(None), map_of)?
    } else {
        None
    };
    if let Some(mut track) = track {
        if let Some((_, Some(path))) = &map {
            track = track.in_map(&path.world_from_map);
        }
        results = truth::with_truth(results, &track, &config.result_file)?;
    }
    let mut results = with_truth_only(results, config)?;
    let rules = RangeMclRules {
        convergence_interval: config.convergence_interval,
        converge_thres: config.converge_thres,
        particle_select_ratio: config.particle_select_ratio,
    };
    let estimates = results.estimates_or_particle_means(&rules)?.into_owned();
    results.estimates = Some(estimates.into());
    let alignment = config.alignment.unwrap_or(Alignment::None);
    note(&mut about, alignment);
    truth::align(&mut results, alignment)?;
    let report = run_output::evaluate(&results, &rules, about)?;
    Ok((report, results, map.map(|(mesh, _)| mesh)))
}

/// Evaluates a trajectory, which has no map.
fn of_trajectory(
    config: &EvaluationConfig,
    mut results: LocalizationResults,
    mut about: BTreeMap<String, String>,
) -> Result<Evaluated> {
    if let Some(mut track) = truth::read_track(config, None)? {
        track.map_from_lidar = trajectory::in_world(&track);
        results = truth::with_truth(results, &track, &config.result_file)?;
    }
    let mut results = with_truth_only(results, config)?;
    let columns = (
        &mut results.estimates_in_space,
        &mut results.ground_truth_in_space,
    );
    if let (Some(estimates), Some(truth)) = columns {
        level_camera_axes(estimates, truth);
    }

    let alignment = config.alignment.unwrap_or(Alignment::First);
    note(&mut about, alignment);
    truth::align(&mut results, alignment)?;
    let report = trajectory::evaluate(&results, about)?;
    Ok((report, results, None))
}

/// The results of the frames that have a true pose.
fn with_truth_only(
    results: LocalizationResults,
    config: &EvaluationConfig,
) -> Result<LocalizationResults> {
    let count = results.len();
    let known = results.into_truth_only();
    ensure!(
        known.ground_truth.is_some() && !known.is_empty(),
        "{} has no ground truth; give the true poses of its recording by --truth FILE, and their calibration by --calib FILE (pose_file, calib_file)",
        config.result_file.display()
    );
    if known.len() < count {
        tracing::warn!(
            "{} of {} frames are left out, because they have no true pose",
            count - known.len(),
            count
        );
    }
    Ok(known)
}

/// Notes the alignment in a report.
fn note(about: &mut BTreeMap<String, String>, alignment: Alignment) {
    let text = match alignment {
        Alignment::None => "none",
        Alignment::First => "at the first pose",
        Alignment::Rigid => "rigid, least squares of the positions (Umeyama 1991), no scale",
    };
    about.insert("alignment".to_owned(), text.to_owned());
}

/// The outputs: by default next to a result, and in a folder of its own next to a trajectory.
fn output_files(config: &EvaluationConfig) -> Result<RunFiles> {
    let result = &config.result_file;
    Ok(match &config.output_folder {
        Some(folder) => RunFiles::in_folder(result, folder),
        None if settings::is_result(result) => RunFiles::new(result),
        None => {
            let mut name = result.file_stem().unwrap_or_default().to_owned();
            name.push("_evaluation");
            let folder = folder_of(result).join(name);
            RunFiles::in_folder(result, &folder)
        }
    })
}

/// Reads the result, in metres.
fn read(config: &EvaluationConfig) -> Result<LocalizationResults> {
    let path = &config.result_file;
    let calibration = config.result_calib_file.as_deref();
    if let Some(path) = calibration {
        input::require_file("result_calib_file", path)?;
    }
    let mut results = if settings::is_result(path) {
        LocalizationResults::read(path)?
    } else {
        trajectory::read(path, calibration)?
    };
    scale(&mut results, config.grid_resolution);
    Ok(results)
}

/// Prepares the configured outputs; the effective configuration is the main one.
fn prepare(config: &EvaluationConfig, context: &Context, main: &Path) -> Result<Claims> {
    let mut names = Vec::new();
    if config.save_evaluation_results {
        names.extend(REPORT_FILES);
    }
    names.extend(config.output.plots.then_some("plots"));
    if names.is_empty() {
        return Claims::read(folder_of(main));
    }
    let optional = [
        ("pose_file", &config.given_poses.pose_file),
        ("calib_file", &config.given_poses.calib_file),
        ("result_calib_file", &config.result_calib_file),
    ];
    let inputs = (optional.iter()).filter_map(|(key, path)| Some((*key, path.as_deref()?)));
    let outputs = Outputs {
        key: "output_folder",
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

/// The inputs and settings of the run from its report, and the evaluated files.
fn about(config: &EvaluationConfig) -> Result<BTreeMap<String, String>> {
    let report = RunFiles::new(&config.result_file).file("report.json");
    let mut about = if settings::is_result(&config.result_file) && report.exists() {
        Report::read_json(&report)?.about
    } else {
        BTreeMap::new()
    };
    let truth = config.given_poses.pose_file.as_ref();
    let truth = truth.or(config.scan_folder.as_ref());
    for (name, path) in [("result", Some(&config.result_file)), ("truth", truth)] {
        about.remove(name);
        about.extend(path.map(|path| (name.to_owned(), path.display().to_string())));
    }
    Ok(about)
}

/// The configuration of the localization next to a result, if there is one.
fn localization_of(result: &Path) -> Result<Option<LocalizationConfig>> {
    let effective = RunFiles::new(result).file("effective_localization.yml");
    let load = || settings::load(Some(&effective), &[]);
    Ok(effective.exists().then(load).transpose()?)
}

/// The map of a run for pictures, a large one coarser, and its path; `None` if its file does not exist.
fn map_of(localized: &LocalizationConfig) -> Result<Option<(TriangleMesh, Option<MappingPath>)>> {
    let file = &localized.map_input.map_file;
    if !file.exists() {
        tracing::info!("{} does not exist any more", file.display());
        return Ok(None);
    }
    Ok(Some(match MappedPly::open(file) {
        Some(mesh) => {
            let drawn = reduced(&[(&mesh, None)], run_output::MOST_TRIANGLES);
            (drawn, mesh.path)
        }
        None => mesh_file::read(file)?,
    }))
}

/// Converts positions in grid cells to metres.
fn scale(results: &mut LocalizationResults, grid_resolution_m: f64) {
    let columns = [&mut results.estimates, &mut results.refined];
    for pose in columns.into_iter().flatten().flatten() {
        pose.translation.vector *= grid_resolution_m;
    }
    let columns = [
        &mut results.estimates_in_space,
        &mut results.refined_in_space,
        &mut results.trajectory_in_space,
    ];
    for pose in columns.into_iter().flatten().flatten() {
        pose.translation.vector *= grid_resolution_m;
    }
    results.particles.scale_positions(grid_resolution_m as f32);
}

/// The results of the frames that the configuration selects.
fn selected(
    results: LocalizationResults,
    config: &EvaluationConfig,
) -> Result<LocalizationResults> {
    let frames = &config.frames;
    let window = usize::try_from(frames.n_scans).unwrap_or(usize::MAX);
    let selected = frames.start_idx..frames.start_idx.saturating_add(window);
    let rows: Vec<usize> = (0..results.len())
        .filter(|&row| selected.contains(&results.frames[row]))
        .step_by(frames.frame_step)
        .collect();
    ensure!(
        !rows.is_empty(),
        "no frame of {} is selected; check start_idx, n_scans and frame_step",
        config.result_file.display()
    );
    Ok(results.select(&rows))
}
