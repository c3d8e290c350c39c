//! One step of a localization: a frame with the motion into it.

use std::time::{Duration, Instant};

use anyhow::Result;

use super::super::motion_source::{FrameMotion, MotionSource};
use super::opened::Opened;
use crate::app::settings::MotionModel;
use crate::lidar::Scan;
use crate::localization::motion::VelocityCommand;
use crate::localization::{Estimate, Odometry, Start, Tracker, TrackerConfig, TrackerError};
use crate::refinement::{FrameResult, InitialEstimate, TrajectoryRefiner};

/// A frame that was localized.
pub struct TrackedFrame<'a> {
    /// The motion since the frame that was localized before; `None` if it is unknown.
    pub motion: Option<FrameMotion>,
    /// The estimate.
    pub estimate: Estimate,
    /// The refined estimate, where every frame is refined.
    pub refined: Option<&'a FrameResult>,
    /// Computing times of the filter and of the refinement.
    pub runtimes: [Duration; 2],
}

/// Localizes frames of a recording one after the other; frames may be left out.
pub struct FrameTracker<'a> {
    opened: &'a Opened,
    motion: &'a mut MotionSource,
    tracker: Tracker,
    refiner: Option<TrajectoryRefiner>,
    /// Row of the last frame.
    last: Option<usize>,
}

impl<'a> FrameTracker<'a> {
    /// A tracker before the first frame.
    pub fn new(opened: &'a Opened, motion: &'a mut MotionSource, start: Start) -> Result<Self> {
        let Opened {
            config,
            map,
            sensor,
            ..
        } = opened;
        let tracker = TrackerConfig {
            odometry: (config.tracker.odometry.clone())
                .filter(|_| matches!(motion, MotionSource::Scans(_))),
            ..config.tracker.clone()
        };
        let tracker = Tracker::new(map, tracker)?.with_sensor(sensor.clone());
        let refiner = || TrajectoryRefiner::new(map, sensor, config.refiner(), config.tracker.seed);
        Ok(Self {
            opened,
            motion,
            tracker: tracker.with_start(start),
            refiner: config.refine.then(refiner).transpose()?,
            last: None,
        })
    }

    /// Does what the start needs before the first frame.
    pub fn prepare_start(&mut self, scan: &Scan) -> Result<(), TrackerError> {
        self.tracker.prepare_start(scan)
    }

    /// Begins again at a start with the next frame.
    pub fn restart(&mut self, start: Start) -> Result<(), TrackerError> {
        self.tracker.restart(start)
    }

    /// Localizes the frame of a row, later than those before.
    pub fn step(&mut self, row: usize, scan: &Scan) -> Result<TrackedFrame<'_>> {
        let recording = &self.opened.recording;
        let started = Instant::now();
        for between in self.motion.frames_before(&recording.frames[row]) {
            self.tracker.pass(&between.read()?)?;
        }
        let since = self.last.map_or(row, |last| last + 1);
        let motion = match self.tracker.measure(scan)? {
            Odometry::Motion(motion) => Some(FrameMotion::from_motion(motion)),
            _ => self.motion.given_over(since..row + 1),
        };
        let times_s = [since.saturating_sub(1), row].map(|row| recording.frames[row].time_s);
        let odometry = odometry_into(self.opened.config.motion_model, motion, times_s);
        let estimate = self.tracker.step_with_motion(scan, odometry)?;
        self.last = Some(row);
        let runtime = started.elapsed();
        let refined = match &mut self.refiner {
            Some(refiner) => Some(refiner.add(scan, &InitialEstimate::from(&estimate))?),
            None => None,
        };
        Ok(TrackedFrame {
            motion,
            estimate,
            refined,
            runtimes: [runtime, started.elapsed() - runtime],
        })
    }
}

/// The odometry into a frame, in the form that the motion model needs, between the times of the frame before and of this one.
fn odometry_into(
    model: MotionModel,
    motion: Option<FrameMotion>,
    [before_s, time_s]: [f64; 2],
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
            let duration = Duration::from_secs_f64((time_s - before_s).max(0.0));
            Odometry::Velocity(VelocityCommand::driving(&increment, duration))
        }
    }
}
