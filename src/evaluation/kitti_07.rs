//! The parent's own run on KITTI 07, for tests where the data is there.

use std::path::{Path, PathBuf};

use super::results::LocalizationResults;
use crate::geometry::{Pose2, planar};
use crate::recording::{Calibration, poses::CameraPoses};

/// The true lidar poses and the results of range-mcl; `None`, saying so, where they are absent.
pub fn kitti_07() -> Option<(Vec<Pose2>, LocalizationResults)> {
    let data = std::env::var_os("FPMCL_DATA").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let poses = data.join("kitti-odometry-poses");
    let results = data.join("range-mcl/kitti07_demo_loc_results.npz");
    if !results.exists() || !poses.exists() {
        eprintln!("not run: {} is absent", results.display());
        return None;
    }
    let calibration = Calibration::read(&poses.join("sequences/07/calib.txt")).unwrap();
    let truth = CameraPoses::read(&poses.join("poses/07.txt")).unwrap();
    let truth = truth.map_from_lidar(&calibration);
    let results = LocalizationResults::read(&results).unwrap();
    Some((truth.iter().map(planar).collect(), results))
}
