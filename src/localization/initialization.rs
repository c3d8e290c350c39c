//! Initial particles: around a given pose, or in the places whose panoramas resemble the scan.
//!
//! ```text
//! pose known   x₀ + U(±5 m), y₀ + U(±5 m), θ₀ + U(±30°)
//! else         a cell of the road or of the map, half of the particles with probability ∝ exp(−cost / scale) and
//!              half in the best cell of each place; uniform in the cell, its best heading + N(0, yaw_sigma²)
//! ```
//!
//! Chen et al., *Range Image-based LiDAR Localization for Autonomous Vehicles*, ICRA 2021, for the
//! first.

use nalgebra::{Point2, Vector2};
use rand::{Rng, RngExt as _};
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::particles::Particle;
use super::places::{PlacesConfig, best_of_each};
use super::resampling::systematic;
use crate::geometry::Pose2;
use crate::lidar::RangeImage;
use crate::map::{PanoramaIndex, PanoramaSeed, SensorAttitude};
use crate::rendering::RenderError;
use crate::validation::{InvalidValue, Validate, not_negative};

/// Shape of the initial distribution.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum StartDistribution {
    /// Uniform within the bound on either side.
    Uniform,
    /// Normal, with the bound as standard deviation.
    Gaussian,
}

/// Spread of the particles around a given pose.
///
/// Defaults: the values of range-mcl: uniform, ±5 m, ±30 degrees.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct StartSpread {
    /// Distribution of each coordinate.
    #[default(StartDistribution::Uniform)]
    pub distribution: StartDistribution,
    /// Bound of x and y [m].
    #[default(5.0)]
    pub position_m: f64,
    /// Bound of the heading [rad].
    #[default(30.0_f64.to_radians())]
    pub heading_rad: f64,
}

impl Validate for StartSpread {
    fn validate(&self) -> Result<(), InvalidValue> {
        not_negative("position_m", self.position_m)?;
        not_negative("heading_rad", self.heading_rad)
    }
}

/// Samples particles around a pose, along the axes of the map; `level_m` is the height of the ground [m],
/// if known.
pub fn around(
    pose: &Pose2,
    level_m: Option<f64>,
    count: usize,
    spread: &StartSpread,
    rng: &mut impl Rng,
) -> Vec<Particle> {
    let mut sample = |bound: f64| -> f64 {
        bound
            * match spread.distribution {
                StartDistribution::Uniform => rng.random_range(-1.0..=1.0),
                StartDistribution::Gaussian => rng.sample(StandardNormal),
            }
    };
    let mut particle = |_| {
        let offset = Vector2::new(sample(spread.position_m), sample(spread.position_m));
        let heading_rad = pose.rotation.angle() + sample(spread.heading_rad);
        Particle::new(
            Pose2::new(pose.translation.vector + offset, heading_rad),
            level_m,
        )
    };
    (0..count).map(&mut particle).collect()
}

/// Samples particles in the cells whose panoramas resemble the scan: half of them in proportion to the likelihoods of
/// the cells, and half equally in the best cells of the places. Empty without cells.
pub fn from_panoramas(
    index: &PanoramaIndex,
    scan: &RangeImage,
    attitude: &SensorAttitude,
    count: usize,
    places: &PlacesConfig,
    rng: &mut impl Rng,
) -> Result<Vec<Particle>, RenderError> {
    let seeds = index.search(scan, attitude)?;
    let Some(first) = seeds.first() else {
        return Ok(Vec::new());
    };
    let mut weights: Vec<f64> = seeds
        .iter()
        .map(|seed| ((first.cost_m - seed.cost_m) / index.config.scale_m).exp())
        .collect();
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|weight| *weight *= 0.5 / sum);
    let best = best_of_places(&seeds, places);
    for &place in &best {
        weights[place] += 0.5 / best.len() as f64;
    }
    let half_column_rad = std::f64::consts::PI / index.model.width as f64;
    let chosen = systematic(&weights, count, rng);
    let sample = |number: usize| {
        let seed = &seeds[number];
        let position = uniform_in_cell(seed.center, index.config.cell_m, rng);
        let turn_rad = index.config.yaw_sigma_deg.to_radians()
            * rng.sample::<f64, _>(StandardNormal)
            + rng.random_range(-half_column_rad..=half_column_rad);
        let map_from_lidar = Pose2::new(position, seed.heading_rad + turn_rad);
        Particle::new(map_from_lidar, Some(seed.level_m))
    };
    Ok(chosen.into_iter().map(sample).collect())
}

/// The cells of least cost, one of each place.
fn best_of_places(seeds: &[PanoramaSeed], config: &PlacesConfig) -> Vec<usize> {
    let particle = |seed: &PanoramaSeed| {
        let pose = Pose2::new(seed.center.coords, seed.heading_rad);
        Particle::new(pose, Some(seed.level_m))
    };
    let particles: Vec<Particle> = seeds.iter().map(particle).collect();
    let costs_m: Vec<_> = seeds.iter().map(|seed| Some(seed.cost_m)).collect();
    best_of_each(&particles, &costs_m, config.most, config.radius_m)
}

/// Samples a position in a square cell [m].
fn uniform_in_cell(center: Point2<f64>, cell_m: f64, rng: &mut impl Rng) -> Vector2<f64> {
    let half_m = 0.5 * cell_m;
    let mut offset = || rng.random_range(-half_m..=half_m);
    center.coords + Vector2::new(offset(), offset())
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use rand::{SeedableRng, rngs::StdRng};

    use super::*;
    use crate::geometry::wrap_angle;
    use crate::lidar::LidarModel;
    use crate::map::world_for_tests::TestWorld;
    use crate::map::{PanoramaConfig, PanoramaRequest, SearchRegion};

    #[test]
    fn a_uniform_start_has_the_variance_of_its_bounds_and_stays_within_them() {
        let pose = Pose2::new(Vector2::new(10.0, -3.0), 3.0);
        let mut rng = StdRng::seed_from_u64(1);
        let particles = around(&pose, None, 20_000, &StartSpread::default(), &mut rng);
        let bound = 30.0_f64.to_radians();
        let poses = || particles.iter().map(|particle| particle.map_from_lidar);
        let turns: Vec<f64> = poses()
            .map(|pose| wrap_angle(pose.rotation.angle() - 3.0))
            .collect();
        let x: Vec<f64> = poses().map(|pose| pose.translation.x - 10.0).collect();
        for (values, bound) in [(turns, bound), (x, 5.0)] {
            assert!(values.iter().all(|v| v.abs() <= bound + 1e-12));
            let n = values.len() as f64;
            let variance = values.iter().map(|v| v * v).sum::<f64>() / n;
            // Variance of the uniform distribution; its fourth moment gives the standard error.
            let error = bound.powi(2) * (1.0_f64 / 5.0 - 1.0 / 9.0).sqrt() / n.sqrt();
            assert_relative_eq!(variance, bound * bound / 3.0, epsilon = 4.0 * error);
        }
    }

    #[test]
    fn a_gaussian_start_has_its_standard_deviation() {
        let spread = StartSpread {
            distribution: StartDistribution::Gaussian,
            position_m: 0.5,
            heading_rad: 0.1,
        };
        let mut rng = StdRng::seed_from_u64(2);
        let particles = around(&Pose2::identity(), None, 20_000, &spread, &mut rng);
        let n = particles.len() as f64;
        let squares = particles
            .iter()
            .map(|particle| particle.map_from_lidar.translation.y.powi(2));
        let sigma = (squares.sum::<f64>() / n).sqrt();
        assert_relative_eq!(sigma, 0.5, epsilon = 4.0 * 0.5 / (2.0 * n).sqrt());
    }

    #[test]
    fn positions_in_a_cell_are_uniform() {
        let mut rng = StdRng::seed_from_u64(3);
        let count = 20_000;
        let offsets: Vec<Vector2<f64>> = (0..count)
            .map(|_| uniform_in_cell(Point2::new(4.0, -7.0), 3.0, &mut rng))
            .map(|position| position - Vector2::new(4.0, -7.0))
            .collect();
        let n = f64::from(count);
        let mean = offsets.iter().sum::<Vector2<f64>>() / n;
        for axis in 0..2 {
            assert!(offsets.iter().all(|offset| offset[axis].abs() <= 1.5));
            // Of a uniform distribution from -1.5 to 1.5 m: four standard errors.
            let squares = offsets.iter().map(|offset| offset[axis].powi(2));
            assert_relative_eq!(mean[axis], 0.0, epsilon = 4.0 * (0.75 / n).sqrt());
            let error = 1.5_f64.powi(2) * (1.0_f64 / 5.0 - 1.0 / 9.0).sqrt() / n.sqrt();
            assert_relative_eq!(squares.sum::<f64>() / n, 0.75, epsilon = 4.0 * error);
        }
        let products = offsets.iter().map(|offset| offset.x * offset.y);
        assert_relative_eq!(
            products.sum::<f64>() / n,
            0.0,
            epsilon = 4.0 * 0.75 / n.sqrt()
        );
    }

    #[test]
    fn half_of_the_particles_are_equally_in_the_best_cells_and_all_head_as_their_panoramas() {
        let world = TestWorld::street();
        let request = PanoramaRequest {
            region: SearchRegion::Road,
            lidar: LidarModel::default(),
            sensor_height_m: 1.73,
            config: PanoramaConfig {
                yaw_sigma_deg: 0.0,
                ..PanoramaConfig::default()
            },
        };
        let index = world.map().panoramas(&request).unwrap();
        let scan = world.scan(&world.pose_at(33.0, 0.4, 0.2));
        let attitude = SensorAttitude::default();
        let places = PlacesConfig {
            most: 4,
            ..PlacesConfig::default()
        };
        let mut rng = StdRng::seed_from_u64(1);
        let particles = from_panoramas(&index, &scan, &attitude, 1000, &places, &mut rng).unwrap();
        let seeds = index.search(&scan, &attitude).unwrap();
        let half_column_rad = std::f64::consts::PI / index.model.width as f64;
        let is_of = |seed: &PanoramaSeed, particle: &Particle| {
            let pose = &particle.map_from_lidar;
            let off_m = (pose.translation.vector - seed.center.coords).amax();
            let turn_rad = wrap_angle(pose.rotation.angle() - seed.heading_rad).abs();
            off_m <= 0.5 * index.config.cell_m + 1e-9 && turn_rad <= half_column_rad + 1e-9
        };
        let is_of_any = |particle: &Particle| seeds.iter().any(|seed| is_of(seed, particle));
        assert!(particles.iter().all(is_of_any));
        let best = best_of_places(&seeds, &places);
        assert_eq!((best.len(), best[0]), (4, 0));
        for place in best {
            let of_place = particles.iter().filter(|it| is_of(&seeds[place], it));
            // An eighth of them, up to rounding.
            let count = of_place.count();
            assert!(count >= 124, "{count}");
        }
    }

    #[test]
    fn panorama_samples_lie_around_the_truth() {
        let world = TestWorld::street();
        let truth = world.pose_at(33.0, 0.4, 0.2);
        let mut rng = StdRng::seed_from_u64(1);
        let request = PanoramaRequest {
            region: SearchRegion::Road,
            lidar: LidarModel::default(),
            sensor_height_m: 1.73,
            config: PanoramaConfig::default(),
        };
        let index = world.map().panoramas(&request).unwrap();
        let scan = world.scan(&truth);
        let particles = from_panoramas(
            &index,
            &scan,
            &SensorAttitude::default(),
            1000,
            &PlacesConfig::default(),
            &mut rng,
        )
        .unwrap();
        let near = particles
            .iter()
            .map(|particle| particle.map_from_lidar.translation.vector)
            .filter(|place| (place - truth.translation.vector).norm() < 1.5)
            .count();
        assert!(near > 300, "{near} of {}", particles.len());
    }
}
