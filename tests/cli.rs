//! The program from outside: its manners, and what it says about bad input.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs;
use std::path::Path;

use common::{Recording, fpmcl};

const COMMANDS: [&str; 8] = [
    "build-map",
    "localize",
    "refine",
    "evaluate",
    "simulate",
    "demo",
    "ground",
    "doctor",
];

fn delivered(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("config")
        .join(name)
}

// Manners.

#[test]
fn the_help_is_what_it_was() {
    insta::assert_snapshot!("help", fpmcl("--help").succeeds().stdout);
}

#[test]
fn the_help_of_every_command_is_what_it_was() {
    for command in COMMANDS {
        let help = fpmcl(command).with("--help").succeeds().stdout;
        insta::assert_snapshot!(format!("help-{command}"), help);
    }
}

#[test]
fn the_help_lists_every_command() {
    let help = fpmcl("-h").succeeds().stdout;
    for command in COMMANDS {
        assert!(help.contains(&format!("\n  {command} ")), "{command}");
    }
}

#[test]
fn the_version_is_that_of_the_package() {
    let expected = format!("fpmcl {}\n", env!("CARGO_PKG_VERSION"));
    assert_eq!(fpmcl("--version").succeeds().stdout, expected);
}

#[test]
fn wrong_usage_has_its_own_exit_code() {
    fpmcl("build-mop").misuse_saying(&["build-mop", "build-map"]);
    fpmcl("localize")
        .with("--treads=2")
        .misuse_saying(&["--treads", "--threads"]);
    fpmcl("localize")
        .with("--threads=0")
        .misuse_saying(&["--threads", "0"]);
    fpmcl("localize")
        .with("--backend=cuda")
        .misuse_saying(&["cuda", "auto, cpu, gpu"]);
    fpmcl("localize")
        .with("--set")
        .with("seed")
        .misuse_saying(&["key=value"]);
    fpmcl("localize")
        .with("-q")
        .with("-v")
        .misuse_saying(&["cannot be used with"]);
}

#[test]
fn the_doctor_tells_threads_and_backend() {
    let said = fpmcl("doctor").succeeds();
    for row in ["instruction sets", "threads in use", "backend auto"] {
        assert!(said.stdout.contains(row), "{}", said.stdout);
    }
}

// Configurations.

#[test]
fn a_missing_configuration_is_named() {
    fpmcl("build-map").fails_saying(&["config/build_map.yml", "give the path"]);
    fpmcl("evaluate")
        .with("own.yml")
        .fails_saying(&["cannot read", "own.yml"]);
}

#[test]
fn an_unknown_key_is_told_with_line_and_nearest_key() {
    let recording = Recording::street(0);
    recording.write("build_map.yml", "depth: 8\nvoxel_sise: 0.1\n");
    recording.fpmcl("build-map").fails_saying(&[
        "build_map.yml, line 2",
        "unknown key `voxel_sise`",
        "did you mean `voxel_size`?",
    ]);
}

#[test]
fn a_word_where_a_number_belongs_is_told_with_its_line() {
    let recording = Recording::street(0);
    recording.write("localization.yml", "# start\n\nnumParticles: many\n");
    recording.fpmcl("localize").fails_saying(&[
        "localization.yml, line 3",
        "`many`",
        "numParticles",
    ]);
}

#[test]
fn contradictory_values_are_told_with_a_remedy() {
    for command in ["build-map", "localize"] {
        Recording::street(0)
            .fpmcl(command)
            .set("range_image.min_range", "60")
            .fails_saying(&[
                "--set range_image.min_range=60",
                "less than max_range, which is 50",
            ]);
    }
    fpmcl("refine")
        .with(delivered("refinement.yml"))
        .set("range_image.width", "0")
        .fails_saying(&["range_image.width is 0"]);
    fpmcl("evaluate")
        .with(delivered("evaluation.yml"))
        .set("frame_step", "0")
        .fails_saying(&["frame_step is 0", "1 takes every frame"]);
}

#[test]
fn a_setting_that_names_no_key_is_told_with_the_nearest() {
    fpmcl("localize")
        .with(delivered("localization.yml"))
        .set("range_image.widht", "512")
        .fails_saying(&["--set range_image.widht=512", "`range_image.width`"]);
}

#[test]
fn a_setting_of_the_wrong_kind_is_quoted() {
    fpmcl("localize")
        .with(delivered("localization.yml"))
        .set("seed", "yesterday")
        .fails_saying(&["--set seed=yesterday", "whole number"]);
}

// Recordings. These wait for the bodies of build-map and localize.

#[test]
#[ignore = "waits for build-map"]
fn a_map_is_built_of_the_street() {
    let recording = Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    assert!(recording.path("map.ply").exists());
}

#[test]
#[ignore = "waits for build-map"]
fn a_missing_file_is_named() {
    for (name, key) in [("poses.txt", "poses.txt"), ("calib.txt", "calib.txt")] {
        let recording = Recording::street(2);
        fs::remove_file(recording.path(name)).unwrap();
        recording.fpmcl("build-map").fails_saying(&[key]);
        assert!(!recording.path("map.ply").exists());
    }
    let recording = Recording::street(2);
    recording
        .fpmcl("build-map")
        .set("scan_folder", "nowhere")
        .fails_saying(&["nowhere"]);
    recording.fpmcl("localize").fails_saying(&["map.ply"]);
}

#[test]
#[ignore = "waits for build-map"]
fn a_truncated_scan_is_named() {
    let recording = Recording::street(3);
    let path = recording.path("velodyne/000001.bin");
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() - 5]).unwrap();
    recording
        .fpmcl("build-map")
        .fails_saying(&["000001.bin", "not a multiple of 16", "truncated"]);
}

#[test]
#[ignore = "waits for build-map"]
fn an_empty_scan_is_no_reason_to_fail() {
    let recording = Recording::street(6);
    recording.write_scan(2, &[]);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
}

#[test]
#[ignore = "waits for build-map"]
fn a_recording_of_nothing_but_empty_scans_is_told() {
    let recording = Recording::street(3);
    for frame in 0..3 {
        recording.write_scan(frame, &[]);
    }
    recording.fpmcl("build-map").fails_saying(&["points"]);
    assert!(!recording.path("map.ply").exists());
}

#[test]
#[ignore = "waits for build-map"]
fn points_that_are_not_finite_change_nothing() {
    let clean = Recording::street(4);
    clean.fpmcl("build-map").succeeds();
    let dirty = Recording::street(4);
    for frame in 0..4 {
        let mut points = dirty.scan(frame);
        points.insert(7, [f32::NAN, 1.0, 1.0]);
        points.push([f32::INFINITY, 0.0, 0.0]);
        points.push([1.0, f32::NEG_INFINITY, 0.0]);
        points.push([0.0, 0.0, 0.0]);
        dirty.write_scan(frame, &points);
    }
    dirty.fpmcl("build-map").succeeds();
    let map = |recording: &Recording| fs::read(recording.path("map.ply")).unwrap();
    assert!(map(&clean) == map(&dirty));
}

#[test]
#[ignore = "waits for build-map"]
fn more_scans_than_poses_is_an_error_and_fewer_is_none() {
    let recording = Recording::street(4);
    let poses = fs::read_to_string(recording.path("poses.txt")).unwrap();
    recording.write("poses.txt", poses.lines().next().unwrap());
    recording
        .fpmcl("build-map")
        .fails_saying(&["000001.bin has no pose", "n_scans"]);
    recording.write("poses.txt", &poses);
    fs::remove_file(recording.path("velodyne/000003.bin")).unwrap();
    recording.fpmcl("build-map").succeeds();
}

#[test]
#[ignore = "waits for build-map"]
fn a_calibration_without_tr_is_told() {
    let recording = Recording::street(2);
    recording.write("calib.txt", "P0: 1 0 0 0 0 1 0 0 0 0 1 0\n");
    recording
        .fpmcl("build-map")
        .fails_saying(&["calib.txt", "`Tr:`"]);
}

#[test]
#[ignore = "waits for build-map"]
fn a_word_among_the_poses_is_told_with_its_line() {
    let recording = Recording::street(2);
    recording.write(
        "poses.txt",
        "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 one 0 0 0 0 1 0\n",
    );
    recording
        .fpmcl("build-map")
        .fails_saying(&["poses.txt, line 2", "`one`"]);
}

#[test]
#[ignore = "waits for localize"]
fn a_map_with_an_impossible_header_is_refused() {
    let recording = Recording::street(2);
    recording.write(
        "map.ply",
        "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n\
         property float x\nproperty float y\nproperty float z\n\
         element face 4000000000\nproperty list uchar int vertex_indices\nend_header\n",
    );
    recording.fpmcl("localize").fails_saying(&["map.ply"]);
}

#[test]
#[ignore = "waits for build-map"]
fn an_existing_map_is_kept_unless_forced() {
    let recording = Recording::street(4);
    recording.write("map.ply", "mine");
    recording
        .fpmcl("build-map")
        .fails_saying(&["map.ply exists", "--force"]);
    assert_eq!(fs::read(recording.path("map.ply")).unwrap(), b"mine");
    recording.fpmcl("build-map").with("--force").succeeds();
    assert!(
        fs::read(recording.path("map.ply"))
            .unwrap()
            .starts_with(b"ply")
    );
}

#[test]
#[ignore = "waits for localize"]
fn a_result_folder_that_cannot_be_written_is_told_before_the_work() {
    let recording = Recording::street(4);
    recording.fpmcl("build-map").succeeds();
    recording.write("results", "a file where a folder belongs");
    recording
        .fpmcl("localize")
        .fails_saying(&["result_path", "results"]);
}

/// Ctrl-C while a command runs: the exit code is that of an interrupted run, the message says
/// what was kept, and it is there.
#[cfg(unix)]
mod interrupted {
    use std::io::Read as _;
    use std::process::{Child, Command, Stdio};
    use std::time::{Duration, Instant};

    use super::*;

    fn start(recording: &Recording, arguments: &[&str]) -> Child {
        Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"))
            .args(arguments)
            .current_dir(recording.folder())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    }

    /// Presses Ctrl-C after a moment; exit code and what was said.
    fn interrupt(mut child: Child, after: Duration) -> (Option<i32>, String) {
        std::thread::sleep(after);
        let pressed = Command::new("kill")
            .args(["-INT", &child.id().to_string()])
            .status()
            .unwrap();
        assert!(pressed.success(), "the command had ended before");
        let start = Instant::now();
        while child.try_wait().unwrap().is_none() {
            if start.elapsed() > Duration::from_secs(60) {
                child.kill().unwrap();
                panic!("it does not stop");
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let mut said = String::new();
        let mut stderr = child.stderr.take().unwrap();
        stderr.read_to_string(&mut said).unwrap();
        (child.wait().unwrap().code(), said)
    }

    #[test]
    #[ignore = "waits for build-map"]
    fn build_map_keeps_what_is_finished() {
        let recording = Recording::street(60);
        let arguments = ["build-map", "build_map.yml", "--set", "local_map_size=4"];
        let child = start(&recording, &arguments);
        let (code, said) = interrupt(child, Duration::from_millis(1500));
        assert_eq!(code, Some(130), "{said}");
        assert!(said.contains("interrupted;"), "{said}");
        if said.contains("map.ply") {
            let map = fs::read(recording.path("map.ply")).unwrap();
            assert!(map.starts_with(b"ply"));
        }
    }

    #[test]
    #[ignore = "waits for localize"]
    fn localize_keeps_what_is_finished() {
        let recording = Recording::street(60);
        recording.fpmcl("build-map").set("n_scans", "8").succeeds();
        let arguments = ["localize", "localization.yml", "--set", "numParticles=5000"];
        let child = start(&recording, &arguments);
        let (code, said) = interrupt(child, Duration::from_millis(1500));
        assert_eq!(code, Some(130), "{said}");
        assert!(said.contains("interrupted;"), "{said}");
        assert!(recording.path("results/localization.npz").exists());
    }
}
