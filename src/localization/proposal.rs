//! Approximation of the optimal proposal distribution by registration, for a narrow distribution.
//!
//! Particles that are predicted by the odometry alone have the spread of its noise, and most of them are
//! unlikely given the scan. The scan is therefore registered with the map once for all particles, which
//! are sampled from the product of prediction and registration:
//!
//! ```text
//! prior      N(m, P)       the predicted particles
//! scan       N(s, S)       registration of the scan with the map, starting at m
//! proposal   N(q, k² Q)    Q = (P⁻¹ + S⁻¹)⁻¹,   q = m + Q S⁻¹ (s − m)
//! weight     w ∝ (p(scan | x, map) N(x; m, P) / N(x; q, k² Q))ᵝ        β: tempering
//! ```
//!
//! The registration also estimates height, roll and pitch, which all particles share.
//! Grisetti, Stachniss and Burgard, *Improved Techniques for Grid Mapping with Rao-Blackwellized
//! Particle Filters* (2007), section III; Kotecha and Djurić, *Gaussian Particle Filtering* (2003),
//! for a distribution that is represented by its mean and covariance.

use nalgebra::{Cholesky, Const, Matrix3, Vector3};
use rand::{Rng, RngExt as _};
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::particles::deviation;
use crate::geometry::{Pose2, wrap_angle};
use crate::registration::RegistrationConfig;
use crate::validation::{InvalidValue, Validate, fraction, in_range, nested};

/// Proposal distribution while tracking.
///
/// Defaults: values of this project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ProposalConfig {
    /// Whether the scan is part of the proposal; otherwise the prediction alone is, as in range-mcl.
    #[default(true)]
    pub scan: bool,
    /// Number of beams that are registered.
    #[default(2400)]
    pub beams: usize,
    /// Largest share of them that end on the road, which determines height, roll and pitch (unitless).
    #[default(0.4)]
    pub road_share: f64,
    /// Number of beams that weight the particles.
    #[default(600)]
    pub weighed_beams: usize,
    /// Registration of the scan with the map. Sampling and weighting add variance, which covers the
    /// rest of the map error: with a larger `map_error_m` the covariances of simulated drives are too large. The last
    /// step is so small that the estimate does not depend on whether there is one more.
    #[default(RegistrationConfig { map_error_m: 0.001, tolerance_m: 1e-4, ..RegistrationConfig::default() })]
    pub registration: RegistrationConfig,
}

impl Validate for ProposalConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("beams", self.beams, 1..=1_000_000)?;
        fraction("road_share", self.road_share)?;
        in_range("weighed_beams", self.weighed_beams, 1..=1_000_000)?;
        nested("registration", &self.registration)
    }
}

/// Normal distribution of planar poses, in the axes of the map.
#[derive(Clone, Debug)]
pub struct Gaussian {
    /// Mean.
    pub mean: Pose2,
    /// Covariance of (x, y, heading) [m², m·rad, rad²].
    pub covariance: Matrix3<f64>,
    cholesky: Cholesky<f64, Const<3>>,
}

impl Gaussian {
    /// `None` where the covariance is not positive definite.
    pub fn new(mean: Pose2, covariance: Matrix3<f64>) -> Option<Self> {
        Some(Self {
            mean,
            covariance,
            cholesky: covariance.cholesky()?,
        })
    }

    /// Squared Mahalanobis distance of a pose from the mean (unitless).
    pub fn squared_distance(&self, pose: &Pose2) -> f64 {
        let offset = deviation(pose, &self.mean);
        offset.dot(&self.cholesky.solve(&offset))
    }

    /// Logarithm of the density, up to a constant.
    pub fn log_density(&self, pose: &Pose2) -> f64 {
        -0.5 * self.squared_distance(pose)
    }

    /// Samples poses.
    pub fn sample(&self, count: usize, rng: &mut impl Rng) -> Vec<Pose2> {
        let root = self.cholesky.l();
        let draw = |_| {
            let deviates = Vector3::from_fn(|_, _| rng.sample(StandardNormal));
            shifted(&self.mean, &(root * deviates))
        };
        (0..count).map(draw).collect()
    }

    /// Normalized product with another one.
    pub fn fused(&self, other: &Self) -> Option<Self> {
        let information = self.cholesky.inverse() + other.cholesky.inverse();
        let covariance = information.cholesky()?.inverse();
        let weighted = other.cholesky.solve(&deviation(&other.mean, &self.mean));
        Self::new(shifted(&self.mean, &(covariance * weighted)), covariance)
    }

    /// Scales the standard deviations.
    pub fn widened(&self, factor: f64) -> Option<Self> {
        Self::new(self.mean, self.covariance * factor.powi(2))
    }
}

fn shifted(pose: &Pose2, offset: &Vector3<f64>) -> Pose2 {
    Pose2::new(
        pose.translation.vector + offset.xy(),
        wrap_angle(pose.rotation.angle() + offset.z),
    )
}

/// Returns a covariance that is positive definite also for identical particles: variances of a tenth of a
/// millimetre and a thousandth of a degree are added.
pub fn regular(covariance: &Matrix3<f64>) -> Matrix3<f64> {
    const SMALLEST: Vector3<f64> = Vector3::new(1e-8, 1e-8, 3e-10);
    covariance + Matrix3::from_diagonal(&SMALLEST)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector2;
    use rand::{SeedableRng, rngs::StdRng};

    use super::super::particles::ParticleSet;
    use super::*;

    fn gaussian(x: f64, heading: f64, sigma: f64) -> Gaussian {
        let variances = Vector3::new(sigma, 2.0 * sigma, 0.1 * sigma).map(|s| s * s);
        let mean = Pose2::new(Vector2::new(x, 3.0), heading);
        Gaussian::new(mean, Matrix3::from_diagonal(&variances)).unwrap()
    }

    #[test]
    fn the_product_of_equal_gaussians_has_the_average_mean_and_half_the_covariance() {
        let (a, b) = (gaussian(0.0, 3.1, 0.2), gaussian(1.0, -3.1, 0.2));
        let fused = a.fused(&b).unwrap();
        assert_relative_eq!(fused.mean.translation.x, 0.5, epsilon = 1e-9);
        let heading = fused.mean.rotation.angle().abs();
        assert_relative_eq!(heading, std::f64::consts::PI, epsilon = 1e-9);
        assert_relative_eq!(fused.covariance, 0.5 * a.covariance, epsilon = 1e-12);
    }

    #[test]
    fn a_gaussian_without_information_does_not_change_the_product() {
        let narrow = gaussian(0.4, 0.2, 0.1);
        let wide = gaussian(9.0, 2.0, 1e6);
        let fused = narrow.fused(&wide).unwrap();
        assert_relative_eq!(fused.mean, narrow.mean, epsilon = 1e-9);
        assert_relative_eq!(fused.covariance, narrow.covariance, epsilon = 1e-9);
    }

    #[test]
    fn samples_have_the_covariance_of_their_gaussian() {
        let gaussian = gaussian(2.0, 1.0, 0.3);
        let count = 20_000;
        let poses = gaussian.sample(count, &mut StdRng::seed_from_u64(1));
        let particles = ParticleSet::uniform(poses);
        let found = particles.covariance_about(&gaussian.mean);
        let error = 4.0 * (2.0 / count as f64).sqrt();
        assert_relative_eq!(found, gaussian.covariance, epsilon = error * 0.36);
        for axis in 0..3 {
            let expected = gaussian.covariance[(axis, axis)];
            assert_relative_eq!(found[(axis, axis)], expected, max_relative = error);
        }
    }

    #[test]
    fn importance_weights_recover_the_prior_from_the_proposal() {
        let prior = gaussian(1.0, 0.0, 0.2);
        let proposal = gaussian(1.1, 0.0, 0.4);
        let poses = proposal.sample(50_000, &mut StdRng::seed_from_u64(2));
        let mut particles = ParticleSet::uniform(poses);
        let ratios: Vec<f64> = particles
            .poses()
            .map(|pose| prior.log_density(pose) - proposal.log_density(pose))
            .collect();
        particles.reweight(&ratios);
        assert_relative_eq!(particles.mean().translation.x, 1.0, epsilon = 0.01);
        let spread = particles.covariance_about(&prior.mean)[(0, 0)].sqrt();
        assert_relative_eq!(spread, 0.2, epsilon = 0.01);
    }

    #[test]
    fn the_regular_covariance_of_identical_particles_is_positive_definite() {
        let covariance = regular(&Matrix3::zeros());
        assert!(Gaussian::new(Pose2::identity(), covariance).is_some());
    }
}
