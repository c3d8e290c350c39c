//! Source of the motion between frames.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::validation::{InvalidValue, require};

/// Source of the motion between frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OdometrySource {
    /// The poses of the recording with noise, as range-mcl does for demonstration.
    #[default]
    GroundTruth,
    /// `odometry_file`.
    File,
    /// None: constant velocity.
    None,
}

impl OdometrySource {
    /// Requires a file for [`OdometrySource::File`].
    pub(super) fn validate(self, file: Option<&Path>) -> Result<(), InvalidValue> {
        require(
            self != Self::File || file.is_some(),
            "odometry",
            "file",
            "name the file in odometry_file, or choose ground_truth or none",
        )
    }
}
