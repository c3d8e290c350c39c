//! Names of files and folders: what the system accepts is read as it is, and shown without being obeyed.

#![cfg(unix)]

use std::ffi::{OsStr, OsString};
use std::fs;
use std::os::unix::ffi::{OsStrExt as _, OsStringExt as _};
use std::path::Path;

use crate::common::{Fpmcl, Output, Recording, fpmcl};

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

fn localize(recording: &Recording, name: &[u8]) -> Fpmcl {
    let call = fpmcl("localize").in_folder(recording.folder());
    in_map(call.with(OsStr::from_bytes(name)), name, ".out")
}

/// A call of `localize` or `live` with the map, the true poses and the output of a name.
fn in_map(call: Fpmcl, name: &[u8], output: &str) -> Fpmcl {
    let named = |end: &str| OsString::from_vec([name, end.as_bytes()].concat());
    let result = Path::new(&named(output)).join("localization.npz");
    let call = call.with("--map").with(named(".ply"));
    let call = call.with("--truth").with(named(".txt"));
    let call = call.with("--calib").with("calib.txt");
    let call = call.with("--output").with(result);
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
    localize(&recording, NAME.as_bytes()).exits_with(3);
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
    let output = localize(&recording, NAME.as_bytes()).exits_with(3);
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
    let output = localize(&recording, NAME.as_bytes()).exits_with(1);
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

#[test]
fn names_that_are_no_text_are_read_and_written_as_their_bytes() {
    let recording = Recording::street(4);
    recording
        .fpmcl("build-map")
        .set("mesh_file", "map.ply")
        .succeeds();
    // Latin-1, and the character that is none.
    for mark in [b"\xe4".as_slice(), "\u{fffe}".as_bytes()] {
        let named = |end: &str| OsString::from_vec([mark, end.as_bytes()].concat());
        let rename = |old: &str, new: &OsStr| {
            fs::rename(recording.path(old), recording.folder().join(new)).unwrap();
        };
        rename("map.ply", &named(".ply"));
        rename("velodyne", &named(""));
        rename("poses.txt", &named(".txt"));
        let output = named(".out");
        let result = Path::new(&output).join("localization.npz");
        localize(&recording, mark).exits_with(3);
        let folder = recording.folder().join(&output);
        let frames = |folder: &Path| fs::read_to_string(folder.join("frames.csv")).unwrap();
        let estimates = |folder: &Path| fs::read(folder.join("mcl_tum.txt")).unwrap();
        // The configuration reads back.
        let again = fpmcl("localize").in_folder(recording.folder());
        let again = again.with(Path::new(&output).join("effective_localization.yml"));
        again
            .with("--output")
            .with("again/localization.npz")
            .with("--backend=cpu")
            .exits_with(3);
        assert_eq!(estimates(&recording.path("again")), estimates(&folder));
        assert_eq!(frames(&folder).lines().count(), 5);
        fs::remove_dir_all(recording.path("again")).unwrap();
        let call = |command: &str| fpmcl(command).in_folder(recording.folder());
        call("refine")
            .with(&result)
            .with("--backend=cpu")
            .exits_with(3);
        let evaluate = call("evaluate")
            .with(&result)
            .with("--truth")
            .with(named(".txt"));
        evaluate.with("--calib").with("calib.txt").succeeds();
        let odometry = call("odometry")
            .with(named(""))
            .with("--output")
            .with(named(".odometry"));
        odometry.succeeds();
        call("info").with(named("")).succeeds();
        call("info").with(named(".ply")).succeeds();
        let live = call("live").with("--replay").with(named(""));
        let live = live.with("--rate=1000").with("--queue=100");
        in_map(live, mark, ".live").may_be_refused().succeeds();
        let export = call("export").with(&result);
        export.with("--mcap").with(named(".mcap")).succeeds();
        let export = call("export").with(named(".ply"));
        export.with("--glb").with(named(".glb")).succeeds();
        let ground = call("ground").with(named("")).set("plot_step", "0");
        ground.set("output_folder", "ground").succeeds();
        let simulation = recording.folder().join(named(".yml"));
        let keys = "output_folder: street\nn_scans: 1\nscanner: {azimuth_steps: 100}\n";
        fs::write(simulation, keys).unwrap();
        call("simulate").with(named(".yml")).succeeds();
        for written in ["ground", "street"] {
            fs::remove_dir_all(recording.path(written)).unwrap();
        }
        let map = call("build-map")
            .with(named(""))
            .with("--output")
            .with(named("2.ply"));
        map.with("--poses")
            .with(named(".txt"))
            .with("--calib")
            .with("calib.txt")
            .set("depth", "7")
            .succeeds();
        // All that was written has names of its own.
        let mut names: Vec<OsString> = (fs::read_dir(recording.folder()).unwrap())
            .map(|entry| entry.unwrap().file_name())
            .collect();
        names.sort();
        assert!(names.contains(&named("2.report.json")), "{names:?}");
        assert!(
            names
                .iter()
                .all(|name| !name.as_bytes().starts_with("\u{fffd}".as_bytes())),
            "{names:?}"
        );
        let back = |old: &OsStr, new: &str| {
            fs::rename(recording.folder().join(old), recording.path(new)).unwrap();
        };
        back(&named(".ply"), "map.ply");
        back(&named(""), "velodyne");
        back(&named(".txt"), "poses.txt");
    }
}
