//! `evaluate` of trajectories of any origin from the outside: against evo, against known errors, and what it refuses.

#![cfg(feature = "bags")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use approx::assert_relative_eq;
use fpmcl::geometry::{Pose3, StampedPose};
use fpmcl::recording::write_tum;
use nalgebra::Vector3;
use serde_json::Value;
use tempfile::TempDir;

use crate::bag_writers::{Cloud, Kind, Recorded, mcap, odometry, point_cloud2, transforms};
use crate::common::{self, Fpmcl, fpmcl, json, real_recording};

/// The pose after `time_s` at 10 m/s along a circle that rises, of a lidar with x ahead.
fn truth_at(time_s: f64) -> Pose3 {
    let [distance_m, heading] = [10.0 * time_s, 0.2 * time_s];
    let position = Vector3::new(
        50.0 * heading.sin(),
        50.0 * (1.0 - heading.cos()),
        0.02 * distance_m,
    );
    Pose3::new(position, Vector3::zeros()) * Pose3::rotation(heading * Vector3::z())
}

fn tum(path: &Path, times_s: impl Iterator<Item = f64>, pose_at: impl Fn(f64) -> Pose3) {
    let rows: Vec<StampedPose> = (times_s.enumerate())
        .map(|(frame, time_s)| StampedPose {
            frame,
            time_s,
            map_from_lidar: pose_at(time_s),
        })
        .collect();
    write_tum(fs::File::create(path).unwrap(), &rows).unwrap();
}

fn times(count: usize, start_s: f64, rate_hz: f64) -> impl Iterator<Item = f64> {
    (0..count).map(move |i| start_s + i as f64 / rate_hz)
}

/// A transform of which no axis is another's.
fn elsewhere() -> Pose3 {
    Pose3::new(
        Vector3::new(100.0, -20.0, 3.0),
        Vector3::new(0.3, -0.2, 1.5),
    )
}

/// An empty folder in which trajectories are evaluated.
struct Folder(TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn evaluate(&self, estimate: &str, truth: &str) -> Fpmcl {
        let call = fpmcl("evaluate").in_folder(self.0.path()).with(estimate);
        let call = call.with("--truth").with(truth);
        // Drawn by one of the tests.
        call.set("plot_loc_traj", "False")
    }

    /// The errors of a trajectory.
    fn errors(&self, folder: &str) -> Value {
        json(&self.path(folder).join("report.json"))["trajectory"].clone()
    }
}

fn number(errors: &Value, path: &[&str]) -> f64 {
    let found = path.iter().fold(errors, |value, key| &value[*key]);
    found
        .as_f64()
        .unwrap_or_else(|| panic!("{path:?}: {found}"))
}

#[test]
fn errors_of_all_alignments_and_segments_equal_those_of_evo() {
    let Some(python) = common::python_with("evo.core.metrics", "python") else {
        common::skips::skipped("FPMCL_PYTHON names no interpreter with evo");
        return;
    };
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let fixture = root.join("src/evaluation/evo");
    let mut pairs = vec![[
        fixture.join("estimate_kitti.txt"),
        fixture.join("reference_kitti.txt"),
    ]];
    if let Some(kitti) = real_recording("kitti-odometry-poses") {
        // The poses of SemanticKITTI against those of the benchmark, both of the camera.
        let both = ["semantickitti_poses/07.txt", "poses/07.txt"];
        pairs.push(both.map(|name| kitti.join(name)));
    }
    for [estimate, truth] in &pairs {
        let output = Command::new(&python)
            .arg(root.join("tests/evo/errors.py"))
            .args([estimate, truth])
            .output()
            .unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{stderr}");
        let evo: Value = serde_json::from_slice(&output.stdout).unwrap();
        compare_with_evo(estimate, truth, &evo);
    }
}

fn compare_with_evo(estimate: &Path, truth: &Path, evo: &Value) {
    let folder = Folder::new();
    let mut compared = 0;
    let mut compare = |ours: &Value, evo: &Value, paths: [&[&str]; 2]| {
        let [ours, evo] = [number(ours, paths[0]), number(evo, paths[1])];
        assert_relative_eq!(ours, evo, epsilon = 1e-6, max_relative = 1e-6);
        compared += 1;
    };
    for alignment in ["none", "first", "rigid"] {
        let call = folder.evaluate(estimate.to_str().unwrap(), truth.to_str().unwrap());
        call.with("--align")
            .with(alignment)
            .with("--output")
            .with(alignment)
            .succeeds();
        let ours = folder.errors(alignment);
        for error in ["position_m", "rotation_rad"] {
            for statistic in ["rmse", "mean", "median", "max"] {
                compare(&ours, &evo[alignment], [&[error, statistic]; 2]);
                let aligned = format!("aligned_{error}");
                let paths = [[aligned.as_str(), statistic], [error, statistic]];
                compare(&ours, &evo["rigid"], [&paths[0], &paths[1]]);
            }
            let end = format!("end_{error}");
            compare(&ours, &evo[alignment], [&[&end], &[error, "end"]]);
        }
        for segments in ["kitti_segments", "short_segments"] {
            for error in ["translation_percent", "rotation_deg_per_m", "segments"] {
                compare(&ours, evo, [&[segments, error]; 2]);
            }
        }
    }
    assert_eq!(compared, 3 * 24);
}

#[test]
fn a_trajectory_elsewhere_has_no_error_after_alignment_and_truth_of_another_rate_is_interpolated() {
    let folder = Folder::new();
    let start_s = 1_700_000_000.0;
    let later = |time_s: f64| truth_at(time_s - start_s);
    tum(&folder.path("truth.tum"), times(1200, start_s, 40.0), later);
    // Ten times a second, between the times of the truth.
    let moved = |time_s| elsewhere() * later(time_s);
    tum(
        &folder.path("ours.txt"),
        times(250, start_s + 0.51, 10.0),
        moved,
    );
    for alignment in ["first", "rigid"] {
        let call = folder.evaluate("ours.txt", "truth.tum");
        let output = call.with("--align").with(alignment).succeeds();
        assert!(!output.stderr.contains("WARN"), "{}", output.stderr);
        let errors = folder.errors("ours_evaluation");
        for path in [
            ["position_m", "max"],
            ["aligned_position_m", "max"],
            ["rotation_rad", "max"],
            ["kitti_segments", "translation_percent"],
        ] {
            assert!(number(&errors, &path) < 1e-3, "{path:?} {errors}");
        }
        assert_relative_eq!(number(&errors, &["distance_m"]), 249.0, epsilon = 0.2);
    }
    // Without alignment the errors are those of the files.
    let call = folder.evaluate("ours.txt", "truth.tum");
    let call = call.set("plot_loc_traj", "True");
    call.with("--align").with("none").succeeds();
    let errors = folder.errors("ours_evaluation");
    assert!(number(&errors, &["position_m", "rmse"]) > 50.0, "{errors}");
    for file in [
        "report.html",
        "report.md",
        "frames.csv",
        "plots/drift.png",
        "plots/path.png",
    ] {
        assert!(folder.path("ours_evaluation").join(file).exists(), "{file}");
    }
    let page = fs::read_to_string(folder.path("ours_evaluation/report.html")).unwrap();
    assert!(page.contains("Trajectory ours.txt") && page.contains("deg/100 m"));
}

#[test]
fn a_path_two_percent_too_long_has_two_percent_error_over_every_length() {
    let folder = Folder::new();
    tum(&folder.path("truth.txt"), times(500, 0.0, 10.0), truth_at);
    let longer = |time_s| {
        let mut pose = truth_at(time_s);
        pose.translation.vector *= 1.02;
        elsewhere() * pose
    };
    tum(&folder.path("long.txt"), times(500, 0.0, 10.0), longer);
    let call = folder.evaluate("long.txt", "truth.txt").with("--all");
    let table = call.succeeds().stdout;
    let errors = folder.errors("long_evaluation");
    for length in errors["by_length"].as_array().unwrap() {
        // Of the chord of a circle of 100 pi m.
        let length_m = number(length, &["length_m"]);
        let chord = 100.0 * (length_m / 100.0).sin().abs() / length_m;
        let percent = number(length, &["translation_percent"]);
        assert!(
            (percent - 2.0 * chord).abs() < 0.05 + 3.0 / length_m,
            "{length}"
        );
        assert!(number(length, &["rotation_deg_per_m"]) < 1e-5, "{length}");
    }
    let row = table
        .lines()
        .find(|line| line.starts_with("segments 5 m, translation"));
    assert!(row.unwrap().contains("2.0"), "{table}");
}

#[test]
fn times_and_numbers_that_do_not_fit_are_errors_with_counts_and_ranges() {
    let folder = Folder::new();
    tum(&folder.path("truth.txt"), times(300, 0.0, 10.0), truth_at);
    tum(&folder.path("late.txt"), times(200, 25.0, 10.0), truth_at);
    folder.evaluate("late.txt", "truth.txt").fails_with(&[
        "only 50 of 200 poses have a true pose",
        "late.txt are from 25.000 to 44.900 s",
        "the 300 true poses of truth.txt from 0.000 to 29.900 s",
        "same clock",
    ]);
    // Most of them: the others are left out, also the one within a tenth of a second after the truth.
    tum(&folder.path("some.txt"), times(200, 15.05, 10.0), truth_at);
    let output = folder.evaluate("some.txt", "truth.txt").succeeds();
    assert!(
        output.stderr.contains("51 of 200 poses are left out"),
        "{}",
        output.stderr
    );
    assert!(output.stdout.contains(" 149"), "{}", output.stdout);
    let selected = folder
        .evaluate("late.txt", "truth.txt")
        .set("n_scans", "40");
    assert!(!selected.succeeds().stderr.contains("left out"));
    // Rows of KITTI have no times.
    let row = "1 0 0 0 0 1 0 0 0 0 1 0\n";
    fs::write(folder.path("short.txt"), row.repeat(150)).unwrap();
    let call = folder.evaluate("some.txt", "short.txt");
    call.fails_with(&["short.txt has 150 poses", "reaches frame 199"]);
    fs::write(folder.path("long.txt"), row.repeat(201)).unwrap();
    let call = folder.evaluate("some.txt", "long.txt");
    call.fails_with(&[
        "some.txt has 200 poses with times",
        "long.txt has 201 without",
        "give both times",
    ]);
    let output = folder.evaluate("short.txt", "truth.txt").succeeds();
    assert!(
        output.stderr.contains("matched by number"),
        "{}",
        output.stderr
    );
    fpmcl("evaluate")
        .in_folder(folder.0.path())
        .with("some.txt")
        .fails_with(&["some.txt has no ground truth"]);
}

#[test]
fn poses_of_a_camera_against_those_of_the_lidar_need_its_calibration() {
    let folder = Folder::new();
    tum(&folder.path("lidar.txt"), times(300, 0.0, 10.0), truth_at);
    fs::write(
        folder.path("calib.txt"),
        "Tr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3\n",
    )
    .unwrap();
    let calibration = fpmcl::recording::Calibration::read(&folder.path("calib.txt")).unwrap();
    let poses: Vec<Pose3> = times(300, 0.0, 10.0).map(truth_at).collect();
    let world = calibration.cam0_from_lidar;
    fpmcl::recording::write_kitti(
        fs::File::create(folder.path("camera.txt")).unwrap(),
        &poses,
        &world,
        &calibration,
    )
    .unwrap();
    let output = folder.evaluate("lidar.txt", "camera.txt").succeeds();
    assert!(
        output.stderr.contains("need calib_file"),
        "{}",
        output.stderr
    );
    let call = || {
        folder
            .evaluate("lidar.txt", "camera.txt")
            .with("--align")
            .with("none")
    };
    let output = call().with("--calib").with("calib.txt").succeeds();
    assert!(
        !output.stderr.contains("need calib_file"),
        "{}",
        output.stderr
    );
    let errors = folder.errors("lidar_evaluation");
    assert!(number(&errors, &["position_m", "max"]) < 1e-4, "{errors}");
    assert!(number(&errors, &["height_m", "max"]) < 1e-4, "{errors}");
    // The camera's poses as the trajectory.
    let call = folder.evaluate("camera.txt", "lidar.txt");
    call.set("result_calib_file", "calib.txt").succeeds();
    let errors = folder.errors("camera_evaluation");
    assert!(number(&errors, &["position_m", "max"]) < 1e-4, "{errors}");
    // Both of the camera: heights are along its -y.
    fs::copy(folder.path("camera.txt"), folder.path("same.txt")).unwrap();
    folder.evaluate("same.txt", "camera.txt").succeeds();
    let csv = fs::read_to_string(folder.path("same_evaluation/frames.csv")).unwrap();
    let last: Vec<&str> = csv.lines().last().unwrap().split(',').collect();
    let z_m: f64 = last[5].parse().unwrap();
    assert!((z_m - 0.02 * 299.0).abs() < 0.1, "{last:?}");
}

#[test]
fn the_truth_may_be_a_body_on_which_the_lidar_is_mounted_or_a_topic_of_a_bag() {
    let folder = Folder::new();
    let body_from_lidar = Pose3::new(Vector3::new(1.0, 0.5, 0.0), Vector3::zeros())
        * Pose3::rotation(std::f64::consts::FRAC_PI_2 * Vector3::z());
    let body = |time_s| truth_at(time_s) * body_from_lidar.inverse();
    tum(&folder.path("lidar.txt"), times(100, 0.0, 10.0), truth_at);
    tum(&folder.path("body.txt"), times(100, 0.0, 10.0), body);
    let mounting = "[1.0, 0.5, 0, 0, 0, 90]";
    let largest_error = |call: Fpmcl| {
        call.succeeds();
        number(&folder.errors("lidar_evaluation"), &["position_m", "max"])
    };
    assert!(largest_error(folder.evaluate("lidar.txt", "body.txt")) > 0.5);
    let call = folder.evaluate("lidar.txt", "body.txt");
    assert!(largest_error(call.set("body_from_lidar", mounting)) < 1e-4);

    let messages: Vec<Recorded> = times(100, 0.0, 10.0)
        .flat_map(|time_s| {
            let time_ns = (1e9 * time_s).round() as u64;
            let pose = body(time_s);
            let (t, q) = (pose.translation, pose.rotation);
            let pose = [t.x, t.y, t.z, q.i, q.j, q.k, q.w];
            let cloud = Cloud::of(&[([1.0, 2.0, 3.0, 0.0], 0, 0.0)]);
            [
                Recorded {
                    topic: "/points",
                    message_type: "sensor_msgs/msg/PointCloud2",
                    time_ns,
                    data: point_cloud2(Kind::CdrLittle, time_ns, "lidar", &cloud),
                },
                Recorded {
                    topic: "/odom",
                    message_type: "nav_msgs/msg/Odometry",
                    time_ns,
                    data: odometry(Kind::CdrLittle, time_ns, "odom", "base", &pose),
                },
            ]
        })
        .collect();
    let q = body_from_lidar.rotation;
    let static_transform = Recorded {
        topic: "/tf_static",
        message_type: "tf2_msgs/msg/TFMessage",
        time_ns: 0,
        data: transforms(
            Kind::CdrLittle,
            &[("base", "lidar", [1.0, 0.5, 0.0, q.i, q.j, q.k, q.w])],
        ),
    };
    let messages: Vec<Recorded> = [static_transform].into_iter().chain(messages).collect();
    let bag = mcap(mcap::WriteOptions::new(), "cdr", &messages);
    fs::write(folder.path("drive.mcap"), bag).unwrap();
    let call = folder.evaluate("lidar.txt", "/odom").with("--recording");
    assert!(largest_error(call.with("drive.mcap")) < 1e-4);
    // The advice is an option that the command has.
    let call = fpmcl("evaluate")
        .in_folder(folder.0.path())
        .with("lidar.txt");
    let call = call.with("--recording").with("drive.mcap");
    let output = call.fails_with(&["has poses in /odom", "name it with --truth"]);
    assert!(!output.stderr.contains("--poses"), "{}", output.stderr);
}

#[test]
fn a_trajectory_of_a_run_is_evaluated_without_touching_the_files_of_the_run() {
    let folder = Folder::new();
    tum(&folder.path("mcl_tum.txt"), times(60, 0.0, 10.0), truth_at);
    tum(&folder.path("truth.txt"), times(60, 0.0, 10.0), truth_at);
    fs::write(folder.path("report.json"), "of another run").unwrap();
    folder.evaluate("mcl_tum.txt", "truth.txt").succeeds();
    let report = fs::read_to_string(folder.path("report.json")).unwrap();
    assert_eq!(report, "of another run");
    // Again, into the same folder.
    folder.evaluate("mcl_tum.txt", "truth.txt").succeeds();
}

#[test]
fn a_straight_line_determines_no_rigid_alignment() {
    let folder = Folder::new();
    let line = |time_s: f64| Pose3::translation(10.0 * time_s, 0.0, 0.0);
    tum(&folder.path("a.txt"), times(60, 0.0, 10.0), line);
    tum(&folder.path("b.txt"), times(60, 0.0, 10.0), line);
    let call = || folder.evaluate("a.txt", "b.txt");
    let output = call().with("--all").succeeds().stdout;
    assert!(!output.contains("aligned position RMSE"), "{output}");
    let call = call().with("--align").with("rigid");
    call.fails_with(&["straight line", "set alignment to first"]);
}
