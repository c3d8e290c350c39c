//! Messages speak of what the caller gave, and state what is no error as what it is.

use std::fs;

use crate::common::{self, Recording, fpmcl, real_recording};

#[test]
fn without_an_input_the_message_asks_for_one_and_names_no_path_as_given() {
    for (command, input) in [
        ("odometry", "a recording"),
        ("build-map", "a recording"),
        ("localize", "a recording"),
        ("ground", "a recording"),
        ("refine", "a result"),
        ("evaluate", "a result"),
    ] {
        let parts = [
            "no input was given",
            &format!("give {input} or a configuration"),
        ];
        let output = fpmcl(command).fails_with(&parts);
        for key in ["scan_folder is data", "result_file is results"] {
            assert!(!output.stderr.contains(key), "{command}: {}", output.stderr);
        }
    }
    // The key that was set is the one that the message is about.
    fpmcl("build-map")
        .set("scan_folder", "nowhere")
        .fails_with(&["scan_folder (the recording) is nowhere", "no such folder"]);
}

#[test]
fn a_build_speaks_of_no_request_and_of_no_missing_file_that_nobody_needs() {
    let recording = Recording::street(8);
    fs::rename(recording.path("poses.txt"), recording.path("given.txt")).unwrap();
    let build = |arguments: &[&str]| {
        let call = fpmcl("build-map").in_folder(recording.folder());
        let call = call
            .set("depth", "6")
            .set("voxel_size", "0.2")
            .set("holdout_step", "3");
        let output = arguments.iter().fold(call, common::Fpmcl::with).succeeds();
        for part in ["was requested", "give their file", "has no poses"] {
            let texts = [&output.stdout, &output.stderr];
            assert!(!texts.iter().any(|text| text.contains(part)), "{texts:?}");
        }
        output
    };
    let output = build(&["velodyne", "--output", "found.ply"]);
    let found = "contains no poses: they are found from its scans";
    assert!(output.stderr.contains(found), "{}", output.stderr);
    let info = fpmcl("info")
        .in_folder(recording.folder())
        .with(".")
        .succeeds();
    let poses = info
        .stdout
        .lines()
        .find(|line| line.starts_with("poses "))
        .unwrap();
    assert!(poses.ends_with(" none in the recording"), "{poses}");
}

#[test]
fn the_beams_of_a_real_sensor_are_those_of_its_manual() {
    let Some(recording) = real_recording("vlp16-raw") else {
        return;
    };
    let info = fpmcl("info").with(recording).succeeds();
    assert!(
        info.stdout.contains("16 beams from +15.0 to -15.0 degrees"),
        "{}",
        info.stdout
    );
}
