//! `export`, from outside: the log and the model hold what the result holds.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::collections::BTreeMap;
use std::fs;

use common::{Fpmcl, Recording, fpmcl};
use serde_json::Value;

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
