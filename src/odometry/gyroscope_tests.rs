//! Laws of the odometry of scans with a gyroscope: a sensor in the hand, twice per second.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};

use super::tests::World;
use super::{ImuCalibrator, Odometer, OdometryConfig, OdometryEstimate, StepState};
use crate::geometry::Pose3;
use crate::inertial::{GRAVITY_M_S2, Gyroscope, Imu, ImuRejection, ImuSample, ImuSamples};
use crate::lidar::{Rotation, RotationDirection, Scan};

const PERIOD_S: f64 = 0.5;

/// Walking at 1.2 m/s, the sensor turned by up to 30 degrees about each axis.
fn hand(time_s: f64) -> Pose3 {
    let position = Vector3::new(1.2 * time_s, 0.3 * (0.8 * time_s).sin(), 0.02);
    let rotation = UnitQuaternion::from_euler_angles(
        0.35 * (2.9 * time_s).sin(),
        0.5 * (3.7 * time_s + 1.0).sin(),
        0.4 * (1.9 * time_s).sin(),
    );
    Pose3::from_parts(position.into(), rotation)
}

/// Scans of the walk, one in each period.
fn scans(count: usize, period_s: f64) -> Vec<Scan> {
    let rotation = Rotation {
        direction: RotationDirection::CounterClockwise,
        period_s: 0.1,
        start_rad: std::f64::consts::PI,
    };
    let world = World::crossing();
    (0..count)
        .map(|number| {
            let moment_s = period_s * number as f64;
            let mut scan = world.scan(|after_s| hand(moment_s + after_s), Some(rotation));
            scan.times_s = rotation.point_times(&scan.points);
            scan.time_s = Some(moment_s);
            scan
        })
        .collect()
}

/// Measurements of a sensor with the axes of the lidar, whose rates are multiplied by a factor and have a bias [rad/s].
fn imu(seconds: usize, factor: f64, bias_rad_s: Vector3<f64>) -> Imu {
    const STEP_S: f64 = 0.005;
    let rows = -100..200 * seconds as i32 + 100;
    let samples = rows.map(|row| {
        let [before, after] = [-1, 1].map(|step| hand(STEP_S * f64::from(row + step)).rotation);
        ImuSample {
            time_s: STEP_S * f64::from(row),
            rate_rad_s: (before.inverse() * after).scaled_axis() * factor / (2.0 * STEP_S)
                + bias_rad_s,
            force_m_s2: Vector3::z() * GRAVITY_M_S2,
        }
    });
    Imu {
        samples: Arc::new(ImuSamples::new(samples.collect()).unwrap()),
        lidar_from_imu: None,
    }
}

fn with_gyroscope(scans: &[Scan], bias_rad_s: Vector3<f64>) -> Vec<Scan> {
    let seconds = (PERIOD_S * scans.len() as f64).ceil() as usize;
    let gyroscope = Arc::new(Gyroscope::exact(&imu(seconds, 1.0, bias_rad_s)));
    let measured = |scan: &Scan| Scan {
        gyroscope: Some(gyroscope.clone()),
        ..scan.clone()
    };
    scans.iter().map(measured).collect()
}

fn run(scans: &[Scan]) -> Vec<OdometryEstimate> {
    let mut odometer = Odometer::new(OdometryConfig::default()).unwrap();
    let step = |scan| odometer.step(scan).unwrap();
    scans.iter().map(step).collect()
}

/// Largest error of a position [m].
fn largest_error_m(estimates: &[OdometryEstimate]) -> f64 {
    let errors = estimates.iter().enumerate().map(|(number, estimate)| {
        let truth = hand(0.0).inverse() * hand(PERIOD_S * number as f64);
        (truth.translation.vector - estimate.odom_from_lidar.translation.vector).norm()
    });
    errors.fold(0.0, f64::max)
}

#[test]
fn a_sensor_in_the_hand_is_followed_with_a_gyroscope() {
    let scans = scans(20, PERIOD_S);
    let (without, with) = (run(&scans), run(&with_gyroscope(&scans, Vector3::zeros())));
    let errors_m = (largest_error_m(&without), largest_error_m(&with));
    eprintln!("{errors_m:?} m");
    // Where the walk ends, nothing but few poles shows how far along the street it is.
    assert!(errors_m.0 > 3.0 && errors_m.1 < 0.3, "{errors_m:?}");
}

#[test]
fn a_scan_that_does_not_fit_is_predicted_by_the_measured_rotation() {
    let mut scans = with_gyroscope(&scans(8, PERIOD_S), Vector3::zeros());
    // Nothing is seen.
    scans[7].points.truncate(10);
    scans[7].times_s.truncate(10);
    let estimates = run(&scans);
    assert_eq!(estimates[7].state, StepState::Predicted);
    let truth = hand(0.0).inverse() * hand(7.0 * PERIOD_S);
    let off_rad = (truth.rotation).angle_to(&estimates[7].odom_from_lidar.rotation);
    assert!(off_rad < 0.01, "{off_rad}");
}

#[test]
fn a_bias_that_has_changed_is_estimated() {
    /// Scans that turn with the sensor and stay at the crossing.
    fn turning(number: usize) -> Pose3 {
        Pose3::from_parts(
            hand(0.0).translation,
            hand(PERIOD_S * number as f64).rotation,
        )
    }
    let bias_rad_s = Vector3::new(0.02, -0.03, 0.04);
    let world = World::crossing();
    let still: Vec<Scan> = (0..SCANS)
        .map(|number| Scan {
            time_s: Some(PERIOD_S * number as f64),
            ..world.scan(|_| turning(number), None)
        })
        .collect();
    let off_rad = |bias_rad_s: Vector3<f64>| {
        let mut scans = with_gyroscope(&still, bias_rad_s);
        // Nothing is seen by the last two, so that the last is predicted over a second.
        for scan in &mut scans[SCANS - 2..] {
            scan.points.truncate(10);
        }
        let last = run(&scans).pop().unwrap();
        assert_eq!(last.state, StepState::Predicted);
        let truth = turning(0).inverse() * turning(SCANS - 1);
        (truth.rotation).angle_to(&last.odom_from_lidar.rotation)
    };
    let (right, wrong) = (off_rad(Vector3::zeros()), off_rad(bias_rad_s));
    eprintln!("{right:.4} {wrong:.4} rad");
    // A share of exp(-60 s / 30 s) remains of 0.054 rad.
    assert!(right < 0.01 && wrong < 0.018, "{right} {wrong}");
}

/// Scans of a minute.
const SCANS: usize = 122;

#[test]
fn a_calibration_ends_when_the_sensor_is_known_or_contradicts_the_scans() {
    let scans = scans(80, 0.1);
    let ended = |imu: Imu| {
        let mut calibrator = ImuCalibrator::new(imu, OdometryConfig::default()).unwrap();
        for (number, scan) in scans.iter().enumerate() {
            if let Some(verdict) = calibrator.add(scan).unwrap() {
                return (number, verdict.map(|_| ()));
            }
        }
        (scans.len(), calibrator.finish().map(|_| ()))
    };
    let (number, verdict) = ended(imu(8, 1.0, Vector3::zeros()));
    assert!(number < 80 && verdict.is_ok(), "{number} {verdict:?}");
    let (_, verdict) = ended(imu(8, 3.0, Vector3::zeros()));
    assert!(
        matches!(verdict, Err(ImuRejection::Scaled { .. })),
        "{verdict:?}"
    );
}
