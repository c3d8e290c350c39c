//! Trusting a frame no more than the particles can bear.
//!
//! The beams of a frame are not independent, and far more precise than a cloud of particles is
//! dense: taken at its word, the likelihood leaves one survivor. So it is raised to a power,
//!
//! ```text
//! wᵢ ∝ wᵢ · L_iᵝ        β = max { β ≤ 1 : N_eff(β) ≥ N_min }
//! ```
//!
//! the largest that leaves enough effective particles. Del Moral, Doucet and Jasra, *An Adaptive
//! Sequential Monte Carlo Method for Approximate Bayesian Computation* (2012), section 3; Deutscher,
//! Blake and Reid, *Articulated Body Motion Capture by Annealed Particle Filtering*, CVPR 2000.

/// The exponent β, at most `most`, for the effective sample size `min_effective`, to 1e-4 relative.
///
/// `most` itself where even that leaves enough; 0 where the weights alone leave too few already.
pub fn exponent(weights: &[f64], log_likelihoods: &[f64], min_effective: f64, most: f64) -> f64 {
    let enough = |beta: f64| effective(weights, log_likelihoods, beta) >= min_effective;
    if enough(most) {
        return most;
    }
    if !enough(0.0) {
        return 0.0;
    }
    // The scale is unknown: halve down to a β that leaves enough, then bisect above it.
    let mut low = 0.5 * most;
    while !enough(low) && low > most * 1e-12 {
        low *= 0.5;
    }
    let mut high = 2.0 * low;
    while high - low > 1e-4 * high {
        let middle = 0.5 * (low + high);
        if enough(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

/// The effective sample size that an exponent leaves.
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
        .map(|(weight, log)| weight * (beta * (log - highest)).exp())
        .fold((0.0, 0.0), |(sum, squares), w| (sum + w, squares + w * w));
    sum * sum / squares
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn a_flat_likelihood_is_taken_at_its_word() {
        assert_eq!(exponent(&[0.25; 4], &[-3.0; 4], 2.0, 1.0), 1.0);
    }

    #[test]
    fn a_sharp_likelihood_leaves_just_enough_particles() {
        let logs: Vec<f64> = (0..100).map(|i| -50.0 * f64::from(i)).collect();
        let weights = [0.01; 100];
        let beta = exponent(&weights, &logs, 30.0, 1.0);
        assert!(beta < 0.01, "{beta}");
        assert_relative_eq!(effective(&weights, &logs, beta), 30.0, epsilon = 0.1);
    }

    #[test]
    fn scaling_the_likelihood_scales_the_exponent_back() {
        let logs: Vec<f64> = (0..50).map(|i| -f64::from(i * i)).collect();
        let sharper: Vec<f64> = logs.iter().map(|log| 8.0 * log).collect();
        let weights = [0.02; 50];
        let beta = exponent(&weights, &logs, 10.0, 1.0);
        let sharper_beta = exponent(&weights, &sharper, 10.0, 1.0);
        assert_relative_eq!(beta, 8.0 * sharper_beta, max_relative = 1e-3);
    }

    #[test]
    fn weights_that_are_too_few_already_are_left_alone() {
        assert_eq!(
            exponent(&[0.97, 0.01, 0.01, 0.01], &[0.0, -9.0, 0.0, 0.0], 3.0, 1.0),
            0.0
        );
    }
}
