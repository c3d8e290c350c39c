//! `live --ros2`: clouds that a robot sends by Cyclone DDS, and what it receives. In a network namespace of their own, where the
//! loopback is the only interface. Without Cyclone DDS or such a namespace they say that they did not run, unless
//! `FPMCL_REQUIRE_ROS2=1`.

#![cfg(all(target_os = "linux", feature = "ros2"))]
#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs;
use std::path::Path;
use std::process::Command;

use common::Recording;
use fpmcl::geometry::StampedPose;
use fpmcl::internals::app::LocalizationResults;
use fpmcl::recording::{PoseTrack, write_tum};
use serde_json::{Value, json};

const RESULT: &str = "results/localization.npz";

/// Time of the first frame of the robot in `tests/ros2/robot.py` [s].
const FIRST_S: f64 = 1.0;

/// Script of a shell in a network namespace: it brings up the loopback and runs its arguments.
const IN_NAMESPACE: &str = "ip link set lo up && ip link set lo multicast on && ip route add 224.0.0.0/4 dev lo && exec \"$@\"";

/// Whether a scenario that cannot run is a failure.
fn is_required() -> bool {
    std::env::var_os("FPMCL_REQUIRE_ROS2").is_some_and(|value| value == "1")
}

/// Reports that a scenario does not run; where they are required it fails.
#[track_caller]
fn skipped(reason: &str) {
    assert!(!is_required(), "FPMCL_REQUIRE_ROS2=1, but {reason}");
    common::skips::skipped(reason);
}

/// A street with its map, whose frames have the times of the robot.
fn street() -> Recording {
    let recording = Recording::street(12);
    recording.fpmcl("build-map").succeeds();
    let times = (0..12).map(|frame| format!("{:.1}\n", FIRST_S + 0.1 * f64::from(frame)));
    recording.write("times.txt", &times.collect::<String>());
    recording
}

fn in_namespace() -> Command {
    let mut command = Command::new("unshare");
    command.args(["--map-root-user", "--net", "sh", "-c", IN_NAMESPACE, "sh"]);
    command
}

/// Runs a scenario of the robot on a street, with its configuration; `None`, with a message, where what it needs is missing.
fn robot(recording: &Recording, scenario: &str, arguments: &[&str]) -> Option<Value> {
    let common = [
        "localization.yml",
        "--start=0,0,0",
        "--queue=1000",
        "--set=pose_file=null",
        "--set=pose_tracking=null",
        "--set=odometry=auto",
        "--output=live/localization.npz",
    ];
    play(
        recording.folder(),
        "velodyne",
        scenario,
        &[&common, arguments].concat(),
    )
}

/// Runs a scenario of the robot with the scans of a folder, and the program with arguments.
fn play(folder: &Path, scans: &str, scenario: &str, arguments: &[&str]) -> Option<Value> {
    let Some(python) = common::python_with("cyclonedds", "ros2") else {
        skipped("FPMCL_PYTHON names no interpreter with cyclonedds");
        return None;
    };
    let probe = in_namespace().args(["true"]).output();
    if !probe.is_ok_and(|it| it.status.success()) {
        skipped("this machine makes no network namespace (unshare, ip)");
        return None;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/ros2/robot.py");
    let mut command = in_namespace();
    command.arg(python).arg(script);
    command.args(["play", scans, scenario, "--"]);
    command.arg(assert_cmd::cargo::cargo_bin!("fpmcl"));
    command.args(["live", "--ros2=/points", "--backend=cpu", "--json"]);
    for variable in [
        "ROS_DOMAIN_ID",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_LOCALHOST_ONLY",
        "CYCLONEDDS_URI",
    ] {
        command.env_remove(variable);
    }
    let output = command
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

/// Poses x, y, z of a topic by their frames.
fn positions(messages: &Value) -> Vec<(usize, [f64; 3])> {
    let messages = messages.as_array().map(Vec::as_slice).unwrap_or_default();
    let frame = |it: &Value| (it["stamp_ns"].as_f64().unwrap() * 1e-8).round() as usize - 10;
    let position = |it: &Value| [0, 1, 2].map(|axis| it["pose"][axis].as_f64().unwrap());
    messages
        .iter()
        .map(|it| (frame(it), position(it)))
        .collect()
}

/// Poses and transforms by their frames.
fn published(received: &Value) -> Vec<(usize, [f64; 3])> {
    let transforms = received["/tf"].as_array().unwrap().iter();
    let poses = positions(&received["/fpmcl/pose"]).into_iter();
    poses.chain(transforms.flat_map(positions)).collect()
}

fn distance_m(a: [f64; 3], b: [f64; 3]) -> f64 {
    let squares = a.iter().zip(b).map(|(a, b)| (a - b).powi(2));
    squares.sum::<f64>().sqrt()
}

/// Whether the messages of the states contain some words in order.
fn states_include(received: &Value, expected: &[&str]) -> bool {
    let states = received["/diagnostics"].as_array().unwrap();
    let mut left = states.iter().map(|it| it["message"].as_str().unwrap());
    expected
        .iter()
        .all(|words| left.any(|it| it.contains(words)))
}

#[test]
fn a_robot_receives_the_poses_that_localize_finds_on_the_same_scans() {
    let recording = street();
    let Some(outcome) = robot(&recording, "drive", &[]) else {
        return;
    };
    let call = recording.fpmcl("localize").set("odometry", "scans");
    let call = call.set("pose_file", "null").set("pose_tracking", "null");
    call.with("--start=0,0,0").succeeds();
    let localized = LocalizationResults::read(&recording.path(RESULT)).unwrap();
    let localized = localized.estimates_in_space.unwrap();
    let (received, report) = (&outcome["received"], &outcome["report"]);
    assert_eq!(report["live"]["received"], 12, "{report}");
    assert_eq!(report["live"]["dropped"], 0, "{report}");
    for topic in ["/fpmcl/pose", "/fpmcl/odometry"] {
        let poses = positions(&received[topic]);
        // A message may be overtaken by the discovery of its reader only, and the first scan waits for that.
        assert_eq!(poses.len(), 12, "{topic}");
        for (frame, position) in poses {
            let expected = localized[frame].translation.vector.into();
            assert!(
                distance_m(position, expected) < 1e-3,
                "{topic} {frame} {position:?}"
            );
        }
    }
    for transform in received["/tf"]
        .as_array()
        .unwrap()
        .iter()
        .flat_map(|it| it.as_array().unwrap())
    {
        let names = ["parent", "child"].map(|key| transform[key].as_str().unwrap());
        assert_eq!(names, ["map", "lidar"]);
        let (frame, position) = positions(&json!([transform]))[0];
        assert!(distance_m(position, localized[frame].translation.vector.into()) < 1e-3);
    }
    assert_eq!(received["/tf"].as_array().unwrap().len(), 12);
    // Five metres per second, straight ahead.
    let last = &received["/fpmcl/odometry"][11];
    let speed = ["forward_m_per_s", "turn_rad_per_s"].map(|key| last[key].as_f64().unwrap());
    assert!(
        (speed[0] - 5.0).abs() < 0.5 && speed[1].abs() < 0.1,
        "{last}"
    );
    let covariance = received["/fpmcl/pose"][11]["covariance"]
        .as_array()
        .unwrap();
    assert!(covariance[0].as_f64() > Some(0.0) && covariance[35].as_f64() > Some(0.0));
    let map = &received["/fpmcl/map"][0];
    let points = map["points"].as_u64().unwrap();
    assert!(
        points > 1000 && map["bytes"] == 12 * points && map["frame"] == "map",
        "{map}"
    );
    let of_state = |it: &&Value| it["message"] == "tracking: the scan agrees with the map";
    let tracking = received["/diagnostics"].as_array().unwrap();
    let tracking = tracking.iter().find(of_state).unwrap();
    assert_eq!(tracking["name"], "fpmcl: localization");
    let values = ["state", "reason", "dropped scans"].map(|key| &tracking["values"][key]);
    assert_eq!(values, ["tracking", "the scan agrees with the map", "0"]);
    for number in ["agreement", "latency [ms]"] {
        let text = tracking["values"][number].as_str().unwrap();
        assert!(text.parse::<f64>().unwrap() > 0.0, "{tracking}");
    }

    // What remains of the drive is what localize writes.
    let written = LocalizationResults::read(&recording.path("live/localization.npz")).unwrap();
    for (written, localized) in written.estimates_in_space.unwrap().iter().zip(&localized) {
        let apart = written.translation.vector - localized.translation.vector;
        assert!(apart.norm() < 1e-3, "{written} {localized}");
    }
    let rows = |folder: &str| {
        let text = recording.bytes(&format!("{folder}/mcl_tum.txt"));
        String::from_utf8(text).unwrap().lines().count()
    };
    assert_eq!(rows("live"), rows("results"));
    assert!(recording.path("live/report.html").exists());
}

#[test]
fn a_drive_of_ten_seconds_with_its_odometry_is_localized_on_the_way_as_afterwards() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let simulation = "\
output_folder: .
n_scans: 100
scanner: {azimuth_steps: 600}
path: [{length_m: 110, turn_deg: 30}]
";
    common::simulate_two_drives(folder, simulation);
    let file = |name: &str| folder.join(name);
    let odometry = PoseTrack::read(
        &file("drive_2/odometry.txt"),
        Some(&file("drive_2/calib.txt")),
    );
    let rows = odometry.unwrap().map_from_lidar.into_iter().enumerate();
    let rows = rows.map(|(frame, map_from_lidar)| StampedPose {
        frame,
        time_s: 0.1 * frame as f64,
        map_from_lidar,
    });
    let driven = fs::File::create(file("driven.txt")).unwrap();
    write_tum(driven, &rows.collect::<Vec<_>>()).unwrap();
    let call = common::fpmcl("build-map").in_folder(folder);
    call.with("drive_1").with("--output=map.ply").succeeds();
    let call = common::fpmcl("localize").in_folder(folder).with("drive_2");
    let call = call
        .with("--map=map.ply")
        .with("--odometry=driven.txt")
        .with("--backend=cpu");
    call.with("--output=afterwards/localization.npz").succeeds();

    let read = |name: &str| LocalizationResults::read(&file(name)).unwrap();
    let afterwards = read("afterwards/localization.npz");
    let start = &afterwards.estimates.unwrap()[0];
    let [x, y, turn] = [
        start.translation.x,
        start.translation.y,
        start.rotation.angle(),
    ];
    let start = format!("--start={x},{y},{}", turn.to_degrees());
    let afterwards = afterwards.estimates_in_space.unwrap();

    let arguments = [
        "--map=map.ply",
        "--odometry=/odom",
        "--output=live/localization.npz",
        &start,
    ];
    let Some(outcome) = play(folder, "drive_2/velodyne", "driven", &arguments) else {
        return;
    };
    let counts = ["received", "dropped"].map(|key| outcome["report"]["live"][key].as_u64());
    let [received, dropped] = counts.map(Option::unwrap);
    assert_eq!(received, 100);
    let live = read("live/localization.npz");
    assert_eq!(live.frames.len() as u64, 100 - dropped);
    // Scans that are dropped change the random beams of those after them: millimetres.
    let poses = positions(&outcome["received"]["/fpmcl/pose"]).into_iter();
    let apart_m = poses
        .map(|(frame, position)| distance_m(position, afterwards[frame].translation.vector.into()));
    let mut apart_m: Vec<f64> = apart_m.collect();
    apart_m.sort_by(f64::total_cmp);
    assert!(
        apart_m.len() >= 20,
        "{} of {dropped} dropped",
        apart_m.len()
    );
    let (median_m, largest_m) = (apart_m[apart_m.len() / 2], apart_m[apart_m.len() - 1]);
    assert!(
        median_m < 0.003 && largest_m < 0.01,
        "{median_m} {largest_m}"
    );
}

#[test]
fn damaged_clouds_a_stall_and_a_proposed_pose_are_survived_and_reported() {
    let recording = street();
    let Some(outcome) = robot(&recording, "events", &[]) else {
        return;
    };
    let (received, report) = (&outcome["received"], &outcome["report"]);
    let counts = ["received", "rejected"].map(|key| report["live"][key].as_u64());
    // Those that arrived were localized or rejected.
    let rejected = counts[1].unwrap();
    assert!(
        rejected >= 2 && counts[0] == Some(11 + rejected),
        "{report}"
    );
    let of_damaged = received["/diagnostics"].as_array().unwrap().last().unwrap();
    let of_damaged = ["rejected scans", "damaged messages"].map(|key| &of_damaged["values"][key]);
    assert_eq!(of_damaged, [rejected.to_string().as_str(); 2], "{report}");
    let stderr = outcome["stderr"].as_str().unwrap();
    assert_eq!(
        stderr.matches("a message of /points is left out").count(),
        1,
        "{stderr}"
    );
    let expected = [
        "tracking: the scan agrees with the map",
        "lost: no scan that can be used arrived for too long",
        "tracking: the scan agrees with the map",
        "searching: a pose was proposed that no scan has confirmed yet",
        "tracking: the scan agrees with the map",
    ];
    assert!(
        states_include(received, &expected),
        "{}",
        received["/diagnostics"]
    );
    let (_, last) = *positions(&received["/fpmcl/pose"]).last().unwrap();
    assert!(distance_m(last, [5.5, 0.0, last[2]]) < 0.1, "{last:?}");
}

/// Position of the robot [m], at a height, that drives ahead until a moment and then from frame 5 to frame 11 and back. It stands
/// at both ends: no robot reverses from one scan to the next.
fn to_and_fro(moment: usize, from: usize, height_m: f64) -> [f64; 3] {
    let frame = moment.checked_sub(from).map_or(moment, |after| {
        let step = after % 24;
        5 + step.min(18_usize.saturating_sub(step)).min(6)
    });
    [0.5 * frame as f64, 0.0, height_m]
}

#[test]
fn a_proposed_pose_that_is_wrong_is_never_published_and_the_robot_is_found_again() {
    let recording = street();
    let Some(outcome) = robot(&recording, "misled", &[]) else {
        return;
    };
    let received = &outcome["received"];
    let expected = [
        "tracking: ",
        "searching: a pose was proposed that no scan has confirmed yet",
        "tracking: ",
    ];
    let states = &received["/diagnostics"];
    assert!(states_include(received, &expected), "{states}");
    let poses = positions(&received["/fpmcl/pose"]);
    for (moment, position) in published(received) {
        let expected = to_and_fro(moment, 5, position[2]);
        // The proposal is metres off. The first pose that is found has the noise of few particles.
        assert!(
            distance_m(position, expected) < 0.5,
            "{moment} {position:?}"
        );
    }
    assert!(poses.last().unwrap().0 >= 5);
}

#[test]
fn a_driver_that_repeats_a_scan_is_as_one_that_sends_none() {
    let recording = street();
    let Some(outcome) = robot(&recording, "frozen", &[]) else {
        return;
    };
    let received = &outcome["received"];
    let expected = [
        "tracking: the scan agrees with the map",
        "coasting: the scans that arrive cannot be used; the motion carries the pose",
        "lost: no scan that can be used arrived for too long",
        "tracking: the scan agrees with the map",
    ];
    let states = &received["/diagnostics"];
    assert!(states_include(received, &expected), "{states}");
    let lost = states.as_array().unwrap().iter();
    let mut lost = lost.filter(|it| it["message"].as_str().unwrap().starts_with("lost: "));
    let values = &lost.next().unwrap()["values"];
    assert!(values["rejected scans"] != "0", "{values}");
    // What the last scan showed.
    assert!(values["agreement"].is_string(), "{values}");
    let poses = positions(&received["/fpmcl/pose"]);
    let frames: Vec<usize> = poses.iter().map(|it| it.0).collect();
    assert_eq!(frames, Vec::from_iter(0..12));
    let stderr = outcome["stderr"].as_str().unwrap();
    assert_eq!(stderr.matches("is not later than the last one").count(), 1);
}

#[test]
fn another_type_of_message_on_the_topic_of_the_clouds_is_reported() {
    let recording = street();
    let Some(outcome) = robot(&recording, "mistyped", &[]) else {
        return;
    };
    let stderr = outcome["stderr"].as_str().unwrap();
    let expected = "no sensor_msgs/msg/PointCloud2 has arrived on /points for 5 s; its type is sensor_msgs/msg/LaserScan elsewhere";
    assert!(stderr.contains(expected), "{stderr}");
}

#[test]
fn reliable_clouds_are_asked_for_by_a_node_of_another_name() {
    let recording = street();
    let arguments = [
        "--reliability=reliable",
        "--node-name=front",
        "--remap=/front/pose:=/fpmcl/pose",
        "--remap=/front/odometry:=/fpmcl/odometry",
        "--remap=/front/map:=/fpmcl/map",
    ];
    let Some(outcome) = robot(&recording, "reliable", &arguments) else {
        return;
    };
    let received = &outcome["received"];
    assert_eq!(positions(&received["/fpmcl/pose"]).len(), 12);
    let name = &received["/diagnostics"][0]["name"];
    assert_eq!(name, "front: localization");
}

#[test]
fn a_robot_that_is_carried_elsewhere_is_lost_without_a_pose_and_found_again() {
    let recording = street();
    let Some(outcome) = robot(&recording, "kidnapped", &[]) else {
        return;
    };
    let received = &outcome["received"];
    let expected = ["tracking: ", "lost: ", "tracking: "];
    let states = &received["/diagnostics"];
    assert!(states_include(received, &expected), "{states}");
    // Frames 5 to 34 of the robot's clock were elsewhere: after half a second nothing is believed.
    let poses = positions(&received["/fpmcl/pose"]);
    for (moment, position) in published(received) {
        assert!(!(10..35).contains(&moment), "{moment} {position:?}");
        let expected = to_and_fro(moment, 35, position[2]);
        let is_elsewhere = (5..10).contains(&moment);
        assert!(
            is_elsewhere || distance_m(position, expected) < 0.1,
            "{moment} {position:?}"
        );
    }
    assert!(poses.last().unwrap().0 >= 35);
}

#[test]
fn a_node_that_is_killed_begins_where_it_was() {
    let recording = street();
    // The last pose was written up to a second of driving ago.
    let widely = [
        "--set",
        "numParticles=1000",
        "--set",
        "start={position_m: 5, heading_rad: 0.5}",
    ];
    let Some(outcome) = robot(&recording, "restarted", &widely) else {
        return;
    };
    let poses = positions(&outcome["received"]["/fpmcl/pose"]);
    let frames: Vec<usize> = poses.iter().map(|it| it.0).collect();
    // The first scans of each run find it.
    assert!(frames.windows(3).any(|it| it == [3, 4, 5]), "{frames:?}");
    assert!(frames.ends_with(&[9, 10, 11]), "{frames:?}");
    for (frame, [x, y, _]) in poses {
        let error_m = (x - 0.5 * frame as f64).hypot(y);
        assert!(error_m < 0.1, "{frame} {x} {y}");
    }
    let stderr = outcome["stderr"].as_str().unwrap();
    assert!(!stderr.contains("start is searched"), "{stderr}");
}

/// The odometry of the robot with wheels, as its lidar moves by it from its first pose: 2 % too far, and 1 % sideways.
fn driven_by_wheels(frame: f64) -> [f64; 2] {
    [0.51 * frame, 0.005 * frame]
}

#[test]
fn with_wheels_poses_are_those_of_the_base_and_the_transform_is_that_of_its_odometry_alone() {
    let recording = street();
    // Rows of KITTI in the axes of the camera: x to the right, z ahead.
    let rows = (0..12).map(|frame| {
        let [ahead, left] = driven_by_wheels(f64::from(frame));
        format!("1 0 0 {} 0 1 0 0 0 0 1 {ahead}\n", -left)
    });
    recording.write("wheels.txt", &rows.collect::<String>());
    let mut localized = None;
    // By its topic, and by `/tf` alone.
    for odometry in [Some("--odometry=/odom"), None] {
        let arguments: Vec<&str> = odometry.into_iter().chain(["--force"]).collect();
        let Some(outcome) = robot(&recording, "wheels", &arguments) else {
            return;
        };
        let localized = localized.get_or_insert_with(|| {
            let call = recording.fpmcl("localize").set("odometry", "auto");
            let call = call.set("pose_file", "null").set("pose_tracking", "null");
            call.with("--start=0,0,0")
                .with("--odometry=wheels.txt")
                .succeeds();
            let results = LocalizationResults::read(&recording.path(RESULT)).unwrap();
            results.estimates_in_space.unwrap()
        });
        let written = LocalizationResults::read(&recording.path("live/localization.npz")).unwrap();
        // The motion is that of the wheels, not that of the scans.
        let step = driven_by_wheels(1.0);
        for increment in &written.odometry.unwrap()[1..] {
            let wrong = [
                increment.translation.x - step[0],
                increment.translation.y - step[1],
            ];
            assert!(wrong.iter().all(|it| it.abs() < 1e-6), "{increment}");
        }
        for (live, localized) in written.estimates_in_space.unwrap().iter().zip(&*localized) {
            let apart = live.translation.vector - localized.translation.vector;
            assert!(apart.norm() < 1e-3, "{live} {localized}");
        }
        let received = &outcome["received"];
        let poses = positions(&received["/fpmcl/pose"]);
        assert_eq!(poses.len(), 12);
        for (frame, position) in poses {
            // One metre behind the lidar.
            let base = localized[frame] * nalgebra::Translation3::new(-1.0, 0.0, 0.0);
            let expected = base.translation.vector.into();
            assert!(
                distance_m(position, expected) < 1e-3,
                "{frame} {position:?}"
            );
        }
        assert_eq!(received["/fpmcl/odometry"][0]["child"], "base_link");
        let transforms = received["/tf"].as_array().unwrap();
        let of_program = transforms
            .iter()
            .flat_map(|it| it.as_array().unwrap())
            .filter(|it| it["parent"] == "map");
        let of_program: Vec<&Value> = of_program.collect();
        assert_eq!(of_program.len(), 12, "{transforms:?}");
        for transform in of_program {
            assert_eq!(transform["child"], "odom");
            let (frame, [x, y, _]) = positions(&json!([transform]))[0];
            // It takes back what the odometry has drifted.
            let [ahead, left] = driven_by_wheels(frame as f64);
            let wrong_m = (x + 3.0 + ahead - 0.5 * frame as f64).hypot(y + left);
            assert!(wrong_m < 0.1, "{transform}");
        }
        if odometry.is_some() {
            assert_eq!(outcome["report"]["about"]["odometry"], "/odom");
        } else {
            let stderr = outcome["stderr"].as_str().unwrap();
            let expected = "the motion is that of base_link in odom, by /tf";
            assert!(stderr.contains(expected), "{stderr}");
        }
    }
}

#[test]
fn while_the_clouds_stall_the_pose_goes_on_with_the_wheels() {
    let recording = street();
    let Some(outcome) = robot(&recording, "carried", &["--odometry=/odom"]) else {
        return;
    };
    let received = &outcome["received"];
    let expected = [
        "tracking: ",
        "coasting: no scan arrives; the motion carries the pose",
    ];
    assert!(
        states_include(received, &expected),
        "{}",
        received["/diagnostics"]
    );
    let last_scan = 4.0;
    let tenths = |it: &Value| it["stamp_ns"].as_f64().unwrap() * 1e-8 - 10.0;
    let poses = received["/fpmcl/pose"].as_array().unwrap().iter();
    let carried: Vec<&Value> = poses.filter(|it| tenths(it) > last_scan + 0.5).collect();
    assert!(carried.len() >= 3, "{received}");
    for pose in &carried {
        let [from, to] = [last_scan, tenths(pose)].map(driven_by_wheels);
        let (_, [x, y, _]) = positions(&json!([pose]))[0];
        let expected = [0.5 * last_scan - 1.0 + to[0] - from[0], to[1] - from[1]];
        let wrong_m = (x - expected[0]).hypot(y - expected[1]);
        assert!(wrong_m < 0.1, "{pose}");
        // The variance of x, which grows.
        let of_scan = received["/fpmcl/pose"][4]["covariance"][0].as_f64();
        assert!(pose["covariance"][0].as_f64() > of_scan, "{pose}");
    }
    let transforms = received["/tf"].as_array().unwrap().iter();
    let of_program = transforms.flat_map(|it| it.as_array().unwrap());
    let of_stall = of_program.filter(|it| it["parent"] == "map" && tenths(it) > last_scan + 0.5);
    let of_stall: Vec<&Value> = of_stall.collect();
    assert!(of_stall.len() >= 3, "{received}");
    let drift = driven_by_wheels(last_scan);
    for transform in of_stall {
        let (_, [x, y, _]) = positions(&json!([transform]))[0];
        let wrong_m = (x + 3.0 + drift[0] - 0.5 * last_scan).hypot(y + drift[1]);
        assert!(transform["child"] == "odom" && wrong_m < 0.1, "{transform}");
    }
}

#[test]
fn what_a_robot_cannot_have_is_an_error_before_any_work() {
    let recording = Recording::street(1);
    let live = || {
        let call = common::fpmcl("live").in_folder(recording.folder());
        call.with("localization.yml").with("--ros2=points")
    };
    live().fails_with(&["pose_file is poses.txt", "set pose_file to null"]);
    let live = || {
        let call = live().set("pose_file", "null").set("pose_tracking", "null");
        call.set("odometry", "auto")
    };
    live()
        .with("--odometry=wheels.txt")
        .fails_with(&["odometry_file is wheels.txt", "--odometry /odom"]);
    live()
        .with("--replay=velodyne")
        .rejects_usage_with(&["cannot be used with"]);
    live()
        .with("--rate=2")
        .rejects_usage_with(&["cannot be used with"]);
    live().with("--domain=300").rejects_usage_with(&["0..=232"]);
    live()
        .with("--interface=::1")
        .rejects_usage_with(&["an IPv4 address of this machine"]);
    // An address for documentation (RFC 5737).
    live()
        .with("--interface=192.0.2.1")
        .fails_with(&["no network interface of this machine has this address"]);
    live()
        .with("--remap=/fpmcl/poses:=/pose")
        .fails_with(&["no topic /fpmcl/poses is used", "/fpmcl/pose,"]);
    live()
        .environment("ROS_DOMAIN_ID", "300")
        .fails_with(&["ROS_DOMAIN_ID is 300; set a number from 0 to 232"]);
    live()
        .with("--remap=/a")
        .rejects_usage_with(&["/fpmcl/pose:=/pose"]);
}
