//! Poses from the scans themselves, through the binary: drive once, drive again.

use std::fs;
use std::path::Path;

use fpmcl::geometry::Pose3;
use fpmcl::internals::MappedPly;
use fpmcl::internals::ply;
use fpmcl::map::{Map, MapBuilder, MapCache, MapConfig, MapOptions};
use fpmcl::mapping::map_recording;
use fpmcl::recording::{PoseTrack, Recording, read_tum};
use fpmcl::rendering::Backend;
use glam::DVec3;

use crate::common::{fpmcl, json, real_recording, run, simulate_two_drives};

/// A street with a bend and traffic.
const SIMULATION: &str = "\
output_folder: street
n_scans: 30
path:
- {length_m: 40, turn_deg: 30, grade_percent: 3}
scanner:
  beams: 32
  azimuth_steps: 1000
";

/// True poses of a drive in the lidar frame of its first scan.
fn truth(drive: &Path) -> PoseTrack {
    PoseTrack::read(&drive.join("poses.txt"), Some(&drive.join("calib.txt"))).unwrap()
}

fn poses(file: &Path) -> Vec<Pose3> {
    let rows = read_tum(file).unwrap();
    rows.iter().map(|row| row.map_from_lidar).collect()
}

/// Root mean square of the distances of positions [m].
fn rmse_m(found: &[Pose3], truth: &[Pose3]) -> f64 {
    assert_eq!(found.len(), truth.len());
    let squares = found
        .iter()
        .zip(truth)
        .map(|(found, truth)| (found.translation.vector - truth.translation.vector).norm_squared());
    (squares.sum::<f64>() / found.len() as f64).sqrt()
}

/// Requires that a map that the program has written has the bytes of that of the library.
#[track_caller]
fn same_as_of_the_library(folder: &Path, drive: &str, older: Option<&str>, file: &str) {
    let options = MapOptions {
        backend: Backend::Cpu,
        cache: MapCache::NextToMap,
        ..MapOptions::default()
    };
    let older = older.map(|name| Map::load(&folder.join(name), &options).unwrap());
    let recording = Recording::open(folder.join("street").join(drive)).unwrap();
    let builder = MapBuilder::new(MapConfig::default());
    let built = map_recording(&recording, older.as_ref(), builder).unwrap();
    built.map.save(&folder.join("library.ply")).unwrap();
    let read = |name: &str| fs::read(folder.join(name)).unwrap();
    assert!(read(file) == read("library.ply"), "{file} differs");
}

#[test]
fn a_recording_is_enough_for_a_map_and_for_another_drive_in_it() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, SIMULATION);
    let [first, second] = [1, 2].map(|drive| truth(&folder.join(format!("street/drive_{drive}"))));
    for drive in ["drive_1", "drive_2"] {
        for file in ["poses.txt", "odometry.txt"] {
            fs::remove_file(folder.join("street").join(drive).join(file)).unwrap();
        }
    }

    let table = run(folder, &["odometry", "street/drive_1", "--output", "poses"]);
    assert!(table.contains("loops"), "{table}");
    let found = poses(&folder.join("poses/poses_tum.txt"));
    let error_m = rmse_m(&found, &first.map_from_lidar);
    assert!(error_m < 0.03, "{error_m}");
    let report = json(&folder.join("poses/report.json"));
    assert_eq!(
        (&report["scans"], &report["predicted"]),
        (&30.into(), &0.into())
    );
    for file in [
        "poses_kitti.txt",
        "odometry_tum.txt",
        "trajectory.npz",
        "frames.csv",
        "path.png",
    ] {
        assert!(folder.join("poses").join(file).is_file(), "{file}");
    }
    // The same bytes with one thread.
    let again = [
        "odometry",
        "street/drive_1",
        "--output",
        "again",
        "--threads",
        "1",
    ];
    run(folder, &again);
    for file in [
        "poses_tum.txt",
        "poses_kitti.txt",
        "odometry_tum.txt",
        "trajectory.npz",
    ] {
        let read = |output: &str| fs::read(folder.join(output).join(file)).unwrap();
        assert!(read("poses") == read("again"), "{file}");
    }

    let build = [
        "build-map",
        "street/drive_1",
        "--output",
        "map.ply",
        "--set",
        "visualize=False",
    ];
    run(folder, &build);
    let of_map = poses(&folder.join("map.poses_tum.txt"));
    assert!(rmse_m(&of_map, &found) < 1e-4);
    let map = fs::read(folder.join("map.ply")).unwrap();
    same_as_of_the_library(folder, "drive_1", None, "map.ply");
    // The poses next to the map serve another build.
    let again = fpmcl("build-map").in_folder(folder).with("street/drive_1");
    let again = again
        .with("--output=map.ply")
        .set("visualize", "False")
        .with("--force");
    let output = again.succeeds();
    assert!(
        output.stderr.contains("finished already"),
        "{}",
        output.stderr
    );
    assert!(fs::read(folder.join("map.ply")).unwrap() == map);

    let localize = [
        "localize",
        "street/drive_2",
        "--map",
        "map.ply",
        "--output",
        "r/r.npz",
    ];
    run(
        folder,
        &[
            &localize[..],
            &["--backend", "cpu", "--set", "plot_loc_results=False"],
        ]
        .concat(),
    );
    let found = poses(&folder.join("r/mcl_tum.txt"));
    let truth = second.in_map(&first.world_from_map).map_from_lidar;
    let planar = |poses: &[Pose3]| -> Vec<Pose3> {
        let flat = |pose: &Pose3| {
            let t = pose.translation.vector;
            Pose3::translation(t.x, t.y, 0.0)
        };
        poses.iter().map(flat).collect()
    };
    let error_m = rmse_m(&planar(&found[3..]), &planar(&truth[3..]));
    assert!(error_m < 0.03, "{error_m}");
}

#[test]
fn a_second_drive_is_added_to_the_map_of_the_first_in_its_frame() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, SIMULATION);
    let second = truth(&folder.join("street/drive_2"));
    let build = |flags: &[&str]| {
        let build = flags
            .iter()
            .fold(fpmcl("build-map"), |it, flag| it.with(flag));
        build
            .in_folder(folder)
            .set("visualize", "False")
            .with("--backend=cpu")
    };
    build(&["street/drive_1", "--output=map.ply", "--set=n_scans=18"]).succeeds();
    let onto = ["street/drive_2", "--onto=map.ply", "--output=both.ply"];
    let output = build(&onto).succeeds();
    assert!(output.stdout.contains("added"), "{}", output.stdout);
    // Its poses are in the world of the first drive.
    let found = poses(&folder.join("both.poses_tum.txt"));
    let error_m = rmse_m(&found, &second.in_map(&Pose3::identity()).map_from_lidar);
    assert!(error_m < 0.05, "{error_m}");
    let report = json(&folder.join("both.report.json"));
    let changes = &report["changes"];
    let area_m2 = |key: &str| changes[key].as_f64().unwrap();
    // The older map ends before the street does; nothing but traffic has moved.
    let added_m2 = area_m2("added_m2");
    assert!(added_m2 > 300.0, "{changes}");
    assert!(area_m2("gone_m2") < 0.05 * added_m2, "{changes}");
    let triangles = |file: &str| json(&folder.join(file))["triangles"].as_u64().unwrap();
    let joined = triangles("map.report.json") + changes["added_triangles"].as_u64().unwrap()
        - changes["gone_triangles"].as_u64().unwrap();
    assert_eq!(triangles("both.report.json"), joined);

    same_as_of_the_library(folder, "drive_2", Some("map.ply"), "both.ply");

    // A thousand kilometres away, the poses in the world are the same.
    let mut older = MappedPly::open(&folder.join("map.ply")).unwrap();
    older.origin = DVec3::new(1_024_000.0, -1_024_000.0, 0.0);
    let map_from_near = Pose3::translation(older.origin.x, older.origin.y, 0.0);
    let mut path = older.path.clone().unwrap();
    path.world_from_map *= map_from_near.inverse();
    for pose in &mut path.map_from_lidar {
        *pose = map_from_near * *pose;
    }
    ply::write_joined(&folder.join("far.ply"), &[&older], Some(&path)).unwrap();
    build(&["street/drive_2", "--onto=far.ply", "--output=far_both.ply"]).succeeds();
    let far = poses(&folder.join("far_both.poses_tum.txt"));
    let apart_m = rmse_m(&far, &found);
    assert!(apart_m < 2e-4, "{apart_m}");

    // The same drive again: the poses next to the map serve, and the map is the same.
    let map = fs::read(folder.join("both.ply")).unwrap();
    let again = build(&onto).with("--force").with("--threads=1").succeeds();
    assert!(
        again.stderr.contains("finished already"),
        "{}",
        again.stderr
    );
    assert!(fs::read(folder.join("both.ply")).unwrap() == map);

    // A drive elsewhere is not added.
    let elsewhere = SIMULATION.replace("turn_deg: 30", "turn_deg: -50") + "seed: 7\n";
    let other = folder.join("other");
    fs::create_dir(&other).unwrap();
    simulate_two_drives(&other, &elsewhere);
    build(&[
        "other/street/drive_2",
        "--onto=map.ply",
        "--output=lost.ply",
    ])
    .fails_with(&["not found in the map"]);
    assert!(!folder.join("lost.ply").exists());

    build(&[
        "street/drive_2",
        "--onto=map.ply",
        "--output=map.ply",
        "--force",
    ])
    .fails_with(&["mesh_file", "onto"]);
}

#[test]
fn poses_that_were_found_without_compensation_are_polished_to_a_centimetre() {
    let Some(recording) = real_recording("kitti-0926-drive-0005") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("polished");
    fpmcl("odometry")
        .with(&recording)
        .with(format!(
            "--poses={}",
            recording.join("poses_uncompensated.txt").display()
        ))
        .with(format!("--calib={}", recording.join("calib.txt").display()))
        .with(format!("--output={}", output.display()))
        .succeeds();
    let read = |file: &Path| {
        PoseTrack::read(file, Some(&recording.join("calib.txt")))
            .unwrap()
            .map_from_lidar
    };
    let truth = read(&recording.join("poses.txt"));
    let before_m = rmse_m(&read(&recording.join("poses_uncompensated.txt")), &truth);
    let after_m = rmse_m(&read(&output.join("poses_kitti.txt")), &truth);
    assert!(before_m > 0.05 && after_m < 0.015, "{before_m} {after_m}");
}

#[test]
fn thinned_recordings_are_followed_or_warned_about() {
    for (name, scans, poses, strides) in [
        ("os1-thinned", "velodyne", "slam_poses.txt", 2..=3),
        ("livox-hku2", "scans", "optimized_poses.txt", 2..=2),
    ] {
        let Some(recording) = real_recording(name) else {
            continue;
        };
        let truth = PoseTrack::read(&recording.join(poses), None).unwrap();
        let position = |row: usize| truth.map_from_lidar[row].translation.vector;
        let times = fs::read_to_string(recording.join("times.txt")).unwrap();
        let times: Vec<&str> = times.lines().collect();
        let mut files: Vec<_> = fs::read_dir(recording.join(scans)).unwrap().collect();
        files.sort_by_key(|file| file.as_ref().unwrap().file_name());
        for stride in strides {
            let folder = tempfile::tempdir().unwrap();
            let thinned = folder.path().join("velodyne");
            fs::create_dir(&thinned).unwrap();
            let rows: Vec<usize> = (0..files.len()).step_by(stride).collect();
            let mut kept_times = String::new();
            for (number, &row) in rows.iter().enumerate() {
                let scan = files[row].as_ref().unwrap().path();
                fs::copy(scan, thinned.join(format!("{number:06}.pcd"))).unwrap();
                kept_times += &format!("{}\n", times[row]);
            }
            fs::write(folder.path().join("times.txt"), kept_times).unwrap();
            let odometry = fpmcl("odometry").in_folder(folder.path()).with("velodyne");
            let output = odometry.with("--output=poses").succeeds();
            let report = json(&folder.path().join("poses/report.json"));
            let path_m = report["path_m"].as_f64().unwrap();
            let steps = rows
                .windows(2)
                .map(|pair| (position(pair[1]) - position(pair[0])).norm());
            let true_m: f64 = steps.sum();
            let error = (path_m / true_m - 1.0).abs();
            let is_warned = output.stderr.contains("did not fit the scans before them");
            assert!(
                error < 0.02 || is_warned,
                "{name} / {stride}: {path_m} of {true_m} m"
            );
            // At least two of three scans are followed where a third of the view is in common.
            let predicted = report["predicted"].as_u64().unwrap() as usize;
            assert!(
                3 * predicted <= rows.len() || stride > 2,
                "{name} / {stride}: {predicted}"
            );
        }
    }
}

#[test]
fn an_adjustment_that_moves_a_drive_farther_than_odometry_drifts_is_left_out() {
    let Some(recording) = real_recording("vlp16-raw") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let odometry = fpmcl("odometry").in_folder(folder.path());
    let odometry = odometry
        .with(recording.join("velodyne"))
        .with("--output=poses");
    let output = odometry.set("n_scans", "20").succeeds();
    let [found, odometry] = ["poses_tum.txt", "odometry_tum.txt"].map(|name| {
        poses(&folder.path().join("poses").join(name))
            .pop()
            .unwrap()
    });
    let apart_m = (found.translation.vector - odometry.translation.vector).norm();
    // 6 m of path, and a voxel.
    assert!(apart_m < 0.06 * 7.0 + 0.5, "{apart_m}: {}", output.stderr);
}
