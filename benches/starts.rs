//! Starts anywhere on the road of a map, and the drive on from each: success, errors, time and memory.
//!
//! ```text
//! cargo bench --bench starts -- MAP.ply RECORDING...      # recordings with poses in the frame of the map
//! FPMCL_STARTS=200 FPMCL_SCANS=20 cargo bench --bench starts -- MAP.ply RECORDING...
//! ```
//!
//! At `FPMCL_STARTS` (50) scans, evenly chosen, a filter without an initial pose is started, and driven on for
//! `FPMCL_SCANS` (1) scans in all by the motion between the poses of the recording. Prints the time to open the map, that of
//! the first start, which makes or opens the panoramas, and of the others, the share whose first estimate is within half a
//! metre and a degree, the memory of the process after each step, and of all scans those that are called tracking: how many
//! are more than half a metre off, and how many others are right but not called so.

#![allow(clippy::print_stdout, reason = "the table")]

mod process;

use std::time::Instant;

use fpmcl::geometry::{Pose2, Pose3, pose2_from_pose3};
use fpmcl::localization::{Estimate, Localizer, LocalizerConfig, Odometry, Start, State};
use fpmcl::map::{Map, MapCache, MapOptions};
use fpmcl::recording::Recording;
use fpmcl::sensor::{Sensor, SensorConfig};

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let [map_file, recordings @ ..] = &*process::files() else {
        println!("skipped: give a map and recordings with poses");
        return Ok(());
    };
    let [most, scans_each] = [("FPMCL_STARTS", 50), ("FPMCL_SCANS", 1)].map(|(name, default)| {
        std::env::var(name).map_or(Ok(default), |text| text.parse::<usize>())
    });
    let (most, scans_each) = (most?, scans_each?);
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
    let mut drives = Drives::default();
    let some = scans[..scans.len().min(10)].iter();
    let some = some
        .map(|(frame, _)| frame.read())
        .collect::<Result<Vec<_>, _>>()?;
    let sensor = Sensor::infer(&some, &SensorConfig::default())?;
    let config = LocalizerConfig {
        num_particles: 10_000,
        ..LocalizerConfig::default()
    };
    for (number, start) in (0..scans.len()).step_by(step).enumerate() {
        let (frame, truth) = &scans[start];
        let scan = frame.read()?;
        let begin = Instant::now();
        let mut localizer =
            Localizer::new(&map, &sensor, config.clone(), Start::Road, number as u64)?;
        let first = localizer.step(&scan, Odometry::Unknown)?;
        let pose = first.pose;
        let time_s = begin.elapsed().as_secs_f64();
        let [off_m, turn_deg] = off(&pose, truth);
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
        drives.add(number, &first, truth);
        let end = scans.len().min(start + scans_each);
        for pair in scans[start..end].windows(2) {
            let [(_, before), (frame, truth)] = pair else {
                continue;
            };
            let motion = Odometry::Motion(before.inverse() * truth);
            let estimate = localizer.step(&frame.read()?, motion)?;
            drives.add(number, &estimate, truth);
        }
    }
    times_s.sort_by(f64::total_cmp);
    println!(
        "{found} of {all} found; time of the others: median {:.2} s, longest {:.2} s; {}",
        times_s.get(times_s.len() / 2).unwrap_or(&0.0),
        times_s.last().unwrap_or(&0.0),
        memory()
    );
    println!("{drives:?}");
    Ok(())
}

/// What became of the scans of all drives.
#[derive(Debug, Default)]
struct Drives {
    scans: usize,
    /// Called tracking.
    tracking: usize,
    /// Called tracking, and more than half a metre off.
    tracking_wrong: usize,
    /// Less than half a metre off, and not called tracking.
    right_not_tracking: usize,
    /// Largest error of those called tracking [m].
    worst_tracking_m: f64,
}

impl Drives {
    fn add(&mut self, start: usize, estimate: &Estimate, truth: &Pose3) {
        const WRONG_M: f64 = 0.5;
        // In space: the storey counts.
        let shift_m = estimate.map_from_lidar.translation.vector - truth.translation.vector;
        let (off_m, is_tracking) = (shift_m.norm(), estimate.state == State::Tracking);
        self.scans += 1;
        self.tracking += usize::from(is_tracking);
        self.right_not_tracking += usize::from(!is_tracking && off_m < WRONG_M);
        if is_tracking {
            self.worst_tracking_m = self.worst_tracking_m.max(off_m);
            if off_m >= WRONG_M {
                self.tracking_wrong += 1;
                println!("start {start}: tracking {off_m:.2} m off");
            }
        }
    }
}

/// How far a pose is from the true one [m, deg].
fn off(pose: &Pose2, truth: &Pose3) -> [f64; 2] {
    let error = pose2_from_pose3(truth).inverse() * pose;
    let turn_deg = error.rotation.angle().to_degrees().abs();
    [error.translation.vector.norm(), turn_deg]
}

/// Memory of the process now and at most.
fn memory() -> String {
    let [now, most] = ["VmRSS", "VmHWM"].map(process::memory_mib);
    format!("{now} MiB of memory, at most {most}")
}
