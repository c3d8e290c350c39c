//! Bags from the outside: one recording in every format is the same recording, and damaged ones are errors.

#![cfg(feature = "bags")]
#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

#[path = "fuzzed/allocation.rs"]
mod allocation;
mod bag_writers;
#[path = "../src/skips_for_tests.rs"]
mod skips;

use std::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2};
use std::fs;
use std::path::Path;
use std::time::Duration;

use assert_cmd::Command;
use fpmcl::geometry::{Pose3, Vec3};
use fpmcl::inertial::GRAVITY_M_S2;
use fpmcl::internals::scan_files;
use fpmcl::lidar::Scan;
use fpmcl::recording::{Bag, FramePose, PoseTrack, RecordingError, TopicKind};
use nalgebra::{UnitQuaternion, Vector3};
use rayon::prelude::*;

use bag_writers::{
    Cloud, Kind, Recorded, compress, db3, imu, livox, mcap, mcap_compressed, nav_sat_fix, odometry,
    point_cloud2, pose_stamped, ros1, transforms,
};

const START_NS: u64 = 1_700_000_000_250_000_000;

const LEVEL: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

/// Five scans with odometry, and the mounting of the sensor.
fn recording(kind: Kind) -> Vec<Recorded> {
    let mounting = [
        ("base_link", "mast", [1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]),
        ("mast", "/lidar", [0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0]),
        ("base_link", "imu", [0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
    ];
    let mut messages = vec![Recorded {
        topic: "/tf_static",
        message_type: "tf2_msgs/msg/TFMessage",
        time_ns: START_NS,
        data: transforms(kind, &mounting),
    }];
    for scan in 0..5 {
        let time_ns = START_NS + 100_000_000 * scan;
        let points: Vec<_> = (0..=40_u16)
            .map(|i| {
                let x = if i == 7 {
                    f32::NAN
                } else {
                    f32::from(i) + scan as f32
                };
                ([x, 2.0, -1.5, 0.25], i % 4, 0.0025 * f32::from(i))
            })
            .collect();
        messages.push(Recorded {
            topic: "/points",
            message_type: "sensor_msgs/msg/PointCloud2",
            time_ns: time_ns + 1_000_000,
            data: point_cloud2(kind, time_ns, "lidar", &Cloud::of(&points)),
        });
        let pose = [[scan as f64, 0.5, 0.0].as_slice(), &LEVEL].concat();
        messages.push(Recorded {
            topic: "/odom",
            message_type: "nav_msgs/msg/Odometry",
            time_ns: time_ns + 2_000_000,
            data: odometry(
                kind,
                time_ns,
                "odom",
                "imu",
                pose.as_slice().try_into().unwrap(),
            ),
        });
        messages.push(Recorded {
            topic: "/chatter",
            message_type: "std_msgs/msg/String",
            time_ns,
            data: vec![0, 1, 0, 0],
        });
    }
    messages
}

/// All that fpmcl reads of a bag.
type Content = (Vec<Scan>, Vec<FramePose>, Vec<FramePose>);

fn content(bag: &Bag) -> Result<Content, RecordingError> {
    let topic = &bag.topic(TopicKind::Scans, None)?.name;
    let scans = 0..bag.scan_times(topic)?.len();
    let scans = scans
        .map(|scan| bag.read_scan(topic, scan))
        .collect::<Result<_, _>>()?;
    let poses = bag.poses(&bag.topic(TopicKind::Poses, None)?.name)?;
    Ok((scans, poses, bag.static_transforms()?))
}

fn metadata(folder: &Path, files: &[&str]) {
    let mut text = "rosbag2_bagfile_information:\n  version: 5\n  compression_format: zstd\n  relative_file_paths:\n".to_owned();
    for file in files {
        text += &format!("    - {file}\n");
    }
    fs::write(
        folder.join("metadata.yaml"),
        text + "  duration:\n    nanoseconds: 1\n",
    )
    .unwrap();
}

/// Writes one recording in every format; returns the names, the first that of a plain MCAP.
fn write_all_formats(folder: &Path) -> Vec<&'static str> {
    let path = |name: &str| folder.join(name);
    let (little, big) = (recording(Kind::CdrLittle), recording(Kind::CdrBig));
    let options = || {
        mcap::WriteOptions::new()
            .compression(None)
            .chunk_size(Some(1500))
    };
    let whole = mcap(options(), "cdr", &little);
    fs::write(path("whole.mcap"), &whole).unwrap();
    fs::write(path("big.mcap"), mcap(options(), "cdr", &big)).unwrap();
    let unchunked = mcap(options().use_chunks(false), "cdr", &little);
    fs::write(path("unchunked.mcap"), unchunked).unwrap();
    let unindexed = options().emit_message_indexes(false);
    fs::write(path("unindexed.mcap"), mcap(unindexed, "cdr", &little)).unwrap();
    let ros1_messages = recording(Kind::Ros1);
    fs::write(path("ros1.mcap"), mcap(options(), "ros1", &ros1_messages)).unwrap();
    let mut names = vec!["big.mcap", "unchunked.mcap", "unindexed.mcap", "ros1.mcap"];
    for compression in ["lz4", "zstd"] {
        let name = if compression == "lz4" {
            "lz4.mcap"
        } else {
            "zstd.mcap"
        };
        fs::write(path(name), mcap_compressed(&whole, compression)).unwrap();
        names.push(name);
    }
    for (name, compression) in [("none.bag", "none"), ("lz4.bag", "lz4"), ("bz2.bag", "bz2")] {
        fs::write(path(name), ros1(compression, &ros1_messages)).unwrap();
        names.push(name);
    }
    db3(&path("all.db3"), &big);
    let bytes = fs::read(path("all.db3")).unwrap();
    fs::write(path("all 100%.db3.zstd"), compress("zstd", &bytes)).unwrap();
    let messages = little.iter().map(|message| Recorded {
        data: compress("zstd", &message.data),
        ..message.clone()
    });
    db3(&path("messages.db3"), &messages.collect::<Vec<_>>());
    for name in ["split", "split_mcap"] {
        fs::create_dir(path(name)).unwrap();
    }
    db3(&path("split/1.db3"), &little[..7]);
    db3(&path("split/0.db3"), &little[7..]);
    metadata(&path("split"), &["\"split/1.db3\"", "0.db3"]);
    fs::write(
        path("split_mcap/a.mcap"),
        mcap(options(), "cdr", &little[..4]),
    )
    .unwrap();
    let rest = compress("zstd", &mcap(options(), "cdr", &little[4..]));
    fs::write(path("split_mcap/b.mcap.zstd"), rest).unwrap();
    fs::write(
        path("split_mcap/metadata.yaml"),
        "rosbag2_bagfile_information:\n  relative_file_paths: [a.mcap, 'b.mcap.zstd']\n",
    )
    .unwrap();
    names.extend([
        "all.db3",
        "all 100%.db3.zstd",
        "messages.db3",
        "split",
        "split_mcap",
    ]);
    names.insert(0, "whole.mcap");
    names
}

#[test]
fn one_recording_in_every_format_is_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let names = write_all_formats(folder.path());
    let expected = content(&Bag::open(&path("whole.mcap")).unwrap()).unwrap();
    let (scans, poses, mounting) = &expected;
    assert_eq!((scans.len(), poses.len(), mounting.len()), (5, 5, 3));
    for (number, scan) in scans.iter().enumerate() {
        let start_s = 1e-9 * START_NS as f64 + 0.1 * number as f64;
        assert!((scan.time_s.unwrap() - start_s - 0.05).abs() < 1e-6);
        assert_eq!(scan.points[3], Vec3::new(3.0 + number as f32, 2.0, -1.5));
        assert_eq!(
            (scan.points.len(), scan.times_s.len(), scan.rings.len()),
            (40, 40, 40)
        );
        assert!(
            (scan.times_s[7] + 0.05 - 8.0 * 0.0025).abs() < 1e-6,
            "after the dropped point"
        );
        assert_eq!((scan.rings[7], scan.intensities[7]), (0, 0.25));
        let pose = &poses[number];
        assert_eq!((pose.parent.as_str(), pose.child.as_str()), ("odom", "imu"));
        assert!((pose.time_s - start_s).abs() < 1e-6);
        assert_eq!(pose.parent_from_child.translation.x, number as f64);
    }
    for name in names {
        let bag = Bag::open(&path(name)).unwrap();
        assert_eq!(content(&bag).unwrap(), expected, "{name}");
        let chatter = &bag.topics()[0];
        assert_eq!(
            (chatter.name.as_str(), chatter.count),
            ("/chatter", 5),
            "{name}"
        );
        let (first_s, last_s) = chatter.span_s.unwrap();
        assert!((last_s - first_s - 0.4).abs() < 1e-6, "{name}");
        let files = fs::read_dir(folder.path()).unwrap();
        let names = files.map(|file| file.unwrap().file_name().into_string().unwrap());
        assert!(
            !names
                .into_iter()
                .any(|n| n.contains("-shm") || n.contains("-wal")),
            "{name}"
        );
    }
}

#[test]
fn positions_of_a_receiver_are_the_same_in_every_serialization() {
    let folder = tempfile::tempdir().unwrap();
    let fixes = |kind| {
        let mut messages = recording(kind);
        for number in 0..4_u32 {
            let time_ns = START_NS + 1_000_000_000 * u64::from(number);
            // The second one has no fix, the third no known covariance, the fourth no height.
            let status = if number == 1 { -1 } else { 0 };
            let covariance_type = if number == 2 { 0 } else { 2 };
            let height_m = if number == 3 { f64::NAN } else { 115.0 };
            let position = [49.0 + 0.001 * f64::from(number), 8.4, height_m];
            let known = (status, covariance_type);
            let variances = [4.0, 4.0, 9.0];
            messages.push(Recorded {
                topic: "/gnss",
                message_type: "sensor_msgs/msg/NavSatFix",
                time_ns: time_ns + 5_000_000,
                data: nav_sat_fix(kind, time_ns, "mast", known, position, variances),
            });
        }
        let path = folder.path().join("fixes.mcap");
        let serialization = if kind == Kind::Ros1 { "ros1" } else { "cdr" };
        let options = mcap::WriteOptions::new().compression(None);
        fs::write(&path, mcap(options, serialization, &messages)).unwrap();
        let recording = fpmcl::recording::Recording::open(&path).unwrap();
        recording.read_fixes(Path::new("/gnss")).unwrap()
    };
    let expected = fixes(Kind::CdrLittle);
    assert_eq!((expected.fixes.len(), expected.without_position), (2, 2));
    let [first, third] = [expected.fixes[0], expected.fixes[1]];
    assert!((first.time_s - 1e-9 * START_NS as f64).abs() < 1e-6);
    assert_eq!(
        (first.position.latitude_deg, first.position.height_m),
        (49.0, 115.0)
    );
    assert_eq!(
        (first.horizontal_m, first.vertical_m),
        (Some(2.0), Some(3.0))
    );
    assert_eq!(
        (third.horizontal_m, third.position.latitude_deg),
        (None, 49.002)
    );
    // The lidar is 1 m above the mast, turned by half a turn about z.
    assert_eq!(expected.antenna_m, Some([0.0, 0.0, -1.0]));
    assert_eq!(fixes(Kind::CdrBig), expected);
    assert_eq!(fixes(Kind::Ros1), expected);
}

#[test]
fn inertial_measurements_are_the_same_in_every_serialization() {
    let folder = tempfile::tempdir().unwrap();
    let rates = |number: u32| [0.1 * f64::from(number), -0.2, 0.3];
    let forces = [0.6, -0.8, 9.7];
    let measured = |kind, per_m_s2: f64| {
        let mut messages = recording(kind);
        // A quarter of a turn about z; the lidar has half a turn.
        let quarter = [0.0, 0.0, 0.0, 0.0, 0.0, FRAC_1_SQRT_2, FRAC_1_SQRT_2];
        messages.push(Recorded {
            topic: "/tf_static",
            message_type: "tf2_msgs/msg/TFMessage",
            time_ns: START_NS,
            data: transforms(kind, &[("base_link", "imu_link", quarter)]),
        });
        for number in 0..30_u32 {
            let time_ns = START_NS + 10_000_000 * u64::from(number);
            // The fourth one has no stamp.
            let stamp_ns = if number == 3 { 0 } else { time_ns };
            let forces = forces.map(|force| force * per_m_s2);
            messages.push(Recorded {
                topic: "/imu",
                message_type: "sensor_msgs/msg/Imu",
                time_ns: time_ns + 2_000_000,
                data: imu(kind, stamp_ns, "/imu_link", &rates(number), &forces),
            });
        }
        let path = folder.path().join("imu.mcap");
        let serialization = if kind == Kind::Ros1 { "ros1" } else { "cdr" };
        let options = mcap::WriteOptions::new().compression(None);
        fs::write(&path, mcap(options, serialization, &messages)).unwrap();
        let recording = fpmcl::recording::Recording::open(&path).unwrap();
        recording.read_imu(Path::new("/imu"), None).unwrap()
    };
    let expected = measured(Kind::CdrLittle, 1.0);
    assert_eq!(expected.samples.rows().len(), 30);
    for (number, sample) in (0..).zip(expected.samples.rows()) {
        let logged_later_s = if number == 3 { 0.002 } else { 0.0 };
        let time_s = 1e-9 * START_NS as f64 + 0.01 * f64::from(number) + logged_later_s;
        assert!((sample.time_s - time_s).abs() < 1e-6, "{number}");
        assert_eq!(sample.rate_rad_s, Vector3::from(rates(number)));
        assert_eq!(sample.force_m_s2, Vector3::from(forces));
    }
    let lidar_from_imu = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -FRAC_PI_2);
    let found = expected.lidar_from_imu.unwrap();
    assert!(found.angle_to(&lidar_from_imu) < 1e-6, "{found}");
    assert_eq!(measured(Kind::CdrBig, 1.0), expected);
    assert_eq!(measured(Kind::Ros1, 1.0), expected);
    // The drivers of Livox write forces in g.
    let in_g = measured(Kind::Ros1, 1.0 / GRAVITY_M_S2);
    for (found, expected) in in_g.samples.rows().iter().zip(expected.samples.rows()) {
        assert!((found.force_m_s2 - expected.force_m_s2).norm() < 1e-9);
    }
}

#[test]
fn threads_read_the_same_scans() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag.bag");
    fs::write(&path, ros1("lz4", &recording(Kind::Ros1))).unwrap();
    let bag = Bag::open(&path).unwrap();
    let (scans, ..) = content(&bag).unwrap();
    (0..200_usize).into_par_iter().for_each(|i| {
        assert_eq!(
            bag.read_scan("/points", 7 * i % 5).unwrap(),
            scans[7 * i % 5]
        );
    });
}

/// A bag of one topic.
fn bag_of(message_type: &'static str, data: Vec<u8>) -> (tempfile::TempDir, Bag) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("one.mcap");
    let message = Recorded {
        topic: "/one",
        message_type,
        time_ns: START_NS,
        data,
    };
    let options = mcap::WriteOptions::new().compression(None);
    fs::write(&path, mcap(options, "cdr", &[message])).unwrap();
    let bag = Bag::open(&path).unwrap();
    (folder, bag)
}

fn read_cloud(cloud: &Cloud) -> Result<Scan, RecordingError> {
    let data = point_cloud2(Kind::CdrLittle, START_NS, "lidar", cloud);
    bag_of("sensor_msgs/msg/PointCloud2", data)
        .1
        .read_scan("/one", 0)
}

/// An organized cloud of 3 x 2 points with padding, whose fields have a type.
fn organized(datatype: u8, size: usize, is_big_endian: bool) -> Cloud {
    let number = |number: i8| {
        let mut bytes = match datatype {
            7 => f32::from(number).to_le_bytes().to_vec(),
            8 => f64::from(number).to_le_bytes().to_vec(),
            _ => i64::from(number).to_le_bytes()[..size].to_vec(),
        };
        if is_big_endian {
            bytes.reverse();
        }
        bytes
    };
    let mut data = Vec::new();
    for row in 0..2 {
        for column in 0..3 {
            data.push(0xff);
            for value in [row, column, 5, 100] {
                data.extend(number(value));
            }
            data.extend([0xff; 2]);
        }
        data.extend([0xff; 11]);
    }
    let step = |field: u32| 1 + field * size as u32;
    Cloud {
        // In another order than in memory.
        fields: vec![
            ("z", step(2), datatype),
            ("Reflectivity", step(3), datatype),
            ("y", step(1), datatype),
            ("x", step(0), datatype),
        ],
        width: 3,
        height: 2,
        point_step: step(4) + 2,
        row_step: 3 * (step(4) + 2) + 11,
        is_big_endian,
        data,
    }
}

#[test]
fn points_of_any_type_order_and_padding_are_read() {
    let types = [
        (1, 1),
        (2, 1),
        (3, 2),
        (4, 2),
        (5, 4),
        (6, 4),
        (7, 4),
        (8, 8),
    ];
    for (datatype, size) in types {
        for is_big_endian in [false, true] {
            let scan = read_cloud(&organized(datatype, size, is_big_endian)).unwrap();
            assert_eq!(scan.len(), 6, "{datatype}");
            assert_eq!(scan.points[5], Vec3::new(1.0, 2.0, 5.0), "{datatype}");
            assert_eq!(scan.intensities, [100.0; 6]);
            assert!(scan.times_s.is_empty() && scan.rings.is_empty());
            assert!((scan.time_s.unwrap() - 1e-9 * START_NS as f64).abs() < 1e-6);
        }
    }
}

#[test]
fn sizes_that_contradict_the_data_are_errors() {
    type Change = fn(&mut Cloud);
    let changes: [(&str, Change); 8] = [
        ("width", |cloud| cloud.width = u32::MAX),
        ("height", |cloud| cloud.height = u32::MAX),
        ("both", |cloud| {
            (cloud.width, cloud.height) = (u32::MAX, u32::MAX)
        }),
        ("point step", |cloud| cloud.point_step = 3),
        ("no point step", |cloud| cloud.point_step = 0),
        ("row step", |cloud| cloud.row_step = 1),
        ("offset", |cloud| cloud.fields[0].1 = u32::MAX),
        ("data", |cloud| cloud.data.truncate(122)),
    ];
    for (name, change) in changes {
        let mut cloud = organized(7, 4, false);
        change(&mut cloud);
        let message = read_cloud(&cloud).unwrap_err().to_string();
        assert!(
            message.contains("one.mcap: message 0 of /one is damaged"),
            "{name}: {message}"
        );
    }
    let mut cloud = organized(7, 4, false);
    cloud.fields[0].0 = "depth";
    let message = read_cloud(&cloud).unwrap_err().to_string();
    assert!(
        message.contains("no fields x, y and z, but: depth"),
        "{message}"
    );
    cloud.fields[0].0 = "z";
    for size in [(0, 0), (0, u32::MAX), (u32::MAX, 0)] {
        (cloud.width, cloud.height) = size;
        assert!(read_cloud(&cloud).unwrap().is_empty());
    }
}

#[test]
fn points_of_livox_have_times_lines_and_reflectivities() {
    for (kind, encoding) in [
        (Kind::CdrLittle, "cdr"),
        (Kind::CdrBig, "cdr"),
        (Kind::Ros1, "ros1"),
    ] {
        let points: Vec<_> = (0..=100)
            .map(|i| {
                (
                    1_000_000 * i,
                    [i as f32, 1.0, 2.0],
                    7 * (i % 30) as u8,
                    (i % 6) as u8,
                )
            })
            .collect();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("livox.mcap");
        let message = Recorded {
            topic: "/livox/lidar",
            message_type: "livox_ros_driver2/msg/CustomMsg",
            time_ns: START_NS,
            data: livox(kind, START_NS, &points),
        };
        let options = mcap::WriteOptions::new().compression(None);
        fs::write(&path, mcap(options, encoding, &[message])).unwrap();
        let scan = Bag::open(&path)
            .unwrap()
            .read_scan("/livox/lidar", 0)
            .unwrap();
        assert_eq!(scan.len(), 101);
        assert_eq!(scan.points[99], Vec3::new(99.0, 1.0, 2.0));
        assert_eq!((scan.rings[99], scan.intensities[99]), (3, 63.0));
        assert!((scan.times_s[99] - 0.049).abs() < 1e-6);
        assert!((scan.time_s.unwrap() - 1e-9 * START_NS as f64 - 0.05).abs() < 1e-6);
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_database_below_a_folder_whose_name_is_no_text_is_read() {
    use std::os::unix::ffi::OsStrExt as _;

    let folder = tempfile::tempdir().unwrap();
    let drive = (folder.path()).join(std::ffi::OsStr::from_bytes(b"100%\xff?a=b#\n"));
    fs::create_dir(&drive).unwrap();
    let path = folder.path().join("all.db3");
    db3(&path, &recording(Kind::CdrLittle));
    fs::rename(&path, drive.join("all.db3")).unwrap();
    let bag = Bag::open(&drive.join("all.db3")).unwrap();
    assert_eq!(bag.read_scan("/points", 4).unwrap().points.len(), 40);
}

#[test]
fn the_mounting_follows_from_the_static_transforms() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("all.db3");
    db3(&path, &recording(Kind::CdrLittle));
    let bag = Bag::open(&path).unwrap();
    let mounting = |body| bag.body_from_lidar(body, "/points").unwrap();
    // Turned by half a turn on the mast.
    let base_from_lidar = mounting("/base_link").unwrap();
    let point = base_from_lidar * nalgebra::Point3::new(1.0, 2.0, 3.0);
    assert!((point.coords - nalgebra::Vector3::new(0.0, -2.0, 4.5)).norm() < 1e-12);
    let imu_from_lidar = mounting("imu").unwrap();
    let point = imu_from_lidar * nalgebra::Point3::new(1.0, 2.0, 3.0);
    assert!((point.coords - nalgebra::Vector3::new(0.0, -4.0, 4.5)).norm() < 1e-12);
    assert_eq!(mounting("lidar").unwrap(), nalgebra::Isometry3::identity());
    assert_eq!(mounting("map"), None);
}

#[test]
fn topics_that_cannot_be_taken_are_errors_that_list_the_others() {
    let pose = pose_stamped(
        Kind::CdrLittle,
        START_NS,
        "map",
        &[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0],
    );
    let (_folder, bag) = bag_of("geometry_msgs/msg/PoseStamped", pose);
    let poses = bag.poses("/one").unwrap();
    assert_eq!(
        (poses[0].parent.as_str(), poses[0].child.as_str()),
        ("map", "")
    );
    let message = bag.topic(TopicKind::Scans, None).unwrap_err().to_string();
    assert!(message.contains("has no topic of scans"), "{message}");
    assert!(
        message.contains("it has /one (geometry_msgs/msg/PoseStamped)"),
        "{message}"
    );
    let message = bag.poses("/two").unwrap_err().to_string();
    assert!(message.contains("no topic /two"), "{message}");
    assert!(message.contains("choose one of: /one"), "{message}");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("two.db3");
    let mut messages = recording(Kind::CdrLittle);
    messages[4].topic = "/points_2";
    db3(&path, &messages);
    let bag = Bag::open(&path).unwrap();
    let message = bag.topic(TopicKind::Scans, None).unwrap_err().to_string();
    assert!(message.contains("several topics of scans"), "{message}");
    assert!(
        message.contains("/points (sensor_msgs/msg/PointCloud2), /points_2"),
        "{message}"
    );
    assert_eq!(
        bag.topic(TopicKind::Scans, Some("/points_2"))
            .unwrap()
            .count,
        1
    );
    let message = bag.read_scan("/points", 4).unwrap_err().to_string();
    assert!(
        message.contains("message 4 of /points does not exist, there are 4"),
        "{message}"
    );
}

#[test]
fn poses_without_the_name_of_a_body_need_its_mounting() {
    let data = pose_stamped(
        Kind::CdrLittle,
        START_NS,
        "map",
        &[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0],
    );
    let (_folder, bag) = bag_of("geometry_msgs/msg/PoseStamped", data);
    let read = |body_from_lidar| PoseTrack::read_topic(&bag, None, "/points", body_from_lidar);
    let message = read(None).unwrap_err().to_string();
    assert!(message.contains("body_from_lidar"), "{message}");
    let track = read(Some(Pose3::identity())).unwrap();
    assert_eq!(track.world_from_map.translation.z, 3.0);
}

#[test]
fn quaternions_and_positions_that_are_none_are_errors() {
    let unknown = [0.0; 7];
    let far = [1e9, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let infinite = [f64::INFINITY, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let not_a_number = [0.0, 0.0, 0.0, f64::NAN, 0.0, 0.0, 1.0];
    for pose in [unknown, far, infinite, not_a_number] {
        let data = pose_stamped(Kind::CdrLittle, START_NS, "map", &pose);
        let (_folder, bag) = bag_of("geometry_msgs/msg/PoseStamped", data);
        let message = bag.poses("/one").unwrap_err().to_string();
        assert!(
            message.contains("message 0 of /one has no pose"),
            "{message}"
        );
    }
}

/// Reads whatever a file still has.
fn read_all(path: &Path, bytes: &[u8]) -> Result<Content, String> {
    fs::write(path, bytes).unwrap();
    let name = path.file_name().unwrap().to_str().unwrap();
    let outcome = Bag::open(path).and_then(|bag| content(&bag));
    outcome.map_err(|error| {
        let message = error.to_string();
        assert!(message.contains(name), "{message}");
        message
    })
}

#[test]
fn a_chunk_with_another_checksum_is_damaged() {
    let folder = tempfile::tempdir().unwrap();
    let messages = recording(Kind::CdrLittle);
    let options = mcap::WriteOptions::new().compression(None);
    let mut file = mcap_compressed(&mcap(options, "cdr", &messages), "zstd");
    let path = folder.path().join("chunks.mcap");
    read_all(&path, &file).unwrap();
    // Magic bytes and records before the first chunk, its head, times and size.
    let mut at = 8;
    while file[at] != 0x06 {
        at += 9 + u64::from_le_bytes(*file[at + 1..].first_chunk().unwrap()) as usize;
    }
    file[at + 9 + 24] ^= 1;
    let message = read_all(&path, &file).unwrap_err();
    assert!(message.contains("checksum"), "{message}");
}

/// Describes a bag with the binary, within a time and an address space, and returns the error.
#[cfg(unix)]
#[track_caller]
fn error_of_info(bag: &Path) -> String {
    const MOST_KIB: u32 = 1 << 20;
    let binary = assert_cmd::cargo::cargo_bin!("fpmcl");
    let script = format!("ulimit -v {MOST_KIB}; exec \"$0\" info \"$1\"");
    let mut call = Command::new("sh");
    call.args(["-c", &script]).arg(binary).arg(bag);
    // Less memory of the arenas of threads.
    call.env("RAYON_NUM_THREADS", "2");
    let output = call.timeout(Duration::from_secs(60)).output().unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{error}");
    error
}

#[test]
#[cfg(unix)]
fn views_virtual_tables_and_computed_columns_are_no_tables_of_a_bag() {
    let endless = "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL \
         SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n";
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("crafted.db3");
    for (table, sql) in [
        ("messages", &*format!("DROP TABLE messages; {endless}")),
        (
            "messages",
            "ALTER TABLE messages RENAME TO stored; CREATE VIEW messages AS SELECT * FROM stored",
        ),
        (
            "topics",
            "ALTER TABLE topics RENAME TO stored; CREATE VIEW topics AS SELECT * FROM stored",
        ),
        (
            "messages",
            "DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
        ),
        (
            "messages",
            "ALTER TABLE messages RENAME COLUMN data TO stored; \
             ALTER TABLE messages ADD COLUMN data AS (zeroblob(100000000))",
        ),
    ] {
        db3(&path, &recording(Kind::CdrLittle));
        let database = rusqlite::Connection::open(&path).unwrap();
        database.execute_batch(sql).unwrap();
        drop(database);
        let error = error_of_info(&path);
        let problem = format!("crafted.db3 is no bag of rosbag2: `{table}` is not a table");
        assert!(error.contains(&problem), "{error}");
    }
}

#[test]
fn a_topic_of_odometry_has_poses_only_where_it_is_named_and_motion_everywhere() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("all.mcap");
    let options = mcap::WriteOptions::new().compression(None);
    let messages = recording(Kind::CdrLittle);
    fs::write(&path, mcap(options, "cdr", &messages)).unwrap();
    let log = |options: &[&str]| {
        let mut call = Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"));
        call.current_dir(folder.path()).args(options);
        let output = call.output().unwrap();
        String::from_utf8([output.stdout, output.stderr].concat()).unwrap()
    };
    let found =
        "the poses are found from the scans: all.mcap has poses in /odom (nav_msgs/msg/Odometry)";
    let unnamed = log(&["build-map", "all.mcap"]);
    assert!(unnamed.contains(found), "{unnamed}");
    let named = log(&["build-map", "all.mcap", "--poses", "/odom"]);
    assert!(!named.contains("found from the scans"), "{named}");
    let given = log(&["build-map", "all.mcap", "--set", "poses=given"]);
    assert!(given.contains("name it with --poses"), "{given}");
    let info = log(&["info", "all.mcap"]);
    assert!(info.contains("only where it is named"), "{info}");
    let recording = fpmcl::recording::Recording::open(&path).unwrap();
    assert!(matches!(
        recording.own_track(),
        Err(RecordingError::TopicNotNamed { .. })
    ));
    assert!(recording.read_track(Path::new("/odom"), None).is_ok());
}

#[test]
fn names_of_topics_are_shown_without_being_obeyed() {
    const NAME: &str = "/a\u{1b}]0;owned\u{7}\n INFO forged";
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("all.mcap");
    let mut messages = recording(Kind::CdrLittle);
    for message in &mut messages {
        if message.topic == "/points" {
            message.topic = NAME;
        }
    }
    let options = mcap::WriteOptions::new().compression(None);
    fs::write(&path, mcap(options, "cdr", &messages)).unwrap();
    for (command, options) in [
        ("info", &[][..]),
        ("info", &["--json"]),
        ("odometry", &["--set", "topic=/two"]),
        ("build-map", &["--set", "topic=/two"]),
    ] {
        let mut call = Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"));
        call.current_dir(folder.path()).arg(command).arg(&path);
        let output = call.args(options).output().unwrap();
        let text = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
        assert!(!text.contains(['\u{1b}', '\u{7}']), "{command}: {text:?}");
        let forged = |line: &str| line.trim_start().starts_with("INFO forged");
        assert!(!text.lines().any(forged), "{command}: {text}");
        // `info` does not name the only topic of scans.
        assert!(
            command == "info" || text.contains("]0;owned"),
            "{command}: {text}"
        );
    }
}

#[test]
#[cfg(unix)]
fn a_message_that_no_sensor_sends_is_refused_by_its_size() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("large.db3");
    let database = rusqlite::Connection::open(&path).unwrap();
    let sql = "PRAGMA page_size = 65536; PRAGMA synchronous = OFF; PRAGMA journal_mode = OFF;
         CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
         INSERT INTO topics VALUES (1, '/points', 'sensor_msgs/msg/PointCloud2', 'cdr');
         INSERT INTO messages VALUES (1, 1, 5, zeroblob(900000000));";
    database.execute_batch(sql).unwrap();
    drop(database);
    let error = error_of_info(&path);
    let problem = "message 0 of /points is damaged: a record has 900000000 bytes";
    assert!(error.contains(problem), "{error}");
}

#[test]
#[cfg(unix)]
fn the_index_of_a_long_recording_is_small_and_within_the_budget_of_memory() {
    const ROWS: usize = 300_000;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.db3");
    // Measurements of an inertial sensor; then as many transforms of a robot's joints, which are not read.
    db3(&path, &recording(Kind::CdrLittle));
    let database = rusqlite::Connection::open(&path).unwrap();
    let sql = "PRAGMA synchronous = OFF; PRAGMA journal_mode = OFF;
         INSERT INTO topics VALUES (100, '/imu', 'sensor_msgs/msg/Imu', 'cdr', ''),
                                   (101, '/tf', 'tf2_msgs/msg/TFMessage', 'cdr', '');";
    database.execute_batch(sql).unwrap();
    let add = |topic: u32| {
        let rows = "INSERT INTO messages (topic_id, timestamp, data) \
             WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < ?2) \
             SELECT ?1, ?3 + 1000000 * i, x'00' FROM n";
        database
            .execute(rows, (topic, ROWS as i64, START_NS as i64))
            .unwrap();
    };
    add(101);
    let of_transforms = allocation::peak_of(|| Bag::open(&path).unwrap()).1;
    assert!(of_transforms < 1 << 20, "{of_transforms}");
    add(100);
    let (bag, of_both) = allocation::peak_of(|| Bag::open(&path).unwrap());
    // 24 bytes each, in a vector that is replaced by one of twice its size.
    assert!(of_both < 72 * ROWS + (1 << 20), "{of_both}");
    let counts = ["/imu", "/tf"].map(|name| {
        let topic = bag.topics().iter().find(|topic| topic.name == name);
        topic.unwrap().count
    });
    assert_eq!(counts, [ROWS; 2]);

    let info = |memory| {
        let mut call = Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"));
        let output = call.arg("info").arg(&path).arg(memory).output().unwrap();
        String::from_utf8(output.stderr).unwrap()
    };
    let error = info("--memory=0.01");
    for part in [
        "long.db3: the index of a bag would need 13.7 MiB of memory, more than the budget of 10.2 MiB",
        "`ros2 bag convert`",
        "--memory sets the budget",
    ] {
        assert!(error.contains(part), "{error}");
    }
    let error = info("--memory=0.1");
    assert!(!error.contains("budget"), "{error}");
}

#[test]
fn pages_of_a_table_that_are_linked_twice_are_damaged() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("linked.db3");
    let mut messages = recording(Kind::CdrLittle);
    let short = messages.remove(0);
    messages.extend(vec![short; 100]);
    db3(&path, &messages);
    let database = rusqlite::Connection::open(&path).unwrap();
    let root = "SELECT rootpage FROM sqlite_master WHERE name = 'messages'";
    let root: u16 = database.query_row(root, [], |row| row.get(0)).unwrap();
    let root = usize::from(root);
    drop(database);
    let mut bytes = fs::read(&path).unwrap();
    let page = &mut bytes[512 * (root - 1)..512 * root];
    // An inner page: its kind, ..., at 8 its last page, at 12 the offset of a cell, which begins with the first page.
    assert_eq!(page[0], 5);
    let cell = usize::from(u16::from_be_bytes([page[12], page[13]]));
    page.copy_within(cell..cell + 4, 8);
    let message = read_all(&path, &bytes).err().unwrap();
    assert!(message.contains("do not ascend"), "{message}");
}

#[test]
fn truncated_and_flipped_bags_are_errors_or_what_is_left() {
    let folder = tempfile::tempdir().unwrap();
    let messages = recording(Kind::CdrLittle);
    db3(&folder.path().join("whole.db3"), &messages);
    let options = mcap::WriteOptions::new()
        .compression(None)
        .chunk_size(Some(1500));
    let whole = mcap(options, "cdr", &messages);
    let database = fs::read(folder.path().join("whole.db3")).unwrap();
    for (name, bytes) in [
        ("a.mcap", &whole),
        ("zstd.mcap", &mcap_compressed(&whole, "zstd")),
        ("lz4.bag", &ros1("lz4", &recording(Kind::Ros1))),
        ("bz2.bag", &ros1("bz2", &recording(Kind::Ros1))),
        ("none.bag", &ros1("none", &recording(Kind::Ros1))),
        ("a.db3", &database),
    ] {
        let path = folder.path().join(name);
        assert!(read_all(&path, bytes).is_ok(), "{name}");
        for part in 0..97 {
            let _ = read_all(&path, &bytes[..part * bytes.len() / 97]);
        }
        for flipped in (0..bytes.len()).step_by(bytes.len() / 397) {
            let mut bytes = bytes.clone();
            bytes[flipped] ^= 1 << (flipped % 8);
            let _ = read_all(&path, &bytes);
        }
    }
}

#[test]
fn the_messages_of_an_interrupted_recording_are_read_or_repaired() {
    let folder = tempfile::tempdir().unwrap();
    let messages = recording(Kind::CdrLittle);
    let options = mcap::WriteOptions::new()
        .compression(None)
        .chunk_size(Some(1500));
    let whole = mcap(options, "cdr", &messages);
    let path = folder.path().join("a.mcap");
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let bag = Bag::open(&path).unwrap();
    let scans = bag.scan_times("/points").unwrap().len();
    assert!((1..5).contains(&scans), "{scans}");
    let mut bag = ros1("none", &recording(Kind::Ros1));
    let position = bag
        .windows(10)
        .position(|bytes| bytes == b"index_pos=")
        .unwrap();
    bag[position + 10..position + 18].fill(0);
    let message = read_all(&folder.path().join("a.bag"), &bag).unwrap_err();
    assert!(message.contains("rosbag reindex"), "{message}");
    let message = read_all(&folder.path().join("b.bag"), b"#ROSBAG V1.2\n").unwrap_err();
    assert!(message.contains("rosbag fix"), "{message}");
    fs::create_dir(folder.path().join("folder")).unwrap();
    let Err(error) = Bag::open(&folder.path().join("folder")) else {
        panic!("a folder without metadata.yaml");
    };
    assert!(error.to_string().contains("ros2 bag reindex"), "{error}");
}

/// Bags by other writers of a drive of KITTI: `FPMCL_PYTHON` names an interpreter with rosbags and mcap.
#[test]
fn bags_of_other_writers_have_the_points_of_the_drive() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let shared = std::env::var("FPMCL_DATA").map_or(root.join("../shared/data"), Into::into);
    let drive = shared.join("kitti-0926-drive-0005");
    let script = shared.join("../judge/make_bags.py");
    let Some(python) = std::env::var_os("FPMCL_PYTHON").filter(|_python| drive.exists()) else {
        skips::skipped(format!("FPMCL_PYTHON or {} is missing", drive.display()));
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let mut command = std::process::Command::new(python);
    command
        .arg(script)
        .arg(&drive)
        .arg(folder.path())
        .args(["0", "20"]);
    assert!(command.status().unwrap().success());
    let mut first: Option<Content> = None;
    for name in ["ros1.bag", "ros2_db3", "ros2.mcap"] {
        let bag = Bag::open(&folder.path().join(name)).unwrap();
        let (scans, poses, mounting) = content(&bag).unwrap();
        assert_eq!((scans.len(), poses.len()), (20, 20));
        for (number, scan) in scans.iter().enumerate() {
            let file = drive.join(format!("velodyne/{number:06}.bin"));
            let expected = scan_files::read(&file).unwrap();
            assert_eq!(scan.points, expected.points, "{name} {number}");
            assert_eq!(scan.intensities, expected.intensities, "{name} {number}");
            let start_s = 1_317_000_000.0 + 0.1 * number as f64;
            assert!((scan.time_s.unwrap() - start_s - 0.05).abs() < 1e-4);
            assert!((poses[number].time_s - start_s).abs() < 1e-6);
            for (point, time_s) in scan.points.iter().zip(&scan.times_s) {
                // Clockwise, from straight behind.
                let expected_s = -point.y.atan2(point.x) / std::f32::consts::TAU * 0.1;
                assert!(
                    (time_s - expected_s).abs() < 1e-4,
                    "{name} {time_s} {expected_s}"
                );
            }
            assert_eq!(scan.times_s.len(), scan.len());
            assert!(scan.rings.iter().all(|&ring| ring < 64) && scan.rings.len() == scan.len());
        }
        assert_eq!(poses[0].parent_from_child.translation.vector.norm(), 0.0);
        assert!(poses[19].parent_from_child.translation.vector.norm() > 1.0);
        let base_from_lidar = bag
            .body_from_lidar("base_link", "/points")
            .unwrap()
            .unwrap();
        assert!((base_from_lidar.translation.z - 1.73).abs() < 1e-12);
        assert_eq!(
            bag.body_from_lidar(&poses[0].child, "/points").unwrap(),
            Some(nalgebra::Isometry3::identity())
        );
        let content = (scans, poses, mounting);
        assert!(
            *first.get_or_insert_with(|| content.clone()) == content,
            "{name}"
        );
    }
}
