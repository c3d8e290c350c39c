//! `simulate`: a drive through a procedural street, written in the layout of KITTI.
//!
//! A drive becomes
//!
//! ```text
//! drive_1/velodyne/000000.bin ...   points
//! drive_1/labels/000000.label ...   a SemanticKITTI class per point
//! drive_1/calib.txt times.txt odometry.txt
//! drive_1/street.ply                what stands still, in the map frame: the truth of a map
//! drive_1/simulation.yml            the configuration, written first
//! drive_1/source.txt                a hash of the source of the program that made it
//! drive_1/poses.txt                 written last
//! ```
//!
//! Every file is written under a temporary name and renamed. A drive is complete where all of them
//! are. One that was interrupted, or that has lost files since, goes on where it was when it is
//! simulated again with the same configuration by a program of the same source.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

use anyhow::{Context as _, Result, bail};
use rayon::prelude::*;

use super::interrupt::{Interrupt, Interrupted};
use super::output::replace as write_whole;
use super::progress::Task;
use super::{Context, version};
use crate::geometry::Pose3;
use crate::kitti::poses::{CameraPoses, write_kitti, write_times};
use crate::kitti::velodyne::{write_labels, write_scan};
use crate::kitti::{Calibration, KittiError};
use crate::map::ply;
use crate::simulation::{Simulation, SimulationConfig, calibration};

/// What becomes of a drive that is there already.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Existing {
    /// It is kept where it is what would be made now; anything else is an error.
    Keep,
    /// As `Keep`, but what a program of other source made of the same configuration is made anew.
    Renew,
    /// It is made anew, whatever it is.
    Replace,
}

/// Name of the file that says by which source a drive was made.
const SOURCE_FILE: &str = "source.txt";

/// What a run did.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulationReport {
    /// The folder of the drive.
    pub folder: PathBuf,
    /// Scans of the drive.
    pub frames: usize,
    /// Scans that were there already.
    pub kept: usize,
    /// Triangles of the street.
    pub triangles: usize,
    /// Length of the drive [m].
    pub driven_m: f64,
}

/// Simulates a drive. `progress` is told how many scans are done, of how many. When `interrupt` is
/// requested, the scans that are being made are finished, and the rest is left for the next run.
///
/// A complete drive with the same configuration, made by a program of the same source, is kept as it
/// is, also where it was moved to; where a part of it is missing, that part is made. What becomes of
/// anything else, `existing` says.
pub fn run(
    config: &SimulationConfig,
    existing: Existing,
    progress: &(dyn Fn(usize, usize) + Sync),
    interrupt: &Interrupt,
) -> Result<SimulationReport> {
    let simulation = prepare(config)?;
    let folder = config.drive_folder();
    let recipe = serde_yaml::to_string(config).context("writing the configuration as YAML")?;
    let poses = simulation.poses();
    let report = |kept| SimulationReport {
        folder: folder.clone(),
        frames: simulation.frames(),
        kept,
        triangles: simulation.street.mesh.triangles.len(),
        driven_m: length_m(&poses),
    };
    match (state_of(config, &simulation)?, existing) {
        (State::Complete, Existing::Keep | Existing::Renew) => {
            return Ok(report(simulation.frames()));
        }
        (State::Foreign, Existing::Keep | Existing::Renew) => bail!(
            "{} holds something else, such as a drive of another configuration; choose another output_folder, remove that folder, or overwrite it with simulate --force",
            folder.display()
        ),
        (State::Outdated, Existing::Keep) => bail!(
            "{} was made by a program of other source, which may have made other scans; choose another output_folder, remove that folder, or overwrite it with simulate --force",
            folder.display()
        ),
        (State::Outdated, Existing::Renew) => {
            tracing::info!(
                "{} was made by a program of other source and is made anew",
                folder.display()
            );
            clear(&folder)?;
        }
        (_, Existing::Replace) => clear(&folder)?,
        (State::Empty | State::Interrupted, _) => {}
    }
    for name in ["velodyne", "labels"] {
        let path = folder.join(name);
        fs::create_dir_all(&path).with_context(|| format!("cannot create {}", path.display()))?;
    }
    write_whole(&folder.join("simulation.yml"), |path| {
        fs::write(path, &recipe).with_context(|| format!("cannot write {}", path.display()))
    })?;
    write_whole(&folder.join(SOURCE_FILE), |path| {
        fs::write(path, version::DRIVE_SOURCE)
            .with_context(|| format!("cannot write {}", path.display()))
    })?;
    write_whole(&folder.join("street.ply"), |path| {
        Ok(ply::write(path, &simulation.truth_in_map())?)
    })?;
    let kept = write_scans(&simulation, &folder, progress, interrupt)?;
    write_poses(&simulation, &folder, &poses)?;
    Ok(report(kept))
}

/// As [`run`], shown to the user; returns the table for standard output.
pub fn run_with_progress(
    config: &SimulationConfig,
    existing: Existing,
    context: &Context,
) -> Result<String> {
    let task: OnceLock<Arc<Task>> = OnceLock::new();
    let progress = |_done: usize, all: usize| {
        task.get_or_init(|| context.progress.task("simulate", all))
            .advance(1);
    };
    let report = run(config, existing, &progress, &context.interrupt)?;
    drop(task);
    let rows = [
        ("folder", report.folder.display().to_string()),
        ("scans", report.frames.to_string()),
        ("of them kept", report.kept.to_string()),
        ("path", format!("{:.1} m", report.driven_m)),
        ("triangles of the street", report.triangles.to_string()),
    ];
    Ok(rows
        .iter()
        .map(|(name, value)| format!("{name:<24} {value:>14}\n"))
        .collect())
}

/// The street and the drive of a configuration, without writing anything.
pub fn prepare(config: &SimulationConfig) -> Result<Simulation> {
    let recorded = match &config.path_pose_file {
        Some(pose_file) => Some(recorded_path(pose_file, config.path_calib_file.as_deref())?),
        None => None,
    };
    Ok(Simulation::new(config, recorded.as_deref())?)
}

fn recorded_path(pose_file: &Path, calib_file: Option<&Path>) -> Result<Vec<Pose3>> {
    let beside = pose_file.with_file_name("calib.txt");
    let calibration = Calibration::read(calib_file.unwrap_or(&beside))
        .context("path_pose_file needs its calibration; name it with path_calib_file")?;
    Ok(CameraPoses::read(pose_file)?.map_from_lidar(&calibration))
}

/// What lies in the folder of a drive.
enum State {
    Empty,
    /// A part of this very drive.
    Interrupted,
    /// All of this very drive.
    Complete,
    /// This drive, or a part of it, as a program of other source made it.
    Outdated,
    /// Anything else.
    Foreign,
}

fn state_of(config: &SimulationConfig, simulation: &Simulation) -> Result<State> {
    let folder = config.drive_folder();
    let Ok(mut entries) = fs::read_dir(&folder) else {
        return Ok(State::Empty);
    };
    let Ok(text) = fs::read_to_string(folder.join("simulation.yml")) else {
        let is_empty = entries.next().is_none();
        return Ok(if is_empty {
            State::Empty
        } else {
            State::Foreign
        });
    };
    let Ok(found) = serde_yaml::from_str::<SimulationConfig>(&text) else {
        return Ok(State::Foreign);
    };
    if recipe_anywhere(&found)? != recipe_anywhere(config)? {
        return Ok(State::Foreign);
    }
    let paths = |config: &SimulationConfig| {
        let SimulationConfig {
            path_pose_file,
            path_calib_file,
            ..
        } = config.clone();
        [path_pose_file, path_calib_file]
    };
    let is_same_path = paths(&found) == paths(config);
    let is_same_source =
        fs::read(folder.join(SOURCE_FILE)).is_ok_and(|by| by == version::DRIVE_SOURCE.as_bytes());
    Ok(match fs::read(folder.join("poses.txt")) {
        // Other source may drive along another path.
        _ if !is_same_source && is_same_path => State::Outdated,
        // A recorded path is the same where the drive follows it, wherever it lies.
        Ok(poses) if poses != poses_text(simulation)? => State::Foreign,
        Ok(_) if !is_same_source => State::Outdated,
        Ok(_) if is_whole(&folder, simulation.frames()) => State::Complete,
        Ok(_) => State::Interrupted,
        Err(_) if is_same_path => State::Interrupted,
        Err(_) => State::Foreign,
    })
}

/// What a drive follows from, wherever it and its recorded path lie.
fn recipe_anywhere(config: &SimulationConfig) -> Result<String> {
    let nowhere = SimulationConfig {
        output_folder: PathBuf::new(),
        path_pose_file: None,
        path_calib_file: None,
        ..config.clone()
    };
    serde_yaml::to_string(&nowhere).context("writing the configuration as YAML")
}

/// What `poses.txt` has.
fn poses_text(simulation: &Simulation) -> Result<Vec<u8>> {
    let file = tempfile::NamedTempFile::new().context("cannot create a temporary file")?;
    let origin = Pose3::identity();
    write_kitti(file.path(), &simulation.poses(), &origin, &calibration())?;
    fs::read(file.path()).with_context(|| format!("cannot read {}", file.path().display()))
}

/// Whether every file of a drive is there.
fn is_whole(folder: &Path, frames: usize) -> bool {
    let tables = ["street.ply", "calib.txt", "times.txt", "odometry.txt"].map(str::to_owned);
    let scans = (0..frames).flat_map(|frame| {
        [
            format!("velodyne/{frame:06}.bin"),
            format!("labels/{frame:06}.label"),
        ]
    });
    (tables.into_iter().chain(scans)).all(|name| folder.join(name).exists())
}

/// Removes what a drive consists of, and nothing else; `poses.txt` first. What says how it was made
/// stays and is written over, so that a folder that is half cleared is still known for what it is.
fn clear(folder: &Path) -> Result<()> {
    let mut paths = ["poses.txt", "street.ply"]
        .map(|name| folder.join(name))
        .to_vec();
    for (name, extension) in [("velodyne", "bin"), ("labels", "label")] {
        for entry in fs::read_dir(folder.join(name)).into_iter().flatten() {
            let path = entry?.path();
            if path.extension().is_some_and(|found| found == extension) {
                paths.push(path);
            }
        }
    }
    for path in paths.iter().filter(|path| path.exists()) {
        fs::remove_file(path).with_context(|| format!("cannot remove {}", path.display()))?;
    }
    Ok(())
}

/// Writes the scans that are missing; returns how many were there.
fn write_scans(
    simulation: &Simulation,
    folder: &Path,
    progress: &(dyn Fn(usize, usize) + Sync),
    interrupt: &Interrupt,
) -> Result<usize> {
    let done = AtomicUsize::new(0);
    let kept = AtomicUsize::new(0);
    (0..simulation.frames())
        .into_par_iter()
        .try_for_each(|frame| -> Result<()> {
            if interrupt.requested() {
                return Ok(());
            }
            let scan_path = folder.join(format!("velodyne/{frame:06}.bin"));
            let label_path = folder.join(format!("labels/{frame:06}.label"));
            if scan_path.exists() && label_path.exists() {
                kept.fetch_add(1, Ordering::Relaxed);
            } else {
                let labelled = simulation.scan(frame);
                write_whole(&label_path, |path| {
                    Ok(write_labels(path, &labelled.classes)?)
                })?;
                write_whole(&scan_path, |path| Ok(write_scan(path, &labelled.scan)?))?;
            }
            progress(
                done.fetch_add(1, Ordering::Relaxed) + 1,
                simulation.frames(),
            );
            Ok(())
        })?;
    let (done, frames) = (done.into_inner(), simulation.frames());
    if done < frames {
        let kept = format!(
            "{done} of {frames} scans are kept in {}; the same command goes on from there",
            folder.display()
        );
        return Err(Interrupted { kept }.into());
    }
    Ok(kept.into_inner())
}

fn write_poses(simulation: &Simulation, folder: &Path, poses: &[Pose3]) -> Result<()> {
    let calibration = calibration();
    let origin = Pose3::identity();
    let kitti = |path: &Path, poses: &[Pose3]| -> Result<(), KittiError> {
        write_kitti(path, poses, &origin, &calibration)
    };
    write_whole(&folder.join("calib.txt"), |path| {
        Ok(calibration.write(path)?)
    })?;
    write_whole(&folder.join("times.txt"), |path| {
        Ok(write_times(path, &simulation.times_s())?)
    })?;
    write_whole(&folder.join("odometry.txt"), |path| {
        Ok(kitti(path, &simulation.odometry())?)
    })?;
    write_whole(&folder.join("poses.txt"), |path| Ok(kitti(path, poses)?))
}

fn length_m(poses: &[Pose3]) -> f64 {
    poses
        .windows(2)
        .map(|pair| (pair[1].translation.vector - pair[0].translation.vector).norm())
        .sum()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::kitti::{Selection, Sequence, velodyne};
    use crate::simulation::{PathSegment, ScannerConfig};

    fn small(folder: &Path) -> SimulationConfig {
        SimulationConfig {
            output_folder: folder.to_owned(),
            n_scans: 6,
            path: vec![PathSegment {
                length_m: 30.0,
                turn_deg: 20.0,
                grade_percent: 2.0,
            }],
            scanner: ScannerConfig {
                beams: 16,
                azimuth_steps: 90,
                ..ScannerConfig::default()
            },
            ..SimulationConfig::default()
        }
    }

    fn quietly(config: &SimulationConfig, existing: Existing) -> Result<SimulationReport> {
        run(config, existing, &|_, _| {}, &Interrupt::default())
    }

    /// Every file of a drive with its bytes, except the recipe, which names the folder.
    fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
        let mut files = Vec::new();
        for part in ["", "velodyne", "labels"] {
            for entry in fs::read_dir(folder.join(part)).unwrap() {
                let path = entry.unwrap().path();
                if path.is_file() && !path.ends_with("simulation.yml") {
                    let name = path.strip_prefix(folder).unwrap().to_owned();
                    files.push((name, fs::read(&path).unwrap()));
                }
            }
        }
        files.sort();
        files
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes_at_any_number_of_threads() {
        let written = [1, 2, 5].map(|threads| {
            let folder = tempfile::tempdir().unwrap();
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| quietly(&small(folder.path()), Existing::Keep))
                .unwrap();
            contents(&folder.path().join("drive_1"))
        });
        assert_eq!(written[0].len(), 6 + 2 * 6);
        assert_eq!(written[0], written[1]);
        assert_eq!(written[0], written[2]);
    }

    #[test]
    fn an_interrupted_drive_goes_on_and_ends_with_the_same_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let config = small(folder.path());
        let drive = config.drive_folder();
        assert_eq!(quietly(&config, Existing::Keep).unwrap().kept, 0);
        let whole = contents(&drive);
        // As after a crash in the middle: no poses yet, scans missing, one half written.
        fs::remove_file(drive.join("poses.txt")).unwrap();
        fs::remove_file(drive.join("velodyne/000004.bin")).unwrap();
        fs::remove_file(drive.join("velodyne/000005.bin")).unwrap();
        fs::write(drive.join("velodyne/000004.bin.part"), [1, 2, 3]).unwrap();
        assert_eq!(quietly(&config, Existing::Keep).unwrap().kept, 4);
        assert_eq!(contents(&drive), whole);
    }

    #[test]
    fn an_interrupt_keeps_the_scans_that_are_done_and_says_how_many() {
        let folder = tempfile::tempdir().unwrap();
        let config = small(folder.path());
        let interrupt = Interrupt::default();
        let after_two = |done: usize, _all: usize| {
            if done == 2 {
                interrupt.request();
            }
        };
        let one_thread = rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .build()
            .unwrap();
        let stopped = one_thread.install(|| run(&config, Existing::Keep, &after_two, &interrupt));
        let message = stopped.unwrap_err().to_string();
        assert!(message.contains("2 of 6 scans are kept"), "{message}");
        assert!(!config.drive_folder().join("poses.txt").exists());
        assert_eq!(quietly(&config, Existing::Keep).unwrap().kept, 2);
    }

    #[test]
    fn what_exists_is_kept_without_force_and_replaced_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let config = small(folder.path());
        quietly(&config, Existing::Keep).unwrap();
        let before = contents(&config.drive_folder());
        assert_eq!(quietly(&config, Existing::Keep).unwrap().kept, 6);

        let mut other = config.clone();
        other.seed = 2;
        other.n_scans = 3;
        let message = quietly(&other, Existing::Keep).unwrap_err().to_string();
        assert!(message.contains("--force"), "{message}");
        assert_eq!(contents(&config.drive_folder()), before);

        quietly(&other, Existing::Replace).unwrap();
        let after = contents(&config.drive_folder());
        assert_eq!(after.len(), 6 + 2 * 3, "scans of the old drive are gone");
    }

    #[test]
    fn a_drive_that_other_source_made_is_told_or_made_anew() {
        let folder = tempfile::tempdir().unwrap();
        let config = small(folder.path());
        let drive = config.drive_folder();
        quietly(&config, Existing::Keep).unwrap();
        let whole = contents(&drive);
        let age = || fs::write(drive.join("source.txt"), "another").unwrap();
        let make_old_scan = || fs::write(drive.join("velodyne/000002.bin"), [0; 16]).unwrap();
        assert_eq!(quietly(&config, Existing::Renew).unwrap().kept, 6);

        for is_complete in [true, false] {
            age();
            make_old_scan();
            if !is_complete {
                fs::remove_file(drive.join("poses.txt")).unwrap();
            }
            let message = quietly(&config, Existing::Keep).unwrap_err().to_string();
            for told in ["other source", "remove that folder", "--force"] {
                assert!(message.contains(told), "{message}");
            }
            assert_eq!(quietly(&config, Existing::Renew).unwrap().kept, 0);
            assert_eq!(contents(&drive), whole);
        }
        // As it was before drives said what made them.
        fs::remove_file(drive.join("source.txt")).unwrap();
        assert_eq!(quietly(&config, Existing::Renew).unwrap().kept, 0);

        // Of another configuration it is not for a comparison to replace it.
        age();
        let other = SimulationConfig { seed: 2, ..config };
        let message = quietly(&other, Existing::Renew).unwrap_err().to_string();
        assert!(message.contains("another configuration"), "{message}");
        assert!(message.contains("remove that folder"), "{message}");
    }

    #[test]
    fn a_drive_of_which_only_the_poses_are_left_is_made_again() {
        let folder = tempfile::tempdir().unwrap();
        let config = small(folder.path());
        let drive = config.drive_folder();
        quietly(&config, Existing::Keep).unwrap();
        let whole = contents(&drive);
        for part in ["velodyne/000002.bin", "labels/000003.label", "odometry.txt"] {
            fs::remove_file(drive.join(part)).unwrap();
        }
        assert_eq!(quietly(&config, Existing::Keep).unwrap().kept, 4);
        assert_eq!(contents(&drive), whole);
        fs::remove_dir_all(drive.join("velodyne")).unwrap();
        fs::remove_dir_all(drive.join("labels")).unwrap();
        assert_eq!(quietly(&config, Existing::Keep).unwrap().kept, 0);
        assert_eq!(contents(&drive), whole);
    }

    #[test]
    fn a_drive_that_was_moved_is_kept_and_one_along_another_path_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let poses = folder.path().join("path.txt");
        let straight = |step_m: f64| {
            let row = |k| format!("1 0 0 0 0 1 0 0 0 0 1 {}\n", step_m * f64::from(k));
            (0..12).map(row).collect::<String>()
        };
        fs::write(&poses, straight(3.0)).unwrap();
        let calib = folder.path().join("calib.txt");
        fs::write(&calib, "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n").unwrap();
        let here = SimulationConfig {
            path_pose_file: Some(poses.clone()),
            path: Vec::new(),
            ..small(&folder.path().join("here"))
        };
        quietly(&here, Existing::Keep).unwrap();
        fs::rename(folder.path().join("here"), folder.path().join("there")).unwrap();
        let moved_poses = folder.path().join("moved.txt");
        fs::rename(&poses, &moved_poses).unwrap();
        let there = SimulationConfig {
            output_folder: folder.path().join("there"),
            path_pose_file: Some(moved_poses.clone()),
            ..here
        };
        assert_eq!(quietly(&there, Existing::Keep).unwrap().kept, 6);
        fs::write(&moved_poses, straight(2.7)).unwrap();
        let message = quietly(&there, Existing::Keep).unwrap_err().to_string();
        assert!(message.contains("--force"), "{message}");
    }

    #[test]
    fn drives_are_read_back_in_the_frames_that_the_documentation_promises() {
        let folder = tempfile::tempdir().unwrap();
        let mapping = small(folder.path());
        let query = SimulationConfig {
            drive: 2,
            ..mapping.clone()
        };
        let [map, query] = [mapping, query].map(|config| {
            quietly(&config, Existing::Keep).unwrap();
            let drive = config.drive_folder();
            let sequence = Sequence::open(
                &drive.join("velodyne"),
                &drive.join("poses.txt"),
                &drive.join("calib.txt"),
                &Selection::default(),
            )
            .unwrap();
            let poses = CameraPoses::read(&drive.join("poses.txt")).unwrap();
            (prepare(&config).unwrap().poses(), sequence, poses, drive)
        });
        let (truth, sequence, ..) = &map;
        for (frame, pose) in sequence.frames.iter().zip(truth) {
            let expected = truth[0].inverse() * pose;
            assert_relative_eq!(frame.map_from_lidar, expected, epsilon = 1e-6);
        }
        let calibration = sequence.frame.calibration;
        for (pose, world_from_cam0) in query.0.iter().zip(&query.2.world_from_cam0) {
            let in_map = calibration.map_from_lidar(&map.2.world_from_cam0[0], world_from_cam0);
            assert_relative_eq!(in_map, truth[0].inverse() * pose, epsilon = 1e-6);
        }
        let labels = velodyne::read_labels(&query.3.join("labels/000003.label")).unwrap();
        assert_eq!(labels.len(), query.1.frames[3].read().unwrap().len());
        // Two drives start in different places.
        assert!((map.0[0].inverse() * query.0[0]).translation.vector.norm() > 0.2);
    }

    #[test]
    fn a_missing_pose_file_is_told_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = small(folder.path());
        config.path_pose_file = Some(folder.path().join("07.txt"));
        let message = format!("{:#}", quietly(&config, Existing::Keep).unwrap_err());
        assert!(message.contains("calib.txt"), "{message}");
        assert!(message.contains("path_calib_file"), "{message}");
    }
}
