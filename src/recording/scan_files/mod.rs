//! Files of one scan: `.bin` of KITTI, SemanticKITTI and nuScenes, `.pcd`, `.ply` and `.npy`.

mod bin;
pub mod npy;
mod pcd;
mod ply;
pub(super) mod point_table;

use std::path::Path;

use super::error::RecordingError;
use super::velodyne::read_bytes;
use crate::lidar::Scan;

/// Extensions of the files that [`parse`] reads.
pub const EXTENSIONS: [&str; 4] = ["bin", "pcd", "ply", "npy"];

/// Whether a file is a scan, by its extension.
pub fn is_scan(path: &Path) -> bool {
    EXTENSIONS.iter().any(|known| has_extension(path, known))
}

/// Reads a scan with all its points, including invalid ones.
pub fn read(path: &Path) -> Result<Scan, RecordingError> {
    parse(path, &read_bytes(path)?)
}

/// Reads the content of a scan's file, whose format is that of its extension; `path` is also for errors.
///
/// Intensities are as in the file, 0 where it has none.
pub fn parse(path: &Path, bytes: &[u8]) -> Result<Scan, RecordingError> {
    let scan = if has_extension(path, "pcd") {
        pcd::parse(bytes)
    } else if has_extension(path, "ply") {
        ply::parse(bytes)
    } else if has_extension(path, "npy") {
        npy::parse(bytes)
    } else {
        bin::parse(bytes)
    };
    scan.map_err(|problem| RecordingError::BadScan {
        path: path.to_owned(),
        problem,
    })
}

fn has_extension(path: &Path, extension: &str) -> bool {
    (path.extension()).is_some_and(|found| found.eq_ignore_ascii_case(extension))
}
