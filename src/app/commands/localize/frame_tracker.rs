//! One step of a localization: a frame with the motion into it.

use std::time::{Duration, Instant};

use anyhow::Result;

use super::super::motion_source::{FrameMotion, MotionSource};
use super::opened::Opened;
use crate::app::settings::MotionModel;
use crate::lidar::Scan;
use crate::localization::motion::VelocityCommand;
use crate::localization::{Estimate, Odometry, Start, Tracker, TrackerConfig, TrackerError};
use crate::recording::Frame;
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

/// Localizes frames one after the other; frames may be left out.
pub struct FrameTracker<'a> {
    opened: &'a Opened,
    motion: &'a mut MotionSource,
    tracker: Tracker,
    refiner: Option<TrajectoryRefiner>,
    /// Row of the last frame in the recording, and its time [s].
    last: Option<(usize, f64)>,
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
        let mut tracker = Tracker::new(map, tracker)?;
        if let Some(sensor) = sensor {
            tracker = tracker.with_sensor(sensor.clone());
        }
        let sensor = sensor.as_ref().filter(|_| config.refine);
        let seed = config.tracker.seed;
        let refiner = sensor.map(|it| TrajectoryRefiner::new(map, it, config.refiner(), seed));
        Ok(Self {
            opened,
            motion,
            tracker: tracker.with_start(start),
            refiner: refiner.transpose()?,
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

    /// Localizes a frame, later than those before; `measured` is the motion since the last one that was localized, where the
    /// robot measures it.
    pub fn step(
        &mut self,
        frame: &Frame,
        scan: &Scan,
        measured: Option<FrameMotion>,
    ) -> Result<TrackedFrame<'_>> {
        let frames = &self.opened.recording.frames;
        let started = Instant::now();
        for between in self.motion.frames_before(frame) {
            self.tracker.pass(&between.read()?)?;
        }
        let row = frames.partition_point(|it| it.number < frame.number);
        let (since, before_s) = match self.last {
            Some((last, time_s)) => (last + 1, time_s),
            None => (row, frame.time_s),
        };
        let of_scans = self.tracker.measure(scan)?;
        let motion = match (measured, of_scans) {
            (Some(measured), _) => Some(measured),
            (None, Odometry::Motion(motion)) => Some(FrameMotion::from_motion(motion)),
            _ => self.motion.given_over(since..row + 1),
        };
        let times_s = [before_s, frame.time_s];
        let odometry = odometry_into(self.opened.config.motion_model, motion, times_s);
        let estimate = self.tracker.step_with_motion(scan, odometry)?;
        self.last = Some((row, frame.time_s));
        let runtime = started.elapsed();
        let refined = match &mut self.refiner {
            Some(refiner) => {
                refiner.forget();
                Some(refiner.add(scan, &InitialEstimate::from(&estimate))?)
            }
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
