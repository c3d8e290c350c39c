//! Paris-Luco: an HDL-32E on a car.
//!
//! Dellenbach et al., *CT-ICP: Real-time Elastic LiDAR Odometry with Loop Closure* (2022): scans `frames/*.ply` with times of their
//! points. The truth, `gt_traj_lidar.txt`, has positions only, which are no poses.

use std::path::Path;

use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::named::{BodyPoses, NamedLayout, base};

pub const PARIS_LUCO: NamedLayout = NamedLayout {
    layout: Layout::ParisLuco,
    needs: "frames/ and gt_traj_lidar.txt",
    find,
    poses,
};

fn find(folder: &Path, _part: Option<&str>) -> Result<Option<RecordingFiles>, RecordingError> {
    let base = base(folder, "frames");
    let (scans, positions) = (base.join("frames"), base.join("gt_traj_lidar.txt"));
    Ok(
        (scans.is_dir() && positions.is_file()).then(|| RecordingFiles {
            scans,
            ..RecordingFiles::without_files(Layout::ParisLuco)
        }),
    )
}

fn poses(_files: &RecordingFiles, path: &Path) -> Result<BodyPoses, RecordingError> {
    Err(RecordingError::NoPoses {
        path: path.to_owned(),
    })
}
