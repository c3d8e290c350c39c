//! `build-map`: builds a triangle-mesh map from scans, whose poses are given or found first.

mod arguments;
mod cloud;
mod files;
mod joined;
mod local_maps;
mod older;
mod opened;
mod parts;
mod poses;
mod progress;
mod quality;

use std::time::Instant;

use anyhow::{Result, ensure};

pub use self::arguments::{BuildMapArgs, BuildPart};
use self::joined::JoinedMap;
use self::parts::Role;
use crate::app::report::georeference::GeoreferenceReport;
use crate::app::report::map::{BuildReport, draw_changes, draw_map};
use crate::app::run::{Context, Printed};
use crate::app::settings::BuildMapConfig;
use crate::evaluation::map_quality::ResidualSums;

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
        BuildPart::List => local_maps::list_jobs(config, context),
        BuildPart::LocalMap(number) => local_maps::build_job(config, number, context),
        BuildPart::Collect => run_with_scans(config, Role::Collect, context)?.printed(),
    }
}

/// Builds the map of scans, or collects its local maps.
fn run_with_scans(config: &BuildMapConfig, role: Role, context: &Context) -> Result<BuildReport> {
    let started = Instant::now();
    let (opened, mut claims) = opened::open(config, role, context)?;
    local_maps::require_all(&opened, role)?;
    let (local_maps, progress) = local_maps::build(&opened, role, context)?;

    let joined = progress.time("join", || opened.parts.joined(local_maps.len()))?;
    let map = JoinedMap::new(&opened, &joined);
    let (config, meshes, path) = (&opened.config, map.meshes(), &map.path);
    progress.time("join", || {
        files::write_map(config, &meshes, path, &mut claims)
    })?;

    let prepared = progress.time("tiles", || quality::prepared_map(&opened))?;
    let residuals = progress.time("quality", || quality::residuals(&opened, prepared.as_ref()))?;
    let truth = progress.time("truth", || quality::agreement(&opened, path))?;
    progress.time("pictures", || draw(config, &map, &residuals))?;

    let report = BuildReport {
        frames: opened.sequence.frames.len(),
        mapped_frames: opened.mapped.len(),
        held_out_frames: opened.held_out.len(),
        sensor: Some(opened.sensor.clone()),
        trajectory: opened.trajectory.clone(),
        georeference: (opened.georeferenced.as_ref())
            .map(GeoreferenceReport::new)
            .transpose()?,
        changes: map.changes(),
        stage_seconds: progress.finish(),
        quality: residuals.quality(),
        truth,
        ..BuildReport::new(
            &meshes,
            local_maps,
            map.drives(),
            &config.mesh_file,
            started,
        )
    };
    files::finish(config, &report, &mut claims)?;
    opened.parts.remove()?;
    Ok(report)
}

/// Draws the map, and what has changed in an older one, where pictures are requested.
fn draw(config: &BuildMapConfig, map: &JoinedMap, residuals: &ResidualSums) -> Result<()> {
    if !config.output.plots {
        return Ok(());
    }
    let file = &config.mesh_file;
    draw_map(file, &map.meshes(), &map.path.map_from_lidar, residuals)?;
    let Some((older, kept)) = &map.older else {
        return Ok(());
    };
    let meshes = (&*older.mesh, kept as _);
    draw_changes(
        file,
        meshes,
        map.gone,
        &map.added,
        &older.path.map_from_lidar,
    )
}
