//! A map that is built by independent jobs, one per local map.

#![cfg(unix)]

use std::fs;
use std::process::{Child, Command, Output, Stdio};

use crate::common::{Fpmcl, Recording};

/// Four local maps of three scans.
fn build_map(recording: &Recording) -> Fpmcl {
    recording
        .fpmcl("build-map")
        .set("local_map_size", "3")
        .set("overlap_m", "0.6")
}

fn listed(recording: &Recording) -> Vec<String> {
    let output = build_map(recording).with("--list-jobs").succeeds();
    output.stdout.lines().map(str::to_owned).collect()
}

/// Starts a listed command as a shell does.
fn start(recording: &Recording, job: &str) -> Child {
    Command::new("sh")
        .args(["-c", job])
        .current_dir(recording.folder())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

fn finish(job: Child) -> Output {
    let output = job.wait_with_output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    output
}

/// The map and its tiles, by name.
fn map_files(recording: &Recording) -> Vec<(String, Vec<u8>)> {
    let mut files = vec![("map.ply".to_owned(), recording.bytes("map.ply"))];
    for entry in fs::read_dir(recording.path("map.ply.tiles")).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        if name.ends_with(".tile") {
            let bytes = recording.bytes(&format!("map.ply.tiles/{name}"));
            files.push((name, bytes));
        }
    }
    files.sort();
    files
}

#[test]
fn jobs_in_any_order_and_at_the_same_time_give_the_bytes_of_one_process() {
    let recording = Recording::street(12);
    let jobs = listed(&recording);
    assert_eq!(jobs.len(), 4, "{jobs:?}");
    let early = build_map(&recording).with("--collect");
    early.fails_with(&["local maps 0, 1, 2, 3 are not finished", "--list-jobs"]);
    for (pair, left) in [([3, 0], 2), ([2, 1], 0)] {
        let running = pair.map(|number| start(&recording, &jobs[number]));
        for (number, job) in pair.into_iter().zip(running) {
            let text = String::from_utf8(finish(job).stdout).unwrap();
            assert!(text.starts_with(&format!("local map {number} ")), "{text}");
        }
        assert_eq!(listed(&recording).len(), left);
    }
    assert!(!recording.path("map.ply").exists());
    // A local map that is damaged is an error, and listed again.
    let part = recording.path("map.ply.parts/0001.ply");
    fs::write(&part, &fs::read(&part).unwrap()[1..]).unwrap();
    (build_map(&recording).with("--collect")).fails_with(&["local map 1 is damaged"]);
    let jobs = listed(&recording);
    assert_eq!(jobs.len(), 1);
    finish(start(&recording, &jobs[0]));
    build_map(&recording).with("--collect").succeeds();
    assert!(!recording.path("map.ply.parts").exists());

    let whole = Recording::street(12);
    build_map(&whole).succeeds();
    let (collected, built) = (map_files(&recording), map_files(&whole));
    assert!(built.len() > 1);
    assert!(collected == built);
}

#[test]
fn jobs_find_the_poses_that_the_listing_found() {
    let recording = Recording::street(12);
    let call = || build_map(&recording).set("poses", "odometry");
    let jobs = call().with("--list-jobs").succeeds().stdout;
    let poses = recording.bytes("map.poses_tum.txt");
    let job = start(&recording, jobs.lines().nth(2).unwrap());
    let stderr = String::from_utf8(finish(job).stderr).unwrap();
    assert!(
        stderr.contains("poses_tum.txt are finished already"),
        "{stderr}"
    );
    assert_eq!(recording.bytes("map.poses_tum.txt"), poses);
    // Neither a job of other scans nor one without these poses changes them.
    let others = || [call().set("frame_step", "2"), build_map(&recording)];
    let jobs = others().map(|other| other.with("--job").with("0"));
    for other in jobs
        .into_iter()
        .chain(others().map(|other| other.with("--collect")))
    {
        other.fails_with(&["list them again with --list-jobs"]);
        assert_eq!(recording.bytes("map.poses_tum.txt"), poses);
    }
    // What the listing found out about the poses is in the report.
    call().succeeds();
    let report: serde_json::Value =
        serde_json::from_slice(&recording.bytes("map.report.json")).unwrap();
    assert_eq!(report["trajectory"]["scans"], 12);
}

#[test]
fn a_job_of_another_configuration_or_without_a_listing_is_refused_and_changes_nothing() {
    let recording = Recording::street(12);
    let not_listed = build_map(&recording).with("--job").with("0");
    not_listed.fails_with(&["map.ply", "list them again with --list-jobs"]);
    assert!(!recording.path("map.ply.parts").exists() && !recording.path(".fpmcl").exists());
    let jobs = listed(&recording);
    finish(start(&recording, &jobs[1]));
    let other = build_map(&recording).set("voxel_size", "0.3");
    (other.with("--job").with("0")).fails_with(&["list them again with --list-jobs"]);
    let beyond = build_map(&recording).with("--job").with("4");
    beyond.fails_with(&["there is no local map 4", "--list-jobs lists the 4"]);
    assert_eq!(listed(&recording).len(), 3);
}

#[test]
fn a_finished_job_is_not_done_again_and_a_whole_build_uses_it() {
    let recording = Recording::street(12);
    let jobs = listed(&recording);
    finish(start(&recording, &jobs[1]));
    let written = fs::metadata(recording.path("map.ply.parts/0001.ply")).unwrap();
    finish(start(&recording, &jobs[1]));
    let again = fs::metadata(recording.path("map.ply.parts/0001.ply")).unwrap();
    assert_eq!(written.modified().unwrap(), again.modified().unwrap());
    let output = build_map(&recording).succeeds();
    assert!(
        output
            .stderr
            .contains("local map 2 of 4 is finished already")
    );
}

#[test]
fn a_cloud_has_no_jobs() {
    let recording = Recording::street(1);
    let call = build_map(&recording).set("cloud_file", "velodyne/000000.bin");
    (call.with("--list-jobs")).fails_with(&["cloud_file", "one process"]);
}
