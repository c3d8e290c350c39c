//! The local maps of a build: those that are not finished yet are built, and all are kept on disk.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use anyhow::{Context as _, Result, bail};

use super::clock::StageClock;
use super::opened::Opened;
use super::parts::{Parts, Role};
use crate::app::run::Context;
use crate::app::run::artefact::hash::{hash_of_scan, hash_of_scans, joint_hash};
use crate::app::run::interrupt::Interrupted;
use crate::app::run::progress::Task;
use crate::map::build::plan::LocalMapPlan;
use crate::map::build::scan_agreement;
use crate::map::{BuildError, BuildEvent, LocalMap, LocalMapCounts, MapBuilder, MapPlan};
use crate::recording::Frame;

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

/// Builds the local maps that are not finished yet, which is an error where they are collected; returns the counts of
/// all, and the progress, which is still open.
pub fn build(
    opened: &Opened,
    role: Role,
    clock: &Arc<StageClock>,
    context: &Context,
) -> Result<(Vec<LocalMapCounts>, Arc<Task>)> {
    let (frames, parts) = (&opened.mapped, &opened.parts);
    let planned = opened.local_maps();
    // Scans in two local maps count once, in the one that owns them.
    let task = context.progress.task("build-map", frames.len());
    let progress = Arc::new(MapProgress {
        task: task.clone(),
        scans: planned.iter().map(|local_map| local_map.used.len()).sum(),
        state: Mutex::default(),
    });
    let builder = builder(opened, context, &progress, clock);
    let plan = opened.plan(&builder)?;
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
            None if role == Role::Collect => {
                parts.discard(local_map.number)?;
                bail!(
                    "local map {} is damaged or of other scans, and was removed; list the jobs again with --list-jobs",
                    local_map.number
                )
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

/// Builds one of the local maps if it is not finished yet; returns its counts, and how many there are.
pub fn build_one(
    opened: &Opened,
    number: usize,
    context: &Context,
) -> Result<(LocalMapCounts, usize)> {
    let (frames, parts) = (&opened.mapped, &opened.parts);
    let planned = opened.local_maps();
    let count = planned.len();
    let local_map = planned.get(number).with_context(|| {
        format!(
            "there is no local map {number}: --list-jobs lists the {count} that there are, from 0"
        )
    })?;
    let used = &frames[local_map.used.clone()];
    if let Some(counts) = parts.finished(number, || hash_of_scans(used)) {
        return Ok((counts, count));
    }
    let progress = Arc::new(MapProgress {
        task: context.progress.task("build-map", local_map.own.len()),
        scans: used.len(),
        state: Mutex::default(),
    });
    let builder = builder(opened, context, &progress, &Arc::default());
    let plan = opened.plan(&builder)?;
    let nothing = "nothing is kept of an unfinished local map".to_owned();
    context.interrupt.keeps(nothing.clone());
    progress.begin(used.len());
    let counts = build_part(&plan, local_map, frames, parts).map_err(|error| {
        match error.downcast_ref() {
            Some(BuildError::Interrupted) => Interrupted { kept: nothing }.into(),
            _ => error,
        }
    })?;
    progress.task.set_share(1.0);
    Ok((counts, count))
}

/// A builder that reports its progress, and stops when it is interrupted.
fn builder(
    opened: &Opened,
    context: &Context,
    progress: &Arc<MapProgress>,
    clock: &Arc<StageClock>,
) -> MapBuilder {
    let (progress, clock) = (progress.clone(), clock.clone());
    let interrupt = context.interrupt.clone();
    MapBuilder {
        on_event: Box::new(move |event| {
            match event {
                BuildEvent::Stage(name) => {
                    progress.begin_stage(name);
                    clock.begin(name);
                }
                BuildEvent::ScanPrepared => progress.end_scan(),
            }
            interrupt.flow()
        }),
        ..MapBuilder::new(opened.config.map.clone())
    }
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
    let built = built.map_err(|error| error.with_frames(number_of))?;
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
