//! Inputs that would give a wrong result without an error: each is refused or warned about.

use std::fs;

use crate::common::{self, Fpmcl, Recording, config_file, fpmcl, json};

/// The poses of `Recording::street`, `(right, ahead)` of each frame [m].
fn poses(positions_m: &[(f64, f64)]) -> String {
    (positions_m.iter())
        .map(|(right_m, ahead_m)| format!("1 0 0 {right_m} 0 1 0 0 0 0 1 {ahead_m}\n"))
        .collect()
}

/// A straight drive in which one frame is somewhere else.
fn with_frame_at(frames: usize, wrong: usize, at: (f64, f64)) -> String {
    let mut positions_m: Vec<_> = (0..frames).map(|i| (0.0, 0.5 * i as f64)).collect();
    positions_m[wrong] = at;
    poses(&positions_m)
}

fn mapped(frames: usize) -> Recording {
    let recording = Recording::street(frames);
    recording.fpmcl("build-map").succeeds();
    recording
}

#[test]
fn one_pose_a_kilometre_off_stops_the_build_and_is_named() {
    let recording = Recording::street(8);
    recording.write("poses.txt", &with_frame_at(8, 4, (0.0, 1002.0)));
    let parts = ["pose_file is poses.txt", "the pose of frame 4 is wrong"];
    recording.fpmcl("build-map").fails_with(&parts);
    assert!(!recording.path("map.ply").exists());
}

#[test]
fn a_jump_of_the_poses_is_an_error_that_can_be_allowed() {
    let recording = Recording::street(4);
    let positions_m = [(0.0, 0.0), (0.0, 0.5), (0.0, 70.0), (0.0, 70.5)];
    recording.write("poses.txt", &poses(&positions_m));
    let parts = ["jump by 70 m from frame 1 to frame 2", "max_step_m"];
    recording.fpmcl("build-map").fails_with(&parts);
    recording
        .fpmcl("build-map")
        .set("max_step_m", "100")
        .set("depth", "8")
        .succeeds();
}

#[test]
fn given_poses_that_jump_stop_the_odometry_and_are_named() {
    let recording = Recording::street(8);
    recording.write("poses.txt", &with_frame_at(8, 4, (0.0, 1002.0)));
    let odometry = || {
        let call = fpmcl("odometry").in_folder(recording.folder());
        call.with("velodyne")
            .with("--poses=poses.txt")
            .with("--calib=calib.txt")
            .with("--output=out")
    };
    odometry().fails_with(&["pose_file is poses.txt", "the pose of frame 4 is wrong"]);
    assert!(!recording.path("out/poses_tum.txt").exists());
    recording.write("poses.txt", &with_frame_at(8, 7, (0.0, 73.5)));
    odometry().fails_with(&["jump by 70 m from frame 6 to frame 7", "max_step_m"]);
    odometry().set("max_step_m", "100").succeeds();
}

/// A scan of nothing that the map of a street has.
fn round_place() -> Vec<[f32; 3]> {
    (0..4000)
        .map(|i| {
            let azimuth = 0.0157 * f64::from(i % 400);
            let z = -1.5 + 0.3 * f64::from(i / 400);
            [30.0 * azimuth.cos(), 30.0 * azimuth.sin(), z].map(|m| m as f32)
        })
        .collect()
}

/// A map of a street, and scans of which those from `first` on are of another place.
fn half_elsewhere(frames: usize, first: usize) -> Recording {
    let recording = mapped(frames);
    for frame in first..frames {
        recording.write_scan(frame, &round_place());
    }
    recording
}

#[test]
fn a_run_that_is_not_localized_has_an_exit_code_of_its_own_and_its_result_is_kept() {
    for (first, code, localized) in [(0, 3, false), (4, 3, false), (10, 0, true)] {
        let recording = half_elsewhere(12, first);
        for (command, name) in [("localize", "mcl_tum.txt"), ("refine", "refined_tum.txt")] {
            let output = recording.fpmcl(command).with("--json").exits_with(code);
            let report: serde_json::Value = serde_json::from_str(&output.stdout).unwrap();
            assert_eq!(report["localized"], localized, "{first} {command}");
            assert!(!output.stderr.contains("error: "), "{}", output.stderr);
            assert!(recording.path("results").join(name).exists());
        }
        assert!(recording.path("results/localization.npz").exists());
    }
}

#[test]
fn frames_that_are_filled_back_do_not_count_as_localized() {
    let recording = half_elsewhere(12, 6);
    // A start that is not known well, so that the first frame is searching.
    let call = without_truth(&recording, "localize").with("--json");
    let call = call.set("tracking_loss.confirming_updates", "2");
    let call = call.set("start.position_m", "5").set("numParticles", "500");
    let output = call.exits_with(3);
    let report: serde_json::Value = serde_json::from_str(&output.stdout).unwrap();
    let summary = &report["summary"];
    assert_eq!(
        (&summary["tracking"], &summary["filled"]),
        (&5.into(), &1.into()),
        "{report}"
    );
    assert_eq!(report["localized"], false);
    let table = String::from_utf8(recording.bytes("results/report.md")).unwrap();
    assert!(table.contains("| filled | 1 |"), "{table}");
    let info = fpmcl("info")
        .in_folder(recording.folder())
        .with("results/localization.npz");
    let info: serde_json::Value =
        serde_json::from_str(&info.with("--json").succeeds().stdout).unwrap();
    assert_eq!(info["filled"], 1);
}

/// A call for a recording of which no true poses are known.
fn without_truth(recording: &Recording, command: &str) -> Fpmcl {
    let call = recording.fpmcl(command).set("pose_file", "null");
    let call = call.set("calib_file", "null").set("odometry", "scans");
    if command == "localize" {
        call.set("initial_pose", "[0, 0, 0]")
    } else {
        call
    }
}

/// Rows of a trajectory, and the comments between them.
fn rows(recording: &Recording, name: &str) -> (usize, Vec<String>) {
    let text = String::from_utf8(recording.bytes(name)).unwrap();
    let comments = text.lines().filter(|line| line.starts_with('#'));
    let comments: Vec<String> = comments.map(str::to_owned).collect();
    (text.lines().count() - comments.len(), comments)
}

#[test]
fn frames_that_are_lost_are_no_part_of_the_trajectory_its_length_and_its_pictures() {
    let recording = half_elsewhere(12, 8);
    let plain = |command: &str| recording.fpmcl(command).set("plot_loc_results", "True");
    for (command, name, column) in [
        ("localize", "mcl", "state"),
        ("refine", "refined", "refined_state"),
    ] {
        plain(command).exits_with(0);
        let table = String::from_utf8(recording.bytes("results/frames.csv")).unwrap();
        let states = common::column(&recording.path("results/frames.csv"), column);
        let tracked = states.iter().filter(|state| *state == "tracking").count();
        assert!((6..12).contains(&tracked), "{states:?}");
        // What is not known has an empty cell.
        assert!(!table.contains(",-1.0000"), "{table}");
        let titles: Vec<&str> = table.lines().next().unwrap().split(',').collect();
        for (row, state) in table.lines().skip(1).zip(&states) {
            let cells = titles.iter().zip(row.split(','));
            let mut cells = cells.filter(|(title, _)| title.starts_with("trajectory_"));
            let is_empty = command == "localize" && state != "tracking";
            assert!(!is_empty || cells.all(|(_, cell)| cell.is_empty()), "{row}");
        }
        let kitti = format!("results/{name}_kitti.txt");
        let tum = format!("results/{name}_tum.txt");
        assert_eq!(rows(&recording, &tum), (tracked, vec![]), "{states:?}");
        assert!(!recording.path(&kitti).exists());
        let report = json(&recording.path("results/report.json"));
        let summary = if command == "localize" {
            &report["summary"]
        } else {
            &report["refinement"]["trajectory"]
        };
        // Half a metre per frame, with what the filter of few particles is off.
        let path_m = summary["path_m"].as_f64().unwrap();
        assert!(
            (path_m - 0.5 * (tracked - 1) as f64).abs() < 0.3,
            "{path_m}"
        );
        // Errors are those of the trusted frames, after the first half of a short run.
        let of = if command == "localize" {
            "mcl"
        } else {
            "refined"
        };
        let errors = &report[of]["metrics"];
        let counts = ["skipped_frames", "frames", "untrusted_frames"];
        assert_eq!(
            counts.map(|it| errors[it].as_u64().unwrap() as usize),
            [6, tracked - 6, 12 - tracked]
        );
        assert!(
            errors["position_m"]["max"].as_f64().unwrap() < 0.5,
            "{errors}"
        );
        let page = String::from_utf8(recording.bytes("results/report.html")).unwrap();
        let title = "Errors without the first 6 frames; frames that are trusted: MCL ";
        assert!(page.contains(title), "{command}");
        let path = json(&recording.path("results/plots/path.json"));
        let trusted = path["trusted"].as_array().unwrap().iter();
        let trusted = trusted.map(|it| it.as_bool().unwrap());
        assert!(trusted.eq(states.iter().map(|state| *state == "tracking")));

        let all = plain(command).with("--force").set("all_poses", "True");
        all.exits_with(0);
        let (count, comments) = rows(&recording, &tum);
        assert_eq!((count, comments[0].as_str()), (12, "# tracking"));
        assert_eq!(rows(&recording, &kitti).0, 12);
        assert!(
            comments.len() > 1 && comments[1] != "# tracking",
            "{comments:?}"
        );
        // Comments are no rows for who reads the file.
        assert_eq!(
            fpmcl::recording::read_tum(&recording.path(&tum))
                .unwrap()
                .len(),
            12
        );
    }
}

#[test]
fn a_run_that_is_nowhere_localized_has_no_path() {
    let recording = half_elsewhere(6, 0);
    let drawn = |command: &str| without_truth(&recording, command).set("plot_loc_results", "True");
    drawn("localize").exits_with(3);
    drawn("refine").exits_with(3);
    for name in ["mcl_tum.txt", "refined_tum.txt"] {
        assert!(
            recording.bytes(&format!("results/{name}")).is_empty(),
            "{name}"
        );
    }
    let report = json(&recording.path("results/report.json"));
    assert_eq!(report["summary"]["path_m"], 0.0);
    assert!(!recording.path("results/plots/path.png").exists());
    assert!(recording.path("results/report.html").exists());
}

#[test]
fn refine_says_what_it_did_without_true_poses() {
    let recording = half_elsewhere(12, 8);
    without_truth(&recording, "localize").exits_with(0);
    let refine = || without_truth(&recording, "refine").with("--force");
    let text = refine().exits_with(0).stdout;
    for row in [
        "moved median",
        "moved max",
        "cost median",
        "beams on the map median",
        "refused frames",
    ] {
        assert!(text.contains(row), "no `{row}` in: {text}");
    }
    assert!(
        text.contains("Refined ") && text.contains("moved by "),
        "{text}"
    );
    let report: serde_json::Value =
        serde_json::from_str(&refine().with("--json").exits_with(0).stdout).unwrap();
    let refinement = &report["refinement"];
    let number = |pointer: &str| refinement.pointer(pointer).unwrap().as_f64().unwrap();
    assert!(number("/cost_m/1/median") <= number("/cost_m/0/median"));
    assert!(number("/agreement/1/median") > 0.8);
    assert!(number("/moved_m/median") > 0.0 && number("/moved_m/max") >= number("/moved_m/median"));
    let refused = number("/refused");
    assert!(refused > 0.0 && refused + number("/trajectory/tracking") == 12.0);
    let page = String::from_utf8(recording.bytes("results/report.html")).unwrap();
    assert!(page.contains("moved median") && page.contains("refused frames"));
}

#[test]
fn senseless_times_stop_the_odometry() {
    let recording = Recording::street(3);
    for (times, part) in [
        ("0\n0.1\n0.1\n", "frame 2 at 0.1 s is not later"),
        ("0\n0.1\n1e300\n", "1e300 is beyond any time"),
        ("0\nnan\n0.2\n", "`nan` is not a finite number"),
    ] {
        recording.write("times.txt", times);
        let call = fpmcl("odometry").in_folder(recording.folder());
        call.with("velodyne")
            .with("--output=out")
            .fails_with(&["times.txt", part]);
    }
}

#[test]
fn one_displaced_pose_is_warned_about_with_its_frame() {
    let recording = Recording::street(9);
    recording.write("poses.txt", &with_frame_at(9, 5, (3.0, 2.5)));
    let stderr = recording.fpmcl("build-map").succeeds().stderr;
    let warning = "fit neither the scan before nor after";
    let line = stderr.lines().find(|line| line.contains(warning)).unwrap();
    assert!(line.ends_with(": 5"), "{line}");
    let stderr = mapped(9)
        .fpmcl("build-map")
        .with("--force")
        .succeeds()
        .stderr;
    assert!(!stderr.contains(warning), "{stderr}");
}

/// A call of build-map that compares the poses with the scans, which these configurations leave out.
fn checked_build(recording: &Recording) -> Fpmcl {
    recording.fpmcl("build-map").set("check_poses", "True")
}

#[test]
fn poses_of_the_camera_taken_for_those_of_the_lidar_are_an_error_that_names_what_fits() {
    let recording = Recording::street(9);
    recording.write("calib.txt", "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n");
    checked_build(&recording).fails_with(&[
        "pose_file is poses.txt",
        "the poses do not fit the scans: between frames 0 and 8",
        "as poses of a camera they differ by 0.0",
        "give calib_file",
    ]);
    assert!(!recording.path("map.ply").exists());
}

#[test]
fn poses_of_the_lidar_taken_for_those_of_a_camera_are_an_error_that_names_what_fits() {
    let recording = Recording::street(9);
    let rows = (0..9).map(|i| format!("1 0 0 {} 0 1 0 0 0 0 1 0\n", 0.5 * f64::from(i)));
    recording.write("poses.txt", &rows.collect::<String>());
    checked_build(&recording).fails_with(&[
        "as poses of the lidar itself they differ by 0.0",
        "remove calib_file",
    ]);
}

#[test]
fn mirrored_poses_of_a_drive_with_a_bend_are_an_error_that_names_what_fits() {
    let folder = tempfile::tempdir().unwrap();
    let simulate = fpmcl("simulate").in_folder(folder.path());
    (simulate.set("output_folder", "street"))
        .set("n_scans", "40")
        .set("path", "[{length_m: 25}, {length_m: 15, turn_deg: 60}]")
        .set("scanner.azimuth_steps", "450")
        .succeeds();
    let path = folder.path().join("street/drive_1/poses.txt");
    let text = fs::read_to_string(path).unwrap();
    // Mirrored at the camera's x axis, which is the lidar's y axis.
    let mirrored = |row: &str| {
        let numbers = row.split_whitespace().enumerate();
        let sign = |i: usize| {
            if (i / 4 == 0) == i.is_multiple_of(4) {
                1.0
            } else {
                -1.0
            }
        };
        let numbers = numbers.map(|(i, word)| (sign(i) * word.parse::<f64>().unwrap()).to_string());
        numbers.collect::<Vec<_>>().join(" ")
    };
    let rows: Vec<String> = text.lines().map(mirrored).collect();
    fs::write(folder.path().join("mirrored.txt"), rows.join("\n")).unwrap();
    let build = fpmcl("build-map").in_folder(folder.path());
    (build.with("street/drive_1").with("--poses=mirrored.txt"))
        .with("--calib=street/drive_1/calib.txt")
        .with("--output=map.ply")
        .fails_with(&[
            "as poses of left-handed frames, mirrored at y they differ by 0.0",
            "negate y, roll and yaw",
        ]);
}

#[test]
fn a_map_whose_ground_is_tilted_is_warned_about() {
    let warning = "the ground is tilted by 20 degrees";
    let tilted = Recording::street(3);
    let (sin, cos) = 20.0_f32.to_radians().sin_cos();
    for frame in 0..3 {
        let points = tilted.scan(frame).into_iter();
        let points = points.map(|[x, y, z]| [x, cos * y - sin * z, sin * y + cos * z]);
        tilted.write_scan(frame, &points.collect::<Vec<_>>());
    }
    let tilted = checked_build(&tilted).set("range_image.fov_up", "30");
    let stderr = tilted.set("range_image.fov_down", "-50").succeeds().stderr;
    assert!(stderr.contains(warning), "{stderr}");
    let stderr = checked_build(&Recording::street(3)).succeeds().stderr;
    assert!(!stderr.contains("tilted"), "{stderr}");
}

#[test]
fn times_that_do_not_ascend_or_are_no_times_are_an_error() {
    let recording = mapped(3);
    for (times, part) in [
        ("0\n0.1\n0.1\n", "frame 2 at 0.1 s is not later"),
        ("1\n1\n1\n", "frame 1 at 1 s is not later"),
        ("0.2\n0.1\n0\n", "frame 1 at 0.1 s is not later"),
        ("0\n0.1\n1e300\n", "is beyond any time"),
    ] {
        recording.write("times.txt", times);
        let call = recording.fpmcl("localize");
        call.set("motion_model", "velocity")
            .fails_with(&["times.txt", part]);
    }
}

#[test]
fn poses_and_odometry_beyond_earth_are_an_error() {
    let recording = mapped(3);
    recording.write("far.txt", &poses(&[(0.0, 0.0), (0.0, 1e200), (0.0, 1e9)]));
    let parts = ["far.txt, line 2", "is beyond any position"];
    recording
        .fpmcl("localize")
        .set("odometry", "file")
        .set("odometry_file", "far.txt")
        .fails_with(&parts);
    recording
        .fpmcl("build-map")
        .with("--force")
        .set("pose_file", "far.txt")
        .fails_with(&parts);
}

#[test]
fn files_that_are_no_scans_do_not_renumber_the_recording() {
    let recording = mapped(4);
    recording.fpmcl("localize").succeeds();
    let expected = recording.bytes("results/mcl_tum.txt");
    fs::write(recording.path("velodyne/._000000.bin"), "hidden").unwrap();
    recording.fpmcl("localize").with("--force").succeeds();
    assert!(recording.bytes("results/mcl_tum.txt") == expected);
    for name in ["notes.bin", "000001 (copy).bin"] {
        let path = recording.path("velodyne").join(name);
        fs::write(&path, []).unwrap();
        let call = recording.fpmcl("localize").with("--force");
        call.fails_with(&[name, "is a number and that of"]);
        fs::remove_file(path).unwrap();
    }
    fs::write(recording.path("velodyne/1.bin"), []).unwrap();
    let call = recording.fpmcl("localize").with("--force");
    call.fails_with(&["1.bin", "have the same number"]);
}

#[cfg(unix)]
#[test]
fn links_that_loop_do_not_multiply_the_recording() {
    let recording = mapped(3);
    recording.fpmcl("localize").succeeds();
    let expected = recording.bytes("results/mcl_tum.txt");
    std::os::unix::fs::symlink(".", recording.path("velodyne/again")).unwrap();
    recording.fpmcl("localize").with("--force").succeeds();
    assert!(recording.bytes("results/mcl_tum.txt") == expected);
}

#[test]
fn numbers_of_other_names_and_types_in_a_map_are_read_and_missing_ones_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let info = |vertex: &str, rows: &str, index: &str| {
        let text = format!(
            "ply\nformat ascii 1.0\nelement vertex 3\n{vertex}element face 1\nproperty list uchar {index} vertex_indices\nend_header\n{rows}3 0 1 2\n"
        );
        fs::write(folder.path().join("map.ply"), text).unwrap();
        fpmcl("info").in_folder(folder.path()).with("map.ply")
    };
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    let rows = "0 0 0\n10 0 0\n0 10 0\n";
    let [upper, integer] = [xyz.to_uppercase(), xyz.replace("float z", "int z")];
    let upper = upper.replace("PROPERTY FLOAT", "property float");
    for (vertex, index) in [(xyz, "short"), (&upper, "int"), (&integer, "uint")] {
        let text = info(vertex, rows, index).succeeds().stdout;
        assert!(text.contains("10 x 10 m"), "{text}");
    }
    let without_z = xyz.replace("property float z\n", "");
    let named = "no property `z` of `vertex`";
    info(&without_z, "0 0\n10 0\n0 10\n", "int").fails_with(&["map.ply", named]);
    info("", "\n\n\n", "int").fails_with(&["map.ply", "no property `x` of `vertex`"]);
}

#[test]
fn text_files_with_a_byte_order_mark_and_line_ends_of_windows_are_read() {
    let recording = mapped(3);
    recording.fpmcl("localize").succeeds();
    let expected = recording.bytes("results/mcl_tum.txt");
    for name in ["poses.txt", "calib.txt"] {
        let text = fs::read_to_string(recording.path(name)).unwrap();
        recording.write(name, &format!("\u{feff}{}", text.replace('\n', "\r\n")));
    }
    recording.fpmcl("localize").with("--force").succeeds();
    assert!(recording.bytes("results/mcl_tum.txt") == expected);
}

#[test]
fn a_run_too_short_for_the_check_of_range_mcl_is_not_a_success() {
    let recording = mapped(4);
    let table = recording.fpmcl("localize").with("--all").succeeds().stdout;
    let row = (table.lines()).find(|line| line.starts_with("range-mcl success"));
    assert!(row.unwrap().contains("not checked"), "{table}");
    let report = json(&recording.path("results/report.json"));
    assert!(report["mcl"]["range_mcl"]["success"].is_null());
}

#[test]
fn a_result_of_range_mcl_is_refined_with_its_report() {
    let recording = mapped(4);
    recording.fpmcl("localize").succeeds();
    // Its results have these two arrays.
    let ours = fs::File::open(recording.path("results/localization.npz")).unwrap();
    let mut ours = zip::ZipArchive::new(ours).unwrap();
    fs::create_dir(recording.path("range_mcl")).unwrap();
    let theirs = fs::File::create(recording.path("range_mcl/localization.npz")).unwrap();
    let mut theirs = zip::ZipWriter::new(theirs);
    for name in ["particles.npy", "start_idx.npy"] {
        let array = ours.by_name(name).unwrap();
        theirs.raw_copy_file(array).unwrap();
    }
    theirs.finish().unwrap();
    let call = recording.fpmcl("refine");
    let file = "range_mcl/localization.npz";
    call.set("result_file", file).succeeds();
    let report = json(&recording.path("range_mcl/report.json"));
    assert_eq!(report["summary"]["frames"], 4, "{report}");
}

#[test]
fn evaluate_uses_the_poses_that_it_is_given() {
    let recording = mapped(4);
    recording.fpmcl("localize").succeeds();
    let moved: Vec<_> = (0..4).map(|i| (50.0, 0.5 * f64::from(i))).collect();
    // The first pose is the origin of the map.
    recording.write("moved.txt", &poses(&[&[(0.0, 0.0)], &moved[1..]].concat()));
    let evaluate = |pose_file: &str| {
        fpmcl("evaluate")
            .in_folder(recording.folder())
            .with(config_file("evaluation.yml"))
            .set("pose_file", pose_file)
            .set("calib_file", "calib.txt")
            .set("plot_loc_traj", "False")
            .succeeds();
        let report = json(&recording.path("results/report.json"));
        report["mcl"]["metrics"]["position_m"]["max"]
            .as_f64()
            .unwrap()
    };
    let error_m = evaluate("null");
    assert!(error_m < 8.0, "{error_m} m");
    let error_m = evaluate("moved.txt");
    assert!((42.0..58.0).contains(&error_m), "{error_m} m");
}

#[test]
fn a_run_that_is_lost_says_so_even_when_quiet() {
    let recording = half_elsewhere(20, 3);
    let call = recording.fpmcl("localize").with("-q").with("--all");
    let output = call.exits_with(3);
    assert!(
        output.stderr.contains("WARN tracking was lost"),
        "{}\n{}",
        output.stderr,
        output.stdout
    );
    assert!(
        output.stdout.contains("states: tracking in"),
        "{}",
        output.stdout
    );
}
