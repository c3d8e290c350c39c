//! `simulate`: a drive through a procedural street, written in the layout of KITTI.
//!
//! ```text
//! drive_1/...               the drive, as of [`drive_files`](crate::simulation::drive_files)
//! drive_1/street.ply        the static world in the map frame: ground truth of a map
//! drive_1/.fpmcl            claim of poses.txt, with the key of configuration and executable
//! drive_1/simulation.yml    the configuration
//! ```
//!
//! Every file is written atomically. A drive is complete if all of them exist. One that was
//! interrupted, or has lost files since, is completed when it is simulated again with the same
//! configuration by the same executable.

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

use anyhow::{Context as _, Result, bail};
use schemars::JsonSchema;
use serde::Serialize;

use crate::app::run::artefact::hash::hash_of_texts;
use crate::app::run::memory;
use crate::app::run::{Claims, Context, Interrupt, Printed, Task, output, version};
use crate::app::settings::to_yaml;
use crate::file_path::FilePath;
use crate::files::{claim_folder, remove_abandoned};
use crate::geometry::{Pose3, distances_m};
use crate::map::files::ply;
use crate::recording::Calibration;
use crate::recording::poses::CameraPoses;
use crate::simulation::drive_files::{POSES_FILE, all_scan_files};
use crate::simulation::{Simulation, SimulationConfig};

/// Treatment of an existing drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Existing {
    /// Keeps a drive of the same configuration and executable; anything else is an error.
    Keep,
    /// Like `Keep`, but replaces a drive of the same configuration by another executable.
    Renew,
    /// Replaces any drive.
    Replace,
}

/// The static world in the map frame: ground truth of a map.
const STREET_FILE: &str = "street.ply";

/// Remedy for a folder that cannot be used.
const REMEDY: &str =
    "choose another output_folder, remove that folder, or overwrite it with simulate --force";

/// Summary of a simulated drive.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct SimulationReport {
    /// Folder of the drive.
    pub folder: FilePath,
    /// Number of scans.
    pub frames: usize,
    /// Number of scans that existed before.
    pub kept: usize,
    /// Number of triangles of the street.
    pub triangles: usize,
    /// Length of the drive [m].
    pub driven_m: f64,
}

/// Simulates a drive and shows its progress; returns the table for standard output.
pub fn run(config: &SimulationConfig, existing: Existing, context: &Context) -> Result<Printed> {
    let task: OnceLock<Arc<Task>> = OnceLock::new();
    let progress = |_done: usize, all: usize| {
        task.get_or_init(|| context.progress.task("simulate", all))
            .advance(1);
    };
    let report = write_drive(config, existing, &progress, &context.interrupt)?;
    drop(task);
    let rows = [
        ("folder", report.folder.display().to_string()),
        ("scans", report.frames.to_string()),
        ("of them kept", report.kept.to_string()),
        ("path", format!("{:.1} m", report.driven_m)),
        ("triangles of the street", report.triangles.to_string()),
    ];
    Printed::rows(&rows, &report)
}

/// Simulates a drive and writes what is missing of it. `progress` gets the number of finished
/// scans and that of all. On an interrupt, the current scans are finished and the rest is left for
/// the next run.
fn write_drive(
    config: &SimulationConfig,
    existing: Existing,
    progress: &(dyn Fn(usize, usize) + Sync),
    interrupt: &Interrupt,
) -> Result<SimulationReport> {
    let simulation = prepare(config)?;
    let folder = config.drive_folder();
    interrupt.keeps(format!(
        "finished scans are kept in {}; the same command continues from there",
        folder.display()
    ));
    let main = folder.join(POSES_FILE);
    let key = key(config)?;
    let mut claims = Claims::read(&folder)?;
    let kept = if resolve_existing(config, &claims, &key, &simulation, existing)? {
        simulation.frames()
    } else {
        output::create_folder(&folder)?;
        claim_folder(&folder)?;
        remove_abandoned(&folder)?;
        claims.begin_with_key(&main, &key)?;
        write_constants(config, &simulation)?;
        let kept = write_scans(&simulation, &folder, progress, interrupt)?;
        simulation.write_tables(&folder)?;
        claims.finish(&main)?;
        kept
    };
    Ok(SimulationReport {
        frames: simulation.frames(),
        kept,
        triangles: simulation.street.surface.mesh.triangles.len(),
        driven_m: distances_m(&simulation.poses())
            .last()
            .copied()
            .unwrap_or_default(),
        folder: folder.into(),
    })
}

/// The street and the drive of a configuration, without writing anything.
fn prepare(config: &SimulationConfig) -> Result<Simulation> {
    let recorded = match &config.path_pose_file {
        Some(pose_file) => Some(recorded_path(pose_file, config.path_calib_file.as_deref())?),
        None => None,
    };
    Ok(Simulation::new(
        config,
        recorded.as_deref(),
        memory::budget(),
    )?)
}

fn recorded_path(pose_file: &Path, calib_file: Option<&Path>) -> Result<Vec<Pose3>> {
    let neighbour = pose_file.with_file_name("calib.txt");
    let calibration = Calibration::read(calib_file.unwrap_or(&neighbour))
        .context("path_pose_file needs its calibration; name it with path_calib_file")?;
    Ok(CameraPoses::read(pose_file)?.map_from_lidar(&calibration))
}

/// Key of a drive: the hash of its configuration, wherever it and its recorded path are, and that of the executable.
fn key(config: &SimulationConfig) -> Result<String> {
    let path = config.path_pose_file.as_deref();
    let path = path.map(|pose_file| recorded_path(pose_file, config.path_calib_file.as_deref()));
    let anywhere = SimulationConfig {
        output_folder: FilePath::default(),
        path_pose_file: None,
        path_calib_file: None,
        ..config.clone()
    };
    let inputs = hash_of_texts(&[to_yaml(&anywhere)?, format!("{:?}", path.transpose()?)]);
    Ok(format!("{inputs}:{}", version::executable_hash()?))
}

/// Applies `existing` to the folder of the drive with a key; returns whether a complete drive is kept.
fn resolve_existing(
    config: &SimulationConfig,
    claims: &Claims,
    key: &str,
    simulation: &Simulation,
    existing: Existing,
) -> Result<bool> {
    let folder = config.drive_folder();
    let name = folder.display();
    // What a run leaves that was killed before it claimed the drive is nothing.
    let is_early = |entry: &fs::DirEntry| entry.file_name().to_string_lossy().starts_with(".fpmcl");
    let mut entries = fs::read_dir(&folder).into_iter().flatten().flatten();
    let is_empty = entries.all(|entry| is_early(&entry));
    let is_same_drive = |found: &str| found.split(':').next() == key.split(':').next();
    match (claims.key(&folder.join(POSES_FILE)), existing) {
        _ if is_empty => return Ok(false),
        (None, Existing::Replace) => bail!(
            "{name} contains files that were not written by fpmcl simulate; choose another output_folder, or move that folder"
        ),
        (Some(_), Existing::Replace) => {}
        (Some(found), _) if found == key => return Ok(is_complete(&folder, claims, simulation)),
        (Some(found), Existing::Keep) if is_same_drive(found) => {
            bail!("{name} was written by another build of the program and may differ; {REMEDY}")
        }
        (Some(found), Existing::Renew) if is_same_drive(found) => {
            tracing::info!("{name} was written by another build of the program and is replaced");
        }
        _ => bail!("{name} contains other files or a drive of another configuration; {REMEDY}"),
    }
    remove_drive(&folder)?;
    Ok(false)
}

/// Whether a drive is finished and has lost no file since.
fn is_complete(folder: &Path, claims: &Claims, simulation: &Simulation) -> bool {
    let mut files = simulation.files_in(folder);
    files.push(folder.join(STREET_FILE));
    claims.state(&folder.join(POSES_FILE)) == Some("finished") && files.iter().all(|it| it.exists())
}

/// Removes the files of a drive and nothing else, `poses.txt` first. The claim is kept until the next one, so that a
/// folder that is half removed is still recognized.
fn remove_drive(folder: &Path) -> Result<()> {
    let first = [POSES_FILE, STREET_FILE].map(|name| folder.join(name));
    let scans = all_scan_files(folder)?;
    (first.iter().chain(&scans)).try_for_each(|path| output::remove_if_exists(path))
}

/// Writes what does not depend on the scans: configuration and street.
fn write_constants(config: &SimulationConfig, simulation: &Simulation) -> Result<()> {
    let folder = config.drive_folder();
    output::write_yaml(&folder.join("simulation.yml"), config)?;
    for name in ["velodyne", "labels"] {
        output::create_subfolder(&folder.join(name))?;
    }
    Ok(ply::write(
        &folder.join(STREET_FILE),
        &simulation.street_in_map(),
        None,
    )?)
}

/// Writes the scans that are missing; returns the number of those that are not.
fn write_scans(
    simulation: &Simulation,
    folder: &Path,
    progress: &(dyn Fn(usize, usize) + Sync),
    interrupt: &Interrupt,
) -> Result<usize> {
    let (frames, count) = (simulation.frames(), AtomicUsize::new(0));
    let [done, kept] = simulation.write_missing_scans(folder, &|| {
        progress(count.fetch_add(1, Ordering::Relaxed) + 1, frames);
        interrupt.flow()
    })?;
    if done < frames {
        interrupt.keeps(format!(
            "{done} of {frames} scans are kept in {}; the same command continues from there",
            folder.display()
        ));
        return Err(interrupt.error().into());
    }
    Ok(kept)
}

#[cfg(test)]
#[path = "simulate_tests.rs"]
mod tests;
