//! Velodyne scans (`.bin`: float32 x, y, z, intensity) and SemanticKITTI labels (`.label`: u32).

use std::fs;
use std::path::Path;

use glam::Vec3;

use super::KittiError;
use crate::lidar::Scan;

/// Reads a scan whole, with all its points, also the invalid ones.
pub fn read_scan(path: &Path) -> Result<Scan, KittiError> {
    let records = read_records::<16>(path)?;
    let mut scan = Scan {
        points: Vec::with_capacity(records.len()),
        intensities: Vec::with_capacity(records.len()),
    };
    for record in &records {
        let [x, y, z, intensity] = floats(record);
        scan.points.push(Vec3::new(x, y, z));
        scan.intensities.push(intensity);
    }
    Ok(scan)
}

/// Writes a scan.
pub fn write_scan(path: &Path, scan: &Scan) -> Result<(), KittiError> {
    let bytes: Vec<u8> = scan
        .points
        .iter()
        .zip(&scan.intensities)
        .flat_map(|(point, &intensity)| [point.x, point.y, point.z, intensity])
        .flat_map(f32::to_le_bytes)
        .collect();
    write_bytes(path, &bytes)
}

/// Reads the semantic class of every point: the low 16 bits, without the instance.
pub fn read_labels(path: &Path) -> Result<Vec<u16>, KittiError> {
    let records = read_records::<4>(path)?;
    Ok(records
        .iter()
        .map(|&[low, high, ..]| u16::from_le_bytes([low, high]))
        .collect())
}

/// Writes semantic classes, instance 0.
pub fn write_labels(path: &Path, classes: &[u16]) -> Result<(), KittiError> {
    let bytes: Vec<u8> = classes
        .iter()
        .flat_map(|&class| u32::from(class).to_le_bytes())
        .collect();
    write_bytes(path, &bytes)
}

fn read_records<const SIZE: usize>(path: &Path) -> Result<Vec<[u8; SIZE]>, KittiError> {
    let bytes = fs::read(path).map_err(|source| KittiError::Read {
        path: path.to_owned(),
        source,
    })?;
    let (records, rest) = bytes.as_chunks::<SIZE>();
    if rest.is_empty() {
        Ok(records.to_vec())
    } else {
        Err(KittiError::Truncated {
            path: path.to_owned(),
            bytes: bytes.len() as u64,
            record_bytes: SIZE,
        })
    }
}

fn floats(record: &[u8; 16]) -> [f32; 4] {
    let (words, _) = record.as_chunks::<4>();
    [words[0], words[1], words[2], words[3]].map(f32::from_le_bytes)
}

fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), KittiError> {
    fs::write(path, bytes).map_err(|source| KittiError::Write {
        path: path.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_written_scan_reads_back_bit_by_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("000000.bin");
        let scan = Scan {
            points: vec![Vec3::new(1.5, -2.25, 0.1), Vec3::INFINITY],
            intensities: vec![0.3, 0.9],
        };
        write_scan(&path, &scan).unwrap();
        assert_eq!(read_scan(&path).unwrap(), scan);
    }

    #[test]
    fn a_truncated_scan_is_an_error_that_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("000000.bin");
        fs::write(&path, [0; 33]).unwrap();
        let message = read_scan(&path).unwrap_err().to_string();
        assert!(message.contains("33 bytes"), "{message}");
        assert!(message.contains("truncated"), "{message}");
    }

    #[test]
    fn labels_lose_their_instance_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("000000.label");
        fs::write(&path, 0x0007_0028_u32.to_le_bytes()).unwrap();
        assert_eq!(read_labels(&path).unwrap(), [40]);
    }
}
