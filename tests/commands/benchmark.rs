//! `benchmark`: odometry, map and localization of two sessions in one command, which resumes.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
#[cfg(unix)]
use std::process::{Child, Command, Stdio};
use std::sync::LazyLock;
#[cfg(unix)]
use std::thread;
#[cfg(unix)]
use std::time::{Duration, Instant};

use nalgebra::{Isometry3, Matrix4, Unit, Vector3};
use tempfile::TempDir;

#[cfg(unix)]
use crate::common::replace_by_pipe;
use crate::common::{Fpmcl, copy_into, copy_of, fpmcl, json, shared_folder, simulate_two_drives};

/// A bend: a straight path determines no rotation about itself.
const STREET: &str = "\
output_folder: street
seed: 5
n_scans: 30
path: [{length_m: 45, turn_deg: 60, grade_percent: 3}]
scanner: {beams: 32, azimuth_steps: 720}
";

/// Two drives.
static SIMULATED: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = shared_folder();
    simulate_two_drives(folder.path(), STREET);
    folder
});

/// Two drives and their finished benchmark, of which other tests take the stages of the first drive.
static FINISHED: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = shared_folder();
    copy_into(SIMULATED.path(), folder.path());
    let printed = benchmark(folder.path()).succeeds().stdout;
    assert!(printed.contains("benchmark.html"), "{printed}");
    folder
});

fn benchmark(folder: &Path) -> Fpmcl {
    let call = fpmcl("benchmark").in_folder(folder);
    let call = call.with("kitti").with("street/drive_1");
    call.with("--second").with("street/drive_2").with("--quiet")
}

#[test]
fn two_sessions_give_all_figures_and_a_second_run_takes_what_is_finished() {
    let folder = copy_of(FINISHED.path());
    let folder = folder.path();
    let path = folder.join("results/benchmark/benchmark.json");
    let report = json(&path);
    let number = |pointer: &str| {
        let found = report.pointer(pointer).and_then(serde_json::Value::as_f64);
        found.unwrap_or_else(|| panic!("{pointer} is missing"))
    };
    assert_eq!(number("/odometry/scans"), 30.0);
    assert!(number("/odometry/scan_by_scan/trajectory/position_m/rmse") < 0.3);
    assert!(number("/odometry/adjusted/trajectory/position_m/rmse") < 0.3);
    assert!(number("/map/triangles") > 1000.0);
    for trajectory in ["mcl", "refined"] {
        let rmse = format!("/localization/{trajectory}/metrics/position_m/rmse");
        assert!(number(&rmse) < 0.1);
    }
    // The truths of both drives are in one frame, in which nothing is to be aligned.
    assert!(number("/localization_aligned/refined/metrics/position_m/rmse") < 0.1);
    assert_eq!(report["layout"], "KITTI odometry");
    let machine = |name: &str| report["machine"][name].as_str().unwrap();
    assert_eq!(report["published"][0]["method"], "GroundLoc");
    let page = fs::read_to_string(folder.join("results/benchmark/benchmark.html")).unwrap();
    for part in [
        "Odometry",
        "Localization",
        "Published figures",
        "GroundLoc",
        "0.134 m",
        "0.205 degrees",
        "Definitions",
        "root mean square of the distance",
        "Program and machine",
        report["program"].as_str().unwrap(),
        machine("processor"),
        machine("memory"),
        machine("renderer"),
    ] {
        assert!(page.contains(part), "{part}");
    }
    // The first session is complete: the second run measures nothing again.
    fs::remove_file(folder.join("results/benchmark/benchmark.html")).unwrap();
    benchmark(folder).succeeds();
    assert_eq!(json(&path)["stage_seconds"], report["stage_seconds"]);
    assert!(folder.join("results/benchmark/benchmark.html").exists());
    // Another setting of one stage leaves the others.
    benchmark(folder).set("num_particles", "500").succeeds();
    let changed = json(&path);
    let seconds = |report: &serde_json::Value, stage: &str| report["stage_seconds"][stage].clone();
    assert_eq!(seconds(&changed, "2 map"), seconds(&report, "2 map"));
    assert_ne!(
        seconds(&changed, "3 localization"),
        seconds(&report, "3 localization")
    );
}

#[test]
fn one_session_without_a_truth_is_divided_and_says_that_it_has_no_errors() {
    let folder = copy_of(SIMULATED.path());
    let folder = folder.path();
    let drive = folder.join("street/drive_1");
    for name in ["poses.txt", "calib.txt"] {
        fs::remove_file(drive.join(name)).unwrap();
    }
    let call = fpmcl("benchmark").in_folder(folder).with("auto");
    let output = call.with("street/drive_1").succeeds();
    assert!(
        output.stderr.contains("has no true poses"),
        "{}",
        output.stderr
    );
    let report = json(&folder.join("results/benchmark/benchmark.json"));
    assert!(report["odometry"]["scan_by_scan"].is_null());
    assert!(report["localization"]["mcl"].is_null());
    assert_eq!(report["localization"]["localized"], true);
    assert!(report["second"].is_null() && report["localization_aligned"].is_null());
}

#[test]
fn a_truth_of_the_second_session_in_another_frame_is_compared_after_alignment() {
    let folder = copy_of(FINISHED.path());
    let folder = folder.path();
    // A turn about an inclined axis, and a shift of 50 m.
    let axis = Unit::new_normalize(Vector3::new(0.1, -1.0, 0.2));
    let other_from_world = Isometry3::new([30.0, 4.0, -40.0].into(), axis.into_inner() * 0.8);
    let other_from_world = other_from_world.to_homogeneous();
    let poses = folder.join("street/drive_2/poses.txt");
    let moved = |row: &str| {
        let numbers = row.split_whitespace().map(|it| it.parse::<f64>().unwrap());
        let last = [0.0, 0.0, 0.0, 1.0];
        let world_from_cam0 = Matrix4::from_row_iterator(numbers.chain(last));
        let other_from_cam0 = other_from_world * world_from_cam0;
        let numbers = (0..12).map(|i| format!("{:e}", other_from_cam0[(i / 4, i % 4)]));
        numbers.collect::<Vec<_>>().join(" ") + "\n"
    };
    let truth = fs::read_to_string(&poses).unwrap();
    fs::write(&poses, truth.lines().map(moved).collect::<String>()).unwrap();
    let printed = benchmark(folder).succeeds().stdout;
    assert!(printed.contains("refined, aligned"), "{printed}");
    let report = json(&folder.join("results/benchmark/benchmark.json"));
    let rmse_m = |which: &str, trajectory: &str| {
        let metrics = &report[which][trajectory]["metrics"];
        metrics["position_m"]["rmse"].as_f64().unwrap()
    };
    for trajectory in ["mcl", "refined"] {
        assert!(rmse_m("localization", trajectory) > 5.0);
        assert!(rmse_m("localization_aligned", trajectory) < 0.1);
        let errors = &report["localization_aligned"][trajectory]["metrics"];
        assert!(errors["heading_rad"]["rmse"].as_f64().unwrap() < 0.02);
    }
    let page = fs::read_to_string(folder.join("results/benchmark/benchmark.html")).unwrap();
    assert!(page.contains("after a rigid alignment of the path"));
}

#[test]
fn a_truth_on_a_straight_line_leaves_out_the_errors_after_alignment() {
    let folder = copy_of(FINISHED.path());
    let folder = folder.path();
    let poses = folder.join("street/drive_2/poses.txt");
    let count = fs::read_to_string(&poses).unwrap().lines().count();
    let row = |ahead_m: usize| format!("1 0 0 0 0 1 0 0 0 0 1 {ahead_m}\n");
    fs::write(&poses, (0..count).map(row).collect::<String>()).unwrap();
    let output = benchmark(folder).succeeds();
    assert!(
        output.stderr.contains("no errors after a rigid alignment"),
        "{}",
        output.stderr
    );
    let report = json(&folder.join("results/benchmark/benchmark.json"));
    assert!(report["localization"]["refined"].is_object());
    assert!(report["localization_aligned"].is_null());
}

#[test]
fn another_error_of_the_evaluation_after_alignment_leaves_the_stage_unfinished() {
    let folder = copy_of(SIMULATED.path());
    let folder = folder.path();
    // Without a truth of the first session, nothing else is evaluated with this key.
    for name in ["poses.txt", "calib.txt"] {
        fs::remove_file(folder.join("street/drive_1").join(name)).unwrap();
    }
    let call = || benchmark(folder).set("result_calib_file", "camera.txt");
    call().fails_with(&["after a rigid alignment", "camera.txt"]);
    let finished = finished_stages(folder);
    assert_eq!(finished.keys().collect::<Vec<_>>(), ["map", "odometry"]);
    // A result is not read by it, only a trajectory.
    fs::write(folder.join("camera.txt"), "").unwrap();
    call().succeeds();
    let report = json(&folder.join("results/benchmark/benchmark.json"));
    assert!(report["localization_aligned"]["refined"].is_object());
}

#[test]
fn scans_and_truths_that_have_changed_are_measured_again() {
    let folder = copy_of(FINISHED.path());
    let folder = folder.path();
    let path = folder.join("results/benchmark/benchmark.json");
    let seconds = |stage: &str| json(&path)["stage_seconds"][stage].clone();
    let stages = ["1 odometry", "2 map", "3 localization"];
    let before = stages.map(seconds);
    // Without its last points, the scan of a session that is localized only.
    let scan = folder.join("street/drive_2/velodyne/000020.bin");
    let points = fs::read(&scan).unwrap();
    fs::write(&scan, &points[..points.len() - 1600]).unwrap();
    benchmark(folder).succeeds();
    let after = stages.map(seconds);
    assert_eq!(after[..2], before[..2]);
    assert_ne!(after[2], before[2]);
    // Another truth of the first session.
    let poses = folder.join("street/drive_1/poses.txt");
    let truth = fs::read_to_string(&poses).unwrap();
    let (rows, last_m) = truth.trim_end().rsplit_once(' ').unwrap();
    let last_m = last_m.parse::<f64>().unwrap() + 0.01;
    fs::write(&poses, format!("{rows} {last_m}\n")).unwrap();
    benchmark(folder).succeeds();
    assert_ne!(stages.map(seconds)[0], before[0]);
}

/// The time of each stage that a benchmark has finished, by its name.
fn finished_stages(folder: &Path) -> BTreeMap<String, serde_json::Value> {
    let stages = fs::read_dir(folder.join("results/benchmark/stages"));
    let paths = stages.into_iter().flatten().map(|it| it.unwrap().path());
    let finished = paths.filter_map(|path| {
        let text = fs::read_to_string(path.join("finished.json")).ok()?;
        let mark: serde_json::Value = serde_json::from_str(&text).ok()?;
        let name = path.file_name()?.to_str()?.split_once('-')?.0.to_owned();
        Some((name, mark["seconds"].clone()))
    });
    finished.collect()
}

#[cfg(unix)]
#[test]
fn a_benchmark_that_is_ended_between_its_stages_resumes() {
    /// Time limit for a program that hangs.
    const TIMEOUT: Duration = Duration::from_secs(300);
    let folder = copy_of(SIMULATED.path());
    let folder = folder.path();
    // The program waits for this scan twice: where it opens the sessions, and in the third stage.
    let scan = folder.join("street/drive_2/velodyne/000020.bin");
    let bytes = replace_by_pipe(&scan);
    let mut child = Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"))
        .args(["benchmark", "kitti", "street/drive_1"])
        .args(["--second", "street/drive_2", "--quiet"])
        .current_dir(folder)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let (pipe, content) = (scan.clone(), bytes.clone());
    thread::spawn(move || fs::write(pipe, content));
    let mut wait_until = |is_reached: &dyn Fn(&mut Child) -> bool| {
        let begin = Instant::now();
        while !is_reached(&mut child) {
            if begin.elapsed() > TIMEOUT {
                child.kill().unwrap();
                panic!("the program hangs: {:?}", finished_stages(folder));
            }
            thread::sleep(Duration::from_millis(20));
        }
    };
    wait_until(&|child| {
        let is_running = child.try_wait().unwrap().is_none();
        assert!(is_running, "{:?}", finished_stages(folder));
        finished_stages(folder).len() == 2
    });
    wait_until(&|child| {
        let id = child.id().to_string();
        // After the first one, there is nothing to be ended any more.
        let _sent = Command::new("kill").args(["-TERM", &id]).status().unwrap();
        let status = child.try_wait().unwrap();
        assert!(status.is_none_or(|status| !status.success()));
        status.is_some()
    });
    let before = finished_stages(folder);
    assert_eq!(before.keys().collect::<Vec<_>>(), ["map", "odometry"]);
    let report = folder.join("results/benchmark/benchmark.json");
    assert!(!report.exists());

    fs::remove_file(&scan).unwrap();
    fs::write(&scan, bytes).unwrap();
    benchmark(folder).succeeds();
    let report = json(&report);
    assert_eq!(report["stage_seconds"]["1 odometry"], before["odometry"]);
    assert_eq!(report["stage_seconds"]["2 map"], before["map"]);
}

#[test]
fn a_key_that_no_stage_has_is_refused() {
    let folder = copy_of(SIMULATED.path());
    let folder = folder.path();
    let call = benchmark(folder).set("num_partikles", "500");
    call.fails_with(&["num_partikles", "localize"]);
    assert!(!folder.join("results/benchmark/stages").exists());
}

#[test]
fn a_layout_that_nobody_knows_is_refused_with_those_that_are_read() {
    let call = fpmcl("benchmark").with("kiti").with("drive");
    call.rejects_usage_with(&["kiti", "kitti", "mulran", "auto"]);
}
