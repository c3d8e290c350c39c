//! Boreas: an Alpha Prime (VLS-128) on a car.
//!
//! Burnett et al., *Boreas: A multi-season autonomous driving dataset* (2023), and its development kit: float32 x, y, z, intensity,
//! laser and time of each point [s]; rows `GPSTime, easting, northing, altitude, velocities, roll, pitch, heading, ...` of the lidar
//! itself at each scan [µs, m, rad], with
//!
//! ```text
//! C_enu_lidar = Rx(−roll) · Ry(−pitch) · Rz(−heading)
//! ```

use std::path::Path;

use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::super::scan_files::point_table::NumberType::F32;
use super::super::scan_files::records::{PointFormat, RecordFormat};
use super::named::{BodyPoses, NamedLayout, base};
use super::rows;
use crate::geometry::Pose3;

pub const BOREAS: NamedLayout = NamedLayout {
    layout: Layout::Boreas,
    needs: "lidar/ and applanix/",
    find,
    poses,
};

const POINTS: RecordFormat = RecordFormat::in_metres(&[
    ("x", F32),
    ("y", F32),
    ("z", F32),
    ("intensity", F32),
    ("ring", F32),
    ("time", F32),
]);

fn find(folder: &Path, _part: Option<&str>) -> Result<Option<RecordingFiles>, RecordingError> {
    let base = base(folder, "lidar");
    let (scans, applanix) = (base.join("lidar"), base.join("applanix"));
    let poses = applanix.join("lidar_poses.csv");
    Ok(
        (scans.is_dir() && applanix.is_dir()).then(|| RecordingFiles {
            format: PointFormat::records(&POINTS),
            ..RecordingFiles::new(Layout::Boreas, scans, poses)
        }),
    )
}

fn poses(_files: &RecordingFiles, path: &Path) -> Result<BodyPoses, RecordingError> {
    let rows = rows::read(path, 10, |row| {
        // The inverse of Rz(heading) · Ry(pitch) · Rx(roll).
        let pose = row.position_and_angles(1, [7, 8, 9])?;
        let pose = Pose3::from_parts(pose.translation, pose.rotation.inverse());
        Ok((row.time_s(0, 1e-6)?, pose))
    })?;
    Ok(BodyPoses::timed(rows, Pose3::identity()))
}
