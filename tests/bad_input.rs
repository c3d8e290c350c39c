//! Recordings, maps and results that are not as they should be: each is told with its file or
//! key, its value and what to do, and nothing that was there is lost.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs;

use ::fpmcl::app::results::LocalizationResults;
use common::{Recording, fpmcl};

/// A recording with its map.
fn mapped(frames: usize) -> Recording {
    let recording = Recording::street(frames);
    recording.fpmcl("build-map").succeeds();
    recording
}

/// A recording with its map and the result of localize.
fn localized(frames: usize) -> Recording {
    let recording = mapped(frames);
    recording.fpmcl("localize").succeeds();
    recording
}

const RESULT: &str = "results/localization.npz";

#[test]
fn a_map_is_built_of_the_street_and_the_car_found_in_it() {
    let recording = localized(6);
    recording.fpmcl("refine").succeeds();
    for name in ["map.ply", "map.yml", "map.report.json", RESULT] {
        assert!(recording.path(name).exists(), "{name}");
    }
    assert!(!recording.path("map.ply.parts").exists());
}

#[test]
fn a_missing_input_is_told_with_its_key_and_nothing_is_written() {
    for (name, key) in [("poses.txt", "pose_file"), ("calib.txt", "calib_file")] {
        let recording = Recording::street(2);
        fs::remove_file(recording.path(name)).unwrap();
        let told = format!("{key} is {name}, but there is no such file");
        recording
            .fpmcl("build-map")
            .fails_saying(&[&told, "give the path"]);
        assert!(!recording.path("map.ply").exists());
        assert!(!recording.path("map.ply.parts").exists());
    }
    let recording = Recording::street(2);
    recording
        .fpmcl("build-map")
        .set("scan_folder", "nowhere")
        .fails_saying(&["scan_folder is nowhere", "no such folder"]);
    recording
        .fpmcl("localize")
        .fails_saying(&["map_file is map.ply", "no such file"]);
    recording
        .fpmcl("refine")
        .fails_saying(&["result_file is results/localization.npz", "no such file"]);
    assert!(!recording.path("results").exists());
}

#[test]
fn a_missing_odometry_is_told_with_its_key() {
    mapped(3)
        .fpmcl("localize")
        .set("odometry_file", "wheels.txt")
        .set("odometry", "file")
        .fails_saying(&["odometry_file is wheels.txt", "no such file"]);
}

#[test]
fn a_truncated_scan_is_named() {
    let recording = mapped(3);
    let map = recording.bytes("map.ply");
    let path = recording.path("velodyne/000001.bin");
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() - 5]).unwrap();
    let told = format!("000001.bin has {} bytes", bytes.len() - 5);
    let parts = [told.as_str(), "not a multiple of 16", "copy it again"];
    recording
        .fpmcl("build-map")
        .with("--force")
        .fails_saying(&parts);
    recording.fpmcl("localize").fails_saying(&parts);
    assert!(recording.bytes("map.ply") == map, "the old map is lost");
}

#[test]
fn an_empty_scan_is_no_reason_to_fail() {
    let recording = Recording::street(6);
    recording.write_scan(0, &[]);
    recording.write_scan(3, &[]);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    recording.fpmcl("refine").succeeds();
}

#[test]
fn a_recording_of_nothing_but_empty_scans_is_told() {
    let recording = Recording::street(3);
    for frame in 0..3 {
        recording.write_scan(frame, &[]);
    }
    recording.fpmcl("build-map").fails_saying(&[
        "frames 0 to 2",
        "too few points",
        "no triangles",
        "check range_image",
    ]);
    assert!(!recording.path("map.ply").exists());
}

#[test]
fn points_that_are_not_finite_change_nothing() {
    let clean = localized(4);
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
    dirty.fpmcl("localize").succeeds();
    for name in ["map.ply", "results/mcl_tum.txt"] {
        assert!(clean.bytes(name) == dirty.bytes(name), "{name}");
    }
}

#[test]
fn more_scans_than_poses_is_an_error_and_fewer_is_none() {
    let recording = Recording::street(4);
    let poses = fs::read_to_string(recording.path("poses.txt")).unwrap();
    recording.write("poses.txt", poses.lines().next().unwrap());
    recording.fpmcl("build-map").fails_saying(&[
        "000001.bin has no pose",
        "poses.txt has 1 rows",
        "n_scans",
    ]);
    recording.write("poses.txt", &poses);
    fs::remove_file(recording.path("velodyne/000003.bin")).unwrap();
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    let rows = fs::read_to_string(recording.path("results/mcl_tum.txt")).unwrap();
    assert_eq!(rows.lines().count(), 3);
}

#[test]
fn a_calibration_without_tr_is_told() {
    let recording = Recording::street(2);
    recording.write("calib.txt", "P0: 1 0 0 0 0 1 0 0 0 0 1 0\n");
    recording
        .fpmcl("build-map")
        .fails_saying(&["calib.txt", "`Tr:`", "use the calib.txt"]);
}

#[test]
fn a_word_among_the_poses_is_told_with_its_line() {
    let recording = Recording::street(2);
    recording.write(
        "poses.txt",
        "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 one 0 0 0 0 1 0\n",
    );
    recording
        .fpmcl("build-map")
        .fails_saying(&["poses.txt, line 2", "`one`", "number"]);
}

#[test]
fn a_selection_of_no_frame_is_told() {
    let recording = Recording::street(2);
    recording
        .fpmcl("build-map")
        .set("start_idx", "7")
        .fails_saying(&["no frame is selected", "start_idx 7", "2 scans"]);
}

#[test]
fn a_map_with_an_impossible_header_is_refused() {
    let recording = Recording::street(2);
    recording.write(
        "map.ply",
        "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n\
         property float x\nproperty float y\nproperty float z\n\
         element face 4000000000\nproperty list uchar int vertex_indices\nend_header\n",
    );
    recording
        .fpmcl("localize")
        .fails_saying(&["map.ply", "4000000000", "header is wrong"]);
}

#[test]
fn a_map_that_is_no_ply_or_cut_off_is_refused() {
    let recording = mapped(3);
    let map = recording.bytes("map.ply");
    fs::write(recording.path("map.ply"), &map[..map.len() / 2]).unwrap();
    recording
        .fpmcl("localize")
        .fails_saying(&["map.ply", "truncated"]);
    recording.write("map.ply", "a letter to my aunt\n");
    recording
        .fpmcl("localize")
        .fails_saying(&["map.ply is not a readable PLY file"]);
}

#[test]
fn an_existing_map_is_kept_unless_forced() {
    let recording = Recording::street(4);
    recording.write("map.ply", "mine");
    recording
        .fpmcl("build-map")
        .fails_saying(&["map.ply exists", "--force"]);
    assert_eq!(recording.bytes("map.ply"), b"mine");
    recording.fpmcl("build-map").with("--force").succeeds();
    assert!(recording.bytes("map.ply").starts_with(b"ply"));
}

#[test]
fn an_existing_result_is_kept_unless_forced() {
    let recording = localized(4);
    let before = recording.bytes(RESULT);
    recording
        .fpmcl("localize")
        .fails_saying(&[RESULT, "exists", "--force"]);
    assert!(recording.bytes(RESULT) == before);
    recording.fpmcl("refine").succeeds();
    let refined = recording.bytes(RESULT);
    recording
        .fpmcl("refine")
        .fails_saying(&[RESULT, "refined poses already", "--force"]);
    assert!(recording.bytes(RESULT) == refined);
    recording.fpmcl("refine").with("--force").succeeds();
}

#[test]
fn a_folder_that_cannot_be_written_is_told_before_the_work() {
    // Permissions do not bind every user; a file where a folder belongs does.
    let recording = mapped(4);
    recording.write("results", "a file where a folder belongs");
    recording.fpmcl("localize").fails_saying(&[
        "result_path is results/localization.npz",
        "choose another result_path",
    ]);
    assert_eq!(recording.bytes("results"), b"a file where a folder belongs");
    recording
        .fpmcl("build-map")
        .set("mesh_file", "results/map.ply")
        .fails_saying(&["mesh_file is results/map.ply", "choose another mesh_file"]);
    fs::create_dir(recording.path("folder.ply")).unwrap();
    recording
        .fpmcl("build-map")
        .set("mesh_file", "folder.ply")
        .fails_saying(&["folder.ply is a folder", "name of a file"]);
}

#[test]
fn a_result_that_is_cut_off_is_refused() {
    let recording = localized(3);
    let bytes = recording.bytes(RESULT);
    fs::write(recording.path(RESULT), &bytes[..bytes.len() / 2]).unwrap();
    recording
        .fpmcl("refine")
        .fails_saying(&[RESULT, "is cut off", "run localize again"]);
    fpmcl("evaluate")
        .in_folder(recording.folder())
        .with(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/config/evaluation.yml"
        ))
        .fails_saying(&[RESULT, "is cut off"]);
}

#[test]
fn refining_other_frames_than_were_localized_is_told() {
    let recording = localized(4);
    recording
        .fpmcl("refine")
        .set("frame_step", "2")
        .fails_saying(&["4 frames, of which 2 are selected", "frame_step"]);
}

#[test]
fn a_broken_scan_in_the_middle_loses_no_frame_before_it() {
    let recording = mapped(8);
    fs::write(recording.path("velodyne/000005.bin"), [0; 21]).unwrap();
    let said = recording.fpmcl("localize").exits_with(1);
    for part in [
        "000005.bin",
        "5 of 8 frames are localized and kept in results",
    ] {
        assert!(said.stderr.contains(part), "{}", said.stderr);
    }
    let rows = String::from_utf8(recording.bytes("results/mcl_tum.txt")).unwrap();
    assert_eq!(rows.lines().count(), 5);
}

#[test]
fn a_picture_that_cannot_be_drawn_costs_no_frame() {
    let recording = mapped(4);
    fs::create_dir(recording.path("results")).unwrap();
    recording.write("results/loc_plots", "a file where a folder belongs");
    let said = recording
        .fpmcl("localize")
        .set("visualize", "True")
        .exits_with(1);
    for part in [
        "loc_plots",
        "1 of 4 frames are localized and kept in results",
    ] {
        assert!(said.stderr.contains(part), "{}", said.stderr);
    }
    assert!(recording.path(RESULT).exists());
}

#[test]
fn a_result_beside_another_is_told_and_a_new_one_takes_all_of_the_old_away() {
    let recording = localized(4);
    recording
        .fpmcl("localize")
        .set("result_path", "results/other.npz")
        .fails_saying(&["report.json", "another result", "result_path", "--force"]);
    recording.fpmcl("refine").succeeds();
    assert!(recording.path("results/refined_tum.txt").exists());
    recording.fpmcl("localize").with("--force").succeeds();
    for name in ["refined_tum.txt", "refined_kitti.txt", "refinement.yml"] {
        assert!(!recording.path("results").join(name).exists(), "{name}");
    }
}

#[test]
fn frames_without_ground_below_keep_what_the_filter_said() {
    let recording = localized(6);
    let map = recording.bytes("map.ply");
    fs::write(recording.path("elsewhere.ply"), moved_aside(&map)).unwrap();
    // Without odometry nothing is smoothed, so nothing may change.
    let said = recording
        .fpmcl("refine")
        .set("map_file", "elsewhere.ply")
        .set("odometry", "none")
        .succeeds();
    let told = "frames are as they were localized";
    assert!(said.stderr.contains(told), "{}", said.stderr);
    assert!(!said.stderr.contains("smoothed"), "{}", said.stderr);
    let results = LocalizationResults::read(&recording.path(RESULT)).unwrap();
    let (estimates, refined) = (results.estimates.unwrap(), results.refined.unwrap());
    assert_eq!(estimates.len(), refined.len());
    for (estimate, refined) in estimates.iter().zip(&refined) {
        let off = estimate.inverse() * refined;
        assert!(off.translation.vector.norm() < 1e-9, "{off}");
        assert!(off.rotation.angle() < 1e-6, "{off}");
    }
}

/// A map of our own making 500 m to the left of where it is.
fn moved_aside(ply: &[u8]) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.ply");
    fs::write(&path, ply).unwrap();
    let mut mesh = ::fpmcl::map::ply::read(&path).unwrap();
    for vertex in &mut mesh.vertices {
        vertex.y += 500.0;
    }
    ::fpmcl::map::ply::write(&path, &mesh).unwrap();
    fs::read(&path).unwrap()
}

#[test]
fn a_map_without_any_surface_is_refused() {
    let recording = mapped(3);
    recording.write(
        "map.ply",
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n",
    );
    recording
        .fpmcl("localize")
        .fails_saying(&["map_file is map.ply", "none of its 1 triangles has an area"]);
}
