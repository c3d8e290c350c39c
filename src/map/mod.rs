//! The map: built from scans, kept as a mesh, cut into tiles.

pub mod elevation;
pub mod tiles;

pub use elevation::{GroundMap, GroundPatch, Stance};
pub use tiles::{TileConfig, TileGrid, TileIndex};
