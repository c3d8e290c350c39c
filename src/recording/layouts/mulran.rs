//! MulRan: an OS1-64 on a car.
//!
//! Kim et al., *MulRan: Multimodal Range Dataset for Urban Place Recognition* (2020), and its file player: points of whole turns,
//! 1024 columns of 64; poses of the base of the car with times [ns]; the lidar on it by `calib_base2ouster.txt`.

use std::path::Path;

use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::super::scan_files::point_table::NumberType::F32;
use super::super::scan_files::records::{ColumnOrder, PointFormat, RecordFormat};
use super::named::{BodyPoses, NamedLayout, base};
use super::rows;
use crate::geometry::pose_from_degrees;

pub const MULRAN: NamedLayout = NamedLayout {
    layout: Layout::Mulran,
    needs: "Ouster/ and global_pose.csv",
    find,
    poses,
};

const POINTS: RecordFormat =
    RecordFormat::in_metres(&[("x", F32), ("y", F32), ("z", F32), ("intensity", F32)]);

/// Turns of an Ouster with 64 beams at 10 Hz, as MulRan and the Newer College data set have them.
pub const OUSTER_64: ColumnOrder = ColumnOrder {
    rows: 64,
    columns: 1024,
    period_s: 0.1,
};

/// Pose of the lidar on the base: x, y, z [m], roll, pitch, yaw [deg].
const BASE_FROM_LIDAR: [f64; 6] = [1.7042, -0.021, 1.8047, 0.0001, 0.0003, 179.6654];

fn find(folder: &Path, _part: Option<&str>) -> Result<Option<RecordingFiles>, RecordingError> {
    let base = base(folder, "Ouster");
    let (scans, poses) = (base.join("Ouster"), base.join("global_pose.csv"));
    let format = PointFormat {
        records: Some(&POINTS),
        order: Some(OUSTER_64),
    };
    Ok((scans.is_dir() && poses.is_file()).then(|| RecordingFiles {
        format,
        ..RecordingFiles::new(Layout::Mulran, scans, poses)
    }))
}

fn poses(_files: &RecordingFiles, path: &Path) -> Result<BodyPoses, RecordingError> {
    let rows = rows::read(path, 13, |row| Ok((row.time_s(0, 1e-9)?, row.matrix(1)?)))?;
    Ok(BodyPoses::timed(rows, pose_from_degrees(BASE_FROM_LIDAR)))
}
