//! The loop over the frames of a localization.

use std::sync::MutexGuard;

use anyhow::Result;
use nalgebra::Vector2;

use super::super::motion_source::MotionSource;
use super::frame_tracker::{FrameTracker, TrackedFrame};
use super::opened::Opened;
use super::recorder::Run;
use crate::app::run::Context;
use crate::app::settings::{Initialization, LocalizationConfig};
use crate::geometry::Pose2;
use crate::localization::Start;
use crate::map::Map;
use crate::recording::Recording;

/// Localizes frames until the end, an interruption or an error, which is recorded.
pub fn localize<'a>(
    opened: &Opened,
    motion: MotionSource,
    recorded: &(dyn Fn() -> MutexGuard<'a, Run> + Sync),
    context: &Context,
) -> Result<()> {
    let start = start(&opened.config, &opened.map, &opened.recording);
    let mut tracker = FrameTracker::new(opened, motion, start)?;
    let task = (context.progress).task("localize", opened.recording.frames.len());
    let mut frames = opened.recording.frames.iter();
    let is_requested = || context.interrupt.requested();
    let first = frames.next().filter(|_| !is_requested());
    let mut next = first.map(|first| tracker.begin(first));
    while let Some(current) = next {
        let process = || {
            let current = current?;
            let record = |tracked: &TrackedFrame<'_>| {
                recorded().record(current.frame, &current.scan, tracked)
            };
            let (recorded, next) = tracker.step_and_read(&current, frames.next(), record);
            recorded.map(|()| next)
        };
        next = match process() {
            Ok(next) => next,
            Err(error) => {
                recorded().failure = Some(error);
                break;
            }
        };
        task.advance(1);
        if is_requested() {
            break;
        }
    }
    Ok(())
}

/// Where the particles start.
pub fn start(config: &LocalizationConfig, map: &Map, recording: &Recording) -> Start {
    let spread = config.start.clone();
    match (config.initialization(), config.initial_pose) {
        (Initialization::Tracking, Some([x, y, heading_deg])) => Start::Pose {
            map_from_lidar: Pose2::new(Vector2::new(x, y), heading_deg.to_radians()),
            height_m: None,
            spread,
        },
        (Initialization::Tracking, None) => {
            let first = recording.frames.first();
            let truth = first.and_then(|frame| frame.map_from_lidar);
            Start::near(&truth.unwrap_or_default(), spread)
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
