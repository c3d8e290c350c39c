//! Places where the car may be, while the particles are far apart.
//!
//! After a start anywhere few particles are near the right pose, and their costs depend on how near they are more than on
//! how well the scan fits there. The best particle of each place is therefore registered with the map, and places are
//! compared by the mean costs d of the registered poses:
//!
//! ```text
//! W_p ∝ W_p · exp(−max(0, d_p − min d − d₀) / s)          W_p: weight of the particles of place p before
//! ```
//!
//! Maps are off by d₀: costs that differ by less decide nothing, so that places that look alike remain until driving
//! tells them apart. Each place keeps a number of particles however small its weight is. Milstein, Sánchez and
//! Williamson, *Robust Global Localization Using Clustered Particle Filtering*, AAAI 2002, for particles per cluster.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::particles::Particle;
use crate::geometry::Pose2;
use crate::map::LEVEL_GAP_M;
use crate::validation::{InvalidValue, Validate, fraction, in_range, not_negative, positive};

/// Search among several places.
///
/// Defaults: values of this project; `docs/method.md`, Thresholds, has what half and twice of them change on four sensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PlacesConfig {
    /// Largest number of places that are registered in a frame.
    #[default(40)]
    pub most: usize,
    /// Distance up to which poses of like heading are in the same place [m].
    #[default(5.0)]
    pub radius_m: f64,
    /// Difference of mean costs that decides nothing between places, d₀ [m].
    #[default(0.01)]
    pub tolerance_m: f64,
    /// Scale s: a mean cost that is larger by s beyond that is e times less likely [m].
    #[default(0.005)]
    pub scale_m: f64,
    /// Largest standard deviation of the position around a given start that is one place: √(σ_x² + σ_y²) [m].
    #[default(10.0)]
    pub known_start_m: f64,
    /// Weight from which on a place is counted as likely, 0 to 1.
    #[default(0.01)]
    pub likely_weight: f64,
    /// Weight below which a place is given up, 0 to 1. All of the 40 places that are registered in a frame weigh less than
    /// 0.00004 together then: the probability that the right one is given up, as far as the weights are right. A scan is registered
    /// further at a pose where its coarse cost exceeds the least by at most twice what this weight allows.
    #[default(1e-6)]
    pub given_up_weight: f64,
}

impl PlacesConfig {
    /// Excess of its cost above the least at which a place of equal weight is given up [m].
    pub(crate) fn excess_given_up_m(&self) -> f64 {
        self.tolerance_m - self.scale_m * self.given_up_weight.ln()
    }
}

impl Validate for PlacesConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("most", self.most, 1..=1000)?;
        positive("radius_m", self.radius_m)?;
        not_negative("tolerance_m", self.tolerance_m)?;
        positive("scale_m", self.scale_m)?;
        positive("known_start_m", self.known_start_m)?;
        fraction("likely_weight", self.likely_weight)?;
        in_range("given_up_weight", self.given_up_weight, 0.0..=0.1)
    }
}

/// Whether two poses are in the same place.
pub fn is_same(a: &Pose2, b: &Pose2, radius_m: f64) -> bool {
    /// Largest difference of headings: a crossroads looks alike from its roads.
    const SAME_HEADING_RAD: f64 = std::f64::consts::FRAC_PI_4;
    let between = a.inverse() * b;
    between.translation.vector.norm() < radius_m
        && between.rotation.angle().abs() < SAME_HEADING_RAD
}

/// Whether two particles are in the same place, on the same level of the ground.
fn is_same_level(a: &Particle, b: &Particle, radius_m: f64) -> bool {
    let apart_m = a.level_m.zip(b.level_m).map_or(0.0, |(a, b)| (a - b).abs());
    apart_m < LEVEL_GAP_M && is_same(&a.map_from_lidar, &b.map_from_lidar, radius_m)
}

/// Indices of the particles of least cost in each of at most `most` places; particles without a cost are left out.
pub fn best_of_each<'a>(
    particles: impl IntoIterator<Item = &'a Particle>,
    costs_m: &[Option<f64>],
    most: usize,
    radius_m: f64,
) -> Vec<usize> {
    let particles: Vec<&Particle> = particles.into_iter().collect();
    let mut ascending: Vec<(f64, usize)> = (costs_m.iter().zip(0..))
        .filter_map(|(cost_m, index)| Some(((*cost_m)?, index)))
        .collect();
    ascending.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut chosen: Vec<usize> = Vec::new();
    for (_, index) in ascending {
        if chosen.len() == most {
            break;
        }
        let is_here = |&other: &usize| is_same_level(particles[other], particles[index], radius_m);
        if !chosen.iter().any(is_here) {
            chosen.push(index);
        }
    }
    chosen
}

/// Weights of the particles in each place; a particle counts for the first place that it is in.
pub fn weights_in(places: &[Particle], particles: &[Particle], radius_m: f64) -> Vec<f64> {
    let mut weights = vec![0.0; places.len()];
    for particle in particles {
        let is_here = |place: &Particle| is_same_level(place, particle, radius_m);
        if let Some(place) = places.iter().position(is_here) {
            weights[place] += particle.weight;
        }
    }
    weights
}

/// Weights of places after a scan, which sum to one: those before, and the costs of the registered poses [m]. Places
/// that are given up have none.
pub fn weights_after(before: &[f64], costs_m: &[f64], config: &PlacesConfig) -> Vec<f64> {
    let least_m = costs_m.iter().copied().fold(f64::INFINITY, f64::min);
    let likelihood =
        |cost_m: f64| (-(cost_m - least_m - config.tolerance_m).max(0.0) / config.scale_m).exp();
    let mut weights: Vec<f64> = (before.iter().zip(costs_m))
        .map(|(weight, &cost_m)| weight * likelihood(cost_m))
        .collect();
    for least in [0.0, config.given_up_weight] {
        let sum: f64 = weights.iter().sum();
        for weight in &mut weights {
            *weight = if *weight >= least * sum {
                *weight / sum
            } else {
                0.0
            };
        }
    }
    weights
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector2;

    use super::super::particles::ParticleSet;
    use super::*;

    fn at(x: f64, heading_rad: f64) -> Pose2 {
        Pose2::new(Vector2::new(x, 0.0), heading_rad)
    }

    #[test]
    fn the_best_of_each_place_is_chosen_whatever_the_number_of_particles_there() {
        let poses = [
            at(0.0, 0.0),
            at(1.0, 0.1),
            at(70.0, 0.0),
            at(0.5, 3.0),
            at(900.0, 0.0),
        ];
        let poses = poses.map(Particle::from);
        let costs_m = [Some(0.3), Some(0.1), Some(0.4), Some(0.2), None];
        assert_eq!(best_of_each(&poses, &costs_m, 9, 5.0), [1, 3, 2]);
        assert_eq!(best_of_each(&poses, &costs_m, 2, 5.0), [1, 3]);
    }

    #[test]
    fn each_level_of_a_car_park_is_a_place_of_its_own() {
        let on = |level_m: Option<f64>| Particle::new(at(0.0, 0.0), level_m);
        let particles = [on(Some(0.0)), on(Some(3.0)), on(Some(0.5)), on(None)];
        let costs_m = [Some(0.1), Some(0.2), Some(0.3), Some(0.4)];
        assert_eq!(best_of_each(&particles, &costs_m, 9, 5.0), [0, 1]);
        let places = &particles[..2];
        let set = ParticleSet::weighted(particles.to_vec());
        // That on no known level counts for the first place.
        assert_eq!(weights_in(places, set.particles(), 5.0), [0.75, 0.25]);
    }

    #[test]
    fn costs_that_differ_by_less_than_maps_are_off_decide_nothing() {
        let config = PlacesConfig::default();
        let mut weights = vec![0.5, 0.5];
        for _ in 0..1000 {
            weights = weights_after(&weights, &[0.050, 0.059], &config);
        }
        assert_relative_eq!(weights[0], 0.5, epsilon = 1e-9);
        // 1 cm more than that is two scales.
        let weights = weights_after(&weights, &[0.05, 0.07], &config);
        assert_relative_eq!(weights[1] / weights[0], (-2.0_f64).exp(), epsilon = 1e-9);
    }

    #[test]
    fn weights_sum_to_one_and_a_common_offset_of_the_costs_changes_nothing() {
        let config = PlacesConfig::default();
        let before = [0.2, 0.5, 0.3];
        let (a, b) = ([0.1, 0.13, 0.3], [0.5, 0.53, 0.7]);
        let (a, b) = (
            weights_after(&before, &a, &config),
            weights_after(&before, &b, &config),
        );
        assert_relative_eq!(a.iter().sum::<f64>(), 1.0, epsilon = 1e-12);
        for (a, b) in a.iter().zip(&b) {
            assert_relative_eq!(*a, *b, epsilon = 1e-9);
        }
        assert_eq!(a[2], 0.0, "a place of no weight is given up");
    }

    #[test]
    fn a_particle_counts_for_one_place() {
        let set = ParticleSet::uniform([at(0.0, 0.0), at(4.0, 0.0), at(70.0, 0.0), at(200.0, 0.0)]);
        let weights = weights_in(
            &[at(2.0, 0.0), at(5.0, 0.0), at(71.0, 0.0)].map(Particle::from),
            set.particles(),
            5.0,
        );
        assert_eq!(weights, [0.5, 0.0, 0.25]);
    }
}
