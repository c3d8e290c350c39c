//! Refines a trajectory in the map frame, with one TUM row per scan of the recording:
//! `cargo run --release --example refine -- RECORDING MAP.ply TRAJECTORY.txt`.

#![allow(clippy::print_stdout, reason = "examples print their result")]

use std::path::PathBuf;

use fpmcl::geometry::pose2_from_pose3;
use fpmcl::map::{Map, MapOptions};
use fpmcl::recording::{Recording, read_tum};
use fpmcl::refinement::{InitialEstimate, RefinerConfig, TrajectoryRefiner};
use fpmcl::sensor::{Sensor, SensorConfig};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [recording, map_file, trajectory_file] = arguments.as_slice() else {
        return Err("usage: refine RECORDING MAP.ply TRAJECTORY.txt".into());
    };
    let map = Map::load(map_file, &MapOptions::default())?;
    let trajectory = read_tum(trajectory_file)?;
    let recording = Recording::open(recording)?;
    let sensor = Sensor::infer_recording(&recording, &SensorConfig::default())?;
    let mut refiner = TrajectoryRefiner::new(&map, &sensor, RefinerConfig::default(), 0)?;
    let recording = sensor.applied_to(recording);
    for (frame, row) in recording.frames.iter().zip(&trajectory) {
        let estimate = InitialEstimate::tracked(pose2_from_pose3(&row.map_from_lidar));
        refiner.add(&frame.read()?, &estimate)?;
    }
    for (row, pose) in refiner.finish(None)?.poses.iter().enumerate() {
        let t = pose.translation;
        println!("{row}: {:.3} {:.3} {:.4}", t.x, t.y, pose.rotation.angle());
    }
    Ok(())
}
