//! Finds a car's pose to the centimetre from one LiDAR and a mesh map that it builds itself.
//!
//! # Entry points
//!
//! | type | from | to |
//! |---|---|---|
//! | [`mapping::build_map`] | a recording, or scans in memory, with or without poses | a [`map::Map`] |
//! | [`odometry::TrajectoryBuilder`] | scans of a drive | their poses: odometry, loops, adjustment |
//! | [`map::MapBuilder`] | deskewed scans with their poses | a [`map::Map`] |
//! | [`map::Map`] | a PLY file | mesh, ground, tiles and renderer; [`save`](map::Map::save) writes it |
//! | [`localization::Tracker`] | a map, then scan by scan, of any sensor | an [`Estimate`](localization::Estimate): pose, covariance, state |
//! | [`refinement::TrajectoryRefiner`] | a map, scans, estimates | a refined, smoothed trajectory |
//!
//! ```no_run
//! use std::path::Path;
//!
//! use fpmcl::localization::{Tracker, TrackerConfig};
//! use fpmcl::map::{Map, MapConfig, MapOptions};
//! use fpmcl::mapping::build_map;
//! use fpmcl::recording::Recording;
//! use fpmcl::refinement::{InitialEstimate, RefinerConfig, TrajectoryRefiner};
//! use fpmcl::sensor::{Sensor, SensorConfig};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let map = build_map(&Recording::open("data/street/drive_1")?, &MapConfig::default())?;
//! map.save(Path::new("results/map.ply"))?;
//!
//! let map = Map::load(Path::new("results/map.ply"), &MapOptions::default())?;
//! let second_drive = Recording::open("data/street/drive_2")?;
//! let sensor = Sensor::infer_recording(&second_drive, &SensorConfig::default())?;
//! // The refiner takes scans whose points have times; a tracker sees to this itself.
//! let second_drive = sensor.applied_to(second_drive);
//! let mut refiner = TrajectoryRefiner::new(&map, &sensor, RefinerConfig::default(), 0)?;
//! // A robot gives its scans as they come, without `with_sensor`: the sensor is inferred from the first ones.
//! let mut tracker = Tracker::new(&map, TrackerConfig::default())?.with_sensor(sensor);
//! for scan in second_drive.scans() {
//!     let scan = scan?;
//!     let estimate = tracker.step(&scan)?;
//!     println!("{} ± {:?}", estimate.pose, estimate.standard_deviations());
//!     refiner.add(&scan, &InitialEstimate::from(&estimate))?;
//! }
//! let trajectory = refiner.finish(None)?;
//! println!("{} refined poses", trajectory.poses.len());
//! # Ok(())
//! # }
//! ```
//!
//! Everything random follows from the seed, at any number of threads. Configurations are plain structs
//! whose [`Default`] holds the published values.
//!
//! # Frames
//!
//! | frame | origin and axes | appears in |
//! |---|---|---|
//! | `lidar` | the sensor; z up, and x forward, y left in KITTI's scans | scans, range images |
//! | `map` | the `lidar` frame of the first pose of the recording, turned upright where an inertial sensor is given, or that of the poses given to [`map::MapBuilder`] | map, particles, trajectories |
//! | `cam0` | left grey camera; x right, y down, z forward | KITTI's pose files, nowhere else |
//! | `body` | what the poses of a recording are poses of, if not the lidar or a camera | [`recording`] |
//! | `world` | that of the poses of a recording | [`recording`], to compare drives of one place |
//!
//! The name of a transform contains both of its frames: `p_map = map_from_lidar * p_lidar`.
//!
//! # Units
//!
//! Metres, radians and seconds; names of bare numbers end in their unit (`max_range_m`). Degrees occur
//! in configuration files and reports, and in the field of view of [`lidar::LidarModel`], which has the
//! keys of range-mcl.
//!
//! # Layers
//!
//! The modules below are in layers. A module imports modules of the layers above its own, and none of
//! its own layer or of those below it; `tests/commands/architecture.rs` checks this.
//!
//! | layer | modules |
//! |---|---|
//! | foundations | [`file_path`], `files`, [`geometry`], [`memory`], `random`, `shared_bytes`, `simd`, `statistics`, [`validation`] |
//! | configurations as texts, with a feature | `configuration` |
//! | inertial sensor | [`inertial`] |
//! | sensor, rays and Earth | [`georeference`], [`lidar`], `raycasting` |
//! | scans, points and meshes | [`ground`], [`meshing`], [`recording`], [`rendering`] |
//! | motion | [`odometry`] |
//! | inferred sensor | [`sensor`] |
//! | map | [`map`], [`registration`], `simulation` (with its feature) |
//! | poses | [`evaluation`], [`localization`] |
//! | trajectories | [`live`], [`mapping`], [`refinement`] |
//! | program, feature `cli` | `app` |
//!
//! `docs/architecture.md` describes how a scan and a configuration key pass through them.

#![allow(
    rustdoc::broken_intra_doc_links,
    reason = "units in brackets, such as [m], are no links"
)]
#![cfg_attr(
    not(all(feature = "cli", feature = "gpu", feature = "bags")),
    allow(
        dead_code,
        unused_imports,
        reason = "what only the program, the graphics card or bags use is dead without them"
    )
)]

// Foundations.
pub mod file_path;
mod files;
pub mod geometry;
pub mod memory;
mod random;
mod shared_bytes;
mod simd;
mod statistics;
pub mod validation;
// Configurations as texts.
#[cfg(feature = "configuration")]
pub mod configuration;
// Inertial sensor.
pub mod inertial;
// Sensor, rays and Earth.
pub mod georeference;
pub mod lidar;
mod raycasting;
// Scans, points and meshes.
pub mod ground;
pub mod meshing;
pub mod recording;
pub mod rendering;
// Motion.
pub mod odometry;
// Inferred sensor.
pub mod sensor;
// Map.
pub mod map;
pub mod registration;
#[cfg(feature = "simulation")]
pub mod simulation;
// Poses.
pub mod evaluation;
pub mod localization;
// Trajectories.
pub mod live;
pub mod mapping;
pub mod refinement;
// Program.
#[cfg(feature = "cli")]
mod app;
#[cfg(feature = "cli")]
pub use app::{main, main_of_library};

#[cfg(test)]
pub(crate) mod skips_for_tests;

/// What the tests and benches of this repository use beyond the library's interface; it changes without notice.
#[doc(hidden)]
pub mod internals {
    pub use crate::geometry::pose::{FARTHEST_M, Rigid3f};
    pub use crate::geometry::surface_samples::surface_area_m2;
    pub use crate::lidar::deskewing::PERIOD_S;
    pub use crate::lidar::spatial_normals::estimate_spatial_normals;
    pub use crate::map::files::mapped_ply::MappedPly;
    pub use crate::odometry::timing::compare_timings;
    pub use crate::random::stream;
    pub use crate::raycasting::Scene;
    pub use crate::recording::poses::CameraPoses;
    pub use crate::rendering::cpu::CpuRenderer;
    #[cfg(feature = "gpu")]
    pub use crate::rendering::gpu::{GpuRenderer, ImageMethod};

    #[cfg(feature = "cli")]
    pub mod app {
        pub use crate::app::cli::{Cli, Command};
        pub use crate::app::comparison::ComparisonConfig;
        pub use crate::app::report::plotting::{Bitmap, LineChart, Panel, Series, color};
        pub use crate::app::report::results::LocalizationResults;
        pub use crate::app::schemas::schemas;
        pub use crate::app::settings;
    }

    pub mod mesh_file {
        pub use crate::map::files::mesh_file::read;
    }

    pub mod ply {
        pub use crate::map::files::ply::{read, read_map, write, write_joined};
    }

    #[cfg(feature = "ros2")]
    pub mod received {
        pub use crate::recording::bags::received::{
            ReceivedCloud, read_odometry, read_pose_with_deviations, read_transforms,
        };
    }

    pub mod scan_files {
        pub use crate::recording::scan_files::{is_scan, read, read_stamped};
    }
}
