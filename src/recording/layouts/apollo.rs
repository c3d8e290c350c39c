//! Apollo-SouthBay: an HDL-64E on a car.
//!
//! Lu et al., *L3-Net: Towards Learning Based LiDAR Localization for Autonomous Driving* (2019): compensated scans `pcds/N.pcd`, and
//! rows `N time x y z qx qy qz qw` of the lidar itself [s, m].

use std::collections::BTreeMap;
use std::path::Path;

use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::super::scan_list::{self, ScanFile};
use super::named::{BodyPoses, NamedLayout, base};
use super::rows::{self, PoseRow};
use crate::geometry::Pose3;

pub const APOLLO: NamedLayout = NamedLayout {
    layout: Layout::Apollo,
    needs: "pcds/ and poses/gt_poses.txt",
    find,
    poses,
};

/// Numbers of a row.
const COLUMNS: usize = 9;

fn find(folder: &Path, _part: Option<&str>) -> Result<Option<RecordingFiles>, RecordingError> {
    let base = base(folder, "pcds");
    let (scans, poses) = (base.join("pcds"), base.join("poses/gt_poses.txt"));
    if !scans.is_dir() || !poses.is_file() {
        return Ok(None);
    }
    // The times of the scans are those of the rows with their numbers, of which the first is 1.
    let number_and_time = |row: &PoseRow<'_>| Ok((row.index(0), row.time_s(1, 1.0)?));
    let times_s: BTreeMap<usize, f64> = (rows::read(&poses, COLUMNS, number_and_time)?)
        .into_iter()
        .collect();
    let timed = |scan: ScanFile| ScanFile {
        time_s: times_s.get(&scan.number).copied(),
        ..scan
    };
    let listed = scan_list::scan_files(&scans)?.into_iter().map(timed);
    Ok(Some(RecordingFiles {
        listed: Some(listed.collect()),
        ..RecordingFiles::new(Layout::Apollo, scans, poses)
    }))
}

fn poses(_files: &RecordingFiles, path: &Path) -> Result<BodyPoses, RecordingError> {
    let rows = rows::read(path, COLUMNS, |row| {
        Ok((row.time_s(1, 1.0)?, row.position_and_quaternion(2)?))
    })?;
    Ok(BodyPoses::timed(rows, Pose3::identity()))
}
