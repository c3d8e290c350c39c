//! The examples as their readers run them, on a simulated drive.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::path::Path;
use std::process::Command;

use common::fpmcl;
use fpmcl::geometry::Pose3;
use fpmcl::recording::{Sequence, poses::read_tum};

const SIMULATION: &str = "\
output_folder: street
n_scans: 16
path:
- {length_m: 40, turn_deg: 30, grade_percent: 3}
";

/// Runs an example in a folder and returns its output.
#[track_caller]
fn example(name: &str, folder: &Path, arguments: &[&str]) -> String {
    let tests = std::env::current_exe().unwrap();
    let built = tests.parent().unwrap().parent().unwrap().join("examples");
    let mut command = Command::new(built.join(name));
    let output = command
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{message}");
    String::from_utf8(output.stdout).unwrap()
}

fn distance_m(a: &Pose3, b: &Pose3) -> f64 {
    (a.translation.vector - b.translation.vector).norm()
}

#[test]
fn a_map_is_built_a_second_drive_is_localized_in_it_and_refined() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("simulation.yml"), SIMULATION).unwrap();
    for drive in ["1", "2"] {
        fpmcl("simulate")
            .with("simulation.yml")
            .set("drive", drive)
            .in_folder(folder.path())
            .succeeds();
    }
    let folder = folder.path();
    let built = example("build_map", folder, &["street/drive_1", "map.ply"]);
    assert!(built.contains("key scans"), "{built}");
    let query = ["street/drive_2", "map.ply", "trajectory.txt"];
    let localized = example("localize", folder, &query);
    assert_eq!(localized.lines().count(), 16);
    assert!(
        localized.lines().last().unwrap().ends_with("tracking"),
        "{localized}"
    );

    // Poses of drive 2 in the frame of the map, which is the first pose of drive 1.
    let map = Sequence::open_folder(&folder.join("street/drive_1")).unwrap();
    let truth = Sequence::open_folder(&folder.join("street/drive_2")).unwrap();
    let truth = truth.in_map(&map.world_from_map);
    let found = read_tum(&folder.join("trajectory.txt")).unwrap();
    let refined = example("refine", folder, &query);
    for (row, (frame, line)) in truth.frames.iter().zip(refined.lines()).enumerate().skip(5) {
        let error_m = distance_m(&found.poses[row].map_from_lidar, &frame.map_from_lidar);
        assert!(error_m < 0.1, "row {row}: {error_m} m");
        let numbers: Vec<f64> = line
            .split(' ')
            .filter_map(|word| word.parse().ok())
            .collect();
        let place = frame.map_from_lidar.translation;
        let off_m = (numbers[0] - place.x).hypot(numbers[1] - place.y);
        assert!(off_m < 0.05, "row {row}: {off_m} m");
    }
}
