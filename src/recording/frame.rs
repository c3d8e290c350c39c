//! One frame of a recording.

use std::path::PathBuf;

use super::error::RecordingError;
use super::scan_files;
use crate::geometry::{Pose3, StampedPose};
use crate::lidar::{Motion, Rotation, Scan};

/// One frame of a recording; the scan is read by [`read`](Self::read).
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Number in the recording.
    pub number: usize,
    /// The scan's file.
    pub scan_path: PathBuf,
    /// Time of the scan's pose, since the start of the recording or since 1970 [s].
    pub time_s: f64,
    /// Given pose, `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Option<Pose3>,
    /// Rotation of the sensor, from which the times of the points follow where the file has none.
    pub rotation: Option<Rotation>,
    /// Motion by which the scan is deskewed when it is read; `None` if it is not.
    pub motion: Option<Motion>,
}

impl Frame {
    /// Reads the scan and deskews it by the motion, if that is known.
    pub fn read(&self) -> Result<Scan, RecordingError> {
        let mut scan = scan_files::read(&self.scan_path)?;
        scan.time_s = scan.time_s.or(Some(self.time_s));
        if let (true, Some(rotation)) = (scan.times_s.is_empty(), &self.rotation) {
            scan.times_s = rotation.point_times(&scan.points);
        }
        if let Some(motion) = &self.motion {
            motion.deskew(&mut scan);
        }
        Ok(scan)
    }

    /// A pose of the frame with its number and time.
    pub fn stamped(&self, map_from_lidar: Pose3) -> StampedPose {
        StampedPose {
            frame: self.number,
            time_s: self.time_s,
            map_from_lidar,
        }
    }
}
