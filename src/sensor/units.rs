//! The range image of a sensor in JSON: other than in configurations, which have the keys of range-mcl, with units in its keys.

use std::sync::Arc;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::lidar::LidarModel;

/// Size, field of view and range limits of a range image.
#[derive(Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct RangeImageInUnits {
    /// Rows.
    height: usize,
    /// Columns over 360 degrees.
    width: usize,
    /// Upper edge of the vertical field of view over the horizon [deg].
    #[serde(alias = "fov_up")]
    fov_up_deg: f32,
    /// Lower edge of the vertical field of view; below the horizon whatever its sign [deg].
    #[serde(alias = "fov_down")]
    fov_down_deg: f32,
    /// Range from which on returns are dropped [m].
    #[serde(alias = "max_range")]
    max_range_m: f32,
    /// Range up to which returns are dropped [m].
    #[serde(alias = "min_range")]
    min_range_m: f32,
    /// Elevations of the rows, from the top [deg]; without them, the rows of a field of view are evenly spaced.
    #[serde(alias = "elevations")]
    elevations_deg: Option<Arc<[f32]>>,
}

/// Writes a model with units in its keys.
pub fn serialize<S: Serializer>(model: &LidarModel, serializer: S) -> Result<S::Ok, S::Error> {
    let keys = RangeImageInUnits {
        height: model.height,
        width: model.width,
        fov_up_deg: model.fov_up,
        fov_down_deg: model.fov_down,
        max_range_m: model.max_range,
        min_range_m: model.min_range,
        elevations_deg: model.elevations.clone(),
    };
    keys.serialize(serializer)
}

/// Reads a model, also with the keys of a configuration, which earlier maps have.
pub fn deserialize<'a, D: Deserializer<'a>>(deserializer: D) -> Result<LidarModel, D::Error> {
    let keys = RangeImageInUnits::deserialize(deserializer)?;
    Ok(LidarModel {
        height: keys.height,
        width: keys.width,
        fov_up: keys.fov_up_deg,
        fov_down: keys.fov_down_deg,
        max_range: keys.max_range_m,
        min_range: keys.min_range_m,
        elevations: keys.elevations_deg,
    })
}
