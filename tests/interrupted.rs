//! Runs that are stopped in the middle, by Ctrl-C or by death, and what is left of them.
//!
//! The middle is a certain one: a scan of the recording is a named pipe, at which the program
//! waits until the test has done with it what it wants to.

#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::PathBuf;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

use common::Recording;
use fpmcl::app::results::LocalizationResults;

/// Longer than this nothing here takes; a limit only so that a hanging program ends.
const PATIENCE: Duration = Duration::from_secs(120);

/// Four local maps of three scans.
const BUILD_MAP: &[&str] = &[
    "build-map",
    "build_map.yml",
    "--set=local_map_size=3",
    "--set=overlap_m=0.6",
];

const LOCALIZE: &[&str] = &["localize", "localization.yml", "--backend=cpu"];

const REFINE: &[&str] = &["refine", "refinement.yml", "--backend=cpu"];

/// A scan that the program has to wait for.
struct HeldScan {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl HeldScan {
    fn of(recording: &Recording, frame: usize) -> Self {
        let path = recording.path(&format!("velodyne/{frame:06}.bin"));
        let bytes = fs::read(&path).unwrap();
        fs::remove_file(&path).unwrap();
        let made = Command::new("mkfifo").arg(&path).status().unwrap();
        assert!(made.success());
        Self { path, bytes }
    }

    /// Tells when the program waits for the scan, and hands over the end to write it to.
    fn asked_for(&self) -> Receiver<File> {
        let (sender, receiver) = channel();
        let path = self.path.clone();
        thread::spawn(move || {
            // Opening waits for the reader.
            let pipe = File::options().write(true).open(path).unwrap();
            // The test may have given up.
            let _ = sender.send(pipe);
        });
        receiver
    }

    /// Makes it an ordinary file again.
    fn release(self) {
        fs::remove_file(&self.path).unwrap();
        fs::write(&self.path, &self.bytes).unwrap();
    }
}

fn start(recording: &Recording, arguments: &[&str]) -> Child {
    Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"))
        .args(arguments)
        .current_dir(recording.folder())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// Waits until the program asks for the scan.
#[track_caller]
fn wait(asked: &Receiver<File>, child: &mut Child) -> File {
    match asked.recv_timeout(PATIENCE) {
        Ok(pipe) => pipe,
        Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
            child.kill().unwrap();
            panic!("the program never asks for the scan");
        }
    }
}

/// Reads what the program says until a line has `part`, or to the end.
fn read_until(stderr: &mut BufReader<ChildStderr>, part: Option<&str>) -> String {
    let mut said = String::new();
    while stderr.read_line(&mut said).unwrap() > 0 {
        let is_there = part.is_some_and(|part| said.contains(part));
        if is_there {
            break;
        }
    }
    said
}

/// Runs a command, presses Ctrl-C while it waits for the scan, then gives it the scan; the exit
/// code and all that was said.
fn interrupted(
    recording: &Recording,
    arguments: &[&str],
    scan: &HeldScan,
) -> (Option<i32>, String) {
    signalled("-INT", recording, arguments, scan)
}

/// As [`interrupted`], by another signal.
fn signalled(
    signal: &str,
    recording: &Recording,
    arguments: &[&str],
    scan: &HeldScan,
) -> (Option<i32>, String) {
    let asked = scan.asked_for();
    let mut child = start(recording, arguments);
    let mut pipe = wait(&asked, &mut child);
    let mut stderr = BufReader::new(child.stderr.take().unwrap());
    let pressed = Command::new("kill")
        .args([signal, &child.id().to_string()])
        .status()
        .unwrap();
    assert!(pressed.success());
    let mut said = read_until(&mut stderr, Some("press Ctrl-C again"));
    pipe.write_all(&scan.bytes).unwrap();
    drop(pipe);
    said += &read_until(&mut stderr, None);
    (child.wait().unwrap().code(), said)
}

/// Kills a command while it waits for the scan.
fn killed(recording: &Recording, arguments: &[&str], scan: &HeldScan) {
    let asked = scan.asked_for();
    let mut child = start(recording, arguments);
    let pipe = wait(&asked, &mut child);
    child.kill().unwrap();
    child.wait().unwrap();
    drop(pipe);
}

/// Runs a command to its end, giving it the scan when it asks; all that was said.
fn resumed(recording: &Recording, arguments: &[&str], scan: &HeldScan) -> String {
    let asked = scan.asked_for();
    let mut child = start(recording, arguments);
    let mut pipe = wait(&asked, &mut child);
    pipe.write_all(&scan.bytes).unwrap();
    drop(pipe);
    let mut stderr = BufReader::new(child.stderr.take().unwrap());
    let said = read_until(&mut stderr, None);
    assert_eq!(child.wait().unwrap().code(), Some(0), "{said}");
    said
}

/// The map that a build gives that nobody stops.
fn whole_map() -> Vec<u8> {
    let recording = Recording::street(12);
    let mut child = start(&recording, BUILD_MAP);
    let said = read_until(&mut BufReader::new(child.stderr.take().unwrap()), None);
    assert_eq!(child.wait().unwrap().code(), Some(0), "{said}");
    recording.bytes("map.ply")
}

#[test]
fn an_interrupted_build_keeps_its_local_maps_and_goes_on_from_there() {
    let recording = Recording::street(12);
    // The scan in the middle of the third local map, in which no other takes part.
    let scan = HeldScan::of(&recording, 7);
    let (code, said) = interrupted(&recording, BUILD_MAP, &scan);
    assert_eq!(code, Some(130), "{said}");
    let kept = "interrupted; 2 of 4 local maps are finished and kept in map.ply.parts";
    assert!(said.contains(kept), "{said}");
    assert!(said.contains("run the same command again"), "{said}");
    assert!(!recording.path("map.ply").exists());
    assert!(
        recording
            .bytes("map.ply.parts/0001.ply")
            .starts_with(b"ply")
    );

    let said = resumed(&recording, BUILD_MAP, &scan);
    for there in ["local map 1 of 4 is there", "local map 2 of 4 is there"] {
        assert!(said.contains(there), "{said}");
    }
    assert!(!said.contains("local map 3 of 4 is there"), "{said}");
    assert!(recording.bytes("map.ply") == whole_map());
    assert!(!recording.path("map.ply.parts").exists());
}

#[test]
fn a_killed_build_goes_on_and_ends_with_the_same_bytes() {
    let recording = Recording::street(12);
    let scan = HeldScan::of(&recording, 7);
    killed(&recording, BUILD_MAP, &scan);
    assert!(!recording.path("map.ply").exists());
    // As if death had come while a part was being written.
    recording.write("map.ply.parts/unfinished.ply", "ply\nformat bin");
    recording.write("map.ply.parts/0002.ply", "ply\nformat bin");
    let said = resumed(&recording, BUILD_MAP, &scan);
    assert!(said.contains("local map 2 of 4 is there"), "{said}");
    assert!(recording.bytes("map.ply") == whole_map());
}

#[test]
fn a_scan_that_is_replaced_by_one_of_the_same_size_is_meshed_again() {
    let recording = Recording::street(12);
    let scan = HeldScan::of(&recording, 7);
    killed(&recording, BUILD_MAP, &scan);
    // Of the two local maps that are finished only the first has seen it.
    let shifted: Vec<[f32; 3]> = (recording.scan(0).into_iter())
        .map(|[x, y, z]| [x, y, z + 0.05])
        .collect();
    recording.write_scan(0, &shifted);
    let said = resumed(&recording, BUILD_MAP, &scan);
    assert!(!said.contains("local map 1 of 4 is there"), "{said}");
    assert!(said.contains("local map 2 of 4 is there"), "{said}");

    let undisturbed = Recording::street(12);
    undisturbed.write_scan(0, &shifted);
    undisturbed
        .fpmcl("build-map")
        .with(BUILD_MAP[2])
        .with(BUILD_MAP[3])
        .succeeds();
    let bytes = recording.bytes("map.ply");
    assert!(bytes == undisturbed.bytes("map.ply"));
    assert!(bytes != whole_map());
}

#[test]
fn parts_of_another_configuration_are_not_taken() {
    let recording = Recording::street(12);
    let scan = HeldScan::of(&recording, 7);
    killed(&recording, BUILD_MAP, &scan);
    let coarser = [BUILD_MAP, &["--set=voxel_size=0.3"]].concat();
    let said = resumed(&recording, &coarser, &scan);
    assert!(!said.contains("is there"), "{said}");
}

#[test]
fn a_build_that_is_stopped_leaves_an_old_map_as_it_was() {
    let recording = Recording::street(12);
    recording.write("map.ply", "mine");
    let scan = HeldScan::of(&recording, 7);
    let forced = [BUILD_MAP, &["--force"]].concat();
    let (code, said) = interrupted(&recording, &forced, &scan);
    assert_eq!(code, Some(130), "{said}");
    assert_eq!(recording.bytes("map.ply"), b"mine");
}

#[test]
fn an_interrupted_localization_keeps_the_frames_it_has() {
    let recording = Recording::street(12);
    recording.fpmcl("build-map").succeeds();
    let scan = HeldScan::of(&recording, 7);
    let (code, said) = interrupted(&recording, LOCALIZE, &scan);
    assert_eq!(code, Some(130), "{said}");
    let results = LocalizationResults::read(&recording.path("results/localization.npz")).unwrap();
    let frames = results.frames.len();
    // The scan may have been asked for ahead of its turn.
    assert!((6..=8).contains(&frames), "{frames}");
    let kept = format!("interrupted; {frames} of 12 frames are localized and kept in results/");
    assert!(said.contains(&kept), "{said}");
    for name in ["mcl_tum.txt", "mcl_kitti.txt"] {
        let rows = recording.bytes(&format!("results/{name}"));
        assert_eq!(String::from_utf8(rows).unwrap().lines().count(), frames);
    }
}

#[test]
fn a_localization_that_is_ended_in_its_first_frame_finishes_that_frame() {
    let recording = Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    let scan = HeldScan::of(&recording, 0);
    // What a batch system or a service manager sends.
    let (code, said) = signalled("-TERM", &recording, LOCALIZE, &scan);
    assert_eq!(code, Some(130), "{said}");
    let kept = "interrupted; 1 of 6 frames are localized and kept in results/localization.npz";
    assert!(said.contains(kept), "{said}");
}

#[test]
fn an_interrupted_refinement_leaves_the_result_as_it_was() {
    let recording = Recording::street(8);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    let before = recording.bytes("results/localization.npz");
    let scan = HeldScan::of(&recording, 5);
    let (code, said) = interrupted(&recording, REFINE, &scan);
    assert_eq!(code, Some(130), "{said}");
    assert!(said.contains("is as it was"), "{said}");
    assert!(recording.bytes("results/localization.npz") == before);
    scan.release();
    recording.fpmcl("refine").succeeds();
}
