//! Maps one drive and localizes another in it: `cargo run --release --example pipeline -- DRIVE_1 DRIVE_2`.

#![allow(clippy::print_stdout, reason = "examples print their result")]

use fpmcl::localization::{Tracker, TrackerConfig};
use fpmcl::map::MapConfig;
use fpmcl::mapping::build_map;
use fpmcl::recording::Recording;
use fpmcl::sensor::{Sensor, SensorConfig};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let drive = |number| std::env::args().nth(number).ok_or("give two recordings");
    let map = build_map(&Recording::open(drive(1)?)?, &MapConfig::default())?;
    let second = Recording::open(drive(2)?)?;
    let sensor = Sensor::infer_recording(&second, &SensorConfig::default())?;
    let mut tracker = Tracker::new(&map, TrackerConfig::default())?.with_sensor(sensor);
    for scan in second.scans() {
        let estimate = tracker.step(&scan?)?;
        let (t, state) = (estimate.map_from_lidar.translation, estimate.state.word());
        println!("{:.9} {:.9} {:.9} {state}", t.x, t.y, t.z);
    }
    Ok(())
}
