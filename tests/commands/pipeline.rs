//! The whole pipeline from outside, on a short simulated street: every output file is readable, and
//! the estimated poses agree with the true ones.

use std::fs;
use std::path::Path;

use fpmcl::internals::CameraPoses;
use fpmcl::internals::app::LocalizationResults;
use fpmcl::internals::app::color::{MCL, REFINED, TRUTH};
use fpmcl::recording::Calibration;
use fpmcl::recording::read_tum;
use serde_json::Value;
use tempfile::TempDir;

use crate::common::picture::Picture;
use crate::common::{
    DRIVE_2_IN_MAP, MAP_OF_DRIVE_1, Recording, SENSOR, json, run, simulate_two_drives,
};

/// Frames of each of the two drives.
const FRAMES: usize = 16;

const SIMULATION: &str = "\
output_folder: street
n_scans: 16
path:
- {length_m: 40, turn_deg: 30, grade_percent: 3}
scanner: {azimuth_steps: 600}
";

const BUILD_MAP: &str = "\
depth: 8
holdout_step: 8
visualize: True
";

const EVALUATION: &str = "\
result_file: results/localization.npz
pose_file: street/drive_2/poses.txt
calib_file: street/drive_2/calib.txt
convergence_interval: 5
";

/// A folder with the configurations of the commands.
fn configured() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    write(
        "build_map.yml",
        &format!("{MAP_OF_DRIVE_1}{BUILD_MAP}{SENSOR}"),
    );
    let query = format!("{DRIVE_2_IN_MAP}{SENSOR}");
    let start = "result_path: results/localization.npz\nnumParticles: 300\n";
    write("localization.yml", &format!("{query}{start}"));
    let result = "result_file: results/localization.npz\n";
    write("refinement.yml", &format!("{query}{result}"));
    write("evaluation.yml", EVALUATION);
    folder
}

#[track_caller]
fn number(value: &Value, pointer: &str) -> f64 {
    let found = value.pointer(pointer).and_then(Value::as_f64);
    found.unwrap_or_else(|| panic!("no number at {pointer} of {value}"))
}

#[test]
fn a_drive_is_localized_and_refined_in_the_map_of_another_drive() {
    let temporary = configured();
    let folder = temporary.path();
    simulate_two_drives(folder, SIMULATION);
    let built = run(folder, &["build-map", "build_map.yml"]);
    let localized = run(folder, &["localize", "localization.yml", "--backend=cpu"]);
    let plots = folder.join("results/plots");
    Picture::read(&plots.join("path.png")).shows(&[TRUTH]);
    let refined = run(folder, &["refine", "refinement.yml", "--backend=cpu"]);

    for (output, row) in [
        (&built, "triangles"),
        (&localized, "position RMSE"),
        (&refined, "refined"),
    ] {
        assert!(output.contains(row), "no `{row}` in: {output}");
    }
    let picture = |name: &str| Picture::read(&plots.join(name));
    picture("path.png").shows(&[TRUTH]);
    picture("errors.png").shows_at_least(400, &[MCL, REFINED]);
    picture("runtime.png").shows(&[MCL, REFINED]);
    picture("particles.png").shows(&[MCL]);
    picture("map.png").shows(&[TRUTH]);
    picture("range_images.png").shows(&[]);
    Picture::read(&folder.join("results/map.png")).shows(&[]);

    evaluation_keeps_the_details_of_the_run(folder);
    the_report_has_small_errors(&folder.join("results"));
    the_result_has_a_row_per_frame(&folder.join("results"));
    the_trajectories_agree_with_the_truth(folder);
}

/// The details of the run in the report and its pictures stay unchanged.
fn evaluation_keeps_the_details_of_the_run(folder: &Path) {
    let results = folder.join("results");
    let pictures =
        ["path.png", "particles.png", "map.png"].map(|name| results.join("plots").join(name));
    let drawn = pictures.each_ref().map(|path| fs::read(path).unwrap());
    let before = json(&results.join("report.json"));
    let evaluated = run(folder, &["evaluate", "evaluation.yml", "--all"]);
    assert!(evaluated.contains("range-mcl success"), "{evaluated}");
    assert!(drawn == pictures.each_ref().map(|path| fs::read(path).unwrap()));
    let after = json(&results.join("report.json"));
    for (key, value) in before["about"].as_object().unwrap() {
        assert_eq!(after["about"][key], *value, "{key}");
    }
    assert_eq!(after["about"]["result"], "results/localization.npz");
    assert!(results.join("report.html").exists());
}

fn the_report_has_small_errors(results: &Path) {
    let report = json(&results.join("report.json"));
    assert_eq!(report["mcl"]["range_mcl"]["success"], true);
    let rmse_m = |name: &str| number(&report, &format!("/{name}/metrics/position_m/rmse"));
    let rmse_rad = |name: &str| number(&report, &format!("/{name}/metrics/heading_rad/rmse"));
    // Measured: 3.0 cm and 0.04 degrees, refined 1.2 cm and 0.02 degrees.
    assert!(rmse_m("mcl") < 0.15, "{}", rmse_m("mcl"));
    assert!(rmse_m("refined") < 0.05, "{}", rmse_m("refined"));
    assert!(rmse_rad("refined") < 0.3_f64.to_radians());

    let report = json(&results.join("map.report.json"));
    assert_eq!(number(&report, "/frames"), FRAMES as f64);
    assert_eq!(number(&report, "/held_out_frames"), 2.0);
    assert!(number(&report, "/triangles") > 1000.0);
    assert!(number(&report, "/quality/beam_plane_median_m") < 0.1);
}

fn the_result_has_a_row_per_frame(results: &Path) {
    let result = LocalizationResults::read(&results.join("localization.npz")).unwrap();
    assert_eq!(result.frames, (0..FRAMES).collect::<Vec<_>>().into());
    assert_eq!(result.refined.unwrap().len(), FRAMES);
    let table = fs::read_to_string(results.join("frames.csv")).unwrap();
    assert_eq!(table.lines().count(), 1 + FRAMES);
    let columns = |line: &str| line.split(',').count();
    let header = columns(table.lines().next().unwrap());
    assert!(table.lines().all(|line| columns(line) == header));
}

/// Both formats contain the same poses, each in its own frame, and agree with the true poses.
fn the_trajectories_agree_with_the_truth(folder: &Path) {
    let calibration = Calibration::read(&folder.join("street/drive_2/calib.txt")).unwrap();
    let truth = CameraPoses::read(&folder.join("street/drive_2/poses.txt")).unwrap();
    let origin = CameraPoses::read(&folder.join("street/drive_1/poses.txt")).unwrap();
    let lidar_from_cam0 = calibration.cam0_from_lidar.inverse();
    // The map's origin is the lidar at the first pose of the mapping drive.
    let map_from_world = (origin.world_from_cam0[0] * calibration.cam0_from_lidar).inverse();
    for (name, limit_m) in [("mcl", 0.5), ("refined", 0.15)] {
        let kitti = folder.join(format!("results/{name}_kitti.txt"));
        let kitti = CameraPoses::read(&kitti).unwrap().world_from_cam0;
        let tum = read_tum(&folder.join(format!("results/{name}_tum.txt"))).unwrap();
        assert_eq!((kitti.len(), tum.len()), (FRAMES, FRAMES));
        for (frame, (camera, stamped)) in kitti.iter().zip(&tum).enumerate() {
            let error = truth.world_from_cam0[frame].inverse() * camera;
            let error_m = error.translation.vector.norm();
            assert!(error_m < limit_m, "{name}, frame {frame}: {error_m} m");
            let lidar = map_from_world * camera * lidar_from_cam0.inverse();
            let difference = lidar.inverse() * stamped.map_from_lidar;
            let difference_m = difference.translation.vector.norm();
            assert!(difference_m < 1e-3, "{name}, {frame}: {difference_m} m");
            assert!((stamped.time_s - 0.1 * frame as f64).abs() < 1e-6);
        }
    }
}

/// Map, trajectories and result for a number of threads, without the runtimes.
fn results_of(threads: &str) -> (Vec<u8>, Vec<Vec<u8>>, LocalizationResults) {
    let recording = Recording::street(8);
    let call = |command| recording.fpmcl(command).with("--threads").with(threads);
    call("build-map").succeeds();
    call("localize").set("numParticles", "200").succeeds();
    call("refine").succeeds();
    let files = [
        "mcl_tum.txt",
        "mcl_kitti.txt",
        "refined_tum.txt",
        "refined_poses.npy",
    ];
    let result = LocalizationResults::read(&recording.path("results/localization.npz")).unwrap();
    (
        recording.bytes("map.ply"),
        files
            .map(|name| recording.bytes(&format!("results/{name}")))
            .to_vec(),
        LocalizationResults {
            runtimes_s: None,
            refine_runtimes_s: None,
            ..result
        },
    )
}

#[test]
fn the_same_seed_gives_the_same_bytes_with_one_thread_and_with_two() {
    let (one, two) = (results_of("1"), results_of("2"));
    assert!(one.0 == two.0, "the maps differ");
    assert!(one.1 == two.1, "the trajectories differ");
    assert!(one.2 == two.2, "the results differ");
}

#[test]
fn a_result_that_is_not_saved_is_reported() {
    let recording = Recording::street(4);
    recording.fpmcl("build-map").succeeds();
    let call = recording.fpmcl("localize").set("save_result", "False");
    let stderr = call.set("plot_loc_results", "False").succeeds().stderr;
    assert!(stderr.contains("save_result is False"), "{stderr}");
    assert!(!recording.path("results").exists());
}
