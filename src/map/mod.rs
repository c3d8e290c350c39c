//! The map: built from scans, a mesh with its ground and tiles, saved and loaded.
//!
//! > [`MapBuilder`] makes a [`Map`] of scans with poses: [`plan`] divides the drive into local maps,
//! > [`scan_cloud`] prepares each scan, [`visibility`] finds moving points and surfaces that beams pass
//! > through, [`local_map`] meshes and cuts what belongs to it. A [`Map`] knows its [`elevation`],
//! > its [`tiles`], the [`panorama`] of every place, and what renders it.

// From scans to a mesh.
pub mod builder;
pub mod changes;
pub mod cloud;
mod cloud_normals;
pub mod confidence;
pub mod config;
pub mod local_map;
pub mod path_check;
pub mod plan;
pub mod scan_agreement;
pub mod scan_cloud;
mod seam;
mod vertex_ground;
pub mod visibility;
// What a pose in the map needs.
pub mod cells;
pub mod elevation;
mod ground_surface;
mod heights;
pub mod panorama;
mod panorama_file;
mod place_descriptor;
mod scan_panorama;
mod tile_file;
mod tile_store;
pub mod tiles;
// The map as a whole, and its file.
pub mod mapped_ply;
pub mod mapping_path;
mod mesh_error;
pub mod mesh_file;
mod mesh_origin;
mod mesh_polygons;
pub mod mesh_view;
pub mod model;
mod obj;
pub mod ply;
mod stl;

#[cfg(test)]
mod seam_tests;
#[cfg(test)]
pub(crate) mod test_world;

pub use builder::{BuildError, BuildEvent, MapBuilder, MapPlan, ScanError};
pub use cloud::CloudPlan;
pub use config::{MapConfig, MapOptions};
pub use elevation::{GroundMap, GroundPatch, SensorAttitude};
pub use local_map::{LocalMap, LocalMapConfig, LocalMapCounts};
pub use mapping_path::MappingPath;
pub use mesh_error::{MeshFileError, MeshFileProblem};
pub use model::{Map, MapError, surface_of};
pub use panorama::{PanoramaConfig, PanoramaIndex, PanoramaRequest, PanoramaSeed, SearchRegion};
pub use tiles::{TileConfig, TileGrid, TileIndex};
