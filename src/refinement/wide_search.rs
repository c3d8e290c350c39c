//! Search of a pose that may be metres and tens of degrees from its estimate.
//!
//! A swarm minimizes the distances between the returns and the upright surfaces of the map, seen from above, which
//! fall evenly towards the right pose where differences of ranges do not:
//!
//! ```text
//! f(x, y, θ) = mean over the returns of min(d(R(θ) p + (x, y)), limit)       d: distance to the nearest surface [m]
//! ```
//!
//! Several swarms end in different minima; Gauss-Newton, first with a wide kernel, and the objective of the frame
//! choose among them.

use nalgebra::Vector2;
use rand::{Rng, RngExt as _};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::objective::FrameObjective;
use super::swarm::{Dimension, SwarmConfig, minimize};
use super::upright::{UprightSurfaces, is_upright_height};
use crate::geometry::{Pose2, Pose3, Rigid3f, pose2_from_pose3};
use crate::lidar::Beam;
use crate::random::stream;
use crate::registration::{RegistrationConfig, approach_widely, registered_pose};
use crate::rendering::RenderError;
use crate::validation::{InvalidValue, Validate, in_range, nested, positive};

/// Settings of the wide search.
///
/// Defaults: our own values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct WideSearchConfig {
    /// Swarms, each of which may end in another minimum.
    #[default(6)]
    pub swarms: usize,
    /// Each swarm.
    #[default(SwarmConfig {
        candidates: 100,
        iterations: 25,
        inertia: 0.8,
        final_inertia: 0.3,
        ..SwarmConfig::default()
    })]
    pub swarm: SwarmConfig,
    /// Number of returns that are compared.
    #[default(250)]
    pub returns: usize,
    /// Largest range of a return that is compared [m].
    #[default(40.0)]
    pub range_m: f64,
    /// Distance from which on a return is as good as any other [m].
    #[default(1.5)]
    pub limit_m: f32,
    /// Scale of the robust kernel with which Gauss-Newton begins [m].
    #[default(0.5)]
    pub kernel_m: f64,
}

impl Validate for WideSearchConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("swarms", self.swarms, 1..=1000)?;
        nested("swarm", &self.swarm)?;
        in_range("returns", self.returns, 1..=100_000)?;
        in_range("range_m", self.range_m, 1.0..=200.0)?;
        in_range("limit_m", self.limit_m, 0.1..=50.0)?;
        positive("kernel_m", self.kernel_m)
    }
}

/// Finds the pose with the smallest cost within `reach` (x, y [m], heading [rad]) of the estimate, and that cost;
/// `None` where the map has no ground or the scan no upright surfaces.
pub fn search(
    objective: &FrameObjective<'_>,
    surfaces: &UprightSurfaces,
    estimate: &Pose2,
    reach: [f64; 3],
    gauss_newton: &RegistrationConfig,
    config: &WideSearchConfig,
    rng: &mut impl Rng,
) -> Result<Option<(Pose3, f64)>, RenderError> {
    let center = estimate.translation.vector;
    let reach_m = reach[0].max(reach[1]);
    let Some(patch) = objective.patch_within(estimate, reach_m)? else {
        return Ok(None);
    };
    let returns = upright_returns(objective, config);
    if returns.is_empty() {
        return Ok(None);
    }
    let radius_m = config.range_m + reach_m;
    let distances = surfaces.distances(center, &patch, radius_m, config.limit_m);
    let mean_distance_m = |&[x, y, heading_rad]: &[f64; 3]| {
        let (sin, cos) = heading_rad.sin_cos();
        let sum: f64 = (returns.iter())
            .map(|p| f64::from(distances.at(x + cos * p.x - sin * p.y, y + sin * p.x + cos * p.y)))
            .sum();
        sum / returns.len() as f64
    };
    let dimensions = Dimension::around(estimate, reach, 0.6);
    // Each with a stream of its own, for the same result with any number of threads.
    let seeds: Vec<u64> = (0..config.swarms).map(|_| rng.random()).collect();
    let mut minima = (seeds.into_par_iter())
        .map(|seed| {
            let batch = |positions: &[[f64; 3]]| {
                Ok::<_, RenderError>(positions.iter().map(mean_distance_m).collect())
            };
            minimize(&dimensions, &config.swarm, batch, &mut stream(seed, 0))
        })
        .collect::<Result<Vec<_>, _>>()?;
    /// Minima that Gauss-Newton finishes.
    const FINISHED: usize = 4;
    minima.sort_by(|a, b| a.1.total_cmp(&b.1));
    let mut best: Option<(Pose3, f64)> = None;
    for pose in distinct(&minima, FINISHED) {
        let Some(found) = finish(objective, &pose, reach_m, gauss_newton, config)? else {
            continue;
        };
        if best.is_none_or(|best| found.1 < best.1) {
            best = Some(found);
        }
    }
    Ok(best)
}

/// The best minima that are not the same.
fn distinct(minima: &[([f64; 3], f64)], count: usize) -> Vec<Pose2> {
    /// Nearer minima are the same one for Gauss-Newton.
    const SAME_M: f64 = 0.3;
    const SAME_RAD: f64 = 0.05;
    let mut kept: Vec<Pose2> = vec![];
    for &([x, y, heading_rad], _) in minima {
        let pose = Pose2::new(Vector2::new(x, y), heading_rad);
        let is_same = |other: &Pose2| {
            let between = other.inverse() * pose;
            let turn_rad = between.rotation.angle().abs();
            between.translation.vector.norm() < SAME_M && turn_rad < SAME_RAD
        };
        if kept.len() < count && !kept.iter().any(is_same) {
            kept.push(pose);
        }
    }
    kept
}

/// Gauss-Newton with the wide kernel, then with that of the frame; the pose and its cost. `None` where the map has no
/// ground within `reach_m`.
pub(super) fn finish(
    objective: &FrameObjective<'_>,
    pose: &Pose2,
    reach_m: f64,
    gauss_newton: &RegistrationConfig,
    config: &WideSearchConfig,
) -> Result<Option<(Pose3, f64)>, RenderError> {
    /// Every n-th beam suffices for the wide kernel.
    const STEP: usize = 3;
    let Some(patch) = objective.patch_within(pose, reach_m)? else {
        return Ok(None);
    };
    let some: Vec<Beam> = objective.beams.iter().step_by(STEP).copied().collect();
    let lifted = patch.lift(pose, &objective.attitude);
    let renderer = objective.renderer;
    let near = approach_widely(renderer, &some, &lifted, config.kernel_m, gauss_newton)?;
    let found = registered_pose(renderer, objective.beams, &near, gauss_newton)?.unwrap_or(near);
    let is_near = (pose2_from_pose3(&found).translation.vector - pose.translation.vector).norm()
        < reach_m.max(1.0);
    let found = if is_near { found } else { lifted };
    let cost_m = objective.costs_in_space(&[found])?[0];
    Ok(Some((found, cost_m)))
}

/// Returns on upright surfaces, seen from above, in the axes of the car [m].
fn upright_returns(objective: &FrameObjective<'_>, config: &WideSearchConfig) -> Vec<Vector2<f64>> {
    let road_from_lidar = Rigid3f::from(&objective.attitude.road_from_lidar());
    let all: Vec<Vector2<f64>> = (objective.beams.iter())
        .filter(|beam| f64::from(beam.range_m) < config.range_m)
        .map(|beam| road_from_lidar.apply(beam.point()))
        .filter(|point| is_upright_height(point.z.into()))
        .map(|point| Vector2::new(point.x.into(), point.y.into()))
        .collect();
    let step = all.len().div_ceil(config.returns).max(1);
    all.into_iter().step_by(step).collect()
}

#[cfg(test)]
mod tests {
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::map::world_for_tests::TestWorld;

    /// Searches for a pose of the street from estimates that are off by x, y [m] and heading [rad]; checks the poses that are
    /// found, and returns their costs [m].
    fn found_on_street<const N: usize>(
        world: &TestWorld,
        truth_heading_rad: f64,
        offsets: [[f64; 3]; N],
        config: &WideSearchConfig,
    ) -> [f64; N] {
        let map = world.map();
        let surfaces = UprightSurfaces::new(&map.mesh().unwrap());
        let truth = world.pose_at(18.0, 0.2, truth_heading_rad);
        let beams: Vec<Beam> = world.scan(&truth).beams().step_by(5).collect();
        let objective = world.objective(&beams);
        let mut seed = 0;
        offsets.map(|[x, y, turn_rad]| {
            let off = Pose2::new(Vector2::new(x, y), turn_rad);
            let mut rng = StdRng::seed_from_u64(seed);
            seed += 1;
            let found = search(
                &objective,
                &surfaces,
                &(truth * off),
                [3.0, 3.0, 0.6],
                &RegistrationConfig::default(),
                config,
                &mut rng,
            );
            let (pose, cost_m) = found.unwrap().unwrap();
            let error = truth.inverse() * pose2_from_pose3(&pose);
            assert!(error.translation.vector.norm() < 0.02, "{off}: {error}");
            assert!(error.rotation.angle().abs() < 0.005, "{off}: {error}");
            cost_m
        })
    }

    #[test]
    fn a_pose_metres_and_tens_of_degrees_off_is_found() {
        let offsets = [[1.5, -1.0, 15.0], [-2.0, 1.0, -25.0], [2.5, 1.5, 30.0]];
        let offsets = offsets.map(|[x, y, turn_deg]| [x, y, f64::to_radians(turn_deg)]);
        let config = WideSearchConfig::default();
        found_on_street(&TestWorld::street(), 0.05, offsets, &config);
    }

    #[test]
    fn a_pose_is_found_wherever_the_street_is_in_the_map() {
        let config = WideSearchConfig::default();
        for (x, y, heading_rad) in [(40.0, -25.0, 0.8), (-30.0, 60.0, -2.0)] {
            let world = TestWorld::moved_street(Pose2::new(Vector2::new(x, y), heading_rad));
            found_on_street(&world, 0.05, [[1.5, -1.0, 0.2]], &config);
        }
    }

    #[test]
    fn swarms_come_so_near_to_the_pose_that_a_narrow_kernel_finishes() {
        let config = WideSearchConfig {
            kernel_m: 0.1,
            ..WideSearchConfig::default()
        };
        let costs_m = found_on_street(
            &TestWorld::street(),
            0.5,
            [[2.0, -1.5, 0.4], [-2.5, 1.0, -0.5]],
            &config,
        );
        assert!(costs_m.iter().all(|cost_m| *cost_m < 0.01), "{costs_m:?}");
    }

    #[test]
    fn minima_that_are_near_each_other_are_one() {
        let at = |x: f64, value: f64| ([x, 0.0, 0.0], value);
        let minima = [at(0.0, 0.1), at(0.1, 0.2), at(2.0, 0.3), at(4.0, 0.4)];
        let kept = distinct(&minima, 2);
        assert_eq!(kept.len(), 2);
        assert_eq!(kept[1].translation.x, 2.0);
    }
}
