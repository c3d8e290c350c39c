//! Fusion of prediction and registration, for a narrow distribution.
//!
//! Particles that are predicted by the odometry alone have the spread of its noise, and most of them are
//! unlikely given the scan. The scan is therefore registered with the map once for all particles, which
//! are sampled from the product of prediction and registration:
//!
//! ```text
//! prior        N(m, P)     the predicted particles
//! likelihood   N(s, S)     registration of the scan with the map, from the pose that gave the motion during its sweep, else from m
//! posterior    N(q, Q)     Q = (P⁻¹ + S⁻¹)⁻¹,   q = m + Q S⁻¹ (s − m)
//! ```
//!
//! The registration also estimates height, roll and pitch, which all particles share. Kotecha and Djurić, *Gaussian
//! Particle Filtering* (2003), with the likelihood of the registration, so that no sample has to be weighted; for a
//! registration as the likelihood of a scan, Grisetti, Stachniss and Burgard, *Improved Techniques for Grid Mapping with
//! Rao-Blackwellized Particle Filters* (2007), section III.

use nalgebra::{Cholesky, Const, Matrix3, Vector3};
use rand::{Rng, RngExt as _};
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::particles::deviation;
use crate::geometry::{Pose2, wrap_angle};
use crate::registration::RegistrationConfig;
use crate::validation::{InvalidValue, Validate, fraction, in_range, nested};

/// Update by a registration while tracking.
///
/// Defaults: values of this project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ProposalConfig {
    /// Whether particles are sampled where prediction and registration agree; otherwise the predicted ones are weighted, as
    /// in range-mcl.
    #[default(true)]
    pub scan: bool,
    /// Number of beams, of which the 4,800 most informative ones are registered, or all if these are fewer.
    #[default(9600)]
    pub beams: usize,
    /// Largest share of them that end on the road, which determines height, roll and pitch (unitless).
    #[default(0.4)]
    pub road_share: f64,
    /// Number of beams whose agreement with the map is judged at the estimate, and that are registered for the motion during
    /// the sweep.
    #[default(2400)]
    pub compared_beams: usize,
    /// Registration of the scan with the map.
    pub registration: RegistrationConfig,
}

impl Validate for ProposalConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("beams", self.beams, 1..=1_000_000)?;
        fraction("road_share", self.road_share)?;
        in_range("compared_beams", self.compared_beams, 1..=1_000_000)?;
        nested("registration", &self.registration)
    }
}

/// Normal distribution of planar poses, in the axes of the map.
#[derive(Clone, Debug)]
pub struct Gaussian {
    /// Mean.
    pub mean: Pose2,
    /// Cholesky factor of the covariance of (x, y, heading) [m², m·rad, rad²].
    cholesky: Cholesky<f64, Const<3>>,
}

impl Gaussian {
    /// `None` where the covariance is not positive definite.
    pub fn new(mean: Pose2, covariance: Matrix3<f64>) -> Option<Self> {
        Some(Self {
            mean,
            cholesky: covariance.cholesky()?,
        })
    }

    /// Squared Mahalanobis distance of a pose from the mean (unitless).
    pub fn squared_distance(&self, pose: &Pose2) -> f64 {
        let offset = deviation(pose, &self.mean);
        offset.dot(&self.cholesky.solve(&offset))
    }

    /// Samples poses whose mean and covariance are exactly those of the distribution; of fewer than four, only the mean.
    pub fn sample(&self, count: usize, rng: &mut impl Rng) -> Vec<Pose2> {
        let draw = |_| Vector3::from_fn(|_, _| rng.sample::<f64, _>(StandardNormal));
        let mut deviates: Vec<Vector3<f64>> = (0..count).map(draw).collect();
        let mean = deviates.iter().sum::<Vector3<f64>>() / count.max(1) as f64;
        deviates.iter_mut().for_each(|deviate| *deviate -= mean);
        let squares: Matrix3<f64> = deviates.iter().map(|it| it * it.transpose()).sum();
        let of_deviates = (squares / count as f64).cholesky().filter(|_| count > 3);
        let whiten = of_deviates.and_then(|it| it.l().try_inverse());
        let root = self.cholesky.l() * whiten.unwrap_or_else(Matrix3::identity);
        let pose = |deviate: &Vector3<f64>| shifted(&self.mean, &(root * deviate));
        deviates.iter().map(pose).collect()
    }

    /// The same, so wide that a pose is a standard deviation from its mean, and as wide as before across; `None` where
    /// rounding leaves no covariance.
    pub fn widened_to(&self, pose: &Pose2) -> Option<Self> {
        let root = self.cholesky.l();
        let offset = deviation(pose, &self.mean);
        Self::new(
            self.mean,
            root * root.transpose() + offset * offset.transpose(),
        )
    }

    /// Normalized product with another one.
    pub fn fused(&self, other: &Self) -> Option<Self> {
        let information = self.cholesky.inverse() + other.cholesky.inverse();
        let covariance = information.cholesky()?.inverse();
        let weighted = other.cholesky.solve(&deviation(&other.mean, &self.mean));
        Self::new(shifted(&self.mean, &(covariance * weighted)), covariance)
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

    fn covariance(gaussian: &Gaussian) -> Matrix3<f64> {
        let root = gaussian.cholesky.l();
        root * root.transpose()
    }

    #[test]
    fn the_product_of_equal_gaussians_has_the_average_mean_and_half_the_covariance() {
        let (a, b) = (gaussian(0.0, 3.1, 0.2), gaussian(1.0, -3.1, 0.2));
        let fused = a.fused(&b).unwrap();
        assert_relative_eq!(fused.mean.translation.x, 0.5, epsilon = 1e-9);
        let heading = fused.mean.rotation.angle().abs();
        assert_relative_eq!(heading, std::f64::consts::PI, epsilon = 1e-9);
        assert_relative_eq!(covariance(&fused), 0.5 * covariance(&a), epsilon = 1e-12);
    }

    #[test]
    fn a_gaussian_without_information_does_not_change_the_product() {
        let narrow = gaussian(0.4, 0.2, 0.1);
        let wide = gaussian(9.0, 2.0, 1e6);
        let fused = narrow.fused(&wide).unwrap();
        assert_relative_eq!(fused.mean, narrow.mean, epsilon = 1e-9);
        assert_relative_eq!(covariance(&fused), covariance(&narrow), epsilon = 1e-9);
    }

    #[test]
    fn a_gaussian_that_is_widened_to_a_pose_leaves_it_to_a_precise_one_in_its_direction_alone() {
        let prior = gaussian(0.0, 0.2, 0.01);
        let pose = Pose2::new(prior.mean.translation.vector + Vector2::new(0.5, 0.0), 0.2);
        let widened = prior.widened_to(&pose).unwrap();
        assert_relative_eq!(widened.squared_distance(&pose), 1.0, epsilon = 1e-3);
        // Of (x, y, heading): x is known, the rest is not.
        let known = Vector3::new(1e-8, 1e6, 1e6);
        let measured = Gaussian::new(pose, Matrix3::from_diagonal(&known)).unwrap();
        let fused = widened.fused(&measured).unwrap();
        assert_relative_eq!(fused.mean, pose, epsilon = 1e-3);
        let across = covariance(&fused).fixed_view::<2, 2>(1, 1).into_owned();
        let before = covariance(&prior).fixed_view::<2, 2>(1, 1).into_owned();
        assert_relative_eq!(across, before, max_relative = 1e-6, epsilon = 1e-12);
    }

    #[test]
    fn samples_have_exactly_the_mean_and_the_covariance_of_their_gaussian() {
        let gaussian = gaussian(2.0, 3.1, 0.03)
            .fused(&gaussian(2.1, -3.1, 0.02))
            .unwrap();
        for count in [4, 5, 100] {
            let poses = gaussian.sample(count, &mut StdRng::seed_from_u64(1));
            assert_eq!(poses.len(), count);
            let particles = ParticleSet::uniform(poses);
            let mean = particles.mean();
            let off = deviation(&mean, &gaussian.mean);
            assert_relative_eq!(off, Vector3::zeros(), epsilon = 1e-6);
            let found = particles.covariance_about(&mean);
            assert_relative_eq!(
                found,
                covariance(&gaussian),
                max_relative = 1e-3,
                epsilon = 1e-9
            );
        }
    }

    #[test]
    fn few_samples_have_the_mean_of_their_gaussian() {
        let gaussian = gaussian(2.0, 1.0, 0.03);
        for count in [0, 1, 2, 3] {
            let poses = gaussian.sample(count, &mut StdRng::seed_from_u64(1));
            assert_eq!(poses.len(), count);
            if count > 0 {
                let mean = ParticleSet::uniform(poses).mean();
                assert_relative_eq!(mean, gaussian.mean, epsilon = 1e-4);
            }
        }
    }

    #[test]
    fn the_regular_covariance_of_identical_particles_is_positive_definite() {
        let covariance = regular(&Matrix3::zeros());
        assert!(Gaussian::new(Pose2::identity(), covariance).is_some());
    }
}
