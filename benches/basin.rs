//! From how far away single frames come back to their true pose: rate, time and rays of Gauss-Newton, the swarm, both,
//! and the filter.
//!
//! ```text
//! cargo bench --bench basin -- MAP.ply RECORDING      # a recording with poses; its odd frames are placed
//! FPMCL_BASIN_TRIALS=100 cargo bench --bench basin -- MAP.ply RECORDING
//! ```
//!
//! Prints a table and writes its picture, `target/basin.png`. A frame is back if it is within 0.1 m and 0.5 degrees of
//! its pose. Offsets have a distance and a turn of either sign, in a random direction; all methods get the same. A refiner has
//! placed another frame before, which is not counted: it knows the attitude of the sensor and the surfaces of the map.

#![allow(clippy::print_stdout, reason = "the table")]

mod process;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use fpmcl::geometry::{Pose2, Pose3, Vec3, pose2_from_pose3};
use fpmcl::internals::app::{LineChart, Panel, Series};
use fpmcl::internals::{PERIOD_S, compare_timings};
use fpmcl::lidar::{Beam, LidarModel, RangeImage, Scan};
use fpmcl::localization::{Localizer, LocalizerConfig, Odometry, Start, StartSpread};
use fpmcl::map::{Map, MapOptions};
use fpmcl::odometry::OdometryConfig;
use fpmcl::recording::Recording;
use fpmcl::refinement::{
    FrameRefinementConfig, InitialEstimate, Method, RefinerConfig, TrajectoryRefiner,
};
use fpmcl::rendering::{RangeDifference, RangeRenderer, RenderError, SurfaceHit};
use fpmcl::sensor::{Sensor, SensorConfig};
use nalgebra::{Matrix3, Vector2};
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

/// Distances [m] and turns [deg] of the starts.
const OFFSETS: [(f64, f64); 5] = [
    (0.5, 5.0),
    (1.0, 10.0),
    (2.0, 20.0),
    (3.0, 30.0),
    (5.0, 30.0),
];

type Failure = Box<dyn std::error::Error>;

/// What places a frame.
#[derive(Clone, Copy)]
enum Placer {
    Refiner(Method),
    Filter(usize),
}

const PLACERS: [(&str, Placer); 6] = [
    ("Gauss-Newton", Placer::Refiner(Method::GaussNewton)),
    ("swarm", Placer::Refiner(Method::Swarm)),
    ("swarm, Gauss-Newton", Placer::Refiner(Method::Both)),
    ("filter, 100 particles", Placer::Filter(100)),
    ("filter, 300 particles", Placer::Filter(300)),
    ("filter, 1000 particles", Placer::Filter(1000)),
];

fn main() -> Result<(), Failure> {
    let [map_file, recording] = &*process::files() else {
        println!("skipped: give a map and a recording with poses");
        return Ok(());
    };
    let trials: usize = std::env::var("FPMCL_BASIN_TRIALS").map_or(Ok(30), |text| text.parse())?;
    let mut map = Map::load(map_file, &MapOptions::default())?;
    let rays = Arc::new(AtomicUsize::new(0));
    map.renderer = Arc::new(Counting {
        inner: map.renderer.clone(),
        rays: rays.clone(),
    });
    let frames = frames(recording, &map)?;
    let scans: Vec<Scan> = frames
        .iter()
        .take(10)
        .map(|(scan, _)| scan.clone())
        .collect();
    let sensor = Sensor::infer(&scans, &SensorConfig::default())?;
    println!("| method | start | back | time per frame | rays per frame |\n|---|---|---|---|---|");
    let mut curves = vec![];
    for (name, placer) in PLACERS {
        let mut curve = vec![];
        for (distance_m, turn_deg) in OFFSETS {
            // Drawn anew for each method, so that all get the same.
            let mut rng = StdRng::seed_from_u64(1);
            let (mut back, mut time_s) = (0, 0.0);
            rays.store(0, Ordering::Relaxed);
            for trial in 0..trials {
                let number = rng.random_range(0..frames.len());
                let (scan, truth) = &frames[number];
                let direction = rng.random_range(0.0..std::f64::consts::TAU);
                let turn_rad = turn_deg.to_radians() * if rng.random() { 1.0 } else { -1.0 };
                let off = distance_m * Vector2::new(direction.cos(), direction.sin());
                let pose = pose2_from_pose3(truth);
                let start = Pose2::new(
                    pose.translation.vector + off,
                    pose.rotation.angle() + turn_rad,
                );
                let trial = Trial {
                    map: &map,
                    sensor: &sensor,
                    scan,
                    other: &frames[(number + 1) % frames.len()],
                    start,
                    height_m: truth.translation.z,
                    distance_m,
                    turn_rad: turn_rad.abs(),
                    seed: trial as u64,
                };
                let (found, elapsed) = trial.place(placer, &rays)?;
                time_s += elapsed.as_secs_f64();
                let error = pose.inverse() * found;
                let is_near = error.translation.vector.norm() < 0.1;
                back += usize::from(is_near && error.rotation.angle().abs() < 0.5_f64.to_radians());
            }
            let each = trials as f64;
            println!(
                "| {name} | {distance_m} m, {turn_deg} deg | {back} of {trials} | {:.0} ms | {:.0} thousand |",
                1e3 * time_s / each,
                1e-3 * rays.load(Ordering::Relaxed) as f64 / each
            );
            curve.push((distance_m, back as f64 / each));
        }
        curves.push((name, curve));
    }
    draw(&curves)
}

/// The odd frames, compensated by the poses, with their poses in the map.
fn frames(recording: &Path, map: &Map) -> Result<Vec<(Scan, Pose3)>, Failure> {
    const SCANS: usize = 11;
    let recording = Recording::open(recording)?;
    let first: Vec<Scan> = (recording.frames.iter().take(SCANS))
        .map(|frame| frame.read())
        .collect::<Result<_, _>>()?;
    let has_times = first.iter().any(|scan| !scan.times_s.is_empty());
    let timing = compare_timings(&first, PERIOD_S, &OdometryConfig::default())?;
    let best = timing.best.filter(|_| !has_times);
    let timing = best.and_then(|best| timing.residuals_m[best].0);
    let track = recording.own_track()?.in_map(&map.path.world_from_map);
    let recording = recording.timed(timing).with_poses(track)?;
    let odd = recording.compensated_by_poses().frames.into_iter();
    odd.filter(|frame| frame.number % 2 == 1)
        .filter_map(|frame| {
            let pose = frame.map_from_lidar?;
            Some(frame.read().map(|scan| (scan, pose)).map_err(Failure::from))
        })
        .collect()
}

/// A frame to place.
struct Trial<'a> {
    map: &'a Map,
    sensor: &'a Sensor,
    scan: &'a Scan,
    other: &'a (Scan, Pose3),
    start: Pose2,
    height_m: f64,
    distance_m: f64,
    turn_rad: f64,
    seed: u64,
}

impl Trial<'_> {
    /// Places the frame; the pose and the time that it took.
    fn place(&self, placer: Placer, rays: &AtomicUsize) -> Result<(Pose2, Duration), Failure> {
        // The scans are compensated already.
        let compensated = |scan: &Scan| Scan {
            times_s: vec![],
            ..scan.clone()
        };
        let scan = compensated(self.scan);
        match placer {
            Placer::Refiner(method) => {
                let config = RefinerConfig {
                    refinement: FrameRefinementConfig {
                        method,
                        ..FrameRefinementConfig::default()
                    },
                    ..RefinerConfig::default()
                };
                let variance = (0.5 * self.distance_m).powi(2);
                let turn_variance = (0.5 * self.turn_rad).powi(2);
                let variances = [variance, variance, turn_variance];
                let uncertain = |pose| InitialEstimate {
                    covariance: Some(Matrix3::from_diagonal(&variances.into())),
                    ..InitialEstimate::tracked(pose)
                };
                let mut refiner = TrajectoryRefiner::new(self.map, self.sensor, config, self.seed)?;
                let counted = rays.load(Ordering::Relaxed);
                let (other, pose) = self.other;
                refiner.add(&compensated(other), &uncertain(pose2_from_pose3(pose)))?;
                let before = rays.load(Ordering::Relaxed);
                let begin = Instant::now();
                let pose = refiner.add(&scan, &uncertain(self.start))?.pose;
                let elapsed = begin.elapsed();
                rays.fetch_sub(before - counted, Ordering::Relaxed);
                Ok((pose, elapsed))
            }
            Placer::Filter(num_particles) => {
                let spread = StartSpread {
                    position_m: self.distance_m,
                    heading_rad: self.turn_rad,
                    ..StartSpread::default()
                };
                let start = Start::Pose {
                    map_from_lidar: self.start,
                    height_m: Some(self.height_m),
                    spread,
                };
                let config = LocalizerConfig {
                    num_particles,
                    ..LocalizerConfig::default()
                };
                let mut localizer =
                    Localizer::new(self.map, self.sensor, config, start, self.seed)?;
                let begin = Instant::now();
                let pose = localizer.step(&scan, Odometry::Unknown)?.pose;
                Ok((pose, begin.elapsed()))
            }
        }
    }
}

/// Counts the rays of another renderer.
struct Counting {
    inner: Arc<dyn RangeRenderer>,
    rays: Arc<AtomicUsize>,
}

impl Counting {
    fn count(&self, rays: usize) {
        self.rays.fetch_add(rays, Ordering::Relaxed);
    }
}

impl RangeRenderer for Counting {
    fn name(&self) -> String {
        self.inner.name()
    }

    fn render(&self, poses: &[Pose3], model: &LidarModel) -> Result<Vec<Vec<f32>>, RenderError> {
        self.count(poses.len() * model.width * model.height);
        self.inner.render(poses, model)
    }

    fn cast(
        &self,
        poses: &[Pose3],
        directions: &[Vec3],
        until_m: f32,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        self.count(poses.len() * directions.len());
        self.inner.cast(poses, directions, until_m)
    }

    fn cast_signed(
        &self,
        pose: &Pose3,
        directions: &[Vec3],
        until_m: f32,
    ) -> Result<Vec<f32>, RenderError> {
        self.count(directions.len());
        self.inner.cast_signed(pose, directions, until_m)
    }

    fn surfaces(
        &self,
        pose: &Pose3,
        beams: &[Beam],
        within_m: f32,
    ) -> Result<Vec<Option<SurfaceHit>>, RenderError> {
        self.count(beams.len());
        self.inner.surfaces(pose, beams, within_m)
    }

    fn compare(
        &self,
        poses: &[Pose3],
        beams: &[Beam],
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        self.count(poses.len() * beams.len());
        self.inner.compare(poses, beams, difference)
    }

    fn compare_images(
        &self,
        poses: &[Pose3],
        measured: &RangeImage,
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        self.count(poses.len() * measured.ranges.len());
        self.inner.compare_images(poses, measured, difference)
    }
}

/// Draws the rates against the distances.
fn draw(curves: &[(&str, Vec<(f64, f64)>)]) -> Result<(), Failure> {
    const COLORS: [[u8; 3]; 6] = [
        [0, 114, 178],
        [230, 159, 0],
        [213, 94, 0],
        [170, 170, 170],
        [110, 110, 110],
        [30, 30, 30],
    ];
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/basin.png");
    let series = (curves.iter().zip(COLORS))
        .map(|((name, curve), color)| Series::line(name, color, curve.iter().copied()));
    let chart = LineChart {
        title: "Single frames that come back to their pose".to_owned(),
        x_name: "distance of the start [m]".to_owned(),
        panels: vec![Panel {
            y_name: "share".to_owned(),
            series: series.collect(),
            ..Panel::default()
        }],
        ..LineChart::default()
    };
    chart.save(&path)?;
    println!("\n{}", path.display());
    Ok(())
}
