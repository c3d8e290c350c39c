//! `.bin`: float32 x, y, z, intensity of each point (KITTI), and one more number, such as the ring
//! (nuScenes), or two.

use glam::Vec3;

use crate::lidar::Scan;

/// Ranges of real scans end well before [m].
const FARTHEST_M: f32 = 1000.0;

/// Reads points of four to six numbers. How many is not stored in the file: the number is the least one
/// with which no intensity is negative and no point is farther than a kilometre, or the least one
/// that divides the file if there is none.
pub fn parse(bytes: &[u8]) -> Result<Scan, String> {
    let mut possible = (4..=6)
        .filter(|columns| bytes.len().is_multiple_of(4 * columns))
        .map(|columns| with_columns(bytes, columns));
    let Some(first) = possible.next() else {
        return Err(format!(
            "has {} bytes, which is not a multiple of 16, 20 or 24, the sizes of points with 4, 5 or 6 floats; it looks truncated, copy it again",
            bytes.len()
        ));
    };
    if is_plausible(&first) {
        return Ok(first);
    }
    Ok(possible.find(is_plausible).unwrap_or(first))
}

fn with_columns(bytes: &[u8], columns: usize) -> Scan {
    let (numbers, _) = bytes.as_chunks::<4>();
    let (points, intensities) = numbers
        .chunks_exact(columns)
        .map(|row| {
            let [x, y, z, intensity] = [0, 1, 2, 3].map(|column| f32::from_le_bytes(row[column]));
            (Vec3::new(x, y, z), intensity)
        })
        .unzip();
    Scan {
        points,
        intensities,
        ..Scan::default()
    }
}

fn is_plausible(scan: &Scan) -> bool {
    let is_point = |point: &Vec3| !point.is_finite() || point.length() < FARTHEST_M;
    scan.points.iter().all(is_point) && !scan.intensities.iter().any(|&intensity| intensity < 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ring of points around the sensor, with a number of columns.
    fn bytes(columns: usize) -> Vec<u8> {
        (0..120)
            .flat_map(|i| {
                let azimuth = 0.05 * i as f32;
                let (sin, cos) = azimuth.sin_cos();
                let ring = (i % 32) as f32;
                let row = [20.0 * cos, 20.0 * sin, -1.7, 0.3, ring, 0.001 * i as f32];
                row[..columns].to_vec()
            })
            .flat_map(f32::to_le_bytes)
            .collect()
    }

    #[test]
    fn points_of_four_five_and_six_numbers_are_told_apart() {
        for columns in 4..=6 {
            let scan = parse(&bytes(columns)).unwrap();
            assert_eq!(scan.len(), 120, "{columns} columns");
            assert_eq!(scan.points[0], Vec3::new(20.0, 0.0, -1.7));
            assert!(scan.intensities.iter().all(|&intensity| intensity == 0.3));
        }
    }

    #[test]
    fn a_truncated_scan_is_an_error_with_its_size() {
        let message = parse(&[0; 33]).unwrap_err();
        assert!(message.contains("33 bytes"), "{message}");
        assert!(message.contains("truncated"), "{message}");
        assert!(parse(&[]).unwrap().is_empty());
    }
}
