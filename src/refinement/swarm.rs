//! Particle swarm optimization: candidates that remember their best place and look towards the
//! best place of all.
//!
//! ```text
//! v ← ω v + φ_p r_p (p_best − x) + φ_g r_g (g_best − x)        r_p, r_g ~ U(0, 1) per dimension
//! x ← x + v
//! ```
//!
//! Velocities begin at random and are clamped per dimension; positions stay within bounds; on a
//! circle positions and differences are wrapped. Kennedy and Eberhart, *Particle Swarm
//! Optimization* (1995); Shi and Eberhart (1998) for the inertia ω and its decrease. The swarm
//! knows nothing of poses: it minimizes any function of n numbers.

use rand::{Rng, RngExt as _};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::geometry::wrap_angle;
use crate::validation::{InvalidValue, Validate, at_least_one, not_negative, positive};

/// How the swarm moves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SwarmConfig {
    /// Number of candidates.
    pub candidates: usize,
    /// Iterations, at most.
    pub iterations: usize,
    /// Share of its velocity that a candidate keeps, ω (unitless).
    pub inertia: f64,
    /// ω of the last iteration, reached linearly; the same as `inertia` for a constant one.
    pub final_inertia: f64,
    /// Pull towards a candidate's own best place, φ_p (unitless).
    pub cognitive: f64,
    /// Pull towards the best place of all, φ_g (unitless).
    pub social: f64,
    /// Velocities never exceed this share of the bounds' half width per iteration (unitless).
    pub max_velocity: f64,
    /// Stop after so many iterations in a row without progress; 0 never stops early.
    pub patience: usize,
    /// Progress is a decrease of the best value by more than this.
    pub tolerance: f64,
}

impl Default for SwarmConfig {
    /// ω, φ_p, φ_g and the iterations of Fuzzy-PSO-MCL; it gives no size and no bounds.
    fn default() -> Self {
        Self {
            candidates: 20,
            iterations: 15,
            inertia: 0.5,
            final_inertia: 0.5,
            cognitive: 1.5,
            social: 1.5,
            max_velocity: 0.3,
            patience: 0,
            tolerance: 1e-5,
        }
    }
}

impl Validate for SwarmConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        at_least_one("candidates", self.candidates)?;
        at_least_one("iterations", self.iterations)?;
        not_negative("inertia", self.inertia)?;
        not_negative("final_inertia", self.final_inertia)?;
        not_negative("cognitive", self.cognitive)?;
        not_negative("social", self.social)?;
        positive("max_velocity", self.max_velocity)?;
        not_negative("tolerance", self.tolerance)
    }
}

/// One coordinate of the search.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dimension {
    /// Where the search starts.
    pub start: f64,
    /// Standard deviation of the candidates around the start.
    pub spread: f64,
    /// How far from the start a candidate may go.
    pub reach: f64,
    /// Whether the coordinate is an angle [rad], on the circle.
    pub is_circular: bool,
}

impl Dimension {
    /// From `b` to `a`, the short way round.
    fn difference(&self, a: f64, b: f64) -> f64 {
        if self.is_circular {
            wrap_angle(a - b)
        } else {
            a - b
        }
    }

    /// The nearest value within the bounds.
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

/// The best place that was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Minimum {
    /// One value per dimension.
    pub position: Vec<f64>,
    /// The objective there.
    pub value: f64,
    /// The best value after the start and after every iteration, never ascending.
    pub history: Vec<f64>,
    /// How often the objective was evaluated.
    pub evaluations: usize,
}

struct Candidate {
    position: Vec<f64>,
    velocity: Vec<f64>,
    best_position: Vec<f64>,
    best_value: f64,
}

/// Minimizes `objective`, which is given all positions of an iteration at once and returns one
/// value for each; a value that is not a number counts as infinite.
///
/// The first candidate begins at the start itself, so that the result is never worse than that.
pub fn minimize<E>(
    dimensions: &[Dimension],
    config: &SwarmConfig,
    mut objective: impl FnMut(&[Vec<f64>]) -> Result<Vec<f64>, E>,
    rng: &mut impl Rng,
) -> Result<Minimum, E> {
    let mut swarm = spread_out(dimensions, config, rng);
    let mut best = evaluate(&mut swarm, None, &mut objective)?;
    let mut idle = 0;
    for iteration in 0..config.iterations {
        let progress = iteration as f64 / (config.iterations.max(2) - 1) as f64;
        let inertia = config.inertia + progress * (config.final_inertia - config.inertia);
        for candidate in &mut swarm {
            fly(candidate, &best.position, dimensions, inertia, config, rng);
        }
        let before = best.value;
        best = evaluate(&mut swarm, Some(best), &mut objective)?;
        idle = if before - best.value > config.tolerance {
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

/// Candidates around the start, with random velocities; the first stands at the start.
fn spread_out(
    dimensions: &[Dimension],
    config: &SwarmConfig,
    rng: &mut impl Rng,
) -> Vec<Candidate> {
    (0..config.candidates.max(1))
        .map(|number| {
            let mut place = |dimension: &Dimension| {
                let deviate: f64 = StandardNormal.sample(rng);
                let offset = if number == 0 {
                    0.0
                } else {
                    dimension.spread * deviate
                };
                dimension.bounded(dimension.start + offset)
            };
            let position: Vec<f64> = dimensions.iter().map(&mut place).collect();
            let velocity = dimensions
                .iter()
                .map(|dimension| {
                    let most = config.max_velocity * dimension.reach;
                    most * rng.random_range(-1.0..=1.0)
                })
                .collect();
            Candidate {
                best_position: position.clone(),
                best_value: f64::INFINITY,
                position,
                velocity,
            }
        })
        .collect()
}

/// Evaluates all candidates in one call and brings every memory up to date.
fn evaluate<E>(
    swarm: &mut [Candidate],
    best: Option<Minimum>,
    objective: &mut impl FnMut(&[Vec<f64>]) -> Result<Vec<f64>, E>,
) -> Result<Minimum, E> {
    let positions: Vec<Vec<f64>> = swarm.iter().map(|c| c.position.clone()).collect();
    let values = objective(&positions)?;
    let mut best = best.unwrap_or_else(|| Minimum {
        position: positions[0].clone(),
        value: f64::INFINITY,
        history: Vec::new(),
        evaluations: 0,
    });
    best.evaluations += positions.len();
    for (candidate, value) in swarm.iter_mut().zip(values) {
        // A comparison with what is not a number is false.
        if value < candidate.best_value {
            candidate.best_value = value;
            candidate.best_position.clone_from(&candidate.position);
        }
        if value < best.value {
            best.value = value;
            best.position.clone_from(&candidate.position);
        }
    }
    best.history.push(best.value);
    Ok(best)
}

/// One step of one candidate.
fn fly(
    candidate: &mut Candidate,
    best: &[f64],
    dimensions: &[Dimension],
    inertia: f64,
    config: &SwarmConfig,
    rng: &mut impl Rng,
) {
    for (axis, dimension) in dimensions.iter().enumerate() {
        let here = candidate.position[axis];
        let own_pull = dimension.difference(candidate.best_position[axis], here);
        let common_pull = dimension.difference(best[axis], here);
        let most = config.max_velocity * dimension.reach;
        let velocity = inertia * candidate.velocity[axis]
            + config.cognitive * rng.random::<f64>() * own_pull
            + config.social * rng.random::<f64>() * common_pull;
        candidate.velocity[axis] = velocity.clamp(-most, most);
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

    fn run(
        dimensions: &[Dimension],
        config: &SwarmConfig,
        seed: u64,
        function: impl Fn(&[f64]) -> f64,
    ) -> Minimum {
        let batch = |positions: &[Vec<f64>]| -> Result<Vec<f64>, Infallible> {
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
            for (name, minimum, tolerance) in [
                ("sphere", run(&start, &many(), seed, sphere), 1e-4),
                ("rosenbrock", run(&start, &many(), seed, rosenbrock), 0.05),
                ("rastrigin", run(&start, &many(), seed, rastrigin), 1e-3),
            ] {
                let error = minimum
                    .position
                    .iter()
                    .map(|x| (x - 1.0).abs())
                    .fold(0.0, f64::max);
                assert!(
                    error < tolerance,
                    "{name}, seed {seed}: {:?}",
                    minimum.position
                );
            }
        }
    }

    #[test]
    fn the_result_is_never_worse_than_the_start_and_the_history_never_ascends() {
        for seed in 0..20 {
            let start = [dimension(1.0), dimension(1.0 + 1e-6)];
            let config = SwarmConfig {
                candidates: 3,
                ..SwarmConfig::default()
            };
            let minimum = run(&start, &config, seed, sphere);
            assert!(minimum.value <= sphere(&[1.0, 1.0 + 1e-6]));
            assert!(minimum.history.is_sorted_by(|a, b| a >= b));
            assert_eq!(minimum.value, sphere(&minimum.position));
        }
    }

    #[test]
    fn on_a_circle_the_swarm_goes_the_short_way_round() {
        let heading = Dimension {
            start: PI - 0.05,
            spread: 0.1,
            reach: 0.3,
            is_circular: true,
        };
        let goal = -PI + 0.1;
        let distance = |x: &[f64]| wrap_angle(x[0] - goal).abs();
        let mut seen = Vec::new();
        let batch = |positions: &[Vec<f64>]| -> Result<Vec<f64>, Infallible> {
            seen.extend(positions.iter().map(|p| p[0]));
            Ok(positions.iter().map(|p| distance(p)).collect())
        };
        let config = SwarmConfig {
            iterations: 60,
            ..SwarmConfig::default()
        };
        let Ok(minimum) = minimize(&[heading], &config, batch, &mut StdRng::seed_from_u64(1));
        assert!(minimum.value < 1e-4, "{minimum:?}");
        assert!(seen.iter().all(|x| (-PI..PI).contains(x)));
        assert!(
            seen.iter()
                .all(|x| wrap_angle(x - heading.start).abs() <= heading.reach + 1e-12)
        );
    }

    #[test]
    fn candidates_stay_within_their_bounds() {
        let narrow = Dimension {
            reach: 0.5,
            ..dimension(-1.0)
        };
        let minimum = run(&[narrow, dimension(0.0)], &many(), 1, sphere);
        assert!(
            (minimum.position[0] + 0.5).abs() < 1e-9,
            "{:?}",
            minimum.position
        );
    }

    #[test]
    fn every_iteration_is_one_call_and_patience_ends_it_early() {
        let mut calls = 0;
        let flat = |positions: &[Vec<f64>]| -> Result<Vec<f64>, Infallible> {
            calls += 1;
            Ok(vec![1.0; positions.len()])
        };
        let config = SwarmConfig {
            patience: 3,
            ..SwarmConfig::default()
        };
        let Ok(minimum) = minimize(
            &[dimension(0.0)],
            &config,
            flat,
            &mut StdRng::seed_from_u64(1),
        );
        assert_eq!(calls, 4);
        assert_eq!(minimum.evaluations, 4 * config.candidates);
    }

    #[test]
    fn values_that_are_no_numbers_are_never_best() {
        let half = |x: &[f64]| if x[0] > 0.0 { f64::NAN } else { -x[0] };
        let minimum = run(&[dimension(-2.0)], &many(), 1, half);
        assert!(minimum.value >= 0.0 && minimum.value < 1e-2, "{minimum:?}");
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
