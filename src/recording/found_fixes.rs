//! Fixes as a source has them, on their way to those of a drive.

use std::path::Path;

use super::error::RecordingError;
use crate::georeference::{GeodeticFix, GeodeticFixes, HeightReference};

/// Fixes as they are in a source, before they are checked.
#[derive(Debug, Default)]
pub struct FoundFixes {
    /// The fixes, in any order.
    pub fixes: Vec<GeodeticFix>,
    /// Whether heights are above mean sea level.
    pub is_above_sea: bool,
    /// Messages without a position.
    pub without_position: usize,
    /// Lines that could not be read.
    pub bad_lines: usize,
    /// Position of the antenna in the lidar frame [m].
    pub antenna_m: Option<[f64; 3]>,
}

impl FoundFixes {
    /// The fixes of a file or a topic, by time; an error without any.
    pub fn checked(mut self, path: &Path) -> Result<GeodeticFixes, RecordingError> {
        if self.fixes.is_empty() {
            return Err(RecordingError::NoFixes {
                path: path.to_owned(),
                without_position: self.without_position,
                bad_lines: self.bad_lines,
            });
        }
        self.fixes.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        self.fixes.dedup_by_key(|fix| fix.time_s);
        Ok(GeodeticFixes {
            path: path.to_owned(),
            fixes: self.fixes,
            height_above: if self.is_above_sea {
                HeightReference::MeanSeaLevel
            } else {
                HeightReference::Ellipsoid
            },
            without_position: self.without_position,
            bad_lines: self.bad_lines,
            antenna_m: self.antenna_m,
        })
    }
}

/// Whether numbers are a position on the Earth [deg, m].
pub fn is_position(latitude_deg: f64, longitude_deg: f64, height_m: f64) -> bool {
    /// Largest height [m].
    const HIGHEST_M: f64 = 1e5;
    latitude_deg.abs() <= 90.0 && longitude_deg.abs() <= 180.0 && height_m.abs() <= HIGHEST_M
}
