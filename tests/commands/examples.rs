//! The examples, run on a simulated drive.

use std::fs;
use std::path::Path;
use std::process::Command;

use fpmcl::geometry::Pose3;
use fpmcl::map::{Map, MapOptions};
use fpmcl::recording::{Recording, read_tum};

use crate::common::simulate_two_drives;

const SIMULATION: &str = "\
output_folder: street
n_scans: 16
path:
- {length_m: 40, turn_deg: 30, grade_percent: 3}
";

#[test]
fn a_drive_without_poses_is_mapped_along_the_path_that_it_has_driven() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, SIMULATION);
    let drive = folder.join("street/drive_1");
    let truth = Recording::open(&drive).and_then(Recording::with_own_poses);
    let truth = truth.unwrap();
    fs::remove_file(drive.join("poses.txt")).unwrap();
    let built = example("build_map", folder, &["street/drive_1", "map.ply"]);
    assert!(built.contains("16 key scans"), "{built}");
    let map = Map::load(&folder.join("map.ply"), &MapOptions::default()).unwrap();
    for (frame, pose) in truth.frames.iter().zip(&map.path.map_from_lidar) {
        let error_m = distance_m(&frame.map_from_lidar.unwrap(), pose);
        assert!(error_m < 0.1, "frame {}: {error_m} m", frame.number);
    }
    // Most scans come too fast for an unoptimized program.
    let printed = example("live", folder, &["street/drive_1", "map.ply"]);
    assert!(
        printed.lines().last().unwrap().starts_with("16 scans, "),
        "{printed}"
    );
    assert!(
        printed.contains("the scan agrees with the map"),
        "{printed}"
    );
}

#[test]
fn a_drive_is_mapped_and_another_one_localized_in_it_without_a_word_about_the_sensor() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, SIMULATION);
    let printed = example("pipeline", folder, &["street/drive_1", "street/drive_2"]);
    let tracking = printed.lines().filter(|line| line.ends_with("tracking"));
    assert!(
        printed.lines().count() == 16 && tracking.count() >= 14,
        "{printed}"
    );
}

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
fn a_second_drive_is_localized_and_refined_in_the_map_of_the_first() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, SIMULATION);
    let built = example("build_map", folder, &["street/drive_1", "map.ply"]);
    assert!(built.contains("key scans"), "{built}");
    let arguments = ["street/drive_2", "map.ply", "trajectory.txt"];
    let localized = example("localize", folder, &arguments);
    assert_eq!(localized.lines().count(), 16);
    assert!(
        localized.lines().last().unwrap().ends_with("tracking"),
        "{localized}"
    );

    // The map frame is the lidar frame of the first pose of drive 1.
    let map = Recording::open(folder.join("street/drive_1"))
        .and_then(Recording::with_own_poses)
        .unwrap();
    let query = Recording::open(folder.join("street/drive_2"))
        .and_then(Recording::with_own_poses)
        .unwrap();
    let truth = query.own_track().unwrap().in_map(&map.world().0);
    let found = read_tum(&folder.join("trajectory.txt")).unwrap();
    let refined = example("refine", folder, &arguments);
    let rows = truth.map_from_lidar.iter().zip(refined.lines());
    for (row, (truth, line)) in rows.enumerate().skip(5) {
        let error_m = distance_m(&found[row].map_from_lidar, truth);
        assert!(error_m < 0.1, "row {row}: {error_m} m");
        let numbers: Vec<f64> = line
            .split(' ')
            .filter_map(|word| word.parse().ok())
            .collect();
        let position = truth.translation;
        let error_m = (numbers[0] - position.x).hypot(numbers[1] - position.y);
        assert!(error_m < 0.05, "refined row {row}: {error_m} m");
    }
}
