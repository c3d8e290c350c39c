//! Consistency of the filter: on a drive through a street with traffic, with slow driving and
//! standstill, the errors agree with the covariances.

use std::fmt::Write as _;
use std::fs;

use fpmcl::internals::app::LocalizationResults;
use nalgebra::Vector3;

use crate::common::{DRIVE_2_IN_MAP, MAP_OF_DRIVE_1, run, simulate_two_drives};

const SIMULATION: &str = "\
output_folder: street
path_pose_file: path.txt
scanner: {azimuth_steps: 900}
";

const LOCALIZATION: &str = "\
result_path: results/localization.npz
numParticles: 500
plot_loc_results: False
# The map is from exact poses: a millimetre is the error of its surfaces.
proposal.registration.map_error_m: 0.001
force: True
";

/// Number of frames that are excluded while the filter converges.
const WARM_UP: usize = 10;

/// Distance driven before each frame: constant speed, braking, crawling, standstill, starting [m].
fn steps_m() -> Vec<f64> {
    let braking = (0..10).map(|frame| 0.9 - 0.08 * f64::from(frame));
    let starting = (0..10).map(|frame| 0.1 * f64::from(frame));
    [0.9; 25]
        .into_iter()
        .chain(braking)
        .chain([0.06; 10])
        .chain([0.0; 10])
        .chain(starting)
        .collect()
}

/// A left bend with these steps in the KITTI format.
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

/// Normalized squared error of the estimate of each frame after the warm-up.
fn squared_errors(results: &LocalizationResults) -> Vec<f64> {
    let estimates = results.estimates.as_ref().unwrap();
    let truths = results.ground_truth.as_ref().unwrap();
    let covariances = results.covariances.as_ref().unwrap();
    let frames = estimates.iter().zip(truths).zip(covariances);
    frames
        .skip(WARM_UP)
        .map(|((estimate, truth), covariance)| {
            let shift_m = estimate.translation.vector - truth.translation.vector;
            let turn_rad = (truth.rotation.inverse() * estimate.rotation).angle();
            let error = Vector3::new(shift_m.x, shift_m.y, turn_rad);
            error.dot(&(covariance.try_inverse().unwrap() * error))
        })
        .collect()
}

#[test]
fn errors_agree_with_the_covariances_also_at_low_speed_and_at_standstill() {
    /// 95 % quantile of the chi-squared distribution with three degrees of freedom.
    const BOUND: f64 = 7.815;
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    let write = |name: &str, text: &str| fs::write(folder.join(name), text).unwrap();
    write("path.txt", &path());
    write("calib.txt", "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n");
    write("build_map.yml", &format!("{MAP_OF_DRIVE_1}depth: 9\n"));
    write(
        "localization.yml",
        &format!("{DRIVE_2_IN_MAP}{LOCALIZATION}"),
    );
    simulate_two_drives(folder, SIMULATION);
    run(folder, &["build-map", "build_map.yml"]);

    let is_slow: Vec<bool> = steps_m().iter().map(|&step_m| step_m < 0.2).collect();
    let (mut all, mut slow, mut sigmas_m) = (Vec::new(), Vec::new(), Vec::new());
    for seed in ["1", "2", "3", "4"] {
        let call = ["localize", "localization.yml", "--backend=cpu", "--seed"];
        run(folder, &[call.as_slice(), &[seed]].concat());
        let results = LocalizationResults::read(&folder.join("results/localization.npz")).unwrap();
        let squares = squared_errors(&results);
        let of_slow = squares.iter().zip(&is_slow[WARM_UP..]);
        slow.extend(
            of_slow
                .filter(|(_, is_slow)| **is_slow)
                .map(|(square, _)| *square),
        );
        let covariances = results.covariances.unwrap();
        sigmas_m.extend(
            covariances[WARM_UP..25]
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
    let summary = format!(
        "all: {:.3} outside, mean {:.2}; slow: {:.3} outside, mean {:.2}",
        outside(&all),
        mean(&all),
        outside(&slow),
        mean(&slow)
    );
    assert!(outside(&all) < 0.1 && outside(&slow) < 0.1, "{summary}");
    assert!((1.0..4.5).contains(&mean(&all)), "{summary}");
    // The covariances are also small: centimetres while the car drives.
    sigmas_m.sort_by(f64::total_cmp);
    assert!(sigmas_m[sigmas_m.len() / 2] < 0.03, "{sigmas_m:?}");
    eprintln!("{summary}");
}
