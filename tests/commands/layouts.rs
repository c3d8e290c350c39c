//! Recordings in the layouts of published data sets: small folders in each, written from the formats that the data sets document, are
//! read with the points, times and poses that were written, and as KISS-ICP reads them.

use std::f64::consts::{PI, TAU};
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use fpmcl::geometry::Pose3;
use fpmcl::memory::MemoryBudget;
use fpmcl::recording::{Recording, RecordingError, Selection};
use nalgebra::{Matrix4, Translation3, UnitQuaternion, Vector3};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::common::{self, fpmcl};

const SCANS: usize = 4;

/// Time of the first scan [s].
const START_S: u64 = 1_600_000_000;

/// Time between two scans [ns].
const PERIOD_NS: u64 = 100_000_000;

/// Time of a scan, in nanoseconds since 1970.
fn stamp_ns(scan: usize) -> u64 {
    START_S * 1_000_000_000 + PERIOD_NS * scan as u64
}

/// A point as it is written.
#[derive(Clone, Copy)]
struct Point {
    position: [f32; 3],
    intensity: u8,
    ring: u8,
    /// Time after the stamp [s].
    time_s: f32,
}

/// A sweep of 16 beams, clockwise, of 3200 points; whole numbers of 5 mm, so that every format has them exactly enough.
fn sweep(scan: usize) -> Vec<Point> {
    points(scan, 200, 16)
}

fn points(scan: usize, columns: usize, rows: usize) -> Vec<Point> {
    let rounded = |metres: f64| ((metres / 0.005).round() * 0.005) as f32;
    (0..columns * rows)
        .map(|point| {
            let (column, row) = (point / rows, point % rows);
            let (sin, cos) = (-TAU * column as f64 / columns as f64).sin_cos();
            let range_m = 10.0 + 0.5 * scan as f64 + 0.1 * row as f64;
            Point {
                position: [range_m * cos, range_m * sin, 0.2 * row as f64 - 2.0].map(rounded),
                intensity: (point % 250) as u8,
                ring: row as u8,
                time_s: 0.1 * column as f32 / columns as f32,
            }
        })
        .collect()
}

/// Pose of the lidar at a scan: a curve uphill, somewhere in UTM.
fn world_from_lidar(scan: usize) -> Pose3 {
    let s = scan as f64;
    let turn = UnitQuaternion::from_euler_angles(0.01 * s, -0.02 * s, 0.4 + 0.1 * s);
    Pose3::from_parts(
        Translation3::new(3000.0 + 1.5 * s, -2000.0 + 0.4 * s, 30.0 + 0.1 * s),
        turn,
    )
}

fn matrix_row(pose: &Pose3, separator: &str) -> String {
    let matrix = pose.to_homogeneous();
    let numbers = (0..12).map(|i| format!("{:.12}", matrix[(i / 4, i % 4)]));
    numbers.collect::<Vec<_>>().join(separator)
}

fn quaternion_row(pose: &Pose3, separator: &str) -> String {
    let (t, q) = (pose.translation.vector, pose.rotation.coords);
    let numbers = [t.x, t.y, t.z, q.x, q.y, q.z, q.w].map(|number| format!("{number:.12}"));
    numbers.join(separator)
}

fn degrees(position: [f64; 3], angles: [f64; 3]) -> Pose3 {
    let [roll, pitch, yaw] = angles.map(f64::to_radians);
    let rotation = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
    Pose3::from_parts(Translation3::from(position), rotation)
}

/// What the data loader of KISS-ICP does differently, of which the documentation has the reasons.
struct Kiss {
    loader: &'static str,
    /// Other packages that the loader needs.
    modules: &'static str,
    sequence: &'static str,
    /// The folder that it is given, below the folder of the data set, if it is another than ours.
    path: Option<&'static str>,
    /// Angle by which it raises all points [deg].
    raised_deg: f64,
    /// Its points at the end that are missing.
    missing: usize,
    /// The frame of its points: `p_kiss = points_from_lidar * p_lidar`.
    points_from_lidar: Pose3,
    /// The frame of its poses.
    poses_from_lidar: Pose3,
    has_same_times: bool,
}

impl Kiss {
    fn new(loader: &'static str) -> Self {
        Self {
            loader,
            modules: "kiss_icp",
            sequence: "",
            path: None,
            raised_deg: 0.0,
            missing: 0,
            points_from_lidar: Pose3::identity(),
            poses_from_lidar: Pose3::identity(),
            has_same_times: true,
        }
    }
}

/// A data set, and what is in it.
struct DataSet {
    folder: TempDir,
    name: &'static str,
    /// What is opened, below the folder.
    path: &'static str,
    topic: Option<&'static str>,
    /// The points of a scan, in the frame of the lidar.
    points: fn(usize) -> Vec<Point>,
    has_rings: bool,
    has_times: bool,
    /// Time of a frame after the time in the name of its scan [s].
    later_s: f64,
    has_poses: bool,
    /// Largest error of a coordinate [m].
    tolerance_m: f64,
    kiss: Option<Kiss>,
}

impl DataSet {
    fn new(name: &'static str) -> Self {
        Self {
            folder: tempfile::tempdir().unwrap(),
            name,
            path: "",
            topic: None,
            points: sweep,
            has_rings: false,
            has_times: false,
            later_s: 0.0,
            has_poses: true,
            tolerance_m: 0.0,
            kiss: None,
        }
    }

    fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        let path = self.folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }

    /// Writes the scans, by their names, as records of the bytes of each point.
    fn write_scans(&self, name: impl Fn(usize) -> String, record: impl Fn(&Point) -> Vec<u8>) {
        for scan in 0..SCANS {
            let bytes: Vec<u8> = (self.points)(scan).iter().flat_map(&record).collect();
            self.write(&name(scan), bytes);
        }
    }

    /// Writes a table with a row per scan.
    fn write_rows(&self, name: &str, header: &str, row: impl Fn(usize) -> String) {
        let rows: Vec<String> = (0..SCANS).map(row).collect();
        self.write(name, format!("{header}{}\n", rows.join("\n")));
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join(self.path)
    }

    fn open(&self, layout: Option<&str>) -> Result<Recording, RecordingError> {
        let layout = layout.map(|name| name.parse().unwrap());
        let (all, budget) = (Selection::default(), MemoryBudget::default());
        Recording::open_with(&self.path(), layout, self.topic, &all, budget)
    }
}

fn floats(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().copied().flat_map(f32::to_le_bytes).collect()
}

fn position_and_intensity(point: &Point) -> Vec<u8> {
    floats(&[&point.position[..], &[f32::from(point.intensity)]].concat())
}

/// MulRan's base to Ouster, by its calibration.
fn mulran() -> DataSet {
    let base_from_lidar = degrees([1.7042, -0.021, 1.8047], [0.0001, 0.0003, 179.6654]);
    let set = DataSet {
        points: |scan| points(scan, 1024, 64),
        has_times: true,
        later_s: 0.05,
        kiss: Some(Kiss {
            // Its calibration is applied in the wrong direction.
            poses_from_lidar: base_from_lidar * base_from_lidar,
            ..Kiss::new("mulran")
        }),
        ..DataSet::new("mulran")
    };
    set.write_scans(
        |scan| format!("Ouster/{}.bin", stamp_ns(scan)),
        position_and_intensity,
    );
    set.write_rows("global_pose.csv", "", |scan| {
        let world_from_base = world_from_lidar(scan) * base_from_lidar.inverse();
        format!("{},{}", stamp_ns(scan), matrix_row(&world_from_base, ","))
    });
    set
}

/// NCLT: points and poses of the body, whose z is down.
fn nclt() -> DataSet {
    let centre = Vector3::new(0.002, -0.004, -0.957);
    let half_turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
    let body_from_lidar = Pose3::from_parts(centre.into(), half_turn);
    // KISS-ICP turns points and poses of the body, and leaves the lidar's place on it out.
    let turned = Pose3::from_parts(Translation3::identity(), half_turn) * body_from_lidar;
    let set = DataSet {
        path: "2012-01-08",
        has_rings: true,
        tolerance_m: 0.0026,
        kiss: Some(Kiss {
            modules: "kiss_icp, scipy",
            points_from_lidar: turned,
            poses_from_lidar: turned,
            ..Kiss::new("nclt")
        }),
        ..DataSet::new("nclt")
    };
    set.write_scans(
        |scan| format!("2012-01-08/velodyne_sync/{}.bin", stamp_ns(scan) / 1000),
        |point| {
            let in_body = body_from_lidar * nalgebra::Point3::from(point.position.map(f64::from));
            let step = |metres: f64| ((metres + 100.0) / 0.005).round() as u16;
            let steps = [in_body.x, in_body.y, in_body.z].map(step);
            let steps = steps.into_iter().flat_map(u16::to_le_bytes);
            steps.chain([point.intensity, point.ring]).collect()
        },
    );
    // The truth begins before the first scan and ends after the last.
    let row = |time_us: u64, scan: usize| {
        let world_from_body = world_from_lidar(scan) * body_from_lidar.inverse();
        let (t, (roll, pitch, heading)) = (
            world_from_body.translation.vector,
            world_from_body.rotation.euler_angles(),
        );
        format!(
            "{time_us},{:.12},{:.12},{:.12},{roll:.15},{pitch:.15},{heading:.15}",
            t.x, t.y, t.z
        )
    };
    let times_us: Vec<u64> = (0..SCANS).map(|scan| stamp_ns(scan) / 1000).collect();
    let mut rows = vec![row(times_us[0] - 100_000, 0)];
    rows.push(format!("{},nan,nan,nan,nan,nan,nan", times_us[0] - 50_000));
    rows.extend((0..SCANS).map(|scan| row(times_us[scan], scan)));
    rows.push(row(times_us[SCANS - 1] + 100_000, SCANS - 1));
    set.write("ground_truth/groundtruth_2012-01-08.csv", rows.join("\n"));
    set
}

/// Boreas: six numbers per point, and poses of the lidar by the angles of the inverse rotation.
fn boreas() -> DataSet {
    let set = DataSet {
        has_rings: true,
        has_times: true,
        later_s: 0.5 * 0.1 * 199.0 / 200.0,
        kiss: Some(Kiss {
            // It takes the times from azimuths.
            has_same_times: false,
            ..Kiss::new("boreas")
        }),
        ..DataSet::new("boreas")
    };
    set.write_scans(
        |scan| format!("lidar/{}.bin", stamp_ns(scan) / 1000),
        |point| {
            let rest = floats(&[f32::from(point.ring), point.time_s]);
            [position_and_intensity(point), rest].concat()
        },
    );
    let header = "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,angvel_z,angvel_y,angvel_x\n";
    set.write_rows("applanix/lidar_poses.csv", header, |scan| {
        let pose = world_from_lidar(scan);
        let (t, (roll, pitch, heading)) = (
            pose.translation.vector,
            pose.rotation.inverse().euler_angles(),
        );
        let time_us = stamp_ns(scan) / 1000;
        format!(
            "{time_us},{:.12},{:.12},{:.12},0,0,0,{roll:.15},{pitch:.15},{heading:.15},0,0,0",
            t.x, t.y, t.z
        )
    });
    set
}

/// HeLiPR: the records of each lidar, and its own poses.
fn helipr(lidar: &'static str, record: impl Fn(&Point) -> Vec<u8>) -> DataSet {
    let set = DataSet {
        topic: Some(lidar),
        has_rings: true,
        has_times: true,
        later_s: 0.5 * 0.1 * 199.0 / 200.0,
        kiss: Some(Kiss {
            sequence: lidar,
            // It leaves the last point out.
            missing: 1,
            ..Kiss::new("helipr")
        }),
        ..DataSet::new("helipr")
    };
    set.write_scans(
        |scan| format!("LiDAR/{lidar}/{}.bin", stamp_ns(scan)),
        record,
    );
    set.write_rows(&format!("LiDAR_GT/global_{lidar}_gt.txt"), "", |scan| {
        format!(
            "{} {}",
            stamp_ns(scan),
            quaternion_row(&world_from_lidar(scan), " ")
        )
    });
    // Another lidar, so that one has to be named.
    let other = if lidar == "Ouster" { "Avia" } else { "Ouster" };
    set.write(&format!("LiDAR/{other}/{}.bin", stamp_ns(0)), [0; 26]);
    set
}

/// Nanoseconds of the time of a point.
fn nanoseconds(point: &Point) -> u32 {
    (f64::from(point.time_s) * 1e9).round() as u32
}

fn helipr_velodyne() -> DataSet {
    helipr("Velodyne", |point| {
        let ring = u16::from(point.ring).to_le_bytes();
        [
            position_and_intensity(point),
            ring.into(),
            floats(&[point.time_s]),
        ]
        .concat()
    })
}

fn helipr_ouster() -> DataSet {
    helipr("Ouster", |point| {
        let time = nanoseconds(point).to_le_bytes();
        let rest = [7, u16::from(point.ring), 9].map(u16::to_le_bytes);
        [position_and_intensity(point), time.into(), rest.concat()].concat()
    })
}

fn helipr_avia() -> DataSet {
    helipr("Avia", |point| {
        let bytes = vec![point.intensity, 16, point.ring];
        [
            floats(&point.position),
            bytes,
            nanoseconds(point).to_le_bytes().into(),
        ]
        .concat()
    })
}

/// The Aeva as in the first sessions, without intensities.
fn helipr_aeva() -> DataSet {
    helipr("Aeva", |point| {
        let time = nanoseconds(point).to_le_bytes();
        let velocity = floats(&[-0.5]);
        let rest = [velocity, time.into(), vec![point.ring]].concat();
        [position_and_intensity(point), rest].concat()
    })
}

/// Newer College: scans of whole turns as PCD, and poses of the base.
fn newer_college() -> DataSet {
    let rotation =
        UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(0.383, 0.0, 0.0, 0.924));
    let base_from_lidar = Pose3::from_parts(Translation3::new(-0.084, -0.025, 0.050), rotation);
    let set = DataSet {
        points: |scan| points(scan, 1024, 64),
        has_times: true,
        later_s: 0.05,
        kiss: Some(Kiss {
            modules: "kiss_icp, pyntcloud",
            ..Kiss::new("ncd")
        }),
        ..DataSet::new("ncd")
    };
    for scan in 0..SCANS {
        let (seconds, rest) = (
            stamp_ns(scan) / 1_000_000_000,
            stamp_ns(scan) % 1_000_000_000,
        );
        let name = format!("raw_format/ouster_scan/cloud_{seconds}_{rest}.pcd");
        set.write(&name, pcd(&(set.points)(scan)));
    }
    let header = "#sec,nsec,x,y,z,qx,qy,qz,qw\n";
    set.write_rows("ground_truth/registered_poses.csv", header, |scan| {
        let world_from_base = world_from_lidar(scan) * base_from_lidar.inverse();
        let (seconds, rest) = (
            stamp_ns(scan) / 1_000_000_000,
            stamp_ns(scan) % 1_000_000_000,
        );
        format!("{seconds},{rest},{}", quaternion_row(&world_from_base, ","))
    });
    set
}

/// A scan as PCD.
fn pcd(points: &[Point]) -> String {
    let count = points.len();
    let mut text = format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {count}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA ascii\n"
    );
    for point in points {
        let [x, y, z] = point.position;
        writeln!(text, "{x} {y} {z} {}", point.intensity).unwrap();
    }
    text
}

/// Apollo-SouthBay: scans numbered from 1, whose rows have their times.
fn apollo() -> DataSet {
    let set = DataSet::new("apollo");
    for scan in 0..SCANS {
        let name = format!("pcds/{}.pcd", scan + 1);
        set.write(&name, pcd(&(set.points)(scan)));
    }
    set.write_rows("poses/gt_poses.txt", "", |scan| {
        let time_s = stamp_ns(scan) as f64 * 1e-9;
        format!(
            "{} {time_s:.6} {}",
            scan + 1,
            quaternion_row(&world_from_lidar(scan), " ")
        )
    });
    set
}

/// Paris-Luco: PLY with times, and positions as the truth.
fn paris_luco() -> DataSet {
    let set = DataSet {
        has_times: true,
        has_poses: false,
        ..DataSet::new("paris_luco")
    };
    for scan in 0..SCANS {
        let points = (set.points)(scan);
        let mut text = format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nproperty float intensity\n\
             property double timestamp\nend_header\n",
            points.len()
        );
        for point in &points {
            let [x, y, z] = point.position;
            writeln!(text, "{x} {y} {z} {} {}", point.intensity, point.time_s).unwrap();
        }
        set.write(&format!("frames/frame_{scan:04}.ply"), text);
    }
    set.write_rows("gt_traj_lidar.txt", "", |scan| {
        let t = world_from_lidar(scan).translation.vector;
        format!("{} {} {}", t.x, t.y, t.z)
    });
    set
}

/// KITTI-360: the layout of KITTI raw, poses of the IMU of some frames, and the lidar by the camera.
fn kitti360() -> DataSet {
    let set = DataSet {
        path: "data_3d_raw/2013_05_28_drive_0000_sync",
        ..DataSet::new("kitti360")
    };
    let imu_from_cam0 = degrees([1.57, 0.04, -0.2], [-90.0, 1.0, -90.0]);
    let lidar_from_cam0 = degrees([0.77, 0.29, -0.08], [-91.0, 0.5, -89.0]);
    set.write_scans(
        |scan| format!("{}/velodyne_points/data/{scan:010}.bin", set.path),
        position_and_intensity,
    );
    set.write_rows(
        &format!("{}/velodyne_points/timestamps.txt", set.path),
        "",
        |scan| format!("2020-09-13 12:26:40.{scan}00000000"),
    );
    set.write_rows(
        "data_poses/2013_05_28_drive_0000_sync/poses.txt",
        "",
        |scan| {
            let imu_from_lidar = imu_from_cam0 * lidar_from_cam0.inverse();
            let world_from_imu = world_from_lidar(scan) * imu_from_lidar.inverse();
            format!("{scan} {}", matrix_row(&world_from_imu, " "))
        },
    );
    let cameras = [("image_00", imu_from_cam0), ("image_01", Pose3::identity())];
    let rows = cameras.map(|(name, pose)| format!("{name}: {}\n", matrix_row(&pose, " ")));
    set.write("calibration/calib_cam_to_pose.txt", rows.concat());
    set.write(
        "calibration/calib_cam_to_velo.txt",
        matrix_row(&lidar_from_cam0, " "),
    );
    set
}

/// KITTI's odometry benchmark, with the poses in their own folder.
fn kitti() -> DataSet {
    let cam0_from_lidar = degrees([-0.01, -0.05, -0.3], [90.0, -89.0, 1.0]);
    let set = DataSet {
        path: "sequences/00",
        kiss: Some(Kiss {
            sequence: "0",
            path: Some(""),
            raised_deg: 0.205,
            ..Kiss::new("kitti")
        }),
        ..DataSet::new("kitti")
    };
    set.write_scans(
        |scan| format!("sequences/00/velodyne/{scan:06}.bin"),
        position_and_intensity,
    );
    set.write_rows("sequences/00/times.txt", "", |scan| {
        format!("{:.6}", stamp_ns(scan) as f64 * 1e-9)
    });
    set.write(
        "sequences/00/calib.txt",
        format!("Tr: {}\n", matrix_row(&cam0_from_lidar, " ")),
    );
    let first = world_from_lidar(0) * cam0_from_lidar.inverse();
    set.write_rows("poses/00.txt", "", |scan| {
        let world_from_cam0 = world_from_lidar(scan) * cam0_from_lidar.inverse();
        matrix_row(&(first.inverse() * world_from_cam0), " ")
    });
    set
}

/// KITTI's raw data, with poses of the IMU as latitude, longitude, altitude and angles.
fn kitti_raw() -> DataSet {
    let lidar_from_imu = degrees([-0.81, 0.32, -0.8], [0.1, -0.1, 0.8]);
    let set = DataSet {
        path: "2011_10_03/2011_10_03_drive_0027_sync",
        kiss: Some(Kiss {
            sequence: "0",
            path: Some(""),
            raised_deg: 0.205,
            // It takes the times from azimuths.
            has_same_times: false,
            ..Kiss::new("kitti_raw")
        }),
        ..DataSet::new("kitti_raw")
    };
    let path = set.path;
    set.write_scans(
        |scan| format!("{path}/velodyne_points/data/{scan:010}.bin"),
        position_and_intensity,
    );
    set.write_rows(
        &format!("{path}/velodyne_points/timestamps.txt"),
        "",
        |scan| format!("2020-09-13 12:26:40.{scan}00000000"),
    );
    let first_lat_rad = 49_f64.to_radians();
    let scale_m = 6_378_137.0 * first_lat_rad.cos();
    let north_m = |lat_rad: f64| scale_m * (PI / 4.0 + lat_rad / 2.0).tan().ln();
    let first = world_from_lidar(0) * lidar_from_imu;
    for scan in 0..SCANS {
        let pose = world_from_lidar(scan) * lidar_from_imu;
        let t = pose.translation.vector;
        let y = north_m(first_lat_rad) + t.y - first.translation.y;
        let lat = (2.0 * (y / scale_m).exp().atan() - PI / 2.0).to_degrees();
        let lon = (t.x / scale_m).to_degrees();
        let (roll, pitch, yaw) = pose.rotation.euler_angles();
        let rest = ["0"; 24].join(" ");
        let row = format!(
            "{lat:.16} {lon:.16} {:.12} {roll:.15} {pitch:.15} {yaw:.15} {rest}\n",
            t.z
        );
        set.write(&format!("{path}/oxts/data/{scan:010}.txt"), row);
    }
    let rigid = |pose: &Pose3| {
        let matrix = pose.to_homogeneous();
        let rotation = (0..9).map(|i| format!("{:.12}", matrix[(i / 3, i % 3)]));
        let rotation = rotation.collect::<Vec<_>>().join(" ");
        let t = pose.translation.vector;
        format!(
            "calib_time: 15-Mar-2012 11:37:16\nR: {rotation}\nT: {} {} {}\n",
            t.x, t.y, t.z
        )
    };
    set.write("2011_10_03/calib_imu_to_velo.txt", rigid(&lidar_from_imu));
    set.write(
        "2011_10_03/calib_velo_to_cam.txt",
        rigid(&Pose3::identity()),
    );
    let cameras: String = (0..4)
        .map(|camera| {
            format!("P_rect_0{camera}: 700 0 600 0 0 700 180 0 0 0 1 0\nR_rect_0{camera}: 1 0 0 0 1 0 0 0 1\n")
        })
        .collect();
    set.write("2011_10_03/calib_cam_to_cam.txt", cameras);
    set
}

/// A folder of scans: positions and intensities as KITTI has them.
fn generic_bin() -> DataSet {
    let set = DataSet {
        has_poses: false,
        kiss: Some(Kiss::new("generic")),
        ..DataSet::new("generic")
    };
    set.write_scans(|scan| format!("{scan:06}.bin"), position_and_intensity);
    set
}

/// A folder of scans as PCD.
fn generic_pcd() -> DataSet {
    let set = DataSet {
        has_poses: false,
        kiss: Some(Kiss {
            modules: "kiss_icp, pyntcloud",
            ..Kiss::new("generic")
        }),
        ..DataSet::new("generic")
    };
    for scan in 0..SCANS {
        set.write(&format!("{scan:06}.pcd"), pcd(&(set.points)(scan)));
    }
    set
}

/// nuScenes: two scenes in the tables, of which one is chosen, and a camera that is none of the sweeps.
fn nuscenes() -> DataSet {
    let set = DataSet {
        topic: Some("scene-0061"),
        has_rings: true,
        kiss: Some(Kiss {
            modules: "kiss_icp, nuscenes",
            sequence: "61",
            ..Kiss::new("nuscenes")
        }),
        ..DataSet::new("nuscenes")
    };
    let ego_from_lidar = degrees([0.94, 0.0, 1.84], [0.5, -0.3, -90.0]);
    let file = |scan: usize| {
        let folder = if scan == 0 { "samples" } else { "sweeps" };
        let time_us = stamp_ns(scan) / 1000;
        format!("{folder}/LIDAR_TOP/n015-2018-07-24-11-22-45+0800__LIDAR_TOP__{time_us}.pcd.bin")
    };
    set.write_scans(file, |point| {
        [
            position_and_intensity(point),
            floats(&[f32::from(point.ring)]),
        ]
        .concat()
    });
    let transform = |pose: &Pose3| {
        let (t, q) = (pose.translation.vector, pose.rotation.coords);
        ([t.x, t.y, t.z], [q.w, q.x, q.y, q.z])
    };
    write_names_of_nuscenes(&set);
    let table = |name: &str, records: Value| {
        set.write(&format!("v1.0-mini/{name}.json"), records.to_string());
    };
    let (translation, rotation) = transform(&ego_from_lidar);
    let calibrated = |token: &str, sensor: &str| {
        json!({"token": token, "sensor_token": sensor, "translation": translation, "rotation": rotation,
            "camera_intrinsic": []})
    };
    table(
        "calibrated_sensor",
        json!([calibrated("c", "camera"), calibrated("l", "lidar")]),
    );
    let data = |token: String, sample: &str, calibrated: &str, scan: usize, file: String| {
        let next = if calibrated == "l" && scan + 1 < SCANS && sample == "key1" {
            format!("sweep{}", scan + 1)
        } else {
            String::new()
        };
        json!({"token": token, "sample_token": sample, "ego_pose_token": format!("ego{scan}"),
            "calibrated_sensor_token": calibrated, "timestamp": stamp_ns(scan) / 1000, "fileformat": "pcd", "is_key_frame": scan == 0,
            "height": 0, "width": 0, "filename": file, "prev": "", "next": next})
    };
    // In another order than that of time.
    let mut measured: Vec<Value> = (0..SCANS)
        .rev()
        .map(|scan| data(format!("sweep{scan}"), "key1", "l", scan, file(scan)))
        .collect();
    measured.push(data(
        "other".into(),
        "key2",
        "l",
        0,
        "samples/LIDAR_TOP/other.pcd.bin".into(),
    ));
    measured.push(data(
        "image".into(),
        "key1",
        "c",
        0,
        "samples/CAM_FRONT/image.jpg".into(),
    ));
    table("sample_data", json!(measured));
    let ego = |scan: usize| {
        let world_from_ego = world_from_lidar(scan) * ego_from_lidar.inverse();
        let (translation, rotation) = transform(&world_from_ego);
        json!({"token": format!("ego{scan}"), "timestamp": stamp_ns(scan) / 1000, "rotation": rotation, "translation": translation})
    };
    table("ego_pose", (0..SCANS).map(ego).collect());
    set
}

/// The tables of scenes, moments and sensors of nuScenes, and those that are not read.
fn write_names_of_nuscenes(set: &DataSet) {
    let table = |name: &str, records: Value| {
        set.write(&format!("v1.0-mini/{name}.json"), records.to_string());
    };
    let scene = |token: &str, name: &str, first: &str| {
        json!({"token": token, "log_token": "log", "nbr_samples": 1, "first_sample_token": first, "last_sample_token": first,
            "name": name, "description": ""})
    };
    // The development kit wants all scenes of the mini split.
    let others = [103, 553, 655, 757, 796, 1077, 1094, 1100]
        .map(|number| scene(&format!("s{number}"), &format!("scene-{number:04}"), "key2"));
    let scenes: Vec<Value> = [scene("s61", "scene-0061", "key1")]
        .into_iter()
        .chain(others)
        .collect();
    table("scene", json!(scenes));
    let sample = |token: &str, scene: &str| json!({"token": token, "timestamp": stamp_ns(0) / 1000, "prev": "", "next": "", "scene_token": scene});
    table(
        "sample",
        json!([sample("key1", "s61"), sample("key2", "s103")]),
    );
    let sensor = |token: &str, channel: &str, modality: &str| json!({"token": token, "channel": channel, "modality": modality});
    table(
        "sensor",
        json!([
            sensor("camera", "CAM_FRONT", "camera"),
            sensor("lidar", "LIDAR_TOP", "lidar")
        ]),
    );
    table(
        "log",
        json!([{"token": "log", "logfile": "n015-2018-07-24-11-22-45+0800", "vehicle": "n015", "date_captured": "2018-07-24",
            "location": "singapore-onenorth"}]),
    );
    for name in [
        "attribute",
        "category",
        "instance",
        "sample_annotation",
        "visibility",
    ] {
        table(name, json!([]));
    }
    table(
        "map",
        json!([{"token": "map", "log_tokens": ["log"], "category": "", "filename": ""}]),
    );
}

/// All layouts.
fn data_sets() -> Vec<DataSet> {
    vec![
        kitti(),
        kitti_raw(),
        kitti360(),
        mulran(),
        nclt(),
        boreas(),
        helipr_velodyne(),
        helipr_ouster(),
        helipr_avia(),
        helipr_aeva(),
        newer_college(),
        nuscenes(),
        apollo(),
        paris_luco(),
        generic_bin(),
        generic_pcd(),
    ]
}

/// Poses relative to the first, in another frame: `C · inv(P₀) Pᵢ · inv(C)`.
fn relative(poses: &[Pose3], other_from_lidar: &Pose3) -> Vec<Pose3> {
    let relative = |pose: &Pose3| poses[0].inverse() * pose;
    let poses = poses.iter().map(relative);
    poses
        .map(|pose| other_from_lidar * pose * other_from_lidar.inverse())
        .collect()
}

#[track_caller]
fn assert_same_poses(name: &str, found: &[Pose3], expected: &[Pose3], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{name}");
    for (found, expected) in found.iter().zip(expected) {
        let difference = found.to_homogeneous() - expected.to_homogeneous();
        assert!(
            difference.abs().max() < tolerance,
            "{name}: {found} {expected}"
        );
    }
}

#[test]
fn measurements_are_given_by_the_folder_of_kitti() {
    let set = kitti_raw();
    for flag in ["--imu", "--gnss"] {
        // It is read up to what it lacks.
        let odometry = fpmcl("odometry").in_folder(set.folder.path());
        let odometry = odometry.with(set.path).with("--output=found");
        let oxts = format!("{flag}={}/oxts", set.path);
        odometry.with(oxts).fails_with(&["oxts/timestamps.txt"]);
    }
}

#[test]
fn the_folder_of_kitti_has_the_rates_forces_and_positions_that_were_written() {
    const ROWS: usize = 25;
    let set = kitti_raw();
    let oxts = format!("{}/oxts", set.path);
    // Each number shows its column and its row.
    let number = |column: usize, row: usize| column as f64 + 0.001 * row as f64;
    let mut times = String::new();
    for row in 0..ROWS {
        let numbers: Vec<String> = (0..30)
            .map(|column| match (column, row) {
                (0, _) => format!("{}", 49.0 + 1e-5 * row as f64),
                // The accuracy of one position is not known.
                (23, 1) => "0".to_owned(),
                _ => format!("{}", number(column, row)),
            })
            .collect();
        set.write(&format!("{oxts}/data/{row:010}.txt"), numbers.join(" "));
        let (second, tenth) = (40 + row / 10, row % 10);
        writeln!(times, "2020-09-13 12:26:{second}.{tenth}00000000").unwrap();
    }
    set.write(&format!("{oxts}/timestamps.txt"), times);
    let recording = set.open(None).unwrap();
    let oxts = set.folder.path().join(&oxts);

    let imu = recording.read_imu(&oxts, None).unwrap();
    let fixes = recording.read_fixes(&oxts).unwrap();
    assert_eq!((imu.samples.rows().len(), fixes.fixes.len()), (ROWS, ROWS));
    for row in 0..ROWS {
        let time_s = START_S as f64 + 0.1 * row as f64;
        let (sample, fix) = (imu.samples.rows()[row], fixes.fixes[row]);
        assert!((sample.time_s - time_s).abs() < 1e-6);
        assert_eq!(fix.time_s, sample.time_s);
        // ax ay az, not af al au; wx wy wz, not wf wl wu.
        let at = |columns: [usize; 3]| Vector3::from(columns.map(|column| number(column, row)));
        assert_eq!(sample.force_m_s2, at([11, 12, 13]));
        assert_eq!(sample.rate_rad_s, at([17, 18, 19]));
        assert_eq!(fix.position.latitude_deg, 49.0 + 1e-5 * row as f64);
        assert_eq!(fix.position.longitude_deg, number(1, row));
        assert_eq!(fix.position.height_m, number(2, row));
        let accuracy_m = (row != 1).then(|| number(23, row));
        assert_eq!((fix.horizontal_m, fix.vertical_m), (accuracy_m, accuracy_m));
    }
    // By `calib_imu_to_velo.txt`.
    let lidar_from_imu = degrees([-0.81, 0.32, -0.8], [0.1, -0.1, 0.8]);
    let found = imu.lidar_from_imu.unwrap();
    assert!(found.angle_to(&lidar_from_imu.rotation) < 1e-6, "{found}");
    let antenna_m = Vector3::from(fixes.antenna_m.unwrap());
    assert!((antenna_m - lidar_from_imu.translation.vector).norm() < 1e-6);
    // A row without a time.
    set.write(
        &format!("{}/oxts/data/{ROWS:010}.txt", set.path),
        "49 8 110 0 0 0",
    );
    let error = recording.read_fixes(&oxts).unwrap_err().to_string();
    assert!(error.contains("timestamps.txt"), "{error}");
}

#[test]
fn every_layout_has_the_points_times_and_poses_that_were_written() {
    let expected: Vec<Pose3> = (0..SCANS).map(world_from_lidar).collect();
    let expected = relative(&expected, &Pose3::identity());
    for set in data_sets() {
        let name = set.name;
        // By its files, and by its name.
        let recording = set.open(None).unwrap();
        assert_eq!(
            format!("{:?}", recording.files.layout),
            format!("{:?}", set.open(Some(name)).unwrap().files.layout)
        );
        assert_eq!(recording.frames.len(), SCANS, "{name}");
        for (scan, frame) in recording.frames.iter().enumerate() {
            let written = (set.points)(scan);
            let read = frame.read().unwrap();
            assert_eq!(read.points.len(), written.len(), "{name}");
            for (found, point) in read.points.iter().zip(&written) {
                for (found, expected) in found.to_array().iter().zip(point.position) {
                    let error_m = f64::from((found - expected).abs());
                    assert!(error_m <= set.tolerance_m, "{name}: {found} {expected}");
                }
            }
            let intensities = written.iter().map(|point| f32::from(point.intensity));
            assert!(intensities.eq(read.intensities.iter().copied()), "{name}");
            let rings = written.iter().map(|point| u16::from(point.ring));
            assert!(
                !set.has_rings && read.rings.is_empty() || rings.eq(read.rings.iter().copied()),
                "{name}"
            );
            assert_eq!(read.times_s.is_empty(), !set.has_times, "{name}");
            for (found, point) in read.times_s.iter().zip(&written) {
                let after_first_s = found - read.times_s[0];
                assert!((after_first_s - point.time_s).abs() < 1e-6, "{name}");
            }
            if recording.has_times {
                let expected_s = stamp_ns(scan) as f64 * 1e-9 + set.later_s;
                assert!(
                    (frame.time_s - expected_s).abs() < 1e-4,
                    "{name}: {} {expected_s}",
                    frame.time_s
                );
            }
        }
        assert_eq!(recording.files.poses.is_some(), set.has_poses, "{name}");
        if set.has_poses {
            let mut track = recording.own_track().unwrap();
            // NCLT's truth begins and ends beyond the scans.
            if track.map_from_lidar.len() == SCANS + 2 {
                track.map_from_lidar = track.map_from_lidar[1..=SCANS].to_vec();
            }
            let found = relative(&track.map_from_lidar, &Pose3::identity());
            assert_same_poses(name, &found, &expected, 1e-6);
            // The same poses, given as a file.
            let path = recording.files.poses.clone().unwrap();
            let calibration = recording.files.calibration.as_deref();
            let given = recording.read_track(&path, calibration.filter(|it| it.is_file()));
            assert_eq!(given.unwrap(), recording.own_track().unwrap(), "{name}");
            let with_poses = recording.with_own_poses().unwrap();
            assert!(with_poses.frames.len() >= SCANS - 1, "{name}");
        }
    }
}

/// The numbers of an array in JSON.
fn numbers(value: &Value) -> Vec<f64> {
    let values = value.as_array().unwrap();
    values
        .iter()
        .map(|number| number.as_f64().unwrap())
        .collect()
}

#[test]
fn every_layout_is_read_as_kiss_icp_reads_it() {
    for set in data_sets() {
        let Some(kiss) = &set.kiss else { continue };
        let Some(python) = common::python_with(kiss.modules, "kiss_icp") else {
            common::skips::skipped(format!("{}: no Python has {}", set.name, kiss.modules));
            continue;
        };
        let folder = set.folder.path().join(kiss.path.unwrap_or(set.path));
        let folder = folder.to_str().unwrap();
        let theirs = run_python(&python, "read.py", &[kiss.loader, folder, kiss.sequence]);
        compare_with_kiss_icp(&set, kiss, &serde_json::from_str(&theirs).unwrap());
    }
}

/// Runs a script of `tests/kiss_icp`, and returns what it prints.
#[track_caller]
fn run_python(python: &Path, script: &str, arguments: &[&str]) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/kiss_icp");
    let mut command = std::process::Command::new(python);
    let command = command.arg(folder.join(script)).args(arguments);
    let output = command.output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{script} {arguments:?}: {stderr}");
    String::from_utf8(output.stdout).unwrap()
}

#[cfg(feature = "bags")]
#[test]
fn bags_are_read_as_kiss_icp_reads_them() {
    let modules = "kiss_icp, rosbags";
    let Some(python) = common::python_with(modules, "kiss_icp") else {
        common::skips::skipped(format!("bags: no Python has {modules}"));
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    run_python(&python, "write_bags.py", &[folder.path().to_str().unwrap()]);
    for name in ["ros1.bag", "sqlite", "mcap"] {
        let path = folder.path().join(name);
        let theirs = run_python(&python, "read.py", &["rosbag", path.to_str().unwrap()]);
        let theirs: Value = serde_json::from_str(&theirs).unwrap();
        let (scans, stamps_s) = (&theirs["scans"], numbers(&theirs["stamps"]));
        let ours = Recording::open(&path).unwrap();
        assert_eq!((ours.frames.len(), stamps_s.len()), (SCANS, SCANS));
        for (scan, frame) in ours.frames.iter().enumerate() {
            let ours = frame.read().unwrap();
            let points = scans[scan]["points"].as_array().unwrap();
            assert_eq!((ours.points.len(), points.len()), (3200, 3200), "{name}");
            for (ours, theirs) in ours.points.iter().zip(points) {
                assert_eq!(ours.to_array().map(f64::from), *numbers(theirs), "{name}");
            }
            // Ours are after the moment of the scan, theirs as in the message, after its stamp.
            let times_s = numbers(&scans[scan]["times"]);
            assert_eq!((ours.times_s.len(), times_s.len()), (3200, 3200), "{name}");
            for (after_s, theirs_s) in ours.times_s.iter().zip(times_s) {
                let ours_s = ours.time_s.unwrap() + f64::from(*after_s);
                assert!((ours_s - stamps_s[scan] - theirs_s).abs() < 1e-4, "{name}");
            }
        }
    }
    // The file in the folder is the same bag.
    let [of_folder, of_file] = ["mcap", "mcap/mcap.mcap"].map(|name| {
        let recording = Recording::open(folder.path().join(name)).unwrap();
        recording.frames[1].read().unwrap()
    });
    assert_eq!(of_folder, of_file);
}

fn compare_with_kiss_icp(set: &DataSet, kiss: &Kiss, theirs: &Value) {
    let name = set.name;
    let recording = set.open(None).unwrap();
    let recording = recording.with_elevation_bias(kiss.raised_deg.to_radians());
    let scans = theirs["scans"].as_array().unwrap();
    assert_eq!(scans.len(), recording.frames.len(), "{name}");
    for (frame, theirs) in recording.frames.iter().zip(scans) {
        let ours = frame.read().unwrap();
        let points = theirs["points"].as_array().unwrap();
        assert_eq!(points.len() + kiss.missing, ours.points.len(), "{name}");
        for (ours, theirs) in ours.points.iter().zip(points) {
            let ours = nalgebra::Point3::from(ours.to_array().map(f64::from));
            let ours = kiss.points_from_lidar * ours;
            for (ours, theirs) in ours.coords.iter().zip(numbers(theirs)) {
                assert!((ours - theirs).abs() < 2e-5, "{name}: {ours} {theirs}");
            }
        }
        let times = numbers(&theirs["times"]);
        if kiss.has_same_times {
            assert_eq!(times.is_empty(), ours.times_s.is_empty(), "{name}");
            // Theirs are shares of the sweep.
            let share = |time_s: &f32| f64::from(time_s - ours.times_s[0]);
            let sweep_s = if times.last().is_some_and(|&last| last == 1.0) {
                0.1 * 199.0 / 200.0
            } else {
                0.1
            };
            for (ours, theirs) in ours.times_s.iter().map(share).zip(&times) {
                assert!(
                    (ours - theirs * sweep_s).abs() < 1e-6,
                    "{name}: {ours} {theirs}"
                );
            }
        }
    }
    if !set.has_poses {
        assert!(theirs["poses"].is_null(), "{name}");
        return;
    }
    let poses: Vec<Pose3> = (theirs["poses"].as_array().unwrap().iter())
        .map(|rows| {
            let rows: Vec<f64> = rows.as_array().unwrap().iter().flat_map(numbers).collect();
            let matrix = Matrix4::from_row_slice(&rows);
            let rotation = matrix.fixed_view::<3, 3>(0, 0).into_owned();
            let rotation = UnitQuaternion::from_matrix(&rotation);
            Pose3::from_parts(
                matrix.fixed_view::<3, 1>(0, 3).into_owned().into(),
                rotation,
            )
        })
        .collect();
    let recording = recording.with_own_poses().unwrap();
    let track = recording.track.unwrap();
    let mut ours = track.map_from_lidar;
    if ours.len() == SCANS + 2 {
        ours = ours[1..=SCANS].to_vec();
    }
    let ours = relative(&ours, &kiss.poses_from_lidar);
    // Theirs are partly in single precision, in metres of a local frame or of the world.
    assert_same_poses(name, &relative(&poses, &Pose3::identity()), &ours, 1e-3);
}

#[test]
fn one_of_several_lidars_or_scenes_has_to_be_named() {
    let mut set = helipr_avia();
    set.topic = None;
    let message = set.open(None).unwrap_err().to_string();
    assert!(
        message.contains("several lidars; choose one of: Avia, Ouster"),
        "{message}"
    );
    set.topic = Some("Velodyne");
    let message = set.open(None).unwrap_err().to_string();
    assert!(message.contains("none is Velodyne"), "{message}");
    // Its folder names it as well.
    set.topic = None;
    set.path = "LiDAR/Avia";
    assert_eq!(set.open(None).unwrap().frames.len(), SCANS);

    let mut set = nuscenes();
    set.topic = None;
    let message = set.open(None).unwrap_err().to_string();
    assert!(
        message.contains("several scenes; choose one of: scene-0061, scene-0103"),
        "{message}"
    );
    for topic in ["scene-0061", "61", "0061"] {
        set.topic = Some(topic);
        assert_eq!(set.open(None).unwrap().frames.len(), SCANS);
    }
    // Its only sweep is not there.
    set.topic = Some("scene-0103");
    assert!(matches!(
        set.open(None),
        Err(RecordingError::NoScans { .. })
    ));
}

#[test]
fn a_folder_in_another_layout_is_an_error_that_says_what_is_missing() {
    let set = mulran();
    for (layout, needs) in [
        ("nclt", "velodyne_sync/"),
        ("kitti", "velodyne/"),
        ("nuscenes", "v1.0-*/"),
        ("mcap", ".mcap"),
    ] {
        let message = set.open(Some(layout)).unwrap_err().to_string();
        assert!(message.contains(needs), "{message}");
    }
    assert!("mulram".parse::<fpmcl::recording::Layout>().is_err());
    // Those that KISS-ICP reads or names, too.
    for (name, parts) in [
        ("argoverse2", ["Arrow", "convert"]),
        ("ouster", ["raw packets", "ouster-cli"]),
        ("tum", ["not of a lidar", "bag"]),
    ] {
        let call = fpmcl("odometry").with("drive").with("--layout").with(name);
        call.rejects_usage_with(&parts);
        let call = fpmcl("benchmark").with(name).with("drive");
        call.rejects_usage_with(&parts);
    }
    let call = fpmcl("odometry").with("drive").with("--layout=mulram");
    call.rejects_usage_with(&["mulram", "kitti", "mulran"]);
    // The scans are scans of a folder, too.
    let mut set = mulran();
    set.path = "Ouster";
    assert_eq!(set.open(Some("generic")).unwrap().frames.len(), SCANS);
}

#[test]
fn tables_of_nuscenes_are_not_trusted() {
    let set = nuscenes();
    let path = set.folder.path().join("v1.0-mini/sample_data.json");
    let table = fs::read_to_string(&path).unwrap();
    let refused = |table: &str| {
        fs::write(&path, table).unwrap();
        set.open(None).unwrap_err().to_string()
    };
    for outside in ["../LIDAR_TOP", "/LIDAR_TOP"] {
        let message = refused(&table.replace("sweeps/LIDAR_TOP", outside));
        assert!(message.contains("outside of its folder"), "{message}");
    }
    for damaged in [
        &table[..table.len() / 2],
        "{}",
        "[{\"token\": 1}]",
        "[1]",
        &"[".repeat(100_000),
    ] {
        let message = refused(damaged);
        assert!(
            message.contains("sample_data.json is no table of nuScenes"),
            "{message}"
        );
    }
    let message = refused(&table.replace("16000000000", "1e300"));
    assert!(
        message.contains("is no table") || message.contains("beyond any time"),
        "{message}"
    );
}

#[test]
fn a_truncated_scan_of_a_data_set_is_an_error_with_its_size() {
    let set = helipr_ouster();
    let path = set
        .folder
        .path()
        .join(format!("LiDAR/Ouster/{}.bin", stamp_ns(0)));
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
    let message = set.open(None).unwrap_err().to_string();
    assert!(message.contains("multiple of 26"), "{message}");
}

#[test]
fn half_of_the_frames_of_a_data_set_may_be_without_a_pose() {
    let set = kitti360();
    // Too far apart for interpolation.
    set.write_rows(
        &format!("{}/velodyne_points/timestamps.txt", set.path),
        "",
        |scan| format!("2020-09-13 12:26:{:02}.0", 5 * scan),
    );
    let poses = "data_poses/2013_05_28_drive_0000_sync/poses.txt";
    let rows = fs::read_to_string(set.folder.path().join(poses)).unwrap();
    let rows: Vec<&str> = rows.lines().collect();
    set.write(poses, [rows[0], rows[3]].join("\n"));
    let numbers = |recording: &Recording| -> Vec<usize> {
        recording.frames.iter().map(|frame| frame.number).collect()
    };
    let recording = set.open(None).unwrap().with_own_poses().unwrap();
    assert_eq!(numbers(&recording), [0, 3]);
    set.write(poses, rows[3]);
    let error = set.open(None).unwrap().with_own_poses().unwrap_err();
    assert!(
        matches!(error, RecordingError::TimesDoNotMatch { .. }),
        "{error}"
    );
}
