//! The place of a recording on the Earth, from its poses and fixes.

use super::error::MappingError;
use crate::geometry::Pose3;
use crate::georeference::{AlignedPath, PathOverTime, align};
use crate::odometry::GnssConstraints;
use crate::recording::Recording;

/// Aligns the poses of a recording, in the frame of its map, with fixes of a GNSS receiver.
///
/// # Errors
/// The fixes are not along the path, or do not determine its place.
pub fn georeferenced(
    recording: &Recording,
    gnss: &GnssConstraints,
) -> Result<AlignedPath, MappingError> {
    let posed = recording.frames.iter();
    let posed = posed.filter_map(|frame| Some((frame.time_s, frame.map_from_lidar?)));
    let (times_s, poses): (Vec<f64>, Vec<Pose3>) = posed.unzip();
    let path = PathOverTime {
        times_s: &times_s,
        map_from_lidar: &poses,
    };
    Ok(align(path, &gnss.fixes, &gnss.config)?)
}
