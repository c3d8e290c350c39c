//! Commands that are interrupted or killed, and what they keep.
//!
//! The time of the interruption is reproducible: a scan of the recording is a named pipe, at which
//! the program waits for the test.

#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::PathBuf;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use common::Recording;
use fpmcl::geometry::{TriangleMesh, Vec3};
use fpmcl::internals::app::LocalizationResults;
use fpmcl::internals::ply;
use fpmcl::localization::State;

/// Time limit for a program that hangs.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Four local maps of three scans.
const BUILD_MAP: &[&str] = &[
    "build-map",
    "build_map.yml",
    "--set=local_map_size=3",
    "--set=overlap_m=0.6",
];

const LOCALIZE: &[&str] = &["localize", "localization.yml", "--backend=cpu"];

const REFINE: &[&str] = &["refine", "refinement.yml", "--backend=cpu"];

/// Signals of terminals, of service managers and batch systems, and of limits of time.
const SIGNALS: [&str; 10] = [
    "-INT", "-TERM", "-HUP", "-QUIT", "-USR1", "-USR2", "-ALRM", "-XCPU", "-VTALRM", "-PROF",
];

/// A scan as a named pipe.
struct PipedScan {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl PipedScan {
    fn new(recording: &Recording, frame: usize) -> Self {
        let path = recording.path(&format!("velodyne/{frame:06}.bin"));
        let bytes = fs::read(&path).unwrap();
        fs::remove_file(&path).unwrap();
        let made = Command::new("mkfifo").arg(&path).status().unwrap();
        assert!(made.success());
        Self { path, bytes }
    }

    /// Receives the write end of the pipe when the program opens the scan.
    fn opened(&self) -> Receiver<File> {
        let (sender, receiver) = channel();
        let path = self.path.clone();
        thread::spawn(move || {
            // Opening blocks until there is a reader.
            let pipe = File::options().write(true).open(path).unwrap();
            // After a timeout, nobody receives it.
            let _ = sender.send(pipe);
        });
        receiver
    }

    /// Replaces the pipe by an ordinary file.
    fn restore(self) {
        fs::remove_file(&self.path).unwrap();
        fs::write(&self.path, &self.bytes).unwrap();
    }
}

fn start(recording: &Recording, arguments: &[&str]) -> Child {
    let program = assert_cmd::cargo::cargo_bin!("fpmcl");
    start_by(Command::new(program), recording, arguments)
}

/// Starts the program in a shell that has run a script before.
fn start_after(script: &str, recording: &Recording, arguments: &[&str]) -> Child {
    let mut shell = Command::new("sh");
    shell
        .arg("-c")
        .arg(format!("{script}; exec \"$0\" \"$@\""))
        .arg(assert_cmd::cargo::cargo_bin!("fpmcl"));
    start_by(shell, recording, arguments)
}

/// Starts the program by a command that takes its arguments.
fn start_by(mut command: Command, recording: &Recording, arguments: &[&str]) -> Child {
    command
        .args(arguments)
        .current_dir(recording.folder())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

#[track_caller]
fn send(signal: &str, child: &Child) {
    let id = child.id().to_string();
    let sent = Command::new("kill").args([signal, &id]).status().unwrap();
    assert!(sent.success());
}

/// Gives the program the scan for which it waits; returns the exit code and the rest of standard error.
fn resume(
    mut child: Child,
    mut pipe: File,
    scan: &PipedScan,
    mut reader: BufReader<ChildStderr>,
) -> (Option<i32>, String) {
    pipe.write_all(&scan.bytes).unwrap();
    drop(pipe);
    let stderr = read_until(&mut reader, None);
    (child.wait().unwrap().code(), stderr)
}

/// Standard error of the program.
fn stderr_of(child: &mut Child) -> BufReader<ChildStderr> {
    BufReader::new(child.stderr.take().unwrap())
}

/// Waits until the program opens the scan.
#[track_caller]
fn wait(opened: &Receiver<File>, child: &mut Child) -> File {
    match opened.recv_timeout(TIMEOUT) {
        Ok(pipe) => pipe,
        Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
            child.kill().unwrap();
            panic!("the program does not open the scan");
        }
    }
}

/// Reads standard error up to the line that contains `part`, or to the end.
fn read_until(stderr: &mut BufReader<ChildStderr>, part: Option<&str>) -> String {
    let mut text = String::new();
    while stderr.read_line(&mut text).unwrap() > 0 {
        if part.is_some_and(|part| text.contains(part)) {
            break;
        }
    }
    text
}

/// Runs a command and interrupts it while it waits for the scan, which it then receives; returns
/// the exit code and standard error.
fn interrupted(
    recording: &Recording,
    arguments: &[&str],
    scan: &PipedScan,
) -> (Option<i32>, String) {
    signalled("-INT", recording, arguments, scan)
}

/// As [`interrupted`], with another signal.
fn signalled(
    signal: &str,
    recording: &Recording,
    arguments: &[&str],
    scan: &PipedScan,
) -> (Option<i32>, String) {
    let opened = scan.opened();
    let mut child = start(recording, arguments);
    let pipe = wait(&opened, &mut child);
    let mut reader = stderr_of(&mut child);
    send(signal, &child);
    let begin = read_until(&mut reader, Some("press Ctrl-C again"));
    let (code, rest) = resume(child, pipe, scan, reader);
    (code, begin + &rest)
}

/// Interrupts a command that is busy and does not look up: it waits for the scan and never gets it;
/// returns standard error.
#[track_caller]
fn overdue(signal: &str, recording: &Recording, arguments: &[&str], scan: &PipedScan) -> String {
    let opened = scan.opened();
    let mut child = start(recording, arguments);
    let _pipe = wait(&opened, &mut child);
    stopped_in_time(signal, child)
}

/// Sends a signal and requires the end within two seconds, and one for a machine under load.
#[track_caller]
fn stopped_in_time(signal: &str, mut child: Child) -> String {
    let reader = stderr_of(&mut child);
    stopped_in_time_with(signal, child, reader)
}

/// The same, with the rest of standard error.
#[track_caller]
fn stopped_in_time_with(
    signal: &str,
    mut child: Child,
    mut reader: BufReader<ChildStderr>,
) -> String {
    let sent = Instant::now();
    send(signal, &child);
    while child.try_wait().unwrap().is_none() {
        if sent.elapsed() > Duration::from_secs(3) {
            child.kill().unwrap();
            panic!("the program goes on after the signal");
        }
        thread::sleep(Duration::from_millis(10));
    }
    let stderr = read_until(&mut reader, None);
    assert_eq!(child.wait().unwrap().code(), Some(130), "{stderr}");
    stderr
}

/// Names of the temporary files in a folder of the recording.
fn temporary_files(recording: &Recording, folder: &str) -> Vec<String> {
    let entries = fs::read_dir(recording.path(folder)).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.ends_with(".part")).collect()
}

/// Kills a command while it waits for the scan.
fn killed(recording: &Recording, arguments: &[&str], scan: &PipedScan) {
    let opened = scan.opened();
    let mut child = start(recording, arguments);
    let pipe = wait(&opened, &mut child);
    child.kill().unwrap();
    child.wait().unwrap();
    drop(pipe);
}

/// Whether a resumed build took over a local map, of four.
fn reuses(stderr: &str, number: usize) -> bool {
    stderr.contains(&format!("local map {number} of 4 is finished already"))
}

/// Runs a command to its end, with the scan; returns standard error.
fn resumed(recording: &Recording, arguments: &[&str], scan: &PipedScan) -> String {
    let opened = scan.opened();
    let mut child = start(recording, arguments);
    let mut pipe = wait(&opened, &mut child);
    pipe.write_all(&scan.bytes).unwrap();
    drop(pipe);
    let mut reader = BufReader::new(child.stderr.take().unwrap());
    let stderr = read_until(&mut reader, None);
    assert_eq!(child.wait().unwrap().code(), Some(0), "{stderr}");
    stderr
}

/// Map of a recording, built without interruption.
fn uninterrupted_map(recording: &Recording) -> Vec<u8> {
    let call = recording.fpmcl("build-map");
    call.with(BUILD_MAP[2]).with(BUILD_MAP[3]).succeeds();
    recording.bytes("map.ply")
}

#[test]
fn an_interrupted_build_keeps_its_local_maps_and_resumes() {
    let recording = Recording::street(12);
    // The middle scan of the third local map, which belongs to no other local map.
    let scan = PipedScan::new(&recording, 7);
    let (code, stderr) = interrupted(&recording, BUILD_MAP, &scan);
    assert_eq!(code, Some(130), "{stderr}");
    let kept = "interrupted; 2 of 4 local maps are finished and kept in map.ply.parts";
    assert!(stderr.contains(kept), "{stderr}");
    assert!(stderr.contains("run the same command again"), "{stderr}");
    assert!(!recording.path("map.ply").exists());
    assert!(
        recording
            .bytes("map.ply.parts/0001.ply")
            .starts_with(b"ply")
    );

    let stderr = resumed(&recording, BUILD_MAP, &scan);
    for number in [1, 2] {
        assert!(reuses(&stderr, number), "{stderr}");
    }
    assert!(!reuses(&stderr, 3), "{stderr}");
    assert!(recording.bytes("map.ply") == uninterrupted_map(&Recording::street(12)));
    assert!(!recording.path("map.ply.parts").exists());
}

#[test]
fn a_killed_build_resumes_and_gives_the_same_bytes() {
    let recording = Recording::street(12);
    let scan = PipedScan::new(&recording, 7);
    killed(&recording, BUILD_MAP, &scan);
    assert!(!recording.path("map.ply").exists());
    // As after a crash while a part was written.
    recording.write("map.ply.parts/unfinished.ply", "ply\nformat bin");
    recording.write("map.ply.parts/0002.ply", "ply\nformat bin");
    let stderr = resumed(&recording, BUILD_MAP, &scan);
    assert!(reuses(&stderr, 2), "{stderr}");
    assert!(recording.bytes("map.ply") == uninterrupted_map(&Recording::street(12)));
}

#[test]
fn a_replaced_scan_of_the_same_size_is_meshed_again() {
    let recording = Recording::street(12);
    let scan = PipedScan::new(&recording, 7);
    killed(&recording, BUILD_MAP, &scan);
    // Of the two finished local maps, only the first contains it.
    let shifted: Vec<[f32; 3]> = (recording.scan(0).into_iter())
        .map(|[x, y, z]| [x, y, z + 0.05])
        .collect();
    recording.write_scan(0, &shifted);
    let stderr = resumed(&recording, BUILD_MAP, &scan);
    assert!(!reuses(&stderr, 1), "{stderr}");
    assert!(reuses(&stderr, 2), "{stderr}");

    let reference = Recording::street(12);
    reference.write_scan(0, &shifted);
    let bytes = recording.bytes("map.ply");
    assert!(bytes == uninterrupted_map(&reference));
    assert!(bytes != uninterrupted_map(&Recording::street(12)));
}

#[test]
fn parts_of_another_configuration_are_not_reused() {
    let recording = Recording::street(12);
    let scan = PipedScan::new(&recording, 7);
    killed(&recording, BUILD_MAP, &scan);
    let coarser = [BUILD_MAP, &["--set=voxel_size=0.3"]].concat();
    let stderr = resumed(&recording, &coarser, &scan);
    assert!(!stderr.contains("is finished already"), "{stderr}");
}

#[test]
fn an_interrupted_build_leaves_an_existing_map_unchanged() {
    let recording = Recording::street(12);
    recording.write("map.ply", "ply of before");
    let scan = PipedScan::new(&recording, 7);
    let forced = [BUILD_MAP, &["--force"]].concat();
    let (code, stderr) = interrupted(&recording, &forced, &scan);
    assert_eq!(code, Some(130), "{stderr}");
    assert_eq!(recording.bytes("map.ply"), b"ply of before");
}

#[test]
fn an_interrupted_localization_keeps_its_finished_frames() {
    let recording = Recording::street(12);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 7);
    let (code, stderr) = interrupted(&recording, LOCALIZE, &scan);
    assert_eq!(code, Some(130), "{stderr}");
    let results = LocalizationResults::read(&recording.path("results/localization.npz")).unwrap();
    let frames = results.frames.len();
    // Scans may be read ahead.
    assert!((6..=8).contains(&frames), "{frames}");
    let kept = format!("interrupted; {frames} of 12 frames are localized and kept in results/");
    assert!(stderr.contains(&kept), "{stderr}");
    assert_eq!(results.selected, Some(12));
    for name in ["mcl_tum.txt", "mcl_kitti.txt"] {
        let rows = recording.bytes(&format!("results/{name}"));
        assert_eq!(String::from_utf8(rows).unwrap().lines().count(), frames);
    }
}

#[test]
fn a_localization_that_is_terminated_in_its_first_frame_finishes_that_frame() {
    let recording = Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 0);
    // The signal of batch systems and service managers.
    let (code, stderr) = signalled("-TERM", &recording, LOCALIZE, &scan);
    assert_eq!(code, Some(130), "{stderr}");
    let kept = "interrupted; 1 of 6 frames are localized and kept in results/localization.npz";
    assert!(stderr.contains(kept), "{stderr}");
}

#[test]
fn an_interrupted_refinement_leaves_the_result_unchanged() {
    let recording = Recording::street(8);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    let before = recording.bytes("results/localization.npz");
    let scan = PipedScan::new(&recording, 5);
    let (code, stderr) = interrupted(&recording, REFINE, &scan);
    assert_eq!(code, Some(130), "{stderr}");
    assert!(stderr.contains("is unchanged"), "{stderr}");
    assert!(recording.bytes("results/localization.npz") == before);
    scan.restore();
    recording.fpmcl("refine").succeeds();
}

#[test]
fn a_busy_build_ends_in_time_and_keeps_its_local_maps() {
    let recording = Recording::street(12);
    let scan = PipedScan::new(&recording, 7);
    let stderr = overdue("-INT", &recording, BUILD_MAP, &scan);
    let kept = "interrupted; 2 of 4 local maps are finished and kept in map.ply.parts";
    assert!(stderr.contains(kept), "{stderr}");
    assert_eq!(temporary_files(&recording, "."), [""; 0]);
    assert_eq!(temporary_files(&recording, "map.ply.parts"), [""; 0]);
    let stderr = resumed(&recording, BUILD_MAP, &scan);
    assert!(reuses(&stderr, 2), "{stderr}");
    assert!(recording.bytes("map.ply") == uninterrupted_map(&Recording::street(12)));
}

#[test]
fn a_long_ransac_ends_in_time() {
    let recording = Recording::street(12);
    let slow = ["--set=ground_method=ransac", "--set=num_iterations=100000"];
    let mut child = start(&recording, &[BUILD_MAP, &slow].concat());
    // In the first scans.
    thread::sleep(Duration::from_secs(1));
    assert!(child.try_wait().unwrap().is_none());
    stopped_in_time("-TERM", child);
}

#[test]
fn a_search_for_the_ground_of_a_mesh_ends_in_time() {
    let recording = Recording::street(2);
    // A floor, and 100 km of narrow triangles, whose rows take seconds.
    let mut mesh = TriangleMesh {
        vertices: [[-30.0, -30.0], [30.0, -30.0], [30.0, 30.0], [-30.0, 30.0]]
            .map(|[x, y]| Vec3::new(x, y, 0.0))
            .into(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..TriangleMesh::default()
    };
    for number in 0..150_000_u32 {
        let (x, first) = (0.7 * number as f32 - 5e4, mesh.vertices.len() as u32);
        let corners = [[x, -200.0], [x + 0.02, -200.0], [x, 200.0]];
        let corners = corners.map(|[x, y]| Vec3::new(x, y, 0.0));
        mesh.vertices.extend(corners);
        mesh.triangles.push([first, first + 1, first + 2]);
    }
    ply::write(&recording.path("wide.ply"), &mesh, None).unwrap();
    let mut child = start(
        &recording,
        &[LOCALIZE, &["--set=map_file=wide.ply"]].concat(),
    );
    let mut reader = stderr_of(&mut child);
    // The last message before that.
    read_until(&mut reader, Some("are the coordinates in"));
    let stderr = stopped_in_time_with("-TERM", child, reader);
    assert!(stderr.contains("no frame was finished"), "{stderr}");
}

#[test]
fn a_busy_localization_ends_in_time_and_keeps_its_finished_frames() {
    let recording = Recording::street(12);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 7);
    for signal in SIGNALS {
        let forced = [LOCALIZE, &["--force"]].concat();
        let stderr = overdue(signal, &recording, &forced, &scan);
        let kept = "interrupted; 7 of 12 frames are localized and kept in results/";
        assert!(stderr.contains(kept), "{stderr}");
        let results = LocalizationResults::read(&recording.path("results/localization.npz"));
        assert_eq!(results.unwrap().frames.len(), 7);
        assert_eq!(temporary_files(&recording, "results"), [""; 0]);
    }
}

#[test]
fn a_localization_that_is_interrupted_after_its_search_keeps_all_frames_as_the_filter_found_them() {
    let recording = Recording::street(12);
    recording.fpmcl("build-map").succeeds();
    // The first frames are searching.
    let late = [
        "--set=tracking_loss.confirming_updates=3",
        "--set=tracking_loss.sure_agreement=1",
    ];
    let results = || {
        let results = LocalizationResults::read(&recording.path("results/localization.npz"));
        results.unwrap()
    };
    let scan = PipedScan::new(&recording, 7);
    let (code, stderr) = interrupted(&recording, &[LOCALIZE, &late].concat(), &scan);
    assert_eq!(code, Some(130), "{stderr}");
    let kept = results();
    // The last of them may come too late.
    assert!((7..=8).contains(&kept.len()), "{}", kept.len());
    assert!(kept.trajectory_in_space.is_none());
    let states = kept.states.unwrap();
    let [first, last] = [states[0], states[6]].map(|state| state == State::Tracking as u8);
    assert!(!first && last, "{states:?}");
    // Without the interruption, they are filled back.
    scan.restore();
    let whole = late
        .iter()
        .fold(recording.fpmcl("localize"), |call, setting| {
            call.with(setting)
        });
    whole.with("--force").succeeds();
    assert!(results().trajectory_in_space.is_some());
}

#[test]
fn a_localization_that_finishes_after_a_signal_has_the_poses_of_its_first_frames() {
    let recording = Recording::street(4);
    recording.fpmcl("build-map").succeeds();
    let late = [
        "--set=tracking_loss.confirming_updates=2",
        "--set=tracking_loss.sure_agreement=1",
        "--set=output.plots=False",
    ];
    let scan = PipedScan::new(&recording, 3);
    // The signal comes while the last frame is localized, or shortly before or after it.
    for delay_ms in (0..60).step_by(4) {
        let opened = scan.opened();
        let mut child = start(&recording, &[LOCALIZE, &late, &["--force"]].concat());
        let mut pipe = wait(&opened, &mut child);
        pipe.write_all(&scan.bytes).unwrap();
        drop(pipe);
        thread::sleep(Duration::from_millis(delay_ms));
        let ended = child.try_wait().unwrap();
        if ended.is_none() {
            send("-TERM", &child);
        }
        let stderr = read_until(&mut stderr_of(&mut child), None);
        if child.wait().unwrap().code() != Some(130) {
            let path = recording.path("results/localization.npz");
            let results = LocalizationResults::read(&path).unwrap();
            assert!(
                results.trajectory_in_space.is_some(),
                "{delay_ms} ms: {stderr}"
            );
        }
    }
}

#[test]
fn a_drive_that_is_interrupted_keeps_its_frames_also_while_no_scan_arrives() {
    let recording = Recording::street(12);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 7);
    let live = ["live", "localization.yml", "--backend=cpu", "--force"];
    let live = [
        &live[..],
        &["--replay=velodyne", "--rate=1000", "--queue=100"],
    ]
    .concat();
    for signal in SIGNALS {
        let opened = scan.opened();
        let mut child = start(&recording, &live);
        let _pipe = wait(&opened, &mut child);
        let mut reader = stderr_of(&mut child);
        // After the first frame.
        read_until(&mut reader, Some("the scan agrees with the map"));
        let stderr = stopped_in_time_with(signal, child, reader);
        let results = LocalizationResults::read(&recording.path("results/localization.npz"));
        let frames = results.unwrap().frames.len();
        // All that were received, or those that were computed in time.
        assert!((1..=7).contains(&frames), "{frames}");
        let kept = format!("interrupted; {frames} of 12 frames are localized and kept in results/");
        assert!(stderr.contains(&kept), "{stderr}");
        assert_eq!(temporary_files(&recording, "results"), [""; 0]);
    }
}

#[test]
fn scans_that_wait_when_a_drive_is_interrupted_count_as_dropped() {
    let recording = Recording::street(40);
    recording.fpmcl("build-map").succeeds();
    let live = [
        "live",
        "localization.yml",
        "--backend=cpu",
        "--replay=velodyne",
    ];
    let fast = ["--rate=1000", "--queue=1000", "--set=output.plots=False"];
    let mut child = start(&recording, &[&live[..], &fast].concat());
    let mut reader = stderr_of(&mut child);
    read_until(&mut reader, Some("the scan agrees with the map"));
    let stderr = stopped_in_time_with("-TERM", child, reader);
    // On a machine under load the process ends before it writes the report.
    if recording.path("results/report.json").exists() {
        let live = &common::json(&recording.path("results/report.json"))["live"];
        let count = |value: &serde_json::Value| value.as_u64().unwrap();
        let localized: u64 = live["states"]
            .as_object()
            .unwrap()
            .values()
            .map(count)
            .sum();
        let lost = count(&live["dropped"]) + count(&live["rejected"]);
        assert_eq!(count(&live["received"]), localized + lost, "{stderr}");
        assert!(
            stderr.contains(&format!("interrupted; {localized} of 40 frames")),
            "{stderr}"
        );
    }
}

#[test]
fn a_signal_ends_a_command_whose_messages_nobody_reads() {
    let recording = Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 3);
    let opened = scan.opened();
    // As many bytes as fit into the pipe.
    let full = "head -c 65536 /dev/zero >&2";
    let mut child = start_after(full, &recording, &[LOCALIZE, &["--quiet"]].concat());
    let _pipe = wait(&opened, &mut child);
    stopped_in_time("-TERM", child);
    let results = LocalizationResults::read(&recording.path("results/localization.npz"));
    assert_eq!(results.unwrap().frames.len(), 3);
}

#[test]
fn a_file_beyond_the_limit_of_the_shell_is_an_error_of_one_line() {
    let recording = Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    let mut child = start_after("ulimit -f 8", &recording, LOCALIZE);
    let stderr = read_until(&mut stderr_of(&mut child), None);
    assert_eq!(child.wait().unwrap().code(), Some(1), "{stderr}");
    assert!(stderr.contains("File too large"), "{stderr}");
    assert_eq!(stderr.matches("error: ").count(), 1, "{stderr}");
    assert_eq!(temporary_files(&recording, "results"), [""; 0]);
}

#[test]
fn a_link_that_replaces_the_folder_of_a_simulation_is_not_followed() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let mut child = Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"))
        .args(["simulate", "--set=output_folder=out", "--set=n_scans=300"])
        .current_dir(folder.path())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    while !path("out/drive_1/velodyne/000000.bin").exists() {
        assert!(child.try_wait().unwrap().is_none(), "it has ended");
        thread::sleep(Duration::from_millis(5));
    }
    send("-STOP", &child);
    fs::create_dir_all(path("others/drive_1/velodyne")).unwrap();
    fs::create_dir_all(path("others/drive_1/labels")).unwrap();
    fs::write(path("others/drive_1/poses.txt"), "theirs").unwrap();
    fs::rename(path("out"), path("moved")).unwrap();
    std::os::unix::fs::symlink("others", path("out")).unwrap();
    send("-CONT", &child);
    let stderr = read_until(&mut stderr_of(&mut child), None);
    assert_eq!(child.wait().unwrap().code(), Some(1), "{stderr}");
    assert!(stderr.contains("was replaced"), "{stderr}");
    assert_eq!(
        fs::read(path("others/drive_1/poses.txt")).unwrap(),
        b"theirs"
    );
    let scans = fs::read_dir(path("others/drive_1/velodyne")).unwrap();
    assert_eq!(scans.count(), 0);
}

#[test]
fn a_signal_that_was_ignored_at_the_start_stays_ignored() {
    let recording = Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 3);
    let opened = scan.opened();
    // As `nohup` does.
    let mut child = start_after("trap '' HUP", &recording, LOCALIZE);
    let pipe = wait(&opened, &mut child);
    send("-HUP", &child);
    let reader = stderr_of(&mut child);
    let (code, stderr) = resume(child, pipe, &scan, reader);
    assert_eq!(code, Some(0), "{stderr}");
    let results = LocalizationResults::read(&recording.path("results/localization.npz"));
    assert_eq!(results.unwrap().frames.len(), 6);
}

#[test]
fn a_localization_that_is_busy_in_its_first_frame_ends_in_time() {
    let recording = Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 0);
    let stderr = overdue("-INT", &recording, LOCALIZE, &scan);
    assert!(stderr.contains("no frame was finished"), "{stderr}");
    assert!(!recording.path("results/localization.npz").exists());
}

#[test]
fn a_busy_refinement_ends_in_time_and_leaves_the_result_unchanged() {
    let recording = Recording::street(8);
    recording.fpmcl("build-map").succeeds();
    recording.fpmcl("localize").succeeds();
    let before = recording.bytes("results/localization.npz");
    let scan = PipedScan::new(&recording, 5);
    let stderr = overdue("-INT", &recording, REFINE, &scan);
    assert!(stderr.contains("is unchanged"), "{stderr}");
    assert!(recording.bytes("results/localization.npz") == before);
}

#[test]
fn a_busy_odometry_ends_in_time_and_writes_nothing() {
    let recording = Recording::street(12);
    let scan = PipedScan::new(&recording, 11);
    for (signal, arguments) in [
        ("-INT", ["odometry", "velodyne", "--output=out"]),
        (
            "-TERM",
            ["build-map", "build_map.yml", "--set=poses=odometry"],
        ),
    ] {
        overdue(signal, &recording, &arguments, &scan);
        for file in ["out/poses_tum.txt", "map.poses_tum.txt", "map.ply"] {
            assert!(!recording.path(file).exists(), "{file}");
        }
    }
    scan.restore();
    let call = common::fpmcl("odometry").in_folder(recording.folder());
    call.with("velodyne").with("--output=out").succeeds();
}

#[test]
fn a_busy_ground_segmentation_ends_in_time() {
    let recording = Recording::street(3);
    let scan = PipedScan::new(&recording, 1);
    let arguments = ["ground", "velodyne", "--set=compare=False"];
    let stderr = overdue("-INT", &recording, &arguments, &scan);
    assert!(stderr.contains("1 of 3 scans are in"), "{stderr}");
}

#[test]
fn an_incomplete_result_is_reported_by_refine_and_evaluate() {
    let recording = Recording::street(12);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 7);
    assert_eq!(interrupted(&recording, LOCALIZE, &scan).0, Some(130));
    scan.restore();
    let refined = recording.fpmcl("refine").succeeds().stderr;
    let evaluated = common::fpmcl("evaluate")
        .in_folder(recording.folder())
        .with(common::config_file("evaluation.yml"))
        .succeeds()
        .stderr;
    let results = LocalizationResults::read(&recording.path("results/localization.npz")).unwrap();
    let shortfall = format!("only {} of 12 frames were localized", results.len());
    for text in [refined, evaluated] {
        assert!(text.contains(&shortfall), "{text}");
    }
    let report = common::json(&recording.path("results/report.json"));
    assert_eq!(report["about"]["frames"], shortfall.as_str());
}

#[test]
fn a_localization_that_is_killed_before_its_pictures_is_completed_without_force() {
    let recording = Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    let localize = [LOCALIZE, &["--set=plot_loc_results=True"]].concat();
    // The middle scan, which is read again for the pictures.
    let scan = PipedScan::new(&recording, 3);
    let opened = scan.opened();
    let mut child = start(&recording, &localize);
    wait(&opened, &mut child).write_all(&scan.bytes).unwrap();
    let written = recording.path("results/frames.csv");
    for _ in 0..2400 {
        if written.exists() {
            break;
        }
        thread::sleep(Duration::from_millis(50));
    }
    let opened = scan.opened();
    let pipe = wait(&opened, &mut child);
    child.kill().unwrap();
    child.wait().unwrap();
    drop(pipe);
    let picture = recording.path("results/plots/range_images.png");
    assert!(recording.path("results/localization.npz").exists());
    assert!(!picture.exists());

    scan.restore();
    let again = || {
        let call = recording.fpmcl("localize");
        call.set("plot_loc_results", "True")
    };
    again().succeeds();
    assert!(picture.exists());
    again().fails_with(&["results/localization.npz exists", "--force"]);
}

#[test]
fn a_build_that_is_killed_after_its_map_is_completed_without_force() {
    let recording = Recording::street(12);
    let build = [BUILD_MAP, &["--set=truth_mesh=truth.ply"]].concat();
    // The true surface is read after the map is written.
    let path = recording.path("truth.ply");
    let bytes = uninterrupted_map(&Recording::street(12));
    let made = Command::new("mkfifo").arg(&path).status().unwrap();
    assert!(made.success());
    let truth = PipedScan { path, bytes };
    killed(&recording, &build, &truth);
    assert!(recording.path("map.ply").exists());
    assert!(recording.path("map.ply.parts").exists());
    assert!(!recording.path("map.report.json").exists());

    truth.restore();
    let call = || {
        build
            .iter()
            .skip(2)
            .fold(recording.fpmcl("build-map"), |call, argument| {
                call.with(argument)
            })
    };
    let stderr = call().succeeds().stderr;
    assert!(reuses(&stderr, 4), "{stderr}");
    assert!(recording.path("map.report.json").exists());
    assert!(!recording.path("map.ply.parts").exists());
    call().fails_with(&["map.ply exists", "--force"]);
}

#[test]
fn a_second_build_of_the_same_map_is_refused() {
    let recording = Recording::street(12);
    let scan = PipedScan::new(&recording, 7);
    let opened = scan.opened();
    let mut first = start(&recording, BUILD_MAP);
    let pipe = wait(&opened, &mut first);
    for force in ["force=False", "force=True"] {
        let second = recording.fpmcl("build-map").with("--set").with(force);
        second.fails_with(&["map.ply is being built by another build-map", "mesh_file"]);
    }
    first.kill().unwrap();
    first.wait().unwrap();
    drop(pipe);
    // The lock of a killed build is released, and its parts are there still.
    let stderr = resumed(&recording, BUILD_MAP, &scan);
    assert!(reuses(&stderr, 2), "{stderr}");
    assert!(recording.bytes("map.ply") == uninterrupted_map(&Recording::street(12)));
}

#[test]
fn a_truncated_part_is_made_again() {
    let recording = Recording::street(12);
    let scan = PipedScan::new(&recording, 7);
    killed(&recording, BUILD_MAP, &scan);
    let part = recording.bytes("map.ply.parts/0000.ply");
    fs::write(
        recording.path("map.ply.parts/0000.ply"),
        &part[..part.len() - 1],
    )
    .unwrap();
    let stderr = resumed(&recording, BUILD_MAP, &scan);
    assert!(!reuses(&stderr, 1), "{stderr}");
    assert!(reuses(&stderr, 2), "{stderr}");
    assert!(recording.bytes("map.ply") == uninterrupted_map(&Recording::street(12)));
}

#[test]
fn an_output_folder_that_vanishes_is_an_error() {
    let recording = Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 3);
    let opened = scan.opened();
    let mut child = start(&recording, LOCALIZE);
    let pipe = wait(&opened, &mut child);
    fs::rename(recording.path("results"), recording.path("moved")).unwrap();
    let reader = stderr_of(&mut child);
    let (code, stderr) = resume(child, pipe, &scan, reader);
    assert_eq!(code, Some(1), "{stderr}");
    assert!(stderr.contains("error: cannot write results/"), "{stderr}");
    assert!(!recording.path("results").exists());
}

#[test]
fn a_link_that_replaces_the_folder_of_a_run_is_not_followed() {
    let recording = Recording::street(8);
    recording.fpmcl("build-map").succeeds();
    let scan = PipedScan::new(&recording, 7);
    let opened = scan.opened();
    let mut child = start(&recording, LOCALIZE);
    let mut pipe = wait(&opened, &mut child);
    fs::create_dir(recording.path("others")).unwrap();
    fs::write(recording.path("others/frames.csv"), "theirs").unwrap();
    fs::rename(recording.path("results"), recording.path("moved")).unwrap();
    std::os::unix::fs::symlink("others", recording.path("results")).unwrap();
    pipe.write_all(&scan.bytes).unwrap();
    drop(pipe);
    let mut reader = BufReader::new(child.stderr.take().unwrap());
    let stderr = read_until(&mut reader, None);
    assert_eq!(child.wait().unwrap().code(), Some(1), "{stderr}");
    assert!(stderr.contains("results was replaced"), "{stderr}");
    assert_eq!(recording.bytes("others/frames.csv"), b"theirs");
    assert_eq!(fs::read_dir(recording.path("others")).unwrap().count(), 1);
}
