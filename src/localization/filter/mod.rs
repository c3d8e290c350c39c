//! The particle filter: Monte Carlo localization with range images.
//!
//! ```text
//! propagate      x ~ p(x | x_before, odometry)           motion
//! reweight       w ∝ w · p(scan | x, map)ᵝ               observation, tempering
//! estimate       weighted mean, covariance              particles
//! phase          searching, tracking, lost              phase, tracking_loss
//! resample       when few particles carry the weight     resampling
//! ```
//!
//! While the filter searches around one place, reweighting and resampling alternate several times within one frame,
//! with an increasingly peaked likelihood (annealing); several places are compared as such
//! ([`places`](super::places)). Once the distribution is narrow, `num_reduced`
//! particles are enough; they are sampled from the product of prediction and registration
//! ([`proposal`](super::proposal)).

mod phase;
mod state;

mod around;
mod coast;
mod propose;
mod resample;
mod reweight;
mod search;
mod step;

pub use state::ParticleFilter;

#[cfg(test)]
mod exact_tests;
#[cfg(test)]
mod filter_tests;
#[cfg(test)]
mod level_tests;
