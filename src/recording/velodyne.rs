//! Velodyne scans (`.bin`: float32 x, y, z, intensity) and SemanticKITTI labels (`.label`: u32).

use std::fs;
use std::io::{self, Write};
use std::path::Path;

use blake3::Hash;
use glam::Vec3;

use super::KittiError;
use crate::lidar::Scan;

/// Reads a scan whole, with all its points, also the invalid ones.
pub fn read_scan(path: &Path) -> Result<Scan, KittiError> {
    parse_scan(path, &read_bytes(path)?)
}

/// Reads a scan and the BLAKE3 hash of its very bytes.
pub fn read_scan_and_hash(path: &Path) -> Result<(Scan, Hash), KittiError> {
    let bytes = read_bytes(path)?;
    Ok((parse_scan(path, &bytes)?, blake3::hash(&bytes)))
}

/// The BLAKE3 hash of a scan's file.
pub fn hash_of_scan(path: &Path) -> Result<Hash, KittiError> {
    Ok(blake3::hash(&read_bytes(path)?))
}

fn parse_scan(path: &Path, bytes: &[u8]) -> Result<Scan, KittiError> {
    let records = records::<16>(path, bytes)?;
    let mut scan = Scan {
        points: Vec::with_capacity(records.len()),
        intensities: Vec::with_capacity(records.len()),
    };
    for record in records {
        let [x, y, z, intensity] = floats(record);
        scan.points.push(Vec3::new(x, y, z));
        scan.intensities.push(intensity);
    }
    Ok(scan)
}

/// Writes a scan.
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

/// Reads the semantic class of every point: the low 16 bits, without the instance.
pub fn read_labels(path: &Path) -> Result<Vec<u16>, KittiError> {
    let bytes = read_bytes(path)?;
    let records = records::<4>(path, &bytes)?;
    Ok(records
        .iter()
        .map(|&[low, high, ..]| u16::from_le_bytes([low, high]))
        .collect())
}

/// Writes semantic classes, instance 0.
pub fn write_labels(mut writer: impl Write, classes: &[u16]) -> io::Result<()> {
    let bytes: Vec<u8> = classes
        .iter()
        .flat_map(|&class| u32::from(class).to_le_bytes())
        .collect();
    writer.write_all(&bytes)
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, KittiError> {
    fs::read(path).map_err(|source| KittiError::Read {
        path: path.to_owned(),
        source,
    })
}

fn records<'a, const SIZE: usize>(
    path: &Path,
    bytes: &'a [u8],
) -> Result<&'a [[u8; SIZE]], KittiError> {
    let (records, rest) = bytes.as_chunks::<SIZE>();
    if rest.is_empty() {
        Ok(records)
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
        write_scan(fs::File::create(&path).unwrap(), &scan).unwrap();
        assert_eq!(read_scan(&path).unwrap(), scan);
    }

    #[test]
    fn the_hash_of_a_scan_is_that_of_its_file_and_tells_one_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("000000.bin");
        let mut scan = Scan {
            points: vec![Vec3::X, Vec3::Y],
            intensities: vec![0.3, 0.9],
        };
        write_scan(fs::File::create(&path).unwrap(), &scan).unwrap();
        let (read, hash) = read_scan_and_hash(&path).unwrap();
        assert_eq!(read, scan);
        assert_eq!(hash_of_scan(&path).unwrap(), hash);
        scan.points[1].y = f32::from_bits(scan.points[1].y.to_bits() ^ 1);
        write_scan(fs::File::create(&path).unwrap(), &scan).unwrap();
        assert_ne!(hash_of_scan(&path).unwrap(), hash);
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
