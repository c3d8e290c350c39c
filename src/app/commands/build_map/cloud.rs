//! `build-map` of a point cloud without scans and poses.

use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

use anyhow::{Result, ensure};

use super::files::{self, prepare, write_map};
use super::progress::BuildProgress;
use crate::app::report::map::{BuildReport, draw_map};
use crate::app::run::memory;
use crate::app::run::{Context, Progress};
use crate::app::settings::BuildMapConfig;
use crate::evaluation::map_quality::ResidualSums;
use crate::geometry::Vec3;
use crate::map::mesh_view::MeshView;
use crate::map::{BuildEvent, CloudPlan, LocalMap, MappingPath};
use crate::recording::scan_files::{self, ReadCloud};

/// Meshes the cloud of a configuration.
pub fn run(config: &BuildMapConfig, cloud_file: &Path, context: &Context) -> Result<BuildReport> {
    let started = Instant::now();
    ensure!(
        scan_files::is_scan(cloud_file),
        "cloud_file is {}, which is not a point cloud; its name must end in .pcd, .ply, .npy or .bin",
        cloud_file.display()
    );
    ensure!(
        !scan_files::is_mesh(cloud_file),
        "cloud_file is {0}, which is a mesh already: it has faces; localize in it as it is, with --map {0}",
        cloud_file.display()
    );
    let mut claims = prepare(config, context)?;
    // The task is that of the blocks, whose number is not known yet.
    let stages = BuildProgress::new(Progress::Silent.task("build-map", 1), 0);
    let mut blocks = build_blocks(config, cloud_file, context, &stages)?;
    for block in &mut blocks {
        block.mesh.compute_normals();
    }
    let meshes: Vec<&dyn MeshView> = blocks.iter().map(|block| &block.mesh as _).collect();
    let path = MappingPath::default();
    write_map(config, &meshes, &path, &mut claims)?;
    if config.output.plots {
        draw_map(&config.mesh_file, &meshes, &[], &ResidualSums::default())?;
    }
    let counts = blocks.iter().map(|block| block.counts.clone()).collect();
    let report = BuildReport {
        stage_seconds: stages.finish(),
        ..BuildReport::new(&meshes, counts, (&[], None), &config.mesh_file, started)
    };
    files::finish(config, &report, &mut claims)?;
    Ok(report)
}

/// Builds the blocks of the cloud.
fn build_blocks(
    config: &BuildMapConfig,
    cloud_file: &Path,
    context: &Context,
    stages: &BuildProgress,
) -> Result<Vec<LocalMap>> {
    let interrupt = &context.interrupt;
    interrupt.keeps("nothing is kept of an unfinished map of a cloud");
    let read = stages.time("read", || scan_files::read_cloud(cloud_file))?;
    let normals = usable_normals(&read, cloud_file);
    let points = read.scan.points;
    let local_map = &config.map.local_map;
    let prepare = || {
        CloudPlan::new(
            &points,
            normals.as_deref(),
            &[],
            local_map,
            memory::budget(),
            &|event| on_stage(event, context, stages),
        )
    };
    let plan = prepare().map_err(|error| interrupt.explain(error))?;
    tracing::info!(
        "{} of {} points are kept, in {} blocks",
        plan.cloud.len(),
        points.len(),
        plan.blocks()
    );
    let task = context.progress.task("build-map", plan.blocks());
    let mut blocks = Vec::with_capacity(plan.blocks());
    for number in 0..plan.blocks() {
        let built = plan.build_block(number, &|event| on_stage(event, context, stages));
        blocks.push(built.map_err(|error| interrupt.explain(error))?);
        task.advance(1);
    }
    stages.end();
    Ok(blocks)
}

/// The normals of a cloud, if those of all points are unit vectors.
fn usable_normals(cloud: &ReadCloud, path: &Path) -> Option<Vec<Vec3>> {
    const TOLERANCE: f32 = 0.01;
    let normals = cloud.normals.as_ref()?;
    let is_unit = |normal: &Vec3| (normal.length() - 1.0).abs() <= TOLERANCE;
    let pairs = cloud.scan.points.iter().zip(normals);
    let bad = pairs.filter(|(point, normal)| point.is_finite() && !is_unit(normal));
    match bad.count() {
        0 => {
            tracing::info!("normals are those of {}", path.display());
            Some(normals.clone())
        }
        bad => {
            tracing::warn!(
                "{}: normals are estimated, because {bad} of {} in the file are not unit vectors",
                path.display(),
                normals.len()
            );
            None
        }
    }
}

fn on_stage(event: BuildEvent, context: &Context, stages: &BuildProgress) -> ControlFlow<()> {
    if let BuildEvent::Stage(name) = event {
        stages.begin(name);
    }
    context.interrupt.flow()
}
