//! Invalid recordings, maps and results: the error names the file or key, the value and the remedy,
//! and existing output is kept.

use std::fs;

use ::fpmcl::internals::app::LocalizationResults;

use crate::common::{Recording, config_file, fpmcl};

/// A recording with its map.
fn mapped(frames: usize) -> Recording {
    let recording = Recording::street(frames);
    recording.fpmcl("build-map").succeeds();
    recording
}

/// A recording with its map and its localization result.
fn localized(frames: usize) -> Recording {
    let recording = mapped(frames);
    recording.fpmcl("localize").succeeds();
    recording
}

const RESULT: &str = "results/localization.npz";

#[test]
fn a_map_is_built_and_the_car_is_localized_in_it() {
    let recording = localized(6);
    recording.fpmcl("refine").succeeds();
    for name in ["map.ply", "map.effective.yml", "map.report.json", RESULT] {
        assert!(recording.path(name).exists(), "{name}");
    }
    assert!(!recording.path("map.ply.parts").exists());
}

#[test]
fn a_missing_input_is_reported_with_its_key_and_nothing_is_written() {
    for (name, key) in [
        ("poses.txt", "pose_file (--poses, --truth)"),
        ("calib.txt", "calib_file (--calib)"),
    ] {
        let recording = Recording::street(2);
        fs::remove_file(recording.path(name)).unwrap();
        let message = format!("{key} is {name}, but there is no such file");
        recording
            .fpmcl("build-map")
            .fails_with(&[&message, "give the path"]);
        assert!(!recording.path("map.ply").exists());
        assert!(!recording.path("map.ply.parts").exists());
    }
    let recording = Recording::street(2);
    recording
        .fpmcl("build-map")
        .set("scan_folder", "nowhere")
        .fails_with(&["scan_folder (the recording) is nowhere", "no such folder"]);
    recording
        .fpmcl("localize")
        .fails_with(&["map_file (--map) is map.ply", "no such file"]);
    recording
        .fpmcl("refine")
        .fails_with(&["result_file is results/localization.npz", "no such file"]);
    assert!(!recording.path("results").exists());
}

#[test]
fn a_missing_odometry_is_reported_with_its_key() {
    mapped(3)
        .fpmcl("localize")
        .set("odometry_file", "wheels.txt")
        .set("odometry", "file")
        .fails_with(&["odometry_file (--odometry) is wheels.txt", "no such file"]);
}

#[test]
fn a_truncated_scan_is_reported_with_its_file() {
    let recording = mapped(3);
    let map = recording.bytes("map.ply");
    let path = recording.path("velodyne/000001.bin");
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() - 5]).unwrap();
    let size = format!("000001.bin has {} bytes", bytes.len() - 5);
    let parts = [size.as_str(), "not a multiple of 16", "copy it again"];
    recording
        .fpmcl("build-map")
        .with("--force")
        .fails_with(&parts);
    recording.fpmcl("localize").fails_with(&parts);
    assert!(
        recording.bytes("map.ply") == map,
        "the existing map has changed"
    );
}

#[test]
fn empty_scans_stop_no_command() {
    let recording = Recording::street(6);
    recording.write_scan(0, &[]);
    recording.write_scan(3, &[]);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    recording.fpmcl("refine").succeeds();
}

#[test]
fn a_recording_with_empty_scans_only_is_reported() {
    let recording = Recording::street(3);
    for frame in 0..3 {
        recording.write_scan(frame, &[]);
    }
    recording.fpmcl("build-map").fails_with(&[
        "frames 0 to 2",
        "too few points",
        "no triangles",
        "check range_image",
    ]);
    assert!(!recording.path("map.ply").exists());
}

#[test]
fn non_finite_points_are_ignored() {
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
fn more_scans_than_poses_are_an_error_and_fewer_are_not() {
    let recording = Recording::street(4);
    let poses = fs::read_to_string(recording.path("poses.txt")).unwrap();
    recording.write("poses.txt", poses.lines().next().unwrap());
    recording.fpmcl("build-map").fails_with(&[
        "000001.bin has no pose",
        "poses.txt has 1 rows",
        "n_scans",
    ]);
    recording.write("poses.txt", &poses);
    fs::remove_file(recording.path("velodyne/000003.bin")).unwrap();
    recording.fpmcl("build-map").succeeds();
    // Not all frames are sure in a map of three scans.
    let call = recording.fpmcl("localize").set("all_poses", "True");
    call.succeeds();
    let rows = fs::read_to_string(recording.path("results/mcl_tum.txt")).unwrap();
    let poses = rows.lines().filter(|row| !row.starts_with('#'));
    assert_eq!(poses.count(), 3);
}

#[test]
fn a_calibration_without_tr_is_reported() {
    let recording = Recording::street(2);
    recording.write("calib.txt", "P0: 1 0 0 0 0 1 0 0 0 0 1 0\n");
    recording
        .fpmcl("build-map")
        .fails_with(&["calib.txt", "`Tr:`", "use the calibration"]);
}

#[test]
fn text_among_the_poses_is_reported_with_its_line() {
    let recording = Recording::street(2);
    recording.write(
        "poses.txt",
        "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 one 0 0 0 0 1 0\n",
    );
    recording
        .fpmcl("build-map")
        .fails_with(&["poses.txt, line 2", "`one`", "number"]);
}

#[test]
fn a_selection_without_frames_is_reported() {
    let recording = Recording::street(2);
    recording
        .fpmcl("build-map")
        .set("start_idx", "7")
        .fails_with(&["no frame is selected", "start_idx 7", "2 scans"]);
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
        .fails_with(&["map.ply", "4000000000", "header is wrong"]);
}

#[test]
fn a_map_that_is_not_ply_or_is_truncated_is_refused() {
    let recording = mapped(3);
    let map = recording.bytes("map.ply");
    fs::write(recording.path("map.ply"), &map[..map.len() / 2]).unwrap();
    recording
        .fpmcl("localize")
        .fails_with(&["map.ply", "truncated"]);
    recording.write("map.ply", "not a map\n");
    recording
        .fpmcl("localize")
        .fails_with(&["map.ply is not a readable PLY file"]);
}

#[test]
fn an_existing_map_is_kept_unless_forced() {
    let recording = Recording::street(4);
    recording.write("map.ply", "ply of before");
    recording
        .fpmcl("build-map")
        .fails_with(&["map.ply exists", "--force"]);
    assert_eq!(recording.bytes("map.ply"), b"ply of before");
    recording.fpmcl("build-map").with("--force").succeeds();
    assert!(recording.bytes("map.ply").starts_with(b"ply"));
}

#[test]
fn an_existing_result_is_kept_unless_forced() {
    let recording = localized(4);
    let before = recording.bytes(RESULT);
    recording
        .fpmcl("localize")
        .fails_with(&[RESULT, "exists", "--force"]);
    assert!(recording.bytes(RESULT) == before);
    recording.fpmcl("refine").succeeds();
    let refined = recording.bytes(RESULT);
    recording
        .fpmcl("refine")
        .fails_with(&[RESULT, "already has refined poses", "--force"]);
    assert!(recording.bytes(RESULT) == refined);
    recording.fpmcl("refine").with("--force").succeeds();
}

#[test]
fn an_output_path_that_cannot_be_written_is_reported_before_any_work() {
    // A file in the place of a folder also stops users whom permissions do not restrict.
    let recording = mapped(4);
    recording.write("results", "a file in the place of a folder");
    recording.fpmcl("localize").fails_with(&[
        "result_path is results/localization.npz",
        "choose another result_path",
    ]);
    assert_eq!(
        recording.bytes("results"),
        b"a file in the place of a folder"
    );
    recording
        .fpmcl("build-map")
        .set("mesh_file", "results/map.ply")
        .fails_with(&["mesh_file is results/map.ply", "choose another mesh_file"]);
    fs::create_dir(recording.path("folder.ply")).unwrap();
    recording
        .fpmcl("build-map")
        .set("mesh_file", "folder.ply")
        .fails_with(&["folder.ply is a folder", "name of a file"]);
}

#[test]
fn a_truncated_result_is_refused() {
    let recording = localized(3);
    let bytes = recording.bytes(RESULT);
    fs::write(recording.path(RESULT), &bytes[..bytes.len() / 2]).unwrap();
    recording
        .fpmcl("refine")
        .fails_with(&[RESULT, "is cut off", "run localize again"]);
    fpmcl("evaluate")
        .in_folder(recording.folder())
        .with(config_file("evaluation.yml"))
        .fails_with(&[RESULT, "is cut off"]);
}

#[test]
fn refining_frames_other_than_the_localized_ones_is_reported() {
    let recording = localized(4);
    recording
        .fpmcl("refine")
        .set("frame_step", "2")
        .fails_with(&["has 4 frames", "frame_step select 2"]);
}

#[test]
fn a_damaged_scan_loses_no_frame_before_it() {
    let recording = mapped(8);
    fs::write(recording.path("velodyne/000005.bin"), [0; 21]).unwrap();
    let stderr = recording.fpmcl("localize").exits_with(1).stderr;
    for part in [
        "000005.bin",
        "5 of 8 frames are localized and kept in results",
    ] {
        assert!(stderr.contains(part), "{stderr}");
    }
    let rows = String::from_utf8(recording.bytes("results/mcl_tum.txt")).unwrap();
    assert_eq!(rows.lines().count(), 5);
}

#[test]
fn a_picture_that_cannot_be_written_loses_no_frame() {
    let recording = mapped(4);
    // A folder in the place of a picture, after an earlier run.
    fs::create_dir_all(recording.path("results/loc_plots/000000.png")).unwrap();
    recording.write("results/.fpmcl", "claimed loc_plots\n");
    let stderr = recording
        .fpmcl("localize")
        .set("visualize", "True")
        .exits_with(1)
        .stderr;
    for part in [
        "loc_plots",
        "1 of 4 frames are localized and kept in results",
    ] {
        assert!(stderr.contains(part), "{stderr}");
    }
    assert!(recording.path(RESULT).exists());
}

#[test]
fn a_result_beside_another_is_refused_and_force_removes_all_files_of_the_old_one() {
    let recording = localized(4);
    recording
        .fpmcl("localize")
        .set("result_path", "results/other.npz")
        .fails_with(&["report.json", "another result", "result_path", "--force"]);
    recording.fpmcl("refine").succeeds();
    assert!(recording.path("results/refined_tum.txt").exists());
    recording.fpmcl("localize").with("--force").succeeds();
    for name in [
        "refined_tum.txt",
        "refined_kitti.txt",
        "effective_refinement.yml",
    ] {
        assert!(!recording.path("results").join(name).exists(), "{name}");
    }
}

#[test]
fn frames_without_ground_keep_the_estimates_of_the_filter() {
    // Shorter drives do not see the ground that they are on, and are not tracked.
    let recording = mapped(16);
    // With few particles the covariances are wide, and the frames are searched for.
    let call = recording.fpmcl("localize").set("numParticles", "2000");
    call.set("num_reduced", "200").succeeds();
    let mut map = ::fpmcl::internals::ply::read(&recording.path("map.ply")).unwrap();
    for vertex in &mut map.vertices {
        vertex.y += 500.0;
    }
    ::fpmcl::internals::ply::write(&recording.path("elsewhere.ply"), &map, None).unwrap();
    // Without odometry, the trajectory is not smoothed either.
    let stderr = recording
        .fpmcl("refine")
        .set("map_file", "elsewhere.ply")
        .set("odometry", "none")
        .succeeds()
        .stderr;
    let message = "frames are not refined: there is no mapped ground";
    assert!(stderr.contains(message), "{stderr}");
    assert!(!stderr.contains("smoothed"), "{stderr}");
    let results = LocalizationResults::read(&recording.path(RESULT)).unwrap();
    let (estimates, refined) = (results.estimates.unwrap(), results.refined.unwrap());
    assert_eq!(estimates.len(), refined.len());
    for (estimate, refined) in estimates.iter().zip(&refined) {
        let change = estimate.inverse() * refined;
        assert!(change.translation.vector.norm() < 1e-9, "{change}");
        assert!(change.rotation.angle() < 1e-6, "{change}");
    }
}

#[test]
fn a_map_of_triangles_without_area_is_refused() {
    let recording = mapped(3);
    recording.write(
        "map.ply",
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n",
    );
    recording.fpmcl("localize").fails_with(&[
        "map_file is map.ply",
        "none of the 1 triangles of the map has an area",
    ]);
}
