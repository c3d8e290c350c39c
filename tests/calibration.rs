//! What the filter says about its own errors is true: on a drive through a street with traffic, in
//! which the car also creeps and stands, the errors are as large as the covariances say.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use assert_cmd::Command;
use fpmcl::app::results::LocalizationResults;
use nalgebra::Vector3;

const SIMULATION: &str = "\
output_folder: street
path_pose_file: path.txt
scanner: {azimuth_steps: 900}
";

const BUILD_MAP: &str = "\
scan_folder: street/drive_1/velodyne
pose_file: street/drive_1/poses.txt
calib_file: street/drive_1/calib.txt
mesh_file: results/map.ply
depth: 9
";

const LOCALIZATION: &str = "\
map_file: results/map.ply
map_pose_file: street/drive_1/poses.txt
map_calib_file: street/drive_1/calib.txt
scan_folder: street/drive_2/velodyne
pose_file: street/drive_2/poses.txt
calib_file: street/drive_2/calib.txt
result_path: results/localization.npz
odometry: file
odometry_file: street/drive_2/odometry.txt
numParticles: 500
plot_loc_results: False
force: True
";

/// Frames before the filter has settled.
const SETTLING: usize = 10;

/// How far the car drives into each frame: a town, a queue, a red light, and on [m].
fn steps_m() -> Vec<f64> {
    let slows = (0..10).map(|frame| 0.9 - 0.08 * f64::from(frame));
    let goes_on = (0..10).map(|frame| 0.1 * f64::from(frame));
    [0.9; 25]
        .into_iter()
        .chain(slows)
        .chain([0.06; 10])
        .chain([0.0; 10])
        .chain(goes_on)
        .collect()
}

/// A bend to the left with these steps, as KITTI writes poses.
fn path() -> String {
    let (mut x, mut z, mut heading) = (0.0, 0.0, 0.0_f64);
    let mut text = String::new();
    for step_m in steps_m() {
        heading += 0.01 * step_m;
        x -= step_m * heading.sin();
        z += step_m * heading.cos();
        let (sin, cos) = heading.sin_cos();
        writeln!(text, "{cos} 0 {} {x} 0 1 0 0 {sin} 0 {cos} {z}", -sin).unwrap();
    }
    text
}

#[track_caller]
fn run(folder: &Path, arguments: &[&str]) {
    let output = Command::cargo_bin("fpmcl")
        .unwrap()
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {said}");
}

/// Normalized squared errors of the estimates, by frame from the first that has settled.
fn squared_errors(results: &LocalizationResults) -> Vec<f64> {
    let estimates = results.estimates.as_ref().unwrap();
    let truths = results.ground_truth.as_ref().unwrap();
    let covariances = results.covariances.as_ref().unwrap();
    let frames = estimates.iter().zip(truths).zip(covariances);
    frames
        .skip(SETTLING)
        .map(|((estimate, truth), covariance)| {
            let off = estimate.translation.vector - truth.translation.vector;
            let turn = (truth.rotation.inverse() * estimate.rotation).angle();
            let error = Vector3::new(off.x, off.y, turn);
            error.dot(&(covariance.try_inverse().unwrap() * error))
        })
        .collect()
}

#[test]
fn errors_are_as_large_as_the_covariances_say_also_where_the_car_creeps_and_stands() {
    /// Below this are 95 % of the squares of three normal deviates.
    const BOUND: f64 = 7.815;
    let home = tempfile::tempdir().unwrap();
    let folder = home.path();
    let write = |name: &str, text: &str| fs::write(folder.join(name), text).unwrap();
    write("path.txt", &path());
    write("calib.txt", "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n");
    write("simulation.yml", SIMULATION);
    write("build_map.yml", BUILD_MAP);
    write("localization.yml", LOCALIZATION);
    run(folder, &["simulate", "simulation.yml"]);
    run(folder, &["simulate", "simulation.yml", "--set", "drive=2"]);
    run(folder, &["build-map", "build_map.yml"]);

    let is_slow: Vec<bool> = steps_m().iter().map(|&step_m| step_m < 0.2).collect();
    let (mut all, mut slow, mut sigmas_m) = (Vec::new(), Vec::new(), Vec::new());
    for seed in ["1", "2", "3", "4"] {
        run(
            folder,
            &[
                "localize",
                "localization.yml",
                "--backend=cpu",
                "--seed",
                seed,
            ],
        );
        let results = LocalizationResults::read(&folder.join("results/localization.npz")).unwrap();
        let squares = squared_errors(&results);
        let of_slow = squares.iter().zip(&is_slow[SETTLING..]);
        slow.extend(
            of_slow
                .filter(|(_, is_slow)| **is_slow)
                .map(|(square, _)| *square),
        );
        let covariances = results.covariances.unwrap();
        sigmas_m.extend(
            covariances[SETTLING..25]
                .iter()
                .map(|c| (c[(0, 0)] + c[(1, 1)]).sqrt()),
        );
        all.extend(squares);
    }
    let outside = |squares: &[f64]| {
        let count = squares.iter().filter(|&&square| square > BOUND).count();
        count as f64 / squares.len() as f64
    };
    let mean = |squares: &[f64]| squares.iter().sum::<f64>() / squares.len() as f64;
    let told = format!(
        "all: {:.3} outside, mean {:.2}; slow: {:.3} outside, mean {:.2}",
        outside(&all),
        mean(&all),
        outside(&slow),
        mean(&slow)
    );
    assert!(outside(&all) < 0.1 && outside(&slow) < 0.1, "{told}");
    assert!((1.0..4.5).contains(&mean(&all)), "{told}");
    // Not by being unsure: centimetres where the car drives.
    sigmas_m.sort_by(f64::total_cmp);
    assert!(sigmas_m[sigmas_m.len() / 2] < 0.03, "{sigmas_m:?}");
    eprintln!("{told}");
}
