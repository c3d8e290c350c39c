//! A second drive in the map of a first one: the trajectory of its scans, in the frame of that map.

use std::sync::Arc;

use glam::DVec3;
use nalgebra::Point2;

use super::error::TrackerError;
use super::odometry::MotionOfScans;
use super::tracker::Tracker;
use super::tracking_loss::State;
use crate::geometry::Pose3;
use crate::lidar::Scan;
use crate::map::MapError;
use crate::map::build::plan::origin_near;
use crate::odometry::{
    OdometryError, PlacementError, Trajectory, TrajectoryBuilder, TrajectoryConfig,
};
use crate::validation::InvalidValue;

/// Why a second drive, or a scan of it, cannot be used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum SecondDriveError {
    #[error(transparent)]
    Odometry(#[from] OdometryError),
    #[error(transparent)]
    Tracker(#[from] TrackerError),
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    #[error(transparent)]
    Map(#[from] MapError),
    #[error(transparent)]
    Placement(#[from] PlacementError),
}

/// Finds the trajectory of a drive in a map, scan by scan; the drive may begin anywhere, and leave the map.
pub struct SecondDrive {
    tracker: Tracker,
    builder: TrajectoryBuilder,
    found: Vec<Option<Pose3>>,
}

impl SecondDrive {
    /// A drive before its first scan, with a tracker in the map.
    ///
    /// # Errors
    /// A field of the configuration is out of its range.
    pub fn new(tracker: Tracker, trajectory: TrajectoryConfig) -> Result<Self, InvalidValue> {
        let builder = TrajectoryBuilder::new(trajectory)?;
        Ok(Self {
            builder: builder.with_memory_budget(tracker.map().memory_budget),
            tracker,
            found: vec![],
        })
    }

    /// Registers the next scan to those before it, and localizes it in the map.
    ///
    /// # Errors
    /// Times of scans do not ascend, the points do not fit the sensor, or the map cannot be rendered.
    pub fn add(&mut self, scan: &Scan) -> Result<State, SecondDriveError> {
        self.found.push(None);
        let motion = MotionOfScans::from(self.builder.add(scan)?);
        let estimate = self.tracker.step_with_motion(scan, motion.into())?;
        let is_found = estimate.state == State::Tracking && estimate.on_mapped_ground;
        if let Some(last) = self.found.last_mut() {
            *last = is_found.then_some(estimate.map_from_lidar);
        }
        Ok(estimate.state)
    }

    /// Number of scans that were found in the map.
    pub fn found(&self) -> usize {
        self.found.iter().flatten().count()
    }

    /// Closes loops and adjusts all poses to the surfaces of the map.
    ///
    /// # Errors
    /// The drive was not found in the map, the map lacks the surfaces around it or cannot be read, or memory does not suffice.
    pub fn finish(self) -> Result<Trajectory, SecondDriveError> {
        /// The map is needed around the scans that were found, as far as a sensor sees [m].
        const RADIUS_M: f64 = 150.0;
        let found = self.found.iter().flatten();
        let positions: Vec<Point2<f64>> = found
            .map(|pose| pose.translation.vector.xy().into())
            .collect();
        // Vertices are single numbers: they are exact only near the origin of their coordinates.
        let first = positions.first().copied().unwrap_or_default();
        let origin = origin_near(DVec3::new(first.x, first.y, 0.0));
        let map_from_local = Pose3::translation(origin.x, origin.y, origin.z);
        let mesh = if positions.is_empty() {
            Arc::default()
        } else {
            (self.tracker.map()).mesh_near(&positions, RADIUS_M, origin, u64::MAX)?
        };
        let found: Vec<Option<Pose3>> = (self.found.iter())
            .map(|pose| pose.map(|pose| map_from_local.inverse() * pose))
            .collect();
        let mut trajectory = (self.builder).finish_in_map(&mesh, &found)?;
        let odometry = trajectory.odometry.iter_mut();
        let odometry = odometry.map(|estimate| &mut estimate.odom_from_lidar);
        for pose in trajectory.poses.iter_mut().chain(odometry) {
            *pose = map_from_local * *pose;
        }
        Ok(trajectory)
    }
}
