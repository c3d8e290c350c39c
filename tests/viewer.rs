//! `live --foxglove`: a viewer that connects, written in Python, and who can connect.

#![cfg(all(target_os = "linux", feature = "viewer"))]
#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs;
use std::io::{BufRead as _, BufReader, Lines, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::time::Duration;

use common::Recording;
use fpmcl::internals::app::LocalizationResults;
use serde_json::{Value, json};

const TOPICS: [&str; 7] = [
    "/estimate",
    "/map",
    "/numbers",
    "/particles",
    "/scan",
    "/state",
    "/tf",
];

/// Messages that wait for a viewer, as `src/app/report/export/viewer.rs` has it.
const MOST_WAITING: usize = 64;

/// A viewer that receives only while it is asked to.
struct StallingViewer {
    socket: BufReader<TcpStream>,
    /// Topics by their channels.
    topics: Vec<(u64, String)>,
}

impl StallingViewer {
    fn connect(address: &str) -> Self {
        let mut socket = TcpStream::connect(address).unwrap();
        // Of a message that does not come.
        let limit = Duration::from_secs(120);
        socket.set_read_timeout(Some(limit)).unwrap();
        let request = [
            "GET / HTTP/1.1",
            &format!("Host: {address}"),
            "Upgrade: websocket",
            "Connection: Upgrade",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Protocol: foxglove.sdk.v1",
            "\r\n",
        ];
        socket.write_all(request.join("\r\n").as_bytes()).unwrap();
        let mut socket = BufReader::new(socket);
        let mut line = String::new();
        while line != "\r\n" {
            line.clear();
            socket.read_line(&mut line).unwrap();
        }
        let topics = Vec::new();
        Self { socket, topics }
    }

    /// The next message: whether it is text, and its bytes.
    fn receive(&mut self) -> (bool, Vec<u8>) {
        let mut read = |bytes: usize| {
            let mut message = vec![0; bytes];
            self.socket.read_exact(&mut message).unwrap();
            message
        };
        let head = read(2);
        let length = match head[1] {
            126 => read(2),
            127 => read(8),
            short => vec![short],
        };
        let length = length
            .iter()
            .fold(0, |all, &it| 256 * all + usize::from(it));
        (head[0] == 0x81, read(length))
    }

    /// Subscribes to all topics, which the first announcement names, whenever the viewer connects: subscriptions to a channel that
    /// is announced later might be refused.
    fn subscribe(&mut self) {
        while self.topics.is_empty() {
            let (true, text) = self.receive() else {
                panic!("data without a subscription");
            };
            let text: Value = serde_json::from_slice(&text).unwrap();
            for channel in text["channels"].as_array().into_iter().flatten() {
                let topic = channel["topic"].as_str().unwrap().to_owned();
                self.topics.push((channel["id"].as_u64().unwrap(), topic));
            }
        }
        let mut topics: Vec<&str> = self.topics.iter().map(|it| it.1.as_str()).collect();
        topics.sort_unstable();
        assert_eq!(topics, TOPICS);
        let subscriptions = self
            .topics
            .iter()
            .map(|(id, _)| json!({"id": id, "channelId": id}));
        let subscriptions: Vec<Value> = subscriptions.collect();
        let text = json!({"op": "subscribe", "subscriptions": subscriptions}).to_string();
        let length = u16::try_from(text.len()).unwrap().to_be_bytes();
        let mask = [0; 4];
        let message = [&[0x81, 0x80 | 126], &length[..], &mask, text.as_bytes()].concat();
        self.socket.get_mut().write_all(&message).unwrap();
    }

    /// Receives until a message of a topic about which `is_last`; returns the topics of all, their times and contents.
    fn receive_until(
        &mut self,
        is_last: impl Fn(&str, &[u8]) -> bool,
    ) -> Vec<(String, u64, Vec<u8>)> {
        let mut received = Vec::new();
        loop {
            let (false, message) = self.receive() else {
                continue;
            };
            let id = u32::from_le_bytes(message[1..5].try_into().unwrap());
            let time_ns = u64::from_le_bytes(message[5..13].try_into().unwrap());
            let found = self.topics.iter().find(|it| it.0 == u64::from(id));
            let topic = found.unwrap().1.clone();
            let is_end = is_last(&topic, &message[13..]);
            received.push((topic, time_ns, message[13..].to_vec()));
            if is_end {
                return received;
            }
        }
    }
}

/// The frame of a message of `/numbers`.
fn frame(numbers: &[u8]) -> u64 {
    let numbers: Value = serde_json::from_slice(numbers).unwrap();
    numbers["frame"].as_u64().unwrap()
}

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
fn a_viewer_that_connects_and_does_not_read_costs_the_filter_nothing_and_has_a_bounded_queue() {
    const FRAMES: usize = 120;
    let recording = Recording::street(FRAMES);
    // The street is longer than that of the other tests.
    recording.fpmcl("build-map").set("depth", "8").succeeds();
    let arguments = ["live", "localization.yml", "--backend=cpu", "--json"];
    let arguments = [
        &arguments[..],
        &["--replay=velodyne", "--rate=1000", "--queue=1000"],
    ]
    .concat();
    let outcome = |stdout: &str| {
        let report: Value = serde_json::from_str(stdout).unwrap();
        let counts = ["received", "dropped", "rejected", "states"];
        let result = recording.path("results/localization.npz");
        let results = LocalizationResults {
            runtimes_s: None,
            ..LocalizationResults::read(&result).unwrap()
        };
        (results, counts.map(|key| report["live"][key].clone()))
    };
    let without = outcome(&common::run(recording.folder(), &arguments));

    // The drive waits for the viewer after the first frame, and for the test before the last.
    let pipes = [1, FRAMES - 1].map(|it| recording.path(&format!("velodyne/{it:06}.bin")));
    let scans = pipes.each_ref().map(|it| common::replace_by_pipe(it));
    let mut program = Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"))
        .args(&arguments)
        .args(["--force", "--foxglove=127.0.0.1:0", "--record=run.mcap"])
        .current_dir(recording.folder())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stderr = BufReader::new(program.stderr.take().unwrap()).lines();
    let mut lines = stderr.by_ref().map(Result::unwrap);
    let address = lines.find_map(|line| Some(line.split_once("ws://")?.1.to_owned()));
    let address = address.unwrap();
    let messages = std::thread::spawn(|| stderr.map(Result::unwrap).collect::<String>());
    // One that says nothing at all keeps no other from being served.
    let _silent = TcpStream::connect(&address).unwrap();
    let mut viewer = StallingViewer::connect(&address);
    viewer.subscribe();
    viewer.receive_until(|topic, _| topic == "/map");
    fs::write(&pipes[0], &scans[0]).unwrap();
    common::wait_for_scans(&recording.path("run.unfinished.mcap"), FRAMES - 1);

    // What the system holds, then a gap, then the queue: the newest messages.
    let newest = FRAMES as u64 - 2;
    let received = viewer.receive_until(|topic, it| topic == "/numbers" && frame(it) == newest);
    let numbers = received.iter().filter(|it| it.0 == "/numbers");
    let numbers: Vec<_> = numbers.map(|it| (frame(&it.2), it.1)).collect();
    let frames: Vec<u64> = numbers.iter().map(|it| it.0).collect();
    let mut gaps = numbers.windows(2).filter(|it| it[1].0 != it[0].0 + 1);
    let (_, begin_ns) = gaps.next_back().unwrap_or_else(|| panic!("{frames:?}"))[1];
    // Changes of the state while no scan arrives have later times.
    let is_queued = |it: &&(String, u64, Vec<u8>)| it.0 != "/state" && it.1 >= begin_ns;
    let queued = received.iter().filter(is_queued).count();
    assert!(queued <= MOST_WAITING, "{queued} {frames:?}");

    fs::write(&pipes[1], &scans[1]).unwrap();
    let output = program.wait_with_output().unwrap();
    let messages = messages.join().unwrap();
    assert!(output.status.success(), "{messages}");
    assert!(!messages.contains("left out"), "{messages}");
    let with = outcome(&String::from_utf8(output.stdout).unwrap());
    assert_eq!(with.1, without.1);
    assert!(with.0 == without.0, "the poses are others");
    let log = common::messages_in(&recording.path("run.mcap"));
    assert_eq!(log["/scan"], FRAMES);
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
