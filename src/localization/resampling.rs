//! Resampling: systematic resampling, KLD sampling for the number of particles, and regularization,
//! which separates the copies of a particle by jitter.
//!
//! ```text
//! pointers  r + k/N,  r ~ U(0, 1/N)                      E[copies of i] = N wᵢ
//! KLD       n = (k−1)/(2ε) · (1 − 2/(9(k−1)) + √(2/(9(k−1))) z)³      k occupied bins
//! jitter    x ← x + h · L ξ,  L Lᵀ = Cov,  h = (4 / (N (d + 2)))^(1/(d+4)),  d = 3
//! ```
//!
//! Thrun, Burgard and Fox, *Probabilistic Robotics* (2005), table 4.4; Fox, *Adapting the Sample
//! Size in Particle Filters Through KLD-Sampling*, IJRR 2003, eq. 7; Musso, Oudjane and Le Gland,
//! *Improving Regularised Particle Filters* (2001), eq. 12.2.7.

use std::collections::BTreeSet;

use nalgebra::{Matrix3, Vector3};
use rand::{Rng, RngExt as _};
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::particles::{ParticleSet, spread};
use crate::geometry::{Pose2, wrap_angle};
use crate::validation::{InvalidValue, Validate, fraction, not_negative, positive};

/// Threshold of resampling, and jitter of the copies of a particle.
///
/// Defaults: range-mcl's 0.75; half the optimal kernel, since the distribution is narrower than the Gaussian
/// with its covariance.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ResamplingConfig {
    /// Share of the particles below which the effective sample size triggers resampling (unitless).
    #[default(0.75)]
    pub min_effective_fraction: f64,
    /// Jitter as a multiple of the kernel width h (unitless); 0 for none, as in range-mcl.
    #[default(0.5)]
    pub jitter: f64,
    /// Largest standard deviation of the jitter in position, however wide the distribution [m].
    #[default(0.3)]
    pub max_jitter_m: f64,
    /// Largest standard deviation of the jitter in heading [rad].
    #[default(0.05)]
    pub max_jitter_rad: f64,
}

impl Validate for ResamplingConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        fraction("min_effective_fraction", self.min_effective_fraction)?;
        not_negative("jitter", self.jitter)?;
        not_negative("max_jitter_m", self.max_jitter_m)?;
        not_negative("max_jitter_rad", self.max_jitter_rad)
    }
}

/// KLD sampling: the number of particles of a wide distribution.
///
/// Defaults: ε and z of Fox (2003), section 4: 0.05 with probability 0.99; bins of 0.5 m and 10 degrees.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct KldConfig {
    /// Bound on the Kullback-Leibler distance between particles and distribution, ε (unitless).
    #[default(0.05)]
    pub max_distance: f64,
    /// Quantile of the standard normal distribution for the probability of the bound, z (unitless).
    #[default(2.33)]
    pub quantile: f64,
    /// Side of a bin in x and y [m].
    #[default(0.5)]
    pub bin_m: f64,
    /// Width of a bin in heading [rad].
    #[default(10.0_f64.to_radians())]
    pub bin_rad: f64,
}

impl Validate for KldConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        positive("max_distance", self.max_distance)?;
        not_negative("quantile", self.quantile)?;
        positive("bin_m", self.bin_m)?;
        positive("bin_rad", self.bin_rad)
    }
}

/// Systematic resampling: draws `count` indices with one random number. The number of copies of an
/// index is `count` times its weight, rounded up or down, and equal to that on average. `weights`
/// sum to one.
pub fn systematic(weights: &[f64], count: usize, rng: &mut impl Rng) -> Vec<usize> {
    let step = 1.0 / count as f64;
    let offset = rng.random::<f64>() * step;
    let mut indices = Vec::with_capacity(count);
    let mut index = 0;
    let mut cumulative = weights[0];
    for k in 0..count {
        let pointer = offset + k as f64 * step;
        while pointer >= cumulative && index + 1 < weights.len() {
            index += 1;
            cumulative += weights[index];
        }
        indices.push(index);
    }
    indices
}

/// Number of particles for which the bound of KLD sampling holds.
pub fn kld_sample_size(occupied_bins: usize, config: &KldConfig) -> usize {
    if occupied_bins < 2 {
        return 1;
    }
    let degrees = (occupied_bins - 1) as f64;
    let ninth = 2.0 / (9.0 * degrees);
    let cube = (1.0 - ninth + ninth.sqrt() * config.quantile).powi(3);
    (degrees / (2.0 * config.max_distance) * cube).ceil() as usize
}

/// Number of bins of (x, y, heading) that contain poses.
pub fn occupied_bins<'a>(poses: impl IntoIterator<Item = &'a Pose2>, config: &KldConfig) -> usize {
    let bin = |pose: &Pose2| {
        let place = pose.translation.vector / config.bin_m;
        let heading = wrap_angle(pose.rotation.angle()) / config.bin_rad;
        [place.x, place.y, heading].map(|coordinate| coordinate.floor() as i64)
    };
    let bins: BTreeSet<[i64; 3]> = poses.into_iter().map(bin).collect();
    bins.len()
}

/// Separates the copies of particles by samples of a kernel: the scaled covariance of the distribution
/// before resampling, of (x, y, heading) [m², m·rad, rad²].
pub fn jitter(
    particles: &mut ParticleSet,
    covariance: &Matrix3<f64>,
    config: &ResamplingConfig,
    rng: &mut impl Rng,
) {
    let kernel = config.jitter * kernel_width(particles.len());
    let Some(root) = limited_root(covariance, kernel, config) else {
        return;
    };
    particles.propagate(|pose| {
        let offset = root * Vector3::from_fn(|_, _| rng.sample(StandardNormal));
        Pose2::new(
            pose.translation.vector + offset.xy(),
            pose.rotation.angle() + offset.z,
        )
    });
}

/// Width of the optimal Gaussian kernel for `count` samples of a Gaussian in three dimensions
/// (standard deviations).
fn kernel_width(count: usize) -> f64 {
    (4.0 / (5.0 * count as f64)).powf(1.0 / 7.0)
}

/// Square root of kernel² · covariance, limited to the largest standard deviations; `None` where the
/// covariance is not positive definite, as for identical particles.
fn limited_root(
    covariance: &Matrix3<f64>,
    kernel: f64,
    config: &ResamplingConfig,
) -> Option<Matrix3<f64>> {
    let (position_m, heading_rad) = spread(covariance);
    let scale = |sigma: f64, largest: f64| {
        if sigma * kernel > largest {
            largest / sigma
        } else {
            kernel
        }
    };
    let scale_m = scale(position_m, config.max_jitter_m);
    let scale_rad = scale(heading_rad, config.max_jitter_rad);
    let scale = Matrix3::from_diagonal(&Vector3::new(scale_m, scale_m, scale_rad));
    Some(scale * covariance.cholesky()?.l())
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use rand::{SeedableRng, rngs::StdRng};

    use super::*;

    #[test]
    fn the_number_of_copies_is_proportional_to_the_weight_up_to_rounding() {
        let weights = [0.05, 0.4, 0.0, 0.33, 0.22];
        let mut rng = StdRng::seed_from_u64(1);
        for _ in 0..200 {
            let indices = systematic(&weights, 10, &mut rng);
            for (index, weight) in weights.iter().enumerate() {
                let copies = indices.iter().filter(|&&drawn| drawn == index).count() as f64;
                assert!(
                    (copies - 10.0 * weight).abs() < 1.0 + 1e-9,
                    "{copies} {weight}"
                );
            }
        }
    }

    #[test]
    fn resampling_is_unbiased() {
        let weights = [0.05, 0.4, 0.33, 0.22];
        let mut rng = StdRng::seed_from_u64(2);
        let rounds = 20_000;
        let mut copies = [0.0; 4];
        for _ in 0..rounds {
            for index in systematic(&weights, 3, &mut rng) {
                copies[index] += 1.0 / f64::from(3 * rounds);
            }
        }
        for (share, weight) in copies.iter().zip(weights) {
            // The number of copies is within one of its mean: standard deviation at most 1/2.
            assert_relative_eq!(
                *share,
                weight,
                epsilon = 4.0 * 0.5 / 3.0 / f64::from(rounds).sqrt()
            );
        }
    }

    #[test]
    fn equal_weights_keep_every_particle_once() {
        let mut rng = StdRng::seed_from_u64(3);
        let indices = systematic(&[0.125; 8], 8, &mut rng);
        assert_eq!(indices, (0..8).collect::<Vec<_>>());
    }

    #[test]
    fn a_wider_distribution_needs_more_particles() {
        let config = KldConfig::default();
        assert_eq!(kld_sample_size(0, &config), 1);
        let sizes: Vec<usize> = [2, 10, 100, 1000]
            .iter()
            .map(|&bins| kld_sample_size(bins, &config))
            .collect();
        assert!(sizes.is_sorted(), "{sizes:?}");
        // χ²₀.₉₉ with one degree of freedom is 6.63, with 99 it is 134.64 (Fox 2003, eq. 5).
        assert_relative_eq!(sizes[0] as f64, 6.63 / 0.1, epsilon = 1.0);
        assert_relative_eq!(sizes[2] as f64, 134.64 / 0.1, epsilon = 10.0);
    }

    #[test]
    fn jitter_has_the_spread_of_the_kernel_up_to_its_limit() {
        let covariance = Matrix3::from_diagonal(&Vector3::new(0.04, 0.01, 1.0));
        let config = ResamplingConfig {
            jitter: 1.0,
            max_jitter_m: 1.0,
            max_jitter_rad: 0.05,
            ..ResamplingConfig::default()
        };
        let n = 20_000;
        let mut set = ParticleSet::uniform(std::iter::repeat_n(Pose2::identity(), n));
        jitter(
            &mut set,
            &covariance,
            &config,
            &mut StdRng::seed_from_u64(4),
        );
        let found = set.covariance_about(&Pose2::identity());
        // h = (4 / 5 n)^(1/7)
        let expected = 0.2 * 4e-5_f64.powf(1.0 / 7.0);
        let error = 4.0 / (2.0 * n as f64).sqrt();
        assert_relative_eq!(found[(0, 0)].sqrt(), expected, epsilon = expected * error);
        assert_relative_eq!(found[(2, 2)].sqrt(), 0.05, epsilon = 0.05 * error);
    }
}
