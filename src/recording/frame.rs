//! One frame of a recording.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

#[cfg(feature = "bags")]
use super::bags::Bag;
use super::error::RecordingError;
use super::scan_files::{self, PointFormat};
use crate::geometry::{Pose3, StampedPose};
use crate::inertial::Gyroscope;
use crate::lidar::{Motion, PointTiming, Scan};

/// Where a scan is stored.
#[derive(Clone, Debug)]
pub enum ScanSource {
    /// A file.
    File {
        /// Its path.
        path: PathBuf,
        /// The stamp of its scan, to which times of points are relative [s]; `None` if unknown.
        stamp_s: Option<f64>,
        /// How its points are stored.
        format: PointFormat,
    },
    /// In memory; times of its points are those after the moment of the pose.
    Memory(Arc<Scan>),
    /// A message of a bag.
    #[cfg(feature = "bags")]
    Message {
        /// The bag.
        bag: Arc<Bag>,
        /// Topic of the scans.
        topic: Arc<str>,
        /// Number of the message among those of the topic.
        index: usize,
    },
}

impl ScanSource {
    fn read(&self) -> Result<Scan, RecordingError> {
        match self {
            Self::File {
                path,
                stamp_s,
                format,
            } => Ok(scan_files::read_formatted(path, *format, *stamp_s)?.scan),
            Self::Memory(scan) => Ok(Scan::clone(scan)),
            #[cfg(feature = "bags")]
            Self::Message { bag, topic, index } => bag.read_scan(topic, *index),
        }
    }
}

impl fmt::Display for ScanSource {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { path, .. } => write!(formatter, "{}", path.display()),
            Self::Memory(_) => formatter.write_str("a scan in memory"),
            #[cfg(feature = "bags")]
            Self::Message { topic, index, .. } => write!(formatter, "message {index} of {topic}"),
        }
    }
}

/// One frame of a recording; the scan is read by [`read`](Self::read).
#[derive(Clone, Debug)]
pub struct Frame {
    /// Number in the recording.
    pub number: usize,
    /// Where the scan is stored.
    pub source: ScanSource,
    /// Time of the scan's pose, since the start of the recording or since 1970 [s].
    pub time_s: f64,
    /// Given pose, `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Option<Pose3>,
    /// Source of the times of the points where the file has none.
    pub timing: Option<PointTiming>,
    /// Whether the points have times; otherwise the scan is taken as compensated.
    pub is_timed: bool,
    /// Angle that is added to the elevations of all points when the scan is read [rad].
    pub elevation_bias_rad: f64,
    /// Motion by which the scan is deskewed when it is read; `None` if it is not.
    pub motion: Option<Motion>,
    /// The sensor that has measured rotations between and within the scans; `None` without one.
    pub gyroscope: Option<Arc<Gyroscope>>,
}

impl Frame {
    /// A frame without a pose.
    pub fn new(number: usize, source: ScanSource, time_s: f64) -> Self {
        Self {
            number,
            source,
            time_s,
            map_from_lidar: None,
            timing: None,
            is_timed: true,
            elevation_bias_rad: 0.0,
            motion: None,
            gyroscope: None,
        }
    }

    /// Reads the scan and deskews it by the motion, if that is known.
    ///
    /// # Errors
    /// The file or message of the scan cannot be read.
    pub fn read(&self) -> Result<Scan, RecordingError> {
        let mut scan = self.source.read()?;
        scan.time_s = scan.time_s.or(Some(self.time_s));
        scan.raise(self.elevation_bias_rad);
        if let (true, Some(timing)) = (scan.times_s.is_empty(), &self.timing) {
            scan.times_s = timing.point_times(&scan);
        }
        if !matches!(self.source, ScanSource::Memory(_)) || self.timing.is_some() {
            scan.center_times();
        }
        if !self.is_timed {
            scan.times_s.clear();
        }
        scan.gyroscope = scan.gyroscope.or_else(|| self.gyroscope.clone());
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
