//! Output files of a run: results, trajectories, reports and plots.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

use super::claims::{Claims, Outputs};
use super::output;
use super::trajectory::stamped;
use crate::app::plotting::color::{MCL, REFINED, Rgb, STATES};
use crate::app::plotting::{
    Animation, InteractivePath, LineChart, LocalizationPicture, MapImage, MapPlot, Mark, Panel,
    PathPlot, Series, drift_chart, error_chart, map_plot,
};
use crate::app::results::{
    LocalizationResults, Report, RunSummary, TrajectoryReport, write_frames_csv, write_poses_npy,
};
use crate::evaluation::trust::Axes;
use crate::evaluation::{
    EvaluatedTrajectory, MetricsConfig, ParticleRow, RangeMclRules, SpatialMetrics,
    TrajectoryMetrics, planar_errors,
};
use crate::files::folder_of;
use crate::geometry::{Pose2, Pose3, TriangleMesh, pose2_from_pose3};
use crate::localization::{Estimate, ParticleSet, State};
use crate::recording::Recording;
use crate::recording::poses::{write_kitti, write_tum};

/// Content of the interactive path, beside the pictures.
pub const INTERACTIVE: &str = "path.json";

/// Cells along the longer side of the map image in plots.
const MAP_CELLS: usize = 1400;

/// Paths of the output files of a run, all in the folder of its result.
#[derive(Clone, Debug)]
pub struct RunFiles {
    /// The `.npz` file.
    pub result: PathBuf,
    folder: PathBuf,
}

impl RunFiles {
    /// The files beside a result.
    pub fn beside(result: &Path) -> Self {
        Self {
            result: result.to_owned(),
            folder: folder_of(result).to_owned(),
        }
    }

    /// The folder of the result.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The files of a result in another folder.
    pub fn in_folder(result: &Path, folder: &Path) -> Self {
        Self {
            result: result.to_owned(),
            folder: folder.to_owned(),
        }
    }

    /// The path of a file beside the result.
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// The path of a plot in `plots/`, which is created if necessary, but not the folder above it.
    pub fn plot(&self, name: &str) -> Result<PathBuf> {
        self.in_subfolder("plots", name)
    }

    fn in_subfolder(&self, folder: &str, name: &str) -> Result<PathBuf> {
        let folder = self.folder.join(folder);
        output::create_subfolder(&folder)?;
        Ok(folder.join(name))
    }
}

/// Report files of a result.
pub const REPORT_FILES: [&str; 4] = ["report.json", "report.md", "report.html", "frames.csv"];

/// Further files that localization writes beside its result.
pub const LOCALIZATION_FILES: [&str; 4] = [
    "mcl_tum.txt",
    "mcl_kitti.txt",
    "ground_truth_poses.npy",
    "effective_localization.yml",
];

/// Files that refinement adds to a result.
pub const REFINEMENT_FILES: [&str; 4] = [
    "refined_tum.txt",
    "refined_kitti.txt",
    "refined_poses.npy",
    "effective_refinement.yml",
];

/// Prepares the outputs of a new result; an error if there is another one, also one with a
/// different name in the same folder.
pub fn prepare(files: &RunFiles, outputs: &Outputs) -> Result<Claims> {
    let claims = outputs.prepare()?;
    let names = ["report.json", "mcl_tum.txt", "frames.csv"];
    let other = names.map(|name| files.file(name));
    match other.iter().find(|path| path.exists()) {
        Some(path) if !outputs.force && !files.result.exists() => bail!(
            "{} exists and belongs to another result; set {} to a path in a folder of its own, or add --force to overwrite it",
            path.display(),
            outputs.key
        ),
        _ => Ok(claims),
    }
}

/// Particles in the layout of the results.
pub fn particle_rows(particles: &ParticleSet) -> Vec<ParticleRow> {
    let row = |pose: &Pose2, weight: f64| {
        let t = pose.translation;
        [t.x, t.y, pose.rotation.angle(), weight].map(|number| number as f32)
    };
    (particles.particles().iter())
        .map(|particle| row(&particle.map_from_lidar, particle.weight))
        .collect()
}

/// Writes `<name>_tum.txt` (map frame, seconds) and `<name>_kitti.txt` (the convention of the
/// recording's poses; without any, lidar poses in the map frame); the poses are those of the first frames.
pub fn write_trajectory(
    files: &RunFiles,
    name: &str,
    recording: &Recording,
    map_from_lidar: &[Pose3],
) -> Result<()> {
    let trajectory = stamped(&recording.frames, map_from_lidar);
    let (world_from_map, calibration) = recording.world();
    output::write_file(&files.file(&format!("{name}_tum.txt")), |file| {
        write_tum(file, &trajectory)
    })?;
    output::write_file(&files.file(&format!("{name}_kitti.txt")), |file| {
        write_kitti(file, map_from_lidar, &world_from_map, &calibration)
    })
}

/// Writes the `.npz` file, and poses as `.npy` files for other programs.
pub fn write_results(files: &RunFiles, results: &LocalizationResults) -> Result<()> {
    results.write(&files.result)?;
    if let Some(truth) = &results.ground_truth {
        write_poses_npy(&files.file("ground_truth_poses.npy"), truth)?;
    }
    if let Some(refined) = &results.refined {
        write_poses_npy(&files.file("refined_poses.npy"), refined)?;
    }
    Ok(())
}

/// Writes `report.json`, `report.md` and `frames.csv`.
pub fn write_report(
    files: &RunFiles,
    results: &LocalizationResults,
    report: &Report,
) -> Result<()> {
    output::write_json(&files.file("report.json"), report)?;
    output::write_text(&files.file("report.md"), &report.to_markdown())?;
    write_frames_csv(&files.file("frames.csv"), results)
}

/// The entry of a report about a result that is not complete.
pub fn shortfall(results: &LocalizationResults) -> Option<(String, String)> {
    Some(("frames".to_owned(), results.shortfall()?))
}

/// Warns of a result that is not complete.
pub fn warn_of_shortfall(results: &LocalizationResults, path: &Path) {
    if let Some(shortfall) = results.shortfall() {
        tracing::warn!(
            "{} is incomplete: {shortfall}; run localize again for all of them",
            path.display()
        );
    }
}

/// Summarizes a run, and compares the estimates and the refined trajectory with the ground truth, if there is one.
pub fn evaluate(
    results: &LocalizationResults,
    rules: &RangeMclRules,
    about: BTreeMap<String, String>,
) -> Result<Report> {
    let report =
        |estimates: &[Pose2], in_space: &Option<Vec<Pose3>>, runtimes_s: &Option<Vec<f64>>| {
            let Some(ground_truth) = results.ground_truth.as_deref() else {
                return Ok(None);
            };
            let trajectory = EvaluatedTrajectory {
                estimates,
                ground_truth,
                times_s: results.times_s.as_deref(),
                runtimes_s: runtimes_s.as_deref(),
            };
            let in_space = in_space
                .as_deref()
                .zip(results.ground_truth_in_space.as_deref());
            evaluate_trajectory(&trajectory, in_space, rules).map(Some)
        };
    let estimates = results.estimates_or_particle_means(rules)?;
    Ok(Report {
        about,
        summary: RunSummary::of(results, &estimates),
        mcl: report(&estimates, &results.estimates_in_space, &results.runtimes_s)?,
        refined: match &results.refined {
            Some(refined) => report(
                refined,
                &results.refined_in_space,
                &results.refine_runtimes_s,
            )?,
            None => None,
        },
        trajectory: None,
    })
}

/// Computes the errors of one trajectory.
pub fn evaluate_trajectory(
    trajectory: &EvaluatedTrajectory,
    in_space: Option<(&[Pose3], &[Pose3])>,
    rules: &RangeMclRules,
) -> Result<TrajectoryReport> {
    let defaults = MetricsConfig::default();
    let config = MetricsConfig {
        // At least half of a short run is evaluated.
        skip_frames: (defaults.skip_frames).min(trajectory.ground_truth.len() / 2),
        ..defaults
    };
    Ok(TrajectoryReport {
        range_mcl: rules.evaluate(trajectory.estimates, trajectory.ground_truth),
        metrics: TrajectoryMetrics::of(trajectory, &config)?,
        in_space: in_space.and_then(|(estimates, truth)| {
            SpatialMetrics::of(estimates, truth, config.skip_frames)
        }),
    })
}

/// Draws the plots of a run in `plots/`.
pub fn draw_run(
    files: &RunFiles,
    mesh: Option<&TriangleMesh>,
    results: &LocalizationResults,
) -> Result<()> {
    let image = mesh.map(|mesh| MapImage::of_colors(mesh, MAP_CELLS));
    let truth = results.ground_truth.as_deref();
    let estimates = match (&results.estimates, &results.estimates_in_space) {
        (Some(estimates), _) => estimates.clone(),
        (None, Some(estimates)) => estimates.iter().map(pose2_from_pose3).collect(),
        (None, None) => Vec::new(),
    };
    let estimates = estimates.as_slice();
    let is_trajectory = results.particles.is_empty();
    let name = if is_trajectory { "estimate" } else { "MCL" };
    let mut paths = vec![(name, MCL, estimates)];
    paths.extend(
        results
            .refined
            .as_deref()
            .map(|it| ("refined", REFINED, it)),
    );
    PathPlot {
        title: match truth {
            Some(_) => "Path against ground truth",
            None => "Path",
        },
        ground_truth: truth,
        paths: &paths,
        map: image.as_ref(),
    }
    .save(&files.plot("path.png")?)?;
    InteractivePath {
        results,
        estimates,
        map: image.as_ref(),
    }
    .save(&files.plot(INTERACTIVE)?)?;
    if let Some(truth) = truth
        && !is_trajectory
    {
        draw_errors(files, results, estimates, truth)?;
    }
    draw_states(files, results, estimates)?;
    draw_drift(files, name, results)?;
    draw_runtimes(files, results)?;
    draw_particles(files, image.as_ref(), results)?;
    if let Some(mesh) = mesh {
        MapPlot {
            title: "Map from above",
            mesh,
            path: match truth {
                Some(truth) => Some(("true path", truth)),
                None => Some(("found path", estimates)),
            },
            keys: &map_plot::ground_and_rest(mesh),
        }
        .save(&files.plot("map.png")?)?;
    }
    Ok(())
}

fn draw_errors(
    files: &RunFiles,
    results: &LocalizationResults,
    estimates: &[Pose2],
    truth: &[Pose2],
) -> Result<()> {
    let by_frame: Vec<f64> = results.frames.iter().map(|&frame| frame as f64).collect();
    let (x_name, x) = match &results.times_s {
        Some(times_s) => ("time [s]", times_s),
        None => ("frame", &by_frame),
    };
    let errors = |poses: &[Pose2]| x.iter().copied().zip(planar_errors(poses, truth)).collect();
    let mut trajectories = vec![("MCL", MCL, errors(estimates))];
    trajectories.extend(
        results
            .refined
            .as_deref()
            .map(|it| ("refined", REFINED, errors(it))),
    );
    error_chart("Errors over time", x_name, &trajectories).save(&files.plot("errors.png")?)
}

/// Draws the errors in space against the distance driven.
fn draw_drift(files: &RunFiles, name: &str, results: &LocalizationResults) -> Result<()> {
    let Some(truth) = results.ground_truth_in_space.as_deref() else {
        return Ok(());
    };
    let trajectories: Vec<_> = [
        (name, MCL, &results.estimates_in_space),
        ("refined", REFINED, &results.refined_in_space),
    ]
    .into_iter()
    .filter_map(|(name, color, poses)| Some((name, color, poses.as_deref()?)))
    .collect();
    if trajectories.is_empty() {
        return Ok(());
    }
    drift_chart(truth, &trajectories).save(&files.plot("drift.png")?)
}

/// Draws how sure the run was of each frame: the standard deviation, and the agreement by state.
fn draw_states(files: &RunFiles, results: &LocalizationResults, estimates: &[Pose2]) -> Result<()> {
    let (Some(states), Some(covariances)) = (&results.states, &results.covariances) else {
        return Ok(());
    };
    let times_s = results.recorded_times();
    let x = |row: usize| match times_s {
        Some(times_s) => times_s[row] - times_s[0],
        None => results.frames[row] as f64,
    };
    let sigma_cm = |row: usize| 100.0 * Axes::of(&covariances[row], &estimates[row]).long_m;
    let agreements = results.agreements.as_deref().unwrap_or_default();
    let in_state = |(state, color): (State, Rgb)| Series {
        mark: Mark::Dots,
        ..Series::line(
            state.word(),
            color,
            (0..agreements.len())
                .filter(|&row| states[row] == state as u8 && agreements[row] >= 0.0)
                .map(|row| (x(row), 100.0 * agreements[row])),
        )
    };
    let mut panels = vec![Panel {
        y_name: "standard deviation [cm]".to_owned(),
        series: vec![Series::line(
            "of the position, MCL",
            MCL,
            (0..results.len()).map(|row| (x(row), sigma_cm(row))),
        )],
        clip_outliers: true,
        ..Panel::default()
    }];
    let by_state: Vec<Series> = STATES
        .into_iter()
        .map(in_state)
        .filter(|it| !it.points.is_empty())
        .collect();
    if !by_state.is_empty() {
        panels.push(Panel {
            y_name: "beams on the map [%]".to_owned(),
            series: by_state,
            ..Panel::default()
        });
    }
    LineChart {
        title: "States over time".to_owned(),
        x_name: if times_s.is_some() {
            "time from the start [s]"
        } else {
            "frame"
        }
        .to_owned(),
        panels,
        marks: Vec::new(),
    }
    .save(&files.plot("states.png")?)
}

fn draw_runtimes(files: &RunFiles, results: &LocalizationResults) -> Result<()> {
    let stages = [
        ("localize", MCL, &results.runtimes_s),
        ("refine", REFINED, &results.refine_runtimes_s),
    ];
    let series = stages.into_iter().filter_map(|(stage, color, times_s)| {
        let points = results.frames.iter().zip(times_s.as_ref()?);
        let points = points.map(|(&frame, time_s)| (frame as f64, 1e3 * time_s));
        Some(Series::line(stage, color, points))
    });
    let series: Vec<Series> = series.collect();
    if series.is_empty() {
        return Ok(());
    }
    LineChart {
        title: "Runtime per frame".to_owned(),
        x_name: "frame".to_owned(),
        panels: vec![Panel {
            y_name: "time per frame [ms]".to_owned(),
            series,
            clip_outliers: true,
            ..Panel::default()
        }],
        marks: Vec::new(),
    }
    .save(&files.plot("runtime.png")?)
}

/// Draws the particles of the first frame, which are spread most.
fn draw_particles(
    files: &RunFiles,
    image: Option<&MapImage>,
    results: &LocalizationResults,
) -> Result<()> {
    let first = |poses: &Option<Vec<Pose2>>| poses.as_ref()?.first().copied();
    if results.particles.is_empty() {
        return Ok(());
    }
    LocalizationPicture {
        title: &format!("Particles in frame {}", results.frames[0]),
        map: image,
        particles: results.particles.frame(0),
        estimate: first(&results.estimates),
        ground_truth: first(&results.ground_truth),
        ..LocalizationPicture::default()
    }
    .save(&files.plot("particles.png")?)
}

/// A picture per frame, and an animation of them.
pub struct Movie {
    files: RunFiles,
    map: MapImage,
    pictures: Vec<PathBuf>,
}

impl Movie {
    /// Prepares the map image of the pictures.
    pub fn begin(files: &RunFiles, mesh: &TriangleMesh) -> Self {
        Self {
            files: files.clone(),
            map: MapImage::of_colors(mesh, MAP_CELLS),
            pictures: Vec::new(),
        }
    }

    /// Draws the last frame of the results.
    pub fn add(&mut self, results: &LocalizationResults, estimate: &Estimate) -> Result<()> {
        /// Width of what is shown around the estimate [m].
        const WINDOW_M: f64 = 80.0;
        let Some(&number) = results.frames.last() else {
            return Ok(());
        };
        let truth = results.ground_truth.as_deref().unwrap_or_default();
        let driven = match truth {
            [] => results.estimates.as_deref().unwrap_or_default(),
            truth => truth,
        };
        let t = estimate.pose.translation;
        let path = self
            .files
            .in_subfolder("loc_plots", &format!("{number:06}.png"))?;
        LocalizationPicture {
            title: &format!("Frame {number}: {}", estimate.state.word()),
            map: Some(&self.map),
            particles: results.particles.frame(results.len() - 1),
            estimate: Some(estimate.pose),
            ground_truth: truth.last().copied(),
            driven,
            window: Some(([t.x, t.y], WINDOW_M)),
        }
        .save(&path)?;
        self.pictures.push(path);
        Ok(())
    }

    /// Writes the animation.
    pub fn finish(self) -> Result<()> {
        Animation::default().save(&self.files.file("localization.gif"), &self.pictures)
    }
}
