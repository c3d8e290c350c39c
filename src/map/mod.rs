//! The map: built from scans, a mesh with its ground and tiles, saved and loaded.
//!
//! > [`MapBuilder`] makes a [`Map`] of scans with poses. A [`Map`] is a mesh, read and written by `files`, divided
//! > into `tiles` that are loaded where the car is; it knows its `ground`, the `places` where a car may be, and
//! > what renders it.

pub(crate) mod build;
pub(crate) mod files;
pub(crate) mod ground;
pub(crate) mod mesh_view;
pub(crate) mod model;
pub(crate) mod places;
pub(crate) mod tiles;
mod unit;

#[cfg(test)]
pub(crate) mod gaussian_for_tests;
#[cfg(test)]
pub(crate) mod world_for_tests;

pub use crate::raycasting::{TileError, TileProblem};
pub use build::builder::{BuildError, BuildEvent, MapBuilder, MapPlan, ScanError};
pub use build::config::{MapConfig, MapOptions, PoseSource};
pub use build::local_map::{LocalMap, LocalMapConfig, LocalMapCounts};
pub use build::path_check::ImplausiblePath;
pub use build::plan::LocalMapPlan;
pub use build::scan_cloud::PointCounts;
pub use build::visibility::VisibilityConfig;
pub use files::mapping_path::{BadPathComment, MappingPath};
pub use files::mesh_error::{MeshFileError, MeshFileProblem};
pub use ground::elevation::{GroundMap, GroundPatch, SensorAttitude};
pub use model::{Map, MapError};
pub use places::panorama::{PanoramaConfig, SearchRegion};
pub use tiles::cache::MapCache;
pub use tiles::grid::{TileConfig, TileGrid, TileIndex};

pub(crate) use build::cloud::CloudPlan;
pub(crate) use ground::heights::LEVEL_GAP_M;
pub(crate) use model::surface_of;
pub(crate) use places::panorama::{PanoramaIndex, PanoramaRequest, PanoramaSeed};
pub(crate) use unit::unit_doubt;
