//! KITTI-360: an HDL-64E on a car.
//!
//! Liao, Xie and Geiger, *KITTI-360: A Novel Dataset and Benchmarks for Urban Scene Understanding in 2D and 3D* (2022): drives below
//! `data_3d_raw/` in the layout of KITTI's raw data; poses of the IMU below `data_poses/`, rows of the number of the frame and a 3x4
//! matrix, not of every frame; and the lidar on the IMU by the camera,
//!
//! ```text
//! imu_from_lidar = imu_from_cam0 · inv(lidar_from_cam0)
//! ```

use std::path::Path;

use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::super::oxts::read_timestamps;
use super::super::table::{parse_numbers, pose_from_row, read_text};
use super::named::{BodyPoses, NamedLayout, base};
use super::rows;
use crate::geometry::Pose3;

pub const KITTI_360: NamedLayout = NamedLayout {
    layout: Layout::Kitti360,
    needs: "velodyne_points/data/ below data_3d_raw/DRIVE/, next to calibration/ and data_poses/",
    find,
    poses,
};

fn find(folder: &Path, _part: Option<&str>) -> Result<Option<RecordingFiles>, RecordingError> {
    let drive = base(folder, "velodyne_points/data");
    let scans = drive.join("velodyne_points/data");
    if !scans.is_dir() {
        return Ok(None);
    }
    let drive = drive.canonicalize().map_err(RecordingError::read(drive))?;
    let above = drive.parent().filter(|it| it.ends_with("data_3d_raw"));
    let (Some(raw), Some(name)) = (above, drive.file_name()) else {
        return Ok(None);
    };
    let poses = raw
        .with_file_name("data_poses")
        .join(name)
        .join("poses.txt");
    let times = drive.join("velodyne_points/timestamps.txt");
    Ok(Some(RecordingFiles {
        times: times.is_file().then_some(times),
        calibration: Some(raw.with_file_name("calibration")),
        ..RecordingFiles::new(Layout::Kitti360, scans, poses)
    }))
}

fn poses(files: &RecordingFiles, path: &Path) -> Result<BodyPoses, RecordingError> {
    let rows = rows::read(path, 13, |row| Ok((row.index(0), row.matrix(1)?)))?;
    let times = files.times.as_deref().map(read_timestamps);
    let Some(times_s) = times.transpose()? else {
        return Err(RecordingError::NoTimes {
            path: files.scans.with_file_name("timestamps.txt"),
        });
    };
    let timed = |(frame, pose): (usize, Pose3)| Some((*times_s.get(frame)?, pose));
    let rows: Vec<(f64, Pose3)> = rows.into_iter().filter_map(timed).collect();
    let folder = files.calibration.clone().unwrap_or_default();
    let imu_from_cam0 = rigid(&folder.join("calib_cam_to_pose.txt"), Some("image_00"))?;
    let lidar_from_cam0 = rigid(&folder.join("calib_cam_to_velo.txt"), None)?;
    let imu_from_lidar = imu_from_cam0 * lidar_from_cam0.inverse();
    Ok(BodyPoses::timed(rows, imu_from_lidar))
}

/// A 3x4 matrix of a file, in the line of a key.
fn rigid(path: &Path, key: Option<&str>) -> Result<Pose3, RecordingError> {
    let text = read_text(path)?;
    let found = (1..).zip(text.lines()).find_map(|(line, text)| match key {
        Some(key) => {
            let (found, numbers) = text.split_once(':')?;
            (found.trim() == key).then_some((line, numbers))
        }
        None => Some((line, text)),
    });
    let (line, numbers) = found.unwrap_or((1, ""));
    pose_from_row(&parse_numbers(numbers, path, line)?, path, line)
}
