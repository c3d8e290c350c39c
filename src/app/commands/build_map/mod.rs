//! `build-map`: builds a triangle-mesh map from scans, whose poses are given or found first.

mod arguments;
mod clock;
mod cloud;
mod files;
mod jobs;
mod local_maps;
mod onto;
mod opened;
mod parts;
mod pictures;
mod pose_check;
mod poses;
mod prepared;
mod quality;

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Result, ensure};

pub use self::arguments::{BuildMapArgs, BuildPart};
use self::clock::StageClock;
use self::files::write_map;
use self::opened::open;
use self::parts::{Joined, Role};
use crate::app::report::map::{BuildReport, ChangesReport};
use crate::app::run::output::Printed;
use crate::app::run::{Context, output};
use crate::app::settings::BuildMapConfig;
use crate::map::MappingPath;
use crate::map::mesh_view::{MeshView, Without};
use crate::mapping::poses_of;

/// Builds the map that a configuration describes.
pub fn run(config: &BuildMapConfig, context: &Context) -> Result<BuildReport> {
    match &config.cloud_file {
        Some(cloud_file) => cloud::run(config, cloud_file, context),
        None => run_with_scans(config, Role::Build, context),
    }
}

/// Does a part of the work of a build.
pub fn run_part(config: &BuildMapConfig, part: BuildPart, context: &Context) -> Result<Printed> {
    ensure!(
        config.cloud_file.is_none(),
        "cloud_file is meshed by one process: jobs are those of a recording; leave out --list-jobs, --job and --collect"
    );
    match part {
        BuildPart::List => jobs::list(config, context),
        BuildPart::LocalMap(number) => jobs::build(config, number, context),
        BuildPart::Collect => run_with_scans(config, Role::Collect, context)?.printed(),
    }
}

/// Builds the map of scans, or collects its local maps.
fn run_with_scans(config: &BuildMapConfig, role: Role, context: &Context) -> Result<BuildReport> {
    let started = Instant::now();
    let (opened, mut claims) = open(config, role, context)?;
    let (config, older, mapped) = (&opened.config, opened.older.as_ref(), &opened.mapped);
    let clock = Arc::new(StageClock::default());
    if role == Role::Collect {
        jobs::require_all(&opened)?;
    }
    let (local_maps, task) = local_maps::build(&opened, role, &clock, context)?;

    task.note("joining");
    let Joined { meshes, gone } = clock.time("join", || opened.parts.joined(local_maps.len()))?;
    let added: Vec<&dyn MeshView> = meshes.iter().map(|mesh| mesh as _).collect();
    let kept = older.map(|older| Without::new(&*older.mesh, &gone));
    let all: Vec<&dyn MeshView> = (kept.iter().map(|mesh| mesh as _))
        .chain(added.iter().copied())
        .collect();
    let poses = poses_of(mapped);
    let path = match older {
        Some(older) => older.path.extended_by(&poses),
        None => MappingPath {
            world_from_map: opened.sequence.world().0,
            map_from_lidar: poses,
        },
    };
    clock.time("join", || write_map(config, &all, &path, &mut claims))?;

    task.note("tiles");
    let map = clock.time("tiles", || {
        prepared::open_map(config, &opened.sensor, mapped.first())
    })?;
    let residuals = clock.time("quality", || {
        quality::residuals(config, &opened.sensor, map.as_ref(), &opened.held_out)
    })?;
    let truth = clock.time("truth", || {
        quality::agreement(config, &opened.sensor, &path)
    })?;
    task.note("pictures");
    if config.output.plots {
        clock.time("pictures", || {
            pictures::draw(config, &all, &path.map_from_lidar, &residuals)
        })?;
        if let (Some(older), Some(kept)) = (older, &kept) {
            let picture = config.mesh_file.with_extension("changes.png");
            onto::draw(older, kept, &gone, &added, &picture)?;
        }
    }
    let triangles = all.iter().map(|mesh| mesh.triangles()).sum();
    let report = BuildReport {
        frames: opened.sequence.frames.len(),
        mapped_frames: mapped.len(),
        held_out_frames: opened.held_out.len(),
        sensor: Some(opened.sensor),
        trajectory: opened.trajectory,
        changes: older.map(|it| ChangesReport::new(&it.file, &*it.mesh, &gone, &added)),
        stage_seconds: clock.seconds(),
        quality: residuals.quality(),
        truth,
        octree_cell_m: (local_maps.iter()).fold(0.0, |largest, counts| counts.cell_m.max(largest)),
        local_maps,
        ..BuildReport::of_map(triangles, &path, &config.mesh_file, started)
    };
    output::write_json(&config.mesh_file.with_extension("report.json"), &report)?;
    output::write_yaml(&config.mesh_file.with_extension("effective.yml"), config)?;
    task.set_share(1.0);
    claims.finish(&config.mesh_file)?;
    opened.parts.remove()?;
    Ok(report)
}
