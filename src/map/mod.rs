//! The map: built from scans, kept as a mesh, cut into tiles.

pub mod elevation;

pub use elevation::{GroundMap, GroundPatch, Stance};
