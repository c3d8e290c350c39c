//! Source of the motion between frames.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::validation::{InvalidValue, require};

/// Source of the motion between frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OdometrySource {
    /// `odometry_file` or, in a bag, the topic of odometry, if there is one; else the scans.
    #[default]
    Auto,
    /// The scans alone.
    Scans,
    /// `odometry_file`.
    File,
    /// The true poses of the recording with noise, as range-mcl does for demonstration.
    GroundTruth,
    /// None: constant velocity.
    None,
}

impl OdometrySource {
    /// Requires a file for [`OdometrySource::File`], and true poses for [`OdometrySource::GroundTruth`].
    pub(super) fn validate(
        self,
        file: Option<&Path>,
        truth: Option<&Path>,
    ) -> Result<(), InvalidValue> {
        require(
            self != Self::GroundTruth || truth.is_some(),
            "odometry",
            "ground_truth",
            "name the true poses in pose_file, or choose auto",
        )?;
        require(
            self != Self::File || file.is_some(),
            "odometry",
            "file",
            "name the file in odometry_file, or choose auto, scans or none",
        )
    }
}
