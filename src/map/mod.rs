//! The map: built from scans, kept as a mesh, cut into tiles.

pub mod elevation;
pub mod ply;

pub use elevation::{GroundMap, GroundPatch, Stance};
pub use ply::PlyError;
pub mod tiles;
pub use tiles::{TileConfig, TileGrid, TileIndex};
