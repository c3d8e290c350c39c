//! Rotations and level poses by an inertial sensor, through the binary and the library.

use std::f32::consts::TAU;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use fpmcl::geometry::Pose3;
use fpmcl::inertial::{Imu, ImuSamples};
use fpmcl::lidar::Scan;
use fpmcl::memory::MemoryBudget;
use fpmcl::recording::{PoseTrack, Recording, read_tum};
use fpmcl::simulation::{
    ImuGrade, MotionConfig, ScannerConfig, SimulatedImuConfig, Simulation, SimulationConfig,
};
use nalgebra::Vector3;

use crate::common::{Output, fpmcl, json, run, simulate_two_drives};

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

/// True poses of a simulated drive, in a frame that is level.
fn true_poses(drive: &Path) -> Vec<Pose3> {
    let calibration = drive.join("calib.txt");
    let track = PoseTrack::read(&drive.join("poses.txt"), Some(&calibration)).unwrap();
    let level_from_map = track.calibration.cam0_from_lidar.inverse() * track.world_from_map;
    let poses = track.map_from_lidar.iter();
    poses.map(|pose| level_from_map * pose).collect()
}

/// Directions up in the lidar frame of each scan of a simulated drive.
fn true_ups(drive: &Path) -> Vec<Vector3<f64>> {
    let up = |pose: &Pose3| pose.rotation.inverse() * Vector3::z();
    true_poses(drive).iter().map(up).collect()
}

/// Requires that a sensor was left out with one warning, for a reason.
#[track_caller]
fn assert_left_out(output: &Output, reason: &str) {
    let stderr = &output.stderr;
    let warnings = stderr.matches("the inertial sensor is left out").count();
    assert!(warnings == 1 && stderr.contains(reason), "{stderr}");
}

/// Writes a table of measurements whose columns are changed.
fn change_imu(from: &Path, to: &Path, change: impl Fn(&mut [f64])) {
    let text = fs::read_to_string(from).unwrap();
    let (header, rows) = text.split_once('\n').unwrap();
    let mut changed = format!("{header}\n");
    for row in rows.lines() {
        let mut numbers: Vec<f64> = row.split(',').map(|word| word.parse().unwrap()).collect();
        change(&mut numbers);
        let words: Vec<String> = numbers.iter().map(f64::to_string).collect();
        changed += &format!("{}\n", words.join(","));
    }
    fs::write(to, changed).unwrap();
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

    // Axes that are not those of the sensor, a clock that is off by more than is searched for, and a range that is too small.
    let imu = drive.join("imu.csv");
    let clipped = |numbers: &mut [f64]| {
        (numbers[1..4].iter_mut()).for_each(|rate| *rate = rate.clamp(-0.1, 0.1));
    };
    change_imu(&imu, &folder.join("late.csv"), |numbers| numbers[0] += 0.5);
    change_imu(&imu, &folder.join("clipped.csv"), clipped);
    let poses = |name: &str| fs::read(folder.join(name).join("poses_tum.txt")).unwrap();
    for (name, file, reason) in [
        (
            "turned",
            "street/drive_1/imu.csv",
            "its rates are not those",
        ),
        ("late", "late.csv", ""),
        ("clipped", "clipped.csv", "it is saturated"),
    ] {
        let mut wrong = odometry(name).with(format!("--imu={file}"));
        if name == "turned" {
            wrong = wrong.set("lidar_from_imu", "[0, 90, 0]");
        }
        assert_left_out(&wrong.succeeds(), reason);
        assert!(poses(name) == poses("without"), "{name}");
    }

    // Poses that are given calibrate it, too.
    let given = |name: &str| odometry(name).with("--poses=without/poses_tum.txt");
    let polished = given("given").with("--imu=street/drive_1/imu.csv");
    let stderr = polished.succeeds().stderr;
    assert!(!stderr.contains("inertial"), "{stderr}");
    assert_left_out(
        &given("left_out").with("--imu=clipped.csv").succeeds(),
        "saturated",
    );

    // A table that ends half-way.
    let table = fs::read_to_string(&imu).unwrap();
    let half: Vec<&str> = table.lines().take(table.lines().count() / 2).collect();
    fs::write(folder.join("half.csv"), half.join("\n")).unwrap();
    let stderr = given("half").with("--imu=half.csv").succeeds().stderr;
    assert!(
        stderr.contains("scans have no inertial measurements"),
        "{stderr}"
    );

    // A table that is none.
    fs::write(folder.join("imu.csv"), "time,speed\n0,1\n").unwrap();
    let refused = odometry("refused").with("--imu=imu.csv");
    refused.fails_with(&["the first row `time,speed`"]);
}

/// A walk of 55 m, the sensor turned by up to 30 degrees, with beams from 45 degrees up to 45 degrees down.
const HAND_HELD: &str = "\
output_folder: hand
path:
- {length_m: 15, turn_deg: 0, grade_percent: 0}
- {length_m: 12, turn_deg: 90, grade_percent: 0}
- {length_m: 12, turn_deg: 0, grade_percent: 0}
- {length_m: 12, turn_deg: -90, grade_percent: 0}
motion: {speed_m_s: 1.2, nodding_deg: 30, rolling_deg: 22, heaving_m: 0.03, sensor_height_m: 1.5}
scanner:
  elevations_deg: [44,41,38,35,32,29,26,23,20,17,14,11,8,5,2,0,-2,-5,-8,-11,-14,-17,-20,-23,-26,-29,-32,-35,-38,-41,-44,-45]
  azimuth_steps: 512
  min_range_m: 0.5
  rolling_shutter: true
imu: {grade: consumer, clock_offset_s: 0.03}
";

#[test]
fn a_sensor_in_the_hand_twice_per_second_is_followed_with_an_inertial_sensor() {
    const EVERY: usize = 5;
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("simulation.yml"), HAND_HELD).unwrap();
    run(folder, &["simulate", "simulation.yml"]);
    let drive = folder.join("hand/drive_1");
    let truth: Vec<Pose3> = true_poses(&drive).into_iter().step_by(EVERY).collect();
    for file in ["poses.txt", "odometry.txt"] {
        fs::rename(drive.join(file), folder.join(file)).unwrap();
    }
    let scans = fs::read_dir(drive.join("velodyne")).unwrap().count();
    for scan in (0..scans).filter(|scan| scan % EVERY != 0) {
        fs::remove_file(drive.join(format!("velodyne/{scan:06}.bin"))).unwrap();
    }
    // Largest error of a rotation between two scans [deg].
    let error_deg = |name: &str, arguments: &[&str]| {
        let mut command = fpmcl("odometry").in_folder(folder).with("hand/drive_1");
        for argument in arguments {
            command = command.with(argument);
        }
        let command = command.set("motion_compensation", "counter_clockwise");
        command.with("--output").with(name).succeeds();
        let rows = read_tum(&folder.join(name).join("poses_tum.txt")).unwrap();
        assert_eq!(rows.len(), truth.len());
        let turn = |pair: [&Pose3; 2]| pair[0].rotation.inverse() * pair[1].rotation;
        let errors = (1..rows.len()).map(|row| {
            let found = turn([row - 1, row].map(|row| &rows[row].map_from_lidar));
            let truth = turn([row - 1, row].map(|row| &truth[row]));
            found.angle_to(&truth).to_degrees()
        });
        errors.fold(0.0, f64::max)
    };
    let without = error_deg("without", &[]);
    let with = error_deg("with", &["--imu=hand/drive_1/imu.csv"]);
    eprintln!("{without} deg, with an inertial sensor {with} deg");
    assert!(without > 2.0 && with < 0.5, "{without} {with}");
}

#[test]
fn scans_are_compensated_by_measured_rotations() {
    let config = SimulationConfig {
        motion: MotionConfig {
            speed_m_s: 1.2,
            nodding_deg: 30.0,
            rolling_deg: 22.0,
            ..MotionConfig::default()
        },
        scanner: ScannerConfig {
            beams: 8,
            azimuth_steps: 2048,
            rolling_shutter: true,
            range_noise_m: 0.0,
            ..ScannerConfig::default()
        },
        imu: SimulatedImuConfig {
            grade: Some(ImuGrade::Consumer),
            clock_offset_s: 0.03,
        },
        n_scans: 100,
        ..SimulationConfig::default()
    };
    let drive = Simulation::new(&config, None, MemoryBudget::default()).unwrap();
    let times_s = drive.times_s();
    let scan = |(number, &time_s): (usize, &f64)| {
        let mut scan = drive.scan(number).scan;
        let after_s = |point: &glam::Vec3| 0.1 * point.y.atan2(point.x) / TAU;
        scan.times_s = scan.points.iter().map(after_s).collect();
        scan.time_s = Some(time_s);
        scan
    };
    let scans: Vec<Scan> = times_s.iter().enumerate().map(scan).collect();
    let pose_at = |time_s: f64| (drive.ego_motion).world_from_lidar(&drive.street.ground, time_s);
    let compensated = |scan: &Scan| -> Vec<glam::Vec3> {
        let moment_s = scan.time_s.unwrap();
        let of_point = |(point, &after_s): (&glam::Vec3, &f32)| {
            let moved = pose_at(moment_s).inverse() * pose_at(moment_s + f64::from(after_s));
            let point = moved * nalgebra::Point3::from(point.to_array()).cast::<f64>();
            glam::Vec3::from(point.cast::<f32>())
        };
        scan.points
            .iter()
            .zip(&scan.times_s)
            .map(of_point)
            .collect()
    };
    let track = PoseTrack::from_poses(drive.poses(), times_s.clone(), Pose3::identity());
    let recording = Recording::from_scans(scans.clone());
    let recording = recording.with_poses(track).unwrap();
    let imu = Imu {
        samples: Arc::new(ImuSamples::new(drive.imu_samples()).unwrap()),
        lidar_from_imu: None,
    };
    // Mean distance of points from where they would be without motion [m].
    let error_m = |recording: Recording| {
        let recording = recording.compensated_by_poses();
        let errors: Vec<f32> = (recording.scans().zip(&scans))
            .flat_map(|(found, scan)| {
                let found = found.unwrap().points;
                let distances = found.into_iter().zip(compensated(scan));
                distances.map(|(a, b)| a.distance(b)).collect::<Vec<_>>()
            })
            .collect();
        errors.iter().sum::<f32>() / errors.len() as f32
    };
    let without = error_m(recording.clone());
    let with = error_m(recording.with_imu(imu));
    eprintln!("{without} m, with an inertial sensor {with} m");
    assert!(without > 0.02 && with < 0.1 * without, "{without} {with}");
}

/// A bumpy street, along which the sensor nods and rolls by 6 degrees.
const BUMPY: &str = "\
output_folder: street
n_scans: 80
path:
- {length_m: 30, turn_deg: 0, grade_percent: 0}
- {length_m: 25, turn_deg: 90, grade_percent: 0}
- {length_m: 25, turn_deg: 0, grade_percent: 0}
motion: {nodding_deg: 6, rolling_deg: 6}
scanner: {beams: 32, azimuth_steps: 600, rolling_shutter: true}
imu: {grade: consumer, clock_offset_s: 0.03}
";

#[test]
fn localize_compensates_scans_by_an_inertial_sensor_and_leaves_out_a_wrong_one() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, BUMPY);
    let with_motion = |command: &str| {
        let command = fpmcl(command).in_folder(folder);
        command.set("motion_compensation", "counter_clockwise")
    };
    let build = with_motion("build-map").with("street/drive_1");
    build
        .with("--imu=street/drive_1/imu.csv")
        .with("--output=map.ply")
        .succeeds();
    let localize = |name: &str| {
        let localize = with_motion("localize")
            .with("street/drive_2")
            .with("--map=map.ply");
        let localize = localize.set("odometry", "scans");
        let localize = localize.set("map_pose_file", "street/drive_1/poses.txt");
        let localize = localize.set("map_calib_file", "street/drive_1/calib.txt");
        let localize = localize
            .set("pose_tracking", "True")
            .with("--truth=street/drive_2/poses.txt");
        let localize = localize.with("--calib=street/drive_2/calib.txt");
        localize.with(format!("--output={name}/result.npz"))
    };
    let rmse_m = |name: &str| {
        let report = json(&folder.join(name).join("report.json"));
        let metrics = &report["mcl"]["metrics"];
        metrics["position_m"]["rmse"].as_f64().unwrap()
    };
    localize("without").succeeds();
    let output = localize("with")
        .with("--imu=street/drive_2/imu.csv")
        .succeeds();
    assert!(!output.stderr.contains("left out"), "{}", output.stderr);
    let (without, with) = (rmse_m("without"), rmse_m("with"));
    eprintln!("{without} m, with an inertial sensor {with} m");
    assert!(with < 0.7 * without, "{without} {with}");
    // Its clock is 30 ms ahead, which is found and corrected; so it is where the result is refined.
    let found = |name: &str| {
        let report = json(&folder.join(name).join("report.json"));
        report["about"]["inertial sensor"]
            .as_str()
            .unwrap_or_default()
            .to_owned()
    };
    assert_eq!(found("without"), "");
    for is_refined in [false, true] {
        if is_refined {
            let refine = fpmcl("refine").in_folder(folder).with("with/result.npz");
            refine.succeeds();
        }
        let found = found("with");
        let offset_ms = found.split("offset of its clock ").nth(1);
        let offset_ms = offset_ms.and_then(|it| it.split(' ').next()?.parse::<f64>().ok());
        assert!((offset_ms.unwrap() - 30.0).abs() < 10.0, "{found}");
    }

    let imu = folder.join("street/drive_2/imu.csv");
    change_imu(&imu, &folder.join("late.csv"), |numbers| numbers[0] += 0.5);
    let output = localize("wrong").with("--imu=late.csv").succeeds();
    assert_left_out(&output, "");
    assert_eq!(found("wrong"), "late.csv, left out");
    let poses = |name: &str| fs::read(folder.join(name).join("mcl_tum.txt")).unwrap();
    assert!(poses("wrong") == poses("without"));
}
