//! What a run leaves on disk: results, trajectories, tables, pictures.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};

use super::output;
use super::stages::LoadedMap;
use crate::app::plotting::color::{MCL, REFINED, Rgb};
use crate::app::plotting::{
    Animation, ErrorPlot, LineChart, LocalizationPicture, MapImage, MapPlot, Panel, Path2,
    PathPlot, RangeImageStrip, RuntimePlot, Series, map_plot,
};
use crate::app::results::{
    LocalizationResults, Report, TrajectoryReport, write_frames_csv, write_poses_npy,
};
use crate::evaluation::{
    EvaluatedTrajectory, MetricsConfig, ParticleRow, PlanarError, RangeMclRules, TrajectoryMetrics,
    planar_errors,
};
use crate::geometry::{Pose2, Pose3, StampedPose, Trajectory, TriangleMesh};
use crate::lidar::RangeImage;
use crate::localization::likelihood::{Direction, width_at_half};
use crate::localization::{FrameEstimate, ParticleSet};
use crate::recording::Sequence;
use crate::recording::poses::{write_kitti, write_tum};

/// Cells along the longer side of the map behind a picture.
const MAP_CELLS: usize = 1400;

/// Names of the files of a run, all beside its result.
#[derive(Clone, Debug)]
pub struct RunFiles {
    /// The `.npz`.
    pub result: PathBuf,
    folder: PathBuf,
}

impl RunFiles {
    /// The files beside a result.
    pub fn beside(result: &Path) -> Self {
        let folder = match result.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
            _ => PathBuf::from("."),
        };
        Self {
            result: result.to_owned(),
            folder,
        }
    }

    /// A file beside the result.
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// A picture under `plots/`, whose folder is made.
    pub fn plot(&self, name: &str) -> Result<PathBuf> {
        self.in_folder("plots", name)
    }

    fn in_folder(&self, folder: &str, name: &str) -> Result<PathBuf> {
        let folder = self.folder.join(folder);
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
        Ok(folder.join(name))
    }
}

/// What lies beside a result under the same name whatever the result is called.
const OF_A_RESULT: [&str; 3] = ["report.json", "mcl_tum.txt", "frames.csv"];

/// What `refine` adds to a result.
const OF_REFINED: [&str; 4] = [
    "refined_tum.txt",
    "refined_kitti.txt",
    "refined_poses.npy",
    "refinement.yml",
];

/// Makes sure, before any work is done, that a result can be written without losing another one:
/// neither its own file nor those beside it, of a result with another name.
pub fn prepare(files: &RunFiles, key: &str, force: bool) -> Result<()> {
    output::prepare(&files.result, key, force)?;
    let foreign = OF_A_RESULT
        .iter()
        .map(|name| files.file(name))
        .find(|path| path.exists());
    match foreign {
        Some(path) if !force && !files.result.exists() => bail!(
            "{} exists and belongs to another result; give {key} a folder of its own, or add --force to replace what lies there",
            path.display()
        ),
        _ => Ok(()),
    }
}

/// Removes what `refine` said of an earlier result.
pub fn remove_refined(files: &RunFiles) -> Result<()> {
    for path in OF_REFINED.map(|name| files.file(name)) {
        if path.exists() {
            std::fs::remove_file(&path)
                .with_context(|| format!("cannot remove {}", path.display()))?;
        }
    }
    Ok(())
}

/// Particles as they are stored.
pub fn rows_of(particles: &ParticleSet) -> Vec<ParticleRow> {
    particles
        .particles()
        .iter()
        .map(|particle| {
            let pose = &particle.map_from_lidar;
            [
                pose.translation.x as f32,
                pose.translation.y as f32,
                pose.rotation.angle() as f32,
                particle.weight as f32,
            ]
        })
        .collect()
}

/// Writes `<name>_tum.txt` (map frame, seconds) and `<name>_kitti.txt` (the convention of the
/// recording's `poses.txt`); rows are the first frames of the sequence.
pub fn write_trajectory(
    files: &RunFiles,
    name: &str,
    sequence: &Sequence,
    map_from_lidar: &[Pose3],
) -> Result<()> {
    let trajectory: Trajectory = sequence
        .frames
        .iter()
        .zip(map_from_lidar)
        .map(|(frame, &map_from_lidar)| StampedPose {
            map_from_lidar,
            ..frame.stamped()
        })
        .collect();
    output::write_file(&files.file(&format!("{name}_tum.txt")), |file| {
        write_tum(file, &trajectory)
    })?;
    output::write_file(&files.file(&format!("{name}_kitti.txt")), |file| {
        write_kitti(
            file,
            map_from_lidar,
            &sequence.frame.world_from_first_cam0,
            &sequence.frame.calibration,
        )
    })
}

/// Writes the `.npz`, and the poses as plain arrays for other programs.
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
    report.write_json(&files.file("report.json"))?;
    report.write_markdown(&files.file("report.md"))?;
    if let Some(estimates) = &results.estimates {
        write_frames_csv(&files.file("frames.csv"), results, estimates)?;
    }
    Ok(())
}

/// Judges the estimates, and the refined trajectory where there is one, against the ground truth.
pub fn evaluate(
    results: &LocalizationResults,
    rules: &RangeMclRules,
    about: BTreeMap<String, String>,
) -> Result<Report> {
    let truth = results
        .ground_truth
        .as_deref()
        .context("there is no ground truth to compare with; name its pose_file")?;
    let estimates = results.estimates_or_particle_means(rules)?;
    let one = |estimates: &[Pose2], runtimes_s: Option<&[f64]>| {
        evaluate_trajectory(
            &EvaluatedTrajectory {
                estimates,
                ground_truth: truth,
                times_s: results.times_s.as_deref(),
                runtimes_s,
            },
            rules,
        )
    };
    Ok(Report {
        about,
        mcl: one(&estimates, results.runtimes_s.as_deref())?,
        refined: results
            .refined
            .as_deref()
            .map(|refined| one(refined, results.refine_runtimes_s.as_deref()))
            .transpose()?,
    })
}

/// Judges one trajectory.
pub fn evaluate_trajectory(
    trajectory: &EvaluatedTrajectory,
    rules: &RangeMclRules,
) -> Result<TrajectoryReport> {
    let config = MetricsConfig {
        // A short run is judged from where it can be.
        skip_frames: MetricsConfig::default()
            .skip_frames
            .min(trajectory.ground_truth.len() / 2),
        ..MetricsConfig::default()
    };
    Ok(TrajectoryReport {
        range_mcl: rules.evaluate(trajectory.estimates, trajectory.ground_truth),
        metrics: TrajectoryMetrics::of(trajectory, &config)?,
    })
}

/// Draws everything about a run under `plots/`.
pub fn draw_run(
    files: &RunFiles,
    map: Option<&LoadedMap>,
    results: &LocalizationResults,
) -> Result<()> {
    draw_run_on(files, map.map(|map| &map.mesh), results)
}

/// The same with the map as it is in its file.
pub fn draw_run_on(
    files: &RunFiles,
    mesh: Option<&TriangleMesh>,
    results: &LocalizationResults,
) -> Result<()> {
    let image = mesh.map(|mesh| MapImage::of_colors(mesh, MAP_CELLS));
    let truth = results.ground_truth.as_deref();
    let estimates = results.estimates.as_deref().unwrap_or_default();
    let mut paths = vec![Path2::mcl(estimates)];
    paths.extend(results.refined.as_deref().map(Path2::refined));
    PathPlot {
        title: "Path against ground truth",
        ground_truth: truth,
        paths: &paths,
        map: image.as_ref(),
    }
    .save(&files.plot("path.png")?)?;
    if let Some(truth) = truth {
        draw_errors(files, results, estimates, truth)?;
    }
    draw_runtimes(files, results)?;
    draw_particles(files, image.as_ref(), results, estimates)?;
    if let Some(mesh) = mesh {
        MapPlot {
            title: "Map from above",
            mesh,
            path: truth.map(|truth| ("path of the car to be found", truth)),
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
    let mcl: Vec<PlanarError> = planar_errors(estimates, truth);
    let refined = results
        .refined
        .as_deref()
        .map(|refined| planar_errors(refined, truth));
    let mut errors = vec![("MCL", MCL, mcl.as_slice())];
    errors.extend(
        refined
            .as_deref()
            .map(|refined| ("refined", REFINED, refined)),
    );
    let by_frame: Vec<f64> = results.frames.iter().map(|&frame| frame as f64).collect();
    let (x_name, x) = match &results.times_s {
        Some(times_s) => ("time [s]", times_s.as_slice()),
        None => ("frame", by_frame.as_slice()),
    };
    ErrorPlot {
        title: "Errors over time",
        x_name,
        x,
        errors: &errors,
    }
    .save(&files.plot("errors.png")?)?;
    Ok(())
}

fn draw_runtimes(files: &RunFiles, results: &LocalizationResults) -> Result<()> {
    let mut stages = Vec::new();
    stages.extend(results.runtimes_s.as_deref().map(|s| ("localize", MCL, s)));
    stages.extend(
        results
            .refine_runtimes_s
            .as_deref()
            .map(|s| ("refine", REFINED, s)),
    );
    if stages.is_empty() {
        return Ok(());
    }
    RuntimePlot {
        title: "Runtime per frame",
        frames: &results.frames,
        stages: &stages,
        converged_row: None,
    }
    .save(&files.plot("runtime.png")?)?;
    Ok(())
}

/// The particles of the first frame, where they are spread most.
fn draw_particles(
    files: &RunFiles,
    image: Option<&MapImage>,
    results: &LocalizationResults,
    estimates: &[Pose2],
) -> Result<()> {
    if results.particles.is_empty() {
        return Ok(());
    }
    let truth = results.ground_truth.as_deref().unwrap_or_default();
    LocalizationPicture {
        title: &format!("Particles in frame {}", results.frames[0]),
        map: image,
        particles: results.particles.frame(0),
        estimate: estimates.first().copied(),
        refined: None,
        ground_truth: truth.first().copied(),
        driven: &[],
        window: None,
    }
    .save(&files.plot("particles.png")?)?;
    Ok(())
}

/// Draws a scan beside what the map shows from the estimate.
pub fn draw_range_images(
    files: &RunFiles,
    observed: &RangeImage,
    rendered: &[f32],
    frame: usize,
) -> Result<()> {
    RangeImageStrip {
        title: &format!("Frame {frame}: observed, rendered, difference"),
        model: &observed.model,
        observed: &observed.ranges,
        rendered,
        difference_limit_m: 1.0,
    }
    .save(&files.plot("range_images.png")?)?;
    Ok(())
}

/// A named line with its colour: (offset, likelihood).
pub type NamedProfile = (&'static str, Rgb, Vec<(f64, f64)>);

/// Draws likelihoods around the true pose of a frame, a panel per direction.
pub fn draw_likelihood(
    files: &RunFiles,
    frame: usize,
    profiles: Vec<(Direction, Vec<NamedProfile>)>,
) -> Result<()> {
    let panels = profiles.into_iter().map(|(direction, profiles)| {
        let (name, unit) = match direction {
            Direction::Along => ("along", "m"),
            Direction::Across => ("across", "m"),
            Direction::Heading => ("heading", "deg"),
        };
        let series = profiles.into_iter().map(|(model, color, points)| {
            let width = match width_at_half(&points) {
                Some(width) => format!("{width:.3} {unit} wide at half height"),
                None => "wider than shown at half height".to_owned(),
            };
            Series::line(&format!("{model}: {width}"), color, points)
        });
        Panel {
            y_name: "likelihood / peak".to_owned(),
            own_x_name: Some(format!("offset {name} [{unit}]")),
            series: series.collect(),
            from_zero: true,
            clip_outliers: false,
        }
    });
    LineChart {
        title: format!("Frame {frame}: likelihood around the true pose"),
        x_name: String::new(),
        panels: panels.collect(),
        marks: vec![(0.0, "truth".to_owned())],
    }
    .save(&files.plot("likelihood.png")?)?;
    Ok(())
}

/// A picture per frame, and in the end a moving one.
pub struct Movie {
    files: RunFiles,
    map: MapImage,
    pictures: Vec<PathBuf>,
}

impl Movie {
    /// Prepares the map behind the pictures.
    pub fn begin(files: &RunFiles, mesh: &TriangleMesh) -> Self {
        Self {
            files: files.clone(),
            map: MapImage::of_colors(mesh, MAP_CELLS),
            pictures: Vec::new(),
        }
    }

    /// Draws the last frame of the results.
    pub fn add(&mut self, results: &LocalizationResults, estimate: &FrameEstimate) -> Result<()> {
        /// Width of what is shown around the estimate [m].
        const WINDOW_M: f64 = 80.0;
        let Some(&number) = results.frames.last() else {
            return Ok(());
        };
        let truth = results.ground_truth.as_deref().unwrap_or_default();
        let t = estimate.pose.translation;
        let path = self
            .files
            .in_folder("loc_plots", &format!("{number:06}.png"))?;
        LocalizationPicture {
            title: &format!("Frame {number}: {}", estimate.state.word()),
            map: Some(&self.map),
            particles: results.particles.frame(results.len() - 1),
            estimate: Some(estimate.pose),
            refined: None,
            ground_truth: truth.last().copied(),
            driven: truth,
            window: Some(([t.x, t.y], WINDOW_M)),
        }
        .save(&path)?;
        self.pictures.push(path);
        Ok(())
    }

    /// Makes the GIF.
    pub fn finish(self) -> Result<()> {
        Animation::default().save(&self.files.file("localization.gif"), &self.pictures)?;
        Ok(())
    }
}
