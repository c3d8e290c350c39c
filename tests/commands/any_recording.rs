//! Recordings as users have them: folders as arguments, without true poses, odometry or a known sensor.

use std::fs;
use std::path::Path;
use std::sync::LazyLock;

use fpmcl::geometry::{Pose3, StampedPose};
use fpmcl::internals::app::LocalizationResults;
use fpmcl::internals::ply;
use fpmcl::recording::PoseTrack;
use fpmcl::recording::{read_tum, write_tum};
use nalgebra::{UnitQuaternion, Vector3};
use serde_json::Value;
use tempfile::TempDir;

use crate::common::{
    Fpmcl, Output, copy_of, fpmcl, json, real_recording, run, shared_folder, simulate_two_drives,
};

/// A street with a bend, scanned by 32 beams that are not evenly spaced, without times.
const SIMULATION: &str = "\
output_folder: street
n_scans: 14
path:
- {length_m: 40, turn_deg: 30, grade_percent: 3}
scanner:
  elevations_deg: [15, 10, 7, 5, 3.5, 2, 1, 0.3, -0.3, -1, -1.6, -2.2, -2.8, -3.4, -4, -4.7, -5.4, -6.2, -7, -8, -9, -10, -11.2, -12.5, -14, -15.5, -17, -19, -21, -23, -25, -27]
  azimuth_steps: 900
";

/// True poses of drive 2 in the map of drive 1.
fn truth(folder: &Path) -> Vec<Pose3> {
    let track = |drive: &str| {
        let drive = folder.join("street").join(drive);
        PoseTrack::read(&drive.join("poses.txt"), Some(&drive.join("calib.txt"))).unwrap()
    };
    let map = track("drive_1").world_from_map;
    track("drive_2").in_map(&map).map_from_lidar
}

/// Two simulated drives and a map of the first.
static FIRST_DRIVE_MAPPED: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = shared_folder();
    simulate_two_drives(folder.path(), SIMULATION);
    let build = ["build-map", "street/drive_1", "--output", "map.ply"];
    run(folder.path(), &build);
    folder
});

/// A folder with two simulated drives and a map of the first, and the true poses of the second in it.
fn with_first_drive_mapped() -> (TempDir, Vec<Pose3>) {
    let folder = copy_of(FIRST_DRIVE_MAPPED.path());
    let truth = truth(folder.path());
    (folder, truth)
}

/// Largest distance of the found positions from the true ones, from a row on [m].
fn largest_error_m(result: &Path, truth: &[Pose3], first: usize) -> f64 {
    let found = read_tum(&result.with_file_name("mcl_tum.txt")).unwrap();
    let rows = found.iter().zip(truth).skip(first);
    rows.map(|(row, truth)| {
        let found = row.map_from_lidar.translation.vector;
        (found - truth.translation.vector).xy().norm()
    })
    .fold(0.0, f64::max)
}

fn localize(folder: &Path, drive: &str, result: &str) -> Fpmcl {
    fpmcl("localize")
        .in_folder(folder)
        .with(drive)
        .with("--map=map.ply")
        .with(format!("--output={result}"))
        .with("--backend=cpu")
        .set("plot_loc_results", "False")
}

#[test]
fn two_folders_are_enough_for_a_map_and_a_trajectory_in_it() {
    let (folder, _truth) = with_first_drive_mapped();
    let folder = folder.path();
    let described = run(folder, &["info", "street/drive_1"]);
    for part in ["KITTI odometry", "32 beams", "build-map", "ready"] {
        assert!(described.contains(part), "{described}");
    }
    let sensor = json(&folder.join("map.report.json"))["sensor"].clone();
    assert_eq!(sensor["beams"], 32);
    let height_m = sensor["mounting"]["height_m"].as_f64().unwrap();
    assert!((height_m - 1.73).abs() < 0.05, "{height_m}");

    // No true poses, no odometry, no start.
    let output = localize(folder, "street/drive_2", "anywhere/r.npz").succeeds();
    assert!(!output.stdout.contains("RMSE"), "{}", output.stdout);
    let report = json(&folder.join("anywhere/report.json"));
    assert_eq!(report["mcl"], Value::Null);
    assert_eq!(report["summary"]["frames"], 14);
    let truth = truth(folder);
    let error_m = largest_error_m(&folder.join("anywhere/r.npz"), &truth, 2);
    assert!(error_m < 0.1, "{error_m} m");

    // The refinement takes what it needs from the localization, and evaluation the true poses.
    run(folder, &["refine", "anywhere/r.npz"]);
    assert_eq!(
        json(&folder.join("anywhere/report.json"))["refined"],
        Value::Null
    );
    run(
        folder,
        &[
            "evaluate",
            "anywhere/r.npz",
            "--set",
            "pose_file=street/drive_2/poses.txt",
            "--set",
            "calib_file=street/drive_2/calib.txt",
        ],
    );
    let rmse_m =
        json(&folder.join("anywhere/report.json"))["refined"]["metrics"]["position_m"]["rmse"]
            .as_f64()
            .unwrap();
    assert!(rmse_m < 0.05, "{rmse_m} m");

    // A start that is known.
    let start = truth[0].translation;
    let heading_deg = truth[0].rotation.euler_angles().2.to_degrees();
    localize(folder, "street/drive_2", "start/r.npz")
        .with(format!(
            "--start={:.1},{:.1},{heading_deg:.0}",
            start.x, start.y
        ))
        .succeeds();
    let error_m = largest_error_m(&folder.join("start/r.npz"), &truth, 2);
    assert!(error_m < 0.1, "{error_m} m");
    localize(folder, "street/drive_2", "far/r.npz")
        .with("--start=5000,0,0")
        .fails_with(&["outside the mapped area"]);
    localize(folder, "street/drive_2", "word/r.npz")
        .with("--start=here")
        .rejects_usage_with(&["12.5,-3,90"]);
}

/// Writes poses of drive 2 that are off by a shift [m] and a turn about the vertical axis.
fn write_rough_poses(path: &Path, truth: &[Pose3], shift_m: [f64; 2], turn_deg: f64) {
    let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, turn_deg.to_radians());
    let rows = truth.iter().enumerate().map(|(frame, pose)| StampedPose {
        frame,
        time_s: 0.1 * frame as f64,
        map_from_lidar: Pose3::from_parts(
            (pose.translation.vector + Vector3::new(shift_m[0], shift_m[1], 0.0)).into(),
            pose.rotation * turn,
        ),
    });
    let mut text = Vec::new();
    write_tum(&mut text, &rows.collect::<Vec<_>>()).unwrap();
    fs::write(path, text).unwrap();
}

#[test]
fn a_rough_trajectory_comes_to_centimetres_and_one_from_elsewhere_is_marked() {
    let (folder, truth) = with_first_drive_mapped();
    let folder = folder.path();
    let refine = |track: &str| {
        fpmcl("refine")
            .in_folder(folder)
            .with(track)
            .with("--recording=street/drive_2")
            .with("--map=map.ply")
            .with("--backend=cpu")
            .set("plot_loc_results", "False")
    };
    let error_m = |result: &str, row: usize| {
        let found = read_tum(&folder.join(result).join("refined_tum.txt")).unwrap();
        let off = found[row].map_from_lidar.translation.vector - truth[row].translation.vector;
        off.xy().norm()
    };
    let rough = folder.join("gps.txt");
    write_rough_poses(&rough, &truth, [1.8, -1.2], 12.0);
    let before = fs::read(&rough).unwrap();
    refine("gps.txt").with("--uncertainty=1,8").succeeds();
    for row in 0..truth.len() {
        let error_m = error_m("gps_refined", row);
        assert!(error_m < 0.06, "{row}: {error_m} m");
    }
    assert_eq!(fs::read(&rough).unwrap(), before);
    let report = json(&folder.join("gps_refined/report.json"));
    assert_eq!(report["summary"]["tracking"], 14);
    refine("gps.txt").fails_with(&["refined.npz exists", "--force"]);

    // A track that leaves the truth is followed by the odometry, and the distance is reported.
    let mut turned = truth.clone();
    for pose in &mut turned {
        let angle_rad = 1.2;
        let first = truth[0].translation.vector;
        let offset = pose.translation.vector - first;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle_rad);
        pose.translation.vector = first + turn * offset;
    }
    write_rough_poses(&folder.join("turned.txt"), &turned, [0.3, 0.2], 3.0);
    let output = refine("turned.txt").with("--uncertainty=0.5,8").succeeds();
    assert!(
        output.stderr.contains("in the frame of the map"),
        "{}",
        output.stderr
    );
    assert!(error_m("turned_refined", 12) < 0.06);

    // From where the uncertainty does not reach the truth, nothing is claimed.
    write_rough_poses(&folder.join("far.txt"), &truth, [400.0, 0.0], 0.0);
    let far = refine("far.txt").with("--output=far/r");
    let output = far.set("all_poses", "True").exits_with(3);
    assert!(
        output.stderr.contains("14 of 14 poses"),
        "{}",
        output.stderr
    );
    assert!((error_m("far", 5) - 400.0).abs() < 1e-3);
    // A result without the ending is one.
    refine("far/r").fails_with(&["far/r already has refined poses", "--force"]);
    let report = json(&folder.join("far/report.json"));
    assert_eq!(report["summary"]["tracking"], 0);
}

/// A straight street that the sensor sees 18 m of.
const SHORT_SIGHTED: &str = "\
output_folder: street
n_scans: 70
path:
- {length_m: 120, turn_deg: 20, grade_percent: 1}
scanner: {beams: 32, azimuth_steps: 600, max_range_m: 18}
";

#[test]
fn where_the_map_ends_the_odometry_carries_on_with_growing_covariance() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, SHORT_SIGHTED);
    let build = ["build-map", "street/drive_1", "--output", "whole.ply"];
    run(folder, &build);
    // No surface from 5 to 48 m: for about 15 m of the way no beam meets the map.
    let (mut mesh, path) = ply::read_map(&folder.join("whole.ply")).unwrap();
    let vertices = mesh.vertices.clone();
    let is_ahead = |vertex: &u32| (5.0..48.0).contains(&vertices[*vertex as usize].x);
    mesh.triangles
        .retain(|triangle| !triangle.iter().any(is_ahead));
    ply::write(&folder.join("map.ply"), &mesh, path.as_ref()).unwrap();
    let call = localize(folder, "street/drive_2", "run/r.npz");
    call.set("all_poses", "True").succeeds();

    let truth = truth(folder);
    let results = LocalizationResults::read(&folder.join("run/r.npz")).unwrap();
    let agreements = results.agreements.as_ref().unwrap();
    // Where no beam meets the map there is nothing to agree with.
    let unmapped: Vec<usize> = (0..results.len())
        .filter(|&row| agreements[row] < 0.0)
        .collect();
    let (&first, &last) = (unmapped.first().unwrap(), unmapped.last().unwrap());
    assert!(unmapped.len() >= 10, "{unmapped:?}");
    let covariances = results.covariances.as_ref().unwrap();
    let deviation_m = |row: usize| (covariances[row][(0, 0)] + covariances[row][(1, 1)]).sqrt();
    let (before, after) = (deviation_m(first - 4), deviation_m(69));
    let inside = (unmapped.iter().map(|&row| deviation_m(row))).fold(0.0, f64::max);
    assert!(
        inside > 5.0 * before.max(after),
        "{before} {inside} {after} m"
    );
    let result = folder.join("run/r.npz");
    assert!(largest_error_m(&result, &truth, 0) < 3.0 * inside);
    let error_m = largest_error_m(&result, &truth, last + 5);
    assert!(error_m < 0.05, "{error_m} m after the map is back");
}

#[test]
fn poses_are_matched_by_time_and_their_absence_is_explained() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, SIMULATION);
    let drive = folder.join("street/drive_1");
    let track = PoseTrack::read(&drive.join("poses.txt"), Some(&drive.join("calib.txt"))).unwrap();
    fs::create_dir(folder.join("scans")).unwrap();
    for scan in 0..14 {
        // Seconds since 1970, half a tenth after a row of the poses.
        let name = format!("scans/{:.2}.bin", 1_700_000_000.05 + 0.1 * f64::from(scan));
        let from = drive.join(format!("velodyne/{scan:06}.bin"));
        fs::copy(from, folder.join(name)).unwrap();
    }
    let tum = |later_s: f64| {
        let row = |(row, pose): (usize, &Pose3)| {
            let time_s = 1_700_000_000.0 + later_s + 0.1 * row as f64;
            let (t, q) = (pose.translation, pose.rotation.coords);
            format!(
                "{time_s:.3} {} {} {} {} {} {} {}\n",
                t.x, t.y, t.z, q.x, q.y, q.z, q.w
            )
        };
        let rows: String = track.map_from_lidar.iter().enumerate().map(row).collect();
        fs::write(folder.join("poses.tum"), rows).unwrap();
    };
    let build = || {
        fpmcl("build-map")
            .in_folder(folder)
            .with("scans")
            .with("--poses=poses.tum")
            .with("--output=map.ply")
            .with("--force")
            .set("visualize", "False")
    };
    // The scans of row n are at the time of row n, whatever their order or number.
    tum(0.05);
    build().succeeds();
    let report = json(&folder.join("map.report.json"));
    assert_eq!(report["frames"], 14);
    // The last scan is half an interval after the last row, which is near enough.
    tum(0.0);
    build().succeeds();
    // Another clock.
    tum(5000.0);
    build().fails_with(&["14 of 14 scans have no pose", "1700005000.000"]);
    // No poses at all, where given ones are asked for.
    fpmcl("build-map")
        .in_folder(folder)
        .with("scans")
        .with("--output=other.ply")
        .set("poses", "given")
        .fails_with(&["has no poses", "--poses"]);
}

/// A folder with a map of the even frames of a real recording, that recording, and what was printed.
fn with_even_frames_mapped(name: &str) -> Option<(TempDir, String, Output)> {
    let recording = real_recording(name)?.display().to_string();
    let folder = tempfile::tempdir().unwrap();
    let output = fpmcl("build-map")
        .in_folder(folder.path())
        .with(&recording)
        .with("--output=map.ply")
        .set("frame_step", "2")
        .set("visualize", "False")
        .succeeds();
    Some((folder, recording, output))
}

/// Localizes the odd frames of a recording, whose true poses the arguments name, and returns the report.
fn localize_odd_frames(folder: &Path, recording: &str, truth: &[String]) -> Value {
    let call = localize(folder, recording, "r/r.npz")
        .set("start_idx", "1")
        .set("frame_step", "2");
    truth.iter().fold(call, Fpmcl::with).succeeds();
    json(&folder.join("r/report.json"))
}

#[test]
fn a_real_drive_is_localized_without_any_key() {
    let Some((folder, data, output)) = with_even_frames_mapped("kitti-0926-drive-0005") else {
        return;
    };
    for part in ["64 beams", "motion compensation: clockwise"] {
        assert!(output.stderr.contains(part), "{}", output.stderr);
    }
    let truth = [
        format!("--truth={data}/poses.txt"),
        format!("--calib={data}/calib.txt"),
    ];
    let report = localize_odd_frames(folder.path(), &data, &truth);
    let rmse = |quantity: &str| report["mcl"]["metrics"][quantity]["rmse"].as_f64().unwrap();
    assert!(rmse("position_m") < 0.012, "{} m", rmse("position_m"));
    assert!(rmse("heading_rad") < 3e-4, "{} rad", rmse("heading_rad"));
}

#[test]
fn a_sensor_of_another_kind_is_found_anywhere_at_two_scans_a_second() {
    let Some((folder, data, _output)) = with_even_frames_mapped("nuscenes-hdl32") else {
        return;
    };
    let truth = [format!("--truth={data}/poses_tum.txt")];
    let report = localize_odd_frames(folder.path(), &data, &truth);
    // A single scan confirms its place only if nearly all of its beams agree: by the seed, that is the first or the second.
    assert!(report["summary"]["tracking"].as_u64() >= Some(15));
    // In the second case the first frame is filled back.
    let trajectory = fs::read_to_string(folder.path().join("r/mcl_tum.txt")).unwrap();
    let poses = trajectory.lines().filter(|line| !line.starts_with('#'));
    assert_eq!(poses.count(), 16);
    let position = &report["mcl"]["metrics"]["position_m"];
    assert!(position["rmse"].as_f64().unwrap() < 0.05, "{position}");
    assert!(position["max"].as_f64().unwrap() < 0.5, "{position}");
}

#[test]
fn odometry_that_contradicts_the_scans_is_left_out_with_a_warning() {
    let (folder, truth) = with_first_drive_mapped();
    let folder = folder.path();
    for (scale, is_left_out) in [(1.0, false), (1.3, true), (3.0, true), (-1.0, true)] {
        let scaled = |pose: &Pose3| {
            let moved = truth[0].inverse() * pose;
            truth[0] * Pose3::from_parts((moved.translation.vector * scale).into(), moved.rotation)
        };
        let poses: Vec<Pose3> = truth.iter().map(scaled).collect();
        write_rough_poses(&folder.join("wheels.txt"), &poses, [0.0; 2], 0.0);
        let result = format!("{scale}/r.npz");
        let call = localize(folder, "street/drive_2", &result).with("--odometry=wheels.txt");
        let output = call.succeeds();
        let warned = output.stderr.contains("contradict each other");
        assert_eq!(warned, is_left_out, "{scale}: {}", output.stderr);
        let error_m = largest_error_m(&folder.join(&result), &truth, 2);
        assert!(error_m < 0.1, "{scale}: {error_m} m");
    }
}

#[test]
fn scans_that_start_elsewhere_each_time_are_compensated_by_the_order_of_their_points() {
    let Some((folder, data, output)) = with_even_frames_mapped("vlp16-raw") else {
        return;
    };
    for part in ["16 beams", "motion compensation: order;"] {
        assert!(output.stderr.contains(part), "{}", output.stderr);
    }
    let report = localize_odd_frames(folder.path(), &data, &[]);
    // A frame that is not sure yet is filled back.
    let summary = &report["summary"];
    let count = |key: &str| summary[key].as_u64().unwrap_or_default();
    assert!(
        count("tracking") >= 29 && count("tracking") + count("filled") == 30,
        "{summary}"
    );
    // 0.832 without times of the points, 0.849 with them.
    let agreement = summary["agreement"]["mean"].as_f64().unwrap();
    assert!(agreement > 0.84, "{agreement}");
}

#[test]
fn scans_of_more_than_a_turn_and_with_gaps_between_them_are_compensated_by_their_order() {
    let Some(data) = real_recording("hdl32-gaps") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let output = fpmcl("odometry")
        .in_folder(folder.path())
        .with(data.display().to_string())
        .set("output_folder", "odometry")
        .succeeds();
    let text = fs::read_to_string(folder.path().join("odometry/effective_odometry.yml")).unwrap();
    let key = text
        .lines()
        .find(|line| line.contains("motion_compensation"));
    assert!(
        key.unwrap().contains("order over 400."),
        "{key:?} {}",
        output.stderr
    );
}
