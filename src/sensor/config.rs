//! What a user knows about a sensor; the rest is inferred from the scans.

use std::fmt;

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::lidar::{LidarModel, PointTiming, Rotation, RotationDirection};
use crate::validation::{InvalidValue, Validate, nested, positive, rectangle};

/// What is known about a sensor, with the names of the configuration; what is `None` is inferred from the scans.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SensorConfig {
    /// Size and limits of the range images.
    #[default(LidarModel::UNKNOWN)]
    pub range_image: LidarModel<Option<usize>, Option<f32>>,
    /// Whether each beam keeps its elevation, as those of spinning sensors do; otherwise `build-map` takes normals
    /// from neighbours in space.
    pub has_rows: Option<bool>,
    /// Rectangle of the own car in the lidar frame, whose points are dropped: x_min, x_max, y_min, y_max [m].
    pub own_car_m: Option<[f32; 4]>,
    /// Height of the sensor above the ground [m].
    pub sensor_height_m: Option<f64>,
    /// Times of the points for motion compensation; `None` for scans that are compensated already.
    #[default(Some(MotionCompensation::Auto))]
    pub motion_compensation: Option<MotionCompensation>,
}

impl Validate for SensorConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("range_image", &self.range_image)?;
        if let Some(own_car_m) = self.own_car_m {
            rectangle("own_car_m", own_car_m)?;
        }
        match self.sensor_height_m {
            Some(height_m) => positive("sensor_height_m", height_m),
            None => Ok(()),
        }
    }
}

/// Source of the times of the points, for motion compensation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(try_from = "String", into = "String")]
pub enum MotionCompensation {
    /// Times of the data, else the order of the points or the rotation that fits consecutive scans best.
    Auto,
    /// Times from a rotation, written as `clockwise`, seen from above, or `counter_clockwise from 90`.
    Rotation {
        /// Sense of rotation.
        direction: RotationDirection,
        /// Azimuth at which a revolution starts, counter-clockwise from the x axis [deg].
        start_deg: f64,
    },
    /// Times from the order in which the points were measured, written as `order`, or `order over 400`.
    Order {
        /// Angle from the start of a scan to that of the next [deg].
        sweep_deg: f64,
    },
}

/// Azimuth at which a revolution starts by default: backwards, as in KITTI [deg].
const BEHIND_DEG: f64 = 180.0;

/// Angle from the start of a scan to that of the next by default, and its limits [deg].
const TURN_DEG: f64 = 360.0;
const SWEEPS_DEG: std::ops::RangeInclusive<f64> = 180.0..=900.0;

impl MotionCompensation {
    /// Times of scans that are an interval apart [s]; the start of a rotation is rounded to a degree, the angle of an
    /// order to a tenth.
    pub(crate) fn of(timing: &PointTiming, interval_s: f64) -> Self {
        match timing {
            PointTiming::Rotation(rotation) => Self::Rotation {
                direction: rotation.direction,
                // No negative zero.
                start_deg: rotation
                    .start_rad
                    .to_degrees()
                    .round()
                    .rem_euclid(360.0)
                    .abs(),
            },
            PointTiming::Order { period_s } => Self::Order {
                sweep_deg: (10.0 * TURN_DEG * interval_s / period_s).round() / 10.0,
            },
        }
    }

    /// The configured times of scans that are an interval apart [s]; `None` if they have to be inferred.
    pub(crate) fn timing(self, interval_s: f64) -> Option<PointTiming> {
        match self {
            Self::Auto => None,
            Self::Rotation {
                direction,
                start_deg,
            } => Some(PointTiming::Rotation(Rotation {
                direction,
                period_s: interval_s,
                start_rad: start_deg.to_radians(),
            })),
            Self::Order { sweep_deg } => Some(PointTiming::Order {
                period_s: interval_s * TURN_DEG / sweep_deg,
            }),
        }
    }
}

impl fmt::Display for MotionCompensation {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (direction, start_deg) = match *self {
            Self::Auto => return formatter.write_str("auto"),
            Self::Order {
                sweep_deg: TURN_DEG,
            } => return formatter.write_str("order"),
            Self::Order { sweep_deg } => return write!(formatter, "order over {sweep_deg}"),
            Self::Rotation {
                direction,
                start_deg,
            } => (direction, start_deg),
        };
        formatter.write_str(match direction {
            RotationDirection::Clockwise => "clockwise",
            RotationDirection::CounterClockwise => "counter_clockwise",
        })?;
        if start_deg == BEHIND_DEG {
            Ok(())
        } else {
            write!(formatter, " from {start_deg}")
        }
    }
}

impl From<MotionCompensation> for String {
    fn from(compensation: MotionCompensation) -> Self {
        compensation.to_string()
    }
}

impl TryFrom<String> for MotionCompensation {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let sweep_deg = match text.strip_prefix("order") {
            Some("") => Some(TURN_DEG),
            Some(rest) => rest
                .strip_prefix(" over ")
                .and_then(|it| it.trim().parse().ok()),
            None => None,
        };
        if let Some(sweep_deg) = sweep_deg.filter(|deg| SWEEPS_DEG.contains(deg)) {
            return Ok(Self::Order { sweep_deg });
        }
        let (direction, start) = match text.split_once(" from ") {
            Some((direction, start)) => (direction.trim(), start.trim().parse().ok()),
            None => (text.as_str(), Some(BEHIND_DEG)),
        };
        let start_deg = start.filter(|deg: &f64| (-360.0..=360.0).contains(deg));
        let direction = match direction {
            "auto" if direction == text => return Ok(Self::Auto),
            "clockwise" => Some(RotationDirection::Clockwise),
            "counter_clockwise" => Some(RotationDirection::CounterClockwise),
            _ => None,
        };
        match (direction, start_deg) {
            (Some(direction), Some(start_deg)) => Ok(Self::Rotation {
                direction,
                start_deg,
            }),
            _ => Err(format!(
                "`{text}` is not auto, or a rotation: clockwise or counter_clockwise, which may be followed by `from` and the azimuth at which a revolution starts, -360 to 360 [deg], or order, which may be followed by `over` and the angle from the start of a scan to that of the next, 180 to 900 [deg]"
            )),
        }
    }
}
