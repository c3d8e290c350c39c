//! Errors of the surface reconstruction.

use crate::validation::InvalidValue;

/// Why a surface cannot be reconstructed.
#[derive(Debug, thiserror::Error, PartialEq)]
#[expect(missing_docs, reason = "the messages say it")]
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
    #[error("{weights} weights were given for {points} points; give one per point")]
    WeightsDoNotMatch { points: usize, weights: usize },
    #[error(transparent)]
    InvalidValue(#[from] InvalidValue),
}
