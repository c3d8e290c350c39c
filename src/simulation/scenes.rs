//! Small scenes with exact labels for ground segmentation: one scan each, from a car that
//! stands on a straight street whose ground has the shape in question.

use super::drive::{Drive, MotionConfig};
use super::path::{Path, PathSegment};
use super::random::{Purpose, stream};
use super::scanner::{LabelledScan, Scanner, ScannerConfig, Target};
use super::street::{Street, StreetConfig};

/// Level ground from behind the car to 6 m before it, then a climb of `grade` (0.1 for 10 %;
/// negative downhill).
pub fn slope_scene(grade: f64, scanner: &ScannerConfig, seed: u64) -> LabelledScan {
    scene(
        &[(66.0, 0.0), (60.0, grade)],
        &StreetConfig::default(),
        scanner,
        seed,
    )
}

/// A climb of `grade` up to a crest 15 m before the car, and down again as steeply.
pub fn crest_scene(grade: f64, scanner: &ScannerConfig, seed: u64) -> LabelledScan {
    scene(
        &[(75.0, grade), (60.0, -grade)],
        &StreetConfig::default(),
        scanner,
        seed,
    )
}

/// A level street with kerbs of a height.
pub fn kerb_scene(height_m: f64, scanner: &ScannerConfig, seed: u64) -> LabelledScan {
    let mut street = StreetConfig::default();
    street.ground.kerb_height_m = height_m;
    scene(&[(120.0, 0.0)], &street, scanner, seed)
}

/// The scan at 60 m of a straight street of pieces (length, grade).
fn scene(
    pieces: &[(f64, f64)],
    street: &StreetConfig,
    scanner: &ScannerConfig,
    seed: u64,
) -> LabelledScan {
    const STATION_M: f64 = 60.0;
    let segments: Vec<PathSegment> = pieces
        .iter()
        .map(|&(length_m, grade)| PathSegment {
            length_m,
            turn_deg: 0.0,
            grade_percent: 100.0 * grade,
        })
        .collect();
    let path = Path::from_segments(&segments, 0.0);
    let street = Street::new(&path, street, seed);
    let drive = Drive::new(&path, Some(&[STATION_M]), &MotionConfig::default(), seed, 1);
    let target = Target::of_street(&street);
    let mut rng = stream(seed, Purpose::Scan, 0);
    Scanner::new(scanner).scan(
        &[&target],
        |delay_s| drive.world_from_lidar(&street.ground, delay_s),
        &mut rng,
    )
}
