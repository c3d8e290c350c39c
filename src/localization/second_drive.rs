//! A second drive in the map of a first one: the trajectory of its scans, in the frame of that map.

use super::config::LocalizerConfig;
use super::localizer::{Localizer, LocalizerError, Start};
use super::odometry::Odometry;
use super::tracking_loss::State;
use crate::geometry::Pose3;
use crate::lidar::Scan;
use crate::map::Map;
use crate::odometry::{
    OdometryError, PlacementError, Trajectory, TrajectoryBuilder, TrajectoryConfig,
};

/// Why a scan of a second drive cannot be used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum SecondDriveError {
    #[error(transparent)]
    Odometry(#[from] OdometryError),
    #[error(transparent)]
    Localizer(#[from] LocalizerError),
}

/// Finds the trajectory of a drive in a map, scan by scan; the drive may begin anywhere, and leave the map.
pub struct SecondDrive {
    map: Map,
    localizer: Localizer,
    builder: TrajectoryBuilder,
    found: Vec<Option<Pose3>>,
}

impl SecondDrive {
    /// A drive before its first scan.
    pub fn new(
        map: &Map,
        localizer: LocalizerConfig,
        trajectory: TrajectoryConfig,
        seed: u64,
    ) -> Result<Self, LocalizerError> {
        Ok(Self {
            map: map.clone(),
            localizer: Localizer::new(map, localizer, Start::Anywhere, seed)?,
            builder: TrajectoryBuilder::new(trajectory)?,
            found: vec![],
        })
    }

    /// Registers the next scan to those before it, and localizes it in the map.
    pub fn add(&mut self, scan: &Scan) -> Result<State, SecondDriveError> {
        self.found.push(None);
        let motion = self.builder.add(scan)?.previous_from_current;
        let estimate = self.localizer.step(scan, Odometry::Motion(motion))?;
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
    pub fn finish(self) -> Result<Trajectory, PlacementError> {
        self.builder.finish_in_map(&self.map.mesh, &self.found)
    }
}
