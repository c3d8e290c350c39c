//! What `odometry` leaves behind: poses, a table of frames, the path, and the report.

use std::path::Path;

use anyhow::Result;
use schemars::JsonSchema;
use serde::Serialize;

use super::georeference::GeoreferenceReport;
use super::plotting::PathPlot;
use super::plotting::color::{ODOMETRY, REFINED};
use super::results::{FrameTable, write_trajectory_npz};
use super::run_output::{RunFiles, Trajectory as WrittenTrajectory, stamped};
use crate::app::run::output;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::mapping::{LostPath, TrajectorySummary};
use crate::odometry::{Loop, OdometryEstimate, StepState, Trajectory};
use crate::recording::poses::write_tum;
use crate::recording::{Frame, Recording};
use crate::sensor::Sensor;

/// Report of a run of `odometry`.
#[derive(Debug, Serialize, JsonSchema)]
pub struct OdometryReport {
    /// Length, speed, loops and residuals.
    #[serde(flatten)]
    pub summary: TrajectorySummary,
    /// The sensor.
    sensor: Sensor,
    /// The place of the first scan on the Earth, where fixes of a receiver were given.
    pub georeference: Option<GeoreferenceReport>,
    /// Loops that were found.
    found_loops: Vec<LoopReport>,
}

/// A loop in the report.
#[derive(Debug, Serialize, JsonSchema)]
struct LoopReport {
    /// Frame of the earlier visit.
    first: usize,
    /// Frame of the later visit.
    second: usize,
    /// Distance between the visits [m].
    distance_m: f64,
    /// Share of the surfaces in common, without the ground.
    common_share: f64,
    /// What became of it.
    verdict: String,
}

impl OdometryReport {
    /// The report of a trajectory of frames.
    pub fn new(found: &Trajectory, frames: &[Frame], has_times: bool, sensor: Sensor) -> Self {
        let loops = found.loops.iter();
        Self {
            found_loops: loops.map(|it| LoopReport::of(it, frames)).collect(),
            summary: TrajectorySummary::new(found, has_times),
            sensor,
            georeference: None,
        }
    }
}

impl LoopReport {
    fn of(found: &Loop, frames: &[Frame]) -> Self {
        Self {
            first: frames[found.first].number,
            second: frames[found.second].number,
            distance_m: found.first_from_second.translation.vector.norm(),
            common_share: found.common_share,
            verdict: format!("{:?}", found.verdict).to_lowercase(),
        }
    }
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
        rows.push(("doubtful scans", summary.doubtful.to_string()));
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
    if let Some(inertial) = &summary.inertial {
        let [roll, pitch, yaw] = inertial.lidar_from_imu_deg;
        rows.push((
            "axes of the inertial sensor",
            format!("roll {roll:.1}, pitch {pitch:.1}, yaw {yaw:.1} deg"),
        ));
        rows.push((
            "offset of its clock",
            format!("{:.1} ms", 1e3 * inertial.time_offset_s),
        ));
        rows.push((
            "direction up",
            format!("standard deviation {:.3} deg", inertial.tilt_sigma_deg),
        ));
    }
    rows.push((
        "largest change",
        format!("{:.3} m", summary.largest_change_m),
    ));
    rows
}

/// Warns of scans that could not be registered, or of a path that is lost by them.
pub fn warn(summary: &TrajectorySummary, lost: Option<&LostPath>) {
    match lost {
        Some(lost) => tracing::warn!("the path is not to be trusted: {lost}"),
        None if summary.predicted > 0 => tracing::warn!(
            "{} of {} scans did not fit the scans before them: their poses are predicted",
            summary.predicted,
            summary.scans
        ),
        None => {}
    }
    if summary.doubtful > 0 {
        tracing::warn!(
            "{} of {} scans fit only after an unexpected motion",
            summary.doubtful,
            summary.scans
        );
    }
}

/// Writes the poses of the selected frames.
pub fn write(
    files: &RunFiles,
    recording: &Recording,
    rows: &[usize],
    found: &Trajectory,
) -> Result<()> {
    let frames = &recording.frames;
    let poses: Vec<Pose3> = rows.iter().map(|&row| found.poses[row]).collect();
    let steps: Vec<&OdometryEstimate> = rows.iter().map(|&row| &found.odometry[row]).collect();
    let odometry: Vec<Pose3> = steps.iter().map(|step| step.odom_from_lidar).collect();
    let written = WrittenTrajectory {
        frames: &recording.frames,
        poses: &poses,
        states: None,
    };
    written.write(files, "poses", recording, false)?;
    output::write_file(&files.file("odometry_tum.txt"), |file| {
        write_tum(file, &stamped(frames, &odometry))
    })?;
    write_trajectory_npz(&files.file("trajectory.npz"), frames, &poses, &steps)?;
    frame_table(frames, &poses, &steps).save(&files.file("frames.csv"))
}

/// The table of frames.
fn frame_table<'a>(
    frames: &'a [Frame],
    poses: &'a [Pose3],
    steps: &'a [&'a OdometryEstimate],
) -> FrameTable<'a> {
    let mut table = FrameTable::empty(frames.len());
    table.add("frame", Some(frames), |it| it.number.to_string());
    table.add("time_s", Some(frames), |it| format!("{:.6}", it.time_s));
    for (axis, title) in ["x_m", "y_m", "z_m"].into_iter().enumerate() {
        table.add(title, Some(poses), move |it| {
            format!("{:.6}", it.translation.vector[axis])
        });
    }
    for (axis, title) in ["roll_rad", "pitch_rad", "yaw_rad"].into_iter().enumerate() {
        let angle = move |it: &Pose3| <[f64; 3]>::from(it.rotation.euler_angles())[axis];
        table.add(title, Some(poses), move |it| format!("{:.8}", angle(it)));
    }
    let steps = Some(steps);
    table.add("state", steps, |it| in_words(it.state).to_owned());
    table.add("matched_share", steps, |it| {
        format!("{:.4}", it.matched_share)
    });
    table.add("residual_m", steps, |it| {
        it.residual_m.map_or(String::new(), |m| format!("{m:.5}"))
    });
    table.add("degenerate_directions", steps, |it| {
        it.degenerate_directions.len().to_string()
    });
    table.add("time_ms", steps, |it| {
        format!("{:.3}", 1e3 * it.elapsed.as_secs_f64())
    });
    table
}

fn in_words(state: StepState) -> &'static str {
    match state {
        StepState::First => "first",
        StepState::Registered => "registered",
        StepState::Doubtful => "doubtful",
        StepState::Predicted => "predicted",
        StepState::Lost => "lost",
        StepState::Given => "given",
    }
}

/// Draws the path before and after loops and adjustment.
pub fn draw(path: &Path, found: &Trajectory, is_given: bool) -> Result<()> {
    let planar = |poses: &mut dyn Iterator<Item = Pose3>| -> Vec<Pose2> {
        poses.map(|pose| pose2_from_pose3(&pose)).collect()
    };
    let before = planar(&mut found.odometry.iter().map(|step| step.odom_from_lidar));
    let after = planar(&mut found.poses.iter().copied());
    let name = if is_given { "given" } else { "odometry" };
    PathPlot {
        title: "Path",
        ground_truth: None,
        paths: &[(name, ODOMETRY, &before), ("adjusted", REFINED, &after)],
        numbers: None,
        map: None,
    }
    .save(path)
}
