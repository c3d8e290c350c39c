//! `live --foxglove`: a viewer that connects, written in Python, and who can connect.

#![cfg(all(target_os = "linux", feature = "viewer"))]
#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs;
use std::io::{BufRead as _, BufReader, Lines};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Stdio};

use common::Recording;
use serde_json::Value;

const TOPICS: [&str; 7] = [
    "/estimate",
    "/map",
    "/numbers",
    "/particles",
    "/scan",
    "/state",
    "/tf",
];

/// A drive that takes two seconds per scan, so that it goes on for as long as a test looks at it.
struct SlowDrive {
    program: Child,
    stderr: Lines<BufReader<ChildStderr>>,
}

impl SlowDrive {
    fn begin(recording: &Recording, arguments: &[&str]) -> Self {
        let mut program = Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"))
            .args(["live", "localization.yml", "--backend=cpu"])
            .args(["--replay=velodyne", "--rate=0.05"])
            .args(arguments)
            .current_dir(recording.folder())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let stderr = BufReader::new(program.stderr.take().unwrap()).lines();
        Self { program, stderr }
    }

    /// Waits for a message of the program; returns what follows `part` in it.
    fn message_after(&mut self, part: &str) -> String {
        let mut lines = self.stderr.by_ref().map(Result::unwrap);
        let found = lines.find_map(|line| Some(line.split_once(part)?.1.trim().to_owned()));
        found.unwrap_or_else(|| panic!("the program ends without {part:?}"))
    }

    /// Local ports at which the program listens or receives.
    fn open_ports(&self) -> Vec<String> {
        let folder = format!("/proc/{}/fd", self.program.id());
        let files = fs::read_dir(folder).unwrap();
        let inodes: Vec<String> = files
            .filter_map(|file| {
                let target = fs::read_link(file.unwrap().path()).ok()?;
                let inode = target.to_str()?.strip_prefix("socket:[")?;
                Some(inode.strip_suffix(']')?.to_owned())
            })
            .collect();
        let tables = ["tcp", "tcp6", "udp", "udp6"].map(|table| {
            let path = format!("/proc/{}/net/{table}", self.program.id());
            fs::read_to_string(path).unwrap_or_default()
        });
        let rows = tables.iter().flat_map(|table| table.lines().skip(1));
        rows.map(|row| row.split_whitespace().collect::<Vec<_>>())
            .filter(|row| {
                row.get(9)
                    .is_some_and(|it| inodes.iter().any(|inode| inode == it))
            })
            .map(|row| row[1].to_owned())
            .collect()
    }

    /// Ends the drive as Ctrl-C does.
    fn end(mut self) {
        let id = self.program.id().to_string();
        assert!(
            Command::new("kill")
                .args(["-INT", &id])
                .status()
                .unwrap()
                .success()
        );
        self.stderr.for_each(|line| drop(line.unwrap()));
        assert_eq!(self.program.wait().unwrap().code(), Some(130));
    }
}

fn street() -> Recording {
    let recording = Recording::street(40);
    recording.fpmcl("build-map").succeeds();
    recording
}

#[test]
fn a_viewer_that_connects_during_the_drive_receives_and_decodes_every_channel() {
    let python = common::python_with("websockets, google.protobuf", "viewer");
    let Some(python) = python else {
        common::skips::skipped("FPMCL_PYTHON names no interpreter with websockets and protobuf");
        return;
    };
    let recording = street();
    let mut drive = SlowDrive::begin(&recording, &["--foxglove=127.0.0.1:0"]);
    let address = drive.message_after("ws://");
    drive.message_after("tracking: ");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/viewer/client.py");
    let mut viewer = Command::new(python);
    let output = viewer
        .arg(script)
        .arg(&address)
        .args(TOPICS)
        .output()
        .unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    drive.end();

    let received: Value = serde_json::from_slice(&output.stdout).unwrap();
    let number = |topic: &str, key: &str| received[topic][key].as_f64().unwrap();
    assert!(number("/scan", "points") > 1000.0 && received["/scan"]["frame"] == "map");
    assert!(received["/map"]["models"][0].as_u64() > Some(10_000));
    assert_eq!(received["/tf"]["parent"], "map");
    assert!(number("/particles", "poses") > 1.0);
    assert_eq!(
        received["/state"]["message"],
        "tracking: the scan agrees with the map"
    );
    assert_eq!(received["/numbers"]["state"], "tracking");
    // Half a metre per frame.
    let frame = number("/numbers", "frame");
    assert!(
        (number("/estimate", "x") - 0.5 * frame).abs() < 0.8,
        "{received}"
    );
    let covariance = received["/estimate"]["covariance"].as_array().unwrap();
    assert!(covariance.len() == 36 && covariance[0].as_f64() > Some(0.0));
}

#[test]
fn nothing_listens_without_the_flag_and_with_it_at_this_machine_alone_unless_an_address_is_given() {
    let recording = street();
    let ports = |arguments: &[&str]| {
        let mut drive = SlowDrive::begin(&recording, arguments);
        drive.message_after("tracking: ");
        let ports = drive.open_ports();
        drive.end();
        ports
    };
    assert_eq!(ports(&["--record=run.mcap"]), [""; 0]);
    // 127.0.0.1:8765, or an error if another program has the port.
    if TcpListener::bind("127.0.0.1:8765").is_ok() {
        assert_eq!(ports(&["--force", "--foxglove"]), ["0100007F:223D"]);
    }
}

#[test]
fn an_address_that_is_taken_is_an_error_that_names_it() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let recording = Recording::street(1);
    let call = common::fpmcl("live").in_folder(recording.folder());
    let call = call.with("localization.yml").with("--replay=velodyne");
    let message = format!("cannot listen at {address}; give --foxglove another address");
    call.with(format!("--foxglove={address}"))
        .fails_with(&[&message]);
}
