//! Poses of a recording from its scans, for `odometry` and `build-map`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, Result};
use serde::{Deserialize, Serialize};

use crate::app::run::Context;
use crate::app::run::interrupt::Interrupted;
use crate::app::run::progress::Task;
use crate::geometry::{Pose3, StampedPose};
use crate::lidar::Scan;
use crate::map::build::path_check;
use crate::odometry::{
    ElevationBias, LoopVerdict, StepState, Trajectory, TrajectoryBuilder, TrajectoryConfig,
};
use crate::recording::{Frame, Recording};

/// Estimates the poses of frames, or polishes those that they have.
pub fn estimate(
    frames: &[Frame],
    is_given: bool,
    config: &TrajectoryConfig,
    context: &Context,
) -> Result<Trajectory> {
    let mut builder = TrajectoryBuilder::new(config.clone())?;
    let name = if is_given { "polish" } else { "odometry" };
    let task = each_scan(name, frames, context, |frame, scan| {
        match frame.map_from_lidar {
            Some(pose) if is_given => builder.add_given(scan, pose)?,
            _ => {
                builder.add(scan)?;
            }
        }
        Ok(())
    })?;
    let found = builder.finish()?;
    task.set_share(1.0);
    Ok(found)
}

/// Reads the scans in order and passes each to `step`, until an interruption; returns the progress, which is still open.
pub fn each_scan(
    name: &str,
    frames: &[Frame],
    context: &Context,
    mut step: impl FnMut(&Frame, &Scan) -> Result<()>,
) -> Result<Arc<Task>> {
    /// About the share of the work until all scans are read; the rest are loops and adjustment.
    const SHARE: f64 = 0.5;
    let kept = "nothing is written: loops and adjustment need all scans";
    context.interrupt.keeps(kept.to_owned());
    let task = context.progress.task(name, frames.len());
    for frame in frames {
        if context.interrupt.requested() {
            return Err(Interrupted { kept: kept.into() }.into());
        }
        step(frame, &frame.read()?)?;
        task.advance_share(SHARE / frames.len() as f64);
    }
    task.note("loops and adjustment");
    Ok(task)
}

/// Poses with the numbers and times of frames.
pub fn stamped(frames: &[Frame], poses: &[Pose3]) -> Vec<StampedPose> {
    (frames.iter().zip(poses))
        .map(|(frame, &pose)| frame.stamped(pose))
        .collect()
}

/// What a trajectory shows about itself.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TrajectorySummary {
    /// Number of scans.
    pub scans: usize,
    /// Scans whose pose was predicted, because they did not fit.
    pub predicted: usize,
    /// Scans that do not determine all of their motion.
    pub degenerate: usize,
    /// Length of the path [m].
    pub path_m: f64,
    /// Mean speed [m/s]; `None` where the times are assumed.
    pub speed_m_per_s: Option<f64>,
    /// Median and 95 % quantile of the time per scan, without loops and adjustment [s].
    pub seconds_per_scan: Option<[f64; 2]>,
    /// Loops that were found and accepted, are not confirmed, and contradict others.
    pub loops: LoopCounts,
    /// Root mean square of the distances between points and common planes, before and after the adjustment [m].
    pub residuals_m: Option<[f64; 2]>,
    /// Angle to add to the elevations of all points so that surfaces fit themselves best.
    pub elevation_bias: Option<ElevationBias>,
    /// Largest change of a position by loops and adjustment [m].
    pub largest_change_m: f64,
}

/// Numbers of loops.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct LoopCounts {
    /// The poses follow them.
    pub accepted: usize,
    /// No second loop confirms them.
    pub unconfirmed: usize,
    /// They contradict others.
    pub contradicted: usize,
}

impl TrajectorySummary {
    /// The same for every run.
    pub fn without_times(&self) -> Self {
        Self {
            seconds_per_scan: None,
            ..self.clone()
        }
    }

    /// Of a trajectory.
    pub fn of(trajectory: &Trajectory, has_times: bool) -> Self {
        let steps = &trajectory.odometry;
        let positions = || trajectory.poses.iter().map(|pose| pose.translation.vector);
        let path_m: f64 = (positions().zip(positions().skip(1)))
            .map(|(a, b)| (b - a).norm())
            .sum();
        let duration_s: f64 = steps.iter().skip(1).map(|step| step.duration_s).sum();
        let mut times_s: Vec<f64> = (steps.iter())
            .map(|step| step.elapsed.as_secs_f64())
            .filter(|&time_s| time_s > 0.0)
            .collect();
        times_s.sort_by(f64::total_cmp);
        let quantile = |share: f64| Some(*times_s.get((share * times_s.len() as f64) as usize)?);
        let counted = |verdict| {
            let loops = trajectory.loops.iter();
            loops.filter(|found| found.verdict == verdict).count()
        };
        Self {
            scans: steps.len(),
            predicted: (steps.iter())
                .filter(|step| step.state == StepState::Predicted)
                .count(),
            degenerate: (steps.iter())
                .filter(|step| !step.degenerate_directions.is_empty())
                .count(),
            path_m,
            speed_m_per_s: (has_times && duration_s > 0.0).then(|| path_m / duration_s),
            seconds_per_scan: quantile(0.5).zip(quantile(0.95)).map(|(a, b)| [a, b]),
            loops: LoopCounts {
                accepted: counted(LoopVerdict::Accepted),
                unconfirmed: counted(LoopVerdict::Unconfirmed),
                contradicted: counted(LoopVerdict::Contradicted),
            },
            residuals_m: trajectory.adjusted.map(|adjusted| adjusted.residuals_m),
            elevation_bias: (trajectory.adjusted).and_then(|adjusted| adjusted.elevation_bias),
            largest_change_m: (positions().zip(steps))
                .map(|(found, step)| (found - step.odom_from_lidar.translation.vector).norm())
                .fold(0.0, f64::max),
        }
    }

    /// Rows of a table.
    pub fn rows(&self) -> Vec<(&'static str, String)> {
        let mut rows = vec![
            ("scans", self.scans.to_string()),
            ("path", format!("{:.1} m", self.path_m)),
        ];
        if let Some(speed) = self.speed_m_per_s {
            rows.push(("speed", format!("{speed:.1} m/s")));
        }
        if let Some([median_s, p95_s]) = self.seconds_per_scan {
            let [median_ms, p95_ms] = [1e3 * median_s, 1e3 * p95_s];
            rows.push((
                "time per scan",
                format!("{median_ms:.0} ms, 95 % within {p95_ms:.0} ms"),
            ));
            rows.push(("predicted scans", self.predicted.to_string()));
            rows.push(("degenerate scans", self.degenerate.to_string()));
            let loops = &self.loops;
            rows.push((
                "loops",
                format!(
                    "{} accepted, {} unconfirmed, {} contradicted",
                    loops.accepted, loops.unconfirmed, loops.contradicted
                ),
            ));
        }
        if let Some([before_m, after_m]) = self.residuals_m {
            let [before_mm, after_mm] = [1e3 * before_m, 1e3 * after_m];
            rows.push((
                "distance from common planes",
                format!("{before_mm:.1} mm, adjusted {after_mm:.1} mm"),
            ));
        }
        if let Some(bias) = self.elevation_bias {
            rows.push((
                "elevation bias",
                format!(
                    "{:.2} deg, standard deviation {:.3} deg",
                    bias.deg, bias.sigma_deg
                ),
            ));
        }
        rows.push(("largest change", format!("{:.3} m", self.largest_change_m)));
        rows
    }

    /// Warns of scans that could not be registered, and says what may be wrong with the elevations.
    pub fn warn(&self) {
        if self.predicted > 0 {
            tracing::warn!(
                "{} of {} scans did not fit the scans before them: their poses are predicted",
                self.predicted,
                self.scans
            );
        }
        if let Some(bias) = self.elevation_bias.filter(ElevationBias::is_significant) {
            tracing::info!(
                "surfaces fit themselves better with {:.2} degrees added to the elevations of all points: try elevation_bias_deg",
                bias.deg
            );
        }
    }
}

/// Checks the poses of a recording against each other; `origin` says where they are from.
pub fn check(recording: &Recording, max_step_m: f64, origin: &str) -> Result<()> {
    let poses = recording.frames.iter();
    let poses = poses.filter_map(|frame| Some((frame.number, frame.map_from_lidar.as_ref()?)));
    path_check::check(poses, max_step_m).with_context(|| origin.to_owned())
}

/// The file of the poses of a map that was built without given ones.
pub fn file_beside(mesh_file: &Path) -> PathBuf {
    mesh_file.with_extension("poses_tum.txt")
}
