//! Intensities, rings and times of points: the same scan in every format, as files and as messages of a bag.

#![cfg(feature = "bags")]

use std::fs;
use std::path::Path;

use fpmcl::geometry::Vec3;
use fpmcl::internals::scan_files;
use fpmcl::lidar::Scan;
use fpmcl::recording::{Bag, PoseTrack, Recording};

use crate::bag_writers::{Cloud, Kind, Recorded, mcap, point_cloud2};

const START_NS: u64 = 1_700_000_000_250_000_000;

/// x, y, z, intensity; ring; time after the stamp [s].
type Point = ([f32; 4], u16, f32);

/// Four beams over 0.1 s, with a point that is none.
fn points(scan: u64) -> Vec<Point> {
    let point = |i: u16| {
        let azimuth_rad = 0.035 * f32::from(i / 4);
        let (sin, cos) = azimuth_rad.sin_cos();
        let x = if i == 7 { f32::NAN } else { 9.0 * cos };
        let z = f32::from(i % 4) - scan as f32;
        let time_s = 0.1 * f32::from(i) / 719.0;
        ([x, 9.0 * sin, z, f32::from(i % 11)], i % 4, time_s)
    };
    (0..720).map(point).collect()
}

/// The numbers of the points one after the other, as float32, but the ring as uint16.
fn binary(points: &[Point], is_big_endian: bool) -> Vec<u8> {
    let mut data = Vec::new();
    let mut push = |mut number: Vec<u8>| {
        if is_big_endian {
            number.reverse();
        }
        data.extend(number);
    };
    for ([x, y, z, intensity], ring, time_s) in points {
        for number in [x, y, z, intensity] {
            push(number.to_le_bytes().to_vec());
        }
        push(ring.to_le_bytes().to_vec());
        push(time_s.to_le_bytes().to_vec());
    }
    data
}

fn text(points: &[Point]) -> Vec<u8> {
    let line = |([x, y, z, intensity], ring, time_s): &Point| {
        format!("{x} {y} {z} {intensity} {ring} {time_s}\n")
    };
    points.iter().map(line).collect::<String>().into_bytes()
}

fn pcd(points: &[Point], kind: &str) -> Vec<u8> {
    let header = format!(
        "VERSION 0.7\nFIELDS x y z intensity channel time_stamp\nSIZE 4 4 4 4 2 4\nTYPE F F F F U F\n\
         COUNT 1 1 1 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {kind}\n",
        points.len()
    );
    let data = match kind {
        "ascii" => text(points),
        _ => binary(points, false),
    };
    [header.into_bytes(), data].concat()
}

fn ply(points: &[Point], kind: &str) -> Vec<u8> {
    let header = format!(
        "ply\nformat {kind} 1.0\ncomment written by a test\nelement vertex {}\nproperty float x\n\
         property float y\nproperty float z\nproperty float scalar_intensity\n\
         property ushort ring\nproperty float t\nend_header\n",
        points.len()
    );
    let data = match kind {
        "ascii" => text(points),
        _ => binary(points, kind == "binary_big_endian"),
    };
    [header.into_bytes(), data].concat()
}

fn npy(points: &[Point], order: char) -> Vec<u8> {
    let field = |(name, kind)| format!("('{name}', '{order}{kind}')");
    let fields = [
        ("x", "f4"),
        ("y", "f4"),
        ("z", "f4"),
        ("reflectivity", "f4"),
        ("line", "u2"),
        ("timestamp", "f4"),
    ];
    let header = format!(
        "{{'descr': [{}], 'fortran_order': False, 'shape': ({},), }}\n",
        fields.map(field).join(", "),
        points.len()
    );
    let length = (header.len() as u16).to_le_bytes();
    let start = [b"\x93NUMPY\x01\x00".as_slice(), &length].concat();
    [start, header.into_bytes(), binary(points, order == '>')].concat()
}

/// Names of the formats, and the files of a scan.
fn files(points: &[Point]) -> [(&'static str, &'static str, Vec<u8>); 7] {
    [
        ("binary", "pcd", pcd(points, "binary")),
        ("ascii", "pcd", pcd(points, "ascii")),
        ("ascii", "ply", ply(points, "ascii")),
        ("little", "ply", ply(points, "binary_little_endian")),
        ("big", "ply", ply(points, "binary_big_endian")),
        ("little", "npy", npy(points, '<')),
        ("big", "npy", npy(points, '>')),
    ]
}

/// A bag of scans, 0.1 s apart.
fn bag(path: &Path, scans: u64) {
    let message = |scan| {
        let time_ns = START_NS + 100_000_000 * scan;
        let cloud = Cloud::of(&points(scan));
        Recorded {
            topic: "/points",
            message_type: "sensor_msgs/msg/PointCloud2",
            time_ns,
            data: point_cloud2(Kind::CdrLittle, time_ns, "lidar", &cloud),
        }
    };
    let messages: Vec<Recorded> = (0..scans).map(message).collect();
    let options = mcap::WriteOptions::new().compression(None);
    fs::write(path, mcap(options, "cdr", &messages)).unwrap();
}

fn assert_same(found: &Scan, expected: &Scan, name: &str) {
    let moments = [found, expected].map(|scan| scan.time_s.unwrap());
    assert!(
        (moments[0] - moments[1]).abs() < 1e-6,
        "{name}: {moments:?}"
    );
    assert_eq!(found.points, expected.points, "{name}");
    assert_eq!(found.intensities, expected.intensities, "{name}");
    assert_eq!(found.rings, expected.rings, "{name}");
    assert_eq!(found.times_s.len(), expected.times_s.len(), "{name}");
    for (time_s, expected_s) in found.times_s.iter().zip(&expected.times_s) {
        // Decimals of a text are of double precision.
        assert!((time_s - expected_s).abs() < 1e-7, "{name}");
    }
}

#[test]
fn the_same_points_are_the_same_scan_in_files_and_in_messages() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("one.mcap");
    bag(&path, 1);
    let expected = Bag::open(&path).unwrap().read_scan("/points", 0).unwrap();
    assert_eq!((expected.len(), expected.rings.len()), (719, 719));
    assert!((expected.times_s[0] + 0.05).abs() < 1e-6);
    for (kind, extension, bytes) in files(&points(0)) {
        let path = folder.path().join("scan").with_extension(extension);
        fs::write(&path, bytes).unwrap();
        let stamp_s = 1e-9 * START_NS as f64;
        let read = scan_files::read_stamped(&path, Some(stamp_s)).unwrap();
        let name = format!("{extension}, {kind}");
        assert!(!read.has_unknown_times, "{name}");
        let mut scan = read.scan;
        assert_eq!(scan.len(), 720, "{name}");
        scan.drop_not_finite();
        assert_same(&scan, &expected, &name);
        // Without a stamp, the times are the same.
        let unstamped = scan_files::read(&path).unwrap();
        assert_eq!(
            (unstamped.times_s[0], unstamped.time_s),
            (scan.times_s[0], None)
        );
    }
}

#[test]
fn files_with_times_as_names_are_compensated_as_a_bag_is() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let poses: String = (0..40)
        .map(|row| {
            let time_s = 1_699_999_999.0 + 0.05 * f64::from(row);
            let x = 0.1 * f64::from(row * row);
            format!("{time_s:.3} {x} 0 0 0 0 0 1\n")
        })
        .collect();
    fs::write(folder.join("poses.tum"), poses).unwrap();
    let compensated = |path: &Path| {
        let track = PoseTrack::read(&folder.join("poses.tum"), None).unwrap();
        let recording = Recording::open(path).unwrap();
        recording.with_poses(track).unwrap().compensated_by_poses()
    };
    bag(&folder.join("drive.mcap"), 3);
    let bag = compensated(&folder.join("drive.mcap"));
    for format in 0..7 {
        let scans = folder.join(format!("{format}"));
        fs::create_dir(&scans).unwrap();
        for scan in 0..3 {
            let (_, extension, bytes) = files(&points(scan)).into_iter().nth(format).unwrap();
            let name = format!("{}.{extension}", START_NS + 100_000_000 * scan);
            fs::write(scans.join(name), bytes).unwrap();
        }
        let files = compensated(&scans);
        for (file, message) in files.frames.iter().zip(&bag.frames) {
            assert!((file.time_s - message.time_s).abs() < 1e-6, "{format}");
            let [pose, expected] = [file, message].map(|frame| frame.map_from_lidar.unwrap());
            assert!((pose.translation.vector - expected.translation.vector).norm() < 1e-5);
            let mut scan = file.read().unwrap();
            scan.drop_not_finite();
            let expected = message.read().unwrap();
            let moved: Vec<Vec3> = points(file.number as u64)
                .iter()
                .map(|([x, y, z, _], ..)| Vec3::new(*x, *y, *z))
                .filter(|point| point.is_finite())
                .collect();
            assert!(moved[0].distance(expected.points[0]) > 0.1);
            for (point, expected) in scan.points.iter().zip(&expected.points) {
                assert!(
                    point.distance(*expected) < 1e-4,
                    "{format}: {point} {expected}"
                );
            }
        }
        assert_eq!(files.frames.len(), 3);
    }
}
