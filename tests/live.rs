//! `live`: scans of recordings that arrive at their own pace.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

#[cfg(feature = "bags")]
mod bag_writers;
mod common;

use std::collections::BTreeMap;
use std::fs;

use common::{Fpmcl, Output, Recording};
use foxglove::Decode as _;
use foxglove::messages::Odometry;
use fpmcl::internals::app::LocalizationResults;
use serde_json::{Value, json};

const RESULT: &str = "results/localization.npz";

/// A street with its map.
fn street(frames: usize) -> Recording {
    let recording = Recording::street(frames);
    recording.fpmcl("build-map").succeeds();
    recording
}

/// A replay, as fast as scans can be read.
fn live(recording: &Recording) -> Fpmcl {
    let call = common::fpmcl("live").in_folder(recording.folder());
    let call = call.with("localization.yml").with("--backend=cpu");
    call.with("--replay=velodyne").with("--rate=1000")
}

/// A replay in which every scan may wait.
fn patient(recording: &Recording) -> Fpmcl {
    live(recording).with("--queue=1000")
}

fn report(output: &Output) -> Value {
    serde_json::from_str(&output.stdout).unwrap()
}

/// The results of a recording, without times of computation.
fn results(recording: &Recording) -> LocalizationResults {
    LocalizationResults {
        runtimes_s: None,
        ..LocalizationResults::read(&recording.path(RESULT)).unwrap()
    }
}

#[test]
fn where_no_scan_is_dropped_the_results_are_those_of_localize() {
    let recording = street(12);
    for odometry in ["ground_truth", "scans", "none"] {
        let calls = [recording.fpmcl("localize"), patient(&recording)];
        let [localized, live] = calls.map(|call| {
            let call = call
                .set("odometry", odometry)
                .with("--force")
                .with("--json");
            let report = report(&call.succeeds());
            let names = ["mcl_tum.txt", "effective_localization.yml"];
            let files = names.map(|name| recording.bytes(&format!("results/{name}")));
            (results(&recording), files, report)
        });
        assert!(live.0 == localized.0 && live.1 == localized.1, "{odometry}");
        assert_eq!(live.2["summary"], localized.2["summary"]);
        let counts = ["received", "dropped", "rejected"].map(|key| &live.2["live"][key]);
        assert_eq!(counts, [12, 0, 0].map(Value::from).each_ref());
        assert_eq!(localized.2["live"], Value::Null);
    }
    assert!(recording.path("results/report.html").exists());
}

#[test]
fn scans_that_come_too_fast_are_dropped_and_counted_and_their_motion_is_bridged() {
    let recording = street(40);
    // Odometry without the noise of a demonstration.
    let call = live(&recording).set("odometry", "file");
    let call = call.set("odometry_file", "poses.txt").with("--json");
    let report = report(&call.succeeds());
    let [received, dropped, rejected] =
        ["received", "dropped", "rejected"].map(|key| report["live"][key].as_u64().unwrap());
    let results = results(&recording);
    assert_eq!((received, rejected), (40, 0));
    assert!(
        dropped > 0 && dropped + results.frames.len() as u64 == received,
        "{report}"
    );
    // The last one is always understood.
    assert_eq!(results.frames.last(), Some(&39));
    let worst_m = report["mcl"]["metrics"]["position_m"]["max"]
        .as_f64()
        .unwrap();
    assert!(worst_m < 0.2, "{report}");
    let [p50, p99, max] =
        ["p50_ms", "p99_ms", "max_ms"].map(|key| report["live"]["latency"][key].as_f64().unwrap());
    assert!(0.0 < p50 && p50 <= p99 && p99 <= max, "{report}");
    let states = report["live"]["states"].as_object().unwrap();
    let counted: u64 = states.values().map(|it| it.as_u64().unwrap()).sum();
    assert_eq!(counted, results.frames.len() as u64);
}

#[test]
fn a_damaged_scan_is_counted_and_the_others_are_localized() {
    let recording = street(12);
    fs::write(recording.path("velodyne/000005.bin"), [0; 17]).unwrap();
    let output = patient(&recording).with("--json").succeeds();
    assert_eq!(report(&output)["live"]["rejected"], 1);
    assert!(output.stderr.contains("000005.bin"), "{}", output.stderr);
    assert!(
        results(&recording)
            .frames
            .iter()
            .copied()
            .eq((0..12).filter(|&it| it != 5))
    );
}

#[test]
fn scans_of_another_sensor_are_reported_and_those_that_fit_are_localized() {
    let recording = street(12);
    for frame in 0..4 {
        // Points half way to the zenith, where the sensor of the configuration sees nothing.
        let points = recording.scan(frame);
        let raised = points.iter().map(|[x, y, _]| [*x, *y, x.hypot(*y)]);
        recording.write_scan(frame, &raised.collect::<Vec<_>>());
    }
    let call = patient(&recording).set("pose_tracking", "False");
    let output = call.with("--start=2,0,0").with("--json").succeeds();
    let report = report(&output);
    assert_eq!(report["live"]["rejected"], 4, "{report}");
    let states = &report["live"]["states"];
    assert!(
        states["tracking"].as_u64() >= Some(7) && states["lost"].is_null(),
        "{report}"
    );
    let expected = "outside the field of view of the sensor";
    let stderr = &output.stderr;
    assert_eq!(stderr.matches(expected).count(), 1, "{stderr}");
}

#[test]
fn a_run_begins_where_the_last_one_ended_if_the_scans_confirm_it() {
    let recording = street(12);
    let first = patient(&recording).with("--start=last").succeeds();
    let missing = "results/last_pose.json does not exist: the start is searched";
    assert!(first.stderr.contains(missing), "{}", first.stderr);
    let before = results(&recording).estimates_in_space.unwrap();
    let last = common::json(&recording.path("results/last_pose.json"));
    let at = |pose: &Value| pose["map_from_lidar"][0].as_f64().unwrap();
    assert!((at(&last) - before[11].translation.x).abs() < 1e-12);

    // The car did not move since then.
    fs::create_dir(recording.path("parked")).unwrap();
    for copy in 0..4 {
        let parked = recording.path(&format!("parked/{copy:06}.bin"));
        fs::copy(recording.path("velodyne/000011.bin"), parked).unwrap();
    }
    let again = || {
        let call = common::fpmcl("live").in_folder(recording.folder());
        let call = call.with("localization.yml").with("--backend=cpu");
        let call = call.set("pose_file", "null").set("pose_tracking", "False");
        let call = call
            .set("odometry", "scans")
            .with("--queue=100")
            .with("--rate=1000");
        call.with("--replay=parked")
            .with("--start=last")
            .with("--force")
            .with("--json")
    };
    let state = |output: &Output| report(output)["live"]["states"].clone();
    assert_eq!(state(&again().succeeds()), json!({"tracking": 4}));
    let found = results(&recording).estimates_in_space.unwrap();
    assert!((found[3].translation.vector - before[11].translation.vector).norm() < 0.05);

    // A pose that the scans do not confirm: across the street.
    let mut wrong = last.clone();
    wrong["map_from_lidar"] = json!([
        at(&last),
        0.0,
        0.0,
        0.0,
        0.0,
        0.5_f64.sqrt(),
        0.5_f64.sqrt()
    ]);
    recording.write("results/last_pose.json", &wrong.to_string());
    let output = again().exits_with(3);
    assert_eq!(state(&output).get("tracking"), None, "{}", output.stderr);
}

#[test]
fn a_last_pose_of_another_map_or_of_no_place_on_earth_is_an_error() {
    let recording = street(3);
    patient(&recording).succeeds();
    let last = common::json(&recording.path("results/last_pose.json"));
    let fails = |key: &str, value: Value, parts: &[&str]| {
        let mut changed = last.clone();
        changed[key] = value;
        recording.write("results/last_pose.json", &changed.to_string());
        let call = patient(&recording).with("--start=last").with("--force");
        call.fails_with(parts);
    };
    fails(
        "map_bytes",
        json!(7),
        &["results/last_pose.json is a pose in the map map.ply"],
    );
    fails(
        "map_from_lidar",
        json!([1e300, 0, 0, 0, 0, 0, 1]),
        &["no pose on Earth"],
    );
    fails(
        "map_from_lidar",
        json!("here"),
        &["is no last pose of fpmcl; remove it"],
    );
}

/// Contents of the messages of each topic.
fn messages(recording: &Recording, log: &str) -> BTreeMap<String, Vec<Vec<u8>>> {
    let log = recording.bytes(log);
    let mut topics = BTreeMap::<String, Vec<_>>::new();
    for message in mcap::MessageStream::new(&log).unwrap() {
        let message = message.unwrap();
        let topic = topics.entry(message.channel.topic.clone()).or_default();
        topic.push(message.data.into_owned());
    }
    topics
}

/// The texts of messages, among bytes of their other fields.
fn texts(messages: &[Vec<u8>]) -> Vec<String> {
    let texts = messages.iter().map(|it| String::from_utf8_lossy(it));
    texts.map(|text| text.into_owned()).collect()
}

#[test]
fn a_log_that_is_written_on_the_way_has_the_messages_that_export_writes_of_the_result() {
    let recording = street(12);
    let call = patient(&recording).with("--record=run.mcap");
    let report = report(&call.with("--json").succeeds());
    assert_eq!(report["live"]["states"], json!({"tracking": 12}));
    let call = common::fpmcl("export").in_folder(recording.folder());
    call.with(RESULT).with("--mcap=exported.mcap").succeeds();
    let [live, exported] = ["run.mcap", "exported.mcap"].map(|log| messages(&recording, log));
    for topic in ["/map", "/particles"] {
        assert!(live[topic] == exported[topic], "{topic}");
    }
    // Quaternions are normalized when a result is read.
    let without_rotation = |message: &Vec<u8>| {
        let mut estimate = Odometry::decode(message.as_slice()).unwrap();
        estimate.pose.as_mut().unwrap().orientation = None;
        estimate
    };
    for (live, exported) in live["/estimate"].iter().zip(&exported["/estimate"]) {
        assert_eq!(without_rotation(live), without_rotation(exported));
    }
    assert_eq!(live["/tf"].len(), 12);
    assert_eq!(live["/scan"].len(), 12);
    let [starting, tracking] = texts(&live["/state"]).try_into().unwrap();
    assert!(
        starting.contains("starting: no scan has arrived"),
        "{starting}"
    );
    assert!(
        tracking.contains("tracking: the scan agrees with the map"),
        "{tracking}"
    );
    for (frame, numbers) in texts(&live["/numbers"]).iter().enumerate() {
        let numbers: Value = serde_json::from_str(numbers).unwrap();
        assert_eq!(numbers["frame"], frame);
        assert_eq!(numbers["reason"], "the scan agrees with the map");
        assert!(numbers["latency_ms"].as_f64() > Some(0.0) && numbers["dropped"] == 0);
    }
    let again = patient(&recording).with("--record=run.mcap");
    let again = again.set("result_path", "others/localization.npz");
    again.fails_with(&["run.mcap exists; add --force"]);
}

#[cfg(unix)]
#[test]
fn a_log_of_a_process_that_is_killed_has_the_frames_until_then_and_is_not_replaced_unasked() {
    use std::process::{Command, Stdio};
    const UNFINISHED: &str = "run.unfinished.mcap";

    let recording = street(12);
    // The program waits for the scan of a pipe.
    let scan = recording.path("velodyne/000008.bin");
    let bytes = common::replace_by_pipe(&scan);
    let mut program = Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"))
        .args(["live", "localization.yml", "--backend=cpu"])
        .args(["--replay=velodyne", "--rate=1000", "--queue=1000"])
        .arg("--record=run.mcap")
        .current_dir(recording.folder())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let log = recording.path(UNFINISHED);
    common::wait_for_scans(&log, 8);
    // SIGKILL.
    program.kill().unwrap();
    program.wait().unwrap();
    let left = common::messages_in(&log);
    for topic in ["/estimate", "/numbers", "/particles", "/scan", "/tf"] {
        assert_eq!(left[topic], 8, "{left:?}");
    }
    assert!(left["/map"] == 1 && left["/state"] >= 2, "{left:?}");
    assert!(!recording.path("run.mcap").exists());

    fs::remove_file(&scan).unwrap();
    fs::write(&scan, bytes).unwrap();
    let again = || patient(&recording).with("--record=run.mcap");
    let part = "run.unfinished.mcap exists, the log of an interrupted run; move it";
    again().fails_with(&[part]);
    assert_eq!(common::messages_in(&log), left);
    again().with("--force").succeeds();
    assert!(!log.exists());
    assert_eq!(messages(&recording, "run.mcap")["/scan"].len(), 12);
    // One of somebody else is kept.
    fs::remove_file(recording.path(".fpmcl")).unwrap();
    fs::write(&log, "of the user").unwrap();
    again()
        .with("--force")
        .fails_with(&["was not written by fpmcl"]);
    assert_eq!(fs::read(&log).unwrap(), b"of the user");
}

#[test]
fn a_log_is_no_input_and_leaves_nothing_where_the_drive_does_not_begin() {
    let recording = street(3);
    std::os::unix::fs::symlink("map.ply", recording.path("map.mcap")).unwrap();
    let call = patient(&recording)
        .with("--record=map.mcap")
        .with("--force");
    call.fails_with(&["map.ply would be replaced, but it is an input (map_file)"]);
    for output in ["report.json", ".fpmcl", "localization.npz"] {
        let call = patient(&recording).with(format!("--record={output}"));
        call.with("--force")
            .fails_with(&["a name that ends in .mcap"]);
    }
    fs::write(recording.path("map.ply"), "ply").unwrap();
    let call = patient(&recording).with("--record=run.mcap");
    call.fails_with(&["map.ply"]);
    for log in ["run.mcap", "run.unfinished.mcap"] {
        assert!(!recording.path(log).exists(), "{log}");
    }
}

#[test]
fn a_sensor_that_stalls_is_reported_and_the_run_goes_on_when_it_sends_again() {
    let recording = street(12);
    let time_s = |frame: usize| 0.1 * frame as f64 + if frame < 6 { 0.0 } else { 3.0 };
    let times: String = (0..12).map(|it| format!("{}\n", time_s(it))).collect();
    recording.write("times.txt", &times);
    let call = common::fpmcl("live").in_folder(recording.folder());
    let call = call.with("localization.yml").with("--backend=cpu");
    let call = call.with("--replay=velodyne").with("--queue=100");
    let output = call.with("--record=run.mcap").with("--json").succeeds();
    assert_eq!(report(&output)["live"]["states"], json!({"tracking": 12}));
    let states = texts(&messages(&recording, "run.mcap")["/state"]);
    let mut left = states.iter();
    for expected in [
        "tracking: the scan agrees with the map",
        "lost: no scan arrived for too long",
        "tracking: the scan agrees with the map",
    ] {
        assert!(left.any(|it| it.contains(expected)), "{states:?}");
    }
}

#[cfg(feature = "bags")]
#[test]
fn after_a_jump_of_the_clock_the_car_is_found_around_its_last_pose() {
    use bag_writers::{Cloud, Kind, Recorded, mcap, point_cloud2};
    const START_NS: u64 = 1_700_000_000_000_000_000;

    let recording = street(12);
    let recorded = |jump_ns: i64| -> Vec<Recorded> {
        let message = |frame: usize| {
            let points = recording.scan(frame);
            let numbers = points.iter().flatten();
            let cloud = Cloud {
                fields: [("x", 0), ("y", 4), ("z", 8)]
                    .map(|(name, at)| (name, at, 7))
                    .into(),
                width: points.len() as u32,
                height: 1,
                point_step: 12,
                row_step: 12 * points.len() as u32,
                data: numbers.flat_map(|it| it.to_le_bytes()).collect(),
                ..Cloud::default()
            };
            let time_ns = START_NS + 100_000_000 * frame as u64;
            let stamp_ns = time_ns.wrapping_add_signed(if frame < 6 { 0 } else { jump_ns });
            Recorded {
                topic: "/points",
                message_type: "sensor_msgs/msg/PointCloud2",
                time_ns,
                data: point_cloud2(Kind::CdrLittle, stamp_ns, "lidar", &cloud),
            }
        };
        (0..12).map(message).collect()
    };
    for (name, jump_s) in [("back", -3600), ("ahead", 3600), ("never", 0)] {
        let bag = mcap(
            ::mcap::WriteOptions::new().compression(None),
            "cdr",
            &recorded(jump_s * 1_000_000_000),
        );
        fs::write(recording.path(&format!("{name}.mcap")), bag).unwrap();
        let call = common::fpmcl("live").in_folder(recording.folder());
        let call = call.with("localization.yml").with("--backend=cpu");
        let call = call.set("pose_file", "null").set("pose_tracking", "False");
        let call = call.set("odometry", "scans").with("--start=0,0,0");
        let call = call
            .with(format!("--replay={name}.mcap"))
            .with("--rate=1000");
        let call = call.with("--queue=100").with("--force").with("--json");
        let log = format!("{name}_log.mcap");
        let output = call.with(format!("--record={log}")).succeeds();
        let report = report(&output);
        let has_jumped = jump_s != 0;
        let warning = "the clock of the scans jumped to";
        assert_eq!(
            output.stderr.contains(warning),
            has_jumped,
            "{}",
            output.stderr
        );
        let states = texts(&messages(&recording, &log)["/state"]);
        let is_jump = |it: &String| it.contains("searching: the clock of the scans was set");
        assert_eq!(states.iter().any(is_jump), has_jumped, "{states:?}");
        assert_eq!(report["live"]["rejected"], 0, "{name} {report}");
        let found = results(&recording).estimates_in_space.unwrap();
        let error_m = (found[11].translation.x - 5.5).hypot(found[11].translation.y);
        assert!(found.len() == 12 && error_m < 0.1, "{name} {error_m}");
    }
}

#[test]
fn what_live_cannot_do_is_an_error_before_any_work() {
    let recording = Recording::street(1);
    let live = || common::fpmcl("live").in_folder(recording.folder());
    live().rejects_usage_with(&["--replay <RECORDING>"]);
    let message = ["drive/ is no configuration (.yml); give a recording by --replay drive/"];
    live()
        .with("drive/")
        .with("--replay=velodyne")
        .fails_with(&message);
    let message = ["refine is True, but", "set refine to False"];
    patient(&recording)
        .set("refine", "True")
        .fails_with(&message);
    for (flag, part) in [
        ("--rate=0", "0.001 to 1000"),
        ("--queue=0", "1..=1000"),
        ("--foxglove=here", "such as 127.0.0.1:8765"),
    ] {
        live()
            .with("--replay=velodyne")
            .with(flag)
            .rejects_usage_with(&[part]);
    }
}
