//! Where particles are drawn while the belief is narrow: where odometry and scan agree.
//!
//! Particles that follow the odometry alone are spread by its noise, and most of them lie where
//! the scan says that the car is not. So the scan is laid onto the map once for all particles, and
//! they are drawn from what odometry and scan say together:
//!
//! ```text
//! prior      N(m, P)       the particles after the motion
//! scan       N(s, S)       the scan laid onto the map, from m on (registration)
//! proposal   N(q, k² Q)    Q = (P⁻¹ + S⁻¹)⁻¹,   q = m + Q S⁻¹ (s − m)
//! weight     w ∝ p(scan | x, map)ᵝ N(x; m, P) / N(x; q, k² Q)
//! ```
//!
//! The registration also solves for the car's tilt and height, which all particles share.
//! Grisetti, Stachniss and Burgard, *Improved Techniques for Grid Mapping with Rao-Blackwellized
//! Particle Filters* (2007), section III; Kotecha and Djurić, *Gaussian Particle Filtering* (2003),
//! for a belief that is its mean and covariance.

use nalgebra::{Cholesky, Const, Matrix3, Vector3};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::particles::deviation;
use crate::geometry::{Pose2, wrap_angle};
use crate::registration::RegistrationConfig;
use crate::validation::{
    InvalidValue, Validate, at_least_one, fraction, nested, positive, require,
};

/// Whether and how the scan takes part in the proposal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ProposalConfig {
    /// Whether it does; if not, particles follow the odometry alone, as in range-mcl.
    pub scan: bool,
    /// Beams that are laid onto the map.
    pub beams: usize,
    /// At most this share of them looks at the road, which gives height, roll and pitch.
    pub road_share: f64,
    /// Beams by which the particles are weighed.
    pub weighed_beams: usize,
    /// How the scan is laid onto the map.
    pub registration: RegistrationConfig,
    /// Widening k of the proposal, at least 1: particles shall reach beyond what is expected.
    pub widening: f64,
    /// A scan that came to lie this many standard deviations of the prior away is not believed.
    pub max_sigmas: f64,
}

impl Default for ProposalConfig {
    /// Our own values.
    fn default() -> Self {
        Self {
            scan: true,
            beams: 2400,
            road_share: 0.4,
            weighed_beams: 300,
            // Drawing and weighing add a width of their own, into which the rest of the map's error
            // fits: with more, the covariances of simulated drives are too large.
            registration: RegistrationConfig {
                map_error_m: 0.001,
                ..RegistrationConfig::default()
            },
            widening: 1.5,
            max_sigmas: 6.0,
        }
    }
}

impl Validate for ProposalConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        at_least_one("beams", self.beams)?;
        fraction("road_share", self.road_share)?;
        at_least_one("weighed_beams", self.weighed_beams)?;
        nested("registration", &self.registration)?;
        require(
            self.widening >= 1.0 && self.widening.is_finite(),
            "widening",
            self.widening,
            "it must be 1 or greater",
        )?;
        positive("max_sigmas", self.max_sigmas)
    }
}

/// A Gaussian of poses in the plane, in the axes of the map.
#[derive(Clone, Debug)]
pub struct Gaussian {
    /// Its middle.
    pub mean: Pose2,
    /// Of (x, y, heading) [m², m·rad, rad²].
    pub covariance: Matrix3<f64>,
    cholesky: Cholesky<f64, Const<3>>,
}

impl Gaussian {
    /// Around a pose; `None` where the covariance is not positive definite.
    pub fn new(mean: Pose2, covariance: Matrix3<f64>) -> Option<Self> {
        Some(Self {
            mean,
            covariance,
            cholesky: covariance.cholesky()?,
        })
    }

    /// Squared distance of a pose from the middle, in standard deviations (Mahalanobis).
    pub fn squared_distance(&self, pose: &Pose2) -> f64 {
        let offset = deviation(pose, &self.mean);
        offset.dot(&self.cholesky.solve(&offset))
    }

    /// Logarithm of the density, but for a constant that is the same for all poses.
    pub fn log_density(&self, pose: &Pose2) -> f64 {
        -0.5 * self.squared_distance(pose)
    }

    /// Draws poses.
    pub fn sample(&self, count: usize, rng: &mut impl Rng) -> Vec<Pose2> {
        let root = self.cholesky.l();
        let draw = |_| {
            let deviates: [f64; 3] = std::array::from_fn(|_| StandardNormal.sample(rng));
            shifted(&self.mean, &(root * Vector3::from(deviates)))
        };
        (0..count).map(draw).collect()
    }

    /// What two Gaussians say together: their product.
    pub fn fused(&self, other: &Self) -> Option<Self> {
        let information = self.cholesky.inverse() + other.cholesky.inverse();
        let covariance = information.cholesky()?.inverse();
        let pull = other.cholesky.solve(&deviation(&other.mean, &self.mean));
        Self::new(shifted(&self.mean, &(covariance * pull)), covariance)
    }

    /// The same `factor` times as wide.
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

/// A covariance that has an inverse, also where all particles are alike: no belief is narrower
/// than a tenth of a millimetre and a thousandth of a degree.
pub fn regular(covariance: &Matrix3<f64>) -> Matrix3<f64> {
    const LEAST: Vector3<f64> = Vector3::new(1e-8, 1e-8, 3e-10);
    covariance + Matrix3::from_diagonal(&LEAST)
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
    fn two_that_are_equally_sure_meet_in_the_middle_and_are_surer_together() {
        let (a, b) = (gaussian(0.0, 3.1, 0.2), gaussian(1.0, -3.1, 0.2));
        let fused = a.fused(&b).unwrap();
        assert_relative_eq!(fused.mean.translation.x, 0.5, epsilon = 1e-9);
        let heading = fused.mean.rotation.angle().abs();
        assert_relative_eq!(heading, std::f64::consts::PI, epsilon = 1e-9);
        assert_relative_eq!(fused.covariance, 0.5 * a.covariance, epsilon = 1e-12);
    }

    #[test]
    fn who_knows_nothing_changes_nothing() {
        let sure = gaussian(0.4, 0.2, 0.1);
        let unsure = gaussian(9.0, 2.0, 1e6);
        let fused = sure.fused(&unsure).unwrap();
        assert_relative_eq!(fused.mean, sure.mean, epsilon = 1e-9);
        assert_relative_eq!(fused.covariance, sure.covariance, epsilon = 1e-9);
    }

    #[test]
    fn samples_have_the_mean_and_the_covariance_that_they_are_drawn_from() {
        let wanted = gaussian(2.0, 1.0, 0.3);
        let count = 20_000;
        let poses = wanted.sample(count, &mut StdRng::seed_from_u64(1));
        let drawn = ParticleSet::uniform(poses);
        let found = drawn.covariance_about(&wanted.mean);
        let error = 4.0 * (2.0 / count as f64).sqrt();
        assert_relative_eq!(found, wanted.covariance, epsilon = error * 0.36);
        for axis in 0..3 {
            let (found, wanted) = (found[(axis, axis)], wanted.covariance[(axis, axis)]);
            assert_relative_eq!(found, wanted, max_relative = error);
        }
    }

    #[test]
    fn weights_undo_the_choice_of_the_proposal() {
        // Drawn from a wide proposal and weighed by prior over proposal, the particles are the prior.
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
    fn particles_that_are_all_alike_have_a_covariance_with_an_inverse() {
        let alike = regular(&Matrix3::zeros());
        assert!(Gaussian::new(Pose2::identity(), alike).is_some());
    }
}
