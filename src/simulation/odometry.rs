//! Odometry with drift: what the wheels and a gyroscope would say.
//!
//! Each increment of the true poses is stretched, turned and shaken, then they are chained:
//!
//! ```text
//! Δ̂ₖ = Exp(ω_drift dₖ + ε_ω) · Δₖ(with translation (1 + s) tₖ + ε_t)        P̂ₖ = P̂ₖ₋₁ Δ̂ₖ
//! ```

use nalgebra::{UnitQuaternion, Vector3};
use rand_distr::{Distribution as _, StandardNormal};
use serde::{Deserialize, Serialize};

use super::random::{Purpose, stream};
use crate::geometry::Pose3;

/// The errors of the odometry.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OdometryConfig {
    /// Share by which distances come out too long.
    pub scale_error: f64,
    /// Turn to the left per metre that did not happen [deg/m].
    pub heading_drift_deg_per_m: f64,
    /// Standard deviation of each component of a step [m].
    pub step_noise_m: f64,
    /// Standard deviation of each component of a turn, per scan [deg].
    pub turn_noise_deg: f64,
}

impl Default for OdometryConfig {
    /// A decent wheel odometry: 1 % too long, a degree in 100 m.
    fn default() -> Self {
        Self {
            scale_error: 0.01,
            heading_drift_deg_per_m: 0.01,
            step_noise_m: 0.01,
            turn_noise_deg: 0.02,
        }
    }
}

/// The poses that odometry reports for true poses, starting at the first of them.
pub fn drifting_odometry(
    true_poses: &[Pose3],
    config: &OdometryConfig,
    (seed, drive): (u64, u32),
) -> Vec<Pose3> {
    let mut rng = stream(seed, Purpose::Odometry, u64::from(drive));
    let mut noise = |sigma: f64| {
        let mut deviate = || -> f64 { StandardNormal.sample(&mut rng) };
        sigma * Vector3::new(deviate(), deviate(), deviate())
    };
    let mut reported: Vec<Pose3> = Vec::with_capacity(true_poses.len());
    for pair in true_poses.windows(2) {
        let previous = *reported.last().unwrap_or(&pair[0]);
        if reported.is_empty() {
            reported.push(previous);
        }
        let step = pair[0].inverse() * pair[1];
        let driven_m = step.translation.vector.norm();
        // A car that stands reports that it stands.
        let is_moving = driven_m > 0.005;
        let shake = if is_moving { 1.0 } else { 0.0 };
        let drift = Vector3::z() * config.heading_drift_deg_per_m.to_radians() * driven_m;
        let turn = drift + shake * noise(config.turn_noise_deg.to_radians());
        let translation = step.translation.vector * (1.0 + config.scale_error)
            + shake * noise(config.step_noise_m);
        let rotation = UnitQuaternion::from_scaled_axis(turn) * step.rotation;
        reported.push(previous * Pose3::from_parts(translation.into(), rotation));
    }
    if reported.is_empty() {
        reported.extend(true_poses.first());
    }
    reported
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::geometry::yaw;

    fn straight(frames: usize) -> Vec<Pose3> {
        (0..frames)
            .map(|frame| Pose3::translation(3.0 + frame as f64, 2.0, 0.5))
            .collect()
    }

    const EXACT: OdometryConfig = OdometryConfig {
        scale_error: 0.0,
        heading_drift_deg_per_m: 0.0,
        step_noise_m: 0.0,
        turn_noise_deg: 0.0,
    };

    #[test]
    fn without_errors_odometry_is_the_truth() {
        let truth: Vec<Pose3> = (0..50)
            .map(|frame| {
                let angle = 0.1 * f64::from(frame);
                Pose3::new(
                    Vector3::new(angle.sin(), angle, 0.0),
                    Vector3::new(0.1 * angle, 0.0, angle),
                )
            })
            .collect();
        for (a, b) in truth.iter().zip(drifting_odometry(&truth, &EXACT, (1, 1))) {
            assert_relative_eq!(*a, b, epsilon = 1e-9);
        }
    }

    #[test]
    fn scale_and_heading_drift_add_up() {
        let config = OdometryConfig {
            scale_error: 0.02,
            heading_drift_deg_per_m: 0.05,
            ..EXACT
        };
        let reported = drifting_odometry(&straight(101), &config, (1, 1));
        let length_m: f64 = reported
            .windows(2)
            .map(|p| (p[1].translation.vector - p[0].translation.vector).norm())
            .sum();
        assert_relative_eq!(length_m, 102.0, epsilon = 1e-6);
        assert_relative_eq!(yaw(&reported[100]).to_degrees(), 5.0, epsilon = 1e-6);
        assert_eq!(reported[0], straight(1)[0]);
    }

    #[test]
    fn steps_have_the_configured_noise() {
        let config = OdometryConfig {
            step_noise_m: 0.03,
            ..EXACT
        };
        let reported = drifting_odometry(&straight(5001), &config, (1, 1));
        let squares: f64 = reported
            .windows(2)
            .map(|p| (p[1].translation.x - p[0].translation.x - 1.0).powi(2))
            .sum();
        // Four standard errors of a standard deviation of 5000 samples.
        let tolerance = 4.0 * 0.03 / (2.0 * 5000_f64).sqrt();
        assert_relative_eq!((squares / 5000.0).sqrt(), 0.03, epsilon = tolerance);
    }

    #[test]
    fn a_standing_car_does_not_drift() {
        let still = vec![straight(1)[0]; 100];
        let reported = drifting_odometry(&still, &OdometryConfig::default(), (1, 1));
        assert_relative_eq!(reported[99], still[0], epsilon = 1e-12);
    }
}
