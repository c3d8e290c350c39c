//! The loop over the frames of a localization.

use std::sync::MutexGuard;
use std::time::{Duration, Instant};

use anyhow::Result;
use nalgebra::Vector2;

use super::super::motion_source::{FrameMotion, MotionSource};
use super::opened::Opened;
use super::recorder::Run;
use crate::app::run::Context;
use crate::app::settings::{Initialization, LocalizationConfig, MotionModel};
use crate::geometry::Pose2;
use crate::localization::motion::VelocityCommand;
use crate::localization::{Odometry, Start, Tracker, TrackerConfig};
use crate::map::Map;
use crate::recording::Recording;
use crate::refinement::{InitialEstimate, TrajectoryRefiner};

/// Localizes frames until the end, an interruption or an error, which is recorded.
pub fn localize<'a>(
    opened: &Opened,
    motion: &mut MotionSource,
    recorded: &dyn Fn() -> MutexGuard<'a, Run>,
    context: &Context,
) -> Result<()> {
    let Opened {
        config,
        map,
        recording,
        sensor,
        ..
    } = opened;
    let tracker = TrackerConfig {
        odometry: (config.tracker.odometry.clone())
            .filter(|_| matches!(motion, MotionSource::Scans(_))),
        ..config.tracker.clone()
    };
    let tracker = Tracker::new(map, tracker)?.with_sensor(sensor.clone());
    let mut tracker = tracker.with_start(start(config, map, recording));
    let refiner = || TrajectoryRefiner::new(map, sensor, config.refiner(), config.tracker.seed);
    let mut refiner = config.refine.then(refiner).transpose()?;
    let task = context.progress.task("localize", recording.frames.len());
    for (row, frame) in recording.frames.iter().enumerate() {
        if context.interrupt.requested() {
            break;
        }
        let mut process = || {
            let scan = frame.read()?;
            let started = Instant::now();
            for between in motion.frames_before(frame) {
                tracker.pass(&between.read()?)?;
            }
            let known = match tracker.measure(&scan)? {
                Odometry::Motion(motion) => Some(FrameMotion::from_motion(motion)),
                _ => motion.given_to(row),
            };
            let increment = known.map(|motion| motion.increment);
            let odometry = odometry_into(config.motion_model, known, recording, row);
            let estimate = tracker.step_with_motion(&scan, odometry)?;
            let runtime = started.elapsed();
            let refined = match &mut refiner {
                Some(refiner) => Some(refiner.add(&scan, &InitialEstimate::from(&estimate))?),
                None => None,
            };
            let runtimes = [runtime, started.elapsed() - runtime];
            recorded().record(frame, increment, &scan, &estimate, refined, runtimes)
        };
        if let Err(error) = process() {
            recorded().failure = Some(error);
            break;
        }
        task.advance(1);
    }
    Ok(())
}

/// Where the particles start.
fn start(config: &LocalizationConfig, map: &Map, recording: &Recording) -> Start {
    let spread = config.start.clone();
    match (config.initialization(), config.initial_pose) {
        (Initialization::Tracking, Some([x, y, heading_deg])) => Start::Pose {
            map_from_lidar: Pose2::new(Vector2::new(x, y), heading_deg.to_radians()),
            height_m: None,
            spread,
        },
        (Initialization::Tracking, None) => {
            let truth = recording.frames[0].map_from_lidar.unwrap_or_default();
            Start::near(&truth, spread)
        }
        (Initialization::Corridor, _) => Start::Road,
        (Initialization::Extent, _) if config.initialization.is_some() => Start::Anywhere,
        (Initialization::Extent, _) => {
            let start = Start::unknown(map);
            if start == Start::Road {
                tracing::info!(
                    "the map is large: an unknown start is searched along its road; set initialization to extent to search all ground"
                );
            }
            start
        }
    }
}

/// The odometry into a frame, in the form that the motion model needs.
fn odometry_into(
    model: MotionModel,
    motion: Option<FrameMotion>,
    recording: &Recording,
    row: usize,
) -> Odometry {
    let Some(FrameMotion {
        increment,
        in_space,
    }) = motion
    else {
        return Odometry::Unknown;
    };
    match model {
        MotionModel::TurnDriveTurn => {
            in_space.map_or(Odometry::Increment(increment), Odometry::Motion)
        }
        MotionModel::Velocity => {
            let times_s = [row.saturating_sub(1), row].map(|row| recording.frames[row].time_s);
            let duration = Duration::from_secs_f64((times_s[1] - times_s[0]).max(0.0));
            Odometry::Velocity(VelocityCommand::driving(&increment, duration))
        }
    }
}
