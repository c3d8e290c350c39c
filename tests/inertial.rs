//! Level poses by an inertial sensor, through the binary.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs;
use std::path::Path;

use common::{fpmcl, json, run};
use fpmcl::geometry::Pose3;
use fpmcl::recording::{PoseTrack, read_tum};
use nalgebra::Vector3;

/// Two bends uphill, with the sensor of a car whose clock is 50 ms ahead.
const SIMULATION: &str = "\
output_folder: street
path:
- {length_m: 20, turn_deg: 0, grade_percent: 4}
- {length_m: 25, turn_deg: 90, grade_percent: 4}
- {length_m: 15, turn_deg: 0, grade_percent: 4}
- {length_m: 25, turn_deg: 90, grade_percent: 0}
- {length_m: 15, turn_deg: 0, grade_percent: 0}
scanner:
  beams: 32
  azimuth_steps: 600
imu: {grade: automotive, clock_offset_s: 0.05}
";

/// That of the simulation.
const MOUNTING: &str = "[2, -1.5, 88]";

/// Directions up in the lidar frame of each scan of a simulated drive.
fn true_ups(drive: &Path) -> Vec<Vector3<f64>> {
    let calibration = drive.join("calib.txt");
    let track = PoseTrack::read(&drive.join("poses.txt"), Some(&calibration)).unwrap();
    let level_from_map = track.calibration.cam0_from_lidar.inverse() * track.world_from_map;
    let up = |pose: &Pose3| (level_from_map * pose).rotation.inverse() * Vector3::z();
    track.map_from_lidar.iter().map(up).collect()
}

/// Mean angle between true directions up and those of poses [deg].
fn mean_tilt_deg(poses: &Path, ups: &[Vector3<f64>]) -> f64 {
    let rows = read_tum(poses).unwrap();
    assert_eq!(rows.len(), ups.len());
    let tilts = (rows.iter().zip(ups))
        .map(|(row, up)| (row.map_from_lidar.rotation.inverse() * Vector3::z()).angle(up));
    (tilts.sum::<f64>() / ups.len() as f64).to_degrees()
}

#[test]
fn poses_are_level_with_a_sensor_and_as_before_without_or_with_a_wrong_one() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("simulation.yml"), SIMULATION).unwrap();
    run(folder, &["simulate", "simulation.yml"]);
    let drive = folder.join("street/drive_1");
    let ups = true_ups(&drive);
    // Of the drive, only what a recording has.
    for file in ["poses.txt", "odometry.txt"] {
        fs::rename(drive.join(file), folder.join(file)).unwrap();
    }
    let odometry = |name: &str| {
        let command = fpmcl("odometry").in_folder(folder).with("street/drive_1");
        command.with("--output").with(name)
    };
    let tilt_deg = |name: &str| mean_tilt_deg(&folder.join(name).join("poses_tum.txt"), &ups);

    odometry("without").succeeds();
    let with = odometry("with").with("--imu=street/drive_1/imu.csv");
    with.set("lidar_from_imu", MOUNTING).succeeds();
    let tilts_deg = (tilt_deg("without"), tilt_deg("with"));
    assert!(tilts_deg.0 > 1.0 && tilts_deg.1 < 0.3, "{tilts_deg:?}");
    let report = json(&folder.join("with/report.json"));
    let offset_s = report["inertial"]["time_offset_s"].as_f64().unwrap();
    assert!((offset_s - 0.05).abs() < 0.01, "{report:#}");
    assert!(json(&folder.join("without/report.json"))["inertial"].is_null());

    // Axes that are not those of the sensor.
    let wrong = odometry("wrong").with("--imu=street/drive_1/imu.csv");
    let wrong = wrong.set("lidar_from_imu", "[0, 90, 0]").succeeds();
    let stderr = &wrong.stderr;
    assert_eq!(
        stderr.matches("the inertial sensor is left out").count(),
        1,
        "{stderr}"
    );
    assert!(
        stderr.contains("its rates are not those of the scans"),
        "{stderr}"
    );
    let poses = |name: &str| fs::read(folder.join(name).join("poses_tum.txt")).unwrap();
    assert!(poses("wrong") == poses("without"));

    // Poses that are given.
    let given = odometry("given").with("--imu=street/drive_1/imu.csv");
    let given = given.with("--poses=without/poses_tum.txt").succeeds();
    assert!(
        given.stderr.contains("the inertial sensor is not used"),
        "{}",
        given.stderr
    );

    // A table that is none.
    fs::write(folder.join("imu.csv"), "time,speed\n0,1\n").unwrap();
    let refused = odometry("refused").with("--imu=imu.csv");
    refused.fails_with(&["the header `time,speed`"]);
}
