//! Laws of simulated drives on disk: reproducible bytes, kept or replaced, frames as documented.

use approx::assert_relative_eq;

use std::path::PathBuf;

use super::*;
use crate::app::run::CLAIMS_FILE;
use crate::recording::{Recording, velodyne};
use crate::simulation::{PathSegment, ScannerConfig};

fn small(folder: &Path) -> SimulationConfig {
    SimulationConfig {
        output_folder: folder.into(),
        n_scans: 6,
        path: vec![PathSegment::new(30.0, 20.0, 2.0)],
        scanner: ScannerConfig {
            beams: 16,
            azimuth_steps: 90,
            ..ScannerConfig::default()
        },
        ..SimulationConfig::default()
    }
}

fn simulate(config: &SimulationConfig, existing: Existing) -> Result<SimulationReport> {
    write_drive(config, existing, &|_, _| {}, &Interrupt::default())
}

/// Every file of a drive with its bytes, except the configuration, which names the folder, and the claims.
fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    for part in ["", "velodyne", "labels"] {
        for entry in fs::read_dir(folder.join(part)).unwrap() {
            let path = entry.unwrap().path();
            let is_named = ["simulation.yml", CLAIMS_FILE].map(|name| path.ends_with(name));
            if path.is_file() && is_named == [false; 2] {
                let name = path.strip_prefix(folder).unwrap().to_owned();
                files.push((name, fs::read(&path).unwrap()));
            }
        }
    }
    files.sort();
    files
}

#[test]
fn the_same_seed_gives_the_same_bytes_at_any_number_of_threads() {
    let written = [1, 2, 5].map(|threads| {
        let folder = tempfile::tempdir().unwrap();
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| simulate(&small(folder.path()), Existing::Keep))
            .unwrap();
        contents(&folder.path().join("drive_1"))
    });
    assert_eq!(written[0].len(), 5 + 2 * 6);
    assert_eq!(written[0], written[1]);
    assert_eq!(written[0], written[2]);
}

#[test]
fn an_interrupted_drive_is_completed_with_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(folder.path());
    let drive = config.drive_folder();
    assert_eq!(simulate(&config, Existing::Keep).unwrap().kept, 0);
    let whole = contents(&drive);
    // As after a crash in the middle: no poses yet, scans missing, one half written.
    fs::remove_file(drive.join("poses.txt")).unwrap();
    fs::remove_file(drive.join("velodyne/000004.bin")).unwrap();
    fs::remove_file(drive.join("velodyne/000005.bin")).unwrap();
    fs::write(drive.join("velodyne/.fpmcl-1.part"), [1, 2, 3]).unwrap();
    assert_eq!(simulate(&config, Existing::Keep).unwrap().kept, 4);
    assert_eq!(contents(&drive), whole);
}

#[test]
fn an_interrupt_keeps_the_finished_scans_and_reports_their_number() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(folder.path());
    let interrupt = Interrupt::default();
    let after_two = |done: usize, _all: usize| {
        if done == 2 {
            interrupt.request();
        }
    };
    let one_thread = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    let stopped =
        one_thread.install(|| write_drive(&config, Existing::Keep, &after_two, &interrupt));
    let message = stopped.unwrap_err().to_string();
    assert!(message.contains("2 of 6 scans are kept"), "{message}");
    assert!(!config.drive_folder().join("poses.txt").exists());
    assert_eq!(simulate(&config, Existing::Keep).unwrap().kept, 2);
}

#[test]
fn what_exists_is_kept_without_force_and_replaced_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(folder.path());
    simulate(&config, Existing::Keep).unwrap();
    let before = contents(&config.drive_folder());
    assert_eq!(simulate(&config, Existing::Keep).unwrap().kept, 6);

    let mut other = config.clone();
    other.seed = 2;
    other.n_scans = 3;
    let message = simulate(&other, Existing::Keep).unwrap_err().to_string();
    assert!(message.contains("--force"), "{message}");
    assert_eq!(contents(&config.drive_folder()), before);

    simulate(&other, Existing::Replace).unwrap();
    let after = contents(&config.drive_folder());
    assert_eq!(after.len(), 5 + 2 * 3, "scans of the old drive are gone");
}

#[test]
fn a_drive_of_another_executable_is_reported_or_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(folder.path());
    let drive = config.drive_folder();
    simulate(&config, Existing::Keep).unwrap();
    let whole = contents(&drive);
    let age = || {
        let claims = fs::read_to_string(drive.join(CLAIMS_FILE)).unwrap();
        let aged = claims.replace(version::executable_hash().unwrap(), "another");
        fs::write(drive.join(CLAIMS_FILE), aged).unwrap();
    };
    let make_old_scan = || fs::write(drive.join("velodyne/000002.bin"), [0; 16]).unwrap();
    assert_eq!(simulate(&config, Existing::Renew).unwrap().kept, 6);

    for is_complete in [true, false] {
        age();
        make_old_scan();
        if !is_complete {
            fs::remove_file(drive.join("poses.txt")).unwrap();
        }
        let message = simulate(&config, Existing::Keep).unwrap_err().to_string();
        for expected in ["another build", "remove that folder", "--force"] {
            assert!(message.contains(expected), "{message}");
        }
        assert_eq!(simulate(&config, Existing::Renew).unwrap().kept, 0);
        assert_eq!(contents(&drive), whole);
    }
    // A comparison does not replace a drive of another configuration.
    age();
    let other = SimulationConfig { seed: 2, ..config };
    let message = simulate(&other, Existing::Renew).unwrap_err().to_string();
    assert!(message.contains("another configuration"), "{message}");
    assert!(message.contains("remove that folder"), "{message}");
    // Nor one that is not claimed.
    fs::remove_file(drive.join(CLAIMS_FILE)).unwrap();
    let message = simulate(&other, Existing::Renew).unwrap_err().to_string();
    assert!(message.contains("other files"), "{message}");
}

#[test]
fn a_drive_of_which_only_the_poses_are_left_is_completed() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(folder.path());
    let drive = config.drive_folder();
    simulate(&config, Existing::Keep).unwrap();
    let whole = contents(&drive);
    for part in ["velodyne/000002.bin", "labels/000003.label", "odometry.txt"] {
        fs::remove_file(drive.join(part)).unwrap();
    }
    assert_eq!(simulate(&config, Existing::Keep).unwrap().kept, 4);
    assert_eq!(contents(&drive), whole);
    fs::remove_dir_all(drive.join("velodyne")).unwrap();
    fs::remove_dir_all(drive.join("labels")).unwrap();
    assert_eq!(simulate(&config, Existing::Keep).unwrap().kept, 0);
    assert_eq!(contents(&drive), whole);
}

#[test]
fn a_drive_that_was_moved_is_kept_and_one_along_another_path_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let poses = folder.path().join("path.txt");
    let straight = |step_m: f64| {
        let row = |k| format!("1 0 0 0 0 1 0 0 0 0 1 {}\n", step_m * f64::from(k));
        (0..12).map(row).collect::<String>()
    };
    fs::write(&poses, straight(3.0)).unwrap();
    let calib = folder.path().join("calib.txt");
    fs::write(&calib, "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n").unwrap();
    let here = SimulationConfig {
        path_pose_file: Some(poses.clone().into()),
        path: Vec::new(),
        ..small(&folder.path().join("here"))
    };
    simulate(&here, Existing::Keep).unwrap();
    fs::rename(folder.path().join("here"), folder.path().join("there")).unwrap();
    let moved_poses = folder.path().join("moved.txt");
    fs::rename(&poses, &moved_poses).unwrap();
    let there = SimulationConfig {
        output_folder: folder.path().join("there").into(),
        path_pose_file: Some(moved_poses.clone().into()),
        ..here
    };
    assert_eq!(simulate(&there, Existing::Keep).unwrap().kept, 6);
    fs::write(&moved_poses, straight(2.7)).unwrap();
    let message = simulate(&there, Existing::Keep).unwrap_err().to_string();
    assert!(message.contains("--force"), "{message}");
}

#[test]
fn drives_are_read_back_in_the_documented_frames() {
    let folder = tempfile::tempdir().unwrap();
    let mapping = small(folder.path());
    let query = SimulationConfig {
        drive: 2,
        ..mapping.clone()
    };
    let [map, query] = [mapping, query].map(|config| {
        simulate(&config, Existing::Keep).unwrap();
        let drive = config.drive_folder();
        let sequence = Recording::open(&drive).unwrap().with_own_poses().unwrap();
        let poses = CameraPoses::read(&drive.join("poses.txt")).unwrap();
        (prepare(&config).unwrap().poses(), sequence, poses, drive)
    });
    let (truth, sequence, ..) = &map;
    for (frame, pose) in sequence.frames.iter().zip(truth) {
        let expected = truth[0].inverse() * pose;
        assert_relative_eq!(frame.map_from_lidar.unwrap(), expected, epsilon = 1e-6);
    }
    let frame = map.2.frame(&sequence.world().1);
    for (pose, world_from_cam0) in query.0.iter().zip(&query.2.world_from_cam0) {
        let in_map = frame.map_from_lidar(world_from_cam0);
        assert_relative_eq!(in_map, truth[0].inverse() * pose, epsilon = 1e-6);
    }
    let labels = velodyne::read_labels(&query.3.join("labels/000003.label")).unwrap();
    assert_eq!(labels.len(), query.1.frames[3].read().unwrap().len());
    // Two drives start in different places.
    assert!((map.0[0].inverse() * query.0[0]).translation.vector.norm() > 0.2);
}

#[test]
fn a_missing_calibration_is_reported_with_its_key() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(folder.path());
    config.path_pose_file = Some(folder.path().join("07.txt").into());
    let message = format!("{:#}", simulate(&config, Existing::Keep).unwrap_err());
    assert!(message.contains("calib.txt"), "{message}");
    assert!(message.contains("path_calib_file"), "{message}");
}
