//! The sensor of a recording.

use super::error::MappingError;
use crate::lidar::Scan;
use crate::map::MapConfig;
use crate::recording::Recording;
use crate::sensor::{self, SensorDescription};

/// Infers the sensor from some scans, spread over the recording, and completes the configuration.
pub fn resolve(
    recording: Recording,
    config: &mut MapConfig,
) -> Result<(Recording, SensorDescription), MappingError> {
    const SCANS: usize = 10;
    let step = recording.frames.len().div_ceil(SCANS).max(1);
    let frames = recording.frames.iter().step_by(step);
    let scans: Vec<Scan> = frames.map(|frame| frame.read()).collect::<Result<_, _>>()?;
    let sensor = sensor::infer(&scans);
    let settings = &mut config.local_map.scan;
    settings.range_image = sensor.lidar.clone();
    settings.has_rows = sensor.has_rows;
    if sensor.is_moving {
        settings.own_car_m = sensor.own_car_m;
    }
    Ok((recording, sensor))
}
