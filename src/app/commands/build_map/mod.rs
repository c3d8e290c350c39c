//! `build-map`: builds a triangle-mesh map from scans, whose poses are given or found first.

mod clock;
mod cloud;
mod files;
mod onto;
mod parts;
mod pictures;
mod pose_check;
mod poses;
mod report;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use anyhow::{Context as _, Result};

use self::clock::StageClock;
use self::files::{prepare, write_map};
use self::onto::{ChangesReport, OlderMap};
pub use self::parts::hash_of_scan;
use self::parts::{Joined, Parts, hash_of_scans, joint_hash};
pub use self::report::BuildReport;
use super::claims::Claims;
use super::interrupt::Interrupted;
use super::progress::Task;
use super::trajectory::{self, TrajectorySummary, file_beside};
use super::{Context, input, output, version};
use crate::app::config::{self, BuildMapConfig, PoseSource};
use crate::evaluation::map_quality::{self, BeamResidual};
use crate::evaluation::{MapQuality, TruthAgreement};
use crate::geometry::{Pose3, TriangleMesh};
use crate::map::plan::{LocalMapPlan, key_scans, local_maps};
use crate::map::{
    BuildError, BuildEvent, LocalMap, LocalMapCounts, MapBuilder, MapPlan, MappingPath, changes,
    ply, scan_agreement,
};
use crate::recording::{Frame, Recording};
use crate::sensor::SensorDescription;

/// Builds the map that a configuration describes.
pub fn run(config: &BuildMapConfig, context: &Context) -> Result<BuildReport> {
    match &config.cloud_file {
        Some(cloud_file) => cloud::run(config, cloud_file, context),
        None => run_with_scans(config, context),
    }
}

/// Builds the map of scans with poses.
fn run_with_scans(config: &BuildMapConfig, context: &Context) -> Result<BuildReport> {
    let started = Instant::now();
    let mut claims = prepare(config, context)?;
    let mut resolved = config.clone();
    let Opened {
        sequence,
        sensor,
        trajectory,
        older,
    } = open(&mut resolved, &mut claims, context)?;
    let config = &resolved;
    let (mapped, held_out) = hold_out(&sequence.frames, config);
    let clock = Arc::new(StageClock::default());
    let parts = Parts::open(&config.mesh_file, &inputs(config, &mapped, older.as_ref())?)?;
    let older = older.as_ref();
    let (local_maps, task) = build_parts(config, context, &mapped, (&parts, &clock), older)?;
    task.note("joining");
    let Joined { mesh: added, gone } = clock.time("join", || parts.join(local_maps.len()))?;
    let poses = poses_of(&mapped);
    let (mesh, added, path) = match older {
        Some(older) => {
            let mesh = changes::joined(&older.mesh, &gone, &added);
            (mesh, added, older.path.extended_by(&poses))
        }
        None => {
            let world_from_map = sequence.world().0;
            let path = MappingPath {
                world_from_map,
                map_from_lidar: poses,
            };
            (added, TriangleMesh::default(), path)
        }
    };
    let residuals = clock.time("quality", || residuals(config, &mesh, &held_out))?;
    write_map(config, &mesh, &path, &mut claims)?;
    let truth = clock.time("truth", || agreement(config, &mesh, &path))?;
    task.note("pictures");
    if config.visualize {
        pictures::draw(config, &mesh, &path.map_from_lidar, &residuals)?;
        if let Some(older) = older {
            let picture = config.mesh_file.with_extension("changes.png");
            onto::draw(older, &gone, &added, &picture)?;
        }
    }
    let report = BuildReport {
        frames: sequence.frames.len(),
        mapped_frames: mapped.len(),
        held_out_frames: held_out.len(),
        sensor,
        trajectory,
        changes: older.map(|older| ChangesReport::of(older, &gone, &added)),
        stage_seconds: clock.seconds(),
        quality: MapQuality::of(&residuals),
        truth,
        octree_cell_m: (local_maps.iter()).fold(0.0, |largest, counts| counts.cell_m.max(largest)),
        local_maps,
        ..BuildReport::of_map(&mesh, &path, &config.mesh_file, started)
    };
    output::write_json(&config.mesh_file.with_extension("report.json"), &report)?;
    output::write_yaml(&config.mesh_file.with_extension("effective.yml"), config)?;
    task.set_share(1.0);
    parts.remove()?;
    claims.finish(&config.mesh_file)?;
    Ok(report)
}

/// The recording of a map.
struct Opened {
    /// The recording with its poses.
    sequence: Recording,
    /// What was inferred about the sensor.
    sensor: Option<SensorDescription>,
    /// What the poses show about themselves, where they were found in this run.
    trajectory: Option<TrajectorySummary>,
    /// The map to which the recording is added.
    older: Option<OlderMap>,
}

/// Opens the recording with its poses, or finds them, and completes the configuration by what the scans show about the
/// sensor.
fn open(config: &mut BuildMapConfig, claims: &mut Claims, context: &Context) -> Result<Opened> {
    let inputs = config.recording_inputs();
    inputs.require()?;
    if let Some(path) = &config.truth_mesh {
        input::require_file("truth_mesh", path)?;
    }
    let (older, older_map) = OlderMap::open(config, context)?.unzip();
    let mut recording = inputs.open(&config.selection())?;
    let given = poses::given(config, &recording)?.map(|track| match &older {
        Some(older) => track.in_map(&older.path.world_from_map),
        None => track,
    });
    let pose_file = given.as_ref().map(|track| track.path.clone());
    if let (Some(track), Some(pose_file)) = (given, &pose_file) {
        recording = recording.with_poses(track)?;
        let origin = format!("pose_file is {}", pose_file.display());
        trajectory::check(&recording, config.max_step_m, &origin)?;
    }
    let (mut sequence, sensor) = config.sensor_keys().resolve(recording)?;
    if let Some(pose_file) = pose_file.filter(|_| config.check_poses) {
        pose_check::check(&sequence)
            .with_context(|| format!("pose_file is {}", pose_file.display()))?;
    }
    let mut trajectory = None;
    if sequence.track.is_none() || config.poses == PoseSource::Polished {
        (sequence, trajectory) = poses::find(
            sequence,
            config,
            older.as_ref().zip(older_map.as_ref()),
            context,
        )?;
        let found = file_beside(&config.mesh_file);
        let origin = format!("the poses from the scans are in {}", found.display());
        trajectory::check(&sequence, config.max_step_m, &origin)?;
    } else if let Some(name) = file_beside(&config.mesh_file).file_name() {
        claims.remove(&[&name.to_string_lossy()])?;
    }
    Ok(Opened {
        sequence: sequence.compensated_by_poses(),
        sensor,
        trajectory,
        older,
    })
}

/// The key scans that build the map, and those that are held out to evaluate it.
fn hold_out(frames: &[Frame], config: &BuildMapConfig) -> (Vec<Frame>, Vec<Frame>) {
    let keys = key_scans(&poses_of(frames), config.displacement_threshold_m);
    let step = config.holdout_step;
    let is_held_out = |row: usize| step > 0 && row % step == step - 1;
    let frames_where = |held_out: bool| {
        let rows = keys.iter().enumerate();
        let rows = rows.filter(|&(row, _)| is_held_out(row) == held_out);
        rows.map(|(_, &key)| frames[key].clone()).collect()
    };
    (frames_where(false), frames_where(true))
}

fn poses_of(frames: &[Frame]) -> Vec<Pose3> {
    let poses = frames.iter().map(|frame| frame.map_from_lidar);
    poses.map(Option::unwrap_or_default).collect()
}

/// Stages of a local map, and about the share of its time before each.
const STAGES: [(&str, f64); 6] = [
    ("scans", 0.0),
    ("moving points", 0.4),
    ("surface", 0.65),
    ("false surfaces", 0.85),
    ("changes", 0.95),
    ("ground", 0.97),
];

/// Share of all work that is left when the local maps are finished.
const JOINING: f64 = 0.03;

/// Progress through the local maps, in scans.
struct MapProgress {
    task: Arc<Task>,
    scans: usize,
    /// Scans of the finished local maps, and of the current one.
    state: Mutex<(usize, usize)>,
}

impl MapProgress {
    /// Begins a local map after the ones before it.
    fn begin(&self, scans: usize) {
        let mut state = self.state();
        *state = (state.0 + state.1, scans);
        self.show(&state, 0.0);
    }

    /// Begins a stage; stages that come again do not move back.
    fn begin_stage(&self, name: &str) {
        self.task.note(name);
        if let Some((_, share)) = STAGES.iter().find(|(stage, _)| *stage == name) {
            self.show(&self.state(), *share);
        }
    }

    fn end_scan(&self) {
        self.task
            .advance_share(STAGES[1].1 * (1.0 - JOINING) / self.scans.max(1) as f64);
    }

    fn show(&self, &(finished, current): &(usize, usize), share: f64) {
        let done = finished as f64 + share * current as f64;
        self.task
            .set_share((1.0 - JOINING) * done / self.scans.max(1) as f64);
    }

    fn state(&self) -> MutexGuard<'_, (usize, usize)> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Builds the local maps that are not finished yet; returns the counts of all, and the progress, which is still open.
fn build_parts(
    config: &BuildMapConfig,
    context: &Context,
    frames: &[Frame],
    (parts, clock): (&Parts, &Arc<StageClock>),
    older: Option<&OlderMap>,
) -> Result<(Vec<LocalMapCounts>, Arc<Task>)> {
    let poses = poses_of(frames);
    let planned = local_maps(&poses, config.local_map_size, config.overlap_m);
    // Scans in two local maps count once, in the one that owns them.
    let task = context.progress.task("build-map", frames.len());
    let progress = Arc::new(MapProgress {
        task: task.clone(),
        scans: planned.iter().map(|local_map| local_map.used.len()).sum(),
        state: Mutex::default(),
    });
    let builder = MapBuilder {
        on_event: {
            let (progress, clock) = (progress.clone(), clock.clone());
            let interrupt = context.interrupt.clone();
            Box::new(move |event| {
                match event {
                    BuildEvent::Stage(name) => {
                        progress.begin_stage(name);
                        clock.begin(name);
                    }
                    BuildEvent::ScanPrepared => progress.end_scan(),
                }
                match interrupt.requested() {
                    true => ControlFlow::Break(()),
                    false => ControlFlow::Continue(()),
                }
            })
        },
        ..MapBuilder::new(config.map())
    };
    let mut plan = builder.plan(poses)?;
    plan.older = older.map(|older| &*older.mesh);
    let mut all = Vec::with_capacity(plan.local_maps.len());
    context.interrupt.keeps(kept(0, &plan, parts));
    for local_map in &plan.local_maps {
        let used = &frames[local_map.used.clone()];
        progress.begin(used.len());
        let counts = match parts.finished(local_map.number, || hash_of_scans(used)) {
            Some(counts) => {
                let (number, count) = (local_map.number + 1, plan.local_maps.len());
                tracing::info!("local map {number} of {count} is finished already");
                counts
            }
            None => {
                let built = build_part(&plan, local_map, frames, parts);
                clock.end();
                built.map_err(|error| interrupted(error, all.len(), &plan, parts))?
            }
        };
        all.push(counts);
        context.interrupt.keeps(kept(all.len(), &plan, parts));
    }
    progress.begin(0);
    Ok((all, task))
}

/// Builds a local map and keeps it.
fn build_part(
    plan: &MapPlan,
    local_map: &LocalMapPlan,
    frames: &[Frame],
    parts: &Parts,
) -> Result<LocalMapCounts> {
    // The hashes of the very points that are meshed.
    let hashes = Mutex::new(BTreeMap::new());
    let read = |key: usize| {
        let frame: &Frame = &frames[key];
        let scan = frame.read()?;
        let hash = hash_of_scan(&scan);
        hashes
            .lock()
            .unwrap_or_else(|e| e.into_inner())
            .insert(key, hash);
        Ok(scan)
    };
    let number_of = |key: usize| frames[key].number;
    let built = plan.build_local_map(local_map, &read);
    let built = built.map_err(|error| match error {
        BuildError::PosesDoNotFit {
            first,
            last,
            percent,
        } => BuildError::PosesDoNotFit {
            first: number_of(first),
            last: number_of(last),
            percent,
        },
        other => other,
    })?;
    warn_of_doubtful_poses(&built, frames);
    let hashes = hashes.into_inner().unwrap_or_else(|e| e.into_inner());
    if built.counts.is_empty {
        tracing::warn!(
            "frames {} to {} have too few points to mesh: the map has a hole there",
            number_of(local_map.own.start),
            number_of(local_map.own.end - 1)
        );
    }
    parts.save(local_map.number, &built, &joint_hash(hashes.into_values()))?;
    Ok(built.counts)
}

/// Warns of scans that do not agree with their neighbours.
fn warn_of_doubtful_poses(built: &LocalMap, frames: &[Frame]) {
    let numbers: Vec<String> = (built.doubtful_scans.iter())
        .map(|&scan| frames[scan].number.to_string())
        .collect();
    if !numbers.is_empty() {
        tracing::warn!(
            "the poses of these frames fit neither the scan before nor after, the map is worse there: {}",
            numbers.join(", ")
        );
    }
    if let Some(agreement) = built.agreement
        && agreement < scan_agreement::DOUBTFUL
    {
        tracing::warn!(
            "only {:.0} % of a scan's points are on the surfaces of the next one: the poses may be inaccurate, of another recording, or in another frame",
            100.0 * agreement
        );
    }
}

/// Replaces an interruption by one that names the finished local maps.
fn interrupted(
    error: anyhow::Error,
    finished: usize,
    plan: &MapPlan,
    parts: &Parts,
) -> anyhow::Error {
    match error.downcast_ref() {
        Some(BuildError::Interrupted) => Interrupted {
            kept: kept(finished, plan, parts),
        }
        .into(),
        _ => error,
    }
}

/// What is kept of an interrupted build.
fn kept(finished: usize, plan: &MapPlan, parts: &Parts) -> String {
    format!(
        "{finished} of {} local maps are finished and kept in {}; run the same command again to continue",
        plan.local_maps.len(),
        parts.folder().display()
    )
}

/// Inputs on which all local maps depend: the program, the configuration without the paths of outputs,
/// the older map, and the poses. The content of the scans is recorded with each local map.
fn inputs(config: &BuildMapConfig, frames: &[Frame], older: Option<&OlderMap>) -> Result<String> {
    let relevant = BuildMapConfig {
        mesh_file: PathBuf::new(),
        truth_mesh: None,
        visualize: false,
        force: false,
        ..config.clone()
    };
    let mut text = format!("# {}\n", version::program()?);
    text += &config::to_yaml(&relevant)?;
    if let Some(older) = older {
        writeln!(text, "onto {}", older.hash)?;
    }
    for frame in frames {
        let path = &frame.source;
        let pose = frame.map_from_lidar.unwrap_or_default();
        let (t, q) = (pose.translation.vector, pose.rotation.coords);
        writeln!(text, "{path} {t:?} {q:?} {:?}", frame.motion)?;
    }
    Ok(text)
}

/// Residuals of the map along the beams of the held-out scans.
fn residuals(
    config: &BuildMapConfig,
    mesh: &TriangleMesh,
    held_out: &[Frame],
) -> Result<Vec<BeamResidual>> {
    let read = |index: usize| -> Result<_> {
        let frame: &Frame = &held_out[index];
        Ok((frame.read()?, frame.map_from_lidar.unwrap_or_default()))
    };
    map_quality::residuals(mesh, held_out.len(), read, &config.map().local_map.scan)
}

/// Agreement of the map with the true surface, where it is given.
fn agreement(
    config: &BuildMapConfig,
    mesh: &TriangleMesh,
    path: &MappingPath,
) -> Result<Option<TruthAgreement>> {
    let Some(truth) = &config.truth_mesh else {
        return Ok(None);
    };
    let surface = ply::read(truth)?;
    let scan = config.map().local_map.scan;
    Ok(TruthAgreement::of(
        mesh,
        &surface,
        &path.map_from_lidar,
        &scan,
    ))
}
