//! Scans of other sensors, as their drivers write them: every point is read, and the sensor is recognized.

use std::fs;
use std::path::Path;

use fpmcl::internals::estimate_spatial_normals;
use fpmcl::internals::scan_files;
use fpmcl::lidar::{NormalConfig, RangeImage, Scan};
use fpmcl::sensor::{BeamSource, DroppedPoints, Sensor, SensorConfig};

use crate::common;

fn infer(scans: &[Scan]) -> Sensor {
    Sensor::infer(scans, &SensorConfig::default()).unwrap()
}

#[test]
fn every_sample_has_the_points_of_its_header_and_they_surround_the_sensor() {
    let Some(folder) = common::real_recording("sensor-samples") else {
        return;
    };
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if !scan_files::is_scan(&path) {
            continue;
        }
        let bytes = fs::read(&path).unwrap();
        let header = String::from_utf8_lossy(&bytes[..400]).into_owned();
        let claimed = header.lines().find_map(|line| line.strip_prefix("POINTS "));
        let scan = scan_files::read(&path).unwrap();
        assert_eq!(
            scan.len(),
            claimed.unwrap().trim().parse::<usize>().unwrap()
        );
        let finite = scan.points.iter().filter(|point| point.is_finite());
        let near = finite.filter(|point| point.length() < 300.0).count();
        assert!(10 * near > 9 * scan.len(), "{}", path.display());
    }
}

#[test]
fn scans_of_nuscenes_have_five_numbers_per_point() {
    let Some(folder) = common::real_recording("nuscenes-hdl32") else {
        return;
    };
    for entry in fs::read_dir(folder.join("lidar")).unwrap() {
        let path = entry.unwrap().path();
        let scan = scan_files::read(&path).unwrap();
        let bytes = fs::metadata(&path).unwrap().len() as usize;
        assert_eq!(scan.len(), bytes / 20, "{}", path.display());
    }
}

/// The sensor of `count` scans of a folder, each `step` after the last.
fn sensor_of(folder: &Path, step: usize, count: usize) -> (Vec<Scan>, Sensor) {
    let mut paths: Vec<_> = (fs::read_dir(folder).unwrap())
        .map(|entry| entry.unwrap().path())
        .filter(|path| scan_files::is_scan(path))
        .collect();
    paths.sort();
    let chosen = paths.iter().step_by(step).take(count);
    let scans: Vec<Scan> = chosen.map(|path| scan_files::read(path).unwrap()).collect();
    let sensor = infer(&scans);
    (scans, sensor)
}

#[test]
fn the_beams_of_twelve_sensors_are_counted_from_one_scan() {
    let Some(folder) = common::real_recording("sensor-samples") else {
        return;
    };
    for (name, beams) in [
        ("40p", 40),
        ("64", 64),
        ("at128", 128),
        ("ot128", 128),
        ("qt128", 128),
        ("qt64", 64),
        ("vlp16", 16),
        ("vlp32", 32),
        ("vls128", 128),
        ("xt16", 16),
        ("xt32", 32),
        ("xt32m", 32),
    ] {
        let scan = scan_files::read(&folder.join(name).with_extension("pcd")).unwrap();
        let sensor = infer(&[scan]);
        assert!(sensor.has_rows, "{name}");
        assert_eq!(sensor.beams, Some(beams), "{name}");
    }
}

#[test]
fn channels_are_rings_and_times_within_packets_are_none_of_the_sweep() {
    let Some(folder) = common::real_recording("sensor-samples") else {
        return;
    };
    let read = scan_files::read_stamped(&folder.join("vlp16.pcd"), None).unwrap();
    assert_eq!(read.scan.rings.len(), read.scan.len());
    assert_eq!(read.scan.rings.iter().max(), Some(&15));
    // They span 1.3 ms in nanoseconds.
    assert!(read.has_unknown_times && read.scan.times_s.is_empty());
    assert_eq!(infer(&[read.scan]).beam_source, BeamSource::Rings);
}

#[test]
fn the_sensor_of_kitti_is_recognized_by_a_drive() {
    let Some(folder) = common::real_recording("kitti-0926-drive-0005") else {
        return;
    };
    let (scans, sensor) = sensor_of(&folder.join("velodyne"), 8, 10);
    assert_eq!((sensor.beams, sensor.range_image.height), (Some(64), 64));
    let height_m = sensor.mounting.unwrap().height_m;
    assert!((height_m - 1.73).abs() < 0.05, "{height_m}");
    assert!(sensor.is_moving);
    let [x_min, x_max, y_min, y_max] = sensor.own_car_m;
    assert!(x_min > -2.8 && x_max < 3.0 && y_min > -2.0 && y_max < 2.0);
    let mut lost = DroppedPoints::default();
    for scan in &scans {
        lost.add(&DroppedPoints::count(
            scan,
            &sensor.range_image,
            sensor.own_car_m,
        ));
    }
    assert_eq!(lost.above(0.2), [], "{lost:?}");
}

#[test]
fn the_beams_of_kitti_are_64_in_compensated_scans_of_its_benchmark() {
    for recording in [
        "kitti-odometry-01",
        "semantickitti-00-labels",
        "semantickitti-08-labels",
    ] {
        let Some(folder) = common::real_recording(recording) else {
            continue;
        };
        let (_, sensor) = sensor_of(&folder.join("velodyne"), 1, 10);
        assert_eq!(sensor.beams, Some(64), "{recording}");
        assert!(
            (62..=64).contains(&sensor.range_image.height),
            "{recording}"
        );
    }
}

#[test]
fn the_sensor_of_nuscenes_is_recognized_by_a_drive() {
    let Some(folder) = common::real_recording("nuscenes-hdl32") else {
        return;
    };
    let (_, sensor) = sensor_of(&folder.join("lidar"), 3, 10);
    assert_eq!(sensor.beams, Some(32));
    let top_deg = sensor.range_image.elevation_rad(0).to_degrees();
    let bottom_deg = sensor
        .range_image
        .elevation_rad(sensor.range_image.height - 1)
        .to_degrees();
    assert!((top_deg - 10.7).abs() < 0.3, "{top_deg}");
    assert!((bottom_deg + 30.7).abs() < 1.0, "{bottom_deg}");
    let height_m = sensor.mounting.unwrap().height_m;
    assert!((height_m - 1.84).abs() < 0.05, "{height_m}");
    // Returns labelled own car are within -0.6 to 0.7 and -1.05 to 2.03 m.
    let [x_min, x_max, y_min, y_max] = sensor.own_car_m;
    assert!(x_min < -0.6 && x_max > 0.7 && y_min < -1.05 && y_max > 2.03);
    assert!(x_min > -1.4 && x_max < 1.4 && y_min > -2.6 && y_max < 2.8);
}

#[test]
fn a_livox_has_no_rows_and_normals_from_neighbours_in_space() {
    let Some(folder) = common::real_recording("livox-hku2") else {
        return;
    };
    let (scans, sensor) = sensor_of(&folder.join("scans"), 13, 20);
    assert!(!sensor.has_rows);
    assert_eq!(
        (sensor.beams, sensor.rotation, sensor.period_s),
        (None, None, None)
    );
    assert!((60.0..90.0).contains(&sensor.horizontal_fov_deg));
    let (mut all_found, mut all_pixels) = (0, 0);
    for scan in &scans {
        let lost = DroppedPoints::count(scan, &sensor.range_image, sensor.own_car_m);
        assert_eq!(lost.above(0.25), [], "{lost:?}");
        let points = RangeImage::project(&scan.points, &sensor.range_image).points;
        let normals = estimate_spatial_normals(&points, &NormalConfig::default());
        let pixels = points.iter().filter(|point| point.length() > 0.0).count();
        let found = normals.iter().flatten().count();
        assert!(3 * found > pixels, "{found} of {pixels}");
        all_found += found;
        all_pixels += pixels;
    }
    assert!(2 * all_found > all_pixels, "{all_found} of {all_pixels}");
}
