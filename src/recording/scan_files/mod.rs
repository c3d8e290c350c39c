//! Files of one scan: `.bin` of KITTI, SemanticKITTI and nuScenes, `.pcd`, `.ply` and `.npy`, and records of other data sets.

mod bin;
pub(crate) mod npy;
mod pcd;
mod ply;
pub(super) mod point_table;
pub(super) mod point_times;
pub(super) mod records;

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use glam::Vec3;

use self::point_table::Table;
use self::point_times::set_times;
pub use self::records::PointFormat;
use super::error::RecordingError;
use super::velodyne::read_bytes;
use crate::files::has_extension;
use crate::lidar::Scan;

/// Extensions of the files that [`read`] reads.
pub const EXTENSIONS: [&str; 4] = ["bin", "pcd", "ply", "npy"];

/// Whether a file is a scan, by its extension.
pub fn is_scan(path: &Path) -> bool {
    EXTENSIONS.iter().any(|known| has_extension(path, known))
}

/// Whether a file is a mesh, a `.ply` with faces.
pub fn is_mesh(path: &Path) -> bool {
    let file = || File::open(path).map(BufReader::new);
    has_extension(path, "ply") && file().is_ok_and(ply::has_faces)
}

/// Whether the columns of a file have names, so that points can have times.
pub fn has_named_columns(path: &Path, format: PointFormat) -> bool {
    format != PointFormat::default() || is_scan(path) && !has_extension(path, "bin")
}

/// A scan as it is read.
#[derive(Clone, Debug, PartialEq)]
pub struct ReadScan {
    /// The scan.
    pub scan: Scan,
    /// Whether the points have numbers by the name of a time which make no sense as one.
    pub has_unknown_times: bool,
}

/// Reads a scan with all its points, including invalid ones.
///
/// Intensities are as in the file, 0 where it has none. Times of the points are those after the middle of the sweep.
///
/// # Errors
/// The file cannot be read, or its format is not one of those of scans.
pub fn read(path: &Path) -> Result<Scan, RecordingError> {
    Ok(read_stamped(path, None)?.scan)
}

/// Reads a scan with a stamp [s], to which the times of its points are relative. The moment of the scan is the middle of
/// its sweep if the points have times, else the stamp; points with times of another clock have the stamp in the
/// middle.
pub fn read_stamped(path: &Path, stamp_s: Option<f64>) -> Result<ReadScan, RecordingError> {
    read_formatted(path, PointFormat::default(), stamp_s)
}

/// Reads a scan as [`read_stamped`], with its points in a format.
pub fn read_formatted(
    path: &Path,
    format: PointFormat,
    stamp_s: Option<f64>,
) -> Result<ReadScan, RecordingError> {
    Ok(read_with_normals(path, format, stamp_s)?.0)
}

/// A scan, and the normals of its points if the file has them.
fn read_with_normals(
    path: &Path,
    format: PointFormat,
    stamp_s: Option<f64>,
) -> Result<(ReadScan, Option<Vec<Vec3>>), RecordingError> {
    let bytes = read_bytes(path)?;
    let table = match format.records {
        Some(records) => Some(records.table(&bytes)),
        None => table(path, &bytes),
    };
    let read = match table {
        Some(table) => {
            table.and_then(|table| Ok((scan_of(&table, format, stamp_s)?, table.normals())))
        }
        None => bin::parse(&bytes).map(|scan| {
            let time_s = stamp_s;
            let scan = Scan { time_s, ..scan };
            let has_unknown_times = false;
            (
                ReadScan {
                    scan,
                    has_unknown_times,
                },
                None,
            )
        }),
    };
    read.map_err(|problem| RecordingError::BadScan {
        path: path.to_owned(),
        problem,
    })
}

fn scan_of(table: &Table, format: PointFormat, stamp_s: Option<f64>) -> Result<ReadScan, String> {
    let (mut scan, mut numbers) = table.points()?;
    if let Some(records) = format.records {
        scan.points
            .iter_mut()
            .for_each(|point| *point = records.point_m(*point));
    }
    if let (true, Some(order)) = (numbers.is_empty(), format.order) {
        numbers = order.times_s(scan.points.len());
    }
    let has_times = set_times(&mut scan, &numbers, stamp_s) || set_times(&mut scan, &numbers, None);
    scan.time_s = scan.time_s.or(stamp_s);
    Ok(ReadScan {
        scan,
        has_unknown_times: !has_times,
    })
}

/// A point cloud as it is read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadCloud {
    /// Its points, as those of a scan.
    pub scan: Scan,
    /// Normal of each point; `None` if the file has none.
    pub normals: Option<Vec<Vec3>>,
}

/// Reads a point cloud with its normals, fields `nx` or `normal_x` and so on.
pub fn read_cloud(path: &Path) -> Result<ReadCloud, RecordingError> {
    let (ReadScan { scan, .. }, normals) = read_with_normals(path, PointFormat::default(), None)?;
    Ok(ReadCloud { scan, normals })
}

/// The table of a file whose format is that of its extension; `None` for `.bin`.
fn table<'a>(path: &Path, bytes: &'a [u8]) -> Option<Result<Table<'a>, String>> {
    if has_extension(path, "pcd") {
        Some(pcd::parse(bytes))
    } else if has_extension(path, "ply") {
        Some(ply::parse(bytes))
    } else if has_extension(path, "npy") {
        Some(npy::parse(bytes))
    } else {
        None
    }
}
