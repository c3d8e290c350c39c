//! Starts anywhere on the road of a map: success, time and memory.
//!
//! ```text
//! cargo bench --bench starts -- MAP.ply RECORDING...      # recordings with poses in the frame of the map
//! FPMCL_STARTS=50 cargo bench --bench starts -- MAP.ply RECORDING...
//! ```
//!
//! Of each scan, a filter without an initial pose is started, and the estimate of its first frame compared with the
//! pose of the recording. Prints the time to open the map, that of the first start, which makes or opens the panoramas,
//! and of the others, the share that is within half a metre and a degree, and the memory of the process after each step.

#![allow(clippy::print_stdout, reason = "the table")]

mod process;

use std::time::Instant;

use fpmcl::geometry::pose2_from_pose3;
use fpmcl::localization::{Localizer, LocalizerConfig, Odometry, Start};
use fpmcl::map::{Map, MapCache, MapOptions};
use fpmcl::recording::Recording;
use fpmcl::sensor::{Sensor, SensorConfig};

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let [map_file, recordings @ ..] = &*process::files() else {
        println!("skipped: give a map and recordings with poses");
        return Ok(());
    };
    let most: usize = std::env::var("FPMCL_STARTS").map_or(Ok(50), |text| text.parse())?;
    let begin = Instant::now();
    let options = MapOptions {
        cache: MapCache::NextToMap,
        ..MapOptions::default()
    };
    let map = Map::load(map_file, &options)?;
    println!(
        "{} triangles in {} tiles, {:.1} km of road; opened in {:.2} s, {}",
        map.triangle_count(),
        map.tiles.len(),
        1e-3 * map.path.map_from_lidar.len() as f64,
        begin.elapsed().as_secs_f64(),
        memory()
    );
    let mut scans = vec![];
    for recording in recordings {
        let recording = Recording::open(recording)?;
        let track = recording.own_track()?.in_map(&map.path.world_from_map);
        for frame in recording.with_poses(track)?.frames {
            let pose = frame.map_from_lidar.ok_or("a frame without a pose")?;
            scans.push((frame, pose));
        }
    }
    let step = scans.len().div_ceil(most).max(1);
    let (mut times_s, mut found, mut all) = (vec![], 0, 0);
    let some = scans[..scans.len().min(10)].iter();
    let some = some
        .map(|(frame, _)| frame.read())
        .collect::<Result<Vec<_>, _>>()?;
    let sensor = Sensor::infer(&some, &SensorConfig::default())?;
    let config = LocalizerConfig {
        num_particles: 10_000,
        ..LocalizerConfig::default()
    };
    for (number, (frame, truth)) in scans.iter().step_by(step).enumerate() {
        let scan = frame.read()?;
        let begin = Instant::now();
        let mut localizer =
            Localizer::new(&map, &sensor, config.clone(), Start::Road, number as u64)?;
        let pose = localizer.step(&scan, Odometry::Unknown)?.pose;
        let time_s = begin.elapsed().as_secs_f64();
        let error = pose2_from_pose3(truth).inverse() * pose;
        let (off_m, turn_deg) = (
            error.translation.vector.norm(),
            error.rotation.angle().to_degrees().abs(),
        );
        let is_found = off_m < 0.5 && turn_deg < 1.0;
        if number == 0 {
            println!("first start {time_s:.2} s, {}", memory());
        } else {
            times_s.push(time_s);
        }
        if !is_found {
            println!("start {number}: {off_m:.2} m, {turn_deg:.1} deg off");
        }
        found += usize::from(is_found);
        all += 1;
    }
    times_s.sort_by(f64::total_cmp);
    println!(
        "{found} of {all} found; time of the others: median {:.2} s, longest {:.2} s; {}",
        times_s.get(times_s.len() / 2).unwrap_or(&0.0),
        times_s.last().unwrap_or(&0.0),
        memory()
    );
    Ok(())
}

/// Memory of the process now and at most.
fn memory() -> String {
    let [now, most] = ["VmRSS", "VmHWM"].map(process::memory_mib);
    format!("{now} MiB of memory, at most {most}")
}
