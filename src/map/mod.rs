//! The map: built from scans, kept as a mesh, cut into tiles.

pub mod confidence;
pub mod elevation;
mod heights;
pub mod local_map;
pub mod plan;
pub mod ply;
pub mod quality;
pub mod scan_cloud;
mod seam;
mod surface_distance;
pub mod tiles;
pub mod truth;
mod vertex_ground;
pub mod visibility;

#[cfg(test)]
mod seam_tests;

pub use elevation::{GroundMap, GroundPatch, Stance};
pub use local_map::{LocalMapCounts, LocalMapError, LocalMapSettings};
pub use ply::PlyError;
pub use quality::MapQuality;
pub use tiles::{TileConfig, TileGrid, TileIndex};
pub use truth::TruthAgreement;
