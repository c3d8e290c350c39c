//! Maps one drive and localizes another in it: `cargo run --release --example pipeline -- DRIVE_1 DRIVE_2`.

#![allow(clippy::print_stdout, reason = "examples print their result")]

use fpmcl::localization::{Tracker, TrackerConfig};
use fpmcl::map::MapConfig;
use fpmcl::mapping::build_map;
use fpmcl::recording::Recording;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let drives: Vec<String> = std::env::args().skip(1).collect();
    let [first, second] = &drives[..] else {
        return Err("give two recordings".into());
    };
    let map = build_map(&Recording::open(first)?, &MapConfig::default())?;
    let mut tracker = Tracker::new(&map, TrackerConfig::default())?;
    for scan in Recording::open(second)?.scans() {
        let estimate = tracker.step(&scan?)?;
        println!("{} {}", estimate.pose, estimate.state.word());
    }
    Ok(())
}
