//! Files of the user that stand where outputs go: nothing is replaced or deleted that the program did
//! not write, with or without `--force`.

use std::fs;
use std::path::Path;

use crate::common::{Fpmcl, Recording, config_file, fpmcl, run};

const RESULT: &str = "results/localization.npz";

fn mapped(frames: usize) -> Recording {
    let recording = Recording::street(frames);
    recording.fpmcl("build-map").succeeds();
    recording
}

/// `evaluate` for the result of a recording.
fn evaluate(recording: &Recording) -> Fpmcl {
    let call = fpmcl("evaluate").in_folder(recording.folder());
    call.with(config_file("evaluation.yml"))
        .set("pose_file", "poses.txt")
        .set("calib_file", "calib.txt")
}

/// Expects an error that names a file, and the file unchanged.
#[track_caller]
fn refuses(recording: &Recording, file: &str, call: impl Fn() -> Fpmcl, parts: &[&str]) {
    let before = recording.bytes(file);
    call().fails_with(&[&[file], parts].concat());
    call()
        .with("--force")
        .fails_with(&[&[file], parts].concat());
    assert!(recording.bytes(file) == before, "{file} has changed");
}

#[test]
fn configurations_beside_the_outputs_are_kept() {
    let recording = Recording::street(4);
    let names = ["build_map.yml", "localization.yml", "refinement.yml"];
    let before = names.map(|name| recording.bytes(name));
    let call = |command: &str, key: &str, value: &str| {
        recording.fpmcl(command).set(key, value).succeeds();
    };
    call("build-map", "mesh_file", "build_map.ply");
    for command in ["localize", "refine"] {
        let key = if command == "refine" {
            "result_file"
        } else {
            "result_path"
        };
        let call = recording.fpmcl(command).set("map_file", "build_map.ply");
        call.set(key, "localization.npz").succeeds();
    }
    assert_eq!(names.map(|name| recording.bytes(name)), before);
    for name in ["effective_localization.yml", "build_map.effective.yml"] {
        assert!(recording.path(name).exists(), "{name}");
    }
}

#[test]
fn files_of_the_user_among_the_outputs_are_refused() {
    let recording = mapped(4);
    fs::create_dir(recording.path("results")).unwrap();
    let names = [
        "report.json",
        "report.html",
        "frames.csv",
        "mcl_tum.txt",
        "effective_localization.yml",
    ];
    for name in names {
        let file = format!("results/{name}");
        recording.write(&file, "of the user");
        let parts = ["was not written by fpmcl", "move it", "result_path"];
        refuses(&recording, &file, || recording.fpmcl("localize"), &parts);
        fs::remove_file(recording.path(&file)).unwrap();
    }
    assert!(!recording.path(RESULT).exists());
    recording.write("other.report.json", "of the user");
    let build = || recording.fpmcl("build-map").set("mesh_file", "other.ply");
    refuses(
        &recording,
        "other.report.json",
        build,
        &["was not written by fpmcl", "mesh_file"],
    );
    assert!(!recording.path("other.ply").exists());

    recording.fpmcl("localize").succeeds();
    recording.write("results/refined_tum.txt", "of the user");
    let refine = || recording.fpmcl("refine");
    refuses(
        &recording,
        "results/refined_tum.txt",
        refine,
        &["result_file"],
    );
    // Not an output of localize without refinement.
    recording.fpmcl("localize").with("--force").succeeds();
    assert_eq!(recording.bytes("results/refined_tum.txt"), b"of the user");

    recording.write("results/effective_evaluation.yml", "of the user");
    let call = || evaluate(&recording);
    refuses(
        &recording,
        "results/effective_evaluation.yml",
        call,
        &["output_folder"],
    );
}

#[test]
fn folders_of_the_user_among_the_outputs_are_refused() {
    let recording = mapped(4);
    fs::create_dir_all(recording.path("results/plots")).unwrap();
    recording.write("results/plots/path.png", "of the user");
    let call = || recording.fpmcl("localize").set("plot_loc_results", "True");
    call().fails_with(&["results/plots exists", "was not written by fpmcl"]);
    assert_eq!(recording.bytes("results/plots/path.png"), b"of the user");
    // Plots are not drawn.
    recording.fpmcl("localize").succeeds();
}

#[test]
fn ground_and_compare_keep_files_of_the_user() {
    let recording = Recording::street(2);
    let ground = || {
        let call = fpmcl("ground")
            .in_folder(recording.folder())
            .with("velodyne");
        call.set("output_folder", "out").set("plot_step", "0")
    };
    fs::create_dir_all(recording.path("out/labels")).unwrap();
    recording.write("out/labels/000000.label", "of the user");
    ground()
        .with("--force")
        .fails_with(&["out/labels exists", "output_folder"]);
    fs::remove_dir_all(recording.path("out")).unwrap();
    ground().succeeds();
    ground().with("--force").succeeds();

    fs::create_dir_all(recording.path("drive_1/velodyne")).unwrap();
    recording.write("drive_1/poses.txt", "of the user");
    recording.write("drive_1/velodyne/000000.bin", "of the user");
    let call = fpmcl("simulate").in_folder(recording.folder());
    call.set("output_folder", ".")
        .set("n_scans", "1")
        .with("--force")
        .fails_with(&["drive_1", "not written by fpmcl simulate"]);
    assert_eq!(
        recording.bytes("drive_1/velodyne/000000.bin"),
        b"of the user"
    );
}

#[test]
fn odometry_keeps_files_of_the_user_and_its_inputs() {
    let recording = Recording::street(4);
    let odometry = |output: &str| {
        let call = fpmcl("odometry").in_folder(recording.folder());
        call.with("velodyne").with(format!("--output={output}"))
    };
    fs::create_dir(recording.path("out")).unwrap();
    for name in ["poses_tum.txt", "report.json", "path.png"] {
        let file = format!("out/{name}");
        recording.write(&file, "of the user");
        let parts = ["was not written by fpmcl", "output_folder"];
        refuses(&recording, &file, || odometry("out"), &parts);
        fs::remove_file(recording.path(&file)).unwrap();
    }
    odometry("out").succeeds();
    odometry("out").fails_with(&["out/report.json exists", "--force"]);
    let before = recording.bytes("out/poses_tum.txt");
    let polish = odometry("out").with("--poses=out/poses_tum.txt");
    polish
        .with("--force")
        .fails_with(&["out/poses_tum.txt would be replaced", "pose_file"]);
    assert!(recording.bytes("out/poses_tum.txt") == before);
    odometry("poses.txt").fails_with(&["output_folder is poses.txt, and nothing can be written"]);

    // The poses that build-map finds are an output next to the map.
    recording.write("map.poses_tum.txt", "of the user");
    let build = || recording.fpmcl("build-map").set("poses", "odometry");
    let parts = ["was not written by fpmcl", "mesh_file"];
    refuses(&recording, "map.poses_tum.txt", build, &parts);
    fs::remove_file(recording.path("map.poses_tum.txt")).unwrap();
    build().succeeds();
    let given = || {
        let call = recording.fpmcl("build-map").with("--force");
        call.set("pose_file", "map.poses_tum.txt")
            .set("calib_file", "null")
    };
    let before = recording.bytes("map.poses_tum.txt");
    given().fails_with(&["map.poses_tum.txt would be replaced", "pose_file"]);
    assert!(recording.bytes("map.poses_tum.txt") == before);
}

#[test]
fn an_output_that_is_an_input_is_refused() {
    let recording = mapped(4);
    let build =
        |key: &'static str, value: &'static str| recording.fpmcl("build-map").set(key, value);
    let parts = ["would be replaced", "pose_file"];
    refuses(
        &recording,
        "poses.txt",
        || build("mesh_file", "poses.txt"),
        &parts,
    );
    refuses(
        &recording,
        "build_map.yml",
        || build("mesh_file", "build_map.yml"),
        &["the configuration file"],
    );
    let truth = || build("truth_mesh", "map.ply");
    refuses(
        &recording,
        "map.ply",
        truth,
        &["would be replaced", "truth_mesh"],
    );
    let result = || recording.fpmcl("localize").set("result_path", "map.ply");
    refuses(
        &recording,
        "map.ply",
        result,
        &["would be replaced", "map_file"],
    );

    // Of an earlier run, and thus claimed.
    recording.fpmcl("localize").succeeds();
    let odometry = || {
        let call = recording.fpmcl("localize").set("odometry", "file");
        call.set("odometry_file", "results/mcl_tum.txt")
            .set("result_path", "results/other.npz")
    };
    refuses(
        &recording,
        "results/mcl_tum.txt",
        odometry,
        &["odometry_file", "result_path"],
    );
}

#[cfg(unix)]
#[test]
fn an_output_that_is_an_input_through_a_link_is_refused() {
    use std::os::unix::fs::symlink;
    let recording = mapped(3);
    fs::create_dir(recording.path("real")).unwrap();
    symlink("real", recording.path("linked")).unwrap();
    fs::copy(
        recording.path("poses.txt"),
        recording.path("real/report.json"),
    )
    .unwrap();
    recording
        .fpmcl("localize")
        .set("pose_file", "real/report.json")
        .set("result_path", "linked/localization.npz")
        .with("--force")
        .fails_with(&["would be replaced", "pose_file"]);
    symlink("map.ply", recording.path("link.ply")).unwrap();
    let map = recording.bytes("map.ply");
    let call = recording.fpmcl("build-map").set("mesh_file", "link.ply");
    call.with("--force")
        .fails_with(&["link.ply", "not a regular file"]);
    assert!(recording.bytes("map.ply") == map);
    assert!(recording.path("link.ply").is_symlink());
}

#[cfg(unix)]
#[test]
fn what_is_not_a_regular_file_is_never_replaced() {
    use std::os::unix::fs::FileTypeExt as _;
    let recording = mapped(3);
    let make = |name: &str| {
        let made = std::process::Command::new("mkfifo")
            .arg(recording.path(name))
            .status();
        assert!(made.unwrap().success());
    };
    make("pipe.ply");
    make("pipe.npz");
    for (command, key, value) in [
        ("build-map", "mesh_file", "pipe.ply"),
        ("localize", "result_path", "pipe.npz"),
    ] {
        let call = recording.fpmcl(command).set(key, value).with("--force");
        call.fails_with(&[value, "not a regular file", key]);
        assert!(
            fs::symlink_metadata(recording.path(value))
                .unwrap()
                .file_type()
                .is_fifo()
        );
    }
}

#[test]
fn force_replaces_files_of_the_same_kind_only() {
    let recording = mapped(3);
    recording.write("notes.txt", "of the user");
    for (command, key) in [("build-map", "mesh_file"), ("localize", "result_path")] {
        let call = recording
            .fpmcl(command)
            .set(key, "notes.txt")
            .with("--force");
        call.fails_with(&["notes.txt", "of another kind", key]);
        assert_eq!(recording.bytes("notes.txt"), b"of the user");
    }
    recording.write("other.ply", "ply\nof another program");
    let call = || recording.fpmcl("build-map").set("mesh_file", "other.ply");
    call().fails_with(&["other.ply exists", "--force"]);
    call().with("--force").succeeds();
    // Now it is ours, also where it was damaged since.
    recording.write("other.ply", "");
    call().with("--force").succeeds();
}

#[test]
fn files_of_others_in_the_folder_of_the_parts_are_kept() {
    let recording = Recording::street(4);
    fs::create_dir(recording.path("map.ply.parts")).unwrap();
    recording.write("map.ply.parts/thesis.tex", "of the user");
    for force in ["force=False", "force=True"] {
        let call = recording.fpmcl("build-map").with("--set").with(force);
        call.fails_with(&[
            "map.ply.parts",
            "files that fpmcl did not write",
            "mesh_file",
        ]);
    }
    // Beside parts of an interrupted build of other inputs.
    recording.write("map.ply.parts/.fpmcl", "unfinished:0123 map.ply\n");
    recording.write("map.ply.parts/0000.ply", "a part");
    recording.fpmcl("build-map").succeeds();
    assert_eq!(recording.bytes("map.ply.parts/thesis.tex"), b"of the user");
    assert_eq!(
        fs::read_dir(recording.path("map.ply.parts"))
            .unwrap()
            .count(),
        1
    );
}

#[test]
fn what_a_killed_process_left_of_the_same_output_is_removed() {
    let recording = Recording::street(3);
    let (left, other) = (".fpmcl-map.ply-Ab3dEf.part", ".fpmcl-other.ply-Ab3dEf.part");
    recording.write(left, "half a map");
    recording.write(other, "half a map");
    recording.fpmcl("build-map").succeeds();
    assert!(!recording.path(left).exists());
    assert!(recording.path(other).exists());
}

/// Runs a command whose files cannot be larger than `blocks` of 512 bytes, as on a full disk.
#[cfg(unix)]
#[track_caller]
fn with_full_disk(folder: &Path, blocks: usize, arguments: &str) -> String {
    let program = assert_cmd::cargo::cargo_bin!("fpmcl");
    let script = format!(
        "trap '' XFSZ; ulimit -f {blocks}; exec {} {arguments}",
        program.display()
    );
    let output = std::process::Command::new("sh")
        .args(["-c", &script])
        .current_dir(folder)
        .output();
    let output = output.unwrap();
    assert_eq!(output.status.code(), Some(1));
    String::from_utf8(output.stderr).unwrap()
}

#[cfg(unix)]
#[test]
fn a_full_disk_leaves_no_temporary_file_and_one_message() {
    let recording = mapped(3);
    for (command, file) in [
        (
            "build-map build_map.yml --set mesh_file=other.ply",
            "other.ply",
        ),
        (
            "localize localization.yml --backend=cpu --set numParticles=20000",
            RESULT,
        ),
    ] {
        let stderr = with_full_disk(recording.folder(), 16, command);
        let (_, message) = stderr.split_once("error: ").unwrap();
        assert!(
            message.contains(file) && message.contains("too large"),
            "{stderr}"
        );
        assert_eq!(message.lines().count(), 1, "{stderr}");
        assert!(!stderr.contains("panicked"), "{stderr}");
        assert!(!recording.path(file).exists());
        for folder in ["", "results", "other.ply.parts"] {
            for entry in fs::read_dir(recording.path(folder)).into_iter().flatten() {
                let name = entry.unwrap().file_name().into_string().unwrap();
                assert!(!name.ends_with(".part"), "{folder}/{name}");
            }
        }
    }
}

#[test]
fn the_demonstration_runs_twice_in_one_folder() {
    let folder = tempfile::tempdir().unwrap();
    for _ in 0..2 {
        run(
            folder.path(),
            &["demo", "--output=out", "--frames=8", "--backend=cpu"],
        );
    }
    assert!(folder.path().join("out/map.ply").exists());
}

#[test]
fn an_effective_configuration_runs_again_in_its_own_folder() {
    let recording = Recording::street(4);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    let expected = recording.bytes("results/mcl_tum.txt");
    fpmcl("localize")
        .in_folder(recording.folder())
        .with("results/effective_localization.yml")
        .with("--backend=cpu")
        .with("--force")
        .succeeds();
    assert!(recording.bytes("results/mcl_tum.txt") == expected);
}
