//! The sensor of a recording.

use super::error::MappingError;
use crate::map::MapConfig;
use crate::recording::Recording;
use crate::sensor::{Sensor, SensorConfig};

/// Infers the sensor from some scans, spread over the recording, and completes the configuration.
pub fn resolve(
    recording: Recording,
    config: &mut MapConfig,
) -> Result<(Recording, Sensor), MappingError> {
    let sensor = Sensor::infer_recording(&recording, &SensorConfig::default())?;
    let settings = &mut config.local_map.scan;
    settings.range_image = sensor.range_image.clone();
    settings.has_rows = sensor.has_rows;
    settings.own_car_m = sensor.own_car_m;
    Ok((sensor.applied_to(recording), sensor))
}
