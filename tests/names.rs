//! Names of files and folders: what the system accepts is read as it is, and shown without being obeyed.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::ffi::OsStr;
use std::fs;
use std::path::Path;

use common::{Fpmcl, Output, Recording, fpmcl};

/// A title of the terminal, a line of a log, and characters that YAML does not hold unescaped.
const NAME: &str = "a\u{1b}]0;owned\u{7}\n INFO forged: 'x' \"y\"\u{7f}\u{9b}2J\u{202e}";
const SHOWN: &str = r"a\u001b]0;owned\u0007\n INFO forged";

/// A street, of which map, scans and poses have such names.
fn named() -> Recording {
    let recording = Recording::street(4);
    let build = recording
        .fpmcl("build-map")
        .set("mesh_file", "map.ply")
        .succeeds();
    assert_plain(&build);
    let rename = |old: &str, new: &str| {
        fs::rename(recording.path(old), recording.path(new)).unwrap();
    };
    rename("map.ply", &format!("{NAME}.ply"));
    rename("velodyne", NAME);
    rename("poses.txt", &format!("{NAME}.txt"));
    recording
}

fn localize(recording: &Recording) -> Fpmcl {
    let call = fpmcl("localize").in_folder(recording.folder()).with(NAME);
    let call = call.with("--map").with(format!("{NAME}.ply"));
    let call = call.with("--truth").with(format!("{NAME}.txt"));
    let call = call.with("--calib").with("calib.txt");
    let call = call
        .with("--output")
        .with(format!("{NAME}.out/localization.npz"));
    [
        ("pose_tracking", "True"),
        ("odometry", "ground_truth"),
        ("numParticles", "50"),
        ("num_reduced", "20"),
        ("has_rows", "True"),
        ("motion_compensation", "null"),
        ("plots", "False"),
        (
            "range_image",
            "{height: 32, width: 360, fov_up: 3, fov_down: -25, max_range: 50, min_range: 1}",
        ),
    ]
    .into_iter()
    .fold(call.with("--backend=cpu"), |call, (key, value)| {
        call.set(key, value)
    })
}

fn is_hidden(c: char) -> bool {
    (c.is_control() && !"\n\t".contains(c)) || c == '\u{202e}'
}

#[track_caller]
fn assert_plain_text(text: &str) {
    assert!(!text.contains(is_hidden), "{text:?}");
    assert!(
        !text
            .lines()
            .any(|line| line.trim_start().starts_with("INFO forged")),
        "{text}"
    );
}

#[track_caller]
fn assert_plain(output: &Output) {
    assert_plain_text(&output.stdout);
    assert_plain_text(&output.stderr);
}

#[test]
fn any_name_in_unicode_is_localized_and_its_configuration_reads_back() {
    let recording = named();
    // Four scans are too few to find an unknown start.
    localize(&recording).exits_with(3);
    let folder = format!("{NAME}.out");
    let result = format!("{folder}/localization.npz");
    let first = recording.bytes(&format!("{folder}/frames.csv"));
    let again = fpmcl("localize").in_folder(recording.folder());
    again
        .with(format!("{folder}/effective_localization.yml"))
        .with("--output")
        .with("again/localization.npz")
        .with("--backend=cpu")
        .exits_with(3);
    let columns = |bytes: &[u8]| String::from_utf8_lossy(bytes).lines().count();
    assert_eq!(
        columns(&recording.bytes("again/frames.csv")),
        columns(&first)
    );
    let refine = fpmcl("refine").in_folder(recording.folder());
    refine.with(&result).with("--backend=cpu").exits_with(3);
}

#[test]
fn names_are_shown_in_output_errors_logs_and_reports_without_being_obeyed() {
    let recording = named();
    let output = localize(&recording).exits_with(3);
    assert_plain(&output);
    assert!(output.stderr.contains(SHOWN), "{}", output.stderr);
    let path = recording.path(&format!("{NAME}.out/report.md"));
    let report = fs::read_to_string(path).unwrap();
    assert_plain_text(&report);
    assert!(report.contains(SHOWN), "{report}");
    let path = recording.path(&format!("{NAME}.out/report.html"));
    let page = fs::read_to_string(path).unwrap();
    // Lines mean nothing in a page.
    assert!(!page.contains(is_hidden), "{page:?}");
    assert!(page.contains(r"a\u001b]0;owned"), "{page}");
    // The second run is refused, and names what exists.
    let output = localize(&recording).exits_with(1);
    assert_plain(&output);
    assert!(output.stderr.contains(SHOWN), "{}", output.stderr);
    let info = |argument: &str| fpmcl("info").in_folder(recording.folder()).with(argument);
    let missing = info(&format!("{NAME}/none")).exits_with(1);
    assert_plain(&missing);
    assert!(missing.stderr.contains(SHOWN), "{}", missing.stderr);
    let folder = format!("{NAME}.drive");
    fs::create_dir(recording.path(&folder)).unwrap();
    let moved = |old: &str, new: &str| {
        fs::rename(
            recording.path(old),
            recording.path(&format!("{folder}/{new}")),
        )
        .unwrap();
    };
    moved(NAME, "velodyne");
    moved(&format!("{NAME}.txt"), "poses.txt");
    for option in ["--all", "--json"] {
        let described = info(&folder).with(option).succeeds();
        assert_plain(&described);
        let shown = described.stdout.replace(r"\\n", r"\n");
        assert!(shown.contains(SHOWN), "{}", described.stdout);
    }
    let usage = info("drive").with(format!("--{NAME}")).exits_with(2);
    assert!(!usage.stderr.contains('\u{1b}'), "{:?}", usage.stderr);
}

#[cfg(unix)]
#[test]
fn a_name_that_is_no_text_is_refused_by_every_command_in_the_same_words() {
    use std::os::unix::ffi::OsStrExt as _;

    let recording = Recording::street(2);
    let names = [OsStr::from_bytes(b"drive\xff"), OsStr::new("drive\u{fffe}")];
    for name in names {
        let folder = recording.folder().join(name);
        fs::create_dir(&folder).unwrap();
        let copy = |file: &str| fs::copy(recording.path(file), folder.join(Path::new(file)));
        fs::create_dir(folder.join("velodyne")).unwrap();
        copy("velodyne/000000.bin").unwrap();
        copy("velodyne/000001.bin").unwrap();
        let mut messages = Vec::new();
        for command in ["info", "localize", "build-map", "odometry", "ground"] {
            let call = fpmcl(command).in_folder(recording.folder()).with(name);
            let parts = ["the argument \"drive\\", "UTF-8", "rename", "link"];
            messages.push(call.fails_with(&parts).stderr);
        }
        messages.dedup();
        assert_eq!(messages.len(), 1, "{messages:?}");
        // The remedy.
        let link = recording.path("drive");
        let _ = fs::remove_file(&link);
        std::os::unix::fs::symlink(&folder, link).unwrap();
        let info = fpmcl("info").in_folder(recording.folder()).with("drive");
        info.succeeds();
    }
}
