//! The poses that a recording comes with: those of a navigation system, with noise, drift and a delay.
//!
//! ```text
//! Pₖ = Dₖ · Exp(ε)        D: the true poses at tₖ + delay, with the drift of an odometry
//! ```
//!
//! A map that is built with drifting poses is bent, and true poses have to be bent with it before they are
//! compared with poses in the map: with the mapping pose nearest to a true pose T,
//!
//! ```text
//! T_map = Dₖ T_k⁻¹ T        k = argmin |t_k − t|
//! ```

use nalgebra::{UnitQuaternion, Vector3};
use rand::Rng;
use rand_distr::{Distribution as _, StandardNormal};
use serde::{Deserialize, Serialize};

use super::odometry::{SimulatedOdometryConfig, drifting_odometry};
use crate::geometry::Pose3;
use crate::validation::{InvalidValue, Validate, in_range};

/// Errors of the given poses.
///
/// Defaults: none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct GivenPosesConfig {
    /// Standard deviation of each component of a position [m].
    pub noise_m: f64,
    /// Standard deviation of each component of a rotation [deg].
    pub noise_deg: f64,
    /// Relative error of distances, positive if they are too long.
    pub scale_error: f64,
    /// Heading drift to the left per metre [deg/m].
    pub heading_drift_deg_per_m: f64,
    /// Delay of the time stamps of the scans against those of the poses and of the odometry [s].
    pub delay_s: f64,
}

impl Validate for GivenPosesConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("noise_m", self.noise_m, 0.0..=100.0)?;
        in_range("noise_deg", self.noise_deg, 0.0..=180.0)?;
        in_range("delay_s", self.delay_s, -10.0..=10.0)?;
        self.drift().validate()
    }
}

impl GivenPosesConfig {
    /// Whether the poses differ from the true ones.
    pub fn has_errors(&self) -> bool {
        *self != Self::default()
    }

    /// The poses without noise, from the true ones at the delayed times.
    pub fn without_noise(&self, delayed: &[Pose3], rng: &mut impl Rng) -> Vec<Pose3> {
        drifting_odometry(delayed, &self.drift(), rng)
    }

    /// Adds noise to poses.
    pub fn with_noise(&self, poses: &[Pose3], rng: &mut impl Rng) -> Vec<Pose3> {
        let mut noise = |sigma: f64| {
            let mut deviate = || -> f64 { StandardNormal.sample(rng) };
            sigma * Vector3::new(deviate(), deviate(), deviate())
        };
        let noisy = poses.iter().map(|pose| {
            let turn = UnitQuaternion::from_scaled_axis(noise(self.noise_deg.to_radians()));
            pose * Pose3::from_parts(noise(self.noise_m).into(), turn)
        });
        noisy.collect()
    }

    fn drift(&self) -> SimulatedOdometryConfig {
        SimulatedOdometryConfig {
            scale_error: self.scale_error,
            heading_drift_deg_per_m: self.heading_drift_deg_per_m,
            step_noise_m: 0.0,
            turn_noise_deg: 0.0,
        }
    }
}

/// True poses as a map has them that was built at true poses `mapped`, given as `given`.
pub fn bent_poses(poses: &[Pose3], mapped: &[Pose3], given: &[Pose3]) -> Vec<Pose3> {
    let bend = |pose: &Pose3| {
        let distance = |(other, _): &(&Pose3, &Pose3)| {
            (other.translation.vector - pose.translation.vector).norm()
        };
        let pairs = mapped.iter().zip(given);
        let nearest = pairs.min_by(|a, b| distance(a).total_cmp(&distance(b)));
        nearest.map_or(*pose, |(mapped, given)| given * mapped.inverse() * pose)
    };
    poses.iter().map(bend).collect()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::super::random::{Purpose, stream};
    use super::*;

    fn straight(frames: usize, y: f64) -> Vec<Pose3> {
        let poses = (0..frames).map(|frame| Pose3::translation(frame as f64, y, 0.0));
        poses.collect()
    }

    #[test]
    fn noise_has_the_configured_deviations_and_does_not_add_up() {
        let config = GivenPosesConfig {
            noise_m: 0.02,
            noise_deg: 0.05,
            ..GivenPosesConfig::default()
        };
        let truth = straight(4000, 0.0);
        let given = config.with_noise(&truth, &mut stream(1, Purpose::GivenPoses, 1));
        let (mut shift, mut turn) = (0.0, 0.0);
        for (truth, given) in truth.iter().zip(&given) {
            let error = truth.inverse() * given;
            shift += error.translation.vector.norm_squared();
            turn += error.rotation.scaled_axis().norm_squared();
        }
        // Three components each; four standard errors of a standard deviation of 12,000 samples.
        let tolerance = 4.0 / (2.0 * 12_000_f64).sqrt();
        let (shift_m, turn_rad) = ((shift / 12e3_f64).sqrt(), (turn / 12e3_f64).sqrt());
        assert_relative_eq!(shift_m, 0.02, max_relative = tolerance);
        assert_relative_eq!(turn_rad.to_degrees(), 0.05, max_relative = tolerance);
    }

    #[test]
    fn true_poses_keep_their_place_beside_the_mapping_poses_of_a_bent_map() {
        let config = GivenPosesConfig {
            scale_error: 0.01,
            heading_drift_deg_per_m: 0.1,
            ..GivenPosesConfig::default()
        };
        let mut rng = stream(1, Purpose::GivenPoses, 1);
        let mapped = straight(200, 0.0);
        let given = config.without_noise(&mapped, &mut rng);
        assert!((given[199].translation.vector - mapped[199].translation.vector).norm() > 10.0);
        let bent = bent_poses(&straight(200, 0.4), &mapped, &given);
        for (bent, given) in bent.iter().zip(&given) {
            let beside = (given.inverse() * bent).translation.vector;
            assert_relative_eq!(beside, Vector3::new(0.0, 0.4, 0.0), epsilon = 1e-9);
        }
    }
}
