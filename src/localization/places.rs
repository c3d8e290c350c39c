//! Places where the car may be, while the particles are far apart.
//!
//! After a start anywhere few particles are near the right pose, and their costs depend on how near they are more than on
//! how well the scan fits there. The best particle of each place is therefore registered with the map, and places are
//! compared by the mean costs d of the registered poses:
//!
//! ```text
//! W_p ∝ W_p · exp(−max(0, d_p − min d − d₀) / s)          W_p: weight of the particles of place p before
//! d₀ = tolerance                                          between places on one level of the ground
//! d₀ = max(tolerance, 2 √Σ_k (d_pk − d_qk)²)              on different ones; d_pk: part of sector k in d_p, q: place of min d
//! ```
//!
//! Maps are off by the tolerance: costs that differ by less decide nothing, so that places that look alike remain until
//! driving tells them apart. Storeys of a building are alike but for what stands there, such as parked cars, which change: if
//! each sector of the scan favors either storey by chance, the sum of the differences has the standard deviation
//! √Σ (d_pk − d_qk)² (the sign-flip test, Fisher, *The Design of Experiments*, 1935, section 21). Each place keeps a number of
//! particles however small its weight is. Milstein, Sánchez and Williamson, *Robust Global Localization Using Clustered
//! Particle Filtering*, AAAI 2002, for particles per cluster.

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

/// Whether two heights of the ground are on one level [m]; those that are not known are.
fn is_one_level(a_m: Option<f64>, b_m: Option<f64>) -> bool {
    a_m.zip(b_m)
        .is_none_or(|(a, b)| (a - b).abs() < LEVEL_GAP_M)
}

/// Whether two particles are in the same place, on the same level of the ground.
pub fn is_same_place(a: &Particle, b: &Particle, radius_m: f64) -> bool {
    is_one_level(a.level_m, b.level_m) && is_same(&a.map_from_lidar, &b.map_from_lidar, radius_m)
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
        let is_here = |&other: &usize| is_same_place(particles[other], particles[index], radius_m);
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
        let is_here = |place: &Particle| is_same_place(place, particle, radius_m);
        if let Some(place) = places.iter().position(is_here) {
            weights[place] += particle.weight;
        }
    }
    weights
}

/// What is compared of a place.
#[derive(Clone)]
pub struct PlaceCosts {
    /// Parts that each sector of a scan has in its mean cost at the registered pose [m].
    pub by_sector_m: Vec<f64>,
    /// Height of the ground [m].
    pub level_m: Option<f64>,
}

impl PlaceCosts {
    /// Mean cost [m].
    pub fn mean_m(&self) -> f64 {
        self.by_sector_m.iter().sum()
    }

    /// By how much the mean cost exceeds that of another place more than maps are off and than chance explains [m].
    fn excess_m(&self, least: &Self, tolerance_m: f64) -> f64 {
        /// Standard deviations that chance explains.
        const SIGMAS: f64 = 2.0;
        let by_sector_m = self.by_sector_m.iter().zip(&least.by_sector_m);
        let squares = by_sector_m.map(|(cost_m, least_m)| (cost_m - least_m).powi(2));
        let by_chance_m = if is_one_level(self.level_m, least.level_m) {
            0.0
        } else {
            SIGMAS * squares.sum::<f64>().sqrt()
        };
        (self.mean_m() - least.mean_m() - tolerance_m.max(by_chance_m)).max(0.0)
    }
}

/// Weights of places after a scan, which sum to one: those before, and the costs of the scan. Places that are given up have none.
pub fn weights_after(before: &[f64], costs: &[PlaceCosts], config: &PlacesConfig) -> Vec<f64> {
    let Some(least) = (costs.iter()).min_by(|a, b| a.mean_m().total_cmp(&b.mean_m())) else {
        return Vec::new();
    };
    let likelihood =
        |costs: &PlaceCosts| (-costs.excess_m(least, config.tolerance_m) / config.scale_m).exp();
    let mut weights: Vec<f64> = (before.iter().zip(costs))
        .map(|(weight, costs)| weight * likelihood(costs))
        .collect();
    for least in [config.given_up_weight, 0.0] {
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

    /// A cost of which each sector of a scan has the same part.
    fn evenly(cost_m: f64) -> PlaceCosts {
        PlaceCosts {
            by_sector_m: vec![cost_m / 24.0; 24],
            level_m: Some(0.0),
        }
    }

    #[test]
    fn costs_that_differ_by_less_than_maps_are_off_decide_nothing() {
        let config = PlacesConfig::default();
        let mut weights = vec![0.5, 0.5];
        for _ in 0..1000 {
            weights = weights_after(&weights, &[0.050, 0.059].map(evenly), &config);
        }
        assert_relative_eq!(weights[0], 0.5, epsilon = 1e-9);
        // 1 cm more than that is two scales.
        let weights = weights_after(&weights, &[0.05, 0.07].map(evenly), &config);
        assert_relative_eq!(weights[1] / weights[0], (-2.0_f64).exp(), epsilon = 1e-9);
    }

    #[test]
    fn weights_sum_to_one_and_a_common_offset_of_the_costs_changes_nothing() {
        let config = PlacesConfig::default();
        let before = [0.2, 0.5, 0.3];
        let (a, b) = ([0.1, 0.13, 0.3], [0.5, 0.53, 0.7]);
        let (a, b) = (
            weights_after(&before, &a.map(evenly), &config),
            weights_after(&before, &b.map(evenly), &config),
        );
        assert_relative_eq!(a.iter().sum::<f64>(), 1.0, epsilon = 1e-12);
        for (a, b) in a.iter().zip(&b) {
            assert_relative_eq!(*a, *b, epsilon = 1e-9);
        }
        assert_eq!(a[2], 0.0, "a place of no weight is given up");
    }

    #[test]
    fn on_another_level_differences_in_few_sectors_and_those_that_favor_either_place_decide_nothing()
     {
        let config = PlacesConfig::default();
        // Sectors in which the second place is worse by 1 cm of the mean cost, and in which it is better by that.
        for (worse, better, is_decided) in [
            (3, 0, false),
            (6, 0, true),
            (12, 6, false),
            (16, 2, true),
            (24, 0, true),
        ] {
            for (level_m, is_decided) in [(Some(2.5), is_decided), (Some(1.5), true), (None, true)]
            {
                let mut costs = [evenly(0.24), evenly(0.24)];
                costs[1].by_sector_m[..worse].fill(0.02);
                costs[1].by_sector_m[worse..worse + better].fill(0.0);
                costs[1].level_m = level_m;
                let weights = weights_after(&[0.5, 0.5], &costs, &config);
                assert_eq!(weights[1] < 0.5, is_decided, "{worse} {better} {level_m:?}");
                costs.swap(0, 1);
                let swapped = weights_after(&[0.5, 0.5], &costs, &config);
                assert_relative_eq!(swapped[0], weights[1], epsilon = 1e-12);
            }
        }
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
