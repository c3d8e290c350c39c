//! Convergence of the particles: they occupy few tiles and their spread is small.
//!
//! ```text
//! converged  ⇔  0 < occupied valid tiles < converge_thres  ∧  √(σ_x² + σ_y²) < s  ∧  σ_θ < s_θ
//! ```
//!
//! The first condition is range-mcl's (Chen et al., ICRA 2021, section III-D). On a map of one tile it
//! holds from the first frame on, hence the limits on the spread.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::particles::{ParticleSet, spread};
use crate::map::TileGrid;
use crate::validation::{InvalidValue, Validate, at_least_one, positive_or_infinite};

/// Thresholds of convergence.
///
/// Defaults: two tiles, as range-mcl; half a metre and five degrees.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ConvergenceConfig {
    /// Number of occupied valid tiles below which the particles have converged.
    #[default(2)]
    pub converge_thres: usize,
    /// Standard deviation of the position, and of the height of the ground below it, below which they have converged [m];
    /// infinite for range-mcl's condition alone.
    #[default(0.5)]
    pub max_spread_m: f64,
    /// Standard deviation of the heading below which they have converged [rad].
    #[default(5.0_f64.to_radians())]
    pub max_spread_rad: f64,
}

impl Validate for ConvergenceConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        at_least_one("converge_thres", self.converge_thres)?;
        positive_or_infinite("max_spread_m", self.max_spread_m)?;
        positive_or_infinite("max_spread_rad", self.max_spread_rad)
    }
}

/// Number of valid tiles that contain particles.
pub fn occupied_tiles(particles: &ParticleSet, tiles: &TileGrid) -> usize {
    let occupied: BTreeSet<_> = particles
        .poses()
        .filter_map(|pose| tiles.valid_tile_of(pose))
        .collect();
    occupied.len()
}

/// Whether the spread is small, whatever tiles the particles occupy.
pub fn is_narrow(particles: &ParticleSet, config: &ConvergenceConfig) -> bool {
    let (position_m, heading_rad) = spread(&particles.covariance_about(&particles.mean()));
    position_m < config.max_spread_m
        && heading_rad < config.max_spread_rad
        && level_spread_m(particles) < config.max_spread_m
}

/// Standard deviation of the height of the ground below the particles, of those for which it is known [m].
fn level_spread_m(particles: &ParticleSet) -> f64 {
    let known = particles.particles().iter();
    let known = known.filter_map(|it| Some((it.weight, it.level_m?)));
    let [sum, first, second] = known.fold([0.0; 3], |sums, (weight, level_m)| {
        let terms = [1.0, level_m, level_m.powi(2)];
        [0, 1, 2].map(|power| sums[power] + weight * terms[power])
    });
    if sum <= 0.0 {
        return 0.0;
    }
    (second / sum - (first / sum).powi(2)).max(0.0).sqrt()
}

/// Whether the particles have converged: a small number is sufficient.
pub fn is_converged(particles: &ParticleSet, tiles: &TileGrid, config: &ConvergenceConfig) -> bool {
    let occupied = occupied_tiles(particles, tiles);
    occupied > 0 && occupied < config.converge_thres && is_narrow(particles, config)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;

    use super::*;
    use crate::geometry::{Pose2, Pose3};
    use crate::localization::particles::Particle;
    use crate::map::TileConfig;

    fn tiles() -> TileGrid {
        let poses: Vec<Pose3> = (0..200)
            .map(|i| Pose3::translation(f64::from(i), 0.0, 0.0))
            .collect();
        TileGrid::around(&poses, &TileConfig::default())
    }

    #[test]
    fn particles_on_two_levels_of_a_car_park_have_not_converged() {
        let config = ConvergenceConfig::default();
        let on = |level_m: Option<f64>| Particle::new(Pose2::identity(), level_m);
        for (levels_m, is_one) in [
            ([Some(500.0), Some(500.2)], true),
            ([Some(0.0), None], true),
            ([None, None], true),
            ([Some(0.0), Some(3.0)], false),
        ] {
            let particles = ParticleSet::uniform(levels_m.map(on));
            assert_eq!(is_narrow(&particles, &config), is_one, "{levels_m:?}");
        }
    }

    fn at(places: &[(f64, f64)]) -> ParticleSet {
        ParticleSet::uniform(
            places
                .iter()
                .map(|&(x, heading)| Pose2::new(Vector2::new(x, 0.0), heading)),
        )
    }

    #[test]
    fn particles_in_one_tile_with_a_small_spread_have_converged() {
        let config = ConvergenceConfig::default();
        assert!(is_converged(
            &at(&[(0.0, 0.0), (0.1, 0.01)]),
            &tiles(),
            &config
        ));
        assert!(!is_converged(
            &at(&[(0.0, 0.0), (10.0, 0.0)]),
            &tiles(),
            &config
        ));
        assert!(!is_converged(
            &at(&[(0.0, 0.0), (0.1, 1.0)]),
            &tiles(),
            &config
        ));
    }

    #[test]
    fn without_limits_on_the_spread_only_the_number_of_tiles_matters() {
        let config = ConvergenceConfig {
            max_spread_m: f64::INFINITY,
            max_spread_rad: f64::INFINITY,
            ..ConvergenceConfig::default()
        };
        assert!(is_converged(
            &at(&[(-40.0, 0.0), (40.0, 3.0)]),
            &tiles(),
            &config
        ));
        assert!(!is_converged(
            &at(&[(40.0, 0.0), (60.0, 0.0)]),
            &tiles(),
            &config
        ));
        assert_eq!(
            occupied_tiles(&at(&[(40.0, 0.0), (60.0, 0.0)]), &tiles()),
            2
        );
    }

    #[test]
    fn particles_outside_all_tiles_have_not_converged() {
        let outside = at(&[(-900.0, 0.0), (-900.0, 0.0)]);
        assert_eq!(occupied_tiles(&outside, &tiles()), 0);
        assert!(!is_converged(
            &outside,
            &tiles(),
            &ConvergenceConfig::default()
        ));
    }
}
