//! Scans of a recording as if the sensor sent them.

use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use super::robot::ArrivedFrame;
use crate::app::run::Interrupt;
use crate::live::Inbox;
use crate::recording::Frame;

/// Time between two looks at whether it is requested to stop.
const POLL: Duration = Duration::from_millis(20);

/// Time between two looks at whether the first scan is taken.
const TAKEN: Duration = Duration::from_millis(1);

/// Puts the scans of frames into an inbox at the pace of their times, which begins when the first is taken: a known start is
/// that of this scan. Counts those that cannot be read. A scan is read before its time.
pub fn replay(
    frames: &[Frame],
    rate: f64,
    inbox: &Inbox<ArrivedFrame>,
    unreadable: &AtomicU64,
    interrupt: &Interrupt,
) {
    let ends = || interrupt.requested() || inbox.is_closed();
    let mut began: Option<(Instant, f64)> = None;
    for frame in frames {
        let scan = match frame.read() {
            Ok(scan) => scan,
            Err(error) => {
                if unreadable.fetch_add(1, Ordering::Relaxed) == 0 {
                    tracing::warn!("a scan cannot be read, and is left out: {error}");
                }
                continue;
            }
        };
        let due = began.map(|(start, first_s)| {
            let after_s = ((frame.time_s - first_s) / rate).max(0.0);
            start + Duration::try_from_secs_f64(after_s).unwrap_or(Duration::ZERO)
        });
        while !ends() && due.is_some_and(|due| due > Instant::now()) {
            let left = due.map(|due| due.saturating_duration_since(Instant::now()));
            thread::sleep(left.unwrap_or(POLL).min(POLL));
        }
        if ends() {
            break;
        }
        inbox.push((frame.clone(), scan));
        if began.is_none() {
            while !ends() && !inbox.is_empty() {
                thread::sleep(TAKEN);
            }
            began = Some((Instant::now(), frame.time_s));
        }
    }
    inbox.close();
}
