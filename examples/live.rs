//! Localizes the scans of a recording as a robot receives them: one thread receives, one computes, and what comes too fast is
//! dropped. A node of one's own puts the scans of its driver into the inbox instead.
//!
//! `cargo run --release --example live -- RECORDING MAP.ply`.

#![allow(clippy::print_stdout, reason = "examples print their result")]

use std::path::PathBuf;
use std::thread;
use std::time::Duration;

use fpmcl::live::{Inbox, Latencies, Monitor, Received};
use fpmcl::localization::{Tracker, TrackerConfig};
use fpmcl::map::{Map, MapOptions};
use fpmcl::recording::Recording;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [recording, map_file] = arguments.as_slice() else {
        return Err("usage: live RECORDING MAP.ply".into());
    };
    let map = Map::load(map_file, &MapOptions::default())?;
    let recording = Recording::open(recording)?;
    let config = TrackerConfig::default();
    let mut monitor = Monitor::new(&config.localizer);
    let mut tracker = Tracker::new(&map, config)?.in_real_time();
    let (inbox, mut latencies) = (Inbox::new(1), Latencies::default());
    thread::scope(|scope| {
        scope.spawn(|| {
            for scan in recording.scans().flatten() {
                inbox.push(scan);
                thread::sleep(Duration::from_millis(100));
            }
            inbox.close();
        });
        while let Received::Scan(arrival) = inbox.take(Duration::from_secs(10)) {
            // Of the scans; a node with wheels passes theirs.
            let odometry = tracker.measure(&arrival.scan)?;
            let estimate = tracker.step_with_motion(&arrival.scan, odometry)?;
            monitor.update(&estimate, &odometry.in_space().unwrap_or_default());
            latencies.add(arrival.arrived.elapsed());
            let (state, reason) = (monitor.state().word(), monitor.reason().words());
            let map_from_odom = monitor.map_from_odom().map(|it| it.translation);
            println!("{state}: {reason}; map_from_odom: {map_from_odom:.2?}");
        }
        Ok::<_, Box<dyn std::error::Error>>(())
    })?;
    println!(
        "{} scans, {} dropped, p99 {:.0?}",
        inbox.received(),
        inbox.dropped(),
        latencies.percentile(0.99).unwrap_or_default()
    );
    Ok(())
}
