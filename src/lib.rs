//! Finds a car's pose to the centimetre from one spinning LiDAR and a mesh map that it builds itself.
//!
//! > A [`recording`] sequence gives [`lidar`] scans; [`ground`] tells road from rest; [`meshing`]
//! > turns points into surfaces, [`map`] tiles them; [`rendering`] shows the map from any pose,
//! > [`registration`] lays a scan onto it; [`localization`] finds the pose; [`refinement`]
//! > polishes it; [`evaluation`] measures it; the program around it is `app`.
//!
//! | frame | origin and axes | appears in |
//! |---|---|---|
//! | `lidar` | the sensor; x forward, y left, z up | scans, range images |
//! | `cam0` | left grey camera; x right, y down, z forward | KITTI's `poses.txt`, nowhere else |
//! | `map` | the `lidar` frame of the first mapping scan | map, particles, trajectories |
//!
//! Metres and radians inside; degrees only in configuration files and reports. A transform
//! says both its frames: `p_map = map_from_lidar * p_lidar`.
//!
//! Imports point only upwards in this list, which `tests/architecture.rs` checks.

// What everything is made of.
pub mod files;
pub mod geometry;
pub mod lidar;
pub mod random;
pub mod raycasting;
pub mod rendering;
pub mod validation;
// From a recording to surfaces.
pub mod ground;
pub mod meshing;
pub mod recording;
// From surfaces to a map, and back to what the sensor would see in it.
pub mod map;
pub mod registration;
pub mod simulation;
// Where the car is, and how well that is known.
pub mod evaluation;
pub mod localization;
pub mod refinement;
// The program.
#[cfg(feature = "cli")]
pub mod app;
