//! The parts of the fuzzing of readers.

pub mod allocation;
#[cfg(feature = "bags")]
pub mod bags;
pub mod configurations;
pub mod files;
pub mod harness;
pub mod mutation;
pub mod npz;
pub mod ply;
pub mod point_clouds;
