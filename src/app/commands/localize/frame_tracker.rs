//! One step of a localization: a frame with the motion into it.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use anyhow::Result;

use super::super::motion_source::{FrameMotion, MotionSource};
use super::opened::Opened;
use crate::app::settings::MotionModel;
use crate::lidar::Scan;
use crate::localization::motion::VelocityCommand;
use crate::localization::{
    BackEnd, Estimate, FrontEnd, Measured, Odometry, Start, Tracker, TrackerConfig, TrackerError,
};
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
    /// Times: of the frame without its refinement, and of that. Where the next frame is measured meanwhile, the former is the time
    /// since the frame before was done.
    pub runtimes: [Duration; 2],
}

/// A frame whose scan was read, with the motion into it as the scans show it.
pub struct MeasuredFrame<'a> {
    /// The frame.
    pub frame: &'a Frame,
    /// Its scan.
    pub scan: Scan,
    measured: Measured,
}

/// Localizes frames one after the other; frames may be left out.
pub struct FrameTracker<'a> {
    tracker: Tracker,
    /// Frames between those that are localized, of which the odometry of the scans needs all.
    between: VecDeque<Frame>,
    localizer: FrameLocalizer<'a>,
    /// When the last frame was done, before the first when it was begun.
    done: Instant,
}

/// Localizes frames that were measured, and refines them.
struct FrameLocalizer<'a> {
    opened: &'a Opened,
    motion: MotionSource,
    refiner: Option<TrajectoryRefiner>,
    /// Row of the last frame in the recording, and its time [s].
    last: Option<(usize, f64)>,
}

impl<'a> FrameTracker<'a> {
    /// A tracker before the first frame.
    pub fn new(opened: &'a Opened, mut motion: MotionSource, start: Start) -> Result<Self> {
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
        tracker = match sensor {
            Some(sensor) => tracker.with_sensor(sensor.clone()),
            // That of a robot.
            None => tracker.in_real_time(),
        };
        let sensor = sensor.as_ref().filter(|_| config.refine);
        let seed = config.tracker.seed;
        let refiner = sensor.map(|it| TrajectoryRefiner::new(map, it, config.refiner(), seed));
        Ok(Self {
            tracker: tracker.with_start(start),
            between: motion.take_frames_between(),
            localizer: FrameLocalizer {
                opened,
                motion,
                refiner: refiner.transpose()?,
                last: None,
            },
            done: Instant::now(),
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

    /// Localizes a frame, later than those before; `given` is the motion since the last one that was localized, where the
    /// robot measures it.
    pub fn step(
        &mut self,
        frame: &Frame,
        scan: &Scan,
        given: Option<FrameMotion>,
    ) -> Result<TrackedFrame<'_>> {
        let started = Instant::now();
        let (front, back) = self.tracker.split();
        let measured = measure(front, &mut self.between, frame, scan)?;
        (self.localizer).step(back, frame, scan, &measured, given, started)
    }

    /// Reads the first frame and measures it.
    pub fn begin<'f>(&mut self, frame: &'f Frame) -> Result<MeasuredFrame<'f>> {
        self.done = Instant::now();
        read(self.tracker.split().0, &mut self.between, frame)
    }

    /// Localizes a frame and records it, while the next one is read and measured.
    pub fn step_and_read<'f>(
        &mut self,
        current: &MeasuredFrame,
        next: Option<&'f Frame>,
        record: impl FnOnce(&TrackedFrame) -> Result<()> + Send,
    ) -> (Result<()>, Option<Result<MeasuredFrame<'f>>>) {
        let MeasuredFrame {
            frame,
            scan,
            measured,
        } = current;
        let (front, back) = self.tracker.split();
        let (localizer, done) = (&mut self.localizer, &mut self.done);
        let localize = || {
            let tracked = localizer.step(back, frame, scan, measured, None, *done)?;
            *done = Instant::now();
            record(&tracked)
        };
        let read = || next.map(|next| read(front, &mut self.between, next));
        rayon::join(localize, read)
    }
}

/// Reads a frame and measures the motion into it.
fn read<'f>(
    front: &mut FrontEnd,
    between: &mut VecDeque<Frame>,
    frame: &'f Frame,
) -> Result<MeasuredFrame<'f>> {
    let scan = frame.read()?;
    Ok(MeasuredFrame {
        frame,
        measured: measure(front, between, frame, &scan)?,
        scan,
    })
}

/// Measures the motion into a frame, over those between.
fn measure(
    front: &mut FrontEnd,
    between: &mut VecDeque<Frame>,
    frame: &Frame,
    scan: &Scan,
) -> Result<Measured> {
    for between in MotionSource::frames_before(between, frame) {
        front.pass(&between.read()?)?;
    }
    Ok(front.measure(scan)?)
}

impl FrameLocalizer<'_> {
    /// Localizes a frame and refines it, where every frame is refined. Its time counts from `started`.
    fn step(
        &mut self,
        back: &mut BackEnd,
        frame: &Frame,
        scan: &Scan,
        measured: &Measured,
        given: Option<FrameMotion>,
        started: Instant,
    ) -> Result<TrackedFrame<'_>> {
        let frames = &self.opened.recording.frames;
        let row = frames.partition_point(|it| it.number < frame.number);
        let (since, before_s) = match self.last {
            Some((last, time_s)) => (last + 1, time_s),
            None => (row, frame.time_s),
        };
        let of_scans = back.motion_into(measured);
        let motion = (given.or_else(|| of_scans.in_space().map(FrameMotion::from_motion)))
            .or_else(|| self.motion.given_over(since..row + 1));
        let times_s = [before_s, frame.time_s];
        // A motion model has the noise of measured motions.
        let odometry = match (given, of_scans) {
            (None, Odometry::Assumed(_)) => of_scans,
            _ => odometry_into(self.opened.config.motion_model, motion, times_s),
        };
        let estimate = back.step(scan, measured, odometry)?;
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
