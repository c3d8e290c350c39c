//! The whole way from a recording to a map.
//!
//! > The poses are those of the recording, checked against the motion and the ground of its scans ([`PoseReport`]), or
//! > are found from the scans ([`TrajectorySummary`]); the sensor is inferred from some scans; key scans, deskewed by
//! > the poses, become a mesh by [`MapBuilder`].
//!
//! [`build_map`] does all of it, [`map_recording`] also returns what the recording has shown. The program, which keeps
//! results between the steps, takes them one by one: `with_given_poses`, `checked`, `PoseSearch`, `key_frames`.

mod error;
mod events;
mod georeferenced;
mod inertial;
mod lost_path;
mod pose_check;
mod pose_report;
mod pose_search;
mod poses;
mod trajectory;

use std::sync::Arc;

pub use error::MappingError;
pub use georeferenced::georeferenced;
pub use inertial::{CALIBRATION, calibrated};
pub use lost_path::LostPath;
pub use pose_report::{PoseReport, Tilt};
pub use trajectory::{InertialSummary, LoopCounts, TrajectorySummary};

pub(crate) use pose_search::PoseSearch;
pub(crate) use poses::{check_path, checked, key_frames, poses_of, with_given_poses};
pub(crate) use trajectory::{ADJUSTMENT, find_poses};

use crate::map::{BuildError, Map, MapBuilder, MapConfig, MappingPath};
use crate::odometry::Trajectory;
use crate::recording::Recording;
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
/// As [`build_map`]; the recording is not found in the map, or the map lacks the surfaces around it.
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
    let (mut recording, sensor, poses) = checked(given, builder.sensor.as_ref(), &builder.config)?;
    builder.sensor = Some(sensor.clone());
    let mut trajectory = None;
    if PoseSearch::is_needed(&recording, &builder.config) {
        let search = PoseSearch::new(recording, &sensor, older, &builder.config);
        let found = search.find(builder.options.memory_budget, &builder.on_event)?;
        let rows = search.rows(&found);
        recording = search.into_recording(rows, found.inertial.is_some())?;
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
