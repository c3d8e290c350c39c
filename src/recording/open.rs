//! A recording: its selected scans with their times.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

#[cfg(feature = "bags")]
use super::bags::{Bag, TopicKind, is_bag};
use super::calibration::Calibration;
use super::error::RecordingError;
use super::fixes;
use super::frame::{Frame, ScanSource};
use super::layout::{Layout, RecordingFiles};
use super::layouts;
use super::oxts::read_timestamps;
use super::poses::{ascending, read_rows_of_poses, read_times};
use super::scan_files;
use super::scan_list::{self, ScanFile, Selection};
use super::track::PoseTrack;
use crate::geometry::Pose3;
use crate::georeference::GeodeticFixes;
use crate::inertial::Imu;
use crate::lidar::{PointTiming, Scan};
use crate::memory::MemoryBudget;

/// Revolutions per second of the sensor, for recordings without times.
const SCANS_PER_SECOND: f64 = 10.0;

/// Where the times of scans are from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TimeSource {
    /// The names of the files of the scans.
    Names,
    /// A file: of times, or of poses with a row per scan.
    File(PathBuf),
    /// The messages of a bag.
    Messages,
}

impl fmt::Display for TimeSource {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Names => formatter.write_str("names"),
            Self::File(path) => write!(formatter, "{}", path.display()),
            Self::Messages => formatter.write_str("messages"),
        }
    }
}

/// A recording with its selected frames.
#[derive(Clone, Debug)]
pub struct Recording {
    /// The folder or bag that was opened.
    pub path: PathBuf,
    /// Its files.
    pub files: RecordingFiles,
    /// Number of all scans.
    pub scans: usize,
    /// Whether the times were recorded; otherwise ten scans per second are assumed.
    pub has_times: bool,
    /// Where recorded times are from; `None` if there are none, and of scans in memory.
    pub time_source: Option<TimeSource>,
    /// The selected frames, ascending.
    pub frames: Vec<Frame>,
    /// The frames that are not selected between the first and the last of these, ascending.
    pub skipped: Vec<Frame>,
    /// The given poses, of which the frames have theirs.
    pub track: Option<PoseTrack>,
    /// Pose of the lidar on the body whose poses a bag has; `None`: that of its static transforms.
    pub body_from_lidar: Option<Pose3>,
    /// The inertial sensor, whose axes and clock need not be known.
    pub imu: Option<Imu>,
    /// The bag and the topic of its scans.
    #[cfg(feature = "bags")]
    pub bag: Option<(Arc<Bag>, Arc<str>)>,
}

/// Whether a path can be the name of a topic.
pub(crate) fn is_topic(path: &Path) -> bool {
    path.starts_with("/") && !path.exists()
}

impl Recording {
    /// Opens a recording; of its scans, only the first one is read, if its points can have times.
    ///
    /// `path` is the folder of a recording in one of the layouts of [`Layout`], the folder of its scans, or a bag. Times
    /// are those of a bag, those in the names of the scans, else those of `times.txt` (`timestamps.txt` of KITTI raw),
    /// which must ascend.
    ///
    /// # Errors
    /// There are no scans, or their times do not ascend or cannot be read.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, RecordingError> {
        let all = Selection::default();
        Self::open_with(path.as_ref(), None, None, &all, MemoryBudget::default())
    }

    /// Opens the selected frames of a recording in a layout, or in the one that its files show. Where it has scans of several
    /// lidars or scenes, `topic` names one: a topic of a bag, a lidar of HeLiPR, or a scene of nuScenes. The index of a bag
    /// is within the budget.
    ///
    /// # Errors
    /// As [`open`](Self::open); the selection is empty, the recording is in another layout, or there is no such topic.
    pub fn open_with(
        path: &Path,
        layout: Option<Layout>,
        topic: Option<&str>,
        selection: &Selection,
        memory_budget: MemoryBudget,
    ) -> Result<Self, RecordingError> {
        #[cfg(not(feature = "bags"))]
        let _ = memory_budget;
        #[cfg(feature = "bags")]
        if is_bag(path) && layout.is_none_or(|layout| layout == Layout::Bag) {
            return Self::open_bag(path, topic, selection, memory_budget);
        }
        let mut files = layouts::find(path, layout, topic)?;
        let listed = files.listed.take();
        let is_listed = listed.is_some();
        let scans = match listed {
            Some(listed) if listed.is_empty() => {
                let path = files.scans;
                return Err(RecordingError::NoScans { path });
            }
            Some(listed) => listed,
            None => scan_list::scan_files(&files.scans)?,
        };
        let format = files.format;
        let rows = scans.last().map_or(0, |last| last.number + 1);
        let (time_source, recorded_s) = if is_listed {
            (files.poses.clone().map(TimeSource::File), None)
        } else if scans[0].time_s.is_some() {
            tracing::info!("the times of the scans are those in their names");
            (Some(TimeSource::Names), None)
        } else {
            let found = recorded_times(&files, rows)?;
            found
                .map(|(path, times_s)| (TimeSource::File(path), times_s))
                .unzip()
        };
        let has_times = time_source.is_some();
        let count = scans.len();
        let frame = |scan: ScanFile| {
            let row = || recorded_s.as_ref()?.get(scan.number).copied();
            let stamp_s = scan.time_s.or_else(row);
            let assumed_s = (!has_times).then_some(scan.number as f64 / SCANS_PER_SECOND);
            let Some(time_s) = stamp_s.or(assumed_s) else {
                return Err(RecordingError::ScanWithoutTime {
                    scan: scan.path,
                    times: recorded_s.as_ref().map_or(0, Vec::len),
                });
            };
            let path = scan.path;
            let source = ScanSource::File {
                path,
                stamp_s,
                format,
            };
            Ok(Frame::new(scan.number, source, time_s))
        };
        let frames: Vec<Frame> = scans.into_iter().map(frame).collect::<Result<_, _>>()?;
        let (mut frames, mut skipped) = selection.of(frames, |frame| frame.number, path)?;
        let later_s = moment_after_stamp_s(&frames[0].source)?;
        for frame in frames.iter_mut().chain(&mut skipped) {
            frame.time_s += later_s;
        }
        Ok(Self {
            path: path.to_owned(),
            time_source,
            skipped,
            ..Self::new(files, count, has_times, frames)
        })
    }

    /// Opens a bag. Its index has the times of writing; the moment of the first scan gives the difference to
    /// those of the poses.
    #[cfg(feature = "bags")]
    fn open_bag(
        path: &Path,
        topic: Option<&str>,
        selection: &Selection,
        memory_budget: MemoryBudget,
    ) -> Result<Self, RecordingError> {
        let bag = Arc::new(Bag::open_within(path, memory_budget)?);
        let topic: Arc<str> = bag.topic(TopicKind::Scans, topic)?.name.as_str().into();
        let times_s = bag.scan_times(&topic)?;
        let moment_s = bag.read_scan(&topic, 0)?.time_s;
        let later_s = moment_s.map_or(0.0, |moment_s| moment_s - times_s[0]);
        let frame = |(index, time_s): (usize, &f64)| {
            let source = ScanSource::Message {
                bag: bag.clone(),
                topic: topic.clone(),
                index,
            };
            Frame::new(index, source, time_s + later_s)
        };
        let frames = times_s.iter().enumerate().map(frame).collect();
        let (frames, skipped) = selection.of(frames, |frame: &Frame| frame.number, path)?;
        Ok(Self {
            path: path.to_owned(),
            time_source: Some(TimeSource::Messages),
            skipped,
            bag: Some((bag, topic)),
            ..Self::new(RecordingFiles::bag(path), times_s.len(), true, frames)
        })
    }

    /// A recording of scans in memory, without poses. Times of points are those after the moment of the pose; scans of
    /// which one has no time are taken as ten per second.
    pub fn from_scans(scans: impl IntoIterator<Item = impl Into<Arc<Scan>>>) -> Self {
        let scans: Vec<Arc<Scan>> = scans.into_iter().map(Into::into).collect();
        let has_times = scans.iter().all(|scan| scan.time_s.is_some());
        let frame = |(number, scan): (usize, Arc<Scan>)| {
            let assumed_s = number as f64 / SCANS_PER_SECOND;
            let time_s = scan.time_s.filter(|_| has_times).unwrap_or(assumed_s);
            Frame::new(number, ScanSource::Memory(scan), time_s)
        };
        let count = scans.len();
        let frames = scans.into_iter().enumerate().map(frame).collect();
        Self::new(
            RecordingFiles::without_files(Layout::Memory),
            count,
            has_times,
            frames,
        )
    }

    fn new(files: RecordingFiles, scans: usize, has_times: bool, frames: Vec<Frame>) -> Self {
        Self {
            path: PathBuf::new(),
            files,
            scans,
            has_times,
            time_source: None,
            frames,
            skipped: vec![],
            track: None,
            body_from_lidar: None,
            imu: None,
            #[cfg(feature = "bags")]
            bag: None,
        }
    }

    /// The poses that belong to the recording by their names and places; those of a bag have to be named, by
    /// [`read_track`](Self::read_track).
    ///
    /// # Errors
    /// The recording has no such poses, or they cannot be read.
    pub fn own_track(&self) -> Result<PoseTrack, RecordingError> {
        #[cfg(feature = "bags")]
        if let Some((bag, _)) = &self.bag {
            return Err(bag.topics_of_poses_not_named());
        }
        let Some(path) = &self.files.poses else {
            return Err(RecordingError::NoPoseFile {
                path: self.path.clone(),
            });
        };
        let calibration = self.files.calibration.as_deref();
        layouts::read_poses(&self.files).unwrap_or_else(|| PoseTrack::read(path, calibration))
    }

    /// The poses of the only topic of poses in a bag, as odometry: only the motion between them is used.
    pub(crate) fn odometry_track(&self) -> Result<PoseTrack, RecordingError> {
        #[cfg(feature = "bags")]
        if let Some((bag, topic)) = &self.bag {
            return PoseTrack::read_topic(bag, None, topic, self.body_from_lidar);
        }
        self.own_track()
    }

    /// Reads poses of this recording from a file, a folder `oxts`, or a topic of its bag; they are those of a body if its
    /// mounting is known, else of the camera of a calibration, else of the lidar.
    ///
    /// # Errors
    /// The poses cannot be read.
    pub fn read_track(
        &self,
        path: &Path,
        calib_file: Option<&Path>,
    ) -> Result<PoseTrack, RecordingError> {
        #[cfg(feature = "bags")]
        if let (Some((bag, topic)), true) = (&self.bag, is_topic(path)) {
            return PoseTrack::read_topic(bag, path.to_str(), topic, self.body_from_lidar);
        }
        // The poses of a data set are in a format of its own.
        let own = self.files.poses.as_deref();
        if own.is_some_and(|own| is_same_file(own, path))
            && let Some(track) = layouts::read_poses(&self.files)
        {
            return track;
        }
        PoseTrack::read_mounted(path, calib_file, self.body_from_lidar)
    }

    /// Reads positions of a GNSS receiver from a file, a folder `oxts`, or a topic of the bag of this recording.
    ///
    /// # Errors
    /// The positions cannot be read, or there are none.
    pub fn read_fixes(&self, path: &Path) -> Result<GeodeticFixes, RecordingError> {
        #[cfg(feature = "bags")]
        if let (Some((bag, topic)), true) = (&self.bag, is_topic(path)) {
            return bag.fixes(&path.to_string_lossy(), topic);
        }
        fixes::read(path)
    }

    /// The same recording with the poses that it contains, `map_from_lidar` in the frame of the first of them.
    ///
    /// # Errors
    /// The recording has no poses, they cannot be read, or do not belong to its frames.
    pub fn with_own_poses(self) -> Result<Self, RecordingError> {
        let track = self.own_track()?;
        self.with_poses(track)
    }

    /// The same recording, whose frames have the poses of a track, and its times where they have none; frames without a pose
    /// are dropped.
    ///
    /// # Errors
    /// The track does not belong to these frames.
    pub fn with_poses(mut self, track: PoseTrack) -> Result<Self, RecordingError> {
        if !self.has_times
            && let Some(times_s) = &track.times_s
        {
            tracing::info!(
                "the times of the scans are those of {}",
                track.path.display()
            );
            for frame in self.frames.iter_mut().chain(&mut self.skipped) {
                frame.time_s = times_s.get(frame.number).copied().unwrap_or(frame.time_s);
            }
        }
        let mut posed = self.with_truth(track)?;
        posed.frames.retain(|frame| frame.map_from_lidar.is_some());
        Ok(posed)
    }

    /// The same recording, whose frames have the poses of a track as the truth that estimates are compared with, where it has
    /// one: its times are not used, and frames without one are kept.
    ///
    /// # Errors
    /// As [`with_poses`](Self::with_poses).
    pub(crate) fn with_truth(mut self, track: PoseTrack) -> Result<Self, RecordingError> {
        let poses = track.matched(&self.frames, self.has_times)?;
        for (frame, pose) in self.frames.iter_mut().zip(poses) {
            frame.map_from_lidar = pose;
        }
        self.track = Some(track);
        Ok(self)
    }

    /// The same recording, whose frames have no poses.
    #[must_use]
    pub fn without_poses(mut self) -> Self {
        for frame in &mut self.frames {
            frame.map_from_lidar = None;
        }
        self.track = None;
        self
    }

    /// Reads the scans of the selected frames, one after the other.
    ///
    /// # Errors
    /// An item is the error of its scan; those after it can be read.
    pub fn scans(&self) -> impl Iterator<Item = Result<Scan, RecordingError>> {
        self.frames.iter().map(Frame::read)
    }

    /// All frames from the first selected one to the last, also those between, ascending.
    pub(crate) fn dense_frames(&self) -> Vec<Frame> {
        let mut frames: Vec<Frame> = (self.frames.iter().chain(&self.skipped)).cloned().collect();
        frames.sort_by_key(|frame| frame.number);
        frames
    }

    /// The same recording, whose scans are compensated already: times of points are ignored.
    #[must_use]
    pub fn compensated(mut self) -> Self {
        for frame in self.frames.iter_mut().chain(&mut self.skipped) {
            frame.is_timed = false;
        }
        self
    }

    /// The same recording, with an angle added to the elevations of all points [rad].
    #[must_use]
    pub fn with_elevation_bias(mut self, bias_rad: f64) -> Self {
        for frame in self.frames.iter_mut().chain(&mut self.skipped) {
            frame.elevation_bias_rad = bias_rad;
        }
        self
    }

    /// The same recording, whose points have times where the data have none.
    #[must_use]
    pub fn timed(mut self, timing: Option<PointTiming>) -> Self {
        for frame in self.frames.iter_mut().chain(&mut self.skipped) {
            frame.timing = timing;
        }
        self
    }

    /// The same recording, whose scans are deskewed by its poses, with the rotations of its inertial sensor where it has one.
    #[must_use]
    pub fn compensated_by_poses(self) -> Self {
        let mut recorded = self.with_gyroscope_of_poses();
        if let Some(track) = &recorded.track {
            for frame in &mut recorded.frames {
                frame.motion = track.motion_at(frame, recorded.has_times);
            }
        }
        recorded
    }

    /// The frame of the poses in the world of their file, and the calibration; identities without poses.
    pub fn world(&self) -> (Pose3, Calibration) {
        let track = self.track.as_ref();
        (
            track.map_or_else(Pose3::identity, |track| track.world_from_map),
            track.map_or_else(Calibration::identity, |track| track.calibration),
        )
    }
}

/// Whether two paths lead to one file.
fn is_same_file(a: &Path, b: &Path) -> bool {
    let canonical = |path: &Path| path.canonicalize().ok();
    a == b || canonical(a).is_some_and(|a| Some(a) == canonical(b))
}

/// Time from the stamp of a scan of a file to its moment, the middle of its sweep [s]; 0 without times of points.
fn moment_after_stamp_s(source: &ScanSource) -> Result<f64, RecordingError> {
    let ScanSource::File {
        path,
        stamp_s,
        format,
    } = source
    else {
        return Ok(0.0);
    };
    if !scan_files::has_named_columns(path, *format) {
        return Ok(0.0);
    }
    let read = scan_files::read_formatted(path, *format, *stamp_s)?;
    if read.has_unknown_times {
        tracing::warn!(
            "{}: the times of the points are ignored: in no unit do they last 10 ms to 1 s",
            path.display()
        );
    }
    let later_s = read.scan.time_s.zip(*stamp_s);
    Ok(later_s.map_or(0.0, |(moment_s, stamp_s)| moment_s - stamp_s))
}

/// The times of scans [s] and their file: of the recording's file of times, else of one in the folder above or of its poses,
/// where these have as many rows as the scans need.
fn recorded_times(
    files: &RecordingFiles,
    rows: usize,
) -> Result<Option<(PathBuf, Vec<f64>)>, RecordingError> {
    let ascending = |path: &Path, times_s| Ok(Some((path.to_owned(), ascending(path, times_s)?)));
    if let Some(path) = &files.times {
        let times_s = match files.layout {
            Layout::KittiRaw | Layout::Kitti360 => read_timestamps(path)?,
            _ => read_times(path)?,
        };
        return ascending(path, times_s);
    }
    let is_fitting = |times_s: &Vec<f64>| times_s.len() == rows;
    let above = files
        .times_above
        .as_ref()
        .map(|path| Ok((path, read_times(path)?)));
    let above = above
        .transpose()?
        .filter(|(_, times_s)| is_fitting(times_s));
    // Poses that cannot be read are an error where poses are needed.
    let of_poses = || {
        let path = files.poses.as_ref().filter(|path| path.is_file())?;
        let (_, times_s) = read_rows_of_poses(path).ok()?;
        Some((path, times_s.filter(is_fitting)?))
    };
    let Some((path, times_s)) = above.or_else(of_poses) else {
        return Ok(None);
    };
    tracing::info!("the times of the scans are those of {}", path.display());
    ascending(path, times_s)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::recording::scan_list::scan_paths;

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

    fn open(folder: &Path, selection: &Selection) -> Result<Recording, RecordingError> {
        let budget = MemoryBudget::default();
        Recording::open_with(folder, None, None, selection, budget)?.with_own_poses()
    }

    fn numbers(recording: &Recording) -> Vec<usize> {
        recording.frames.iter().map(|frame| frame.number).collect()
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
        let recording = open(folder.path(), &Selection::default()).unwrap();
        assert_eq!(numbers(&recording), [5, 7]);
        assert_eq!(recording.frames[0].time_s, 0.5);
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
    fn times_are_those_of_names_of_the_folder_above_or_of_a_row_of_poses_per_scan() {
        let times_of = |folder: &tempfile::TempDir| {
            let recording = Recording::open(folder.path().join("inner")).unwrap();
            let times: Vec<f64> = recording.frames.iter().map(|it| it.time_s).collect();
            (times, recording.has_times)
        };
        let scans = |names: &[&str]| {
            let folder = tempfile::tempdir().unwrap();
            fs::create_dir(folder.path().join("inner")).unwrap();
            for name in names {
                fs::write(folder.path().join("inner").join(name), []).unwrap();
            }
            folder
        };
        let named = scans(&[
            "cloud_1317384506_5000000.bin",
            "cloud_1317384506_40000000.bin",
        ]);
        let opened = Recording::open(named.path().join("inner")).unwrap();
        assert_eq!(opened.time_source, Some(TimeSource::Names));
        assert_eq!(
            times_of(&named),
            (vec![1317384506.005, 1317384506.04], true)
        );
        let nuscenes = scans(&[
            "n015-2018-07-24__LIDAR_TOP__1532402927647951.bin",
            "n015-2018-07-24__LIDAR_TOP__1532402928147847.bin",
        ]);
        let expected = vec![1532402927.647951, 1532402928.147847];
        assert_eq!(times_of(&nuscenes), (expected, true));
        // Ten digits of KITTI raw are a number.
        let raw = scans(&["0000000000.bin", "0000000001.bin"]);
        assert_eq!(times_of(&raw), (vec![0.0, 0.1], false));
        let numbered = scans(&["0.bin", "1.bin", "2.bin"]);
        let write = |name: &str, text: &str| {
            fs::write(numbered.path().join(name), text).unwrap();
        };
        let assumed = (vec![0.0, 0.1, 0.2], false);
        assert_eq!(times_of(&numbered), assumed);
        let row = |time_s: f64| format!("{time_s} 0 0 0 0 0 0 1\n");
        write("inner/poses_tum.txt", &[7.0, 7.5].map(row).concat());
        // Rows that are not one per scan are poses between the scans.
        assert_eq!(times_of(&numbered), assumed);
        write("inner/poses_tum.txt", &[7.0, 7.5, 9.0].map(row).concat());
        assert_eq!(times_of(&numbered), (vec![7.0, 7.5, 9.0], true));
        write("times.txt", "1\n2\n3\n4\n");
        assert_eq!(times_of(&numbered), (vec![7.0, 7.5, 9.0], true));
        write("times.txt", "1\n2\n4\n");
        assert_eq!(times_of(&numbered), (vec![1.0, 2.0, 4.0], true));
        write("inner/times.txt", "5\n6\n7\n");
        assert_eq!(times_of(&numbered), (vec![5.0, 6.0, 7.0], true));
    }

    #[test]
    fn numbers_are_sorted_as_numbers() {
        let folder = recording(&["10.bin", "2.bin", "1.bin"], 11);
        let recording = open(folder.path(), &Selection::default()).unwrap();
        assert_eq!(numbers(&recording), [1, 2, 10]);
    }

    #[test]
    fn hidden_files_are_ignored_and_names_that_are_partly_numbers_are_an_error() {
        let names = ["000000.bin", "000001.bin", "._000000.bin"];
        let folder = recording(&names, 2);
        let recording = open(folder.path(), &Selection::default()).unwrap();
        assert_eq!(numbers(&recording), [0, 1]);
        let copy = folder.path().join("velodyne/000000 (copy).bin");
        fs::write(&copy, []).unwrap();
        let result = open(folder.path(), &Selection::default());
        let message = result.unwrap_err().to_string();
        assert!(message.contains("000000 (copy).bin"), "{message}");
        fs::rename(copy, folder.path().join("velodyne/0.bin")).unwrap();
        let result = open(folder.path(), &Selection::default());
        assert!(matches!(result, Err(RecordingError::SameNumber { .. })));
    }

    #[test]
    fn a_map_among_the_scans_is_none_of_them() {
        let folder = recording(&["000000.bin", "000001.bin"], 2);
        let ply = |faces: usize| {
            let header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
                property float z\nelement face";
            let list = "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n";
            format!("{header} {faces}\n{list}{}", "3 0 1 2\n".repeat(faces))
        };
        let map = folder.path().join("velodyne/map.ply");
        fs::write(&map, ply(1)).unwrap();
        let recording = open(folder.path(), &Selection::default()).unwrap();
        assert_eq!(numbers(&recording), [0, 1]);
        // Points of the same name are a scan.
        fs::write(&map, ply(0)).unwrap();
        let result = open(folder.path(), &Selection::default());
        assert!(matches!(result, Err(RecordingError::MixedNames { .. })));
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
        let folder = recording(&["000000.bin", "000001.bin", "000002.bin"], 1);
        let message = open(folder.path(), &Selection::default())
            .unwrap_err()
            .to_string();
        assert!(message.contains("000001.bin has no pose"), "{message}");
        // One at the end is left out.
        let row = "1 0 0 0 0 1 0 0 0 0 1 0\n";
        fs::write(folder.path().join("poses.txt"), row.repeat(2)).unwrap();
        assert_eq!(
            numbers(&open(folder.path(), &Selection::default()).unwrap()),
            [0, 1]
        );
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
        let recording = open(folder.path(), &Selection::default()).unwrap();
        assert_eq!(recording.frames[1].time_s, 0.104);
        fs::write(folder.path().join("times.txt"), "0.0\n").unwrap();
        let message = open(folder.path(), &Selection::default())
            .unwrap_err()
            .to_string();
        assert!(message.contains("000001.bin has no time"), "{message}");
    }
}
