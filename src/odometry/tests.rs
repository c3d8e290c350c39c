//! Laws of the odometry on scans of a drawn world.

use glam::Vec3;
use nalgebra::{Point3, Vector3};
use rand::{SeedableRng as _, rngs::StdRng};
use rand_distr::{Distribution as _, StandardNormal};

use super::*;
use crate::geometry::{Pose3, wrap_angle};
use crate::lidar::{PointTiming, Rotation, RotationDirection, Scan};

/// Surfaces: planes n · p = d within a box, and upright cylinders (x, y, radius) up to a height.
#[derive(Default)]
pub(super) struct World {
    planes: Vec<(Vector3<f64>, f64, [f64; 6])>,
    poles: Vec<[f64; 4]>,
}

const UNBOUNDED: [f64; 6] = [-1e3, 1e3, -1e3, 1e3, -1e3, 1e3];

impl World {
    /// A crossing: ground, house fronts with gaps, cross walls, poles.
    pub(super) fn crossing() -> Self {
        let mut world = Self::default();
        world.planes.push((Vector3::z(), -1.7, UNBOUNDED));
        for (y, gaps) in [
            (9.0, [-30.0, -4.0, 3.0, 40.0]),
            (-7.5, [-22.0, 1.5, 9.0, 35.0]),
        ] {
            for range in gaps.chunks(2) {
                let bounds = [range[0], range[1], -1e3, 1e3, -2.0, 6.0];
                world.planes.push((Vector3::y(), y, bounds));
            }
        }
        let tilted = Vector3::new(0.8, 0.6, 0.0);
        world
            .planes
            .push((tilted, 30.0, [-1e3, 1e3, -20.0, 20.0, -2.0, 8.0]));
        world
            .planes
            .push((Vector3::x(), -25.0, [-1e3, 1e3, -6.0, 5.0, -2.0, 3.0]));
        for (x, y) in [
            (4.0, 5.0),
            (12.0, -5.5),
            (-6.0, 5.5),
            (19.0, 6.0),
            (-13.0, -5.0),
        ] {
            world.poles.push([x, y, 0.15, 4.0]);
        }
        world
    }

    /// House fronts and poles along a round of radius 24 m about (0, 24), all different.
    pub(super) fn around_a_block() -> Self {
        let mut world = Self::default();
        world.planes.push((Vector3::z(), -1.7, UNBOUNDED));
        for number in 0..40 {
            let varied = |factor: f64| (factor * f64::from(number)).sin();
            let angle = 0.157 * f64::from(number) + 0.05 * varied(7.3);
            let radius = if number % 2 == 0 { 34.0 } else { 13.0 } + 2.0 * varied(3.1);
            let (x, y) = (radius * angle.cos(), 24.0 + radius * angle.sin());
            let turned = angle + 0.4 * varied(5.7);
            let normal = Vector3::new(turned.cos(), turned.sin(), 0.0);
            let half = 2.5 + varied(9.1);
            let height = 2.0 + 3.0 * varied(2.3);
            let bounds = [x - half, x + half, y - half, y + half, -2.0, height];
            (world.planes).push((normal, normal.dot(&Vector3::new(x, y, 0.0)), bounds));
            let radius = 24.0 + 5.0 * varied(4.9).signum();
            let angle = angle + 0.08;
            (world.poles).push([radius * angle.cos(), 24.0 + radius * angle.sin(), 0.2, 3.0]);
        }
        world
    }

    /// Two walls and a floor without end.
    fn corridor() -> Self {
        let mut world = Self::default();
        world.planes.push((Vector3::z(), -1.0, UNBOUNDED));
        world.planes.push((Vector3::y(), 2.0, UNBOUNDED));
        world.planes.push((Vector3::y(), -2.5, UNBOUNDED));
        world
    }

    /// A corridor with a ceiling.
    pub(super) fn tunnel() -> Self {
        let mut world = Self::corridor();
        world.planes.push((Vector3::z(), 4.0, UNBOUNDED));
        world
    }

    /// A scan from each pose.
    pub(super) fn scans(&self, poses: &[Pose3]) -> Vec<Scan> {
        (poses.iter())
            .map(|&pose| self.scan(|_| pose, None))
            .collect()
    }

    /// Range along a ray; `None` beyond 60 m.
    fn cast(&self, origin: &Point3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        let mut nearest = 60.0;
        for (normal, offset, bounds) in &self.planes {
            let range = (offset - normal.dot(&origin.coords)) / normal.dot(direction);
            let p = origin + direction * range;
            let inside =
                (0..3).all(|axis| (bounds[2 * axis]..=bounds[2 * axis + 1]).contains(&p[axis]));
            if range > 0.1 && range < nearest && inside {
                nearest = range;
            }
        }
        for [x, y, radius, height] in &self.poles {
            let (ox, oy) = (origin.x - x, origin.y - y);
            let a = direction.x.powi(2) + direction.y.powi(2);
            let b = ox * direction.x + oy * direction.y;
            let root = b * b - a * (ox * ox + oy * oy - radius * radius);
            let range = (-b - root.max(0.0).sqrt()) / a;
            let z = origin.z + direction.z * range;
            if root > 0.0 && range > 0.1 && range < nearest && z < *height {
                nearest = range;
            }
        }
        (nearest < 60.0).then_some(nearest)
    }

    /// A scan of 32 beams, by a sensor whose pose depends on the time after the moment of the scan.
    pub(super) fn scan(&self, pose_at: impl Fn(f64) -> Pose3, rotation: Option<Rotation>) -> Scan {
        const STEPS: u16 = 2000;
        const NOISE_M: f64 = 0.01;
        let mut scan = Scan::default();
        let mut rng = StdRng::seed_from_u64(1);
        for step in 0..STEPS {
            let azimuth =
                std::f64::consts::TAU * ((f64::from(step) + 0.5) / f64::from(STEPS) - 0.5);
            for beam in 0..32 {
                let elevation = (10.0 - f64::from(beam) * 1.2_f64).to_radians();
                let direction = Vector3::new(
                    azimuth.cos() * elevation.cos(),
                    azimuth.sin() * elevation.cos(),
                    elevation.sin(),
                );
                let point = |range: f64| (direction * range).cast::<f32>();
                let time_s = rotation.map_or(0.0, |rotation| {
                    f64::from(rotation.point_times(&[point(1.0).into()])[0])
                });
                let pose = pose_at(time_s);
                let origin = Point3::from(pose.translation.vector);
                if let Some(range) = self.cast(&origin, &(pose.rotation * direction)) {
                    let deviate: f64 = StandardNormal.sample(&mut rng);
                    scan.points.push(point(range + NOISE_M * deviate).into());
                }
            }
        }
        scan
    }
}

/// A curve with pitching and rolling: the pose of the sensor at a time, 6 m/s.
pub(super) fn drive(time_s: f64) -> Pose3 {
    let (speed, turn_rate) = (6.0, 0.25);
    let heading = turn_rate * time_s;
    let radius = speed / turn_rate;
    let position = Vector3::new(
        radius * heading.sin(),
        radius * (1.0 - heading.cos()),
        0.02 * (3.0 * time_s).sin(),
    );
    let rotation = nalgebra::UnitQuaternion::from_euler_angles(
        0.01 * (2.0 * time_s).sin(),
        0.015 * (2.5 * time_s).sin(),
        heading,
    );
    Pose3::from_parts(position.into(), rotation)
}

const CLOCKWISE: Rotation = Rotation {
    direction: RotationDirection::Clockwise,
    period_s: 0.1,
    start_rad: std::f64::consts::PI,
};

/// Scans of the drive, ten per second; with a rotation they are not compensated.
pub(super) fn drive_scans(count: usize, rotation: Option<Rotation>) -> Vec<Scan> {
    let world = World::crossing();
    (0..count)
        .map(|number| {
            let time_s = 0.1 * number as f64;
            let mut scan = world.scan(|after_s| drive(time_s + after_s), rotation);
            scan.time_s = Some(time_s);
            scan
        })
        .collect()
}

fn with_times(scans: &[Scan], rotation: Rotation) -> Vec<Scan> {
    let timed = |scan: &Scan| Scan {
        times_s: rotation.point_times(&scan.points),
        ..scan.clone()
    };
    scans.iter().map(timed).collect()
}

fn odometer() -> Odometer {
    Odometer::new(OdometryConfig::default()).unwrap()
}

fn run(scans: &[Scan]) -> Vec<OdometryEstimate> {
    let mut odometer = odometer();
    let step = |scan| odometer.step(scan).unwrap();
    scans.iter().map(step).collect()
}

/// Largest error of the poses [m, rad].
fn largest_error(estimates: &[OdometryEstimate]) -> (f64, f64) {
    let origin = drive(0.0);
    let errors = estimates.iter().enumerate().map(|(number, estimate)| {
        let truth = origin.inverse() * drive(0.1 * number as f64);
        truth.inverse() * estimate.odom_from_lidar
    });
    errors.fold((0.0, 0.0), |(shift, turn): (f64, f64), error| {
        let error_m = error.translation.vector.norm();
        (shift.max(error_m), turn.max(error.rotation.angle()))
    })
}

#[test]
fn a_sensor_at_rest_does_not_move() {
    let world = World::crossing();
    let scan = world.scan(|_| drive(0.0), None);
    let estimates = run(&[scan.clone(), scan.clone(), scan]);
    assert_eq!(estimates[0].state, StepState::First);
    for estimate in &estimates[1..] {
        assert_eq!(estimate.state, StepState::Registered);
        let (shift_m, turn_rad) = largest_error(&estimates[..1]);
        assert_eq!((shift_m, turn_rad), (0.0, 0.0));
        assert!(estimate.odom_from_lidar.translation.vector.norm() < 5e-3);
        assert!(estimate.odom_from_lidar.rotation.angle() < 2e-4);
    }
}

#[test]
fn a_drive_is_recovered_in_six_degrees_of_freedom() {
    let estimates = run(&drive_scans(12, None));
    let (shift_m, turn_rad) = largest_error(&estimates);
    assert!(shift_m < 0.02 && turn_rad < 1e-3, "{shift_m} {turn_rad}");
    for estimate in &estimates[1..] {
        assert_eq!(estimate.state, StepState::Registered);
        assert!(estimate.degenerate_directions.is_empty());
    }
}

#[test]
fn scans_of_a_moving_sensor_are_compensated_by_their_times() {
    let raw = drive_scans(12, Some(CLOCKWISE));
    let (shift_m, turn_rad) = largest_error(&run(&with_times(&raw, CLOCKWISE)));
    assert!(shift_m < 0.03 && turn_rad < 2e-3, "{shift_m} {turn_rad}");
    let uncompensated = largest_error(&run(&raw));
    assert!(
        uncompensated.0 > 2.0 * shift_m,
        "{uncompensated:?} {shift_m}"
    );
}

#[test]
fn large_steps_at_a_low_rate_converge() {
    let world = World::crossing();
    // 3 m and 7 degrees from scan to scan.
    let times_s = [0.0, 0.5, 1.0, 1.5, 2.0];
    let scans = times_s.map(|time_s| Scan {
        time_s: Some(time_s),
        ..world.scan(|_| drive(time_s), None)
    });
    for (estimate, time_s) in run(&scans).iter().zip(times_s) {
        let error = drive(time_s).inverse() * estimate.odom_from_lidar;
        assert!(error.translation.vector.norm() < 0.03, "{time_s}: {error}");
        assert!(error.rotation.angle() < 2e-3, "{time_s}: {error}");
    }
}

#[test]
fn a_corridor_does_not_determine_its_own_direction() {
    let poses = [0.0, 0.3].map(|along_m| Pose3::translation(along_m, 0.0, 0.0));
    let scans = World::corridor().scans(&poses);
    for estimate in &run(&scans)[1..2] {
        let [direction] = estimate.degenerate_directions.as_slice() else {
            panic!("{:?}", estimate.degenerate_directions);
        };
        assert!(direction.x.abs() > 0.95, "{direction}");
        let [along_m, across_m] = [0, 1].map(|axis| estimate.covariance[(axis, axis)].sqrt());
        assert!(along_m > 0.05 && across_m < 0.01, "{along_m} {across_m}");
        assert!(estimate.odom_from_lidar.translation.y.abs() < 0.01);
    }
}

#[test]
fn lengths_are_relative_to_the_range_of_the_sensor() {
    let scans = drive_scans(6, None);
    let small: Vec<Scan> = (scans.iter())
        .map(|scan| Scan {
            points: scan.points.iter().map(|&point| point * 0.125).collect(),
            ..scan.clone()
        })
        .collect();
    for (large, small) in run(&scans).iter().zip(&run(&small)) {
        let [large, small] = [large, small].map(|estimate| estimate.odom_from_lidar);
        let difference = large.translation.vector * 0.125 - small.translation.vector;
        assert!(difference.norm() < 1e-5, "{difference}");
        assert!(large.rotation.angle_to(&small.rotation) < 1e-5);
    }
}

#[test]
fn the_number_of_threads_does_not_change_a_byte() {
    let scans = with_times(&drive_scans(5, Some(CLOCKWISE)), CLOCKWISE);
    let poses = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let estimates = pool.install(|| run(&scans));
        let values = estimates
            .iter()
            .map(|estimate| (estimate.odom_from_lidar, estimate.covariance));
        values.collect::<Vec<_>>()
    };
    assert_eq!(poses(1), poses(2));
}

#[test]
fn an_impossible_step_is_predicted_and_not_mapped() {
    let world = World::crossing();
    let mut scans = drive_scans(9, None);
    // 2.5 m to the side within a tenth of a second.
    let aside = drive(0.4) * Pose3::translation(0.0, 2.5, 0.0);
    scans[4] = Scan {
        time_s: Some(0.4),
        ..world.scan(|_| aside, None)
    };
    let estimates = run(&scans);
    assert_eq!(estimates[4].state, StepState::Predicted);
    assert_eq!(estimates[5].state, StepState::Registered);
    let (shift_m, _) = largest_error(&estimates);
    assert!(shift_m < 0.03, "{shift_m}");
    let [before, during] = [3, 4].map(|number| estimates[number].covariance[(1, 1)]);
    assert!(during > 100.0 * before);
}

#[test]
fn a_leap_that_the_next_scan_confirms_is_found_and_doubtful() {
    let world = World::crossing();
    let mut scans = drive_scans(5, None);
    // 5 m along and 20 degrees to the side within a tenth of a second.
    let leap = Pose3::new(Vector3::new(5.0, 0.5, 0.0), Vector3::z() * 0.35);
    for number in 5..9 {
        let time_s = 0.1 * f64::from(number);
        scans.push(Scan {
            time_s: Some(time_s),
            ..world.scan(|_| drive(time_s) * leap, None)
        });
    }
    let estimates = run(&scans);
    use StepState::{Doubtful, Predicted, Registered};
    let states: Vec<StepState> = estimates[4..].iter().map(|it| it.state).collect();
    assert_eq!(states[..3], [Registered, Predicted, Doubtful]);
    for (number, estimate) in estimates.iter().enumerate().skip(6) {
        let truth = drive(0.0).inverse() * drive(0.1 * number as f64) * leap;
        let error = truth.inverse() * estimate.odom_from_lidar;
        assert!(error.translation.vector.norm() < 0.05, "{number}: {error}");
        assert!(estimate.state.is_measured(), "{number}");
    }
}

#[test]
fn a_sensor_that_was_carried_away_begins_a_new_local_map() {
    let mut scans = drive_scans(4, None);
    let world = World::corridor();
    for number in 4..20 {
        let pose = Pose3::new(Vector3::zeros(), Vector3::new(0.0, 0.0, 0.7));
        scans.push(Scan {
            time_s: Some(0.1 * f64::from(number)),
            ..world.scan(|_| pose, None)
        });
    }
    let estimates = run(&scans);
    assert_eq!(estimates[4].state, StepState::Predicted);
    assert!(estimates[4..8].iter().any(|it| it.state == StepState::Lost));
    assert_eq!(estimates[19].state, StepState::Registered);
}

#[test]
fn scans_without_points_do_not_panic() {
    let mut scans = drive_scans(5, None);
    let empty = |time_s| Scan {
        time_s: Some(time_s),
        ..Scan::default()
    };
    scans.insert(0, empty(-0.1));
    scans[3] = empty(0.2);
    scans[4].points = vec![Vec3::NAN; 500];
    let states: Vec<StepState> = run(&scans).iter().map(|estimate| estimate.state).collect();
    use StepState::{First, Predicted, Registered};
    assert_eq!(
        states,
        [First, First, Registered, Predicted, Predicted, Registered]
    );
}

#[test]
fn times_of_scans_must_ascend() {
    let scans = drive_scans(2, None);
    let mut odometer = odometer();
    odometer.step(&scans[1]).unwrap();
    let error = odometer.step(&scans[0]).unwrap_err().to_string();
    assert!(error.contains("0 s follows one of time 0.1 s"), "{error}");
}

#[test]
fn the_times_that_fit_are_found() {
    let best = |scans: &[Scan]| {
        let config = OdometryConfig::default();
        let found = compare_timings(scans, CLOCKWISE.period_s, &config).unwrap();
        found.best.map(|best| found.residuals_m[best].0)
    };
    let rotations = [
        (RotationDirection::Clockwise, 180.0_f64),
        (RotationDirection::CounterClockwise, 180.0),
        (RotationDirection::Clockwise, 90.0),
        (RotationDirection::CounterClockwise, 0.0),
    ];
    for (direction, start_deg) in rotations {
        let rotation = Rotation {
            direction,
            start_rad: start_deg.to_radians(),
            ..CLOCKWISE
        };
        let found = best(&drive_scans(8, Some(rotation))).flatten().unwrap();
        let PointTiming::Rotation(found) = found else {
            panic!("{found:?}")
        };
        let apart_rad = wrap_angle(found.start_rad - rotation.start_rad);
        assert_eq!(found.direction, direction, "{start_deg}");
        assert!(apart_rad.abs() < 0.01, "{start_deg}: {apart_rad}");
    }
    assert_eq!(best(&drive_scans(8, None)), Some(None));
    let world = World::crossing();
    let at_rest = world.scan(|_| drive(0.0), None);
    assert_eq!(best(&vec![at_rest; 8]), None);
}

#[test]
fn the_order_of_the_points_fits_where_each_scan_starts_elsewhere_unless_they_are_compensated() {
    let config = OdometryConfig::default();
    let world = World::crossing();
    for direction in [
        RotationDirection::Clockwise,
        RotationDirection::CounterClockwise,
    ] {
        for are_compensated in [false, true] {
            let scan = |number: usize| {
                let time_s = 0.1 * number as f64;
                let rotation = Rotation {
                    direction,
                    start_rad: 1.9 * (number * number) as f64,
                    ..CLOCKWISE
                };
                let moved = |after_s| drive(time_s + after_s);
                let scan = world.scan(moved, Some(rotation).filter(|_| !are_compensated));
                // In the order in which they were measured.
                let times_s = rotation.point_times(&scan.points);
                let mut order: Vec<usize> = (0..scan.len()).collect();
                order.sort_by(|&a, &b| times_s[a].total_cmp(&times_s[b]));
                Scan {
                    points: order.iter().map(|&point| scan.points[point]).collect(),
                    time_s: Some(time_s),
                    ..Scan::default()
                }
            };
            let scans: Vec<Scan> = (0..8).map(scan).collect();
            let found = compare_timings(&scans, 0.1, &config).unwrap();
            let residuals_m = &found.residuals_m;
            assert!(matches!(residuals_m[1].0, Some(PointTiming::Order { .. })));
            assert_eq!(
                found.best,
                Some(usize::from(!are_compensated)),
                "{residuals_m:?}"
            );
        }
    }
}
