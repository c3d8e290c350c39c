//! Calibration of the inertial sensor of a recording by its first scans.

use super::error::MappingError;
use super::events::{OnEvent, notify};
use crate::inertial::{Gyroscope, Imu, ImuRejection};
use crate::map::BuildEvent;
use crate::odometry::{ImuCalibrator, OdometryConfig};
use crate::recording::{Frame, Recording};

/// The stage before the first scan, where there is an inertial sensor.
pub const CALIBRATION: &str = "inertial sensor";

/// The recording with the rotations that its inertial sensor has measured, where it has one: calibrated by the odometry of the
/// first scans, or left out with a warning where it contradicts them. Recordings whose poses are found need not be calibrated
/// before. Its only event is the stage `"inertial sensor"`, with every scan.
///
/// # Errors
/// The scans cannot be read, their times do not ascend, or an event is answered with `Break`.
pub fn calibrated(
    recording: Recording,
    config: &OdometryConfig,
    on_event: OnEvent,
) -> Result<Recording, MappingError> {
    let Some(imu) = &recording.imu else {
        return Ok(recording);
    };
    match calibrate_imu(&recording.dense_frames(), imu, config, on_event)? {
        Ok(gyroscope) => Ok(recording.with_gyroscope(gyroscope)),
        Err(rejection) => {
            tracing::warn!("the inertial sensor is left out: {rejection}");
            Ok(Recording {
                imu: None,
                ..recording
            })
        }
    }
}

/// Calibrates an inertial sensor by the first frames, or by all of them.
pub fn calibrate_imu(
    frames: &[Frame],
    imu: &Imu,
    config: &OdometryConfig,
    on_event: OnEvent,
) -> Result<Result<Gyroscope, ImuRejection>, MappingError> {
    let mut calibrator = ImuCalibrator::new(imu.clone(), config.clone())?;
    for frame in frames {
        notify(on_event, BuildEvent::Stage(CALIBRATION))?;
        if let Some(verdict) = calibrator.add(&frame.read()?)? {
            return Ok(verdict);
        }
    }
    Ok(calibrator.finish())
}
