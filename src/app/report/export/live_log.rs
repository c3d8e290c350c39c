//! Messages of a localization that goes on, on the topics of [logs](super::log) and with their schemas.
//!
//! `/tf` is sent only while the pose is believed; each change of the `/state` has its reason; `/numbers` has latency and dropped
//! scans in addition. They are encoded in a thread of their own: neither a slow disk nor a large map slows the localization.

use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use anyhow::Result;
#[cfg(feature = "viewer")]
use foxglove::messages::{FrameTransform, Log, Odometry, PointCloud, PosesInFrame, SceneUpdate};
use serde_json::json;

use super::log::MOST_POINTS;
use super::messages::{
    cloud, map_scene, nanoseconds, odometry, particles, state_change, transform,
};
#[cfg(feature = "viewer")]
use super::sinks::Topic;
use super::sinks::{MessageSink, Sinks};
use crate::app::report::run_output::particle_rows;
use crate::evaluation::trust::Axes;
use crate::geometry::TriangleMesh;
use crate::lidar::Scan;
use crate::live::Reason;
use crate::localization::Estimate;

/// Frames that may wait until they are encoded: those of three seconds of most sensors.
const MOST_WAITING: usize = 32;

/// Time between flushes of the log.
const FLUSH: Duration = Duration::from_secs(1);

/// The topics of all messages.
#[cfg(feature = "viewer")]
pub fn live_topics() -> Result<[Topic; 7]> {
    Ok([
        Topic::of::<SceneUpdate>("/map")?,
        Topic::of::<Log>("/state")?,
        Topic::of::<FrameTransform>("/tf")?,
        Topic::of::<Odometry>("/estimate")?,
        Topic::of::<PosesInFrame>("/particles")?,
        Topic::of::<PointCloud>("/scan")?,
        Topic::of_numbers("/numbers"),
    ])
}

/// A frame that was localized.
pub struct LiveFrame {
    /// Its number.
    pub number: usize,
    /// Its time [s].
    pub time_s: f64,
    /// Its scan.
    pub scan: Scan,
    /// Its estimate.
    pub estimate: Estimate,
    /// Why the localization is in its state.
    pub reason: Reason,
    /// Time from the arrival of the scan to its pose.
    pub latency: Duration,
    /// Number of scans that were dropped so far.
    pub dropped: u64,
    /// Number of scans that could not be used so far.
    pub rejected: u64,
}

/// What is known at a moment.
enum Known {
    Frame(Box<LiveFrame>),
    State { time_s: f64, reason: Reason },
}

/// The side of the localization, which never waits.
pub struct LiveLog {
    waiting: SyncSender<Known>,
    left_out: u64,
}

/// The side that encodes and sends.
pub struct LiveLogWriter {
    sinks: Sinks,
    waiting: Receiver<Known>,
}

/// A log that is sent to sinks.
pub fn live_log(sinks: Sinks) -> (LiveLog, LiveLogWriter) {
    let (sender, receiver) = sync_channel(MOST_WAITING);
    let log = LiveLog {
        waiting: sender,
        left_out: 0,
    };
    let writer = LiveLogWriter {
        sinks,
        waiting: receiver,
    };
    (log, writer)
}

impl LiveLog {
    /// Sends a frame.
    pub fn frame(&mut self, frame: LiveFrame) {
        let scan = frame.scan.at_most(MOST_POINTS);
        self.send(Known::Frame(LiveFrame { scan, ..frame }.into()));
    }

    /// Sends a change of the state.
    pub fn state(&mut self, time_s: f64, reason: Reason) {
        self.send(Known::State { time_s, reason });
    }

    fn send(&mut self, known: Known) {
        if self.waiting.try_send(known).is_err() {
            self.left_out += 1;
        }
    }
}

impl Drop for LiveLog {
    fn drop(&mut self) {
        if self.left_out > 0 {
            tracing::warn!(
                "{} messages were left out of log and viewers, which take them more slowly than the scans arrive: write the log to a faster disk",
                self.left_out
            );
        }
    }
}

impl LiveLogWriter {
    /// Sends the map and what is known until the localization ends. A log that fails is reported, and the drive goes on.
    pub fn run(mut self, mesh: &TriangleMesh, first_s: f64) {
        let sinks: &mut dyn MessageSink = &mut self.sinks;
        let mut send = || {
            let stamp = nanoseconds(first_s);
            sinks.send("/map", stamp, &map_scene(mesh, stamp)?)?;
            send_state(sinks, first_s, Reason::NoScan)?;
            sinks.flush()?;
            let mut flushed = Instant::now();
            loop {
                if flushed.elapsed() >= FLUSH {
                    sinks.flush()?;
                    flushed = Instant::now();
                }
                let wait = FLUSH.saturating_sub(flushed.elapsed());
                match self.waiting.recv_timeout(wait) {
                    Ok(Known::Frame(frame)) => send_frame(sinks, *frame)?,
                    Ok(Known::State { time_s, reason }) => send_state(sinks, time_s, reason)?,
                    Err(RecvTimeoutError::Timeout) => {}
                    Err(RecvTimeoutError::Disconnected) => return sinks.finish(),
                }
            }
        };
        if let Err(error) = send() {
            tracing::warn!("the log ends: {error:#}");
        }
    }
}

fn send_state(sinks: &mut dyn MessageSink, time_s: f64, reason: Reason) -> Result<()> {
    let (stamp, state) = (nanoseconds(time_s), reason.state());
    let message = format!("{}: {}", state.word(), reason.words());
    let change = state_change(message, state.is_believed(), stamp);
    sinks.send("/state", stamp, &change)
}

fn send_frame(sinks: &mut dyn MessageSink, frame: LiveFrame) -> Result<()> {
    let LiveFrame {
        mut scan,
        estimate,
        reason,
        ..
    } = frame;
    let (stamp, state) = (nanoseconds(frame.time_s), reason.state());
    let pose = &estimate.map_from_lidar;
    if state.is_believed() {
        sinks.send("/tf", stamp, &transform(pose, stamp))?;
    }
    let covariance = Some(estimate.covariance);
    let odometry = odometry(pose, covariance, Some(state.word()), stamp);
    sinks.send("/estimate", stamp, &odometry)?;
    let rows = particle_rows(&estimate.particles);
    let particles = particles(&rows, pose.translation.z, stamp);
    sinks.send("/particles", stamp, &particles)?;
    if let Some(motion) = &estimate.motion {
        motion.deskew(&mut scan);
    }
    scan.drop_not_finite();
    sinks.send("/scan", stamp, &cloud(&scan, pose, stamp))?;
    let axes = Axes::new(&estimate.covariance, &estimate.pose);
    let [_, _, heading_rad] = estimate.standard_deviations();
    sinks.send_json(
        "/numbers",
        stamp,
        &json!({
            "frame": frame.number,
            "state": state.word(),
            "reason": reason.words(),
            "particles": estimate.particles.len(),
            "agreement": estimate.agreement,
            "places": estimate.places,
            "sigma_long_m": axes.long_m,
            "sigma_short_m": axes.short_m,
            "sigma_heading_deg": heading_rad.to_degrees(),
            "latency_ms": 1e3 * frame.latency.as_secs_f64(),
            "dropped": frame.dropped,
            "rejected": frame.rejected,
        }),
    )
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;
    use std::thread;

    use super::super::sinks::Message;
    use super::*;

    /// Takes nothing until it is released.
    struct Hanging(Receiver<()>);

    impl MessageSink for Hanging {
        fn write(&mut self, _message: &Message) -> Result<()> {
            self.0.recv().ok();
            Ok(())
        }

        fn finish(&mut self) -> Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_sink_that_hangs_slows_no_localization() {
        let (release, hanging) = channel();
        let mut sinks = Sinks::default();
        sinks.add("a log".to_owned(), Hanging(hanging));
        let (mut log, writer) = live_log(sinks);
        thread::scope(|scope| {
            scope.spawn(|| writer.run(&TriangleMesh::default(), 0.0));
            for frame in 0..1000 {
                log.state(f64::from(frame), Reason::ScanAgrees);
            }
            // One may be taken out of those that wait.
            let least = 1000 - MOST_WAITING as u64 - 1;
            assert!((least..1000).contains(&log.left_out), "{}", log.left_out);
            drop((release, log));
        });
    }
}
