//! MCAP log of a run with the message schemas of Foxglove, which its viewer and others open.
//!
//! | topic | schema | content |
//! |---|---|---|
//! | `/tf` | `foxglove.FrameTransform` | `map` to `lidar`, the best pose of each frame |
//! | `/estimate`, `/refined` | `foxglove.Odometry` | pose with covariance of x, y and heading; the state is in its metadata |
//! | `/truth` | `foxglove.PoseInFrame` | true pose |
//! | `/particles` | `foxglove.PosesInFrame` | poses of the particles, at the height of the estimate |
//! | `/scan` | `foxglove.PointCloud` | scan, motion-compensated, in the map frame |
//! | `/map` | `foxglove.SceneUpdate` | the mesh as a glTF model |
//! | `/paths` | `foxglove.SceneUpdate` | whole trajectories as lines |
//! | `/state` | `foxglove.Log` | each change of the state |
//! | `/numbers` | `fpmcl.Frame` (JSON) | state, standard deviations, agreement and errors, to plot |
//!
//! Times before zero, of recordings without a date, are shifted to zero.

use std::io::{Seek, Write};

use anyhow::{Context as _, Result};
use foxglove::messages::{
    LinePrimitive, PointCloud, PoseInFrame, SceneEntity, SceneUpdate, line_primitive,
};
use serde_json::{Value, json};

use super::messages::{
    MAP, cloud, entity, map_scene, nanoseconds, odometry, opaque, particles, point, pose,
    state_change, timestamp, transform,
};
use super::sinks::{McapSink, MessageSink};
use crate::app::report::plotting::color::{MCL, REFINED, Rgb, TRUTH};
use crate::app::report::results::{Column, LocalizationResults, stretches};
use crate::evaluation::planar_errors;
use crate::evaluation::trust::Axes;
use crate::geometry::{Pose2, Pose3, TriangleMesh, pose2_from_pose3, pose3_from_pose2};
use crate::georeference::Georeference;
use crate::lidar::Motion;
use crate::localization::State;
use crate::recording::{Frame, RecordingError};

/// Largest number of points of a scan by default.
pub const MOST_POINTS: usize = 30_000;

/// A run to write.
pub struct RunLog<'a> {
    /// Results with estimates.
    pub results: &'a LocalizationResults,
    /// Frames of the results with their scans; `None` for a log without scans.
    pub frames: Option<&'a [Frame]>,
    /// Map; `None` for a log without it.
    pub mesh: Option<&'a TriangleMesh>,
    /// The place of the map on the Earth, if it is known.
    pub georeference: Option<&'a Georeference>,
    /// Largest number of points per scan: of larger ones, points at even distances in the file.
    pub max_points: usize,
}

/// Writes a log; `written` is called after each frame, and its error ends the log.
pub fn write_mcap(
    run: &RunLog,
    writer: impl Write + Seek,
    mut written: impl FnMut() -> Result<()>,
) -> Result<()> {
    let results = run.results;
    let poses = Trajectories::of(results)?;
    let mut log = McapSink::new(writer)?;
    if let Some(georeference) = run.georeference {
        log.write_georeference(georeference)?;
    }
    let log: &mut dyn MessageSink = &mut log;
    let assumed = || {
        results
            .frames
            .iter()
            .map(|&frame| frame as f64 / 10.0)
            .collect()
    };
    let times_s: Vec<f64> = (results.times_s.as_deref()).map_or_else(assumed, <[f64]>::to_vec);
    let first_s = times_s.iter().copied().reduce(f64::min).unwrap_or(0.0);
    let shift_s = (-first_s).max(0.0);
    let stamps = times_s.iter().map(|time_s| nanoseconds(time_s + shift_s));
    let stamps: Vec<u64> = stamps.collect();
    if let Some(&first) = stamps.first() {
        log.send("/paths", first, &poses.scene(results, first))?;
        if let Some(mesh) = run.mesh {
            log.send("/map", first, &map_scene(mesh, first)?)?;
        }
    }
    for (row, &stamp) in stamps.iter().enumerate() {
        poses.send(log, results, row, stamp)?;
        if !results.particles.is_empty() {
            let height_m = poses.best()[row].translation.z;
            let particles = particles(&results.particles.frame(row)?, height_m, stamp);
            log.send("/particles", stamp, &particles)?;
        }
        if let Some(frames) = run.frames {
            let motion = Motion::along(poses.best(), &times_s, row);
            let cloud = run.cloud(&frames[row], motion, &poses.best()[row], stamp)?;
            log.send("/scan", stamp, &cloud)?;
        }
        written()?;
    }
    log.finish()
}

impl RunLog<'_> {
    /// The points of a scan in the map frame.
    fn cloud(
        &self,
        frame: &Frame,
        motion: Option<Motion>,
        map_from_lidar: &Pose3,
        stamp: u64,
    ) -> Result<PointCloud, RecordingError> {
        let mut scan = frame.read()?;
        if let Some(motion) = motion {
            motion.deskew(&mut scan);
        }
        scan.drop_not_finite();
        Ok(cloud(&scan.at_most(self.max_points), map_from_lidar, stamp))
    }
}

/// Trajectories of a run in space, where they are known.
struct Trajectories {
    estimates: Column<Pose3>,
    refined: Option<Column<Pose3>>,
    truth: Option<Column<Pose3>>,
}

impl Trajectories {
    fn of(results: &LocalizationResults) -> Result<Self> {
        let raised = |in_space: &Option<Column<Pose3>>, planar: &Option<Column<Pose2>>| {
            let planar = planar.as_ref().map(|poses| poses.iter());
            let raised = planar.map(|poses| poses.map(|pose| pose3_from_pose2(pose, 0.0)));
            in_space.clone().or(raised.map(Iterator::collect))
        };
        let estimates = raised(&results.estimates_in_space, &results.estimates);
        Ok(Self {
            estimates: estimates.context("the result holds no estimates; run localize again")?,
            refined: raised(&results.refined_in_space, &results.refined),
            truth: raised(&results.ground_truth_in_space, &results.ground_truth),
        })
    }

    /// The refined poses, else the estimates.
    fn best(&self) -> &[Pose3] {
        self.refined.as_ref().unwrap_or(&self.estimates)
    }

    /// Sends the poses, the state and the numbers of a frame.
    fn send(
        &self,
        log: &mut dyn MessageSink,
        results: &LocalizationResults,
        row: usize,
        stamp: u64,
    ) -> Result<()> {
        log.send("/tf", stamp, &transform(&self.best()[row], stamp))?;
        let state = |row: usize| Some(State::from_number(results.states.as_ref()?[row])?.word());
        let of_refined = |row: usize| {
            let states = results
                .refined_states
                .as_ref()
                .or(results.states.as_ref())?;
            Some(State::from_number(states[row])?.word())
        };
        let covariance = |all: &Option<Column<_>>| all.as_ref().map(|all| all[row]);
        let of_estimate = covariance(&results.covariances);
        let estimate = odometry(&self.estimates[row], of_estimate, state(row), stamp);
        log.send("/estimate", stamp, &estimate)?;
        if let Some(refined) = &self.refined {
            let covariance = covariance(&results.refined_covariances);
            let refined = odometry(&refined[row], covariance, of_refined(row), stamp);
            log.send("/refined", stamp, &refined)?;
        }
        if let Some(truth) = self.truth_of(row) {
            let truth = PoseInFrame {
                timestamp: timestamp(stamp),
                frame_id: MAP.to_owned(),
                pose: Some(pose(truth)),
            };
            log.send("/truth", stamp, &truth)?;
        }
        if let Some(now) = state(row)
            && (row == 0 || state(row - 1) != Some(now))
        {
            let is_tracking = now == State::Tracking.word();
            let message = format!("frame {}: {now}", results.frames[row]);
            let change = state_change(message, is_tracking, stamp);
            log.send("/state", stamp, &change)?;
        }
        log.send_json("/numbers", stamp, &self.numbers(results, row, state(row)))
    }

    /// The true pose of a frame, where it is known.
    fn truth_of(&self, row: usize) -> Option<&Pose3> {
        let truth = &self.truth.as_ref()?[row];
        (!truth.translation.x.is_nan()).then_some(truth)
    }

    fn numbers(&self, results: &LocalizationResults, row: usize, state: Option<&str>) -> Value {
        let errors = |poses: &[Pose3]| {
            let [pose, truth] = [&poses[row], self.truth_of(row)?].map(pose2_from_pose3);
            planar_errors(&[pose], &[truth]).first().copied()
        };
        let best = pose2_from_pose3(&self.best()[row]);
        let covariance = results.best_covariances().map(|all| all[row]);
        let axes = covariance.map(|covariance| Axes::new(&covariance, &best));
        let [error, refined_error] = [Some(&self.estimates), self.refined.as_ref()]
            .map(|poses| poses.and_then(|poses| errors(poses)));
        let agreement = results.agreements.as_ref().map(|all| all[row]);
        json!({
            "frame": results.frames[row],
            "state": state,
            "particles": (!results.particles.is_empty()).then(|| results.particles.count(row)),
            "agreement": agreement.filter(|&share| share >= 0.0),
            "places": results.places.as_ref().map(|all| all[row] as u64),
            "sigma_long_m": axes.map(|axes| axes.long_m),
            "sigma_short_m": axes.map(|axes| axes.short_m),
            "sigma_heading_deg": covariance.map(|it| it[(2, 2)].max(0.0).sqrt().to_degrees()),
            "position_error_m": error.map(|error| error.distance_m()),
            "heading_error_deg": error.map(|error| error.turn_rad.to_degrees()),
            "refined_position_error_m": refined_error.map(|error| error.distance_m()),
            "refined_heading_error_deg": refined_error.map(|error| error.turn_rad.to_degrees()),
            "time_ms": results.runtimes_s.as_ref().map(|all| 1e3 * all[row]),
        })
    }

    /// The trajectories as lines, with gaps where they are not trusted.
    fn scene(&self, results: &LocalizationResults, stamp: u64) -> SceneUpdate {
        let line = |color: Rgb, poses: &[Pose3]| LinePrimitive {
            r#type: line_primitive::Type::LineStrip.into(),
            thickness: 3.0,
            scale_invariant: true,
            points: poses.iter().map(point).collect(),
            color: Some(opaque(color)),
            ..LinePrimitive::default()
        };
        let estimate = results.trajectory_in_space().unwrap_or(&self.estimates);
        let all = results.has_truth().unwrap_or_default();
        let lines = [
            ("truth", TRUTH, self.truth.as_ref(), all),
            ("estimate", MCL, Some(estimate), results.trusted()),
            (
                "refined",
                REFINED,
                self.refined.as_ref(),
                results.refined_trusted(),
            ),
        ];
        let entities = lines
            .into_iter()
            .filter_map(|(name, color, poses, trusted)| {
                let poses = poses?;
                let stretches = stretches(&trusted);
                Some(SceneEntity {
                    lines: stretches.map(|rows| line(color, &poses[rows])).collect(),
                    ..entity(name, stamp)
                })
            });
        SceneUpdate {
            entities: entities.collect(),
            ..SceneUpdate::default()
        }
    }
}
