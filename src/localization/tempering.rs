//! Tempering of the likelihood, so that enough effective particles remain.
//!
//! The beams of a frame are not independent, and the likelihood is far more peaked than the particles
//! are dense: unchanged, it would leave a single effective particle. It is therefore raised to a power,
//!
//! ```text
//! wᵢ ∝ wᵢ · L_iᵝ        β = max { β ≤ 1 : N_eff(β) ≥ N_min }
//! ```
//!
//! the largest that leaves enough effective particles. Del Moral, Doucet and Jasra, *An Adaptive
//! Sequential Monte Carlo Method for Approximate Bayesian Computation* (2012), section 3; Deutscher,
//! Blake and Reid, *Articulated Body Motion Capture by Annealed Particle Filtering*, CVPR 2000, for
//! several rounds of it in a frame.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::validation::{InvalidValue, Validate, fraction, in_range};

/// Tempering of the likelihood within a frame.
///
/// Defaults: values of this project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct TemperingConfig {
    /// Smallest share of effective particles that a frame may leave (unitless); 0 uses the likelihood
    /// unchanged, as range-mcl does.
    #[default(0.2)]
    pub min_effective_fraction: f64,
    /// Rounds of reweighting and resampling per frame while searching; while tracking there is one.
    #[default(4)]
    pub searching_rounds: usize,
}

impl Validate for TemperingConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        fraction("min_effective_fraction", self.min_effective_fraction)?;
        in_range("searching_rounds", self.searching_rounds, 1..=100)
    }
}

/// Largest exponent β up to `largest` that leaves an effective sample size of `min_effective`, to 1e-4
/// relative; 0 where the weights alone leave fewer.
pub fn exponent(weights: &[f64], log_likelihoods: &[f64], min_effective: f64, largest: f64) -> f64 {
    let is_enough = |beta: f64| effective(weights, log_likelihoods, beta) >= min_effective;
    if is_enough(largest) {
        return largest;
    }
    if !is_enough(0.0) {
        return 0.0;
    }
    // The scale of β is unknown: halve it until it leaves enough, then bisect above that.
    let mut low = 0.5 * largest;
    while !is_enough(low) && low > largest * 1e-12 {
        low *= 0.5;
    }
    let mut high = 2.0 * low;
    while high - low > 1e-4 * high {
        let middle = 0.5 * (low + high);
        if is_enough(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

/// Effective sample size after tempering with an exponent.
fn effective(weights: &[f64], log_likelihoods: &[f64], beta: f64) -> f64 {
    let highest = weights
        .iter()
        .zip(log_likelihoods)
        .filter(|(weight, _)| **weight > 0.0)
        .map(|(_, &log)| log)
        .fold(f64::NEG_INFINITY, f64::max);
    let (sum, squares) = weights
        .iter()
        .zip(log_likelihoods)
        // Those above the highest have no weight; their exponentials must not overflow.
        .map(|(weight, log)| weight * (beta * (log - highest).min(0.0)).exp())
        .fold((0.0, 0.0), |(sum, squares), w| (sum + w, squares + w * w));
    sum * sum / squares
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn a_flat_likelihood_is_used_unchanged() {
        assert_eq!(exponent(&[0.25; 4], &[-3.0; 4], 2.0, 1.0), 1.0);
    }

    #[test]
    fn a_peaked_likelihood_leaves_just_enough_effective_particles() {
        let logs: Vec<f64> = (0..100).map(|i| -50.0 * f64::from(i)).collect();
        let weights = [0.01; 100];
        let beta = exponent(&weights, &logs, 30.0, 1.0);
        assert!(beta < 0.01, "{beta}");
        assert_relative_eq!(effective(&weights, &logs, beta), 30.0, epsilon = 0.1);
    }

    #[test]
    fn the_exponent_is_inversely_proportional_to_the_scale_of_the_log_likelihood() {
        let logs: Vec<f64> = (0..50).map(|i| -f64::from(i * i)).collect();
        let scaled: Vec<f64> = logs.iter().map(|log| 8.0 * log).collect();
        let weights = [0.02; 50];
        let beta = exponent(&weights, &logs, 10.0, 1.0);
        let scaled_beta = exponent(&weights, &scaled, 10.0, 1.0);
        assert_relative_eq!(beta, 8.0 * scaled_beta, max_relative = 1e-3);
    }

    #[test]
    fn a_likely_particle_without_weight_does_not_temper_the_others() {
        let (weights, logs) = ([0.5, 0.5, 0.0], [-2000.0, -2000.0, 0.0]);
        assert_eq!(exponent(&weights, &logs, 2.0, 1.0), 1.0);
    }

    #[test]
    fn the_exponent_is_never_above_the_largest_though_more_may_be_effective_there() {
        // With a growing exponent, the weight is that of many unlikely particles, of one, then of many others.
        let particles = [(100, 0.01, -60.0), (1, 1e-3, -10.0), (100, 1e-9, 0.0)];
        let (weights, logs): (Vec<f64>, Vec<f64>) = (particles.into_iter())
            .flat_map(|(count, weight, log)| std::iter::repeat_n((weight, log), count))
            .unzip();
        assert!(effective(&weights, &logs, 0.5) < 5.0 && effective(&weights, &logs, 1.0) > 5.0);
        let beta = exponent(&weights, &logs, 5.0, 0.5);
        assert!(beta < 0.5, "{beta}");
        assert_relative_eq!(effective(&weights, &logs, beta), 5.0, max_relative = 0.01);
    }

    #[test]
    fn weights_with_too_few_effective_particles_are_unchanged() {
        assert_eq!(
            exponent(&[0.97, 0.01, 0.01, 0.01], &[0.0, -9.0, 0.0, 0.0], 3.0, 1.0),
            0.0
        );
    }
}
