//! Poses of a recording on its way into a map.

use super::error::MappingError;
use super::pose_report::PoseReport;
use crate::geometry::Pose3;
use crate::map::build::path_check::{self, ImplausiblePath};
use crate::map::build::plan::key_scans;
use crate::map::{MapConfig, PoseSource};
use crate::recording::{Frame, Recording, RecordingError};
use crate::sensor::Sensor;

/// The recording with the poses that were given to it, else its own ones; without poses where these are to be found from
/// the scans. `older` is the pose `world_from_map` of the map to which the recording is added, in whose world its poses
/// are only if that is said by [`PoseSource::Given`].
pub fn with_given_poses(
    mut recording: Recording,
    source: PoseSource,
    older: Option<&Pose3>,
) -> Result<Recording, RecordingError> {
    let is_auto = source == PoseSource::Auto;
    if source == PoseSource::Odometry || (is_auto && older.is_some()) {
        return Ok(recording.without_poses());
    }
    let track = match recording.track.take() {
        Some(track) => track,
        None => match recording.own_track() {
            Err(error) if is_auto && recording.files.poses.is_none() => {
                if matches!(error, RecordingError::TopicNotNamed { .. }) {
                    tracing::info!("the poses are found from the scans: {error}");
                } else if error.is_absence() {
                    tracing::info!(
                        "the recording contains no poses: they are found from its scans"
                    );
                } else {
                    tracing::warn!(
                        "the poses of the recording are not used, but found from its scans: {error}"
                    );
                }
                return Ok(recording);
            }
            track => track?,
        },
    };
    recording.with_poses(match older {
        Some(world_from_map) => track.in_map(world_from_map),
        None => track,
    })
}

/// The recording as its sensor measures it, the sensor, which is inferred where it is not given, and what the scans say
/// about the poses; an error where these contradict each other or the scans.
pub fn checked(
    recording: Recording,
    sensor: Option<&Sensor>,
    config: &MapConfig,
) -> Result<(Recording, Sensor, Option<PoseReport>), MappingError> {
    check_path(&recording, config.max_step_m)?;
    let sensor = match sensor {
        Some(sensor) => sensor.clone().with_known(&config.sensor),
        None => Sensor::infer_recording(&recording, &config.sensor)?,
    };
    let recording = sensor.applied_to(recording);
    if recording.track.is_none() || !config.check_poses {
        return Ok((recording, sensor, None));
    }
    let report = PoseReport::new(&recording)?;
    report.require_fit()?;
    Ok((recording, sensor, Some(report)))
}

/// Checks the poses of a recording against each other; see [`path_check`].
pub fn check_path(recording: &Recording, max_step_m: f64) -> Result<(), ImplausiblePath> {
    let poses = recording.frames.iter();
    let poses = poses.filter_map(|frame| Some((frame.number, frame.map_from_lidar.as_ref()?)));
    path_check::check(poses, max_step_m)
}

/// The frames that are far enough from each other [m] to be mapped.
pub fn key_frames(frames: &[Frame], displacement_m: f64) -> Vec<Frame> {
    let keys = key_scans(&poses_of(frames), displacement_m).into_iter();
    keys.map(|key| frames[key].clone()).collect()
}

/// The poses of frames that have poses.
pub fn poses_of(frames: &[Frame]) -> Vec<Pose3> {
    let poses = frames.iter().map(|frame| frame.map_from_lidar);
    poses.map(Option::unwrap_or_default).collect()
}
