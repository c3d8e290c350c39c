//! Poses of a recording from its scans, for `odometry` and `build-map`, with progress.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use anyhow::Result;

use crate::app::run::Context;
use crate::map::BuildEvent;
use crate::mapping::{ADJUSTMENT, MappingError};
use crate::odometry::Trajectory;

/// Finds the trajectory of a number of scans by `find`, to which it gives the events; with progress, until an
/// interruption.
pub fn find(
    name: &str,
    scans: usize,
    context: &Context,
    find: impl FnOnce(&dyn Fn(BuildEvent) -> ControlFlow<()>) -> Result<Trajectory, MappingError>,
) -> Result<Trajectory> {
    /// About the share of the work until all scans are read; the rest are loops and adjustment.
    const SHARE: f64 = 0.5;
    let interrupt = &context.interrupt;
    interrupt.keeps("nothing is written: loops and adjustment need all scans");
    let task = context.progress.task(name, scans);
    let found = find(&|event| {
        match event {
            BuildEvent::ScanPrepared => task.advance_share(SHARE / scans as f64),
            BuildEvent::Stage(ADJUSTMENT) => task.note(ADJUSTMENT),
            BuildEvent::Stage(_) => {}
        }
        interrupt.flow()
    });
    task.set_share(1.0);
    found.map_err(|error| interrupt.explain(error))
}

/// The file of the poses of a map that was built without given ones.
pub fn poses_next_to(mesh_file: &Path) -> PathBuf {
    mesh_file.with_extension("poses_tum.txt")
}
