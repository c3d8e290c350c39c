//! Sensors by their names, with the elevations that their makers publish.

use super::Sensor;
use crate::lidar::LidarModel;

/// Range up to which surfaces are rendered [m].
const MAX_RANGE_M: f32 = 50.0;

impl Sensor {
    /// Velodyne HDL-64E: an upper block of 32 beams from +2 degrees down in steps of 1/3 degree, a lower one from
    /// -8.83 degrees in steps of 1/2 degree; HDL-64E S3 user's manual, 63-HDL64ES3 rev. J.
    pub fn hdl64e() -> Self {
        let upper = (0..32).map(|row| 2.0 - row as f32 / 3.0);
        let lower = (0..32).map(|row| -8.83 - row as f32 / 2.0);
        Self::new(LidarModel {
            elevations: Some(upper.chain(lower).collect()),
            ..even([2.0, -24.33], 64, 2048, 0.9)
        })
    }

    /// Velodyne HDL-32E: 32 beams from +10.67 to -30.67 degrees; user's manual, 63-9113.
    pub fn hdl32e() -> Self {
        Self::new(even([10.67, -30.67], 32, 2048, 1.0))
    }

    /// Velodyne VLP-16: 16 beams from +15 to -15 degrees, steps of 0.2 degrees at 10 Hz; user manual, 63-9243.
    pub fn vlp16() -> Self {
        Self::new(even([15.0, -15.0], 16, 1800, 0.5))
    }

    /// Ouster OS1-64: 64 beams from +22.5 to -22.5 degrees, 1024 columns; OS1 datasheet, revision 6.
    pub fn os1_64() -> Self {
        Self::new(even([22.5, -22.5], 64, 1024, 0.5))
    }
}

/// Evenly spaced beams between two elevations [deg].
fn even([top, bottom]: [f32; 2], beams: usize, columns: usize, min_range: f32) -> LidarModel {
    let half_step = 0.5 * (top - bottom) / (beams - 1) as f32;
    LidarModel {
        height: beams,
        width: columns,
        fov_up: top + half_step,
        fov_down: bottom - half_step,
        max_range: MAX_RANGE_M,
        min_range,
        elevations: None,
    }
}
