//! The loop over the scans that arrive.

use std::iter;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use anyhow::Result;

use super::super::localize::Recorded;
use super::super::localize::frame_tracker::FrameTracker;
use super::super::localize::opened::Opened;
use super::super::motion_source::{FrameMotion, MotionSource};
use super::last_pose::LastPoseWriter;
use super::robot::{ArrivedFrame, CarriedPose, MeasuredPose, Robot, Waiting};
use crate::app::report::export::{LiveFrame, LiveLog, Sinks, live_log};
use crate::app::report::results::{LatencySummary, LiveSummary};
use crate::app::report::run_output;
use crate::app::run::Context;
use crate::geometry::{Pose3, pose3_from_pose2};
use crate::lidar::Motion;
use crate::live::{
    Arrival, Inbox, Latencies, LiveState, Monitor, Outage, Reason, Received, StampClock, Tick,
};
use crate::localization::{LocalizerError, Start, TrackerError};

/// Longest wait for a scan before the state is looked at.
const WAIT: Duration = Duration::from_millis(50);

/// Time between scans while it is not known, and the longest that is: a stall does not make the next one longer.
const USUAL_PERIOD: Duration = Duration::from_millis(100);
const LONGEST_PERIOD: Duration = Duration::from_secs(1);

/// A drive whose scans arrive at their own pace.
pub struct Drive<'a, 'b> {
    /// Map and configuration, and the recording that is replayed.
    pub opened: &'a Opened,
    /// Takes the localized frames.
    pub recorded: Recorded<'a, 'b>,
    /// Seconds of the stamps per second: how many times faster than it was recorded.
    pub rate: f64,
    /// Number of scans that may wait.
    pub queue: usize,
    /// Interruption and progress.
    pub context: &'a Context,
}

impl Drive<'_, '_> {
    /// Has scans received in one thread and localizes them in this one, until the last or an interruption. `receive` fills the
    /// inbox until it is closed, closes it at the end, and counts what it could not read.
    pub fn run(
        &self,
        motion: MotionSource,
        start: Start,
        sinks: Sinks,
        robot: Robot<'_>,
        receive: impl FnOnce(&Inbox<ArrivedFrame>, &AtomicU64) + Send,
    ) -> Result<()> {
        // A known start is that of the first scan, which is not dropped.
        let is_prepared = matches!(start, Start::Pose { .. });
        let tracker = FrameTracker::new(self.opened, motion, start)?;
        let inbox = Inbox::new(self.queue);
        let unreadable = AtomicU64::new(0);
        let mesh = (!sinks.is_empty())
            .then(|| run_output::map_around(&self.opened.map, iter::empty()))
            .transpose()?;
        let summary = thread::scope(|scope| {
            scope.spawn(|| receive(&inbox, &unreadable));
            let log = mesh.map(|mesh| {
                let (log, writer) = live_log(sinks);
                let first = self.opened.recording.frames.first();
                let first_s = first.map_or_else(now_s, |frame| frame.time_s);
                scope.spawn(move || writer.run(&mesh, first_s));
                log
            });
            let reception = Reception {
                inbox: &inbox,
                unreadable: &unreadable,
            };
            let mut driver = Driver::new(self, reception, tracker, is_prepared, log, robot);
            let outcome = driver.follow();
            // Nobody takes what the other thread would still send.
            inbox.close();
            outcome.map(|()| driver.summary())
        })?;
        let unreadable = unreadable.into_inner();
        let rejected = summary.rejected + unreadable;
        let mut run = (self.recorded)();
        run.missed = (inbox.dropped() + rejected) as usize;
        // Those that a signal has left waiting are lost to a robot, and not to a recording.
        let dropped = inbox.dropped() + inbox.len() as u64;
        if self.opened.is_driving() {
            run.missed += inbox.len();
            run.results.selected = Some(run.results.len() + run.missed);
        }
        run.live = Some(LiveSummary {
            received: inbox.received() + unreadable,
            dropped,
            rejected,
            ..summary
        });
        Ok(())
    }

    /// The time of the recording for a time that passes between two scans, so that a slow replay does not look like a stalled
    /// sensor. In a fast replay, where reading the files may take longer, the time that passes.
    fn recorded_time(&self, passed: Duration) -> Duration {
        passed.mul_f64(self.rate.min(1.0))
    }
}

/// Now, in nanoseconds since 1970.
pub fn now_ns() -> u64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since.map_or(0, |it| it.as_nanos() as u64)
}

/// Now, in seconds since 1970.
fn now_s() -> f64 {
    1e-9 * now_ns() as f64
}

/// What the thread that receives has for the one that computes.
#[derive(Clone, Copy)]
struct Reception<'a> {
    inbox: &'a Inbox<ArrivedFrame>,
    /// Number of scans that could not be read.
    unreadable: &'a AtomicU64,
}

/// The last scan that was localized.
struct LastScan {
    /// Its time [s].
    time_s: f64,
    arrived: Instant,
    /// Time since the one before.
    period: Option<Duration>,
    /// Number of scans that could not be used until then.
    rejected: u64,
}

/// The thread that computes.
struct Driver<'a, 'b> {
    drive: &'a Drive<'a, 'b>,
    reception: Reception<'a>,
    tracker: FrameTracker<'a>,
    monitor: Monitor,
    clock: StampClock,
    latencies: Latencies,
    last_pose: Option<LastPoseWriter>,
    log: Option<LiveLog>,
    robot: Robot<'a>,
    /// Time of the last scan that was localized [s], and the pose by the odometry, where it is measured.
    measured_last: Option<(f64, MeasuredPose)>,
    summary: LiveSummary,
    /// Whether the map is prepared for the start.
    is_prepared: bool,
    last: Option<LastScan>,
}

impl<'a, 'b> Driver<'a, 'b> {
    fn new(
        drive: &'a Drive<'a, 'b>,
        reception: Reception<'a>,
        tracker: FrameTracker<'a>,
        is_prepared: bool,
        log: Option<LiveLog>,
        robot: Robot<'a>,
    ) -> Self {
        let config = &drive.opened.config;
        Self {
            drive,
            reception,
            tracker,
            monitor: Monitor::new(&config.tracker.localizer),
            clock: StampClock::new(drive.rate),
            latencies: Latencies::default(),
            last_pose: LastPoseWriter::new(config),
            log,
            robot,
            measured_last: None,
            summary: LiveSummary::default(),
            is_prepared,
            last: None,
        }
    }

    /// Takes scans until the last.
    fn follow(&mut self) -> Result<()> {
        let inbox = self.reception.inbox;
        let context = self.drive.context;
        let frames = self.drive.opened.recording.frames.len();
        let task = (frames > 0).then(|| context.progress.task("live", frames));
        while !context.interrupt.requested() {
            if let Some(start) = (self.robot.proposed)() {
                self.propose(start)?;
            }
            match inbox.take(WAIT) {
                Received::End => break,
                Received::Nothing => self.wait(Instant::now()),
                Received::Scan(arrival) if !self.is_prepared => {
                    self.prepare(&arrival)?;
                    inbox.put_back(arrival);
                }
                Received::Scan(arrival) => {
                    self.take(arrival)?;
                    let count = inbox.dropped() + self.summary.rejected + self.latencies.count();
                    if let Some(task) = &task {
                        task.set_share(count as f64 / frames as f64);
                    }
                }
            }
        }
        if let Some(last_pose) = &mut self.last_pose {
            last_pose.write();
        }
        Ok(())
    }

    /// What was seen.
    fn summary(mut self) -> LiveSummary {
        self.summary.latency = LatencySummary::new(&self.latencies);
        self.summary
    }

    /// Prepares the map for the sensor of the first scan.
    fn prepare(&mut self, arrival: &Arrival<ArrivedFrame>) -> Result<()> {
        let (frame, scan) = &arrival.scan;
        self.note(Reason::Preparing, frame.time_s);
        self.is_prepared = true;
        match self.tracker.prepare_start(scan) {
            // What is wrong with this scan may be right with the next.
            Err(error) if is_about_scan(&error) => Ok(()),
            prepared => Ok(prepared?),
        }
    }

    /// Localizes a scan.
    fn take(&mut self, arrival: Arrival<ArrivedFrame>) -> Result<()> {
        let Arrival {
            scan: (frame, scan),
            arrived,
        } = arrival;
        let stamp_s = scan.time_s.unwrap_or(frame.time_s);
        match self.clock.tick(stamp_s, arrived) {
            Tick::Later => {}
            Tick::Repeated => {
                let why = format!("its time {stamp_s} s is not later than the last one");
                self.reject(arrived, &why);
                return Ok(());
            }
            Tick::Jumped => self.restart(frame.time_s)?,
        }
        let measured = (self.robot.measured)(frame.time_s);
        let motion = self.moved_to(frame.time_s, measured.as_ref());
        let motion = motion.map(FrameMotion::measured);
        let rejected = self.rejected();
        let tracked = match self.tracker.step(&frame, &scan, motion) {
            Err(error) if error.downcast_ref().is_some_and(is_about_scan) => {
                self.reject(arrived, &error.to_string());
                return Ok(());
            }
            tracked => tracked?,
        };
        self.measured_last = measured.map(|measured| (frame.time_s, measured));
        let since = |last: &LastScan| arrived.saturating_duration_since(last.arrived);
        let period = self.last.as_ref().map(since);
        self.last = Some(LastScan {
            time_s: frame.time_s,
            arrived,
            period: period.map(|period| self.drive.recorded_time(period)),
            rejected,
        });
        let before = self.monitor.reason();
        self.monitor
            .update(&tracked.estimate, &in_space(tracked.motion));
        let state = self.monitor.state();
        if let (LiveState::Tracking, Some(last_pose)) = (state, &mut self.last_pose) {
            last_pose.update(frame.time_s, &tracked.estimate.map_from_lidar);
        }
        *self.summary.states.entry(state).or_default() += 1;
        let estimate = tracked.estimate.clone();
        let localized = LiveFrame {
            number: frame.number,
            time_s: frame.time_s,
            scan,
            estimate,
            reason: self.monitor.reason(),
            latency: arrived.elapsed(),
            dropped: self.reception.inbox.dropped(),
            rejected,
        };
        (self.robot.localized)(&localized);
        self.latencies.add(arrived.elapsed());
        (self.drive.recorded)().record(&frame, &localized.scan, &tracked)?;
        if let Some(log) = &mut self.log {
            log.frame(localized);
        }
        self.note_change(before, frame.time_s);
        Ok(())
    }

    /// Motion from the last scan that was localized to a time [s], where both are measured and the odometry was not reset.
    fn moved_to(&self, time_s: f64, measured: Option<&MeasuredPose>) -> Option<Pose3> {
        let (last_s, last) = self.measured_last.as_ref()?;
        measured?.since(last, time_s - last_s)
    }

    /// Looks at the state at a moment at which no scan is localized.
    fn wait(&mut self, now: Instant) {
        let time_s = self.time_s(now);
        let mut carried = None;
        if let Some(last) = &self.last {
            let waited = now.saturating_duration_since(last.arrived);
            let waited = self.drive.recorded_time(waited);
            let period = last.period.unwrap_or(USUAL_PERIOD).min(LONGEST_PERIOD);
            let moved = self.moved_to(time_s, (self.robot.measured)(time_s).as_ref());
            let outage = if self.rejected() > last.rejected {
                Outage::UnusableScans
            } else {
                Outage::NoScans
            };
            let before = self.monitor.reason();
            (self.monitor).wait(outage, waited, period, moved.as_ref());
            let duration_s = time_s - last.time_s;
            carried = moved.and_then(|moved| self.carried(moved, duration_s));
            self.note_change(before, time_s);
        }
        let waiting = Waiting {
            time_s,
            reason: self.monitor.reason(),
            carried,
            dropped: self.reception.inbox.dropped(),
            rejected: self.rejected(),
        };
        (self.robot.waiting)(&waiting);
    }

    /// The pose after a motion since the last scan, while that carries it.
    fn carried(&self, moved: Pose3, duration_s: f64) -> Option<CarriedPose> {
        if !self.monitor.is_carried() || duration_s <= 0.0 {
            return None;
        }
        Some(CarriedPose {
            pose: self.monitor.pose_after(&moved)?,
            motion: Motion {
                previous_from_current: moved,
                duration_s,
            },
        })
    }

    /// Restarts at a proposed start, which the scans have to confirm.
    fn propose(&mut self, start: Start) -> Result<()> {
        let tiles = &self.drive.opened.map.tiles;
        if let Start::Pose { map_from_lidar, .. } = &start
            && tiles.valid_tile_of(map_from_lidar).is_none()
        {
            let t = map_from_lidar.translation;
            tracing::warn!(
                "the pose that was proposed at x {:.1} m, y {:.1} m is outside the mapped area, and is left out; give one in the frame of the map",
                t.x,
                t.y
            );
            return Ok(());
        }
        self.tracker.restart(start)?;
        (self.measured_last, self.is_prepared) = (None, true);
        self.note(Reason::PoseProposed, self.time_s(Instant::now()));
        Ok(())
    }

    /// Begins again after the clock of the scans was set, around the pose that was believed.
    fn restart(&mut self, time_s: f64) -> Result<()> {
        tracing::warn!(
            "the clock of the scans jumped to {time_s} s: the localization begins again"
        );
        let opened = self.drive.opened;
        let last = self.monitor.pose_after(&Pose3::identity());
        let start = last.map_or_else(
            || Start::unknown(&opened.map),
            |last| Start::near(&last.map_from_lidar, opened.config.start.clone()),
        );
        self.tracker.restart(start)?;
        self.measured_last = None;
        self.note(Reason::ClockJumped, time_s);
        Ok(())
    }

    /// Leaves out a scan. A sensor all of whose scans are left out is as one that sends none.
    fn reject(&mut self, arrived: Instant, why: &str) {
        if self.summary.rejected == 0 {
            tracing::warn!("a scan is left out: {why}");
        }
        self.summary.rejected += 1;
        self.wait(arrived);
    }

    /// Number of scans that could not be used so far.
    fn rejected(&self) -> u64 {
        self.summary.rejected + self.reception.unreadable.load(Ordering::Relaxed)
    }

    /// A moment by the clock of the scans [s]; before the first one, by that of the machine.
    fn time_s(&self, now: Instant) -> f64 {
        self.last.as_ref().map_or_else(now_s, |last| {
            let waited = now.saturating_duration_since(last.arrived);
            last.time_s + self.drive.rate * waited.as_secs_f64()
        })
    }

    /// Sets a reason that is not that of an estimate.
    fn note(&mut self, reason: Reason, time_s: f64) {
        let before = self.monitor.reason();
        self.monitor.set(reason);
        self.note_change(before, time_s);
    }

    /// Reports a change of the state at a time [s].
    fn note_change(&mut self, before: Reason, time_s: f64) {
        let (state, reason) = (self.monitor.state(), self.monitor.reason());
        if state == before.state() {
            return;
        }
        self.summary.changes += 1;
        tracing::info!("{}: {}", state.word(), reason.words());
        if let Some(log) = &mut self.log {
            log.state(time_s, reason);
        }
    }
}

/// The motion in space; none where it is unknown.
fn in_space(motion: Option<FrameMotion>) -> Pose3 {
    motion.map_or_else(Pose3::identity, |motion| {
        let in_plane = || pose3_from_pose2(&motion.increment, 0.0);
        motion.in_space.unwrap_or_else(in_plane)
    })
}

/// Whether an error is about one scan, after which the next may be localized.
fn is_about_scan(error: &TrackerError) -> bool {
    matches!(
        error,
        TrackerError::Sensor(_)
            | TrackerError::Odometry(_)
            | TrackerError::Localizer(
                LocalizerError::Sensor(_) | LocalizerError::ImpossibleOdometry(_)
            )
    )
}
