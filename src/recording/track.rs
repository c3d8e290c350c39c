//! Poses of a recording, and how they meet its scans.
//!
//! Poses and scans are matched by time where both have one: a pose is interpolated between the rows before
//! and after it. Otherwise the number of a scan is the row of its pose, from 0.

use std::path::{Path, PathBuf};

#[cfg(feature = "bags")]
use super::bags::{Bag, TopicKind};
use super::calibration::Calibration;
use super::error::RecordingError;
use super::frame::Frame;
use super::oxts;
use super::poses::{CameraPoses, ascending, read_rows_of_poses, read_times};
use crate::geometry::Pose3;
use crate::lidar::{Motion, PERIOD_S, interpolate_motion};

/// Longest time between two rows across which poses are interpolated [s].
const MAX_GAP_S: f64 = 2.0;

/// Poses of the sensor along a drive, at least one.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseTrack {
    /// The file.
    pub path: PathBuf,
    /// Poses of the lidar, in the frame of the first row unless moved by [`in_map`](Self::in_map).
    pub map_from_lidar: Vec<Pose3>,
    /// Their times, which ascend [s]; `None` if the file has none.
    pub times_s: Option<Vec<f64>>,
    /// Calibration: of the camera or another body whose poses the file has.
    pub calibration: Calibration,
    /// Frame of the poses in the world of the file.
    pub world_from_map: Pose3,
    /// Whether up to half of the frames may be without a pose: the truth of data sets begins late, or pauses.
    pub(super) is_partial: bool,
}

/// Whether so few frames have no pose that these can be left out: one and a hundredth of all, and not all.
pub(crate) fn may_be_missing(missing: usize, frames: usize) -> bool {
    missing <= 1 + frames / 100 && missing < frames
}

impl PoseTrack {
    /// Reads rows of KITTI (12 numbers: poses of the camera if there is a calibration, else of the lidar), rows of
    /// TUM (8 numbers: poses of the lidar), or a folder `oxts` of KITTI raw. Times are those of the rows, or
    /// of `times.txt` next to the file.
    ///
    /// # Errors
    /// The file cannot be read, or a row is no pose.
    pub fn read(path: &Path, calib_file: Option<&Path>) -> Result<Self, RecordingError> {
        if path.is_dir() {
            let (world_from_imu, calibration) = oxts::read(path)?;
            let camera = CameraPoses {
                world_from_cam0: world_from_imu,
            };
            return Self::of(path, camera, calibration, None);
        }
        let (camera, times_s) = read_rows_of_poses(path)?;
        let calibration = match (calib_file, &times_s) {
            (Some(calib_file), None) => Calibration::read(calib_file)?,
            _ => Calibration::identity(),
        };
        Self::of(path, camera, calibration, times_s)
    }

    /// Reads poses of a body on which the lidar is mounted, if its pose there is given, rows of KITTI or TUM; else as
    /// [`read`](Self::read).
    pub(crate) fn read_mounted(
        path: &Path,
        calib_file: Option<&Path>,
        body_from_lidar: Option<Pose3>,
    ) -> Result<Self, RecordingError> {
        let Some(body_from_lidar) = body_from_lidar else {
            return Self::read(path, calib_file);
        };
        let (body, times_s) = read_rows_of_poses(path)?;
        let calibration = Calibration {
            cam0_from_lidar: body_from_lidar,
        };
        Self::of(path, body, calibration, times_s)
    }

    /// Reads the poses of a topic of a bag, of the lidar or of a body on which it is mounted as given, else by the
    /// static transforms.
    ///
    /// # Errors
    /// There is no such topic, a message cannot be decoded, or the transforms do not join the frames.
    #[cfg(feature = "bags")]
    pub fn read_topic(
        bag: &Bag,
        topic: Option<&str>,
        scan_topic: &str,
        body_from_lidar: Option<Pose3>,
    ) -> Result<Self, RecordingError> {
        let topic = &bag.topic(TopicKind::Poses, topic)?.name;
        let rows = bag.poses(topic)?;
        let Some(first) = rows.first() else {
            let path = PathBuf::from(topic);
            return Err(RecordingError::NoPoses { path });
        };
        let found = match body_from_lidar {
            Some(given) => Some(given),
            None if first.child.is_empty() => {
                let topic = topic.clone();
                return Err(RecordingError::NoBody { topic });
            }
            None => bag.body_from_lidar(&first.child, scan_topic)?,
        };
        let Some(body_from_lidar) = found else {
            return Err(RecordingError::NoMounting {
                topic: topic.clone(),
                body: first.child.clone(),
                lidar: bag.scan_frame(scan_topic)?,
            });
        };
        let body = CameraPoses {
            world_from_cam0: rows.iter().map(|row| row.parent_from_child).collect(),
        };
        let calibration = Calibration {
            cam0_from_lidar: body_from_lidar,
        };
        let times_s = rows.iter().map(|row| row.time_s).collect();
        Self::of(Path::new(topic), body, calibration, Some(times_s))
    }

    /// Poses of the lidar in the frame of a map by their times, which ascend [s].
    pub fn from_poses(
        map_from_lidar: Vec<Pose3>,
        times_s: Vec<f64>,
        world_from_map: Pose3,
    ) -> Self {
        Self {
            path: PathBuf::from("the given poses"),
            map_from_lidar,
            times_s: Some(times_s),
            calibration: Calibration::identity(),
            world_from_map,
            is_partial: false,
        }
    }

    /// Poses of a camera or another body with its calibration; without times those of `times.txt` next to the file.
    pub(super) fn of(
        path: &Path,
        camera: CameraPoses,
        calibration: Calibration,
        times_s: Option<Vec<f64>>,
    ) -> Result<Self, RecordingError> {
        let map_from_lidar = camera.map_from_lidar(&calibration);
        let times_file = path.with_file_name("times.txt");
        let (times_path, times_s) = match times_s {
            Some(times_s) => (path.to_owned(), Some(times_s)),
            None if times_file.exists() => (times_file.clone(), Some(read_times(&times_file)?)),
            None => (path.to_owned(), None),
        };
        if let Some(times_s) = &times_s
            && times_s.len() != map_from_lidar.len()
        {
            return Err(RecordingError::WrongTimes {
                path: times_path,
                times: times_s.len(),
                poses: map_from_lidar.len(),
            });
        }
        Ok(Self {
            times_s: times_s.map(|t| ascending(&times_path, t)).transpose()?,
            world_from_map: camera.frame(&calibration).world_from_map(),
            calibration,
            path: path.to_owned(),
            map_from_lidar,
            is_partial: false,
        })
    }

    /// Transforms all poses into the frame of a map in the same world.
    #[must_use]
    pub fn in_map(mut self, world_from_map: &Pose3) -> Self {
        let map_from_track = world_from_map.inverse() * self.world_from_map;
        for pose in &mut self.map_from_lidar {
            *pose = map_from_track * *pose;
        }
        self.world_from_map = *world_from_map;
        self
    }

    /// The poses of frames. Frames after the last row or before the first are without one, with a
    /// warning; an error if these are more than one and a hundredth of the frames, or half of them in a data set.
    pub(crate) fn matched(
        &self,
        frames: &[Frame],
        have_times: bool,
    ) -> Result<Vec<Option<Pose3>>, RecordingError> {
        let poses: Vec<_> = (frames.iter())
            .map(|frame| self.pose_at(frame, have_times))
            .collect();
        let missing = || frames.iter().zip(&poses).filter(|(_, pose)| pose.is_none());
        let count = missing().count();
        if let Some((first, _)) = missing().next() {
            let is_partial = self.is_partial && 2 * count <= frames.len();
            if !is_partial && !may_be_missing(count, frames.len()) {
                return Err(self.mismatch(frames, have_times, first, count));
            }
            /// Frames in a message.
            const LISTED: usize = 100;
            let numbers: Vec<String> = (missing().take(LISTED))
                .map(|(frame, _)| frame.number.to_string())
                .collect();
            let rest = match count.saturating_sub(LISTED) {
                0 => String::new(),
                rest => format!(" and {rest} others"),
            };
            tracing::warn!(
                "{} has no pose for these frames: {}{rest}",
                self.path.display(),
                numbers.join(", ")
            );
        }
        Ok(poses)
    }

    fn mismatch(
        &self,
        frames: &[Frame],
        have_times: bool,
        first: &Frame,
        missing: usize,
    ) -> RecordingError {
        match &self.times_s {
            Some(times_s) if have_times => RecordingError::TimesDoNotMatch {
                pose_file: self.path.clone(),
                poses: times_s.len(),
                first_pose_s: times_s[0],
                last_pose_s: times_s[times_s.len() - 1],
                scans: frames.len(),
                first_scan_s: frames[0].time_s,
                last_scan_s: frames[frames.len() - 1].time_s,
                missing,
            },
            _ => RecordingError::ScanWithoutPose {
                scan: first.source.to_string(),
                pose_file: self.path.clone(),
                poses: self.map_from_lidar.len(),
            },
        }
    }

    /// Motion of the sensor around a frame; `None` if the frame has no pose, or the track only one.
    pub(crate) fn motion_at(&self, frame: &Frame, have_times: bool) -> Option<Motion> {
        self.at(frame, have_times)?.1
    }

    /// Pose of a frame; `None` if the track has none.
    pub(crate) fn pose_at(&self, frame: &Frame, have_times: bool) -> Option<Pose3> {
        Some(self.at(frame, have_times)?.0)
    }

    /// Pose of a frame and the motion around it.
    fn at(&self, frame: &Frame, have_times: bool) -> Option<(Pose3, Option<Motion>)> {
        let poses = &self.map_from_lidar;
        let Some(times_s) = self.times_s.as_ref().filter(|_| have_times) else {
            let pose = *poses.get(frame.number)?;
            // Two rows to each side: at an end the motion follows from the two steps next to it.
            let first = frame.number.saturating_sub(2);
            let around = first..(frame.number + 3).min(poses.len());
            let assumed_s = |row| PERIOD_S * row as f64;
            let times_s: Vec<f64> = match &self.times_s {
                Some(times_s) => times_s[around.clone()].to_vec(),
                None => around.clone().map(assumed_s).collect(),
            };
            let motion = Motion::along(&poses[around], &times_s, frame.number - first);
            return Some((pose, motion));
        };
        /// Differences of clocks and rounded times [s].
        const SAME_S: f64 = 1e-4;
        let after = times_s.partition_point(|&time_s| time_s <= frame.time_s);
        let nearest = |row: usize| (times_s[row] - frame.time_s).abs() <= SAME_S;
        for row in [after.saturating_sub(1), after.min(poses.len() - 1)] {
            if nearest(row) {
                return Some((poses[row], Motion::along(poses, times_s, row)));
            }
        }
        // The interval around the time, or the first or last, which is continued by its own length.
        let after = after.clamp(1, poses.len().checked_sub(1).filter(|&last| last > 0)?);
        let interval = Motion {
            previous_from_current: poses[after - 1].inverse() * poses[after],
            duration_s: times_s[after] - times_s[after - 1],
        };
        let since_s = frame.time_s - times_s[after - 1];
        let is_near = (-interval.duration_s..=2.0 * interval.duration_s).contains(&since_s);
        if !is_near || interval.duration_s > MAX_GAP_S {
            return None;
        }
        let share = since_s / interval.duration_s;
        let moved = interpolate_motion(&interval.previous_from_current, share);
        Some((poses[after - 1] * moved, Some(interval)))
    }
}
