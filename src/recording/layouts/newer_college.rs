//! Newer College: an OS1-64, handheld.
//!
//! Ramezani et al., *The Newer College Dataset: Handheld LiDAR, Inertial and Vision with Ground Truth* (2020): scans as PCD, of whole
//! turns; rows `sec, nsec, x, y, z, qx, qy, qz, qw` of the left camera's base, on which the lidar is turned by 135 degrees.

use std::path::Path;

use nalgebra::{Quaternion, Translation3, UnitQuaternion};

use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::super::scan_files::records::PointFormat;
use super::mulran::OUSTER_64;
use super::named::{BodyPoses, NamedLayout, base};
use super::rows;
use crate::geometry::Pose3;

pub const NEWER_COLLEGE: NamedLayout = NamedLayout {
    layout: Layout::NewerCollege,
    needs: "raw_format/ouster_scan/",
    find,
    poses,
};

fn find(folder: &Path, _part: Option<&str>) -> Result<Option<RecordingFiles>, RecordingError> {
    let base = base(folder, "raw_format/ouster_scan");
    let scans = base.join("raw_format/ouster_scan");
    let poses = base.join("ground_truth/registered_poses.csv");
    let format = PointFormat {
        records: None,
        order: Some(OUSTER_64),
    };
    Ok(scans.is_dir().then(|| RecordingFiles {
        format,
        ..RecordingFiles::new(Layout::NewerCollege, scans, poses)
    }))
}

fn poses(_files: &RecordingFiles, path: &Path) -> Result<BodyPoses, RecordingError> {
    let rows = rows::read(path, 9, |row| {
        let time_s = row.time_s(0, 1.0)? + row.time_s(1, 1e-9)?;
        Ok((time_s, row.position_and_quaternion(2)?))
    })?;
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(0.383, 0.0, 0.0, 0.924));
    let base_from_lidar = Pose3::from_parts(Translation3::new(-0.084, -0.025, 0.050), rotation);
    Ok(BodyPoses::timed(rows, base_from_lidar))
}
