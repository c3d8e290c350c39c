//! The search for the poses of a recording that has none, or whose poses are polished.

use super::error::MappingError;
use super::events::OnEvent;
use super::lost_path::LostPath;
use super::poses::check_path;
use super::trajectory::{each_scan, find_poses};
use crate::geometry::{Pose3, StampedPose};
use crate::inertial::Imu;
use crate::localization::{LocalizerConfig, SecondDrive, SecondDriveError, Tracker, TrackerConfig};
use crate::map::{Map, MapConfig, PoseSource};
use crate::memory::MemoryBudget;
use crate::odometry::{GnssConstraints, Trajectory, TrajectoryConfig};
use crate::recording::{Frame, PoseTrack, Recording};
use crate::sensor::Sensor;

/// A recording whose poses are found from its scans, in an older map where there is one.
pub struct PoseSearch<'a> {
    /// The frames whose poses are found.
    pub frames: Vec<Frame>,
    recording: Recording,
    sensor: &'a Sensor,
    older: Option<&'a Map>,
    config: &'a MapConfig,
    gnss: Option<&'a GnssConstraints>,
}

impl<'a> PoseSearch<'a> {
    /// Whether the poses of a recording are not used as they are.
    pub fn is_needed(recording: &Recording, config: &MapConfig) -> bool {
        recording.track.is_none() || config.poses == PoseSource::Polished
    }

    /// The search for the poses of all frames, or, where the recording has poses, of those that have one.
    pub fn new(
        recording: Recording,
        sensor: &'a Sensor,
        older: Option<&'a Map>,
        config: &'a MapConfig,
    ) -> Self {
        let recording = recording.with_gyroscope_of_poses();
        let frames = if recording.track.is_some() {
            recording.frames.clone()
        } else {
            recording.dense_frames()
        };
        Self {
            frames,
            recording,
            sensor,
            older,
            config,
            gnss: None,
        }
    }

    /// The search with fixes of a GNSS receiver, which poses from the scans follow.
    #[must_use]
    pub fn with_gnss(self, gnss: Option<&'a GnssConstraints>) -> Self {
        Self { gnss, ..self }
    }

    /// Whether given poses are polished.
    pub fn is_given(&self) -> bool {
        self.recording.track.is_some()
    }

    /// The inertial sensor by which the poses are level; `None` where others show the direction up.
    pub fn imu(&self) -> Option<&Imu> {
        let is_used = self.older.is_none() && !self.is_given();
        (self.recording.imu.as_ref()).filter(|_| is_used)
    }

    /// The stage of the build.
    pub fn name(&self) -> &'static str {
        match (self.older, self.is_given()) {
            (Some(_), _) => "localize",
            (None, true) => "polish",
            (None, false) => "odometry",
        }
    }

    /// Finds the poses in the frame of the map. Its events are the stage of its [`name`](Self::name), every scan, and the
    /// stage [`ADJUSTMENT`](super::ADJUSTMENT).
    pub fn find(
        &self,
        memory_budget: MemoryBudget,
        on_event: OnEvent,
    ) -> Result<Trajectory, MappingError> {
        let settings = TrajectoryConfig::default();
        match self.older {
            Some(map) => self.find_in(map, settings, on_event),
            None => {
                let found = find_poses(
                    &self.frames,
                    self.is_given(),
                    self.imu(),
                    &settings,
                    self.gnss,
                    memory_budget,
                    on_event,
                )?;
                LostPath::of(&found, &self.frames).map_or(Ok(found), |lost| Err(lost.into()))
            }
        }
    }

    fn find_in(
        &self,
        map: &Map,
        settings: TrajectoryConfig,
        on_event: OnEvent,
    ) -> Result<Trajectory, MappingError> {
        let tracker = TrackerConfig {
            localizer: LocalizerConfig {
                ground: self.config.ground.clone(),
                ..LocalizerConfig::default()
            },
            odometry: None,
            seed: self.config.seed,
            ..TrackerConfig::default()
        };
        let tracker = Tracker::new(map, tracker).map_err(SecondDriveError::from)?;
        let drive = SecondDrive::new(tracker.with_sensor(self.sensor.clone()), settings);
        let mut drive = drive.map_err(SecondDriveError::from)?;
        each_scan(self.name(), &self.frames, on_event, |_, scan| {
            drive.add(scan)?;
            Ok(())
        })?;
        tracing::info!(
            "{} of {} scans are found in the older map",
            drive.found(),
            self.frames.len()
        );
        Ok(drive.finish()?)
    }

    /// The found poses in the world of the map, normalized, so that they are the same once they are written and read.
    pub fn rows(&self, found: &Trajectory) -> Vec<StampedPose> {
        let world_from_map = self.world_from_map();
        let row = |(frame, pose): (&Frame, &Pose3)| {
            let mut world_from_lidar = world_from_map * pose;
            world_from_lidar.rotation.renormalize();
            frame.stamped(world_from_lidar)
        };
        self.frames.iter().zip(&found.poses).map(row).collect()
    }

    /// The recording with poses in the world of the map, which are checked against each other. It has no inertial sensor where
    /// one was left out when they were found.
    pub fn into_recording(
        self,
        rows: Vec<StampedPose>,
        is_level: bool,
    ) -> Result<Recording, MappingError> {
        let is_left_out = self.imu().is_some() && !is_level;
        let world_from_map = self.world_from_map();
        let map_from_world = world_from_map.inverse();
        let poses = rows.iter().map(|row| map_from_world * row.map_from_lidar);
        let times_s = rows.iter().map(|row| row.time_s).collect();
        let track = PoseTrack::from_poses(poses.collect(), times_s, world_from_map);
        let mut recording = self.recording;
        recording.imu = recording.imu.filter(|_| !is_left_out);
        // The rows have the times of the frames, also where these are assumed.
        recording.has_times = true;
        let recording = recording.with_poses(track)?;
        check_path(&recording, self.config.max_step_m)?;
        Ok(recording)
    }

    fn world_from_map(&self) -> Pose3 {
        let own = || self.recording.world().0;
        self.older.map_or_else(own, |map| map.path.world_from_map)
    }
}
