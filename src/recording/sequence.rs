//! A recording: its selected scans with their poses and times.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::calibration::Calibration;
use super::error::RecordingError;
use super::poses::{DrivePoses, read_times};
use super::scan_files;
use super::velodyne::read_bytes;
use crate::geometry::{Pose3, StampedPose};
use crate::lidar::{Motion, Rotation, RotationDirection, Scan};
use crate::validation::{InvalidValue, Validate, require};

/// Revolutions per second of the sensor, for recordings without `times.txt`.
const SCANS_PER_SECOND: f64 = 10.0;

/// Selected frames of a recording: `start_idx`, `start_idx + frame_step`, ...
///
/// Defaults: every frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct Selection {
    /// First frame.
    pub start_idx: usize,
    /// Number of consecutive scans to select from; -1 for all.
    #[default(-1)]
    pub n_scans: i64,
    /// Every n-th of them is selected.
    #[default(1)]
    pub frame_step: usize,
}

impl Validate for Selection {
    fn validate(&self) -> Result<(), InvalidValue> {
        require(
            self.n_scans == -1 || self.n_scans >= 1,
            "n_scans",
            self.n_scans,
            "it must be 1 or greater, or -1 for all scans",
        )?;
        require(
            self.frame_step >= 1,
            "frame_step",
            self.frame_step,
            "1 takes every frame, 2 every other one",
        )
    }
}

/// One frame of a recording; the scan is read by [`read`](Self::read).
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Number in the recording.
    pub number: usize,
    /// The scan's file.
    pub scan_path: PathBuf,
    /// Time since the start of the recording [s].
    pub time_s: f64,
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Pose3,
    /// Rotation of the sensor, from which the times of the points follow where the file has none.
    pub rotation: Option<Rotation>,
    /// Motion by which the scan is deskewed when it is read; `None` if it is not.
    pub motion: Option<Motion>,
}

impl Frame {
    /// Reads the scan and deskews it by the motion, if that is known.
    pub fn read(&self) -> Result<Scan, RecordingError> {
        self.parse(&read_bytes(&self.scan_path)?)
    }

    /// Reads the scan from the content of its file, as [`read`](Self::read) does.
    pub fn parse(&self, bytes: &[u8]) -> Result<Scan, RecordingError> {
        let mut scan = scan_files::parse(&self.scan_path, bytes)?;
        scan.time_s = Some(self.time_s);
        if let (true, Some(rotation)) = (scan.times_s.is_empty(), &self.rotation) {
            scan.times_s = rotation.point_times(&scan.points);
        }
        if let Some(motion) = &self.motion {
            motion.deskew(&mut scan);
        }
        Ok(scan)
    }

    /// The pose with its frame number and time.
    pub fn stamped(&self) -> StampedPose {
        StampedPose {
            frame: self.number,
            time_s: self.time_s,
            map_from_lidar: self.map_from_lidar,
        }
    }
}

/// A recording with its selected frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Sequence {
    /// The selected frames, ascending.
    pub frames: Vec<Frame>,
    /// All lidar poses of the recording in the frame of the first.
    pub map_from_lidar: Vec<Pose3>,
    /// Their times [s].
    pub times_s: Vec<f64>,
    /// Calibration of the recording.
    pub calibration: Calibration,
    /// Frame of all poses of this sequence in the world of its camera poses.
    pub world_from_map: Pose3,
}

impl Sequence {
    /// Opens a recording without reading its scans.
    ///
    /// Scans are the files below `scan_folder` that [`scan_files`] reads, without hidden ones. If their names are
    /// numbers, the number is the row of the pose file, from 0, so that a part of a recording keeps
    /// its poses; if none is a number, the position in the order of their paths is. A mixture, and
    /// a number that two scans have, are errors. Times are read from `times.txt` beside the pose
    /// file if it exists; they must ascend.
    pub fn open(
        scan_folder: &Path,
        pose_file: &Path,
        calib_file: Option<&Path>,
        selection: &Selection,
    ) -> Result<Self, RecordingError> {
        let poses = DrivePoses::read(pose_file, calib_file)?;
        let map_from_lidar = poses.map_from_lidar();
        let times_s = frame_times(pose_file, poses.times_s.as_deref(), map_from_lidar.len())?;
        let mut frames = Vec::new();
        for (number, scan_path) in selected_scans(scan_folder, selection)? {
            let Some(&pose) = map_from_lidar.get(number) else {
                return Err(RecordingError::ScanWithoutPose {
                    scan: scan_path,
                    pose_file: pose_file.to_owned(),
                    poses: map_from_lidar.len(),
                });
            };
            frames.push(Frame {
                number,
                scan_path,
                time_s: times_s[number],
                map_from_lidar: pose,
                rotation: None,
                motion: None,
            });
        }
        Ok(Self {
            frames,
            map_from_lidar,
            times_s,
            calibration: poses.calibration,
            world_from_map: poses.world_from_map(),
        })
    }

    /// Opens a folder in the layout of KITTI: `velodyne/`, `poses.txt` and `calib.txt`.
    pub fn open_folder(folder: &Path) -> Result<Self, RecordingError> {
        let [scans, poses, calibration] =
            ["velodyne", "poses.txt", "calib.txt"].map(|name| folder.join(name));
        Self::open(&scans, &poses, Some(&calibration), &Selection::default())
    }

    /// Reads the scans, one after the other, with their poses `map_from_lidar`.
    pub fn scans(&self) -> impl Iterator<Item = Result<(Scan, Pose3), RecordingError>> {
        let read = |frame: &Frame| Ok((frame.read()?, frame.map_from_lidar));
        self.frames.iter().map(read)
    }

    /// The same sequence, whose points have times from the rotation of the sensor.
    #[must_use]
    pub fn rotating(mut self, direction: Option<RotationDirection>) -> Self {
        let rotation = direction.map(|direction| Rotation {
            direction,
            period_s: 1.0 / SCANS_PER_SECOND,
        });
        for frame in &mut self.frames {
            frame.rotation = rotation;
        }
        self
    }

    /// The same sequence, whose scans are deskewed by the poses of the recording.
    #[must_use]
    pub fn compensated_by_poses(mut self) -> Self {
        for frame in &mut self.frames {
            frame.motion = Motion::along(&self.map_from_lidar, &self.times_s, frame.number);
        }
        self
    }

    /// Transforms all poses into the frame of a map in the same world.
    #[must_use]
    pub fn in_map(mut self, world_from_map: &Pose3) -> Self {
        let map_from_recording = world_from_map.inverse() * self.world_from_map;
        for pose in &mut self.map_from_lidar {
            *pose = map_from_recording * *pose;
        }
        for frame in &mut self.frames {
            frame.map_from_lidar = map_from_recording * frame.map_from_lidar;
        }
        self.world_from_map = *world_from_map;
        self
    }
}

/// The selected scans below a folder with their numbers, ascending; see [`Sequence::open`].
pub fn selected_scans(
    folder: &Path,
    selection: &Selection,
) -> Result<Vec<(usize, PathBuf)>, RecordingError> {
    let scans = numbered(scan_paths(folder)?)?;
    let count = scans.len();
    let window = usize::try_from(selection.n_scans).unwrap_or(usize::MAX);
    let window_end = selection.start_idx.saturating_add(window);
    let selected: Vec<(usize, PathBuf)> = (scans.into_iter())
        .filter(|(number, _)| {
            let in_window = (selection.start_idx..window_end).contains(number);
            in_window && (number - selection.start_idx).is_multiple_of(selection.frame_step)
        })
        .collect();
    if selected.is_empty() {
        return Err(RecordingError::NothingSelected {
            path: folder.to_owned(),
            start_idx: selection.start_idx,
            n_scans: selection.n_scans,
            frame_step: selection.frame_step,
            scans: count,
        });
    }
    Ok(selected)
}

/// All scans below a folder, sorted by path, without hidden files and folders. A folder that
/// is linked more than once is read once.
pub fn scan_paths(folder: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let mut paths = Vec::new();
    let mut folders = vec![folder.to_owned()];
    let mut visited = BTreeSet::new();
    while let Some(folder) = folders.pop() {
        let read_error = || RecordingError::read(&folder);
        if !visited.insert(folder.canonicalize().map_err(read_error())?) {
            continue;
        }
        for entry in fs::read_dir(&folder).map_err(read_error())? {
            let path = entry.map_err(read_error())?.path();
            let is_hidden = (path.file_name()).is_some_and(|n| n.as_encoded_bytes()[0] == b'.');
            if is_hidden {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else if scan_files::is_scan(&path) {
                paths.push(path);
            }
        }
    }
    if paths.is_empty() {
        return Err(RecordingError::NoScans {
            path: folder.to_owned(),
        });
    }
    paths.sort();
    Ok(paths)
}

/// Scans with their numbers, ascending: those in their names, or, if no name is a number, their
/// positions.
fn numbered(scans: Vec<PathBuf>) -> Result<Vec<(usize, PathBuf)>, RecordingError> {
    // The name of nuScenes' scans is `000000.pcd.bin`.
    let number_of = |path: &PathBuf| {
        let name = path.file_name()?.to_str()?;
        name.split('.').next()?.parse::<usize>().ok()
    };
    let Some(first) = scans.iter().find(|path| number_of(path).is_some()).cloned() else {
        return Ok(scans.into_iter().enumerate().collect());
    };
    let mut numbered = Vec::with_capacity(scans.len());
    for path in scans {
        let Some(number) = number_of(&path) else {
            return Err(RecordingError::MixedNames {
                number: first,
                word: path,
            });
        };
        numbered.push((number, path));
    }
    numbered.sort();
    for pair in numbered.windows(2) {
        if pair[0].0 == pair[1].0 {
            return Err(RecordingError::SameNumber {
                first: pair[0].1.clone(),
                second: pair[1].1.clone(),
            });
        }
    }
    Ok(numbered)
}

/// Times of the poses: those of `times.txt` beside the pose file, else those in the pose file.
fn frame_times(
    pose_file: &Path,
    own_s: Option<&[f64]>,
    poses: usize,
) -> Result<Vec<f64>, RecordingError> {
    let beside = pose_file.with_file_name("times.txt");
    let (path, times_s) = match own_s {
        _ if beside.exists() => (beside.clone(), read_times(&beside)?),
        Some(own_s) => (pose_file.to_owned(), own_s.to_vec()),
        None => return Ok((0..poses).map(|i| i as f64 / SCANS_PER_SECOND).collect()),
    };
    if times_s.len() != poses {
        return Err(RecordingError::WrongTimes {
            path,
            times: times_s.len(),
            poses,
        });
    }
    match times_s.windows(2).position(|pair| pair[1] <= pair[0]) {
        Some(frame) => Err(RecordingError::TimesDoNotAscend {
            path,
            frame: frame + 1,
            time_s: times_s[frame + 1],
            previous_s: times_s[frame],
        }),
        None => Ok(times_s),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recording(scans: &[&str], poses: usize) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let velodyne = folder.path().join("velodyne");
        fs::create_dir(&velodyne).unwrap();
        for name in scans {
            fs::write(velodyne.join(name), []).unwrap();
        }
        let row = "1 0 0 0 0 1 0 0 0 0 1 0\n";
        fs::write(folder.path().join("poses.txt"), row.repeat(poses)).unwrap();
        fs::write(folder.path().join("calib.txt"), format!("Tr: {row}")).unwrap();
        folder
    }

    fn open(folder: &Path, selection: &Selection) -> Result<Sequence, RecordingError> {
        Sequence::open(
            &folder.join("velodyne"),
            &folder.join("poses.txt"),
            Some(&folder.join("calib.txt")),
            selection,
        )
    }

    fn numbers(sequence: &Sequence) -> Vec<usize> {
        sequence.frames.iter().map(|frame| frame.number).collect()
    }

    #[test]
    fn even_and_odd_frames_partition_the_recording() {
        let names: Vec<String> = (0..9).map(|i| format!("{i:06}.bin")).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let folder = recording(&names, 9);
        let step = |start_idx| Selection {
            start_idx,
            frame_step: 2,
            ..Selection::default()
        };
        let even = open(folder.path(), &step(0)).unwrap();
        let odd = open(folder.path(), &step(1)).unwrap();
        assert_eq!(numbers(&even), [0, 2, 4, 6, 8]);
        assert_eq!(numbers(&odd), [1, 3, 5, 7]);
    }

    #[test]
    fn scans_with_numbers_as_names_keep_their_poses() {
        let folder = recording(&["000005.bin", "000007.bin"], 10);
        let sequence = open(folder.path(), &Selection::default()).unwrap();
        assert_eq!(numbers(&sequence), [5, 7]);
        assert_eq!(sequence.frames[0].time_s, 0.5);
    }

    #[test]
    fn scans_without_numbers_as_names_are_numbered_by_position() {
        let folder = recording(&["a.bin", "b.bin"], 2);
        assert_eq!(
            numbers(&open(folder.path(), &Selection::default()).unwrap()),
            [0, 1]
        );
    }

    #[test]
    fn numbers_are_sorted_as_numbers() {
        let folder = recording(&["10.bin", "2.bin", "1.bin"], 11);
        let sequence = open(folder.path(), &Selection::default()).unwrap();
        assert_eq!(numbers(&sequence), [1, 2, 10]);
    }

    #[test]
    fn hidden_files_are_ignored_and_names_that_are_partly_numbers_are_an_error() {
        let names = ["000000.bin", "000001.bin", "._000000.bin"];
        let folder = recording(&names, 2);
        let sequence = open(folder.path(), &Selection::default()).unwrap();
        assert_eq!(numbers(&sequence), [0, 1]);
        let copy = folder.path().join("velodyne/000000 (copy).bin");
        fs::write(&copy, []).unwrap();
        let result = open(folder.path(), &Selection::default());
        let message = result.unwrap_err().to_string();
        assert!(message.contains("000000 (copy).bin"), "{message}");
        fs::rename(copy, folder.path().join("velodyne/0.bin")).unwrap();
        let result = open(folder.path(), &Selection::default());
        assert!(matches!(result, Err(RecordingError::SameNumber { .. })));
    }

    #[cfg(unix)]
    #[test]
    fn a_loop_of_links_does_not_multiply_the_recording() {
        let folder = recording(&["a.bin", "b.bin"], 2);
        let velodyne = folder.path().join("velodyne");
        std::os::unix::fs::symlink(&velodyne, velodyne.join("loop")).unwrap();
        assert_eq!(scan_paths(&velodyne).unwrap().len(), 2);
    }

    #[test]
    fn times_that_do_not_ascend_are_an_error() {
        let folder = recording(&["000000.bin"], 3);
        for times in ["0\n0.1\n0.1\n", "0\n0.2\n0.1\n"] {
            fs::write(folder.path().join("times.txt"), times).unwrap();
            let result = open(folder.path(), &Selection::default());
            let message = result.unwrap_err().to_string();
            assert!(message.contains("frame 2"), "{message}");
        }
    }

    #[test]
    fn a_selected_scan_without_a_pose_is_an_error() {
        let folder = recording(&["000000.bin", "000001.bin"], 1);
        let message = open(folder.path(), &Selection::default())
            .unwrap_err()
            .to_string();
        assert!(message.contains("000001.bin has no pose"), "{message}");
        let first = Selection {
            n_scans: 1,
            ..Selection::default()
        };
        assert_eq!(numbers(&open(folder.path(), &first).unwrap()), [0]);
    }

    #[test]
    fn times_are_read_and_their_number_is_checked() {
        let folder = recording(&["000000.bin", "000001.bin"], 2);
        fs::write(folder.path().join("times.txt"), "0.0\n0.104\n").unwrap();
        let sequence = open(folder.path(), &Selection::default()).unwrap();
        assert_eq!(sequence.frames[1].time_s, 0.104);
        fs::write(folder.path().join("times.txt"), "0.0\n").unwrap();
        let message = open(folder.path(), &Selection::default())
            .unwrap_err()
            .to_string();
        assert!(message.contains("1 times for 2 poses"), "{message}");
    }
}
