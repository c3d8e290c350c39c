//! Fixes of a GNSS receiver.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::earth::Geodetic;

/// A position that a receiver has found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GeodeticFix {
    /// When it was measured, by the clock of the scans [s].
    pub time_s: f64,
    /// Position of the antenna.
    pub position: Geodetic,
    /// Standard deviation along each horizontal axis, where the receiver gives it [m].
    pub horizontal_m: Option<f64>,
    /// The same of the height.
    pub vertical_m: Option<f64>,
}

/// What heights are above.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum HeightReference {
    /// The ellipsoid of WGS84.
    #[default]
    Ellipsoid,
    /// The mean sea level of the receiver's geoid.
    MeanSeaLevel,
}

impl HeightReference {
    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ellipsoid => "the ellipsoid of WGS84",
            Self::MeanSeaLevel => "mean sea level",
        }
    }
}

/// The fixes of a drive.
#[derive(Clone, Debug, PartialEq)]
pub struct GeodeticFixes {
    /// Their file, or their topic.
    pub path: PathBuf,
    /// The fixes, by time; at least one.
    pub fixes: Vec<GeodeticFix>,
    /// What their heights are above.
    pub height_above: HeightReference,
    /// Messages of a receiver without a position.
    pub without_position: usize,
    /// Lines of a file that could not be read.
    pub bad_lines: usize,
    /// Position of the antenna in the lidar frame, where the recording has it [m].
    pub antenna_m: Option<[f64; 3]>,
}

impl GeodeticFixes {
    /// The fix nearest to a moment, within a time of it [s].
    pub fn near(&self, time_s: f64, within_s: f64) -> Option<GeodeticFix> {
        let near = |fix: &&GeodeticFix| (fix.time_s - time_s).abs() <= within_s;
        let distance = |fix: &GeodeticFix| (fix.time_s - time_s).abs();
        let near = self.fixes.iter().filter(near);
        near.min_by(|a, b| distance(a).total_cmp(&distance(b)))
            .copied()
    }
}
