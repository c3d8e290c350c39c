//! Errors of the surface reconstruction.

use crate::memory::MemoryError;
use crate::validation::InvalidValue;

/// Why a surface cannot be reconstructed.
#[derive(Debug, thiserror::Error, PartialEq)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum MeshingError {
    #[error(
        "only {usable} of {given} points can be meshed, at least {needed} at different positions are needed; \
         check crop box and ranges"
    )]
    TooFewPoints {
        usable: usize,
        given: usize,
        needed: usize,
    },
    #[error(
        "the points extend over {extent_m:.0} m, so that the finest octree cells would be {cell_m:.2} m wide, more than {limit_m} m; raise depth, which is {depth}, at most to 12, or mesh fewer points at a time, or check their poses"
    )]
    CellsTooLarge {
        extent_m: f32,
        cell_m: f32,
        limit_m: f32,
        depth: u32,
    },
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[error(transparent)]
    InvalidValue(#[from] InvalidValue),
}
