//! What a sensor is: given, or inferred from a few of its scans.
//!
//! | question | answer from |
//! |---|---|
//! | `beams` and their elevations | the rings of the points, else revolutions in the order of the points, else peaks of the elevations |
//! | `columns`, field of view | differences of azimuth along a beam, empty azimuths |
//! | `rotation` and period | azimuth against time; times of scans |
//! | `own_car` | near returns above the ground that stay while everything else moves |
//! | `mounting` | ground segmentation and ground plane, per scan |
//! | `projection` | the above; limits of range from the ranges |
//!
//! `dropped` counts which points a projection loses, and why. Two returns of one pulse are two points of
//! one direction: they count once for beams and columns, and a range image keeps the nearer one.

mod beam;
pub(crate) mod beams;
pub(crate) mod columns;
mod config;
pub(crate) mod dropped;
mod elevations;
pub(crate) mod inference;
pub(crate) mod mounting;
mod named;
pub(crate) mod own_car;
pub(crate) mod projection;
mod raw;
pub(crate) mod rotation;
mod units;

use std::fmt;

use serde::{Deserialize, Serialize};

pub use beams::BeamSource;
pub use config::{MotionCompensation, SensorConfig};
pub use dropped::{DropReason, DroppedPoints};
pub use inference::SensorError;
pub use mounting::Mounting;

pub(crate) use inference::{SENSOR_SCANS, TIMING_SCANS, spread_scans};

use crate::lidar::{LidarModel, RotationDirection};
use crate::validation::{InvalidValue, Validate, nested, positive, rectangle};

/// What a sensor is, and how its scans are used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Sensor {
    /// Projection: rows are the beams that returned, or pixels of about the spacing of the points if there
    /// are no rows.
    #[serde(with = "units")]
    #[cfg_attr(feature = "configuration", schemars(with = "units::RangeImageInUnits"))]
    pub range_image: LidarModel,
    /// Whether each beam keeps its elevation, as those of spinning sensors do.
    pub has_rows: bool,
    /// Number of beams of the device, which may have more than returned; `None` without rows.
    pub beams: Option<usize>,
    /// What the beams follow from.
    pub beam_source: BeamSource,
    /// Azimuth steps per revolution; 0 without rows.
    pub columns: usize,
    /// Horizontal field of view [deg].
    pub horizontal_fov_deg: f32,
    /// Height over ground and tilt; `None` where too little ground is visible.
    pub mounting: Option<Mounting>,
    /// Given height above the ground [m]; `None`: measured in each scan.
    pub sensor_height_m: Option<f64>,
    /// Rectangle of the lidar frame with returns of the own car, which are dropped: x_min, x_max, y_min, y_max [m];
    /// all 0 if there are none.
    pub own_car_m: [f32; 4],
    /// Whether the scans show that the sensor moves, without which they do not show its own car.
    pub is_moving: bool,
    /// Duration of a revolution or frame [s]; `None` if no times show it.
    pub period_s: Option<f64>,
    /// Sense of rotation by the times of the points; `None` without times or revolutions.
    pub rotation: Option<RotationDirection>,
    /// Times of the points: `auto` are those of the data; `None` for scans that are compensated already.
    pub motion_compensation: Option<MotionCompensation>,
    /// Number of scans that it was inferred from.
    pub scans: usize,
}

impl Sensor {
    /// A sensor of beams all around, without an own car, with the times of the data.
    pub fn new(range_image: LidarModel) -> Self {
        Self {
            has_rows: true,
            beams: Some(range_image.height),
            beam_source: BeamSource::None,
            columns: range_image.width,
            horizontal_fov_deg: 360.0,
            range_image,
            mounting: None,
            sensor_height_m: None,
            own_car_m: [0.0; 4],
            is_moving: false,
            period_s: None,
            rotation: None,
            motion_compensation: Some(MotionCompensation::Auto),
            scans: 0,
        }
    }

    /// Height above the ground: given, else that of the mounting [m].
    pub(crate) fn height_m(&self) -> Option<f64> {
        (self.sensor_height_m).or(self.mounting.map(|mounting| mounting.height_m))
    }
}

impl From<&Sensor> for SensorConfig {
    /// All of a sensor that can be known.
    fn from(sensor: &Sensor) -> Self {
        Self {
            range_image: (&sensor.range_image).into(),
            has_rows: Some(sensor.has_rows),
            own_car_m: Some(sensor.own_car_m),
            sensor_height_m: sensor.sensor_height_m,
            motion_compensation: sensor.motion_compensation,
        }
    }
}

impl Validate for Sensor {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("range_image", &self.range_image)?;
        rectangle("own_car_m", self.own_car_m)?;
        match self.sensor_height_m {
            Some(height_m) => positive("sensor_height_m", height_m),
            None => Ok(()),
        }
    }
}

/// Beams, field of view, image, ranges and height.
impl fmt::Display for Sensor {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let image = &self.range_image;
        match self.beams {
            Some(beams) => write!(formatter, "{beams} beams")?,
            None => formatter.write_str("points without rows")?,
        }
        let [highest, lowest] = match image.elevations.as_deref() {
            Some([highest, .., lowest]) => [*highest, *lowest],
            _ => {
                let [top, bottom] = [image.fov_up, -image.fov_down.abs()];
                // Beams are in the middle of their rows.
                let margin = if self.has_rows {
                    0.5 * (top - bottom) / image.height as f32
                } else {
                    0.0
                };
                [top - margin, bottom + margin]
            }
        };
        write!(
            formatter,
            " from {highest:+.1} to {lowest:+.1} degrees, image {} x {}, ranges {:.1} to {:.0} m",
            image.height, image.width, image.min_range, image.max_range
        )?;
        match &self.mounting {
            Some(mounting) => write!(formatter, ", {:.2} m above the ground", mounting.height_m),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests;
