//! Output files of a run: results, trajectories, reports and plots.

mod pictures;

use std::collections::BTreeMap;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use nalgebra::Matrix3;

use crate::app::report::results::{
    Column, LocalizationResults, RefinementSummary, Report, RunSummary, TrajectoryReport,
    write_frames_csv, write_poses_npy,
};
use crate::app::run::{Claims, Outputs, output};
use crate::app::settings::{InertialConfig, MapInputConfig, RecordingConfig};
use crate::evaluation::metrics::pick;
use crate::evaluation::{
    Consistency, EvaluatedTrajectory, MetricsConfig, ParticleRow, PlanarError, RangeMclRules,
    SpatialMetrics, TrajectoryMetrics,
};
use crate::files::folder_of;
use crate::geometry::{Pose2, Pose3, StampedPose};
use crate::georeference::write_geojson;
use crate::localization::{ParticleSet, State};
use crate::map::Map;
use crate::recording::poses::{write_kitti, write_tum};
use crate::recording::{Frame, Recording};
use crate::refinement::FrameChange;

pub use pictures::{MOST_TRIANGLES, Movie, draw_range_images, draw_run, map_around, time_axis};

/// Content of the interactive path, next to the pictures.
pub const INTERACTIVE: &str = "path.json";

/// Paths of the output files of a run, all in the folder of its result.
#[derive(Clone, Debug)]
pub struct RunFiles {
    /// The `.npz` file.
    pub result: PathBuf,
    folder: PathBuf,
}

impl RunFiles {
    /// The files in the folder of a result.
    pub fn new(result: &Path) -> Self {
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

    /// The path of a file next to the result.
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

/// Further files that localization writes next to its result.
pub const LOCALIZATION_FILES: [&str; 5] = [
    "mcl_tum.txt",
    "mcl_kitti.txt",
    "mcl.geojson",
    "ground_truth_poses.npy",
    "effective_localization.yml",
];

/// Files that refinement adds to a result.
pub const REFINEMENT_FILES: [&str; 5] = [
    "refined_tum.txt",
    "refined_kitti.txt",
    "refined.geojson",
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

/// Poses with the numbers and times of frames.
pub fn stamped(frames: &[Frame], poses: &[Pose3]) -> Vec<StampedPose> {
    (frames.iter().zip(poses))
        .map(|(frame, &pose)| frame.stamped(pose))
        .collect()
}

/// A trajectory with its frames.
pub struct Trajectory<'a> {
    /// The frames.
    pub frames: &'a [Frame],
    /// `map_from_lidar` of each frame.
    pub poses: &'a [Pose3],
    /// State of each pose as a number; all are trusted where they are not known.
    pub states: Option<&'a [u8]>,
}

impl<'a> Trajectory<'a> {
    /// The trajectory of the filter, in which the frames before the first tracked one are filled back.
    pub fn of_filter(results: &'a LocalizationResults, frames: &'a [Frame]) -> Self {
        Self {
            frames,
            poses: results.trajectory_in_space().map_or(&[], |poses| poses),
            states: results.trajectory_states().map(|states| &**states),
        }
    }

    /// The refined trajectory.
    pub fn refined(results: &'a LocalizationResults, frames: &'a [Frame]) -> Self {
        Self {
            frames,
            poses: results.refined_in_space.as_deref().unwrap_or_default(),
            states: results.refined_states.as_deref(),
        }
    }

    /// Rows of the poses that are trusted.
    fn trusted(&self) -> impl DoubleEndedIterator<Item = usize> {
        (0..self.poses.len()).filter(|&row| self.state(row) == State::Tracking)
    }

    fn state(&self, row: usize) -> State {
        let state = self.states.map(|states| State::from_number(states[row]));
        state.map_or(State::Tracking, |state| state.unwrap_or(State::Searching))
    }

    /// The frame in the middle of those that are trusted, and its pose.
    pub fn middle(&self) -> Option<(&'a Frame, &'a Pose3)> {
        let rows: Vec<usize> = self.trusted().collect();
        let &row = rows.get(rows.len() / 2)?;
        Some((&self.frames[row], &self.poses[row]))
    }

    /// Writes `<name>_tum.txt` (map frame, seconds) and `<name>_kitti.txt` (the convention of the recording's poses; without
    /// any, lidar poses in the map frame): the poses that are trusted, or all of them, with the states as comments. Rows of
    /// KITTI have no times: that file is only written where every frame has one.
    pub fn write(
        &self,
        files: &RunFiles,
        name: &str,
        recording: &Recording,
        all: bool,
    ) -> Result<()> {
        let rows: Vec<usize> = if all {
            (0..self.poses.len()).collect()
        } else {
            self.trusted().collect()
        };
        let (world_from_map, calibration) = recording.world();
        output::write_file(&files.file(&format!("{name}_tum.txt")), |file| {
            for stretch in rows.chunk_by(|&a, &b| self.state(a) == self.state(b)) {
                if all && self.states.is_some() {
                    writeln!(file, "# {}", self.state(stretch[0]).word())?;
                }
                for &row in stretch {
                    let pose = self.frames[row].stamped(self.poses[row]);
                    write_tum(&mut *file, &[pose])?;
                }
            }
            io::Result::Ok(())
        })?;
        let kitti = files.file(&format!("{name}_kitti.txt"));
        if rows.len() < self.poses.len() {
            // Other programs take row k for frame k.
            let kitti_file = kitti.display();
            tracing::info!("{kitti_file} is not written, as not every frame has a trusted pose");
            return output::remove_if_exists(&kitti);
        }
        output::write_file(&kitti, |file| {
            write_kitti(file, self.poses, &world_from_map, &calibration)
        })
    }
}

impl Trajectory<'_> {
    /// Writes `<name>.geojson`, the poses that are trusted on the Earth, or all of them, where the place of the map is known.
    pub fn write_geojson(&self, files: &RunFiles, name: &str, map: &Map, all: bool) -> Result<()> {
        let path = files.file(&format!("{name}.geojson"));
        let Some(georeference) = &map.path.georeference else {
            return output::remove_if_exists(&path);
        };
        let rows: Vec<usize> = if all {
            (0..self.poses.len()).collect()
        } else {
            self.trusted().collect()
        };
        let stretches: Vec<Vec<StampedPose>> = rows
            .chunk_by(|a, b| a + 1 == *b)
            .map(|rows| {
                let poses = rows.iter();
                poses
                    .map(|&row| self.frames[row].stamped(self.poses[row]))
                    .collect()
            })
            .collect();
        output::write_file(&path, |file| write_geojson(file, georeference, &stretches))
    }
}

/// Costs [m] and agreements before and after the refinement of a frame, -1 where unknown.
pub fn before_and_after(change: Option<FrameChange>) -> ([f64; 2], [f64; 2]) {
    change.map_or(([-1.0; 2], [-1.0; 2]), |it| {
        (it.cost_m, it.agreement.map(|share| share.unwrap_or(-1.0)))
    })
}

/// Writes the `.npz` file, and poses as `.npy` files for other programs.
pub fn write_results(files: &RunFiles, results: &LocalizationResults) -> Result<()> {
    results.write(&files.result)?;
    write_poses(files, results)
}

/// Writes poses as `.npy` files for other programs.
pub fn write_poses(files: &RunFiles, results: &LocalizationResults) -> Result<()> {
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

/// Inputs and settings of a run in a map, for its report.
pub fn about(
    results: &LocalizationResults,
    (recording, map_input): (&RecordingConfig, &MapInputConfig),
    map: &Map,
    odometry: String,
    seed: u64,
) -> BTreeMap<String, String> {
    [
        ("recording", recording.scan_folder.display().to_string()),
        ("map", map_input.map_file.display().to_string()),
        ("odometry", odometry),
        ("renderer", map.renderer.name()),
        ("seed", seed.to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into_iter()
    .chain(shortfall(results))
    .collect()
}

/// The entry of a report about the inertial sensor of a recording: what was found about it, or that it is left out.
pub fn inertial(config: &InertialConfig, frames: &[Frame]) -> Option<(String, String)> {
    let path = config.imu_file.as_ref()?.display();
    let found = match &frames.first()?.gyroscope {
        Some(gyroscope) => {
            let calibration = gyroscope.calibration();
            let (roll, pitch, yaw) = calibration.lidar_from_imu.euler_angles();
            let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_degrees);
            let offset_ms = 1e3 * calibration.offset_s;
            format!(
                "{path}, offset of its clock {offset_ms:.1} ms, axes roll {roll:.1}, pitch {pitch:.1}, yaw {yaw:.1} deg"
            )
        }
        None => format!("{path}, left out"),
    };
    Some(("inertial sensor".to_owned(), found))
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

/// Summarizes a run, and compares the estimates of the tracked frames and the trusted poses of the refined trajectory with
/// the ground truth, if there is one.
pub fn evaluate(
    results: &LocalizationResults,
    rules: &RangeMclRules,
    about: BTreeMap<String, String>,
) -> Result<Report> {
    let estimates = results.estimates_or_particle_means(rules)?;
    let evaluated = results.with_truth_only();
    let truth_in_space = evaluated.ground_truth_in_space.as_deref();
    let report = |trajectory: &EvaluatedTrajectory,
                  in_space: &Option<Column<Pose3>>,
                  covariances: &Option<Column<Matrix3<f64>>>| {
        let in_space = in_space.as_deref().zip(truth_in_space);
        if trajectory.trusted_after(skipped(trajectory)).is_empty() {
            return Ok(None);
        }
        evaluate_trajectory(trajectory, in_space, covariances.as_deref(), rules).map(Some)
    };
    let (mut mcl, mut refined) = (None, None);
    if let Some(ground_truth) = evaluated.ground_truth.as_deref() {
        let tracked = evaluated.tracked();
        let of_filter = EvaluatedTrajectory {
            estimates: &evaluated.estimates_or_particle_means(rules)?,
            ground_truth,
            times_s: evaluated.times_s.as_deref(),
            runtimes_s: evaluated.runtimes_s.as_deref(),
            trusted: tracked.as_deref(),
        };
        mcl = report(
            &of_filter,
            &evaluated.estimates_in_space,
            &evaluated.covariances,
        )?;
        if let Some(poses) = &evaluated.refined {
            let of_refined = EvaluatedTrajectory {
                estimates: poses,
                runtimes_s: evaluated.refine_runtimes_s.as_deref(),
                trusted: Some(&evaluated.refined_trusted()),
                ..of_filter
            };
            refined = report(
                &of_refined,
                &evaluated.refined_in_space,
                &evaluated.refined_covariances,
            )?;
        }
    }
    let summary = RunSummary::of(results, &estimates);
    let refinement = RefinementSummary::of(results, &estimates);
    Ok(Report {
        about,
        localized: (refinement.as_ref())
            .and_then(|it| it.trajectory.localized())
            .or(summary.localized()),
        summary,
        live: None,
        refinement,
        has_true_poses: results.ground_truth.is_some(),
        mcl,
        refined,
        trajectory: None,
    })
}

/// Computes the errors of one trajectory.
pub fn evaluate_trajectory(
    trajectory: &EvaluatedTrajectory,
    in_space: Option<(&[Pose3], &[Pose3])>,
    covariances: Option<&[Matrix3<f64>]>,
    rules: &RangeMclRules,
) -> Result<TrajectoryReport> {
    let config = MetricsConfig {
        skip_frames: skipped(trajectory),
        ..MetricsConfig::default()
    };
    let rows = trajectory.trusted_after(config.skip_frames);
    let error = |row: usize| {
        PlanarError::between(&trajectory.estimates[row], &trajectory.ground_truth[row])
    };
    let consistency = covariances.and_then(|covariances| {
        Consistency::new(rows.iter().map(|&row| (error(row), &covariances[row])))
    });
    Ok(TrajectoryReport {
        consistency,
        range_mcl: rules.evaluate(trajectory.estimates, trajectory.ground_truth),
        metrics: TrajectoryMetrics::new(trajectory, &config)?,
        in_space: in_space.and_then(|(estimates, truth)| {
            SpatialMetrics::new(&pick(estimates, &rows), &pick(truth, &rows), 0)
        }),
    })
}

/// Number of frames at the beginning that are not evaluated: at least half of a short run is.
fn skipped(trajectory: &EvaluatedTrajectory) -> usize {
    let frames = trajectory.ground_truth.len();
    MetricsConfig::default().skip_frames.min(frames / 2)
}
