//! Inertial measurements: angular rates and specific forces of a sensor that is fixed to the lidar.
//!
//! ```text
//! ω_imu = inv(lidar_from_imu) · ω_lidar + b_ω
//! f_imu = inv(lidar_from_imu) · inv(R) · (a + g · up) + b_f       R = rotation of world_from_lidar
//! ```
//!
//! A sensor at rest measures f = g · up. The biases b, the offset between the clocks and, where it is unknown, the rotation
//! `lidar_from_imu` are estimated from rotations that something else has measured: [`ImuCalibration::estimate`]. A sensor
//! that does not fit them is refused: [`ImuRejection`]. One that does is a [`Gyroscope`], whose rates are integrated to rotations
//! between scans and within them.

mod calibration;
mod gyroscope;
mod samples;

pub use calibration::{ImuCalibration, ImuRejection, MeasuredTurn};
pub use gyroscope::{Gyroscope, MeasuredRotation};
pub use samples::{GRAVITY_M_S2, Imu, ImuError, ImuSample, ImuSamples};
