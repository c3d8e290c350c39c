//! Weighted particles: the distribution over the pose of the car.
//!
//! ```text
//! Σ wᵢ = 1        N_eff = 1 / Σ wᵢ²        mean = (Σ wᵢ xᵢ, Σ wᵢ yᵢ, arg Σ wᵢ e^{iθᵢ})
//! ```
//!
//! Every operation keeps the sum of the weights at one. Thrun, Burgard and Fox, *Probabilistic
//! Robotics* (2005), chapter 4.3; Kong, Liu and Wong (1994) for the effective sample size.

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::geometry::{Pose2, circular_mean, wrap_angle};

/// A pose hypothesis of the filter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Particle {
    /// `p_map = map_from_lidar * p_lidar`, in the plane.
    pub map_from_lidar: Pose2,
    /// Height of the ground below it [m], which selects among several levels; `None` before any ground
    /// was found.
    pub level_m: Option<f64>,
    /// Importance weight, 0 to 1 in a set (unitless).
    pub weight: f64,
}

impl Particle {
    /// A particle of weight 1.
    pub(crate) fn new(map_from_lidar: Pose2, level_m: Option<f64>) -> Self {
        Self {
            map_from_lidar,
            level_m,
            weight: 1.0,
        }
    }
}

impl From<Pose2> for Particle {
    /// A particle of weight 1 without a known level.
    fn from(map_from_lidar: Pose2) -> Self {
        Self::new(map_from_lidar, None)
    }
}

/// Particles whose weights sum to one.
#[derive(Clone, Debug, PartialEq)]
pub struct ParticleSet {
    particles: Vec<Particle>,
}

impl ParticleSet {
    /// At least one particle, with equal weights whatever they were.
    pub fn uniform(particles: impl IntoIterator<Item = impl Into<Particle>>) -> Self {
        let mut particles: Vec<Particle> = particles.into_iter().map(Into::into).collect();
        debug_assert!(!particles.is_empty(), "a distribution needs a particle");
        let weight = 1.0 / particles.len() as f64;
        particles
            .iter_mut()
            .for_each(|particle| particle.weight = weight);
        Self { particles }
    }

    /// At least one particle of positive weight; the weights are normalized.
    pub(crate) fn weighted(mut particles: Vec<Particle>) -> Self {
        let sum: f64 = particles.iter().map(|particle| particle.weight).sum();
        debug_assert!(sum > 0.0, "a distribution needs weight");
        for particle in &mut particles {
            particle.weight /= sum;
        }
        Self { particles }
    }

    /// Number of particles.
    pub fn len(&self) -> usize {
        self.particles.len()
    }

    /// Whether there are no particles.
    pub fn is_empty(&self) -> bool {
        self.particles.is_empty()
    }

    /// The particles, in a fixed order.
    pub fn particles(&self) -> &[Particle] {
        &self.particles
    }

    /// The poses `map_from_lidar` in the plane, in the order of the particles.
    pub fn poses(&self) -> impl ExactSizeIterator<Item = &Pose2> {
        self.particles
            .iter()
            .map(|particle| &particle.map_from_lidar)
    }

    /// The weights, whose sum is one, in the order of the particles.
    pub fn weights(&self) -> Vec<f64> {
        self.particles.iter().map(|p| p.weight).collect()
    }

    /// Moves every particle, in order.
    pub(crate) fn propagate(&mut self, mut moved: impl FnMut(&Pose2) -> Pose2) {
        for particle in &mut self.particles {
            particle.map_from_lidar = moved(&particle.map_from_lidar);
        }
    }

    /// Sets the heights of the ground below the particles [m], in order; particles without ground keep
    /// the last one.
    pub(crate) fn set_levels(&mut self, levels_m: impl IntoIterator<Item = Option<f64>>) {
        for (particle, level_m) in self.particles.iter_mut().zip(levels_m) {
            particle.level_m = level_m.or(particle.level_m);
        }
    }

    /// Multiplies every weight by its likelihood and normalizes (Bayes' rule). The logarithms may have
    /// any common offset, and their exponentials do not underflow.
    pub fn reweight(&mut self, log_likelihoods: &[f64]) {
        debug_assert_eq!(log_likelihoods.len(), self.len());
        let highest = self
            .particles
            .iter()
            .zip(log_likelihoods)
            .filter(|(particle, _)| particle.weight > 0.0)
            .map(|(_, &log)| log)
            .fold(f64::NEG_INFINITY, f64::max);
        if !highest.is_finite() {
            return;
        }
        for (particle, log) in self.particles.iter_mut().zip(log_likelihoods) {
            // Those above the highest have no weight; their exponentials must not overflow.
            particle.weight *= (log - highest).min(0.0).exp();
        }
        let sum: f64 = self.particles.iter().map(|p| p.weight).sum();
        for particle in &mut self.particles {
            particle.weight /= sum;
        }
    }

    /// Number of equally weighted particles with the same variance, 1 to N (unitless).
    pub fn effective_sample_size(&self) -> f64 {
        1.0 / self.particles.iter().map(|p| p.weight.powi(2)).sum::<f64>()
    }

    /// Copies of the particles with these indices, equally weighted; an index may occur several times.
    #[must_use]
    pub(crate) fn selected(&self, indices: &[usize]) -> Self {
        Self::uniform(indices.iter().map(|&index| self.particles[index]))
    }

    /// The particle with the largest weight, the first among equals.
    pub fn best(&self) -> Particle {
        let heavier = |best: Particle, next: &Particle| {
            if next.weight > best.weight {
                *next
            } else {
                best
            }
        };
        self.particles.iter().fold(self.particles[0], heavier)
    }

    /// Weighted mean, with the circular mean of the headings; the heading of the best particle where
    /// the circular mean is undefined.
    pub fn mean(&self) -> Pose2 {
        let position: Vector2<f64> = self
            .particles
            .iter()
            .map(|p| p.weight * p.map_from_lidar.translation.vector)
            .sum();
        let headings = self
            .particles
            .iter()
            .map(|p| (p.map_from_lidar.rotation.angle(), p.weight));
        let heading_rad =
            circular_mean(headings).unwrap_or_else(|| self.best().map_from_lidar.rotation.angle());
        Pose2::new(position, heading_rad)
    }

    /// Weighted covariance of (x, y, heading) about a pose, in the axes of the map [m², m·rad, rad²].
    pub(crate) fn covariance_about(&self, center: &Pose2) -> Matrix3<f64> {
        self.particles
            .iter()
            .map(|particle| {
                let offset = deviation(&particle.map_from_lidar, center);
                particle.weight * offset * offset.transpose()
            })
            .sum()
    }

    /// Covariance of (x, y, heading) of the mean as an estimate of the pose, in the axes of the map
    /// [m², m·rad, rad²]: that of the distribution, and that of the mean of so few samples,
    ///
    /// ```text
    /// Σ = Σ_weighted + Σ_samples / N_eff        Σ_samples: of the particles without their weights
    /// ```
    pub(crate) fn covariance_of_estimate(&self) -> Matrix3<f64> {
        let samples = Self::uniform(self.poses().copied());
        let of_mean = samples.covariance_about(&samples.mean()) / self.effective_sample_size();
        self.covariance_about(&self.mean()) + of_mean
    }
}

/// Difference of two poses: Δx, Δy [m] in the axes of the map and the turn in [-π, π) [rad].
pub fn deviation(pose: &Pose2, center: &Pose2) -> Vector3<f64> {
    let offset = pose.translation.vector - center.translation.vector;
    let turn_rad = wrap_angle(pose.rotation.angle() - center.rotation.angle());
    offset.push(turn_rad)
}

/// Standard deviation of the position along the long axis of a covariance of (x, y, heading) [m].
pub fn long_axis_m(covariance: &Matrix3<f64>) -> f64 {
    let position = covariance.fixed_view::<2, 2>(0, 0).into_owned();
    position.symmetric_eigenvalues().max().max(0.0).sqrt()
}

/// Standard deviations of a covariance of (x, y, heading): position as √(σ_x² + σ_y²) [m], heading [rad].
pub fn spread(covariance: &Matrix3<f64>) -> (f64, f64) {
    (
        (covariance[(0, 0)] + covariance[(1, 1)]).max(0.0).sqrt(),
        covariance[(2, 2)].max(0.0).sqrt(),
    )
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use approx::assert_relative_eq;
    use rand::{SeedableRng as _, rngs::StdRng};
    use rand_distr::{Distribution as _, StandardNormal};

    use super::*;

    fn pose(x: f64, y: f64, heading: f64) -> Pose2 {
        Pose2::new(Vector2::new(x, y), heading)
    }

    fn total(set: &ParticleSet) -> f64 {
        set.particles().iter().map(|p| p.weight).sum()
    }

    #[test]
    fn the_covariance_of_an_estimate_from_few_samples_matches_its_errors() {
        let mut rng = StdRng::seed_from_u64(3);
        let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
        let trials = 3000;
        let mut squared = 0.0;
        for _ in 0..trials {
            let truth_m = normal();
            // Sampled twice as wide as the weighted distribution.
            let mut set = ParticleSet::uniform((0..8).map(|_| pose(2.0 * normal(), 0.0, 0.0)));
            let logs: Vec<f64> = set
                .poses()
                .map(|pose| pose.translation.x.powi(2) * (0.125 - 0.5))
                .collect();
            set.reweight(&logs);
            let error_m = set.mean().translation.x - truth_m;
            squared += error_m.powi(2) / set.covariance_of_estimate()[(0, 0)];
        }
        // Slightly conservative; the covariance of the weighted particles alone gives 1.1.
        let normalized = squared / f64::from(trials);
        assert!((0.7..1.1).contains(&normalized), "{normalized}");
    }

    #[test]
    fn weights_sum_to_one_after_every_operation() {
        let mut set = ParticleSet::uniform((0..7).map(|i| pose(f64::from(i), 0.0, 0.0)));
        assert_relative_eq!(total(&set), 1.0, epsilon = 1e-12);
        for logs in [
            [0.0; 7],
            [-1e4; 7],
            [-1.0, -2.0, -900.0, 3.0, 0.0, 0.5, -1e9],
        ] {
            set.reweight(&logs);
            assert_relative_eq!(total(&set), 1.0, epsilon = 1e-12);
        }
        set.propagate(|p| pose(1.0, 0.0, 0.0) * p);
        assert_relative_eq!(total(&set), 1.0, epsilon = 1e-12);
        assert_relative_eq!(total(&set.selected(&[1, 1, 4])), 1.0, epsilon = 1e-12);
    }

    #[test]
    fn resampled_particles_weigh_the_same_and_keep_the_mean() {
        let mut set = ParticleSet::uniform((0..4).map(|i| pose(f64::from(i), 0.0, 0.0)));
        set.reweight(&[0.1_f64, 0.2, 0.3, 0.4].map(f64::ln));
        let mean_m = set.mean().translation.x;
        assert_relative_eq!(mean_m, 2.0, epsilon = 1e-12);
        // The copies that resampling draws for these weights.
        let resampled = set.selected(&[0, 1, 1, 2, 2, 2, 3, 3, 3, 3]);
        assert!(resampled.weights().iter().all(|&weight| weight == 0.1));
        assert_relative_eq!(resampled.mean().translation.x, mean_m, epsilon = 1e-12);
    }

    #[test]
    fn given_weights_are_normalized_and_the_first_of_the_heaviest_is_the_best() {
        let weights = [1.0, 3.0, 0.5, 3.0, 0.5];
        let particles = weights.iter().enumerate().map(|(index, &weight)| Particle {
            weight,
            ..Particle::new(pose(index as f64, 0.0, 0.0), None)
        });
        let set = ParticleSet::weighted(particles.collect());
        assert_eq!(set.weights(), weights.map(|weight| weight / 8.0));
        assert_eq!(set.best().map_from_lidar.translation.x, 1.0);
        assert!(set.len() == 5 && !set.is_empty());
    }

    #[test]
    fn particles_are_moved_in_order_and_keep_the_level_where_there_is_no_ground() {
        let mut set = ParticleSet::uniform([0.0, 1.0].map(|x| pose(x, 0.0, 0.0)));
        set.propagate(|before| before * pose(0.0, 2.0, 0.0));
        set.set_levels([Some(3.0), Some(4.0)]);
        set.set_levels([None, Some(5.0)]);
        let found: Vec<_> = (set.particles().iter())
            .map(|it| (it.map_from_lidar, it.level_m))
            .collect();
        let expected = [
            (pose(0.0, 2.0, 0.0), Some(3.0)),
            (pose(1.0, 2.0, 0.0), Some(5.0)),
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn a_likely_particle_without_weight_does_not_take_the_weight_of_the_others() {
        let mut set = ParticleSet::uniform([0.0, 1.0].map(|x| pose(x, 0.0, 0.0)));
        set.reweight(&[0.0, f64::NEG_INFINITY]);
        set.reweight(&[-2000.0, 0.0]);
        assert_eq!(set.weights(), [1.0, 0.0]);
    }

    #[test]
    fn only_likelihood_ratios_matter() {
        let start = ParticleSet::uniform((0..3).map(|i| pose(f64::from(i), 0.0, 0.0)));
        let (mut a, mut b) = (start.clone(), start);
        a.reweight(&[0.0, 1.0, 2.0]);
        b.reweight(&[-5000.0, -4999.0, -4998.0]);
        for (a, b) in a.particles().iter().zip(b.particles()) {
            assert_relative_eq!(a.weight, b.weight, epsilon = 1e-12);
        }
        let ratio = a.particles()[2].weight / a.particles()[1].weight;
        assert_relative_eq!(ratio, 1.0_f64.exp(), epsilon = 1e-9);
    }

    #[test]
    fn the_effective_sample_size_is_n_for_equal_weights_and_one_for_a_single_weight() {
        let mut set = ParticleSet::uniform((0..5).map(|i| pose(f64::from(i), 0.0, 0.0)));
        assert_relative_eq!(set.effective_sample_size(), 5.0, epsilon = 1e-9);
        set.reweight(&[0.0, -1e6, -1e6, -1e6, -1e6]);
        assert_relative_eq!(set.effective_sample_size(), 1.0, epsilon = 1e-9);
    }

    #[test]
    fn the_mean_heading_around_pi_is_pi() {
        let set = ParticleSet::uniform([pose(0.0, 0.0, PI - 0.1), pose(2.0, 0.0, -PI + 0.1)]);
        assert_relative_eq!(set.mean().translation.x, 1.0, epsilon = 1e-12);
        assert_relative_eq!(set.mean().rotation.angle().abs(), PI, epsilon = 1e-9);
        let covariance = set.covariance_about(&set.mean());
        assert_relative_eq!(covariance[(2, 2)], 0.01, epsilon = 1e-9);
        assert_relative_eq!(covariance[(0, 0)], 1.0, epsilon = 1e-9);
    }
}
