//! The local maps of a build: those that are not finished yet are built, and all are kept on disk. They are built by one
//! process, or as independent jobs on any number of machines that share the folder of the map.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use anyhow::{Context as _, Result, bail};

use super::opened::{Opened, open};
use super::parts::{Parts, Role};
use super::progress::BuildProgress;
use crate::app::run::arguments::command_of_job;
use crate::app::run::artefact::hash::{hash_of_scan, hash_of_scans, joint_hash};
use crate::app::run::memory;
use crate::app::run::{Context, Printed};
use crate::app::settings::BuildMapConfig;
use crate::map::build::plan::LocalMapPlan;
use crate::map::build::scan_agreement;
use crate::map::{BuildEvent, LocalMap, LocalMapCounts, MapBuilder, MapOptions, MapPlan};
use crate::recording::Frame;

/// Builds the local maps that are not finished yet, which is an error where they are collected; returns the counts of
/// all, and the progress, which is still open.
pub fn build(
    opened: &Opened,
    role: Role,
    context: &Context,
) -> Result<(Vec<LocalMapCounts>, Arc<BuildProgress>)> {
    let planned = opened.local_maps();
    // Scans in two local maps count once, in the one that owns them.
    let task = context.progress.task("build-map", opened.mapped.len());
    let scans = planned.iter().map(|local_map| local_map.used.len()).sum();
    let progress = Arc::new(BuildProgress::new(task, scans));
    let builder = builder(opened, context, &progress);
    let plan = opened.plan(&builder)?;
    let count = plan.local_maps.len();
    let mut all = Vec::with_capacity(count);
    for local_map in &plan.local_maps {
        context
            .interrupt
            .keeps(kept(all.len(), count, &opened.parts));
        progress.begin_local_map(local_map.used.len());
        let counts = finish(opened, &plan, local_map, role);
        let counts = counts.map_err(|error| context.interrupt.explain(error));
        progress.end();
        all.push(counts?);
    }
    context.interrupt.keeps(kept(count, count, &opened.parts));
    progress.begin_local_map(0);
    Ok((all, progress))
}

/// One shell command per local map that is not finished, for the current folder: the command line of this process with
/// `--job` instead of `--list-jobs`. The poses are found first.
pub fn list_jobs(config: &BuildMapConfig, context: &Context) -> Result<Printed> {
    let (opened, _claims) = open(config, Role::Build, context)?;
    let jobs = missing(&opened).into_iter();
    let commands = jobs.map(|number| command_of_job(&format!("--job {number}")) + "\n");
    Ok(Printed::text(commands.collect::<String>()))
}

/// Builds a local map by its number.
pub fn build_job(config: &BuildMapConfig, number: usize, context: &Context) -> Result<Printed> {
    let (opened, _claims) = open(config, Role::Job, context)?;
    let (counts, count) = build_one(&opened, number, context)?;
    let triangles = counts.triangles;
    Ok(Printed::text(format!(
        "local map {number} (0 to {}): {triangles} triangles\n",
        count - 1
    )))
}

/// Builds one of the local maps if it is not finished yet; returns its counts, and how many there are.
fn build_one(opened: &Opened, number: usize, context: &Context) -> Result<(LocalMapCounts, usize)> {
    let planned = opened.local_maps();
    let count = planned.len();
    let local_map = planned.get(number).with_context(|| {
        format!(
            "there is no local map {number}: --list-jobs lists the {count} that there are, from 0"
        )
    })?;
    let task = context.progress.task("build-map", local_map.own.len());
    let progress = Arc::new(BuildProgress::new(task, local_map.used.len()));
    let builder = builder(opened, context, &progress);
    let plan = opened.plan(&builder)?;
    (context.interrupt).keeps("nothing is kept of an unfinished local map");
    progress.begin_local_map(local_map.used.len());
    let counts = finish(opened, &plan, local_map, Role::Job);
    let counts = counts.map_err(|error| context.interrupt.explain(error))?;
    progress.finish();
    Ok((counts, count))
}

/// Requires that all local maps are finished where they are collected.
pub fn require_all(opened: &Opened, role: Role) -> Result<()> {
    let missing = missing(opened);
    if role != Role::Collect || missing.is_empty() {
        return Ok(());
    }
    let names: Vec<String> = missing.iter().map(usize::to_string).collect();
    bail!(
        "local maps {} are not finished: run their jobs (--list-jobs lists them), or leave out --collect to build them here",
        names.join(", ")
    )
}

/// Numbers of the local maps that are not finished.
fn missing(opened: &Opened) -> Vec<usize> {
    let planned = opened.local_maps();
    let numbers = planned.iter().map(|local_map| local_map.number);
    numbers
        .filter(|&number| !opened.parts.has(number))
        .collect()
}

/// A builder that reports its progress, and stops when it is interrupted.
fn builder(opened: &Opened, context: &Context, progress: &Arc<BuildProgress>) -> MapBuilder {
    let (progress, interrupt) = (progress.clone(), context.interrupt.clone());
    MapBuilder {
        on_event: Box::new(move |event| {
            match event {
                BuildEvent::Stage(name) => progress.begin(name),
                BuildEvent::ScanPrepared => progress.end_scan(),
            }
            interrupt.flow()
        }),
        options: MapOptions {
            memory_budget: memory::budget(),
            ..MapOptions::default()
        },
        ..MapBuilder::new(opened.config.map.clone())
    }
}

/// The counts of a local map, which is built if it is not finished yet.
fn finish(
    opened: &Opened,
    plan: &MapPlan,
    local_map: &LocalMapPlan,
    role: Role,
) -> Result<LocalMapCounts> {
    let (number, parts) = (local_map.number, &opened.parts);
    let used = &opened.mapped[local_map.used.clone()];
    if let Some(counts) = parts.finished(number, || hash_of_scans(used)) {
        let (nth, count) = (number + 1, plan.local_maps.len());
        tracing::info!("local map {nth} of {count} is finished already");
        return Ok(counts);
    }
    if role == Role::Collect {
        parts.discard(number)?;
        bail!(
            "local map {number} is damaged or was built from other scans, and was removed; list the jobs again with --list-jobs"
        )
    }
    build_part(plan, local_map, &opened.mapped, parts)
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
            "the poses of these frames fit neither the scan before nor after; the map is worse there: {}",
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

/// What is kept of an interrupted build.
fn kept(finished: usize, count: usize, parts: &Parts) -> String {
    format!(
        "{finished} of {count} local maps are finished and kept in {}; run the same command again to continue",
        parts.folder().display()
    )
}
