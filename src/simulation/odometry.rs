//! Odometry drift model: the poses that wheel encoders and a gyroscope report.
//!
//! Each increment of the true poses gets a scale error, a heading drift and noise, then the
//! increments are composed:
//!
//! ```text
//! Δ̂ₖ = Exp(ω_drift dₖ + ε_ω) · Δₖ(with translation (1 + s) tₖ + ε_t)        P̂ₖ = P̂ₖ₋₁ Δ̂ₖ
//! ```

use nalgebra::{UnitQuaternion, Vector3};
use rand::Rng;
use rand_distr::{Distribution as _, StandardNormal};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::geometry::Pose3;
use crate::validation::{InvalidValue, Validate, in_range};

/// Errors of the odometry.
///
/// Defaults: a good wheel odometry: 1 % too long, one degree in 100 m.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedOdometryConfig {
    /// Relative error of distances (s), positive if they are too long.
    #[default(0.01)]
    pub scale_error: f64,
    /// Heading drift to the left per metre (ω_drift) [deg/m].
    #[default(0.01)]
    pub heading_drift_deg_per_m: f64,
    /// Standard deviation of each component of a translation (ε_t) [m].
    #[default(0.01)]
    pub step_noise_m: f64,
    /// Standard deviation of each component of a rotation, per scan (ε_ω) [deg].
    #[default(0.02)]
    pub turn_noise_deg: f64,
}

impl Validate for SimulatedOdometryConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("scale_error", self.scale_error, -0.9..=10.0)?;
        let drift = self.heading_drift_deg_per_m;
        in_range("heading_drift_deg_per_m", drift, -90.0..=90.0)?;
        in_range("step_noise_m", self.step_noise_m, 0.0..=100.0)?;
        in_range("turn_noise_deg", self.turn_noise_deg, 0.0..=180.0)
    }
}

/// The poses that odometry reports for true poses, starting at the first of them.
pub fn drifting_odometry(
    true_poses: &[Pose3],
    config: &SimulatedOdometryConfig,
    rng: &mut impl Rng,
) -> Vec<Pose3> {
    let mut noise = |sigma: f64| {
        let mut deviate = || -> f64 { StandardNormal.sample(rng) };
        sigma * Vector3::new(deviate(), deviate(), deviate())
    };
    let mut reported: Vec<Pose3> = true_poses.first().copied().into_iter().collect();
    for (index, pair) in true_poses.windows(2).enumerate() {
        let step = pair[0].inverse() * pair[1];
        let driven_m = step.translation.vector.norm();
        // The odometry of a stationary vehicle has no noise.
        let noise_scale = if driven_m > 0.005 { 1.0 } else { 0.0 };
        let drift = Vector3::z() * config.heading_drift_deg_per_m.to_radians() * driven_m;
        let turn = drift + noise_scale * noise(config.turn_noise_deg.to_radians());
        let translation = step.translation.vector * (1.0 + config.scale_error)
            + noise_scale * noise(config.step_noise_m);
        let rotation = UnitQuaternion::from_scaled_axis(turn) * step.rotation;
        reported.push(reported[index] * Pose3::from_parts(translation.into(), rotation));
    }
    reported
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::super::random::{Purpose, stream};
    use super::*;
    use crate::geometry::yaw;

    fn straight(frames: usize) -> Vec<Pose3> {
        (0..frames)
            .map(|frame| Pose3::translation(3.0 + frame as f64, 2.0, 0.5))
            .collect()
    }

    fn odometry(true_poses: &[Pose3], config: &SimulatedOdometryConfig) -> Vec<Pose3> {
        drifting_odometry(true_poses, config, &mut stream(1, Purpose::Odometry, 1))
    }

    const EXACT: SimulatedOdometryConfig = SimulatedOdometryConfig {
        scale_error: 0.0,
        heading_drift_deg_per_m: 0.0,
        step_noise_m: 0.0,
        turn_noise_deg: 0.0,
    };

    #[test]
    fn without_errors_odometry_is_exact() {
        let truth: Vec<Pose3> = (0..50)
            .map(|frame| {
                let angle = 0.1 * f64::from(frame);
                Pose3::new(
                    Vector3::new(angle.sin(), angle, 0.0),
                    Vector3::new(0.1 * angle, 0.0, angle),
                )
            })
            .collect();
        for (a, b) in truth.iter().zip(odometry(&truth, &EXACT)) {
            assert_relative_eq!(*a, b, epsilon = 1e-9);
        }
    }

    #[test]
    fn scale_and_heading_drift_add_up() {
        let config = SimulatedOdometryConfig {
            scale_error: 0.02,
            heading_drift_deg_per_m: 0.05,
            ..EXACT
        };
        let reported = odometry(&straight(101), &config);
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
        let config = SimulatedOdometryConfig {
            step_noise_m: 0.03,
            ..EXACT
        };
        let reported = odometry(&straight(5001), &config);
        let squares: f64 = reported
            .windows(2)
            .map(|p| (p[1].translation.x - p[0].translation.x - 1.0).powi(2))
            .sum();
        // Four standard errors of a standard deviation of 5000 samples.
        let tolerance = 4.0 * 0.03 / (2.0 * 5000_f64).sqrt();
        assert_relative_eq!((squares / 5000.0).sqrt(), 0.03, epsilon = tolerance);
    }

    #[test]
    fn a_stationary_vehicle_does_not_drift() {
        let stationary = vec![straight(1)[0]; 100];
        let reported = odometry(&stationary, &SimulatedOdometryConfig::default());
        assert_relative_eq!(reported[99], stationary[0], epsilon = 1e-12);
    }
}
