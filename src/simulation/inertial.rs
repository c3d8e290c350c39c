//! Inertial measurements of a drive: rates and forces of its poses, with the errors of a sensor.
//!
//! ```text
//! measured = true + bias + drift + noise        drift: first-order Gauss-Markov,   noise: white, σ = density · √rate
//! ```
//!
//! The true values are differences of the poses 10 ms apart, so that they add up to the motion exactly.

use nalgebra::Vector3;
use rand::Rng;
use rand_distr::{Distribution as _, StandardNormal};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::geometry::{Pose3, pose_from_degrees};
use crate::inertial::{GRAVITY_M_S2, ImuSample};
use crate::validation::{InvalidValue, Validate, in_range};

/// Time between measurements [s].
const PERIOD_S: f64 = 0.01;
/// Measurements before the first and after the last scan.
const MARGIN: i64 = 50;
/// Time in which the drift of a bias changes [s].
const DRIFT_S: f64 = 300.0;

/// Pose of the sensor on the lidar: below and behind it, and turned.
pub(super) fn lidar_from_imu() -> Pose3 {
    pose_from_degrees([-0.4, 0.1, -0.6, 2.0, -1.5, 88.0])
}

/// The inertial sensor of a simulated drive, whose measurements are written to `imu.csv`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedImuConfig {
    /// Its errors; null: no sensor.
    pub grade: Option<ImuGrade>,
    /// Time of its clock at the moment 0 of that of the scans [s].
    pub clock_offset_s: f64,
}

impl Validate for SimulatedImuConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("clock_offset_s", self.clock_offset_s, -10.0..=10.0)
    }
}

/// Errors of an inertial sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ImuGrade {
    /// None.
    Exact,
    /// A sensor of phones and drones, after Bosch BMI088 (data sheet BST-BMI088-DS001, section 1): noise of rates 0.014
    /// deg/s/√Hz, offset 1 deg/s, bias stability 2 deg/h; noise of forces 160 to 190 µg/√Hz by axis, here 175, offset 20 mg, and
    /// 0.2 mg per kelvin, of which it is assumed to drift by one.
    Consumer,
    /// A calibrated sensor for vehicles, after Analog Devices' ADIS16470 (data sheet, revision C, features): noise of rates 0.008
    /// deg/s/√Hz, bias stability 8 deg/h and 13 µg, here 20 µg. Assumed: offsets of 0.2 deg/s and 3 mg, and a noise of forces of
    /// 100 µg/√Hz.
    Automotive,
}

/// Errors of rates or forces, in their unit: density of the noise [1/√Hz], offset, and drift of the bias.
struct Errors {
    density: f64,
    offset: f64,
    drift: f64,
}

impl ImuGrade {
    fn errors(self) -> [Errors; 2] {
        let errors = |[density, offset, drift]: [f64; 3], unit: f64| Errors {
            density: density * unit,
            offset: offset * unit,
            drift: drift * unit,
        };
        let (deg, milli_g) = (1_f64.to_radians(), 1e-3 * GRAVITY_M_S2);
        let (rates, forces) = match self {
            Self::Exact => ([0.0; 3], [0.0; 3]),
            Self::Consumer => ([0.014, 1.0, 2.0 / 3600.0], [0.175, 20.0, 0.2]),
            Self::Automotive => ([0.008, 0.2, 8.0 / 3600.0], [0.1, 3.0, 0.02]),
        };
        [errors(rates, deg), errors(forces, milli_g)]
    }
}

/// What a sensor measures from half a second before a drive that lasts some seconds until half a second after it, by the
/// pose of the lidar at each time; nothing without one.
pub(super) fn imu_samples(
    config: &SimulatedImuConfig,
    duration_s: f64,
    world_from_lidar: impl Fn(f64) -> Pose3,
    rng: &mut impl Rng,
) -> Vec<ImuSample> {
    let Some(grade) = config.grade else {
        return vec![];
    };
    let last = (duration_s / PERIOD_S).round() as i64 + MARGIN;
    let pose_at = |row: i64| world_from_lidar(PERIOD_S * row as f64) * lidar_from_imu();
    let poses: Vec<Pose3> = (-MARGIN - 1..=last + 1).map(pose_at).collect();
    let mut errors = grade.errors().map(|errors| ErrorProcess::new(errors, rng));
    let rows = (-MARGIN..=last).zip(poses.windows(3));
    rows.map(|(row, poses)| {
        let [rate, force] = measured(poses);
        let [of_rate, of_force] = errors.each_mut().map(|errors| errors.next(rng));
        ImuSample {
            time_s: PERIOD_S * row as f64 + config.clock_offset_s,
            rate_rad_s: rate + of_rate,
            force_m_s2: force + of_force,
        }
    })
    .collect()
}

/// Rate and force at the second of three poses in succession.
fn measured(poses: &[Pose3]) -> [Vector3<f64>; 2] {
    let [p, q, r] = [0, 1, 2].map(|row| poses[row].translation.vector);
    let acceleration = (r - q * 2.0 + p) / PERIOD_S.powi(2);
    let force = acceleration + Vector3::z() * GRAVITY_M_S2;
    let turn = poses[0].rotation.inverse() * poses[2].rotation;
    [
        turn.scaled_axis() / (2.0 * PERIOD_S),
        poses[1].rotation.inverse() * force,
    ]
}

/// Errors by time.
struct ErrorProcess {
    errors: Errors,
    offset: Vector3<f64>,
    drift: Vector3<f64>,
}

impl ErrorProcess {
    fn new(errors: Errors, rng: &mut impl Rng) -> Self {
        Self {
            // Of a data sheet's typical offset, to either side.
            offset: normal(rng) * errors.offset,
            drift: normal(rng) * errors.drift,
            errors,
        }
    }

    fn next(&mut self, rng: &mut impl Rng) -> Vector3<f64> {
        let share = PERIOD_S / DRIFT_S;
        self.drift *= 1.0 - share;
        self.drift += normal(rng) * (self.errors.drift * (2.0 * share).sqrt());
        let noise = normal(rng) * (self.errors.density / PERIOD_S.sqrt());
        self.offset + self.drift + noise
    }
}

fn normal(rng: &mut impl Rng) -> Vector3<f64> {
    let mut deviate = || -> f64 { StandardNormal.sample(rng) };
    Vector3::new(deviate(), deviate(), deviate())
}
