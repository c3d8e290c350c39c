//! Writing of scans (`.bin`: float32 x, y, z, intensity), and SemanticKITTI labels (`.label`: u32).

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::error::RecordingError;
use crate::lidar::Scan;
use crate::memory;

/// Writes a scan in the format of KITTI's `.bin`: x, y, z [m] and intensity of each point, as little-endian `f32`.
///
/// # Errors
/// Those of the writer.
pub fn write_scan(mut writer: impl Write, scan: &Scan) -> io::Result<()> {
    let bytes: Vec<u8> = scan
        .points
        .iter()
        .zip(&scan.intensities)
        .flat_map(|(point, &intensity)| [point.x, point.y, point.z, intensity])
        .flat_map(f32::to_le_bytes)
        .collect();
    writer.write_all(&bytes)
}

/// Reads the semantic class of each point: the low 16 bits, without the instance.
///
/// # Errors
/// The file cannot be read, or its size is not a multiple of four bytes.
pub fn read_labels(path: &Path) -> Result<Vec<u16>, RecordingError> {
    let bytes = read_bytes(path)?;
    let (records, rest) = bytes.as_chunks::<4>();
    if !rest.is_empty() {
        return Err(RecordingError::Truncated {
            path: path.to_owned(),
            bytes: bytes.len() as u64,
            record_bytes: 4,
        });
    }
    let class = |&[low, high, ..]: &[u8; 4]| u16::from_le_bytes([low, high]);
    Ok(records.iter().map(class).collect())
}

/// Writes the semantic class of each point as a little-endian `u32`, with instance 0.
///
/// # Errors
/// Those of the writer.
pub fn write_labels(mut writer: impl Write, classes: &[u16]) -> io::Result<()> {
    let bytes: Vec<u8> = classes
        .iter()
        .flat_map(|&class| u32::from(class).to_le_bytes())
        .collect();
    writer.write_all(&bytes)
}

pub(super) fn read_bytes(path: &Path) -> Result<Vec<u8>, RecordingError> {
    memory::read_file(path).map_err(RecordingError::read(path))
}

/// The existing label file of a scan: of the same name in `label_folder`, by default in `labels`
/// next to the folder of the scans. That of nuScenes' `000000.pcd.bin` is `000000.label`.
pub fn label_file(scan_path: &Path, name: &Path, label_folder: Option<&Path>) -> Option<PathBuf> {
    let depth = name.components().count();
    let above = |depth| Some(scan_path.ancestors().nth(depth + 1)?.join("labels"));
    let stem = name.file_stem()?;
    let candidates = match label_folder {
        Some(folder) => [folder.join(name), folder.join(stem)],
        None => [above(depth)?.join(name), above(1)?.join(stem)],
    };
    candidates
        .map(|path| path.with_extension("label"))
        .into_iter()
        .find(|path| path.is_file())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use glam::Vec3;

    use super::*;
    use crate::recording::scan_files;

    #[test]
    fn a_written_scan_reads_back_exactly() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("000000.bin");
        let scan = Scan {
            points: vec![Vec3::new(1.5, -2.25, 0.1), Vec3::INFINITY],
            intensities: vec![0.3, 0.9],
            ..Scan::default()
        };
        write_scan(fs::File::create(&path).unwrap(), &scan).unwrap();
        assert_eq!(scan_files::read(&path).unwrap(), scan);
    }

    #[test]
    fn labels_are_read_without_their_instance() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("000000.label");
        fs::write(&path, 0x0007_0028_u32.to_le_bytes()).unwrap();
        assert_eq!(read_labels(&path).unwrap(), [40]);
    }
}
