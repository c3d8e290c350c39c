//! NCLT: an HDL-32E on a Segway.
//!
//! Carlevaris-Bianco, Ushani and Eustice, *University of Michigan North Campus Long-Term Vision and LIDAR Dataset* (2016), and its
//! scripts: points are uint16 in steps of 5 mm from -100 m, with intensity and laser (uint8), in the frame of the body, whose z is
//! down. Rows of the truth are time [µs], x, y, z [m], roll, pitch, heading [rad] of the body.
//!
//! ```text
//! p_lidar = F (p_body − t)    body_from_lidar = Trans(t) · F    F = diag(1, −1, −1)
//! ```
//!
//! with t the centre of the lidar, from which its ranges and elevations are measured.

use std::path::Path;

use nalgebra::{Translation3, UnitQuaternion, Vector3};

use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::super::scan_files::point_table::NumberType::{U8, U16};
use super::super::scan_files::records::{PointFormat, RecordFormat};
use super::named::{BodyPoses, NamedLayout, base};
use super::rows;
use crate::geometry::Pose3;

pub const NCLT: NamedLayout = NamedLayout {
    layout: Layout::Nclt,
    needs: "velodyne_sync/",
    find,
    poses,
};

/// Centre of the lidar on the body [m].
const CENTRE_M: [f64; 3] = [0.002, -0.004, -0.957];

const POINTS: RecordFormat = RecordFormat {
    fields: &[
        ("x", U16),
        ("y", U16),
        ("z", U16),
        ("intensity", U8),
        ("ring", U8),
    ],
    metres: [
        (0.005, -100.0 - CENTRE_M[0] as f32),
        (-0.005, 100.0 + CENTRE_M[1] as f32),
        (-0.005, 100.0 + CENTRE_M[2] as f32),
    ],
};

fn find(folder: &Path, _part: Option<&str>) -> Result<Option<RecordingFiles>, RecordingError> {
    let base = base(folder, "velodyne_sync");
    let scans = base.join("velodyne_sync");
    if !scans.is_dir() {
        return Ok(None);
    }
    let base = base.canonicalize().map_err(RecordingError::read(base))?;
    let session = base.file_name().unwrap_or_default().display();
    let name = format!("groundtruth_{session}.csv");
    let inside = base.join(&name);
    let poses = if inside.is_file() {
        inside
    } else {
        base.with_file_name("ground_truth").join(name)
    };
    Ok(Some(RecordingFiles {
        format: PointFormat::records(&POINTS),
        ..RecordingFiles::new(Layout::Nclt, scans, poses)
    }))
}

fn poses(_files: &RecordingFiles, path: &Path) -> Result<BodyPoses, RecordingError> {
    let rows = rows::read(path, 7, |row| {
        let world_from_body = row.position_and_angles(1, [4, 5, 6])?;
        Ok((row.time_s(0, 1e-6)?, world_from_body))
    })?;
    let half_turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let centre = Translation3::from(CENTRE_M);
    Ok(BodyPoses::timed(rows, Pose3::from_parts(centre, half_turn)))
}
