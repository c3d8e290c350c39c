//! Laws of the levelling on a drive of 3.7 km with corners and hills.

use approx::assert_relative_eq;
use rand::SeedableRng as _;
use rand::rngs::StdRng;
use rand_distr::{Distribution as _, StandardNormal};

use super::*;
use crate::inertial::ImuSample;

const IMU_PERIOD_S: f64 = 0.01;
const SCAN_EVERY: usize = 10;
/// Offset of the clock of the sensor.
const OFFSET_S: f64 = 0.15;

/// Errors of an accelerometer [m/s²].
struct Errors {
    bias: Vector3<f64>,
    noise: f64,
}

/// An offset of 20 mg and a noise of 175 µg/√Hz, as that of a consumer's sensor.
const CONSUMER: Errors = Errors {
    bias: Vector3::new(0.196, -0.15, 0.1),
    noise: 0.0172,
};
/// An offset of 3 mg and a noise of 100 µg/√Hz, as that of a calibrated sensor of cars.
const AUTOMOTIVE: Errors = Errors {
    bias: Vector3::new(0.0294, -0.0225, 0.015),
    noise: 0.0098,
};
const NONE: Errors = Errors {
    bias: Vector3::new(0.0, 0.0, 0.0),
    noise: 0.0,
};

/// A drive of 10 m/s around blocks of 200 m, up and down hills of 6 m; the lidar is tilted on its car.
fn truth(duration_s: f64) -> Vec<Pose3> {
    let lidar = UnitQuaternion::from_euler_angles(0.02, -0.03, 0.0);
    let (mut heading, mut position, mut path_m) = (0.0_f64, Vector3::<f64>::zeros(), 0.0_f64);
    (0..(duration_s / IMU_PERIOD_S) as usize)
        .map(|step| {
            let time_s = IMU_PERIOD_S * step as f64;
            let speed = 10.0 + 2.0 * (0.2 * time_s).sin();
            let in_block = time_s % 20.0;
            let side = if (time_s / 20.0) as usize % 5 == 3 {
                -1.0
            } else {
                1.0
            };
            let rate = if (15.0..19.0).contains(&in_block) {
                side * 0.25 * PI * 0.5 * (1.0 - (PI * (in_block - 15.0) / 2.0).cos())
            } else {
                0.0
            };
            heading += rate * IMU_PERIOD_S;
            let slope = 6.0 / 80.0 * (path_m / 80.0).cos();
            path_m += speed * IMU_PERIOD_S;
            position += Vector3::new(heading.cos(), heading.sin(), slope) * speed * IMU_PERIOD_S;
            let nodding = 0.005 * (3.3 * time_s).sin();
            let body = UnitQuaternion::from_euler_angles(0.0, nodding - slope.atan(), heading);
            Pose3::from_parts(position.into(), body * lidar)
        })
        .collect()
}

/// What a sensor with the axes of the lidar measures on a drive.
fn measured(truth: &[Pose3], errors: &Errors) -> ImuSamples {
    let mut rng = StdRng::seed_from_u64(5);
    let mut deviate = || -> f64 { StandardNormal.sample(&mut rng) };
    let rows = (1..truth.len() - 1).map(|row| {
        let [before, here, after] = [row - 1, row, row + 1].map(|row| truth[row]);
        let [p, q, r] = [before, here, after].map(|pose| pose.translation.vector);
        let acceleration = (r - q * 2.0 + p) / IMU_PERIOD_S.powi(2);
        let force = acceleration + Vector3::z() * GRAVITY_M_S2;
        let noise = Vector3::new(deviate(), deviate(), deviate()) * errors.noise;
        let turn = (before.rotation.inverse() * after.rotation).scaled_axis();
        ImuSample {
            time_s: IMU_PERIOD_S * row as f64 + OFFSET_S,
            rate_rad_s: turn / (2.0 * IMU_PERIOD_S),
            force_m_s2: here.rotation.inverse() * force + errors.bias + noise,
        }
    });
    ImuSamples::new(rows.collect()).unwrap()
}

/// True poses of the scans, relative to the first, and those of an odometry that tilts by a random walk and a steady drift.
fn scans(truth: &[Pose3], drifts: bool) -> (Vec<Pose3>, Vec<Pose3>, Vec<f64>) {
    let mut rng = StdRng::seed_from_u64(7);
    let share = if drifts { 1.0 } else { 0.0 };
    let mut deviate = || {
        let deviate: f64 = StandardNormal.sample(&mut rng);
        share * deviate
    };
    let scans: Vec<Pose3> = truth.iter().step_by(SCAN_EVERY).copied().collect();
    let times_s = (0..scans.len()).map(|row| IMU_PERIOD_S * (SCAN_EVERY * row) as f64);
    let mut pose = Pose3::identity();
    let mut odometry = vec![pose];
    for pair in scans.windows(2) {
        let drift = Vector3::new(0.0, 5e-5 * share, 0.0)
            + Vector3::new(deviate(), deviate(), deviate()) * 1e-4;
        let motion = pair[0].inverse() * pair[1];
        pose *= Pose3::from_parts(
            motion.translation,
            motion.rotation * UnitQuaternion::from_scaled_axis(drift),
        );
        odometry.push(pose);
    }
    // The error of a single scan does not stay.
    for pose in &mut odometry {
        pose.translation.vector += Vector3::new(deviate(), deviate(), deviate()) * 0.01;
    }
    (scans, odometry, times_s.collect())
}

fn calibration() -> ImuCalibration {
    ImuCalibration {
        lidar_from_imu: UnitQuaternion::identity(),
        offset_s: OFFSET_S,
        rate_bias_rad_s: Vector3::zeros(),
        residual_rad_s: 0.0,
        axes_sigma_rad: 0.0,
    }
}

/// Largest error of the height [m], and mean and largest one of the direction up [deg].
fn errors(truth: &[Pose3], poses: &[Pose3]) -> [f64; 3] {
    let risen = |poses: &[Pose3], row: usize| poses[row].translation.z - poses[0].translation.z;
    let heights_m = (0..truth.len()).map(|row| (risen(poses, row) - risen(truth, row)).abs());
    let tilts_deg = truth.iter().zip(poses).map(|(truth, pose)| {
        let [a, b] = [truth, pose].map(|it| it.rotation.inverse() * Vector3::z());
        a.angle(&b).to_degrees()
    });
    let largest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
    let mean = tilts_deg.clone().sum::<f64>() / truth.len() as f64;
    [
        largest(&mut heights_m.into_iter()),
        mean,
        largest(&mut tilts_deg.into_iter()),
    ]
}

/// The errors of a drive whose first pose is level already, without and with an accelerometer.
fn without_and_with(drifts: bool, of_sensor: &Errors) -> ([f64; 3], [f64; 3], Levelled) {
    let truth = truth(370.0);
    let samples = measured(&truth, of_sensor);
    let (scans, odometry, times_s) = scans(&truth, drifts);
    let found = level(&odometry, &times_s, &samples, &calibration()).unwrap();
    let without: Vec<Pose3> = odometry.iter().map(|pose| scans[0] * pose).collect();
    (
        errors(&scans, &without),
        errors(&scans, &found.poses),
        found,
    )
}

#[test]
fn exact_measurements_show_the_exact_direction_up() {
    let ([height_m, ..], [levelled_m, mean_deg, most_deg], found) = without_and_with(false, &NONE);
    assert!(height_m < 1e-6);
    assert!(levelled_m < 0.15, "{levelled_m}");
    assert!(mean_deg < 0.01 && most_deg < 0.05, "{mean_deg} {most_deg}");
    assert!(found.force_bias_m_s2.norm() < 0.01, "{found:?}");
}

#[test]
fn over_3700_m_height_and_tilt_do_not_drift_with_an_accelerometer() {
    for (name, of_sensor) in [("consumer", CONSUMER), ("automotive", AUTOMOTIVE)] {
        let (without, with, found) = without_and_with(true, &of_sensor);
        let text = format!("{name} [m, mean deg, largest deg] {without:?} {with:?}");
        eprintln!("{text}, deg: {}", found.sigma_rad.to_degrees());
        assert!(with[1] < 0.05 && with[2] < 0.25, "{text}");
        assert!(with[0] < 0.4 && with[0] < 0.15 * without[0], "{text}");
        assert_relative_eq!(found.force_bias_m_s2, of_sensor.bias, epsilon = 0.02);
        assert!(found.sigma_rad.to_degrees() < 0.1);
    }
}

#[test]
fn an_odometry_that_does_not_drift_keeps_its_shape() {
    let truth = truth(370.0);
    for errors in [NONE, CONSUMER] {
        let samples = measured(&truth, &errors);
        let (_, odometry, times_s) = scans(&truth, false);
        let found = level(&odometry, &times_s, &samples, &calibration()).unwrap();
        let middle = odometry.len() / 2;
        let level_from_odom = found.poses[middle] * odometry[middle].inverse();
        let bent_m = (odometry.iter().zip(&found.poses)).map(|(odometry, found)| {
            let moved = level_from_odom * odometry;
            (moved.translation.vector - found.translation.vector).norm()
        });
        let bent_m = bent_m.fold(0.0, f64::max);
        eprintln!("bent by {bent_m} m over 3.7 km");
        assert!(bent_m < 0.1, "{bent_m}");
    }
}

#[test]
fn a_straight_drive_does_not_tell_a_bias_from_a_tilt_and_says_so() {
    let steady: Vec<Pose3> = (0..6000)
        .map(|step| Pose3::translation(0.1 * f64::from(step), 0.0, 0.0))
        .collect();
    let samples = measured(&steady, &CONSUMER);
    let (_, odometry, times_s) = scans(&steady, false);
    let found = level(&odometry, &times_s, &samples, &calibration()).unwrap();
    // The prior of the bias over that of gravity.
    assert_relative_eq!(found.sigma_rad, 0.3 / GRAVITY_M_S2, epsilon = 0.004);
}

#[test]
fn forces_of_another_drive_are_refused() {
    let truth = truth(120.0);
    let (_, odometry, times_s) = scans(&truth, true);
    let mut samples = measured(&truth, &CONSUMER).rows().to_vec();
    for sample in &mut samples {
        // The axes of the accelerometer are not those of the rates.
        let force = sample.force_m_s2;
        sample.force_m_s2 = Vector3::new(force.z, force.x, -force.y);
    }
    let swapped = level(
        &odometry,
        &times_s,
        &ImuSamples::new(samples.clone()).unwrap(),
        &calibration(),
    );
    assert!(
        matches!(swapped, Err(ImuRejection::Forces { .. })),
        "{swapped:?}"
    );
    let short = level(
        &odometry[..30],
        &times_s[..30],
        &ImuSamples::new(samples).unwrap(),
        &calibration(),
    );
    assert!(matches!(short, Err(ImuRejection::TooShort { .. })));
}

#[test]
fn the_constraint_pulls_a_tilted_pose_upright_and_leaves_its_heading() {
    let levels = Levels {
        up_in_lidar: vec![Vector3::z()],
        information: 1e4,
    };
    let mut pose = Pose3::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.05, -0.08, 0.0));
    let heading = crate::geometry::yaw(&pose);
    for _ in 0..5 {
        let mut system = BlockSystem::new(1);
        levels.add_to(&mut system, (0, 0), &pose, 1.0);
        system.add(0, &(Matrix6::identity() * 1e-3), &Vector6::zeros());
        pose *= crate::geometry::pose::exponential(&system.solve().unwrap()[0]);
    }
    assert_relative_eq!((pose.rotation * Vector3::z()).z, 1.0, epsilon = 1e-9);
    assert_relative_eq!(crate::geometry::yaw(&pose), heading, epsilon = 0.01);
    assert_relative_eq!(pose.translation.vector, Vector3::new(1.0, 2.0, 3.0));
}
