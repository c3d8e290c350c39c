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
//! drive_1/executable.txt            hash of the executable that made it
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
use super::output::{self, write_file};
use super::progress::Task;
use super::{Context, version};
use crate::geometry::Pose3;
use crate::map::ply;
use crate::recording::poses::{CameraPoses, write_kitti, write_times};
use crate::recording::velodyne::{write_labels, write_scan};
use crate::recording::{Calibration, MapFrame};
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
const EXECUTABLE_FILE: &str = "executable.txt";

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
        triangles: simulation.street.surface.mesh.triangles.len(),
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
            "{} was made by another build of the program, which may have made other scans; choose another output_folder, remove that folder, or overwrite it with simulate --force",
            folder.display()
        ),
        (State::Outdated, Existing::Renew) => {
            tracing::info!(
                "{} was made by another build of the program and is made anew",
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
    output::write_text(&folder.join("simulation.yml"), &recipe)?;
    output::write_text(&folder.join(EXECUTABLE_FILE), &version::executable_hash()?)?;
    output::replace(&folder.join("street.ply"), |path| {
        Ok(ply::write(path, &simulation.street_in_map())?)
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
    let executable = version::executable_hash()?;
    let is_same_source =
        fs::read(folder.join(EXECUTABLE_FILE)).is_ok_and(|by| by == executable.as_bytes());
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
    let mut text = Vec::new();
    write_kitti(&mut text, &simulation.poses(), &map_frame())?;
    Ok(text)
}

/// The frame of the poses of a drive; its world frame is that of the street.
fn map_frame() -> MapFrame {
    MapFrame {
        calibration: calibration(),
        world_from_first_cam0: Pose3::identity(),
    }
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
                write_file(&label_path, |file| write_labels(file, &labelled.classes))?;
                write_file(&scan_path, |file| write_scan(file, &labelled.scan))?;
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
    let frame = map_frame();
    let write_poses = |name: &str, poses: &[Pose3]| {
        write_file(&folder.join(name), |file| write_kitti(file, poses, &frame))
    };
    write_file(&folder.join("calib.txt"), |file| {
        frame.calibration.write(file)
    })?;
    write_file(&folder.join("times.txt"), |file| {
        write_times(file, &simulation.times_s())
    })?;
    write_poses("odometry.txt", &simulation.odometry())?;
    write_poses("poses.txt", poses)
}

fn length_m(poses: &[Pose3]) -> f64 {
    poses
        .windows(2)
        .map(|pair| (pair[1].translation.vector - pair[0].translation.vector).norm())
        .sum()
}

#[cfg(test)]
#[path = "simulate_tests.rs"]
mod tests;
