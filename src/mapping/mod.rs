//! The whole way from a recording to a map.
//!
//! > The poses are those of the recording, checked against the motion and the ground of its scans ([`PoseReport`]), or
//! > are found from the scans ([`TrajectorySummary`]); the sensor is inferred from some scans; key scans, deskewed by
//! > the poses, become a mesh by [`MapBuilder`].
//!
//! [`build_map`] does all of it, [`map_recording`] also returns what the recording has shown. The program, which keeps
//! results between the steps, takes them one by one: `with_given_poses`, `PoseReport::new`, `find_poses`, `key_frames`.

mod error;
mod pose_check;
mod pose_report;
mod poses;
mod trajectory;

use std::sync::Arc;

pub use error::MappingError;
pub use pose_report::{PoseReport, Tilt};
pub use trajectory::{LoopCounts, TrajectorySummary};

pub(crate) use poses::{check_path, key_frames, poses_of, with_given_poses};
pub(crate) use trajectory::{ADJUSTMENT, find_poses, find_poses_in};

use crate::map::{BuildError, Map, MapBuilder, MapConfig, MappingPath, PoseSource};
use crate::odometry::{Trajectory, TrajectoryConfig};
use crate::recording::{Frame, Recording};
use crate::sensor::Sensor;

/// A map, and what its recording has shown.
pub struct MappedRecording {
    /// The map.
    pub map: Map,
    /// The sensor.
    pub sensor: Sensor,
    /// Checks of the poses that the recording has; `None` without them, or where they are not to be checked.
    pub poses: Option<PoseReport>,
    /// Poses that were found from the scans; `None` where those of the recording were used.
    pub trajectory: Option<Trajectory>,
}

/// Builds a map of a recording. Its poses are checked; without any, they are found from the scans. The frame of the map is
/// that of the lidar at the first pose.
///
/// Scans are read when they are needed, more than once: memory is that of the scans of a local map, about 1.5 MB for each
/// of 120,000 points, and the map.
///
/// # Errors
/// The scans cannot be read, no poses can be found or they contradict the scans, or the map cannot be built.
pub fn build_map(recording: &Recording, config: &MapConfig) -> Result<Map, MappingError> {
    let builder = MapBuilder::new(config.clone());
    Ok(map_recording(recording, None, builder)?.map)
}

/// Adds a recording to a map of the same place: it is localized in that map, or has poses in its world; what its beams
/// pass through is removed, and what the map does not have is added.
///
/// # Errors
/// As [`build_map`]; the recording is not found in the map.
pub fn extend_map(
    map: &Map,
    recording: &Recording,
    config: &MapConfig,
) -> Result<Map, MappingError> {
    let builder = MapBuilder::new(config.clone());
    Ok(map_recording(recording, Some(map), builder)?.map)
}

/// Builds a map of a recording, or adds it to an older one, with the events and options of a builder.
///
/// # Errors
/// As [`build_map`] and [`extend_map`].
pub fn map_recording(
    recording: &Recording,
    older: Option<&Map>,
    mut builder: MapBuilder,
) -> Result<MappedRecording, MappingError> {
    let world = older.map(|map| map.path.world_from_map);
    let given = with_given_poses(recording.clone(), builder.config.poses, world.as_ref())?;
    check_path(&given, builder.config.max_step_m)?;
    let sensor = match &builder.sensor {
        Some(sensor) => sensor.clone().with_known(&builder.config.sensor),
        None => Sensor::infer_recording(&given, &builder.config.sensor)?,
    };
    builder.sensor = Some(sensor.clone());
    let mut recording = sensor.applied_to(given);
    let mut poses = None;
    if recording.track.is_some() && builder.config.check_poses {
        let report = PoseReport::new(&recording)?;
        report.require_fit()?;
        poses = Some(report);
    }
    let mut trajectory = None;
    if recording.track.is_none() || builder.config.poses == PoseSource::Polished {
        let (frames, found) = found_poses(&recording, older, &sensor, &builder)?;
        let world_from_map = world.unwrap_or(recording.world().0);
        recording = recording.with_poses_of(&frames, found.poses.clone(), world_from_map)?;
        check_path(&recording, builder.config.max_step_m)?;
        trajectory = Some(found);
    }
    let recording = recording.compensated_by_poses();
    Ok(MappedRecording {
        map: map_of_poses(&recording, older, &builder)?,
        sensor,
        poses,
        trajectory,
    })
}

/// The poses of all frames, or those of the selected ones polished.
fn found_poses(
    recording: &Recording,
    older: Option<&Map>,
    sensor: &Sensor,
    builder: &MapBuilder,
) -> Result<(Vec<Frame>, Trajectory), MappingError> {
    let config = TrajectoryConfig::default();
    let frames = if recording.track.is_some() {
        recording.frames.clone()
    } else {
        recording.dense_frames()
    };
    let found = match older {
        Some(map) => find_poses_in(map, &frames, sensor, &builder.config, &builder.on_event)?,
        None => find_poses(
            &frames,
            recording.track.is_some(),
            &config,
            builder.options.memory_budget,
            &builder.on_event,
        )?,
    };
    Ok((frames, found))
}

/// The map of a recording with poses, whose key scans are read when they are needed.
fn map_of_poses(
    recording: &Recording,
    older: Option<&Map>,
    builder: &MapBuilder,
) -> Result<Map, MappingError> {
    let keys = key_frames(&recording.frames, builder.config.displacement_threshold_m);
    let read = |key: usize| Ok(keys[key].read()?);
    let built = builder.build_keys(poses_of(&keys), older, &read);
    let mut map = built.map_err(|error| error.with_frames(|key| keys[key].number))?;
    if older.is_none() {
        map.path = Arc::new(MappingPath {
            world_from_map: recording.world().0,
            ..(*map.path).clone()
        });
    }
    Ok(map)
}

impl From<BuildError> for MappingError {
    fn from(error: BuildError) -> Self {
        match error {
            BuildError::Interrupted => Self::Interrupted,
            other => Self::Build(other),
        }
    }
}
