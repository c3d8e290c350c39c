//! Localizes a recording in a map without an initial pose, odometry or a known sensor. A robot has no recording yet: the
//! tracker then infers the sensor from the first scans.
//!
//! `cargo run --release --example localize -- RECORDING MAP.ply TRAJECTORY.txt`.

#![allow(clippy::print_stdout, reason = "examples print their result")]

use std::path::PathBuf;

use fpmcl::localization::{State, Tracker, TrackerConfig};
use fpmcl::map::{Map, MapOptions};
use fpmcl::recording::{Recording, write_tum};
use fpmcl::sensor::{Sensor, SensorConfig};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [recording, map_file, trajectory_file] = arguments.as_slice() else {
        return Err("usage: localize RECORDING MAP.ply TRAJECTORY.txt".into());
    };
    let map = Map::load(map_file, &MapOptions::default())?;
    let recording = Recording::open(recording)?;
    let sensor = Sensor::infer_recording(&recording, &SensorConfig::default())?;
    let mut tracker = Tracker::new(&map, TrackerConfig::default())?.with_sensor(sensor);
    let mut trajectory = Vec::new();
    for frame in &recording.frames {
        let estimate = tracker.step(&frame.read()?)?;
        let (t, deviations) = (estimate.pose.translation, estimate.standard_deviations());
        let state = estimate.state.word();
        println!(
            "{}: {:.2} {:.2} +- {:.3?} {state}",
            frame.number, t.x, t.y, deviations
        );
        // Poses while the filter searches are not to be used.
        if estimate.state == State::Tracking {
            trajectory.push(frame.stamped(estimate.map_from_lidar));
        }
    }
    write_tum(std::fs::File::create(trajectory_file)?, &trajectory)?;
    Ok(())
}
