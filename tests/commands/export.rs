//! `export`, from outside: the log and the model hold what the result holds.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use fpmcl::geometry::Vec3;
use fpmcl::internals::mesh_file;
use fpmcl::internals::scan_files;
use fpmcl::internals::surface_area_m2;
use serde_json::Value;

use crate::common::{Fpmcl, Recording, fpmcl};

const RESULT: &str = "results/localization.npz";
const FRAMES: usize = 5;

/// A localized recording, with the log that `localize` wrote.
fn localized() -> Recording {
    let recording = Recording::street(FRAMES);
    recording.fpmcl("build-map").succeeds();
    recording
        .fpmcl("localize")
        .with("--mcap")
        .with("run.mcap")
        .succeeds();
    recording
}

fn export(recording: &Recording, arguments: &[&str]) -> Fpmcl {
    let call = fpmcl("export").in_folder(recording.folder());
    arguments.iter().fold(call, Fpmcl::with)
}

/// Times and contents of the messages of each topic [ns].
fn messages(log: &[u8]) -> BTreeMap<String, Vec<(u64, Vec<u8>)>> {
    let mut topics = BTreeMap::<String, Vec<_>>::new();
    for message in mcap::MessageStream::new(log).unwrap() {
        let message = message.unwrap();
        let topic = topics.entry(message.channel.topic.clone()).or_default();
        topic.push((message.log_time, message.data.into_owned()));
    }
    topics
}

#[test]
fn a_log_has_a_message_of_every_kind_per_frame() {
    let recording = localized();
    let log = recording.bytes("run.mcap");
    let topics = messages(&log);
    for (topic, count) in [
        ("/tf", FRAMES),
        ("/estimate", FRAMES),
        ("/truth", FRAMES),
        ("/particles", FRAMES),
        ("/scan", FRAMES),
        ("/numbers", FRAMES),
        ("/map", 1),
        ("/paths", 1),
    ] {
        assert_eq!(topics[topic].len(), count, "{topic}");
    }
    let csv = String::from_utf8(recording.bytes("results/frames.csv")).unwrap();
    let mut rows = csv.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let header = rows.next().unwrap();
    let column = |row: &[&str], name: &str| -> f64 {
        let column = header.iter().position(|title| *title == name).unwrap();
        row[column].parse().unwrap()
    };
    for (row, (time_ns, numbers)) in rows.zip(&topics["/numbers"]) {
        let numbers: Value = serde_json::from_slice(numbers).unwrap();
        assert_eq!(numbers["frame"].as_f64().unwrap(), column(&row, "frame"));
        let error_m = numbers["position_error_m"].as_f64().unwrap();
        let expected_m = column(&row, "mcl_position_error_m");
        assert!(
            (error_m - expected_m).abs() < 1e-4,
            "{error_m} {expected_m}"
        );
        assert!((*time_ns as f64 * 1e-9 - column(&row, "time_s")).abs() < 1e-4);
    }
    // The same bytes from the result.
    export(&recording, &[RESULT, "--mcap", "again.mcap"]).succeeds();
    assert!(log == recording.bytes("again.mcap"));
    export(
        &recording,
        &[RESULT, "--mcap", "small.mcap", "--points", "100"],
    )
    .succeeds();
    let scans = &messages(&recording.bytes("small.mcap"))["/scan"];
    assert!(
        scans
            .iter()
            .all(|(_, scan)| (800..2600).contains(&scan.len()))
    );
}

#[test]
fn a_log_without_scans_needs_no_recording() {
    let recording = localized();
    fs::rename(recording.path("velodyne"), recording.path("moved")).unwrap();
    let call = || export(&recording, &[RESULT, "--mcap", "poses.mcap"]);
    call().fails_with(&["--points 0", "--recording"]);
    assert!(!recording.path("poses.mcap").exists());
    call().with("--points").with("0").succeeds();
    assert!(!messages(&recording.bytes("poses.mcap")).contains_key("/scan"));
    call()
        .with("--force")
        .with("--recording")
        .with("moved")
        .succeeds();
    assert_eq!(
        messages(&recording.bytes("poses.mcap"))["/scan"].len(),
        FRAMES
    );
}

#[test]
fn a_model_has_the_map_and_the_path() {
    let recording = localized();
    export(&recording, &[RESULT, "--glb", "run.glb"]).succeeds();
    export(&recording, &["map.ply", "--glb", "map.glb"]).succeeds();
    for (file, meshes) in [("run.glb", 3), ("map.glb", 1)] {
        let model = recording.bytes(file);
        assert_eq!((&model[..4], &model[16..20]), (&b"glTF"[..], &b"JSON"[..]));
        let length = u32::from_le_bytes(model[12..16].try_into().unwrap()) as usize;
        let header: Value = serde_json::from_slice(&model[20..20 + length]).unwrap();
        assert_eq!(header["meshes"].as_array().unwrap().len(), meshes, "{file}");
    }
}

#[test]
fn nothing_is_replaced_that_is_no_export() {
    let recording = localized();
    let before = recording.bytes("run.mcap");
    export(&recording, &[RESULT, "--mcap", "run.mcap"]).fails_with(&["run.mcap", "--force"]);
    recording.write("notes.txt", "mine");
    let call = |file| export(&recording, &[RESULT, "--glb", file, "--force"]);
    call("notes.txt").fails_with(&["notes.txt", "not written by fpmcl"]);
    call("map.ply").fails_with(&["map.ply"]);
    export(&recording, &["map.ply", "--mcap", "a.mcap"]).fails_with(&["map.ply", "--glb"]);
    export(&recording, &["poses.txt", "--glb", "a.glb"]).fails_with(&["poses.txt", ".npz"]);
    export(&recording, &[RESULT]).rejects_usage_with(&["--mcap"]);
    assert!(before == recording.bytes("run.mcap"));
}

const TILES: &str = "autoware/pointcloud_map.pcd";
const METADATA: &str = "autoware/pointcloud_map_metadata.yaml";

/// A recording with its map.
fn mapped() -> Recording {
    let recording = Recording::street(FRAMES);
    recording.fpmcl("build-map").succeeds();
    recording
}

/// Lines of the metadata without comments, as keys and values.
fn metadata(recording: &Recording) -> Vec<(String, String)> {
    let text = String::from_utf8(recording.bytes(METADATA)).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines
        .map(|line| {
            let (key, value) = line.split_once(": ").unwrap();
            (key.to_owned(), value.to_owned())
        })
        .collect()
}

/// Lower corners [m] and points of the tiles that the metadata name.
fn tiles(recording: &Recording) -> Vec<([i32; 2], Vec<Vec3>)> {
    let metadata = metadata(recording).into_iter().skip(2);
    metadata
        .map(|(name, corner)| {
            let numbers = corner.trim_matches(['[', ']']).split(", ");
            let corner: Vec<i32> = numbers.map(|number| number.parse().unwrap()).collect();
            let path = recording.path(TILES).join(name);
            let points = scan_files::read(&path).unwrap().points;
            (corner.try_into().unwrap(), points)
        })
        .collect()
}

/// Names of the files of a folder.
fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

#[test]
fn tiles_hold_points_of_the_map_each_in_its_square() {
    let recording = mapped();
    export(
        &recording,
        &["map.ply", "--pcd", "autoware", "--glb", "map.glb"],
    )
    .succeeds();
    let (mesh, _) = mesh_file::read(&recording.path("map.ply")).unwrap();
    let tiles = tiles(&recording);
    assert!(tiles.len() > 3);
    assert_eq!(names(&recording.path(TILES)).len(), tiles.len());
    for (corner_m, points) in &tiles {
        for point in points {
            for (low_m, x) in corner_m.iter().zip([point.x, point.y]) {
                let from_corner_m = f64::from(x) - f64::from(*low_m);
                assert!((0.0..20.0).contains(&from_corner_m), "{corner_m:?} {point}");
            }
        }
    }
    let points: Vec<Vec3> = tiles.into_iter().flat_map(|(_, points)| points).collect();
    let squares = surface_area_m2(&mesh) / (0.2 * 0.2);
    assert!((points.len() as f64 - squares).abs() <= 1.0, "{squares}");
    let bounds = mesh.bounds();
    let is_within = |&point: &Vec3| point.cmpge(bounds.min).all() && point.cmple(bounds.max).all();
    assert!(points.iter().all(is_within));
    assert!(recording.path("map.glb").exists());
}

#[test]
fn tiles_have_the_requested_side_and_spacing_and_the_same_bytes_again() {
    let recording = mapped();
    let call = |folder: &str| {
        let arguments = ["map.ply", "--spacing", "0.5", "--tile-size", "10", "--pcd"];
        export(&recording, &arguments).with(folder).succeeds();
    };
    call("autoware");
    call("again");
    let side = |key: &str| (key.to_owned(), "10.0".to_owned());
    assert_eq!(
        metadata(&recording)[..2],
        [side("x_resolution"), side("y_resolution")]
    );
    let (mesh, _) = mesh_file::read(&recording.path("map.ply")).unwrap();
    let points: usize = tiles(&recording).iter().map(|(_, it)| it.len()).sum();
    assert!((points as f64 - surface_area_m2(&mesh) / 0.25).abs() <= 1.0);
    let again = recording.path("again");
    assert_eq!(
        recording.bytes(METADATA),
        fs::read(again.join("pointcloud_map_metadata.yaml")).unwrap()
    );
    for name in names(&recording.path(TILES)) {
        let path = again.join("pointcloud_map.pcd").join(&name);
        assert!(recording.bytes(&format!("{TILES}/{name}")) == fs::read(path).unwrap());
    }
}

#[test]
fn tiles_of_an_earlier_export_are_replaced_with_force_and_files_of_others_are_kept() {
    let recording = mapped();
    let call = |arguments: &[&str]| {
        let call = export(&recording, &["map.ply", "--pcd", "autoware"]);
        arguments.iter().fold(call, Fpmcl::with)
    };
    call(&["--tile-size", "5"]).succeeds();
    let small = names(&recording.path(TILES));
    recording.write(&format!("{TILES}/mine.pcd"), "mine");
    call(&[]).fails_with(&["pointcloud_map_metadata.yaml", "--force"]);
    call(&["--force"]).succeeds();
    let tiles = tiles(&recording);
    assert!(tiles.len() < small.len());
    assert_eq!(names(&recording.path(TILES)).len(), tiles.len() + 1);
    assert_eq!(recording.bytes(&format!("{TILES}/mine.pcd")), b"mine");

    fs::create_dir_all(recording.path("other/pointcloud_map.pcd")).unwrap();
    let other = |arguments: &[&str]| export(&recording, arguments).with("--pcd").with("other");
    other(&["map.ply", "--force"]).fails_with(&["pointcloud_map.pcd", "not written by fpmcl"]);
    assert!(names(&recording.path("other/pointcloud_map.pcd")).is_empty());
}

#[test]
fn a_spacing_that_fits_neither_memory_nor_map_is_an_error() {
    let recording = mapped();
    let call = |spacing| {
        export(
            &recording,
            &["map.ply", "--pcd", "autoware", "--spacing", spacing],
        )
    };
    call("0").rejects_usage_with(&["0.001 to 100"]);
    let message = ["the points of the tiles", "--spacing", "--memory"];
    call("0.001").with("--memory=0.1").fails_with(&message);
    call("100").fails_with(&["too little", "--spacing"]);
    assert!(!recording.path(TILES).exists());
    export(&recording, &["map.ply", "--glb", "a.glb", "--spacing", "1"])
        .rejects_usage_with(&["--pcd"]);
}

#[test]
fn a_result_is_exported_with_the_tiles_of_its_map() {
    let recording = localized();
    export(&recording, &[RESULT, "--pcd", "autoware"]).succeeds();
    assert!(tiles(&recording).len() > 3);
}
