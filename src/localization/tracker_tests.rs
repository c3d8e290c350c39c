//! The tracker on scans of a street.

use glam::Vec3;

use super::*;
use crate::geometry::{Pose2, Pose3};
use crate::localization::{Distortion, StartSpread, State};
use crate::map::world_for_tests::TestWorld;
use crate::odometry::Odometer;
use crate::sensor::{SensorError, TIMING_SCANS};

fn config() -> TrackerConfig {
    TrackerConfig {
        localizer: LocalizerConfig::of_test(500),
        ..TrackerConfig::default()
    }
}

/// A drive along the street, 0.8 m per scan: poses and scans.
fn drive(world: &TestWorld) -> Vec<(Pose2, Scan)> {
    drive_of(12, world)
}

fn drive_of(scans: u32, world: &TestWorld) -> Vec<(Pose2, Scan)> {
    (0..scans)
        .map(|number| {
            let pose = world.pose_at(10.0 + 0.8 * f64::from(number), 0.3, 0.02);
            let scan = Scan {
                points: world.scan(&pose).points,
                time_s: Some(0.1 * f64::from(number)),
                ..Scan::default()
            };
            (pose, scan)
        })
        .collect()
}

fn near(pose: &Pose2) -> Start {
    Start::Pose {
        map_from_lidar: *pose,
        height_m: None,
        spread: StartSpread::default(),
    }
}

/// A tracker whose start is known and whose sensor is not.
fn tracker_near(pose: &Pose2, world: &TestWorld) -> Tracker {
    let tracker = Tracker::new(&world.map(), config()).unwrap();
    tracker.with_start(near(pose))
}

#[test]
fn scans_of_an_unknown_sensor_are_tracked() {
    let world = TestWorld::street();
    let drive = drive(&world);
    let mut tracker = tracker_near(&drive[0].0, &world);
    assert!(tracker.sensor().is_none());
    for (row, (truth, scan)) in drive.iter().enumerate() {
        let estimate = tracker.step(scan).unwrap();
        let error = truth.inverse() * estimate.pose;
        let error_m = error.translation.vector.norm();
        assert!(row < 2 || error_m < 0.1, "scan {row}: {error_m} m");
        assert!(row < 11 || estimate.state == State::Tracking);
    }
    assert_eq!(tracker.sensor().unwrap().range_image.height, 32);
}

#[test]
fn a_tracker_is_the_odometer_and_the_localizer() {
    let world = TestWorld::street();
    let drive = drive(&world);
    let start = near(&drive[0].0);
    let sensor = Sensor::infer(&[drive[0].1.clone()], &SensorConfig::default()).unwrap();
    let tracker = Tracker::new(&world.map(), config()).unwrap();
    let mut tracker = (tracker.with_sensor(sensor.clone())).with_start(start.clone());
    let mut odometer = Odometer::new(OdometryConfig::default()).unwrap();
    let mut localizer =
        Localizer::new(&world.map(), &sensor, config().localizer, start, 0).unwrap();
    let mut motion = Pose3::identity();
    for (row, (_, scan)) in drive.iter().enumerate() {
        motion *= odometer.step(scan).unwrap().previous_from_current;
        if row % 2 == 1 {
            tracker.split().0.pass(scan).unwrap();
            continue;
        }
        let expected = localizer.step(scan, Odometry::Motion(motion)).unwrap();
        let found = tracker.step(scan).unwrap();
        assert_eq!(found.particles, expected.particles, "scan {row}");
        motion = Pose3::identity();
    }
}

#[test]
fn the_front_end_may_be_a_scan_ahead() {
    let world = TestWorld::street();
    // The sensor is complete before the last scans.
    let drive = drive_of(TIMING_SCANS as u32 + 2, &world);
    let tracker = || tracker_near(&drive[0].0, &world);
    let (mut in_turn, mut ahead) = (tracker(), tracker());
    let (front, back) = ahead.split();
    let mut next = Some(front.measure(&drive[0].1).unwrap());
    for (row, (_, scan)) in drive.iter().enumerate() {
        let measured = next.take().unwrap();
        let odometry = back.motion_into(&measured);
        let (estimate, following) = rayon::join(
            || back.step(scan, &measured, odometry).unwrap(),
            || Some(front.measure(&drive.get(row + 1)?.1).unwrap()),
        );
        next = following;
        let expected = in_turn.step(scan).unwrap();
        assert_eq!(estimate.particles, expected.particles, "scan {row}");
    }
}

#[test]
fn in_real_time_the_sensor_is_completed_while_scans_pass() {
    let world = TestWorld::street();
    let drive = drive_of(TIMING_SCANS as u32, &world);
    let tracker = || Tracker::new(&world.map(), config()).unwrap();
    let (mut at_once, mut in_real_time) = (tracker(), tracker().in_real_time());
    for (row, (_, scan)) in drive.iter().enumerate() {
        for tracker in [&mut at_once, &mut in_real_time] {
            tracker.split().0.pass(scan).unwrap();
        }
        assert!(row > 0 || at_once.sensor() == in_real_time.sensor());
    }
    let expected = at_once.sensor().unwrap();
    assert!(expected.is_moving);
    assert!(
        !in_real_time.sensor().unwrap().is_moving,
        "the last scan waited"
    );
    let is_completed = (1..1000).any(|count| {
        let mut scan = drive[drive.len() - 1].1.clone();
        scan.time_s = scan.time_s.map(|time_s| time_s + 0.1 * f64::from(count));
        in_real_time.split().0.pass(&scan).unwrap();
        in_real_time.sensor() == Some(expected)
    });
    assert!(is_completed);
}

#[test]
fn a_scan_that_cannot_be_localized_does_not_lose_its_motion() {
    let world = TestWorld::street();
    let drive = drive(&world);
    let tracker = || tracker_near(&drive[0].0, &world);
    let (mut found, mut expected) = (tracker(), tracker());
    for (row, (_, scan)) in drive.iter().enumerate() {
        let impossible = Odometry::Increment(Pose2::translation(f64::NAN, 0.0));
        let of_scan = found.measure(scan).unwrap();
        if row == 5 {
            found.step_with_motion(scan, impossible).unwrap_err();
            expected.split().0.pass(scan).unwrap();
            continue;
        }
        let found = found.step_with_motion(scan, of_scan).unwrap();
        let expected = expected.step(scan).unwrap();
        let apart = expected.pose.inverse() * found.pose;
        assert!(
            apart.translation.vector.norm() < 0.02,
            "scan {row}: {apart}"
        );
    }
}

#[test]
fn a_first_scan_without_points_is_an_error() {
    let mut tracker = Tracker::new(&TestWorld::street().map(), config()).unwrap();
    let result = tracker.step(&Scan::default());
    assert!(matches!(
        result,
        Err(TrackerError::Sensor(SensorError::NoPoints))
    ));
}

#[test]
fn a_restarted_tracker_is_a_new_one_with_its_sensor_and_preparing_the_start_changes_nothing() {
    let world = TestWorld::street();
    let drive = drive(&world);
    let states = |tracker: &mut Tracker| {
        let step = |(_, scan): &(Pose2, Scan)| tracker.step(scan).unwrap().particles;
        drive[..2].iter().map(step).collect::<Vec<_>>()
    };
    let mut config = config();
    // Few panoramas.
    config.localizer.panorama.cell_m = 6.0;
    let sensor = Sensor::infer(&[drive[0].1.clone()], &SensorConfig::default()).unwrap();
    let tracker = || {
        let tracker = Tracker::new(&world.map(), config.clone()).unwrap();
        tracker.with_sensor(sensor.clone())
    };
    for start in [near(&drive[0].0), Start::Anywhere] {
        let expected = states(&mut tracker().with_start(start.clone()));
        let mut restarted = tracker().with_start(start.clone());
        restarted.prepare_start(&drive[3].1).unwrap();
        assert_eq!(states(&mut restarted), expected);
        // Times that begin again are those of new scans.
        restarted.restart(start).unwrap();
        assert_eq!(states(&mut restarted), expected);
    }
}

#[test]
fn scans_of_a_left_handed_frame_or_with_ranges_by_a_wrong_factor_are_lost_and_named() {
    const FACTOR: f32 = 1.05;
    let world = TestWorld::street();
    let drive = drive_of(20, &world);
    let tracked = |changed: &dyn Fn(Vec3) -> Vec3| {
        let tracker = Tracker::new(&world.map(), config()).unwrap();
        let mut tracker = tracker.with_start(Start::Road);
        let step = |(_, scan): &(Pose2, Scan)| {
            let points = scan.points.iter().map(|&point| changed(point)).collect();
            let scan = Scan {
                points,
                ..scan.clone()
            };
            tracker.step(&scan).unwrap()
        };
        drive.iter().map(step).collect::<Vec<Estimate>>()
    };
    let is_tracked = |found: &[Estimate]| found.iter().any(|it| it.state == State::Tracking);
    let mirrored = tracked(&|point| Vec3::new(point.x, -point.y, point.z));
    assert_eq!(mirrored[19].distortion, Some(Distortion::Mirrored));
    assert!(!is_tracked(&mirrored));
    let scaled = tracked(&|point| FACTOR * point);
    let Some(Distortion::Scaled { factor }) = scaled[19].distortion else {
        panic!("{:?}", scaled[19].distortion);
    };
    assert!((factor - f64::from(FACTOR)).abs() < 3e-3, "{factor}");
    assert!(!is_tracked(&scaled));
    let right = tracked(&|point| point);
    assert!(right.iter().all(|it| it.distortion.is_none()));
    assert!(right[5..].iter().all(|it| it.state == State::Tracking));
}
