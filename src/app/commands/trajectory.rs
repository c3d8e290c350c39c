//! Poses of a recording from its scans, for `odometry` and `build-map`: progress, tables and warnings.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Error, Result};

use crate::app::run::Context;
use crate::app::run::interrupt::Interrupted;
use crate::geometry::{Pose3, StampedPose};
use crate::map::BuildEvent;
use crate::mapping::{self, ADJUSTMENT, MappingError, TrajectorySummary};
use crate::odometry::{ElevationBias, Trajectory};
use crate::recording::{Frame, Recording};

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
    let kept = "nothing is written: loops and adjustment need all scans";
    context.interrupt.keeps(kept.to_owned());
    let task = context.progress.task(name, scans);
    let found = find(&|event| {
        match event {
            BuildEvent::ScanPrepared => task.advance_share(SHARE / scans as f64),
            BuildEvent::Stage(ADJUSTMENT) => task.note(ADJUSTMENT),
            BuildEvent::Stage(_) => {}
        }
        context.interrupt.flow()
    });
    task.set_share(1.0);
    found.map_err(|error| interrupted(error, kept))
}

/// The error, or the interruption of a process that keeps something.
fn interrupted(error: MappingError, kept: &str) -> Error {
    match error {
        MappingError::Interrupted => Interrupted { kept: kept.into() }.into(),
        error => error.into(),
    }
}

/// Poses with the numbers and times of frames.
pub fn stamped(frames: &[Frame], poses: &[Pose3]) -> Vec<StampedPose> {
    (frames.iter().zip(poses))
        .map(|(frame, &pose)| frame.stamped(pose))
        .collect()
}

/// Rows of a table.
pub fn rows(summary: &TrajectorySummary) -> Vec<(&'static str, String)> {
    let mut rows = vec![
        ("scans", summary.scans.to_string()),
        ("path", format!("{:.1} m", summary.path_m)),
    ];
    if let Some(speed) = summary.speed_m_per_s {
        rows.push(("speed", format!("{speed:.1} m/s")));
    }
    if let Some([median_s, p95_s]) = summary.seconds_per_scan {
        let [median_ms, p95_ms] = [1e3 * median_s, 1e3 * p95_s];
        rows.push((
            "time per scan",
            format!("{median_ms:.0} ms, 95 % within {p95_ms:.0} ms"),
        ));
        rows.push(("predicted scans", summary.predicted.to_string()));
        rows.push(("degenerate scans", summary.degenerate.to_string()));
        let loops = &summary.loops;
        rows.push((
            "loops",
            format!(
                "{} accepted, {} unconfirmed, {} contradicted",
                loops.accepted, loops.unconfirmed, loops.contradicted
            ),
        ));
    }
    if let Some([before_m, after_m]) = summary.residuals_m {
        let [before_mm, after_mm] = [1e3 * before_m, 1e3 * after_m];
        rows.push((
            "distance from common planes",
            format!("{before_mm:.1} mm, adjusted {after_mm:.1} mm"),
        ));
    }
    if let Some(bias) = summary.elevation_bias {
        rows.push((
            "elevation bias",
            format!(
                "{:.2} deg, standard deviation {:.3} deg",
                bias.deg, bias.sigma_deg
            ),
        ));
    }
    rows.push((
        "largest change",
        format!("{:.3} m", summary.largest_change_m),
    ));
    rows
}

/// Warns of scans that could not be registered, and says what may be wrong with the elevations.
pub fn warn(summary: &TrajectorySummary) {
    if summary.predicted > 0 {
        tracing::warn!(
            "{} of {} scans did not fit the scans before them: their poses are predicted",
            summary.predicted,
            summary.scans
        );
    }
    if let Some(bias) = summary.elevation_bias.filter(ElevationBias::is_significant) {
        tracing::info!(
            "surfaces fit themselves better with {:.2} degrees added to the elevations of all points: try elevation_bias_deg",
            bias.deg
        );
    }
}
/// Checks the poses of a recording against each other; `origin` says where they are from.
pub fn check(recording: &Recording, max_step_m: f64, origin: &str) -> Result<()> {
    mapping::check_path(recording, max_step_m).with_context(|| origin.to_owned())
}

/// The file of the poses of a map that was built without given ones.
pub fn file_beside(mesh_file: &Path) -> PathBuf {
    mesh_file.with_extension("poses_tum.txt")
}
