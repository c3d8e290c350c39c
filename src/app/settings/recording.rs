//! Keys of recordings that several commands share.

use std::path::Path;

use nalgebra::{UnitQuaternion, Vector3};

use crate::geometry::Pose3;
use crate::validation::{InvalidValue, require};

/// Pose x, y, z [m], roll, pitch, yaw [deg] of the lidar on a body.
pub fn body_from_lidar([x, y, z, roll, pitch, yaw]: [f64; 6]) -> Pose3 {
    let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_radians);
    Pose3::from_parts(
        Vector3::new(x, y, z).into(),
        UnitQuaternion::from_euler_angles(roll, pitch, yaw),
    )
}

/// Requires that a body's pose and a camera's calibration are not both given, and that the numbers are possible.
pub(super) fn mounting(
    calib_file: Option<&Path>,
    body_from_lidar: Option<[f64; 6]>,
) -> Result<(), InvalidValue> {
    let Some(numbers) = body_from_lidar else {
        return Ok(());
    };
    require(
        calib_file.is_none(),
        "body_from_lidar",
        format!("{numbers:?}"),
        "give calib_file or body_from_lidar, not both",
    )?;
    let is_possible = numbers[..3].iter().all(|m| m.abs() <= 1000.0)
        && numbers[3..].iter().all(|deg| deg.abs() <= 360.0);
    require(
        is_possible,
        "body_from_lidar",
        format!("{numbers:?}"),
        "x, y, z must be within 1000 m, and roll, pitch, yaw within 360 degrees",
    )
}
