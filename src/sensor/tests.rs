//! Laws of the inference, on drawn sensors and scenes.

use std::f32::consts::TAU;

use arbtest::arbtest;
use glam::Vec3;
use rand::seq::SliceRandom;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::lidar::{PointTiming, Scan};
use crate::odometry::TimingComparison;

fn infer(scans: &[Scan]) -> Sensor {
    Sensor::infer(scans, &SensorConfig::default()).unwrap()
}

/// A drawn spinning sensor at the origin in a yard: ground 1.8 m below, walls around at 8 to 30 m.
struct Spinner {
    elevations_deg: Vec<f32>,
    columns: usize,
    /// Heights of the lasers above the origin [m].
    offset_m: f32,
}

impl Spinner {
    fn draw(rng: &mut impl Rng, beams: usize) -> Self {
        let gaps: Vec<f32> = (0..beams).map(|_| rng.random_range(0.3..2.0)).collect();
        let scale = 45.0_f32.min(1.0 * beams as f32) / gaps.iter().sum::<f32>();
        let mut elevation_deg = 0.4 * scale * gaps.iter().sum::<f32>();
        let elevations_deg = (gaps.iter())
            .map(|gap| {
                elevation_deg -= scale * gap;
                elevation_deg
            })
            .collect();
        Self {
            elevations_deg,
            columns: rng.random_range(500..1800),
            offset_m: 0.0,
        }
    }

    /// A scan at a place along the yard, column after column; walls move by with the place.
    fn scan(&self, place_m: f32, rng: &mut impl Rng) -> Scan {
        let mut scan = Scan::default();
        for column in 0..self.columns {
            let azimuth = TAU * (column as f32 + 0.5) / self.columns as f32;
            let (sin, cos) = azimuth.sin_cos();
            let wall_m = 14.0 + 6.0 * (3.0 * azimuth + 0.4 * place_m).sin();
            for elevation_deg in &self.elevations_deg {
                let slope = elevation_deg.to_radians().tan();
                let ground_m = if slope < 0.0 {
                    (1.8 + self.offset_m) / -slope
                } else {
                    1e3
                };
                let distance_m = wall_m.min(ground_m) + rng.random_range(-0.02..0.02);
                let z = self.offset_m + slope * distance_m;
                scan.points
                    .push(Vec3::new(distance_m * cos, distance_m * sin, z));
                scan.times_s.push(0.1 * column as f32 / self.columns as f32);
            }
        }
        scan
    }
}

fn assert_finds(sensor: &Spinner, scan: &Scan) {
    let found = infer(std::slice::from_ref(scan));
    assert!(found.has_rows);
    assert_eq!(found.range_image.height, sensor.elevations_deg.len());
    for (row, expected) in sensor.elevations_deg.iter().enumerate() {
        let error = found.range_image.elevation_rad(row).to_degrees() - expected;
        assert!(error.abs() < 0.15, "row {row}: {error}");
    }
}

#[test]
fn beams_of_any_elevations_are_found_in_any_order_and_with_a_third_of_the_points_dropped() {
    arbtest(|u| {
        let mut rng = ChaCha8Rng::seed_from_u64(u.arbitrary()?);
        let sensor = Spinner::draw(&mut rng, u.int_in_range(4..=90)?);
        let mut scan = sensor.scan(0.0, &mut rng);
        scan.times_s.clear();
        assert_finds(&sensor, &scan);
        scan.points.retain(|_| rng.random_bool(0.7));
        assert_finds(&sensor, &scan);
        scan.points.shuffle(&mut rng);
        assert_finds(&sensor, &scan);
        Ok(())
    })
    .budget_ms(3000);
}

/// A scan in a random order by beams at some elevations.
fn shuffled_scan(elevations_deg: &[f32], columns: usize, rng: &mut impl Rng) -> (Spinner, Scan) {
    let sensor = Spinner {
        elevations_deg: elevations_deg.to_vec(),
        columns,
        offset_m: 0.0,
    };
    let mut scan = sensor.scan(0.0, rng);
    scan.times_s.clear();
    scan.points.shuffle(rng);
    (sensor, scan)
}

#[test]
fn two_beams_close_together_among_others_far_apart_are_two() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    for gap_deg in [0.25, 0.33, 0.45, 0.6] {
        let elevations_deg = [4.0, 2.5, 1.0, 1.0 - gap_deg, -1.2, -3.0];
        let (sensor, scan) = shuffled_scan(&elevations_deg, 1200, &mut rng);
        assert_finds(&sensor, &scan);
    }
}

#[test]
fn blurred_beams_of_few_points_are_not_divided() {
    let mut rng = ChaCha8Rng::seed_from_u64(10);
    let elevations_deg = [9.0, 6.0, 3.0, 1.0, -1.0, -3.0, -6.0, -9.0];
    for blur_deg in [0.02, 0.05, 0.1, 0.2] {
        let (sensor, mut scan) = shuffled_scan(&elevations_deg, 100, &mut rng);
        for point in &mut scan.points {
            let blur_rad = (blur_deg * rng.random_range(-1.0..1.0_f32)).to_radians();
            point.z += point.truncate().length() * blur_rad;
        }
        assert_finds(&sensor, &scan);
    }
}

#[test]
fn beams_that_follow_one_another_are_found_by_their_order_though_motion_smears_them() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let sensor = Spinner::draw(&mut rng, 40);
    let mut points = vec![];
    let scan = sensor.scan(0.0, &mut rng);
    for beam in 0..40 {
        points.extend(scan.points.iter().skip(beam).step_by(40));
    }
    // Compensated for 2 m of motion in the revolution.
    let azimuth = |point: Vec3| point.y.atan2(point.x) / TAU;
    let moved = points
        .iter()
        .map(|&p: &Vec3| p + 2.0 * azimuth(p) * Vec3::X);
    let scan = Scan {
        points: moved.filter(|_| rng.random_bool(0.7)).collect(),
        ..Scan::default()
    };
    let found = infer(&[scan]);
    assert_eq!(found.beam_source, BeamSource::Order);
    assert_eq!(found.beams, Some(40));
}

#[test]
fn lasers_above_the_origin_are_found_in_any_order() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut sensor = Spinner::draw(&mut rng, 50);
    sensor.offset_m = 0.2;
    let mut scan = sensor.scan(0.0, &mut rng);
    scan.points.shuffle(&mut rng);
    let found = infer(&[scan]);
    // The offset is found to a centimetre, so two beams close together may be one.
    assert!((49..=51).contains(&found.range_image.height));
}

#[test]
fn rings_are_trusted_only_if_they_are_beams() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let sensor = Spinner::draw(&mut rng, 14);
    let mut scan = sensor.scan(0.0, &mut rng);
    // Two beams without a return.
    scan.rings = (0..scan.len())
        .map(|point| 1 + (point % 14) as u16)
        .collect();
    let found = infer(std::slice::from_ref(&scan));
    assert_eq!(
        (found.beam_source, found.beams),
        (BeamSource::Rings, Some(15))
    );
    assert_eq!(found.range_image.height, 14);
    scan.rings = (0..scan.len()).map(|_| rng.random_range(0..6)).collect();
    let found = infer(&[scan]);
    assert_eq!(
        (found.beam_source, found.range_image.height),
        (BeamSource::Elevations, 14)
    );
}

#[test]
fn random_directions_have_no_rows() {
    arbtest(|u| {
        let mut rng = ChaCha8Rng::seed_from_u64(u.arbitrary()?);
        let count = u.int_in_range(500..=60_000)?;
        let points = (0..count).map(|_| {
            let direction = Vec3::new(
                1.0,
                rng.random_range(-0.7..0.7),
                rng.random_range(-0.7..0.7),
            );
            direction * rng.random_range(3.0..20.0_f32)
        });
        let scan = Scan {
            points: points.collect(),
            ..Scan::default()
        };
        let found = infer(&[scan]);
        assert!(!found.has_rows, "{count} points: {found:?}");
        assert_eq!(found.beams, None);
        assert!((60.0..90.0).contains(&found.horizontal_fov_deg));
        Ok(())
    })
    .budget_ms(2000);
}

#[test]
fn times_tell_the_sense_and_the_period() {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let sensor = Spinner::draw(&mut rng, 16);
    let mut scan = sensor.scan(0.0, &mut rng);
    let found = infer(std::slice::from_ref(&scan));
    assert_eq!(found.rotation, Some(RotationDirection::CounterClockwise));
    assert!((found.period_s.unwrap() - 0.1).abs() < 1e-3);
    scan.points.iter_mut().for_each(|point| point.y = -point.y);
    assert_eq!(infer(&[scan]).rotation, Some(RotationDirection::Clockwise));
}

#[test]
fn a_moving_sensor_sees_its_own_car_and_the_ground_below() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let sensor = Spinner::draw(&mut rng, 48);
    let scans: Vec<Scan> = (0..10)
        .map(|number| {
            let mut scan = sensor.scan(2.0 * number as f32, &mut rng);
            scan.times_s.clear();
            // A hood in front, 0.7 m below the sensor.
            let hood = (0..400).map(|_| {
                let (x, y) = (rng.random_range(1.0..2.0), rng.random_range(-0.6..0.6));
                Vec3::new(x, y, -0.7)
            });
            scan.points.extend(hood);
            scan
        })
        .collect();
    let found = infer(&scans);
    assert!(found.is_moving);
    for (limit, expected) in found.own_car_m.into_iter().zip([1.0, 2.0, -0.6, 0.6]) {
        assert!((limit - expected).abs() <= 0.41, "{:?}", found.own_car_m);
    }
    let mounting = found.mounting.unwrap();
    assert!((mounting.height_m - 1.8).abs() < 0.03, "{mounting:?}");
    assert!(mounting.pitch_rad.abs() < 0.02);

    // Without motion, what is close to the sensor may be anything.
    let standing: Vec<Scan> = (0..10)
        .map(|_| {
            let mut scan = sensor.scan(0.0, &mut rng);
            let close = |step: usize| Vec3::new(0.5, 0.001 * step as f32 - 0.2, -0.4);
            scan.points.extend((0..400).map(close));
            Scan {
                points: scan.points,
                ..Scan::default()
            }
        })
        .collect();
    let found = infer(&standing);
    assert_eq!((found.is_moving, found.own_car_m), (false, [0.0; 4]));
    let found = infer(&scans);

    // As from the first scan on, one after the other.
    let mut first = infer(&scans[..1]);
    assert_eq!(first.own_car_m, [0.0; 4]);
    let known = SensorConfig::default();
    assert!(!first.complete(&standing, &known).unwrap());
    assert!(first.complete(&scans, &known).unwrap());
    assert_eq!((first.own_car_m, first.period_s), (found.own_car_m, None));

    // Consecutive scans with times show the period, also where one has none.
    let mut timed = scans;
    for (number, scan) in timed.iter_mut().enumerate() {
        scan.time_s = (number != 4).then_some(5.0 + 0.05 * number as f64);
    }
    assert!(first.complete(&timed, &known).unwrap());
    assert!((first.period_s.unwrap() - 0.05).abs() < 1e-9);
}

#[test]
fn what_a_sensor_is_is_known_of_it_and_rows_that_are_not_given_are_inferred() {
    let sensor = Sensor::hdl64e();
    let mut known = SensorConfig::from(&sensor);
    assert_eq!(Sensor::configured(&known), Some(sensor.clone()));
    known.has_rows = None;
    assert_eq!(Sensor::configured(&known), None);
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let direction = |_| Vec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
    let scattered = Scan {
        points: (0..20_000).map(direction).map(|it| 9.0 * it).collect(),
        ..Scan::default()
    };
    let found = Sensor::infer(&[scattered], &known).unwrap();
    assert_eq!(found.range_image, sensor.range_image);
    assert_eq!((found.has_rows, found.beams), (false, None));
}

#[test]
fn ranges_reach_as_far_as_nearly_all_returns_and_twice_as_far_in_a_building() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    for (returned_m, reach_m) in [
        (3.0, 10.0),
        (8.0, 16.0),
        (40.0, 50.0),
        (70.0, 70.0),
        (300.0, 120.0),
    ] {
        let point = |_| {
            let [x, y, z] = std::array::from_fn(|_| rng.random_range(-1.0..1.0_f32));
            returned_m * Vec3::new(x, y, z).normalize_or(Vec3::X)
        };
        let scan = Scan {
            points: (0..5000).map(point).collect(),
            ..Scan::default()
        };
        let found_m = infer(&[scan]).range_image.max_range;
        assert!(
            (found_m - reach_m).abs() < 0.01,
            "{returned_m} m: {found_m} m"
        );
    }
}

#[test]
fn nothing_follows_from_no_points_and_damaged_ones() {
    let infer = |scans: &[Scan]| Sensor::infer(scans, &SensorConfig::default());
    let scan = |point: Option<Vec3>| Scan {
        rings: vec![u16::MAX; 50],
        times_s: vec![f32::NAN; 50],
        points: point.map_or_else(Vec::new, |point| vec![point; 50]),
        ..Scan::default()
    };
    for point in [None, Some(Vec3::NAN), Some(Vec3::ZERO)] {
        let found = infer(&[scan(point), scan(point)]);
        assert!(matches!(found, Err(SensorError::NoPoints)), "{found:?}");
    }
    let found = infer(&[scan(Some(Vec3::X)), scan(Some(Vec3::X))]).unwrap();
    assert!(!found.has_rows);
    assert_eq!(found.mounting, None);
    assert!(matches!(infer(&[]), Err(SensorError::NoPoints)));
}

#[test]
fn every_point_is_in_the_image_or_counted_with_its_reason() {
    let lidar = LidarModel::default();
    let scan = Scan {
        points: vec![
            Vec3::new(10.0, 0.0, 0.0),
            Vec3::new(20.0, 0.0, 0.0),
            Vec3::new(20.0, -0.02, 0.0),
            Vec3::new(10.0, 0.0, 5.0),
            Vec3::new(1.0, 0.0, 0.0),
            Vec3::new(0.0, 5.0, 0.0),
            Vec3::new(-70.0, 0.0, 0.0),
            Vec3::ZERO,
            Vec3::NAN,
        ],
        ..Scan::default()
    };
    let own_car_m = [-1.0, 1.0, 4.0, 6.0];
    let mut counts = DroppedPoints::count(&scan, &lidar, own_car_m);
    let expected = DroppedPoints {
        points: 9,
        without_return: 2,
        own_car: 1,
        too_near: 1,
        too_far: 1,
        outside_image: 1,
        second_return: 1,
        same_pixel: 1,
    };
    assert_eq!(counts, expected);
    assert_eq!(counts.above(0.2), []);
    assert_eq!(counts.above(0.1).len(), 5);
    counts.outside_image += 3;
    counts.points += 3;
    assert_eq!(counts.above(0.2)[0].0, DropReason::OutsideImage);
}

#[test]
fn keys_of_a_sensor_have_units_and_those_of_earlier_maps_are_read() {
    let sensor = Sensor::new(LidarModel {
        elevations: Some([3.0, -2.0].into()),
        ..LidarModel::default()
    });
    let json = serde_json::to_string(&sensor).unwrap();
    let mut earlier = json.clone();
    for (key, unit) in [
        ("fov_up", "deg"),
        ("fov_down", "deg"),
        ("max_range", "m"),
        ("min_range", "m"),
        ("elevations", "deg"),
    ] {
        let in_units = format!("\"{key}_{unit}\":");
        assert!(json.contains(&in_units), "{json}");
        earlier = earlier.replace(&in_units, &format!("\"{key}\":"));
    }
    for text in [json, earlier] {
        assert_eq!(serde_json::from_str::<Sensor>(&text).unwrap(), sensor);
    }
}

#[test]
fn beams_are_whole_though_the_ends_of_a_compensated_sweep_overlap() {
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    // Velodyne's HDL-64E: two blocks of 32 lasers with two spacings, mounted 0.2 degrees too high.
    let upper = (0..32).map(|laser| 2.2 - laser as f32 / 3.0);
    let lower = (0..32).map(|laser| -8.63 - 0.5 * laser as f32);
    let sensor = Spinner {
        elevations_deg: upper.chain(lower).collect(),
        columns: 1800,
        offset_m: 0.0,
    };
    let scans = [0.0, 2.0, 4.0].map(|place_m| {
        let scan = sensor.scan(place_m, &mut rng);
        let columns: Vec<&[Vec3]> = scan.points.chunks(64).collect();
        // The sweep starts behind; files start in front. It moves by 8 cm, and turns by 363 degrees.
        let moved = |column: usize, turns: f32| {
            let later = move |point: &Vec3| *point + 0.08 * turns * Vec3::X;
            columns[column].iter().map(later).collect::<Vec<_>>()
        };
        let share = |column: usize| (column as f32 + 0.5) / 1800.0;
        let first = (0..908).map(|column| moved(column, share(column)));
        let second = (893..1800).map(|column| moved(column, share(column) - 1.0));
        let ordered: Vec<Vec<Vec3>> = first.chain(second).collect();
        Scan {
            points: (0..64)
                .flat_map(|beam| ordered.iter().map(move |column| column[beam]))
                .collect(),
            ..Scan::default()
        }
    });
    let found = infer(&scans);
    assert_eq!(found.beam_source, BeamSource::Order);
    assert_eq!((found.beams, found.range_image.height), (Some(64), 64));
    for (row, expected) in sensor.elevations_deg.iter().enumerate() {
        let error = found.range_image.elevation_rad(row).to_degrees() - expected;
        assert!(error.abs() < 0.05, "row {row}: {error}");
    }
}

#[test]
fn a_scan_with_more_beams_than_most_does_not_count() {
    let mut rng = ChaCha8Rng::seed_from_u64(13);
    let sensor = Spinner::draw(&mut rng, 20);
    let scans = [20, 20, 23].map(|beams| {
        let scan = sensor.scan(0.0, &mut rng);
        let beam = |beam: usize| {
            // Returns from elsewhere in three turns below the others.
            let lower = if beam < 20 { 0.0 } else { beam as f32 };
            let points = scan.points.iter().skip(beam % 20).step_by(20);
            points.map(move |&point| point - lower * Vec3::Z)
        };
        Scan {
            points: (0..beams).flat_map(beam).collect(),
            ..Scan::default()
        }
    });
    let found = infer(&scans);
    assert_eq!(
        (found.beam_source, found.beams),
        (BeamSource::Order, Some(20))
    );
}

/// The points of a scan, compensated for a motion in the sweep [m].
fn compensated(scan: &Scan, motion_m: f32) -> Scan {
    let later = |point: &Vec3| *point + motion_m * point.y.atan2(point.x) / TAU * Vec3::X;
    Scan {
        points: scan.points.iter().map(later).collect(),
        ..scan.clone()
    }
}

#[test]
fn the_elevations_of_scans_as_measured_are_exact_and_those_of_compensated_ones_are_not() {
    let mut rng = ChaCha8Rng::seed_from_u64(14);
    for offset_m in [0.0, 0.1] {
        let sensor = Spinner {
            offset_m,
            ..Spinner::draw(&mut rng, 24)
        };
        let mut scan = sensor.scan(0.0, &mut rng);
        scan.times_s.clear();
        for point in &mut scan.points {
            *point = (1000.0 * *point).round() / 1000.0;
        }
        let rows = infer(std::slice::from_ref(&scan)).range_image;
        for has_rings in [true, false] {
            scan.rings = if has_rings {
                (0..scan.len()).map(|point| (point % 24) as u16).collect()
            } else {
                vec![]
            };
            let are_raw = |scans: &[Scan]| raw::are_raw(scans, &rows);
            assert!(are_raw(std::slice::from_ref(&scan)));
            assert!(!are_raw(&[compensated(&scan, 0.1)]));
            // Of a sensor that does not always move.
            assert!(!are_raw(&[scan.clone(), compensated(&scan, 0.1)]));
        }
    }
    assert!(!raw::are_raw(&[], &LidarModel::default()));
}

#[test]
fn the_order_of_points_decides_where_scans_as_measured_fit_no_other_times_better() {
    let mut rng = ChaCha8Rng::seed_from_u64(15);
    let mut scan = Spinner::draw(&mut rng, 24).scan(0.0, &mut rng);
    scan.times_s.clear();
    let moving = Sensor {
        is_moving: true,
        ..infer(std::slice::from_ref(&scan))
    };
    let order = Some(PointTiming::Order { period_s: 0.1 });
    let timing = |sensor: &Sensor, scan: &Scan, best: Option<usize>| {
        let compared = TimingComparison {
            residuals_m: vec![(None, 0.03), (order, 0.0301)],
            best,
        };
        let scans = std::slice::from_ref(scan);
        sensor.timing(scans, || Ok(Some(compared))).unwrap()
    };
    let in_order = Some(MotionCompensation::Order { sweep_deg: 360.0 });
    let bent = compensated(&scan, 0.3);
    assert_eq!(timing(&moving, &scan, None), in_order);
    assert_eq!(timing(&moving, &bent, None), None);
    assert_eq!(timing(&moving, &bent, Some(1)), in_order);
    // Simulated scans of a moment have exact elevations, too.
    assert_eq!(timing(&moving, &scan, Some(0)), None);
    let at_rest = Sensor {
        is_moving: false,
        ..moving.clone()
    };
    assert_eq!(timing(&at_rest, &scan, None), None);
    let too_few = moving.timing(std::slice::from_ref(&scan), || Ok(None));
    assert_eq!(too_few.unwrap(), None);
}

#[test]
fn times_from_the_order_are_a_key() {
    let read = |text: &str| MotionCompensation::try_from(text.to_owned());
    for (text, sweep_deg) in [("order", 360.0), ("order over 400.7", 400.7)] {
        let key = MotionCompensation::Order { sweep_deg };
        assert_eq!(read(text), Ok(key));
        assert_eq!(key.to_string(), text);
        let timing = key.timing(0.1).unwrap();
        assert_eq!(MotionCompensation::of(&timing, 0.1), key);
    }
    for text in [
        "order over",
        "order over 0",
        "order over NaN",
        "order from 90",
        "orders",
    ] {
        assert!(read(text).unwrap_err().contains("order"), "{text}");
    }
}
