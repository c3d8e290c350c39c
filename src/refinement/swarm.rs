//! Particle swarm optimization: candidates accelerate towards their own best position and towards the
//! best position of the swarm.
//!
//! ```text
//! v ← ω v + φ_p r_p (p_best − x) + φ_g r_g (g_best − x)        r_p, r_g ~ U(0, 1) per dimension
//! x ← x + v
//! ```
//!
//! Initial velocities are random; velocities and positions are clamped per dimension; angles and their
//! differences are wrapped. Kennedy and Eberhart, *Particle Swarm Optimization* (1995); Shi and Eberhart
//! (1998) for the inertia ω and its decrease. The objective is any function of n numbers.

use rand::{Rng, RngExt as _};
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::geometry::{Pose2, wrap_angle};
use crate::validation::{InvalidValue, Validate, in_range, not_negative, positive};

/// Parameters of the swarm.
///
/// Defaults: ω, φ_p, φ_g and the number of iterations of Fuzzy-PSO-MCL, which gives no size and no bounds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SwarmConfig {
    /// Number of candidates.
    #[default(20)]
    pub candidates: usize,
    /// Largest number of iterations.
    #[default(15)]
    pub iterations: usize,
    /// Inertia ω of the first iteration: share of its velocity that a candidate keeps (unitless).
    #[default(0.5)]
    pub inertia: f64,
    /// Inertia of the last iteration, linear in between (unitless).
    #[default(0.5)]
    pub final_inertia: f64,
    /// Cognitive acceleration φ_p, towards the best position of the candidate (unitless).
    #[default(1.5)]
    pub cognitive: f64,
    /// Social acceleration φ_g, towards the best position of the swarm (unitless).
    #[default(1.5)]
    pub social: f64,
    /// Largest velocity per iteration, as a share of the reach (unitless).
    #[default(0.3)]
    pub max_velocity: f64,
    /// Number of consecutive iterations without progress after which the search stops; 0 for no limit.
    pub patience: usize,
    /// Decrease of the best value that counts as progress.
    #[default(1e-5)]
    pub tolerance: f64,
}

impl Validate for SwarmConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("candidates", self.candidates, 1..=10_000)?;
        in_range("iterations", self.iterations, 1..=1000)?;
        not_negative("inertia", self.inertia)?;
        not_negative("final_inertia", self.final_inertia)?;
        not_negative("cognitive", self.cognitive)?;
        not_negative("social", self.social)?;
        positive("max_velocity", self.max_velocity)?;
        not_negative("tolerance", self.tolerance)
    }
}

/// A dimension of the search space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dimension {
    /// Initial value.
    pub start: f64,
    /// Standard deviation of the initial candidates around it.
    pub spread: f64,
    /// Largest distance of a candidate from it.
    pub reach: f64,
    /// Whether the coordinate is an angle [rad].
    pub is_circular: bool,
}

impl Dimension {
    /// x, y and heading around a pose, up to a reach of each, of which `spread` is the standard deviation of the initial
    /// candidates.
    pub fn around(pose: &Pose2, reach: [f64; 3], spread: f64) -> [Self; 3] {
        let t = pose.translation;
        let start = [t.x, t.y, pose.rotation.angle()];
        [0, 1, 2].map(|axis| Self {
            start: start[axis],
            spread: spread * reach[axis],
            reach: reach[axis],
            is_circular: axis == 2,
        })
    }

    /// `a - b`, wrapped for angles.
    fn difference(&self, a: f64, b: f64) -> f64 {
        if self.is_circular {
            wrap_angle(a - b)
        } else {
            a - b
        }
    }

    /// Nearest value within the reach.
    fn bounded(&self, value: f64) -> f64 {
        let offset = self
            .difference(value, self.start)
            .clamp(-self.reach, self.reach);
        let bounded = self.start + offset;
        if self.is_circular {
            wrap_angle(bounded)
        } else {
            bounded
        }
    }
}

struct Candidate<const N: usize> {
    position: [f64; N],
    velocity: [f64; N],
    best_position: [f64; N],
    best_value: f64,
}

/// Minimizes `objective`, which evaluates all positions of an iteration in one call; a value of NaN
/// counts as infinite. Returns the best position and its value.
///
/// The first candidate is at the start, so that the result is never worse than the start.
pub fn minimize<const N: usize, E>(
    dimensions: &[Dimension; N],
    config: &SwarmConfig,
    mut objective: impl FnMut(&[[f64; N]]) -> Result<Vec<f64>, E>,
    rng: &mut impl Rng,
) -> Result<([f64; N], f64), E> {
    let mut swarm = initial_swarm(dimensions, config, rng);
    let mut best = (swarm[0].position, f64::INFINITY);
    evaluate(&mut swarm, &mut best, &mut objective)?;
    let mut idle = 0;
    for iteration in 0..config.iterations {
        let progress = iteration as f64 / (config.iterations.max(2) - 1) as f64;
        let inertia = config.inertia + progress * (config.final_inertia - config.inertia);
        for candidate in &mut swarm {
            advance(candidate, &best.0, dimensions, inertia, config, rng);
        }
        let before = best.1;
        evaluate(&mut swarm, &mut best, &mut objective)?;
        idle = if before - best.1 > config.tolerance {
            0
        } else {
            idle + 1
        };
        if config.patience > 0 && idle >= config.patience {
            break;
        }
    }
    Ok(best)
}

/// Candidates around the start with random velocities; the first is at the start.
fn initial_swarm<const N: usize>(
    dimensions: &[Dimension; N],
    config: &SwarmConfig,
    rng: &mut impl Rng,
) -> Vec<Candidate<N>> {
    (0..config.candidates.max(1))
        .map(|number| {
            let sample = |dimension: &Dimension| {
                let deviate: f64 = rng.sample(StandardNormal);
                let offset = match number {
                    0 => 0.0,
                    _ => dimension.spread * deviate,
                };
                dimension.bounded(dimension.start + offset)
            };
            let position = dimensions.each_ref().map(sample);
            let velocity = |dimension: &Dimension| {
                config.max_velocity * dimension.reach * rng.random_range(-1.0..=1.0)
            };
            Candidate {
                position,
                velocity: dimensions.each_ref().map(velocity),
                best_position: position,
                best_value: f64::INFINITY,
            }
        })
        .collect()
}

/// Evaluates all candidates in one call and updates their best positions and that of the swarm.
fn evaluate<const N: usize, E>(
    swarm: &mut [Candidate<N>],
    best: &mut ([f64; N], f64),
    objective: &mut impl FnMut(&[[f64; N]]) -> Result<Vec<f64>, E>,
) -> Result<(), E> {
    let positions: Vec<[f64; N]> = swarm.iter().map(|c| c.position).collect();
    let values = objective(&positions)?;
    for (candidate, value) in swarm.iter_mut().zip(values) {
        // Comparisons with NaN are false.
        if value < candidate.best_value {
            candidate.best_value = value;
            candidate.best_position = candidate.position;
        }
        if value < best.1 {
            *best = (candidate.position, value);
        }
    }
    Ok(())
}

/// Moves a candidate.
fn advance<const N: usize>(
    candidate: &mut Candidate<N>,
    best: &[f64; N],
    dimensions: &[Dimension; N],
    inertia: f64,
    config: &SwarmConfig,
    rng: &mut impl Rng,
) {
    for (axis, dimension) in dimensions.iter().enumerate() {
        let here = candidate.position[axis];
        let to_own_best = dimension.difference(candidate.best_position[axis], here);
        let to_best = dimension.difference(best[axis], here);
        let largest = config.max_velocity * dimension.reach;
        let velocity = inertia * candidate.velocity[axis]
            + config.cognitive * rng.random::<f64>() * to_own_best
            + config.social * rng.random::<f64>() * to_best;
        candidate.velocity[axis] = velocity.clamp(-largest, largest);
        candidate.position[axis] = dimension.bounded(here + candidate.velocity[axis]);
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;
    use std::f64::consts::PI;

    use rand::{SeedableRng, rngs::StdRng};

    use super::*;

    fn dimension(start: f64) -> Dimension {
        Dimension {
            start,
            spread: 1.0,
            reach: 5.0,
            is_circular: false,
        }
    }

    fn many() -> SwarmConfig {
        SwarmConfig {
            candidates: 40,
            iterations: 200,
            inertia: 0.7,
            final_inertia: 0.4,
            ..SwarmConfig::default()
        }
    }

    fn run<const N: usize>(
        dimensions: &[Dimension; N],
        config: &SwarmConfig,
        seed: u64,
        function: impl Fn(&[f64]) -> f64,
    ) -> ([f64; N], f64) {
        let batch = |positions: &[[f64; N]]| -> Result<Vec<f64>, Infallible> {
            Ok(positions
                .iter()
                .map(|position| function(position))
                .collect())
        };
        let Ok(minimum) = minimize(dimensions, config, batch, &mut StdRng::seed_from_u64(seed));
        minimum
    }

    fn sphere(x: &[f64]) -> f64 {
        x.iter().map(|x| (x - 1.0).powi(2)).sum()
    }

    #[test]
    fn the_minimum_of_standard_functions_is_found() {
        let rosenbrock = |x: &[f64]| 100.0 * (x[1] - x[0] * x[0]).powi(2) + (1.0 - x[0]).powi(2);
        let rastrigin = |x: &[f64]| {
            x.iter()
                .map(|x| (x - 1.0).powi(2) + 10.0 * (1.0 - (2.0 * PI * (x - 1.0)).cos()))
                .sum::<f64>()
        };
        for seed in 0..5 {
            let start = [dimension(-1.0), dimension(2.5)];
            for (name, (position, _), tolerance) in [
                ("sphere", run(&start, &many(), seed, sphere), 1e-4),
                ("rosenbrock", run(&start, &many(), seed, rosenbrock), 0.05),
                ("rastrigin", run(&start, &many(), seed, rastrigin), 1e-3),
            ] {
                let error = position.iter().map(|x| (x - 1.0).abs()).fold(0.0, f64::max);
                assert!(error < tolerance, "{name}, seed {seed}: {position:?}");
            }
        }
    }

    #[test]
    fn the_result_is_never_worse_than_the_start_or_that_of_fewer_iterations() {
        for seed in 0..20 {
            let start = [dimension(1.0), dimension(1.0 + 1e-6)];
            let mut previous = sphere(&[1.0, 1.0 + 1e-6]);
            for iterations in 1..=15 {
                let config = SwarmConfig {
                    candidates: 3,
                    iterations,
                    ..SwarmConfig::default()
                };
                let (position, value) = run(&start, &config, seed, sphere);
                assert!(value <= previous);
                assert_eq!(value, sphere(&position));
                previous = value;
            }
        }
    }

    #[test]
    fn angles_are_wrapped_and_stay_within_their_reach() {
        let heading = Dimension {
            start: PI - 0.05,
            spread: 0.1,
            reach: 0.3,
            is_circular: true,
        };
        let goal = -PI + 0.1;
        let distance = |x: &[f64]| wrap_angle(x[0] - goal).abs();
        let mut seen = Vec::new();
        let batch = |positions: &[[f64; 1]]| -> Result<Vec<f64>, Infallible> {
            seen.extend(positions.iter().map(|p| p[0]));
            Ok(positions.iter().map(|p| distance(p)).collect())
        };
        let config = SwarmConfig {
            iterations: 60,
            ..SwarmConfig::default()
        };
        let Ok(minimum) = minimize(&[heading], &config, batch, &mut StdRng::seed_from_u64(1));
        assert!(minimum.1 < 1e-4, "{minimum:?}");
        assert!(seen.iter().all(|x| (-PI..PI).contains(x)));
        assert!(
            seen.iter()
                .all(|x| wrap_angle(x - heading.start).abs() <= heading.reach + 1e-12)
        );
    }

    #[test]
    fn candidates_stay_within_their_reach() {
        let narrow = Dimension {
            reach: 0.5,
            ..dimension(-1.0)
        };
        let (position, _) = run(&[narrow, dimension(0.0)], &many(), 1, sphere);
        assert!((position[0] + 0.5).abs() < 1e-9, "{position:?}");
    }

    #[test]
    fn every_iteration_is_one_call_and_patience_stops_early() {
        let mut calls = 0;
        let flat = |positions: &[[f64; 1]]| -> Result<Vec<f64>, Infallible> {
            calls += 1;
            assert_eq!(positions.len(), SwarmConfig::default().candidates);
            Ok(vec![1.0; positions.len()])
        };
        let config = SwarmConfig {
            patience: 3,
            ..SwarmConfig::default()
        };
        let mut rng = StdRng::seed_from_u64(1);
        let Ok(_) = minimize(&[dimension(0.0)], &config, flat, &mut rng);
        assert_eq!(calls, 4);
    }

    #[test]
    fn the_inertia_decreases_linearly_from_the_first_iteration_to_the_last() {
        // Without acceleration, a velocity is multiplied by the inertia of each iteration.
        let config = SwarmConfig {
            candidates: 8,
            iterations: 4,
            inertia: 0.9,
            final_inertia: 0.3,
            cognitive: 0.0,
            social: 0.0,
            ..SwarmConfig::default()
        };
        let mut positions: Vec<Vec<f64>> = Vec::new();
        let batch = |all: &[[f64; 1]]| -> Result<Vec<f64>, Infallible> {
            positions.push(all.iter().map(|position| position[0]).collect());
            Ok(vec![1.0; all.len()])
        };
        let wide = Dimension {
            reach: 1e3,
            ..dimension(2.0)
        };
        let Ok(_) = minimize(&[wide], &config, batch, &mut StdRng::seed_from_u64(3));
        assert_eq!(positions.len(), 5);
        let path_of =
            |candidate: usize| -> Vec<f64> { positions.iter().map(|it| it[candidate]).collect() };
        for path in (0..8).map(path_of) {
            let moved = |iteration: usize| path[iteration + 1] - path[iteration];
            // At first up to 0.3 of the reach.
            let first = moved(0) / 0.9;
            assert!(first.abs() <= 300.0 && first.abs() > 0.1, "{first}");
            let mut expected = first;
            for (iteration, inertia) in [0.9, 0.7, 0.5, 0.3].into_iter().enumerate() {
                expected *= inertia;
                assert!((moved(iteration) - expected).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn initial_candidates_have_the_spread_of_their_dimension_and_uniform_velocities() {
        let config = SwarmConfig {
            candidates: 10_000,
            ..SwarmConfig::default()
        };
        let dimensions = [Dimension {
            start: 3.0,
            spread: 0.5,
            reach: 100.0,
            is_circular: false,
        }];
        let swarm = initial_swarm(&dimensions, &config, &mut StdRng::seed_from_u64(4));
        assert_eq!(swarm[0].position, [3.0]);
        let n = swarm.len() as f64;
        let mean = |value: &dyn Fn(&Candidate<1>) -> f64| swarm.iter().map(value).sum::<f64>() / n;
        // Four standard errors, of a normal distribution and of a uniform one up to 0.3 of the reach.
        assert!((mean(&|c| c.position[0] - 3.0)).abs() < 4.0 * 0.5 / n.sqrt());
        let variance = mean(&|c| (c.position[0] - 3.0).powi(2));
        assert!((variance - 0.25).abs() < 4.0 * 0.25 * (2.0 / n).sqrt());
        assert!(swarm.iter().all(|c| c.velocity[0].abs() <= 30.0));
        assert!((mean(&|c| c.velocity[0])).abs() < 4.0 * (300.0 / n).sqrt());
        let variance = mean(&|c| c.velocity[0].powi(2));
        let error = 900.0 * (1.0_f64 / 5.0 - 1.0 / 9.0).sqrt() / n.sqrt();
        assert!((variance - 300.0).abs() < 4.0 * error, "{variance}");
    }

    #[test]
    fn both_accelerations_are_uniform_up_to_their_factors_and_velocities_are_limited() {
        let config = SwarmConfig {
            cognitive: 1.6,
            social: 0.8,
            max_velocity: 0.5,
            ..SwarmConfig::default()
        };
        let dimensions = [Dimension {
            start: 0.0,
            spread: 1.0,
            reach: 100.0,
            is_circular: false,
        }];
        let mut rng = StdRng::seed_from_u64(5);
        let mut moved = |own_best: f64, best: f64| {
            let mut candidate = Candidate {
                position: [1.0],
                velocity: [2.0],
                best_position: [own_best],
                best_value: 0.0,
            };
            advance(&mut candidate, &[best], &dimensions, 0.5, &config, &mut rng);
            assert_eq!(candidate.position, [1.0 + candidate.velocity[0]]);
            candidate.velocity[0]
        };
        let count = 10_000;
        // Mean and variance of half of the velocity and of the uniform shares of both ways, of -10 and 4 m.
        let velocities: Vec<f64> = (0..count).map(|_| moved(-9.0, 5.0)).collect();
        let n = f64::from(count);
        let mean = velocities.iter().sum::<f64>() / n;
        let variance = velocities.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
        let expected = (16.0_f64.powi(2) + 3.2_f64.powi(2)) / 12.0;
        assert!((mean - (1.0 - 8.0 + 1.6)).abs() < 4.0 * (expected / n).sqrt());
        assert!((variance / expected - 1.0).abs() < 4.0 * (2.0 / n).sqrt());
        // A share of the reach of 100 m.
        let far: Vec<f64> = (0..100).map(|_| moved(1000.0, 1000.0)).collect();
        assert!(far.iter().all(|velocity| *velocity <= 50.0));
        assert!(far.contains(&50.0));
    }

    #[test]
    fn nan_is_never_the_minimum() {
        let half = |x: &[f64]| if x[0] > 0.0 { f64::NAN } else { -x[0] };
        let minimum = run(&[dimension(-2.0)], &many(), 1, half);
        assert!((0.0..1e-2).contains(&minimum.1), "{minimum:?}");
    }

    #[test]
    fn the_same_seed_gives_the_same_result() {
        let start = [dimension(0.0), dimension(0.0)];
        let config = SwarmConfig::default();
        assert_eq!(
            run(&start, &config, 5, sphere),
            run(&start, &config, 5, sphere)
        );
        assert_ne!(
            run(&start, &config, 5, sphere),
            run(&start, &config, 6, sphere)
        );
    }
}
