//! What to do about given poses that do not fit the scans.

use anyhow::{Error, Result};

use crate::app::settings::BuildMapConfig;
use crate::mapping::{MappingError, PoseReport};
use crate::odometry::{PoseFit, PoseMeaning};
use crate::recording::Recording;

/// Checks the poses of a recording whose scans are not compensated by them: an error where they are of another
/// motion, a warning where they are doubtful or the map is not level.
pub fn check(recording: &Recording, config: &BuildMapConfig) -> Result<()> {
    if !config.map.check_poses || recording.track.is_none() {
        return Ok(());
    }
    let report = PoseReport::new(recording)?;
    report.require_fit().map_err(with_remedy)?;
    match report.fit() {
        PoseFit::Fits => tracing::debug!("the poses fit the scans: {report}"),
        _ => tracing::warn!("the poses fit the scans badly: {report}{}", remedy(&report)),
    }
    match report.tilt {
        Some(tilt) if tilt.is_uneven() => tracing::warn!(
            "the direction up of the ground varies by {:.0} degrees along the drive: check the rotations in pose_file, calib_file and body_from_lidar",
            tilt.spread_rad.to_degrees()
        ),
        Some(tilt) if tilt.is_steep() => tracing::warn!(
            "the ground is tilted by {:.0} degrees in the map, whose frame is that of the lidar in the first row of the poses: turn scans and poses so that its z axis points up",
            tilt.tilt_rad.to_degrees()
        ),
        _ => {}
    }
    Ok(())
}

fn with_remedy(error: MappingError) -> Error {
    match &error {
        MappingError::PosesDoNotFit(report) => anyhow::anyhow!("{error}{}", remedy(report)),
        _ => error.into(),
    }
}

/// What to change in the configuration.
fn remedy(report: &PoseReport) -> String {
    match report.better() {
        None | Some(PoseMeaning::Given) => "; check that pose_file belongs to this recording, and that calib_file or body_from_lidar describe the body whose poses it has".to_owned(),
        Some(PoseMeaning::Camera) => ": give calib_file with the line Tr".to_owned(),
        Some(PoseMeaning::Lidar) => ": remove calib_file and body_from_lidar".to_owned(),
        Some(PoseMeaning::Inverse) => ": invert the rows of pose_file".to_owned(),
        Some(PoseMeaning::Turned(rad)) => format!(
            ": give body_from_lidar with a yaw of {:.0} degrees",
            rad.to_degrees()
        ),
    }
}
