//! Scans of other sensors, as their drivers write them: every point is read.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs;

use fpmcl::recording::scan_files;

#[test]
fn every_sample_has_the_points_of_its_header_and_they_surround_the_sensor() {
    let Some(folder) = common::real_recording("sensor-samples") else {
        return;
    };
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if !scan_files::is_scan(&path) {
            continue;
        }
        let bytes = fs::read(&path).unwrap();
        let header = String::from_utf8_lossy(&bytes[..400]).into_owned();
        let claimed = header.lines().find_map(|line| line.strip_prefix("POINTS "));
        let scan = scan_files::read(&path).unwrap();
        assert_eq!(
            scan.len(),
            claimed.unwrap().trim().parse::<usize>().unwrap()
        );
        let finite = scan.points.iter().filter(|point| point.is_finite());
        let near = finite.filter(|point| point.length() < 300.0).count();
        assert!(10 * near > 9 * scan.len(), "{}", path.display());
    }
}

#[test]
fn scans_of_nuscenes_have_five_numbers_per_point() {
    let Some(folder) = common::real_recording("nuscenes-hdl32") else {
        return;
    };
    for entry in fs::read_dir(folder.join("lidar")).unwrap() {
        let path = entry.unwrap().path();
        let scan = scan_files::read(&path).unwrap();
        let bytes = fs::metadata(&path).unwrap().len() as usize;
        assert_eq!(scan.len(), bytes / 20, "{}", path.display());
    }
}
