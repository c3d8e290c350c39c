//! Inertial measurements of a drive are those of its poses.

use std::sync::Arc;

use super::inertial::lidar_from_imu;
use super::{ImuGrade, SimulatedImuConfig, Simulation, SimulationConfig};
use crate::inertial::{GRAVITY_M_S2, Imu, ImuCalibration, ImuSamples, MeasuredTurn};
use crate::memory::MemoryBudget;

fn drive(grade: ImuGrade) -> Simulation {
    let config = SimulationConfig {
        imu: SimulatedImuConfig {
            grade: Some(grade),
            clock_offset_s: 0.05,
        },
        ..SimulationConfig::default()
    };
    Simulation::new(&config, None, MemoryBudget::default()).unwrap()
}

fn calibrated(drive: &Simulation) -> ImuCalibration {
    let (poses, times_s) = (drive.poses(), drive.times_s());
    let turns: Vec<MeasuredTurn> = (1..poses.len())
        .map(|row| MeasuredTurn {
            from_s: times_s[row - 1],
            to_s: times_s[row],
            turn: poses[row - 1].rotation.inverse() * poses[row].rotation,
        })
        .collect();
    let imu = Imu {
        samples: Arc::new(ImuSamples::new(drive.imu_samples()).unwrap()),
        lidar_from_imu: None,
    };
    ImuCalibration::estimate(&imu, &turns).unwrap()
}

#[test]
fn rates_are_those_of_the_poses_on_the_clock_of_the_sensor() {
    let found = calibrated(&drive(ImuGrade::Exact));
    assert!((found.offset_s - 0.05).abs() < 2e-3, "{found:?}");
    let off_rad = (found.lidar_from_imu).angle_to(&lidar_from_imu().rotation);
    assert!(off_rad < 0.5_f64.to_radians(), "{off_rad}");
    assert!(found.rate_bias_rad_s.norm() < 1e-3);
}

#[test]
fn forces_at_rest_are_gravity_and_their_errors_those_of_the_grade() {
    let drive = drive(ImuGrade::Consumer);
    let samples = drive.imu_samples();
    let count = samples.len() as f64;
    let mean: f64 = samples.iter().map(|it| it.force_m_s2.norm()).sum::<f64>() / count;
    assert!((mean - GRAVITY_M_S2).abs() < 0.6, "{mean}");
    // White noise: half of the mean square of differences, without the motion that changes slowly.
    let differences = samples.windows(3).map(|it| {
        let [a, b, c] = [it[0], it[1], it[2]].map(|it| it.rate_rad_s.x);
        (a - 2.0 * b + c).powi(2) / 6.0
    });
    let sigma = (differences.sum::<f64>() / (count - 2.0)).sqrt();
    let expected = 0.14_f64.to_radians();
    assert!((sigma / expected - 1.0).abs() < 0.2, "{sigma} {expected}");
    assert_eq!(samples, drive.imu_samples());
}

#[test]
fn a_drive_without_a_sensor_measures_nothing() {
    let config = SimulationConfig::default();
    let drive = Simulation::new(&config, None, MemoryBudget::default()).unwrap();
    assert!(drive.imu_samples().is_empty());
}
