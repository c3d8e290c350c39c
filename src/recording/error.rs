//! Errors of reading recordings.

use std::io;
use std::path::{Path, PathBuf};

use crate::inertial::ImuError;

/// A file of a recording that cannot be read or used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum RecordingError {
    #[error("cannot read {}: {source}", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("{} has {bytes} bytes, which is not a multiple of {record_bytes}; it looks truncated, copy it again", path.display())]
    Truncated {
        path: PathBuf,
        bytes: u64,
        record_bytes: usize,
    },
    #[error("{} {problem}", path.display())]
    BadScan { path: PathBuf, problem: String },
    #[error("{} {problem}", path.display())]
    BadTable { path: PathBuf, problem: String },
    #[error("{} {problem}", path.display())]
    BadBag { path: PathBuf, problem: String },
    #[error("{}: message {number} of {topic} {problem}", path.display())]
    BadMessage {
        path: PathBuf,
        topic: String,
        number: usize,
        problem: String,
    },
    #[error("{} is no recording of {layout}, which has {needs}; give its folder, or leave the layout out", path.display())]
    NotInLayout {
        path: PathBuf,
        layout: &'static str,
        needs: &'static str,
    },
    #[error("{} has several {kind}{named}; choose one of: {known}", path.display())]
    ChoosePart {
        path: PathBuf,
        kind: &'static str,
        named: String,
        known: String,
    },
    #[error("{} does not exist, and the poses have no times without it; copy it there from the archive of the scans", path.display())]
    NoTimes { path: PathBuf },
    #[error("{} has no topic of {types}; it has {found}", path.display())]
    NoTopic {
        path: PathBuf,
        types: &'static str,
        found: String,
    },
    #[error("{} has no topic {topic} of {types}; choose one of: {known}", path.display())]
    UnknownTopic {
        path: PathBuf,
        topic: String,
        types: &'static str,
        known: String,
    },
    #[error("{} has several topics of {types}; choose one of: {known}", path.display())]
    SeveralTopics {
        path: PathBuf,
        types: &'static str,
        known: String,
    },
    #[error("{} has poses in {known}; a topic is used for poses only where it is named, as it may be wheel odometry, which drifts", path.display())]
    TopicNotNamed { path: PathBuf, known: String },
    #[error("{}, line {line}: `{word}` is not a finite number", path.display())]
    NotANumber {
        path: PathBuf,
        line: usize,
        word: String,
    },
    #[error("{}, line {line}: {found} numbers where {expected} are needed ({layout})", path.display())]
    WrongCount {
        path: PathBuf,
        line: usize,
        found: usize,
        expected: usize,
        layout: &'static str,
    },
    #[error("{}, line {line}: the first three columns are not a rotation", path.display())]
    NotARotation { path: PathBuf, line: usize },
    #[error("{} has no line `Tr:` (cam0_from_lidar, 12 numbers); use the calibration that belongs to the poses, or give the mounting with body_from_lidar", path.display())]
    NoTr { path: PathBuf },
    #[error("{} contains no poses", path.display())]
    NoPoses { path: PathBuf },
    #[error("{} has no fixes of a GNSS receiver: {without_position} messages are without a position, {bad_lines} lines are damaged; give sentences of NMEA with GGA, rows of time, latitude, longitude and height, a folder oxts, or a topic of sensor_msgs/NavSatFix", path.display())]
    NoFixes {
        path: PathBuf,
        without_position: usize,
        bad_lines: usize,
    },
    #[error("{}, line {line}: `{row}` is not on the Earth; give time [s], latitude, longitude [deg] and height [m]", path.display())]
    NotOnEarth {
        path: PathBuf,
        line: usize,
        row: String,
    },
    #[error("{} contains no scans (.bin, .pcd, .ply or .npy); give the folder of a recording or of its scans, or a bag", path.display())]
    NoScans { path: PathBuf },
    #[error("{scan} has no pose: {} has {poses} rows; check that both belong to one recording, or select fewer frames with n_scans", pose_file.display())]
    ScanWithoutPose {
        scan: String,
        pose_file: PathBuf,
        poses: usize,
    },
    #[error("{} has no poses (poses.txt, poses_tum.txt, poses.tum or oxts); give their file", path.display())]
    NoPoseFile { path: PathBuf },
    #[error(
        "the poses of {topic} do not name the body that they are of; give its lidar's pose with body_from_lidar, [0, 0, 0, 0, 0, 0] if they are poses of the lidar"
    )]
    NoBody { topic: String },
    #[error(
        "the poses of {topic} are those of {body}, and no static transform leads from it to {lidar}, the frame of the scans; record tf_static, or give the poses as a file and the mounting with body_from_lidar"
    )]
    NoMounting {
        topic: String,
        body: String,
        lidar: String,
    },
    #[error("{} has no calib_imu_to_velo.txt in its folder or above it; copy it there from the archive of the calibration", path.display())]
    NoImuCalibration { path: PathBuf },
    #[error("{} {problem}", path.display())]
    BadImu { path: PathBuf, problem: ImuError },
    #[error("{}: the first row `{header}` is no header that names one time, three angular rates (gyro_x ...) and three forces (acc_x ...), nor has it seven numbers in this order", path.display())]
    ImuColumns { path: PathBuf, header: String },
    #[error("{}: the unit of the {quantity} is unknown: {value:.3e} {of}; state it in a header such as time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,acc_x_m_s2,acc_y_m_s2,acc_z_m_s2", path.display())]
    ImuUnit {
        path: PathBuf,
        quantity: &'static str,
        value: f64,
        of: &'static str,
    },
    #[error("{} has no time: times.txt has {times} rows; give one row per scan, or remove the file to assume 10 scans per second", scan.display())]
    ScanWithoutTime { scan: PathBuf, times: usize },
    #[error("{missing} of {scans} scans have no pose: the scans are from {first_scan_s:.3} to {last_scan_s:.3} s and the {poses} poses of {} from {first_pose_s:.3} to {last_pose_s:.3} s; give poses of this recording with times of the same clock", pose_file.display())]
    TimesDoNotMatch {
        pose_file: PathBuf,
        poses: usize,
        first_pose_s: f64,
        last_pose_s: f64,
        scans: usize,
        first_scan_s: f64,
        last_scan_s: f64,
        missing: usize,
    },
    #[error("{} has {times} times for {poses} poses; both need one row per frame", path.display())]
    WrongTimes {
        path: PathBuf,
        times: usize,
        poses: usize,
    },
    #[error("{}: frame {frame} at {time_s} s is not later than the frame before it at {previous_s} s; give times that ascend, in seconds with decimals, or remove the file to assume 10 scans per second", path.display())]
    TimesDoNotAscend {
        path: PathBuf,
        frame: usize,
        time_s: f64,
        previous_s: f64,
    },
    #[error("{}, line {line}: {value:e} is beyond any {quantity} of a recording, {limit}", path.display())]
    OutOfRange {
        path: PathBuf,
        line: usize,
        value: f64,
        quantity: &'static str,
        limit: &'static str,
    },
    #[error("the name of {} is a number and that of {} is not; the numbers of scans are rows of the pose file, remove the file that is not a scan of the recording", number.display(), word.display())]
    MixedNames { number: PathBuf, word: PathBuf },
    #[error("{} and {} have the same number; give the folder of one recording", first.display(), second.display())]
    SameNumber { first: PathBuf, second: PathBuf },
    #[error("no frame is selected: start_idx {start_idx}, n_scans {n_scans}, frame_step {frame_step} of {scans} scans in {}", path.display())]
    NothingSelected {
        path: PathBuf,
        start_idx: usize,
        n_scans: i64,
        frame_step: usize,
        scans: usize,
    },
}

impl RecordingError {
    /// Whether the recording does not have what was searched for; otherwise it has it, and it cannot be used.
    pub(crate) fn is_absence(&self) -> bool {
        matches!(self, Self::NoTopic { .. } | Self::NoPoseFile { .. })
    }

    /// Adds the file to an error of reading.
    pub(super) fn read(path: &Path) -> impl FnOnce(io::Error) -> Self {
        |source| Self::Read {
            path: path.to_owned(),
            source,
        }
    }
}
