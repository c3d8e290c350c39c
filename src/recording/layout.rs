//! Layouts of recordings, recognized by their files.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::de::{Error as _, IntoDeserializer as _};
use serde::{Deserialize, Serialize};

use super::scan_files::PointFormat;
use super::scan_list::ScanFile;

/// How a recording is stored. Names in configurations are those of the data loaders of KISS-ICP.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// `velodyne/`, `times.txt`, `poses.txt` and `calib.txt` of the KITTI odometry benchmark.
    #[serde(rename = "kitti")]
    KittiOdometry,
    /// `velodyne_points/data`, `velodyne_points/timestamps.txt` and `oxts/` of KITTI's raw data.
    KittiRaw,
    /// A drive below `data_3d_raw/` of KITTI-360, with `data_poses/` and `calibration/`.
    Kitti360,
    /// `Ouster/` and `global_pose.csv` of MulRan.
    Mulran,
    /// `velodyne_sync/` of NCLT, with `ground_truth/` in the folder above.
    Nclt,
    /// `lidar/` and `applanix/lidar_poses.csv` of Boreas.
    Boreas,
    /// `LiDAR/` and `LiDAR_GT/` of HeLiPR, with a folder per lidar.
    Helipr,
    /// `raw_format/ouster_scan/` and `ground_truth/registered_poses.csv` of the Newer College data set.
    #[serde(rename = "ncd")]
    NewerCollege,
    /// `samples/`, `sweeps/` and the tables `v1.0-*/` of nuScenes, with many scenes.
    Nuscenes,
    /// `pcds/` and `poses/gt_poses.txt` of Apollo's sequences for localization.
    Apollo,
    /// `frames/` and `gt_traj_lidar.txt` of Paris-Luco.
    ParisLuco,
    /// Scan files in a folder.
    #[serde(rename = "generic")]
    Folder,
    /// MCAP, rosbag2 or a bag of ROS 1.
    #[serde(alias = "mcap", alias = "rosbag")]
    Bag,
    /// Scans in memory.
    #[serde(skip)]
    Memory,
}

impl FromStr for Layout {
    type Err = serde::de::value::Error;

    /// A layout by its name in configurations, such as `mulran`. The error about a data set that is not read says what to do
    /// instead.
    fn from_str(name: &str) -> Result<Self, Self::Err> {
        if let Some((_, reason)) = NOT_READ.iter().find(|(known, _)| *known == name) {
            return Err(Self::Err::custom(format!("`{name}` is not read: {reason}")));
        }
        Self::deserialize(name.into_deserializer())
    }
}

/// Data sets that are not read: their names, the reasons, and what to do instead.
const NOT_READ: [(&str, &str); 4] = [
    ("argoverse2", ARGOVERSE_2),
    ("argoverse_2", ARGOVERSE_2),
    (
        "ouster",
        "a .pcap or .osf has raw packets, which the SDK of Ouster decodes; convert it by `ouster-cli source FILE save FILE.bag`, which is read",
    ),
    (
        "tum",
        "its images of a room are not of a lidar; clouds that are made of them are read as a folder of scans or from a bag",
    ),
];

const ARGOVERSE_2: &str = "its .feather files are tables of Apache Arrow with the points of two lidars in the frame of the car; convert them to a folder of scans with times.txt, such as .npy or .ply, as pandas and numpy do";

impl Layout {
    /// Name for reports.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::KittiOdometry => "KITTI odometry",
            Self::KittiRaw => "KITTI raw",
            Self::Kitti360 => "KITTI-360",
            Self::Mulran => "MulRan",
            Self::Nclt => "NCLT",
            Self::Boreas => "Boreas",
            Self::Helipr => "HeLiPR",
            Self::NewerCollege => "Newer College",
            Self::Nuscenes => "nuScenes",
            Self::Apollo => "Apollo",
            Self::ParisLuco => "Paris-Luco",
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
    /// Poses of the recording: a file, KITTI's folder `oxts`, or the tables of nuScenes.
    pub poses: Option<PathBuf>,
    /// Calibration of the recording.
    pub calibration: Option<PathBuf>,
    /// How the points of a scan are stored.
    pub(super) format: PointFormat,
    /// The scans, where they are not all that are below their folder.
    pub(super) listed: Option<Vec<ScanFile>>,
    /// Name of the lidar or the scene, where the folder has several.
    pub(super) part: Option<String>,
}

impl RecordingFiles {
    /// A bag, which has its times and poses in itself.
    pub(crate) fn bag(path: &Path) -> Self {
        Self {
            scans: path.to_owned(),
            ..Self::without_files(Layout::Bag)
        }
    }

    /// No files.
    pub(super) fn without_files(layout: Layout) -> Self {
        Self {
            layout,
            scans: PathBuf::new(),
            times: None,
            times_above: None,
            poses: None,
            calibration: None,
            format: PointFormat::default(),
            listed: None,
            part: None,
        }
    }

    /// Scans in a folder with the poses in a file that may be missing.
    pub(super) fn new(layout: Layout, scans: PathBuf, poses: PathBuf) -> Self {
        Self {
            scans,
            poses: poses.exists().then_some(poses),
            ..Self::without_files(layout)
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
                scans: base.join("velodyne_points/data"),
                times: existing(base, &["velodyne_points/timestamps.txt"]),
                times_above: None,
                poses: existing(base, &["oxts"]).or_else(poses),
                calibration,
                ..Self::without_files(Layout::KittiRaw)
            };
        }
        if base.join("velodyne").is_dir() {
            return Self {
                scans: base.join("velodyne"),
                times,
                times_above,
                poses: poses().or_else(|| benchmark_poses(base)),
                calibration,
                ..Self::without_files(Layout::KittiOdometry)
            };
        }
        Self {
            scans: folder.to_owned(),
            times,
            times_above,
            poses: poses(),
            calibration,
            ..Self::without_files(Layout::Folder)
        }
    }
}

/// `poses/NN.txt` of KITTI's odometry benchmark for its folder `sequences/NN`.
fn benchmark_poses(sequence: &Path) -> Option<PathBuf> {
    let sequences = sequence.parent().filter(|it| it.ends_with("sequences"))?;
    let mut name = sequence.file_name()?.to_owned();
    name.push(".txt");
    let poses = sequences.with_file_name("poses").join(name);
    poses.is_file().then_some(poses)
}
