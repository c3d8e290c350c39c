//! The same recording in other files gives the same trajectory.

use std::fs;

use fpmcl::internals::app::LocalizationResults;

use crate::common::{self, Recording, fpmcl};

const FRAMES: usize = 6;

/// Positions of a TUM trajectory.
fn positions(recording: &Recording) -> Vec<[f64; 3]> {
    let text = String::from_utf8(recording.bytes("results/mcl_tum.txt")).unwrap();
    text.lines()
        .map(|line| {
            let numbers: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
            [numbers[1], numbers[2], numbers[3]]
        })
        .collect()
}

/// Builds the map, localizes in it, and compares with the expected positions [m].
#[track_caller]
fn gives(recording: &Recording, expected: &[[f64; 3]]) {
    recording.fpmcl("build-map").with("--force").succeeds();
    recording.fpmcl("localize").with("--force").succeeds();
    let found = positions(recording);
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        for axis in 0..3 {
            assert!(
                (found[axis] - expected[axis]).abs() < 1e-3,
                "{found:?} {expected:?}"
            );
        }
    }
}

/// Replaces the `.bin` files by files of another format.
fn convert(recording: &Recording, extension: &str, bytes_of: impl Fn(&[[f32; 3]]) -> Vec<u8>) {
    for frame in 0..FRAMES {
        let points = recording.scan(frame);
        let path = recording.path(&format!("velodyne/{frame:06}.bin"));
        fs::remove_file(&path).unwrap();
        fs::write(path.with_extension(extension), bytes_of(&points)).unwrap();
    }
}

fn little_endian(numbers: impl IntoIterator<Item = f32>) -> Vec<u8> {
    numbers.into_iter().flat_map(f32::to_le_bytes).collect()
}

#[test]
fn scans_as_pcd_ply_npy_and_five_floats_give_the_same_trajectory() {
    let recording = Recording::street(FRAMES);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    let expected = positions(&recording);

    let pcd = Recording::street(FRAMES);
    convert(&pcd, "pcd", |points| {
        let header = format!(
            "VERSION .7\nFIELDS z y x\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA binary\n",
            points.len()
        );
        let data = little_endian(points.iter().flat_map(|&[x, y, z]| [z, y, x]));
        [header.as_bytes(), &data].concat()
    });
    gives(&pcd, &expected);

    let ply = Recording::street(FRAMES);
    convert(&ply, "ply", |points| {
        let header = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\n\
             property float y\nproperty float z\nproperty uchar intensity\nend_header\n",
            points.len()
        );
        let row = |point: &[f32; 3]| [little_endian(*point), vec![7]].concat();
        let data: Vec<u8> = points.iter().flat_map(row).collect();
        [header.as_bytes(), &data].concat()
    });
    gives(&ply, &expected);

    let npy = Recording::street(FRAMES);
    convert(&npy, "npy", |points| {
        let shape = format!("({}, 3)", points.len());
        let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}");
        let padding = 64 - (10 + header.len() + 1) % 64;
        let header = format!("{header}{}\n", " ".repeat(padding));
        let length = (header.len() as u16).to_le_bytes();
        let data = little_endian(points.iter().flatten().copied());
        [b"\x93NUMPY\x01\x00", &length[..], header.as_bytes(), &data].concat()
    });
    gives(&npy, &expected);

    let five = Recording::street(FRAMES);
    convert(&five, "bin", |points| {
        little_endian(points.iter().flat_map(|&[x, y, z]| [x, y, z, 0.5, 12.0]))
    });
    gives(&five, &expected);
}

#[test]
fn poses_of_the_lidar_need_no_calibration() {
    let recording = Recording::street(FRAMES);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    let expected = positions(&recording);
    fs::remove_file(recording.path("calib.txt")).unwrap();
    let ahead_m = |frame: usize| 0.5 * frame as f64;
    let tum: String = (0..FRAMES)
        .map(|frame| format!("{} {} 0 0 0 0 0 1\n", 0.1 * frame as f64, ahead_m(frame)))
        .collect();
    let kitti: String = (0..FRAMES)
        .map(|frame| format!("1 0 0 {} 0 1 0 0 0 0 1 0\n", ahead_m(frame)))
        .collect();
    for (name, poses) in [("TUM", tum), ("KITTI", kitti)] {
        recording.write("poses.txt", &poses);
        let call = |command: &str| {
            let call = recording.fpmcl(command).with("--force");
            call.set("calib_file", "null")
        };
        call("build-map").succeeds();
        call("localize").set("map_calib_file", "null").succeeds();
        let found = positions(&recording);
        for (found, expected) in found.iter().zip(&expected) {
            assert!(
                (found[0] - expected[0]).abs() < 1e-3,
                "{name}: {found:?} {expected:?}"
            );
        }
    }
}

/// All that a run found: its trajectory as bytes, and its result without the truth and the computing times.
fn found(recording: &Recording, trajectory: &str) -> (Vec<u8>, LocalizationResults) {
    let result = recording.path("results/localization.npz");
    let mut results = LocalizationResults::read(&result).unwrap();
    (results.ground_truth, results.ground_truth_in_space) = (None, None);
    (results.runtimes_s, results.refine_runtimes_s) = (None, None);
    (recording.bytes(trajectory), results)
}

#[test]
fn a_truth_is_compared_with_and_changes_no_estimate() {
    let recording = Recording::street(FRAMES);
    recording.fpmcl("build-map").succeeds();
    let rows = |time_s: &dyn Fn(usize) -> f64, ahead_m: f64, count: usize| -> String {
        let row = |frame: usize| {
            let x_m = ahead_m + 0.5 * frame as f64;
            format!("{:.2} {x_m} 0 0 0 0 0 1\n", time_s(frame))
        };
        (0..count).map(row).collect()
    };
    // Times that are not those of the scans, for which ten per second are assumed.
    let other = |frame: usize| 3.0 * frame as f64;
    recording.write("right.txt", &rows(&other, 0.0, FRAMES));
    recording.write("wrong.txt", &rows(&other, 25.0, FRAMES));
    recording.write("short.txt", &rows(&other, 0.0, FRAMES - 1));
    // Of recorded times, the first frame is before the truth.
    let late = |frame: usize| 0.15 + 0.1 * frame as f64;
    recording.write("late.txt", &rows(&late, 0.75, FRAMES));
    let call = |command: &str, truth: &str| {
        let call = recording.fpmcl(command).with("--force");
        let call = call.set("odometry", "auto").set("pose_file", truth);
        call.set("motion_compensation", "auto")
    };
    let localized = |truth: &str| {
        let call = call("localize", truth).set("initial_pose", "[0, 0, 0]");
        call.succeeds();
        let report = recording.bytes("results/report.json");
        (found(&recording, "results/mcl_tum.txt"), report)
    };
    let refined = |truth: &str| {
        call("refine", truth).succeeds();
        found(&recording, "results/refined_tum.txt")
    };

    let [right, wrong, short, without] =
        ["right.txt", "wrong.txt", "short.txt", "null"].map(localized);
    assert!(without.0.1.particles.len() == FRAMES && without.0.1.covariances.is_some());
    assert!(without.0 == right.0 && without.0 == wrong.0 && without.0 == short.0);
    assert!(right.1 != wrong.1 && without.1 != right.1);
    // That of the last run, which has no truth.
    let [without, wrong, short] = ["null", "wrong.txt", "short.txt"].map(refined);
    assert!(without.1.refined_covariances.is_some());
    assert!(without == wrong && without == short);

    let times: String = (0..FRAMES)
        .map(|frame| format!("{:.1}\n", 0.1 * frame as f64))
        .collect();
    recording.write("times.txt", &times);
    let [without, late] = ["null", "late.txt"].map(localized);
    assert!(without.0 == late.0);
    let result = recording.path("results/localization.npz");
    let truth = LocalizationResults::read(&result).unwrap().ground_truth;
    let is_unknown: Vec<bool> = (truth.unwrap().iter())
        .map(|pose| pose.translation.x.is_nan())
        .collect();
    assert_eq!(is_unknown, [true, false, false, false, false, false]);
    let evaluate = fpmcl("evaluate").in_folder(recording.folder());
    let evaluate = evaluate.with("results/localization.npz").with("--force");
    let said = evaluate.succeeds().stderr;
    assert!(said.contains("1 of 6 frames are left out"), "{said}");
}

#[test]
fn a_truth_that_ends_a_frame_early_is_evaluated_without_that_frame() {
    let recording = Recording::street(FRAMES);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    let poses = String::from_utf8(recording.bytes("poses.txt")).unwrap();
    let rows = |count: usize| -> String { poses.split_inclusive('\n').take(count).collect() };
    let evaluate = || {
        let call = fpmcl("evaluate").in_folder(recording.folder());
        let call = call.with("results/localization.npz").with("--force");
        call.with("--truth")
            .with("short.txt")
            .with("--calib")
            .with("calib.txt")
    };
    recording.write("short.txt", &rows(FRAMES - 1));
    let output = evaluate().succeeds();
    assert!(
        output.stderr.contains("the last 1 of 6 frames"),
        "{}",
        output.stderr
    );
    recording.write("short.txt", &rows(FRAMES - 2));
    evaluate().fails_with(&["belong to different recordings"]);
}

#[test]
fn times_of_exactly_ten_scans_per_second_are_matched_where_they_were_recorded() {
    const FRAMES: usize = 12;
    let recording = Recording::street(FRAMES);
    fs::remove_file(recording.path("calib.txt")).unwrap();
    let times: String = (0..FRAMES)
        .map(|k| format!("{:.1}\n", 0.1 * k as f64))
        .collect();
    let write_truth = |name: &str, later_s: f64, rows: usize| {
        let row = |k: usize| {
            let (time_s, ahead_m) = (later_s + 0.1 * k as f64, 0.5 * k as f64);
            format!("{time_s:.1} {ahead_m} 0 0 0 0 0 1\n")
        };
        recording.write(name, &(0..rows).map(row).collect::<String>());
    };
    write_truth("poses.txt", 0.0, FRAMES);
    let call = |command: &str| {
        let call = recording.fpmcl(command).with("--force");
        call.set("calib_file", "null").set("pose_file", "poses.txt")
    };
    call("build-map").succeeds();
    // Moved, so that they are no times of the scans.
    fs::rename(recording.path("poses.txt"), recording.path("truth.txt")).unwrap();
    let localize = || {
        let call = recording.fpmcl("localize").with("--force");
        let call = call.set("calib_file", "null").set("pose_file", "null");
        let call = call
            .set("map_pose_file", "null")
            .set("map_calib_file", "null");
        let call = call
            .set("odometry", "auto")
            .set("initial_pose", "[0, 0, 0]");
        call.succeeds();
    };
    let evaluate = |truth: &str| {
        let call = fpmcl("evaluate").in_folder(recording.folder());
        let call = call.with("results/localization.npz").with("--truth");
        call.with(truth)
    };
    let rmse_m = || {
        let errors = common::json(&recording.path("results/report.json"));
        errors["mcl"]["metrics"]["position_m"]["rmse"]
            .as_f64()
            .unwrap()
    };
    write_truth("early.txt", 0.0, FRAMES - 2);
    write_truth("late.txt", 0.5, FRAMES);

    recording.write("times.txt", &times);
    localize();
    let said = evaluate("early.txt").succeeds().stderr;
    assert!(said.contains("2 of 12 poses are left out"), "{said}");
    assert!(rmse_m() < 0.2, "{}", rmse_m());
    let said = evaluate("late.txt").succeeds().stderr;
    assert!(said.contains("5 of 12 poses are left out"), "{said}");
    assert!((rmse_m() - 2.5).abs() < 0.2, "{}", rmse_m());

    // Assumed ones are none: row k is that of frame k.
    fs::remove_file(recording.path("times.txt")).unwrap();
    localize();
    evaluate("late.txt").succeeds();
    assert!(rmse_m() < 0.2, "{}", rmse_m());
    evaluate("early.txt").fails_with(&[
        "early.txt has 10 poses",
        "reaches frame 11",
        "matched by number",
        "give times",
    ]);
}

#[test]
fn info_has_the_period_of_the_sensor_and_where_the_times_are_from() {
    // Of twenty scans, every second one is read.
    const FRAMES: usize = 20;
    let recording = Recording::street(FRAMES);
    let info = |path: &str| {
        let call = || fpmcl("info").in_folder(recording.folder()).with(path);
        let output = call().with("--json").succeeds();
        let found: serde_json::Value = serde_json::from_str(&output.stdout).unwrap();
        (found, output.stderr, call().succeeds().stdout)
    };
    let (found, _, text) = info(".");
    assert!(found["sensor"]["period_s"].is_null() && found["times_from"].is_null());
    assert!(text.contains("there are no times"), "{text}");

    let times = (0..FRAMES).map(|k| format!("{:.1}\n", 7.0 + 0.1 * k as f64));
    recording.write("times.txt", &times.collect::<String>());
    let (found, _, text) = info(".");
    let period_s = |found: &serde_json::Value| found["sensor"]["period_s"].as_f64().unwrap();
    assert!((period_s(&found) - 0.1).abs() < 1e-6, "{found}");
    assert_eq!(found["times_from"], "./times.txt");
    assert!(text.contains("in ./times.txt"), "{text}");

    // One folder up.
    fs::rename(recording.path("velodyne"), recording.path("plain")).unwrap();
    let (found, said, _) = info("plain");
    assert_eq!(found["times_from"], "times.txt");
    assert!(said.contains("those of times.txt"), "{said}");

    fs::create_dir(recording.path("named")).unwrap();
    for frame in 0..FRAMES {
        let name = format!("named/{:.2}.bin", 1_700_000_000.0 + 0.05 * frame as f64);
        let scan = recording.path(&format!("plain/{frame:06}.bin"));
        fs::rename(scan, recording.path(&name)).unwrap();
    }
    let (found, said, text) = info("named");
    assert!((period_s(&found) - 0.05).abs() < 1e-6, "{found}");
    assert_eq!(found["times_from"], "names");
    assert!(
        said.contains("the times of the scans are those in their names"),
        "{said}"
    );
    assert!(text.contains("in the names of the scans"), "{text}");
}
