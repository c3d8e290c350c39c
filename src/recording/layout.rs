//! Layouts of recordings, recognized by their files.

use std::path::{Path, PathBuf};

/// How a recording is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// `velodyne/`, `times.txt`, `poses.txt` and `calib.txt` of the KITTI odometry benchmark.
    KittiOdometry,
    /// `velodyne_points/data`, `velodyne_points/timestamps.txt` and `oxts/` of KITTI's raw data.
    KittiRaw,
    /// Scan files in a folder.
    Folder,
    /// MCAP, rosbag2 or a bag of ROS 1.
    Bag,
    /// Scans in memory.
    Memory,
}

impl Layout {
    /// Name for reports.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::KittiOdometry => "KITTI odometry",
            Self::KittiRaw => "KITTI raw",
            Self::Folder => "folder of scans",
            Self::Bag => "bag",
            Self::Memory => "scans in memory",
        }
    }
}

/// The files of a recording in a folder.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordingFiles {
    /// How they are stored.
    pub layout: Layout,
    /// Folder of the scans.
    pub scans: PathBuf,
    /// Times of the scans, one row per scan.
    pub times: Option<PathBuf>,
    /// Times in the folder above, which may be those of another recording.
    pub(super) times_above: Option<PathBuf>,
    /// Poses of the recording: a file, or KITTI's folder `oxts`.
    pub poses: Option<PathBuf>,
    /// Calibration of the recording.
    pub calibration: Option<PathBuf>,
}

impl RecordingFiles {
    /// A bag, which has its times and poses in itself.
    pub(crate) fn bag(path: &Path) -> Self {
        Self {
            layout: Layout::Bag,
            scans: path.to_owned(),
            ..Self::memory()
        }
    }

    /// No files.
    pub(super) fn memory() -> Self {
        Self {
            layout: Layout::Memory,
            scans: PathBuf::new(),
            times: None,
            times_above: None,
            poses: None,
            calibration: None,
        }
    }

    /// Finds the files of a recording: of its folder, or of the folder of its scans.
    pub(crate) fn find(folder: &Path) -> Self {
        let existing = |base: &Path, names: &[&str]| {
            let paths = names.iter().map(|name| base.join(name));
            paths.into_iter().find(|path| path.exists())
        };
        // `velodyne` and `velodyne_points/data` themselves are recordings, too.
        let is_inner = |name: &str| folder.ends_with(name);
        let base = if is_inner("velodyne_points/data") {
            folder.ancestors().nth(2).unwrap_or(folder)
        } else if is_inner("velodyne") || is_inner("lidar") {
            folder.parent().unwrap_or(folder)
        } else {
            folder
        };
        let poses = || existing(base, &["poses.txt", "poses_tum.txt", "poses.tum"]);
        let calibration = existing(base, &["calib.txt"]);
        let times = existing(base, &["times.txt"]);
        // Above a link is the folder of its target; the name of any other folder is enough.
        let named = base.file_name().filter(|_| !base.is_symlink());
        let above = named
            .and(base.parent())
            .map_or_else(|| base.join(".."), Path::to_owned);
        let times_above = existing(&above, &["times.txt"]);
        if base.join("velodyne_points/data").is_dir() {
            return Self {
                layout: Layout::KittiRaw,
                scans: base.join("velodyne_points/data"),
                times: existing(base, &["velodyne_points/timestamps.txt"]),
                times_above: None,
                poses: existing(base, &["oxts"]).or_else(poses),
                calibration,
            };
        }
        if base.join("velodyne").is_dir() {
            return Self {
                layout: Layout::KittiOdometry,
                scans: base.join("velodyne"),
                times,
                times_above,
                poses: poses(),
                calibration,
            };
        }
        Self {
            layout: Layout::Folder,
            scans: folder.to_owned(),
            times,
            times_above,
            poses: poses(),
            calibration,
        }
    }
}
