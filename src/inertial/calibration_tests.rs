//! Laws of the calibration on motions without and with errors.

use std::sync::Arc;

use approx::assert_relative_eq;
use rand::SeedableRng as _;
use rand::rngs::StdRng;
use rand_distr::{Distribution as _, StandardNormal};

use super::*;
use crate::inertial::{GRAVITY_M_S2, ImuSample};

/// Rates of a car [rad/s]: turns, and the pitch and roll of its suspension.
fn car(time_s: f64) -> Vector3<f64> {
    let corner = 0.4 * (0.31 * time_s).sin().powi(3) + 0.1 * (0.9 * time_s).sin();
    Vector3::new(
        0.015 * (2.3 * time_s).sin(),
        0.02 * (3.3 * time_s + 1.0).sin(),
        corner,
    )
}

/// Rates of a hand.
fn hand(time_s: f64) -> Vector3<f64> {
    Vector3::new(
        0.5 * (2.1 * time_s).sin(),
        0.7 * (1.3 * time_s + 0.4).sin(),
        0.9 * (0.7 * time_s).cos(),
    )
}

fn mounting() -> UnitQuaternion<f64> {
    UnitQuaternion::from_euler_angles(0.3, -0.2, 2.4)
}

const BIAS: Vector3<f64> = Vector3::new(0.02, -0.01, 0.015);
const DURATION_S: f64 = 120.0;

/// Measurements of a sensor whose clock shows `offset_s` at the moment 0 of the scans.
fn imu(rates: fn(f64) -> Vector3<f64>, offset_s: f64) -> Vec<ImuSample> {
    let count = (DURATION_S * 100.0) as usize;
    (0..count)
        .map(|row| {
            let time_s = 0.01 * row as f64;
            ImuSample {
                time_s: time_s + offset_s,
                rate_rad_s: mounting().inverse() * rates(time_s) + BIAS,
                force_m_s2: Vector3::z() * GRAVITY_M_S2,
            }
        })
        .collect()
}

/// Rotations between scans, ten per second, with errors of a standard deviation.
fn turns(rates: fn(f64) -> Vector3<f64>, sigma_rad: f64) -> Vec<MeasuredTurn> {
    turns_every(0.1, rates, sigma_rad)
}

fn turns_every(period_s: f64, rates: fn(f64) -> Vector3<f64>, sigma_rad: f64) -> Vec<MeasuredTurn> {
    const STEPS: usize = 100;
    let mut rng = StdRng::seed_from_u64(3);
    let mut deviate = || -> f64 { StandardNormal.sample(&mut rng) };
    let margin = (1.0 / period_s) as usize;
    (margin..(DURATION_S / period_s) as usize - margin)
        .map(|scan| {
            let from_s = period_s * scan as f64;
            let mut turn = UnitQuaternion::identity();
            for step in 0..STEPS {
                let time_s = from_s + period_s * (step as f64 + 0.5) / STEPS as f64;
                turn *= UnitQuaternion::from_scaled_axis(rates(time_s) * period_s / STEPS as f64);
            }
            let error = Vector3::new(deviate(), deviate(), deviate()) * sigma_rad;
            MeasuredTurn {
                from_s,
                to_s: from_s + period_s,
                turn: turn * UnitQuaternion::from_scaled_axis(error),
            }
        })
        .collect()
}

fn estimate(
    samples: Vec<ImuSample>,
    turns: &[MeasuredTurn],
    lidar_from_imu: Option<UnitQuaternion<f64>>,
) -> Result<ImuCalibration, ImuRejection> {
    let imu = Imu {
        samples: Arc::new(ImuSamples::new(samples).unwrap()),
        lidar_from_imu,
    };
    ImuCalibration::estimate(&imu, turns)
}

/// Errors of rotations between scans of a real sensor [rad].
const NOISE_RAD: f64 = 0.001;

#[test]
fn axes_clock_and_bias_are_found() {
    for rates in [car, hand] {
        for offset_s in [0.0, 0.05, -0.173] {
            let exact = estimate(imu(rates, offset_s), &turns(rates, 0.0), None).unwrap();
            assert_relative_eq!(exact.offset_s, offset_s, epsilon = 1e-3);
            assert!(exact.lidar_from_imu.angle_to(&mounting()) < 0.01);
            assert!((exact.rate_bias_rad_s - BIAS).norm() < 1e-3);
            let noisy = estimate(imu(rates, offset_s), &turns(rates, NOISE_RAD), None).unwrap();
            assert_relative_eq!(noisy.offset_s, offset_s, epsilon = 4e-3);
            let off_rad = noisy.lidar_from_imu.angle_to(&mounting());
            assert!(off_rad < 3.0 * noisy.axes_sigma_rad, "{off_rad} {noisy:?}");
            assert!((noisy.rate_bias_rad_s - BIAS).norm() < 2e-3);
        }
    }
}

#[test]
fn rotations_about_changing_axes_over_half_a_second_do_not_add_up_to_those_of_the_sensor() {
    let shaken = |time_s: f64| 4.0 * hand(2.0 * time_s);
    let found = estimate(imu(shaken, 0.05), &turns_every(0.5, shaken, 0.0), None).unwrap();
    assert_relative_eq!(found.offset_s, 0.05, epsilon = 1e-3);
    let off_rad = found.lidar_from_imu.angle_to(&mounting());
    assert!(off_rad < 1e-3 && found.residual_rad_s < 0.02, "{found:?}");
    assert!((found.rate_bias_rad_s - BIAS).norm() < 1e-3, "{found:?}");
}

#[test]
fn single_wrong_rotations_do_not_count() {
    let mut turns = turns(car, NOISE_RAD);
    for turn in turns.iter_mut().step_by(23) {
        turn.turn = UnitQuaternion::from_euler_angles(0.3, 0.1, -0.4);
    }
    let found = estimate(imu(car, 0.05), &turns, None).unwrap();
    assert_relative_eq!(found.offset_s, 0.05, epsilon = 4e-3);
    assert!(found.lidar_from_imu.angle_to(&mounting()) < 3.0 * found.axes_sigma_rad);
}

#[test]
fn swapped_axes_are_estimated_and_refused_where_others_are_given() {
    let swapped = |samples: Vec<ImuSample>| -> Vec<ImuSample> {
        let swap = |v: Vector3<f64>| Vector3::new(v.y, v.z, v.x);
        (samples.into_iter())
            .map(|sample| ImuSample {
                rate_rad_s: swap(sample.rate_rad_s),
                ..sample
            })
            .collect()
    };
    let turns = turns(car, NOISE_RAD);
    assert!(estimate(swapped(imu(car, 0.0)), &turns, None).is_ok());
    let refused = estimate(swapped(imu(car, 0.0)), &turns, Some(mounting())).unwrap_err();
    let text = refused.to_string();
    assert!(text.contains("with axes turned by 12"), "{text}");
    assert!(estimate(imu(car, 0.0), &turns, Some(mounting())).is_ok());
}

#[test]
fn a_wrong_sensor_is_refused_with_its_reason() {
    let noisy = |rates| turns(rates, NOISE_RAD);
    // Another drive, and a clock that is off by more than is searched for.
    let other = |time_s: f64| car(time_s + 37.0);
    for (sensor, turns) in [(imu(other, 0.0), noisy(car)), (imu(hand, 0.6), noisy(hand))] {
        let refused = estimate(sensor, &turns, None).unwrap_err();
        assert!(
            matches!(
                refused,
                ImuRejection::Unexplained { .. } | ImuRejection::Offset { .. }
            ),
            "{refused}"
        );
    }
    // Another time.
    let refused = estimate(imu(car, 1e6), &noisy(car), None).unwrap_err();
    assert!(matches!(
        refused,
        ImuRejection::NotCovered { covered: 0, .. }
    ));
    // One axis mirrored.
    let mut mirrored = imu(hand, 0.0);
    for sample in &mut mirrored {
        sample.rate_rad_s.y *= -1.0;
    }
    let refused = estimate(mirrored, &noisy(hand), None).unwrap_err();
    assert_eq!(refused, ImuRejection::Mirrored);
    // Another scale, with its axes given and not.
    for (scale, given) in [(1.5, None), (0.45, Some(mounting())), (57.3, None)] {
        let mut scaled = imu(car, 0.0);
        for sample in &mut scaled {
            sample.rate_rad_s *= scale;
        }
        let refused = estimate(scaled, &noisy(car), given).unwrap_err();
        let ImuRejection::Scaled { scale: found } = refused else {
            panic!("{refused}");
        };
        assert_relative_eq!(found, scale, max_relative = 0.02);
    }
    // Noise is no scale.
    let mut rng = StdRng::seed_from_u64(5);
    let mut vibrating = imu(car, 0.0);
    for sample in &mut vibrating {
        let mut deviate = || -> f64 { StandardNormal.sample(&mut rng) };
        sample.rate_rad_s += Vector3::new(deviate(), deviate(), deviate()) * 0.3;
    }
    let found = estimate(vibrating, &noisy(car), Some(mounting()));
    assert!(
        !matches!(found, Err(ImuRejection::Scaled { .. })),
        "{found:?}"
    );
    // A range of 0.2 rad/s.
    let mut clipped = imu(car, 0.0);
    for sample in &mut clipped {
        sample.rate_rad_s = sample.rate_rad_s.map(|rate| rate.clamp(-0.2, 0.2));
    }
    let refused = estimate(clipped, &noisy(car), None).unwrap_err();
    assert_eq!(refused, ImuRejection::Saturated);
    // Nothing turns.
    let straight = |_| Vector3::zeros();
    let refused = estimate(imu(straight, 0.0), &noisy(straight), None).unwrap_err();
    assert!(matches!(refused, ImuRejection::TooStill { .. }));
    // Turns about one axis do not show how the others lie.
    let flat = |time_s: f64| Vector3::z() * car(time_s).z;
    let refused = estimate(imu(flat, 0.0), &noisy(flat), None).unwrap_err();
    assert!(
        matches!(refused, ImuRejection::AxesUnknown { .. }),
        "{refused}"
    );
}
